"""`skysim balance`: mass properties are measured and balanced; undetermined ones are refused."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimator.calibration.mass_dynamics import BearingRecord, MassEstimate, Prior
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.dynamics import guidance, multibody
from skysim.experiments import balance_flight, balance_procedure
from skysim.experiments.balance_procedure import BalancePlan
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.simulation.flight import Flight, Progress
from tests.helpers.bearing_motion import SMALL

SIGMA_RAD = 5e-5
UNCERTAINTY = balance_flight.parse_uncertainty("10%", "500 um", "0.1%", "0.03 deg", 1.0)
BALANCE = BalancePlan("wheels", 8.0, 5e-5, 4, True)


def noisy_truth(
    flown: Flight, watch: Progress | None
) -> list[tuple[float, Rotation, Floats, Floats]]:
    """Attitudes with 10 arcsec of noise at 2 Hz instead of solved frames, without common errors."""
    log = flown.simulate_motion().telemetry()
    rng = random_stream(flown.lab.scene.seed, 999)
    every = round(0.5 / log.period_s)
    turned = Rotation.from_rotvec(SIGMA_RAD * rng.standard_normal((len(log.t_s[::every]), 3)))
    attitudes = log.lab_from_body[::every] * turned
    parts = np.array([SIGMA_RAD**2 * np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))])
    return [
        (float(t), one, parts, np.ones(1))
        for t, one in zip(log.t_s[::every], attitudes, strict=True)
    ]


def scene_of(name: str, **overrides: str) -> Scene:
    return loader.load(
        name, {key.replace("__", "."): value for key, value in overrides.items()}
    )


@pytest.mark.slow
def test_table_is_balanced_below_the_published_torque(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """5e-5 N m (Bahu & Modenini 2020): MuJoCo's mass, center and inertia are the truth."""
    monkeypatch.setattr(balance_flight, "measured_attitudes", noisy_truth)
    scene = scene_of("cubesat_table")
    last = list(balance_procedure.balance(scene, BALANCE, UNCERTAINTY))[-1]
    assert last.true_torque_nm < 5e-5
    assert last.torque_bound_nm <= 5e-5
    result = balance_procedure.statistics(scene.name, BALANCE, [last])
    assert result["balanced"]
    assert result["nees"] < chi2.ppf(0.9999, 9)
    for row in result["estimates"][:3]:
        assert row["estimate"] == pytest.approx(row["truth"], rel=0.01)
    for row in result["estimates"][6:]:
        assert row["estimate"] == pytest.approx(row["truth"], abs=1.0)
    balance_procedure.write_all(tmp_path, result, [last], "skysim balance cubesat_table")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<p class="verdict good">balanced: ' in page
    assert page.count("<tr><td") == 1 + 9
    assert f"{last.true_torque_nm:.2g} N m" in page
    assert json.loads((tmp_path / "balance.json").read_text())["report"] == str(
        tmp_path / "report.html"
    )


@pytest.mark.long
def test_the_errors_of_a_table_in_frames_match_their_covariance() -> None:
    """Draws of vehicle, noise and survey, one frame a second: the sum of 30 NEES of nine values is chi-square."""
    plan = BalancePlan("wheels", 8.0, 5e-5, 1, False)
    total = 0.0
    for seed in range(30):
        changes = {"exposure.rate_hz": "1", "tracker.survey.seed": str(seed)}
        scene = loader.load("cubesat_table", changes | {"seed": str(seed)})
        (one,) = balance_procedure.balance(scene, plan, UNCERTAINTY)
        total += balance_procedure.statistics(scene.name, plan, [one])["nees"]
    assert chi2.ppf(1e-4, 270) < total < chi2.ppf(1 - 1e-4, 270)


