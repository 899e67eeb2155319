"""Data passed between the packages: frozen arrays with their shapes, frames and units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.jit import jit
from skysim.core.quaternion import interpolate

Floats = NDArray[np.float64]
ROUNDING = 1e-12  # more than the rounding errors of a cosine


@dataclass(frozen=True, slots=True)
class Mount:
    """Position and orientation of the camera on the vehicle.

    Attributes
    ----------
    camera_body_m
        (3,) entrance pupil in the body frame, whose origin is the bearing center
    cam_from_body
        Rotation of the body frame into the camera frame (+x right, +y down, +z boresight)
    """

    camera_body_m: Floats
    cam_from_body: Rotation


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The vehicle's attitude history, sampled finely enough for interpolation.

    Attributes
    ----------
    t_s
        (N,) strictly increasing
    lab_from_body
        N rotations
    rate_body_rad_s
        (N, 3) angular velocity of body in lab, in body axes
    """

    t_s: Floats
    lab_from_body: Rotation
    rate_body_rad_s: Floats
    _segments: list[tuple[Floats, Floats]] = field(init=False, repr=False, default_factory=list)

    @classmethod
    def at_rest(cls, lab_from_body: Rotation, end_s: float) -> Trajectory:
        """A constant attitude from 0 to end_s."""
        ends = Rotation.concatenate([lab_from_body, lab_from_body])
        return cls(np.array([0.0, end_s]), ends, np.zeros((2, 3)))

    @classmethod
    def at_rate(
        cls, lab_from_body: Rotation, rate_body_rad_s: Floats, at_s: float, t_s: Floats
    ) -> Trajectory:
        """A constant rate (3,) in body axes, with this attitude at at_s; sampled at times (N,)."""
        turned = Rotation.from_rotvec(np.outer(t_s - at_s, rate_body_rad_s))
        return cls(t_s, lab_from_body * turned, np.tile(rate_body_rad_s, (len(t_s), 1)))

    def since(self, begin_s: float) -> Trajectory:
        """The same motion; if it begins later than that, after a turn at the rate of its start."""
        if self.t_s[0] <= begin_s:
            return self
        before = Trajectory.at_rate(
            self.lab_from_body[0], self.rate_body_rad_s[0], float(self.t_s[0]), np.array([begin_s])
        )
        return Trajectory(
            np.concatenate([before.t_s, self.t_s]),
            Rotation.concatenate([before.lab_from_body, self.lab_from_body]),
            np.concatenate([before.rate_body_rad_s, self.rate_body_rad_s]),
        )

    def hermite_segments(self) -> tuple[Floats, Floats]:
        """Attitudes (N, 4) as wxyz and hermite_rad (N - 1, 3, 3) for `quaternion.interpolate`; computed once."""
        if not self._segments:
            step = np.diff(self.t_s)[:, None]
            rotvec = (self.lab_from_body[:-1].inv() * self.lab_from_body[1:]).as_rotvec()
            begin = self.rate_body_rad_s[:-1] * step
            end = self.rate_body_rad_s[1:] * step
            # d(rotvec)/dt = omega + rotvec x omega / 2 + ...: the rotation vector is from the previous sample.
            end = end + np.cross(rotvec, end) / 2
            wxyz = self.lab_from_body.as_quat(scalar_first=True)
            self._segments.append((wxyz, np.stack([rotvec, begin, end], axis=1)))
        return self._segments[0]

    def attitude_at(self, t_s: float | Floats) -> Rotation:
        """lab_from_body at any time within the history.

        Cubic Hermite in the rotation vector from the previous sample, with the rates at both ends: exact to fourth
        order in the step. Raises ValueError outside the history.
        """
        t = np.atleast_1d(np.asarray(t_s, dtype=float))
        if t.min() < self.t_s[0] - 1e-9 or t.max() > self.t_s[-1] + 1e-9:
            raise ValueError(
                f"time {t.min():.6f}..{t.max():.6f} s is outside {self.t_s[0]}..{self.t_s[-1]} s"
            )
        k = np.minimum(
            np.maximum(np.searchsorted(self.t_s, t, side="right") - 1, 0), len(self.t_s) - 2
        )
        fraction = (t - self.t_s[k]) / (self.t_s[k + 1] - self.t_s[k])
        lab_from_body = Rotation.from_quat(
            interpolate(*self.hermite_segments(), k, fraction), scalar_first=True
        )
        return lab_from_body if np.ndim(t_s) else lab_from_body[0]

    def rate_at(self, t_s: float) -> Floats:
        """(3,) angular velocity in body axes, interpolated linearly."""
        return np.array([np.interp(t_s, self.t_s, rate) for rate in self.rate_body_rad_s.T])


