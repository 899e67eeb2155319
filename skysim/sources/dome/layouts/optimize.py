"""Optimized LED placement: move LEDs between candidate sites to lower the variance of the worst attitudes.

What a camera on its lever arm can learn about the attitude a from the LEDs in its field is the Fisher information of
the rotation-only solution, M_a = sum_i J_i'J_i (`fisher`). It does not depend on any estimator. The search minimizes

    sum_a (MISSING_LED_FACTOR^missing_a tr(M_a^-1))^HARDNESS,

a smooth substitute for the worst case over all attitudes to the greatest tilt, in which missing_a is the number of
LEDs that the field lacks of `min_leds`. It is a local search: each LED in turn is tried at a random site nearby, and
the move is kept if it lowers the sum and respects the least spacing (`try_moves`). Because no finite set of attitudes
contains the worst one, the hardest attitudes of a fresh random sample join the set between generations
(`hardest_attitudes`).

Layouts are compared by the mean variance of the worst 1 % of independent attitudes
(`PlacementScore`). By this measure the result is never worse than the even layouts; at a single attitude it can be.
`optimize_places` has the steps in order.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats, Ints, around_z, lengths
from skysim.scene.sections.layouts import OptimizedConfig
from skysim.sources.dome.layouts.ambiguity import Ambiguity, field_ambiguity
from skysim.sources.dome.layouts.fisher import (
    Visibility,
    add_led,
    costs,
    sum_information,
    total_information,
    update_costs,
    variances,
    visible_from,
)
from skysim.sources.dome.layouts.placing import contract, spacing_ok, spread, tilts_rad
from skysim.sources.dome.surface import Surface

# g^4 = g + 1: base of the R3 low-discrepancy sequence (Roberts 2018; assumed).
GOLDEN = 1.2207440846057596


# Sites and starting layouts.
SITES_PER_LED = (
    500  # candidate sites per LED; their spacing is then a twentieth of the LEDs' own
)
EVEN_SITES_PER_LED = 10  # sites per LED that suffice for an even layout
# Steps that find its spacing, between the least spacing and the sites' extent.
BISECTIONS = 12
# Fractions of the solid angle to which the best even layout is contracted.
CONTRACTIONS = (0.98, 0.96, 0.94, 0.92, 0.9, 0.88, 0.86, 0.84)

# Local search: least and greatest step in units of the LEDs' spacing, and the fraction of the field that is used. The
# margin is for attitudes between the sampled ones, which lose LEDs at the edge. With few LEDs in a field, less than
# SPARSE_BELOW in the mean, evenness matters most and steps must be small; with many, larger steps gain more.
SPARSE_BELOW = 8.0
SPARSE = (0.02, 0.06), 0.93
DENSE = (0.01, 0.3), 0.97
# Sampled attitudes that see a site; a field's border then passes it in steps of a twentieth of the field.
VIEWS_PER_SITE = 400
ATTITUDES = 2000, 20_000  # limits of the number of sampled attitudes
# Generations into which the rounds are divided; after each the hardest of fresh attitudes join the sample.
GENERATIONS = 15
KEEP_EVERY = 3  # generations from one candidate layout to the next

# Hardest attitudes: size of a fresh sample, and number of its attitudes that are kept.
FRESH_ATTITUDES = 20_000
HARDEST_ATTITUDES = 600
# Random rotations tried for each of these, and their size in half fields.
PERTURBATIONS = 6
PERTURBATION_SIZE = 0.1

# Comparison of layouts: number of independent attitudes, and the fraction of them, the worst, whose mean variance is
# compared.
SCORE_ATTITUDES = 40_000
TAIL_FRACTION = 0.01
INNER_FIELD = 0.95  # fraction of the field in which fewer than two LEDs count as too few

# Ambiguity.
MAX_OVERLAP = 0.5  # fraction of a field's LEDs that may coincide with another field's
AMBIGUITY_TRIALS = 100  # tries to move one LED of an ambiguous field
CENTRAL_LEDS = 4  # number of LEDs nearest to the field's center, one of which is moved
# Number of nearest sites that it may take; they reach a fifth of the LEDs' own spacing.
NEARBY_SITES = 60
VARIANCE_SLACK = 0.02  # relative rise of the worst variances that the moves may cost in total


class PlacementScore(NamedTuple):
    """Comparison of layouts on attitudes that no search uses.

    Attributes
    ----------
    R_body_from_lab
        (A, 3, 3) attitudes
    reference
        Tail variance of the best even layout, the unit of `tail_variance`
    """

    config: OptimizedConfig
    R_body_from_lab: Floats
    reference: float = 1.0

    def tail_variance(self, place_m: Floats) -> float:
        """Mean variance of the worst attitudes over the reference: 1 or less is as good as any even layout.

        The single worst attitude is unstable: it depends on one LED at the field's edge and on the sampling.
        """
        geometry = camera_geometry(self.config)
        information = total_information(place_m, self.R_body_from_lab, *geometry)
        variance = np.sort(variances(information))
        # Mean of the worst.
        tail = math.ceil(TAIL_FRACTION * len(variance))
        return float(variance[-tail:].mean()) / self.reference

    def under_two(self, place_m: Floats) -> int:
        """Number of attitudes with fewer than two LEDs in the inner part of the field; two fix an attitude."""
        geometry = camera_geometry(self.config, INNER_FIELD)
        return int(
            np.sum(total_information(place_m, self.R_body_from_lab, *geometry)[:, 6] < 2)
        )

    def score(self, place_m: Floats, rng: Generator) -> tuple[bool, bool, float]:
        """Sort key of layouts; less is better.

        In this order: whether an even layout is better in the worst attitudes; whether an attitude was found that
        sees fewer than two LEDs; the tail variance, times 1 + the fraction of ambiguous fields.
        """
        geometry = camera_geometry(self.config)
        tail = self.tail_variance(place_m)
        ambiguity = layout_ambiguity(self.config, place_m)
        hardest = hardest_attitudes(self.config, place_m, geometry, rng)
        fewest = total_information(place_m, hardest, *geometry)[:, 6].min()
        ambiguous = float(np.mean(ambiguity.fraction > MAX_OVERLAP))
        return tail > 1, bool(fewest < 2), tail * (1 + ambiguous)


def optimize_places(
    config: OptimizedConfig,
    sites_m: Floats,
    starts_m: Sequence[Floats],
    rng: Generator,
) -> Floats:
    """(N, 3) sites in m at which config.count LEDs make the worst attitudes within the tilt as good as possible.

    1. The best even layout by `PlacementScore.tail_variance` sets the reference. It is also contracted toward the
       zenith.
    2. From the best of these `descend` lowers the sum over attitudes a to the tilt; the Jacobian J_i of LED i is with
       respect to a rotation about the bearing. Steps are small, because evenness once lost is not regained, but they
       suffice to make one field differ from others.
    3. The best by `PlacementScore.score` of all layouts reached is kept, so no even layout is better in the worst
       attitudes.
    4. `reduce_ambiguity` changes ambiguous fields; its result is kept if `score` prefers it.

    Parameters
    ----------
    sites_m
        (K, 3) allowed places in the lab, on the surface within its rim and cap;
        SITES_PER_LED times the count
    starts_m
        (N, 3) each, layouts to start from; a Poisson-disk sample of the sites, as even as possible, is added

    Raises
    ------
    InputError
        If not all LEDs find room at the spacing.
    """
    # 1. Even layouts that keep the spacing.
    few_sites_m = sites_m[: EVEN_SITES_PER_LED * config.count]
    even = even_layouts(config, few_sites_m, starts_m)
    visible = visible_fraction(config, few_sites_m, rng)
    scorer = PlacementScore(config, sample_attitudes(config, SCORE_ATTITUDES, rng))
    # The best of them is the reference; contracted layouts are further starts.
    even_m = min(even, key=scorer.tail_variance)
    scorer = scorer._replace(reference=scorer.tail_variance(even_m))
    contracted = [contract(even_m, sites_m, fraction) for fraction in CONTRACTIONS]
    roomy = [layout_m for layout_m in contracted if spacing_ok(layout_m, config.spacing_m)]
    start_m = min([even_m, *roomy], key=scorer.tail_variance)

    def best(layouts_m: Sequence[Floats]) -> Floats:
        return min(layouts_m, key=lambda layout_m: scorer.score(layout_m, rng))

    best_m = best([even_m, start_m])
    # 2. and 3.
    best_m = best([best_m, *descend(config, start_m, sites_m, visible, rng)])
    # 4.
    return best([reduce_ambiguity(scorer, best_m, sites_m, rng), best_m])


def even_layouts(
    config: OptimizedConfig, sites_m: Floats, starts_m: Sequence[Floats]
) -> list[Floats]:
    """The starts that keep the spacing, and a Poisson-disk sample of the sites if there is room for it.

    Raises
    ------
    InputError
        If there is none.
    """
    even = [start_m for start_m in starts_m if spacing_ok(start_m, config.spacing_m)]
    chosen = spread(sites_m, config.spacing_m, config.count, BISECTIONS)
    if len(chosen) == config.count:
        even.append(sites_m[chosen])
    if not even:
        raise InputError(
            "light.layout.spacing",
            f"{len(chosen)} of {config.count} LEDs fit {config.spacing_m:.3g} m apart where the field reaches at a"
            f" tilt of {config.tilt_deg:g} deg",
            "fewer LEDs, less spacing, or a greater cap_deg",
        )
    return even


def descend(
    config: OptimizedConfig,
    place_m: Floats,
    sites_m: Floats,
    visible: float,
    rng: Generator,
) -> list[Floats]:
    """Layouts reached by descent from place_m, (N, 3) sites each: one per KEEP_EVERY generations, and the last.

    In each round one move is proposed to each LED and tried in random order:

    1. At the end of a generation keep a candidate, and add the hardest attitudes of a fresh sample.
    2. Propose a site to each LED, a random step away; the step's length is log-uniform between its limits. Compute what
       the attitudes see of the present and of the proposed places.
    3. Try the moves.

    Parameters
    ----------
    visible
        Fraction of the LEDs in a field, from `visible_fraction`
    """
    steps, field_fraction = SPARSE if visible * config.count < SPARSE_BELOW else DENSE
    geometry = camera_geometry(config, field_fraction)
    tree = cKDTree(sites_m)
    candidates = []
    attitude_count = np.clip(VIEWS_PER_SITE / max(visible, 1e-9), *ATTITUDES)
    R_body_from_lab = sample_attitudes(config, int(attitude_count), rng)
    last_rounds = np.linspace(0, config.rounds, GENERATIONS + 1).round().astype(int)[1:-1]
    for n in range(config.rounds):
        if n in last_rounds[KEEP_EVERY - 1 :: KEEP_EVERY]:
            candidates.append(place_m)
        # 1. The descent improves the sampled attitudes at the expense of those between them. Adding the worst of a
        # fresh sample closes these gaps.
        if n in last_rounds:
            hardest = hardest_attitudes(config, place_m, geometry, rng)
            R_body_from_lab = np.concatenate([R_body_from_lab, hardest])
        # 2. Sites 0 to count - 1 are the present places, site count + n is the one proposed to LED n.
        spacing_m = np.median(cKDTree(place_m).query(place_m, k=2)[0][:, 1])
        low, high = np.log(steps)
        step_m = spacing_m * np.exp(rng.uniform(low, high, (config.count, 1)))
        target_m = place_m + step_m * rng.standard_normal(place_m.shape)
        both_m = np.concatenate([place_m, sites_m[tree.query(target_m)[1]]])
        visibility = Visibility(*visible_from(both_m, R_body_from_lab, *geometry))
        # 3.
        chosen = np.arange(config.count)
        # LEDs are tried in random order.
        order = rng.permutation(config.count)
        try_moves(
            chosen,
            both_m,
            visibility,
            len(R_body_from_lab),
            config.min_leds,
            config.spacing_m,
            order,
            order + config.count,
        )
        place_m = both_m[chosen]
    return [*candidates, place_m]


def visible_fraction(config: OptimizedConfig, sites_m: Floats, rng: Generator) -> float:
    """Mean fraction of the sites in the field of view, over random attitudes.

    Multiplied by the number of LEDs, it is the mean number of LEDs in a field.
    """
    total = total_information(
        sites_m, sample_attitudes(config, 200, rng), *camera_geometry(config)
    )
    return float(total[:, 6].mean()) / len(sites_m)


def hardest_attitudes(
    config: OptimizedConfig,
    place_m: Floats,
    geometry: tuple[Floats, Floats],
    rng: Generator,
) -> Floats:
    """(H, 3, 3) attitudes R_body_from_lab with the highest costs for these LEDs, seen with this `camera_geometry`.

    1. The worst of a fresh sample.
    2. Perturb each by random rotations, and keep those that raise its cost. Rotations about the boresight are larger,
       because they move an LED less than rotations across it do: by the tangent of its field angle, at most that of
       the field's corner.
    """

    def attitude_costs(R_body_from_lab: Floats) -> Floats:
        return costs(total_information(place_m, R_body_from_lab, *geometry), config.min_leds)

    # 1.
    sample = sample_attitudes(config, FRESH_ATTITUDES, rng)
    sample_cost = attitude_costs(sample)
    worst = np.argsort(sample_cost)[-HARDEST_ATTITUDES:]
    hardest = sample[worst]
    cost = sample_cost[worst]
    # 2. Size of the rotations across the boresight and about it.
    half = tan_half(config)
    step_rad = PERTURBATION_SIZE * half.min() * np.array([1, 1, 1 / math.hypot(*half)])
    for _ in range(PERTURBATIONS):
        perturbation = Rotation.from_rotvec(step_rad * rng.standard_normal((len(hardest), 3)))
        perturbed = perturbation.as_matrix() @ hardest
        new_cost = attitude_costs(perturbed)
        harder = (new_cost > cost) & (
            perturbed[:, 2, 2] >= math.cos(math.radians(config.tilt_deg))
        )
        hardest[harder] = perturbed[harder]
        cost[harder] = new_cost[harder]
    return hardest


def sample_attitudes(config: OptimizedConfig, count: int, rng: Generator) -> Floats:
    """(A, 3, 3) R_body_from_lab: boresights uniform over the cap of the tilt, yaw uniform; a shifted R3 lattice."""
    # R3 sequence: the multiples of 1/g, 1/g^2 and 1/g^3 modulo 1 fill the unit cube evenly.
    unit = (rng.random(3) + np.arange(count)[:, None] / GOLDEN ** np.arange(1, 4)) % 1
    # Uniform in the cosine of the tilt.
    tilt = np.arccos(1 - unit[:, 0] * (1 - math.cos(math.radians(config.tilt_deg))))
    angles = np.column_stack([2 * math.pi * unit[:, 1], tilt, 2 * math.pi * unit[:, 2]])
    return Rotation.from_euler("ZYZ", angles).inv().as_matrix()


def camera_geometry(
    config: OptimizedConfig, field_fraction: float = 1.0
) -> tuple[Floats, Floats]:
    """(3,) entrance pupil on the body, m, and (2,) tangents of half the field, scaled by `field_fraction`."""
    return np.array(config.camera_m), field_fraction * tan_half(config)


def tan_half(config: OptimizedConfig) -> Floats:
    """(2,) tangents of half the field's width and height."""
    assert config.field_deg is not None, "completed by the scene"
    return np.tan(np.radians(config.field_deg) / 2)


