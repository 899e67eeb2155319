"""On-board star catalog: read a star list and compute apparent unit vectors, independently of the simulator.

`read` parses an ECSV file, and `StarCatalog.from_radec` takes arrays. `apparent` applies proper motion, parallax, light
deflection and aberration for an `Observer`. `merge_doubles` replaces unresolved stars by one at their center of light.
"""

from __future__ import annotations

import datetime
import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from estimator.core import checks
from estimator.core.checks import Floats, Ints, frozen
from estimator.core.constants import (
    DAY_S,
    J2000,
    J2000_JD,
    JULIAN_YEAR_DAY,
    MAS_RAD,
    SPEED_OF_LIGHT_M_S,
    SUN_DEFLECTION_RAD,
    TT_MINUS_UTC_S,
)
from estimator.core.errors import ImageError, file_bytes, reason
from estimator.core.vectors import normalized

EPOCHS_YR = 1800.0, 2200.0  # allowed: linear proper motions are good for a century or two


@frozen
class StarCatalog:
    """Stars as given in the file, at its epoch in the ICRS, brightest first.

    Attributes
    ----------
    id
        (N,) identifiers
    vectors
        (N, 3) unit vectors
    drift_rad_yr
        (N, 3) proper motion in the tangent plane, rad per Julian year
    parallax_rad
        (N,) parallaxes
    v_mag
        (N,) visual magnitudes
    epoch_yr
        Julian year of the vectors
    """

    id: Ints
    vectors: Floats
    drift_rad_yr: Floats
    parallax_rad: Floats
    v_mag: Floats
    epoch_yr: float

    def __len__(self) -> int:
        return len(self.id)

    @classmethod
    def read(cls, path: str | Path) -> StarCatalog:
        """Read an ECSV file, as `skysim catalog build` writes it; see `catalog.read`."""
        return read(path)

    @classmethod
    def from_radec(
        cls,
        ra_deg: ArrayLike,
        dec_deg: ArrayLike,
        v_mag: ArrayLike,
        pm_ra_mas_yr: ArrayLike = 0.0,
        pm_dec_mas_yr: ArrayLike = 0.0,
        parallax_mas: ArrayLike = 0.0,
        *,
        epoch_yr: float = 2000.0,
        id: ArrayLike | None = None,
    ) -> StarCatalog:
        """Build a catalog from arrays of any source: ICRS places at a Julian year, and magnitudes, (N,) each.

        The stars are sorted by brightness.

        Parameters
        ----------
        ra_deg, dec_deg
            Right ascension and declination
        v_mag
            Visual magnitudes
        pm_ra_mas_yr, pm_dec_mas_yr
            Proper motions; that in right ascension is times cos(dec), as Hipparcos and Gaia give it
        parallax_mas
            Parallaxes
        epoch_yr
            Julian year of the places
        id
            (N,) whole numbers; None: 1 to N in the order given

        Raises
        ------
        ImageError
            For arrays of other lengths, places out of range, and values that look like radians.
        """
        count = checks.native("catalog: v_mag", v_mag, np.float64).size
        given = ra_deg, dec_deg, pm_ra_mas_yr, pm_dec_mas_yr, parallax_mas, v_mag
        # One motion or parallax, in mas, may be that of all stars.
        ra, dec, *others = (
            _column(name, value, count, "_mas" in name)
            for name, value in zip(COLUMNS[1:], given, strict=True)
        )
        epoch_yr = checks.number(
            "catalog: epoch_yr", epoch_yr, *EPOCHS_YR, "a Julian year of 1800 to 2200"
        )
        _check_places(ra, dec)
        numbers = np.arange(1, count + 1)
        if id is not None:
            numbers = checks.row_numbers("catalog: id", id, 2**63 - 1)
        if len(numbers) != count:
            raise ImageError(
                f"catalog: id has {len(numbers)} numbers; allowed: {count}, one a star"
            )
        return from_columns(numbers, ra, dec, *others, epoch_yr=epoch_yr).brightest_first()

    def take(self, which: NDArray | slice) -> StarCatalog:
        """Select stars by mask, index or slice; a slice shares the memory."""
        columns = [name for name in self.__dataclass_fields__ if name != "epoch_yr"]
        return replace(self, **{name: getattr(self, name)[which] for name in columns})

    def brightest_first(self) -> StarCatalog:
        """Sort the stars by brightness; equally bright ones keep their order."""
        return self.take(np.argsort(self.v_mag, kind="stable"))


