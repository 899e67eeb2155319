"""Fast exact random numbers for millions of pixels: Poisson counts and Gaussian read noise.

Photo-electrons follow a Poisson law of the expected number in each pixel; read noise is normal. `count` draws the
Poisson numbers: below INVERSION_MAX_E electrons by inversion of the distribution function with a guide table, above
by the PD algorithm of Ahrens & Dieter (1982), which corrects a rounded normal number so that the law is exact. `normal`
uses the ziggurat of Marsaglia & Tsang (2000). Both take less than one 64-bit draw per pixel on average.

Every row of a frame has its own SplitMix64 stream (Steele, Lea & Flood 2014) from a seed that the frame's generator
drew, so the result does not depend on the order of the rows or the number of threads. A stream's state is one
integer; the functions take it and return its next value.
"""

from __future__ import annotations

from functools import lru_cache
from math import erfc, exp, log, pi, sqrt
from typing import Any, NamedTuple

import numpy as np
from numba import float32, float64, int32, int64, uint32, uint64
from numpy.random import Generator
from numpy.typing import NDArray

from skysim.core.jit import jit

BUCKETS = 1024  # ten bits, six pixels per draw; the rows of a dark frame's means then fit the L1 cache
GUIDES_PER_E = 128  # guide tables per electron of mean
INVERSION_MAX_E = 16.0  # means above it use the PD algorithm
AMBIGUOUS = 255  # entry of the guide table for buckets that more than one count shares
LAYERS = 512  # nine bits for the layer and 23 for the position in it: two numbers per draw
POSITION_STEPS = 2.0**22

GAMMA = 0x9E3779B97F4A7C15
MIX1, MIX2 = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB


class Tables(NamedTuple):
    """Lookup tables of the draws.

    guide : (INVERSION_MAX_E * GUIDES_PER_E, BUCKETS) counts: row k is for means from k to k + 1 over GUIDES_PER_E,
            bucket b holds the count of every uniform number in [b, b + 1) / BUCKETS, or AMBIGUOUS
    edge, height : (LAYERS + 1,) the ziggurat's corners x and exp(-x^2 / 2)
    width, accept : (LAYERS,) x and the next x over x, in steps of the signed 23-bit position in a layer
    """

    guide: NDArray[np.uint8]
    edge: NDArray[np.float64]
    height: NDArray[np.float64]
    width: NDArray[np.float32]
    accept: NDArray[np.int32]


@lru_cache(maxsize=1)
def tables() -> Tables:
    """The tables, made once per process in 20 ms."""
    edge = ziggurat()
    width = (edge[:LAYERS] / POSITION_STEPS).astype(np.float32)
    accept = (edge[1:] / edge[:LAYERS] * POSITION_STEPS).astype(np.int32)
    return Tables(_guide(), edge, np.exp(-(edge**2) / 2), width, accept)


def seeds(rng: Generator, rows: int) -> NDArray[np.uint64]:
    """A seed for the stream of every row."""
    return rng.integers(0, 2**64, rows, dtype=np.uint64)


def ziggurat() -> NDArray[np.float64]:
    """(LAYERS + 1,) corners of layers of equal area under exp(-x^2 / 2) (Marsaglia & Tsang 2000).

    The lowest layer holds the tail beyond r: its corner is area / height. The layers built on r reach exactly the
    peak for only one r, found by bisection.
    """

    def stack(r: float) -> tuple[NDArray[np.float64], bool]:
        area = r * exp(-(r**2) / 2) + sqrt(pi / 2) * erfc(r / sqrt(2))
        x = np.zeros(LAYERS + 1)
        x[0], x[1] = area * exp(r**2 / 2), r
        for n in range(2, LAYERS + 1):
            next_height = area / x[n - 1] + exp(-(x[n - 1] ** 2) / 2)
            if next_height >= 1:
                return x, True
            x[n] = sqrt(-2 * log(next_height))
        return x, False

    low, high = 3.0, 5.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if stack(middle)[1] else (low, middle)  # an r too small passes the peak
    x = stack(high)[0]
    x[LAYERS] = 0.0
    return x


@jit
def _guide() -> Any:
    """The guide table of the Poisson law for small means.

    A count n is certain where the whole bucket is above F(n - 1) of the smallest mean and below F(n) of the greatest
    mean of the row, since F falls with the mean. The other buckets, one at each step of F and 1/GUIDES_PER_E of the
    numbers, are AMBIGUOUS.
    """
    rows = int(INVERSION_MAX_E * GUIDES_PER_E)
    guide = np.empty((rows, BUCKETS), np.uint8)
    for k in range(rows):
        low, high = k / GUIDES_PER_E, (k + 1) / GUIDES_PER_E
        p_low, p_high, n, below = exp(-low), exp(-high), 0, 0.0
        f_low, f_high = p_low, p_high
        for b in range(BUCKETS):
            while b / BUCKETS >= f_low and n < AMBIGUOUS - 1:
                n += 1
                below = f_low
                p_low, p_high = p_low * low / n, p_high * high / n
                f_low, f_high = f_low + p_low, f_high + p_high
            guide[k, b] = n if b / BUCKETS >= below and (b + 1) / BUCKETS <= f_high else AMBIGUOUS
    return guide


@jit(inline="always")
def draw(state: Any) -> Any:
    """64 random bits (SplitMix64) and the stream's next state."""
    state += uint64(GAMMA)
    z = (state ^ (state >> uint64(30))) * uint64(MIX1)
    z = (z ^ (z >> uint64(27))) * uint64(MIX2)
    return z ^ (z >> uint64(31)), state


