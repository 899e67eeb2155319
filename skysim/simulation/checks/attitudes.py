"""Attitudes at which a scene is checked: those of its frames, and a sample of those that its motion could reach.

The attitudes of the frames are those of the reference maneuver, or of a constant rate without a controller; their rates
contain the run's jitter. The motion itself is not simulated.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.constants import GOLDEN_ANGLE_RAD
from skysim.core.quaternion import to_rotation
from skysim.core.types import UP, Floats, lengths
from skysim.dynamics import multibody
from skysim.simulation.lab import Lab

MAX_FRAMES = 400  # frames among which the fastest and the most tilted one are sought
FRAMES = 16  # evenly spaced frames that are checked
DIRECTIONS = 48  # attitudes that sample the reach of the motion
SAMPLES = 101  # of the jitter in an exposure
GOLDEN_RATIO = (1 + math.sqrt(5)) / 2


class CheckedAttitudes(NamedTuple):
    """N attitudes.

    Attributes
    ----------
    lab
        Laboratory
    lab_from_body
        N rotations
    rate_body_rad_s
        (N, 3) rates in body axes
    t_s
        (N,) times of the frames; NaN for an attitude that is not of a frame
    """

    lab: Lab
    lab_from_body: Rotation
    rate_body_rad_s: Floats
    t_s: Floats

    @property
    def speed_deg_s(self) -> Floats:
        """(N,) lengths of the rates."""
        return np.degrees(lengths(self.rate_body_rad_s))

    @property
    def tilts_deg(self) -> Floats:
        """(N,) angles between the z axes of body and lab."""
        return multibody.tilt_deg(self.lab_from_body)

    @property
    def boresights(self) -> Floats:
        """(N, 3) unit vectors of the boresight in lab axes."""
        cam_from_body = self.lab.camera.mount.cam_from_body
        return (self.lab_from_body * cam_from_body.inv()).apply(UP)

    @property
    def rates_text(self) -> str:
        """The least and the greatest rate, to 0.001 deg/s."""
        rates_deg_s = self.speed_deg_s.round(3)
        low, high = (f"{rate:.3g}" for rate in (rates_deg_s.min(), rates_deg_s.max()))
        return f"at {low} deg/s" if low == high else f"at {low} to {high} deg/s"

    def describe(self, n: int) -> str:
        """Attitude n in words: RA and Dec of the boresight, or angles and tilt of the vehicle; and the time."""
        t_s = self.t_s[n]
        if self.lab.scene.stars:
            x, y, z = self.boresights[n]
            ra_deg = math.degrees(math.atan2(y, x)) % 360
            dec_deg = math.degrees(math.asin(min(max(z, -1.0), 1.0)))
            where = f"RA {ra_deg:.1f}° Dec {dec_deg:+.1f}°"
        else:
            lab_from_body = self.lab_from_body[n]
            # Adding 0 turns -0 into 0.
            yaw, pitch, roll = np.round(lab_from_body.as_euler("ZYX", degrees=True), 1) + 0.0
            tilt_deg = self.tilts_deg[n]
            where = f"roll {roll:.1f}° pitch {pitch:.1f}° yaw {yaw:.1f}°, a tilt of {tilt_deg:.1f}°"
        return where if math.isnan(t_s) else f"{where} (t = {t_s:.1f} s)"


def of_frames(lab: Lab) -> CheckedAttitudes:
    """Attitudes at mid-exposure of some frames: evenly spaced ones, the fastest and the most tilted."""
    # 1. The reference at many frames.
    scene = lab.scene
    exposure = scene.exposure
    count = exposure.frames
    index = np.unique(np.linspace(0, count - 1, min(count, MAX_FRAMES)).astype(int))
    t_s = exposure.first_s + index / exposure.rate_hz + exposure.time_s / 2
    jitter, _ = jitter_in_exposures(lab, t_s, exposure.time_s)
    if scene.motion.control is None:
        # Without a controller the rate is the initial one.
        rates = lab.start_rate_rad_s
        lab_from_body = lab.start * Rotation.from_rotvec(np.outer(t_s, rates))
    else:
        reference = lab.reference
        states = [reference.state_at(float(t)) for t in t_s]
        wxyz, rates, _ = (np.array(column) for column in zip(*states, strict=True))
        lab_from_body = to_rotation(wxyz)
    every = CheckedAttitudes(lab, lab_from_body, rates + jitter, t_s)
    # 2. Evenly spaced frames, the fastest and the most tilted.
    chosen = set(np.linspace(0, len(index) - 1, min(len(index), FRAMES)).astype(int))
    chosen.add(int(every.speed_deg_s.argmax()))
    chosen.add(int(every.tilts_deg.argmax()))
    rows = np.array(sorted(chosen))
    # 3. Without a controller the vehicle may reach the stop; the frames before are checked.
    if scene.vehicle.mount == "air_bearing":
        free = every.tilts_deg[rows] <= scene.vehicle.tilt_stop_deg
        rows = rows[free] if free.any() else rows[:1]
    return CheckedAttitudes(
        lab, every.lab_from_body[rows], every.rate_body_rad_s[rows], t_s[rows]
    )


def jitter_in_exposures(lab: Lab, t_s: Floats, exposure_s: float) -> tuple[Floats, Floats]:
    """The run's jitter in exposures about N times: (N, 3) mean rate in rad/s, and the rest (N, K, 3) in rad.

    The rest is the rotation relative to one at the mean rate, K samples of zero mean, in body axes.
    """
    vibration = lab.vibration(lab.reference)
    if not vibration.components:
        return np.zeros((len(t_s), 3)), np.zeros((len(t_s), 1, 3))
    after_s = exposure_s * np.linspace(-0.5, 0.5, SAMPLES)
    # `evaluate` wants ascending times.
    phi = np.array([vibration.evaluate(one + after_s)[0] for one in t_s])
    # Whole periods leave rounding errors.
    rate = ((phi[:, -1] - phi[:, 0]) / exposure_s).round(12)
    rest = phi - rate[:, None] * after_s[:, None]
    return rate, rest - rest.mean(axis=1, keepdims=True)


def greatest_tilt_deg(frames: CheckedAttitudes) -> float:
    """The greatest tilt at the frames; without a controller on a bearing, the tilt stop."""
    scene = frames.lab.scene
    if scene.motion.control is None and scene.vehicle.mount == "air_bearing":
        return scene.vehicle.tilt_stop_deg
    return float(frames.tilts_deg.max())


def within_reach(frames: CheckedAttitudes, tilt_deg: float | None = None) -> CheckedAttitudes:
    """A sample of the attitudes in reach: under the stars all, else any azimuth and yaw up to the greatest tilt.

    They have the rates of the frames in turn. Directions are evenly spread on a Fibonacci spiral. The
    rotations about them are multiples of the golden ratio, which spreads them evenly too.

    Parameters
    ----------
    frames
        Attitudes of the frames, with their rates; their greatest tilt is the default
    tilt_deg
        Greatest tilt, for example that of a study's trials; None for `greatest_tilt_deg`
    """
    lab = frames.lab
    n = np.arange(DIRECTIONS)
    turn_rad = 2 * np.pi * np.mod(n / GOLDEN_RATIO, 1.0)
    if lab.scene.stars:
        zenith_rad = np.arccos(1 - 2 * (n + 0.5) / DIRECTIONS)
        lab_from_cam = Rotation.from_euler(
            "ZYZ", np.column_stack([n * GOLDEN_ANGLE_RAD, zenith_rad, turn_rad])
        )
        lab_from_body = lab_from_cam * lab.camera.mount.cam_from_body
    else:
        if tilt_deg is None:
            tilt_deg = greatest_tilt_deg(frames)
        cosine = math.cos(math.radians(tilt_deg))
        # Equal steps of the cosine are equal areas; the last attitude has the greatest tilt.
        tilt_rad = np.arccos(1 - n / (DIRECTIONS - 1) * (1 - cosine))
        azimuth_rad = n * GOLDEN_ANGLE_RAD
        # With a yaw of minus the azimuth, the tilt is about a horizontal axis.
        angles = np.column_stack([azimuth_rad, tilt_rad, turn_rad - azimuth_rad])
        lab_from_body = Rotation.from_euler("ZYZ", angles)
    turn = n % len(frames.t_s)
    rate_body_rad_s = frames.rate_body_rad_s[turn]
    return CheckedAttitudes(lab, lab_from_body, rate_body_rad_s, np.full(DIRECTIONS, np.nan))