@frozen
class Observer:
    """State of the observer, barycentric, in ICRS axes.

    Attributes
    ----------
    epoch_yr
        Julian year
    position_au, velocity_m_s
        (3,) position and velocity
    """

    epoch_yr: float
    position_au: Floats
    velocity_m_s: Floats


def _column(name: str, value: ArrayLike, count: int, one_for_all: bool) -> Floats:
    """(count,) finite floats; one number for all stars where that is allowed. Raises ImageError otherwise."""
    array = checks.native(f"catalog: {name}", value, np.float64)
    if one_for_all and array.ndim == 0:
        array = np.full(count, array)
    checks.floats(f"catalog: {name}", array, (count,))
    if not np.isfinite(array).all():
        raise ImageError(
            f"catalog: {name} has a NaN or infinity in row {checks.first_bad(np.isfinite(array))}"
        )
    return array


def _check_places(ra_deg: Floats, dec_deg: Floats) -> None:
    """Raise ImageError for places out of range, and for a whole sky in the range of radians."""
    for name, array, low, high in (
        ("ra_deg", ra_deg, -360.0, 360.0),
        ("dec_deg", dec_deg, -90.0, 90.0),
    ):
        good = (array >= low) & (array <= high)
        if not good.all():
            value = array[checks.first_bad(good)]
            raise ImageError(
                f"catalog: {name} is {value:g} in a row; allowed: {low:g} to {high:g} degrees"
            )
    # Many stars that cover the sky in radians, and only a corner of it in degrees.
    turn = 2 * np.pi + 1e-6
    pole = np.pi / 2 + 1e-6
    if (
        len(ra_deg) >= 20
        and 5 < ra_deg.max() <= turn
        and np.ptp(dec_deg) > 1.2
        and np.abs(dec_deg).max() <= pole
    ):
        raise ImageError(
            f"catalog: all ra_deg are below {turn:.4f} and dec_deg below {pole:.4f}; radians?"
        )


def checked(stars: object) -> StarCatalog:
    """The catalog, if its columns are of one length and finite and its vectors of unit length; else ImageError."""
    checks.of_type("stars", stars, StarCatalog)
    assert isinstance(stars, StarCatalog)
    count = len(stars)
    if count == 0:
        raise ImageError(
            "stars: the catalog is empty at this limiting magnitude; allowed: 3 stars or more"
        )
    checks.unit_rows("stars: vectors", stars.vectors, count)
    checks.rows("stars: drift_rad_yr", stars.drift_rad_yr, count, 3)
    for name in ("parallax_rad", "v_mag"):
        _column(name, getattr(stars, name), count, False)
    return stars


def utc(date: object) -> datetime.datetime:
    """A UTC time from ISO 8601 or a datetime, within EPOCHS_YR. Raises ImageError for anything else."""
    try:
        time = datetime.datetime.fromisoformat(date) if isinstance(date, str) else date
    except ValueError:
        raise ImageError(
            f"date: {date!r} is not ISO 8601; allowed: for example 2012-06-22T21:00"
        ) from None
    if (
        not isinstance(time, datetime.datetime)
        or not EPOCHS_YR[0] <= time.year < EPOCHS_YR[1]
    ):
        years = "{:g} to {:g}".format(*EPOCHS_YR)
        raise ImageError(
            f"date: {checks.excerpt(date)}; allowed: a UTC date or datetime of {years}"
        )
    return time