@pytest.mark.slow
def test_simsat_is_measured_to_a_percent_and_a_micrometer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In-plane offset, without trim masses; NEES of the nine as their covariance says."""
    monkeypatch.setattr(balance_flight, "measured_attitudes", noisy_truth)
    scene = scene_of("simsat_slew")
    plan = BALANCE._replace(moves=False)
    (one,) = balance_procedure.balance(scene, plan, UNCERTAINTY)
    rows = balance_procedure.statistics(scene.name, plan, [one])
    for row in rows["estimates"][:3]:
        assert row["estimate"] == pytest.approx(row["truth"], rel=0.01)
    for row in rows["estimates"][6:8]:
        assert row["sigma"] < 0.33
        assert row["estimate"] == pytest.approx(row["truth"], abs=1.0)
    assert rows["nees"] < chi2.ppf(0.9999, 9)


@pytest.mark.parametrize("name", ["simsat_slew", "cubesat_table"])
def test_maneuver_stays_within_what_wheels_and_stop_allow(name: str) -> None:
    scene = scene_of(name)
    vehicle = multibody.build(scene.vehicle)
    moved = balance_flight.excited_by_wheels(scene, vehicle, 8.0)
    reference = guidance.plan(moved.motion)
    wheels = scene.vehicle.wheels
    assert wheels is not None
    inertia = np.linalg.eigvalsh(vehicle.inertia_kg_m2)[2]
    states = [reference.state_at(t) for t in np.arange(0, reference.duration_s, 0.05)]
    rates, accelerations = (np.array([state[n] for state in states]) for n in (1, 2))
    capacity = vehicle.wheels.inertia_kg_m2.min() * wheels.speed_limit_rpm * 2 * np.pi / 60
    assert (
        inertia * np.linalg.norm(accelerations, axis=1).max() < 0.6 * wheels.torque_limit_nm
    )
    assert inertia * np.linalg.norm(rates, axis=1).max() < 0.6 * capacity
    attitudes = Rotation.from_quat([state[0] for state in states], scalar_first=True)
    # The sine fades in and out.
    assert multibody.tilt_deg(attitudes).max() == pytest.approx(7.3, abs=0.1)
    turned = (attitudes[0].inv() * attitudes).as_rotvec()
    assert np.degrees(np.abs(turned[:, 2]).max()) > 115


def test_trim_masses_move_to_cancel_the_moment() -> None:
    scene = scene_of(
        "cubesat_table", vehicle__trim="{position: [1 mm, 2 mm, -3 mm], step: 0.001 um}"
    )
    vehicle = multibody.build(scene.vehicle)
    moment = vehicle.mass.mass_kg * vehicle.mass.center_m
    position_m = balance_procedure.balanced_position_m(vehicle, moment, scene)
    moved = multibody.build(
        scene.with_values("vehicle.trim", position_m=tuple(position_m)).vehicle
    )
    np.testing.assert_allclose(moved.mass.center_m, 0, atol=1e-10)
    assert np.abs(position_m - vehicle.trims.position_m).max() > 1e-3
    heavy_kg_m = 1e-2 * np.ones(3)
    lever_kg = vehicle.trims.axes * vehicle.trims.mass_kg
    needed_m = vehicle.trims.position_m - np.linalg.solve(lever_kg, heavy_kg_m)
    beyond_g_mm = 1e6 * vehicle.trims.mass_kg * (np.abs(needed_m) - 0.02)
    with pytest.raises(InputError, match=r"trim_. would have to go to .* mm;") as refused:
        balance_procedure.balanced_position_m(vehicle, heavy_kg_m, scene)
    ballast = f"by {beyond_g_mm[np.argmax(np.abs(needed_m))]:.3g} g mm"
    assert (
        f"allowed: vehicle.trim.travel 20 mm: first move ballast along its axis, {ballast}"
        in (str(refused.value))
    )


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        (
            "simsat_slew",
            {},
            "vehicle.trim: none, so nothing can be moved; allowed: joints trim_",
        ),
        ("shefex2", {}, "vehicle.mount: a free vehicle has no bearing"),
        ("tas2_vscmg", {}, "vehicle.cmgs: the stored momentum must be that of wheels"),
        (
            "cubesat_table",
            {"vehicle.disturbances.cable": "{stiffness: 1e-4 N m / rad}"},
            "vehicle.disturbances.cable: its",
        ),
    ],
)
def test_a_vehicle_that_cannot_be_balanced_is_refused(
    name: str, overrides: dict[str, str], message: str
) -> None:
    with pytest.raises(InputError) as refused:
        next(balance_procedure.balance(loader.load(name, overrides), BALANCE, UNCERTAINTY))
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


def record_of(rate_deg_s: float) -> BearingRecord:
    """Record of a level yaw at a constant rate."""
    t_s = np.arange(10.0)
    attitudes = Rotation.from_rotvec(np.outer(np.radians(rate_deg_s) * t_s, [0, 0, 1]))
    return BearingRecord(
        t_s, attitudes, np.tile(1e-9 * np.eye(3), (10, 1, 1)), t_s, np.zeros((10, 3))
    )


def test_an_undetermined_quantity_is_named_with_a_sufficient_maneuver() -> None:
    """Information beyond the assumed grows with time and with the square of the motion."""
    sigma = np.array([*[0.1] * 3, *[0.05] * 3, *[1e-3] * 3, *[1.0] * 11])
    prior = Prior(np.array([1.0] * 3 + [0.0] * 17), sigma, SMALL.lab)
    known = sigma.copy()
    known[:9] = 1e-3, 1e-3, 0.04, *[1e-3] * 3, 1e-6, 1e-6, 1e-6

    def faults(sigmas: Floats) -> list[str]:
        estimate = MassEstimate(prior.values, np.diag(sigmas**2), 1.0)
        flown = balance_flight.Excitation(8.0, 29.0, 2.0)
        return balance_flight.uncertain(
            estimate, prior, [record_of(2.0)], 0.01, np.full(3, 1e-5), flown
        )

    def fault(sigmas: Floats) -> str:
        (only,) = faults(sigmas)
        return only

    gained = 0.04**-2 - 0.1**-2
    needed = 0.01**-2 - 0.1**-2
    times = needed / gained
    text = fault(known)
    # 8 deg times sqrt(18.7) is beyond the stop, so only the time is left.
    assert text.startswith(
        "inertia about z is known to 4 %, not 1 %, after turns of 2 deg/s: fly again with --longer "
    )
    assert 1.0 <= float(text.split()[-1]) / (2 * times) < 1.06
    # A miss of 4 % takes 8 % more information: 4 % more of a tilt. Either command gives it.
    known[2] = 0.0104
    tilt_text, longer_text = re.findall(r"--(?:tilt|longer) ([\d.]+)", fault(known))
    gained = 0.0104**-2 - 0.1**-2
    assert 1.0 <= (float(tilt_text) / 8) ** 2 / (needed / gained) < 1.09
    assert 1.0 <= float(longer_text) / 2 / (needed / gained) < 1.12
    known[2] = 1e-3
    known[0] = 0.1
    assert fault(known) == (
        "inertia about x is known to 10 %, not 1 %, after no turn about it: a turn is needed that the wheels'"
        " known momentum or a known trim weighs"
    )
    known[0] = 1e-3
    known[8] = 1e-3
    assert fault(known).startswith(
        "moment along z is known to 1000 g mm, not 10, after tilts of 0.0 deg: a tilt"
    )
    known[8] = 1e-6
    assert not faults(known)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (
            ("10", "500 um", "0.1%", "0.03 deg", 1.0),
            "balance.inertia_sigma: 10; allowed: 0.001 to 0.5",
        ),
        (
            ("10%", "5 s", "0.1%", "0.03 deg", 1.0),
            "balance.offset_sigma: '5 s' is not a length",
        ),
        (
            ("10%", "1 m", "0.1%", "0.03 deg", 1.0),
            "balance.offset_sigma: 1 m; allowed: 1e-07 to 0.01 m",
        ),
        (
            ("10%", "1 mm", "0.1%", "0.03 deg", -1.0),
            "balance.tacho_sigma: -1; allowed: 0 to 1000 rpm",
        ),
    ],
)
def test_wrong_uncertainties_are_refused(
    texts: tuple[str, str, str, str, float], message: str
) -> None:
    with pytest.raises(InputError) as refused:
        balance_flight.parse_uncertainty(*texts)
    assert str(refused.value).startswith(message)


def test_wrong_accuracy_limits_are_refused() -> None:
    for torque, offset, message in (
        ("5 m", None, "balance.torque: '5 m' is not a torque"),
        ("0 N m", None, "balance.torque: 0 N m; allowed: above 0"),
        ("1e-5 N m", "1 s", "balance.offset_bar: '1 s' is not a length"),
    ):
        with pytest.raises(InputError) as refused:
            balance_procedure.parse_bars(torque, 1.0, offset)
        assert str(refused.value).startswith(message)
    vehicle = multibody.build(scene_of("cubesat_table").vehicle)
    weight = vehicle.mass.mass_kg * vehicle.gravity_m_s2
    np.testing.assert_allclose(
        balance_procedure.parse_bars("4e-5 N m", 1.0, None).moment_kg_m(vehicle),
        2e-5 / weight * vehicle.mass.mass_kg,
    )
    np.testing.assert_allclose(
        balance_procedure.parse_bars("4e-5 N m", 1.0, "1 um").moment_kg_m(vehicle),
        1e-6 * vehicle.mass.mass_kg,
    )


# What the lab assumes, flies and measures, each by its own arithmetic.


@pytest.mark.parametrize("name", ["simsat_slew", "cubesat_table"])
def test_assumptions_err_by_their_stated_deviations(name: str) -> None:
    """Relative to the mean moment of inertia, half as much for products; by the offset's torque and a fifth of it."""
    scene = scene_of(name)
    vehicle = multibody.build(scene.vehicle)
    true = vehicle.inertia_kg_m2
    six = np.array([*np.diag(true), true[0, 1], true[0, 2], true[1, 2]])
    six_order = balance_flight.inertia_six(np.array([[1.0, 4, 5], [4, 2, 6], [5, 6, 3]]))
    np.testing.assert_array_equal(six_order, [1, 2, 3, 4, 5, 6])
    count = len(vehicle.wheels)
    drawn = []
    wheels = []
    for seed in range(400):
        numbered = scene.model_copy(update={"seed": seed})
        found = balance_flight.draw_assumptions(numbered, vehicle, UNCERTAINTY)
        drawn.append(found.prior.values)
        wheels.append(vehicle.wheels.inertia_kg_m2 / found.wheel_inertia_kg_m2 - 1)
    sigma = found.prior.sigma
    mean_kg_m2 = np.trace(true) / 3
    moment = vehicle.mass.mass_kg * 500e-6
    torque = moment * vehicle.gravity_m_s2 / 20
    expected = [
        *[0.1 * mean_kg_m2] * 3,
        *[0.05 * mean_kg_m2] * 3,
        *[moment] * 3,
        *[torque] * 3,
        # The drag is as large as the torque at 0.1 rad/s.
        torque / 0.1,
        torque / 0.01,
        *[np.radians(0.03)] * 3,
        *[1e-3] * count,
    ]
    np.testing.assert_allclose(sigma, expected, rtol=1e-9)
    values = np.array(drawn)
    assert not values[:, 6:].any()
    z = (values[:, :6] - six) / sigma[:6]
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(400)
    np.testing.assert_allclose(z.std(axis=0), 1, rtol=0.15)
    np.testing.assert_allclose(np.std(wheels, axis=0), 1e-3, rtol=0.15)


