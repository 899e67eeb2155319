"""Results of many trials: responses against theory, Sobol indices against known ones, exports."""

import csv
import math

import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc

from estimator.trackers.star_tracker import StarTracker
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.experiments.study import study_file, table, worst
from skysim.experiments.study.execution import engines, runner, store
from skysim.experiments.study.execution.outcomes import FIELDS
from skysim.experiments.study.execution.store import TIMES
from skysim.experiments.study.report import study_export, study_report
from skysim.results import metrics

STUDY = """schema: 1
title: a question
scene: shefex2
seed: 1
set: {light.limit_mag: 6.0}
trial: {kind: centroids, noise_px: 0.1, lights: 15}
factors:
  strays: {key: trial.false_lights, values: [0, 5]}
  focal: {key: camera.focal_length, values: ["20 mm", "-1 mm"]}
replicates: 4
responses: [identified, cross_arcsec_p95]
"""


def columns(**given):
    """Columns of trials; columns that are not given are NaN."""
    count = len(next(iter(given.values())))
    empty = {name: np.full(count, np.nan) for name in (*FIELDS, *TIMES)}
    return empty | {name: np.asarray(values, dtype=float) for name, values in given.items()}


def test_responses_compute_the_named_quantity():
    c = columns(
        frames=[1, 1, 1, 1, 0],
        solved=[1, 1, 1, 0, 0],
        wrong=[0, 0, 1, 0, 0],
        x_arcsec=[3, 0, 2000, np.nan, np.nan],
        y_arcsec=[4, 1, 0, np.nan, np.nan],
        roll_arcsec=[-12, 0, 0, np.nan, np.nan],
        nees=[3, 3, 1e5, np.nan, np.nan],
        stars=[7, 5, 4, 2, np.nan],
        ambiguous=[0, 0, 0, 1, 0],
        misidentified=[0, 0, 1, 0, np.nan],
        misled=[0, 0, 1, 0, np.nan],
        wrong_matches=[0, 0, 3, 0, np.nan],
        matched=[9, 0, 20, 1, 5],
        roll_noise=[1, 0, 0, 0, np.nan],
        streak_px=[1, 2, 6, 3, np.nan],
        centroid_px=[1, 1, 7, np.nan, np.nan],
    )
    said = {
        "ambiguous": 1 / 4,
        "misidentified": 1 / 4,
        "misled": 1 / 4,
        "roll_noise": 1 / 4,
        "mismatched": 3 / 30,
        "streak_px": 2.5,
        "centroid_px": math.sqrt(17),
        "nees": 33335.333333333336,
        "streak_px_worst": 6,
        "identified": 2 / 4,
        "wrong": 1 / 4,
        "refused": 1 / 4,
        "failed": 1 / 5,
        "overconfident": 1 / 3,
        "coverage": 2 / 4,
        "coverage_3": 3 / 4,
        "stars_least": 2,
        "stars_mean": 4.5,
        "cross_arcsec_median": 5,
        "roll_arcsec_worst": 12,
        "angle_arcsec_least": 1,
    }
    for name, value in said.items():
        assert metrics.response(name)(c).value == pytest.approx(value, rel=1e-12), name
    assert metrics.response("filter_arcsec_rms")(c) == metrics.NO_VALUE


def test_correct_covariances_are_not_called_overconfident():
    nees = stats.chi2.rvs(3, size=100_000, random_state=4)
    share = metrics.response("overconfident")(columns(nees=nees, frames=np.ones(len(nees))))
    assert share.value == 0
    assert stats.chi2.sf(
        stats.chi2.isf(metrics.OVERCONFIDENCE_PROBABILITY, 3), 3
    ) == pytest.approx(1e-8, rel=1e-6)


@pytest.mark.parametrize(
    "name", ["identify", "cross_arcsec", "cross_p95", "stars_p9", "coverage_", "_p95", ""]
)
def test_an_unknown_response_is_refused_with_the_known_ones(name):
    with pytest.raises(
        InputError,
        match=r"responses.2: unknown response .*; allowed: overconfident, identified",
    ):
        metrics.response(name, "responses.2")


