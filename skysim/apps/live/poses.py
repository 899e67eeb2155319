"""A flight whose motion a client simulates: the command `pose` gives samples, a frame and its solution answer it.

| key of `pose` | value at each of n times |
|---|---|
| `t_s` | (n,) time since the scene's start; the exposure ends at the last one |
| `lab_from_body_xyzw` | (n, 4) attitude, scalar last; under the stars the lab's axes are those of the ICRS |
| `rate_body_rad_s` | (n, 3) rate in body axes |
| `position_m`, `velocity_m_s` | (n, 3) from the Earth's center in axes of the ICRS, in scenes with an orbit |
"""

import queue
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from estimator.trackers.pipeline import Clock
from skysim.apps.live.commands import QUATERNION_TOLERANCE
from skysim.apps.live.pacing import Live
from skysim.camera.render import Window
from skysim.core.errors import InputError
from skysim.core.plugins import finite_array
from skysim.core.types import Floats, Trajectory
from skysim.simulation.exposure import render_frame
from skysim.simulation.flight import Shot
from skysim.simulation.timing import window_from
from skysim.sources.orbit_elements import OemOrbit
from skysim.tracking import factory
from skysim.tracking.onboard_model import OrbitStarTracker

MOST_SAMPLES = 150  # what a line of the wire holds
LATEST_S = 1e7  # since the scene's start
STEP_S = (1e-6, 1.0)  # between two samples
ROUNDING_S = 1e-9
POLL_S = 0.2  # time in which a flight whose outputs have failed ends

# Number of components, and limits of a vector's length.
MOTION = {
    "lab_from_body_xyzw": (4, 1 - QUATERNION_TOLERANCE, 1 + QUATERNION_TOLERANCE),
    "rate_body_rad_s": (3, 0.0, 10.0),
}
PLACE = {"position_m": (3, 6.36e6, 1e9), "velocity_m_s": (3, 0.0, 1e5)}


def pose_samples(pose: Any, in_orbit: bool) -> dict[str, Floats]:
    """The samples of a pose by key, checked. Raises InputError."""
    vectors = MOTION | (PLACE if in_orbit else {})
    keys = ("t_s", *vectors)
    if not isinstance(pose, dict) or set(pose) != set(keys):
        found = list(pose) if isinstance(pose, dict) else pose
        raise InputError("pose", repr(found)[:80], ", ".join(keys))
    count = len(pose["t_s"]) if isinstance(pose["t_s"], list) else 0
    if not 2 <= count <= MOST_SAMPLES:
        raise InputError("pose", f"t_s has {count} samples", f"2 to {MOST_SAMPLES}")
    try:
        values = {"t_s": finite_array(pose["t_s"], "t_s", (count,))}
        for key, (size, _, _) in vectors.items():
            values[key] = finite_array(pose[key], key, (count, size))
    except ValueError as error:
        raise InputError("pose", error) from None
    t_s = values["t_s"]
    require_within("t_s", t_s, 0.0, LATEST_S)
    require_within("step of t_s", np.diff(t_s), *STEP_S)
    for key, (_, least, most) in vectors.items():
        with np.errstate(over="ignore"):
            length = np.linalg.norm(values[key], axis=1)
        require_within(f"length of {key}", length, least, most)
    return values


def require_within(name: str, values: Floats, least: float, most: float) -> None:
    """Raise InputError for values (n,) of a pose beyond these limits."""
    beyond = values[(values < least) | (values > most)]
    if len(beyond):
        raise InputError("pose", f"{name} {beyond[0]:.9g}", f"{least:g} to {most:g}")


