"""Schema of the scene section `motion`: start, maneuver, attitude controller and jitter."""

from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
)

from skysim.core.errors import InputError
from skysim.core.units import (
    BY_KIND,
    ZEROS,
    AboveZero,
    ConfigModel,
    Declination,
    Duration,
    Momentum,
    NotEmpty,
    NotNegative,
    Number,
    Options,
    Positive,
    RightAscension,
    Spin,
    Spins,
    Three,
    TimeLimit,
    within,
)
from skysim.core.yaml_reader import ExistingFile
from skysim.scene.sections.vehicle import ActuatorsName

SIDEREAL = "sidereal"  # the rate of a vehicle that stands on the Earth, under the stars
StartRate = Annotated[
    Annotated[Spins, Tag("rates")] | Annotated[Literal["sidereal"], Tag("name")],
    Discriminator(lambda value: "name" if isinstance(value, str) else "rates"),
]
LawName = Annotated[str, Field(pattern=r"^\w[\w.-]*$", max_length=100)]
BUILT_IN_LAWS = ("pid", "pd")  # of dynamics/attitude_control.py
PRESCRIBED = "prescribed"  # no controller: the vehicle moves exactly along the maneuver


class AttitudeConfig(ConfigModel):
    """3-2-1 Euler angles of the body in the lab."""

    roll_deg: Spin = 0.0
    pitch_deg: Spin = 0.0
    yaw_deg: Spin = 0.0


class PointingConfig(ConfigModel):
    """Pointing of the camera in the ICRS: its boresight, and the position angle of the image's up direction."""

    ra_deg: RightAscension
    dec_deg: Declination
    roll_deg: Spin = 0.0


def start_tag(value: Any) -> str:
    """Tag of the kind of start; an error in one kind is then not reported with the keys of the other."""
    if isinstance(value, str):
        return "profile"
    keys = value if isinstance(value, dict) else ()
    sky = isinstance(value, PointingConfig) or any(
        key in keys for key in ("ra_deg", "dec_deg")
    )
    return "PointingConfig" if sky else "AttitudeConfig"


Start = Annotated[
    Annotated[AttitudeConfig, Tag("AttitudeConfig")]
    | Annotated[PointingConfig, Tag("PointingConfig")]
    | Annotated[Literal["profile"], Tag("profile")],
    Discriminator(start_tag),
]


AxesRms = Three[NotNegative]


class JitterLineConfig(ConfigModel):
    """A vibration at one frequency: rms_arcsec about each axis of the body, with random phases."""

    kind: Literal["line"]
    frequency_hz: Positive
    rms_arcsec: AxesRms


class JitterBandConfig(ConfigModel):
    """Random vibration between two frequencies, with a power spectral density proportional to f^slope."""

    kind: Literal["band"]
    from_hz: Positive
    to_hz: Positive
    rms_arcsec: AxesRms
    slope: Annotated[Number, within(-6, 6)] = 0.0

    def check(self) -> None:
        if self.from_hz >= self.to_hz:
            raise InputError("from_hz", f"{self.from_hz:g} is not below to_hz {self.to_hz:g}")


JitterPart = Annotated[JitterLineConfig | JitterBandConfig, BY_KIND]


class HoldConfig(ConfigModel):
    """Hold the attitude for a duration."""

    kind: Literal["hold"]
    duration_s: Duration


class StepConfig(AttitudeConfig):
    """Command a 3-2-1 attitude as a step and hold it for a duration: the controller's step response."""

    kind: Literal["step"]
    duration_s: Duration


class SlewConfig(AttitudeConfig):
    """Rest-to-rest eigenaxis rotation to a 3-2-1 attitude: the rate rises and falls along smoothsteps 3x^2 - 2x^3.

    The acceleration peaks in the middle of a ramp. An angle A takes A / rate + 1.5 rate / acceleration.

    Attributes
    ----------
    rate_deg_s
        Greatest rate; 2 deg/s if neither it nor a duration is given. A short slew does not reach it
    acceleration_deg_s2
        Greatest acceleration
    duration
        Duration, in place of the rate
    """

    kind: Literal["slew"]
    rate_deg_s: Positive | None = None
    acceleration_deg_s2: Positive = 0.5
    duration_s: Duration | None = None

    def check(self) -> None:
        if self.rate_deg_s is not None and self.duration_s is not None:
            raise InputError("duration", "given beside rate_deg_s", "one of the two")


