"""Orbits from files: mean elements (TLE, OMM) with places by SGP4, and orbit ephemerides (OEM).

SGP4's theory and its constants (WGS 72) belong to the elements, which were fitted with it. Source: Hoots & Roehrich
1980, Spacetrack Report No. 3; Vallado, Crawford, Hujsak & Kelso 2006, Revisiting Spacetrack Report #3 (AIAA 2006-6753),
whose code the package `sgp4` compiles. Formats: CCSDS 502.0-B-2 and 502.0-B-3 (OMM, OEM).
"""

import csv
import datetime
import io
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import erfa
import numpy as np
import scipy

from skysim.core.constants import DAY_S, EARTH_J2, EARTH_MU_M3_S2, EARTH_RADIUS_M
from skysim.core.errors import InputError, Where
from skysim.core.text import (
    TextSegment,
    check_numbers,
    excerpt,
    one_of,
    read_lines,
    seconds_since,
    split_segments,
    to_numbers,
)
from skysim.core.time import J2000_JD, SCALES, tt_jd, ut1_jd, utc_days
from skysim.core.types import Floats, Ints
from skysim.sources.ephemeris import GcrsState

MAX_SATELLITES = 100_000  # in a file
MAX_AGE_DAYS = 365  # of the elements that are nearest in time
REQUIRED = (
    "EPOCH",
    "NORAD_CAT_ID",
    "MEAN_MOTION",
    "ECCENTRICITY",
    "INCLINATION",
    "RA_OF_ASC_NODE",
    "ARG_OF_PERICENTER",
    "MEAN_ANOMALY",
    "BSTAR",
)
# Fields that SGP4 does not use, with values for messages that lack them.
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
NUMBERS = (*REQUIRED[1:], *(key for key, value in OPTIONAL.items() if value == "0"))
EPOCH = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,6})?", re.ASCII)
TLE_LENGTHS = 68, 69  # without and with the checksum


class MeanElements(NamedTuple):
    """Mean elements of a satellite: its catalog number, its name, and SGP4's record."""

    number: int
    name: str
    record: Any


def check_epochs(
    path: str, elements: Sequence[MeanElements], time: datetime.datetime
) -> None:
    """Raise InputError if all elements are of an epoch too far from a time for places by SGP4."""
    records = [one.record for one in elements]
    epoch_days = [one.jdsatepoch - J2000_JD + one.jdsatepochF for one in records]
    nearest = min((utc_days(time) - one for one in epoch_days), key=abs)
    if abs(nearest) > MAX_AGE_DAYS:
        raise InputError(
            path,
            f"elements of {abs(nearest):.0f} days {'before' if nearest > 0 else 'after'} start_time {time:%Y-%m-%d}",
            f"{MAX_AGE_DAYS} days: the error grows by 1 to 3 km a day",
        )


def read_elements(path: str) -> list[MeanElements]:
    """The satellites of a file: TLE, or OMM as CSV, XML or JSON, recognized by its content.

    Raises
    ------
    InputError
        For a file that is none of these, or with more than MAX_SATELLITES.
    """
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
    return satellites


def read_tle(path: str, lines: list[tuple[int, str]]) -> Iterator[MeanElements]:
    """Yield the elements of each pair of lines; a line with the name may precede it. Raises InputError."""
    # sgp4 is imported where it is used: few scenes have satellites.
    from sgp4.api import Satrec

    rest = iter(lines)
    for n, line in rest:
        name = ""
        # A line that is not line 1 of a TLE is a name.
        if not line.startswith("1 ") or len(line) < TLE_LENGTHS[0]:
            name = line.removeprefix("0 ").strip()
            n, line = next(rest, (n, ""))
        second = next(rest, (n, ""))[1]
        pair = line[: TLE_LENGTHS[1]], second[: TLE_LENGTHS[1]]
        # Both lines must be complete, and their checksums right if they have any.
        for begin, one in zip("12", pair, strict=True):
            if not one.startswith(f"{begin} ") or len(one) not in TLE_LENGTHS:
                raise Where(path, n).error(f"{excerpt(one)} is not line {begin} of a TLE")
            if len(one) == TLE_LENGTHS[1] and checksum(one) != one[-1]:
                raise Where(path, n).error(
                    f"the checksum of line {begin} is {one[-1]}; it should be {checksum(one)}"
                )
        try:
            record = Satrec.twoline2rv(*pair)
        except ValueError:
            # Where sgp4 has no compiled code; that takes any text as numbers.
            raise Where(path, n).error(
                "not a TLE: its fields are not in their columns"
            ) from None
        yield usable(path, n, name, record)


def checksum(line: str) -> str:
    """The last character of a line of a TLE: the sum of its digits modulo 10, where a minus counts 1."""
    return str(
        sum(int(c) if c.isdigit() and c.isascii() else c == "-" for c in line[:68]) % 10
    )


