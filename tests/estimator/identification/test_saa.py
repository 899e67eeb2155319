"""The angle method: its matches against the truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.attitude.nearfield import thesis_points
from estimator.calibration.home_position import Sighting, calibrate
from estimator.catalog import pair_index
from estimator.catalog.pair_index import PairIndex
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.constants import ARCSEC_RAD
from estimator.core.errors import ImageError
from estimator.core.types import StarMatch
from estimator.core.vectors import normalized
from estimator.identification.published.saa import saa

pytestmark = pytest.mark.long  # an algorithm of the papers: compiles for ten seconds

RARE = 1e-4


# ---- identification ------------------------------------------------------------------------------------------------

# Twelve LEDs on AFIT's 8 mm lattice at 48 in, some places empty, unequal.
LATTICE = np.array(
    [
        [-2, -2],
        [-2, 0],
        [-2, 1],
        [-1, 2],
        [-1, -1],
        [0, 0],
        [0, 2],
        [1, -2],
        [1, 1],
        [2, -1],
        [2, 0],
        [2, 2],
    ]
)
PITCH_RAD = 8e-3 / 1.2192
MAGNITUDE = np.array([150.0, 35, 110, 70, 130, 50, 90, 20, 145, 60, 100, 40])
SIGMA_RAD = 5 * ARCSEC_RAD
EPSILON_MAG = 5.0


def patch(places: Floats) -> Floats:
    return normalized(np.column_stack([places * PITCH_RAD, np.ones(len(places))]))


def pairs_of(vectors: Floats, magnitude: Floats) -> PairIndex:
    """All pairs of a patch whose lights are in no order of their magnitudes."""
    return pair_index.build(vectors, 0.1)._replace(magnitude=np.asarray(magnitude, float))


def observed(
    rng: np.random.Generator,
    vectors: Floats,
    magnitude: Floats,
    false: int = 0,
    mirrored: bool = False,
) -> tuple[Floats, Floats, Floats, Rotation]:
    """Noisy vectors in camera axes, brightest first, their magnitudes and rows (-1: a reflection), and the truth."""
    truth = Rotation.random(rng=rng)
    seen = truth.apply(vectors)
    reflection = truth.apply(patch(rng.uniform(-2.5, 2.5, (false, 2))))
    seen = normalized(
        np.vstack([seen, reflection]) + rng.normal(0, SIGMA_RAD, (len(seen) + false, 3))
    )
    # The patch is brought before the camera, as a field is.
    upright = Rotation.align_vectors([[0, 0, 1]], [seen.mean(axis=0)])[0]
    seen = upright.apply(seen)
    truth = upright * truth
    if mirrored:
        seen = seen * [-1, 1, 1]
    light = np.concatenate(
        [magnitude + rng.normal(0, EPSILON_MAG, len(vectors)), rng.uniform(20, 150, false)]
    )
    row = np.concatenate([np.arange(len(vectors)), np.full(false, -1)])
    order = np.argsort(-light)
    return seen[order], light[order], row[order], truth


def found(
    seen: Floats, light: Floats, known: PairIndex, epsilon_mag: float = EPSILON_MAG
) -> StarMatch | None:
    return saa(
        seen,
        known,
        3 * SIGMA_RAD,
        magnitude=light,
        epsilon_mag=epsilon_mag,
    )


@pytest.mark.parametrize("false", [0, 4])
def test_a_patch_of_unequal_leds_is_identified_and_never_wrongly(false: int) -> None:
    rng = np.random.default_rng(74)
    known = pairs_of(patch(LATTICE), MAGNITUDE)
    right = 0
    z2 = []
    for _ in range(100):
        seen, light, row, truth = observed(rng, patch(LATTICE), MAGNITUDE, false)
        match = found(seen, light, known)
        if match is None:
            continue
        true = row[match.observed]
        assert (true == match.star)[true >= 0].all()
        right += 1
        # The attitude across the boresight: sigma / sqrt(K) about either axis, two of them.
        across = (match.cam_from_ref * truth.inv()).as_rotvec()[:2]
        z2.append(across @ across / (SIGMA_RAD**2 / len(match.observed)))
    # At 98 % expected, 92 of 100 or fewer come once in a thousand.
    assert right > 92
    # The mean of 2 with a deviation of 2 each; a false light taken for an LED near it adds to it.
    assert abs(np.mean(z2) - 2) < 5 * 2 / np.sqrt(right)


SQUARE = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])


@pytest.mark.parametrize("places", [SQUARE, SQUARE[[1, 3, 4, 5, 7]], SQUARE[[0, 2, 6, 8]]])
def test_a_symmetric_pattern_of_equal_leds_is_refused(places: Floats) -> None:
    rng = np.random.default_rng(75)
    equal = np.full(len(places), 100.0)
    known = pairs_of(patch(places), equal)
    for _ in range(3):
        seen, light, _, _ = observed(rng, patch(places), equal)
        assert found(seen, light, known) is None


def test_a_square_of_unequal_leds_is_identified() -> None:
    # So that the refusal above is the symmetry's, not a gate's. Magnitudes 20 epsilons apart: at two to
    # four a full square, on which false assumptions find partners too, is mostly refused.
    rng = np.random.default_rng(76)
    magnitude = 100.0 * np.random.default_rng(80).permutation(9) + 100
    known = pairs_of(patch(SQUARE), magnitude)
    named = 0
    for _ in range(30):
        seen, light, row, _ = observed(rng, patch(SQUARE), magnitude)
        match = found(seen, light, known)
        if match is not None:
            assert (row[match.observed] == match.star).all()
            named += 1
    assert named > 25  # at 97 % expected, 25 or fewer of 30 come once in a thousand


def test_without_magnitudes_an_irregular_pattern_is_identified() -> None:
    rng = np.random.default_rng(77)
    places = rng.uniform(-3, 3, (14, 2))
    known = pair_index.build(patch(places), 0.1)
    right = 0
    for _ in range(30):
        seen, _, row, _ = observed(rng, patch(places), np.full(14, 100.0))
        match = saa(seen, known, 3 * SIGMA_RAD)
        if match is not None:
            assert (row[match.observed] == match.star).all()
            right += 1
    assert right > 26  # at 98 % expected, 26 or fewer of 30 come three times in a thousand


def test_a_mirror_image_and_pure_noise_are_refused() -> None:
    rng = np.random.default_rng(78)
    # Off the lattice: a lattice's mirror image has most of its places.
    places = LATTICE + rng.uniform(-0.3, 0.3, (12, 2))
    known = pairs_of(patch(places), MAGNITUDE)
    for _ in range(5):
        seen, light, _, _ = observed(rng, patch(places), MAGNITUDE, mirrored=True)
        assert found(seen, light, known) is None
        seen, light, _, _ = observed(rng, np.empty((0, 3)), np.empty(0), false=12)
        assert found(seen, light, known) is None


def test_saa_refuses_three_stars_and_an_uncertain_focal_length() -> None:
    known = pairs_of(patch(LATTICE), MAGNITUDE)
    assert saa(patch(LATTICE[:3]), known, SIGMA_RAD) is None
    with pytest.raises(
        ImageError, match="saa: the focal length is uncertain; allowed: a calibrated camera"
    ):
        saa(patch(LATTICE), known, SIGMA_RAD, focal_unknown=True)
    with pytest.raises(ImageError, match="saa: tolerance 0"):
        saa(patch(LATTICE), known, 0.0)


# ---- the thesis's procedure, end to end ----------------------------------------------------------------------------


def test_a_dome_calibrated_from_its_frames_is_identified_at_the_thesis_s_stops() -> None:
    # Table 6's stops, centroids of .3 px, the IMU exact: catalog, epsilons and pairs all from the frames.
    camera = Camera(1600, 1200, 8750.0, (799.5, 599.5))
    lever = Lever(np.array([0.0, 0.0, 0.381]), Rotation.identity())
    ball = LedMap(np.arange(0), np.zeros((0, 3)), np.zeros(3), np.full(3, 1.2192))
    leds = replace(ball, id=np.arange(12), position_m=1.2192 * patch(LATTICE))
    stops = np.radians(
        [
            [0, 0, 0],
            [-0.009, 2.3, 0.007],
            [0.25, -2.1, 0.004],
            [3.3, -0.14, -0.028],
            [-1.9, 0.28, 0.19],
        ]
    )
    rng = np.random.default_rng(79)
    attitudes = Rotation.from_euler("ZYX", stops[:, ::-1])

    def frame(stop: int) -> Sighting:
        xy = project(attitudes[stop], leds.position_m, lever, camera) + rng.normal(
            0, 0.3, (12, 2)
        )
        return Sighting(
            stop, attitudes[stop], leds.id, xy, MAGNITUDE + rng.normal(0, EPSILON_MAG, 12)
        )

    home = calibrate(
        [frame(stop) for stop in range(5) for _ in range(20)], camera, ball, lever
    )
    known = pairs_of(home.vectors, home.brightness)
    named = 0
    for stop in np.repeat(np.arange(5), 8):
        seen = frame(stop)
        order = np.argsort(-seen.brightness)
        point, _ = thesis_points(camera.rays(seen.xy_px[order]), ball, lever)
        rays = normalized(point + lever.camera_body_m)
        match = saa(
            rays,
            known,
            3 * home.epsilon_pos_m / 1.2192,
            magnitude=seen.brightness[order],
            epsilon_mag=home.epsilon_mag,
        )
        if match is not None:
            assert (home.id[match.star] == order[match.observed]).all()
            named += 1
    assert named > 35  # at 98 % expected, 35 or fewer of 40 come once in a thousand
