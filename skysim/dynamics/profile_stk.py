"""Attitude samples from an STK attitude file (`.a`): AttitudeTimeQuaternions and its scalar-first variant.

STK's help describes the format in "Attitude File Format (*.a)". A quaternion is that of the rotation that turns the
axes of CoordinateAxes into those of the body. It converts coordinates from body to reference: ref_from_body. Times are
seconds from ScenarioEpoch (UTC). The interpolation that the file names is not used.
"""

from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path

from skysim.core.errors import InputError, Where, unknown_name
from skysim.core.text import Line, excerpt, to_numbers
from skysim.dynamics.profile_samples import REFERENCES, Samples, from_quaternions, icrs_from

# By section: count of numbers in a data line, including its time, and the columns of x, y, z, w.
SECTIONS = {
    "attitudetimequaternions": (5, [1, 2, 3, 4]),
    "attitudetimequatscalarfirst": (5, [2, 3, 4, 1]),
    "attitudetimequatangvels": (8, [1, 2, 3, 4]),
}
SECTION_NAMES = (
    "AttitudeTimeQuaternions",
    "AttitudeTimeQuatScalarFirst",
    "AttitudeTimeQuatAngVels",
)
UNUSED = (
    "MessageLevel",
    "InterpolationMethod",
    "InterpolationOrder",
    "BlockingFactor",
    "AttitudeDeviations",
)
KEYWORDS = (
    "NumberOfAttitudePoints",
    "ScenarioEpoch",
    "CentralBody",
    "CoordinateAxes",
    "TimeFormat",
    *UNUSED,
)
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")


def read_stk(path: Path, lines: list[Line], start: datetime.datetime) -> Samples:
    """The samples of an attitude file. Raises InputError for data other than quaternions in ICRF, J2000 or LAB.

    After the version a file has BEGIN Attitude, lines of keyword and value, the name of the data section, rows of
    numbers, and END Attitude.
    """
    keywords: dict[str, Line] = {}
    section = ""
    rows = list[tuple[int, list[str]]]()
    inside = False
    for n, line in lines[1:]:  # the first has the version
        # Keywords and section names are not case-sensitive.
        words = line.split()
        lower = line.lower()
        if line.startswith("#"):
            continue
        if lower.split() == ["end", "attitude"]:
            break
        if not inside:
            if lower.split() != ["begin", "attitude"]:
                raise InputError(path, excerpt(line), "BEGIN Attitude", where=Where(path, n))
            inside = True
        elif section:
            rows.append((n, words))
        elif lower.startswith("attitudetime"):
            if lower not in SECTIONS:
                raise InputError(
                    path, *unknown_name("data", words[0], SECTION_NAMES), Where(path, n)
                )
            section = lower
        else:
            name = next(
                (known for known in KEYWORDS if known.lower() == words[0].lower()), None
            )
            if name is None:
                raise InputError(
                    path, *unknown_name("keyword", words[0], KEYWORDS), Where(path, n)
                )
            keywords[name] = (n, " ".join(words[1:]))
    if not section:
        raise InputError(path, "no attitudes", ", ".join(SECTION_NAMES))
    return to_samples(path, keywords, section, rows, start)


def to_samples(
    path: Path,
    keywords: dict[str, Line],
    section: str,
    rows: list[tuple[int, list[str]]],
    start: datetime.datetime,
) -> Samples:
    """The samples of the data rows. Raises InputError for values or keywords that are not supported."""
    # 1. Keywords.
    width, columns = SECTIONS[section]
    rows = rows[: point_count(path, keywords, len(rows))]
    for key, allowed in (("CentralBody", "Earth"), ("TimeFormat", "EpSec")):
        line, value = keywords.get(key, (0, allowed))
        if value.lower() != allowed.lower():
            raise InputError(
                path, f"{key} {excerpt(value)}", allowed, where=Where(path, line)
            )
    line, axes = keywords.get("CoordinateAxes", (0, ""))
    if axes.upper() not in REFERENCES:
        where = Where(path, line) if line else None
        raise InputError(
            path, f"CoordinateAxes {excerpt(axes)}", ", ".join(REFERENCES), where
        )
    # 2. Numbers; times count from the scene's start if the file has an epoch.
    places = [n for n, _ in rows]
    values = to_numbers(str(path), places, [words for _, words in rows], width)
    t_s = values[:, 0]
    if "ScenarioEpoch" in keywords:
        t_s = t_s + (scenario_epoch(path, *keywords["ScenarioEpoch"]) - start).total_seconds()
    # 3. Quaternions, with the frame bias of J2000.
    frames = (REFERENCES[axes.upper()], "body")
    samples = from_quaternions(
        str(path),
        "line",
        places,
        t_s,
        frames,
        values[:, columns],
        absolute="ScenarioEpoch" in keywords,
    )
    return replace(samples, a_from_b=icrs_from(axes) * samples.a_from_b)


def point_count(path: Path, keywords: dict[str, Line], count: int) -> int:
    """Number of rows to read: NumberOfAttitudePoints, or all. Raises InputError if there are fewer."""
    if "NumberOfAttitudePoints" not in keywords:
        return count
    line, text = keywords["NumberOfAttitudePoints"]
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise InputError(
            path,
            f"NumberOfAttitudePoints {excerpt(text)}",
            "a whole number",
            where=Where(path, line),
        )
    if int(text) > count:
        raise InputError(
            path,
            f"NumberOfAttitudePoints {text}, but there are {count}: the file is cut off",
            where=Where(path, line),
        )
    return int(text)


def scenario_epoch(path: Path, line: int, text: str) -> datetime.datetime:
    """The epoch "1 Jul 2005 12:00:00.00" in UTC. Raises InputError."""
    try:
        day, month, year, clock = text.split()
        hours, minutes, seconds = clock.split(":")
        date = datetime.datetime(int(year), MONTHS.index(month[:3].lower()) + 1, int(day))
        if (
            not 0 <= float(seconds) < 60
            or not 0 <= int(minutes) < 60
            or not 0 <= int(hours) < 24
        ):
            raise ValueError
        return date + datetime.timedelta(
            hours=int(hours), minutes=int(minutes), seconds=float(seconds)
        )
    except (ValueError, OverflowError):
        raise InputError(
            path,
            f"ScenarioEpoch {excerpt(text)}",
            "1 Jul 2005 12:00:00.00",
            where=Where(path, line),
        ) from None
