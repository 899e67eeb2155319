"""Charge that does not stay where the light put it: blooming, transfer loss and smear, in place on a frame.

A frame is (H, W) electrons, float32 or float64. It is read out towards row 0 and then towards column 0: the packet
of pixel (x, y) makes y + 1 parallel and x + 1 serial transfers.
"""

from __future__ import annotations

import functools
from typing import Any

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from skysim.core.jit import jit
from skysim.core.types import Floats

BLOCK = 64  # columns worked at together: a few cache lines of every row
TAIL = 1e-6  # share of a packet below which its places are not told apart


def bloom(electrons: NDArray[Any], full_well_e: float, anti_blooming: float = 0.0) -> None:
    """What a full well cannot hold goes in halves to the two neighbours in its column, and on, until all fits.

    anti_blooming : share of every pixel's excess that a drain takes first; the rest is conserved, but for what runs
        off the ends of the column, which is lost.
    Where the halving ends does not depend on its order, and it keeps the charge's centre as well as its sum (the
    divisible sandpile in one dimension: Levine & Peres 2009, Potential Anal. 30, 1; `assumed`). From these two
    conserved numbers the ends of the streak follow without a single halving, see `_settle`. Columns without excess
    are only looked at.
    """
    over = np.flatnonzero(electrons.max(axis=0) > full_well_e)
    if len(over):
        _bloom(electrons, over, float(full_well_e), float(anti_blooming))


@jit(parallel=True)
def _bloom(
    electrons: NDArray[Any], over: NDArray[np.int64], full_well_e: float, anti_blooming: float
) -> None:
    height = electrons.shape[0]
    for k in numba.prange(len(over)):
        x = over[k]
        room = np.empty(height)  # negative where there is too much
        first, last = height, -1
        for y in range(height):
            room[y] = full_well_e - electrons[y, x]
            if room[y] < 0:
                room[y] *= 1 - anti_blooming
                first, last = min(first, y), max(last, y)
        for y in range(height):
            if room[y] < 0:
                a, b = _settle(room, y)
                first, last = min(first, a), max(last, b)
        for y in range(max(first, 0), min(last, height - 1) + 1):
            electrons[y, x] = full_well_e - room[y]


@jit
def _settle(room: Floats, y: int) -> tuple[int, int]:
    """Spread the excess of pixel y until it and all it reaches are full; returns the two ends, full in part.

    Between the ends a and b, not yet full, everything is; what is left over lands on these two, and sum and first
    moment say how much on each (the lever). One that cannot hold its part joins the full ones, or gives its own
    excess if it has any. Beyond the column's ends there is room for everything, and it is lost.
    """
    height = len(room)
    left, moment = -room[y], 0.0  # moment about y
    room[y] = 0.0
    a, b = y - 1, y + 1
    while True:
        to_b = (moment + left * (y - a)) / (b - a)
        to_a = left - to_b
        if a >= 0 and to_a > room[a]:
            left, moment = left - room[a], moment - room[a] * (a - y)
            room[a] = 0.0
            a -= 1
        elif b < height and to_b > room[b]:
            left, moment = left - room[b], moment - room[b] * (b - y)
            room[b] = 0.0
            b += 1
        else:
            break
    if a >= 0:
        room[a] -= to_a
    if b < height:
        room[b] -= to_b
    return a, b


def transfer_loss(electrons: NDArray[Any], cti_parallel: float, cti_serial: float) -> None:
    """Every transfer leaves a share behind, which follows in the next packet: tails that point away from read-out.

    cti_parallel, cti_serial : that share, the same for every charge (linear, no traps that fill).
    Of a packet that makes n transfers, C(n + k - 1, k) cti^k (1 - cti)^n comes out k places late: it takes k
    failures before the n-th success, the negative binomial law. What comes later than the frame's last row or
    column is in the overscan and not in the frame; nothing else is lost.
    """
    height, width = electrons.shape
    if cti_parallel > 0:
        _late_rows(electrons, late_shares(height, cti_parallel))
    if cti_serial > 0:
        _late_columns(electrons, late_shares(width, cti_serial))


@functools.lru_cache(maxsize=8)
def late_shares(transfers: int, cti: float) -> Floats:
    """(K + 1, transfers) share of the packet of n + 1 transfers that comes k places late; columns add up to 1.

    Ends where less than 1e-6 of the longest way's charge is later still, and counts that as K places late.
    """
    last = int(scipy.stats.nbinom.ppf(1 - TAIL, transfers, 1 - cti))
    late, n = np.arange(last + 1)[:, None], np.arange(1, transfers + 1)
    share = scipy.stats.nbinom.pmf(late, n, 1 - cti)
    share[-1] = scipy.stats.nbinom.sf(last - 1, n, 1 - cti)
    share.flags.writeable = False
    return np.asarray(share)


@jit(parallel=True)
def _late_rows(electrons: NDArray[Any], share: Floats) -> None:
    """From the last row to the first, each gathers what the rows before it left: those are still as they were."""
    height, width = electrons.shape
    for block in numba.prange((width + BLOCK - 1) // BLOCK):
        x0, x1 = block * BLOCK, min((block + 1) * BLOCK, width)
        gathered = np.empty(BLOCK, dtype=electrons.dtype)
        for y in range(height - 1, -1, -1):
            gathered[:] = 0
            for k in range(min(len(share), y + 1)):
                part = electrons.dtype.type(share[k, y - k])
                for x in range(x0, x1):
                    gathered[x - x0] += part * electrons[y - k, x]
            for x in range(x0, x1):
                electrons[y, x] = gathered[x - x0]


@jit(parallel=True)
def _late_columns(electrons: NDArray[Any], share: Floats) -> None:
    height, width = electrons.shape
    for y in numba.prange(height):
        gathered = np.zeros(width)
        for k in range(min(len(share), width)):
            for x in range(k, width):
                gathered[x] += share[k, x - k] * electrons[y, x - k]
        for x in range(width):
            electrons[y, x] = gathered[x]


def frame_transfer_smear(light_e: NDArray[Any], exposure_s: float, row_time_s: float) -> None:
    """Charge that is shifted under light takes some of every row's, row_time / exposure of what it gave.

    light_e : the exposure's light (in place it gains the smear); dark current is the same in any row.
    The chip is emptied into its store row by row before the exposure as after it. A pixel that ends at row y came
    in with nothing over the rows above y (greater y) and goes out over those below, row_time in each: once every
    other row of its column, before or after, as bright as in the exposure.
    """
    _smear(light_e, row_time_s / exposure_s)


def interline_smear(light_e: NDArray[Any], exposure_s: float, row_time_s: float, leak: float) -> None:
    """A covered register takes `leak` of the light of every row that it passes: smear as above, times the leak.

    light_e : the exposure's light (in place it gains the smear). The register runs all the time, so that the place
    that takes over a pixel's charge has passed the rows above it and will pass those below.
    """
    _smear(light_e, leak * row_time_s / exposure_s)


@jit(parallel=True)
def _smear(light_e: NDArray[Any], share: float) -> None:
    """Add a share of the rest of its column to every pixel."""
    height, width = light_e.shape
    for block in numba.prange((width + BLOCK - 1) // BLOCK):
        x0, x1 = block * BLOCK, min((block + 1) * BLOCK, width)
        column = np.zeros(BLOCK)
        for y in range(height):
            for x in range(x0, x1):
                column[x - x0] += light_e[y, x]
        column *= share
        for y in range(height):
            for x in range(x0, x1):
                light_e[y, x] = (1 - share) * light_e[y, x] + column[x - x0]
