"""PNG, TIFF, JPEG, BMP, WebP and PGM or PPM images, whose declared size is checked before OpenCV decodes them.

A few bytes of a damaged or hostile file can declare an image that exceeds the memory. Pillow reads the headers of JPEG,
BMP and PGM. Those of PNG, WebP and TIFF are parsed here: the chunks of a PNG can be as harmful as its size, Pillow
decodes a WebP to open it, does not open TIFF files of 64-bit floats and uses the last of a repeated tag where libtiff
uses the first.
"""

import contextlib
import io
import os
import struct
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from math import prod
from pathlib import Path
from struct import calcsize
from typing import Any, NamedTuple

import cv2
import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Array, frozen

# Directories of TIFF files, and of the EXIF blocks of JPEG and PNG files, which have the same structure.

MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

# Integer types of 8, 16, 32 and 64 bits. libtiff also accepts signed types for a size. All are read as unsigned, so a
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
MAX_DIRECTORIES = 1000
# A reduced version of another image, in the bits of SUBFILE_TAG; white is 0, by PHOTOMETRIC_TAG.
SUBFILE_TAG = 254
REDUCED = 1
PHOTOMETRIC_TAG = 262
WHITE_IS_ZERO = 0
BLACK_IS_ZERO = 1
COLOR_FILTERS = (
    32803  # a mosaic of color filters (TIFF/EP, ISO 12234-2); OpenCV does not read it
)


class TiffEntry(NamedTuple):
    """An entry of a directory: its tag, type, number of values, and the offset of its value field."""

    tag: int
    kind: int
    values: int
    at: int


@frozen
class Tiff:
    """The structure of a TIFF file (TIFF 6.0, section 2) or a BigTIFF. Methods raise struct.error beyond its end."""

    data: bytes

    @property
    def order(self) -> str:
        """Byte order as a format character of the module struct."""
        return "<" if self.data.startswith(b"II") else ">"

    @property
    def kinds(self) -> tuple[str, str]:
        """Format characters of the number of entries and of an offset: a BigTIFF has both of 64 bits."""
        return ("Q", "Q") if self.number("H", 2) == 43 else ("H", "I")

    def number(self, kind: str, at: int) -> int:
        """The integer at an offset; `kind` is its format character in the module struct."""
        return int(struct.unpack_from(self.order + kind, self.data, at)[0])

    def directories(self) -> Iterator[int]:
        """Yield the offsets of the first MAX_DIRECTORIES directories, one for each image."""
        count, offset = self.kinds
        place = calcsize(offset)
        size = 4 + 2 * place  # of an entry: tag, type, number of values, value field
        for _ in range(MAX_DIRECTORIES):
            at = self.number(offset, place)
            if not at:
                return
            yield at
            place = at + calcsize(count) + size * self.number(count, at)

    def entries(self, at: int | None = None) -> Iterator[TiffEntry]:
        """Yield the entries of the directory at an offset, or of the first directory."""
        count, offset = self.kinds
        if at is None:
            at = next(self.directories(), 0)
        value = 4 + calcsize(offset)  # offset of the value field in an entry
        begin = at + calcsize(count)
        for _ in range(min(self.number(count, at), MAX_ENTRIES)):
            tag = self.number("H", begin)
            kind = self.number("H", begin + 2)
            yield TiffEntry(tag, kind, self.number(offset, begin + 4), begin + value)
            begin += value + calcsize(offset)

    def value(self, entry: TiffEntry) -> int | None:
        """The first value of an entry, if it is an integer in the entry itself; else None."""
        if entry.kind not in INTEGER_TYPES:
            return None
        return self.number(INTEGER_TYPES[entry.kind], entry.at)


