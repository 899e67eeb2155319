"""Command `skysim characterize`: a camera preset from darks, flats and night frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any
import typer
from skysim.apps.cli.commands.camera import complete_camera
from skysim.apps.cli.options import (Json, Out)
from skysim.apps.cli.terminal import print_json, progress
from skysim.core.errors import InputError
from skysim.results.report.as_text import print_wrapped



def characterize(
    camera: Annotated[
        str,
        typer.Option(
            help="Preset, camera file or scene: what frames do not tell, such as size, pixel pitch and bits.",
            autocompletion=complete_camera,
        ),
    ],
    darks: Annotated[
        Path | None, typer.Option(help="Folder of darks, of two exposures or more.")
    ] = None,
    flats: Annotated[
        Path | None, typer.Option(help="Folder of flats: pairs at exposures up to saturation.")
    ] = None,
    night: Annotated[
        Path | None, typer.Option(help="Folder of frames of the night sky, stars at rest.")
    ] = None,
    frames_to: Annotated[
        Path | None,
        typer.Option(help="Measure nothing: write the darks and flats of --camera, simulated."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the frames of --frames-to.")] = 1,
    out: Out = None,
    json: Json = False,
) -> None:
    """Measure a camera from its own frames: sensor from darks and flats, lens from the night sky, to a preset.

    The method is photon transfer, in the terms of EMVA 1288. Every value has its 95 % interval.
    """
    from skysim.apps.cli.options import output_folder
    from skysim.experiments.characterize import characterize_camera

    config, raw = characterize_camera.read_camera(camera)
    if frames_to is not None:
        given = {"darks": darks, "flats": flats, "night": night, "out": out}
        if conflict := next((name for name, value in given.items() if value is not None), None):
            raise InputError(f"--{conflict}", "has no effect with --frames-to", "one of the two")
        write_simulated(config, frames_to, seed, json)
        return
    folders = characterize_camera.check_folders(darks, flats)
    found = characterize_camera.measure_sensor(config, *folders)
    sky = characterize_camera.measure_night(config, raw, night, found) if night else None
    name = Path(camera).stem
    statistics, report = characterize_camera.write_results(
        output_folder(out, name), config, raw, found, sky, name
    )
    if json:
        print_json(statistics)
    else:
        report.print()
        print_wrapped(f"report: {statistics['report']}")


def write_simulated(config: Any, folder: Path, seed: int, json: bool) -> None:
    """Write simulated darks and flats."""
    from skysim.experiments.characterize import frame_files

    total = frame_files.frame_count(config.detector)
    paths = list(progress(frame_files.write_frames(config, folder, seed), total, "rendering"))
    if json:
        print_json({"frames": len(paths), "folder": str(folder)})
    else:
        print_wrapped(f"{len(paths)} frames: --darks {folder / 'darks'} --flats {folder / 'flats'}")


