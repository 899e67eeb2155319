"""AFIT's Test 1: nine equal LEDs of one board, imaged from five attitudes (Padro 2012, sections 3.7.1 and 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.home_position import pooled
from skysim.core.types import Floats
from skysim.dynamics import guidance
from skysim.experiments.papers.afit.bench import changed, furnished, grey, measured, separations_arcsec, shot
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import mean_of
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import exact
from skysim.results.plots import INK
from skysim.scene.loader import load
from skysim.scene.motion import SlewConfig
from skysim.scene.scene import Scene
from skysim.simulation import testbed
from skysim.simulation.testbed import Testbed
from skysim.tracking import onboard_model

LEDS, POSITIONS = 9, 5
WHOLE_S, FRAME_S = 36e-3, 100e-3  # four cycles of nine 1 ms slots; the frame time at 10 Hz, 11 1/9 cycles
INTENSITY_CD = 10.4e-3  # at FRAME_S; the mean magnitude of the nine is then the published one
PITCH_M = 8e-3
NEIGHBOURS = ((1, 4), (3, 4), (4, 5), (4, 7))  # pairs of the central LED, in the scene's order
STEPS = (1.0, 2.0, 4.0, 5.0, 8.0)  # squared distances in a 3x3 lattice, in pitches
PAIRS = (12, 8, 6, 8, 2)  # number of pairs at each of these distances
GAP_ARCSEC = 100.0  # sorted angles with a larger gap are counted as distinct


class Board(NamedTuple):
    """A board's images: (n, 9) magnitudes, sorted within each image, and (n,) attitude number."""

    magnitude: Floats
    position: Floats


def attitudes(scene: Scene) -> list[Rotation]:
    """The five attitudes of the scene's maneuver."""
    legs = [leg for leg in scene.motion.manoeuvre if isinstance(leg, SlewConfig)]
    return [guidance.start(scene.motion), *(guidance.attitude(leg) for leg in legs)]


def exposed(time_s: float) -> Scene:
    """The scene with another exposure time, its LEDs scaled so that a frame has the same light."""
    scene = changed(load("afit_test1"), "exposure", time_s=time_s)
    return changed(scene, "light.led", intensity_cd=INTENSITY_CD * FRAME_S / time_s)


def another(lab: Testbed, hardware_seed: int) -> Testbed:
    """The same board with nine other LEDs, by another hardware seed."""
    scene = changed(lab.scene, "light.layout", hardware_seed=hardware_seed)
    return replace(lab, scene=scene, sources=testbed.light_sources(scene, lab.band))


def board(lab: Testbed, images: int, rng: np.random.Generator) -> Board:
    """Images from each of the five attitudes; those that do not show all nine LEDs are left out."""
    magnitude, position = [], []
    for number, lab_from_body in enumerate(attitudes(lab.scene)):
        for _ in range(images):
            found = measured(grey(shot(lab, lab_from_body, rng)[0], lab)).magnitude
            if len(found) == LEDS:
                magnitude.append(found)
                position.append(number)
    return Board(np.array(magnitude), np.array(position))


def nine(ask: Ask) -> Found:
    """Table 2, and the five angles of Fig. 66."""
    boards, images = ask.trials(24, 3), ask.trials(5, 2)
    labs = [furnished(exposed(time_s)) for time_s in (WHOLE_S, FRAME_S)]
    whole: list[Board] = []
    frame: list[Board] = []
    for n in range(boards):
        ask.watch(n, boards)
        for stage, (lab, found) in enumerate(zip(labs, (whole, frame), strict=True)):
            rng = np.random.default_rng([ask.seed, stage, n])
            found.append(
                board(another(lab, int(np.random.default_rng([ask.seed, n]).integers(2**31))), images, rng)
            )
    answers = ranks(whole, frame) | alike(whole)
    found_arcsec = lattice(labs[0], ask.trials(20, 2), np.random.default_rng([ask.seed, 2]))
    return Found(answers | separations(found_arcsec), drawings(whole, frame, found_arcsec))


def ranks(whole: Sequence[Board], frame: Sequence[Board]) -> dict[str, Answer]:
    """Table 2: mean and pooled standard deviation of each rank, over boards; magnitudes scaled to published mean."""
    level = told_mean()
    pairs = [[level / one.magnitude.mean() for one in runs] for runs in (whole, frame)]
    mean, deviation = (
        [
            np.array([k * figure(one) for k, one in zip(scales, runs, strict=True)])
            for scales, runs in zip(pairs, (whole, frame), strict=True)
        ]
        for figure in (by_rank, scatter)
    )
    answers: dict[str, Answer] = {}
    for n in range(LEDS):
        answers[f"mean_{n + 1}"] = of_frame(*(one[:, n] for one in mean))
        answers[f"sd_{n + 1}"] = of_frame(*(one[:, n] for one in deviation))
    return answers


def told_mean() -> float:
    """The published mean magnitude of all nine LEDs."""
    rows = experiments()["afit-table-2"].rows
    return float(np.mean([rows[f"mean_{rank}"].published or 0.0 for rank in range(1, LEDS + 1)]))


def by_rank(one: Board) -> Floats:
    """(9,) mean magnitude of each rank over all images."""
    return np.asarray(one.magnitude.mean(axis=0))


def of_frame(whole: Floats, frame: Floats) -> Answer:
    """Result for whole cycles, with the result for the camera's frame time as the cause."""
    return Answer(
        mean_of(whole), cause=Cause("100 ms, 11 1/9 cycles: one LED has a twelfth pulse", mean_of(frame))
    )


