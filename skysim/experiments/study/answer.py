"""The answers of a study in words: range of each response, thresholds, and how often the tracker answers wrongly.

Misidentification (a light matched with a wrong star or LED) is separate from roll noise (the right lights, and an error
that the covariance allows). An event that was never seen has an upper bound instead of an interval.
"""

import math
from collections.abc import Sequence

import numpy as np
import scipy

from skysim.experiments.study import thresholds
from skysim.experiments.study.table import (
    PointRow,
    PointRows,
    PointTable,
    format_summary,
    has_few_values,
)
from skysim.results.metrics import (
    CONFIDENCE,
    FEWEST,
    NO_VALUE,
    ONE_SURVEY,
    OVERCONFIDENCE_PROBABILITY,
    OVERCONFIDENT_NEES,
    SIGMAS,
    Summary,
    exact_bounds,
    joint_sigmas,
    proportion,
    trials_needed,
)
from skysim.results.requirements import Judgment, percent

# Claims that a study's numbers support, in words: whether the tracker's claimed errors are true, and rare events.


Sentences = list[str]
# Range of the mean NEES (3 if true) in which claimed errors are true to a tenth.
TRUE_NEES = (2.5, 3.5)
CLAIMED = "Are the claimed errors true?"
POWER = 0.8  # probability with which a stated factor is noticed


def claimed_errors(lines: PointTable, survey_share: float) -> Sentences:
    """Sentences on whether the claimed errors are true at all points, by the intervals of the mean NEES.

    Trials that share a survey cannot decide it if `survey_share` of the variance is the survey's, unless the mean NEES
    is beyond what one draw of three angles can have (probability OVERCONFIDENCE_PROBABILITY).
    """
    every = ((line.responses.get("nees", NO_VALUE), line) for line in lines)
    known = [(one, line) for one, line in every if one.trials]
    if not known:
        return []
    found = [(jointly(one, len(known)), line) for one, line in known]
    found = [(one, line) for one, line in found if np.isfinite(one.low)]
    low, high = TRUE_NEES
    means = [one.value for one, _ in known]
    shared = survey_share > ONE_SURVEY
    if shared and max(means) < OVERCONFIDENT_NEES:
        spread = f"{min(means):.3g}"
        spread += f" to {max(means):.3g}" if len(means) > 1 else ""
        return [
            f"{CLAIMED} One survey cannot decide it: {100 * survey_share:.0f} % of the expected variance is of the"
            f" survey that all trials share (NEES {spread}; over many surveys 3 if true). `hardware:"
            " [tracker.survey.seed]` draws one in every replicate; with tracker.map it takes maps of many surveys."
        ]
    if not found:
        most = max(one.trials for one, _ in known)
        return [
            f"{CLAIMED} Too few to say: {most} trials{everywhere(len(known))}, {FEWEST} are needed."
        ]
    together = f", 95 % for all {len(known)} points together" if len(known) > 1 else ""
    false = [(one, line) for one, line in found if one.low > high or one.high < low]
    if not false:
        few = len(known) - len(found)
        at = (
            f" at {len(found)} of {len(known)} points, too few to say at the others"
            if few
            else everywhere(len(found))
        )
        if all(one.low >= low and one.high <= high for one, _ in found):
            return [f"{CLAIMED} Yes: NEES is {low:g} to {high:g}{at}{together}."]
        widest, line = max(found, key=lambda pair: pair[0].high - pair[0].low)
        named = f" at {lines.place(line)}{together}" if len(known) > 1 else ""
        between = f"{widest.low:.3g} to {widest.high:.3g}"
        factor = noticed(widest, len(known))
        return [
            f"{CLAIMED} Nothing says otherwise{at if few else ''}, but NEES is known to {between} only{named}."
            f" Errors too small by a factor of {factor:.2g} would be noticed with a probability of {100 * POWER:g} %."
        ]
    worst, line = max(false, key=lambda pair: abs(math.log(max(pair[0].value, 1e-9) / 3)))
    factor = math.sqrt(worst.value / 3)
    size = "small" if factor >= 1 else "large"
    factor = max(factor, 1 / factor)
    at = f" at {lines.place(line)}" if len(known) > 1 else ""
    count = f", at {len(false)} of {len(known)} points" if len(known) > 1 else ""
    wrong = line.responses.get("wrong", NO_VALUE).value
    cause = ", wrong attitudes included" if wrong > 0 else ""
    interval = f"{worst.low:.3g} to {worst.high:.3g}{together}"
    return [
        f"{CLAIMED} No: too {size} by a factor of {factor:.2g}{at} (NEES {worst.value:.3g}, {interval}{cause}; 3 if"
        f" true){count}."
    ]


