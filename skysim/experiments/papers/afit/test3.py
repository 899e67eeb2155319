"""AFIT's Test 3, calibration (Padro 2012, 4.4.1, Tables 6-9, Figs 74-79): five LEDs, five positions, 50 images each.

The thesis derives its identification tolerances (epsilons) from the scatter of magnitudes, positions and separations
over 250 images. We repeat this on rendered images with LED positions that are fitted to Table 8, then with likely
faults of the camera, and with the IMU errors of Tables 10-14.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from estimator.attitude.dome_map import project
from estimator.calibration.home_position import Sighting
from estimator.catalog.catalog import unit
from estimator.catalog.pair_buckets import bucket_of, bucketed
from skysim.core.types import Floats
from skysim.core.units import ARCSEC_RAD
from skysim.experiments.papers.afit.bench import vectors_m
from skysim.experiments.papers.afit.still import (
    ALGORITHM_DEG,
    IMU_DEG,
    LAB,
    Sights,
    bench,
    lab_from_body,
    measured,
    photographed,
    told,
)
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import resampled
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import Summary, exact, extreme
from skysim.results.plots import INK, MARKS
from skysim.simulation.testbed import Testbed
from skysim.tracking import onboard_model

ID = "afit-table-6-9"
BUMPED = 4
# True attitudes: the IMU's angles, but the algorithm's at the fifth position, where the IMU was bumped.
TRUE_DEG = (*IMU_DEG[:BUMPED], ALGORITHM_DEG[BUMPED])
ON_US = np.array([1000.0, 500.0, 400.0, 200.0, 1.0])
LINEAR = slice(1, 4)  # LEDs of 500, 400 and 200 us
LINES = ((0, 4), (4, 8), (8, 10))  # rows of Table 8: neighbors, diagonals, opposite ends of the cross
APART_ARCSEC = 100.0  # width of the catalog's buckets; angles closer than this count as one
NOMINAL = '[["0 mm", "0 mm", "48 in"], ["8 mm", "0 mm", "48 in"], ["0 mm", "8 mm", "48 in"], \
["-8 mm", "0 mm", "48 in"], ["0 mm", "-8 mm", "48 in"]]'
CAUSE = "a rolling shutter, 1/60 s and pixels full at 186 DN"

Statistic = Callable[[Floats], Any]


def calibration(ask: Ask) -> Found:
    """Tables 6-9: with our baseline, with likely faults of the camera as the cause, and with a bumped IMU."""
    images, few = ask.trials(50, 3), ask.trials(10, 2)
    plan = {
        "ours": ({}, images),
        "lab": (LAB, images),
        "nominal": ({"light.layout.positions": NOMINAL}, few),
        "as told": ({"light.layout.levels": "[1.0, 0.5, 0.4, 0.2, 0.001]"}, few),
    }
    fitted = {"light.layout.positions": placed(fitted_places(bench()))}
    runs = {}
    for done, (name, (changes, count)) in enumerate(plan.items()):
        ask.watch(done, len(plan))
        here = bench(fitted | changes)
        runs[name] = Run(here, every_position(here, count, np.random.default_rng([ask.seed, done])))
    ours, lab, nominal = (runs[name].sights for name in ("ours", "lab", "nominal"))
    bumped = runs["ours"].bumped(BUMPED)
    drifted = runs["ours"].bumped(*range(len(IMU_DEG)))
    answers = magnitudes(ours, lab, runs["as told"])
    answers |= separations(ours, lab, nominal)
    answers |= epsilons(ours, lab, bumped, drifted)
    answers |= buckets()
    return Found(answers, drawings(lab, bumped))


class Run(NamedTuple):
    """Images of one testbed."""

    lab: Testbed
    sightings: list[Sighting]

    @property
    def sights(self) -> Sights:
        return measured(self.lab, self.sightings)

    def bumped(self, *positions: int) -> Sights:
        """The same images, with the IMU errors of Tables 10-14 at these positions."""
        wrong = {
            n: lab_from_body((np.add(TRUE_DEG[n], IMU_DEG[n]) - ALGORITHM_DEG[n]).tolist()) for n in positions
        }
        seen = [
            told([one], wrong[one.position])[0] if one.position in wrong else one for one in self.sightings
        ]
        return measured(self.lab, seen)


def every_position(lab: Testbed, images: int, rng: np.random.Generator) -> list[Sighting]:
    """Images at each of the five positions, with a perfect IMU."""
    return [
        one
        for n, angles in enumerate(TRUE_DEG)
        for one in photographed(lab, n, lab_from_body(angles), images, rng)
    ]


def fitted_places(lab: Testbed) -> Floats:
    """(5, 3) LED positions in the board's plane for which the thesis's eqs 43-45, without noise, give Table 8.

    Least squares of eight coordinates to ten angles; the central LED is fixed. Table 8 is sorted, so its angles are
    assigned to pairs by the order of the angles from the scene's positions, which neglect the error of eq. 44.
    """
    rows = experiments()[ID].rows
    published = np.array([rows[f"separation_{n}"].published for n in range(1, 11)], dtype=float)
    place_m = lab.sources.place[:, :3].copy()
    start = seen_arcsec(lab, place_m)
    # Table 8 is in ascending order: its k-th angle belongs to the pair with the k-th smallest start angle.
    aim = np.empty(len(published))
    aim[np.argsort(start)] = published

    def off(arms_mm: Floats) -> Floats:
        place_m[1:, :2] = arms_mm.reshape(-1, 2) / 1e3
        return seen_arcsec(lab, place_m) - aim

    found = least_squares(off, place_m[1:, :2].ravel() * 1e3).x
    place_m[1:, :2] = found.reshape(-1, 2) / 1e3
    return place_m


def seen_arcsec(lab: Testbed, place_m: Floats) -> Floats:
    """(10,) angle of every pair as the thesis measures it, without noise, averaged over the vehicle's positions."""
    lever = onboard_model.believed_lever(lab.scene, lab.mount)
    camera = onboard_model.calibration(lab.scene.camera)
    seen = [project(lab_from_body(one).inv(), place_m, lever, camera) for one in TRUE_DEG]
    body_m = np.array([vectors_m(lab, xy_px) for xy_px in seen])
    nothing = np.zeros((len(body_m), len(place_m)))
    return Sights(np.arange(len(body_m)), nothing, body_m, body_m).separation_arcsec.mean(axis=0)


