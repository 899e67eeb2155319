"""AFIT's Test 2: one pair of LEDs at three places of the dome (Padro 2012, sections 3.5.3, 3.7.2 and 4.3).

The pair's separation should be the same at every place; the thesis finds a smaller one towards the edge. Causes that
are simulated: camera noise, a board that is not parallel to the dome, a dome off its center, and glare of the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import project
from skysim.core.types import Floats
from skysim.core.units import INCH_M
from skysim.experiments.papers.afit.bench import (
    GREY_E,
    changed,
    furnished,
    grey,
    measured,
    separations_arcsec,
    shot,
)
from skysim.experiments.papers.afit.surface import contour
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import mean_of, resampled
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import Summary, exact
from skysim.results.plots import INK, MARKS
from skysim.scene.camera import MoffatPsfConfig
from skysim.scene.light import DomeConfig
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.simulation.testbed import Testbed
from skysim.sources.dome.surface import Surface, build_surface
from skysim.tracking import onboard_model

PLACES_DEG = (0.0, 14.0, 28.0)  # tilts of the scene's places: apex, halfway, edge within the tilt stop
HALF_WAY_DEG, LEAN_DEG, LEAN_TOO_DEG, DECENTRE_IN = 23.6, 5.5, 4.0, 0.125
PAIR_M = 16.119e-3  # gives Table 5's 2727" at the apex; 16 mm gives 2706.9"
EXPOSURE_S, INTENSITY_CD, ON_SHARE, NOISE_E = 0.1, 2.85e-3, 0.0594, 700.0
BRIGHT, DIM = 0, 1
NOISY = f"noise of {NOISE_E / GREY_E:.1f} grey levels"


class Place(NamedTuple):
    """Place of the board: tilt from the vertical at the bearing, lean off the dome's surface, dome offset in x."""

    tilt_deg: float
    lean_deg: float = 0.0
    decentre_in: float = 0.0


class Series(NamedTuple):
    """Measurements of n images of a place: (n, 2) magnitudes of the bright and the dim LED, (n,) their angle."""

    magnitude: Floats
    angle_arcsec: Floats


def scene(dim_share: float) -> Scene:
    """The scene with intensities that give Table 3's bright LED; the dim LED is on for a fraction of its slot."""
    told = changed(load("afit_test2"), "exposure", time_s=EXPOSURE_S)
    told = changed(told, "light.layout", levels=(1.0, dim_share) * len(PLACES_DEG))
    return changed(told, "light.led", intensity_cd=INTENSITY_CD, scatter=0.0)


def noisy() -> Scene:
    """The same scene with the read noise that gives Table 5's standard deviations."""
    return changed(scene(ON_SHARE), "camera.detector", read_noise_e=NOISE_E)


def dome_of(told: Scene, decentre_in: float = 0.0) -> Surface:
    """The measured dome, displaced along x."""
    assert isinstance(told.light, DomeConfig)
    return build_surface(told.light.surface.model_copy(update={"offset_m": (decentre_in * INCH_M, 0.0, 0.0)}))


def glued(lab: Testbed, place: Place) -> Testbed:
    """The pair on a board tangent to the dome, or leaning off it, with its LEDs along the meridian."""
    inside, tilt = dome_of(lab.scene, place.decentre_in), np.radians(place.tilt_deg)
    middle_m = inside.meet(np.zeros(3), np.array([[np.sin(tilt), 0.0, np.cos(tilt)]]))[0]
    lean = Rotation.from_euler("y", place.lean_deg, degrees=True)
    normal = lean.apply(inside.inward(middle_m[None])[0])
    along = np.cross(normal, [0.0, 1.0, 0.0])
    spots_m = middle_m + np.outer([-PAIR_M / 2, PAIR_M / 2], along / np.linalg.norm(along))
    pair = lab.sources.take(np.arange(2))
    return replace(
        lab,
        sources=replace(pair, place=np.column_stack([spots_m, np.ones(2)]), normal=np.tile(normal, (2, 1))),
    )


