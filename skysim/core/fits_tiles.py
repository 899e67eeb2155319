"""Script for `core.guarded`: decode a compressed FITS image or camera raw. Wrong sizes make decoders overrun memory.

Arguments: the file, the number of the image's HDU or `raw`, and the .npy file to write.
"""

import sys
import warnings

import numpy as np
from astropy.io import fits


def decode(path: str, number: str, out: str) -> None:
    """Write the pixels of HDU `number` to a .npy file. Raises exceptions of many types for a damaged file."""
    if number == "raw":
        import rawpy

        with rawpy.imread(path) as raw:
            if raw.raw_pattern is None or raw.raw_pattern.shape != (2, 2):
                raise ValueError("its color filters are no Bayer mosaic")
            np.save(out, raw.raw_image_visible)
        return
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
