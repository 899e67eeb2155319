"""PNG, TIFF, JPEG and BMP images, whose declared size is checked before OpenCV decodes them.

A few bytes of a damaged or hostile file can declare an image that exceeds the memory. Pillow reads the headers of JPEG
and BMP. PNG and TIFF headers are parsed here, because a PNG chunk can be as harmful as its size, and because Pillow
does not open TIFF files of 64-bit floats, or uses the last of a repeated tag where libtiff uses the first.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.core.io import decoding, tiff
from skysim.core.io.decoding import check_pixels, silent_stderr

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
    if complete or width * height > decoding.MAX_PIXELS:  # the caller reports an excessive size
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
    if size := tiff.image_size(data):
        width, height, samples, bits, _ = size
        yield (width, height, samples) if samples > 1 else (width, height), min(bits // 8, 8)


FORMATS: dict[bytes, Callable[[bytes], Sizes]] = {
    PNG_MAGIC: png_size,
    **dict.fromkeys((JPEG_MAGIC, BMP_MAGIC), pillow_size),
    **dict.fromkeys(tiff.MAGICS, tiff_size),
}


def check_planes(path: Path, data: bytes) -> None:
    """Raise InputError for a TIFF file of separate color planes, which OpenCV misreads unless they have 8 bits."""
    size = tiff.image_size(data) if data.startswith(tiff.MAGICS) else None
    if size and size[2] > 1 and size[3] > 8 and size[4]:
        raise InputError(
            path,
            f"a TIFF file of separate color planes (PlanarConfiguration 2) of {size[3]} bits",
            "interleaved colors, monochrome, or planes of 8 bits",
        )


def read_exif(data: bytes) -> tiff.Exif:
    """EXIF of a PNG, TIFF or JPEG file that can be decoded; the defaults without one.

    OpenCV has applied the orientation of a TIFF file, but not that of PNG and JPEG.
    """
    if data.startswith(tiff.MAGICS):
        return tiff.read_exif(data)._replace(orientation=1)
    if data.startswith(PNG_MAGIC):
        return tiff.read_exif(
            next((data[at:end] for kind, at, end in png_chunks(data) if kind == b"eXIf"), b"")
        )
    if data.startswith(JPEG_MAGIC):
        with opened_by_pillow(data) as image:
            return tiff.read_exif(image.info.get("exif", b"").removeprefix(b"Exif\0\0"))
    return tiff.Exif()


def upright(image: NDArray, orientation: int) -> NDArray:
    """The image as it is to be seen: (H, W, ...) turned and mirrored by EXIF's orientation, 1 to 8."""
    if orientation > 4:
        image = image.swapaxes(0, 1)
    rows, columns = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 0: (-1, 1)}[orientation % 4]
    return np.ascontiguousarray(image[::rows, ::columns])
