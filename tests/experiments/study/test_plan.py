"""Study files: allowed contents, refusals before the first trial, and the shipped studies."""

import pytest

from skysim.core.errors import InputError
from skysim.core.paths import STUDIES, shipped_files
from skysim.experiments.study import plan, study_file

STUDY = """schema: 1
title: a question
scene: shefex2
seed: 1
set: {exposure.frames: 1}
trial: {kind: centroids, noise_px: 0.1}
factors:
  strays: {key: trial.false_lights, values: [0, 5]}
  focal: {key: camera.focal_length, from: "20 mm", to: "30 mm", steps: 3}
replicates: 4
responses: [identified, cross_arcsec_p95]
"""


def written(folder, text):
    path = folder / "question.yaml"
    path.write_text(text)
    return path


def test_a_plan_has_every_trial_of_every_point(tmp_path):
    study_plan = study_file.load(written(tmp_path, STUDY))
    assert (study_plan.name, len(study_plan.points), study_plan.trials) == ("question", 6, 24)
    scene, trial = plan.resolve_point(study_plan.spec, study_plan.points[4].settings)
    assert trial.false_lights == 5
    assert trial.noise_px == 0.1
    assert scene.camera.focal_length_m == pytest.approx(0.025, rel=1e-12)
    assert scene.exposure.frames == 1


def test_the_digest_covers_exactly_what_determines_the_trials(tmp_path):
    study_plan = study_file.load(written(tmp_path, STUDY))
    same = study_file.load(
        written(
            tmp_path, STUDY.replace("a question", "another").replace(", cross_arcsec_p95", "")
        )
    )
    assert same.digest == study_plan.digest
    for change in (
        ("seed: 1", "seed: 2"),
        ("noise_px: 0.1", "noise_px: 0.2"),
        ("replicates: 4", "replicates: 5"),
    ):
        assert (
            study_file.load(written(tmp_path, STUDY.replace(*change))).digest
            != study_plan.digest
        )


def test_an_override_changes_the_study(tmp_path):
    study_plan = study_file.load(
        written(tmp_path, STUDY), {"replicates": "7", "factors.strays.values": "[1, 2, 3]"}
    )
    assert study_plan.trials == 3 * 3 * 7


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            ("replicates: 4", "replicas: 4"),
            r"replicas: unknown key; did you mean replicates\?.*line 10\)",
        ),
        (
            ("cross_arcsec_p95", "cross_arcsec_p"),
            r"responses.1: unknown response 'cross_arcsec_p'; allowed: over.*line 11\)",
        ),
        (
            ("trial.false_lights", "trial.falselights"),
            r"factors.strays: 0: trial.falselights.*line 8\)",
        ),
        (
            ("camera.focal_length", "camera.focal"),
            r"factors.focal: '25 mm': camera.focal: unknown key",
        ),
        (
            ('"30 mm"', '"30 in"'),
            r"factors.focal: from '20 mm' and to '30 in' have different units.*line 9\)",
        ),
        (
            ('"20 mm"', '"0 mm"'),
            r"factors.focal: '0 mm': camera.focal_length: '0 mm' is not allowed",
        ),
        (("noise_px: 0.1", "noise_px: -1"), r"trial.*noise_px.*line 6\)"),
        (
            ("{exposure.frames: 1}", "\n  exposure.frames: 2\n  camera.f_number: -2"),
            r"camera.f_number: -2 is not allowed.*line 7\)",
        ),
        (
            ("kind: centroids", "kind: guesses"),
            r"trial.kind: unknown kind 'guesses'; allowed:",
        ),
        (
            ("  strays:", "  stars:"),
            r"factors.stars: the name is that of a column of the trials; allowed: another name.*line 8\)",
        ),
        (
            ("cross_arcsec_p95", "streak_px"),
            r"responses.1: streak_px in trials of kind centroids; allowed: of frames, flight.*line 11\)",
        ),
        (
            ("cross_arcsec_p95", "availability_mean"),
            "responses.1: availability_mean in trials of kind centroids; allowed: of",
        ),
        (
            ("cross_arcsec_p95", "ambiguous"),
            r"responses.1: no tracker of this study reports ambiguity; allowed: under a dome.*line 11\)",
        ),
        (
            ("scene: shefex2", "scene: collimated_display"),
            r"trial.kind: centroids with a collimated display",
        ),
        (("scene: shefex2", "scene: shefex3"), r"shefex3: no such scene; allowed:"),
        (
            ("replicates: 4", "replicates: 4\nbudget: {trials: 23}"),
            r"budget.trials: 23; allowed: at least 24",
        ),
        (
            (
                "replicates: 4",
                "replicates: 4\nfigures: [{kind: curve, x: rate, y: identified}]",
            ),
            r"figures.0.x: unknown factor 'rate'; allowed: strays, focal",
        ),
        (
            ("values: [0, 5]", "distribution: normal, mean: 0, sigma: 1"),
            r"factors.strays: a distribution has no",
        ),
    ],
)
def test_an_error_in_a_study_is_one_line_with_its_place(tmp_path, change, complaint):
    with pytest.raises(InputError, match=complaint) as raised:
        study_file.load(written(tmp_path, STUDY.replace(*change)))
    assert "\n" not in str(raised.value)
    assert "question.yaml" in str(raised.value)


