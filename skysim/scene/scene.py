"""Schema of a scene file (YAML): the validated, frozen `Scene`, and the checks between its sections.

The sections are defined in `vehicle`, `motion`, `light`, `leds`, `camera` and `tracker`; values with units in
`core.units`.
"""

import datetime
import html
import math
import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, model_validator
from pydantic._internal._model_construction import ModelMetaclass

from skysim.core.constants import DAY_S
from skysim.core.errors import InputError
from skysim.core.random_streams import HEAD_SEED, derived_seed
from skysim.core.time import Moment
from skysim.core.units import (
    BY_KIND,
    ZEROS,
    ConfigModel,
    Delay,
    Position,
    Positive,
    PositiveInt,
    Seed,
    Spins,
    Time,
    TimeError,
    within,
)
from skysim.core.yaml_reader import Tree, excerpt, explained, fault_of
from skysim.scene.sections.camera import CameraConfig
from skysim.scene.sections.layouts import OptimizedConfig
from skysim.scene.sections.light import DomeConfig, FurtherLight, Light, StarsConfig
from skysim.scene.sections.motion import SIDEREAL, MotionConfig, PointingConfig
from skysim.scene.sections.surroundings import Coefficients, Glow, Orbit, ThermalConfig
from skysim.scene.sections.tracker import OWN, FilterConfig, SurveyErrorsConfig, TrackerConfig
from skysim.scene.sections.vehicle import SiteConfig, VehicleConfig

NAME_ALIAS = "(the file's name)"  # alias of Scene.name, not a valid key in a file

EPHEMERIS_KEYS = "bodies", "satellites"  # keys of a light that need the ephemeris
BODIES_YEARS = 1972, 2100  # UTC has leap seconds from 1972; the ephemeris ends with 2100
# Of a run, limited by memory.
MAX_FRAMES = 1_000_000
MAX_DURATION_S = DAY_S


class ExposureConfig(ConfigModel):
    """Exposure time, frame rate, number of frames, time of the first frame, and the camera's timing errors.

    Attributes
    ----------
    trigger_jitter
        Greatest delay of the beginning of an exposure, uniformly distributed
    time_tag_offset
        Mean of a frame's time tag minus the true time of mid-exposure
    time_tag_jitter
        Standard deviation of that difference from frame to frame, or a tolerance
    """

    time_s: Annotated[Time, Field(ge=1e-6)]
    rate_hz: Positive
    frames: PositiveInt
    first_s: Delay = 0.0
    trigger_jitter_s: Delay = 0.0
    time_tag_offset_s: Annotated[Time, within(-1, 1)] = 0.0
    time_tag_jitter_s: Annotated[TimeError, Field(le=1)] = 0.0

    def check(self) -> None:
        """Check that an exposure ends before the next begins, and that the run is not too long."""
        if self.time_s + self.trigger_jitter_s > 1 / self.rate_hz:
            jitter = (
                f" plus trigger_jitter {self.trigger_jitter_s:g} s"
                if self.trigger_jitter_s
                else ""
            )
            raise InputError(
                "time",
                f"{self.time_s} s{jitter} is longer than the frame period {1 / self.rate_hz} s",
            )
        duration_s = self.first_s + self.frames / self.rate_hz
        if self.frames > MAX_FRAMES or duration_s > MAX_DURATION_S:
            raise InputError(
                "",
                f"{self.frames} frames over {duration_s:g} s",
                f"up to {MAX_FRAMES}, over a day ({MAX_DURATION_S:g} s)",
            )


class HeadConfig(ConfigModel):
    """A further star camera on the vehicle, in addition to the main one of the sections `camera` and `tracker`.

    Attributes
    ----------
    name
        Name of its folder in the results, and in messages
    position
        Position of its entrance pupil on the body
    rotation_deg
        Rotation vector from the axes of the main camera to its own, in the axes of the main camera (+x right, +y down,
        +z boresight): [0, 90, 0] looks to the right of the main camera's image
    mount_error_arcsec
        Rotation of the real camera from the assumed mount, about its own axes, unknown to its tracker
    mount_arcsec_k
        The same for each kelvin of `thermal`
    camera, tracker, exposure
        Keys that differ from those of the main camera. The camera is another unit: its hardware_seed is the next one
        unless it is given
    """

    name: Annotated[str, Field(pattern=r"^[a-z]\w*$", max_length=40)]
    position_m: Position
    rotation_deg: Spins
    mount_error_arcsec: Coefficients = ZEROS
    mount_arcsec_k: Coefficients = ZEROS
    camera: CameraConfig | None = None
    tracker: TrackerConfig | None = None
    exposure: ExposureConfig | None = None


