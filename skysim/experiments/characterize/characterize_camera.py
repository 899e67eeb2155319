"""Make a camera preset from folders of frames: read and check them, estimate its values, write preset and report."""

import copy
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core import files
from skysim.core.errors import InputError, printable
from skysim.core.types import Record, joined, lengths, median, taken
from skysim.experiments.characterize import frame_files, night_sky, sensor_fit
from skysim.experiments.characterize.fixed_pattern import DarkCurrent
from skysim.experiments.characterize.night_sky import LENS, Night, lens_estimates
from skysim.experiments.characterize.photon_transfer import (
    BLACK,
    CURVATURE,
    FIRST_DARK,
    GAIN,
    LIGHT,
    Estimate,
    interval_digits,
    interval_text,
    model,
)
from skysim.experiments.characterize.sensor_fit import MeasuredSensor
from skysim.results.plots import INK, png
from skysim.results.report import (
    Cell,
    Column,
    Facts,
    Figure,
    Items,
    Report,
    Section,
    Table,
    Verdict,
)
from skysim.scene import loader
from skysim.scene.camera_sheet import PLACEHOLDER_LENS, SheetLine, yaml_lines
from skysim.scene.sections.camera import CameraConfig, GaussianPsfConfig

# The report of a characterized camera: its values, and figures of the data with the fits.


def characterize_report(
    statistics: Record,
    config: CameraConfig,
    found: MeasuredSensor,
    night: Night | None,
) -> Report:
    """The report of a characterized camera from the numbers of `characterize.json`."""
    drawn = [(partial(draw_transfer, found), TRANSFER_TEXT)]
    if found.dark:
        drawn.append((partial(draw_dark, found.dark), DARK_TEXT))
    if night:
        drawn.append((partial(draw_size, config, night), SIZE_TEXT))
    figures = [Figure(png(draw, SIZE_IN), text) for draw, text in drawn]
    values = value_table(statistics)
    blocks = [
        verdict(statistics, len(values.rows)),
        Items([f"unknown: {remark}" for remark in statistics["remarks"]], tone="bad"),
        Section("Figures", figures),
        Section("Values", [values, facts(statistics)]),
    ]
    return Report(f"{statistics['camera']}, measured", blocks)


def verdict(statistics: Record, values: int) -> Verdict:
    """How many values are known, and how well the law of photon transfer holds."""
    unknown = len(statistics["remarks"])
    misfit = statistics["misfit"]
    text = f"{values} values measured, {unknown} unknown; misfit of the photon transfer {misfit:.2f}"
    return Verdict(f"{text} (1 if the law holds).", "warning" if unknown else "good")


def facts(statistics: Record) -> Facts:
    """The preset, and the conditions of the values."""
    celsius = statistics["temperature_c"]
    rows = [
        ("for camera.preset", [statistics["preset"]]),
        (
            "dark current at",
            ["an unknown temperature" if celsius is None else f"{celsius:g} °C"],
        ),
        (
            "linearity error",
            [f"{100 * statistics['linearity_error']:.2g} %, of 5 to 95 % of the saturation"],
        ),
        ("flicker of the lamp", [f"{100 * statistics['flicker']:.2g} %"]),
        ("drift between flats", [f"{100 * statistics['drift']:.2g} %"]),
    ]
    if night := statistics["night"]:
        rms_px = night["rms_px"]
        residuals = "" if rms_px is None else f", residuals {rms_px:.2g} px rms"
        stars = f"{night['stars']} star images in {night['frames']} frames"
        rows.append(
            ("night", [f"{stars}, of which {night['identified']} were identified{residuals}"])
        )
    return Facts(rows)


def value_table(statistics: Record) -> Table:
    """The measured values with their intervals, beside the values of the camera's file."""
    columns = [
        "what",
        Column("measured"),
        Column("95 %"),
        Column("file", format=".5g"),
        "unit",
    ]
    night = statistics["night"]
    rows = []
    for row in statistics["values"] + (night["values"] if night else []):
        low, high = row["low"], row["high"]
        value = Cell(f"{row['value']:.{interval_digits(low, high)}g}", key=row["value"])
        rows.append([row["what"], value, interval_text(low, high), row["file"], row["unit"]])
    return Table(columns, rows)


