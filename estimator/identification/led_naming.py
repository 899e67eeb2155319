"""Attitude from lights that may each be several LEDs: the names by their codes and the places together.

Two lights are taken to be all pairs of LEDs that their codes allow and that are as far apart, seen from the bearing.
Each pair of names gives an attitude, which predicts where the others are: the misfit of the hypothesis is that of the
two codes, and of each other light the least sum, over the LEDs, of the code's misfit and the squared distance, at most
STRANGER. The best hypothesis counts if every other one is worse by the factor 10^MARGIN_DEX in likelihood, if it takes
the codes at their word, and if most of the lights agree: one wrong name leads to a refusal, not to a wrong attitude.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.solvers import rotation
from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.identification.chance import GATE_SIGMA
from estimator.identification.led_search import MARGIN_DEX

REACH = 30.0  # names with a misfit that exceeds the best one's by more are left out
STRANGER = 14.0  # misfit of a light that fits no LED: a reflection, or a track that changed its LED
TRUSTED = 5.0  # by which the misfit of two codes may exceed that of their best names
MAX_HYPOTHESES = 150  # more of them are not decided yet
UNDECIDED = "codes: more than one attitude fits the lights"
CONTRADICTED = "codes: the names of the lights contradict their places"


class NamedLights(NamedTuple):
    """T lights of a frame whose codes are known.

    Attributes
    ----------
    ray
        (T, 3) unit, in camera axes
    sigma
        (T,) standard deviation of its tangents
    misfit
        (T, N) of each LED's code
    """

    ray: Floats
    sigma: Floats
    misfit: Floats


class Sphere(NamedTuple):
    """LEDs and the camera about the bearing.

    Attributes
    ----------
    position_m
        (N, 3) in the lab
    radius_m
        (N,) from the bearing
    direction
        (N, 3) position / radius
    pupil_m
        (3,) in camera axes
    """

    position_m: Floats
    radius_m: Floats
    direction: Floats
    pupil_m: Floats


def identify(lights: NamedLights, sphere: Sphere) -> StarMatch | str:
    """The lights' LEDs with the attitude, or the reason for a refusal; rows of `lights` in the match."""
    excess = lights.misfit - lights.misfit.min(axis=1, keepdims=True)
    first, second = _best_pair(lights.ray, excess)
    names = _pair_names(lights, sphere, excess, first, second)
    if not len(names):
        return CONTRADICTED
    if len(names) >= MAX_HYPOTHESES:
        return UNDECIDED
    R_cam_from_lab = _attitudes(lights, sphere, first, second, names)
    total, star = _evaluate(lights, sphere, excess, R_cam_from_lab, (first, second), names)
    order = np.argsort(total)
    best = order[0]
    if len(order) > 1 and total[order[1]] - total[best] < MARGIN_DEX * np.log(10):
        return UNDECIDED
    rows = np.arange(len(lights.ray))
    matched = star[best] >= 0
    by_code = excess[rows[matched], star[best][matched]]
    if by_code.sum() > TRUSTED * np.sqrt(matched.sum()) or matched.sum() < max(
        2, 2 * len(rows) / 3
    ):
        return CONTRADICTED
    return StarMatch(
        rows[matched], star[best][matched], rotation(R_cam_from_lab[best]), -MARGIN_DEX
    )


def is_supported(match: StarMatch, misfit: Floats, lights: int) -> bool:
    """Whether the names hold at one time of the codes' clock, and no other light of the frame speaks against them.

    `identify` takes each light at its own best phase; the names together must be nearly as good at a common one. Two
    names that nothing else confirms count only where there is no other light; else half of the lights must have one.

    Parameters
    ----------
    misfit
        (P, T, N) of each LED's code at P phases of the clock, of the rows of `match.observed`
        among others
    lights
        Number of lights with enough bits, also those that fit no code
    """
    count = len(match.observed)
    if count < lights / 2 or (count == 2 and lights > 2):
        return False
    together = misfit[:, match.observed, match.star].sum(axis=1).min()
    apart = misfit.min(axis=(0, 2))[match.observed].sum()
    return bool(together - apart <= TRUSTED * np.sqrt(count))


def _best_pair(ray: Floats, excess: Floats) -> tuple[int, int]:
    """The two lights with the fewest pairs of names, of those that are at least half as far apart as any."""
    apart = np.linalg.norm(ray[:, None] - ray, axis=2)
    names = (excess <= REACH).sum(axis=1).astype(float)
    cost = np.where(apart >= apart.max() / 2, names[:, None] * names, np.inf)
    np.fill_diagonal(cost, np.inf)
    first, second = np.unravel_index(int(cost.argmin()), cost.shape)
    return int(first), int(second)


