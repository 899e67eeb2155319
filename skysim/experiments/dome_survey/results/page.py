"""The HTML page of a survey: what it found, its picture, residuals, predicted against reached, faults, next steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.io.files import write_text
from skysim.core.types import Floats
from skysim.experiments.dome_survey.survey_run import SurveyRun, residuals_px
from skysim.results.plots import INK, png
from skysim.results.report import embed, render_page

CELLS = 8  # across the chip, over which residuals are averaged
BINS = 60
TAIL = 0.005  # share of the residuals beyond each end of the histogram


def write_page(path: Path, statistics: dict[str, Any], run: SurveyRun, command: str) -> None:
    """Write one HTML file with its images embedded. statistics : as in `survey.json`"""
    reached = {
        "led_mm": 1e3 * run.accuracy.led_rms_m,
        "lever_mm": 1e3 * float(np.sqrt(np.mean(run.accuracy.lever_sigma_m**2))),
        "focal_px": float(run.accuracy.lens_sigma[0]),
    }
    text = render_page(
        "survey.html",
        title=f"Survey of {statistics['scene']}",
        command=command,
        survey=statistics,
        reached=reached,
        faults=fault_rows(statistics["faults"]),
        list_mm=1e3 * statistics["faults"]["list_sigma_m"],
        picture=embed(Path(statistics["picture"]).read_bytes()),
        residuals=embed(residual_figure(run)),
    )
    write_text(path, text)


def fault_rows(faults: dict[str, Any]) -> list[tuple[str, str, str]]:
    """LED, fault and details, one row a fault."""
    rows = [(str(led), "dark", "no frame shows it") for led in faults["dark"]]
    for led, off_m in faults["displaced"].items():
        rows.append((str(led), "displaced", f"{1e3 * off_m:.1f} mm from its place in the list, {place(faults, led)}"))
    for led, shows, others in faults["exchanged"]:
        alike = f" (or {', '.join(map(str, others))})" if others else ""
        rows.append((str(led), "exchanged", f"LED {shows}{alike} shines at its place, {place(faults, led)}"))
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
        draw_means(right, xy_px, residual_px, (run.survey.camera.width_px, run.survey.camera.height_px))

    return png(draw, (10, 4))


def draw_histogram(axes: Any, residual_px: Floats, noise_px: float) -> None:
    """Residual coordinates as a density, with the Gaussian of the noise: wider, as a fit takes up part of the noise."""
    end_px = float(np.quantile(np.abs(residual_px), 1 - TAIL))
    x_px = np.linspace(-end_px, end_px, 200)
    inside = residual_px[np.abs(residual_px) <= end_px]
    axes.hist(inside, BINS, weights=np.full(len(inside), BINS / (2 * end_px * len(residual_px))), color=INK[5])
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
    centers, means = centers[enough], means[enough]
    largest_px = float(np.linalg.norm(means, axis=1).max(initial=0)) or 1.0
    arrows = axes.quiver(*centers.T, *means.T, angles="xy", scale_units="xy", scale=2 * largest_px / width_px)
    axes.quiverkey(arrows, 0.85, 1.04, largest_px, f"{largest_px:.2g} px", labelpos="E")
    axes.set(xlim=(0, size_px[0]), ylim=(size_px[1], 0), aspect="equal", xlabel="x [px]", ylabel="y [px]")
    axes.set_title("mean residuals over the chip", loc="left")
