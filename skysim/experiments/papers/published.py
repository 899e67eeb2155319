"""Published data: experiments as files that the user runs, their numbers with sources, and the papers' errors."""

from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.core.units import ConfigModel, NotNegative, Number, PositiveInt, ZeroOrMore
from skysim.core.yaml_reader import explained, read_yaml

FOLDER = DATA / "published"

# What an agreement of a row says: a prediction may fail; the others are true by construction, or not printed.
RowClass = Literal["prediction", "bound", "derived", "fitted", "repeated", "input"]


class PublishedRow(ConfigModel):
    """One published number, and the response of our experiment that is compared with it.

    Attributes
    ----------
    quantity
        Its description, with the unit in parentheses
    row_class
        `prediction`: nothing of it is used; `bound`: only a bound is published; `derived`: not
        printed, but computed from printed numbers; `fitted`: a parameter was fitted to it;
        `repeated`: it follows from another row; `input`: the experiment is given it
    published
        The number; at_least and at_most, one or both, replace it if the paper states only a
        bound
    scatter
        Standard deviation of the published number
    draw
        Whether the number is a single draw, of which ours has the standard deviation between
        runs
    tolerance
        Difference that is allowed without scatter, such as half of the last digit
    response
        Path into the result of the experiment's command, see `reproduction`
    source
        The table, figure or page, if it differs from its experiment's
    note
        Remark for the reader, such as a misprint or the reason for the tolerance
    """

    quantity: str
    row_class: Annotated[RowClass, Field(alias="class")] = "prediction"
    published: Number | None = None
    at_least: Number | None = None
    at_most: Number | None = None
    scatter: NotNegative = 0.0
    draw: bool = False
    tolerance: NotNegative = 0.0
    response: str
    source: str = ""
    note: str = ""

    def check(self) -> None:
        bounded = self.at_least is not None or self.at_most is not None
        if bounded == (self.published is not None):
            raise InputError("", "give either published, or at_least or at_most or both")


class Experiment(ConfigModel):
    """An experiment of a paper: the command that repeats it, and its published numbers.

    Attributes
    ----------
    source
        Table, figure or section
    command, file
        `run` or `calibrate` with a scene, or `study` with a study
    runs, quick_runs
        Number of runs with other seeds; of replicates for a study
    clicks
        Option of `skysim calibrate`; its default if left out
    hardware
        Keys of the seeds of hardware that differ from run to run
    wrong
        Errors of the paper, with the corrected values
    assumed
        Our assumptions where the paper gives no value
    fitted
        Parameters chosen so that a number is reproduced; all such parameters are listed here
    """

    title: str
    source: str
    command: Literal["run", "calibrate", "study"]
    file: str
    runs: PositiveInt = 1
    quick_runs: PositiveInt = 1
    clicks: ZeroOrMore[int] | None = None
    hardware: tuple[str, ...] = ()
    wrong: str = ""
    assumed: tuple[str, ...] = ()
    fitted: tuple[str, ...] = ()
    rows: Annotated[dict[str, PublishedRow], Field(min_length=1)]
    paper: str = ""


class Paper(ConfigModel):
    """A file of data/published: a paper and its experiments by id."""

    paper: str
    experiments: Annotated[dict[str, Experiment], Field(min_length=1)]


@cache
def experiments() -> dict[str, Experiment]:
    """All published experiments by id, in the order of the files and within them. Raises InputError."""
    by_id: dict[str, Experiment] = {}
    for path in sorted(FOLDER.glob("*.yaml")):
        paper = read(path)
        for id, experiment in paper.experiments.items():
            if id in by_id:
                raise InputError(path, f"experiments.{id} is defined in two files")
            by_id[id] = experiment.with_values(paper=paper.paper)
    return by_id


def read(path: Path) -> Paper:
    """Read one file of data/published. Raises InputError."""
    tree, text = read_yaml(path)
    with explained(tree, [(path, text)], {}):
        return Paper.model_validate(tree)
