"""The inside of the dome as a surface in the lab frame: where rays meet it, its normals, its rim.

Every surface is a level set in a frame of its own, at its centre, upright before it is tilted. What a scene's
`light.surface.kind` names stands in SURFACES.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene import light
from skysim.sources.dome import point_cloud
from skysim.sources.dome.point_cloud import Believed, fit_ellipsoid

FLAT_RADIUS_M = 1e6  # of a sphere that is flat to a micrometre within a metre
RINGS, SECTORS = 60, 72  # of the samples by which a surface is told as an ellipsoid
MOST_STEPS = 200
SLACK_M = 1e-12  # a point on the rim itself, rounded, is within it


@dataclass(frozen=True, slots=True)
class Rim:
    """Where a surface ends, in its own frame.

    eye_m    : (3,) the bearing's centre as it was before the surface was displaced
    lowest_m : height of the lowest place
    half_rad : the greatest angle from the upright, seen from the eye
    """

    eye_m: Floats = field(default_factory=lambda: np.zeros(3))
    lowest_m: float = -math.inf
    half_rad: float = math.pi

    @property
    def nowhere(self) -> bool:
        """Whether the surface has no end."""
        return self.lowest_m == -math.inf and self.half_rad == math.pi

    def holds(self, own_m: Floats) -> NDArray[np.bool_]:
        """(N,) whether (N, 3) points of the surface's own frame are within; NaN is not."""
        seen = own_m - self.eye_m
        slack = SLACK_M - np.cos(self.half_rad) * np.linalg.norm(seen, axis=1)
        return np.asarray((own_m[:, 2] >= self.lowest_m - SLACK_M) & (seen[:, 2] + slack >= 0))


@dataclass(frozen=True, slots=True)
class Surface(ABC):
    """A surface seen from inside: a level set, negative inside, in a frame of its own that is displaced and tilted.

    centre_m       : (3,) origin of its own frame, in the lab
    lab_from_own   : its tilt
    survey_sigma_m : standard deviation, along the normal, of the lab's survey of it
    """

    centre_m: Floats
    rim: Rim = field(default_factory=Rim, kw_only=True)
    lab_from_own: Rotation = field(default_factory=Rotation.identity, kw_only=True)
    survey_sigma_m: float = field(default=0.0, kw_only=True)

    @abstractmethod
    def level(self, own_m: Floats) -> Floats:
        """(N,) negative inside, zero on the surface, of (N, 3) points in its own frame."""

    @abstractmethod
    def gradient(self, own_m: Floats) -> Floats:
        """(N, 3) the level's gradient, or a positive multiple of it, at points of the surface."""

    @abstractmethod
    def distance(self, start_m: Floats, along: Floats) -> Floats:
        """(N,) how many times its ray (N, 3) until a ray from inside leaves; NaN where it never does."""

    def within(self, own_m: Floats) -> NDArray[np.bool_]:
        """(N,) whether points of the level set belong to the surface."""
        return self.rim.holds(own_m)

    def meet(self, origin_m: Floats, rays: Floats) -> Floats:
        """(N, 3) points where rays (N, 3) of any length leave the inside; NaN where they miss or pass under the rim."""
        turn = self.lab_from_own.as_matrix()
        start, along = (origin_m - self.centre_m) @ turn, rays @ turn
        distance = self.distance(start, along)
        on_it = self.within(start + distance[:, None] * along)
        return np.asarray(origin_m + np.where(on_it, distance, np.nan)[:, None] * rays)

    def inward(self, points_m: Floats) -> Floats:
        """(N, 3) unit normals towards the inside, at points of the surface: minus the level's gradient."""
        turn = self.lab_from_own.as_matrix()
        gradient = self.gradient((points_m - self.centre_m) @ turn) @ turn.T
        return np.asarray(-gradient / np.linalg.norm(gradient, axis=1, keepdims=True))

    def inside(self, point_m: Floats) -> bool:
        """Whether a point of the lab, (3,), is inside; rim or none."""
        own = (point_m - self.centre_m) @ self.lab_from_own.as_matrix()
        return bool(self.level(own[None])[0] < 0)

    def samples_m(self) -> Floats:
        """(N, 3) points within the rim, in as equal shares of the cap that the bearing sees as rings allow."""
        lowest = np.cos(min(self.rim.half_rad, np.pi / 2))
        up = 1 - (np.arange(RINGS) + 0.5) / RINGS * (1 - lowest)
        azimuth = np.arange(SECTORS) * (2 * np.pi / SECTORS)
        level, turn = (one.ravel() for one in np.meshgrid(up, azimuth, indexing="ij"))
        out = np.sqrt(1 - level**2)
        rays = self.lab_from_own.apply(np.column_stack([out * np.cos(turn), out * np.sin(turn), level]))
        met = self.meet(np.zeros(3), rays)
        return met[np.isfinite(met[:, 0])]

    def believed(self) -> Believed:
        """The nearest ellipsoid: least squares over the surface within its rim."""
        return fit_ellipsoid(self.samples_m())

    def as_ellipsoid(self) -> tuple[Floats, Floats]:
        """Centre and semi-axes, (3,) each, m, by which an estimator knows the surface; `believed` has its rms too."""
        nearest = self.believed()
        return nearest.centre_m, nearest.semi_axes_m


