"""The vehicle in motion: flight computer, dynamics, disturbances, vibration and IMU, one control period at a time.

`check_reference` refuses a maneuver that exceeds the vehicle's limits, `forecast_torque` forecasts what the actuators
give, and `shortfall` tells what they cannot. `Motion.advance` simulates a control period:

1. The controller reads the attitude and the rate, true or estimated.
2. The flight computer sets the actuators.
3. Disturbance torques are added.
4. `Motion.record` records the state, before it changes.
5. Valves and the like turn the controls into those of every step, else the controls are held; MuJoCo integrates the
   equations of motion.
6. The IMU samples the motion with its vibration, and the navigation takes the samples.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera import as_built
from skysim.core.errors import InputError
from skysim.core.plugins import NO_PROGRAMS, Programs
from skysim.core.quaternion import to_rotation
from skysim.core.random_streams import AIR_CURRENT, IMU, random_stream
from skysim.core.types import Bools, Floats, Mounting, Record, Telemetry, Trajectory, lengths
from skysim.core.units import significant
from skysim.dynamics import guidance, imu, multibody
from skysim.dynamics.disturbances import DisturbanceModel
from skysim.dynamics.flight_computer import NO_COMMANDS, Commands, FlightComputer, usage
from skysim.dynamics.guidance import Reference
from skysim.dynamics.multibody import Simulation
from skysim.dynamics.multibody.actuator_kind import ControlInput
from skysim.dynamics.multibody.cmgs import CmgActuator
from skysim.dynamics.multibody.model import build_actuators, build_drives
from skysim.dynamics.multibody.thrusters import propellant_kg
from skysim.scene.sections.motion import BUILT_IN_LAWS
from skysim.scene.sections.vehicle import VehicleConfig
from skysim.simulation.lab import Lab, StarCamera
from skysim.tracking.navigation import Navigation

# Limits of the vehicle: tilt, and rate and torque of profiles and chirps.

TILT_CHECK_S = 0.05  # sampling interval of a maneuver when its tilt is checked
ROUNDING = 1e-6  # relative excess over a limit that counts as rounding


def check_reference(lab: Lab, reference: Reference, duration_s: float) -> None:
    """Raise InputError for a maneuver beyond the tilt stop, the gyros' range or the actuators' torque.

    The controller would push against the stop, or fall behind. The torque of a rate w and an acceleration a is
    J a + w x J w. A prescribed motion needs no torque.
    """
    scene = lab.scene
    motion = scene.motion
    vehicle = scene.vehicle
    # Without a controller the vehicle may reach the stop later.
    check_tilt(reference, vehicle, 0.0 if motion.control is None else duration_s)
    if motion.control is None:
        return
    legs = zip(reference.legs, reference.start_s, motion.maneuver, strict=False)
    for n, (leg, begin_s, element) in enumerate(legs):
        if element.kind not in ("profile", "chirp"):
            continue
        t_s, rate, acceleration = demands(leg, 1 / scene.control_rate_hz)
        key = f"motion.maneuver.{n}: {element.kind}"
        if vehicle.imu is not None:
            limit_deg_s = vehicle.imu.gyro.rate_limit_deg_s
            fastest = np.abs(rate).max(axis=1)
            k = int(fastest.argmax())
            if fastest[k] > math.radians(limit_deg_s) * (1 + ROUNDING):
                raise InputError(
                    key,
                    f"{math.degrees(fastest[k]):.4g} deg/s about a body axis at {begin_s + t_s[k]:.6g} s",
                    f"up to vehicle.imu.gyro.rate_limit_deg_s {limit_deg_s:g}",
                )
        if not motion.is_prescribed:
            inertia = lab.vehicle.inertia_kg_m2
            torque_nm = acceleration @ inertia.T + np.cross(rate, rate @ inertia.T)
            actuators = build_actuators(vehicle, lab.vehicle)[motion.control.actuators]
            used = usage(actuators, torque_nm)
            k = int(used.argmax())
            if used[k] > 1 + ROUNDING:
                raise InputError(
                    key,
                    f"needs a torque of ({components(torque_nm[k], 3)}) N m at {begin_s + t_s[k]:.6g} s,"
                    f" {used[k]:.3g} times what the actuators {motion.control.actuators} can give",
                    "slower or smaller, or motion.control: prescribed",
                )


def check_tilt(reference: Reference, vehicle: VehicleConfig, duration_s: float) -> None:
    """Raise InputError for a tilt beyond the stop of the air bearing, up to the end of the motion.

    An endless motion is checked up to the end of the maneuvers.
    """
    if vehicle.mount != "air_bearing":
        return
    end_s = duration_s if math.isfinite(duration_s) else reference.duration_s
    t_s = np.arange(0, end_s + TILT_CHECK_S, TILT_CHECK_S)
    tilt_deg = multibody.tilt_deg(reference.attitudes(t_s))
    beyond = np.flatnonzero(tilt_deg > vehicle.tilt_stop_deg)
    if len(beyond):
        raise InputError(
            "motion.maneuver" if beyond[0] else "motion.start",
            f"tilt of {tilt_deg[beyond[0]]:.3g} deg at {t_s[beyond[0]]:.3g} s",
            f"up to vehicle.tilt_stop_deg {vehicle.tilt_stop_deg:g}",
        )


def demands(leg: guidance.AnyLeg, period_s: float) -> tuple[Floats, Floats, Floats]:
    """(K,) times since the leg's start, (K, 3) rates and (K, 3) accelerations in body axes.

    They are those at the samples of a profile, else at every control period. Between two samples the acceleration of
    a profile is nearly linear in time, so it is greatest at a sample.
    """
    if isinstance(leg, guidance.ProfileLeg):
        knots_s = leg.spline.t_s - leg.begin_s
        t_s = knots_s[(knots_s >= 0) & (knots_s <= leg.duration_s)]
        _, rate, acceleration = leg.spline.states_at(t_s + leg.begin_s)
        return t_s, rate, acceleration
    t_s = np.arange(0.0, leg.duration_s, period_s)
    _, rates, accelerations = zip(*(leg.state_at(float(t)) for t in t_s), strict=True)
    return t_s, np.array(rates), np.array(accelerations)


def components(vector: Floats, digits: int) -> str:
    """A vector with commas; 0 for components below the last digit of the largest one."""
    return ", ".join(f"{one:.{digits}g}" for one in significant(vector, digits))


# Actuators at their limits: forecast, and in words.

FORECAST_S = 0.02  # period of the forecast, at least
FORECAST_PERIODS = 2000  # greatest number of periods
MISSING = 0.01  # share of the greatest torque that may be missing
LEAST_SHORT_S = 0.2  # shorter shortfalls give no warning
FLOWN_S = 300.0  # longest flight that shows how long actuators are saturated
AT_LIMIT = 0.999  # load from which an actuator is saturated: friction keeps a wheel just below its limit


class TorqueForecast(NamedTuple):
    """The torque that a maneuver needs, and what the actuators give.

    Attributes
    ----------
    period_s, t_s
        Forecast period, and (K,) starts of the periods
    needed_nm, given_nm
        (K, 3) torques in body axes
    propellant_kg
        Propellant that the thrusters use for it; 0 without thrusters
    """

    period_s: float
    t_s: Floats
    needed_nm: Floats
    given_nm: Floats
    propellant_kg: float


def forecast_torque(lab: Lab) -> TorqueForecast | None:
    """The forecast of the torques of a maneuver; None without a controller.

    The vehicle is put on the reference in each period. Then

    1. the torque needed is that of MuJoCo's inverse dynamics for the mean acceleration over the period, less the
       disturbances, plus what the actuators still owe;
    2. the flight computer allocates it, and wheels and gimbals respond.

    A jump of the rate is a torque over one period. Jumps of the attitude and knocks are left out.
    """
    scene = lab.scene
    control = scene.motion.control
    if control is None or scene.motion.is_prescribed:
        return None
    # The torque is given, so the control law does not matter.
    pid = scene.with_values("motion.control", law="pid")
    reference = lab.reference
    period_s = max(FORECAST_S, lab.duration_s / FORECAST_PERIODS)
    vehicle = lab.vehicle
    start = multibody.Simulation(vehicle, Rotation.identity(), np.zeros(3), period_s)
    angles = start.angles_rad.copy()
    speeds = start.speeds_rad_s.copy()
    t_s = np.arange(0.0, lab.duration_s, period_s)
    computer = FlightComputer(pid, vehicle, reference)
    disturbances = build_disturbances(lab, (), period_s)
    needed = np.zeros((len(t_s), 3))
    given = np.zeros((len(t_s), 3))
    owed = np.zeros(3)
    used_kg = 0.0
    following = reference.state_at(0.0)
    for k, t in enumerate(t_s.tolist()):
        # 1. Torque.
        attitude, rate, _ = following
        following = reference.state_at(t + period_s)
        angles[:4] = attitude
        speeds[:3] = rate
        momentum = computer.momentum_nms(angles, speeds)
        ends_s = np.array([t, t + period_s])
        mean = (following[1] - rate) / period_s
        needed[k] = start.required_torque_nm(angles, speeds, mean)
        needed[k] -= disturbances.torque_nm(ends_s, attitude, rate, momentum)[0]
        # 2. Allocation and response.
        inputs = ControlInput(t, period_s, rate, angles, speeds)
        commands = Commands(owed + needed[k])
        controls = computer.compute_controls(inputs, attitude, momentum, commands)
        given[k] = computer.achieved_nm
        owed += needed[k] - given[k]
        if scene.vehicle.thrusters:
            impulses_ns = controls[vehicle.thrusters.motor] * period_s
            used_kg += float(propellant_kg(impulses_ns, scene.vehicle.thrusters).sum())
        angles[vehicle.gimbals.qpos] += period_s * controls[vehicle.gimbals.motor]
        for spun in (vehicle.wheels, vehicle.rotors):
            torque = np.where(spun.motor < 0, 0.0, controls[spun.motor])
            speeds[spun.dof] += period_s * torque / spun.inertia_kg_m2
    return TorqueForecast(period_s, t_s, needed, given, used_kg)


def shortfall(lab: Lab, forecast: TorqueForecast | None) -> str:
    """A warning if the actuators cannot give the torque that the maneuver needs; empty if they can."""
    control = lab.scene.motion.control
    if control is None or forecast is None:
        return ""
    period_s, t_s, needed, given, _ = forecast
    owed = needed - given
    missing = lengths(owed)
    if (missing > MISSING * np.abs(needed).max()).sum() * period_s < LEAST_SHORT_S:
        return ""
    # Later the actuators give more than is needed: what they owe.
    n = int((owed * needed).sum(axis=1).argmax())
    text = flown_saturation(lab)
    return (
        f"motion.maneuver: needs a torque of ({components(needed[n], 2)}) N m at {t_s[n]:.1f} s, of which the"
        f" actuators {control.actuators} give ({components(given[n], 2)})"
        f"{text and ': '}{text}; change it to a slower or smaller one, balance"
        " the vehicle, or take stronger actuators"
    )


def flown_saturation(lab: Lab) -> str:
    """The actuators at their limits in a flight without cameras, as `saturation_text`.

    The controller gets the truth; `pid` replaces an external one. Of a long flight only the first FLOWN_S are flown.
    """
    scene = lab.scene
    control = scene.motion.control
    assert control is not None
    law = control.law if control.law in BUILT_IN_LAWS else "pid"
    scene = scene.with_values("motion.control", law=law, feedback="truth")
    scene = scene.with_values("vehicle", imu=None).with_values(filter=None)
    lab = replace(lab, scene=scene)
    motion = Motion(lab, NO_PROGRAMS, min(lab.duration_s, FLOWN_S))
    while motion.simulation.steps_left:
        motion.advance(motion.period_steps)
    log = motion.telemetry()
    return saturation_text(log.t_s, log.loads)


def at_limit(loads: Mapping[str, Floats]) -> dict[str, Bools]:
    """Whether each actuator is at its limit, (K,) by name; actuators that never are left out."""
    return {name: full for name, load in loads.items() if (full := load >= AT_LIMIT).any()}


def saturation_text(t_s: Floats, loads: Mapping[str, Floats]) -> str:
    """The actuators at their limits, with the first and the last of the times (K,), and their share of the time."""
    parts = []
    for name, full in at_limit(loads).items():
        first, last = np.flatnonzero(full)[[0, -1]]
        share = full[first : last + 1].mean()
        part = f", {100 * share:.0f} % of the time" if share < 0.95 else ""
        parts.append(f"{name} saturated from {t_s[first]:.1f} s to {t_s[last]:.1f} s{part}")
    return "; ".join(parts)


# The mounting states of the filter.


def mounting_rad(camera: StarCamera, t_s: Floats) -> Floats:
    """(K, 3) rotation vector of the attitude error from a camera's mount error and temperature, in body axes.

    The real camera is rotated by e from its assumed mount C: cam = exp(e) C body. The attitude of the body by its
    tracker is C^-1 exp(e) C body = exp(C^-1 e) body, so ref_from_body = truth exp(-C^-1 e).
    """
    error = camera.mount_error or Rotation.identity()
    config = camera.scene.thermal
    turned = [
        (as_built.turned(config, t) if config else Rotation.identity()) * error for t in t_s
    ]
    return -camera.mount.body_from_cam.apply(Rotation.concatenate(turned).as_rotvec())


# The motion.


class Motion:
    """The motion of a lab's vehicle. Stateful: use one object for one motion.

    Parameters
    ----------
    lab
        Laboratory
    programs
        External controllers other than entry points, by name
    duration_s
        Greatest duration; may be infinite with `kept_s`
    kept_s
        Time for which past states and IMU samples are kept; None keeps all of them

    Attributes
    ----------
    period_steps
        Integration steps in a control period
    keeps_history
        Whether all control periods are recorded
    rows
        Arrays of what the simulation does not keep, one row per control period, by name; made at the first one

    Raises
    ------
    InputError
        For a maneuver that the vehicle cannot follow, and for vibration that needs too many samples.
    """

    def __init__(
        self,
        lab: Lab,
        programs: Programs,
        duration_s: float,
        kept_s: float | None = None,
    ) -> None:
        scene = lab.scene
        vehicle = lab.vehicle
        self.lab = lab
        self.reference = lab.reference
        check_reference(lab, self.reference, duration_s)
        if scene.motion.is_prescribed:
            self.simulation: Simulation = multibody.PrescribedMotion(
                vehicle, self.reference.state_at, duration_s, kept_s
            )
        else:
            self.simulation = multibody.Simulation(
                vehicle, lab.start, lab.start_rate_rad_s, duration_s, kept_s
            )
        self.vibration = lab.vibration(self.reference)
        if kept_s is None:
            # This raises InputError for too many samples before any long work.
            self.vibration.subdivisions(
                self.simulation.times_s(0, self.simulation.last_step + 1)
            )
        self.flight_computer = FlightComputer(scene, vehicle, self.reference, programs)
        self.period_steps = round(self.flight_computer.period_s / self.simulation.step_s)
        self.drives = build_drives(scene.vehicle, vehicle)
        self.navigation = None
        if scene.vehicle.imu is not None:
            self.navigation = Navigation(
                scene,
                tuple(camera.mount for camera in lab.cameras),
                lab.start,
                multibody.imu_position_m(vehicle),
                vehicle.gravity_m_s2,
                random_stream(scene.seed, IMU, 0),
                math.inf if kept_s is None else kept_s,
            )
        impulses = guidance.impulses(scene.motion, self.reference)
        self.disturbances = build_disturbances(lab, impulses, self.flight_computer.period_s)
        self.keeps_history = kept_s is None
        self.rows = Record()

    def close(self) -> None:
        """End the process of an external controller."""
        self.flight_computer.close()

    @property
    def is_free(self) -> bool:
        """Whether nothing depends on the motion: no disturbances, no controller and no navigation."""
        return self.disturbances.inactive and not (
            self.lab.scene.motion.control or self.navigation
        )

    @property
    def readings(self) -> dict[str, Floats]:
        """The present readings of the actuators' hardware, by name."""
        return {
            name: values for drive in self.drives for name, values in drive.readings.items()
        }

    def advance(self, steps: int, commands: Commands = NO_COMMANDS) -> None:
        """Simulate some steps with controls that are held over them, by the steps of the module's docstring.

        Parameters
        ----------
        steps
            Number of integration steps: those of a control period, or more if nothing depends on the motion
        commands
            What replaces the control law
        """
        simulation = self.simulation
        flight_computer = self.flight_computer
        navigation = self.navigation
        angles = simulation.angles_rad
        speeds = simulation.speeds_rad_s
        attitude = angles[:4]
        rate = speeds[:3]
        momentum = flight_computer.momentum_nms(angles, speeds)
        # 1. The controller gets the truth or, with feedback imu or filter, the estimates of the navigation.
        measured_attitude = attitude
        measured_rate = rate
        config = flight_computer.config
        if navigation and config and config.feedback != "truth":
            measured_attitude = navigation.attitude_wxyz(config.feedback)
            measured_rate = navigation.body_rate_rad_s(config.feedback)
        # 2. Controls.
        inputs = ControlInput(
            simulation.now_s, flight_computer.period_s, measured_rate, angles, speeds
        )
        held = flight_computer.compute_controls(inputs, measured_attitude, momentum, commands)
        control = np.empty((min(steps, simulation.steps_left), len(held)))
        control[:] = held
        # 3. Disturbances act through the model's ideal torque actuators. They change at every step; commands do not.
        mean_nm = np.zeros(3)
        if not (self.disturbances.inactive or self.lab.scene.motion.is_prescribed):
            times_s = simulation.times_s(simulation.step, simulation.step + len(control) + 1)
            disturbance = self.disturbances.torque_nm(times_s, attitude, rate, momentum)
            control[:, simulation.vehicle.torques] += disturbance
            mean_nm = disturbance.sum(axis=0) / len(control)
        # 4. Record before the motion advances, so that all columns of a row are of the same time.
        if self.keeps_history:
            self.record(steps // self.period_steps, mean_nm)
        # 5. Integration.
        for drive in self.drives:
            drive.apply(control, angles)
        simulation.advance(control)
        # 6. IMU.
        if navigation:
            navigation.sample_imu(simulation.now_s, *self.last_knots(len(control)))

    def record(self, periods: int, disturbance_nm: Floats) -> None:
        """Record control periods of the same controls and mean disturbance (3,), before the motion advances."""
        row = Record(
            torque_nm=self.flight_computer.control_torque_nm,
            disturbance_nm=disturbance_nm,
            control=self.flight_computer.control,
        )
        for drive in self.drives:
            row |= drive.readings
        simulation = self.simulation
        navigation = self.navigation
        if navigation:
            row.update(
                lab_from_imu=navigation.attitude_wxyz("imu"),
                saturated=navigation.saturated,
                bias_rad_s=navigation.apparent_bias_rad_s(
                    simulation.lab_from_body_wxyz, simulation.rate_body_rad_s
                ),
            )
            if navigation.filter:
                state = navigation.filter.state
                row.update(
                    lab_from_filter=navigation.attitude_wxyz("filter"),
                    sigma_attitude_rad=state.sigma_attitude_rad,
                    assumed_bias_rad_s=state.bias_rad_s,
                    sigma_bias_rad_s=state.sigma_bias_rad_s,
                    # The mounting states of the filter, that of the main camera first.
                    mountings=[
                        (estimate, state.sigma(name))
                        for name, estimate in state.others.items()
                        if name.startswith("mounting")
                    ],
                )
        number = simulation.step // self.period_steps
        now = slice(number, number + periods)
        rows = self.rows
        for name, value in row.items():
            if name not in rows:
                one = np.asarray(value)
                count = math.ceil(simulation.last_step / self.period_steps)
                rows[name] = np.zeros((count, *one.shape), one.dtype)
            rows[name][now] = value

    def telemetry(self) -> Telemetry:
        """The rows so far as Telemetry; there is no commanded attitude without a controller."""
        simulation = self.simulation
        vehicle = simulation.vehicle
        steps = np.arange(0, simulation.step, self.period_steps)
        states = simulation.states[steps]
        rows = {name: row[: len(steps)] for name, row in self.rows.items()}
        nq = simulation.nq
        readings = {name: rows.pop(name) for name in self.readings}
        cmgs = self.flight_computer.actuator_sets.get("cmgs")
        gimbals = states[:, 1 + vehicle.gimbals.qpos]
        rotors = states[:, 1 + nq + vehicle.rotors.dof]
        t_s = steps * np.float64(simulation.step_s)
        rows["loads"] = self.flight_computer.loads(rows.pop("control"), states[:, 1 + nq :])
        # The filter's mounting states (K, n, 2, 3); that of a head is relative to that of the main camera.
        states_rad = rows.pop("mountings", np.zeros(0))
        rows["mountings"] = {}
        if states_rad.size:
            true_rad = np.array([mounting_rad(camera, t_s) for camera in self.lab.cameras])
            true_rad[1:] -= true_rad[0]
            rows["mountings"] = {
                camera.name: Mounting(states_rad[:, n, 0], states_rad[:, n, 1], true_rad[n])
                for n, camera in enumerate(self.lab.cameras)
            }
        for name in rows:
            if name.startswith("lab_from"):
                rows[name] = to_rotation(rows[name])
        return Telemetry(
            t_s,
            self.flight_computer.period_s,
            to_rotation(states[:, 1:5]),
            states[:, 1 + nq : 4 + nq].copy(),
            wheel_rad_s=states[:, 1 + nq + vehicle.wheels.dof],
            gimbal_rad=gimbals,
            joints=states[:, 1 : 1 + nq].copy(),
            momentum_nms=np.array(
                [
                    self.flight_computer.momentum_nms(state[1 : 1 + nq], state[1 + nq :])
                    for state in states
                ]
            ),
            manipulability=cmgs.manipulability(gimbals, rotors)
            if isinstance(cmgs, CmgActuator)
            else None,
            lab_from_ref=self.reference.attitudes(t_s)
            if self.lab.scene.motion.control
            else None,
            wheel_names=vehicle.wheels.names,
            gimbal_names=vehicle.gimbals.names,
            readings=readings,
            **rows,
        )

    def trajectory(self, begin_s: float = 0.0) -> Trajectory:
        """The motion from shortly before a time until now, with the vibration."""
        first = max(int(begin_s / self.simulation.step_s) - 1, self.simulation.first_step)
        return self.vibration.add_to(self.simulation.trajectory(first))

    def last_knots(self, steps: int) -> tuple[Floats, Floats, Floats]:
        """Times (K,), lab_from_body_wxyz (K, 4) and rates (K, 3) in body axes of the last steps, with the vibration."""
        simulation = self.simulation
        begin = max(simulation.step - steps, 0)
        if not self.vibration.components:
            return simulation.knots(begin)
        trajectory = self.vibration.add_to(simulation.trajectory(begin))
        return (
            trajectory.t_s,
            trajectory.lab_from_body.as_quat(scalar_first=True),
            trajectory.rate_body_rad_s,
        )


def build_disturbances(
    lab: Lab, impulses: tuple[guidance.Impulse, ...], period_s: float
) -> DisturbanceModel:
    """The scene's disturbances, with these knocks."""
    scene = lab.scene
    return DisturbanceModel(
        scene.vehicle.disturbances,
        imu.earth_rate_lab_rad_s(scene.site),
        impulses,
        lab.vehicle.inertia_kg_m2,
        period_s,
        random_stream(scene.seed, AIR_CURRENT, 0),
    )
