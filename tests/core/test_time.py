"""Time scales are astropy's, at dates before and after each kind of leap second, and ERFA's epochs."""

from __future__ import annotations

import datetime
import warnings

import erfa
import numpy as np
import pytest
from astropy import units as u
from astropy.time import Time
from astropy.utils import iers

from estimator.core import constants as believed
from skysim.core import time
from skysim.core.constants import DAY_S

DATES = (
    "1962-05-01T12:00:00",  # UTC drifted from TAI
    "1971-12-31T23:59:59.9",
    "1972-01-01T00:00:00",
    "1972-07-01T00:00:00",
    "1985-06-30T23:59:59",
    "1999-01-01T00:00:00",
    "2012-06-22T21:00:00",
    "2012-07-01T00:00:00.000001",
    "2016-12-31T23:59:59.999999",
    "2017-01-01T00:00:00",
    "2024-02-29T12:34:56.789",
)
# No UTC yet; leap seconds to come.
UNKNOWN = ("1905-01-01T00:00:00", "2030-01-01T00:00:00", "2099-12-31T23:59:59")


@pytest.mark.parametrize("text", DATES + UNKNOWN)
def test_terrestrial_time_matches_astropy(text: str) -> None:
    date = datetime.datetime.fromisoformat(text)
    theirs = astropy_time(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        tt = theirs.tt
        tai = theirs.tai
    days = (tt.jd1 - erfa.DJ00) + tt.jd2
    assert DAY_S * (time.tt_days(date) - days) == pytest.approx(0, abs=2e-6)
    assert DAY_S * (time.tt_jd(date) - tt.jd) == pytest.approx(0, abs=1e-4)
    # The same calendar date in a scale without leap seconds: astropy stretches a UTC day that has one.
    uniform = Time(text, scale="tai")
    assert DAY_S * (time.utc_jd(date) - uniform.jd) == pytest.approx(0, abs=1e-4)
    assert time.tai_minus_utc_s(date) == pytest.approx((tai - uniform).sec, abs=1e-6)


def test_dynamical_time_differs_from_tt_by_less_than_two_milliseconds() -> None:
    dates = Time("2000-01-01", scale="tt") + np.arange(0, 3000, 7.0) * u.day
    tdb_minus_tt_s = DAY_S * ((dates.tdb.jd1 - dates.jd1) + (dates.tdb.jd2 - dates.jd2))
    assert 1.5e-3 < np.abs(tdb_minus_tt_s).max() < 2e-3


def test_leap_seconds_match_the_iers() -> None:
    for date, seconds in {
        "1972-01-01": 10,
        "1999-01-01": 32,
        "2016-12-31": 36,
        "2017-01-01": 37,
        "2030-01-01": 37,
    }.items():
        assert time.tai_minus_utc_s(datetime.datetime.fromisoformat(date)) == seconds


def test_the_earths_rotation_matches_astropy_within_the_iers_table() -> None:
    with iers.earth_orientation_table.set(iers.IERS_B.open()):
        for text in (
            "1972-08-01T06:00:00",
            "1998-03-02T03:04:05",
            "2012-06-22T21:00:00",
            "2020-11-05T18:00:00",
        ):
            date = datetime.datetime.fromisoformat(text)
            assert DAY_S * (time.ut1_jd(date) - astropy_time(text).ut1.jd) == pytest.approx(
                0, abs=1e-4
            )
    for text in UNKNOWN:
        date = datetime.datetime.fromisoformat(text)
        assert time.ut1_jd(date) == time.utc_jd(date)


def test_epochs_match_erfa() -> None:
    assert (time.J2000_JD, time.MJD_ZERO_JD) == (erfa.DJ00, erfa.DJM0)
    assert Time(time.J2000, scale="tt").jd == time.J2000_JD
    assert (
        erfa.TTMTAI,
        (Time(0, format="gps").tai - Time("1980-01-06T00:00:00", scale="tai")).sec,
    ) == pytest.approx((time.TT_MINUS_TAI_S, -time.GPS_MINUS_TAI_S), abs=1e-9)


def test_the_estimators_epochs_match_erfa_and_its_leap_seconds_are_current() -> None:
    assert (believed.J2000, believed.J2000_JD) == (time.J2000, erfa.DJ00)
    assert (
        pytest.approx(time.tt_minus_utc_s(datetime.datetime(2026, 1, 1)), abs=1e-12)
        == believed.TT_MINUS_UTC_S
    )


def test_naive_times_equal_utc_times() -> None:
    naive = datetime.datetime(2024, 2, 29, 12)
    zoned = datetime.datetime(
        2024, 2, 29, 17, 30, tzinfo=datetime.timezone(datetime.timedelta(hours=5.5))
    )
    assert time.tt_days(naive) == time.tt_days(zoned)
    # JD 2460370.0 is 2024-02-29 12:00; TT is 69.184 s ahead of UTC.
    assert time.tt_days(naive) == pytest.approx(
        2460370.0 - 2451545.0 + 69.184 / 86400, abs=1e-9
    )


def test_a_year_out_of_range_is_refused() -> None:
    for year in (1899, 2101):
        with pytest.raises(ValueError, match="is outside 1900 to 2100"):
            time.check_year(datetime.datetime(year, 6, 1))
    zoned = datetime.datetime(
        2100, 6, 1, 2, tzinfo=datetime.timezone(datetime.timedelta(hours=2))
    )
    assert time.check_year(zoned) == datetime.datetime(2100, 6, 1)


def astropy_time(text: str) -> Time:
    """A UTC date, without the warning of leap seconds that are not known."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        return Time(text, scale="utc")