def towards(place: Place) -> Rotation:
    """lab_from_body that points the boresight at the board."""
    return Rotation.from_euler("y", place.tilt_deg, degrees=True)


def series(lab: Testbed, place: Place, count: int, rng: np.random.Generator) -> Series:
    """Measure images of a place; those that do not show two lights are left out."""
    board, attitude = glued(lab, place), towards(place)
    magnitudes, angles = [], []
    for _ in range(count):
        lights = measured(grey(shot(board, attitude, rng)[0], board))
        if len(lights.magnitude) == 2:
            magnitudes.append(lights.magnitude)
            angles.append(separations_arcsec(lights.xy_px, board)[0])
    return Series(np.array(magnitudes), np.array(angles))


def dome(ask: Ask) -> Found:
    """Tables 3 to 5 and the dome's contour: with the camera's own noise, and with more noise as the cause."""
    count, quiet, faint = ask.trials(50, 10), furnished(scene(ON_SHARE)), furnished(noisy())
    rng = [np.random.default_rng([ask.seed, stage]) for stage in range(3)]
    own, wild = [], []
    for n, tilt_deg in enumerate(PLACES_DEG):
        ask.watch(n, 4)
        own.append(series(quiet, Place(tilt_deg), count, rng[0]))
        wild.append(series(faint, Place(tilt_deg), count, rng[1]))
    answers = magnitudes(own, wild, count) | spreads(own, wild)
    ask.watch(3, 4)
    answers |= angles(quiet, own, wild, ask.trials(12, 2), rng[2]) | contour(dome_of(load("afit_test2")))
    return Found(answers, drawings(quiet, own, wild))


def magnitudes(own: Sequence[Series], wild: Sequence[Series], count: int) -> dict[str, Answer]:
    """Table 3, and the relative change of the bright LED's magnitude from the first place to the last."""
    answers: dict[str, Answer] = {}
    seen = [f"{len(one.magnitude)} and {len(two.magnitude)}" for one, two in zip(own, wild, strict=True)]
    for led, name in enumerate(("bright", "dim")):
        ours, cause = ([mean_of(one.magnitude[:, led]) for one in runs] for runs in (own, wild))
        for n, pair in enumerate(zip(ours, cause, strict=True)):
            told = f"the pair is seen in {seen[n]} of {count} images"
            answers[f"{name}_{n + 1}"] = Answer(pair[0], told, Cause(NOISY, pair[1]))
        answers[f"{name}_avg"] = Answer(averaged(ours), cause=Cause(NOISY, averaged(cause)))
        if led == BRIGHT:
            answers["gain"] = Answer(gained(ours), cause=Cause(NOISY, gained(cause)))
    return answers


def gained(places: Sequence[Summary]) -> Summary:
    """Increase of the mean from the first place to the last in percent; independent errors add in quadrature."""
    first, last = places[0], places[-1]
    value = 100 * (last.value / first.value - 1)
    half = 100 * float(np.hypot(last.high - last.value, first.high - first.value)) / first.value
    return Summary(value, value - half, value + half, first.trials + last.trials)


def averaged(places: Sequence[Summary]) -> Summary:
    """Mean of the places' means; independent errors add in quadrature."""
    value = float(np.mean([one.value for one in places]))
    half = float(np.sqrt(sum((one.high - one.value) ** 2 for one in places)) / len(places))
    return Summary(value, value - half, value + half, sum(one.trials for one in places))


