"""The default identifier: its sky against brute force, its evidence against chance, its errors against theory."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.catalog import sky_index
from estimator.core import least_squares
from estimator.core.errors import ImageError
from estimator.core.types import NO_SPREAD
from estimator.core.vectors import quaternion_xyzw
from estimator.identification import star_detections as detections_module
from estimator.identification import star_evidence, star_search
from estimator.identification.star_detections import Sensor, changed, gates_of
from estimator.identification.star_evidence import Solution
from tests.helpers.interpreted import interpreted
from tests.helpers.star_fields import (
    CHECKS,
    FIELD,
    MAG,
    SEARCHED,
    SIGMA,
    SKY,
    VECTORS,
    WIDE_RAD,
    attitude_error,
    detections_of,
    observe,
    random_sky,
)


def solve(detections: star_evidence.Detections, sky: sky_index.SkyIndex = SKY) -> Solution:
    return star_search.lost_in_space(detections, sky, SEARCHED, CHECKS)


@pytest.mark.slow
def test_the_sky_holds_every_pair_in_its_bin() -> None:
    chord = 2 * np.sin(WIDE_RAD / 2)
    expected = {tuple(sorted(pair)) for pair in cKDTree(VECTORS).query_pairs(chord)}
    assert {tuple(sorted(pair)) for pair in SKY.pair.tolist()} == expected
    assert len(SKY.pair) == len(expected)
    one, other = VECTORS[SKY.pair].transpose(1, 0, 2)
    angle = np.arctan2(
        np.linalg.norm(np.cross(one, other), axis=1), np.sum(one * other, axis=1)
    )
    number = np.repeat(np.arange(len(SKY.first) - 1), np.diff(SKY.first))
    offset = angle / SKY.bin_rad - number
    assert offset.min() > -1e-9  # rounding
    assert offset.max() < 1 + 1e-9


# Corners, edges and middles of the cube's faces are where a grid on it may fail.
coordinate = st.one_of(st.floats(-1, 1), st.sampled_from([-1.0, 0.0, 1.0]))


@pytest.mark.slow
@settings(deadline=None)
@given(coordinate, coordinate, coordinate, st.floats(1e-4, 0.05))
@example(-1.0, -1.0, 0.921875, 0.046875)  # the star stands at a tangent of 1.13 of the face
def test_the_nearest_star_matches_a_k_d_tree(
    x: float, y: float, z: float, gate: float
) -> None:
    where = np.array([x, y, z]) + 1e-3
    where /= np.linalg.norm(where)
    star, chord2 = sky_index.nearest(
        SKY.vectors, SKY.cell_first, SKY.cell_star, SKY.side, *where, gate
    )
    chord, expected = cKDTree(VECTORS).query(where)
    inside = chord < gate
    assert star == (expected if inside else -1)
    assert chord2 == pytest.approx(chord**2 if inside else gate**2, rel=1e-9)


def test_a_sky_without_a_pattern_is_refused() -> None:
    in_a_row = Rotation.from_rotvec([[0, 0, 0], [0, 0.15, 0], [0, 0.3, 0]]).apply(
        [0.0, 0.0, 1.0]
    )
    with pytest.raises(
        ImageError,
        match=r"2 pairs of stars within 12\.00 deg are too few; allowed: 3 or more",
    ):
        sky_index.add_pairs(sky_index.build(in_a_row, MAG[:3]), WIDE_RAD)


@pytest.mark.parametrize(("share", "brighter"), [(0.5, False), (0.5, True), (0.7, False)])
def test_a_field_is_identified_if_its_brightest_lights_are_false(
    share: float, brighter: bool
) -> None:
    """Half or two thirds of the lights are false and brighter than any star, so the search starts with false ones."""
    rng = np.random.default_rng(14)
    solved = 0
    for _ in range(40):
        truth = Rotation.random(rng=rng)
        tangent, mag, row = observe(truth, rng)
        false = round(len(row) * share / (1 - share))
        lights = np.vstack([tangent, rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (false, 2))])
        false_mag = (
            rng.uniform(mag.min() - 2, mag.min() - 1, false)
            if brighter
            else rng.choice(MAG, false)
        )
        shown = np.concatenate([mag, false_mag])
        order = np.argsort(shown)
        solution = solve(detections_of(lights[order], shown[order]))
        if not len(solution.star):
            continue
        solved += 1
        assert np.linalg.norm(attitude_error(solution, truth)) < 1e-3
        number = order[solution.observed]  # of the light, below len(row) a star's
        assert np.mean(number < len(row)) > 0.9
        assert (row[number[number < len(row)]] == solution.star[number < len(row)]).all()
    assert solved >= 38


def test_lights_with_elongated_errors_are_weighted_by_their_covariance() -> None:
    """Smeared stars: the attitude errors about y (from errors along x) and about x match their covariance."""
    rng = np.random.default_rng(12)
    scaled = []
    along = 4 * SIGMA
    across = SIGMA / 4
    for _ in range(150):
        truth = Rotation.random(rng=rng)
        tangent, mag, _ = observe(truth, rng, sigma=0.0)
        tangent = tangent + rng.standard_normal(tangent.shape) * [along, across]
        detections = detections_of(tangent, mag, along)
        solution = solve(
            detections._replace(weight=np.tile([along**-2, across**-2, 0], (len(mag), 1)))
        )
        if len(solution.star):
            scaled.append(
                attitude_error(solution, truth) / np.sqrt(np.diag(solution.covariance_rad2))
            )
    assert len(scaled) > 140
    # A mean square of 140 numbers is 1 to 12 %; that of equal weights would be 2 and 1/8.
    np.testing.assert_allclose(np.mean(np.square(scaled), axis=0), 1, rtol=0, atol=0.4)


def test_true_lights_give_the_true_attitude_and_names() -> None:
    rng = np.random.default_rng(2)
    for _ in range(30):
        truth = Rotation.random(rng=rng)
        tangent, mag, row = observe(truth, rng, sigma=0.0)
        solution = solve(detections_of(tangent, mag))
        # Rounding over a field of a tenth of a radian.
        assert np.linalg.norm(attitude_error(solution, truth)) < 1e-12
        assert np.array_equal(row[solution.observed], solution.star)
        assert len(solution.star) == len(row)


def test_a_field_whose_lights_all_match_needs_no_second_fit() -> None:
    """The search's own fit: another one from there finds the same stars, attitude and evidence."""
    rng = np.random.default_rng(15)
    whole = 0
    for _ in range(30):
        tangent, mag, _ = observe(Rotation.random(rng=rng), rng)
        detections = detections_of(tangent, mag)
        solution = solve(detections)
        if len(solution.star) < len(mag):
            continue
        whole += 1
        first = Rotation.from_quat(solution.cam_from_ref_xyzw)
        again = star_evidence.evaluate(
            detections, SKY, first.as_matrix(), 1.0, gates_of(detections, 1.5), -np.inf
        )
        assert np.array_equal(again.observed, solution.observed)
        assert np.array_equal(again.star, solution.star)
        turn = Rotation.from_matrix(again.R_cam_from_ref) * first.inv()
        assert turn.magnitude() < 1e-3 * SIGMA
        assert again.dex == pytest.approx(solution.dex, abs=1e-3)
    assert whole > 10


