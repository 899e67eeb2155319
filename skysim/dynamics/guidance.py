"""Guidance: the reference attitude over time from a scene's list of maneuvers, and its impulses.

`plan` makes the reference in three steps:

1. Start attitude and rate (`start_attitude`, `start_rate_rad_s`).
2. One leg for each maneuver, by the function in `LEGS`; each begins at the attitude at which the previous one ended.
3. A last leg without end, at the rate at which the list ended.

Guidance is independent of the simulator and the controller. Attitudes are unit quaternions `lab_from_ref_wxyz` (4,),
scalar first; rates and accelerations are (3,) in the reference's own axes.
"""

import bisect
import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core import quaternion
from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats, frozen
from skysim.dynamics.reference_curves import (
    AngleProfile,
    AttitudeSpline,
    integrate_knots,
    linear_sweep,
    log_sweep,
    rate_change_state,
    rest_to_rest,
    steady,
    still,
)
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import (
    SIDEREAL,
    AttitudeConfig,
    BumpConfig,
    ChirpConfig,
    MotionConfig,
    PointingConfig,
    ProfileConfig,
    RateConfig,
    SineConfig,
    SlewConfig,
    SpinUpConfig,
    StepConfig,
)
from skysim.sources.ephemeris import earth_rate_rad_s

State = tuple[Floats, Floats, Floats]  # lab_from_ref_wxyz, rate_rad_s, acceleration_rad_s2

# A change of rate is integrated in steps of at most KNOT_RAD, and in at least MIN_KNOTS steps: error 2e-10 rad, see
# `spin_up`.
KNOT_RAD = 0.01
MIN_KNOTS = 128
MAX_KNOTS = 5_000_000
SLEW_DEG_S = 2.0  # greatest rate of a slew without rate and duration
# Greatest jump of attitude and rate at the beginning of a profile.
MAX_JUMP_DEG = 0.1
MAX_JUMP_DEG_S = 0.1


def attitude(angles: AttitudeConfig) -> Rotation:
    """lab_from_body = Rz(yaw) Ry(pitch) Rx(roll) of 3-2-1 Euler angles (intrinsic ZYX) in degrees."""
    return Rotation.from_euler(
        "ZYX", [angles.yaw_deg, angles.pitch_deg, angles.roll_deg], degrees=True
    )


def start_attitude(motion: MotionConfig, profiles: Sequence[AttitudeSpline]) -> Rotation:
    """lab_from_body at the start; the identity for a pointing, since then the body's axes define the lab's."""
    if motion.start == "profile":
        return quaternion.to_rotation(profile_start(motion, profiles)[0])
    return (
        attitude(motion.start)
        if isinstance(motion.start, AttitudeConfig)
        else Rotation.identity()
    )


def start_rate_rad_s(motion: MotionConfig, profiles: Sequence[AttitudeSpline]) -> Floats:
    """(3,) rate at the start, in body axes, rad/s; 0 of `sidereal`, which has no controller to follow it."""
    if motion.start == "profile":
        return profile_start(motion, profiles)[1]
    return np.zeros(3) if motion.rate_deg_s == SIDEREAL else np.radians(motion.rate_deg_s)


def body_rate_rad_s(
    scene: Scene, lab_from_body: Rotation, profiles: Sequence[AttitudeSpline]
) -> Floats:
    """(3,) rate of a vehicle at this attitude at the start, in body axes; `sidereal` is that of the Earth."""
    if scene.motion.rate_deg_s == SIDEREAL:
        return lab_from_body.inv().apply(earth_rate_rad_s(scene.start_time))
    return start_rate_rad_s(scene.motion, profiles)


def profile_start(motion: MotionConfig, profiles: Sequence[AttitudeSpline]) -> State:
    """The state at the start of the first maneuver, which is a profile."""
    element = motion.maneuver[0]
    assert isinstance(element, ProfileConfig)
    return profiles[0].state_at(
        profiles[0].t_s[0] if element.begin == "first_sample" else 0.0
    )


