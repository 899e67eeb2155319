"""A flight whose motion a client simulates: a frame and its solution answer each command `pose`, samples at n times.

| key of `pose` | value |
|---|---|
| `t_s` | (n,) times since the scene's start; the exposure ends at the last one |
| `lab_from_body_xyzw` | (n, 4) attitudes, scalar last; under the stars the lab's axes are those of the ICRS |
| `rate_body_rad_s` | (n, 3) rates in body axes |
| `position_m`, `velocity_m_s` | (n, 3) from the Earth's center in axes of the ICRS, in scenes with an orbit |
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from skysim.apps.live.pacing import Live
from skysim.core.errors import InputError
from skysim.core.plugins import finite_array
from skysim.core.types import Floats, Trajectory
from skysim.simulation.flight import Shot
from skysim.sources.orbit_elements import OemOrbit
from skysim.tracking.onboard_model import OrbitStarTracker

MOST_SAMPLES = 150  # what a line of the wire holds
LATEST_S = 1e7  # since the scene's start
STEP_S = (1e-6, 1.0)  # between two samples
ROUNDING = 1e-9
POLL_S = 1e-3  # between looks at what has arrived

# Number of components, and limits of a vector's length.
MOTION = {"lab_from_body_xyzw": (4, 0.999, 1.001), "rate_body_rad_s": (3, 0.0, 10.0)}
PLACE = {"position_m": (3, 6.36e6, 1e9), "velocity_m_s": (3, 0.0, 1e5)}


def pose_samples(pose: Any, in_orbit: bool) -> dict[str, Floats]:
    """The samples of a pose by key, checked. Raises InputError."""
    vectors = MOTION | (PLACE if in_orbit else {})
    keys = ("t_s", *vectors)
    if not isinstance(pose, dict) or set(pose) != set(keys):
        raise InputError("pose", f"{pose!r:.60}", ", ".join(keys))
    count = len(pose["t_s"]) if isinstance(pose["t_s"], list) else 0
    require_within("number of samples", count, 2, MOST_SAMPLES)
    try:
        values = {"t_s": finite_array(pose["t_s"], "t_s", (count,))}
        for key, (size, *_) in vectors.items():
            values[key] = finite_array(pose[key], key, (count, size))
    except ValueError as error:
        raise InputError("pose", error) from None
    require_within("t_s", values["t_s"], 0.0, LATEST_S)
    require_within("step of t_s", np.diff(values["t_s"]), *STEP_S)
    for key, (_, *limits) in vectors.items():
        # Without overflow.
        require_within(f"length of {key}", np.hypot.reduce(values[key], axis=1), *limits)
    return values


def require_within(name: str, values: Floats | float, least: float, most: float) -> None:
    """Raise InputError for values (n,) of a pose beyond these limits."""
    outside = np.maximum(least - values, values - most) > ROUNDING
    if np.any(outside):
        first = np.extract(outside, values)[0]
        raise InputError("pose", f"{name} {first:.9g}", f"{least:.9g} to {most:.9g}")


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
        window = self.flight.schedules[0].window_to(0.0)
        return super().greeting | {"exposure_s": -window.open_s}

    def run(self) -> None:
        """Answer poses until the last frame, or until all outputs have failed."""
        self.warm_up()
        self.pace.start(0.0)
        while not self.flight.schedules[0].is_over and not self.is_abandoned:
            for command, reply in self.inbox.take():
                try:
                    if set(command) != {"pose"}:
                        raise InputError("", f"no commands {list(command)!r:.60}", "pose")
                    self.send_shot(self.expose(command["pose"]))
                    self.commands.received += 1
                except InputError as error:
                    self.commands.refused += 1
                    reply(str(error))
            time.sleep(POLL_S)

    def expose(self, pose: Any) -> Shot:
        """Render an exposure that ends at the last sample, and solve it if a client takes the solutions.

        1. Check the samples: they cover the exposure, which begins after the last one.
        2. The camera is where the client says; its tracker knows the velocity as it knows that of the scene's orbit.
        3. Render and solve.

        Raises
        ------
        InputError
            For a pose that cannot be taken; then nothing is exposed.
        """
        # 1. Window.
        schedule = self.flight.schedules[0]
        in_orbit = schedule.camera.orbit is not None
        values = pose_samples(pose, in_orbit)
        t_s = values["t_s"]
        close_s = float(t_s[-1])
        window = schedule.window_to(close_s)
        begin_s = max(self.closed_s, t_s[0])
        require_within("exposure's start", window.open_s, begin_s, LATEST_S)
        # 2. Place.
        if in_orbit:
            states = np.stack([values[key] for key in PLACE], axis=1)
            # Rounding may place the exposure's end beyond the samples.
            always = np.array([-np.inf, np.inf])
            orbit = OemOrbit("pose", always, BPoly.from_derivatives(t_s, states))
            schedule.camera = replace(schedule.camera, orbit=orbit)
            tracker = self.flight.trackers.get(0)
            if isinstance(tracker, OrbitStarTracker):
                tracker.orbit = orbit
        # 3. Frame and solution.
        shot = self.flight.capture(
            schedule,
            schedule.index,
            window,
            "solution" in self.wanted,
            updates_filter=False,
            given=Trajectory(
                t_s,
                Rotation.from_quat(values["lab_from_body_xyzw"]),
                values["rate_body_rad_s"],
            ),
        )
        schedule.index += 1
        schedule.exposure_control.update(shot.frame)
        self.closed_s = close_s
        return shot
