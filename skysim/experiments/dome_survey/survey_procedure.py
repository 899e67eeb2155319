"""The procedure of a survey: its plan with predicted errors, its images, its simulation, and their comparison.

A folder has one image for each attitude, in the order of their names. It may have `attitudes.csv` with the IMU's
attitudes: columns file, roll_deg, pitch_deg, yaw_deg (the angles of `motion` in a scene). Images that are not in this
file are identified by the tracker with the list of LEDs, or with the survey of the other images.
"""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.calibration.survey_plan import SurveyAccuracy, SurveyModel, measurable
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Settings
from skysim.core import files, images
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.text import excerpt, read_named_rows
from skysim.core.types import Array, Bools, Record
from skysim.experiments.dome_survey.adjust import run_survey
from skysim.experiments.dome_survey.survey_findings import (
    SurveyRun,
    accuracy_statistics,
    fault_rows,
    find_faults,
    predicted,
)
from skysim.experiments.dome_survey.survey_frames import (
    ANGLES,
    CANDIDATES,
    STREAM_KEYS,
    CalibrationPrior,
    SurveyFrame,
    SurveyUncertainty,
    calibration_prior,
    centroid_noise_px,
    detect_lights,
    from_angles,
    from_rows,
    imu_attitudes,
    planned_stops,
    stop_attitudes,
    survey_model,
    take_frames,
    with_survey_errors,
)
from skysim.experiments.dome_survey.survey_report import led_errors
from skysim.results.files import recording
from skysim.results.telemetry_report import euler_deg
from skysim.scene.scene import Scene
from skysim.simulation.flight import Progress
from skysim.simulation.lab import Lab, build_lab

ATTITUDES = "attitudes.csv"
FRAME = "frame_{:04d}.fits"
COLUMNS = ("file", *ANGLES)
NO_COLUMNS: Mapping[str, Sequence[object]] = {}
MIN_IMAGES = 3
# Of several images with the same name, the first format of this list is read.
FORMATS = (".fits", ".fit", ".fits.gz", ".tif", ".tiff", ".png")


class SurveyImage(NamedTuple):
    """An image of a survey: its name, its detections, and the IMU's lab_from_body, None if there is none."""

    name: str
    lights: Centroids
    lab_from_body: Rotation | None


def image_files(folder: Path) -> list[Path]:
    """The images of a folder by name, one of each stem. Raises InputError for too few, or no folder."""
    paths = best_images(folder)
    if len(paths) < MIN_IMAGES:
        raise InputError(
            folder, f"{len(paths)} images", f"{MIN_IMAGES} or more, typically tens"
        )
    return paths


def frame_names(count: int) -> list[str]:
    """The names of the images of a plan or a simulation."""
    return [FRAME.format(n) for n in range(count)]


def best_images(folder: Path) -> list[Path]:
    """The images of a folder by name; of one stem, that of the first of FORMATS. Raises InputError for no folder."""

    def rank(path: Path) -> int:
        suffix = images.image_suffix(path.name)
        return (*FORMATS, suffix).index(suffix)  # others are the last

    return [path for _, path in sorted(images.best_images(folder, rank).items())]


def read_images(folder: Path, camera: Camera, settings: Settings) -> Iterator[SurveyImage]:
    """The images of a folder with their detections. Raises InputError for an image that cannot be used."""
    paths = image_files(folder)
    attitudes = read_attitudes(folder / ATTITUDES) if (folder / ATTITUDES).exists() else {}
    names = {path.name for path in paths}
    for name in attitudes:
        if name not in names:
            raise InputError(folder / ATTITUDES, f"{excerpt(name)} is no image of the folder")
    for path in paths:
        yield SurveyImage(
            path.name, lights_of(path, camera, settings), attitudes.get(path.name)
        )


def lights_of(path: Path, camera: Camera, settings: Settings) -> Centroids:
    """The detections of an image. Raises InputError if it cannot be used."""
    return detect_lights(settings, camera, pixels_of(path, camera))


