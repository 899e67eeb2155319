"""Vibration: small rotations about the body axes added to the simulated attitude, always or for an interval.

1. `Vibration` draws each vibration as a sum of sines of the rotation vector in body axes: single frequencies
   (`line`) or a random spectrum (`band`).
2. `Vibration.subdivisions` finds how finely the trajectory must be sampled.
3. `Vibration.add_to` adds the rotation and its rate to the samples.

Vibration is kinematic: MuJoCo does not simulate it, but the IMU senses it (`Motion.last_knots`) and it smears the
images.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Bools, Floats, Ints, Trajectory, frozen, joined
from skysim.dynamics.guidance import Reference, plan
from skysim.dynamics.reference_curves import envelope
from skysim.scene.sections.motion import (
    JitterBandConfig,
    JitterLineConfig,
    MotionConfig,
)

SINES_PER_BAND = 128  # even a steep spectrum has tens of sines of similar amplitude
# Samples per shortest period: cubic Hermite interpolation has an error of (2 pi / 16)^4 / 384 = 6e-5.
SAMPLES_PER_PERIOD = 16
MAX_SAMPLES = 5_000_000
# Duration of the rise and of the fall: a fraction of the interval, at most MAX_RISE_S.
RISE_FRACTION = 0.1
MAX_RISE_S = 1.0


class Sines(NamedTuple):
    """A rotation vector in body axes: phi(t) = sum_k sine_k sin(omega_k t) + cosine_k cos(omega_k t).

    Attributes
    ----------
    omega_rad_s
        (K,) angular frequencies
    sine_rad, cosine_rad
        (K, 3) amplitudes about each body axis
    """

    omega_rad_s: Floats
    sine_rad: Floats
    cosine_rad: Floats


def line(config: JitterLineConfig, rng: Generator) -> Sines:
    """One frequency: sqrt(2) rms sin(2 pi f t + phase) about each axis, with random phases."""
    return with_phases(np.array([config.frequency_hz]), np.ones(1), config.rms_arcsec, rng)


def band(config: JitterBandConfig, rng: Generator) -> Sines:
    """A power spectral density proportional to f^slope from from_hz to to_hz, as a sum of many sines.

    1. Split the band into pieces of equal frequency ratio.
    2. Give each piece one sine with the whole power of the piece, so the rms is exact in every draw.
    3. Draw its frequency from the spectrum within the piece, so the density is exact in expectation.
    4. Draw its phases.

    (Shinozuka & Deodatis 1991, ASME Appl. Mech. Rev. 44, 191, whose frequencies are fixed; `assumed`.) With
    u = ln(f / from_hz) the power per du is proportional to exp((slope + 1) u).
    """
    # 1. Pieces, as intervals low to high of u.
    edges = np.linspace(0, math.log(config.to_hz / config.from_hz), SINES_PER_BAND + 1)
    exponent = config.slope + 1
    low = edges[:-1]
    high = edges[1:]
    uniform = rng.uniform(size=SINES_PER_BAND)
    # 2. and 3. Power of each piece, and a u drawn from it by inverting its cumulative power.
    if abs(exponent) < 1e-6:
        power = high - low
        middle = low + uniform * (high - low)
    else:
        power = np.exp(exponent * low) * np.expm1(exponent * (high - low)) / exponent
        middle = low + np.log1p(uniform * np.expm1(exponent * (high - low))) / exponent
    # 4. Phases.
    return with_phases(
        config.from_hz * np.exp(middle), power / power.sum(), config.rms_arcsec, rng
    )


def with_phases(
    frequency_hz: Floats,
    power_fraction: Floats,
    rms_arcsec: Sequence[float],
    rng: Generator,
) -> Sines:
    """Sines of (K,) frequencies and fractions of the power, with independent random phases for each axis.

    A sine of amplitude A has the power A^2 / 2, so A = sqrt(2 fraction) rms.
    """
    amplitude = np.sqrt(2 * power_fraction)[:, None] * np.radians(np.array(rms_arcsec) / 3600)
    phase = rng.uniform(0, 2 * np.pi, amplitude.shape)
    return Sines(
        2 * np.pi * frequency_hz, amplitude * np.cos(phase), amplitude * np.sin(phase)
    )


# Spectra by kind. To add one, add a class to scene/sections/motion.py and a function here.
SPECTRA: dict[str, Callable[[Any, Generator], Sines]] = {"line": line, "band": band}


@frozen
class VibrationComponent:
    """Sines within an interval: phi(t) = envelope(t) sines(t) from begin_s to end_s.

    The envelope is 1 except for a rise and a fall along 10x^3 - 15x^4 + 6x^5. Each takes a tenth of the interval, a
    second at most. phi, its rate and its acceleration are continuous. Without an interval the envelope is 1.

    Attributes
    ----------
    sines
        Sines of the vibration
    name
        Place in the scene that declares it, for messages
    begin_s, end_s
        Interval; infinite for a vibration that is always on
    """

    sines: Sines
    name: str
    begin_s: float
    end_s: float

    @property
    def rise_s(self) -> float:
        return min(RISE_FRACTION * (self.end_s - self.begin_s), MAX_RISE_S)

    @property
    def highest_hz(self) -> float:
        """The frequency that sets the sampling: the highest of the sines plus one period per rise.

        The envelope is smoother than a sine with a period of one rise. The error of cubic Hermite interpolation
        follows from the fourth derivative and the jumps of the third. They are at most 360 / rise^4 and 60 / rise^3
        for the envelope, 1559 / rise^4 and 248 / rise^3 for the sine.
        """
        edge_hz = 1 / self.rise_s if math.isfinite(self.begin_s) else 0.0
        return float(self.sines.omega_rad_s.max()) / (2 * np.pi) + edge_hz

    def active(self, t_s: Floats) -> Bools:
        """(N - 1,) whether the vibration is active between each of (N,) times and the next."""
        return (t_s[:-1] < self.end_s) & (self.begin_s < t_s[1:])

    def evaluate(self, t_s: Floats) -> tuple[Floats, Floats]:
        """(N, 3) phi and (N, 3) its derivative at (N,) times within the interval."""
        phi, rate = evaluate_sines(t_s, *self.sines)
        if not math.isfinite(self.begin_s):
            return phi, rate
        # Product rule.
        gain, slope = envelopes(t_s - self.begin_s, self.end_s - self.begin_s, self.rise_s)
        return gain * phi, gain * rate + slope * phi


class Vibration:
    """All vibration of one run: `motion.jitter`, which is always on, and each jitter maneuver in its interval.

    Its phases are drawn once, so evaluation piece by piece equals one evaluation.

    Parameters
    ----------
    motion
        The scene's section `motion`
    rng
        Generator of the frequencies and phases
    reference
        Reference of the maneuvers; by default it is planned here, which is not possible with a profile
    """

    def __init__(
        self, motion: MotionConfig, rng: Generator, reference: Reference | None = None
    ) -> None:
        spans = [("motion.jitter", motion.jitter, -math.inf, math.inf)]
        starts_s = (reference or plan(motion)).start_s
        for begin_s, element in zip(starts_s, motion.maneuver, strict=False):
            if element.kind == "jitter":
                name = f"motion.maneuver jitter at {begin_s:g} s"
                end_s = begin_s + element.duration_s
                spans.append((name, element.components, begin_s, end_s))
        # Parts without power are left out.
        self.components = tuple(
            VibrationComponent(
                joined([SPECTRA[part.kind](part, rng) for part in active]), name, *span_s
            )
            for name, parts, *span_s in spans
            if (active := [part for part in parts if any(part.rms_arcsec)])
        )

    def evaluate(self, t_s: Floats) -> tuple[Floats, Floats]:
        """(N, 3) rotation vector phi and (N, 3) its derivative (rad/s), body axes, at (N,) ascending times."""
        phi = np.zeros((len(t_s), 3))
        rate = np.zeros((len(t_s), 3))
        for component in self.components:
            # The samples within the component's interval.
            active = slice(*np.searchsorted(t_s, [component.begin_s, component.end_s]))
            component_phi, component_rate = component.evaluate(t_s[active])
            phi[active] += component_phi
            rate[active] += component_rate
        return phi, rate

    def add_to(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory, or a part of one, with the vibration added: attitude lab_from_body exp(phi(t)).

        1. Resample where vibration is active, so finely that interpolation by `Trajectory.at` keeps phi to 1e-4 of
           its amplitude. All samples of the trajectory are kept.
        2. Evaluate phi and dphi/dt at the samples.
        3. Rotate. The rate in the vibrating axes is exp(-phi) omega + J(phi) dphi/dt, J of `rotvec_body_rate`, with
           omega linear between the samples of the trajectory.

        Without active vibration the same object is returned. Raises InputError if more than MAX_SAMPLES would be
        needed.
        """
        if not any(component.active(trajectory.t_s).any() for component in self.components):
            return trajectory
        # 1. Resample.
        t_s = subdivide(trajectory.t_s, self.subdivisions(trajectory.t_s))
        # 2. Rotation vector and its derivative.
        phi, phi_rate = self.evaluate(t_s)
        # 3. Attitude and rate in the vibrating axes.
        vibration = Rotation.from_rotvec(phi)
        # omega at the new samples.
        rate = np.column_stack(
            [np.interp(t_s, trajectory.t_s, axis) for axis in trajectory.rate_body_rad_s.T]
        )
        return Trajectory(
            t_s,
            trajectory.attitude_at(t_s) * vibration,
            vibration.inv().apply(rate) + rotvec_body_rate(phi, phi_rate),
        )

    def subdivisions(self, t_s: Floats) -> Ints:
        """(N - 1,) number of pieces of each step between (N,) times: SAMPLES_PER_PERIOD samples in every period.

        Before vibration is added piece by piece, call this once with all times: it counts all samples.

        Raises
        ------
        InputError
            If there are more than MAX_SAMPLES samples.
        """
        # The highest frequency that is active in each step.
        highest_hz = np.zeros(len(t_s) - 1)
        for component in self.components:
            np.maximum(
                highest_hz, component.highest_hz, out=highest_hz, where=component.active(t_s)
            )
        count = np.ceil(
            np.maximum(np.diff(t_s) * highest_hz * SAMPLES_PER_PERIOD * (1 - 1e-12), 1)
        )
        needed = int(count.sum()) + 1
        if self.components and needed > MAX_SAMPLES:
            # Name the vibration that needs most of the samples.
            densest = max(
                self.components,
                key=lambda component: (
                    component.highest_hz * np.diff(t_s)[component.active(t_s)].sum()
                ),
            )
            raise InputError(
                densest.name,
                f"{densest.highest_hz:g} Hz over {np.diff(t_s)[densest.active(t_s)].sum():g} s needs {needed:,}"
                " attitude samples",
                f"{MAX_SAMPLES:,}, {SAMPLES_PER_PERIOD} a period",
            )
        return count.astype(np.int64)


