"""PNG, TIFF, JPEG and BMP images, whose declared size is checked before OpenCV decodes them.

A few bytes of a damaged or hostile file can declare an image that exceeds the memory. Pillow reads the headers of JPEG
and BMP. PNG and TIFF headers are parsed here, because a PNG chunk can be as harmful as its size, and because Pillow
does not open TIFF files of 64-bit floats, or uses the last of a repeated tag where libtiff uses the first.
"""

from __future__ import annotations

import io
import os
import struct
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError

# Directories of TIFF files, and of the EXIF blocks of JPEG and PNG files, which have the same
# structure.


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


class TiffEntry(NamedTuple):
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

    def entries(self, at: int | None = None) -> Iterator[TiffEntry]:
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
            yield TiffEntry(tag, kind, self.number("Q" if big else "I", begin + 4), begin + value)

    def value(self, entry: TiffEntry) -> int | None:
        """The first value of an entry, if it is an integer in the entry itself; else None."""
        return (
            self.number(INTEGER_TYPES[entry.kind], entry.at)
            if entry.kind in INTEGER_TYPES
            else None
        )

    def most_bits(self, entry: TiffEntry) -> int:
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

    Attributes
    ----------
    orientation
        1 to 8; 1 if the rows are stored as they are to be seen
    focal_35mm
        FocalLengthIn35mmFilm, mm; None if unknown
    """

    orientation: int = 1
    focal_35mm: int | None = None


def read_exif_block(data: bytes) -> Exif:
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


# What the readers of images share: limits on the size by the header, and C libraries that print
# nothing.


MAX_PIXELS = 1 << 28
MAX_BYTES = 600 << 20  # of a file, and of its pixels when decoded: 2^28 of 16 bits, and a header


def check_pixels(path: Path, *sides: int, each_bytes: int = 1) -> None:
    """Raise InputError for more pixels than MAX_PIXELS, or more than MAX_BYTES when decoded."""
    size = "x".join(map(str, sides)) if len(sides) < 5 else f"{prod(sides):.3g}"
    if prod(sides) > MAX_PIXELS:
        raise InputError(path, f"{size} pixels by its header", f"up to {MAX_PIXELS}")
    if (size_bytes := prod(sides) * each_bytes) > MAX_BYTES:
        raise InputError(
            path, f"{size} pixels of {size_bytes} bytes by its header", f"up to {MAX_BYTES} bytes"
        )


def check_bytes(path: Path) -> None:
    """Raise InputError for a file larger than the largest allowed image."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(path, f"{size} bytes", f"up to {MAX_BYTES}")


