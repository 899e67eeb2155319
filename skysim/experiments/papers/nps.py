"""NPS's TAS-2 under nine stars on a flat panel (Tappe 2009, cited by Padro 2012, section 2.7.2).

The stars are near, so their directions from the bearing depend on the attitude. The tracker computes the distances
from an assumed attitude (eq. 33), identifies the stars and solves; the solution can be the next assumed attitude. The
experiment shows how large the initial attitude error may be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, on_surface
from estimator.attitude.solvers import quest
from estimator.catalog import pair_index
from estimator.catalog.pair_index import PairIndex
from estimator.identification.published.master_star import master_star
from skysim.core.constants import ARCSEC_RAD
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.dome_survey.survey_frames import detect_lights
from skysim.experiments.papers.compare import (
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    bootstrap_interval,
    with_cause,
)
from skysim.results.metrics import Summary, proportion
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.sections.light import DomeConfig, FlatSurfaceConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking import factory, onboard_model

INITIAL_DEG = (-6, -3, 0, 3, 6)
ITERATED_DEG = 2.0
UPDATES = 5
SEPARATION_RAD = 500 * ARCSEC_RAD
APPROXIMATE_DEG = 1.0  # a solution with a smaller error counts as approximating the attitude
FITTED_CAMERA_M = np.array([0.30, 0.0, 0.20])


class OnboardModel(NamedTuple):
    """The tracker's model: the true panel and lever arm, and the nine stars as seen from the level vehicle.

    Attributes
    ----------
    lab
        The true lab
    panel
        The plane
    vectors
        (9, 3) unit, from the bearing
    pairs
        Their index
    """

    lab: Lab
    panel: LedMap
    vectors: Floats
    pairs: PairIndex


class PanelSolution(NamedTuple):
    """Number of matched stars and body_from_lab; 0 and None if no match is significant against chance."""

    matched: int
    body_from_lab: Rotation | None

    @property
    def error_deg(self) -> float:
        """Error of the attitude; the true one is level. NaN without a solution."""
        return (
            float(np.degrees(self.body_from_lab.magnitude()))
            if self.body_from_lab
            else np.nan
        )


def build_model(camera_m: Floats | None, seed: int, frames: int) -> OnboardModel:
    """The scene with the camera moved to camera_m on the vehicle (None: not moved), and the panel moved along with it.

    The catalog is the mean of `frames` frames from the level vehicle.
    """
    scene = loader.load("nps_tas2_ideal")
    lab = build_lab(scene)
    assert isinstance(scene.light, DomeConfig)
    assert isinstance(scene.light.surface, FlatSurfaceConfig)
    height_m = scene.light.surface.apex_m
    if camera_m is not None:
        shift_m = camera_m - lab.camera.mount.camera_body_m
        position = lab.camera.sources.place + np.append(shift_m, 0.0)
        height_m += shift_m[2]
        sources = replace(lab.camera.sources, place=position)
        mount = replace(lab.camera.mount, camera_body_m=camera_m)
        lab = lab.with_sources(sources).with_camera(mount=mount)
    no_leds = np.empty(0, np.int64), np.empty((0, 3))
    panel = LedMap(*no_leds, np.zeros(3), np.array([np.inf, np.inf, height_m]))
    rays_of_frames = [rays_body(lab, seed + n) for n in range(frames)]
    # Noise changes the order of brightness between frames, so sort by position before averaging.
    sorted_rays = [rays[np.lexsort((rays[:, 1], rays[:, 0]))] for rays in rays_of_frames]
    mean = np.mean(
        [rays for rays in sorted_rays if len(rays) == len(lab.camera.sources)], axis=0
    )
    vectors = directions(lab, panel, mean, Rotation.identity())
    return OnboardModel(lab, panel, vectors, pair_index.build(vectors, 1.0))


def rays_body(lab: Lab, seed: int) -> Floats:
    """(N, 3) unit vectors in body axes to the stars of one frame from the level vehicle, brightest first."""
    frame, _ = render_at_rest(lab.in_run(seed).camera, lab.start)
    camera = onboard_model.assumed_camera(lab.scene)
    lights = detect_lights(factory.assumed_settings(lab.scene), camera, frame.image_dn)
    return lab.camera.mount.cam_from_body.inv().apply(camera.rays(lights.xy_px))


def directions(lab: Lab, panel: LedMap, rays: Floats, body_from_lab: Rotation) -> Floats:
    """(N, 3) unit vectors along R_0 + alpha_i b_i in body axes, distances alpha_i from the assumed attitude (eq. 33).

    R_0 is the camera's position and b_i the ray of light i; alpha_i is the distance to the panel along the ray.
    """
    camera_m = lab.camera.mount.camera_body_m
    lab_from_body = body_from_lab.inv()
    origin_m = lab_from_body.apply(camera_m)
    intersection_m = on_surface(lab_from_body.apply(rays), origin_m, panel)
    point_m = camera_m + np.linalg.norm(intersection_m - origin_m, axis=1)[:, None] * rays
    return point_m / np.linalg.norm(point_m, axis=1, keepdims=True)


def solve(model: OnboardModel, rays: Floats, assumed: Rotation) -> PanelSolution:
    """Solve once: distances from the assumed attitude, master-star identification within 500 arcsec, QUEST."""
    observed = directions(model.lab, model.panel, rays, assumed)
    # master_star takes the error of a direction; an angle's is sqrt(2) times that.
    match = master_star(observed, model.pairs, SEPARATION_RAD / np.sqrt(2))
    if match is None:
        return PanelSolution(0, None)
    sigma_rad = np.full(len(match.observed), SEPARATION_RAD)
    return PanelSolution(
        len(sigma_rad), quest(observed[match.observed], model.vectors[match.star], sigma_rad)
    )


def solve_iteratively(model: OnboardModel, rays: Floats, assumed: Rotation) -> PanelSolution:
    """Solve UPDATES times, each time with the last solution as the assumed attitude."""
    for _ in range(UPDATES):
        solution = solve(model, rays, assumed)
        if solution.body_from_lab is None:
            return solution
        assumed = solution.body_from_lab
    return solution


def initial_error(error_deg: float) -> Rotation:
    """Rotation of the initial error: the same error in all three Euler angles."""
    return Rotation.from_euler("ZYX", [error_deg] * 3, degrees=True)


class SolutionSeries(NamedTuple):
    """Solutions of all trials by initial error in degrees, and the iterated solutions."""

    solutions: dict[float, list[PanelSolution]]
    iterated: list[PanelSolution]

    def matched(self) -> Summary:
        """Mean number of matched stars over the five trials."""
        counts = [
            [solution.matched for solution in self.solutions[error]] for error in INITIAL_DEG
        ]
        mean_of_frame = np.mean(counts, axis=0)  # the trials of a frame are not independent
        return bootstrap_interval(mean_of_frame, np.mean)

    def fraction_near(self, error_deg: float) -> Summary:
        """Fraction of a trial's solutions with an error below APPROXIMATE_DEG."""
        errors_deg = np.array([solution.error_deg for solution in self.solutions[error_deg]])
        return proportion(int(np.sum(errors_deg < APPROXIMATE_DEG)), len(errors_deg))

    def mean_euler_angle(self) -> Summary:
        """Mean absolute Euler angle after the updates, deg; the true angles are zero."""
        attitudes = [
            solution.body_from_lab for solution in self.iterated if solution.body_from_lab
        ]
        angles = [
            np.abs(attitude.as_euler("ZYX", degrees=True)).mean() for attitude in attitudes
        ]
        return bootstrap_interval(np.array(angles), np.mean)