def days_after_j2000(time_utc: datetime.datetime) -> float:
    """Days from J2000.0 to a UTC time (naive means UTC), without leap seconds."""
    if time_utc.tzinfo is not None:
        time_utc = time_utc.astimezone(datetime.UTC).replace(tzinfo=None)
    return (time_utc - J2000) / datetime.timedelta(days=1)


def on_earth(time_utc: datetime.datetime) -> Observer:
    """The observer at the Earth's center at a UTC time (naive means UTC), from the IAU ephemeris `epv00`.

    Raises
    ------
    ImageError
        Without the package pyerfa, which nothing else in the estimator needs.
    """
    try:
        import erfa
    except ImportError:
        message = "a date needs pyerfa (pip install pyerfa); without it: StarTracker(camera, stars, vectors)"
        raise ImageError(message) from None
    # epv00 takes TDB; TT is within 2 ms of it.
    days = days_after_j2000(time_utc) + TT_MINUS_UTC_S / DAY_S
    _, barycentric = erfa.epv00(J2000_JD, days)
    meters_per_second = erfa.DAU / DAY_S
    return Observer(
        2000 + days / JULIAN_YEAR_DAY, barycentric["p"], barycentric["v"] * meters_per_second
    )


def read(path: str | Path) -> StarCatalog:
    """Read a catalog file: ECSV with hip, ra_deg, dec_deg, pm_ra_mas_yr, pm_dec_mas_yr, parallax_mas, v_mag.

    The header gives the epoch, `epoch_jyear`. A file that has not changed is read once.

    Raises
    ------
    ImageError
        If the file cannot be read.
    """
    try:
        state = Path(path).stat()
    except (OSError, TypeError, ValueError):
        return _read.__wrapped__(path)  # raises the error
    return _read(path, state.st_dev, state.st_ino, state.st_mtime_ns)


@functools.lru_cache(maxsize=4)
def _read(path: str | Path, *_state: int) -> StarCatalog:
    """Read a catalog file in a state, and sort the stars by brightness.

    The last four are kept, because reading one takes 0.1 s.
    """
    table, epoch_yr = columns(path, COLUMNS)
    hip, count = np.unique(table[0], return_counts=True)
    if count.max() > 1:
        twice = hip[np.argmax(count)]
        raise ImageError(
            f"{path}: star {twice:.0f} occurs {count.max()} times; allowed: once"
        )
    return from_columns(*table, epoch_yr=epoch_yr).brightest_first()


COLUMNS = (
    "hip",
    "ra_deg",
    "dec_deg",
    "pm_ra_mas_yr",
    "pm_dec_mas_yr",
    "parallax_mas",
    "v_mag",
)


def hipparcos() -> StarCatalog:
    """The Hipparcos-2 subset to Hp 6.5 that comes with the package.

    It is in data/catalogs beside the package in a checkout, in skysim/data/catalogs where skysim is installed, and in
    estimator/data/catalogs where the estimator is installed alone.

    Raises
    ------
    ImageError
        If none of them has it.
    """
    root = Path(__file__).resolve().parents[2]
    name = "data/catalogs/hipparcos_hp6.5.ecsv"
    places = root / name, root / "skysim" / name, root / "estimator" / name
    return read(next((path for path in places if path.is_file()), root / name))