def field_reach_rad(config: OptimizedConfig, surface: Surface) -> float:
    """Greatest angle from the zenith, at the bearing, that the field of any attitude reaches; at most the cap.

    Rays around the cone that encloses the field are intersected with the surface, for boresights at the greatest tilt
    in all azimuths and at every yaw.
    """
    # The circle about the field's corners.
    half_diagonal = np.hypot(*tan_half(config))
    azimuth = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    cone = around_z(half_diagonal, azimuth, 1.0)
    tilt_rad = math.radians(config.tilt_deg)
    angles = [(a, tilt_rad, yaw) for a in azimuth for yaw in azimuth[::2]]
    reach = 0.0
    for lab_from_body in Rotation.from_euler("ZYZ", angles):
        camera_m = lab_from_body.apply(np.array(config.camera_m))
        met_m = surface.meet(camera_m, lab_from_body.apply(cone))
        met_m = met_m[np.isfinite(met_m[:, 0])]
        reach = max(reach, *tilts_rad(met_m), 0.0)
    return min(reach, math.radians(config.cap_deg)) or math.radians(config.cap_deg)


@jit
def has_room(
    site: int, without: int, chosen: Ints, sites_m: Floats, spacing_m: float
) -> bool:
    """Whether a site keeps the spacing to every LED except LED number `without`."""
    for n in range(len(chosen)):
        distance2 = 0.0
        for i in range(3):
            distance2 += (sites_m[chosen[n], i] - sites_m[site, i]) ** 2
        if n != without and distance2 < spacing_m**2:
            return False
    return True


