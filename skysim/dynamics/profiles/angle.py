"""One angle over time, for rotations about a fixed axis: angle, rate and acceleration by analytic laws.

Each function returns (angle, rate, acceleration) at a time in seconds: rad, rad/s, rad/s2.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from skysim.core.jit import jit

AngleProfile = Callable[[float], tuple[float, float, float]]
Derivatives = tuple[float, float, float]  # a value and its first two derivatives by time


def still(t_s: float) -> Derivatives:
    """No motion."""
    return 0.0, 0.0, 0.0


def steady(rate_rad_s: float, t_s: float) -> Derivatives:
    """A constant rate."""
    return rate_rad_s * t_s, rate_rad_s, 0.0


@jit
def rest_to_rest(
    angle_rad: float, rate_rad_s: float, ramp_s: float, duration_s: float, t_s: float
) -> Derivatives:
    """The rate rises along the smoothstep 3x^2 - 2x^3 (x = t / ramp), cruises at rate_rad_s and falls likewise.

    The acceleration is continuous: zero at both ends of a ramp and 1.5 rate / ramp at its middle.
    """
    # Symmetric profile: the braking half is the first half in reversed time.
    braking = t_s > duration_s / 2  # the second half mirrors the first
    ramp_time_s = duration_s - t_s if braking else t_s
    x = min(ramp_time_s / ramp_s, 1.0)
    angle = rate_rad_s * (ramp_s * x**3 * (1 - x / 2) + max(ramp_time_s - ramp_s, 0.0))
    rate = rate_rad_s * x**2 * (3 - 2 * x)
    acceleration = rate_rad_s / ramp_s * 6 * x * (1 - x)
    return (angle_rad - angle, rate, -acceleration) if braking else (angle, rate, acceleration)


@jit
def envelope(t_s: float, duration_s: float, rise_s: float, fall_s: float) -> Derivatives:
    """1 in the middle, 0 at and beyond both ends, and its two derivatives (1/s, 1/s2), all three continuous.

    It rises along 10x^3 - 15x^4 + 6x^5 (x = t / rise_s) and falls likewise in fall_s; the two together are at most
    duration_s.
    """
    falling = t_s > duration_s - fall_s
    growth_s = fall_s if falling else rise_s
    x = min(max((duration_s - t_s if falling else t_s) / growth_s, 0.0), 1.0)
    slope = 30 * x**2 * (1 - x) ** 2 / growth_s
    curvature = 60 * x * (1 - x) * (1 - 2 * x) / growth_s**2
    return x**3 * (10 - 15 * x + 6 * x**2), -slope if falling else slope, curvature


@jit
def modulated_sine(amplitude_rad: float, gain: Derivatives, phase: Derivatives) -> Derivatives:
    """amplitude gain(t) sin(phase(t)), and its two derivatives by the product rule."""
    e, slope, curvature = gain
    phi, omega, chirp = phase
    s = math.sin(phi)
    c = math.cos(phi)
    rate = slope * s + e * omega * c
    acceleration = (curvature - e * omega**2) * s + (2 * slope * omega + e * chirp) * c
    return amplitude_rad * e * s, amplitude_rad * rate, amplitude_rad * acceleration


@jit
def linear_sweep(
    amplitude_rad: float,
    omega_rad_s: float,
    omega_rate_rad_s2: float,
    duration_s: float,
    rise_s: float,
    fall_s: float,
    t_s: float,
) -> Derivatives:
    """A sine in the envelope, of angular frequency omega + omega_rate t: phase omega t + omega_rate t^2 / 2."""
    omega = omega_rad_s + omega_rate_rad_s2 * t_s
    phase = omega_rad_s * t_s + omega_rate_rad_s2 * t_s**2 / 2, omega, omega_rate_rad_s2
    return modulated_sine(amplitude_rad, envelope(t_s, duration_s, rise_s, fall_s), phase)


@jit
def log_sweep(
    amplitude_rad: float,
    omega_rad_s: float,
    growth_1_s: float,
    duration_s: float,
    rise_s: float,
    fall_s: float,
    t_s: float,
) -> Derivatives:
    """A sine in the envelope, of angular frequency omega exp(k t): phase omega (exp(k t) - 1) / k, k = growth."""
    omega = omega_rad_s * math.exp(growth_1_s * t_s)
    phase = omega_rad_s * math.expm1(growth_1_s * t_s) / growth_1_s, omega, growth_1_s * omega
    return modulated_sine(amplitude_rad, envelope(t_s, duration_s, rise_s, fall_s), phase)
