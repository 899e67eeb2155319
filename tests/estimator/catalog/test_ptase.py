"""PTASE's READCAT and PROC_CAT: published counts, the epoch against erfa, merged light, and the log."""

from pathlib import Path

import erfa
import numpy as np
import pytest
from scipy.spatial import cKDTree

from estimator.catalog.published_catalogs import (
    BYTES_PER_ENTRY,
    Color,
    OnBoard,
    histogram,
    log,
    proc_cat,
    read_cat,
)
from estimator.core.errors import ImageError

FILE = Path(__file__).parents[3] / "data/catalogs/hipparcos_hp6.5.ecsv"
ARCSEC_RAD = np.pi / 648_000
HEADER = "# epoch_jyear: 1991.25\nhip,ra_deg,dec_deg,pm_ra_mas_yr,pm_dec_mas_yr,parallax_mas,v_mag,b_v,v_i\n"


def made_up(ra_arcsec: list[float], magnitude: list[float]) -> OnBoard:
    """Stars on the equator."""
    ra = np.array(ra_arcsec) * ARCSEC_RAD
    vectors = np.column_stack([np.cos(ra), np.sin(ra), 0 * ra])
    return OnBoard(
        np.arange(len(ra)), vectors, np.array(magnitude), np.ones(len(ra), int), 2000.0
    )


@pytest.mark.parametrize(("limit", "published"), [(5.0, 1618), (5.4, 2551), (6.0, 5025)])
def test_the_counts_are_the_published_ones(limit: float, published: int) -> None:
    # Reference section 2, counted from hip2 with V from Hp; some dozens of stars are supplied from elsewhere.
    assert len(read_cat(FILE, limit)) == pytest.approx(published, rel=0.005)


def test_the_file_s_order_stays_until_the_catalog_is_processed() -> None:
    raw = read_cat(FILE, 5.0)
    numbers = [
        int(line.split(",")[0])
        for line in FILE.read_text().splitlines()
        if line[:1].isdigit()
    ]
    place = {hip: n for n, hip in enumerate(numbers)}
    assert np.all(np.diff([place[hip] for hip in raw.id]) > 0)
    assert np.any(np.diff(raw.magnitude) < 0)
    assert np.all(np.diff(proc_cat(raw, 60 * ARCSEC_RAD).magnitude) >= 0)


