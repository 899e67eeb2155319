"""The areas of the baseline. Each has cases by name: functions of an empty folder that yield keys and digests."""

from __future__ import annotations

import csv
import json
import shlex
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import skysim
from tests.baseline import digest
from tests.baseline.command import ROOT, forked, run, succeed
from tests.baseline.digest import Entries

Case = Callable[[Path], Entries]
CASES = {
    path.stem: yaml.safe_load(path.read_text(encoding="utf-8"))
    for path in Path(__file__).parent.glob("cases/*")
}


def write_files(folder: Path, files: dict[str, str]) -> None:
    """Write small text files that a case needs."""
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


def prefixed(name: str, entries: Entries) -> Entries:
    """The same entries with a word before their keys."""
    for key, value in entries:
        yield f"{name} {key}", value


def shipped(folder: str) -> list[str]:
    """Names of the YAML files of a folder of the repository."""
    return sorted(path.stem for path in (ROOT / folder).glob("*.yaml"))


def scene_cases() -> dict[str, Case]:
    """Every shipped scene and every variant, by the command `run`; and runs from Python."""
    given = CASES["scenes"]
    cases: dict[str, Case] = {
        name: partial(run_scene, name, given["shipped"].get(name, given["frames"]))
        for name in shipped("scenes")
    }
    cases |= {
        name: partial(run_variant, name, keys) for name, keys in given["variants"].items()
    }
    return cases | {
        f"python {name}": partial(run_python, text) for name, text in given["python"].items()
    }


def run_variant(name: str, keys: dict[str, Any], folder: Path) -> Entries:
    """Write a scene with its files and run all of its frames."""
    scene = yaml.safe_dump({"schema": 1, "title": name} | keys, sort_keys=False)
    write_files(folder, CASES["scenes"]["files"] | {f"{name}.yaml": scene})
    return run_scene(f"{name}.yaml", None, folder)


def run_scene(scene: str, frames: int | None, folder: Path) -> Entries:
    """Messages, JSON and files of `skysim run`, and facts of `skysim check`. frames : the scene's if None"""
    ran = succeed(
        folder,
        "run",
        scene,
        "--json",
        "--out",
        "out",
        *(["--frames", str(frames)] if frames else []),
    )
    yield "messages", ran.err
    yield from prefixed("json", digest.values(json.loads(ran.out)))
    yield from result_files(folder / "out")
    yield from prefixed(
        "check", digest.values(json.loads(succeed(folder, "check", scene, "--json").out))
    )


def run_python(text: str, folder: Path) -> Entries:
    """The files that statements write to the folder `out`."""
    (folder / "out").mkdir()
    ran = forked(folder, partial(execute, text))
    if ran.code:
        raise RuntimeError(ran.err)
    return result_files(folder / "out")


def execute(text: str) -> None:
    """Execute statements; a wrong input ends the process with the error's type and text."""
    try:
        exec(text, {"skysim": skysim, "np": np})
    except skysim.InputError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)


def result_files(folder: Path) -> Entries:
    """Names of the files of a run, its frames with truth, and its tables; those of further cameras too."""
    paths = sorted(folder.iterdir())
    yield "files", " ".join(path.name for path in paths)
    for path in paths:
        if path.suffix == ".fits":
            yield from prefixed(path.stem, digest.frame_file(path))
        elif path.suffix == ".npy":
            yield path.stem, digest.array(np.load(path))
        elif path.suffix == ".ecsv" and path.stem.startswith("frame_"):
            yield f"{path.stem} truth", digest.sha(path.read_bytes())
        elif path.suffix == ".ecsv":
            yield from prefixed(path.stem, digest.ecsv(path))
        elif path.is_dir():
            yield from prefixed(path.name, result_files(path))


def study_cases() -> dict[str, Case]:
    """Every shipped study, reduced."""
    given = CASES["studies"]
    cases: dict[str, Case] = {}
    for name in shipped(
        "scenes/studies"
    ):  # one without a line in the file of cases is a KeyError
        keys = dict(given[name])
        prefix = "long " if keys.pop("long", False) else ""
        cases[prefix + name] = partial(
            run_study, name, "optimize" if keys.pop("search", False) else "run", keys
        )
    return cases