# Requirements of scenes and studies: shares of frames, and quantiles of errors.
SHARES = (
    r"identified|refused|wrong|ambiguous|misidentified|misled|coverage_\d+"
    r"|right_within(_(cross|roll|angle)_arcsec_\d+(\.\d+)?)+"
)
QUANTILES = r"(cross|roll|angle|filter|pointing|drift)_arcsec_(median|(p|tol)(?!0+$)\d{2,5})"


def check_requirements(require: dict[str, float]) -> dict[str, float]:
    """Check the names of requirements, and that the limit of a share is below 1. Raises InputError."""
    for name, limit in require.items():
        share = re.fullmatch(SHARES, name)
        if not share and not re.fullmatch(QUANTILES, name):
            raise InputError(
                name,
                "nothing that a number of trials shows without assumptions",
                "quantiles of errors (cross_arcsec_p95, roll_arcsec_median, pointing_arcsec_p99) and shares (wrong,"
                " refused, identified, right_within_cross_arcsec_10, coverage_4)",
            )
        if share and limit >= 1:
            raise InputError(name, f"{limit:g}", "a share between 0 and 1")
    return require


Requirements = Annotated[dict[str, Positive], AfterValidator(check_requirements)]
MAX_HEADS = 8
# Sections of a head, whose keys override those of the main camera.
HEAD_SECTIONS = ("camera", "tracker", "exposure")


def ephemeris_problem(start_time: datetime.datetime) -> str:
    """The reason why the ephemeris does not have a time; empty if it has."""
    first, last = BODIES_YEARS
    if first <= start_time.year <= last:
        return ""
    return f"start_time {start_time} is outside {first} to {last}"


class RawKeys(Tree):
    """The keys from which a scene was loaded. Equal to any other: the values of scenes are compared.

    Attributes
    ----------
    call
        The Python call that loads the scene; empty if it was not loaded
    """

    call = ""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RawKeys)

    __hash__ = None


class SceneKind(ModelMetaclass):
    """The class of `Scene`: a scene from Python's keywords is refused in one line, like one from a file."""

    def __call__(cls, /, **keys: Any) -> Any:
        with explained(keys, [], {}):
            return super().__call__(**keys)


