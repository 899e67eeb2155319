"""Air currents, Earth rotation, turbine torque and knocks against their laws or independent integrations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from skysim.core import quaternion
from skysim.core.types import Floats
from skysim.dynamics.disturbances import AirCurrent, DisturbanceModel, earth_torque_nm
from skysim.dynamics.guidance import Impulse
from skysim.dynamics.imu import earth_rate_lab_rad_s
from skysim.scene import loader
from skysim.scene.sections.vehicle import AirCurrentConfig, DisturbancesConfig, SiteConfig
from skysim.simulation.flight import Flight, simulate_motion

AXES = Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix()
# Of a vehicle whose principal axes are not the body's.
TENSOR = AXES @ np.diag([6.0, 6.5, 9.0]) @ AXES.T
NONE = np.zeros(3)
BALANCED = {
    "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
    "motion.control": "none",
    "motion.maneuver": "[]",
}
QUIET = DisturbancesConfig()


def flown(duration_s: float, **changes: str) -> Flight:
    """SimSat, balanced and without a controller."""
    until = {
        "exposure": f"{{time: 10 ms, rate_hz: 1, frames: 1, first: {duration_s - 0.012} s}}"
    }
    given = (
        BALANCED | until | {key.replace("__", "."): value for key, value in changes.items()}
    )
    return simulate_motion(loader.load("afit_simsat", given))


def room(
    config: DisturbancesConfig = QUIET, earth: Floats = NONE, knocks: tuple[Impulse, ...] = ()
) -> DisturbanceModel:
    return DisturbanceModel(config, earth, knocks, TENSOR, 0.01, np.random.default_rng(1))


# --- the air ------------------------------------------------------------------------------------------------

RMS_NM = np.array([1e-3, 2e-3, 5e-4])
AIR_CURRENT = AirCurrentConfig.model_validate(
    {"rms": ["1 mN m", "2 mN m", "0.5 mN m"], "correlation": "50 ms"}
)
PERIOD_S = 0.01


@pytest.fixture(scope="module")
def gusts() -> Floats:
    """(100,000, 3) gust torques of a thousand seconds."""
    air = AirCurrent(AIR_CURRENT, PERIOD_S, np.random.default_rng(5))
    return np.array([air.sample() for _ in range(100_000)])


@pytest.mark.slow
def test_gusts_have_their_rms_and_no_mean(gusts: Floats) -> None:
    """Of N samples of an Ornstein-Uhlenbeck process, a = exp(-period / time): the mean's variance is rms^2 / N
    (1 + a) / (1 - a), the mean square's 2 rms^4 / N (1 + a^2) / (1 - a^2). Four sigma."""
    a = math.exp(-PERIOD_S / 0.05)
    n = len(gusts)
    assert (np.abs(gusts.mean(axis=0)) < 4 * RMS_NM * math.sqrt((1 + a) / (1 - a) / n)).all()
    square = (gusts**2).mean(axis=0) / RMS_NM**2
    np.testing.assert_allclose(
        square, 1, rtol=0, atol=4 * math.sqrt(2 * (1 + a**2) / (1 - a**2) / n)
    )


@pytest.mark.parametrize("lag", [1, 3, 10, 30])
def test_gusts_decorrelate_with_their_correlation_time(gusts: Floats, lag: int) -> None:
    """exp(-lag / time) about each axis, nothing between axes; four sigma of Bartlett's formula for such a process."""
    a = math.exp(-PERIOD_S / 0.05)
    n = len(gusts)
    x = gusts / RMS_NM
    found = x[:-lag].T @ x[lag:] / (n - lag)
    b = a**2
    own = (1 + b) * (1 - b**lag) / (1 - b) - 2 * lag * b**lag + 2 * b**lag * (1 + b) / (1 - b)
    across = (1 + b) / (1 - b)
    spread = 4 * np.sqrt(np.where(np.eye(3) > 0, own, across) / n)
    assert (np.abs(found - a**lag * np.eye(3)) < spread).all()