def test_the_lab_is_known_as_the_scene_has_it() -> None:
    """Its air's level, or the least one; the Earth's rate; a wheel's momentum error by its tachometer of 1 rpm."""
    calm = scene_of("simsat_slew")
    vehicle = multibody.build(calm.vehicle)
    lab = balance_flight.known_lab(calm, vehicle, UNCERTAINTY)
    rpm = 2 * np.pi / 60
    assert lab.wheel_sigma_nms == pytest.approx(vehicle.wheels.inertia_kg_m2.max() * rpm)
    air = calm.vehicle.disturbances.air_current
    if air is None:
        np.testing.assert_allclose(lab.torque_rms_nm, 1e-7)
        assert lab.torque_correlation_s == 2.0
    windy = scene_of(
        "simsat_slew",
        vehicle__disturbances__air_current='{rms: ["3e-6 N m", "2e-6 N m", "0 N m"], correlation: 7 s}',
        vehicle__disturbances__earth_rotation="true",
    )
    found = balance_flight.known_lab(windy, vehicle, UNCERTAINTY)
    np.testing.assert_allclose(found.torque_rms_nm, [3e-6, 2e-6, 1e-7])
    assert found.torque_correlation_s == 7
    # A sidereal day
    assert np.linalg.norm(found.earth_lab_rad_s) == pytest.approx(
        2 * np.pi / 86164.1, rel=1e-4
    )
    still = scene_of("simsat_slew", vehicle__disturbances__earth_rotation="false")
    assert not balance_flight.known_lab(still, vehicle, UNCERTAINTY).earth_lab_rad_s.any()


