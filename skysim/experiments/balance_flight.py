"""One flight of a vehicle to be balanced: excitation, frames, and what the lab measures of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
import numpy as np
from scipy.spatial.transform import Rotation
from estimator.calibration.mass_dynamics import BearingRecord
from skysim.core.constants import RPM_RAD_S
from skysim.core.errors import InputError
from skysim.core.random_streams import BALANCE, random_stream
from skysim.core.types import Floats
from skysim.dynamics import guidance, multibody
from skysim.dynamics.multibody import VehicleModel
from skysim.experiments.balance_prior import (Assumptions, Uncertainty)
from skysim.experiments.configs import with_config
from skysim.scene.scene import Scene
from skysim.scene.sections.light import StarsConfig
from skysim.scene.sections.motion import MotionConfig
from skysim.simulation.flight import Flight, open_flight



YAWS_DEG = (0.0, 120.0, 240.0)
AXES_DEG = (0.0, 90.0, 45.0)  # of the tilting at each of these, from body x
PERIODS = 2  # of tilting at each yaw
# of what the wheels can do that the maneuver takes
TORQUE_SHARE = 0.3
MOMENTUM_SHARE = 0.3
STOP_MARGIN_DEG = 1.0
LEAST_ATTITUDES = 20
MAX_HZ = 0.1
YAW_DEG_S = 5.0
YAW_DEG_S2 = 1.0
SWING_S = 150.0
ProgressCallback = Callable[[float, float], None]


@dataclass(frozen=True, slots=True)
class BalanceFlight:
    """A flight's record, the true vehicle, and how many frames had no attitude or came after a contact.

    frames, solved, after_contact : numbers of frames
    """

    record: BearingRecord
    vehicle: VehicleModel
    frames: int
    solved: int
    after_contact: int


def check_scene(scene: Scene) -> None:
    """Refuse a scene whose vehicle cannot be weighed so."""
    vehicle = scene.vehicle
    if vehicle.mount != "air_bearing":
        raise InputError(
            "vehicle.mount", "a free vehicle has no bearing to be balanced on", "air_bearing"
        )
    if isinstance(scene.light, StarsConfig):
        raise InputError(
            "light.kind", "stars: balancing needs attitudes relative to the lab", "dome"
        )
    if vehicle.disturbances.cable:
        raise InputError(
            "vehicle.disturbances.cable", "its spring acts like a low center of mass", "no cable"
        )
    if vehicle.cmgs:
        raise InputError("vehicle.cmgs", "the stored momentum must be that of wheels", "no cmgs")


def excited_by_wheels(scene: Scene, vehicle: VehicleModel, tilt_deg: float) -> Scene:
    """The scene with its wheels at rest at first and a maneuver that tilts the vehicle at three yaw angles.

    The yaw separates an offset of the center of mass from a horizontal torque that is constant in the lab, the tilt
    shows the offset's height, and the wheels' momentum, about all three axes, the moments of inertia.
    """
    wheels = scene.vehicle.wheels
    if wheels is None:
        raise InputError(
            "vehicle.wheels", "none, and the inertia's scale is that of the wheels", "excite swing"
        )
    largest = float(np.linalg.eigvalsh(vehicle.inertia_kg_m2)[2])
    torque = TORQUE_SHARE * wheels.torque_limit_nm / (largest * math.radians(tilt_deg))
    limit_rad_s = wheels.speed_limit_rpm * RPM_RAD_S
    momentum = MOMENTUM_SHARE * float(vehicle.wheels.inertia_kg_m2.min()) * limit_rad_s / largest
    rate_hz = min(
        MAX_HZ, math.sqrt(torque) / (2 * math.pi), momentum / math.radians(tilt_deg) / (2 * math.pi)
    )
    acceleration = math.degrees(TORQUE_SHARE * wheels.torque_limit_nm / largest)
    legs = []
    for yaw_deg, axis_deg in zip(YAWS_DEG, AXES_DEG, strict=True):
        legs.append(
            {
                "kind": "slew",
                "yaw_deg": yaw_deg,
                "rate_deg_s": min(YAW_DEG_S, math.degrees(momentum)),
                "acceleration_deg_s2": min(YAW_DEG_S2, acceleration),
            }
        )
        direction = [math.cos(math.radians(axis_deg)), math.sin(math.radians(axis_deg)), 0.0]
        legs.append(
            {
                "kind": "sine",
                "amplitude_deg": [tilt_deg * one for one in direction],
                "frequency_hz": rate_hz,
                "duration": f"{PERIODS / rate_hz} s",
            }
        )
    control = scene.motion.control
    law = {"law": "pid", "actuators": "wheels"}
    if control and control.law in ("pid", "pd"):
        law |= {
            key: getattr(control, key)
            for key in ("bandwidth_rad_s", "damping", "integral_rad_s", "rate_hz")
        }
    motion = MotionConfig.model_validate({"control": law, "maneuver": legs[1:]})
    return with_config(scene, "vehicle.wheels", start_rpm=()).model_copy(update={"motion": motion})


def excited_by_swing(scene: Scene, tilt_deg: float, number: int) -> Scene:
    """The scene with the vehicle let go at rest, tilted and at another yaw in every flight, without control."""
    start = {
        "roll_deg": tilt_deg,
        "pitch_deg": tilt_deg / 2,
        "yaw_deg": YAWS_DEG[number % len(YAWS_DEG)],
    }
    motion = MotionConfig.model_validate({"start": start})
    return scene.model_copy(update={"motion": motion})


def with_frames(scene: Scene, duration_s: float) -> Scene:
    """The scene with frames at its rate over this time."""
    frames = max(int((duration_s - scene.exposure.first_s) * scene.exposure.rate_hz), 2)
    return with_config(scene, "exposure", frames=frames)


def maneuver_s(scene: Scene) -> float:
    """Duration of a scene's maneuver."""
    return guidance.plan(scene.motion).duration_s


