"""Terminal output of `skysim survey --plan` and `--repeat`: the attitudes to hold, predicted and simulated errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skysim.results.report.as_text import print_table, print_wrapped
from skysim.results.report.blocks import Column, Table

SHOWN_STOPS = 12  # attitudes of a plan that are printed; the file has all


def print_plan(plan: dict[str, Any]) -> None:
    from skysim.experiments.dome_survey.results.survey_report import stop_table

    print_table(stop_table(plan["attitudes"][:SHOWN_STOPS]))
    if len(plan["attitudes"]) > SHOWN_STOPS:
        print(f"... {len(plan['attitudes'])} attitudes in all, in {plan['plan']}")
    print()
    heads = ("LED place mm", "lever mm", "focal length px")
    columns = [
        Column("frames"),
        Column("LEDs measured"),
        *(Column(head, format=".3g") for head in heads),
    ]
    keys = ("frames", "measured", "led_mm", "lever_mm", "focal_px")
    table = Table(columns, [[row[key] for key in keys] for row in plan["predicted"]])
    print_table(
        table,
        f"predicted errors (1σ) of {plan['leds']} LEDs, centroids to {plan['noise_px']:.2g} px",
    )


def print_comparison(result: dict[str, Any]) -> None:
    columns = [
        Column("what", kind="text"),
        Column("predicted", format=".3g"),
        Column("simulated", format=".3g"),
    ]
    rows = [
        [
            row["what"],
            row["predicted"],
            row["simulated"],
            None if row["ratio"] is None else f"{row['ratio']:.2f} ± {row['ratio_sigma']:.2f}",
        ]
        for row in result["rows"]
    ]
    print_table(Table([*columns, Column("ratio")], rows))
    print_wrapped(
        f"{len(result['measured'])} surveys of {result['frames']} frames, {min(result['measured'])} to"
        f" {max(result['measured'])} LEDs measured; {result['false_alarms']} faults reported, of none"
    )
    for failure in result["failures"]:
        print_wrapped(f"one more survey failed: {failure}")


PRINTERS: dict[str, Callable[[dict[str, Any]], None]] = {
    "plan": print_plan,
    "repeat": print_comparison,
}
