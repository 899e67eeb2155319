"""Positions and velocities from a CCSDS Orbit Ephemeris Message (OEM) in keyword = value notation.

CCSDS 502.0-B-2 and 502.0-B-3: segments of metadata (META_START ... META_STOP) and lines of an epoch, a position in km,
a velocity in km/s and, if present, an acceleration in km/s^2. Covariances are not used.
"""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import NamedTuple

import erfa
import numpy as np
from scipy.interpolate import BPoly

from skysim.core.constants import EARTH_J2, EARTH_MU_M3_S2, EARTH_RADIUS_M
from skysim.core.errors import InputError, Where
from skysim.core.text import (Segment, check_version, keyword_value, one_of, read_lines, seconds_since, to_numbers)
from skysim.core.time import J2000_JD, SCALES
from skysim.core.types import Floats

VERSION = "CCSDS_OEM_VERS"
VERSIONS = ("1.0", "2.0", "3.0")
FRAMES = ("ICRF", "GCRF", "EME2000", "J2000")
REQUIRED = ("CENTER_NAME", "REF_FRAME", "TIME_SYSTEM")
SAME_M = 1.0  # of a sample that both of two adjoining segments have
KEYWORDS = ("META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP")


class Ephemeris(NamedTuple):
    """Samples of an orbit in GCRS axes.

    t_s  : (N,) since the scene's start, strictly increasing
    path : a polynomial of the fifth degree between two samples, of their positions, velocities and accelerations
    """

    source: str
    t_s: Floats
    path: BPoly

    def at(self, after_s: Floats) -> tuple[Floats, Floats]:
        """Positions (K, 3) in m and velocities in m/s. Raises InputError outside the samples."""
        first, last = self.t_s[[0, -1]]
        if after_s.min() < first or after_s.max() > last:
            worst = after_s.min() if after_s.min() < first else after_s.max()
            raise InputError(
                "orbit.file",
                f"{self.source} is from {first:.6g} to {last:.6g} s after start_time, not at {worst:.6g} s",
            )
        return self.path(after_s), self.path.derivative()(after_s)


def read_oem(path: str, start: datetime.datetime) -> Ephemeris:
    """The orbit of an OEM. Raises InputError.

    Without accelerations in the file, those of gravity with J2 are taken. The error between two samples of a low orbit
    is 1 mm at a step of 2 min and 0.2 m at 5 min.
    """
    segments = split_segments(path)
    if not segments:
        raise InputError(
            path, "no segment", "META_START ... META_STOP, then lines of an epoch and numbers"
        )
    parts = [segment_samples(path, segment, start) for segment in segments]
    t_s, samples = parts[0]
    for t, more in parts[1:]:
        if t[0] == t_s[-1] and np.linalg.norm(more[0, :3] - samples[-1, :3]) < SAME_M:
            t = t[1:]
            more = more[1:]
        t_s = np.concatenate([t_s, t])
        samples = np.concatenate([samples, more])
    if len(t_s) < 2 or (np.diff(t_s) <= 0).any():
        raise InputError(path, f"the epochs of {len(t_s)} samples", "two or more, in order of time")
    missing = np.isnan(samples[:, 6])
    samples[missing, 6:] = gravity_m_s2(samples[missing, :3])
    return Ephemeris(path, t_s, BPoly.from_derivatives(t_s, samples.reshape(-1, 3, 3)))


def gravity_m_s2(position_m: Floats) -> Floats:
    """(N, 3) acceleration by the Earth's mass and J2 at (N, 3). Source: Vallado 2013, section 8.7.1."""
    r = np.linalg.norm(position_m, axis=1, keepdims=True)
    flattened = 1.5 * EARTH_J2 * (EARTH_RADIUS_M / r) ** 2
    polar = 5 * (position_m[:, 2:] / r) ** 2
    factors = 1 + flattened * (np.array([1.0, 1.0, 3.0]) - polar)
    return np.asarray(-EARTH_MU_M3_S2 / r**3 * position_m * factors)


def split_segments(path: str) -> list[Segment]:
    """The segments of a message. Raises InputError for a line out of place."""
    version = ""
    segments = list[Segment]()
    section = ""
    for n, line in read_lines(Path(path)):
        word = line.split(maxsplit=1)[0]
        if word == "COMMENT":
            continue
        if word in KEYWORDS:
            section = word
            if word == "META_START":
                segments.append(Segment({}, []))
            elif not segments:
                raise InputError(path, f"{word} before META_START", where=Where(path, n))
        elif section in ("", "META_START"):
            key, value = keyword_value(path, n, line)
            if section:
                segments[-1].metadata[key] = (n, value)
            elif key == VERSION:
                version = value
        elif section == "META_STOP":
            segments[-1].data.append((n, line.split()))
    check_version(path, VERSION, version, VERSIONS)
    return segments


def segment_samples(path: str, segment: Segment, start: datetime.datetime) -> tuple[Floats, Floats]:
    """Times (N,) and positions, velocities, accelerations (N, 9) of a segment, SI, GCRS axes. Raises InputError."""
    metadata = segment.metadata
    segment.require(path, REQUIRED)
    frame = one_of(path, metadata, "REF_FRAME", FRAMES)
    one_of(path, metadata, "CENTER_NAME", ("EARTH",))
    system = one_of(path, metadata, "TIME_SYSTEM", SCALES)
    if not segment.data:
        raise InputError(
            path, "a segment without data", "lines of an epoch, a position and a velocity"
        )
    lines = [n for n, _ in segment.data]
    rows = [words[1:] for _, words in segment.data]
    width = 9 if len(rows[0]) == 9 else 6
    numbers = 1e3 * to_numbers(path, lines, rows, width)
    t_s = seconds_since(path, lines, [words[0] for _, words in segment.data], start, system)
    if width == 6:
        numbers = np.column_stack([numbers, np.full((len(numbers), 3), np.nan)])
    if frame in ("EME2000", "J2000"):
        bias, _, _ = erfa.bp06(J2000_JD, 0.0)
        numbers = (numbers.reshape(-1, 3) @ bias).reshape(-1, 9)
    return t_s, numbers