@jit
def rotated_state(
    lab_from_start_wxyz: Floats,
    axis: Floats,
    angle_rad: float,
    rate_rad_s: float,
    acceleration_rad_s2: float,
    lab_from_ref_wxyz: Floats,
    rate: Floats,
    acceleration: Floats,
) -> None:
    """Set the state after a rotation by an angle about a fixed unit axis (3,), given in body axes.

    lab_from_ref = lab_from_start exp(angle axis),    rate = angle' axis,    acceleration = angle'' axis
    """
    wxyz = quaternion.multiply(lab_from_start_wxyz, quaternion.from_rotvec(angle_rad * axis))
    for n in range(4):
        lab_from_ref_wxyz[n] = wxyz[n]
    for n in range(3):
        rate[n] = rate_rad_s * axis[n]
        acceleration[n] = acceleration_rad_s2 * axis[n]


# Kinds of legs.


class Leg(NamedTuple):
    """A leg: its duration, and the function of its state at 0 <= t_s <= duration_s after its start."""

    duration_s: float
    state_at: Callable[[float], State]


@frozen
class ProfileLeg:
    """A profile of attitude samples, beginning at its time begin_s."""

    spline: AttitudeSpline
    begin_s: float
    duration_s: float

    def state_at(self, t_s: float) -> State:
        return self.spline.state_at(self.begin_s + t_s)


AnyLeg = Leg | ProfileLeg


def fixed_axis(
    lab_from_start_wxyz: Floats, axis: Floats, duration_s: float, profile: AngleProfile
) -> Leg:
    """A rotation about one fixed axis (3,) in body axes with a profile of its angle; zeros for no rotation."""

    def state_at(t_s: float) -> State:
        # An array that compiled code returns takes four times as long as one of NumPy's that it fills.
        state = np.empty(4), np.empty(3), np.empty(3)
        rotated_state(lab_from_start_wxyz, axis, *profile(t_s), *state)
        return state

    return Leg(duration_s, state_at)


class LegStart(NamedTuple):
    """The start of a leg.

    Attributes
    ----------
    lab_from_ref_wxyz
        (4,) attitude of the reference
    rate_rad_s
        (3,) rate of the reference, in its own axes
    lab_from_home
        Frame from which the Euler angles of maneuvers count
    begin_s
        Time since the start of the motion
    spline
        Spline of a profile; None for other maneuvers
    """

    lab_from_ref_wxyz: Floats
    rate_rad_s: Floats
    lab_from_home: Rotation
    begin_s: float = 0.0
    spline: AttitudeSpline | None = None


def length_and_direction(vector: Floats) -> tuple[float, Floats]:
    """The length and the (3,) unit direction of a vector; the direction of zeros is zeros."""
    length = float(np.linalg.norm(vector))
    return length, vector / length if length else np.zeros(3)


def hold(element: Any, start: LegStart) -> Leg:
    """Rest at the present attitude; a preceding rate drops to zero at once."""
    # A bump rests as well, until the end of its second impulse.
    caught_s = element.caught_after_s if isinstance(element, BumpConfig) else None
    return fixed_axis(
        start.lab_from_ref_wxyz, np.zeros(3), element.duration_s + (caught_s or 0.0), still
    )


def step(element: StepConfig, start: LegStart) -> Leg:
    """Jump to another attitude and rest there."""
    lab_from_there = quaternion.from_rotation(start.lab_from_home * attitude(element))
    return fixed_axis(lab_from_there, np.zeros(3), element.duration_s, still)


def slew(element: SlewConfig, start: LegStart) -> Leg:
    """The shortest eigen-axis rotation from rest to rest, as fast as the two limits allow, or in the duration.

    With the greatest acceleration a, a ramp to the rate v takes the time 1.5 v / a and the angle 0.75 v^2 / a. A
    rotation too short for two ramps peaks at v = sqrt(a angle / 1.5) and never cruises. Its duration is
    T = 1.5 v / a + angle / v, so v = 2 angle / (T + sqrt(T^2 - 6 angle / a)).

    Raises
    ------
    InputError
        For a duration shorter than sqrt(6 angle / a), that of a slew that never cruises.
    """
    # 1. Eigen-axis and angle of the rotation.
    lab_from_there = quaternion.from_rotation(start.lab_from_home * attitude(element))
    back_wxyz = quaternion.inverse(start.lab_from_ref_wxyz)
    angle, axis = length_and_direction(
        quaternion.to_rotvec(quaternion.multiply(back_wxyz, lab_from_there))
    )
    # The vehicle is there already.
    if angle < 1e-12:
        return fixed_axis(start.lab_from_ref_wxyz, np.zeros(3), 0.0, still)
    # 2. Peak rate, duration of a ramp, and duration of the whole: two ramps, and a cruise over the rest of the angle.
    accel = math.radians(element.acceleration_deg_s2)
    if element.duration_s is None:
        rate = min(
            math.radians(element.rate_deg_s or SLEW_DEG_S), math.sqrt(accel * angle / 1.5)
        )
    else:
        rate = slew_rate(angle, accel, element.duration_s)
    ramp = 1.5 * rate / accel
    duration_s = ramp + angle / rate
    return fixed_axis(
        start.lab_from_ref_wxyz,
        axis,
        duration_s,
        partial(rest_to_rest, angle, rate, ramp, duration_s),
    )


