"""Commands `skysim scenes`, `new` and `export`."""

import re
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument

from skysim.apps.cli.options import Json, Overrides, SceneArg, Seed, load, write_file
from skysim.apps.cli.terminal import print_json, print_titles, progress
from skysim.core.errors import InputError, check_name
from skysim.core.paths import DATA, SCENES
from skysim.results.report import Column, Table, print_table

# A kind is the name of its template, with any endings.
NEW = DATA / "new"
KINDS = sorted({path.stem for path in NEW.glob("*.*")})

scenes_app = typer.Typer(
    invoke_without_command=True,
    help="List the shipped scenes; show every key of a scene, or export it for MuJoCo.",
)


@scenes_app.callback()
def scenes(context: typer.Context, json: Json = False) -> None:
    """List the scenes that come with skysim."""
    if context.invoked_subcommand:
        return
    print_titles(SCENES, json)


@scenes_app.command("show")
def scenes_show(scene: SceneArg, set_: Overrides = None, json: Json = False) -> None:
    """Print the effective scene: every key with its value and where it comes from (file and line, preset, default)."""
    from skysim.core.yaml_reader import parse_overrides
    from skysim.scene import provenance

    entries = provenance.effective(scene, parse_overrides(set_))
    if json:
        print_json(provenance.as_dicts(entries))
    else:
        print(provenance.text(entries), end="")


@scenes_app.command("export")
def scenes_export(
    scene: SceneArg,
    out: Path | None = None,
    paper: str = "a4",
    seed: Seed = None,
    set_: Overrides = None,
) -> None:
    """Write a scene for MuJoCo's viewer (.xml), as a unit of co-simulation (.fmu), or what a builder of its dome needs.

    The unit is of FMI 3, for Simulink and other tools; it needs pythonfmu3 and a C compiler.
    The builder gets a list of the LEDs (.csv), a pattern of gores at full scale on pages (.pdf), in one drawing to
    print (.svg) or to cut (.dxf), or the shell with a mark at each LED as a mesh (.obj).

    Parameters
    ----------
    out
        Output file: .xml, .fmu; of a dome .csv (LEDs), .pdf, .svg, .dxf (gores), .obj. Else out/SCENE.xml.
    paper
        Paper of a .pdf: a4 or a3 (sheets to join), roll (610 mm), gore (one a page).
    """
    from skysim.core import files
    from skysim.results.files import fmu, parts, templates
    from skysim.simulation.lab import build_lab
    from skysim.sources.dome.layouts.led_list import led_list

    loaded = load(scene, set_, seed)
    path = out or Path("out") / f"{loaded.name}.xml"
    ending = path.suffix.lower()
    if ending == ".fmu":
        fmu.write_unit(path, loaded)
        print(f"{path}: FMI 3.0, co-simulation; its variables: fmpy info {path}")
        return
    lab = build_lab(loaded)
    use = f"python -m mujoco.viewer --mjcf={path}"
    if ending == ".pdf":
        files.make_folder(path.parent)
        count = templates.write_pdf(path, parts.DomeDesign(loaded, "templates"), paper)
        print(f"{path}: {count} pages; print them at 100 %")
        return
    if ending == ".csv":
        if not loaded.dome:
            raise InputError("light.kind", f"{loaded.light.kind} has no list of LEDs", "dome")
        text, cap_deg = led_list(loaded.dome, lab.camera.band, loaded.name)
        use = f"light.layout: {{kind: listed, cap_deg: {cap_deg}, file: {path}}}"
    elif ending in templates.TEMPLATES:
        text = templates.template(lab, ending)
        use = "print it at 100 %" if ending == ".svg" else "in mm"
    else:
        text = lab.export_mjcf()
    write_file(path, text)
    print(f"{path}: {use}")


@scenes_app.command("parts")
def scenes_parts(
    scene: SceneArg,
    prices: str = "assumed",
    out: Path | None = None,
    seed: Seed = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """List the parts of a scene's dome with their prices: LEDs, tape or boards, drivers, wire, shell, survey.

    Parameters
    ----------
    prices : FILE
        Table of prices (.csv); `assumed` is the one that comes along.
    out
        Also write the list as CSV.
    """
    from skysim.results.files import parts

    loaded = load(scene, set_, seed)
    found = parts.parts_list(loaded, parts.read_prices(parts.find_prices(prices)))
    if out:
        write_file(out, parts.to_csv(found, loaded.name))
    if json:
        lines = [line._asdict() for line in found.lines]
        print_json({"parts": lines, "groups": found.groups(), "total": found.total})
        return
    columns = [
        Column(head, kind="text" if head in ("part", "what") else "number")
        for head in parts.COLUMNS
    ]
    print_table(Table(columns, found.rows()), f"Parts of {loaded.name}, prices: {prices}")
    shares = [
        f"{name} {cost:.2f} ({cost / max(found.total, 0.01):.0%})"
        for name, cost in found.groups().items()
    ]
    print(f"Of the total: {', '.join(shares)}")


def new(
    kind: Annotated[
        str,
        Argument(
            metavar="KIND",
            help=f"What to begin: {', '.join(KINDS)}.",
            autocompletion=lambda: list(KINDS),
        ),
    ],
    name: Annotated[str, Argument()],
    out: Path = Path(),
) -> None:
    """Begin a scene, vehicle, camera, study, controller or tracker: write a commented file that runs as it is.

    Its first lines say which commands use it. A vehicle is two files: its model, and a scene that flies it.

    Parameters
    ----------
    name : NAME
        Name of the new file, without its ending.
    out
        Folder of the new file.
    """
    check_name("", "kind", kind, KINDS)
    if not re.fullmatch(r"[A-Za-z]\w*", name):
        raise InputError(
            "NAME", f"{name!r} is no name", "a letter, then letters, digits and _"
        )
    templates = {out / f"{name}{path.suffix}": path for path in sorted(NEW.glob(f"{kind}.*"))}
    for target in templates:
        if target.exists():
            raise InputError(
                target, "exists; choose another name, or another folder with --out"
            )
    for target, template in templates.items():
        text = template.read_text(encoding="utf-8")
        write_file(target, text.replace("NAME", name))
        print(target)
        for use in re.findall("^#   (skysim.*)", text, re.MULTILINE):
            print(
                f"  {use.replace(template.with_stem('NAME').name, str(target)).replace('NAME', name)}"
            )


def export(
    folder: Annotated[Path, Argument()],
    to: list[str],
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Write a finished run for other tools: attitudes as CCSDS AEM, tables as Parquet, frames as TIFF, Zarr, video.

    Parameters
    ----------
    folder : FOLDER
        Output folder of `skysim run` or `render`.
    to : FORMAT
        aem, ecsv, parquet, tiff, zarr or video; repeatable.
    out
        Output folder; default: FOLDER.
    """
    from skysim.results.files import recording
    from skysim.results.files import run_export as export_files

    run = recording.Recording(folder)
    written = export_files.export(run, to, out or folder, progress)
    if json:
        print_json([str(path) for path in written])
        return
    for path in written[:10]:
        print(path)
    if len(written) > 10:
        print(f"and {len(written) - 10} more files in {out or folder}")
