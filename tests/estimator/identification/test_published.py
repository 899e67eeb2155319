"""The published identifiers on small fields: laws of each step, run by the interpreter, which compiles nothing.

`test_pyramid`, `test_saa` and `test_fialho` have the Monte Carlo of the compiled algorithms.
"""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from estimator.catalog import pair_index
from estimator.core.checks import Floats
from estimator.core.vectors import normalized
from estimator.identification.published import pyramid
from estimator.identification.published.primary_pair import Gates, Primary, SearchInput
from estimator.identification.published.saa import UNMATCHED_COST
from estimator.identification.published.shefex import FOURTH_STAR, ShefexOptions
from estimator.identification.registry import IDENTIFIERS
from estimator.identification.solver_options import Options
from tests.helpers.interpreted import interpreted

PLAIN = interpreted("estimator.identification.registry").IDENTIFIERS
PYRAMID, SHEFEX, FIALHO, SAA, DIRECT = (
    interpreted(f"estimator.identification.{name}")
    for name in (
        "published.pyramid",
        "published.shefex",
        "published.fialho",
        "published.saa",
        "direct_match",
    )
)
TOLERANCE_RAD = 1e-4
EDGES = (-0.05, 0.08, -0.07, 0.06)  # tangents of a field off its center
CAP_RAD = 0.3
FIELD_RAD = 0.12
MAX_ANGLE_RAD = 0.24


def cap(rng: np.random.Generator, count: int, radius_rad: float) -> Floats:
    """Unit vectors, uniform within an angle of z."""
    z = rng.uniform(np.cos(radius_rad), 1, count)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])


def field(
    seed: int, false: int = 0, count: int = 60
) -> tuple[Floats, Floats, Floats, pair_index.PairIndex, Rotation]:
    """Rays of a field's stars in camera axes, brightest first, their magnitudes and rows (-1: false), index, truth."""
    rng = np.random.default_rng(seed)
    stars = cap(rng, count, CAP_RAD)
    magnitude = np.linspace(1, 6, count)
    truth = Rotation.random(rng=rng)
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
    found = 0
    required = (0 if name in ("fialho_1", "fialho_2") else 1) if false else 3
    for seed in range(3):
        rays, magnitude, rows, index, truth = field(seed, false)
        match = PLAIN[name](rays, index, TOLERANCE_RAD, magnitude=magnitude, epsilon_mag=0.1)
        if match is None:
            continue
        found += 1
        np.testing.assert_array_equal(match.star, rows[match.observed])
        assert len(match.star) >= 0.8 * np.count_nonzero(rows >= 0)
        # Rounding over the field's 0.2 rad.
        assert (match.cam_from_ref * truth.inv()).magnitude() < 1e-13
        assert match.log10_chance < -5
    assert found >= required


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("tolerance_rad", [0.0, -1e-4, np.nan])
def test_a_tolerance_must_be_positive(name: str, tolerance_rad: float) -> None:
    rays, magnitude, _, index, _ = field(0)
    with pytest.raises(ValueError, match=r"tolerance.*allowed: more than 0"):
        PLAIN[name](rays, index, tolerance_rad, magnitude=magnitude, epsilon_mag=0.1)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name.endswith("triangle") else ())
        for name in NAMES
    ],
)
def test_no_method_takes_a_mirror_image(name: str) -> None:
    rays, magnitude, _, index, _ = field(0)
    match = PLAIN[name](
        rays * [-1, 1, 1], index, TOLERANCE_RAD, magnitude=magnitude, epsilon_mag=0.1
    )
    assert match is None


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
            PLAIN[name](
                rays[rows], index, TOLERANCE_RAD, missed_dex=dex, **known
            ).log10_chance
            for dex in (0.0, 0.07)
        )
        assert charged - free == pytest.approx(0.07 * missing, abs=1e-12)


