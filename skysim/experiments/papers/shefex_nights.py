"""SHEFEX-2's night-sky tests, end to end on rendered frames (Samaan & Theil 2011, sections 4 and 5).

Frames at random attitudes of the northern sky, with moonlit sky and atmospheric absorption or in space, go through
the paper's processing chain and through our default one. Varied: exposure time, rotation rate, focus.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.star_field import self_calibrate
from estimator.core.camera import Camera
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from estimator.trackers.star_tracker import StarTracker
from skysim.camera.detector import saturation_dn
from skysim.camera.glow import background
from skysim.camera.render import Window, render
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Frame, Trajectory, Truth
from skysim.experiments.papers.compare import (
    Cause,
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    RowResult,
    bootstrap_interval,
    format_summary,
    symmetric_interval,
)
from skysim.experiments.papers.shefex_setup import (
    PUBLISHED,
    apparent,
    plot_curve,
    processing_chain,
    shefex_lab,
    stars,
)
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.setups import TrialSetup
from skysim.experiments.study.plan import FrameTrial
from skysim.results import metrics
from skysim.results.metrics import Summary, exact, proportion
from skysim.scene.loader import load
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.tracking import factory, onboard_model

# SHEFEX-2's camera as rendered: field of view, smear length, peak loss by smear, defocus,
# calibrated focal length.


NOMINAL_FOCAL_MM = 25.0
TRUE_FOCAL_MM = 24.95
DEFOCUS_M = 1e-4
EXPOSURE_S = 0.05


def optics_results(options: ExperimentOptions) -> Results:
    """Answers that need no night-sky frames."""
    horizontal, vertical, diagonal = field_deg(
        onboard_model.calibration(shefex_lab().scene.camera)
    )
    absorbed = star_image(ground_lab(), 0.05).sum() / star_image(shefex_lab(), 0.035).sum()
    results: Results = {
        "field_h": exact(horizontal),
        "field_v": exact(vertical),
        "diagonal": RowResult(
            exact(diagonal), f"hypotenuse of both fields {np.hypot(horizontal, vertical):.3f}"
        ),
        "diagonal_true": exact(diagonal),
        "absorbed": exact(absorbed),
        "blur": exact(blur_px()),
        "focal": RowResult(*calibrated_focal_mm(options)),
    }
    for rate in (2, 4):
        results[f"smear_{rate}"] = exact(smear_px(rate))
        results[f"loss_{rate}"] = peak_loss(rate, options.trials(60, 5), options.seed)
    return results


def field_deg(camera: Camera) -> tuple[float, float, float]:
    """Horizontal, vertical and diagonal field of view in degrees, between the detector's outer edges and corners."""
    right = camera.width_px - 0.5
    bottom = camera.height_px - 0.5
    x, y = camera.center_px
    edges = [
        [(-0.5, y), (right, y)],
        [(x, -0.5), (x, bottom)],
        [(-0.5, -0.5), (right, bottom)],
    ]
    rays = [camera.rays(np.array(pair)) for pair in edges]
    return tuple(float(np.degrees(np.arccos(a @ b))) for a, b in rays)  # type: ignore[return-value]


@cache
def ground_lab() -> Lab:
    """The camera below an atmosphere that absorbs 30 %."""
    transmission = 0.7 * shefex_lab().scene.camera.gray_transmission
    return build_lab(load("shefex2", {"camera.transmission": str(transmission)}))