class Scene(ConfigModel, metaclass=SceneKind):
    """A complete simulation: the laboratory, the vehicle and its motion, the light, the camera and the tracker.

    Attributes
    ----------
    require
        Requirements on the frames: greatest quantile of an error (`cross_arcsec_p95: 60`), greatest share of an event
        (`wrong: 0.001`), least share of `identified`, `coverage_N` or frames that are right with errors within limits
        (`right_within_cross_arcsec_10: 0.99`)
    """

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    title: str
    seed: Seed
    start_time: Moment
    site: SiteConfig = SiteConfig()
    orbit: Orbit | None = None
    vehicle: VehicleConfig
    motion: MotionConfig
    light: Annotated[Light, BY_KIND]
    background: tuple[Glow, ...] = ()
    lights: tuple[FurtherLight, ...] = ()
    camera: CameraConfig
    exposure: ExposureConfig
    thermal: ThermalConfig | None = None
    tracker: TrackerConfig = TrackerConfig()
    filter: FilterConfig | None = None
    heads: Annotated[tuple[HeadConfig, ...], Field(max_length=MAX_HEADS)] = ()
    require: Requirements = Field(default_factory=dict)
    name: Annotated[str, Field(exclude=True, alias=NAME_ALIAS)] = ""
    # Keys of the vehicle that the loader took from a base with another vehicle.model.
    _inherited: tuple[str, ...] = ()
    # Keys as loaded, see `loader.keys_of`.
    _source: RawKeys = RawKeys()

    def check(self) -> None:
        """Check keys that depend on the kind of light, and that the shutter reads all rows within a frame period."""
        sky = self.light.kind == "stars"
        tracker = self.tracker
        # Survey errors and maps need LEDs; without LEDs only the focal length is surveyed.
        survey = tracker.survey
        if survey.focal_length_sigma_m:
            survey = survey.with_values(focal_length_sigma_m=0.0, seed=0)
        if not self.dome and (survey != SurveyErrorsConfig() or tracker.map):
            key = "map" if tracker.map else "survey"
            raise InputError(
                f"tracker.{key}",
                f"light of kind {self.light.kind} has no LEDs to survey",
                "dome",
            )
        # The start is a pointing under the stars, else an attitude.
        if self.motion.start != "profile" and sky != isinstance(
            self.motion.start, PointingConfig
        ):
            keys = "ra_deg, dec_deg, roll_deg" if sky else "roll_deg, pitch_deg, yaw_deg"
            raise InputError(
                "motion.start", f"light of kind {self.light.kind} requires {keys}"
            )
        if not sky and self.motion.rate_deg_s == SIDEREAL:
            raise InputError(
                "motion.rate_deg_s", "sidereal requires light of kind stars", "[0, 0, 0]"
            )
        for glow in self.background:
            if not sky and glow.kind in ("faint_stars", "zodiacal"):
                raise InputError(
                    "background",
                    f"{glow.kind} requires light of kind stars, not {self.light.kind}",
                )
        read_s = getattr(self.camera.shutter, "row_time_s", 0.0) * (self.camera.height_px - 1)
        if read_s > 1 / self.exposure.rate_hz:
            raise InputError(
                "camera.shutter",
                f"readout takes {read_s:g} s, longer than the frame period {1 / self.exposure.rate_hz:g} s",
            )
        # The decoder has a code, and all rows of the shutter show the same bits.
        code = self.dome.led.code if self.dome else None
        if self.tracker.decoder and code is None:
            raise InputError("tracker.decoder", "requires light.led.code")
        if code and code.bit_time_s != "frame" and self.camera.shutter.kind == "rolling":
            raise InputError(
                "light.led.code.bit_time",
                "the rows of a rolling shutter show different bits",
                "frame, or another camera.shutter",
            )

    @model_validator(mode="after")
    def complete_layout(self) -> "Scene":
        """The scene with the field of view and the camera position of an optimized layout completed by its own."""
        dome = self.dome
        if dome is None or not isinstance(dome.points, OptimizedConfig):
            return self
        points = dome.points
        nested = dome.layout is not points
        camera_m = points.camera_m or self.vehicle.camera_m
        if camera_m is None:
            key = f"light.layout.{'points.' if nested else ''}camera"
            raise InputError(key, "missing", "that, or vehicle.camera")
        field_deg = self.camera.calibration().field_deg[:2]
        points = points.with_values(
            camera_m=camera_m, field_deg=points.field_deg or field_deg
        )
        layout = dome.layout.with_values(points=points) if nested else points
        return self.with_values("light", layout=layout)

    @model_validator(mode="after")
    def check_sky(self) -> "Scene":
        """Check bodies, orbit, satellites and air.

        1. The ephemeris is valid at the scene's time.
        2. An orbit is under the stars, and satellites have an orbit or a site.
        3. The air has a site, and its light has the ephemeris of Sun and Moon.
        """
        # 1. Ephemeris.
        problem = ephemeris_problem(self.start_time)
        sections = {
            "orbit": self.orbit,
            **{f"light.{key}": getattr(self.light, key, None) for key in EPHEMERIS_KEYS},
        }
        for key, section in sections.items():
            if section and problem:
                raise InputError(key, problem)
        # 2. Orbit.
        if self.orbit and not self.stars:
            raise InputError(
                "orbit", f"light of kind {self.light.kind} is in a laboratory", "stars"
            )
        satellites = getattr(self.light, "satellites", None)
        if (
            satellites
            and satellites.file
            and not self.orbit
            and self.site.longitude_deg is None
        ):
            raise InputError(
                "light.satellites.file", "requires the section orbit, or a site.longitude_deg"
            )
        # 3. Air.
        air = getattr(self.light, "air", None)
        if air and self.orbit:
            raise InputError(
                "light.air", "the camera is in an orbit, above the air", "light.air or orbit"
            )
        if air and self.site.longitude_deg is None:
            raise InputError("light.air", "requires site.longitude_deg")
        if air and air.glow and problem:
            raise InputError("light.air.glow", problem)
        if air and air.glow and any(glow.kind in ("sky", "moon") for glow in self.background):
            raise InputError(
                "light.air.glow",
                "conflicts with a background of kind sky or moon",
                "one of the two",
            )
        return self

    @model_validator(mode="after")
    def check_exposure_limits(self) -> "Scene":
        """Check that every exposure that the exposure control may select ends before the next one begins."""
        control = self.tracker.exposure_control
        period_s = 1 / self.exposure.rate_hz
        if control is None:
            return self
        if control.longest_s + self.exposure.trigger_jitter_s > period_s:
            raise InputError(
                "tracker.exposure_control.longest",
                f"{control.longest_s:g} s is longer than the frame period {period_s:g} s",
            )
        if not control.shortest_s <= self.exposure.time_s <= control.longest_s:
            raise InputError(
                "tracker.exposure_control",
                f"exposure.time {self.exposure.time_s:g} s, of the first frame, is outside {control.shortest_s:g} s"
                f" to {control.longest_s:g} s",
            )
        return self

    @model_validator(mode="after")
    def check_control(self) -> "Scene":
        """Check that the actuators of the controller and its source of the attitude are in the scene."""
        control = self.motion.control
        imu = self.vehicle.imu
        if self.filter and not imu:
            raise InputError("filter", "requires the section vehicle.imu")
        if self.tracker.gyro and not imu:
            raise InputError("tracker.gyro", "requires the section vehicle.imu")
        if control is None:
            return self
        commanded = getattr(self.vehicle, control.actuators, None)
        if commanded is None and control.actuators != "ideal":
            raise InputError(
                "motion.control.actuators",
                f"requires the section vehicle.{control.actuators}",
            )
        stored = control.actuators in ("wheels", "cmgs")  # these store momentum
        if control.desaturation and not (self.vehicle.fans and stored):
            raise InputError(
                "motion.control.desaturation",
                "requires vehicle.fans, and actuators wheels or cmgs",
            )
        if {"truth": False, "imu": not imu, "filter": not self.filter}[control.feedback]:
            section = "vehicle.imu" if control.feedback == "imu" else "filter"
            raise InputError(
                "motion.control.feedback",
                f"{control.feedback} requires the section {section}",
            )
        return self

    @model_validator(mode="after")
    def check_motion(self) -> "Scene":
        """Check the gimbals of a two-axis mount, and the control period.

        The mount follows profiles alone, in a laboratory. The period is a whole number of milliseconds and of IMU
        samples, and resolves every sine.
        """
        # 1. Gimbals.
        motion = self.motion
        two_axis = self.vehicle.mount == "two_axis"
        follows = (
            motion.is_prescribed
            and motion.start == "profile"
            and {leg.kind for leg in motion.maneuver} <= {"profile", "hold", "jitter"}
            and not self.stars
        )
        if two_axis != bool(self.vehicle.gimbals) or (two_axis and not follows):
            raise InputError(
                "vehicle.gimbals",
                "mount two_axis has them and follows profiles in a laboratory, without dynamics",
                "motion.control: prescribed, start: profile, maneuvers profile, hold, jitter, and no light: stars",
            )
        # 2. Period.
        rate_hz = self.control_rate_hz
        if abs(1000 / rate_hz - round(1000 / rate_hz)) > 1e-9:
            raise InputError(
                "motion.control.rate_hz",
                f"{rate_hz:g} Hz has a period that is not a whole number of milliseconds",
            )
        imu = self.vehicle.imu
        if imu and self.filter and self.filter.bias_time_s < 10 / imu.rate_hz:
            raise InputError(
                "filter.bias_time",
                f"shorter than ten samples of the IMU, {10 / imu.rate_hz:g} s",
            )
        sines_hz = [leg.frequency_hz for leg in self.motion.maneuver if leg.kind == "sine"]
        chirps_hz = [
            max(leg.from_hz, leg.to_hz) for leg in self.motion.maneuver if leg.kind == "chirp"
        ]
        fastest_hz = max((*sines_hz, *chirps_hz), default=0)
        if 2 * fastest_hz >= rate_hz:
            kind = "sine" if fastest_hz in sines_hz else "chirp"
            raise InputError(
                "motion.maneuver",
                f"a {kind} of {fastest_hz:g} Hz requires a motion.control.rate_hz above {2 * fastest_hz:g}",
            )
        if imu and abs(imu.rate_hz / rate_hz - round(imu.rate_hz / rate_hz)) > 1e-9:
            raise InputError(
                "vehicle.imu.rate_hz",
                f"{imu.rate_hz:g} Hz is not a multiple of motion.control.rate_hz {rate_hz:g} Hz",
            )
        return self

    @model_validator(mode="after")
    def check_heads(self) -> "Scene":
        """Check that heads have different names, and that each makes a valid scene with its camera and tracker."""
        names = [head.name for head in self.heads]
        for n, head in enumerate(self.heads):
            if head.name in ("main", *names[:n]):
                raise InputError(
                    f"heads.{n}.name", f"{head.name} is the name of another camera"
                )
            if any(head.mount_arcsec_k) and not self.thermal:
                raise InputError(f"heads.{n}.mount_arcsec_k", "requires the section thermal")
            own = self.of_head(n)
            values = {
                field.alias or key: getattr(own, key)
                for key, field in Scene.model_fields.items()
            }
            try:
                Scene.model_validate(values)
            except ValidationError as error:
                first = error.errors()[0]
                section = ".".join(map(str, ("heads", n, *first["loc"])))
                raise fault_of(first).under(section) from None
        return self

    @property
    def dome(self) -> DomeConfig | None:
        """The light if it is an LED dome."""
        return self.light if isinstance(self.light, DomeConfig) else None

    @property
    def stars(self) -> StarsConfig | None:
        """The light if it is the sky."""
        return self.light if isinstance(self.light, StarsConfig) else None

    @property
    def call(self) -> str:
        """The Python call that loads this scene; empty if it was not loaded."""
        return self._source.call

    @property
    def inherited(self) -> tuple[str, ...]:
        """Keys about the vehicle's body that are from a base scene with another `vehicle.model`."""
        return self._inherited

    def of_head(self, n: int) -> "Scene":
        """The scene with head n as its only camera, whose noise and timing have their own seed."""
        head = self.heads[n]
        main = self.camera
        camera = head.camera or main
        if camera.detector.hardware_seed == main.detector.hardware_seed:
            unit = main.detector.hardware_seed + n + 1
            camera = camera.with_values("detector", hardware_seed=unit)
        thermal = self.thermal and self.thermal.with_values(
            mount_arcsec_k=head.mount_arcsec_k
        )
        if thermal and not thermal.has_effect:
            thermal = None
        return self.with_values(
            seed=derived_seed(self.seed, HEAD_SEED, n),
            vehicle=self.vehicle.with_values(camera_m=head.position_m),
            camera=camera,
            tracker=head.tracker or self.tracker,
            exposure=head.exposure or self.exposure,
            thermal=thermal,
            heads=(),
        )

    @property
    def summary(self) -> list[tuple[str, str]]:
        """Name and description of each section of the scene, for tables."""
        camera = self.camera
        exposure = self.exposure
        control = self.motion.control
        tracker = self.tracker
        dome = self.dome
        stages = [
            getattr(tracker, stage)
            for stage in ("detector", "centroider", "identifier", "solver")
            if tracker.name == OWN
        ]
        focus = "infinity" if math.isinf(camera.focus_m) else f"{camera.focus_m:.4g} m"
        return [
            ("name", self.name),
            (
                "light",
                f"dome: {dome.surface.kind}, {dome.layout.kind}" if dome else self.light.kind,
            ),
            ("vehicle", f"{self.vehicle.mount}, {control.law if control else 'no'} control"),
            (
                "camera",
                f"{camera.width_px} × {camera.height_px} px of {1e6 * camera.pixel_m:g} µm,"
                f" f = {1e3 * camera.focal_length_m:g} mm, f/{camera.f_number:g}, focus {focus}",
            ),
            (
                "exposure",
                f"{exposure.frames} of {1e3 * exposure.time_s:g} ms at {exposure.rate_hz:g} Hz",
            ),
            ("tracker", ", ".join([tracker.name, *(stage for stage in stages if stage)])),
            *([("heads", ", ".join(head.name for head in self.heads))] if self.heads else []),
        ]

    def _repr_html_(self) -> str:
        """A table of the scene's sections for notebooks."""
        cells = "".join(
            f"<tr><th>{key}</th><td>{html.escape(text)}</td></tr>"
            for key, text in self.summary
        )
        return f"<h4>{html.escape(self.title)}</h4><table>{cells}</table>"

    @property
    def control_rate_hz(self) -> float:
        """Rate of the control periods, with or without a controller."""
        return self.motion.control.rate_hz if self.motion.control else 100.0


def check_scene(scene: object) -> None:
    """Raise InputError for what is no scene, such as the name of one."""
    if not isinstance(scene, Scene):
        raise InputError("scene", excerpt(repr(scene)), "a Scene, as from skysim.load_scene")