def test_the_tail_of_chance_matches_is_binomial_down_to_the_least_number() -> None:
    """Probabilities below 1e-300 are clipped, so that the evidence is finite."""
    chance = interpreted("estimator.identification.chance")
    for trials, hits, p in ((10, 4, 0.01), (30, 12, 1e-4), (5, 5, 0.3), (40, 1, 1e-3)):
        wanted = stats.binom.logsf(hits - 1, trials, p) / np.log(10)
        assert chance.log10_tail(trials, hits, p) == pytest.approx(wanted, abs=1e-9)
    assert chance.log10_tail(200, 200, 1e-5) == -300


def test_a_match_counts_as_the_binomial_tail_of_its_gates() -> None:
    """Three of five random directions: their gates cover a share p of the sky of the catalog's local density."""
    rays, _, rows, index, _ = field(1)
    strays = normalized(np.array([[0.1, 0.05, 1.0], [-0.08, 0.06, 1.0]]))
    seen = np.vstack([rays, strays])
    corners = np.arange(3)
    hypotheses = 7
    for stretch in (0.0, 1e-3):
        match = DIRECT.match_field(seen, index, corners, rows[:3], 2e-3, stretch, hypotheses)
        assert match.observed.tolist() == list(range(len(rays)))
        neighbors = np.sum(
            np.linalg.norm(index.vectors - index.vectors[rows[0]], axis=1) < 2 * np.sin(0.12)
        )
        density = neighbors / (2 * np.pi * (1 - np.cos(MAX_ANGLE_RAD)))
        radius = 2e-3 + stretch * np.arctan2(np.hypot(*seen[:, :2].T), seen[:, 2])
        p = -np.expm1(-density * np.pi * np.mean(radius**2))
        tail = stats.binom.logsf(len(rays) - 4, len(seen) - 3, p) / np.log(10)
        assert match.log10_chance == pytest.approx(tail + np.log10(hypotheses), abs=1e-9)


@pytest.mark.parametrize("zoom", [0.99, 1.01])
def test_pyramid_names_the_stars_of_a_lens_of_unknown_focal_length(zoom: float) -> None:
    rays, _, rows, index, truth = field(3)
    zoomed = normalized(rays * [zoom, zoom, 1])
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
def test_the_sides_of_a_triangle_must_agree_on_one_focal_length(
    scale: tuple[float, float, float], unknown: bool, hypotheses: int
) -> None:
    """The stretch of 0.015 is one factor of all sides if the focal length is unknown, and else each side's own."""
    sides = np.array([0.1, 0.12, 0.14])
    index = pair_index.build(triangle(sides * scale), 0.2)
    options = pyramid.PyramidOptions(
        1e-5, 0.015, unknown, 10, 1000, 3, 0.0, -1.0, 1.0, -1.0, 1.0
    )
    tried = np.zeros(3, np.int64)
    PYRAMID._triangle(triangle(sides), index, np.arange(3), options, tried)
    assert tried[1] == hypotheses


@pytest.mark.parametrize(("share", "hypotheses"), [(0.9, 1), (1.1, 0)])
@pytest.mark.parametrize("side", range(3))
@pytest.mark.parametrize("unknown", [False, True])
def test_a_side_s_tolerance_includes_both_direction_errors_and_its_stretch(
    unknown: bool, side: int, share: float, hypotheses: int
) -> None:
    """sqrt(2) tolerances beyond the stretch; a third of the stretch after one factor for the whole perimeter."""
    sides = np.array([0.1, 0.12, 0.14])
    tolerance = 1e-4
    stretch = 0.002
    # Of a side's error that the perimeter's factor leaves.
    part = 1 - sides[side] / sides.sum() if unknown else 1.0
    own_stretch = (stretch / 3 if unknown else stretch) * sides[side]
    longer = sides + np.eye(3)[side] * (share * np.sqrt(2) * tolerance + own_stretch) / part
    index = pair_index.build(triangle(longer), 0.2)
    options = pyramid.PyramidOptions(tolerance, stretch, unknown, 10, 1000, 3, 0.0, *EDGES)
    tried = np.zeros(3, np.int64)
    PYRAMID._triangle(triangle(sides), index, np.arange(3), options, tried)
    assert tried[1] == hypotheses


