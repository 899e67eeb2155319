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
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import on_sphere
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, ImageError, Ints
from estimator.core.jit import jit
from estimator.core.types import Centroids

GROSS = 7.0  # misfit of a gross error: one of a thousand
# errors at first sight, and the greatest excess of their misfit
ROUGH = 0.1
LIKELY = 40.0
PHASES_PER_BIT = 8  # phases that a free-running receiver tries


@dataclass(frozen=True, slots=True)
class LedCode:
    """The words of a dome's LEDs as the tracker knows them.

    Attributes
    ----------
    levels
        (N, B) part of its light that each LED shows in each bit, 0 to 1, in the order of the
        LED map
    bit_time_s
        Of one bit, of a free-running clock of unknown phase; None if frame n shows bit n
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

    Parameters
    ----------
    spread
        (W, J) error of a template by the unknown phase
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


# Lights followed from frame to frame, with the brightness of each in the last frames.


BORDER_PX = 30.0  # an LED nearer to the border of the sensor may be undetected


class LightTracks:
    """The tracks of a field's lights; T of them, with the last J frames.

    Attributes
    ----------
    pupil_m
        (3,) of the camera from the bearing, in camera axes
    radius_m
        Of the sphere about the bearing
    frames
        J
    gate_px
        Greatest distance of a light from its prediction
    patience
        Successive frames without its light after which a track ends
    goes_dark
        Whether an LED without light says that its level is 0; it is unknown otherwise
    light, sigma
        (T, J) and their errors, NaN without a measurement; frame n is in column n modulo J
    row
        (T,) row of each in the last frame's centroids, -1 without a light
    """

    def __init__(
        self,
        camera: Camera,
        pupil_m: Floats,
        radius_m: float,
        frames: int,
        gate_px: float,
        patience: int,
        goes_dark: bool,
    ) -> None:
        self.camera = camera
        self.pupil_m = pupil_m
        self.radius_m = radius_m
        self.frames = frames
        self.gate_px = gate_px
        self.patience = patience
        self.goes_dark = goes_dark
        self.clear()

    def clear(self) -> None:
        """Forget all lights and their motion."""
        self.point_m = np.empty((0, 3))
        self.light = np.empty((0, self.frames))
        self.sigma = np.empty((0, self.frames))
        self.row = np.empty(0, np.int64)
        self.missed = np.empty(0, np.int64)
        self.rate_rad_s = np.zeros(3)
        self.column = -1

    def advance(
        self,
        centroids: Centroids,
        sigma: Floats,
        elapsed_s: float,
        now_from_then: Rotation | None = None,
    ) -> None:
        """Continue the tracks with a frame's lights, and begin new ones.

        Parameters
        ----------
        sigma
            (N,) errors of the lights' brightness
        now_from_then
            cam(now) from cam(last frame), from a gyro
        """
        self.column = (self.column + 1) % self.frames
        turn = now_from_then or Rotation.from_rotvec(self.rate_rad_s * elapsed_s)
        predicted_m = turn.apply(self.point_m)
        xy_px = self.camera.pixels(predicted_m - self.pupil_m)
        seen_m = on_sphere(self.camera.rays(centroids.xy_px), self.pupil_m, self.radius_m)
        self.row = _mutual_nearest(xy_px, centroids.xy_px, self.gate_px)
        self._measure_motion(seen_m, elapsed_s)
        found = self.row >= 0
        self.point_m = np.where(
            found[:, None], seen_m[self.row] if len(seen_m) else predicted_m, predicted_m
        )
        self._record(
            centroids, sigma, self.camera.contains(np.nan_to_num(xy_px, nan=-1e9), BORDER_PX)
        )
        self.missed = np.where(found, 0, self.missed + 1)
        self._keep(
            found
            | (
                (self.missed <= self.patience)
                & self.camera.contains(np.nan_to_num(xy_px, nan=-1e9))
            )
        )
        self._begin(centroids, sigma, seen_m)

    def _measure_motion(self, seen_m: Floats, elapsed_s: float) -> None:
        """The rate of the lights between the last two frames, in camera axes; unchanged unless two are seen in both."""
        found = self.row >= 0
        if found.sum() >= 2 and elapsed_s > 0:
            turn, _ = Rotation.align_vectors(seen_m[self.row[found]], self.point_m[found])
            self.rate_rad_s = turn.as_rotvec() / elapsed_s

    def _record(self, centroids: Centroids, sigma: Floats, inside: NDArray[np.bool_]) -> None:
        """Store the brightness of each track; 0 for an LED that is dark well inside the field."""
        found = self.row >= 0
        dark = ~found & inside & self.goes_dark
        self.light[:, self.column] = np.where(dark, 0.0, np.nan)
        self.sigma[:, self.column] = np.nan
        self.light[found, self.column] = centroids.flux[self.row[found]]
        self.sigma[found, self.column] = sigma[self.row[found]]
        # A dark frame is as uncertain as the others, whose errors are those of the light itself.
        with np.errstate(invalid="ignore"):
            greatest = np.fmax.reduce(self.sigma, axis=1, initial=0.0)
        self.sigma[dark, self.column] = greatest[dark]

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        for name in ("point_m", "light", "sigma", "row", "missed"):
            setattr(self, name, getattr(self, name)[kept])

    def _begin(self, centroids: Centroids, sigma: Floats, seen_m: Floats) -> None:
        """New tracks for the lights that continue none."""
        new = np.setdiff1d(np.arange(len(centroids)), self.row)
        nothing = np.full((len(new), self.frames), np.nan)
        self.point_m = np.vstack([self.point_m, seen_m[new]])
        self.light, self.sigma = np.vstack([self.light, nothing]), np.vstack([self.sigma, nothing])
        self.row = np.concatenate([self.row, new])
        self.missed = np.concatenate([self.missed, np.zeros(len(new), np.int64)])
        first = len(self.row) - len(new)
        self.light[first:, self.column] = centroids.flux[new]
        self.sigma[first:, self.column] = sigma[new]


def _mutual_nearest(predicted_px: Floats, seen_px: Floats, gate_px: float) -> Ints:
    """(T,) row of the light nearest to each prediction, if both are each other's nearest within the gate, else -1."""
    row = np.full(len(predicted_px), -1)
    if not len(predicted_px) or not len(seen_px):
        return row
    distance = np.linalg.norm(predicted_px[:, None] - seen_px, axis=2)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    track = np.arange(len(row))
    good = (distance.argmin(axis=0)[nearest] == track) & (distance[track, nearest] <= gate_px)
    row[good] = nearest[good]
    return row
