"""A folder of images that is followed while they are taken.

A file is read once its size and time of change have been the same at two looks in succession, since it may still be
written. An image that cannot be used is reported and read again when it changes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from skysim.core.errors import InputError
from skysim.experiments.dome_survey.folder.images import (
    ATTITUDES,
    SurveyImage,
    best_images,
    lights_of,
    read_attitudes,
)

POLL_S = 0.5  # between two looks at the folder

Stamp = tuple[int, int]  # size in bytes, time of the last change in ns


class News(NamedTuple):
    """What a look found: names of the files that were read, and an error for each that cannot be used."""

    read: list[str]
    complaints: list[InputError]


@dataclass
class WatchedFolder:
    """The images of a folder so far; `pictures` has their names, detections and attitudes, by name."""

    folder: Path
    camera: Camera
    settings: Settings
    _lights: dict[str, Centroids] = field(default_factory=dict)
    _attitudes: dict[str, Rotation] = field(default_factory=dict)
    _seen: dict[str, Stamp] = field(default_factory=dict)
    _done: dict[str, Stamp] = field(default_factory=dict)

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
        """Read the files that are complete and new. Raises InputError if there is no such folder."""
        news = News([], [])
        paths = best_images(self.folder)
        names = {path.name for path in paths}
        self._lights = {name: lights for name, lights in self._lights.items() if name in names}
        for path in [*paths, self.folder / ATTITUDES]:
            stamp = stamp_of(path)
            before = self._seen.get(path.name)
            if stamp is None:
                continue
            self._seen[path.name] = stamp
            if stamp != before or stamp == self._done.get(path.name):
                continue
            try:
                self._read(path)
            except InputError as error:
                news.complaints.append(error)
            else:
                news.read.append(path.name)
            self._done[path.name] = stamp
        return news

    def _read(self, path: Path) -> None:
        if path.name == ATTITUDES:
            self._attitudes = read_attitudes(path)
        else:
            self._lights.pop(path.name, None)
            self._lights[path.name] = lights_of(path, self.camera, self.settings)


def stamp_of(path: Path) -> Stamp | None:
    """Size and time of the last change of a file; None if there is none."""
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_size, about.st_mtime_ns
