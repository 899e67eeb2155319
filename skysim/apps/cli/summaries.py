"""Terminal output of `skysim study` but for its report: progress and provenance, worst and replayed trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any
from skysim.apps.cli.terminal import print_error
from skysim.core.errors import printable
from skysim.results.report.as_text import print_wrapped
from collections.abc import Callable
from typing import Any
from skysim.results.report.as_text import print_table, print_wrapped
from skysim.results.report.blocks import Column, Table

if TYPE_CHECKING:
    from skysim.experiments.study.analysis.worst import WorstTrial
    from skysim.experiments.study.execution.store import Store
    from skysim.experiments.study.plan import Plan


REPLAYED = (
    "trial",
    "point",
    "replicate",
    "seed",
    "status",
    "x_arcsec",
    "y_arcsec",
    "roll_arcsec",
    "stars",
    "matched",
)


def study_status(plan: Plan, store: Store) -> dict[str, Any]:
    """Progress and provenance of a study: trial counts, code version, run time and store."""
    return {
        "study": plan.name,
        "title": plan.study.title,
        "trials": plan.study.trial_count(len(plan.points)),
        **store.counts(),
        "code": store.meta("code"),
        "seconds": sum(run["seconds"] for run in store.runs()),
        "store": str(store.path),
    }


def print_study_status(status: dict[str, Any]) -> None:
    rate = status["done"] / status["seconds"] if status["seconds"] else 0.0
    print_wrapped(
        f"{status['title']}: {status['done']} of {status['trials']} trials, {status['failed']} failed,"
        f" {status['wrong']} wrong attitudes; {status['seconds']:.1f} s, {rate:.0f} trials/s"
    )
    print(f"store: {status['store']} (code {status['code']})")


def print_worst(
    response: str,
    found: Sequence[WorstTrial],
    levels: Sequence[Mapping[str, Any]],
    repeat: str,
    instead: str,
) -> None:
    """Print the worst attitudes by a response, the settings that start there, and the commands that repeat them.

    levels : of each trial's point;  instead : the command to give if no trial counts for the response
    """
    if not found:
        print(f"no trial counts for {response}; rank them by an error: {instead}")
    for rank, (one, level) in enumerate(zip(found, levels, strict=True), 1):
        at = ", ".join(f"{name} = {value}" for name, value in level.items())
        print(
            f"{rank}. {one.direction}, {one.lights:.0f} lights: {printable(one.event)} ({printable(at)})"
        )
        if one.start:
            print(f"   {one.start}")
        print(f"   {repeat} {one.trial}")


def print_replay(replay: dict[str, Any]) -> None:
    """Print the outcome of a repeated trial, and whether it differs from the stored one."""
    for name in REPLAYED:
        print(f"{name:12s} {replay[name]}")
    if replay["changed"]:
        print_error(
            f"differs from the store in {', '.join(replay['changed'])}: another code version"
        )
    if replay["error"]:
        print(replay["error"])
    for path in replay["pictures"][:10]:
        print(path)




# Terminal output of `skysim survey --plan` and `--repeat`: the attitudes to hold, predicted and
# simulated errors.


SHOWN_STOPS = 12  # attitudes of a plan that are printed; the file has all


def print_plan(plan: dict[str, Any]) -> None:
    from skysim.experiments.dome_survey.survey_report import stop_table

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


