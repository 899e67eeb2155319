"""The inside of the dome as a surface in the lab frame: ray intersection, normals, rim.

Every surface is a level set f(x) = 0 in its own frame, f < 0 inside. The frame's origin is the surface's center; its
axes are the lab's unless the surface is tilted. A ray from the inside meets the surface where f first becomes zero:
in closed form for planes and quadrics (`exit_distance`), by safeguarded Newton steps for a radius over
direction (`Radial`). SURFACES maps the scene's `light.surface.kind` to the function that builds the surface.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import (
    UP,
    Array,
    Bools,
    Floats,
    Record,
    around_z,
    frozen,
    lengths,
    normalized,
    positive,
)
from skysim.scene.sections import light
from skysim.sources.dome import point_cloud
from skysim.sources.dome.point_cloud import FittedEllipsoid, fit_ellipsoid

FLAT_RADIUS_M = 1e6  # radius of a sphere that is flat to a micrometer within a meter
# Samples to which an ellipsoid is fitted.
RINGS = 60
SECTORS = 72
MAX_STEPS = 200  # of the ray intersection
SLACK_M = 1e-12  # rounding tolerance that keeps points on the rim within it


@frozen
class Rim:
    """The end of a surface, in its own frame.

    Attributes
    ----------
    bearing_m
        (3,) center of the bearing before the surface was displaced
    lowest_m
        Height of the lowest point of the surface
    half_rad
        Greatest angle from the upright axis, seen from the bearing
    """

    bearing_m: Floats = field(default_factory=lambda: np.zeros(3))
    lowest_m: float = -math.inf
    half_rad: float = math.pi

    @property
    def unbounded(self) -> bool:
        """Whether the surface has no end."""
        return self.lowest_m == -math.inf and self.half_rad == math.pi

    def contains(self, own_m: Floats) -> Bools:
        """(N,) whether (N, 3) points in the surface's own frame are within the rim; False for NaN."""
        # cos(angle) >= cos(half_rad), times the distance from the bearing.
        from_bearing_m = own_m - self.bearing_m
        slack = SLACK_M - np.cos(self.half_rad) * lengths(from_bearing_m)
        return (own_m[:, 2] >= self.lowest_m - SLACK_M) & (from_bearing_m[:, 2] + slack >= 0)


