"""FITS files from anywhere: their first image and their date. What is too large or damaged is refused in one line."""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from skysim.picturefile import check_pixels
from skysim.types import BadInput

FITS_SUFFIXES = (".fits", ".fit", ".fts")
BEGINS = b"SIMPLE  ="  # what is packed (gzip, zip and others) does not: astropy would unpack it
MOST_HDUS = 1000  # in which an image is looked for


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """The file for astropy, whose warnings are errors within: past them it may walk a damaged file for ever."""
    from astropy.utils.exceptions import AstropyWarning

    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)  # "file may have been truncated" is one
        if file.read(len(BEGINS)) != BEGINS:
            raise BadInput(f"{path}: not a whole FITS file: allowed: one that begins with SIMPLE, not packed")
        file.seek(0)
        yield file


def read_fits(path: Path) -> NDArray:
    """The pixels of the first image, in the machine's byte order. Raises BadInput with one line."""
    from astropy.io import fits

    try:
        with opened(path) as file, fits.open(file, memmap=False) as hdus:
            for hdu in islice(hdus, MOST_HDUS):
                # By the header, before the data is read or skipped.
                check_pixels(path, *map(int, getattr(hdu, "shape", ()) or ()))
                check_pixels(path, int(hdu.size) // 8)
                if getattr(hdu, "is_image", False) and hdu.header.get("NAXIS", 0) > 0:
                    return np.ascontiguousarray(hdu.data.astype(hdu.data.dtype.newbyteorder("=")))
    except BadInput:
        raise
    except Exception as error:  # astropy meets a damaged header with whatever it stumbles over, KeyError too
        raise BadInput(f"{path}: not a whole FITS file: {' '.join(str(error).split())}") from None
    raise BadInput(f"{path}: a FITS file without an image")


def date_of(path: Path) -> datetime.datetime | None:
    """DATE-OBS of a FITS file; None for other files and other headers."""
    if path.suffix.lower() not in FITS_SUFFIXES:
        return None
    from astropy.io import fits

    try:
        with opened(path) as file:
            return datetime.datetime.fromisoformat(str(fits.getheader(file).get("DATE-OBS")))
    except Exception:  # as in `read_fits`, where it is told
        return None
