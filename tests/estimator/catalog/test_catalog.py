"""The on-board catalog: apparent places against astropy, doubles and magnitudes against hand calculations."""

import datetime
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import GCRS, Distance, SkyCoord
from astropy.time import Time
from astropy.utils import iers
from scipy.spatial import cKDTree

from estimator.catalog import catalog
from estimator.catalog.catalog import Observer, StarCatalog
from estimator.core.errors import ImageError

FILE = Path(__file__).parents[3] / "data/catalogs/hipparcos_hp6.5.ecsv"
ARCSEC_RAD = np.pi / 180 / 3600
MAS_RAD = ARCSEC_RAD / 1000
DATES = [
    datetime.datetime(1995, 1, 3),
    datetime.datetime(2016, 6, 21, 7, 30),
    datetime.datetime(2027, 10, 9),
]
EPOCH_YR = 1991.25
EPOCH = b"#   epoch_jyear: 1991.25\n"
HEADER = EPOCH + b"hip,ra_deg,dec_deg,pm_ra_mas_yr,pm_dec_mas_yr,parallax_mas,v_mag"


@pytest.fixture(scope="module")
def stars() -> StarCatalog:
    return catalog.read(FILE)


def made_up(*rows: tuple[float, ...]) -> StarCatalog:
    """Stars of (id, ra deg, dec deg, pm_ra, pm_dec mas/yr, parallax mas, V)."""
    return catalog.from_columns(*np.array(rows).T, epoch_yr=EPOCH_YR)


def separation_rad(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2)


def columns_of_the_file() -> dict[str, np.ndarray]:
    lines = [line for line in FILE.read_text().splitlines() if not line.startswith("#")]
    rows = [line.split(",") for line in lines[1:]]
    names = lines[0].split(",")[:-1]
    return {name: np.array([float(row[k]) for row in rows]) for k, name in enumerate(names)}


@pytest.fixture(scope="module")
def oracle() -> SkyCoord:
    """The file as SkyCoord; a star without a measured parallax gets 1e-6 arcsec."""
    table = columns_of_the_file()
    return SkyCoord(
        ra=table["ra_deg"] * u.deg,
        dec=table["dec_deg"] * u.deg,
        pm_ra_cosdec=table["pm_ra_mas_yr"] * u.mas / u.yr,
        pm_dec=table["pm_dec_mas_yr"] * u.mas / u.yr,
        distance=Distance(parallax=np.maximum(table["parallax_mas"], 1e-3) * u.mas),
        radial_velocity=np.zeros(len(table["hip"])) * u.km / u.s,
        obstime=Time(1991.25, format="jyear", scale="tdb"),
    )


@pytest.mark.filterwarnings("ignore:ERFA function")  # negative parallaxes, set aside below
@pytest.mark.parametrize("date", DATES)
def test_apparent_places_match_skycoord(
    stars: StarCatalog, oracle: SkyCoord, date: datetime.datetime
) -> None:
    with (
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
    ):
        time = Time(date, scale="utc")
        wanted = oracle.apply_space_motion(new_obstime=time).transform_to(GCRS(obstime=time))
    wanted = wanted.cartesian.xyz.value.T
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    in_file_s_order = np.empty((len(stars), 3))
    order = np.argsort(columns_of_the_file()["v_mag"], kind="stable")
    here = catalog.on_earth(date)
    in_file_s_order[order] = catalog.apparent(stars, here)
    off_mas = separation_rad(in_file_s_order, wanted) / MAS_RAD
    assert np.mean(off_mas < 2) > 0.99
    # A negative parallax has no place in SkyCoord. Near the Sun its own 0.005 au from the barycenter shows.
    far = in_file_s_order @ here.position_au > -np.cos(np.radians(15)) * np.linalg.norm(
        here.position_au
    )
    fair = far & (columns_of_the_file()["parallax_mas"] > 0)
    assert fair.sum() > 7500
    # The classical law of aberration is up to 0.51 mas off the relativistic; 0.15 for the Sun's place.
    assert off_mas[fair].max() < 0.66


