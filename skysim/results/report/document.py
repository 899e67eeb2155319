"""A report: its title, the command that repeats it, and its blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from skysim.core import __version__
from skysim.core.errors import InputError, unknown_name
from skysim.results.report import (as_text)
from skysim.results.report import pages
from skysim.results.report import pages
from skysim.results.report.blocks import Block, Cell, Column, Section, Verdict, figure_files, filled

SUFFIXES = (".html", ".md", ".json")
LOOKS = (
    "folded",
    "id",
    "image",
    "kind",
    "name",
    "on_terminal",
    "optional",
)  # fields that JSON leaves out


@dataclass(frozen=True)
class Report:
    """What a run, a study or a measurement says to people.

    blocks  : the answer and what must be known with it, then sections; those that hold nothing are left out
    command : the command that repeats it
    """

    title: str
    blocks: Sequence[Block]
    command: str = ""
    version: str = __version__

    def __post_init__(self) -> None:
        object.__setattr__(self, "blocks", filled(self.blocks))

    @property
    def verdict(self) -> str:
        """The sentence that answers; empty without one."""
        return next((one.text for one in self.blocks if isinstance(one, Verdict)), "")

    def html(self) -> str:
        """One self-contained page, its images embedded."""
        return pages.html_page(self.title, self.command, self.version, self.blocks)

    def markdown(self, pictures: str = "") -> str:
        """A Markdown page. pictures : what the paths of its figures begin with; without it they are left out"""
        return pages.markdown_page(self.title, self.command, self.blocks, pictures)

    def json(self) -> dict[str, Any]:
        """Title, command, version and blocks as values for JSON; figures by their captions."""
        return {
            "title": self.title,
            "command": self.command,
            "version": self.version,
            "blocks": plain(self.blocks),
        }

    def print(self) -> None:
        """Print it on the terminal, without figures; the answer comes last, above the prompt."""
        opening = [one for one in self.blocks if not isinstance(one, Section)]
        as_text.print_blocks([*(one for one in self.blocks if isinstance(one, Section)), *opening])

    def save(self, path: str | Path, pictures: str = "") -> Path:
        """Write a page in the format of the suffix: .html, .md or .json. Returns the path.

        pictures : what the paths of a Markdown page's figures begin with; by default a folder of the page's name

        Raises InputError for another suffix.
        """
        from skysim.core import files

        path = Path(path)
        if path.suffix not in SUFFIXES:
            raise InputError(path, *unknown_name("file format", path.suffix, SUFFIXES))
        files.make_folder(path.parent)
        if path.suffix == ".html":
            files.write_text(path, self.html())
        elif path.suffix == ".json":
            files.write_text(path, files.to_json(self.json()))
        else:
            pictures = pictures or f"{path.stem}/"
            for name, figure in figure_files(self.blocks):
                file = path.parent / f"{pictures}{name}"
                files.make_folder(file.parent)
                files.write_bytes(file, figure.image)
            files.write_text(path, self.markdown(pictures))
        return path


def plain(value: Any) -> Any:
    """Blocks and what they hold as values for JSON."""
    if isinstance(value, Block):
        held = {
            one.name: plain(getattr(value, one.name))
            for one in fields(value)
            if one.name not in LOOKS
        }
        return {"kind": type(value).__name__.lower()} | held
    if isinstance(value, Cell):
        return value.text
    if isinstance(value, Column):
        return {"title": value.title, "unit": value.unit}
    return [plain(one) for one in value] if isinstance(value, list | tuple) else value
