"""Veiling glare: light that rough or dirty surfaces of a lens scatter over the chip, by its glare-spread function.

Polished surfaces scatter by the law of Harvey and Shack, BSDF = b (1 + (sin(theta) / l)^2)^(s / 2), the ABg law with a
round shoulder (Stover, Optical Scattering, 3rd ed., ch. 4). On the chip that is, around each image,

    g(r) = (n - 2) / (2 pi a^2) (1 + (r / a)^2)^(-n / 2),    n > 2,

with unit integral. Its Fourier transform at the angular frequency k is Matern's

    G(k) = 2^(1 - v) / Gamma(v) (a k)^v K_v(a k),    v = n / 2 - 1.

The frame is convolved with it as if the field went on beside the chip as its mirror image: as much light enters as
leaves, so that the total is conserved, and uniform light stays uniform. That is a product of cosine transforms.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, special

from skysim.core.types import Floats, SourceTruth
from skysim.scene.sections.camera import GlareConfig

BLOCKS = 8  # least number of blocks of pixels across the core: a light is shifted by less than a 16th of it


def add_glare(light_e: NDArray[Any], config: GlareConfig) -> None:
    """Spread a share of the light of an (H, W) frame, in place."""
    block = block_px(light_e.shape, config.core_px)
    height, width = (size // block for size in light_e.shape)
    coarse = light_e.reshape(height, block, width, block).mean(axis=(1, 3), dtype=float)
    spectrum = fft.dctn(coarse, type=2, norm="ortho") * transfer(config, (height, width), block)
    scattered = fft.idctn(spectrum, type=2, norm="ortho").astype(light_e.dtype)
    light_e *= 1 - config.share
    light_e += config.share * ndimage.zoom(
        scattered, block, order=1, mode="reflect", grid_mode=True
    )


def block_px(shape: tuple[int, ...], core_px: float) -> int:
    """The side of the square blocks in which the glare is computed: a divisor of the frame's sides."""
    common = math.gcd(*shape)
    return max(n for n in range(1, max(int(core_px / BLOCKS), 1) + 1) if common % n == 0)


@lru_cache(maxsize=4)
def transfer(config: GlareConfig, shape: tuple[int, int], block: int) -> Floats:
    """(h, w) the transform of the glare at the frequencies of the cosine transform of blocks."""
    order = config.exponent / 2 - 1
    rows, columns = (np.pi * np.arange(size) / (size * block) for size in shape)
    scaled = config.core_px * np.hypot(rows[:, None], columns)
    scaled[0, 0] = 1.0  # the limit is 1
    values = 2 ** (1 - order) / special.gamma(order) * scaled**order * special.kv(order, scaled)
    values[0, 0] = 1.0
    return np.asarray(values)


def without_glare(sources: SourceTruth, config: GlareConfig) -> SourceTruth:
    """The truth of images from which a share of the light was scattered away."""
    return replace(
        sources,
        electrons=(1 - config.share) * sources.electrons,
        peak_e=(1 - config.share) * sources.peak_e,
    )
