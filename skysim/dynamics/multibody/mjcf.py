"""Read and compile MJCF files; report MuJoCo's errors in one line."""

from __future__ import annotations

import math
import os.path
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mujoco

from skysim.core.errors import InputError
from skysim.core.files import SCENES
from skysim.core.guarded import run_guarded
from skysim.core.yaml_reader import excerpt, is_file

# Check that an untrusted MJCF file and all it includes name only files within its own folder, and
# only finite numbers.


# In lower case: MuJoCo finds <INCLUDE> too.
XML_ELEMENTS = {"include", "model"}
CUBE_SIDES = ("right", "left", "up", "down", "front", "back")
FOLDER_ATTRIBUTES = {"meshdir", "texturedir", "assetdir"}
FILE_ATTRIBUTES = {"file", *(f"file{side}" for side in CUBE_SIDES)}
MAX_BYTES = 1 << 24  # of an XML file
MAX_NUMBER = 1e12  # in any unit; squares and cubes of it are finite
MAX_CANDIDATES = 100_000  # candidate paths of a model's files


class FileReference(NamedTuple):
    """A file or folder as a model names it."""

    value: str
    source: str  # which element names it, for the error message
    is_xml: bool


@dataclass
class References:
    """References found so far. A setting in one file affects the paths of another, so all files are collected together.

    Attributes
    ----------
    bases
        Folders that a relative name may start from
    folders
        Values of meshdir and the like
    """

    folder: Path
    bases: set[str]
    folders: set[FileReference] = field(default_factory=set)
    files: set[FileReference] = field(default_factory=set)

    def add(self, path: Path) -> None:
        """Add the names in an XML file."""
        # Normalized, since a file that includes itself through `..` would otherwise give new folders without end.
        # The other two cover how the system resolves `..` after a link.
        self.bases |= {
            os.path.normpath(path.parent),
            str(path.parent.resolve()),
            str(path.resolve().parent),
        }
        for element in xml_root(path).iter():
            tag = element.tag.lower()
            for key, value in element.attrib.items():
                if key.lower() in FOLDER_ATTRIBUTES | FILE_ATTRIBUTES:
                    target = self.files if key.lower() in FILE_ATTRIBUTES else self.folders
                    target.add(
                        FileReference(
                            value,
                            f"{path}: {element.tag} {key}={excerpt(repr(value))}",
                            tag in XML_ELEMENTS,
                        )
                    )

    def candidates(self) -> Iterator[tuple[FileReference, Path]]:
        """All paths where MuJoCo may look for each name. Some versions remove `..` before they follow links,
        some after.
        """
        subfolders = {"", *(reference.value for reference in self.folders)}
        if len(self.bases) * len(subfolders) * len(self.files) > MAX_CANDIDATES:
            raise InputError(
                self.folder, "the model names too many files", f"{MAX_CANDIDATES} candidate paths"
            )
        for base in self.bases:
            for reference in self.folders:
                yield from (
                    (reference, candidate) for candidate in path_variants(base, reference.value)
                )
            for reference in self.files:
                for name in {reference.value, os.path.basename(reference.value)}:  # strippath
                    for folder in subfolders:
                        yield from (
                            (reference, candidate)
                            for candidate in path_variants(base, folder, name)
                        )


def path_variants(*parts: str) -> tuple[Path, Path]:
    """A joined path as it is, and normalized (each `..` removed with the part before it)."""
    path = os.path.join(*parts)
    return Path(path), Path(os.path.normpath(path))


def check_confined(path: Path) -> None:
    """Raise InputError (one line) for a model that names files outside of its folder."""
    references = References(path.resolve().parent, set())
    checked = set[tuple[FileReference, Path]]()
    pending = [path]
    visited = {file_identity(path)}
    while pending:
        for file in pending:
            references.add(file)
        pending = []
        for reference, candidate in references.candidates():
            if (reference, candidate) in checked:
                continue
            checked.add((reference, candidate))
            check_candidate(reference, candidate, references.folder)
            if reference.is_xml and file_identity(candidate) not in visited and is_file(candidate):
                pending.append(candidate)
                visited.add(file_identity(candidate))


