"""Frames of a survey from images on disk.

A folder has one image for each attitude, in the order of their names. It may have `attitudes.csv` with the IMU's
attitudes: columns file, roll_deg, pitch_deg, yaw_deg (the angles of `motion` in a scene). Images that are not in this
file are identified by the tracker with the list of LEDs, or with the survey of the other images.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Settings
from skysim.core import images
from skysim.core.errors import InputError
from skysim.core.files import atomic_file
from skysim.core.text import excerpt, read_named_rows
from skysim.core.types import Record
from skysim.experiments.dome_survey.survey_frames import (
    ANGLES,
    CalibrationPrior,
    SurveyFrame,
    detect_lights,
    from_angles,
    from_rows,
)
from skysim.results.telemetry_report import euler_deg

ATTITUDES = "attitudes.csv"
SOLVED = "solved_attitudes.csv"
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
        return FORMATS.index(suffix) if suffix in FORMATS else len(FORMATS)

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


def pixels_of(path: Path, camera: Camera) -> NDArray:
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
    with atomic_file(path) as temporary:
        lines = [",".join(map(str, row)) for row in rows]
        temporary.write_text("\n".join([*lines, ""]), encoding="utf-8")


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


@dataclass
class WatchedFolder:
    """The images of a folder so far; `pictures` has their names, detections and attitudes, ordered by name.

    A file is read when a look finds it as the look before did. `_seen` has its stamp, and whether it was read.
    """

    folder: Path
    camera: Camera
    settings: Settings
    _lights: dict[str, Centroids] = field(default_factory=dict)
    _attitudes: dict[str, Rotation] = field(default_factory=dict)
    _seen: dict[str, tuple[Stamp, bool]] = field(default_factory=dict)

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
        for path in [*paths, self.folder / ATTITUDES]:
            stamp = stamp_of(path)
            before, was_read = self._seen.get(path.name, (None, False))
            if stamp is None or (stamp == before and was_read):
                continue
            self._seen[path.name] = (stamp, stamp == before)
            if stamp != before:
                continue
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
