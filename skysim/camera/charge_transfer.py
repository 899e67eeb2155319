"""Charge transport in the chip: blooming, transfer loss and smear, in place on a frame.

A frame is (H, W) electrons, float32 or float64. It is read out towards row 0 and then towards column 0: the packet
of pixel (x, y) makes y + 1 parallel and x + 1 serial transfers. Every function keeps the equation that it computes:

- `bloom`: charge above the full well spreads along its column; sum and first moment are conserved.
- `transfer_loss`: of n transfers each leaves a fraction behind; the charge arrives late by the negative binomial law.
- `smear`: charge that is moved under light collects it from every row it passes.
"""

import functools

import numba
import numpy as np
from numpy.typing import NDArray

from skysim.core.jit import jit
from skysim.core.types import Floats, Ints

BLOCK = 256  # columns processed together: a kilobyte or two of each row, which the processor reads ahead
TAIL = 1e-6  # fraction of a packet that the table of delays does not resolve


def bloom(electrons: NDArray, full_well_e: float, anti_blooming: float = 0.0) -> None:
    """Spread charge above the full well along its column: half of each excess to either neighbor, until all fits.

    The final state does not depend on the order of the halvings, and it conserves the charge's sum and first moment
    (the divisible sandpile in one dimension: Levine & Peres 2009, Potential Anal. 30, 1; `assumed`). These two
    conserved numbers give the ends of the streak directly (`_settle`).

    1. Find the columns with excess; the others are skipped.
    2. A drain removes the fraction `anti_blooming` of every pixel's excess.
    3. Settle the pixels with excess one after another (`_settle`).

    Parameters
    ----------
    electrons
        (H, W) charge, changed in place
    anti_blooming
        Fraction of every pixel's excess that a drain removes first. The rest is conserved, except for what leaves the
        ends of the column, which is lost.
    """
    columns = np.flatnonzero(electrons.max(axis=0) > full_well_e)
    if len(columns):
        _bloom(electrons, columns, float(full_well_e), float(anti_blooming))


@jit(parallel=True)
def _bloom(
    electrons: NDArray,
    columns: Ints,
    full_well_e: float,
    anti_blooming: float,
) -> None:
    """Spread the excess of the chosen columns, in parallel."""
    height = electrons.shape[0]
    for k in numba.prange(len(columns)):
        x = columns[k]
        # Range of rows that change.
        headroom = np.empty(height)  # remaining capacity; negative: excess
        first = height
        last = -1
        # 2. The drain takes its fraction of the excess before the rest spreads.
        for y in range(height):
            headroom[y] = full_well_e - electrons[y, x]
            if headroom[y] < 0:
                headroom[y] *= 1 - anti_blooming
                first = min(first, y)
                last = max(last, y)
        # 3. Settling fills neighbors; their own excess joins it, so each pixel is settled once at
        # most.
        for y in range(height):
            if headroom[y] < 0:
                a, b = _settle(headroom, y)
                first = min(first, a)
                last = max(last, b)
        for y in range(max(first, 0), min(last, height - 1) + 1):
            # Back from remaining capacity to charge, only where something changed.
            electrons[y, x] = full_well_e - headroom[y]


@jit
def _settle(headroom: Floats, y: int) -> tuple[int, int]:
    """Spread the excess of pixel y until it fits; return the two ends of the streak, which are filled partly.

    All pixels between the ends a and b are full. The charge that is left over, Q with its first moment M about y, is
    split between a and b so that sum and first moment are conserved (the lever rule):

        Q_b = (M + Q (y - a)) / (b - a),    Q_a = Q - Q_b.

    An end pixel that cannot hold its part is filled and the end moves on, with Q and M less what the pixel took; if
    that pixel has excess itself (negative room), its excess joins Q. Beyond the column's ends any amount fits, and is
    lost.
    """
    height = len(headroom)
    # Q and M, its moment about y.
    excess = -headroom[y]
    moment = 0.0
    headroom[y] = 0.0
    a = y - 1
    b = y + 1
    while True:
        # Lever rule.
        to_b = (moment + excess * (y - a)) / (b - a)
        to_a = excess - to_b
        # Fill end a or end b, whichever overflows, and move it on.
        if a >= 0 and to_a > headroom[a]:
            excess = excess - headroom[a]
            moment = moment - headroom[a] * (a - y)
            headroom[a] = 0.0
            a -= 1
        elif b < height and to_b > headroom[b]:
            excess = excess - headroom[b]
            moment = moment - headroom[b] * (b - y)
            headroom[b] = 0.0
            b += 1
        else:
            break
    if a >= 0:
        headroom[a] -= to_a
    if b < height:
        headroom[b] -= to_b
    return a, b