def pixels_of(path: Path, camera: Camera) -> Array:
    """The pixels of an image of the camera, the highest row first. Raises InputError for another size."""
    pixels = images.as_light(images.read_ordered(path)).pixels
    images.check_size(path, pixels, (camera.height_px, camera.width_px))
    return pixels


def read_attitudes(path: Path) -> dict[str, Rotation]:
    """lab_from_body of each image by its name, from a CSV file. Raises InputError with one line."""
    refusal = InputError(
        path, "no attitudes", f"columns {', '.join(COLUMNS)}, and others, which are not used"
    )
    files, numbers = read_named_rows(path, COLUMNS[0], ANGLES, refusal)
    return dict(zip(files, from_angles(numbers), strict=True))


def write_attitudes(
    path: Path,
    names: Sequence[str],
    lab_from_body: Rotation,
    more: Mapping[str, Sequence[object]] = NO_COLUMNS,
) -> None:
    """Write attitudes as `read_attitudes` reads them; `more` are further columns."""
    angles = ([f"{angle:.4f}" for angle in column] for column in euler_deg(lab_from_body).T)
    columns = {**dict(zip(COLUMNS, (names, *angles), strict=True)), **more}
    rows = (columns, *zip(*columns.values(), strict=True))
    files.write_text(path, "".join(f"{','.join(map(str, row))}\n" for row in rows))


def write_solved(path: Path, rows: Sequence[Record]) -> None:
    """Write the attitudes of `survey_findings.attitude_rows` that are solved, with the upper half of the covariance."""
    solved = [row for row in rows if row["status"] == "solved"]
    more: dict[str, list[float]] = {"leds": [row["matches"] for row in solved]}
    for n, axis in enumerate("xyzw"):
        more[f"cam_from_lab_{axis}"] = [row["cam_from_lab_xyzw"][n] for row in solved]
    for i, j in zip(*np.triu_indices(3), strict=True):
        name = f"covariance_{'xyz'[i]}{'xyz'[j]}_rad2"
        more[name] = [row["covariance_rad2"][i][j] for row in solved]
    names = [row["file"] for row in solved]
    write_attitudes(path, names, from_rows(solved), more)


def frames_with_attitude(
    pictures: Sequence[SurveyImage],
    model: CalibrationPrior,
    settings: Settings,
) -> list[SurveyFrame]:
    """The images whose attitude is known, or is found by the tracker with this model, lost in space."""
    tracker: DomeTracker | None = None
    out = []
    for index, picture in enumerate(pictures):
        attitude = picture.lab_from_body
        if attitude is None:
            tracker = tracker or lost_in_space(model, settings)
            cam_from_lab = tracker.solve_centroids(picture.lights).cam_from_ref
            if cam_from_lab is None:
                continue
            attitude = cam_from_lab.inv() * model.lever.cam_from_body
        out.append(SurveyFrame(picture.lights, attitude.inv(), index))
    return out


def lost_in_space(model: CalibrationPrior, settings: Settings) -> DomeTracker:
    """A tracker with the uncertainty of the model. Raises InputError for LEDs that it cannot use."""
    uncertainty = model.uncertainty
    camera = replace(model.camera, focal_sigma=uncertainty.focal_error)
    leds: LedMap = replace(
        model.leds,
        sigma_m=uncertainty.led_sigma_m,
        covariance_m2=None,
        common_m=None,
        common_camera=None,
    )
    lever = replace(model.lever, sigma_m=uncertainty.lever_sigma_m)
    return dome_tracker(camera, leds, lever, settings)


def dome_tracker(
    camera: Camera, leds: LedMap, lever: Lever, settings: Settings
) -> DomeTracker:
    """A `DomeTracker`. Raises InputError for LEDs that it cannot use."""
    try:
        return DomeTracker(camera, leds, lever, settings)
    except ImageError as error:
        raise InputError("light", f"the star tracker cannot use this dome: {error}") from None


# A folder of images that is followed while they are taken.


POLL_S = 0.5  # time between two looks at the folder