def test_a_fourth_star_has_its_angles_to_all_three_corners() -> None:
    """Beyond the three corners' tries, the direct match's effort shows that a fourth star was taken."""
    rng = np.random.default_rng(8)
    tolerance = 1e-4
    taken = 0
    corners = normalized(np.array([[0.1, 0.02, 1], [-0.06, 0.08, 1], [-0.03, -0.09, 1]]))
    options = pyramid.PyramidOptions(tolerance, 0.0, False, 10, 1000, 4, 0.0, *EDGES)
    for _ in range(100):
        fourth = normalized(np.array([[0.03, 0.05, 1]]))
        moved = normalized(fourth + rng.normal(0, 1.5 * tolerance, 3))
        # As far from the first corner as the fourth star, in another direction.
        decoy = Rotation.from_rotvec(corners[0]).apply(fourth)
        rays = np.vstack([corners, fourth])
        index = pair_index.build(np.vstack([corners, moved, decoy]), 0.4)
        errors = np.abs(np.arccos(corners @ fourth[0]) - np.arccos(corners @ moved[0]))
        tried = np.array([0, 1, 0])
        PYRAMID._pyramid(rays, index, np.arange(3), np.arange(3), options, 0.0, tried)
        fits = errors.max() <= np.sqrt(2) * tolerance
        # Four tries; four rays against the corner's four neighbors.
        assert tried[2] == 4 + fits * 4 * 4
        taken += fits
    assert 20 < taken < 80


@pytest.mark.parametrize("name", ["pyramid", "shefex"])
def test_the_number_of_triangles_tried_is_the_allowed_one(name: str) -> None:
    """The first three of four triangles have a false star; the first that has none is the last in order."""
    stars = normalized(
        np.array(
            [
                [-0.1, -0.02, 1],
                [0.06, 0.07, 1],
                [0.09, -0.08, 1],
                [-0.05, 0.06, 1],
                [0.01, 0.03, 1],
            ]
        )
    )
    false = normalized(np.array([[0.04, -0.05, 1]]))
    index = pair_index.build(stars, 0.4)
    seen = np.vstack([false, stars])
    limits = {"base_stars": 6, "max_checks": 10**6}
    least = next(
        n
        for n in range(1, 21)
        if PLAIN[name](seen, index, 1e-5, max_triangles=n, **limits) is not None
    )
    # Six stars in the order of pyramid: (0 1 2) (1 2 3); of shefex: ten triangles with the false star first.
    assert least == {"pyramid": 2, "shefex": 11}[name]


def test_a_pyramid_s_chance_counts_the_hypotheses_tried() -> None:
    rays, _, rows, index, _ = field(4)
    options = pyramid.PyramidOptions(TOLERANCE_RAD, 0.0, False, 10, 10**6, 12, 0.0, *EDGES)
    tried = np.array([0, 40, 0])
    match = PYRAMID._triangle(rays, index, np.arange(3), options, tried)
    np.testing.assert_array_equal(match.star, rows[match.observed])
    assert tried[1] >= 41
    once = DIRECT.match_field(rays, index, np.arange(3), rows[:3], TOLERANCE_RAD, 0.0, 1)
    assert match.log10_chance - once.log10_chance == pytest.approx(
        np.log10(tried[1]), abs=1e-9
    )


# ---- the areas of gates