@jit
def try_moves(
    chosen: Ints,
    sites_m: Floats,
    visibility: Visibility,
    attitude_count: int,
    min_leds: int,
    spacing_m: float,
    moved: Ints,
    target: Ints,
) -> None:
    """One trial for each LED: moved[n] goes to site target[n] if there is room and the cost falls; changes `chosen`."""
    total = sum_information(chosen, visibility, attitude_count)
    attitude_cost = costs(total, min_leds)
    for n in range(len(moved)):
        old = chosen[moved[n]]
        new = target[n]
        if old == new or not has_room(new, moved[n], chosen, sites_m, spacing_m):
            continue
        # Only attitudes that see the old or the new site change. The cost is a sum over attitudes, so the changes at
        # the two sites add up: the second call finds attitudes that see both already up to date.
        add_led(old, -1, visibility, total)
        add_led(new, 1, visibility, total)
        change_old = update_costs(old, visibility, total, attitude_cost, min_leds)
        if change_old + update_costs(new, visibility, total, attitude_cost, min_leds) < 0:
            chosen[moved[n]] = new
        else:
            # Undo the move.
            add_led(new, -1, visibility, total)
            add_led(old, 1, visibility, total)
            update_costs(old, visibility, total, attitude_cost, min_leds)
            update_costs(new, visibility, total, attitude_cost, min_leds)


