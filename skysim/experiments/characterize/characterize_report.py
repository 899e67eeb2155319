"""The report of a characterized camera: its values, and figures of what they were fitted to."""

from __future__ import annotations

from typing import Any

import numpy as np

from skysim.experiments.characterize.night_sky import Night
from skysim.experiments.characterize.night_sky import ImageSize
from skysim.experiments.characterize.fixed_pattern import DarkCurrent
from skysim.experiments.characterize.photon_transfer import (BLACK, CURVATURE, FIRST_DARK, GAIN, LIGHT, model)
from skysim.experiments.characterize.sensor_fit import MeasuredSensor
from skysim.results.plots import INK, png
from skysim.results.report import Column, Facts, Figure, Items, Report, Section, Table, Verdict
from skysim.scene.sections.camera import CameraConfig


def characterize_report(
    statistics: dict[str, Any], config: CameraConfig, found: MeasuredSensor, night: Night | None
) -> Report:
    """The report of a characterized camera. statistics : as in `characterize.json`"""
    figures = [
        Figure(png(lambda fig: draw_transfer(fig.subplots(1, 2), found), SIZE_IN), TRANSFER_TEXT)
    ]
    if dark := found.dark:
        figures.append(Figure(png(lambda fig: draw_dark(fig.subplots(), dark), SIZE_IN), DARK_TEXT))
    if night:
        figures.append(
            Figure(png(lambda fig: draw_size(fig.subplots(), config, night), SIZE_IN), SIZE_TEXT)
        )
    values = value_table(statistics)
    blocks = [
        verdict(statistics, len(values.rows)),
        Items([f"unknown: {remark}" for remark in statistics["remarks"]], tone="bad"),
        Section("Figures", figures),
        Section("Values", [values, facts(statistics)]),
    ]
    return Report(f"{statistics['camera']}, measured", blocks)


def verdict(statistics: dict[str, Any], values: int) -> Verdict:
    """How many values are known, and how well the law of photon transfer holds."""
    unknown = len(statistics["remarks"])
    misfit = statistics["misfit"]
    text = (
        f"{values} values measured, {unknown} unknown; misfit of the photon transfer {misfit:.2f}"
    )
    return Verdict(f"{text} (1 if the law holds).", "warning" if unknown else "good")


def facts(statistics: dict[str, Any]) -> Facts:
    """The preset, and the conditions of the values."""
    celsius = statistics["temperature_c"]
    night = statistics["night"]
    rows = [
        ("for camera.preset", [statistics["preset"]]),
        ("dark current at", ["an unknown temperature" if celsius is None else f"{celsius:g} °C"]),
        (
            "linearity error",
            [f"{100 * statistics['linearity_error']:.2g} %, of 5 to 95 % of the saturation"],
        ),
        ("flicker of the lamp", [f"{100 * statistics['flicker']:.2g} %"]),
    ]
    if night:
        residuals = "" if night["rms_px"] is None else f", residuals {night['rms_px']:.2g} px rms"
        stars = f"{night['stars']} star images in {night['frames']} frames"
        rows.append(
            ("night", [f"{stars}, of which {night['identified']} were identified{residuals}"])
        )
    return Facts(rows)


def value_table(statistics: dict[str, Any]) -> Table:
    """The values with their intervals, and those of the camera's file."""
    columns = [Column("what", kind="text"), Column("measured", format=".5g"), Column("95 %")]
    columns += [Column("file", format=".5g"), Column("unit", kind="text")]
    values = statistics["values"] + (statistics["night"]["values"] if statistics["night"] else [])
    interval = "{low:.5g} to {high:.5g}"
    rows = [
        [row["what"], row["value"], interval.format(**row), row["file"], row["unit"]]
        for row in values
    ]
    return Table(columns, rows)


SIZE_IN = (10, 4)  # of a figure
TRANSFER_TEXT = (
    "Photon transfer: temporal variance against the mean signal, of darks and flats. Line: the fit; open: beyond it."
    " Right: the signal over that of a linear sensor with the same lamp, less 1; line: the fitted amplifier."
)
DARK_TEXT = (
    "Dark current of the pixels at the darks' temperature: bars measured, line expected "
    "(lognormal, hot pixels, noise)."
)
SIZE_TEXT = (
    "Size of the star images over the field, line: the fit; the principal point is at 0, "
    "the farthest corner at 1."
)