@pytest.mark.parametrize("known", [True, False])
def test_a_field_is_identified_if_half_of_its_lights_are_false(known: bool) -> None:
    rng = np.random.default_rng(3)
    solved = 0
    for _ in range(40):
        truth = Rotation.random(rng=rng)
        tangent, mag, _ = observe(truth, rng)
        while len(mag) < 7:
            truth = Rotation.random(rng=rng)
            tangent, mag, _ = observe(truth, rng)
        strays = rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (7, 2))
        shown = np.concatenate([mag[:7], rng.choice(MAG, 7)])
        order = np.argsort(shown)
        shown = shown[order] if known else np.full(14, np.nan)
        solution = solve(detections_of(np.concatenate([tangent[:7], strays])[order], shown))
        # Seven stars of 4": a wrong attitude would be tens of degrees off.
        solved += (
            len(solution.star) > 0
            and np.linalg.norm(attitude_error(solution, truth)) < 50 * SIGMA
        )
    assert solved == 40


@pytest.mark.slow
@pytest.mark.parametrize("zoom", [0.0, 0.05])
def test_the_covariance_matches_the_scatter(zoom: float) -> None:
    """NEES of 300 attitudes; with the focal length unknown to 5 % that of the zoom's own error too."""
    rng = np.random.default_rng(4)
    nees = []
    focal_errors = []
    for _ in range(300):
        truth = Rotation.random(rng=rng)
        true_ratio = 1 + rng.uniform(-zoom, zoom)
        tangent, mag, row = observe(truth, rng, zoom=true_ratio)
        solution = solve(detections_of(tangent, mag, zoom=zoom))
        error = attitude_error(solution, truth)
        nees.append(error @ np.linalg.solve(solution.covariance_rad2, error))
        focal_errors.append(
            (np.log(solution.focal_ratio / true_ratio)) / zoom_sigma(truth, row, true_ratio)
        )
    # Chi-square of three degrees: mean 3, deviation sqrt(6 / 300) = 0.141; four of them.
    assert np.mean(nees) == pytest.approx(3, abs=0.57)
    # The mean square of 300 normal numbers: deviation sqrt(2 / 300) = 0.082.
    assert np.mean(np.square(focal_errors)) == pytest.approx(1 if zoom else 0, abs=0.33)


