"""Schema of the scene section `light.air`: the atmosphere between a sky scene's camera and the stars."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from skysim.core.constants import FWHM_PER_SIGMA
from skysim.core.errors import InputError
from skysim.core.units import Ascending, ConfigModel, Fraction, Length, Number, check_table

NEGLIGIBLE_PX = 0.02  # a blur of this sigma makes an image of 0.7 px wider by 0.0003 px
Altitude = Annotated[Number, Field(ge=0, lt=90)]


class HorizonConfig(ConfigModel):
    """A skyline: apparent altitudes below which nothing is seen, linear between the azimuths (from north through east).

    The table continues around the circle from its last row to its first.
    """

    azimuth_deg: Ascending
    altitude_deg: Annotated[tuple[Altitude, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def check_columns(self) -> Self:
        check_table(self.azimuth_deg, self.altitude_deg, "altitude_deg")
        if not 0 <= self.azimuth_deg[0] <= self.azimuth_deg[-1] < 360:
            raise InputError("azimuth_deg", "outside the circle", "0 to below 360")
        return self


class AirGlowConfig(ConfigModel):
    """The sky's glow, which follows from time and place.

    dark_mag_arcsec2 : V surface brightness of the moonless night sky at the zenith
    moonlight, twilight : scattered light of the Moon and of the Sun
    """

    dark_mag_arcsec2: Annotated[Number, Field(ge=10, le=30)] = 21.7
    moonlight: bool = True
    twilight: bool = True


class AirConfig(ConfigModel):
    """The atmosphere over `site`. Of the standard atmosphere at the site's height what is left out.

    pressure_hpa, temperature_c : at the site
    humidity         : relative, 0 to 1
    wavelength       : of refraction; the mean of a G2 star's photo-electrons if left out
    extinction_mag   : k' at the zenith in the camera's band;  color_extinction_mag : k''. A star loses
        (k' + k'' (B-V)) mag for each air mass
    scintillation    : whether stars twinkle
    seeing_arcsec    : full width of a star's image at the zenith, half maximum, at a long exposure
    horizon          : the skyline; altitude 0 all around if left out
    glow             : sky, twilight and moonlight; none if left out
    """

    pressure_hpa: Annotated[Number, Field(ge=0, le=1100)] | None = None
    temperature_c: Annotated[Number, Field(ge=-80, le=50)] | None = None
    humidity: Fraction = 0.5
    wavelength_m: Annotated[Length, Field(ge=300e-9, le=2e-6)] | None = None
    extinction_mag: Annotated[Number, Field(ge=0, le=5)] = 0.172
    color_extinction_mag: Annotated[Number, Field(ge=-1, le=1)] = 0.0
    scintillation: bool = True
    seeing_arcsec: Annotated[Number, Field(ge=0, le=20)] = 0.0
    horizon: HorizonConfig | None = None
    glow: AirGlowConfig | None = None

    def seeing_px(self, focal_px: float) -> float:
        """Standard deviation of a star's image at the zenith by the seeing; 0 where it is too small to matter."""
        sigma_px = math.radians(self.seeing_arcsec / 3600) * (1 / FWHM_PER_SIGMA) * focal_px
        return sigma_px if sigma_px > NEGLIGIBLE_PX else 0.0