def fly(
    scene: Scene, assumptions: Assumptions, uncertainty: Uncertainty, watch: ProgressCallback | None
) -> BalanceFlight:
    """Simulate a flight, render and solve its frames, and return what was measured.

    The frames from the first one near the tilt stop on are left out, because the torque of a contact is unknown.
    """
    with open_flight(scene) as flight:
        rows = measured_attitudes(flight, watch)
        log = flight.telemetry()
    vehicle = flight.lab.vehicle
    tilts_deg = np.array([multibody.tilt_deg(attitude) for _, attitude, *_ in rows])
    contact = np.flatnonzero(tilts_deg > scene.vehicle.tilt_stop_deg - STOP_MARGIN_DEG)
    kept = rows[: contact[0]] if len(contact) else rows
    if len(kept) < LEAST_ATTITUDES:
        cause = (
            "before the vehicle touched its tilt stop: balance it by hand first"
            if len(contact)
            else "were solved"
        )
        raise InputError("balance", f"{len(kept)} attitudes {cause}", f"{LEAST_ATTITUDES} or more")
    t_s, attitudes, covariances, shared = zip(*kept, strict=True)
    speeds = log.wheel_rad_s + uncertainty.tacho_sigma_rad_s * random_stream(
        scene.seed, BALANCE, 1
    ).standard_normal(log.wheel_rad_s.shape)
    lab_from_body = Rotation.concatenate(attitudes)
    record = BearingRecord(
        np.array(t_s),
        lab_from_body,
        np.array(covariances)
        + timing_covariance(np.array(t_s), lab_from_body, scene.exposure.time_tag_jitter_s),
        log.t_s,
        speeds * assumptions.wheel_inertia_kg_m2,
        *vehicle.trims.added(vehicle.trims.position_m),
        np.array(shared),
    )
    return BalanceFlight(record, vehicle, scene.exposure.frames, len(rows), len(rows) - len(kept))


def measured_attitudes(
    flight: Flight, watch: ProgressCallback | None
) -> list[tuple[float, Rotation, Floats, Floats]]:
    """Of every frame that the tracker solved: time, attitude, (3, 3) covariance in body axes, and its shared part."""
    camera = flight.lab.camera
    body_from_cam = camera.mount.cam_from_body.inv()
    R_body_from_cam = body_from_cam.as_matrix()
    rows = []
    for shot in flight.shots(cameras=[0], progress=watch):
        assert shot.report is not None
        attitude = shot.report.attitude
        if attitude.cam_from_ref is not None and attitude.covariance_rad2 is not None:
            systematic = (
                np.zeros((3, 3)) if attitude.systematic_rad2 is None else attitude.systematic_rad2
            )
            covariance, shared = (
                R_body_from_cam @ one @ R_body_from_cam.T
                for one in (attitude.covariance_rad2, systematic)
            )
            rows.append(
                (
                    shot.frame.t_mid_s,
                    (body_from_cam * attitude.cam_from_ref).inv(),
                    covariance,
                    shared,
                )
            )
    return rows


def timing_covariance(t_s: Floats, lab_from_body: Rotation, jitter_s: float) -> Floats:
    """(N, 3, 3) s^2 w w^T of attitudes whose times have the error s, with the rate w of their differences."""
    turned = (lab_from_body[:-1].inv() * lab_from_body[1:]).as_rotvec() / np.diff(t_s)[:, None]
    rate = np.vstack([turned[:1], (turned[1:] + turned[:-1]) / 2, turned[-1:]])
    return np.asarray(jitter_s**2 * rate[:, :, None] * rate[:, None, :])


