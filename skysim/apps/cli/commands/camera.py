"""Commands `skysim camera`: list the presets, show a camera, write one from the numbers of a data sheet."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperGroup

from skysim.apps.cli.options import (
    OPTIONS,
    Json,
    Overrides,
    as_typed,
    complete_scene,
    write_file,
)
from skysim.apps.cli.terminal import print_error, print_json, print_list
from skysim.core.errors import InputError, printable, unknown_name
from skysim.core.paths import DATA, shipped_files
from skysim.results.report import print_wrapped, terminal_width
from skysim.scene import camera_sheet
from skysim.scene.camera_sheet import PLACEHOLDER_LENS, QUESTIONS

if TYPE_CHECKING:
    from skysim.core.types import Record
    from skysim.scene.opencv_calibration import OpencvCalibration
    from skysim.scene.sections.camera import CameraConfig


def complete_camera(incomplete: str) -> list[str]:
    """Names of camera presets, scenes and YAML files that begin with what was typed."""
    names = [name for name in shipped_files(DATA / "cameras") if name.startswith(incomplete)]
    return sorted({*names, *complete_scene(incomplete)})


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


app = typer.Typer(
    cls=CameraGroup,
    invoke_without_command=True,
    help="Show a camera: field of view, arcseconds a pixel, calibration. Make one from a data sheet.",
)


@app.callback()
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


@app.command("show")
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
    path = loader.preset_path(name) if name in loader.list_cameras() else loader.find(name)
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


@app.command("new")
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
        print_json({"file": str(out), "missing": [one._asdict() for one in filled.missing]})
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
