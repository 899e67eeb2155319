"""Image files (FITS, PNG, TIFF, JPEG, BMP) and frames of a live camera, read with limits on their size.

A few bytes of a damaged or hostile file can declare an image that exceeds the memory. The declared size is therefore
read from the header, and checked, before astropy or OpenCV decodes the file: by astropy for FITS and by Pillow for JPEG
and BMP. PNG and TIFF headers are parsed here, because a PNG chunk can be as harmful as its size, and because Pillow
does not open TIFF files of 64-bit floats, or uses the last of a repeated tag where libtiff uses the first.
"""

from __future__ import annotations

import contextlib
import datetime
import io
import os
import re
import struct
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from math import prod
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.core.guard.process import run_guarded

FITS_SUFFIXES = (".fits", ".fit", ".fts")
FITS_MAGIC = b"SIMPLE  ="  # start of every FITS file; a compressed one differs, which astropy would unpack
MAX_HDUS = 1000  # that are searched for an image
CARD_BYTES = 80  # a line of a header
AXES, MAX_AXES = re.compile(rb"NAXIS *= *(\d+)"), 999  # FITS standard 4.0, section 4.4.1.1
MAX_COLUMNS = 999  # of a table (FITS standard 4.0, section 7.3.1)
TILES_CPU_S, TILES_BYTES = 10, 1 << 31  # for a compressed image


@contextmanager
def open_fits(path: Path) -> Iterator[BinaryIO]:
    """The file for astropy, with its warnings as errors: past a warning it may read a damaged file endlessly."""
    from astropy.utils.exceptions import AstropyWarning

    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)  # "file may have been truncated" is one
        if file.read(len(FITS_MAGIC)) != FITS_MAGIC:
            raise InputError(f"{path}: not a complete FITS file; allowed: one that begins with SIMPLE, not compressed")
        file.seek(0)
        check_axes(path, file)
        yield file


def check_axes(path: Path, file: BinaryIO, start: int = 0) -> None:
    """Refuse the header that begins at `start` if it has more axes than the standard.

    astropy makes a list of as many entries as NAXIS says when it opens a header. Raises InputError; the file is left
    where it was.
    """
    before = file.tell()
    file.seek(start)
    while (card := file.read(CARD_BYTES)) and card.rstrip() != b"END":
        if (hit := AXES.match(card)) and int(hit[1]) > MAX_AXES:
            raise InputError(f"{path}: NAXIS {int(hit[1])}; allowed: up to {MAX_AXES} axes")
    file.seek(before)


