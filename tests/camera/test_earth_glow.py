"""The Earth's light in an orbit: Lambert's sphere, the airglow's layer and the place of the limb."""

from __future__ import annotations

import numpy as np
import pytest

from skysim.camera.glow import earth_glow
from skysim.camera.glow.earth_glow import LAYER, earth_radiance
from skysim.core.constants import EARTH_RADIUS_M, SUN_V_MAG
from skysim.scene import loader
from skysim.scene.sections.surroundings import EarthConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import build_lab
from skysim.sources.photometry import SUN, Band, sky_radiance_e_s_m2_sr, star_flux_e_s_m2

BAND = Band.from_efficiency("interline")
IRRADIANCE = float(star_flux_e_s_m2(SUN_V_MAG, *SUN, BAND))
DARK = 30.0  # mag arcsec^-2


@pytest.fixture
def sphere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(earth_glow, "TO_SPHERE", np.full(3, 1 / EARTH_RADIUS_M))


@pytest.mark.parametrize("phase_deg", [0.0, 60.0, 120.0])
def test_the_earth_disc_s_light_is_that_of_a_lambert_sphere(
    sphere: None, phase_deg: float
) -> None:
    """From far away: E (2/3) a (R / d)^2 (sin p + (pi - p) cos p) / pi; the air adds 2 H / R or a little more."""
    far_m = 200 * EARTH_RADIUS_M
    phase = np.radians(phase_deg)
    edge = np.arcsin(1.02 / 200)
    axis = (np.arange(400) + 0.5) / 200 - 1
    x, y = (part.ravel() * edge for part in np.meshgrid(axis, axis))
    toward = np.column_stack([x, y, -np.ones_like(x)])
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    sun = 1.5e11 * np.array([np.sin(phase), 0.0, np.cos(phase)])
    place = np.array([0.0, 0.0, far_m])
    light = earth_radiance(
        EarthConfig(albedo=0.3, airglow_mag_arcsec2=DARK), place, toward, sun, BAND
    )
    total = light.sum() * (edge / 200) ** 2
    expected = (
        IRRADIANCE
        * 0.3
        * 2
        / 3
        / 200**2
        * (np.sin(phase) + (np.pi - phase) * np.cos(phase))
        / np.pi
    )
    assert total == pytest.approx(expected, rel=0.006)


def test_the_airglow_is_brightest_at_the_bottom_of_its_layer(sphere: None) -> None:
    place = np.array([0.0, 0.0, 1.1 * EARTH_RADIUS_M])
    night = np.array([0.0, 0.0, -1.5e11])
    impact = np.array([0.0, *LAYER, 1.05])
    nadir = np.arcsin(impact / 1.1)
    toward = np.column_stack([np.sin(nadir), np.zeros(4), -np.cos(nadir)])
    light = earth_radiance(EarthConfig(airglow_mag_arcsec2=21.0), place, toward, night, BAND)
    light /= float(sky_radiance_e_s_m2_sr(21.0, BAND))
    bottom, top = LAYER
    assert light == pytest.approx(
        [1, 2 * np.sqrt(top**2 - bottom**2) / (top - bottom), 0, 0], abs=1e-4
    )
    assert light[1] == pytest.approx(72, rel=0.01)


def test_the_limb_is_at_its_geometric_dip() -> None:
    """From 500 km above the equator, looking 2 degrees above the horizon ahead: the ground's edge is so far off."""
    dip_deg = np.degrees(np.arccos(EARTH_RADIUS_M / (EARTH_RADIUS_M + 500e3)))
    keys = {
        "orbit": "{kind: circular, altitude: 500 km, inclination_deg: 0, argument_deg: 0, earth: {albedo: 0.3}}",
        "motion.start": f"{{ra_deg: {90 + dip_deg - 2:.9f}, dec_deg: 0, roll_deg: 90}}",
        "light.limit_mag": "0",
        "camera.detector.noise": "false",
        "exposure.frames": "1",
        "exposure.time": "10 us",
        "background": "[]",
    }
    lab = build_lab(loader.load("shefex2", keys | {"start_time": "2012-06-22T09:00:00"}))
    frame, _ = render_at_rest(lab.camera, lab.start)
    camera = lab.scene.camera
    image = frame.image_dn
    middle = image[:, round(camera.center_px[0])] - image.min()
    assert middle.max() > 0
    rows = np.flatnonzero(middle > middle.max() / 2)
    edge_px = min(
        abs(row - camera.center_px[1])
        for row in (rows[0], rows[-1])
        if 0 < row < len(middle) - 1
    )
    off_deg = np.degrees(np.arctan(edge_px / camera.focal_px))
    assert off_deg == pytest.approx(2.0, abs=0.25)  # the air blurs it by 8 km, 0.2 degrees
