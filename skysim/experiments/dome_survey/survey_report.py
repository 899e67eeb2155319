"""The report of a survey: the dome from above, results with errors, faults, and the attitudes to hold next."""

import math
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import Lever, on_surface
from estimator.calibration.dome_survey import DomeSurvey
from estimator.core.camera import Camera
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import UP, Bools, Floats, Frame, Mount, Record, Truth, lengths, median
from skysim.experiments.dome_survey.adjust import lens_sigma
from skysim.experiments.dome_survey.survey_findings import (
    Coverage,
    SurveyRun,
    accuracy_statistics,
    fault_rows,
    fault_summary,
    residuals_px,
    rows_of_columns,
)
from skysim.experiments.dome_survey.survey_frames import CalibrationPrior
from skysim.results import metrics, scoring
from skysim.results.plots import INK, png
from skysim.results.report import (
    Block,
    Cell,
    Column,
    Facts,
    Figure,
    Report,
    Section,
    Table,
    Text,
    Verdict,
)
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.lab import Lab
from skysim.tracking import factory
from skysim.tracking.onboard_model import rows_of

SOLVED = "solved_attitudes.csv"
CELLS = 8  # number of cells across the chip in which residuals are averaged
BINS = 60
TAIL = 0.005  # fraction of the residuals beyond each end of the histogram
REACHED = {"led_mm": "LED place, mm", "lever_mm": "lever, mm", "focal_px": "focal length, px"}
MEASURED = (
    "{surveyed} of {leds} LEDs measured in {tied} of {frames} frames, to {led_mm:.2g} mm rms about each axis (1σ);"
    " {faults} faults."
)
FIT = (
    "{status}: {outliers} outliers, {rms_px:.2g} px rms residual; 1σ of an LED's place: median"
    " {led_sigma_mm_median:.2g} mm, worst {led_sigma_mm_worst:.2g} mm."
)
SEEN = (
    "{measured} of {leds} LEDs measured, {seen_once} seen once, {unseen} not seen; hold these {stops} attitudes"
    " next:"
)
TRUE_ERROR = (
    "True error of the LEDs: {led_mm_before:.2g} mm rms before, {led_mm_after:.2g} mm after (predicted {predicted} mm);"
    " {renamed} with another identity."
)
FILES = (
    ("map, for tracker.map", "leds.ecsv"),
    ("attitudes of the images", SOLVED),
    ("every number of this page", "survey.json"),
)


def survey_report(statistics: Record, run: SurveyRun, command: str) -> Report:
    """The report of a survey from the numbers of `survey.json`."""
    reached = accuracy_statistics(run.accuracy)
    faults = statistics["faults"]
    columns = [Column("LED"), "fault", "details"]
    rows = [row[:3] for row in fault_rows(faults)]
    dome = Figure(
        Path(statistics["picture"]).read_bytes(),
        "The dome from above: LED errors, faults, next attitudes.",
    )
    residuals = Figure(
        png(partial(draw_residuals, run), (10, 4)),
        "Residuals: their distribution, and their means over the chip.",
    )
    blocks = [
        verdict(statistics, 1e3 * run.accuracy.led_rms_m, len(rows)),
        Text(FIT.format(**statistics)),
        Facts([(name, [Cell(file, link=file)]) for name, file in FILES], on_terminal=False),
        Section("The dome", [dome]),
        Section("Residuals", [residuals]),
        Section("Camera and lever", [value_table(statistics)]),
        Section("Truth and survey", truth_blocks(statistics)),
        Section("Predicted and reached", [accuracy_table(statistics, reached)]),
        Section("Coverage and next attitudes", coverage_blocks(statistics)),
        Section("Faults", [Table(columns, rows), Text(fault_summary(faults))]),
    ]
    return Report(f"Survey of {statistics['scene']}", blocks, command)


def verdict(statistics: Record, led_mm: float, faults: int) -> Verdict:
    """Number of measured LEDs, their error, and number of faults."""
    text = MEASURED.format(**statistics | {"led_mm": led_mm, "faults": faults})
    return Verdict(text, "warning" if faults else "good")


def value_table(statistics: Record) -> Table:
    """Lens and lever before and after the survey, with the truth if it was simulated."""
    truth = statistics.get("truth")
    rows = []
    for row in statistics["values"]:
        what = row["what"]
        numbers = [row["believed"], row["found"], *([truth[what]] if truth else [])]
        before, found, *known = (
            f"{one:.5g}" if what[0] in "kp" else f"{one:.3f}" for one in numbers
        )
        rows += [[what, before, found, f"{row['sigma']:.2g}", *known]] if row["sigma"] else []
    heads = ["before", "found", "1σ"] + ["truth"] * bool(truth)
    return Table(["", *map(Column, heads)], rows)


