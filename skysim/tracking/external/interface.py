"""A star tracker of your own: what it is told, what it answers, and how it is found (entry points `skysim.trackers`).

An entry point names a callable that makes a `Tracker` from a `Setup`. It runs in a process of its own, so that what
it does there, be it to hang or to crash, is an answer and no end of a run; docs/howto/external_tracker.md has examples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib import metadata
from importlib.util import find_spec
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError, printable

GROUP = "skysim.trackers"
OWN = "own"  # the name of skysim's own estimator
SOLVED = "solved"
FAILED = "failed: "  # what the status of a tracker begins with that raised, hung, died or answered nonsense
PROTOCOL = 1  # its version, first in the set-up
UNIT_TOLERANCE = 1e-3  # of a quaternion's norm: single precision is let pass, and made a unit again
LARGEST_RAD2 = (2 * np.pi) ** 2  # an axis of a covariance: nothing at all is known
EXTRAS = {
    "skysim.tracking.external.tetra3rs:Tetra3rs": ("tetra3rs", "oracle")
}  # module and extra of the trackers in our own package
LEAST_RAD2 = 1e-24  # 0.2 micro-arcseconds
MOST_CENTROIDS = 100_000
MOST_TEXT = 300  # characters of a status

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Stars:
    """The catalogue that the scene's tracker is given, brightest first.

    id : (N,) Hipparcos numbers; direction : (N, 3) unit vectors in the reference, as seen at the scene's date
    (proper motion, parallax, aberration); magnitude : (N,) V
    """

    id: NDArray[np.int64]
    direction: Floats
    magnitude: Floats


@dataclass(frozen=True, slots=True)
class Leds:
    """The dome as it was surveyed. The vehicle turns about the lab's origin, and the camera is not there.

    id : (N,); position_m : (N, 3) in the lab
    camera_body_m : (3,) entrance pupil in body axes; cam_from_body_xyzw : (4,) body axes to camera axes
    """

    id: NDArray[np.int64]
    position_m: Floats
    camera_body_m: Floats
    cam_from_body_xyzw: Floats


@dataclass(frozen=True, slots=True)
class Setup:
    """What a tracker is told before the first frame: the hardware as it is believed to be.

    reference  : "icrs" under the stars, "lab" under a dome or on a bench: what attitudes refer to
    time_utc   : ISO 8601, when t_s is 0
    width_px, height_px, focal_px, centre_px : a pinhole in camera axes, +x right, +y down, +z boresight;
        the middle of the first pixel is (0, 0)
    distortion : k1, k2, p1, p2, k3 of Brown and Conrady, as OpenCV has them
    stars, leds: the map; one of them is None
    seed       : for a tracker that draws random numbers
    options    : the scene's `tracker.options`
    """

    reference: Literal["icrs", "lab"]
    time_utc: str
    width_px: int
    height_px: int
    focal_px: float
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    gain_e_dn: float
    saturation_dn: float
    seed: int
    stars: Stars | None = None
    leds: Leds | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    def as_tree(self) -> dict[str, Any]:
        """What JSON can say; arrays are lists."""
        told: dict[str, Any] = plain(asdict(self))
        return {"skysim_tracker": PROTOCOL, **told}

    @classmethod
    def of_tree(cls, tree: Mapping[str, Any]) -> Self:
        """What `as_tree` told."""
        told = {name: value for name, value in tree.items() if name != "skysim_tracker"}
        for name, part in (("stars", Stars), ("leds", Leds)):
            if told[name] is not None:
                told[name] = part(**{key: np.array(value) for key, value in told[name].items()})
        told["centre_px"], told["distortion"] = tuple(told["centre_px"]), tuple(told["distortion"])
        return cls(**told)


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame as a tracker gets it.

    image_dn   : (height_px, width_px), uint16; float64 of a camera without noise
    frame      : its number; t_s : mid-exposure since the scene's start; exposure_s
    streak_px  : (dx, dy) that lights move in the exposure, where a gyro tells; else None
    """

    image_dn: NDArray[Any]
    frame: int
    t_s: float
    exposure_s: float
    streak_px: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """What a tracker makes of a frame.

    status             : "solved", or why there is no attitude
    cam_from_ref_xyzw  : (4,) unit quaternion, scalar last: v_cam = q v_ref q*, reference to camera; where solved
    covariance_rad2    : (3, 3) of the small rotation in camera axes, if it is known; an attitude filter needs it
    centroids_px       : (N, 2) x and y of the lights that were found, if it tells
    seconds            : what it took, if not from the frame's sending to its answer
    """

    status: str
    cam_from_ref_xyzw: Any = None
    covariance_rad2: Any = None
    centroids_px: Any = None
    seconds: float | None = None

    def as_tree(self) -> dict[str, Any]:
        """What JSON can say; what is None is left out."""
        told = {part.name: getattr(self, part.name) for part in fields(self)}
        return {name: plain(value) for name, value in told.items() if value is not None}

    @classmethod
    def of_tree(cls, tree: Any) -> Self:
        """Raises ValueError for keys that an answer has not."""
        if not isinstance(tree, dict) or "status" not in tree:
            raise ValueError("an answer is an object with a status")
        known = [part.name for part in fields(cls)]
        strange = [name for name in tree if name not in known]
        if strange:
            raise ValueError(f"{strange[0]!r} is none of {', '.join(known)}")
        return cls(**tree)


