"""The interface for external star trackers: set-up, frame, answer, and the programs that exchange them.

An entry point of the group `skysim.trackers` names a callable that makes a `Tracker` from a `Setup`. It runs in its own
process, so a hang or a crash becomes a failed answer and does not end the run. A program from the user's command line
answers each frame with a line of JSON; no file can name a command. docs/howto/external_tracker.md has examples.
"""

import json
import math
import re
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, field, fields, replace
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Protocol, Self

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError, printable, reason, refusing
from skysim.core.plugins import (
    FOLDER,
    MAX_STATUS_CHARS,
    PluginKind,
    Program,
    ProgramError,
    finite_array,
    to_lists,
)
from skysim.core.types import Array, Floats, Ints, Record, frozen
from skysim.dynamics.controllers import CONTROLLERS
from skysim.scene.sections.tracker import OWN

TRACKERS = PluginKind("tracker", "skysim.trackers", "tracker.name", (OWN,))
SOLVED = "solved"
NO_ATTITUDE = "no attitude"  # status if a tracker in Python returned None
FAILED = "failed: "  # start of the status after an exception, hang, crash or invalid answer
PROTOCOL = 1  # version of the protocol, the first key of the set-up
# Deviation of a quaternion's norm from 1: single precision passes and is normalized
UNIT_TOLERANCE = 1e-3
MIN_RAD2 = 1e-24  # smallest eigenvalue of a covariance: (0.2 micro-arcseconds)^2
MAX_RAD2 = (2 * np.pi) ** 2  # largest eigenvalue of a covariance: no information
MAX_CENTROIDS = 100_000
MAX_CENTROID_PX = 1e6  # distance from the first pixel along x and y
# Module and extra of the trackers in skysim, by their entry point.
EXTRAS = {"skysim.tracking.tetra3rs:Tetra3rs": ("tetra3rs", "oracle")}


@frozen
class Stars:
    """The star catalog given to the tracker, brightest first.

    Attributes
    ----------
    id
        (N,) Hipparcos numbers
    direction
        (N, 3) apparent unit vectors in the reference frame at the scene's date (proper motion, parallax, aberration)
    magnitude
        (N,) magnitudes in V
    """

    id: Ints
    direction: Floats
    magnitude: Floats


@frozen
class Leds:
    """The surveyed dome. The vehicle rotates about the lab's origin; the camera is offset from it.

    Attributes
    ----------
    id
        (N,) numbers of the LEDs
    position_m
        (N, 3) positions in the lab
    camera_body_m
        (3,) position of the entrance pupil in body axes
    cam_from_body_xyzw
        (4,) rotation from body axes to camera axes, scalar last
    """

    id: Ints
    position_m: Floats
    camera_body_m: Floats
    cam_from_body_xyzw: Floats


@frozen
class Setup:
    """The data that a tracker gets before the first frame: the hardware that the scene's tracker assumes.

    Attributes
    ----------
    reference
        Frame of the attitudes: "icrs" under the stars, "lab" under a dome or on a bench
    time_utc
        Date of t_s = 0, ISO 8601
    width_px, height_px, focal_px, center_px
        Pinhole in camera axes, +x right, +y down, +z boresight; the center of the first pixel is (0, 0)
    distortion
        Coefficients k1, k2, p1, p2, k3 of Brown and Conrady, in OpenCV's order
    gain_e_dn, saturation_dn
        Gain of the detector, and the value at which it saturates
    seed
        The scene's seed, for a tracker that draws random numbers
    stars, leds
        Catalog or dome; the other one is None
    options
        The scene's `tracker.options`
    """

    reference: Literal["icrs", "lab"]
    time_utc: str
    width_px: int
    height_px: int
    focal_px: float
    center_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    gain_e_dn: float
    saturation_dn: float
    seed: int
    stars: Stars | None = None
    leds: Leds | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    def as_tree(self) -> Record:
        """The set-up as a JSON object; arrays become lists."""
        return {"skysim_tracker": PROTOCOL, **to_lists(asdict(self))}

    @classmethod
    def of_tree(cls, tree: Mapping[str, Any]) -> Self:
        """The inverse of `as_tree`."""
        values = {name: value for name, value in tree.items() if name != "skysim_tracker"}
        for name, map_type in (("stars", Stars), ("leds", Leds)):
            if values[name] is not None:
                values[name] = map_type(
                    **{key: np.array(value) for key, value in values[name].items()}
                )
        for name in ("center_px", "distortion"):
            values[name] = tuple(values[name])
        return cls(**values)


