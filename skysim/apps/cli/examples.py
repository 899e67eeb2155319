"""Examples of every command, at the end of its `--help` and in docs/reference/command_line.md."""

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


def add_examples(app: typer.Typer, name: str = "") -> None:
    """Add the examples to a group of commands and to all commands in it. Raises KeyError where there are none."""
    app.info.epilog = epilog(name)
    for command in app.registered_commands:
        function = command.callback
        own = command.name or (function.__name__ if function else "")
        command.epilog = epilog(f"{name} {own}".strip())
    for group in app.registered_groups:
        if group.typer_instance:
            add_examples(group.typer_instance, f"{name} {group.name}".strip())
