"""Terminal output of `skysim survey`: the plan, what is measured, the attitudes to hold next, faults, errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from skysim.apps.cli.terminal import print_table, print_wrapped

COLUMNS = ("believed", "found", "sigma")
SHOWN_STOPS = 12  # attitudes of a plan that are printed; the file has all


def print_stops(rows: Sequence[dict[str, Any]], title: str) -> None:
    """Print attitudes as roll, pitch and yaw."""
    keys = ("roll_deg", "pitch_deg", "yaw_deg", "tilt_deg")
    lines = [[str(n), *(f"{row[key]:.1f}" for key in keys), str(row["leds"])] for n, row in enumerate(rows, 1)]
    print_table(title, ["", "roll °", "pitch °", "yaw °", "tilt °", "LEDs"], lines)


def accuracy_cells(row: dict[str, Any]) -> list[str]:
    """Measured LEDs, and the errors or a dash."""
    numbers = [row[key] for key in ("led_mm", "lever_mm", "focal_px")]
    return [str(row["measured"]), *("-" if number is None else f"{number:.3g}" for number in numbers)]


def print_plan(plan: dict[str, Any]) -> None:
    print_stops(plan["attitudes"][:SHOWN_STOPS], "")
    if len(plan["attitudes"]) > SHOWN_STOPS:
        print(f"... {len(plan['attitudes'])} attitudes in all, in {plan['plan']}")
    print()
    lines = [[str(row["frames"]), *accuracy_cells(row)] for row in plan["predicted"]]
    heads = ["frames", "LEDs measured", "LED place mm", "lever mm", "focal length px"]
    print_table(f"predicted errors (1σ) of {plan['leds']} LEDs, centroids to {plan['noise_px']:.2g} px", heads, lines)


def print_comparison(result: dict[str, Any]) -> None:
    lines = [
        [
            row["what"],
            "-" if row["predicted"] is None else f"{row['predicted']:.3g}",
            f"{row['simulated']:.3g}",
            "-" if row["ratio"] is None else f"{row['ratio']:.2f} ± {row['ratio_sigma']:.2f}",
        ]
        for row in result["rows"]
    ]
    print_table("", ["what", "predicted", "simulated", "ratio"], lines)
    print_wrapped(
        f"{len(result['measured'])} surveys of {result['frames']} frames, {min(result['measured'])} to"
        f" {max(result['measured'])} LEDs measured; {result['false_alarms']} faults reported, of none"
    )
    for failure in result["failures"]:
        print_wrapped(f"one more survey failed: {failure}")


def print_coverage(result: dict[str, Any]) -> None:
    """Print which LEDs are measured, and the attitudes to hold next."""
    counts, reaches = result["coverage"], result["next_reaches"]
    title = (
        f"{counts['measured']} of {counts['leds']} LEDs measured, {counts['seen_once']} seen once, {counts['unseen']}"
        f" not seen; hold these {len(result['next'])} attitudes next"
    )
    print_wrapped(title)
    print_stops(result["next"], "")
    if reaches["led_mm"] is not None:
        print_wrapped(f"with them: {reaches['measured']} measured, to {reaches['led_mm']:.2g} mm rms about each axis")
    print()


def print_survey(survey: dict[str, Any]) -> None:
    """Print a survey: what it found, its coverage, the faults, and the errors if it was simulated."""
    from skysim.experiments.dome_survey.results.findings import fault_lines

    truth = survey.get("truth")
    lines = [
        [
            row["what"],
            *(cell(row["what"], row[key]) for key in COLUMNS),
            *([cell(row["what"], truth[row["what"]])] if truth else []),
        ]
        for row in survey["values"]
        if row["sigma"]
    ]
    print_table("", ["what", *COLUMNS, *(["truth"] if truth else [])], lines)
    print()
    print_wrapped(
        f"{survey['surveyed']} of {survey['leds']} LEDs surveyed in {survey['tied']} of {survey['frames']} frames;"
        f" {survey['status']}, {survey['outliers']} outliers, {survey['rms_px']:.2g} px rms"
    )
    print_wrapped(
        f"LEDs: sigma median {survey['led_sigma_mm_median']:.2g} mm worst {survey['led_sigma_mm_worst']:.2g} mm"
    )
    if truth:
        print_truth(survey)
    print()
    print_coverage(survey)
    for line in fault_lines(survey["faults"]):
        print_wrapped(line)
    print_wrapped(f"{survey['map']}: for tracker.map; report: {survey['report']}")


def cell(what: str, number: float) -> str:
    """A number of the table of lens and lever."""
    return f"{number:.5g}" if what[0] in "kp" else f"{number:.3f}"


def print_truth(survey: dict[str, Any]) -> None:
    """Print the errors of a simulated survey."""
    predicted = survey["predicted"]["led_mm"]
    print_wrapped(
        f"true error of the LEDs: {survey['led_mm_before']:.2g} mm rms before, {survey['led_mm_after']:.2g} mm after"
        f" (predicted {'-' if predicted is None else f'{predicted:.2g}'} mm); {survey['renamed']} with another identity"
    )
    for when in ("before", "after"):
        result = survey[when]
        errors = [
            f"{name} median {result[f'{name}_arcsec_median']:.3g}″ worst {result[f'{name}_arcsec_worst']:.3g}″"
            for name in ("cross", "roll")
            if result["solved"]
        ]
        print_wrapped(
            f"{when}: " + ", ".join([f"{result['solved']} of {result['stops']} test attitudes solved", *errors])
        )


PRINTERS: dict[str, Callable[[dict[str, Any]], None]] = {
    "plan": print_plan,
    "repeat": print_comparison,
    "images": print_survey,
    "watch": print_survey,
    "simulate": print_survey,
}
