"""AFIT's Test 2: one pair of LEDs at three positions on the dome (Padro 2012, sections 3.5.3, 3.7.2 and 4.3).

The pair's separation should be the same at every place; the thesis finds a smaller one towards the edge. Causes that
are simulated: camera noise, a board that is not parallel to the dome, a dome off its center, and glare of the lens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import project
from skysim.core.constants import INCH_M
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.papers.afit.afit_surface import contour
from skysim.experiments.papers.afit.test_stand import (
    E_PER_GRAY,
    build_test_stand,
    measure_frame,
    separations_arcsec,
)
from skysim.experiments.papers.compare import (
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    bootstrap_interval,
    confidence_interval,
    sample_std,
    symmetric_interval,
    with_cause,
)
from skysim.experiments.papers.published import experiments
from skysim.experiments.tracker_comparison import with_config
from skysim.results.metrics import Summary, exact
from skysim.results.plots import INK, MARKS
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import MoffatPsfConfig
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.lab import Lab
from skysim.sources.dome.surface import Surface, build_surface
from skysim.tracking import onboard_model

# Tilts of the scene's places: apex, halfway, edge within the tilt stop.
PLACES_DEG = (0.0, 14.0, 28.0)
HALFWAY_DEG = 23.6
BOARD_TILT_DEG = 5.5
SMALLER_BOARD_TILT_DEG = 4.0
DECENTER_IN = 0.125
PAIR_M = 16.119e-3  # gives Table 5's 2727" at the apex; 16 mm gives 2706.9"
EXPOSURE_S = 0.1
INTENSITY_CD = 2.85e-3
ON_FRACTION = 0.0594
NOISE_E = 700.0
BRIGHT = 0
DIM = 1
CAUSE_NOISE = f"noise of {NOISE_E / E_PER_GRAY:.1f} gray levels"


class BoardPlace(NamedTuple):
    """Place of the board: tilt from the vertical at the bearing, tilt off the tangent plane, dome offset in x."""

    tilt_deg: float
    board_tilt_deg: float = 0.0
    decenter_in: float = 0.0


class PlaceSeries(NamedTuple):
    """Measurements of n images of a place: (n, 2) magnitudes of the bright and the dim LED, (n,) their angle."""

    magnitude: Floats
    angle_arcsec: Floats


class NoiseRuns(NamedTuple):
    """Series of all places, with the camera's own noise and with more noise as the cause."""

    own: list[PlaceSeries]
    more: list[PlaceSeries]


def scene(dim_fraction: float) -> Scene:
    """The scene with intensities that give Table 3's bright LED; the dim LED is on for a fraction of its slot."""
    scene = with_config(load("afit_test2_ideal"), "exposure", time_s=EXPOSURE_S)
    scene = with_config(scene, "light.layout", levels=(1.0, dim_fraction) * len(PLACES_DEG))
    return with_config(scene, "light.led", intensity_cd=INTENSITY_CD, scatter=0.0)


def measured_dome(scene: Scene, decenter_in: float = 0.0) -> Surface:
    """The measured dome, displaced along x."""
    assert isinstance(scene.light, DomeConfig)
    return build_surface(
        scene.light.surface.model_copy(update={"offset_m": (decenter_in * INCH_M, 0.0, 0.0)})
    )


def place_pair(lab: Lab, place: BoardPlace) -> Lab:
    """The pair on a board tangent to the dome, or tilted from it, with its LEDs along the meridian."""
    dome = measured_dome(lab.scene, place.decenter_in)
    tilt = np.radians(place.tilt_deg)
    center_m = dome.meet(np.zeros(3), np.array([[np.sin(tilt), 0.0, np.cos(tilt)]]))[0]
    board_tilt = Rotation.from_euler("y", place.board_tilt_deg, degrees=True)
    normal = board_tilt.apply(dome.inward(center_m[None])[0])
    meridian = np.cross(normal, [0.0, 1.0, 0.0])
    positions_m = center_m + np.outer(
        [-PAIR_M / 2, PAIR_M / 2], meridian / np.linalg.norm(meridian)
    )
    pair = lab.camera.sources.take(np.arange(2))
    homogeneous = np.column_stack([positions_m, np.ones(2)])
    return lab.with_sources(replace(pair, place=homogeneous, normal=np.tile(normal, (2, 1))))


