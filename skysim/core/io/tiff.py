"""Directories of TIFF files, and of the EXIF blocks of JPEG and PNG files, which have the same structure."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

# Integer types of 8, 16, 32 and 64 bits. libtiff accepts signed types for a size too. All are read as unsigned, so a
# negative size, which libtiff rejects, is a huge one here.
INTEGER_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q", 6: "B", 8: "H", 9: "I", 17: "Q"}
WIDTH_TAG = 256
HEIGHT_TAG = 257
SAMPLES_TAG = 277
BITS_TAG = 258
PLANAR_TAG = 284
ORIENTATION_TAG = 274
EXIF_TAG = 34665
FOCAL_35MM_TAG = 41989
MAX_ENTRIES = 1 << 16


class Entry(NamedTuple):
    """An entry of a directory: its tag, type and number of values, and where its value field begins."""

    tag: int
    kind: int
    values: int
    at: int


@dataclass(frozen=True, slots=True)
class Tiff:
    """The structure of a TIFF file (TIFF 6.0, section 2) or a BigTIFF. Methods raise struct.error beyond its end."""

    data: bytes

    @property
    def order(self) -> str:
        """Byte order, as for struct."""
        return "<" if self.data.startswith(b"II") else ">"

    @property
    def is_big(self) -> bool:
        """Whether it is a BigTIFF, with offsets of 64 bits."""
        return self.number("H", 2) == 43

    def number(self, kind: str, at: int) -> int:
        """The integer of this type of struct at an offset."""
        return int(struct.unpack_from(self.order + kind, self.data, at)[0])

    def entries(self, at: int | None = None) -> Iterator[Entry]:
        """The entries of the directory at an offset, or of the first directory."""
        big = self.is_big
        if at is None:
            at = self.number("Q" if big else "I", 8 if big else 4)
        count = self.number("Q" if big else "H", at)
        size, head, value = (20, 8, 12) if big else (12, 2, 8)
        for n in range(min(count, MAX_ENTRIES)):
            begin = at + head + n * size
            tag = self.number("H", begin)
            kind = self.number("H", begin + 2)
            yield Entry(tag, kind, self.number("Q" if big else "I", begin + 4), begin + value)

    def value(self, entry: Entry) -> int | None:
        """The first value of an entry, if it is an integer in the entry itself; else None."""
        return (
            self.number(INTEGER_TYPES[entry.kind], entry.at)
            if entry.kind in INTEGER_TYPES
            else None
        )

    def most_bits(self, entry: Entry) -> int:
        """Bits of the first sample by a BITS_TAG, whose values are in the entry itself, or where it points to."""
        inside = entry.values * 2 <= (8 if self.is_big else 4)
        return self.number(
            "H", entry.at if inside else self.number("Q" if self.is_big else "I", entry.at)
        )


def image_size(data: bytes) -> tuple[int, int, int, int, bool] | None:
    """Width, height, samples a pixel, bits a sample, and whether the samples are planar; None without a size.

    Of a repeated tag the greatest value counts: libtiff uses the first.
    """
    tiff = Tiff(data)
    values = {WIDTH_TAG: 0, HEIGHT_TAG: 0, SAMPLES_TAG: 1, PLANAR_TAG: 1}
    bits = 8
    for entry in tiff.entries():
        if entry.tag in values:
            values[entry.tag] = max(values[entry.tag], tiff.value(entry) or 0)
        elif entry.tag == BITS_TAG:
            bits = max(bits, tiff.most_bits(entry))
    width, height, samples, planar = values.values()
    return (width, height, samples, bits, planar == 2) if width and height and samples else None


class Exif(NamedTuple):
    """What a camera wrote beside the pixels (Exif 2.32, CIPA DC-008).

    orientation : 1 to 8; 1 if the rows are stored as they are to be seen
    focal_35mm  : FocalLengthIn35mmFilm, mm; None if unknown
    """

    orientation: int = 1
    focal_35mm: int | None = None


def read_exif(data: bytes) -> Exif:
    """Orientation and focal length of an EXIF block or a TIFF file; the defaults for what is missing or damaged."""
    found: dict[int, int] = {}
    if not data.startswith(MAGICS):
        return Exif()
    try:
        tiff = Tiff(data)
        main = {entry.tag: tiff.value(entry) for entry in tiff.entries()}
        found |= {ORIENTATION_TAG: main.get(ORIENTATION_TAG) or 1}
        if at := main.get(EXIF_TAG):
            found |= {entry.tag: tiff.value(entry) or 0 for entry in tiff.entries(at)}
    except struct.error:  # it ends before its last entry
        pass
    orientation = found.get(ORIENTATION_TAG, 1)
    return Exif(orientation if 1 <= orientation <= 8 else 1, found.get(FOCAL_35MM_TAG) or None)
