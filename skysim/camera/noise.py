"""Fast exact random numbers for millions of pixels: Poisson counts and Gaussian read noise.

Photo-electrons follow a Poisson law of the expected number in each pixel; read noise is normal. `count` draws the
Poisson numbers: below INVERSION_MAX_E electrons by inversion of the distribution function with a guide table, above
by the PD algorithm of Ahrens & Dieter (1982), which corrects a rounded normal number so that the law is exact. `normal`
uses the transform of Box & Muller (1958). Both take half a 64-bit draw per pixel at most, and a row in a few loops
without branches, which compilers turn into vector instructions; the few pixels that need more are done afterwards.

Every row of a frame has its own SplitMix64 stream (Steele, Lea & Flood 2014) from a seed that the frame's generator
drew, so the result does not depend on the order of the rows or the number of threads. A stream's state is one
integer; the functions take it and return its next value.
"""

from __future__ import annotations

from functools import lru_cache
from math import exp, log, pi, sqrt
from typing import Any, NamedTuple

import numpy as np
from numba import float32, float64, int32, int64, uint8, uint16, uint32, uint64
from numpy.random import Generator
from numpy.typing import NDArray

from skysim.core.jit import jit

BUCKETS = 1024  # ten bits; the rows of a dark frame's means then fit the L2 cache
GUIDES_PER_E = 128  # guide tables per electron of mean
INVERSION_MAX_E = 16.0  # means above it use the PD algorithm
# Entries of the guide table for buckets that more than one count shares, and for means above INVERSION_MAX_E. They have
# the highest bit, which counts below LARGE_BIT do not have.
AMBIGUOUS = 255
LARGE = 254
LARGE_BIT = 128
EIGHT_BITS = 0x8080808080808080  # the highest bits of eight entries
RARE = 128  # a radius of Box & Muller below RARE of 2^31 gets more bits

GAMMA = 0x9E3779B97F4A7C15
MIX1 = 0xBF58476D1CE4E5B9
MIX2 = 0x94D049BB133111EB
ROOT_HALF_BITS = 0x3F3504F3  # the single-precision number sqrt(1/2)


class Scratch(NamedTuple):
    """Memory for one row at a time. A NamedTuple, because numba can compile functions that take one.

    Attributes
    ----------
    bits
        64-bit draws
    cell, late
        A number for each pixel
    found
        A byte for each pixel, and up to seven more
    radius, exponent
        A number for every other pixel
    normals, means
        One for each
    """

    bits: NDArray[np.uint64]
    cell: NDArray[np.int32]
    late: NDArray[np.int32]
    found: NDArray[np.uint8]
    radius: NDArray[np.float32]
    exponent: NDArray[np.float32]
    normals: NDArray[np.float32]
    means: NDArray[np.float32]


