"""Two other domes: JHU/APL's of a hundred fibers (Boone et al. 2005), and AFIT's later one of OLED panels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from skysim.camera.projection import Poses, in_view, project
from skysim.core.constants import ARCSEC_RAD
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Sources
from skysim.experiments.papers.compare import (
    Cause,
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    bootstrap_interval,
)
from skysim.experiments.papers.published import experiments
from skysim.experiments.study.execution.setups import TrialSetup
from skysim.experiments.study.execution.trials import run_centroid_trials
from skysim.experiments.study.plan import CentroidTrial
from skysim.experiments.tracker_comparison import with_config
from skysim.results.metrics import Summary, exact, extremum, rms
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig
from skysim.scene.sections.tracker import SurveyErrorsConfig
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.sources import dome
from skysim.sources.photometry import Band
from skysim.tracking import onboard_model

LARGE_OFFSET_M = 0.05
SMALL_OFFSET_M = 1e-3
OFFSETS_M = (1e-4, 1e-3, 1e-2, 5e-2, 1e-1)
CIRCLE_DEG = 10.0
MEAN_STARS = 5.0
APL_MAX_TILT_DEG = 60.0  # greatest angle of the boresight from the zenith


def shell_scene(radius_variation: float, seed: int) -> Scene:
    """The scene with another random variation of the shell's radius; the fibers keep their directions."""
    variation = "light.layout.radius_variation"
    hardware_seed = "light.layout.points.hardware_seed"
    return loader.load(
        "apl_dome_ideal", {variation: str(radius_variation), hardware_seed: str(seed)}
    )


def fibers(scene: Scene, lab: Lab) -> tuple[Sources, Floats]:
    """The true fibers of a shell, and their (N, 3) positions on a perfect sphere."""
    assert isinstance(scene.light, DomeConfig)
    true = dome.sources(scene.light, Band.from_camera(scene.camera))
    perfect_light = with_config(scene.light, "layout", radius_variation=0.0)
    return true, dome.sources(perfect_light, lab.camera.band).place[:, :3]


def random_attitudes(count: int, rng: np.random.Generator) -> list[Rotation]:
    """Random lab_from_body: boresight (body z) uniform within MAX_TILT_DEG of the zenith, any roll."""
    tilt = np.arccos(rng.uniform(np.cos(np.radians(APL_MAX_TILT_DEG)), 1, count))
    first, last = rng.uniform(0, 2 * np.pi, (2, count))
    return [
        Rotation.from_euler("ZYZ", angles) for angles in np.column_stack([first, tilt, last])
    ]


def largest_discrepancies_arcsec(
    scene: Scene, lab: Lab, offset_m: float, corrected: bool, attitudes: list[Rotation]
) -> Floats:
    """(K,) largest angle between observed ray and expected direction of a fiber, for each attitude with one in view.

    The pupil is displaced across the boresight by offset_m. The tracker assumes a perfect sphere, and the pupil in its
    center unless `corrected`: then the offset is known.
    """
    true, perfect_m = fibers(scene, lab)
    camera = onboard_model.assumed_camera(scene)
    cam_from_body = lab.camera.mount.cam_from_body
    pupil_m = cam_from_body.inv().apply([offset_m, 0.0, 0.0])
    assumed_pupil_m = pupil_m if corrected else np.zeros(3)
    boresight = cam_from_body.inv().apply([0.0, 0.0, 1.0])
    level_rotation, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [boresight])
    largest = []
    for lab_from_body in (attitude * level_rotation for attitude in attitudes):
        cam_from_lab = cam_from_body * lab_from_body.inv()
        poses = Poses(cam_from_lab.as_matrix()[None], lab_from_body.apply(pupil_m)[None])
        visible = in_view(true, lab.camera.optics, poses)
        xy_px = project(true.take(visible), lab.camera.optics, poses)[0][0]
        on_detector = camera.contains(xy_px)
        assumed_m = cam_from_lab.apply(
            perfect_m[visible[on_detector]] - lab_from_body.apply(assumed_pupil_m)
        )
        expected_rays = assumed_m / np.linalg.norm(assumed_m, axis=1, keepdims=True)
        sine = np.linalg.norm(
            np.cross(camera.rays(xy_px[on_detector]), expected_rays), axis=1
        )
        if len(sine):
            largest.append(np.arcsin(sine.max()) / ARCSEC_RAD)
    return np.array(largest)


