"""Picture files (PNG, TIFF, JPEG, BMP) decoded, once their headers promise no more pixels than there is memory for.

A file of a megabyte may decompress to gigabytes. OpenCV goes by a file's first bytes and not by its name, and has
decoders that nobody needs here, so what is none of these four is no picture.
"""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.types import BadInput

MOST_PX = 1 << 28
MOST_BYTES = 8 * MOST_PX  # of a file: each pixel a double
DEFLATE = 1032  # times as many bytes come out of it at most (zlib's technical details)
SEGMENTS = 1000  # of a JPEG before its picture
ALONE = (0x01, *range(0xD0, 0xD8))  # TEM and RST: marks without a length
# TIFF: types of a whole number, 8, 16, 32 and 64 bits, and signed ones, which libtiff takes for a size as well (below 0
# it does not, and we see more than is allowed); tags of width, height and samples of a pixel.
WHOLE = {1: "B", 3: "H", 4: "I", 16: "Q", 6: "B", 8: "H", 9: "I", 17: "Q"}
WIDTH_TAG, HEIGHT_TAG, SAMPLES_TAG = 256, 257, 277


def read_picture(path: Path) -> NDArray:
    """The pixels as they are, (H, W) or (H, W, channels). Raises BadInput with one line."""
    data = path.read_bytes()
    check_picture(path, data)
    try:
        with silent_stderr():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise BadInput(f"{path}: cannot be decoded: {' '.join(str(error).split())}") from None
    if image is None:
        raise BadInput(f"{path}: cannot be decoded; it may be truncated or not an image")
    return image


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Keep C libraries quiet: libpng and OpenCV print their complaints on file descriptor 2 themselves."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def check_pixels(path: Path, *sides: int) -> None:
    """Raise BadInput for more pixels than MOST_PX."""
    if prod(sides) > MOST_PX:
        size = "x".join(map(str, sides)) if len(sides) < 5 else f"{prod(sides):.3g}"
        raise BadInput(f"{path}: {size} pixels by its header; allowed: up to {MOST_PX}")


def check_bytes(path: Path) -> None:
    """Raise BadInput for a file greater than the greatest picture."""
    held = path.stat().st_size
    if held > MOST_BYTES:
        raise BadInput(f"{path}: {held} bytes; allowed: up to {MOST_BYTES}")


def check_picture(path: Path, data: bytes) -> None:
    """Raise BadInput unless these are the bytes of a PNG, TIFF, JPEG or BMP file of no more pixels than allowed."""
    read = next((told for magic, told in FORMATS.items() if data.startswith(magic)), None)
    try:
        sizes = list(read(data)) if read else []
    except (struct.error, OverflowError):  # it ends within its header, or is told to go on beyond memory
        sizes = []
    if not sizes:
        raise BadInput(f"{path}: cannot be decoded; it may be truncated or not an image")
    for sides in sizes:
        check_pixels(path, *sides)


Sizes = Iterator[tuple[int, ...]]


def png(data: bytes) -> Sizes:
    """The first chunk is IHDR (PNG, section 11.2.2). None where more rows or a longer chunk are told than there can be.

    OpenCV takes the memory for a chunk before it reads it.
    """
    width, height, bits = struct.unpack_from(">IIB", data, 16)
    at, kind = 8, b""
    while kind != b"IEND" and at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        at += 12 + length
    held = at <= len(data) and height * (1 + width * bits // 8) <= DEFLATE * len(data)
    if held or width * height > MOST_PX:  # of so many the caller tells
        yield width, height


def bmp(data: bytes) -> Sizes:
    """The old header of 12 bytes has 16-bit sizes; a negative height is a picture that begins at its top."""
    old = struct.unpack_from("<I", data, 14)[0] == 12
    width, height = struct.unpack_from("<HH" if old else "<ii", data, 18)
    yield abs(width), abs(height)


def jpeg(data: bytes) -> Sizes:
    """Every start of a frame (SOF, ITU-T T.81, B.2.2) before the first scan.

    Between segments libjpeg passes over what is none; we read no further.
    """
    at = 2
    for _ in range(SEGMENTS):
        while data[at : at + 2] == b"\xff\xff":  # fill bytes
            at += 1
        mark, kind, length = struct.unpack_from(">BBH", data, at)
        if mark != 0xFF or kind in (0x00, 0xDA):
            return
        if kind in ALONE:
            at += 2
            continue
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            yield width, height
        at += 2 + length


def tiff(data: bytes) -> Sizes:
    """The first directory (TIFF 6.0, section 2), or BigTIFF's. The greatest of a tag that is there twice.

    Here alone a sample may have eight bytes, as a pixel of the other formats has at most.
    """
    order = "<" if data.startswith(b"II") else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    (at,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, at)
    entry, head, value = (20, 8, 12) if big else (12, 2, 8)
    sides = {WIDTH_TAG: 0, HEIGHT_TAG: 0, SAMPLES_TAG: 1}
    for n in range(min(count, 1 << 16)):
        begin = at + head + n * entry
        tag, kind = struct.unpack_from(order + "HH", data, begin)
        if tag in sides and kind in WHOLE:
            told = struct.unpack_from(order + WHOLE[kind], data, begin + value)[0]
            sides[tag] = max(sides[tag], told)
    if all(sides.values()):
        width, height, samples = sides.values()
        yield (width, height, samples) if samples > 1 else (width, height)


FORMATS: dict[bytes, Callable[[bytes], Sizes]] = {
    b"\x89PNG\r\n\x1a\n": png,
    b"\xff\xd8\xff": jpeg,
    b"BM": bmp,
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), tiff),
}
