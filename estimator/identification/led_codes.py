"""Codes of LEDs: which LED a light is, from its brightness over successive frames.

Each LED repeats a word of bits. In an exposure its light is a T: the unknown brightness a times the template T, the
mean level of the bits that the exposure covers, weighted by their shares of its time. The misfit of a word to the light
y_j of the frames j is its negative log likelihood, with normal errors sigma_j of which a few are gross (a failed bit, a
blend):

    misfit = min over a of sum over j of min((y_j - a T_j)^2 / (2 sigma_j^2), GROSS)

A receiver that does not know the time of the code tries all words at PHASES_PER_BIT phases in each bit. It adds the
error of a level by the error of the phase to sigma: an exposure that crosses the edge of a bit counts less.

Codes need the same light in successive frames. `LightTracks` follows the lights. Under a dome the points where rays
meet a sphere about the bearing turn rigidly with the vehicle, wherever the camera is on its lever:

1. Turn the points of the last frame by the motion since then, from a gyro or else the last motion of the lights.
2. Project them. A light continues the track whose prediction is nearest to it, and of which it is the nearest.
3. Measure the motion of the lights for the next frame.
4. Record the brightness of each track; 0 for an LED that is dark well inside the field.
5. End the tracks that have lost their light for too long, and begin tracks of new lights.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import on_sphere
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Allowed, Floats, Ints, frozen
from estimator.core.errors import ImageError
from estimator.core.jit import jit
from estimator.core.types import Centroids
from estimator.identification.direct_match import mutual_nearest

GROSS = 7.0  # misfit of a gross error: one of a thousand
ROUGH = 0.1  # `likely`: error of a light, as a fraction of the brightest frame
LIKELY = 40.0  # `likely`: greatest misfit in excess of the best word's
PHASES_PER_BIT = 8  # phases that a free-running receiver tries


@frozen
class LedCode:
    """The words of a dome's LEDs, as the tracker knows them.

    Attributes
    ----------
    levels
        (N, B) fraction of its light that each LED shows in each bit, 0 to 1, in the order of the LED map
    bit_time_s
        Duration of a bit, of a free-running clock of unknown phase; None if frame n shows bit n
    """

    levels: Floats
    bit_time_s: float | None = None

    def __post_init__(self) -> None:
        levels = checks.floats("code: levels", self.levels, (None, None))
        # An LED with the same level in all bits has no code.
        in_range = ((levels >= 0) & (levels <= 1)).all()
        if levels.size == 0 or not in_range or not (np.ptp(levels, axis=1) > 0).all():
            raise ImageError(
                "code: levels; allowed: 0 to 1, of each LED two different ones or more"
            )
        object.__setattr__(self, "levels", levels)
        allowed = Allowed(1e-9, 1e9, "above 0, or None", optional=True)
        checks.store_numbers(self, "code: ", {"bit_time_s": allowed})

    @property
    def bits(self) -> int:
        """Number of bits B of a word."""
        return self.levels.shape[1]

    @property
    def phases(self) -> Floats:
        """(P,) phases to try: the code's time at t = 0, in bits."""
        if self.bit_time_s is None:
            return np.zeros(1)
        return np.arange(self.bits * PHASES_PER_BIT) / PHASES_PER_BIT

    def templates(self, frame: int, begin_s: float, end_s: float) -> tuple[Floats, Floats]:
        """The mean level of each LED in the exposure of a frame, at each phase.

        The mean level is the integral of the level over the exposure, divided by its length. The phase is uniform
        over a step of the phases, and the level about linear in it, so that its standard deviation is the change
        over a whole step divided by sqrt(12), that over half a step divided by sqrt(3).

        Parameters
        ----------
        frame
            Number of the frame
        begin_s, end_s
            Exposure, in the time of the phases

        Returns
        -------
        level
            (P, N) mean levels
        error
            (P, N) standard deviation of the level by that of the phase
        """
        # Synchronized: the frame shows one bit, without an error of the phase.
        if self.bit_time_s is None:
            shown = self.levels[None, :, frame % self.bits]
            return shown, np.zeros_like(shown)
        # Free-running: begin and length of the exposure, in bits, at each phase.
        begin = begin_s / self.bit_time_s % self.bits + self.phases
        length = max((end_s - begin_s) / self.bit_time_s, 1e-6)
        half = 0.5 / PHASES_PER_BIT
        # The mean level half a step of the phase before, at, and after each phase.
        before = self._mean_level(begin - half, length)
        at = self._mean_level(begin, length)
        after = self._mean_level(begin + half, length)
        change = np.maximum(np.abs(at - before), np.abs(after - at))
        return at, change / np.sqrt(3)

    def _mean_level(self, begin: Floats, length: float) -> Floats:
        """(P, N) mean level of each LED in exposures of a length that begin at P times, in bits."""
        shown = self._shown_until(begin + length) - self._shown_until(begin)
        return shown.T / length

    def _shown_until(self, time: Floats) -> Floats:
        """(N, P) integral of each LED's level from 0 to P times, in bits."""
        total = np.pad(np.cumsum(self.levels, axis=1), ((0, 0), (1, 0)))
        # Whole periods, whole bits, and a part of a bit.
        periods, within = np.divmod(time, self.bits)
        bit = np.minimum(within.astype(np.int64), self.bits - 1)
        return total[:, -1:] * periods + total[:, bit] + (within - bit) * self.levels[:, bit]


