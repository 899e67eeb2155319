"""Messages from a worker to its page: plain numbers, arrays, strings and bytes, so that they can be pickled.

NiceGUI writes arrays as JSON, with null for NaN."""

from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from skysim.core.types import Floats, Ints, Record, frozen
from skysim.results import plots
from skysim.results.scoring import FrameRow
from skysim.scene.scene import Scene

Triple = tuple[float, float, float]
LightName = Callable[[int], str]  # the name of a light by its number
NAN = float("nan")
# Limits of the display; the last ones are set in the browser.
LIMITS = ("automatic", "zscale", "min to max", "manual")


# Pictures of a real frame and the rendered one.
REAL_VIEWS = ("real", "simulated", "difference", "overlay")


class Display(NamedTuple):
    """How the browser draws frames.

    Attributes
    ----------
    screen_px
        Width and height of the screen area that a whole frame fills; (0, 0) if all pixels are
        needed
    limits
        Black and white level: one of LIMITS, or values in DN
    curve
        Curve between them, a key of `plots.CURVES`
    near_px
        Column and row of the upper left pixel in the loupe, if it shows any
    """

    screen_px: tuple[int, int] = (0, 0)
    limits: str | tuple[float, float] = LIMITS[0]
    curve: str = next(iter(plots.CURVES))
    near_px: tuple[int, int] | None = None


ALL_PIXELS = Display()


class Pixels(NamedTuple):
    """A frame's pixels for the browser, see `worker.pixels.pixels_for`.

    Attributes
    ----------
    data
        The encoded pixels
    fields
        Further data for the browser: limits, histogram, the loupe's pixels
    display
        Display for which the pixels are made
    number
        Number of the image in its worker
    """

    data: bytes
    fields: Record
    display: Display
    number: int


NO_PIXELS = Pixels(b"", {}, ALL_PIXELS, 0)


# The true lights of a frame, as rows of an array, since objects for hundreds of stars take longer to send than the
# pixels: HIP or LED number, pixel (x, y), electrons, V magnitude (NaN of an LED), expected electrons in its brightest
# pixel, and whether that is expected to be saturated.
Lights = Any  # numpy's types do not know that parts of a recarray are recarrays
LIGHT = np.dtype(
    [
        ("id", np.int64),
        ("xy_px", float, 2),
        ("electrons", float),
        ("magnitude", float),
        ("peak_e", float),
        ("saturated", bool),
    ]
)
NO_LIGHTS: Lights = np.recarray(0, LIGHT)


@frozen
class Detection:
    """A detection: pixel, standard error, flux; id of the matched light (-1: none).

    Attributes
    ----------
    residual_px
        Along x and y, detected minus predicted by the tracker's attitude; NaN without a matched light
    """

    x: float
    y: float
    sigma_px: float
    flux: float
    id: int = -1
    residual_px: tuple[float, float] = (NAN, NAN)


def places_px(detections: Collection[Detection]) -> Floats:
    """(N, 2) pixels of detections."""
    return np.array([(one.x, one.y) for one in detections], float).reshape(-1, 2)


@frozen
class TrackerResult:
    """The tracker's solution of a frame.

    Attributes
    ----------
    row
        The frame in numbers, as in `solutions.ecsv`; of an image without truth, without errors
    windows_px
        Pixels (x, y) at which the tracker's map predicts lights
    """

    row: FrameRow
    detections: tuple[Detection, ...]
    windows_px: tuple[tuple[float, float], ...] = ()


@frozen
class Lens:
    """Directions of a camera's pixels in camera axes, between which the browser interpolates.

    They are the tangents x / z and y / z at n x n points, row by row from the frame's upper left to its lower right
    corner.
    """

    n: int
    x: Floats
    y: Floats


@frozen
class Pose:
    """Attitude of a frame's camera: reference_from_cam by rows; the reference is ICRS or the lab.

    Attributes
    ----------
    place_m, depth_m
        Under a dome, the camera's place in the lab frame, and for each point of the lens's tables
        the depth along the boresight at which its ray meets the surface (NaN if it does not)
    """

    rotation: Floats
    place_m: Floats | None = None
    depth_m: Floats | None = None


class FrameView(NamedTuple):
    """One rendered frame: image, true attitude, true lights, and the tracker's solution if the frame was solved.

    Attributes
    ----------
    pose
        Attitude of its camera, for the scene's lens
    saturation_dn
        Value from which a pixel is saturated
    body_wxyz
        lab_from_body
    """

    pose: Pose
    saturation_dn: float
    angles_deg: Triple
    body_wxyz: Floats
    exposure_s: float
    statistics: plots.FrameStatistics
    lights: Lights
    result: TrackerResult | None
    ms: float
    pixels: Pixels = NO_PIXELS


