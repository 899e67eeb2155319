"""On-board navigation: IMU, inertial navigator, attitude filter, and the attitude that the controller gets.

1. `Navigation.sample_imu` takes the samples of the IMU. The inertial navigator (`imu.Navigator`) integrates them to an
   attitude.
2. With a filter, they also propagate a multiplicative extended Kalman filter (`estimator.filter.mekf`).
3. `Navigation.update_filter` updates the filter with each attitude of a star tracker.
4. `attitude_wxyz` and `body_rate_rad_s` are the estimates that the controller gets.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, RateEstimate
from estimator.filter.error_models import GyroModel, JumpModel, TrackerModel
from estimator.filter.mekf import AttitudeFilter
from skysim.camera.render import Window
from skysim.core import quaternion
from skysim.core.constants import ARCSEC_RAD, DEG_H_RAD_S, EARTH_RATE_RAD_S, HOUR_S, PPM
from skysim.core.types import Floats, Mount, Record
from skysim.dynamics import imu
from skysim.dynamics.imu import Increments
from skysim.scene.scene import Scene
from skysim.scene.sections.tracker import FilterConfig
from skysim.scene.sections.vehicle import ImuConfig

# Rate of a frame from the gyros, for the star tracker.


def rate_of_frame(
    samples: Increments, window: Window, config: ImuConfig, mount: Mount
) -> RateEstimate | None:
    """Mean rate of the camera in its own axes over an exposure, with the covariance by the gyros' data sheet.

    None without samples, and if a gyro was saturated.

    Parameters
    ----------
    samples
        Samples of the IMU
    window
        Exposure window
    config
        The scene's `vehicle.imu`
    mount
        Mount of the camera
    """
    begins_s = samples.t_s - samples.step_s
    during = (samples.t_s > window.open_s) & (begins_s < window.close_s)
    if not during.any() or samples.saturated[during].any():
        return None
    rate = samples.angle_rad[during].mean(axis=0) / samples.step_s
    sigma = sigma_rad_s(
        config, float(np.linalg.norm(rate)), int(during.sum()) * samples.step_s
    )
    return RateEstimate(mount.cam_from_body.apply(rate), sigma**2 * np.eye(3))


def sigma_rad_s(config: ImuConfig, rate_rad_s: float, duration_s: float) -> float:
    """Standard deviation about each axis of a mean rate: the root of the sum of squares of

    1. white noise, sigma / sqrt(duration)
    2. quantization of both ends, quantum / sqrt(6) / duration
    3. bias instability and turn-on bias
    4. scale factor and misalignment times the rate
    5. the Earth rate, if the gyros sense it
    """
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
    """The samples that ended at most kept_s before the last one."""
    if not math.isfinite(kept_s):
        return samples
    since_s = samples[-1].t_s[-1] - kept_s
    return [one for one in samples if one.t_s[-1] >= since_s]


class Navigation:
    """The vehicle's attitude estimates: integrated gyros, and the filter that star trackers correct.

    Parameters
    ----------
    scene
        The scene, with `vehicle.imu` and optionally `filter`
    mounts
        Assumed mounts of the cameras, that of the main camera first
    lab_from_body
        True attitude at the start, when the navigator is zeroed
    position_body_m, gravity_m_s2
        Position (3,) of the accelerometers in body axes, and gravity
    rng
        Generator of the IMU's noise
    kept_s
        Time for which IMU samples are kept, for `imu_samples`
    """

    def __init__(
        self,
        scene: Scene,
        mounts: Sequence[Mount],
        lab_from_body: Rotation,
        position_body_m: Floats,
        gravity_m_s2: float,
        rng: np.random.Generator,
        kept_s: float = math.inf,
    ) -> None:
        config = scene.vehicle.imu
        assert config is not None
        self.imu = imu.Imu(config, rng)
        self.position_body_m = position_body_m
        self.gravity_m_s2 = gravity_m_s2
        self.body_from_cam = [mount.body_from_cam for mount in mounts]
        self.step_s = 1 / config.rate_hz
        self.samples = 0
        earth = imu.earth_rate_lab_rad_s(scene.site)
        self.earth_sensed_rad_s = earth * (config.earth_rate != "none")
        self.earth_compensated_rad_s = earth * (config.earth_rate == "compensated")
        # The navigator is zeroed to the true attitude minus an error.
        angles_deg = lab_from_body.as_euler("ZYX", degrees=True) - config.home_error_deg[::-1]
        assumed = Rotation.from_euler("ZYX", angles_deg, degrees=True)
        self.navigator = imu.Navigator(
            assumed.as_quat(scalar_first=True), self.earth_compensated_rad_s
        )
        self.filter = (
            build_filter(scene.filter, assumed, len(mounts)) if scene.filter else None
        )
        self.time_tag_sigma_s = scene.filter.time_tag_sigma_s if scene.filter else 0.0
        self.kept_s = kept_s
        self.measured = list[imu.Increments]()
        self.rate_rad_s = np.zeros(3)
        self.saturated = False

    def sample_imu(
        self, now_s: float, t_s: Floats, lab_from_body_wxyz: Floats, rate_body_rad_s: Floats
    ) -> None:
        """Take the IMU samples that are due up to now_s; update navigator and filter with them.

        Parameters
        ----------
        now_s
            Present time
        t_s, lab_from_body_wxyz, rate_body_rad_s
            Times (K,), attitudes (K, 4) and rates (K, 3) in body axes of the motion since the last call
        """
        # 1. Samples. The small term keeps rounding from losing a sample that is due exactly now.
        due = int(now_s / self.step_s + 1e-6) - self.samples
        if due < 1:
            return
        ends_s = (self.samples + 1 + np.arange(due)) * np.float64(self.step_s)
        self.samples += due
        ideal = imu.ideal_increments(
            t_s,
            lab_from_body_wxyz,
            rate_body_rad_s,
            ends_s,
            self.step_s,
            self.position_body_m,
            self.gravity_m_s2,
            self.earth_sensed_rad_s,
        )
        measured = self.imu.measure(ideal)
        self.measured.append(measured)
        self.measured = latest(self.measured, self.kept_s)
        # 2. Navigator, and the mean rate of this period.
        self.navigator.add(measured)
        self.saturated = bool(measured.saturated.any())
        compensation = self.earth_body_rad_s(self.navigator.lab_from_body_wxyz)
        self.rate_rad_s = measured.angle_rad.mean(axis=0) / self.step_s - compensation
        if self.filter:
            # 3. Filter. Its reference is the lab, so the Earth rate is removed at its own attitude estimate.
            compensation = self.earth_body_rad_s(self.attitude_wxyz("filter"))
            self.filter.propagate(
                ends_s, measured.angle_rad - compensation * self.step_s, measured.saturated
            )

    def imu_samples(self, since_s: float = -math.inf) -> imu.Increments:
        """The kept IMU samples of whole control periods from about since_s on."""
        if not self.measured:
            none = np.zeros((0, 3))
            never = np.zeros(0, bool)
            return imu.Increments(np.zeros(0), self.step_s, none, none, never, never)
        first = len(self.measured) - 1
        while first > 0 and self.measured[first - 1].t_s[-1] >= since_s:
            first -= 1
        kept = self.measured[first:]
        columns: Record = {
            name: np.concatenate([getattr(one, name) for one in kept])
            for name in ("t_s", "angle_rad", "velocity_m_s", "saturated", "overloaded")
        }
        return replace(kept[0], **columns)

    def apparent_bias_rad_s(
        self, lab_from_body_wxyz: Floats, rate_body_rad_s: Floats
    ) -> Floats:
        """(3,) error of the measured rate without noise at a true attitude (4,) and rate (3,), in body axes.

        It is the sum of the gyro bias, the scale factor and misalignment errors times the rate, and the Earth rate if
        that is not compensated.
        """
        uncompensated = self.earth_sensed_rad_s - self.earth_compensated_rad_s
        earth = quaternion.apply(quaternion.inverse(lab_from_body_wxyz), uncompensated)
        return (
            self.imu.gyro_bias_rad_s
            + self.imu.gyro.matrix @ rate_body_rad_s
            - rate_body_rad_s
            + earth
        )

    def earth_body_rad_s(self, lab_from_body_wxyz: Floats) -> Floats:
        """(3,) Earth rate to subtract, in body axes; zeros if it is not compensated."""
        return quaternion.apply(
            quaternion.inverse(lab_from_body_wxyz), self.earth_compensated_rad_s
        )

    def update_filter(self, t_s: float, solution: Attitude, camera: int = 0) -> str:
        """Update the filter with a camera's attitude at mid-exposure t_s; return the status of the update.

        Without filter, attitude or covariance the status of the tracker is returned. An error of the time tag rotates
        the attitude along the motion, so its standard deviation s adds s^2 w w^T to the covariance, with the filter's
        rate w.
        """
        if (
            self.filter is None
            or solution.cam_from_ref is None
            or solution.covariance_rad2 is None
        ):
            return solution.status
        # Covariance in body axes.
        body_from_cam = self.body_from_cam[camera]
        R_body_from_cam = body_from_cam.as_matrix()
        covariance = R_body_from_cam @ solution.covariance_rad2 @ R_body_from_cam.T
        turn_rad = self.time_tag_sigma_s * self.filter.rate_rad_s
        covariance += np.outer(turn_rad, turn_rad)
        systematic = solution.systematic_rad2
        if systematic is not None:
            systematic = R_body_from_cam @ systematic @ R_body_from_cam.T
        measured = body_from_cam * solution.cam_from_ref
        return self.filter.update(t_s, measured, covariance, systematic, camera).status

    def attitude_wxyz(self, feedback: str) -> Floats:
        """(4,) lab_from_body from the inertial navigator ("imu") or the filter."""
        if feedback == "imu" or self.filter is None:
            return self.navigator.lab_from_body_wxyz
        return self.filter.ref_from_body_wxyz

    def body_rate_rad_s(self, feedback: str) -> Floats:
        """(3,) body rate in the lab, in body axes, from the same source.

        That of the IMU is the mean over the last control period.
        """
        if feedback == "imu" or self.filter is None:
            return self.rate_rad_s
        return self.filter.rate_rad_s


def build_filter(
    config: FilterConfig, lab_from_body: Rotation, cameras: int = 1
) -> AttitudeFilter:
    """The attitude filter at the start, in SI units; its reference frame is the lab."""
    gyro = GyroModel(
        math.radians(config.arw_deg_sqrt_h) / math.sqrt(HOUR_S),
        math.radians(config.bias_deg_h) / HOUR_S,
        config.bias_time_s,
        config.scale_ppm * PPM,
        config.misalignment_arcsec * ARCSEC_RAD,
        math.radians(config.rate_limit_deg_s or math.inf),
    )
    tracker = TrackerModel(
        config.systematic_arcsec * ARCSEC_RAD,
        config.systematic_time_s,
        math.radians(config.systematic_angle_deg),
        config.mounting_arcsec * ARCSEC_RAD,
        config.mounting_drift_arcsec_sqrt_h * ARCSEC_RAD / math.sqrt(HOUR_S),
    )
    return AttitudeFilter(
        gyro,
        0.0,
        lab_from_body.inv(),
        math.radians(config.start_deg),
        math.radians(config.start_bias_deg_h) / HOUR_S,
        config.floor_arcsec * ARCSEC_RAD,
        config.gate_sigma,
        tracker,
        JumpModel(config.missed_per_h / HOUR_S, config.wrong_share, config.wrong_repeat),
        config.considered,
        cameras,
    )
