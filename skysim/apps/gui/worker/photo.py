"""Solves images that are not of the current scene: uploaded files, a live camera's frames, a study's trials."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.detection.detect import check_size
from skysim.apps import plate_solver
from skysim.apps.gui.messages import Answer, Light, Triple
from skysim.apps.gui.worker.workbench import answered, lights_of, magnitudes, named, prefix_of, spots_of
from skysim.core import images
from skysim.core.errors import InputError
from skysim.core.images import LiveCamera
from skysim.experiments.study import loader, store
from skysim.experiments.study.execution import replay
from skysim.experiments.study.setups import prepared_setup
from skysim.experiments.study.store import STORE
from skysim.experiments.study.trials import one
from skysim.results import scoring, stretch

SUFFIXES = (".fits", ".fit", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


@dataclass(frozen=True, slots=True)
class Photo:
    """An image that is not of the current scene, and its solution; size_px is the image's, jpeg what the page shows.

    names, true_deg : of its three angles, and their true values if known
    lights, prefix : true lights of a study's trial, and the catalog of the lights' numbers (HIP or LED)
    """

    size_px: tuple[int, int]
    answer: Answer
    solution: dict[str, Any]
    facts: stretch.Facts
    jpeg: bytes = b""
    names: tuple[str, str, str] = ("RA", "Dec", "roll")
    true_deg: Triple | None = None
    lights: tuple[Light, ...] = ()
    prefix: str = "HIP"


Seen = tuple[Photo, NDArray]  # with the image's pixels


def of_file(name: str, data: bytes, fov_deg: float | None, stages: dict[str, str]) -> Seen:
    """Solve an uploaded file. Raises InputError if it is no readable image."""
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{Path(name).name}: allowed: {', '.join(SUFFIXES)}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"upload{suffix}"
        path.write_bytes(data)
        try:
            image, (taken, _) = (
                images.monochrome(images.read_image(path)),
                plate_solver.believable(images.date_of(path)),
            )
        except InputError as error:
            raise InputError(str(error).replace(str(path), Path(name).name)) from None
    return solved(image, fov_deg, stages, taken)


def of_camera(camera: LiveCamera, fov_deg: float | None, stages: dict[str, str]) -> Seen:
    """Solve the next frame of a live camera. Raises InputError."""
    return solved(images.monochrome(camera.frame()), fov_deg, stages, None)


def of_trial(study: str, folder: Path, trial: int) -> Seen:
    """Repeat a study's trial: its first frame with the tracker's solution."""
    planned = loader.load(study)
    with store.open_store(folder / STORE) as kept:
        segment = replay.segment_of(planned, kept, trial)
    row = one(planned.recipe, segment, trial, segment.replicates[0])
    ready = prepared_setup(planned.recipe, segment.settings)
    frame, truth, report = next(replay.seen(ready, row.seed))
    answer = answered(ready.lab, ready.estimator, report, truth)
    if row.error:
        answer = Answer(row.error.strip().splitlines()[-1], answer.spots, answer.ms)
    scene, (height, width) = ready.lab.scene, frame.image_dn.shape
    told = Photo(
        (width, height),
        answer,
        {},
        stretch.facts(frame.image_dn, frame.saturation_dn),
        names=scoring.angle_names(scene),
        true_deg=scoring.angles_deg(truth.cam_from_lab, scene, ready.lab.mount),
        lights=lights_of(truth, magnitudes(ready.lab)),
        prefix=prefix_of(ready.lab),
    )
    return told, frame.image_dn


def solved(image: NDArray, fov_deg: float | None, stages: dict[str, str], taken: Any) -> Seen:
    """Solve an image; the result's status says why if there is no solution. taken : UTC, if known."""
    check_size(image)
    how = plate_solver.make_solver(fov_deg, None, stages=stages)
    found, tracker = plate_solver.look(image, how, taken)
    told = found.attitude
    spots = spots_of(found, named(tracker, told, found.centroids.xy_px))
    solution = plate_solver.solution(found) if told.solved else {}
    angles: Triple | None = (
        (solution["ra_deg"], solution["dec_deg"], solution["roll_deg"]) if solution else None
    )
    answer = Answer(told.status, spots, 1e3 * sum(found.seconds.values()), angles)
    height, width = image.shape
    full = float(np.iinfo(image.dtype).max) if image.dtype.kind == "u" else math.inf
    return Photo((width, height), answer, solution, stretch.facts(image, full)), image
