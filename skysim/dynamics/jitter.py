"""Vibration: small rotations about the body axes added to the simulated attitude, always or for an interval.

A vibration is a sum of sines of the rotation vector in body axes: single frequencies (`line`) or a random spectrum
(`band`). It is kinematic: MuJoCo does not simulate it, but the IMU senses it (`closed_loop.felt`) and it smears the
images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats, Trajectory
from skysim.dynamics.guidance import envelope, shakes
from skysim.scene.motion import JitterBandConfig, JitterLineConfig, JitterPart, MotionConfig

SINES = 128  # sines in a band; even a steep spectrum has tens of similar amplitude
PER_PERIOD = (
    16  # samples per shortest period: cubic Hermite interpolation has an error of (2 pi / 16)^4 / 384 = 6e-5
)
MOST_SAMPLES = 5_000_000
RISE = 0.1  # of an interval of vibration is its rise, and as much its fall ...
LONGEST_RISE_S = 1.0  # ... but no longer


@dataclass(frozen=True, slots=True)
class Sines:
    """phi(t) = sum over K of sine sin(omega t) + cosine cos(omega t), a rotation vector in body axes.

    omega_rad_s : (K,)
    sine_rad, cosine_rad : (K, 3)
    """

    omega_rad_s: Floats
    sine_rad: Floats
    cosine_rad: Floats


def line(part: JitterLineConfig, rng: np.random.Generator) -> Sines:
    """One frequency: sqrt(2) rms sin(2 pi f t + phase) about each axis, with random phases."""
    return with_phases(np.array([part.frequency_hz]), np.ones(1), part.rms_arcsec, rng)


def band(part: JitterBandConfig, rng: np.random.Generator) -> Sines:
    """Power spectral density proportional to f^slope from from_hz to to_hz, the sum of many sines.

    The band is split into pieces of equal frequency ratio. Each has one sine with the piece's whole power, so that
    the rms is exact in every draw, at a frequency drawn from the spectrum within the piece, so that the density is
    exact in expectation (Shinozuka & Deodatis 1991, ASME Appl. Mech. Rev. 44, 191, whose frequencies are fixed;
    `assumed`).
    """
    edges = np.linspace(0, math.log(part.to_hz / part.from_hz), SINES + 1)  # logarithm of f / from_hz
    rise = part.slope + 1  # power up to f goes as f^rise, of which only ratios count
    low, high = edges[:-1], edges[1:]
    drawn = rng.uniform(size=SINES)
    if abs(rise) < 1e-6:
        share, middle = high - low, low + drawn * (high - low)
    else:
        # Power of each piece, and a frequency drawn from it by inverting its cumulative power.
        share = np.exp(rise * low) * np.expm1(rise * (high - low)) / rise
        middle = low + np.log1p(drawn * np.expm1(rise * (high - low))) / rise
    return with_phases(part.from_hz * np.exp(middle), share / share.sum(), part.rms_arcsec, rng)


def with_phases(
    frequency_hz: Floats, share: Floats, rms_arcsec: Sequence[float], rng: np.random.Generator
) -> Sines:
    """Sines of (K,) frequencies and fractions of the power, with independent random phases for each axis."""
    amplitude = np.sqrt(2 * share)[:, None] * np.radians(np.array(rms_arcsec) / 3600)
    phase = rng.uniform(0, 2 * np.pi, amplitude.shape)
    return Sines(2 * np.pi * frequency_hz, amplitude * np.cos(phase), amplitude * np.sin(phase))


# Spectra by kind. To add one, add a class to scene/motion.py and a function here.
SPECTRA: dict[str, Callable[[Any, np.random.Generator], Sines]] = {"line": line, "band": band}


@dataclass(frozen=True, slots=True)
class Voice:
    """Sines and their interval: phi(t) = envelope(t) sines(t), from begin_s to end_s.

    The envelope is 1 except for a rise and a fall of a tenth of the interval each, a second at most, along
    10x^3 - 15x^4 + 6x^5: phi, its rate and its acceleration are continuous. Without an interval it is 1.

    name : where in the scene it is declared
    """

    sines: Sines
    name: str
    begin_s: float = -math.inf
    end_s: float = math.inf

    @property
    def rise_s(self) -> float:
        return min(RISE * (self.end_s - self.begin_s), LONGEST_RISE_S)

    @property
    def highest_hz(self) -> float:
        """The frequency that sets the sampling: the sines' highest plus one period per rise.

        The envelope is smoother than a sine of that frequency. The error of cubic Hermite interpolation follows
        from the fourth derivative, at most 360 / rise^4, and the jumps of the third, 60 / rise^3; for the sine they
        are 1559 and 248.
        """
        edge_hz = 1 / self.rise_s if math.isfinite(self.begin_s) else 0.0
        return float(self.sines.omega_rad_s.max()) / (2 * np.pi) + edge_hz

    def sounds(self, t_s: Floats) -> NDArray[np.bool_]:
        """(N - 1,) whether it is active between each of (N,) times and the next."""
        return np.asarray((t_s[:-1] < self.end_s) & (self.begin_s < t_s[1:]))

    def swing(self, t_s: Floats) -> tuple[Floats, Floats]:
        """(N, 3) phi and (N, 3) its derivative at (N,) times within the interval."""
        phi, rate = swing(t_s, self.sines.omega_rad_s, self.sines.sine_rad, self.sines.cosine_rad)
        if not math.isfinite(self.begin_s):
            return phi, rate
        gain, slope = gains(t_s - self.begin_s, self.end_s - self.begin_s, self.rise_s)
        return gain * phi, gain * rate + slope * phi


@dataclass(frozen=True, slots=True)
class Vibration:
    """All vibration of one run. Its phases are drawn once, so that evaluation in pieces equals that of the whole."""

    voices: tuple[Voice, ...]

    @classmethod
    def of(cls, motion: MotionConfig, rng: np.random.Generator) -> Vibration:
        """The vibration of `motion.jitter`, always on, and of each jitter maneuver during its interval."""
        drawn = [voice(motion.jitter, rng, "motion.jitter")]
        for begin_s, end_s, parts in shakes(motion):
            drawn.append(voice(parts, rng, f"motion.manoeuvre jitter at {begin_s:g} s", begin_s, end_s))
        return cls(tuple(one for one in drawn if one))

    def swing(self, t_s: Floats) -> tuple[Floats, Floats]:
        """(N, 3) rotation vector phi and (N, 3) its derivative (rad/s), body axes, at (N,) ascending times."""
        phi, rate = np.zeros((len(t_s), 3)), np.zeros((len(t_s), 3))
        for one in self.voices:
            now = slice(*np.searchsorted(t_s, [one.begin_s, one.end_s]))
            more, faster = one.swing(t_s[now])
            phi[now] += more
            rate[now] += faster
        return phi, rate

    def lay_over(self, trajectory: Trajectory) -> Trajectory:
        """Add the vibration to a trajectory, or to a part of one: lab_from_body exp(phi(t)), phi in body axes.

        Where vibration is active the trajectory is resampled so finely that `Trajectory.at` between two samples
        keeps phi to 1e-4 of its amplitude; all samples are kept. The body rate becomes exp(-phi) omega + J(phi)
        dphi/dt, in the vibrating axes, with omega linear between the samples of the trajectory. Without active
        vibration the same object is returned. Raises InputError (one line) where more than five million samples
        would be needed.
        """
        if not any(one.sounds(trajectory.t_s).any() for one in self.voices):
            return trajectory
        t_s = finer(trajectory.t_s, self.pieces(trajectory.t_s))
        phi, phi_rate = self.swing(t_s)
        turn = Rotation.from_rotvec(phi)
        rate = np.column_stack(
            [np.interp(t_s, trajectory.t_s, axis) for axis in trajectory.rate_body_rad_s.T]
        )
        return Trajectory(t_s, trajectory.at(t_s) * turn, turn.inv().apply(rate) + own_rate(phi, phi_rate))

    def pieces(self, t_s: Floats) -> NDArray[np.int64]:
        """(N - 1,) number of pieces of each step, so that every period has PER_PERIOD samples.

        Raises InputError if there are too many samples. Before applying vibration piece by piece, call this
        with all times.
        """
        highest_hz = np.zeros(len(t_s) - 1)
        for one in self.voices:
            np.maximum(highest_hz, one.highest_hz, out=highest_hz, where=one.sounds(t_s))
        pieces = np.ceil(np.maximum(np.diff(t_s) * highest_hz * PER_PERIOD * (1 - 1e-12), 1))
        needed = int(pieces.sum()) + 1
        if self.voices and needed > MOST_SAMPLES:
            worst = max(self.voices, key=lambda one: one.highest_hz * np.diff(t_s)[one.sounds(t_s)].sum())
            raise InputError(
                f"{worst.name}: {worst.highest_hz:g} Hz over {np.diff(t_s)[worst.sounds(t_s)].sum():g} s needs "
                f"{needed:,} attitude samples; allowed: {MOST_SAMPLES:,}, {PER_PERIOD} a period"
            )
        return pieces.astype(np.int64)


def voice(
    parts: Sequence[JitterPart],
    rng: np.random.Generator,
    name: str,
    begin_s: float = -math.inf,
    end_s: float = math.inf,
) -> Voice | None:
    """Draw a vibration's parts; None if all have zero rms."""
    loud = [part for part in parts if any(part.rms_arcsec)]
    if not loud:
        return None
    return Voice(joined([SPECTRA[part.kind](part, rng) for part in loud]), name, begin_s, end_s)


