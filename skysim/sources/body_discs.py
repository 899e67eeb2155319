"""Discs of bodies: how brightness is distributed over them.

The disc's plane is spanned by x, toward the Sun (the bright limb), and y; its rim is the unit circle. At (x, y) the
cosine of the emission angle is mu = sqrt(1 - x^2 - y^2), and at a phase angle a that of the incidence is
mu0 = x sin a + mu cos a; the terminator, mu0 = 0, is half an ellipse of semi-axes 1 and |cos a|.
"""

from __future__ import annotations

from functools import lru_cache
from math import cos, sin, sqrt
from typing import Any, NamedTuple
import numpy as np
from skysim.core.jit import jit
from skysim.core.types import Floats



# laws of `brightness`
LIMB_DARKENED = 0
LOMMEL_SEELIGER = 1
LAMBERT = 2
ACROSS = 12  # elements on the diameter of a small disc
SAMPLES = 16  # points across an element at which the brightness is sampled
RIM = 20  # cells within the rim in which the mean over a cell matters
PHASE_STEP_DEG = (
    0.05  # phases of small discs are rounded to this, so that frames share their elements
)


@jit
def brightness(law: int, mu: float, mu0: float) -> float:
    """Relative brightness of a surface.

    LIMB_DARKENED   : the Sun at 550 nm: 0.30 + 0.93 mu - 0.23 mu^2 (Cox 2000, Allen's Astrophysical Quantities)
    LOMMEL_SEELIGER : a dark rough surface, in which light is scattered once: mu0 / (mu0 + mu) (Hapke 1981, JGR 86,
                      3039). The full disc is uniform, as the full Moon's is; the maria are left out.
    LAMBERT         : a bright cloud deck, in which light is scattered many times: mu0
    """
    if law == LIMB_DARKENED:
        return 0.30 + 0.93 * mu - 0.23 * mu**2
    if mu0 <= 0:
        return 0.0
    return mu0 / (mu0 + mu) if law == LOMMEL_SEELIGER else mu0


class Surface(NamedTuple):
    """How a disc shines.

    law        : of `brightness`
    earthshine : light of the disc as lit from the observer's side, over that of the sunlit one
    """

    law: int
    phase_rad: float
    earthshine: float = 0.0


def light_map(surface: Surface, axis: Floats) -> Floats:
    """Shares of the disc's light at the points of a square lattice that covers it; they add up to 1.

    axis : (n,) the lattice's even coordinates in both directions, in units of the disc's radius
    Returns (n, n), [y, x].
    """
    sunlit, earthlit = np.zeros((2, len(axis), len(axis)))
    _fill(sunlit, earthlit, surface.law, surface.phase_rad, axis)
    light = sunlit / max(float(sunlit.sum()), 1e-300)
    if surface.earthshine:
        light += earthlit * (surface.earthshine / float(earthlit.sum()))
        light /= 1 + surface.earthshine
    return np.asarray(light)


@jit
def _fill(sunlit: Any, earthlit: Any, law: int, phase_rad: float, axis: Floats) -> None:
    """Light of each point's cell, lit from the Sun and from the observer."""
    sine = sin(phase_rad)
    cosine = cos(phase_rad)
    step = axis[1] - axis[0]
    inner = inner_radius2(step)
    for j in range(len(axis)):
        for i in range(len(axis)):
            sunlit[j, i], earthlit[j, i] = cell_light(
                law, sine, cosine, axis[i], axis[j], step, inner
            )


@jit
def inner_radius2(step: float) -> float:
    """Square of the radius within which the brightness at a cell's center is its mean."""
    return max(1 - RIM * step, 0.0) ** 2


@jit
def cell_light(
    law: int, sine: float, cosine: float, x: float, y: float, step: float, inner: float
) -> tuple[float, float]:
    """Brightness at (x, y) times the part of a cell of width `step` that is on the disc, lit from the Sun and from the
    observer, at a phase angle with this sine and cosine.

    Near the rim mu varies as a square root: the mean of mu over the cell's radial extent on the disc, from m1 inside
    to m2, is 2/3 (m1^2 + m1 m2 + m2^2) / (m1 + m2), as mu^2 is linear in the radius there.
    """
    rho2 = x * x + y * y
    if rho2 > (1 + step / 2) ** 2:
        return 0.0, 0.0
    covered = 1.0
    inward = 1.0
    mu = 0.0
    if rho2 < inner:
        mu = sqrt(1 - rho2)
    else:
        rho = sqrt(rho2)
        covered = min(max(0.5 + (1 - rho) / step, 0.0), 1.0)
        m1 = sqrt(max(1 - max(rho - step / 2, 0.0) ** 2, 0.0))
        m2 = sqrt(max(1 - (rho + step / 2) ** 2, 0.0))
        mu = 2 / 3 * (m1 * m1 + m1 * m2 + m2 * m2) / (m1 + m2) if m1 > 0 else 0.0
        inward = 1.0 if covered == 1 else (1 + rho - step / 2) / (2 * rho)
    return covered * brightness(law, mu, inward * x * sine + mu * cosine), covered * brightness(
        law, mu, mu
    )


class Elements(NamedTuple):
    """M elements of a disc: (M, 2) centers of light in units of its radius, (M,) shares of the light."""

    xy: Floats
    share: Floats

    def merged(self) -> Elements:
        """All light at its center."""
        return Elements((self.share @ self.xy)[None], np.array([self.share.sum()]))


def disc_elements(surface: Surface) -> Elements:
    """A small disc as elements on a square lattice, ACROSS on its diameter; dark ones are left out.

    An element has the light of its cell and lies at the center of that light.
    """
    phase_steps = round(np.degrees(surface.phase_rad) / PHASE_STEP_DEG)
    return _elements(surface.law, phase_steps, float(f"{surface.earthshine:.2g}"))


@lru_cache(maxsize=32)
def _elements(law: int, phase_steps: int, earthshine: float) -> Elements:
    fine = ACROSS * SAMPLES
    axis = np.asarray((np.arange(fine) + 0.5) * (2 / fine) - 1, float)
    light = light_map(
        Surface(law, float(np.radians(phase_steps * PHASE_STEP_DEG)), earthshine), axis
    )
    cells = (ACROSS, SAMPLES, ACROSS, SAMPLES)
    weighted = (light, light * axis, light * axis[:, None])
    share, share_x, share_y = (one.reshape(cells).sum(axis=(1, 3)).ravel() for one in weighted)
    lit = share > 0
    return Elements(np.column_stack([share_x[lit], share_y[lit]]) / share[lit, None], share[lit])