def crossing_area_sr(
    center: Floats, rings: list[tuple[Floats, float]], step: float = 2e-5
) -> float:
    """Area of the intersection of rings about stars, each with the radius of `center` and a half-width."""
    steps = np.arange(-150, 151) * step
    across, down = np.linalg.svd(center[None])[2][1:]
    places = center + steps[:, None, None] * across + steps[:, None] * down
    inside = np.ones(places.shape[:2], bool)
    for star, half_width in rings:
        angles = np.arctan2(np.linalg.norm(np.cross(places, star), axis=2), places @ star)
        inside &= (
            np.abs(angles - np.arctan2(np.linalg.norm(np.cross(center, star)), center @ star))
            < half_width
        )
    return float(inside.sum() * step**2)


def test_shefex_s_gates_have_the_least_area_of_their_crossing_rings() -> None:
    rays = normalized(
        np.array(
            [
                [0.1, 0.02, 1],
                [-0.06, 0.08, 1],
                [-0.03, -0.09, 1],
                [0.02, 0.03, 1],
                [0.06, -0.08, 1],
            ]
        )
    )
    options = ShefexOptions(1e-5, 1e-6, 100, 10**6, 5)
    gates = SHEFEX._angle_gates(rays, np.arange(3), options)
    assert (gates[:3, 9] == 0).all()
    for n in (3, 4):
        half = (gates[n, 3:6] - gates[n, :3]) / 2
        pairs = [(0, 1), (1, 2), (2, 0)]
        areas = [
            crossing_area_sr(rays[n], [(rays[a], half[a]), (rays[b], half[b])])
            for a, b in pairs
        ]
        # Of the lattice, and of the rings' curvature.
        assert gates[n, 9] == pytest.approx(min(areas), rel=0.03)


def test_shefex_counts_the_other_stars_in_the_gates_by_the_binomial_law() -> None:
    rays, _, rows, index, _ = field(2)
    options = ShefexOptions(2e-5, TOLERANCE_RAD, 100, 10**6, 12)
    tried = np.zeros(3, np.int64)
    match = SHEFEX.search(rays, index, options, tried)
    np.testing.assert_array_equal(match.star, rows[match.observed])
    neighbors = np.sum(
        np.linalg.norm(index.vectors - index.vectors[match.star[0]], axis=1)
        < 2 * np.sin(0.12)
    )
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
        normal = normalized(np.cross(rays[[far]], rays[(far + 1) % 3]))[0]
        mirrored = rays[3] - 2 * (rays[3] @ normal) * normal
        index = SimpleNamespace(
            vectors=Rotation.random(rng=rng).apply(np.vstack([rays, mirrored]))
        )
        corners = np.arange(3)
        assert SHEFEX._same_side(rays, index, corners, corners, 3, 3)
        assert not SHEFEX._same_side(rays, index, corners, corners, 3, 4)


def test_shefex_takes_the_star_whose_three_angles_fit_best() -> None:
    """Against a search of all stars with wide gates: angles, side of the base, least sum of differences."""
    rng = np.random.default_rng(9)
    found = 0
    for _ in range(20):
        rays = cap(rng, 4, 0.15)
        strays = cap(rng, 300, 0.17)
        index = pair_index.build(np.vstack([rays[:3], strays]), 0.4)
        gates = SHEFEX._angle_gates(rays, np.arange(3), ShefexOptions(1e-3, 1e-6, 1, 1, 4))
        cosines = rays[:3] @ index.vectors.T
        tried = np.zeros(3, np.int64)
        angles = np.arccos(np.clip(cosines, -1, 1))
        fits = ((angles >= gates[3, :3, None]) & (angles <= gates[3, 3:6, None])).all(axis=0)
        volumes = [np.linalg.det(rays[[m, (m + 1) % 3, 3]]) for m in range(3)]
        far = int(np.argmax(np.abs(volumes)))
        fits &= index.vectors @ np.cross(rays[far], rays[(far + 1) % 3]) * volumes[far] > 0
        fits[:3] = False
        difference = np.where(
            fits, np.abs(cosines - (rays[:3] @ rays[3])[:, None]).sum(axis=0), np.inf
        )
        wanted = int(np.argmin(difference)) if fits.any() else -1
        assert (
            SHEFEX._partner(rays, index, np.arange(3), np.arange(3), 3, gates[3], tried)
            == wanted
        )
        found += np.count_nonzero(fits) > 1
    assert found > 5