def truth_blocks(statistics: Record) -> list[Block]:
    """The true errors of a simulated survey, and the tracker before and after it."""
    if not statistics.get("truth"):
        return []
    predicted = Column("", format=".2g").cell(statistics["predicted"]["led_mm"]).text
    text = TRUE_ERROR.format(**statistics | {"predicted": predicted})
    rows = []
    for when in ("before", "after"):
        one = statistics[when]
        errors = (
            one[f"{name}_arcsec_{kind}"]
            for name in ("cross", "roll")
            for kind in ("median", "worst")
        )
        rows.append([when, f"{one['solved']} / {one['stops']}", *errors])
    heads = ("cross, median", "worst", "roll, median", "worst")
    columns = [
        "the tracker",
        Column("solved"),
        *(Column(head, "″", ".3g") for head in heads),
    ]
    return [Text(text), Table(columns, rows)]


def accuracy_table(statistics: Record, reached: Record) -> Table:
    """Errors: predicted by the plan, by the covariance, true, and predicted with the next attitudes."""
    predicted = statistics.get("predicted")
    after = statistics.get("led_mm_after")
    columns = {
        "by the plan": predicted,
        "by this survey's covariance": reached,
        "true error, rms": {} if after is None else {"led_mm": after},
        "with the next attitudes": statistics["next_reaches"],
    }
    given = {head: one for head, one in columns.items() if one}
    rows = [
        [what, *(one.get(key) for one in given.values())] for key, what in REACHED.items()
    ]
    return Table(["1σ", *(Column(head, format=".3g") for head in given)], rows)


def coverage_blocks(statistics: Record) -> list[Block]:
    """The measured LEDs, the attitudes to hold next, and the accuracy predicted with them."""
    counts = statistics["coverage"]
    reaches = statistics["next_reaches"]
    stops = statistics["next"]
    seen = SEEN.format(**counts, stops=len(stops))
    with_them = f"With them: {reaches['measured']} measured"
    if reaches["led_mm"] is not None:
        with_them += f", to {reaches['led_mm']:.2g} mm rms about each axis"
    return [Text(seen), stop_table(stops), Text(f"{with_them}.")]


def stop_table(stops: list[Record]) -> Table:
    """Attitudes as roll, pitch and yaw, with tilt and number of LEDs."""
    names = ("roll", "pitch", "yaw", "tilt")
    rows = [
        [n, *(one[f"{name}_deg"] for name in names), one["leds"]]
        for n, one in enumerate(stops, 1)
    ]
    return Table(
        [Column(""), *(Column(name, "°", ".1f") for name in names), Column("LEDs")], rows
    )


def draw_residuals(run: SurveyRun, fig: Any) -> None:
    """Draw the residuals: their distribution against the Gaussian of their noise, and their means over the chip."""
    xy_px, residual_px = residuals_px(run)
    camera = run.survey.camera
    left, right = fig.subplots(1, 2)
    draw_histogram(left, residual_px.ravel(), run.noise_px)
    draw_means(right, xy_px, residual_px, (camera.width_px, camera.height_px))


def draw_histogram(axes: Any, residual_px: Floats, noise_px: float) -> None:
    """Draw the density of the residual coordinates, and the Gaussian of the noise.

    The Gaussian is wider, because the fit absorbs a part of the noise.
    """
    end_px = float(np.quantile(np.abs(residual_px), 1 - TAIL))
    x_px = np.linspace(-end_px, end_px, 200)
    inside = residual_px[np.abs(residual_px) <= end_px]
    axes.hist(
        inside,
        BINS,
        weights=np.full(len(inside), BINS / (2 * end_px * len(residual_px))),
        color=INK[5],
    )
    density = np.exp(-((x_px / noise_px) ** 2) / 2) / (noise_px * np.sqrt(2 * np.pi))
    axes.plot(x_px, density, color=INK[1], label=f"Gaussian of the noise, {noise_px:.2g} px")
    axes.set(xlabel="residual coordinate [px]", ylabel="density [1/px]", title="residuals")
    axes.locator_params(axis="x", nbins=5)
    axes.legend()


