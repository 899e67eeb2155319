"""Compare skysim with its baseline, or record it: `python -m tests.baseline [AREA | AREA/CASE ...] [--record]`."""

from __future__ import annotations

import os

# Before numpy is imported: sums of BLAS threads depend on their number, and a forked process inherits no threads.
os.environ.update(
    {
        "OPENBLAS_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "100",
        "NO_COLOR": "1",
    }
)

import argparse
import fnmatch
import json
import sys
import tempfile
import time
from pathlib import Path

from tests.baseline.areas import AREAS, Case
from tests.baseline.command import preload
from tests.baseline.machine import differences, machine

DIGESTS = Path(__file__).parent / "digests"
LONG = "long "  # name of a case that takes a minute or more begins so
FAILED = "failed"  # key of the entry of a case that ends with an error
CHANGES = "tests/baseline/CHANGES.md"


def measured(area: str, cases: dict[str, Case]) -> dict[str, str]:
    """The entries of some cases of an area; prints progress."""
    entries = {}
    for number, (name, case) in enumerate(cases.items(), 1):
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            try:
                for key, value in case(Path(folder).resolve()):
                    entries[f"{name} | {key}" if key else name] = value
            except Exception as error:  # the others are compared all the same
                entries[f"{name} | {FAILED}"] = f"{type(error).__name__}: {error}"
        seconds = time.perf_counter() - began
        print(
            f"{area} {number}/{len(cases)} {seconds:5.1f} s  {name[:90]}",
            file=sys.stderr,
            flush=True,
        )
    return entries


def chosen(area: str, names: list[str], every: bool) -> dict[str, Case]:
    """The cases of an area that the command line names; if none, all but those that take long, or `every`."""
    cases = AREAS[area]()
    if not names or area in names:
        return {
            name: case for name, case in cases.items() if every or not name.startswith(LONG)
        }
    return {
        case: made
        for case, made in cases.items()
        if any(fnmatch.fnmatch(f"{area}/{case}", n) for n in names)
    }


def read(area: str) -> dict[str, dict[str, str]]:
    """The machine and the entries of an area as they were recorded; empty if they were not."""
    path = DIGESTS / f"{area}.json"
    return (
        json.loads(path.read_text(encoding="utf-8"))
        if path.exists()
        else {"machine": {}, "entries": {}}
    )


def recorded(area: str, cases: dict[str, Case]) -> dict[str, str]:
    """The recorded entries of some cases of an area, and of cases that are gone."""
    others = AREAS[area]().keys() - cases
    return {
        key: value
        for key, value in read(area)["entries"].items()
        if key.partition(" | ")[0] not in others
    }


def record(area: str, cases: dict[str, Case]) -> bool:
    """Write the entries of some cases beside those of the others, but for those of cases that failed."""
    now = measured(area, cases)
    before = recorded(area, cases)
    failed = {key: value for key, value in now.items() if key.endswith(f" | {FAILED}")}
    others = {key: value for key, value in read(area)["entries"].items() if key not in before}
    entries = {key: value for key, value in (others | now).items() if key not in failed}
    text = json.dumps(
        {"machine": machine(), "entries": dict(sorted(entries.items()))},
        indent=1,
        ensure_ascii=False,
    )
    DIGESTS.mkdir(exist_ok=True)
    (DIGESTS / f"{area}.json").write_text(f"{text}\n", encoding="utf-8")
    lines = [f"  {key}: {value}" for key, value in failed.items()]
    print(f"{area}: {len(now) - len(failed)} entries recorded", *lines, sep="\n", flush=True)
    return not failed


def compare(area: str, cases: dict[str, Case]) -> bool:
    """Print how many entries are the same as recorded, and list the others. Returns whether all are the same."""
    now = measured(area, cases)
    before = recorded(area, cases)
    lines = [
        f"  {line}; numbers may differ for that"
        for line in differences(read(area)["machine"])
    ]
    lines += [f"  gone     {key}: {before[key]}" for key in before if key not in now]
    lines += [f"  new      {key}: {now[key]}" for key in now if key not in before]
    for key in before.keys() & now.keys():
        if now[key] != before[key]:
            lines.append(f"  differs  {key}\n    - {before[key]}\n    + {now[key]}")
    same = sum(now.get(key) == value for key, value in before.items())
    print(
        f"{area}: {same} of {len(before)} entries are the same",
        *sorted(lines),
        sep="\n",
        flush=True,
    )
    return now == before


def main() -> int:
    """Returns 0 if everything is the same or was recorded, else 1."""
    parser = argparse.ArgumentParser(prog="python -m tests.baseline", description=__doc__)
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"{', '.join(AREAS)}, or AREA/CASE with * and ?",
    )
    parser.add_argument(
        "--record",
        action="store_true",
        help="write the digests instead of comparing with them",
    )
    parser.add_argument(
        "--all", action="store_true", help=f"also the cases {LONG}..., which take minutes"
    )
    asked = parser.parse_args()
    unknown = [name for name in asked.names if name.partition("/")[0] not in AREAS]
    if unknown:
        parser.error(f"{', '.join(unknown)}: allowed: {', '.join(AREAS)}, or AREA/CASE")
    preload()
    handle = record if asked.record else compare
    chosen_by_area = {area: chosen(area, asked.names, asked.all) for area in AREAS}
    done = [handle(area, cases) for area, cases in chosen_by_area.items() if cases]
    if not done:
        parser.error(f"no case is called {', '.join(asked.names)}")
    if not asked.record and not all(done):
        print(f"Intended changes belong in {CHANGES}; then record: make baseline RECORD=1")
    return 0 if all(done) else 1


if __name__ == "__main__":
    sys.exit(main())
