"""Errors for the user, and text that is safe to print on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

running_as_command = False  # whether skysim runs as a command, with a user at the terminal


def note(message: str) -> None:
    """Print an informational line to stderr if it is a terminal."""
    if sys.stderr.isatty():
        print(f"skysim: {message}", file=sys.stderr, flush=True)


def printable(text: object) -> str:
    """Text from outside on one line, with ? for control characters and others that a terminal cannot show."""
    return "".join(
        character if character.isprintable() else "?" for character in " ".join(str(text).split())
    )


def unknown_name(kind: str, name: object, allowed: Iterable[object]) -> tuple[str, str]:
    """Problem of a name that is not allowed, and the allowed ones: `unknown solver 'magic'`, `quest, svd`."""
    return f"unknown {kind} {name!r}", ", ".join(map(str, allowed))


class Where(NamedTuple):
    """A place in a file; `str` gives `scenes/x.yaml, line 31`.

    Attributes
    ----------
    line
        None if the place is the file as a whole
    unit
        What `line` counts: lines, or rows of a table
    """

    file: str | Path
    line: int | None = None
    unit: str = "line"

    def __str__(self) -> str:
        return printable(
            self.file if self.line is None else f"{self.file}, {self.unit} {self.line}"
        )


OVERRIDES = Where("overrides")  # of a value that the caller gave in place of the file's


class InputError(ValueError):
    """The user's input is wrong; `str` says where, what, and what is allowed, in one printable line.

    No code reads the text of an error: the command line and the page word it from these parts. A caller that knows more
    raises a changed copy: `under`, `within`, `at`.

    Attributes
    ----------
    key
        The input at fault: a dotted key, a parameter or a file; empty if it has no name
    problem
        What is wrong with it; may be empty if `allowed` says all
    allowed
        What it may be; may be empty if `problem` says all
    where
        Place of the key in a file; for the file that is the key itself, the place in it
    """

    key: str
    problem: str
    allowed: str
    where: Where | None

    def __init__(
        self, key: object, problem: object, allowed: object = "", where: Where | None = None
    ) -> None:
        self.key = printable(key)  # the parts may quote a file, and a file may hold anything
        self.problem = printable(problem)
        self.allowed = printable(allowed)
        self.where = where and where._replace(file=str(where.file))
        super().__init__(
            self.key, self.problem, self.allowed, self.where
        )  # from these it is unpickled

    @property
    def fault(self) -> str:
        """The problem and what is allowed, without the key and the place."""
        return "; ".join(
            part for part in (self.problem, self.allowed and f"allowed: {self.allowed}") if part
        )

    @property
    def is_of_file(self) -> bool:
        """Whether the key is the file that `where` is in."""
        return self.where is not None and printable(self.where.file) == self.key

    @property
    def subject(self) -> str:
        """The key; of a file with the place in it."""
        return str(self.where) if self.is_of_file else self.key

    def __str__(self) -> str:
        text = f"{self.subject}: {self.fault}" if self.key else self.fault
        return text if self.where is None or self.is_of_file else f"{text} ({self.where})"

    def under(self, prefix: object) -> InputError:
        """The error with the key of the section around it before its own."""
        key = f"{prefix}.{self.key}" if self.key else prefix
        return InputError(key, self.problem, self.allowed, self.where)

    def within(self, key: object) -> InputError:
        """The error with the key whose value names what is at fault; the problem then begins with that name."""
        problem = f"{self.subject}: {self.problem}" if self.key else self.problem
        return InputError(key, problem, self.allowed, None if self.is_of_file else self.where)

    def at(self, where: Where | None) -> InputError:
        """The error with its place in a file."""
        return InputError(self.key, self.problem, self.allowed, where)