def _pair_names(
    lights: NamedLights, sphere: Sphere, excess: Floats, first: int, second: int
) -> Ints:
    """(M, 2) names of two lights, the likeliest ones, whose angle about the bearing is that of the lights."""
    rows = [np.flatnonzero(excess[light] <= REACH) for light in (first, second)]
    seen = [
        _seen_directions(lights.ray[light], sphere, row)
        for light, row in zip((first, second), rows, strict=True)
    ]
    known = [sphere.direction[row] for row in rows]
    gate = float(GATE_SIGMA * np.hypot(lights.sigma[first], lights.sigma[second]))
    pairs = np.empty((_alike(*seen, *known, gate, np.empty((0, 2), np.int64)), 2), np.int64)
    _alike(*seen, *known, gate, pairs)
    names = np.column_stack([rows[0][pairs[:, 0]], rows[1][pairs[:, 1]]])
    names = names[names[:, 0] != names[:, 1]]
    cost = excess[first, names[:, 0]] + excess[second, names[:, 1]]
    order = np.argsort(cost, kind="stable")
    return names[order[:MAX_HYPOTHESES]] if len(order) else names


@jit
def _alike(u: Floats, v: Floats, known_u: Floats, known_v: Floats, gate: float, pairs: Ints) -> int:
    """How many pairs of u (K, 3) and v (L, 3) are as far apart as their known directions; the first fill `pairs`.

    The difference of two angles that are much greater than it is that of their cosines over the sine.
    """
    found = 0
    for a in range(len(u)):
        for b in range(len(v)):
            cosine = u[a, 0] * v[b, 0] + u[a, 1] * v[b, 1] + u[a, 2] * v[b, 2]
            known = (
                known_u[a, 0] * known_v[b, 0]
                + known_u[a, 1] * known_v[b, 1]
                + known_u[a, 2] * known_v[b, 2]
            )
            if (cosine - known) ** 2 < gate**2 * max(1 - cosine**2, gate**2):
                if found < len(pairs):
                    pairs[found, 0] = a
                    pairs[found, 1] = b
                found += 1
    return found


def _seen_directions(ray: Floats, sphere: Sphere, rows: Ints) -> Floats:
    """(K, 3) direction from the bearing to the point where a ray meets the sphere of each of these LEDs' radii."""
    radius = sphere.radius_m[rows]
    along = float(ray @ sphere.pupil_m)
    reach = -along + np.sqrt(np.maximum(along**2 - sphere.pupil_m @ sphere.pupil_m + radius**2, 0))
    return (sphere.pupil_m + reach[:, None] * ray) / radius[:, None]


def _attitudes(lights: NamedLights, sphere: Sphere, first: int, second: int, names: Ints) -> Floats:
    """(M, 3, 3) R_cam_from_lab of each pair of names."""
    seen = [
        _seen_directions(lights.ray[light], sphere, names[:, k])
        for k, light in enumerate((first, second))
    ]
    known = [sphere.direction[names[:, k]] for k in range(2)]
    return np.einsum("mia,mib->mab", _frames(*seen), _frames(*known))


def _frames(u: Floats, v: Floats) -> Floats:
    """(M, 3, 3) orthonormal axes, in rows, of pairs of unit vectors: their middle, the third, and their normal."""
    middle = u + v
    normal = np.cross(u, v)
    middle = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return np.stack([middle, np.cross(normal, middle), normal], axis=1)


def _evaluate(
    lights: NamedLights,
    sphere: Sphere,
    excess: Floats,
    R_cam_from_lab: Floats,
    pair: tuple[int, int],
    names: Ints,
) -> tuple[Floats, NDArray[np.int64]]:
    """(M,) misfit of each hypothesis and (M, T) its names of the lights, -1 for none."""
    offset = (R_cam_from_lab.reshape(-1, 3) @ sphere.position_m.T).reshape(
        -1, 3, len(sphere.position_m)
    )
    offset = offset - sphere.pupil_m[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        tangent = np.where(offset[:, 2:] > 0, offset[:, :2] / offset[:, 2:], np.inf)
    seen = lights.ray[:, :2] / lights.ray[:, 2:]
    middle = seen[list(pair)].mean(axis=0)
    length2 = np.sum((seen[pair[0]] - seen[pair[1]]) ** 2)
    total = excess[pair[0], names[:, 0]] + excess[pair[1], names[:, 1]]
    star = np.full((len(names), len(seen)), -1)
    star[:, pair] = names
    cost = np.full(
        (len(names), len(sphere.position_m) + 1), STRANGER
    )  # of each LED, and at last (-1) of none of them
    named = list(pair)
    for light in set(range(len(seen))) - set(pair):
        # The pair's attitude adds half of a light's variance, and more with the distance from the pair's middle.
        factor = 1.5 + 2 * np.sum((seen[light] - middle) ** 2) / length2
        squared = (tangent[:, 0] - seen[light, 0]) ** 2 + (tangent[:, 1] - seen[light, 1]) ** 2
        squared /= factor * lights.sigma[light] ** 2
        cost[:, :-1] = np.where(squared < GATE_SIGMA**2, squared / 2 + excess[light], np.inf)
        np.put_along_axis(cost, star[:, named], np.inf, axis=1)  # an LED is one light at most
        cost[:, -1] = STRANGER
        star[:, light] = cost.argmin(axis=1)
        total = total + cost.min(axis=1)
        star[star[:, light] == len(sphere.position_m), light] = -1
        named.append(light)
    return total, star
