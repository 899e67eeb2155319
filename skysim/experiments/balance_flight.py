"""One flight of a vehicle to be balanced: its excitation, its frames, and the measurements of the lab."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.mass_dynamics import (
    BearingRecord,
    LabConstants,
    MassEstimate,
    Prior,
    inertia_six,
)
from skysim.core.constants import RPM_RAD_S
from skysim.core.errors import InputError
from skysim.core.random_streams import BALANCE, random_stream
from skysim.core.types import Floats, Record
from skysim.core.units import quantities_within
from skysim.dynamics import imu, multibody
from skysim.dynamics.multibody import VehicleModel
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import BUILT_IN_LAWS, MotionConfig
from skysim.simulation.flight import Flight, Progress, open_flight

# The assumed vehicle before it is balanced, and its uncertainty.


PARAMETERS = 17  # number of parameters, without the wheels' relative errors
# Standard deviation of the constant lab torque, relative to the offset's torque.
LAB_TORQUE_SHARE = 0.05
# Rate at which the drag's standard deviation equals that of the lab torque.
DRAG_RATE_RAD_S = 0.1
LEAST_TORQUE_NM = 1e-7  # rms of the random torque that is always assumed
DEFAULT_CORRELATION_S = 2.0
MAX_TACHO_RPM = 1000.0

# By option: unit, quantity, example, minimum and maximum.
RANGES = {
    "inertia_sigma": ("", "share", '"10%"', 1e-3, 0.5),
    "offset_sigma": ("m", "length", '"300 um"', 1e-7, 0.01),
    "wheel_sigma": ("", "share", '"0.1%"', 1e-6, 0.1),
    "mount_sigma": ("rad", "plane angle", '"0.03 deg"', 1e-8, 0.1),
}


class Uncertainty(NamedTuple):
    """Standard deviations of the Gaussian errors of the assumed vehicle.

    Attributes
    ----------
    inertia_sigma
        Each moment of inertia, relative to their mean; half of it for the products
    offset_sigma_m
        Center of mass along each axis, which is assumed to be the bearing's center
    wheel_sigma
        Axial inertia of each wheel, relative
    mount_sigma_rad
        Rotation of the tracker in the body about each axis
    tacho_sigma_rad_s
        Each reading of a wheel's speed
    """

    inertia_sigma: float
    offset_sigma_m: float
    wheel_sigma: float
    mount_sigma_rad: float
    tacho_sigma_rad_s: float


def parse_uncertainty(
    inertia_sigma: str,
    offset_sigma: str,
    wheel_sigma: str,
    mount_sigma: str,
    tacho_sigma_rpm: float,
) -> Uncertainty:
    """Parse quantities with units. Raises InputError for an invalid or out-of-range value."""
    texts = inertia_sigma, offset_sigma, wheel_sigma, mount_sigma
    sigmas = quantities_within("balance", RANGES, texts)
    if not 0 <= tacho_sigma_rpm <= MAX_TACHO_RPM:
        raise InputError(
            "balance.tacho_sigma", f"{tacho_sigma_rpm:g}", f"0 to {MAX_TACHO_RPM:g} rpm"
        )
    return Uncertainty._make([*sigmas, tacho_sigma_rpm * RPM_RAD_S])


class Assumptions(NamedTuple):
    """The lab's assumptions on a vehicle with its trim masses at zero.

    Attributes
    ----------
    prior
        Prior of the parameters, with gravity, Earth rate, wheel axes and level of the random torque
        (`estimator.calibration.mass_properties`)
    wheel_inertia_kg_m2
        (n,) assumed axial inertias
    """

    prior: Prior
    wheel_inertia_kg_m2: Floats


def draw_assumptions(
    scene: Scene, at_zero: VehicleModel, uncertainty: Uncertainty
) -> Assumptions:
    """Draw the errors of inertia and wheels from the scene's seed; offset, lab torque and drag are assumed as zero.

    The level of air currents is assumed as in the scene, or LEAST_TORQUE_NM.
    """
    rng = random_stream(scene.seed, BALANCE, 0)
    count = len(at_zero.wheels)
    true_kg_m2 = at_zero.inertia_kg_m2
    inertia_sigma = (
        uncertainty.inertia_sigma * np.trace(true_kg_m2) / 3 * np.repeat([1.0, 0.5], 3)
    )
    moment_kg_m = at_zero.mass.mass_kg * uncertainty.offset_sigma_m
    torque_nm = LAB_TORQUE_SHARE * moment_kg_m * at_zero.gravity_m_s2
    drag = torque_nm / DRAG_RATE_RAD_S ** np.array([1, 2])
    rest = [
        moment_kg_m,
        torque_nm,
        *drag,
        uncertainty.mount_sigma_rad,
        uncertainty.wheel_sigma,
    ]
    sigma = np.append(inertia_sigma, np.repeat(rest, [3, 3, 1, 1, 3, count]))
    values = np.zeros(PARAMETERS + count)
    values[:6] = inertia_six(true_kg_m2) + inertia_sigma * rng.standard_normal(6)
    assumed_wheels = at_zero.wheels.inertia_kg_m2 / (
        1 + uncertainty.wheel_sigma * rng.standard_normal(count)
    )
    lab = known_lab(scene, at_zero, uncertainty)
    return Assumptions(Prior(values, sigma, lab), assumed_wheels)


def known_lab(scene: Scene, vehicle: VehicleModel, uncertainty: Uncertainty) -> LabConstants:
    """The lab as the estimator assumes it."""
    disturbances = scene.vehicle.disturbances
    air = disturbances.air_current
    earth = imu.earth_rate_lab_rad_s(scene.site)
    return LabConstants(
        vehicle.gravity_m_s2,
        vehicle.wheels.axes,
        np.maximum(air.rms_nm if air else 0.0, LEAST_TORQUE_NM) * np.ones(3),
        air.correlation_s if air else DEFAULT_CORRELATION_S,
        earth * disturbances.earth_rotation,
        float(np.max(vehicle.wheels.inertia_kg_m2, initial=0.0))
        * uncertainty.tacho_sigma_rad_s,
    )


# Mass properties that a flight has not shown well enough, with the motion that would.


LEAST_RATE_DEG_S = 0.05  # rate below which a turn does not count
LEAST_INFORMATION = 1e-3  # fraction of the needed information below which more of the same motion does not help
AXES = "xyz"


def uncertain(
    estimate: MassEstimate,
    prior: Prior,
    records: Sequence[BearingRecord],
    inertia_bar: float,
    moment_bar_kg_m: Floats,
    excitation: Excitation,
) -> list[str]:
    """One line for each moment of inertia and component of the static moment that is less certain than required.

    Parameters
    ----------
    inertia_bar
        Standard deviation of a moment of inertia over its value
    moment_bar_kg_m
        (3,) standard deviations of the components of mass times center of mass
    excitation
        Tilt and length of the flights
    """
    values = estimate.values
    sigma = estimate.sigma
    # The largest rate about each body axis between two attitudes.
    rates = [turn_rates(one.t_s, one.lab_from_body) for one in records]
    rate_deg_s = np.degrees(np.abs(np.concatenate(rates)).max(axis=0))
    tilt_deg = largest_tilt_deg(records)
    faults = []
    for axis in range(3):
        bar = inertia_bar * abs(values[axis])
        if sigma[axis] > bar:
            known = f"inertia about {AXES[axis]} is known to {100 * sigma[axis] / abs(values[axis]):.3g} %"
            shown = f"after turns of {rate_deg_s[axis]:.2g} deg/s"
            if rate_deg_s[axis] < LEAST_RATE_DEG_S:
                shown = "after no turn about it"
            needed = remedy("turn", sigma[axis], prior.sigma[axis], bar, excitation)
            faults.append(f"{known}, not {100 * inertia_bar:.3g} %, {shown}: {needed}")
    for axis in range(3):
        if sigma[6 + axis] > moment_bar_kg_m[axis]:
            known = f"moment along {AXES[axis]} is known to {1e6 * sigma[6 + axis]:.4g} g mm"
            needed = remedy(
                "tilt",
                sigma[6 + axis],
                prior.sigma[6 + axis],
                moment_bar_kg_m[axis],
                excitation,
            )
            faults.append(
                f"{known}, not {1e6 * moment_bar_kg_m[axis]:.3g}, after tilts of {tilt_deg:.1f} deg: {needed}"
            )
    return faults


class Excitation(NamedTuple):
    """Tilt of a flight, its greatest value, and its length relative to the usual one, as options give them."""

    tilt_deg: float
    most_deg: float
    longer: float


def remedy(
    motion: str, sigma: float, prior_sigma: float, bar: float, excitation: Excitation
) -> str:
    """Advice on the motion: the information beyond the prior grows with time and with the square of the motion."""
    needed = bar**-2 - prior_sigma**-2
    gained = max(sigma**-2 - prior_sigma**-2, 0.0)
    if gained < LEAST_INFORMATION * needed:
        return f"a {motion} is needed that the wheels' known momentum or a known trim weighs"
    factor = needed / gained
    # Rounded up to one digit after the point, with a margin of 5 %.
    tilt_deg = math.ceil(10 * excitation.tilt_deg * math.sqrt(1.05 * factor)) / 10
    longer = math.ceil(10 * 1.05 * factor * excitation.longer) / 10
    by_tilt = f"--tilt {tilt_deg:g}, or " if tilt_deg <= excitation.most_deg else ""
    return f"fly again with {by_tilt}--longer {longer:g}"


def turn_rates(t_s: Floats, lab_from_body: Rotation) -> Floats:
    """(N - 1, 3) mean rates about the body axes between N attitudes."""
    turned = lab_from_body[:-1].inv() * lab_from_body[1:]
    return turned.as_rotvec() / np.diff(t_s)[:, None]


def largest_tilt_deg(records: Sequence[BearingRecord]) -> float:
    """Largest angle between body z and lab z."""
    return max(float(multibody.tilt_deg(one.lab_from_body).max()) for one in records)


YAWS_DEG = (0.0, 120.0, 240.0)
AXES_DEG = (0.0, 90.0, 45.0)  # axis of the tilting at each of these yaws, from body x
PERIODS = 2  # number of periods of tilting at each yaw
# Fractions of the wheels' torque and momentum that the maneuver uses.
TORQUE_SHARE = 0.3
MOMENTUM_SHARE = 0.3
STOP_MARGIN_DEG = 1.0
LEAST_ATTITUDES = 20
MAX_HZ = 0.1
YAW_DEG_S = 5.0
YAW_DEG_S2 = 1.0
SWING_S = 150.0


class BalanceFlight(NamedTuple):
    """A flight's record, the true vehicle, and numbers of frames: all, solved, and after a contact.

    Attributes
    ----------
    frames, solved, after_contact
        Numbers of frames
    """

    record: BearingRecord
    vehicle: VehicleModel
    frames: int
    solved: int
    after_contact: int


def check_scene(scene: Scene) -> None:
    """Raise InputError for a scene whose vehicle cannot be measured in this way."""
    vehicle = scene.vehicle
    if vehicle.mount != "air_bearing":
        raise InputError(
            "vehicle.mount", "a free vehicle has no bearing to be balanced on", "air_bearing"
        )
    if scene.stars:
        raise InputError(
            "light.kind", "stars: balancing needs attitudes relative to the lab", "dome"
        )
    if vehicle.disturbances.cable:
        raise InputError(
            "vehicle.disturbances.cable",
            "its spring acts like a low center of mass",
            "no cable",
        )
    if vehicle.cmgs:
        raise InputError(
            "vehicle.cmgs", "the stored momentum must be that of wheels", "no cmgs"
        )


def excited_by_wheels(
    scene: Scene, vehicle: VehicleModel, tilt_deg: float, longer: float = 1.0
) -> Scene:
    """The scene with wheels at rest at its start and a maneuver that tilts the vehicle at three yaw angles.

    The tilting lasts `longer` times PERIODS periods at each of them.

    The yaw separates an offset of the center of mass from a horizontal torque that is constant in the lab. The tilt
    shows the height of the offset. The wheels' momentum about all three axes shows the moments of inertia.
    """
    wheels = scene.vehicle.wheels
    if wheels is None:
        raise InputError(
            "vehicle.wheels",
            "none, and the inertia's scale is that of the wheels",
            "excite swing",
        )
    largest = float(np.linalg.eigvalsh(vehicle.inertia_kg_m2)[2])
    torque = TORQUE_SHARE * wheels.torque_limit_nm / (largest * math.radians(tilt_deg))
    limit_rad_s = wheels.speed_limit_rpm * RPM_RAD_S
    momentum = (
        MOMENTUM_SHARE * float(vehicle.wheels.inertia_kg_m2.min()) * limit_rad_s / largest
    )
    rate_hz = min(
        MAX_HZ,
        math.sqrt(torque) / (2 * math.pi),
        momentum / math.radians(tilt_deg) / (2 * math.pi),
    )
    acceleration = math.degrees(TORQUE_SHARE * wheels.torque_limit_nm / largest)
    legs: list[Record] = []
    for yaw_deg, axis_deg in zip(YAWS_DEG, AXES_DEG, strict=True):
        axis_rad = math.radians(axis_deg)
        legs += [
            {
                "kind": "slew",
                "yaw_deg": yaw_deg,
                "rate_deg_s": min(YAW_DEG_S, math.degrees(momentum)),
                "acceleration_deg_s2": min(YAW_DEG_S2, acceleration),
            },
            {
                "kind": "sine",
                "amplitude_deg": [
                    tilt_deg * math.cos(axis_rad),
                    tilt_deg * math.sin(axis_rad),
                    0.0,
                ],
                "frequency_hz": rate_hz,
                "duration": f"{longer * PERIODS / rate_hz} s",
            },
        ]
    control = scene.motion.control
    law = {"law": "pid", "actuators": "wheels"}
    if control and control.law in BUILT_IN_LAWS:
        kept = {"bandwidth_rad_s", "damping", "integral_rad_s", "rate_hz"}
        law |= control.model_dump(include=kept)
    motion = MotionConfig.model_validate({"control": law, "maneuver": legs[1:]})
    return scene.with_values("vehicle.wheels", start_rpm=()).with_values(motion=motion)


def excited_by_swing(scene: Scene, tilt_deg: float, number: int) -> Scene:
    """The scene with the vehicle released at rest and tilted, at another yaw in every flight, without control."""
    start = {
        "roll_deg": tilt_deg,
        "pitch_deg": tilt_deg / 2,
        "yaw_deg": YAWS_DEG[number % len(YAWS_DEG)],
    }
    motion = MotionConfig.model_validate({"start": start})
    return scene.with_values(motion=motion)


def with_frames(scene: Scene, duration_s: float) -> Scene:
    """The scene with as many frames, two at least, as its frame rate gives in a duration."""
    frames = max(int((duration_s - scene.exposure.first_s) * scene.exposure.rate_hz), 2)
    return scene.with_values("exposure", frames=frames)


def fly(
    scene: Scene,
    assumptions: Assumptions,
    uncertainty: Uncertainty,
    watch: Progress | None,
) -> BalanceFlight:
    """Simulate a flight, render and solve its frames, and return the measurements.

    Frames are left out from the first one near the tilt stop on, because the torque of a contact is unknown.
    """
    with open_flight(scene) as flight:
        measured = measured_attitudes(flight, watch)
        log = flight.telemetry()
    # A time tag may be before the first wheel speed.
    rows = [row for row in measured if row[0] >= log.t_s[0]]
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
        raise InputError(
            "balance", f"{len(kept)} attitudes {cause}", f"{LEAST_ATTITUDES} or more"
        )
    t_s, attitudes, parts, lights = zip(*kept, strict=True)
    covariance, systematic, constant = np.stack(parts, axis=1)
    speeds = log.wheel_rad_s + uncertainty.tacho_sigma_rad_s * random_stream(
        scene.seed, BALANCE, 1
    ).standard_normal(log.wheel_rad_s.shape)
    lab_from_body = Rotation.concatenate(attitudes)
    record = BearingRecord(
        np.array(t_s),
        lab_from_body,
        covariance
        + timing_covariance(np.array(t_s), lab_from_body, scene.exposure.time_tag_jitter_s),
        log.t_s,
        speeds * assumptions.wheel_inertia_kg_m2,
        *vehicle.trims.added(vehicle.trims.position_m),
        systematic,
        constant,
        np.array(lights),
    )
    return BalanceFlight(
        record, vehicle, scene.exposure.frames, len(rows), len(rows) - len(kept)
    )


def measured_attitudes(
    flight: Flight, watch: Progress | None
) -> list[tuple[float, Rotation, Floats, Floats]]:
    """Of each solved frame: time, attitude, covariances in body axes, and which LEDs it has used, 1 or 0.

    The covariances (3, 3, 3) are the whole one, the part that frames share, and the part of this that is constant.
    """
    camera = flight.lab.camera
    body_from_cam = camera.mount.body_from_cam
    R_body_from_cam = body_from_cam.as_matrix()
    rows = []
    for shot in flight.shots(cameras=[0], progress=watch):
        attitude = shot.solution.attitude
        if attitude.cam_from_ref is not None and attitude.covariance_rad2 is not None:
            parts = [
                np.zeros((3, 3)) if one is None else R_body_from_cam @ one @ R_body_from_cam.T
                for one in (
                    attitude.covariance_rad2,
                    attitude.systematic_rad2,
                    attitude.constant_rad2,
                )
            ]
            used = np.zeros(len(camera.sources))
            # An external tracker may not say which LEDs it has used.
            known = slice(None) if attitude.match is None else attitude.match.star
            used[known] = 1.0
            lab_from_body = (body_from_cam * attitude.cam_from_ref).inv()
            rows.append((shot.frame.t_mid_s, lab_from_body, np.array(parts), used))
    return rows


def timing_covariance(t_s: Floats, lab_from_body: Rotation, jitter_s: float) -> Floats:
    """(N, 3, 3) covariance s^2 w w^T of attitudes whose times have the error s, with the rate w from differences."""
    turned = turn_rates(t_s, lab_from_body)
    rate = np.vstack([turned[:1], (turned[1:] + turned[:-1]) / 2, turned[-1:]])
    return jitter_s**2 * rate[:, :, None] * rate[:, None, :]
