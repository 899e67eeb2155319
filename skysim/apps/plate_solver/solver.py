"""Plate solver: right ascension, declination and roll of images from any camera, lost in space.

If the field of view is known (a camera file, an OpenCV calibration or `--fov`), one `StarTracker` solves the image.
Otherwise 2 to 100 degrees are split into N overlapping ranges of focal length, each searched by quads of stars
(`estimator.identification.star_quads`) with a tracker that fits the focal length within its range. The image's stars
are detected once; all trackers are tried with little effort before any is tried with more. A tracker has the brightest
stars of the catalog, as many as its narrowest field needs.

Every tracker is one more opportunity for a false match. With P the probability that the best match is due to chance,
it is accepted if P <= P_accept / N (Bonferroni), and if no solution elsewhere on the sky has a P less than 1000 times
as large (MARGIN_DEX). N includes the hypotheses about a picture (`picture.py`), each of which is solved.
"""

from __future__ import annotations

import functools
import math
import os
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import field, replace
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from estimator.catalog import catalog as star_catalog
from estimator.catalog import index_file
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids
from estimator.detection.classify import NO_STAR
from estimator.identification.chance import ACCEPT_LOG10_CHANCE
from estimator.identification.refusals import NO_MATCH
from estimator.trackers.pipeline import Clock, Report, Settings, detect_and_centroid
from estimator.trackers.search_models import QUAD_SEARCHES
from estimator.trackers.star_tracker import StarTracker
from skysim.core.errors import InputError, check_name, refusing
from skysim.core.paths import CATALOGS
from skysim.core.time import check_year
from skysim.core.types import Array, frozen

if TYPE_CHECKING:
    from skysim.scene.sections.camera import DetectorConfig


# Relative uncertainty of the focal length. An OpenCV chessboard calibration gives it to about 0.1 %.
CALIBRATED_UNCERTAINTY = 0.003
FOV_UNCERTAINTY = (
    0.055  # 5 % that --fov allows, plus 0.5 % for the definition of the field of view
)
FOV_LIMITS_DEG = 1.0, 120.0
CATALOG = CATALOGS / "gaia_v8.0.ecsv"
PHOTOGRAPH = Settings(reject=NO_STAR)  # text and trees are no stars
THREADS = min(os.cpu_count() or 1, 8)
DEFAULT_EPOCH_YR = 2020.0


Circle = tuple[float, float, float]  # right ascension, declination and radius, degrees
Solved = tuple[Attitude, StarTracker]  # an attitude and the tracker that found it, or refused

# Limits of the horizontal fields of view that are searched if the field is unknown, and the one that is tried first.
WIDEST_DEG = 100.0
NARROWEST_DEG = 2.0
TYPICAL_DEG = 22.0
MAX_UNCERTAINTY = 0.25  # greatest relative half-width of a range of focal lengths
MAX_WARP = 0.04  # greatest u sin^2 a, see `search_cameras`, with the angle a of the corner
OVERLAP = 0.01  # of neighboring ranges, as a fraction of the focal length
STARS = 300.0  # mean number of catalog stars in the narrowest field of a tracker
LEAST_STARS = (
    4.0  # mean number in the middle of a range below which the catalog is too shallow for it
)
DECISIVE_LOG10_CHANCE = (
    -10.0
)  # a solution below this ends the search without trying other fields of view
MARGIN_DEX = 3.0  # by which a solution must beat those with another attitude
SAME_ATTITUDE_RAD = math.radians(0.2)  # angle below which two solutions are the same


def search_cameras(width_px: int, height_px: int) -> list[tuple[Camera, float]]:
    """The cameras to try for an unknown field, each with its relative focal-length uncertainty.

    They are in the order from the typical field outward. A range is as wide as the codes of quads allow: a focal length
    wrong by the fraction u changes the code of stars at the angle a from the boresight by up to 2 u sin^2 a
    (`star_quads._code_gate`). In narrow fields this is negligible, and the lengths of an index's quads, in units of the
    field's height, limit the range.
    """
    out = []
    narrowest, tangent = (
        math.tan(math.radians(deg) / 2) for deg in (NARROWEST_DEG, WIDEST_DEG)
    )
    # Square of the half diagonal, in units of half the width
    diagonal2 = 1 + (height_px / width_px) ** 2
    while tangent > narrowest:  # tangent of the half field at the lower end of a range
        corner2 = diagonal2 * tangent**2
        uncertainty = min(MAX_UNCERTAINTY, MAX_WARP * (1 + corner2) / corner2)
        # A focal length f covers f (1 - u) to f (1 + u).
        tangent *= 1 - uncertainty
        camera = Camera.from_fov(width_px, height_px, 2 * math.atan(tangent))
        out.append((camera, uncertainty + OVERLAP))
        tangent /= 1 + uncertainty
    typical_rad = math.radians(TYPICAL_DEG)
    return sorted(out, key=lambda one: abs(math.log(one[0].fov_rad / typical_rad)))


