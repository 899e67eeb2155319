"""The reference follows the law of each element, is continuous where required, and applies knocks."""

from __future__ import annotations

import itertools
import math
import timeit

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.dynamics.guidance import (
    LEGS,
    Impulse,
    Reference,
    attitude,
    impulses,
    plan,
)
from skysim.dynamics.jitter import Vibration
from skysim.dynamics.reference_curves import envelope
from skysim.scene.sections.motion import AttitudeConfig, MotionConfig, SlewConfig, StepConfig

HOLD = {"kind": "hold", "duration": "2 s"}
LIMITS = {"rate_deg_s": 2.0, "acceleration_deg_s2": 0.5}
START = {"roll_deg": 3, "pitch_deg": -4, "yaw_deg": 170}
STEP = {"kind": "step", "roll_deg": 5, "pitch_deg": -9, "yaw_deg": 30, "duration": "1.5 s"}
RATE = {"kind": "rate", "rate_deg_s": [3, -5, 20], "duration": "4 s"}
SPIN = {"kind": "spin_up", "rate_deg_s": [-10, 4, 30], "duration": "3 s"}
SINE = {"kind": "sine", "amplitude_deg": [4, -2, 1], "frequency_hz": 0.7, "duration": "5 s"}
CHIRP = {
    "kind": "chirp",
    "amplitude_deg": [2, -1, 3],
    "from_hz": 0.5,
    "to_hz": 3.0,
    "duration": "8 s",
}
SHAKE = {
    "kind": "jitter",
    "duration": "3 s",
    "components": [{"kind": "line", "frequency_hz": 30, "rms_arcsec": [9, 9, 9]}],
}
BUMP = {"kind": "bump", "rate_deg_s": [30, -60, 10], "duration": "50 ms"}


