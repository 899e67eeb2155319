"""The gyro's rate of a frame, for the star tracker: mean of the IMU's samples over the frame's exposure."""

from __future__ import annotations

import math

import numpy as np

from estimator.core.types import RateEstimate
from skysim.camera.render import Window
from skysim.core.constants import ARCSEC_RAD, DEG_H_RAD_S, EARTH_RATE_RAD_S, PPM
from skysim.core.types import Mount
from skysim.dynamics.imu import Increments
from skysim.scene.sections.vehicle import ImuConfig


def rate_of_frame(
    samples: Increments, window: Window, rows: int, config: ImuConfig, mount: Mount
) -> RateEstimate | None:
    """Rate of the camera in its own axes, with the covariance of the data sheet; None without samples, or saturated.

    window, rows : exposure of a sensor of so many rows, to the end of its last row
    """
    begin_s = window.open_s
    end_s = window.close_s(rows)
    during = (samples.t_s > begin_s) & (samples.t_s - samples.step_s < end_s)
    if not during.any() or samples.saturated[during].any():
        return None
    rate = samples.angle_rad[during].mean(axis=0) / samples.step_s
    sigma = sigma_rad_s(config, float(np.linalg.norm(rate)), int(during.sum()) * samples.step_s)
    return RateEstimate(mount.cam_from_body.apply(rate), sigma**2 * np.eye(3))


def sigma_rad_s(config: ImuConfig, rate_rad_s: float, duration_s: float) -> float:
    """Standard deviation about each axis of a mean rate: by noise, counts, bias, scale factors and axes."""
    gyro = config.gyro
    return math.hypot(
        math.radians(gyro.arw_deg_sqrt_h) / 60 / math.sqrt(duration_s),
        gyro.quantum_arcsec * ARCSEC_RAD / math.sqrt(6) / duration_s,
        gyro.bias_deg_h * DEG_H_RAD_S,
        float(gyro.turn_on_bias_deg_h) * DEG_H_RAD_S,
        float(gyro.scale_ppm) * PPM * rate_rad_s,
        float(gyro.misalignment_arcsec) * ARCSEC_RAD * rate_rad_s,
        EARTH_RATE_RAD_S * (config.earth_rate != "none"),
    )


def latest(samples: list[Increments], kept_s: float) -> list[Increments]:
    """Without the samples that ended more than kept_s before the last one."""
    if not math.isfinite(kept_s):
        return samples
    since_s = samples[-1].t_s[-1] - kept_s
    return [one for one in samples if one.t_s[-1] >= since_s]
