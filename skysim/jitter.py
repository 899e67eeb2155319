"""Vibration: small turns in the body's own axes, laid over the attitude history."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy.spatial.transform import Rotation

from skysim.scene import Jitter, JitterBand, JitterLine
from skysim.types import BadInput, Floats, Trajectory

SINES = 128  # a band is a sum of so many; an uneven spectrum still has tens of equal ones
PER_PERIOD = (
    16  # samples of the shortest period: cubic Hermite is then off by (2 pi / 16)^4 / 384 = 6e-5 of it
)
MOST_SAMPLES = 5_000_000


@dataclass(frozen=True, slots=True)
class Sines:
    """phi(t) = sum over K of sine sin(omega t) + cosine cos(omega t), a rotation vector in body axes.

    omega_rad_s : (K,)
    sine_rad, cosine_rad : (K, 3)
    """

    omega_rad_s: Floats
    sine_rad: Floats
    cosine_rad: Floats


def line(part: JitterLine, rng: np.random.Generator) -> Sines:
    """One frequency: sqrt(2) rms sin(2 pi f t + phase) about each axis, its phase at random."""
    return with_phases(np.array([part.frequency_hz]), np.ones(1), part.rms_arcsec, rng)


def band(part: JitterBand, rng: np.random.Generator) -> Sines:
    """Power spectral density proportional to f^slope from from_hz to to_hz, the sum of many sines.

    The band is cut into pieces of equal ratio. A sine in each has the piece's whole power, so that the rms is
    exact in every draw, and a frequency drawn from the spectrum within the piece, so that the density is exact in
    expectation (Shinozuka & Deodatis 1991, ASME Appl. Mech. Rev. 44, 191, whose frequencies are fixed; `assumed`).
    """
    edges = np.linspace(0, math.log(part.to_hz / part.from_hz), SINES + 1)  # logarithm of f / from_hz
    rise = part.slope + 1  # power up to f goes as f^rise, of which only ratios count
    low, high = edges[:-1], edges[1:]
    drawn = rng.uniform(size=SINES)
    if abs(rise) < 1e-6:
        share, middle = high - low, low + drawn * (high - low)
    else:
        share = np.exp(rise * low) * np.expm1(rise * (high - low)) / rise
        middle = low + np.log1p(drawn * np.expm1(rise * (high - low))) / rise
    return with_phases(part.from_hz * np.exp(middle), share / share.sum(), part.rms_arcsec, rng)


def with_phases(
    frequency_hz: Floats, share: Floats, rms_arcsec: Sequence[float], rng: np.random.Generator
) -> Sines:
    """Sines of (K,) frequencies and shares of the power, each axis with phases of its own."""
    amplitude = np.sqrt(2 * share)[:, None] * np.radians(np.array(rms_arcsec) / 3600)
    phase = rng.uniform(0, 2 * np.pi, amplitude.shape)
    return Sines(2 * np.pi * frequency_hz, amplitude * np.cos(phase), amplitude * np.sin(phase))


# How a vibration sounds. A third kind is a class in scene.py and a function here.
SPECTRA: dict[str, Callable[[Any, np.random.Generator], Sines]] = {"line": line, "band": band}


def shake(trajectory: Trajectory, parts: Sequence[Jitter], rng: np.random.Generator) -> Trajectory:
    """The attitude history with its vibration: lab_from_body exp(phi(t)), phi in body axes.

    Resampled so finely that `Trajectory.at` between two samples keeps phi to 1e-4 of its amplitude. The body then
    turns at exp(-phi) omega + J(phi) dphi/dt, in its own shaken axes. The rates of the history are taken as
    straight between its samples. The same object comes back if nothing shakes. Raises BadInput (one line) where
    more than five million samples would be needed.
    """
    loud = [part for part in parts if any(part.rms_arcsec)]
    if not loud:
        return trajectory
    sines = joined([SPECTRA[part.kind](part, rng) for part in loud])
    t_s = finer(trajectory.t_s, float(sines.omega_rad_s.max()) / (2 * np.pi))
    phi, phi_rate = swing(t_s, sines.omega_rad_s, sines.sine_rad, sines.cosine_rad)
    turn = Rotation.from_rotvec(phi)
    rate = np.column_stack([np.interp(t_s, trajectory.t_s, axis) for axis in trajectory.rate_body_rad_s.T])
    return Trajectory(t_s, trajectory.at(t_s) * turn, turn.inv().apply(rate) + own_rate(phi, phi_rate))


def joined(many: Sequence[Sines]) -> Sines:
    """All of them at once."""
    return Sines(
        np.concatenate([one.omega_rad_s for one in many]),
        np.concatenate([one.sine_rad for one in many]),
        np.concatenate([one.cosine_rad for one in many]),
    )


def finer(t_s: Floats, highest_hz: float) -> Floats:
    """The samples' times, and between them so many more that each period has PER_PERIOD."""
    step = np.diff(t_s)
    pieces = np.ceil(np.maximum(step * highest_hz * PER_PERIOD * (1 - 1e-12), 1))
    needed = int(pieces.sum()) + 1
    if needed > MOST_SAMPLES:
        raise BadInput(
            f"motion.jitter: {highest_hz:g} Hz over {t_s[-1] - t_s[0]:g} s needs {needed:,} attitude samples; "
            f"allowed: {MOST_SAMPLES:,}, {PER_PERIOD} a period"
        )
    count = pieces.astype(np.int64)
    begin = np.repeat(np.cumsum(count) - count, count)  # the first sample of each one's own step
    within = (np.arange(len(begin)) - begin) / np.repeat(count, count)
    return np.append(np.repeat(t_s[:-1], count) + within * np.repeat(step, count), t_s[-1])


def own_rate(phi: Floats, phi_rate: Floats) -> Floats:
    """(N, 3) angular velocity of exp(phi) in its own axes: dphi/dt - phi x dphi/dt / 2 + phi x (phi x dphi/dt) / 6.

    The right Jacobian of the rotations to second order (Bullo & Murray 1995; `assumed`): what is left out is
    |phi|^3 / 24 of the rate, 1e-12 for an arc-minute, 2e-7 for a degree.
    """
    cross = np.cross(phi, phi_rate)
    return np.asarray(phi_rate - cross / 2 + np.cross(phi, cross) / 6)


@numba.njit(cache=True, parallel=True)
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