@dataclass
class PosedLive(Live):
    """A flight without a clock, whose frames are exposed when a client gives a pose.

    Attributes
    ----------
    closed_s
        End of the last exposure
    """

    closed_s: float = 0.0

    @property
    def greeting(self) -> dict[str, Any]:
        """As that of a live flight, with the time that the samples of a pose have to cover."""
        window = self.window(0.0)
        return super().greeting | {"exposure_s": -window.open_s}

    def window(self, close_s: float) -> Window:
        """Window of an exposure whose last row ends at a time."""
        schedule = self.flight.schedules[0]
        scene = schedule.camera.scene
        window = window_from(scene, 0.0, schedule.exposure_control.exposure_s)
        return window._replace(open_s=close_s - window.close_s(scene.camera.height_px))

    def run(self) -> None:
        """Answer poses until the last frame, or until all outputs have failed."""
        self.warm_up()
        while not self.flight.schedules[0].is_over and not self.is_abandoned:
            try:
                command, reply = self.inbox.waiting.get(timeout=POLL_S)
            except queue.Empty:
                continue
            try:
                self.answer(command)
                self.commands.received += 1
            except InputError as error:
                self.commands.refused += 1
                reply(str(error))

    def answer(self, command: dict[str, Any]) -> None:
        """Carry out a command: an exposure time, a pose. Raises InputError."""
        unknown = [key for key in command if key not in ("pose", "exposure_s")]
        if unknown:
            raise InputError(
                repr(unknown[0])[:40], "the client gives the motion", "pose, exposure_s"
            )
        exposure_s = self.commands.exposure_s(command.get("exposure_s"))
        control = self.flight.schedules[0].exposure_control
        before_s = control.exposure_s
        control.exposure_s = exposure_s or before_s
        if "pose" in command:
            try:
                shot = self.expose(command["pose"])
            except InputError:
                # A refused line changes nothing.
                control.exposure_s = before_s
                raise
            self.send_shot(shot)

    def expose(self, pose: Any) -> Shot:
        """Render an exposure that ends at the last sample, and solve it if a client takes the solutions.

        1. Check the samples and the exposure's window: it lies within them, after the last one.
        2. The camera is where the client says; its tracker knows the velocity as it knows that of the scene's orbit.
        3. Render and solve.

        Raises
        ------
        InputError
            For a pose that cannot be taken; then nothing is exposed.
        """
        # 1. Window.
        flight = self.flight
        schedule = flight.schedules[0]
        camera = schedule.camera
        values = pose_samples(pose, camera.orbit is not None)
        t_s = values["t_s"]
        close_s = float(t_s[-1])
        window = self.window(close_s)
        if t_s[0] > window.open_s + ROUNDING_S:
            raise InputError(
                "pose",
                f"samples from {t_s[0]:.9g} s",
                f"from {window.open_s:.9g} s or before",
            )
        if window.open_s < self.closed_s - ROUNDING_S:
            raise InputError(
                "pose",
                f"the exposure opens at {window.open_s:.9g} s",
                f"{self.closed_s:.9g} s, the end of the last one, or later",
            )
        # 2. Motion and place.
        trajectory = Trajectory(
            t_s,
            Rotation.from_quat(values["lab_from_body_xyzw"]),
            values["rate_body_rad_s"],
        )
        orbit = None
        if camera.orbit is not None:
            states = np.stack([values[key] for key in PLACE], axis=1)
            path = BPoly.from_derivatives(t_s, states)
            # Rounding may place the exposure's ends beyond the samples.
            orbit = OemOrbit("pose", np.array([-np.inf, np.inf]), path)
            camera = replace(camera, orbit=orbit)
        # 3. Frame and solution.
        clock = Clock()
        index = schedule.index
        frame, truth = render_frame(camera, trajectory, index, clock, window)
        report = None
        if "solution" in self.wanted:
            tracker = flight.tracker_of(schedule, frame)
            if orbit and isinstance(tracker, OrbitStarTracker):
                tracker.orbit = orbit
            report = factory.solve_frame(tracker, frame)
        schedule.index += 1
        schedule.exposure_control.update(frame)
        self.closed_s = close_s
        return Shot(camera, window, frame, truth, report, None, "", clock.seconds)
