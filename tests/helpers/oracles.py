"""Sky frames rendered by skysim, solved by independent solvers ("oracles").

Frames at random attitudes go to tetra3rs and to astrometry.net as FITS
files, with only the field of view (tetra3rs: the camera calibration) given. Each detects the stars with its own code
and identifies them with its own catalog. Its world coordinates (WCS), and separately its identified stars, are
compared with the WCS in the frame's header, and the difference with the error predicted from the oracle's own
residuals. `tests.helpers.galsim_sky` has the opposite direction.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.coordinates import GCRS, SkyCoord
from astropy.io import fits
from astropy.time import Time
from astropy.wcs import WCS, FITSFixedWarning
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from skysim.core.constants import SPEED_OF_LIGHT_KM_S
from skysim.core.types import Frame, Truth
from skysim.results.files import recording as frame_files
from skysim.results.metrics import WRONG_RAD
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import build_lab
from skysim.tracking import factory, onboard_model
from skysim.tracking import tetra3rs as tetra3rs_tracker

# Epochs of the catalogs: Tycho-2 in the index files, and Gaia; both are used without proper motions.
EPOCHS = {"astrometry.net": "2000-01-01T12:00:00", "tetra3rs": "2016-01-01T12:00:00"}
STILL = {"motion.rate_deg_s": "[0, 0, 0]"}
# EC655 unchanged; and 1600 x 1200 pixels over 25 degrees with a lens whose distortion is 12.5 pixels at the corners.
SCENES = {
    "shefex2": STILL,
    "shefex2, wide": STILL
    | {
        "camera.preset": "lu205c",
        "camera.focal_length": "15 mm",
        "camera.distortion": "[-0.18, 0.05, 2e-4, -3e-4, 0]",
        "camera.detector.gain_e_dn": "4",
        "camera.detector.bits": "14",
        "camera.shutter": "{kind: global}",
    },
}
# Order of astrometry.net's distortion polynomials: 1 is a lens without distortion.
TWEAK_ORDER = {"shefex2": 1, "shefex2, wide": 3}
SIDE = (
    9  # lattice points along each side of the frame at which world coordinates are compared
)
CLASSES = 12  # number of brightness classes, each with its own centroid variance
MISTAKEN = 4.0  # ratio to the usual variance above which a frame is taken to have a misidentified star
TIMES = 3.0  # tolerance as a multiple of the predicted error
DEEPEST_G = 7.5  # limiting magnitude of tetra3rs's stars; the frames have stars to V = 6.5
STAR_PX = 1.0  # maximum distance of a centroid from its catalog star


@dataclass(frozen=True, slots=True)
class Found:
    """Result of an oracle for a frame. Directions are apparent, in ICRS axes.

    direction  : (N, 3) directions of the pixels of `lattice` by its world coordinates
    order      : order of the polynomials in the world coordinates; 0 for an attitude alone
    xy_px      : (K, 2) detected stars;  left_px : (K, 2) residuals, detected minus catalog position
    brightness : (K,) in the oracle's units;  named : (K, 3) catalog directions of the stars
    """

    direction: NDArray
    order: int
    xy_px: NDArray
    left_px: NDArray
    brightness: NDArray
    named: NDArray

    @property
    def variance_px2(self) -> NDArray:
        """(K,) squared residual of each star per axis, corrected for the number of fitted coefficients."""
        coefficients = (self.order + 1) * (self.order + 2) / 2 if self.order else 1.5
        count = len(self.xy_px)
        return np.asarray(
            np.sum(self.left_px**2, axis=1) / 2 * count / max(count - coefficients, 1.0)
        )


@dataclass(frozen=True, slots=True)
class Sighting:
    """A solved frame and the error of the oracle relative to the header, as rotation vectors in camera axes.

    coordinates : error of its world coordinates;  stars : error of the attitude from its stars alone
    rays        : (K, 3) the stars in camera axes
    """

    frame: int
    coordinates: NDArray
    stars: NDArray
    rays: NDArray
    found: Found


@dataclass(frozen=True, slots=True)
class Agreement:
    """One solved frame: error of the oracle's attitude, and the predicted standard deviations."""

    frame: int
    cross_rad: float
    roll_rad: float
    sigma_cross_rad: float
    sigma_roll_rad: float
    stars: int

    @property
    def within(self) -> bool:
        """Whether cross-boresight and roll errors are both within TIMES the predicted error."""
        return (
            self.cross_rad <= TIMES * self.sigma_cross_rad
            and abs(self.roll_rad) <= TIMES * self.sigma_roll_rad
        )

    @property
    def wrong(self) -> bool:
        return float(np.hypot(self.cross_rad, self.roll_rad)) > WRONG_RAD


