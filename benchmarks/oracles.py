"""Our sky frames, solved by others. `python -m benchmarks.oracles [FRAMES] [SEED]`.

Frames at random attitudes go to tetra3rs and to astrometry.net as FITS files, with nothing of ours but the camera's
field of view (tetra3rs: its calibration). Each finds the stars by its own code and names them by its own catalogue.
Its world coordinates, and its stars alone, are held against the world coordinates in the frame's header, and the
difference against the error that the oracle's own residuals predict. `benchmarks.galsim_sky` is the way back.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
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
from skysim.core.types import Frame, Trajectory, Truth
from skysim.core.units import ARCSEC_RAD
from skysim.results.files import frames as frame_files
from skysim.results.metrics import WRONG_RAD
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.simulation import testbed
from skysim.simulation.exposure import render_frame
from skysim.sources.stars import C_M_S
from skysim.tracking import onboard_model
from skysim.tracking import settings as tracker_settings
from skysim.tracking.external import adapter
from skysim.tracking.external import tetra3rs as tetra3rs_tracker
from skysim.tracking.external.interface import Stars

# When the stars stood where the catalogue has them: the index files' Tycho-2, and Gaia, both without proper motions.
EPOCHS = {"astrometry.net": "2000-01-01T12:00:00", "tetra3rs": "2016-01-01T12:00:00"}
STILL = {"motion.rate_deg_s": "[0, 0, 0]"}
# EC655 as it is; and 1600 x 1200 pixels on 25 degrees, behind a lens that moves its corners by 12.5 pixels.
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
TWEAK_ORDER = {
    "shefex2": 1,
    "shefex2, wide": 3,
}  # of astrometry.net's polynomials: 1 is a lens without distortion
SIDE = 9  # pixels along each side of the frame where world coordinates are compared
CLASSES = 12  # of brightness, of which each has its own error of a star
MISTAKEN = 4.0  # of the variance that stars have, from which on one of a frame's is taken to be another
TIMES = 3.0  # the predicted error
DEEPEST_G = 7.5  # of tetra3rs's stars: those to V = 6.5 are drawn
STAR_PX = 1.0  # how near to one of them a centroid is that star


@dataclass(frozen=True, slots=True)
class Found:
    """What an oracle says of a frame. Directions are apparent, in ICRS axes.

    direction  : (N, 3) where the pixels of `lattice` look, by its own world coordinates
    order      : of the polynomials in them; 0 for an attitude alone
    xy_px      : (K, 2) stars that it found, left_px: how far its coordinates and catalogue put them from there
    brightness : (K,) by its own measure;  named : (K, 3) where its catalogue has them
    """

    direction: NDArray
    order: int
    xy_px: NDArray
    left_px: NDArray
    brightness: NDArray
    named: NDArray

    @property
    def variance_px2(self) -> NDArray:
        """(K,) of each star, each axis, for the coefficients that were fitted."""
        coefficients = (self.order + 1) * (self.order + 2) / 2 if self.order else 1.5
        count = len(self.xy_px)
        return np.asarray(np.sum(self.left_px**2, axis=1) / 2 * count / max(count - coefficients, 1.0))


@dataclass(frozen=True, slots=True)
class Sighting:
    """A solved frame: by what turn, in camera axes, the oracle's coordinates, and its stars, are off the header's.

    rays : (K, 3) the stars in camera axes
    """

    frame: int
    coordinates: NDArray
    stars: NDArray
    rays: NDArray
    found: Found


@dataclass(frozen=True, slots=True)
class Agreement:
    """One solved frame: the oracle's attitude against the truth, and what it may be off by."""

    frame: int
    cross_rad: float
    roll_rad: float
    sigma_cross_rad: float
    sigma_roll_rad: float
    stars: int

    @property
    def within(self) -> bool:
        """Whether boresight and roll are both within TIMES the predicted error."""
        return (
            self.cross_rad <= TIMES * self.sigma_cross_rad
            and abs(self.roll_rad) <= TIMES * self.sigma_roll_rad
        )

    @property
    def wrong(self) -> bool:
        return float(np.hypot(self.cross_rad, self.roll_rad)) > WRONG_RAD


Solve = Callable[[Path, Frame], Found | None]


Pair = tuple[Agreement, Agreement]  # by the oracle's own world coordinates, and by its stars alone