def count_fibers(lab: Lab, diameter_deg: float, boresights: Floats) -> Floats:
    """(K,) number of fibers in a circle of this diameter about each of the (K, 3) unit boresights from the center."""
    position_m = lab.camera.sources.place[:, :3]
    directions = position_m / np.linalg.norm(position_m, axis=1, keepdims=True)
    return np.asarray(
        (boresights @ directions.T > np.cos(np.radians(diameter_deg / 2))).sum(axis=1), float
    )


def random_boresights(count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) unit vectors uniform over the upper hemisphere."""
    z = rng.uniform(0, 1, count)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    return np.column_stack(
        [np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z]
    )


def discrepancies_and_counts(options: ExperimentOptions) -> ExperimentResult:
    """Discrepancies over shells and attitudes, and the number of fibers in a field."""
    rng = random_stream(options.seed, 2005)
    lab = build_lab(loader.load("apl_dome_ideal"))
    scenes = [
        shell_scene(0.004, int(seed))
        for seed in rng.integers(2**31, size=options.trials(30, 5))
    ]
    attitudes = random_attitudes(options.trials(60, 20), rng)
    large_offset = np.concatenate(
        [
            largest_discrepancies_arcsec(scene, lab, LARGE_OFFSET_M, True, attitudes)
            for scene in scenes
        ]
    )
    small_offset = largest_discrepancies_arcsec(
        shell_scene(0.0, 1), lab, SMALL_OFFSET_M, False, attitudes
    )
    true, perfect_m = fibers(scenes[0], lab)
    radius_m, perfect_radius_m = (
        np.linalg.norm(place_m, axis=1) for place_m in (true.place[:, :3], perfect_m)
    )
    radius_change = radius_m / perfect_radius_m - 1
    boresights = random_boresights(options.trials(100_000, 20_000), rng)
    inner_boresights = boresights[boresights[:, 2] > np.sin(np.radians(20))]

    def excess_stars(diameter_deg: float) -> float:
        return count_fibers(lab, diameter_deg, inner_boresights).mean() - MEAN_STARS

    results: Results = {
        "fibers": exact(len(lab.camera.sources)),
        "variation": extremum(100 * np.abs(radius_change), np.max),
        "off_50mm": extremum(large_offset, np.max),
        "off_1mm": extremum(small_offset, np.max),
        "stars_10deg": bootstrap_interval(count_fibers(lab, CIRCLE_DEG, boresights), np.mean),
        "field_5stars": extremum(np.array([brentq(excess_stars, 5, 90, xtol=0.05)]), np.max),
    }
    # Worst discrepancies without and with the pupil's offset known.
    worst = [
        [
            largest_discrepancies_arcsec(scenes[0], lab, offset_m, known, attitudes).max()
            for known in (False, True)
        ]
        for offset_m in OFFSETS_M
    ]
    caption = "Largest angular discrepancy of a fiber against the camera's offset, with the offset unknown and known."
    return ExperimentResult(
        results, (FigureDrawing(caption, lambda fig: draw_apl(fig, np.array(worst))),)
    )


def draw_apl(fig: Any, worst_arcsec: Floats) -> None:
    axes = fig.subplots()
    rows = experiments()["apl"].rows
    offset_mm = 1e3 * np.array(OFFSETS_M)
    for n, name in enumerate(("ours, place not told", "ours, place told: the shell is left")):
        axes.plot(
            offset_mm, worst_arcsec[:, n], color=INK[(0, 2)[n]], marker=MARKS[n], label=name
        )
    for key, position_mm in (("off_1mm", 1), ("off_50mm", 50)):
        published = rows[key].published
        label = f"stated: {published:g} arcsec at {position_mm} mm"
        axes.plot(position_mm, published, "*", color=INK[1], ms=11, label=label)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="pupil off the dome's center (mm)",
        ylabel="worst error (arcsec)",
    )
    axes.set_xticks(offset_mm, [f"{tick:g}" for tick in offset_mm])
    ticks = 10.0 ** np.arange(-1, 5)
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.legend()


# AFIT's later OLED dome: noise-equivalent angle and absolute error of the attitude with many small
# lights in view.


NOISE_PX = 0.1
STATED_LIGHTS = 20
MANY_LIGHTS = 80
SPACING_MM = {
    10: 30,
    20: 22,
    40: 15.5,
    80: 11,
}  # by number of lights; slightly more are in view
ARCSEC_TICKS = (0.2, 0.5, 1, 2, 5, 10)
OLED_MAX_TILT_DEG = 10.0
CAP_DEG = 18.0
MEASURED = {
    "led_sigma": "0.2 mm",
    "lever_sigma": "0.2 mm",
}  # of a laser tracker or a measuring arm
# Left by `skysim survey`, docs/findings/dome.md.
BY_FRAMES = {"led_sigma": "0.08 mm", "lever_sigma": "0.09 mm"}
LEVEL_SIGMA_DEG = 0.005  # orientation error of the survey's axes


class AttitudeErrors(NamedTuple):
    """(N, 3) attitude errors about the camera's axes of N solved attitudes, arcsec."""

    error_arcsec: Floats

    @property
    def cross_boresight(self) -> Summary:
        """rms error about one axis across the boresight, from both axes."""
        return bootstrap_interval(rms(self.error_arcsec[:, :2]), rms)

    @property
    def roll(self) -> Summary:
        """rms error about the boresight."""
        return bootstrap_interval(self.error_arcsec[:, 2], rms)


