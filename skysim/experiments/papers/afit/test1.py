"""AFIT's Test 1: nine equal LEDs of one board, imaged from five attitudes (Padro 2012, sections 3.7.1 and 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.calibration.home_position import pooled
from skysim.core.constants import INCH_M
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.dynamics import guidance
from skysim.experiments.papers.afit.test_stand import (
    build_test_stand,
    gray_levels,
    measure_frame,
    measure_lights,
    render_at_attitude,
    separations_arcsec,
)
from skysim.experiments.papers.compare import (
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    confidence_interval,
    with_cause,
)
from skysim.experiments.papers.published import published_values
from skysim.experiments.tracker_comparison import with_config
from skysim.results.metrics import exact
from skysim.results.plots import INK
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import SlewConfig
from skysim.simulation.lab import Lab
from skysim.simulation.lights.dome import known_light
from skysim.simulation.lights.light import LightPlan
from skysim.tracking import onboard_model

LEDS = 9
POSITIONS = 5
FULL_CYCLES_S = 36e-3  # four cycles of nine 1 ms slots
FRAME_TIME_S = 100e-3  # at 10 Hz: 11 1/9 cycles
INTENSITY_CD = 10.4e-3  # at FRAME_S; the mean magnitude of the nine is then the published one
PITCH_M = 8e-3
NEIGHBORS = ((1, 4), (3, 4), (4, 5), (4, 7))  # pairs of the central LED, in the scene's order
SQUARED_DISTANCES = (
    1.0,
    2.0,
    4.0,
    5.0,
    8.0,
)  # squared distances in a 3x3 lattice, in pitches
PAIR_COUNTS = (12, 8, 6, 8, 2)  # number of pairs at each of these distances
CAUSE = "100 ms, 11 1/9 cycles: one LED has a twelfth pulse"
GAP_ARCSEC = 100.0  # sorted angles with a larger gap are counted as distinct


def attitudes(scene: Scene) -> list[Rotation]:
    """The five attitudes of the scene's maneuver."""
    legs = [leg for leg in scene.motion.maneuver if isinstance(leg, SlewConfig)]
    return [guidance.start_attitude(scene.motion), *(guidance.attitude(leg) for leg in legs)]


def scene_with_exposure(time_s: float) -> Scene:
    """The scene with another exposure time, its LEDs scaled so that a frame has the same light."""
    scene = with_config(load("afit_test1_ideal"), "exposure", time_s=time_s)
    return with_config(scene, "light.led", intensity_cd=INTENSITY_CD * FRAME_TIME_S / time_s)


def take_board(lab: Lab, images: int, rng: np.random.Generator) -> Floats:
    """(n, 9) magnitudes of a board, sorted within each image, from images at each of the five attitudes.

    Images that do not show all nine LEDs are left out.
    """
    poses = [lab_from_body for lab_from_body in attitudes(lab.scene) for _ in range(images)]
    magnitudes = [measure_frame(lab, lab_from_body, rng).magnitude for lab_from_body in poses]
    return np.array([one for one in magnitudes if len(one) == LEDS])


def table_2(options: ExperimentOptions) -> ExperimentResult:
    """Table 2, and the five angles of Fig. 66."""
    boards = options.trials(24, 3)
    images = options.trials(5, 2)
    stands = [
        build_test_stand(scene_with_exposure(time_s))
        for time_s in (FULL_CYCLES_S, FRAME_TIME_S)
    ]
    runs: tuple[list[Floats], list[Floats]] = (
        [],
        [],
    )  # with full cycles, with the frame time
    for n in range(boards):
        options.watch(n, boards)
        hardware_seed = int(random_stream(options.seed, n).integers(2**31))
        for stage, lab in enumerate(stands):
            # The same board with nine other LEDs, by another hardware seed.
            scene = with_config(lab.scene, "light.layout", hardware_seed=hardware_seed)
            plan = LightPlan(scene, lab.camera.band, lab.vehicle, lab.camera.viewpoint, None)
            other_leds = lab.with_scene(scene).with_light(known_light(plan))
            rng = random_stream(options.seed, stage, n)
            runs[stage].append(take_board(other_leds, images, rng))
    found_arcsec = lattice_angles(
        stands[0], options.trials(20, 2), random_stream(options.seed, 2)
    )
    drawings = (
        FigureDrawing(
            "Table 2: magnitude by rank; a bar is a rank's standard deviation over the images of a board.",
            lambda fig: draw_ranks(fig, *runs),
        ),
        FigureDrawing(
            "Figs 64 and 65: magnitudes of one of our boards by rank, at an exposure of 100 ms.",
            lambda fig: draw_board(fig, runs[1][0]),
        ),
        FigureDrawing(
            "Fig. 66: angles of all 36 pairs; dashed, a perfect lattice of 8 mm at 48 in.",
            lambda fig: draw_angles(fig, found_arcsec),
        ),
    )
    return ExperimentResult(ranks(*runs) | separations(found_arcsec), drawings)