@jit(inline="always")
def _uniform(state: Any) -> Any:
    """A uniform number in (0, 1) with 52 bits, and the next state."""
    bits, state = draw(state)
    return (float64(int64(bits >> uint64(12))) + 0.5) * 2.0**-52, state


@jit
def count(row: Any, state: Any, tables: Tables) -> Any:
    """Turn a row of means >= 0 into Poisson counts, exactly, in place. Returns the stream's next state.

    Small means use inversion: ten bits choose the guide's bucket, and only where the count is not certain more bits
    are drawn and the law is summed at the exact mean. Large means use Ahrens & Dieter's PD (1982), see
    `_count_large`.
    """
    large, n_large = np.empty(row.size, np.int32), 0
    bits = uint64(0)
    for x in range(row.size):
        # One draw of 64 bits serves six pixels of ten bits each.
        if x % 6 == 0:
            bits, state = draw(state)
        bucket = bits & uint64(BUCKETS - 1)  # unsigned: saves numba's check for negative indices
        bits >>= uint64(10)
        mean = row[x]
        if mean < float32(INVERSION_MAX_E):
            drawn = tables.guide[uint64(int64(mean * float32(GUIDES_PER_E))), bucket]
            row[x] = float32(drawn)
            if drawn == AMBIGUOUS:
                remainder, state = _uniform(state)
                row[x] = _invert(float64(mean), (float64(int64(bucket)) + remainder) / BUCKETS)
        else:
            large[n_large] = x
            n_large += 1
    if n_large > 0:
        state = _count_large(row, large[:n_large], state, tables.edge, tables.height, tables.width, tables.accept)
    return state


@jit
def _invert(mean: Any, u: Any) -> Any:
    """The least n with F(n) > u, by summing the Poisson law."""
    n, p = 0.0, exp(-mean)
    total = p
    while u >= total and n < 1000.0:
        n += 1.0
        p *= mean / n
        total += p
    return n


@jit
def _count_large(row: Any, rows_large: Any, state: Any, edge: Any, height: Any, width: Any, accept: Any) -> Any:
    """Poisson counts for the chosen pixels of a row, with means of at least ten.

    PD: the floor of a normal number of the same mean and variance has the Poisson law but for an error of order
    mean^-1/2. A squeeze accepts most numbers without computing the law: u >= (mean - k)^3 / (6 mean^2). The rest go
    to `_correct`, which accepts or replaces them so that the law is exact.
    """
    for x in rows_large:
        mean = float64(row[x])
        sigma = sqrt(mean)
        bits, state = draw(state)
        layer, position = uint32(bits) & uint32(LAYERS - 1), int32(uint32(bits)) >> int32(9)
        g = float32(position) * width[layer]
        # Inside the next, narrower layer the position is accepted; about 1 in 160 is not.
        if abs(position) >= accept[layer]:
            g, state = _ziggurat_edge(int64(position), int64(layer), state, edge, height)
        k = np.floor(mean + sigma * g)
        u = float64(int64(bits >> uint64(32))) * 2.0**-32
        deficit = mean - k
        # PD accepts every k above mean - 1.1484 at once, and the squeeze most of the others.
        if min(deficit, deficit * deficit * deficit - 6 * mean * mean * u) > 1.1484:
            k, state = _correct(mean, sigma, k, u, state)
        row[x] = k
    return state


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
        px, py = -mean, 1.0
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
def normal(row: Any, state: Any, tables: Tables) -> Any:
    """Fill a row with standard normal numbers by the ziggurat. Returns the stream's next state.

    Of 32 bits nine choose the layer and 23, signed, the position in it; 99.4 % need no more. (`_count_large` repeats
    these lines: a function that takes the Tables tuple would count references to its arrays, ten times the work.)
    """
    for x in range(0, row.size, 2):
        bits, state = draw(state)
        for k in range(2):
            if x + k < row.size:
                layer, position = uint32(bits) & uint32(LAYERS - 1), int32(uint32(bits)) >> int32(9)
                row[x + k] = float32(position) * tables.width[layer]
                if abs(position) >= tables.accept[layer]:
                    row[x + k], state = _ziggurat_edge(int64(position), int64(layer), state, tables.edge, tables.height)
                bits >>= uint64(32)
    return state


@jit
def _ziggurat_edge(position: Any, layer: Any, state: Any, edge: Any, height: Any) -> Any:
    """The ziggurat's slow path: test the position against the density, or draw from the tail in the lowest layer."""
    while True:
        x = position * (edge[layer] / POSITION_STEPS)
        if abs(x) < edge[layer + 1]:
            return float32(x), state
        if layer == 0:
            return _ziggurat_tail(position, state, edge[1])
        u, state = _uniform(state)
        low, high = height[layer], height[layer + 1]
        if low + u * (high - low) < exp(-x * x / 2):
            return float32(x), state
        bits, state = draw(state)
        layer, position = int64(bits & uint64(LAYERS - 1)), int64(int32(bits) >> int32(9))


@jit
def _ziggurat_tail(sign: Any, state: Any, start: float) -> Any:
    """A normal number beyond `start`, with the given sign (Marsaglia 1964)."""
    while True:
        u, state = _uniform(state)
        v, state = _uniform(state)
        a = -log(u) / start
        if -2 * log(v) > a * a:
            return float32(start + a if sign > 0 else -start - a), state