def build_setup(lights: int) -> TrialSetup:
    """AFIT's camera under its measured dome with randomly placed lights, of which at most `lights` are used."""
    layout = f'{{kind: poisson_disk, spacing: "{SPACING_MM[lights]} mm", cap_deg: {CAP_DEG}}}'
    scene = loader.load(
        "afit_simsat_ideal",
        {"light.layout": layout, "tracker.centroid_sigma_px": str(NOISE_PX)},
    )
    lab = build_lab(scene)
    trial = CentroidTrial(
        kind="centroids", noise_px=NOISE_PX, lights=lights, tilt_deg=(0, OLED_MAX_TILT_DEG)
    )
    return TrialSetup(lab, build_tracker(lab.camera), trial, "")


def solve_random_attitudes(setup: TrialSetup, seeds: Sequence[int]) -> AttitudeErrors:
    """Errors of lost-in-space solutions from simulated centroids at random attitudes."""
    solutions = run_centroid_trials(setup, seeds)
    errors = np.array([[one.x_arcsec, one.y_arcsec, one.roll_arcsec] for one in solutions])
    return AttitudeErrors(errors[np.isfinite(errors[:, 0])])


def with_surveyed_map(setup: TrialSetup, sigmas: dict[str, str], seed: int) -> TrialSetup:
    """The same dome with a tracker whose map comes from a survey with position errors and slightly rotated axes."""
    rotation_deg = random_stream(seed, 2).normal(0, LEVEL_SIGMA_DEG, 3)
    survey_errors = SurveyErrorsConfig.model_validate(
        sigmas | {"rotation_deg": rotation_deg.tolist(), "seed": seed}
    )
    lab = setup.lab.with_scene(with_config(setup.lab.scene, "tracker", survey=survey_errors))
    return setup._replace(lab=lab, estimator=build_tracker(lab.camera))


