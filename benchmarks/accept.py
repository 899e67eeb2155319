"""`python -m benchmarks accept [--quick]`: every bar of the areas and every long test, in out/accept.json.

A step is an area or a file of long tests, measured in a process of its own. Its rows are written when it ends, so a run
that was stopped goes on: a step is left out if its rows are of the code as it is. A row is

    name    : of a benchmark's row, or a test
    command : what repeats it
    figure, unit, bar : value and bar of the benchmark's row; seconds, and "passes", of a test
    met     : None where something that it needs is not installed
    code    : hash of skysim and estimator; commit : of the checkout, with + if files differ from it

`--quick` measures QUICK alone, in about a minute, and keeps the bars that hold for any number of frames on any machine:
no wrong attitude, no defect. Exit code 1 if a bar is missed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks import AREAS
from skysim.core.files import to_json
from skysim.core.paths import ROOT
from skysim.experiments.study.execution.trials import code_version

OUT = ROOT / "out"
RESULTS = OUT / "accept.json"
QUICK_RESULTS = OUT / "accept_quick.json"
LONG_JUNIT = OUT / "accept_junit.xml"
# Areas of the quick run, with options that keep all of them within a minute.
QUICK = {
    "nees": {"count": 20},
    "codes_attitudes": {"count": 10},
    "dome_identify": {"count": 50},
    "robust_hostile": {"count": 60},
    "robust_no_sky": {"count": 300},
}
# Bars of the quick run: nothing of these is wrong, however few are tried. A share or a mean NEES of so few would miss
# its bar by chance, and a time because the machine is busy.
COUNTED = {"frames", "fields", "attitudes", "images"}
Row = dict[str, Any]


def main(quick: bool) -> int:
    """Measure what is missing, step by step; print bars that are missed; return the exit code."""
    path = QUICK_RESULTS if quick else RESULTS
    code = code_version()
    commit = commit_of_checkout()
    steps = quick_steps() if quick else all_steps()
    kept = {} if quick else rows_by_command(path)
    begin = time.monotonic()
    for n, command in enumerate(steps, 1):
        say = f"accept: {n} of {len(steps)}, {time.monotonic() - begin:.0f} s: {' '.join(command)}"
        key = " ".join(command)
        if kept.get(key) and all(row["code"] == code for row in kept[key]):
            continue
        print(say, file=sys.stderr, flush=True)
        rows = (
            test_rows(command) if command[0] == "pytest" else benchmark_rows(command, quick)
        )
        kept[key] = [
            {"name": name, "command": key, **row, "code": code, "commit": commit}
            for name, row in rows
        ]
        write([row for each in steps for row in kept.get(" ".join(each), [])], path)
    return report([row for command in steps for row in kept[" ".join(command)]], path)


def quick_steps() -> list[list[str]]:
    """The commands of QUICK."""
    return [
        [
            "python",
            "-m",
            "benchmarks",
            area,
            *(f"--{key}={value}" for key, value in chosen.items()),
        ]
        for area, chosen in QUICK.items()
    ]


def all_steps() -> list[list[str]]:
    """Commands of all areas, quick ones first, and of all files with long tests."""
    areas = sorted(AREAS, key=lambda area: AREAS[area].quick is None)
    listed = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", "-q", "-m", "long"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    files = [
        line.rpartition(":")[0]
        for line in listed.stdout.splitlines()
        if line.startswith("tests/")
    ]
    return [
        *(["python", "-m", "benchmarks", area] for area in areas),
        *(["pytest", "-m", "long", file] for file in files),
    ]


def benchmark_rows(command: list[str], quick: bool) -> Iterator[tuple[str, Row]]:
    """The rows of an area that have a bar. In the quick run only those that count what is wrong."""
    area, *words = command[3:]
    given = dict(word.removeprefix("--").split("=") for word in words)
    rows = measured(area, {key: int(value) for key, value in given.items()})
    if rows is None:
        yield area, {"figure": None, "unit": "", "bar": "runs", "met": False}
        return
    for row in rows:
        if row["met"] is None or (quick and row["unit"] not in COUNTED):
            continue
        facts = {
            "figure": row["value"],
            "unit": row["unit"],
            "bar": row["bar"],
            "met": row["met"],
        }
        yield f"{area}: {row['name']}", facts


def measured(area: str, options: dict[str, int]) -> list[Row] | None:
    """The rows of an area, measured in a process of its own; None if it fails."""
    code = (
        "import json, sys; from benchmarks import measure; from skysim.core.files import to_json\n"
        "print(to_json(measure(sys.argv[1], **json.loads(sys.argv[2]))))"
    )
    words = [sys.executable, "-c", code, area, json.dumps(options)]
    done = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        return None
    rows: list[Row] = json.loads(done.stdout)
    return rows


def test_rows(command: list[str]) -> Iterator[tuple[str, Row]]:
    """The long tests of a file, each with its time."""
    LONG_JUNIT.unlink(missing_ok=True)
    junit = ("--junitxml", str(LONG_JUNIT))
    subprocess.run(
        [sys.executable, "-m", *command, *junit],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        check=False,
    )
    if not LONG_JUNIT.exists():
        yield command[-1], {"figure": None, "unit": "s", "bar": "passes", "met": False}
        return
    for test in ElementTree.parse(LONG_JUNIT).iter("testcase"):
        outcomes = {outcome.tag for outcome in test}
        met = None if "skipped" in outcomes else not outcomes & {"failure", "error"}
        facts = {
            "figure": float(test.get("time", 0)),
            "unit": "s",
            "bar": "passes",
            "met": met,
        }
        yield f"{command[-1]}::{test.get('name')}", facts


def rows_by_command(path: Path) -> dict[str, list[Row]]:
    """The rows of an earlier run."""
    kept: dict[str, list[Row]] = {}
    for row in json.loads(path.read_text()) if path.exists() else ():
        kept.setdefault(row["command"], []).append(row)
    return kept


def write(rows: list[Row], path: Path) -> None:
    """Write the rows; a run that is stopped meanwhile leaves the file as it was."""
    OUT.mkdir(exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(to_json(rows) + "\n")
    part.replace(path)


def commit_of_checkout() -> str:
    """The commit, with + if files differ from it; empty outside of a checkout."""
    done = subprocess.run(
        ["git", "describe", "--always", "--exclude", "*", "--dirty=+"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    return done.stdout.strip()


def report(rows: list[Row], path: Path) -> int:
    """Print the bars that are missed, and the counts; return the exit code."""
    missed = [row for row in rows if row["met"] is False]
    for row in missed:
        value = "no figure" if row["figure"] is None else f"{row['figure']:.4g} {row['unit']}"
        print(f"missed: {row['name']}: {value}, bar {row['bar']} ({row['command']})")
    met = sum(row["met"] is True for row in rows)
    other = len(rows) - met - len(missed)
    print(f"accept: {met} met, {len(missed)} missed, {other} not installed: {path}")
    return int(bool(missed))
