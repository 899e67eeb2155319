"""Attitude samples from an STK attitude file (`.a`): AttitudeTimeQuaternions and its scalar-first variant.

STK's help describes the format in "Attitude File Format (*.a)". A quaternion is that of the rotation that turns the
axes of CoordinateAxes into those of the body. It converts coordinates from body to reference: ref_from_body. Times are
seconds from ScenarioEpoch (UTC). The interpolation that the file names is not used.
"""

import datetime
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from skysim.core.errors import InputError, Where, unknown_name
from skysim.core.text import Line, Metadata, Words, excerpt, to_numbers
from skysim.dynamics.profile_samples import REFERENCES, Samples, from_quaternions, icrs_from

# By section: count of numbers in a data line, including its time, and the columns of x, y, z, w.
SECTIONS = {
    "AttitudeTimeQuaternions": (5, [1, 2, 3, 4]),
    "AttitudeTimeQuatScalarFirst": (5, [2, 3, 4, 1]),
    "AttitudeTimeQuatAngVels": (8, [1, 2, 3, 4]),
}
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
    keywords: Metadata = {}
    section = ""
    rows = []
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
                raise Where(path, n).error(excerpt(line), "BEGIN Attitude")
            inside = True
        elif section:
            rows.append((n, words))
        elif lower.startswith("attitudetime"):
            section = spelled("data", " ".join(words), SECTIONS, Where(path, n))
        else:
            name = spelled("keyword", words[0], KEYWORDS, Where(path, n))
            keywords[name] = (n, " ".join(words[1:]))
    if not section:
        raise InputError(path, "no attitudes", ", ".join(SECTIONS))
    return to_samples(path, keywords, section, rows, start)


def spelled(what: str, name: str, known: Iterable[str], where: Where) -> str:
    """A name in the standard's spelling, whatever its case. Raises InputError for an unknown one."""
    for one in known:
        if one.lower() == name.lower():
            return one
    raise where.error(*unknown_name(what, name, known))


def to_samples(
    path: Path,
    keywords: Metadata,
    section: str,
    rows: list[Words],
    start: datetime.datetime,
) -> Samples:
    """The samples of the data rows. Raises InputError for values or keywords that are not supported."""
    # 1. Keywords.
    width, columns = SECTIONS[section]
    line, text = keywords.get("NumberOfAttitudePoints", (0, str(len(rows))))
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise Where(path, line).error(
            f"NumberOfAttitudePoints {excerpt(text)}", "a whole number"
        )
    if int(text) > len(rows):
        raise Where(path, line).error(
            f"NumberOfAttitudePoints {text}, but there are {len(rows)}: the file is cut off"
        )
    rows = rows[: int(text)]
    for key, allowed in (("CentralBody", "Earth"), ("TimeFormat", "EpSec")):
        line, value = keywords.get(key, (0, allowed))
        if value.lower() != allowed.lower():
            raise Where(path, line).error(f"{key} {excerpt(value)}", allowed)
    line, axes = keywords.get("CoordinateAxes", (0, ""))
    if axes.upper() not in REFERENCES:
        raise Where(path, line or None).error(
            f"CoordinateAxes {excerpt(axes)}", ", ".join(REFERENCES)
        )
    # 2. Numbers; times count from the scene's start if the file has an epoch.
    places = [n for n, _ in rows]
    values = to_numbers(path, rows, width)
    t_s = values[:, 0]
    if "ScenarioEpoch" in keywords:
        t_s = t_s + (scenario_epoch(path, *keywords["ScenarioEpoch"]) - start).total_seconds()
    # 3. Quaternions, with the frame bias of J2000.
    frames = (REFERENCES[axes.upper()], "body")
    samples = from_quaternions(
        path,
        "line",
        places,
        t_s,
        frames,
        values[:, columns],
        absolute="ScenarioEpoch" in keywords,
    )
    return replace(samples, a_from_b=icrs_from(axes) * samples.a_from_b)


def scenario_epoch(path: Path, line: int, text: str) -> datetime.datetime:
    """The epoch "1 Jul 2005 12:00:00.00" in UTC. Raises InputError."""
    try:
        day, month, year, clock = text.split()
        whole, _, fraction = clock.partition(".")
        number = MONTHS.index(month[:3].lower()) + 1
        date = datetime.datetime.strptime(
            f"{year} {number} {day} {whole}", "%Y %m %d %H:%M:%S"
        )
        return date + datetime.timedelta(seconds=int(fraction or 0) / 10 ** len(fraction))
    except ValueError:
        raise Where(path, line).error(
            f"ScenarioEpoch {excerpt(text)}", "1 Jul 2005 12:00:00.00"
        ) from None
