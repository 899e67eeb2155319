"""Basilisk's attitude control on rendered stars: `python fly.py PORT` flies 200 s and prints figures as JSON.

`skysim live orbit.yaml --tcp PORT --poses --endless` renders and solves the frames. The spacecraft of 120 kg m2 is in
an orbit of 500 km; it turns by half a degree and holds. inertial3D, attTrackingError and mrpFeedback are Basilisk's;
`Navigation` filters gyros and stars.
"""

from __future__ import annotations

import argparse
import json
from collections import deque
from typing import Any

import numpy as np
from Basilisk.architecture import messaging, sysModel  # type: ignore[import-not-found]
from Basilisk.fswAlgorithms import (  # type: ignore[import-not-found]
    attTrackingError,
    inertial3D,
    mrpFeedback,
)
from Basilisk.simulation import extForceTorque, spacecraft  # type: ignore[import-not-found]
from Basilisk.utilities import (  # type: ignore[import-not-found]
    SimulationBaseClass,
    macros,
    orbitalMotion,
    simIncludeGravBody,
)
from star_camera import (  # type: ignore[import-not-found]
    NANO,
    StarCamera,
    inverse,
    mrp_of_xyzw,
    times,
    xyzw_of_mrp,
)

STEP_S = 0.025  # dynamics, gyros and control
FRAME_S = 0.125
INERTIA_KG_M2 = 120.0
BANDWIDTH_RAD_S = 0.3
DAMPING = 0.8
ARW_RAD_SQRT_S = np.radians(0.07) / 60
BIAS_RAD_S = np.radians(1.0) / 3600
TARGET_XYZW = np.array([-0.690193, -0.078638, -0.167927, 0.699464])  # start of orbit.yaml
START_RAD = np.radians([0.3, -0.3, 0.3])  # from the reference to the start
SETTLED_S = 40.0
ARCSEC = np.degrees(1) * 3600


def rotation_vector(quaternion: Any) -> np.ndarray:
    """Rotation vector (3,) of a quaternion, scalar last."""
    vector = np.copysign(1.0, quaternion[3]) * quaternion[:3]
    sine = np.linalg.norm(vector)
    return vector * (2 * np.arctan2(sine, abs(quaternion[3])) / sine if sine else 2.0)


def quaternion_of(rotvec: Any) -> np.ndarray:
    """The inverse of `rotation_vector`."""
    half = 0.5 * np.linalg.norm(rotvec)
    return np.array([*(0.5 * np.sinc(half / np.pi) * rotvec), np.cos(half)])


