"""Render one frame with its truth (`render_frame`).

1. Collect the light that reaches the lens in the exposure (lights/light.py).
2. Draw extended light (camera/glow).
3. Draw points and discs along each path through the lens (camera/render.py, camera/discs), then the lens's glare.
   A color camera draws 2. and 3. once for the pixels of each color.
4. Add the charge smear of the shutter, and let charge repel charge (camera/detector).
5. Collect the truth of the frame.
6. Convert the light to digital numbers: noise, charge, analog-to-digital conversion (camera/detector).
"""

import math
from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.trackers.pipeline import Clock
from skysim.camera import as_built
from skysim.camera.detector import (
    AddedCharge,
    add_snr_and_saturation,
    expose,
    repel,
    saturation_dn,
    smear,
)
from skysim.camera.discs import render_bodies
from skysim.camera.glow import background, stray
from skysim.camera.projection import in_view, project, sample_times
from skysim.camera.render import Window, render
from skysim.core.random_streams import DETECTOR, random_stream
from skysim.core.types import (
    Floats,
    Frame,
    Ints,
    Sources,
    SourceTruth,
    Trajectory,
    Truth,
    joined,
)
from skysim.simulation.lab import (
    MARGIN_S,
    ColorChannel,
    StarCamera,
    exposure_window,
    frame_end_s,
    time_tag_error_s,
    window_from,
)
from skysim.simulation.lights.light import Beam, Exposure, Seeds, any_of, beam_of

KNOTS = 5  # attitude samples of an exposure at a constant rate


def render_frame(
    camera: StarCamera,
    trajectory: Trajectory,
    index: int,
    clock: Clock | None = None,
    window: Window | None = None,
    added: AddedCharge | None = None,
) -> tuple[Frame, Truth]:
    """A frame and its truth, both for mid-exposure of the middle row, and independent of other frames.

    Parameters
    ----------
    trajectory
        Motion of the vehicle during the exposure
    index
        Number of the frame, which selects its random numbers
    clock
        Clock that measures the stages
    window
        Exposure window; by default that of the scene's schedule
    added
        Receives the masks of smear and particles
    """
    clock = clock or Clock()
    scene = camera.scene
    detector = camera.detector
    window = window or exposure_window(scene, index)
    # 1. Light.
    exposure = exposure_of(camera, trajectory, index, window, camera.seeds)
    beam = beam_of(camera.lights, exposure)
    # 2. Extended light. The canvas is reused for every frame: the glow overwrites it, the rest is added to it.
    light_e = camera.canvas
    if camera.channels:
        sources = draw_colors(light_e, camera.channels, exposure)
    else:
        draw_glow(light_e, beam, window.exposure_s)
        # 3. Points, discs, glare.
        sources = draw_lights(light_e, beam, exposure)
    # 4. Smear, and charge that repels charge.
    smear(light_e, window.exposure_s, detector.shutter, added)
    repel(light_e, detector.config)
    # Saturation and SNR need the light of the whole frame, which `expose` then overwrites.
    sources = add_snr_and_saturation(sources, light_e, window.exposure_s, detector)
    # 5. Truth. Before the detector, whose passes over the whole frame would empty the processor's cache.
    truth = truth_of(beam, exposure, sources)
    clock.lap("render")
    # 6. Detector, and the camera's time tag.
    image = expose(
        light_e,
        window.exposure_s,
        detector,
        random_stream(scene.seed, DETECTOR, index),
        added,
    )
    clock.lap("detector")
    tagged_s = exposure.t_s + time_tag_error_s(scene, index)
    frame = Frame(
        index, image, tagged_s, window.exposure_s, saturation_dn(scene.camera.detector)
    )
    return frame, truth


def render_at_rest(
    camera: StarCamera, lab_from_body: Rotation, index: int = 0
) -> tuple[Frame, Truth]:
    """A frame of a vehicle at rest at an attitude, and its truth."""
    trajectory = Trajectory.at_rest(lab_from_body, frame_end_s(camera.scene, index))
    return render_frame(camera, trajectory, index)


def exposure_of(
    camera: StarCamera,
    trajectory: Trajectory,
    index: int,
    window: Window,
    seeds: Seeds | None,
) -> Exposure:
    """An exposure of a camera, with mount error, temperature, sag and run-out of mid-exposure applied.

    Parameters
    ----------
    camera
        Star camera
    trajectory
        Motion of the vehicle during the exposure
    index
        Number of the frame
    window
        Exposure window
    seeds
        Seeds of the run; None for the expectation, see `Exposure`
    """
    mount = camera.mount
    optics = camera.optics
    scene = camera.scene
    middle_s = window.middle_s
    if camera.mount_error is not None:
        mount = replace(mount, cam_from_body=camera.mount_error * mount.cam_from_body)
    if scene.thermal is not None:
        mount, optics = as_built.camera_at(scene.thermal, mount, optics, middle_s)
    lab_from_body = trajectory.attitude_at(middle_s)
    if scene.vehicle.is_bent:
        mount = as_built.mount_at(scene.vehicle, mount, lab_from_body)
    return Exposure(
        index,
        window,
        trajectory,
        lab_from_body,
        mount,
        optics,
        camera.band,
        camera.viewpoint,
        seeds,
    )


