"""The error model: laws of its processes, agreement of draws and steps, independence of skysim, and the FMU."""

from __future__ import annotations

import subprocess
import sys
import time
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skysim.experiments.datasheet import model_fit
from skysim.experiments.datasheet.cells import AXES, QUICK, Designer, MeasuredFrames
from skysim.experiments.datasheet.error_model import ErrorModel, State, correlated
from skysim.scene.loader import load

CONSTANTS: dict[str, Any] = {
    "mean": [0.3, -0.2, 1.0],
    "unit": [0.5, 0.5, 4.0],
    "thermal": [0.4, 0.3, 2.0],
    "field": [1.0, 0.8, 5.0],
    "pixel": [0.6, 0.6, 3.0],
    "scale": [0.6, 0.6, 0.9],
    "field_deg": 3.0,
    "pixel_deg": 0.02,
    "scale_deg": 6.0,
    "rates_deg_s": [0.0, 1.0, 4.0],
    "noise": [[1.0, 1.0, 10.0], [1.5, 1.5, 12.0], [4.0, 4.0, 30.0]],
    "along": [0.0, 1.2, 5.0],
}


@pytest.fixture
def model() -> ErrorModel:
    return ErrorModel(CONSTANTS)


def test_a_process_follows_its_recursion():
    """Against a loop over times with changing steps: the same numbers from the same draws."""
    steps = np.random.default_rng(1).uniform(0, 0.5, 300)
    found = correlated(steps, np.array([0.7, -1.2]), np.random.default_rng(2))
    normal = np.random.default_rng(2).standard_normal((300, 2))
    left = np.exp(-steps)
    value = np.array([0.7, -1.2])
    for k in range(1, 300):
        value = left[k] * value + np.sqrt(1 - left[k] ** 2) * normal[k]
        assert found[k] == pytest.approx(value, abs=1e-12)


def test_a_process_is_stationary_and_forgets_exponentially():
    steps = np.full(200_000, 0.1)
    values = correlated(
        steps, np.random.default_rng(3).standard_normal(), np.random.default_rng(4)
    )
    assert np.var(values) == pytest.approx(1, abs=0.03)
    for lag in (1, 5, 20):
        assert np.mean(values[lag:] * values[:-lag]) == pytest.approx(
            np.exp(-0.1 * lag), abs=0.03
        )


def test_at_rest_only_the_noise_changes(model):
    """Of one state: the mean is the slow part, the deviation the noise at the field's scale."""
    state = State(
        np.array([1.0, -1.0, 0.5]),
        np.array([0.3, 0.2, -1.0]),
        0.8,
        np.array([2.0, -3.0, 7.0]),
        1.0,
    )
    errors = model.draw(np.zeros(40_000), 0.1, np.random.default_rng(5), state)
    scales = np.exp(0.5 * (0.8 * model.scale - model.scale**2 / 2))
    slow = state.bias + scales * (model.field * state.field + model.pixel * state.pixel)
    assert errors.mean(axis=0) == pytest.approx(slow, abs=0.3)
    assert errors.std(axis=0) == pytest.approx(scales * model.noise[0], rel=0.02)


@pytest.mark.slow
def test_over_many_units_and_fields_the_variance_is_the_sum_of_the_terms(model):
    rng = np.random.default_rng(6)
    errors = np.array([model.draw(np.full(2, 1.0), 0.1, rng)[1] for _ in range(8000)])
    expected = (
        model.mean**2 + model.unit**2 + model.field**2 + model.pixel**2 + model.noise[1] ** 2
    )
    expected += model.thermal**2
    expected += model.along[1] ** 2 / 2 * np.array([1, 1, 0])
    assert np.mean(errors**2, axis=0) == pytest.approx(expected, rel=0.08)


@pytest.mark.slow
def test_steps_of_a_process_have_the_statistics_of_independent_draws(model):
    """Mean square and correlation from one step to the next at 2 degrees per second."""
    rng = np.random.default_rng(7)
    pairs = []
    for _ in range(3000):
        state = model.start(rng, unit=False)
        state, first = model.step(state, 2.0, 0.1, rng)
        pairs.append((first, model.step(state, 2.0, 0.1, rng)[1]))
    stepped = np.array(pairs) - model.mean
    drawn = np.array(
        [
            model.draw(np.full(2, 2.0), 0.1, rng, model.start(rng, unit=False))
            for _ in range(3000)
        ]
    )
    drawn -= model.mean
    for one, other in ((0, 0), (0, 1)):
        found, expected = (
            np.mean(each[:, one] * each[:, other], axis=0) for each in (stepped, drawn)
        )
        spread = np.sqrt(
            np.mean(stepped[:, 0] ** 2, axis=0) * np.mean(drawn[:, 0] ** 2, axis=0)
        )
        assert (found - expected) / spread == pytest.approx(np.zeros(3), abs=0.12)


