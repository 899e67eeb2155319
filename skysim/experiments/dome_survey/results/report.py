"""Report of a dome survey: statistics, pictures of the dome, and the comparison of a simulated one with the truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import Lever, on_surface
from estimator.calibration.dome_survey import DomeSurvey
from estimator.core.camera import Camera
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, Frame, Mount, Truth
from skysim.experiments.dome_survey.adjust import lens_sigma
from skysim.experiments.dome_survey.prior import CalibrationPrior
from skysim.experiments.dome_survey.results.findings import Coverage, DomeFaults, rows_of
from skysim.experiments.dome_survey.survey_run import SurveyRun
from skysim.results import metrics
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.lab import Lab
from skysim.tracking import factory

LENS = ("focal length px", "center x px", "center y px", "k1", "k2", "p1", "p2")
PARAMETERS = (*LENS, *(f"lever {axis} mm" for axis in "xyz"))
VALUE_KEYS = ("what", "believed", "found", "sigma")


def error_statistics(
    stops: int, errors_rad: list[tuple[float, float]]
) -> dict[str, float | int | None]:
    """Median and worst cross-boresight and roll errors of a tracker in arcseconds; None if nothing was solved."""
    statistics: dict[str, float | int | None] = {"stops": stops, "solved": len(errors_rad)}
    errors_arcsec = np.abs(errors_rad).reshape(-1, 2) / ARCSEC_RAD
    for name, error_arcsec in zip(("cross", "roll"), errors_arcsec.T, strict=True):
        statistics[f"{name}_arcsec_median"] = (
            float(np.median(error_arcsec)) if len(error_arcsec) else None
        )
        statistics[f"{name}_arcsec_worst"] = (
            float(error_arcsec.max()) if len(error_arcsec) else None
        )
    return statistics


def compare_trackers(
    trackers: Mapping[str, factory.Estimator], frames: Iterable[tuple[Frame, Truth]]
) -> dict[str, dict[str, float | int | None]]:
    """Statistics of each tracker on the same frames, by name."""
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in trackers}
    stops = 0
    for frame, truth in frames:
        stops += 1
        for name, tracker in trackers.items():
            cam_from_ref = factory.solve_frame(tracker, frame).attitude.cam_from_ref
            if cam_from_ref is not None:
                errors[name].append(metrics.cross_and_roll_rad(cam_from_ref, truth.cam_from_lab))
    return {name: error_statistics(stops, errors_rad) for name, errors_rad in errors.items()}


class LedErrors(NamedTuple):
    """The S surveyed LEDs: true positions (S, 3), position errors before and after the survey (S, 3), renamed (S,).

    If the map before the survey has two LEDs each closer to the other's true position, the survey may exchange their
    numbers. This does not affect an attitude, which depends on positions only. `after_m` is therefore the error from
    the nearest true LED, and `renamed` marks LEDs whose nearest true LED has another number.
    """

    true_m: Floats
    before_m: Floats
    after_m: Floats
    renamed: NDArray[np.bool_]


def led_errors(survey: DomeSurvey, prior: CalibrationPrior, lab: Lab) -> LedErrors:
    """LED position errors before and after the survey."""
    true_m = lab.camera.sources.place[:, :3]
    row = np.flatnonzero(survey.surveyed)
    position_m = survey.leds.position_m[row]
    _, nearest = cKDTree(true_m).query(position_m)
    before_m = prior.leds.position_m[row] - true_m[row]
    return LedErrors(true_m[row], before_m, position_m - true_m[nearest], nearest != row)


def survey_statistics(run: SurveyRun, before: CalibrationPrior) -> dict[str, Any]:
    """Statistics of a survey without the truth. `values` holds one row per lens and lever parameter that is fitted."""
    survey = run.survey
    sigma_mm = 1e3 * run.accuracy.led_sigma_m[survey.surveyed]
    columns = [
        parameters(lens, lever)
        for lens, lever in ((before.camera, before.lever), (survey.camera, survey.lever))
    ]
    lever_sigma_mm = 1e3 * np.sqrt(np.diag(survey.lever_covariance_m2))
    sigma = [*lens_sigma(survey)[:7].tolist(), *lever_sigma_mm.tolist()]
    return {
        "status": survey.status,
        "tied": int(survey.tied.sum()),
        "leds": len(survey.surveyed),
        "surveyed": int(survey.surveyed.sum()),
        "outliers": len(survey.outliers),
        "rms_px": survey.rms_px,
        "noise_px": run.noise_px,
        "misfit": survey.misfit,
        "led_sigma_mm_median": float(np.median(sigma_mm)),
        "led_sigma_mm_worst": float(sigma_mm.max()),
        "values": [
            dict(zip(VALUE_KEYS, row, strict=True))
            for row in zip(PARAMETERS, *columns, sigma, strict=True)
        ],
    }


def truth_statistics(run: SurveyRun, before: CalibrationPrior, lab: Lab) -> dict[str, Any]:
    """The errors of a simulated survey: of the LEDs before and after it, and the true parameters."""
    errors = led_errors(run.survey, before, lab)
    truth = parameters(lab.scene.camera, lab.camera.mount)
    return {
        "renamed": int(errors.renamed.sum()),
        "led_mm_before": float(1e3 * np.sqrt(np.mean(errors.before_m**2))),
        "led_mm_after": float(1e3 * np.sqrt(np.mean(errors.after_m**2))),
        "truth": dict(zip(PARAMETERS, truth, strict=True)),
    }


def parameters(lens: Camera | CameraConfig, lever: Lever | Mount) -> list[float]:
    """The lens and the lever in the order of PARAMETERS."""
    lever_mm = (1e3 * np.asarray(lever.camera_body_m)).tolist()
    return [float(lens.focal_px), *lens.center_px, *lens.distortion[:4], *lever_mm]


def coverage_figure(
    so_far: Coverage, faults: DomeFaults | None, further: Rotation | None
) -> NDArray[np.uint8]:
    """BGR image of the dome from above: how well each LED is measured, faults, and where to point the camera next."""
    fig, canvas = new_figure((8, 7))
    draw_coverage(fig.subplots(), so_far, faults, further)
    return picture_of(canvas)


def survey_figure(
    so_far: Coverage,
    faults: DomeFaults,
    further: Rotation | None,
    errors: LedErrors | None,
    shifts: LedErrors,
) -> NDArray[np.uint8]:
    """BGR image: the coverage, and the LED errors before and after the survey, or else their shifts from the list."""
    panels = [("found minus list", shifts.true_m, -shifts.before_m)]
    if errors is not None:
        panels = [
            ("error before the survey", errors.true_m, errors.before_m),
            ("after", errors.true_m, errors.after_m),
        ]
    fig, canvas = new_figure((7 * (1 + len(panels)), 6.5))
    first, *rest = fig.subplots(1, 1 + len(panels))
    draw_coverage(first, so_far, faults, further)
    for axes, (title, place_m, error_m) in zip(rest, panels, strict=True):
        draw_errors(axes, title, place_m, error_m)
    return picture_of(canvas)


def new_figure(size_in: tuple[float, float]) -> tuple[Any, Any]:
    """A figure and its canvas."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(figsize=size_in, layout="constrained")
    return fig, FigureCanvasAgg(fig)


