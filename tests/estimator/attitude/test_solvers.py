"""Wahba's problem: every method against scipy's SVD, half turns of every kind, the covariance by Monte Carlo."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude import wahba as kernel
from estimator.attitude.solvers import SOLVERS, Solver, covariance, quest
from estimator.core.types import ra_dec_roll_rad
from estimator.core.vectors import quaternion_xyzw
from tests.helpers.interpreted import interpreted

ARCSEC_RAD = np.pi / 180 / 3600
FOV_RAD = np.radians(14.87)
WIDTH_PX = 659
FOCAL_PX = (WIDTH_PX - 1) / 2 / np.tan(FOV_RAD / 2)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def in_field(
    rng: np.random.Generator, *shape: int, half: float = np.tan(FOV_RAD / 2)
) -> np.ndarray:
    """Directions about the boresight, uniform in a square field."""
    return unit(
        np.concatenate([rng.uniform(-half, half, (*shape, 2)), np.ones((*shape, 1))], axis=-1)
    )


# All stars' optimum; TRIAD's is that of two.
OPTIMAL = {name: solver for name, solver in SOLVERS.items() if name != "triad"}
COSTLY = "davenport", "svd", "esoq2"  # to compile
CASES = {
    name: pytest.param(solve, id=name, marks=[pytest.mark.slow] * (name in COSTLY))
    for name, solve in SOLVERS.items()
}
every_solver = pytest.mark.parametrize("solve", CASES.values())
every_optimal = pytest.mark.parametrize("solve", [CASES[name] for name in OPTIMAL])


def error_rad(a: Rotation, b: Rotation) -> float:
    return (a * b.inv()).magnitude()


@pytest.mark.compiles
@every_optimal
@pytest.mark.parametrize("count", [2, 3, 5, 20])
def test_each_solver_gives_the_svd_s_rotation(count: int, solve: Solver) -> None:
    rng = np.random.default_rng(40)
    for _ in range(100):
        ref = unit(rng.normal(size=(count, 3)))
        truth = Rotation.random(rng=rng)
        sigma = rng.uniform(1e-5, 1e-3, count)
        cam = unit(truth.apply(ref) + sigma[:, None] * rng.normal(size=(count, 3)))
        oracle, _ = Rotation.align_vectors(cam, ref, weights=1 / sigma**2)
        # 1e-10: the SVD of two directions a few degrees apart has lost some digits itself.
        assert error_rad(solve(cam, ref, sigma), oracle) < 1e-10


@pytest.mark.parametrize("count", [2, 5, 15])
def test_quest_gives_the_svd_s_rotation_in_a_star_tracker_s_field(count: int) -> None:
    rng = np.random.default_rng(41)
    for _ in range(100):
        truth = Rotation.random(rng=rng)
        seen = in_field(rng, count)
        cam = unit(seen + 1e-5 * rng.normal(size=seen.shape))
        ref = truth.inv().apply(seen)
        oracle, _ = Rotation.align_vectors(cam, ref)
        # Stars 0.1 rad apart cost the SVD a factor of 1e4 (their spread squared) and two of them more.
        assert error_rad(quest(cam, ref, np.ones(count)), oracle) < 1e-8


@pytest.mark.compiles
@every_solver
@pytest.mark.parametrize("half_rad", [0.1, 0.01, 1e-3, 2e-4])
def test_close_directions_keep_full_precision(half_rad: float, solve: Solver) -> None:
    # Noise-free, roll can be known to the rounding over the spread. (The bare quartic errs by 3 rad at 2e-4.)
    rng = np.random.default_rng(42)
    for _ in range(100):
        truth = Rotation.random(rng=rng)
        cam = (
            half_rad
            * np.array([[1, 0], [-0.5, 0.9], [-0.5, -0.9]])
            * rng.uniform(0.5, 1, (3, 1))
        )
        cam = unit(np.column_stack([cam, np.ones(3)]))
        assert (
            error_rad(solve(cam, truth.inv().apply(cam), np.ones(3)), truth)
            < 20 * 2.2e-16 / half_rad
        )


@pytest.mark.compiles
@every_solver
def test_directions_on_one_great_circle_are_enough(solve: Solver) -> None:
    rng = np.random.default_rng(43)
    for _ in range(50):
        angle = rng.uniform(0, 0.2, 6)
        truth = Rotation.random(rng=rng)
        cam = np.column_stack([np.sin(angle), 1e-9 * rng.normal(size=6), np.cos(angle)])
        cam = unit(cam)
        # 1e-13: rounding over a spread of 0.06 rad.
        assert error_rad(solve(cam, truth.inv().apply(cam), np.ones(6)), truth) < 1e-13


AXES = {
    "x": [1, 0, 0],
    "y": [0, 1, 0],
    "z": [0, 0, 1],
    "xy": [1, 1, 0],
    "yz": [0, -1, 1],
    "xyz": [1, 1, 1],
    "oblique": [0.3, -0.5, 0.8],
    "nearly x": [1, 1e-9, 0],
}


@pytest.mark.compiles
@every_solver
@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("short_of_rad", [0.0, 1e-12, 1e-8, 1e-4])
def test_half_turns_about_any_axis_are_solved(
    axis: str, short_of_rad: float, solve: Solver
) -> None:
    rng = np.random.default_rng(44)
    truth = Rotation.from_rotvec(
        (np.pi - short_of_rad) * unit(np.array(AXES[axis], dtype=float))
    )
    for count in (2, 3, 8):
        for _ in range(20):
            ref = in_field(rng, count) if count == 8 else unit(rng.normal(size=(count, 3)))
            cross = np.linalg.norm(np.cross(ref[0], ref[1]))
            # Rounding over the angle between the directions.
            assert error_rad(
                solve(truth.apply(ref), ref, np.ones(count)), truth
            ) < 1e-14 / min(cross, 0.1)


QUARTER_TURNS = list(Rotation.create_group("O"))


@every_solver
@pytest.mark.parametrize("truth", QUARTER_TURNS, ids=range(24))
@pytest.mark.parametrize("count", [2, 3])
def test_all_24_orientations_of_a_cube_are_solved(
    truth: Rotation, count: int, solve: Solver
) -> None:
    # Exact zeros and ones: where a quaternion's parts vanish altogether.
    ref = np.eye(3)[:count]
    assert error_rad(solve(truth.apply(ref), ref, np.ones(count)), truth) < 1e-14  # rounding


@every_optimal
def test_a_more_accurate_star_weighs_more(solve: Solver) -> None:
    # Of two pairs of directions that disagree by 0.1 rad of roll, the hundred times better decides but for 1e-4.
    ref = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    cam = np.vstack([ref[:2], Rotation.from_rotvec([0, 0, 0.1]).apply(ref[2:])])
    rotated = solve(cam, ref, np.array([1.0, 1, 100, 100])).as_rotvec()
    assert rotated[2] == pytest.approx(0.1e-4, rel=1e-2)


@every_solver
@pytest.mark.parametrize(
    "vectors",
    [
        np.empty((0, 3)),
        np.array([[0, 0, 1.0]]),
        np.array([[0, 0.6, 0.8]] * 5),
        np.array([[0, 0.6, 0.8], [0, -0.6, -0.8]]),
    ],
    ids=["none", "one", "five alike", "opposite"],
)
def test_parallel_directions_are_refused(vectors: np.ndarray, solve: Solver) -> None:
    with pytest.raises(ValueError, match="all vectors are parallel"):
        solve(vectors, vectors, np.ones(len(vectors)))


@every_solver
def test_stars_that_coincide_in_camera_or_catalog_are_refused(solve: Solver) -> None:
    distinct = np.eye(3)[:2]
    identical = np.eye(3)[[0, 0]]
    for cam, ref in ((distinct, identical), (identical, distinct)):
        with pytest.raises(ValueError, match="all vectors are parallel"):
            solve(cam, ref, np.ones(2))


@every_solver
@pytest.mark.parametrize(
    ("cam", "ref", "sigma", "what"),
    [
        (
            np.eye(3),
            np.eye(3),
            np.array([1.0, 0.0, 1.0]),
            "sigma_rad is not usable; allowed: finite, above 0",
        ),
        (np.eye(3), np.eye(3), np.array([1.0, np.nan, 1.0]), "sigma_rad is not usable"),
        (np.eye(3), np.eye(3), np.array([1.0, -1.0, 1.0]), "sigma_rad is not usable"),
        (np.diag([1.0, np.nan, 1.0]), np.eye(3), np.ones(3), "a direction is NaN"),
        (
            np.diag([1.0, 1.02, 1.0]),
            np.eye(3),
            np.ones(3),
            "a direction is not of unit length",
        ),
        (
            np.eye(3),
            np.diag([1.0, 1.0, 0.98]),
            np.ones(3),
            "a direction is not of unit length",
        ),
        (np.eye(3), np.eye(3)[:2], np.ones(3), r"shapes .* allowed: \(N, 3\)"),
        (np.eye(3), np.eye(3), np.ones(2), r"shapes .* allowed: \(N, 3\)"),
        (np.ones(3), np.ones(3), np.ones(3), r"shapes .* allowed: \(N, 3\)"),
    ],
)
def test_bad_directions_are_refused_in_one_line(
    cam: np.ndarray, ref: np.ndarray, sigma: np.ndarray, what: str, solve: Solver
) -> None:
    with pytest.raises(ValueError, match=what) as caught:
        solve(cam, ref, sigma)
    assert "\n" not in str(caught.value)


# ---- One optimum, many ways ----


def same_data(
    case: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noisy directions in camera axes and their catalog's, and sigmas that differ by a factor of three."""
    count = {"two stars": 2, "two close stars": 2, "a few stars": 5}.get(case, 15)
    seen = in_field(rng, count)
    if case == "two close stars":
        seen = in_field(rng, count, half=0.005)
    if case == "near-collinear":
        seen = unit(seen * [1, 1e-6, 1])
    truth = Rotation.random(rng=rng)
    if case == "half a turn":
        truth = Rotation.from_rotvec(np.pi * unit(rng.normal(size=3)))
    if case == "no turn":
        truth = Rotation.identity()
    sigma = rng.uniform(2e-5, 6e-5, count)
    return (
        unit(seen + sigma[:, None] * rng.normal(size=seen.shape)),
        truth.inv().apply(seen),
        sigma,
    )


