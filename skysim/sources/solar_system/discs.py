"""Discs of bodies: how brightness is distributed over them, cut into small elements that are drawn as points.

The disc's plane is spanned by x, toward the Sun (the bright limb), and y; its rim is the unit circle. At (x, y) the
cosine of the emission angle is mu = sqrt(1 - x^2 - y^2), and at a phase angle a that of the incidence is
mu0 = x sin a + mu cos a; the terminator, mu0 = 0, is half an ellipse of semi-axes 1 and |cos a|.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from skysim.core.types import Floats

SAMPLES = 180  # least number of points across a disc at which the brightness is sampled, two or more an element
PHASE_STEP_DEG = 0.05  # phases are rounded to this, so that frames share their elements


def limb_darkened(mu: Floats, mu0: Floats) -> Floats:
    """The Sun at 550 nm: 0.30 + 0.93 mu - 0.23 mu^2 (Cox 2000, Allen's Astrophysical Quantities, section 14.7)."""
    return 0.30 + 0.93 * mu - 0.23 * mu**2


def lommel_seeliger(mu: Floats, mu0: Floats) -> Floats:
    """A dark rough surface, in which light is scattered once: mu0 / (mu0 + mu) (Hapke 1981, JGR 86, 3039).

    The full disc is uniform, as the full Moon's is. The maria are left out.
    """
    return np.where(mu0 > 0, mu0 / np.maximum(mu0 + mu, 1e-12), 0.0)


def lambert(mu: Floats, mu0: Floats) -> Floats:
    """A bright cloud deck, in which light is scattered many times: mu0."""
    return np.maximum(mu0, 0.0)


class Elements(NamedTuple):
    """M elements of a disc: (M, 2) centers of light in units of its radius, (M,) shares of the light."""

    xy: Floats
    share: Floats


Law = Callable[[Floats, Floats], Floats]


def disc_elements(law: Law, phase_rad: float, across: int, earthshine: float = 0.0) -> Elements:
    """The disc as elements on a square lattice with so many on its diameter; dark ones are left out.

    An element has the light of its cell and lies at the center of that light, both sampled more finely: so the
    center of the whole disc's light is as if the disc were drawn from these samples.

    earthshine : light of the disc lit from the observer's side, over that of the sunlit one
    """
    return _elements(law, round(np.degrees(phase_rad) / PHASE_STEP_DEG), across, float(f"{earthshine:.2g}"))


@lru_cache(maxsize=32)
def _elements(law: Law, phase_steps: int, across: int, earthshine: float) -> Elements:
    subcells = max(2, -(-SAMPLES // across))
    fine = across * subcells
    axis = (np.arange(fine) + 0.5) * (2 / fine) - 1
    x, y = np.meshgrid(axis, axis)
    on_disc = x**2 + y**2 < 1
    mu = np.sqrt(np.where(on_disc, 1 - x**2 - y**2, 1.0))
    phase_rad = np.radians(phase_steps * PHASE_STEP_DEG)
    light = normalized(np.where(on_disc, law(mu, x * np.sin(phase_rad) + mu * np.cos(phase_rad)), 0.0))
    light = normalized(light + earthshine * normalized(np.where(on_disc, law(mu, mu), 0.0)))
    cells = (across, subcells, across, subcells)
    share, share_x, share_y = (map_.reshape(cells).sum(axis=(1, 3)).ravel() for map_ in (light, light * x, light * y))
    lit = share > 0
    xy = np.column_stack([share_x[lit], share_y[lit]]) / share[lit, None]
    return Elements(xy, share[lit])


def normalized(light: Floats) -> Floats:
    """The light over its sum; a disc wholly dark stays so."""
    return light / max(float(light.sum()), 1e-300)
