"""The estimator's own constants, each with its unit in the name and its source.

They are kept apart from the simulator's on purpose: an error in one is not hidden by the other.
"""

import datetime

import numpy as np

SPEED_OF_LIGHT_M_S = 299_792_458.0  # exact: SI
SUN_DEFLECTION_RAD = 1.974e-8  # 2 G M_sun / (c^2 1 au): IAU 2015 B3, IAU 2012 B2
ZERO_CELSIUS_K = 273.15
STANDARD_PRESSURE_HPA = 1013.25  # one atmosphere
STANDARD_TEMPERATURE_K = 288.15  # of Edlen's refractivity: 15 C
ARCSEC_RAD = np.pi / 180 / 3600
MAS_RAD = np.pi / 180 / 3.6e6
INCH_M = 0.0254  # exact: international yard and pound agreement, 1959
# Standard deviation of a normal distribution over its median absolute deviation.
SIGMA_PER_MAD = 1.4826

DAY_S = 86_400.0
JULIAN_YEAR_DAY = 365.25
JULIAN_CENTURY_DAY = 36_525.0
J2000 = datetime.datetime(2000, 1, 1, 12)
J2000_JD = 2451545.0
# Since 2017 (IERS Bulletin C). The leap seconds before that are left out: each is 4 microarcseconds of aberration.
TT_MINUS_UTC_S = 69.184