CASES = [
    "two stars",
    "two close stars",
    "a few stars",
    "many stars",
    "near-collinear",
    "half a turn",
    "no turn",
]


@pytest.mark.compiles
@pytest.mark.parametrize("case", CASES)
def test_all_methods_give_the_same_optimum_on_the_same_data(case: str) -> None:
    rng = np.random.default_rng(50)
    for _ in range(50):
        cam, ref, sigma = same_data(case, rng)
        solvers = SOLVERS if len(cam) == 2 else OPTIMAL
        answers = Rotation.concatenate([solve(cam, ref, sigma) for solve in solvers.values()])
        assert (answers * answers[0].inv()).magnitude().max() < 1e-10
        # An optimum: the gradient of Wahba's loss, sum(w a x cam), vanishes to the rounding of its terms.
        rotated = answers[0].apply(ref)
        weight = sigma**-2 / np.sum(sigma**-2)
        assert np.abs(weight @ np.cross(rotated, cam)).max() < 4e-16


RAW = {
    "quest": kernel.raw_quest,
    "davenport": kernel.raw_davenport,
    "esoq2": kernel.raw_esoq2,
    "svd": kernel.raw_svd,
}


def davenport_matrix(B: np.ndarray) -> np.ndarray:
    """K of Davenport's q-method for active quaternions (x, y, z, w): q' K q = tr(A(q) B')."""
    S = B + B.T
    trace = np.trace(B)
    z = np.array([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])
    return np.block([[S - trace * np.eye(3), z[:, None]], [z[None], np.array([[trace]])]])


