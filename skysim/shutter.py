"""One frame: the light that a camera in flight gathers between two moments, and what was true meanwhile."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.stages import Clock
from skysim import background, display, world
from skysim.camera import RollingShutter
from skysim.detector import expose, judge, saturation_dn, smear
from skysim.render import Poses, Window, in_view, look, render
from skysim.scene import Scene
from skysim.types import Frame, Truth

if TYPE_CHECKING:
    from skysim.simulate import Lab

STAGE_ID = {"detector": 1, "jitter": 2, "imu": 3, "draught": 4}


def rng(seed: int, stage: str, frame: int) -> np.random.Generator:
    """A stage's random stream for one frame, the same whatever was drawn before: frame 57 renders alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STAGE_ID[stage], frame)))


def window(scene: Scene, index: int, exposure_s: float | None = None) -> Window:
    """When the chip gathers the light of a frame; for the scene's own exposure if none is given."""
    shutter = scene.camera.shutter
    row_time_s = shutter.row_time_s if isinstance(shutter, RollingShutter) else 0.0
    begin_s = scene.exposure.first_s + index / scene.exposure.rate_hz
    return Window(begin_s, scene.exposure.time_s if exposure_s is None else exposure_s, row_time_s)


def shoot(
    lab: Lab, index: int, clock: Clock | None = None, exposure_s: float | None = None
) -> tuple[Frame, Truth]:
    """One frame with its truth. Depends on the scene, the index and the exposure (the scene's if left out) alone."""
    clock = clock or Clock()
    scene, camera = lab.scene, lab.scene.camera
    when = window(scene, index, exposure_s)
    middle_s = when.middle_s(camera.height_px)
    lab_from_body = lab.trajectory.at(middle_s)
    cam_from_lab = lab.mount.cam_from_body * lab_from_body.inv()
    light_e = lab.canvas
    glow = background.glow_map(scene.background, lab.optics, cam_from_lab, lab.band)
    background.fill(light_e, glow, when.exposure_s)
    camera_m = lab_from_body.apply(lab.mount.camera_body_m)
    black = display.black_glow(scene.light, lab.optics, cam_from_lab, camera_m, lab.band)
    if black is not None:
        light_e += black * when.exposure_s
    hides = partial(world.hidden, lab.obstacles, lab_from_body) if lab.obstacles else None
    seen = render(light_e, lab.sources, lab.optics, lab.trajectory, lab.mount, when, lab.emitter, hides)
    smear(light_e, when.exposure_s, lab.chip.shutter)
    seen = judge(seen, light_e, when.exposure_s, lab.chip)
    clock.lap("render")
    image = expose(light_e, when.exposure_s, lab.chip, rng(scene.seed, "detector", index))
    clock.lap("detector")
    rate_cam = lab.mount.cam_from_body.apply(lab.trajectory.rate_at(middle_s))
    truth = Truth(middle_s, lab_from_body, cam_from_lab, rate_cam, seen, behind_things(lab, lab_from_body))
    return Frame(index, image, middle_s, when.exposure_s, saturation_dn(camera.detector)), truth


def behind_things(lab: Lab, lab_from_body: Rotation) -> NDArray[np.int64]:
    """(M,) ids of the sources that would be on the chip at that attitude, had something not stood in the way."""
    if lab.obstacles is None:
        return np.zeros(0, np.int64)
    cam_from_lab = (lab.mount.cam_from_body * lab_from_body.inv()).as_matrix()
    here = Poses(cam_from_lab[None], lab_from_body.apply(lab.mount.camera_body_m)[None])
    near = lab.sources.take(in_view(lab.sources, lab.optics, here))
    xy_px = look(near, lab.optics, here)[0][0]
    size_px = np.array([lab.scene.camera.width_px, lab.scene.camera.height_px])
    on_chip = ((xy_px > -0.5) & (xy_px < size_px - 0.5)).all(axis=1)
    return near.id[on_chip & world.hidden(lab.obstacles, lab_from_body, near)]