def columns(
    path: str | Path, names: Sequence[str], optional: Sequence[str] = ()
) -> tuple[Floats, float]:
    """Read columns of a catalog file, in the file's order.

    Parameters
    ----------
    names
        Columns in which every field is a number
    optional
        Columns in which empty fields are allowed and become NaN

    Returns
    -------
    numbers
        (len(names) + len(optional), N)
    epoch_yr
        Julian year of the file

    Raises
    ------
    ImageError
        If the file cannot be read.
    """
    try:
        lines = file_bytes(path).decode().splitlines()
        # The header's line `# epoch_jyear: 1991.25`
        matches = (re.fullmatch(r"#\s*epoch_jyear:\s*(\d+\.?\d*)\s*", line) for line in lines)
        found = next(filter(None, matches), None)
        epoch_yr = float(found[1]) if found else np.nan
        if not EPOCHS_YR[0] <= epoch_yr <= EPOCHS_YR[1]:
            raise ValueError(
                "its header has no epoch_jyear of {:g} to {:g}".format(*EPOCHS_YR)
            )
        body = [line for line in lines if line and not line.startswith("#")]
        delimiter = "," if "," in body[0] else None
        header = body[0].replace('"', "").split(delimiter)
        column_numbers = [header.index(name) for name in (*names, *optional)]
        if not body[1:]:
            raise ValueError("it has no rows")
        converters: dict[int | str, Callable[[str], Any]] = dict.fromkeys(
            column_numbers[len(names) :], _number_or_nan
        )
        table = np.loadtxt(
            body[1:],
            delimiter=delimiter,
            usecols=column_numbers,
            ndmin=2,
            converters=converters,
        )
        finite = (np.abs(table[:, : len(names)]) <= 1e15).all(axis=1)
        if not finite.all():
            row = np.argmin(finite) + 1
            raise ValueError(f"the numbers of row {row} are not finite up to 1e15")
    except (OSError, TypeError, ValueError, IndexError) as error:
        raise ImageError(
            f"{path}: not a star catalog ({reason(error)}); allowed: ECSV with {', '.join((*names, *optional))}"
        ) from None
    return table.T, epoch_yr


def _number_or_nan(text: str) -> float:
    """A field as a number; NaN if it is empty."""
    return float(text) if text.strip('" ') else np.nan


def from_columns(
    hip: NDArray,
    ra_deg: Floats,
    dec_deg: Floats,
    pm_ra_mas_yr: Floats,
    pm_dec_mas_yr: Floats,
    parallax_mas: Floats,
    v_mag: Floats,
    *,
    epoch_yr: float,
) -> StarCatalog:
    """Convert spherical coordinates and proper motions to vectors; pm_ra includes the factor cos(dec).

    The tangent plane has the axes east = (-sin a, cos a, 0) and north = (-sin d cos a, -sin d sin a, cos d), with
    the right ascension a and the declination d. The proper motion is pm_ra east + pm_dec north.
    """
    ra_rad, dec_rad = np.radians([ra_deg, dec_deg])
    sa = np.sin(ra_rad)
    ca = np.cos(ra_rad)
    sd = np.sin(dec_rad)
    vectors = from_angles(ra_rad, dec_rad)
    east = np.column_stack([-sa, ca, np.zeros_like(sa)])
    north = np.column_stack([-sd * ca, -sd * sa, np.cos(dec_rad)])
    drift = MAS_RAD * (pm_ra_mas_yr[:, None] * east + pm_dec_mas_yr[:, None] * north)
    parallax_rad = MAS_RAD * parallax_mas
    return StarCatalog(hip.astype(np.int64), vectors, drift, parallax_rad, v_mag, epoch_yr)


def from_angles(east_rad: Floats | float, north_rad: Floats | float) -> Floats:
    """Return the (..., 3) unit vectors at angles east along the equator and north of it."""
    cosine = np.cos(north_rad)
    return np.stack(
        [cosine * np.cos(east_rad), cosine * np.sin(east_rad), np.sin(north_rad)], axis=-1
    )


def at_epoch(stars: StarCatalog, epoch_yr: float) -> Floats:
    """(N, 3) barycentric unit vectors at a Julian year: R + (t - t0) dR/dt, normalized."""
    return normalized(stars.vectors + (epoch_yr - stars.epoch_yr) * stars.drift_rad_yr)