class RateConfig(ConfigModel):
    """Rotate at a constant rate, rate_deg_s about body x, y, z, from the beginning of the maneuver."""

    kind: Literal["rate"]
    rate_deg_s: Spins
    duration_s: Duration


class SpinUpConfig(ConfigModel):
    """Change the rate smoothly from its present value to rate_deg_s about body x, y, z."""

    kind: Literal["spin_up"]
    rate_deg_s: Spins
    duration_s: Duration


class SineConfig(ConfigModel):
    """Oscillate about the attitude: amplitude_deg about body x, y, z at frequency_hz, starting and ending smoothly."""

    kind: Literal["sine"]
    amplitude_deg: Spins
    frequency_hz: Positive
    duration_s: Duration


class ChirpConfig(ConfigModel):
    """Oscillate about the attitude with a frequency that sweeps from from_hz to to_hz.

    Attributes
    ----------
    amplitude_deg
        Amplitude about body x, y, z, in phase; constant except for a smooth beginning and end of one period each
    sweep
        `linear`: the frequency changes evenly with time; `log`: by equal factors in equal times
    """

    kind: Literal["chirp"]
    amplitude_deg: Spins
    from_hz: Positive
    to_hz: Positive
    duration_s: Duration
    sweep: Literal["linear", "log"] = "linear"

    def check(self) -> None:
        if self.from_hz == self.to_hz:
            raise InputError(
                "",
                f"from_hz and to_hz are both {self.from_hz:g}",
                "different ones, or kind: sine",
            )
        if self.duration_s < 1 / self.from_hz + 1 / self.to_hz:
            raise InputError(
                "duration",
                f"{self.duration_s:g} s is shorter than a period of from_hz and one of to_hz,"
                f" {1 / self.from_hz + 1 / self.to_hz:g} s",
            )


# The rotation of a profile's quaternions.
RotationName = Literal[
    "lab_from_body",
    "body_from_lab",
    "icrs_from_body",
    "body_from_icrs",
    "icrs_from_cam",
    "cam_from_icrs",
]


class ProfileConfig(ConfigModel):
    """Follow the attitudes of a file, interpolated by a spline with continuous rate and acceleration.

    Attributes
    ----------
    file
        CSV or ECSV table, CCSDS AEM, or STK attitude file; its content determines the format
    begin
        Time in the file at which the maneuver begins. `zero`: t_s = 0, while epochs count from the scene's start_time;
        `first_sample`: that of the first sample
    rotation
        Rotation of the columns q_x, q_y, q_z, q_w; columns such as lab_from_body_qx name it themselves
    """

    kind: Literal["profile"]
    file: ExistingFile
    begin: Literal["zero", "first_sample"] = "zero"
    rotation: RotationName | None = None


class ShakeConfig(ConfigModel):
    """Hold the attitude while the vehicle vibrates, like `motion.jitter` but only for this duration."""

    kind: Literal["jitter"]
    duration_s: Duration
    components: NotEmpty[JitterPart]


class BumpConfig(ConfigModel):
    """An external torque impulse hits the vehicle while it is commanded to hold.

    Attributes
    ----------
    rate_deg_s
        Change of the rate about body x, y, z that the impulse alone would cause
    duration
        Duration of the impulse, a half-sine of torque
    caught_after
        Time from the beginning of the impulse to an equal and opposite one; none if left out
    """

    kind: Literal["bump"]
    rate_deg_s: Spins
    duration_s: Duration
    caught_after_s: Duration | None = None

    def check(self) -> None:
        if self.caught_after_s is not None and self.caught_after_s < self.duration_s:
            raise InputError(
                "caught_after", f"{self.caught_after_s:g} s is before the impulse ends"
            )


Maneuver = Annotated[
    HoldConfig
    | StepConfig
    | SlewConfig
    | RateConfig
    | SpinUpConfig
    | SineConfig
    | ChirpConfig
    | ProfileConfig
    | ShakeConfig
    | BumpConfig,
    BY_KIND,
]


Stored = AboveZero[Momentum]


class DesaturationConfig(ConfigModel):
    """Unloading of momentum from wheels or CMGs by the fans.

    Attributes
    ----------
    start, stop
        Stored momentum above which unloading starts, and below which it stops
    time
        Stored momentum over the torque of the fans, within their limits
    """

    start_nms: Stored
    stop_nms: Stored
    time_s: Duration = 10.0

    def check(self) -> None:
        if self.stop_nms >= self.start_nms:
            raise InputError(
                "stop", f"{self.stop_nms:g} N m s is not below start {self.start_nms:g} N m s"
            )


