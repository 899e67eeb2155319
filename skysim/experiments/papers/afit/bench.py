"""AFIT's test stand for LEDs: frames at fixed attitudes, with lights measured as in the thesis (Padro 2012)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude import nearfield
from estimator.calibration.home_position import instrument_magnitude
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import FramePriors
from estimator.detection import detect
from skysim.camera.optics import Optics
from skysim.core.types import Floats, Frame, Trajectory, Truth
from skysim.core.units import ARCSEC_RAD
from skysim.scene.light import DomeConfig
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.simulation import exposure, testbed
from skysim.simulation.testbed import Testbed
from skysim.sources.dome.led import Emitter
from skysim.tracking import onboard_model

FULL = 255  # white in the thesis's gray levels
GREY_E = 40000 / FULL  # electrons per gray level: the camera's full well is white
MOST_PHASE_S = 1.0  # the exposure starts at a random time within this


class Lights(NamedTuple):
    """Measured lights of a frame, (N, ...), in descending order of instrument magnitude (larger is brighter)."""

    xy_px: Floats
    area_px: Floats
    mean_dn: Floats
    magnitude: Floats


def changed(scene: Scene, part: str, **told: Any) -> Scene:
    """Copy a scene with values of a section changed, without validation; `part` may have two parts, as `light.led`."""
    head, _, rest = part.partition(".")
    if rest:
        inner = getattr(scene, head)
        return scene.model_copy(
            update={head: inner.model_copy(update={rest: getattr(inner, rest).model_copy(update=told)})}
        )
    return scene.model_copy(update={head: getattr(scene, head).model_copy(update=told)})


@cache
def bare() -> Testbed:
    """A testbed of AFIT's, kept for its vehicle and detector, which all AFIT scenes share."""
    return testbed.build_testbed(load("afit_test1"))


def furnished(scene: Scene) -> Testbed:
    """Testbed of a scene with other lights, lens or electronics; the detector's fixed pattern is computed only once."""
    lab = bare()
    assert isinstance(scene.light, DomeConfig)
    return replace(
        lab,
        scene=scene,
        sources=testbed.light_sources(scene, lab.band),
        emitter=Emitter.of(scene.light.led),
        optics=Optics.of(scene.camera),
        chip=replace(lab.chip, part=scene.camera.detector),
        obstacles=testbed.obstacles(scene, lab.ship),
    )


def shot(lab: Testbed, lab_from_body: Rotation, rng: np.random.Generator) -> tuple[Frame, Truth]:
    """Render a frame at a fixed attitude, started at a random time of the LEDs' cycle."""
    scene = changed(lab.scene, "exposure", first_s=rng.uniform(0, MOST_PHASE_S))
    scene = scene.model_copy(update={"seed": int(rng.integers(2**62))})
    path = Trajectory.at_rest(lab_from_body, MOST_PHASE_S + scene.exposure.time_s + 1)
    return exposure.render_frame(replace(lab, scene=scene, trajectory=path), 0)


def grey(frame: Frame, lab: Testbed) -> NDArray[np.uint8]:
    """The frame in 8-bit gray levels, as in the thesis's MATLAB code: 0 is black, 255 a full well."""
    part = lab.scene.camera.detector
    level = (frame.image_dn - part.offset_dn) * (part.gain_e_dn / GREY_E)
    return np.clip(np.rint(level), 0, FULL).astype(np.uint8)


def measured(image: NDArray[np.uint8]) -> Lights:
    """Lights of at least 50 px above a threshold of 4 %, with instrument magnitudes (sections 3.4.1.3 and 3.6.2.1)."""
    try:
        blobs = detect.thesis(image.astype(np.uint16), hints=FramePriors(saturation=FULL))
    except ImageError:
        return Lights(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0))
    mean_dn = blobs.flux / blobs.area_px + float(blobs.background.level[0, 0])
    area_px = blobs.area_px.astype(float)
    magnitude = instrument_magnitude(mean_dn, area_px) if len(blobs) else mean_dn
    order = np.argsort(-magnitude, kind="stable")
    return Lights(blobs.xy_px[order], area_px[order], mean_dn[order], magnitude[order])


def vectors_m(lab: Testbed, xy_px: Floats, camera: Camera | None = None) -> Floats:
    """(N, 3) positions of lights in body axes, by eqs 43-44 and the camera's lever arm.

    camera : camera model to use; the tracker's own if left out
    """
    assert isinstance(lab.scene.light, DomeConfig)
    leds = onboard_model.believed_dome(lab.scene, lab.scene.light, lab.sources)
    lever = onboard_model.believed_lever(lab.scene, lab.mount)
    points, _ = nearfield.thesis_points(
        (camera or onboard_model.believed_camera(lab.scene)).rays(xy_px), leds, lever
    )
    return lever.cam_from_body.inv().apply(points) + lever.camera_body_m


def pair_angles_arcsec(vectors: Floats) -> Floats:
    """(..., N (N - 1) / 2) angle of every pair of (..., N, 3) vectors, in the order of np.triu_indices.

    2 arcsin(chord / 2), which is accurate for small angles, unlike arccos of the dot product.
    """
    unit = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    a, b = np.triu_indices(unit.shape[-2], 1)
    chord = np.linalg.norm(unit[..., a, :] - unit[..., b, :], axis=-1)
    return np.asarray(2 * np.arcsin(chord / 2) / ARCSEC_RAD)


def separations_arcsec(xy_px: Floats, lab: Testbed, camera: Camera | None = None) -> Floats:
    """(N (N - 1) / 2,) angles about the bearing of all pairs of (N, 2) pixels, by eqs 43-45."""
    return pair_angles_arcsec(vectors_m(lab, xy_px, camera))
