"""Overlay of a frame: which marks it has, and where, in the frame's pixels. Each kind can be switched off."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from skysim.apps.gui.messages import Detection, Light, TrackerResult

COLORS = {
    **{"truth": "#7a8cff", "detected": "#dd5a60", "identified": "#6ff0d8", "false": "#e8b90f"},
    "windows": "#7f8a9a",
}
KINDS = tuple(COLORS)
MAX_LABELS = 40  # most names; the brightest lights get them
MAX_TRUTH_MARKS = 400  # most marks of true lights
UNSOLVED_TICKS = 60  # of the brightest true lights of a frame without detections; fainter ones are dots
NEAR_PX = 4.0  # a detection within this distance of a true light is not false

Point = tuple[float, float]


def marks(
    lights: Collection[Light], result: TrackerResult | None, shown: Collection[str], name: Callable[[int], str]
) -> dict[str, Any]:
    """What frame.js draws: marks by kind (ticks for true lights, dots for those fainter than any identified one,
    squares for detections, circles for identified ones, crosses for false ones, dashed squares for predicted windows),
    names of identified lights, and all lights that the cursor may find.

    lights of the answer : (x, y, number or -1, whether it is a detection), detections last
    """
    detections = result.detections if result else ()
    identified = [detection for detection in detections if detection.id >= 0]
    visible = list(lights)[:MAX_TRUTH_MARKS]
    bright = bright_count(visible, detections)
    points: Mapping[str, list[Point]] = {
        "windows": [rounded(x, y) for x, y in result.windows_px] if result else [],
        "truth": places(visible[:bright]),
        "faint": places(visible[bright:]),
        "detected": places(detections),
        "identified": places(identified),
        "false": places(false_detections(detections, lights)),
    }
    return {
        "marks": [
            {"kind": drawn, "color": COLORS[kind], "points": points[drawn]}
            for kind, drawn in (*((kind, kind) for kind in KINDS), ("truth", "faint"))
            if kind in shown and points[drawn]
        ],
        "names": [(*rounded(one.x, one.y), name(one.id)) for one in identified[:MAX_LABELS]]
        if "identified" in shown
        else [],
        "lights": [(*rounded(one.x, one.y), one.id, 0) for one in visible]
        + [(*rounded(one.x, one.y), one.id, 1) for one in detections],
    }


def bright_count(lights: Sequence[Light], detections: Collection[Detection]) -> int:
    """How many lights, the brightest first, are as bright as the faintest identified one, or else detected one.

    In a field of hundreds of faint stars some detection of noise is beside one of them.
    """
    if not detections or not lights:
        return UNSOLVED_TICKS
    identified = {one.id for one in detections if one.id >= 0}
    found_px = np.array([(one.x, one.y) for one in detections])
    seen = [
        light.id in identified if identified else bool((np.abs(found_px - (light.x, light.y)) < NEAR_PX).all(1).any())
        for light in lights
    ]
    return max((n + 1 for n, is_seen in enumerate(seen) if is_seen), default=0)


def places(items: Collection[Detection] | Collection[Light]) -> list[Point]:
    return [rounded(item.x, item.y) for item in items]


def rounded(x: float, y: float) -> Point:
    """To a tenth of a pixel, for a short message."""
    return round(x, 1), round(y, 1)


def false_detections(detections: Collection[Detection], lights: Collection[Light]) -> list[Detection]:
    """Detections that have no true light within NEAR_PX; none if the truth is unknown."""
    if not lights:
        return []
    true_px = np.array([(light.x, light.y) for light in lights])
    return [
        detection
        for detection in detections
        if not (np.abs(true_px - (detection.x, detection.y)) < NEAR_PX).all(axis=1).any()
    ]