def leaves(start: Floats, along: Floats) -> Floats:
    """(N,) the greater root s > 0 of |start + s along| = 1; NaN where there is none. Free of cancellation."""
    a, b, c = np.sum(along**2, axis=1), along @ start, start @ start - 1
    under = b**2 - a * c
    reach = np.abs(b) + np.sqrt(np.where((under >= 0) & (a > 0), under, np.nan))
    reach = np.where(reach > 0, reach, np.nan)
    far = np.where(b > 0, -c / reach, reach / np.where(a > 0, a, np.nan))
    return np.where(far > 0, far, np.nan)


@dataclass(frozen=True, slots=True)
class Ellipsoid(Surface):
    """sum((x / semi_axes)^2) = 1 in its own frame. A sphere has equal semi-axes."""

    semi_axes_m: Floats

    def level(self, own_m: Floats) -> Floats:
        return np.asarray(np.sum((own_m / self.semi_axes_m) ** 2, axis=1) - 1)

    def gradient(self, own_m: Floats) -> Floats:
        return np.asarray(own_m / self.semi_axes_m**2)

    def distance(self, start_m: Floats, along: Floats) -> Floats:
        return leaves(start_m / self.semi_axes_m, along / self.semi_axes_m)

    def believed(self) -> Believed:
        """Itself, unless it is tilted and no sphere."""
        if self.lab_from_own.magnitude() > 0 and np.ptp(self.semi_axes_m) > 0:
            return fit_ellipsoid(self.samples_m())
        return Believed(self.centre_m, self.semi_axes_m, 0.0)


@dataclass(frozen=True, slots=True)
class Plane(Surface):
    """A panel z = 0 in its own frame, seen from below.

    half_m : (2,) half its extent along its own x and y
    """

    half_m: Floats = field(default_factory=lambda: np.full(2, np.inf))

    @property
    def height_m(self) -> float:
        """Of its middle, above the bearing."""
        return float(self.centre_m[2])

    def level(self, own_m: Floats) -> Floats:
        return own_m[:, 2]

    def gradient(self, own_m: Floats) -> Floats:
        return np.tile([0.0, 0.0, 1.0], (len(own_m), 1))

    def distance(self, start_m: Floats, along: Floats) -> Floats:
        """Rays that point down never meet it."""
        distance = -start_m[2] / np.where(along[:, 2] > 0, along[:, 2], np.nan)
        return np.where(distance > 0, distance, np.nan)

    def within(self, own_m: Floats) -> NDArray[np.bool_]:
        return np.asarray(np.all(np.abs(own_m[:, :2]) <= self.half_m + SLACK_M, axis=1))

    def believed(self) -> Believed:
        """A sphere so great that it is flat to a micrometre within a metre."""
        up = self.lab_from_own.apply([0.0, 0.0, 1.0])
        return Believed(self.centre_m - FLAT_RADIUS_M * up, np.full(3, FLAT_RADIUS_M), 0.0)