def subdivide(t_s: Floats, counts: Ints) -> Floats:
    """(M,) sample times: (N,) times with each step divided evenly into counts (N - 1,) pieces."""
    # For each new sample: the number of the first sample in its step, and the fraction of the step before it.
    begin = np.repeat(np.cumsum(counts) - counts, counts)
    within = (np.arange(len(begin)) - begin) / np.repeat(counts, counts)
    return np.append(
        np.repeat(t_s[:-1], counts) + within * np.repeat(np.diff(t_s), counts), t_s[-1]
    )


def rotvec_body_rate(phi: Floats, phi_rate: Floats) -> Floats:
    """(N, 3) angular velocity of the rotation exp(phi) in its own axes, J(phi) dphi/dt by the right Jacobian:

        dphi/dt - (1 - cos a) / a^2 phi x dphi/dt + (a - sin a) / a^3 phi x (phi x dphi/dt),  a = |phi|

    (Bullo & Murray 1995; `assumed`).
    """
    # (1 - cos a) / a^2 = sinc(a / 2 pi)^2 / 2 has no cancellation at small a; NumPy's sinc(x) is sin(pi x) / (pi x).
    angle = np.linalg.norm(phi, axis=1, keepdims=True)
    first = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    # (a - sin a) / a^3 loses precision at small a. There it is 1/6 to a^2 / 120, and its term is only a^2 of the rate.
    second = np.where(
        angle > 1e-4, (1 - np.sinc(angle / np.pi)) / np.maximum(angle, 1e-4) ** 2, 1 / 6
    )
    cross = np.cross(phi, phi_rate)
    return phi_rate - first * cross + second * np.cross(phi, cross)


