"""Laws of the star catalog and of its indexes, on any sky."""

from __future__ import annotations

import datetime
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from estimator.catalog import (
    cat_file,
    catalog,
    pair_index,
    published_catalogs,
    quad_index,
    sky_index,
)
from estimator.catalog.catalog import StarCatalog
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from tests.helpers.laws import ANY, NUMBERS, SEEDS, answered, drawn, law, units

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
CAMERA = Camera.from_fov(640, 480, np.radians(40))
RAYS = arrays("f8", some.tuples(some.integers(0, 12), some.just(3)), elements=ANY)


def apart(a: NDArray, b: NDArray) -> NDArray:
    """Angles between all of two lists of unit vectors, by the cross product."""
    return np.arctan2(np.linalg.norm(np.cross(a[:, None], b[None]), axis=2), a @ b.T)


# Catalog


@law(catalog.from_angles)
@given(east_rad=some.floats(-7, 7), north_rad=some.floats(-1.57, 1.57))
def test_a_direction_has_the_angles_that_it_is_made_of(
    east_rad: float, north_rad: float
) -> None:
    x, y, z = catalog.from_angles(east_rad, north_rad)
    assert np.arcsin(z) == pytest.approx(north_rad, abs=1e-7)
    assert np.hypot(x, y) * np.exp(1j * east_rad) == pytest.approx(x + 1j * y, abs=1e-15)


@law(
    catalog.from_columns,
    catalog.StarCatalog.brightest_first,
    catalog.at_epoch,
    catalog.apparent,
)
@given(rng=SEEDS, year=some.floats(1900, 2100))
def test_stars_move_across_the_sky_and_no_farther_than_they_can(
    rng: np.random.Generator, year: float
) -> None:
    stars = drawn(rng)
    assert (np.diff(stars.brightest_first().v_mag) >= 0).all()
    np.testing.assert_allclose(
        np.sum(stars.vectors * stars.drift_rad_yr, axis=1), 0, rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(
        catalog.at_epoch(stars, stars.epoch_yr), stars.vectors, rtol=0, atol=1e-15
    )
    there = catalog.Observer(year, units(rng, 1)[0], 3e4 * units(rng, 1)[0])
    seen = catalog.apparent(stars, there)
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 1, rtol=0, atol=1e-12)
    moved = np.linalg.norm(seen - catalog.at_epoch(stars, year), axis=1)
    # Near the Sun light is bent by more than a bit.
    away = np.linalg.norm(seen + there.position_au, axis=1)
    assert (
        moved
        < 1.01e-4
        + stars.parallax_rad
        + 2 * catalog.SUN_DEFLECTION_RAD / np.maximum(away, 1e-9)
    ).all()


@law(catalog.on_earth, catalog.days_after_j2000)
@given(some.datetimes(datetime.datetime(1900, 1, 1), datetime.datetime(2100, 1, 1)))
def test_the_earth_is_one_au_from_the_sun_and_moves_at_30_km_s(
    utc: datetime.datetime,
) -> None:
    there = catalog.on_earth(utc)
    assert 0.97 < np.linalg.norm(there.position_au) < 1.03
    assert 29e3 < np.linalg.norm(there.velocity_m_s) < 30.6e3
    zone = datetime.timezone(datetime.timedelta(hours=5))
    same = catalog.on_earth(utc.replace(tzinfo=datetime.UTC).astimezone(zone))
    np.testing.assert_allclose(same.position_au, there.position_au, rtol=0, atol=1e-15)
    days = (utc - datetime.datetime(2000, 1, 1, 12)).total_seconds() / 86400
    assert catalog.days_after_j2000(utc) == pytest.approx(days, rel=1e-12)