def test_four_stars_are_the_least_of_shefex_s_match() -> None:
    """The paper's own rule takes any fourth star."""
    rays, _, rows, index, _ = field(2)
    options = ShefexOptions(2e-6, TOLERANCE_RAD, 10, 10**6, 12, accept=FOURTH_STAR)
    match = SHEFEX.search(rays[:4], index, options._replace(base=4), np.zeros(3, np.int64))
    np.testing.assert_array_equal(match.star, rows[:4])
    strays = np.vstack([rays[:3], normalized(np.array([[0.012, 0.034, 1.0]]))])
    assert (
        len(
            SHEFEX.search(strays, index, options._replace(base=4), np.zeros(3, np.int64)).star
        )
        == 0
    )
    # Within wide gates of the angles, but 30 tolerances from its place.
    moved = normalized(rays[:4] + np.outer([0, 0, 0, 1], [3e-4, 0, 0]))
    wide = options._replace(cos_error=1e-4, tolerance_rad=1e-5)
    assert (
        len(SHEFEX.search(moved, index, wide._replace(base=4), np.zeros(3, np.int64)).star)
        == 0
    )


# ---- SAA

SEPARATION_RAD = 1e-4
POSITION_RAD = 1e-2
STRETCH = 1e-4
FIVE = normalized(
    np.array(
        [
            [0.1, 0.02, 1],
            [-0.06, 0.08, 1],
            [-0.03, -0.09, 1],
            [0.02, 0.03, 1],
            [0.15, -0.12, 1],
        ]
    )
)


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
            assert primary.gate_rad[side, k] == pytest.approx(
                3 * SEPARATION_RAD + STRETCH * angle, rel=1e-9
            )
            rings.append((FIVE[row], primary.gate_rad[side, k]))
        assert primary.area_sr[k] == pytest.approx(crossing_area_sr(FIVE[n], rings), rel=0.03)
    midpoint = normalized(FIVE[[0]] + FIVE[2])[0]
    reach_rad = np.arccos(FIVE @ midpoint).max() + 3 * SEPARATION_RAD
    assert primary.reach_rad == pytest.approx(reach_rad, abs=1e-9)


def test_saa_s_gate_of_positions_is_three_errors_of_the_predicted_place() -> None:
    """Noise of all three stars: the worst axis of where the pair's attitude puts a star beside where it is seen."""
    sigma_rad = 1e-5
    rng = np.random.default_rng(6)
    errors = []
    primary = primary_of(FIVE, sigma_rad)
    for _ in range(2000):
        seen = normalized(FIVE + sigma_rad * rng.normal(size=FIVE.shape))
        R = SAA.triad(seen[0], seen[2]).T @ SAA.triad(FIVE[0], FIVE[2])
        errors.append((FIVE @ R.T - seen)[primary.others])
    for k, n in enumerate(primary.others):
        worst2 = np.linalg.eigvalsh(np.cov(np.array(errors)[:, k].T)).max()
        # 4 deviations of a variance of 2,000.
        assert primary.sigma_rad[k] ** 2 == pytest.approx(worst2, rel=0.12)
        far_rad = np.arccos(FIVE[n] @ primary.midpoint)
        assert primary.radius_rad[k] == pytest.approx(
            3 * primary.sigma_rad[k] + STRETCH * far_rad, rel=1e-9
        )
        assert primary.area_sr[k] == pytest.approx(
            np.pi * primary.radius_rad[k] ** 2, rel=1e-12
        )


