"""What is measured of a motion on an air bearing, what is assumed of it, and what is to be found."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.arrays import Floats
from estimator.core.errors import ImageError

INERTIA = slice(0, 6)
MOMENT = slice(6, 9)
LAB_TORQUE = slice(9, 12)
DRAG = slice(12, 14)
# the wheels' are the last
BIAS = slice(14, 17)
WHEELS = 17
TRIANGLE = (
    (0, 1, 2, 0, 0, 1),
    (0, 1, 2, 1, 2, 2),
)  # rows and columns of the six numbers of an inertia tensor
MIN_ATTITUDES = 4


@dataclass(frozen=True, slots=True)
class BearingRecord:
    """One motion without contact: attitudes of the star tracker, and momenta of the wheels by their speeds.

    t_s                : (N,) ascending times of the attitudes
    lab_from_body      : N measured attitudes
    covariance_rad2    : (N, 3, 3) of their errors, rotation vectors in body axes
    wheel_t_s          : (M,) ascending times of the wheel speeds, over all attitudes' times
    wheel_momentum_nms : (M, n) assumed axial inertia times measured speed
    added_inertia_kg_m2, added_moment_kg_m : (3, 3) and (3,) that trim masses have added to the vehicle since the
        configuration whose mass properties are sought
    systematic_rad2    : (N, 3, 3) the part of covariance_rad2 that attitudes near one another share; None without one
    """

    t_s: Floats
    lab_from_body: Rotation
    covariance_rad2: Floats
    wheel_t_s: Floats
    wheel_momentum_nms: Floats
    added_inertia_kg_m2: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    added_moment_kg_m: Floats = field(default_factory=lambda: np.zeros(3))
    systematic_rad2: Floats | None = None

    def __post_init__(self) -> None:
        if len(self.t_s) < MIN_ATTITUDES:
            raise ImageError(
                f"mass properties: {len(self.t_s)} attitudes; allowed: {MIN_ATTITUDES} or more"
            )
        if not (np.all(np.diff(self.t_s) > 0) and np.all(np.diff(self.wheel_t_s) > 0)):
            raise ImageError("mass properties: times do not ascend")
        if self.t_s[0] < self.wheel_t_s[0] or self.t_s[-1] > self.wheel_t_s[-1]:
            raise ImageError(
                f"mass properties: wheel speeds from {self.wheel_t_s[0]:g} to {self.wheel_t_s[-1]:g} s; allowed: over"
                f" all attitudes, {self.t_s[0]:g} to {self.t_s[-1]:g} s"
            )

    @property
    def noise_rad2(self) -> Floats:
        """(N, 3, 3) the part of covariance_rad2 that is independent from attitude to attitude."""
        return (
            self.covariance_rad2
            if self.systematic_rad2 is None
            else self.covariance_rad2 - self.systematic_rad2
        )

    def with_noise(self, factor: float) -> BearingRecord:
        """The record with its independent part scaled."""
        added = (factor - 1) * self.noise_rad2
        return replace(self, covariance_rad2=self.covariance_rad2 + added)


@dataclass(frozen=True, slots=True)
class Lab:
    """What is known of the lab and of the wheels.

    gravity_m_s2, earth_lab_rad_s : along lab -z; (3,) the Earth's rate
    wheel_axes            : (3, n) in body axes
    torque_rms_nm         : (3,) standard deviation of the random torque (air currents) about each lab axis
    torque_correlation_s  : its correlation time; its autocorrelation is rms^2 exp(-|lag| / correlation)
    wheel_sigma_nms       : standard deviation of a measured wheel momentum, independent from sample to sample
    """

    gravity_m_s2: float
    wheel_axes: Floats
    torque_rms_nm: Floats
    torque_correlation_s: float
    earth_lab_rad_s: Floats = field(default_factory=lambda: np.zeros(3))
    wheel_sigma_nms: float = 0.0


@dataclass(frozen=True, slots=True)
class Prior:
    """Values assumed before, (P,), and their standard deviations.

    In the order: inertia xx, yy, zz, xy, xz, yz about the bearing (kg m2); moment m r, mass times center of mass (3,)
    (kg m); torque constant in the lab (3,) (N m); viscous and quadratic drag (N m s, N m s2); rotation of the
    tracker's body axes from the true ones (3,) (rad); relative error of each wheel's assumed axial inertia (n).
    """

    values: Floats
    sigma: Floats

    def __post_init__(self) -> None:
        if not (np.all(np.isfinite(self.values)) and np.all(self.sigma > 0)):
            raise ImageError(
                "mass properties: assumed values must be finite and their standard deviations above 0"
            )


@dataclass(frozen=True, slots=True)
class MassEstimate:
    """The nine mass properties with their covariance, and the other parameters.

    values, covariance : (P,) and (P, P), in the order of `Prior`
    misfit     : chi-square of the residuals over their number; 1 if noise and torques are as assumed
    iterations : 0 of a recursive estimate;  attitude_factor : by which the attitudes' noise was scaled
    """

    values: Floats
    covariance: Floats
    misfit: float
    iterations: int = 0
    attitude_factor: float = 1.0

    @property
    def inertia_kg_m2(self) -> Floats:
        """(3, 3)"""
        return inertia_matrix(self.values[INERTIA])

    @property
    def moment_kg_m(self) -> Floats:
        """(3,) mass times center of mass from the bearing's center, in body axes."""
        return self.values[MOMENT]

    @property
    def sigma(self) -> Floats:
        """(P,)"""
        return np.sqrt(np.diag(self.covariance))


def inertia_matrix(six: Floats) -> Floats:
    """(3, 3, ...) symmetric matrix of xx, yy, zz, xy, xz, yz (6, ...)."""
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_six(inertia: Floats) -> Floats:
    """(6,) xx, yy, zz, xy, xz, yz of a symmetric (3, 3) matrix."""
    return inertia[TRIANGLE]