def spreads(own: Sequence[Series], wild: Sequence[Series]) -> dict[str, Answer]:
    """Table 4, and the standard deviations of Table 5."""
    answers: dict[str, Answer] = {}
    for led, name in enumerate(("bright", "dim")):
        columns = [[one.magnitude[:, led] for one in runs] for runs in (own, wild)]
        answers |= {f"sd_{name}_{n}": spread(*pair) for n, pair in enumerate(zip(*columns, strict=True), 1)}
        answers[f"sd_{name}_all"] = spread(*(np.concatenate(column) for column in columns))
    pairs = enumerate(zip(own, wild, strict=True), 1)
    return answers | {f"sd_angle_{n}": spread(one.angle_arcsec, two.angle_arcsec) for n, (one, two) in pairs}


def spread(own: Floats, wild: Floats) -> Answer:
    """Standard deviation with the camera's own noise, and with more noise as the cause."""
    return Answer(deviation(own), cause=Cause(NOISY, deviation(wild)))


def deviation(values: Floats) -> Summary:
    """Standard deviation (n - 1) with its bootstrap interval."""
    return resampled(values, lambda x, axis=-1: np.std(x, ddof=1, axis=axis))


def angles(
    lab: Testbed, own: Sequence[Series], wild: Sequence[Series], count: int, rng: np.random.Generator
) -> dict[str, Answer]:
    """Table 5's means, with the effect of each cause on the last two."""
    edge = PLACES_DEG[2]
    half_way, decentred, leaning, both, more = (
        mean_of(series(lab, place, count, rng).angle_arcsec)
        for place in (
            Place(HALF_WAY_DEG),
            Place(edge, 0.0, DECENTRE_IN),
            Place(edge, LEAN_DEG),
            Place(edge, LEAN_TOO_DEG, DECENTRE_IN),
            Place(edge, LEAN_DEG, DECENTRE_IN),
        )
    )
    glaring = glare(lab, count, rng)
    faint = [
        float(two.angle_arcsec.mean() - one.angle_arcsec.mean()) for one, two in zip(own, wild, strict=True)
    ]
    means = [mean_of(one.angle_arcsec) for one in own]
    others = (
        f'the dome {DECENTRE_IN} in off centre alone: {decentred.value:.1f}"; with that, leaning {LEAN_TOO_DEG:g} deg:'
        f' {both.value:.1f}", leaning {LEAN_DEG:g} deg: {more.value:.1f}"; centroid bias of the dim LED, in the noise:'
        f' {faint[2] - faint[0]:+.1f}" from apex to edge, by glare of a lens with wide wings: {glaring:+.1f}"'
    )
    leans = f"a board that leans {LEAN_DEG:g} deg"
    fall = [fallen(one, means[0].value) for one in (means[2], leaning)]
    least = min(geometric(lab, Place(float(tilt_deg))) for tilt_deg in np.linspace(20, 34, 29))
    return {
        "angle_1": Answer(means[0]),
        "angle_2": Answer(means[1], cause=Cause(f"the board at {HALF_WAY_DEG} deg", half_way)),
        "angle_3": Answer(means[2], others, Cause(leans, leaning)),
        "fall": Answer(fall[0], cause=Cause(leans, fall[1])),
        "least": Answer(exact(least)),
    }


def fallen(angle: Summary, before: float) -> Summary:
    """Decrease of an angle relative to `before` in percent; the error of `before` is neglected."""
    value, high, low = (100 * (1 - one / before) for one in (angle.value, angle.low, angle.high))
    return Summary(value, low, high, angle.trials)


def glare(lab: Testbed, count: int, rng: np.random.Generator) -> float:
    """Change of the angle from apex to edge in arcsec, beyond geometry, due to a PSF with wide wings.

    The wings add light of one LED below the other, which biases the centroids.
    """
    wide = furnished(
        changed(scene(2 * ON_SHARE), "camera", psf=MoffatPsfConfig(kind="moffat", fwhm_px=2.5, beta=1.5))
    )
    edge, apex = Place(PLACES_DEG[2]), Place(0.0)
    there, here = (series(wide, place, count, rng).angle_arcsec.mean() for place in (edge, apex))
    return float(there - here - geometric(lab, edge) + geometric(lab, apex))