def test_gusts_are_stationary_from_the_start() -> None:
    """The first torque of 4,000 flights has the rms already: 4 sigma of a variance, sqrt(2 / 4000)."""
    first = np.array(
        [
            AirCurrent(AIR_CURRENT, PERIOD_S, np.random.default_rng(k)).sample()
            for k in range(4000)
        ]
    )
    np.testing.assert_allclose(
        (first**2).mean(axis=0) / RMS_NM**2, 1, rtol=0, atol=4 * math.sqrt(2 / 4000)
    )


def test_steady_wind_and_turbine_torques_are_along_the_lab_s_axes() -> None:
    """Turned by 90 deg of yaw, what twists about lab x twists about body -y."""
    config = DisturbancesConfig.model_validate({"turbine": ["1 mN m", "0 N m", "2 mN m"]})
    times = np.arange(11) * 1e-3
    here = quaternion.from_rotation(Rotation.from_euler("z", 90, degrees=True))
    torque = room(config).torque_nm(times, here, np.array([0.1, 0.2, 0.3]), NONE)
    np.testing.assert_allclose(torque, np.tile([0, -1e-3, 2e-3], (10, 1)), rtol=0, atol=1e-17)
    blown = DisturbancesConfig.model_validate({"air_current": {"rms": ["1 mN m"] * 3}})
    level = room(blown).torque_nm(
        times, quaternion.from_rotation(Rotation.identity()), NONE, NONE
    )
    turned = room(blown).torque_nm(times, here, NONE, NONE)
    np.testing.assert_allclose(turned, level[:, [1, 0, 2]] * [1, -1, 1], rtol=0, atol=1e-17)
    assert np.ptp(level, axis=0).max() == 0  # held over the tick


def test_turbine_spins_a_vehicle_up() -> None:
    """w = T t / J about z: 2e-3 N m for 4 s on 9 kg m2."""
    flight = flown(4.0, vehicle__disturbances="{turbine: [0 N m, 0 N m, 2 mN m]}")
    motion = flight.trajectory()
    telemetry = flight.telemetry()
    expected = 2e-3 / 9 * motion.t_s[-1]
    np.testing.assert_allclose(
        motion.rate_body_rad_s[-1], [0, 0, expected], rtol=1e-9, atol=1e-12
    )
    wanted = np.tile([0, 0, 2e-3], (len(telemetry.t_s), 1))
    np.testing.assert_allclose(telemetry.disturbance_nm, wanted, atol=1e-12)


# --- the Earth ----------------------------------------------------------------------------------------------


def integrated(
    slope: object, attitude: Rotation, rate: Floats, t_s: Floats
) -> tuple[Rotation, Floats]:
    """Attitudes and rates at times of dR/dt = R [w], dw/dt = slope(R, w)."""

    def both(_: float, y: Floats) -> Floats:
        R = y[:9].reshape(3, 3)
        w = y[9:]
        return np.concatenate([np.cross(R, w).ravel(), slope(R, w)])  # type: ignore[operator]

    begin = np.concatenate([attitude.as_matrix().ravel(), rate])
    run = solve_ivp(
        both, (0, t_s[-1]), begin, t_eval=t_s, method="DOP853", rtol=1e-13, atol=1e-14
    )
    return Rotation.from_matrix(run.y[:9].T.reshape(-1, 3, 3)), run.y[9:].T


