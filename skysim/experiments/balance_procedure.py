"""The procedure of `skysim balance`: fly, estimate, move the trim masses, and fly again until the torque is small.

Each estimate is from all flights so far, since the places of the trim masses, and so their part of inertia and moment,
are known. The masses move by -(m r) / m_i along their axes, which would bring the center of mass to the bearing's
center. The gravity torque is at most g |m r|. The vehicle is balanced if this plus two standard deviations is below the
bar.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from estimator.calibration.mass_dynamics import MOMENT, BearingRecord, MassEstimate
from estimator.calibration.mass_properties import estimate_with_noise
from estimator.core.errors import ImageError
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.core.units import quantity
from skysim.dynamics import guidance
from skysim.dynamics.multibody import VehicleModel, build
from skysim.experiments.balance_flight import (
    SWING_S,
    Assumptions,
    BalanceFlight,
    Uncertainty,
    check_scene,
    draw_assumptions,
    excited_by_swing,
    excited_by_wheels,
    fly,
    with_frames,
)
from skysim.experiments.tracker_comparison import with_config
from skysim.scene.scene import Scene
from skysim.simulation.flight import Progress

CONFIDENCE = 2.0  # standard deviations by which the estimated torque must be below the bar
MAX_SHRINK = 1e-6  # smallest eigenvalue of the trim axes' Gram matrix


class BalancePlan(NamedTuple):
    """Plan by which a vehicle is balanced.

    Attributes
    ----------
    excite
        Excitation: wheels or swing
    tilt_deg
        Tilt of the excitation
    torque_bar_nm
        Residual gravity torque to be reached
    max_flights
        Maximum number of flights
    moves
        Whether trim masses are moved; if not, the estimate is from one flight
    longer
        Length of a flight relative to the usual one
    """

    excite: str
    tilt_deg: float
    torque_bar_nm: float
    max_flights: int
    moves: bool
    longer: float = 1.0


class Bars(NamedTuple):
    """Goals: residual torque, and standard deviations of inertia (relative) and offset.

    Attributes
    ----------
    offset_m
        If None, half of the residual torque over the vehicle's weight
    """

    torque_nm: float
    inertia: float
    offset_m: float | None

    def moment_kg_m(self, vehicle: VehicleModel) -> Floats:
        """(3,) standard deviations of mass times center of mass."""
        if self.offset_m is None:
            return np.full(3, self.torque_nm / (CONFIDENCE * vehicle.gravity_m_s2))
        return np.full(3, vehicle.mass.mass_kg * self.offset_m)


def parse_bars(torque: str, inertia_percent: float, offset: str | None) -> Bars:
    """Parse the bars. Raises InputError if one is not a torque or length, or not positive."""

    def positive(name: str, text: str, unit: str, what: str, example: str) -> float:
        try:
            value = quantity(unit, what, example)(text)
        except InputError as error:
            raise error.under(f"balance.{name}") from None
        if not value > 0:
            raise InputError(f"balance.{name}", text, "above 0")
        return value

    torque_nm = positive("torque", torque, "N m", "torque", '"5e-5 N m"')
    offset_m = None
    if offset is not None:
        offset_m = positive("offset_bar", offset, "m", "length", '"1 um"')
    return Bars(torque_nm, inertia_percent / 100, offset_m)


class Iteration(NamedTuple):
    """One flight and the estimate from all flights so far.

    Attributes
    ----------
    estimate
        Estimate for the vehicle with its trim masses at zero
    next_m
        (n,) next places of the trim masses; the present ones if they stay
    """

    flight: BalanceFlight
    estimate: MassEstimate
    gravity_m_s2: float
    next_m: Floats

    @property
    def moment_kg_m(self) -> Floats:
        """(3,) estimated mass times center of mass, with the trim masses as flown."""
        return self.estimate.moment_kg_m + self.flight.record.added_moment_kg_m

    @property
    def torque_nm(self) -> float:
        """Estimate of the largest gravity torque at any attitude, g |m r|."""
        return float(self.gravity_m_s2 * np.linalg.norm(self.moment_kg_m))

    @property
    def torque_bound_nm(self) -> float:
        """Largest gravity torque with CONFIDENCE standard deviations added in the worst direction."""
        worst = float(np.linalg.eigvalsh(self.estimate.covariance[MOMENT, MOMENT])[2])
        return self.torque_nm + CONFIDENCE * self.gravity_m_s2 * math.sqrt(worst)

    @property
    def true_torque_nm(self) -> float:
        """Largest gravity torque of the simulated vehicle."""
        mass = self.flight.vehicle.mass
        return float(self.gravity_m_s2 * mass.mass_kg * np.linalg.norm(mass.center_m))


def balance(
    scene: Scene, plan: BalancePlan, uncertainty: Uncertainty, watch: Progress | None = None
) -> Iterator[Iteration]:
    """Yield each flight's iteration until the torque is below the bar, or max_flights are flown.

    Raises
    ------
    InputError
        For a vehicle that cannot be balanced in this way.
    """
    check_scene(scene)
    vehicle = build(scene.vehicle)
    if plan.moves and not len(vehicle.trims):
        raise InputError(
            "vehicle.trim",
            "none, so nothing can be moved",
            "joints trim_* in the vehicle's file and vehicle.trim, or an estimate only",
        )
    assumptions = assumed(scene, uncertainty)
    records = list[BearingRecord]()
    position_m = vehicle.trims.position_m
    for number in range(plan.max_flights if plan.moves else 1):
        flown = fly(
            in_flight(scene, plan, number, position_m), assumptions, uncertainty, watch
        )
        records.append(flown.record)
        try:
            estimate = estimate_with_noise(records, assumptions.lab, assumptions.prior)
        except ImageError as error:  # it does not converge
            raise InputError("balance", error) from error
        iteration = Iteration(flown, estimate, vehicle.gravity_m_s2, position_m)
        if plan.moves and iteration.torque_bound_nm > plan.torque_bar_nm:
            position_m = balanced_position_m(flown.vehicle, iteration.moment_kg_m, scene)
            iteration = iteration._replace(next_m=position_m)
        yield iteration
        if iteration.torque_bound_nm <= plan.torque_bar_nm:
            return


def assumed(scene: Scene, uncertainty: Uncertainty) -> Assumptions:
    """The assumptions on the vehicle with its trim masses at zero."""
    at_zero = with_config(scene, "vehicle", trim=None) if scene.vehicle.trim else scene
    return draw_assumptions(scene, build(at_zero.vehicle), uncertainty)


def in_flight(scene: Scene, plan: BalancePlan, number: int, position_m: Floats) -> Scene:
    """The scene of one flight: trim masses in their places, excitation, frames all the time, and its own noise."""
    scene = scene.model_copy(update={"seed": scene.seed + number})
    if scene.vehicle.trim:
        scene = with_config(scene, "vehicle.trim", position_m=tuple(map(float, position_m)))
    if plan.excite == "swing":
        return with_frames(
            excited_by_swing(scene, plan.tilt_deg, number),
            plan.longer * SWING_S,
        )
    scene = excited_by_wheels(scene, build(scene.vehicle), plan.tilt_deg, plan.longer)
    return with_frames(scene, guidance.plan(scene.motion).duration_s)


def balanced_position_m(vehicle: VehicleModel, moment_kg_m: Floats, scene: Scene) -> Floats:
    """(n,) places of the trim masses that cancel a (3,) moment as flown. Raises InputError beyond their travel."""
    trims = vehicle.trims
    config = scene.vehicle.trim
    assert config is not None
    lever = trims.axes * trims.mass_kg
    if np.linalg.matrix_rank(lever, tol=MAX_SHRINK) < 3:
        raise InputError(
            "vehicle.trim",
            f"{', '.join(trims.names)} do not move the center of mass along all axes",
            "three slides in independent directions",
        )
    position_m = trims.position_m - np.linalg.pinv(lever) @ moment_kg_m
    worst = int(np.argmax(np.abs(position_m)))
    if abs(position_m[worst]) > config.travel_m:
        excess_kg_m = trims.mass_kg[worst] * (abs(position_m[worst]) - config.travel_m)
        raise InputError(
            "balance",
            f"{trims.names[worst]} would have to go to {1e3 * position_m[worst]:.1f} mm",
            f"vehicle.trim.travel {1e3 * config.travel_m:g} mm: first move ballast along its axis, by"
            f" {1e6 * excess_kg_m:.3g} g mm",
        )
    return position_m
