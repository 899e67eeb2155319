"""What the readers of images share: limits on the size by the header, and C libraries that print nothing."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path

import cv2

from skysim.core.errors import InputError

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
