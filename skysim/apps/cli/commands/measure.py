"""Commands that measure hardware: `skysim balance`, `characterize` for the camera, `calibrate` for its LEDs.

`skysim camera`: list the presets, show a camera, write one from the numbers of a data sheet.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option
from typer.core import TyperGroup

from skysim.apps.cli.options import (
    OPTIONS,
    Json,
    Out,
    Overrides,
    SceneArg,
    Seed,
    as_typed,
    command_line,
    complete_scene,
    complete_yaml,
    given_options,
    load,
    output_folder,
    write_file,
)
from skysim.apps.cli.terminal import (
    print_error,
    print_json,
    print_list,
    progress,
    progress_callback,
)
from skysim.core.errors import InputError, printable, unknown_name
from skysim.core.paths import DATA, shipped_files
from skysim.results.report import print_wrapped, terminal_width
from skysim.scene import camera_sheet
from skysim.scene.camera_sheet import PLACEHOLDER_LENS, QUESTIONS

if TYPE_CHECKING:
    from skysim.core.types import Record
    from skysim.experiments.balance_flight import Uncertainty
    from skysim.experiments.balance_procedure import BalancePlan, Iteration
    from skysim.results.report import Report
    from skysim.scene.opencv_calibration import OpencvCalibration
    from skysim.scene.scene import Scene
    from skysim.scene.sections.camera import CameraConfig


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
    from skysim.experiments.characterize import characterize_camera, frame_files

    config, raw = characterize_camera.read_camera(camera)
    if frames_to is not None:
        for option in given_options(darks=darks, flats=flats, night=night, out=out):
            raise InputError(
                f"--{option}", "has no effect with --frames-to", "one of the two"
            )
        total = frame_files.frame_count(config.detector)
        written = frame_files.write_frames(config, frames_to, seed)
        paths = list(progress(written, total, "rendering"))
        if json:
            print_json({"frames": len(paths), "folder": frames_to})
        else:
            places = f"--darks {frames_to / 'darks'} --flats {frames_to / 'flats'}"
            print_wrapped(f"{len(paths)} frames: {places}")
        return
    folders = characterize_camera.check_folders(darks, flats)
    found = characterize_camera.measure_sensor(config, *folders)
    sky = characterize_camera.measure_night(config, raw, night, found) if night else None
    name = Path(camera).stem
    folder = output_folder(out, name)
    results = characterize_camera.write_results(folder, config, raw, found, sky, name)
    print_report(*results, json)


def complete_camera(incomplete: str) -> list[str]:
    """Names of camera presets, scenes and YAML files that begin with what was typed."""
    return sorted({*complete_yaml(DATA / "cameras", incomplete), *complete_scene(incomplete)})


class CameraGroup(TyperGroup):
    """`skysim camera FILE` is short for `skysim camera show FILE`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert `show` before arguments that name no subcommand."""
        words = [word for word in args if not word.startswith("-")]
        if words and args[0] not in self.commands:
            args = ["show", *args]
        return super().parse_args(ctx, args)

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Subcommands, and arguments of `show`."""
        # The class is that of typer's own parser or of click.
        item = type(super().shell_complete(ctx, "")[0])
        names = [] if incomplete.startswith("-") else complete_camera(incomplete)
        return [*super().shell_complete(ctx, incomplete), *map(item, names)]


camera_app = typer.Typer(
    cls=CameraGroup,
    invoke_without_command=True,
    help="Show a camera: field of view, arcseconds a pixel, calibration. Make one from a data sheet.",
)


@camera_app.callback()
def cameras(context: typer.Context, json: Json = False) -> None:
    """List the camera presets; with a file or a name, show that camera (`skysim camera show`)."""
    if context.invoked_subcommand:
        return
    from skysim.scene import loader

    listed = [preset_entry(path) for path in sorted(loader.PRESETS.glob("*.yaml"))]
    width = terminal_width()
    print_list(
        listed,
        json,
        lambda entry: "{name:11s} {size:15s} {pixel:8s} {shutter:10s} {what}".format(**entry)[
            :width
        ],
    )


def preset_entry(path: Path) -> dict[str, str]:
    """Name, size, pitch, shutter and the first words of the description of a preset."""
    from skysim.core.yaml_reader import read_yaml

    tree, text = read_yaml(path)
    camera = tree["camera"]
    comment = " ".join(
        line.removeprefix("#") for line in text.splitlines() if line.startswith("#")
    )
    return {
        "name": path.stem,
        "size": f"{camera['width_px']} x {camera['height_px']} px",
        "pixel": camera["pixel"],
        "shutter": camera["shutter"]["kind"],
        "what": printable(comment.replace("(", ",").replace(":", ",").partition(",")[0]),
        "file": str(path),
    }


