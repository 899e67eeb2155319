"""Schema of the surroundings of camera and laboratory: `light.air`, `thermal`, `orbit`, satellites, `background`."""

import math
from typing import Annotated, Literal

from pydantic import Field

from skysim.core.constants import FWHM_PER_SIGMA, SUN_V_MAG
from skysim.core.errors import InputError
from skysim.core.units import (
    BY_KIND,
    ZEROS,
    AxisAngle,
    ConfigModel,
    Declination,
    Distance,
    Duration,
    Fraction,
    Fractions,
    Length,
    Magnitude,
    Number,
    Position,
    RightAscension,
    Seed,
    Several,
    Signed,
    Spin,
    TableConfig,
    Temperature,
    Three,
    Whole,
    above,
    within,
)
from skysim.core.yaml_reader import ExistingFile

# The scene section `light.air`: the atmosphere between the camera of a sky scene and the stars.

NEGLIGIBLE_PX = 0.02  # a blur of this sigma makes an image of 0.7 px wider by 0.0003 px
Altitude = Annotated[Number, Field(ge=0, lt=90)]
Darkness = Annotated[Number, within(10, 30)]  # of a sky, mag/arcsec²


class HorizonConfig(TableConfig):
    """A skyline: apparent altitudes below which nothing is visible, by azimuth from north through east.

    The altitude is linear between the azimuths, also from the last row to the first.
    """

    azimuth_deg: Several[RightAscension]
    altitude_deg: Several[Altitude]


class AirGlowConfig(ConfigModel):
    """The glow of the sky at the scene's time and place.

    Attributes
    ----------
    dark_mag_arcsec2
        V surface brightness of the moonless night sky at the zenith
    moonlight, twilight
        Whether there is scattered light of the Moon and of the Sun
    """

    dark_mag_arcsec2: Darkness = 21.7
    moonlight: bool = True
    twilight: bool = True


class AirConfig(ConfigModel):
    """The atmosphere over `site`.

    Attributes
    ----------
    pressure_hpa, temperature_c
        Pressure and temperature at the site; those of the standard atmosphere at the site's height if left out
    humidity
        Relative humidity, 0 to 1
    wavelength
        Wavelength of the refraction; the mean of a G2 star's photo-electrons if left out
    extinction_mag
        Extinction k' at the zenith in the camera's band
    color_extinction_mag
        Color coefficient k'': a star loses (k' + k'' (B-V)) mag for each air mass
    dispersion
        Whether each star is refracted by its own color, or all by `wavelength`
    scintillation
        Whether stars scintillate
    seeing_arcsec
        Full width at half maximum of a star's image at the zenith in a long exposure
    horizon
        Skyline; altitude 0 at all azimuths if left out
    glow
        Sky, twilight and moonlight; none if left out
    """

    pressure_hpa: Annotated[Number, within(0, 1100)] | None = None
    temperature_c: Annotated[Number, within(-80, 50)] | None = None
    humidity: Fraction = 0.5
    wavelength_m: Annotated[Length, within(300e-9, 2e-6)] | None = None
    extinction_mag: Annotated[Number, within(0, 5)] = 0.172
    color_extinction_mag: Annotated[Number, within(-1, 1)] = 0.0
    dispersion: bool = False
    scintillation: bool = True
    seeing_arcsec: Annotated[Number, within(0, 20)] = 0.0
    horizon: HorizonConfig | None = None
    glow: AirGlowConfig | None = None

    def seeing_px(self, focal_px: float) -> float:
        """Standard deviation of a star's image at the zenith by the seeing; 0 if it is negligible."""
        sigma_px = math.radians(self.seeing_arcsec / 3600) * (1 / FWHM_PER_SIGMA) * focal_px
        return sigma_px if sigma_px > NEGLIGIBLE_PX else 0.0


# The scene section `thermal`: the temperature of the laboratory and its effects.

Coefficient = Annotated[Number, within(-10_000, 10_000)]
Coefficients = Three[Coefficient]


class SteadyTemperatureConfig(ConfigModel):
    """A constant temperature."""

    kind: Literal["steady"]
    temperature_c: Temperature


class LinearTemperatureConfig(ConfigModel):
    """A temperature that changes evenly from start_c."""

    kind: Literal["linear"]
    start_c: Temperature
    rate_c_h: Annotated[Number, within(-100, 100)]


class SineTemperatureConfig(ConfigModel):
    """A periodic temperature: mean + amplitude sin(2 pi t / period + phase)."""

    kind: Literal["sine"]
    mean_c: Temperature
    amplitude_c: Annotated[Number, above(0, 100)]
    period_s: Duration
    phase_deg: Spin = 0.0


