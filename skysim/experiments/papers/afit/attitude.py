"""AFIT's Test 3, attitudes (Padro 2012, 4.4.2, Tables 10-15): the thesis's algorithm against the IMU.

The thesis gives the attitude by its algorithm and by the IMU at five positions. Our baseline repeats the algorithm on
clean images with a perfect IMU. Then the likely causes of the differences are simulated together: camera noise with
two LEDs under a rolling shutter, drift of an LN-200 during a stay at each position, and the bump at position 5
(module `bump`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import quest
from estimator.calibration.home_position import Sighting
from estimator.catalog.catalog import unit
from estimator.catalog.pair_buckets import PairCatalogue, bucketed, candidates
from estimator.core.arrays import Ints
from estimator.identification.published.saa_search import Gates, Sky, gate_rad, matched, primary_of
from skysim.core.types import Floats
from skysim.core.units import ARCSEC_RAD, INCH_M
from skysim.dynamics import guidance, imu
from skysim.dynamics.multibody import imu_place_m
from skysim.experiments.papers.afit import bump
from skysim.experiments.papers.afit.bench import vectors_m
from skysim.experiments.papers.afit.still import (
    ALGORITHM_DEG,
    EPSILON_MAG,
    EPSILON_POS_M,
    EPSILON_SEP_ARCSEC,
    HOME,
    IMU_DEG,
    LAB,
    LEDS,
    angles_deg,
    bench,
    lab_from_body,
    photographed,
)
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import another
from skysim.results.metrics import Summary, share
from skysim.results.plots import INK
from skysim.scene import loader
from skysim.simulation import testbed
from skysim.simulation.testbed import Testbed

STAY_MIN = 0.75  # time at a position: fitted, see `drawings`
STAYS_MIN = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
AZIMUTH_DEG = "0"  # of the lab's x axis: fitted
KNOT_S = 0.05  # the vehicle turns at 2 deg/s at most
STATISTICS: dict[str, Callable[..., Any]] = {
    "min": np.min,
    "max": np.max,
    "mean": np.mean,
    "sd": lambda values, axis: np.std(values, axis=axis, ddof=1),
}
PAIR = "two LEDs under a rolling shutter"
IMU = f"{PAIR}, an LN-200 of {STAY_MIN} min a stay"
BUMPED = f"{IMU}, position 5 bumped"


class Solved(NamedTuple):
    """D sets of five images, one per position; the catalog is from the home position's image.

    off_deg  : (D, 5, 3) roll, pitch, yaw by the algorithm minus the true ones
    named    : number of images with all LEDs identified correctly, and number of images
    """

    off_deg: Floats
    named: tuple[int, int]


class World(NamedTuple):
    """Results with all causes simulated together.

    off_deg : (K, 5, 3) attitude by the algorithm minus that of the IMU
    images : number of independent draws for positions 1 to 4 (the fewer of images and IMUs)
    bumps : number of independent draws for position 5 (the fewest of images, IMUs and bumps)
    earth_deg : (5, 3) what an uncorrected Earth rate in the IMU would add
    """

    off_deg: Floats
    images: int
    bumps: int
    earth_deg: Floats


def attitudes(ask: Ask) -> Found:
    """Tables 10-15: with clean images and a perfect IMU; with camera noise, IMU drift and the bump as the cause."""
    images, units = ask.trials(50, 3), ask.trials(60, 8)
    clean = solved(bench(), images, LEDS, np.random.default_rng([ask.seed, 0]))
    ask.watch(1, 4)
    pair = solved(bench(LAB), images, 2, np.random.default_rng([ask.seed, 1]))
    ask.watch(2, 4)
    stays = (STAY_MIN,) if ask.quick else STAYS_MIN
    drift = {stay: drifted(stay, units, np.random.default_rng([ask.seed, 2])) for stay in stays}
    still = drifted(STAY_MIN, units, np.random.default_rng([ask.seed, 2]), earth=False)
    ask.watch(3, 4)
    knocked = bump.flights(bump.FITTED, ask.trials(10, 3), ask.seed)
    bumps = np.array([one.imu_deg[-1] for one in knocked])
    earth_deg = (still - drift[STAY_MIN]).mean(axis=0)
    world = all_at_once(pair.off_deg, still, bumps, earth_deg)
    answers = each(clean.off_deg, world) | table_15(clean.off_deg, world)
    worst = [np.abs(one).max(axis=(1, 2)) for one in (clean.off_deg, world.off_deg)]
    answers["worst"] = Answer(another(worst[0]), cause=Cause(BUMPED, another(worst[1], world.bumps)))
    answers["named"] = Answer(
        in_percent(share(*clean.named)), cause=Cause(PAIR, in_percent(share(*pair.named)))
    )
    turn = [one[:, 3, 0] - one[:, 2, 0] for one in (clean.off_deg, world.off_deg)]
    answers["turns_back"] = Answer(
        another(turn[0]),
        with_earth(world, turn[1].mean() + earth_deg[3, 0] - earth_deg[2, 0]),
        Cause(IMU, another(turn[1], world.images)),
    )
    return Found(answers, drawings(world, drift))


def all_at_once(pair_deg: Floats, drift_deg: Floats, bump_deg: Floats, earth_deg: Floats) -> World:
    """Combine images, IMUs and bumps by cycling through each; a bump adds to the IMU's error at position 5."""
    counts = len(pair_deg), len(drift_deg), len(bump_deg)
    turn = np.arange(max(counts))
    # The algorithm's errors minus the IMU's, each sequence repeated to the length of the longest.
    off = pair_deg[turn % counts[0]] - drift_deg[turn % counts[1]]
    off[:, -1] -= bump_deg[turn % counts[2]]
    return World(off, min(counts[:2]), min(counts), earth_deg)