@contextmanager
def silent_opencv() -> Iterator[None]:
    """Suppress OpenCV's own messages, for example about a missing camera."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Suppress output of C libraries: libpng and OpenCV write their messages directly to file descriptor 2."""
    sys.stderr.flush()
    saved = os.dup(2)
    devnull = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(devnull, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(devnull)


MAX_DEFLATE_RATIO = 1032  # greatest compression ratio of deflate (zlib's technical details)
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
BMP_MAGIC = b"BM"
SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")


def decode_image(path: Path, data: bytes) -> NDArray:
    """The pixels of a file's bytes, (H, W) or (H, W, channels), blue first. Raises InputError with one line.

    OpenCV turns a TIFF image as its orientation says, and leaves PNG and JPEG as stored.
    """
    check_encoded_size(path, data)
    check_planes(path, data)
    try:
        with silent_stderr():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(path, f"cannot be decoded: {error}") from None
    if image is None:
        raise InputError(path, "cannot be decoded; it may be truncated or not an image")
    return image


def check_encoded_size(path: Path, data: bytes) -> None:
    """Raise InputError unless these are the bytes of a PNG, TIFF, JPEG or BMP file with at most MAX_PIXELS pixels."""
    reader = next((reader for magic, reader in FORMATS.items() if data.startswith(magic)), None)
    try:
        sizes = list(reader(data)) if reader else []
    except Exception:  # of many types, from Pillow or struct, for a truncated or damaged header
        sizes = []
    if not sizes:
        raise InputError(path, "cannot be decoded; it may be truncated or not an image")
    for sides, each_bytes in sizes:
        check_pixels(path, *sides, each_bytes=each_bytes)


Sizes = Iterator[
    tuple[tuple[int, ...], int]
]  # width and height, and the bytes of each pixel as OpenCV decodes it
PNG_SAMPLES = {
    0: 1,
    2: 3,
    3: 4,
    4: 4,
    6: 4,
}  # by color type: OpenCV adds colors to gray with alpha, alpha to a palette


def png_size(data: bytes) -> Sizes:
    """Size from IHDR, the first chunk (PNG, section 11.2.2); nothing if a chunk or the rows exceed the file.

    OpenCV allocates memory for a chunk before it reads it, so every chunk must end within the file, and the rows must
    be no more than the file can hold at deflate's greatest compression.
    """
    width, height, bits, color = struct.unpack_from(">IIBB", data, 16)
    end = [chunk_end for _, _, chunk_end in png_chunks(data)][-1] + 4  # behind the chunk's checksum
    complete = end <= len(data) and height * (1 + width * bits // 8) <= MAX_DEFLATE_RATIO * len(
        data
    )
    if complete or width * height > MAX_PIXELS:  # the caller reports an excessive size
        yield (width, height), PNG_SAMPLES.get(color, 4) * max(bits // 8, 1)


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Kind of each chunk, and where its body begins and ends, up to IEND (PNG, section 5.3)."""
    at = len(PNG_MAGIC)
    kind = b""
    while kind != b"IEND" and at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        yield kind, at + 8, at + 8 + length
        at += 12 + length


def pillow_size(data: bytes) -> Sizes:
    """Size of a JPEG or BMP file."""
    with opened_by_pillow(data) as image:
        yield image.size, 1 if image.mode in ("1", "L") else 4


@contextmanager
def opened_by_pillow(data: bytes) -> Iterator[Any]:
    """A JPEG or BMP file as an image of Pillow, which reads the header only; its warnings are left out."""
    from PIL import BmpImagePlugin, JpegImagePlugin

    # The class, not Image.open: that has a limit of its own.
    plugin = (
        BmpImagePlugin.BmpImageFile if data.startswith(BMP_MAGIC) else JpegImagePlugin.JpegImageFile
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of damaged EXIF
        with plugin(io.BytesIO(data)) as image:
            yield image


def tiff_size(data: bytes) -> Sizes:
    """Size from the first directory. Only here are samples counted as pixels, because each may have eight bytes."""
    if size := image_size(data):
        width, height, samples, bits, _ = size
        yield (width, height, samples) if samples > 1 else (width, height), min(bits // 8, 8)


FORMATS: dict[bytes, Callable[[bytes], Sizes]] = {
    PNG_MAGIC: png_size,
    **dict.fromkeys((JPEG_MAGIC, BMP_MAGIC), pillow_size),
    **dict.fromkeys(MAGICS, tiff_size),
}


def check_planes(path: Path, data: bytes) -> None:
    """Raise InputError for a TIFF file of separate color planes, which OpenCV misreads unless they have 8 bits."""
    size = image_size(data) if data.startswith(MAGICS) else None
    if size and size[2] > 1 and size[3] > 8 and size[4]:
        raise InputError(
            path,
            f"a TIFF file of separate color planes (PlanarConfiguration 2) of {size[3]} bits",
            "interleaved colors, monochrome, or planes of 8 bits",
        )


def read_exif(data: bytes) -> Exif:
    """EXIF of a PNG, TIFF or JPEG file that can be decoded; the defaults without one.

    OpenCV has applied the orientation of a TIFF file, but not that of PNG and JPEG.
    """
    if data.startswith(MAGICS):
        return read_exif_block(data)._replace(orientation=1)
    if data.startswith(PNG_MAGIC):
        return read_exif_block(
            next((data[at:end] for kind, at, end in png_chunks(data) if kind == b"eXIf"), b"")
        )
    if data.startswith(JPEG_MAGIC):
        with opened_by_pillow(data) as image:
            return read_exif_block(image.info.get("exif", b"").removeprefix(b"Exif\0\0"))
    return Exif()


def upright(image: NDArray, orientation: int) -> NDArray:
    """The image as it is to be seen: (H, W, ...) turned and mirrored by EXIF's orientation, 1 to 8."""
    if orientation > 4:
        image = image.swapaxes(0, 1)
    rows, columns = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 0: (-1, 1)}[orientation % 4]
    return np.ascontiguousarray(image[::rows, ::columns])