def zoom_sigma(truth: Rotation, row, zoom: float) -> float:
    """Standard deviation of log zoom with unknown attitude: least squares with numerical derivatives."""

    def model(p):
        x, y, z = (Rotation.from_rotvec(p[:3]) * truth).apply(VECTORS[row]).T
        return zoom * np.exp(p[3]) * np.concatenate([x / z, y / z])

    slope = np.column_stack(
        [(model(1e-6 * unit) - model(-1e-6 * unit)) / 2e-6 for unit in np.eye(4)]
    )
    return SIGMA * float(np.sqrt(np.linalg.inv(slope.T @ slope)[3, 3]))


@pytest.mark.long
def test_random_lights_are_refused() -> None:
    """Evidence beyond 10^x is met in less than one of 10^x frames, and 10^4 is asked for: none of 200."""
    rng = np.random.default_rng(5)
    for _ in range(200):
        count = rng.integers(3, 21)
        tangent = rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (count, 2))
        assert not len(solve(detections_of(tangent, np.sort(rng.choice(MAG, count)))).star)


@pytest.mark.slow
def test_a_mirrored_sky_is_refused() -> None:
    rng = np.random.default_rng(6)
    for _ in range(40):
        tangent, mag, _ = observe(Rotation.random(rng=rng), rng)
        assert not len(solve(detections_of(tangent * [-1, 1], mag)).star)


def test_a_sky_that_repeats_is_ambiguous() -> None:
    """Stars listed twice in the catalog give two attitudes: significant, ambiguous, and refused."""
    rng = np.random.default_rng(7)
    sparse, sparse_mag = random_sky(300, 8)
    once = sky_index.add_pairs(sky_index.build(sparse, sparse_mag), WIDE_RAD)
    loose = 5e-4
    dex = np.inf
    while not star_search.ACCEPT_DEX < dex < star_search.DECISIVE_DEX:
        truth = Rotation.random(rng=rng)
        tangent, mag, row = observe(truth, rng, sigma=loose, vectors=sparse, mag=sparse_mag)
        dex = (
            solve(detections_of(tangent, mag, sigma=loose), once).dex
            if len(row) > 3
            else np.inf
        )
    copied = Rotation.from_euler("xyz", [70, 20, 30], degrees=True).apply(sparse[row])
    clear = np.linalg.norm(sparse - copied.mean(axis=0), axis=1) > 0.2
    vectors = np.concatenate([sparse[clear], copied])
    both = np.concatenate([sparse_mag[clear], sparse_mag[row]])
    order = np.argsort(both, kind="stable")
    twice = sky_index.add_pairs(sky_index.build(vectors[order], both[order]), WIDE_RAD)
    assert not len(solve(detections_of(tangent, mag, sigma=loose), twice).star)


def test_one_light_of_wrong_brightness_costs_little_evidence() -> None:
    """A variable star, or a planet in front of a star, is matched and does not prevent the answer."""
    rng = np.random.default_rng(9)
    for _ in range(20):
        truth = Rotation.random(rng=rng)
        tangent, mag, row = observe(truth, rng)
        mag[3] -= 2.5
        solution = solve(detections_of(tangent, mag))
        assert np.linalg.norm(attitude_error(solution, truth)) < 50 * SIGMA
        assert row[3] in solution.star


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_normal_equations_are_solved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(4, 4))
    matrix = half @ half.T + 0.1 * np.eye(4)
    right = rng.normal(size=4)
    factor = matrix.copy()
    star_evidence.factorize(factor)
    solved = right.copy()
    least_squares.cholesky_solve(factor, solved)
    np.testing.assert_allclose(matrix @ solved, right, rtol=0, atol=1e-10)