def load(name: str, who: str, frames: int) -> Scene:
    """A scene of SCENES at rest, of so many frames, taken in the epoch of that oracle's catalogue."""
    keys = SCENES[name] | {"start_time": EPOCHS[who], "exposure.frames": str(frames)}
    return loader.load(name.split(",")[0], keys)


def photographs(told: Scene, seed: int) -> Iterator[tuple[Frame, Truth]]:
    """A scene's frames, each at an attitude of its own, uniform over all rotations, and at rest."""
    lab = testbed.build_testbed(told)
    for n in range(told.exposure.frames):
        cam_from_icrs = Rotation.random(rng=np.random.default_rng([seed, n]))
        still = Trajectory.at_rest(cam_from_icrs.inv() * lab.mount.cam_from_body, lab.flown_s)
        yield render_frame(replace(lab, trajectory=still), n)


def lattice(width_px: int, height_px: int) -> NDArray:
    """(SIDE^2, 2) pixels all over a frame."""
    sides = np.linspace(0, width_px - 1, SIDE), np.linspace(0, height_px - 1, SIDE)
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


def directions(header: fits.Header, xy_px: NDArray) -> NDArray:
    """(N, 3) where pixels look, by astropy from a FITS header."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)  # astrometry.net's header belongs to no image
        told = WCS(header, fix=False)
    return unit_vectors(*told.all_pix2world(xy_px, 0).T)


def unit_vectors(ra_deg: NDArray, dec_deg: NDArray) -> NDArray:
    """(N, 3)."""
    return np.asarray(SkyCoord(ra_deg, dec_deg, unit="deg").cartesian.xyz.value.T)


def radec_deg(vectors: NDArray) -> tuple[NDArray, NDArray]:
    """Right ascension and declination of (N, 3) vectors."""
    x, y, z = vectors.T
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arctan2(z, np.hypot(x, y)))


def aberrated(direction: NDArray, utc: str) -> NDArray:
    """(N, 3) catalogue directions as seen from the Earth, by astropy: aberration and the Sun's bending."""
    seen = SkyCoord(*radec_deg(direction), unit="deg").transform_to(GCRS(obstime=Time(utc)))
    return np.asarray(seen.cartesian.xyz.value.T)


def sighting(frame: Frame, truth: Truth, header: fits.Header, found: Found) -> Sighting:
    """The rotations in camera axes that take the header's directions nearest to the oracle's: on a lattice over the
    frame, where the oracle's world coordinates tell them, and at its stars, where its catalogue does."""
    turn = truth.cam_from_lab.apply
    everywhere = turn(directions(header, lattice(*frame.image_dn.shape[::-1])))
    rays = turn(directions(header, found.xy_px))
    coordinates, stars = (
        Rotation.align_vectors(turn(theirs), ours)[0].as_rotvec()
        for theirs, ours in ((found.direction, everywhere), (found.named, rays))
    )
    return Sighting(frame.index, coordinates, stars, rays, found)


def agreements(seen: Sequence[Sighting], camera: Camera) -> list[Pair]:
    """Every frame's two turns beside what is to be expected of them, by how the oracle's stars scatter."""
    held = []
    for one, sigma_px in zip(seen, star_sigmas_px([each.found for each in seen]), strict=True):
        by_stars = attitude_spread(one.rays, sigma_px / camera.focal_px)
        by_plate = plate_spread(one.found, sigma_px, camera) if one.found.order else by_stars
        held.append((agreement(one, one.coordinates, by_plate), agreement(one, one.stars, by_stars)))
    return held


def agreement(one: Sighting, turn: NDArray, sigma: tuple[float, float]) -> Agreement:
    return Agreement(one.frame, float(np.hypot(*turn[:2])), float(turn[2]), *sigma, len(one.rays))


