"""Script for `core.guarded`: decode a compressed FITS image. Wrong sizes make the decoder overrun memory.

Arguments: the file, the number of the image's HDU, and the .npy file to write.
"""

from __future__ import annotations

import sys
import warnings

import numpy as np
from astropy.io import fits


def decode(path: str, number: str, out: str) -> None:
    """Write the pixels of HDU `number` to a .npy file. Raises exceptions of many types for a damaged file."""
    warnings.simplefilter("error")
    with open(path, "rb") as file, fits.open(file, memmap=False) as hdus:
        pixels = hdus[int(number)].data
        np.save(out, pixels.astype(pixels.dtype.newbyteorder("=")))


if __name__ == "__main__":
    try:
        decode(*sys.argv[1:])
    except MemoryError:
        raise
    except Exception as error:
        sys.exit(" ".join(str(error).split()))
