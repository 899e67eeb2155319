"""Overlay of a frame: which marks it has, and where, in the frame's pixels. Each kind can be switched off."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from itertools import compress
from typing import Any
import numpy as np
from numpy.typing import NDArray
from skysim.apps.gui.messages import Lights, TrackerResult
from skysim.core.types import Floats



COLORS = {
    "truth": "#7a8cff",
    "detected": "#dd5a60",
    "identified": "#6ff0d8",
    "false": "#e8b90f",
    "windows": "#7f8a9a",
}
KINDS = tuple(COLORS)
MAX_LABELS = 40  # most names; the brightest lights get them
MAX_TRUTH_MARKS = 400  # most marks of true lights
UNSOLVED_TICKS = (
    60  # of the brightest true lights of a frame without detections; fainter ones are dots
)
NEAR_PX = 4.0  # a detection within this distance of a true light is not false

Points = list[list[float]]  # to a tenth of a pixel, for a short message


def marks(
    lights: Lights, result: TrackerResult | None, shown: Collection[str], name: Callable[[int], str]
) -> dict[str, Any]:
    """What frame.js draws: marks by kind (ticks for true lights, dots for those fainter than any identified one,
    squares for detections, circles for identified ones, crosses for false ones, dashed squares for predicted windows),
    names of identified lights, and all lights that the cursor may find.

    lights of the answer : (x, y, number or -1, whether it is a detection), detections last
    """
    detections = result.detections if result else ()
    ids = [one.id for one in detections]
    found_px = np.array([(one.x, one.y) for one in detections], float).reshape(-1, 2)
    is_identified = np.array(ids, np.int64) >= 0
    visible = lights[:MAX_TRUTH_MARKS]
    near_x, near_y = (
        np.abs(np.subtract.outer(*pair)) < NEAR_PX
        for pair in zip(lights.xy_px.T, found_px.T, strict=True)
    )
    near = near_x & near_y  # of each true light and each detection
    bright = bright_count(visible, ids, near[: len(visible)])
    is_false = ~near.any(axis=0) & bool(len(lights))  # without true lights it is not known
    true = rounded(visible.xy_px)
    found = rounded(found_px)
    points: Mapping[str, Points] = {
        "windows": rounded(np.array(result.windows_px).reshape(-1, 2)) if result else [],
        "truth": true[:bright],
        "faint": true[bright:],
        "detected": found,
        "identified": list(compress(found, is_identified)),
        "false": list(compress(found, is_false)),
    }
    named = list(compress(zip(found, ids, strict=True), is_identified))[:MAX_LABELS]
    return {
        "marks": [
            {"kind": drawn, "color": COLORS[kind], "points": points[drawn]}
            for kind, drawn in (*((kind, kind) for kind in KINDS), ("truth", "faint"))
            if kind in shown and points[drawn]
        ],
        "names": [(*place, name(id)) for place, id in named] if "identified" in shown else [],
        "lights": [(*place, id, 0) for place, id in zip(true, visible.id.tolist(), strict=True)]
        + [(*place, id, 1) for place, id in zip(found, ids, strict=True)],
    }


def bright_count(lights: Lights, identified: Collection[int], near: NDArray[np.bool_]) -> int:
    """How many lights, the brightest first, are as bright as the faintest identified one, or else detected one.

    In a field of hundreds of faint stars some detection of noise is beside one of them.
    identified : number of the light of each detection, or -1;  near : (lights, detections) whether they are near
    """
    if not len(identified) or not len(lights):
        return UNSOLVED_TICKS
    numbers = [id for id in identified if id >= 0]
    seen = np.isin(lights.id, numbers) if numbers else near.any(axis=1)
    return int(np.flatnonzero(seen)[-1]) + 1 if seen.any() else 0


def rounded(xy_px: Floats) -> Points:
    return np.round(xy_px, 1).tolist()




# Proper names of bright stars (IAU Working Group on Star Names) by Hipparcos number.


NAMES = {
    677: "Alpheratz",
    746: "Caph",
    2081: "Ankaa",
    3179: "Schedar",
    3419: "Diphda",
    5447: "Mirach",
    7588: "Achernar",
    8903: "Sheratan",
    9640: "Almach",
    9884: "Hamal",
    11767: "Polaris",
    14576: "Algol",
    15863: "Mirfak",
    17702: "Alcyone",
    21421: "Aldebaran",
    24436: "Rigel",
    24608: "Capella",
    25336: "Bellatrix",
    25428: "Elnath",
    25930: "Mintaka",
    25985: "Arneb",
    26311: "Alnilam",
    26727: "Alnitak",
    27366: "Saiph",
    27989: "Betelgeuse",
    28360: "Menkalinan",
    30324: "Mirzam",
    30438: "Canopus",
    31681: "Alhena",
    32349: "Sirius",
    33579: "Adhara",
    34444: "Wezen",
    35904: "Aludra",
    36850: "Castor",
    37279: "Procyon",
    37826: "Pollux",
    39429: "Naos",
    41037: "Avior",
    44816: "Suhail",
    45238: "Miaplacidus",
    45556: "Aspidiske",
    46390: "Alphard",
    49669: "Regulus",
    53910: "Merak",
    54061: "Dubhe",
    57632: "Denebola",
    58001: "Phecda",
    59774: "Megrez",
    59803: "Gienah",
    60718: "Acrux",
    61084: "Gacrux",
    62434: "Mimosa",
    62956: "Alioth",
    63608: "Vindemiatrix",
    65378: "Mizar",
    65474: "Spica",
    67301: "Alkaid",
    68702: "Hadar",
    68933: "Menkent",
    69673: "Arcturus",
    71683: "Rigil Kentaurus",
    72105: "Izar",
    72607: "Kochab",
    72622: "Zubenelgenubi",
    74785: "Zubeneschamali",
    76267: "Alphecca",
    77070: "Unukalhai",
    78401: "Dschubba",
    80763: "Antares",
    82273: "Atria",
    84012: "Sabik",
    85927: "Shaula",
    86032: "Rasalhague",
    86228: "Sargas",
    87833: "Eltanin",
    90185: "Kaus Australis",
    91262: "Vega",
    92855: "Nunki",
    97278: "Tarazed",
    97649: "Altair",
    100453: "Sadr",
    100751: "Peacock",
    102098: "Deneb",
    105199: "Alderamin",
    107315: "Enif",
    109268: "Alnair",
    112122: "Tiaki",
    113368: "Fomalhaut",
    113881: "Scheat",
    113963: "Markab",
}