def geometric(lab: Testbed, place: Place) -> float:
    """The pair's angle by eqs 43-45 from its LEDs' projected positions, without rendering."""
    lever, camera = (
        onboard_model.believed_lever(lab.scene, lab.mount),
        onboard_model.believed_camera(lab.scene),
    )
    xy_px = project(towards(place).inv(), glued(lab, place).sources.place[:, :3], lever, camera)
    return float(separations_arcsec(xy_px, lab)[0])


def drawings(lab: Testbed, own: Sequence[Series], wild: Sequence[Series]) -> tuple[Drawing, ...]:
    return (
        Drawing(
            f"Figs 69 and 70: magnitudes of the two LEDs at three places, ours with {NOISY}; published as mean and"
            " standard deviation.",
            lambda fig: draw_magnitudes(fig, wild),
        ),
        Drawing(
            "Fig. 71 and Table 5: the pair's angle over the tilt of its board; the published bars are standard"
            " deviations, their tilts 0 deg, as fitted and as assumed.",
            lambda fig: draw_angles(fig, lab, own),
        ),
    )


def draw_magnitudes(fig: Any, wild: Sequence[Series]) -> None:
    """Histograms of our magnitudes, with the published means and deviations."""
    rows = experiments()["afit-table-3-5"].rows
    both = fig.subplots(1, 2)
    for column, name, axes in zip((DIM, BRIGHT), ("dim", "bright"), both, strict=True):
        everything = np.concatenate([one.magnitude[:, column] for one in wild])
        bins = np.linspace(everything.min(), everything.max(), 25)
        top = 1.0
        for n, one in enumerate(wild):
            counts, _, _ = axes.hist(
                one.magnitude[:, column],
                bins,
                histtype="step",
                color=INK[(0, 2, 4)[n]],
                label=f"ours, place {n + 1}",
            )
            top = max(top, counts.max())
        for n in range(3):
            mean, sd = rows[f"{name}_{n + 1}"].published, rows[f"sd_{name}_{n + 1}"].published
            axes.errorbar(
                mean,
                top * (1.1 + 0.1 * n),
                xerr=sd,
                color=INK[1],
                marker=MARKS[n],
                label=f"published, {n + 1}",
            )
        axes.set(xlabel=f"magnitude of the {name} LED", ylabel="images", ylim=(0, top * 1.4))
    fig.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8)


def draw_angles(fig: Any, lab: Testbed, own: Sequence[Series]) -> None:
    """Angles against the tilt: geometric curves, ours from images, and the published ones."""
    rows, axes = experiments()["afit-table-3-5"].rows, fig.subplots()
    tilt_deg = np.linspace(0, 32, 33)
    curves = (
        ("measured dome", Place(0)),
        (f"{DECENTRE_IN} in off centre", Place(0, 0, DECENTRE_IN)),
        (f"leaning {LEAN_DEG:g} deg", Place(0, LEAN_DEG)),
    )
    for ink, style, (name, place) in zip((INK[0], INK[2], INK[4]), ("-", "--", "-."), curves, strict=True):
        axes.plot(
            tilt_deg,
            [geometric(lab, place._replace(tilt_deg=float(tilt))) for tilt in tilt_deg],
            style,
            color=ink,
            label=name,
        )
    axes.plot(
        PLACES_DEG, [one.angle_arcsec.mean() for one in own], "s", color=INK[0], label="ours, from images"
    )
    told = [(rows[f"angle_{n}"].published, rows[f"sd_angle_{n}"].published) for n in (1, 2, 3)]
    axes.errorbar(
        (0, HALF_WAY_DEG, PLACES_DEG[2]),
        [mean for mean, _ in told],
        [sd for _, sd in told],
        fmt="o",
        capsize=3,
        color=INK[1],
        label="published",
    )
    axes.set(xlabel="tilt of the board (deg)", ylabel="angle of the pair (arcsec)")
    axes.legend()