@law(
    StarCatalog.take,
    catalog.brighter_than,
    catalog.limit_for_density,
    published_catalogs.asymmetric,
)
@given(rng=SEEDS, limit=some.floats(-2, 7), wanted=some.floats(0, 1e3))
def test_a_subset_of_a_catalog_holds_the_requested_stars(
    rng: np.random.Generator, limit: float, wanted: float
) -> None:
    stars = drawn(rng)
    bright = catalog.brighter_than(stars, limit)
    assert bright.id.tolist() == [
        n for n, mag in zip(stars.id, stars.v_mag, strict=True) if mag <= limit
    ]
    south = published_catalogs.asymmetric(stars, limit, limit + 1)
    assert set(bright.id) <= set(south.id) <= set(catalog.brighter_than(stars, limit + 1).id)
    density = catalog.limit_for_density(stars, 1.0, wanted)
    assert len(catalog.brighter_than(stars, density)) == np.clip(
        int(wanted * 4 * np.pi), 1, len(stars)
    )


@law(published_catalogs.thin, published_catalogs.uniform)
@given(rng=SEEDS, apart_rad=some.floats(0.01, 1), count=some.integers(-1, 70))
def test_spread_stars_are_apart_and_none_is_left_out_needlessly(
    rng: np.random.Generator, apart_rad: float, count: int
) -> None:
    stars = drawn(rng)
    kept = published_catalogs.thin(stars, apart_rad)
    between = apart(kept.vectors, kept.vectors)[np.triu_indices(len(kept), 1)]
    assert (between > apart_rad - 1e-9).all()
    assert (apart(stars.vectors, kept.vectors).min(axis=1) <= apart_rad + 1e-9).all()
    few = answered(lambda: published_catalogs.uniform(stars, count), ImageError)
    assert (few is not None) == (1 <= count <= 60)
    assert few is None or (set(few.id) <= set(stars.id) and abs(len(few) - count) <= 2)


@law(published_catalogs.uniform_to_limit)
@given(rng=SEEDS, limit=some.floats(-2, 7), count=some.integers(1, 60))
def test_a_uniform_catalog_to_a_limit_has_no_fainter_star(
    rng: np.random.Generator, limit: float, count: int
) -> None:
    stars = drawn(rng)
    few = answered(
        lambda: published_catalogs.uniform_to_limit(stars, count, limit), ImageError
    )
    assert (few is not None) == (count <= np.sum(stars.v_mag <= limit))
    assert few is None or (few.v_mag <= limit).all()


@law(cat_file.encode, cat_file.read, cat_file.read_stars)
@given(rng=SEEDS, damaged=some.integers(0, 39), by=some.integers(1, 255))
def test_a_cat_file_keeps_any_sky_and_no_damaged_byte_passes_as_a_star(
    tmp_path_factory: pytest.TempPathFactory, rng: np.random.Generator, damaged: int, by: int
) -> None:
    stars = drawn(rng)
    ones = np.ones(len(stars), int)
    sky = published_catalogs.OnBoard(stars.id, stars.vectors, stars.v_mag, ones, 2010.0)
    path = tmp_path_factory.mktemp("cat") / "x.cat"
    data = bytearray(cat_file.encode(sky))
    path.write_bytes(data)
    # A unit is 2^-32 of a turn.
    same = cat_file.read(path)
    np.testing.assert_allclose(same.vectors, sky.vectors, rtol=0, atol=2e-9)
    assert cat_file.read_stars(path).v_mag.tolist() == sorted(same.magnitude)
    data[20 + damaged] ^= by
    path.write_bytes(data)
    assert answered(lambda: cat_file.read(path), ImageError) is None


@law(published_catalogs.chosen, slow=True)
@given(rng=SEEDS)
def test_the_flown_catalog_has_the_requested_number_or_is_refused(
    rng: np.random.Generator,
) -> None:
    many = replace(drawn(rng, 2600), v_mag=np.linspace(4, 5.2, 2600))
    assert abs(len(published_catalogs.chosen(many)) - published_catalogs.COUNT) <= 3
    with pytest.raises(ImageError, match="2023 of"):
        published_catalogs.chosen(drawn(rng))