def draw_means(
    axes: Any, xy_px: Floats, residual_px: Floats, size_px: tuple[int, int]
) -> None:
    """Mean residuals in cells of the chip: a pattern is a distortion that the lens model lacks."""
    width_px = size_px[0] / CELLS
    cell = (xy_px // width_px).astype(np.int64)
    _, inverse, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.ravel()
    centers, means = (
        np.column_stack([np.bincount(inverse, one, len(count)) / count for one in values.T])
        for values in (xy_px, residual_px)
    )
    enough = count >= 5
    centers = centers[enough]
    means = means[enough]
    largest_px = float(lengths(means).max(initial=0)) or 1.0
    arrows = axes.quiver(
        *centers.T, *means.T, angles="xy", scale_units="xy", scale=2 * largest_px / width_px
    )
    axes.quiverkey(arrows, 0.85, 1.04, largest_px, f"{largest_px:.2g} px", labelpos="E")
    axes.set(
        xlim=(0, size_px[0]),
        ylim=(size_px[1], 0),
        aspect="equal",
        xlabel="x [px]",
        ylabel="y [px]",
    )
    axes.set_title("mean residuals over the chip", loc="left")


# Statistics, pictures of the dome, and the comparison of a simulated survey with the truth.


LENS = ("focal length px", "center x px", "center y px", "k1", "k2", "p1", "p2")
PARAMETERS = (*LENS, *(f"lever {axis} mm" for axis in "xyz"))


def compare_trackers(
    trackers: Mapping[str, factory.Estimator], frames: Iterable[tuple[Frame, Truth]]
) -> dict[str, Record]:
    """Numbers of stops and of solved ones, and the errors, of each tracker on the same frames, by name."""
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in trackers}
    stops = 0
    for frame, truth in frames:
        stops += 1
        for name, tracker in trackers.items():
            cam_from_ref = factory.solve_frame(tracker, frame).attitude.cam_from_ref
            if cam_from_ref is not None:
                cross, roll = metrics.cross_and_roll_rad(cam_from_ref, truth.cam_from_lab)
                errors[name].append((cross / ARCSEC_RAD, roll / ARCSEC_RAD))
    return {
        name: {"stops": stops, "solved": len(found), **scoring.error_statistics(found)}
        for name, found in errors.items()
    }


class LedErrors(NamedTuple):
    """The S surveyed LEDs: true positions (S, 3), position errors before and after the survey (S, 3), renamed (S,).

    If the map before the survey has two LEDs each closer to the other's true position, the survey may exchange their
    numbers. This does not affect an attitude, which depends on positions only. `after_m` is therefore the error from
    the nearest true LED, and `renamed` marks LEDs whose nearest true LED has another number.
    """

    true_m: Floats
    before_m: Floats
    after_m: Floats
    renamed: Bools


def led_errors(survey: DomeSurvey, prior: CalibrationPrior, lab: Lab) -> LedErrors:
    """LED position errors before and after the survey."""
    true_m = lab.camera.sources.xyz
    row = np.flatnonzero(survey.surveyed)
    position_m = survey.leds.position_m[row]
    _, nearest = cKDTree(true_m).query(position_m)
    before_m = prior.leds.position_m[row] - true_m[row]
    return LedErrors(true_m[row], before_m, position_m - true_m[nearest], nearest != row)


def survey_statistics(run: SurveyRun, before: CalibrationPrior) -> Record:
    """Statistics of a survey without the truth. `values` holds one row per lens and lever parameter that is fitted."""
    survey = run.survey
    sigma_mm = 1e3 * run.accuracy.led_sigma_m[survey.surveyed]
    lever_sigma_mm = 1e3 * run.accuracy.lever_sigma_m
    return {
        "status": survey.status,
        "tied": int(survey.tied.sum()),
        "leds": len(survey.surveyed),
        "surveyed": int(survey.surveyed.sum()),
        "outliers": len(survey.outliers),
        "rms_px": survey.rms_px,
        "noise_px": run.noise_px,
        "misfit": survey.misfit,
        "led_sigma_mm_median": median(sigma_mm),
        "led_sigma_mm_worst": float(sigma_mm.max()),
        "values": rows_of_columns(
            what=PARAMETERS,
            believed=parameters(before.camera, before.lever),
            found=parameters(survey.camera, survey.lever),
            sigma=[*lens_sigma(survey)[:7], *lever_sigma_mm],
        ),
    }


def truth_statistics(run: SurveyRun, before: CalibrationPrior, lab: Lab) -> Record:
    """The errors of a simulated survey: of the LEDs before and after it, and the true parameters."""
    errors = led_errors(run.survey, before, lab)
    truth = parameters(lab.scene.camera, lab.camera.mount)
    return {
        "renamed": int(errors.renamed.sum()),
        "led_mm_before": 1e3 * float(metrics.rms(errors.before_m.ravel())),
        "led_mm_after": 1e3 * float(metrics.rms(errors.after_m.ravel())),
        "truth": dict(zip(PARAMETERS, truth, strict=True)),
    }