def star_image(
    lab: Lab, exposure_s: float, rate_deg_s: float = 0.0, place_rad: tuple[float, float] = (0.0, 0.0),
    axis_rad: float = 0.0,
) -> Floats:  # fmt: skip
    """(H, W) noise-free electrons of the catalog's brightest star alone, with the camera rotating across the boresight.

    Parameters
    ----------
    place_rad
        Offset of the star from the boresight, right and down, at mid-exposure
    axis_rad
        Direction of the rotation axis, from camera x towards y
    """
    brightest = lab.camera.sources.take(np.array([np.argmax(lab.camera.sources.strength)]))
    star_direction = brightest.place[0, :3]
    roll = Rotation.align_vectors([[0.0, 0.0, 1.0]], [star_direction])[0]
    cam_from_lab = Rotation.from_rotvec([-place_rad[1], place_rad[0], 0.0]) * roll
    # A rate about an axis in the image plane moves the star along a straight line.
    rate_cam = np.radians(rate_deg_s) * np.array([np.cos(axis_rad), np.sin(axis_rad), 0.0])
    lab_from_body = cam_from_lab.inv() * lab.camera.mount.cam_from_body
    rate_body = lab.camera.mount.cam_from_body.inv().apply(rate_cam)
    t_s = np.linspace(-0.01, exposure_s + 0.01, trials.KNOTS)
    path = lab_from_body * Rotation.from_rotvec(np.outer(t_s - exposure_s / 2, rate_body))
    image = np.zeros(lab.camera.canvas.shape)
    trajectory = Trajectory(t_s, path, np.tile(rate_body, (len(t_s), 1)))
    render(
        image,
        brightest,
        lab.camera.optics,
        trajectory,
        lab.camera.mount,
        Window(0.0, exposure_s),
    )
    return image


def variance_px2(image: Floats) -> Floats:
    """(2,) largest and smallest variance of an image about its centroid (eigenvalues of its second moments)."""
    y, x = np.indices(image.shape)
    total = image.sum()
    offset_px = np.stack([x - (image * x).sum() / total, y - (image * y).sum() / total])
    covariance = np.einsum("iyx,jyx,yx->ij", offset_px, offset_px, image) / total
    return np.linalg.eigvalsh(covariance)[::-1]


def smear_px(rate_deg_s: float) -> float:
    """Length L of a streak in pixels: smear along a line adds L^2 / 12 to the variance of the star at rest."""
    moving, at_rest = (
        variance_px2(star_image(shefex_lab(), EXPOSURE_S, rate))[0]
        for rate in (rate_deg_s, 0.0)
    )
    return math.sqrt(12 * (moving - at_rest))


def peak_loss(rate_deg_s: float, count: int, seed: int) -> RowResult:
    """Loss of the brightest pixel by smear in magnitudes, for a star centered on a pixel and moving along a row.

    The note gives the mean over random positions in the pixel and random directions.
    """
    rng = random_stream(seed, 4)
    pixel_rad = 1 / shefex_lab().camera.optics.camera.focal_px
    places = [((0.0, 0.0), np.pi / 2)]
    places += [
        (tuple(rng.uniform(-0.5, 0.5, 2) * pixel_rad), rng.uniform(0, 2 * np.pi))
        for _ in range(count)
    ]
    loss_mag = []
    for place, axis_rad in places:
        peaks = [
            star_image(shefex_lab(), EXPOSURE_S, rate, place, axis_rad).max()
            for rate in (0.0, rate_deg_s)
        ]
        loss_mag.append(2.5 * np.log10(peaks[0] / peaks[1]))
    mean_note = format_summary(bootstrap_interval(np.array(loss_mag[1:]), np.mean))
    return RowResult(
        exact(loss_mag[0]), f"mean over positions in the pixel and directions: {mean_note}"
    )


def blur_px() -> float:
    """Diameter D in pixels of a star's blur disk, 0.1 mm out of focus: a uniform disk adds D^2 / 16 per axis."""
    labs = build_lab(load("shefex2", out_of_focus(DEFOCUS_M))), shefex_lab()
    defocused, sharp = (variance_px2(star_image(one, EXPOSURE_S)).mean() for one in labs)
    return float(4 * np.sqrt(defocused - sharp))


def out_of_focus(defocus_m: float) -> dict[str, str]:
    """Overrides that put the detector defocus_m behind the focus of stars: the lens is focused at a finite distance.

    By the thin-lens equation, 1 / distance = 1 / f - 1 / (f + defocus).
    """
    focal_m = shefex_lab().scene.camera.focal_length_m
    return {"camera.focus": f"{1 / (1 / focal_m - 1 / (focal_m + defocus_m)):.9g} m"}