def transfer_loss(electrons: NDArray, cti_parallel: float, cti_serial: float) -> None:
    """Charge-transfer inefficiency: every transfer leaves a fraction behind, which joins the next packet.

    This gives trailing tails. Of a packet that makes n transfers the fraction

        C(n + k - 1, k) cti^k (1 - cti)^n

    arrives k pixels late: it takes k failures before the n-th success, the negative binomial law. What arrives later
    than the frame's last row or column is in the overscan and not in the frame; nothing else is lost.

    Parameters
    ----------
    electrons
        (H, W) charge, changed in place
    cti_parallel, cti_serial
        Fraction that a transfer leaves behind, the same for every charge (linear, no traps that fill)
    """
    height, width = electrons.shape
    if cti_parallel > 0:
        _delay_rows(electrons, delayed_fractions(height, cti_parallel))
    if cti_serial > 0:
        _delay_columns(
            electrons, delayed_fractions(width, cti_serial).astype(electrons.dtype)
        )


@functools.lru_cache(maxsize=8)
def delayed_fractions(transfers: int, cti: float) -> Floats:
    """(K + 1, transfers) fractions that arrive k pixels late, of the packet of n + 1 transfers; columns add up to 1.

    Each term follows from the one before: C(n + k - 1, k) = C(n + k - 2, k - 1) (n + k - 1) / k. K is the delay from
    which less than TAIL of the packet with the most transfers is still missing; that rest counts as K pixels late.
    """
    n = np.arange(1, transfers + 1)
    fractions = [(1 - cti) ** n]
    # Until the packet with the most transfers has arrived but for TAIL.
    while (later := 1 - np.sum(fractions, axis=0))[-1] > TAIL:
        k = len(fractions)
        fractions.append(fractions[-1] * cti * (n + k - 1) / k)
    # `later` may be a small negative number by rounding.
    fractions[-1] = np.maximum(fractions[-1] + later, 0)
    table = np.array(fractions)
    # The array is cached and shared, so it must not change.
    table.flags.writeable = False
    return table


@jit(parallel=True)
def _delay_rows(electrons: NDArray, fraction: Floats) -> None:
    """Apply the parallel loss in place: row y receives delayed charge of the rows with lower numbers."""
    height, width = electrons.shape
    for block in numba.prange((width + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        last = min((block + 1) * BLOCK, width)
        gathered = np.empty(last - first, electrons.dtype)
        # Backwards, so that the rows that row y gathers from still hold the charge before transfer.
        for y in range(height - 1, -1, -1):
            gathered[:] = 0
            # new[y] = sum over k of fraction[k, y - k] old[y - k].
            for k in range(min(len(fraction), y + 1)):
                weight = electrons.dtype.type(fraction[k, y - k])
                packets = electrons[y - k, first:last]
                for x in range(len(gathered)):
                    gathered[x] += weight * packets[x]
            row = electrons[y, first:last]
            for x in range(len(gathered)):
                row[x] = gathered[x]


@jit(parallel=True)
def _delay_columns(electrons: NDArray, fraction: NDArray) -> None:
    """Apply the serial loss in place, row by row.

    Parameters
    ----------
    fraction
        (K + 1, W) as from `delayed_fractions`, of the electrons' type
    """
    height, width = electrons.shape
    for y in numba.prange(height):
        row = electrons[y]
        packets = row.copy()
        row[:] = 0
        # new[x + k] += fraction[k, x] old[x].
        for k in range(min(len(fraction), width)):
            weight = fraction[k]
            late = row[k:]
            for x in range(len(late)):
                late[x] += weight[x] * packets[x]


@jit(parallel=True)
def smear(light_e: NDArray, exposure_s: float, row_time_s: float, leak: float = 1.0) -> None:
    """Smear of a frame-transfer chip, or of an interline chip whose covered register lets the fraction `leak` through.

    A frame-transfer chip is shifted into its store row by row before the exposure as after it. A pixel that ends at
    row y was shifted in, empty, over the rows above y (greater y) and is shifted out over those below, for row_time in
    each. So it passes every other row of its column once, with the same brightness as in the exposure, and collects
    row_time / exposure of each row's light L. The register of an interline chip is clocked all the time, so the cell
    that takes over a pixel's charge has passed the rows above it and will pass those below, with `leak` of their light:

        smear(y) = leak row_time / exposure sum over j != y of L(j).

    Parameters
    ----------
    light_e
        (H, W) light of the exposure; the smear is added in place. Dark current is the same in every row, so it is not
        affected.
    """
    fraction = leak * row_time_s / exposure_s
    height, width = light_e.shape
    for block in numba.prange((width + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        last = min((block + 1) * BLOCK, width)
        # The column's sum contains the pixel itself, whose fraction is taken off: (1 - fraction) L
        # + fraction sum.
        total = np.zeros(last - first)
        for y in range(height):
            total += light_e[y, first:last]
        smear = (fraction * total).astype(light_e.dtype)
        own = light_e.dtype.type(1 - fraction)
        for y in range(height):
            # A row is contiguous for the compiler, which rows of a block of columns are not.
            row = light_e[y, first:last]
            for x in range(len(row)):
                row[x] = own * row[x] + smear[x]