@frozen
class Surface(ABC):
    """A surface seen from inside: a level set, negative inside, in its own displaced and tilted frame.

    Attributes
    ----------
    center_m
        (3,) origin of its own frame, in the lab
    rim
        The surface's end
    lab_from_own
        The surface's tilt
    survey_sigma_m
        Standard deviation, along the normal, of the lab's survey of the surface
    """

    center_m: Floats
    rim: Rim = field(default_factory=Rim, kw_only=True)
    lab_from_own: Rotation = field(default_factory=Rotation.identity, kw_only=True)
    survey_sigma_m: float = field(default=0.0, kw_only=True)

    @abstractmethod
    def level_and_gradient(self, own_m: Floats) -> tuple[Floats, Floats]:
        """(N,) level f at (N, 3) points in the surface's own frame, and (N, 3) a positive multiple of its gradient.

        The level is negative inside and zero on the surface.
        """

    @abstractmethod
    def distance(self, start_m: Floats, along: Floats) -> Floats:
        """(N,) distance at which a ray from the inside leaves, in lengths of `along` (N, 3); NaN if it never leaves."""

    def within(self, own_m: Floats) -> Bools:
        """(N,) whether points of the level set belong to the surface."""
        return self.rim.contains(own_m)

    def meet(self, origin_m: Floats, rays: Floats) -> Floats:
        """(N, 3) points where rays (N, 3) of any length leave the inside; NaN where they miss or pass below the rim."""
        start, along = self.own_rays(origin_m, rays)
        distance = self.distance(start, along)
        within = self.within(start + distance[:, None] * along)
        return origin_m + np.where(within, distance, np.nan)[:, None] * rays

    def from_bearing(self, rays: Floats) -> Floats:
        """(..., 3) points where rays (..., 3) from the bearing's center leave the inside; NaN as in `meet`."""
        return self.meet(np.zeros(3), rays.reshape(-1, 3)).reshape(rays.shape)

    def exit_m(self, origin_m: Floats, rays: Floats) -> Floats:
        """(N,) distances of rays in the lab's axes to the surface, or to its continuation beyond the rim."""
        return self.distance(*self.own_rays(origin_m, rays))

    def own_rays(self, origin_m: Floats, rays: Floats) -> tuple[Floats, Floats]:
        """Origin and rays of the lab in the surface's own frame; a rotation keeps lengths and distances."""
        R_lab_from_own = self.lab_from_own.as_matrix()
        return (origin_m - self.center_m) @ R_lab_from_own, rays @ R_lab_from_own

    def inward(self, points_m: Floats) -> Floats:
        """(N, 3) unit normals toward the inside, at points of the surface: minus the level's gradient."""
        R_lab_from_own = self.lab_from_own.as_matrix()
        _, gradient = self.level_and_gradient((points_m - self.center_m) @ R_lab_from_own)
        return -normalized(gradient @ R_lab_from_own.T)

    def inside(self, point_m: Floats) -> bool:
        """Whether a point (3,) of the lab is inside; the rim is ignored."""
        own = (point_m - self.center_m) @ self.lab_from_own.as_matrix()
        return bool(self.level_and_gradient(own[None])[0] < 0)

    def samples_m(self) -> Floats:
        """(N, 3) points of the surface within its rim, on rings of equal solid angle as seen from the bearing."""
        # Rings of equal steps in z have equal solid angles.
        min_z = np.cos(min(self.rim.half_rad, np.pi / 2))
        ring_z = 1 - (np.arange(RINGS) + 0.5) / RINGS * (1 - min_z)
        sectors = circle_rad(SECTORS)
        rays = unit_vectors(ring_z[:, None], sectors).reshape(-1, 3)
        # Keep the rays that meet the surface within its rim.
        met = self.from_bearing(self.lab_from_own.apply(rays))
        return met[np.isfinite(met[:, 0])]

    def nearest_ellipsoid(self) -> FittedEllipsoid:
        """The nearest ellipsoid: a least-squares fit to `samples_m`."""
        return fit_ellipsoid(self.samples_m())

    def as_ellipsoid(self) -> tuple[Floats, Floats]:
        """Center and semi-axes of the ellipsoid that estimators use, (3,) each in m: `nearest_ellipsoid`."""
        return self.nearest_ellipsoid()[:2]


def circle_rad(count: int) -> Floats:
    """(N,) azimuths all around, evenly spaced from 0."""
    return np.arange(count, dtype=float) * (2 * np.pi / count)


def unit_vectors(z: Array, azimuth: Array) -> Floats:
    """(..., 3) unit vectors at heights z = cos(angle from +z) and azimuths from +x toward +y; these are broadcast."""
    return around_z(np.sqrt(1 - z**2), azimuth, z)


def directions(tilt_rad: Floats, azimuth_rad: Floats | float) -> Floats:
    """(..., 3) unit vectors at angles from +z and azimuths from +x toward +y; these are broadcast."""
    return around_z(np.sin(tilt_rad), azimuth_rad, np.cos(tilt_rad))


def perpendicular(unit: Floats) -> Floats:
    """(N, 3) one unit vector perpendicular to each of (N, 3) unit vectors; along the surface for its normals."""
    # The axis on which the vector has its least component is never parallel to it.
    return normalized(np.cross(unit, np.eye(3)[np.abs(unit).argmin(axis=1)]))


