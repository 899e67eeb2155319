"""Attitude from lights that may each be one of several LEDs: names from their codes and places together.

A name is the LED that a light is taken for. Codes alone leave several names for a light; the places decide.

1. Choose two lights with few names that are far apart (`_best_pair`).
2. List the pairs of their names with the same angle about the bearing, likeliest codes first (`_hypotheses`).
3. Each pair of names gives an attitude.
4. The attitude predicts the places of all LEDs, and each other light takes its best name (`_evaluate`). The misfit of
   the hypothesis is that of the two codes plus, for each other light, the least sum of a code's misfit and half the
   squared distance; at most STRANGER.
5. Accept the best hypothesis if every other one is worse by the factor 10^MARGIN_DEX in likelihood, if its names hardly
   contradict the codes, and if most of the lights have a name (`identify`).

One wrong name thus leads to a refusal, not to a wrong attitude.
"""

from typing import NamedTuple

import numpy as np

from estimator.attitude.dome_map import on_sphere
from estimator.attitude.solvers import rotation
from estimator.core.checks import Floats, Ints
from estimator.core.types import StarMatch
from estimator.core.vectors import normalized
from estimator.identification.chance import GATE_SIGMA
from estimator.identification.led_search import MARGIN_DEX

REACH = 30.0  # greatest misfit of a name in excess of the best name's
STRANGER = (
    14.0  # misfit of a light that fits no LED: a reflection, or a track that changed its LED
)
TRUSTED = 5.0  # greatest excess misfit of the names, times the square root of their number
MAX_HYPOTHESES = 150  # with this number or more, the lights are undecided
UNDECIDED = "codes: more than one attitude fits the lights"
CONTRADICTED = "codes: the names of the lights contradict their places"


class NamedLights(NamedTuple):
    """T lights of a frame whose codes are known.

    Attributes
    ----------
    ray
        (T, 3) unit vectors in camera axes
    sigma
        (T,) standard deviation of their tangents
    misfit
        (T, N) misfit of each LED's code
    """

    ray: Floats
    sigma: Floats
    misfit: Floats


class Sphere(NamedTuple):
    """LEDs and the camera about the bearing.

    Attributes
    ----------
    position_m
        (N, 3) positions of the LEDs in the lab frame
    radius_m
        (N,) their distances from the bearing
    direction
        (N, 3) position / radius
    pupil_m
        (3,) camera's entrance pupil from the bearing, in camera axes
    """

    position_m: Floats
    radius_m: Floats
    direction: Floats
    pupil_m: Floats


def identify(lights: NamedLights, sphere: Sphere) -> StarMatch | str:
    """Name the lights and solve the attitude: the module's steps.

    Returns
    -------
    StarMatch | str
        The lights' rows, their LEDs and the attitude, or the reason for a refusal
    """
    excess = lights.misfit - lights.misfit.min(axis=1, keepdims=True)
    # 1. Two lights.
    pair = _best_pair(lights.ray, excess)
    # 2. and 3. Their names, and the attitudes.
    names, R_cam_from_lab = _hypotheses(lights, sphere, excess, pair)
    if not len(names):
        return CONTRADICTED
    if len(names) >= MAX_HYPOTHESES:
        return UNDECIDED
    # 4. The names of the other lights.
    total, star = _evaluate(lights, sphere, excess, R_cam_from_lab, pair, names)
    # 5. Refuse unless one hypothesis is clearly the best, and agrees with the codes and with most of the lights.
    order = np.argsort(total)
    best = order[0]
    if len(order) > 1 and total[order[1]] - total[best] < MARGIN_DEX * np.log(10):
        return UNDECIDED
    rows = np.arange(len(lights.ray))
    matched = star[best] >= 0
    observed = rows[matched]
    leds = star[best][matched]
    if excess[observed, leds].sum() > TRUSTED * np.sqrt(len(leds)):
        return CONTRADICTED
    if len(leds) < max(2, 2 * len(rows) / 3):
        return CONTRADICTED
    return StarMatch(observed, leds, rotation(R_cam_from_lab[best]), -MARGIN_DEX)


def is_supported(match: StarMatch, misfit: Floats, lights: int) -> bool:
    """Whether the names hold at one time of the codes' clock, and no other light of the frame contradicts them.

    `identify` takes each light at its own best phase; the names together must be nearly as good at a common one. Two
    names that nothing else confirms count only if there is no other light. Otherwise half of the lights must have a
    name.

    Parameters
    ----------
    misfit
        (P, T, N) misfit of each LED's code at P phases of the clock, for lights that include those of `match.observed`
    lights
        Number of lights with enough bits, including those that fit no code
    """
    count = len(match.observed)
    if count < lights / 2 or (count == 2 and lights > 2):
        return False
    # Best misfit at one common phase, and at a phase of its own for each light.
    together = misfit[:, match.observed, match.star].sum(axis=1).min()
    apart = misfit.min(axis=(0, 2))[match.observed].sum()
    return bool(together - apart <= TRUSTED * np.sqrt(count))


