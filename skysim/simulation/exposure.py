"""Render one frame with its truth.

The order is that of the light: background, stray light past the baffle and display glow, the sources integrated along
their paths (camera/render.py), ghosts and glare of the lens (camera/stray), charge smear of the shutter, then the
detector (camera/detector).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.trackers.pipeline import Clock
from skysim.camera import thermal
from skysim.camera.detector.added_charge import AddedCharge
from skysim.camera.detector.detector import add_snr_and_saturation, expose, saturation_dn, smear
from skysim.camera.discs.bodies import FEW, behind, concatenated, render_bodies
from skysim.camera.discs.disc_image import Exposed
from skysim.camera.glow import background, display_glow
from skysim.camera.glow.air_glow import sky_light
from skysim.camera.glow.baffle import stray_of_bodies_e_s_m2, stray_of_earth_e_s_m2
from skysim.camera.glow.earth_glow import earth_light
from skysim.camera.optics import Optics
from skysim.camera.render import OcclusionTest, Poses, Window, in_view, poses, project, render
from skysim.camera.stray import ghosts, glare, wall
from skysim.core.random_streams import DETECTOR, SCINTILLATION, random_stream
from skysim.core.types import Floats, Frame, Sources, SourceTruth, Trajectory, Truth, with_sources
from skysim.dynamics import multibody
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.lab import (
    StarCamera,
    bodies_during,
    lights_during,
    observer_during,
    satellites_during,
    sky_during,
)
from skysim.simulation.timing import exposure_window, frame_end_s, time_tag_error_s
from skysim.sources.air.air import Sky
from skysim.sources.dome.led import Emitter, warm_up_factor
from skysim.sources.orbit.earth import sun_m
from skysim.sources.orbit.satellites import MovingLight, View, as_sources
from skysim.sources.photometry import SUN
from skysim.sources.solar_system.bodies import BodyLight


def render_frame(
    camera: StarCamera,
    trajectory: Trajectory,
    index: int,
    clock: Clock | None = None,
    window: Window | None = None,
    added: AddedCharge | None = None,
) -> tuple[Frame, Truth]:
    """Render one frame and its truth, both for mid-exposure of the middle row.

    They depend only on the camera, its motion, the index and the window (the scene's if left out), not on other frames.
    added : gets the masks of smear and particles
    """
    clock = clock or Clock()
    testbed = camera
    scene = testbed.scene
    window = window or exposure_window(scene, index)
    middle_s = window.middle_s(scene.camera.height_px)
    testbed = at_time(testbed, middle_s)
    lab_from_body = trajectory.attitude_at(middle_s)
    cam_from_lab = testbed.mount.cam_from_body * lab_from_body.inv()
    camera_m = lab_from_body.apply(testbed.mount.camera_body_m)
    sky, light_e = sky_during(testbed, middle_s), testbed.canvas
    # The canvas is reused for every frame: the background overwrites it, all else is added to it.
    bodies = bodies_during(testbed, middle_s)
    stray_e_s = sum(stray_light_e_s(testbed, bodies, cam_from_lab, middle_s).values())
    fill_background(light_e, testbed, sky, cam_from_lab, camera_m, middle_s, window.exposure_s, stray_e_s)
    view = view_of(testbed, trajectory, window, cam_from_lab, middle_s)
    satellites = satellites_during(testbed, view, middle_s, index)
    stars = lights_during(testbed, view, middle_s, window.exposure_s)
    if testbed.codes:
        stars = testbed.codes.shown(stars, window.open_s, window.exposure_s, index)
    if sky:
        stars = seen_stars(testbed, trajectory, stars, sky, window, index)
    streaks = satellite_sources(testbed, sky, satellites)
    lights = Lights(with_images(testbed, stars, cam_from_lab, camera_m), bodies, streaks)
    occludes = occlusion_test(testbed, lab_from_body, sky)
    optics = seeing_optics(testbed, sky, cam_from_lab) if sky else testbed.optics
    exposed = Exposed(optics, trajectory, testbed.mount, window)
    sources = draw_lights(light_e, lights, exposed, testbed.emitter, occludes)
    sources = add_stray(light_e, sources, lights, exposed, testbed, occludes)
    smear(light_e, window.exposure_s, testbed.detector.shutter, added)
    # Saturation and SNR need the light of the whole frame, which `expose` then overwrites.
    sources = add_snr_and_saturation(sources, light_e, window.exposure_s, testbed.detector)
    clock.lap("render")
    rng = random_stream(scene.seed, DETECTOR, index)
    image = expose(light_e, window.exposure_s, testbed.detector, rng, added)
    clock.lap("detector")
    rate_cam = testbed.mount.cam_from_body.apply(trajectory.rate_at(middle_s))
    seen = tuple(body.truth() for body in lights.bodies if body.id in sources.id)
    streaked = tuple(light.truth for light in satellites if light.truth.id in sources.id)
    hidden_ids = occluded_ids(testbed, lab_from_body, stars, occludes)
    truth = Truth(middle_s, lab_from_body, cam_from_lab, rate_cam, sources, hidden_ids, seen, streaked)
    tagged_s = middle_s + time_tag_error_s(scene, index)
    return Frame(index, image, tagged_s, window.exposure_s, saturation_dn(scene.camera.detector)), truth


def render_at_rest(camera: StarCamera, lab_from_body: Rotation, index: int = 0) -> tuple[Frame, Truth]:
    """Render one frame of a vehicle that is at rest at an attitude."""
    return render_frame(camera, Trajectory.at_rest(lab_from_body, frame_end_s(camera.scene, index)), index)


def fill_background(
    light_e: NDArray[Any],
    testbed: StarCamera,
    sky: Sky | None,
    cam_from_lab: Rotation,
    camera_m: Floats,
    t_s: float,
    exposure_s: float,
    stray_e_s: float,
) -> None:
    """Set the image to all extended light: background and air, the dome's wall, the Earth, a display's black level.

    stray_e_s : of `stray_light_e_s`
    """
    optics, band, left = testbed.optics, testbed.band, light_left(testbed, t_s)
    glow = background.glow_map(testbed.scene.background, optics, cam_from_lab, band, sky_light(sky)) + stray_e_s
    if testbed.reflecting:
        glow = glow + left * wall.wall_glow(testbed.reflecting, optics, cam_from_lab, camera_m, band)
    background.fill(light_e, glow, exposure_s)
    add_earth(light_e, testbed, cam_from_lab, t_s, exposure_s)
    black_level = display_glow.black_glow(testbed.scene.light, optics, cam_from_lab, camera_m, band)
    if black_level is not None:
        light_e += black_level * (left * exposure_s)


def stray_light_e_s(
    testbed: StarCamera, bodies: Sequence[BodyLight], cam_from_lab: Rotation, t_s: float
) -> dict[str, float]:
    """Electrons s^-1 px^-1 that each body, and the Earth, sends past the baffle; empty without a baffle.

    bodies : of `bodies_during`; those below the skyline give nothing
    """
    scene, baffle = testbed.scene, testbed.scene.camera.baffle
    if baffle is None:
        return {}
    sky = sky_during(testbed, t_s)
    boresight = cam_from_lab.inv().apply([0.0, 0.0, 1.0])
    up = [body for body in bodies if not (sky and sky.below_horizon(body.place.direction[None])[0])]
    found = stray_of_bodies_e_s_m2(baffle, up, boresight)
    if scene.orbit and scene.orbit.earth:
        here = observer_during(testbed, t_s)
        position_m, sun = here.from_earth.position_m, sun_m(here.tt_jd)
        found["earth"] = stray_of_earth_e_s_m2(baffle, scene.orbit.earth, position_m, sun, boresight, testbed.band)
    return {name: light * scene.camera.pixel_m**2 for name, light in found.items()}


def satellite_sources(testbed: StarCamera, sky: Sky | None, satellites: Sequence[MovingLight]) -> Sources | None:
    """The satellites as light sources, through the air where there is one; None without satellites."""
    if not satellites:
        return None
    streaks = as_sources(satellites, testbed.band)
    return sky.lights_seen(streaks, SUN[0]) if sky else streaks


def add_stray(
    light_e: NDArray[Any],
    sources: SourceTruth,
    lights: Lights,
    exposed: Exposed,
    testbed: StarCamera,
    occludes: OcclusionTest | None,
) -> SourceTruth:
    """Add the lens's ghosts and glare to the image, in place; return the truth of all images."""
    camera = testbed.scene.camera
    for number, ghost in enumerate(camera.ghosts, 1):
        by_ghost = exposed._replace(optics=ghosts.ghost_optics(testbed.optics, ghost))
        drawn = draw_lights(light_e, lights, by_ghost, testbed.emitter, occludes)
        sources = concatenated([sources, ghosts.as_ghosts(drawn, number)])
    if camera.glare:
        glare.add_glare(light_e, camera.glare)
        sources = glare.without_glare(sources, camera.glare)
    return sources


def add_earth(
    light_e: NDArray[Any], testbed: StarCamera, cam_from_lab: Rotation, t_s: float, exposure_s: float
) -> None:
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


def view_of(
    testbed: StarCamera, trajectory: Trajectory, window: Window, cam_from_lab: Rotation, middle_s: float
) -> View:
    """What the camera can see in the exposure."""
    duration_s = window.close_s(testbed.scene.camera.height_px) - window.open_s
    turn_rad = float(np.linalg.norm(trajectory.rate_at(middle_s))) * duration_s
    return View(cam_from_lab.inv().apply([0.0, 0.0, 1.0]), testbed.optics.field_rad, turn_rad, duration_s)


def light_left(testbed: StarCamera, t_s: float) -> float:
    """Light of the dome's LEDs at that time, over that when they were switched on."""
    light = testbed.scene.light
    return warm_up_factor(light.led.warm_up, t_s) if isinstance(light, DomeConfig) else 1.0


def at_time(testbed: StarCamera, t_s: float) -> StarCamera:
    """The test bed with LEDs as bright as they are at that time, and LEDs, mount and lens where the temperature has
    moved them.
    """
    left = light_left(testbed, t_s)
    if left < 1:
        dimmed = replace(testbed.sources, strength=left * testbed.sources.strength)
        testbed = replace(testbed, sources=dimmed)
    if testbed.mount_error is not None:
        mount = replace(testbed.mount, cam_from_body=testbed.mount_error * testbed.mount.cam_from_body)
        testbed = replace(testbed, mount=mount)
    if testbed.scene.thermal is None:
        return testbed
    hardware = thermal.Hardware(testbed.sources, testbed.mount, testbed.optics)
    return replace(testbed, **thermal.at_time(testbed.scene.thermal, hardware, t_s)._asdict())


def with_images(testbed: StarCamera, sources: Sources, cam_from_lab: Rotation, camera_m: Floats) -> Sources:
    """The sources, and the images of LEDs that a camera there sees in the wall."""
    if not (testbed.reflecting and testbed.reflecting.config.mirrors):
        return sources
    images = wall.images_in_wall(testbed.reflecting, sources, testbed.optics, cam_from_lab, camera_m)
    return with_sources([sources, images])


class Lights(NamedTuple):
    """All that shines in an exposure; no satellites are None."""

    sources: Sources
    bodies: Sequence[BodyLight]
    satellites: Sources | None


def draw_lights(
    image: NDArray[Any], lights: Lights, exposed: Exposed, emitter: Emitter, occludes: OcclusionTest | None
) -> SourceTruth:
    """Add all lights to the (H, W) image, in place; return the truth of those that gave light."""
    hidden = behind(lights.bodies, occludes)
    truths = [render(image, lights.sources, *exposed, emitter, hidden)]
    if lights.bodies:
        truths += render_bodies(image, lights.bodies, exposed, occludes)
    if lights.satellites is not None:
        truths.append(render(image, lights.satellites, *exposed, None, hidden))
    return concatenated(truths) if len(truths) > 1 else truths[0]


def seen_stars(
    testbed: StarCamera, trajectory: Trajectory, stars: Sources, sky: Sky, window: Window, index: int
) -> Sources:
    """The stars near the field of a frame as they are seen through the air.

    The site turns by 15" in a second, which changes a refraction by less than 0.02" at 15 degrees of altitude, so the
    air is that of mid-exposure.
    """
    scene, rows = testbed.scene, testbed.scene.camera.height_px
    few_poses = poses(trajectory, testbed.mount, np.linspace(window.open_s, window.close_s(rows), FEW))
    seen = sky.stars_seen(stars.take(in_view(stars, testbed.optics, few_poses)))
    if not sky.air.config.scintillation:
        return seen
    rng = random_stream(scene.seed, SCINTILLATION, index)
    return sky.twinkling(seen, scene.camera.pupil_m, window.exposure_s, rng)


def seeing_optics(testbed: StarCamera, sky: Sky, cam_from_lab: Rotation) -> Optics:
    """The optics with the blur of the seeing at the boresight."""
    boresight = cam_from_lab.inv().apply([0.0, 0.0, 1.0])
    return replace(testbed.optics, blur_px=sky.seeing_px(boresight, testbed.scene.camera.focal_px))


def occlusion_test(testbed: StarCamera, lab_from_body: Rotation, sky: Sky | None) -> OcclusionTest | None:
    """The test for sources that the vehicle, the dome or the skyline hides; None if nothing can."""
    by_parts = partial(multibody.occluded, testbed.obstacles, lab_from_body) if testbed.obstacles else None
    if sky is None:
        return by_parts

    def hidden(place: Floats) -> NDArray[np.bool_]:
        below = sky.below_horizon(place[:, :3])
        return below | by_parts(place) if by_parts else below

    return hidden


def occluded_ids(
    testbed: StarCamera, lab_from_body: Rotation, light: Sources, occludes: OcclusionTest | None
) -> NDArray[np.int64]:
    """(M,) ids of the occluded sources that would otherwise be on the chip at that attitude."""
    if occludes is None:
        return np.zeros(0, np.int64)
    cam_from_lab = (testbed.mount.cam_from_body * lab_from_body.inv()).as_matrix()
    pose = Poses(cam_from_lab[None], lab_from_body.apply(testbed.mount.camera_body_m)[None])
    visible = light.take(in_view(light, testbed.optics, pose, reach=0.0))
    xy_px = project(visible, testbed.optics, pose)[0][0]
    size_px = np.array([testbed.scene.camera.width_px, testbed.scene.camera.height_px])
    on_chip = ((xy_px > -0.5) & (xy_px < size_px - 0.5)).all(axis=1)
    return visible.id[on_chip & occludes(visible.place)]
