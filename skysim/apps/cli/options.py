"""Options shared by several commands, and the functions that interpret them."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from skysim.core.errors import OVERRIDES, InputError, Where
from skysim.core.paths import SCENES, STUDIES, shipped_files
from skysim.scene.camera_sheet import QUESTIONS

if TYPE_CHECKING:
    from skysim.experiments.study.plan import Plan
    from skysim.scene.scene import Scene


# Loaded scenes: name and command-line overrides, for the locations in error messages.
Loaded = tuple[str, dict[str, str]]
LOADED: list[Loaded] = []
TYPED: dict[str, str] = {}  # scene keys that an option has set, and the option


def complete_scene(incomplete: str) -> list[str]:
    """Names of shipped scenes, and YAML files and folders, that begin with what was typed."""
    return complete_yaml(SCENES, incomplete)


def complete_study(incomplete: str) -> list[str]:
    """Names of shipped studies, and YAML files and folders, that begin with what was typed."""
    return complete_yaml(STUDIES, incomplete)


def complete_yaml(folder: Path, incomplete: str) -> list[str]:
    names = list(shipped_files(folder))
    found = Path(
        incomplete if incomplete.endswith("/") else os.path.dirname(incomplete)
    ).glob("*")
    files = [
        f"{path}/" if path.is_dir() else str(path)
        for path in found
        if path.is_dir() or path.suffix == ".yaml"
    ]
    return sorted(name for name in names + files if name.startswith(incomplete))


SceneArg = Annotated[
    str,
    Argument(
        metavar="SCENE",
        help="Scene file (.yaml), or name of a scene in scenes/.",
        autocompletion=complete_scene,
    ),
]
Frames = Annotated[int | None, Option(help="Number of frames; default: the scene's.")]
Seed = Annotated[
    int | None,
    Option(
        help="Seed of all noise, and of a survey's list, lever and focal length; default: the scene's."
    ),
]
Out = Annotated[Path | None, Option(help="Output folder; default: out/NAME.")]
Scene3d = Annotated[
    bool,
    Option(
        "--scene-3d", help="Write 3-D views of the laboratory: scene_3d.png and scene_3d.gif."
    ),
]
Overrides = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a key of the file: exposure.rate_hz=10; repeatable.",
    ),
]
Detector = Annotated[str | None, Option(help="Detection algorithm, e.g. local.")]
Centroider = Annotated[str | None, Option(help="Centroiding algorithm, e.g. gaussian_fit.")]
Identifier = Annotated[str | None, Option(help="Identification algorithm, e.g. pyramid.")]
SolverName = Annotated[str | None, Option(help="Attitude algorithm, e.g. quest.")]
TRACKER_HELP = "Tracker: own, or a name from `skysim trackers` or --program."
Programs = Annotated[
    list[str] | None,
    Option(
        metavar="NAME=COMMAND", help="External tracker or controller: a program; repeatable."
    ),
]
OpenReport = Annotated[bool, Option("--open", help="Open the report when it is written.")]
Json = Annotated[bool, Option("--json", help="Print JSON instead of text.")]


def load(
    name: str,
    overrides: list[str] | None,
    seed: int | None = None,
    frames: int | None = None,
    trackers: list[str] | None = None,
) -> Scene:
    """Load the scene with the command line's overrides. Raises InputError.

    Parameters
    ----------
    trackers
        Names of all trackers that will solve its frames, the scene's own first; an override
        must have an effect for one of them
    """
    from skysim.core.yaml_reader import parse_overrides
    from skysim.scene import unused
    from skysim.scene.loader import load as load_scene

    TYPED.clear()
    values = parse_overrides(overrides)
    if frames is not None:
        values["exposure.frames"] = str(frames)
        TYPED["exposure.frames"] = "--frames"
    if seed is not None:
        values["seed"] = str(seed)
        TYPED["seed"] = "--seed"
    if trackers:
        values["tracker.name"] = trackers[0]
        TYPED["tracker.name"] = "--tracker"
    LOADED.append((name, values))
    scene = load_scene(name, values, refuses_unused=not trackers)
    if trackers:
        each = [scene.with_values("tracker", name=tracker) for tracker in trackers]
        unused.check_overrides(each, values)
    return scene


def used_programs(options: list[str] | None, names: Iterable[str | None]) -> dict[str, str]:
    """The commands of --program by name. Raises InputError for a name that is not among those used."""
    from skysim.tracking import tracker_interface

    programs = tracker_interface.program_commands(options)
    used = set(names)
    for name in programs:
        if name not in used:
            problem = "has no effect: nothing has this name"
            raise InputError(
                f"programs.{name}",
                problem,
                "that of --tracker, tracker.name or motion.control.law",
            )
    return programs


def scene_names(scene: Scene) -> tuple[str | None, str | None]:
    """The names of the scene's tracker and of its controller, None without one."""
    control = scene.motion.control
    return scene.tracker.name, control.law if control else None


