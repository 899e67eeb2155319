"""Optimized LED placement: move LEDs between candidate sites to lower the variance of the worst attitudes.

What a camera on its lever arm can learn about the attitude a from the LEDs in its field is the Fisher information of
the rotation-only solution, M_a = sum_i J_i'J_i (`fisher`). It does not depend on any estimator. The search minimizes
    sum_a (SHORT^missing_a tr(M_a^-1))^HARDNESS,
a smooth substitute for the worst case over all attitudes to the greatest tilt, in which missing_a is the number of
LEDs that the field lacks of `wanted`. It is a local search: LEDs take turns, each is offered a random site nearby,
and a move is kept if it lowers the sum and respects the least spacing. Because no finite set of attitudes contains
the worst one, the hardest attitudes of a fresh random sample join the set between generations (`hardest`).

The search starts from even layouts: Fibonacci spirals and a Poisson-disc sample of the sites, the best of them also
contracted toward the zenith. A final stage nudges LEDs whose fields of view are too similar to another field
(`set_apart`). Layouts are compared by the mean variance of the worst 1 % of independent attitudes (`Exam`). By this
measure the result is never worse than the even layouts; at a single attitude it can be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats
from skysim.scene import leds
from skysim.sources.dome.placement.ambiguity import Ambiguity, field_ambiguity
from skysim.sources.dome.placement.fisher import (
    Visibility,
    add,
    costs,
    sum_information,
    total_information,
    update_costs,
    variances,
    visible_from,
)
from skysim.sources.dome.surface import Inside

Ints = NDArray[np.int64]

SITES_AN_LED = 500  # candidate sites per LED: their spacing is a twentieth of the LEDs' own
EVEN = 10  # sites per LED that suffice for an even layout
HALVINGS = 12  # bisection steps of its spacing, which starts between the least spacing and the sites' extent
# Step sizes (least, greatest) in units of the LEDs' spacing, and the fraction of the field that the search uses. The
# smaller field keeps a margin, because attitudes between the sampled ones lose LEDs at the edge. Where a field holds
# few LEDs, evenness matters most and steps must be small; where it holds many, larger steps gain more.
FEW = 8.0  # LEDs in a field, on average, below which the search is CAREFUL
CAREFUL, BOLD = ((0.02, 0.06), 0.93), ((0.01, 0.3), 0.97)
SEERS = 400  # attitudes that see a site: a field's border passes it in steps of a twentieth of the field
FEWEST, MOST = 2000, 20_000  # limits of the number of attitudes in the cost
GOLDEN = 1.2207440846057596  # g^4 = g + 1: base of the R3 low-discrepancy sequence (Roberts 2018; assumed)
EXAMINED = 40_000  # attitudes by which layouts are compared
TAIL = 0.01  # fraction of them, the worst, whose mean variance is compared
DRAWN_IN = (0.98, 0.96, 0.94, 0.92, 0.9, 0.88, 0.86, 0.84)  # of the solid angle, for contracted layouts
GENERATIONS = 15  # of attitudes: after each the hardest of fresh ones join the cost
KEPT = 3  # every so many generations the layout is kept as a candidate
DRAWN, HARDEST = 20_000, 600  # fresh attitudes, and how many of them are kept
SHAKES, SHAKE = 6, 0.1  # random perturbations of each of the hardest attitudes, and their size in half fields
HALF = 0.5  # fraction of a field's LEDs that may coincide with another field's
NUDGES = 100  # tries to make a field differ
BESIDE = 60  # nearest sites that a nudged LED may take: a fifth of the LEDs' own spacing
ABOUT = 4  # LEDs nearest to the center of a field, one of which is nudged
SLACK = 0.02  # relative rise of the worst variance that the nudges may cost
BLIND = 0.95  # part of the field in which nudges must not leave more attitudes with fewer than two LEDs


class Exam(NamedTuple):
    """Comparison of layouts on (A, 3, 3) attitudes that no search uses.

    limit : mean variance of the worst TAIL of attitudes, for the best of the even layouts
    """

    part: leds.OptimisedConfig
    R_body_from_lab: Floats
    limit: float

    def mark(self, place_m: Floats) -> float:
        """Mean variance of the worst TAIL of attitudes over the limit: 1 or less is as good as any even layout.

        The single worst attitude is unstable: it depends on one LED at the field's edge and on the sampling.
        """
        each = np.sort(variances(total_information(place_m, self.R_body_from_lab, *camera(self.part))))
        return float(each[-math.ceil(TAIL * len(each)) :].mean()) / self.limit

    def blind(self, place_m: Floats) -> int:
        """Number of attitudes with fewer than two LEDs in the BLIND part of the field; two fix an attitude."""
        return int(
            np.sum(total_information(place_m, self.R_body_from_lab, *camera(self.part, BLIND))[:, 6] < 2)
        )


def places(
    part: leds.OptimisedConfig, sites_m: Floats, begin_m: Sequence[Floats], rng: np.random.Generator
) -> Floats:
    """(N, 3) sites, m, at which part.count LEDs make the worst attitudes within the tilt as good as possible.

    sites_m : (K, 3) allowed places in the lab, on the surface within its rim and cap; K = SITES_AN_LED times the
        count
    begin_m : (N, 3) each, layouts to start from; a Poisson-disc sample of the sites, as even as possible, is added
    1. The best even layout by `Exam.mark` sets the limit. It is also contracted toward the zenith by DRAWN_IN.
    2. From the best of these `searched` descends sum_a c_a^HARDNESS, c_a = SHORT^missing tr((sum_i J_i'J_i)^-1),
       over attitudes a to the tilt. The Jacobian J_i of LED i is with respect to a rotation about the bearing. Steps
       are small, because evenness once lost is not regained, but they suffice to make one field differ from others.
    3. The best by `worth` of all layouts reached is kept, so no even layout is better in the worst attitudes.
    4. `set_apart` reduces the ambiguity between fields; its result is kept if `worth` prefers it.
    Raises InputError if not all LEDs find room at the spacing.
    """
    beginnings = [one for one in begin_m if roomy(one, part.spacing_m)]
    chosen = evenly(sites_m[: EVEN * part.count], part.spacing_m, part.count)
    if len(chosen) == part.count:
        beginnings.append(sites_m[chosen])
    if not beginnings:
        raise InputError(
            f"light.layout.spacing: {len(chosen)} of {part.count} LEDs find room {part.spacing_m:.3g} m apart where a"
            f" tilt of {part.tilt_deg:g} deg looks; allowed: fewer, nearer to each other, or a greater cap_deg"
        )
    share = seen_share(part, sites_m[: EVEN * part.count], rng)
    exam = Exam(part, attitudes(part, EXAMINED, rng), 1.0)
    even_m = min(beginnings, key=exam.mark)
    exam = exam._replace(limit=exam.mark(even_m))
    drawn = [drawn_in(even_m, sites_m, share) for share in DRAWN_IN]
    begun_m = min([even_m, *(one for one in drawn if roomy(one, part.spacing_m))], key=exam.mark)
    best_m = min([even_m, begun_m], key=lambda one: worth(exam, one, rng))
    steps, edge = CAREFUL if share * part.count < FEW else BOLD
    judged = int(np.clip(SEERS / max(share, 1e-9), FEWEST, MOST))
    found = searched(Search(part, sites_m, cKDTree(sites_m), steps, edge), begun_m, judged, rng)
    best_m = min([best_m, *found], key=lambda one: worth(exam, one, rng))
    return min([set_apart(exam, best_m, sites_m, rng), best_m], key=lambda one: worth(exam, one, rng))


def worth(exam: Exam, place_m: Floats, rng: np.random.Generator) -> tuple[bool, bool, float]:
    """Sort key of layouts, less is better.

    In this order: whether an even layout is better in the worst attitudes; whether an attitude was found that sees
    fewer than two LEDs; the worst variances, times 1 + the share of fields of which more than HALF coincides with
    another field.
    """
    mark, like = exam.mark(place_m), alike(exam.part, place_m)
    whole = Search(exam.part, place_m, cKDTree(place_m), CAREFUL[0], 1.0)
    fewest = total_information(place_m, hardest(whole, place_m, rng), *whole.camera())[:, 6].min()
    return mark > 1, bool(fewest < 2), mark * (1 + float(np.mean(like.share > HALF)))


def roomy(place_m: Floats, spacing_m: float) -> bool:
    """Whether no two LEDs are nearer to each other than the spacing."""
    return bool(cKDTree(place_m).query(place_m, k=2)[0][:, 1].min() >= spacing_m)


def drawn_in(place_m: Floats, sites_m: Floats, share: float) -> Floats:
    """(N, 3) sites nearest to a layout that is contracted to this share of its solid angle about the zenith.

    Few attitudes see the rim, so its LEDs help more where more fields overlap. With z = cos(zenith angle) the
    contraction is 1 - z' = share (1 - z), which scales every solid angle alike.
    """
    up = place_m / np.linalg.norm(place_m, axis=1, keepdims=True)
    z = 1 - share * (1 - up[:, 2])
    aside = up[:, :2] * np.sqrt((1 - z**2) / np.maximum(1 - up[:, 2] ** 2, 1e-12))[:, None]
    site_up = sites_m / np.linalg.norm(sites_m, axis=1, keepdims=True)
    return sites_m[cKDTree(site_up).query(np.column_stack([aside, z]))[1]]


class Search(NamedTuple):
    """Settings of the local search: (K, 3) candidate sites, m, a k-d tree of them, and steps and edge as in CAREFUL."""

    part: leds.OptimisedConfig
    sites_m: Floats
    tree: cKDTree
    steps: tuple[float, float]
    edge: float

    def offers(self, place_m: Floats, rng: np.random.Generator) -> Floats:
        """(N, 3) one site per LED, a random step away; step lengths are log-uniform between the limits in `steps`."""
        usual_m = np.median(cKDTree(place_m).query(place_m, k=2)[0][:, 1])
        least, most = np.log(self.steps)
        step_m = usual_m * np.exp(rng.uniform(least, most, (len(place_m), 1)))
        return self.sites_m[self.tree.query(place_m + step_m * rng.standard_normal(place_m.shape))[1]]

    def camera(self) -> tuple[Floats, Floats]:
        """As `camera`, with the part of the field that the search uses."""
        return camera(self.part, self.edge)


def searched(search: Search, place_m: Floats, judged: int, rng: np.random.Generator) -> list[Floats]:
    """Layouts, (N, 3) sites each, that the descent from place_m reaches: one every KEPT generations, and the last.

    judged : number of attitudes in the first generation's cost
    """
    part, found, R_body_from_lab = search.part, [], attitudes(search.part, judged, rng)
    ends = np.linspace(0, part.rounds, GENERATIONS + 1).round().astype(int)[1:-1]
    for n in range(part.rounds):
        if n in ends[KEPT - 1 :: KEPT]:
            found.append(place_m)
        # The descent improves the sampled attitudes at the expense of those between them. Adding the worst of a fresh
        # sample closes these gaps.
        if n in ends:
            R_body_from_lab = np.concatenate([R_body_from_lab, hardest(search, place_m, rng)])
        # Sites 0 to count - 1 are the present places, site count + n is the offer to LED n.
        both_m = np.concatenate([place_m, search.offers(place_m, rng)])
        seen = Visibility(*visible_from(both_m, R_body_from_lab, *search.camera()))
        chosen, who = np.arange(part.count), rng.permutation(part.count)
        exchange(
            chosen, both_m, seen, len(R_body_from_lab), part.wanted, part.spacing_m, who, who + part.count
        )
        place_m = both_m[chosen]
    return [*found, place_m]


def seen_share(part: leds.OptimisedConfig, sites_m: Floats, rng: np.random.Generator) -> float:
    """Mean fraction of the sites that an attitude sees; times the number of LEDs it is the mean number in a field."""
    return float(total_information(sites_m, attitudes(part, 200, rng), *camera(part))[:, 6].mean()) / len(
        sites_m
    )


def hardest(search: Search, place_m: Floats, rng: np.random.Generator) -> Floats:
    """(H, 3, 3) R_body_from_lab with the highest cost for these LEDs: the worst of a fresh sample, then perturbed.

    Each perturbation is kept if the cost rises. Rotations about the boresight are larger, because they move an LED
    less than rotations across it do: by the tangent of its field angle, at most that of the field's corner.
    """
    drawn = attitudes(search.part, DRAWN, rng)
    each = served(search, place_m, drawn)
    kept = np.argsort(each)[-HARDEST:]
    worst, each = drawn[kept], each[kept]
    half = tan_half(search.part)
    step_rad = SHAKE * half.min() * np.array([1, 1, 1 / math.hypot(*half)])
    for _ in range(SHAKES):
        turn = Rotation.from_rotvec(step_rad * rng.standard_normal((len(worst), 3)))
        beside = turn.as_matrix() @ worst
        fresh = served(search, place_m, beside)
        harder = (fresh > each) & (beside[:, 2, 2] >= math.cos(math.radians(search.part.tilt_deg)))
        worst[harder], each[harder] = beside[harder], fresh[harder]
    return worst


def served(search: Search, place_m: Floats, R_body_from_lab: Floats) -> Floats:
    """(A,) cost of every attitude in the search's field."""
    return costs(total_information(place_m, R_body_from_lab, *search.camera()), search.part.wanted)


def attitudes(part: leds.OptimisedConfig, count: int, rng: np.random.Generator) -> Floats:
    """(A, 3, 3) R_body_from_lab: boresights uniform over the cap of the tilt, yaw uniform; a shifted R3 lattice."""
    # R3 sequence: the multiples of 1/g, 1/g^2 and 1/g^3 modulo 1 fill the unit cube evenly.
    turn = (rng.random(3) + np.arange(count)[:, None] / GOLDEN ** np.arange(1, 4)) % 1
    tilt = np.arccos(1 - turn[:, 0] * (1 - math.cos(math.radians(part.tilt_deg))))
    angles = np.column_stack([2 * math.pi * turn[:, 1], tilt, 2 * math.pi * turn[:, 2]])
    return Rotation.from_euler("ZYZ", angles).inv().as_matrix()


def camera(part: leds.OptimisedConfig, edge: float = 1.0) -> tuple[Floats, Floats]:
    """(3,) entrance pupil on the body, m, and (2,) tangents of half the field, scaled by `edge`."""
    return np.array(part.camera_m), edge * tan_half(part)


def tan_half(part: leds.OptimisedConfig) -> Floats:
    """(2,) tangents of half the field's width and height."""
    return np.tan(np.radians(part.field_deg) / 2)


def reach_rad(part: leds.OptimisedConfig, inside: Inside) -> float:
    """Greatest angle from the zenith, at the bearing, that the field of any attitude reaches; at most the cap.

    Rays around the cone that encloses the field are intersected with the surface, for boresights at the greatest tilt
    in all azimuths and at every yaw.
    """
    half_diagonal, around = np.hypot(*tan_half(part)), np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = np.column_stack([half_diagonal * np.cos(around), half_diagonal * np.sin(around), np.ones(24)])
    angles = [(a, math.radians(part.tilt_deg), yaw) for a in around for yaw in around[::2]]
    most = 0.0
    for lab_from_body in Rotation.from_euler("ZYZ", angles):
        met_m = inside.meet(lab_from_body.apply(np.array(part.camera_m)), lab_from_body.apply(rim))
        met_m = met_m[np.isfinite(met_m[:, 0])]
        most = max(most, *np.arctan2(np.hypot(*met_m.T[:2]), met_m[:, 2]), 0.0)
    return min(most, math.radians(part.cap_deg)) or math.radians(part.cap_deg)


@jit
def room_at(site: int, without: int, chosen: Ints, sites_m: Floats, spacing_m: float) -> bool:
    """Whether a site keeps the spacing to every LED except `without`."""
    for n in range(len(chosen)):
        away2 = 0.0
        for i in range(3):
            away2 += (sites_m[chosen[n], i] - sites_m[site, i]) ** 2
        if n != without and away2 < spacing_m**2:
            return False
    return True


@jit
def exchange(
    chosen: Ints,
    sites_m: Floats,
    seen: Visibility,
    attitude_count: int,
    wanted: int,
    spacing_m: float,
    who: Ints,
    where: Ints,
) -> None:
    """One offer per LED: who[n] moves to where[n] if there is room and the cost falls. Changes `chosen` in place."""
    total = sum_information(chosen, seen, attitude_count)
    each = costs(total, wanted)
    for n in range(len(who)):
        old, new = chosen[who[n]], where[n]
        if old == new or not room_at(new, who[n], chosen, sites_m, spacing_m):
            continue
        # Only attitudes that see the old or the new site change. The cost is a sum over attitudes, so the changes at
        # the two sites add up: the second call finds attitudes that see both already up to date.
        add(old, -1, seen, total)
        add(new, 1, seen, total)
        if update_costs(old, seen, total, each, wanted) + update_costs(new, seen, total, each, wanted) < 0:
            chosen[who[n]] = new
        else:  # undo the move
            add(new, -1, seen, total)
            add(old, 1, seen, total)
            update_costs(old, seen, total, each, wanted)
            update_costs(new, seen, total, each, wanted)


def evenly(sites_m: Floats, spacing_m: float, count: int, halvings: int = HALVINGS) -> Ints:
    """Indices of `count` sites at the widest spacing at which `apart` finds that many, by bisection.

    Fewer than `count` if even spacing_m does not leave room for them.
    """
    chosen = apart(sites_m, spacing_m, count)
    near_m, far_m = spacing_m, float(np.ptp(sites_m, axis=0).max())
    for _ in range(halvings):
        middle_m = (near_m + far_m) / 2
        wider = apart(sites_m, middle_m, count)
        if len(wider) < count:
            far_m = middle_m
        else:
            near_m, chosen = middle_m, wider
    return chosen


def apart(sites_m: Floats, spacing_m: float, count: int | None = None) -> Ints:
    """Indices of sites taken in order, each if none taken before is within the spacing, to `count`.

    This is random sequential adsorption where the sites are in random order.
    """
    tree, free = cKDTree(sites_m), np.ones(len(sites_m), dtype=bool)
    taken: list[int] = []
    for site in range(len(sites_m)):
        if free[site] and (count is None or len(taken) < count):
            taken.append(site)
            free[tree.query_ball_point(sites_m[site], spacing_m)] = False
    return np.array(taken, dtype=np.int64)


# Reduce the ambiguity between fields of view.


def alike(part: leds.OptimisedConfig, place_m: Floats) -> Ambiguity:
    """Ambiguity of the layout (`likeness`), for a round field of the same area as the camera's."""
    radius_rad = math.atan(math.sqrt(4 * float(np.prod(tan_half(part))) / math.pi))
    return field_ambiguity(place_m, part.camera_m[2], math.radians(part.tilt_deg), radius_rad, part.alike_m)


def set_apart(exam: Exam, place_m: Floats, sites_m: Floats, rng: np.random.Generator) -> Floats:
    """The layout after LEDs in ambiguous fields are moved to free sites nearby, where that reduces `excess`.

    A field is ambiguous if more than HALF of its LEDs coincide with another field's. The worst variances may rise by
    SLACK in total, but not beyond those of the best even layout. Ambiguity that remains after NUDGES tries is
    accepted: with three LEDs in a field, two of them have a similar pair almost anywhere.
    """
    part, tree = exam.part, cKDTree(sites_m)
    like, mark, blind = alike(part, place_m), exam.mark(place_m), exam.blind(place_m)
    most = max(mark, min(1.0, mark * (1 + SLACK)))
    for _ in range(NUDGES):
        bad = np.flatnonzero(like.share > HALF)
        if not len(bad):
            break
        middle_m = place_m[like.led[rng.choice(bad)]]
        who = rng.choice(cKDTree(place_m).query(middle_m, k=min(ABOUT, part.count))[1])
        tried_m = place_m.copy()
        tried_m[who] = sites_m[rng.choice(tree.query(place_m[who], k=min(BESIDE, len(sites_m)))[1])]
        if np.delete(np.linalg.norm(place_m - tried_m[who], axis=1), who).min() < part.spacing_m:
            continue
        # The nudge must reduce the ambiguity and must not leave more attitudes with fewer than two LEDs.
        nudged = alike(part, tried_m)
        if excess(nudged) >= excess(like) or exam.blind(tried_m) > blind:
            continue
        if exam.mark(tried_m) <= most:
            place_m, like = tried_m, nudged
    return place_m


def excess(like: Ambiguity) -> float:
    """Sum over the fields of the ambiguity in excess of HALF."""
    return float(np.maximum(like.share - HALF, 0).sum())
