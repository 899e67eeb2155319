"""Motions on an air bearing for tests, by Euler's equations in body axes, which the estimator does not use."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.mass_dynamics import (
    BearingRecord,
    LabConstants,
    Prior,
    inertia_six,
)
from estimator.core.checks import Floats

GRAVITY_M_S2 = 9.80665
WHEEL_KG_M2 = 2e-5
PERIOD_S = 0.1  # of wheel speeds and random torque


@dataclass(frozen=True)
class Vehicle:
    """True mass properties of a small vehicle with three wheels, and the torques on it."""

    inertia_kg_m2: Floats
    moment_kg_m: Floats
    lab_torque_nm: Floats
    drag: tuple[float, float] = (0.0, 0.0)
    bias_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wheel_errors: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque_rms_nm: float = 2e-6
    correlation_s: float = 2.0
    attitude_sigma_rad: float = 5e-5

    @property
    def truth(self) -> Floats:
        """(20,) in the order of the estimator's parameters."""
        return np.array(
            [
                *inertia_six(self.inertia_kg_m2),
                *self.moment_kg_m,
                *self.lab_torque_nm,
                *self.drag,
                *self.bias_rad,
                *self.wheel_errors,
            ]
        )

    @property
    def lab(self) -> LabConstants:
        return LabConstants(
            GRAVITY_M_S2, np.eye(3), np.full(3, self.torque_rms_nm), self.correlation_s
        )

    @property
    def known(self) -> Prior:
        """The true values, as if they were assumed."""
        return Prior(self.truth, np.ones(20), self.lab)


INERTIA = np.array([[0.11, 0.004, -0.002], [0.004, 0.13, 0.003], [-0.002, 0.003, 0.09]])
SMALL = Vehicle(
    INERTIA, np.array([4e-6, -3e-6, -2e-5]), np.array([1e-6, -2e-6, 4e-6]), (2e-5, 1e-4)
)


def wheel_momenta(t_s: Floats) -> Floats:
    """(N, 3) about body x, y, z: two swings of each wheel, one wheel after another."""
    phase = np.clip((np.asarray(t_s)[:, None] / 20 - np.arange(3)), 0, 1)
    return np.asarray(4e-3 * np.sin(2 * np.pi * phase) * np.sin(np.pi * phase) ** 2)


def motion(
    vehicle: Vehicle, duration_s: float, rng: np.random.Generator, wheels: bool = True
) -> tuple[Floats, Rotation]:
    """Times and attitudes every PERIOD_S: J w' = T - h' - w x (J w + h), from rest, level (Runge-Kutta)."""
    J = vehicle.inertia_kg_m2
    count = round(duration_s / PERIOD_S)
    small = 1e-4
    inverse = np.linalg.inv(J)
    random_nm = random_torque(vehicle, count, rng)
    half_s = np.arange(2 * count + 1) * PERIOD_S / 2
    stored = wheels * wheel_momenta(half_s)
    change = (
        wheels * (wheel_momenta(half_s + small) - wheel_momenta(half_s - small)) / (2 * small)
    )

    def slope(half: int, state: Floats) -> Floats:
        rate = state[4:]
        (x, y, z, s) = state[:4] / np.linalg.norm(state[:4])
        lab_from_body = Rotation.from_quat([x, y, z, s]).as_matrix()
        lab_nm = vehicle.lab_torque_nm + random_nm[min(half // 2, count - 1)]
        torque = (
            np.cross(vehicle.moment_kg_m, -GRAVITY_M_S2 * lab_from_body[2])
            + lab_from_body.T @ lab_nm
        )
        torque -= (vehicle.drag[0] + vehicle.drag[1] * np.abs(rate)) * rate
        matrix = np.array([[s, -z, y], [z, s, -x], [-y, x, s], [-x, -y, -z]])
        gyroscopic = np.cross(rate, J @ rate + stored[half])
        return np.concatenate(
            [matrix @ rate / 2, inverse @ (torque - change[half] - gyroscopic)]
        )

    states = np.zeros((count + 1, 7))
    states[0, 3] = 1
    for k in range(count):
        state = states[k]
        h = PERIOD_S
        a = slope(2 * k, state)
        b = slope(2 * k + 1, state + h / 2 * a)
        c = slope(2 * k + 1, state + h / 2 * b)
        d = slope(2 * k + 2, state + h * c)
        states[k + 1] = state + h / 6 * (a + 2 * b + 2 * c + d)
    return np.arange(count + 1) * np.float64(PERIOD_S), Rotation.from_quat(states[:, :4])


def random_torque(vehicle: Vehicle, count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) Ornstein-Uhlenbeck torques, a period apart."""
    decay = np.exp(-PERIOD_S / vehicle.correlation_s)
    value = rng.standard_normal(3)
    rows = []
    for _ in range(count):
        rows.append(value)
        value = decay * value + np.sqrt(1 - decay**2) * rng.standard_normal(3)
    return vehicle.torque_rms_nm * np.array(rows)


def record(
    vehicle: Vehicle, rng: np.random.Generator, duration_s: float = 62.0, wheels: bool = True
) -> BearingRecord:
    """A record with an attitude a second; the wheels' inertias are wrong by the vehicle's errors."""
    t_s, lab_from_body = motion(vehicle, duration_s, rng, wheels)
    every = round(1 / PERIOD_S)
    noise = vehicle.attitude_sigma_rad * rng.standard_normal((len(t_s[::every]), 3))
    return BearingRecord(
        t_s[::every],
        lab_from_body[::every]
        * Rotation.from_rotvec(vehicle.bias_rad)
        * Rotation.from_rotvec(noise),
        np.tile(vehicle.attitude_sigma_rad**2 * np.eye(3), (len(noise), 1, 1)),
        t_s,
        wheels * wheel_momenta(t_s) / (1 + np.array(vehicle.wheel_errors)),
    )


def prior(vehicle: Vehicle, rng: np.random.Generator) -> tuple[Prior, Vehicle]:
    """Assumed mass properties, and a vehicle with random bias and wheel errors within their standard deviations."""
    sigma = np.array(
        [
            *[0.01] * 3,
            *[0.005] * 3,
            *[3e-5] * 3,
            *[1e-5] * 3,
            1e-4,
            1e-3,
            *[5e-4] * 3,
            *[1e-3] * 3,
        ]
    )
    bias = 5e-4 * rng.standard_normal(3)
    wheels = 1e-3 * rng.standard_normal(3)
    true = replace(vehicle, bias_rad=tuple(bias), wheel_errors=tuple(wheels))
    assumed = vehicle.truth + sigma * rng.standard_normal(20)
    assumed[14:] = 0
    return Prior(assumed, sigma, true.lab), true