def misfits(light: Floats, sigma: Floats, templates: Floats, spread: Floats) -> Floats:
    """Misfit of W words to each of T lights (see the module's equation).

    Parameters
    ----------
    light, sigma
        (T, J) brightness of the lights in J frames and its errors; a NaN is no measurement
    templates
        (W, J) templates of the words
    spread
        (W, J) error of a template by the unknown phase

    Returns
    -------
    Floats
        (T, W)
    """
    arrays = (
        np.ascontiguousarray(one, dtype=float) for one in (light, sigma, templates, spread)
    )
    return _misfits(*arrays)


@jit
def _misfits(light: Floats, sigma: Floats, templates: Floats, spread: Floats) -> Floats:
    """Return the (T, W) misfits of `misfits`, from arrays in row order.

    The brightness is fitted twice, as gross errors make the least-squares fit depend on its start: from the fit to all
    frames, and from the brightest frame. The better fit counts.
    """
    out = np.empty((len(light), len(templates)))
    weight = np.empty(light.shape[1])
    for t in range(len(light)):
        top = 0.0
        for j in range(light.shape[1]):
            if light[t, j] > top:
                top = light[t, j]
        # The error by the phase is proportional to the brightness, for which the brightest frame is taken.
        for w in range(len(templates)):
            for j in range(len(weight)):
                # Without a measurement the weight is 0.
                weight[j] = 0.0
                if abs(light[t, j]) < np.inf:
                    weight[j] = 1 / (sigma[t, j] ** 2 + (top * spread[w, j]) ** 2)
            # The brightness from two starts; the better fit counts.
            least = np.inf
            for start in (_brightness(light[t], weight, templates[w], 0.0, False), top):
                fitted = _brightness(light[t], weight, templates[w], start, True)
                least = min(least, _misfit(light[t], weight, templates[w], fitted))
            out[t, w] = least
    return out


@jit
def _brightness(
    light: Floats, weight: Floats, template: Floats, start: float, selects: bool
) -> float:
    """Least-squares brightness a = sum(w y T) / sum(w T^2).

    Parameters
    ----------
    weight
        (J,) inverse variances; 0 without a measurement
    start
        First brightness, returned if no frame has light
    selects
        Whether to leave out the frames that have a gross error at the first brightness
    """
    product = 0.0
    square = 0.0
    for j in range(len(light)):
        # Leave out what is not measured, and gross errors.
        if weight[j] == 0 or (
            selects and (light[j] - start * template[j]) ** 2 * weight[j] > 2 * GROSS
        ):
            continue
        product += weight[j] * light[j] * template[j]
        square += weight[j] * template[j] ** 2
    return product / square if square > 0 else start