def test_sobol_indices_of_two_outputs_match_a_hand_calculation():
    """f = (2 x + y, 3 z + x y) over the unit cube: V = 175/144; x: 51/175, y: 15/175, z: 108/175, x with y: 1/175."""
    shares = qmc.Sobol(6, rng=1).random(4096)
    a = shares[:, :3]
    b = shares[:, 3:]

    def f(u):
        return np.stack([2 * u[:, 0] + u[:, 1], 3 * u[:, 2] + u[:, 0] * u[:, 1]])

    mixed = np.stack([f(np.where(np.arange(3) == n, b, a)) for n in range(3)])
    first, total = table.generalized(f(a), f(b), mixed)
    assert first == pytest.approx(np.array([51, 15, 108]) / 175, abs=5e-3)
    assert total == pytest.approx(np.array([52, 16, 108]) / 175, abs=5e-3)


ERRORS = """schema: 1
title: an error budget
scene: afit_simsat
seed: 1
set:
  tracker.assumed_camera_body: ["0 mm", "0 mm", "381 mm"]
  tracker.survey: {rotation_deg: [0, 0, 0]}
  light.layout: {kind: random, count: 1400, cap_deg: 30}
  tracker.centroid_sigma_px: 0.2
trial: {kind: centroids, noise_px: 0.0, tilt_deg: [0, 10]}
factors:
  lever_x: {key: tracker.assumed_camera_body.0, distribution: normal, mean: "0 mm", sigma: "0.2 mm"}
  turn_x: {key: tracker.survey.rotation_deg.0, distribution: normal, mean: 0, sigma: 0.01}
  turn_z: {key: tracker.survey.rotation_deg.2, distribution: normal, mean: 0, sigma: 0.02}
design: {kind: saltelli, points: 8}
replicates: 3
responses: [identified]
"""


@pytest.mark.long
def test_the_error_budget_attributes_errors_to_their_factors(tmp_path):
    """A survey turned about z is roll alone, one about x is cross alone; a lever across is mostly cross: 0.2 mm at
    33 in of the camera's sight is 0.2 / 838 rad of a point's direction, of which the bearing's turn takes 1 - 15/48."""
    study_plan, kept = done(tmp_path, ERRORS)
    with kept as rows:
        found = {(one.response, one.factor): one for one in table.indices(study_plan, rows)}
    assert found["roll_arcsec", "turn_z"].total.value > 0.9
    assert found["cross_arcsec", "turn_z"].total.value < 0.05
    assert found["roll_arcsec", "turn_x"].total.value < 0.1
    assert (
        found["cross_arcsec", "turn_x"].total.value
        + found["cross_arcsec", "lever_x"].total.value
        > 0.9
    )
    drawn = np.degrees(1) * 3600 * 0.2 / (48 * 25.4)
    assert found["cross_arcsec", "lever_x"].rms_arcsec == pytest.approx(drawn, rel=0.6)


SWITCHED = """schema: 1
title: causes off and on
scene: afit_simsat
seed: 1
trial: {kind: centroids, noise_px: 0.1, tilt_deg: [0, 10]}
factors:
  leds: {key: tracker.survey.led_sigma, values: ["0 mm", "0.2 mm"]}
  lever: {levels: {exact: {tracker.survey.lever_sigma: "0 mm"}, surveyed: {}}}
replicates: 3
responses: [identified]
"""


@pytest.mark.parametrize(
    ("design", "first", "total"),
    [
        # Of variances 1, 4 and 16; 25 with all on, by an interaction of 4.
        ("factorial", (4 / 25, 16 / 25, 1 / 25), (8 / 25, 20 / 25, math.nan)),
        ("one_at_a_time", (4 / 21, 16 / 21, 1 / 21), (4 / 21, 16 / 21, math.nan)),
    ],
)
def test_switched_causes_have_their_parts_of_the_mean_square(
    tmp_path, monkeypatch, design, first, total
):
    path = tmp_path / "question.yaml"
    path.write_text(SWITCHED + f"design: {{kind: {design}}}\n")
    study_plan = study_file.load(path)
    assert table.switches_causes(study_plan.study)
    squares = {(0, 0): 1.0, (1, 0): 5.0, (0, 1): 17.0, (1, 1): 25.0}
    on = [
        (int(a != "0 mm"), int(b != "exact"))
        for a, b in (one.levels.values() for one in study_plan.points)
    ]
    errors = np.sqrt([squares[one] for one in on]) * np.array([[1.0], [-1.0]] * 4)
    monkeypatch.setattr(table, "complete_outputs", lambda plan, store, axes: errors)
    found = [one for one in table.indices(study_plan, None) if one.response == "roll_arcsec"]
    assert [one.factor for one in found] == ["leds", "lever", "the rest"]
    assert [one.first.value for one in found] == pytest.approx(first)
    assert [one.total.value for one in found] == pytest.approx(total, nan_ok=True)
    assert [one.rms_arcsec for one in found] == pytest.approx([2, 4, 1])
    assert found[0].first.low == pytest.approx(first[0])