SIZE_IN = (10, 4)  # width and height of a figure
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


def draw_transfer(found: MeasuredSensor, fig: Any) -> None:
    """Variance against mean, and the linearity."""
    transfer = found.transfer
    curve, line = fig.subplots(1, 2)
    black = transfer.values[BLACK]
    curvature = transfer.values[CURVATURE]
    fitted = transfer.points
    fitted_flats = taken(fitted, fitted.lit > 0)
    beyond = taken(found.flats, found.flats.mean_dn > fitted_flats.mean_dn.max())
    groups = (
        ("darks", taken(fitted, fitted.lit == 0), {"color": INK[1]}),
        ("flats", fitted_flats, {"color": INK[0]}),
        ("flats beyond the fit", beyond, {"facecolor": "none", "edgecolor": INK[0]}),
    )
    for name, points, colors in groups:
        signal = np.maximum(points.mean_dn - black, 0.1)
        curve.scatter(signal, np.maximum(points.variance_dn2, 0.05), 18, label=name, **colors)
    expected_mean, expected_variance = model(fitted, transfer.values)
    order = np.argsort(expected_mean)
    x = np.maximum(expected_mean[order] - black, 0.1)
    curve.plot(x, expected_variance[order], color="0.4", zorder=0)
    curve.set(
        xscale="log", yscale="log", xlabel="signal [DN]", ylabel="temporal variance [DN²]"
    )
    curve.legend()
    flats = joined([fitted_flats, beyond])
    signal = flats.mean_dn - black
    rate = transfer.values[LIGHT] + transfer.values[FIRST_DARK + flats.dark]
    linear = rate * flats.exposure_s
    inside = signal < 0.98 * signal.max()
    line.scatter(linear[inside], 100 * (signal / linear - 1)[inside], 18, color=INK[0])
    x = np.linspace(0, linear[inside].max(), 50)
    line.plot(x, -100 * curvature * x, color="0.4", zorder=0)
    line.set(
        xlabel="signal of a linear sensor [DN]",
        ylabel="deviation [%]",
        title=f"{1 / transfer.values[GAIN]:.4g} e-/DN",
    )


def draw_dark(dark: DarkCurrent, fig: Any) -> None:
    """Density of the dark rates of all pixels, hot ones included: measured and expected."""
    axes = fig.subplots()
    width = np.diff(dark.edges)
    measured = dark.counts[1:-1] / width
    expected = dark.expected[1:-1] / width
    axes.stairs(measured, dark.edges, color=INK[0], fill=True, alpha=0.4, label="measured")
    axes.plot(
        (dark.edges[1:] + dark.edges[:-1]) / 2, expected, color=INK[1], label="expected"
    )
    axes.set_xscale("symlog", linthresh=dark.mean.value)
    axes.set(yscale="log", xlabel="dark current [DN/s]", ylabel="pixels per DN/s")
    axes.legend()


def draw_size(config: CameraConfig, night: Night, fig: Any) -> None:
    """Standard deviation of the images against the distance from the principal point."""
    axes = fig.subplots()
    size = night.size
    center_px = night.lens.camera.center_px if night.lens else config.center_px
    rho = lengths(size.used.xy_px - np.array(center_px)) / config.corner_px
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


# A camera preset: the file of the camera that took the frames, with its values replaced by the measured ones.


DIGITS = 6
Stated = dict[str, tuple[Any, str]]  # value and comment by key


def measured(sensor: MeasuredSensor) -> Stated:
    """Value and comment by key of the section camera; an estimate below 0 becomes 0."""
    found = {
        f"detector.{key}": stated(one._replace(value=max(one.value, 0.0)))
        for key, one in sensor.estimates.items()
    }
    celsius = sensor.dark_temperature_c
    if celsius is not None:
        found["detector.dark_temperature_c"] = (rounded(celsius), "[M] of the darks")
    else:
        why = "the darks' temperature is unknown: dark_e_s is at it"
        found["detector.temperature_c"] = (None, why)
    found["detector.reset_noise_e"] = (0.0, "[M] contained in read_noise_e")
    return found


