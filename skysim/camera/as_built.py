"""Where LEDs and camera are, beside where a survey has them: temperature, gravity, the bearing, dies of LEDs.

Each effect of temperature is linear in the difference dT from the reference temperature, at which the set-up was
surveyed: LEDs move with the dome's expansion, the camera on its mount, the image with the focal length.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.core.constants import ARCSEC_RAD, HOUR_S, PPM
from skysim.core.types import UP, Floats, Mount, Sources, lengths, normalized
from skysim.scene.sections.surroundings import (
    LinearTemperatureConfig,
    SineTemperatureConfig,
    SteadyTemperatureConfig,
    TemperatureTableConfig,
    ThermalConfig,
)
from skysim.scene.sections.vehicle import VehicleConfig

BORESIGHT = UP  # in camera axes


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


def mount_at(vehicle: VehicleConfig, mount: Mount, lab_from_body: Rotation) -> Mount:
    """The camera's mount at an attitude, at which gravity bends it and the bearing's ball displaces it.

    1. Gravity across the boresight b bends the bracket, with compliances k about the camera's axes in angle per g: the
       camera turns by w = k (b x (d - d_0)), d the down direction in its axes and d_0 that of a level vehicle, at which
       it was aligned. The pupil, which is mast_m b from where the bracket bends, moves by w x mast_m b.
    2. A ball has the radius R + sum q_i u_i^2 in the direction u of the body. Around its lowest point, which is in the
       direction d, the surface is a sphere about c = 2 q d - (d . q d) d (elementwise products q d): it has the radius
       there and its slope. A small cup holds this sphere, so the body moves by -c, minus its place when level (a cup of
       half-angle 45 deg moves it across by 0.8 of that).
    """
    # 1. Sag.
    down_body = lab_from_body.inv().apply(-UP)
    down_cam = mount.cam_from_body.apply(down_body + UP)
    compliance_rad = ARCSEC_RAD * np.array([*vehicle.sag_arcsec, 0.0])
    turned_rad = compliance_rad * np.cross(BORESIGHT, down_cam)
    swung_m = np.cross(turned_rad, vehicle.mast_m * BORESIGHT)
    pupil_m = mount.camera_body_m + mount.body_from_cam.apply(swung_m)
    # 2. Run-out. A level body is higher by q_z.
    deviation_m = np.array(vehicle.runout_m) * down_body
    lift_m = down_body @ deviation_m + vehicle.runout_m[2]
    moved_m = lift_m * down_body - 2 * deviation_m
    # Lights turn the other way.
    cam_from_aligned = Rotation.from_rotvec(-turned_rad)
    return Mount(pupil_m + moved_m, cam_from_aligned * mount.cam_from_body)


def off_center(leds: Sources, die_m: Floats) -> Sources:
    """LEDs whose light comes from places (3,) beside the centers of their windows, in the axes of each LED.

    Its z is the LED's normal n, x is level (z_lab x n, the lab's x for an LED that looks straight up or down) and y is
    n x x: all LEDs of a batch are soldered the same way.
    """
    level = np.cross(UP, leds.normal)
    level[lengths(level) < 1e-9] = (1.0, 0.0, 0.0)
    level = normalized(level)
    axes = np.stack([level, np.cross(leds.normal, level), leds.normal], axis=1)
    place = leds.place.copy()
    place[:, :3] += np.einsum("i,nij->nj", die_m, axes)
    return replace(leds, place=place)
