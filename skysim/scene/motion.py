"""Schema of the scene section `motion`: start, maneuver, attitude controller and jitter."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from skysim.core.units import ConfigModel, Momentum, NotNegative, Number, Positive, Spin, Time

Duration = Annotated[Time, Field(gt=0)]
Acceleration = Positive
RatesDegS = tuple[Spin, Spin, Spin]
Law = Literal["pid", "pd"]


class AttitudeConfig(ConfigModel):
    """3-2-1 Euler angles of the body in the lab."""

    roll_deg: Number = 0.0
    pitch_deg: Number = 0.0
    yaw_deg: Number = 0.0


class PointingConfig(ConfigModel):
    """Pointing of the camera in the ICRS: its boresight, and the position angle of the image's up direction."""

    ra_deg: Annotated[Number, Field(ge=0, lt=360)]
    dec_deg: Annotated[Number, Field(ge=-90, le=90)]
    roll_deg: Number = 0.0


def start_tag(value: Any) -> str:
    """Tag of the kind of start, so that an error in one kind is not reported with the keys of the other."""
    keys = value if isinstance(value, dict) else ()
    sky = isinstance(value, PointingConfig) or any(key in keys for key in ("ra_deg", "dec_deg"))
    return "PointingConfig" if sky else "AttitudeConfig"


Start = Annotated[
    Annotated[AttitudeConfig, Tag("AttitudeConfig")] | Annotated[PointingConfig, Tag("PointingConfig")],
    Discriminator(start_tag),
]


class JitterLineConfig(ConfigModel):
    """A vibration at one frequency: rms_arcsec about each of the body's axes, random phases."""

    kind: Literal["line"]
    frequency_hz: Positive
    rms_arcsec: tuple[NotNegative, NotNegative, NotNegative]


class JitterBandConfig(ConfigModel):
    """Random vibration between two frequencies, power spectral density proportional to f^slope."""

    kind: Literal["band"]
    from_hz: Positive
    to_hz: Positive
    rms_arcsec: tuple[NotNegative, NotNegative, NotNegative]
    slope: Annotated[Number, Field(ge=-6, le=6)] = 0.0

    @model_validator(mode="after")
    def check_frequencies(self) -> JitterBandConfig:
        if self.from_hz >= self.to_hz:
            raise ValueError(f"from_hz {self.from_hz:g} is not below to_hz {self.to_hz:g}")
        return self


JitterPart = Annotated[JitterLineConfig | JitterBandConfig, Field(discriminator="kind")]


class HoldConfig(ConfigModel):
    """Hold the attitude for a duration."""

    kind: Literal["hold"]
    duration_s: Duration


class StepConfig(AttitudeConfig):
    """Command a 3-2-1 attitude as a step and hold it for a duration: the controller's step response."""

    kind: Literal["step"]
    duration_s: Duration


class SlewConfig(AttitudeConfig):
    """Rest-to-rest eigenaxis rotation to a 3-2-1 attitude, at most at rate_deg_s."""

    kind: Literal["slew"]
    rate_deg_s: Positive = 2.0
    acceleration_deg_s2: Acceleration = 0.5


class RateConfig(ConfigModel):
    """Rotate at a constant rate: rate_deg_s about body x, y, z, from the first moment."""

    kind: Literal["rate"]
    rate_deg_s: RatesDegS
    duration_s: Duration


class SpinUpConfig(ConfigModel):
    """Change the rate smoothly from its present value to rate_deg_s about body x, y, z."""

    kind: Literal["spin_up"]
    rate_deg_s: RatesDegS
    duration_s: Duration


class SineConfig(ConfigModel):
    """Oscillate about the attitude: amplitude_deg about body x, y, z at frequency_hz, starting and ending smoothly."""

    kind: Literal["sine"]
    amplitude_deg: tuple[Number, Number, Number]
    frequency_hz: Positive
    duration_s: Duration


