"""Fluxes that the tracker expects of LEDs by their data sheet, against rendered frames."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.scene import loader
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import build_lab, build_tracker
from skysim.tracking.factory import solve_frame

LEVELS = {
    "light.led.code": "null",
    "tracker.decoder": "null",
    "light.layout.count": "1400",
    "light.layout.levels": "[1, 0.5, 0.25]",
    "tracker.brightness_sigma": "0.15",
    "motion.control": "null",
    "motion.maneuver": "[]",
}


@pytest.mark.slow
@pytest.mark.parametrize("drive", [{}, {"light.led.drive": "{kind: direct}"}])
def test_measured_fluxes_scatter_as_the_leds_do(drive: dict[str, str]) -> None:
    """By 8 % from LED to LED, as the scene has it, and little more; and every attitude of the spiral is found."""
    lab = build_lab(loader.load("coded_spiral", LEVELS | drive))
    tracker = build_tracker(lab.camera)
    ratios = []
    for index in range(6):
        tilt = Rotation.from_euler("zyx", [60 * index, 4 * index, -3 * index], degrees=True)
        frame, truth = render_at_rest(lab.camera, tilt, index)
        report = solve_frame(tracker, frame)
        assert report.attitude.solved
        match = report.attitude.match
        flux_s = report.centroids.flux[match.observed] / frame.exposure_s
        ratios += np.log(flux_s / tracker.leds.flux_s[match.star]).tolist()
        assert set(tracker.leds.id[match.star]) <= set(truth.sources.id)
    assert len(ratios) > 60
    assert np.mean(ratios) == pytest.approx(0, abs=0.04)
    assert np.std(ratios) == pytest.approx(0.08, abs=0.025)
