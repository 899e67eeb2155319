"""Thermal motion: LEDs move with the dome's expansion, the camera on its mount, the image with the focal length.

Each effect is linear in the difference dT from the reference temperature, at which the set-up was surveyed.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.core.constants import ARCSEC_RAD, HOUR_S, PPM
from skysim.core.types import Mount, Sources
from skysim.scene.sections.surroundings import (
    LinearTemperatureConfig,
    SineTemperatureConfig,
    SteadyTemperatureConfig,
    TemperatureTableConfig,
    ThermalConfig,
)


def steady(config: SteadyTemperatureConfig, _hours: float) -> float:
    """A constant temperature in deg C."""
    return config.temperature_c


def linear(config: LinearTemperatureConfig, hours: float) -> float:
    """A temperature that changes at a constant rate: start + rate t."""
    return config.start_c + config.rate_c_h * hours


def sine(config: SineTemperatureConfig, hours: float) -> float:
    """A daily or other cycle: mean + amplitude sin(2 pi t / period + phase)."""
    # The phase in turns.
    turns = hours * HOUR_S / config.period_s + config.phase_deg / 360
    return config.mean_c + config.amplitude_c * float(np.sin(2 * np.pi * turns))


def table(config: TemperatureTableConfig, hours: float) -> float:
    """A measured temperature, linear between the measured times, constant beyond them."""
    return float(np.interp(hours, config.hours, config.temperature_c))


TEMPERATURES: dict[str, Callable[[Any, float], float]] = {
    "steady": steady,
    "linear": linear,
    "sine": sine,
    "table": table,
}


def temperature_c(config: ThermalConfig, t_s: float) -> float:
    """The temperature in deg C at a time since the scene's start; `speed` hastens its clock."""
    return TEMPERATURES[config.temperature.kind](
        config.temperature, t_s * config.speed / HOUR_S
    )


def turned(config: ThermalConfig, t_s: float) -> Rotation:
    """The camera's rotation since the calibration, about its own axes, at a time since the start: beta dT."""
    difference_k = temperature_c(config, t_s) - config.reference_c
    return Rotation.from_rotvec(np.array(config.mount_arcsec_k) * (ARCSEC_RAD * difference_k))


def leds_at(config: ThermalConfig, leds: Sources, t_s: float) -> Sources:
    """Move the LEDs from their surveyed places to their places at a time since the scene's start.

    An LED at x is at a + (1 + alpha dT)(x - a) + creep, with the anchor a on the dome's axis.
    """
    difference_k = temperature_c(config, t_s) - config.reference_c
    anchor_m = np.array([0.0, 0.0, config.anchor_height_m])
    place = leds.place.copy()
    moved_m = (
        PPM * config.dome_ppm_k * difference_k * (place[:, :3] - anchor_m) + config.creep_m
    )
    # Stars have w = 0 and stay.
    place[:, :3] += place[:, 3:] * moved_m
    return replace(leds, place=place)


def camera_at(
    config: ThermalConfig, mount: Mount, optics: Optics, t_s: float
) -> tuple[Mount, Optics]:
    """The camera's mount and lens at a time since the scene's start, from those at the calibration.

    The camera is turned by beta dT about its own axes, and the image is 1 + gamma dT times as large.
    """
    difference_k = temperature_c(config, t_s) - config.reference_c
    mount = replace(mount, cam_from_body=turned(config, t_s) * mount.cam_from_body)
    scale = 1 + PPM * config.lens_ppm_k * difference_k
    return mount, replace(optics, scale=scale) if config.lens_ppm_k else optics
