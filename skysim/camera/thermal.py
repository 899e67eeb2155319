"""What moves with the temperature: LEDs with the dome's expansion, the camera on its mount, the lens's focal length."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics, ScaledOptics
from skysim.core.constants import ARCSEC_RAD, HOUR_S, PPM
from skysim.core.types import Mount, Sources
from skysim.scene.sections.thermal import (
    LinearTemperatureConfig,
    SineTemperatureConfig,
    SteadyTemperatureConfig,
    TemperatureTableConfig,
    ThermalConfig,
)


def steady(config: SteadyTemperatureConfig, _hours: float) -> float:
    """The same temperature all along."""
    return config.temperature_c


def linear(config: LinearTemperatureConfig, hours: float) -> float:
    """start + rate t."""
    return config.start_c + config.rate_c_h * hours


def sine(config: SineTemperatureConfig, hours: float) -> float:
    """mean + amplitude sin(2 pi t / period + phase)."""
    turns = hours * HOUR_S / config.period_s + config.phase_deg / 360
    return config.mean_c + config.amplitude_c * float(np.sin(2 * np.pi * turns))


def table(config: TemperatureTableConfig, hours: float) -> float:
    """Linear between the measured times, constant beyond them."""
    return float(np.interp(hours, config.hours, config.temperature_c))


TEMPERATURES: dict[str, Callable[[Any, float], float]] = {
    "steady": steady,
    "linear": linear,
    "sine": sine,
    "table": table,
}


def temperature_c(config: ThermalConfig, t_s: float) -> float:
    """The temperature at a time since the scene's start."""
    return TEMPERATURES[config.temperature.kind](config.temperature, t_s * config.speed / HOUR_S)


def turned(config: ThermalConfig, t_s: float) -> Rotation:
    """The camera's rotation on its mount since the calibration, about its own axes, at a time since the start."""
    difference_k = temperature_c(config, t_s) - config.reference_c
    return Rotation.from_rotvec(np.array(config.mount_arcsec_k) * (ARCSEC_RAD * difference_k))


class Hardware(NamedTuple):
    """Light sources, camera mount and lens."""

    sources: Sources
    mount: Mount
    optics: Optics


def at_time(config: ThermalConfig, hardware: Hardware, t_s: float) -> Hardware:
    """The hardware as it is at a time since the scene's start, from what it was at survey and calibration.

    With the temperature's difference dT an LED at x is at a + (1 + alpha dT)(x - a) + creep, a the anchor on the axis;
    the camera is turned by beta dT about its own axes; the image is 1 + gamma dT times as large.
    """
    difference_k = temperature_c(config, t_s) - config.reference_c
    sources, mount, optics = hardware
    if (sources.place[:, 3] > 0).any():
        anchor_m = np.array([0.0, 0.0, config.anchor_height_m])
        place = sources.place.copy()
        place[:, :3] += PPM * config.dome_ppm_k * difference_k * (place[:, :3] - anchor_m) + config.creep_m
        sources = replace(sources, place=place)
    mount = replace(mount, cam_from_body=turned(config, t_s) * mount.cam_from_body)
    scale = 1 + PPM * config.lens_ppm_k * difference_k
    return Hardware(sources, mount, ScaledOptics.of(optics, scale) if config.lens_ppm_k else optics)