def test_the_classical_aberration_differs_by_half_a_thousandth_at_most() -> None:
    # At 29.8 km/s and 45 or 135 degrees from the motion: v^2 / 4 c^2 = 0.51 mas.
    angle = np.radians(np.arange(0, 181, 5))
    star = StarCatalog(
        np.arange(37),
        np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]),
        np.zeros((37, 3)),
        np.zeros(37),
        np.zeros(37),
        EPOCH_YR,
    )
    beta = 29_800 / 299_792_458
    # Where no Sun bends light.
    far = Observer(1991.25, np.array([0.0, 0.0, 1e9]), np.array([29_800.0, 0.0, 0.0]))
    seen = catalog.apparent(star, far)
    relativistic = np.arccos((np.cos(angle) + beta) / (1 + beta * np.cos(angle)))
    off_mas = np.abs(np.arctan2(seen[:, 1], seen[:, 0]) - relativistic) / MAS_RAD
    assert off_mas.max() == pytest.approx(0.51, abs=0.01)


def test_a_star_like_barnard_s_drifts_ten_arcseconds_a_year() -> None:
    # 10.36"/yr for 20 years, northward from dec +4.7: a rotation towards the pole but for the cube of 207".
    start, end = (
        catalog.at_epoch(made_up((1, 269.4, 4.7, 0, 10_360, 0, 9.5)), 1991.25 + t)
        for t in (0, 20)
    )
    moved = np.degrees(np.arcsin(end[0, 2]) - np.arcsin(start[0, 2])) * 3600
    assert moved == pytest.approx(207.2, abs=1e-3)


def test_proper_motion_in_right_ascension_is_along_the_parallel() -> None:
    # 1"/yr of mu_alpha cos(delta) at dec 60 is 1" of arc toward the east: from RA 0, along +y.
    star = made_up((1, 0, 60, 1000, 0, 0, 5))
    moved = catalog.at_epoch(star, 1992.25) - catalog.at_epoch(star, 1991.25)
    # 1e-10 rad: half the square of 1".
    np.testing.assert_allclose(moved, [[0, ARCSEC_RAD, 0]], rtol=0, atol=1e-10)


def test_parallax_shifts_stars_toward_the_sun() -> None:
    # A star at right angles to the Earth's place p shifts by the parallax toward -p.
    still = np.zeros(3)
    star = made_up((1, 90, 0, 0, 0, 750, 5))
    near = catalog.apparent(star, Observer(1991.25, np.array([1.0, 0, 0]), still))
    bare = catalog.apparent(
        made_up((1, 90, 0, 0, 0, 0, 5)), Observer(1991.25, np.array([1.0, 0, 0]), still)
    )
    # 1e-11 rad: half the square of 0.75".
    np.testing.assert_allclose(near - bare, [[-0.75 * ARCSEC_RAD, 0, 0]], rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("elongation_deg", "bent_mas"), [(90, 4.07), (45, 9.83), (10, 46.5), (180, 0)]
)
def test_the_sun_deflects_light_by_the_textbook_s_angles(
    elongation_deg: float, bent_mas: float
) -> None:
    # 4.07 mas cot(psi / 2) at 1 au (Will 2014; IERS Conventions 2010, chapter 11). The Sun is toward -x.
    star = made_up((1, 180 - elongation_deg, 0, 0, 0, 0, 5))
    seen = catalog.apparent(star, Observer(1991.25, np.array([1.0, 0, 0]), np.zeros(3)))[0]
    turned = np.radians(180 - elongation_deg) - np.arctan2(seen[1], seen[0])
    assert turned / MAS_RAD == pytest.approx(bent_mas, abs=0.05)


def test_naive_times_are_utc_like_zoned_ones() -> None:
    zone = datetime.timezone(datetime.timedelta(hours=-3))
    naive = catalog.on_earth(datetime.datetime(2024, 5, 6, 15))
    zoned = catalog.on_earth(datetime.datetime(2024, 5, 6, 12, tzinfo=zone))
    np.testing.assert_array_equal(naive.position_au, zoned.position_au)
    # JD 2460437.125; TT is 69.184 s later.
    assert naive.epoch_yr == pytest.approx(
        2000 + (8892.125 + 69.184 / 86400) / 365.25, abs=1e-9
    )