def placed(place_m: Floats) -> str:
    """The positions in a scene's YAML syntax."""
    told = [f'["{x * 1e3:.4f} mm", "{y * 1e3:.4f} mm", "48 in"]' for x, y, _ in place_m]
    return f"[{', '.join(told)}]"


# Statistics of the images, with intervals over the images.


def of_images(sights: Sights, values: Floats, statistic: Statistic) -> Summary:
    """A statistic of (F, ...) values of the images, with a bootstrap interval stratified by position.

    Images are resampled within each position only, because the differences between positions are systematic.
    statistic : of (..., F, K) values to (...), over the last two axes
    """
    position, rows = sights.position, np.arange(len(values))
    first = np.searchsorted(position, position)
    count = np.bincount(position)[position]
    table = values.reshape(len(values), -1)

    def drawn(index: Floats, axis: int = -1) -> Any:
        same = np.array_equal(index, rows)
        # A resampled index becomes an image of the position of the image that it replaces (stratified bootstrap).
        chosen = index if same else first + index % count
        return statistic(table[chosen.astype(int)])

    return resampled(rows.astype(float), drawn)


def mean(values: Floats) -> Any:
    return values.mean(axis=(-2, -1))


def spread(values: Floats) -> Any:
    """Largest standard deviation of the columns over all images. It includes the systematic differences between
    positions, so the sum is divided by n and not by n - 1."""
    return values.std(axis=-2).max(axis=-1)


def within(sights: Sights) -> float:
    """Standard deviation of a pair's angle within a position, averaged over positions; the largest over pairs."""
    angle = sights.separation_arcsec
    at_one = [angle[sights.position == n].std(axis=0, ddof=1) for n in np.unique(sights.position)]
    return float(np.mean(at_one, axis=0).max())


def slope(values: Floats) -> Any:
    """Least-squares slope of the mean magnitude against the on-time in microseconds."""
    lit = ON_US[LINEAR] - ON_US[LINEAR].mean()
    return values.mean(axis=-2) @ lit / (lit @ lit)