def solve_series(
    model: OnboardModel,
    errors_deg: Sequence[float],
    frames: int,
    seed: int,
    options: ExperimentOptions,
) -> SolutionSeries:
    """Solve frames from the level vehicle, each from every initial error, and iterated from ITERATED_DEG."""
    solutions: dict[float, list[PanelSolution]] = {error: [] for error in errors_deg}
    iterated_solutions = []
    for n in range(frames):
        rays = rays_body(model.lab, seed + n)
        for error in errors_deg:
            solutions[error].append(solve(model, rays, initial_error(error)))
        iterated_solutions.append(solve_iteratively(model, rays, initial_error(ITERATED_DEG)))
        options.watch(n + 1, frames)
    return SolutionSeries(solutions, iterated_solutions)


def initial_error_trials(options: ExperimentOptions) -> ExperimentResult:
    """Solutions for each initial error (five tests of 50 frames), with the scene's and a fitted camera position."""
    errors_deg = INITIAL_DEG if options.quick else (*INITIAL_DEG, -10, -8, -4.5, 4.5, 8, 10)
    frames = options.trials(250, 40)
    catalog_frames = options.trials(50, 10)
    seeds = random_stream(options.seed, 2009).integers(2**31, size=4).tolist()
    scene_camera, fitted_camera = (
        solve_series(
            build_model(camera_m, seeds[n], catalog_frames),
            errors_deg,
            frames,
            seeds[n + 2],
            options,
        )
        for n, camera_m in enumerate((None, FITTED_CAMERA_M))
    )
    statistics: dict[str, Callable[[SolutionSeries], Summary]] = {
        "matched": SolutionSeries.matched,
        **{
            f"from_{error}": partial(SolutionSeries.fraction_near, error_deg=error)
            for error in INITIAL_DEG
        },
        "iterated": SolutionSeries.mean_euler_angle,
    }
    cause = "the camera 0.30 m to the side and 0.20 m up, fitted"
    results: Results = {
        key: with_cause(cause, one, scene_camera, fitted_camera)
        for key, one in statistics.items()
    }
    caption = "Stars matched, and the solutions' error, by the initial attitude's error; shaded where NPS succeeded."
    series = {"scene's camera": scene_camera, "0.30 m to the side": fitted_camera}
    return ExperimentResult(
        results, (FigureDrawing(caption, lambda fig: draw(fig, series), (7.4, 4.6)),)
    )


def draw(fig: Any, series_by_camera: dict[str, SolutionSeries]) -> None:
    above, below = fig.subplots(2, 1, sharex=True)
    for n, (name, series) in enumerate(series_by_camera.items()):
        errors = sorted(series.solutions)
        counts = []
        mean_error_deg = []
        for error in errors:
            counts.append(np.mean([one.matched for one in series.solutions[error]]))
            errors_deg = [
                one.error_deg for one in series.solutions[error] if one.body_from_lab
            ]
            mean_error_deg.append(np.mean(errors_deg) if errors_deg else np.nan)
        style = {"color": INK[(0, 2)[n]], "marker": MARKS[n], "label": f"ours, {name}"}
        above.plot(errors, counts, **style)
        below.plot(errors, mean_error_deg, **style | {"label": None})
    for axes in (above, below):
        axes.axvspan(-6, 3, color=INK[1], alpha=0.12, lw=0)
    above.axhline(6, color=INK[1], ls="--", label="published: about 6 on average")
    above.set(ylabel="stars matched, mean", ylim=(-0.5, 9.5))
    fig.legend(loc="outside upper center", ncols=3)
    below.set(
        ylabel="error of solutions (deg)",
        xlabel="error of the initial attitude, each angle (deg)",
    )
