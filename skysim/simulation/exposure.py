"""Render one frame with its truth.

The order is that of the light: background and display glow, the sources integrated along their paths
(camera/render.py), charge smear of the shutter, then the detector (camera/detector).
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.trackers.pipeline import Clock
from skysim.camera import background, display_glow
from skysim.camera.detector.detector import add_snr_and_saturation, expose, saturation_dn, smear
from skysim.camera.render import Poses, in_view, look, render
from skysim.core.types import Frame, Truth
from skysim.dynamics import multibody
from skysim.simulation.random_streams import rng
from skysim.simulation.testbed import Testbed, window


def render_frame(
    lab: Testbed, index: int, clock: Clock | None = None, exposure_s: float | None = None
) -> tuple[Frame, Truth]:
    """Render one frame and its truth, both for mid-exposure of the middle row.

    They depend only on the test bed, the index and the exposure time (the scene's if left out), not on other frames.
    """
    clock = clock or Clock()
    scene, camera = lab.scene, lab.scene.camera
    when = window(scene, index, exposure_s)
    middle_s = when.middle_s(camera.height_px)
    lab_from_body = lab.trajectory.at(middle_s)
    cam_from_lab = lab.mount.cam_from_body * lab_from_body.inv()
    light_e = lab.canvas
    # The canvas is reused for every frame: the background overwrites it, all else is added to it.
    glow = background.glow_map(scene.background, lab.optics, cam_from_lab, lab.band)
    background.fill(light_e, glow, when.exposure_s)
    camera_m = lab_from_body.apply(lab.mount.camera_body_m)
    black = display_glow.black_glow(scene.light, lab.optics, cam_from_lab, camera_m, lab.band)
    if black is not None:
        light_e += black * when.exposure_s
    hides = partial(multibody.hidden, lab.obstacles, lab_from_body) if lab.obstacles else None
    seen = render(light_e, lab.sources, lab.optics, lab.trajectory, lab.mount, when, lab.emitter, hides)
    smear(light_e, when.exposure_s, lab.chip.shutter)
    # Saturation and SNR need the light of the whole frame, which `expose` then overwrites.
    seen = add_snr_and_saturation(seen, light_e, when.exposure_s, lab.chip)
    clock.lap("render")
    image = expose(light_e, when.exposure_s, lab.chip, rng(scene.seed, "detector", index))
    clock.lap("detector")
    rate_cam = lab.mount.cam_from_body.apply(lab.trajectory.rate_at(middle_s))
    truth = Truth(middle_s, lab_from_body, cam_from_lab, rate_cam, seen, occluded_ids(lab, lab_from_body))
    return Frame(index, image, middle_s, when.exposure_s, saturation_dn(camera.detector)), truth


def occluded_ids(lab: Testbed, lab_from_body: Rotation) -> NDArray[np.int64]:
    """(M,) ids of the occluded sources that would otherwise be on the chip at that attitude."""
    if lab.obstacles is None:
        return np.zeros(0, np.int64)
    cam_from_lab = (lab.mount.cam_from_body * lab_from_body.inv()).as_matrix()
    here = Poses(cam_from_lab[None], lab_from_body.apply(lab.mount.camera_body_m)[None])
    near = lab.sources.take(in_view(lab.sources, lab.optics, here))
    xy_px = look(near, lab.optics, here)[0][0]
    size_px = np.array([lab.scene.camera.width_px, lab.scene.camera.height_px])
    on_chip = ((xy_px > -0.5) & (xy_px < size_px - 0.5)).all(axis=1)
    return near.id[on_chip & multibody.hidden(lab.obstacles, lab_from_body, near)]