def calibrated_focal_mm(options: ExperimentOptions) -> tuple[Summary, str]:
    """Focal length in mm by our star-field calibration, of a 24.95 mm lens with a nominal 25 mm; with a note."""
    overrides = {"camera.focal_length": f"{TRUE_FOCAL_MM} mm", "exposure.time": "50 ms"}
    lab = build_lab(
        load("shefex2", overrides | {"exposure.first": "10 ms", "exposure.frames": "1"})
    )
    setup = TrialSetup(lab, build_tracker(lab.camera), FrameTrial(kind="frames"), "")
    nominal_camera = onboard_model.calibration(shefex_lab().scene.camera)
    detector = lab.scene.camera.detector
    settings = Settings(gain_e_dn=detector.gain_e_dn, saturation=saturation_dn(detector))
    first_seed = 1_000_000 * options.seed
    rendered = (
        trials.render_trial_frame(setup, first_seed + n)[0]
        for n in range(options.trials(40, 8))
    )
    frames = [
        detect_and_centroid(frame.image_dn, nominal_camera, settings, Clock())
        for frame in rendered
    ]

    def tracker(camera: Camera, uncertainty: float) -> StarTracker:
        return StarTracker(camera, stars(), apparent(stars()), settings, uncertainty)

    calibrated = self_calibrate(frames, tracker, nominal_camera, 0.01, EXPOSURE_S)
    mm_per_px = 1e3 * lab.scene.camera.pixel_m
    value = calibrated.camera.focal_px * mm_per_px
    half_width = 1.96 * mm_per_px * math.sqrt(calibrated.covariance[0, 0])
    note = f"from {len(frames)} frames, starting from {NOMINAL_FOCAL_MM:g} mm"
    return symmetric_interval(value, half_width, len(frames)), note


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

    Attributes
    ----------
    right_low_threshold
        Solved correctly by it with a threshold of LOW_SIGMA in place of SIGMA
    ours
        Solved correctly by our default chain
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
) -> Iterator[tuple[TrialSetup, Frame, Truth]]:
    """Yield frames at random attitudes of the northern sky, not near the Moon; the same attitudes for every rate."""
    lab = build_lab(load("shefex2", ONE_FRAME | overrides))
    trial = FrameTrial(kind="frames", rate_deg_s=rate_deg_s, dec_deg=NORTH_DEG)
    setup = TrialSetup(lab, build_tracker(lab.camera), trial, "")
    moon_direction = background.direction(*MOON_DEG)
    trial_seed = 1_000_000 * seed
    rendered = 0
    while rendered < count:
        trial_seed += 1
        lab_from_body = trials.random_attitude(setup, trials.streams(setup, trial_seed)[0])
        boresight = (lab_from_body * lab.camera.mount.cam_from_body.inv()).apply(
            [[0.0, 0.0, 1.0]]
        )
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
            processing_chain(CATALOG, sigma, setup.lab.scene.camera.focal_px).solve(
                frame.image_dn
            )
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
    rates, space_rates = (
        (QUICK_RATES, QUICK_RATES[:1]) if options.quick else (RATES, SPACE_RATES)
    )
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
        FigureDrawing(
            "Frames identified against the turning rate.", partial(draw_rates, results)
        ),
        FigureDrawing(
            "Fig. 11: a frame of 40 ms, its centroids and those identified.",
            partial(draw_frame, options.seed),
        ),
    )
    return ExperimentResult(frame_results(results) | optics_results(options), drawings)


def frame_results(results: dict[str, NightResults]) -> Results:
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
            np.mean([getattr(result, name) for result in by_exposure.values()], axis=0),
            np.mean,
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
        "centroids": Summary(float(median), float(fewest), float(most), len(centroids)),
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
            ours = [
                proportion(result.ours.sum(), len(result.ours)) for result in by_rate.values()
            ]
            plot_curve(axes, list(by_rate), ours, 2, f"{label}, our default chain")
    axes.axvspan(
        0, 2, color=PUBLISHED, alpha=0.25, lw=0, label="published: mostly identified"
    )
    axes.axvspan(4, 8, color=PUBLISHED, alpha=0.1, lw=0, label="published: rarely identified")
    axes.set(
        xlabel="turning rate (deg/s)",
        ylabel="frames identified",
        ylim=(0, 1.03),
        xlim=(-0.1, 8.1),
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
