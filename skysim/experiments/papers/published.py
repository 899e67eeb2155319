"""What was published: numbers with their page, the tolerance to reproduce them to, and what the papers get wrong."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, ValidationError, model_validator

from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.core.units import ConfigModel, NotNegative, Number
from skysim.core.yaml_reader import explain, read_yaml

FOLDER = DATA / "published"


class Row(ConfigModel):
    """One published number.

    quantity : what it is, with its unit in brackets
    published: the number; in its place at_least and at_most, one or both, where a bound is all that was stated
    tolerance: how far ours may be off, in the same unit
    source   : the table, figure or page, where it is another than its experiment's
    derived  : not printed, but what follows from what is: by arithmetic, or by theory that is not ours alone
    note     : what the reader should know: a misprint, how the tolerance was come by
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
    def one_or_the_other(self) -> Self:
        bounded = self.at_least is not None or self.at_most is not None
        if bounded == (self.published is not None):
            raise ValueError("either published, or at_least and at_most")
        return self

    @property
    def band(self) -> tuple[float, float]:
        """From where to where ours agrees; an open end is infinite."""
        if self.published is not None:
            return self.published - self.tolerance, self.published + self.tolerance
        low = float("-inf") if self.at_least is None else self.at_least - self.tolerance
        return low, float("inf") if self.at_most is None else self.at_most + self.tolerance


class Experiment(ConfigModel):
    """What is published of one experiment.

    source : table, figure or section;  wrong: what the paper gets wrong, and the value corrected
    assumed: what the paper does not tell, and what was put in its place
    fitted : parameters that were chosen so that a number comes out: never without being told here
    data   : published tables that an experiment is set up by, row by row
    """

    title: str
    source: str
    wrong: str = ""
    assumed: tuple[str, ...] = ()
    fitted: tuple[str, ...] = ()
    data: dict[str, tuple[tuple[Number, ...], ...]] = Field(default_factory=dict)
    rows: Annotated[dict[str, Row], Field(min_length=1)]
    paper: str = ""


class Paper(ConfigModel):
    """A file of data/published: a paper and its experiments by id."""

    paper: str
    experiments: Annotated[dict[str, Experiment], Field(min_length=1)]


@cache
def experiments() -> dict[str, Experiment]:
    """All published experiments by id, in the order of the files and in them. Raises InputError."""
    found: dict[str, Experiment] = {}
    for path in sorted(FOLDER.glob("*.yaml")):
        told = read(path)
        for name, one in told.experiments.items():
            if name in found:
                raise InputError(f"experiments.{name}: stands in two files ({path})")
            found[name] = one.model_copy(update={"paper": told.paper})
    return found


def read(path: Path) -> Paper:
    """One file."""
    tree, text = read_yaml(path)
    try:
        return Paper.model_validate(tree)
    except ValidationError as error:
        raise InputError(explain(error, Paper, tree, [(path, text)], {})) from error
