"""The published identifiers on small fields: laws of each step, run by the interpreter, which compiles nothing.

`test_pyramid`, `test_saa` and `test_fialho` have the Monte Carlo of the compiled algorithms.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from interpreted import interpreted
from scipy import stats
from scipy.spatial.transform import Rotation

from estimator.catalog import pair_index
from estimator.catalog.catalog import unit
from estimator.core.arrays import Floats
from estimator.identification.published import pyramid
from estimator.identification.published.saa_search import Gates, Primary, SearchInput
from estimator.identification.published.shefex import SearchOptions
from estimator.identification.registry import IDENTIFIERS

PLAIN = interpreted("estimator.identification.registry").IDENTIFIERS
PYRAMID, SHEFEX, SAA, DIRECT = (
    interpreted(f"estimator.identification.{name}")
    for name in ("published.pyramid", "published.shefex", "published.saa", "direct_match")
)
TOLERANCE_RAD = 1e-4
CAP_RAD, FIELD_RAD, MAX_ANGLE_RAD = 0.3, 0.12, 0.24


def cap(rng: np.random.Generator, count: int, radius_rad: float) -> Floats:
    """Unit vectors, uniform within an angle of z."""
    z, azimuth = rng.uniform(np.cos(radius_rad), 1, count), rng.uniform(0, 2 * np.pi, count)
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])


def field(seed: int, false: int = 0, count: int = 60) -> tuple[Floats, Floats, Floats, pair_index.PairIndex, Rotation]:
    """Rays of a field's stars in camera axes, brightest first, their magnitudes and rows (-1: false), index, truth."""
    rng = np.random.default_rng(seed)
    stars, magnitude, truth = cap(rng, count, CAP_RAD), np.linspace(1, 6, count), Rotation.random(rng=rng)
    index = pair_index.build(truth.inv().apply(stars), MAX_ANGLE_RAD, magnitude=magnitude)
    rows = np.flatnonzero(stars[:, 2] > np.cos(FIELD_RAD))
    rays = np.vstack([stars[rows], cap(rng, false, FIELD_RAD)])
    magnitude = np.concatenate([magnitude[rows], rng.uniform(1, 6, false)])
    order = np.argsort(magnitude)
    rows = np.concatenate([rows, np.full(false, -1)])
    return rays[order], magnitude[order], rows[order], index, truth


