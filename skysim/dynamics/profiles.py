"""Attitude profiles of a scene.

1. `read_profile` reads the samples of a file, here, or of a table's columns (profile_samples.py).
2. `to_body` converts them to lab_from_body.
3. `profile_samples.check_samples` checks their number, times and steps.
4. `two_axis.on_gimbals` turns them to those that a two-axis mount takes.
5. `reference_curves.AttitudeSpline` interpolates them.

Two kinds of files have formats of their own: CCSDS Attitude Ephemeris Messages, and STK attitude files (`.a`).

An Attitude Ephemeris Message (AEM) of version 1.0 or 2.0 is keyword = value or XML, by CCSDS 504.0-B-1 and 504.0-B-2.
The quaternion "from A to B" turns the axes of A into those of B (annex F2 of 504.0-B-2), which is the quaternion of the
rotation a_from_b of coordinates. Version 1.0 also names the direction (ATTITUDE_DIR: A2B or B2A) and whether the scalar
is FIRST or LAST (QUATERNION_TYPE). In version 2.0 the direction is A to B and the scalar is last, but these keywords
are obeyed if a file has them. Euler angles likewise turn A into B, each about an axis that the ones before it have
turned, in the order of EULER_ROT_SEQ (312 or ZXY). A spinning vehicle has its spin axis, z of B, at right ascension
alpha and declination delta of A, and the spin angle about it from the axis z x z_B to x of B:

    a_from_b = Rz(90 deg + alpha) Rx(90 deg - delta) Rz(spin angle)

Nutation, rates and derivatives after the angles or the quaternion are not used, nor is the interpolation that the file
recommends.

1. `from_xml` writes an XML message as the lines of its keyword = value notation.
2. `split_segments` reads the lines into segments of metadata and data.
3. `segment_samples` converts each segment to checked samples within its useable span.
4. `join` appends them to each other.

STK's help describes its format (AttitudeTimeQuaternions, also scalar-first) in "Attitude File Format (*.a)". A
quaternion is that of the rotation that turns the axes of CoordinateAxes into those of the body. It converts coordinates
from body to reference: ref_from_body. Times are seconds from ScenarioEpoch (UTC). The interpolation that the file names
is not used.
"""

import datetime
from collections.abc import Iterable
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError, XMLPullParser

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError, Where, errors_within, unknown_name
from skysim.core.files import read_table
from skysim.core.text import (
    Line,
    Metadata,
    TextSegment,
    Words,
    excerpt,
    one_of,
    read_lines,
    seconds_since,
    split_segments,
    to_numbers,
)
from skysim.core.time import SCALES, in_utc
from skysim.core.types import Floats, Mount
from skysim.dynamics import profile_samples
from skysim.dynamics.profile_samples import (
    REFERENCES,
    Samples,
    check_samples,
    frame_of,
    from_quaternions,
    icrs_from,
)
from skysim.dynamics.reference_curves import AttitudeSpline
from skysim.dynamics.two_axis import on_gimbals
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import ProfileConfig

VERSION = "CCSDS_AEM_VERS"
VERSIONS = ("1.0", "2.0")
# Numbers after the epoch: first the four of a quaternion, or three angles in degrees.
TYPES = {
    "QUATERNION": 4,
    "QUATERNION/DERIVATIVE": 8,
    "QUATERNION/RATE": 7,
    "QUATERNION/ANGVEL": 7,
    "EULER_ANGLE": 3,
    "EULER_ANGLE/RATE": 6,
    "EULER_ANGLE/DERIVATIVE": 6,
    "EULER_ANGLE/ANGVEL": 6,
    "SPIN": 4,
    "SPIN/NUTATION": 7,
    "SPIN/NUTATION_MOM": 7,
}
# Keywords that begin or end a part, and those after which each may come; the header has none.
AFTER = {
    "META_START": ("", "DATA_STOP"),
    "META_STOP": ("META_START",),
    "DATA_START": ("META_STOP",),
    "DATA_STOP": ("DATA_START",),
}
NUMBERED = str.maketrans("123", "XYZ")
# Elements of an XML message, and what their keywords begin with.
XML_SECTIONS = {"metadata": "META", "data": "DATA"}
# Order of the elements of an attitude; others keep theirs after them.
XML_ORDER = {"EPOCH": 0, "Q1": 1, "Q2": 2, "Q3": 3, "QC": 4}
DIRECTIONS = ("A2B", "B2A")
ORDERS = ("FIRST", "LAST")
REQUIRED = ("REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", "ATTITUDE_TYPE")
# Greatest difference of one sample that two adjoining segments share
SAME_ATTITUDE_RAD = 1e-6