def test_the_mission_s_epoch_matches_erfa_s_space_motion() -> None:
    raw = read_cat(FILE, 4.0, 2010.0)
    still = read_cat(FILE, 4.0)
    rows = [line.split(",") for line in FILE.read_text().splitlines() if line[:1].isdigit()]
    table = {int(row[0]): [float(x) for x in row[1:5]] for row in rows}
    ra, dec, pm_ra, pm_dec = np.array([table[hip] for hip in raw.id]).T
    ra, dec = np.radians([ra, dec])
    pm_ra, pm_dec = np.array([pm_ra / np.cos(dec), pm_dec]) * 1e-3 * ARCSEC_RAD
    epochs = erfa.DJ00, -8.75 * 365.25, erfa.DJ00, 10 * 365.25
    ra, dec, *_ = erfa.pmsafe(ra, dec, pm_ra, pm_dec, 0.01, 0.0, *epochs)
    oracle = np.column_stack(
        [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    )
    # 0.2 mas: erfa moves a star evenly in space, 0.01" of parallax away; alpha Centauri's 69" is its angle's tangent.
    assert np.linalg.norm(oracle - raw.vectors, axis=1).max() < 2e-4 * ARCSEC_RAD
    assert np.linalg.norm(raw.vectors - still.vectors, axis=1).max() > 60 * ARCSEC_RAD


def test_an_instrument_s_magnitudes_follow_the_formula_and_a_missing_color_is_the_sun_s(
    tmp_path: Path,
) -> None:
    path = tmp_path / "three.ecsv"
    path.write_text(
        HEADER + "1,0,0,0,0,0,4.0,0.0,0.0\n2,9,0,0,0,0,5.0,1.5,1.0\n3,20,0,0,0,0,5.0,,\n"
    )
    seen = read_cat(path, 6.0, color=Color(0.1, -0.2, 0.3))
    # By hand: 4 + .1; 5 + .1 - .3 + .3; 5 + .1 - .2 * .65 + .3 * .72.
    np.testing.assert_allclose(
        seen.magnitude, [4.1, 5.1, 5.186], rtol=0, atol=1e-12
    )  # rounding
    # The limit is a visual one, whatever the instrument sees.
    assert read_cat(path, 4.5, color=Color(3.0)).id.tolist() == [1]


def test_a_double_is_one_star_of_all_the_light_at_its_center() -> None:
    # 5 and 7.5: a tenth of the light, so 1/11 of the way, and -2.5 log10(1.1) brighter.
    one = proc_cat(made_up([0, 110, 4000], [7.5, 5.0, 6.0]), 120 * ARCSEC_RAD)
    assert one.id.tolist() == [1, 2]
    assert one.components.tolist() == [2, 1]
    assert one.magnitude[0] == pytest.approx(5 - 2.5 * np.log10(1.1), abs=1e-12)
    ra = np.arctan2(one.vectors[0, 1], one.vectors[0, 0])
    assert ra / ARCSEC_RAD == pytest.approx(
        100, abs=1e-4
    )  # a chord instead of an arc: 1e-7 of it


def test_merging_keeps_light_and_star_count_and_leaves_the_rest_apart() -> None:
    raw = read_cat(FILE, 6.5, 2010.0)
    merged = proc_cat(raw, 120 * ARCSEC_RAD)
    light, all_light = (np.sum(10 ** (-0.4 * stars.magnitude)) for stars in (merged, raw))
    assert light == pytest.approx(all_light, rel=1e-12)  # rounding
    assert merged.components.sum() == len(raw)
    assert len(merged) < len(raw)
    # As many entries as the pairs leave groups; only the middles of chains may have come closer.
    assert len(cKDTree(merged.vectors).query_pairs(2 * np.sin(60 * ARCSEC_RAD))) <= 3
    pairs = len(cKDTree(raw.vectors).query_pairs(2 * np.sin(60 * ARCSEC_RAD)))
    assert 0 < len(raw) - len(merged) <= pairs


def test_processing_again_changes_nothing() -> None:
    once = proc_cat(read_cat(FILE, 5.5), 60 * ARCSEC_RAD)
    twice = proc_cat(once, 60 * ARCSEC_RAD)
    np.testing.assert_array_equal(once.id, twice.id)
    np.testing.assert_array_equal(once.components, twice.components)


def test_the_histogram_counts_every_star_in_its_bin() -> None:
    edges, count = histogram(np.array([-1.46, 0.0, 0.49, 0.5, 1.7]), 0.5)
    assert edges.tolist() == [-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5]
    assert count.tolist() == [1, 0, 0, 2, 1, 0, 1]
    magnitude = read_cat(FILE, 6.0).magnitude
    edges, count = histogram(magnitude, 0.25)
    np.testing.assert_array_equal(
        count, np.histogram(magnitude, [*edges, edges[-1] + 0.25])[0]
    )


def test_the_log_has_the_histogram_the_memory_and_every_star() -> None:
    stars = proc_cat(
        made_up([0, 110, 4000, 3600 * 90], [7.5, 5.0, 6.0, -1.0]), 120 * ARCSEC_RAD
    )
    lines = log(stars).splitlines()
    assert lines[0] == "3 entries from 4 stars at J2000.00; 1 of them of 2 stars"
    assert lines[1].startswith(f"{3 * BYTES_PER_ENTRY} bytes")
    assert lines[-3].split() == ["3", "90.000000", "+0.000000", "-1.000", "1"]
    assert lines[-2].split() == [
        "1",
        "0.027778",
        "+0.000000",
        "4.897",
        "2",
    ]  # 100", 5 - .1035
    counts = [int(line.split()[3]) for line in lines if ".." in line]
    assert sum(counts) == 3


def test_an_invalid_catalog_and_a_limit_without_stars_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "no_colors.ecsv"
    path.write_text(HEADER.replace(",b_v,v_i", "") + "1,0,0,0,0,0,4\n")
    assert len(read_cat(path, 6.0)) == 1
    with pytest.raises(ImageError, match=r"not a star catalog .*v_mag, b_v, v_i"):
        read_cat(path, 6.0, color=Color(0.1))
    with pytest.raises(ImageError, match="no star of V <= -3; allowed: a fainter limit"):
        read_cat(FILE, -3.0)
