"""The procedure of `skysim balance`: fly, estimate, move the trim masses, and fly again until the torque is small.

Each estimate is from all flights so far, since the places of the trim masses, and so their part of inertia and moment,
are known. The masses move by -(m r) / m_i along their axes, which would bring the center of mass to the bearing's
center. The gravity torque is at most g |m r|. The vehicle is balanced if this plus two standard deviations is below the
bar.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimator.calibration.mass_dynamics import (
    INERTIA,
    MOMENT,
    BearingRecord,
    MassEstimate,
    inertia_six,
)
from estimator.calibration.mass_properties import estimate_with_noise, filter_mass
from estimator.core.errors import ImageError
from skysim.core import files
from skysim.core.errors import InputError, errors_under, refusing
from skysim.core.types import Floats, Record
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
    largest_tilt_deg,
    with_frames,
)
from skysim.results.plots import png
from skysim.results.report import (
    Block,
    Cell,
    Column,
    Facts,
    Figure,
    Items,
    Report,
    Section,
    Table,
    Text,
    Verdict,
)
from skysim.results.telemetry_report import AXES, EULER, euler_deg
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
        with errors_under(f"balance.{name}"):
            value = quantity(unit, what, example)(text)
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
        with refusing(ImageError, "balance"):  # it does not converge
            estimate = estimate_with_noise(records, assumptions.prior)
        iteration = Iteration(flown, estimate, vehicle.gravity_m_s2, position_m)
        if plan.moves and iteration.torque_bound_nm > plan.torque_bar_nm:
            position_m = balanced_position_m(flown.vehicle, iteration.moment_kg_m, scene)
            iteration = iteration._replace(next_m=position_m)
        yield iteration
        if iteration.torque_bound_nm <= plan.torque_bar_nm:
            return


def assumed(scene: Scene, uncertainty: Uncertainty) -> Assumptions:
    """The assumptions on the vehicle with its trim masses at zero."""
    at_zero = scene.with_values("vehicle", trim=None) if scene.vehicle.trim else scene
    return draw_assumptions(scene, build(at_zero.vehicle), uncertainty)


def in_flight(scene: Scene, plan: BalancePlan, number: int, position_m: Floats) -> Scene:
    """The scene of one flight: trim masses in their places, excitation, frames all the time, and its own noise."""
    scene = scene.with_values(seed=scene.seed + number)
    if scene.vehicle.trim:
        scene = scene.with_values("vehicle.trim", position_m=tuple(map(float, position_m)))
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


# Statistics, picture and report of a balance: the estimates by flight beside the simulated vehicle.


INERTIA_NAMES = ("Jxx", "Jyy", "Jzz", "Jxy", "Jxz", "Jyz")


def statistics(scene: str, plan: BalancePlan, iterations: Sequence[Iteration]) -> Record:
    """All numbers of a balance, SI except where a unit is in the name."""
    last = iterations[-1]
    return {
        "scene": scene,
        "excite": plan.excite,
        "moves": plan.moves,
        "torque_bar_nm": plan.torque_bar_nm,
        "balanced": last.torque_bound_nm <= plan.torque_bar_nm,
        "flights": [flight_row(n, one) for n, one in enumerate(iterations, 1)],
        "estimates": estimate_rows(last.flight, last.estimate),
        "misfit": last.estimate.misfit,
        "nees": nees(last.flight, last.estimate),
    }


def flight_row(number: int, one: Iteration) -> Record:
    """Numbers of one flight; names that begin with `true` are of the simulated vehicle."""
    mass = one.flight.vehicle.mass
    per_um = 1e6 / mass.mass_kg
    return {
        "flight": number,
        "duration_s": one.flight.record.t_s[-1],
        "frames": one.flight.frames,
        "solved": one.flight.solved,
        "after_contact": one.flight.after_contact,
        "tilt_deg": largest_tilt_deg([one.flight.record]),
        "trim_mm": (1e3 * one.flight.vehicle.trims.position_m).tolist(),
        "next_trim_mm": (1e3 * one.next_m).tolist(),
        "offset_um": (per_um * one.moment_kg_m).tolist(),
        "offset_sigma_um": (per_um * one.estimate.sigma[MOMENT]).tolist(),
        "true_offset_um": (1e6 * mass.center_m).tolist(),
        "torque_nm": one.torque_nm,
        "torque_bound_nm": one.torque_bound_nm,
        "true_torque_nm": one.true_torque_nm,
        "misfit": one.estimate.misfit,
    }


def true_values(flight: BalanceFlight) -> Floats:
    """(9,) inertia and moment of the simulated vehicle with its trim masses at zero."""
    vehicle = flight.vehicle
    record = flight.record
    inertia = vehicle.inertia_kg_m2 - record.added_inertia_kg_m2
    moment = vehicle.mass.mass_kg * vehicle.mass.center_m - record.added_moment_kg_m
    return np.concatenate([inertia_six(inertia), moment])


def estimate_rows(flight: BalanceFlight, estimate: MassEstimate) -> list[Record]:
    """One row per mass property, of the vehicle with its trim masses at zero: offsets in micrometers."""
    scale = np.repeat([1.0, 1e6 / flight.vehicle.mass.mass_kg], [6, 3])
    names = (*INERTIA_NAMES, *(f"offset {axis} um" for axis in AXES))
    columns = scale * [estimate.values[:9], estimate.sigma[:9], true_values(flight)]
    return [
        {"what": name, "estimate": value, "sigma": sigma, "truth": truth}
        for name, (value, sigma, truth) in zip(names, columns.T.tolist(), strict=True)
    ]


def nees(flight: BalanceFlight, estimate: MassEstimate) -> float:
    """NEES of the nine mass properties: chi-square with 9 degrees of freedom if their covariance is true."""
    nine = slice(INERTIA.start, MOMENT.stop)
    error = estimate.values[nine] - true_values(flight)
    return float(error @ np.linalg.solve(estimate.covariance[nine, nine], error))


def draw_flights(fig: Any, statistics: Record, record: BearingRecord) -> None:
    """Draw gravity torque and offset of the center of mass flight by flight, and the last flight's attitude."""
    torque, offset, motion = fig.subplots(1, 3)
    rows = statistics["flights"]
    numbers = np.arange(1, len(rows) + 1)
    for key, style, label in (
        ("torque_nm", "o-", "estimate"),
        ("torque_bound_nm", "v--", "bound"),
        ("true_torque_nm", "kx", "simulated vehicle"),
    ):
        torque.semilogy(numbers, [row[key] for row in rows], style, label=label)
    torque.axhline(statistics["torque_bar_nm"], color="0.5", linestyle=":")
    torque.set(xlabel="flight", ylabel="largest gravity torque [N m]", xticks=numbers)
    for axis, name in enumerate(AXES):
        values, sigma = (
            [row[key][axis] for row in rows] for key in ("offset_um", "offset_sigma_um")
        )
        offset.errorbar(numbers, values, sigma, marker="o", capsize=3, label=name)
    offset.set(
        xlabel="flight",
        ylabel="center of mass from the bearing's center [um]",
        xticks=numbers,
        yscale="symlog",
    )
    motion.plot(record.t_s, euler_deg(record.lab_from_body), ".-", label=EULER)
    motion.set(xlabel="t [s]", ylabel="measured attitude [deg]", title=f"flight {len(rows)}")
    for axes in (torque, offset, motion):
        axes.legend(fontsize="small")