def turn_to(roll: float, pitch: float, yaw: float, **limits: float) -> dict[str, object]:
    return (
        {"kind": "slew", "roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw}
        | LIMITS
        | limits
    )


def motion_config(*maneuver: object, **motion: object) -> MotionConfig:
    return MotionConfig.model_validate(
        {"control": "pid", "maneuver": maneuver, "start": START} | motion
    )


def reference(*maneuver: object, **motion: object) -> Reference:
    return plan(motion_config(*maneuver, **motion))


EVERY = {
    "hold": (HOLD,),
    "step": (STEP,),
    "slew": (turn_to(12, -6, -160),),
    "short slew": (turn_to(3, -4, 176),),
    "rate": (RATE,),
    "spin_up": (SPIN,),
    "spin_up of a moving axis": (RATE, SPIN),
    "spin_up out of spin_up": (SPIN, SPIN | {"rate_deg_s": [50, 0, -40]}),
    "sine": (SINE,),
    "short sine": (SINE | {"duration": "2 s"},),
    "chirp": (CHIRP,),
    "falling chirp": (CHIRP | {"from_hz": 3.0, "to_hz": 0.5},),
    "log chirp": (CHIRP | {"sweep": "log"},),
    "jitter": (SHAKE,),
    "bump": (BUMP | {"duration": "1 s"},),
}


@pytest.fixture
def tour() -> Reference:
    """Long slews with a cruise phase, one too short for it, and holds between them."""
    return reference(
        HOLD, turn_to(12, -6, -160), turn_to(-8, 14, 80), HOLD, turn_to(-2, 14, 80)
    )


def sampled(ref: Reference, t_s: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray]:
    _, rates, accelerations = zip(*(ref.state_at(t) for t in t_s), strict=True)
    return ref.attitudes(t_s), np.array(rates), np.array(accelerations)


def euler(roll: float, pitch: float, yaw: float) -> Rotation:
    return attitude(
        AttitudeConfig.model_validate({"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw})
    )


def between(a: Rotation, b: Rotation) -> np.ndarray:
    """Angles (rad) by the rotation vector; `magnitude` of small rotations is accurate only to 1e-8."""
    return np.linalg.norm((a.inv() * b).as_rotvec(), axis=-1)


def there(ref: Reference, t_s: float) -> Rotation:
    return ref.attitudes(np.array([t_s]))[0]


# The laws, element by element


def test_euler_angles_are_yaw_then_pitch_then_roll() -> None:
    """Rz(yaw) Ry(pitch) Rx(roll) written out by hand."""
    roll = 0.3
    pitch = -0.5
    yaw = 1.1
    about_x = [
        [1, 0, 0],
        [0, math.cos(roll), -math.sin(roll)],
        [0, math.sin(roll), math.cos(roll)],
    ]
    about_y = [
        [math.cos(pitch), 0, math.sin(pitch)],
        [0, 1, 0],
        [-math.sin(pitch), 0, math.cos(pitch)],
    ]
    about_z = [
        [math.cos(yaw), -math.sin(yaw), 0],
        [math.sin(yaw), math.cos(yaw), 0],
        [0, 0, 1],
    ]
    angles = dict(
        zip(("roll_deg", "pitch_deg", "yaw_deg"), np.degrees([roll, pitch, yaw]), strict=True)
    )
    expected = np.array(about_z) @ about_y @ about_x
    slew = SlewConfig.model_validate(angles | {"kind": "slew"})
    step = StepConfig.model_validate(angles | {"kind": "step", "duration": "1 s"})
    for given in (AttitudeConfig.model_validate(angles), slew, step):
        np.testing.assert_allclose(attitude(given).as_matrix(), expected, rtol=0, atol=1e-15)


@pytest.mark.compiles
@pytest.mark.parametrize("name", EVERY)
def test_rate_and_acceleration_are_the_derivatives_of_the_attitude(name: str) -> None:
    """Five-point differences at random times within the last element: off by 1e-15 / h, that is 1e-11, by rounding.

    Where a law's third derivative jumps (the end of a ramp) the difference would be off by h times the jump; such
    moments are 4 h wide, and this seed draws none of them.
    """
    ref = reference(*EVERY[name])
    h = 1e-4
    begin, end = ref.start_s[-2:]
    t = np.random.default_rng(1).uniform(begin + 3 * h, end - 3 * h, 200)
    here, rate, acceleration = sampled(ref, t)
    weights = {-2: 1 / 12, -1: -8 / 12, 1: 8 / 12, 2: -1 / 12}
    shifted = {k: sampled(ref, t + k * h) for k in weights}
    turned = sum(w * (here.inv() * shifted[k][0]).as_rotvec() for k, w in weights.items()) / h
    np.testing.assert_allclose(turned, rate, rtol=0, atol=1e-9)
    quicker = sum(w * shifted[k][1] for k, w in weights.items()) / h
    np.testing.assert_allclose(quicker, acceleration, rtol=0, atol=1e-9)


def test_reference_visits_every_attitude_of_the_list(tour: Reference) -> None:
    wanted = [
        (3, -4, 170),
        (3, -4, 170),
        (12, -6, -160),
        (-8, 14, 80),
        (-8, 14, 80),
        (-2, 14, 80),
    ]
    for t, angles in zip(tour.start_s, wanted, strict=True):
        assert between(there(tour, t), euler(*angles)) < 1e-14
        # The sums of durations round; the rate leaves zero with their square.
        np.testing.assert_allclose(tour.state_at(t)[1], np.zeros(3), rtol=0, atol=1e-20)


def test_slews_keep_their_limits_and_use_them(tour: Reference) -> None:
    t = np.arange(0, tour.duration_s, 1e-2)
    _, rate, acceleration = sampled(tour, t)
    rate_deg_s = np.degrees(np.linalg.norm(rate, axis=1))
    acceleration_deg_s2 = np.degrees(np.linalg.norm(acceleration, axis=1))
    assert rate_deg_s.max() == pytest.approx(2.0, abs=1e-12)
    assert acceleration_deg_s2.max() <= 0.5 + 1e-12
    assert acceleration_deg_s2.max() > 0.4999
    # The last slew, 6 degrees of roll, has no time to cruise: it peaks at sqrt(a angle / 1.5).
    assert rate_deg_s[t > tour.start_s[-2]].max() == pytest.approx(
        math.sqrt(0.5 * 6 / 1.5), abs=1e-4
    )


def test_slew_takes_the_time_of_its_profile() -> None:
    """Trapezoid with smoothstep ramps: duration = 1.5 v / a + angle / v, here 6 + 30 s."""
    assert reference(turn_to(0, 0, 60), start={}).duration_s == pytest.approx(36.0, abs=1e-12)


def test_slew_goes_the_shorter_way_round() -> None:
    ref = reference(turn_to(0, 0, -170), start={"yaw_deg": 170})
    assert there(ref, ref.duration_s / 2).as_euler("ZYX", degrees=True)[0] == pytest.approx(
        180, abs=1e-9
    )


def test_a_slew_to_the_present_attitude_takes_no_time() -> None:
    ref = reference(turn_to(0, 0, 0), HOLD, turn_to(0, 0, 0), start={})
    assert ref.duration_s == 2
    assert between(there(ref, 1.0), Rotation.identity()) == 0


def test_a_step_changes_attitude_at_once_with_zero_rate() -> None:
    ref = reference(HOLD, STEP, HOLD)
    assert between(there(ref, 2.0 - 1e-9), euler(3, -4, 170)) < 1e-15
    for t in (2.0, 3.0, 4.0, 1e3):
        assert between(there(ref, t), euler(5, -9, 30)) < 1e-15
    for t in (2.0 - 1e-9, 2.0, 2.0 + 1e-9, 3.0):
        np.testing.assert_array_equal(ref.state_at(t)[1:], np.zeros((2, 3)))


def test_a_rate_element_rotates_by_the_exponential_of_rate_times_time() -> None:
    """lab_from_ref = start exp(w t) with the matrix exponential's series; from the first moment to long after."""
    ref = reference(RATE)
    w = np.radians([3, -5, 20])
    for t in (0.0, 1.234, 4.0, 50.0):
        wanted = euler(*START.values()) * Rotation.from_rotvec(w * t)
        assert between(there(ref, t), wanted) < 2e-14
        np.testing.assert_allclose(ref.state_at(t)[1], w, rtol=1e-15, atol=0)
        np.testing.assert_array_equal(ref.state_at(t)[2], np.zeros(3))


CHANGES = [
    ((10.0, 0.0, 0.0), (0.0, 10.0, 0.0), 1.0),
    ((360.0, 0.0, 0.0), (0.0, 360.0, 100.0), 0.1),
    ((300.0, -360.0, 0.0), (0.0, 360.0, -300.0), 20.0),
    ((5.0, 0.0, 0.0), (-5.0, 3.0, 2.0), 60.0),
]


@pytest.mark.compiles
@pytest.mark.parametrize(("begin", "end", "lasts_s"), CHANGES)
def test_spin_up_is_the_integral_of_its_rate(
    begin: tuple, end: tuple, lasts_s: float
) -> None:
    """Against scipy's eighth-order integration of q' = q w / 2 with w by hand, to 1e-9 rad."""
    ref = reference(
        {"kind": "rate", "rate_deg_s": begin, "duration": "1 s"},
        {"kind": "spin_up", "rate_deg_s": end, "duration": f"{lasts_s} s"},
    )
    w0 = np.radians(begin)
    w1 = np.radians(end)

    def rate(t_s: float) -> np.ndarray:
        x = t_s / lasts_s
        return w0 + (w1 - w0) * (3 * x**2 - 2 * x**3)

    def slope(t_s: float, q: np.ndarray) -> np.ndarray:
        w, x, y, z = q
        return 0.5 * np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) @ rate(t_s)

    at = np.append(np.sort(np.random.default_rng(2).uniform(0, lasts_s, 30)), lasts_s)
    run = solve_ivp(
        slope, (0, lasts_s), ref.state_at(1.0)[0], "DOP853", at, rtol=1e-13, atol=1e-13
    )
    wanted = Rotation.from_quat(run.y.T, scalar_first=True)
    assert between(ref.attitudes(1.0 + at), wanted).max() < 1e-9
    np.testing.assert_allclose(
        [ref.state_at(1.0 + t)[1] for t in at], [rate(t) for t in at], rtol=0, atol=1e-12
    )


def test_a_spin_up_from_or_to_rest_turns_by_half_of_rate_times_time() -> None:
    """The mean of the smoothstep is 1/2; the axis stands still, so this is exact."""
    up, down = (
        SPIN | {"rate_deg_s": w, "duration": "10 s"} for w in ([6, 0, -12], [0, 0, 0])
    )
    ref = reference(HOLD, up, down)
    for t, turned_s in ((12.0, 5.0), (22.0, 10.0), (99.0, 10.0)):
        wanted = euler(*START.values()) * Rotation.from_rotvec(
            np.radians([6, 0, -12]) * turned_s
        )
        assert between(there(ref, t), wanted) < 1e-14
    np.testing.assert_array_equal(ref.state_at(30.0)[1:], np.zeros((2, 3)))


@pytest.mark.compiles
def test_first_spin_up_begins_at_the_vehicles_own_rate() -> None:
    ref = reference(SPIN, rate_deg_s=(1.0, 2.0, -3.0))
    np.testing.assert_allclose(np.degrees(ref.state_at(0.0)[1]), [1, 2, -3], rtol=1e-14)
    np.testing.assert_allclose(np.degrees(ref.state_at(3.0)[1]), [-10, 4, 30], rtol=1e-14)
    held = reference(HOLD, SPIN, rate_deg_s=(1.0, 2.0, -3.0))
    np.testing.assert_array_equal(held.state_at(2.0)[1], np.zeros(3))


def test_a_spin_up_of_too_many_knots_is_refused_in_one_line() -> None:
    fast = {"kind": "spin_up", "rate_deg_s": [0, 360, 0], "duration": "1 h"}
    with pytest.raises(
        InputError,
        match=r"^motion\.maneuver: a spin_up of 36000 s .*; allowed: 2\.86e\+06 deg$",
    ):
        reference(RATE, fast | {"duration": "10 h"})
    reference(HOLD, fast | {"duration": "10 h"})  # one axis needs no knots


@pytest.mark.compiles
def test_sine_swings_by_its_amplitude_about_the_attitude_it_started_from() -> None:
    """Between the first and the last period phi(t) is amplitude sin(2 pi f t), exactly."""
    ref = reference(HOLD, SINE)
    amplitude = np.radians([4, -2, 1])
    t = np.linspace(1 / 0.7, 5 - 1 / 0.7, 300)
    phi = (euler(*START.values()).inv() * ref.attitudes(2.0 + t)).as_rotvec()
    wanted = np.sin(2 * np.pi * 0.7 * t)[:, None] * amplitude
    np.testing.assert_allclose(phi, wanted, rtol=0, atol=1e-14)
    assert np.abs(phi).max() > 0.9999 * amplitude[0]


@pytest.mark.parametrize("duration_s", [0.3, 2.0, 5.0, 7.77])
def test_sine_begins_and_ends_at_rest_without_a_jump_of_the_torque(duration_s: float) -> None:
    ref = reference(HOLD, SINE | {"duration": f"{duration_s} s"}, HOLD)
    for t in ref.start_s[1:3]:
        assert between(there(ref, t), euler(*START.values())) < 1e-15
        # A ns of jerk, up to 60 amplitude / growth^3 = 1e3 rad/s3.
        for near in (t - 1e-9, t, t + 1e-9):
            np.testing.assert_allclose(
                ref.state_at(near)[1:], np.zeros((2, 3)), rtol=0, atol=2e-6
            )
    inside = np.linspace(2.0, 2.0 + duration_s, 100)
    assert (
        between(ref.attitudes(inside), euler(*START.values())).max()
        <= np.radians(math.sqrt(21)) + 1e-15
    )


def test_the_envelope_has_its_stated_derivatives() -> None:
    t = np.random.default_rng(3).uniform(-0.5, 3.5, 300)
    h = 1e-5
    e, before, after = (
        np.array([envelope(s, 3.0, 0.7, 0.7) for s in t + d]) for d in (0, -h, h)
    )
    # Within a step of a corner, where the third derivative jumps by 60 / growth^3, off by a quarter of h times that.
    np.testing.assert_allclose(
        (after - before)[:, :2] / (2 * h), e[:, 1:], rtol=0, atol=60 / 0.7**3 * h / 4
    )
    middle = (t > 0.7) & (t < 2.3)
    np.testing.assert_array_equal(e[middle], np.tile([1.0, 0.0, 0.0], (middle.sum(), 1)))
    np.testing.assert_array_equal(e[(t < 0) | (t > 3)], 0.0)
    assert [envelope(s, 3.0, 0.7, 0.7)[0] for s in (0.35, 2.65)] == pytest.approx(
        [0.5, 0.5], abs=1e-15
    )


@pytest.mark.parametrize("element", [HOLD, SHAKE, BUMP, BUMP | {"caught_after": "1 s"}])
def test_during_jitter_and_bumps_the_reference_holds(element: dict[str, object]) -> None:
    ref = reference(turn_to(1, 2, 3), element)
    t = np.linspace(*ref.start_s[1:], 20)
    assert between(ref.attitudes(t), euler(1, 2, 3)).max() < 1e-14
    np.testing.assert_array_equal([ref.state_at(s)[1:] for s in t], 0.0)


# The chain


def test_there_is_a_law_for_every_kind_of_element() -> None:
    named = {part[-1]["kind"] for part in EVERY.values()}
    assert set(LEGS) - {"profile"} == named  # whose tests are in test_profiles.py


@pytest.mark.parametrize(("first", "second"), list(itertools.product(EVERY, repeat=2)))
def test_attitude_is_continuous_between_all_elements_but_steps(
    first: str, second: str
) -> None:
    later = [el for el in EVERY[second] if el["kind"] != "step"] or [HOLD]
    ref = reference(*EVERY[first], *later, HOLD)
    joints = ref.start_s[1:]
    assert len(joints) == len(EVERY[first]) + len(later) + 1
    for joint in joints:
        before = there(ref, joint - 1e-9)
        after = there(ref, joint)
        assert between(before, after) < 1e-8 * 2  # a ns at up to 1.5 rad/s, and rounding
    durations = [leg.duration_s for leg in ref.legs[:-1]]
    np.testing.assert_allclose(joints, np.cumsum(durations), rtol=1e-15)


def test_slews_join_without_a_jump_of_rate_or_torque(tour: Reference) -> None:
    for joint in tour.start_s[1:]:
        (_, rate_before, accel_before), (_, rate_after, accel_after) = (
            tour.state_at(joint - 1e-9),
            tour.state_at(joint + 1e-9),
        )
        assert between(there(tour, joint - 1e-9), there(tour, joint + 1e-9)) < 1e-12
        np.testing.assert_allclose(rate_before, rate_after, rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            accel_before, accel_after, rtol=0, atol=1e-10
        )  # 2 ns of jerk


def test_spin_ups_join_without_a_jump_of_rate() -> None:
    ref = reference(
        HOLD, SPIN, SPIN | {"rate_deg_s": [50, 0, -40]}, RATE | {"rate_deg_s": [50, 0, -40]}
    )
    for joint in ref.start_s[1:]:
        np.testing.assert_allclose(
            ref.state_at(joint - 1e-9)[1:], ref.state_at(joint + 1e-9)[1:], rtol=0, atol=1e-8
        )


@pytest.mark.parametrize("kind", ["rate", "spin_up", "spin_up of a moving axis"])
def test_a_vehicle_that_was_spun_up_keeps_spinning(kind: str) -> None:
    ref = reference(*EVERY[kind])
    end = ref.duration_s
    rate = np.radians(EVERY[kind][-1]["rate_deg_s"])
    for later in (0.0, 1.0, 77.0):
        wanted = there(ref, end) * Rotation.from_rotvec(rate * later)
        assert between(there(ref, end + later), wanted) < 1e-13
        np.testing.assert_allclose(ref.state_at(end + later)[1], rate, rtol=1e-14)
        np.testing.assert_array_equal(ref.state_at(end + later)[2], np.zeros(3))


def test_a_hold_after_a_rate_stops_at_once() -> None:
    ref = reference(RATE, HOLD)
    np.testing.assert_allclose(
        ref.state_at(4.0 - 1e-9)[1], np.radians([3, -5, 20]), rtol=1e-14
    )
    stopped = euler(*START.values()) * Rotation.from_rotvec(np.radians([12, -20, 80]))
    for t in (4.0, 5.0, 6.0, 60.0):
        np.testing.assert_array_equal(ref.state_at(t)[1], np.zeros(3))
        assert between(there(ref, t), stopped) < 1e-14


def test_reference_holds_after_its_end_and_without_a_maneuver(tour: Reference) -> None:
    assert between(there(tour, tour.duration_s + 1e3), euler(-2, 14, 80)) < 1e-14
    np.testing.assert_array_equal(tour.state_at(tour.duration_s + 1e3)[1:], np.zeros((2, 3)))
    idle = reference(start={"yaw_deg": 40}, rate_deg_s=(1.0, 2.0, 3.0))
    assert idle.duration_s == 0
    assert between(there(idle, 7.0), euler(0, 0, 40)) < 1e-15
    np.testing.assert_array_equal(idle.state_at(7.0)[1], np.zeros(3))
    assert between(there(idle, -1.0), euler(0, 0, 40)) < 1e-15


def test_pointing_at_stars_starts_from_the_lab_axes() -> None:
    """This holds also if the reference is the ICRS: angles are counted from the start."""
    motion = motion_config(HOLD, turn_to(3, -5, 30), STEP, start={"ra_deg": 83, "dec_deg": 2})
    lab_from_start = Rotation.from_rotvec([0.4, -1.0, 2.0])
    own = plan(motion)
    icrs = plan(motion, lab_from_start)
    assert between(there(own, 0.0), Rotation.identity()) == 0
    assert between(there(own, own.start_s[2] - 1e-9), euler(3, -5, 30)) < 1e-12
    np.testing.assert_allclose(own.start_s, icrs.start_s, rtol=1e-14)
    t = np.linspace(0, own.duration_s, 77)
    assert between(lab_from_start * own.attitudes(t), icrs.attitudes(t)).max() < 1e-14


def test_the_start_of_a_vehicle_in_the_lab_does_not_move_its_targets() -> None:
    ref = plan(motion_config(turn_to(3, -5, 30)), euler(0, 0, 20))
    assert between(there(ref, 0.0), euler(0, 0, 20)) < 1e-15
    assert between(there(ref, ref.duration_s), euler(3, -5, 30)) < 1e-14


@pytest.mark.parametrize("name", EVERY)
def test_the_reference_returns_new_unit_quaternions(name: str) -> None:
    """Writing into a returned array does not change later results."""
    ref = reference(*EVERY[name])
    for t in np.linspace(0, ref.duration_s + 1, 9):
        state = ref.state_at(t)
        assert [part.shape for part in state] == [(4,), (3,), (3,)]
        assert np.linalg.norm(state[0]) == pytest.approx(1, abs=1e-14)
        kept = [part.copy() for part in state]
        for part in state:
            part[:] = np.nan
        for again, first in zip(ref.state_at(t), kept, strict=True):
            np.testing.assert_array_equal(again, first)


def test_the_reference_is_fast_enough_for_every_control_tick() -> None:
    """12 us expected; the fastest of several runs is compared, as the machine may be busy."""
    for name in EVERY:
        ref = reference(*EVERY[name])
        t = ref.start_s[-2] + 0.3 * (ref.duration_s - ref.start_s[-2])
        assert (
            min(timeit.repeat(lambda ref=ref, t=t: ref.state_at(t), number=20, repeat=200))
            / 20
            < 12e-6
        )


# Knocks and vibration


def test_a_knock_is_a_half_sine_of_torque() -> None:
    """Shares against the integral of sin(pi x) pi / 2 by scipy's quadrature, cut at the knock's ends."""
    knock = Impulse(2.0, 0.05, np.zeros(3))
    x = np.linspace(0, 1, 20_001)
    impulse = np.concatenate(
        [[0], np.cumsum(np.sin(np.pi * (x[1:] + x[:-1]) / 2)) * np.pi / 2 / 20_000]
    )
    for a, b in np.random.default_rng(4).uniform(1.97, 2.08, (50, 2)):
        wanted = np.interp([a, b], 2.0 + 0.05 * x, impulse)
        assert knock.fraction(a, b) == pytest.approx(wanted[1] - wanted[0], abs=1e-8)
    assert knock.fraction(0.0, 2.0) == knock.fraction(2.05, 9.0) == 0
    ticks = np.arange(1.9, 2.2, 1e-3)
    assert sum(knock.fraction(a, b) for a, b in itertools.pairwise(ticks)) == pytest.approx(
        1, abs=1e-14
    )


def test_bumps_knock_at_their_times_and_a_caught_one_leaves_no_impulse() -> None:
    motion = motion_config(HOLD, BUMP, SPIN, BUMP | {"caught_after": "80 ms"}, HOLD)
    first, second, third = impulses(motion, plan(motion))
    assert [k.begin_s for k in (first, second, third)] == pytest.approx(
        [2.0, 5.05, 5.13], abs=1e-12
    )
    assert [k.duration_s for k in (first, second, third)] == [0.05] * 3
    for knock in (first, second):
        np.testing.assert_allclose(np.degrees(knock.rate_rad_s), [30, -60, 10], rtol=1e-14)
    left = sum(k.fraction(5.0, 9.0) * k.rate_rad_s for k in (second, third))
    np.testing.assert_allclose(left, np.zeros(3), rtol=0, atol=1e-15)
    assert plan(motion).start_s[4] == pytest.approx(
        5.18, abs=1e-12
    )  # caught_after + duration
    assert impulses(motion_config(HOLD, SPIN), reference(HOLD, SPIN)) == ()


def test_vibration_lasts_as_long_as_its_element() -> None:
    motion = motion_config(HOLD, SHAKE, turn_to(3, -4, 176), SHAKE | {"duration": "1 s"})
    rng = np.random.default_rng(1)
    first, second = Vibration(motion, rng).components
    assert (first.begin_s, first.end_s) == (2.0, 5.0)
    assert first.sines.omega_rad_s[0] == pytest.approx(2 * np.pi * 30)
    assert (second.begin_s, second.end_s) == pytest.approx(
        (plan(motion).start_s[3], plan(motion).duration_s), abs=1e-12
    )
    assert Vibration(motion_config(HOLD, BUMP), rng).components == ()
