"""The answers of a study in words: range of each response, thresholds, and how often the tracker answers wrongly.

Misidentification (a light matched with a wrong star or LED) is kept apart from honest roll noise (the right lights, and
an error that the covariance allows). An event that was never seen has an upper bound instead of an interval.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skysim.experiments.study.analysis import claims, thresholds
from skysim.experiments.study.analysis.axes import axis, distinct, unit_of
from skysim.experiments.study.analysis.table import (
    Place,
    PointRow,
    format_level,
    format_summary,
    has_few_values,
)
from skysim.experiments.study.factors import Value
from skysim.experiments.study.plan import Study
from skysim.results import metrics
from skysim.results.metrics import Summary

EVENTS = {
    "misidentified": "Misidentified (at least one light matched with a wrong star or LED)",
    "roll_noise": "Roll noise (the right lights, but a roll error beyond 10′ that the covariance allows)",
    "wrong": "Wrong attitudes (an error beyond 10′ that the covariance does not allow, or beyond 1°)",
}
SHARES = (*EVENTS, "ambiguous", "misled", "refused")
RESPONSES = (
    *SHARES,
    "mismatched",
    "nees",
)  # responses that the answers need besides those of the study


def headline(
    study: Study,
    lines: Sequence[PointRow],
    may_be_ambiguous: bool,
    worst: str = "skysim study worst STUDY",
) -> list[str]:
    """Thresholds, refusals, ambiguity and wrong answers, one sentence or two each; none if all trials failed.

    lines : of all points, with the responses of the study and RESPONSES
    may_be_ambiguous : whether the tracker can refuse a frame as ambiguous
    worst : the command that lists the worst trials
    """
    done = [line for line in lines if line.trials and np.isfinite(line.responses["wrong"].value)]
    if not done:
        return []
    place = placer(study, done)
    found = list[str]()
    for threshold in study.thresholds:
        found += thresholds.sentences(threshold, study, done)
    found.append(solved_everywhere(study, done, place, worst))
    if may_be_ambiguous:
        found.append(ambiguity(study, done, place))
    for name, text in EVENTS.items():
        found.append(event(text, [line.responses[name] for line in done], done, place))
        found += claims.effect_of_wrong_matches(done, place) if name == "misidentified" else []
    return [*found, *claims.runs_needed(done, list(EVENTS)), *claims.claimed_errors(done, place)]


def ranges(study: Study, lines: Sequence[PointRow]) -> list[str]:
    """Smallest and largest value of each response over the points, but of those that the headline is about."""
    done = [line for line in lines if line.trials]
    place = placer(study, done)
    return (
        [response_range(name, done, place) for name in study.responses if name not in SHARES]
        if done
        else []
    )


def placer(study: Study, lines: Sequence[PointRow]) -> Place:
    """The function that names a point by the levels that vary: "leds = 900, rate = 8 deg/s"."""
    varied = [
        name for name in study.factors if len(distinct(line.levels[name] for line in lines)) > 1
    ]
    units = {name: unit_of(axis(study, lines, name)) for name in varied}

    def named(name: str, level: Value) -> str:
        return f"{name} = {format_level(level)}" + ("" if isinstance(level, str) else units[name])

    return lambda line: ", ".join(named(name, line.levels[name]) for name in varied)


def response_range(name: str, lines: Sequence[PointRow], place: Place) -> str:
    """Smallest and largest value of a response over the points; those of few values only if there are no others."""
    known = [line for line in lines if np.isfinite(line.responses[name].value)]
    known = [line for line in known if not has_few_values(line, name)] or known
    if not known:
        return f"{name}: no trial has a value."
    least, most = (pick(known, key=lambda line: line.responses[name].value) for pick in (min, max))
    low, high = (format_summary(line.responses[name]) for line in (least, most))
    if least.responses[name].value == most.responses[name].value:
        return f"{name}: {low}" + (f" at all {len(known)} points." if len(known) > 1 else ".")
    return f"{name}: {low} at {place(least)}, to {high} at {place(most)}."


def event(text: str, shares: Sequence[Summary], lines: Sequence[PointRow], place: Place) -> str:
    """How often an event happens: the point where it is most frequent, and an upper bound where it was never seen."""
    known = [
        (share, line) for share, line in zip(shares, lines, strict=True) if np.isfinite(share.value)
    ]
    if not known:
        return f"{text}: unknown, as the tracker does not name its lights."
    never = [share for share, _ in known if share.value == 0]
    if len(never) == len(known):
        return f"{text}: {none_of(never)}."
    most, line = max(known, key=lambda pair: pair[0].value)
    where = (
        f" at {len(known) - len(never)} of {len(known)} points, most at {place(line)}:"
        if len(known) > 1
        else ""
    )
    found = f"{text}:{where} {percent(most.value)} of the frames ({interval(most)})"
    return f"{found}; {none_of(never)} at the other points." if never else f"{found}."


def ambiguity(study: Study, lines: Sequence[PointRow], place: Place) -> str:
    """Whether the lights of some attitude fit another one as well: refused as ambiguous, or misled."""
    shares = []
    for line in lines:
        refused = line.responses["ambiguous"]
        wrong = line.responses["misled"]
        either = refused.value + np.nan_to_num(wrong.value)
        share = metrics.proportion(round(either * refused.trials), refused.trials)
        shares.append(share._replace(value=either))
    unit = ", each with hardware of its own" if study.hardware else ""
    text = event("Ambiguous or misled", shares, lines, place)
    never = all(share.value == 0 for share in shares)
    return f"Is it ambiguous anywhere{unit}? {'No' if never else 'Yes'}. {text}"


def solved_everywhere(study: Study, lines: Sequence[PointRow], place: Place, worst: str) -> str:
    """Whether every attitude is solved, and how often and where the tracker refuses one for any reason."""
    shares = [line.responses["refused"] for line in lines]
    text = event("Refused (no attitude is returned)", shares, lines, place)
    what = "attitude" if study.trial.kind == "centroids" else "frame"
    if all(share.value == 0 for share in shares):
        return f"Is every {what} solved? Yes. {text}"
    return f"Is every {what} solved? No. {text} `{worst} --response refused` names the worst."


def one_unit(fixed: Sequence[str]) -> list[str]:
    """That the intervals are of one unit of hardware, and how to cover others; nothing without a seed drawn once."""
    if not fixed:
        return []
    units = " and ".join(
        "one survey" if seed.startswith("tracker.") else "one draw of the LEDs" for seed in fixed
    )
    return [
        f"Intervals cover other attitudes, with {units}: `hardware: [{', '.join(fixed)}]` in the study draws"
        " the hardware anew in every replicate, and they cover it too."
    ]


def none_of(shares: Sequence[Summary]) -> str:
    """That an event was never seen, and the exact upper bound of its frequency (Clopper & Pearson 1934)."""
    fewest = min(share.trials for share in shares)
    each = " a point" if len(shares) > 1 else ""
    bound = metrics.exact_bounds(0, fewest)[1] if fewest else 1.0
    return f"none in {fewest:,}{each} (less than {100 * bound:.2g} % at {100 * metrics.CONFIDENCE:g} % confidence)"


def interval(share: Summary) -> str:
    """The interval of a share in percent."""
    return f"{100 * share.low:.3g} to {percent(share.high)}"


def percent(share: float) -> str:
    """A share in percent, to three digits."""
    return f"{100 * share:.3g} %"