def picture_of(canvas: Any) -> NDArray[np.uint8]:
    """BGR image of a canvas."""
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, 2::-1])


def draw_coverage(
    axes: Any, so_far: Coverage, faults: DomeFaults | None, further: Rotation | None
) -> None:
    """LEDs by their standard deviation, gray if not measured; faults; the numbers of the next attitudes."""
    from matplotlib.colors import LogNorm

    leds = so_far.model.leds
    measured = so_far.measured
    x_m, y_m, _ = leds.position_m.T
    once = so_far.seen.any(axis=0) & ~measured
    unseen = ~measured & ~once
    axes.scatter(
        x_m[unseen],
        y_m[unseen],
        s=14,
        facecolor="none",
        edgecolor="0.6",
        label=f"not seen: {unseen.sum()}",
    )
    axes.scatter(
        x_m[once], y_m[once], s=14, color="0.75", label=f"seen, not measured: {once.sum()}"
    )
    if so_far.accuracy is not None:
        sigma_mm = 1e3 * so_far.accuracy.led_sigma_m[measured]
        label = f"measured: {measured.sum()}"
        points = axes.scatter(
            x_m[measured], y_m[measured], s=14, c=sigma_mm, norm=LogNorm(), label=label
        )
        axes.figure.colorbar(
            points, ax=axes, label="standard deviation about each axis [mm]", shrink=0.8
        )
    if faults is not None:
        marks = {
            "dark": (faults.dark, "x", "black"),
            "displaced": (list(faults.displaced), "D", "magenta"),
            "exchanged": ([led for led, _, _ in faults.exchanged], "s", "red"),
        }
        for name, (numbers, marker, color) in marks.items():
            rows = rows_of(numbers, leds.id)
            colors = (
                {"color": color} if marker == "x" else {"facecolor": "none", "edgecolor": color}
            )
            if len(rows):
                axes.scatter(x_m[rows], y_m[rows], 70, marker=marker, label=name, **colors)
            for row in rows:
                axes.annotate(
                    str(leds.id[row]),
                    (x_m[row], y_m[row]),
                    (6, 6),
                    textcoords="offset points",
                    color=color,
                )
    if further is not None:
        lever = so_far.model.lever
        toward = further.apply(lever.cam_from_body.inv().apply([0.0, 0.0, 1.0])).reshape(-1, 3)
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
    rms_mm = 1e3 * float(np.sqrt(np.mean(error_m**2)))
    scale_mm = 1e3 * float(np.quantile(np.linalg.norm(error_m, axis=1), 0.95)) or 1.0
    x_m, y_m, _ = place_m.T
    arrows = axes.quiver(
        x_m, y_m, *(1e3 * error_m.T), angles="xy", scale=25 * scale_mm, cmap="coolwarm"
    )
    arrows.set_clim(-scale_mm, scale_mm)
    axes.quiverkey(arrows, 0.9, 1.03, scale_mm, f"{scale_mm:.2g} mm", labelpos="E")
    axes.set_title(f"{title}: {rms_mm:.2g} mm rms an axis", loc="left")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.figure.colorbar(arrows, ax=axes, label="z error [mm]", shrink=0.8)


def list_shifts(run: SurveyRun) -> LedErrors:
    """The measured LEDs as found, and the list's errors against that."""
    row = np.flatnonzero(run.survey.surveyed)
    found_m = run.survey.leds.position_m[row]
    none = np.zeros(len(row), dtype=bool)
    return LedErrors(found_m, run.listed.position_m[row] - found_m, np.zeros_like(found_m), none)
