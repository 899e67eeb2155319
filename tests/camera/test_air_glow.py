"""The sky's glow over a site: airglow, twilight and moonlight against published measurements and geometry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.camera.glow.background import (
    NANOLAMBERT_V0,
    PointedCamera,
    diffuse_air_mass,
    glow_map,
)
from skysim.camera.glow.earth_glow import airglow_nl, seen_place, sunlight_nl
from skysim.core.types import Floats
from skysim.scene.loader import load
from skysim.scene.sections.surroundings import AirGlowConfig, SkyGlowConfig
from skysim.simulation.exposure import expected_exposure
from skysim.simulation.lab import Lab, build_lab
from skysim.simulation.lights.effects import AirEffects, AirGlow
from skysim.simulation.lights.light import find_light
from skysim.sources.air import Sky

SITE = "{latitude_deg: 53.1, longitude_deg: 8.8, height: 10 m}"


def lab_of(time: str, **glow: str) -> Lab:
    keys = {"start_time": time, "site": SITE, "light.air.glow.twilight": "true"}
    return build_lab(
        load("shefex2", keys | {f"light.air.{key}": value for key, value in glow.items()})
    )


def mag_arcsec2(nanolamberts: float) -> float:
    return float(-2.5 * np.log10(nanolamberts / NANOLAMBERT_V0))


def test_airglow_is_proportional_to_the_path_through_its_shell() -> None:
    """The path through a thin shell 131 km above a sphere, by the geometry of two spheres."""
    zenith = np.radians(np.linspace(0, 85, 50))
    inner = 6371.0
    outer = 6371.0 / np.sqrt(0.96)

    def path_km(z: np.ndarray, r: float) -> np.ndarray:
        return np.sqrt(r**2 - (inner * np.sin(z)) ** 2) - inner * np.cos(z)

    thin = (path_km(zenith, outer + 0.01) - path_km(zenith, outer)) / 0.01
    np.testing.assert_allclose(diffuse_air_mass(zenith), thin, rtol=1e-4)
    dark = airglow_nl(21.7, zenith, 0.0)
    assert mag_arcsec2(float(dark[0])) == pytest.approx(21.7, abs=1e-9)
    assert (np.diff(dark) > 0).all()
    assert airglow_nl(21.7, zenith, 0.3)[-1] < dark[-1] * 10 ** (-0.4 * 0.3 * 2)


def test_the_dark_sky_is_paranal_s() -> None:
    """Patat 2003, A&A 400, 1183: V 21.61 +- 0.20 at the zenith, and by his equation C.3 as 0.4 + 0.6 X below it.

    Without extinction. Taking all light as airglow is 0.23 mag too bright at a zenith distance of 60 deg.
    """
    assert AirGlowConfig().dark_mag_arcsec2 == pytest.approx(21.61, abs=0.20)
    zenith = np.radians([0.0, 30.0, 45.0, 60.0])
    masses = (1 - 0.96 * np.sin(zenith) ** 2) ** -0.5
    patat = 21.7 - 2.5 * np.log10(0.4 + 0.6 * masses)
    found = [mag_arcsec2(float(each)) for each in airglow_nl(21.7, zenith, 0.0)]
    np.testing.assert_allclose(patat - found, [0.0, 0.05, 0.13, 0.23], atol=0.015)


def test_airglow_is_van_rhijn_s_at_leinert_s_height() -> None:
    """Leinert et al. 1998, A&AS 127, 1, section 4: a layer at 100 km; 2 % fainter here to 60 deg, 7 % to 80 deg."""
    for zenith_deg, part in ((30.0, 0.003), (60.0, 0.02), (80.0, 0.08)):
        sine = 6371 / 6471 * np.sin(np.radians(zenith_deg))
        layer = (1 - sine**2) ** -0.5
        assert float(diffuse_air_mass(np.radians(zenith_deg))) == pytest.approx(
            layer, rel=part
        )


def test_twilight_at_the_zenith_matches_paranal() -> None:
    """Patat, Ugolnikov & Postylyakov (2006), A&A 455, 385: V = 11.84 + 1.518 x - 0.057 x^2, x = depression - 5.

    Measured over 5 to 12 degrees, before the night's own light matters, where the air takes 0.13 mag. Schaefer's law,
    a magnitude for each degree, is fainter at first.
    """
    for depression, tolerance_mag in (
        (5.0, 1.2),
        (6.0, 0.8),
        (8.0, 0.2),
        (10.0, 0.1),
        (12.0, 0.4),
    ):
        x = depression - 5
        measured = 11.84 + 1.518 * x - 0.057 * x**2
        ours = mag_arcsec2(
            float(sunlight_nl(np.array([90 + depression]), -depression, np.zeros(1), 0.13)[0])
        )
        assert ours == pytest.approx(measured, abs=tolerance_mag)


def test_daylight_has_its_published_brightness() -> None:
    """A clear sky has some 5,000 cd m^-2 near the Sun and 2,000 far from it; 10.8e4 cd m^-2 are 0 mag arcsec^-2."""
    day = sunlight_nl(np.array([20.0, 60.0, 90.0]), 45.0, np.full(3, 45.0), 0.172)
    assert (np.diff(day) < 0).all()
    luminance = 10.8e4 * 10 ** (-0.4 * np.array([mag_arcsec2(one) for one in day]))
    assert 3000 < luminance[0] < 9000
    assert 1000 < luminance[2] < 3000
    falling = [
        float(sunlight_nl(np.array([90.0]), h, np.array([45.0]), 0.172)[0])
        for h in (5, 0, -3, -6, -12, -18)
    ]
    assert (np.diff(falling) < 0).all()


@pytest.mark.slow
def test_the_moon_lights_the_sky_only_above_the_horizon() -> None:
    full_up = "2012-06-03T23:00:00"
    full_down = "2012-06-04T10:00:00"
    mean = {}
    for name, time in (("up", full_up), ("down", full_down)):
        for moonlight in ("true", "false"):
            lab = lab_of(time, **{"glow.moonlight": moonlight, "glow.twilight": "false"})
            sky = sky_of(lab)
            moon = sky.altitude_rad(seen_place("moon", sky).direction[None])[0]
            assert (moon > 0) == (name == "up")
            pointing = up_pointing(lab)
            mean[name, moonlight] = float(glow_toward(lab, pointing).mean())
    assert mean["up", "true"] > 3 * mean["up", "false"]
    assert mean["down", "true"] == mean["down", "false"]


def sky_of(lab: Lab) -> Sky:
    """The air at the scene's start."""
    atmosphere = find_light(lab.camera.lights, AirEffects)
    assert atmosphere is not None
    return atmosphere.air.at(lab.scene.start_time)


