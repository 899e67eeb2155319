"""SHEFEX-2's night-sky tests, end to end on rendered frames (Samaan & Theil 2011, sections 4 and 5).

Frames at random attitudes of the northern sky, with moonlit sky and atmospheric absorption or in space, go through
the paper's processing chain and through our default one. Varied: exposure time, rotation rate, focus.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple
import numpy as np
from scipy.spatial.transform import Rotation
from skysim.camera.glow import background
from skysim.core.types import Floats, Frame, Truth
from skysim.experiments.papers.compare import (Cause, Drawing, ExperimentOptions, ExperimentResult, RowResult)
from skysim.experiments.papers.compare import bootstrap_interval
from skysim.experiments.papers.shefex.shefex_optics import (DEFOCUS_M, optics_results, out_of_focus)
from skysim.experiments.papers.shefex.shefex_setup import (PUBLISHED, plot_curve, processing_chain)
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.setups import Setup
from skysim.experiments.study.plan import FrameTrial
from skysim.results import metrics
from skysim.results.metrics import Summary, proportion
from skysim.scene.loader import load
from skysim.simulation.lab import build_lab, build_tracker
from skysim.tracking import factory



MOON_DEG = (90.0, 20.0)  # right ascension, declination
FROM_MOON_DEG = 30.0
SKY = "{kind: sky, mag_arcsec2: 20}"
MOON = "{kind: moon, ra_deg: 90, dec_deg: 20, phase_angle_deg: 0, moon_zenith_deg: 40, field_zenith_deg: 30}"
ONE_FRAME = {"exposure.first": "10 ms", "exposure.frames": "1"}
ATMOSPHERE = {"camera.transmission": "0.595"}  # 30 % less than the scene's 0.85
MOONLESS = ATMOSPHERE | {"background": f"[{SKY}]"}
FULL_MOON = ATMOSPHERE | {"background": f"[{SKY}, {MOON}]"}
NORTH_DEG = (8.0, 90.0)  # declinations that culminate above 45 deg at Bremen
RATES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
QUICK_RATES = (0.0, 2.0, 4.0, 5.0)
SPACE_RATES = (0.0, 2.0, 4.0, 6.0)
SIGMA = 5.0
LOW_SIGMA = 4.0
CATALOG = "uniform"  # "processed using the uniform Hipparcos catalog"


class NightResults(NamedTuple):
    """Results of N frames, each (N,): solved correctly, solved wrongly, number of centroids, by the paper's chain.

    right_low_threshold : solved correctly by it with a threshold of LOW_SIGMA in place of SIGMA
    ours : solved correctly by our default chain
    """

    right: Floats
    wrong: Floats
    centroids: Floats
    right_low_threshold: Floats
    ours: Floats

    @property
    def success(self) -> Summary:
        """Success rate of the paper's chain."""
        return proportion(self.right.sum(), len(self.right))

    @property
    def note(self) -> str:
        """Wrong solutions, and the success rate of our default chain."""
        wrong = f"{int(self.wrong.sum())} of {len(self.wrong)} solved wrongly"
        return f"{wrong}; our default chain {self.ours.mean():.2f}"


def render_frames(
    overrides: dict[str, str], rate_deg_s: float, count: int, seed: int
) -> Iterator[tuple[Setup, Frame, Truth]]:
    """Yield frames at random attitudes of the northern sky, not near the Moon; the same attitudes for every rate."""
    lab = build_lab(load("shefex2", ONE_FRAME | overrides))
    trial = FrameTrial(kind="frames", rate_deg_s=rate_deg_s, dec_deg=NORTH_DEG)
    setup = Setup(lab, build_tracker(lab.camera), trial, "")
    moon_direction = background.direction(*MOON_DEG)
    trial_seed = 1_000_000 * seed
    rendered = 0
    while rendered < count:
        trial_seed += 1
        lab_from_body = trials.random_attitude(setup, trials.streams(setup, trial_seed)[0])
        boresight = (lab_from_body * lab.camera.mount.cam_from_body.inv()).apply([[0.0, 0.0, 1.0]])
        if background.angular_separation_deg(boresight, moon_direction)[0] < FROM_MOON_DEG:
            continue
        frame, truth, _ = trials.render_trial_frame(setup, trial_seed)
        rendered += 1
        yield setup, frame, truth


def process_frames(
    overrides: dict[str, str], rate_deg_s: float, count: int, seed: int
) -> NightResults:
    """Process frames with all chains."""
    rows = []
    for setup, frame, truth in render_frames(overrides, rate_deg_s, count, seed):
        paper, low_threshold = (
            processing_chain(CATALOG, sigma, setup.lab.scene.camera.focal_px).solve(frame.image_dn)
            for sigma in (SIGMA, LOW_SIGMA)
        )
        ours = factory.solve_frame(setup.estimator, frame).attitude
        right, right_low_threshold, ours_right = (
            is_right(one.cam_from_ref, truth) for one in (paper, low_threshold, ours)
        )
        wrong = paper.cam_from_ref is not None and not right
        rows.append((right, wrong, len(paper.centroids), right_low_threshold, ours_right))
    return NightResults(*np.array(rows, float).T)


def is_right(cam_from_ref: Rotation | None, truth: Truth) -> bool:
    """Return True if a frame is solved with an error below ten arc-minutes."""
    return cam_from_ref is not None and not metrics.is_wrong(
        (cam_from_ref * truth.cam_from_lab.inv()).magnitude()
    )