def measured_lens(config: CameraConfig, night: Night) -> Stated:
    """Value and comment by key of the lens."""
    size = night.size
    found: Stated = {
        "psf.kind": ("gaussian", "[M]"),
        "psf.sigma_px": stated(size.sigma_px),
        "psf.corner_sigma_px": stated(size.corner_sigma_px),
    }
    if night.lens is None:
        return found
    lens = lens_estimates(config, night.lens)
    focal = lens["focal_length_mm"]
    x, y, *distortion = (lens[name] for name in LENS[1:])
    points = f"{comment(x)}, {interval_text(y.low, y.high)}"
    return found | {
        "focal_length": (
            f"{focal.value:.7g} mm",
            f"[M] {focal.low:.7g} to {focal.high:.7g} mm",
        ),
        "principal_point_px": ([rounded(x.value), rounded(y.value)], points),
        "distortion": (
            [rounded(one.value) for one in distortion],
            ", ".join(f"k{n} {comment(one)}" for n, one in enumerate(distortion, start=1)),
        ),
    }


def stated(one: Estimate) -> tuple[Any, str]:
    """An estimate's value and comment."""
    return rounded(one.value), comment(one)


def comment(one: Estimate) -> str:
    return f"[M] {interval_text(one.low, one.high)}"


def rounded(value: float) -> float:
    """The value to DIGITS significant digits."""
    return float(f"{value:.{DIGITS}g}")


def lines(camera: Record, found: Stated) -> Iterator[SheetLine]:
    """The lines of the section, with measured values in place of the camera's own; subsections come last."""
    tree = copy.deepcopy(dict(camera))
    if "psf.kind" in found:
        tree["psf"] = {}  # keys of another kind
    for key, (value, _) in found.items():
        section, _, last = key.rpartition(".")
        (tree.setdefault(section, {}) if section else tree)[last] = value
    yield from section_lines(tree, "", found)


def section_lines(section: Record, prefix: str, found: Stated) -> Iterator[SheetLine]:
    """The lines of a section: its values, then its subsections."""
    for key, value in sorted(section.items(), key=lambda item: isinstance(item[1], dict)):
        if isinstance(value, dict):
            yield from section_lines(value, f"{prefix}{key}.", found)
        else:
            _, source = found.get(prefix + key, (value, "of the camera's file"))
            yield SheetLine(prefix + key, value, source)


UNITS = {
    "gain_e_dn": "e-/DN",
    "offset_dn": "DN",
    "read_noise_e": "e-",
    "full_well_e": "e-",
    "dark_e_s": "e-/s",
    "dark_doubling_c": "K",
    "hot_e_s": "e-/s",
    "column_offset_e": "e-",
    "sigma_px": "px",
    "corner_sigma_px": "px",
    "focal_length_mm": "mm",
    "center_x_px": "px",
    "center_y_px": "px",
}


def read_camera(name: str) -> tuple[CameraConfig, Record]:
    """The camera of a preset, a camera file or a scene, and its raw section. Raises InputError."""
    path = loader.preset_path(name) if name in loader.list_cameras() else loader.find(name)
    camera = loader.load_camera(path, PLACEHOLDER_LENS)
    tree, files = loader.read(path)
    return camera, loader.camera_tree(path, tree, files, {})["camera"]


def measure_sensor(
    camera: CameraConfig, darks_folder: Path, flats_folder: Path
) -> MeasuredSensor:
    """The sensor from folders of darks and flats. Raises InputError for frames that cannot be used."""
    shape = (camera.height_px, camera.width_px)
    bits = camera.detector.bits
    darks = frame_files.read_stack(darks_folder, shape, bits)
    frame_files.check_darks(darks_folder, darks)
    flats = frame_files.read_stack(flats_folder, shape, bits)
    usable = sensor_fit.usable_pixels(darks)
    shortest = min(darks, key=lambda one: one.exposure_s)
    black_dn = median(shortest.mean_dn)
    frame_files.check_flats(flats_folder, flats, usable, black_dn)
    return sensor_fit.characterize(darks, flats)


