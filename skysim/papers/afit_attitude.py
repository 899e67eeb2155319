"""AFIT's Test 3, attitudes (Padro 2012, 4.4.2, Tables 10-15): his algorithm against the IMU, and what parts them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude import quest
from estimator.buckets import PairCatalogue, bucketed, candidates
from estimator.catalog import unit
from estimator.homecat import Sighting
from estimator.saasearch import Gates, Sky, gate_rad, matched, primary_of
from estimator.types import Ints
from skysim import imu, manoeuvre, scene, simulate
from skysim.metrics import Summary, share
from skysim.papers import afit_bump
from skysim.papers.afit_bench import vectors_m
from skysim.papers.afit_still import (
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
from skysim.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.papers.intervals import another
from skysim.plots import INK
from skysim.quantity import ARCSEC_RAD, INCH_M
from skysim.simulate import Lab
from skysim.types import Floats
from skysim.world import imu_place_m

STAY_MIN = 0.75  # at a position: fitted, see `drawings`
STAYS_MIN = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
AZIMUTH_DEG = "0"  # of the lab's x axis: fitted
KNOT_S = 0.05  # the vehicle turns at 2 deg/s at most
STATISTICS: dict[str, Callable[..., Any]] = {
    "min": np.min,
    "max": np.max,
    "mean": np.mean,
    "sd": lambda values, axis: np.std(values, axis=axis, ddof=1),
}
PAIR = "0.1-0.4 px by a rolling shutter, two LEDs"
EARTH = f"the Earth's turning in the IMU, {STAY_MIN} min a stay"
BUMPED = "position 5 bumped"
# What is taken for the cause of each angle's differences.
CAUSES = (EARTH, f"{EARTH}; {BUMPED}", f"{PAIR}; {BUMPED}")


class Solved(NamedTuple):
    """D times five images, one a position, the catalogue from the first.

    off_deg  : (D, 5, 3) roll, pitch, yaw by the algorithm less the true ones
    named    : images whose LEDs all got their own names, of how many
    """

    off_deg: Floats
    named: tuple[int, int]


def attitudes(ask: Ask) -> Found:
    """Tables 10-15: clean images and a perfect IMU; noisy centroids of two LEDs; an IMU that feels the Earth turn."""
    images, units = ask.trials(50, 3), ask.trials(60, 8)
    clean = solved(bench(), images, LEDS, np.random.default_rng([ask.seed, 0]))
    ask.watch(1, 4)
    pair = solved(bench(LAB), images, 2, np.random.default_rng([ask.seed, 1]))
    ask.watch(2, 4)
    stays = (STAY_MIN,) if ask.quick else STAYS_MIN
    drift = {stay: drifted(stay, units, np.random.default_rng([ask.seed, 2])) for stay in stays}
    ask.watch(3, 4)
    knocked = afit_bump.flights(afit_bump.FITTED, ask.trials(10, 1), ask.seed)
    cause = caused(drift[STAY_MIN], pair.off_deg, np.array([one.imu_deg[-1] for one in knocked]))
    answers = each(clean.off_deg, cause) | table_15(clean.off_deg, cause)
    worst = [another(np.abs(one).max(axis=(1, 2))) for one in (clean.off_deg, cause)]
    answers["worst"] = Answer(worst[0], cause=Cause("each angle's cause", worst[1]))
    answers["named"] = Answer(
        in_percent(share(*clean.named)), cause=Cause(PAIR, in_percent(share(*pair.named)))
    )
    turn = [another(one[:, 3, 0] - one[:, 2, 0]) for one in (clean.off_deg, cause)]
    answers["turns_back"] = Answer(turn[0], cause=Cause(EARTH, turn[1]))
    return Found(answers, drawings(cause, drift))


def caused(earth_deg: Floats, pair_deg: Floats, bump_deg: Floats) -> Floats:
    """(U, 5, 3) the algorithm less the IMU by the causes of each angle; an IMU, an image and a bump in turn."""
    count = max(len(earth_deg), len(pair_deg))
    turn = np.arange(count)
    off = -earth_deg[turn % len(earth_deg)]
    off[:, :, 2] = pair_deg[turn % len(pair_deg), :, 2]
    off[:, -1, 1:] -= bump_deg[turn % len(bump_deg), 1:]
    return off


def in_percent(part: Summary) -> Summary:
    return Summary(100 * part.value, 100 * part.low, 100 * part.high, part.trials)


def each(clean: Floats, cause: Floats) -> dict[str, Answer]:
    """Tables 10-14: the algorithm's angles less the IMU's."""
    answers = {}
    for position in range(len(IMU_DEG)):
        for axis, name in enumerate(CAUSES):
            before = name.removesuffix(f"; {BUMPED}") if position < len(IMU_DEG) - 1 else name
            told = Cause(before, another(cause[:, position, axis]))
            answers[f"position_{position + 1}_theta_{axis + 1}"] = Answer(
                another(clean[:, position, axis]), cause=told if position != HOME else None
            )
    return answers


def table_15(clean: Floats, cause: Floats) -> dict[str, Answer]:
    """Least, greatest, mean and deviation (n - 1) of the five differences of an angle, and the angles' average."""
    answers = {}
    for name, statistic in STATISTICS.items():
        ours, theirs = (statistic(np.abs(one), axis=1) for one in (clean, cause))
        for axis, told in enumerate(CAUSES):
            answers[f"{name}_theta_{axis + 1}"] = Answer(
                another(ours[:, axis]), cause=Cause(told, another(theirs[:, axis]))
            )
        answers[f"{name}_averaged"] = Answer(
            another(ours.mean(axis=1)), cause=Cause("each angle's cause", another(theirs.mean(axis=1)))
        )
    return answers


