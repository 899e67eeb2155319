"""Compare a dome survey with the truth: statistics, attitude errors before and after, and a plot of LED errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.calibration.dome_survey import Survey
from skysim.core.types import Floats, Frame, Truth
from skysim.experiments.dome_survey import CalibrationPrior, SurveyUncertainty, led_sigma_m, lens_sigma
from skysim.results import metrics
from skysim.simulation.testbed import Testbed
from skysim.tracking import factory


class Check(NamedTuple):
    """Result of a tracker at new stops: number of stops, and (S,) cross-boresight and roll errors of those solved."""

    stops: int
    cross_rad: Floats
    roll_rad: Floats

    def figures(self) -> dict[str, float | int | None]:
        """Median and worst errors in degrees; None if nothing was solved."""
        told: dict[str, float | int | None] = {"stops": self.stops, "solved": len(self.cross_rad)}
        for name, error in (("cross", self.cross_rad), ("roll", self.roll_rad)):
            off_deg = np.degrees(np.abs(error))
            told[f"{name}_deg_median"] = float(np.median(off_deg)) if len(off_deg) else None
            told[f"{name}_deg_worst"] = float(off_deg.max()) if len(off_deg) else None
        return told


def checked(
    eyes: Mapping[str, factory.Estimator], shots: Iterable[tuple[Frame, Truth]]
) -> dict[str, dict[str, float | int | None]]:
    """Statistics of each tracker on the same frames, by name."""
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in eyes}
    stops = 0
    for frame, truth in shots:
        stops += 1
        for name, tracker in eyes.items():
            told = factory.solve_frame(tracker, frame).attitude.cam_from_ref
            if told is not None:
                errors[name].append(metrics.cross_and_roll_rad(told, truth.cam_from_lab))
    return {name: Check(stops, *np.array(off).reshape(-1, 2).T).figures() for name, off in errors.items()}


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


def misplaced(found: Survey, belief: CalibrationPrior, lab: Testbed) -> LedErrors:
    """LED position errors before and after the survey."""
    true_m = lab.sources.place[:, :3]
    row = np.flatnonzero(found.surveyed)
    place_m = found.leds.position_m[row]
    _, nearest = cKDTree(true_m).query(place_m)
    return LedErrors(
        true_m[row], belief.leds.position_m[row] - true_m[row], place_m - true_m[nearest], nearest != row
    )


def figures(
    found: Survey, belief: CalibrationPrior, lab: Testbed, doubt: SurveyUncertainty
) -> dict[str, Any]:
    """Statistics of a survey. `values` holds one row per lens and lever parameter: believed, found, truth, sigma."""
    sigma_mm = 1e3 * led_sigma_m(found, doubt)[found.surveyed]
    off = misplaced(found, belief, lab)
    camera = lab.scene.camera
    columns = [
        [float(lens.focal_px), *lens.centre_px, *lens.distortion[:4], *(1e3 * np.asarray(lever_m)).tolist()]
        for lens, lever_m in (
            (belief.camera, belief.lever.camera_body_m),
            (found.camera, found.lever.camera_body_m),
            (camera, lab.mount.camera_body_m),
        )
    ]
    lever_sigma_mm = 1e3 * np.sqrt(np.diag(found.lever_covariance_m2))
    columns.append([*lens_sigma(found)[:7].tolist(), *lever_sigma_mm.tolist()])
    names = ["focal length px", "centre x px", "centre y px", "k1", "k2", "p1", "p2"]
    names += [f"lever {axis} mm" for axis in "xyz"]
    keys = ("what", "believed", "found", "truth", "sigma")
    return {
        "status": found.status,
        "tied": int(found.tied.sum()),
        "leds": len(found.surveyed),
        "surveyed": int(found.surveyed.sum()),
        "renamed": int(off.renamed.sum()),
        "outliers": len(found.outliers),
        "rms_px": found.rms_px,
        "misfit": found.misfit,
        "led_sigma_mm_median": float(np.median(sigma_mm)),
        "led_sigma_mm_worst": float(sigma_mm.max()),
        "led_mm_before": float(1e3 * np.sqrt(np.mean(off.before_m**2))),
        "led_mm_after": float(1e3 * np.sqrt(np.mean(off.after_m**2))),
        "values": [dict(zip(keys, row, strict=True)) for row in zip(names, *columns, strict=True)],
    }


def figure(off: LedErrors) -> NDArray[np.uint8]:
    """BGR image of the dome from above with arrows for the errors of the surveyed LEDs before and after the survey.

    Each panel has its own arrow scale, shown in its key; color is the vertical error.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(figsize=(12, 6), layout="constrained")
    canvas = FigureCanvasAgg(fig)
    panels = (("before the survey", off.before_m), ("after", off.after_m))
    for axes, (title, error_m) in zip(fig.subplots(1, 2, sharex=True, sharey=True), panels, strict=True):
        rms_mm = 1e3 * float(np.sqrt(np.mean(error_m**2)))
        usual_mm = 1e3 * float(np.quantile(np.linalg.norm(error_m, axis=1), 0.95)) or 1.0
        x_m, y_m, _ = off.true_m.T
        arrows = axes.quiver(
            x_m,
            y_m,
            *(1e3 * error_m[:, :2].T),
            1e3 * error_m[:, 2],
            angles="xy",
            scale=25 * usual_mm,
            cmap="coolwarm",
        )
        arrows.set_clim(-usual_mm, usual_mm)
        axes.quiverkey(arrows, 0.9, 1.03, usual_mm, f"{usual_mm:.2g} mm", labelpos="E")
        axes.set_title(f"{title}: {rms_mm:.2g} mm rms an axis", loc="left")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        axes.set_aspect("equal")
        fig.colorbar(arrows, ax=axes, label="z error [mm]", shrink=0.8)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, 2::-1])