Stamp = tuple[int, int]  # size in bytes, time of the last change in ns


class News(NamedTuple):
    """Result of a look at the folder: names of files that were read, and an error for each that cannot be used."""

    read: list[str]
    complaints: list[InputError]


class CompleteFiles:
    """Files that are written while they are watched: one is complete when a look finds it as the look before did.

    Attributes
    ----------
    seen
        Stamp of each file, and whether it was returned
    """

    def __init__(self) -> None:
        self.seen: dict[Path, tuple[Stamp, bool]] = {}

    def new(self, paths: Sequence[Path]) -> list[Path]:
        """Those that are complete now, and have not been returned as they are."""
        found = []
        for path in paths:
            stamp = stamp_of(path)
            before, was_read = self.seen.get(path, (None, False))
            if stamp is None or (stamp == before and was_read):
                continue
            self.seen[path] = (stamp, stamp == before)
            if stamp == before:
                found.append(path)
        return found


@dataclass
class WatchedFolder:
    """The images of a folder so far; `pictures` has their names, detections and attitudes, ordered by name."""

    folder: Path
    camera: Camera
    settings: Settings
    _lights: dict[str, Centroids] = field(default_factory=dict)
    _attitudes: dict[str, Rotation] = field(default_factory=dict)
    _files: CompleteFiles = field(default_factory=CompleteFiles)

    @property
    def pictures(self) -> list[SurveyImage]:
        """The images that were read."""
        return [
            SurveyImage(name, self._lights[name], self._attitudes.get(name))
            for name in sorted(self._lights)
        ]

    def arrivals(self, count: int, poll_s: float = POLL_S) -> Iterator[News]:
        """Yield after every look that finds something new, until `count` images are read."""
        while True:
            news = self.look()
            if news.read or news.complaints:
                yield news
            if len(self._lights) >= count:
                return
            time.sleep(poll_s)

    def look(self) -> News:
        """Read the new files that are complete. Raises InputError if there is no such folder."""
        news = News([], [])
        paths = best_images(self.folder)
        names = {path.name for path in paths}
        self._lights = {
            name: lights for name, lights in self._lights.items() if name in names
        }
        for path in self._files.new([*paths, self.folder / ATTITUDES]):
            try:
                if path.name == ATTITUDES:
                    self._attitudes = read_attitudes(path)
                else:
                    self._lights.pop(path.name, None)
                    self._lights[path.name] = lights_of(path, self.camera, self.settings)
            except InputError as error:
                news.complaints.append(error)
            else:
                news.read.append(path.name)
        return news


def stamp_of(path: Path) -> Stamp | None:
    """Size and time of the last change of a file; None if there is none."""
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_size, about.st_mtime_ns


# The plan of a survey with predicted errors, its simulation, and their comparison.


PLANNED = "plan"
RANDOM = "random"
DRAWS = 100  # number of domes in which the LEDs that a plan measures are counted