def magnitudes(ours: Sights, lab: Sights, as_told: Run) -> dict[str, Answer]:
    """Table 7: means and standard deviations of the magnitudes."""
    answers = {}
    for n in range(len(ON_US)):
        told = [of_images(one, one.magnitude[:, [n]], mean) for one in (ours, lab)]
        answers[f"magnitude_{n + 1}"] = Answer(told[0], cause=Cause(CAUSE, told[1]))
        told = [of_images(one, one.magnitude[:, [n]], spread) for one in (ours, lab)]
        answers[f"magnitude_sd_{n + 1}"] = Answer(told[0], cause=Cause(CAUSE, told[1]))
    # Only images with five LEDs are kept, so every one of `as_told` shows the LED of 1 us.
    found = exact(as_told.sights.magnitude[:, -1].mean() if as_told.sightings else 0.0)
    answers["magnitude_5"] = Answer(
        found, cause=Cause("75 us of light (fitted)", answers["magnitude_5"].ours)
    )
    answers["slope"] = Answer(of_images(ours, ours.magnitude[:, LINEAR], slope))
    means = ours.magnitude.mean(axis=0)
    answers["order"] = Answer(exact(1 + np.sum(np.diff(means) < 0)))
    return answers


def separations(ours: Sights, lab: Sights, nominal: Sights) -> dict[str, Answer]:
    """Table 8: separations of the pairs in ascending order."""
    order = np.argsort(ours.separation_arcsec.mean(axis=0))
    angle, rolled = ours.separation_arcsec[:, order], lab.separation_arcsec[:, order]
    answers = {}
    for n in range(len(order)):
        answers[f"separation_{n + 1}"] = Answer(of_images(ours, angle[:, [n]], mean))
        told = [of_images(ours, angle[:, [n]], spread), of_images(lab, rolled[:, [n]], spread)]
        answers[f"separation_sd_{n + 1}"] = Answer(told[0], cause=Cause(CAUSE, told[1]))
    alike = np.sort(nominal.separation_arcsec, axis=1)
    for n, (first, last) in enumerate(LINES, 1):
        answers[f"class_{n}"] = Answer(of_images(nominal, alike[:, first:last], mean))
    apart = np.diff(angle.mean(axis=0)) > APART_ARCSEC
    answers["classes"] = Answer(exact(1 + np.sum(apart)))
    return answers


def epsilons(ours: Sights, lab: Sights, bumped: Sights, drifted: Sights) -> dict[str, Answer]:
    """Table 9 and Figs 77-79: the largest pooled standard deviations; positions in millimeters."""
    position = {
        name: of_images(one, one.lab_m.reshape(len(one.lab_m), -1) * 1e3, spread)
        for name, one in (("ours", ours), ("bumped", bumped), ("drifted", drifted))
    }
    column = np.sort(bumped.lab_m[bumped.position == BUMPED, :, 0].mean(axis=0) * 1e3)
    return {
        "epsilon_mag": Answer(
            of_images(ours, ours.magnitude, spread), cause=Cause(CAUSE, of_images(lab, lab.magnitude, spread))
        ),
        "epsilon_pos": Answer(
            position["ours"],
            f"with all differences of Tables 10-14 taken for the IMU's: {position['drifted'].value:.2f}",
            Cause("position 5 bumped", position["bumped"]),
        ),
        "epsilon_sep": Answer(
            of_images(ours, ours.separation_arcsec, spread),
            f"of a pair at one position {within(ours):.2g}; the rest is eq. 44's slip between positions",
            Cause(CAUSE, of_images(lab, lab.separation_arcsec, spread)),
        ),
        "columns": Answer(extreme(column, lambda x: (x[-1] - x[0]) / 2)),
        "height": Answer(extreme(ours.lab_m[:, :, 2].ravel() * 1e3, np.ptp)),
    }


def buckets() -> dict[str, Answer]:
    """Section 2.4.6: length of the example's bucket table, percentage searched outside the gate, and eq. 12."""
    low, high = np.radians([1.5, 8.0])
    width, gate = 5 * ARCSEC_RAD, 20 * ARCSEC_RAD
    stars = unit(np.random.default_rng(0).standard_normal((500, 3)))
    entries = len(bucketed(stars, np.zeros(len(stars)), width, (low, high)).table) - 1
    # Average over the phase of a pair's angle within a bucket.
    angle = (low + high) / 2 + width * (np.arange(1000) + 0.5) / 1000
    first, last = (bucket_of(angle + end, high, width, entries) for end in (-gate, gate))
    looked_at = (last - first + 1).mean() * width
    # Eq. 12: a pair 1.7 buckets below the end, a gate of 0.6.
    ends = bucket_of(high - np.array([1.7 + 0.6, 1.7 - 0.6]) * width, high, width, entries)
    return {
        "buckets": Answer(exact(entries)),
        "extra": Answer(exact(100 * (looked_at / (2 * gate) - 1))),
        "example_low": Answer(exact(entries - ends[0])),
        "example_high": Answer(exact(entries - ends[1] - 1)),
    }


