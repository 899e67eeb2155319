"""Studies from Python: run all trials of a study and return its table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skysim.experiments.study import loader, store
from skysim.experiments.study.analysis import table as tables
from skysim.experiments.study.execution import runner
from skysim.experiments.study.plan import Plan

if TYPE_CHECKING:
    import pandas as pd
    from astropy.table import Table


@dataclass(frozen=True, slots=True)
class StudyResult:
    """A study whose trials are in a store: its plan, the store's path and how many trials failed."""

    plan: Plan
    path: Path
    failed: int

    def table(self) -> Table:
        """One row a design point: its factors, and each response with its confidence interval and count."""
        from astropy.table import Table

        with store.open_store(self.path) as kept:
            return Table(tables.flat(tables.table(kept, self.plan.study.responses)))

    def trials(self) -> Table:
        """One row a trial: the design point, its factors and every measured number."""
        from astropy.table import Table

        with store.open_store(self.path) as kept:
            return Table(tables.everything(kept))

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
    """Run the missing trials of a study, a file or a name in scenes/studies, and keep them in a store.

    overrides : keys of the study and their values, such as {"replicates": 20}
    out       : folder of the store; out/NAME if left out. A store of the same study is continued
    workers   : processes, as many as there are cores if left out; 1 runs the trials in this process

    A script that uses several processes needs the usual `if __name__ == "__main__":`. Raises InputError.
    """
    texts = {key: one if isinstance(one, str) else json.dumps(one) for key, one in (overrides or {}).items()}
    plan = loader.load(str(name), texts)
    folder = Path(out) if out is not None else Path("out") / Path(name).stem
    engine = runner.ENGINES["serial" if workers == 1 else "pool"](workers, "")
    path = folder / store.STORE
    try:
        with store.writing(path) as kept:
            runner.begin(plan, kept, resume=kept.counts()["done"] > 0, overrides=texts)
            progress = runner.run(plan, kept, engine)
    finally:
        engine.close()
    return StudyResult(plan, path, progress.failed)
