"""Pushing the vehicle: a user pulls at a point of it, and its multibody dynamics are integrated in real time."""

from __future__ import annotations

import math
from typing import NamedTuple
import numpy as np
from scipy.spatial.transform import Rotation
from skysim.core.errors import InputError
from skysim.core.types import Floats, Trajectory
from skysim.dynamics import multibody
from skysim.scene.scene import Scene
from skysim.scene.sections.light import CollimatedDisplayConfig
from skysim.simulation.lab import Lab
from skysim.simulation.timing import MARGIN_S, exposure_window



PULL_RAD_S = 1.5  # a held vehicle without gravity would swing at this angular frequency about where it is pulled to
PERIOD_S = 0.01  # for which a torque is held in body axes
MAX_ADVANCE_S = 0.25  # in one call; on a slow machine the motion is slower than real time


class Grip(NamedTuple):
    """Where the vehicle is held, in body axes, and where that point is pulled to, in the lab frame; m."""

    held_body_m: tuple[float, float, float]
    wanted_m: tuple[float, float, float]


class Push:
    """The motion of a lab's vehicle from rest at an attitude, as long as the user lets it go on.

    simulation    : with gravity, drag, cable, tilt stop and the rotors' momentum; without disturbances and controller
    lab_from_body : the present attitude
    torque_nm     : (3,) of the grip in the last period, body axes
    """

    def __init__(self, lab: Lab, lab_from_body: Rotation) -> None:
        require_vehicle(lab.scene)
        self.lab = lab
        kept_s = self.exposure_s + MAX_ADVANCE_S
        self.simulation = multibody.Simulation(
            lab.vehicle, lab_from_body, np.zeros(3), math.inf, kept_s
        )
        self.lab_from_body = lab_from_body
        self.torque_nm = np.zeros(3)

    @property
    def exposure_s(self) -> float:
        """How much of the motion a frame sees."""
        window = exposure_window(self.lab.scene, 0)
        return window.close_s(self.lab.scene.camera.height_px) - window.open_s + 2 * MARGIN_S

    def advance(self, grip: Grip | None, elapsed_s: float) -> None:
        """Integrate for a time with a torque that follows the vehicle; without a grip there is none."""
        simulation = self.simulation
        period = round(PERIOD_S / simulation.step_s)
        steps = round(min(elapsed_s, MAX_ADVANCE_S) / simulation.step_s)
        for begin in range(0, steps, period):
            lab_from_body = Rotation.from_quat(simulation.lab_from_body_wxyz, scalar_first=True)
            self.torque_nm = pull_torque_nm(grip, lab_from_body, self.lab.vehicle.inertia_kg_m2)
            control = np.zeros((min(period, steps - begin), simulation.model.nu))
            control[:, simulation.vehicle.torques] = self.torque_nm
            simulation.advance(control)
        self.lab_from_body = Rotation.from_quat(simulation.lab_from_body_wxyz, scalar_first=True)

    def seen(self) -> Trajectory:
        """A motion of which frame 0 sees what happened until now; before it the vehicle was at rest."""
        window = exposure_window(self.lab.scene, 0)
        end_s = window.close_s(self.lab.scene.camera.height_px) + MARGIN_S
        begin = self.simulation.step - math.ceil(self.exposure_s / self.simulation.step_s)
        motion = self.simulation.trajectory(max(begin, self.simulation.first_step))
        t_s = motion.t_s + end_s - self.simulation.now_s
        attitudes = motion.lab_from_body
        rates = motion.rate_body_rad_s
        start_s = window.open_s - MARGIN_S
        if t_s[0] > start_s:
            t_s = np.append(start_s, t_s)
            rates = np.concatenate([np.zeros((1, 3)), rates])
            attitudes = Rotation.concatenate([attitudes[:1], attitudes])
        return Trajectory(t_s, attitudes, rates)


def pull_torque_nm(grip: Grip | None, lab_from_body: Rotation, inertia_kg_m2: Floats) -> Floats:
    """(3,) torque about the bearing, in body axes, of a force towards the wanted point.

    With the held point r and the way d from it to the wanted one, T = J w^2 (r x d) / max(r^2, |r x d|): that of a
    force in proportion to d, scaled so that vehicles of every size follow alike, and not above J w^2. J is the mean
    moment of inertia, w is PULL_RAD_S. The force itself is the bearing's to bear.
    """
    if grip is None:
        return np.zeros(3)
    held = np.array(grip.held_body_m)
    moment = np.cross(held, lab_from_body.inv().apply(grip.wanted_m) - held)
    stiffness = np.trace(inertia_kg_m2) / 3 * PULL_RAD_S**2
    return np.asarray(stiffness * moment / max(held @ held, float(np.linalg.norm(moment)), 1e-9))


def require_vehicle(scene: Scene) -> None:
    """Raise InputError for a scene whose vehicle does not move by dynamics."""
    if isinstance(scene.light, CollimatedDisplayConfig):
        raise InputError("", "the camera of this scene is on a bench: there is no vehicle to push")
    if scene.motion.is_prescribed:
        raise InputError("", "the motion of this scene is prescribed: its vehicle cannot be pushed")