def test_noise_is_larger_about_the_axis_of_the_rate(model):
    """At 4 degrees per second about an axis at 30 degrees from x: sqrt(4^2 + 5^2) about it, 4 about the other."""
    state = model.start(np.random.default_rng(1))._replace(axis_rad=np.pi / 6)
    noise = model.drawn_noise(np.full(100_000, 4.0), state.axis_rad, np.random.default_rng(3))
    about = noise[:, :2] @ [np.cos(np.pi / 6), np.sin(np.pi / 6)]
    other = noise[:, :2] @ [-np.sin(np.pi / 6), np.cos(np.pi / 6)]
    assert [about.std(), other.std()] == pytest.approx([np.hypot(4, 5), 4], rel=0.01)
    assert noise[:, 2].std() == pytest.approx(30, rel=0.01)


@pytest.mark.parametrize("turned_deg", [0.0, 0.05, 3.0])
def test_correlations_match_those_of_simulated_draws(model, turned_deg):
    """Of pairs of errors that the boresight's turn separates, at rest and at a rate: each pair in another field."""
    rate_deg_s = 2.0
    count = 150_000
    rng = np.random.default_rng(11)
    normal = {
        name: rng.standard_normal((2, count, width))
        for name, width in (("field", 3), ("pixel", 3), ("scale", 1))
    }
    for name, one in normal.items():
        left = np.exp(-turned_deg / model.constants[f"{name}_deg"])
        one[1] = left * one[0] + np.sqrt(1 - left**2) * one[1]
    rates = np.full(count, rate_deg_s)
    axis_rad = rng.uniform(0, 2 * np.pi, count)
    noise = np.stack([model.drawn_noise(rates, axis_rad, rng) for _ in range(2)])
    slow = model.field * normal["field"] + model.pixel * normal["pixel"]
    errors = np.stack([model.scales(scale[:, 0]) for scale in normal["scale"]]) * (
        slow + noise
    )
    found = np.mean(errors[0] * errors[1], axis=0) / np.mean(errors**2, axis=(0, 1))
    assert found == pytest.approx(model.correlation(turned_deg, rate_deg_s), abs=0.02)


@pytest.mark.parametrize(
    ("angle_deg", "rate_deg_s"), [(0.0, 0.0), (0.01, 2.5), (2.0, 1.0), (9.0, 4.0)]
)
def test_a_correlation_is_the_mean_product_by_quadrature(
    model: ErrorModel, angle_deg: float, rate_deg_s: float
) -> None:
    """Gauss-Hermite over two normal numbers of the scales; slow terms share their exponentials, the noise nothing."""
    x, weight = np.polynomial.hermite_e.hermegauss(40)
    weight = weight / weight.sum()
    left = np.exp(-angle_deg / CONSTANTS["scale_deg"])
    first = model.scales(x)[:, None]
    second = model.scales((left * x[:, None] + np.sqrt(1 - left**2) * x).ravel())
    second = second.reshape(40, 40, 3)
    scales = np.einsum("i,j,ijk->k", weight, weight, first * second)
    slow = model.field**2 * np.exp(-angle_deg / CONSTANTS["field_deg"])
    slow = slow + model.pixel**2 * np.exp(-angle_deg / CONSTANTS["pixel_deg"])
    rates = CONSTANTS["rates_deg_s"]
    noise = np.array(
        [np.interp(rate_deg_s, rates, one) for one in np.transpose(CONSTANTS["noise"])]
    )
    along = np.interp(rate_deg_s, rates, CONSTANTS["along"])
    square = model.field**2 + model.pixel**2 + noise**2 + along**2 * np.array([0.5, 0.5, 0])
    # The mean of the squared scale is 1.
    assert model.correlation(angle_deg, rate_deg_s) == pytest.approx(scales * slow / square)
    assert model.correlation(-angle_deg, -rate_deg_s) == pytest.approx(scales * slow / square)


