"""The report of a run: what was solved and how well, pictures, the scene, and every frame."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from estimator.identification import refusals as reasons
from skysim.core.types import Record, median
from skysim.results import metrics, scoring
from skysim.results.plots import Picture, figure_png, stacked_axes
from skysim.results.report import (
    Cell,
    Column,
    Facts,
    Figure,
    Items,
    Report,
    Section,
    Table,
    Text,
    Tone,
    Verdict,
)
from skysim.results.requirements import NOT_MET, Judgment
from skysim.results.scoring import FrameRow
from skysim.scene.scene import Scene
from skysim.simulation.checks import Check
from skysim.tracking.computer_time import computer_text

Rows = Sequence[FrameRow]
# Settings that help where the tracker's own refusal names none.
BRIGHTER = (
    "lower tracker.threshold_sigma or tracker.min_area_px, or expose longer (exposure.time)"
)
FEWER = (
    "raise tracker.centroid_sigma_px if the camera or the map is less accurate than assumed, or leave out false lights"
    " with tracker.brightest"
)
HELP = {
    reasons.NO_LIGHTS: BRIGHTER,
    reasons.NO_STARS: BRIGHTER,
    reasons.NO_MATCH: FEWER,
    reasons.FALSE_LIGHTS: FEWER,
    reasons.BUDGET: FEWER,
    reasons.WRONG_SCALE: "correct the focal length that the tracker assumes",
    reasons.AMBIGUOUS: "tell LEDs apart by tracker.brightness_sigma with several levels in light.layout, or make the"
    " layout irregular; keep reflections of the stars out of the field",
}
MOTION = {  # sentences of the motion's statistics, by the statistic that a scene must have
    "pointing_deg_worst": "pointing: worst {pointing_deg_worst:.3g}°, at the end {pointing_deg_end:.2g}°; "
    "maximum commanded torque {torque_nm_worst:.3g} N m",
    "momentum_nms_worst": "maximum stored momentum {momentum_nms_worst:.3g} N m s",
    "wheel_rpm_worst": "maximum wheel speed {wheel_rpm_worst:.0f} rpm",
    "manipulability_least": "minimum CMG manipulability {manipulability_least:.2g}",
    "propellant_g_used": "propellant used {propellant_g_used:.3g} g",
    "imu_deg_worst": "IMU alone: error {imu_deg_end:.3g}° at the end; gyros saturated for {gyro_saturated_s:.2g} s",
    "filter_deg_worst": "filter: worst {filter_deg_worst:.3g}°, at the end {filter_arcsec_end:.3g}″, "
    "bias error {filter_bias_deg_h_end:.2g}°/h",
}


def run_report(
    scene: Scene,
    plan: Check,
    command: str,
    rows: Rows,
    *,
    stages_ms: Mapping[str, float],
    annotated: Picture,
    motion: Section,
    views: Sequence[Path],
    judged: Sequence[Judgment],
) -> Report:
    """The report of a run. A single frame has no plot against time.

    Parameters
    ----------
    plan
        The check of the scene, whose facts and warnings are shown
    stages_ms
        Median time by stage
    annotated
        The last solved frame with its markers, BGR
    motion
        Section of `motion_section`
    views
        Image files of the laboratory in 3-D
    judged
        Judgments of the scene's requirements
    """
    frame = Figure(cv2.imencode(".png", annotated)[1].tobytes(), FRAME_CAPTION)
    laboratory = [
        Figure(path.read_bytes(), "the laboratory in 3-D", path.suffix[1:]) for path in views
    ]
    errors = [Figure(error_figure(rows), ERROR_CAPTION)] if len(rows) > 1 else []
    findings = plan.findings
    warned = f"The check of the plan warns: {len(findings)}, see below." if findings else ""
    facts = [(name, [text]) for name, text in scene.summary]
    facts += [(fact.name, fact.lines) for fact in plan.facts]
    stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in stages_ms.items())
    computer = scene.tracker.computer
    on_it = computer_text(computer, stages_ms) if computer else ""
    last = [Text(f"Median ms a frame: {stages}"), Text(on_it), Text(magnitude_text(rows))]
    blocks = [
        verdict(rows),
        required(judged, rows),
        Text(claims_text(rows)),
        Text(warned, "bad", on_terminal=False),
        Section("The last solved frame", [frame]),
        Section("The laboratory", laboratory),
        Section("Errors", errors),
        motion,
        Section("Scene", [Facts(facts)], on_terminal=False),
        Section("Check of the plan", [Items(findings, tone="warning")], on_terminal=False),
        Section(
            "Frames",
            [
                frame_table(scoring.angle_names(scene), rows),
                Items(refusals(rows, findings)),
                *last,
            ],
        ),
    ]
    return Report(scene.title, blocks, command)


FRAME_CAPTION = "Blue ticks: truth. Red squares: detected. Green circles: identified."
MAGNITUDES = (
    "Magnitudes of {magnitude_stars} stars, measured (-2.5 log10 DN/s) minus catalog: mean"
    " {magnitude_error_mag_mean:+.3f}, standard deviation {magnitude_error_mag_sigma:.3f}"
)
CLAIMS = (
    "claimed {cross_sigma_arcsec_rms:.3g}″ cross, {roll_sigma_arcsec_rms:.3g}″ roll (1σ); real"
    " {cross_arcsec_rms:.3g}″ and {roll_arcsec_rms:.3g}″ (rms); NEES {nees_mean:.3g} (3 if true)"
)
ERROR_CAPTION = (
    "Errors, lights and rate against time. Red lines mark frames that were not solved."
)
MOTION_CAPTION = "Attitude, estimates and actuators against time."


def summary(rows: Rows) -> Record:
    """Frame counts, median and worst errors in arcseconds, and median solve time of a run.

    Errors are over solved frames, wrong ones included; NaN if no frame was solved. Where stars were identified, also
    `magnitude_errors`; for `scatter_arcsec` see there. Where the tracker claims errors, also `claims`.
    """
    solved = [row for row in rows if row.status == "solved"]
    return {
        "frames": len(rows),
        "solved": len(solved),
        "wrong": sum(row.wrong for row in solved),
        **scoring.error_statistics([(row.cross_arcsec, row.roll_arcsec) for row in solved]),
        "scatter_arcsec": scatter_arcsec(solved),
        **claims(solved),
        "time_ms_median": median([row.time_ms for row in rows]),
        **magnitude_errors(rows),
    }


def claims(solved: Rows) -> dict[str, float]:
    """Rms errors and claimed ones in arcsec, mean NEES, and the mean share of the survey; empty without a claim."""
    known = [row for row in solved if math.isfinite(row.nees)]
    if not known:
        return {}
    sizes = {
        f"{name}_rms": math.sqrt(np.mean([getattr(row, name) ** 2 for row in known]))
        for name in ("cross_sigma_arcsec", "roll_sigma_arcsec", "cross_arcsec", "roll_arcsec")
    }
    shares = np.nan_to_num([row.survey_share for row in known])
    return sizes | {
        "nees_mean": np.mean([row.nees for row in known]),
        "survey_share": np.mean(shares),
    }


def claims_text(rows: Rows) -> str:
    """The claimed and the real errors in words; empty without a claim."""
    run = summary(rows)
    if "nees_mean" not in run:
        return ""
    survey = (
        f"; {100 * run['survey_share']:.0f} % of the claim is of one survey, whose error all frames share: they cannot"
        " tell whether it is true"
        if run["survey_share"] > metrics.ONE_SURVEY
        else ""
    )
    return CLAIMS.format(**run) + survey


def magnitude_errors(rows: Rows) -> Record:
    """Mean and standard deviation of measured minus catalog magnitude over the stars of all frames; empty without any.

    The sum of squares about the common mean is that within the frames and that of the frames' means.
    """
    found = [row for row in rows if not np.isnan(row.magnitude_error_mag)]
    if not found:
        return {}
    stars = np.array([row.matched for row in found])
    means = np.array([row.magnitude_error_mag for row in found])
    sigmas = np.array([row.magnitude_sigma_mag for row in found])
    mean = np.average(means, weights=stars)
    squares = np.sum((stars - 1) * sigmas**2 + stars * (means - mean) ** 2)
    return {
        "magnitude_error_mag_mean": mean,
        "magnitude_error_mag_sigma": np.sqrt(squares / (stars.sum() - 1)),
        "magnitude_stars": stars.sum(),
    }


def scatter_arcsec(solved: Rows) -> list[float]:
    """Standard deviations of the three estimated angles about straight lines in time, fitted by least squares.

    A laboratory without a truth measures it at rest or at a constant rate. NaN for fewer than three frames.
    """
    if len(solved) < 3:
        return [math.nan] * 3
    t_s = [row.t_s for row in solved]
    angles_deg = np.array([row.estimate_deg for row in solved])
    # 360 degrees are none.
    angles_deg = np.unwrap(angles_deg, period=360, axis=0)
    design = np.column_stack([np.ones(len(t_s)), t_s])
    fit = np.linalg.lstsq(design, angles_deg, rcond=None)[0]
    squares = np.sum((angles_deg - design @ fit) ** 2, axis=0)
    return (3600 * np.sqrt(squares / (len(t_s) - 2))).tolist()


def magnitude_text(rows: Rows) -> str:
    """The magnitude errors in words; empty without any."""
    errors = magnitude_errors(rows)
    return MAGNITUDES.format(**errors) if errors else ""


def verdict(rows: Rows) -> Verdict:
    """How many frames were solved, how many of them wrongly, and the errors."""
    run = summary(rows)
    tone: Tone = "good" if run["solved"] == run["frames"] else "warning"
    text = f"{run['solved']} of {run['frames']} frames solved, {run['wrong']} wrong"
    if np.isfinite(run["cross_arcsec_median"]):
        text += (
            f"; cross-boresight median {run['cross_arcsec_median']:.3g}″ worst {run['cross_arcsec_worst']:.3g}″,"
            f" roll median {run['roll_arcsec_median']:.3g}″ worst {run['roll_arcsec_worst']:.3g}″"
        )
    text += f"; image to attitude in {run['time_ms_median']:.1f} ms (median)"
    return Verdict(text, "bad" if run["wrong"] or not run["solved"] else tone)


def required(judged: Sequence[Judgment], rows: Rows) -> Items:
    """The judgments of requirements in words, and how many independent draws the frames are if they are fewer."""
    lines = [one.text() for one in judged]
    draws = max((one.draws for one in judged), default=math.inf)
    if draws < 0.99 * sum(row.status == "solved" for row in rows):
        lines.append(
            f"{len(rows)} frames count as {draws:.3g} independent draws, for a run draws the errors of its survey"
            " once; a study draws them anew by `hardware: [tracker.survey.seed]`"
        )
    unmet = any(one.answer == NOT_MET for one in judged)
    return Items(lines, "Requirements" if lines else "", "bad" if unmet else "")


def refusals(rows: Rows, findings: Sequence[str]) -> list[str]:
    """Each reason why frames were not solved, their number, and the settings that would help.

    Whether stars are too few in too long or too short an exposure is known to the check, by its `findings`.
    """
    exposure = [line for line in findings if line.startswith("exposure.time: ")]
    darkness = dict.fromkeys((reasons.NO_LIGHTS, reasons.NO_STARS), *exposure[:1])
    advice = HELP | (darkness if exposure else {})
    counts = Counter(row.status for row in rows if row.status in HELP)
    return [f"{count} frames: {status}; {advice[status]}" for status, count in counts.items()]


def motion_section(
    motion: Mapping[str, float], findings: Sequence[str], figure: bytes
) -> Section:
    """The statistics of a motion in words, the warnings after the flight, and the plot as PNG, which may be empty.

    Statistics that a scene does not have are skipped.
    """
    lines = [text.format(**motion) for key, text in MOTION.items() if key in motion]
    mounts = re.findall(r"mounting_(\w+)_arcsec_end", " ".join(motion))
    errors = ", ".join(
        f"{name} {motion[f'mounting_{name}_arcsec_end']:.3g}″" for name in mounts
    )
    if mounts:
        lines.append(f"mounting error at the end: {errors}")
    plot = [Figure(figure, MOTION_CAPTION)] if figure else []
    return Section("Motion", [*plot, Items(lines), Items(findings, tone="warning")])


def frame_table(angles: tuple[str, str, str], rows: Rows) -> Table:
    """One row per frame: truth, estimate, errors, lights and time; `angles` names the three angles."""
    columns = [
        Column("frame"),
        Column("t", "s", ".3f"),
        Column("exp", "ms", ".5g"),
        Column("rate", "°/s", ".2f"),
        *(Column(f"true {name}", "°", ".5f") for name in angles),
        *(Column(name, "°", ".5f") for name in angles),
        Column("cross", "″", ".3f"),
        Column("roll", "″", "+.3f"),
        Column("detected"),
        Column("used"),
        Column("time", "ms", ".1f"),
        "status",
    ]
    lines = []
    for row in rows:
        motion = [row.frame, row.t_s, 1e3 * row.exposure_s, row.rate_deg_s, *row.truth_deg]
        errors = [
            *(row.estimate_deg or (None, None, None)),
            row.cross_arcsec,
            row.roll_arcsec,
        ]
        status = Cell("WRONG", "bad") if row.wrong else row.status
        lines.append([*motion, *errors, row.detected, row.matched, row.time_ms, status])
    return Table(columns, lines, optional=((7, 8, 9), (2,), (14,), (3,), (12,), (4, 5, 6)))


def error_figure(rows: Rows) -> bytes:
    """Errors, detected and matched sources, and rate against time, as PNG. Red lines mark unsolved frames."""
    fig, (errors, stars, rate) = stacked_axes([2.9, 1.45, 1.45])
    solved = [row for row in rows if row.status == "solved"]
    t = [row.t_s for row in solved]
    cross, roll = (
        [max(abs(getattr(row, f"{name}_arcsec")), 1e-6) for row in solved]
        for name in ("cross", "roll")
    )
    errors.plot(t, cross, ".-", label="cross-boresight")
    errors.plot(t, roll, ".-", label="roll")
    if solved and max(cross + roll) > 10 * min(cross + roll):
        errors.set_yscale("log")
    else:
        errors.set_ylim(bottom=0)
    for row in rows:
        if row.status != "solved":
            errors.axvline(row.t_s, color="tab:red", alpha=0.4)
    errors.set_ylabel("error [arcsec]")
    errors.legend()
    t_all = [row.t_s for row in rows]
    stars.plot(t_all, [row.detected for row in rows], label="detected")
    stars.plot(t_all, [row.matched for row in rows], label="matched")
    stars.set_ylabel("sources")
    stars.set_ylim(bottom=0)
    stars.legend()
    rate.plot(t_all, [row.rate_deg_s for row in rows], color="tab:green")
    rate.set_ylabel("rate [deg/s]")
    return figure_png(fig, dpi=110)