def filter_rows(one: Iteration, assumptions: Assumptions) -> list[Record]:
    """As `estimate_rows`, for the filter in flight at the end of one iteration. Raises InputError for few attitudes."""
    with refusing(ImageError, "balance"):
        *_, last = filter_mass(one.flight.record, assumptions.prior)
    return estimate_rows(one.flight, last)


def balance_report(statistics: Record, picture: bytes, command: str) -> Report:
    """The report of a balance with the picture of `draw_flights` as PNG bytes."""
    trims = bool(statistics["flights"][-1]["trim_mm"])
    uncertain = statistics.get("uncertain", [])
    blocks = [
        verdict(statistics),
        Items(uncertain, "Less certain than required", "bad"),
        Facts(
            [("every number of this page", [Cell("balance.json", link="balance.json")])],
            on_terminal=False,
        ),
        Section("Balance", [Figure(picture, CAPTION)]),
        Section(
            "Flights", [Text(FLIGHTS), flight_table(statistics["flights"])], on_terminal=False
        ),
        Section(
            f"{'With the trim masses at zero, from' if trims else 'From'} all flights",
            mass_blocks(statistics["estimates"], trims),
        ),
        Section(
            "By the filter in flight, from the last flight",
            mass_blocks(statistics.get("in_flight", []), trims),
        ),
    ]
    return Report(f"Balance of {statistics['scene']}", blocks, command)


