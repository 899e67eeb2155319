"""Atomic writes of files and folders, tables, images and JSON."""

import errno
import json
import os
import platform
import re
import shutil
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.errors import InputError, Where, shortened
from skysim.core.text import Line, read_lines
from skysim.core.types import Array, Record

HOST = f"{zlib.crc32(platform.node().encode()):08x}"  # distinguishes machines that share a folder

TEMPORARY_NAME = re.compile(rf"\..+\.skysim-{HOST}-(\d{{1,9}})(\.\w+)?")

ACTIVE_PATHS: set[Path] = set()  # temporary paths in use by this process


@contextmanager
def temporary_path(path: Path) -> Iterator[Path]:
    """Yield a hidden path beside `path` with host and process id, for a file or a folder that is removed at the end."""
    temporary = path.with_name(f".{path.stem}.skysim-{HOST}-{os.getpid()}{path.suffix}")
    ACTIVE_PATHS.add(temporary.absolute())
    try:
        yield temporary
    finally:
        remove(temporary)
        ACTIVE_PATHS.discard(temporary.absolute())


def remove_stale_temporaries(folder: Path) -> None:
    """Remove temporary files in the folder whose processes, of this machine, no longer run."""
    for path in folder.glob(".*.skysim-*"):
        match = TEMPORARY_NAME.fullmatch(path.name)
        if match and not writer_is_running(int(match[1]), path):
            # A permission error will surface at the next write.
            with suppress(OSError):
                remove(path)


def writer_is_running(pid: int, path: Path) -> bool:
    """Whether the process that was writing a file still runs."""
    # The number of this process may be one that an earlier process had.
    if pid == os.getpid():
        return path.absolute() in ACTIVE_PATHS
    # Signal 0 tests whether a process exists; it is not available on other systems.
    if os.name != "posix":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # it runs as another user
    return True


def remove(path: Path) -> None:
    """Remove a file or a folder if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


WHOLE = "nothing is half-written"  # what a write that fails leaves


@contextmanager
def name_in_errors(path: Path, needed_bytes: int = 0, left: str = WHOLE) -> Iterator[None]:
    """Re-raise an OSError with `path` and the system's own message.

    Some libraries do not name the file, or do not report a full disk by its error number.

    Parameters
    ----------
    needed_bytes
        Size of the whole file; 0 if it is not known
    left
        What a full disk leaves of the file
    """
    try:
        yield
    except OSError as error:
        # Some libraries report a full disk in the text only, as NumPy does: "9 requested and 4 written".
        full = error.errno in (None, errno.ENOSPC, errno.EDQUOT) and re.search(
            "(?i)space| written", str(error)
        )
        number = errno.ENOSPC if full else error.errno
        if number is None:
            raise
        reason = f"{os.strerror(number)}{'; ' + room_left(path, needed_bytes, left) if full else ''}"
        raise OSError(number, reason, str(path)) from error


def room_left(path: Path, needed_bytes: int = 0, left: str = WHOLE) -> str:
    """Text that says how much room is left for a file that could not be written; see `name_in_errors`."""
    needed = f" of {needed_bytes / 1e6:.3g} needed" if needed_bytes else ""
    return f"{shutil.disk_usage(path.parent).free / 1e6:.3g} MB are free{needed}, {left}"


@contextmanager
def atomic_file(path: Path, needed_bytes: int = 0) -> Iterator[Path]:
    """Yield a temporary path beside `path`, whose file replaces that of `path` at the end.

    If the body raises an exception, the temporary file is removed and `path` is unchanged. An error of a full disk
    names the size of the whole file, unless that is 0: not known.
    """
    # Removed first, so that its room counts as free.
    with name_in_errors(path, needed_bytes), temporary_path(path) as temporary:
        yield temporary
        os.replace(temporary, path)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """As `atomic_file`, for a folder, which replaces `path` and its previous content."""
    backup = path.with_name(f"{path.stem}.old{path.suffix}")
    with (
        name_in_errors(path),
        temporary_path(path) as temporary,
        temporary_path(backup) as old,
    ):
        yield temporary
        # Two renames are fast, and the old folder is removed afterward: an interruption leaves one of the two complete.
        if path.exists():
            path.rename(old)
        temporary.rename(path)


def make_folder(path: Path) -> Path:
    """The folder, created if it does not exist, without temporary files of killed processes.

    Raises
    ------
    InputError
        If it cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(path, f"cannot be created as a folder: {error.strerror}") from error
    remove_stale_temporaries(path)
    return path


def write_png16(path: Path, image_dn: Array) -> None:
    """Write digital numbers as a 16-bit PNG; those of a noise-free frame are rounded."""
    numbers = np.clip(np.rint(image_dn), 0, 65535).astype(np.uint16)
    write_image(path, numbers)


