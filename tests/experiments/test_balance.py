"""`skysim balance`: mass properties are measured and balanced; undetermined ones are refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

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
    with pytest.raises(
        InputError,
        match=r"trim_. would have to go to .* mm; allowed: vehicle.trim.travel 20 mm: first",
    ):
        balance_procedure.balanced_position_m(vehicle, 10 * np.ones(3) * 1e-3, scene)


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
    prior = Prior(np.array([1.0] * 3 + [0.0] * 17), sigma)
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