@frozen
class Picture:
    """One frame that a tracker gets.

    Attributes
    ----------
    image_dn
        (height_px, width_px) image, uint16; float64 from a camera without noise
    frame
        Number of the frame
    t_s
        Mid-exposure, from the scene's start
    exposure_s
        Exposure time
    streak_px
        Motion (dx, dy) of the images in the exposure, if a gyro measures it; else None
    """

    image_dn: Array
    frame: int
    t_s: float
    exposure_s: float
    streak_px: tuple[float, float] | None = None


@frozen
class Answer:
    """A tracker's solution of a frame.

    Attributes
    ----------
    status
        "solved", or the reason why there is no attitude
    cam_from_ref_xyzw
        (4,) unit quaternion from reference to camera, scalar last: v_cam = q v_ref q*; None if not solved
    covariance_rad2
        (3, 3) covariance of the small rotation in camera axes; optional, but an attitude filter needs it
    centroids_px
        (N, 2) positions x and y of the lights found; optional
    seconds
        Processing time; None for the time from sending the frame to its answer
    """

    status: str
    cam_from_ref_xyzw: Any = None
    covariance_rad2: Any = None
    centroids_px: Any = None
    seconds: float | None = None

    def as_tree(self) -> Record:
        """The answer as a JSON object; entries that are None are left out."""
        values = to_lists(asdict(self))
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def of_tree(cls, tree: Any) -> Self:
        """The inverse of `as_tree`. Raises ValueError for unknown keys or a missing status."""
        if not isinstance(tree, dict) or "status" not in tree:
            raise ValueError("status: missing; allowed: a JSON object with a status")
        names = [item.name for item in fields(cls)]
        unknown = [name for name in tree if name not in names]
        if unknown:
            raise ValueError(f"unknown key {unknown[0]!r}; allowed: {', '.join(names)}")
        return cls(**tree)


class Tracker(Protocol):
    """The object that an entry point's callable returns for a `Setup`.

    The callable raises an exception for a set-up that it cannot use.
    """

    def solve(self, picture: Picture) -> Any:
        """The attitude at mid-exposure, or the reason why there is none, as `to_answer` takes it."""
        ...


def to_answer(value: Any) -> Any:
    """What a tracker in Python returned as an Answer; other values, which `check_answer` refuses, stay unchanged.

    Allowed are an Answer, the attitude cam_from_ref as a Rotation, unit quaternion (4,) scalar last or matrix (3, 3),
    and None for no attitude.
    """
    if value is None:
        return Answer(NO_ATTITUDE)
    if isinstance(value, np.ndarray | list | tuple):
        if np.shape(value) == (3, 3):
            matrix = finite_array(value, "the matrix", (3, 3))
            if np.abs(matrix @ matrix.T - np.eye(3)).max() > UNIT_TOLERANCE or (
                np.linalg.det(matrix) < 0
            ):
                raise ValueError(
                    "the matrix is no rotation; allowed: orthogonal, determinant 1"
                )
            value = Rotation.from_matrix(matrix).as_quat()
        return Answer(SOLVED, value)
    return Answer(SOLVED, value.as_quat()) if isinstance(value, Rotation) else value


def check_answer(given: Any) -> Answer:
    """The answer with a normalized quaternion. Raises ValueError for wrong shapes, quaternion, covariance or time."""
    answer = to_answer(given)
    if not isinstance(answer, Answer):
        raise ValueError(f"the tracker returned {type(answer).__name__}; allowed: Answer")
    status = (
        printable(answer.status)[:MAX_STATUS_CHARS] if isinstance(answer.status, str) else ""
    )
    if not status:
        raise ValueError(f"status {answer.status!r}; allowed: text")
    quaternion = None
    if answer.cam_from_ref_xyzw is not None:
        quaternion = finite_array(answer.cam_from_ref_xyzw, "cam_from_ref_xyzw", (4,))
        norm = math.hypot(*quaternion)
        if abs(norm - 1) > UNIT_TOLERANCE:
            raise ValueError(f"cam_from_ref_xyzw has norm {norm:.6g}; allowed: 1")
        quaternion = quaternion / norm
    if (status == SOLVED) != (quaternion is not None):
        raise ValueError(
            f"status {status!r} {'without' if quaternion is None else 'with'} cam_from_ref_xyzw"
        )
    covariance = answer.covariance_rad2
    if covariance is not None:
        covariance = check_covariance(finite_array(covariance, "covariance_rad2", (3, 3)))
    seconds = (
        None if answer.seconds is None else float(finite_array(answer.seconds, "seconds", ()))
    )
    if seconds is not None and seconds < 0:
        raise ValueError(f"seconds {seconds:g}; allowed: 0 or more")
    return Answer(
        status, quaternion, covariance, check_centroids(answer.centroids_px), seconds
    )