@dataclass(frozen=True, slots=True)
class Cylinder(Surface):
    """(x / radius)^2 summed over the two axes across = 1 in its own frame.

    axis : 0, 1, 2 its own x, y, z
    """

    radius_m: float
    axis: int
    half_length_m: float = math.inf

    def semi_axes_m(self, along_m: float = math.inf) -> Floats:
        return np.where(np.arange(3) == self.axis, along_m, self.radius_m)

    def level(self, own_m: Floats) -> Floats:
        return np.asarray(np.sum((own_m / self.semi_axes_m()) ** 2, axis=1) - 1)

    def gradient(self, own_m: Floats) -> Floats:
        return np.asarray(own_m / self.semi_axes_m() ** 2)

    def distance(self, start_m: Floats, along: Floats) -> Floats:
        return leaves(start_m / self.semi_axes_m(), along / self.semi_axes_m())

    def within(self, own_m: Floats) -> NDArray[np.bool_]:
        ends = np.abs(own_m[:, self.axis]) <= self.half_length_m + SLACK_M
        return np.asarray(self.rim.holds(own_m) & ends)

    def believed(self) -> Believed:
        """An ellipsoid so long that it is straight, where it is not tilted."""
        if self.lab_from_own.magnitude() > 0:
            return fit_ellipsoid(self.samples_m())
        return Believed(self.centre_m, self.semi_axes_m(FLAT_RADIUS_M), 0.0)


class RadiusLaw(Protocol):
    """A surface's distance from its centre over direction: at most most_m, known to cover_rad from the axis."""

    @property
    def most_m(self) -> float: ...

    @property
    def cover_rad(self) -> float: ...

    def at(self, unit: Floats) -> tuple[Floats, Floats]:
        """(N,) radius over (N, 3) unit vectors, and (N, 3) its gradient (of which the part along the unit is free)."""


@dataclass(frozen=True, slots=True)
class Shell:
    """Inside of a formed wall: r = R - share t(angle), t linear from apex to base and then constant.

    share : of the wall that lies inside of R: 1 where R is the outside's, 1/2 where it is the middle's
    AFIT's design contour, 48.033 in at the apex and 48.010 in at 40 deg (Padro 2012, sec. 3.7), follows from its
    0.2036 in and 0.25 in of acrylic about R = 48.135 in as the middle's; as the outside's it does not.
    """

    most_m: float
    share: float
    thickness_m: tuple[float, float]
    base_rad: float
    cover_rad: float = math.pi

    def at(self, unit: Floats) -> tuple[Floats, Floats]:
        out = np.hypot(unit[:, 0], unit[:, 1])
        angle = np.arctan2(out, unit[:, 2])
        slope = -self.share * (self.thickness_m[1] - self.thickness_m[0]) / self.base_rad
        radius = self.most_m - self.share * self.thickness_m[0] + slope * np.minimum(angle, self.base_rad)
        # The unit vector towards greater angles; none at the apex itself, where the law has its tip.
        around = np.column_stack([unit[:, :2] * (unit[:, 2] / np.where(out > 0, out, np.inf))[:, None], -out])
        return radius, np.where(angle < self.base_rad, slope, 0.0)[:, None] * around