def read_aem(path: Path, lines: list[Line], start: datetime.datetime) -> Samples:
    """The samples of all segments. Raises InputError for a file that is not an AEM."""
    if lines[0][1].startswith("<"):
        lines = from_xml(path, lines)
    version, segments = split_segments(path, lines, VERSION, VERSIONS, AFTER, "DATA_START")
    last = next((line for _, line in reversed(lines) if line in AFTER), "DATA_STOP")
    if last != "DATA_STOP":
        raise InputError(path, f"ends within a segment, after {last}: the file is cut off")
    if not segments:
        raise InputError(
            path, "no segment", "META_START ... META_STOP, DATA_START ... DATA_STOP"
        )
    parts = [segment_samples(path, version, segment, start) for segment in segments]
    return reduce(join, parts)


def from_xml(path: Path, lines: list[Line]) -> list[Line]:
    """The lines of an AEM in XML (CCSDS 505.0-B) as keyword = value. Raises InputError for damaged or unsafe XML."""
    out = []
    section = ""
    parser: Any = XMLPullParser(("start", "end"))
    for n, line in lines:
        if "<!DOCTYPE" in line:  # it may declare entities that expand
            raise Where(path, n).error("XML with a document type", "none")
        try:
            parser.feed(f"{line}\n")
            events = list(parser.read_events())
        except ParseError as error:
            raise Where(path, n).error(f"not XML: {error}") from None
        for event, element in events:
            tag = element.tag
            if event == "start":
                if tag == "aem":
                    out.append((n, f"{VERSION} = {element.get('version', '')}"))
                elif tag in XML_SECTIONS:
                    section = XML_SECTIONS[tag]
                    out.append((n, f"{section}_START"))
            elif tag == "attitudeState":
                # A quaternion with its scalar last, others in their order.
                leaves = [
                    one for one in element.iter() if not len(one) and one.tag != "COMMENT"
                ]
                leaves.sort(key=lambda one: XML_ORDER.get(str(one.tag), len(XML_ORDER)))
                out.append(
                    (n, " ".join("".join((one.text or "-").split()) for one in leaves))
                )
                element.clear()
            elif tag in XML_SECTIONS:
                if section == "META":
                    # Its quaternions are put in this order by their names.
                    out.append((n, "QUATERNION_TYPE = LAST"))
                out.append((n, f"{section}_STOP"))
                section = ""
            elif section == "META":
                out.append((n, f"{tag} = {(element.text or '').strip()}"))
    return out


def segment_samples(
    path: Path, version: str, segment: TextSegment, start: datetime.datetime
) -> Samples:
    """The samples of one segment within its useable span. Raises InputError for invalid metadata or data.

    1. Check the metadata: keywords, time system, and two frames of which one is inertial and one of the vehicle.
    2. Convert epochs and numbers.
    3. Order the quaternion's components and the frames as the file's conventions say.
    4. Apply the frame bias, and keep the useable span.
    """
    # 1. Metadata.
    metadata = segment.metadata
    segment.require(path, (*REQUIRED, *(("ATTITUDE_DIR",) if version == "1.0" else ())))
    system = one_of(path, metadata, "TIME_SYSTEM", SCALES)
    kind = one_of(path, metadata, "ATTITUDE_TYPE", TYPES)
    width = TYPES[kind]
    if kind.startswith("EULER"):
        segment.require(path, ("EULER_ROT_SEQ",))
    elif kind.startswith("QUATERNION") and version == "1.0":
        segment.require(path, ("QUATERNION_TYPE",))
    frames = [
        frame_of(Where(path, metadata[key][0]), metadata[key][1]) for key in REQUIRED[:2]
    ]
    names = [metadata[key][1] for key in REQUIRED[:2]]
    if sum(name.upper() in REFERENCES for name in names) != 1:
        raise Where(path, metadata["REF_FRAME_B"][0]).error(
            f"the attitude of {names[1]} in {names[0]}",
            "one of the two an inertial or laboratory frame, the other of the vehicle",
        )
    # 2. Data lines: an epoch, and the numbers.
    for n, words in segment.data:
        if len(words) != width + 1:
            raise Where(path, n).error(
                f"{len(words)} values", f"an epoch and {width} numbers"
            )
    lines = [n for n, _ in segment.data]
    numbers = to_numbers(path, [(n, words[1:]) for n, words in segment.data], width)
    t_s = seconds_since(path, lines, [words[0] for _, words in segment.data], start, system)
    # 3. Conventions: scalar last and A to B, unless the keywords say otherwise.
    xyzw = quaternions(path, metadata, kind, numbers)
    reverse = (
        "ATTITUDE_DIR" in metadata
        and one_of(path, metadata, "ATTITUDE_DIR", DIRECTIONS) == "B2A"
    )
    a, b = frames[::-1] if reverse else frames
    samples = from_quaternions(path, "line", lines, t_s, (a, b), xyzw, absolute=True)
    # 4. Frame bias and useable span.
    useable = within_span(path, metadata, t_s, start, system)
    return take(to_icrs(samples, names), useable)


