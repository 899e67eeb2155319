"""Time scales: UTC, TAI, TT and UT1 of a date, as Julian dates and as days from J2000.0.

    TAI = UTC + leap seconds,    TT = TAI + 32.184 s,    GPS = TAI - 19 s

TT also serves as TDB: they differ by less than 2 ms, in which the Moon moves by 0.001" and the Earth's velocity changes
by 0.01 mm/s. Sources: IERS Conventions 2010, chapter 10; IS-GPS-200.
"""

import datetime
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator

from skysim.core.constants import DAY_S
from skysim.core.errors import InputError
from skysim.core.types import Floats

# The calendar date of J2000.0, in the time scale that is counted from it.
J2000 = datetime.datetime(2000, 1, 1, 12)
J2000_JD = 2451545.0
MJD_ZERO_JD = 2400000.5
DAY = datetime.timedelta(days=1)
TT_MINUS_TAI_S = 32.184
GPS_MINUS_TAI_S = -19.0
# Scales of astropy by time systems of CCSDS; GPS is an offset from TAI.
SCALES = {"UTC": "utc", "TAI": "tai", "TT": "tt", "TDB": "tdb", "GPS": "tai"}


def in_utc(moment: datetime.datetime) -> datetime.datetime:
    """The moment in UTC, without a time zone; a datetime without a time zone is in UTC."""
    return (
        moment
        if moment.tzinfo is None
        else moment.astimezone(datetime.UTC).replace(tzinfo=None)
    )


def check_year(value: datetime.datetime) -> datetime.datetime:
    """The date in UTC, without a time zone. Raises InputError outside of 1900 to 2100.

    The Earth's ephemeris and linear proper motion are valid for about a century.
    """
    if not 1900 <= value.year <= 2100:
        raise InputError("", f"{value.isoformat()} is outside 1900 to 2100")
    return in_utc(value)


def date_of(value: Any) -> Any:
    """A date from YAML or an ISO text. Raises InputError for others; pydantic takes a number for seconds since 1970."""
    if isinstance(value, datetime.date):
        return value
    try:
        return datetime.datetime.fromisoformat(value)
    except (TypeError, ValueError):
        raise InputError(
            "",
            f"{value!r} is not a date",
            "an ISO date, or date and time: 2012-06-21 03:00:00",
        ) from None


Moment = Annotated[datetime.datetime, BeforeValidator(date_of), AfterValidator(check_year)]


def tai_minus_utc_s(time: datetime.datetime) -> float:
    """TAI - UTC by ERFA's table of leap seconds, whose last value is used for later dates; 0 before 1960."""
    import erfa

    moment = in_utc(time)
    midnight = datetime.datetime(moment.year, moment.month, moment.day)
    # The ufunc does not warn that later leap seconds are unknown and that there was no UTC before 1960.
    seconds, _status = erfa.ufunc.dat(
        moment.year, moment.month, moment.day, (moment - midnight) / DAY
    )
    return float(seconds)


def tt_minus_utc_s(time: datetime.datetime) -> float:
    """TT - UTC: 69.184 s since 2017."""
    return tai_minus_utc_s(time) + TT_MINUS_TAI_S


def utc_days(time: datetime.datetime) -> float:
    """UTC as days from J2000.0, exact to a microsecond; a Julian date in one number is exact to 40 us."""
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
    """UT1, the Earth's rotation, as a Julian date from the IERS table in astropy; UTC outside of the table.

    There UT1 - UTC is below 0.9 s by the definition of UTC; a second of time is 0.24" of the Moon's place.
    """
    mjd, ut1_minus_utc_s = ut1_table()
    utc = utc_jd(time)
    offset_s = np.interp(utc - MJD_ZERO_JD, mjd, ut1_minus_utc_s, left=0.0, right=0.0)
    return utc + float(offset_s) / DAY_S


@lru_cache(maxsize=1)
def ut1_table() -> tuple[Floats, Floats]:
    """Modified Julian dates (UTC) and UT1 - UTC in s; interpolation between two days also smooths a leap second."""
    from astropy.utils import iers

    table = iers.IERS_B.open()
    return np.asarray(table["MJD"].value), np.asarray(table["UT1_UTC"].value)