def exit_distance(start: Floats, along: Floats) -> Floats:
    """(N,) the greater root s > 0 of |start + s along| = 1; NaN where there is none.

    a s^2 + 2 b s + c = 0. With q = |b| + sqrt(b^2 - a c) the greater root is -c / q for b > 0 and q / a otherwise, free
    of cancellation.
    """
    a = np.sum(along**2, axis=1)
    b = along @ start
    c = start @ start - 1
    discriminant = b**2 - a * c
    q = np.abs(b) + np.sqrt(np.where((discriminant >= 0) & (a > 0), discriminant, np.nan))
    q = positive(q)
    root = np.where(b > 0, -c / q, q / positive(a))
    return positive(root)


@frozen
class Ellipsoid(Surface):
    """An ellipsoid: sum((x / semi_axes)^2) = 1 in its own frame. A sphere has equal semi-axes."""

    semi_axes_m: Floats

    def level_and_gradient(self, own_m: Floats) -> tuple[Floats, Floats]:
        level = np.sum((own_m / self.semi_axes_m) ** 2, axis=1) - 1
        return level, own_m / self.semi_axes_m**2

    def distance(self, start_m: Floats, along: Floats) -> Floats:
        return exit_distance(start_m / self.semi_axes_m, along / self.semi_axes_m)

    def nearest_ellipsoid(self) -> FittedEllipsoid:
        """The ellipsoid itself; a fit if it is tilted and not a sphere."""
        # A sphere is the same at every tilt.
        if self.lab_from_own.magnitude() > 0 and np.ptp(self.semi_axes_m) > 0:
            return fit_ellipsoid(self.samples_m())
        # An infinite axis becomes one so long that the ellipsoid is straight.
        semi_axes_m = np.minimum(self.semi_axes_m, FLAT_RADIUS_M)
        return FittedEllipsoid(self.center_m, semi_axes_m, 0.0)


@frozen
class Plane(Surface):
    """A panel at z = 0 in its own frame, seen from below.

    Attributes
    ----------
    half_m
        (2,) half the panel's extent along its own x and y
    """

    half_m: Floats = field(default_factory=lambda: np.full(2, np.inf))

    def level_and_gradient(self, own_m: Floats) -> tuple[Floats, Floats]:
        return own_m[:, 2], np.tile(UP, (len(own_m), 1))

    def distance(self, start_m: Floats, along: Floats) -> Floats:
        """As `Surface.distance`; NaN for rays that point down."""
        # Only rays that point up meet the panel.
        distance = -start_m[2] / positive(along[:, 2])
        return positive(distance)

    def within(self, own_m: Floats) -> Bools:
        return np.all(np.abs(own_m[:, :2]) <= self.half_m + SLACK_M, axis=1)

    def nearest_ellipsoid(self) -> FittedEllipsoid:
        """A sphere so large that it is flat to a micrometer within a meter."""
        up = self.lab_from_own.apply(UP)
        return FittedEllipsoid(
            self.center_m - FLAT_RADIUS_M * up, np.full(3, FLAT_RADIUS_M), 0.0
        )


@frozen
class Cylinder(Ellipsoid):
    """A cylinder: an ellipsoid with an infinite semi-axis along an axis of its own frame.

    Attributes
    ----------
    half_length_m
        Half the extent along the axis
    """

    half_length_m: float = math.inf

    def within(self, own_m: Floats) -> Bools:
        along_m = own_m[:, self.semi_axes_m.argmax()]
        return self.rim.contains(own_m) & (np.abs(along_m) <= self.half_length_m + SLACK_M)


