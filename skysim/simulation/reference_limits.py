"""Refuse a maneuver that asks for more than the vehicle can do: tilt, and for profiles and chirps rate and torque."""

from __future__ import annotations

import math

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.dynamics import guidance, multibody
from skysim.dynamics.flight_computer import controlling_actuator, usage
from skysim.dynamics.multibody.actuators.registry import build_actuators
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import ControlConfig
from skysim.scene.sections.vehicle import VehicleConfig

TILT_CHECK_S = 0.05  # sampling interval of a maneuver when its tilt is checked
ROUNDING = 1e-6  # relative


def check_reference(
    reference: guidance.Reference, scene: Scene, model: multibody.VehicleModel, duration_s: float
) -> None:
    """Raise InputError for a maneuver beyond the tilt stop, the gyros' range or the actuators' torque.

    The controller would push against the stop, or fall behind. A prescribed motion needs no torque.
    """
    motion = scene.motion
    vehicle = scene.vehicle
    if motion.control is None:
        return
    check_tilt(reference, vehicle, duration_s)
    actuators = build_actuators(scene.vehicle, model.model)
    legs = zip(reference.legs, reference.start_s, motion.maneuver, strict=False)
    for n, (leg, begin_s, element) in enumerate(legs):
        if element.kind not in ("profile", "chirp"):
            continue
        t_s, rate, acceleration = demands(leg, 1 / scene.control_rate_hz)
        key = f"motion.maneuver.{n}: {element.kind}"
        check_rate(key, begin_s + t_s, rate, vehicle)
        if not motion.is_prescribed:
            inertia = model.inertia_kg_m2
            torque_nm = acceleration @ inertia.T + np.cross(rate, rate @ inertia.T)
            used = usage(controlling_actuator(motion.control, actuators, model), torque_nm)
            check_torque(key, begin_s + t_s, used, torque_nm, motion.control)


def check_tilt(reference: guidance.Reference, vehicle: VehicleConfig, duration_s: float) -> None:
    """Raise InputError for a tilt beyond the stop of the air bearing."""
    if vehicle.mount != "air_bearing":
        return
    t_s = np.arange(0, min(reference.duration_s, duration_s) + TILT_CHECK_S, TILT_CHECK_S)
    tilt_deg = multibody.tilt_deg(reference.attitudes(t_s))
    beyond = np.flatnonzero(tilt_deg > vehicle.tilt_stop_deg)
    if len(beyond):
        raise InputError(
            "motion.maneuver",
            f"tilt of {tilt_deg[beyond[0]]:.3g} deg at {t_s[beyond[0]]:.3g} s",
            f"up to vehicle.tilt_stop_deg {vehicle.tilt_stop_deg:g}",
        )


def demands(leg: guidance.Leg, period_s: float) -> tuple[Floats, Floats, Floats]:
    """(K,) times since the leg's start, (K, 3) rates and (K, 3) accelerations: at a profile's samples, else every tick.

    Between two samples the acceleration of a profile is nearly linear in time, so it is greatest at a sample.
    """
    if isinstance(leg, guidance.ProfileLeg):
        knots_s = leg.spline.t_s - leg.begin_s
        t_s = knots_s[(knots_s >= 0) & (knots_s <= leg.duration_s)]
        _, rate, acceleration = leg.spline.states_at(t_s + leg.begin_s)
        return t_s, rate, acceleration
    t_s = np.arange(0.0, leg.duration_s, period_s)
    _, rates, accelerations = zip(*(leg.state_at(float(t)) for t in t_s), strict=True)
    return t_s, np.array(rates), np.array(accelerations)


def check_rate(key: str, t_s: Floats, rate_rad_s: Floats, vehicle: VehicleConfig) -> None:
    """Raise InputError for a rate about a body axis that saturates the gyros."""
    if vehicle.imu is None:
        return
    limit_deg_s = vehicle.imu.gyro.rate_limit_deg_s
    fastest = np.abs(rate_rad_s).max(axis=1)
    n = int(fastest.argmax())
    if fastest[n] > math.radians(limit_deg_s) * (1 + ROUNDING):
        raise InputError(
            key,
            f"{math.degrees(fastest[n]):.4g} deg/s about a body axis at {t_s[n]:.6g} s",
            f"up to vehicle.imu.gyro.rate_limit_deg_s {limit_deg_s:g}",
        )


def check_torque(
    key: str, t_s: Floats, used: Floats, torque_nm: Floats, control: ControlConfig
) -> None:
    """Raise InputError for a torque (K, 3) that the actuators cannot give. used : (K,) times what they can"""
    n = int(used.argmax())
    if used[n] > 1 + ROUNDING:
        torque = ", ".join(f"{component:.3g}" for component in torque_nm[n])
        raise InputError(
            key,
            f"needs a torque of ({torque}) N m at {t_s[n]:.6g} s, {used[n]:.3g} times what the actuators"
            f" {control.actuators} can give",
            "slower or smaller, or motion.control: prescribed",
        )