def check_covariance(covariance: Floats) -> Floats:
    """The covariance (3, 3), made exactly symmetric.

    Raises ValueError unless it is symmetric and positive definite within plausible limits.
    """
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0):
        raise ValueError("covariance_rad2 is not symmetric")
    eigenvalues = np.linalg.eigvalsh(covariance)
    if eigenvalues[0] < MIN_RAD2 or eigenvalues[-1] > MAX_RAD2:
        raise ValueError(
            f"covariance_rad2 has eigenvalues {eigenvalues[0]:.3g} to {eigenvalues[-1]:.3g};"
            f" allowed: {MIN_RAD2:g} to {MAX_RAD2:.3g}"
        )
    return (covariance + covariance.T) / 2


def check_centroids(centroids: Any) -> Floats:
    """(N, 2) centroids; empty for None. Raises ValueError unless they are finite and not far outside the frame."""
    if centroids is None:
        return np.empty((0, 2))
    # A number instead of an array has no rows, so that `finite_array` refuses it.
    count = np.shape(centroids)[0] if np.ndim(centroids) else -1
    if count > MAX_CENTROIDS:
        raise ValueError(f"centroids_px has {count} rows; allowed: up to {MAX_CENTROIDS}")
    xy_px = finite_array(centroids, "centroids_px", (count, 2)) if count else np.empty((0, 2))
    if (farthest := np.abs(xy_px).max(initial=0.0)) > MAX_CENTROID_PX:
        raise ValueError(
            f"centroids_px has {farthest:g}; allowed: up to {MAX_CENTROID_PX:g} px from the first pixel"
        )
    return xy_px


def missing_extra(point: metadata.EntryPoint) -> str:
    """The extra to install for one of skysim's own plug-ins if its package is missing; else "". Imports nothing."""
    plugin = EXTRAS.get(point.value)
    return f"skysim[{plugin[1]}]" if plugin and find_spec(plugin[0]) is None else ""


# Programs as external trackers.

MAX_FAILURES = 3  # consecutive failures after which a program is not restarted
NAME = re.compile(r"[a-z][a-z0-9_-]*")


def program_commands(options: Sequence[str] | None) -> dict[str, str]:
    """Commands by name from texts `NAME=COMMAND` (trackers, controllers). Raises InputError."""
    kinds = (TRACKERS, CONTROLLERS)
    programs = {}
    for option in options or ():
        name, equals, command = option.partition("=")
        if not equals or not NAME.fullmatch(name) or not command.strip():
            raise InputError(
                "programs",
                option,
                "NAME=COMMAND, NAME of lower-case letters, digits, _ and -",
            )
        taken = {known for kind in kinds for known in (*kind.own, *kind.entry_points())}
        if name in taken or name in programs:
            raise InputError(f"programs.{name}", "name already in use", "another one")
        split_command(name, command)
        programs[name] = command
    return programs


def split_command(name: str, command: str) -> tuple[list[str], str | None]:
    """The arguments of a command, and the file format of its `{folder}`; None without one. Raises InputError."""
    with refusing(ValueError, f"programs.{name}"):
        arguments = shlex.split(command)
    formats = {image_format or "png" for image_format in FOLDER.findall(command)}
    if formats - set(WRITERS) or len(formats) > 1:
        raise InputError(
            f"programs.{name}",
            "",
            f"{{folder}}, or one of {{folder:{'}, {folder:'.join(WRITERS)}}}",
        )
    return arguments, formats.pop() if formats else None


