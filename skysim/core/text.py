"""Text files of samples over time: lines, numbers, epochs, CSV, and CCSDS's keyword = value notation.

Errors name the line of the fault.
"""

import datetime
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from skysim.core.errors import InputError, Where, refusing, shortened
from skysim.core.time import GPS_MINUS_TAI_S, SCALES
from skysim.core.types import Floats
from skysim.core.yaml_reader import read_limited

MAX_BYTES = 200_000_000  # of a file: a million lines of 200 characters
LARGEST = 1e15  # number of a table, in any unit; computations overflow far above
MAX_EXCERPT = 40  # number of characters of a value in a message
EPOCH = re.compile(
    r"(?:19|20|21)\d\d-(\d\d-\d\d|\d{3})[T ]\d\d:\d\d:\d\d(\.\d{0,15})?Z?", re.ASCII
)

Line = tuple[int, str]  # number, from 1, and content
Words = tuple[int, list[str]]  # number of a line, and its words
Metadata = dict[str, Line]  # values by keyword


def read_lines(path: Path) -> list[Line]:
    """The numbered lines of a text file, without blank lines. Raises InputError if it is too large or not UTF-8."""
    text = read_limited(path, MAX_BYTES, "utf-8-sig")
    return [(n, line.strip()) for n, line in enumerate(text.split("\n"), 1) if line.strip()]


def excerpt(text: object) -> str:
    """A value for a message, on one line and truncated."""
    return repr(shortened(text, MAX_EXCERPT))


def to_numbers(source: str | Path, rows: Sequence[Words], width: int) -> Floats:
    """(N, width) numbers of the words of each line. Raises InputError for the first line without finite numbers."""
    for line, words in rows:
        if len(words) != width:
            raise Where(source, line).error(f"{len(words)} values", width)
    try:
        numbers = np.array([words for _, words in rows], dtype=np.float64).reshape(-1, width)
    except ValueError:
        numbers = np.full((1, width), np.nan)
    if not (np.abs(numbers) <= LARGEST).all():
        for line, words in rows:
            check_numbers(Where(source, line), words)
    return numbers


def column_numbers(
    source: str | Path, rows: Sequence[Words], wanted: Sequence[str]
) -> Floats:
    """(N, K) numbers of the wanted columns that a table has; its first line names them. Raises InputError by line."""
    names = rows[0][1]
    for place, row in rows:
        if len(row) != len(names):
            raise Where(source, place).error(
                f"{len(row)} values", f"{len(names)}, as the first line has"
            )
    used = [names.index(one) for one in wanted if one in names]
    return to_numbers(source, [(n, [row[k] for k in used]) for n, row in rows[1:]], len(used))


def check_numbers(where: Where, words: Sequence[str]) -> None:
    """Raise InputError for the first word that is not a finite number up to LARGEST."""
    for word in words:
        kind = f"finite number up to {LARGEST:g}"
        try:
            if abs(float(word)) <= LARGEST:
                continue
        except ValueError:
            kind = "number"
        raise where.error(f"{excerpt(word)} is not a {kind}")


def seconds_since(
    source: str | Path,
    places: Sequence[int],
    epochs: Sequence[str],
    start: datetime.datetime,
    system: str,
    unit: str = "line",
) -> Floats:
    """(N,) seconds from a start in UTC to epochs (ISO 8601, calendar or day of year) of a time system of SCALES.

    Like the scene's own times, UTC is taken as uniform: a leap second in between is not counted. Raises InputError for
    the first text that is not an epoch.
    """
    from astropy.time import Time

    # 1. The form of the texts, which must be the same for all.
    bad = [n for n, epoch in enumerate(epochs) if not EPOCH.fullmatch(epoch)]
    bad += [
        n
        for n, epoch in enumerate(epochs)
        if len(epoch.split("-")) != len(epochs[0].split("-"))
    ]
    if bad:
        raise Where(source, places[min(bad)], unit).error(
            f"{excerpt(epochs[min(bad)])} is not an epoch",
            "2012-06-22T21:00:00.5, or all of the form 2012-174T21:00:00.5",
        )
    # 2. UTC, by astropy.
    texts = [epoch.rstrip("Z").replace(" ", "T") for epoch in epochs]
    ordinal = bool(texts) and texts[0].count("-") == 1
    kind = "yday" if ordinal else "isot"
    scale = SCALES[system]
    if ordinal:
        texts = [text.replace("-", ":", 1).replace("T", ":", 1) for text in texts]
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # "dubious year": leap seconds of the future are unknown
        try:
            times = Time(texts, format=kind, scale=scale).utc
        except ValueError:
            for n, text in enumerate(texts):  # the first that is none by itself
                try:
                    Time(text, format=kind, scale=scale)
                except ValueError:
                    problem = f"{excerpt(epochs[n])} is not a date and time"
                    raise Where(source, places[n], unit).error(problem) from None
            raise
        times.precision = 9
    # 3. Difference from the start in whole nanoseconds.
    with refusing(ValueError, source, "an epoch within a leap second", "other times"):
        nanoseconds = np.array(times.isot, dtype="datetime64[ns]") - np.datetime64(
            start, "ns"
        )
    return nanoseconds.astype(np.int64) / 1e9 - (GPS_MINUS_TAI_S if system == "GPS" else 0.0)