class KnownCamera(NamedTuple):
    """A camera that is known by a scene, a camera file or an OpenCV calibration.

    Attributes
    ----------
    model
        Model of its pixels' directions
    uncertainty
        Relative uncertainty of its focal length
    detector
        Its detector; None if only a calibration is known
    dome
        Its scene if that has a dome
    """

    model: Camera
    uncertainty: float = CALIBRATED_UNCERTAINTY
    detector: DetectorConfig | None = None
    dome: Path | None = None


@frozen
class Solver:
    """Settings of the plate solver.

    Either a field of view is known to 5 %, or a camera exactly or by calibration; with neither,
    `search_cameras` are tried.

    Attributes
    ----------
    time_utc
        Time at which the images were taken; if it is None, `skysim solve` sets the date of each FITS
        header. Without any date the epoch is 2020, and stellar aberration (20") is left out because
        its direction depends on the season
    fov_uncertainty
        Relative uncertainty of the focal length that follows from fov_deg
    hypotheses
        Number of alternative readings of one picture that are solved in turn
    upper_half
        Whether the centroids are only of the upper half: the trackers' field then is that half,
        with quads of its height, and no star counts as missing in the lower half
    size_px
        Width and height of pictures of which only lists of lights are known
    near_deg
        Right ascension, declination and radius of a circle in which the image center is; None: the whole sky
    tracker_cache
        The trackers for the last image size and date, by camera and uncertainty
    """

    fov_deg: float | None
    camera: KnownCamera | None
    stars: star_catalog.StarCatalog
    settings: Settings
    time_utc: datetime | None = None
    fov_uncertainty: float = FOV_UNCERTAINTY
    hypotheses: int = 1
    upper_half: bool = False
    size_px: tuple[int, int] | None = None
    near_deg: Circle | None = None
    tracker_cache: dict[Any, dict[Any, StarTracker]] = field(
        default_factory=dict, compare=False, repr=False
    )

    @property
    def field_is_known(self) -> bool:
        """Whether a single tracker solves the image."""
        return bool(self.camera or self.fov_deg)

    def candidate_cameras(self, width_px: int, height_px: int) -> list[tuple[Camera, float]]:
        """Cameras to try for this image size, each with its relative focal-length uncertainty, the likeliest first."""
        if self.upper_half:
            whole = replace(self, upper_half=False).candidate_cameras(width_px, height_px)
            return [
                (replace(camera, height_px=height_px // 2), uncertainty)
                for camera, uncertainty in whole
            ]
        if self.camera:
            return [(self.camera.model, self.camera.uncertainty)]
        if self.fov_deg:
            camera = Camera.from_fov(width_px, height_px, math.radians(self.fov_deg))
            return [(camera, self.fov_uncertainty)]
        cameras = search_cameras(width_px, height_px)
        least_sr = 4 * math.pi * LEAST_STARS / len(self.stars)
        return [one for one in cameras if one[0].field_sr >= least_sr]

    def tried_fov_deg(self, width_px: int, height_px: int) -> tuple[float, float]:
        """Narrowest and widest horizontal field that is tried for this image size."""
        cameras = self.candidate_cameras(width_px, height_px)
        ends = [
            round(math.degrees(camera.zoomed(1 + change).fov_rad), 2)
            for camera, uncertainty in cameras
            for change in (uncertainty, -uncertainty)
        ]
        return min(ends), max(ends)

    def trackers(self, width_px: int, height_px: int) -> Iterator[StarTracker]:
        """Yield the trackers for an image of this size: one, or one per range of fields of view.

        Trackers are built when first needed and cached until an image of another size or date comes.
        """
        key = width_px, height_px, self.time_utc
        if key not in self.tracker_cache:
            self.tracker_cache.clear()  # keep the trackers of one image size and date only
        cached = self.tracker_cache.setdefault(key, {})
        for lens in self.candidate_cameras(width_px, height_px):
            if lens not in cached:
                cached[lens] = self.tracker(*lens)
            yield cached[lens]

    def tracker(self, camera: Camera, uncertainty: float) -> StarTracker:
        """A tracker with the brightest stars of the catalog, as many as its narrowest field needs.

        Their directions are those seen from the Earth at the solver's time, or those at the default epoch. With
        `near_deg` it has only those that a picture can show whose center is in the circle.
        """
        field_sr = camera.zoomed(1 + uncertainty).field_sr
        limit_mag = star_catalog.limit_for_density(self.stars, field_sr, STARS)
        stars = star_catalog.brighter_than(self.stars, limit_mag)
        if self.time_utc is None:
            vectors = star_catalog.at_epoch(stars, DEFAULT_EPOCH_YR)
        else:
            vectors = star_catalog.apparent(stars, star_catalog.on_earth(self.time_utc))
        if self.near_deg is not None:
            ra, dec, radius = np.radians(self.near_deg)
            reach = radius + camera.zoomed(1 - uncertainty).diagonal_rad / 2
            near = vectors @ star_catalog.from_angles(ra, dec) >= np.cos(min(reach, np.pi))
            stars = stars.take(near)
            vectors = vectors[near]
        searches = () if self.field_is_known else QUAD_SEARCHES
        return StarTracker(camera, stars, vectors, self.settings, uncertainty, searches)


def make_solver(
    fov_deg: float | None,
    camera_file: Path | None,
    time_utc: datetime | None = None,
    stages: Mapping[str, str] | None = None,
    catalog: str | None = None,
    size_px: tuple[int, int] | None = None,
    near_deg: Circle | None = None,
) -> Solver:
    """Build a Solver from user input. Raises InputError with one line.

    Parameters
    ----------
    stages
        Names of algorithms by stage: detector, centroider, identifier, solver; the tracker's defaults for the others
    catalog
        Name or file of a star catalog; the shipped one, CATALOG, if left out
    size_px, near_deg
        As in `Solver`
    """
    if near_deg is not None and not (abs(near_deg[1]) <= 90 and 0 < near_deg[2] <= 180):
        raise InputError(
            "solve.near_deg",
            near_deg,
            "a declination of -90 to 90 and a radius of 0 to 180 degrees",
        )
    low, high = FOV_LIMITS_DEG
    if fov_deg is not None and camera_file is not None:
        raise InputError("solve.fov_deg", "conflicts with a camera", "one of the two")
    if fov_deg is not None and not low <= fov_deg <= high:
        raise InputError(
            "solve.fov_deg",
            f"{fov_deg:g}",
            f"the horizontal field of view, {low:g} to {high:g} degrees",
        )
    time_utc, warning = validated_date(time_utc)
    if warning:
        raise InputError("solve.time_utc", warning)
    camera, settings = read_camera(camera_file) if camera_file else (None, PHOTOGRAPH)
    if stages:
        from skysim.tracking.factory import STAR_ALGORITHMS

        for stage, name in stages.items():
            check_name(f"solve.{stage}", stage, name, STAR_ALGORITHMS[stage])
        settings = replace(settings, **stages)  # type: ignore[arg-type]
    stars = read_catalog(catalog)
    return Solver(
        fov_deg, camera, stars, settings, time_utc, size_px=size_px, near_deg=near_deg
    )


@functools.lru_cache(maxsize=1)
def kept_solver(
    fov_deg: float | None,
    time_utc: datetime | None = None,
    stages: tuple[tuple[str, str], ...] = (),
) -> Solver:
    """The solver of `make_solver` with the shipped catalog, cached with its trackers for the next picture.

    Indexing the fields of view from 2 to 100 degrees takes longer than solving a picture.

    Parameters
    ----------
    stages
        Pairs of stage and algorithm
    """
    return make_solver(fov_deg, None, time_utc, dict(stages))


def read_camera(path: Path) -> tuple[KnownCamera, Settings]:
    """Read a scene (its file, or its name), a camera file or an OpenCV calibration.

    Returns
    -------
    camera
        The camera of the images
    settings
        Settings of its tracker: the defaults, with the detector's gain and saturation if known

    Raises
    ------
    InputError
        With one line.
    """
    from skysim.camera.detector import saturation_dn
    from skysim.scene import loader
    from skysim.scene import opencv_calibration as opencv
    from skysim.tracking.onboard_model import calibration

    if opencv.looks_like_calibration(path):
        lens = opencv.read(path)
        size_px = lens.width_px, lens.height_px
        camera = Camera(*size_px, lens.focal_px, lens.center_px, lens.distortion)
        return KnownCamera(camera), PHOTOGRAPH
    is_file = path.suffix or path.exists()  # else the name of a shipped scene
    file = path if is_file else loader.find(str(path))
    config = loader.load_camera(file)
    detector = config.detector
    settings = replace(
        PHOTOGRAPH, gain_e_dn=detector.gain_e_dn, saturation=saturation_dn(detector)
    )
    light = loader.read(file)[0].get("light")
    is_dome = isinstance(light, dict) and light.get("kind") == "dome"
    dome = path if is_dome else None
    return KnownCamera(calibration(config), 0.0, detector, dome), settings


def read_catalog(name: str | None) -> star_catalog.StarCatalog:
    """The catalog of the user: a name in data/catalogs/ or a file; the shipped one for None. Raises InputError."""
    if name is not None:
        from skysim.tracking.onboard_model import onboard_catalog

        return onboard_catalog("solve.catalog", name)
    with refusing(
        ImageError, "solve.catalog", allowed="a star catalog (.ecsv) built by skysim"
    ):
        return star_catalog.read(CATALOG)


def validated_date(date_utc: datetime | None) -> tuple[datetime | None, str]:
    """Return (date in UTC, ""), or (None, reason) for a date outside the supported range; (None, "") without a date."""
    try:
        return (check_year(date_utc) if date_utc else None), ""
    except InputError as error:
        return None, error.problem


def solve_array(
    image: Array,
    solver: Solver,
    centroids: Centroids | None = None,
    efforts: int | None = None,
) -> tuple[Report, StarTracker]:
    """Solve one monochrome image and return the report and the tracker that made it.

    Parameters
    ----------
    centroids
        Centroids of this image, if they are known
    efforts
        As in `solve_centroids`
    """
    height_px, width_px = image.shape
    first = next(solver.trackers(width_px, height_px))
    clock = Clock()
    if centroids is None:  # only the size of the camera is used
        centroids = detect_and_centroid(image, first.camera, solver.settings, clock)
    attitude, tracker = solve_centroids(
        centroids, solver, (width_px, height_px), clock, efforts
    )
    if attitude.camera:
        # Of a half, the camera of the whole picture.
        attitude = replace(attitude, camera=replace(attitude.camera, height_px=height_px))
    return Report(attitude, centroids, clock.seconds), tracker


def solve_centroids(
    centroids: Centroids,
    solver: Solver,
    size_px: tuple[int, int],
    clock: Clock,
    efforts: int | None = None,
) -> Solved:
    """Solve the centroids of an image of (width, height) with every tracker of the solver, as `solve_array`.

    Parameters
    ----------
    efforts
        Number of searches that are made, of growing effort; None: all of them
    """
    first = next(solver.trackers(*size_px))
    made = range(first.efforts)[:efforts]
    if solver.field_is_known:
        for effort in [None] if efforts is None else made:
            attitude = first.solve_centroids(centroids, clock, effort)
            if attitude.solved:
                break
        allowed = ACCEPT_LOG10_CHANCE - math.log10(solver.hypotheses)
        refused = attitude.solved and attitude.log10_chance > allowed
        return (Attitude(NO_MATCH) if refused else attitude), first
    tries = len(solver.candidate_cameras(*size_px)) * solver.hypotheses
    for effort in made:  # try all fields of view quickly before trying any thoroughly
        trackers = solver.trackers(*size_px)
        attitude, tracker = best_attitude(centroids, trackers, clock, effort, tries)
        if attitude.solved:
            break
    return attitude, tracker


def best_attitude(
    centroids: Centroids,
    trackers: Iterator[StarTracker],
    clock: Clock,
    effort: int,
    tries: int,
) -> Solved:
    """Return the most significant attitude among those of trackers with different fields of view, and its tracker.

    The accepted probability of chance is divided by the number of tries. The best attitude must also beat every
    different attitude by `margin_dex`; otherwise the result is NO_MATCH.
    """
    solutions: list[Solved] = []
    for attitude, tracker in attitudes(centroids, trackers, effort):
        clock.lap("identify")
        if attitude.log10_chance <= DECISIVE_LOG10_CHANCE:
            return attitude, tracker
        if attitude.solved:
            solutions.append((attitude, tracker))
    if not solutions:
        return attitude, tracker
    best, best_tracker = min(solutions, key=lambda solution: solution[0].log10_chance)
    # The same attitude from neighboring trackers, whose ranges overlap, is not a rival.
    assert best.cam_from_ref is not None
    to_best = best.cam_from_ref.inv()
    rivals = [
        other.log10_chance
        for other, _ in solutions
        if other.cam_from_ref
        and (other.cam_from_ref * to_best).magnitude() >= SAME_ATTITUDE_RAD
    ]
    threshold = ACCEPT_LOG10_CHANCE - math.log10(tries)  # Bonferroni correction
    significant = best.log10_chance <= min(threshold, min(rivals, default=0.0) - MARGIN_DEX)
    return (best if significant else Attitude(NO_MATCH)), best_tracker


def attitudes(
    centroids: Centroids, trackers: Iterator[StarTracker], effort: int
) -> Iterator[Solved]:
    """Yield the attitudes of trackers in their order. THREADS of them solve at once: compiled code holds no GIL."""
    pool = ThreadPoolExecutor(THREADS)
    begun = (
        (pool.submit(one.solve_centroids, centroids, None, effort), one) for one in trackers
    )
    try:
        running = deque(islice(begun, THREADS))
        while running:
            future, tracker = running.popleft()
            yield future.result(), tracker
            index_file.release()
            running.extend(islice(begun, 1))
    finally:
        pool.shutdown(cancel_futures=True)