def test_saa_s_chance_counts_the_stars_within_its_reach() -> None:
    """Catalog stars in the field and about the pair, of about the magnitude, over the area that they share."""
    rng = np.random.default_rng(7)
    seen = FIVE[:4]
    catalog = np.vstack([seen, cap(rng, 400, 0.4)])
    magnitude = np.concatenate([[1, 2, 3, 4], rng.uniform(0, 5, 400)])
    seen_mag = np.array([1.0, 2, 3, 4])
    stars = SearchInput(
        seen, seen_mag, catalog, magnitude, None, Gates(SEPARATION_RAD, 1e-3, 0.4, 0.0)
    )
    primary = SAA.build_primary(stars, 0, 2)
    x, y = (catalog[:, :2] / catalog[:, 2:]).T
    in_field = (x > -0.3) & (x < 0.08) & (y > -0.1) & (y < 0.07)
    near = np.arccos(np.clip(catalog @ primary.midpoint, -1, 1)) < primary.reach_rad
    rows = np.setdiff1d(np.flatnonzero(in_field & near), [0, 2])
    assert 0 < len(rows) < np.count_nonzero(near) - 2
    similar = np.sum(
        np.abs(magnitude[rows] - seen_mag[primary.others][:, None]) <= 1.2, axis=1
    )
    share = primary.area_sr / (2 * np.pi * (1 - np.cos(primary.reach_rad)))
    # Star 3 of the field is seen and has no partner.
    pool = SAA.AssumptionPool(stars, (-0.3, 0.08, -0.1, 0.07), 0.0)
    pool.star = np.array([0, 1, 2, -1])
    p, missing = pool._chance_statistics(primary)
    assert p == pytest.approx(np.mean(-np.expm1(-similar * share)), rel=1e-9)
    assert missing == np.count_nonzero(in_field) - 3
    pool.stars = stars._replace(vectors=seen, magnitude_cam=seen_mag, magnitude=magnitude[:4])
    pool.star = np.arange(4)
    assert pool._chance_statistics(primary)[1] == 0


@pytest.mark.parametrize("base", [5, 9])
def test_saa_tries_every_pair_that_gives_the_roll_the_brightest_first(base: int) -> None:
    rays = cap(np.random.default_rng(10), 9, 0.01)
    gates = Gates(SEPARATION_RAD, 1e-3, np.inf, 0.0)
    unknown = np.full(9, np.nan)
    max_rad = 0.012
    pairs = list(
        SAA._primary_pairs(
            SearchInput(rays, unknown, rays, unknown, None, gates), base, max_rad
        )
    )
    angle = np.arccos(np.clip(rays @ rays.T, -1, 1))
    fitting = (angle > 12 * SEPARATION_RAD) & (angle <= max_rad + 3 * SEPARATION_RAD)
    wanted = {(a, b) for a, b in np.argwhere(fitting) if a < b < base}
    assert 0 < len(wanted) < base * (base - 1) // 2
    assert {(a, b) for a, b, _ in pairs} == wanted
    assert len(pairs) == len(wanted)
    assert (np.diff([a + b for a, b, _ in pairs]) >= 0).all()
    np.testing.assert_allclose(
        [size for _, _, size in pairs], [angle[a, b] for a, b, _ in pairs], rtol=1e-6
    )


