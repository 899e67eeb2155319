"""The page of the command line, written from the commands themselves whenever the site is built."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer

from skysim.apps.cli.main import app

PAGE = "reference/commands.md"
MARK = "<!-- commands -->"


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The page with its commands in place of the mark."""
    return markdown.replace(MARK, told()) if page.file.src_uri == PAGE else markdown


def told() -> str:
    """Every command: a heading, what it does, how it is typed, and a table of what it takes."""
    return "\n\n".join(section(context) for context in contexts(typer.Context(root(), info_name="skysim")))


def root() -> Any:
    return typer.main.get_command(app)


def contexts(above: Any) -> Iterator[Any]:
    """A command and all beneath it, in the order of `skysim --help`."""
    yield above
    for name, command in getattr(above.command, "commands", {}).items():
        yield from contexts(typer.Context(command, info_name=name, parent=above))


def section(context: Any) -> str:
    """One command."""
    command = context.command
    rows = [row(part, context) for part in command.get_params(context) if part.name != "help"]
    name, usage = context.command_path, command.get_usage(context).removeprefix("Usage: ")
    head = f"{'##' if context.parent is None or context.parent.parent is None else '###'} `{name}`"
    table = "\n".join(["| it takes | for |", "|---|---|", *rows]) if rows else ""
    return "\n\n".join(filter(None, [head, command.help or "", f"```text\n{usage}\n```", table]))


def row(part: Any, context: Any) -> str:
    """An argument or an option: how it is written, and what it is for."""
    what, meaning = part.get_help_record(context)
    if part.param_type_name == "argument":
        what = what.partition(" <")[0]
    return f"| `{cell(what)}` | {cell(meaning)} |"


def cell(text: str) -> str:
    """A text in a table: Markdown's and HTML's marks as the letters that they are."""
    return " ".join(text.split()).replace("|", "\\|").replace("*", "\\*")
