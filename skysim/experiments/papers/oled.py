"""AFIT's later OLED dome: noise-equivalent angle and absolute error of the attitude with many small lights in view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple
import numpy as np
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.tracker_comparison import with_config
from skysim.experiments.papers.compare import (Cause, FigureDrawing, ExperimentOptions, ExperimentResult, RowResult)
from skysim.experiments.papers.compare import bootstrap_interval
from skysim.experiments.papers.published import experiments
from skysim.experiments.study.execution.setups import TrialSetup
from skysim.experiments.study.execution.trials import run_centroid_trials
from skysim.experiments.study.plan import CentroidTrial
from skysim.results.metrics import Summary, rms
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.sections.tracker import SurveyErrorsConfig
from skysim.simulation.lab import (build_lab, build_tracker)



NOISE_PX = 0.1
STATED_LIGHTS = 20
MANY_LIGHTS = 80
SPACING_MM = {10: 30, 20: 22, 40: 15.5, 80: 11}  # by number of lights; slightly more are in view
ARCSEC_TICKS = (0.2, 0.5, 1, 2, 5, 10)
MAX_TILT_DEG = 10.0
CAP_DEG = 18.0
MEASURED = {"led_sigma": "0.2 mm", "lever_sigma": "0.2 mm"}  # of a laser tracker or a measuring arm
BY_FRAMES = {
    "led_sigma": "0.08 mm",
    "lever_sigma": "0.09 mm",
}  # left by `skysim survey`, docs/findings/dome.md
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
        "afit_simsat_ideal", {"light.layout": layout, "tracker.centroid_sigma_px": str(NOISE_PX)}
    )
    lab = build_lab(scene)
    trial = CentroidTrial(
        kind="centroids", noise_px=NOISE_PX, lights=lights, tilt_deg=(0, MAX_TILT_DEG)
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

    seeds : one list per survey: its seed, then the seeds of its attitudes
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
    results = {
        "across": RowResult(few.cross_boresight, cause=Cause(cause, many.cross_boresight)),
        "roll": RowResult(few.roll, cause=Cause(cause, many.roll)),
        "absolute": RowResult(
            measured, cause=Cause("LED positions surveyed with the camera's own frames", by_frames)
        ),
    }
    caption = (
        "Noise-equivalent angle by the number of lights in the field; dashed the published bounds."
    )
    return ExperimentResult(results, (FigureDrawing(caption, lambda fig: draw(fig, errors_by_lights)),))


def draw(fig: Any, errors_by_lights: dict[int, AttitudeErrors]) -> None:
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
        axes.axhline(rows[key].at_most, color=INK[n], ls="--", label=f"published bound, {name}")
    axes.set(xscale="log", yscale="log", xlabel="lights in the field", ylabel="error, rms (arcsec)")
    axes.set_xticks(lights, [str(count) for count in lights])
    axes.set_yticks(ARCSEC_TICKS, [f"{tick:g}" for tick in ARCSEC_TICKS])
    axes.minorticks_off()
    axes.legend(ncols=2, loc="center")


