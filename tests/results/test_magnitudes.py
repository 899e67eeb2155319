"""The run's report: PTASE's magnitude errors, by hand and over several frames, and the advice for refused frames."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.trackers.pipeline import Report
from skysim.results.run_report import magnitude_errors, magnitude_text, refusals, summary
from skysim.results.scoring import FrameRow, magnitude_errors_mag


def report(flux: list[float], v_mag: list[float] | None, observed: list[int]) -> Report:
    """A report on lights of which some are identified."""
    lights = Centroids(np.zeros((len(flux), 2)), np.ones(len(flux)), np.array(flux))
    magnitudes = None if v_mag is None else np.array(v_mag)
    rows = np.array(observed)
    match = StarMatch(rows, rows, Rotation.identity(), -9.0, magnitudes)
    return Report(Attitude("solved", Rotation.identity(), match=match), lights)


def row(frame: int, stars: int, mean: float, sigma: float) -> FrameRow:
    angles = (0.0, 0.0, 0.0)
    numbers = {"cross_arcsec": 1.0, "roll_arcsec": 1.0, "rms_px": 0.1, "time_ms": 1.0}
    return FrameRow(
        frame=frame,
        t_s=0.0,
        rate_deg_s=0.0,
        status="solved",
        truth_deg=angles,
        estimate_deg=angles,
        detected=stars,
        matched=stars,
        wrong=False,
        magnitude_error_mag=mean,
        magnitude_sigma_mag=sigma,
        **numbers,
    )


def test_a_frame_s_magnitude_errors_are_those_worked_out_by_hand() -> None:
    # 10, 5 (not identified) and 1 DN in 0.1 s: -2.5 lg 100 = -5 and -2.5 lg 10 = -2.5 mag, against 3.0 and 5.7.
    mean, sigma = magnitude_errors_mag(report([10.0, 5.0, 1.0], [3.0, 5.7], [0, 2]), 0.1)
    assert mean == pytest.approx((-8.0 - 8.2) / 2)
    assert sigma == pytest.approx(0.2 / np.sqrt(2))


def test_leds_have_no_magnitude_errors() -> None:
    assert np.isnan(magnitude_errors_mag(report([1.0, 2.0], None, [0, 1]), 0.1)).all()
    unsolved = [row(0, 0, np.nan, np.nan)]
    assert magnitude_errors(unsolved) == {}
    assert magnitude_text(unsolved) == ""
    assert "magnitude_stars" not in summary(unsolved)


def test_the_run_s_mean_and_deviation_are_those_of_all_stars_together() -> None:
    rng = np.random.default_rng(4)
    frames = [rng.normal(-13.8, 0.1, count) + shift for count, shift in ((5, 0.0), (20, 0.3))]
    rows = [row(n, len(e), e.mean(), e.std(ddof=1)) for n, e in enumerate(frames)]
    rows.append(row(2, 0, np.nan, np.nan))
    together = np.concatenate(frames)
    found = summary(rows)
    assert found["magnitude_stars"] == 25
    assert found["magnitude_error_mag_mean"] == pytest.approx(together.mean(), rel=1e-12)
    assert found["magnitude_error_mag_sigma"] == pytest.approx(
        together.std(ddof=1), rel=1e-12
    )
    assert magnitude_text(rows).startswith(
        "Magnitudes of 25 stars, measured (-2.5 log10 DN/s)"
    )


def test_too_few_stars_in_long_streaks_want_the_shorter_exposure_of_the_check() -> None:
    refused = [replace(row(0, 2, 0.0, 0.1), status="too few stars detected")]
    shorter = "exposure.time: images move by up to 125 px; change it to 4.9 ms"
    assert refusals(refused, ["light.catalog: short", shorter]) == [
        f"1 frames: too few stars detected; {shorter}"
    ]
    assert "expose longer" in refusals(refused, [])[0]