def with_earth(world: World, value: float) -> str:
    """Note with the value if the IMU also contained the Earth rate."""
    return f"were the Earth's turning in the IMU besides: {value:.3f}"


def in_percent(part: Summary) -> Summary:
    return Summary(100 * part.value, 100 * part.low, 100 * part.high, part.trials)


def each(clean: Floats, world: World) -> dict[str, Answer]:
    """Tables 10-14: the algorithm's angles minus the IMU's."""
    answers = {}
    for position in range(len(IMU_DEG)):
        last = position == len(IMU_DEG) - 1
        name, count = (BUMPED, world.bumps) if last else (IMU, world.images)
        for axis in range(3):
            found = world.off_deg[:, position, axis]
            home = position == HOME
            answers[f"position_{position + 1}_theta_{axis + 1}"] = Answer(
                another(clean[:, position, axis]),
                "" if home else with_earth(world, found.mean() + world.earth_deg[position, axis]),
                None if home else Cause(name, another(found, count)),
            )
    return answers


def table_15(clean: Floats, world: World) -> dict[str, Answer]:
    """Minimum, maximum, mean and standard deviation (n - 1) of an angle's five differences, and the angles' average."""
    answers = {}
    for name, statistic in STATISTICS.items():
        ours, theirs, besides = (
            statistic(np.abs(one), axis=1) for one in (clean, world.off_deg, world.off_deg + world.earth_deg)
        )
        for column in range(4):
            key = "averaged" if column == 3 else f"theta_{column + 1}"
            told = [one.mean(axis=1) if column == 3 else one[:, column] for one in (ours, theirs, besides)]
            answers[f"{name}_{key}"] = Answer(
                another(told[0]),
                with_earth(world, told[2].mean()),
                Cause(BUMPED, another(told[1], world.bumps)),
            )
    return answers


# The camera.


def solved(lab: Testbed, images: int, lights: int, rng: np.random.Generator) -> Solved:
    """The thesis's processing: eqs 43-44, SAA with Table 9's epsilons, QUEST with the `lights` brightest LEDs.

    images : number of images per position
    """
    seen = [photographed(lab, n, lab_from_body(one), images, rng) for n, one in enumerate(IMU_DEG)]
    sets = list(zip(*seen, strict=False))
    off, right = np.empty((len(sets), len(IMU_DEG), 3)), 0
    for d, shots in enumerate(sets):
        # The home image is the map: all attitudes of a set are relative to it, as in the thesis.
        catalogue = home_catalogue(lab, shots[HOME])
        for n, shot in enumerate(shots):
            order = np.argsort(-shot.magnitude, kind="stable")
            vectors = unit(vectors_m(lab, shot.xy_px[order]))
            star = identified(vectors, shot.magnitude[order], catalogue)
            right += int(np.array_equal(star, order))
            used = order[:lights]
            here = quest(vectors[:lights], catalogue.vectors[used], np.ones(lights))
            off[d, n] = angles_deg(here.inv()) - IMU_DEG[n]
    return Solved(off, (right, len(sets) * len(IMU_DEG)))


def home_catalogue(lab: Testbed, home: Sighting) -> PairCatalogue:
    """Catalog of section 3.6.4: the LEDs as seen from the home position, pairs in buckets of 100 arcsec."""
    return bucketed(unit(vectors_m(lab, home.xy_px)), home.magnitude)


def identified(vectors: Floats, magnitude: Floats, catalogue: PairCatalogue) -> Ints:
    """(N,) catalog row of each observed LED, brightest first, -1 for none, by SAA from the two brightest.

    As in the thesis, the hypothesis of lowest cost is accepted. Our own SAA also requires that a match is significant
    against chance, which five LEDs with errors of 2 mm in a cross of 8 mm rarely are.
    """
    gates = Gates(EPSILON_SEP_ARCSEC * ARCSEC_RAD, EPSILON_POS_M / (48 * INCH_M), EPSILON_MAG, 0.0)
    sky = Sky(vectors, magnitude, catalogue.vectors, catalogue.magnitude, catalogue.cells, gates)
    apart = float(2 * np.arcsin(np.linalg.norm(vectors[0] - vectors[1]) / 2))
    gate = gate_rad(gates, apart)
    begin, end = candidates(catalogue, apart - gate, apart + gate)
    star, cost, _ = matched(sky, primary_of(sky, 0, 1), catalogue.pair[begin:end])
    return star[cost.argmin()].astype(np.int64) if len(cost) else np.full(len(vectors), -1)


