"""World coordinate system of the frames for FITS: gnomonic projection, lens distortion as SIP polynomials."""

import math
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.optics import distort, field_rad, fold_r
from skysim.core.types import Bools, Floats, Record, frozen, grid_points, lengths
from skysim.scene.opencv_calibration import OpencvCalibration
from skysim.sources.stars import sky_axes

MAX_ORDER = 9  # the highest that SIP allows
TARGET_ERROR_PX = 1e-4  # the fit stops at the first order with a smaller error
MAX_ERROR_PX = 0.01  # a larger error gives a warning
# Points along each side of the field that the polynomials are fitted to; checked at three times as many.
GRID_SIDE = 41
MARGIN = 0.02  # the fit extends beyond the chip's edges by this fraction of its sides

Coefficients = dict[tuple[int, int], float]


@frozen
class Sip:
    """Distortion as polynomials about the principal point (Shupe et al. 2005), coefficients by powers (p, q).

    Attributes
    ----------
    a, b
        Polynomials of the distorted pixel offsets (u, v): what to add to get the undistorted offsets
    ap, bp
        The inverse, which is Brown's law (1971) itself, a polynomial of at most seventh order
    worst_px
        Greatest error of a and b on the chip
    """

    a: Coefficients
    b: Coefficients
    ap: Coefficients
    bp: Coefficients
    worst_px: float


def header(camera: OpencvCalibration, cam_from_icrs: Rotation) -> Record:
    """TAN-SIP header (TAN without distortion) of a pointing (Calabretta & Greisen 2002; Shupe et al. 2005).

    CD converts pixel offsets to degrees east (xi) and north (eta) of the tangent point. The rows of the attitude
    matrix are the camera's axes in the ICRS, so CD's columns are their products with the local east and north.
    The axes are those of the ICRS; directions are apparent, aberration included (`sky.apparent`).
    """
    right, down, boresight = cam_from_icrs.as_matrix()
    ra = np.arctan2(boresight[1], boresight[0])
    dec = np.arcsin(np.clip(boresight[2], -1, 1))
    east, north, _ = sky_axes(ra, dec)
    scale = np.degrees(1 / camera.focal_px)
    distortion = fit_sip(camera)
    suffix = "-SIP" if distortion else ""
    return {
        "CTYPE1": f"RA---TAN{suffix}",
        "CTYPE2": f"DEC--TAN{suffix}",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "RADESYS": "ICRS",
        "CRVAL1": np.degrees(ra) % 360,
        "CRVAL2": np.degrees(dec),
        "CRPIX1": camera.center_px[0] + 1,  # FITS counts pixels from 1
        "CRPIX2": camera.center_px[1] + 1,
        "CD1_1": scale * (right @ east),
        "CD1_2": scale * (down @ east),
        "CD2_1": scale * (right @ north),
        "CD2_2": scale * (down @ north),
    } | (keywords(distortion) if distortion else {})


def keywords(distortion: Sip) -> Record:
    """The polynomials as FITS keywords, and their greatest error in pixels as SIPERR (not in the standard)."""
    cards: Record = {"SIPERR": distortion.worst_px}
    for name in ("A", "B", "AP", "BP"):
        table: Coefficients = getattr(distortion, name.lower())
        cards[f"{name}_ORDER"] = max((p + q for p, q in table), default=0)
        cards |= {f"{name}_{p}_{q}": value for (p, q), value in sorted(table.items())}
    return cards


def accuracy_warning(camera: OpencvCalibration) -> str:
    """A warning if the WCS of this camera's frames is inaccurate; otherwise an empty string."""
    distortion = fit_sip(camera)
    if distortion is None or distortion.worst_px <= MAX_ERROR_PX:
        return ""
    return (
        f"camera.distortion: too much for SIP polynomials: the frames' WCS is wrong by up to"
        f" {distortion.worst_px:.2g} px (keyword SIPERR)"
    )


