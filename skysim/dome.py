"""The inside of the dome and the LEDs on it, in the lab frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from skysim import light
from skysim.photometry import Band, led_strength_e_s_sr, radiant_strength_e_s_sr
from skysim.types import BadInput, Floats, Sources

HOLES = 9  # on a patch board; LED number = board * HOLES + hole
GOLDEN_ANGLE_RAD = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """sum(((x - centre) / semi_axes)^2) = 1, seen from inside. A sphere has equal semi-axes."""

    centre_m: Floats
    semi_axes_m: Floats

    def meet(self, origin_m: Floats, rays: Floats) -> Floats:
        """(N, 3) points where rays leave the inside: a quadratic in the scaled coordinates."""
        start, along = (origin_m - self.centre_m) / self.semi_axes_m, rays / self.semi_axes_m
        a, b, c = np.sum(along**2, axis=1), along @ start, start @ start - 1
        return origin_m + ((-b + np.sqrt(b**2 - a * c)) / a)[:, None] * rays

    def inward(self, points_m: Floats) -> Floats:
        """(N, 3) unit normals towards the inside: minus the gradient."""
        gradient = (points_m - self.centre_m) / self.semi_axes_m**2
        return -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)

    def as_ellipsoid(self) -> tuple[Floats, Floats]:
        """Centre and semi-axes, (3,) each, m."""
        return self.centre_m, self.semi_axes_m


@dataclass(frozen=True, slots=True)
class Plane:
    """A flat panel z = height, seen from below."""

    height_m: float

    def meet(self, origin_m: Floats, rays: Floats) -> Floats:
        """(N, 3) points where rays meet the panel; rays that point down never do and give NaN."""
        distance = (self.height_m - origin_m[2]) / np.where(rays[:, 2] > 0, rays[:, 2], np.nan)
        return origin_m + distance[:, None] * rays

    def inward(self, points_m: Floats) -> Floats:
        """(N, 3) unit normals, straight down."""
        return np.tile([0.0, 0.0, -1.0], (len(points_m), 1))

    def as_ellipsoid(self) -> tuple[Floats, Floats]:
        """A sphere so great (1000 km) that it is flat to a micrometre within a metre."""
        radius_m = 1e6
        return np.array([0.0, 0.0, self.height_m - radius_m]), np.full(3, radius_m)


Surface = Ellipsoid | Plane


def sphere(part: light.Surface) -> Surface:
    """A sphere of part.radius_m whose top is part.apex_m above the bearing."""
    radius = float(part.radius_m or 0)
    return Ellipsoid(np.array([0, 0, part.apex_m - radius]) + part.offset_m, np.full(3, radius))


def ellipsoid(part: light.Surface) -> Surface:
    """An ellipsoid with its axes along the lab's, its top part.apex_m above the bearing."""
    axes = np.array(part.semi_axes_m)
    return Ellipsoid(np.array([0, 0, part.apex_m - axes[2]]) + part.offset_m, axes)


def flat(part: light.Surface) -> Surface:
    """A horizontal panel part.apex_m above the bearing."""
    return Plane(part.apex_m + part.offset_m[2])


SURFACES: dict[str, Callable[[light.Surface], Surface]] = {
    "sphere": sphere,
    "ellipsoid": ellipsoid,
    "flat": flat,
}


def surface(part: light.Surface) -> Surface:
    """The surface that a scene describes. Raises BadInput unless the bearing is inside of it."""
    made = SURFACES[part.kind](part)
    if isinstance(made, Ellipsoid) and np.sum((made.centre_m / made.semi_axes_m) ** 2) >= 1:
        raise BadInput("light.surface: the bearing's centre is outside of the dome; check apex and semi_axes")
    if isinstance(made, Plane) and made.height_m <= 0:
        raise BadInput("light.surface: the panel is not above the bearing's centre; check apex and offset")
    return made


def cap(count: int, half_angle_rad: float) -> Floats:
    """(count, 3) unit vectors spread evenly over a cap about +z: Fibonacci's spiral, equal areas in z."""
    n = np.arange(count) + 0.5
    z = 1 - n / count * (1 - np.cos(half_angle_rad))
    ring = np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(n * GOLDEN_ANGLE_RAD), ring * np.sin(n * GOLDEN_ANGLE_RAD), z])


def patch_boards(part: light.PatchBoards, inside: Surface, led: light.Led, band: Band) -> Sources:
    """3x3 boards glued flat to the surface, each turned at random, with its own choice of LEDs and levels.

    Boards are spread evenly over the cap as seen from the bearing. A board is a plane tangent at its middle, so
    that its outer LEDs stand off the surface as on the real thing. Everything random here is the hardware's and
    comes from part.hardware_seed: which LEDs are soldered, how bright each is, the phase of its pulses.
    Brightness is lognormal about led.intensity_cd: the logarithm's standard deviation is led.scatter, AFIT's
    Table 2 has .07 to .09.
    """
    rng = np.random.default_rng(part.hardware_seed)
    half = np.radians(part.cap_deg)
    apex = inside.meet(np.zeros(3), np.array([[0.0, 0.0, 1.0]]))[0, 2]
    area_m2 = 2 * np.pi * apex**2 * (1 - np.cos(half))
    boards = max(1, round(area_m2 / part.spacing_m**2))
    middle = inside.meet(np.zeros(3), cap(boards, half))
    normal = inside.inward(middle)
    across = np.cross(normal, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(normal, across)
    turn = rng.uniform(0, 2 * np.pi, boards)[:, None]
    u, v = across * np.cos(turn) + along * np.sin(turn), along * np.cos(turn) - across * np.sin(turn)
    lit = [rng.permutation(HOLES)[: rng.integers(part.lit[0], part.lit[1] + 1)] for _ in range(boards)]
    board = np.concatenate([np.full(len(holes), b) for b, holes in enumerate(lit)])
    hole = np.concatenate(lit)
    place = (
        middle[board]
        + ((hole % 3 - 1) * part.pitch_m)[:, None] * u[board]
        + ((hole // 3 - 1) * part.pitch_m)[:, None] * v[board]
    )
    count = len(board)
    level = rng.choice(part.pwm_levels, count)
    scatter = np.exp(led.scatter * rng.standard_normal(count))
    if led.intensity_cd is not None:
        strength = led_strength_e_s_sr(led.intensity_cd, led.spectrum, band) * scatter
    else:
        strength = radiant_strength_e_s_sr(led.radiant_intensity_w_sr or 0.0, led.spectrum, band) * scatter
    return Sources(
        id=(board * HOLES + hole).astype(np.int64),
        place=np.column_stack([place, np.ones(count)]),
        normal=normal[board],
        radius_m=np.full(count, led.disc_diameter_m / 2),
        strength=strength,
        period_s=np.full(count, led.pwm_period_s),
        start_s=rng.uniform(0, led.pwm_period_s, count),
        on_s=level * led.pwm_period_s,
        magnitude=np.full(count, np.nan),
    )


LAYOUTS = {"patch_boards": patch_boards}


def sources(part: light.Dome, band: Band) -> Sources:
    """Every LED of the dome, as bright as the chip's band makes it: strength is photo-electrons s^-1 sr^-1."""
    return LAYOUTS[part.layout.kind](part.layout, surface(part.surface), part.led, band)
