"""Brightness as evidence for an LED: its Bayes factor, and a regular dome identified by brightness alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.identification import led_detections
from estimator.identification.led_detections import STRAY, STRAY_DENSITY
from estimator.identification.led_index import build_dome_index
from estimator.trackers.dome_tracker import DomeTracker
from tests.helpers.interpreted import interpreted

CAMERA = Camera(1600, 1200, 8698.0, (799.5, 599.5))
LEVER = Lever(np.array([0.0, 0.0, 0.381]), Rotation.identity())
FLUX_S = 2e5
SIGMA = 0.15
LEVELS = np.array([1.0, 0.5, 0.25])


def grid(levels: Floats | None, pitch_m: float = 0.03, side: int = 21) -> LedMap:
    """LEDs on a square grid on a flat panel with random flux levels; positions alone are ambiguous."""
    axis = pitch_m * (np.arange(side) - side // 2)
    place_m = np.column_stack(
        [*(one.ravel() for one in np.meshgrid(axis, axis)), np.full(side**2, 1.2192)]
    )
    leds = LedMap(
        np.arange(side**2),
        place_m,
        np.zeros(3),
        np.array([np.inf, np.inf, 1.2192]),
        sigma_m=1e-4,
    )
    if levels is None:
        return leds
    flux_s = FLUX_S * np.random.default_rng(4).choice(levels, side**2)
    return replace(leds, flux_s=flux_s, flux_sigma=SIGMA)


def test_the_evidence_of_a_brightness_is_a_bayes_factor() -> None:
    """Its ratio integrates to one over brightnesses of any LED, and its terms are a normal's and a stray light's."""
    evidence = interpreted("estimator.identification.led_detections")
    dome = build_dome_index(grid(LEVELS), LEVER, CAMERA)
    log_flux = np.linspace(np.log(FLUX_S) - 5, np.log(FLUX_S) + 5, 4001)
    rays = np.tile([0.0, 0.0, 1.0], (len(log_flux), 1))
    detections = led_detections.build_detections(
        rays, np.full(len(rays), 1e-5), dome, flux_s=np.exp(log_flux)
    )
    as_any = np.mean(
        [norm.pdf(log_flux, np.log(flux), SIGMA) for flux in grid(LEVELS).flux_s], axis=0
    )
    as_any = (1 - STRAY) * as_any + STRAY * STRAY_DENSITY
    np.testing.assert_allclose(detections.light_density, as_any, rtol=1e-9)
    for star in (0, 5, 17):
        ratio = 10.0 ** np.array(
            [evidence.light_dex(detections, dome, n, star) for n in range(len(log_flux))]
        )
        assert np.trapezoid(ratio * as_any, log_flux) == pytest.approx(1.0, abs=1e-3)
        best = log_flux[np.argmax(ratio)]
        assert abs(best - np.log(grid(LEVELS).flux_s[star])) < 0.2
        # A blend costs three powers of ten at most.
        assert ratio.min() >= STRAY * STRAY_DENSITY / as_any.max()


@pytest.mark.parametrize("known", ["map", "exposure", "neither"])
def test_without_brightness_the_evidence_depends_on_positions_alone(known: str) -> None:
    evidence = interpreted("estimator.identification.led_detections")
    dome = build_dome_index(grid(LEVELS if known == "map" else None), LEVER, CAMERA)
    flux_s = np.full(3, FLUX_S) if known == "exposure" else None
    detections = led_detections.build_detections(
        CAMERA.rays(np.eye(3, 2) * 100), np.full(3, 1e-5), dome, flux_s=flux_s
    )
    assert evidence.light_dex(detections, dome, 1, 2) == 0.0


@pytest.mark.slow
def test_brightness_distinguishes_the_fields_of_a_grid() -> None:
    """Equal LEDs on a grid are ambiguous everywhere; with three levels nearly all attitudes are found, none wrong."""
    leds = grid(LEVELS)
    trackers = {
        "equal": DomeTracker(CAMERA, grid(None), LEVER),
        "levels": DomeTracker(CAMERA, leds, LEVER),
    }
    rng = np.random.default_rng(6)
    found = dict.fromkeys(trackers, 0)
    for _ in range(40):
        body_from_lab = Rotation.from_euler(
            "zyx", [rng.uniform(0, 360), *rng.uniform(-6, 6, 2)], degrees=True
        )
        xy_px = project(body_from_lab, leds.position_m, LEVER, CAMERA)
        seen = np.flatnonzero(CAMERA.contains(np.nan_to_num(xy_px, nan=-1e9), 12))
        flux = leds.flux_s[seen] * 0.01 * np.exp(0.1 * rng.standard_normal(len(seen)))
        order = np.argsort(-flux)
        noisy_px = xy_px[seen] + 0.2 * rng.standard_normal((len(seen), 2))
        centroids = Centroids(noisy_px[order], np.full(len(seen), 0.2), flux[order])
        for name, tracker in trackers.items():
            solved = tracker.solve_centroids(centroids, exposure_s=0.01)
            found[name] += solved.solved
            if solved.solved:
                np.testing.assert_array_equal(
                    seen[order][solved.match.observed], solved.match.star
                )
        assert (
            not trackers["levels"].solve_centroids(centroids).solved
        )  # the exposure is unknown
    assert found["equal"] == 0
    assert found["levels"] >= 36


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"flux_s": np.zeros(441)}, "flux_s is 0 or less"),
        ({"flux_s": np.ones(3)}, r"leds: flux_s .*\(3,\)"),
        ({"flux_sigma": 0.0}, "leds: flux_sigma"),
    ],
)
def test_a_map_with_unusable_fluxes_is_refused(
    change: dict[str, object], reason: str
) -> None:
    with pytest.raises(ImageError, match=reason):
        DomeTracker(CAMERA, replace(grid(LEVELS), **change), LEVER)