@jit
def _misfit(light: Floats, weight: Floats, template: Floats, brightness: float) -> float:
    """The misfit at a brightness: sum of min(w (y - a T)^2 / 2, GROSS) over the frames measured."""
    total = 0.0
    for j in range(len(light)):
        if weight[j] > 0:
            total += min((light[j] - brightness * template[j]) ** 2 * weight[j] / 2, GROSS)
    return total


def likely(light: Floats, templates: Floats) -> Ints:
    """Rows of the templates that a light does not exclude at first sight.

    By least squares with errors of ROUGH of the brightest frame, which tolerate an edge or a failed bit. With the best
    brightness a = (y . T) / (T . T) the misfit is (y . y - (y . T)^2 / (T . T)) / 2.

    Parameters
    ----------
    light
        (J,) brightness in J frames; a NaN is no measurement
    templates
        (W, J) templates of the words
    """
    seen = np.isfinite(light)
    # In units of the standard deviation.
    y = light[seen] / light[seen].max() / ROUGH
    shown = templates[:, seen]
    square = np.maximum(np.einsum("wj,wj->w", shown, shown), 1e-300)
    misfit = (y @ y - (shown @ y) ** 2 / square) / 2
    return np.flatnonzero(misfit <= misfit.min() + LIKELY)


def excess_noise(least: Floats, measured: Floats | Ints) -> float:
    """Factor by which squared errors exceed the assumed ones, 1 or more.

    Half a chi-square of n measurements has the mean n / 2 (Birge 1932, Phys. Rev. 40, 207: errors are enlarged
    until the residuals are as large as expected). The median over the lights leaves out one that is no LED.

    Parameters
    ----------
    least
        (T,) least misfit of each light
    measured
        (T,) number of its measurements
    """
    return max(1.0, float(np.median(least / (np.asarray(measured) / 2))))


def expected_misfit(measured: Floats | Ints) -> Floats:
    """(T,) greatest misfit of the true word that is not suspicious, for each number of measurements.

    Half a chi-square has the mean n / 2 and the variance n / 2. Three standard deviations are allowed, and gross
    errors: one, or one in six measurements.
    """
    return measured / 2 + 3 * np.sqrt(measured / 2) + GROSS * np.maximum(1.0, measured / 6)


# Tracks: lights followed from frame to frame, with the brightness of each in the last frames.


BORDER_PX = 30.0  # an LED nearer to the border of the sensor may be undetected


