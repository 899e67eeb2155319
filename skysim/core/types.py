"""Data passed between the packages: frozen arrays with their shapes, frames and units."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import NDArray as Array  # of numbers of any type
from scipy.spatial.transform import Rotation

from skysim.core.quaternion import from_rotation, interpolate, to_rotation

Floats = Array[np.float64]
Ints = Array[np.int64]
Record = dict[str, Any]  # values by name, as an object in JSON or a row of a table
Bools = Array[np.bool_]
Singles = Array[np.float32]


def lengths(vectors: Floats) -> Floats:
    """(...,) lengths of (..., K) vectors."""
    return np.linalg.norm(vectors, axis=-1)


def normalized(vectors: Floats) -> Floats:
    """(..., K) vectors, divided by their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def around_z(radius: Any, azimuth_rad: Any, z: Any) -> Floats:
    """(..., 3) points at distances from the z axis, azimuths from +x toward +y, and heights; these are broadcast."""
    x = radius * np.cos(azimuth_rad)
    y = radius * np.sin(azimuth_rad)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def polar_rad(places: Floats) -> Floats:
    """(N,) angles of (N, 3) places from +z."""
    return np.arctan2(np.hypot(*places.T[:2]), places[:, 2])


def azimuths_rad(places: Floats) -> Floats:
    """(N,) azimuths of (N, 3) places from +x toward +y."""
    return np.arctan2(places[:, 1], places[:, 0])


def homogeneous(rows: Floats, last: float) -> Floats:
    """(N, K + 1) rows of (N, K) numbers, and a last one that all share."""
    return np.column_stack([rows, np.full(len(rows), last)])


