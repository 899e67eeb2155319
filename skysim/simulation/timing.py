"""Timing of a scene's frames: exposure windows, trigger jitter, time tags, and the duration of the motion."""

import math
from functools import lru_cache

import numpy as np

from skysim.camera.render import Window
from skysim.core.random_streams import CAMERA_TIMING, random_stream
from skysim.core.units import scaled_errors
from skysim.scene.scene import Scene

MARGIN_S = 2e-3  # time that is simulated after the last exposure
# Longest exposure that a client may set where the scene has none as long.
LONGEST_LIVE_S = 1.0
HISTORY_MARGIN_S = 0.05  # duration of past states that is kept beyond the needs of a frame


def exposure_window(scene: Scene, index: int, exposure_s: float | None = None) -> Window:
    """The exposure window of a frame, which opens late by its trigger jitter; exposure_s defaults to the scene's."""
    jitter_s = scene.exposure.trigger_jitter_s
    late_s = jitter_s * timing_draws(scene.seed, index)[0] if jitter_s else 0.0
    begin_s = scene.exposure.first_s + index / scene.exposure.rate_hz + late_s
    return window_from(scene, begin_s, exposure_s)


def window_from(scene: Scene, begin_s: float, exposure_s: float | None = None) -> Window:
    """The window of an exposure that begins at begin_s, with the row time of the camera's shutter."""
    if exposure_s is None:
        exposure_s = scene.exposure.time_s
    camera = scene.camera
    return Window(begin_s, exposure_s, camera.row_delay_s, camera.height_px)


def time_tag_error_s(scene: Scene, index: int) -> float:
    """Time tag of a frame minus the true time of mid-exposure."""
    exposure = scene.exposure
    if not exposure.time_tag_jitter_s:
        return exposure.time_tag_offset_s
    drawn = np.array(timing_draws(scene.seed, index)[1])
    return exposure.time_tag_offset_s + float(
        scaled_errors(exposure.time_tag_jitter_s, drawn)
    )


@lru_cache(maxsize=64)
def timing_draws(seed: int, index: int) -> tuple[float, float]:
    """A uniform draw for the trigger of a frame, and a standard normal draw for its time tag.

    They are cached, since every control period needs those of the next frame.
    """
    trigger, tag = (random_stream(seed, CAMERA_TIMING, index, part) for part in range(2))
    return trigger.random(), float(tag.standard_normal())


def longest_exposure_s(scene: Scene) -> float:
    """The longest exposure time that a frame can get."""
    control = scene.tracker.exposure_control
    return control.longest_s if control else scene.exposure.time_s


def longest_live_s(scene: Scene) -> float:
    """The longest exposure that a client may set: the scene's longest, or a frame period up to LONGEST_LIVE_S."""
    period_s = min(1 / scene.exposure.rate_hz, LONGEST_LIVE_S)
    return max(longest_exposure_s(scene), period_s)


def frame_end_s(scene: Scene, index: int) -> float:
    """Time until which a motion must last for a frame."""
    return exposure_window(scene, index).close_s + MARGIN_S


def duration_s(scene: Scene) -> float:
    """Duration of a motion until the longest exposure of the last frame ends, and a period begins after its middle.

    Telemetry has a row at the beginning of each control period, so it covers mid-exposure and time tag of all frames.
    """
    last = scene.exposure.frames - 1
    window = exposure_window(scene, last, longest_exposure_s(scene))
    latest_s = window.middle_s + max(time_tag_error_s(scene, last), 0.0)
    covered_s = math.ceil(latest_s * scene.control_rate_hz) / scene.control_rate_hz
    return max(window.close_s, covered_s) + MARGIN_S


def history_s(scene: Scene) -> float:
    """Duration of past states that a frame needs when it is due: longest exposure, latency, two control periods."""
    latency_s = scene.filter.latency_s if scene.filter else 0.0
    window = window_from(scene, 0.0, longest_live_s(scene))
    return window.close_s + latency_s + 2 / scene.control_rate_hz + HISTORY_MARGIN_S
