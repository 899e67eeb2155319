"""NPS's TAS-2 under nine stars on a flat panel (Tappe 2009, cited by Padro 2012, section 2.7.2).

The stars are near, so their directions from the bearing depend on the attitude. The tracker computes the distances
from a believed attitude (eq. 33), identifies the stars and solves; the solution can be the next believed attitude. The
experiment shows how large the initial attitude error may be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, on_surface
from estimator.attitude.solvers import quest
from estimator.catalog import pair_index
from estimator.catalog.pair_index import PairIndex
from estimator.identification.published.master_star import master_star
from skysim.core.types import Floats
from skysim.core.units import ARCSEC_RAD
from skysim.experiments import dome_survey
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import resampled
from skysim.experiments.study.trials import reseeded
from skysim.results.metrics import Summary, share
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.light import DomeConfig, FlatSurfaceConfig
from skysim.simulation import exposure, testbed
from skysim.simulation.testbed import Testbed
from skysim.tracking import onboard_model, settings

INITIAL_DEG = (-6, -3, 0, 3, 6)
ITERATED_DEG, UPDATES = 2.0, 5
SEPARATION_RAD = 500 * ARCSEC_RAD
APPROXIMATE_DEG = 1.0  # a solution with a smaller error counts as approximating the attitude
FITTED_CAMERA_M = np.array([0.30, 0.0, 0.20])


class Known(NamedTuple):
    """What the tracker knows: the true panel and lever arm, and the nine stars as seen from the level vehicle.

    lab : the true testbed;  panel : the plane;  vectors : (9, 3) unit, from the bearing;  pairs : their index
    """

    lab: Testbed
    panel: LedMap
    vectors: Floats
    pairs: PairIndex


class Solution(NamedTuple):
    """Number of matched stars and body_from_lab; 0 and None if no match is significant against chance."""

    matched: int
    body_from_lab: Rotation | None

    @property
    def off_deg(self) -> float:
        """Error of the attitude; the true one is level. NaN without a solution."""
        return float(np.degrees(self.body_from_lab.magnitude())) if self.body_from_lab else np.nan


def at(camera_m: Floats | None, seed: int, frames: int) -> Known:
    """The scene with the camera moved to camera_m on the vehicle (None: not moved), and the panel moved along with it.

    The catalog is the mean of `frames` frames from the level vehicle.
    """
    told = loader.load("nps_tas2")
    lab = testbed.build_testbed(told)
    assert isinstance(told.light, DomeConfig)
    assert isinstance(told.light.surface, FlatSurfaceConfig)
    height_m = told.light.surface.apex_m
    if camera_m is not None:
        shift_m = camera_m - lab.mount.camera_body_m
        place = lab.sources.place + np.append(shift_m, 0.0)
        height_m += shift_m[2]
        lab = replace(
            lab,
            sources=replace(lab.sources, place=place),
            mount=replace(lab.mount, camera_body_m=np.asarray(camera_m)),
        )
    nowhere = np.empty(0, np.int64), np.empty((0, 3))
    panel = LedMap(*nowhere, np.zeros(3), np.array([np.inf, np.inf, height_m]))
    shots = [rays_body(lab, seed + n) for n in range(frames)]
    # Noise changes the order of brightness between frames, so sort by position before averaging.
    by_place = [rays[np.lexsort((rays[:, 1], rays[:, 0]))] for rays in shots]
    mean = np.mean([one for one in by_place if len(one) == len(lab.sources)], axis=0)
    vectors = directions(lab, panel, mean, Rotation.identity())
    return Known(lab, panel, vectors, pair_index.build(vectors, 1.0))


def rays_body(lab: Testbed, seed: int) -> Floats:
    """(N, 3) unit vectors in body axes to the stars of one frame from the level vehicle, brightest first."""
    frame, _ = exposure.render_frame(reseeded(lab, seed), 0)
    camera = onboard_model.believed_camera(lab.scene)
    seen = dome_survey.detect_lights(settings.believed_settings(lab.scene), camera, frame)
    return lab.mount.cam_from_body.inv().apply(camera.rays(seen.xy_px))


def directions(lab: Testbed, panel: LedMap, rays: Floats, body_from_lab: Rotation) -> Floats:
    """(N, 3) unit vectors along R_0 + alpha_i b_i in body axes, distances alpha_i from the believed attitude (eq. 33).

    R_0 is the camera's position and b_i the ray of light i; alpha_i is the distance to the panel along the ray.
    """
    camera_m, lab_from_body = lab.mount.camera_body_m, body_from_lab.inv()
    origin_m = lab_from_body.apply(camera_m)
    met_m = on_surface(lab_from_body.apply(rays), origin_m, panel)
    point_m = camera_m + np.linalg.norm(met_m - origin_m, axis=1)[:, None] * rays
    return point_m / np.linalg.norm(point_m, axis=1, keepdims=True)


def solve(known: Known, rays: Floats, believed: Rotation) -> Solution:
    """Solve once: distances from the believed attitude, master-star identification within 500 arcsec, QUEST."""
    seen = directions(known.lab, known.panel, rays, believed)
    # master_star takes the error of a direction; an angle's is sqrt(2) times that.
    match = master_star(seen, known.pairs, SEPARATION_RAD / np.sqrt(2))
    if match is None:
        return Solution(0, None)
    sigma_rad = np.full(len(match.observed), SEPARATION_RAD)
    return Solution(len(sigma_rad), quest(seen[match.observed], known.vectors[match.star], sigma_rad))


def iterated(known: Known, rays: Floats, believed: Rotation) -> Solution:
    """Solve UPDATES times, each time with the last solution as the believed attitude."""
    for _ in range(UPDATES):
        found = solve(known, rays, believed)
        if found.body_from_lab is None:
            return found
        believed = found.body_from_lab
    return found


def wrong_by(error_deg: float) -> Rotation:
    """Rotation of the initial error: the same error in all three Euler angles."""
    return Rotation.from_euler("ZYX", [error_deg] * 3, degrees=True)


class Course(NamedTuple):
    """Solutions of all trials by initial error in degrees, and the iterated solutions."""

    trials: dict[float, list[Solution]]
    iterated: list[Solution]

    @property
    def matched(self) -> Summary:
        """Mean number of matched stars over the five trials."""
        count = [[one.matched for one in self.trials[error]] for error in INITIAL_DEG]
        return resampled(np.mean(count, axis=0), np.mean)  # mean per frame: its trials are not independent

    def near(self, error_deg: float) -> Summary:
        """Fraction of a trial's solutions with an error below APPROXIMATE_DEG."""
        off = np.array([one.off_deg for one in self.trials[error_deg]])
        return share(int(np.sum(off < APPROXIMATE_DEG)), len(off))

    @property
    def euler(self) -> Summary:
        """Mean absolute Euler angle after the updates, deg; the true angles are zero."""
        angles = [
            np.abs(one.body_from_lab.as_euler("ZYX", degrees=True)).mean()
            for one in self.iterated
            if one.body_from_lab
        ]
        return resampled(np.array(angles), np.mean)


