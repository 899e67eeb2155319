"""`python -m benchmarks [AREA ...] [--quick] [--count N] [--seed N] [--json]`: measure areas, and print their rows.

Without a name the quick part of every area runs, and what is left out is named. A name alone runs the whole area, which
can take hours; a group's name (`dome`) runs all its areas. `python -m benchmarks accept` runs all that has a bar.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

from benchmarks import AREAS, accept, chosen, measure, options
from skysim.core.files import to_json

HEADS = ("what", "ours", "peer", "peer's", "ratio", "bar", "met")


def main(words: list[str] | None = None) -> int:
    """Measure the areas that are named, the quick parts of all without a name, and print a table or JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        epilog="\n".join(["areas:", *map(described, AREAS)]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "areas", nargs="*", metavar="AREA", help="one of those below, or `accept`"
    )
    parser.add_argument("--quick", action="store_true", help="the quick part of each area")
    parser.add_argument(
        "--count", type=int, help="frames, fields or trials in place of the area's"
    )
    parser.add_argument("--seed", type=int, help="the seed in place of the area's")
    parser.add_argument(
        "--json", action="store_true", help="print JSON rows in place of a table"
    )
    arguments = parser.parse_args(words)
    if arguments.areas == ["accept"]:
        return accept.main(arguments.quick)
    unknown = [name for name in arguments.areas if not chosen(name)]
    if unknown:
        parser.error(f"{unknown[0]!r} is not an area; allowed: {', '.join(AREAS)}")
    quick = arguments.quick or not arguments.areas
    areas = [area for name in arguments.areas or AREAS for area in chosen(name)]
    areas = list(dict.fromkeys(areas))
    rows = []
    for area in areas:
        asked = {"count": arguments.count, "seed": arguments.seed}
        asked = {key: value for key, value in asked.items() if value is not None}
        if quick and AREAS[area].quick is None:
            continue
        refused = sorted(asked.keys() - options(area))
        if refused:
            parser.error(f"{area} has no --{refused[0]}")
        print(f"benchmarks: {area}", file=sys.stderr, flush=True)
        try:
            rows += measure(area, **((AREAS[area].quick or {}) if quick else {}) | asked)
        except ModuleNotFoundError as error:
            if arguments.areas:
                raise
            print(f"benchmarks: {area} is left out: {error}", file=sys.stderr, flush=True)
    print(to_json(rows) if arguments.json else table(rows))
    if quick:
        print(left_out(areas), file=sys.stderr)
    return 0


def described(area: str) -> str:
    """An area's line of the help."""
    quick = AREAS[area].quick
    what = "long" if quick is None else "long, with a quick part" if quick else "quick"
    return f"  {area:22s}{AREAS[area].about} ({what})"


def left_out(areas: list[str]) -> str:
    """What a run of the quick parts did not measure."""
    long = [area for area in areas if AREAS[area].quick is None]
    part = [area for area in areas if AREAS[area].quick]
    return (
        f"Not measured: {', '.join(long) or 'nothing'}.\n"
        f"Measured in part: {', '.join(part) or 'nothing'}.\n"
        "`python -m benchmarks AREA` measures all of an area."
    )


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
        "  ".join(
            f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)
        ).rstrip()
        for line in lines
    )


if __name__ == "__main__":
    sys.exit(main())