def test_a_scene_beside_the_study_is_found_from_anywhere(tmp_path):
    (tmp_path / "mine.yaml").write_text("schema: 1\nbase: shefex2\ntitle: mine\n")
    study_plan = study_file.load(
        written(tmp_path, STUDY.replace("scene: shefex2", "scene: mine.yaml"))
    )
    assert plan.resolve_point(study_plan.spec, {})[0].title == "mine"


def test_an_unknown_study_is_refused():
    with pytest.raises(
        InputError, match=r"which: no such study; allowed: a .yaml file or one of .*dome_"
    ):
        study_file.load("which")


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    list(shipped_files(STUDIES).values()),
    ids=lambda path: path.stem,
)
def test_every_shipped_study_loads(path):
    """Every level of every factor makes a scene; `load` has tried them all."""
    study_plan = study_file.load(path)
    assert study_plan.study.title
    assert study_plan.trials or study_plan.study.optimize


COSINES = """schema: 1
title: how many angles?
scene: shefex2
seed: 1
set: {set}
trial: {{kind: centroids}}
factors: {{px: {{key: trial.noise_px, values: [0.1, 0.2]}}}}
responses: [angles_compared_mean]
"""


def test_compared_angles_are_of_the_identifier_that_counts_them(tmp_path):
    counts = COSINES.format(set="{tracker.identifier: shefex, tracker.cos_error: 5.5e-5}")
    assert study_file.load(written(tmp_path, counts)).trials == 2
    with pytest.raises(
        InputError, match=r"no identifier .* counts angles; allowed: tracker.id"
    ):
        study_file.load(written(tmp_path, COSINES.format(set="{tracker.identifier: saa}")))
    unused = counts.replace("identifier: shefex", "identifier: pyramid")
    with pytest.raises(
        InputError, match=r"cos_error: has no effect.*no tolerance of cosines"
    ):
        study_file.load(written(tmp_path, unused.replace("angles_compared_mean", "wrong")))


FLIGHT = """schema: 1
title: where from?
scene: {scene}
seed: 1
set: {{exposure.frames: 1}}
trial: {{kind: flight, start: {start}}}
factors: {{hz: {{key: exposure.rate_hz, values: [1, 2]}}}}
responses: [identified]
"""


def test_led_codes_without_a_flight_are_refused(tmp_path):
    """One frame shows one bit."""
    assert (
        study_file.load(
            written(tmp_path, FLIGHT.format(scene="coded_spiral", start="scene"))
        ).trials
        == 2
    )
    single = FLIGHT.format(scene="coded_spiral", start="scene").replace(
        "{kind: flight, start: scene}", "{kind: frames}"
    )
    with pytest.raises(
        InputError,
        match=r"frames with tracker\.decoder, which needs many; allowed: centroids, flight",
    ):
        study_file.load(written(tmp_path, single))


