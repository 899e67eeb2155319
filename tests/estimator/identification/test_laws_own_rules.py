"""Laws of triangle searches, of the papers' own rules of acceptance, and of directions from an assumed attitude."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog import pair_index
from estimator.core.vectors import normalized
from estimator.identification.chance import MIN_MATCHES
from estimator.identification.published.saa import AssumptionPool, Gates, SearchInput
from estimator.identification.published.triangles import triangle
from estimator.identification.refusals import OWN_RULE, advice
from estimator.identification.registry import IDENTIFIERS
from estimator.trackers.dome_tracker import assumed_directions
from estimator.trackers.pipeline import Settings
from tests.helpers.laws import SEEDS, law

LIMIT_MAG = "limit_mag"  # of the scene's tracker, whose catalog it shortens


@given(
    identifier=some.sampled_from(sorted(IDENTIFIERS)),
    lights=some.integers(0, 60),
    acceptance=some.sampled_from(["evidence", "thesis"]),
    in_field=some.floats(0.1, 100),
    cos_error=some.none() | some.floats(1e-6, 1e-3),
)
@law(advice)
def test_every_refusal_names_a_setting(
    identifier: str, lights: int, acceptance: str, in_field: float, cos_error: float | None
) -> None:
    text = advice(identifier, lights, acceptance, in_field, cos_error)
    assert cos_error is None or "centroid_sigma_px" not in text
    assert any(name in text for name in (*Settings.__slots__, "brightest", LIMIT_MAG))
    assert ("acceptance" not in text) or identifier in OWN_RULE


@given(rng=SEEDS, spherical=some.booleans())
@law(triangle, slow=True)
def test_triangles_name_noise_free_stars_or_none(rng: Generator, spherical: bool) -> None:
    """The stars of a field among 300 of the sky, in another order: each is named as itself."""
    stars = normalized(rng.standard_normal((300, 3)))
    index = pair_index.build(stars, 0.5)
    turn = Rotation.random(rng=rng)
    near = np.argsort(-stars @ normalized(rng.standard_normal((1, 3)))[0])[:9]
    match = triangle(spherical, turn.apply(stars[near]), index, 1e-6)
    if match:
        assert near[match.observed].tolist() == match.star.tolist()
        assert len(match.observed) >= MIN_MATCHES


@given(rng=SEEDS, named=some.integers(0, 12))
@law(AssumptionPool.is_complete)
def test_an_assumption_is_complete_with_four_named_stars(rng: Generator, named: int) -> None:
    rays = normalized(rng.uniform([-0.2, -0.2, 1.0], [0.2, 0.2, 1.0], (12, 3)))
    index = pair_index.build(rays, 0.5)
    magnitude = np.zeros(12)
    gates = Gates(1e-3, 1e-3, 0.5, 0.0)
    stars = SearchInput(rays, magnitude, rays, magnitude, index.cells, gates)
    pool = AssumptionPool(stars, (-0.1, -0.1, 0.1, 0.1), 0.5)
    pool.star[rng.permutation(12)[:named]] = 7
    assert pool.is_complete == (named >= MIN_MATCHES)


@given(rng=SEEDS)
@law(assumed_directions)
def test_directions_at_the_true_attitude_are_those_from_the_bearing(rng: Generator) -> None:
    """Eq. 33 of Padro 2012 on an ellipsoid; on another attitude's rays it is at other distances."""
    axes_m = np.array([1.0, 1.0, 1.3])
    toward = rng.uniform([-0.3, -0.3, 0.8], [0.3, 0.3, 1.0], (6, 3))
    place_m = toward / np.linalg.norm(toward / axes_m, axis=1, keepdims=True)
    leds = LedMap(np.arange(6), place_m, np.zeros(3), axes_m)
    lever = Lever(np.array([0.02, -0.01, 0.38]), Rotation.from_rotvec([0.0, 0.0, 0.3]))
    angles_deg = rng.uniform(-8, 8, 3)
    lab_from_body = Rotation.from_euler("ZYX", angles_deg[::-1], degrees=True)
    cam_from_lab = lever.cam_from_body * lab_from_body.inv()
    rays = normalized(
        cam_from_lab.apply(place_m) - lever.cam_from_body.apply(lever.camera_body_m)
    )
    roll_deg, pitch_deg, yaw_deg = angles_deg.tolist()
    found = assumed_directions(rays, leds, lever, (roll_deg, pitch_deg, yaw_deg))
    assert found == pytest.approx(normalized(cam_from_lab.apply(place_m)), abs=1e-9)
    other = assumed_directions(rays, leds, lever, (roll_deg + 10, pitch_deg, yaw_deg))
    assert np.abs(other - found).max() > 1e-4