class ControlConfig(ConfigModel):
    """The attitude controller on the vehicle's computer.

    Attributes
    ----------
    law
        `pid`, or `pd`, which leaves the offset by a constant torque; or an external controller: an entry point of the
        group skysim.controllers, or a program given on the command line (`--program`). `prescribed` is no controller:
        the vehicle moves exactly along the maneuver, without dynamics
    options, time_limit
        Options of an external controller, and its time limit for each control period
    actuators
        `ideal` torques about the body's axes, or one of the sets that `vehicle` switches on
    feedback
        Source of the attitude: `truth`, `imu` (the navigator), `filter` (star tracker and gyro)
    rate_hz
        Rate of the control periods
    bandwidth_rad_s, damping
        Bandwidth and damping of the attitude loop. The bandwidth times the delay (a control period, and with fans
        their time constant) should be well below 1, such as 0.3
    integral_rad_s
        Pole of the integral
    desaturation
        Unloading of momentum by the fans; none if left out
    """

    law: LawName = "pid"
    options: Options = Field(default_factory=dict)
    time_limit_s: TimeLimit = 10.0
    actuators: ActuatorsName = "ideal"
    feedback: Literal["truth", "imu", "filter"] = "truth"
    rate_hz: Annotated[Number, within(1, 1000)] = 100.0
    bandwidth_rad_s: Positive = 3.0
    damping: Positive = 0.8
    integral_rad_s: Positive = 0.6
    desaturation: DesaturationConfig | None = None

    def check(self) -> None:
        """Refuse keys that have no effect with the law."""
        unused = []
        if self.law in BUILT_IN_LAWS:
            unused = ["options", "time_limit_s"]
        elif self.law == PRESCRIBED:
            unused = [
                name for name in type(self).model_fields if name not in ("law", "rate_hz")
            ]
        for name in unused:
            default = type(self).model_fields[name].get_default(call_default_factory=True)
            if getattr(self, name) != default:
                key = name.removesuffix("_s")
                raise InputError("", f"{key} has no effect with law {self.law}", "none")


def expand_control(value: Any) -> Any:
    """The full section of `control: NAME`, which is {law: NAME}; None for `none`."""
    if value == "none":
        return None
    return {"law": value} if isinstance(value, str) else value


class MotionConfig(ConfigModel):
    """The vehicle's start, its maneuver, its controller and its jitter.

    Attributes
    ----------
    start
        Attitude, or pointing under the stars; `profile`: attitude and rate of the first maneuver, which is a profile
    rate_deg_s
        Rate at the start about body x, y, z; `sidereal` under the stars: that of the Earth about its pole at
        start_time, as of a camera on a tripod
    control
        Controller; none if left out
    maneuver
        Maneuvers in their order
    jitter
        Vibration that is always on
    """

    start: Start = AttitudeConfig()
    rate_deg_s: StartRate = ZEROS
    control: Annotated[
        ControlConfig | None,
        BeforeValidator(
            expand_control, json_schema_input_type=ControlConfig | LawName | None
        ),
    ] = None
    maneuver: tuple[Maneuver, ...] = ()
    jitter: tuple[JitterPart, ...] = ()

    @property
    def is_prescribed(self) -> bool:
        """Whether the vehicle moves exactly along the maneuver, without dynamics."""
        return self.control is not None and self.control.law == PRESCRIBED

    def check(self) -> None:
        if self.rate_deg_s == SIDEREAL and self.control is not None:
            raise InputError(
                "rate_deg_s", "sidereal conflicts with a controller", "no control"
            )
        driven = any(leg.kind not in ("bump", "hold", "jitter") for leg in self.maneuver)
        if driven and self.control is None:
            raise InputError(
                "",
                "a maneuver requires a controller, such as control: pid",
                "maneuver: [] without one",
            )
        # A prescribed motion, which has no dynamics, has neither an impulse nor a jump of the attitude.
        refused = [leg.kind for leg in self.maneuver if leg.kind in ("bump", "step")]
        if self.is_prescribed and refused:
            raise InputError(
                "maneuver",
                f"{refused[0]} is not possible with control: prescribed",
                "control: pid",
            )
        if self.start != "profile":
            return
        if not self.maneuver or self.maneuver[0].kind != "profile":
            raise InputError("start", "profile requires a first maneuver of kind profile")
        if any(self.rate_deg_s):
            raise InputError(
                "rate_deg_s",
                "has no effect with start: profile, which gives the rate",
                "[0, 0, 0]",
            )