def test_the_earth_moves_thirty_kilometers_a_second_about_a_sun_one_au_away() -> None:
    for month in range(1, 13):
        here = catalog.on_earth(datetime.datetime(2023, month, 4))
        # 0.0167 of eccentricity, and 0.009 au and 16 m/s of the Sun's own motion at most.
        assert np.linalg.norm(here.position_au) == pytest.approx(1, abs=0.027)
        assert np.linalg.norm(here.velocity_m_s) == pytest.approx(29_785, rel=0.018)


def test_two_equal_stars_ten_arcseconds_apart_merge_half_way_and_0_753_brighter() -> None:
    # -2.5 log10 2 = -0.7526.
    pair = made_up(
        (7, 50, -1e-3 * 5 / 3.6, 100, 0, 8, 5), (8, 50, 1e-3 * 5 / 3.6, 300, 20, 16, 5)
    )
    one = catalog.merge_doubles(pair, 11 * ARCSEC_RAD)
    assert one.id.tolist() == [7]
    assert one.v_mag[0] == pytest.approx(5 - 0.7526, abs=1e-4)
    middle = made_up((0, 50, 0, 200, 10, 12, 5))
    np.testing.assert_allclose(one.vectors, middle.vectors, rtol=0, atol=1e-14)  # rounding
    # 1e-13 rad/yr: the directions of east differ by 10" times 0.3"/yr.
    np.testing.assert_allclose(one.drift_rad_yr, middle.drift_rad_yr, rtol=0, atol=1e-10)
    assert one.parallax_rad[0] / MAS_RAD == pytest.approx(12, abs=1e-9)


def test_the_center_of_light_is_nearer_to_the_brighter_star() -> None:
    # A magnitude of 2.5 is a tenth of the light: the middle stands 1/11 of the way from the bright one.
    pair = made_up((1, 50, 0, 0, 0, 0, 4.0), (2, 50, 11 / 3600, 0, 0, 0, 6.5))
    one = catalog.merge_doubles(pair, 20 * ARCSEC_RAD)
    assert one.id.tolist() == [1]
    assert np.arcsin(one.vectors[0, 2]) / ARCSEC_RAD == pytest.approx(1, abs=1e-6)
    assert one.v_mag[0] == pytest.approx(4 - 2.5 * np.log10(1.1), abs=1e-12)


def test_a_chain_of_close_stars_merges_and_a_distant_star_does_not() -> None:
    chain = [(k, 50, k * 9 / 3600, 0, 0, 0, 5.0) for k in range(4)]
    merged = catalog.merge_doubles(
        made_up(*chain, (9, 50, -11 / 3600, 0, 0, 0, 3.0)), 10 * ARCSEC_RAD
    )
    assert merged.id.tolist() == [9, 0]
    assert merged.v_mag[1] == pytest.approx(5 - 2.5 * np.log10(4), abs=1e-12)


def test_merging_keeps_all_the_light_brightest_first(stars: StarCatalog) -> None:
    merged = catalog.merge_doubles(stars, 120 * ARCSEC_RAD)
    assert len(merged) < len(stars)
    assert np.all(np.diff(merged.v_mag) >= 0)
    light = np.sum(10 ** (-0.4 * stars.v_mag))
    assert np.sum(10 ** (-0.4 * merged.v_mag)) == pytest.approx(light, rel=1e-12)  # rounding
    apart = 2 * np.sin(60 * ARCSEC_RAD)
    # Only the middles of chains may have come closer than that to each other.
    assert len(cKDTree(merged.vectors).query_pairs(apart)) <= 3


def test_brighter_keeps_the_limit_itself() -> None:
    stars = made_up(
        (1, 0, 0, 0, 0, 0, 4.0), (2, 9, 0, 0, 0, 0, 5.0), (3, 20, 0, 0, 0, 0, 5.01)
    )
    assert catalog.brighter_than(stars, 5.0).id.tolist() == [1, 2]


def test_the_limit_for_a_density_gives_that_density(stars: StarCatalog) -> None:
    # 14.87 x 11.15 degrees, 12 stars a field on average: count 12 * 4 pi / field over the sky.
    field_sr = np.radians(14.87) * np.radians(11.15)
    limit = catalog.limit_for_density(stars, field_sr, 12)
    wanted = 12 * 4 * np.pi / field_sr
    count = len(catalog.brighter_than(stars, limit))
    # Stars of the same thousandth of a magnitude come together.
    assert wanted - 1 <= count <= wanted + 10
    assert catalog.limit_for_density(stars, field_sr, 1e9) == stars.v_mag.max()


