"""Build de423.npz, the ephemeris that skysim carries, from JPL's DE423.

    pip install jplephem de423
    python data/ephemeris/build.py

DE423 (Folkner 2010, JPL IOM 343R-10-001; public domain) is refitted by shorter Chebyshev series over the years that a
scene with bodies may have. SERIES gives each body's interval and number of coefficients, the cheapest for which the
largest error found is below 0.005" as seen from the Earth: 10 m for the Moon, 1 km for the inner planets.
"""

from __future__ import annotations

from pathlib import Path

import de423
import numpy as np
from jplephem import Ephemeris
from numpy.polynomial import chebyshev

FIRST_JD, LAST_JD = 2441316.5, 2488436.5  # 1972 January 1 to 2101 January 3, TDB
# Name in DE423: name here, days in an interval, coefficients, unit in km.
SERIES = {
    "sun": ("sun", 256, 17, 0.05),
    "mercury": ("mercury", 32, 17, 0.05),
    "venus": ("venus", 128, 13, 0.1),
    "earthmoon": ("earth_moon", 128, 12, 0.1),
    "mars": ("mars", 256, 14, 0.2),
    "jupiter": ("jupiter", 2048, 14, 1.0),
    "saturn": ("saturn", 2048, 12, 1.0),
    "uranus": ("uranus", 2048, 7, 2.0),
    "neptune": ("neptune", 2048, 6, 3.0),
    "moon": ("moon", 16, 18, 0.001),
}


def fit(ephemeris: Ephemeris, name: str, days: int, count: int) -> np.ndarray:
    """(count, 3, intervals) Chebyshev coefficients in km: least squares at the nodes of twice as many terms."""
    nodes = chebyshev.chebpts1(2 * count)
    starts = np.arange(FIRST_JD, LAST_JD, days)
    times = starts[:, None] + (nodes + 1) / 2 * days
    position_km = ephemeris.position(name, times.ravel()).reshape(3, len(starts), len(nodes))
    return np.einsum(
        "kn,agn->kag", np.linalg.pinv(chebyshev.chebvander(nodes, count - 1)), position_km
    )


def main() -> None:
    ephemeris = Ephemeris(de423)
    arrays = {"first_jd": FIRST_JD, "last_jd": LAST_JD, "earth_moon_ratio": ephemeris.EMRAT}
    for source, (name, days, count, unit_km) in SERIES.items():
        steps = np.rint(fit(ephemeris, source, days, count) / unit_km)
        assert np.abs(steps).max() < 2**31
        arrays |= {
            name: steps.astype(np.int32),
            f"{name}_days": float(days),
            f"{name}_unit_km": unit_km,
        }
    np.savez_compressed(Path(__file__).with_name("de423.npz"), **arrays)


if __name__ == "__main__":
    main()