class ShakeConfig(ConfigModel):
    """Hold while the vehicle vibrates, as `motion.jitter` but for this duration only."""

    kind: Literal["jitter"]
    duration_s: Duration
    components: Annotated[tuple[JitterPart, ...], Field(min_length=1)]


class BumpConfig(ConfigModel):
    """An external torque impulse hits the vehicle while it is commanded to hold.

    rate_deg_s : change of the rate about body x, y, z that the impulse alone would cause
    duration   : of the impulse, a half-sine of torque
    caught_after : time from its beginning to an equal and opposite impulse; none if left out
    """

    kind: Literal["bump"]
    rate_deg_s: RatesDegS
    duration_s: Duration
    caught_after_s: Duration | None = None

    @model_validator(mode="after")
    def check_catch_time(self) -> BumpConfig:
        if self.caught_after_s is not None and self.caught_after_s < self.duration_s:
            raise ValueError(f"caught_after {self.caught_after_s:g} s is before the impulse ends")
        return self


Maneuver = Annotated[
    HoldConfig | StepConfig | SlewConfig | RateConfig | SpinUpConfig | SineConfig | ShakeConfig | BumpConfig,
    Field(discriminator="kind"),
]


class DesaturationConfig(ConfigModel):
    """The fans unload momentum from wheels or CMGs: from above start until below stop.

    time : the fans' torque is the stored momentum over this time, within their limits
    """

    start_nms: Annotated[Momentum, Field(gt=0)]
    stop_nms: Annotated[Momentum, Field(gt=0)]
    time_s: Duration = 10.0

    @model_validator(mode="after")
    def check_thresholds(self) -> DesaturationConfig:
        if self.stop_nms >= self.start_nms:
            raise ValueError(f"stop {self.stop_nms:g} N m s is not below start {self.start_nms:g} N m s")
        return self


class ControlConfig(ConfigModel):
    """The attitude controller on the vehicle's computer.

    law       : pid, or pd, which leaves the offset caused by a constant torque
    actuators : ideal torques about the body's axes, or one of the sets that `vehicle` switches on
    feedback  : source of the attitude: truth, imu (the navigator), filter (star tracker and gyro)
    bandwidth_rad_s, damping : of the attitude loop;  integral_rad_s : the pole of the integral. Keep the bandwidth
        times the delay (a period of rate_hz, and the fans' time constant with fans) well below 1: 0.3 is fine
    """

    law: Law = "pid"
    actuators: Literal["ideal", "wheels", "fans", "cmgs"] = "ideal"
    feedback: Literal["truth", "imu", "filter"] = "truth"
    rate_hz: Annotated[Number, Field(ge=1, le=1000)] = 100.0
    bandwidth_rad_s: Positive = 3.0
    damping: Positive = 0.8
    integral_rad_s: Positive = 0.6
    desaturation: DesaturationConfig | None = None


def expand_control(value: Any) -> Any:
    """`control: pid` is short for {law: pid}, `none` for no controller."""
    if value == "none":
        return None
    return {"law": value} if isinstance(value, str) else value


class MotionConfig(ConfigModel):
    """The vehicle's start, its maneuver, its controller and its jitter."""

    start: Start = AttitudeConfig()
    rate_deg_s: RatesDegS = (0.0, 0.0, 0.0)
    control: Annotated[
        ControlConfig | None,
        BeforeValidator(expand_control, json_schema_input_type=ControlConfig | Law | Literal["none"] | None),
    ] = None
    maneuver: tuple[Maneuver, ...] = ()
    jitter: tuple[JitterPart, ...] = ()

    @model_validator(mode="after")
    def check_controller(self) -> MotionConfig:
        driven = any(leg.kind not in ("bump", "hold", "jitter") for leg in self.maneuver)
        if driven and self.control is None:
            raise ValueError("a maneuver requires a controller, such as control: pid")
        return self