@pytest.mark.parametrize(
    "levels", ['values: ["0.1 mm", "0.2 mm"]', 'values: ["0 mm", "0.1 mm", "0.2 mm"]']
)
def test_other_factors_than_switches_have_no_causes(tmp_path, levels):
    path = tmp_path / "question.yaml"
    path.write_text(SWITCHED.replace('values: ["0 mm", "0.2 mm"]', levels))
    assert not table.switches_causes(study_file.load(path).study)


def test_one_output_has_the_indices_of_many_equal_ones():
    """Saltelli with one replicate and one axis: SciPy drops the axis of a single output."""
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(2, 1, 16))
    ab = rng.normal(size=(3, 1, 16))
    one = table.generalized(a, b, ab)
    many = table.generalized(*(np.repeat(x, 2, axis=-2) for x in (a, b, ab)))
    assert one.shape == (2, 3)
    assert one == pytest.approx(many, rel=1e-12)


SAMPLED = """schema: 1
title: a sampled question
scene: shefex2
seed: 1
set: {light.limit_mag: 6.0}
trial: {kind: centroids, lights: 15}
factors:
  noise: {key: trial.noise_px, from: 0.05, to: 0.5}
  missing: {key: trial.missing, from: 0.0, to: 0.001}
design: {kind: lhs, points: 64}
responses: [cross_arcsec_p95, identified]
"""


@pytest.mark.slow
def test_sampled_points_are_evaluated_together(tmp_path):
    """64 points of a trial: a p95 of all has an interval, and the error depends on the noise alone."""
    study_plan, kept = done(tmp_path, SAMPLED)
    assert not study_plan.study.paired
    with kept as rows:
        columns = table.pooled(study_plan, rows)
        assert len({float(one) for one in columns["boresight_ra_deg"]}) == 64
        text = study_report.study_report(study_plan, rows).html()
    error = table.pooled_row(study_plan, columns, ["cross_arcsec_p95"]).responses
    assert error["cross_arcsec_p95"] == metrics.response("cross_arcsec_p95")(columns)
    assert error["cross_arcsec_p95"].needs == 0
    found = {factor: one for _, factor, one in table.rank_correlations(study_plan, columns)}
    assert found["noise"].low > 0 > found["missing"].low
    assert found["missing"].high > 0
    x = [one.levels["noise"] for one in study_plan.points]
    y = metrics.QUANTITIES["cross_arcsec"](columns)
    assert found["noise"].value == pytest.approx(stats.spearmanr(x, y).statistic)
    assert "more values" not in text
    assert "All points together" in text


def test_independent_factors_are_said_to_matter_in_at_most_one_study_of_twenty(tmp_path):
    """Bonett & Wright's intervals of six correlations together, of 100 samples of 30 of independent numbers."""
    path = tmp_path / "question.yaml"
    path.write_text(
        SAMPLED.replace("[cross_arcsec_p95", "[nees, stars_mean, cross_arcsec_p95")
    )
    study_plan = study_file.load(path)
    rng = np.random.default_rng(3)
    names = ("nees", "stars", "x_arcsec", "y_arcsec")
    said = 0
    for _ in range(100):
        trials = {name: rng.normal(size=30) for name in names} | {"point": np.arange(30)}
        found = table.rank_correlations(study_plan, trials)
        assert len(found) == 6
        said += any(one.low > 0 or one.high < 0 for *_, one in found)
    assert said <= 5 + 4 * math.sqrt(4.75)


@pytest.mark.parametrize("text", [ERRORS, SWITCHED])
def test_a_budget_without_trials_is_nan_and_no_error(tmp_path, text):
    path = tmp_path / "question.yaml"
    path.write_text(text)
    study_plan = study_file.load(path)
    with store.writing(tmp_path / "study.sqlite") as rows:
        runner.prepare_store(study_plan, rows, resume=False)
        found = table.indices(study_plan, rows)
    assert len(found) == 6
    assert all(math.isnan(one.total.value) for one in found)


