"""Laws of calibration: bundle adjustment and its gauge, the dome's survey, the lens from star fields."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.calibration import bundle_adjustment as ba
from estimator.calibration import dome_survey, star_field, survey_subset
from estimator.calibration.bundle_adjustment import Assumed, Bundle, Sightings
from estimator.calibration.dome_survey import DomeFrame, DomeSurvey, survey
from estimator.calibration.star_field import LensPrior, StarFrame
from estimator.calibration.survey_subset import Subset
from estimator.catalog.catalog import StarCatalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Attitude, Centroids, StarMatch
from tests.helpers.laws import (
    ANY,
    NUMBERS,
    SEEDS,
    answered,
    assert_covariance,
    law,
    turn,
    units,
)
from tests.helpers.lens_and_streak import disagreement_px

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
LIGHTS = 14
FRAMES = 6
CAMERA = Camera(640, 480, 400.0, (318.0, 241.0), (-0.05, 0.01, 1e-3, -1e-3, 0.0))
LENS = np.array([CAMERA.focal_px, *CAMERA.center_px, *CAMERA.distortion])


def dome(rng: np.random.Generator, noise_px: float = 0.0) -> tuple[Bundle, Sightings]:
    """Lights overhead that are all seen in every frame of a tilting and rotating camera."""
    across = rng.uniform(-0.4, 0.4, (LIGHTS, 2))
    place = np.column_stack(
        [across, 1.2 - 0.3 * np.sum(across**2, axis=1) + rng.uniform(-0.1, 0.1, LIGHTS)]
    )
    lean = 0.25 * units(rng, FRAMES)
    yaw = rng.uniform(0, 2 * np.pi, FRAMES)
    turned = Rotation.from_rotvec(lean * [1, 1, 0]) * Rotation.from_rotvec(
        yaw[:, None] * [0, 0, 1]
    )
    true = Bundle(
        *(
            place,
            turned.as_matrix(),
            np.array([0.02, -0.03, 0.35]),
            turn(rng, 0.1).as_matrix(),
            LENS,
            3,
            place,
        )
    )
    frame, led = np.divmod(np.arange(FRAMES * LIGHTS), LIGHTS)
    seen = Sightings(frame, led, np.zeros((len(led), 2)), rng.uniform(0.05, 0.2, len(led)))
    pixels = -ba.residuals(true, seen) * seen.sigma_px[:, None]
    return true, replace(seen, xy_px=pixels + rng.normal(0, 1, pixels.shape) * noise_px)


def nudged(rng: np.random.Generator, true: Bundle, by: float) -> Bundle:
    """The parameters with small random errors."""
    return true.apply_step(
        rng.normal(0, by, 3 * LIGHTS), rng.normal(0, by, 3 * FRAMES + 3 + 3)
    )


def whole_matrix(terms: ba.NormalEquations) -> Floats:
    """The normal matrix of all unknowns, lights first."""
    coupling = terms.coupling.toarray()
    return np.block([[block_diag(*terms.by_led), coupling.T], [coupling, terms.rest]])


# Bundle adjustment


@law(Sightings.of, Sightings.in_frames)
@given(rng=SEEDS)
def test_sightings_are_those_of_the_frames_in_their_order(rng: np.random.Generator) -> None:
    counts = rng.integers(0, 4, FRAMES)
    frames = [
        StarFrame(rng.uniform(0, 99, (count, 2)), rng.uniform(1, 2, count), units(rng, count))
        for count in counts
    ]
    led = rng.permutation(counts.sum())
    seen = Sightings.of(frames, led)
    assert (seen.led == led).all()
    for (frame, n), xy_px, sigma_px in zip(
        seen.in_frames, seen.xy_px, seen.sigma_px, strict=True
    ):
        assert (frames[frame].xy_px[n] == xy_px).all()
        assert frames[frame].sigma_px[n] == sigma_px
    assert (np.bincount(seen.frame, minlength=FRAMES) == counts).all()


@law(ba.linearize, ba.residuals, Bundle.start, Bundle.apply_step, Sightings.take)
@given(rng=SEEDS)
def test_the_jacobian_rows_match_finite_differences_of_the_residuals(
    rng: np.random.Generator,
) -> None:
    true, seen = dome(rng)
    seen = seen.take(rng.permutation(len(seen.led))[:20])
    rows = ba.linearize(true, seen)
    step = 1e-6
    led = rng.normal(size=3 * LIGHTS)
    rest = rng.normal(size=3 * FRAMES + 6)
    moved = [
        ba.residuals(true.apply_step(sign * step * led, sign * step * rest), seen)
        for sign in (-1, 1)
    ]
    by_led = np.einsum("mai,mi->ma", rows.by_led, led.reshape(-1, 3)[seen.led])
    by_rotation = np.einsum(
        "mai,mi->ma", rows.by_rotation, rest[: 3 * FRAMES].reshape(-1, 3)[seen.frame]
    )
    slope = by_led + by_rotation + rows.by_shared @ rest[3 * FRAMES :]
    np.testing.assert_allclose(
        (moved[0] - moved[1]) / (2 * step), slope, rtol=1e-4, atol=1e-4 * np.abs(slope).max()
    )
    np.testing.assert_allclose(rows.residual, ba.residuals(true, seen), rtol=0, atol=1e-9)


@law(
    Bundle.equations,
    ba.eliminate_lights,
    ba.step,
    ba.cauchy,
    ba.robust_scale,
    Bundle.cost,
)
@given(rng=SEEDS, damping=some.floats(1e-6, 1), width=some.floats(0.5, 9))
def test_eliminating_the_lights_solves_the_whole_system(
    rng: np.random.Generator, damping: float, width: float
) -> None:
    true, seen = dome(rng, 0.1)
    bundle = nudged(rng, true, 1e-3)
    weight = rng.uniform(0.1, 1, len(seen.led))
    terms = bundle.equations(seen, weight)
    whole = whole_matrix(terms)
    assert_covariance(whole)
    led, rest = ba.step(terms, ba.eliminate_lights(terms, damping))
    pull = np.concatenate([terms.rhs_led, terms.rhs_rest])
    whole[np.diag_indices_from(whole)] *= 1 + damping
    left_over = whole @ np.concatenate([led, rest]) - pull
    np.testing.assert_allclose(left_over, 0, rtol=0, atol=1e-5 * np.abs(pull).max())
    squared = np.sum(ba.residuals(bundle, seen) ** 2, axis=1)
    cost, lighter = ba.cauchy(squared, width)
    assert 0 <= cost <= ba.cauchy(squared, np.inf)[0] * (1 + 1e-12)
    assert ((lighter > 0) & (lighter <= 1)).all()
    np.testing.assert_allclose(bundle.cost(seen, width)[0], cost, rtol=1e-12, atol=0)
    assert ba.robust_scale(bundle, seen) == max(
        1.0, np.median(np.sqrt(squared)) / ba.MEDIAN_RADIUS
    )


@law(ba.summed, ba.attitude_equations, Bundle.equations)
@given(rng=SEEDS, rows=some.integers(1, FRAMES * LIGHTS))
def test_the_equations_of_an_attitude_are_those_of_its_own_sightings(
    rng: np.random.Generator, rows: int
) -> None:
    """Each is J^T W J and J^T W e, as of its frame alone; it is a block of the whole bundle's equations."""
    true, seen = dome(rng, 0.1)
    seen = seen.take(rng.permutation(len(seen.led))[:rows])
    weight = rng.uniform(0.1, 1, rows)
    terms = ba.linearize(true, seen)
    matrix, pull = ba.attitude_equations(terms, seen, weight, FRAMES)
    whole = true.equations(seen, weight)
    for frame in range(FRAMES):
        own = seen.frame == frame
        slopes = terms.by_rotation[own].reshape(-1, 3)
        weighted = np.repeat(weight[own], 2)[:, None] * slopes
        unknowns = slice(3 * frame, 3 * frame + 3)
        expected = weighted.T @ slopes
        fall = weighted.T @ terms.residual[own].ravel()
        for found, known in (
            (matrix[frame], expected if own.any() else np.eye(3)),
            (whole.rest[unknowns, unknowns], expected),
            (pull[frame], fall),
            (whole.rhs_rest[unknowns], fall),
        ):
            size = 1e-9 * np.abs(known).max()
            np.testing.assert_allclose(found, known, rtol=0, atol=size)
    counts = ba.summed(np.ones((rows, 2)), seen.led, LIGHTS)
    assert (counts == np.bincount(seen.led, minlength=LIGHTS)[:, None]).all()


