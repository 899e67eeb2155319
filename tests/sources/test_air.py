"""Refraction and extinction against other implementations and published numbers."""

from __future__ import annotations

import datetime
from dataclasses import replace
from typing import Any

import erfa
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from astropy.utils import iers
from scipy.integrate import solve_ivp

from skysim.core.types import Floats
from skysim.scene.loader import load
from skysim.scene.sections.surroundings import AirConfig, HorizonConfig
from skysim.scene.sections.vehicle import SiteConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import build_lab
from skysim.sources import air as starlight
from skysim.sources import catalog, stars
from skysim.sources.air import Air, horizon_rad, mean_wavelength_m
from skysim.sources.bodies import BODIES, bodies_from
from skysim.sources.ephemeris import observe_from
from skysim.sources.photometry import SUN, Band, temperature_k
from skysim.sources.refraction import (
    Atmosphere,
    Refraction,
    Weather,
    refraction_rad,
    refractivity,
    standard_pressure_hpa,
    standard_temperature_c,
)

BAND = Band.from_efficiency(0.5)
ARCSEC = 1 / 206264.806
SITES = [(53.1, 8.8, 10.0), (-23.2, -45.9, 600.0), (28.3, 343.5, 2390.0)]


def site_of(place: tuple[float, float, float]) -> SiteConfig:
    latitude, longitude, height = place
    return SiteConfig(latitude_deg=latitude, longitude_deg=longitude, height=f"{height} m")


def air_at(place: tuple[float, float, float], **keys: Any) -> Air:
    return Air.from_config(
        AirConfig(**keys), site_of(place), catalog.read_for("x", "hipparcos_hp6.5"), BAND
    )