def measure_night(
    config: CameraConfig, raw: Record, folder: Path, found: MeasuredSensor
) -> Night:
    """The lens from a folder of night frames. Raises InputError for a camera without a lens, or unusable frames."""
    if "focal_length" not in raw:
        raise InputError(
            "characterize.night",
            "the camera's file has no lens",
            "a camera file with focal_length, to 5 %, and f_number",
        )
    return night_sky.measure_night(config, folder, found.transfer, found.saturation_dn)


def write_results(
    folder: Path,
    config: CameraConfig,
    raw: Record,
    found: MeasuredSensor,
    night: Night | None,
    name: str,
) -> tuple[Record, Report]:
    """Write preset, report and `characterize.json`; return the statistics in it, and the report.

    Raises
    ------
    InputError
        If the preset is not a valid camera.
    """
    path = files.make_folder(folder) / "camera.yaml"
    head = [
        f"# {printable(name)}, measured. Written by `skysim characterize`.",
        "# [M] measured, with its 95 % interval. Other values are those of the camera's file.",
    ]
    values = measured(found) | (measured_lens(config, night) if night else {})
    files.write_text(path, "\n".join([*head, *yaml_lines(list(lines(raw, values))), ""]))
    loader.load_camera(path, PLACEHOLDER_LENS)  # as a scene reads it
    statistics = {
        "camera": name,
        "preset": str(path),
        "report": str(folder / "report.html"),
        "temperature_c": found.dark_temperature_c,
        "values": [
            row(key, one, raw["detector"].get(key)) for key, one in found.estimates.items()
        ],
        "linearity_error": found.linearity_error,
        "flicker": found.transfer.flicker,
        "drift": found.transfer.drift,
        "misfit": found.transfer.misfit,
        "night": night_statistics(config, night) if night else None,
        "remarks": found.remarks + (night.remarks if night else []),
    }
    files.write_json(folder / "characterize.json", statistics)
    report = characterize_report(statistics, config, found, night)
    report.save(folder / "report.html")
    return statistics, report


def night_statistics(config: CameraConfig, night: Night) -> Record:
    """Rows of the lens, and the numbers of frames and stars that were used."""
    psf = config.psf if isinstance(config.psf, GaussianPsfConfig) else None
    rows = [
        row("sigma_px", night.size.sigma_px, psf and psf.sigma_px),
        row("corner_sigma_px", night.size.corner_sigma_px, psf and psf.corner_sigma_px),
    ]
    if night.lens:
        before = [1e3 * config.focal_length_m, *config.center_px, *config.distortion]
        found = night_sky.lens_estimates(config, night.lens)
        rows += [
            row(name, one, value)
            for (name, one), value in zip(found.items(), before, strict=True)
        ]
    return {
        "values": rows,
        "frames": night.frames,
        "identified": night.identified,
        "stars": len(night.size.used.chi2),
        "rms_px": night.lens.report.rms_px if night.lens else None,
    }


def row(key: str, one: Estimate, before: object) -> Record:
    """A row of the table: name, value, interval, unit, and the value of the camera's file."""
    return {
        "what": key,
        "value": one.value,
        "low": one.low,
        "high": one.high,
        "unit": UNITS.get(key, ""),
        "file": before if isinstance(before, int | float) else None,
    }


def check_folders(darks: Path | None, flats: Path | None) -> tuple[Path, Path]:
    """Both folders. Raises InputError if one is missing."""
    if darks and flats:
        return darks, flats
    name, unknown = ("flats", "gain and full well")
    if not darks:
        name, unknown = ("darks", "dark current and black level")
    problem = f"missing: without them {unknown} are unknown"
    raise InputError(f"characterize.{name}", problem, f"a folder of {name}")