def slew_rate(angle_rad: float, acceleration_rad_s2: float, duration_s: float) -> float:
    """The greatest rate of a slew of this duration, rad/s, see `slew`."""
    spare_s2 = duration_s**2 - 6 * angle_rad / acceleration_rad_s2
    if spare_s2 < 0:
        raise InputError(
            "motion.maneuver",
            f"a slew of {math.degrees(angle_rad):.4g} deg in {duration_s:g} s needs an acceleration_deg_s2 of"
            f" {math.degrees(6 * angle_rad / duration_s**2):.3g}",
            f"{math.degrees(acceleration_rad_s2):.4g}, or a longer duration",
        )
    return 2 * angle_rad / (duration_s + math.sqrt(spare_s2))


def rate(element: RateConfig, start: LegStart) -> Leg:
    """A constant rate w from the start of the leg, where the rate jumps: attitude start exp(w t)."""
    size, axis = length_and_direction(np.radians(element.rate_deg_s))
    return fixed_axis(
        start.lab_from_ref_wxyz, axis, element.duration_s, partial(steady, size)
    )


def spin_up(element: SpinUpConfig, start: LegStart) -> Leg:
    """Change the present rate to another one, each component along a smoothstep; the axis may move.

    The rate is rate + change (3x^2 - 2x^3), x = t / duration. The attitude is integrated from knots at the beginnings
    of equal steps by Magnus' expansion. For a change that rotates by an angle a in n steps its error is proportional
    to a^3 / n^4: below 2e-10 rad for these knots.

    Raises
    ------
    InputError
        If more than MAX_KNOTS knots would be needed.
    """
    # The fastest rate is at one of the two ends, since the rate changes along a line.
    duration_s = element.duration_s
    start_rate = start.rate_rad_s
    change = np.radians(element.rate_deg_s) - start_rate
    fastest = max(
        float(np.linalg.norm(start_rate)), float(np.linalg.norm(start_rate + change))
    )
    # With a fixed axis one step of Magnus' expansion is exact.
    axis_moves = np.linalg.norm(np.cross(start_rate, change)) > 1e-12 * fastest**2
    count = max(MIN_KNOTS, math.ceil(fastest * duration_s / KNOT_RAD)) if axis_moves else 1
    if count > MAX_KNOTS:
        raise InputError(
            "motion.maneuver",
            f"a spin_up of {duration_s:g} s at up to {math.degrees(fastest):g} deg/s whose axis moves"
            f" rotates by {math.degrees(fastest * duration_s):.3g} deg",
            f"{math.degrees(MAX_KNOTS * KNOT_RAD):.3g} deg",
        )
    knots_wxyz = integrate_knots(
        start.lab_from_ref_wxyz, count, duration_s, start_rate, change
    )
    state_at = partial(rate_change_state, knots_wxyz, duration_s, start_rate, change)
    return Leg(duration_s, state_at)


def sine(element: SineConfig, start: LegStart) -> Leg:
    """Oscillate about the attitude: rotation vector amplitude envelope(t) sin(2 pi f t) in body axes.

    The three axes have the same phase, so the axis of rotation is fixed. The envelope rises and falls within a
    period each, or within half of the duration if that is shorter.
    """
    duration_s = element.duration_s
    # A sine is a sweep whose frequency does not change.
    omega = 2 * math.pi * element.frequency_hz
    growth_s = min(1 / element.frequency_hz, duration_s / 2)
    size, axis = length_and_direction(np.radians(element.amplitude_deg))
    profile = partial(linear_sweep, size, omega, 0.0, duration_s, growth_s, growth_s)
    return fixed_axis(start.lab_from_ref_wxyz, axis, duration_s, profile)