def read_fits(path: Path) -> NDArray:
    """The pixels of the first image, in the machine's byte order. Raises InputError with one line."""
    from astropy.io import fits

    try:
        with open_fits(path) as file, fits.open(file, memmap=False, disable_image_compression=True) as hdus:
            for number, hdu in enumerate(islice(hdus, MAX_HDUS)):
                # From the header, before the data is read or skipped.
                if (columns := hdu.header.get("TFIELDS", 0)) > MAX_COLUMNS:
                    raise InputError(f"{path}: TFIELDS {columns}; allowed: up to {MAX_COLUMNS} columns")
                if hdu.header.get("ZIMAGE"):
                    sides = (int(hdu.header[f"ZNAXIS{n}"]) for n in range(hdu.header["ZNAXIS"], 0, -1))
                    check_pixels(path, *sides, each_bytes=abs(int(hdu.header.get("ZBITPIX", 8))) // 8)
                    return decode_tiles(path, number)
                item_bytes = abs(int(hdu.header.get("BITPIX", 8))) // 8
                check_pixels(path, *map(int, getattr(hdu, "shape", ()) or ()), each_bytes=item_bytes)
                check_pixels(path, int(hdu.size) // 8)
                if getattr(hdu, "is_image", False) and hdu.header.get("NAXIS", 0) > 0:
                    return np.ascontiguousarray(hdu.data.astype(hdu.data.dtype.newbyteorder("=")))
                place = hdu.fileinfo()
                check_axes(path, file, place["datLoc"] + place["datSpan"])  # of the next header, before it is opened
    except InputError:
        raise
    except Exception as error:  # a damaged header makes astropy raise exceptions of many types, KeyError too
        raise InputError(f"{path}: not a complete FITS file: {' '.join(str(error).split())}") from None
    raise InputError(f"{path}: a FITS file without an image")


def decode_tiles(path: Path, number: int) -> NDArray:
    """The pixels of a compressed image, the HDU of this number. Raises InputError with one line."""
    with tempfile.TemporaryDirectory(prefix="skysim-") as folder:
        out = Path(folder) / "pixels.npy"
        script = Path(__file__).parent / "guard/fits_tiles.py"
        if fault := run_guarded(script, str(path), str(number), str(out), cpu_s=TILES_CPU_S, memory_bytes=TILES_BYTES):
            raise InputError(f"{path}: not a complete FITS file: {fault}")
        return np.asarray(np.load(out))


def read_date_obs(path: Path) -> datetime.datetime | None:
    """DATE-OBS of a FITS file; None for other files and for headers without a valid one."""
    if path.suffix.lower() not in FITS_SUFFIXES:
        return None
    from astropy.io import fits

    try:
        with open_fits(path) as file:
            return datetime.datetime.fromisoformat(str(fits.getheader(file).get("DATE-OBS")))
    except Exception:  # of many types, as in `read_fits`, which reports the fault
        return None


class LiveCamera:
    """An open camera or video stream, read frame by frame."""

    def __init__(self, source: str) -> None:
        self.source, self.frame_count = source, 0
        with silent_opencv():
            self.capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
            self.capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest frame, not a buffered one

    def frame(self) -> NDArray:
        """The next frame, (H, W) or (H, W, 3). Raises InputError if there is none."""
        with silent_opencv():
            ok, frame = self.capture.read()
        if not ok or frame is None:
            if self.frame_count:
                raise InputError(f"{self.source}: ends after {self.frame_count} frames")
            raise InputError(f"{self.source}: no camera found; allowed: an index such as 0, a video file, a URL")
        self.frame_count += 1
        return np.asarray(frame)

    def close(self) -> None:
        """Release the camera."""
        self.capture.release()


def grab_frame(source: str) -> NDArray:
    """One frame of a camera, (H, W) or (H, W, 3). Raises InputError if there is none."""
    with contextlib.closing(LiveCamera(source)) as camera:
        return camera.frame()


@contextlib.contextmanager
def silent_opencv() -> Iterator[None]:
    """Suppress OpenCV's own messages, for example about a missing camera."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


MAX_PIXELS = 1 << 28
MAX_BYTES = 600 << 20  # of a file, and of its pixels when decoded: 2^28 of 16 bits, and a header
MAX_DEFLATE_RATIO = 1032  # greatest compression ratio of deflate (zlib's technical details)

# TIFF: integer types of 8, 16, 32 and 64 bits. libtiff accepts signed types for a size too. All are read as unsigned,
# so a negative size, which libtiff rejects, is a huge one here. Tags of width, height, samples and bits per sample.
INTEGER_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q", 6: "B", 8: "H", 9: "I", 17: "Q"}
WIDTH_TAG, HEIGHT_TAG, SAMPLES_TAG, BITS_TAG = 256, 257, 277, 258


def decode_image(path: Path) -> NDArray:
    """The pixels as stored, (H, W) or (H, W, channels). Raises InputError with one line."""
    data = path.read_bytes()
    check_encoded_size(path, data)
    try:
        with silent_stderr():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"{path}: cannot be decoded: {' '.join(str(error).split())}") from None
    if image is None:
        raise InputError(f"{path}: cannot be decoded; it may be truncated or not an image")
    return image


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Suppress output of C libraries: libpng and OpenCV write their messages directly to file descriptor 2."""
    sys.stderr.flush()
    saved, devnull = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(devnull, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(devnull)


def check_pixels(path: Path, *sides: int, each_bytes: int = 1) -> None:
    """Raise InputError for more pixels than MAX_PIXELS, or more than MAX_BYTES when decoded."""
    size = "x".join(map(str, sides)) if len(sides) < 5 else f"{prod(sides):.3g}"
    if prod(sides) > MAX_PIXELS:
        raise InputError(f"{path}: {size} pixels by its header; allowed: up to {MAX_PIXELS}")
    if (size_bytes := prod(sides) * each_bytes) > MAX_BYTES:
        raise InputError(f"{path}: {size} pixels of {size_bytes} bytes by its header; allowed: up to {MAX_BYTES} bytes")


def check_bytes(path: Path) -> None:
    """Raise InputError for a file larger than the largest allowed image."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"{path}: {size} bytes; allowed: up to {MAX_BYTES}")


def check_encoded_size(path: Path, data: bytes) -> None:
    """Raise InputError unless these are the bytes of a PNG, TIFF, JPEG or BMP file with at most MAX_PIXELS pixels."""
    reader = next((reader for magic, reader in FORMATS.items() if data.startswith(magic)), None)
    try:
        sizes = list(reader(data)) if reader else []
    except Exception:  # of many types, from Pillow or struct, for a truncated or damaged header
        sizes = []
    if not sizes:
        raise InputError(f"{path}: cannot be decoded; it may be truncated or not an image")
    for sides, each_bytes in sizes:
        check_pixels(path, *sides, each_bytes=each_bytes)


Sizes = Iterator[tuple[tuple[int, ...], int]]  # width and height, and the bytes of each pixel as OpenCV decodes it
PNG_SAMPLES = {0: 1, 2: 3, 3: 4, 4: 4, 6: 4}  # by color type: OpenCV adds colors to gray with alpha, alpha to a palette


def png_size(data: bytes) -> Sizes:
    """Size from IHDR, the first chunk (PNG, section 11.2.2); nothing if a chunk or the rows exceed the file.

    OpenCV allocates memory for a chunk before it reads it, so every chunk must end within the file, and the rows must
    be no more than the file can hold at deflate's greatest compression.
    """
    width, height, bits, color = struct.unpack_from(">IIBB", data, 16)
    at, kind = 8, b""
    while kind != b"IEND" and at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        at += 12 + length
    complete = at <= len(data) and height * (1 + width * bits // 8) <= MAX_DEFLATE_RATIO * len(data)
    if complete or width * height > MAX_PIXELS:  # the caller reports an excessive size
        yield (width, height), PNG_SAMPLES.get(color, 4) * max(bits // 8, 1)


def pillow_size(data: bytes) -> Sizes:
    """Size of a JPEG or BMP file by Pillow, which reads the header only."""
    from PIL import BmpImagePlugin, JpegImagePlugin

    plugin = BmpImagePlugin.BmpImageFile if data.startswith(b"BM") else JpegImagePlugin.JpegImageFile
    with plugin(io.BytesIO(data)) as image:  # the class, not Image.open: that has a limit of its own
        yield image.size, 1 if image.mode in ("1", "L") else 4


def tiff_size(data: bytes) -> Sizes:
    """Size from the first directory (TIFF 6.0, section 2), or BigTIFF's; the greatest value of a repeated tag.

    Only here are samples counted as pixels, because each may have eight bytes. Colors of a palette are not.
    """
    order = "<" if data.startswith(b"II") else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    (at,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, at)
    entry, head, value = (20, 8, 12) if big else (12, 2, 8)
    sides, bits = {WIDTH_TAG: 0, HEIGHT_TAG: 0, SAMPLES_TAG: 1}, 8
    for n in range(min(count, 1 << 16)):
        begin = at + head + n * entry
        tag, kind = struct.unpack_from(order + "HH", data, begin)
        if tag in sides and kind in INTEGER_TYPES:
            number = struct.unpack_from(order + INTEGER_TYPES[kind], data, begin + value)[0]
            sides[tag] = max(sides[tag], number)
        elif tag == BITS_TAG:
            # One per sample: in the entry itself, or where it points to.
            length = struct.unpack_from(order + ("Q" if big else "I"), data, begin + 4)[0]
            place = struct.unpack_from(order + ("Q" if big else "I"), data, begin + value)[0]
            at_bits = begin + value if length * 2 <= entry - value else place
            bits = max(bits, struct.unpack_from(order + "H", data, at_bits)[0])
    if all(sides.values()):
        width, height, samples = sides.values()
        yield (width, height, samples) if samples > 1 else (width, height), min(bits // 8, 8)


FORMATS: dict[bytes, Callable[[bytes], Sizes]] = {
    b"\x89PNG\r\n\x1a\n": png_size,
    **dict.fromkeys((b"\xff\xd8\xff", b"BM"), pillow_size),
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), tiff_size),
}

IMAGE_SUFFIXES = (*FITS_SUFFIXES, ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")


def read_image(path: Path) -> NDArray:
    """The pixels of a FITS, PNG, TIFF, JPEG or BMP file as stored: (H, W) or (H, W, channels).

    Raises InputError with one line for a file that is missing, truncated, not an image, or has too many pixels.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        raise InputError(f"{path}: unknown image suffix; allowed: {', '.join(IMAGE_SUFFIXES)}")
    check_bytes(path)
    image = read_fits(path) if path.suffix.lower() in FITS_SUFFIXES else decode_image(path)
    if image.dtype.kind not in "uif":
        raise InputError(f"{path}: pixels of type {image.dtype}; allowed: integers and floats")
    return image


def monochrome(image: NDArray) -> NDArray:
    """Luminance of a color image (alpha is ignored); a monochrome one unchanged. Raises InputError."""
    if image.ndim == 2:
        return image
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise InputError(f"an image of shape {image.shape}; allowed: (height, width) and color with 3 or 4 channels")
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    return cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY)