# Ambiguity between fields of view.


def layout_ambiguity(config: OptimizedConfig, place_m: Floats) -> Ambiguity:
    """Ambiguity of the layout (`ambiguity`), for a round field of the same area as the camera's."""
    # A circle of the area 4 tan(w/2) tan(h/2).
    radius_rad = math.atan(math.sqrt(4 * float(np.prod(tan_half(config))) / math.pi))
    assert config.camera_m is not None, "completed by the scene"
    return field_ambiguity(
        place_m,
        config.camera_m[2],
        math.radians(config.tilt_deg),
        radius_rad,
        config.coincidence_m,
    )


def reduce_ambiguity(
    scorer: PlacementScore, place_m: Floats, sites_m: Floats, rng: Generator
) -> Floats:
    """Move LEDs in ambiguous fields to free sites nearby, where that reduces `excess_overlap`; return the layout.

    A field is ambiguous if more than MAX_OVERLAP of its LEDs coincide with another field's. The worst variances may
    rise by VARIANCE_SLACK in total, but not beyond those of the best even layout. Ambiguity that remains after
    AMBIGUITY_TRIALS is accepted: with three LEDs in a field, two of them have a similar pair almost anywhere.

    1. Choose an LED near the center of an ambiguous field, and a site near it that keeps the spacing.
    2. The move must reduce the ambiguity and must not leave more attitudes with fewer than two LEDs.
    3. It must not raise the worst variances beyond the limit.
    """
    config = scorer.config
    tree = cKDTree(sites_m)
    ambiguity = layout_ambiguity(config, place_m)
    tail = scorer.tail_variance(place_m)
    under_two = scorer.under_two(place_m)
    max_tail = max(tail, min(1.0, tail * (1 + VARIANCE_SLACK)))
    for _ in range(AMBIGUITY_TRIALS):
        ambiguous = np.flatnonzero(ambiguity.fraction > MAX_OVERLAP)
        if not len(ambiguous):
            break
        # 1.
        center_m = place_m[ambiguity.led[rng.choice(ambiguous)]]
        central = cKDTree(place_m).query(center_m, k=min(CENTRAL_LEDS, config.count))[1]
        moved = rng.choice(central)
        nearby = tree.query(place_m[moved], k=min(NEARBY_SITES, len(sites_m)))[1]
        trial_m = place_m.copy()
        trial_m[moved] = sites_m[rng.choice(nearby)]
        distance_m = lengths(place_m - trial_m[moved])
        if np.delete(distance_m, moved).min() < config.spacing_m:
            continue
        # 2.
        trial_ambiguity = layout_ambiguity(config, trial_m)
        less_excess = excess_overlap(trial_ambiguity) < excess_overlap(ambiguity)
        if not less_excess or scorer.under_two(trial_m) > under_two:
            continue
        # 3.
        if scorer.tail_variance(trial_m) <= max_tail:
            place_m = trial_m
            ambiguity = trial_ambiguity
    return place_m


def excess_overlap(ambiguity: Ambiguity) -> float:
    """Sum over the fields of the overlap in excess of MAX_OVERLAP."""
    return float(np.maximum(ambiguity.fraction - MAX_OVERLAP, 0).sum())
