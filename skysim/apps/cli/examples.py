"""The help of every command: its options, from its docstring, and examples, also in docs/reference/command_line.md."""

import inspect
import re
from copy import copy
from typing import Annotated, Any

import typer

from skysim.core.paths import DATA

# By the name of the command; "" is `skysim` itself. The file has a paragraph for each command: its name with a colon,
# then a line for each example.
EXAMPLES: dict[str, tuple[str, ...]] = {}
for paragraph in (DATA / "examples.txt").read_text("utf-8").strip().split("\n\n"):
    head, *lines = paragraph.splitlines()
    EXAMPLES[head.removeprefix("skysim").strip(" :")] = tuple(lines)


def epilog(name: str) -> str:
    """The examples of a command as the last paragraphs of its help."""
    return "\n".join(["Examples:", *(f"  {line}" for line in EXAMPLES[name])])


PARAMETERS = "\n\nParameters\n----------\n"


def documented(command: Any) -> None:
    """Give a command's parameters the help in its docstring, and the metavar there, as in `size : WxH`.

    A parameter that is not annotated is an option. A bool is a flag: typer alone would add an option --no-NAME.
    """
    text, _, section = (inspect.getdoc(command) or "").partition(PARAMETERS)
    signature = inspect.signature(command, eval_str=True)
    options = dict(signature.parameters)
    described = re.findall(r"^(\w+)(?: : (.+))?\n((?: +.+\n?)+)", section, re.MULTILINE)
    for name, metavar, explained in described:
        kind = options[name].annotation
        if not hasattr(kind, "__metadata__"):
            kind = Annotated[kind, typer.Option(f"--{name.rstrip('_').replace('_', '-')}")]
        parameter = copy(kind.__metadata__[0])  # options of one type share it
        parameter.help = " ".join(explained.split())
        parameter.metavar = metavar or parameter.metavar
        kind = Annotated[kind.__origin__, parameter]
        options[name] = options[name].replace(annotation=kind)
    command.__doc__ = text
    command.__signature__ = signature.replace(parameters=list(options.values()))


def add_help(app: typer.Typer, name: str = "") -> None:
    """Add the help to a group of commands and to all commands in it. Raises KeyError where there are no examples."""
    app.info.epilog = epilog(name)
    for command in app.registered_commands:
        function = command.callback
        documented(function)
        own = command.name or (function.__name__ if function else "")
        command.epilog = epilog(f"{name} {own}".strip())
    for group in app.registered_groups:
        if group.typer_instance:
            add_help(group.typer_instance, f"{name} {group.name}".strip())
