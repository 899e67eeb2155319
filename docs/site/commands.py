"""The command line as Markdown: a section for each command. `reference.py` puts them into the reference."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer

from skysim.apps.cli.examples import EXAMPLES
from skysim.apps.cli.main import app


def commands_markdown() -> str:
    """All commands: heading, description, usage, and a table of the parameters."""
    return "\n\n".join(
        section(context)
        for context in command_contexts(typer.Context(root_command(), info_name="skysim"))
    )


def root_command() -> Any:
    return typer.main.get_command(app)


def command_contexts(parent: Any) -> Iterator[Any]:
    """A command and all its subcommands, in the order of `skysim --help`."""
    yield parent
    for name, command in getattr(parent.command, "commands", {}).items():
        yield from command_contexts(typer.Context(command, info_name=name, parent=parent))


def section(context: Any) -> str:
    """Section of one command."""
    command = context.command
    rows = [
        row(parameter, context)
        for parameter in command.get_params(context)
        if parameter.name != "help"
    ]
    name = context.command_path
    usage = command.get_usage(context).removeprefix("Usage: ")
    heading = f"{'##' if context.parent is None or context.parent.parent is None else '###'} `{name}`"
    table = "\n".join(["| parameter | meaning |", "|---|---|", *rows]) if rows else ""
    examples = "\n".join(EXAMPLES[name.partition(" ")[2]])
    parts = [
        heading,
        command.help or "",
        f"```text\n{usage}\n```",
        table,
        f"Examples:\n\n```text\n{examples}\n```",
    ]
    return "\n\n".join(filter(None, parts))


def row(parameter: Any, context: Any) -> str:
    """Table row of an argument or option: usage and meaning."""
    usage, meaning = parameter.get_help_record(context)
    if parameter.param_type_name == "argument":
        usage = usage.partition(" <")[0]
    return f"| `{escape_cell(usage)}` | {escape_cell(meaning)} |"


def escape_cell(text: str) -> str:
    """Escape a text for a cell of a Markdown table."""
    return " ".join(text.split()).replace("|", "\\|").replace("*", "\\*")
