"""Write attitudes as a CCSDS Attitude Ephemeris Message, version 2.0, in keyword = value notation (CCSDS 504.0-B-2)."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
import numpy as np
from scipy.spatial.transform import Rotation
from skysim.core.errors import InputError
from skysim.core.time import in_utc
from skysim.core.types import Floats
from skysim.dynamics.profile_samples import (BODY, CAMERA, ICRF, LAB)



MOST_CHARACTERS = 254  # limit of a line, section 6.3 of the standard
ORIGINATOR = (
    "SKYSIM"  # not in the SANA registry; the standard leaves that to those who exchange the files
)
MEANING = {
    ICRF: "axes of the ICRS",
    LAB: "the laboratory: origin in the bearing's center, z up; known to this file's users only",
    CAMERA: "the camera: +x right and +y down in the image, +z along the boresight",
    BODY: "the vehicle's body as its MJCF has it",
}


def message(
    name: str,
    notes: Sequence[str],
    frames: tuple[str, str],
    utc: Sequence[datetime.datetime],
    a_from_b: Rotation,
) -> str:
    """The text of an AEM file with one segment of type QUATERNION.

    name     : object name
    notes    : comments
    frames   : (A, B), keys of MEANING
    utc      : K epochs, ascending
    a_from_b : K rotations

    The standard's quaternion "from A to B" rotates the basis vectors of A into those of B (annex F2). That is the
    quaternion of a_from_b, whose matrix has the axes of B in coordinates of A as columns; coordinates transform by
    X_B = a_from_b^-1 X_A. Scalar last. Raises InputError if there is no epoch or the epochs do not ascend.
    """
    if not utc:
        raise InputError(name, "no attitude to write")
    late = [n for n in range(1, len(utc)) if utc[n] <= utc[n - 1]]
    if late:
        raise InputError(
            name, f"epoch {epoch(utc[late[0]])} is not after {epoch(utc[late[0] - 1])}"
        )
    head = {
        "CCSDS_AEM_VERS": "2.0",
        "CREATION_DATE": epoch(datetime.datetime.now(datetime.UTC)),
        "ORIGINATOR": ORIGINATOR,
    }
    meta = {
        "OBJECT_NAME": name.upper(),
        "OBJECT_ID": "UNKNOWN",
        "REF_FRAME_A": frames[0],
        "REF_FRAME_B": frames[1],
        "TIME_SYSTEM": "UTC",
        "START_TIME": epoch(utc[0]),
        "STOP_TIME": epoch(utc[-1]),
        "ATTITUDE_TYPE": "QUATERNION",
    }
    comments = [*notes, *(f"{frame} = {MEANING[frame]}" for frame in frames)]
    rows = zip(utc, continuous_quaternions(a_from_b.as_quat()), strict=True)
    lines = [
        *(f"{key} = {value}" for key, value in head.items()),
        "META_START",
        *(f"COMMENT {text}" for text in comments),
        *(f"{key} = {value}" for key, value in meta.items()),
        "META_STOP",
        "DATA_START",
        *(
            f"{epoch(when)} " + " ".join(f"{component:.15f}" for component in xyzw)
            for when, xyzw in rows
        ),
        "DATA_STOP",
    ]
    return "".join(f"{ascii_line(line)}\n" for line in lines)


def continuous_quaternions(xyzw: Floats) -> Floats:
    """(K, 4) the same attitudes as a continuous sequence of quaternions; the first has a scalar part >= 0.

    q and -q are the same attitude. Each quaternion takes the sign that makes its dot product with the previous one
    positive, so that other tools can interpolate between them.
    """
    dot = np.sum(xyzw[1:] * xyzw[:-1], axis=1)
    first = -1.0 if xyzw[0, 3] < 0 else 1.0
    sign = first * np.concatenate([[1.0], np.cumprod(np.where(dot < 0, -1.0, 1.0))])
    return np.asarray(xyzw * sign[:, None] + 0.0)  # + 0.0 turns -0.0 into 0.0


def epoch(utc: datetime.datetime) -> str:
    """Time string of section 6.8.9 of the standard, in UTC: 2012-06-22T21:00:00.120000."""
    return in_utc(utc).isoformat(timespec="microseconds")


def ascii_line(line: str) -> str:
    """The line cut to the allowed length, with characters outside printable ASCII replaced by "?"."""
    printable = "".join(character if " " <= character <= "~" else "?" for character in line)
    return printable[:MOST_CHARACTERS]