def expected_exposure(
    camera: StarCamera, lab_from_body: Rotation, rate_body_rad_s: Floats, t_s: float
) -> Exposure:
    """An exposure at an attitude and a constant rate, without random draws.

    Parameters
    ----------
    camera
        Star camera
    lab_from_body
        Attitude at mid-exposure
    rate_body_rad_s
        (3,) rate in body axes
    t_s
        Middle of the first row's exposure; NaN for that of the first frame
    """
    config = camera.scene.exposure
    middle_s = config.first_s + config.time_s / 2 if math.isnan(t_s) else t_s
    window = window_from(camera.scene, middle_s - config.time_s / 2)
    after_s = np.linspace(-1, 1, KNOTS) * (window.close_s - window.open_s + MARGIN_S)
    trajectory = Trajectory.at_rate(
        lab_from_body, rate_body_rad_s, window.middle_s, window.middle_s + after_s
    )
    return exposure_of(camera, trajectory, 0, window, None)


def draw_glow(image: NDArray, beam: Beam, exposure_s: float) -> None:
    """Set the (H, W) image to the extended light of a beam in electrons: smooth light, then light with edges."""
    smooth = sum(lit.glow() for lit in beam.lits if lit.glow)
    background.fill(image, np.atleast_2d(smooth), exposure_s)
    for edged in (lit.edged for lit in beam.lits if lit.edged):
        glow = edged()
        if glow is not None:
            background.add(image, glow, exposure_s)


def draw_lights(image: NDArray, beam: Beam, exposure: Exposure) -> SourceTruth:
    """Add the points and discs of a beam to the (H, W) image in place, and the glare of the lens.

    Returns the truth of their images.
    """
    truths = []
    # The first path is the image, the others are ghosts.
    for number, optics in enumerate(beam.paths):
        exposed = exposure.exposed(optics)
        for lit in beam.lits:
            if lit.points is not None:
                drawn = render(
                    image, lit.points, *exposed, lit.emitter, any_of(beam.before(lit))
                )
                truths.append(stray.as_ghosts(drawn, number))
            if lit.discs:
                bodies = render_bodies(image, lit.discs, exposed, lit.occlusion)
                truths += [stray.as_ghosts(body, number) for body in bodies]
    sources = joined(truths)
    for config in beam.glares:
        stray.add_glare(image, config)
        sources = stray.without_glare(sources, config)
    return sources


def draw_colors(
    image: NDArray, channels: Sequence[ColorChannel], exposure: Exposure
) -> SourceTruth:
    """Set the (H, W) image of a color camera to all light: each pixel has that of the channel of its filter.

    Returns the truth of the images. Electrons are the mean over an image's positions in the mosaic, since its light is
    drawn for the whole image in each color; other values are those of its brightest color.
    """
    one_color = np.empty_like(image)
    truths = []
    for channel in channels:
        own = replace(exposure, band=channel.band)
        beam = beam_of(channel.lights, own)
        draw_glow(one_color, beam, exposure.window.exposure_s)
        drawn = draw_lights(one_color, beam, own)
        truths.append(replace(drawn, electrons=drawn.electrons * len(channel.first_px) / 4))
        for y, x in channel.first_px:
            image[y::2, x::2] = one_color[y::2, x::2]
    every = joined(truths)
    # In descending order of brightness, so that the first row of an id is its brightest color.
    order = np.argsort(-every.peak_e, kind="stable")
    _, first, source = np.unique(every.id[order], return_index=True, return_inverse=True)
    kept = order[first]
    columns = {one.name: getattr(every, one.name)[kept] for one in fields(every)}
    columns["electrons"] = np.bincount(source, every.electrons[order])
    return SourceTruth(**columns)


def truth_of(beam: Beam, exposure: Exposure, sources: SourceTruth) -> Truth:
    """The truth of an exposure, from the truth of its images."""
    trajectory = exposure.trajectory
    half_s = exposure.window.exposure_s / 2
    # The renderer's own samples, those of the middle row.
    t_s = sample_times(exposure.t_s - half_s, exposure.t_s + half_s, trajectory)
    mean_lab_from_body, mean_rate_rad_s = trajectory.means(t_s)
    cam_from_body = exposure.mount.cam_from_body
    # Points that something hides and that would otherwise be on the detector at mid-exposure.
    hidden = [np.zeros(0, np.int64)]
    for lit in beam.lits:
        if lit.points is not None and lit.occlusion is not None:
            near = in_view(lit.points, exposure.optics, exposure.pose, reach=0.0)
            near = near[lit.occlusion(lit.points.place[near])]
            # Most exposures have none.
            if len(near):
                behind = lit.points.take(near)
                hidden.append(behind.id[on_detector(behind, exposure)[0]])
    return Truth(
        exposure.t_s,
        exposure.lab_from_body,
        exposure.cam_from_lab,
        mean_lab_from_body,
        cam_from_body.apply(trajectory.rate_at(exposure.t_s)),
        cam_from_body.apply(mean_rate_rad_s),
        sources,
        np.concatenate(hidden),
        tuple(disc.truth() for disc in beam.discs if disc.id in sources.id),
        tuple(
            truth for lit in beam.lits for truth in lit.satellites if truth.id in sources.id
        ),
    )


def on_detector(points: Sources, exposure: Exposure) -> tuple[Ints, list[Floats]]:
    """Rows of the points whose images are on the detector, and what `project` returns for these at the one pose."""
    optics = exposure.optics
    near = in_view(points, optics, exposure.pose, reach=0.0)
    projected = [one[0] for one in project(points.take(near), optics, exposure.pose)]
    xy_px = projected[0]
    # The detector ends half a pixel outside of the centers of its outer pixels.
    size = np.array(optics.camera.size_px)
    on_chip = ((xy_px > -0.5) & (xy_px < size - 0.5)).all(axis=1)
    return near[on_chip], [one[on_chip] for one in projected]
