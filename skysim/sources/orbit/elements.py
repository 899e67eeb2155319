"""Mean elements of satellites from TLE and OMM files, and their places by SGP4.

SGP4's theory and its constants (WGS 72) belong to the elements, which were fitted with it. Source: Hoots & Roehrich
1980, Spacetrack Report No. 3; Vallado, Crawford, Hujsak & Kelso 2006, Revisiting Spacetrack Report #3 (AIAA 2006-6753),
whose code the package `sgp4` compiles. Formats: CCSDS 502.0-B-3 (OMM).
"""

from __future__ import annotations

import csv
import datetime
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import erfa
import numpy as np
from numpy.typing import NDArray

from skysim.core.constants import DAY_S
from skysim.core.errors import InputError, Where
from skysim.core.text import (excerpt, read_lines)
from skysim.core.time import J2000_JD, tt_jd, ut1_jd, utc_days
from skysim.core.types import Floats

MAX_SATELLITES = 100_000  # of a file
REQUIRED = (
    "NORAD_CAT_ID",
    "EPOCH",
    "MEAN_MOTION",
    "ECCENTRICITY",
    "INCLINATION",
    "RA_OF_ASC_NODE",
    "ARG_OF_PERICENTER",
    "MEAN_ANOMALY",
    "BSTAR",
)
# What SGP4 does not use: a message may lack it.
OPTIONAL = {
    "CLASSIFICATION_TYPE": "U",
    "OBJECT_ID": "",
    "EPHEMERIS_TYPE": "0",
    "ELEMENT_SET_NO": "0",
    "REV_AT_EPOCH": "0",
    "MEAN_MOTION_DOT": "0",
    "MEAN_MOTION_DDOT": "0",
    "OBJECT_NAME": "",
}
EPOCH = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,6})?", re.ASCII)
TLE_LENGTHS = 68, 69  # without and with the checksum


class Elements(NamedTuple):
    """N satellites: their catalog numbers, names, and SGP4's records."""

    numbers: tuple[int, ...]
    names: tuple[str, ...]
    records: tuple[Any, ...]

    def take(self, which: Iterable[int]) -> Elements:
        """The chosen satellites."""
        rows = list(which)
        return Elements(*(tuple(column[n] for n in rows) for column in self))  # type: ignore[arg-type]


def read_elements(path: str) -> Elements:
    """The satellites of a file, told by its content: TLE, or OMM as CSV, XML or JSON. Raises InputError."""
    lines = read_lines(Path(path))
    if not lines:
        raise InputError(path, "empty", "a TLE or an OMM")
    text = "\n".join(line for _, line in lines)
    if text[0] in "<[{" or "NORAD_CAT_ID" in lines[0][1]:
        satellites = [
            satellite(path, n, fields) for n, fields in enumerate(messages(path, text), 1)
        ]
    else:
        satellites = list(read_tle(path, lines))
    if not 0 < len(satellites) <= MAX_SATELLITES:
        raise InputError(path, f"{len(satellites)} satellites", f"1 to {MAX_SATELLITES}")
    return Elements(*map(tuple, zip(*satellites, strict=True)))


def read_tle(path: str, lines: list[tuple[int, str]]) -> Iterator[tuple[int, str, Any]]:
    """Number, name and record of each pair of lines, before which its name may be. Raises InputError."""
    from sgp4.api import Satrec

    rest = iter(lines)
    for n, line in rest:
        name = ""
        if not line.startswith("1 ") or len(line) < TLE_LENGTHS[0]:
            name = line.removeprefix("0 ").strip()
            n, line = next(rest, (n, ""))
        second = next(rest, (n, ""))[1]
        pair = line[: TLE_LENGTHS[1]], second[: TLE_LENGTHS[1]]
        for begin, one in zip("12", pair, strict=True):
            if not one.startswith(f"{begin} ") or len(one) not in TLE_LENGTHS:
                raise InputError(
                    path, f"{excerpt(one)} is not line {begin} of a TLE", where=Where(path, n)
                )
            if len(one) == TLE_LENGTHS[1] and checksum(one) != one[-1]:
                raise InputError(
                    path,
                    f"the checksum of line {begin} is {one[-1]}; it should be {checksum(one)}",
                    where=Where(path, n),
                )
        try:
            record = Satrec.twoline2rv(*pair)
        except (ValueError, IndexError) as error:
            raise InputError(path, f"not a TLE: {excerpt(error)}", where=Where(path, n)) from None
        yield usable(path, n, name, record)