@pytest.mark.parametrize(
    ("scene", "start", "complaint"),
    [
        ("afit_simsat", "random", None),
        ("afit_simsat", "scene", None),
        ("shefex2", "{dec_deg: [0, 30]}", None),
        ("shefex2", "{near: {body: moon}}", None),
        (
            "afit_simsat",
            "{near: {body: moon}}",
            "trial.start.near: has no effect with light of kind dome",
        ),
        (
            "shefex2",
            "{near: {body: moon, off_deg: [5, 1]}}",
            "5 to 1; allowed: the smaller first",
        ),
        (
            "afit_simsat",
            "{tilt_deg: 31}",
            "trial.start.tilt_deg: 31; allowed: up to vehicle.tilt_stop_deg 30",
        ),
        (
            "afit_simsat",
            "{dec_deg: [0, 30]}",
            "trial.start.dec_deg: has no effect with light of kind dome",
        ),
        (
            "shefex2",
            "{tilt_deg: 5}",
            "trial.start.tilt_deg: has no effect with light of kind stars",
        ),
        (
            "collimated_display",
            "random",
            "trial.start: random with a collimated display; allowed: scene",
        ),
        (
            "shefex2",
            "anywhere",
            r"trial\.flight\.start|trial\.start: 'anywhere' is not allowed",
        ),
    ],
)
def test_a_random_start_must_be_possible_in_the_scene(scene, start, complaint, tmp_path):
    path = written(tmp_path, FLIGHT.format(scene=scene, start=start))
    if complaint is None:
        assert study_file.load(path).trials == 2
    else:
        with pytest.raises(InputError, match=complaint):
            study_file.load(path)


@pytest.mark.parametrize(
    ("axis", "complaint"),
    [
        ("sideways", "rate_axis: 'sideways' is not allowed"),
        (
            "{body: [0, 0, 0]}",
            "rate_axis: allowed: one of body and camera, a vector that is not zero",
        ),
        ("{body: [1, 0, 0], camera: [1, 0, 0]}", "allowed: one of body and camera"),
        ("{lab: [1, 0, 0]}", "rate_axis.lab: unknown key"),
    ],
)
def test_an_axis_is_a_name_or_a_vector(axis, complaint, tmp_path):
    trial = f"{{kind: frames, rate_deg_s: 1, rate_axis: {axis}}}"
    text = STUDY.replace("{kind: centroids, noise_px: 0.1}", trial).replace(
        "trial.false_lights", "seed"
    )
    with pytest.raises(InputError, match=complaint):
        study_file.load(written(tmp_path, text))


def test_a_study_without_factors_has_one_point(tmp_path):
    lines = [one for one in STUDY.splitlines() if not one.startswith(("factors", "  "))]
    one = study_file.load(written(tmp_path, "\n".join(lines)))
    assert (len(one.points), one.trials) == (1, 4)
    assert one.points[0] == ({}, {})
    sampled = "\n".join([*lines, "design: {kind: lhs, points: 4}"])
    with pytest.raises(InputError, match="factors: missing: lhs draws their values"):
        study_file.load(written(tmp_path, sampled))
    # What it sets is checked as that of a study with factors is.
    with pytest.raises(InputError, match=r"exposure\.frames"):
        study_file.load(
            written(tmp_path, "\n".join(lines).replace("frames: 1", "frames: -1"))
        )


def many(factors: int, values: int) -> str:
    """A study of so many factors, each of so many values."""
    one = f"{{key: trial.noise_px, values: {list(range(values))}}}"
    lines = "".join(f"  f{n}: {one}\n" for n in range(factors))
    head, tail = STUDY.split("  strays:")
    return head + lines + "replicates:" + tail.split("replicates:")[1]


@pytest.mark.parametrize(
    ("factors", "values", "design", "message"),
    [
        (
            8,
            50,
            "factorial",
            "design: factorial of 39062500000000 points; .*100000",
        ),
        (2, 317, "factorial", "design: factorial of 100489 points; .*100000"),
        (1, 9_000, "factorial", "factors: 9000 levels; allowed: up to 1000"),
        (3, 400, "one_at_a_time", "factors: 1200 levels; allowed: up to 1000"),
        (101, 2, "one_at_a_time", "factors: .*; allowed: at most 100 values"),
        (1, 3, "saltelli, points: 65536", "saltelli of 196608 points"),
        (1, 3, "lhs, points: 100001", "design.points: 100001 is not allowed; .* 100000"),
    ],
)
def test_counts_that_multiply_are_refused_before_the_points_are_made(
    tmp_path, monkeypatch, factors, values, design, message
):
    """A point is made from the options of its factors, the scene of a level is read in some milliseconds."""
    monkeypatch.setattr("skysim.experiments.study.factors.make_point", None)
    monkeypatch.setattr("skysim.experiments.study.study_file.resolve_point", None)
    text = many(factors, values) + f"design: {{kind: {design}}}\n"
    with pytest.raises(InputError, match=rf"{message}.*question\.yaml, line \d+"):
        study_file.load(written(tmp_path, text))
