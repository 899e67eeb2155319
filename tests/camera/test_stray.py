"""Glow of the dome's wall, ghosts and veiling glare of the lens, against their laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.camera.glow.background import PointedCamera, even_grid_px
from skysim.camera.glow.stray import add_glare, block_px, wall_glow
from skysim.camera.optics import Optics
from skysim.core.types import Frame, Sources, Truth
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig, GlareConfig
from skysim.scene.sections.leds import CosineLobeConfig
from skysim.scene.sections.light import ReflectionConfig
from skysim.simulation.flight import simulate_motion
from skysim.simulation.lab import build_lab
from skysim.sources.dome.interreflection import ReflectingDome, diffuse_light, spiral
from skysim.sources.dome.surface import Ellipsoid
from skysim.sources.photometry import Band
from skysim.sources.satellites import GHOST, MIRRORED

CAMERA = {
    "width_px": 400,
    "height_px": 300,
    "pixel": "10 um",
    "focal_length": "4 mm",
    "f_number": 2,
    "transmission": 0.8,
    "detector": {
        "quantum_efficiency": 0.5,
        "full_well_e": 40000,
        "gain_e_dn": 10,
        "bits": 12,
    },
}


@pytest.mark.slow
def test_the_glow_of_a_uniform_sphere_matches_theory() -> None:
    """Radiance rho E / pi with E = P / (A (1 - rho)), and the cos^4 law; wherever the camera is and looks."""
    wall = Ellipsoid(np.zeros(3), semi_axes_m=np.full(3, 2.0))
    share = 0.6
    count = 30
    place = wall.meet(np.zeros(3), spiral(count))
    ones = np.ones(count)
    rows = np.arange(count)
    leds = Sources(
        rows,
        np.column_stack([place, ones]),
        wall.inward(place),
        ones,
        ones,
        ones,
        0 * ones,
        ones,
        rows,
        ones,
    )
    config = ReflectionConfig(diffuse=share)
    dome = ReflectingDome(config, wall, diffuse_light(config, wall, leds, CosineLobeConfig()))
    optics = Optics.from_camera(CameraConfig.model_validate(CAMERA))
    turned = Rotation.from_euler("xyz", [0.4, -1.1, 2.0])
    camera_m = np.array([0.3, -0.5, 0.2])
    camera = PointedCamera(optics, turned, camera_m, Band.from_efficiency(0.5))
    glow = wall_glow(dome, camera)
    shape = camera.nodes().shape
    xy_px = even_grid_px(optics.camera, *shape[::-1])
    radius = np.linalg.norm(xy_px - optics.camera.center_px, axis=1) / optics.camera.focal_px
    radiance = share * count * math.pi / (16 * math.pi) / (1 - share) / math.pi
    expected = (
        radiance
        * optics.collecting_m2
        * np.cos(np.arctan(radius)) ** 4
        / optics.camera.focal_px**2
    )
    np.testing.assert_allclose(glow, expected.reshape(shape), rtol=1e-4)


DEEP = {
    "light.surface": "{kind: sphere, apex: 5 ft, radius: 4 ft, rim_deg: 130}",
    "light.reflection": "{specular: 0.5}",
    "camera.detector.noise": "false",
    "exposure.frames": "1",
}


@pytest.mark.slow
def test_reflections_are_in_the_frame_and_its_truth() -> None:
    """In a deep dome reflections are drawn at their true positions, and nothing else changes."""
    black, _ = frame(
        "apl_dome", {key: value for key, value in DEEP.items() if key != "light.reflection"}
    )
    shiny, truth = frame("apl_dome", DEEP)
    gained = shiny.image_dn - black.image_dn
    lights = truth.sources
    false = lights.id > MIRRORED
    assert false.sum() >= 5
    assert set(lights.id[false] % MIRRORED) <= set(
        build_lab(loader.load("apl_dome", DEEP)).camera.sources.id
    )
    gain = loader.load("apl_dome").camera.detector.gain_e_dn
    assert gained.sum() * gain == pytest.approx(lights.electrons[false].sum(), rel=2e-3)
    for n in np.flatnonzero(false):
        x, y = lights.peak_xy[n]
        assert gained[y, x] * gain == pytest.approx(lights.peak_e[n], rel=0.05)


def frame(scene: str, settings: dict[str, str]) -> tuple[Frame, Truth]:
    """The first frame of a scene."""
    return simulate_motion(loader.load(scene, settings)).render(0)


SKY = {"camera.detector.noise": "false", "exposure.frames": "1", "camera.detector.prnu": "0"}


@pytest.mark.slow
@pytest.mark.parametrize("magnification", [0.4, -0.7, 1.5])
def test_ghosts_are_mirrored_through_the_axis(magnification: float) -> None:
    """At c - m (x - c), with a share of the light; every star's, and those of stars beside the chip."""
    share = 0.02
    ghost = f"[{{magnification: {magnification}, share: {share}, radius_px: 6}}]"
    clear, _ = frame("shefex2", SKY)
    haunted, truth = frame("shefex2", SKY | {"camera.ghosts": ghost})
    lights = truth.sources
    camera = loader.load("shefex2").camera
    is_ghost = lights.id > GHOST
    center = np.array(camera.center_px)
    size = np.array([camera.width_px, camera.height_px])
    own = {int(id): n for n, id in enumerate(lights.id[~is_ghost])}
    inside = np.all((lights.xy_px > 15) & (lights.xy_px < size - 15), axis=1)
    checked = 0
    for n in np.flatnonzero(is_ghost & inside):
        star = own.get(int(lights.id[n] % GHOST))
        if star is None or not inside[star]:
            continue
        expected = center - magnification * (lights.xy_px[star] - center)
        np.testing.assert_allclose(lights.xy_px[n], expected, atol=1e-9)
        assert lights.electrons[n] == pytest.approx(share * lights.electrons[star], rel=1e-3)
        checked += 1
    assert checked > 3
    if abs(magnification) < 1:
        assert set(lights.id[is_ghost] % GHOST) > set(own)  # of stars beside the chip too
    gained = (haunted.image_dn - clear.image_dn).sum() * camera.detector.gain_e_dn
    assert gained == pytest.approx(lights.electrons[is_ghost].sum(), rel=1e-3)