@pytest.mark.parametrize("rate_deg_s", [4.1, -50.0, np.nan])
def test_a_rate_beyond_the_measured_ones_is_refused(model, rate_deg_s):
    """Not the noise of the last one: by draws, steps and correlations; the last rate itself is allowed."""
    rng = np.random.default_rng(1)
    message = "rate_deg_s: .* deg/s; allowed: up to 4 deg/s, as measured"
    model.draw([0.0, -4.0], 0.1, rng)
    for call in (
        lambda: model.draw([0.0, rate_deg_s], 0.1, rng),
        lambda: model.step(model.start(rng), rate_deg_s, 0.1, rng),
        lambda: model.correlation(1.0, rate_deg_s),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_more_than_a_hundred_thousand_errors_a_second(model):
    """A million in the best of three runs: ten times what is asked, even on a busy machine."""
    rng = np.random.default_rng(8)
    rates = np.full(100_000, 1.0)
    seconds = []
    for _ in range(3):
        begun = time.process_time()
        model.draw(rates, 0.1, rng)
        seconds.append(time.process_time() - begun)
    assert min(seconds) < 1.0


def test_the_error_model_runs_without_skysim(tmp_path: Path) -> None:
    """A copy of the module needs only NumPy and its constants."""
    model_fit.write_model(tmp_path, CONSTANTS)
    code = (
        "import sys, numpy; from tracker_error import ErrorModel; m = ErrorModel.read('tracker_error.json');"
        " print(m.draw(numpy.full(5, 1.0), 0.1, numpy.random.default_rng(1)).shape,"
        " [name for name in sys.modules if name.startswith(('skysim', 'estimator', 'scipy'))])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PATH": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split("\n")[0] == "(5, 3) []"


@pytest.mark.slow
def test_the_fmu_gives_the_same_errors_in_another_tool(
    tmp_path: Path, model: ErrorModel
) -> None:
    """fmpy runs it at 1.5 degrees per second: the errors are those of the model's own steps with that seed."""
    fmpy = pytest.importorskip("fmpy")
    pytest.importorskip("pythonfmu3")
    model_fit.write_model(tmp_path, CONSTANTS)
    path = model_fit.write_fmu(tmp_path)
    assert fmpy.read_model_description(str(path)).fmiVersion == "3.0"
    outputs = ["x_arcsec", "y_arcsec", "roll_arcsec"]
    result = fmpy.simulate_fmu(
        str(path),
        stop_time=2.0,
        output_interval=0.1,
        start_values={"seed": 5, "rate_deg_s": 1.5},
        output=outputs,
    )
    rng = np.random.default_rng(5)
    state = model.start(rng)
    expected = []
    for _ in range(len(result) - 1):
        state, errors = model.step(state, 1.5, 0.1, rng)
        expected.append(errors)
    assert len(result) == 21
    found = np.array([[row[name] for name in outputs] for row in result[1:]])
    assert found == pytest.approx(np.array(expected), rel=1e-6)


def test_the_scatter_of_fields_is_computed_from_two_estimates_of_each():
    """Noise whose variance is lognormal over the fields, seen by eight frames in each estimate."""
    rng = np.random.default_rng(9)
    variance = np.exp(0.7 * rng.standard_normal(60_000))
    first, second = (variance * rng.chisquare(7, 60_000) / 7 for _ in range(2))
    assert model_fit.log_scale(first, second) == pytest.approx(0.7, rel=0.05)
    assert model_fit.log_scale(first, first) > 0.8
    assert model_fit.log_scale(np.ones(9), np.ones(9)) == 0


def test_the_scatter_of_few_units_is_that_of_all_that_could_be_bought():
    """Three units of a batch with 0.5, 0.5 and 4": the mean of many squares has no bias."""
    rng = np.random.default_rng(13)
    sigma = np.array([0.5, 0.5, 4.0])
    squares = []
    for _ in range(1500):
        unit = sigma[:, None, None] * rng.standard_normal((3, 1, 3))
        other = sigma[:, None, None] * rng.standard_normal((3, 12, 3))
        squares.append(model_fit.unit_scatter((unit + other)[..., None, None, None]) ** 2)
    # Squares below 0, which have no root, are left at 0: about one in four.
    assert np.mean(squares, axis=0) == pytest.approx(sigma**2, rel=0.1)


def drawn_sheet(model: ErrorModel, fields: int) -> MeasuredFrames:
    """A datasheet of shefex2 whose errors are drawn from a model: every cell of a field at its turn and rate."""
    scene = load("shefex2", {})
    size = QUICK._replace(fields=fields)
    designer = Designer(scene, size)
    cells = list(designer.cells())
    rng = np.random.default_rng(12)
    turns = np.array([cell.settings.get("trial.turn_deg", 0.0) for cell in cells])
    rates = np.array([cell.settings.get("trial.rate_deg_s", 0.0) for cell in cells])
    order = np.argsort(turns)
    steps = np.diff(turns[order], prepend=turns[order][0])
    errors = np.empty((3, len(cells), fields))
    axis_rad = np.empty(fields)
    for field in range(fields):
        state = model.start(rng, unit=False)
        axis_rad[field] = state.axis_rad
        for row, step_deg in zip(order, steps, strict=True):
            state = turned(model, state, step_deg, rng)
            noise = model.drawn_noise(rates[[row]], state.axis_rad, rng)[0]
            slow = model.field * state.field + model.pixel * state.pixel
            errors[:, row, field] = state.bias + model.scales(np.array([state.scale]))[0] * (
                slow + noise
            )
    ones = np.ones((len(cells), fields))
    columns = dict(zip(AXES, errors, strict=True)) | {
        "solved": ones,
        "wrong": 0 * ones,
        "axis_rad": axis_rad * ones,
    }
    return MeasuredFrames(scene, "shefex2", {}, size, designer, cells, columns, None)


def turned(
    model: ErrorModel, state: State, step_deg: float, rng: np.random.Generator
) -> State:
    """The state after a rotation."""
    new = []
    for name in ("field", "pixel", "scale"):
        left = np.exp(-step_deg / model.constants[f"{name}_deg"])
        old = np.asarray(getattr(state, name))
        new.append(left * old + np.sqrt(1 - left**2) * rng.standard_normal(old.shape))
    return state._replace(field=new[0], pixel=new[1], scale=float(new[2]))


def test_errors_are_compared_by_the_turn_between_their_frames(model: ErrorModel):
    """The differences of the turns at which the cells of each sequence look; at rest all are 0."""
    sheet = drawn_sheet(model, 10)
    angles_deg, _, _ = model_fit.lagged(sheet, np.zeros(3))
    expected = []
    for rate in sheet.levels("sequence", "rate_deg_s"):
        rows = sheet.rows("sequence", rate_deg_s=rate)
        turns_deg = [sheet.cells[row].settings.get("trial.turn_deg", 0.0) for row in rows]
        expected += [late - early for early, late in combinations(turns_deg, 2)]
    assert angles_deg == pytest.approx(expected, abs=1e-9)
    assert angles_deg.max() > 0.1


@pytest.mark.slow
def test_a_model_agrees_with_new_fields_of_its_own_errors_and_not_with_others(
    monkeypatch: pytest.MonkeyPatch,
):
    """Fitted to half of 300 fields that a model drew; wrong noise and wrong memory are noticed in the other half.

    More than 5 % of the p-values are below 0.05, because the fit to 150 fields has errors of its own.
    """
    rates = {"rates_deg_s": [0.0, 0.28, 0.57, 1.1, 2.3], "along": [0.0, 0.5, 1.0, 2.0, 4.0]}
    truth = ErrorModel(CONSTANTS | rates | {"noise": [[1.0, 1.0, 10.0]] * 5})
    sheet = drawn_sheet(truth, 300)
    monkeypatch.setattr(
        model_fit, "axes_rad", lambda sheet, rate: sheet.columns["axis_rad"][0]
    )
    found = model_fit.agreements(sheet)
    assert [one.fitted for one in found] == ["even"] * 8 + ["odd"] * 8
    # All rates that the model accepts, those of pairs of one attitude too.
    assert [one.rate_deg_s for one in found[:8]] == model_fit.constants(sheet)["rates_deg_s"]
    assert np.mean([p > 0.05 for one in found for p in one.p_values]) >= 0.7
    # A sequence has fifteen pairs of frames, a faster rate one in each of 150 fields: 0.06 rms.
    for one in found:
        assert one.correlation == pytest.approx(
            one.expected_correlation, abs=0.1 if one.rate_deg_s <= 2.3 else 0.2
        )
    constants = model_fit.constants(sheet)
    assert constants["along"][:5] == pytest.approx(truth.along, abs=0.4)
    noisy = truth.constants | {"noise": [[2.0, 2.0, 20.0]] * 5}
    assert max(model_fit.agreement(ErrorModel(noisy), sheet, 0.0, "even").p_values) < 0.01
    fleeting = model_fit.agreement(
        ErrorModel(truth.constants | {"field_deg": 0.02}), sheet, 0.57, "even"
    )
    assert fleeting.correlation - fleeting.expected_correlation > 0.1


@pytest.mark.slow
def test_noise_at_a_rate_is_what_the_streak_and_the_slow_terms_leave(
    monkeypatch: pytest.MonkeyPatch,
):
    """Of errors that a model drew: noise of 2" on every axis, and 4" more about the rate's axis from 0.3 deg/s on."""
    rates = {"rates_deg_s": [0.0, 0.28, 2.3], "along": [0.0, 4.0, 4.0]}
    slow = {name: [0.3, 0.3, 2.0] for name in ("field", "pixel")}
    truth = ErrorModel(
        CONSTANTS | rates | slow | {"noise": [[2.0, 2.0, 10.0]] * 3, "scale": [0.2] * 3}
    )
    sheet = drawn_sheet(truth, 300)
    monkeypatch.setattr(
        model_fit, "axes_rad", lambda sheet, rate: sheet.columns["axis_rad"][0]
    )
    found = model_fit.constants(sheet)
    noise = np.array(found["noise"])[np.array(found["rates_deg_s"]) > 0.28]
    assert len(noise) >= 2
    assert np.sqrt(np.mean(noise**2, axis=0)) == pytest.approx([2.0, 2.0, 10.0], rel=0.12)
