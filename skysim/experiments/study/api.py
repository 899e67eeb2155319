"""Python interface to studies: run all trials of a study and return its tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from skysim.core.yaml_reader import override_texts
from skysim.experiments.study import study_file, table
from skysim.experiments.study.execution import runner, store
from skysim.experiments.study.plan import Plan
from skysim.experiments.study.report.study_report import study_report
from skysim.results.report import Report

if TYPE_CHECKING:
    import pandas as pd
    from astropy.table import Table


class StudyResult(NamedTuple):
    """A study with its trials in a store: plan, path of the store, number of failed trials."""

    plan: Plan
    path: Path
    failed: int

    def table(self) -> Table:
        """One row per design point: its factors, and each response with its confidence interval and trial count."""
        from astropy.table import Table

        with store.open_store(self.path) as kept:
            return Table(table.to_columns(table.table(kept, self.plan.study.responses)))

    def trials(self) -> Table:
        """One row per trial: design point, factors and every measured quantity."""
        from astropy.table import Table

        with store.open_store(self.path) as kept:
            return Table(dict(table.trial_columns(kept)))

    def report(self) -> Report:
        """The study's report: answers, figures and tables."""
        with store.open_store(self.path) as kept:
            return study_report(self.plan, kept)

    def to_pandas(self) -> pd.DataFrame:
        """`table` as a data frame; needs pandas."""
        return self.table().to_pandas()


def run_study(
    name: str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    out: str | Path | None = None,
    workers: int | None = None,
) -> StudyResult:
    """Run the missing trials of a study and keep them in a store.

    A script that uses several processes needs the usual `if __name__ == "__main__":`. Raises InputError.

    Parameters
    ----------
    name
        Path of a study file, or name of a study in scenes/studies
    overrides
        Keys of the study and their values, such as {"replicates": 20}
    out
        Folder of the store, by default out/NAME; a store of the same study is continued
    workers
        Number of processes, by default the number of cores; 1 runs the trials in this process
    """
    texts = override_texts(overrides)
    plan = study_file.load(str(name), texts)
    folder = Path(out) if out is not None else Path("out") / Path(name).stem
    engine = runner.ENGINES["serial" if workers == 1 else "pool"](workers, "")
    path = folder / store.STORE
    try:
        with store.writing(path) as kept:
            runner.prepare_store(
                plan, kept, resume=kept.counts()["done"] > 0, overrides=texts
            )
            progress = runner.run(plan, kept, engine)
    finally:
        engine.close()
    return StudyResult(plan, path, progress.failed)
