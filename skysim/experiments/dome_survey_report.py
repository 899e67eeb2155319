"""Compare a dome survey with the truth: statistics, attitude errors before and after, and a plot of LED errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.calibration.dome_survey import DomeSurvey
from skysim.core.quantities.units import ARCSEC_RAD
from skysim.core.types import Floats, Frame, Truth
from skysim.experiments.dome_survey import led_sigma_m, lens_sigma
from skysim.experiments.dome_survey_naming import CalibrationPrior, SurveyUncertainty
from skysim.results import metrics
from skysim.simulation.testbed import Testbed
from skysim.tracking import factory


def error_statistics(stops: int, errors_rad: list[tuple[float, float]]) -> dict[str, float | int | None]:
    """Median and worst cross-boresight and roll errors of a tracker in arcseconds; None if nothing was solved."""
    statistics: dict[str, float | int | None] = {"stops": stops, "solved": len(errors_rad)}
    errors_arcsec = np.abs(errors_rad).reshape(-1, 2) / ARCSEC_RAD
    for name, error_arcsec in zip(("cross", "roll"), errors_arcsec.T, strict=True):
        statistics[f"{name}_arcsec_median"] = float(np.median(error_arcsec)) if len(error_arcsec) else None
        statistics[f"{name}_arcsec_worst"] = float(error_arcsec.max()) if len(error_arcsec) else None
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


def led_errors(survey: DomeSurvey, prior: CalibrationPrior, testbed: Testbed) -> LedErrors:
    """LED position errors before and after the survey."""
    true_m = testbed.sources.place[:, :3]
    row = np.flatnonzero(survey.surveyed)
    position_m = survey.leds.position_m[row]
    _, nearest = cKDTree(true_m).query(position_m)
    before_m = prior.leds.position_m[row] - true_m[row]
    return LedErrors(true_m[row], before_m, position_m - true_m[nearest], nearest != row)


def survey_statistics(
    survey: DomeSurvey, prior: CalibrationPrior, testbed: Testbed, uncertainty: SurveyUncertainty
) -> dict[str, Any]:
    """Statistics of a survey. `values` holds one row per lens and lever parameter, before and after the survey."""
    sigma_mm = 1e3 * led_sigma_m(survey, uncertainty)[survey.surveyed]
    errors = led_errors(survey, prior, testbed)
    camera = testbed.scene.camera
    columns = [
        [float(lens.focal_px), *lens.center_px, *lens.distortion[:4], *(1e3 * np.asarray(lever_m)).tolist()]
        for lens, lever_m in (
            (prior.camera, prior.lever.camera_body_m),
            (survey.camera, survey.lever.camera_body_m),
            (camera, testbed.mount.camera_body_m),
        )
    ]
    lever_sigma_mm = 1e3 * np.sqrt(np.diag(survey.lever_covariance_m2))
    columns.append([*lens_sigma(survey)[:7].tolist(), *lever_sigma_mm.tolist()])
    names = ["focal length px", "center x px", "center y px", "k1", "k2", "p1", "p2"]
    names += [f"lever {axis} mm" for axis in "xyz"]
    keys = ("what", "believed", "found", "truth", "sigma")
    return {
        "status": survey.status,
        "tied": int(survey.tied.sum()),
        "leds": len(survey.surveyed),
        "surveyed": int(survey.surveyed.sum()),
        "renamed": int(errors.renamed.sum()),
        "outliers": len(survey.outliers),
        "rms_px": survey.rms_px,
        "misfit": survey.misfit,
        "led_sigma_mm_median": float(np.median(sigma_mm)),
        "led_sigma_mm_worst": float(sigma_mm.max()),
        "led_mm_before": float(1e3 * np.sqrt(np.mean(errors.before_m**2))),
        "led_mm_after": float(1e3 * np.sqrt(np.mean(errors.after_m**2))),
        "values": [dict(zip(keys, row, strict=True)) for row in zip(names, *columns, strict=True)],
    }


def led_error_figure(errors: LedErrors) -> NDArray[np.uint8]:
    """BGR image of the dome from above with arrows for the errors of the surveyed LEDs before and after the survey.

    Each panel has its own arrow scale, shown in its key; color is the vertical error.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(figsize=(12, 6), layout="constrained")
    canvas = FigureCanvasAgg(fig)
    panels = (("before the survey", errors.before_m), ("after", errors.after_m))
    for axes, (title, error_m) in zip(fig.subplots(1, 2, sharex=True, sharey=True), panels, strict=True):
        rms_mm = 1e3 * float(np.sqrt(np.mean(error_m**2)))
        scale_mm = 1e3 * float(np.quantile(np.linalg.norm(error_m, axis=1), 0.95)) or 1.0
        x_m, y_m, _ = errors.true_m.T
        arrows = axes.quiver(x_m, y_m, *(1e3 * error_m.T), angles="xy", scale=25 * scale_mm, cmap="coolwarm")
        arrows.set_clim(-scale_mm, scale_mm)
        axes.quiverkey(arrows, 0.9, 1.03, scale_mm, f"{scale_mm:.2g} mm", labelpos="E")
        axes.set_title(f"{title}: {rms_mm:.2g} mm rms an axis", loc="left")
        axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        fig.colorbar(arrows, ax=axes, label="z error [mm]", shrink=0.8)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, 2::-1])
