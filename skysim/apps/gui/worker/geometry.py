"""3-D geometry of the laboratory, as numbers for the browser to draw."""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from skysim.apps.gui.messages import Lens, Pose, Triple
from skysim.core import quaternion
from skysim.core.errors import InputError
from skysim.core.types import (
    UP,
    Bools,
    Floats,
    Ints,
    Record,
    Sources,
    Trajectory,
    Truth,
    grid_points,
    lengths,
)
from skysim.dynamics import guidance, multibody
from skysim.dynamics.multibody.mjcf_export import FOVY_DEG, brightest
from skysim.results import scoring
from skysim.scene.scene import Scene
from skysim.scene.sections.light import CollimatedDisplayConfig
from skysim.scene.sections.motion import AttitudeConfig
from skysim.simulation.checks import attitudes
from skysim.simulation.lab import MARGIN_S, Lab, exposure_window
from skysim.sources import stars
from skysim.sources.dome import surface
from skysim.tracking.onboard_model import calibration

MAX_STARS = 600
MAX_LEDS = 4000
WIDE_DEG = 100.0  # field of the view from the bearing
NEARLY = (
    0.999  # fraction of the vehicle's greatest tilt that is within it in spite of rounding
)
AXIS = 0.35  # length of the axes, relative to the viewing distance of the laboratory
MOST_AXIS_M = 1.2
DIGITS = 5  # decimals of lengths in meters


def lab_geometry(lab: Lab) -> Record:
    """Geometry of a lab for space.js; meters in the lab frame unless stated otherwise.

    It has the shapes of the MJCF file that `skysim scenes export` writes, without the lights; the lights, stars on a
    sphere; the places to look from, by name; and the length of the drawn axes.
    """
    model = multibody.Laboratory(lab.export_mjcf())
    ids, place_m, radius_m, lit = lights(lab.camera.sources)
    return {
        "shapes": [
            shape._asdict() | {"vertices_m": shape.vertices_m.round(DIGITS)}
            for shape in model.shapes
        ],
        "lights": {
            "id": ids,
            "place": place_m.round(DIGITS).ravel(),
            "radius": radius_m.round(DIGITS),
            "lit": lit,
        },
        "views": views(lab, model),
        "axis": min(AXIS * math.dist(model.eye_m, model.target_m), MOST_AXIS_M),
    }


def lights(sources: Sources) -> tuple[Ints, Floats, Floats, Bools]:
    """Ids, (N, 3) positions and (N,) drawn radii in m of the brightest lights, brightest first, and which are lit.

    The radius of an LED grows with the time-averaged power to the power of 0.3, so that faint ones remain visible; that
    of a star grows with the square root of its light, as in the MJCF file.
    """
    stars, rows, fraction, position_m, radius_m = brightest(sources, MAX_STARS, MAX_LEDS)
    if not stars:
        radius_m *= np.clip(fraction**0.3, 0.3, 1.0)
    return sources.id[rows], position_m, radius_m, fraction > 0


def views(lab: Lab, model: multibody.Laboratory) -> dict[str, tuple[Any, ...]]:
    """The places to look from: outside, from the camera along its boresight, from the bearing up, and from above.

    Each is a place, a target and the direction up, in the lab frame, or in body axes if the place is on the vehicle;
    the vertical field of view, deg; and whether it is on the vehicle.
    """
    mount = lab.camera.mount
    body_from_cam = mount.body_from_cam
    pupil_m = mount.camera_body_m
    height_m = np.linalg.norm(model.eye_m - model.target_m)
    field_deg = lab.scene.camera.calibration().field_deg[1]
    north = np.array([0.0, 1.0, 0.0])
    ahead = body_from_cam.apply(UP)
    above = body_from_cam.apply([0.0, -1.0, 0.0])
    return {
        "outside": (model.eye_m, model.target_m, UP, FOVY_DEG, False),
        "camera": (pupil_m, pupil_m + ahead, above, field_deg, True),
        "bearing": (np.zeros(3), UP, north, WIDE_DEG, False),
        "top": (model.target_m + height_m * UP, model.target_m, north, FOVY_DEG, False),
    }


# Directions of a frame's pixels, for the browser.


NODES = 13  # points along each side of a frame, between which the browser interpolates


def lens_of(camera: Camera) -> Lens:
    """Tables of the tangents x / z and y / z of a camera's pixels, from the upper left to the lower right corner."""
    x = np.linspace(-0.5, camera.width_px - 0.5, NODES)
    y = np.linspace(-0.5, camera.height_px - 0.5, NODES)
    tangents = camera.tangents(grid_points(x, y))
    return Lens(NODES, *tangents.T.copy())


