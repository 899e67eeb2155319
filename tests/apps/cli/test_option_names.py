"""The command line names the option that was typed where an error names a parameter or an overridden key."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from skysim.apps.cli import options
from skysim.apps.cli.main import app
from skysim.apps.cli.options import OPTIONS, as_typed, load
from skysim.core.errors import OVERRIDES, InputError, Where
from skysim.experiments.study.plan import Study
from skysim.scene.scene import Scene

PACKAGE = Path(options.__file__).parents[2]
PARAMETERS = {key.partition(".")[0] for key in OPTIONS}  # begin of the keys of parameters


@pytest.fixture(autouse=True)
def _no_scene_loaded() -> None:
    options.TYPED.clear()
    options.LOADED.clear()


def declared(command: object) -> Iterator[str]:
    """Every option of a command and of its subcommands."""
    for parameter in command.params:
        yield from parameter.opts
    for inner in getattr(command, "commands", {}).values():
        yield from declared(inner)


def raised_keys() -> Iterator[str]:
    """The constant keys of errors below the apps, and the begin of those with a name filled in.

    Not those of a scene's sections, which are relative to the section.
    """
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).parts[0] == "apps" or path.parent.name == "sections":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Call)
                and getattr(node.func, "id", "") == "InputError"
                and node.args
            ):
                key = (
                    node.args[0].values[0]
                    if isinstance(node.args[0], ast.JoinedStr)
                    else node.args[0]
                )
                if isinstance(key, ast.Constant):
                    yield key.value


def test_every_key_of_the_table_has_an_option_that_exists() -> None:
    known = set(declared(typer.main.get_command(app)))
    assert {option for option in OPTIONS.values() if option not in known} == set()


def test_no_key_of_the_table_is_a_key_of_a_scene_or_a_study() -> None:
    models = (Scene, Study)
    keys = {
        field.alias or name for model in models for name, field in model.model_fields.items()
    }
    assert PARAMETERS.isdisjoint(keys)


@pytest.mark.slow
def test_every_parameter_at_fault_below_the_apps_is_in_the_table() -> None:
    found = {
        key for key in raised_keys() if "." in key and key.partition(".")[0] in PARAMETERS
    }
    assert len(found) > 10
    # With a name filled in, as `dataset.{name}`, the begin alone is known.
    assert {key for key in found if key not in OPTIONS and key[-1] != "."} <= {
        "where.",
        "programs.",
    }


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (InputError("survey.tilt_deg", "95", "up to 30"), "--tilt: 95; allowed: up to 30"),
        (
            InputError("programs.mine", "name already in use"),
            "--program mine: name already in use",
        ),
        (
            InputError("where.rate", "unknown level 5", "1, 2"),
            "--where rate: unknown level 5; allowed: 1, 2",
        ),
        (
            InputError("overrides", "frames", "path.to.key=value"),
            "--set: frames; allowed: path.to.key=value",
        ),
        (
            InputError("seed", "-1", "0 or more", OVERRIDES),
            "seed: -1; allowed: 0 or more (--set)",
        ),
        (InputError("seed", "-1", "", Where("x.yaml", 3)), "seed: -1 (x.yaml, line 3)"),
        (InputError("light.layout", "full"), "light.layout: full"),
        (InputError("", "no image"), "no image"),
    ],
)
def test_an_error_names_the_typed_option(error: InputError, line: str) -> None:
    assert str(as_typed(error)) == line


def test_a_key_that_an_option_of_its_own_sets_is_named_by_that_option() -> None:
    with pytest.raises(InputError) as raised:
        load("shefex2", None, frames=0)
    assert str(as_typed(raised.value)).startswith("--frames: 0 is not allowed; allowed: ")
    with pytest.raises(InputError) as raised:
        load("shefex2", ["exposure.frames=0"])
    assert str(as_typed(raised.value)).startswith("exposure.frames: 0 is not allowed; ")
    assert str(as_typed(raised.value)).endswith("(--set)")


def test_a_key_that_is_checked_after_loading_gets_its_place() -> None:
    load("shefex2", ["camera.f_number=2"], 5)
    in_file = as_typed(InputError("light.kind", "cannot be built"))
    assert in_file.where is not None
    assert in_file.where.line
    assert in_file.where.file.endswith("shefex2.yaml")
    assert (
        str(as_typed(InputError("camera.f_number", "too fast")))
        == "camera.f_number: too fast (--set)"
    )
    assert str(as_typed(InputError("seed", "unlucky"))) == "--seed: unlucky"