@settings(deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([None, [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0]]),
)
def test_a_matrix_has_the_rotation_of_its_quaternion(seed: int, axis) -> None:
    """This includes half turns, where the scalar part vanishes."""
    rotation = (
        Rotation.random(rng=seed)
        if axis is None
        else Rotation.from_rotvec(np.pi * np.array(axis))
    )
    again = Rotation.from_quat(quaternion_xyzw(rotation.as_matrix()))
    assert (again * rotation.inv()).magnitude() < 1e-14 * 10


# ---- steps of the search, by the interpreter

PLAIN = interpreted("estimator.identification.star_search")
CHANCE = interpreted("estimator.identification.chance")
DETECTIONS = interpreted("estimator.identification.star_detections")
PLACES = np.array(
    [[0.01, 0.02], [-0.05, 0.03], [0.06, -0.04], [-0.02, -0.06], [0.03, 0.0], [0.012, 0.018]]
)
UNEQUAL = np.array([1, 2, 3, 1.5, 1, 1]) * SIGMA


def unequal(zoom: float = 0.0) -> star_evidence.Detections:
    """Six detections of magnitudes 3, 4, ..., the last one's unknown, of unequal errors."""
    mag = np.array([3.0, 4.0, 5.0, 5.5, 6.0, np.nan])
    return detections_of(PLACES, mag, zoom=zoom)._replace(sigma=UNEQUAL)


def test_a_pair_s_gates_are_the_error_of_where_it_puts_a_detection() -> None:
    """3.5 standard deviations along the worst axis: the pair's middle and direction are fitted, all have noise."""
    # of equal errors: others' are correlated with the middle's
    rng = np.random.default_rng(80)
    a = 0
    b = 4
    seen = PLACES[:, 0] + 1j * PLACES[:, 1]
    noisy = seen + UNEQUAL * (
        rng.standard_normal((20_000, 6)) + 1j * rng.standard_normal((20_000, 6))
    )
    turn = (
        (noisy[:, b] - noisy[:, a])
        / np.abs(noisy[:, b] - noisy[:, a])
        / (seen[b] - seen[a])
        * abs(seen[b] - seen[a])
    )
    middle = (noisy[:, [a]] + noisy[:, [b]]) / 2
    errors = middle + turn[:, None] * (seen - (seen[a] + seen[b]) / 2) - noisy
    gates = DETECTIONS.pair_gates(unequal(), a, b)
    for n in (1, 2, 3):
        worst2 = np.linalg.eigvalsh(np.cov(errors[:, n].real, errors[:, n].imag)).max()
        # 4 deviations of a variance of 20,000.
        assert gates[n] == pytest.approx(3.5 * np.sqrt(worst2), rel=0.02)


@pytest.mark.parametrize("zoom", [0.0, 0.02])
def test_every_catalog_pair_that_two_detections_may_be_is_in_their_range(zoom: float) -> None:
    """Angles within 3.5 errors of a separation, or of any that the focal length allows; few others."""
    one, other = VECTORS[SKY.pair].transpose(1, 0, 2)
    angle = np.arctan2(
        np.linalg.norm(np.cross(one, other), axis=1), np.sum(one * other, axis=1)
    )
    for a, b in ((0, 1), (1, 2), (2, 3)):
        low, high, chord, gate = PLAIN._pair_range(unequal(zoom), SKY, a, b)
        begin = SKY.first[low]
        end = SKY.first[high + 1]
        rays = np.column_stack([PLACES[[a, b]], np.ones(2)])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        seen = np.arccos(rays[0] @ rays[1])
        assert chord == pytest.approx(2 * np.sin(seen / 2), rel=1e-9)
        assert gate == pytest.approx(3.5 * np.hypot(UNEQUAL[a], UNEQUAL[b]), rel=1e-9)
        possible = np.flatnonzero(
            (angle > seen / (1 + zoom) - gate) & (angle < seen / (1 - zoom) + gate)
        )
        assert begin <= possible.min()
        assert possible.max() < end
        margin = star_evidence.FOCAL_MARGIN * zoom
        outside = angle[begin:end] - np.clip(
            angle[begin:end], seen / (1 + margin) - gate, seen / (1 - margin) + gate
        )
        assert np.abs(outside).max() <= SKY.bin_rad