def messages(path: str, text: str) -> Iterator[Mapping[str, Any]]:
    """Yield the keywords of each message of an OMM file in XML, JSON or CSV. Raises InputError."""
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


def satellite(path: str, n: int, fields: Mapping[str, Any]) -> MeanElements:
    """The elements of the n-th message of an OMM file. Raises InputError."""
    from sgp4 import omm
    from sgp4.api import Satrec

    record = Satrec()
    where = Where(path, n, "message")
    texts = {key: str(value) for key, value in fields.items() if value not in (None, "")}
    # Elements that SGP4 needs.
    missing = [key for key in REQUIRED if key not in texts]
    if missing:
        raise where.error(f"{missing[0]} is missing")
    epoch = texts["EPOCH"].rstrip("Z")
    if not EPOCH.fullmatch(epoch):
        raise where.error(f"EPOCH {excerpt(epoch)}", "2012-06-22T21:00:00.123456")
    # sgp4 reads epochs with a fraction of a second only.
    texts = OPTIONAL | texts | {"EPOCH": epoch if "." in epoch else f"{epoch}.0"}
    check_numbers(where, [texts[key] for key in NUMBERS])
    try:
        omm.initialize(record, texts)
    except (ValueError, OverflowError):
        raise where.error(
            "not elements of SGP4",
            "a date of the calendar; whole numbers of the satellite, its set and its orbit",
        ) from None
    return usable(path, n, texts["OBJECT_NAME"], record)


def usable(path: str, n: int, name: str, record: Any) -> MeanElements:
    """The elements of a satellite. Raises InputError for elements that SGP4 refuses at their own epoch."""
    from sgp4.api import SGP4_ERRORS

    error, place_km, _ = record.sgp4(record.jdsatepoch, record.jdsatepochF)
    if error or not np.isfinite(place_km).all():
        what = SGP4_ERRORS.get(error, "elements that are not numbers")
        raise Where(path, n, "satellite").error(f"SGP4 refuses these elements: {what}")
    return MeanElements(int(record.satnum), name or str(record.satnum), record)


def gcrs_states(
    elements: Sequence[MeanElements], time: datetime.datetime, after_s: Floats
) -> tuple[Floats, Floats, Ints]:
    """States of N satellites at K times after a time, by SGP4.

    SGP4's error grows by 1 to 3 km a day from the elements' epoch in low orbits.

    Returns
    -------
    tuple
        (N, K, 3) positions in m and velocities in m/s in GCRS axes, and (N, K) error codes of SGP4
    """
    from sgp4.api import SatrecArray

    # Dates are in two numbers: in one with the Julian date a satellite would be off by 0.3 m.
    days = utc_days(time) + np.asarray(after_s, float) / DAY_S
    errors, place_km, velocity_km_s = SatrecArray([one.record for one in elements]).sgp4(
        np.full(len(days), J2000_JD), days
    )
    matrix = gcrs_from_teme(time)
    return 1e3 * place_km @ matrix.T, 1e3 * velocity_km_s @ matrix.T, errors.astype(np.int64)


@lru_cache(maxsize=64)
def gcrs_from_teme(time: datetime.datetime) -> Floats:
    """(3, 3) matrix from SGP4's true equator and mean equinox (TEME) to GCRS axes.

    TEME and the axes that rotate with the Earth differ by Greenwich mean sidereal time of 1982 about the pole. Those
    axes differ from the celestial intermediate system by the Earth rotation angle; GCRS axes follow by precession and
    nutation of IAU 2006/2000A. Source: Vallado et al. 2006, appendix C; IERS Conventions 2010, chapter 5.
    """
    # The difference of both angles about the pole.
    ut1 = ut1_jd(time)
    angle = erfa.gmst82(ut1, 0.0) - erfa.era00(ut1, 0.0)
    return erfa.c2i06a(tt_jd(time), 0.0).T @ erfa.rz(angle, np.eye(3))


# OEM: segments of metadata (META_START ... META_STOP) and lines of an epoch, a position in km, a velocity in km/s and,
# if present, an acceleration in km/s^2. Covariances are not used.


VERSION = "CCSDS_OEM_VERS"
VERSIONS = ("1.0", "2.0", "3.0")
FRAMES = ("ICRF", "GCRF", "EME2000", "J2000")
OEM_REQUIRED = ("CENTER_NAME", "REF_FRAME", "TIME_SYSTEM")
# Adjoining segments may share a sample; its positions then differ by less than this
SAME_M = 1.0
# Lines that begin or end a part, which may come after each other in any order from the first META_START on.
PARTS = ("META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP")
AFTER = {**dict.fromkeys(PARTS, PARTS), "META_START": ("", *PARTS)}