def scene_lens(lab: Lab) -> Lens:
    """The tables of a scene's true camera."""
    return lens_of(calibration(lab.scene.camera))


def scene_pose(lab: Lab, lens: Lens, truth: Truth) -> Pose:
    """The true attitude of a frame's camera; under a dome also where its rays meet the surface."""
    lab_from_cam = truth.cam_from_lab.inv()
    rotation = lab_from_cam.as_matrix().ravel()
    light = lab.scene.dome
    if light is None:
        return Pose(rotation)
    place_m = truth.lab_from_body.apply(lab.camera.mount.camera_body_m)
    rays_cam = np.column_stack([lens.x, lens.y, np.ones(len(lens.x))])
    length = lengths(rays_cam)
    dome = surface.build_surface(light.surface)
    points_m = dome.meet(place_m, lab_from_cam.apply(rays_cam / length[:, None]))
    # Depths along the boresight, to 0.01 mm; NaN where a ray meets nothing.
    depth_m = lengths(points_m - place_m) / length
    return Pose(rotation, place_m, depth_m.round(5))


# Camera pointing: from typed angles, or by rotations about the camera's own axes, which have no singularity.


# Step of an arrow key without and with shift, in fields of view.
FINE = 0.02
COARSE = 0.2
ROLL_FINE_DEG = 1.0
ROLL_COARSE_DEG = 10.0
RANGES = {  # degrees
    "RA": (0.0, 360.0),
    "Dec": (-90.0, 90.0),
    "roll": (-360.0, 360.0),
    "pitch": (-90.0, 90.0),
    "yaw": (-360.0, 360.0),
}