@law(Assumed.less, Assumed.weight, Bundle.cost, Bundle.equations)
@given(
    rng=SEEDS,
    lever_m=some.floats(0, 0.1),
    focal_px=some.floats(0, 20),
    list_m=some.floats(1e-4, 0.1),
)
def test_an_assumption_acts_as_a_measurement_of_its_weight(
    rng: np.random.Generator, lever_m: float, focal_px: float, list_m: float
) -> None:
    """The right-hand sides are half the cost's falling slope, and the matrix has 1 / sigma^2 more for each value."""
    true, seen = dome(rng, 0.1)
    assumed = Assumed(
        true.camera_body_m + rng.normal(0, 0.01, 3),
        lever_m,
        LENS[0] + rng.normal(0, 5),
        focal_px,
    )
    bundle = replace(nudged(rng, true, 1e-3), map_sigma_m=list_m)
    known = replace(bundle, assumed=assumed)
    every = np.ones(len(seen.led))
    terms = known.equations(seen, every)
    more = np.diag(terms.rest - bundle.equations(seen, every).rest)
    sigma = np.maximum(
        [lever_m] * 3 + [focal_px], ba.EXACT * np.array([1, 1, 1, assumed.focal_px])
    )
    np.testing.assert_allclose(
        more[3 * FRAMES : 3 * FRAMES + 4], sigma**-2.0, rtol=1e-3, atol=1e-3
    )
    assert np.abs(np.delete(more, np.s_[3 * FRAMES : 3 * FRAMES + 4])).max() == 0
    led = rng.normal(size=3 * LIGHTS)
    rest = rng.normal(size=3 * FRAMES + 6)
    step = 1e-7
    costs = [
        known.apply_step(sign * step * led, sign * step * rest).cost(seen, np.inf)[0]
        for sign in (-1, 1)
    ]
    slope = (costs[0] - costs[1]) / (2 * step)
    pull = 2 * (terms.rhs_led @ led + terms.rhs_rest @ rest)
    np.testing.assert_allclose(
        slope, pull, rtol=1e-3, atol=1e-5 * max(costs) + 1e-9 * max(costs) / step
    )