def write_image(path: Path, image: Array) -> None:
    """Write an image in the format of the path's suffix.

    Raises
    ------
    InputError
        If it cannot be encoded.
    OSError
        If it cannot be written.
    """
    import cv2  # slow to import

    # Some readers do not support compressed TIFF.
    uncompressed = (cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE)
    options = uncompressed if path.suffix == ".tif" else ()
    # Encode in memory, because OpenCV does not report why a file cannot be written.
    try:
        encoded, data = cv2.imencode(path.suffix, image, options)
    except cv2.error:
        encoded = False
    if not encoded:
        raise InputError(
            path,
            f"an image of {image.dtype} and shape {image.shape} cannot be encoded in this format",
        )
    write_bytes(path, data.data)


def write_table(path: Path, table: Any) -> None:
    """Write an astropy table as ECSV."""
    with atomic_file(path) as temporary:
        table.write(temporary, format="ascii.ecsv", overwrite=True)


@contextmanager
def strict_warnings() -> Iterator[None]:
    """Raise the warnings of astropy about a damaged file, and those of NumPy about numbers beyond their type."""
    from astropy.utils.exceptions import AstropyWarning

    with warnings.catch_warnings():
        for category in (AstropyWarning, RuntimeWarning):
            warnings.simplefilter("error", category)
        yield


MAX_HEADER_LINES = 5000  # of an ECSV table; a map's has some hundred


def read_table(path: Path) -> Any:
    """The astropy table in an ECSV file. Raises InputError if the file is not valid ECSV, with the first bad line."""
    from astropy.table import Table

    lines = read_lines(path)
    # Before it is parsed, which takes a second for a thousand lines.
    header = sum(line.startswith("#") for _, line in lines)
    if header > MAX_HEADER_LINES:
        raise InputError(path, f"a header of {header} lines", f"up to {MAX_HEADER_LINES}")

    def parse(some: list[Line]) -> Any:
        try:
            with strict_warnings():
                return Table.read([line for _, line in some], format="ascii.ecsv")
        except Exception as error:  # astropy's parsers raise many types
            return error

    def fails(some: list[Line]) -> bool:
        return isinstance(parse(some), Exception)

    if not isinstance(table := parse(lines), Exception):
        return table
    head = header + 1
    # The first bad row: each step reads the half of the rows in which it is.
    bad = head
    end = len(lines)
    while end - bad > 1:
        middle = (bad + end) // 2
        if fails([*lines[:head], *lines[bad:middle]]):
            end = middle
        else:
            bad = middle
    # With another row alone, the header is read.
    other = head + (bad == head)
    if fails([*lines[:head], *lines[other : other + 1]]):
        # A lookup that fails says nothing to a user: there are no such lines; nor do the words of a conversion.
        fault = "no lines" if isinstance(table, LookupError) else str(table).split(": ")[0]
        raise InputError(path, f"not an ECSV table: {shortened(fault, 120)}")
    raise Where(path, lines[bad][0]).error("no row of the table")


def header_numbers(path: Path, meta: Record, key: str, count: int) -> list[float]:
    """The `count` numbers under a key of an ECSV header.

    Raises InputError unless they are finite, and positive for a size or focal length.
    """
    try:
        numbers = np.atleast_1d(np.array(meta.get(key), dtype=float))
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    positive = key in ("size_px", "focal_px")
    valid = numbers.shape == (count,) and np.isfinite(numbers).all()
    if not valid or (positive and numbers.min() <= 0):
        what = (
            f"{count} finite number{'s' if count > 1 else ''}{' above 0' if positive else ''}"
        )
        raise InputError(path, f"{key} in the header is {meta.get(key)!r}", what)
    return [float(number) for number in numbers]


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8."""
    write_bytes(path, text.encode())


def write_json(path: Path, data: Any) -> None:
    """Write data as JSON."""
    write_text(path, to_json(data))


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Write a file of bytes."""
    with atomic_file(path, memoryview(data).nbytes) as temporary:
        temporary.write_bytes(data)


def to_json(data: Any) -> str:
    """JSON text of data, with null for NaN and infinity."""

    def without_nan(value: Any) -> Any:
        """The value with NumPy's arrays and numbers as Python's, paths as text, and None for NaN and infinity."""
        if isinstance(value, np.ndarray | np.generic):
            value = value.tolist()
        if isinstance(value, dict):
            return {key: without_nan(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [without_nan(item) for item in value]
        if isinstance(value, Path):
            return str(value)
        return None if isinstance(value, float) and not np.isfinite(value) else value

    return json.dumps(without_nan(data), indent=1, allow_nan=False)