def test_a_pair_s_focal_ratio_makes_its_angle_the_catalog_s() -> None:
    for ratio in (0.97, 1.0, 1.03):
        target = PLAIN.vectors.chord(PLAIN.ray(PLACES, 1, ratio), PLAIN.ray(PLACES, 2, ratio))
        # The fixed point contracts by about the square of a tangent, 5e-3, each time.
        assert PLAIN.fit_focal_ratio(PLACES, 1, 2, target) == pytest.approx(ratio, abs=1e-6)


def test_pairs_cost_as_many_catalog_pairs_as_are_expected() -> None:
    """Length times error; a light among others costs as much as it has neighbors, and a short pair most."""
    crowd, hubs = PLAIN._crowds(unequal())
    # The last one is 3 mrad from the first: both are crowded.
    assert crowd.tolist() == [2, 1, 1, 1, 1, 2]
    cost = np.array([PLAIN._pair_costs(unequal(), crowd, hub) for hub in range(6)])
    distance = np.linalg.norm(PLACES[:, None] - PLACES, axis=2)
    expected = distance * np.hypot(UNEQUAL[:, None], UNEQUAL) * crowd[:, None] * crowd
    far = distance > 0.01
    np.testing.assert_allclose(cost[far], expected[far], rtol=1e-12)
    assert cost[0, 5] == cost[5, 0] > 100 * expected.max()
    assert (np.diff(((np.arange(6) + 1) * crowd)[hubs]) >= 0).all()