def quaternions(path: Path, metadata: Metadata, kind: str, numbers: Floats) -> Floats:
    """(N, 4) quaternions of a_from_b, scalar last, from the numbers of a type of attitude. Raises InputError."""
    if kind.startswith("QUATERNION"):
        first = (
            "QUATERNION_TYPE" in metadata
            and one_of(path, metadata, "QUATERNION_TYPE", ORDERS) == "FIRST"
        )
        return numbers[:, [1, 2, 3, 0] if first else [0, 1, 2, 3]]
    angles_deg = numbers[:, :3]
    if kind.startswith("SPIN"):
        angles_deg = angles_deg * [1, -1, 1] + [90, 90, 0]
    line, sequence = metadata["EULER_ROT_SEQ"] if kind.startswith("EULER") else (0, "ZXZ")
    try:
        axes = sequence.upper().translate(NUMBERED)
        return Rotation.from_euler(axes, angles_deg, degrees=True).as_quat()
    except ValueError:
        raise Where(path, line).error(
            f"EULER_ROT_SEQ = {excerpt(sequence)}", "three axes, such as 321 or ZYX"
        ) from None


def within_span(
    path: Path, metadata: Metadata, t_s: Floats, start: datetime.datetime, system: str
) -> slice:
    """The range of samples from USEABLE_START_TIME to USEABLE_STOP_TIME; a missing keyword sets no limit."""
    ends_s = [-np.inf, np.inf]
    for side, key in enumerate(("USEABLE_START_TIME", "USEABLE_STOP_TIME")):
        if key in metadata:
            line, epoch = metadata[key]
            ends_s[side] = float(seconds_since(path, [line], [epoch], start, system)[0])
    # A nanosecond allows for the rounding of epochs.
    inside = np.flatnonzero((t_s >= ends_s[0] - 1e-9) & (t_s <= ends_s[1] + 1e-9))
    return slice(int(inside[0]), int(inside[-1]) + 1) if len(inside) else slice(0, 0)


def take(samples: Samples, which: slice) -> Samples:
    """A range of the samples."""
    return replace(
        samples,
        places=samples.places[which],
        t_s=samples.t_s[which],
        a_from_b=samples.a_from_b[which],
    )


def to_icrs(samples: Samples, names: list[str]) -> Samples:
    """The samples with the frame bias applied, if one of the two frames is EME2000."""
    # At most one of the two frames is inertial, so at most one factor is not the identity.
    bias = Rotation.identity()
    for name in names:
        bias = icrs_from(name) * bias
    a_from_b = (
        bias * samples.a_from_b if samples.a == "icrs" else samples.a_from_b * bias.inv()
    )
    return replace(samples, a_from_b=a_from_b)


def join(first: Samples, second: Samples) -> Samples:
    """Two adjoining segments as one. A sample that both have at the seam is taken once.

    Raises
    ------
    InputError
        If the segments are in different frames, overlap, or leave a gap.
    """
    if not len(first.t_s) or not len(second.t_s):
        return first if len(first.t_s) else second
    # The same frames, in the same direction.
    direction = second.direction
    if direction != first.direction:
        second = second.inverted()
    if second.direction != first.direction:
        raise second.error(
            0, f"a segment of {direction} after one of {first.direction}", "the same frames"
        )
    # No overlap, except of one sample that both share.
    gap_s = second.t_s[0] - first.t_s[-1]
    if (
        gap_s == 0
        and (first.a_from_b[-1].inv() * second.a_from_b[0]).magnitude() < SAME_ATTITUDE_RAD
    ):
        second = take(second, slice(1, None))
    elif gap_s <= 0:
        raise second.error(
            0, f"a segment that begins {-gap_s:.6g} s before the end of the one before it"
        )
    # No gap, except that of a usual step.
    longest_s = max(float(np.diff(part.t_s).max(initial=0.0)) for part in (first, second))
    if gap_s > 1.5 * longest_s:
        raise second.error(
            0,
            f"a gap of {gap_s:.6g} s between two segments",
            f"up to 1.5 steps, {1.5 * longest_s:.6g}",
        )
    return replace(
        first,
        places=np.concatenate([first.places, second.places]),
        t_s=np.concatenate([first.t_s, second.t_s]),
        a_from_b=Rotation.concatenate([first.a_from_b, second.a_from_b]),
    )


