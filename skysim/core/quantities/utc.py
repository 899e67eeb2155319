"""Dates and times: UTC, without a zone."""

from __future__ import annotations

import datetime

from skysim.core.errors import InputError


def in_utc(moment: datetime.datetime) -> datetime.datetime:
    """The moment in UTC, without a zone; a naive datetime is in UTC already."""
    return moment if moment.tzinfo is None else moment.astimezone(datetime.UTC).replace(tzinfo=None)


def check_year(value: datetime.datetime) -> datetime.datetime:
    """UTC without a zone. The Earth's ephemeris and linear proper motion are valid for about a century."""
    if not 1900 <= value.year <= 2100:
        raise InputError("", f"{value.isoformat()} is outside 1900 to 2100")
    return in_utc(value)