@pytest.mark.compiles
@pytest.mark.parametrize("name", RAW)
@pytest.mark.parametrize("half_turn", [False, True])
def test_each_bare_method_solves_davenport_s_equation_itself(
    name: str, half_turn: bool
) -> None:
    # Over the whole sky the bare methods need no refinement: K q = x q, x the greatest eigenvalue (numpy's).
    rng = np.random.default_rng(51)
    for _ in range(200):
        ref = unit(rng.normal(size=(6, 3)))
        sigma = rng.uniform(1e-4, 1e-2, 6)
        axis = unit(rng.normal(size=3))
        truth = Rotation.from_rotvec(np.pi * axis) if half_turn else Rotation.random(rng=rng)
        cam = unit(truth.apply(ref) + sigma[:, None] * rng.normal(size=ref.shape))
        weight = sigma**-2 / np.sum(sigma**-2)
        B = np.einsum("n,ni,nj->ij", weight, cam, ref)
        values, vectors = np.linalg.eigh(davenport_matrix(B))
        gap = values[3] - values[2]  # weights of 1 and 1e-4 alone leave it small
        q = Rotation.from_matrix(RAW[name](B)).as_quat()
        assert np.abs(davenport_matrix(B) @ q - values[3] * q).max() < 1e-13
        assert 1 - abs(q @ vectors[:, 3]) < (1e-13 / gap) ** 2 + 1e-15
        assert kernel.largest_eigenvalue(B) == pytest.approx(
            values[3], abs=1e-14 / min(gap, 1)
        )


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("name", RAW)
def test_each_bare_method_is_exact_at_half_a_turn(name: str, axis: str) -> None:
    # QUEST's own vector is infinite there, and ESOQ2's matrix vanishes at no turn: another frame is taken.
    ref = unit(np.array([[1, 0.2, 0.1], [-0.3, 1, 0.4], [0.1, -0.6, 1]]))
    for angle in (np.pi, 0.0):
        truth = Rotation.from_rotvec(angle * unit(np.array(AXES[axis], dtype=float)))
        B = truth.apply(ref).T @ ref / 3
        assert (
            np.abs(RAW[name](B) - truth.as_matrix()).max() < 1e-13
        )  # rounding over a gap of 0.3