def test_each_quantity_is_held_to_its_own_bar() -> None:
    """Of moments of inertia 1, 2 and 4, and of moments along each axis with bars of their own."""
    sigma = np.array([*[0.5] * 3, *[0.05] * 3, *[1e-3] * 3, *[1.0] * 11])
    prior = Prior(np.array([1.0, 2.0, 4.0] + [0.0] * 17), sigma, SMALL.lab)
    values = np.array([1.0, -2.0, 4.0] + [0.0] * 17)
    bars = np.array([1e-5, 2e-5, 3e-5])
    flown = balance_flight.Excitation(8.0, 29.0, 1.0)
    below = np.array([0.0099, 0.0199, 0.0399, *[1.0] * 3, *(0.99 * bars), *[1.0] * 11])
    names = ["inertia about x", "inertia about y", "inertia about z"]
    names += ["moment along x", "moment along y", "moment along z"]
    tilted = BearingRecord(
        np.arange(10.0),
        Rotation.from_rotvec(np.outer(np.arange(10.0), np.radians([0.5, 0.2, 0.04]))),
        np.tile(1e-9 * np.eye(3), (10, 1, 1)),
        np.arange(10.0),
        np.zeros((10, 3)),
    )
    for index, name in zip((0, 1, 2, 6, 7, 8), names, strict=True):
        above = below.copy()
        above[index] *= 1.02
        estimate = MassEstimate(values, np.diag(above**2), 1.0)
        (line,) = balance_flight.uncertain(estimate, prior, [tilted], 0.01, bars, flown)
        assert line.startswith(f"{name} is known to ")
        known, bar = (
            float(one) for one in re.findall(r"to ([\d.]+).*?, not ([\d.]+)", line)[0]
        )
        if index < 3:
            assert (known, bar) == (pytest.approx(1.01, abs=0.011), 1.0)
            rates = {0: "0.5", 1: "0.2"}
            after = f"turns of {rates[index]} deg/s" if index in rates else "no turn about it"
            assert f"after {after}" in line
        else:
            assert bar == pytest.approx(1e6 * bars[index - 6])
            assert known == pytest.approx(1.01 * bar, rel=0.01)
            # Nine steps of 0.54 degrees about a level axis
            tilt_deg = np.degrees(np.arccos(tilted.lab_from_body[-1].as_matrix()[2, 2]))
            assert f"after tilts of {tilt_deg:.1f} deg" in line
        # Little is missing: a bit more tilt or time.
        tilt, longer = re.findall(r"--(?:tilt|longer) ([\d.]+)", line)
        assert 8 < float(tilt) < 8.7
        assert 1 < float(longer) < 1.3