class TemperatureTableConfig(TableConfig):
    """A measured history, linear between its times and constant beyond them."""

    kind: Literal["table"]
    hours: Several[Signed]
    temperature_c: Several[Temperature]


Temperatures = Annotated[
    SteadyTemperatureConfig
    | LinearTemperatureConfig
    | SineTemperatureConfig
    | TemperatureTableConfig,
    BY_KIND,
]


class ThermalConfig(ConfigModel):
    """Thermal motion since survey and calibration, which were at reference_c. It is unknown to the tracker.

    Attributes
    ----------
    temperature
        Temperature of dome, mount and lens over the time since the scene's start
    speed
        Factor by which the history of the temperature is faster than time, so that a short run can have hours of it
    dome_ppm_k
        Linear expansion of the dome with its LEDs from the point at anchor_height above the bearing's center on its
        axis; 70 for acrylic, 12 for steel
    creep
        Displacement of the dome since its survey
    mount_arcsec_k
        Rotation of the camera on the vehicle about the camera's axes
    lens_ppm_k
        Relative change of the focal length
    """

    temperature: Temperatures
    reference_c: Temperature = 20.0
    speed: Annotated[Number, within(1, 1e5)] = 1.0
    dome_ppm_k: Coefficient = 0.0
    anchor_height_m: Length = 0.0
    creep_m: Position = ZEROS
    mount_arcsec_k: Coefficients = ZEROS
    lens_ppm_k: Coefficient = 0.0

    @property
    def has_effect(self) -> bool:
        """Whether anything depends on the temperature."""
        return bool(self.dome_ppm_k or any(self.mount_arcsec_k) or self.lens_ppm_k)

    def check(self) -> None:
        if not self.has_effect:
            raise InputError(
                "",
                "nothing depends on the temperature",
                "dome_ppm_k, mount_arcsec_k or lens_ppm_k, or no thermal",
            )


# The scene sections `orbit`, with the Earth's light and exclusion angles, and `light.satellites`.

ExclusionAngle = Annotated[Number, Field(ge=0, lt=180)]
Rate = Annotated[Number, above(0, 30)]


class RandomSatellitesConfig(ConfigModel):
    """Sunlit satellites on random paths anywhere in the field and in any direction, drawn for each frame.

    Attributes
    ----------
    per_field
        Mean number in the camera's field (the circle around its detector) at any time
    rate_deg_s
        Least and greatest angular rate relative to the stars; its logarithm is uniformly distributed
    v_mag
        Least and greatest V magnitude, uniformly distributed
    seed
        Seed of these draws, together with the scene's seed
    """

    per_field: Annotated[Number, above(0, 1000)]
    rate_deg_s: tuple[Rate, Rate] = (0.05, 1.5)
    v_mag: tuple[Magnitude, Magnitude] = (2.0, 8.0)
    seed: Seed

    def check(self) -> None:
        for name in ("rate_deg_s", "v_mag"):
            low, high = getattr(self, name)
            if low > high:
                raise InputError(
                    name, f"{low:g} is above {high:g}", "the least, then the greatest"
                )


class SatellitesConfig(ConfigModel):
    """Artificial satellites, seen from the scene's `orbit`, or from `site` with its longitude.

    Attributes
    ----------
    file
        File of mean elements: TLE, or OMM as CSV, XML or JSON
    standard_mag
        V magnitude of all satellites of the file at a range of 1000 km and a phase angle of 90 degrees
    random
        Further satellites on random paths
    """

    file: ExistingFile | None = None
    standard_mag: Magnitude = 6.0
    random: RandomSatellitesConfig | None = None

    def check(self) -> None:
        if self.file is None and self.random is None:
            raise InputError("", "no satellite is left", "file or random, or no satellites")


class ExclusionConfig(ConfigModel):
    """Limits of the tracker's use in its orbit, for `skysim availability`.

    Attributes
    ----------
    sun_deg, moon_deg
        Least angles of the boresight from the centers of Sun and Moon
    earth_deg
        Least angle of the boresight from the Earth's limb
    stars
        Least number of stars to `tracker.limit_mag` in a round field of the detector's area
    """

    sun_deg: ExclusionAngle = 0.0
    earth_deg: ExclusionAngle = 0.0
    moon_deg: ExclusionAngle = 0.0
    stars: Whole = 4


class EarthConfig(ConfigModel):
    """The Earth's light in the field: lit ground, the air above its limb, and the airglow.

    Attributes
    ----------
    albedo
        Albedo of the ground with its clouds
    airglow_mag_arcsec2
        V surface brightness of the airglow layer seen vertically from above
    """

    albedo: Fraction = 0.3
    airglow_mag_arcsec2: Darkness = 22.0