@dataclass(eq=False)
class LightTracks:
    """Tracks of the lights of a field, with the brightness of each in the last frames (see the module's steps).

    Attributes
    ----------
    camera
        The camera
    pupil_m
        (3,) camera's entrance pupil from the bearing, in camera axes
    radius_m
        Radius of the sphere about the bearing
    frames
        Number J of frames that are kept
    gate_px
        Greatest distance of a light from its prediction, pixels
    patience
        Number of successive frames without its light after which a track ends
    goes_dark
        Whether an LED without light has the level 0; its level is unknown otherwise
    point_m
        (T, 3) points on the sphere, in camera axes
    light, sigma
        (T, J) brightness and its errors, NaN without a measurement; frame n is in column n modulo J
    row
        (T,) row of each track's light in the last frame's centroids, -1 without a light
    missed
        (T,) number of frames since its last light
    rate_rad_s
        (3,) last rate of the lights, in camera axes
    column
        Column of the last frame
    """

    camera: Camera
    pupil_m: Floats
    radius_m: float
    frames: int
    gate_px: float
    patience: int
    goes_dark: bool

    def __post_init__(self) -> None:
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
        """Continue the tracks with the lights of a frame, and begin new ones.

        Parameters
        ----------
        centroids
            The lights of the frame
        sigma
            (N,) errors of the lights' brightness
        elapsed_s
            Time since the last frame
        now_from_then
            cam(now) from cam(last frame), from a gyro; None: from the last motion of the lights
        """
        self.column = (self.column + 1) % self.frames
        # 1. Turn the points by the motion.
        turn = now_from_then or Rotation.from_rotvec(self.rate_rad_s * elapsed_s)
        predicted_m = turn.apply(self.point_m)
        # 2. Project them, and find their lights. A point behind the camera has no pixel: it is outside of the sensor.
        xy_px = self.camera.pixels(predicted_m - self.pupil_m)
        xy_px = np.nan_to_num(xy_px, nan=-1e9)
        seen_m = on_sphere(self.camera.rays(centroids.xy_px), self.pupil_m, self.radius_m)
        track = np.arange(len(xy_px))
        light, track = mutual_nearest(centroids.xy_px, xy_px, self.gate_px, track)
        self.row = np.full(len(xy_px), -1)
        self.row[track] = light
        found = self.row >= 0
        # 3. Measure the rate of the lights, which is unchanged unless two of them are seen in both frames.
        if found.sum() >= 2 and elapsed_s > 0:
            # Wahba's problem: the rotation of the points from the last frame to this one.
            turn, _ = Rotation.align_vectors(seen_m[self.row[found]], self.point_m[found])
            self.rate_rad_s = turn.as_rotvec() / elapsed_s
        self.point_m = predicted_m
        self.point_m[found] = seen_m[self.row[found]]
        # 4. Record the brightness.
        self._record(centroids, sigma, self.camera.contains(xy_px, BORDER_PX))
        # 5. End tracks and begin new ones.
        self.missed = np.where(found, 0, self.missed + 1)
        waits = (self.missed <= self.patience) & self.camera.contains(xy_px)
        self._end_and_begin(found | waits, centroids, sigma, seen_m)

    def _record(self, centroids: Centroids, sigma: Floats, inside: NDArray[np.bool_]) -> None:
        """Step 4: store the brightness of each track; 0 for an LED that is dark well inside the field.

        Parameters
        ----------
        inside
            (T,) whether the prediction is well inside the sensor
        """
        found = self.row >= 0
        dark = ~found & inside & self.goes_dark
        # Dark tracks have a measurement of 0; those without one have NaN.
        self.light[:, self.column] = np.where(dark, 0.0, np.nan)
        self.sigma[:, self.column] = np.nan
        # The light found, with its error.
        self.light[found, self.column] = centroids.flux[self.row[found]]
        self.sigma[found, self.column] = sigma[self.row[found]]
        # A dark frame is as uncertain as the others, whose errors are those of the light itself.
        with np.errstate(invalid="ignore"):
            greatest = np.fmax.reduce(self.sigma, axis=1, initial=0.0)
        self.sigma[dark, self.column] = greatest[dark]

    def _end_and_begin(
        self, kept: NDArray[np.bool_], centroids: Centroids, sigma: Floats, seen_m: Floats
    ) -> None:
        """Step 5: keep the tracks of a (T,) mask, and begin tracks for the lights that continue none."""
        new = np.setdiff1d(np.arange(len(centroids)), self.row)
        # Their only measurement is that of this frame.
        light, error = np.full((2, len(new), self.frames), np.nan)
        light[:, self.column] = centroids.flux[new]
        error[:, self.column] = sigma[new]
        begun = {
            "point_m": seen_m[new],
            "light": light,
            "sigma": error,
            "row": new,
            "missed": np.zeros(len(new), np.int64),
        }
        for name, more in begun.items():
            setattr(self, name, np.concatenate([getattr(self, name)[kept], more]))
