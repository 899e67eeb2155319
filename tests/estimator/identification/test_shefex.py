"""SHEFEX-2's identifier and NPS's master star: the published gates, nine stars on a screen."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.catalog import pair_index
from estimator.core.checks import Floats
from estimator.core.vectors import normalized
from estimator.identification.published.master_star import master_star
from estimator.identification.published.shefex import (
    ShefexOptions,
    angle_interval,
    cos_error,
    direction_tolerance_rad,
    search,
    shefex,
)

pytestmark = pytest.mark.slow  # much is compiled

ARCSEC_RAD = np.pi / 648_000
SCREEN_CORNERS = normalized(
    np.array([[0.1, 0.1, 1], [-0.1, 0.1, 1], [0.1, -0.1, 1], [-0.1, -0.1, 1]])
)
# "the angle per pixel, computed from the FOV and the CCD size (0.02 deg)".
PIXEL_RAD = np.radians(0.02)


@pytest.mark.parametrize(("centroid_px", "factor"), [(0.1, 4.95), (0.2, 2.47), (0.3, 1.65)])
def test_eq_3_gives_the_published_cos_error(centroid_px: float, factor: float) -> None:
    # Section 3.4.1: "a value between 0.00005 and 0.00006"; the constants' third digit is half a per cent.
    error = cos_error(np.radians(18.57), centroid_px * PIXEL_RAD, factor)
    assert error == pytest.approx(5.5e-5, rel=0.01)


@pytest.mark.parametrize(
    ("angle_deg", "tolerance_deg"), [(2, 0.090), (5, 0.036), (10, 0.018), (18.57, 0.010)]
)
def test_cos_error_is_a_wide_gate_at_small_angles_and_a_narrow_one_at_large_ones(
    angle_deg: float, tolerance_deg: float
) -> None:
    low, high = np.degrees(angle_interval(np.radians(angle_deg), 5.5e-5))
    assert (high - low) / 2 == pytest.approx(tolerance_deg, abs=6e-4)  # its last digit


def test_the_gate_s_ends_are_off_by_cos_error_in_the_cosine() -> None:
    for angle in np.radians([0.9, 3, 10, 40]):
        low, high = angle_interval(angle, 5.5e-5)
        # 1e-15: rounding of 1.
        np.testing.assert_allclose(np.cos(low) - np.cos(angle), 5.5e-5, rtol=0, atol=1e-15)
        np.testing.assert_allclose(np.cos(angle) - np.cos(high), 5.5e-5, rtol=0, atol=1e-15)
    # Closer than that to zero every smaller angle is alike.
    assert angle_interval(0.001, 5.5e-5)[0] == 0


@pytest.mark.parametrize(
    ("triangles", "checks", "begun"), [(3, 10**6, 3), (100, 0, 0), (100, 10**6, 20)]
)
def test_no_triangle_is_begun_once_the_effort_is_used_up(
    triangles: int, checks: int, begun: int
) -> None:
    """Six stars have 20 triangles; no star of the catalog is near theirs, so that none is found."""
    seen = normalized(screen(np.random.default_rng(5))[:6])
    index = pair_index.build(SCREEN_CORNERS, 0.5)
    tried = np.zeros(3, np.int64)
    search(seen, index, ShefexOptions(1e-9, 1e-7, triangles, checks, base=6), tried)
    assert tried[2] == begun


def test_a_given_cos_error_searches_as_eq_3_does_from_its_tolerance() -> None:
    """The inverse of eq. 3 leads from the paper's 5.5e-5 to 0.495 px, c = 4.95 at 0.1 px, and back."""
    fov = np.radians(18.57)
    tolerance = direction_tolerance_rad(fov, 5.5e-5)
    assert tolerance == pytest.approx(0.495 * PIXEL_RAD, rel=0.01)
    assert cos_error(fov, tolerance) == pytest.approx(5.5e-5, rel=1e-9)
    rng = np.random.default_rng(8)
    stars = normalized(rng.normal(size=(2000, 3)))
    index = pair_index.build(stars, fov)
    seen = stars[np.arccos(np.clip(stars @ stars[0], -1, 1)) < fov / 2]
    error = cos_error(index.max_angle_rad, tolerance)
    counts = np.zeros((2, 1), np.int64)
    by_eq_3 = shefex(seen, index, tolerance, compared=counts[0])
    given = shefex(seen, index, 1e-3, cos_error=error, compared=counts[1])
    assert by_eq_3 is not None
    assert given is not None
    np.testing.assert_array_equal(given.star, by_eq_3.star)
    assert counts[0, 0] == counts[1, 0] > 3