def check_candidate(reference: FileReference, candidate: Path, folder: Path) -> None:
    """Raise InputError (one line) for a path outside of the folder, and for one that is not a plain file."""
    if "\\" in reference.value or not resolved(candidate).is_relative_to(folder):
        raise InputError("", f"{reference.source} is outside {folder}", "files in it")
    if os.path.exists(candidate) and not (os.path.isfile(candidate) or os.path.isdir(candidate)):
        raise InputError("", f"{reference.source} is not a regular file", f"files in {folder}")


def file_identity(path: Path) -> tuple[str, Path, Path]:
    """Identity of a file: equal for two paths only if they are one file and relative names resolve alike."""
    return os.path.normpath(path), resolved(path.parent), resolved(path)


def resolved(path: Path) -> Path:
    """The path with all links followed; the root, which is in no folder, if links form a circle."""
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        return Path("/")


def xml_root(path: Path) -> ElementTree.Element:
    """The parsed XML, if MuJoCo's parser reads it the same way. Raises InputError with one line."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None
    require(path, len(data) <= MAX_BYTES, f"up to {MAX_BYTES} bytes")
    require(path, b"<!DOCTYPE" not in data, "XML without DOCTYPE")
    try:
        # UTF-8 whatever the XML declaration says, as in MuJoCo.
        root = ElementTree.fromstring(data.decode("utf-8"))
    except (ElementTree.ParseError, ValueError) as error:
        raise unreadable(path, error) from None
    names = [name for element in root.iter() for name in (element.tag, *element.attrib)]
    require(path, not any("{" in name for name in names), "XML without namespaces")
    require(path, root.tag.lower() != "robot", "MJCF, not URDF")
    for element in root.iter():
        for key, value in element.attrib.items():
            if not all(map(is_moderate, value.split())):
                raise InputError(
                    path,
                    f"{element.tag} {key}={excerpt(repr(value))}",
                    f"finite numbers up to {MAX_NUMBER:g}",
                )
    return root


def is_moderate(word: str) -> bool:
    """False for a number that is not finite or is beyond MAX_NUMBER. Any other word is moderate."""
    try:
        return math.isfinite(number := float(word)) and abs(number) <= MAX_NUMBER
    except ValueError:
        return True


def unreadable(path: Path, error: Exception) -> InputError:
    """The error for a file that cannot be read, or is not UTF-8 or not XML."""
    return InputError(path, f"not a MuJoCo model: {error}")


def require(path: Path, condition: bool, allowed: str) -> None:
    """Raise InputError (one line) where a rule for model files is violated."""
    if not condition:
        raise InputError(path, "not a MuJoCo model that skysim reads", allowed)


TRIAL = Path(__file__).parent / "mjcf_trial.py"
TRIAL_CPU_S = 3
TRIAL_BYTES = 1 << 30


def load(path: Path) -> Any:
    """The MJCF file as an MjSpec."""
    if not path.is_file():
        raise InputError(
            path, "no such file; vehicle.model is a path relative to the scene or to scenes/"
        )
    check_confined(path)
    if fault := trial_fault(path, path.stat().st_mtime_ns):
        raise InputError(path, f"not a MuJoCo model that skysim reads: {fault}")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(path, f"not a MuJoCo model: {one_line(error)}") from error


@lru_cache(maxsize=64)
def trial_fault(path: Path, modified_ns: int) -> str:
    """Why MuJoCo does not survive the file, in one line; "" if it does. A shipped file needs no trial.

    Parameters
    ----------
    modified_ns
        So that a changed file is tried again
    """
    data = path.read_bytes()
    if any(data == shipped.read_bytes() for shipped in (SCENES / "vehicles").glob("*.xml")):
        return ""
    return run_guarded(TRIAL, str(path), cpu_s=TRIAL_CPU_S, memory_bytes=TRIAL_BYTES)


def compile_spec(spec: Any, path: Path) -> Any:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(path, f"MuJoCo cannot compile it: {one_line(error)}") from error


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would otherwise print and append to a file in the working folder."""
    caught: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(caught.append)
    try:
        yield caught
    finally:
        mujoco.set_mju_user_warning(before)


def one_line(error: Exception) -> str:
    return " ".join(str(error).split())
