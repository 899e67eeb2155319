"""Failing surveys: one of several repeated ones, and one that contradicts its assumptions."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from estimator.calibration.bundle_adjustment import Assumed
from skysim.apps.cli.main import app
from skysim.core.errors import InputError
from skysim.experiments.dome_survey import adjust, survey_frames, survey_procedure
from skysim.experiments.dome_survey.survey_procedure import SimulatedErrors


@pytest.mark.slow
def test_a_failed_survey_does_not_lose_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first of three fails; the rms of the others is that of their mean squares."""
    found = iter(
        [
            InputError("survey", "too few"),
            SimulatedErrors(1e-8, 4e-8, 1.0, 90, 0),
            SimulatedErrors(3e-8, 4e-8, 9.0, 92, 1),
        ]
    )

    def run_survey(*_: object) -> SimulatedErrors:
        one = next(found)
        if isinstance(one, InputError):
            raise one
        return one

    monkeypatch.setattr(survey_procedure, "run_survey", run_survey)
    monkeypatch.setattr(survey_procedure, "survey_errors", lambda run, *_: run)
    monkeypatch.setattr(survey_procedure, "simulated_frames", lambda *_: [])
    command = ["survey", "afit_simsat", "--frames", "4", "--repeat", "3", "--json"]
    done = CliRunner().invoke(app, command)
    result = json.loads(done.stdout)
    assert result["failures"] == ["survey: too few"]
    assert result["measured"] == [90, 92]
    assert result["rows"][0]["simulated"] == pytest.approx(1e3 * 2e-8**0.5)


@pytest.mark.parametrize(
    ("parameter", "refused"), [("focal px", True), ("lever z mm", True), ("focal px", False)]
)
def test_a_survey_that_contradicts_its_assumptions_is_refused(
    parameter: str, refused: bool
) -> None:
    """The frames alone give a value of sigma s, before that one of sigma p was assumed: they differ by hypot(s, p), and
    the weighted mean of both moves from the assumed one by p^2 / (s^2 + p^2) of this."""
    assumed = survey_frames.survey_uncertainty()
    focal_px = 9222.6
    share = adjust.PLAUSIBLE * (1.01 if refused else 0.99)

    def moved(frames_sigma: float, before_sigma: float) -> tuple[float, float]:
        """Shift of the mean for frames with an error of `share`, and its standard deviation."""
        both = math.hypot(frames_sigma, before_sigma)
        return share * both * (before_sigma / both) ** 2, frames_sigma * before_sigma / both

    off_px, sigma_px = moved(180.0, assumed.focal_error * focal_px)
    off_m, sigma_m = moved(0.001, assumed.lever_sigma_m)
    off_px = off_px * (parameter == "focal px")
    off_m = off_m * (parameter == "lever z mm")
    before, found = (
        SimpleNamespace(
            camera=SimpleNamespace(focal_px=focal_px - focal),
            lever=SimpleNamespace(camera_body_m=np.array([0.0, 0.0, 0.381 - lever])),
            uncertainty=assumed,
        )
        for focal, lever in ((0.0, 0.0), (off_px, off_m))
    )
    accuracy = SimpleNamespace(
        lens_sigma=np.full(3, sigma_px), lever_sigma_m=np.full(3, sigma_m)
    )
    run = SimpleNamespace(survey=found, accuracy=accuracy)
    arm_m = before.lever.camera_body_m
    expected = Assumed(arm_m, assumed.lever_sigma_m, focal_px, assumed.focal_error * focal_px)
    if refused:
        with pytest.raises(
            InputError, match=f"survey: {parameter} .* contradicts the assumed"
        ):
            adjust.check_plausible(run, expected)  # type: ignore[arg-type]
    else:
        adjust.check_plausible(run, expected)  # type: ignore[arg-type]
