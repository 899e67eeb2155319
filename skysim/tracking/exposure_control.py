"""Automatic exposure: set the next exposure time from the last frame."""

from __future__ import annotations

import numpy as np

from estimator.core.checks import ImageError
from estimator.core.types import FramePriors
from estimator.detection.detect import DETECTORS
from estimator.trackers.exposure_control import (Control, NextExposure, Observation, observe, step)
from estimator.trackers.pipeline import Settings
from skysim.core.types import Frame
from skysim.scene.scene import Scene
from skysim.tracking.factory import assumed_settings


class ExposureController:
    """The camera's exposure controller: sets the next exposure time from the last frame.

    exposure_s : of the next frame; always the scene's `exposure.time` without `tracker.exposure_control`
    """

    def __init__(self, scene: Scene) -> None:
        self.control = control_settings(scene)
        self.settings = assumed_settings(scene)
        self.exposure_s = scene.exposure.time_s

    def update(self, frame: Frame) -> None:
        """Update the exposure time from a frame, which was exposed for `frame.exposure_s`."""
        if self.control:
            state = NextExposure(frame.exposure_s)
            self.exposure_s = step(
                state, observe_frame(self.settings, self.control, frame), self.control
            ).time_s


def control_settings(scene: Scene) -> Control | None:
    """The constants of the control law from the scene; None where exposure times are fixed."""
    config = scene.tracker.exposure_control
    return Control(**dict(config)) if config else None


def observe_frame(settings: Settings, control: Control, frame: Frame) -> Observation:
    """What the control law needs from a frame: brightness statistics of the detected blobs.

    Blobs that are not stars (defects, tracks, the Moon) are left out. A pixel counts as saturated near the camera's
    saturation value.
    """
    try:
        blobs = DETECTORS[settings.detector](
            frame.image_dn,
            settings.threshold_sigma,
            settings.min_area_px,
            settings.max_blobs,
            FramePriors(None, settings.saturation),
        )
    except ImageError:  # a coarse converter may give a frame of one value: no blobs
        return observe(frame.image_dn, np.empty((0, 4), np.int64), settings.saturation, control)
    box_px = blobs.box_px[blobs.flag & settings.reject == 0]
    return observe(frame.image_dn, box_px, settings.saturation, control)