@jit
def envelopes(t_s: Floats, duration_s: float, rise_s: float) -> tuple[Floats, Floats]:
    """(N, 1) envelope and (N, 1) its derivative at (N,) times after its beginning."""
    gain = np.empty((len(t_s), 1))
    slope = np.empty((len(t_s), 1))
    for n in range(len(t_s)):
        gain[n, 0], slope[n, 0], _ = envelope(t_s[n], duration_s, rise_s, rise_s)
    return gain, slope


@jit(parallel=True)
def evaluate_sines(
    t_s: Floats, omega_rad_s: Floats, sine_rad: Floats, cosine_rad: Floats
) -> tuple[Floats, Floats]:
    """(N, 3) phi of `Sines` and (N, 3) its derivative at (N,) times."""
    phi = np.zeros((len(t_s), 3))
    rate = np.zeros((len(t_s), 3))
    for n in numba.prange(len(t_s)):
        for k in range(len(omega_rad_s)):
            omega = omega_rad_s[k]
            s = np.sin(omega * t_s[n])
            c = np.cos(omega * t_s[n])
            for i in range(3):
                a = sine_rad[k, i]
                b = cosine_rad[k, i]
                phi[n, i] = phi[n, i] + a * s + b * c
                rate[n, i] = rate[n, i] + a * (omega * c) - b * (omega * s)
    return phi, rate