def shake(trajectory: Trajectory, parts: Sequence[JitterPart], rng: np.random.Generator) -> Trajectory:
    """The whole trajectory with a vibration that is always active, see `Vibration.lay_over`."""
    return Vibration.of(MotionConfig(jitter=tuple(parts)), rng).lay_over(trajectory)


def joined(many: Sequence[Sines]) -> Sines:
    """All sines in one set."""
    return Sines(
        np.concatenate([one.omega_rad_s for one in many]),
        np.concatenate([one.sine_rad for one in many]),
        np.concatenate([one.cosine_rad for one in many]),
    )


def finer(t_s: Floats, pieces: NDArray[np.int64]) -> Floats:
    """The sample times with each step divided evenly into its pieces."""
    begin = np.repeat(np.cumsum(pieces) - pieces, pieces)  # the first sample of each one's own step
    within = (np.arange(len(begin)) - begin) / np.repeat(pieces, pieces)
    return np.append(np.repeat(t_s[:-1], pieces) + within * np.repeat(np.diff(t_s), pieces), t_s[-1])


def own_rate(phi: Floats, phi_rate: Floats) -> Floats:
    """(N, 3) angular velocity of exp(phi) in its own axes, by the rotations' right Jacobian:

        dphi/dt - (1 - cos a) / a^2 phi x dphi/dt + (a - sin a) / a^3 phi x (phi x dphi/dt),  a = |phi|

    (Bullo & Murray 1995; `assumed`).
    """
    angle = np.linalg.norm(phi, axis=1, keepdims=True)
    first = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    # For small a the quotient loses precision; there it is 1/6 to a^2 / 120, and its term is only a^2 of the rate.
    second = np.where(angle > 1e-4, (1 - np.sinc(angle / np.pi)) / np.maximum(angle, 1e-4) ** 2, 1 / 6)
    cross = np.cross(phi, phi_rate)
    return np.asarray(phi_rate - first * cross + second * np.cross(phi, cross))