class PushedView(NamedTuple):
    """A frame of the pushed vehicle, with the torque on it and its rate at the end of the exposure."""

    view: FrameView
    torque_nm: float
    rate_deg_s: float


class SceneInfo(NamedTuple):
    """Facts about a loaded scene that the page displays.

    Attributes
    ----------
    names
        Names of the three angles
    prefix
        Prefix of the lights' numbers (HIP or LED)
    field_deg
        Horizontal field of view
    pixel_arcsec
        Angle of a pixel in the frame's middle
    stages
        The tracker's algorithm by stage
    duration_s
        Duration of the motion
    noise
        Whether the camera has noise; without it a frame is the expected value
    geometry
        See `worker.geometry.lab_geometry`
    heads, head
        Names of the cameras, and that of the shown one
    code_frames
        Number of frames in which LEDs are named by their codes at the latest; 0 if they blink none
    surveyed
        Whether a survey of the dome has begun
    """

    scene: Scene
    names: tuple[str, str, str]
    prefix: str
    field_deg: float
    pixel_arcsec: float
    stages: dict[str, str]
    duration_s: float
    noise: bool
    geometry: Record
    lens: Lens
    heads: tuple[str, ...]
    head: str
    code_frames: int
    surveyed: bool = False


Curves = dict[
    str, Floats
]  # curves of a simulated motion and their times `t_s`, decimated for display


# What was at its limit in a flight, from a time to another.
AtLimit = tuple[str, float, float]


class FlightRow(NamedTuple):
    """One frame of a flight in numbers; NaN if the scene has no filter.

    Attributes
    ----------
    row
        As in `solutions.ecsv`
    lights
        Number of lights in the field
    saturated
        Number of saturated pixels
    filter_arcsec
        Error of the filter
    innovation_arcsec
        Angle between the star tracker's attitude and the filter's
    """

    row: FrameRow
    lights: int
    saturated: int
    filter_arcsec: float
    innovation_arcsec: float


class Residual(NamedTuple):
    """Residual of an identified light in a frame: time, number of the light, absolute value in pixels.

    Attributes
    ----------
    lab_px
        The residual along the axes of the lab frame, in which a wrong place of a light is constant
    """

    t_s: float
    id: int
    px: float
    lab_px: Triple


class FlightStep(NamedTuple):
    """Progress of a flight that is being computed.

    Attributes
    ----------
    t_s, duration_s
        Time that has been computed, and duration of the flight
    rows
        Rows of the frames since the last step
    log
        Curves of the motion so far, if there are new frames
    residuals
        Residuals of the lights identified in these frames
    limits
        What was at its limit so far
    """

    is_done: bool
    t_s: float
    duration_s: float
    rows: Sequence[FlightRow] = ()
    log: Curves | None = None
    residuals: Sequence[Residual] = ()
    limits: Sequence[AtLimit] = ()


class AmbiguityMap(NamedTuple):
    """For the field about each LED, the most similar other field.

    Attributes
    ----------
    ids, others
        (N,) LEDs at the centers of the fields
    fraction
        (N,) fraction of the LEDs that coincide, at least `least`
    coincidence_mm
        Two LEDs coincide if they are nearer than this
    """

    ids: Ints
    others: Ints
    fraction: Floats
    least: float
    coincidence_mm: float


# Number of frames; number of LEDs measured and their rms error, mm, predicted after these (None if not determined).
PlanStep = tuple[int, int, float | None]


class SurveyPlan(NamedTuple):
    """Attitudes to hold for a survey of the dome.

    Attributes
    ----------
    angles_deg
        Roll, pitch and yaw of each attitude
    shown
        Number of LEDs that each shows
    leds
        Number of LEDs on the dome
    steps
        Predicted accuracies
    """

    angles_deg: Sequence[Sequence[float]]
    shown: Sequence[int]
    leds: int
    steps: tuple[PlanStep, ...]


class SurveyFound(NamedTuple):
    """Results of the frames of a survey, and the attitudes to hold next.

    Attributes
    ----------
    statistics
        `frames` so far, `connected` ones, which share enough LEDs with others, and `missed`
        attitudes of the last flight without a frame at which the vehicle rested; by the connected
        frames, LEDs `measured`, `seen_once` and `unseen`; those `renamed` that have another one's
        number; estimated rms error `sigma_mm` along each axis, and true ones before the survey and
        now, `led_mm_before` and `led_mm_after`. If the frames do not determine the LEDs, the
        reason is in `refusal`, and there are no errors
    faults
        Faults of the dome, a line each
    ids, known
        (N,) LEDs, and the reduction of each one's uncertainty by the survey, 0 to 1; `known` is
        empty after a refusal
    """

    statistics: Record
    faults: list[str]
    ids: Ints
    known: Floats
    plan: SurveyPlan
