"""AFIT's surfaces: flat against spherical, the dome as designed and as measured (Padro 2012, section 3.5, Table 1)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from skysim.core.types import Floats
from skysim.core.units import INCH_M
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import Summary, exact
from skysim.results.plots import INK
from skysim.scene.light import FlatSurfaceConfig, SphereSurfaceConfig
from skysim.sources.dome.point_cloud import fit_sphere
from skysim.sources.dome.surface import Rim, Surface, build_surface

FIELD_RAD = np.radians(10.45)
STATED_MOUNT_IN, FITTED_MOUNT_IN = 14.0, 15.5
ANGLES_DEG = (0, 10, 15, 20, 25, 30)
FLAT = FlatSurfaceConfig.model_validate({"kind": "flat", "apex": "48 in"})
SPHERE = SphereSurfaceConfig.model_validate({"kind": "sphere", "apex": "48 in", "radius": "48 in"})
WALL = {"thickness_apex": "0.2036 in", "thickness_base": "0.25 in", "base_deg": 40, "radius_of": "mid_wall"}
DESIGN = SphereSurfaceConfig.model_validate(
    {"kind": "sphere", "apex": "48 in", "radius": "48.135 in", "wall": WALL}
)
EDGE_RAD, WIDE_IN, OUTSIDE_IN = (
    np.radians(40.0),
    62.0,
    48.135,
)  # the dome covers 80 deg and is 62 in wide; radius of the design's sphere
RINGS, SECTORS = 400, 12


def width_in(shape: Surface, mount_in: float, angle_deg: float) -> float:
    """Width of the image plane where the field's inner edge meets a surface: c' of the thesis's eq. 38, in inches.

    The camera is mount_in above the bearing on a vehicle tilted by angle_deg. The ray along the edge of the field
    nearer to the apex has length s to the surface, and the plane through its end across the boresight has the width
    2 s sin(field / 2). s comes from our own intersection code, so eq. 38 is an independent check of it.
    """
    lean, half = np.radians(angle_deg), FIELD_RAD / 2
    camera_m = mount_in * INCH_M * along(lean)
    edge = along(lean - half)
    slant_m = np.linalg.norm(shape.meet(camera_m, edge[None])[0] - camera_m)
    return float(2 * slant_m * np.sin(half) / INCH_M)


def along(lean_rad: float) -> Floats:
    """(3,) unit vector tilted from the vertical by lean_rad towards x."""
    return np.array([np.sin(lean_rad), 0.0, np.cos(lean_rad)])


def flat(ask: Ask) -> Found:
    """Table 1: with the mount height that the thesis states, and with the one that reproduces its numbers."""
    panel = build_surface(FLAT)
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
    dome = build_surface(SPHERE)
    chords = [chord_in(dome, STATED_MOUNT_IN, angle) for angle in ANGLES_DEG]
    answers["sphere"] = Answer(exact(np.ptp(chords)))
    return Found(
        answers, (Drawing("Table 1: width of the image on a flat surface.", lambda fig: draw(fig, panel)),)
    )


def more(width: Floats, n: int) -> Summary:
    """Difference of a width from the first, in percent of their mean (the thesis's definition)."""
    return exact(200 * (width[n] - width[0]) / (width[n] + width[0]))


def chord_in(shape: Surface, mount_in: float, angle_deg: float) -> float:
    """Chord between the points where the two edges of the field meet a surface (eq. 42), in inches."""
    lean, half = np.radians(angle_deg), FIELD_RAD / 2
    edges = np.array([along(lean - half), along(lean + half)])
    ends = shape.meet(mount_in * INCH_M * along(lean), edges)
    return float(np.linalg.norm(ends[1] - ends[0]) / INCH_M)


def draw(fig: Any, panel: Surface) -> None:
    """Widths against the angle for both mount heights, with the published ones."""
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


def contour(inside: Surface) -> dict[str, Answer]:
    """Dimensions of the designed and of the measured inner surface (section 3.5.3), from our surface models; inches."""
    design = build_surface(DESIGN)
    ends = along(0.0), along(EDGE_RAD)
    radii = np.linalg.norm(design.meet(design.centre_m, np.array(ends)) - design.centre_m, axis=1) / INCH_M
    # A spheroid through apex and edge, solved for b: 1 / r^2 = cos^2 / a^2 + sin^2 / b^2.
    across = np.sin(EDGE_RAD) / np.sqrt(radii[1] ** -2 - np.cos(EDGE_RAD) ** 2 / radii[0] ** 2)
    _, axes_m = inside.as_ellipsoid()
    wide, tall = axes_m[0] / INCH_M, axes_m[2] / INCH_M
    return {
        "design_apex": Answer(exact(radii[0])),
        "design_edge": Answer(exact(radii[1])),
        "design_change": Answer(exact(100 * (radii[0] / radii[1] - 1))),
        "design_across": Answer(exact(across)),
        "differs_v": Answer(exact(per_cent(radii[0], tall))),
        "differs_h": Answer(exact(per_cent(across, wide))),
        **rim_and_radii(inside),
        **best_sphere(inside),
    }


def per_cent(one: float, other: float) -> float:
    """Difference of two lengths in percent of their mean (the thesis's definition)."""
    return float(200 * abs(one - other) / (one + other))


def met_in(inside: Surface, lean_rad: Any) -> Floats:
    """(N, 3) points where rays from the bearing, tilted by lean_rad, meet a surface extended beyond its rim; inches."""
    rays = np.array([along(one) for one in np.atleast_1d(lean_rad)])
    return np.asarray(replace(inside, rim=Rim(inside.rim.eye_m)).meet(np.zeros(3), rays) / INCH_M)


def rim_and_radii(inside: Surface) -> dict[str, Answer]:
    """Rim of the measured surface (where it is as wide as the dome), and its distances from the bearing."""
    rim_rad = brentq(lambda lean: met_in(inside, lean)[0, 0] - WIDE_IN / 2, 0.5, 0.9)
    rim = met_in(inside, rim_rad)[0]
    height = Answer(exact(met_in(inside, 0.0)[0, 2] - rim[2]))
    lean_rad = np.linspace(0, rim_rad, 4001)
    rho = np.linalg.norm(met_in(inside, lean_rad), axis=1)
    return {
        "height": height,
        "height_by_axes": height,
        "rim_z": Answer(exact(rim[2])),
        "rim_rho": Answer(exact(float(np.linalg.norm(rim)))),
        "rho_max": Answer(exact(rho.max())),
        "rho_max_at": Answer(exact(np.degrees(lean_rad[rho.argmax()]))),
    }


def best_sphere(inside: Surface) -> dict[str, Answer]:
    """Least-squares sphere of the measured surface, sampled uniformly by area over the design's cap, and the rms of the
    contour's distance from it.

    The contour's points are uniform in polar angle, as those of a measuring arm moved along a meridian.
    """
    cap_rad = np.arcsin(WIDE_IN / 2 / OUTSIDE_IN)
    part = (np.arange(RINGS) + 0.5) / RINGS
    profile_in = met_in(inside, np.arccos(1 - part * (1 - np.cos(cap_rad))))
    around = Rotation.from_euler("z", np.arange(SECTORS)[:, None] * (2 * np.pi / SECTORS))
    ball = fit_sphere(np.concatenate([one.apply(profile_in) for one in around]))
    contour_in = met_in(inside, part * cap_rad)
    off_in = np.linalg.norm(contour_in - ball.centre_m, axis=1) - ball.radius_m
    return {
        "best_sphere": Answer(exact(ball.radius_m)),
        "best_centre": Answer(exact(float(ball.centre_m[2]))),
        "best_rms": Answer(exact(float(np.sqrt(np.mean(off_in**2)))), f"over equal areas {ball.rms_m:.3f}"),
    }