@pytest.mark.parametrize("zoom", [0.0, 0.02])
def test_every_triangle_of_the_catalog_that_fits_is_closed(zoom: float) -> None:
    """Against all triples of 60 stars: the sides within 3.5 errors, for one focal length, and the same orientation."""
    vectors, mag = random_sky(60, 6)
    vectors = vectors * [0.05, 0.05, 0] + [0, 0, 1]
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    sky = sky_index.add_pairs(sky_index.build(vectors, mag), WIDE_RAD)
    sigma = 2e-4
    tangent = vectors[[7, 30, 41], :2] / vectors[[7, 30, 41], 2:] * (1 + zoom / 2)
    lights = detections_of(tangent, np.full(3, np.nan), sigma, zoom)
    rays = np.column_stack([tangent, np.ones(3)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    links = PLAIN._no_links(60)
    partners = np.array([1, 2])
    closed = []
    for count in (1, 2):
        low, high, chord, gate = PLAIN._pair_range(lights, sky, 0, count)
        wanted = PLAIN._wanted(lights, 0, partners[:count], gate / chord)
        pairs = (sky.pair, sky.first, low, high, sky.bin_rad)
        found, _ = PLAIN._close(
            pairs, vectors, mag, (np.nan, np.nan, 1.0), chord if zoom else 0.0, wanted, links
        )
        closed = [tuple(row) for row in links.closed[:found, :2].tolist()]
    side = [np.linalg.norm(rays[m] - rays[n]) for m, n in ((0, 1), (0, 2), (1, 2))]
    i, j, k = np.meshgrid(*[np.arange(60)] * 3, indexing="ij")
    chords = [
        np.linalg.norm(vectors[m] - vectors[n], axis=-1) for m, n in ((i, j), (i, k), (j, k))
    ]
    ratio = np.array(side)[:, None, None, None] / np.maximum(chords, 1e-9)
    middle = ratio[1] if zoom else 1.0
    fits = (i != j) & (j != k) & (i != k) & (abs(ratio[1] - 1) < zoom + 1e-4)
    for measured, there in zip(side, chords, strict=True):
        fits &= abs(there * middle - measured) < 3 * np.sqrt(2) * sigma
    fits &= (
        np.einsum("...x,...x", vectors[i], np.cross(vectors[j], vectors[k]))
        * (rays[0] @ np.cross(rays[1], rays[2]))
        > 0
    )
    expected = set(zip(i[fits].tolist(), k[fits].tolist(), strict=True))
    assert (7, 41) in expected
    assert expected <= set(closed)
    assert len(closed) < 60**2 / 10
    PLAIN._clear(links)
    assert not links.last.any()


@pytest.mark.parametrize("zoom", [0.0, 0.01])
def test_a_pair_s_attitude_counts_as_laplace_s_integral(zoom: float) -> None:
    """sqrt(2 pi)^n / sqrt(det info) over the prior volume, info that of two exact matches near the boresight."""
    near = np.array([[0.01, 0.004], [-0.008, -0.002]])
    detections = detections_of(near, [np.nan, np.nan], zoom=zoom)
    rays = np.column_stack([near, np.ones(2)])
    sky = sky_index.build(
        rays / np.linalg.norm(rays, axis=1, keepdims=True), np.array([1.0, 2.0])
    )
    info = np.zeros((4, 4))
    both = np.arange(2)
    star_evidence._fit(detections, sky, np.eye(3), 1.0, both, both, info)
    count = 4 if zoom else 3
    volume = 8 * np.pi**2 * (2 * zoom if zoom else 1)
    wanted = np.log10(
        np.sqrt(2 * np.pi) ** count / np.sqrt(np.linalg.det(info[:count, :count])) / volume
    )
    found = CHANCE.attitude_dex(
        detections.tangent, detections.sigma, 0, 1, 8 * np.pi**2, detections.focal_uncertainty
    )
    assert found == pytest.approx(wanted, abs=1e-3)


@pytest.mark.parametrize(("limit_mag", "matches"), [(np.nan, 4), (6.0, 0)])
def test_an_attitude_from_the_brightest_lights_must_be_confirmed_by_all(
    limit_mag: float, matches: int
) -> None:
    """Four stars are beyond chance among four lights, not among 104 as faint as stars that are missing."""
    rng = np.random.default_rng(4)
    truth = Rotation.random(rng=rng)
    sigma = 6 * SIGMA
    tangent, mag, _ = observe(truth, rng, sigma)
    false = rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (100, 2))
    lights = detections_of(
        np.concatenate([tangent[:4], false]), np.append(mag[:4], np.full(100, 6.0)), sigma
    )
    few = detections_module.chosen(lights, np.arange(4))
    candidate = star_evidence.evaluate(
        few, SKY, truth.as_matrix(), 1.0, gates_of(few, 1.5), -np.inf
    )
    assert candidate.dex > star_search.ACCEPT_DEX
    found = PLAIN.fit_to_all(lights._replace(limit_mag=limit_mag), SKY, candidate, True)
    assert len(found.star) == matches


def test_the_farthest_corner_of_a_field_off_the_axis_is_on_its_longer_sides() -> None:
    """sqrt(0.12^2 + 0.08^2) of the field from -0.1 to 0.12 by -0.08 to 0.06."""
    corner = PLAIN.squared_corner(np.array([-0.1, 0.12, -0.08, 0.06]))
    assert corner == pytest.approx(0.12**2 + 0.08**2)


def test_the_limiting_magnitude_is_taken_at_the_median_light() -> None:
    lens = Sensor(1000.0, (0.0, 0.0), (0.0,) * 5, FIELD, 20.0, 0.25)
    sigma_px = np.full(5, 0.1)
    flux = np.array([900.0, 500.0, 300.0, 200.0, 100.0])
    lights = detections_module.detections_of(
        (np.eye(5, 2), sigma_px, sigma_px, flux, NO_SPREAD), lens, 0.0
    )
    assert lights.limit_mag == pytest.approx(20 - 2.5 * np.log10(300))
    assert changed(lights, 4.0, 0.0).limit_mag == lights.limit_mag
    assert np.isnan(detections_module.chosen(lights, np.arange(4)).limit_mag)


def test_a_clump_displaces_no_light_elsewhere() -> None:
    """Of 300 lights in one cell and 20 elsewhere, all fainter, the 20 are among 40; the brightest of each cell are."""
    rng = np.random.default_rng(3)
    clump = 0.01 * rng.random((300, 2))
    alone = np.array(
        [[x, y] for x in (0.3, 0.45, 0.6, 0.75, 0.9) for y in (0.2, 0.4, 0.6, 0.8)]
    )
    rows = detections_module.spread(np.vstack([clump, alone]), np.array([0.0, 1, 0, 1]), 40)
    assert rows.tolist() == [*range(20), *range(300, 320)]
    few = detections_module.spread(alone, np.array([0.0, 1, 0, 1]), 20)
    assert few.tolist() == list(range(20))