@jit
def gains(t_s: Floats, duration_s: float, rise_s: float) -> tuple[Floats, Floats]:
    """(N, 1) envelope and (N, 1) its derivative."""
    gain, slope = np.empty((len(t_s), 1)), np.empty((len(t_s), 1))
    for n in range(len(t_s)):
        gain[n, 0], slope[n, 0], _ = envelope(t_s[n], duration_s, rise_s)
    return gain, slope


@jit(parallel=True)
def swing(t_s: Floats, omega_rad_s: Floats, sine_rad: Floats, cosine_rad: Floats) -> tuple[Floats, Floats]:
    """(N, 3) phi and (N, 3) its derivative at every time."""
    phi, rate = np.empty((len(t_s), 3)), np.empty((len(t_s), 3))
    for n in numba.prange(len(t_s)):
        x = y = z = u = v = w = 0.0
        for k in range(len(omega_rad_s)):
            omega, a, b = omega_rad_s[k], sine_rad[k], cosine_rad[k]
            s, c = np.sin(omega * t_s[n]), np.cos(omega * t_s[n])
            x, y, z = x + a[0] * s + b[0] * c, y + a[1] * s + b[1] * c, z + a[2] * s + b[2] * c
            s, c = omega * s, omega * c
            u, v, w = u + a[0] * c - b[0] * s, v + a[1] * c - b[1] * s, w + a[2] * c - b[2] * s
        phi[n, 0], phi[n, 1], phi[n, 2] = x, y, z
        rate[n, 0], rate[n, 1], rate[n, 2] = u, v, w
    return phi, rate
