"""Where to glue so many LEDs that the worst attitude is known as well as can be: LEDs exchange their places.

What a camera on its lever can learn of the attitude from the LEDs in its field is the Fisher information of the
rotation-only solve; here it is written down by itself and never asked of an estimator. By the mean of the worst drawn
attitudes no layout returned is worse than the even ones it began with; one attitude alone may be.
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
from skysim.sources.dome.placement.ambiguity import Likeness, likeness
from skysim.sources.dome.placement.fisher import Seen, add, costs, look, renew, tally, told, variances
from skysim.sources.dome.surface import Inside

Ints = NDArray[np.int64]

SITES_AN_LED = 500  # places to choose from: a twentieth of the LEDs' own spacing apart
EVEN = 10  # of them are enough to be spread evenly
HALVINGS = 12  # of the sites' width, until they are
# Steps, of the LEDs' own spacing, from the least to the greatest; and how much of the field a search believes in, for
# none is judged at every attitude. Evenness is all where few LEDs are seen; where many are, there is more to gain.
FEW = 8.0  # LEDs in a field, on average
CAREFUL, BOLD = ((0.02, 0.06), 0.93), ((0.01, 0.3), 0.97)
SEERS = 400  # attitudes that see a site: a field's border passes it in steps of a twentieth of the field
FEWEST, MOST = 2000, 20_000  # attitudes judged
GOLDEN = 1.2207440846057596  # g^4 = g + 1: by its powers points fill a cube evenly (Roberts 2018; assumed)
EXAMINED = 40_000  # attitudes by which layouts are compared
TAIL = 0.01  # of them, the worst: what is asked of a dome
DRAWN_IN = (0.98, 0.96, 0.94, 0.92, 0.9, 0.88, 0.86, 0.84)  # of the solid angle, what spreads are drawn in to
GENERATIONS = 15  # of attitudes: after each the hardest of fresh ones join those that are judged
KEPT = 3  # from that many generations to the next what it came to is kept
DRAWN, HARDEST = 20_000, 600
SHAKES, SHAKE = 6, 0.1  # the hardest are turned that often, by that much of half a field, to find harder ones
HALF = 0.5  # of a field's LEDs may coincide with another field's
NUDGES = 100  # tries to make a field differ
BESIDE = 60  # nearest sites, to which it is tried: a fifth of the LEDs' own spacing
ABOUT = 4  # LEDs in the middle of a field, one of which is nudged
SLACK = 0.02  # by which the worst variance may rise for it
BLIND = 0.95  # of the field, where no more attitudes than before may hold fewer than two LEDs for it


class Exam(NamedTuple):
    """What layouts are compared by: (A, 3, 3) attitudes that no search looks at, and what is to be beaten in them.

    limit : the least worst variance that layouts to begin with have
    """

    part: leds.OptimisedConfig
    R_body_from_lab: Floats
    limit: float

    def mark(self, place_m: Floats) -> float:
        """Mean variance of the worst TAIL of attitudes over the limit: 1 or less is as good as any to begin with.

        The very worst one is a matter of a hair's breadth, by which an LED leaves the field, and of luck to find.
        """
        each = np.sort(variances(told(place_m, self.R_body_from_lab, *camera(self.part))))
        return float(each[-math.ceil(TAIL * len(each)) :].mean()) / self.limit

    def blind(self, place_m: Floats) -> int:
        """How many of them have fewer than the two LEDs that an attitude takes in the BLIND part of their field."""
        return int(np.sum(told(place_m, self.R_body_from_lab, *camera(self.part, BLIND))[:, 6] < 2))


def places(
    part: leds.OptimisedConfig, sites_m: Floats, begin_m: Sequence[Floats], rng: np.random.Generator
) -> Floats:
    """(N, 3) of the sites, m, where part.count LEDs make the worst attitude within the tilt as good as possible.

    sites_m : (K, 3) allowed places in the lab, on the surface within its rim and cap; SITES_AN_LED times the count do
    begin_m : (N, 3) each, layouts to begin with, beside one of the sites that is as even as chance makes it
    The best of them, drawn in from the rim as far as the worst attitudes gain by it, begins a descent of sum_a
    c_a^HARDNESS, c_a = SHORT^missing tr((sum_i J_i'J_i)^-1), over attitudes a to the tilt, with what LED i tells of a
    turn in J_i: one LED after another is offered a site beside it. Steps are small, for evenness once lost is not
    found again; they are enough to make one field unlike the others. Of what it came to the best by `worth` is kept,
    so none of the layouts to begin with is better in the worst attitudes. Then `set_apart`, where that is of worth.
    Raises InputError where so many do not find room at the spacing.
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
    """Less is better: whether a layout to begin with is better in the worst attitudes; whether an attitude was found
    that has fewer than two LEDs; then worst variances times 1 to 2, as none or all fields are more than HALF another's.
    """
    mark, like = exam.mark(place_m), alike(exam.part, place_m)
    whole = Search(exam.part, place_m, cKDTree(place_m), CAREFUL[0], 1.0)
    fewest = told(place_m, hardest(whole, place_m, rng), *whole.camera())[:, 6].min()
    return mark > 1, bool(fewest < 2), mark * (1 + float(np.mean(like.share > HALF)))


def roomy(place_m: Floats, spacing_m: float) -> bool:
    """Whether no two are nearer to each other than the spacing."""
    return bool(cKDTree(place_m).query(place_m, k=2)[0][:, 1].min() >= spacing_m)


def drawn_in(place_m: Floats, sites_m: Floats, share: float) -> Floats:
    """(N, 3) of the sites, nearest to places drawn in on that share of their solid angle about the zenith.

    Few attitudes look at the rim, and all of them gain by LEDs that are moved from there to where the others are.
    """
    up = place_m / np.linalg.norm(place_m, axis=1, keepdims=True)
    z = 1 - share * (1 - up[:, 2])
    aside = up[:, :2] * np.sqrt((1 - z**2) / np.maximum(1 - up[:, 2] ** 2, 1e-12))[:, None]
    site_up = sites_m / np.linalg.norm(sites_m, axis=1, keepdims=True)
    return sites_m[cKDTree(site_up).query(np.column_stack([aside, z]))[1]]


class Search(NamedTuple):
    """In what manner places are sought: among (K, 3) sites, m, and a tree of them; steps and edge as in CAREFUL."""

    part: leds.OptimisedConfig
    sites_m: Floats
    tree: cKDTree
    steps: tuple[float, float]
    edge: float

    def offers(self, place_m: Floats, rng: np.random.Generator) -> Floats:
        """(N, 3) of the sites, one an LED, a step beside it; the steps' logarithms are even."""
        usual_m = np.median(cKDTree(place_m).query(place_m, k=2)[0][:, 1])
        least, most = np.log(self.steps)
        step_m = usual_m * np.exp(rng.uniform(least, most, (len(place_m), 1)))
        return self.sites_m[self.tree.query(place_m + step_m * rng.standard_normal(place_m.shape))[1]]

    def camera(self) -> tuple[Floats, Floats]:
        """As `camera`, of the field that is believed in."""
        return camera(self.part, self.edge)


def searched(search: Search, place_m: Floats, judged: int, rng: np.random.Generator) -> list[Floats]:
    """(N, 3) of the sites each, what the generations came to from these places; judged: attitudes at first."""
    part, found, R_body_from_lab = search.part, [], attitudes(search.part, judged, rng)
    ends = np.linspace(0, part.rounds, GENERATIONS + 1).round().astype(int)[1:-1]
    for n in range(part.rounds):
        if n in ends[KEPT - 1 :: KEPT]:
            found.append(place_m)
        if n in ends:
            R_body_from_lab = np.concatenate([R_body_from_lab, hardest(search, place_m, rng)])
        both_m = np.concatenate([place_m, search.offers(place_m, rng)])
        seen = Seen(*look(both_m, R_body_from_lab, *search.camera()))
        chosen, who = np.arange(part.count), rng.permutation(part.count)
        exchange(
            chosen, both_m, seen, len(R_body_from_lab), part.wanted, part.spacing_m, who, who + part.count
        )
        place_m = both_m[chosen]
    return [*found, place_m]


def seen_share(part: leds.OptimisedConfig, sites_m: Floats, rng: np.random.Generator) -> float:
    """Of the sites, how many a few attitudes see on average: times the LEDs, how many a field holds."""
    return float(told(sites_m, attitudes(part, 200, rng), *camera(part))[:, 6].mean()) / len(sites_m)


def hardest(search: Search, place_m: Floats, rng: np.random.Generator) -> Floats:
    """(H, 3, 3) R_body_from_lab: of fresh attitudes those that these LEDs serve worst, or still worse ones beside.

    About the boresight they are turned by more, since what is in the field's corner moves less.
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
    """(A,) how badly, by the search's cost."""
    return costs(told(place_m, R_body_from_lab, *search.camera()), search.part.wanted)


def attitudes(part: leds.OptimisedConfig, count: int, rng: np.random.Generator) -> Floats:
    """(A, 3, 3) R_body_from_lab of boresights evenly over the cap of the tilt, of any yaw: a shifted lattice's."""
    turn = (rng.random(3) + np.arange(count)[:, None] / GOLDEN ** np.arange(1, 4)) % 1
    tilt = np.arccos(1 - turn[:, 0] * (1 - math.cos(math.radians(part.tilt_deg))))
    angles = np.column_stack([2 * math.pi * turn[:, 1], tilt, 2 * math.pi * turn[:, 2]])
    return Rotation.from_euler("ZYZ", angles).inv().as_matrix()


def camera(part: leds.OptimisedConfig, edge: float = 1.0) -> tuple[Floats, Floats]:
    """Where its pupil is on the body, m, and the tangents of half its field, or of that part of it."""
    return np.array(part.camera_m), edge * tan_half(part)


def tan_half(part: leds.OptimisedConfig) -> Floats:
    """(2,) tangents of half the field's width and height."""
    return np.tan(np.radians(part.field_deg) / 2)


def reach_rad(part: leds.OptimisedConfig, inside: Inside) -> float:
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


@jit
def room_at(site: int, without: int, chosen: Ints, sites_m: Floats, spacing_m: float) -> bool:
    """Whether a site is as far as the spacing from every LED but that one."""
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


def evenly(sites_m: Floats, spacing_m: float, count: int, halvings: int = HALVINGS) -> Ints:
    """The sites, in their order, that are as far apart as finds `count` of them room; or fewer at the spacing."""
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
    """The first `count` of the sites, or all, taken in their order, that have none taken before within the spacing."""
    tree, free = cKDTree(sites_m), np.ones(len(sites_m), dtype=bool)
    taken: list[int] = []
    for site in range(len(sites_m)):
        if free[site] and (count is None or len(taken) < count):
            taken.append(site)
            free[tree.query_ball_point(sites_m[site], spacing_m)] = False
    return np.array(taken, dtype=np.int64)


# Fields that are told apart.


def alike(part: leds.OptimisedConfig, place_m: Floats) -> Likeness:
    """How much of the field about each LED another attitude shows as well; a round field of the camera's own area."""
    radius_rad = math.atan(math.sqrt(4 * float(np.prod(tan_half(part))) / math.pi))
    return likeness(place_m, part.camera_m[2], math.radians(part.tilt_deg), radius_rad, part.alike_m)


def set_apart(exam: Exam, place_m: Floats, sites_m: Floats, rng: np.random.Generator) -> Floats:
    """The places after LEDs of fields too much alike were nudged to free sites beside, where that makes less of it.

    Too much is more than HALF of a field. The worst variances may rise by SLACK in all, not beyond what layouts to
    begin with have. What NUDGES tries do not part stays: of three LEDs in a field two have their like almost anywhere.
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
        nudged = alike(part, tried_m)
        if excess(nudged) >= excess(like) or exam.blind(tried_m) > blind:
            continue
        if exam.mark(tried_m) <= most:
            place_m, like = tried_m, nudged
    return place_m


def excess(like: Likeness) -> float:
    """By how much fields are more alike than HALF, all together."""
    return float(np.maximum(like.share - HALF, 0).sum())
