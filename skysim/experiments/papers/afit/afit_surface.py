"""AFIT's surfaces: flat against spherical, the dome as designed and as measured (Padro 2012, section 3.5, Table 1)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from skysim.core.constants import INCH_M
from skysim.core.types import Floats
from skysim.experiments.papers.compare import (
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    with_cause,
)
from skysim.experiments.papers.published import published_values
from skysim.results.metrics import exact
from skysim.results.plots import INK
from skysim.scene.sections.light import FlatSurfaceConfig, SphereSurfaceConfig
from skysim.sources.dome.point_cloud import fit_sphere
from skysim.sources.dome.surface import Rim, Surface, build_surface

FIELD_RAD = np.radians(10.45)
STATED_HEIGHT_IN = 14.0
FITTED_HEIGHT_IN = 15.5
ANGLES_DEG = (0, 10, 15, 20, 25, 30)
FLAT = FlatSurfaceConfig.model_validate({"kind": "flat", "apex": "48 in"})
SPHERE = SphereSurfaceConfig.model_validate(
    {"kind": "sphere", "apex": "48 in", "radius": "48 in"}
)
WALL = {
    "thickness_apex": "0.2036 in",
    "thickness_base": "0.25 in",
    "base_deg": 40,
    "radius_of": "mid_wall",
}
DESIGN = SphereSurfaceConfig.model_validate(
    {"kind": "sphere", "apex": "48 in", "radius": "48.135 in", "wall": WALL}
)
EDGE_RAD = np.radians(40.0)  # the dome covers 80 deg
# full width; radius of the design's sphere
DOME_WIDTH_IN = 62.0
DESIGN_RADIUS_IN = 48.135
SAMPLE_RINGS = 400
SAMPLE_SECTORS = 12


def width_in(surface: Surface, height_in: float, angle_deg: float) -> float:
    """Width of the image plane where the field's inner edge meets a surface: c' of the thesis's eq. 38, in inches.

    The camera is height_in above the bearing on a vehicle tilted by angle_deg. The ray along the edge of the field
    nearer to the apex has length s to the surface, and the plane through its end across the boresight has the width
    2 s sin(field / 2). s comes from our own intersection code, so eq. 38 is an independent check of it.
    """
    tilt = np.radians(angle_deg)
    half_field = FIELD_RAD / 2
    camera_m = height_in * INCH_M * tilted_direction(tilt)
    edge_ray = tilted_direction(tilt - half_field)
    distance_m = np.linalg.norm(surface.meet(camera_m, edge_ray[None])[0] - camera_m)
    return float(2 * distance_m * np.sin(half_field) / INCH_M)


def tilted_direction(tilt_rad: float) -> Floats:
    """(3,) unit vector tilted from the vertical by tilt_rad towards x."""
    return np.array([np.sin(tilt_rad), 0.0, np.cos(tilt_rad)])


def table_1(options: ExperimentOptions) -> ExperimentResult:
    """Table 1: with the mount height that the thesis states, and with the one that reproduces its numbers."""
    panel = build_surface(FLAT)
    stated, fitted = (
        np.array([width_in(panel, height_in, angle) for angle in ANGLES_DEG])
        for height_in in (STATED_HEIGHT_IN, FITTED_HEIGHT_IN)
    )
    results: Results = {}
    for n, angle in enumerate(ANGLES_DEG):
        values = {"width": [width[n] for width in (stated, fitted)]}
        if n:  # the difference from the first width, in percent of their mean (the thesis's definition)
            values["more"] = [
                200 * (width[n] - width[0]) / (width[n] + width[0])
                for width in (stated, fitted)
            ]
        for name, pair in values.items():
            results[f"{name}_{angle}"] = with_cause(
                f"M = {FITTED_HEIGHT_IN} in", exact, *pair
            )
    dome = build_surface(SPHERE)
    chords = [chord_in(dome, STATED_HEIGHT_IN, angle) for angle in ANGLES_DEG]
    results["sphere"] = exact(np.ptp(chords))
    caption = "Table 1: width of the image on a flat surface."
    return ExperimentResult(results, (FigureDrawing(caption, lambda fig: draw(fig, panel)),))


def chord_in(surface: Surface, height_in: float, angle_deg: float) -> float:
    """Chord between the points where the two edges of the field meet a surface (eq. 42), in inches."""
    tilt = np.radians(angle_deg)
    half_field = FIELD_RAD / 2
    edges = np.array(
        [tilted_direction(tilt - half_field), tilted_direction(tilt + half_field)]
    )
    ends_m = surface.meet(height_in * INCH_M * tilted_direction(tilt), edges)
    return float(np.linalg.norm(ends_m[1] - ends_m[0]) / INCH_M)


def draw(fig: Any, panel: Surface) -> None:
    axes = fig.subplots()
    angle = np.linspace(0, 30, 61)
    for height_in, ink in ((STATED_HEIGHT_IN, INK[0]), (FITTED_HEIGHT_IN, INK[2])):
        width = [width_in(panel, height_in, angle_deg) for angle_deg in angle]
        axes.plot(angle, width, color=ink, label=f"ours, M = {height_in} in")
    published = published_values("afit-table-1", *(f"width_{angle}" for angle in ANGLES_DEG))
    axes.plot(ANGLES_DEG, published, "o", color=INK[1], label="published")
    axes.set(xlabel="angle (deg)", ylabel="width (in)")
    axes.legend()


def contour(dome: Surface) -> Results:
    """Dimensions of the designed and of the measured inner surface (section 3.5.3), from our surface models; inches."""
    design = build_surface(DESIGN)
    rays = tilted_direction(0.0), tilted_direction(EDGE_RAD)
    radii = (
        np.linalg.norm(design.meet(design.center_m, np.array(rays)) - design.center_m, axis=1)
        / INCH_M
    )
    # A spheroid through apex and edge, solved for b: 1 / r^2 = cos^2 / a^2 + sin^2 / b^2.
    design_horizontal_in = np.sin(EDGE_RAD) / np.sqrt(
        radii[1] ** -2 - np.cos(EDGE_RAD) ** 2 / radii[0] ** 2
    )
    _, axes_m = dome.as_ellipsoid()
    horizontal_in = axes_m[0] / INCH_M
    vertical_in = axes_m[2] / INCH_M
    return {
        "design_apex": exact(radii[0]),
        "design_edge": exact(radii[1]),
        "design_change": exact(100 * (radii[0] / radii[1] - 1)),
        "design_across": exact(design_horizontal_in),
        "differs_v": exact(relative_difference(radii[0], vertical_in)),
        "differs_h": exact(relative_difference(design_horizontal_in, horizontal_in)),
        **rim_and_radii(dome),
        **best_sphere(dome),
    }


def relative_difference(a: float, b: float) -> float:
    """Difference of two lengths in percent of their mean (the thesis's definition)."""
    return float(200 * abs(a - b) / (a + b))


def intersections_in(dome: Surface, tilt_rad: Any) -> Floats:
    """(N, 3) points where rays from the bearing, tilted by tilt_rad, meet a surface extended beyond its rim; inches."""
    rays = np.array([tilted_direction(tilt) for tilt in np.atleast_1d(tilt_rad)])
    return replace(dome, rim=Rim(dome.rim.bearing_m)).meet(np.zeros(3), rays) / INCH_M


def rim_and_radii(dome: Surface) -> Results:
    """Rim of the measured surface (where it is as wide as the dome), and its distances from the bearing."""
    rim_rad = brentq(
        lambda tilt: intersections_in(dome, tilt)[0, 0] - DOME_WIDTH_IN / 2, 0.5, 0.9
    )
    rim = intersections_in(dome, rim_rad)[0]
    height = exact(intersections_in(dome, 0.0)[0, 2] - rim[2])
    tilt_rad = np.linspace(0, rim_rad, 4001)
    rho = np.linalg.norm(intersections_in(dome, tilt_rad), axis=1)
    return {
        "height": height,
        "height_by_axes": height,
        "rim_z": exact(rim[2]),
        "rim_rho": exact(float(np.linalg.norm(rim))),
        "rho_max": exact(rho.max()),
        "rho_max_at": exact(np.degrees(tilt_rad[rho.argmax()])),
    }


def best_sphere(dome: Surface) -> Results:
    """Least-squares sphere of the measured surface, sampled uniformly by area over the design's cap, and the rms of the
    contour's distance from it.

    The contour's points are uniform in polar angle, as those of a measuring arm moved along a meridian.
    """
    cap_rad = np.arcsin(DOME_WIDTH_IN / 2 / DESIGN_RADIUS_IN)
    fraction = (np.arange(SAMPLE_RINGS) + 0.5) / SAMPLE_RINGS
    profile_in = intersections_in(dome, np.arccos(1 - fraction * (1 - np.cos(cap_rad))))
    rotations = Rotation.from_euler(
        "z", np.arange(SAMPLE_SECTORS)[:, None] * (2 * np.pi / SAMPLE_SECTORS)
    )
    sphere = fit_sphere(
        np.concatenate([rotation.apply(profile_in) for rotation in rotations])
    )
    contour_in = intersections_in(dome, fraction * cap_rad)
    error_in = np.linalg.norm(contour_in - sphere.center_m, axis=1) - sphere.radius_m
    return {
        "best_sphere": exact(sphere.radius_m),
        "best_center": exact(float(sphere.center_m[2])),
        "best_rms": RowResult(
            exact(math.sqrt(np.mean(error_in**2))), f"weighted by area {sphere.rms_m:.3f}"
        ),
    }
