"""Limits on the size of an image, checked against its header before it is decoded."""

from __future__ import annotations

from math import prod
from pathlib import Path

from skysim.core.errors import InputError

MAX_PIXELS = 1 << 28
MAX_BYTES = 600 << 20  # of a file, and of its pixels when decoded: 2^28 of 16 bits, and a header


def check_pixels(path: Path, *sides: int, each_bytes: int = 1) -> None:
    """Raise InputError for more pixels than MAX_PIXELS, or more than MAX_BYTES when decoded."""
    size = "x".join(map(str, sides)) if len(sides) < 5 else f"{prod(sides):.3g}"
    if prod(sides) > MAX_PIXELS:
        raise InputError(path, f"{size} pixels by its header", f"up to {MAX_PIXELS}")
    if (size_bytes := prod(sides) * each_bytes) > MAX_BYTES:
        raise InputError(path, f"{size} pixels of {size_bytes} bytes by its header", f"up to {MAX_BYTES} bytes")


def check_bytes(path: Path) -> None:
    """Raise InputError for a file larger than the largest allowed image."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(path, f"{size} bytes", f"up to {MAX_BYTES}")