def star_sigmas_px(found: Sequence[Found]) -> list[NDArray]:
    """(K,) of each frame: the oracle's error of a star, from its own residuals alone.

    That of a star of that brightness: the mean variance over the frames. A frame's stars that scatter by more, for one
    of them was taken for another, count as worse by as much, all of them; in the mean are no frames MISTAKEN times as
    bad as the median has them (of a Gaussian in two axes, sigma^2 2 ln 2).
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
        np.sqrt(usual[member] * max(1.0, times)) for member, times in zip(members, worse(usual), strict=True)
    ]


def attitude_spread(rays: NDArray, sigma_rad: NDArray) -> tuple[float, float]:
    """Errors of an unweighted least-squares attitude of (K, 3) rays, camera axes: rms across the boresight, and about
    it, rad. Covariance H^-1 sum(sigma^2 (I - b b^T)) H^-1 with H = sum(I - b b^T)."""
    projectors = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    inverse = np.linalg.inv(projectors.sum(axis=0))
    covariance = inverse @ np.tensordot(sigma_rad**2, projectors, axes=1) @ inverse
    return float(np.sqrt(covariance[0, 0] + covariance[1, 1])), float(np.sqrt(covariance[2, 2]))


def plate_spread(found: Found, sigma_px: NDArray, camera: Camera) -> tuple[float, float]:
    """The same of an unweighted least-squares plate, whose turn is that of the whole lattice.

    Shift and turn are linear in the plate's coefficients, whose covariance, one for x and one for y, is
    (A^T A)^-1 A^T diag(sigma^2) A (A^T A)^-1.
    """
    middle = np.array([(camera.width_px - 1) / 2, (camera.height_px - 1) / 2])

    def monomials(xy_px: NDArray) -> NDArray:
        x, y = ((xy_px - middle) / middle).T
        return np.column_stack([x**p * y ** (n - p) for n in range(found.order + 1) for p in range(n + 1)])

    inverse = np.linalg.pinv(monomials(found.xy_px))
    covariance = (inverse * sigma_px**2) @ inverse.T
    pixels = lattice(camera.width_px, camera.height_px)
    shift = monomials(pixels).mean(axis=0)
    arms = (pixels - middle) / np.sum((pixels - middle) ** 2)
    turns = arms.T @ monomials(pixels)
    cross_px, roll_rad = np.sqrt([2 * shift @ covariance @ shift, np.sum((turns @ covariance) * turns)])
    return float(cross_px / camera.focal_px), float(roll_rad)


def astrometry_net(name: str) -> Solve | None:
    """astrometry.net's own `solve-field`, lost in space but for the field's width to 5 %; None where it is not."""
    if not (shutil.which("solve-field") and list(Path("/usr/share/astrometry").glob("index-*"))):
        return None
    camera = load(name, "astrometry.net", 1).camera
    width_deg = float(np.degrees(onboard_model.calibration(camera).fov_rad))
    size_px, order = (camera.width_px, camera.height_px), TWEAK_ORDER[name]
    options = ["--overwrite", "--no-plots", "--no-verify", "--crpix-center", "--cpulimit", "30"]
    options += ["--scale-units", "degwidth", "--scale-low", f"{0.95 * width_deg}"]
    options += ["--scale-high", f"{1.05 * width_deg}", "--tweak-order", str(order)]
    options += ["--no-remove-lines", "--uniformize", "0"]  # what is written in Python needs more packages
    options += [
        part for kind in ("new-fits", "rdls", "match", "index-xyls") for part in (f"--{kind}", "none")
    ]

    def solve(path: Path, frame: Frame) -> Found | None:
        stem = path.with_suffix("")
        subprocess.run(["solve-field", *options, str(path)], capture_output=True, check=True, cwd=path.parent)
        if not stem.with_suffix(".solved").exists():
            return None
        matched = fits.getdata(stem.with_suffix(".corr"))
        direction = directions(fits.getheader(stem.with_suffix(".wcs")), lattice(*size_px))
        utc = fits.getheader(path)["DATE-OBS"]
        xy_px = np.column_stack([matched["field_x"], matched["field_y"]]) - 1  # FITS counts from 1
        left_px = xy_px + 1 - np.column_stack([matched["index_x"], matched["index_y"]])
        named = aberrated(unit_vectors(matched["index_ra"], matched["index_dec"]), utc)
        return Found(aberrated(direction, utc), order, xy_px, left_px, matched["FLUX"], named)

    return solve


def tetra3rs(name: str) -> Solve | None:
    """tetra3rs, told our calibration, with its own centroids, catalogue and aberration; None where it is not."""
    if importlib.util.find_spec("tetra3rs") is None:
        return None
    told = load(name, "tetra3rs", 1)
    camera, settings = onboard_model.believed_camera(told), tracker_settings.believed_settings(told)
    nothing = np.zeros(0)
    tracker = tetra3rs_tracker.Tetra3rs(
        adapter.set_up(told, camera, settings, Stars(nothing, nothing, nothing))
    )
    pixels = lattice(camera.width_px, camera.height_px) - tracker.middle_px

    def solve(path: Path, frame: Frame) -> Found | None:
        seen = tracker.extract(fits.getdata(path).astype(np.uint16), max_centroids=60, threads=1)
        answer = tracker.database.solve_from_centroids(
            seen.centroids, camera_model=tracker.camera, observer_velocity_km_s=tracker.velocity_km_s
        )
        if not answer:
            return None
        direction = unit_vectors(*answer.pixel_to_world(*np.ascontiguousarray(pixels.T)))
        return Found(direction, 0, *its_stars(tracker, seen.centroids, answer))

    return solve


def its_stars(
    tracker: tetra3rs_tracker.Tetra3rs, centroids: Sequence[Any], answer: Any
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """All of tetra3rs's centroids that are stars of its catalogue: the last four fields of Found.

    Its own matches, and its own `attitude_sigma_rad` with them, are those left after clipping, which takes an eighth
    of the stars, the worst, and three tenths of the variance with them.
    """
    radius_deg = 0.7 * tracker.camera.fov_deg
    listed = tracker.database.cone_search(answer.crval_ra_deg, answer.crval_dec_deg, radius_deg)
    places = np.array([(star.ra_deg, star.dec_deg) for star in listed if star.magnitude < DEEPEST_G])
    moved = unit_vectors(*places.T) + np.array(tracker.velocity_km_s) / (C_M_S / 1000)
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    there_px = np.nan_to_num(np.column_stack(answer.world_to_pixel(*radec_deg(moved))), nan=1e6)
    seen = np.array([(one.x, one.y, one.brightness) for one in centroids])
    apart_px, star = cKDTree(there_px).query(seen[:, :2])
    near = apart_px < STAR_PX
    (x, y, brightness), star = seen[near].T, star[near]
    xy_px = np.column_stack([x, y])
    return xy_px + tracker.middle_px, xy_px - there_px[star], brightness, moved[star]


ORACLES = {"tetra3rs": tetra3rs, "astrometry.net": astrometry_net}


def confront(name: str, who: str, oracle: Solve, frames: int, seed: int) -> list[Pair]:
    """Every frame that the oracle solves."""
    seen, told = [], load(name, who, frames)
    for frame, truth in photographs(told, seed):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "frame.fits"
            frame_files.write_fits(path, frame, truth, told)
            found = oracle(path, frame)
            if found:
                seen.append(sighting(frame, truth, fits.getheader(path), found))
    return agreements(seen, onboard_model.calibration(told.camera))


def squares(solved: Sequence[Agreement]) -> NDArray:
    """(2,) mean square of the error over what was predicted, across the boresight and about it: 1 if that is right."""
    ratio = [(one.cross_rad / one.sigma_cross_rad, one.roll_rad / one.sigma_roll_rad) for one in solved]
    return np.asarray(np.mean(np.square(ratio), axis=0))


def line(label: str, frames: int, solved: Sequence[Agreement]) -> str:
    """A row of the table: medians and worst in arcsec."""
    cross = np.array([one.cross_rad for one in solved]) / ARCSEC_RAD
    roll = np.abs([one.roll_rad for one in solved]) / ARCSEC_RAD
    over = squares(solved)
    return (
        f"{label:42s} {frames:6d} {len(solved):6d} {sum(one.within for one in solved):9d}"
        f" {np.median(cross):8.2f} {cross.max():8.2f} {np.median(roll):8.1f} {roll.max():8.1f}"
        f" {over[0]:7.2f} {over[1]:7.2f} {sum(one.wrong for one in solved):6d}"
    )


HEAD = (
    f"{'':42s} {'frames':>6s} {'solved':>6s} {'within 3x':>9s} {'cross':>8s} {'worst':>8s} {'roll':>8s}"
    f" {'worst':>8s} {'cross²':>7s} {'roll²':>7s} {'wrong':>6s}"
)

if __name__ == "__main__":
    count, first = (int(one) for one in (sys.argv[1:3] + ["200", "1"][len(sys.argv[1:3]) :]))
    print(HEAD)
    for scene_name in SCENES:
        for who, made in ORACLES.items():
            asked = made(scene_name)
            if asked is None:
                print(f"{who}: not installed")
                continue
            both = zip(*confront(scene_name, who, asked, count, first), strict=True)
            for what, pairs in zip(("its coordinates", "its stars"), both, strict=True):
                print(line(f"{who}, {scene_name}, {what}", count, pairs), flush=True)