GLARE = GlareConfig(share=0.1, exponent=3.0, core_px=16.0)


def test_glare_conserves_light() -> None:
    light = np.random.default_rng(3).exponential(50.0, (240, 400))
    total = light.sum()
    add_glare(light, GLARE)
    assert light.sum() == pytest.approx(total, rel=1e-12)


def test_glare_leaves_uniform_light_uniform() -> None:
    light = np.full((240, 400), 7.0)
    add_glare(light, GLARE)
    np.testing.assert_allclose(light, 7.0, rtol=1e-12)


@pytest.mark.parametrize(
    "config",
    [GLARE, GlareConfig(share=0.02, exponent=2.4, core_px=9.0)],
    ids=["steep", "flat"],
)
def test_the_glare_of_a_point_matches_its_profile(config: GlareConfig) -> None:
    """The share left in the image, and the law of the power around it, with the mirrored field beside the chip."""
    side = block_px((256, 320), config.core_px)
    light = np.zeros((256, 320))
    (x, y) = np.array([140, 130]) + (side - 1) / 2
    light[130 : 130 + side, 140 : 140 + side] = 1 / side**2
    add_glare(light, config)
    assert light[130, 140] == pytest.approx((1 - config.share) / side**2, rel=1e-3)

    def law(dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
        shape = (1 + (dx**2 + dy**2) / config.core_px**2) ** (-config.exponent / 2)
        return np.asarray(
            config.share * (config.exponent - 2) / (2 * math.pi * config.core_px**2) * shape
        )

    places = np.arange(-60, 61)
    mirrored_x = np.concatenate([640 * places + x, 640 * places - 1 - x])
    mirrored_y = np.concatenate([512 * places + y, 512 * places - 1 - y])
    # Beyond the sum the mirrored lights are even: the integral of the law there, over the chip.
    beyond = config.share * (60 * 576 / config.core_px) ** (2 - config.exponent) / light.size
    for px, py in [(160, 130), (140, 190), (60, 60), (250, 30), (5, 250)]:
        total = law(*np.meshgrid(px - mirrored_x, py - mirrored_y)).sum()
        assert light[py, px] == pytest.approx(total + beyond, rel=0.03)