class OemOrbit(NamedTuple):
    """An orbit in GCRS axes given by samples, as a polynomial between them.

    Attributes
    ----------
    source
        The file
    t_s
        (N,) times since the scene's start, strictly increasing
    path
        Polynomial of the fifth degree between two samples, from their positions, velocities and accelerations
    """

    source: str
    t_s: Floats
    path: "scipy.interpolate.BPoly"

    def states(self, after_s: Floats) -> GcrsState:
        """(K, 3) positions and velocities at K times. Raises InputError outside the samples."""
        # No extrapolation: the polynomials diverge.
        first, last = self.t_s[[0, -1]]
        if after_s.min() < first or after_s.max() > last:
            worst = after_s.min() if after_s.min() < first else after_s.max()
            raise InputError(
                "orbit.file",
                f"{self.source} is from {first:.6g} to {last:.6g} s after start_time, not at {worst:.6g} s",
            )
        return GcrsState(self.path(after_s), self.path.derivative()(after_s))


def read_oem(path: str, start: datetime.datetime) -> OemOrbit:
    """The orbit of an OEM file.

    1. Read the segments and their samples.
    2. Join them; a sample that two segments share is taken once.
    3. Accelerations that the file lacks are those of gravity with J2. The error between two samples of a low orbit is
       then 1 mm at a step of 2 min and 0.2 m at 5 min.

    Raises
    ------
    InputError
        For a file that is not an OEM, or whose epochs are not in order.
    """
    # 1.
    lines = read_lines(Path(path))
    _, segments = split_segments(path, lines, VERSION, VERSIONS, AFTER, "META_STOP")
    if not segments:
        raise InputError(
            path, "no segment", "META_START ... META_STOP, then lines of an epoch and numbers"
        )
    parts = [segment_samples(path, segment, start) for segment in segments]
    # 2.
    t_s, samples = parts[0]
    for t, more in parts[1:]:
        # The same sample at the seam of two segments.
        if t[0] == t_s[-1] and np.linalg.norm(more[0, :3] - samples[-1, :3]) < SAME_M:
            t = t[1:]
            more = more[1:]
        t_s = np.concatenate([t_s, t])
        samples = np.concatenate([samples, more])
    if len(t_s) < 2 or (np.diff(t_s) <= 0).any():
        raise InputError(
            path, f"the epochs of {len(t_s)} samples", "two or more, in order of time"
        )
    # 3.
    missing = np.isnan(samples[:, 6])
    samples[missing, 6:] = gravity_m_s2(samples[missing, :3])
    return OemOrbit(
        path, t_s, scipy.interpolate.BPoly.from_derivatives(t_s, samples.reshape(-1, 3, 3))
    )


def gravity_m_s2(position_m: Floats) -> Floats:
    """(N, 3) accelerations by the Earth's mass and J2 at (N, 3) positions (Vallado 2013, section 8.7.1).

    a = -mu r / |r|^3 (1 + 1.5 J2 (R / |r|)^2 ((1, 1, 3) - 5 (z / |r|)^2)).
    """
    r = np.linalg.norm(position_m, axis=1, keepdims=True)
    flattened = 1.5 * EARTH_J2 * (EARTH_RADIUS_M / r) ** 2
    polar = 5 * (position_m[:, 2:] / r) ** 2
    factors = 1 + flattened * (np.array([1.0, 1.0, 3.0]) - polar)
    return -EARTH_MU_M3_S2 / r**3 * position_m * factors


def segment_samples(
    path: str, segment: TextSegment, start: datetime.datetime
) -> tuple[Floats, Floats]:
    """Samples of a segment in SI units and GCRS axes. Raises InputError.

    Returns
    -------
    tuple
        (N,) times since `start`, and (N, 9) positions, velocities and accelerations, NaN where the file has none
    """
    metadata = segment.metadata
    segment.require(path, OEM_REQUIRED)
    frame = one_of(path, metadata, "REF_FRAME", FRAMES)
    one_of(path, metadata, "CENTER_NAME", ("EARTH",))
    system = one_of(path, metadata, "TIME_SYSTEM", SCALES)
    if not segment.data:
        raise InputError(
            path, "a segment without data", "lines of an epoch, a position and a velocity"
        )
    lines = [n for n, _ in segment.data]
    rows = [(n, words[1:]) for n, words in segment.data]
    # Nine numbers with accelerations, else six.
    width = 9 if len(rows[0][1]) == 9 else 6
    numbers = 1e3 * to_numbers(path, rows, width)
    for n in np.flatnonzero(np.abs(numbers[:, :3]).max(axis=1) < 1e6):
        raise Where(path, lines[n]).error(
            "a position in the Earth's core", "positions in km from its center"
        )
    t_s = seconds_since(path, lines, [words[0] for _, words in segment.data], start, system)
    if width == 6:
        numbers = np.column_stack([numbers, np.full((len(numbers), 3), np.nan)])
    # From the mean equator of J2000.0 to the GCRS by the frame bias.
    if frame in ("EME2000", "J2000"):
        bias, _, _ = erfa.bp06(J2000_JD, 0.0)
        numbers = (numbers.reshape(-1, 3) @ bias).reshape(-1, 9)
    return t_s, numbers