class Mounting(NamedTuple):
    """Rotation of a camera from its assumed mount in body axes: the filter's estimate, its sigma, the truth; (K, 3)."""

    estimate_rad: Floats
    sigma_rad: Floats
    true_rad: Floats


@dataclass(frozen=True, slots=True)
class Telemetry:
    """True and estimated states of the vehicle at K ticks of its computer; None for what it does not have.

    Attributes
    ----------
    t_s
        (K,); period_s between them
    lab_from_body
        K, the truth, without the added jitter; rate_body_rad_s (K, 3) likewise
    lab_from_ref
        K, the commanded attitude
    torque_nm
        (K, 3) torque demanded by the controller, in body axes
    disturbance_nm
        (K, 3) disturbance torque, without gravity, drag, spring and actuators
    momentum_nms
        (K, 3) stored in wheels and CMGs, in body axes
    wheel_rad_s, gimbal_rad
        (K, n)
    joints
        (K, nq) MuJoCo's positions of all joints, for rendering
    manipulability
        (K,) of the CMGs: 1 far from a singularity, 0 at one
    lab_from_imu
        K, the navigator's attitude
    saturated
        (K,) whether the gyros were at their limit in the previous tick
    bias_rad_s
        (K, 3) rate error of the gyros: bias, scale, misalignment, and the Earth rate if not
        compensated
    lab_from_filter
        K, the filter's attitude; sigma_attitude_rad (K, 3) its standard deviation about the
        body's axes; assumed_bias_rad_s (K, 3) its bias estimate, sigma_bias_rad_s (K, 3) the
        bias's standard deviation
    mountings
        By name of the camera, where the filter has these states: "main" relative to the gyro's
        axes, the others relative to "main"
    """

    t_s: Floats
    period_s: float
    lab_from_body: Rotation
    rate_body_rad_s: Floats
    torque_nm: Floats
    disturbance_nm: Floats
    momentum_nms: Floats
    wheel_rad_s: Floats
    gimbal_rad: Floats
    joints: Floats
    manipulability: Floats | None = None
    lab_from_ref: Rotation | None = None
    lab_from_imu: Rotation | None = None
    saturated: NDArray[np.bool_] | None = None
    bias_rad_s: Floats | None = None
    lab_from_filter: Rotation | None = None
    sigma_attitude_rad: Floats | None = None
    assumed_bias_rad_s: Floats | None = None
    sigma_bias_rad_s: Floats | None = None
    mountings: dict[str, Mounting] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Sources:
    """All light sources, stars and LEDs alike, in lab axes.

    Attributes
    ----------
    id
        (N,) number of the star in its catalog (Hipparcos'), or LED number
    place
        (N, 4) homogeneous: (direction, 0) for a star at infinity, (x, y, z in m, 1) for an LED
    normal
        (N, 3) unit normal of the emitting disk; zeros for a star
    radius_m
        (N,) radius of the emitting disk; 0 for a star
    strength
        (N,) in photo-electrons, that is photons weighted with the chip's quantum efficiency at
        each wavelength: star: e- s^-1 m^-2 at the aperture; LED: e- s^-1 sr^-1 along its
        normal. Its decrease with angle and distance is given by `led.Emitter`
    period_s, start_s, on_s
        (N,) pulse train: lit from start_s for on_s in every period_s, by its controller's clock
    clock
        (N,) number of that clock, from 0; LEDs of one controller share it; 0 for a star
    magnitude
        (N,) V magnitude of a star; NaN for an LED
    motion
        (N, 2, 3) velocity s^-1 and acceleration s^-2 of `place` at mid-exposure; None where
        nothing moves
    chromatic
        (N, 4) mean and standard deviation, over the light's photo-electrons, of the lens's
        shift of focus in m and of its shift at the chip's corner in px; None for a lens without
        chromatic aberration
    """

    id: NDArray[np.int64]
    place: Floats
    normal: Floats
    radius_m: Floats
    strength: Floats
    period_s: Floats
    start_s: Floats
    on_s: Floats
    clock: NDArray[np.int64]
    magnitude: Floats
    motion: Floats | None = None
    chromatic: Floats | None = None

    def __len__(self) -> int:
        return len(self.id)

    def take(self, which: NDArray[Any]) -> Sources:
        """The chosen sources, by mask or index."""
        rows = np.flatnonzero(which) if which.dtype == bool else which
        columns = (getattr(self, name) for name in Sources.__slots__)
        chosen: list[Any] = [
            None if column is None else column.take(rows, axis=0) for column in columns
        ]
        return Sources(*chosen)