def mean_absolute_error_deg(
    setup: TrialSetup, sigmas: dict[str, str], seeds: list[list[int]]
) -> Summary:
    """Mean error angle in degrees. The attitudes of one survey share its errors, so the interval is over surveys.

    Parameters
    ----------
    seeds
        One list per survey: its seed, then the seeds of its attitudes
    """
    means_arcsec = []
    for survey_seed, *attitude_seeds in seeds:
        errors = solve_random_attitudes(
            with_surveyed_map(setup, sigmas, survey_seed), attitude_seeds
        )
        means_arcsec.append(np.mean(np.linalg.norm(errors.error_arcsec, axis=1)))
    return bootstrap_interval(np.array(means_arcsec) / 3600, np.mean)


def noise_and_absolute_error(options: ExperimentOptions) -> ExperimentResult:
    """Noise-equivalent angle with an exact map for several numbers of lights; absolute error with a surveyed map."""
    rng = random_stream(options.seed, 76398981)
    counts = [STATED_LIGHTS, MANY_LIGHTS] if options.quick else list(SPACING_MM)
    n_attitudes = options.trials(600, 60)
    errors_by_lights = {}
    for n, lights in enumerate(counts):
        seeds = rng.integers(2**31, size=n_attitudes).tolist()
        errors_by_lights[lights] = solve_random_attitudes(build_setup(lights), seeds)
        options.watch(n + 1, len(counts) + 1)
    few = errors_by_lights[STATED_LIGHTS]
    many = errors_by_lights[MANY_LIGHTS]
    seeds = rng.integers(2**31, size=(options.trials(40, 6), options.trials(11, 5))).tolist()
    measured, by_frames = (
        mean_absolute_error_deg(build_setup(STATED_LIGHTS), sigmas, seeds)
        for sigmas in (MEASURED, BY_FRAMES)
    )
    cause = f"{MANY_LIGHTS} lights in the field"
    results: Results = {
        "across": RowResult(few.cross_boresight, cause=Cause(cause, many.cross_boresight)),
        "roll": RowResult(few.roll, cause=Cause(cause, many.roll)),
        "absolute": RowResult(
            measured,
            cause=Cause("LED positions surveyed with the camera's own frames", by_frames),
        ),
    }
    caption = "Noise-equivalent angle by the number of lights in the field; dashed the published bounds."
    return ExperimentResult(
        results, (FigureDrawing(caption, lambda fig: draw_oled(fig, errors_by_lights)),)
    )


def draw_oled(fig: Any, errors_by_lights: dict[int, AttitudeErrors]) -> None:
    """Both angles against the number of lights n, with a fitted line proportional to 1 / sqrt(n)."""
    axes = fig.subplots()
    rows = experiments()["oled"].rows
    lights = np.array(list(errors_by_lights))
    errors = list(errors_by_lights.values())
    across = [one.cross_boresight for one in errors]
    roll = [one.roll for one in errors]
    curves = (("across", "across, one axis", across), ("roll", "roll", roll))
    for n, (key, name, summaries) in enumerate(curves):
        value, low, high, *_ = np.array(summaries).T
        axes.errorbar(
            lights,
            value,
            [value - low, high - value],
            fmt=MARKS[n],
            color=INK[n],
            capsize=3,
            label=f"ours, {name}",
        )
        coefficient = np.exp(np.mean(np.log(value * np.sqrt(lights))))
        axes.plot(lights, coefficient / np.sqrt(lights), color=INK[n], lw=0.8)
        axes.axhline(
            rows[key].at_most, color=INK[n], ls="--", label=f"published bound, {name}"
        )
    axes.set(
        xscale="log", yscale="log", xlabel="lights in the field", ylabel="error, rms (arcsec)"
    )
    axes.set_xticks(lights, [str(count) for count in lights])
    axes.set_yticks(ARCSEC_TICKS, [f"{tick:g}" for tick in ARCSEC_TICKS])
    axes.minorticks_off()
    axes.legend(ncols=2, loc="center")