def test_saa_s_partner_meets_the_four_conditions_at_the_least_cost() -> None:
    """Needelman's: magnitude, position, and the angles to A and to B; by all stars of a crowded field."""
    rng = np.random.default_rng(11)
    gates = Gates(2e-3, 3e-3, 0.3, 0.0)
    several = 0
    for _ in range(20):
        seen = cap(rng, 5, 0.1)
        crowd = cap(rng, 300, 0.12)
        index = pair_index.build(np.vstack([seen[[0, 2]], crowd]), 0.3)
        magnitude = np.concatenate([[1, 1], rng.uniform(0, 3, 300)])
        seen_mag = np.array([1, 1.5, 1, 1.5, np.nan])
        stars = SearchInput(seen, seen_mag, index.vectors, magnitude, index.cells, gates)
        primary = SAA.build_primary(stars, 0, 2)
        nearby = np.empty(302, np.int64)
        partner = np.empty(3, np.int64)
        cost = np.empty(3)
        SAA._partners(stars, primary, 0, 1, nearby, partner, cost)
        for k, n in enumerate((1, 3, 4)):
            # The reference's axes are the camera's.
            distance = np.linalg.norm(index.vectors - seen[n], axis=1)
            off = np.arccos(index.vectors @ seen[[0, 2]].T) - np.arccos(
                seen[n] @ seen[[0, 2]].T
            )
            unlike = np.nan_to_num((magnitude - seen_mag[n]) / 0.3)
            fits = (np.abs(unlike) <= 3) & (
                2 * np.arcsin(distance / 2) <= primary.radius_rad[k]
            )
            fits &= (np.abs(off) <= 6e-3).all(axis=1) & (np.arange(302) > 1)
            own_cost = unlike**2 + np.sum(off**2, axis=1) / 2e-3**2
            total = np.where(fits, own_cost + (distance / primary.sigma_rad[k]) ** 2, np.inf)
            best = int(total.argmin()) if fits.any() else -1
            assert partner[k] == best
            assert cost[k] == pytest.approx(
                own_cost[best] if best >= 0 else UNMATCHED_COST, rel=1e-6
            )
            several += np.count_nonzero(fits) > 1
    assert several > 15


def test_of_two_stars_with_one_partner_the_cheaper_keeps_it() -> None:
    for costs, kept in (([1.0, 2.0], 0), ([2.0, 1.0], 2)):
        partner = np.array([7, 3, 7, -1])
        cost = np.array([costs[0], 5.0, costs[1], UNMATCHED_COST])
        assert SAA._remove_duplicates(partner, cost) == 2
        assert partner.tolist() == [7 if kept == 0 else -1, 3, 7 if kept == 2 else -1, -1]
        assert cost[2 - kept] == UNMATCHED_COST
        assert cost[kept] == 1


def test_saa_s_best_counts_as_the_binomial_tail_of_the_stars_beside_its_pair() -> None:
    """All but one of them are matched; each catalog star of the field that is not seen costs half a power of ten."""
    rays, _, rows, index, _ = field(0)
    unknown = np.full(len(rays), np.nan)
    stars = SearchInput(
        rays,
        unknown,
        index.vectors,
        np.full(60, np.nan),
        index.cells,
        Gates(1e-4, 1e-4, np.inf, 0.0),
    )
    pool = SAA.AssumptionPool(stars, (-1.0, 1.0, -1.0, 1.0), 0.5)
    best = rows.astype(np.int32)
    best[-1] = -1
    pool.add(
        SAA.build_primary(stars, 0, 1),
        (best[None], np.array([3.0]), np.array([len(rows) - 3])),
    )
    tail = stats.binom.logsf(len(rows) - 4, len(rows) - 2, pool.p) / np.log(10)
    assert pool.log10_chance == pytest.approx(tail + 0.5 * pool.missing, abs=1e-9)


@pytest.mark.parametrize(("ratio", "accepted"), [(0.9e5, False), (1.1e5, True)])
def test_saa_s_best_match_must_be_1e5_times_as_likely_as_contradicting_ones(
    ratio: float, accepted: bool
) -> None:
    """A cost is a squared number of standard deviations: the likelihood is exp(-cost / 2)."""
    rays, _, rows, index, _ = field(0)
    unknown = np.full(len(rays), np.nan)
    stars = SearchInput(
        rays,
        unknown,
        index.vectors,
        np.full(60, np.nan),
        index.cells,
        Gates(1e-4, 1e-4, np.inf, 0.0),
    )
    pool = SAA.AssumptionPool(stars, (-1.0, 1.0, -1.0, 1.0), 0.0)
    primary = SAA.build_primary(stars, 0, 1)
    best = rows.astype(np.int32)
    rival = np.full(len(rows), -1, np.int32)
    rival[:4] = np.roll(best[:4], 1)
    costs = np.array([3.0, 3.0 + 2 * np.log(ratio)])
    pool.add(primary, (np.array([best, rival]), costs, np.array([len(rows) - 2, 0])))
    assert (pool.best_match() is not None) == accepted