class StarSources(Sources):
    """Stars alone, which are found by direction: the time of a frame does not grow with the catalog."""

    @cached_property
    def by_z(self) -> tuple[NDArray[np.int64], Floats]:
        """Rows in the order of z, and their (N, 3) directions in it."""
        order = np.argsort(self.place[:, 2], kind="stable")
        return order, np.ascontiguousarray(self.place[order, :3])

    def within(self, direction: Floats, angle_rad: float) -> NDArray[np.int64]:
        """Rows, in order, of the stars within an angle of a unit vector: those of a band in z are tested.

        The band is read from end to end, in half of the time in which a search tree finds the stars of a field.
        """
        order, sorted_place = self.by_z
        from_pole = math.acos(min(max(float(direction[2]), -1.0), 1.0))
        ends = (
            math.cos(min(from_pole + angle_rad, math.pi)),
            math.cos(max(from_pole - angle_rad, 0.0)),
        )
        first, last = np.searchsorted(sorted_place[:, 2], (ends[0] - ROUNDING, ends[1] + ROUNDING))
        chord = 2.0 * math.sin(min(angle_rad, math.pi) / 2.0)
        return np.sort(
            order[first + _closer(sorted_place[first:last], np.asarray(direction), chord)]
        )


@jit
def _closer(place: Floats, direction: Floats, chord: float) -> NDArray[np.int64]:
    """Which of (N, 3) unit vectors are at most a chord from another one."""
    found = np.empty(len(place), np.int64)
    count = 0
    for n in range(len(place)):
        x = place[n, 0] - direction[0]
        y = place[n, 1] - direction[1]
        z = place[n, 2] - direction[2]
        found[count] = n
        count += x * x + y * y + z * z <= chord * chord
    return found[:count]


def with_sources(parts: Sequence[Sources]) -> Sources:
    """All sources of several sets of which none moves, in their order."""
    columns = {name: [getattr(part, name) for part in parts] for name in Sources.__slots__}
    return Sources(
        **{name: np.concatenate(own) for name, own in columns.items() if own[0] is not None}
    )


@dataclass(frozen=True, slots=True)
class SourceTruth:
    """The true image of every source that contributed light to the frame.

    Attributes
    ----------
    id
        (N,)
    xy_px
        (N, 2) pixel at mid-exposure; with a rolling shutter that of the middle row
    flux_xy_px
        (N, 2) flux-weighted mean pixel over the exposure
    electrons
        (N,) mean photo-electrons on the chip
    peak_e
        (N,) mean electrons in the source's brightest pixel
    streak_px
        (N,) path length over the exposure; with a rolling shutter that of the first row
    area_px
        (N,) noise-equivalent area (sum s)^2 / sum s^2 of its image
    peak_xy
        (N, 2) the brightest pixel
    saturated
        (N,) whether that pixel is expected to be full
    snr
        (N,) signal-to-noise ratio of its electrons over that area, without saturation
    streak_xy_px
        (N, 2) displacement of the image from the begin to the end of the exposure of the row
        that it is on; NaN where it has no image at one of them
    """

    id: NDArray[np.int64]
    xy_px: Floats
    flux_xy_px: Floats
    electrons: Floats
    peak_e: Floats
    streak_px: Floats
    area_px: Floats
    peak_xy: NDArray[np.int64]
    saturated: NDArray[np.bool_]
    snr: Floats
    streak_xy_px: Floats = field(default_factory=lambda: np.empty((0, 2)))