def scatter(one: Board) -> Floats:
    """(9,) standard deviation of each rank over all images."""
    rank = np.tile(np.arange(LEDS), len(one.magnitude))
    return pooled(one.magnitude.ravel(), rank, np.zeros_like(rank))


def alike(whole: Sequence[Board]) -> dict[str, Answer]:
    """Relative standard deviation among the nine LEDs of a board, percent."""
    mean = np.array([by_rank(one) for one in whole])
    return {"scatter": Answer(mean_of(100 * mean.std(axis=1, ddof=1) / mean.mean(axis=1)))}


def lattice(lab: Testbed, images: int, rng: np.random.Generator) -> Floats:
    """(n, 36) angles of all pairs, ascending, by the thesis's scale: four spacings of the first image average 8 mm."""
    camera = onboard_model.believed_camera(lab.scene)
    found: list[Floats] = []
    for lab_from_body in attitudes(lab.scene):
        for _ in range(images):
            frame, truth = shot(lab, lab_from_body, rng)
            xy_px = measured(grey(frame, lab)).xy_px
            if not found:
                name = [int(np.argmin(np.linalg.norm(xy_px - place, axis=1))) for place in truth.seen.xy_px]
                steps_px = [np.linalg.norm(xy_px[name[a]] - xy_px[name[b]]) for a, b in NEIGHBOURS]
                reach_m = lab.sources.place[4, 2] - lab.mount.camera_body_m[2]
                camera = camera.zoomed(float(np.mean(steps_px)) * reach_m / PITCH_M / camera.focal_px)
            found.append(np.sort(separations_arcsec(xy_px, lab, camera)))
    return np.array(found)


def separations(found_arcsec: Floats) -> dict[str, Answer]:
    """Number of distinct angles, and the five of them."""
    middle = found_arcsec.mean(axis=0)
    breaks = np.flatnonzero(np.diff(middle) > GAP_ARCSEC) + 1
    answers = {"distinct": Answer(exact(len(breaks) + 1))}
    for n, columns in enumerate(np.split(found_arcsec, np.cumsum(PAIRS)[:-1], axis=1), 1):
        answers[f"angle_{n}"] = Answer(mean_of(columns.mean(axis=1).reshape(POSITIONS, -1).mean(axis=1)))
    return answers


def drawings(whole: Sequence[Board], frame: Sequence[Board], found_arcsec: Floats) -> tuple[Drawing, ...]:
    return (
        Drawing(
            "Table 2: magnitude by rank; a bar is a rank's standard deviation over the images of a board.",
            lambda fig: draw_ranks(fig, whole, frame),
        ),
        Drawing(
            "Figs 64 and 65: magnitudes of one of our boards by rank, at an exposure of 100 ms.",
            lambda fig: draw_board(fig, frame[0]),
        ),
        Drawing(
            "Fig. 66: angles of all 36 pairs; dashed, a perfect lattice of 8 mm at 48 in.",
            lambda fig: draw_angles(fig, found_arcsec),
        ),
    )


def draw_ranks(fig: Any, whole: Sequence[Board], frame: Sequence[Board]) -> None:
    """Published magnitudes by rank, and ours with whole cycles and with the frame time."""
    rows, axes, rank = experiments()["afit-table-2"].rows, fig.subplots(), np.arange(1, LEDS + 1)
    told = [rows[f"mean_{n}"].published for n in rank]
    for shift, ink, mark, name, runs in (
        (-0.15, INK[0], "s", "ours, whole cycles", whole),
        (0.15, INK[2], "D", "ours, 100 ms", frame),
    ):
        mean = np.mean([by_rank(one) for one in runs], axis=0)
        bar = np.mean([scatter(one) for one in runs], axis=0)
        k = told_mean() / mean.mean()
        axes.errorbar(rank + shift, k * mean, k * bar, fmt=mark, color=ink, capsize=2, label=name)
    bar = [rows[f"sd_{n}"].published for n in rank]
    axes.errorbar(rank, told, bar, fmt="o", color=INK[1], capsize=2, label="published")
    axes.set(xlabel="rank in the image", ylabel="magnitude", xticks=rank)
    axes.legend()


def draw_board(fig: Any, one: Board) -> None:
    """Histograms of the magnitudes by rank."""
    axes = fig.subplots()
    bins = np.linspace(one.magnitude.min(), one.magnitude.max(), 60)
    shades = [*INK, "#bbbbbb"]
    axes.hist(
        list(one.magnitude.T), bins, stacked=True, color=shades, label=[str(n + 1) for n in range(LEDS)]
    )
    rows = experiments()["afit-table-2"].rows
    told = [rows[f"mean_{n}"].published for n in range(1, LEDS + 1)]
    axes.plot(told, np.zeros(LEDS), "v", color="black", markersize=7, clip_on=False, label="published means")
    axes.set(xlabel="magnitude", ylabel="images")
    axes.legend(title="rank", ncols=3, fontsize=7)


def draw_angles(fig: Any, found_arcsec: Floats) -> None:
    """Histogram of the angles, with those of a perfect lattice."""
    axes = fig.subplots()
    axes.hist(found_arcsec.ravel(), np.arange(1200, 4000, 20), color=INK[0], label="ours")
    for n, squared in enumerate(STEPS):
        axes.axvline(nominal_arcsec(squared), ls="--", color=INK[1], label="8 mm lattice" if n == 0 else None)
    axes.set(xlabel="angle of a pair (arcsec)", ylabel="pairs in all images")
    axes.legend()


def nominal_arcsec(squared: float) -> float:
    """Angle about the bearing of two LEDs sqrt(squared) pitches apart in a board at 48 in."""
    return float(np.degrees(2 * np.arctan(PITCH_M * np.sqrt(squared) / 2 / (48 * 0.0254))) * 3600)
