"""Stray light past the baffle against Planck's law, Lambert's sphere and sums over the Earth's surface."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from skysim.camera.glow import earth_glow
from skysim.camera.glow.earth_glow import (
    earth_around,
    stray_around_e_s_m2,
    stray_of_bodies_e_s_m2,
)
from skysim.core.constants import EARTH_RADIUS_M, SUN_V_MAG
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.scene.sections.camera import BaffleConfig
from skysim.scene.sections.surroundings import EarthConfig
from skysim.simulation.exposure import expected_exposure, render_at_rest
from skysim.simulation.lab import Lab, build_lab
from skysim.simulation.lights.effects import stray_e_s
from skysim.simulation.lights.light import beam_of
from skysim.sources.photometry import SUN, Band, star_flux_e_s_m2

BAND = Band.from_efficiency(0.5)  # flat from 400 to 1000 nm
IRRADIANCE = float(star_flux_e_s_m2(SUN_V_MAG, *SUN, BAND))
EVEN = BaffleConfig(angle_deg=(0, 180), pst=(1e-4, 1e-4))
STEEP = BaffleConfig(angle_deg=(20, 50, 90, 120), pst=(1e-3, 1e-7, 1e-9, 1e-12))
DARK_EARTH = EarthConfig(albedo=0.3, airglow_mag_arcsec2=30.0)
TABLE = "{angle_deg: [20, 50, 90, 120], pst: [1e-3, 1e-7, 1e-9, 1e-12]}"
ORBIT = "{kind: circular, altitude: 500 km, inclination_deg: 97, raan_deg: 90, earth: {albedo: 0.3}}"


@pytest.fixture
def sphere(monkeypatch: pytest.MonkeyPatch) -> None:
    """A round Earth without air."""
    monkeypatch.setattr(earth_glow, "TO_SPHERE", np.full(3, 1 / EARTH_RADIUS_M))
    monkeypatch.setattr(earth_glow, "AIR_M", 1.0)


def in_space(ra_deg: float, dec_deg: float, **keys: str) -> Lab:
    start = f"{{ra_deg: {ra_deg}, dec_deg: {dec_deg}, roll_deg: 0}}"
    given = {
        "camera.baffle": TABLE,
        "motion.start": start,
        "start_time": "2012-06-24T21:00:00",
        "background": "[]",
    }
    overrides = given | {key.replace("__", "."): value for key, value in keys.items()}
    return build_lab(loader.load("shefex2", overrides))


def stray_of(lab: Lab, t_s: float = 0.0) -> dict[str, float]:
    return stray_e_s(
        lab.camera.lights, expected_exposure(lab.camera, lab.start, np.zeros(3), t_s)
    )


def test_the_sun_s_light_is_its_irradiance_times_the_transmittance() -> None:
    """1361 W/m2 of a black body of 5772 K, counted in photons: Kopp & Lean 2011; V = -26.74 gives 4 % more."""
    lab = in_space(90.0, -20.0, light__bodies="{moon: false, planets: false}")
    sun = beam_of(
        lab.camera.lights, expected_exposure(lab.camera, lab.start, np.zeros(3), 0.0)
    ).discs[0]
    m = np.linalg.norm(
        np.cross(sun.place.direction, [0.0, np.cos(np.radians(20)), np.sin(np.radians(-20))])
    )
    angle_deg = np.degrees(np.arcsin(m))
    assert 40 < angle_deg < 50
    wavelength_m = np.linspace(100e-9, 100e-6, 400_001)
    power = wavelength_m**-5 / np.expm1(0.014387769 / (wavelength_m * 5772))
    # Aphelion was ten days later.
    power *= 1361 / integrate.simpson(power, x=wavelength_m) / 1.0165**2
    response = np.interp(
        wavelength_m, lab.camera.band.wavelength_m, lab.camera.band.response, left=0, right=0
    )
    electrons = integrate.simpson(
        power * wavelength_m / 1.98644586e-25 * response, x=wavelength_m
    )
    pst = 10 ** (-3 - 4 * (angle_deg - 20) / 30)
    expected = electrons * pst * lab.scene.camera.pixel_m**2
    assert stray_of(lab)["the Sun"] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("phase_deg", [0.0, 70.0, 130.0])
def test_the_stray_light_of_a_distant_earth_is_that_of_a_lambert_sphere(
    sphere: None, phase_deg: float
) -> None:
    """E PST (2/3) a (R / d)^2 (sin p + (pi - p) cos p) / pi; the airglow is negligible."""
    phase = np.radians(phase_deg)
    far = 1000.0
    sun_m = 1.5e11 * np.array([np.sin(phase), 0.0, np.cos(phase)])
    place_m = np.array([0.0, 0.0, far * EARTH_RADIUS_M])
    light = stray_around_e_s_m2(
        EVEN, *earth_around(DARK_EARTH, place_m, sun_m, BAND), np.array([1.0, 0.0, 0.0])
    )
    law = (np.sin(phase) + (np.pi - phase) * np.cos(phase)) / np.pi
    assert light == pytest.approx(IRRADIANCE * 1e-4 * 0.3 * 2 / 3 / far**2 * law, rel=0.004)


@pytest.mark.parametrize(
    ("sun_deg", "boresight_deg"), [(40.0, 20.0), (90.0, 60.0), (100.0, -30.0), (0.0, -80.0)]
)
def test_the_stray_light_of_a_near_earth_is_that_of_its_ground(
    sphere: None, sun_deg: float, boresight_deg: float
) -> None:
    """From 700 km: the sum over patches dA of the ground, (a E mu0 / pi) cos(e) dA / d^2 PST, in place of directions.

    sun_deg : from the zenith;  boresight_deg : above the horizontal plane
    """
    place_m = np.array([0.0, 0.0, EARTH_RADIUS_M + 700e3])
    sun = np.radians(sun_deg)
    up = np.radians(boresight_deg)
    sun_m = 1.5e11 * np.array([np.sin(sun), 0.0, np.cos(sun)])
    boresight = np.array([0.0, np.cos(up), np.sin(up)])
    edge = np.arccos(EARTH_RADIUS_M / place_m[2])
    colatitude, longitude = (
        part.ravel() for part in np.meshgrid((np.arange(600) + 0.5) * edge / 600, steps(600))
    )
    normal = np.column_stack(
        [
            *(np.sin(colatitude) * np.array([np.cos(longitude), np.sin(longitude)])),
            np.cos(colatitude),
        ]
    )
    area_m2 = EARTH_RADIUS_M**2 * np.sin(colatitude) * (edge / 600) * (2 * np.pi / 600)
    toward = EARTH_RADIUS_M * normal - place_m
    d_m = np.linalg.norm(toward, axis=1)
    emission = -np.sum(toward * normal, axis=1) / d_m
    through = 10 ** np.interp(
        np.degrees(np.arccos(toward @ boresight / d_m)), STEEP.angle_deg, np.log10(STEEP.pst)
    )
    radiance = (
        0.3 * IRRADIANCE / np.pi * np.maximum(normal @ sun_m / np.linalg.norm(sun_m), 0)
    )
    expected = np.sum(radiance * emission * area_m2 / d_m**2 * through)
    light = stray_around_e_s_m2(
        STEEP, *earth_around(DARK_EARTH, place_m, sun_m, BAND), boresight
    )
    assert light == pytest.approx(expected, rel=0.006)


def steps(count: int) -> Floats:
    """Centers of equal steps around a circle."""
    return (np.arange(count) + 0.5) * 2 * np.pi / count


def test_the_quadrature_over_a_cone_is_exact_for_its_solid_angle() -> None:
    directions, weights = earth_glow.cone_rule(0.4, 0.3)
    assert weights.sum() == pytest.approx(2 * np.pi * 0.7)
    assert (weights @ directions) == pytest.approx([0, 0, np.pi * (1 - 0.3**2)], abs=1e-12)


def test_a_frame_has_the_stray_light_in_every_pixel() -> None:
    keys = {
        "light__bodies": "{planets: false}",
        "camera__detector__noise": "false",
        "light__limit_mag": "0",
    }
    lit = in_space(90.0, -5.0, **keys)
    e_s = sum(stray_of(lit, lit.scene.exposure.time_s / 2).values())
    dark = in_space(90.0, -5.0, **keys, camera__baffle="null")
    bright_dn, dark_dn = (
        render_at_rest(lab.camera, lab.start)[0].image_dn for lab in (lit, dark)
    )
    detector = lit.scene.camera.detector
    assert np.median(bright_dn - dark_dn) == pytest.approx(
        e_s * lit.scene.exposure.time_s / detector.gain_e_dn, rel=1e-3
    )
    assert e_s > 1


@pytest.mark.slow
def test_stray_light_follows_orbit_and_date() -> None:
    """The Sun gives none behind the Earth; the Earth's light is strongest over the day side; both depend on season."""
    lab = in_space(90.0, 60.0, light__bodies="{}", orbit=ORBIT)
    around = [stray_of(lab, t_s) for t_s in range(0, 5670, 210)]
    assert 0.55 < np.mean(["the Sun" in one for one in around]) < 1
    earth = np.array([one["the Earth"] for one in around])
    assert earth.max() > 100 * earth.min()
    winter = in_space(90.0, 60.0, light__bodies="{}", start_time="2012-12-24T21:00:00")
    summer = in_space(90.0, 60.0, light__bodies="{}")
    assert stray_of(summer)["the Sun"] > 100 * stray_of(winter)["the Sun"]


def test_a_body_below_the_skyline_gives_no_stray_light() -> None:
    site = {
        "site": "{latitude_deg: 53, longitude_deg: 9}",
        "light__air": "{}",
        "light__bodies": "{planets: false}",
    }
    lab = in_space(250.0, 60.0, **site, start_time="2012-06-24T23:00:00")
    assert "the Sun" not in stray_of(lab)
    assert stray_of(lab, 12 * 3600.0)["the Sun"] > 0


def test_without_a_body_there_is_no_stray_light() -> None:
    assert stray_of_bodies_e_s_m2(STEEP, [], np.array([0.0, 0.0, 1.0])) == {}
    assert stray_of(in_space(90.0, 0.0, light__bodies="{}", camera__baffle="null")) == {}