@pytest.mark.parametrize(
    ("limit", "tried"), [(3, 3), (1000, 2 + SAA.RIVAL_PAIRS), (10**6, 2 + SAA.RIVAL_PAIRS)]
)
def test_saa_tries_rival_pairs_once_its_best_is_significant_and_never_too_many(
    limit: int, tried: int
) -> None:
    """The second pair's best is significant."""
    rays, _, _, index, _ = field(0)
    unknown = np.full(len(rays), np.nan)
    gates = Gates(1e-4, 1e-4, np.inf, 0.0)
    stars = SearchInput(rays, unknown, index.vectors, np.full(60, np.nan), index.cells, gates)
    added = []

    class Pool:
        count = 0
        log10_chance = property(lambda _: -9.0 if len(added) == 2 else 0.0)

        def add(self, primary: Primary, _: object) -> None:
            added.append(primary)

    pool = Pool()
    pool.stars = stars
    SAA._test_pairs(pool, index, Options(max_triangles=limit, base_stars=len(rays)))
    assert len(list(SAA._primary_pairs(stars, len(rays), index.max_angle_rad))) > tried
    assert len(added) == tried


@pytest.mark.parametrize(("share", "matched"), [(0.5, False), (0.49, True)])
def test_fialho_s_match_has_more_than_its_share_of_the_observed_stars(
    share: float, matched: bool
) -> None:
    """All stars match among twice as many lights."""
    rays, _, rows, index, _ = field(1)
    strays = normalized(rays + np.array([0.004, 0.003, 0]))  # 50 tolerances beside each star
    options = FIALHO.search_options(
        TOLERANCE_RAD, Options(epsilon_mag=0.1), share, True, False
    )
    match = FIALHO._direct_match(
        np.vstack([rays, strays]), index, np.arange(3), rows[:3], options, 1
    )
    assert len(match.observed) == (len(rays) if matched else 0)


@pytest.mark.parametrize(
    ("triangles", "checks", "tried"), [(10**6, 10**6, None), (5, 10**6, 5), (10**6, 20, 3)]
)
def test_fialho_tries_every_wide_triangle_once_up_to_its_limits(
    triangles: int, checks: int, tried: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each triangle takes seven checks and is no match; the brightest comes first."""
    rays, _, _, index, _ = field(1)
    asked: list[tuple[int, ...]] = []

    def no_triplet(*arguments: object) -> object:
        asked.append(tuple(arguments[3]))
        arguments[5][1] += 7
        return FIALHO.no_match()

    monkeypatch.setattr(FIALHO, "triplets", no_triplet)
    options = FIALHO.search_options(TOLERANCE_RAD, Options(epsilon_mag=0.1), 0.5, True, True)
    options = options._replace(triangles=triangles, checks=checks, base=6)
    assert len(FIALHO.search(rays, np.full(len(rays), np.nan), index, options).observed) == 0
    wide = [
        corners
        for corners in itertools.combinations(range(6), 3)
        if shortest_side_rad(rays[list(corners)])
        >= FIALHO.MIN_SIDE_FRACTION * index.max_angle_rad
    ]
    assert len(wide) > 5
    assert asked[0] == wide[0]
    assert len(set(asked)) == len(asked) == (tried or len(wide))
    assert set(asked) <= set(wide)


def shortest_side_rad(corners: Floats) -> float:
    """The shortest side of a triangle, rad."""
    return float(np.arccos(np.sum(corners * np.roll(corners, 1, axis=0), axis=1)).min())
