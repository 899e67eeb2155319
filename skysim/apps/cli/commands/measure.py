"""Commands that measure hardware: `skysim balance`, `characterize` for the camera, `calibrate` for its LEDs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Option

from skysim.apps.cli.commands.camera import complete_camera
from skysim.apps.cli.options import (
    Json,
    Out,
    Overrides,
    SceneArg,
    Seed,
    command_line,
    given_options,
    load,
    output_folder,
)
from skysim.apps.cli.terminal import print_json, progress, progress_callback
from skysim.core.errors import InputError
from skysim.results.report import print_wrapped

if TYPE_CHECKING:
    from skysim.core.types import Record
    from skysim.experiments.balance_flight import Uncertainty
    from skysim.experiments.balance_procedure import BalancePlan, Iteration
    from skysim.results.report import Report
    from skysim.scene.scene import Scene


def balance(
    scene: SceneArg,
    excite: Literal["wheels", "swing"] = "wheels",
    estimate_only: bool = False,
    tilt: Annotated[float, Option(min=0.1, max=60)] = 8.0,
    longer: Annotated[float, Option(min=0.1, max=100)] = 1.0,
    torque: str = "5e-5 N m",
    flights: Annotated[int | None, Option(min=1, max=50)] = None,
    inertia_bar: Annotated[float, Option(min=0.01)] = 1.0,
    offset_bar: str | None = None,
    in_flight: bool = False,
    # The errors of the onboard model before the first flight.
    inertia_sigma: str = "10%",
    offset_sigma: str = "500 um",
    wheel_sigma: str = "0.1%",
    mount_sigma: str = "0.03 deg",
    tacho_sigma: float = 1.0,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """Balance a vehicle on its air bearing: estimate inertia and center of mass, move trim masses, repeat.

    The star tracker is the instrument. Every flight is simulated, its frames are rendered and solved.

    Parameters
    ----------
    excite
        Tilt by the wheels at three yaw angles, or let go and swing freely.
    estimate_only
        Estimate from one flight; move nothing.
    tilt
        Tilt of the excitation, degrees.
    longer
        Length of a flight, times the usual one.
    torque
        Residual gravity torque at which the vehicle is balanced.
    flights
        Flights at most; default: 6.
    inertia_bar
        Standard deviation that moments of inertia must reach, percent.
    offset_bar
        Standard deviation that the offset must reach; default: half of the torque over weight.
    in_flight
        Also run the filter in flight over the last flight.
    inertia_sigma
        Standard error of the assumed inertia, a share.
    offset_sigma
        Standard error of the assumed balance, along each axis.
    wheel_sigma
        Standard error of a wheel's assumed inertia, a share.
    mount_sigma
        Standard error of the tracker's axes in the body.
    tacho_sigma
        Standard error of a reading of a wheel's speed, rpm.
    """
    from skysim.experiments import balance_flight, balance_procedure

    if estimate_only and flights is not None:
        raise InputError("--flights", "has no effect with --estimate-only", "none")
    uncertainty = balance_flight.parse_uncertainty(
        inertia_sigma, offset_sigma, wheel_sigma, mount_sigma, tacho_sigma
    )
    bars = balance_procedure.parse_bars(torque, inertia_bar, offset_bar)
    loaded = load(scene, set_, seed)
    plan = balance_procedure.BalancePlan(
        excite, tilt, bars.torque_nm, flights or 6, not estimate_only, longer
    )
    assumed = balance_procedure.assumed(loaded, uncertainty)
    flown = fly(loaded, plan, uncertainty, json)
    statistics = balance_procedure.statistics(loaded.name, plan, flown)
    if in_flight:
        statistics["in_flight"] = balance_procedure.filter_rows(flown[-1], assumed)
    stop_deg = loaded.vehicle.tilt_stop_deg - balance_flight.STOP_MARGIN_DEG
    statistics["uncertain"] = balance_flight.uncertain(
        flown[-1].estimate,
        assumed.prior,
        [one.flight.record for one in flown],
        bars.inertia,
        bars.moment_kg_m(flown[-1].flight.vehicle),
        balance_flight.Excitation(tilt, stop_deg, longer),
    )
    folder = output_folder(out, loaded.name)
    command = command_line()
    print_report(
        statistics, balance_procedure.write_all(folder, statistics, flown, command), json
    )


def fly(
    scene: Scene, plan: BalancePlan, uncertainty: Uncertainty, json: bool
) -> list[Iteration]:
    """Fly and move the trim masses until the vehicle is balanced; print each flight, unless `json`."""
    from skysim.experiments import balance_procedure

    flown = []
    with progress_callback("flying") as watch:
        for one in balance_procedure.balance(scene, plan, uncertainty, watch):
            flown.append(one)
            if json:
                continue
            row = balance_procedure.flight_row(len(flown), one)
            places = "/".join(f"{place:.3f}" for place in row["next_trim_mm"])
            moves = row["next_trim_mm"] != row["trim_mm"]
            moved = f"; trim masses to {places} mm" if moves else ""
            after = row["after_contact"]
            contact = f", {after} of them after a contact" if after else ""
            print_wrapped(
                f"flight {row['flight']}: {row['solved']} of {row['frames']} frames solved{contact};"
                f" center of mass at {balance_procedure.offset_text(row)} um;"
                f" gravity torque {row['torque_nm']:.2g} N m, at most {row['torque_bound_nm']:.2g} N m{moved}"
            )
    return flown


def print_report(statistics: Record, report: Report, json: bool) -> None:
    """Print a report and its path, or the statistics as JSON."""
    if json:
        print_json(statistics)
    else:
        report.print()
        print_wrapped(f"report: {statistics['report']}")


def calibrate(
    scene: SceneArg,
    images: Path | None = None,
    clicks: Annotated[int, Option(min=0)] = 4,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """Measure LEDs from the vehicle's stops as the AFIT thesis does: magnitudes, angles, epsilons, on-board catalog.

    Parameters
    ----------
    images
        Folder of images with attitudes.csv of the IMU, in place of a flight.
    clicks
        LED spacings that set the scale in the first frame; 0 keeps the focal length.
    """
    from skysim.experiments import home_calibration

    loaded = load(scene, set_, seed)
    with progress_callback(loaded.title) as watch:
        known, frames = (
            home_calibration.measure_folder(images, loaded)
            if images
            else home_calibration.measure_scene(loaded, watch)
        )
    found = home_calibration.calibrated(known, frames, clicks)
    folder = output_folder(out, f"{loaded.name}_calibration")
    written = home_calibration.write_results(
        folder, loaded.name, known, found, command_line()
    )
    print_report(*written, json)


# Command `skysim characterize`: a camera preset from darks, flats and night frames.


def characterize(
    camera: Annotated[str, Option(autocompletion=complete_camera)],
    darks: Path | None = None,
    flats: Path | None = None,
    night: Path | None = None,
    frames_to: Path | None = None,
    seed: Annotated[int, Option(min=0)] = 1,
    out: Out = None,
    json: Json = False,
) -> None:
    """Measure a camera from its own frames: sensor from darks and flats, lens from the night sky, to a preset.

    The method is photon transfer, in the terms of EMVA 1288. Every value has its 95 % interval.

    Parameters
    ----------
    camera
        Preset, camera file or scene: what frames do not tell, such as size, pixel pitch and bits.
    darks
        Folder of darks, of two exposures or more; required without --frames-to.
    flats
        Folder of flats: pairs at exposures up to saturation; required without --frames-to.
    night
        Folder of frames of the night sky, stars at rest.
    frames_to
        Measure nothing: write the darks and flats of --camera, simulated.
    seed
        Seed of the frames of --frames-to.
    """
    from skysim.experiments.characterize import characterize_camera

    config, raw = characterize_camera.read_camera(camera)
    if frames_to is not None:
        for option in given_options(darks=darks, flats=flats, night=night, out=out):
            raise InputError(
                f"--{option}", "has no effect with --frames-to", "one of the two"
            )
        write_simulated(config, frames_to, seed, json)
        return
    folders = characterize_camera.check_folders(darks, flats)
    found = characterize_camera.measure_sensor(config, *folders)
    sky = characterize_camera.measure_night(config, raw, night, found) if night else None
    name = Path(camera).stem
    written = characterize_camera.write_results(
        output_folder(out, name), config, raw, found, sky, name
    )
    print_report(*written, json)


def write_simulated(config: Any, folder: Path, seed: int, json: bool) -> None:
    """Write simulated darks and flats."""
    from skysim.experiments.characterize import frame_files

    total = frame_files.frame_count(config.detector)
    paths = list(progress(frame_files.write_frames(config, folder, seed), total, "rendering"))
    if json:
        print_json({"frames": len(paths), "folder": str(folder)})
    else:
        print_wrapped(
            f"{len(paths)} frames: --darks {folder / 'darks'} --flats {folder / 'flats'}"
        )
