"""Attitude samples as read from a file or a table, and their checks. An error message names the line of the fault."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError, Where
from skysim.core.text import excerpt
from skysim.core.time import J2000_JD
from skysim.core.types import Floats, Ints, frozen

MIN_SAMPLES = 4  # a not-a-knot cubic needs four
MAX_SAMPLES = 1_000_000
UNIT_TOLERANCE = 1e-3  # greatest deviation of a quaternion's norm from 1
MAX_TIME_S = 1e9
MIN_STEP_S = 1e-6
# Largest rotation between two samples. At a constant rate the error of the interpolated attitude grows with its fifth
# power, most in the first and the last step: 0.04 arcsec at 10 deg, 1.3 arcsec at 20 deg (measured).
MAX_STEP_DEG = 10.0


@frozen
class Samples:
    """N attitudes over time.

    Attributes
    ----------
    source
        Path of the file or name of the table, for messages
    unit
        Unit of `places`: line of a file, or row of a table
    places
        (N,) line or row of each sample, from 1
    t_s
        (N,) seconds from the scene's start if `absolute`, else from the zero of the file's times
    a, b
        Frames of the rotations: one of icrs and lab, and one of body and cam, in any order
    a_from_b
        N rotations
    absolute
        Whether the samples have epochs
    """

    source: str | Path
    unit: str
    places: Ints
    t_s: Floats
    a: str
    b: str
    a_from_b: Rotation
    absolute: bool = False

    def error(self, n: int, problem: str, allowed: str = "") -> InputError:
        """The error for sample n, with its line or row."""
        return Where(self.source, int(self.places[n]), self.unit).error(problem, allowed)

    @property
    def direction(self) -> str:
        """Name of the rotations, such as lab_from_body."""
        return f"{self.a}_from_{self.b}"

    def inverted(self) -> "Samples":
        """The same attitudes as rotations b_from_a."""
        return replace(self, a=self.b, b=self.a, a_from_b=self.a_from_b.inv())


def continuous(quaternions: Floats) -> Floats:
    """(K, 4) the same attitudes without jumps of a component: q and -q are the same attitude.

    Each quaternion takes the sign that makes its dot product with the previous one positive.
    """
    dot = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
    sign = np.cumprod(np.where(dot < 0, -1.0, 1.0))
    return quaternions * np.append(1.0, sign)[:, None]


def from_quaternions(
    source: str | Path,
    unit: str,
    places: Sequence[int] | Ints,
    t_s: Floats,
    frames: tuple[str, str],
    xyzw: Floats,
    absolute: bool = False,
) -> Samples:
    """Samples of quaternions (N, 4), scalar last. Raises InputError for the first one whose norm is not 1."""
    places = np.asarray(places, np.int64)
    norm = np.linalg.norm(xyzw, axis=1) if len(xyzw) else np.empty(0)
    bad = np.flatnonzero(~(np.abs(norm - 1) <= UNIT_TOLERANCE))  # NaN is bad, too
    if len(bad):
        raise Where(source, int(places[bad[0]]), unit).error(
            f"a quaternion of norm {norm[bad[0]]:.6g}", f"1, to {UNIT_TOLERANCE:g}"
        )
    rotation = Rotation.from_quat(xyzw) if len(xyzw) else Rotation.identity(0)
    return Samples(source, unit, places, t_s, *frames, rotation, absolute)


def check_samples(samples: Samples) -> Samples:
    """The samples. Raises InputError for too few or too many, times that do not ascend, or samples too far apart."""
    # 1. Number.
    count = len(samples.t_s)
    if not MIN_SAMPLES <= count <= MAX_SAMPLES:
        raise InputError(
            samples.source, f"{count} attitudes", f"{MIN_SAMPLES} to {MAX_SAMPLES}"
        )
    # 2. Times. NaN is rejected, too.
    if len(bad := np.flatnonzero(~(np.abs(samples.t_s) <= MAX_TIME_S))):
        raise samples.error(
            int(bad[0]),
            f"time {samples.t_s[bad[0]]:.9g} s",
            f"within {MAX_TIME_S:g} s of the start",
        )
    if len(bad := np.flatnonzero(np.diff(samples.t_s) < MIN_STEP_S)):
        n = int(bad[0]) + 1
        after = samples.t_s[n]
        before = samples.t_s[n - 1]
        raise samples.error(
            n, f"time {after:.9g} s is not after {before:.9g} s, by a microsecond at least"
        )
    # 3. Rotation from each sample to the next.
    angle_deg = np.degrees((samples.a_from_b[:-1].inv() * samples.a_from_b[1:]).magnitude())
    if len(bad := np.flatnonzero(angle_deg > MAX_STEP_DEG)):
        n = int(bad[0]) + 1
        raise samples.error(
            n,
            f"{angle_deg[n - 1]:.3g} deg from the attitude before it",
            f"up to {MAX_STEP_DEG:g} deg; sample more densely",
        )
    return samples


# Names of frames in CCSDS and STK attitude files.

# The names that skysim writes.
ICRF = "ICRF"
LAB = "LAB"
CAMERA = "STARTRACKER_1"
BODY = "SC_BODY_1"
EME2000 = ("EME2000", "J2000")
# Frames of `Samples` by the names that are read.
REFERENCES = {ICRF: "icrs", "GCRF": "icrs", LAB: "lab", **dict.fromkeys(EME2000, "icrs")}
VEHICLES = {BODY: "body", "SC_BODY": "body", CAMERA: "cam", "STARTRACKER": "cam"}


def frame_of(where: Where, name: str) -> str:
    """The frame (icrs, lab, body or cam) with this name in a file. Raises InputError for an unknown name."""
    frames = REFERENCES | VEHICLES
    if name.upper() not in frames:
        raise where.error(f"unknown frame {excerpt(name)}", ", ".join(frames))
    return frames[name.upper()]


def icrs_from(name: str) -> Rotation:
    """Rotation from the axes of an inertial frame to those of the ICRS: identity, except for EME2000.

    The frame bias of EME2000 is 23 mas, by IAU 2006 (ERFA's bp06).
    """
    import erfa

    if name.upper() not in EME2000:
        return Rotation.identity()
    mean_from_icrs, _, _ = erfa.bp06(J2000_JD, 0.0)
    return Rotation.from_matrix(mean_from_icrs).inv()
