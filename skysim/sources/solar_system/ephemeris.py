"""Barycentric positions of the Sun, the Moon and the planets: Chebyshev series fitted to JPL's DE423.

`data/ephemeris/build.py` makes the file. It is within 0.005" of DE423 as seen from the Earth, over 1972 to 2100.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.core.paths import DATA
from skysim.core.types import Floats

EPHEMERIS = DATA / "ephemeris" / "de423.npz"


class Series(NamedTuple):
    """One body: intervals of `days` from the file's first day, (count, 3, intervals) coefficients in units of km."""

    days: float
    unit_km: float
    coefficients: NDArray[np.int32]


class Ephemeris(NamedTuple):
    """All bodies' series from first_jd (TDB) on, and the mass of the Earth over the Moon's."""

    first_jd: float
    earth_moon_ratio: float
    series: dict[str, Series]

    def position_km(self, name: str, tdb_jd: float) -> Floats:
        """(3,) position in km, ICRS axes: from the solar system's barycenter, the Moon's from the Earth.

        The outer planets' places are their systems' barycenters: Jupiter and Saturn are up to 0.07" from them.
        """
        if name == "earth":
            return self.position_km("earth_moon", tdb_jd) - self.position_km("moon", tdb_jd) / (
                1 + self.earth_moon_ratio
            )
        series = self.series[name]
        interval, offset_days = divmod(tdb_jd - self.first_jd, series.days)
        coefficients = series.coefficients[:, :, int(interval)] * series.unit_km
        # T_k(x) = cos(k arccos x)
        angle = np.arccos(2 * offset_days / series.days - 1)
        return np.asarray(np.cos(angle * np.arange(len(coefficients))) @ coefficients)

    def barycentric_km(self, name: str, tdb_jd: float) -> Floats:
        """(3,) position in km from the solar system's barycenter, the Moon's too."""
        position_km = self.position_km(name, tdb_jd)
        return position_km + self.position_km("earth", tdb_jd) if name == "moon" else position_km


@lru_cache(maxsize=1)
def load_ephemeris() -> Ephemeris:
    """The ephemeris that is shipped."""
    with np.load(EPHEMERIS, allow_pickle=False) as arrays:
        names = [name.removesuffix("_days") for name in arrays.files if name.endswith("_days")]
        series = {
            name: Series(
                float(arrays[f"{name}_days"]), float(arrays[f"{name}_unit_km"]), arrays[name]
            )
            for name in names
        }
        return Ephemeris(float(arrays["first_jd"]), float(arrays["earth_moon_ratio"]), series)
