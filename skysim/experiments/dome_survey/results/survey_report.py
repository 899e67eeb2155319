"""The report of a survey: the dome from above, what was found and how well, faults, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.types import Floats
from skysim.experiments.dome_survey.results.findings import accuracy_statistics, fault_lines
from skysim.experiments.dome_survey.survey_run import SurveyRun, residuals_px
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

CELLS = 8  # across the chip, over which residuals are averaged
BINS = 60
TAIL = 0.005  # share of the residuals beyond each end of the histogram
REACHED = {"led_mm": "LED place, mm", "lever_mm": "lever, mm", "focal_px": "focal length, px"}
FIT = (
    "{status}: {outliers} outliers, {rms_px:.2g} px rms residual; 1σ of an LED's place: median"
    " {led_sigma_mm_median:.2g} mm, worst {led_sigma_mm_worst:.2g} mm."
)
FILES = (("map, for tracker.map", "leds.ecsv"), ("every number of this page", "survey.json"))


def survey_report(statistics: dict[str, Any], run: SurveyRun, command: str) -> Report:
    """The report of a survey. statistics : as in `survey.json`"""
    reached = accuracy_statistics(run.accuracy)
    dome = Figure(
        Path(statistics["picture"]).read_bytes(),
        "The dome from above: LED errors, faults, next attitudes.",
    )
    residuals = Figure(
        residual_figure(run), "Residuals: their distribution, and their means over the chip."
    )
    blocks = [
        verdict(statistics, 1e3 * run.accuracy.led_rms_m),
        Text(FIT.format(**statistics)),
        Facts([(name, [Cell(file, link=file)]) for name, file in FILES], on_terminal=False),
        Section("The dome", [dome]),
        Section("Residuals", [residuals]),
        Section("Camera and lever", [value_table(statistics)]),
        Section("Truth and survey", truth_blocks(statistics)),
        Section("Predicted and reached", [accuracy_table(statistics, reached)]),
        Section("Coverage and next attitudes", coverage_blocks(statistics)),
        Section("Faults", fault_blocks(statistics["faults"])),
    ]
    return Report(f"Survey of {statistics['scene']}", blocks, command)


def verdict(statistics: Mapping[str, Any], led_mm: float) -> Verdict:
    """How many LEDs were measured, how well, and the number of faults."""
    faults = len(fault_rows(statistics["faults"]))
    text = "{surveyed} of {leds} LEDs measured in {tied} of {frames} frames".format(**statistics)
    text += f", to {led_mm:.2g} mm rms about each axis (1σ); {faults} faults."
    return Verdict(text, "warning" if faults else "good")


def value_table(statistics: dict[str, Any]) -> Table:
    """Lens and lever before and after the survey, and in truth if it was simulated."""
    truth = statistics.get("truth")
    rows = []
    for row in statistics["values"]:
        what = row["what"]
        numbers = [row["believed"], row["found"], *([truth[what]] if truth else [])]
        before, found, *known = (
            f"{one:.5g}" if what[0] in "kp" else f"{one:.3f}" for one in numbers
        )
        rows += [[what, before, found, f"{row['sigma']:.2g}", *known]] if row["sigma"] else []
    return Table(
        [
            Column("", kind="text"),
            *map(Column, ["before", "found", "1σ", *["truth"] * bool(truth)]),
        ],
        rows,
    )


def truth_blocks(statistics: dict[str, Any]) -> list[Block]:
    """The true errors of a simulated survey, and the tracker before and after it."""
    if not statistics.get("truth"):
        return []
    predicted = Column("", format=".2g").cell(statistics["predicted"]["led_mm"]).text
    text = (
        f"True error of the LEDs: {statistics['led_mm_before']:.2g} mm rms before, {statistics['led_mm_after']:.2g} mm"
        f" after (predicted {predicted} mm); {statistics['renamed']} with another identity."
    )
    errors = (
        "cross_arcsec_median",
        "cross_arcsec_worst",
        "roll_arcsec_median",
        "roll_arcsec_worst",
    )
    trackers = [(when, statistics[when]) for when in ("before", "after")]
    rows = [
        [when, f"{one['solved']} / {one['stops']}", *(one[key] for key in errors)]
        for when, one in trackers
    ]
    heads = ("cross, median", "worst", "roll, median", "worst")
    columns = [
        Column("the tracker", kind="text"),
        Column("solved"),
        *(Column(head, "″", ".3g") for head in heads),
    ]
    return [Text(text), Table(columns, rows)]


def accuracy_table(statistics: dict[str, Any], reached: Mapping[str, Any]) -> Table:
    """Errors by the plan, by this survey's covariance, in truth, and with the next attitudes."""
    predicted = statistics.get("predicted")
    after = statistics.get("led_mm_after")
    columns = {"by the plan": predicted} if predicted else {}
    columns["by this survey's covariance"] = reached
    columns |= {"true error, rms": {"led_mm": after}} if after is not None else {}
    columns["with the next attitudes"] = statistics["next_reaches"]
    rows = [[what, *(one.get(key) for one in columns.values())] for key, what in REACHED.items()]
    return Table(
        [Column("1σ", kind="text"), *(Column(head, format=".3g") for head in columns)], rows
    )


