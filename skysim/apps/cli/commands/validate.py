"""Commands `skysim validate` and `check`.

`validate` checks input files without simulating, or prints their JSON Schema for an editor; `check` says what a scene
will show and how accurate its tracker will be.
"""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from skysim.apps.cli.options import (
    Json,
    Overrides,
    Programs,
    SceneArg,
    load,
    scene_names,
    study_names,
    used_programs,
    with_location,
)
from skysim.apps.cli.terminal import print_check, print_error, print_json
from skysim.core.errors import InputError


class FileVerdict(NamedTuple):
    """Result for one file: a description and warnings, or `fault`, the error in one line."""

    file: str
    what: str = ""
    doubts: tuple[str, ...] = ()
    fault: str = ""


def validate(
    files: Annotated[list[Path] | None, typer.Argument()] = None,
    program: Programs = None,
    schema: str | None = None,
    json: Json = False,
) -> None:
    """Check files: keys, units, consistency, and whether a scene can be set up. Exit code 2 if one is invalid.

    Parameters
    ----------
    files : FILES
        Scenes, studies and cameras (YAML files or names), calibrations of OpenCV (YAML), vehicles (MJCF),
        catalogs and LED maps (ECSV).
    schema
        Print the JSON Schema of a kind of file: scene or study.
    """
    if schema is not None:
        from skysim.apps.cli import json_schema

        if schema not in json_schema.KINDS:
            raise InputError(f"--schema {schema}", "", ", ".join(json_schema.KINDS))
        print_json(json_schema.json_schema(schema))
        return
    if not files:
        raise InputError("", "no files", "files, or --schema scene")
    from skysim.tracking import tracker_interface

    programs = tracker_interface.program_commands(program)
    verdicts = [check_file(path, programs) for path in files]
    if program and not any(verdict.fault for verdict in verdicts):
        used_programs(program, {name for path in files for name in names_in_file(path)})
    if json:
        print_json([verdict._asdict() for verdict in verdicts])
    for verdict in verdicts if not json else []:
        if verdict.fault:
            print_error(verdict.fault)
        else:
            print(f"{verdict.file}: {verdict.what}", *verdict.doubts, sep="\n  ")
    if any(verdict.fault for verdict in verdicts):
        raise typer.Exit(2)


def check(
    scene: SceneArg, program: Programs = None, set_: Overrides = None, json: Json = False
) -> None:
    """Check a plan before its run: field, lights in it, image size, saturation, smear, focus, expected error, warnings.

    Nothing is simulated or rendered; everything is computed at sampled attitudes.
    """
    from skysim.simulation.checks import check as check_plan
    from skysim.simulation.lab import UserParts, build_lab

    loaded = load(scene, set_)
    result = check_plan(
        build_lab(loaded, UserParts(used_programs(program, scene_names(loaded))))
    )
    findings = [with_location(finding) for finding in result.findings]
    if json:
        print_json(result._replace(findings=findings).as_dict())
    else:
        print_check(result.facts, findings)


def check_file(path: Path, programs: Mapping[str, str]) -> FileVerdict:
    """Check one file; errors become the verdict's `fault`.

    Parameters
    ----------
    programs
        Commands of external trackers and controllers, by name
    """
    try:
        return FileVerdict(str(path), *describe_file(path, programs))
    except (InputError, OSError) as error:
        return FileVerdict(str(path), fault=str(error))


def describe_file(path: Path, programs: Mapping[str, str]) -> tuple[str, tuple[str, ...]]:
    """Return a description of the file and warnings. Raises InputError with one line."""
    from skysim.core.yaml_reader import is_file, read_yaml
    from skysim.scene import opencv_calibration

    path = path if path.suffix else find_shipped(path)
    if path.suffix not in (".yaml", ".yml", ".ecsv", ".xml"):
        raise InputError(
            path, "", ".yaml, .ecsv, .xml or the name of a scene, a study or a camera"
        )
    if not is_file(path):  # reading a named pipe would block
        raise InputError(path, "not a regular file")
    if path.suffix == ".ecsv":
        return describe_table(path), ()
    if path.suffix == ".xml":
        from skysim.dynamics import multibody
        from skysim.scene.sections.vehicle import VehicleConfig

        model = multibody.build(VehicleConfig.model_validate({"model": str(path.resolve())}))
        return f"a vehicle of {model.mass.mass_kg:g} kg", ()
    if opencv_calibration.looks_like_calibration(path):
        lens = opencv_calibration.read(path)
        return f"a calibration of {lens.width_px} x {lens.height_px} pixels", ()
    keys = read_yaml(path)[0].keys()
    if keys & {"factors", "trial", "responses"}:
        from skysim.experiments.study import study_file

        plan = study_file.load(path)
        return f"a study of {plan.trials} trials" if plan.trials else "a search", ()
    if "camera" in keys and keys <= {"camera", "schema"}:
        from skysim.scene.camera_sheet import PLACEHOLDER_LENS
        from skysim.scene.loader import load_camera

        camera = load_camera(path, PLACEHOLDER_LENS)
        return f"a camera of {camera.width_px} x {camera.height_px} pixels", ()
    return check_scene(path, programs)


def names_in_file(path: Path) -> set[str | None]:
    """The names of trackers and controllers in a scene or a study; empty for other files."""
    from skysim.experiments.study import study_file
    from skysim.scene import loader

    path = path if path.suffix else find_shipped(path)
    with contextlib.suppress(InputError):
        return set(scene_names(loader.load(path)))
    with contextlib.suppress(InputError):
        return study_names(study_file.load(path))
    return set()


def find_shipped(path: Path) -> Path:
    """Path of the shipped scene, study or camera of this name. Raises InputError with the names of the scenes."""
    from skysim.core.paths import DATA, SCENES, STUDIES, shipped_files
    from skysim.core.yaml_reader import find_file

    others = shipped_files(DATA / "cameras") | shipped_files(STUDIES)
    return others.get(str(path)) or find_file(str(path), SCENES, "scene")


def check_scene(path: Path, programs: Mapping[str, str]) -> tuple[str, tuple[str, ...]]:
    """Set up a scene without simulating its motion: vehicle, lights, tracker. Returns a description and warnings."""
    from skysim.scene import loader
    from skysim.simulation.checks import check as check_plan
    from skysim.simulation.lab import UserParts, build_lab, build_tracker

    scene = loader.load(path)
    try:
        lab = build_lab(scene, UserParts(programs))
        build_tracker(lab.camera, programs)
        findings = check_plan(lab).findings
    except InputError as error:
        raise loader.located(error, str(path), {}) from None
    count = len(lab.camera.sources.id)
    frames = scene.exposure.frames
    described = f"a scene of {count} lights and {frames} frames"
    return described, tuple(with_location(finding, (str(path), {})) for finding in findings)


def describe_table(path: Path) -> str:
    """Describe an ECSV table: a star catalog if its header has a column `hip`, else an LED map."""
    from skysim.core.yaml_reader import read_limited
    from skysim.sources import catalog
    from skysim.tracking import dome_map_file

    if "{name: hip," in read_limited(path, catalog.MAX_BYTES)[:4000]:
        return f"a catalog of {len(catalog.read(path).hip)} stars"
    return f"a map of {len(dome_map_file.read_dome_map(path).id)} LEDs"