def test_no_method_reads_outside_its_arrays() -> None:
    """NumPy refuses an index beyond an array; compiled code would read and write what lies behind it."""
    plain = interpreted("estimator.attitude.wahba")
    rng = np.random.default_rng(56)
    for truth in [*QUARTER_TURNS, *Rotation.random(20, rng=rng)]:
        ref = unit(rng.normal(size=(4, 3)))
        cam = unit(truth.apply(ref) + 1e-4 * rng.normal(size=ref.shape))
        weight = rng.uniform(1, 9, 4)
        B = plain.profile(cam, ref, weight)
        np.testing.assert_allclose(B, kernel.profile(cam, ref, weight), rtol=0, atol=1e-15)
        for name in RAW:
            # Of a raw method the rounding is over the gap of the two largest eigenvalues.
            found = getattr(plain, f"raw_{name}")(B)
            np.testing.assert_allclose(found, RAW[name](B), rtol=0, atol=1e-10, err_msg=name)
        for one, other in zip(
            plain.wahba(cam, ref, weight), kernel.wahba(cam, ref, weight), strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-13)
        np.testing.assert_allclose(
            plain.raw_triad(cam, ref, weight),
            kernel.raw_triad(cam, ref, weight),
            rtol=0,
            atol=1e-13,
        )


@pytest.mark.slow
def test_bare_quest_loses_precision_in_a_narrow_field_and_polishing_restores_it() -> None:
    rng = np.random.default_rng(52)
    worst = 0.0
    for _ in range(50):
        cam, ref, sigma = same_data("two close stars", rng)
        B = np.einsum("n,ni,nj->ij", sigma**-2 / np.sum(sigma**-2), cam, ref)
        worst = max(
            worst,
            error_rad(Rotation.from_matrix(kernel.raw_quest(B)), quest(cam, ref, sigma)),
        )
    assert worst > 1e-10  # what the methods are to agree to


# ---- TRIAD ----


def test_triad_with_one_perfect_star_is_black_s_triad() -> None:
    # Black 1964: the first star's direction is met exactly; the second sets the plane alone.
    rng = np.random.default_rng(53)
    for _ in range(50):
        ref = unit(rng.normal(size=(2, 3)))
        truth = Rotation.random(rng=rng)
        cam = unit(truth.apply(ref) + 0.01 * rng.normal(size=(2, 3)))

        def triad_of(v: np.ndarray) -> np.ndarray:
            normal = unit(np.cross(v[0], v[1]))
            return np.column_stack([v[0], normal, np.cross(v[0], normal)])

        black = Rotation.from_matrix(triad_of(cam) @ triad_of(ref).T)
        # The second star's weight of 1e-14 turns it by 1e-14 of the 0.01 rad by which they disagree.
        assert error_rad(SOLVERS["triad"](cam, ref, np.array([1.0, 1e7])), black) < 1e-14


