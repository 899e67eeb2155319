"""SHEFEX-2's catalogs: the published counts, and that thinned stars are spread evenly."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from estimator.catalog import catalog, pair_index
from estimator.catalog.catalog import StarCatalog
from estimator.catalog.published_catalogs import (
    BRIGHT_MAG,
    CATALOGS,
    COUNT,
    asymmetric,
    chosen,
    thin,
    uniform,
)
from estimator.core.errors import ImageError

FILE = Path(__file__).parents[3] / "data/catalogs/hipparcos_hp6.5.ecsv"


@pytest.fixture(scope="module")
def stars() -> StarCatalog:
    return catalog.read(FILE)


def chord(angle_rad: float) -> float:
    return 2 * np.sin(angle_rad / 2)


def test_the_chosen_catalog_has_the_published_stars_and_pairs(stars: StarCatalog) -> None:
    # Section 3.3: "2023 stars which can be combined to 54804 reasonable star pair combinations"; +-15 %, since
    # the thinning is unpublished.
    flown = chosen(stars)
    assert len(flown) == pytest.approx(2023, abs=1)
    pairs = len(pair_index.build(flown.vectors, np.radians(18.57)).pair)
    assert pairs == pytest.approx(54_804, rel=0.15)
    # "Only about 180 stars between 5.2 and 5.4", none fainter, all of them in the south.
    faint = flown.v_mag > 5.2
    assert flown.v_mag.max() <= 5.4
    assert faint.sum() == pytest.approx(180, rel=0.15)
    assert flown.vectors[faint, 2].max() < 0


def test_a_uniform_sky_of_as_many_stars_has_the_expected_pairs(stars: StarCatalog) -> None:
    # N (N - 1) / 2 (1 - cos theta) / 2 = 53,243; thinning leaves less clumping than the flown one has.
    even = CATALOGS["uniform"](stars)
    expected = len(even) * (len(even) - 1) / 4 * (1 - np.cos(np.radians(18.57)))
    assert len(even) == pytest.approx(COUNT, abs=1)
    assert expected == pytest.approx(53_243, rel=0.002)
    assert len(pair_index.build(even.vectors, np.radians(18.57)).pair) == pytest.approx(
        expected, rel=0.02
    )
    clumped = catalog.brighter_than(stars, float(np.sort(stars.v_mag)[len(even) - 1]))
    assert len(pair_index.build(clumped.vectors, np.radians(18.57)).pair) > 1.1 * expected


def test_fewer_fields_are_too_poor_in_the_uniform_catalog(stars: StarCatalog) -> None:
    # What the uniform catalog is for: a field needs four stars. 2000 random fields as large as SHEFEX's, round.
    even = CATALOGS["uniform"](stars)
    bright = catalog.brighter_than(stars, float(np.sort(stars.v_mag)[len(even) - 1]))
    sights = np.random.default_rng(5).normal(size=(2000, 3))
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    radius = np.sqrt(np.radians(14.87) * np.radians(11.15) / np.pi)
    poor = [
        np.mean(
            cKDTree(known.vectors).query_ball_point(sights, chord(radius), return_length=True)
            < 4
        )
        for known in (even, bright)
    ]
    assert poor[0] < poor[1] / 3


def test_the_hemispheres_have_their_own_limits(stars: StarCatalog) -> None:
    both = asymmetric(stars, 4.0, 5.0)
    north = both.vectors[:, 2] >= 0
    assert both.v_mag[north].max() <= 4.0 < both.v_mag[~north].max() <= 5.0
    wanted = np.where(stars.vectors[:, 2] >= 0, stars.v_mag <= 4.0, stars.v_mag <= 5.0)
    np.testing.assert_array_equal(both.id, stars.id[wanted])


@pytest.mark.long
def test_thinned_stars_are_apart_with_none_left_out_needlessly_and_the_brightest_kept(
    stars: StarCatalog,
) -> None:
    apart = np.radians(3.0)
    kept = thin(stars, apart, BRIGHT_MAG)
    bright = stars.v_mag <= BRIGHT_MAG
    assert np.isin(stars.id[bright], kept.id).all()
    close = cKDTree(kept.vectors).query_pairs(chord(apart), output_type="ndarray")
    # Of two that are close both were to stay.
    assert np.all(kept.v_mag[close] <= BRIGHT_MAG)
    left_out = ~np.isin(stars.id, kept.id)
    off, nearest = cKDTree(kept.vectors).query(stars.vectors[left_out], k=len(kept.id))
    within = off <= chord(apart)
    # Each of those left out has one as bright, taken, that near.
    as_bright = kept.v_mag[nearest] <= stars.v_mag[left_out][:, None]
    assert (within & as_bright).any(axis=1).all()


def test_an_impossible_count_is_refused(stars: StarCatalog) -> None:
    with pytest.raises(ImageError, match="9000 of 7996 stars; allowed"):
        uniform(stars, 9000)
    with pytest.raises(ImageError, match="100 of 7996 stars; allowed: 9"):
        uniform(stars, 100, 4.5)
