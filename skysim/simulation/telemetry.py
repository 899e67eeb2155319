"""Record what the vehicle did and what its navigation estimated, at every control period."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera import thermal_motion
from skysim.core.types import Floats, Mounting, Telemetry
from skysim.dynamics.flight_computer import FlightComputer
from skysim.dynamics.guidance import Reference
from skysim.dynamics.multibody import Simulation
from skysim.dynamics.multibody.actuators.cmgs import CmgActuator
from skysim.simulation.lab import StarCamera
from skysim.tracking.navigation import Navigation


class TelemetryRecorder:
    """Records of a simulated motion, one row per control period; `telemetry` returns them as a table.

    Quantities in the simulation's states are read from them at the end; only the others are recorded on the way.
    """

    def __init__(
        self, simulation: Simulation, flight_computer: FlightComputer, navigation: Navigation | None
    ) -> None:
        self.simulation = simulation
        self.flight_computer = flight_computer
        self.navigation = navigation
        steps = round(flight_computer.period_s / simulation.step_s)
        self.at_step = np.arange(0, simulation.last_step, steps)
        self.steps_per_tick = steps
        rows = len(self.at_step)
        self.recorded = np.zeros(rows, dtype=bool)
        self.torque_nm = np.zeros((rows, 3))
        self.disturbance_nm = np.zeros((rows, 3))
        self.momentum_nms = np.zeros((rows, 3))
        self.imu_wxyz = np.zeros((rows, 4))
        self.filter_wxyz = np.zeros((rows, 4))
        self.saturated = np.zeros(rows, dtype=bool)
        self.bias_rad_s = np.zeros((rows, 3))
        self.filter_estimates = np.zeros(
            (rows, 3, 3)
        )  # filter: sigma of the attitude, bias, its sigma
        mounted = mounting_states(navigation)
        self.mountings = np.zeros(
            (len(mounted), 2, rows, 3)
        )  # filter: estimate and sigma of each mounting

    @property
    def row(self) -> int:
        """Row of the control period that begins now."""
        return self.simulation.step // self.steps_per_tick

    def record_disturbance(self, torque_nm: Floats) -> None:
        """Record the mean disturbance torque (3,) of this control period; call it before `record`."""
        self.disturbance_nm[self.row] = torque_nm

    def record(self, momentum_nms: Floats) -> None:
        """Record the rest of this control period, after the controls are set and before the vehicle moves."""
        k = self.row
        self.recorded[k] = True
        self.torque_nm[k], self.momentum_nms[k] = (
            self.flight_computer.control_torque_nm,
            momentum_nms,
        )
        if self.navigation:
            self.record_estimates(k, self.navigation)

    def record_estimates(self, k: int, navigation: Navigation) -> None:
        """Record the present estimates of the inertial navigator and of the filter in row k."""
        self.imu_wxyz[k] = navigation.attitude_wxyz("imu")
        self.saturated[k] = navigation.saturated
        self.bias_rad_s[k] = navigation.apparent_bias_rad_s(
            self.simulation.lab_from_body_wxyz, self.simulation.rate_body_rad_s
        )
        if navigation.filter:
            state = navigation.filter.state
            self.filter_wxyz[k] = navigation.attitude_wxyz("filter")
            self.filter_estimates[k] = (
                state.sigma_attitude_rad,
                state.bias_rad_s,
                state.sigma_bias_rad_s,
            )
            for n, name in enumerate(mounting_states(navigation)):
                self.mountings[n, :, k] = state.others[name], state.sigma(name)

    def telemetry(self, reference: Reference | None, cameras: Sequence[StarCamera]) -> Telemetry:
        """All rows as Telemetry; reference is the commanded attitude profile, if there is one."""
        simulation = self.simulation
        vehicle = self.simulation.vehicle
        steps = self.at_step[self.at_step < simulation.step]
        states = simulation.states[steps]
        nq = simulation.model.nq
        # Several control periods of a free motion are integrated at once, and only the first is recorded.
        for k in np.flatnonzero(~self.recorded[: len(steps)]):
            self.momentum_nms[k] = self.flight_computer.momentum_nms(
                states[k, 1 : 1 + nq], states[k, 1 + nq :]
            )
        cmgs = self.flight_computer.actuator_sets.get("cmgs")
        gimbals = states[:, 1 + vehicle.gimbals.qpos]
        rotors = states[:, 1 + nq + vehicle.rotors.dof]
        t_s = steps * np.float64(simulation.step_s)
        navigation = self.navigation
        rows = slice(len(steps))
        has_imu = navigation is not None
        has_filter = navigation is not None and navigation.filter is not None
        return Telemetry(
            t_s,
            self.flight_computer.period_s,
            Rotation.from_quat(states[:, 1:5], scalar_first=True),
            states[:, 1 + nq : 4 + nq].copy(),
            self.torque_nm[rows],
            self.disturbance_nm[rows],
            self.momentum_nms[rows],
            states[:, 1 + nq + vehicle.wheels.dof],
            gimbals,
            states[:, 1 : 1 + nq].copy(),
            cmgs.model.manipulability(gimbals, rotors) if isinstance(cmgs, CmgActuator) else None,
            reference.attitudes(t_s) if reference else None,
            rotation(self.imu_wxyz[rows]) if has_imu else None,
            self.saturated[rows] if has_imu else None,
            self.bias_rad_s[rows] if has_imu else None,
            rotation(self.filter_wxyz[rows]) if has_filter else None,
            self.filter_estimates[rows, 0] if has_filter else None,
            self.filter_estimates[rows, 1] if has_filter else None,
            self.filter_estimates[rows, 2] if has_filter else None,
            self.mountings_by_camera(t_s, cameras),
        )

    def mountings_by_camera(
        self, t_s: Floats, cameras: Sequence[StarCamera]
    ) -> dict[str, Mounting]:
        """The filter's mounting states, and what they are in truth."""
        if not len(self.mountings):
            return {}
        names = [camera.name for camera in cameras]
        true_rad = [mounting_rad(camera, t_s) for camera in cameras]
        relative_rad = [true_rad[0], *(head - true_rad[0] for head in true_rad[1:])]
        return {
            name: Mounting(estimate[: len(t_s)], sigma[: len(t_s)], true)
            for name, (estimate, sigma), true in zip(
                names, self.mountings, relative_rad, strict=True
            )
        }


def mounting_states(navigation: Navigation | None) -> list[str]:
    """Names of the filter's mounting states, the main camera's first."""
    if navigation is None or navigation.filter is None:
        return []
    return [name for name in navigation.filter.state.others if name.startswith("mounting")]


def mounting_rad(camera: StarCamera, t_s: Floats) -> Floats:
    """(K, 3) the error that a camera's real mount makes of the body's attitude, in body axes.

    The real camera is turned by e from its assumed mount C, cam = exp(e) C body. Its tracker's attitude of the body is
    C^-1 exp(e) C body = exp(C^-1 e) body, so that ref_from_body = truth exp(-C^-1 e).
    """
    error = camera.mount_error or Rotation.identity()
    config = camera.scene.thermal
    turned = [(thermal_motion.turned(config, t) if config else Rotation.identity()) * error for t in t_s]
    return -camera.mount.cam_from_body.inv().apply(Rotation.concatenate(turned).as_rotvec())


def rotation(wxyz: Floats) -> Rotation:
    return Rotation.from_quat(wxyz, scalar_first=True)
