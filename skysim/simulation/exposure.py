"""Render one frame with its truth.

The order is that of the light: background and display glow, the sources integrated along their paths
(camera/render.py), charge smear of the shutter, then the detector (camera/detector).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.trackers.pipeline import Clock
from skysim.camera.detector.detector import add_snr_and_saturation, expose, saturation_dn, smear
from skysim.camera.discs.bodies import FEW, behind, concatenated, render_bodies
from skysim.camera.discs.disc_image import Exposed
from skysim.camera.glow import background, display_glow
from skysim.camera.glow.air_glow import sky_light
from skysim.camera.glow.earth_glow import earth_light
from skysim.camera.optics import Optics
from skysim.camera.render import OcclusionTest, Poses, Window, in_view, poses, project, render
from skysim.core.random_streams import DETECTOR, SCINTILLATION, random_stream
from skysim.core.types import Frame, Sources, Truth
from skysim.dynamics import multibody
from skysim.simulation.testbed import (
    Testbed,
    bodies_during,
    exposure_window,
    lights_during,
    observer_during,
    satellites_during,
    sky_during,
    time_tag_error_s,
)
from skysim.sources.air.air import Sky
from skysim.sources.orbit.earth import sun_m
from skysim.sources.orbit.satellites import View, as_sources
from skysim.sources.photometry import SUN


def render_frame(
    testbed: Testbed, index: int, clock: Clock | None = None, exposure_s: float | None = None
) -> tuple[Frame, Truth]:
    """Render one frame and its truth, both for mid-exposure of the middle row.

    They depend only on the test bed, the index and the exposure time (the scene's if left out), not on other frames.
    """
    clock = clock or Clock()
    scene, camera = testbed.scene, testbed.scene.camera
    window = exposure_window(scene, index, exposure_s)
    middle_s = window.middle_s(camera.height_px)
    lab_from_body = testbed.trajectory.attitude_at(middle_s)
    cam_from_lab = testbed.mount.cam_from_body * lab_from_body.inv()
    light_e = testbed.canvas
    # The canvas is reused for every frame: the background overwrites it, all else is added to it.
    sky = sky_during(testbed, middle_s)
    glow = background.glow_map(scene.background, testbed.optics, cam_from_lab, testbed.band, sky_light(sky))
    background.fill(light_e, glow, window.exposure_s)
    add_earth(light_e, testbed, cam_from_lab, middle_s, window.exposure_s)
    camera_m = lab_from_body.apply(testbed.mount.camera_body_m)
    black_level = display_glow.black_glow(scene.light, testbed.optics, cam_from_lab, camera_m, testbed.band)
    if black_level is not None:
        light_e += black_level * window.exposure_s
    view = view_of(testbed, window, cam_from_lab, middle_s)
    light = lights_during(testbed, view, middle_s)
    bodies, optics = bodies_during(testbed, middle_s), testbed.optics
    if sky:
        light, optics = seen_stars(testbed, sky, window, index), seeing_optics(testbed, sky, cam_from_lab)
    occludes = occlusion_test(testbed, lab_from_body, sky)
    sources = render(
        light_e,
        light,
        optics,
        testbed.trajectory,
        testbed.mount,
        window,
        testbed.emitter,
        behind(bodies, occludes),
    )
    if bodies:
        exposed = Exposed(optics, testbed.trajectory, testbed.mount, window)
        sources = concatenated([sources, *render_bodies(light_e, bodies, exposed, occludes)])
    satellites = satellites_during(testbed, view, middle_s, index)
    if satellites:
        hidden = behind(bodies, occludes)
        streaks = as_sources(satellites, testbed.band)
        if sky:
            streaks = sky.lights_seen(streaks, SUN[0])
        drawn = render(light_e, streaks, optics, testbed.trajectory, testbed.mount, window, None, hidden)
        sources = concatenated([sources, drawn])
    smear(light_e, window.exposure_s, testbed.detector.shutter)
    # Saturation and SNR need the light of the whole frame, which `expose` then overwrites.
    sources = add_snr_and_saturation(sources, light_e, window.exposure_s, testbed.detector)
    clock.lap("render")
    image = expose(light_e, window.exposure_s, testbed.detector, random_stream(scene.seed, DETECTOR, index))
    clock.lap("detector")
    rate_cam = testbed.mount.cam_from_body.apply(testbed.trajectory.rate_at(middle_s))
    seen = tuple(body.truth() for body in bodies if body.id in sources.id)
    streaked = tuple(light.truth for light in satellites if light.truth.id in sources.id)
    hidden_ids = occluded_ids(testbed, lab_from_body, light, occludes)
    truth = Truth(middle_s, lab_from_body, cam_from_lab, rate_cam, sources, hidden_ids, seen, streaked)
    tagged_s = middle_s + time_tag_error_s(scene, index)
    return Frame(index, image, tagged_s, window.exposure_s, saturation_dn(camera.detector)), truth


def add_earth(light_e: NDArray[Any], testbed: Testbed, cam_from_lab: Rotation, t_s: float, exposure_s: float) -> None:
    """Add the Earth's light at a time to the image, in place, where the scene's orbit has it."""
    config = testbed.scene.orbit.earth if testbed.scene.orbit else None
    if config is None:
        return
    here = observer_during(testbed, t_s)
    position_m = here.from_earth.position_m
    glow = earth_light(config, position_m, sun_m(here.tt_jd), testbed.optics, cam_from_lab, testbed.band)
    if glow is not None:
        own = np.empty_like(light_e)
        background.fill(own, glow, exposure_s)
        light_e += own


def view_of(testbed: Testbed, window: Window, cam_from_lab: Rotation, middle_s: float) -> View:
    """What the camera can see in the exposure."""
    duration_s = window.close_s(testbed.scene.camera.height_px) - window.open_s
    turn_rad = float(np.linalg.norm(testbed.trajectory.rate_at(middle_s))) * duration_s
    return View(cam_from_lab.inv().apply([0.0, 0.0, 1.0]), testbed.optics.field_rad, turn_rad, duration_s)


def seen_stars(testbed: Testbed, sky: Sky, window: Window, index: int) -> Sources:
    """The stars near the field of a frame as they are seen through the air.

    The site turns by 15" in a second, which changes a refraction by less than 0.02" at 15 degrees of altitude, so the
    air is that of mid-exposure.
    """
    scene, rows = testbed.scene, testbed.scene.camera.height_px
    few_poses = poses(testbed.trajectory, testbed.mount, np.linspace(window.open_s, window.close_s(rows), FEW))
    seen = sky.stars_seen(testbed.sources.take(in_view(testbed.sources, testbed.optics, few_poses)))
    if not sky.air.config.scintillation:
        return seen
    rng = random_stream(scene.seed, SCINTILLATION, index)
    return sky.twinkling(seen, scene.camera.pupil_m, window.exposure_s, rng)


def seeing_optics(testbed: Testbed, sky: Sky, cam_from_lab: Rotation) -> Optics:
    """The optics with the blur of the seeing at the boresight."""
    boresight = cam_from_lab.inv().apply([0.0, 0.0, 1.0])
    return replace(testbed.optics, blur_px=sky.seeing_px(boresight, testbed.scene.camera.focal_px))


def occlusion_test(testbed: Testbed, lab_from_body: Rotation, sky: Sky | None) -> OcclusionTest | None:
    """The test for sources that the vehicle, the dome or the skyline hides; None if nothing can."""
    by_parts = partial(multibody.occluded, testbed.obstacles, lab_from_body) if testbed.obstacles else None
    if sky is None:
        return by_parts

    def hidden(sources: Sources) -> NDArray[np.bool_]:
        below = sky.below_horizon(sources.place[:, :3])
        return below | by_parts(sources) if by_parts else below

    return hidden


def occluded_ids(
    testbed: Testbed, lab_from_body: Rotation, light: Sources, occludes: OcclusionTest | None
) -> NDArray[np.int64]:
    """(M,) ids of the occluded sources that would otherwise be on the chip at that attitude."""
    if occludes is None:
        return np.zeros(0, np.int64)
    cam_from_lab = (testbed.mount.cam_from_body * lab_from_body.inv()).as_matrix()
    pose = Poses(cam_from_lab[None], lab_from_body.apply(testbed.mount.camera_body_m)[None])
    visible = light.take(in_view(light, testbed.optics, pose))
    xy_px = project(visible, testbed.optics, pose)[0][0]
    size_px = np.array([testbed.scene.camera.width_px, testbed.scene.camera.height_px])
    on_chip = ((xy_px > -0.5) & (xy_px < size_px - 0.5)).all(axis=1)
    return visible.id[on_chip & occludes(visible)]
