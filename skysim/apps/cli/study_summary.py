"""Terminal output of `skysim study`: progress and provenance, table of results, replayed trial."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from skysim.apps.cli.terminal import print_error, print_table
from skysim.core.errors import printable

if TYPE_CHECKING:
    from skysim.experiments.study.plan import Plan
    from skysim.experiments.study.store import Store

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
    print(
        f"{printable(status['title'])}: {status['done']} of {status['trials']} trials, {status['failed']} failed,"
        f" {status['wrong']} wrong attitudes; {status['seconds']:.1f} s, {rate:.0f} trials/s\n"
        f"store: {status['store']} (code {status['code']})"
    )


def print_points(heads: Sequence[str], cells: Sequence[Sequence[str]]) -> None:
    """Print the table of a study's results, the first MAX_ROWS rows of it."""
    print_table("", heads, cells[:MAX_ROWS])
    if len(cells) > MAX_ROWS:
        print(f"and {len(cells) - MAX_ROWS} more points in the report")


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
