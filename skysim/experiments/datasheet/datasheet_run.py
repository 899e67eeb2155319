"""Run the experiments of a datasheet: write them as a study, run its missing trials, and read them as arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
import numpy as np
import yaml
from numpy.typing import NDArray
from skysim.core.errors import InputError
from skysim.core.files import (make_folder, write_text)
from skysim.core.yaml_reader import parse_yaml
from skysim.core.types import Floats
from skysim.experiments.datasheet.cells import FULL, QUICK, Cell, Designer, Size, check_scene
from skysim.experiments.study.factors import Point
from skysim.experiments.study.execution import runner, store
from skysim.experiments.study.plan import Plan, Study, TrialSpec, make_plan
from skysim.scene.scene import Scene



STUDY = "datasheet.yaml"
AXES = ("x_arcsec", "y_arcsec", "roll_arcsec")


@dataclass(frozen=True, slots=True)
class Sheet:
    """The measured frames of a datasheet.

    columns : of the trials, (cells, fields) each;  scene_name : as it was given;  overrides : of the command line
    spec    : what a trial needs to be run again
    """

    scene: Scene
    scene_name: str
    overrides: Mapping[str, str]
    size: Size
    designer: Designer
    cells: list[Cell]
    columns: dict[str, NDArray[Any]]
    spec: TrialSpec

    def rows(self, experiment: str, **levels: Any) -> list[int]:
        """Rows of the cells of an experiment that have these levels."""
        return [
            row
            for row, cell in enumerate(self.cells)
            if cell.experiment == experiment and levels.items() <= cell.levels.items()
        ]

    def levels(self, experiment: str, name: str) -> list[Any]:
        """The levels of an experiment, in order."""
        return list(
            dict.fromkeys(cell.levels[name] for cell in self.cells if cell.experiment == experiment)
        )

    def column(self, name: str, rows: list[int]) -> NDArray[Any]:
        """(cells, fields) of some cells."""
        return self.columns[name][rows]

    def right(self, rows: list[int]) -> NDArray[np.bool_]:
        """(cells, fields) whether a frame was solved and is not false."""
        return (self.columns["solved"][rows] > 0) & ~self.false(rows)

    def false(self, rows: list[int]) -> NDArray[np.bool_]:
        """(cells, fields) whether a frame has a false attitude."""
        return self.columns["wrong"][rows] > 0

    def errors(self, rows: list[int]) -> Floats:
        """(3, cells, fields) errors about the camera's axes, arcseconds; NaN for refused and false ones."""
        errors = np.stack([self.columns[name][rows] for name in AXES])
        return np.where(self.right(rows), errors, np.nan)


def study_tree(
    scene_name: str, scene: Scene, overrides: Mapping[str, str], size: Size, cells: list[Cell]
) -> dict[str, Any]:
    """The study file of the cells."""
    settings = {key: parse_yaml(text)[1] for key, text in overrides.items() if key != "seed"}
    return {
        "schema": 1,
        "title": f"Datasheet of {scene.title}",
        "scene": scene_name,
        "seed": scene.seed,
        **({"set": settings} if settings else {}),
        "trial": {"kind": "frames", **attitudes(scene)},
        "factors": {"cell": {"levels": {cell.name: cell.settings for cell in cells}}},
        "replicates": size.fields,
        "responses": ["identified", "wrong", "refused", "cross_arcsec_rms", "roll_arcsec_rms"],
    }


def attitudes(scene: Scene) -> dict[str, Any]:
    """Keys of the trial that bound the attitudes: under a dome the tilt of the vehicle's stop."""
    if scene.light.kind != "dome":
        return {}
    greatest = scene.vehicle.tilt_stop_deg if scene.vehicle.mount == "air_bearing" else 30.0
    return {"tilt_deg": [0.0, min(float(greatest), 30.0)]}


def measure(
    scene_name: str,
    scene: Scene,
    overrides: Mapping[str, str],
    folder: Path,
    *,
    quick: bool = False,
    fields: int | None = None,
    workers: int | None = None,
    watch: Callable[[int], runner.Watch] | None = None,
) -> Sheet:
    """Run the missing trials of a scene's datasheet in a folder, and return all of them.

    quick, fields : smaller experiments, and another number of fields
    watch(trials) : returns the function that is called after every batch
    Raises InputError for a scene without attitudes of single frames, and for a cell whose trials fail.
    """
    check_scene(scene)
    size = QUICK if quick else FULL
    size = replace(size, fields=fields or size.fields)
    designer = Designer(scene, size)
    cells = list(designer.cells())
    tree = study_tree(scene_name, scene, overrides, size, cells)
    path = make_folder(folder) / STUDY
    write_text(path, yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=120))
    plan = make_plan(path, Study.model_validate(tree), tree["trial"], {})
    engine = runner.ENGINES["serial" if workers == 1 else "pool"](workers, "")
    try:
        with store.writing(folder / store.STORE) as kept:
            runner.prepare_store(plan, kept, resume=kept.counts()["done"] > 0)
            runner.run(plan, kept, engine, watch(plan.trials) if watch else None)
            return Sheet(
                scene, scene_name, overrides, size, designer, cells, read(plan, kept), plan.spec
            )
    finally:
        engine.close()


def read(plan: Plan, kept: store.Store) -> dict[str, NDArray[Any]]:
    """The columns of all trials, (cells, fields). Raises InputError for a failed trial."""
    if failures := kept.failures():
        trial, error = failures[0]
        point: Point = plan.points[trial // plan.study.replicates]
        raise InputError(point.levels["cell"], error.strip().splitlines()[-1])
    return {name: values.reshape(len(plan.points), -1) for name, values in kept.columns().items()}


