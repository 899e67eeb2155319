"""Physical constants and conversion factors, each with its unit in the name and its source.

The estimator has its own constants (`estimator/core/constants.py`), so that an error here cannot cancel there. Times
and epochs are in `skysim/core/time.py`. A number that only one formula uses is defined next to the formula.
"""

import math

# Fundamental: exact by the definition of the SI (BIPM 2019; CODATA 2018).
SPEED_OF_LIGHT_M_S = 299_792_458.0
PLANCK_J_S = 6.62607015e-34
BOLTZMANN_J_K = 1.380649e-23
LUMINOUS_EFFICACY_LM_W = 683.0  # of light at 540 THz, 555 nm
STANDARD_GRAVITY_M_S2 = 9.80665  # CGPM 1901
ZERO_CELSIUS_K = 273.15
STANDARD_PRESSURE_HPA = 1013.25  # one atmosphere, CGPM 1954
STANDARD_TEMPERATURE_K = 288.15  # at sea level, International Standard Atmosphere (ISO 2533)

# Angles and lengths.
ARCSEC_RAD = math.pi / 180 / 3600
MAS_RAD = math.pi / 180 / 3.6e6
ARCSEC_DEG = 1 / 3600
ARCSEC2_SR = ARCSEC_RAD**2
GOLDEN_ANGLE_RAD = math.pi * (
    3 - math.sqrt(5)
)  # between successive azimuths of a Fibonacci spiral
INCH_M = 0.0254  # exact: international yard and pound agreement, 1959
PPM = 1e-6

# Times and rates.
HOUR_S = 3600.0
DAY_S = 86_400.0
JULIAN_YEAR_DAY = 365.25  # IAU
RPM_RAD_S = math.pi / 30  # one revolution per minute in rad/s
DEG_H_RAD_S = math.radians(1) / 3600  # one degree per hour in rad/s

# The Earth: WGS 84 (NGA.STND.0036), J2 of EGM2008.
EARTH_RADIUS_M = 6_378_137.0  # at the equator
EARTH_FLATTENING = 1 / 298.257223563
EARTH_MU_M3_S2 = 3.986004418e14  # with the atmosphere
EARTH_J2 = 1.08262668e-3
EARTH_RATE_RAD_S = 7.292115e-5  # sidereal, 15.041 deg/h

# The solar system.
AU_M = 149_597_870_700.0  # exact: IAU 2012, resolution B2
AU_KM = AU_M / 1e3
SPEED_OF_LIGHT_KM_S = SPEED_OF_LIGHT_M_S / 1e3
SPEED_OF_LIGHT_AU_DAY = DAY_S / (AU_M / SPEED_OF_LIGHT_M_S)
SUN_V_MAG = -26.74  # at 1 au (Allen 1976, Astrophysical Quantities)

# Statistics.
FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))  # of a Gaussian
MAD_PER_SIGMA = (
    0.6745  # median absolute deviation of a normal distribution, its upper quartile
)
SIGMA_PER_MAD = 1.4826  # the reciprocal
