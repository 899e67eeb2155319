"""Every command's help ends with examples, and every example is a command line that parses."""

from __future__ import annotations

import shlex
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from skysim.apps.cli.examples import EXAMPLES
from skysim.apps.cli.main import app

ROOT = typer.main.get_command(app)


def commands(command: Any, name: str = "") -> dict[str, Any]:
    """All commands by their path."""
    below = {
        path: one
        for own, inner in getattr(command, "commands", {}).items()
        for path, one in commands(inner, f"{name} {own}".strip()).items()
    }
    return {name: command} | below


def command_of(words: list[str]) -> tuple[str, Any, list[str]]:
    """Path of the command that the words call, the command, and the remaining words; `camera FILE` is `camera show`."""
    path = ""
    command = ROOT
    while inner := getattr(command, "commands", {}):
        if path == "camera" and words and words[0] not in inner:
            words = ["show", *words]
        if not words or words[0] not in inner:
            break
        path = f"{path} {words[0]}".strip()
        command = inner[words[0]]
        words = words[1:]
    return path, command, words


def test_exactly_the_existing_commands_have_examples() -> None:
    assert set(EXAMPLES) == set(commands(ROOT))


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_help_ends_with_examples(name: str) -> None:
    shown = CliRunner().invoke(app, [*name.split(), "--help"], env={"COLUMNS": "100"})
    assert shown.exit_code == 0
    end = shown.output.partition("Examples:")[2].split("\n")
    assert [line.strip() for line in end if line.strip()] == list(EXAMPLES[name])


@pytest.mark.parametrize(
    ("name", "line"),
    [(name, line) for name, lines in EXAMPLES.items() for line in lines],
    ids=lambda text: text,
)
def test_an_example_calls_its_command_with_options_that_it_has(name: str, line: str) -> None:
    program, *words = shlex.split(line)
    path, command, left = command_of(words)
    assert program == "skysim"
    assert path == name or (
        f"{path} ".startswith(f"{name} ".lstrip())
        and hasattr(commands(ROOT)[name], "commands")
    )
    command.make_context(
        path, list(left)
    )  # raises for an unknown option or a missing argument
    assert len(line) <= 78


def test_an_unknown_option_would_be_found() -> None:
    path, command, left = command_of(["run", "shefex2", "--fames", "3"])
    with pytest.raises(Exception, match="fames"):
        command.make_context(path, left)
