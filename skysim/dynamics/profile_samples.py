"""Attitude samples as read from a file or a table, and their checks. An error message names the line of the fault.

They come from files of other formats (profiles.py), or from named columns: a CSV or ECSV file, or an astropy
Table or pandas DataFrame, read here. The names of the columns define their content, so nothing is guessed:

time     : `t_s`, or `utc` (ISO 8601)
attitude : a quaternion `A_from_B_qw`, `_qx`, `_qy`, `_qz` of one of the rotations in QUATERNIONS, or the components
           `q_w`, `q_x`, `q_y`, `q_z` where the scene's maneuver names the rotation; in a laboratory `roll_deg`,
           `pitch_deg`, `yaw_deg`, 3-2-1 angles of the body, or `azimuth_deg`, `elevation_deg` of a two-axis mount,
           Rz(azimuth) Ry(elevation); under the stars `ra_deg`, `dec_deg`, `roll_deg` of the
           camera
"""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError, Where, printable
from skysim.core.text import Line, cells_of, excerpt, seconds_since, to_numbers
from skysim.core.time import J2000_JD
from skysim.core.types import Floats, Ints, Record, frozen, lengths
from skysim.scene.sections.motion import RotationName
from skysim.sources.stars import cam_from_icrs

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
    norm = lengths(xyzw) if len(xyzw) else np.empty(0)
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


# Samples from named columns.

QUATERNIONS = get_args(RotationName)
BARE = ("q_x", "q_y", "q_z", "q_w")
BODY_ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
GIMBAL_ANGLES = ("azimuth_deg", "elevation_deg")
CAMERA_ANGLES = ("ra_deg", "dec_deg", "roll_deg")
TIMES = ("t_s", "utc")
UNITS = {"t_s": "s", **dict.fromkeys(BODY_ANGLES + GIMBAL_ANGLES + CAMERA_ANGLES, "deg")}
COLUMNS = (
    "t_s or utc, with A_from_B_qx, _qy, _qz, _qw (A_from_B: "
    + ", ".join(QUATERNIONS)
    + "), or q_x, q_y, q_z, q_w and"
    " the maneuver's key rotation, or roll_deg, pitch_deg, yaw_deg, or azimuth_deg,"
    " elevation_deg, or ra_deg, dec_deg, roll_deg"
)


def read_csv(
    path: Path, lines: list[Line], start: datetime.datetime, rotation: str | None
) -> Samples:
    """Samples of a CSV file: a line of column names, then a line for each sample. Lines with # are comments."""
    # 1. Split the lines into cells.
    rows = cells_of(lines)
    if not rows:
        raise InputError(
            path, "empty", "a line of column names, then a line for each attitude"
        )
    body = rows[1:]
    (head, names) = rows[0]
    check_names(Where(path, head), names, rotation)
    for n, cells in body:
        if len(cells) != len(names):
            raise Where(path, n).error(
                f"{len(cells)} values", f"{len(names)}, one for each column"
            )
    # 2. Convert to columns; epochs stay texts.
    places = [n for n, _ in body]
    columns = Record()
    if "utc" in names:
        date = names.index("utc")
        columns["utc"] = [cells.pop(date) for _, cells in body]
        names = names[:date] + names[date + 1 :]
    numbers = to_numbers(path, body, len(names))
    columns |= dict(zip(names, numbers.T, strict=True))
    return to_samples(path, "line", places, columns, start, rotation)


def from_table(
    table: Any, source: str | Path, start: datetime.datetime, rotation: str | None = None
) -> Samples:
    """Samples of an astropy Table, a pandas DataFrame or a mapping of columns. Raises InputError.

    Parameters
    ----------
    table
        Table with the columns of the module's docstring
    source
        Name of the table or file, for messages
    start
        The scene's start in UTC, from which epochs count
    rotation
        Name of the rotation of columns q_x, q_y, q_z, q_w; None for other columns
    """
    try:
        names = [
            str(name)
            for name in (table.colnames if hasattr(table, "colnames") else table.keys())
        ]
        columns = {name: table[name] for name in names}
    except (AttributeError, TypeError, KeyError):
        raise InputError(
            source,
            type(table).__name__,
            "an astropy Table, a pandas DataFrame or a mapping of columns",
        ) from None
    check_names(Where(source), names, rotation)
    values: Record = {}
    for name, column in columns.items():
        unit = getattr(column, "unit", None)
        if unit is not None and str(unit) != UNITS.get(name, ""):
            raise InputError(
                source, f"column {name} is in {unit}", UNITS.get(name) or "no unit"
            )
        values[name] = to_epochs(column) if name == "utc" else to_column(source, name, column)
    count = len(next(iter(values.values())))
    for name, column in values.items():
        if len(column) != count:
            raise InputError(
                source, f"column {name} has {len(column)} values", f"{count}, as the first"
            )
    return to_samples(source, "row", range(1, count + 1), values, start, rotation)


