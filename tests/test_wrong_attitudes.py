"""Random fields with false and missing lights never give a wrong attitude."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import project
from estimator.core.types import Centroids
from estimator.trackers.dome_tracker import DomeTracker
from skysim.results import metrics
from skysim.scene import loader
from skysim.simulation.lab import build_lab, build_tracker

FIELDS = 60


@pytest.fixture(scope="module")
def afit() -> DomeTracker:
    """The tracker of the AFIT scene: patch boards that repeat one 8 mm lattice all over the dome."""
    tracker = build_tracker(build_lab(loader.load("afit_simsat")).camera)
    assert isinstance(tracker, DomeTracker)
    return tracker


def body_from_lab(rng: np.random.Generator) -> Rotation:
    """Random body_from_lab with tilts uniform to 20 deg and any yaw."""
    tilt, azimuth, yaw = (
        np.radians(20) * np.sqrt(rng.uniform()),
        *rng.uniform(0, 2 * np.pi, 2),
    )
    lean = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0]))
    return (lean * Rotation.from_euler("z", yaw)).inv()


def field(
    tracker: DomeTracker,
    turned: Rotation,
    missing: float,
    false: int,
    rng: np.random.Generator,
) -> Centroids:
    """The LEDs wholly in view without a missing share, with 0.2 px of noise, and random false lights."""
    pixels = project(turned, tracker.leds.position_m, tracker.lever, tracker.camera)
    pixels = pixels[tracker.camera.contains(np.nan_to_num(pixels, nan=-1e9), 12)]
    pixels = pixels[rng.uniform(size=len(pixels)) >= missing]
    seen = pixels + 0.2 * rng.standard_normal(pixels.shape)
    strays = rng.uniform(
        (0, 0), (tracker.camera.width_px, tracker.camera.height_px), (false, 2)
    )
    xy = rng.permutation(np.vstack([seen, strays]))
    return Centroids(xy, np.full(len(xy), 0.2), np.ones(len(xy)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("missing", "false", "least_solved"),
    [
        (0.0, 0, 0.995),
        (0.0, 5, 0.995),
        (0.2, 5, 0.95),
        (0.5, 5, 0.3),
        (0.7, 10, 0.0),
        (1.0, 15, 0.0),
    ],
    ids=[
        "clean",
        "5 false",
        "a fifth missing",
        "half missing",
        "most missing",
        "only false lights",
    ],
)
@pytest.mark.parametrize(
    "fields", [FIELDS // 3, pytest.param(40 * FIELDS, marks=pytest.mark.long)]
)
def test_a_dome_is_never_solved_wrongly(afit, missing, false, least_solved, fields):
    solved = 0
    for n in range(fields):
        rng = np.random.default_rng([2012, n])
        turned = body_from_lab(rng)
        answer = afit.solve_centroids(field(afit, turned, missing, false, rng))
        if answer.cam_from_ref is None:
            continue
        solved += 1
        error = answer.cam_from_ref * (afit.lever.cam_from_body * turned).inv()
        assert not metrics.is_wrong(error.magnitude())
    assert solved >= least_solved * fields


@pytest.mark.long
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_a_mirrored_dome_is_refused(afit, missing):
    """What a left-right swapped cable would show: the same distances, the wrong hand."""
    for n in range(FIELDS // 3):
        rng = np.random.default_rng([2013, n])
        seen = field(afit, body_from_lab(rng), missing, 0, rng)
        mirrored = seen.xy_px * [-1, 1] + [afit.camera.width_px - 1, 0]
        answer = afit.solve_centroids(Centroids(mirrored, seen.sigma_px, seen.flux))
        assert answer.cam_from_ref is None
