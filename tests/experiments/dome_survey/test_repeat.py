"""Repeated simulated surveys: one that fails is counted, and the others are kept."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from skysim.apps.cli.main import app
from skysim.core.errors import InputError
from skysim.experiments.dome_survey import procedure
from skysim.experiments.dome_survey.procedure import Errors


def test_a_survey_that_fails_does_not_lose_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first of three fails; the rms of the others is that of their mean squares."""
    found = iter([InputError("survey: too few"), Errors(1e-8, 4e-8, 1.0, 90, 0), Errors(3e-8, 4e-8, 9.0, 92, 1)])

    def run_survey(*_: object) -> Errors:
        one = next(found)
        if isinstance(one, InputError):
            raise one
        return one

    monkeypatch.setattr(procedure, "run_survey", run_survey)
    monkeypatch.setattr(procedure, "survey_errors", lambda run, *_: run)
    monkeypatch.setattr(procedure, "simulated_frames", lambda *_: [])
    command = ["survey", "afit_simsat", "--frames", "4", "--repeat", "3", "--json"]
    done = CliRunner().invoke(app, command)
    result = json.loads(done.stdout)
    assert result["failures"] == ["survey: too few"]
    assert result["measured"] == [90, 92]
    assert result["rows"][0]["simulated"] == pytest.approx(1e3 * 2e-8**0.5)
