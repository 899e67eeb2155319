"""Add the image of a kernel of any of the three forms to a patch."""

from __future__ import annotations

from skysim.camera.psf import splat
from skysim.camera.psf.kernel import GRID, ROUND, Kernel
from skysim.core.types import Floats


def add_kernel(
    patch: Floats, row0: int, row1: int, x: float, y: float, electrons: float, image: Kernel
) -> None:
    """Add `electrons` spread as the kernel's image about (x, y) to the rows row0 <= j < row1."""
    if image.kind == GRID:
        splat.add_grid(patch, row0, row1, x, y, electrons, image.table)
    elif image.kind == ROUND:
        splat.add_round(patch, row0, row1, x, y, electrons, image.table)
    else:
        splat.add_gaussian(patch, row0, row1, x, y, electrons, image.sigma_px)