@dataclass(frozen=True, slots=True)
class Radial(Surface):
    """|x| = r(x / |x|) in its own frame: one radius in every direction from its centre.

    survey : the points that it was fitted to, if it was
    """

    radius: RadiusLaw
    survey: point_cloud.Survey | None = None

    def level(self, own_m: Floats) -> Floats:
        return self.level_and_gradient(own_m)[0]

    def gradient(self, own_m: Floats) -> Floats:
        return self.level_and_gradient(own_m)[1]

    def level_and_gradient(self, own_m: Floats) -> tuple[Floats, Floats]:
        """(N,) |x| - r and (N, 3) x/|x| - (grad r - its part along x)/|x|."""
        far = np.linalg.norm(own_m, axis=1, keepdims=True)
        far = np.where(far > 0, far, np.finfo(float).tiny)  # at the centre itself every direction will do
        unit = own_m / far
        radius, slope = self.radius.at(unit)
        across = slope - np.sum(slope * unit, axis=1, keepdims=True) * unit
        return far[:, 0] - radius, unit - across / far

    def within(self, own_m: Floats) -> NDArray[np.bool_]:
        cosine = own_m[:, 2] - np.cos(self.radius.cover_rad) * np.linalg.norm(own_m, axis=1)
        return np.asarray(self.rim.holds(own_m) & (cosine >= -SLACK_M))

    def distance(self, start_m: Floats, along: Floats) -> Floats:
        """Newton's steps inside of a bracket that always holds a crossing: the level is negative below, not so above.

        The bracket ends on the sphere of the greatest radius. A step that leaves it, or follows one that did not halve
        the level, is a bisection; so it ends. Only a level of some roundings is a result: raises ArithmeticError
        otherwise. An inside that is convex is left but once; of several crossings it would be one.
        """
        low, high = np.zeros(len(along)), leaves(start_m / self.radius.most_m, along / self.radius.most_m)
        if self.level(start_m[None])[0] >= 0:
            return np.full(len(along), np.nan)
        distance, before = high.copy(), np.full(len(along), np.inf)
        for _ in range(MOST_STEPS):
            level, gradient = self.level_and_gradient(start_m + distance[:, None] * along)
            open_ = np.abs(level) > 16 * np.finfo(float).eps * self.radius.most_m
            if not open_.any():
                return distance
            low, high = np.where(level < 0, distance, low), np.where(level > 0, distance, high)
            slope = np.sum(gradient * along, axis=1)
            step = distance - level / np.where(slope > 0, slope, np.nan)
            newton = (step > low) & (step < high) & (np.abs(level) <= before / 2)
            before = np.abs(level)
            distance = np.where(open_, np.where(newton, step, (low + high) / 2), distance)
        raise ArithmeticError(f"{open_.sum()} rays do not settle on the surface in {MOST_STEPS} steps")


def placed(part: light.SurfaceConfig, centre_m: float) -> dict[str, Any]:
    """Where a scene puts an upright surface whose centre is so high above the bearing: what every Surface takes."""
    height_m, half_deg = getattr(part, "rim_height_m", None), getattr(part, "rim_deg", None)
    lowest_m = -math.inf if height_m is None else height_m - centre_m
    half_rad = math.pi if half_deg is None else math.radians(half_deg)
    return {
        "centre_m": np.array([0.0, 0.0, centre_m]) + part.offset_m,
        "rim": Rim(np.array([0.0, 0.0, -centre_m]), lowest_m, half_rad),
        "lab_from_own": Rotation.from_euler("xy", part.tilt_deg, degrees=True),
        "survey_sigma_m": part.error_m,
    }


def sphere(part: light.SphereSurfaceConfig) -> Surface:
    """A sphere whose top is part.apex_m above the bearing, or the inside of a wall about one."""
    if part.wall is None:
        return Ellipsoid(semi_axes_m=np.full(3, part.radius_m), **placed(part, part.apex_m - part.radius_m))
    thickness_m = (part.wall.thickness_apex_m, part.wall.thickness_base_m)
    share = {"outside": 1.0, "mid_wall": 0.5}[part.wall.radius_of]
    law = Shell(part.radius_m, share, thickness_m, math.radians(part.wall.base_deg))
    return Radial(radius=law, **placed(part, part.apex_m - part.radius_m + share * thickness_m[0]))


