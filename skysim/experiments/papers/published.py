"""Published data: numbers with their source, the tolerance of the reproduction, and the papers' errors."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.core.types import Floats
from skysim.core.units import ConfigModel, NotNegative, Number
from skysim.core.yaml_reader import explain, read_yaml

FOLDER = DATA / "published"


class PublishedRow(ConfigModel):
    """One published number.

    Attributes
    ----------
    quantity
        Its description, with the unit in parentheses
    published
        The number; at_least and at_most, one or both, replace it if the paper states only a
        bound
    tolerance
        Allowed difference of ours, in the same unit
    source
        The table, figure or page, if it differs from its experiment's
    derived
        Not printed, but follows from printed numbers by arithmetic or by generally accepted
        theory
    note
        Remark for the reader, such as a misprint or the reason for the tolerance
    """

    quantity: str
    published: Number | None = None
    at_least: Number | None = None
    at_most: Number | None = None
    tolerance: NotNegative = 0.0
    source: str = ""
    derived: bool = False
    note: str = ""

    @model_validator(mode="after")
    def check_number_or_bounds(self) -> Self:
        bounded = self.at_least is not None or self.at_most is not None
        if bounded == (self.published is not None):
            raise InputError("", "give either published, or at_least or at_most or both")
        return self

    @property
    def band(self) -> tuple[float, float]:
        """(low, high): values with which ours agrees; an open end is infinite."""
        if self.published is not None:
            return self.published - self.tolerance, self.published + self.tolerance
        low = float("-inf") if self.at_least is None else self.at_least - self.tolerance
        return low, float("inf") if self.at_most is None else self.at_most + self.tolerance


class Experiment(ConfigModel):
    """Published data of one experiment.

    Attributes
    ----------
    source
        Table, figure or section
    wrong
        Errors of the paper, with the corrected values
    assumed
        Our assumptions where the paper gives no value
    fitted
        Parameters chosen so that a number is reproduced; all such parameters are listed here
    data
        Published tables that are inputs of the experiment, row by row
    """

    title: str
    source: str
    wrong: str = ""
    assumed: tuple[str, ...] = ()
    fitted: tuple[str, ...] = ()
    data: dict[str, tuple[tuple[Number, ...], ...]] = Field(default_factory=dict)
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
            by_id[id] = experiment.model_copy(update={"paper": paper.paper})
    return by_id


def published_values(id: str, *keys: str) -> Floats:
    """(N,) published numbers of an experiment's rows; NaN for a row with bounds only."""
    rows = experiments()[id].rows
    return np.array([rows[key].published for key in keys], dtype=float)


def read(path: Path) -> Paper:
    """Read one file of data/published. Raises InputError."""
    tree, text = read_yaml(path)
    try:
        return Paper.model_validate(tree)
    except ValidationError as error:
        raise explain(error, Paper, tree, [(path, text)], {}) from error
