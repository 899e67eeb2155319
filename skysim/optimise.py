"""Where to glue so many LEDs that the worst attitude is known as well as can be: LEDs exchange their places.

What a camera on its lever can learn of the attitude from the LEDs in its field is the Fisher information of the
rotation-only solve; here it is written down by itself and never asked of an estimator. By the mean of the worst drawn
attitudes no layout returned is worse than the even ones it began with; one attitude alone may be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skysim import lamp
from skysim.likeness import Likeness, likeness
from skysim.planetarium import Inside
from skysim.turninfo import Seen, add, costs, look, renew, tally, told, variances
from skysim.types import BadInput, Floats

Ints = NDArray[np.int64]

SITES_AN_LED = 300  # places to choose from: a seventeenth of the LEDs' own spacing apart
EVEN = 10  # of them are enough to be spread evenly
FAR = 0.1  # of the offers are anywhere
STEPS = (0.02, 0.6)  # of the LEDs' own spacing: how far the others are, from the least to the greatest
SEERS = 400  # attitudes that see a site: a field's border passes it in steps of a twentieth of the field
FEWEST, MOST = 2000, 10_000  # attitudes judged
GOLDEN = 1.2207440846057596  # g^4 = g + 1: by its powers points fill a cube evenly (Roberts 2018; assumed)
EXAMINED = 3  # times as many attitudes are those by which layouts are compared
TAILS = (0.0005, 0.01)  # of them, the worst: what is asked of a dome
GENERATIONS = 25  # of attitudes: after each the hardest of fresh ones join those that are judged
DRAWN, HARDEST = 20_000, 400
SHAKES, SHAKE = 6, 0.1
EDGE = 0.98  # of the field is what a search believes in
HALF = 0.5  # of a field's LEDs may coincide with another field's
NUDGES = 100  # tries to make a field differ
ABOUT = 4  # LEDs in the middle of a field, one of which is nudged
SLACK = 0.02  # by which the worst variance may rise for it


class Exam(NamedTuple):
    """What layouts are compared by: (A, 3, 3) attitudes that no search looks at, and what is to be beaten in them.

    limit : (2,) the least marks that layouts to begin with have
    """

    part: lamp.Optimised
    R_body_from_lab: Floats
    limit: Floats

    def marks(self, place_m: Floats) -> Floats:
        """(2,) variances, rad^2 per rad^2 of a ray: the means of the worst attitudes, by the parts of TAILS.

        The very worst one is a matter of a hair's breadth, by which an LED leaves the field, and of luck to find.
        """
        each = np.sort(variances(told(place_m, self.R_body_from_lab, *camera(self.part))))
        return np.array([each[-math.ceil(part * len(each)) :].mean() for part in TAILS])

    def mark(self, place_m: Floats) -> float:
        """The worse of both over its limit: what has 1 or less is at least as good as any layout to begin with."""
        return float(np.max(self.marks(place_m) / self.limit))


def places(
    part: lamp.Optimised, sites_m: Floats, begin_m: Sequence[Floats], rng: np.random.Generator
) -> Floats:
    """(N, 3) of the sites, m, where part.count LEDs make the worst attitude within the tilt as good as possible.

    sites_m : (K, 3) allowed places in the lab, on the surface within its rim and cap; SITES_AN_LED times the count do
    begin_m : (N, 3) each, layouts to begin with, beside one of the sites that is as even as chance makes it
    Descent of sum_a c_a^6, c_a = SHORT^missing tr((sum_i J_i'J_i)^-1), over attitudes a to the tilt, with what LED i
    tells of a turn in J_i: one LED after another is offered another site. Heat only lost the evenness it began with.
    Of what each generation came to the best by `Exam` is kept, so none of the layouts to begin with is better in the
    worst attitudes. Then fields that look alike are made to differ: `set_apart`.
    Raises BadInput where so many do not find room at the spacing.
    """
    beginnings = [one for one in begin_m if cKDTree(one).query(one, k=2)[0][:, 1].min() >= part.spacing_m]
    chosen = evenly(sites_m[: EVEN * part.count], part)
    if len(chosen) == part.count:
        beginnings.append(sites_m[chosen])
    if not beginnings:
        raise BadInput(
            f"light.layout.spacing: {len(chosen)} of {part.count} LEDs find room {part.spacing_m:.3g} m apart where a"
            f" tilt of {part.tilt_deg:g} deg looks; allowed: fewer, nearer to each other, or a greater cap_deg"
        )
    judged = attitude_count(part, sites_m, rng)
    exam = Exam(part, attitudes(part, EXAMINED * judged, rng), np.ones(2))
    exam = exam._replace(limit=np.min([exam.marks(one) for one in beginnings], axis=0))
    best_m = min(beginnings, key=exam.mark)
    found = searched(part, best_m, sites_m, attitudes(part, judged, rng), rng)
    best_m = min([best_m, *found], key=exam.mark)
    return set_apart(exam, best_m, sites_m, rng)


def searched(
    part: lamp.Optimised, place_m: Floats, sites_m: Floats, R_body_from_lab: Floats, rng: np.random.Generator
) -> list[Floats]:
    """(N, 3) each, what the generations came to from these places."""
    tree, found = cKDTree(sites_m), []
    ends = np.linspace(0, part.rounds, GENERATIONS + 1).round().astype(int)[1:-1]
    for n in range(part.rounds):
        if n in ends:
            found.append(place_m)
            R_body_from_lab = np.concatenate([R_body_from_lab, hardest(part, place_m, rng)])
        both_m = np.concatenate([place_m, offers(place_m, sites_m, tree, rng)])
        chosen = np.arange(part.count)
        seen = seen_from(part, both_m, R_body_from_lab)
        who = rng.permutation(part.count)
        exchange(chosen, both_m, seen, len(R_body_from_lab), part.wanted, part.spacing_m, who, who + part.count)
        place_m = both_m[chosen]
    return [*found, place_m]


def offers(place_m: Floats, sites_m: Floats, tree: cKDTree, rng: np.random.Generator) -> Floats:
    """(N, 3) of the sites, one an LED: most a step beside it, some anywhere."""
    usual_m = np.median(cKDTree(place_m).query(place_m, k=2)[0][:, 1])
    step_m = usual_m * np.exp(rng.uniform(*np.log(STEPS), (len(place_m), 1)))
    beside = tree.query(place_m + step_m * rng.standard_normal(place_m.shape))[1]
    anywhere = rng.integers(len(sites_m), size=len(place_m))
    return sites_m[np.where(rng.random(len(place_m)) < FAR, anywhere, beside)]


def seen_from(part: lamp.Optimised, sites_m: Floats, R_body_from_lab: Floats) -> Seen:
    """Who sees which site."""
    return Seen(*look(sites_m, R_body_from_lab, np.array(part.camera_m), EDGE * tan_half(part)))


def attitude_count(part: lamp.Optimised, sites_m: Floats, rng: np.random.Generator) -> int:
    """How many attitudes it takes for SEERS of them to see a site, from how many sites a few see."""
    few, some_m = attitudes(part, 200, rng), sites_m[: EVEN * part.count]
    share = len(seen_from(part, some_m, few).attitude) / (len(few) * len(some_m))
    return int(np.clip(SEERS / max(share, 1e-9), FEWEST, MOST))


def hardest(part: lamp.Optimised, place_m: Floats, rng: np.random.Generator) -> Floats:
    """(H, 3, 3) R_body_from_lab: of fresh attitudes those that these LEDs serve worst, and then the worst about them."""
    drawn = attitudes(part, DRAWN, rng)
    each = served(part, place_m, drawn)
    kept = np.argsort(each)[-HARDEST:]
    worst, each = drawn[kept], each[kept]
    step_rad = float(tan_half(part).min()) * SHAKE
    for _ in range(SHAKES):
        shaken = Rotation.from_rotvec(step_rad * rng.standard_normal((HARDEST, 3)) * [1, 1, 8]).as_matrix() @ worst
        fresh = served(part, place_m, shaken)
        harder = (fresh > each) & (shaken[:, 2, 2] >= math.cos(math.radians(part.tilt_deg)))
        worst[harder], each[harder] = shaken[harder], fresh[harder]
    return worst


def served(part: lamp.Optimised, place_m: Floats, R_body_from_lab: Floats) -> Floats:
    """(A,) how badly, by the search's cost."""
    where_m, field = camera(part)
    return costs(told(place_m, R_body_from_lab, where_m, EDGE * field), part.wanted)


def attitudes(part: lamp.Optimised, count: int, rng: np.random.Generator) -> Floats:
    """(A, 3, 3) R_body_from_lab of boresights evenly over the cap of the tilt, of any yaw: a shifted lattice's."""
    turn = (rng.random(3) + np.arange(count)[:, None] / GOLDEN ** np.arange(1, 4)) % 1
    tilt = np.arccos(1 - turn[:, 0] * (1 - math.cos(math.radians(part.tilt_deg))))
    angles = np.column_stack([2 * math.pi * turn[:, 1], tilt, 2 * math.pi * turn[:, 2]])
    return Rotation.from_euler("ZYZ", angles).inv().as_matrix()


def camera(part: lamp.Optimised) -> tuple[Floats, Floats]:
    """Where its pupil is on the body, m, and the tangents of half its field."""
    return np.array(part.camera_m), tan_half(part)


def tan_half(part: lamp.Optimised) -> Floats:
    """(2,) tangents of half the field's width and height."""
    return np.tan(np.radians(part.field_deg) / 2)


def reach_rad(part: lamp.Optimised, inside: Inside) -> float:
    """How far from the zenith, as the bearing sees it, any attitude's field comes on a surface; at most the cap.

    From every side of the greatest tilt, at every yaw, the rays of the field's diagonal turned about the boresight.
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


@numba.njit(cache=True)
def room_at(site: int, without: int, chosen: Ints, sites_m: Floats, spacing_m: float) -> bool:
    """Whether a site is as far as the spacing from every LED but that one."""
    for n in range(len(chosen)):
        away2 = 0.0
        for i in range(3):
            away2 += (sites_m[chosen[n], i] - sites_m[site, i]) ** 2
        if n != without and away2 < spacing_m**2:
            return False
    return True


@numba.njit(cache=True)
def exchange(
    chosen: Ints,
    sites_m: Floats,
    seen: Seen,
    attitude_count: int,
    wanted: int,
    spacing_m: float,
    who: Ints,
    where: Ints,
) -> None:
    """One offer a LED: who[n] moves to where[n] if there is room and the cost falls. In place."""
    total = tally(chosen, seen, attitude_count)
    each = costs(total, wanted)
    for n in range(len(who)):
        old, new = chosen[who[n]], where[n]
        if old == new or not room_at(new, who[n], chosen, sites_m, spacing_m):
            continue
        add(old, -1, seen, total)
        add(new, 1, seen, total)
        if renew(old, seen, total, each, wanted) + renew(new, seen, total, each, wanted) < 0:
            chosen[who[n]] = new
        else:
            add(new, -1, seen, total)
            add(old, 1, seen, total)
            renew(old, seen, total, each, wanted)
            renew(new, seen, total, each, wanted)


def evenly(sites_m: Floats, part: lamp.Optimised) -> Ints:
    """The sites, in their order, that are as far apart as finds part.count of them room; or fewer at the spacing."""
    chosen = apart(sites_m, part.spacing_m, part.count)
    near_m, far_m = part.spacing_m, float(np.ptp(sites_m, axis=0).max())
    for _ in range(12):
        middle_m = (near_m + far_m) / 2
        wider = apart(sites_m, middle_m, part.count)
        if len(wider) < part.count:
            far_m = middle_m
        else:
            near_m, chosen = middle_m, wider
    return chosen


def apart(sites_m: Floats, spacing_m: float, count: int) -> Ints:
    """The first `count` of the sites, taken in their order, that have none taken before within the spacing."""
    tree, free = cKDTree(sites_m), np.ones(len(sites_m), dtype=bool)
    taken: list[int] = []
    for site in range(len(sites_m)):
        if free[site] and len(taken) < count:
            taken.append(site)
            free[tree.query_ball_point(sites_m[site], spacing_m)] = False
    return np.array(taken, dtype=np.int64)


# Fields that are told apart.


def alike(part: lamp.Optimised, place_m: Floats) -> Likeness:
    """How much of the field about each LED another attitude shows as well; a round field of the camera's own area."""
    radius_rad = math.atan(math.sqrt(4 * float(np.prod(tan_half(part))) / math.pi))
    return likeness(place_m, part.camera_m[2], math.radians(part.tilt_deg), radius_rad, part.alike_m)


def set_apart(exam: Exam, place_m: Floats, sites_m: Floats, rng: np.random.Generator) -> Floats:
    """The places after LEDs of fields too much alike were nudged to free sites beside, where that makes less of it.

    Too much is more than HALF of a field. The worst variances may rise by SLACK in all, not beyond what layouts to
    begin with have. What NUDGES tries do not part stays: of three LEDs in a field two have their like almost anywhere.
    """
    part, tree = exam.part, cKDTree(sites_m)
    like, mark = alike(part, place_m), exam.mark(place_m)
    most = max(mark, min(1.0, mark * (1 + SLACK)))
    for _ in range(NUDGES):
        bad = np.flatnonzero(like.share > HALF)
        if not len(bad):
            break
        middle_m = place_m[like.led[rng.choice(bad)]]
        who = rng.choice(cKDTree(place_m).query(middle_m, k=min(ABOUT, part.count))[1])
        tried_m = place_m.copy()
        tried_m[who] = sites_m[rng.choice(tree.query(place_m[who], k=min(100, len(sites_m)))[1])]
        if np.delete(np.linalg.norm(place_m - tried_m[who], axis=1), who).min() < part.spacing_m:
            continue
        nudged = alike(part, tried_m)
        if excess(nudged) < excess(like) and exam.mark(tried_m) <= most:
            place_m, like = tried_m, nudged
    return place_m


def excess(like: Likeness) -> float:
    """By how much fields are more alike than HALF, all together."""
    return float(np.maximum(like.share - HALF, 0).sum())