def night_results(options: ExperimentOptions) -> ExperimentResult:
    """Success rates at rest (35 to 50 ms, in space), against the rate, and out of focus; and the camera's optics."""
    rates, space_rates = (QUICK_RATES, QUICK_RATES[:1]) if options.quick else (RATES, SPACE_RATES)
    space = exposure_override(50)
    ground = FULL_MOON | space
    conditions: dict[str, tuple[dict[str, str], float]] = {
        **{f"ground {rate:g}": (ground, rate) for rate in rates},
        **{f"space {rate:g}": (space, rate) for rate in space_rates},
        "35 ms": (FULL_MOON | exposure_override(35), 0.0),
        "40 ms": (FULL_MOON | exposure_override(40), 0.0),
        "moonless": (MOONLESS | space, 0.0),
        "defocus": (ground | out_of_focus(DEFOCUS_M), 0.0),
        "half defocus": (ground | out_of_focus(DEFOCUS_M / 2), 0.0),
    }
    results: dict[str, NightResults] = {}
    for key, (overrides, rate) in conditions.items():
        results[key] = process_frames(overrides, rate, options.trials(150, 10), options.seed)
        options.watch(len(results), len(conditions))
    drawings = (
        Drawing("Frames identified against the turning rate.", partial(draw_rates, results)),
        Drawing(
            "Fig. 11: a frame of 40 ms, its centroids and those identified.",
            partial(draw_frame, options.seed),
        ),
    )
    return ExperimentResult(frame_results(results) | optics_results(options), drawings)


def frame_results(results: dict[str, NightResults]) -> dict[str, RowResult]:
    """Answers from the frames to the statements of sections 4 and 5."""
    at_rest = results["ground 0"]
    centroids = results["40 ms"].centroids
    fewest, median, most = np.quantile(centroids, [0.025, 0.5, 0.975], method="nearest")
    by_exposure = {"35 ms": results["35 ms"], "40 ms": results["40 ms"], "50 ms": at_rest}
    by_exposure_note = ", ".join(
        f"{result.success.value:.2f} at {name}" for name, result in by_exposure.items()
    )
    combined, combined_low_threshold = (
        bootstrap_interval(
            np.mean([getattr(result, name) for result in by_exposure.values()], axis=0), np.mean
        )
        for name in ("right", "right_low_threshold")
    )
    cause = Cause(f"a threshold of {LOW_SIGMA:g} sigma", combined_low_threshold)

    def success(key: str, other: str = "", name: str = "") -> RowResult:
        """Success rate under a condition; its note begins with the rate under another one."""
        note = f"{name} {results[other].success.value:.2f}; " if other else ""
        return RowResult(results[key].success, note + results[key].note)

    return {
        "ground_50": success("ground 0", "moonless", "without the Moon"),
        "ground": RowResult(combined, by_exposure_note, cause),
        "space": success("space 0"),
        "rate_2": success("ground 2"),
        "rate_5": success("ground 5", "ground 4", "at 4 deg/s"),
        "defocus": success("defocus", "half defocus", "at 0.05 mm"),
        "centroids": RowResult(Summary(float(median), float(fewest), float(most), len(centroids))),
    }


def exposure_override(exposure_ms: int) -> dict[str, str]:
    """Override of the exposure time."""
    return {"exposure.time": f"{exposure_ms} ms"}


def draw_rates(results: dict[str, NightResults], fig: Any) -> None:
    axes = fig.subplots()
    labels = {"ground": "ours, under air and Moon", "space": "ours, in space"}
    for n, (condition, label) in enumerate(labels.items()):
        by_rate = {
            float(key.split()[1]): result
            for key, result in results.items()
            if key.startswith(condition)
        }
        successes = [result.success for result in by_rate.values()]
        plot_curve(axes, list(by_rate), successes, n, f"{label}, the paper's chain")
        if n == 0:
            ours = [proportion(result.ours.sum(), len(result.ours)) for result in by_rate.values()]
            plot_curve(axes, list(by_rate), ours, 2, f"{label}, our default chain")
    axes.axvspan(0, 2, color=PUBLISHED, alpha=0.25, lw=0, label="published: mostly identified")
    axes.axvspan(4, 8, color=PUBLISHED, alpha=0.1, lw=0, label="published: rarely identified")
    axes.set(
        xlabel="turning rate (deg/s)", ylabel="frames identified", ylim=(0, 1.03), xlim=(-0.1, 8.1)
    )
    axes.legend(fontsize=8)


def draw_frame(seed: int, fig: Any) -> None:
    """Draw the first frame in which the paper's chain identifies at least eight stars, or the last of forty."""
    axes = fig.subplots()
    for setup, frame, _ in render_frames(FULL_MOON | exposure_override(40), 0.0, 40, seed):
        result = processing_chain(CATALOG, SIGMA, setup.lab.scene.camera.focal_px).solve(
            frame.image_dn
        )
        if len(result.observed) >= 8:
            break
    low, high = np.percentile(frame.image_dn, [50, 99.95])
    axes.imshow(frame.image_dn, cmap="gray_r", vmin=low, vmax=high, interpolation="none")
    xy_px = result.centroids.xy_px
    axes.scatter(
        *xy_px.T, s=130, facecolors="none", edgecolors="blue", label=f"{len(xy_px)} centroids"
    )
    identified_px = xy_px[result.observed]
    axes.scatter(
        *identified_px.T,
        s=45,
        facecolors="none",
        edgecolors="red",
        label=f"{len(identified_px)} identified",
    )
    axes.set(xlabel="x (px)", ylabel="y (px)")
    axes.grid(visible=False)
    fig.legend(*axes.get_legend_handles_labels(), loc="outside right upper")