Solve = Callable[[Path, Frame], Found | None]


Pair = tuple[
    Agreement, Agreement
]  # by the oracle's own world coordinates, and by its stars alone


def load(name: str, who: str, frames: int) -> Scene:
    """A scene of SCENES at rest with `frames` frames, at the epoch of the oracle's catalog."""
    keys = SCENES[name] | {"start_time": EPOCHS[who], "exposure.frames": str(frames)}
    return loader.load(name.split(",")[0], keys)


def render_frames(scene: Scene, seed: int) -> Iterator[tuple[Frame, Truth]]:
    """Yield the frames of a scene, each at rest at its own uniformly random attitude."""
    lab = build_lab(scene)
    for n in range(scene.exposure.frames):
        cam_from_icrs = Rotation.random(rng=np.random.default_rng([seed, n]))
        yield render_at_rest(
            lab.camera, cam_from_icrs.inv() * lab.camera.mount.cam_from_body, n
        )


def lattice(width_px: int, height_px: int) -> NDArray:
    """(SIDE^2, 2) pixels on a regular lattice over the frame."""
    sides = np.linspace(0, width_px - 1, SIDE), np.linspace(0, height_px - 1, SIDE)
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


def directions(header: fits.Header, xy_px: NDArray) -> NDArray:
    """(N, 3) directions of pixels from the WCS of a FITS header, by astropy."""
    with warnings.catch_warnings():
        # astrometry.net's header belongs to no image.
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(header, fix=False)
    return unit_vectors(*wcs.all_pix2world(xy_px, 0).T)


def unit_vectors(ra_deg: NDArray, dec_deg: NDArray) -> NDArray:
    """(N, 3) unit vectors of right ascensions and declinations."""
    return np.asarray(SkyCoord(ra_deg, dec_deg, unit="deg").cartesian.xyz.value.T)


def radec_deg(vectors: NDArray) -> tuple[NDArray, NDArray]:
    """Right ascension and declination of (N, 3) vectors, degrees."""
    x, y, z = vectors.T
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))


def aberrated(direction: NDArray, utc: str) -> NDArray:
    """(N, 3) apparent directions from the Earth, by astropy: aberration and light deflection by the Sun."""
    seen = SkyCoord(*radec_deg(direction), unit="deg").transform_to(GCRS(obstime=Time(utc)))
    return np.asarray(seen.cartesian.xyz.value.T)


def sighting(frame: Frame, truth: Truth, header: fits.Header, found: Found) -> Sighting:
    """Compare an oracle's result with the header of a frame.

    Each error is the rotation in camera axes that best aligns the header's directions with the oracle's: over the
    lattice by its world coordinates, and at its stars by its catalog.
    """
    turn = truth.cam_from_lab.apply
    everywhere = turn(directions(header, lattice(*frame.image_dn.shape[::-1])))
    rays = turn(directions(header, found.xy_px))
    coordinates, stars = (
        Rotation.align_vectors(turn(theirs), ours)[0].as_rotvec()
        for theirs, ours in ((found.direction, everywhere), (found.named, rays))
    )
    return Sighting(frame.index, coordinates, stars, rays, found)


def agreements(seen: Sequence[Sighting], camera: Camera) -> list[Pair]:
    """The two errors of each frame with their standard deviations, predicted from the scatter of the oracle's stars."""
    held = []
    for one, sigma_px in zip(
        seen, star_sigmas_px([each.found for each in seen]), strict=True
    ):
        by_stars = attitude_spread(one.rays, sigma_px / camera.focal_px)
        by_plate = plate_spread(one.found, sigma_px, camera) if one.found.order else by_stars
        held.append(
            (agreement(one, one.coordinates, by_plate), agreement(one, one.stars, by_stars))
        )
    return held


def agreement(one: Sighting, turn: NDArray, sigma: tuple[float, float]) -> Agreement:
    return Agreement(
        one.frame, float(np.hypot(*turn[:2])), float(turn[2]), *sigma, len(one.rays)
    )


