"""Index of quads on disk, memory-mapped: that of a deep catalog takes seconds to build and a hundred megabytes.

A file is named by the SHA-256 of what its index is built from: directions, field, and the text FORM, which changes with
the method. Directions change with the date of the frames (aberration by up to 20", proper motion), so that another date
is another file. A file holds 32-bit words: `QuadIndex.first`, `star` and `code`, and last the CRC-32 of all words
before it. Compiled code reads rows without checks, so that an index is used only if this sum is right; any other file
is written again. It is written to a temporary name and renamed, so that several processes may start at once. Of the
files, the newest MOST_FILES are kept. Where the folder cannot be written, the index is built in memory.

The folder is ESTIMATOR_CACHE_DIR, or else `estimator` in XDG_CACHE_HOME or in ~/.cache.
"""

import hashlib
import mmap
import os
import tempfile
import zlib
from contextlib import suppress
from pathlib import Path
from weakref import WeakSet

import numpy as np

from estimator.catalog import quad_index
from estimator.catalog.quad_index import SIDE, QuadIndex
from estimator.catalog.sky_index import SkyIndex

FORM = b"quads 1"
# The index of fewer stars is built in a fraction of a second, and not kept.
FEW_STARS = 50_000
MOST_FILES = 8
HEAD = SIDE**4 + 1  # words of `first`
MAPPED = WeakSet[mmap.mmap]()  # maps of the files that are in use
WHOLE_CRC = 0x2144DF1C  # CRC-32 of any bytes followed by their CRC-32, the low byte first


def folder() -> Path:
    """Return the folder of the files."""
    user = os.getenv("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.getenv("ESTIMATOR_CACHE_DIR") or f"{user}/estimator").expanduser()


def quads(sky: SkyIndex, height_rad: float) -> QuadIndex:
    """Return the quads of a sky for fields of the given height: from their file, else built and written to it."""
    if len(sky.vectors) < FEW_STARS:
        return quad_index.build(sky, height_rad)
    key = hashlib.sha256(FORM + np.float64(height_rad).tobytes())
    key.update(sky.vectors.data)
    path = folder() / f"quads_{key.hexdigest()}.bin"
    with suppress(OSError, ValueError):
        return read(path)
    built = quad_index.build(sky, height_rad)
    with suppress(OSError, ValueError):
        path.parent.mkdir(parents=True, exist_ok=True)
        crc = 0
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            for array in (built.first, built.star, built.code):
                crc = zlib.crc32(array.data, crc)
                file.write(array.data)
            file.write(crc.to_bytes(4, "little"))
        os.replace(file.name, path)
        # The oldest files are removed.
        files = sorted(path.parent.glob("quads_*.bin"), key=os.path.getmtime)
        for old in files[:-MOST_FILES]:
            old.unlink()
        return read(path)
    return built


def release() -> None:
    """Give the pages of all mapped files back. They count as memory, and are mapped again where they are read."""
    for pages in list(MAPPED):
        if hasattr(pages, "madvise"):  # not on all systems
            pages.madvise(mmap.MADV_DONTNEED)


def read(path: Path) -> QuadIndex:
    """Map a file into memory. Raises OSError or ValueError if there is none, or if it is damaged."""
    crc = 0
    with path.open("rb") as file:
        # Read, not mapped: pages of the map count as memory of the process once they are touched.
        while part := file.read(2**20):
            crc = zlib.crc32(part, crc)
        # Copy on write: compiled code has one version, for arrays that can be written.
        pages = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    MAPPED.add(pages)
    words = np.frombuffer(pages, np.int32)
    if len(words) <= HEAD or crc != WHOLE_CRC:
        raise ValueError(f"{path}: damaged")
    star, code = words[HEAD:-1].reshape(2, -1, 4)
    return QuadIndex(star, code.view(np.float32), words[:HEAD])