@law(catalog.light_centers, catalog.close_groups, catalog.merge_doubles)
@given(rng=SEEDS, near_rad=some.floats(0, 1))
def test_merged_stars_keep_their_light(rng: np.random.Generator, near_rad: float) -> None:
    stars = drawn(rng)
    groups = catalog.close_groups(stars.vectors, 2 * np.sin(near_rad / 2))
    near = apart(stars.vectors, stars.vectors) < near_rad - 1e-9
    assert (groups[:, None] == groups)[near].all()
    alone = ~(near & ~np.eye(len(stars), dtype=bool)).any(axis=1) & (near_rad > 1e-9)
    assert (np.bincount(groups)[groups[alone]] == 1).all() or near_rad < 1e-6
    _, mag = catalog.light_centers(stars.vectors.T, stars.v_mag, groups)
    merged = catalog.merge_doubles(stars, near_rad)
    for magnitudes in (mag, merged.v_mag):
        np.testing.assert_allclose(
            np.sum(10 ** (-0.4 * magnitudes)),
            np.sum(10 ** (-0.4 * stars.v_mag)),
            rtol=1e-9,
            atol=0,
        )
    assert set(merged.id) <= set(stars.id)
    assert (np.diff(merged.v_mag) >= 0).all()


@pytest.mark.long
@law(catalog.read, catalog.columns, published_catalogs.read_cat)
@given(
    rows=some.lists(
        some.lists(some.floats() | some.text(max_size=5), min_size=5, max_size=8), max_size=3
    ),
    rng=SEEDS,
)
def test_any_table_is_a_catalog_or_is_refused(
    tmp_path_factory: pytest.TempPathFactory,
    rows: list[list[object]],
    rng: np.random.Generator,
) -> None:
    path = tmp_path_factory.mktemp("catalog") / "x.ecsv"
    head = "# epoch_jyear: 2016.0\n" + ",".join(catalog.COLUMNS)
    path.write_text(
        "\n".join([head, *(",".join(map(str, row)) for row in rows)]), encoding="utf-8"
    )
    answered(lambda: catalog.read(path), ImageError)
    answered(lambda: published_catalogs.read_cat(path, 5.0), ImageError)
    table = rng.uniform(1, 50, (4, 7))
    path.write_text("\n".join([head, *(",".join(map(repr, row)) for row in table.tolist())]))
    numbers, epoch_yr = catalog.columns(path, catalog.COLUMNS)
    np.testing.assert_array_equal(numbers, table.T)
    assert epoch_yr == 2016.0
    assert catalog.read(path).v_mag.tolist() == sorted(table[:, 6])
    assert len(published_catalogs.read_cat(path, 60.0)) == 4


@law(published_catalogs.proc_cat, published_catalogs.histogram, published_catalogs.log)
@given(rng=SEEDS, near_rad=some.floats(0, 1), step_mag=some.floats(0.1, 2))
def test_a_prepared_catalog_counts_every_star(
    rng: np.random.Generator, near_rad: float, step_mag: float
) -> None:
    stars = drawn(rng)
    raw = published_catalogs.OnBoard(
        stars.id, stars.vectors, stars.v_mag, np.ones(len(stars), np.int64), 2000.0
    )
    prepared = published_catalogs.proc_cat(raw, near_rad)
    assert prepared.components.sum() == len(stars)
    assert (np.diff(prepared.magnitude) >= 0).all()
    edges, count = published_catalogs.histogram(prepared.magnitude, step_mag)
    assert count.sum() == len(prepared)
    assert edges[0] <= prepared.magnitude[0] + 1e-6
    assert prepared.magnitude[-1] < edges[-1] + step_mag
    assert len(published_catalogs.log(prepared, step_mag).splitlines()) == 6 + len(
        count
    ) + len(prepared)


# Indexes