class Tracker(Protocol):
    """What an entry point's callable makes of a `Setup`. It may raise there what it cannot work with."""

    def solve(self, picture: Picture) -> Answer:
        """The attitude at mid-exposure, or why there is none."""
        ...


def plain(value: Any) -> Any:
    """Arrays as lists, mappings and sequences all through."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: plain(inner) for name, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def checked(answer: Any) -> Answer:
    """An answer that can be scored: arrays of the right shape, a unit quaternion. Raises ValueError for any other."""
    if not isinstance(answer, Answer):
        raise ValueError(f"a {type(answer).__name__} is no Answer")
    status = printable(answer.status)[:MOST_TEXT] if isinstance(answer.status, str) else ""
    if not status:
        raise ValueError(f"status {answer.status!r} is no text")
    quaternion = None
    if answer.cam_from_ref_xyzw is not None:
        quaternion = unit(numbers(answer.cam_from_ref_xyzw, "cam_from_ref_xyzw", (4,)))
    if (status == SOLVED) != (quaternion is not None):
        raise ValueError(f"status {status!r} {'without' if quaternion is None else 'with'} cam_from_ref_xyzw")
    covariance = answer.covariance_rad2
    if covariance is not None:
        covariance = spread(numbers(covariance, "covariance_rad2", (3, 3)))
    seconds = None if answer.seconds is None else float(numbers(answer.seconds, "seconds", ()))
    if seconds is not None and seconds < 0:
        raise ValueError(f"seconds {seconds:g} is below 0")
    return Answer(status, quaternion, covariance, places(answer.centroids_px), seconds)


def numbers(value: Any, name: str, shape: tuple[int, ...]) -> Floats:
    """Finite numbers of a shape. Raises ValueError."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} has other things than numbers") from None
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; allowed: {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has a number that is not finite")
    return array


def unit(quaternion: Floats) -> Floats:
    """Made exactly a unit where it nearly is. Raises ValueError."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > UNIT_TOLERANCE:
        raise ValueError(f"cam_from_ref_xyzw has norm {norm:.6g}; allowed: 1")
    return quaternion / norm


def spread(covariance: Floats) -> Floats:
    """Symmetric and positive definite, in reason. Raises ValueError."""
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0):
        raise ValueError("covariance_rad2 is not symmetric")
    axes = np.linalg.eigvalsh(covariance)
    if axes[0] < LEAST_RAD2 or axes[-1] > LARGEST_RAD2:
        raise ValueError(
            f"covariance_rad2 has eigenvalues {axes[0]:.3g} to {axes[-1]:.3g};"
            f" allowed: {LEAST_RAD2:g} to {LARGEST_RAD2:.3g}"
        )
    return (covariance + covariance.T) / 2


def places(centroids: Any) -> Floats:
    """(N, 2) of finite numbers; none where none are told. Raises ValueError."""
    count = 0 if centroids is None else np.shape(centroids)[0] if np.ndim(centroids) else -1
    if count > MOST_CENTROIDS:
        raise ValueError(f"centroids_px has {count} rows; allowed: up to {MOST_CENTROIDS}")
    return numbers(centroids, "centroids_px", (count, 2)) if count else np.empty((0, 2))


def entry_points() -> dict[str, metadata.EntryPoint]:
    """The trackers that installed packages offer, by name; none is loaded. The name `own` is kept for skysim's."""
    return {point.name: point for point in metadata.entry_points(group=GROUP) if point.name != OWN}


def release(name: str) -> str:
    """The package that offers a tracker, with its version; empty for skysim's own and for programs."""
    point = entry_points().get(name) if name != OWN else None
    return f"{point.dist.name} {point.dist.version}" if point and point.dist else ""


def needs(point: metadata.EntryPoint) -> str:
    """What has to be installed for a tracker of skysim's own package, else nothing. Nothing is imported."""
    package = EXTRAS.get(point.value)
    return f"skysim[{package[1]}]" if package and find_spec(package[0]) is None else ""


def known(name: str, commands: Mapping[str, str]) -> None:
    """Refuse a tracker that is not there. Raises InputError."""
    allowed = [OWN, *entry_points(), *commands]
    if name not in allowed:
        raise InputError(
            f"tracker.name: {name!r} is none of {', '.join(allowed)}; a program takes --program {name}=COMMAND"
        )
