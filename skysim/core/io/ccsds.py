"""What CCSDS messages in keyword = value notation share: segments of metadata and data lines, and their checks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from skysim.core.errors import InputError, Where
from skysim.core.io.text import Line, excerpt


class Segment(NamedTuple):
    """A segment: its metadata with their lines, and its data lines split into words."""

    metadata: dict[str, Line]
    data: list[tuple[int, list[str]]]

    def require(self, path: str | Path, keys: Sequence[str]) -> None:
        """Raise InputError for the first keyword that the metadata lack."""
        for key in keys:
            if key not in self.metadata:
                raise InputError(path, f"{key} is missing in the metadata of a segment")


def keyword_value(path: str | Path, n: int, line: str) -> tuple[str, str]:
    """The keyword and the value of a line. Raises InputError for another line."""
    key, equals, value = (part.strip() for part in line.partition("="))
    if not equals:
        raise InputError(path, f"{excerpt(line)} is not KEYWORD = value", where=Where(path, n))
    return key, value


def check_version(path: str | Path, keyword: str, version: str, allowed: Sequence[str]) -> None:
    """Raise InputError for a version of the message that is not read."""
    if version not in allowed:
        raise InputError(path, f"{keyword} is {excerpt(version)}", ", ".join(allowed))


def one_of(path: str | Path, metadata: dict[str, Line], key: str, allowed: Iterable[str]) -> str:
    """A keyword's value, in capitals, if it is allowed. Raises InputError."""
    line, value = metadata[key]
    names = list(allowed)
    if value.upper() not in names:
        raise InputError(path, f"{key} = {excerpt(value)}", ", ".join(names), where=Where(path, line))
    return value.upper()