def chirp(element: ChirpConfig, start: LegStart) -> Leg:
    """Oscillate about the attitude as `sine` does, while the frequency sweeps from f0 to f1 within the duration T.

        linear: f = f0 + (f1 - f0) t / T
        log:    f = f0 (f1 / f0)^(t / T)

    The envelope rises within a period of f0 and falls within a period of f1.
    """
    duration_s = element.duration_s
    omega = 2 * math.pi * element.from_hz
    size, axis = length_and_direction(np.radians(element.amplitude_deg))
    # The change of angular frequency: k = ln(f1 / f0) / T in exp(k t), or a rate in rad/s2.
    if element.sweep == "log":
        sweep = log_sweep
        change = math.log(element.to_hz / element.from_hz) / duration_s
    else:
        sweep = linear_sweep
        change = 2 * math.pi * (element.to_hz - element.from_hz) / duration_s
    profile = partial(
        sweep, size, omega, change, duration_s, 1 / element.from_hz, 1 / element.to_hz
    )
    return fixed_axis(start.lab_from_ref_wxyz, axis, duration_s, profile)


def profile(element: ProfileConfig, start: LegStart) -> ProfileLeg:
    """Follow the attitudes of a file or table.

    If the maneuver begins before the first sample, the first cubic is continued backwards by one step at most.

    Raises
    ------
    InputError
        If the samples are at other times, or if attitude or rate would jump.
    """
    spline = start.spline
    assert spline is not None
    # 1. The time of the profile at which the maneuver begins.
    first_s = float(spline.t_s[0])
    last_s = float(spline.t_s[-1])
    begin_s = first_s if element.begin == "first_sample" else start.begin_s * spline.absolute
    step_s = float(spline.t_s[1]) - first_s
    if first_s - begin_s > step_s + 1e-9 or last_s <= begin_s:
        raise InputError(
            "motion.maneuver",
            f"{spline.source}: attitudes from {first_s - begin_s:.6g} s to {last_s - begin_s:.6g} s after the"
            " maneuver's beginning",
            f"from {step_s:.3g} s (a step) at most, to a time after it; or begin: first_sample",
        )
    # 2. The jump from the end of the previous maneuver.
    lab_from_ref, rate_rad_s, _ = spline.state_at(begin_s)
    jump = quaternion.multiply(quaternion.inverse(start.lab_from_ref_wxyz), lab_from_ref)
    jump_deg = math.degrees(float(np.linalg.norm(quaternion.to_rotvec(jump))))
    jump_deg_s = math.degrees(float(np.linalg.norm(rate_rad_s - start.rate_rad_s)))
    if jump_deg > MAX_JUMP_DEG or jump_deg_s > MAX_JUMP_DEG_S:
        raise InputError(
            "motion.maneuver",
            f"{spline.source}: begins {jump_deg:.3g} deg and {jump_deg_s:.3g} deg/s away from the motion before it",
            f"{MAX_JUMP_DEG:g} deg and {MAX_JUMP_DEG_S:g} deg/s, or motion.start: profile",
        )
    return ProfileLeg(spline, begin_s, last_s - begin_s)


# The leg of each kind of maneuver. To add a kind, add a class to scene/sections/motion.py and a function here.
LEGS: dict[str, Callable[[Any, LegStart], AnyLeg]] = {
    "hold": hold,
    "step": step,
    "slew": slew,
    "rate": rate,
    "spin_up": spin_up,
    "sine": sine,
    "chirp": chirp,
    "profile": profile,
    "jitter": hold,
    "bump": hold,
}


@frozen
class Reference:
    """The commanded attitude over time: a sequence of legs, the last of which has no end.

    Attributes
    ----------
    legs
        Legs in order of time
    start_s
        Start time of each leg, ascending from 0
    """

    legs: tuple[AnyLeg, ...]
    start_s: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        """Duration of the list of maneuvers."""
        return self.start_s[-1]

    def state_at(self, t_s: float) -> State:
        """lab_from_ref_wxyz (4,), rate (rad/s) and acceleration (rad/s2), each (3,) in the reference's own axes.

        The state at the time where two legs meet is that of the later one. Before 0 the state is that at 0.
        """
        # The last leg that starts at or before t_s.
        k = max(bisect.bisect_right(self.start_s, t_s) - 1, 0)
        leg = self.legs[k]
        return leg.state_at(min(max(t_s - self.start_s[k], 0.0), leg.duration_s))

    def attitudes(self, t_s: Floats) -> Rotation:
        """lab_from_ref at (N,) times."""
        return Rotation.from_quat(
            np.array([self.state_at(float(t))[0] for t in t_s]).reshape(-1, 4),
            scalar_first=True,
        )