@pytest.mark.parametrize(
    "half", [np.tan(FOV_RAD / 2), 5.0], ids=["a star tracker's field", "nearly half the sky"]
)
def test_triad_uses_the_pair_with_the_least_maximum_variance(half: float) -> None:
    rng = np.random.default_rng(54)
    for _ in range(50):
        cam = in_field(rng, 8, half=half)
        sigma = rng.uniform(1e-5, 1e-4, 8)

        def worst(pair: tuple[int, int]) -> float:
            rows = list(pair)
            return float(np.linalg.eigvalsh(covariance(cam[rows], sigma[rows]))[-1])  # noqa: B023

        pairs = [(m, n) for m in range(8) for n in range(m + 1, 8)]
        best = min(pairs, key=worst)
        assert kernel.best_pair(cam, sigma**-2) == best
        predicted = covariance(cam, sigma, solver="triad")
        assert np.abs(predicted - covariance(cam[list(best)], sigma[list(best)])).max() == 0
        # Another star moved changes nothing.
        other = next(n for n in range(8) if n not in best)
        ref = cam.copy()
        ref[other] = unit(ref[other] + [1e-4, 0, 0])
        assert error_rad(SOLVERS["triad"](cam, ref, sigma), Rotation.identity()) < 1e-13


# ---- The covariance ----


@pytest.mark.slow
def test_the_compiled_core_gives_the_optimum_and_its_covariance() -> None:
    rng = np.random.default_rng(55)
    for _ in range(50):
        cam, ref, sigma = same_data("many stars", rng)
        found, spread = kernel.wahba(cam, ref, sigma**-2)
        # Rounding over the field.
        assert error_rad(Rotation.from_matrix(found), quest(cam, ref, sigma)) < 1e-13
        assert np.abs(found @ found.T - np.eye(3)).max() < 1e-15
        information = np.einsum(
            "n,nij->ij", sigma**-2, np.eye(3) - cam[:, :, None] * cam[:, None, :]
        )
        # Rounding over its condition, 300.
        assert np.abs(spread @ information - np.eye(3)).max() < 1e-11


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi])
def test_quaternions_and_matrices_match_scipy(axis: str, angle_rad: float) -> None:
    rotation = Rotation.from_rotvec(angle_rad * unit(np.array(AXES[axis], dtype=float)))
    found = quaternion_xyzw(rotation.as_matrix())
    # Either sign is the same turn.
    assert (
        min(
            np.abs(found - rotation.as_quat()).max(), np.abs(found + rotation.as_quat()).max()
        )
        < 1e-15
    )
    assert (
        np.abs(kernel.matrix_of(tuple(3 * rotation.as_quat())) - rotation.as_matrix()).max()
        < 1e-15
    )