@pytest.mark.slow
@pytest.mark.parametrize("stored", [NONE, np.array([1.5, -2.0, 3.0])])
def test_motion_in_a_rotating_lab_equals_inertial_motion_seen_from_it(stored: Floats) -> None:
    """Integrated among the stars, where no torque acts, and seen from the lab; and in the lab with the extra torque.

    A vehicle with rotors at constant speed, on an Earth that turns in two minutes: the law knows no small numbers,
    and what it does is then of order one.
    """
    earth = np.array([0.02, -0.03, 0.035])
    start = Rotation.from_rotvec([0.3, 0.1, -0.5])
    rate = np.array([0.05, -0.08, 0.11])
    inverse = np.linalg.inv(TENSOR)
    t_s = np.linspace(1, 60, 20)

    def among_stars(_: Floats, w: Floats) -> Floats:
        return inverse @ -np.cross(w, TENSOR @ w + stored)

    def in_the_lab(R: Floats, w: Floats) -> Floats:
        extra = earth_torque_nm(TENSOR, stored, w, R.T @ earth)
        return inverse @ (extra - np.cross(w, TENSOR @ w + stored))

    turning = rate + start.inv().apply(earth)
    stars_from_body, fast = integrated(among_stars, start, turning, t_s)
    stars_from_lab = Rotation.from_rotvec(np.outer(t_s, earth))  # the axes are one at t = 0
    expected = stars_from_lab.inv() * stars_from_body
    lab_from_body, found = integrated(in_the_lab, start, rate, t_s)
    assert np.linalg.norm((expected.inv() * lab_from_body).as_rotvec(), axis=1).max() < 1e-9
    np.testing.assert_allclose(found, fast - expected.inv().apply(earth), rtol=0, atol=1e-9)
    ignored, _ = integrated(lambda _, w: among_stars(_, w), start, rate, t_s)
    # Without the torque it is somewhere else.
    assert (expected.inv() * ignored).magnitude().max() > 0.5


def test_a_vehicle_at_rest_among_the_stars_rotates_with_them_in_the_lab() -> None:
    """With dw/dt = 0, in any attitude, whatever its inertia: J dw/dt = T - w x J w, w = -W."""
    earth_body = Rotation.from_rotvec([0.3, 1.0, -0.5]).apply([3e-5, 0, 5e-5])
    torque = earth_torque_nm(TENSOR, NONE, -earth_body, earth_body)
    np.testing.assert_allclose(
        torque, np.cross(earth_body, TENSOR @ earth_body), rtol=0, atol=1e-23
    )


def test_a_spinning_wheel_is_a_gyrocompass() -> None:
    """At rest in the lab, h = 2 N m s along lab east, lab x: -W x h turns it towards north and up, 2 h W N m."""
    earth = earth_rate_lab_rad_s(SiteConfig(latitude_deg=39.8, x_azimuth_deg=90))
    torque = earth_torque_nm(np.zeros((3, 3)), np.array([2.0, 0, 0]), NONE, earth)
    w = 7.292115e-5
    up = w * math.sin(math.radians(39.8))
    north = w * math.cos(math.radians(39.8))
    np.testing.assert_allclose(torque, [0, -2 * up, 2 * north], rtol=0, atol=1e-15)


@pytest.mark.slow
def test_the_earth_s_rotation_acts_on_a_controlled_vehicle() -> None:
    """Let go with no turn among the stars, it turns in the lab with -15.04 deg/h about the Earth's axis."""
    earth = earth_rate_lab_rad_s(SiteConfig(latitude_deg=39.8, x_azimuth_deg=90))
    rate = str((-np.degrees(earth)).tolist())
    motion = flown(
        20.0, vehicle__disturbances="{earth_rotation: true}", motion__rate_deg_s=rate
    ).trajectory()
    t_s = motion.t_s[-1]
    turned = motion.lab_from_body[-1].as_rotvec()
    np.testing.assert_allclose(
        turned, -earth * t_s, rtol=0, atol=1e-6 * np.linalg.norm(earth) * t_s
    )
    spinning = '{start_rpm: [3000, 0, 0], torque_limit: "0.5 N m"}'
    pushed = flown(
        2.0, vehicle__disturbances="{earth_rotation: true}", vehicle__wheels=spinning
    ).telemetry()
    # At rest in the lab the momentum among the stars, nearly all of it the wheel's, makes the torque.
    whole = pushed.momentum_nms[0] + np.diag([6.0, 6.5, 9.0]) @ earth
    expected = -np.cross(earth, whole)
    np.testing.assert_allclose(pushed.disturbance_nm[0], expected, rtol=1e-9, atol=1e-15)


