"""Assign each source of a frame its kernel: look kernels up, share them, and lay them out for compiled code."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.camera.psf.kernel import QUANTUM_PX, Kernel, build_kernel
from skysim.camera.psf.otf import blur_radius_px, field_sigma_px
from skysim.camera.psf.splat import PER_PX, Singles
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene.sections.camera import CameraConfig

GAUSS, ROUND, GRID = 0, 1, 2
PACKING = np.array([1 << 42, 1 << 21, 1])  # packs three sizes, in steps of 0.01 px, into one integer


class Kernels(NamedTuple):
    """The pixel-integrated images of N sources.

    kind     : (N,) GAUSS, ROUND or GRID
    sigma_px : (N,) of a Gaussian
    reach_px : (N,) no light beyond it in x or in y
    sharp_px : (N,) size of the sharpest feature, see `sharpness_px`
    table    : (N, 4) begin and end of the source's table in `tables`, and two sizes of its shape
    tables   : all tables that are needed, end to end
    """

    kind: NDArray[np.int64]
    sigma_px: Floats
    reach_px: Floats
    sharp_px: Floats
    table: NDArray[np.int64]
    tables: Singles


class KernelCache(NamedTuple):
    """A camera's kernels, laid end to end in the order of first use; `rows` gives a key's row in each list."""

    rows: dict[tuple[int, ...], int]
    kernels: list[tuple[int, float, float, float]]  # kind, sigma_px, reach_px, sharp_px
    spans: list[tuple[int, int, int, int]]
    tables: list[Singles]  # one element: all tables joined


CACHE_BYTES = 1 << 27  # the cache is emptied when it is larger than this
MAX_RADIUS_PX = 500.0  # largest radius of an image: beyond, tables are too large


@lru_cache(maxsize=16)
def kernel_cache(camera: CameraConfig) -> KernelCache:
    """The kernel cache of a camera, empty at first."""
    return KernelCache({}, [], [], [np.empty(0, np.float32)])


def source_kernels(
    camera: CameraConfig,
    xy_px: Floats,
    radius_m: Floats,
    is_led: NDArray[np.bool_],
    distance_m: Floats,
    cos_field: Floats,
) -> Kernels:
    """The kernels of N sources.

    xy_px      : (N, 2) image positions, for the blur that grows with the field; NaN is taken as the principal point
    radius_m   : (N,) of the emitting disk, 0 for a star; drawn as a round disk of angular radius radius / distance
    is_led     : (N,) LEDs, which may be out of focus by their own distance_m; stars are at infinity
    cos_field  : (N,) of the angle from the boresight
    Raises InputError for a source too far out of focus.
    """
    position = np.where(np.isnan(xy_px), camera.center_px, xy_px)
    extra = field_sigma_px(camera.psf, camera, position)
    emitter = np.where(is_led, radius_m / distance_m, 0.0) * camera.focal_px
    blur = blur_radius_px(camera, np.where(is_led, distance_m * np.maximum(cos_field, 1e-6), np.inf))
    size = np.array([camera.width_px, camera.height_px])
    outside_px = np.maximum(np.maximum(-position, position - size), 0).max(axis=1)
    # Sources far outside the frame have no image.
    emitter, blur = (np.where(outside_px < MAX_RADIUS_PX, radius, 0.0) for radius in (emitter, blur))
    largest = (emitter + blur).max(initial=0.0)
    if largest > MAX_RADIUS_PX:
        raise InputError(
            f"camera.focus: a source's image, {blur.max():.0f} px out of focus, has a radius of {largest:.0f} px;"
            f" allowed: up to {MAX_RADIUS_PX:.0f} px"
        )
    steps = np.rint(np.column_stack([extra, emitter, blur]) / QUANTUM_PX).astype(np.int64)
    gaussian = camera.psf.kind == "gaussian"
    if gaussian:
        steps[(steps[:, 1:] == 0).all(axis=1), 0] = 0  # Gaussians need no shared table
    cache = kernel_cache(camera)
    codes = steps @ PACKING
    all_in_focus = codes.size > 0 and not codes.any()  # stars in focus share one key: skip the sort
    first, inverse = ([0], np.zeros(len(codes), int)) if all_in_focus else np.unique(codes, True, True)[1:]
    keys = [tuple(key) for key in steps[first].tolist()]
    add_kernels(cache, camera, keys)
    rows = np.array([cache.rows[key] for key in keys], dtype=np.int64)[inverse]
    # Contiguous: columns of a table would be another array type, for which the renderer is compiled once more.
    kind, sigma, reach, sharp = np.ascontiguousarray(np.array(cache.kernels).reshape(-1, 4)[rows].T)
    spans = np.array(cache.spans, dtype=np.int64).reshape(-1, 4)[rows]
    if gaussian and camera.psf.corner_sigma_px:
        point = kind == GAUSS
        widening = np.hypot(sigma, extra) / np.where(point, sigma, 1)
        sigma, sharp = (np.where(point, a * widening, a) for a in (sigma, sharp))
        reach = np.where(point, reach * np.maximum(widening, 1), reach)
    return Kernels(kind.astype(np.int64), sigma, reach, sharp, spans, cache.tables[0])


def add_kernels(cache: KernelCache, camera: CameraConfig, keys: list[tuple[int, ...]]) -> None:
    """Make the kernels that the cache does not hold yet; empty the cache first if it is over CACHE_BYTES."""
    if cache.tables[0].nbytes > CACHE_BYTES:
        for container in cache:
            container.clear()
        cache.tables.append(np.empty(0, np.float32))
    tables, begin = [cache.tables[0]], len(cache.tables[0])
    for key in dict.fromkeys(key for key in keys if key not in cache.rows):
        kernel = build_kernel(camera.psf, camera, *(n * QUANTUM_PX for n in key))
        kind = GRID if len(kernel.grid) else ROUND if len(kernel.radial) else GAUSS
        table = kernel.grid if kind == GRID else kernel.radial
        sizes = {GAUSS: (0, 0), ROUND: kernel.radial.shape, GRID: kernel.grid.shape[1:3]}[kind]
        cache.rows[key] = len(cache.kernels)
        cache.kernels.append((kind, kernel.sigma_px, kernel.reach_px, sharpness_px(kernel)))
        cache.spans.append((begin, begin + table.size, *sizes))
        tables.append(table.ravel())
        begin += table.size
        if 4 * begin > 2 * CACHE_BYTES:
            raise InputError(
                f"camera.psf: images of different sizes take more than {2 * CACHE_BYTES >> 20} MB;"
                " allowed: a smaller table, or corner_sigma_px: 0"
            )
    if len(tables) > 1:
        cache.tables[0] = np.concatenate(tables)


def sharpness_px(kernel: Kernel) -> float:
    """How far an image may move before its pixels change much: half its peak over its steepest slope.

    For the table of a Gaussian it is 0.82 sigma. For a soft edge it is 1.25 sigma, which is still safe: two nodes in
    1.6 sigma leave a ripple of 0.5 exp(-2 pi^2 / 1.6^2) = 2e-4, and the ends' fraction falls with the disk's width.
    For a Gaussian drawn by formula it is sigma with the pixel's own variance, 1/12, added.
    """
    if len(kernel.grid):
        steps = kernel.grid.shape[0] - 3
        slope = max(np.abs(np.diff(kernel.grid, axis=axis)).max() for axis in (0, 1)) * steps
        return float(0.5 * kernel.grid.max() / slope)
    if len(kernel.radial):
        return float(0.5 * kernel.radial[0, 0] / (np.abs(kernel.radial[:, 1]).max() * PER_PX))
    return float(np.sqrt(kernel.sigma_px**2 + 1 / 12))
