"""Command `skysim balance`: measure inertia and center of mass with the star tracker, and move the trim masses."""

from __future__ import annotations

import shlex
import sys
from enum import StrEnum
from typing import Annotated

import typer

from skysim.apps.cli.options import Json, Out, Overrides, SceneArg, Seed, load, output_folder
from skysim.apps.cli.terminal import print_json, progress_callback
from skysim.core.errors import InputError


class Excitation(StrEnum):
    """How the vehicle is set in motion."""

    WHEELS = "wheels"
    SWING = "swing"


def balance(
    scene: SceneArg,
    excite: Annotated[
        Excitation, typer.Option(help="Tilt by the wheels at three yaw angles, or let go and swing freely.")
    ] = Excitation.WHEELS,
    estimate_only: Annotated[
        bool, typer.Option("--estimate-only", help="Estimate from one flight; move nothing.")
    ] = False,
    tilt: Annotated[float, typer.Option(min=0.1, max=60, help="Tilt of the excitation, degrees.")] = 8.0,
    torque: Annotated[str, typer.Option(help="Residual gravity torque at which the vehicle is balanced.")] = "5e-5 N m",
    flights: Annotated[int | None, typer.Option(min=1, max=50, help="Flights at most; default: 6.")] = None,
    inertia_bar: Annotated[
        float, typer.Option(min=0.01, help="Standard deviation that moments of inertia must reach, percent.")
    ] = 1.0,
    offset_bar: Annotated[
        str | None,
        typer.Option(help="Standard deviation that the offset must reach; default: half of the torque over weight."),
    ] = None,
    in_flight: Annotated[
        bool, typer.Option("--in-flight", help="Also run the filter in flight over the last flight.")
    ] = False,
    inertia_sigma: Annotated[str, typer.Option(help="Standard error of the assumed inertia, a share.")] = "10%",
    offset_sigma: Annotated[
        str, typer.Option(help="Standard error of the assumed balance, along each axis.")
    ] = "500 um",
    wheel_sigma: Annotated[str, typer.Option(help="Standard error of a wheel's assumed inertia, a share.")] = "0.1%",
    mount_sigma: Annotated[str, typer.Option(help="Standard error of the tracker's axes in the body.")] = "0.03 deg",
    tacho_sigma: Annotated[float, typer.Option(help="Standard error of a reading of a wheel's speed, rpm.")] = 1.0,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """Balance a vehicle on its air bearing: estimate inertia and center of mass, move trim masses, repeat.

    The star tracker is the instrument. Every flight is simulated, its frames are rendered and solved.
    """
    from skysim.apps.cli.balance_summary import print_balance, print_flight
    from skysim.experiments.balance import assumptions, observability, procedure, report

    if estimate_only and flights is not None:
        raise InputError("--flights", "has no effect with --estimate-only", "none")
    uncertainty = assumptions.parse_uncertainty(inertia_sigma, offset_sigma, wheel_sigma, mount_sigma, tacho_sigma)
    bars = procedure.parse_bars(torque, inertia_bar, offset_bar)
    loaded = load(scene, None, seed, set_)
    plan = procedure.Plan(excite.value, tilt, bars.torque_nm, flights or 6, not estimate_only)
    folder, iterations = output_folder(out, loaded.name), []
    with progress_callback("flying") as watch:
        for one in procedure.balance(loaded, plan, uncertainty, watch):
            iterations.append(one)
            if not json:
                print_flight(report.flight_row(len(iterations), one))
    statistics = report.statistics(loaded.name, plan, iterations)
    if in_flight:
        statistics["in_flight"] = report.filter_rows(iterations[-1], procedure.assumed(loaded, uncertainty))
    report.write_all(folder, statistics, iterations, shlex.join(["skysim", *sys.argv[1:]]))
    if json:
        print_json(statistics)
    else:
        print_balance(statistics)
    observability.check_observed(
        iterations[-1].estimate,
        procedure.assumed(loaded, uncertainty).prior,
        [one.flight.record for one in iterations],
        bars.inertia,
        bars.moment_kg_m(iterations[-1].flight.vehicle),
    )