def run_study(name: str, verb: str, keys: dict[str, Any], folder: Path) -> Entries:
    """The table of a study, and the rows of each of its points without times."""
    overrides = [word for key, value in keys.items() for word in ("--set", f"{key}={value}")]
    ran = succeed(
        folder,
        "study",
        verb,
        name,
        "--engine",
        "serial",
        "--json",
        "--out",
        "out",
        *overrides,
    )
    report = json.loads(ran.out)
    yield from prefixed("table", digest.values(report.pop("points")))
    yield from prefixed("json", digest.values(report))
    succeed(folder, "study", "export", name, "trials.csv", "--out", "out")
    points: dict[str, list[dict[str, str]]] = {}
    with (folder / "trials.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            points.setdefault(row["point"], []).append(digest.steady(row))
    for point, rows in points.items():
        yield f"point {point}", f"{len(rows)} rows {digest.sha(json.dumps(rows))}"


def run_session(lines: list[str], folder: Path) -> Entries:
    """Run commands one after another in one folder: the structure of what they print with --json, else its digest."""
    write_files(folder, CASES["contracts"]["files"])
    for line in lines:
        ran = run(folder, *shlex.split(line))
        yield f"{line}: exit code", str(ran.code)
        if "--json" in line:
            yield from prefixed(
                f"{line}:", iter(digest.structure(json.loads(ran.out)).items())
            )
        else:
            yield f"{line}: text", digest.sha(ran.out)


def run_live(scene: str, folder: Path) -> Entries:
    """Packets of a pipe, and files of a folder, of three frames as fast as possible."""
    words = ("live", scene, "--speed", "0", "--frames", "3", "--json")
    ran = succeed(folder, *words, "--pipe", "-")
    yield "statistics", json.dumps(digest.steady(json.loads(ran.err)))
    data = ran.out
    while data:
        line, _, data = data.partition(b"\n")
        header = json.loads(line)
        size = header["bytes"]
        yield f"packet {header['index']}", json.dumps(digest.steady(header))
        yield f"packet {header['index']} pixels", digest.sha(data[:size])
        data = data[size:]
    succeed(folder, *words, "--folder", "out")
    for path in sorted((folder / "out").iterdir()):
        content = path.read_bytes()
        yield (
            path.name,
            digest.sha(
                json.dumps(digest.steady(json.loads(content)))
                if path.suffix == ".json"
                else content
            ),
        )


def run_survey(words: str, folder: Path) -> Entries:
    """Statistics and files of a survey of a small dome."""
    write_files(folder, CASES["contracts"]["files"])
    ran = succeed(folder, "survey", *words.split(), "--json", "--out", "out")
    yield "messages", ran.err
    yield from prefixed("json", digest.values(json.loads(ran.out)))
    for path in sorted((folder / "out").glob("*.*sv")):
        yield path.name, digest.sha(path.read_bytes())


def message_cases() -> dict[str, Case]:
    """Error messages for wrong input of the command line and of Python."""
    given = CASES["messages"]
    cases: dict[str, Case] = {
        f"skysim {line}": partial(refused, line) for line in given["commands"].splitlines()
    }
    return cases | {text: partial(raised, text) for text in given["python"].splitlines()}


def refused(line: str, folder: Path) -> Entries:
    """Exit code and text of a wrong command."""
    write_files(folder, CASES["messages"]["files"])
    ran = run(folder, *shlex.split(line))
    yield "", f"{ran.code}: {ran.err.strip()}"


def raised(text: str, folder: Path) -> Entries:
    """Type and text of the error of a wrong Python statement."""
    write_files(folder, CASES["messages"]["files"])
    ran = forked(folder, partial(execute, text))
    yield "", f"{ran.code}: {ran.err.strip()}"


AREAS: dict[str, Callable[[], dict[str, Case]]] = {
    "scenes": scene_cases,
    "studies": study_cases,
    "contracts": lambda: {
        name: partial(run_session, lines)
        for name, lines in CASES["contracts"]["sessions"].items()
    },
    "live": lambda: {
        scene: partial(run_live, scene) for scene in ("shefex2", "afit_simsat", "simsat_bump")
    },
    "surveys": lambda: {
        name: partial(run_survey, words) for name, words in CASES["surveys"].items()
    },
    "messages": message_cases,
}
