"""Pictures of the user's own, from a file or a live camera, solved and shown, or refused with the reason."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.detect import check_size
from skysim import greys, io, solve
from skysim.lab.desk import named, spots_of
from skysim.lab.views import Answer, Triple
from skysim.study import plan, replay, store
from skysim.study.benches import bench
from skysim.study.commands import STORE
from skysim.study.trials import one
from skysim.types import BadInput

SUFFIXES = (".fits", ".fit", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
WIDEST_PX = 1400  # as the browser gets it


@dataclass(frozen=True, slots=True)
class Photo:
    """A picture of the user's, as the page shows it; size_px is the picture's own."""

    jpeg: bytes
    size_px: tuple[int, int]
    answer: Answer
    facts: dict[str, Any]


def of_file(name: str, data: bytes, fov_deg: float | None, stages: dict[str, str]) -> Photo:
    """An uploaded file, solved. Raises BadInput for what cannot be an image."""
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise BadInput(f"{Path(name).name}: allowed: {', '.join(SUFFIXES)}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"upload{suffix}"
        path.write_bytes(data)
        try:
            image, taken = io.monochrome(io.read_image(path)), io.date_of(path)
        except BadInput as error:
            raise BadInput(str(error).replace(str(path), Path(name).name)) from None
    return solved(image, fov_deg, stages, taken)


def of_camera(source: str, fov_deg: float | None, stages: dict[str, str]) -> Photo:
    """One frame of a live camera. Raises BadInput."""
    return solved(io.monochrome(io.grab(source)), fov_deg, stages, None)


def of_trial(study: str, folder: Path, trial: int) -> Photo:
    """The frame of a study's trial, done again, with what the tracker made of it."""
    told = plan.load(study)
    with store.open_store(folder / STORE) as kept:
        segment = replay.segment_of(told, kept, trial)
    row = one(told.recipe, segment, trial, segment.replicates[0])
    ready = bench(told.recipe, segment.settings)
    frame, _, report = next(replay.seen(ready, row.seed))
    spots = spots_of(report, named(ready.estimator, report.attitude, report.centroids.xy_px))
    answer = Answer(row.error.strip().splitlines()[-1] if row.error else report.attitude.status, spots, 0.0)
    grey = greys.stretched(frame.image_dn, "square root")
    return Photo(greys.jpeg(grey), (grey.shape[1], grey.shape[0]), answer, {})


def solved(image: NDArray, fov_deg: float | None, stages: dict[str, str], taken: Any) -> Photo:
    """The answer to a picture, or why there is none."""
    check_size(image)
    how = solve.make_solver(fov_deg, None, stages=stages)
    found, tracker = solve.look(image, how, taken)
    told = found.attitude
    spots = spots_of(found, named(tracker, told, found.centroids.xy_px))
    facts = solve.solution(found) if told.solved else {}
    angles: Triple | None = (facts["ra_deg"], facts["dec_deg"], facts["roll_deg"]) if facts else None
    answer = Answer(told.status, spots, 1e3 * sum(found.seconds.values()), angles)
    grey = greys.stretched(image, "square root")
    height, width = grey.shape
    if width > WIDEST_PX:
        grey = cv2.resize(grey, (WIDEST_PX, round(height * WIDEST_PX / width)), interpolation=cv2.INTER_AREA)
    return Photo(greys.jpeg(np.asarray(grey, np.uint8)), (width, height), answer, facts)