def point_at(place: BoardPlace) -> Rotation:
    """lab_from_body that points the boresight at the board."""
    return Rotation.from_euler("y", place.tilt_deg, degrees=True)


def series(lab: Lab, place: BoardPlace, images: int, rng: np.random.Generator) -> PlaceSeries:
    """Measure images of a place; those that do not show two lights are left out."""
    lab_at_place = place_pair(lab, place)
    attitude = point_at(place)
    magnitudes = []
    angles = []
    for _ in range(images):
        lights = measure_frame(lab_at_place, attitude, rng)
        if len(lights.magnitude) == 2:
            magnitudes.append(lights.magnitude)
            angles.append(separations_arcsec(lights.xy_px, lab_at_place)[0])
    return PlaceSeries(np.array(magnitudes), np.array(angles))


def tables_3_to_5(options: ExperimentOptions) -> ExperimentResult:
    """Tables 3 to 5 and the dome's contour: with the camera's own noise, and with more noise as the cause."""
    images = options.trials(50, 10)
    quiet_stand = build_test_stand(scene(ON_FRACTION))
    # The read noise that gives Table 5's standard deviations.
    noisy_stand = build_test_stand(
        with_config(scene(ON_FRACTION), "camera.detector", read_noise_e=NOISE_E)
    )
    rng = [random_stream(options.seed, stage) for stage in range(3)]
    runs = NoiseRuns([], [])
    for n, tilt_deg in enumerate(PLACES_DEG):
        options.watch(n, 4)
        runs.own.append(series(quiet_stand, BoardPlace(tilt_deg), images, rng[0]))
        runs.more.append(series(noisy_stand, BoardPlace(tilt_deg), images, rng[1]))
    results = magnitudes(runs, images) | standard_deviations(runs)
    options.watch(3, 4)
    results |= angles(quiet_stand, runs, options.trials(12, 2), rng[2])
    results |= contour(measured_dome(load("afit_test2_ideal")))
    drawings = (
        FigureDrawing(
            f"Figs 69 and 70: magnitudes of the two LEDs at three positions, ours with {CAUSE_NOISE}; published as"
            " mean and standard deviation.",
            lambda fig: draw_magnitudes(fig, runs.more),
        ),
        FigureDrawing(
            "Fig. 71 and Table 5: the pair's angle over the tilt of its board; the published bars are standard"
            " deviations, their tilts 0 deg, as fitted and as assumed.",
            lambda fig: draw_angles(fig, quiet_stand, runs.own),
        ),
    )
    return ExperimentResult(results, drawings)


def magnitudes(runs: NoiseRuns, images: int) -> Results:
    """Table 3, and the relative change of the bright LED's magnitude from the first place to the last."""
    results: Results = {}
    for led, name in enumerate(("bright", "dim")):
        ours, theirs = ([one.magnitude[:, led] for one in places] for places in runs)
        for n, (own, more) in enumerate(zip(ours, theirs, strict=True), 1):
            note = f"the pair is detected in {len(own)} and {len(more)} of {images} images"
            results[f"{name}_{n}"] = with_cause(
                CAUSE_NOISE, confidence_interval, own, more, note=note
            )
        results[f"{name}_avg"] = with_cause(CAUSE_NOISE, mean_of_places, ours, theirs)
        if led == BRIGHT:
            results["gain"] = with_cause(CAUSE_NOISE, relative_gain, ours, theirs)
    return results


def relative_gain(places: Sequence[Floats]) -> Summary:
    """Increase of the mean from the first place to the last in percent; independent errors add in quadrature."""
    first = confidence_interval(places[0])
    last = confidence_interval(places[-1])
    value = 100 * (last.value / first.value - 1)
    half = 100 * math.hypot(last.high - last.value, first.high - first.value) / first.value
    return symmetric_interval(value, half, first.trials + last.trials)