def test_a_remedy_is_rounded_up_with_a_margin_and_within_the_stop() -> None:
    """Information of 4 where 9 is needed: 2.25 times, 1.05 for safety: a tilt times 1.537, a time times 2.363."""
    flown = balance_flight.Excitation(10.0, 15.4, 2.0)
    arguments = 1 / np.sqrt(5.0), 1.0, 1 / np.sqrt(10.0)
    text = balance_flight.remedy("tilt", *arguments, flown)
    assert text == "fly again with --tilt 15.4, or --longer 4.8"
    text = balance_flight.remedy("tilt", *arguments, flown._replace(most_deg=15.3))
    assert text == "fly again with --longer 4.8"
    # A thousandth of what is needed is none.
    for share, helps in ((1.1e-3, True), (0.9e-3, False)):
        sigma = 1 / np.sqrt(1 + share * 9)
        found = balance_flight.remedy("turn", sigma, 1.0, 1 / np.sqrt(10.0), flown)
        assert found.startswith("fly again") == helps
    assert "a turn is needed" in balance_flight.remedy("turn", 1.1, 1.0, 0.3, flown)


def test_an_error_of_the_time_tag_is_one_of_the_rate() -> None:
    """s^2 w w^T, at a rate that grows: of differences before and after, those at the ends alone."""
    t_s = np.array([0.0, 1.0, 3.0, 4.0])
    rates = np.array([0.01, 0.02, 0.05])
    angles = np.concatenate([[0.0], np.cumsum(rates * np.diff(t_s))])
    axis = np.array([0.6, 0.0, 0.8])
    found = balance_flight.timing_covariance(
        t_s, Rotation.from_rotvec(np.outer(angles, axis)), 0.1
    )
    expected = 0.01 * np.array([0.01, 0.015, 0.035, 0.05]) ** 2
    np.testing.assert_allclose(
        found, expected[:, None, None] * np.outer(axis, axis), rtol=1e-6, atol=1e-15
    )