@law(dome_survey.redundancy, dome_survey.check_redundancy, Subset.terms)
@given(rng=SEEDS, list_m=some.floats(1e-4, 0.1), rows=some.integers(40, FRAMES * LIGHTS))
def test_redundancy_is_the_share_of_residuals_that_the_unknowns_do_not_absorb(
    rng: np.random.Generator, list_m: float, rows: int
) -> None:
    """By definition: their number less the trace of the hat matrix, which takes pixels to those of the fit."""
    true, seen = dome(rng, 0.1)
    seen = seen.take(rng.permutation(len(seen.led))[:rows])
    every = np.ones(rows)
    pixels = whole_matrix(true.equations(seen, every))
    known = replace(
        true, map_sigma_m=list_m, assumed=Assumed(true.camera_body_m, 0.005, LENS[0], 5.0)
    )
    part = Subset(known, seen, np.arange(LIGHTS), np.arange(FRAMES), np.arange(rows))
    terms = part.terms
    covariances = survey_subset.covariance(terms, known)
    spare = 2 * rows - np.trace(np.linalg.solve(whole_matrix(terms), pixels))
    assert dome_survey.redundancy(part, covariances) == pytest.approx(spare, abs=1e-3)
    assert (
        answered(lambda: dome_survey.check_redundancy(part, covariances) or True) is None
    ) == (spare < dome_survey.MIN_REDUNDANCY)