@frozen
class Shell:
    """Inner radius of a formed wall: r = R - f t(angle), with t linear from apex to base and constant beyond.

    AFIT's design contour, 48.033 in at the apex and 48.010 in at 40 deg (Padro 2012, sec. 3.7), follows from its
    0.2036 in and 0.25 in of acrylic about R = 48.135 in as the mid-wall radius. With R as the outer radius it does
    not.

    Attributes
    ----------
    max_m
        R, the upper bound of the radius
    inner_fraction
        f, the fraction of the wall's thickness inside R: 1 if R is the outer radius, 1/2 if it is the mid-wall's
    thickness_m
        Thickness at the apex and at the base
    base_rad
        Angle of the base from the axis
    cover_rad
        Angle from the axis up to which the radius is defined
    """

    max_m: float
    inner_fraction: float
    thickness_m: tuple[float, float]
    base_rad: float
    cover_rad: float = math.pi

    def evaluate(self, unit: Floats) -> tuple[Floats, Floats]:
        """(N,) radius over (N, 3) unit vectors, and (N, 3) its gradient on the unit sphere."""
        ring = np.hypot(*unit.T[:2])
        angle = np.arctan2(ring, unit[:, 2])
        # dr / d(angle) between apex and base.
        slope = (
            -self.inner_fraction * (self.thickness_m[1] - self.thickness_m[0]) / self.base_rad
        )
        at_apex = self.max_m - self.inner_fraction * self.thickness_m[0]
        radius = at_apex + slope * np.minimum(angle, self.base_rad)
        # Unit vector toward greater angles; zero at the apex, where the law has no tangent.
        tangent = np.column_stack(
            [unit[:, :2] * (unit[:, 2] / np.where(ring > 0, ring, np.inf))[:, None], -ring]
        )
        return radius, np.where(angle < self.base_rad, slope, 0.0)[:, None] * tangent


@frozen
class Radial(Surface):
    """|x| = r(x / |x|) in its own frame: one radius in every direction from its center.

    Attributes
    ----------
    radius
        Law of the radius over direction
    fit
        The fit to measured points that gave it, if any
    """

    radius: Shell | point_cloud.Zernike
    fit: point_cloud.SurfaceFit | None = None

    def level_and_gradient(self, own_m: Floats) -> tuple[Floats, Floats]:
        """(N,) level f = |x| - r and (N, 3) its gradient x/|x| - (grad r less its part along x) / |x|."""
        distance_m = lengths(own_m)[:, None]
        # The least positive number avoids 0 / 0 at the center.
        distance_m = np.where(distance_m > 0, distance_m, np.finfo(float).tiny)
        unit = own_m / distance_m
        radius, slope = self.radius.evaluate(unit)
        # The gradient of r across x.
        across = slope - np.sum(slope * unit, axis=1, keepdims=True) * unit
        return distance_m[:, 0] - radius, unit - across / distance_m

    def within(self, own_m: Floats) -> Bools:
        """(N,) whether points are within the rim and in directions for which the radius is defined."""
        cosine = own_m[:, 2] - np.cos(self.radius.cover_rad) * lengths(own_m)
        return self.rim.contains(own_m) & (cosine >= -SLACK_M)

    def distance(self, start_m: Floats, along: Floats) -> Floats:
        """Newton's method within a bracket, for all rays at once.

        1. The level is negative at the bracket's low end, the start, and not negative at its high end, on the sphere of
           the greatest radius.
        2. The point of the last step replaces one of the ends.
        3. Take Newton's step, or bisect if that step would leave the bracket or the last step did not halve the level;
           so the iteration converges.

        A ray leaves a convex inside only once; otherwise one of several crossings is found.

        Raises
        ------
        ArithmeticError
            If a level larger than a few roundings remains.
        """
        # 1.
        low = np.zeros(len(along))
        high = exit_distance(start_m / self.radius.max_m, along / self.radius.max_m)
        if self.level_and_gradient(start_m[None])[0] >= 0:
            return np.full(len(along), np.nan)
        distance = high.copy()
        before = np.full(len(along), np.inf)
        for _ in range(MAX_STEPS):
            level, gradient = self.level_and_gradient(start_m + distance[:, None] * along)
            # Rays that have not converged; those that have keep their distance.
            unconverged = np.abs(level) > 16 * np.finfo(float).eps * self.radius.max_m
            if not unconverged.any():
                return distance
            # 2.
            low = np.where(level < 0, distance, low)
            high = np.where(level > 0, distance, high)
            # 3.
            # Derivative of the level along the ray.
            slope = np.sum(gradient * along, axis=1)
            step = distance - level / positive(slope)
            newton = (step > low) & (step < high) & (np.abs(level) <= before / 2)
            before = np.abs(level)
            distance = np.where(
                unconverged, np.where(newton, step, (low + high) / 2), distance
            )
        raise ArithmeticError(
            f"no convergence on the surface for {unconverged.sum()} rays in {MAX_STEPS} steps"
        )


