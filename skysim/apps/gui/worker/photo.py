"""Images that are not of the current scene: uploaded files, a live camera's frames, a study's trials; and export.

The image on the page is exported as files: frame, truth, solution, scene.
"""

import math
import shlex
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, field, replace
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import yaml
from astropy.io import fits
from numpy.typing import NDArray

from estimator.detection.detect import check_size
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.apps import plate_solver
from skysim.apps.gui.messages import (
    NO_LIGHTS,
    NO_PIXELS,
    FrameView,
    Lens,
    Lights,
    Pixels,
    Pose,
    TrackerResult,
    Triple,
    places_px,
)
from skysim.apps.gui.worker import geometry as lenses
from skysim.apps.gui.worker import workbench
from skysim.apps.gui.worker.workbench import Workbench
from skysim.core import files as file_io
from skysim.core import images
from skysim.core.errors import InputError
from skysim.core.images import TOP_DOWN_CARD
from skysim.core.paths import PAPERS, SCENES
from skysim.core.types import Record, frozen
from skysim.core.yaml_reader import VERSION, set_key
from skysim.experiments.study import study_file
from skysim.experiments.study.execution import runner, store, trials
from skysim.results import plots, scoring
from skysim.results.files import recording
from skysim.results.plots import annotate
from skysim.results.scoring import FrameRow
from skysim.scene.loader import find


@frozen
class Photo:
    """An image that is not of the current scene, and its solution.

    Attributes
    ----------
    pixels, saturation_dn, pose
        As in `FrameView`
    lens
        Lens for the pose; both are None if the image was not solved
    names, angles_deg
        Names of the three angles, and their true values if known
    lights, prefix
        True lights of a study's trial, and the catalog of the lights' numbers (HIP or LED)
    hint
        Likely cause of a refusal, or assumption about a solved file
    name
        Name of the file, or of the camera
    compared
        Whether `angles_deg` are those of the simulation, which is compared with a real camera
    """

    result: TrackerResult
    solution: Record
    statistics: plots.FrameStatistics
    pixels: Pixels = NO_PIXELS
    saturation_dn: float = math.inf
    lens: Lens | None = None
    pose: Pose | None = None
    names: tuple[str, str, str] = ("RA", "Dec", "roll")
    angles_deg: Triple | None = None
    lights: Lights = field(default_factory=lambda: NO_LIGHTS)
    prefix: str = "HIP"
    hint: str = ""
    name: str = "camera"
    compared: bool = False


UNKNOWN = (math.nan,) * 3
PhotoPixels = tuple[Photo, NDArray]  # a photo and the image's pixels
# Suffixes of image files as a browser's file dialog takes them: ".gz" for ".fits.gz".
SUFFIXES = tuple(
    dict.fromkeys("." + suffix.rpartition(".")[2] for suffix in images.IMAGE_SUFFIXES)
)


Stages = tuple[tuple[str, str], ...]  # chosen algorithms: pairs of stage and name


def photo_from_file(
    name: str, data: bytes, fov_deg: float | None, stages: Stages = ()
) -> PhotoPixels:
    """Solve an uploaded file in its viewing orientation. Raises InputError if it is not a readable image."""
    suffix = images.image_suffix(name)
    if not suffix:
        raise InputError(Path(name).name, "", ", ".join(images.IMAGE_SUFFIXES))
    solver = plate_solver.kept_solver(fov_deg, stages=stages)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"upload{suffix}"
        path.write_bytes(data)
        try:
            picture = plate_solver.load_picture(path)
        except InputError as error:
            raise InputError(Path(name).name, error.problem, error.allowed) from None
    date_utc, _ = plate_solver.validated_date(picture.date_utc)
    outcome = plate_solver.solve_picture(picture, replace(solver, time_utc=date_utc))
    hint = plate_solver.outcome_fields(outcome)["hint"]
    photo, image = solved_photo(outcome.hypothesis.pixels, outcome.report, outcome.tracker)
    return replace(photo, hint=hint), image


def photo_from_trial(study: str, folder: Path, trial: int) -> PhotoPixels:
    """Repeat a study's trial: its first frame with the tracker's solution."""
    plan = study_file.load(study)
    with store.open_store(folder / store.STORE) as stored:
        segment = runner.segment_of(plan, stored, trial)
    (row,) = trials.run_block(plan.spec, segment)
    setup = trials.prepared_setup(plan.spec, segment.settings)
    lab = setup.lab
    frame, truth, report = runner.replayed_frame(setup, row.seed)
    lens = lenses.scene_lens(lab)
    bench = Workbench(lab.scene, lab, setup.estimator, lab.start, lens, {}, lab)
    bench.magnitude = workbench.magnitude_by_id(lab)
    photo = scene_photo(bench, bench.frame_view(frame, truth, report, 0.0))
    if row.error:
        status = row.error.strip().splitlines()[-1]
        failed = replace(photo.result.row, status=status, estimate_deg=None)
        photo = replace(photo, result=replace(photo.result, row=failed))
    return photo, frame.image_dn


def scene_photo(bench: Workbench, view: FrameView) -> Photo:
    """A solved frame of a scene as an image that is not of the current scene."""
    assert view.result is not None
    return Photo(
        view.result,
        {},
        view.statistics,
        saturation_dn=view.saturation_dn,
        lens=bench.lens,
        pose=view.pose,
        names=scoring.angle_names(bench.scene),
        angles_deg=view.angles_deg,
        lights=view.lights,
        prefix=workbench.id_prefix(bench.lab),
    )


