"""Schema of the scene section `thermal`: the temperature of the laboratory, and what moves with it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from skysim.core.errors import InputError
from skysim.core.units import Ascending, ConfigModel, Length, Number, Time, check_table

Temperature = Annotated[Number, Field(ge=-150, le=150)]
Coefficient = Annotated[Number, Field(ge=-10_000, le=10_000)]


class SteadyTemperatureConfig(ConfigModel):
    """The same temperature all along."""

    kind: Literal["steady"]
    temperature_c: Temperature


class LinearTemperatureConfig(ConfigModel):
    """A temperature that rises or falls evenly from start_c."""

    kind: Literal["linear"]
    start_c: Temperature
    rate_c_h: Annotated[Number, Field(ge=-100, le=100)]


class SineTemperatureConfig(ConfigModel):
    """A temperature that goes up and down: mean + amplitude sin(2 pi t / period + phase)."""

    kind: Literal["sine"]
    mean_c: Temperature
    amplitude_c: Annotated[Number, Field(gt=0, le=100)]
    period_s: Annotated[Time, Field(gt=0)]
    phase_deg: Annotated[Number, Field(ge=-360, le=360)] = 0.0


class TemperatureTableConfig(ConfigModel):
    """A measured history, linear between its times and constant beyond them."""

    kind: Literal["table"]
    hours: Ascending
    temperature_c: Annotated[tuple[Temperature, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def check_columns(self) -> TemperatureTableConfig:
        check_table(self.hours, self.temperature_c, "temperature_c", "hours")
        return self


Temperatures = Annotated[
    SteadyTemperatureConfig
    | LinearTemperatureConfig
    | SineTemperatureConfig
    | TemperatureTableConfig,
    Field(discriminator="kind"),
]


class ThermalConfig(ConfigModel):
    """What has moved since survey and calibration, which were at reference_c. The tracker does not know of it.

    temperature   : of dome, mount and lens alike, against the time since the scene's start
    speed         : the temperature's history runs so many times as fast as the clock, so that a short run has hours
    dome_ppm_k    : linear expansion of the dome with its LEDs, from the level anchor_height above the bearing's center
        on its axis; acrylic has 70, steel 12
    creep         : displacement of the dome since its survey
    mount_arcsec_k: rotation of the camera on the vehicle about the camera's axes
    lens_ppm_k    : relative change of the focal length
    """

    temperature: Temperatures
    reference_c: Temperature = 20.0
    speed: Annotated[Number, Field(ge=1, le=1e5)] = 1.0
    dome_ppm_k: Coefficient = 0.0
    anchor_height_m: Length = 0.0
    creep_m: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)
    mount_arcsec_k: tuple[Coefficient, Coefficient, Coefficient] = (0.0, 0.0, 0.0)
    lens_ppm_k: Coefficient = 0.0

    @property
    def has_effect(self) -> bool:
        """Whether anything depends on the temperature."""
        return bool(self.dome_ppm_k or any(self.mount_arcsec_k) or self.lens_ppm_k)

    @model_validator(mode="after")
    def check_effect(self) -> ThermalConfig:
        if not self.has_effect:
            raise InputError(
                "",
                "nothing depends on the temperature",
                "dome_ppm_k, mount_arcsec_k or lens_ppm_k, or no thermal",
            )
        return self