@pytest.mark.parametrize(
    ("tilt_deg", "longer", "limits", "by"),
    [
        (8.0, 1.0, {}, "torque"),
        (3.0, 2.5, {"vehicle__wheels__torque_limit": "100 N m"}, "most"),
        (
            3.0,
            2.5,
            {"vehicle__wheels__speed_limit_rpm": "30", "vehicle__wheels__start_rpm": "[]"},
            "momentum",
        ),
    ],
)
def test_a_maneuver_tilts_for_whole_periods_about_three_axes(
    tilt_deg: float, longer: float, limits: dict[str, str], by: str
) -> None:
    """At a rate that 0.3 of the wheels' torque or momentum allows, and not above 0.1 Hz; slews as fast as these."""
    scene = scene_of("simsat_slew", **limits)
    vehicle = multibody.build(scene.vehicle)
    wheels = scene.vehicle.wheels
    assert wheels is not None
    inertia = np.linalg.eigvalsh(vehicle.inertia_kg_m2).max()
    tilt_rad = np.radians(tilt_deg)
    # A sine of the amplitude a and the angular rate w has the greatest torque J a w^2, and momentum J a w.
    by_torque = np.sqrt(0.3 * wheels.torque_limit_nm / (inertia * tilt_rad)) / (2 * np.pi)
    most_nms = vehicle.wheels.inertia_kg_m2.min() * wheels.speed_limit_rpm * 2 * np.pi / 60
    by_momentum = 0.3 * most_nms / (inertia * tilt_rad) / (2 * np.pi)
    rates = {"most": 0.1, "torque": by_torque, "momentum": by_momentum}
    assert min(rates, key=lambda one: rates[one]) == by, rates
    rate_hz = rates[by]
    motion = balance_flight.excited_by_wheels(scene, vehicle, tilt_deg, longer).motion
    assert motion is not None
    legs = motion.maneuver
    sines = [one for one in legs if one.kind == "sine"]
    slews = [one for one in legs if one.kind == "slew"]
    assert [leg.kind for leg in legs] == ["sine", "slew", "sine", "slew", "sine"]
    for leg, axis_deg in zip(sines, (0.0, 90.0, 45.0), strict=True):
        axis_rad = np.radians(axis_deg)
        expected = tilt_deg * np.array([np.cos(axis_rad), np.sin(axis_rad), 0.0])
        np.testing.assert_allclose(leg.amplitude_deg, expected, rtol=0, atol=1e-9)
        assert leg.frequency_hz == pytest.approx(rate_hz)
        assert leg.duration_s == pytest.approx(longer * 2 / rate_hz)
    assert [leg.yaw_deg for leg in slews] == [120.0, 240.0]
    for leg in slews:
        fastest = np.degrees(0.3 * most_nms / inertia)
        assert leg.rate_deg_s == pytest.approx(min(5.0, fastest))
        hardest = np.degrees(0.3 * wheels.torque_limit_nm / inertia)
        assert leg.acceleration_deg_s2 == pytest.approx(min(1.0, hardest))


def test_a_swing_is_released_at_rest_at_another_yaw_in_each_flight() -> None:
    scene = scene_of("cubesat_table")
    yaws = []
    for number in range(4):
        start = balance_flight.excited_by_swing(scene, 6.0, number).motion.start
        assert (start.roll_deg, start.pitch_deg) == (6.0, 3.0)
        yaws.append(start.yaw_deg)
    assert yaws == [0, 120, 240, 0]
    plan = BALANCE._replace(excite="swing", longer=2.0)
    flown = balance_procedure.in_flight(
        scene, plan, 3, multibody.build(scene.vehicle).trims.position_m
    )
    assert flown.seed == scene.seed + 3
    last_s = flown.exposure.first_s + flown.exposure.frames / flown.exposure.rate_hz
    assert last_s == pytest.approx(300, abs=1.5 / flown.exposure.rate_hz)


@pytest.mark.parametrize(
    ("duration_s", "frames"), [(10.05, 20), (0.1, 2), (1.3, 2), (1.8, 3)]
)
def test_as_many_frames_are_taken_as_the_duration_has(duration_s: float, frames: int) -> None:
    scene = scene_of("simsat_slew", exposure__rate_hz="2", exposure__first="50 ms")
    assert balance_flight.with_frames(scene, duration_s).exposure.frames == frames


class FakeTrims(NamedTuple):
    """No trim masses."""

    position_m: Floats = np.zeros(0)

    def added(self, position_m: Floats) -> tuple[Floats, Floats]:
        assert not len(position_m)
        return np.zeros((3, 3)), np.zeros(3)


def flown_with(
    monkeypatch: pytest.MonkeyPatch, tilts_deg: Floats, speeds_rad_s: Floats
) -> balance_flight.BalanceFlight:
    """A flight of attitudes at these tilts about x, at one a second from -1 s on; wheel speeds from 0 on."""
    scene = scene_of("simsat_slew", exposure__time_tag_jitter="2 ms")
    t_s = np.arange(len(tilts_deg)) - 1.0
    parts = np.array([3e-9 * np.eye(3), 2e-9 * np.eye(3), 1e-9 * np.eye(3)])
    rows = [
        (float(t), Rotation.from_euler("x", tilt, degrees=True), parts, np.ones(4))
        for t, tilt in zip(t_s, tilts_deg, strict=True)
    ]
    log = SimpleNamespace(t_s=np.arange(len(speeds_rad_s)) * 1.0, wheel_rad_s=speeds_rad_s)
    flight = SimpleNamespace(
        lab=SimpleNamespace(vehicle=SimpleNamespace(trims=FakeTrims())), telemetry=lambda: log
    )
    monkeypatch.setattr(balance_flight, "open_flight", lambda _: nullcontext(flight))
    monkeypatch.setattr(balance_flight, "measured_attitudes", lambda *_: rows)
    vehicle = multibody.build(scene.vehicle)
    assumed = balance_flight.draw_assumptions(scene, vehicle, UNCERTAINTY)
    assumed = assumed._replace(wheel_inertia_kg_m2=np.array([1.0, 2.0, 3.0]))
    return balance_flight.fly(scene, assumed, UNCERTAINTY, None)


