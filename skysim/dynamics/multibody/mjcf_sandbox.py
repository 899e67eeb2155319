"""Check that an untrusted MJCF file and all it includes name only files within its own folder.

MuJoCo itself would read any file. The check must see the same names as MuJoCo's parser, so XML that two
parsers could
read differently is refused: encodings other than UTF-8, a DOCTYPE, namespaces. Of each name all places are checked
where MuJoCo may look for it.
"""

from __future__ import annotations

import os.path
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from skysim.core.errors import InputError
from skysim.core.yaml_reader import is_file, shown

# In lower case: MuJoCo finds <INCLUDE> too.
READ_AS_XML = {"include", "model"}
SIDES = ("right", "left", "up", "down", "front", "back")
FOLDERS = {"meshdir", "texturedir", "assetdir"}
FILES = {"file", *(f"file{side}" for side in SIDES)}
MOST_BYTES = 1 << 24  # of an XML file
MOST_PLACES = 100_000  # candidate paths of a model's files


class Named(NamedTuple):
    """A file or folder as a model names it."""

    value: str
    told: str  # which element names it, for the error message
    xml: bool


@dataclass
class Names:
    """Names found so far. A setting in one file affects the paths of another, so all files are collected together.

    bases : folders that a relative name may start from;  folders : values of meshdir and the like
    """

    folder: Path
    bases: set[str]
    folders: set[Named] = field(default_factory=set)
    files: set[Named] = field(default_factory=set)

    def add(self, path: Path) -> None:
        """Add the names in an XML file."""
        # Normalized, since a file that includes itself through `..` would otherwise give new folders without end.
        # The other two cover how the system resolves `..` after a link.
        self.bases |= {os.path.normpath(path.parent), str(path.parent.resolve()), str(path.resolve().parent)}
        for element in parsed(path).iter():
            tag = element.tag.lower()
            for key, value in element.attrib.items():
                if key.lower() in FOLDERS | FILES:
                    into = self.files if key.lower() in FILES else self.folders
                    into.add(
                        Named(value, f"{path}: {element.tag} {key}={shown(repr(value))}", tag in READ_AS_XML)
                    )

    def places(self) -> Iterator[tuple[Named, Path]]:
        """All paths where MuJoCo may look for each name. Some versions remove `..` before they follow links,
        some after.
        """
        between = {"", *(one.value for one in self.folders)}
        if len(self.bases) * len(between) * len(self.files) > MOST_PLACES:
            raise InputError(
                f"{self.folder}: the model names too many files; allowed: {MOST_PLACES} places of them"
            )
        for base in self.bases:
            for one in self.folders:
                yield from ((one, place) for place in both(base, one.value))
            for one in self.files:
                for name in {one.value, os.path.basename(one.value)}:  # strippath
                    for folder in between:
                        yield from ((one, place) for place in both(base, folder, name))


def both(*parts: str) -> tuple[Path, Path]:
    """A joined path as it is, and normalized (each `..` removed with the part before it)."""
    path = os.path.join(*parts)
    return Path(path), Path(os.path.normpath(path))


def confined(path: Path) -> None:
    """Raise InputError (one line) for a model that names files outside of its folder."""
    names, looked = Names(path.resolve().parent, set()), set[tuple[Named, Path]]()
    waiting, seen = [path], {same(path)}
    while waiting:
        for one in waiting:
            names.add(one)
        waiting = []
        for name, place in names.places():
            if (name, place) in looked:
                continue
            looked.add((name, place))
            check_place(name, place, names.folder)
            if name.xml and same(place) not in seen and is_file(place):
                waiting.append(place)
                seen.add(same(place))


def check_place(name: Named, place: Path, folder: Path) -> None:
    """Raise InputError (one line) for a path outside of the folder, and for one that is not a plain file."""
    if "\\" in name.value or not resolved(place).is_relative_to(folder):
        raise InputError(f"{name.told} leaves {folder}; allowed: files in it")
    if os.path.exists(place) and not (os.path.isfile(place) or os.path.isdir(place)):
        raise InputError(f"{name.told} is no plain file; allowed: files in {folder}")


def same(place: Path) -> tuple[str, Path, Path]:
    """Identity of a file: equal for two paths only if they are one file and relative names resolve alike."""
    return os.path.normpath(place), resolved(place.parent), resolved(place)


def resolved(place: Path) -> Path:
    """The path with all links followed; the root, which is in no folder, if links form a circle."""
    try:
        return place.resolve()
    except (OSError, RuntimeError):
        return Path("/")


def parsed(path: Path) -> ElementTree.Element:
    """The parsed XML, if MuJoCo's parser reads it the same way. Raises InputError with one line."""
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise unread(path, error) from None
    check(path, len(data) <= MOST_BYTES, f"up to {MOST_BYTES} bytes")
    check(path, b"<!DOCTYPE" not in data, "XML without DOCTYPE")
    try:
        # UTF-8 whatever the XML declaration says, as in MuJoCo.
        root = ElementTree.fromstring(data.decode("utf-8"))
    except (ElementTree.ParseError, ValueError) as error:
        raise unread(path, error) from None
    named = [name for element in root.iter() for name in (element.tag, *element.attrib)]
    check(path, not any("{" in name for name in named), "XML without namespaces")
    check(path, root.tag.lower() != "robot", "MJCF, no URDF")
    return root


def unread(path: Path, error: Exception) -> InputError:
    """The error for a file that cannot be read, or is not UTF-8 or not XML."""
    return InputError(f"{path}: not a MuJoCo model: {' '.join(str(error).split())}")


def check(path: Path, holds: bool, allowed: str) -> None:
    """Raise InputError (one line) where a rule for model files is violated."""
    if not holds:
        raise InputError(f"{path}: not a MuJoCo model that skysim reads; allowed: {allowed}")
