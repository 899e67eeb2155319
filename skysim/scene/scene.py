"""Schema of a scene file (YAML): the validated, frozen `Scene`, and the checks between its sections.

The sections are defined in `vehicle`, `motion`, `light`, `leds`, `camera` and `tracker`; values with units in
`core.units`.
"""

from __future__ import annotations

import datetime
import html
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from skysim.core.units import ConfigModel, Number, Time, in_utc
from skysim.scene.camera import CameraConfig
from skysim.scene.light import BenchConfig, DomeConfig, Glow, StarsConfig
from skysim.scene.motion import MotionConfig, PointingConfig
from skysim.scene.tracker import FilterConfig, SurveyErrorsConfig, TrackerConfig
from skysim.scene.vehicle import SiteConfig, VehicleConfig

STEM = "(the file's name)"  # alias of Scene.name, not a valid key in a file

MOST_FRAMES, MOST_S = 1_000_000, 86_400.0  # of a run, limited by memory


def in_our_time(value: datetime.datetime) -> datetime.datetime:
    """UTC without a zone. The Earth's ephemeris and linear proper motion are valid for about a century."""
    if not 1900 <= value.year <= 2100:
        raise ValueError(f"{value.isoformat()} is outside of 1900 to 2100")
    return in_utc(value)


class ExposureConfig(ConfigModel):
    """Exposure time, frame rate, number of frames, and the time of the first."""

    time_s: Annotated[Time, Field(ge=1e-6)]
    rate_hz: Annotated[Number, Field(gt=0)]
    frames: Annotated[int, Field(ge=1)]
    first_s: Annotated[Time, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def fits_its_period(self) -> ExposureConfig:
        if self.time_s > 1 / self.rate_hz:
            raise ValueError(f"time {self.time_s} s is longer than the frame period {1 / self.rate_hz} s")
        lasts_s = self.first_s + self.frames / self.rate_hz
        if self.frames > MOST_FRAMES or lasts_s > MOST_S:
            raise ValueError(
                f"{self.frames} frames over {lasts_s:g} s; allowed: up to {MOST_FRAMES}, over a day ({MOST_S:g} s)"
            )
        return self


class Scene(ConfigModel):
    """A complete simulation: the laboratory, the vehicle and its motion, the light, the camera and the tracker."""

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    title: str
    seed: Annotated[int, Field(ge=0)]
    start_time: Annotated[datetime.datetime, AfterValidator(in_our_time)]
    lab: SiteConfig = SiteConfig()
    vehicle: VehicleConfig
    motion: MotionConfig
    light: Annotated[DomeConfig | StarsConfig | BenchConfig, Field(discriminator="kind")]
    background: tuple[Glow, ...] = ()
    camera: CameraConfig
    exposure: ExposureConfig
    tracker: TrackerConfig = TrackerConfig()
    filter: FilterConfig | None = None
    name: Annotated[str, Field(exclude=True, alias=STEM)] = ""

    @model_validator(mode="after")
    def one_world(self) -> Scene:
        # Survey errors and maps need LEDs. The start is a pointing under the stars and an attitude otherwise. All rows
        # must be read out within a frame period.
        sky = self.light.kind == "stars"
        told = self.tracker
        if not isinstance(self.light, DomeConfig) and (told.survey != SurveyErrorsConfig() or told.map):
            key = "map" if told.map else "survey"
            raise ValueError(
                f"tracker.{key}: light of kind {self.light.kind} has nothing to survey; allowed: dome"
            )
        if sky != isinstance(self.motion.start, PointingConfig):
            wanted = "ra_deg, dec_deg, roll_deg" if sky else "roll_deg, pitch_deg, yaw_deg"
            raise ValueError(f"motion.start: light of kind {self.light.kind} takes {wanted}")
        read_s = getattr(self.camera.shutter, "row_time_s", 0.0) * (self.camera.height_px - 1)
        if read_s > 1 / self.exposure.rate_hz:
            raise ValueError(
                f"camera.shutter: reading takes {read_s:g} s, longer than the frame period"
                f" {1 / self.exposure.rate_hz:g} s"
            )
        return self

    @model_validator(mode="after")
    def exposures(self) -> Scene:
        """Check that any exposure the exposure control may select ends before the next one begins."""
        told, period_s = self.tracker.exposure_control, 1 / self.exposure.rate_hz
        if told is None:
            return self
        if told.longest_s > period_s:
            raise ValueError(
                f"tracker.exposure_control.longest: {told.longest_s:g} s is longer than the frame period {period_s:g} s"
            )
        if not told.shortest_s <= self.exposure.time_s <= told.longest_s:
            raise ValueError(
                f"tracker.exposure_control: exposure.time {self.exposure.time_s:g} s, the first, is outside of"
                f" {told.shortest_s:g} s to {told.longest_s:g} s"
            )
        return self

    @model_validator(mode="after")
    def who_flies(self) -> Scene:
        told = self.motion.control
        imu = self.vehicle.imu
        if self.filter and not imu:
            raise ValueError("filter: takes a gyro; allowed beside vehicle.imu")
        if told is None:
            return self
        # The controller's actuators and its source of the attitude must be in the scene.
        has = {"ideal": True} | {kind: getattr(self.vehicle, kind) for kind in ("wheels", "fans", "cmgs")}
        if not has[told.actuators]:
            raise ValueError(f"motion.control.actuators: vehicle.{told.actuators} is not switched on")
        if told.desaturation and (not self.vehicle.fans or told.actuators not in ("wheels", "cmgs")):
            raise ValueError("motion.control.desaturation: takes vehicle.fans, and actuators: wheels or cmgs")
        if {"truth": False, "imu": not imu, "filter": not self.filter}[told.feedback]:
            section = "vehicle.imu" if told.feedback == "imu" else "filter"
            raise ValueError(f"motion.control.feedback: {told.feedback} takes the section {section}")
        return self

    @model_validator(mode="after")
    def clocks(self) -> Scene:
        """Check that a control period is a whole number of milliseconds and of IMU samples."""
        rate_hz = self.control_rate_hz
        if abs(1000 / rate_hz - round(1000 / rate_hz)) > 1e-9:
            raise ValueError(f"motion.control.rate_hz: {rate_hz:g} Hz is no whole number of milliseconds")
        imu = self.vehicle.imu
        if imu and self.filter and self.filter.bias_time_s < 10 / imu.rate_hz:
            raise ValueError(f"filter.bias_time: shorter than ten samples of the IMU, {10 / imu.rate_hz:g} s")
        fastest_hz = max(
            (part.frequency_hz for part in self.motion.manoeuvre if part.kind == "sine"), default=0
        )
        if 2 * fastest_hz >= rate_hz:
            raise ValueError(
                f"motion.manoeuvre: a sine of {fastest_hz:g} Hz takes a motion.control.rate_hz of more than twice that"
            )
        if imu and abs(imu.rate_hz / rate_hz - round(imu.rate_hz / rate_hz)) > 1e-9:
            raise ValueError(
                f"vehicle.imu.rate_hz: {imu.rate_hz:g} Hz is no multiple of motion.control.rate_hz {rate_hz:g} Hz"
            )
        return self

    def _repr_html_(self) -> str:
        """For notebooks: what the scene has, one row a section."""
        camera, exposure = self.camera, self.exposure
        rows = [
            ("name", self.name),
            ("light", self.light.kind),
            ("vehicle", self.vehicle.mount),
            (
                "camera",
                f"{camera.width_px} × {camera.height_px} px, f = {1e3 * camera.focal_length_m:g} mm",
            ),
            (
                "exposure",
                f"{exposure.frames} of {1e3 * exposure.time_s:g} ms at {exposure.rate_hz:g} Hz",
            ),
            ("tracker", self.tracker.name),
        ]
        cells = "".join(f"<tr><th>{key}</th><td>{html.escape(str(value))}</td></tr>" for key, value in rows)
        return f"<h4>{html.escape(self.title)}</h4><table>{cells}</table>"

    @property
    def control_rate_hz(self) -> float:
        """Tick rate of the vehicle's computer, with or without a controller."""
        return self.motion.control.rate_hz if self.motion.control else 100.0
