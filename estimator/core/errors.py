"""The error of the estimator's users."""

import re
from pathlib import Path


def reason(error: Exception) -> str:
    """Why a file cannot be read, without Python's words for text in another encoding or NumPy's for no number."""
    if isinstance(error, UnicodeDecodeError):
        return f"not text in UTF-8, by byte {error.start + 1}"
    if place := re.search(r"row (\d+), column \d+", str(error)):
        return f"no number in its row {int(place[1]) + 1}"
    return getattr(error, "strerror", None) or str(error)


def file_bytes(path: str | Path) -> bytes:
    """The bytes of a regular file; reading a pipe or a device may not end. Raises OSError."""
    if not Path(path).is_file():
        raise OSError(0, "no such file")
    return Path(path).read_bytes()


class ImageError(ValueError):
    """The image or the calibration cannot be used. The one printable line names the fault and what is allowed."""

    def __init__(self, message: object) -> None:
        line = " ".join(
            str(message).split()
        )  # it may quote a file, and a file may hold anything
        super().__init__(
            "".join(character if character.isprintable() else "?" for character in line)
        )
