"""Codes of LEDs: which LED a light is, from its brightness over successive frames.

An LED repeats a word of bits. In an exposure its light is a T, with the brightness a, which is unknown, and the
template T, the mean level of the bits in the exposure by their shares of its time. A word's misfit to a light y in
frames j is its negative log likelihood, with normal errors sigma of which a few are gross (a bit that failed, a blend):

    misfit = min over a of sum over j of min((y_j - a T_j)^2 / (2 sigma_j^2), GROSS)

A receiver that does not know the code's time tries all words at some phases of it, and adds the error of a level by
that of the phase to sigma: an exposure that crosses a bit's edge counts less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.core import checks
from estimator.core.arrays import Floats, Ints
from estimator.core.errors import ImageError
from estimator.core.jit import jit

GROSS = 7.0  # misfit of a gross error: one of a thousand
# errors at first sight, and the greatest excess of their misfit
ROUGH = 0.1
LIKELY = 40.0
PHASES_PER_BIT = 8  # phases that a free-running receiver tries


@dataclass(frozen=True, slots=True)
class LedCode:
    """The words of a dome's LEDs as the tracker knows them.

    levels     : (N, B) part of its light that each LED shows in each bit, 0 to 1, in the order of the LED map
    bit_time_s : of one bit, of a free-running clock of unknown phase; None if frame n shows bit n
    """

    levels: Floats
    bit_time_s: float | None = None

    def __post_init__(self) -> None:
        levels = checks.floats("code: levels", self.levels, (None, None))
        if (
            levels.size == 0
            or not ((levels >= 0) & (levels <= 1)).all()
            or not (np.ptp(levels, axis=1) > 0).all()
        ):
            raise ImageError(
                "code: levels; allowed: 0 to 1, of each LED two different ones or more"
            )
        object.__setattr__(self, "levels", levels)
        if self.bit_time_s is not None:
            bit_time_s = checks.number(
                "code: bit_time_s", self.bit_time_s, 1e-9, 1e9, "above 0, or None"
            )
            object.__setattr__(self, "bit_time_s", bit_time_s)

    @property
    def bits(self) -> int:
        return self.levels.shape[1]

    @property
    def phases(self) -> Floats:
        """(P,) phases to try, in bits: the code's time at t = 0."""
        if self.bit_time_s is None:
            return np.zeros(1)
        return np.arange(self.bits * PHASES_PER_BIT) / PHASES_PER_BIT

    def templates(self, frame: int, begin_s: float, end_s: float) -> tuple[Floats, Floats]:
        """(P, N) mean level of each LED in the exposure of a frame, at each phase, and its error by the phase.

        The phase is uniform over a step of the phases, and the level about linear in it: the standard deviation is the
        change over the step divided by sqrt(12).
        """
        if self.bit_time_s is None:
            shown = self.levels[None, :, frame % self.bits]
            return shown, np.zeros_like(shown)
        begin = begin_s / self.bit_time_s % self.bits + self.phases
        length = max((end_s - begin_s) / self.bit_time_s, 1e-6)
        half = 0.5 / PHASES_PER_BIT
        before, at, after = (
            (self._shown_until(begin + step + length) - self._shown_until(begin + step)).T / length
            for step in (-half, 0.0, half)
        )
        return at, np.maximum(np.abs(at - before), np.abs(after - at)) / np.sqrt(3)

    def _shown_until(self, time: Floats) -> Floats:
        """(N, P) integral of each LED's level from 0 to P times, in bits."""
        total = np.concatenate(
            [np.zeros((len(self.levels), 1)), np.cumsum(self.levels, axis=1)], axis=1
        )
        periods, within = np.divmod(time, self.bits)
        bit = np.minimum(within.astype(np.int64), self.bits - 1)
        return total[:, -1:] * periods + total[:, bit] + (within - bit) * self.levels[:, bit]


def misfits(light: Floats, sigma: Floats, templates: Floats, spread: Floats) -> Floats:
    """(T, W) misfit of W templates (W, J) to each of T lights (T, J) with errors sigma; a NaN is no measurement.

    spread : (W, J) error of a template by the unknown phase
    """
    arrays = (np.ascontiguousarray(one, dtype=float) for one in (light, sigma, templates, spread))
    out = np.empty((len(light), len(templates)))
    _misfits(*arrays, out)
    return out


@jit
def _misfits(light: Floats, sigma: Floats, templates: Floats, spread: Floats, out: Floats) -> None:
    """Write the misfits. The brightness is fitted twice: from all frames, and from the brightest one."""
    weight = np.empty(light.shape[1])
    for t in range(len(light)):
        top = 0.0
        for j in range(light.shape[1]):
            if light[t, j] > top:
                top = light[t, j]
        for w in range(len(templates)):
            for j in range(len(weight)):
                weight[j] = 0.0
                if abs(light[t, j]) < np.inf:
                    weight[j] = 1 / (sigma[t, j] ** 2 + (top * spread[w, j]) ** 2)
            least = np.inf
            for start in (_brightness(light[t], weight, templates[w], 0.0, False), top):
                fitted = _brightness(light[t], weight, templates[w], start, True)
                least = min(least, _misfit(light[t], weight, templates[w], fitted))
            out[t, w] = least


@jit
def _brightness(
    light: Floats, weight: Floats, template: Floats, start: float, selects: bool
) -> float:
    """Least-squares brightness; with `selects` of the frames without a gross error at a first brightness."""
    product = 0.0
    square = 0.0
    for j in range(len(light)):
        if weight[j] == 0 or (
            selects and (light[j] - start * template[j]) ** 2 * weight[j] > 2 * GROSS
        ):
            continue
        product += weight[j] * light[j] * template[j]
        square += weight[j] * template[j] ** 2
    return product / square if square > 0 else start


@jit
def _misfit(light: Floats, weight: Floats, template: Floats, brightness: float) -> float:
    total = 0.0
    for j in range(len(light)):
        if weight[j] > 0:
            total += min((light[j] - brightness * template[j]) ** 2 * weight[j] / 2, GROSS)
    return total


def likely(light: Floats, templates: Floats) -> Ints:
    """Rows of the (W, J) templates that a light (J,) does not exclude at first sight; a NaN is no measurement.

    By least squares with errors of ROUGH of the brightest frame, which make little of an edge or a failed bit.
    """
    seen = np.isfinite(light)
    y = light[seen] / light[seen].max() / ROUGH
    shown = templates[:, seen]
    square = np.maximum(np.einsum("wj,wj->w", shown, shown), 1e-300)
    misfit = (y @ y - (shown @ y) ** 2 / square) / 2
    return np.flatnonzero(misfit <= misfit.min() + LIKELY)


def excess_noise(least: Floats, measured: Floats | Ints) -> float:
    """The factor by which squared errors exceed the assumed ones, 1 or more, from the least misfit of each light (T,).

    Half a chi-square of n measurements has the mean n / 2 (Birge 1932, Phys. Rev. 40, 207: errors are enlarged until
    the residuals are as large as expected). The median over the lights leaves out one that is no LED.
    """
    return max(1.0, float(np.median(least / (np.asarray(measured) / 2))))


def expected_misfit(measured: Floats | Ints) -> Floats:
    """(T,) greatest misfit of the true word to so many measurements that is not suspicious.

    Half a chi-square has the mean n / 2 and the variance n / 2; beside it one gross error, and one in six.
    """
    return measured / 2 + 3 * np.sqrt(measured / 2) + GROSS * np.maximum(1.0, measured / 6)