def test_the_file_is_read_whole_brightest_first(stars: StarCatalog) -> None:
    # 7,996 rows by its own header; Sirius is HIP 32349, at 6h45m09s -16d43' and -1.46.
    assert len(stars) == 7996
    assert stars.id[0] == 32349
    assert stars.v_mag[0] == -1.46
    ra, dec = np.radians([(6 + 45 / 60 + 8.9 / 3600) * 15, -(16 + 42 / 60 + 58 / 3600)])
    sirius = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    # J2000, 8.75 years at 1.34"/yr.
    assert separation_rad(stars.vectors[0], np.array(sirius)) < 15 * ARCSEC_RAD
    assert np.all(np.diff(stars.v_mag) >= 0)
    np.testing.assert_allclose(np.linalg.norm(stars.vectors, axis=1), 1, rtol=0, atol=1e-15)
    # A drift is tangent; 1e-20 is rounding of some 1e-5 rad/yr at most.
    np.testing.assert_allclose(
        np.sum(stars.vectors * stars.drift_rad_yr, axis=1), 0, rtol=0, atol=1e-20
    )


def test_a_file_separated_by_blanks_is_read(tmp_path: Path) -> None:
    path = tmp_path / "blanks.ecsv"
    path.write_bytes(
        b"# %ECSV 1.0\n"
        + HEADER.replace(b",", b" ")
        + b"\n1 10.0 20.0 0 0 0 5.5\n2 30.0 40.0 0 0 0 1.5\n"
    )
    assert catalog.read(path).id.tolist() == [2, 1]


UNREADABLE = {
    "empty.ecsv": b"",
    "comments.ecsv": b"# %ECSV 1.0\n",
    "header_only.ecsv": HEADER + b"\n",
    "no_magnitude.ecsv": EPOCH + b"hip,ra_deg,dec_deg\n1,2,3\n",
    "words.ecsv": HEADER + b"\n1,2,3,0,0,0,bright\n",
    "gap.ecsv": HEADER + b"\n1,2,3,0,0,,5\n",
    "short.ecsv": HEADER + b"\n1,2,3,0,0,0,5\n1,2,3\n",
    "not_a_number.ecsv": HEADER + b"\n1,2,nan,0,0,0,5\n",
    "binary.ecsv": b"\x89PNG\r\n\x1a\n\x00\xff",
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_an_invalid_catalog_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(UNREADABLE[name])
    with pytest.raises(
        ImageError, match=r"not a star catalog .*allowed: ECSV with hip, ra_deg"
    ) as refusal:
        catalog.read(path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "epoch",
    ["", "#   epoch_jyear: last year\n", "#   epoch_jyear: 1e9\n", "#   epoch_jyear: 16\n"],
)
def test_a_file_without_an_epoch_is_refused(tmp_path: Path, epoch: str) -> None:
    path = tmp_path / "stars.ecsv"
    path.write_bytes(epoch.encode() + HEADER.removeprefix(EPOCH) + b"\n1,2,3,0,0,0,5\n")
    with pytest.raises(ImageError, match=r"its header has no epoch_jyear of 1800 to 2200"):
        catalog.read(path)


def test_stars_move_from_the_epoch_of_their_file(tmp_path: Path) -> None:
    # 1"/yr north from 2016.0 to 2012.0 is 4" south; from J1991.25 it would be 20.75" north.
    path = tmp_path / "stars.ecsv"
    path.write_bytes(HEADER.replace(b"1991.25", b"2016.0") + b"\n1,0,0,0,1000,0,5\n")
    stars = catalog.read(path)
    assert stars.epoch_yr == 2016.0
    for kept in (stars, stars.take(np.array([0])), catalog.merge_doubles(stars, 1e-4)):
        assert catalog.at_epoch(kept, 2012.0)[0, 2] / ARCSEC_RAD == pytest.approx(
            -4, abs=1e-6
        )


@pytest.mark.parametrize("name", [".", "no_such_file.ecsv"])
def test_a_missing_file_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(ImageError, match="not a star catalog"):
        catalog.read(tmp_path / name)