def _best_pair(ray: Floats, excess: Floats) -> tuple[int, int]:
    """Step 1: the two lights with the fewest pairs of names, among those at least half as far apart as any.

    Parameters
    ----------
    ray
        (T, 3) unit vectors
    excess
        (T, N) misfit of each name in excess of the best one's
    """
    apart = np.linalg.norm(ray[:, None] - ray, axis=2)
    names = (excess <= REACH).sum(axis=1).astype(float)
    # The number of pairs of names; infinite for lights that are too close together.
    cost = np.where(apart >= apart.max() / 2, names[:, None] * names, np.inf)
    np.fill_diagonal(cost, np.inf)
    first, second = np.unravel_index(int(cost.argmin()), cost.shape)
    return int(first), int(second)


def _hypotheses(
    lights: NamedLights, sphere: Sphere, excess: Floats, pair: tuple[int, int]
) -> tuple[Ints, Floats]:
    """Steps 2 and 3: names of two lights whose angle about the bearing is that of the lights, the likeliest ones.

    The cosines of two angles differ by the difference of the angles times the sine, if that difference is small.

    Returns
    -------
    names
        (M, 2) rows of LEDs, at most MAX_HYPOTHESES
    R_cam_from_lab
        (M, 3, 3) attitudes
    """
    # Directions from the bearing to the points where each ray meets the spheres of its LEDs' radii
    rows = [np.flatnonzero(excess[light] <= REACH) for light in pair]
    u, v = (
        normalized(on_sphere(lights.ray[light], sphere.pupil_m, sphere.radius_m[leds]))
        for light, leds in zip(pair, rows, strict=True)
    )
    known_u, known_v = (sphere.direction[leds] for leds in rows)
    # (difference of the cosines / sine)^2 < gate^2; the sine has a floor for coincident lights.
    gate2 = GATE_SIGMA**2 * np.sum(lights.sigma[list(pair)] ** 2)
    cosine = u @ v.T
    alike = (cosine - known_u @ known_v.T) ** 2 < gate2 * np.maximum(1 - cosine**2, gate2)
    # One LED cannot be both lights.
    a, b = np.nonzero(alike & (rows[0][:, None] != rows[1]))
    cost = excess[pair[0], rows[0][a]] + excess[pair[1], rows[1][b]]
    order = np.argsort(cost, kind="stable")[:MAX_HYPOTHESES]
    a = a[order]
    b = b[order]
    # R = sum over the axes of (axis in camera axes) (axis in the lab frame)^T.
    axes = _frames(u[a], v[b]).mT @ _frames(known_u[a], known_v[b])
    return np.column_stack([rows[0][a], rows[1][b]]), axes


def _frames(u: Floats, v: Floats) -> Floats:
    """(M, 3, 3) axes of pairs of unit vectors, in rows: the bisector b, n x b, and the normal n to both vectors."""
    middle = normalized(u + v)
    normal = np.cross(u, v)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return np.stack([middle, np.cross(normal, middle), normal], axis=1)


def _evaluate(
    lights: NamedLights,
    sphere: Sphere,
    excess: Floats,
    R_cam_from_lab: Floats,
    pair: tuple[int, int],
    names: Ints,
) -> tuple[Floats, Ints]:
    """Step 4: the misfit of each hypothesis, and the names that it gives to the lights.

    Parameters
    ----------
    R_cam_from_lab
        (M, 3, 3) attitudes of the hypotheses
    pair
        Rows of the two lights
    names
        (M, 2) names of the two lights

    Returns
    -------
    total
        (M,) misfits
    star
        (M, T) names of the lights, -1 for none
    """
    # Predicted tangents of all LEDs at each attitude; infinite behind the camera.
    leds = len(sphere.position_m)
    turned = R_cam_from_lab.reshape(-1, 3) @ sphere.position_m.T
    offset = turned.reshape(-1, 3, leds) - sphere.pupil_m[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        tangent = np.where(offset[:, 2:] > 0, offset[:, :2] / offset[:, 2:], np.inf)
    # Geometry of the pair, for the error of its attitude.
    seen = lights.ray[:, :2] / lights.ray[:, 2:]
    middle = seen[list(pair)].mean(axis=0)
    length2 = np.sum((seen[pair[0]] - seen[pair[1]]) ** 2)
    # Misfit of the pair's two codes.
    total = excess[pair[0], names[:, 0]] + excess[pair[1], names[:, 1]]
    star = np.full((len(names), len(seen)), -1)
    star[:, pair] = names
    # Cost of each name of a light; the last column is that of no name.
    cost = np.full((len(names), leds + 1), STRANGER)
    named = list(pair)
    for light in set(range(len(seen))) - set(pair):
        # The pair's attitude adds half of a light's variance, and more with the distance from the pair's middle.
        factor = 1.5 + 2 * np.sum((seen[light] - middle) ** 2) / length2
        squared = np.sum((tangent - seen[light][:, None]) ** 2, axis=1)
        squared /= factor * lights.sigma[light] ** 2
        cost[:, :-1] = np.where(squared < GATE_SIGMA**2, squared / 2 + excess[light], np.inf)
        np.put_along_axis(cost, star[:, named], np.inf, axis=1)  # an LED is one light at most
        cost[:, -1] = STRANGER
        # The best name of this light, or none.
        star[:, light] = cost.argmin(axis=1)
        total = total + cost.min(axis=1)
        star[star[:, light] == leds, light] = -1
        named.append(light)
    return total, star
