"""Files of on-board catalogs, .CAT: twenty bytes a star, with angles in fixed point and a checksum.

Fialho & Saotome 2005, section 3.2: "The stored fields are: right ascension, declination, instrumental magnitude, star
ID numbers, flags and checksum. [...] Right ascension and declination are stored using a custom fixed-point format." The
layout of PTASE's files is unpublished; this one has the same fields and cannot read them. It is little-endian:

    header   "SKYSIM.CAT" (12 bytes), epoch in 0.001 Julian years (4), number of entries (4)
    entry    right ascension and declination in 2^-32 turns (4 each), magnitude in 10^-6 mag (4), identifier (4),
             number of stars merged into the entry as flags (2), checksum (2)

The ten 16-bit words of an entry add up to 0 modulo 2^16. A unit of an angle is 0.3 milliarcseconds.
"""

from pathlib import Path

import numpy as np

from estimator.catalog.catalog import StarCatalog, from_angles
from estimator.catalog.published_catalogs import BYTES_PER_ENTRY, OnBoard
from estimator.core.errors import ImageError, file_bytes

HEADER = np.dtype([("magic", "S12"), ("epoch_milliyear", "<u4"), ("entries", "<u4")])
ENTRY = np.dtype(
    [
        ("ra", "<u4"),
        ("dec", "<i4"),
        ("magnitude", "<i4"),
        ("id", "<u4"),
        ("components", "<u2"),
        ("checksum", "<u2"),
    ]
)
MAGIC = b"SKYSIM.CAT"
UNITS_RAD = 2**32 / (2 * np.pi)  # units of an angle in a radian
UNITS_MAG = 1e6
assert ENTRY.itemsize == BYTES_PER_ENTRY


def encode(stars: OnBoard) -> bytes:
    """The bytes of a .CAT file."""
    header = np.array((MAGIC, round(1000 * stars.epoch_yr), len(stars)), HEADER)
    entries = np.zeros(len(stars), ENTRY)
    x, y, z = stars.vectors.T
    # A right ascension just below a whole turn rounds to 0.
    entries["ra"] = np.rint(UNITS_RAD * np.arctan2(y, x)).astype(np.int64) % 2**32
    entries["dec"] = np.rint(UNITS_RAD * np.arctan2(z, np.hypot(x, y)))
    entries["magnitude"] = np.rint(UNITS_MAG * stars.magnitude)
    entries["id"] = stars.id
    entries["components"] = stars.components
    entries["checksum"] = -_word_sums(entries) % 2**16
    return header.tobytes() + entries.tobytes()


def _word_sums(entries: np.ndarray) -> np.ndarray:
    """(N,) sums of the 16-bit words of each entry."""
    return entries.view("<u2").reshape(-1, BYTES_PER_ENTRY // 2).sum(axis=1, dtype=np.int64)


def read(path: str | Path) -> OnBoard:
    """Read a .CAT file.

    Raises
    ------
    ImageError
        For a file that cannot be read, of another format or length, and for a wrong checksum.
    """
    try:
        data = file_bytes(path)
    except OSError as error:
        raise _not_cat(path, error.strerror) from None
    if data[: len(MAGIC)] != MAGIC or len(data) < HEADER.itemsize:
        raise _not_cat(path, "its header is another")
    header = np.frombuffer(data, HEADER, 1)[0]
    count = int(header["entries"])
    if len(data) != HEADER.itemsize + BYTES_PER_ENTRY * count:
        raise _not_cat(path, f"{len(data)} bytes for {count} entries")
    entries = np.frombuffer(data, ENTRY, count, HEADER.itemsize)
    damaged = np.flatnonzero(_word_sums(entries) % 2**16)
    if len(damaged):
        raise _not_cat(path, f"wrong checksum of entry {damaged[0]}")
    vectors = from_angles(entries["ra"] / UNITS_RAD, entries["dec"] / UNITS_RAD)
    return OnBoard(
        entries["id"].astype(np.int64),
        vectors,
        entries["magnitude"] / UNITS_MAG,
        entries["components"].astype(np.int64),
        float(header["epoch_milliyear"]) / 1000,
    )


def _not_cat(path: str | Path, problem: object) -> ImageError:
    return ImageError(
        f"{path}: not a .CAT catalog ({problem}); allowed: a file of catalog readcat"
    )


def read_stars(path: str | Path) -> StarCatalog:
    """Read a .CAT file as a tracker's catalog, brightest first; its stars have no motion and no parallax."""
    on_board = read(path)
    count = len(on_board)
    return StarCatalog(
        on_board.id,
        on_board.vectors,
        np.zeros((count, 3)),
        np.zeros(count),
        on_board.magnitude,
        on_board.epoch_yr,
    ).brightest_first()