def apparent(stars: StarCatalog, observer: Observer) -> Floats:
    """(N, 3) apparent unit vectors for an observer.

    1. Proper motion, R + (t - t0) dR/dt.
    2. Parallax, R - pi r.
    3. Deflection of light by the Sun, 2 G M / (c^2 r) cot(psi / 2) away from the Sun, psi the angle from the Sun.
    4. Aberration by PTASE's eq. 4, (R + v/c) / |R + v/c|: the classical law, within 0.5 mas of the relativistic one.

    The Sun is assumed at the barycenter; for stars more than 10 degrees from the Sun the error is below 0.1 mas.
    """
    # 1. and 2. Proper motion and parallax.
    vectors = at_epoch(stars, observer.epoch_yr)
    vectors = normalized(vectors - stars.parallax_rad[:, None] * observer.position_au)
    distance_au = np.linalg.norm(observer.position_au)
    from_sun = observer.position_au / distance_au
    along = vectors @ from_sun
    # 3. Deflection.
    # The vector (e - (u.e) u) / (1 + u.e) has length cot(psi / 2). The floor keeps it finite behind the Sun's disk,
    # where no star is visible.
    deflection = (from_sun - along[:, None] * vectors) / np.maximum(1 + along, 1e-5)[:, None]
    vectors = normalized(vectors + SUN_DEFLECTION_RAD / distance_au * deflection)
    # 4. Aberration.
    return normalized(vectors + observer.velocity_m_s / SPEED_OF_LIGHT_M_S)


def merge_doubles(stars: StarCatalog, closer_than_rad: float) -> StarCatalog:
    """Replace each group of unresolved stars by one star at their center of light, with their total flux."""
    groups = close_groups(stars.vectors, 2 * np.sin(closer_than_rad / 2))
    columns = [*stars.vectors.T, *stars.drift_rad_yr.T, stars.parallax_rad]
    means, v_mag = light_centers(columns, stars.v_mag, groups)
    # Stars are sorted by brightness, so the first of each group is its brightest and gives the id.
    _, first = np.unique(groups, return_index=True)
    result = StarCatalog(
        stars.id[first],
        normalized(means[:, :3]),
        means[:, 3:6],
        means[:, 6],
        v_mag,
        stars.epoch_yr,
    )
    return result.brightest_first()


def light_centers(
    columns: Floats | list[Floats], magnitude: Floats, group: Ints
) -> tuple[Floats, Floats]:
    """Centers of light of groups: means weighted by the flux 10^(-0.4 m).

    Parameters
    ----------
    columns
        K columns of values of the stars, (N,) each
    magnitude
        (N,) their magnitudes
    group
        (N,) their groups, 0 to G - 1

    Returns
    -------
    means
        (G, K)
    magnitude
        (G,) magnitudes of the total flux of each group
    """
    flux = 10 ** (-0.4 * magnitude)
    total = np.bincount(group, flux)
    means = np.empty((len(total), len(columns)))
    for k, column in enumerate(columns):
        means[:, k] = np.bincount(group, flux * column) / total
    return means, -2.5 * np.log10(total)


def close_groups(points: Floats, distance: float) -> Ints:
    """Label each point (N, 3) with its group: the connected components of the graph of pairs within a distance.

    Each point takes the least label among itself and its neighbors until none changes. scipy.sparse.csgraph does the
    same, but takes longer to import than this to run.
    """
    one, other = cKDTree(points).query_pairs(distance, output_type="ndarray").T
    label = np.arange(len(points))
    before = np.empty(0, int)
    while not np.array_equal(label, before):
        before = label.copy()
        np.minimum.at(label, one, before[other])
        np.minimum.at(label, other, before[one])
    return np.unique(label, return_inverse=True)[1].astype(np.int64)


def brighter_than(stars: StarCatalog, limit_mag: float) -> StarCatalog:
    """Select the stars down to a limiting V magnitude: the first ones of a catalog, brightest first; not copied."""
    return stars.take(slice(np.searchsorted(stars.v_mag, limit_mag, "right")))


def limit_for_density(stars: StarCatalog, field_sr: float, mean_count: float) -> float:
    """The limiting magnitude at which a field of `field_sr` steradians holds `mean_count` stars on average.

    The stars are brightest first.
    """
    count = int(np.clip(mean_count * 4 * np.pi / field_sr, 1, len(stars)))
    return float(stars.v_mag[count - 1])