def to_column(source: str | Path, name: str, column: Any) -> Floats:
    """(N,) numbers of a column. Raises InputError that names the first row without a finite number."""
    try:
        numbers = np.ma.filled(np.ma.asarray(column).astype(np.float64), np.nan)
    except (TypeError, ValueError):
        raise InputError(source, f"column {name} has values that are no numbers") from None
    if numbers.ndim != 1:
        raise InputError(
            source, f"column {name} has shape {numbers.shape}", "one number in each row"
        )
    if len(bad := np.flatnonzero(~np.isfinite(numbers))):
        raise Where(source, int(bad[0]) + 1, "row").error(f"{name} is not a finite number")
    return np.asarray(numbers, dtype=np.float64)


def to_epochs(column: Any) -> list[str]:
    """ISO 8601 texts of a column of texts, datetimes, numpy or pandas dates, or an astropy Time."""
    if hasattr(column, "utc") and hasattr(column, "isot"):  # an astropy Time
        exact = column.utc.replicate()
        exact.precision = 9
        return [str(text) for text in np.atleast_1d(exact.isot)]
    values = np.asarray(column)
    if values.dtype.kind == "M":
        return [str(text) for text in np.datetime_as_string(values.astype("datetime64[ns]"))]
    return [
        value.isoformat() if isinstance(value, datetime.datetime) else str(value)
        for value in values.tolist()
    ]


def check_names(where: Where, names: Sequence[str], rotation: str | None) -> None:
    """Raise InputError unless the columns are exactly one time and one attitude."""
    repeated = [name for n, name in enumerate(names) if name in names[:n]]
    if repeated:
        raise where.error(f"two columns {excerpt(repeated[0])}", "one")
    # The sets of columns that make an attitude.
    attitudes = [tuple(f"{name}_q{end}" for end in "xyzw") for name in QUATERNIONS]
    attitudes += [BARE, BODY_ANGLES, GIMBAL_ANGLES, CAMERA_ANGLES]
    known = {*TIMES, *(name for columns in attitudes for name in columns)}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise where.error(f"unknown column {excerpt(unknown[0])}", COLUMNS)
    found = {name for name in names if name not in TIMES}
    if len(found) + 1 != len(names) or not any(
        set(columns) == found for columns in attitudes
    ):
        given = ", ".join(printable(name) for name in names)
        raise where.error(f"columns {given} are not one time and one attitude", COLUMNS)
    if found == set(BARE) and rotation is None:
        raise where.error(
            "q_x, q_y, q_z, q_w do not say which rotation they are",
            f"rotation: {QUATERNIONS[0]} in the maneuver, or columns {QUATERNIONS[0]}_qx, ...",
        )
    if found != set(BARE) and rotation is not None:
        raise where.error("the columns name the rotation", "no key rotation in the maneuver")


def to_samples(
    source: str | Path,
    unit: str,
    places: Sequence[int],
    columns: Mapping[str, Any],
    start: datetime.datetime,
    rotation: str | None,
) -> Samples:
    """Samples of checked columns. `places` (N,) are their lines or rows, as `unit` says."""
    absolute = "utc" in columns
    t_s = (
        seconds_since(source, places, columns["utc"], start, "UTC", unit)
        if absolute
        else np.asarray(columns["t_s"], dtype=np.float64)
    )
    ends = np.array(places, np.int64)
    # 3-2-1 angles of the body in the lab, or those of its mount.
    for order, names in (("ZYX", BODY_ANGLES[::-1]), ("ZY", GIMBAL_ANGLES)):
        if names[0] in columns:
            body = Rotation.from_euler(order, stack(columns, names), degrees=True)
            return Samples(source, unit, ends, t_s, "lab", "body", body, absolute)
    # Right ascension, declination and roll of the camera.
    if "ra_deg" in columns:
        if len(bad := np.flatnonzero(np.abs(columns["dec_deg"]) > 90)):
            raise Where(source, places[bad[0]], unit).error(
                "dec_deg is beyond a pole", "-90 to 90"
            )
        camera = cam_from_icrs(*stack(columns, CAMERA_ANGLES).T)
        return Samples(source, unit, ends, t_s, "cam", "icrs", camera, absolute)
    # A quaternion, whose rotation is named by the columns or by the maneuver.
    first = next(name for name in columns if name.endswith(("_qw", "q_w")))
    prefix = first.removesuffix("w")
    a, _, b = (rotation or first.removesuffix("_qw")).partition("_from_")
    xyzw = stack(columns, [f"{prefix}{end}" for end in "xyzw"])
    return from_quaternions(source, unit, ends, t_s, (a, b), xyzw, absolute)


def stack(columns: Mapping[str, Any], names: Sequence[str]) -> Floats:
    """(N, K) matrix of the columns with K names."""
    return np.column_stack([columns[name] for name in names])