def image_size(data: bytes, at: int | None = None) -> tuple[int, int, int, int, bool] | None:
    """Width, height, samples per pixel, bits per sample, and whether samples are planar; None without a size.

    They are those of the directory at an offset, or of the first one. The greatest value of a repeated tag counts,
    since libtiff uses the first.
    """
    tiff = Tiff(data)
    values = {WIDTH_TAG: 0, HEIGHT_TAG: 0, SAMPLES_TAG: 1, PLANAR_TAG: 1}
    bits = 8
    for entry in tiff.entries(at):
        if entry.tag in values:
            values[entry.tag] = max(values[entry.tag], tiff.value(entry) or 0)
        elif entry.tag == BITS_TAG:
            # The values are in the entry itself, or at an offset in it.
            offset = tiff.kinds[1]
            inside = entry.values * 2 <= calcsize(offset)
            place = entry.at if inside else tiff.number(offset, entry.at)
            bits = max(bits, tiff.number("H", place))
    width, height, samples, planar = values.values()
    return (
        (width, height, samples, bits, planar == 2) if width and height and samples else None
    )


class Exif(NamedTuple):
    """Metadata that a camera wrote with the pixels (Exif 2.32, CIPA DC-008).

    Attributes
    ----------
    orientation
        1 to 8; 1 if the stored image is upright
    focal_35mm
        FocalLengthIn35mmFilm in mm; None if unknown
    """

    orientation: int = 1
    focal_35mm: int | None = None


def read_exif_block(data: bytes) -> Exif:
    """Orientation and focal length in an EXIF block or a TIFF file; defaults for values that are missing or damaged."""
    found: dict[int, int] = {}
    if not data.startswith(MAGICS):
        return Exif()
    try:
        tiff = Tiff(data)
        main = {entry.tag: tiff.value(entry) for entry in tiff.entries()}
        found |= {ORIENTATION_TAG: main.get(ORIENTATION_TAG) or 1}
        if at := main.get(EXIF_TAG):
            found |= {entry.tag: tiff.value(entry) or 0 for entry in tiff.entries(at)}
    except struct.error:
        pass  # the block ends before its last entry
    orientation = found.get(ORIENTATION_TAG, 1)
    return Exif(
        orientation if 1 <= orientation <= 8 else 1, found.get(FOCAL_35MM_TAG) or None
    )


# Limits of the size, and output of C libraries.

MAX_PIXELS = 1 << 28
MAX_BYTES = 600 << 20  # of a file, and of its decoded pixels: 2^28 of 16 bits, and a header


def check_pixels(path: Path, *sides: int, each_bytes: int = 1) -> None:
    """Raise InputError for more pixels than MAX_PIXELS, or for more than MAX_BYTES after decoding."""
    size = "x".join(map(str, sides)) if len(sides) < 5 else f"{prod(sides):.3g}"
    if prod(sides) > MAX_PIXELS:
        raise InputError(path, f"{size} pixels by its header", f"up to {MAX_PIXELS}")
    if (size_bytes := prod(sides) * each_bytes) > MAX_BYTES:
        raise InputError(
            path,
            f"{size} pixels of {size_bytes} bytes by its header",
            f"up to {MAX_BYTES} bytes",
        )


SILENCE = (
    threading.Lock()
)  # threads in turn: one would save what another has put in the place of stderr


@contextlib.contextmanager
def silent_stderr() -> Iterator[None]:
    """Suppress output of C libraries: libpng and OpenCV write messages directly to file descriptor 2."""
    with SILENCE:
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


# Decoding.

MAX_DEFLATE_RATIO = 1032  # greatest compression ratio of deflate (zlib's technical details)
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
BMP_MAGIC = b"BM"
WEBP_MAGIC = b"RIFF"
PNM_MAGICS = (b"P2", b"P3", b"P5", b"P6")  # PGM and PPM, as text and binary
SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".webp", ".pgm", ".ppm")


