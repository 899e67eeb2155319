"""The commands of docs/findings/dome.md and of the estimator's README run, and print what the page shows in kind."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import AREAS
from skysim.core.paths import ROOT
from skysim.experiments.study import plan, study_file

DOME = (ROOT / "docs/findings/dome.md").read_text(encoding="utf-8")
ESTIMATOR = (ROOT / "estimator/README.md").read_text(encoding="utf-8")
COUNT = "--count"  # the word before the number of trials


def commands(page: str = DOME) -> list[list[str]]:
    blocks = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    return [
        shlex.split(line, comments=True)
        for block in blocks
        for line in block.splitlines()
        if line
    ]


def test_the_page_s_commands_exist_in_this_project() -> None:
    starts = [" ".join(words[:3]) for words in commands()]
    assert len(starts) >= 4
    for words in commands():
        if words[:3] == ["python", "-m", "benchmarks"]:
            assert words[3] in AREAS
        elif words[0] == "pytest":
            assert (ROOT / words[3]).is_file()
        else:
            assert words[0] == "skysim"


TABLES = [words for words in commands(DOME) + commands(ESTIMATOR) if words[0] == "python"]


@pytest.mark.long
@pytest.mark.parametrize("words", TABLES, ids=" ".join)
def test_the_page_s_tables_can_be_printed(words: list[str]) -> None:
    """Run with two trials per row instead of the page's number."""
    assert len(printed_with(words, 2)) >= 5


@pytest.mark.long
@pytest.mark.parametrize("words", TABLES, ids=" ".join)
def test_a_tenth_of_the_page_s_trials_prints_the_same_number_of_rows(
    words: list[str],
) -> None:
    """Numbers are the business of the modules' own tests."""
    trials = int(words[words.index(COUNT) + 1]) // 10
    assert len(printed_with(words, trials)) == len(printed_with(words, 2))


def printed_with(words: list[str], trials: int) -> list[str]:
    """The lines of a table's command with so many trials a row."""
    at = words.index(COUNT) + 1
    few = [*words[1:at], str(trials), *words[at + 1 :]]
    done = subprocess.run([sys.executable, *few], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.long
def test_the_page_s_survey_prints_what_the_page_shows(tmp_path: Path) -> None:
    """The command runs as typed there; solved stops and errors agree to a tenth with the table."""
    (words,) = [words for words in commands() if words[0] == "skysim"]
    command = [sys.executable, "-m", *words]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    (after,) = re.findall(
        r"^after: (\d+) of \d+.*?cross median ([\d.]+)″.*?roll median ([\d.]+)″",
        done.stdout,
        re.M,
    )
    rows = dict(
        re.findall(r"^\| (new attitudes|cross|roll).*\| ([\d.]+)[^|]*\|$", DOME, re.M)
    )
    shown = [float(rows[name]) for name in ("new attitudes", "cross", "roll")]
    assert [float(one) for one in after] == pytest.approx(shown, rel=0.1)


@pytest.mark.parametrize(
    "words", [words for words in commands() if words[0] == "skysim"], ids=" ".join
)
def test_the_page_s_skysim_commands_parse(words: list[str]) -> None:
    """Only options are parsed; `test_measure.py` runs a survey."""
    done = subprocess.run(
        [sys.executable, "-m", "skysim", words[1], "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0
    assert [word for word in words if word.startswith("--") and word not in done.stdout] == []


def test_the_page_s_surveys_are_run_by_tests() -> None:
    for words in commands():
        if words[0] == "pytest":
            assert words[words.index("-k") + 1] in (ROOT / words[3]).read_text(
                encoding="utf-8"
            )


# The pages of the studies.

STUDIES = (ROOT / "docs/findings/studies.md").read_text(encoding="utf-8")


@pytest.mark.long
def test_every_shipped_study_has_a_page_and_a_command() -> None:
    shipped = {path.stem for path in plan.STUDIES.glob("*.yaml")}
    listed = re.findall(
        r"\[(\w+)\]\(studies/(\w+)\.md\) \| `skysim study (run|optimize) (\w+)`", STUDIES
    )
    assert {name for name, page, _, command in listed if name == page == command} == shipped
    for name, _, verb, _ in listed:
        assert (verb == "optimize") == (study_file.load(name).study.optimize is not None)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "docs/findings/studies").glob("*.md")), ids=lambda path: path.stem
)
def test_a_study_s_page_answers_with_one_figure_and_one_table(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    study_plan = study_file.load(path.stem)
    assert text.startswith(f"# {study_plan.study.title}\n")
    assert text.endswith(f", seed {study_plan.study.seed}\n")
    counted = re.search(r"N: .*?, ([\d,]+) in all, none failed", text)
    assert counted is not None
    if study_plan.study.optimize is None:
        assert int(counted[1].replace(",", "")) == study_plan.trials
    pictures = re.findall(r"!\[[^]]*\]\((\w+\.png)\)", text)
    assert len(pictures) <= 1
    assert all((path.parent / name).is_file() for name in pictures)
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert 3 <= len(rows) <= 22
    assert text.count("\n| --- |") == 1