def plan(
    motion: MotionConfig,
    lab_from_start: Rotation | None = None,
    profiles: Sequence[AttitudeSpline] = (),
) -> Reference:
    """The reference of the list of maneuvers.

    Attitude: each maneuver begins where the previous one ended; only a step jumps. The Euler angles of steps and
    slews are those of the body in the lab. If the start is a pointing they are relative to the attitude at the
    start, whatever axes lab_from_start is in.

    Rate: a maneuver ends at rest, except a rate, a spin_up or a profile. A spin_up begins at the rate at which the
    previous maneuver ended; a first one begins at motion.rate_deg_s. The rate jumps at the start of a rate, and
    between a rate, spin_up or profile and any following maneuver other than a spin_up or profile.

    After the list the reference continues at the rate at which it ended.

    Parameters
    ----------
    motion
        The scene's section `motion`
    lab_from_start
        lab_from_body at the start; None for motion.start, or for the identity if that is a pointing
    profiles
        Splines of the maneuvers of kind profile, in their order (`profiles.load_profiles`)
    """
    # 1. Start.
    first = lab_from_start if lab_from_start is not None else start_attitude(motion, profiles)
    home = first if isinstance(motion.start, PointingConfig) else Rotation.identity()
    leg_start = LegStart(
        quaternion.from_rotation(first), start_rate_rad_s(motion, profiles), home
    )
    # 2. One leg for each maneuver.
    legs = []
    splines = iter(profiles)
    for element in motion.maneuver:
        spline = next(splines) if element.kind == "profile" else None
        legs.append(LEGS[element.kind](element, leg_start._replace(spline=spline)))
        # The next leg begins with the state at the end of this one.
        lab_from_ref_wxyz, rate_rad_s, _ = legs[-1].state_at(legs[-1].duration_s)
        leg_start = LegStart(
            lab_from_ref_wxyz, rate_rad_s, home, leg_start.begin_s + legs[-1].duration_s
        )
    # 3. The last leg; an empty list rests.
    size, axis = length_and_direction(leg_start.rate_rad_s if legs else np.zeros(3))
    final_leg = fixed_axis(leg_start.lab_from_ref_wxyz, axis, math.inf, partial(steady, size))
    start_times_s = itertools.accumulate((leg.duration_s for leg in legs), initial=0.0)
    return Reference((*legs, final_leg), tuple(start_times_s))


# Impulses of the list.


@frozen
class Impulse:
    """A half-sine of torque that alone would change the vehicle's rate by rate_rad_s, (3,) in body axes.

    The integral of the torque is J rate_rad_s.
    """

    begin_s: float
    duration_s: float
    rate_rad_s: Floats

    def fraction(self, from_s: Any, to_s: Any) -> Any:
        """Fraction of the impulse between two times, or (N,) between pairs: (cos(pi a) - cos(pi b)) / 2."""
        # a and b are the times in durations, limited to the impulse.
        a, b = (
            np.clip((t_s - self.begin_s) / self.duration_s, 0, 1) for t_s in (from_s, to_s)
        )
        return (np.cos(np.pi * a) - np.cos(np.pi * b)) / 2


def impulses(motion: MotionConfig, reference: Reference) -> tuple[Impulse, ...]:
    """The impulses of the bumps in order of time; a caught bump has two, equal and opposite."""
    result = []
    for begin_s, bump in zip(reference.start_s, motion.maneuver, strict=False):
        if isinstance(bump, BumpConfig):
            rate_rad_s = np.radians(bump.rate_deg_s)
            result.append(Impulse(begin_s, bump.duration_s, rate_rad_s))
            # Catching the vehicle is the opposite impulse.
            if bump.caught_after_s is not None:
                result.append(
                    Impulse(begin_s + bump.caught_after_s, bump.duration_s, -rate_rad_s)
                )
    return tuple(result)
