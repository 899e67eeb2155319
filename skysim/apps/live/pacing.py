"""A flight in real time. Every control period:

1. `CommandState.receive`: the clients' commands are taken; those of actuators are held until they time out.
2. The motion is simulated for one control period with them.
3. The clock is waited for; a period that ends late by a period or more is a missed deadline. A frame that ends in the
   first half of the period does not wait for its end, since no command changes the motion within it.
4. IMU samples, encoders, telemetry and truth are sent, as far as a client takes them.
5. Frames that are due are rendered, solved if a client takes the solutions, and sent. One that is late by a frame
   period or more before its rendering starts is dropped.

A flight whose motion a client simulates: a frame and its solution answer each command `pose`, samples at n times.

| key of `pose` | value |
|---|---|
| `t_s` | (n,) times since the scene's start; the exposure ends at the last one |
| `lab_from_body_xyzw` | (n, 4) attitudes, scalar last; under the stars the lab's axes are those of the ICRS |
| `rate_body_rad_s` | (n, 3) rates in body axes |
| `position_m`, `velocity_m_s` | (n, 3) from the Earth's center in axes of the ICRS, in scenes with an orbit |
"""

import gc
import threading
import time
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from skysim.apps.live.commands import CommandState, Inbox
from skysim.apps.live.packets import (
    PERIODIC,
    Output,
    Packet,
    frame_packet,
    plain,
    solution_packet,
    values_of,
)
from skysim.core.errors import InputError, refusing
from skysim.core.plugins import finite_array
from skysim.core.types import Floats, Record, Trajectory
from skysim.simulation.flight import Flight, Shot
from skysim.sources.orbit_elements import OemOrbit
from skysim.tracking.onboard_model import OrbitStarTracker


class Pace:
    """Maps scene time to wall-clock time: t_wall = zero_s + t_scene / speed. A speed of 0 disables pacing.

    The clock starts after the first rendering, so that compilation is not counted as delay. A frame that is late by a
    frame period or more before rendering starts is dropped.
    """

    def __init__(self, speed: float, rate_hz: float) -> None:
        self.speed = speed
        self.rate_hz = rate_hz
        self.zero_s: float | None = None  # monotonic time at which scene time is 0
        self.offset_s = time.time() - time.monotonic()  # from monotonic to Unix time

    def start(self, t_s: float) -> None:
        """Start the clock: scene time is t_s now."""
        self.zero_s = time.monotonic() - (t_s / self.speed if self.speed else 0.0)

    def due_s(self, t_s: float) -> float:
        """Monotonic time at which scene time is t_s; the present if the clock has not started or pacing is off."""
        if self.zero_s is None or not self.speed:
            return time.monotonic()
        return self.zero_s + t_s / self.speed

    def late_s(self, t_s: float) -> float:
        """Delay: wall-clock seconds since scene time t_s; negative if t_s is still to come."""
        return time.monotonic() - self.due_s(t_s)

    def is_on_time(self, _: int, t_s: float) -> bool:
        """Return True if a frame whose exposure ends at t_s is less than one frame period late, so worth rendering."""
        return self.late_s(t_s) * self.speed * self.rate_hz < 1

    def wait(self, t_s: float) -> None:
        time.sleep(max(-self.late_s(t_s), 0.0))


DELAY_WINDOW = 10_000  # newest delays from which the quantiles are computed
QUANTILES = {"median": 0.5, "p99": 0.99, "worst": 1.0}