CAPTION = "Gravity torque and offset flight by flight, and the attitude in the last flight."
FLIGHTS = (
    "The center of mass is measured from the bearing's center, with the trim masses where they were in the flight; ± is"
    " 1σ."
)


def verdict(statistics: Record) -> Verdict:
    """Whether the vehicle is balanced, with the torque and its bound."""
    flights = statistics["flights"]
    last = flights[-1]
    frames = sum(one["frames"] for one in flights)
    word = "balanced" if statistics["balanced"] else "not balanced"
    if not statistics["moves"]:
        word = "estimated"
    return Verdict(
        f"{word}: gravity torque at most (estimate and 2σ)"
        f" {last['torque_bound_nm']:.2g} N m, bar {statistics['torque_bar_nm']:.2g} N m; the simulated vehicle's is"
        f" {last['true_torque_nm']:.2g} N m; {len(flights)} flights, {frames} frames; misfit {statistics['misfit']:.2f}"
        " (rms residual over its standard error)",
        "bad" if word == "not balanced" else "good",
    )


def flight_table(flights: Sequence[Record]) -> Table:
    """One row per flight."""
    columns = [
        Column("flight"),
        Column("frames solved"),
        Column("greatest tilt", "°", ".1f"),
        Column("trim masses", "mm"),
        Column("center of mass", "µm"),
        Column("of the simulated vehicle", "µm"),
        Column("gravity torque", "N m", ".2g"),
        Column("at most", "N m", ".2g"),
    ]
    rows = [
        [
            one["flight"],
            f"{one['solved']} / {one['frames']}",
            one["tilt_deg"],
            ", ".join(f"{place:.3f}" for place in one["trim_mm"]),
            offset_text(one),
            ", ".join(f"{value:.3g}" for value in one["true_offset_um"]),
            one["torque_nm"],
            one["torque_bound_nm"],
        ]
        for one in flights
    ]
    return Table(columns, rows)


def offset_text(flight: Record) -> str:
    """The center of mass with its standard deviations."""
    found = zip(flight["offset_um"], flight["offset_sigma_um"], strict=True)
    return ", ".join(f"{value:.3g} ± {sigma:.2g}" for value, sigma in found)


def mass_blocks(rows: Sequence[Record], trims: bool) -> list[Block]:
    """Estimates of the mass properties beside the simulated vehicle's, which may have trim masses."""
    heads = ("estimate", "1σ", "simulated vehicle")
    columns = ["what", *(Column(head, format=".5g") for head in heads)]
    values = [[row[key] for key in ("what", "estimate", "sigma", "truth")] for row in rows]
    for row in values:
        # A true value far below the standard error is rounding.
        row[3] *= abs(row[3]) > 1e-6 * row[2]
        row.append((row[1] - row[3]) / row[2])
    table = Table([*columns, Column("error over 1σ", format=".1f")], values)
    of = ", of the vehicle with its trim masses at zero" if trims else ""
    return [table, Text(f"J in kg m²{of}.")] if rows else []


def write_all(
    folder: Path, statistics: Record, iterations: Sequence[Iteration], command: str
) -> Report:
    """Write picture, JSON and report; their paths are added to the statistics. Returns the report."""
    picture = files.make_folder(folder) / "balance.png"
    last = iterations[-1].flight.record
    image = png(lambda fig: draw_flights(fig, statistics, last), (15, 4.5))
    files.write_bytes(picture, image)
    statistics |= {"picture": str(picture), "report": str(folder / "report.html")}
    files.write_json(folder / "balance.json", statistics)
    report = balance_report(statistics, image, command)
    report.save(folder / "report.html")
    return report