def done(folder, text):
    """A study's plan and its finished store."""
    path = folder / "question.yaml"
    path.write_text(text)
    study_plan = study_file.load(path) if "-1 mm" not in text else loaded_with_a_fault(path)
    with store.writing(folder / "study.sqlite") as kept:
        runner.prepare_store(study_plan, kept, resume=False)
        runner.run(study_plan, kept, engines.Serial())
    return study_plan, store.open_store(folder / "study.sqlite")


FLIGHTS = """schema: 1
title: flights
scene: afit_simsat
seed: 1
set: {exposure.frames: 1}
trial: {kind: flight}
factors:
  noise: {key: camera.detector.read_noise_e, values: [5, 10]}
responses: [cross_arcsec_mean]
"""


@pytest.mark.slow
def test_the_worst_flights_are_ranked_by_their_value_and_replayed_with_telemetry(tmp_path):
    """Two flights of one direction are two; the attitude of a frame is not where a flight starts."""
    study_plan, kept = done(tmp_path, FLIGHTS)
    with kept as rows:
        found = worst.worst_of_levels(study_plan.study, rows, "cross_arcsec_mean", {})
        cross = metrics.QUANTITIES["cross_arcsec"](rows.columns())
        again = runner.replay(study_plan, rows, 1, tmp_path / "trial_1")
    assert [one.value for one in found] == sorted(cross.tolist(), reverse=True)
    assert [one.start for one in found] == ["", ""]
    assert not again.changed
    names = {path.name for path in again.files}
    assert names == {"frame_0000.fits", "report.html", "solutions.ecsv", "telemetry.ecsv"}


def loaded_with_a_fault(path):
    """A plan with a level of an invalid scene, which `load` would refuse before the first trial."""
    good = path.with_name("good.yaml")
    good.write_text(path.read_text().replace("-1 mm", "30 mm"))
    study_plan = study_file.load(good)
    bad = [
        point._replace(
            settings={
                key: "-1 mm" if value == "30 mm" else value
                for key, value in point.settings.items()
            }
        )
        for point in study_plan.points
    ]
    study_plan.points[:] = bad
    return study_plan


@pytest.mark.long
def test_exports_have_the_values_of_the_store(tmp_path):
    pandas = pytest.importorskip("pandas")
    pyarrow = pytest.importorskip("pyarrow.parquet")
    xarray = pytest.importorskip("xarray")
    study_plan, kept = done(tmp_path, STUDY)
    with kept as rows:
        for suffix in ("csv", "parquet", "zarr"):
            study_export.export(
                rows, study_plan.study.responses, tmp_path / f"trials.{suffix}"
            )
        columns = rows.columns()
        lines = table.table(rows, study_plan.study.responses)
        with pytest.raises(
            InputError, match=r"unknown file format '.xlsx'; allowed: .csv, .parquet, .zarr"
        ):
            study_export.export(rows, study_plan.study.responses, tmp_path / "trials.xlsx")
    with (tmp_path / "trials.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == study_plan.trials == 16
    assert [float(row["x_arcsec"] or "nan") for row in written] == pytest.approx(
        columns["x_arcsec"].tolist(), abs=0, nan_ok=True
    )
    frame = pandas.read_parquet(tmp_path / "trials.parquet")
    assert frame["strays"].tolist() == [0] * 8 + [5] * 8
    assert frame["status"].tolist() == [row["status"] for row in written]
    assert (
        pyarrow.read_schema(tmp_path / "trials.parquet").metadata[b"title"] == b"a question"
    )
    cube = xarray.open_zarr(tmp_path / "trials.zarr", consolidated=False)
    assert dict(cube.sizes) == {"strays": 2, "focal": 2}
    assert (
        float(cube.identified.sel(strays=5, focal="20 mm"))
        == lines[2].responses["identified"].value
    )
    assert not list(tmp_path.glob(".*"))


def test_a_csv_leaves_out_what_no_trial_has(tmp_path):
    """A study of centroids has no pointing error and no streak; the columns that are left are the store's, in order."""
    study_plan, kept = done(tmp_path, STUDY)
    with kept as rows:
        study_export.export(rows, study_plan.study.responses, tmp_path / "trials.csv")
        columns = table.trial_columns(rows)
    written = (tmp_path / "trials.csv").read_text().splitlines()[0].split(",")
    empty = {"pointing_arcsec", "filter_arcsec", "streak_px", "body_tilt_deg"}
    assert empty <= set(columns)
    assert empty & set(written) == set()
    assert {"trial", "status", "x_arcsec", "boresight_ra_deg", "strays"} <= set(written)
    assert written == [name for name in columns if name in written]


@pytest.mark.slow
def test_a_trial_is_replayed_with_its_frames(tmp_path):
    study_plan, kept = done(tmp_path, STUDY)
    with kept as rows:
        again = runner.replay(study_plan, rows, 9, tmp_path / "trial_9")
        assert again.changed == []
        assert again.row.seed == rows.trial(9)["seed"]
        assert [path.name for path in again.files] == ["frame_0000.fits"]
        assert all(path.is_file() for path in again.files + again.pictures)
        failed = runner.replay(study_plan, rows, 5, tmp_path / "trial_5")
        assert "camera.focal_length" in failed.row.error
        assert failed.files == []
        with pytest.raises(InputError, match="trial 16: not in the study; allowed: 0 to 15"):
            runner.replay(study_plan, rows, 16, tmp_path)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("1.59728308212 m", "1.597 m"),
        ("48 in", "48 in"),
        ("0.25 mm", "0.25 mm"),
        (0.123456, "0.1235"),
        ([0, 30], "0, 30"),
    ],
)
def test_a_level_is_formatted_briefly(value, text):
    assert table.format_level(value) == text


