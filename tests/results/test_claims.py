"""The line of a run on claimed and real errors, and what frames of one survey can tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skysim.results.run_report import claims_text, summary
from skysim.results.scoring import FrameRow


def row(cross: float, roll: float, nees: float, share: float) -> FrameRow:
    return FrameRow(
        frame=0,
        t_s=0.0,
        rate_deg_s=0.0,
        status="solved",
        truth_deg=(0.0, 0.0, 0.0),
        estimate_deg=(0.0, 0.0, 0.0),
        cross_arcsec=cross,
        roll_arcsec=roll,
        detected=20,
        matched=20,
        rms_px=0.1,
        time_ms=1.0,
        wrong=False,
        cross_sigma_arcsec=15.0,
        roll_sigma_arcsec=20.0,
        nees=nees,
        survey_share=share,
    )


def test_claims_stand_beside_rms_errors_worked_out_by_hand() -> None:
    """Root of (3^2 + 4^2) / 2 is 3.54; NEES is a mean. An unsolved frame has no part in it."""
    rows = [row(3, -4, 1.0, 0.99), row(4, 3, 2.0, 0.97)]
    lost = replace(row(np.nan, np.nan, np.nan, np.nan), status="no identification")
    found = summary([*rows, lost])
    assert found["cross_arcsec_rms"] == pytest.approx(np.sqrt(12.5))
    assert found["roll_sigma_arcsec_rms"] == pytest.approx(20)
    text = claims_text([*rows, lost])
    assert text.startswith(
        "claimed 15″ cross, 20″ roll (1σ); real 3.54″ and 3.54″ (rms); NEES 1.5 (3 if true); 98 % of the claim is of"
        " one survey"
    )


@pytest.mark.parametrize("share", [0.05, np.nan])
def test_frames_with_errors_of_their_own_are_not_called_one_survey(share: float) -> None:
    assert claims_text([row(3, 4, 1.0, share)]).endswith("NEES 1 (3 if true)")


def test_a_tracker_without_claims_has_no_line() -> None:
    assert claims_text([row(3, 4, np.nan, np.nan)]) == ""
    assert "nees_mean" not in summary([row(3, 4, np.nan, np.nan)])
