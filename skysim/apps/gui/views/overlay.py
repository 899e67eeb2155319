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