@jit
def scratch(width: int) -> Scratch:
    """Memory for rows of a width."""
    half = (width + 1) // 2
    return Scratch(
        np.empty(half, np.uint64),
        np.empty(width, np.int32),
        np.empty(width, np.int32),
        np.zeros((width + 7) // 8 * 8, np.uint8),
        np.empty(half, np.float32),
        np.empty(half, np.float32),
        np.empty(width, np.float32),
        np.empty(width, np.float32),
    )


@lru_cache(maxsize=1)
def guide() -> NDArray[np.uint8]:
    """(INVERSION_MAX_E * GUIDES_PER_E + 1, BUCKETS) counts, made once per process in 20 ms.

    Row k is for means from k to k + 1 over GUIDES_PER_E, bucket b holds the count of every uniform number in
    [b, b + 1) / BUCKETS, or AMBIGUOUS. The last row is LARGE.
    """
    return np.asarray(_guide())


def seeds(rng: Generator, rows: int) -> NDArray[np.uint64]:
    """A seed for the stream of every row."""
    return rng.integers(0, 2**64, rows, dtype=np.uint64)


@jit
def _guide() -> Any:
    """The guide table of the Poisson law for small means.

    A count n is certain where the whole bucket is above F(n - 1) of the smallest mean and below F(n) of the greatest
    mean of the row, since F falls with the mean. The other buckets, one at each step of F and 1/GUIDES_PER_E of the
    numbers, are AMBIGUOUS.
    """
    rows = int(INVERSION_MAX_E * GUIDES_PER_E)
    guide = np.full((rows + 1, BUCKETS), np.uint8(LARGE))
    for k in range(rows):
        low = k / GUIDES_PER_E
        high = (k + 1) / GUIDES_PER_E
        p_low = exp(-low)
        p_high = exp(-high)
        n = 0
        below = 0.0
        f_low = p_low
        f_high = p_high
        for b in range(BUCKETS):
            while b / BUCKETS >= f_low and n < LARGE_BIT - 1:
                n += 1
                below = f_low
                p_low = p_low * low / n
                p_high = p_high * high / n
                f_low = f_low + p_low
                f_high = f_high + p_high
            guide[k, b] = n if b / BUCKETS >= below and (b + 1) / BUCKETS <= f_high else AMBIGUOUS
    return guide


@jit(inline="always")
def _mixed(state: Any) -> Any:
    """The 64 random bits of a state (SplitMix64)."""
    z = (state ^ (state >> uint64(30))) * uint64(MIX1)
    z = (z ^ (z >> uint64(27))) * uint64(MIX2)
    return z ^ (z >> uint64(31))


@jit
def _draws(bits: Any, state: Any) -> Any:
    """Fill an array with the next draws of 64 bits. Returns the stream's next state."""
    for n in range(bits.size):
        bits[n] = _mixed(state + uint64(n + 1) * uint64(GAMMA))
    return state + uint64(bits.size) * uint64(GAMMA)


@jit(inline="always")
def _uniform(state: Any) -> Any:
    """A uniform number in (0, 1) with 52 bits, and the next state."""
    state += uint64(GAMMA)
    return (float64(int64(_mixed(state) >> uint64(12))) + 0.5) * 2.0**-52, state


@jit
def count(row: Any, state: Any, guide: Any, memory: Scratch) -> Any:
    """Turn a row of means >= 0 into Poisson counts, exactly, in place. Returns the stream's next state.

    Small means use inversion: ten of a pixel's 16 bits choose the guide's bucket. Where the count is not certain, more
    bits are drawn and the law is summed at the exact mean. Large means use Ahrens & Dieter's PD (1982), see
    `_count_large`.
    """
    cell = memory.cell
    late = memory.late
    found = memory.found
    width = row.size
    bits = memory.bits[: (row.size + 3) // 4]
    least = float32(INVERSION_MAX_E)
    for x in range(width):
        least = min(least, row[x])
    if least == float32(INVERSION_MAX_E):
        for x in range(width):
            late[x] = x
        return _count_large(row, late[:width], state, memory)
    state = _draws(bits, state)
    words = bits.view(np.uint16)
    table = guide.reshape(-1)
    for x in range(width):
        k = int32(min(row[x] * float32(GUIDES_PER_E), float32(INVERSION_MAX_E * GUIDES_PER_E)))
        cell[x] = int32(int32(k * int32(BUCKETS)) + int32(words[x] >> uint16(6)))
    for x in range(width):
        found[x] = table[
            uint64(uint32(cell[x]))
        ]  # unsigned: saves numba's check for negative indices
    large = 0
    for n in range(_marked(found, late)):
        x = late[n]
        if found[x] == LARGE:
            late[large] = x
            large += 1
        else:
            more, state = _uniform(state)
            found[x] = uint8(
                _invert(float64(row[x]), (float64(int64(words[x] >> uint16(6))) + more) / BUCKETS)
            )
    if large == 0:
        for x in range(width):
            row[x] = float32(found[x])
        return state
    for x in range(width):
        row[x] = row[x] if found[x] == LARGE else float32(found[x])
    return _count_large(row, late[:large], state, memory)


@jit
def _marked(found: Any, late: Any) -> int:
    """Write the places of the entries with the highest bit to `late`, in order; return their number."""
    eights = found.view(np.uint64)
    count = 0
    for n in range(eights.size):
        if eights[n] & uint64(EIGHT_BITS):
            for x in range(8 * n, 8 * n + 8):
                if found[x] >= LARGE_BIT:
                    late[count] = x
                    count += 1
    return count


@jit
def _invert(mean: Any, u: Any) -> Any:
    """The least n with F(n) > u, by summing the Poisson law."""
    n = 0.0
    p = exp(-mean)
    total = p
    while u >= total and n < LARGE_BIT - 1:
        n += 1.0
        p *= mean / n
        total += p
    return n


@jit
def _count_large(row: Any, pixels: Any, state: Any, memory: Scratch) -> Any:
    """Poisson counts for the chosen pixels of a row, with means of at least ten.

    PD: the floor of a normal number of the same mean and variance has the Poisson law but for an error of order
    mean^-1/2. A squeeze accepts most numbers without computing the law: u >= (mean - k)^3 / (6 mean^2). The rest go
    to `_correct`, which accepts or replaces them so that the law is exact.
    """
    count = pixels.size
    found = memory.found
    counts = memory.normals[:count]
    means = memory.means[:count]
    bits = memory.bits[: (count + 1) // 2]
    state = _draws(bits, normal(counts, state, memory))
    words = bits.view(np.int32)
    found[:] = 0
    for n in range(count):
        means[n] = row[pixels[n]]
    for n in range(count):
        mean = float64(means[n])
        k = np.floor(mean + np.sqrt(mean) * counts[n])
        # PD accepts every k above mean - 1.1484 at once, and the squeeze most of the others.
        deficit = mean - k
        squeezed = deficit * deficit * deficit - 6 * mean * mean * _fraction(words[n])
        found[n] = uint8(LARGE) if (deficit > 1.1484) & (squeezed > 1.1484) else uint8(0)
        counts[n] = k
    for n in range(_marked(found, memory.cell)):
        which = memory.cell[n]
        mean = float64(means[which])
        counts[which], state = _correct(
            mean, sqrt(mean), float64(counts[which]), _fraction(words[which]), state
        )
    for n in range(count):
        row[pixels[n]] = counts[n]
    return state


@jit(inline="always")
def _fraction(word: Any) -> float:
    """A uniform number in (0, 1) from 32 random bits."""
    return (float64(word) + 0.5) * 2.0**-32 + 0.5


@jit
def _correct(mean: float, sigma: float, k: float, u: float, state: Any) -> Any:
    """PD's steps P to H: quotient acceptance, then rejection from a double exponential."""
    if k >= 0:
        px, py, fx, fy = _densities(mean, sigma, k)
        if fy * (1 - u) <= py * exp(px - fx):
            return k, state
    while True:
        v, state = _uniform(state)
        e = -log(v)
        v, state = _uniform(state)
        v = 2 * v - 1
        t = 1.8 + (e if v >= 0 else -e)
        if t <= -0.6744:
            continue
        k = np.floor(mean + sigma * t)
        px, py, fx, fy = _densities(mean, sigma, k)
        if 0.1069 / mean * abs(v) <= py * exp(px + e) - fy * exp(fx + e):
            return k, state


@jit
def _densities(mean: float, sigma: float, k: float) -> Any:
    """PD's procedure F: the Poisson probability of k is py exp(px), that of the discrete normal is about fy exp(fx).

    k >= 10 by Stirling's series: px = k (log(1 + v) - v) - 1/(12 k) + ..., v = (mean - k) / k.
    """
    if k < 10:
        px = -mean
        py = 1.0
        for i in range(int(k)):
            py *= mean / (i + 1)
    else:
        v = (mean - k) / k
        r = 1 / (k * k)
        # Stirling's series with k (log(1 + v) - v) avoids cancellation of large terms.
        px = k * (np.log1p(v) - v) - (1 / 12 - (1 / 360 - r / 1260) * r) / k
        py = 1 / sqrt(2 * pi * k)
    x2 = ((0.5 - mean + k) / sigma) ** 2
    b1 = 1 / (24 * mean)
    b2 = 0.3 * b1 * b1
    c3 = b1 * b2 / 7
    c2 = b2 - 15 * c3
    c1 = b1 - 6 * b2 + 45 * c3
    c0 = 1 - b1 + 3 * b2 - 15 * c3
    fy = (((c3 * x2 + c2) * x2 + c1) * x2 + c0) / (sqrt(2 * pi) * sigma)
    return px, py, -x2 / 2, fy


@jit
def normal(row: Any, state: Any, memory: Scratch) -> Any:
    """Fill a row with standard normal numbers (Box & Muller 1958). Returns the stream's next state.

    With u and v uniform, r cos(2 pi v) and r sin(2 pi v) of r = sqrt(-2 ln u) are normal and independent; they go to a
    pixel of the first half of the row and one of the second. u has 31 bits, and 52 more if it is below RARE / 2^31.
    Of v two bits choose the quadrant, and 30 the place in it. Sine and cosine are the polynomials of Cephes, the
    logarithm is that of FreeBSD's logf: both are within two units of the last place of single precision.
    """
    half = (row.size + 1) // 2
    radius = memory.radius
    exponent = memory.exponent
    bits = memory.bits[:half]
    state = _draws(bits, state)
    words = bits.view(np.int32)
    mantissa = radius.view(np.int32)
    rare = 0
    for n in range(half):
        steps = int32(words[n] & int32(0x7FFFFFFF))
        rare += steps < RARE
        radius[n] = (float32(steps) + float32(0.5)) * float32(2.0**-31)
    for n in range(half):
        # u = 2^exponent m with m from sqrt(1/2) to sqrt(2)
        above = int32(mantissa[n] - int32(ROOT_HALF_BITS))
        exponent[n] = float32(int32(above >> int32(23)))
        mantissa[n] = int32(int32(above & int32(0x7FFFFF)) + int32(ROOT_HALF_BITS))
    for n in range(half):
        radius[n] = np.sqrt(float32(-2) * _log(radius[n], exponent[n]))
    if rare:
        state = _lengthen(radius[:half], words, state)
    second = row[half:]
    for n in range(row.size - half):
        x, y = _direction(words[half + n])
        row[n] = radius[n] * x
        second[n] = radius[n] * y
    if row.size < 2 * half:
        row[half - 1] = radius[half - 1] * _direction(words[2 * half - 1])[0]
    return state


@jit
def _log(mantissa: Any, exponent: Any) -> Any:
    """Natural logarithm of 2^exponent times a number near 1: with s = f / (2 + f), ln(1 + f) = 2 artanh(s)."""
    f = mantissa - float32(1)
    s = f / (float32(2) + f)
    z = s * s
    w = z * z
    odd = z * (float32(0.66666662693) + w * float32(0.28498786688))
    even = w * (float32(0.40000972152) + w * float32(0.24279078841))
    square = float32(0.5) * f * f
    # ln 2 in two parts
    low = exponent * float32(9.0580006145e-06)
    high = exponent * float32(6.9313812256e-01)
    return s * (square + (even + odd)) + low - square + f + high


@jit
def _direction(word: Any) -> Any:
    """Cosine and sine of an angle from 32 random bits: two for the quadrant, the others for the angle in it."""
    steps = int32(int32(word << int32(2)) >> int32(2))
    angle = (float32(steps) + float32(0.5)) * float32(pi / 2**31)
    z = angle * angle
    x = (float32(2.443315711809948e-5) * z - float32(1.388731625493765e-3)) * z + float32(
        4.166664568298827e-2
    )
    y = (float32(-1.9515295891e-4) * z + float32(8.3321608736e-3)) * z - float32(1.6666654611e-1)
    x = x * z * z - float32(0.5) * z + float32(1)
    y = y * z * angle + angle
    turned = int32(word & int32(1 << 30)) != 0
    sign = float32(1) if word < 0 else float32(-1)
    return sign * (-y if turned else x), sign * (x if turned else y)


@jit
def _lengthen(radius: Any, words: Any, state: Any) -> Any:
    """Set the radii of the least u, which have too few bits, with more of them. Returns the stream's next state."""
    for n in range(radius.size):
        steps = int32(words[n] & int32(0x7FFFFFFF))
        if steps < RARE:
            more, state = _uniform(state)
            radius[n] = sqrt(-2 * log((steps + more) * 2.0**-31))
    return state