class HeldAttitudes(NamedTuple):
    """Attitudes to hold, one frame at each.

    Attributes
    ----------
    shown
        (F, N) mask of the LEDs that each shows
    margin_px
        Margin of the chip in which an image would be incomplete
    in_reach
        (N,) whether any attitude within the tilt shows each LED
    """

    lab_from_body: Rotation
    shown: Bools
    model: SurveyModel
    margin_px: float
    in_reach: Bools

    def first(self, count: int) -> SurveyAccuracy:
        """The accuracy predicted after the first `count` frames."""
        return predicted(self.model, self.lab_from_body[:count].inv(), self.shown[:count])

    def counts(self, count: int) -> Record:
        """The number of LEDs that the first `count` frames measure if the dome differs from the model by its sigmas.

        Mean and 95 % interval over DRAWS domes. The attitudes show more of the model's LEDs than of theirs, because
        they were chosen for it.
        """
        model = self.model
        held = self.lab_from_body[:count].inv()
        rng = random_stream(0, STREAM_KEYS["domes"])
        found = []
        for _ in range(DRAWS):
            focal, *lever = rng.standard_normal(4)
            own_m = rng.standard_normal(model.leds.position_m.shape) * model.leds_sigma_m
            leds_m = model.leds.position_m + own_m
            lever_m = model.lever.camera_body_m + np.array(lever) * model.lever_sigma_m
            zoom = 1 + focal * model.focal_sigma_px / model.camera.focal_px
            other = replace(
                model,
                camera=model.camera.zoomed(zoom),
                leds=replace(model.leds, position_m=leds_m),
                lever=replace(model.lever, camera_body_m=lever_m),
            )
            shown = other.visible(held, self.margin_px)
            found.append(int(measurable(other, held, shown).sum()))
        return {
            "measured": round(np.mean(found)),
            "measured_range": [round(end) for end in np.quantile(found, [0.025, 0.975])],
        }

    def steps(self) -> list[tuple[int, SurveyAccuracy]]:
        """The accuracy predicted after a quarter, a half, three quarters and all of the frames."""
        total = len(self.lab_from_body)
        counts = sorted({max(round(total * part / 4), 2) for part in range(1, 5)})
        return [(count, self.first(count)) for count in counts]


def plan_survey(
    scene: Scene,
    uncertainty: SurveyUncertainty,
    count: int,
    tilt_deg: float,
    kind: str = PLANNED,
) -> tuple[Lab, CalibrationPrior, HeldAttitudes]:
    """The lab whose onboard model has errors as before a survey, that model, and the attitudes: planned, or random.

    Raises
    ------
    InputError
        For a tilt beyond the vehicle's stop.
    """
    lab = build_lab(with_survey_errors(scene, uncertainty))
    prior = calibration_prior(lab)._replace(uncertainty=uncertainty)
    random = stop_attitudes(lab.scene, "attitudes", count, tilt_deg)
    model = survey_model(prior, centroid_noise_px(lab, tilt_deg))
    margin_px = prior.margin_px
    held = (
        random
        if kind == RANDOM
        else planned_stops(lab.scene, model, margin_px, count, tilt_deg)
    )
    shown = model.visible(held.inv(), margin_px)
    anywhere = stop_attitudes(lab.scene, "candidates", CANDIDATES, tilt_deg)
    in_reach = np.asarray(model.visible(anywhere.inv(), margin_px).any(axis=0))
    return lab, prior, HeldAttitudes(held, shown, model, margin_px, in_reach)


def write_plan(path: Path, plan: HeldAttitudes) -> None:
    """Write the attitudes as CSV with the names of the images to take, as `attitudes.csv` has them."""
    leds = plan.shown.sum(axis=1).tolist()
    write_attitudes(path, frame_names(len(leds)), plan.lab_from_body, {"leds": leds})


def simulated_frames(
    lab: Lab,
    uncertainty: SurveyUncertainty,
    lab_from_body: Rotation,
    folder: Path | None = None,
) -> Iterator[SurveyFrame]:
    """The frames of a simulated survey, which are also written to a folder as FITS with the IMU's attitudes."""
    measured = imu_attitudes(lab.scene, lab_from_body, uncertainty.imu_sigma_rad)
    if folder is not None:
        names = frame_names(len(lab_from_body))
        write_attitudes(files.make_folder(folder) / ATTITUDES, names, measured.inv())
    for (frame, truth, lights), body_from_lab in zip(
        take_frames(lab, lab_from_body), measured, strict=True
    ):
        if folder is not None:
            recording.write_fits(folder / FRAME.format(frame.index), frame, truth, lab.scene)
        yield SurveyFrame(lights, body_from_lab, frame.index)