def jointly(nees: Summary, points: int) -> Summary:
    """A mean NEES with an interval at CONFIDENCE for all of some points together; none for few trials.

    The ends of an interval of chi-square have normal inverse cube roots (Wilson & Hilferty 1931), which are extended. A
    mean of few trials counts as it is if a true covariance hardly has it (probability OVERCONFIDENCE_PROBABILITY).
    """
    count = nees.trials
    if count < FEWEST:
        chance = scipy.special.chdtrc(3 * count, count * nees.value)
        end = nees.value if chance < OVERCONFIDENCE_PROBABILITY else math.nan
        return nees._replace(low=end, high=end)
    low, high = nees.low ** (-1 / 3), nees.high ** (-1 / 3)
    middle = (low + high) / 2
    half = joint_sigmas(points) / SIGMAS * (low - high) / 2
    return nees._replace(low=(middle + half) ** -3, high=max(middle - half, 1e-9) ** -3)


def noticed(nees: Summary, points: int) -> float:
    """The factor by which errors are claimed too small that would be noticed with POWER, by the interval of `jointly`.

    The lower end must exceed TRUE_NEES; POWER takes so many sigmas more, of which value / low has `joint_sigmas`.
    """
    ratio = 1 + scipy.special.ndtri(POWER) / joint_sigmas(points)
    return math.sqrt(TRUE_NEES[1] / 3 * (nees.value / nees.low) ** ratio)


def effect_of_wrong_matches(lines: PointTable) -> Sentences:
    """Sentences on wrong matches, and on whether they make the attitude err more than claimed; none without them."""
    known = [line.responses.get("mismatched", NO_VALUE) for line in lines]
    shares = [one for one in known if one.value > 0]
    if not shares:
        return []
    matches = sum(one.trials for one in shares)
    count = round(sum(one.value * one.trials for one in shares))
    text = f"There {count:,} of {matches:,} matches {'is' if count == 1 else 'are'} wrong"
    misled = [line for line in lines if line.responses["misled"].value > 0]
    if not misled:
        return [f"{text}; the attitude is unaffected: all errors are as claimed."]
    line = max(misled, key=lambda line: line.responses["misled"].value)
    most = line.responses["misled"]
    at = " in"
    if len(lines) > 1:
        at = f" at {len(misled)} of {len(lines)} points, most at {lines.place(line)}:"
    share = f"{percent(most.value)} of the frames ({interval(most)})"
    return [f"{text}; the attitude errs more than claimed{at} {share}."]


def everywhere(points: int) -> str:
    """ " at all 5 points"; empty for one."""
    return f" at all {points} points" if points > 1 else ""


def runs_needed(lines: PointRows, events: Sequence[str]) -> Sentences:
    """Sentences on how many trials a smaller claim about events that were never seen needs; none if all were seen.

    The next smaller claim is the next power of ten below the bound of the point with the fewest trials.
    """
    shares = [line.responses[name] for line in lines for name in events]
    never = [share.trials for share in shares if share.value == 0]
    if not never:
        return []
    fewest = min(never)
    bound = exact_bounds(0, fewest)[1]
    claim = 10.0 ** (math.ceil(math.log10(bound) - 1e-9) - 1)
    needed = trials_needed(claim)
    each = " at each point" if len(lines) > 1 else ""
    return [
        f"None in {fewest:,} is less than {100 * bound:.2g} % at {100 * CONFIDENCE:g} % confidence; a claim of"
        f" less than {100 * claim:.6g} % needs {needed:,} in all{each} without any."
    ]


EVENTS = {
    "misidentified": "Misidentified (at least one light matched with a wrong star or LED)",
    "roll_noise": "Roll noise (the right lights, but a roll error beyond 10′ that the covariance allows)",
    "wrong": "Wrong attitudes (an error beyond 10′ that the covariance does not allow, or beyond 1°)",
}
SHARES = (*EVENTS, "ambiguous", "misled", "refused")
# Responses that the answers need in addition to those of the study.
RESPONSES = (*SHARES, "mismatched", "nees")