def decode_images(path: Path, data: bytes) -> tuple[list[Array], bool]:
    """The images (H, W) or (H, W, channels), blue first, of a file's bytes, and whether they are raw Bayer frames.

    OpenCV applies the orientation of a TIFF file, but not that of PNG and JPEG. Raises InputError.
    """
    check_encoded_size(path, data)
    data, pages, is_mosaic = check_tiff(path, data)
    buffer = np.frombuffer(data, np.uint8)
    try:
        with silent_stderr():
            images: Any = (cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED),)
            if pages != [0]:
                images = cv2.imdecodemulti(buffer, cv2.IMREAD_UNCHANGED)[1]
    except cv2.error as error:
        raise InputError(path, f"cannot be decoded: {error}") from None
    if len(images) <= max(pages) or images[0] is None:
        raise InputError(path, "cannot be decoded; it may be truncated or not an image")
    return [images[page] for page in pages], is_mosaic


def check_encoded_size(path: Path, data: bytes) -> None:
    """Raise InputError unless these are the bytes of an image of FORMATS with at most MAX_PIXELS pixels."""
    reader = next(
        (reader for magic, reader in FORMATS.items() if data.startswith(magic)), None
    )
    try:
        sizes = list(reader(data)) if reader else []
    except Exception:
        sizes = []  # Pillow and struct raise many types of exception for a damaged header
    if not sizes:
        raise InputError(path, "cannot be decoded; it may be truncated or not an image")
    for sides, each_bytes in sizes:
        check_pixels(path, *sides, each_bytes=each_bytes)
    total = sum(prod(sides) for sides, _ in sizes)
    check_pixels(path, total, each_bytes=max(each_bytes for _, each_bytes in sizes))


# Width and height, and the bytes of each pixel as decoded by OpenCV.
Sizes = Iterator[tuple[tuple[int, ...], int]]
# Samples by color type: OpenCV adds colors to gray with alpha, and alpha to a palette.
PNG_SAMPLES = {0: 1, 2: 3, 3: 4, 4: 4, 6: 4}