# The IMU.


def drifted(stay_min: float, units: int, rng: np.random.Generator, earth: bool = True) -> Floats:
    """(U, 5, 3) error of U random IMUs at the end of each stay: roll, pitch, yaw in degrees.

    The vehicle follows Test 3's commanded attitudes exactly; each IMU has its own hardware seed.
    earth : measure the Earth rate and do not correct for it
    """
    lab = testbed.build_testbed(loader.load("afit_test3", {"lab.x_azimuth_deg": AZIMUTH_DEG}))
    part = lab.scene.vehicle.imu
    assert part is not None
    asked = lab.scene.motion.manoeuvre[1:]  # the IMU is zeroed as the vehicle leaves home
    tour = [
        one.model_copy(update={"duration_s": 60 * stay_min}) if one.kind == "hold" else one for one in asked
    ]
    reference = guidance.plan(lab.scene.motion.model_copy(update={"manoeuvre": tuple(tour)}))
    t_s = np.arange(0, reference.duration_s, KNOT_S)
    wxyz, rate, _ = (np.array(column) for column in zip(*map(reference.at, t_s), strict=True))
    ideal = imu.felt(
        t_s,
        wxyz,
        rate,
        t_s[1:],
        KNOT_S,
        imu_place_m(lab.ship),
        lab.ship.gravity_m_s2,
        imu.earth_rate_lab_rad_s(lab.scene.lab) * earth,
    )
    leave_s = np.array(reference.start_s[::2])  # of home, then the ends of the stays
    stops = np.searchsorted(t_s[1:], leave_s - KNOT_S)
    makes = [part.model_copy(update={"hardware_seed": int(seed)}) for seed in rng.integers(2**31, size=units)]
    return np.array([readings(imu.Unit.of(made, rng).measure(ideal), stops) - IMU_DEG for made in makes])


def readings(measured: imu.Increments, stops: Ints) -> Floats:
    """(5, 3) roll, pitch, yaw in degrees from integrated IMU increments, after each number of samples in `stops`."""
    here, shown = np.array([1.0, 0.0, 0.0, 0.0]), []
    for piece in np.split(measured.angle_rad, stops)[: len(stops)]:
        here = imu.turned(here, piece, np.zeros(3), measured.step_s)
        shown.append(here)
    return angles_deg(Rotation.from_quat(shown, scalar_first=True))


# Figures.


def drawings(world: World, drift: dict[float, Floats]) -> tuple[Drawing, ...]:
    return (
        Drawing(
            "Tables 10-14: the algorithm less the IMU, and where 95 % of ours are with camera noise, the IMU's own"
            " drift and the bump; diamonds, were the Earth's turning in the IMU besides.",
            lambda fig: draw_differences(fig, world),
            (7.4, 3.5),
        ),
        Drawing(
            "How long a stay makes the errors of an IMU that feels the Earth turn as great as Table 15 has them.",
            lambda fig: draw_stays(fig, drift),
            (7.4, 3.3),
        ),
    )


def draw_differences(fig: Any, world: World) -> None:
    """Signed differences, one panel per angle."""
    at = np.arange(1, len(IMU_DEG) + 1)
    panels = fig.subplots(1, 3, sharey=True)
    for axis, axes in enumerate(panels):
        found = world.off_deg[:, :, axis]
        low, middle, high = np.quantile(found, [0.025, 0.5, 0.975], axis=0)
        spread = [middle - low, high - middle]
        axes.errorbar(at + 0.1, middle, spread, fmt="s", ms=4, color=INK[0], label="ours with the causes")
        earth = found.mean(axis=0) + world.earth_deg[:, axis]
        axes.plot(at + 0.25, earth, "D", ms=4, color=INK[5], label="and the Earth's turning")
        told = np.subtract(ALGORITHM_DEG, IMU_DEG)[:, axis]
        axes.plot(at - 0.1, told, "o", color=INK[1], label="published")
        axes.set(xlabel="position", xticks=at, title=f"theta_{axis + 1}")
    panels[0].set(ylabel="algorithm less IMU (deg)")
    handles, labels = panels[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=3)


def draw_stays(fig: Any, drift: dict[float, Floats]) -> None:
    """Mean absolute difference of roll and of pitch against the duration of a stay."""
    published = np.abs(np.subtract(ALGORITHM_DEG, IMU_DEG)).mean(axis=0)
    for axis, axes in enumerate(fig.subplots(1, 2, sharey=True)):
        mean = np.array([np.abs(one[:, :, axis]).mean(axis=1) for one in drift.values()])
        low, middle, high = np.quantile(mean, [0.025, 0.5, 0.975], axis=1)
        spread = [middle - low, high - middle]
        axes.errorbar(list(drift), middle, spread, fmt="s-", color=INK[0], label="ours, 95 % of IMUs")
        axes.axhline(published[axis], color=INK[1], label="published")
        axes.set(xlabel="minutes at a position", title=f"theta_{axis + 1}")
        if axis == 0:
            axes.set(ylabel="mean difference (deg)")
            axes.legend(loc="upper left")
