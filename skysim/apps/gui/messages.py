"""What goes from a worker to its page: plain numbers, names and bytes."""

from __future__ import annotations

from dataclasses import dataclass, field

from skysim.results import stretch

Triple = tuple[float, float, float]
NAN = float("nan")


@dataclass(frozen=True, slots=True)
class Light:
    """A true light on the frame: HIP or LED number, pixel, electrons, V magnitude (NaN of an LED)."""

    id: int
    x: float
    y: float
    electrons: float
    magnitude: float


@dataclass(frozen=True, slots=True)
class Spot:
    """What the tracker saw: pixel, error, flux; the light that it took it for (-1: none), residual in pixels."""

    x: float
    y: float
    sigma_px: float
    flux: float
    id: int = -1
    residual_px: float = NAN


@dataclass(frozen=True, slots=True)
class Answer:
    """The tracker's answer to a frame, and its error where the truth is known.

    status : "solved", or why not;  angles_deg : as the page's scene names them
    sigma_arcsec : what it claims of cross and roll;  windows_px : (x, y) where its map would have lights
    """

    status: str
    spots: tuple[Spot, ...]
    ms: float
    angles_deg: Triple | None = None
    cross_arcsec: float = NAN
    roll_arcsec: float = NAN
    sigma_arcsec: tuple[float, float] = (NAN, NAN)
    wrong: bool = False
    windows_px: tuple[tuple[float, float], ...] = ()

    @property
    def solved(self) -> bool:
        return self.angles_deg is not None

    @property
    def identified(self) -> int:
        return sum(spot.id >= 0 for spot in self.spots)


@dataclass(frozen=True, slots=True)
class View:
    """One look: the picture, where the camera was, what shone there, and the tracker's answer if it was asked.

    body_wxyz : lab_from_body;  t_s : in the flight that is played, else 0
    filter_arcsec, innovation_arcsec : by how much the filter was off, and the star tracker off the filter, in flight
    """

    jpeg: bytes
    size_px: tuple[int, int]
    angles_deg: Triple
    body_wxyz: tuple[float, ...]
    exposure_s: float
    facts: stretch.Facts
    lights: tuple[Light, ...]
    answer: Answer | None
    ms: float
    t_s: float = 0.0
    filter_arcsec: float = NAN
    innovation_arcsec: float = NAN


@dataclass(frozen=True, slots=True)
class Zoom:
    """The pixels around one: their numbers, row by row, and which pixel is the first."""

    x: int
    y: int
    dn: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True)
class Setting:
    """A scene that is set up: what the page has to know of it.

    names : of its three angles;  prefix : of its lights
    field_deg : across;  stages : the tracker's algorithm by stage, and all that there are
    tree : the keys of the scene as its file and the files beneath it have them
    """

    scene: str
    title: str
    under_stars: bool
    names: tuple[str, str, str]
    prefix: str
    field_deg: float
    stages: dict[str, str]
    choices: dict[str, tuple[str, ...]]
    flies: bool
    duration_s: float
    stage: Stage


@dataclass(frozen=True, slots=True)
class Stage:
    """The laboratory in three dimensions, in lab metres.

    shapes  : the vehicle's, in body axes (kind, size, place, wxyz, rgb)
    ids, lights_m, size : the lights and how large each is drawn, 0 to 1; stars stand on a sphere
    camera_m : its pupil in body axes;  corners_m : where the four corners of its field meet the surface, in body axes
    shell_m : lines on the dome, each a list of points
    """

    shapes: tuple[tuple[str, Triple, Triple, tuple[float, float, float, float], Triple], ...]
    ids: tuple[int, ...]
    lights_m: tuple[Triple, ...]
    size: tuple[float, ...]
    camera_m: Triple
    corners_m: tuple[Triple, ...]
    shell_m: tuple[tuple[Triple, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class FlightLog:
    """A flight that can be played: curves against time, thinned for the screen."""

    t_s: tuple[float, ...]
    curves: dict[str, tuple[float, ...]] = field(default_factory=dict)
    frame_s: tuple[float, ...] = ()