def horizontal(axes: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Azimuth and altitude in radians."""
    north, east, up = axes @ directions.T
    return np.arctan2(east, north), np.arcsin(up)


@pytest.mark.parametrize("place", SITES)
@pytest.mark.parametrize(
    "weather",
    [(1013.25, 15.0, 0.5, 550.0), (980.0, -10.0, 0.0, 450.0), (700.0, 5.0, 0.9, 900.0)],
)
def test_refraction_matches_astropy(
    place: tuple[float, float, float], weather: tuple[float, ...]
) -> None:
    """Within 0.1" down to 15 degrees of AltAz with air less AltAz without: ERFA's A tan Z + B tan^3 Z.

    The altitudes themselves are within the polar motion, which moves AltAz's zenith by up to 0.5", not ours.
    """
    pressure_hpa, temperature_c, humidity, nm = weather
    time = datetime.datetime(2012, 6, 24, 23, 10)
    stars_of = catalog.read_for("x", "hipparcos_hp6.5").to_limit(4.0)
    still = np.zeros(len(stars_of))
    stars_of = replace(stars_of, pm_ra_rad_yr=still, pm_dec_rad_yr=still, parallax_rad=still)
    directions = stars.apparent(
        stars_of, time, observe_from(time, site_of(place)).from_earth.velocity_m_s
    )
    keys = {
        "pressure_hpa": pressure_hpa,
        "temperature_c": temperature_c,
        "humidity": humidity,
    }
    sky = air_at(place, **keys, wavelength=f"{nm} nm").at(time)
    azimuth, altitude = horizontal(sky.axes, directions)
    seen_azimuth, seen_altitude = horizontal(
        sky.axes, sky.air.refraction.apparent(directions, sky.zenith)
    )
    location = EarthLocation.from_geodetic(place[1] * u.deg, place[0] * u.deg, place[2] * u.m)
    at = AltAz(location=location, obstime=Time(time))
    air = {"pressure": pressure_hpa * u.hPa, "temperature": temperature_c * u.deg_C}
    through_air = at.replicate_without_data(
        **air, relative_humidity=humidity, obswl=nm * u.nm
    )
    with iers.conf.set_temp("auto_download", False):
        icrs = SkyCoord(stars_of.ra_rad * u.rad, stars_of.dec_rad * u.rad)
        without = icrs.transform_to(at)
        seen = icrs.transform_to(through_air)
    high = seen_altitude > np.radians(15)
    assert high.sum() > 50
    raised = (seen_altitude - altitude) - (seen.alt.rad - without.alt.rad)
    assert np.abs(raised[high]).max() < 0.1 * ARCSEC
    np.testing.assert_allclose(seen_azimuth, azimuth, atol=1e-9)
    assert np.abs(altitude - without.alt.rad).max() < 0.6 * ARCSEC


def test_refraction_is_the_published_one() -> None:
    """ERFA's documentation of `refco`: ray tracing of Hohenkerk & Sinclair, 1005 hPa, 7 C, 80 %, 574 nm."""
    published = {
        10: 10.27,
        30: 33.61,
        45: 58.16,
        60: 100.51,
        70: 158.63,
        74: 200.35,
        76: 229.45,
        78: 267.44,
        80: 319.13,
    }
    air = Atmosphere.from_weather(Weather(0.0, np.radians(50.0), 1005.0, 7.0, 0.8, 574e-9))
    ours = refraction_rad(np.radians(list(published)), air) / ARCSEC
    np.testing.assert_allclose(ours, list(published.values()), rtol=2.5e-4, atol=0.006)


def test_refraction_on_the_horizon_is_half_a_degree() -> None:
    """The Nautical Almanac's 34' at 1010 hPa and 10 C; a table is as good as the integral, and no air bends nothing."""
    weather = Weather(0.0, np.radians(45.0), 1010.0, 10.0, 0.5, 590e-9)
    air = Atmosphere.from_weather(weather)
    assert refraction_rad(np.array([np.pi / 2]), air)[0] / ARCSEC / 60 == pytest.approx(
        34, abs=1
    )
    zenith_rad = np.radians(np.linspace(0.1, 89.9, 300))
    bending_rad = refraction_rad(zenith_rad, air)
    np.testing.assert_allclose(
        Refraction(weather).bending_rad(zenith_rad + bending_rad),
        bending_rad,
        atol=1e-3 * ARCSEC,
    )
    none = Refraction(weather._replace(pressure_hpa=0.0))
    assert not none.bending_rad(zenith_rad).any()


@pytest.mark.parametrize("height_m", [0.0, 4000.0])
@pytest.mark.parametrize("latitude_deg", [0.0, 45.0, -90.0])
def test_the_air_weighs_by_gravity_at_its_center_of_mass(
    latitude_deg: float, height_m: float
) -> None:
    """Normal gravity of GRS 80 (Somigliana), less 3.086e-6 /s2 a meter up to 7.3 km + 0.9 h (Saastamoinen 1972)."""
    air = Atmosphere.from_weather(
        Weather(height_m, np.radians(latitude_deg), 1000.0, 10.0, 0.0, 574e-9)
    )
    sine2 = np.sin(np.radians(latitude_deg)) ** 2
    at_sea = (
        9.7803267715 * (1 + 0.001931851353 * sine2) / np.sqrt(1 - 0.0066943800229 * sine2)
    )
    at_center = at_sea - 3.086e-6 * (7300 + 0.9 * height_m)
    assert air.scale_per_k * 8314.32 / 28.9644 == pytest.approx(at_center, rel=1e-4)


@pytest.mark.parametrize("temperature_c", [-30.0, 0.0, 20.0, 40.0])
def test_saturated_air_holds_the_water_of_erfa_and_of_magnus(temperature_c: float) -> None:
    """ERFA's A is (dry - 11.2684e-6 p_w) / T times 1 - 4.4474e-6 T; Magnus's law by Alduchov & Eskridge (1996)."""
    pressure_hpa = 1000.0
    t_k = temperature_c + 273.15
    wet, dry = (
        Atmosphere.from_weather(
            Weather(0.0, 0.8, pressure_hpa, temperature_c, humidity, 574e-9)
        )
        for humidity in (1.0, 0.0)
    )
    # What the vapor's lightness adds to the dry term is in the wet term too.
    vapor_hpa = (wet.wet - (wet.dry - dry.dry)) * t_k / 1.12684e-5
    theirs = [erfa.refco(pressure_hpa, temperature_c, one, 0.574)[0] for one in (0.0, 1.0)]
    of_erfa = (theirs[0] - theirs[1]) * t_k / (1 - 4.4474e-6 * t_k) / 11.2684e-6
    assert vapor_hpa == pytest.approx(of_erfa, rel=1e-4)
    magnus = 6.1094 * np.exp(17.625 * temperature_c / (temperature_c + 243.04))
    assert vapor_hpa == pytest.approx(magnus, rel=0.012)


def test_the_air_thins_like_the_standard_atmosphere() -> None:
    """Densities of the US Standard Atmosphere 1976 over those at the sea, in both layers; ISO 2533 at the site."""
    air = Atmosphere.from_weather(Weather(0.0, np.radians(45), 1013.25, 15.0, 0.0, 574e-9))
    at_site = air.troposphere(np.array(air.r0_m))[0] - 1
    for height_m, density in ((5000.0, 0.6012), (10000.0, 0.3376)):
        found = air.troposphere(np.array(air.r0_m + height_m))[0] - 1
        assert found / at_site == pytest.approx(density, rel=0.01)
    for height_m, density in ((11000.0, 0.2971), (20000.0, 0.07187)):
        found = air.stratosphere(np.array(air.r0_m + height_m))[0] - 1
        assert found / at_site == pytest.approx(density, rel=0.01)
    for height_m, pressure_hpa, temperature_c in (
        (1000.0, 898.75, 8.5),
        (5000.0, 540.20, -17.5),
        (8000.0, 356.00, -37.0),
    ):
        assert standard_pressure_hpa(height_m) == pytest.approx(pressure_hpa, abs=0.03)
        assert standard_temperature_c(height_m) == pytest.approx(temperature_c)


def test_moist_air_is_in_hydrostatic_balance() -> None:
    """dp/dh = -(g / R T) (M_d (p - p_w) + M_w p_w), p_w as T^18.36, integrated; slopes are those of n."""
    weather = Weather(0.0, np.radians(30), 1000.0, 30.0, 1.0, 574e-9)
    air = Atmosphere.from_weather(weather)
    dry = Atmosphere.from_weather(weather._replace(humidity=0.0))
    vapor_hpa = (air.wet - (air.dry - dry.dry)) * air.t0_k / 1.12684e-5
    per_hpa = dry.dry * air.t0_k / 1000.0

    def fall(height_m: float, pressure_hpa: Floats) -> Floats:
        t_k = air.t0_k - 0.0065 * height_m
        lighter = (1 - 18.0152 / 28.9644) * vapor_hpa * (t_k / air.t0_k) ** 18.36
        return -air.scale_per_k / t_k * (pressure_hpa - lighter)

    height_m = np.array([2000.0, 6000.0, 10000.0])
    solved = solve_ivp(fall, (0.0, 1e4), [1000.0], t_eval=height_m, rtol=1e-11, atol=1e-9)
    t_k = air.t0_k - 0.0065 * height_m
    vapor = vapor_hpa * (t_k / air.t0_k) ** 18.36
    excess = (per_hpa * solved.y[0] - 1.12684e-5 * vapor) / t_k
    r_m = air.r0_m + height_m
    np.testing.assert_allclose(air.troposphere(r_m)[0] - 1, excess, rtol=1e-7)
    for layer, at_m in ((air.troposphere, r_m), (air.stratosphere, r_m + 12e3)):
        above, below = (layer(at_m + step)[0] for step in (1.0, -1.0))
        np.testing.assert_allclose(layer(at_m)[1], at_m * (above - below) / 2, rtol=1e-4)


def test_the_colors_of_stars_do_not_depend_on_the_catalog_s_order() -> None:
    """Rigel -0.03, Betelgeuse 1.50, Sirius 0.01, Aldebaran 1.54 (Hipparcos, field H37), from a catalog backwards."""
    stars_of = catalog.read_for("x", "hipparcos_hp6.5").to_limit(3.0)
    backwards = stars_of.take(np.arange(len(stars_of))[::-1])
    air = Air.from_config(AirConfig(), site_of(SITES[0]), backwards, BAND)
    hip = np.array([24436, 27989, 32349, 21421])
    np.testing.assert_allclose(air.b_v[air.rows(hip)], [-0.03, 1.50, 0.01, 1.54], atol=0.011)


def test_bodies_are_extinct_by_their_own_colors() -> None:
    """Mars, Uranus and Neptune by B-V of 1.36, 0.50 and 0.39 (Mallama, Krobusek & Pavlov 2017, table 3)."""
    time = datetime.datetime(2012, 6, 24, 20, 0)
    published = {"mars": 1.36, "uranus": 0.50, "neptune": 0.39}
    air = air_at(SITES[0], extinction_mag=0.3, color_extinction_mag=-0.05)
    sky = air.at(time)
    for body in bodies_from(_bodies(), observe_from(time, air.site), BAND):
        if body.name in published:
            seen = sky.body_seen(body)
            lost_mag = -2.5 * np.log10(seen.flux_e_s_m2 / body.flux_e_s_m2)
            air_mass = float(sky.air_mass(seen.place.direction[None])[0])
            expected = 0.3 - 0.05 * published[body.name]
            assert lost_mag / air_mass == pytest.approx(expected, abs=1e-3)


def test_seeing_grows_with_the_depth_of_the_turbulence() -> None:
    """Fried's r0 = (0.423 k^2 sec z int Cn^2 dh)^(-3/5), the seeing as 1 / r0: at 60 degrees 2^(3/5) = 1.516."""
    sky = air_at(SITES[0], seeing_arcsec=2.0).at(datetime.datetime(2012, 6, 24, 23))
    tilted = (np.sqrt(3) * sky.axes[0] + sky.axes[2]) / 2
    at_zenith_px, at_60_px = (sky.seeing_px(axis, 5000.0) for axis in (sky.zenith, tilted))
    assert at_60_px / at_zenith_px == pytest.approx(1.516, rel=5e-3)


def test_bodies_are_refracted_like_stars() -> None:
    """The Moon is raised by the refraction of its place, and its bright limb stays across the line of sight."""
    time = datetime.datetime(2012, 6, 24, 20, 0)
    air = air_at(SITES[0])
    for body in bodies_from(_bodies(), observe_from(time, air.site), BAND):
        sky = air.at(time)
        seen = sky.body_seen(body)
        moved = np.arccos(min(float(seen.place.direction @ body.place.direction), 1.0))
        zenith_rad = np.arccos(body.place.direction @ sky.zenith)
        assert moved == pytest.approx(
            float(air.refraction.bending_rad(np.array([zenith_rad]))[0]), abs=1e-7
        )
        assert seen.place.direction @ sky.zenith >= body.place.direction @ sky.zenith
        assert abs(seen.place.toward_sun @ seen.place.direction) < 1e-12
        assert seen.id == BODIES[body.name].id
        assert seen.flux_e_s_m2 < body.flux_e_s_m2


def test_bodies_are_dispersed_as_a_star_of_the_sun_s_color() -> None:
    time = datetime.datetime(2012, 6, 24, 20, 0)
    stars = catalog.read_for("x", "hipparcos_hp6.5").to_limit(3.0)
    # The last star by its number is red, the first has the Sun's colors.
    order = np.argsort(stars.hip)
    b_v = stars.b_v.copy()
    v_i = stars.v_i.copy()
    b_v[order[[0, -1]]] = SUN[0], 1.6
    v_i[order[[0, -1]]] = SUN[1], 2.0
    colored = replace(stars, b_v=b_v, v_i=v_i)
    air = Air.from_config(AirConfig(dispersion=True), site_of(SITES[0]), colored, BAND)
    sky = air.at(time)
    solar, red = air.dispersion[air.rows(np.sort(stars.hip)[[0, -1]])]
    assert abs(solar / red - 1) > 1e-4
    for body in bodies_from(_bodies(), observe_from(time, air.site), BAND):
        seen = sky.body_seen(body).place.direction
        expected = air.refraction.apparent(
            body.place.direction[None], sky.zenith, np.array([solar])
        )[0]
        assert np.linalg.norm(seen - expected) < 1e-12


def _bodies() -> Any:
    from skysim.scene.sections.light import BodiesConfig

    return BodiesConfig()


def kasten_young(altitude_rad: Floats) -> Floats:
    """Kasten & Young 1989, Applied Optics 28, 4735: another fit to another atmosphere."""
    h_deg = np.degrees(altitude_rad)
    return 1 / (np.sin(altitude_rad) + 0.50572 * (h_deg + 6.07995) ** -1.6364)


def test_air_masses_match_kasten_and_young() -> None:
    altitude = np.radians(np.linspace(3, 90, 200))
    np.testing.assert_allclose(
        starlight.air_mass(altitude), kasten_young(altitude), rtol=0.012
    )
    # Pickering's own value.
    assert starlight.air_mass(np.array([0.0]))[0] == pytest.approx(38.75, abs=0.01)
    assert starlight.air_mass(np.array([-0.1]))[0] == starlight.air_mass(np.array([0.0]))[0]


def test_stars_are_extinct_by_air_mass_and_color() -> None:
    time = datetime.datetime(2012, 6, 24, 23)
    k = 0.3
    k_color = -0.05
    air = air_at(SITES[0], extinction_mag=k, color_extinction_mag=k_color)
    cat = catalog.read_for("x", "hipparcos_hp6.5")
    all_stars = stars.sources(cat, time, None, _identity(), BAND)
    sky = air.at(time)
    seen = sky.points_seen(all_stars)
    altitude = horizontal(sky.axes, seen.place[:, :3])[1]
    high = (
        (altitude > np.radians(5))
        & np.isfinite(cat.b_v)
        & (np.abs(cat.b_v) > 0.01)
        & (cat.b_v < 1.5)
    )
    high &= cat.v_i != 0
    lost_mag = -2.5 * np.log10(seen.strength / all_stars.strength)[high]
    wanted = kasten_young(altitude[high]) * (k + k_color * np.maximum(cat.b_v[high], -0.3))
    np.testing.assert_allclose(lost_mag, wanted, rtol=0.01)
    assert seen.id.tolist() == all_stars.id.tolist()


def _identity() -> Any:
    from scipy.spatial.transform import Rotation

    return Rotation.identity()


def test_a_skyline_is_interpolated_around_the_full_circle() -> None:
    skyline = HorizonConfig(azimuth_deg=(10, 90, 350), altitude_deg=(4, 20, 8))
    at_deg = [350, 0, 10, 50, 220, 370]
    wanted = [8, 6, 4, 12, 14, 4]
    np.testing.assert_allclose(
        np.degrees(horizon_rad(skyline, np.radians(at_deg))), wanted, atol=1e-9
    )
    sky = air_at(SITES[0], horizon={"azimuth_deg": (0, 180), "altitude_deg": (10, 30)}).at(
        datetime.datetime(2012, 1, 1)
    )
    az = np.radians([0.0, 0.0, 90.0, 90.0])
    alt = np.radians([9.9, 10.1, 19.9, 20.1])
    directions = (
        np.stack([np.cos(alt) * np.cos(az), np.cos(alt) * np.sin(az), np.sin(alt)], axis=1)
        @ sky.axes
    )
    assert sky.below_horizon(directions).tolist() == [True, False, True, False]


def test_refraction_uses_the_band_s_wavelength() -> None:
    """Of a flat band from 400 to 1000 nm by Planck's law at 5772 K, counted in photons."""
    m = np.linspace(400e-9, 1000e-9, 2001)
    photons = m**-4 / np.expm1(0.014387769 / (m * 5772))
    assert mean_wavelength_m(BAND) == pytest.approx(
        np.sum(m * photons) / np.sum(photons), abs=2e-9
    )
    narrow = Band(np.array([500e-9, 501e-9]), np.ones(2))
    assert mean_wavelength_m(narrow) == pytest.approx(500.5e-9, abs=0.1e-9)


# Refraction by color.


def test_stars_are_refracted_by_the_mean_of_their_colors() -> None:
    """ERFA's constant A of refraction at a wavelength, over that of the weather, averaged over Planck's photons."""
    time = datetime.datetime(2012, 6, 24, 23, 10)
    place = SITES[0]
    keys = {"pressure_hpa": 1000.0, "temperature_c": 10.0, "humidity": 0.0}
    one = air_at(place, dispersion=True, **keys)
    nm = np.linspace(400, 1000, 601)
    weather_nm = 1e9 * mean_wavelength_m(BAND)

    def constant(wavelength_nm: float) -> float:
        return float(erfa.refco(1000.0, 10.0, 0.0, wavelength_nm / 1e3)[0])

    relative = np.array([constant(each) for each in nm]) / constant(weather_nm)
    stars_of = catalog.read_for("x", "hipparcos_hp6.5")
    own = []
    for hip in (24436, 27989):  # Rigel and Betelgeuse
        row = np.flatnonzero(stars_of.hip == hip)
        kelvin = float(temperature_k(stars_of.b_v[row], stars_of.v_i[row])[0])
        photons = nm**-4.0 / np.expm1(1.43878e7 / (nm * kelvin))
        expected = (relative * photons).sum() / photons.sum()
        own.append(one.dispersion[one.rows(np.array([hip]))][0])
        assert own[-1] - 1 == pytest.approx(expected - 1, abs=3e-5)
    # At 45 deg the blue star is raised by half an arcsecond more than the red one.
    blue, red = own
    sky = one.at(time)
    halfway = (sky.axes[0] + sky.axes[2]) / np.sqrt(2)
    apart = [
        one.refraction.apparent(halfway[None], sky.zenith, scale)[0] for scale in (blue, red)
    ]
    assert 0.2 < np.arccos(apart[0] @ apart[1]) / ARCSEC < 1.0
    assert np.all(air_at(place, **keys).dispersion == 1)


@pytest.mark.parametrize("nm", [400.0, 900.0])
def test_another_color_is_bent_as_its_own_ray(nm: float) -> None:
    """Against the integral along the ray at that wavelength: within 0.15 % of the difference above 2 deg."""
    weather = Weather(0.0, 0.8, 1013.25, 15.0, 0.5, 550e-9)
    one = Refraction(weather)
    other = Refraction(weather._replace(wavelength_m=nm * 1e-9))
    altitude = np.radians([2.0, 3.0, 5.0, 10.0, 30.0, 60.0])
    directions = np.column_stack([np.cos(altitude), np.zeros(6), np.sin(altitude)])
    zenith = np.array([0.0, 0.0, 1.0])
    scale = float(refractivity(nm * 1e-9) / refractivity(550e-9))

    def raised(seen: Floats) -> Floats:
        return np.arctan2(seen[:, 2], seen[:, 0]) - altitude

    expected = raised(other.apparent(directions, zenith))
    plain = raised(one.apparent(directions, zenith))
    found = raised(one.apparent(directions, zenith, scale))
    np.testing.assert_allclose(found - plain, expected - plain, rtol=1.5e-3)
    # In proportion to the refractivity alone 1 % is missing at 5 deg.
    assert (scale - 1) * plain[2] / (expected - plain)[2] == pytest.approx(1.01, abs=0.004)


def test_a_star_of_the_catalog_is_refracted_by_its_own_color() -> None:
    """The light of Betelgeuse is raised less than that of Rigel, in proportion to its refraction."""
    time = datetime.datetime(2012, 12, 24, 23, 10)
    stars_of = catalog.read_for("x", "hipparcos_hp6.5")
    row = np.flatnonzero(np.isin(stars_of.hip, (27989, 24436)))
    # In their places at the epoch, high over the site or not: only the ratio is compared.
    ra = stars_of.ra_rad[row]
    dec = stars_of.dec_rad[row]
    place = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    chosen = stars.steady_points(stars_of.hip[row], place, np.ones(2), np.zeros(2))
    with_color = air_at(SITES[0], dispersion=True).at(time)
    without = air_at(SITES[0]).at(time)
    for n, hip in enumerate(chosen.id.tolist()):
        true = chosen.place[n, :3]
        raised = [
            np.arccos(true @ sky.points_seen(chosen).place[n, :3])
            for sky in (with_color, without)
        ]
        own = with_color.air.dispersion[with_color.air.rows(np.array([hip]))]
        assert raised[0] / raised[1] == pytest.approx(own[0], rel=1e-5)


def test_rendered_stars_are_raised_by_the_colors_of_their_spectra() -> None:
    """Edlen's dispersion (1966) over Planck's photons times ERFA's refraction, 45 deg high, to 3 % of the greatest."""
    keys = {
        "background": "[]",
        "motion.rate_deg_s": "[0, 0, 0]",
        "motion.start": "{ra_deg: 71, dec_deg: 15, roll_deg: 0}",
        "site": "{latitude_deg: 53.1, longitude_deg: 8.8, height: 10 m}",
        "start_time": "2012-12-29T22:00:00",
    }
    weather = "pressure_hpa: 1000, temperature_c: 10, humidity: 0, scintillation: false"
    images = []
    for color in ("false", "true"):
        one = keys | {"light.air": f"{{{weather}, dispersion: {color}}}"}
        lab = build_lab(load("shefex2", one))
        camera = lab.camera
        images.append(render_at_rest(camera, lab.start)[1])
    plain, raised = (one.sources for one in images)
    _, before, after = np.intersect1d(plain.id, raised.id, return_indices=True)
    moved_px = raised.xy_px[after] - plain.xy_px[before]
    sky = next(one.air for one in camera.lights if hasattr(one, "air")).at(
        camera.scene.start_time
    )
    lens = camera.scene.camera
    ray = np.column_stack(
        [plain.xy_px[before] - lens.center_px, np.full(len(before), lens.focal_px)]
    )
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    zenith = images[0].cam_from_lab.apply(sky.zenith)
    along = zenith - (ray @ zenith)[:, None] * ray
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    upward_px = (
        lens.focal_px
        * (along[:, :2] * ray[:, 2:] - ray[:, :2] * along[:, 2:])
        / ray[:, 2:] ** 2
    )
    found = (moved_px * upward_px).sum(axis=1) / (upward_px**2).sum(axis=1) / ARCSEC

    nm = np.linspace(300, 1100, 1601)
    response = np.interp(nm * 1e-9, camera.band.wavelength_m, camera.band.response, 0, 0)
    shown = catalog.read_for("x", camera.scene.light.catalog)
    order = np.argsort(shown.hip)
    row = order[np.searchsorted(shown.hip[order], plain.id[before])]
    kelvin = temperature_k(shown.b_v[row], shown.v_i[row])[:, None]

    def edlen(nm: Floats) -> Floats:
        s2 = (1e3 / nm) ** 2
        return 8342.13 + 2406030 / (130 - s2) + 15997 / (38.9 - s2)

    photons = response * nm**-4.0 / np.expm1(1.438777e7 / (nm * kelvin))
    mean = (photons * edlen(nm)).sum(axis=1) / photons.sum(axis=1)
    middle_nm = 1e9 * sky.air.wavelength_m
    a, b = erfa.refco(1000.0, 10.0, 0.0, middle_nm / 1e3)
    tangent = np.tan(np.arccos(ray @ zenith))
    wanted = (a * tangent + b * tangent**3) * (mean / edlen(np.array(middle_nm)) - 1) / ARCSEC
    assert len(wanted) > 10
    assert np.abs(wanted).max() > 0.2
    np.testing.assert_allclose(found, wanted, rtol=0, atol=0.03 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("altitude_deg", "air_masses"),
    [(2.0, 19.6427), (5.0, 10.3337), (10.0, 5.58074), (30.0, 1.993154), (60.0, 1.154058)],
)
def test_air_masses_are_those_of_the_published_formula(
    altitude_deg: float, air_masses: float
) -> None:
    """1 / sin(h + 244 / (165 + 47 h^1.1)), in degrees, worked out by hand (Pickering 2002)."""
    found = starlight.air_mass(np.radians([altitude_deg]))[0]
    assert found == pytest.approx(air_masses, rel=3e-6)


def test_turbulence_and_wind_have_their_published_values() -> None:
    """Hufnagel-Valley 5/7 (A = 1.7e-14, W = 21 m/s) on the ground, and its high layer at 10 km; Bufton's jet at 9.4 km.

    0.00594 (7/9)^2 1e-10 e^-10 = 1.6314e-17, and 2.7e-16 e^(-20/3) = 3.436e-19.
    """
    ground, high, site = starlight.hufnagel_valley(
        np.array([0.0, 10_000.0, 1500.0]), np.array([0.0, 10_000.0, 100.0])
    )
    assert ground == pytest.approx(1.7e-14 + 2.7e-16, rel=1e-9)
    assert high == pytest.approx(1.6314e-17 + 3.436e-19, rel=2e-4)
    assert site == pytest.approx((1.7e-14 + 2.7e-16) / np.e, rel=1e-3)
    jet = starlight.wind(np.array([9400.0, 4600.0, 14_200.0]))
    np.testing.assert_allclose(jet, [35.0, 5 + 30 / np.e, 5 + 30 / np.e], rtol=1e-12)


def test_layers_of_the_air_integrate_to_25_km() -> None:
    """Of the model's turbulence, to 0.1 %, by the trapezoidal rule at steps of half a meter."""
    for height_m in (0.0, 2400.0):
        above_m, strength = starlight.layers(height_m)
        fine_m = np.arange(0.0, 25_000.1, 0.5)
        profile = starlight.hufnagel_valley(height_m + fine_m, fine_m)
        for power in (0, 5 / 6, 2):
            expected = np.trapezoid(profile * fine_m**power, fine_m)
            assert np.sum(strength * above_m**power) == pytest.approx(expected, rel=1e-3)


def test_apertures_and_exposures_filter_by_their_means() -> None:
    """A disc's mean of a wave, by quadrature; the mean of sinc^2 over all directions of the wind."""
    for x in (0.3, 1.0, 2.7):
        r = (np.arange(4000) + 0.5) / 8000
        disc = np.sum(
            np.cos(2 * np.pi * x * r[:, None] * np.cos(np.arange(360) * np.pi / 180))
            * r[:, None]
        )
        disc /= 360 * np.sum(r)
        assert starlight.airy(np.array([x]))[0] == pytest.approx(disc, abs=1e-4)
    assert starlight.airy(np.zeros(1))[0] == pytest.approx(1)
    around = (np.arange(20_000) + 0.5) * np.pi / 20_000
    for turns in (0.1, 1.3, 20.0):
        mean = np.mean(np.sinc(turns * np.cos(around)) ** 2)
        assert starlight.exposure_filter(np.array([turns]))[0] == pytest.approx(
            mean, rel=1e-4
        )
    assert starlight.exposure_filter(np.zeros(1))[0] == pytest.approx(1, abs=1e-6)


def test_a_star_s_light_varies_about_its_mean_by_the_variance() -> None:
    """Log-normal: never negative, of the mean 1."""
    variances = np.repeat([0.0, 0.04, 0.5], 200_000)
    found = starlight.factors(variances, np.random.default_rng(5)).reshape(3, -1)
    assert found.min() > 0
    np.testing.assert_allclose(found.mean(axis=1), 1, atol=0.01)
    np.testing.assert_allclose(found.var(axis=1), [0.0, 0.04, 0.5], rtol=0.03)
    skew = np.mean(np.log(found[2]))
    assert skew == pytest.approx(-np.log(1.5) / 2, abs=0.01)


def test_lights_of_no_catalog_have_the_row_of_the_sun() -> None:
    """Beside, between and beyond the catalog's numbers."""
    air = air_at(SITES[0])
    last = int(air.star_id[-1])
    known = air.star_id[[0, 5, -1]]
    between = next(n for n in range(1, 500) if n not in set(air.star_id.tolist()))
    found = air.rows(np.array([*known, between, last + 1, 10**12, 0]))
    assert found.tolist() == [0, 5, len(air.star_id) - 1, -1, -1, -1, -1]
    assert len(air.b_v) == len(air.star_id) + 1
    assert air.extinction_mag(0.5) == pytest.approx(
        air.config.extinction_mag + 0.5 * air.config.color_extinction_mag
    )


def test_light_fades_by_its_magnitudes_of_extinction() -> None:
    found = starlight.transmission(np.array([0.0, 1.0, 2.5]), 2.0)
    np.testing.assert_allclose(found, [1.0, 10**-0.8, 0.01])


def test_altitudes_are_above_and_below_the_horizon() -> None:
    """And of a vector that is longer than one by rounding that of the zenith."""
    sky = air_at(SITES[0]).at(datetime.datetime(2012, 6, 24, 23))
    altitude = np.radians([-90.0, -30.0, 0.0, 20.0, 90.0])
    directions = np.outer(np.sin(altitude), sky.zenith) + np.outer(
        np.cos(altitude), sky.axes[0]
    )
    np.testing.assert_allclose(
        sky.altitude_rad(directions * (1 + 1e-15)), altitude, rtol=0, atol=1e-7
    )