@lru_cache(maxsize=8)
def fit_sip(camera: OpencvCalibration) -> Sip | None:
    """The camera's distortion as SIP; None without distortion, or if distortion keeps all light off the chip.

    1. Make points on the chip and slightly beyond, without and with distortion; more of them for checks.
    2. Fit polynomials of increasing order by least squares.
    3. Check each by a round trip on the chip: undistort by the polynomials, distort by the lens.
    4. Stop at the first order within TARGET_ERROR_PX; else take the most accurate.
    """
    if not any(camera.distortion):
        return None
    # 1. Points for the fit and for the check.
    undistorted_px, distorted_px, on_chip = fit_grid(camera, GRID_SIDE)
    _, checked_px, checked_on_chip = fit_grid(camera, 3 * GRID_SIDE)
    chip_px = checked_px[checked_on_chip]
    if not on_chip.any():
        return None
    # Offsets are scaled to 1; high powers of pixels would make the least squares ill-conditioned.
    scale = np.abs(distorted_px).max()
    fits = []
    for order in range(2, MAX_ORDER + 1):
        # 2. All powers p + q from 2 to the order.
        powers = [(p, n - p) for n in range(2, order + 1) for p in range(n, -1, -1)]
        design = monomials(distorted_px / scale, powers)
        solution = np.linalg.lstsq(design, undistorted_px - distorted_px, rcond=None)[0]
        a, b = (
            {(p, q): one / scale ** (p + q) for (p, q), one in zip(powers, side, strict=True)}
            for side in solution.T.tolist()
        )
        # 3. Round trip.
        round_trip = distorted(
            chip_px + monomials(chip_px / scale, powers) @ solution, camera
        )
        worst_px = float(lengths(round_trip - chip_px).max())
        fits.append(Sip(a, b, *brown(camera), worst_px))
        # 4.
        if worst_px <= TARGET_ERROR_PX:
            break
    return min(fits, key=lambda fit: fit.worst_px)


def monomials(xy: Floats, powers: list[tuple[int, int]]) -> Floats:
    """(N, len(powers)) values of x^p y^q at (N, 2) points."""
    x, y = (np.vander(side, MAX_ORDER + 1, increasing=True) for side in xy.T)
    return np.column_stack([x[:, p] * y[:, q] for p, q in powers])


def fit_grid(camera: OpencvCalibration, side: int) -> tuple[Floats, Floats, Bools]:
    """A grid of image points with their places without distortion.

    Returns
    -------
    tuple
        (N, 2) offsets from the principal point in px without distortion, the same with distortion, and (N,) which
        points are on the chip. The others are slightly beyond its edges, so that the fit does not extrapolate there.
    """
    center = np.array(camera.center_px)
    size = np.array([camera.width_px, camera.height_px])
    corner_r = camera.corner_px / camera.focal_px
    fold = fold_r(camera.distortion)
    corner = camera.focal_px * np.tan(field_rad(corner_r, camera.distortion, fold))
    # Barrel distortion draws points in, so the undistorted grid must be wider than the chip.
    widening = max(corner / camera.corner_px, 1.0) * (1 + 2 * MARGIN)
    edges = np.array([-0.5 - center, size - 0.5 - center])
    low, high = edges * np.where((edges < 0) == [[True], [False]], widening, 1 / widening)
    steps = [np.linspace(*pair, side) for pair in zip(low, high, strict=True)]
    undistorted_px = grid_points(*steps)
    distorted_px = distorted(undistorted_px, camera)
    pixels = distorted_px + center

    def inside(out: float) -> Bools:
        # Distorted pixels within the chip and a fraction `out` of its sides.
        return ((pixels >= -0.5 - out * size) & (pixels <= size - 0.5 + out * size)).all(
            axis=1
        )

    on_fit_area = inside(MARGIN)
    return undistorted_px[on_fit_area], distorted_px[on_fit_area], inside(0)[on_fit_area]


def distorted(undistorted_px: Floats, camera: OpencvCalibration) -> Floats:
    """Apply the lens's distortion to (N, 2) undistorted offsets from the principal point, px.

    Points beyond the distortion's fold, which have no image, get a large offset.
    """
    x, y = undistorted_px.T / camera.focal_px
    tangents = np.column_stack(distort(camera.distortion, fold_r(camera.distortion), x, y))
    return np.where(np.isfinite(tangents), tangents * camera.focal_px, 1e9)


def brown(camera: OpencvCalibration) -> tuple[Coefficients, Coefficients]:
    """Brown's distortion as polynomials in the undistorted offsets U, V in pixels.

    x (k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (3 x^2 + y^2), y likewise, with x = U / focal. Powers of r^2 = x^2 +
    y^2 are multiplied out by the binomial theorem.
    """
    k1, k2, p1, p2, k3 = camera.distortion
    across: Coefficients = {(1, 1): 2 * p1, (2, 0): 3 * p2, (0, 2): p2}
    down: Coefficients = {(1, 1): 2 * p2, (0, 2): 3 * p1, (2, 0): p1}
    for n, k in ((1, k1), (2, k2), (3, k3)):
        for m in range(n + 1):
            p = 2 * (n - m)
            q = 2 * m
            across[p + 1, q] = down[p, q + 1] = k * math.comb(n, m)
    return in_pixels(across, camera.focal_px), in_pixels(down, camera.focal_px)


def in_pixels(table: Coefficients, focal_px: float) -> Coefficients:
    """The terms that are not 0, from tangents to pixels: divided by focal^(p + q) and multiplied by focal."""
    return {
        (p, q): value * focal_px ** (1 - p - q) for (p, q), value in table.items() if value
    }
