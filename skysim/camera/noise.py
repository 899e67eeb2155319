"""Fast exact random numbers for millions of pixels: Poisson counts and Gaussian read noise.

The noise law: the photo-electrons of a pixel follow a Poisson law of their expected number m, P(n) = exp(-m) m^n / n!,
with the variance m; read noise is normal and independent of them. `detector` puts both together.

1. `count` draws the Poisson numbers: below INVERSION_MAX_E electrons by inversion of the distribution function F, the
   least n with F(n) > u for a uniform u, with a guide table.
2. Above, `_count_large` uses the PD algorithm of Ahrens & Dieter (1982, ACM Trans. Math. Softw. 8, 163), which corrects
   a rounded normal number so that the law is exact.
3. `normal` uses the transform of Box & Muller (1958, Ann. Math. Stat. 29, 610).

Each takes half a 64-bit draw per pixel at most, and a row in a few loops without branches, which compilers turn into
vector instructions; the few pixels that need more are treated afterwards.

Every row of a frame has its own SplitMix64 stream (Steele, Lea & Flood 2014) from a seed that the frame's generator
drew, so the result does not depend on the order of the rows or the number of threads. A stream's state is one
integer; the functions take it and return its next value.
"""

from functools import lru_cache
from math import exp, log, pi, sqrt
from typing import Any, NamedTuple

import numpy as np
from numba import float32, float64, int32, int64, uint8, uint16, uint32, uint64
from numba.cpython.unsafe.numbers import trailing_zeros
from numpy.random import Generator
from numpy.typing import NDArray

from skysim.core.jit import jit, loop
from skysim.core.types import Singles

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

# SplitMix64: the increment of the state, and the multipliers that mix its bits.
GAMMA = 0x9E3779B97F4A7C15
MIX1 = 0xBF58476D1CE4E5B9
MIX2 = 0x94D049BB133111EB
ROOT_HALF_BITS = 0x3F3504F3  # the single-precision number sqrt(1/2)


class Scratch(NamedTuple):
    """Memory for one row at a time. A NamedTuple, because numba can compile functions that take one.

    Attributes
    ----------
    bits
        (W / 2,) 64-bit draws, for a row of W pixels
    cell, late
        (W,) cells of the guide table, and indices of pixels that need more work
    found
        (W,) counts or marks, padded to a multiple of eight bytes
    radius, exponent
        (W / 2,) the radii of Box & Muller, and exponents of their uniform numbers
    normals, means
        (W,) normal numbers, and means of the pixels that PD counts
    """

    bits: NDArray[np.uint64]
    cell: NDArray[np.int32]
    late: NDArray[np.int32]
    found: NDArray[np.uint8]
    radius: Singles
    exponent: Singles
    normals: Singles
    means: Singles


@jit
def scratch(width: int) -> Scratch:
    """Memory for rows of `width` pixels."""
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
    """The guide table, (INVERSION_MAX_E * GUIDES_PER_E + 1, BUCKETS), made once per process in 20 ms.

    Row k is for means from k to k + 1 over GUIDES_PER_E. Bucket b holds the count that every uniform number in
    [b, b + 1) / BUCKETS gives, or AMBIGUOUS. The last row is LARGE.
    """
    return _guide()


def seeds(rng: Generator, rows: int) -> NDArray[np.uint64]:
    """(rows,) a seed for the stream of every row."""
    return rng.integers(0, 2**64, rows, dtype=np.uint64)


@jit
def _guide() -> Any:
    """The guide table of the Poisson law for small means (`guide`).

    F(n) = sum over i <= n of exp(-m) m^i / i!. A count n is certain where the whole bucket is above F(n - 1) of the
    smallest mean and below F(n) of the greatest mean of the row, since F falls with the mean. The other buckets, one at
    each step of F and a fraction of 1 / GUIDES_PER_E of the numbers, are AMBIGUOUS.
    """
    rows = int(INVERSION_MAX_E * GUIDES_PER_E)
    guide = np.full((rows + 1, BUCKETS), np.uint8(LARGE))
    for k in range(rows):
        low = k / GUIDES_PER_E
        high = (k + 1) / GUIDES_PER_E
        p_low = exp(-low)
        p_high = exp(-high)
        # The probability of n and F(n), at both ends of the row's means.
        n = 0
        below = 0.0
        f_low = p_low
        f_high = p_high
        for b in range(BUCKETS):
            # The count at the bucket's lower end, for the smallest mean.
            while b / BUCKETS >= f_low and n < LARGE_BIT - 1:
                n += 1
                below = f_low
                p_low = p_low * low / n
                p_high = p_high * high / n
                f_low = f_low + p_low
                f_high = f_high + p_high
            guide[k, b] = (
                n if b / BUCKETS >= below and (b + 1) / BUCKETS <= f_high else AMBIGUOUS
            )
    return guide