def course(known: Known, errors_deg: Sequence[float], frames: int, seed: int, ask: Ask) -> Course:
    """Solve frames from the level vehicle, each from every initial error, and iterated from ITERATED_DEG."""
    trials: dict[float, list[Solution]] = {error: [] for error in errors_deg}
    last = []
    for n in range(frames):
        rays = rays_body(known.lab, seed + n)
        for error in errors_deg:
            trials[error].append(solve(known, rays, wrong_by(error)))
        last.append(iterated(known, rays, wrong_by(ITERATED_DEG)))
        ask.watch(n + 1, frames)
    return Course(trials, last)


def trials(ask: Ask) -> Found:
    """Solutions for each initial error (five tests of 50 frames), with the scene's and a fitted camera position."""
    errors = INITIAL_DEG if ask.quick else (*INITIAL_DEG, -10, -8, -4.5, 4.5, 8, 10)
    frames, sky = ask.trials(250, 40), ask.trials(50, 10)
    seeds = np.random.default_rng([ask.seed, 2009]).integers(2**31, size=4).tolist()
    scene_s, fitted = (
        course(at(camera_m, seeds[n], sky), errors, frames, seeds[n + 2], ask)
        for n, camera_m in enumerate((None, FITTED_CAMERA_M))
    )
    name = "the camera 0.30 m to the side and 0.20 m up, fitted"
    answers = {"matched": Answer(scene_s.matched, cause=Cause(name, fitted.matched))}
    for error in INITIAL_DEG:
        answers[f"from_{error}"] = Answer(scene_s.near(error), cause=Cause(name, fitted.near(error)))
    answers["iterated"] = Answer(scene_s.euler, cause=Cause(name, fitted.euler))
    caption = "Stars matched, and the solutions' error, by the initial attitude's error; shaded where NPS succeeded."
    courses = {"scene's camera": scene_s, "0.30 m to the side": fitted}
    return Found(answers, (Drawing(caption, lambda fig: draw(fig, courses), (7.4, 4.6)),))


def draw(fig: Any, courses: dict[str, Course]) -> None:
    """Matched stars above, errors below."""
    above, below = fig.subplots(2, 1, sharex=True)
    for n, (name, one) in enumerate(courses.items()):
        errors = sorted(one.trials)
        counts = [np.mean([each.matched for each in one.trials[error]]) for error in errors]
        found = [[each.off_deg for each in one.trials[error] if each.body_from_lab] for error in errors]
        off = [np.mean(each) if each else np.nan for each in found]
        style = {"color": INK[(0, 2)[n]], "marker": MARKS[n], "label": f"ours, {name}"}
        above.plot(errors, counts, **style)
        below.plot(errors, off, **style | {"label": None})
    for axes in (above, below):
        axes.axvspan(-6, 3, color=INK[1], alpha=0.12, lw=0)
    above.axhline(6, color=INK[1], ls="--", label="published: about 6 on average")
    above.set(ylabel="stars matched, mean", ylim=(-0.5, 9.5))
    fig.legend(loc="outside upper center", ncols=3)
    below.set(ylabel="error of solutions (deg)", xlabel="error of the initial attitude, each angle (deg)")
