"""AFIT's later OLED dome: noise-equivalent angle and absolute error of the attitude with many small lights in view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from skysim.core.types import Floats
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import resampled
from skysim.experiments.papers.published import experiments
from skysim.experiments.study.plan import CentroidTrial
from skysim.experiments.study.setups import Setup
from skysim.experiments.study.trials import centroids
from skysim.results.metrics import Summary, rms
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.tracker import SurveyErrorsConfig
from skysim.simulation import testbed

NOISE_PX = 0.1
STATED_LIGHTS, MANY_LIGHTS = 20, 80
SPACING_MM = {10: 30, 20: 22, 40: 15.5, 80: 11}  # by number of lights; slightly more are in view
ARCSEC_TICKS = (0.2, 0.5, 1, 2, 5, 10)
TILT_DEG, CAP_DEG = 10.0, 18.0
MEASURED = {"led_sigma": "0.2 mm", "lever_sigma": "0.2 mm"}  # of a laser tracker or a measuring arm
BY_FRAMES = {
    "led_sigma": "0.08 mm",
    "lever_sigma": "0.09 mm",
}  # left by `skysim survey`, docs/findings/dome.md
LEVEL_SIGMA_DEG = 0.005  # orientation error of the survey's axes


class Spread(NamedTuple):
    """(N, 3) attitude errors about the camera's axes of N solved attitudes, arcsec; and the number attempted."""

    error_arcsec: Floats
    asked: int

    @property
    def across(self) -> Summary:
        """rms error about one axis across the boresight, from both axes."""
        return resampled(rms(self.error_arcsec[:, :2]), rms)

    @property
    def roll(self) -> Summary:
        """rms error about the boresight."""
        return resampled(self.error_arcsec[:, 2], rms)


def bench(lights: int) -> Setup:
    """AFIT's camera under its measured dome with randomly placed lights, of which at most `lights` are used."""
    layout = f'{{kind: poisson_disc, spacing: "{SPACING_MM[lights]} mm", cap_deg: {CAP_DEG}}}'
    told = loader.load("afit_simsat", {"light.layout": layout, "tracker.centroid_sigma_px": str(NOISE_PX)})
    lab = testbed.build_testbed(told)
    trial = CentroidTrial(kind="centroids", noise_px=NOISE_PX, lights=lights, tilt_deg=(0, TILT_DEG))
    return Setup(lab, testbed.tracker(lab), trial, "")


def spread(ready: Setup, seeds: Sequence[int]) -> Spread:
    """Errors of lost-in-space solutions from simulated centroids at random attitudes."""
    came = [centroids(ready, seed) for seed in seeds]
    off = np.array([[one.x_arcsec, one.y_arcsec, one.roll_arcsec] for one in came])
    return Spread(off[np.isfinite(off[:, 0])], len(came))


def surveyed(ready: Setup, sigmas: dict[str, str], seed: int) -> Setup:
    """The same dome with a tracker whose map comes from a survey with position errors and slightly rotated axes."""
    turn = np.random.default_rng([seed, 2]).normal(0, LEVEL_SIGMA_DEG, 3)
    told = SurveyErrorsConfig.model_validate(sigmas | {"turn_deg": turn.tolist(), "seed": seed})
    part = ready.lab.scene.tracker.model_copy(update={"survey": told})
    lab = replace(ready.lab, scene=ready.lab.scene.model_copy(update={"tracker": part}))
    return ready._replace(lab=lab, estimator=testbed.tracker(lab))


def absolute_deg(ready: Setup, sigmas: dict[str, str], seeds: list[list[int]]) -> Summary:
    """Mean error angle in degrees. The attitudes of one survey share its errors, so the interval is over surveys.

    seeds : one list per survey: its seed, then the seeds of its attitudes
    """
    off = [spread(surveyed(ready, sigmas, first), rest).error_arcsec for first, *rest in seeds]
    return resampled(np.array([np.mean(np.linalg.norm(one, axis=1)) for one in off]) / 3600, np.mean)


def dome(ask: Ask) -> Found:
    """Noise-equivalent angle with an exact map for several numbers of lights; absolute error with a surveyed map."""
    rng = np.random.default_rng([ask.seed, 76398981])
    counts = [STATED_LIGHTS, MANY_LIGHTS] if ask.quick else list(SPACING_MM)
    trials, spreads = ask.trials(600, 60), {}
    for n, lights in enumerate(counts):
        spreads[lights] = spread(bench(lights), rng.integers(2**31, size=trials).tolist())
        ask.watch(n + 1, len(counts) + 1)
    few, many = spreads[STATED_LIGHTS], spreads[MANY_LIGHTS]
    seeds = rng.integers(2**31, size=(ask.trials(40, 6), ask.trials(11, 5))).tolist()
    measured, by_frames = (
        absolute_deg(bench(STATED_LIGHTS), sigmas, seeds) for sigmas in (MEASURED, BY_FRAMES)
    )
    cause = f"{MANY_LIGHTS} lights in the field"
    answers = {
        "across": Answer(few.across, cause=Cause(cause, many.across)),
        "roll": Answer(few.roll, cause=Cause(cause, many.roll)),
        "absolute": Answer(measured, cause=Cause("places as surveyed by the camera's own frames", by_frames)),
    }
    caption = "Noise-equivalent angle by the number of lights in the field; dashed the published bounds."
    return Found(answers, (Drawing(caption, lambda fig: draw(fig, spreads)),))


def draw(fig: Any, spreads: dict[int, Spread]) -> None:
    """Both angles against the number of lights n, with a fitted line proportional to 1 / sqrt(n)."""
    axes, rows = fig.subplots(), experiments()["oled"].rows
    lights = np.array(list(spreads))
    for n, (key, name) in enumerate((("across", "across, one axis"), ("roll", "roll"))):
        found = [getattr(one, key) for one in spreads.values()]
        value = np.array([one.value for one in found])
        ends = np.array([[one.value - one.low, one.high - one.value] for one in found]).T
        axes.errorbar(lights, value, ends, fmt=MARKS[n], color=INK[n], capsize=3, label=f"ours, {name}")
        through = np.exp(np.mean(np.log(value * np.sqrt(lights))))
        axes.plot(lights, through / np.sqrt(lights), color=INK[n], lw=0.8)
        axes.axhline(rows[key].at_most, color=INK[n], ls="--", label=f"published bound, {name}")
    axes.set(xscale="log", yscale="log", xlabel="lights in the field", ylabel="error, rms (arcsec)")
    axes.set_xticks(lights, [str(one) for one in lights])
    axes.set_yticks(ARCSEC_TICKS, [f"{one:g}" for one in ARCSEC_TICKS])
    axes.minorticks_off()
    axes.legend(ncols=2, loc="center")