@camera_app.command("show")
def camera_show(
    file: Annotated[str, Argument(autocompletion=complete_camera)],
    out: Path | None = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """Show a camera: field of view, arcseconds a pixel, focal length, distortion. Optionally write it for OpenCV.

    `skysim camera FILE` does the same.

    Parameters
    ----------
    file : FILE
        Scene, camera file, preset (data/cameras) or OpenCV calibration (YAML): a file or a name.
    out
        Also write the calibration to this file, in OpenCV's YAML format.
    """
    import dataclasses

    from skysim.scene import opencv_calibration

    lens, chip = read_camera(file, set_)
    if lens is None and out:
        raise InputError(
            f"--out {out}", f"{file} has no lens", "--set camera.focal_length='16 mm'"
        )
    if lens is not None and out:
        write_file(out, opencv_calibration.text(lens))
    if json:
        known: Record = {"width_px": chip.width_px, "height_px": chip.height_px}
        if lens:
            known |= dataclasses.asdict(lens)
            known |= {"field_deg": lens.field_deg, "arcsec_px": lens.arcsec_px}
        print_json(known)
        return
    print(f"size             {chip.width_px} x {chip.height_px} px")
    if lens is None:
        print("field of view    no lens: add --set camera.focal_length='16 mm'")
        return
    x, y = lens.center_px
    coefficients = zip(opencv_calibration.COEFFICIENTS, lens.distortion, strict=True)
    print(f"field of view    {lens.field_text()}")
    print(f"focal length     {lens.focal_px:.6g} px")
    print(f"principal point  {x:.6g}, {y:.6g} px (the center of the first pixel is 0, 0)")
    print(
        "distortion       " + ", ".join(f"{name} {value:g}" for name, value in coefficients)
    )
    if out:
        print(
            f"{out}: for OpenCV, skysim solve --camera and the scene key camera.calibration"
        )


def read_camera(
    name: str, overrides: list[str] | None
) -> tuple[OpencvCalibration | None, OpencvCalibration | CameraConfig]:
    """Calibration (None without a lens) and size of a scene's camera, a camera file, a preset or an OpenCV file."""
    from skysim.core.yaml_reader import parse_overrides
    from skysim.scene import loader, opencv_calibration

    if opencv_calibration.looks_like_calibration(Path(name)):
        if overrides:
            raise InputError(
                f"--set {overrides[0]}",
                f"has no effect: {name} is a calibration",
                "a scene, a camera",
            )
        lens = opencv_calibration.read(Path(name))
        return lens, lens
    values = parse_overrides(overrides)
    if not Path(name).suffix and name not in (
        known := loader.list_cameras() + loader.list_scenes()
    ):
        problem, names = unknown_name("camera", name, known)
        raise InputError("", problem, f"{names}, or a .yaml file")
    path = shipped_files(loader.PRESETS).get(name) or loader.find(name)
    tree = loader.read(path)[0]
    alone = tree.keys() <= {"camera", "schema"} and isinstance(tree.get("camera"), dict)
    if values and not alone:
        camera = loader.load(path, values).camera
    else:
        camera = loader.load_camera(path, PLACEHOLDER_LENS if alone else None, values)
    has_lens = (
        not alone or "camera.focal_length" in values or "focal_length" in tree["camera"]
    )
    return camera.calibration() if has_lens else None, camera


def asking(command: Callable[..., None]) -> Callable[..., None]:
    """The command with an option for each question of the data sheet, before its own options."""
    answers = [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                str | None,
                Option(
                    OPTIONS[f"answers.{name}"],
                    metavar="TEXT",
                    help=f"{question.ask}: {question.where}.",
                ),
            ],
        )
        for name, question in QUESTIONS.items()
    ]
    *own, _ = inspect.signature(command, eval_str=True).parameters.values()
    command.__signature__ = inspect.Signature([*answers, *own])  # type: ignore[attr-defined]
    return command


@camera_app.command("new")
@asking
def camera_new(
    *,
    name: str = "",
    out: Path = Path("camera.yaml"),
    json: Json = False,
    **answers: str | None,
) -> None:
    """Write a camera file from the numbers of a data sheet: asks for each; with options, only those are used.

    Numbers that the data sheet does not state are assumed; the file and the output name them.

    Parameters
    ----------
    name
        Name of camera, lens and data sheets, for the file's first line.
    out
        The file to write, for the key camera.preset.
    """
    if out.suffix not in (".yaml", ".yml") or out.exists():
        raise InputError(
            f"--out {out}", "exists" if out.exists() else "no .yaml file", "a new .yaml file"
        )
    given = {key: text for key in QUESTIONS if (text := answers[key]) is not None}
    filled = camera_sheet.fill(given or ask_all())
    write_file(out, camera_sheet.text(filled, name or out.stem))
    if json:
        print_json({"file": out, "missing": [one._asdict() for one in filled.missing]})
        return
    lens, chip = read_camera(str(out), None)
    field = f"; {lens.field_text()}" if lens else ""
    print(f"{out}: {chip.width_px} x {chip.height_px} px{field}")
    if filled.missing:
        print(f"not stated, and assumed in {out}:")
    width = min(max(terminal_width(), 40), 100)
    for one in filled.missing:
        name = one.name.replace("_", " ")
        line = f"{one.assumed or 'left out'}: {one.consequence}"
        print_wrapped(line, f"  {name:19s}", " " * 21, width)
    print(f"in a scene: camera: {{preset: {out}}}; skysim camera {out} shows it")


def ask_all() -> dict[str, str]:
    """Ask for each number of the data sheet. A wrong answer is asked again; an empty one leaves the number out."""
    print(
        "Numbers of the data sheets of camera and lens, with their units. Press Enter for what is not stated."
    )
    answers: dict[str, str] = {}
    for name, question in QUESTIONS.items():
        required = name in camera_sheet.PLACEHOLDERS
        if not required and name not in camera_sheet.outstanding(answers):
            continue  # a question on a lens or a shutter that this camera does not have
        assumed = (
            "" if required else camera_sheet.outstanding(answers)[name].assumed or "left out"
        )
        print(
            f"\n{question.ask}\n  where: {question.where}"
            + (f"\n  not stated: {assumed}" if assumed else "")
        )
        while True:
            text = typer.prompt(
                f"  {name.replace('_', '-')}", default="", show_default=False
            ).strip()
            try:
                if text:
                    camera_sheet.outstanding(answers | {name: text})
                    answers[name] = text
                elif required:
                    raise InputError(name.replace("_", "-"), "required")
                break
            except InputError as error:
                print_error(str(as_typed(error)))
    return answers