def grid_points(x: Array, y: Array) -> Floats:
    """(N, 2) points of a grid, row by row."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def positive(values: Floats) -> Floats:
    """The values above zero, and NaN for the others."""
    return np.where(values > 0, values, np.nan)


def median(values: Any) -> float:
    """The median of numbers, as a number of Python."""
    return float(np.median(values))


Kind = TypeVar("Kind")


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(kind: type[Kind]) -> type[Kind]:
    """The class as a dataclass whose objects have its fields only, and cannot be changed."""
    return dataclass(frozen=True, slots=True)(kind)


def joined(parts: Sequence[Kind]) -> Kind:
    """Objects of one class, whose fields are columns of equal length, as one: the rows of all, in their order."""
    if len(parts) == 1:
        return parts[0]
    kind: Any = type(parts[0])
    names = getattr(kind, "_fields", kind.__slots__)
    columns = ([getattr(part, name) for part in parts] for name in names)
    return kind(*map(np.concatenate, columns))


def taken(columns: Kind, which: Any) -> Kind:
    """The rows of a named tuple of columns that a mask, indices, a slice or one index select."""
    table: Any = columns
    return table._make(column[which] for column in table)


# Of the lab, and of a level body; in camera axes the boresight.
UP = np.array([0.0, 0.0, 1.0])
ROUNDING = 1e-12  # greater than the rounding error of a cosine


@frozen
class Mount:
    """Position and orientation of the camera on the vehicle.

    Attributes
    ----------
    camera_body_m
        (3,) position of the entrance pupil in the body frame, whose origin is the bearing center
    cam_from_body
        Rotation of the body frame into the camera frame (+x right, +y down, +z boresight)
    """

    camera_body_m: Floats
    cam_from_body: Rotation

    @property
    def body_from_cam(self) -> Rotation:
        """Rotation of the camera frame into the body frame."""
        return self.cam_from_body.inv()

    def toward(self, place: Floats, lab_from_body: Rotation) -> Floats:
        """(N, 3) vectors in camera axes from the pupil to places (N, 4), as in `Sources`, at an attitude."""
        toward_m = place[:, :3] - place[:, 3:] * lab_from_body.apply(self.camera_body_m)
        return (self.cam_from_body * lab_from_body.inv()).apply(toward_m)


@dataclass(frozen=True)
class Trajectory:
    """The vehicle's attitude history, sampled finely enough for interpolation.

    Attributes
    ----------
    t_s
        (N,) strictly increasing times
    lab_from_body
        N rotations
    rate_body_rad_s
        (N, 3) angular velocity of the body in the lab, in body axes
    """

    t_s: Floats
    lab_from_body: Rotation
    rate_body_rad_s: Floats

    @classmethod
    def at_rest(cls, lab_from_body: Rotation, end_s: float) -> "Trajectory":
        """A constant attitude from 0 to end_s."""
        ends = Rotation.concatenate([lab_from_body, lab_from_body])
        return cls(np.array([0.0, end_s]), ends, np.zeros((2, 3)))

    @classmethod
    def at_rate(
        cls, lab_from_body: Rotation, rate_body_rad_s: Floats, at_s: float, t_s: Floats
    ) -> "Trajectory":
        """A constant rate (3,) in body axes, with this attitude at the time at_s; sampled at times (N,)."""
        turned = Rotation.from_rotvec(np.outer(t_s - at_s, rate_body_rad_s))
        return cls(t_s, lab_from_body * turned, np.tile(rate_body_rad_s, (len(t_s), 1)))

    def since(self, begin_s: float) -> "Trajectory":
        """The same motion; if it begins after begin_s, preceded by a rotation at the rate of its start."""
        if self.t_s[0] <= begin_s:
            return self
        before = Trajectory.at_rate(
            self.lab_from_body[0],
            self.rate_body_rad_s[0],
            float(self.t_s[0]),
            np.array([begin_s]),
        )
        return Trajectory(
            np.concatenate([before.t_s, self.t_s]),
            Rotation.concatenate([before.lab_from_body, self.lab_from_body]),
            np.concatenate([before.rate_body_rad_s, self.rate_body_rad_s]),
        )

    @cached_property
    def knots(self) -> tuple[Floats, Floats, Floats, Floats]:
        """What `quaternion.interpolate` takes, computed once; contiguous, so that it is compiled for one layout."""
        rotvec = (self.lab_from_body[:-1].inv() * self.lab_from_body[1:]).as_rotvec()
        t_s, rates_rad_s = map(np.ascontiguousarray, (self.t_s, self.rate_body_rad_s))
        return t_s, from_rotation(self.lab_from_body), rotvec, rates_rad_s

    def attitude_at(self, t_s: float | Floats) -> Rotation:
        """lab_from_body at any time within the history. Raises ValueError outside of it.

        The interpolation is cubic Hermite in the rotation vector from the previous sample, with the rates at both ends.
        Its error is of fourth order in the step.
        """
        t = np.array(t_s, float, ndmin=1)
        if t.min() < self.t_s[0] - 1e-9 or t.max() > self.t_s[-1] + 1e-9:
            raise ValueError(
                f"time {t.min():.6f}..{t.max():.6f} s is outside {self.t_s[0]}..{self.t_s[-1]} s"
            )
        wxyz = interpolate(t, *self.knots)
        return to_rotation(wxyz if np.ndim(t_s) else wxyz[0])

    def means(self, t_s: Floats) -> tuple[Rotation, Floats]:
        """Means of lab_from_body and of the rate in body axes over an interval, from an odd number of even times (K,).

        The mean attitude is the rotation R with the least integral of |R - lab_from_body(t)|^2, by Simpson's rule
        (Markley et al. 2007, J. Guid. Control Dyn. 30, 1193). It also solves Wahba's problem for mean directions.
        """
        weights = np.full(len(t_s), 2.0)
        weights[1::2] = 4.0
        weights[[0, -1]] = 1.0
        attitudes = self.attitude_at(t_s)
        turned = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec().sum(axis=0)
        return attitudes.mean(weights), turned / (t_s[-1] - t_s[0])

    def rate_at(self, t_s: float) -> Floats:
        """(3,) angular velocity in body axes, interpolated linearly."""
        return np.array([np.interp(t_s, self.t_s, rate) for rate in self.rate_body_rad_s.T])


class Mounting(NamedTuple):
    """Rotation of a camera from its assumed mount at K times, in body axes.

    Attributes
    ----------
    estimate_rad, sigma_rad
        (K, 3) estimate of the filter, and its standard deviation
    true_rad
        (K, 3) truth
    """

    estimate_rad: Floats
    sigma_rad: Floats
    true_rad: Floats


@frozen
class Telemetry:
    """True and estimated states of the vehicle at the starts of K control periods; None for missing hardware.

    Attributes
    ----------
    t_s, period_s
        (K,) times, and the control period
    lab_from_body, rate_body_rad_s
        K true attitudes and (K, 3) true rates in body axes, without the added vibration
    torque_nm
        (K, 3) torque commanded by the controller, in body axes; the actuators may give less
    disturbance_nm
        (K, 3) disturbance torque in body axes, without gravity, drag, spring and actuators
    momentum_nms
        (K, 3) momentum stored in wheels and CMGs, in body axes
    wheel_rad_s, gimbal_rad
        (K, n) speeds of the wheels, and angles of the gimbals
    joints
        (K, nq) MuJoCo's positions of all joints, for rendering
    manipulability
        (K,) manipulability of the CMGs: 1 far from a singularity, 0 at a singularity
    lab_from_ref
        K commanded attitudes
    lab_from_imu
        K attitudes of the inertial navigator
    saturated
        (K,) whether the gyros were at their limit in the previous period
    bias_rad_s
        (K, 3) rate error of the gyros: bias, scale, misalignment, and the Earth rate if it is not compensated
    lab_from_filter
        K attitudes of the filter
    sigma_attitude_rad
        (K, 3) its standard deviation of the attitude about the body's axes
    assumed_bias_rad_s, sigma_bias_rad_s
        (K, 3) its estimate of the bias, and the standard deviation of the bias
    mountings
        Mounting states of the filter by name of the camera: "main" relative to the axes of the gyros, the others
        relative to "main"
    loads
        (K,) command, or speed, of each actuator of the controller relative to its limit, by name
    wheel_names, gimbal_names
        Names of the joints of wheels and gimbals
    readings
        Readings of further actuators by name, such as the propellant in kg: (K,) or (K, n)
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
    saturated: Bools | None = None
    bias_rad_s: Floats | None = None
    lab_from_filter: Rotation | None = None
    sigma_attitude_rad: Floats | None = None
    assumed_bias_rad_s: Floats | None = None
    sigma_bias_rad_s: Floats | None = None
    mountings: dict[str, Mounting] = field(default_factory=dict)
    loads: dict[str, Floats] = field(default_factory=dict)
    wheel_names: tuple[str, ...] = ()
    gimbal_names: tuple[str, ...] = ()
    readings: dict[str, Floats] = field(default_factory=dict)


