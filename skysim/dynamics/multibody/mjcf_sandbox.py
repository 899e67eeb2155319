"""A vehicle's model may be a stranger's: it names no file outside of its own folder, by itself or in what it includes.

MuJoCo would read any. It and we have to see the same names, so XML that two parsers could take differently is refused:
another encoding than UTF-8, a DOCTYPE, namespaces. And of the places where MuJoCo may look for a name all are checked.
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
MOST_PLACES = 100_000  # where a model's files might lie


class Named(NamedTuple):
    """A file or folder as a model names it."""

    value: str
    told: str  # by whom, in words
    xml: bool


@dataclass
class Names:
    """What has been found so far: a setting in one file moves the files of another, so all are taken together.

    bases : folders that a name may start from;  folders : what meshdir and its like put between
    """

    folder: Path
    bases: set[str]
    folders: set[Named] = field(default_factory=set)
    files: set[Named] = field(default_factory=set)

    def add(self, path: Path) -> None:
        """What an XML file names."""
        # Without `..`, or a file that includes itself by way of one would lie in ever new folders. What the system
        # makes of a `..` after a link is in the others.
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
        """Wherever MuJoCo may look for a name; it takes `..` away before links are followed, and others after."""
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
    """A joined path as it is, and with each `..` and what stands before it left out."""
    path = os.path.join(*parts)
    return Path(path), Path(os.path.normpath(path))


def confined(path: Path) -> None:
    """Refuse a model that leaves the folder it is in. Raises InputError with one line."""
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
    """Refuse a place outside of the folder, and what is there and no plain file. Raises InputError with one line."""
    if "\\" in name.value or not resolved(place).is_relative_to(folder):
        raise InputError(f"{name.told} leaves {folder}; allowed: files in it")
    if os.path.exists(place) and not (os.path.isfile(place) or os.path.isdir(place)):
        raise InputError(f"{name.told} is no plain file; allowed: files in {folder}")


def same(place: Path) -> tuple[str, Path, Path]:
    """What two places share that are one file, and from which the same names lead to the same places."""
    return os.path.normpath(place), resolved(place.parent), resolved(place)


def resolved(place: Path) -> Path:
    """The place with all links followed; of links in a circle the root, which is in no folder."""
    try:
        return place.resolve()
    except (OSError, RuntimeError):
        return Path("/")


def parsed(path: Path) -> ElementTree.Element:
    """The XML, if MuJoCo's parser and Python's read the same in it. Raises InputError with one line."""
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise unread(path, error) from None
    check(path, len(data) <= MOST_BYTES, f"up to {MOST_BYTES} bytes")
    check(path, b"<!DOCTYPE" not in data, "XML without DOCTYPE")
    try:
        # UTF-8 whatever its first line says: so MuJoCo does.
        root = ElementTree.fromstring(data.decode("utf-8"))
    except (ElementTree.ParseError, ValueError) as error:
        raise unread(path, error) from None
    named = [name for element in root.iter() for name in (element.tag, *element.attrib)]
    check(path, not any("{" in name for name in named), "XML without namespaces")
    check(path, root.tag.lower() != "robot", "MJCF, no URDF")
    return root


def unread(path: Path, error: Exception) -> InputError:
    """What to say of a file that cannot be read, is no UTF-8 or no XML."""
    return InputError(f"{path}: not a MuJoCo model: {' '.join(str(error).split())}")


def check(path: Path, holds: bool, allowed: str) -> None:
    """InputError with one line where a rule for a model's file does not hold."""
    if not holds:
        raise InputError(f"{path}: not a MuJoCo model that skysim reads; allowed: {allowed}")