def test_a_flight_ends_a_degree_before_the_stop_and_begins_with_the_wheels_speeds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop_deg = scene_of("simsat_slew").vehicle.tilt_stop_deg
    tilts = np.zeros(40)
    tilts[5] = stop_deg - 1.01
    tilts[30] = stop_deg - 0.99
    speeds = np.full((4000, 3), 100.0)
    found = flown_with(monkeypatch, tilts, speeds)
    # The first attitude is before the first speed.
    np.testing.assert_array_equal(found.record.t_s, np.arange(29))
    assert (found.solved, found.after_contact) == (39, 10)
    assert found.record.lights is not None
    assert found.record.lights.shape == (29, 4)
    assert found.record.systematic_rad2 is not None
    assert found.record.constant_rad2 is not None
    np.testing.assert_allclose(
        found.record.systematic_rad2, np.tile(2e-9 * np.eye(3), (29, 1, 1))
    )
    np.testing.assert_allclose(
        found.record.constant_rad2, np.tile(1e-9 * np.eye(3), (29, 1, 1))
    )
    # 2 ms at the rate of half of 28.99 degrees in a second, about x
    rate = np.radians(stop_deg - 1.01) / 1.0
    covariance = found.record.covariance_rad2
    assert covariance[3, 0, 0] == pytest.approx(3e-9 + (0.002 * rate / 2) ** 2)
    assert covariance[3, 1, 1] == pytest.approx(3e-9)
    # Speeds are read with an error of 1 rpm; momenta are of the assumed wheels.
    read = found.record.wheel_momentum_nms / [1.0, 2.0, 3.0]
    assert read.mean() == pytest.approx(100, abs=0.01)
    assert read.std() == pytest.approx(2 * np.pi / 60, rel=0.05)
    # Errors of their own, not those of the assumptions.
    others = random_stream(scene_of("simsat_slew").seed, balance_flight.BALANCE, 0)
    same = others.standard_normal(read.shape)
    assert abs(np.corrcoef(read.ravel(), same.ravel())[0, 1]) < 0.05
    free = flown_with(monkeypatch, np.zeros(21), speeds)
    assert (len(free.record.t_s), free.after_contact) == (20, 0)
    with pytest.raises(InputError, match="19 attitudes were solved; allowed: 20 or more"):
        flown_with(monkeypatch, np.zeros(20), speeds)
    tilts[:] = stop_deg
    with pytest.raises(InputError, match="0 attitudes before the vehicle touched"):
        flown_with(monkeypatch, tilts, speeds)


def test_a_frame_s_covariances_are_those_of_the_body() -> None:
    """By the rotation of the mount; without a model of common errors these are zero; lights by number, or all."""
    cam_from_body = Rotation.from_euler("xyz", [0.3, -0.2, 0.9])
    cam_from_lab = Rotation.from_euler("xyz", [0.1, 0.4, -0.7])
    whole = np.diag([1e-9, 4e-9, 9e-9])
    common = np.diag([1e-10, 2e-10, 3e-10])

    def shot(t_s: float, **attitude: Any) -> Any:
        none = {
            name: None
            for name in (
                "cam_from_ref",
                "covariance_rad2",
                "systematic_rad2",
                "constant_rad2",
                "match",
            )
        }
        return SimpleNamespace(
            frame=SimpleNamespace(t_mid_s=t_s),
            solution=SimpleNamespace(attitude=SimpleNamespace(**(none | attitude))),
        )

    solved = {"cam_from_ref": cam_from_lab, "covariance_rad2": whole}
    shots = [
        shot(0.0, **solved, systematic_rad2=common),
        shot(1.0),
        shot(2.0, cam_from_ref=cam_from_lab),
        shot(3.0, **solved, match=SimpleNamespace(star=np.array([1, 3]))),
    ]
    camera = SimpleNamespace(
        mount=SimpleNamespace(body_from_cam=cam_from_body.inv()), sources=range(5)
    )
    flight: Any = SimpleNamespace(
        lab=SimpleNamespace(camera=camera), shots=lambda cameras, progress: shots
    )
    rows = balance_flight.measured_attitudes(flight, None)
    assert [row[0] for row in rows] == [0.0, 3.0]
    expected = cam_from_lab.inv() * cam_from_body
    R = cam_from_body.as_matrix()
    for _, lab_from_body, parts, _ in rows:
        assert (lab_from_body * expected.inv()).magnitude() < 1e-12
        np.testing.assert_allclose(R @ parts[0] @ R.T, whole, rtol=0, atol=1e-20)
        assert not parts[2].any()
    np.testing.assert_allclose(R @ rows[0][2][1] @ R.T, common, rtol=0, atol=1e-20)
    assert not rows[1][2][1].any()
    assert rows[0][3].tolist() == [1] * 5
    assert rows[1][3].tolist() == [0, 1, 0, 1, 0]