def draw_transfer(axes: Any, found: MeasuredSensor) -> None:
    """Variance against mean, and the linearity."""
    transfer = found.transfer
    (curve, line) = axes
    black = transfer.values[BLACK]
    curvature = transfer.values[CURVATURE]
    fitted = transfer.points
    beyond = [one for one in found.flats if one not in fitted]
    groups = (
        ("darks", [one for one in fitted if not one.lit], {"color": INK[1]}),
        ("flats", [one for one in fitted if one.lit], {"color": INK[0]}),
        ("flats beyond the fit", beyond, {"facecolor": "none", "edgecolor": INK[0]}),
    )
    for name, points, colors in groups:
        mean, variance = (
            np.array([getattr(one.moments, key) for one in points])
            for key in ("mean_dn", "variance_dn2")
        )
        curve.scatter(
            np.maximum(mean - black, 0.1), np.maximum(variance, 0.05), 18, label=name, **colors
        )
    expected_mean, expected_variance = model(fitted, transfer.values)
    order = np.argsort(expected_mean)
    curve.plot(
        np.maximum(expected_mean - black, 0.1)[order],
        expected_variance[order],
        color="0.4",
        zorder=0,
    )
    curve.set(xscale="log", yscale="log", xlabel="signal [DN]", ylabel="temporal variance [DN²]")
    curve.legend()
    plain_labels(curve.xaxis, curve.yaxis)
    flats = [one for one in fitted if one.lit] + beyond
    time_s = np.array([one.exposure_s for one in flats])
    signal = np.array([one.moments.mean_dn for one in flats]) - black
    linear = (transfer.values[LIGHT] + transfer.values[FIRST_DARK + flats[0].dark]) * time_s
    inside = signal < 0.98 * signal.max()
    line.scatter(linear[inside], 100 * (signal / linear - 1)[inside], 18, color=INK[0])
    x = np.linspace(0, linear[inside].max(), 50)
    line.plot(x, -100 * curvature * x, color="0.4", zorder=0)
    line.set(
        xlabel="signal of a linear sensor [DN]",
        ylabel="deviation [%]",
        title=f"{1 / transfer.values[GAIN]:.4g} e-/DN",
    )


def plain_labels(*axis: Any) -> None:
    """Label powers of ten as numbers: the style has no mathematical text."""
    from matplotlib.ticker import NullFormatter

    for one in axis:
        one.set_major_formatter("{x:g}")
        one.set_minor_formatter(NullFormatter())


def draw_dark(axes: Any, dark: DarkCurrent) -> None:
    """Density of the pixels' rates, hot ones too, measured and expected."""
    width = np.diff(dark.edges)
    measured = dark.counts[1:-1] / width
    expected = dark.expected[1:-1] / width
    axes.stairs(measured, dark.edges, color=INK[0], fill=True, alpha=0.4, label="measured")
    axes.plot((dark.edges[1:] + dark.edges[:-1]) / 2, expected, color=INK[1], label="expected")
    axes.set_xscale("symlog", linthresh=dark.mean.value)
    axes.set(yscale="log", xlabel="dark current [DN/s]", ylabel="pixels per DN/s")
    axes.legend()
    plain_labels(axes.xaxis, axes.yaxis)


def draw_size(axes: Any, config: CameraConfig, night: Night) -> None:
    """Standard deviation of the images against the distance from the principal point."""
    size: ImageSize = night.size
    center_px = night.lens.camera.center_px if night.lens else config.center_px
    rho = np.linalg.norm(size.used.xy_px - np.array(center_px), axis=1) / config.corner_px
    sigma_px = np.sqrt(size.used.variance_px2)
    axes.errorbar(
        rho,
        sigma_px,
        size.used.variance_sigma_px2 / (2 * sigma_px),
        fmt=".",
        color=INK[0],
        elinewidth=0.6,
    )
    x = np.linspace(0, 1, 60)
    axes.plot(x, np.hypot(size.sigma_px.value, size.corner_sigma_px.value * x), color=INK[1])
    axes.set(
        xlabel="distance from the principal point, of the corner's",
        ylabel="standard deviation [px]",
    )