def png_size(data: bytes) -> Sizes:
    """Yield the size from IHDR, the first chunk (PNG, section 11.2.2); nothing if a chunk or the rows exceed the file.

    OpenCV allocates memory for a chunk before it reads it, so every chunk must end within the file. The rows must not
    exceed what the file can hold at deflate's greatest compression.
    """
    width, height, bits, color = struct.unpack_from(">IIBB", data, 16)
    # A checksum of four bytes follows the last chunk.
    end = [chunk_end for _, _, chunk_end in png_chunks(data)][-1] + 4
    rows_bytes = height * (1 + width * bits // 8)
    complete = end <= len(data) and rows_bytes <= MAX_DEFLATE_RATIO * len(data)
    # The caller reports an excessive size.
    if complete or width * height > MAX_PIXELS:
        yield (width, height), PNG_SAMPLES.get(color, 4) * max(bits // 8, 1)


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, begin and end of the body of each chunk up to IEND (PNG, section 5.3)."""
    at = len(PNG_MAGIC)
    kind = b""
    while kind != b"IEND" and at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        yield kind, at + 8, at + 8 + length
        at += 12 + length


def pillow_size(data: bytes) -> Sizes:
    """Yield the size of a JPEG, BMP, PGM or PPM file."""
    with opened_by_pillow(data) as image:
        yield image.size, 1 if image.mode in ("1", "L") else 4


@contextlib.contextmanager
def opened_by_pillow(data: bytes) -> Iterator[Any]:
    """A file as an image of Pillow, which reads only the header; its warnings are suppressed."""
    from PIL import BmpImagePlugin, JpegImagePlugin, PpmImagePlugin

    # Image.open has its own limit of size, so its class is used.
    plugin: Any = PpmImagePlugin.PpmImageFile
    if data.startswith(BMP_MAGIC):
        plugin = BmpImagePlugin.BmpImageFile
    elif data.startswith(JPEG_MAGIC):
        plugin = JpegImagePlugin.JpegImageFile
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of damaged EXIF
        with plugin(io.BytesIO(data)) as image:
            yield image


def webp_size(data: bytes) -> Sizes:
    """Yield the size of the canvas (WebP container specification), or of a single lossless or lossy image."""
    if data[12:16] == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") for at in (24, 27))
    elif data[12:16] == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        width, height = (bits & 0x3FFF, bits >> 14 & 0x3FFF)
    else:
        width, height = (side - 1 & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    yield (width + 1, height + 1), 4


def tiff_size(data: bytes) -> Sizes:
    """Yield the size of each directory; samples count as pixels, because each may have eight bytes."""
    with contextlib.suppress(struct.error):  # the file ends before its last directory
        for at in Tiff(data).directories():
            if size := image_size(data, at):
                width, height, samples, bits, _ = size
                sides = (width, height, samples) if samples > 1 else (width, height)
                yield sides, min(bits // 8, 8)


FORMATS: dict[bytes, Callable[[bytes], Sizes]] = {
    PNG_MAGIC: png_size,
    **dict.fromkeys((JPEG_MAGIC, BMP_MAGIC, *PNM_MAGICS), pillow_size),
    WEBP_MAGIC: webp_size,
    **dict.fromkeys(MAGICS, tiff_size),
}


def check_tiff(path: Path, data: bytes) -> tuple[bytes, list[int], bool]:
    """Raise InputError for a TIFF file that OpenCV misreads.

    It misreads separate color planes unless they have 8 bits, and inverts white zeros in some formats only. Reduced
    versions of an image are no images of their own.

    Returns
    -------
    The file for OpenCV, in which a mosaic is a gray image; the numbers of its images; whether one is a mosaic
    """
    pages = []
    is_mosaic = False
    tiff = Tiff(data)
    with contextlib.suppress(struct.error):  # the file ends before its last directory
        for number, at in enumerate(tiff.directories() if data.startswith(MAGICS) else ()):
            entries = {entry.tag: entry for entry in tiff.entries(at)}
            tags = {tag: tiff.value(entry) for tag, entry in entries.items()}
            if tags.get(PHOTOMETRIC_TAG) == WHITE_IS_ZERO:
                raise InputError(
                    path,
                    "a TIFF file in which 0 is white (PhotometricInterpretation 0)",
                    "1, 0 is black",
                )
            size = image_size(data, at)
            if size and size[2] > 1 and size[3] > 8 and size[4]:
                raise InputError(
                    path,
                    f"a TIFF file of separate color planes (PlanarConfiguration 2) of {size[3]} bits",
                    "interleaved colors, monochrome, or planes of 8 bits",
                )
            if tags.get(PHOTOMETRIC_TAG) == COLOR_FILTERS:
                is_mosaic = True
                place = entries[PHOTOMETRIC_TAG].at
                gray = struct.pack(f"{tiff.order}H", BLACK_IS_ZERO)
                data = data[:place] + gray + data[place + 2 :]
            if not (tags.get(SUBFILE_TAG) or 0) & REDUCED:
                pages.append(number)
    return data, pages or [0], is_mosaic


def read_exif(data: bytes) -> Exif:
    """EXIF of a PNG, TIFF or JPEG file that can be decoded; defaults without it.

    The orientation of a TIFF file is 1, because OpenCV has applied it.
    """
    if data.startswith(MAGICS):
        return read_exif_block(data)._replace(orientation=1)
    if data.startswith(PNG_MAGIC):
        # Chunks after eXIf are not read: the file may end in one of them.
        blocks = (data[at:end] for kind, at, end in png_chunks(data) if kind == b"eXIf")
        return read_exif_block(next(blocks, b""))
    if data.startswith(JPEG_MAGIC):
        with opened_by_pillow(data) as image:
            return read_exif_block(image.info.get("exif", b"").removeprefix(b"Exif\0\0"))
    return Exif()


def upright(image: Array, orientation: int) -> Array:
    """The upright image (H, W, ...): rotated and mirrored by EXIF's orientation, 1 to 8."""
    # Orientations above 4 are transposed; the other two bits mirror rows and columns.
    if orientation > 4:
        image = image.swapaxes(0, 1)
    rows, columns = {1: (1, 1), 2: (1, -1), 3: (-1, -1), 0: (-1, 1)}[orientation % 4]
    return np.ascontiguousarray(image[::rows, ::columns])
