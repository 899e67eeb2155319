"""`skysim study` as it is typed: run, status, resume, report, export, replay, and its messages for wrong input."""

import json
import re
import sqlite3
import sys

import pytest

from skysim.apps.cli import main

STUDY = """schema: 1
title: a question
scene: shefex2
seed: 1
set: {light.limit_mag: 6.0}
trial: {kind: centroids, noise_px: 0.1, lights: 15}
factors:
  strays: {key: trial.false_lights, values: [0, 5]}
replicates: 30
responses: [identified, cross_arcsec_p95]
"""


@pytest.fixture
def typed(tmp_path, monkeypatch, capsys):
    """Run a command in a new folder with a study; return exit code, standard output and error output."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "question.yaml").write_text(STUDY)

    def enter(*words):
        monkeypatch.setattr(sys, "argv", ["skysim", *words])
        with pytest.raises(SystemExit) as end:
            main.main()
        printed = capsys.readouterr()
        return end.value.code, printed.out, printed.err

    return enter


@pytest.mark.long
def test_a_study_is_run_reported_exported_and_replayed(typed, tmp_path):
    code, out, _ = typed("study", "run", "question.yaml", "--engine", "serial")
    assert code == 0
    assert "60 of 60 trials, 0 failed, 0 wrong" in out
    assert (tmp_path / "out/question/report.html").is_file()
    code, out, _ = typed("study", "status", "question.yaml", "--json")
    report = json.loads(out)
    assert (code, report["done"], report["trials"], report["failures"]) == (0, 60, 60, [])
    code, out, _ = typed("study", "report", "question.yaml", "--json")
    assert json.loads(out)["points"]["strays"] == [0, 5]
    assert (
        "skysim study run question.yaml"
        in (tmp_path / "out/question/report.html").read_text()
    )
    assert typed("study", "export", "question.yaml", "all.csv")[0] == 0
    assert len((tmp_path / "all.csv").read_text().splitlines()) == 61
    code, out, _ = typed("study", "replay", "question.yaml", "31", "--json")
    report = json.loads(out)
    assert (code, report["point"], report["replicate"], report["changed"]) == (0, 1, 1, [])
    assert (tmp_path / report["pictures"][0]).is_file()


@pytest.mark.long
def test_a_study_that_ran_out_of_its_budget_is_resumed(typed):
    code, _, err = typed(
        "study", "run", "question.yaml", "--engine", "serial", "--set", "budget={time: 1 us}"
    )
    assert code == 0
    assert "within the budget; continue: skysim study resume question.yaml" in err
    code, _, err = typed("study", "run", "question.yaml", "--engine", "serial")
    assert code == 2
    assert "trials; allowed: to resume the study, or another store" in err
    code, out, _ = typed("study", "resume", "question.yaml", "--engine", "serial")
    assert code == 0
    assert "of 60 trials" in out


@pytest.mark.slow
def test_overrides_are_kept_on_resume(typed):
    words = ("question.yaml", "--engine", "serial", "--out", "here")
    assert typed("study", "run", *words, "--set", "replicates=3")[0] == 0
    assert (
        json.loads(typed("study", "status", "question.yaml", "--out", "here", "--json")[1])[
            "trials"
        ]
        == 6
    )


@pytest.mark.slow
def test_a_study_named_by_its_folder_can_be_grown(typed, tmp_path):
    assert (
        typed("study", "run", "question.yaml", "--engine", "serial", "--set", "replicates=2")[
            0
        ]
        == 0
    )
    refused = typed(
        "study", "resume", "question.yaml", "--engine", "serial", "--set", "seed=2"
    )
    assert refused[0] == 2
    assert "another study" in refused[2]
    grow = ("study", "resume", "out/question", "--engine", "serial", "--set", "replicates=4")
    code, out, _ = typed(*grow)
    assert code == 0
    assert "8 of 8 trials" in out
    assert typed("study", "export", "out/question", "rows.csv")[0] == 0
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 9
    (tmp_path / "question.yaml").rename(tmp_path / "moved.yaml")
    code, _, err = typed("study", "export", "out/question", "rows.csv")
    assert code == 2
    assert err.strip().endswith("question.yaml; allowed: STUDY --out out/question")
    assert typed("study", "export", "moved.yaml", "rows.csv", "--out", "out/question")[0] == 0


@pytest.mark.long
def test_the_worst_trials_are_listed_with_their_replay_command(typed):
    assert typed("study", "run", "question.yaml", "--engine", "serial")[0] == 0
    code, out, _ = typed(
        "study", "worst", "question.yaml", "--response", "cross_arcsec_p95", "--json"
    )
    worst = json.loads(out)
    assert (code, len(worst)) == (0, 3)
    assert [one["cross_arcsec"] for one in worst] == sorted(
        (one["cross_arcsec"] for one in worst), reverse=True
    )
    assert worst[0]["command"] == f"skysim study replay question.yaml {worst[0]['trial']}"
    again = json.loads(
        typed("study", "replay", "question.yaml", str(worst[0]["trial"]), "--json")[1]
    )
    assert (again["boresight_ra_deg"], again["boresight_dec_deg"]) == (
        worst[0]["ra_deg"],
        worst[0]["dec_deg"],
    )
    words = ("study", "worst", "question.yaml", "--where", "strays=5", "--count", "2")
    _, out, _ = typed(*words, "--response", "cross_arcsec_p95")
    line = (
        r"^1\. RA [\d.]+°, Dec [+-][\d.]+°, \d+ lights: cross .*″, roll .*″ \(strays = 5\)$"
    )
    assert re.search(line, out, re.MULTILINE)
    assert (
        "no trial counts for misidentified" in typed(*words, "--response", "misidentified")[1]
    )
    for wrong, complaint in (
        (("--where", "strays=6"), "--where strays: unknown level 6; allowed: 0, 5"),
        (("--where", "star=6"), "--where: unknown factor 'star'; allowed: strays"),
        (("--where", "strays"), "--where: strays; allowed: FACTOR=LEVEL"),
        (("--response", "stray"), "--response: unknown response 'stray'"),
    ):
        code, _, err = typed("study", "worst", "question.yaml", *wrong)
        assert (code, len(err.strip().splitlines())) == (2, 1)
        assert complaint in err


def test_a_store_of_an_earlier_skysim_is_refused_in_one_line(typed, tmp_path):
    """Format 1 has no attitudes. It is neither resumed nor reported."""
    (tmp_path / "out/question").mkdir(parents=True)
    path = tmp_path / "out/question/study.sqlite"
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL)")
    db.execute("INSERT INTO meta VALUES ('format', '4')")
    db.commit()
    db.close()
    for words in (
        ("resume", "--engine", "serial"),
        ("run", "--engine", "serial"),
        ("report",),
        ("worst",),
        ("status",),
    ):
        code, _, err = typed("study", words[0], "question.yaml", *words[1:])
        assert code == 2
        assert err == (
            "skysim: out/question/study.sqlite: written by an earlier skysim, without all columns of the trials;"
            " allowed: run the study again, to another store\n"
        )


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            ("run", "question.yaml", "--engine", "ray"),
            "--engine: unknown engine 'ray'; allowed: pool, serial, dask",
        ),
        (
            ("run", "question.yaml", "--engine", "dask"),
            "--scheduler: required with --engine dask",
        ),
        (
            ("run", "question.yaml", "--set", "replicates"),
            "--set: replicates; allowed: path.to.key=value",
        ),
        (("run", "question.yaml", "--set", "replicates=0"), "replicates: 0 is not allowed"),
        (("run", "nothing"), "nothing: no such study; allowed: a .yaml file or one of "),
        (("run", "question"), "question: no such study; did you mean question.yaml?"),
        (
            ("list",),
            "Allowed: run, resume, status, report, export, replay, worst, optimize; `skysim study` alone lists.",
        ),
        (
            ("status", "question.yaml"),
            "out/question/study.sqlite: no such store; allowed: a store of a study's trials",
        ),
        (("resume", "question.yaml", "--engine", "serial"), "no such store"),
        (
            ("optimize", "question.yaml", "--engine", "serial"),
            "has no key optimize; allowed: skysim study run",
        ),
    ],
)
def test_wrong_input_is_refused_in_one_line(typed, words, complaint):
    code, _, err = typed("study", *words)
    assert code == 2
    assert complaint in err
    assert len(err.strip().splitlines()) == 1


def test_the_studies_are_listed(typed):
    code, out, _ = typed("study", "--json")
    assert code == 0
    assert {
        "dome_shape",
        "dome_size",
        "led_count",
        "rate_smear",
        "false_stars",
        "moon_and_planets",
        "end_to_end",
    } <= {entry["name"] for entry in json.loads(out)}
