"""AFIT's test stand for LEDs: frames at fixed attitudes, with lights measured as in the thesis (Padro 2012)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude import nearfield
from estimator.calibration.home_position import instrument_brightness
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import FramePriors
from estimator.detection import detect
from skysim.camera.optics import Optics
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, Frame, Truth
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab
from skysim.simulation.lights.light import LightPlan
from skysim.simulation.lights.registry import build_lights
from skysim.tracking import onboard_model

WHITE = 255  # white in the thesis's gray levels
E_PER_GRAY = 40000 / WHITE  # electrons per gray level: the camera's full well is white


class MeasuredLights(NamedTuple):
    """Measured lights of a frame, (N, ...), in descending order of instrument magnitude (larger is brighter)."""

    xy_px: Floats
    area_px: Floats
    mean_dn: Floats
    magnitude: Floats


# Lab of Test 1, whose vehicle and detector all AFIT scenes share.
base_lab = cache(lambda: build_lab(load("afit_test1_ideal")))


def build_test_stand(scene: Scene) -> Lab:
    """Lab of a scene with other lights, lens or electronics; the detector's fixed pattern is computed only once."""
    lab = base_lab()
    assert isinstance(scene.light, DomeConfig)
    plan = LightPlan(scene, lab.camera.band, lab.vehicle, lab.camera.viewpoint, None)
    return lab.with_scene(scene).with_camera(
        lights=build_lights(plan),
        optics=Optics.from_camera(scene.camera),
        detector=replace(lab.camera.detector, config=scene.camera.detector),
    )


def render_at_attitude(
    lab: Lab, lab_from_body: Rotation, rng: np.random.Generator
) -> tuple[Frame, Truth]:
    """Render a frame at a fixed attitude, in a run of its own: the phase of the LEDs' cycle is random."""
    return render_at_rest(lab.in_run(int(rng.integers(2**62))).camera, lab_from_body)


def gray_levels(frame: Frame, lab: Lab) -> NDArray[np.uint8]:
    """The frame in 8-bit gray levels, as in the thesis's MATLAB code: 0 is black, 255 a full well."""
    config = lab.scene.camera.detector
    level = (frame.image_dn - config.offset_dn) * (config.gain_e_dn / E_PER_GRAY)
    return np.clip(np.rint(level), 0, WHITE).astype(np.uint8)


def measure_lights(image: NDArray[np.uint8]) -> MeasuredLights:
    """Lights of at least 50 px above a threshold of 4 %, with instrument magnitudes (sections 3.4.1.3 and 3.6.2.1)."""
    try:
        blobs = detect.thesis(image.astype(np.uint16), priors=FramePriors(saturation=WHITE))
    except ImageError:
        return MeasuredLights(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))
    mean_dn = blobs.flux / blobs.area_px + float(blobs.background.level[0, 0])
    area_px = blobs.area_px.astype(float)
    magnitude = instrument_brightness(mean_dn, area_px) if len(blobs) else mean_dn
    order = np.argsort(-magnitude, kind="stable")
    return MeasuredLights(
        blobs.xy_px[order], area_px[order], mean_dn[order], magnitude[order]
    )


def measure_frame(
    lab: Lab, lab_from_body: Rotation, rng: np.random.Generator
) -> MeasuredLights:
    """Lights of a frame rendered at a fixed attitude."""
    return measure_lights(gray_levels(render_at_attitude(lab, lab_from_body, rng)[0], lab))


def light_positions_m(lab: Lab, xy_px: Floats, camera: Camera | None = None) -> Floats:
    """(N, 3) positions of lights in body axes, by eqs 43-44 and the camera's lever arm.

    Parameters
    ----------
    camera
        Camera model to use; the tracker's own if left out
    """
    assert isinstance(lab.scene.light, DomeConfig)
    leds = onboard_model.assumed_dome(lab.scene, lab.scene.light, lab.camera.sources)
    lever = onboard_model.assumed_lever(lab.scene, lab.camera.mount)
    rays = (camera or onboard_model.assumed_camera(lab.scene)).rays(xy_px)
    points_m, _ = nearfield.thesis_points(rays, leds, lever)
    return lever.cam_from_body.inv().apply(points_m) + lever.camera_body_m


def pair_angles_arcsec(vectors: Floats) -> Floats:
    """(..., N (N - 1) / 2) angle of every pair of (..., N, 3) vectors, in the order of np.triu_indices.

    2 arcsin(chord / 2), which is accurate for small angles, unlike arccos of the dot product.
    """
    directions = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    a, b = np.triu_indices(directions.shape[-2], 1)
    chord = np.linalg.norm(directions[..., a, :] - directions[..., b, :], axis=-1)
    return 2 * np.arcsin(chord / 2) / ARCSEC_RAD


def separations_arcsec(xy_px: Floats, lab: Lab, camera: Camera | None = None) -> Floats:
    """(N (N - 1) / 2,) angles about the bearing of all pairs of (N, 2) pixels, by eqs 43-45."""
    return pair_angles_arcsec(light_positions_m(lab, xy_px, camera))