def solve_frame(image: NDArray, fov_deg: float | None, stages: Stages = ()) -> PhotoPixels:
    """Solve a frame of a live camera; without a solution, the status of the result is the reason."""
    check_size(image)
    return solved_photo(
        image,
        *plate_solver.solve_array(image, plate_solver.kept_solver(fov_deg, stages=stages)),
    )


def solved_photo(image: NDArray, report: Report, tracker: StarTracker) -> PhotoPixels:
    """The photo for the page of an image that a tracker has solved or refused."""
    attitude = report.attitude
    solution = plate_solver.solution_fields(report) if attitude.solved else {}
    angles: Triple | None = (
        (solution["ra_deg"], solution["dec_deg"], solution["roll_deg"]) if solution else None
    )
    row = FrameRow(
        frame=0,
        t_s=math.nan,
        rate_deg_s=math.nan,
        status=attitude.status,
        truth_deg=UNKNOWN,
        estimate_deg=angles,
        cross_arcsec=math.nan,
        roll_arcsec=math.nan,
        detected=len(report.centroids),
        matched=len(attitude.match.observed) if attitude.match else 0,
        rms_px=attitude.rms_px,
        time_ms=1e3 * sum(report.seconds.values()),
        wrong=False,
    )
    result = TrackerResult(row, workbench.detections_of(tracker, report))
    saturation_dn = float(np.iinfo(image.dtype).max) if image.dtype.kind == "u" else math.inf
    statistics = plots.frame_statistics(image, saturation_dn)
    lens: Lens | None = None
    pose: Pose | None = None
    if attitude.cam_from_ref is not None:
        lens = lenses.lens_of(attitude.camera or tracker.camera)
        pose = Pose(attitude.cam_from_ref.inv().as_matrix().ravel())
    return Photo(result, solution, statistics, NO_PIXELS, saturation_dn, lens, pose), image


FILE_BY_ITEM = {  # file by menu entry
    "frame, FITS": "frame.fits",
    "frame, PNG": "frame.png",
    "truth": "frame.ecsv",
    "solution": "solution.json",
    "figure": "figure.png",
    "scene": "scene.yaml",
    "command line": "command.txt",
    "Python": "scene.py",
    "all of them": "",
}
PYTHON = """import skysim

scene = skysim.load_scene({!r}, {!r})
for frame in skysim.simulate(scene):
    print(frame)
"""


def frame_files(
    workbench: Workbench, base: str, overrides: dict[str, str]
) -> dict[str, bytes]:
    """All files by name. Raises InputError if no frame has been rendered."""
    if workbench.frame is None or workbench.truth is None:
        raise InputError("", "no frame has been rendered yet")
    with tempfile.TemporaryDirectory() as folder:
        recording.write_frame(Path(folder), workbench.frame, workbench.truth, workbench.scene)
        contents = {
            f"frame{path.suffix}": path.read_bytes()
            for path in sorted(Path(folder).iterdir())
        }
    annotated = scoring.annotated(workbench.frame, workbench.truth, workbench.report)
    contents["figure.png"] = bytes(cv2.imencode(".png", annotated)[1])
    if workbench.result:
        solution = file_io.to_json(solution_record(workbench.result))
        contents["solution.json"] = solution.encode()
    name = base_reference(base)
    contents["scene.yaml"] = scene_yaml(name, overrides).encode()
    contents["command.txt"] = command(base, overrides).encode()
    contents["scene.py"] = PYTHON.format(name, overrides).encode()
    return contents


def command(scene: str, overrides: Mapping[str, str]) -> str:
    """The command line that runs a scene with overrides."""
    sets = [word for pair in overrides.items() for word in ("--set", "=".join(pair))]
    return shlex.join(["skysim", "run", base_reference(scene), *sets])


def photo_files(photo: Photo, image: NDArray) -> dict[str, bytes]:
    """The files of an image that is not of the scene, by name: it has no truth, and the scene says nothing about it."""
    detected = places_px(photo.result.detections)
    identified = np.array([spot.id >= 0 for spot in photo.result.detections], bool)
    record = solution_record(photo.result) | {"solution": photo.solution, "hint": photo.hint}
    buffer = BytesIO()
    fits.PrimaryHDU(image, fits.Header([TOP_DOWN_CARD])).writeto(buffer)
    return {
        "frame.fits": buffer.getvalue(),
        "frame.png": bytes(cv2.imencode(".png", image)[1]),
        "figure.png": bytes(
            cv2.imencode(".png", annotate(image, detected, detected[identified]))[1]
        ),
        "solution.json": file_io.to_json(record).encode(),
    }


def solution_record(result: TrackerResult) -> Record:
    """The tracker's result for JSON."""
    return asdict(result.row) | {"spots": [asdict(spot) for spot in result.detections]}


def base_reference(scene: str, folder: Path | None = None) -> str:
    """The value of `base` by which a file in `folder` refers to a scene: a shipped scene's name, else a path."""
    path = find(scene).resolve()
    if path.parent in (SCENES.resolve(), PAPERS.resolve()):
        return path.stem
    return path.name if path.parent == folder else str(path)


def scene_yaml(base: str, overrides: dict[str, str], title: str = "") -> str:
    """YAML of a scene that consists of a base and overrides."""
    tree: dict[str, object] = {"schema": VERSION, "base": base}
    if title:
        tree["title"] = title
    for key, value in overrides.items():
        set_key(tree, key, value)
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)


def zip_archive(contents: dict[str, bytes]) -> bytes:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
    return buffer.getvalue()
