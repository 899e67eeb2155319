"""Read and compile MJCF files; report MuJoCo's errors in one line.

A file is not trusted, since MuJoCo itself would read any file that it names. `load` reads it in three steps:

1. `check_confined` checks that the file, and all that it includes, name only files within its own folder and only
   finite numbers. The check must see the same names as MuJoCo's parser. XML that two parsers could read differently
   is refused: encodings other than UTF-8, a DOCTYPE, namespaces. All paths at which MuJoCo may look for a name are
   checked.
2. `trial_fault` compiles the file in a child process with limits.
3. MuJoCo reads it.
"""

import itertools
import os.path
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self
from xml.etree import ElementTree

import mujoco

from skysim.core.errors import InputError, reason
from skysim.core.guarded import run_guarded
from skysim.core.paths import SCENES
from skysim.core.yaml_reader import excerpt, is_file

LAB_CAMERA = "lab"  # camera of an exported file that sees the whole laboratory

# 1. Files that a model names, and its numbers.

# Elements that name XML files. They are in lower case, since MuJoCo also reads <INCLUDE>.
XML_ELEMENTS = {"include", "model"}
CUBE_SIDES = ("right", "left", "up", "down", "front", "back")
FOLDER_ATTRIBUTES = {"meshdir", "texturedir", "assetdir"}
FILE_ATTRIBUTES = {"file", *(f"file{side}" for side in CUBE_SIDES)}
MAX_BYTES = 1 << 24  # of an XML file
MAX_NUMBER = 1e12  # in any unit; squares and cubes of it are finite
MAX_CANDIDATES = 100_000  # candidate paths of a model's files


class FileReference(NamedTuple):
    """A file or folder that a model names.

    Attributes
    ----------
    value
        Name as written
    source
        Element that names it, for the error message
    is_xml
        Whether it is an XML file that MuJoCo reads in turn
    """

    value: str
    source: str
    is_xml: bool


@dataclass
class References:
    """References found so far. A setting in one file affects the paths of another, so all files are collected together.

    Attributes
    ----------
    folder
        Folder of the model, which must contain all files
    bases
        Folders from which a relative name may start
    folders
        Values of meshdir and the like
    files
        References to files
    """

    folder: Path
    bases: set[str]
    folders: set[FileReference] = field(default_factory=set)
    files: set[FileReference] = field(default_factory=set)

    def add(self, path: Path) -> None:
        """Add the names in an XML file."""
        # Normalize, since a file that includes itself through `..` would otherwise give new folders without end.
        # The other two folders are those of a system that resolves `..` after a link.
        self.bases |= {
            os.path.normpath(path.parent),
            str(path.parent.resolve()),
            str(path.resolve().parent),
        }
        for element in xml_root(path).iter():
            is_xml = element.tag.lower() in XML_ELEMENTS
            for key, value in element.attrib.items():
                source = f"{path}: {element.tag} {key}={excerpt(repr(value))}"
                if key.lower() in FILE_ATTRIBUTES:
                    self.files.add(FileReference(value, source, is_xml))
                elif key.lower() in FOLDER_ATTRIBUTES:
                    self.folders.add(FileReference(value, source, is_xml))

    def candidates(self) -> Iterator[tuple[FileReference, Path]]:
        """All paths at which MuJoCo may look for each name.

        Some versions remove `..` before they follow links, some after.
        """
        subfolders = {"", *(reference.value for reference in self.folders)}
        if len(self.bases) * len(subfolders) * len(self.files) > MAX_CANDIDATES:
            raise InputError(
                self.folder,
                "the model names too many files",
                f"{MAX_CANDIDATES} candidate paths",
            )
        for base in self.bases:
            for reference in self.folders:
                for candidate in path_variants(base, reference.value):
                    yield reference, candidate
            for reference in self.files:
                # The compiler's option strippath leaves only the last part of a name.
                names = {reference.value, os.path.basename(reference.value)}
                for name, folder in itertools.product(names, subfolders):
                    for candidate in path_variants(base, folder, name):
                        yield reference, candidate


def path_variants(*parts: str) -> tuple[Path, Path]:
    """The joined path as it is, and normalized: each `..` removed with the part before it."""
    path = os.path.join(*parts)
    return Path(path), Path(os.path.normpath(path))