def pose_and_rim(config: light.SurfaceConfig, center_m: float) -> Record:
    """Arguments common to all surfaces: center, rim, tilt, survey error.

    center_m is the height of the surface's center above the bearing. Own and lab frame differ by it before the tilt.
    """
    height_m = getattr(config, "rim_height_m", None)
    half_deg = getattr(config, "rim_deg", None)
    # The rim's height from the surface's center.
    lowest_m = -math.inf if height_m is None else height_m - center_m
    half_rad = math.pi if half_deg is None else math.radians(half_deg)
    return {
        "center_m": np.array([0.0, 0.0, center_m]) + config.offset_m,
        "rim": Rim(np.array([0.0, 0.0, -center_m]), lowest_m, half_rad),
        "lab_from_own": Rotation.from_euler("xy", config.tilt_deg, degrees=True),
        "survey_sigma_m": config.error_m,
    }


def sphere(config: light.SphereSurfaceConfig) -> Surface:
    """A sphere with its top at part.apex_m above the bearing, or the inner face of a formed wall."""
    if config.wall is None:
        return Ellipsoid(
            semi_axes_m=np.full(3, config.radius_m),
            **pose_and_rim(config, config.apex_m - config.radius_m),
        )
    thickness_m = (config.wall.thickness_apex_m, config.wall.thickness_base_m)
    inner_fraction = {"outside": 1.0, "mid_wall": 0.5}[config.wall.radius_of]
    shell = Shell(
        config.radius_m, inner_fraction, thickness_m, math.radians(config.wall.base_deg)
    )
    return Radial(
        radius=shell,
        **pose_and_rim(
            config, config.apex_m - config.radius_m + inner_fraction * thickness_m[0]
        ),
    )


def ellipsoid(config: light.EllipsoidSurfaceConfig) -> Surface:
    """An ellipsoid with its top at part.apex_m above the bearing."""
    axes_m = np.array(config.semi_axes_m)
    return Ellipsoid(semi_axes_m=axes_m, **pose_and_rim(config, config.apex_m - axes_m[2]))


def flat(config: light.FlatSurfaceConfig) -> Surface:
    """A panel with its center at part.apex_m above the bearing."""
    size_m = [
        math.inf if side_m is None else side_m for side_m in (config.width_m, config.height_m)
    ]
    return Plane(half_m=np.array(size_m) / 2, **pose_and_rim(config, config.apex_m))


def cylinder(config: light.CylinderSurfaceConfig) -> Surface:
    """A vault with its top line, or a drum with its upper edge, at part.apex_m above the bearing."""
    half_m = math.inf if config.length_m is None else config.length_m / 2
    below_m = half_m if config.axis == "z" else config.radius_m
    pose = pose_and_rim(config, config.apex_m - below_m)
    semi_axes_m = np.full(3, config.radius_m)
    semi_axes_m["xyz".index(config.axis)] = math.inf
    return Cylinder(semi_axes_m=semi_axes_m, half_length_m=half_m, **pose)


