"""What is assumed of a vehicle before it is balanced, and how uncertain it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.calibration.mass_properties.record import Lab, Prior, inertia_six
from skysim.core.constants import RPM_RAD_S
from skysim.core.errors import InputError
from skysim.core.random_streams import BALANCE, random_stream
from skysim.core.types import Floats
from skysim.core.units import quantities_within
from skysim.dynamics import imu
from skysim.dynamics.multibody import VehicleModel
from skysim.scene.scene import Scene

PARAMETERS = 17  # beside the wheels' relative errors
LAB_TORQUE_SHARE = (
    0.05  # standard deviation of the constant lab torque, relative to the offset's torque
)
DRAG_RATE_RAD_S = 0.1  # at which the drag's standard deviation is as large as that torque
LEAST_TORQUE_NM = 1e-7  # rms of the random torque that is always assumed
DEFAULT_CORRELATION_S = 2.0
MAX_TACHO_RPM = 1000.0

# Unit, quantity, example, minimum and maximum.
RANGES = {
    "inertia_sigma": ("", "share", '"10%"', 1e-3, 0.5),
    "offset_sigma": ("m", "length", '"300 um"', 1e-7, 0.01),
    "wheel_sigma": ("", "share", '"0.1%"', 1e-6, 0.1),
    "mount_sigma": ("rad", "plane angle", '"0.03 deg"', 1e-8, 0.1),
}


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Standard deviations of what is assumed, all Gaussian.

    inertia_sigma : of each moment of inertia, relative to their mean; products have half of it
    offset_sigma_m : of the center of mass along each axis, assumed at the bearing's center
    wheel_sigma   : of each wheel's axial inertia, relative
    mount_sigma_rad : of the tracker's axes in the body, about each axis, assumed as known
    tacho_sigma_rad_s : of every reading of a wheel's speed
    """

    inertia_sigma: float
    offset_sigma_m: float
    wheel_sigma: float
    mount_sigma_rad: float
    tacho_sigma_rad_s: float


def parse_uncertainty(
    inertia_sigma: str,
    offset_sigma: str,
    wheel_sigma: str,
    mount_sigma: str,
    tacho_sigma_rpm: float,
) -> Uncertainty:
    """Parse quantities with units. Raises InputError for an invalid or out-of-range value."""
    texts = inertia_sigma, offset_sigma, wheel_sigma, mount_sigma
    inertia, offset_m, wheel, mount_rad = quantities_within("balance", RANGES, texts)
    if not 0 <= tacho_sigma_rpm <= MAX_TACHO_RPM:
        raise InputError(
            "balance.tacho_sigma", f"{tacho_sigma_rpm:g}", f"0 to {MAX_TACHO_RPM:g} rpm"
        )
    return Uncertainty(inertia, offset_m, wheel, mount_rad, tacho_sigma_rpm * RPM_RAD_S)


@dataclass(frozen=True, slots=True)
class Assumptions:
    """What the lab assumes of a vehicle with its trim masses at zero.

    prior : of the parameters (`estimator.calibration.mass_properties`)
    lab   : gravity, the Earth's rate, wheel axes, level of the random torque
    wheel_inertia_kg_m2 : (n,) assumed axial inertias
    """

    prior: Prior
    lab: Lab
    wheel_inertia_kg_m2: Floats


def draw_assumptions(scene: Scene, at_zero: VehicleModel, uncertainty: Uncertainty) -> Assumptions:
    """Draw the errors of inertia and wheels from the scene's seed; offset, lab torque and drag are assumed as zero.

    The level of air currents is assumed as in the scene, or LEAST_TORQUE_NM.
    """
    rng = random_stream(scene.seed, BALANCE, 0)
    count = len(at_zero.wheels)
    true_kg_m2 = at_zero.inertia_kg_m2
    inertia_sigma = uncertainty.inertia_sigma * np.trace(true_kg_m2) / 3 * np.repeat([1.0, 0.5], 3)
    moment_kg_m = at_zero.mass.mass_kg * uncertainty.offset_sigma_m
    torque_nm = LAB_TORQUE_SHARE * moment_kg_m * at_zero.gravity_m_s2
    drag = torque_nm / DRAG_RATE_RAD_S ** np.array([1, 2])
    sigma = np.concatenate(
        [
            inertia_sigma,
            np.full(3, moment_kg_m),
            np.full(3, torque_nm),
            drag,
            np.full(3, uncertainty.mount_sigma_rad),
            np.full(count, uncertainty.wheel_sigma),
        ]
    )
    values = np.zeros(PARAMETERS + count)
    values[:6] = inertia_six(true_kg_m2) + inertia_sigma * rng.standard_normal(6)
    wheels = at_zero.wheels.inertia_kg_m2
    assumed_wheels = wheels / (1 + uncertainty.wheel_sigma * rng.standard_normal(count))
    return Assumptions(Prior(values, sigma), known_lab(scene, at_zero, uncertainty), assumed_wheels)


def known_lab(scene: Scene, vehicle: VehicleModel, uncertainty: Uncertainty) -> Lab:
    """The lab as the estimator assumes it."""
    disturbances = scene.vehicle.disturbances
    air = disturbances.air_current
    earth = imu.earth_rate_lab_rad_s(scene.site)
    return Lab(
        vehicle.gravity_m_s2,
        vehicle.wheels.axes,
        np.maximum(air.rms_nm if air else 0.0, LEAST_TORQUE_NM) * np.ones(3),
        air.correlation_s if air else DEFAULT_CORRELATION_S,
        earth * disturbances.earth_rotation,
        float(np.max(vehicle.wheels.inertia_kg_m2, initial=0.0)) * uncertainty.tacho_sigma_rad_s,
    )