def test_the_angles_of_twenty_triangles_without_a_catalog_pair_are_sixty() -> None:
    seen = normalized(screen(np.random.default_rng(5))[:6])
    compared = np.zeros(1, np.int64)
    index = pair_index.build(SCREEN_CORNERS, 0.5)
    assert shefex(seen, index, 1e-7, cos_error=1e-9, compared=compared) is None
    assert compared[0] == 3 * 20


# ---- the master star: nine stars on a screen of .30 x .22 m a meter away (reference section 5) -----------------------


def screen(rng: np.random.Generator) -> Floats:
    """Directions of nine stars, the brightest first."""
    return normalized(
        np.column_stack([rng.uniform([-0.15, -0.11], [0.15, 0.11], (9, 2)), np.ones(9)])
    )


def observe(
    rng: np.random.Generator, stars: Floats, noise_rad: float
) -> tuple[Floats, Rotation]:
    truth = Rotation.from_rotvec(rng.normal(0, 0.1, 3))
    return normalized(truth.apply(stars) + rng.normal(0, noise_rad, stars.shape)), truth


TOLERANCE_RAD = 500 * ARCSEC_RAD / np.sqrt(2)  # +-500 arcsec of an angle


def test_nine_stars_on_a_screen_are_identified_by_their_master_star() -> None:
    rng = np.random.default_rng(120)
    found = 0
    for _ in range(40):
        stars = screen(rng)
        seen, truth = observe(rng, stars, 60 * ARCSEC_RAD)
        match = master_star(seen, pair_index.build(stars, 0.5), TOLERANCE_RAD)
        if match is not None:
            np.testing.assert_array_equal(match.star, match.observed)
            assert (match.cam_from_ref * truth.inv()).magnitude() < np.radians(0.3)
            found += 1
    # Where two stars come within the tolerance one of nine is lost; that is not many.
    assert found >= 36


def test_six_of_the_nine_are_enough_but_not_without_the_master() -> None:
    # NPS matched "about six stars out of the total nine". The thesis's criticism: all rests on the brightest.
    rng = np.random.default_rng(121)
    found = np.zeros(2)
    for _ in range(40):
        stars = screen(rng)
        seen, _ = observe(rng, stars, 20 * ARCSEC_RAD)
        index = pair_index.build(stars, 0.5)
        strays = observe(rng, screen(rng), 0.0)[0]
        few = np.vstack([seen[:6], strays[:3]])
        headless = np.vstack([strays[:1], seen[1:]])
        found[0] += master_star(few, index, TOLERANCE_RAD) is not None
        found[1] += master_star(headless, index, TOLERANCE_RAD) is not None
    assert found[0] >= 30
    assert found[1] <= 4


def test_nine_stars_of_another_screen_or_a_mirror_are_refused() -> None:
    rng = np.random.default_rng(122)
    for _ in range(60):
        stars = screen(rng)
        other = screen(rng)
        index = pair_index.build(stars, 0.5)
        assert master_star(other, index, TOLERANCE_RAD) is None
        assert master_star(stars * [-1, 1, 1], index, TOLERANCE_RAD) is None


def test_a_square_of_equal_angles_is_no_answer() -> None:
    # Nine on a lattice: eight turns and mirrors fit; the corner that is the master is four.
    places = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]) * 0.1
    stars = normalized(np.column_stack([places, np.ones(9)]))
    turned_by = Rotation.from_euler("z", 90, degrees=True)
    match = master_star(turned_by.apply(stars), pair_index.build(stars, 0.5), TOLERANCE_RAD)
    assert match is None