def star_sigmas_px(found: Sequence[Found]) -> list[NDArray]:
    """(K,) standard deviations of the stars of each frame, pixels per axis, from the oracle's residuals alone.

    The variance is the mean over all frames in a class of equal brightness. If the residuals of a frame scatter more,
    for example because of a misidentified star, the variances of all its stars are scaled up by that ratio. Frames
    whose ratio exceeds MISTAKEN are left out of the mean. For that test the variance comes from the median, because the
    median of (dx^2 + dy^2) / 2 is sigma^2 ln 2 for Gaussian errors.
    """
    brightness = np.concatenate([one.brightness for one in found])
    edges = np.quantile(brightness, np.linspace(0, 1, CLASSES + 1))[1:-1]
    members = [np.searchsorted(edges, one.brightness) for one in found]

    def law(take: Callable[[NDArray], Any], sound: Sequence[int]) -> NDArray:
        member = np.concatenate([members[n] for n in sound])
        variance = np.concatenate([found[n].variance_px2 for n in sound])
        return np.array([take(variance[member == n]) for n in range(CLASSES)])

    def worse(usual: NDArray) -> list[float]:
        return [
            float(np.mean(one.variance_px2 / usual[member]))
            for one, member in zip(found, members, strict=True)
        ]

    rough = law(np.median, range(len(found))) / np.log(2)
    usual = law(np.mean, [n for n, times in enumerate(worse(rough)) if times < MISTAKEN])
    return [
        np.sqrt(usual[member] * max(1.0, times))
        for member, times in zip(members, worse(usual), strict=True)
    ]


def attitude_spread(rays: NDArray, sigma_rad: NDArray) -> tuple[float, float]:
    """Standard deviations, rad, of an unweighted least-squares attitude from (K, 3) rays in camera axes: RMS across
    the boresight, and about it.

    The covariance is H^-1 sum(sigma^2 (I - b b^T)) H^-1 with H = sum(I - b b^T).
    """
    projectors = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    inverse = np.linalg.inv(projectors.sum(axis=0))
    covariance = inverse @ np.tensordot(sigma_rad**2, projectors, axes=1) @ inverse
    return float(np.sqrt(covariance[0, 0] + covariance[1, 1])), float(
        np.sqrt(covariance[2, 2])
    )


def plate_spread(found: Found, sigma_px: NDArray, camera: Camera) -> tuple[float, float]:
    """The same for an unweighted least-squares plate solution, whose error is the mean rotation of the lattice.

    Shift and rotation of the lattice are linear in the plate coefficients. The covariance of these is
    (A^T A)^-1 A^T diag(sigma^2) A (A^T A)^-1, separately for x and y, with A the monomials at the stars.
    """
    middle = np.array([(camera.width_px - 1) / 2, (camera.height_px - 1) / 2])

    def monomials(xy_px: NDArray) -> NDArray:
        x, y = ((xy_px - middle) / middle).T
        return np.column_stack(
            [x**p * y ** (n - p) for n in range(found.order + 1) for p in range(n + 1)]
        )

    inverse = np.linalg.pinv(monomials(found.xy_px))
    covariance = (inverse * sigma_px**2) @ inverse.T
    pixels = lattice(camera.width_px, camera.height_px)
    # Least-squares rotation of the lattice by a small displacement field: sum(arm x displacement) / sum(arm^2).
    shift = monomials(pixels).mean(axis=0)
    arms = (pixels - middle) / np.sum((pixels - middle) ** 2)
    turns = arms.T @ monomials(pixels)
    cross_px, roll_rad = np.sqrt(
        [2 * shift @ covariance @ shift, np.sum((turns @ covariance) * turns)]
    )
    return float(cross_px / camera.focal_px), float(roll_rad)


def astrometry_net(name: str) -> Solve | None:
    """astrometry.net's `solve-field`, given only the field width to 5%; None if it is not installed."""
    if not (
        shutil.which("solve-field") and list(Path("/usr/share/astrometry").glob("index-*"))
    ):
        return None
    camera = load(name, "astrometry.net", 1).camera
    width_deg = float(np.degrees(onboard_model.calibration(camera).fov_rad))
    size_px = (camera.width_px, camera.height_px)
    order = TWEAK_ORDER[name]
    options = [
        "--overwrite",
        "--no-plots",
        "--no-verify",
        "--crpix-center",
        "--cpulimit",
        "30",
    ]
    options += ["--scale-units", "degwidth", "--scale-low", f"{0.95 * width_deg}"]
    options += ["--scale-high", f"{1.05 * width_deg}", "--tweak-order", str(order)]
    # Skip its Python steps, which need more packages.
    options += ["--no-remove-lines", "--uniformize", "0"]
    options += [
        part
        for kind in ("new-fits", "rdls", "match", "index-xyls")
        for part in (f"--{kind}", "none")
    ]

    def solve(path: Path, frame: Frame) -> Found | None:
        stem = path.with_suffix("")
        subprocess.run(
            ["solve-field", *options, str(path)],
            capture_output=True,
            check=True,
            cwd=path.parent,
        )
        if not stem.with_suffix(".solved").exists():
            return None
        matched = fits.getdata(stem.with_suffix(".corr"))
        direction = directions(fits.getheader(stem.with_suffix(".wcs")), lattice(*size_px))
        utc = fits.getheader(path)["DATE-OBS"]
        xy_px = (
            np.column_stack([matched["field_x"], matched["field_y"]]) - 1
        )  # FITS counts from 1
        left_px = xy_px + 1 - np.column_stack([matched["index_x"], matched["index_y"]])
        named = aberrated(unit_vectors(matched["index_ra"], matched["index_dec"]), utc)
        return Found(aberrated(direction, utc), order, xy_px, left_px, matched["FLUX"], named)

    return solve


