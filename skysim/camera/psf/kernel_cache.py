"""Assign each source of a frame its kernel: look kernels up, share them, and lay them out for compiled code."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.camera.psf.kernel import QUANTUM_PX, Kernel, kernel
from skysim.camera.psf.otf import blur_radius_px, field_sigma_px
from skysim.camera.psf.splat import PER_PX, Singles
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene.camera import CameraConfig

GAUSS, ROUND, GRID = 0, 1, 2
PACKED = np.array([1 << 42, 1 << 21, 1])  # packs three sizes, in steps of 0.01 px, into one integer


class Images(NamedTuple):
    """The images of N sources.

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
    """A camera's kernels, laid end to end in the order of first use; `places` gives a key's row in each list."""

    places: dict[tuple[int, ...], int]
    kernels: list[tuple[int, float, float, float]]  # kind, sigma_px, reach_px, sharp_px
    spans: list[tuple[int, int, int, int]]
    tables: list[Singles]  # one element: all tables joined


SHELF_BYTES = 1 << 27
MOST_PX = 500.0  # largest radius of an image: beyond, tables are too large


@lru_cache(maxsize=16)
def shelf(camera: CameraConfig) -> KernelCache:
    """The kernel cache of a camera, empty at first."""
    return KernelCache({}, [], [], [np.empty(0, np.float32)])


def images(
    camera: CameraConfig,
    middle_px: Floats,
    radius_m: Floats,
    near: NDArray[np.bool_],
    distance_m: Floats,
    cos_field: Floats,
) -> Images:
    """The kernels of N sources.

    middle_px  : (N, 2) image positions, for the blur that grows with the field; NaN is taken as the principal point
    radius_m   : (N,) of the emitting disc, 0 for a star; drawn as a round disc of angular radius radius / distance
    near       : (N,) LEDs, which may be out of focus by their own distance_m; stars are at infinity
    cos_field  : (N,) of the angle from the boresight
    Raises InputError for a source too far out of focus.
    """
    place = np.where(np.isnan(middle_px), camera.centre_px, middle_px)
    extra = field_sigma_px(camera.psf, camera, place)
    emitter = np.where(near, radius_m / distance_m, 0.0) * camera.focal_px
    blur = blur_radius_px(camera, np.where(near, distance_m * np.maximum(cos_field, 1e-6), np.inf))
    size = np.array([camera.width_px, camera.height_px])
    aside = np.maximum(np.maximum(-place, place - size), 0).max(axis=1)
    emitter, blur = (
        np.where(aside < MOST_PX, disc, 0.0) for disc in (emitter, blur)
    )  # far outside the frame: no image
    largest = (emitter + blur).max(initial=0.0)
    if largest > MOST_PX:
        raise InputError(
            f"camera.focus: a source's image, {blur.max():.0f} px out of focus, has a radius of {largest:.0f} px;"
            f" allowed: up to {MOST_PX:.0f} px"
        )
    steps = np.rint(np.column_stack([extra, emitter, blur]) / QUANTUM_PX).astype(np.int64)
    gaussian = camera.psf.kind == "gaussian"
    if gaussian:
        steps[(steps[:, 1:] == 0).all(axis=1), 0] = 0  # Gaussians need no shared table
    held = shelf(camera)
    packed = steps @ PACKED
    alike = packed.size > 0 and not packed.any()  # stars in focus share one key: skip the sort
    first, which = ([0], np.zeros(len(packed), int)) if alike else np.unique(packed, True, True)[1:]
    keys = [tuple(key) for key in steps[first].tolist()]
    stock(held, camera, keys)
    rows = np.array([held.places[key] for key in keys], dtype=np.int64)[which]
    kind, sigma, reach, sharp = np.array(held.kernels).reshape(-1, 4)[rows].T
    spans = np.array(held.spans, dtype=np.int64).reshape(-1, 4)[rows]
    if gaussian and camera.psf.corner_sigma_px:
        point = kind == GAUSS
        wider = np.hypot(sigma, extra) / np.where(point, sigma, 1)
        sigma, sharp = (np.where(point, a * wider, a) for a in (sigma, sharp))
        reach = np.where(point, reach * np.maximum(wider, 1), reach)
    return Images(kind.astype(np.int64), sigma, reach, sharp, spans, held.tables[0])


def stock(held: KernelCache, camera: CameraConfig, keys: list[tuple[int, ...]]) -> None:
    """Make the kernels that the cache does not hold yet; empty the cache first if it is over SHELF_BYTES."""
    if held.tables[0].nbytes > SHELF_BYTES:
        for part in held:
            part.clear()
        held.tables.append(np.empty(0, np.float32))
    tables, begin = [held.tables[0]], len(held.tables[0])
    for key in dict.fromkeys(key for key in keys if key not in held.places):
        made = kernel(camera.psf, camera, *(n * QUANTUM_PX for n in key))
        kind = GRID if len(made.grid) else ROUND if len(made.radial) else GAUSS
        table = made.grid if kind == GRID else made.radial
        sizes = {GAUSS: (0, 0), ROUND: made.radial.shape, GRID: made.grid.shape[1:3]}[kind]
        held.places[key] = len(held.kernels)
        held.kernels.append((kind, made.sigma_px, made.reach_px, sharpness_px(made)))
        held.spans.append((begin, begin + table.size, *sizes))
        tables.append(table.ravel())
        begin += table.size
        if 4 * begin > 2 * SHELF_BYTES:
            raise InputError(
                f"camera.psf: images of different sizes take more than {2 * SHELF_BYTES >> 20} MB;"
                " allowed: a smaller table, or corner_sigma_px: 0"
            )
    if len(tables) > 1:
        held.tables[0] = np.concatenate(tables)


def sharpness_px(made: Kernel) -> float:
    """How far an image may move before its pixels change much: half its peak over its steepest slope.

    For the table of a Gaussian it is 0.82 sigma. For a soft edge it is 1.25 sigma, which is still safe: two nodes in
    1.6 sigma leave a ripple of 0.5 exp(-2 pi^2 / 1.6^2) = 2e-4, and the ends' share falls with the disc's width.
    For a Gaussian drawn by formula it is sigma with the pixel's own variance, 1/12, added.
    """
    if len(made.grid):
        steps = made.grid.shape[0] - 3
        slope = max(np.abs(np.diff(made.grid, axis=axis)).max() for axis in (0, 1)) * steps
        return float(0.5 * made.grid.max() / slope)
    if len(made.radial):
        return float(0.5 * made.radial[0, 0] / (np.abs(made.radial[:, 1]).max() * PER_PX))
    return float(np.sqrt(made.sigma_px**2 + 1 / 12))
