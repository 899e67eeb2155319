"""Reference frames of attitude files by the names that CCSDS and STK give them."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError, Where
from skysim.core.io.text import excerpt
from skysim.core.time import J2000_JD

# as skysim writes them
ICRF = "ICRF"
LAB = "LAB"
CAMERA = "STARTRACKER_1"
BODY = "SC_BODY_1"
EME2000 = ("EME2000", "J2000")
REFERENCES = {
    ICRF: "icrs",
    "GCRF": "icrs",
    LAB: "lab",
    **dict.fromkeys(EME2000, "icrs"),
}  # frame of Samples, by name
VEHICLES = {BODY: "body", "SC_BODY": "body", CAMERA: "cam", "STARTRACKER": "cam"}


def frame_of(where: Where, name: str) -> str:
    """The frame (icrs, lab, body or cam) that a file's name stands for. Raises InputError."""
    frames = REFERENCES | VEHICLES
    if name.upper() not in frames:
        raise InputError(where.file, f"unknown frame {excerpt(name)}", ", ".join(frames), where)
    return frames[name.upper()]


def icrs_from(name: str) -> Rotation:
    """Rotation to the ICRS's axes from those of an inertial frame: the frame bias of 23 mas from EME2000, else none.

    The bias is that of IAU 2006 (ERFA's bp06).
    """
    import erfa

    if name.upper() not in EME2000:
        return Rotation.identity()
    mean_from_icrs, _, _ = erfa.bp06(J2000_JD, 0.0)
    return Rotation.from_matrix(mean_from_icrs).inv()
