"""AFIT's flat surface against a spherical one (Padro 2012, sections 3.5.1 and 3.5.2, Table 1)."""

from __future__ import annotations

from typing import Any

import numpy as np

from skysim.light import FlatSurface, SphereSurface
from skysim.metrics import Summary, exact
from skysim.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.papers.published import experiments
from skysim.plots import INK
from skysim.quantity import INCH_M
from skysim.surface import Surface, surface
from skysim.types import Floats

FIELD_RAD = np.radians(10.45)
STATED_MOUNT_IN, FITTED_MOUNT_IN = 14.0, 15.5
ANGLES_DEG = (0, 10, 15, 20, 25, 30)
FLAT = FlatSurface.model_validate({"kind": "flat", "apex": "48 in"})
SPHERE = SphereSurface.model_validate({"kind": "sphere", "apex": "48 in", "radius": "48 in"})


def width_in(shape: Surface, mount_in: float, angle_deg: float) -> float:
    """Width of the image plane where the field's inner edge meets a surface: c' of the thesis's eq. 38, in inches.

    The camera stands mount_in above the bearing on a vehicle that leans by angle_deg; the ray along the edge of its
    field nearer to the apex goes s far to the surface, and a plane there across the boresight is 2 s sin(field / 2)
    wide. s is of our own surface's intersection, so that eq. 38 is its oracle and not its source.
    """
    lean, half = np.radians(angle_deg), FIELD_RAD / 2
    camera_m = mount_in * INCH_M * along(lean)
    edge = along(lean - half)
    slant_m = np.linalg.norm(shape.meet(camera_m, edge[None])[0] - camera_m)
    return float(2 * slant_m * np.sin(half) / INCH_M)


def along(lean_rad: float) -> Floats:
    """(3,) the direction that leans so far from the upright, towards x."""
    return np.array([np.sin(lean_rad), 0.0, np.cos(lean_rad)])


def flat(ask: Ask) -> Found:
    """Table 1: the mount that the thesis states, and the one that gives its numbers."""
    panel = surface(FLAT)
    stated, fitted = (
        np.array([width_in(panel, mount_in, angle) for angle in ANGLES_DEG])
        for mount_in in (STATED_MOUNT_IN, FITTED_MOUNT_IN)
    )
    cause = f"M = {FITTED_MOUNT_IN} in"
    answers = {
        f"width_{angle}": Answer(exact(stated[n]), cause=Cause(cause, exact(fitted[n])))
        for n, angle in enumerate(ANGLES_DEG)
    }
    answers |= {
        f"more_{angle}": Answer(more(stated, n), cause=Cause(cause, more(fitted, n)))
        for n, angle in enumerate(ANGLES_DEG[1:], 1)
    }
    dome = surface(SPHERE)
    chords = [chord_in(dome, STATED_MOUNT_IN, angle) for angle in ANGLES_DEG]
    answers["sphere"] = Answer(exact(np.ptp(chords)))
    return Found(
        answers, (Drawing("Table 1: width of the image on a flat surface.", lambda fig: draw(fig, panel)),)
    )


def more(width: Floats, n: int) -> Summary:
    """By how many per cent of their mean a width is more than the first, as the thesis takes its differences."""
    return exact(200 * (width[n] - width[0]) / (width[n] + width[0]))


def chord_in(shape: Surface, mount_in: float, angle_deg: float) -> float:
    """Chord between the places where the two edges of the field meet a surface (eq. 42), in inches."""
    lean, half = np.radians(angle_deg), FIELD_RAD / 2
    edges = np.array([along(lean - half), along(lean + half)])
    ends = shape.meet(mount_in * INCH_M * along(lean), edges)
    return float(np.linalg.norm(ends[1] - ends[0]) / INCH_M)


def draw(fig: Any, panel: Surface) -> None:
    """Widths by the angle, of both mounts, with the published ones."""
    axes, rows = fig.subplots(), experiments()["afit-table-1"].rows
    angle = np.linspace(0, 30, 61)
    for mount_in, ink in ((STATED_MOUNT_IN, INK[0]), (FITTED_MOUNT_IN, INK[2])):
        axes.plot(
            angle,
            [width_in(panel, mount_in, one) for one in angle],
            color=ink,
            label=f"ours, M = {mount_in} in",
        )
    told = [rows[f"width_{one}"].published for one in ANGLES_DEG]
    axes.plot(ANGLES_DEG, told, "o", color=INK[1], label="published")
    axes.set(xlabel="angle (deg)", ylabel="width (in)")
    axes.legend()