def mean_of_places(places: Sequence[Floats]) -> Summary:
    """Mean of the places' means; independent errors add in quadrature."""
    means = [confidence_interval(values) for values in places]
    value = sum(mean.value for mean in means) / len(means)
    half = math.hypot(*(mean.high - mean.value for mean in means)) / len(means)
    return symmetric_interval(value, half, sum(mean.trials for mean in means))


def standard_deviations(runs: NoiseRuns) -> Results:
    """Table 4, and the standard deviations of Table 5."""
    results: Results = {}
    std_interval = partial(bootstrap_interval, statistic=sample_std)
    for led, name in enumerate(("bright", "dim")):
        every = (np.concatenate([one.magnitude for one in places])[:, led] for places in runs)
        results[f"sd_{name}_all"] = with_cause(CAUSE_NOISE, std_interval, *every)
    for n, (own, more) in enumerate(zip(*runs, strict=True), 1):
        columns = {
            f"sd_bright_{n}": (own.magnitude[:, BRIGHT], more.magnitude[:, BRIGHT]),
            f"sd_dim_{n}": (own.magnitude[:, DIM], more.magnitude[:, DIM]),
            f"sd_angle_{n}": (own.angle_arcsec, more.angle_arcsec),
        }
        for key, pair in columns.items():
            results[key] = with_cause(CAUSE_NOISE, std_interval, *pair)
    return results


def angles(lab: Lab, runs: NoiseRuns, images: int, rng: np.random.Generator) -> Results:
    """Table 5's means, with the effect of each cause on the last two."""

    def angles_at(*place: float) -> Floats:
        return series(lab, BoardPlace(*place), images, rng).angle_arcsec

    edge = PLACES_DEG[2]
    halfway = angles_at(HALFWAY_DEG)
    decentered = angles_at(edge, 0.0, DECENTER_IN)
    tilted = angles_at(edge, BOARD_TILT_DEG)
    tilted_decentered = angles_at(edge, SMALLER_BOARD_TILT_DEG, DECENTER_IN)
    more_tilted_decentered = angles_at(edge, BOARD_TILT_DEG, DECENTER_IN)
    glare_arcsec = glare_bias_arcsec(lab, images, rng)
    apex_bias, _, edge_bias = (
        more.angle_arcsec.mean() - own.angle_arcsec.mean()
        for own, more in zip(*runs, strict=True)
    )
    at_apex, at_halfway, at_edge = (own.angle_arcsec for own in runs.own)
    note = (
        f'the dome {DECENTER_IN} in off center alone: {decentered.mean():.1f}"; with that, tilted by'
        f' {SMALLER_BOARD_TILT_DEG:g} deg: {tilted_decentered.mean():.1f}", tilted by {BOARD_TILT_DEG:g} deg:'
        f' {more_tilted_decentered.mean():.1f}"; centroid bias of the dim LED, in the noise:'
        f' {edge_bias - apex_bias:+.1f}" from apex to edge, by glare of a lens with wide'
        f' wings: {glare_arcsec:+.1f}"'
    )
    cause = f"a board tilted by {BOARD_TILT_DEG:g} deg"
    smallest = min(
        geometric_angle_arcsec(lab, BoardPlace(float(tilt)))
        for tilt in np.linspace(20, 34, 29)
    )
    return {
        "angle_1": confidence_interval(at_apex),
        "angle_2": with_cause(
            f"the board at {HALFWAY_DEG} deg", confidence_interval, at_halfway, halfway
        ),
        "angle_3": with_cause(cause, confidence_interval, at_edge, tilted, note=note),
        "fall": with_cause(
            cause, partial(relative_decrease, float(at_apex.mean())), at_edge, tilted
        ),
        "least": exact(smallest),
    }


def relative_decrease(reference: float, angles: Floats) -> Summary:
    """Decrease of a mean angle relative to `reference` in percent; the error of `reference` is neglected."""
    mean = confidence_interval(angles)
    value, high, low = (
        100 * (1 - one / reference) for one in (mean.value, mean.low, mean.high)
    )
    return Summary(value, low, high, mean.trials)


