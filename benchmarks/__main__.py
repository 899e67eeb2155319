"""`python -m benchmarks [AREA ...] [--json]`: our speed beside the best peer's, in the same run."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from benchmarks import AREAS, measure
from skysim.core.files import to_json

HEADS = ("what", "ours", "peer", "peer's", "ratio", "bar", "met")


def main(words: list[str] | None = None) -> None:
    """Measure the areas that are named, all of them without a name, and print a table or JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("areas", nargs="*", metavar="AREA", help=", ".join(AREAS))
    parser.add_argument("--json", action="store_true", help="print JSON rows in place of a table")
    arguments = parser.parse_args(words)
    unknown = [area for area in arguments.areas if area not in AREAS]
    if unknown:
        parser.error(f"{unknown[0]!r} is not an area; allowed: {', '.join(AREAS)}")
    rows = []
    for area in arguments.areas or AREAS:
        print(f"benchmarks: {area}", file=sys.stderr, flush=True)
        rows += measure(area)
    print(to_json(rows) if arguments.json else table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as aligned columns."""
    cells = [
        [
            row["name"],
            f"{row['value']:.3g} {row['unit']}",
            str(row["peer"] or "-"),
            *(
                "-" if row[key] is None else f"{row[key]:.3g}"
                for key in ("peer_value", "ratio", "bar")
            ),
            {True: "yes", False: "no", None: "-"}[row["met"]],
        ]
        for row in rows
    ]
    lines = [list(HEADS), *cells]
    widths = [max(len(line[n]) for line in lines) for n in range(len(HEADS))]
    return "\n".join(
        "  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


if __name__ == "__main__":
    main()
