"""Options shared by several commands, and the functions that interpret them."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.scene.scene import Scene

LOADED: list[
    tuple[str, dict[str, str]]
] = []  # loaded scenes: name and command-line overrides, for error locations

SceneArg = Annotated[
    str, typer.Argument(metavar="SCENE", help="A scene file (.yaml) or the name of one in scenes/.")
]
Frames = Annotated[int | None, typer.Option(help="How many frames; the scene's own number if left out.")]
Seed = Annotated[int | None, typer.Option(help="Seed of all random streams; the scene's own if left out.")]
Out = Annotated[Path | None, typer.Option(help="Folder for what is written; out/NAME if left out.")]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Override a key: camera.detector.bits=8; may be given again."
    ),
]
Detector = Annotated[str | None, typer.Option(help="How lights are found, e.g. local.")]
Centroider = Annotated[str | None, typer.Option(help="How they are centred, e.g. gaussian_fit.")]
Identifier = Annotated[str | None, typer.Option(help="How they are named, e.g. pyramid.")]
SolverName = Annotated[str | None, typer.Option("--solver", help="How the attitude follows, e.g. quest.")]
Programs = Annotated[
    list[str] | None,
    typer.Option(
        "--program", metavar="NAME=COMMAND", help="A tracker of your own: a program that is told frames."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")]


def load(name: str, frames: int | None, seed: int | None, sets: list[str] | None) -> Scene:
    """Load the scene with the command line's overrides. Raises InputError."""
    from skysim.core.yaml_reader import parse_overrides
    from skysim.scene.loader import load as load_scene

    overrides = parse_overrides(sets)
    if frames is not None:
        overrides["exposure.frames"] = str(frames)
    if seed is not None:
        overrides["seed"] = str(seed)
    LOADED.append((name, overrides))
    return load_scene(name, overrides)


def given_stages(**stages: str | None) -> dict[str, str]:
    """The tracker stages for which the command line names an algorithm."""
    return {stage: name for stage, name in stages.items() if name is not None}


def clean_folder(folder: Path) -> Path:
    """Make the folder and remove the frames and results of an earlier run; return it."""
    from skysim.core import files
    from skysim.results.files import frames

    frames.clear(files.make_folder(folder))
    return folder


def moment(text: str | None) -> datetime.datetime | None:
    if text is None:
        return None
    try:
        return datetime.datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--time {text}: allowed: ISO 8601, e.g. 2012-06-22T21:00:00") from None


def with_location(message: str) -> str:
    """Add file and line of the scene to an error message about a key that was only checked after loading."""
    if not LOADED:
        return message
    from skysim.scene.loader import with_location

    return with_location(message, *LOADED[-1])