@dataclass
class Live:
    """A flight that is paced to the clock, and its counters.

    Attributes
    ----------
    flight, pace, outputs
        Flight without history, its clock, and where the packets go
    commands
        Commands of clients
    inbox
        Where they arrive
    entered
        Set when the first client has begun
    has_truth
        Whether truth may be sent
    solves_itself
        Whether the filter takes the solutions of the scene's tracker, and not the clients'
    may_solve
        Whether a client may take solutions
    rendered
        Number of rendered frames
    periods, missed
        Numbers of control periods, and of those that ended late by a period or more
    late_ms
        Delays from the end of the exposure until the frame is ready, for the newest DELAY_WINDOW frames
    """

    flight: Flight
    pace: Pace
    outputs: list[Output]
    commands: CommandState
    inbox: Inbox = field(default_factory=Inbox)
    entered: threading.Event = field(default_factory=threading.Event)
    has_truth: bool = False
    solves_itself: bool = True
    may_solve: bool = False
    rendered: int = 0
    periods: int = 0
    missed: int = 0
    late_ms: deque[float] = field(default_factory=lambda: deque(maxlen=DELAY_WINDOW))

    @property
    def greeting(self) -> Record:
        """What a client receives first: the scene, control period, camera, and the actuators with their motors."""
        flight = self.flight
        scene = flight.lab.scene
        sets = flight.motion.flight_computer.actuator_sets
        return {
            "scene": scene.name,
            "period_s": flight.motion.flight_computer.period_s,
            "width": scene.camera.width_px,
            "height": scene.camera.height_px,
            "rate_hz": scene.exposure.rate_hz,
            "actuators": {
                key: {"motors": len(one.motor), "limit": one.limit}
                for key, one in sets.items()
            },
            "cam_from_body_xyzw": flight.lab.cameras[0]
            .mount.cam_from_body.as_quat()
            .tolist(),
        }

    def run(self) -> None:
        """Fly until the end, or until all outputs have failed."""
        self.warm_up()
        # A pass over all that a scene has loaded takes longer than a control period.
        gc.freeze()
        try:
            self.pace.start(0.0)
            while not self.flight.is_over and not self.is_abandoned:
                self.advance()
            self.send_frames(late=True)
        finally:
            gc.unfreeze()

    @property
    def is_abandoned(self) -> bool:
        """Whether all outputs have failed."""
        return bool(self.outputs) and all(output.fault for output in self.outputs)

    def warm_up(self) -> None:
        """Render a frame that no one gets, and solve it, which compiles what will run.

        An external tracker gets only the frames of the flight, in order.
        """
        shot = self.flight.observe(solves=False)
        if self.may_solve:
            self.flight.tracker_of(self.flight.schedules[0], shot.frame)

    @property
    def wanted(self) -> set[str]:
        """The channels that an output takes."""
        channels = {
            name for output in self.outputs if not output.fault for name in output.channels
        }
        return channels if self.has_truth else channels - {"truth"}

    def advance(self) -> None:
        """Simulate one control period, and send what it gave."""
        flight = self.flight
        # 1. and 2. Commands and motion.
        self.commands.receive(self.inbox)
        began_s = flight.now_s
        flight.motion.advance(flight.motion.period_steps, self.commands.in_force())
        # 3. A frame that ends in the first half of the period, and the clock.
        now_s = flight.now_s
        period_s = flight.motion.flight_computer.period_s
        main = flight.schedules[0]
        if not main.is_over and began_s < main.window.close_s < began_s + period_s / 2:
            self.pace.wait(main.window.close_s)
            self.send_frames()
        self.pace.wait(now_s)
        self.periods += 1
        self.missed += self.pace.late_s(now_s) * self.pace.speed >= period_s
        # 4. Values.
        wanted = self.wanted
        made_unix_s = time.monotonic() + self.pace.offset_s
        for channel in PERIODIC:
            values = values_of(channel, flight, began_s) if channel in wanted else {}
            if values:
                head = {"channel": channel, "t_s": now_s, "made_unix_s": made_unix_s}
                self.send(Packet(head | plain(values)))
        # 5. Frames.
        self.send_frames()

    def send_frames(self, late: bool = False) -> None:
        """Send the exposures of the main camera that are due; late ones are due only after the end.

        Frames that a filter or a client that triggers waits for are not dropped.
        """
        flight = self.flight
        updates = bool(flight.filter_schedules) and self.solves_itself
        all_come = updates or self.commands.has_triggers
        main = flight.schedules[0]
        for shot in flight.capture_due(
            flight.schedules if updates else [main],
            "solution" in self.wanted,
            None if all_come else self.pace.is_on_time,
            late,
            updates,
        ):
            if shot.camera is main.camera:
                self.send_shot(shot)

    def send_shot(self, shot: Shot) -> None:
        """Send a frame, and its solution."""
        pace = self.pace
        # With a rolling shutter, the end of the last row's exposure.
        due_s = pace.due_s(shot.window.close_s)
        now_s = time.monotonic()
        dropped = shot.frame.index - self.rendered
        self.rendered += 1
        self.late_ms.append(1e3 * (now_s - due_s))
        packet = frame_packet(shot, due_s + pace.offset_s, now_s + pace.offset_s, dropped)
        self.send(packet if self.has_truth else packet._replace(truth={}))
        if shot.report is not None:
            self.send(solution_packet(shot, time.monotonic() + pace.offset_s))

    def send(self, packet: Packet) -> None:
        """Offer a packet to each output that takes its channel."""
        for output in self.outputs:
            if packet.channel in output.channels:
                output.offer(packet, patient=not self.pace.speed)

    def statistics(self) -> Record:
        """Counts, delay statistics in ms, and the counters of each output."""
        late_ms = self.late_ms or [np.nan]
        commands = self.commands
        return {
            "made": self.rendered,
            "dropped": self.flight.schedules[0].index - self.rendered,
            **{
                f"late_ms_{name}": float(np.quantile(late_ms, part))
                for name, part in QUANTILES.items()
            },
            "periods": self.periods,
            "missed": self.missed,
            "commands": {
                "received": commands.received,
                "refused": commands.refused,
                "timeouts": commands.timeouts,
                "updates": dict(commands.updates),
            },
            "outputs": {output.name: output.counters() for output in self.outputs},
        }


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
    with refusing(ValueError, "pose"):
        values = {"t_s": finite_array(pose["t_s"], "t_s", (count,))}
        for key, (size, *_) in vectors.items():
            values[key] = finite_array(pose[key], key, (count, size))
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
    def greeting(self) -> Record:
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