def write_png(path: Path, picture: Picture) -> None:
    """Write the frame as a 16-bit PNG."""
    from skysim.core import files

    files.write_png16(path, picture.image_dn)


def write_fits(path: Path, picture: Picture) -> None:
    """Write the frame as FITS with times in the header, but without the truth that the frames of a run contain."""
    from astropy.io import fits

    from skysim.core import files, images

    header = fits.Header(
        {"EXPTIME": picture.exposure_s, "TMID": picture.t_s, "FRAME": picture.frame}
    )
    header.append(images.TOP_DOWN_CARD)
    with files.atomic_file(path) as temporary:
        fits.PrimaryHDU(picture.image_dn, header).writeto(temporary, overwrite=True)


WRITERS: dict[str, Callable[[Path, Picture], None]] = {"png": write_png, "fits": write_fits}


class TrackerProgram(Program):
    """An external tracker program. After a failure it is restarted for the next frame, up to MAX_FAILURES in a row.

    Parameters
    ----------
    name
        Name of the tracker, for messages
    arguments, image_format
        Arguments and file format from `split_command`
    setup
        Set-up to send
    limit_s
        Time limit for each frame
    environment
        Environment of the program; None for that of this process

    Raises
    ------
    InputError
        If it cannot be started, or refuses the set-up.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        image_format: str | None,
        setup: Setup,
        limit_s: float,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.image_format = image_format
        self.failures = 0
        self.last_failure = ""
        super().__init__(TRACKERS.key, name, arguments, setup.as_tree(), limit_s, environment)

    def solve(self, picture: Picture) -> Answer:
        """The program's answer to a frame, with the seconds it took. Raises ProgramError."""
        if self.failures >= MAX_FAILURES:
            raise ProgramError(
                f"given up after {MAX_FAILURES} failures in a row, the last: {self.last_failure}"
            )
        try:
            if self.running is None:
                self.start()
            begin_s = time.perf_counter()
            reply = self.exchange(self.frame_message(picture), self.limit_s)
            spent_s = time.perf_counter() - begin_s
            answer = self.to_answer(reply, picture.frame)
        except ProgramError as error:
            if self.running is None:
                self.failures += 1
                self.last_failure = str(error)
            raise
        self.failures = 0
        own_s = spent_s if answer.seconds is None else min(answer.seconds, spent_s)
        return replace(answer, seconds=own_s)

    def to_answer(self, reply: Any, frame: int) -> Answer:
        """The checked answer of a JSON reply. Raises ProgramError; an answer to another frame ends the program."""
        if not isinstance(reply, dict) or reply.get("frame") != frame:
            raise self.fail(f"no answer to frame {frame}, but {str(reply)[:80]!r}")
        try:
            return check_answer(
                Answer.of_tree({key: reply[key] for key in reply if key != "frame"})
            )
        except ValueError as error:
            raise ProgramError(str(error)) from None

    def frame_message(self, picture: Picture) -> list[bytes]:
        """The header of a frame and, unless the frame is written to the folder, its pixels: row by row, little-endian.

        Raises
        ------
        ProgramError
            If the program has made its folder unusable.
        """
        header: Record = {
            "frame": picture.frame,
            "t_s": picture.t_s,
            "exposure_s": picture.exposure_s,
            "streak_px": picture.streak_px,
        }
        if self.image_format:
            assert self.running is not None
            assert self.running.folder is not None
            path = self.running.folder / f"frame_{picture.frame:04d}.{self.image_format}"
            try:
                for previous in self.running.folder.glob("frame_*"):
                    previous.unlink(missing_ok=True)
                WRITERS[self.image_format](path, picture)
            except OSError as error:
                raise self.fail(
                    f"the program's folder takes no frame: {reason(error)}", 0.0
                ) from None
            return [(json.dumps(header | {"file": str(path)}) + "\n").encode()]
        dtype = "<u2" if picture.image_dn.dtype == np.uint16 else "<f8"
        pixels = np.ascontiguousarray(picture.image_dn, dtype=dtype).tobytes()
        height, width = picture.image_dn.shape
        header |= {
            "width_px": width,
            "height_px": height,
            "dtype": dtype,
            "bytes": len(pixels),
        }
        return [(json.dumps(header) + "\n").encode(), pixels]