# STK attitude files.

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


# Profiles of a scene.

TABLE = "profile"  # source of a table given in Python


def load_profiles(
    scene: Scene, mount: Mount, given: Any = None
) -> tuple[AttitudeSpline, ...]:
    """The splines of a scene's maneuvers of kind profile, in their order.

    Parameters
    ----------
    scene
        The scene
    mount
        The camera's mount, for profiles of the camera's attitude
    given
        Astropy Table, pandas DataFrame or mapping of columns that replaces the file of the first profile

    Raises
    ------
    InputError
        For an invalid profile; its key is that of the maneuver.
    """
    profiles: list[AttitudeSpline] = []
    for n, element in enumerate(scene.motion.maneuver):
        if isinstance(element, ProfileConfig):
            # A given table replaces the file of the first profile.
            source = given if given is not None and not profiles else Path(element.file)
            with errors_within(f"motion.maneuver.{n}"):
                samples = read_profile(source, in_utc(scene.start_time), element.rotation)
                samples = check_samples(to_body(samples, scene, mount))
                if scene.vehicle.gimbals:
                    samples = on_gimbals(samples, scene.vehicle.gimbals)
                profiles.append(AttitudeSpline(samples))
    return tuple(profiles)


def read_profile(
    source: Any, start: datetime.datetime, rotation: str | None = None
) -> Samples:
    """The samples of a file or a table. The format follows from the first line of the file. Raises InputError.

    Parameters
    ----------
    source
        Path of a file, or a table
    start
        The scene's start in UTC, from which epochs count
    rotation
        Name of the rotation of columns q_x, q_y, q_z, q_w; None for other columns
    """
    if not isinstance(source, Path):
        return profile_samples.from_table(source, TABLE, start, rotation)
    # AEM and STK files name their format and frames; other files are tables.
    lines = read_lines(source)
    first = next((line for _, line in lines if not line.startswith("COMMENT")), "")
    is_xml = first.startswith("<")
    is_aem = first.startswith("CCSDS_AEM_VERS") or (
        is_xml and any("<aem" in line for _, line in lines)
    )
    is_stk = first.lower().startswith("stk.v.")
    if (is_aem or is_stk) and rotation is not None:
        raise InputError(
            source, "the file names its frames", "no key rotation in the maneuver"
        )
    if is_aem:
        return read_aem(source, lines, start)
    if is_stk:
        return read_stk(source, lines, start)
    if first.startswith("# %ECSV"):
        return profile_samples.from_table(read_table(source), source, start, rotation)
    if is_xml:
        raise InputError(source, "XML", "CSV, ECSV, CCSDS AEM, or STK (.a)")
    return profile_samples.read_csv(source, lines, start, rotation)


def to_body(samples: Samples, scene: Scene, mount: Mount) -> Samples:
    """The samples as lab_from_body. Raises InputError for attitudes that the scene's light does not allow.

    Under the stars the lab's axes are those of the ICRS.
    """
    if samples.a in ("body", "cam"):
        samples = samples.inverted()
    sky = scene.stars
    allowed = ("icrs_from_body", "icrs_from_cam") if sky else ("lab_from_body",)
    if samples.direction not in allowed:
        raise InputError(
            samples.source,
            f"attitudes {samples.direction} with light of kind {scene.light.kind}",
            f"{', '.join(allowed)}, or the inverse",
        )
    # lab_from_cam cam_from_body.
    lab_from_body = (
        samples.a_from_b * mount.cam_from_body if samples.b == "cam" else samples.a_from_b
    )
    return replace(samples, a="lab", b="body", a_from_b=lab_from_body)
