"""Files that are being written: their names until they are whole, and those that a killed process left behind."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path

HOST = f"{zlib.crc32(platform.node().encode()):08x}"  # for folders that machines share
NAME = re.compile(rf"\..+\.skysim-{HOST}-(\d{{1,9}})(\.\w+)?")
WRITING: set[Path] = set()  # by this process


@contextlib.contextmanager
def being_written(path: Path) -> Iterator[Path]:
    """A hidden name beside `path` that tells who writes, for a file or a folder; what is there at the end vanishes."""
    temporary = path.with_name(f".{path.stem}.skysim-{HOST}-{os.getpid()}{path.suffix}")
    WRITING.add(temporary.absolute())
    try:
        yield temporary
    finally:
        remove(temporary)
        WRITING.discard(temporary.absolute())


def sweep(folder: Path) -> None:
    """Remove what processes of this machine that are no more were writing there."""
    for path in folder.glob(".*.skysim-*"):
        told = NAME.fullmatch(path.name)
        if told and not lives(int(told[1]), path):
            with contextlib.suppress(OSError):  # who may not, will be told as soon as something is written
                remove(path)


def lives(pid: int, path: Path) -> bool:
    """Whether the process that was writing a file still may. Our own number may have been another's before us."""
    if pid == os.getpid():
        return path.absolute() in WRITING
    if os.name != "posix":  # where there is no asking
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it is somebody else's
        return True
    return True


def remove(path: Path) -> None:
    """A file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
