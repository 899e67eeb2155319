"""Schema of the scene section `orbit`, of the satellites in a sky scene, and of what the Earth does to the camera."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from skysim.core.errors import InputError
from skysim.core.yaml_reader import existing_file
from skysim.core.units import ConfigModel, Fraction, Length, Number

ElementsFile = Annotated[str, AfterValidator(existing_file)]
Magnitude = Annotated[Number, Field(ge=-30, le=30)]
Rate = Annotated[Number, Field(gt=0, le=30)]


class RandomSatellitesConfig(ConfigModel):
    """Sunlit satellites on random paths, drawn anew for each frame: anywhere in the field, in any direction.

    per_field  : mean number in the camera's field (the circle around its chip) at any moment
    rate_deg_s : least and greatest angular rate against the stars; its logarithm is uniformly distributed
    v_mag      : least and greatest V magnitude, uniformly distributed
    seed       : of all these draws, together with the scene's
    """

    per_field: Annotated[Number, Field(gt=0, le=1000)]
    rate_deg_s: tuple[Rate, Rate] = (0.05, 1.5)
    v_mag: tuple[Magnitude, Magnitude] = (2.0, 8.0)
    seed: Annotated[int, Field(ge=0)]

    @model_validator(mode="after")
    def check_ranges(self) -> Self:
        for name in ("rate_deg_s", "v_mag"):
            low, high = getattr(self, name)
            if low > high:
                raise InputError(name, f"{low:g} is above {high:g}", "the least, then the greatest")
        return self


class SatellitesConfig(ConfigModel):
    """Artificial satellites, seen from the scene's `orbit`, or else from `site` with its longitude.

    file         : mean elements: TLE, or OMM as CSV, XML or JSON
    standard_mag : V at a range of 1000 km and a phase angle of 90 degrees, of all satellites of the file
    random       : further satellites on random paths
    """

    file: ElementsFile | None = None
    standard_mag: Magnitude = 6.0
    random: RandomSatellitesConfig | None = None

    @model_validator(mode="after")
    def check_any(self) -> Self:
        if self.file is None and self.random is None:
            raise InputError("", "no satellite is left", "file or random, or no satellites")
        return self


class ExclusionConfig(ConfigModel):
    """When the tracker can be used in its orbit, for `skysim availability`.

    sun_deg, moon_deg : least angle of the boresight from their centers;  earth_deg : from the Earth's limb
    stars : least number of stars to `tracker.limit_mag` in a round field of the chip's area
    """

    sun_deg: Annotated[Number, Field(ge=0, lt=180)] = 0.0
    earth_deg: Annotated[Number, Field(ge=0, lt=180)] = 0.0
    moon_deg: Annotated[Number, Field(ge=0, lt=180)] = 0.0
    stars: Annotated[int, Field(ge=0)] = 4


class EarthConfig(ConfigModel):
    """The Earth's light in the field: lit ground, the air above its limb, and the airglow.

    albedo  : of the ground with its clouds
    airglow : V surface brightness of the layer seen from straight above
    """

    albedo: Fraction = 0.3
    airglow_mag_arcsec2: Annotated[Number, Field(ge=10, le=30)] = 22.0


class OrbitConfig(ConfigModel):
    """The camera's orbit about the Earth: keys common to all kinds.

    earth     : the Earth's light; if left out it is dark, but hides stars
    exclusion : limits of the tracker's use; none if left out
    """

    earth: EarthConfig | None = None
    exclusion: ExclusionConfig | None = None


class CircularOrbitConfig(OrbitConfig):
    """A circular orbit at the scene's start, in GCRS axes, turned by the Earth's flattening (J2).

    altitude     : above the Earth's equatorial radius, 6378.137 km
    argument_deg : from the ascending node to the camera at start_time
    """

    kind: Literal["circular"]
    altitude_m: Annotated[Length, Field(ge=100e3, le=1e9)]
    inclination_deg: Annotated[Number, Field(ge=0, le=180)]
    raan_deg: Annotated[Number, Field(ge=-360, le=360)] = 0.0
    argument_deg: Annotated[Number, Field(ge=-360, le=360)] = 0.0


class TleOrbitConfig(OrbitConfig):
    """An orbit of mean elements (SGP4): a TLE, or an OMM as CSV, XML or JSON.

    number : the satellite's catalog number, for a file of several
    """

    kind: Literal["tle"]
    file: ElementsFile
    number: Annotated[int, Field(ge=0, le=999_999_999)] | None = None


class OemOrbitConfig(OrbitConfig):
    """An orbit of a CCSDS Orbit Ephemeris Message (OEM) in keyword = value notation."""

    kind: Literal["oem"]
    file: ElementsFile


Orbit = Annotated[
    CircularOrbitConfig | TleOrbitConfig | OemOrbitConfig, Field(discriminator="kind")
]