def headline(
    lines: PointTable,
    may_be_ambiguous: bool,
    worst: str = "skysim study worst STUDY",
    judged: Sequence[Sequence[Judgment]] = (),
    survey_share: float = 0.0,
) -> Sentences:
    """Thresholds, refusals, ambiguity and wrong answers, in one or two sentences each; none if all trials failed.

    Parameters
    ----------
    lines
        All points, with the responses of the study and RESPONSES
    may_be_ambiguous
        Whether the tracker can refuse a frame as ambiguous
    worst
        The command that lists the worst trials
    judged
        Judgments of each requirement at all points
    survey_share
        Share of a survey that all trials share in the expected variance
    """
    done = answered(lines)
    if not done:
        return []
    found = [thresholds.requirement_text(one, done) for one in judged]
    for threshold in lines.study.thresholds:
        found += thresholds.sentences(threshold, done)
    found.append(solved_everywhere(done, worst))
    if may_be_ambiguous:
        found.append(ambiguity(done))
    for name, text in EVENTS.items():
        found.append(event(text, [line.responses[name] for line in done], done))
        found += effect_of_wrong_matches(done) if name == "misidentified" else []
    return [
        *found,
        *runs_needed(done, list(EVENTS)),
        *claimed_errors(done, survey_share),
    ]


def answered(lines: PointTable) -> PointTable:
    """The points with a trial that has an answer."""
    return lines.with_rows(
        line for line in lines if line.trials and np.isfinite(line.responses["wrong"].value)
    )


def verdict(
    lines: PointTable,
    judged: Sequence[Sequence[Judgment]] = (),
    survey_share: float = 0.0,
) -> str:
    """The answer of the study in three to five short sentences; "" if no trial has an answer.

    1. Its requirements and thresholds. 2. How many frames are refused. 3. How many attitudes are wrong.
    4. Whether the claimed errors are false.
    """
    done = answered(lines)
    if not done:
        return ""
    study = lines.study
    frame = "attitude" if study.trial.kind == "centroids" else "frame"
    sentences = []
    for one in judged:
        worst, where = thresholds.decisive(one)
        sentences.append(f"`{one[worst].claim}` is {one[worst].answer}{where}.")
    sentences += [thresholds.brief(threshold, done) for threshold in study.thresholds]
    sentences += [
        worst_share(
            "refused", f"Every {frame} is solved", f"of the {frame}s are refused", done
        ),
        worst_share(
            "wrong", "No attitude is wrong", f"of the {frame}s give a wrong attitude", done
        ),
    ]
    sentences += [
        one for one in claimed_errors(done, survey_share) if one.startswith(f"{CLAIMED} No:")
    ]
    return " ".join(sentence[:1].upper() + sentence[1:] for sentence in sentences if sentence)


def worst_share(name: str, never: str, text: str, lines: PointTable) -> str:
    """A sentence such as "No attitude is wrong (in 12,000).", or the fraction at the point where it is largest."""
    worst = max(lines, key=lambda line: np.nan_to_num(line.responses[name].value))
    share = worst.responses[name]
    if not share.value > 0:
        trials = sum(line.responses[name].trials for line in lines)
        refused = sum(
            round(line.responses["refused"].value * line.responses["refused"].trials)
            for line in lines
        )
        # A frame without an attitude has no wrong one.
        count = f"{trials - refused:,} of {trials:,} frames" if refused else f"{trials:,}"
        return f"{never} (in {count})."
    if len(lines) == 1:
        return f"{percent(share.value)} {text} ({interval(share)})."
    return f"Up to {percent(share.value)} {text}, most at {lines.place(worst)}."


def ranges(lines: PointTable) -> Sentences:
    """Smallest and largest value over the points of each response that the headline is not about."""
    done = lines.with_rows(line for line in lines if line.trials)
    if not done:
        return []
    return [
        response_range(name, done) for name in lines.study.responses if name not in SHARES
    ]


def valued(name: str, lines: PointRows) -> list[PointRow]:
    """The points with a value of a response; those with few values only if there are no others."""
    found = [line for line in lines if np.isfinite(line.responses[name].value)]
    return [line for line in found if not has_few_values(line, name)] or found


