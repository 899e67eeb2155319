"""World coordinate system of the frames for FITS: gnomonic projection, lens distortion as SIP polynomials."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.core.types import Floats
from skysim.scene.camera import CameraConfig

MAX_ORDER = 9  # the highest that SIP allows
ENOUGH_PX = 1e-4  # error at which the order is high enough
GOOD_PX = 0.01  # error above which a warning is given
SIDE = 41  # points along each side of the field that the polynomials are fitted to; checked at three times as many
MARGIN = 0.02  # of the chip's sides: the fit extends beyond the edges by this

Coefficients = dict[tuple[int, int], float]


@dataclass(frozen=True, slots=True)
class Sip:
    """Distortion as polynomials about the principal point (Shupe et al. 2005), coefficients by powers (p, q).

    a, b   : from distorted pixel offsets u, v to what is added to get the undistorted offsets
    ap, bp : the inverse, which is Brown's law (1971) itself, a polynomial of at most seventh order
    worst_px : the greatest error of a and b on the chip
    """

    a: Coefficients
    b: Coefficients
    ap: Coefficients
    bp: Coefficients
    worst_px: float


def header(camera: CameraConfig, cam_from_icrs: Rotation) -> dict[str, Any]:
    """TAN-SIP header (TAN without distortion) of the true pointing (Calabretta & Greisen 2002; Shupe et al. 2005).

    CD carries pixel offsets to degrees east (xi) and north (eta) of the tangent point; rows of the attitude
    matrix are the camera's axes in the ICRS, so its products with the local east and north are the CD's columns.
    Axes are the ICRS's; directions are apparent, aberration included (`sky.apparent`).
    """
    right, down, sight = cam_from_icrs.as_matrix()
    ra, dec = np.arctan2(sight[1], sight[0]), np.arcsin(np.clip(sight[2], -1, 1))
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    scale = np.degrees(1 / camera.focal_px)
    lens = sip(camera)
    kind = "-SIP" if lens else ""
    return {
        "CTYPE1": f"RA---TAN{kind}",
        "CTYPE2": f"DEC--TAN{kind}",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "RADESYS": "ICRS",
        "CRVAL1": np.degrees(ra) % 360,
        "CRVAL2": np.degrees(dec),
        "CRPIX1": camera.centre_px[0] + 1,  # FITS counts pixels from 1
        "CRPIX2": camera.centre_px[1] + 1,
        "CD1_1": scale * (right @ east),
        "CD1_2": scale * (down @ east),
        "CD2_1": scale * (right @ north),
        "CD2_2": scale * (down @ north),
    } | (keywords(lens) if lens else {})


def keywords(lens: Sip) -> dict[str, Any]:
    """The polynomials as FITS keywords, with SIPERR (not in the standard), their greatest error in pixels."""
    told: dict[str, Any] = {"SIPERR": lens.worst_px}
    for name in ("A", "B", "AP", "BP"):
        table: Coefficients = getattr(lens, name.lower())
        told[f"{name}_ORDER"] = max((p + q for p, q in table), default=0)
        told |= {f"{name}_{p}_{q}": value for (p, q), value in sorted(table.items())}
    return told


def doubt(camera: CameraConfig) -> str:
    """A warning if the WCS of this camera's frames is inaccurate; else empty."""
    lens = sip(camera)
    if lens is None or lens.worst_px <= GOOD_PX:
        return ""
    return (
        f"camera.distortion: too much for SIP polynomials: the frames' WCS is wrong by up to {lens.worst_px:.2g} px"
        " (keyword SIPERR)"
    )


def sip(camera: CameraConfig) -> Sip | None:
    """The camera's distortion as SIP; None without distortion, or if distortion keeps all light off the chip."""
    return fitted(camera) if any(camera.distortion) else None