# --- knocks -------------------------------------------------------------------------------------------------

SPHERE = {"vehicle__mount": "free", "vehicle__inertia": '["6 kg m2", "6 kg m2", "6 kg m2"]'}
HOLD = '{kind: hold, duration: "0.1234 s"}'


def bump(**more: str) -> str:
    rest = "".join(f", {key}: {value}" for key, value in more.items())
    return f'{{kind: bump, rate_deg_s: [3, -2, 14], duration: "40 ms"{rest}}}'


def test_a_knock_changes_the_rate_by_the_declared_amount() -> None:
    """On a sphere about three axes at once, beginning and ending within steps and ticks."""
    motion = flown(0.5, motion__maneuver=f"[{HOLD}, {bump()}]", **SPHERE).trajectory()
    rate = np.degrees(motion.rate_body_rad_s)
    np.testing.assert_allclose(rate[-1], [3, -2, 14], rtol=1e-6, atol=0)
    t_s = motion.t_s
    assert (rate[t_s < 0.1234] == 0).all()
    # A half-sine: its integral is (1 - cos(pi x)) / 2 of the whole. Every step has its exact share.
    x = np.clip((t_s - 0.1234) / 0.040, 0, 1)
    expected = np.outer((1 - np.cos(np.pi * x)) / 2, [3, -2, 14])
    np.testing.assert_allclose(rate, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_knock_gives_the_declared_rate_about_each_axis(axis: int) -> None:
    rate = (5.0 * np.eye(3)[axis]).tolist()
    motion = flown(
        0.3, motion__maneuver=f'[{{kind: bump, rate_deg_s: {rate}, duration: "30 ms"}}]'
    ).trajectory()
    np.testing.assert_allclose(
        np.degrees(motion.rate_body_rad_s[-1]), rate, rtol=1e-6, atol=1e-12
    )


def test_a_caught_vehicle_is_at_rest_at_another_attitude() -> None:
    """Turned by rate times the time between the knocks: 14.5 deg/s for 0.2 s, 2.9 deg."""
    motion = flown(
        0.6, motion__maneuver=f"[{HOLD}, {bump(caught_after='0.2 s')}]", **SPHERE
    ).trajectory()
    assert np.degrees(np.abs(motion.rate_body_rad_s[-1])).max() < 1e-6
    turned = np.degrees(motion.lab_from_body[-1].as_rotvec())
    np.testing.assert_allclose(turned, np.array([3, -2, 14]) * 0.2, rtol=1e-6, atol=0)


# --- quiet --------------------------------------------------------------------------------------------------


def test_a_room_is_quiet_if_nothing_is_switched_on() -> None:
    earth = np.array([0.0, 0.0, 7e-5])
    knock = Impulse(1.0, 0.1, np.array([0.1, 0, 0]))
    assert room().inactive
    assert room(earth=earth).inactive  # which does not count unless the scene says so
    assert not room(DisturbancesConfig(earth_rotation=True), earth).inactive
    assert not room(knocks=(knock,)).inactive
    for part in (
        {"turbine": ["0 N m", "1 uN m", "0 N m"]},
        {"air_current": {"rms": ["1 uN m"] * 3}},
    ):
        assert not room(DisturbancesConfig.model_validate(part)).inactive
    # It is MuJoCo's.
    assert room(
        DisturbancesConfig.model_validate({"cable": {"stiffness": "1 N m / rad"}})
    ).inactive


def test_a_room_without_disturbances_gives_no_torque() -> None:
    torque = room().torque_nm(
        np.arange(11) * 1e-3,
        quaternion.from_rotation(Rotation.identity()),
        np.ones(3),
        np.ones(3),
    )
    np.testing.assert_array_equal(torque, np.zeros((10, 3)))