def monte_carlo(
    count: int, half: float, trials: int, seed: int, name: str = "quest"
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (trials, 3) in camera axes and the covariances claimed, at 0.1 px a star and axis."""
    rng = np.random.default_rng(seed)
    sigma = np.full(count, 0.1 / FOCAL_PX)
    errors = []
    claimed = []
    for _ in range(trials):
        truth = Rotation.random(rng=rng)
        seen = in_field(rng, count, half=half)
        tangent = seen[:, :2] / seen[:, 2:] + sigma[:, None] * rng.normal(size=(count, 2))
        cam = unit(np.column_stack([tangent, np.ones(count)]))
        errors.append(
            (SOLVERS[name](cam, truth.inv().apply(seen), sigma) * truth.inv()).as_rotvec()
        )
        claimed.append(covariance(cam, sigma, name))
    return np.array(errors), np.array(claimed)


@pytest.mark.slow
def test_fifteen_stars_have_the_reference_s_error() -> None:
    errors, claimed = monte_carlo(15, np.tan(FOV_RAD / 2), 1500, seed=45)
    cross, roll = (
        np.sqrt([np.mean(errors[:, :2] ** 2), np.mean(errors[:, 2] ** 2)]) / ARCSEC_RAD
    )
    # Reference section 3 (14.87 deg, 659 px, 0.1 px): 2.17" an axis and 21.1" rms; 1,500 trials give 1.3 and 1.8 %.
    assert cross == pytest.approx(2.17, rel=0.05)
    assert roll == pytest.approx(21.1, rel=0.06)
    predicted = np.sqrt(np.mean(claimed, axis=0).diagonal()) / ARCSEC_RAD
    assert predicted == pytest.approx([cross, cross, roll], rel=0.05)


@pytest.mark.compiles
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("count", [2, 3, 5, 30])
def test_the_covariance_matches_the_scatter(count: int, name: str) -> None:
    errors, claimed = monte_carlo(count, np.tan(np.radians(5)), 600, seed=46, name=name)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(claimed), errors)
    # Chi-square of three degrees: mean 3, deviation sqrt(6 / 600) = 0.1; three of them, and 1 % for the
    # tangent plane's own unevenness within 5 degrees.
    assert nees.mean() == pytest.approx(3, abs=0.33)


def test_the_covariance_of_three_axes_matches_a_hand_calculation() -> None:
    # Directions along x, y, z of sigma s: each axis is seen by the other two: s^2 / 2.
    # rounding.
    np.testing.assert_allclose(
        covariance(np.eye(3), np.full(3, 2e-5)), 2e-10 * np.eye(3), rtol=0, atol=1e-24
    )


def looking(x: list, y: list, z: list) -> Rotation:
    """cam_from_icrs from the camera axes in ICRS."""
    return Rotation.from_matrix(np.array([x, y, z], dtype=float))


HALF = np.pi / 2
BY_HAND = {
    # RA 0, dec 0 (sight +X), north up (down = -Z): right is west, -Y.
    "equinox, north up": (looking([0, -1, 0], [0, 0, -1], [1, 0, 0]), (0, 0, 0)),
    # Up is east, +Y: down = -Y; right is north, +Z.
    "equinox, east up": (looking([0, 0, 1], [0, -1, 0], [1, 0, 0]), (0, 0, HALF)),
    # Up is west: down = +Y, right is south.
    "equinox, west up": (looking([0, 0, -1], [0, 1, 0], [1, 0, 0]), (0, 0, -HALF)),
    "equinox, south up": (looking([0, 1, 0], [0, 0, 1], [1, 0, 0]), (0, 0, np.pi)),
    # RA 90 (sight +Y), north up: east is -X, so right is +X.
    "solstice, north up": (looking([1, 0, 0], [0, 0, -1], [0, 1, 0]), (HALF, 0, 0)),
    # RA 270 (sight -Y), north up: right is -X.
    "winter, north up": (looking([-1, 0, 0], [0, 0, -1], [0, -1, 0]), (3 * HALF, 0, 0)),
    # North pole on the meridian RA 0: north there is -X; up = -X, so down = +X, right = down x sight = X x Z = -Y.
    "north pole": (looking([0, -1, 0], [1, 0, 0], [0, 0, 1]), (0, HALF, 0)),
    # South pole: north is +X; down = -X, right = -X x -Z = X x Z = -Y.
    "south pole": (looking([0, -1, 0], [-1, 0, 0], [0, 0, -1]), (0, -HALF, 0)),
}


@pytest.mark.parametrize("case", BY_HAND)
def test_right_ascension_declination_and_roll_match_a_hand_calculation(case: str) -> None:
    camera, (ra, dec, roll) = BY_HAND[case]
    found = ra_dec_roll_rad(camera)
    assert found[:2] == pytest.approx((ra, dec), abs=1e-15)  # rounding
    assert found[2] == pytest.approx(roll, abs=1e-15)


def from_angles(ra: float, dec: float, roll: float) -> Rotation:
    """cam_from_icrs by three rotations: Z by right ascension, Y by declination, then roll about the boresight."""
    # Intrinsic: carries +X to the sight, +Z to up.
    to_sight = Rotation.from_euler("ZYX", [ra, -dec, -roll])
    axes = to_sight.apply([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    return Rotation.from_matrix(axes)


@pytest.mark.parametrize("dec_deg", [-89.9999, -60, 0, 33, 89.999999])
def test_angles_are_recovered_from_their_rotation(dec_deg: float) -> None:
    rng = np.random.default_rng(47)
    for ra, roll in rng.uniform([0, -3.1], [6.28, 3.1], (50, 2)):
        found = np.array(ra_dec_roll_rad(from_angles(ra, np.radians(dec_deg), roll)))
        # Rounding; near a pole right ascension and roll are known to rounding over the distance from it.
        near = np.cos(np.radians(dec_deg))
        np.testing.assert_allclose(found[1], np.radians(dec_deg), rtol=0, atol=2e-15)
        np.testing.assert_allclose(found[[0, 2]], [ra, roll], rtol=0, atol=4e-15 / near)


def test_a_right_ascension_just_short_of_zero_stays_below_a_full_circle() -> None:
    ra, _, _ = ra_dec_roll_rad(looking([-1e-17, -1, 0], [0, 0, -1], [1, -1e-17, 0]))
    assert 0 <= ra < 2 * np.pi