def ranks(full_cycles: Sequence[Floats], frame_time: Sequence[Floats]) -> Results:
    """Table 2: mean and pooled standard deviation of each rank, over boards, magnitudes scaled to the published mean;
    and the relative standard deviation among the nine LEDs of a board, percent."""
    published_mean = published_by_rank("mean").mean()
    results: Results = {}
    for name, statistic in (("mean", partial(np.mean, axis=0)), ("sd", pooled_std_by_rank)):
        ours, theirs = (
            np.array([published_mean / board.mean() * statistic(board) for board in boards])
            for boards in (full_cycles, frame_time)
        )
        for n in range(LEDS):
            results[f"{name}_{n + 1}"] = with_cause(
                CAUSE, confidence_interval, ours[:, n], theirs[:, n]
            )
    mean = np.array([board.mean(axis=0) for board in full_cycles])
    results["scatter"] = confidence_interval(
        100 * mean.std(axis=1, ddof=1) / mean.mean(axis=1)
    )
    return results


def published_by_rank(statistic: str) -> Floats:
    """(9,) published `mean` or `sd` of each rank's magnitude."""
    return published_values(
        "afit-table-2", *(f"{statistic}_{rank}" for rank in range(1, LEDS + 1))
    )


def pooled_std_by_rank(board: Floats) -> Floats:
    """(9,) standard deviation of each rank over all images."""
    rank = np.tile(np.arange(LEDS), len(board))
    return pooled(board.ravel(), rank, np.zeros_like(rank))


def lattice_angles(lab: Lab, images: int, rng: np.random.Generator) -> Floats:
    """(n, 36) angles of all pairs, ascending, by the thesis's scale: four spacings of the first image average 8 mm."""
    camera = onboard_model.assumed_camera(lab.scene)
    angles_arcsec: list[Floats] = []
    poses = [lab_from_body for lab_from_body in attitudes(lab.scene) for _ in range(images)]
    for lab_from_body in poses:
        frame, truth = render_at_attitude(lab, lab_from_body, rng)
        xy_px = measure_lights(gray_levels(frame, lab)).xy_px
        if not angles_arcsec:
            _, nearest = cKDTree(xy_px).query(truth.sources.xy_px)
            first, second = xy_px[nearest[np.transpose(NEIGHBORS)]]
            spacing_px = float(np.mean(np.linalg.norm(first - second, axis=1)))
            distance_m = lab.camera.sources.place[4, 2] - lab.camera.mount.camera_body_m[2]
            camera = camera.zoomed(spacing_px * distance_m / PITCH_M / camera.focal_px)
        angles_arcsec.append(np.sort(separations_arcsec(xy_px, lab, camera)))
    return np.array(angles_arcsec)


def separations(angles_arcsec: Floats) -> Results:
    """Number of distinct angles, and the five of them."""
    mean_arcsec = angles_arcsec.mean(axis=0)
    gaps = np.flatnonzero(np.diff(mean_arcsec) > GAP_ARCSEC) + 1
    results: Results = {"distinct": exact(len(gaps) + 1)}
    for n, columns in enumerate(
        np.split(angles_arcsec, np.cumsum(PAIR_COUNTS)[:-1], axis=1), 1
    ):
        means = columns.mean(axis=1).reshape(POSITIONS, -1).mean(axis=1)
        results[f"angle_{n}"] = confidence_interval(means)
    return results


def draw_ranks(fig: Any, full_cycles: Sequence[Floats], frame_time: Sequence[Floats]) -> None:
    axes = fig.subplots()
    rank = np.arange(1, LEDS + 1)
    published = published_by_rank("mean")
    for shift, ink, marker, name, boards in (
        (-0.15, INK[0], "s", "ours, whole cycles", full_cycles),
        (0.15, INK[2], "D", "ours, 100 ms", frame_time),
    ):
        mean = np.mean([board.mean(axis=0) for board in boards], axis=0)
        std = np.mean([pooled_std_by_rank(board) for board in boards], axis=0)
        scale = published.mean() / mean.mean()
        axes.errorbar(
            rank + shift,
            scale * mean,
            scale * std,
            fmt=marker,
            color=ink,
            capsize=2,
            label=name,
        )
    axes.errorbar(
        rank,
        published,
        published_by_rank("sd"),
        fmt="o",
        color=INK[1],
        capsize=2,
        label="published",
    )
    axes.set(xlabel="rank in the image", ylabel="magnitude", xticks=rank)
    axes.legend()


def draw_board(fig: Any, board: Floats) -> None:
    axes = fig.subplots()
    bins = np.linspace(board.min(), board.max(), 60)
    colors = [*INK, "#bbbbbb"]
    axes.hist(
        list(board.T),
        bins,
        stacked=True,
        color=colors,
        label=[str(n + 1) for n in range(LEDS)],
    )
    published = published_by_rank("mean")
    axes.plot(
        published,
        np.zeros(LEDS),
        "v",
        color="black",
        markersize=7,
        clip_on=False,
        label="published means",
    )
    axes.set(xlabel="magnitude", ylabel="images")
    axes.legend(title="rank", ncols=3, fontsize=7)


def draw_angles(fig: Any, angles_arcsec: Floats) -> None:
    axes = fig.subplots()
    axes.hist(angles_arcsec.ravel(), np.arange(1200, 4000, 20), color=INK[0], label="ours")
    # Angles about the bearing of two LEDs of the lattice, in a board at 48 in.
    angles_rad = 2 * np.arctan(PITCH_M * np.sqrt(SQUARED_DISTANCES) / 2 / (48 * INCH_M))
    for n, angle_arcsec in enumerate(np.degrees(angles_rad) * 3600):
        label = "8 mm lattice" if n == 0 else None
        axes.axvline(angle_arcsec, ls="--", color=INK[1], label=label)
    axes.set(xlabel="angle of a pair (arcsec)", ylabel="pairs in all images")
    axes.legend()