@lru_cache(maxsize=8)
def fitted(camera: CameraConfig) -> Sip | None:
    """Fit polynomials of increasing order until one is within ENOUGH_PX; else return the most accurate.

    The error is checked by a round trip on the chip: undistort by the polynomials, distort by the lens.
    """
    straight, bent, lit = lattice(camera, SIDE)
    _, everywhere, on_chip = lattice(camera, 3 * SIDE)
    chip = everywhere[on_chip]
    if not lit.any():
        return None
    # Offsets are scaled to 1, or the high powers would make the least squares ill-conditioned.
    scale, found = np.abs(bent).max(), []
    for order in range(2, MAX_ORDER + 1):
        powers = [(p, n - p) for n in range(2, order + 1) for p in range(n, -1, -1)]
        added = np.linalg.lstsq(monomials(bent / scale, powers), straight - bent, rcond=None)[0]
        a, b = (
            {(p, q): float(value) / scale ** (p + q) for (p, q), value in zip(powers, column, strict=True)}
            for column in added.T
        )
        back = distorted(chip + monomials(chip / scale, powers) @ added, camera)
        found.append(Sip(a, b, *brown(camera), float(np.linalg.norm(back - chip, axis=1).max())))
        if found[-1].worst_px <= ENOUGH_PX:
            break
    return min(found, key=lambda one: one.worst_px)


def monomials(xy: Floats, powers: list[tuple[int, int]]) -> Floats:
    """(N, len(powers)) x^p y^q."""
    x, y = (np.vander(side, MAX_ORDER + 1, increasing=True) for side in xy.T)
    return np.column_stack([x[:, p] * y[:, q] for p, q in powers])


def lattice(camera: CameraConfig, side: int) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Offsets (N, 2) from the principal point, px, without and with distortion; (N,) which are on the chip.

    The others are slightly beyond its edges, so that the fit does not extrapolate at an edge.
    """
    centre, size = np.array(camera.centre_px), np.array([camera.width_px, camera.height_px])
    corner = camera.focal_px * np.tan(Optics.of(camera).field_rad)
    wider = max(corner / camera.corner_px, 1.0) * (1 + 2 * MARGIN)
    ends = np.array([-0.5 - centre, size - 0.5 - centre])
    low, high = ends * np.where((ends < 0) == [[True], [False]], wider, 1 / wider)
    steps = [np.linspace(*pair, side) for pair in zip(low, high, strict=True)]
    straight = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    bent = distorted(straight, camera)
    pixels = bent + centre

    def within(out: float) -> NDArray[np.bool_]:
        return np.asarray(((pixels >= -0.5 - out * size) & (pixels <= size - 0.5 + out * size)).all(axis=1))

    near = within(MARGIN)
    return straight[near], bent[near], within(0)[near]


def distorted(straight: Floats, camera: CameraConfig) -> Floats:
    """Apply the lens's distortion to (N, 2) undistorted offsets from the principal point, px.

    Points beyond the distortion's fold, which have no image, get a large offset.
    """
    rays = np.column_stack([straight / camera.focal_px, np.ones(len(straight))])
    bent = Optics.of(camera).project(rays) - np.array(camera.centre_px)
    return np.where(np.isfinite(bent), bent, 1e9)


def brown(camera: CameraConfig) -> tuple[Coefficients, Coefficients]:
    """Brown's distortion as polynomials in the undistorted offsets, multiplied out.

    x (k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (3 x^2 + y^2), y likewise, with x = U / focal; r^2n by the binomial.
    """
    k1, k2, p1, p2, k3 = camera.distortion
    binomials = {1: (1, 1), 2: (1, 2, 1), 3: (1, 3, 3, 1)}
    across: Coefficients = {(1, 1): 2 * p1, (2, 0): 3 * p2, (0, 2): p2}
    down: Coefficients = {(1, 1): 2 * p2, (0, 2): 3 * p1, (2, 0): p1}
    for n, k in ((1, k1), (2, k2), (3, k3)):
        for m, times in enumerate(binomials[n]):
            p, q = 2 * (n - m), 2 * m
            across[p + 1, q] = k * times
            down[p, q + 1] = k * times
    focal = camera.focal_px
    return tuple(  # type: ignore[return-value]
        {(p, q): value * focal ** (1 - p - q) for (p, q), value in table.items() if value}
        for table in (across, down)
    )