def cells_of(lines: Iterable[Line]) -> list[Words]:
    """The numbered lines of a table, split at commas if its first has one, or else at blanks; # begins a comment."""
    rows = [(n, line) for n, line in lines if not line.startswith("#")]
    comma = "," if rows and "," in rows[0][1] else None
    return [(n, [cell.strip() for cell in line.split(comma)]) for n, line in rows]


def read_named_rows(
    path: Path,
    name: str,
    needed: Sequence[str],
    refusal: InputError,
    also: Sequence[str] = (),
) -> tuple[list[str], Floats]:
    """Names of the rows and numbers (N, K) of a CSV file whose first line names its columns; # begins a comment.

    Parameters
    ----------
    path
        The file
    name
        Column with the names of the rows, each of which occurs once
    needed
        Columns of numbers that the file must have
    refusal
        Error to raise for a file without these columns or without rows
    also
        Columns of numbers that it may have, after `needed` in the result; others are not used

    Raises
    ------
    InputError
        For a file that cannot be read in this way.
    """
    lines = cells_of(read_lines(path))
    columns = lines[0][1] if lines else []
    if len(lines) < 2 or len({*columns}) < len(columns) or not {name, *needed} <= {*columns}:
        raise refusal
    numbers = column_numbers(path, lines, (*needed, *also))
    first: dict[str, int] = {}
    for place, row in lines[1:]:
        one = row[columns.index(name)]
        if first.setdefault(one, place) != place:
            raise Where(path, place).error(
                f"{excerpt(one)} is in line {first[one]} too", "once"
            )
    return list(first), numbers


class TextSegment(NamedTuple):
    """A segment: metadata with their line numbers by keyword, and data lines split into words."""

    metadata: Metadata
    data: list[Words]

    def require(self, path: str | Path, keys: Sequence[str]) -> None:
        """Raise InputError for the first keyword that is missing in the metadata."""
        for key in keys:
            if key not in self.metadata:
                raise InputError(path, f"{key} is missing in the metadata of a segment")


def split_segments(
    path: str | Path,
    lines: Iterable[Line],
    keyword: str,
    versions: Sequence[str],
    after: Mapping[str, Sequence[str]],
    data: str,
) -> tuple[str, list[TextSegment]]:
    """The version and the segments of a CCSDS message; lines of covariances are not used.

    Parameters
    ----------
    keyword, versions
        Keyword of the version, and the versions that are supported
    after
        Lines that begin or end a part, and those after which each may come; the header has none
    data
        The line after which data follow

    Raises
    ------
    InputError
        For a line out of place, and another version.
    """
    version = section = ""
    segments = []
    for n, line in lines:
        if line.split(maxsplit=1)[0] == "COMMENT":
            continue
        # A line that begins or ends a part, a data line, or KEYWORD = value of the header or the metadata.
        if line in after:
            if section not in after[line]:
                place = f"after {section}" if section else "before META_START"
                raise Where(path, n).error(f"{line} {place}")
            section = line
            if line == "META_START":
                segments.append(TextSegment({}, []))
        elif section == data:
            segments[-1].data.append((n, line.split()))
        elif section in ("", "META_START"):
            key, equals, value = (part.strip() for part in line.partition("="))
            if not equals:
                raise Where(path, n).error(f"{excerpt(line)} is not KEYWORD = value")
            if section:
                segments[-1].metadata[key] = (n, value)
            elif key == keyword:
                version = value
        elif not section.startswith("COVARIANCE"):
            raise Where(path, n).error(
                f"{excerpt(line)} after {section}", "DATA_START or META_START"
            )
    if version not in versions:
        raise InputError(path, f"{keyword} is {excerpt(version)}", ", ".join(versions))
    return version, segments


def one_of(path: str | Path, metadata: Metadata, key: str, allowed: Iterable[str]) -> str:
    """The value of a keyword in capitals. Raises InputError if it is not allowed."""
    line, value = metadata[key]
    names = list(allowed)
    if value.upper() not in names:
        raise Where(path, line).error(f"{key} = {excerpt(value)}", ", ".join(names))
    return value.upper()
