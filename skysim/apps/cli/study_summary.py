"""Terminal output of `skysim study`: progress and provenance, table of results, replayed trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from skysim.apps.cli.terminal import print_error, print_table, print_wrapped, table_width, terminal_width
from skysim.core.errors import printable

if TYPE_CHECKING:
    from skysim.experiments.study.analysis.worst import WorstTrial
    from skysim.experiments.study.execution.store import Store
    from skysim.experiments.study.plan import Plan

COLUMN_GAP = 2  # characters between two columns of a table
MAX_ROWS = 60  # printed rows of a table; the report has all
REPLAYED = (
    *("trial", "point", "replicate", "seed", "status", "x_arcsec", "y_arcsec", "roll_arcsec"),
    *("stars", "matched"),
)


def trial_count(plan: Plan) -> int:
    """Number of trials of a study or, if it runs to its end, of a search."""
    search = plan.study.optimize
    return plan.study.replicates * (search.candidates if search else len(plan.points))


def study_status(plan: Plan, store: Store) -> dict[str, Any]:
    """Progress and provenance of a study: trial counts, code version, run time and store."""
    return {
        "study": plan.name,
        "title": plan.study.title,
        "trials": trial_count(plan),
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


def print_points(heads: Sequence[str], cells: Sequence[Sequence[str]], factors: int = 0) -> None:
    """Print the table of a study's results, the first MAX_ROWS rows of it.

    factors : number of columns after the first that are factors. A terminal that is too narrow for all columns gets
              point and factors, and as many responses as fit.
    """
    shown = cells[:MAX_ROWS]
    count = fitting_columns(heads, shown, 1 + factors, terminal_width())
    print_table("", heads[:count], [row[:count] for row in shown])
    if count < len(heads):
        print_wrapped(f"in the report, or in a wider terminal: {', '.join(heads[count:])}")
    if len(cells) > MAX_ROWS:
        print(f"and {len(cells) - MAX_ROWS} more points in the report")


def print_front(heads: Sequence[str], cells: Sequence[Sequence[str]], candidates: int) -> None:
    """Print a search's front: a table, or a paragraph for each candidate where the terminal is too narrow."""
    print(f"front of {candidates} candidates:" if cells else f"no front: none of {candidates} candidates is feasible")
    if cells and table_width(heads, cells) <= terminal_width():
        print_table("", heads, cells)
        return
    for row in cells:
        print_wrapped(", ".join(f"{head} {cell}" for head, cell in zip(heads, row, strict=True)), others="    ")


def fitting_columns(heads: Sequence[str], cells: Sequence[Sequence[str]], kept: int, width: int) -> int:
    """Number of columns, from the first, that fit into a width; at least the first `kept`."""
    columns = zip(heads, *cells, strict=True)
    widths = [max(map(len, column)) for column in columns]
    total = 0
    for count, one in enumerate(widths):
        total += one + (COLUMN_GAP if count else 0)
        if total > width and count >= kept:
            return count
    return len(widths)


def print_answers(findings: Sequence[str], answers: Sequence[str]) -> None:
    """Print what the checks of the scene found, and the answers of a study, wrapped at the terminal's width."""
    for text in (*(f"check: {line}" for line in findings), *answers):
        print_wrapped(text)


def print_worst(
    response: str, found: Sequence[WorstTrial], levels: Sequence[Mapping[str, Any]], repeat: str, instead: str
) -> None:
    """Print the worst attitudes by a response, the settings that start there, and the commands that repeat them.

    levels : of each trial's point;  instead : the command to give if no trial counts for the response
    """
    if not found:
        print(f"no trial counts for {response}; rank them by an error: {instead}")
    for rank, (one, level) in enumerate(zip(found, levels, strict=True), 1):
        at = ", ".join(f"{name} = {value}" for name, value in level.items())
        print(f"{rank}. {one.direction}, {one.lights:.0f} lights: {printable(one.event)} ({printable(at)})")
        if one.start:
            print(f"   {one.start}")
        print(f"   {repeat} {one.trial}")


def print_replay(replay: dict[str, Any]) -> None:
    """Print the outcome of a repeated trial, and whether it differs from the stored one."""
    for name in REPLAYED:
        print(f"{name:12s} {replay[name]}")
    if replay["changed"]:
        print_error(f"differs from the store in {', '.join(replay['changed'])}: another code version")
    if replay["error"]:
        print(replay["error"])
    for path in replay["pictures"][:10]:
        print(path)