def extremes(name: str, lines: PointRows) -> list[tuple[PointRow, str]]:
    """The points with the least and the largest value of a response, with the text of the value."""

    def value(line: PointRow) -> float:
        return line.responses[name].value

    ends = (min(lines, key=value), max(lines, key=value))
    return [(line, format_summary(line.responses[name])) for line in ends]


def response_range(name: str, lines: PointTable) -> str:
    """Smallest and largest value of a response over the points, as a sentence."""
    points = valued(name, lines)
    if not points:
        return f"{name}: no trial has a value."
    (least, low), (most, high) = extremes(name, points)
    if least.responses[name].value == most.responses[name].value:
        return f"{name}: {low}{everywhere(len(points))}."
    return f"{name}: {low} at {lines.place(least)}, to {high} at {lines.place(most)}."


def range_rows(lines: PointTable) -> list[list[str]]:
    """A row per response: name, least value and its point, largest value and its point."""
    done = lines.with_rows(line for line in lines if line.trials)
    rows = []
    for name in lines.study.responses:
        if points := valued(name, done):
            (least, low), (most, high) = extremes(name, points)
            rows.append([name, low, done.place(least), high, done.place(most)])
    return rows


def event(text: str, shares: Sequence[Summary], lines: PointTable) -> str:
    """How often an event happens: the point where it is most frequent, and an upper bound where it was never seen."""
    pairs = zip(shares, lines, strict=True)
    known = [(share, line) for share, line in pairs if np.isfinite(share.value)]
    if not known:
        return f"{text}: unknown, as the tracker does not name its lights."
    never = [share for share, _ in known if share.value == 0]
    if len(never) == len(known):
        return f"{text}: {none_of(never)}."
    most, line = max(known, key=lambda pair: pair[0].value)
    where = ""
    if len(known) > 1:
        where = f" at {len(known) - len(never)} of {len(known)} points, most at {lines.place(line)}:"
    found = f"{text}:{where} {percent(most.value)} of the frames ({interval(most)})"
    return f"{found}; {none_of(never)} at the other points." if never else f"{found}."


def ambiguity(lines: PointTable) -> str:
    """A sentence on attitudes whose lights fit another attitude as well: refused as ambiguous, or misled."""
    shares = []
    for line in lines:
        refused = line.responses["ambiguous"]
        either = refused.value + np.nan_to_num(line.responses["misled"].value)
        share = proportion(round(either * refused.trials), refused.trials)
        shares.append(share._replace(value=either))
    unit = ", each with hardware of its own" if lines.study.hardware else ""
    text = event("Ambiguous or misled", shares, lines)
    never = all(share.value == 0 for share in shares)
    return f"Is it ambiguous anywhere{unit}? {'No' if never else 'Yes'}. {text}"


def solved_everywhere(lines: PointTable, worst: str) -> str:
    """A sentence on whether every attitude is solved, and how often and where the tracker refuses one."""
    shares = [line.responses["refused"] for line in lines]
    text = event("Refused (no attitude is returned)", shares, lines)
    what = "attitude" if lines.study.trial.kind == "centroids" else "frame"
    if all(share.value == 0 for share in shares):
        return f"Is every {what} solved? Yes. {text}"
    return f"Is every {what} solved? No. {text} `{worst} --response refused` names the worst."


def one_unit(fixed: Sequence[str]) -> Sentences:
    """A sentence that the intervals are of one unit of hardware, and how to cover others; "" without a fixed seed."""
    if not fixed:
        return []
    units = " and ".join(
        "one survey" if seed.startswith("tracker.") else "one draw of the LEDs"
        for seed in fixed
    )
    return [
        f"Intervals cover other attitudes, with {units}: `hardware: [{', '.join(fixed)}]` in the study draws"
        " the hardware anew in every replicate, and they cover it too."
    ]


def none_of(shares: Sequence[Summary]) -> str:
    """A sentence that an event was never seen, with the exact upper bound of its frequency (Clopper & Pearson 1934)."""
    fewest = min(share.trials for share in shares)
    each = " a point" if len(shares) > 1 else ""
    bound = exact_bounds(0, fewest)[1] if fewest else 1.0
    return f"none in {fewest:,}{each} (less than {100 * bound:.2g} % at {100 * CONFIDENCE:g} % confidence)"


def interval(share: Summary) -> str:
    """The interval of a fraction in percent."""
    return f"{100 * share.low:.3g} to {percent(share.high)}"