def surveyed(config: light.SurveyedSurfaceConfig) -> Surface:
    """A smooth surface fitted to measured points, tilted about the origin of the points.

    Raises
    ------
    InputError
        For points that are far from a smooth surface, or do not reach the rim.
    """
    # A bad fit means wrong points, units or degree.
    fit = point_cloud.fit(
        point_cloud.read(config.file, config.unit), config.degree, config.file
    )
    if fit.rms_m > config.rms_limit_m:
        raise InputError(
            "light.surface.file",
            f"{config.file}: the points are {fit.rms_m:.3g} m rms off a smooth surface (worst {fit.max_residual_m:.3g}"
            " m)",
            f"rms_limit {config.rms_limit_m:g} m, a higher degree, another unit",
        )
    pose = pose_and_rim(config, 0.0)
    # The origin of the surface's frame is the center of the best sphere; the scene gives tilt and rim in the frame of
    # the points.
    pose["center_m"] = config.offset_m + pose["lab_from_own"].apply(fit.center_m)
    pose["rim"] = Rim(
        -fit.center_m, pose["rim"].lowest_m - fit.center_m[2], pose["rim"].half_rad
    )
    has_rim = config.rim_height_m is not None or config.rim_deg is not None
    if has_rim and pose["rim"].contains(fit.edge_m()).any():
        raise InputError(
            "light.surface",
            f"the points of {config.file} do not reach the rim",
            f"a rim within {np.degrees(fit.radius.cover_rad):.2f} deg about their best sphere's center",
        )
    return Radial(radius=fit.radius, fit=fit, **pose)


# Surfaces by the name in the scene, `light.surface.kind`.
SURFACES: dict[str, Callable[[Any], Surface]] = {
    "sphere": sphere,
    "ellipsoid": ellipsoid,
    "flat": flat,
    "cylinder": cylinder,
    "surveyed": surveyed,
}


def build_surface(config: light.SurfaceConfig) -> Surface:
    """The surface of a scene.

    Raises
    ------
    InputError
        If the bearing's center is outside of the surface or sees no part of it.
    """
    surface = SURFACES[config.kind](config)
    if not surface.inside(np.zeros(3)):
        check = (
            "file, unit, offset" if config.kind == "surveyed" else "apex, sizes and offset"
        )
        place = "not below the panel" if isinstance(surface, Plane) else "outside of the dome"
        raise InputError("light.surface", f"the bearing's center is {place}; check {check}")
    if not len(surface.samples_m()):
        raise InputError(
            "light.surface",
            "no part of it is above the bearing; check rim, width, height, length",
        )
    return surface


# Area of a dome's surface over a cap of directions from the bearing.


AREA_RINGS = 200
AREA_SECTORS = 180


def cap_area_m2(surface: Surface, cap_deg: float) -> float:
    """Area in m^2 of a surface within an angle from the zenith, seen from the bearing.

    Of a panel with sides it is the whole area. Else a cone of directions of solid angle dW about the unit vector u
    meets the surface at the distance r, where its inward normal is n, in the area

        dA = r^2 dW / -(u . n),

    integrated over the cosine of the zenith angle by Gauss and Legendre's rule, and over the azimuth in equal steps,
    which is exact to rounding for a smooth surface. A rim within the angle is resolved to one part in AREA_RINGS.
    """
    if isinstance(surface, Plane) and np.isfinite(surface.half_m).all():
        return float(np.prod(2 * surface.half_m))
    # Nodes in the cosine from 1 to that of the cap.
    node, weight = np.polynomial.legendre.leggauss(AREA_RINGS)
    least = np.cos(np.radians(cap_deg))
    cosine = (1 + least) / 2 + (1 - least) / 2 * node
    azimuth = circle_rad(AREA_SECTORS)
    rays = unit_vectors(cosine[:, None], azimuth).reshape(-1, 3)
    place_m = surface.from_bearing(rays)
    met = np.isfinite(place_m[:, 0])
    place_m = place_m[met]
    rays = rays[met]
    # dA / dW, and the weights dW.
    element_m2 = np.sum(place_m**2, axis=1) / -np.sum(rays * surface.inward(place_m), axis=1)
    solid = (
        np.repeat(weight, AREA_SECTORS)[met] * (1 - least) / 2 * (2 * np.pi / AREA_SECTORS)
    )
    return float(element_m2 @ solid)