@frozen
class Sources:
    """All light sources, stars and LEDs alike, in lab axes.

    Attributes
    ----------
    id
        (N,) number of the star in its catalog (Hipparcos), or of the LED
    place
        (N, 4) homogeneous coordinates: (direction, 0) for a star at infinity, (x, y, z in m, 1) for an LED
    normal
        (N, 3) unit normal of the emitting disk; zeros for a star
    radius_m
        (N,) radius of the emitting disk; 0 for a star
    strength
        (N,) strength in photo-electrons, which are photons weighted with the detector's quantum efficiency. For a
        star e- s^-1 m^-2 at the aperture; for an LED e- s^-1 sr^-1 along its normal, and `led.Emitter` has its
        decrease with angle and distance
    period_s, start_s, on_s
        (N,) pulse train: lit from start_s for on_s in every period_s of its controller's clock
    clock
        (N,) number of that clock, from 0; the LEDs of a controller share it; 0 for a star
    magnitude
        (N,) V magnitude of a star; NaN for an LED
    motion
        (N, 2, 3) velocity in s^-1 and acceleration in s^-2 of `place` at mid-exposure; None without motion
    chromatic
        (N, 4 + 2 K) means, over the photo-electrons, of the lens's shift of focus in m and of its lateral shift at the
        detector's corner in px, their standard deviations, K lateral shifts about that mean in px, and their shares of
        the light (`photometry.chromatic_moments`); None for a lens without chromatic aberration
    """

    id: Ints
    place: Floats
    normal: Floats
    radius_m: Floats
    strength: Floats
    period_s: Floats
    start_s: Floats
    on_s: Floats
    clock: Ints
    magnitude: Floats
    motion: Floats | None = None
    chromatic: Floats | None = None

    def __len__(self) -> int:
        return len(self.id)

    @property
    def xyz(self) -> Floats:
        """(N, 3) positions of the LEDs in m, and directions of the stars."""
        return self.place[:, :3]

    @property
    def duty(self) -> Floats:
        """(N,) fractions of the time for which they are lit."""
        return np.minimum(self.on_s / self.period_s, 1.0)

    def take(self, which: Array) -> "Sources":
        """The sources selected by a mask or by indices."""
        rows = np.flatnonzero(which) if which.dtype == bool else which
        columns = (getattr(self, name) for name in Sources.__dataclass_fields__)
        chosen: list[Any] = [
            None if column is None else column.take(rows, axis=0) for column in columns
        ]
        return Sources(*chosen)


class StarSources(Sources):
    """Stars sorted for a search by direction, so the time of a frame does not grow with the catalog."""

    @cached_property
    def by_z(self) -> tuple[Ints, Floats]:
        """Rows in ascending order of z, and their directions (N, 3) in this order."""
        order = np.argsort(self.place[:, 2], kind="stable")
        return order, np.ascontiguousarray(self.xyz[order])

    def within(self, direction: Floats, angle_rad: float) -> Ints:
        """Ascending rows of the stars within an angle of a unit vector.

        Stars in a band of z are tested, which takes half of the time of a search tree for the stars of a field.
        """
        # The band contains all directions within the angle.
        order, sorted_place = self.by_z
        from_pole = math.acos(min(max(float(direction[2]), -1.0), 1.0))
        ends = (
            math.cos(min(from_pole + angle_rad, math.pi)),
            math.cos(max(from_pole - angle_rad, 0.0)),
        )
        first, last = np.searchsorted(
            sorted_place[:, 2], (ends[0] - ROUNDING, ends[1] + ROUNDING)
        )
        cosine = math.cos(min(angle_rad, math.pi))
        near = sorted_place[first:last] @ direction >= cosine - ROUNDING
        return np.sort(order[first:last][near])