NAMES = [name for name in IDENTIFIERS if name != "default"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("false", [0, 2])
def test_every_method_names_the_stars_and_gives_their_attitude(name: str, false: int) -> None:
    """A false star among the brightest three stops the first two versions of Fialho's method, as published."""
    found, required = 0, (0 if name in ("fialho_1", "fialho_2") else 1) if false else 3
    for seed in range(3):
        rays, magnitude, rows, index, truth = field(seed, false)
        match = PLAIN[name](rays, index, TOLERANCE_RAD, magnitude=magnitude, epsilon_mag=0.1)
        if match is None:
            continue
        found += 1
        np.testing.assert_array_equal(match.star, rows[match.observed])
        assert len(match.star) >= 0.8 * np.count_nonzero(rows >= 0)
        assert (match.cam_from_ref * truth.inv()).magnitude() < 1e-13  # rounding over the field's 0.2 rad
        assert match.log10_chance < -5
    assert found >= required


@pytest.mark.parametrize("name", NAMES)
def test_no_method_takes_a_mirror_image(name: str) -> None:
    rays, magnitude, _, index, _ = field(0)
    match = PLAIN[name](rays * [-1, 1, 1], index, TOLERANCE_RAD, magnitude=magnitude, epsilon_mag=0.1)
    assert match is None


EDGES = (-0.05, 0.08, -0.07, 0.06)  # tangents of a field off its center


@pytest.mark.parametrize("name", ["pyramid", "saa"])
def test_each_catalog_star_of_the_field_that_is_not_seen_costs_its_penalty(name: str) -> None:
    rays, magnitude, _, index, _ = field(0, count=120)
    left, right, top, bottom = EDGES
    x, y = (rays[:, :2] / rays[:, 2:]).T
    inside = np.flatnonzero((x > left) & (x < right) & (y > top) & (y < bottom))
    assert len(inside) >= 8
    for missing in (1, 3):
        rows = inside[:-missing]
        known = {"magnitude": magnitude[rows], "epsilon_mag": 0.1, "field_tan": EDGES}
        free, charged = (
            PLAIN[name](rays[rows], index, TOLERANCE_RAD, missed_dex=dex, **known).log10_chance for dex in (0.0, 0.07)
        )
        assert charged - free == pytest.approx(0.07 * missing, abs=1e-12)


def test_a_match_counts_as_the_binomial_tail_of_its_gates() -> None:
    """Three of five random directions: their gates cover a share p of the sky of the catalog's local density."""
    rays, _, rows, index, _ = field(1)
    strays = unit(np.array([[0.1, 0.05, 1.0], [-0.08, 0.06, 1.0]]))
    seen, corners, hypotheses = np.vstack([rays, strays]), np.arange(3), 7
    for stretch in (0.0, 1e-3):
        match = DIRECT.match_field(seen, index, corners, rows[:3], 2e-3, stretch, hypotheses)
        assert match.observed.tolist() == list(range(len(rays)))
        neighbors = np.sum(np.linalg.norm(index.vectors - index.vectors[rows[0]], axis=1) < 2 * np.sin(0.12))
        density = neighbors / (2 * np.pi * (1 - np.cos(MAX_ANGLE_RAD)))
        radius = 2e-3 + stretch * np.arctan2(np.hypot(*seen[:, :2].T), seen[:, 2])
        p = -np.expm1(-density * np.pi * np.mean(radius**2))
        tail = stats.binom.logsf(len(rays) - 4, len(seen) - 3, p) / np.log(10)
        assert match.log10_chance == pytest.approx(tail + np.log10(hypotheses), abs=1e-9)


@pytest.mark.parametrize("zoom", [0.99, 1.01])
def test_pyramid_names_the_stars_of_a_lens_of_unknown_focal_length(zoom: float) -> None:
    rays, _, rows, index, truth = field(3)
    zoomed = unit(rays * [zoom, zoom, 1])
    match = PLAIN["pyramid"](zoomed, index, TOLERANCE_RAD, stretch=0.02, focal_unknown=True)
    np.testing.assert_array_equal(match.star, rows[match.observed])
    assert len(match.star) == len(rows)
    assert (match.cam_from_ref * truth.inv()).magnitude() < 2 * TOLERANCE_RAD


def triangle(sides_rad: Floats) -> Floats:
    """(3, 3) directions about z with these angles 01, 02 and 12: their dot products are a Cholesky factor's."""
    ij, ik, jk = np.cos(sides_rad)
    vectors = np.linalg.cholesky(np.array([[1, ij, ik], [ij, 1, jk], [ik, jk, 1]]))
    return Rotation.align_vectors([[0, 0, 1]], [vectors.sum(axis=0)])[0].apply(vectors)


@pytest.mark.parametrize(
    ("scale", "unknown", "hypotheses"),
    [
        ((1.014, 1.014, 1.014), True, 1),
        ((1.014, 0.986, 1.014), True, 0),
        ((0.986, 1.014, 1.014), True, 0),
        ((1.014, 1.014, 0.986), True, 0),
        ((1.014, 0.986, 1.014), False, 1),
        ((1.018, 1.0, 1.0), False, 0),
        ((1.0, 1.018, 1.0), False, 0),
        ((1.0, 1.0, 1.018), False, 0),
    ],
)
def test_a_triangle_s_sides_must_agree_on_one_focal_length(
    scale: tuple[float, float, float], unknown: bool, hypotheses: int
) -> None:
    """The stretch of 0.015 is one factor of all sides if the focal length is unknown, and else each side's own."""
    sides = np.array([0.1, 0.12, 0.14])
    index = pair_index.build(triangle(sides * scale), 0.2)
    options = pyramid.SearchOptions(1e-5, 0.015, unknown, 10, 1000, 3, 0.0, -1.0, 1.0, -1.0, 1.0)
    tried = np.zeros(3, np.int64)
    PYRAMID._triangle(triangle(sides), index, np.arange(3), options, tried)
    assert tried[1] == hypotheses


# ---- the areas of gates -----------------------------------------------------------------------------------------------


def crossing_area_sr(center: Floats, rings: list[tuple[Floats, float]], step: float = 2e-5) -> float:
    """Area where rings about stars cross: each of directions as far from its star as `center`, to a half-width."""
    steps = np.arange(-150, 151) * step
    across, down = np.linalg.svd(center[None])[2][1:]
    places = center + steps[:, None, None] * across + steps[:, None] * down
    inside = np.ones(places.shape[:2], bool)
    for star, half_width in rings:
        angles = np.arctan2(np.linalg.norm(np.cross(places, star), axis=2), places @ star)
        inside &= np.abs(angles - np.arctan2(np.linalg.norm(np.cross(center, star)), center @ star)) < half_width
    return float(inside.sum() * step**2)


def test_shefex_s_gates_have_the_least_area_of_their_crossing_rings() -> None:
    rays = unit(np.array([[0.1, 0.02, 1], [-0.06, 0.08, 1], [-0.03, -0.09, 1], [0.02, 0.03, 1], [0.06, -0.08, 1]]))
    options = SearchOptions(1e-5, 1e-6, 100, 10**6, 5)
    gates = SHEFEX._angle_gates(rays, np.arange(3), options)
    assert (gates[:3, 9] == 0).all()
    for n in (3, 4):
        half = (gates[n, 3:6] - gates[n, :3]) / 2
        pairs = [(0, 1), (1, 2), (2, 0)]
        areas = [crossing_area_sr(rays[n], [(rays[a], half[a]), (rays[b], half[b])]) for a, b in pairs]
        assert gates[n, 9] == pytest.approx(min(areas), rel=0.03)  # of the lattice, and of the rings' curvature


def test_shefex_counts_the_other_stars_in_the_gates_by_the_binomial_law() -> None:
    rays, _, rows, index, _ = field(2)
    options, tried = SearchOptions(2e-5, TOLERANCE_RAD, 100, 10**6, 12), np.zeros(3, np.int64)
    match = SHEFEX.search(rays, index, options, tried)
    np.testing.assert_array_equal(match.star, rows[match.observed])
    neighbors = np.sum(np.linalg.norm(index.vectors - index.vectors[match.star[0]], axis=1) < 2 * np.sin(0.12))
    density = neighbors / (2 * np.pi * (1 - np.cos(MAX_ANGLE_RAD)))
    area_sr = SHEFEX._angle_gates(rays, match.observed[:3], options)[:, 9].sum()
    p = -np.expm1(-density * area_sr / (len(rays) - 3))
    tail = stats.binom.logsf(len(match.star) - 4, len(rays) - 3, p) / np.log(10)
    assert match.log10_chance == pytest.approx(tail + np.log10(tried[0]), abs=1e-9)


def test_a_star_and_its_mirror_image_in_the_base_are_on_different_sides() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        rays = cap(rng, 4, 0.2)
        volumes = [np.linalg.det(rays[[m, (m + 1) % 3, 3]]) for m in range(3)]
        far = int(np.argmax(np.abs(volumes)))
        normal = unit(np.cross(rays[[far]], rays[(far + 1) % 3]))[0]
        mirrored = rays[3] - 2 * (rays[3] @ normal) * normal
        index = SimpleNamespace(vectors=Rotation.random(rng=rng).apply(np.vstack([rays, mirrored])))
        corners = np.arange(3)
        assert SHEFEX._same_side(rays, index, corners, corners, 3, 3)
        assert not SHEFEX._same_side(rays, index, corners, corners, 3, 4)


# ---- SAA ----------------------------------------------------------------------------------------------------------------

SEPARATION_RAD, POSITION_RAD, STRETCH = 1e-4, 1e-2, 1e-4
FIVE = unit(np.array([[0.1, 0.02, 1], [-0.06, 0.08, 1], [-0.03, -0.09, 1], [0.02, 0.03, 1], [0.15, -0.12, 1]]))


def primary_of(rays: Floats, position_rad: float = POSITION_RAD) -> Primary:
    """The primary pair of stars 0 and 2, without magnitudes."""
    unknown = np.full(len(rays), np.nan)
    gates = Gates(SEPARATION_RAD, position_rad, np.inf, STRETCH)
    return SAA.build_primary(SearchInput(rays, unknown, rays, unknown, None, gates), 0, 2)


def test_saa_s_gates_of_angles_cross_in_an_area_about_each_star() -> None:
    primary = primary_of(FIVE)
    assert primary.others.tolist() == [1, 3, 4]
    for k, n in enumerate(primary.others):
        rings = []
        for side, row in enumerate(primary.rows):
            angle = np.arccos(FIVE[n] @ FIVE[row])
            assert primary.corner_rad[side, k] == pytest.approx(angle, abs=1e-12)
            assert primary.gate_rad[side, k] == pytest.approx(3 * SEPARATION_RAD + STRETCH * angle, rel=1e-9)
            rings.append((FIVE[row], primary.gate_rad[side, k]))
        assert primary.area_sr[k] == pytest.approx(crossing_area_sr(FIVE[n], rings), rel=0.03)
    midpoint = unit(FIVE[[0]] + FIVE[2])[0]
    reach_rad = np.arccos(FIVE @ midpoint).max() + 3 * SEPARATION_RAD
    assert primary.reach_rad == pytest.approx(reach_rad, abs=1e-9)


def test_saa_s_gate_of_positions_is_three_errors_of_the_predicted_place() -> None:
    """Noise of all three stars: the worst axis of where the pair's attitude puts a star beside where it is seen."""
    sigma_rad, rng, errors = 1e-5, np.random.default_rng(6), []
    primary = primary_of(FIVE, sigma_rad)
    for _ in range(2000):
        seen = unit(FIVE + sigma_rad * rng.normal(size=FIVE.shape))
        R = SAA.triad(seen[0], seen[2]).T @ SAA.triad(FIVE[0], FIVE[2])
        errors.append((FIVE @ R.T - seen)[primary.others])
    for k, n in enumerate(primary.others):
        worst2 = np.linalg.eigvalsh(np.cov(np.array(errors)[:, k].T)).max()
        assert primary.sigma_rad[k] ** 2 == pytest.approx(worst2, rel=0.12)  # 4 deviations of a variance of 2,000
        far_rad = np.arccos(FIVE[n] @ primary.midpoint)
        assert primary.radius_rad[k] == pytest.approx(3 * primary.sigma_rad[k] + STRETCH * far_rad, rel=1e-9)
        assert primary.area_sr[k] == pytest.approx(np.pi * primary.radius_rad[k] ** 2, rel=1e-12)


def test_saa_s_chance_is_that_of_the_stars_within_its_reach() -> None:
    """Catalog stars in the field and about the pair, of about the magnitude, over the area that they share."""
    rng, seen = np.random.default_rng(7), FIVE[:4]
    catalog = np.vstack([seen, cap(rng, 400, 0.4)])
    magnitude, seen_mag = np.concatenate([[1, 2, 3, 4], rng.uniform(0, 5, 400)]), np.array([1.0, 2, 3, 4])
    stars = SearchInput(seen, seen_mag, catalog, magnitude, None, Gates(SEPARATION_RAD, 1e-3, 0.4, 0.0))
    primary = SAA.build_primary(stars, 0, 2)
    x, y = (catalog[:, :2] / catalog[:, 2:]).T
    in_field = (x > -0.3) & (x < 0.08) & (y > -0.1) & (y < 0.07)
    near = np.arccos(np.clip(catalog @ primary.midpoint, -1, 1)) < primary.reach_rad
    rows = np.setdiff1d(np.flatnonzero(in_field & near), [0, 2])
    assert 0 < len(rows) < np.count_nonzero(near) - 2
    similar = np.sum(np.abs(magnitude[rows] - seen_mag[primary.others][:, None]) <= 1.2, axis=1)
    share = primary.area_sr / (2 * np.pi * (1 - np.cos(primary.reach_rad)))
    # Star 3 of the field is seen and has no partner.
    p, missing = SAA._chance_statistics(stars, primary, np.array([0, 1, 2, -1]), (-0.3, 0.08, -0.1, 0.07))
    assert p == pytest.approx(np.mean(-np.expm1(-similar * share)), rel=1e-9)
    assert missing == np.count_nonzero(in_field) - 3