class OrbitConfig(ConfigModel):
    """The camera's orbit about the Earth: keys common to all kinds.

    Attributes
    ----------
    earth
        Light of the Earth; if left out, the Earth is dark but hides stars
    exclusion
        Limits of the tracker's use; none if left out
    """

    earth: EarthConfig | None = None
    exclusion: ExclusionConfig | None = None


class CircularOrbitConfig(OrbitConfig):
    """An orbit in GCRS axes that is circular at the scene's start and precesses by the Earth's flattening (J2).

    Attributes
    ----------
    altitude
        Height above the Earth's equatorial radius, 6378.137 km
    argument_deg
        Angle from the ascending node to the camera at start_time
    """

    kind: Literal["circular"]
    altitude_m: Annotated[Distance, within(100e3, 1e9)]
    inclination_deg: AxisAngle
    raan_deg: Spin = 0.0
    argument_deg: Spin = 0.0


class TleOrbitConfig(OrbitConfig):
    """An orbit of mean elements (SGP4): a TLE, or an OMM as CSV, XML or JSON.

    Attributes
    ----------
    number
        Catalog number of the satellite, for a file of several satellites
    """

    kind: Literal["tle"]
    file: ExistingFile
    number: Annotated[int, within(0, 999_999_999)] | None = None


class OemOrbitConfig(OrbitConfig):
    """An orbit of a CCSDS Orbit Ephemeris Message (OEM) in keyword = value notation."""

    kind: Literal["oem"]
    file: ExistingFile


Orbit = Annotated[CircularOrbitConfig | TleOrbitConfig | OemOrbitConfig, BY_KIND]


# The scene section `background`: glow.


ZenithDistance = Altitude


class UniformGlowConfig(ConfigModel):
    """Uniform glow: e_s electrons per second in every pixel (a light leak, a lit room)."""

    kind: Literal["uniform"]
    e_s: Annotated[Number, within(0, 1e12)]


class SkyGlowConfig(ConfigModel):
    """Surface brightness of the night sky at the boresight, with a relative gradient along the axes of the image."""

    kind: Literal["sky"]
    mag_arcsec2: Annotated[Number, within(0, 30)]
    gradient_per_deg: tuple[Coefficient, Coefficient] = (0.0, 0.0)


class MoonGlowConfig(ConfigModel):
    """Moonlight scattered by the atmosphere (Krisciunas & Schaefer 1991), with the Moon at ra_deg, dec_deg.

    Attributes
    ----------
    phase_angle_deg
        Phase angle: 0 at full moon, 90 at the quarters
    extinction_mag
        Extinction of the atmosphere at the zenith, in V
    moon_zenith_deg, field_zenith_deg
        Zenith distances of the Moon and of the boresight
    """

    kind: Literal["moon"]
    ra_deg: RightAscension
    dec_deg: Declination
    phase_angle_deg: AxisAngle
    extinction_mag: Annotated[Number, within(0, 2)] = 0.172
    moon_zenith_deg: ZenithDistance
    field_zenith_deg: ZenithDistance


class StrayLightConfig(TableConfig):
    """Stray light of a bright body outside the field, by the point source transmittance of baffle and lens.

    Attributes
    ----------
    ra_deg, dec_deg
        Direction of the body in the lab's axes (under the stars those of the ICRS)
    v_mag
        V magnitude of the body; the Sun's -26.74 if left out
    angle_deg, pst
        Irradiance on the detector over irradiance before the lens, by the angle from the boresight
    """

    kind: Literal["stray"]
    ra_deg: RightAscension
    dec_deg: Declination
    v_mag: Magnitude = SUN_V_MAG
    angle_deg: Several[AxisAngle]
    pst: Fractions


class FaintStarsGlowConfig(ConfigModel):
    """Light of all stars fainter than a V magnitude, by galactic latitude, for skies of kind stars.

    Attributes
    ----------
    fainter_than_mag
        Faintest magnitude of the catalog, or its limit_mag
    """

    kind: Literal["faint_stars"]
    fainter_than_mag: Annotated[Number, within(6, 15)]


class ZodiacalGlowConfig(ConfigModel):
    """Sunlight scattered by interplanetary dust, for skies of kind stars.

    Attributes
    ----------
    sun_longitude_deg
        Ecliptic longitude of the Sun, 0 at the March equinox, 90 at the June solstice
    """

    kind: Literal["zodiacal"]
    sun_longitude_deg: RightAscension


Glow = Annotated[
    UniformGlowConfig
    | SkyGlowConfig
    | MoonGlowConfig
    | StrayLightConfig
    | FaintStarsGlowConfig
    | ZodiacalGlowConfig,
    BY_KIND,
]