def glare_bias_arcsec(lab: Lab, images: int, rng: np.random.Generator) -> float:
    """Change of the angle from apex to edge in arcsec, beyond geometry, due to a PSF with wide wings.

    The wings add light of one LED below the other, which biases the centroids.
    """
    psf = MoffatPsfConfig(kind="moffat", fwhm_px=2.5, beta=1.5)
    stand = build_test_stand(with_config(scene(2 * ON_FRACTION), "camera", psf=psf))
    at_edge, at_apex = (
        series(stand, place, images, rng).angle_arcsec.mean()
        - geometric_angle_arcsec(lab, place)
        for place in (BoardPlace(PLACES_DEG[2]), BoardPlace(0.0))
    )
    return float(at_edge - at_apex)


def geometric_angle_arcsec(lab: Lab, place: BoardPlace) -> float:
    """The pair's angle by eqs 43-45 from its LEDs' projected positions, without rendering."""
    lever = onboard_model.assumed_lever(lab.scene, lab.camera.mount)
    camera = onboard_model.assumed_camera(lab.scene)
    xy_px = project(
        point_at(place).inv(),
        place_pair(lab, place).camera.sources.place[:, :3],
        lever,
        camera,
    )
    return float(separations_arcsec(xy_px, lab)[0])


def draw_magnitudes(fig: Any, places: Sequence[PlaceSeries]) -> None:
    rows = experiments()["afit-table-3-5"].rows
    panels = fig.subplots(1, 2)
    for column, name, axes in zip((DIM, BRIGHT), ("dim", "bright"), panels, strict=True):
        magnitudes = [one.magnitude[:, column] for one in places]
        bins = np.linspace(
            np.concatenate(magnitudes).min(), np.concatenate(magnitudes).max(), 25
        )
        top = 1.0
        for n, values in enumerate(magnitudes):
            style = {"color": INK[(0, 2, 4)[n]], "label": f"ours, place {n + 1}"}
            counts, _, _ = axes.hist(values, bins, histtype="step", **style)
            top = max(top, counts.max())
        for n in range(3):
            mean = rows[f"{name}_{n + 1}"].published
            sd = rows[f"sd_{name}_{n + 1}"].published
            style = {"color": INK[1], "marker": MARKS[n], "label": f"published, {n + 1}"}
            axes.errorbar(mean, top * (1.1 + 0.1 * n), xerr=sd, **style)
        axes.set(xlabel=f"magnitude of the {name} LED", ylabel="images", ylim=(0, top * 1.4))
    fig.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=6,
        fontsize=8,
    )


def draw_angles(fig: Any, lab: Lab, places: Sequence[PlaceSeries]) -> None:
    rows = experiments()["afit-table-3-5"].rows
    axes = fig.subplots()
    tilt_deg = np.linspace(0, 32, 33)
    curves = (
        ("measured dome", BoardPlace(0)),
        (f"{DECENTER_IN} in off center", BoardPlace(0, 0, DECENTER_IN)),
        (f"leaning {BOARD_TILT_DEG:g} deg", BoardPlace(0, BOARD_TILT_DEG)),
    )
    for ink, style, (name, place) in zip(
        (INK[0], INK[2], INK[4]), ("-", "--", "-."), curves, strict=True
    ):
        angle = [
            geometric_angle_arcsec(lab, place._replace(tilt_deg=float(tilt)))
            for tilt in tilt_deg
        ]
        axes.plot(tilt_deg, angle, style, color=ink, label=name)
    ours = [one.angle_arcsec.mean() for one in places]
    axes.plot(PLACES_DEG, ours, "s", color=INK[0], label="ours, from images")
    mean, sd = (
        [rows[f"{key}_{n}"].published for n in (1, 2, 3)] for key in ("angle", "sd_angle")
    )
    published_deg = (0, HALFWAY_DEG, PLACES_DEG[2])
    axes.errorbar(
        published_deg, mean, sd, fmt="o", capsize=3, color=INK[1], label="published"
    )
    axes.set(xlabel="tilt of the board (deg)", ylabel="angle of the pair (arcsec)")
    axes.legend()