def cross_matrix(vector: Any) -> np.ndarray:
    """Matrix (3, 3) of the cross product from the left."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


class Navigation(sysModel.SysModel):  # type: ignore[misc]
    """Multiplicative extended Kalman filter for attitude and bias of the gyros, which this module simulates.

    1. A gyro measures the turn since the last update, with a constant bias and a random walk.
    2. Attitude and covariance follow it: the error e in body axes obeys de/dt = -w x e - db - n.
    3. A new attitude of the star camera corrects both. It is compared with the filter's attitude at its time tag.

    Source: Lefferts, Markley & Shuster 1982, J. Guidance 5, 417.

    Attributes
    ----------
    scStateInMsg, stAttInMsg, attOutMsg
        True state, star camera's attitude, and the estimate (NavAttMsg), which begins at the first attitude
    camera
        Star camera, whose covariances the filter uses; STAttMsg has none
    """

    def __init__(self, camera: StarCamera, seed: int) -> None:
        super().__init__()
        self.ModelTag = "navigation"
        self.scStateInMsg = messaging.SCStatesMsgReader()
        self.stAttInMsg = messaging.STAttMsgReader()
        self.attOutMsg = messaging.NavAttMsg()
        self.camera = camera
        self.rng = np.random.default_rng(seed)  # noqa: TID251  (no part of skysim runs)
        self.true_bias_rad_s = BIAS_RAD_S * self.rng.standard_normal(3)
        self.bias_rad_s = np.zeros(3)
        self.covariance = np.diag([0.0] * 3 + [(2 * BIAS_RAD_S) ** 2] * 3)
        self.lab_from_body: Any = None
        self.before: Any = None
        self.past: deque[tuple[float, Any]] = deque(maxlen=200)
        self.tag = 0

    def Reset(self, CurrentSimNanos: int) -> None:
        pass

    def UpdateState(self, CurrentSimNanos: int) -> None:
        now_s = CurrentSimNanos * NANO
        true = xyzw_of_mrp(self.scStateInMsg().sigma_BN)
        rate_rad_s = np.zeros(3)
        if self.before is not None:
            # 1. Gyro.
            step_s = now_s - self.before[0]
            turn_rad = rotation_vector(times(inverse(self.before[1]), true))
            turn_rad = turn_rad + self.true_bias_rad_s * step_s
            turn_rad += ARW_RAD_SQRT_S * np.sqrt(step_s) * self.rng.standard_normal(3)
            rate_rad_s = turn_rad / step_s - self.bias_rad_s
            if self.lab_from_body is not None:
                self.propagate(rate_rad_s, step_s)
        self.before = (now_s, true)
        if self.lab_from_body is not None:
            self.past.append((now_s, self.lab_from_body))
        if self.stAttInMsg.isWritten() and self.stAttInMsg().timeTag > self.tag:
            # 3. Star camera.
            message = self.stAttInMsg()
            self.tag = message.timeTag
            self.correct(xyzw_of_mrp(message.MRP_BdyInrtl), self.tag * NANO, now_s)
        if self.lab_from_body is not None:
            out = messaging.NavAttMsgPayload()
            out.timeTag = now_s
            out.sigma_BN = mrp_of_xyzw(self.lab_from_body).tolist()
            out.omega_BN_B = rate_rad_s.tolist()
            self.attOutMsg.write(out, CurrentSimNanos, self.moduleID)

    def propagate(self, rate_rad_s: Any, step_s: float) -> None:
        """Step 2."""
        self.lab_from_body = times(self.lab_from_body, quaternion_of(rate_rad_s * step_s))
        transition = np.eye(6)
        transition[:3, :3] -= cross_matrix(rate_rad_s) * step_s
        transition[:3, 3:] = -np.eye(3) * step_s
        noise = np.diag([ARW_RAD_SQRT_S**2 * step_s] * 3 + [0.0] * 3)
        self.covariance = transition @ self.covariance @ transition.T + noise

    def correct(self, measured: Any, tagged_s: float, now_s: float) -> None:
        """Step 3: errors are in body axes, lab_from_true = lab_from_body exp(e)."""
        header = next(
            one
            for one in reversed(self.camera.solutions)
            if abs(one["t_s"] - tagged_s) < 1e-6
        )
        turn = matrix_of(self.camera.cam_from_body)
        noise = turn.T @ np.array(header["covariance_rad2"]) @ turn
        if self.lab_from_body is None:
            # The camera's latency is small against the turn of the start.
            self.lab_from_body = measured
            self.covariance[:3, :3] = noise
            self.past.append((now_s, measured))
            return
        # The attitude at the time tag, between two updates.
        t_s = np.array([one for one, _ in self.past])
        k = (
            int(np.clip(np.searchsorted(t_s, tagged_s) - 1, 0, len(t_s) - 2))
            if len(t_s) > 1
            else 0
        )
        attitude = self.past[k][1]
        if len(t_s) > 1:
            turn_rad = rotation_vector(times(inverse(attitude), self.past[k + 1][1]))
            share = (tagged_s - t_s[k]) / (t_s[k + 1] - t_s[k])
            attitude = times(attitude, quaternion_of(share * turn_rad))
        innovation_rad = rotation_vector(times(inverse(attitude), measured))
        gain = self.covariance[:, :3] @ np.linalg.inv(self.covariance[:3, :3] + noise)
        correction = gain @ innovation_rad
        self.covariance = (np.eye(6) - gain @ np.eye(3, 6)) @ self.covariance
        self.bias_rad_s = self.bias_rad_s + correction[3:]
        turn_of = quaternion_of(correction[:3])
        self.lab_from_body = times(self.lab_from_body, turn_of)
        self.past = deque(((t, times(one, turn_of)) for t, one in self.past), maxlen=200)


def matrix_of(quaternion: Any) -> np.ndarray:
    """Matrix (3, 3) of a quaternion, scalar last."""
    x, y, z, w = quaternion
    cross = cross_matrix([x, y, z])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def fly(port: int, seconds: float, latency_s: float, seed: int) -> dict[str, Any]:
    """Fly and return the figures."""
    target = TARGET_XYZW / np.linalg.norm(TARGET_XYZW)
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("process")
    step = macros.sec2nano(STEP_S)
    process.addTask(sim.CreateNewTask("dynamics", step), 20)
    process.addTask(sim.CreateNewTask("control", step), 10)

    # Spacecraft in its orbit.
    craft = spacecraft.Spacecraft()
    craft.hub.mHub = 500.0
    craft.hub.IHubPntBc_B = (INERTIA_KG_M2 * np.eye(3)).tolist()
    factory = simIncludeGravBody.gravBodyFactory()
    earth = factory.createEarth()
    earth.isCentralBody = True
    factory.addBodiesTo(craft)
    elements = orbitalMotion.ClassicElements()
    elements.a = 6378137.0 + 500e3
    elements.e = 0.0
    elements.i = np.radians(90.0)
    elements.Omega = np.radians(83.0)
    elements.omega = 0.0
    elements.f = 0.0
    r_m, v_m_s = orbitalMotion.elem2rv(earth.mu, elements)
    craft.hub.r_CN_NInit = r_m
    craft.hub.v_CN_NInit = v_m_s
    start = times(target, quaternion_of(START_RAD))
    craft.hub.sigma_BNInit = [[one] for one in mrp_of_xyzw(start)]
    craft.hub.omega_BN_BInit = [[0.0], [0.0], [0.0]]
    torque = extForceTorque.ExtForceTorque()
    craft.addDynamicEffector(torque)

    # Star camera and navigation.
    camera = StarCamera(port, period_s=FRAME_S, latency_s=latency_s)
    camera.scStateInMsg.subscribeTo(craft.scStateOutMsg)
    navigation = Navigation(camera, seed)
    navigation.scStateInMsg.subscribeTo(craft.scStateOutMsg)
    navigation.stAttInMsg.subscribeTo(camera.stAttOutMsg)

    # Basilisk's control: u = -K sigma - P omega, with sigma a quarter of the angle.
    reference = inertial3D.inertial3D()
    reference.sigma_R0N = mrp_of_xyzw(target).tolist()
    tracking = attTrackingError.attTrackingError()
    tracking.attNavInMsg.subscribeTo(navigation.attOutMsg)
    tracking.attRefInMsg.subscribeTo(reference.attRefOutMsg)
    control = mrpFeedback.mrpFeedback()
    control.K = 4 * INERTIA_KG_M2 * BANDWIDTH_RAD_S**2
    control.P = 2 * DAMPING * BANDWIDTH_RAD_S * INERTIA_KG_M2
    control.Ki = -1.0
    control.guidInMsg.subscribeTo(tracking.attGuidOutMsg)
    vehicle = messaging.VehicleConfigMsgPayload()
    vehicle.ISCPntB_B = (INERTIA_KG_M2 * np.eye(3)).ravel().tolist()
    vehicle_message = messaging.VehicleConfigMsg().write(vehicle)
    control.vehConfigInMsg.subscribeTo(vehicle_message)
    torque.cmdTorqueInMsg.subscribeTo(control.cmdTorqueOutMsg)

    for priority, model in ((100, craft), (90, torque), (80, camera), (70, navigation)):
        sim.AddModelToTask("dynamics", model, priority)
    for priority, model in ((60, reference), (50, tracking), (40, control)):
        sim.AddModelToTask("control", model, priority)
    states = craft.scStateOutMsg.recorder()
    sim.AddModelToTask("dynamics", states)

    # Control begins after the first attitudes.
    sim.InitializeSimulation()
    sim.disableTask("control")
    sim.ConfigureStopTime(macros.sec2nano(1.0))
    sim.ExecuteSimulation()
    sim.enableTask("control")
    sim.ConfigureStopTime(macros.sec2nano(seconds))
    sim.ExecuteSimulation()
    camera.wire.close()
    return figures(camera, states, target)


def figures(camera: StarCamera, states: Any, target: Any) -> dict[str, Any]:
    """Errors of the solutions against Basilisk's truth, and of the pointing."""
    t_s = states.times() * NANO
    lab_from_body = np.array([xyzw_of_mrp(one) for one in states.sigma_BN])
    rates = states.omega_BN_B
    cross = []
    roll = []
    sigmas = []
    for solution in camera.solutions:
        if solution["status"] != "solved":
            continue
        # The true attitude at mid-exposure, from the nearest sample.
        k = int(np.argmin(abs(t_s - solution["t_s"])))
        turned = quaternion_of(rates[k] * (solution["t_s"] - t_s[k]))
        cam_from_lab = times(camera.cam_from_body, inverse(times(lab_from_body[k], turned)))
        error_rad = rotation_vector(
            times(np.array(solution["cam_from_ref_xyzw"]), inverse(cam_from_lab))
        )
        covariance = np.array(solution["covariance_rad2"])
        cross.append(np.hypot(*error_rad[:2]) * ARCSEC)
        roll.append(abs(error_rad[2]) * ARCSEC)
        sigmas.append(np.sqrt(error_rad @ np.linalg.solve(covariance, error_rad)))
    settled = np.flatnonzero(t_s >= SETTLED_S)
    pointing = [rotation_vector(times(inverse(target), lab_from_body[k])) for k in settled]
    rms = (
        np.sqrt(np.mean(np.square(pointing), axis=0)) * ARCSEC
        if pointing
        else np.full(3, np.nan)
    )
    return {
        "frames": sum(camera.statuses.values()),
        "statuses": dict(camera.statuses),
        "worst_cross_arcsec": max(cross),
        "worst_roll_arcsec": max(roll),
        "worst_sigma": max(sigmas),
        "mean_nees": float(np.mean(np.square(sigmas))),
        "pointing_rms_arcsec": rms.tolist(),
        "exchange_ms": dict(
            zip(
                ("p10", "median", "p90"),
                (1e3 * np.quantile(camera.exchange_s, [0.1, 0.5, 0.9])).tolist(),
                strict=True,
            )
        ),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description="Basilisk's attitude control on rendered stars"
    )
    parser.add_argument("port", type=int)
    parser.add_argument("--seconds", type=float, default=200.0)
    parser.add_argument("--latency", type=float, default=0.0, metavar="SECONDS")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(json.dumps(fly(given.port, given.seconds, given.latency, given.seed)))


if __name__ == "__main__":
    main()
