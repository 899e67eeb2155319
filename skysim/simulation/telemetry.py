"""Record what the vehicle did and what its navigation estimated, at every control period."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.types import Floats, Telemetry
from skysim.dynamics.flight_computer import CmgActuator, FlightComputer
from skysim.dynamics.guidance import Reference
from skysim.dynamics.multibody import Flight
from skysim.tracking.navigation import Navigation


class TelemetryRecorder:
    """Records of a simulated motion, one row per control period; `telemetry` returns them as a table.

    Quantities held in the flight's states are read from them at the end; only the others are recorded on the way.
    """

    def __init__(self, flight: Flight, pilot: FlightComputer, navigation: Navigation | None) -> None:
        self.flight, self.pilot, self.navigation = flight, pilot, navigation
        steps = round(pilot.period_s / flight.step_s)
        self.at_step = np.arange(0, flight.last, steps)
        self.row = 0
        rows = len(self.at_step)
        self.torque_nm, self.disturbance_nm = np.zeros((rows, 3)), np.zeros((rows, 3))
        self.momentum_nms = np.zeros((rows, 3))
        self.imu_wxyz, self.filter_wxyz = np.zeros((rows, 4)), np.zeros((rows, 4))
        self.saturated = np.zeros(rows, dtype=bool)
        self.bias_rad_s = np.zeros((rows, 3))
        self.believed = np.zeros((rows, 3, 3))  # filter: sigma of the attitude, bias, its sigma

    def disturbed(self, torque_nm: Floats) -> None:
        """Record the mean disturbance torque (3,) of this control period; call it before `note`."""
        self.disturbance_nm[self.row] = torque_nm

    def note(self, momentum_nms: Floats) -> None:
        """Record the rest of this control period, after the controls are set and before the vehicle moves."""
        k = self.row
        self.row += 1
        self.torque_nm[k], self.momentum_nms[k] = self.pilot.wanted_nm, momentum_nms
        if self.navigation:
            self.believe(k, self.navigation)

    def believe(self, k: int, navigation: Navigation) -> None:
        """Record the present estimates of the inertial navigator and of the filter in row k."""
        self.imu_wxyz[k] = navigation.attitude_wxyz("imu")
        self.saturated[k] = navigation.saturated
        self.bias_rad_s[k] = navigation.apparent_bias_rad_s(
            self.flight.lab_from_body_wxyz, self.flight.rate_body_rad_s
        )
        if navigation.filter:
            state = navigation.filter.state
            self.filter_wxyz[k] = navigation.attitude_wxyz("filter")
            self.believed[k] = state.sigma_attitude_rad, state.bias_rad_s, state.sigma_bias_rad_s

    def telemetry(self, reference: Reference | None) -> Telemetry:
        """All rows as Telemetry; reference is the commanded attitude profile, if there is one."""
        flight, ship, noted = self.flight, self.flight.world, self.at_step[: self.row]
        at_one_go = self.row == 1  # integrated in a single call, see `ClosedLoop.nobody_speaks`
        if at_one_go:
            noted = self.at_step
        states, nq = flight.states[noted], flight.model.nq
        if at_one_go:
            angles, speeds = states[:, 1 : 1 + nq], states[:, 1 + nq :]
            self.momentum_nms[:] = [
                self.pilot.momentum_nms(q, v) for q, v in zip(angles, speeds, strict=True)
            ]
        cmgs = self.pilot.sets.get("cmgs")
        gimbals, rotors = states[:, 1 + ship.gimbals.qpos], states[:, 1 + nq + ship.rotors.dof]
        t_s, navigation = noted * np.float64(flight.step_s), self.navigation
        listens = navigation is not None
        filters = navigation is not None and navigation.filter is not None
        return Telemetry(
            t_s,
            self.pilot.period_s,
            Rotation.from_quat(states[:, 1:5], scalar_first=True),
            states[:, 1 + nq : 4 + nq].copy(),
            self.torque_nm,
            self.disturbance_nm,
            self.momentum_nms,
            states[:, 1 + nq + ship.wheels.dof],
            gimbals,
            states[:, 1 : 1 + nq].copy(),
            cmgs.set.manipulability(gimbals, rotors) if isinstance(cmgs, CmgActuator) else None,
            reference.attitudes(t_s) if reference else None,
            turned(self.imu_wxyz) if listens else None,
            self.saturated if listens else None,
            self.bias_rad_s if listens else None,
            turned(self.filter_wxyz) if filters else None,
            *((self.believed[:, n] if filters else None) for n in range(3)),
        )


def turned(wxyz: Floats) -> Rotation:
    return Rotation.from_quat(wxyz, scalar_first=True)