def glow_toward(lab: Lab, cam_from_lab: Rotation) -> Floats:
    """The glow at the nodes of a camera at the scene's start."""
    air_glow = find_light(lab.camera.lights, AirGlow)
    assert air_glow is not None
    lab_from_body = cam_from_lab.inv() * lab.camera.mount.cam_from_body
    exposure = expected_exposure(lab.camera, lab_from_body, np.zeros(3), 0.0)
    return air_glow.during(exposure).glow()


def up_pointing(lab: Lab) -> Rotation:
    """cam_from_icrs of a camera that looks at the zenith."""
    sky = sky_of(lab)
    north, east, up = sky.axes
    return Rotation.from_matrix(np.stack([-east, -north, up]))


def test_below_the_skyline_there_is_no_glow() -> None:
    lab = lab_of("2012-06-24T23:00:00")
    sky = sky_of(lab)
    north, east, up = sky.axes
    level = Rotation.from_matrix(np.stack([east, -up, north]))  # looks north along the ground
    glow = glow_toward(lab, level)
    half = len(glow) // 2
    assert (glow[:half] > 0).all()
    assert not glow[half + 1 :].any()
    assert (np.diff(glow[: half - 1].mean(axis=1)) != 0).all()


def test_the_dark_glow_is_that_of_the_declared_sky() -> None:
    """At the zenith, moonless and at night: as a background of kind sky of the same magnitude."""
    lab = lab_of(
        "2012-12-13T23:00:00", **{"glow.dark_mag_arcsec2": "21", "extinction_mag": "0"}
    )
    ours = glow_toward(lab, up_pointing(lab))
    sky_glow = SkyGlowConfig(kind="sky", mag_arcsec2=21)
    even = glow_map(
        (sky_glow,),
        PointedCamera(lab.camera.optics, up_pointing(lab), np.zeros(3), lab.camera.band),
    )
    center = tuple(size // 2 for size in ours.shape)
    assert ours[center] == pytest.approx(even[center], rel=2e-3)