@jit(inline="always")
def _mixed(state: Any) -> Any:
    """The 64 random bits of a state: two rounds of multiplication and shifting (SplitMix64's finalizer)."""
    z = (state ^ (state >> uint64(30))) * uint64(MIX1)
    z = (z ^ (z >> uint64(27))) * uint64(MIX2)
    return z ^ (z >> uint64(31))


@loop
def _draws(bits: Any, state: Any) -> Any:
    """Fill an array with the stream's next 64-bit numbers. Returns the stream's next state."""
    for n in range(bits.size):
        bits[n] = _mixed(state + uint64(n + 1) * uint64(GAMMA))
    return state + uint64(bits.size) * uint64(GAMMA)


@jit(inline="always")
def _uniform(state: Any) -> Any:
    """A uniform number in (0, 1) with 52 bits, and the stream's next state."""
    state += uint64(GAMMA)
    return (float64(int64(_mixed(state) >> uint64(12))) + 0.5) * 2.0**-52, state


@loop
def count(row: Any, state: Any, guide: Any, memory: Scratch) -> Any:
    """Turn a row of means >= 0 into Poisson counts, exactly, in place. Returns the stream's next state.

    1. If every mean is large, use PD for the whole row.
    2. Else look each pixel's count up: its mean gives the row of the guide table, ten of its 16 random bits the bucket.
    3. Where the table has no count: large means are left to PD. In an ambiguous bucket more random bits are drawn, and
       the law is summed at the exact mean.
    4. Write the counts back, and count the large means by PD (`_count_large`).
    """
    cell = memory.cell
    late = memory.late
    found = memory.found
    width = row.size
    bits = memory.bits[: (row.size + 3) // 4]
    # 1. Large means alone. In most rows the first pixel is not large, which ends the search.
    large = 0
    while large < width and row[large] >= float32(INVERSION_MAX_E):
        large += 1
    if large == width:
        for x in range(width):
            late[x] = x
        return _count_large(row, late[:width], state, memory)
    # 2. The cell of the guide table for each pixel.
    state = _draws(bits, state)
    words = bits.view(np.uint16)
    table = guide.reshape(-1)
    for x in range(width):
        k = int32(
            min(row[x] * float32(GUIDES_PER_E), float32(INVERSION_MAX_E * GUIDES_PER_E))
        )
        cell[x] = int32(int32(k * int32(BUCKETS)) + int32(words[x] >> uint16(6)))
    for x in range(width):
        # Unsigned: saves numba's check for negative indices.
        found[x] = table[uint64(uint32(cell[x]))]
    # 3. Pixels without a certain count; the large ones are collected at the front of `late`.
    large = 0
    for n in range(_marked(found, late)):
        x = late[n]
        if found[x] == LARGE:
            late[large] = x
            large += 1
        else:
            more, state = _uniform(state)
            found[x] = uint8(
                _invert(
                    float64(row[x]), (float64(int64(words[x] >> uint16(6))) + more) / BUCKETS
                )
            )
    # 4. Write the counts to the row.
    for x in range(width):
        row[x] = row[x] if found[x] == LARGE else float32(found[x])
    return _count_large(row, late[:large], state, memory) if large else state


@loop
def _marked(found: Any, late: Any) -> int:
    """Write the indices of the entries with the highest bit to `late`, in order; return their number.

    Eight entries are tested at once.
    """
    eights = found.view(np.uint64)
    count = 0
    for n in range(eights.size):
        marks = eights[n] & uint64(EIGHT_BITS)
        while marks:
            late[count] = 8 * n + (trailing_zeros(marks) >> 3)
            count += 1
            # Without the lowest mark.
            marks &= marks - uint64(1)
    return count


@jit
def _invert(mean: Any, u: Any) -> Any:
    """The least n with F(n) > u, by summing the Poisson law p(n) = p(n - 1) mean / n."""
    n = 0.0
    p = exp(-mean)
    total = p
    # The first steps without branches, most of which would be mispredicted.
    for k in range(1, 6):
        n += u >= total
        p *= mean / k
        total += p
    while u >= total and n < LARGE_BIT - 1:
        n += 1.0
        p *= mean / n
        total += p
    return n


@loop
def _count_large(row: Any, pixels: Any, state: Any, memory: Scratch) -> Any:
    """Poisson counts for the chosen pixels of a row, with means of at least ten, by PD.

    1. The floor k of a normal number of the same mean and variance has the Poisson law but for an error of order
       mean^-1/2.
    2. PD accepts every k above mean - 1.1484 at once. A squeeze accepts most of the others without computing the law:
       u >= (mean - k)^3 / (6 mean^2).
    3. The rest go to `_correct`, which accepts or replaces them so that the law is exact.
    """
    count = pixels.size
    # Whole eights.
    found = memory.found[: (count + 7) // 8 * 8]
    counts = memory.normals[:count]
    means = memory.means[:count]
    # 1. Normal numbers first, then a uniform number of 32 bits for each pixel.
    bits = memory.bits[: (count + 1) // 2]
    state = _draws(bits, normal(counts, state, memory))
    words = bits.view(np.int32)
    found[:] = 0
    for n in range(count):
        means[n] = row[pixels[n]]
    for n in range(count):
        mean = float64(means[n])
        k = np.floor(mean + np.sqrt(mean) * counts[n])
        # 2. The squeeze has room for the 1.1484 too (checked for means from 10 to 5000): the law stays exact.
        deficit = mean - k
        squeezed = deficit * deficit * deficit - 6 * mean * mean * _fraction(words[n])
        found[n] = uint8(LARGE) if (deficit > 1.1484) & (squeezed > 1.1484) else uint8(0)
        counts[n] = k
    # 3. The few that are neither accepted at once nor by the squeeze.
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
    """A uniform number in (0, 1) from 32 random bits, read as a signed integer."""
    return (float64(word) + 0.5) * 2.0**-32 + 0.5


@jit
def _correct(mean: float, sigma: float, k: float, u: float, state: Any) -> Any:
    """PD's steps P to H for a normal number k that was not accepted: keep it, or draw another from the difference.

    1. Quotient acceptance: keep k if fy (1 - u) <= py exp(px - fx), with the densities of `_densities`.
    2. Else draw t from a double exponential about 1.8, limited to where the Poisson law exceeds the normal, and accept
       the k at t standard deviations by rejection.
    """
    # 1. Quotient acceptance (steps P, Q).
    if k >= 0:
        px, py, fx, fy = _densities(mean, sigma, k)
        if fy * (1 - u) <= py * exp(px - fx):
            return k, state
    # 2. Double exponential and hat acceptance (steps E, H).
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

    For k >= 10 by Stirling's series: px = k (log(1 + v) - v) - 1/(12 k) + ..., v = (mean - k) / k; py = 1 / sqrt(2 pi
    k). The normal density at x = (k + 1/2 - mean) / sigma is corrected by a polynomial of the third degree in x^2.

    Returns px, py, fx, fy.
    """
    if k < 10:
        px = -mean
        py = 1.0
        for i in range(int(k)):
            py *= mean / (i + 1)
    else:
        v = (mean - k) / k
        r = 1 / (k * k)
        # This form avoids the cancellation of large terms.
        px = k * (np.log1p(v) - v) - (1 / 12 - (1 / 360 - r / 1260) * r) / k
        py = 1 / sqrt(2 * pi * k)
    x2 = ((0.5 - mean + k) / sigma) ** 2
    # PD's coefficients of the discrete normal's correction.
    b1 = 1 / (24 * mean)
    b2 = 0.3 * b1 * b1
    c3 = b1 * b2 / 7
    c2 = b2 - 15 * c3
    c1 = b1 - 6 * b2 + 45 * c3
    c0 = 1 - b1 + 3 * b2 - 15 * c3
    fy = (((c3 * x2 + c2) * x2 + c1) * x2 + c0) / (sqrt(2 * pi) * sigma)
    return px, py, -x2 / 2, fy


@loop
def normal(row: Any, state: Any, memory: Scratch) -> Any:
    """Fill a row with standard normal numbers (Box & Muller 1958). Returns the stream's next state.

    With u and v uniform and r = sqrt(-2 ln u), the numbers r cos(2 pi v) and r sin(2 pi v) are normal and independent;
    they go to a pixel of the first half of the row and one of the second.

    1. u has 31 bits.
    2. ln u from u = 2^exponent m, by the polynomial of FreeBSD's logf.
    3. A u below RARE / 2^31 gets 52 more bits, so that the tails are right.
    4. Of v two bits choose the quadrant, and 30 the angle in it; sine and cosine are the polynomials of Cephes.

    Logarithm, sine and cosine are within two units of the last place of single precision.
    """
    half = (row.size + 1) // 2
    radius = memory.radius
    exponent = memory.exponent
    bits = memory.bits[:half]
    state = _draws(bits, state)
    words = bits.view(np.int32)
    mantissa = radius.view(np.int32)
    rare = 0
    # 1. Uniform numbers in (0, 1).
    for n in range(half):
        steps = int32(words[n] & int32(0x7FFFFFFF))
        rare += steps < RARE
        radius[n] = (float32(steps) + float32(0.5)) * float32(2.0**-31)
    # 2. Exponent and mantissa by the bits of the single-precision numbers.
    for n in range(half):
        # u = 2^exponent m with m from sqrt(1/2) to sqrt(2).
        above = int32(mantissa[n] - int32(ROOT_HALF_BITS))
        exponent[n] = float32(int32(above >> int32(23)))
        mantissa[n] = int32(int32(above & int32(0x7FFFFF)) + int32(ROOT_HALF_BITS))
    # r = sqrt(-2 ln u).
    for n in range(half):
        radius[n] = np.sqrt(float32(-2) * _log(radius[n], exponent[n]))
    # 3. More bits for the smallest u.
    if rare:
        state = _lengthen(radius[:half], words, state)
    # 4. The second half of the draws gives the angles. Slices, since an index half + n might be negative for numba.
    second = row[half:]
    angles = words[half:]
    for n in range(second.size):
        x, y = _direction(angles[n])
        row[n] = radius[n] * x
        second[n] = radius[n] * y
    # A row of odd width has one pixel without a partner.
    if row.size < 2 * half:
        row[half - 1] = radius[half - 1] * _direction(words[2 * half - 1])[0]
    return state


@jit
def _log(mantissa: Any, exponent: Any) -> Any:
    """Natural logarithm of 2^exponent times a number near 1.

    With f = mantissa - 1 and s = f / (2 + f), ln(1 + f) = 2 artanh(s) = f - f^2 / 2 + s (f^2 / 2 + R), R an even
    polynomial in s.
    """
    f = mantissa - float32(1)
    s = f / (float32(2) + f)
    z = s * s
    w = z * z
    odd = z * (float32(0.66666662693) + w * float32(0.28498786688))
    even = w * (float32(0.40000972152) + w * float32(0.24279078841))
    square = float32(0.5) * f * f
    # ln 2 in two parts, so that the product with the exponent is exact.
    low = exponent * float32(9.0580006145e-06)
    high = exponent * float32(6.9313812256e-01)
    return s * (square + (even + odd)) + low - square + f + high


@jit
def _direction(word: Any) -> Any:
    """Cosine and sine of an angle from 32 random bits: two for the quadrant, the others for the angle in it.

    The angle in the quadrant is within pi / 4 of its middle, where the polynomials are accurate.
    """
    steps = int32(int32(word << int32(2)) >> int32(2))
    angle = (float32(steps) + float32(0.5)) * float32(pi / 2**31)
    # cos and sin of the angle, by polynomials in its square.
    z = angle * angle
    x = (float32(2.443315711809948e-5) * z - float32(1.388731625493765e-3)) * z + float32(
        4.166664568298827e-2
    )
    y = (float32(-1.9515295891e-4) * z + float32(8.3321608736e-3)) * z - float32(
        1.6666654611e-1
    )
    x = x * z * z - float32(0.5) * z + float32(1)
    y = y * z * angle + angle
    # The quadrant: a turn by a quarter swaps the two, half a turn changes both signs.
    turned = int32(word & int32(1 << 30)) != 0
    sign = float32(1) if word < 0 else float32(-1)
    return sign * (-y if turned else x), sign * (x if turned else y)


@loop
def _lengthen(radius: Any, words: Any, state: Any) -> Any:
    """Give the smallest u, which have too few bits, more of them and set their radii. Returns the next state."""
    for n in range(radius.size):
        steps = int32(words[n] & int32(0x7FFFFFFF))
        if steps < RARE:
            more, state = _uniform(state)
            radius[n] = sqrt(-2 * log((steps + more) * 2.0**-31))
    return state
