"""Image files (FITS, PNG, TIFF, JPEG, BMP) and frames of a live camera, read with limits on their size.

A few bytes of a damaged or hostile file can declare an image that exceeds the memory. The declared size is therefore
read from the header, and checked, before astropy (`fits`) or OpenCV (`encoded`) decodes the file.
"""

from __future__ import annotations

import contextlib
import datetime
from dataclasses import dataclass
from pathlib import Path
import cv2
import numpy as np
from numpy.typing import NDArray
from skysim.core.errors import InputError
from skysim.core import encoded
from skysim.core import fits
from skysim.core.encoded import (check_bytes, silent_opencv)



IMAGE_SUFFIXES = (*fits.SUFFIXES, *encoded.SUFFIXES)
LUMINANCE = {"blue": 0.114, "green": 0.587, "red": 0.299}  # ITU-R BT.601, in OpenCV's order


@dataclass(frozen=True, slots=True)
class Picture:
    """An image as a person sees it: turned as EXIF says, the highest row first.

    pixels          : (H, W) or (H, W, channels), blue first
    date_utc        : DATE-OBS of a FITS file; None if unknown
    focal_35mm      : focal length of the 35 mm camera with the same diagonal field, mm; None if unknown
    row_order_known : False for a FITS file without ROWORDER, whose last row is then taken for the highest, as the
        standard recommends
    exposure_s, temperature_c : of a FITS header; None if unknown
    """

    pixels: NDArray
    date_utc: datetime.datetime | None = None
    focal_35mm: float | None = None
    row_order_known: bool = True
    exposure_s: float | None = None
    temperature_c: float | None = None


def read_picture(path: Path) -> Picture:
    """The image as a person sees it. Raises InputError as `read_image` does."""
    check_name(path)
    if not is_fits(path):
        data = path.read_bytes()
        pixels = encoded.decode_image(path, data)
        exif = encoded.read_exif(data)
        return Picture(
            check_numbers(path, encoded.upright(pixels, exif.orientation)),
            focal_35mm=exif.focal_35mm,
        )
    image = fits.read_fits_image(path)
    pixels = image.pixels if image.top_down else np.ascontiguousarray(image.pixels[::-1])
    return Picture(
        check_numbers(path, pixels),
        image.date_utc,
        row_order_known=image.top_down is not None,
        exposure_s=image.exposure_s,
        temperature_c=image.temperature_c,
    )


def read_image(path: Path) -> NDArray:
    """The pixels of a FITS, PNG, TIFF, JPEG or BMP file as stored: (H, W) or (H, W, channels), blue first.

    Raises InputError with one line for a file that is missing, truncated, not an image, or has too many pixels.
    """
    check_name(path)
    return check_numbers(
        path,
        fits.read_fits(path) if is_fits(path) else encoded.decode_image(path, path.read_bytes()),
    )


def image_suffix(name: str) -> str:
    """The suffix of an image file's name, in small letters: the longest known one; empty if there is none."""
    return max(
        (suffix for suffix in IMAGE_SUFFIXES if name.lower().endswith(suffix)), key=len, default=""
    )


def check_name(path: Path) -> None:
    """Raise InputError for a missing or too large file, and for one with the suffix of no known format."""
    if not path.is_file():
        raise InputError(path, "no such file")
    if not image_suffix(path.name):
        raise InputError(path, "unknown image suffix", ", ".join(IMAGE_SUFFIXES))
    check_bytes(path)


def check_numbers(path: Path, pixels: NDArray) -> NDArray:
    """The pixels. Raises InputError unless they are real numbers."""
    if pixels.dtype.kind not in "uif":
        raise InputError(path, f"pixels of type {pixels.dtype}", "integers and floats")
    return pixels


def is_fits(path: Path) -> bool:
    """Whether this is the name of a FITS file."""
    return path.name.lower().endswith(fits.SUFFIXES)


def monochrome(image: NDArray) -> NDArray:
    """Luminance of a color image (alpha is ignored); a monochrome one unchanged. Raises InputError."""
    if image.ndim == 2:
        return image
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise InputError(
            "", f"an image of shape {image.shape}", "(height, width) and color with 3 or 4 channels"
        )
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    if image.dtype in (np.uint8, np.uint16, np.float32):
        return cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY)
    gray = np.zeros(image.shape[:2])
    for n, weight in enumerate(LUMINANCE.values()):
        gray += weight * image[:, :, n]
    return gray


class LiveCamera:
    """An open camera or video stream, read frame by frame."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.frame_count = 0
        with silent_opencv():
            self.capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
            self.capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest frame, not a buffered one

    def frame(self) -> NDArray:
        """The next frame, (H, W) or (H, W, 3). Raises InputError if there is none."""
        with silent_opencv():
            ok, frame = self.capture.read()
        if not ok or frame is None:
            if self.frame_count:
                raise InputError(self.source, f"ends after {self.frame_count} frames")
            raise InputError(
                self.source, "no camera found", "an index such as 0, a video file, a URL"
            )
        self.frame_count += 1
        return np.asarray(frame)

    def close(self) -> None:
        """Release the camera."""
        self.capture.release()


def grab_frame(source: str) -> NDArray:
    """One frame of a camera, (H, W) or (H, W, 3). Raises InputError if there is none."""
    with contextlib.closing(LiveCamera(source)) as camera:
        return camera.frame()