# The camera.


def solved(lab: Lab, images: int, lights: int, rng: np.random.Generator) -> Solved:
    """The thesis's chain: eqs 43-44, SAA with Table 9's epsilons, QUEST by so many of the brightest LEDs."""
    seen = [photographed(lab, n, lab_from_body(one), images, rng) for n, one in enumerate(IMU_DEG)]
    sets = list(zip(*seen, strict=False))
    off, right = np.empty((len(sets), len(IMU_DEG), 3)), 0
    for d, shots in enumerate(sets):
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


def home_catalogue(lab: Lab, home: Sighting) -> PairCatalogue:
    """Section 3.6.4: what is seen from the home position, in buckets of 100 arcsec."""
    return bucketed(unit(vectors_m(lab, home.xy_px)), home.magnitude)


def identified(vectors: Floats, magnitude: Floats, catalogue: PairCatalogue) -> Ints:
    """(N,) the catalogue's row of each observed LED, brightest first, -1 for none: SAA of the two brightest.

    The best of the assumptions that the pair makes, as the thesis takes it: without our own SAA's demand that it is
    beyond chance, which five LEDs that are 2 mm wrong in a cross of 8 mm seldom meet.
    """
    gates = Gates(EPSILON_SEP_ARCSEC * ARCSEC_RAD, EPSILON_POS_M / (48 * INCH_M), EPSILON_MAG, 0.0)
    sky = Sky(vectors, magnitude, catalogue.vectors, catalogue.magnitude, catalogue.cells, gates)
    apart = float(2 * np.arcsin(np.linalg.norm(vectors[0] - vectors[1]) / 2))
    gate = gate_rad(gates, apart)
    begin, end = candidates(catalogue, apart - gate, apart + gate)
    star, cost, _ = matched(sky, primary_of(sky, 0, 1), catalogue.pair[begin:end])
    return star[cost.argmin()].astype(np.int64) if len(cost) else np.full(len(vectors), -1)


# The IMU.


def drifted(stay_min: float, units: int, rng: np.random.Generator) -> Floats:
    """(U, 5, 3) what IMUs off the line show at the end of each stay, less the truth: roll, pitch, yaw in degrees.

    Test 3 moved just as it was asked for, the Earth's rate felt and not taken away.
    """
    lab = simulate.furnish(scene.load("afit_test3", {"lab.x_azimuth_deg": AZIMUTH_DEG}))
    part = lab.scene.vehicle.imu
    assert part is not None
    asked = lab.scene.motion.manoeuvre[1:]  # zeroed as it leaves home
    tour = [
        one.model_copy(update={"duration_s": 60 * stay_min}) if one.kind == "hold" else one for one in asked
    ]
    reference = manoeuvre.plan(lab.scene.motion.model_copy(update={"manoeuvre": tuple(tour)}))
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
        imu.earth_rate_lab_rad_s(lab.scene.lab),
    )
    leave_s = np.array(reference.start_s[::2])  # of home, then the ends of the stays
    stops = np.searchsorted(t_s[1:], leave_s - KNOT_S)
    makes = [part.model_copy(update={"hardware_seed": int(seed)}) for seed in rng.integers(2**31, size=units)]
    return np.array([readings(imu.Unit.of(made, rng).measure(ideal), stops) - IMU_DEG for made in makes])


def readings(measured: imu.Increments, stops: Ints) -> Floats:
    """(5, 3) roll, pitch, yaw of the navigator when so many samples are in."""
    here, shown = np.array([1.0, 0.0, 0.0, 0.0]), []
    for piece in np.split(measured.angle_rad, stops)[: len(stops)]:
        here = imu.turned(here, piece, np.zeros(3), measured.step_s)
        shown.append(here)
    return angles_deg(Rotation.from_quat(shown, scalar_first=True))


# Figures.


def drawings(cause: Floats, drift: dict[float, Floats]) -> tuple[Drawing, ...]:
    return (
        Drawing(
            "Tables 10-14: the algorithm less the IMU, and where 95 % of ours are by each angle's cause.",
            lambda fig: draw_differences(fig, cause),
            (7.4, 3.5),
        ),
        Drawing(
            "How long a stay makes the IMU's errors as great on average as Table 15 has them.",
            lambda fig: draw_stays(fig, drift),
            (7.4, 3.3),
        ),
    )


def draw_differences(fig: Any, cause: Floats) -> None:
    """A panel an angle, signed."""
    at = np.arange(1, len(IMU_DEG) + 1)
    panels = fig.subplots(1, 3, sharey=True)
    heads = ("the Earth's turning", "the same; bump", "two LEDs, rolling shutter; bump")
    for axis, axes in enumerate(panels):
        low, middle, high = np.quantile(cause[:, :, axis], [0.025, 0.5, 0.975], axis=0)
        axes.errorbar(
            at + 0.1,
            middle,
            [middle - low, high - middle],
            fmt="s",
            ms=4,
            color=INK[0],
            label="ours with the cause",
        )
        axes.plot(
            at - 0.1, np.subtract(ALGORITHM_DEG, IMU_DEG)[:, axis], "o", color=INK[1], label="published"
        )
        axes.set(xlabel="position", xticks=at, title=f"theta_{axis + 1}: {heads[axis]}")
        axes.title.set_fontsize(8)
    panels[0].set(ylabel="algorithm less IMU (deg)")
    handles, labels = panels[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=2)


def draw_stays(fig: Any, drift: dict[float, Floats]) -> None:
    """The mean of the five differences of roll and of pitch by the minutes of a stay."""
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
