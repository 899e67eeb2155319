"""`skysim study` as it is typed: run, status, resume, report, export, replay, and what it says to a slip."""

import json
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
    """Type a command in a fresh folder with a study in it: its exit code, what it printed, what it complained of."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "question.yaml").write_text(STUDY)

    def enter(*words):
        monkeypatch.setattr(sys, "argv", ["skysim", *words])
        with pytest.raises(SystemExit) as end:
            main.main()
        told = capsys.readouterr()
        return end.value.code, told.out, told.err

    return enter


@pytest.mark.long
def test_a_study_from_its_run_to_its_replay(typed, tmp_path):
    code, out, _ = typed("study", "run", "question.yaml", "--engine", "serial")
    assert code == 0
    assert "60 of 60 trials, 0 failed, 0 wrong" in out
    assert (tmp_path / "out/question/report.html").is_file()
    code, out, _ = typed("study", "status", "question.yaml", "--json")
    told = json.loads(out)
    assert (code, told["done"], told["trials"], told["failures"]) == (0, 60, 60, [])
    code, out, _ = typed("study", "report", "question.yaml", "--json")
    assert json.loads(out)["points"]["strays"] == [0, 5]
    assert "skysim study run question.yaml" in (tmp_path / "out/question/report.html").read_text()
    assert typed("study", "export", "question.yaml", "all.csv")[0] == 0
    assert len((tmp_path / "all.csv").read_text().splitlines()) == 61
    code, out, _ = typed("study", "replay", "question.yaml", "31", "--json")
    told = json.loads(out)
    assert (code, told["point"], told["replicate"], told["changed"]) == (0, 1, 1, [])
    assert (tmp_path / told["pictures"][0]).is_file()


@pytest.mark.long
def test_a_study_that_ran_out_of_its_budget_is_resumed(typed):
    code, _, err = typed("study", "run", "question.yaml", "--engine", "serial", "--set", "budget={time: 1 us}")
    assert code == 0
    assert "within the budget; continue: skysim study resume question.yaml" in err
    code, _, err = typed("study", "run", "question.yaml", "--engine", "serial")
    assert code == 2
    assert "trials; allowed: skysim study resume" in err
    code, out, _ = typed("study", "resume", "question.yaml", "--engine", "serial")
    assert code == 0
    assert "of 60 trials" in out


def test_what_was_overridden_is_remembered(typed):
    words = ("question.yaml", "--engine", "serial", "--out", "here")
    assert typed("study", "run", *words, "--set", "replicates=3")[0] == 0
    assert json.loads(typed("study", "status", "question.yaml", "--out", "here", "--json")[1])["trials"] == 6


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            ("run", "question.yaml", "--engine", "ray"),
            "--engine: unknown engine 'ray'; allowed: pool, serial, dask",
        ),
        (("run", "question.yaml", "--engine", "dask"), "--scheduler: required with --engine dask"),
        (("run", "question.yaml", "--set", "replicates"), "--set replicates: allowed: path.to.key=value"),
        (("run", "question.yaml", "--set", "replicates=0"), "replicates: 0 is not allowed"),
        (("run", "nothing"), "nothing: no such study; allowed: a .yaml file or one of dome_"),
        (
            ("status", "question.yaml"),
            "out/question/study.sqlite: no such store; allowed: a store written by skysim study run",
        ),
        (("resume", "question.yaml", "--engine", "serial"), "no such store"),
        (
            ("optimize", "question.yaml", "--engine", "serial"),
            "has no key optimize; allowed: skysim study run",
        ),
    ],
)
def test_a_slip_is_told_in_one_line(typed, words, complaint):
    code, _, err = typed("study", *words)
    assert code == 2
    assert complaint in err
    assert len(err.strip().splitlines()) == 1


def test_the_studies_are_listed(typed):
    code, out, _ = typed("study", "--json")
    assert code == 0
    assert {"dome_shape", "dome_size", "led_count", "rate_smear", "false_stars", "end_to_end"} <= {
        entry["name"] for entry in json.loads(out)
    }