def test_a_torque_s_bound_is_two_deviations_in_the_worst_direction() -> None:
    """Of a moment along x and y, with the least known direction across them."""
    values = np.zeros(20)
    values[6:9] = [3e-4, 0.0, 0.0]
    covariance = np.zeros((20, 20))
    covariance[6:9, 6:9] = np.diag([1e-12, 4e-12, 9e-12])
    flight: Any = SimpleNamespace(
        record=SimpleNamespace(added_moment_kg_m=np.array([0.0, 4e-4, 0.0])),
        vehicle=SimpleNamespace(
            mass=SimpleNamespace(mass_kg=10.0, center_m=np.array([0.0, 3e-6, 4e-6]))
        ),
    )
    estimate = MassEstimate(values, covariance, 1.0)
    found = balance_procedure.Iteration(flight, estimate, 9.8, np.zeros(3))
    np.testing.assert_allclose(found.moment_kg_m, [3e-4, 4e-4, 0])
    assert found.torque_nm == pytest.approx(9.8 * 5e-4)
    assert found.torque_bound_nm == pytest.approx(9.8 * (5e-4 + 2 * 3e-6))
    assert found.true_torque_nm == pytest.approx(9.8 * 10 * 5e-6)


def test_bars_of_a_moment_follow_from_the_torque_or_the_offset() -> None:
    """Half of the torque over the weight; or the mass times the offset."""
    vehicle = multibody.build(scene_of("cubesat_table").vehicle)
    by_torque = balance_procedure.parse_bars("5e-5 N m", 2.0, None)
    assert by_torque.inertia == 0.02
    assert by_torque.torque_nm == 5e-5
    np.testing.assert_allclose(
        by_torque.moment_kg_m(vehicle), [5e-5 / vehicle.gravity_m_s2 / 2] * 3
    )
    by_offset = balance_procedure.parse_bars("5e-5 N m", 2.0, "3 um")
    np.testing.assert_allclose(
        by_offset.moment_kg_m(vehicle), [vehicle.mass.mass_kg * 3e-6] * 3
    )
    with pytest.raises(InputError, match=r"balance\.torque: 0 N m; allowed: above 0"):
        balance_procedure.parse_bars("0 N m", 2.0, None)


def test_a_balancing_ends_below_the_bar_or_after_its_flights(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Masses move only while the bound is above it, to places that the last estimate gives."""
    scene = scene_of("cubesat_table")
    moments = [1e-3, 1e-4, 0.0, 0.0, 0.0]
    flown: list[Floats] = []

    def fake_flight(scene: Scene, *_: Any) -> Any:
        flown.append(np.array(scene.vehicle.trim.position_m))
        return SimpleNamespace(
            record=SimpleNamespace(added_moment_kg_m=np.zeros(3)), vehicle=None
        )

    def fake_estimate(records: list[Any], *_: Any) -> MassEstimate:
        values = np.zeros(20)
        values[6] = moments[len(records) - 1]
        return MassEstimate(values, 1e-30 * np.eye(20), 1.0)

    monkeypatch.setattr(balance_procedure, "fly", fake_flight)
    monkeypatch.setattr(balance_procedure, "estimate_with_noise", fake_estimate)
    monkeypatch.setattr(
        balance_procedure, "balanced_position_m", lambda _, moment, scene: moment * [1, 0, 0]
    )
    first = multibody.build(scene.vehicle).trims.position_m
    done = list(balance_procedure.balance(scene, BALANCE, UNCERTAINTY))
    assert len(done) == 3
    np.testing.assert_allclose(flown, [first, [1e-3, 0, 0], [1e-4, 0, 0]])
    np.testing.assert_allclose([one.next_m for one in done], [*flown[1:], flown[-1]])
    flown.clear()
    moments[:] = [1e-3] * 5
    assert len(list(balance_procedure.balance(scene, BALANCE, UNCERTAINTY))) == 4
    flown.clear()
    still = BALANCE._replace(moves=False)
    (only,) = balance_procedure.balance(scene, still, UNCERTAINTY)
    np.testing.assert_allclose(only.next_m, first)
