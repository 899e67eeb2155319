"""Files for `hostile`: encoded images, and headers that declare more data than the file has."""

from __future__ import annotations

import struct
import zlib

import cv2
from numpy.typing import NDArray


def encoded(picture: NDArray, suffix: str) -> bytes:
    """An image encoded as the bytes of a file with this suffix."""
    if suffix == ".fits":
        from io import BytesIO

        from astropy.io import fits

        buffer = BytesIO()
        fits.PrimaryHDU(picture).writeto(buffer)
        return buffer.getvalue()
    success, data = cv2.imencode(suffix, picture)
    assert success
    return data.tobytes()


def promise(suffix: str, width: int, height: int) -> bytes:
    """The header of an image file of that size, with at most the beginning of the pixel data."""
    if suffix == ".png":
        parts = [
            (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
            (b"IDAT", zlib.compress(b"\0" * 999)),
        ]
        chunks = [struct.pack(">I", len(data)) + kind + data for kind, data in parts]
        return b"\x89PNG\r\n\x1a\n" + b"".join(
            chunk + struct.pack(">I", zlib.crc32(chunk[4:])) for chunk in chunks
        )
    if suffix == ".bmp":
        head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
        return b"BM" + struct.pack("<IHHI", 54 + 999, 0, 0, 54) + head
    if suffix == ".jpg":
        start = struct.pack(
            ">HBHHBBBB", 11, 8, height & 0xFFFF, width & 0xFFFF, 1, 1, 0x11, 0
        )
        return b"\xff\xd8\xff\xc0" + start
    if suffix == ".fits":
        cards = [
            "SIMPLE  =                    T",
            "BITPIX  =                   16",
            "NAXIS   =                    2",
        ]
        cards += [f"NAXIS1  = {width:20d}", f"NAXIS2  = {height:20d}", "END"]
        return "".join(card.ljust(80) for card in cards).ljust(2880).encode()
    tags = [
        (256, 4, width),
        (257, 4, height),
        (258, 3, 8),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 8),
    ]
    tags += [(277, 3, 1), (278, 4, height), (279, 4, min(width * height, 2**32 - 1))]
    return (
        b"II*\0\x08\0\0\0"
        + struct.pack("<H", len(tags))
        + b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
        + b"\0" * 4
    )
