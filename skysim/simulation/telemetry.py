"""Record what the vehicle did and what its navigation estimated, at every control period."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.types import Floats, Telemetry
from skysim.dynamics.flight_computer import CmgActuator, FlightComputer
from skysim.dynamics.guidance import Reference
from skysim.dynamics.multibody import Simulation
from skysim.tracking.navigation import Navigation


class TelemetryRecorder:
    """Records of a simulated motion, one row per control period; `telemetry` returns them as a table.

    Quantities in the simulation's states are read from them at the end; only the others are recorded on the way.
    """

    def __init__(self, simulation: Simulation, flight_computer: FlightComputer, navigation: Navigation | None) -> None:
        self.simulation, self.flight_computer, self.navigation = simulation, flight_computer, navigation
        steps = round(flight_computer.period_s / simulation.step_s)
        self.at_step = np.arange(0, simulation.last_step, steps)
        self.row = 0
        rows = len(self.at_step)
        self.torque_nm, self.disturbance_nm = np.zeros((rows, 3)), np.zeros((rows, 3))
        self.momentum_nms = np.zeros((rows, 3))
        self.imu_wxyz, self.filter_wxyz = np.zeros((rows, 4)), np.zeros((rows, 4))
        self.saturated = np.zeros(rows, dtype=bool)
        self.bias_rad_s = np.zeros((rows, 3))
        self.filter_estimates = np.zeros((rows, 3, 3))  # filter: sigma of the attitude, bias, its sigma

    def record_disturbance(self, torque_nm: Floats) -> None:
        """Record the mean disturbance torque (3,) of this control period; call it before `record`."""
        self.disturbance_nm[self.row] = torque_nm

    def record(self, momentum_nms: Floats) -> None:
        """Record the rest of this control period, after the controls are set and before the vehicle moves."""
        k = self.row
        self.row += 1
        self.torque_nm[k], self.momentum_nms[k] = self.flight_computer.control_torque_nm, momentum_nms
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
            self.filter_estimates[k] = state.sigma_attitude_rad, state.bias_rad_s, state.sigma_bias_rad_s

    def telemetry(self, reference: Reference | None) -> Telemetry:
        """All rows as Telemetry; reference is the commanded attitude profile, if there is one."""
        simulation, vehicle, steps = self.simulation, self.simulation.vehicle, self.at_step[: self.row]
        single_call = self.row == 1  # integrated in a single call, see `ClosedLoop.is_free_motion`
        if single_call:
            steps = self.at_step
        states, nq = simulation.states[steps], simulation.model.nq
        if single_call:
            angles, speeds = states[:, 1 : 1 + nq], states[:, 1 + nq :]
            self.momentum_nms[:] = [
                self.flight_computer.momentum_nms(q, v) for q, v in zip(angles, speeds, strict=True)
            ]
        cmgs = self.flight_computer.actuator_sets.get("cmgs")
        gimbals, rotors = states[:, 1 + vehicle.gimbals.qpos], states[:, 1 + nq + vehicle.rotors.dof]
        t_s, navigation = steps * np.float64(simulation.step_s), self.navigation
        has_imu = navigation is not None
        has_filter = navigation is not None and navigation.filter is not None
        return Telemetry(
            t_s,
            self.flight_computer.period_s,
            Rotation.from_quat(states[:, 1:5], scalar_first=True),
            states[:, 1 + nq : 4 + nq].copy(),
            self.torque_nm,
            self.disturbance_nm,
            self.momentum_nms,
            states[:, 1 + nq + vehicle.wheels.dof],
            gimbals,
            states[:, 1 : 1 + nq].copy(),
            cmgs.model.manipulability(gimbals, rotors) if isinstance(cmgs, CmgActuator) else None,
            reference.attitudes(t_s) if reference else None,
            rotation(self.imu_wxyz) if has_imu else None,
            self.saturated if has_imu else None,
            self.bias_rad_s if has_imu else None,
            rotation(self.filter_wxyz) if has_filter else None,
            *((self.filter_estimates[:, n] if has_filter else None) for n in range(3)),
        )


def rotation(wxyz: Floats) -> Rotation:
    return Rotation.from_quat(wxyz, scalar_first=True)