@law(
    survey_subset.covariance,
    survey_subset.common_errors,
    Camera.with_lens,
    Camera.lens,
)
@given(rng=SEEDS, list_m=some.floats(1e-4, 0.1), fits=some.booleans())
def test_common_errors_are_the_part_of_the_inverse_matrix_that_lever_and_lens_share(
    rng: np.random.Generator, list_m: float, fits: bool
) -> None:
    """They hold all of lever and lens, and what lights share with these, of the inverse of the whole normal matrix."""
    true, seen = dome(rng)
    known = replace(
        true,
        map_sigma_m=list_m,
        free_lens=7 if fits else 3,
        assumed=Assumed(true.camera_body_m, 0.005, LENS[0], 5.0),
    )
    np.testing.assert_array_equal(CAMERA.with_lens(2 * CAMERA.lens).lens, 2 * LENS)
    terms = known.equations(seen, np.ones(len(seen.led)))
    whole = whole_matrix(terms)
    scale = np.sqrt(np.diag(whole))
    inverse = np.linalg.inv(whole / np.outer(scale, scale)) / np.outer(scale, scale)
    position_m, camera = survey_subset.common_errors(terms, known)
    light_m = position_m.reshape(len(position_m), -1)
    first = 3 * (LIGHTS + FRAMES)
    sigma = np.sqrt(np.diag(inverse))
    for found, block in (
        (camera.T @ camera, (slice(first, None), slice(first, None))),
        (light_m.T @ camera, (slice(3 * LIGHTS), slice(first, None))),
    ):
        size = np.outer(sigma[block[0]], sigma[block[1]])
        np.testing.assert_allclose(found / size, inverse[block] / size, rtol=0, atol=1e-4)
    own = inverse[: 3 * LIGHTS, : 3 * LIGHTS] - light_m.T @ light_m
    assert np.linalg.eigvalsh(own).min() > -1e-6 * np.trace(own)
    blocks = survey_subset.covariance(terms, known)
    by_three = inverse[:first, :first].reshape(-1, 3, first // 3, 3)
    diagonal = np.einsum("iajb->iab", by_three * np.eye(first // 3)[:, None, :, None])
    for found, block in (
        (np.concatenate([blocks.by_led, blocks.by_rotation]), diagonal),
        (blocks.shared[None], inverse[None, first:, first:]),
    ):
        size = np.einsum("nii->n", block)[:, None, None]
        np.testing.assert_allclose(found / size, block / size, rtol=0, atol=1e-4)


@law(ba.adjust, ba.fit_attitudes, survey_subset.covariance)
@given(rng=SEEDS, by=some.floats(0, 3e-3))
def test_an_adjustment_converges_to_the_observed_pixels(
    rng: np.random.Generator, by: float
) -> None:
    true, seen = dome(rng)
    # The map, which is exact here, fixes the moves that change no pixel.
    start = replace(nudged(rng, true, by), map_sigma_m=0.01)
    turned = ba.fit_attitudes(start, seen, 3)
    assert turned.cost(seen, np.inf)[0] <= start.cost(seen, np.inf)[0] * (1 + 1e-9) + 1e-9
    found, status = ba.adjust(turned, seen, np.inf)
    assert status == "converged"
    assert np.abs(ba.residuals(found, seen)).max() < 1e-5
    terms = found.equations(seen, np.ones(len(seen.led)))
    by_led, by_rotation, shared = survey_subset.covariance(terms, found)
    for matrix in (*by_led, *by_rotation, shared):
        assert_covariance(matrix)


@pytest.mark.slow
def test_no_step_of_an_adjustment_raises_the_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Levenberg-Marquardt takes a step only if the cost falls; from this far off the first steps often overshoot."""
    equations = Bundle.equations
    costs = list[float]()

    def recorded(bundle: Bundle, sightings: Sightings, weight: Floats) -> Any:
        costs.append(bundle.cost(sightings, np.inf)[0])
        return equations(bundle, sightings, weight)

    monkeypatch.setattr(Bundle, "equations", recorded)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        true, seen = dome(rng, 0.1)
        costs.clear()
        ba.adjust(replace(nudged(rng, true, 0.1), map_sigma_m=0.1), seen, np.inf)
        assert len(costs) > 2
        assert (np.diff(costs) <= 1e-9 * np.array(costs[:-1])).all()


@law(Subset.insert_into)
@given(rng=SEEDS)
def test_a_subset_changes_its_own_lights_and_frames_only(rng: np.random.Generator) -> None:
    true, seen = dome(rng)
    led = np.sort(rng.permutation(LIGHTS)[:5])
    frame = np.sort(rng.permutation(FRAMES)[:3])
    part = Subset(true, seen, led, frame, np.arange(0))
    moved = nudged(rng, true, 0.01)
    fitted = replace(
        moved, position_m=moved.position_m[led], R_body_from_lab=moved.R_body_from_lab[frame]
    )
    whole = part.insert_into(true, fitted)
    for name, rows in (("position_m", led), ("R_body_from_lab", frame)):
        expected = getattr(true, name).copy()
        expected[rows] = getattr(moved, name)[rows]
        np.testing.assert_array_equal(getattr(whole, name), expected)


# The dome's survey


@law(survey, DomeSurvey.focal_sigma_px, DomeSurvey.surveyed_leds, slow=True)
@given(rng=SEEDS)
def test_a_survey_of_a_dome_converges_and_states_its_errors(rng: np.random.Generator) -> None:
    true, _seen = dome(rng, 0.1)
    arm = Lever(true.camera_body_m, Rotation.from_matrix(true.R_cam_from_body))
    leds = LedMap(np.arange(LIGHTS), true.position_m, np.zeros(3), np.full(3, 1.2))
    frames = []
    for k in range(FRAMES):
        truth = Rotation.from_matrix(true.R_body_from_lab[k])
        xy = project(truth, true.position_m, arm, CAMERA) + rng.normal(0, 0.1, (LIGHTS, 2))
        frames.append(
            DomeFrame(np.arange(LIGHTS), xy, np.full(LIGHTS, 0.1), turn(rng, 0.01) * truth)
        )
    result = answered(lambda: survey(frames, leds, arm, CAMERA, leds_sigma_m=0.01))
    assert result is not None
    assert result.status == "converged"
    assert 0 < result.focal_sigma_px < 100
    assert result.surveyed_leds.id.tolist() == np.flatnonzero(result.surveyed).tolist()
    for matrix in (
        *result.led_covariance_m2[result.surveyed],
        result.lever_covariance_m2,
        result.lens_covariance,
    ):
        assert_covariance(matrix)


@law(survey, slow=True)
@given(rng=SEEDS, lever_m=some.floats(0, 0.02), focal_px=some.floats(0.5, 20))
def test_the_misfit_is_over_what_the_pixels_determine(
    rng: np.random.Generator, lever_m: float, focal_px: float
) -> None:
    """Beside a map and an assumed lever the pixels determine tr(N C) of the unknowns: N their own normal matrix, C the
    covariance by all measurements. The survey is where these agree best; a lever that is known exactly is not moved."""
    true, seen = dome(rng, 0.1)
    # Equal errors: a small one among larger ones is an outlier while only the attitudes are fitted.
    seen = replace(seen, sigma_px=np.full(len(seen.led), 0.1))
    turned = Rotation.from_matrix(true.R_body_from_lab)
    arm = Lever(true.camera_body_m, Rotation.from_matrix(true.R_cam_from_body))
    leds = LedMap(
        np.arange(LIGHTS),
        true.position_m + rng.normal(0, 0.002, (LIGHTS, 3)),
        np.zeros(3),
        np.full(3, 1.2),
    )
    rows = [seen.frame == k for k in range(FRAMES)]
    frames = [
        DomeFrame(seen.led[k], seen.xy_px[k], seen.sigma_px[k], turned[n])
        for n, k in enumerate(rows)
    ]
    assumed = Assumed(true.camera_body_m, lever_m, CAMERA.focal_px, focal_px)
    found = survey(frames, leds, arm, CAMERA, leds_sigma_m=0.002, assumed=assumed)
    assert found.surveyed.all()
    lens = np.array([found.camera.focal_px, *found.camera.center_px, *CAMERA.distortion])
    attitudes = found.body_from_lab.as_matrix()
    place_m = found.leds.position_m
    at_m = found.lever.camera_body_m
    bundle = Bundle(
        place_m,
        attitudes,
        at_m,
        true.R_cam_from_body,
        lens,
        3,
        leds.position_m,
        0.002,
        assumed,
    )
    every = ba.linearize(bundle, seen)
    jacobian = np.zeros((len(seen.led), 2, 3 * LIGHTS + 3 * FRAMES + 6))
    for n, (led, frame) in enumerate(zip(seen.led, seen.frame, strict=True)):
        jacobian[n, :, 3 * led : 3 * led + 3] = every.by_led[n]
        jacobian[n, :, 3 * (LIGHTS + frame) : 3 * (LIGHTS + frame) + 3] = every.by_rotation[n]
    jacobian[:, :, -6:] = every.by_shared
    jacobian = jacobian.reshape(2 * len(seen.led), -1)
    by_pixels = jacobian.T @ jacobian
    before = np.zeros(jacobian.shape[1])
    before[: 3 * LIGHTS] = 0.002**-2
    before[-6:-2] = assumed.weight
    determined = np.trace(np.linalg.solve(by_pixels + np.diag(before), by_pixels))
    wanted = np.sqrt(np.sum(every.residual**2) / (2 * len(seen.led) - determined))
    assert found.misfit == pytest.approx(wanted, rel=1e-3)
    terms = bundle.equations(seen, np.ones(len(seen.led)))
    led_step, rest_step = ba.step(terms, ba.eliminate_lights(terms, 0.0))
    # At rest where all measurements agree best.
    assert terms.rhs_led @ led_step + terms.rhs_rest @ rest_step < 1e-6
    assert np.linalg.norm(at_m - true.camera_body_m) < 6 * np.sqrt(3) * max(lever_m, ba.EXACT)


@law(survey)
@given(
    rng=SEEDS,
    led=arrays("i8", 5),
    xy=NUMBERS | arrays("f8", (5, 2), elements=ANY),
    sigma=NUMBERS | arrays("f8", 5, elements=ANY),
    assumed_m=ANY,
)
def test_any_frames_give_a_survey_or_are_refused(
    rng: np.random.Generator, led: NDArray, xy: Floats, sigma: Floats, assumed_m: float
) -> None:
    true, _ = dome(rng)
    arm = Lever(true.camera_body_m, Rotation.from_matrix(true.R_cam_from_body))
    leds = LedMap(np.arange(LIGHTS), true.position_m, np.zeros(3), np.full(3, 1.2))
    for rows in (led, np.arange(5)):
        frames = [DomeFrame(rows, xy, sigma, turn(rng, 0.2)) for _ in range(3)]
        answered(lambda: survey(frames, leds, arm, CAMERA, leds_sigma_m=assumed_m))  # noqa: B023
    with pytest.raises(ValueError, match="no frames"):
        survey([], leds, arm, CAMERA, leds_sigma_m=0.01)


# The lens from star fields


def filmed(rng: np.random.Generator, count: int) -> tuple[list[StarFrame], Rotation]:
    """Star fields over the whole sensor with errors of a tenth of a pixel."""
    truths = Rotation.random(count, rng=rng)
    frames = []
    for k in range(count):
        xy = rng.uniform(0, [639, 479], (25, 2))
        vectors = truths[k].inv().apply(CAMERA.rays(xy))
        frames.append(StarFrame(xy + rng.normal(0, 0.1, xy.shape), np.full(25, 0.1), vectors))
    return frames, truths


@pytest.mark.slow
@law(star_field.calibrate, LensPrior.sigma)
@given(rng=SEEDS, longer=some.floats(-0.03, 0.03))
def test_star_fields_determine_the_lens(rng: np.random.Generator, longer: float) -> None:
    frames, truths = filmed(rng, 8)
    sheet = replace(
        CAMERA.zoomed(1 + longer), center_px=(319.5, 239.5), distortion=(0.0,) * 5
    )
    result = star_field.calibrate(frames, sheet)
    assert result.report.status == "converged"
    assert_covariance(result.covariance)
    assert disagreement_px(CAMERA, CAMERA) < 1e-9
    assert disagreement_px(result.camera, CAMERA) < 0.3
    assert (result.report.cam_from_ref * truths.inv()).magnitude().max() < 0.01
    assert (LensPrior().sigma(sheet) > 0).all()


@law(star_field.calibrate)
@given(
    xy=NUMBERS | arrays("f8", (5, 2), elements=ANY),
    sigma=NUMBERS | arrays("f8", 5, elements=ANY),
    vectors=NUMBERS | arrays("f8", (5, 3), elements=ANY),
)
def test_any_star_fields_determine_a_lens_or_are_refused(
    xy: Floats, sigma: Floats, vectors: Floats
) -> None:
    answered(lambda: star_field.calibrate([StarFrame(xy, sigma, vectors)] * 4, CAMERA))
    with pytest.raises(ValueError, match="no frames"):
        star_field.calibrate([], CAMERA)


class Namer:
    """A perfect identifier: a light's name is its row in the list."""

    def __init__(self, frames: list[StarFrame], seen: bool) -> None:
        vectors = np.concatenate([frame.vectors_ref for frame in frames])
        count = 25 * len(frames)
        self.stars = StarCatalog(
            np.arange(count), vectors, 0 * vectors, np.zeros(count), np.zeros(count), 2000.0
        )
        self.seen = seen

    def solve_centroids(self, centroids: Centroids) -> Attitude:
        star = centroids.flux.astype(np.int64) - 1
        match = StarMatch(np.arange(len(star)), star, Rotation.identity(), -9.0)
        return (
            Attitude("solved", Rotation.identity(), match=match)
            if self.seen
            else Attitude("no")
        )


@law(star_field.self_calibrate)
@given(rng=SEEDS, seen=some.booleans())
def test_a_camera_is_calibrated_by_identified_stars(
    rng: np.random.Generator, seen: bool
) -> None:
    frames, _ = filmed(rng, 5)
    lights = [
        Centroids(one.xy_px, one.sigma_px, np.arange(1.0, 26.0) + 25 * k)
        for k, one in enumerate(frames)
    ]
    namer = Namer(frames, seen)
    result = answered(
        lambda: star_field.self_calibrate(lights, lambda *_: namer, CAMERA.zoomed(1.01))
    )
    assert (result is not None) == seen
    assert result is None or disagreement_px(result.camera, CAMERA) < 0.5


@law(survey_subset.connected_group)
@given(rng=SEEDS, shared=some.sampled_from([1, 2]))
def test_a_group_of_frames_is_closed_and_connected(
    rng: np.random.Generator, shared: int
) -> None:
    """With one light to share it is a component of the graph of frames and lights."""
    visible = rng.random((rng.integers(2, 12), rng.integers(2, 15))) < 0.25
    frames = len(visible)
    first = int(rng.integers(frames))
    group = survey_subset.connected_group(visible, first, shared)
    assert group[first]
    # No other frame shares so many lights with the group, and each of the group does with those before it.
    lights = visible[group].any(axis=0)
    assert all((visible[~group] & lights).sum(axis=1) < shared)
    reached = {first}
    for _ in range(frames):
        lights = visible[sorted(reached)].any(axis=0)
        reached |= set(np.flatnonzero((visible & lights).sum(axis=1) >= shared).tolist())
    assert reached == set(np.flatnonzero(group).tolist())
    if shared == 1:
        graph = np.block(
            [
                [np.zeros((frames, frames)), visible],
                [visible.T, np.zeros((visible.shape[1],) * 2)],
            ]
        )
        label = connected_components(csr_array(graph))[1]
        assert (label[:frames] == label[first]).tolist() == group.tolist()