def study_names(plan: Plan) -> set[str | None]:
    """All texts that are values of a study, and the names of its scene's tracker and controller."""
    from skysim.experiments.study.plan import resolve_point

    def texts(value: Any) -> Iterator[str]:
        if isinstance(value, str):
            yield value
        for inner in (
            value.values()
            if isinstance(value, dict)
            else value
            if isinstance(value, list | tuple)
            else ()
        ):
            yield from texts(inner)

    scene, _ = resolve_point(plan.spec, {})
    return {*texts(plan.study.model_dump(mode="json")), *scene_names(scene)}


def output_folder(out: Path | None, name: str) -> Path:
    """The folder of --out, by default out/NAME."""
    return out or Path("out") / name


def write_file(path: Path, text: str) -> None:
    """Write a text file, and make its folder if there is none. Raises InputError."""
    from skysim.core import files

    files.make_folder(path.parent)
    files.write_text(path, text)


def command_line() -> str:
    """The command that the user has typed."""
    return shlex.join(["skysim", *sys.argv[1:]])


def given_options(**options: Any) -> dict[str, Any]:
    """The options that the command line has, without those that are left out."""
    return {name: value for name, value in options.items() if value is not None}


# Errors with the option that a user typed in place of the key.


OPTIONS = {  # the option of each function parameter, by the parameter's key in messages
    "overrides": "--set",
    "programs": "--program",
    "trackers": "--tracker",
    "export.formats": "--to",
    "export.file": "--out",
    "dataset.formats": "--to",
    "dataset.frames_per_shard": "--shard-frames",
    "survey.tilt_deg": "--tilt",
    "solve.fov_deg": "--fov",
    "solve.near_deg": "--near",
    "solve.time_utc": "--time",
} | {  # those with the parameter's name
    key: f"--{key.rpartition('.')[2].replace('_', '-')}"
    for key in (
        "engine",
        "scheduler",
        "workers",
        "where",
        "response",
        "dataset.frames",
        "datasheet.fields",
        "datasheet.fmu",
        "survey.imu_sigma",
        "survey.led_sigma",
        "survey.lever_sigma",
        "survey.focal_error",
        "balance.torque",
        "balance.offset_bar",
        "balance.inertia_sigma",
        "balance.offset_sigma",
        "balance.wheel_sigma",
        "balance.mount_sigma",
        "balance.tacho_sigma",
        "characterize.darks",
        "characterize.flats",
        "characterize.night",
        "solve.catalog",
        "solve.detector",
        "solve.centroider",
        "solve.identifier",
        "solve.solver",
        *(f"answers.{name}" for name in QUESTIONS),
    )
}


def as_typed(error: InputError, loaded: Loaded | None = None) -> InputError:
    """The error with the option at fault in place of its key, and with file and line of a key of the scene.

    Parameters
    ----------
    loaded
        Name and overrides of the scene, by default those of the last one
    """
    loaded = loaded or (LOADED[-1] if LOADED else None)
    if loaded:
        from skysim.scene.loader import located

        error = located(error, *loaded)
    if error.where == OVERRIDES:
        typed = TYPED.get(error.key)
        if typed:
            return InputError(typed, error.problem, error.allowed)
        return error.at(Where("--set"))
    return InputError(option_of(error.key), error.problem, error.allowed, error.where)


def option_of(key: str) -> str:
    """The option that gives a parameter, with the name of an item in it: `programs.mine` is `--program mine`."""
    if key in OPTIONS:
        return OPTIONS[key]
    parameter, _, item = key.partition(".")
    return f"{OPTIONS[parameter]} {item}" if item and parameter in OPTIONS else key


def with_location(finding: str, loaded: Loaded | None = None) -> str:
    """A finding, `key: text`, with file and line of the key in a loaded scene; by default, in the last one."""
    key, _, text = finding.partition(": ")
    return str(as_typed(InputError(key, text), loaded)) if text else finding