def tetra3rs(name: str) -> Solve | None:
    """tetra3rs with the camera calibration given, and its own centroids, catalog and aberration; None if it is not
    installed."""
    if importlib.util.find_spec("tetra3rs") is None:
        return None
    scene = load(name, "tetra3rs", 1)
    camera = onboard_model.assumed_camera(scene)
    lab = build_lab(scene)
    setup = factory.setup_of(scene, lab.camera.mount, lab.camera.sources)
    tracker = tetra3rs_tracker.Tetra3rs(setup)
    pixels = lattice(camera.width_px, camera.height_px) - tracker.image_center_px

    def solve(path: Path, frame: Frame) -> Found | None:
        seen = tracker.extract(
            fits.getdata(path).astype(np.uint16), max_centroids=60, threads=1
        )
        answer = tracker.database.solve_from_centroids(
            seen.centroids,
            camera_model=tracker.camera,
            observer_velocity_km_s=tracker.velocity_km_s,
        )
        if not answer:
            return None
        direction = unit_vectors(*answer.pixel_to_world(*np.ascontiguousarray(pixels.T)))
        return Found(direction, 0, *its_stars(tracker, seen.centroids, answer))

    return solve


def its_stars(
    tracker: tetra3rs_tracker.Tetra3rs, centroids: Sequence[Any], answer: Any
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """All centroids of tetra3rs that agree with a star of its catalog: the last four fields of Found.

    Its own matches are not used (nor is its `attitude_sigma_rad`), because they remain after a clipping that removes
    the worst eighth of the stars and with them three tenths of the variance.
    """
    radius_deg = 0.7 * tracker.camera.fov_deg
    listed = tracker.database.cone_search(
        answer.crval_ra_deg, answer.crval_dec_deg, radius_deg
    )
    places = np.array(
        [(star.ra_deg, star.dec_deg) for star in listed if star.magnitude < DEEPEST_G]
    )
    moved = unit_vectors(*places.T) + np.array(tracker.velocity_km_s) / SPEED_OF_LIGHT_KM_S
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    there_px = np.nan_to_num(
        np.column_stack(answer.world_to_pixel(*radec_deg(moved))), nan=1e6
    )
    seen = np.array([(one.x, one.y, one.brightness) for one in centroids])
    apart_px, star = cKDTree(there_px).query(seen[:, :2])
    near = apart_px < STAR_PX
    star = star[near]
    (x, y, brightness) = seen[near].T
    xy_px = np.column_stack([x, y])
    return xy_px + tracker.image_center_px, xy_px - there_px[star], brightness, moved[star]


ORACLES = {"tetra3rs": tetra3rs, "astrometry.net": astrometry_net}


def confront(name: str, who: str, oracle: Solve, frames: int, seed: int) -> list[Pair]:
    """Errors and predictions of every frame that the oracle solves."""
    seen = []
    scene = load(name, who, frames)
    for frame, truth in render_frames(scene, seed):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "frame.fits"
            frame_files.write_fits(path, frame, truth, scene)
            found = oracle(path, frame)
            if found:
                seen.append(sighting(frame, truth, fits.getheader(path), found))
    return agreements(seen, onboard_model.calibration(scene.camera))


def squares(solved: Sequence[Agreement]) -> NDArray:
    """(2,) mean of (error / predicted sigma)^2, cross-boresight and roll; 1 if the prediction is correct."""
    ratio = [
        (one.cross_rad / one.sigma_cross_rad, one.roll_rad / one.sigma_roll_rad)
        for one in solved
    ]
    return np.asarray(np.mean(np.square(ratio), axis=0))
