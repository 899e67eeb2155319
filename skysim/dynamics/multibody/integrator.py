"""Integrate the equations of motion: step the model with given controls, and keep every state.

MuJoCo computes the multibody dynamics and integrates them by the fourth-order Runge-Kutta method with a fixed step
(model.STEP_S). Controls are constant within each step. `Simulation.advance` does the following:

1. Make room for the new states.
2. Integrate one step for each row of controls; raise an error if MuJoCo warned.
"""

import copy
from collections.abc import Callable
from functools import partial

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.quaternion import to_rotation
from skysim.core.types import Floats, Trajectory
from skysim.dynamics.multibody.mjcf import MujocoWarnings
from skysim.dynamics.multibody.model import VehicleModel, set_start
from skysim.dynamics.multibody.wheels import Stiction

STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)
MAX_STEPS = 2**62  # stands for an infinite duration

Controller = Callable[[float, Rotation, Floats], Floats]


class Simulation:
    """A simulated motion in progress. `advance` integrates some steps with given controls and keeps all states.

    MuJoCo's rollout steps in C and writes every state directly into `states`, so there is no overhead per step. The
    present is the last state; angles, rates and speeds are views of it.

    Parameters
    ----------
    vehicle
        Vehicle to simulate
    lab_from_body
        Attitude at the start
    rate_body_rad_s
        (3,) rate at the start, in body axes
    duration_s
        Greatest duration of this motion, which sets the memory; may be infinite with history_s
    history_s
        Age of the oldest states to keep; there is memory for twice as many. None keeps all states

    Attributes
    ----------
    states
        (rows, size) MuJoCo's full physics states: time, qpos (lab_from_body wxyz first), qvel, actuator states
    step, first_step
        Numbers of the present step and of the step in the first row of `states`
    """

    def __init__(
        self,
        vehicle: VehicleModel,
        lab_from_body: Rotation,
        rate_body_rad_s: Floats,
        duration_s: float,
        history_s: float | None = None,
    ) -> None:
        check_tilt(vehicle, lab_from_body)
        self.vehicle = vehicle
        self.model = vehicle.model
        self.stiction = None
        wheels = vehicle.config.wheels
        if wheels and wheels.stiction_nm:
            # The friction of a wheel at rest is a parameter of the model.
            self.model = copy.copy(vehicle.model)
            self.stiction = Stiction(self.model, wheels)
        # Attributes of MuJoCo's objects take longer to read than their values.
        self.step_s = float(self.model.opt.timestep)
        self.nq = self.model.nq
        self.nv = self.model.nv
        self.last_step = max(1, int(np.ceil(min(duration_s / self.step_s, MAX_STEPS) - 1e-6)))
        self.history_steps = (
            self.last_step if history_s is None else int(np.ceil(history_s / self.step_s))
        )
        # Memory for all steps, or for twice the history, so that old states are dropped in blocks.
        rows = min(self.last_step, 2 * self.history_steps) + 1
        self.states = np.empty((rows, mujoco.mj_stateSize(self.model, STATE)))
        self.step = self.first_step = 0
        self.data = mujoco.MjData(self.model)
        # MuJoCo's own memory as the warm start carries the solver's state over from call to call.
        self.rollout = partial(
            Rollout(nthread=0).rollout,
            [self.model],
            [self.data],
            control_spec=CONTROL,
            skip_checks=True,
            initial_warmstart=self.data.qacc_warmstart[None],
        )
        # The initial state; wheel speeds, rotor speeds and gimbal angles are those of the scene.
        data = self.data
        data.qpos[:4] = lab_from_body.as_quat(scalar_first=True)
        data.qvel[:3] = rate_body_rad_s
        set_start(vehicle.config, self.model, data)
        mujoco.mj_getState(self.model, data, self.states[0], STATE)
        # The forward dynamics give the warm start of the first step.
        mujoco.mj_forward(self.model, data)

    @property
    def steps_left(self) -> int:
        """Number of steps up to the greatest duration."""
        return self.last_step - self.step

    @property
    def now_s(self) -> float:
        """Time since the start."""
        return self.step * self.step_s

    @property
    def lab_from_body_wxyz(self) -> Floats:
        """(4,) present attitude, scalar first."""
        return self.angles_rad[:4]

    @property
    def rate_body_rad_s(self) -> Floats:
        """(3,) present rate in body axes."""
        return self.speeds_rad_s[:3]

    @property
    def angles_rad(self) -> Floats:
        """(nq,) present qpos; `Hinges.qpos` has the indices of the joints."""
        return self.states[self.row, 1 : 1 + self.nq]

    @property
    def speeds_rad_s(self) -> Floats:
        """(nv,) present qvel; `Hinges.dof` has the indices of the joints."""
        return self.states[self.row, 1 + self.nq : 1 + self.nq + self.nv]

    @property
    def row(self) -> int:
        """Row of the present state in `states`."""
        return self.step - self.first_step

    def discard_old(self, steps: int) -> None:
        """Drop states older than `history_steps` if there is no room for this number of new steps."""
        if self.row + steps < len(self.states):
            return
        # Move the kept states to the front.
        old = max(self.row - self.history_steps, 0)
        self.states[: self.row - old + 1] = self.states[old : self.row + 1]
        self.first_step += old

    def advance(self, control: Floats) -> None:
        """Integrate one step for each row of control (K, nu). Raises InputError if MuJoCo warned.

        MuJoCo resets an unstable model to its start and continues.
        """
        # 1. Room.
        self.discard_old(len(control))
        # 2. Integration; step by step if the friction of a wheel may change.
        if self.stiction is None:
            self.integrate(control)
        else:
            for row in control:
                self.stiction.set_friction(row, self.speeds_rad_s, self.data.qacc[:3])
                self.integrate(row[None])

    def integrate(self, control: Floats) -> None:
        """Integrate one step for each row of control (K, nu) with MuJoCo's rollout. Raises InputError if it warned."""
        row = self.row
        steps = len(control)
        with MujocoWarnings() as warned:
            self.rollout(
                self.states[None, row],
                control[None],
                nstep=steps,
                state=self.states[None, row + 1 : row + 1 + steps],
            )
        self.step += steps
        if warned:
            # The next call clears MuJoCo's own record.
            kinds = np.flatnonzero(self.data.warning.number).tolist()
            names = ", ".join(mujoco.mjtWarning(kind).name for kind in kinds)
            raise InputError(
                "motion",
                f"not integrable at a step of {1e3 * self.step_s:g} ms: MuJoCo warned before {self.now_s:.3f} s"
                f" ({names}); check vehicle and motion.control for stiff, fast or NaN values",
            )

    def required_torque_nm(
        self, angles_rad: Floats, speeds_rad_s: Floats, acceleration_rad_s2: Floats
    ) -> Floats:
        """(3,) torque of the actuators in body axes for an acceleration (3,) of the body, by MuJoCo's inverse dynamics.

        It is J a + w x (J w + h), less the torques of gravity, air drag and cable spring.
        """
        data = self.data
        data.qpos[:] = angles_rad
        data.qvel[:] = speeds_rad_s
        data.qacc[:] = 0.0
        data.qacc[:3] = acceleration_rad_s2
        mujoco.mj_inverse(self.model, data)
        return np.array(data.qfrc_inverse[:3])

    def times_s(self, begin: int, end: int) -> Floats:
        """(end - begin,) times of the steps begin, ..., end - 1."""
        return np.arange(begin, end) * np.float64(self.step_s)

    def knots(self, begin: int = 0) -> tuple[Floats, Floats, Floats]:
        """Times (K,), attitudes lab_from_body_wxyz (K, 4) and rates (K, 3) in body axes, from step begin on."""
        states = self.states[begin - self.first_step : self.row + 1]
        rates = states[:, 1 + self.nq : 4 + self.nq]
        return self.times_s(begin, self.step + 1), states[:, 1:5], rates

    def trajectory(self, begin: int = 0) -> Trajectory:
        """The motion from step begin on, as a Trajectory."""
        t_s, lab_from_body_wxyz, rate = self.knots(begin)
        return Trajectory(t_s, to_rotation(lab_from_body_wxyz), rate.copy())


