"""Write docs/findings/studies/*.md with their figures, from the stores of completed studies. `make studies` does both.

`python docs/site/studies.py [FOLDER]`: of every study's store in FOLDER/NAME (out/ if left out).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from skysim.core.files import STUDIES
from skysim.core.types import Floats
from skysim.experiments.study import search
from skysim.experiments.study.execution import store
from skysim.experiments.study.execution.store import STORE, Store
from skysim.experiments.study.plan import Plan
from skysim.experiments.study.report.study_report import (
    POINTS,
    STUDY_FILE,
    analyze,
    commands,
    compose,
)
from skysim.experiments.study.study_file import load
from skysim.results.report import Report
from skysim.results.report_blocks import Section, Text

PAGES = Path(__file__).parents[1] / "findings" / "studies"
BESIDE = {
    "dome_for_the_money": "dome_without_codes"
}  # a search whose front is drawn in another one's figure


def main(folder: Path) -> None:
    """Write a page for every study with a complete store."""
    PAGES.mkdir(exist_ok=True)
    for path in sorted(STUDIES.glob("*.yaml")):
        plan = load(path)
        store_path = folder / plan.name / STORE
        if not store_path.is_file():
            print(f"{store_path}: no such store; page not changed")
            continue
        with store.open_store(store_path) as trial_store:
            unfinished = trial_store.counts()["done"] < plan.study.trial_count(len(plan.points))
            if trial_store.meta("digest") != plan.digest or unfinished:
                print(
                    f"{store_path}: not finished, or of another version of the study; page not changed"
                )
                continue
            print(page(plan, trial_store, folder).save(PAGES / f"{plan.name}.md", f"{plan.name}_"))


def page(plan: Plan, trial_store: Store, folder: Path) -> Report:
    """A study's report with a link to its file; without the many points of Sobol indices and searches."""
    study = plan.study
    name = plan.name
    also = {f"front of {BESIDE[name]}": front_of(BESIDE[name], folder)} if name in BESIDE else None
    command = commands(plan, trial_store, name)
    report = compose(study, trial_store, analyze(plan, trial_store, command), command, also)
    left_out = {
        STUDY_FILE,
        *([POINTS] if study.optimize or study.design.kind == "saltelli" else []),
    }
    question, *blocks = (
        one for one in report.blocks if not (isinstance(one, Section) and one.title in left_out)
    )
    varied = Text(
        f"What is varied: [`{plan.path.name}`](../../../scenes/studies/{plan.path.name})."
    )
    return replace(report, blocks=[question, varied, *blocks])


def front_of(name: str, folder: Path) -> Floats:
    """(K, 2) objectives of the front of another search."""
    with store.open_store(folder / name / STORE) as trial_store:
        found = search.collect_result(load(name), trial_store).front
    return np.array([candidate.objectives for candidate in found])


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out"))
