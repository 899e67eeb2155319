"""Catalog stars as sources: apparent directions at a date, and photo-electrons per square meter of the aperture."""

import datetime
from dataclasses import replace
from typing import Any

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.constants import (
    ARCSEC_RAD,
    JULIAN_YEAR_DAY,
    SPEED_OF_LIGHT_AU_DAY,
    SPEED_OF_LIGHT_M_S,
)
from skysim.core.random_streams import VARIABLE_STARS, random_stream
from skysim.core.time import J2000_JD, tt_days
from skysim.core.types import (
    Floats,
    Ints,
    Sources,
    StarSources,
    around_z,
    homogeneous,
    normalized,
)
from skysim.sources.catalog import Catalog
from skysim.sources.photometry import Band, Reals, star_chromatic, star_flux_e_s_m2

LAST_HIPPARCOS = 120_416  # number of the catalog's last star
AT_REST = (0.0, 0.0, 0.0)  # velocity of an observer at the Earth's center


def apparent(
    catalog: Catalog,
    time: datetime.datetime,
    observer_velocity_m_s: Floats | tuple[float, ...] = AT_REST,
) -> Floats:
    """Apparent directions of stars: proper motion, annual parallax, light deflection and aberration.

    Returns (N, 3) unit vectors in ICRS axes.

    1. Proper motion and annual parallax (up to 0.75", alpha Centauri), `erfa.pmpx`.
    2. The Sun's deflection of light (4 mas at 90 degrees, 1.7" at its limb), `erfa.ldsun`.
    3. Aberration by the observer's barycentric velocity (up to 20.5"), `erfa.ab`; the Earth's from `erfa.epv00`.

    Neglected: radial velocity (not in the catalog, < 2 mas in 35 years except for a handful of stars), the planets'
    deflection, the observer's distance from the Earth's center (< 0.04 mas).
    Source: IERS Conventions 2010, chapters 5 and 7; the SOFA routines of these names.

    Parameters
    ----------
    time
        UTC (a naive datetime is UTC)
    observer_velocity_m_s
        (3,) velocity relative to the Earth's center, ICRS axes; an orbit's 7.6 km/s is 5.2", the ground's 0.46 km/s is
        0.3"
    """
    tt_day = tt_days(time)
    # The Earth's position and velocity in au and au/day; TT for TDB is 2 ms off.
    heliocentric, barycentric = erfa.epv00(J2000_JD, tt_day)
    years = tt_day / JULIAN_YEAR_DAY + 2000.0 - catalog.epoch_jyear
    # 1. SOFA takes the rate of right ascension itself, without cos(delta).
    geometric = erfa.pmpx(
        catalog.ra_rad,
        catalog.dec_rad,
        catalog.pm_ra_rad_yr / np.cos(catalog.dec_rad),
        catalog.pm_dec_rad_yr,
        catalog.parallax_rad / ARCSEC_RAD,
        0.0,
        years,
        barycentric["p"],
    )
    # 2. Deflection.
    sun_au = float(np.linalg.norm(heliocentric["p"]))
    deflected = erfa.ldsun(geometric, heliocentric["p"] / sun_au, sun_au)
    # 3. Aberration.
    own_beta = np.asarray(observer_velocity_m_s, dtype=float) / SPEED_OF_LIGHT_M_S
    beta = barycentric["v"] / SPEED_OF_LIGHT_AU_DAY + own_beta
    apparent_direction = erfa.ab(deflected, beta, sun_au, np.sqrt(1.0 - beta @ beta))
    return normalized(apparent_direction)


def varied(stars: Catalog, seed: int) -> Catalog:
    """The stars with the magnitudes of variable ones drawn about their means, at one time.

    The draw is normal, with the standard deviation that Hipparcos saw over three years, and belongs to the star's
    Hipparcos number: the same star has the same magnitude whatever the catalog's limit. The colors stay.
    """
    # Every Hipparcos number has a draw; stars with other numbers share draw 0, and do not vary.
    draws = random_stream(seed, VARIABLE_STARS).standard_normal(LAST_HIPPARCOS + 1)
    numbered = np.where(stars.hip <= LAST_HIPPARCOS, stars.hip, 0)
    return replace(stars, v_mag=stars.v_mag + stars.scatter_mag * draws[numbered])