def from_angles(lab: Lab, angles_deg: Triple) -> Rotation:
    """lab_from_body from RA, Dec, roll of the camera under stars, else from roll, pitch, yaw of the vehicle; degrees.

    Raises
    ------
    InputError
        For an angle out of range, or a tilt beyond the vehicle's stop.
    """
    for name, angle in zip(scoring.angle_names(lab.scene), angles_deg, strict=True):
        low, high = RANGES[name]
        if not (math.isfinite(angle) and low <= angle <= high):
            raise InputError(name, f"{angle:g} deg is not allowed", f"{low:g} to {high:g}")
    if lab.scene.stars:
        return stars.cam_from_icrs(*angles_deg).inv() * lab.camera.mount.cam_from_body
    roll, pitch, yaw = angles_deg
    start = AttitudeConfig.model_validate(
        {"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw}
    )
    return within_stop(lab.scene, guidance.attitude(start))


def moved(
    lab: Lab, lab_from_body: Rotation, right: float, up: float, roll_deg: float
) -> Rotation:
    """lab_from_body after moving the boresight right and up (in fields of view) and rolling the camera clockwise.

    The three form one rotation vector about the camera's axes (x right, y down, z boresight). Raises InputError
    beyond the tilt stop.
    """
    cam_from_body = lab.camera.mount.cam_from_body
    field_deg = lab.scene.camera.calibration().field_deg[0]
    turn_deg = [up * field_deg, right * field_deg, roll_deg]
    new_from_cam = Rotation.from_rotvec(turn_deg, degrees=True).inv()
    cam_from_lab = new_from_cam * cam_from_body * lab_from_body.inv()
    return within_stop(lab.scene, cam_from_lab.inv() * cam_from_body)


def in_reach(lab: Lab) -> tuple[list[Triple], Floats]:
    """The angles of `checks.attitudes.within_reach` up to the vehicle's stop, and (N, 3) boresights in lab axes.

    They are those of `skysim check`; under the stars, all directions.
    """
    tilt_deg = NEARLY * lab.scene.vehicle.tilt_stop_deg
    found = attitudes.within_reach(attitudes.of_frames(lab), tilt_deg)
    cams_from_lab = lab.camera.mount.cam_from_body * found.lab_from_body.inv()
    angles_deg = [scoring.angles_deg(one, lab.camera) for one in cams_from_lab]
    return angles_deg, found.boresights


def within_stop(scene: Scene, lab_from_body: Rotation) -> Rotation:
    """Return the attitude. Raises InputError if its tilt is beyond the air bearing's stop."""
    vehicle = scene.vehicle
    tilt_deg = float(multibody.tilt_deg(lab_from_body))
    if vehicle.mount == "air_bearing" and tilt_deg > vehicle.tilt_stop_deg:
        raise InputError(
            "",
            f"tilt of {tilt_deg:.1f} deg: the bearing stops at {vehicle.tilt_stop_deg:g} deg",
        )
    return lab_from_body


# Pushing the vehicle: a user pulls at a point of it, and its dynamics are integrated in real time.


PULL_RAD_S = (
    1.5  # a held vehicle without gravity approaches the wanted place as exp(-PULL_RAD_S t)
)
PERIOD_S = 0.01  # time for which a torque is constant in body axes
MAX_ADVANCE_S = (
    0.25  # maximum step of one call; on a slow machine the motion is slower than real time
)


class Grip(NamedTuple):
    """The held point of the vehicle in body axes, and the wanted place of this point in the lab frame; m."""

    held_body_m: Triple
    wanted_m: Triple


class Push:
    """The motion of a lab's vehicle from rest at an attitude, under the pull of a user.

    Attributes
    ----------
    simulation
        Dynamics with gravity, drag, cable, tilt stop and the rotors' momentum, without
        disturbances and controller
    start_s, end_s
        Times between which frame 0 shows the motion
    lab_from_body
        The present attitude
    torque_nm
        (3,) torque of the grip in the last period, body axes
    """

    def __init__(self, lab: Lab, lab_from_body: Rotation) -> None:
        if isinstance(lab.scene.light, CollimatedDisplayConfig):
            raise InputError(
                "", "the camera of this scene is on a bench: there is no vehicle to push"
            )
        if lab.scene.motion.is_prescribed:
            raise InputError(
                "", "the motion of this scene is prescribed: its vehicle cannot be pushed"
            )
        self.lab = lab
        window = exposure_window(lab.scene, 0)
        self.start_s = window.open_s - MARGIN_S
        self.end_s = window.close_s + MARGIN_S
        kept_s = self.end_s - self.start_s + MAX_ADVANCE_S
        self.simulation = multibody.Simulation(
            lab.vehicle, lab_from_body, np.zeros(3), math.inf, kept_s
        )
        self.lab_from_body = lab_from_body
        self.torque_nm = np.zeros(3)

    def advance(self, grip: Grip | None, elapsed_s: float) -> None:
        """Integrate for a time with a torque that follows the vehicle; without a grip there is none."""
        simulation = self.simulation
        period = round(PERIOD_S / simulation.step_s)
        steps = round(min(elapsed_s, MAX_ADVANCE_S) / simulation.step_s)
        for begin in range(0, steps, period):
            self.torque_nm = pull_torque_nm(
                grip,
                self.lab_from_body,
                simulation.rate_body_rad_s,
                self.lab.vehicle.inertia_kg_m2,
            )
            control = np.zeros((min(period, steps - begin), simulation.model.nu))
            control[:, simulation.vehicle.torques] = self.torque_nm
            simulation.advance(control)
            self.lab_from_body = quaternion.to_rotation(simulation.lab_from_body_wxyz)

    def seen(self) -> Trajectory:
        """A trajectory whose frame 0 ends now; before the motion the vehicle is at rest."""
        shown_s = self.end_s - self.start_s
        begin = self.simulation.step - math.ceil(shown_s / self.simulation.step_s)
        motion = self.simulation.trajectory(max(begin, self.simulation.first_step))
        t_s = motion.t_s + self.end_s - self.simulation.now_s
        attitudes = motion.lab_from_body
        rates = motion.rate_body_rad_s
        if t_s[0] > self.start_s:
            t_s = np.append(self.start_s, t_s)
            rates = np.concatenate([np.zeros((1, 3)), rates])
            attitudes = Rotation.concatenate([attitudes[:1], attitudes])
        return Trajectory(t_s, attitudes, rates)


def pull_torque_nm(
    grip: Grip | None, lab_from_body: Rotation, rate_body_rad_s: Floats, inertia_kg_m2: Floats
) -> Floats:
    """(3,) torque about the bearing, in body axes, of a hand that leads the held point to the wanted one.

    With the held point r, the vector d from it to the wanted one and the rate w,

        T = J W^2 (r x d) / max(r^2, |r x d|) - 2 J W w.

    The first part is the torque of a force proportional to d, scaled so that vehicles of every size follow alike, and
    at most J W^2; the second damps the motion critically, as a hand does, so that the vehicle reaches the place without
    swinging about it. J is the mean moment of inertia, W is PULL_RAD_S. The bearing takes the force itself.
    """
    if grip is None:
        return np.zeros(3)
    held = np.array(grip.held_body_m)
    moment = np.cross(held, lab_from_body.inv().apply(grip.wanted_m) - held)
    moment /= max(held @ held, float(np.linalg.norm(moment)), 1e-9)
    inertia = np.trace(inertia_kg_m2) / 3
    return np.asarray(inertia * PULL_RAD_S * (PULL_RAD_S * moment - 2 * rate_body_rad_s))