def coverage_blocks(statistics: dict[str, Any]) -> list[Block]:
    """Which LEDs are measured, the attitudes to hold next, and what those will reach."""
    counts = statistics["coverage"]
    reaches = statistics["next_reaches"]
    stops = statistics["next"]
    seen = (
        f"{counts['measured']} of {counts['leds']} LEDs measured, {counts['seen_once']} seen once, {counts['unseen']}"
        f" not seen; hold these {len(stops)} attitudes next:"
    )
    with_them = f"With them: {reaches['measured']} measured"
    if reaches["led_mm"] is not None:
        with_them += f", to {reaches['led_mm']:.2g} mm rms about each axis"
    return [Text(seen), stop_table(stops), Text(f"{with_them}.")]


def stop_table(stops: list[dict[str, Any]]) -> Table:
    """Attitudes as roll, pitch and yaw, with tilt and number of LEDs."""
    names = ("roll", "pitch", "yaw", "tilt")
    rows = [
        [n, *(one[f"{name}_deg"] for name in names), one["leds"]] for n, one in enumerate(stops, 1)
    ]
    return Table([Column(""), *(Column(name, "°", ".1f") for name in names), Column("LEDs")], rows)


def fault_blocks(faults: dict[str, Any]) -> list[Block]:
    """The faults as a table; their numbers, the error of the list's other places, and which exchanges can be found."""
    columns = [Column("LED"), Column("fault", kind="text"), Column("details", kind="text")]
    *_, counts = fault_lines(faults)
    return [Table(columns, fault_rows(faults)), Text(counts)]


def fault_rows(faults: dict[str, Any]) -> list[tuple[str, str, str]]:
    """LED, fault and details, one row a fault."""
    rows = [(str(led), "dark", "no frame shows it") for led in faults["dark"]]
    for led, off_m in faults["displaced"].items():
        rows.append(
            (
                str(led),
                "displaced",
                f"{1e3 * off_m:.1f} mm from its place in the list, {place(faults, led)}",
            )
        )
    for led, shows, others in faults["exchanged"]:
        alike = f" (or {', '.join(map(str, others))})" if others else ""
        rows.append(
            (str(led), "exchanged", f"LED {shows}{alike} shines at its place, {place(faults, led)}")
        )
    rows += [("", "not in the list", f"a light at {coordinates(at)}") for at in faults["unlisted"]]
    return rows


def place(faults: dict[str, Any], led: int) -> str:
    """Where an LED with a fault was found."""
    return f"at {coordinates(faults['found_m'][led])}"


def coordinates(place_m: list[float]) -> str:
    """A place in millimeters."""
    return f"({', '.join(f'{1e3 * one:.1f}' for one in place_m)}) mm"


def residual_figure(run: SurveyRun) -> bytes:
    """PNG of the residuals: their distribution against the Gaussian of their noise, and their means over the chip."""
    xy_px, residual_px = residuals_px(run)

    def draw(fig: Any) -> None:
        left, right = fig.subplots(1, 2)
        draw_histogram(left, residual_px.ravel(), run.noise_px)
        draw_means(
            right, xy_px, residual_px, (run.survey.camera.width_px, run.survey.camera.height_px)
        )

    return png(draw, (10, 4))


def draw_histogram(axes: Any, residual_px: Floats, noise_px: float) -> None:
    """Residual coordinates as a density, with the Gaussian of the noise: wider, as a fit takes up part of the noise."""
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


def draw_means(axes: Any, xy_px: Floats, residual_px: Floats, size_px: tuple[int, int]) -> None:
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
    largest_px = float(np.linalg.norm(means, axis=1).max(initial=0)) or 1.0
    arrows = axes.quiver(
        *centers.T, *means.T, angles="xy", scale_units="xy", scale=2 * largest_px / width_px
    )
    axes.quiverkey(arrows, 0.85, 1.04, largest_px, f"{largest_px:.2g} px", labelpos="E")
    axes.set(
        xlim=(0, size_px[0]), ylim=(size_px[1], 0), aspect="equal", xlabel="x [px]", ylabel="y [px]"
    )
    axes.set_title("mean residuals over the chip", loc="left")
