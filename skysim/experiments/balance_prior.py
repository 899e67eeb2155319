"""What is assumed of a vehicle before it is balanced, and how uncertain it is."""

from __future__ import annotations

from dataclasses import dataclass
import numpy as np
from estimator.calibration.mass_dynamics import (Lab, Prior, inertia_six)
from skysim.core.constants import RPM_RAD_S
from skysim.core.errors import InputError
from skysim.core.random_streams import BALANCE, random_stream
from skysim.core.types import Floats
from skysim.core.units import quantities_within
from skysim.dynamics import imu
from skysim.dynamics.multibody import VehicleModel
from skysim.scene.scene import Scene
from collections.abc import Sequence
from estimator.calibration.mass_dynamics import (BearingRecord, MassEstimate, Prior)



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




# Which mass properties a flight has not shown well enough, what was missing, and how much more
# would do.


LEAST_RATE_DEG_S = 0.05  # below which there is no turn to speak of
LEAST_INFORMATION = 1e-3  # of what is needed: below it, more of the same does not help
AXES = "xyz"


def check_observed(
    estimate: MassEstimate,
    prior: Prior,
    records: Sequence[BearingRecord],
    inertia_bar: float,
    moment_bar_kg_m: Floats,
) -> None:
    """Raise InputError, in one line, if moments of inertia or the moment are less certain than asked.

    inertia_bar : standard deviation of a moment of inertia over its value;  moment_bar_kg_m : (3,) standard deviations
    of the components of the moment
    """
    values = estimate.values
    sigma = estimate.sigma
    rate_deg_s = largest_rates_deg_s(records)
    tilt_deg = largest_tilt_deg(records)
    faults = []
    for axis in range(3):
        bar = inertia_bar * abs(values[axis])
        if sigma[axis] > bar:
            known = f"inertia about {AXES[axis]} is known to {100 * sigma[axis] / abs(values[axis]):.3g} %"
            shown = f"after turns of {rate_deg_s[axis]:.2g} deg/s"
            if rate_deg_s[axis] < LEAST_RATE_DEG_S:
                shown = "after no turn about it"
            needed = remedy("turn", sigma[axis], prior.sigma[axis], bar)
            faults.append(f"{known}, not {100 * inertia_bar:.3g} %, {shown}: {needed}")
    for axis in range(3):
        if sigma[6 + axis] > moment_bar_kg_m[axis]:
            known = f"moment along {AXES[axis]} is known to {1e6 * sigma[6 + axis]:.4g} g mm"
            needed = remedy("tilt", sigma[6 + axis], prior.sigma[6 + axis], moment_bar_kg_m[axis])
            faults.append(
                f"{known}, not {1e6 * moment_bar_kg_m[axis]:.3g}, after tilts of {tilt_deg:.1f} deg: {needed}"
            )
    if faults:
        raise InputError(
            "balance", f"{faults[0]}{f' ({len(faults) - 1} more)' if len(faults) > 1 else ''}"
        )


def remedy(motion: str, sigma: float, prior_sigma: float, bar: float) -> str:
    """What would do: the information is that beyond the assumed, which grows with the square of the motion and time."""
    needed = bar**-2 - prior_sigma**-2
    gained = max(sigma**-2 - prior_sigma**-2, 0.0)
    if gained < LEAST_INFORMATION * needed:
        return f"a {motion} is needed that the wheels' known momentum or a known trim weighs"
    factor = needed / gained
    return f"{motion} {np.sqrt(factor):.1f} times as far, or fly {factor:.1f} times as long"


def largest_rates_deg_s(records: Sequence[BearingRecord]) -> Floats:
    """(3,) largest rate about each body axis between two attitudes."""
    rates = [
        np.abs(
            (one.lab_from_body[:-1].inv() * one.lab_from_body[1:]).as_rotvec()
            / np.diff(one.t_s)[:, None]
        )
        for one in records
    ]
    return np.degrees(np.concatenate(rates).max(axis=0))


def largest_tilt_deg(records: Sequence[BearingRecord]) -> float:
    """Largest angle between body z and lab z."""
    cosines = np.concatenate([one.lab_from_body.as_matrix()[:, 2, 2] for one in records])
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())


