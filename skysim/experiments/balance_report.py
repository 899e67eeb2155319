"""Statistics, picture and report of a balance: the estimates by flight beside the simulated vehicle."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimator.calibration.mass_dynamics import (
    INERTIA,
    MOMENT,
    BearingRecord,
    MassEstimate,
    inertia_six,
)
from estimator.calibration.mass_properties import filter_mass
from estimator.core.errors import ImageError
from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.types import Floats, Record
from skysim.experiments.balance_flight import Assumptions, BalanceFlight, largest_tilt_deg
from skysim.experiments.balance_procedure import BalancePlan, Iteration
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
    text_column,
)
from skysim.results.telemetry_report import AXES, EULER, euler_deg

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
    trims = one.flight.vehicle.trims
    mass = one.flight.vehicle.mass
    per_um = 1e6 / mass.mass_kg
    return {
        "flight": number,
        "duration_s": float(one.flight.record.t_s[-1]),
        "frames": one.flight.frames,
        "solved": one.flight.solved,
        "after_contact": one.flight.after_contact,
        "tilt_deg": largest_tilt_deg([one.flight.record]),
        "trim_mm": (1e3 * trims.position_m).tolist(),
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
    try:
        *_, last = filter_mass(one.flight.record, assumptions.lab, assumptions.prior)
    except ImageError as error:
        raise InputError("balance", error) from error
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
    columns = [text_column("what"), *(Column(head, format=".5g") for head in heads)]
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
    files.write_text(folder / "balance.json", files.to_json(statistics))
    report = balance_report(statistics, image, command)
    report.save(folder / "report.html")
    return report
