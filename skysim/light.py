"""What shines, as a scene says it: a dome with its LEDs or the stars, and the glow behind them. Schema only."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from skysim.quantity import (
    Ascending,
    Intensity,
    Length,
    NotNegative,
    Number,
    Part,
    RadiantIntensity,
    SemiAxis,
    Share,
    Time,
    a_table,
    one_of,
)


class Surface(Part):
    """The inside of the dome, in the lab frame (metres, bearing centre at the origin)."""

    kind: Literal["sphere", "ellipsoid", "flat"]
    apex_m: Annotated[Length, Field(gt=0)]
    radius_m: Annotated[Length, Field(gt=0)] | None = None
    semi_axes_m: tuple[SemiAxis, SemiAxis, SemiAxis] | None = None
    offset_m: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def its_own_sizes(self) -> Surface:
        needs = {"sphere": {"radius"}, "ellipsoid": {"semi_axes"}, "flat": set()}[self.kind]
        has = {name for name in ("radius", "semi_axes") if getattr(self, f"{name}_m") is not None}
        if needs != has:
            wanted = ", ".join(sorted(needs)) or "neither radius nor semi_axes"
            raise ValueError(f"a {self.kind} takes {wanted}")
        return self


class PatchBoards(Part):
    """3x3 LED boards spread evenly over a cap of the surface, each with a pattern of its own."""

    kind: Literal["patch_boards"]
    cap_deg: Annotated[Number, Field(gt=0, le=90)]
    spacing_m: Annotated[Length, Field(gt=0)]
    pitch_m: Annotated[Length, Field(gt=0)]
    lit: tuple[int, int] = (4, 6)
    pwm_levels: Annotated[tuple[Annotated[Number, Field(gt=0, le=1)], ...], Field(min_length=1)] = (1.0,)
    hardware_seed: Annotated[int, Field(ge=0)] = 0

    @field_validator("lit")
    @classmethod
    def within_board(cls, value: tuple[int, int]) -> tuple[int, int]:
        if not 1 <= value[0] <= value[1] <= 9:
            raise ValueError(f"{value} is no range of LEDs on a 3x3 board; allowed: 1 <= least <= most <= 9")
        return value

    @model_validator(mode="after")
    def boards_fit_beside_each_other(self) -> PatchBoards:
        if self.spacing_m < 3 * self.pitch_m:
            raise ValueError(
                f"spacing {self.spacing_m:g} m: boards of three LEDs at {self.pitch_m:g} m would overlap"
            )
        return self


class CosineLobe(Part):
    """Radiant intensity as cos^exponent of the angle from the normal; 1 is Lambert's law."""

    kind: Literal["cosine"] = "cosine"
    exponent: NotNegative = 1.0


class LobeTable(Part):
    """Relative intensity against angle as it was measured, 1 on the axis, nothing beyond the last angle."""

    kind: Literal["table"]
    angle_deg: Ascending
    intensity: Annotated[tuple[NotNegative, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def a_table(self) -> LobeTable:
        a_table(self.angle_deg, self.intensity, "intensity")
        if self.angle_deg[0] != 0 or abs(self.intensity[0] - 1) > 1e-6:
            raise ValueError("the table does not begin with an intensity of 1 at 0 deg")
        return self


Lobe = Annotated[CosineLobe | LobeTable, Field(discriminator="kind")]


class Led(Part):
    """One kind of LED, for the whole dome: so bright along its normal, in candela or in watts a steradian."""

    intensity_cd: Annotated[Intensity, Field(gt=0)] | None = None
    radiant_intensity_w_sr: Annotated[RadiantIntensity, Field(gt=0)] | None = None
    disc_diameter_m: Annotated[Length, Field(gt=0)]
    falloff: str = "inverse_square"
    lobe: Lobe = CosineLobe()
    spectrum: Literal["white"] | Annotated[Length, Field(ge=300e-9, le=1100e-9)] = "white"
    scatter: Annotated[Number, Field(ge=0, lt=0.5)] = 0.0
    pwm_period_s: Annotated[Time, Field(gt=0)] = 1e-3

    @field_validator("falloff")
    @classmethod
    def known_falloff(cls, value: str) -> str:
        from skysim.led import FALLOFF

        return one_of(value, FALLOFF)

    @model_validator(mode="after")
    def one_brightness(self) -> Led:
        if (self.intensity_cd is None) == (self.radiant_intensity_w_sr is None):
            raise ValueError("an LED takes either intensity or radiant_intensity")
        return self


class Dome(Part):
    """An LED dome as the light."""

    kind: Literal["dome"]
    surface: Surface
    layout: PatchBoards
    led: Led


class Stars(Part):
    """The real sky as the light."""

    kind: Literal["stars"]
    catalogue: str = "hipparcos_hp6.5"
    limit_mag: Annotated[Number, Field(ge=0, le=15)] = 6.5


class UniformGlow(Part):
    """The same everywhere: e_s electrons a second in every pixel (a light leak, a lit room)."""

    kind: Literal["uniform"]
    e_s: Annotated[Number, Field(ge=0, le=1e12)]


class SkyGlow(Part):
    """The night sky's surface brightness at the boresight, with a relative slope along the image's axes."""

    kind: Literal["sky"]
    mag_arcsec2: Annotated[Number, Field(ge=0, le=30)]
    gradient_per_deg: tuple[Number, Number] = (0.0, 0.0)


class MoonGlow(Part):
    """Moonlight scattered by the air (Krisciunas & Schaefer 1991), the Moon at ra_deg, dec_deg.

    phase_angle_deg : 0 at full moon, 90 at the quarters
    extinction_mag  : of the air at the zenith, in V
    moon_zenith_deg, field_zenith_deg : zenith distances of the Moon and of the boresight
    """

    kind: Literal["moon"]
    ra_deg: Annotated[Number, Field(ge=0, lt=360)]
    dec_deg: Annotated[Number, Field(ge=-90, le=90)]
    phase_angle_deg: Annotated[Number, Field(ge=0, le=180)]
    extinction_mag: Annotated[Number, Field(ge=0, le=2)] = 0.172
    moon_zenith_deg: Annotated[Number, Field(ge=0, lt=90)]
    field_zenith_deg: Annotated[Number, Field(ge=0, lt=90)]


class StrayLight(Part):
    """A bright body outside of the field through baffle and lens, by their point source transmittance.

    ra_deg, dec_deg : where it stands, in the lab's axes (under the stars those of the ICRS)
    v_mag           : how bright it is; the Sun's -26.74 if left out
    angle_deg, pst  : irradiance on the chip over irradiance before the lens, against the angle from the boresight
    """

    kind: Literal["stray"]
    ra_deg: Annotated[Number, Field(ge=0, lt=360)]
    dec_deg: Annotated[Number, Field(ge=-90, le=90)]
    v_mag: Number = -26.74
    angle_deg: Ascending
    pst: Annotated[tuple[Share, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def a_table(self) -> StrayLight:
        a_table(self.angle_deg, self.pst, "pst")
        return self


Glow = Annotated[UniformGlow | SkyGlow | MoonGlow | StrayLight, Field(discriminator="kind")]