@frozen
class SourceTruth:
    """The true image of every source that contributed light to the frame.

    Attributes
    ----------
    id
        (N,) numbers of the sources
    xy_px
        (N, 2) image position at mid-exposure; with a rolling shutter that of the middle row
    flux_xy_px
        (N, 2) flux-weighted mean position over the exposure
    electrons
        (N,) mean photo-electrons on the detector
    peak_e
        (N,) mean electrons in the source's brightest pixel
    streak_px
        (N,) length of the path over the exposure; with a rolling shutter that of the first row
    area_px
        (N,) noise-equivalent area (sum s)^2 / sum s^2 of the image
    peak_xy
        (N, 2) brightest pixel
    saturated
        (N,) whether that pixel is expected to be full
    snr
        (N,) signal-to-noise ratio of the electrons over that area, without saturation
    streak_xy_px
        (N, 2) displacement of the image from the beginning to the end of the exposure of its row; NaN if it has no
        image at one of them
    """

    id: Ints
    xy_px: Floats
    flux_xy_px: Floats
    electrons: Floats
    peak_e: Floats
    streak_px: Floats
    area_px: Floats
    peak_xy: Ints
    saturated: Bools
    snr: Floats
    streak_xy_px: Floats = field(default_factory=lambda: np.empty((0, 2)))


@frozen
class BodyTruth:
    """Sun, Moon or a planet in a frame; `id` is its number in the truth of the sources.

    Attributes
    ----------
    ra_deg, dec_deg
        Apparent place of the center of the disc in ICRS axes
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


@frozen
class SatelliteTruth:
    """An artificial satellite in a frame at mid-exposure; `id` is its number in the truth of the sources.

    Attributes
    ----------
    v_mag
        Magnitude with its present illumination
    ra_deg, dec_deg
        Apparent place in ICRS axes
    rate_deg_s
        Rate relative to the stars
    range_km
        Distance from the camera
    phase_deg
        Angle at the satellite between the Sun and the camera; NaN for a random satellite
    sunlit
        Fraction of the Sun's disc that the satellite sees
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


# Attitudes of a `Truth` that are written to files.
ATTITUDES = ("lab_from_body", "cam_from_lab", "mean_lab_from_body", "mean_cam_from_lab")


@frozen
class Truth:
    """The true state behind a frame.

    Attributes
    ----------
    t_s
        Mid-exposure, from the scene's start
    lab_from_body
        Attitude at mid-exposure
    cam_from_lab
        Attitude of the camera at mid-exposure
    mean_lab_from_body
        Mean attitude over the exposure of the middle row, which the frame shows and solutions are compared with. An
        angular acceleration a turns it by a T^2 / 24 from that at mid-exposure
    rate_cam_rad_s
        (3,) angular velocity in camera axes
    mean_rate_cam_rad_s
        (3,) mean of the angular velocity over that exposure
    sources
        Sources on the frame
    hidden
        (M,) ids of sources that are occluded and would otherwise be on the frame at mid-exposure
    bodies
        Sun, Moon and planets on the frame
    satellites
        Artificial satellites on the frame
    """

    t_s: float
    lab_from_body: Rotation
    cam_from_lab: Rotation
    mean_lab_from_body: Rotation
    rate_cam_rad_s: Floats
    mean_rate_cam_rad_s: Floats
    sources: SourceTruth
    hidden: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    bodies: tuple[BodyTruth, ...] = ()
    satellites: tuple[SatelliteTruth, ...] = ()

    @property
    def mean_cam_from_lab(self) -> Rotation:
        """Mean attitude of the camera."""
        return self.cam_from_lab * self.lab_from_body * self.mean_lab_from_body.inv()


@frozen
class Frame:
    """One camera frame.

    Attributes
    ----------
    index
        Number of the frame
    image_dn
        (H, W) image, uint16 from a detector or float64 without noise
    t_mid_s
        Time tag of mid-exposure, from the scene's start
    exposure_s
        Exposure time
    saturation_dn
        Digital number at which the detector saturates
    """

    index: int
    image_dn: Array
    t_mid_s: float
    exposure_s: float
    saturation_dn: float