def check_confined(path: Path) -> None:
    """Raise InputError for a model that names files outside of its folder.

    Each pass collects the names in new XML files and checks all paths, since a new setting of meshdir changes the
    paths of earlier names. XML files found in a pass are read in the next one.
    """
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
            if (
                reference.is_xml
                and file_identity(candidate) not in visited
                and is_file(candidate)
            ):
                pending.append(candidate)
                visited.add(file_identity(candidate))


def check_candidate(reference: FileReference, candidate: Path, folder: Path) -> None:
    """Raise InputError for a path outside of the folder, and for one that is neither a plain file nor a folder."""
    if "\\" in reference.value or not resolved(candidate).is_relative_to(folder):
        raise InputError("", f"{reference.source} is outside {folder}", "files in it")
    if os.path.exists(candidate) and not (
        os.path.isfile(candidate) or os.path.isdir(candidate)
    ):
        raise InputError(
            "", f"{reference.source} is not a regular file", f"files in {folder}"
        )


def file_identity(path: Path) -> tuple[str, Path, Path]:
    """Identity of a file: equal for two paths only if they are one file and resolve relative names alike."""
    return os.path.normpath(path), resolved(path.parent), resolved(path)


def resolved(path: Path) -> Path:
    """The path with all links followed; the root, which is within no folder, if links form a circle."""
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        return Path("/")


def xml_root(path: Path) -> ElementTree.Element:
    """The parsed XML. Raises InputError unless MuJoCo's parser would read it the same way."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None
    require(path, len(data) <= MAX_BYTES, f"up to {MAX_BYTES} bytes")
    require(path, b"<!DOCTYPE" not in data, "XML without DOCTYPE")
    try:
        # Like MuJoCo, read UTF-8 whatever the XML declaration says.
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
    """Whether a word is no number, or a finite number up to MAX_NUMBER."""
    try:
        return abs(float(word)) <= MAX_NUMBER  # False for NaN
    except ValueError:
        return True


def unreadable(path: Path, error: Exception) -> InputError:
    """The error for a file that cannot be read, is not UTF-8 or is not XML."""
    return InputError(path, f"not a MuJoCo model: {reason(error)}")


def require(path: Path, condition: bool, allowed: str) -> None:
    """Raise InputError unless a condition for model files holds."""
    if not condition:
        raise InputError(path, "not a MuJoCo model that skysim reads", allowed)


# 2. and 3. Trial in a child process, and reading.

TRIAL = Path(__file__).parent / "mjcf_trial.py"
TRIAL_CPU_S = 3
TRIAL_BYTES = 1 << 30


def load(path: Path) -> Any:
    """The MJCF file as an MjSpec. Raises InputError if it is not a model that skysim reads."""
    if not path.is_file():
        raise InputError(
            path, "no such file; vehicle.model is a path relative to the scene or to scenes/"
        )
    check_confined(path)
    if fault := trial_fault(path, path.stat().st_mtime_ns):
        raise InputError(path, f"not a MuJoCo model that skysim reads: {fault}")
    with mujoco_errors(path, "not a MuJoCo model"):
        return mujoco.MjSpec.from_file(str(path))


@lru_cache(maxsize=64)
def trial_fault(path: Path, modified_ns: int) -> str:
    """One line on why MuJoCo does not survive the file; "" if it does. A shipped file needs no trial.

    Parameters
    ----------
    path
        MJCF file
    modified_ns
        Time of the last change; part of the cache's key, so a changed file is tried again
    """
    data = path.read_bytes()
    if any(data == shipped.read_bytes() for shipped in (SCENES / "vehicles").glob("*.xml")):
        return ""
    return run_guarded(TRIAL, str(path), cpu_s=TRIAL_CPU_S, memory_bytes=TRIAL_BYTES)


def compile_spec(spec: Any, path: Path) -> Any:
    """The compiled model of a spec that was read from path. Raises InputError with MuJoCo's message."""
    with mujoco_errors(path, "MuJoCo cannot compile it"):
        return spec.compile()


@contextmanager
def mujoco_errors(path: Path, problem: str) -> Iterator[None]:
    """Turn MuJoCo's errors into an InputError of a file."""
    try:
        yield
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(path, f"{problem}: {one_line(error)}") from error


class MujocoWarnings(list[str]):
    """MuJoCo's warnings in a `with` block; otherwise it prints them and appends them to a file where it runs."""

    def __enter__(self) -> Self:
        self.before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(self.append)
        return self

    def __exit__(self, *_: object) -> None:
        mujoco.set_mju_user_warning(self.before)


def one_line(error: Exception) -> str:
    """The message of an error with its line breaks removed."""
    return " ".join(str(error).split())