class PrescribedMotion(Simulation):
    """A motion along given attitudes, without dynamics; wheels and gimbals stay in their initial state.

    Attributes
    ----------
    state_at
        Function from the time in s to lab_from_body_wxyz (4,), rate and acceleration (3,) in body axes
    """

    def __init__(
        self,
        vehicle: VehicleModel,
        state_at: Callable[[float], tuple[Floats, ...]],
        duration_s: float,
        history_s: float | None = None,
    ) -> None:
        self.state_at = state_at
        wxyz, rate, _ = state_at(0.0)
        super().__init__(vehicle, to_rotation(wxyz), rate, duration_s, history_s)

    def advance(self, control: Floats) -> None:
        """Advance one step for each row of control (K, nu); its values have no effect."""
        self.discard_old(len(control))
        # Only attitude and rate change.
        for _ in range(len(control)):
            self.states[self.row + 1] = self.states[self.row]
            self.step += 1
            self.lab_from_body_wxyz[:], self.rate_body_rad_s[:], _ = self.state_at(self.now_s)


def simulate(
    vehicle: VehicleModel,
    lab_from_body_start: Rotation,
    rate_body_rad_s: Floats,
    duration_s: float,
    controller: Controller | None = None,
    control_period_s: float = 0.01,
) -> Trajectory:
    """The motion of the vehicle under gravity, its tilt stop and a controller's ideal torques, sampled at every step.

    Parameters
    ----------
    lab_from_body_start
        Attitude at the start
    rate_body_rad_s
        (3,) rate at the start, in body axes
    controller
        (t_s, lab_from_body, rate_body_rad_s) to a torque (3,) in N m in body axes. It is called at the start and
        every control period; its torque, clipped to the limit, is held in between
    control_period_s
        Control period, rounded to whole steps

    Raises
    ------
    InputError
        For a start beyond the tilt stop, and if MuJoCo warned.
    """
    simulation = Simulation(vehicle, lab_from_body_start, rate_body_rad_s, duration_s)
    steps = (
        max(1, round(control_period_s / simulation.step_s))
        if controller
        else simulation.steps_left
    )
    # One controller call for each control period, or one step over the whole duration.
    limit = vehicle.config.torque_limit_nm
    while simulation.steps_left:
        control = np.zeros((min(steps, simulation.steps_left), vehicle.model.nu))
        if controller:
            attitude = to_rotation(simulation.lab_from_body_wxyz)
            torque = controller(simulation.now_s, attitude, simulation.rate_body_rad_s.copy())
            control[:, vehicle.torques] = np.clip(torque, -limit, limit)
        simulation.advance(control)
    return simulation.trajectory()


def tilt_deg(lab_from_body: Rotation) -> Floats:
    """Angle in degrees between the z axes of body and lab, of one attitude or of many."""
    return np.degrees(np.arccos(np.clip(lab_from_body.as_matrix()[..., 2, 2], -1, 1)))


def check_tilt(vehicle: VehicleModel, lab_from_body: Rotation) -> None:
    """Raise InputError for a start beyond the tilt stop."""
    tilt = float(tilt_deg(lab_from_body))
    if vehicle.config.mount == "air_bearing" and tilt > vehicle.config.tilt_stop_deg:
        raise InputError(
            "motion.start",
            f"tilt of {tilt:.1f} deg",
            f"up to vehicle.tilt_stop_deg {vehicle.config.tilt_stop_deg:g}",
        )
