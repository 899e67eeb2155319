"""Time scales: UTC, TAI, TT and UT1 of a date, as Julian dates and as days from J2000.0.

TT = TAI + 32.184 s, and TAI = UTC + leap seconds. TT stands for TDB too: they differ by less than 2 ms, in which the
Moon moves by 0.001" and the Earth's velocity changes by 0.01 mm/s. GPS time is TAI - 19 s. Sources: IERS Conventions
2010, chapter 10; IS-GPS-200.
"""

from __future__ import annotations

import datetime
from functools import lru_cache

import numpy as np

from skysim.core.constants import DAY_S
from skysim.core.errors import InputError
from skysim.core.types import Floats

J2000 = datetime.datetime(
    2000, 1, 1, 12
)  # the calendar date of J2000.0, in the scale that is counted from it
J2000_JD = 2451545.0
MJD_ZERO_JD = 2400000.5
DAY = datetime.timedelta(days=1)
TT_MINUS_TAI_S = 32.184
GPS_MINUS_TAI_S = -19.0
SCALES = {
    "UTC": "utc",
    "TAI": "tai",
    "TT": "tt",
    "TDB": "tdb",
    "GPS": "tai",
}  # astropy's, by CCSDS's time systems


def in_utc(moment: datetime.datetime) -> datetime.datetime:
    """The moment in UTC, without a zone; a naive datetime is in UTC already."""
    return moment if moment.tzinfo is None else moment.astimezone(datetime.UTC).replace(tzinfo=None)


def check_year(value: datetime.datetime) -> datetime.datetime:
    """UTC without a zone. The Earth's ephemeris and linear proper motion are valid for about a century."""
    if not 1900 <= value.year <= 2100:
        raise InputError("", f"{value.isoformat()} is outside 1900 to 2100")
    return in_utc(value)


def tai_minus_utc_s(time: datetime.datetime) -> float:
    """TAI - UTC by ERFA's table of leap seconds, whose last value holds from then on; 0 before 1960, as in ERFA."""
    import erfa

    moment = in_utc(time)
    midnight = datetime.datetime(moment.year, moment.month, moment.day)
    # The function without its warnings: later leap seconds are unknown, and before 1960 there was no UTC.
    seconds, _status = erfa.ufunc.dat(
        moment.year, moment.month, moment.day, (moment - midnight) / DAY
    )
    return float(seconds)


def tt_minus_utc_s(time: datetime.datetime) -> float:
    """TT - UTC: 69.184 s since 2017."""
    return tai_minus_utc_s(time) + TT_MINUS_TAI_S


def utc_days(time: datetime.datetime) -> float:
    """UTC as days from J2000.0: exact to a microsecond, which a Julian date in one number is not (40 us)."""
    return (in_utc(time) - J2000) / DAY


def tt_days(time: datetime.datetime) -> float:
    """Terrestrial Time as days from J2000.0."""
    return (in_utc(time) + datetime.timedelta(seconds=tt_minus_utc_s(time)) - J2000) / DAY


def utc_jd(time: datetime.datetime) -> float:
    """UTC as a Julian date."""
    return J2000_JD + utc_days(time)


def tt_jd(time: datetime.datetime) -> float:
    """Terrestrial Time as a Julian date."""
    return utc_jd(time) + tt_minus_utc_s(time) / DAY_S


def ut1_jd(time: datetime.datetime) -> float:
    """The Earth's rotation as a Julian date, from the table of the IERS that comes with astropy; UTC outside of it.

    A second of time is 0.24" of the Moon's place; beyond the table UT1 - UTC is below 0.9 s by definition of UTC.
    """
    mjd, ut1_minus_utc_s = ut1_table()
    utc = utc_jd(time)
    return (
        utc + float(np.interp(utc - MJD_ZERO_JD, mjd, ut1_minus_utc_s, left=0.0, right=0.0)) / DAY_S
    )


@lru_cache(maxsize=1)
def ut1_table() -> tuple[Floats, Floats]:
    """Modified Julian dates (UTC) and UT1 - UTC in s; between two days a leap second would be interpolated."""
    from astropy.utils import iers

    table = iers.IERS_B.open()
    return np.asarray(table["MJD"].value), np.asarray(table["UT1_UTC"].value)