# Figures.


def published(key: str) -> Floats:
    """Published values of the rows key_1, key_2, ... of Tables 7 and 8."""
    rows = experiments()[ID].rows
    told = [row.published for name, row in rows.items() if name.rpartition("_")[0] == key]
    return np.array(told, dtype=float)


def drawings(lab: Sights, bumped: Sights) -> tuple[Drawing, ...]:
    cause = f"ours with {CAUSE}"
    return (
        Drawing(f"Figs 74 and 75: magnitudes of 250 images, {cause}.", lambda fig: draw_magnitudes(fig, lab)),
        Drawing(f"Fig. 76: angles of all pairs, {cause}.", lambda fig: draw_separations(fig, lab)),
        Drawing(
            "Figs 77 and 79: where the five LEDs come back to, the IMU right but at the bumped position 5.",
            lambda fig: draw_scatter(fig, bumped),
            (6.4, 3.9),
        ),
    )


def draw_magnitudes(fig: Any, lab: Sights) -> None:
    """A histogram for each LED, with Table 7's mean and deviation above."""
    axes = fig.subplots()
    edges = np.arange(0, 171, 2.0)
    heights = [axes.hist(one, edges, color=INK[0], alpha=0.75)[0].max() for one in lab.magnitude.T]
    axes.patches[0].set_label("ours")
    axes.errorbar(
        published("magnitude"),
        np.full(len(ON_US), 1.08 * max(heights)),
        xerr=published("magnitude_sd"),
        fmt="o",
        color=INK[1],
        label="published, with 1 sd",
    )
    axes.set(xlabel="instrument magnitude", ylabel="images", ylim=(0, 1.3 * max(heights)))
    axes.legend(loc="upper right", ncols=2)


def draw_separations(fig: Any, lab: Sights) -> None:
    """The three groups of angles side by side, and Table 8's means and deviations."""
    angle = np.sort(lab.separation_arcsec, axis=1)
    panels = fig.subplots(1, len(LINES), sharey=True)
    for axes, (first, last) in zip(panels, LINES, strict=True):
        one = angle[:, first:last].ravel()
        middle = published("separation")[first:last].mean()
        axes.hist(one, np.arange(middle - 60, middle + 61, 4.0), color=INK[0], alpha=0.75, label="ours")
        axes.set(xlabel="angle (arcsec)")
    top = max(axes.get_ylim()[1] for axes in panels)
    for axes, (first, last) in zip(panels, LINES, strict=True):
        axes.errorbar(
            published("separation")[first:last],
            top * (1.05 + 0.06 * np.arange(last - first)),
            xerr=published("separation_sd")[first:last],
            fmt="o",
            color=INK[1],
            label="published, with 1 sd",
        )
        axes.set(ylim=(0, 1.4 * top))
    panels[0].set(ylabel="pairs in images")
    panels[-1].legend(loc="upper right", fontsize=8)


def draw_scatter(fig: Any, bumped: Sights) -> None:
    """X and Y of every LED in the lab frame, one marker per position, the mean in black, and Table 9's deviation."""
    axes = fig.subplots()
    place_mm = bumped.lab_m * 1e3
    for n in range(len(IMU_DEG)):
        x, y = place_mm[bumped.position == n].mean(axis=0)[:, :2].T
        axes.plot(x, y, MARKS[n], color=INK[n], ls="", label=f"position {n + 1}", alpha=0.8)
    x, y = place_mm.mean(axis=0)[:, :2].T
    axes.plot(x, y, "+", color="black", ms=9, ls="", label="mean")
    epsilon_mm = experiments()[ID].rows["epsilon_pos"].published
    axes.errorbar(x, y - 0.5, xerr=epsilon_mm, fmt="none", color=INK[1], label="published eps_position")
    axes.set(xlabel="X (mm)", ylabel="Y (mm)", aspect="equal")
    fig.legend(loc="outside right upper")