def test_a_trial_that_raises_in_its_tracker_is_replayed_with_its_frame(tmp_path, monkeypatch):
    study_plan, kept = done(tmp_path, STUDY)

    def broken(self, centroids, *_):
        raise ZeroDivisionError("in the tracker")

    monkeypatch.setattr(StarTracker, "solve_centroids", broken)
    with kept as rows:
        again = runner.replay(study_plan, rows, 9, tmp_path / "trial_9")
    assert "in the tracker" in again.row.error
    assert str(SCENES.parent) not in again.row.error
    assert [path.name for path in again.files] == ["frame_0000.fits"]
    assert again.pictures[0].is_file()


def test_a_store_of_a_changed_scene_is_not_resumed(tmp_path):
    (tmp_path / "mine.yaml").write_text("schema: 1\nbase: shefex2\n")
    study_plan, _ = done(
        tmp_path,
        STUDY.replace("scene: shefex2", "scene: mine.yaml").replace('"-1 mm"', '"30 mm"'),
    )
    with store.writing(tmp_path / "study.sqlite") as kept:
        runner.prepare_store(study_plan, kept, resume=True)
    (tmp_path / "mine.yaml").write_text("schema: 1\nbase: shefex2\ncamera: {f_number: 2.0}\n")
    with (
        store.writing(tmp_path / "study.sqlite") as kept,
        pytest.raises(InputError, match="the scene of point 0 has changed"),
    ):
        runner.prepare_store(study_plan, kept, resume=True)


def test_failed_trials_can_be_forgotten(tmp_path):
    study_plan, _ = done(tmp_path, STUDY)
    with store.writing(tmp_path / "study.sqlite") as kept:
        assert kept.counts() == {"done": 16, "failed": 8, "wrong": 0}
        kept.delete_failed()
        assert kept.done(16).sum() == 8
        runner.run(study_plan, kept, engines.Serial())
        assert kept.counts()["done"] == 16


def test_frames_of_one_flight_count_as_one_trial():
    """Two flights of a hundred frames each, all identified: the interval is of two, not of two hundred."""
    c = columns(frames=[100, 100], solved=[100, 100], wrong=[0, 0], nees=[500, 500])
    share = metrics.response("identified")(c)
    assert (share.value, share.trials) == (1.0, 2)
    assert share.low == pytest.approx(metrics.proportion(2, 2).low)
    assert metrics.response("overconfident")(c).trials == 0  # a flight's NEES is a mean


def test_a_table_has_a_row_for_every_point(tmp_path):
    study_plan, kept = done(tmp_path, STUDY)
    with kept as rows:
        lines = table.table(rows, study_plan.study.responses)
    assert [one.levels for one in lines] == [
        {"strays": strays, "focal": focal}
        for strays in (0, 5)
        for focal in ("20 mm", "30 mm")
    ]
    assert list(lines[0].responses) == ["identified", "cross_arcsec_p95"]
    said = [table.format_response(lines[1], name) for name in lines[1].responses]
    assert said == ["-", "-"]  # its scene cannot be
    assert lines[0].responses["identified"].trials == 4