def seen_at_velocity(apparent_direction: Floats, from_m_s: Floats, to_m_s: Floats) -> Floats:
    """Apparent directions (N, 3) of stars for another velocity of the observer.

    The aberration of the first velocity is undone by that of its opposite, then that of the second is applied
    (`erfa.ab`).

    Parameters
    ----------
    from_m_s, to_m_s
        (3,) barycentric velocities, before and after
    """
    direction = apparent_direction
    for beta in (
        -np.asarray(from_m_s) / SPEED_OF_LIGHT_M_S,
        np.asarray(to_m_s) / SPEED_OF_LIGHT_M_S,
    ):
        direction = erfa.ab(direction, beta, 1.0, np.sqrt(1.0 - beta @ beta))
    return direction


def sources(
    stars: Catalog,
    time: datetime.datetime,
    limit_mag: float | None,
    lab_from_icrs: Rotation,
    band: Band,
    observer_velocity_m_s: Floats | tuple[float, ...] = AT_REST,
) -> Sources:
    """The stars to a limiting magnitude as steady points at infinity.

    Returns Sources in lab axes: place is (direction, 0), strength photo-electrons s^-1 m^-2 from V and both colors.

    Parameters
    ----------
    limit_mag
        Faintest Johnson V that is kept; None keeps all stars
    lab_from_icrs
        Rotation from the ICRS to the lab's axes at that time
    band
        Response of the camera
    observer_velocity_m_s
        As in `apparent`
    """
    # Only the stars that are drawn are transformed.
    selected = stars.to_limit(limit_mag)
    # A catalog without stars to this limit has no directions to compute.
    direction = np.zeros((0, 3))
    if len(selected):
        direction = lab_from_icrs.apply(apparent(selected, time, observer_velocity_m_s))
    flux = star_flux_e_s_m2(selected.v_mag, selected.b_v, selected.v_i, band)
    colors = star_chromatic(selected.b_v, selected.v_i, band)
    return steady_points(selected.hip, direction, flux, selected.v_mag, colors)


def steady_points(
    ids: Ints,
    direction: Floats,
    flux_e_s_m2: Floats,
    magnitude: Floats,
    chromatic: Floats | None = None,
) -> StarSources:
    """Steady points of light at infinity: (N, 3) unit vectors, (N,) photo-electrons s^-1 m^-2 and V magnitudes.

    Parameters
    ----------
    chromatic
        (N, 4) as in `Sources`
    """
    count = len(ids)
    zeros = np.zeros(count)
    ones = np.ones(count)
    return StarSources(
        id=ids,
        # Contiguous: rows are taken from it.
        place=np.ascontiguousarray(homogeneous(direction, 0.0)),
        normal=np.zeros((count, 3)),
        radius_m=zeros,
        strength=flux_e_s_m2,
        period_s=ones,
        start_s=zeros,
        on_s=ones,
        clock=np.zeros(count, dtype=np.int64),
        magnitude=magnitude,
        chromatic=chromatic,
    )


def sky_axes(ra_rad: Any, dec_rad: Any) -> tuple[Floats, Floats, Floats]:
    """Unit vectors (..., 3) to the east and to the north of directions on the sky, and along them."""
    return axes_about_z(ra_rad, np.sin(dec_rad), np.cos(dec_rad))


def axes_about_z(azimuth_rad: Any, sine: Any, cosine: Any) -> tuple[Floats, Floats, Floats]:
    """Unit vectors (..., 3) to the east and toward z of directions, and along them, from azimuth and elevation."""
    east = np.stack(
        [-np.sin(azimuth_rad), np.cos(azimuth_rad), np.zeros_like(azimuth_rad)], -1
    )
    return east, around_z(-sine, azimuth_rad, cosine), around_z(cosine, azimuth_rad, sine)


def directions(ra_deg: Any, dec_deg: Any) -> Floats:
    """(..., 3) unit vectors of right ascensions and declinations."""
    return sky_axes(np.radians(ra_deg), np.radians(dec_deg))[2]


def cam_from_icrs(ra_deg: Reals, dec_deg: Reals, roll_deg: Reals) -> Rotation:
    """Camera attitude from the boresight's right ascension and declination and the position angle of the image's up.

    Returns cam_from_icrs; its matrix has the camera's x (right), y (down), z (boresight) as rows. Up is
    cos(roll) N + sin(roll) E and x = y × z, so that at roll 0 north is up and east is to the left: the sky is seen from
    inside. At the poles N and E are those of the meridian ra_deg.

    Parameters
    ----------
    ra_deg, dec_deg
        ICRS direction of the boresight, a number or (N,) each
    roll_deg
        Position angle of the image's up (-y) at the boresight, from north through east
    """
    ra, dec, roll = (np.radians(angle) for angle in (ra_deg, dec_deg, roll_deg))
    east, north, z = sky_axes(ra, dec)
    y = -(np.cos(roll)[..., None] * north + np.sin(roll)[..., None] * east)
    return Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=-2))