def parameters(lens: Camera | CameraConfig, lever: Lever | Mount) -> list[float]:
    """The lens and the lever in the order of PARAMETERS."""
    lever_mm = (1e3 * np.asarray(lever.camera_body_m)).tolist()
    return [float(lens.focal_px), *lens.center_px, *lens.distortion[:4], *lever_mm]


def survey_figure(
    so_far: Coverage,
    faults: Record,
    further: Rotation,
    errors: LedErrors | None,
    run: SurveyRun,
) -> bytes:
    """PNG image: the coverage, and the LED errors before and after the survey, or else their shifts from the list."""
    row = np.flatnonzero(run.survey.surveyed)
    found_m = run.survey.leds.position_m[row]
    panels = [("found minus list", found_m, found_m - run.listed.position_m[row])]
    if errors is not None:
        panels = [
            ("error before the survey", errors.true_m, errors.before_m),
            ("after", errors.true_m, errors.after_m),
        ]

    def draw(fig: Any) -> None:
        first, *rest = fig.subplots(1, 1 + len(panels))
        draw_coverage(first, so_far, faults, further)
        for axes, panel in zip(rest, panels, strict=True):
            draw_errors(axes, *panel)

    return png(draw, (7 * (1 + len(panels)), 6.5))


def draw_coverage(axes: Any, so_far: Coverage, faults: Record, further: Rotation) -> None:
    """LEDs by their standard deviation, gray if not measured; faults; the numbers of the next attitudes."""
    from matplotlib.colors import LogNorm

    leds = so_far.model.leds
    measured = so_far.accuracy.measured
    x_m, y_m, _ = leds.position_m.T
    once = so_far.seen.any(axis=0) & ~measured
    unseen = ~measured & ~once

    def dots(which: Bools, name: str, **style: Any) -> Any:
        return axes.scatter(
            x_m[which], y_m[which], s=14, label=f"{name}: {which.sum()}", **style
        )

    dots(unseen, "not seen", facecolor="none", edgecolor="0.6")
    dots(once, "seen, not measured", color="0.75")
    if measured.any():
        sigma_mm = 1e3 * so_far.accuracy.led_sigma_m[measured]
        points = dots(measured, "measured", c=sigma_mm, norm=LogNorm())
        axes.figure.colorbar(
            points, ax=axes, label="standard deviation about each axis [mm]", shrink=0.8
        )
    numbers = faults | {"exchanged": [led for led, _, _ in faults["exchanged"]]}
    for name, marker, color in (
        ("dark", "x", "black"),
        ("displaced", "D", "magenta"),
        ("exchanged", "s", "red"),
    ):
        rows = rows_of(list(numbers[name]), leds.id)
        colors = (
            {"color": color} if marker == "x" else {"facecolor": "none", "edgecolor": color}
        )
        if len(rows):
            axes.scatter(x_m[rows], y_m[rows], 70, marker=marker, label=name, **colors)
        for led, at in zip(leds.id[rows], leds.position_m[rows, :2], strict=True):
            axes.annotate(str(led), at, (6, 6), textcoords="offset points", color=color)
    lever = so_far.model.lever
    toward = further.apply(lever.cam_from_body.inv().apply(UP)).reshape(-1, 3)
    for n, (u, attitude) in enumerate(zip(toward, further, strict=True)):
        at = on_surface(u[None], attitude.apply(lever.camera_body_m), leds)[0]
        axes.annotate(str(n + 1), at[:2], color="tab:blue", ha="center", weight="bold")
    axes.legend(loc="upper left", fontsize="small")
    axes.set(
        xlabel="x [m]",
        ylabel="y [m]",
        aspect="equal",
        title="coverage; blue: the attitudes to hold next",
    )


def draw_errors(axes: Any, title: str, place_m: Floats, error_m: Floats) -> None:
    """Arrows of LED errors; the scale is in the key, and color is the vertical error."""
    rms_mm = 1e3 * math.sqrt(np.mean(error_m**2))
    scale_mm = 1e3 * float(np.quantile(lengths(error_m), 0.95)) or 1.0
    x_m, y_m, _ = place_m.T
    arrows = axes.quiver(
        x_m, y_m, *(1e3 * error_m.T), angles="xy", scale=25 * scale_mm, cmap="coolwarm"
    )
    arrows.set_clim(-scale_mm, scale_mm)
    axes.quiverkey(arrows, 0.9, 1.03, scale_mm, f"{scale_mm:.2g} mm", labelpos="E")
    axes.set_title(f"{title}: {rms_mm:.2g} mm rms an axis", loc="left")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.figure.colorbar(arrows, ax=axes, label="z error [mm]", shrink=0.8)