@dataclass(frozen=True, slots=True)
class BodyTruth:
    """Sun, Moon or a planet in a frame, none of which is in a star catalog; `id` is its number in the sources' truth.

    Attributes
    ----------
    ra_deg, dec_deg
        Apparent place of the disc's center in ICRS axes
    phase_deg
        Angle at the body between the Sun and the observer
    """

    id: int
    name: str
    v_mag: float
    ra_deg: float
    dec_deg: float
    diameter_arcsec: float
    phase_deg: float


@dataclass(frozen=True, slots=True)
class SatelliteTruth:
    """An artificial satellite in a frame, at mid-exposure; `id` is its number in the sources' truth.

    Attributes
    ----------
    v_mag
        As it is lit
    sunlit
        Part of the Sun's disc that the satellite sees
    ra_deg, dec_deg
        Apparent place in ICRS axes
    rate_deg_s
        Against the stars
    range_km
        From the camera
    phase_deg
        Angle at the satellite between the Sun and the camera; NaN for a random one
    """

    id: int
    name: str
    v_mag: float
    ra_deg: float
    dec_deg: float
    rate_deg_s: float
    range_km: float
    phase_deg: float
    sunlit: float


@dataclass(frozen=True, slots=True)
class Truth:
    """The true state behind a frame.

    Attributes
    ----------
    t_s
        mid-exposure, seconds from the scene's start
    lab_from_body
        Attitude at mid-exposure
    cam_from_lab
        The camera's attitude at mid-exposure
    rate_cam_rad_s
        (3,) angular velocity in camera axes
    sources
        The sources on the frame
    hidden
        (M,) ids of sources that are occluded and would otherwise be on the frame at
        mid-exposure
    bodies
        Sun, Moon and planets on the frame
    satellites
        Artificial satellites on the frame
    """

    t_s: float
    lab_from_body: Rotation
    cam_from_lab: Rotation
    rate_cam_rad_s: Floats
    sources: SourceTruth
    hidden: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    bodies: tuple[BodyTruth, ...] = ()
    satellites: tuple[SatelliteTruth, ...] = ()


@dataclass(frozen=True, slots=True)
class Frame:
    """One camera frame: image_dn (H, W), uint16 from a detector or float64 when every noise is off."""

    index: int
    image_dn: NDArray[Any]
    t_mid_s: float
    exposure_s: float
    saturation_dn: float


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One frame of a run for the report: angles in degrees, errors in arcseconds, times in ms.

    Attributes
    ----------
    truth_deg, estimate_deg
        (RA, Dec, roll) of the camera under the stars, (roll, pitch, yaw) of the vehicle under
        the dome
    wrong
        Solved, but off by more than ten arcminutes and by more than the tracker claims
        (`metrics.is_wrong`)
    cross_sigma_arcsec, roll_sigma_arcsec
        Standard deviations that the tracker claims
    log10_chance
        Of its matches
    rate_error_deg_s
        Angular rate of the camera by the tracker minus the truth, length of the vector; of the
        two signs the nearer one if the tracker does not know the sign
    rate_sigma_deg_s
        That it claims
    filter
        Verdict of the attitude filter on the solution; empty without a filter
    """

    frame: int
    t_s: float
    rate_deg_s: float
    status: str
    truth_deg: tuple[float, float, float]
    estimate_deg: tuple[float, float, float] | None
    cross_arcsec: float
    roll_arcsec: float
    detected: int
    matched: int
    rms_px: float
    time_ms: float
    wrong: bool
    filter: str = ""
    cross_sigma_arcsec: float = float("nan")
    roll_sigma_arcsec: float = float("nan")
    log10_chance: float = float("nan")
    exposure_s: float = float("nan")
    rate_error_deg_s: float = float("nan")
    rate_sigma_deg_s: float = float("nan")