def checksum(line: str) -> str:
    """The last character of a line of a TLE: the sum of its digits, a minus counting 1, modulo 10."""
    return str(sum(int(c) if c.isdigit() and c.isascii() else c == "-" for c in line[:68]) % 10)


def messages(path: str, text: str) -> Iterator[Mapping[str, Any]]:
    """The keywords of each message of OMMs. Raises InputError."""
    from xml.etree import ElementTree

    try:
        if text[0] == "<":
            for segment in ElementTree.fromstring(text).iter("segment"):
                yield {leaf.tag: leaf.text for leaf in segment.iter() if not len(leaf)}
        elif text[0] in "[{":
            tree = json.loads(text)
            for fields in tree if isinstance(tree, list) else [tree]:
                yield fields if isinstance(fields, dict) else {}
        else:
            yield from csv.DictReader(io.StringIO(text))
    except (ElementTree.ParseError, ValueError, csv.Error, RecursionError) as error:
        raise InputError(path, f"not an OMM: {excerpt(error)}") from None


def satellite(path: str, n: int, fields: Mapping[str, Any]) -> tuple[int, str, Any]:
    """Number, name and record of the n-th message. Raises InputError."""
    from sgp4 import omm
    from sgp4.api import Satrec

    record = Satrec()
    texts = {key: str(value) for key, value in fields.items() if value not in (None, "")}
    missing = [key for key in REQUIRED if key not in texts]
    if missing:
        raise InputError(path, f"{missing[0]} is missing", where=Where(path, n, "message"))
    epoch = texts["EPOCH"].rstrip("Z")
    if not EPOCH.fullmatch(epoch):
        raise InputError(
            path,
            f"EPOCH {excerpt(epoch)}",
            "2012-06-22T21:00:00.123456",
            where=Where(path, n, "message"),
        )
    try:
        omm.initialize(
            record, {**OPTIONAL, **texts, "EPOCH": epoch if "." in epoch else f"{epoch}.0"}
        )
    except (ValueError, OverflowError) as error:
        raise InputError(path, excerpt(error), where=Where(path, n, "message")) from None
    return usable(path, n, texts.get("OBJECT_NAME", ""), record)


def usable(path: str, n: int, name: str, record: Any) -> tuple[int, str, Any]:
    """Number, name and record. Raises InputError for elements that SGP4 refuses at their own epoch."""
    from sgp4.api import SGP4_ERRORS

    error, place_km, _ = record.sgp4(record.jdsatepoch, record.jdsatepochF)
    if error or not np.isfinite(place_km).all():
        what = SGP4_ERRORS.get(error, "elements that are not numbers")
        raise InputError(
            path, f"SGP4 refuses these elements: {what}", where=Where(path, n, "satellite")
        )
    return int(record.satnum), name or str(record.satnum), record


def age_days(elements: Elements, time: datetime.datetime) -> Floats:
    """(N,) days from the elements' epochs to a time; SGP4's error grows by 1 to 3 km a day in low orbits."""
    epochs = [record.jdsatepoch - J2000_JD + record.jdsatepochF for record in elements.records]
    return utc_days(time) - np.array(epochs)


def gcrs_states(
    elements: Elements, time: datetime.datetime, after_s: Floats
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Positions (N, K, 3) in m and velocities in m/s in GCRS axes at K times after a time, and SGP4's errors (N, K)."""
    from sgp4.api import SatrecArray

    # In one number with the Julian date a satellite would be off by 0.3 m.
    days = utc_days(time) + np.asarray(after_s, float) / DAY_S
    errors, place_km, velocity_km_s = SatrecArray(list(elements.records)).sgp4(
        np.full(len(days), J2000_JD), days
    )
    matrix = gcrs_from_teme(time)
    return 1e3 * place_km @ matrix.T, 1e3 * velocity_km_s @ matrix.T, errors.astype(np.int64)


@lru_cache(maxsize=64)
def gcrs_from_teme(time: datetime.datetime) -> Floats:
    """(3, 3) matrix to GCRS axes from SGP4's true equator and mean equinox.

    TEME and the axes that turn with the Earth differ by Greenwich mean sidereal time of 1982 about the pole, and those
    differ from the celestial intermediate system by the Earth rotation angle; the latter follows by precession and
    nutation of IAU 2006/2000A. Source: Vallado et al. 2006, appendix C; IERS Conventions 2010, chapter 5.
    """
    ut1 = ut1_jd(time)
    angle = erfa.gmst82(ut1, 0.0) - erfa.era00(ut1, 0.0)
    return np.asarray(erfa.c2i06a(tt_jd(time), 0.0).T @ erfa.rz(angle, np.eye(3)))