def survey_images(
    pictures: Sequence[SurveyImage],
    frames: list[SurveyFrame],
    prior: CalibrationPrior,
    settings: Settings,
    watch: Progress | None,
) -> SurveyRun:
    """Survey from images. `frames` are those with an attitude; the others are identified with the LEDs so far.

    Raises
    ------
    InputError
        If too few images have an attitude, or they do not determine the unknowns.
    """
    if len(frames) < 2:
        raise InputError(
            "survey",
            f"{len(frames)} of {len(pictures)} images identified",
            f"2 or more: give their attitudes in {ATTITUDES}",
        )
    run = run_survey(frames, prior, watch)
    while len(frames) < len(pictures):
        found = run.found
        measured = found.uncertainty._replace(led_sigma_m=run.accuracy.led_rms_m)
        model = found._replace(leds=run.survey.surveyed_leds, uncertainty=measured)
        known = {frame.index: frame.body_from_lab.inv() for frame in frames}
        named = [
            picture._replace(lab_from_body=known.get(n)) for n, picture in enumerate(pictures)
        ]
        more = frames_with_attitude(named, model, settings)
        if len(more) == len(frames):
            break
        frames = more
        run = run_survey(frames, prior, watch)
    return run


# Comparison of the prediction with simulated surveys.


class SimulatedErrors(NamedTuple):
    """Errors of one simulated survey: mean squares of coordinates of LEDs and lever (m2) and of the focal length (px2).

    Also the number of measured LEDs, and of faults reported although the dome has none.
    """

    led_m2: float
    lever_m2: float
    focal_px2: float
    measured: int
    false_alarms: int


def repeat_survey(
    lab: Lab, uncertainty: SurveyUncertainty, plan: HeldAttitudes, repeats: int
) -> Iterator[SimulatedErrors | InputError]:
    """The errors of simulated surveys at the attitudes of a plan, each with its own noise, IMU errors and list.

    For a survey that does not determine the dome, the InputError that says why.
    """
    for n in range(repeats):
        again = in_survey(lab, n)
        prior = calibration_prior(again)._replace(uncertainty=uncertainty)
        frames = list(simulated_frames(again, uncertainty, plan.lab_from_body))
        try:
            yield survey_errors(run_survey(frames, prior), prior, again)
        except InputError as error:
            yield error


def in_survey(lab: Lab, n: int) -> Lab:
    """The lab of another survey: with other noise, and other errors of list, lever and IMU."""
    scene = lab.scene
    again = lab.in_run(scene.seed + n)
    return replace(
        again,
        scene=again.scene.with_values("tracker.survey", seed=scene.tracker.survey.seed + n),
    )


def survey_errors(run: SurveyRun, prior: CalibrationPrior, lab: Lab) -> SimulatedErrors:
    """The errors of one survey against the truth."""
    survey = run.survey
    lever_m = survey.lever.camera_body_m - lab.camera.mount.camera_body_m
    return SimulatedErrors(
        float(np.mean(led_errors(survey, prior, lab).after_m ** 2)),
        float(np.mean(lever_m**2)),
        (survey.camera.focal_px - lab.scene.camera.focal_px) ** 2,
        int(survey.surveyed.sum()),
        len([*fault_rows(find_faults(run))]),
    )


def comparison(plan: HeldAttitudes, errors: list[SimulatedErrors]) -> list[Record]:
    """Rows with predicted errors, simulated errors (rms over all surveys), and their ratio with its standard error."""
    accuracy = accuracy_statistics(plan.first(len(plan.lab_from_body)))
    led_m2, lever_m2, focal_px2, *_ = np.array(errors).T
    rows = []
    for what, key, squares in (
        ("LED place mm", "led_mm", 1e6 * led_m2),
        ("lever mm", "lever_mm", 1e6 * lever_m2),
        ("focal length px", "focal_px", focal_px2),
    ):
        mean = float(squares.mean())
        sigma = accuracy[key]
        ratio = math.sqrt(mean) / sigma if sigma else None
        # The relative error of the root of a mean square.
        relative = float(squares.std() / (2 * mean * np.sqrt(len(squares))))
        rows.append(
            {
                "what": what,
                "predicted": sigma,
                "simulated": math.sqrt(mean),
                "ratio": ratio,
                "ratio_sigma": ratio and ratio * relative,
            }
        )
    return rows