def ellipsoid(part: light.EllipsoidSurfaceConfig) -> Surface:
    """An ellipsoid with its top part.apex_m above the bearing."""
    axes_m = np.array(part.semi_axes_m)
    return Ellipsoid(semi_axes_m=axes_m, **placed(part, part.apex_m - axes_m[2]))


def flat(part: light.FlatSurfaceConfig) -> Surface:
    """A panel whose middle is part.apex_m above the bearing."""
    size_m = [math.inf if one is None else one for one in (part.width_m, part.height_m)]
    return Plane(half_m=np.array(size_m) / 2, **placed(part, part.apex_m))


def cylinder(part: light.CylinderSurfaceConfig) -> Surface:
    """A vault whose top line is part.apex_m above the bearing, or a drum whose upper edge is."""
    half_m = math.inf if part.length_m is None else part.length_m / 2
    below_m = half_m if part.axis == "z" else part.radius_m
    where = placed(part, part.apex_m - below_m)
    return Cylinder(radius_m=part.radius_m, axis="xyz".index(part.axis), half_length_m=half_m, **where)


def surveyed(part: light.SurveyedSurfaceConfig) -> Surface:
    """What a measuring arm found, made smooth; tilted about the origin of its points. Raises InputError."""
    found = point_cloud.fit(point_cloud.read(part.file, part.unit), part.degree, part.file)
    if found.rms_m > part.rms_limit_m:
        raise InputError(
            f"light.surface.file: {part.file}: the points lie {found.rms_m:.3g} m rms off a smooth surface"
            f" (worst {found.worst_m:.3g} m); allowed: rms_limit {part.rms_limit_m:g} m, a greater degree, another unit"
        )
    where = placed(part, 0.0)
    where["centre_m"] = part.offset_m + where["lab_from_own"].apply(found.centre_m)
    where["rim"] = Rim(-found.centre_m, where["rim"].lowest_m - found.centre_m[2], where["rim"].half_rad)
    told = part.rim_height_m is not None or part.rim_deg is not None
    if told and where["rim"].holds(found.edge_m()).any():
        raise InputError(
            f"light.surface: the points of {part.file} do not reach the rim; allowed: a rim within"
            f" {np.degrees(found.law.cover_rad):.2f} deg about their best sphere's centre"
        )
    return Radial(radius=found.law, survey=found, **where)


SURFACES: dict[str, Callable[[Any], Surface]] = {
    "sphere": sphere,
    "ellipsoid": ellipsoid,
    "flat": flat,
    "cylinder": cylinder,
    "surveyed": surveyed,
}


def build_surface(part: light.SurfaceConfig) -> Surface:
    """The surface that a scene describes. Raises InputError unless the bearing is inside of it and sees some of it."""
    made = SURFACES[part.kind](part)
    if not made.inside(np.zeros(3)):
        check = "file, unit, offset" if part.kind == "surveyed" else "apex, sizes and offset"
        where = "not below the panel" if isinstance(made, Plane) else "outside of the dome"
        raise InputError(f"light.surface: the bearing's centre is {where}; check {check}")
    if not len(made.samples_m()):
        raise InputError(
            "light.surface: none of it is left above the bearing; check rim, width, height, length"
        )
    return made


class Inside(Protocol):
    """A surface, as far as LEDs have to know it."""

    def meet(self, origin_m: Floats, rays: Floats) -> Floats:
        """(N, 3) points where rays from the inside leave it."""

    def inward(self, points_m: Floats) -> Floats:
        """(N, 3) unit normals towards the inside."""

    def inside(self, point_m: Floats) -> bool:
        """Whether a point is inside."""
