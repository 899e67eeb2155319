"""The light of a disc on a lattice of sub-pixels, sampled several times a point where that is needed."""

from __future__ import annotations

import math
from typing import Any
import numba
import numpy as np
from skysim.core.jit import jit
from skysim.core.types import Floats
from skysim.sources.body_discs import (Surface, cell_light, inner_radius2)



REACH = 3  # points to either side among which a sample's light is shared


def lattice_light(
    surface: Surface,
    count: int,
    subsamples: int,
    axis_px: Floats,
    radius_from_px: Floats,
    shown: Any,
) -> Floats:
    """(count, count) shares of the disc's light at the points of a lattice, [y, x], which zeros must surround.

    axis_px : (count * subsamples,) even coordinates of the samples in both directions
    shown   : (len(axis_px), len(axis_px)) the part of each sample that nothing hides; (0, 0) where all are seen
    """
    fine = len(axis_px)
    weights = sharing_weights(subsamples)
    step = float(axis_px[1] - axis_px[0]) * math.sqrt(abs(float(np.linalg.det(radius_from_px))))
    matrix = np.ascontiguousarray(radius_from_px)
    has_earthshine = surface.earthshine > 0
    sunlit = np.empty((fine, count))
    earthlit = np.empty((fine, count) if has_earthshine else (0, 0))
    totals = np.empty((fine, 2))
    _light_rows(
        sunlit,
        earthlit,
        totals,
        surface.law,
        surface.phase_rad,
        axis_px,
        matrix,
        step,
        weights,
        shown,
    )
    of_sun, of_earth = totals.sum(axis=0)
    light = np.empty((count, count))
    of_all = 1 + surface.earthshine
    _light_columns(light, sunlit, weights, 1 / (of_all * max(of_sun, 1e-300)), False)
    if has_earthshine:
        _light_columns(light, earthlit, weights, surface.earthshine / (of_all * of_earth), True)
    return light


def sharing_weights(subsamples: int) -> Floats:
    """(subsamples, 2 REACH + 1) weights of a sample's light at the points -REACH to REACH from its own.

    Light between two points is shared between them by linear weights: a triangular filter, whose spectrum sinc^2
    suppresses the frequencies that the lattice folds back. Below them it is undone by the second differences
    D = -delta^2: 1 / sinc^2 = 1 + D / 12 + D^2 / 90 + ...
    """
    offset = (np.arange(subsamples) + 0.5) / subsamples - 0.5
    linear = np.stack([np.maximum(-offset, 0), 1 - np.abs(offset), np.maximum(offset, 0)], axis=1)
    second = np.array([-1.0, 2.0, -1.0])
    undone = np.convolve(second, second) / 90
    undone[1:4] += second / 12
    undone[2] += 1
    return np.stack([np.convolve(row, undone) for row in linear])


@jit(parallel=True)
def _light_rows(
    sunlit: Any,
    earthlit: Any,
    totals: Any,
    law: int,
    phase_rad: float,
    axis_px: Floats,
    matrix: Floats,
    step: float,
    weights: Floats,
    shown: Any,
) -> None:
    """Light of each row of samples, shared among the lattice's columns, from the Sun and from the observer's side.

    totals : (fine, 2) sums of the rows with what is hidden
    """
    count = sunlit.shape[1]
    subsamples = len(weights)
    sine = math.sin(phase_rad)
    cosine = math.cos(phase_rad)
    inner = inner_radius2(step)
    with_earth = len(earthlit) > 0
    masked = len(shown) > 0
    for j in numba.prange(len(axis_px)):
        own = np.zeros(
            (2, subsamples, count + 2 * REACH)
        )  # with a margin, so that no point has an edge
        of_sun = of_earth = 0.0
        for k in range(count):
            for m in range(subsamples):
                i = k * subsamples + m
                x = matrix[0, 0] * axis_px[i] + matrix[0, 1] * axis_px[j]
                y = matrix[1, 0] * axis_px[i] + matrix[1, 1] * axis_px[j]
                from_sun, from_earth = cell_light(law, sine, cosine, x, y, step, inner)
                of_sun += from_sun
                of_earth += from_earth
                part = shown[j, i] if masked else 1.0
                own[0, m, k + REACH] = part * from_sun
                own[1, m, k + REACH] = part * from_earth
        totals[j, 0] = of_sun
        totals[j, 1] = of_earth
        _share(sunlit[j], own[0], weights)
        if with_earth:
            _share(earthlit[j], own[1], weights)


@jit
def _share(points: Any, samples: Floats, weights: Floats) -> None:
    """Light of (subsamples, count + 2 REACH) samples shared among (count,) points, in place."""
    for k in range(len(points)):
        points[k] = 0.0
    for d in range(2 * REACH + 1):
        for m in range(len(weights)):
            weight = weights[m, d]
            for k in range(len(points)):
                points[k] += weight * samples[m, k + 2 * REACH - d]


@jit(parallel=True)
def _light_columns(light: Any, rows: Floats, weights: Floats, scale: float, add: bool) -> None:
    """Rows of samples shared among the lattice's rows, scaled, in place of `light` or in addition to it."""
    count = light.shape[1]
    subsamples = len(weights)
    for k in numba.prange(count):
        if not add:
            for i in range(count):
                light[k, i] = 0.0
        for d in range(max(k + REACH - count + 1, 0), min(2 * REACH, k + REACH) + 1):
            for m in range(subsamples):
                weight = scale * weights[m, d]
                j = (k + REACH - d) * subsamples + m
                for i in range(count):
                    light[k, i] += weight * rows[j, i]


