"""Requirements on errors and events, and whether trials show that they are met.

Every requirement is a claim on the share of draws that miss it: of `cross_arcsec_p95: 60` at most 5 % may have an error
above 60, of `wrong: 0.001` at most 0.1 % may be wrong, of `identified: 0.99` at most 1 % may not be identified. With k
of n independent draws missing it, it is

    met              if the exact upper bound of the share (Clopper & Pearson 1934) is at most that share,
    not met          if the exact lower bound is above it,
    not shown yet    else, with the number of draws that would decide at the share seen so far.

Each bound holds at 95 %. So a quantile is required with the tolerance limit of 95 % confidence (`tol95`): 59 draws
without a miss show a 95 % quantile, 2,995 without an event a probability of 0.001. A claim that several requirements,
or all points of a study, are met holds at 95 % if each does (Berger 1982).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from skysim.results import metrics
from skysim.results.scoring import FrameRow
from skysim.simulation.checks.facts import REQUIREMENTS, Fact

MORE = ("identified", "coverage", "right_within")  # proportions of which more is better
MET, NOT_MET, NOT_SHOWN = "met", "not met", "not shown yet"


class Requirement(NamedTuple):
    """A requirement, as in a scene or study, the proportion that decides on it, and the share that may miss it."""

    name: str
    limit: float
    response: str
    allowed: float


def requirement(name: str, limit: float) -> Requirement:
    """The requirement of a key of a scene or study and its limit."""
    quantity, statistic = metrics.split_name(name)
    probability = metrics.probability_of(statistic)
    if probability is not None:
        return Requirement(name, limit, f"{quantity}_over_{limit}", 1 - probability)
    return Requirement(name, limit, name, 1 - limit if name.startswith(MORE) else limit)


class Judgment(NamedTuple):
    """Whether some trials meet a requirement.

    Attributes
    ----------
    misses, low, high
        Share of the draws that miss it, and its exact bounds, each at 95 %
    allowed
        Greatest share that meets it
    draws
        Number of independent draws; not whole if those of one run are correlated
    needs
        Number of draws in all that decides at this share of misses; 0 if it is decided
    """

    requirement: str
    limit: float
    answer: str
    misses: float
    low: float
    high: float
    allowed: float
    draws: float
    needs: int

    @property
    def claim(self) -> str:
        """The requirement in words."""
        sign = "≥" if self.requirement.startswith(MORE) else "≤"
        return f"{self.requirement} {sign} {self.limit:g}"

    def text(self, where: str = "") -> str:
        """The judgment in words, for some points of a study."""
        if not self.draws:
            return f"{self.claim}: {self.answer}{where}: it is measured by a study, in trials that have it"
        bound = f"less than {percent(self.high)}"
        if self.answer == NOT_MET:
            bound = f"more than {percent(self.low)}"
        needs = f", needs {self.needs:,} draws" if self.needs else ""
        return (
            f"{self.claim}: {self.answer}{where}{needs}: {percent(self.misses)} of {self.draws:.4g} draws miss it,"
            f" {bound} at {100 * metrics.CONFIDENCE:g} % confidence, {percent(self.allowed)} allowed"
        )


def percent(share: float) -> str:
    """A share in percent, to three digits."""
    return f"{100 * share:.3g} %"


def judge(
    one: Requirement, found: metrics.Summary, draws: float | None = None, points: int = 1
) -> Judgment:
    """Judge a requirement by the proportion that decides on it.

    Parameters
    ----------
    draws
        Number of independent draws, if it is not that of the values: the effective sample size in the exact bounds
        (Korn & Graubard 1998); their number need not be whole
    points
        Number of points of which a "not met" holds at 95 % together (Bonferroni 1936)
    """
    count = found.trials if draws is None else draws
    misses = float(np.nan_to_num(found.value))
    if one.name.startswith(MORE):
        misses = 1 - misses
    error = (1 - metrics.CONFIDENCE) / points
    low = metrics.exact_bounds(misses * count, count, 1 - error)[0]
    high = metrics.exact_bounds(misses * count, count)[1]
    answer = MET if high <= one.allowed else NOT_MET if low > one.allowed else NOT_SHOWN
    # The claim that more draws would show.
    share, limit = misses, one.allowed
    if misses > one.allowed:
        share, limit = 1 - misses, 1 - one.allowed
    needs = metrics.trials_needed(limit, share=share) if answer == NOT_SHOWN else 0
    return Judgment(*one[:2], answer, misses, low, high, one.allowed, count, needs)


def of_run(
    require: Mapping[str, float], rows: Sequence[FrameRow], facts: Sequence[Fact]
) -> list[Judgment]:
    """Judge the requirements of a scene by the frames of one run.

    Frames have independent noise and share the errors that a run draws once, such as those of its survey. With their
    share r of the variance by the facts of the check, n frames count as n / (1 + (n - 1) r) independent draws (Kish
    1965, section 5.4); as one without this fact.
    """
    forecast = [fact.values["drawn_once"] for fact in facts if fact.name == REQUIREMENTS]
    drawn_once = forecast[0] if forecast else 1.0
    values = [
        (1, row.status == "solved", row.wrong, row.cross_arcsec, 0, row.roll_arcsec)
        for row in rows
    ]
    names = ("frames", "solved", "wrong", "x_arcsec", "y_arcsec", "roll_arcsec")
    columns = dict(zip(names, np.array(values, float).T, strict=True))
    judged = []
    for one in (requirement(*item) for item in require.items()):
        try:
            found = metrics.response(one.response)(columns)
        except KeyError:  # frames of a run do not have it
            found = metrics.NO_VALUE
        draws = found.trials / (1 + max(found.trials - 1, 0) * drawn_once)
        judged.append(judge(one, found, draws))
    return judged