@law(
    pair_index.build,
    pair_index.k_vector,
    sky_index.build_grid,
    sky_index.build,
    sky_index.add_pairs,
    sky_index.count_pairs,
    sky_index.chord_of,
    sky_index.close_pairs,
)
@given(rng=SEEDS, most_rad=some.floats(0.3, 3.2), count=some.integers(8, 50))
def test_both_indexes_hold_the_existing_pairs(
    rng: np.random.Generator, most_rad: float, count: int
) -> None:
    vectors = units(rng, count)
    mag = np.sort(rng.uniform(0, 6, count))
    every = apart(vectors, vectors)[np.triu_indices(count, 1)]
    pairs = int(np.count_nonzero(every <= most_rad))
    pair, angle_rad = sky_index.close_pairs(vectors, most_rad)
    expected = apart(vectors, vectors)[tuple(pair.T)]
    np.testing.assert_allclose(angle_rad, expected, rtol=0, atol=1e-7)
    assert len(pair) == pairs
    bare = sky_index.build(vectors, mag)
    assert sky_index.count_pairs(vectors, most_rad) == pairs
    for build in (
        pair_index.build,
        lambda *arguments: sky_index.add_pairs(bare, arguments[1]),
    ):
        made = answered(lambda: build(vectors, most_rad), ImageError)  # noqa: B023
        assert (len(made.pair) if made else 0) == (pairs if pairs >= 3 else 0)
    if made:  # the sky index: every pair once, in the bin of its angle
        angle = apart(vectors, vectors)[tuple(made.pair.T)]
        in_bin = np.repeat(np.arange(len(made.first) - 1), np.diff(made.first))
        assert np.abs(angle / made.bin_rad - in_bin - 0.5).max() < 0.5 + 1e-6
        assert len({tuple(sorted(pair)) for pair in made.pair.tolist()}) == pairs
    assert sorted(sky_index.build_grid(vectors).row.tolist()) == list(range(count))
    kvector, slope, offset = pair_index.k_vector(np.sort(every))
    z = slope * np.arange(len(kvector)) + offset
    assert all(np.count_nonzero(every <= at) == n for at, n in zip(z, kvector, strict=True))
    assert set(bare.cell_star.tolist()) == set(range(count))


@law(sky_index.count_pairs, sky_index.add_pairs, sky_index.chord_of)
@given(rng=SEEDS, most_rad=some.floats(0.3, 4), paired=some.none() | some.integers(8, 50))
def test_pairs_are_counted_without_them_and_their_number_is_limited(
    rng: np.random.Generator, most_rad: float, paired: int | None
) -> None:
    vectors = units(rng, 50)
    sky = sky_index.build(vectors, np.sort(rng.uniform(0, 6, 50)))
    assert not len(sky.pair)
    with patch.object(sky_index, "MOST_PAIRS", 300):
        count = sky_index.count_pairs(vectors[:paired], most_rad)
        made = answered(lambda: sky_index.add_pairs(sky, most_rad, paired), ImageError)
        assert count == len(made.pair) if made else count < 3
        # Of a uniform sky, the brightest have about as many as the limit.
        assert count < 600
        assert not made or made.pair.max() < (paired or 50)
    chord = np.linalg.norm(np.array([1, 0]) - [np.cos(most_rad), np.sin(most_rad)])
    expected = chord if most_rad < np.pi else 2
    np.testing.assert_allclose(sky_index.chord_of(most_rad), expected, rtol=0, atol=1e-12)


@law(pair_index.build)
@given(vectors=RAYS, mag=NUMBERS, most_rad=ANY)
def test_any_array_is_indexed_or_refused(
    vectors: NDArray, mag: NDArray, most_rad: float
) -> None:
    answered(lambda: pair_index.build(vectors, most_rad))
    answered(lambda: pair_index.build(vectors, 1.0, None, mag))


@law(quad_index.build)
@given(rng=SEEDS, count=some.integers(8, 50), height_rad=ANY)
def test_quads_are_of_four_stars_and_by_their_cell(
    rng: np.random.Generator, count: int, height_rad: float
) -> None:
    index = quad_index.build(
        sky_index.build(units(rng, count), np.sort(rng.uniform(0, 6, count))), height_rad
    )
    assert len(index.star) == len(index.code) == index.first[-1]
    assert all(len(set(star)) == 4 for star in index.star.tolist())
    assert not len(index.code) or np.abs(index.code).max() <= 1


def test_the_shipped_catalog_is_brightest_first() -> None:
    stars = catalog.hipparcos()
    assert len(stars) > 7900
    assert (np.diff(stars.v_mag) >= 0).all()


@given(place=ANY, last=some.integers(0, 1000))
def test_a_position_s_cell_is_the_nearest_one(place: float, last: int) -> None:
    """This holds for any number, including NaN and 1e300, whose casts once led beyond a table's end."""
    expected = 0 if np.isnan(place) else min(max(place, 0), last)
    assert sky_index.cell_of(float(place), last) == int(expected)
