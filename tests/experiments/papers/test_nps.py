"""NPS's distances from an assumed attitude, against geometry."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.trackers.dome_tracker import assumed_directions
from skysim.scene import loader
from skysim.simulation.lab import build_lab, build_tracker


def test_with_the_true_attitude_the_distances_are_true() -> None:
    """Eq. 33 of Padro 2012: R_0 + alpha b is the star's place; with another attitude it is not."""
    lab = build_lab(loader.load("nps_bench"))
    tracker = build_tracker(lab.camera)
    body_from_lab = Rotation.from_euler("ZYX", [2.0, -1.0, 3.0], degrees=True).inv()
    places_m = lab.camera.sources.place[:, :3]
    cam_from_lab = tracker.lever.cam_from_body * body_from_lab
    camera_m = tracker.lever.cam_from_body.apply(tracker.lever.camera_body_m)
    rays = cam_from_lab.apply(places_m) - camera_m
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    expected = cam_from_lab.apply(places_m)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    found = assumed_directions(rays, tracker.leds, tracker.lever, (3.0, -1.0, 2.0))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)
    wrong = assumed_directions(rays, tracker.leds, tracker.lever, (6.0, 2.0, 5.0))
    assert np.abs(wrong - expected).max() > 2e-3
