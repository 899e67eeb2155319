"""Positions and magnitudes of Sun, Moon and planets match Skyfield with JPL's DE421 (extra `oracle`).

Skyfield computes light time, deflection, aberration, Earth rotation and magnitudes itself; the shipped ephemeris is
fitted to DE423.
"""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from skysim.core.time import tt_jd
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources import body_discs, camera_orbit, ephemeris, orbit_elements, satellites

LIMIT_ARCSEC = 0.1
LIMIT_MAG = 0.001
BARYCENTERS = ("jupiter", "saturn", "uranus", "neptune")
NAMES = ("sun", "moon", "mercury", "venus", "mars", *BARYCENTERS)
# to the end of 2025, where both have tables of UT1
FIRST = datetime.datetime(1972, 1, 2)
DAYS = 19_700
COUNT = 60


class Skyfield(NamedTuple):
    bodies: Any
    time: Any
    at_site: Any


@pytest.fixture(scope="module")
def skyfield() -> Skyfield:
    api = pytest.importorskip("skyfield.api")
    data = pytest.importorskip("skyfield_data")
    with warnings.catch_warnings():
        # Tables of UT1 that it has, but does not use here, are old.
        warnings.simplefilter("ignore", RuntimeWarning)
        load = api.Loader(data.get_skyfield_data_path())
    return Skyfield(load("de421.bsp"), load.timescale(builtin=True), api.wgs84.latlon)


def observers(
    skyfield: Skyfield, on_ground: bool
) -> Iterator[tuple[ephemeris.ObserverPlace, Any, Any]]:
    """Random times, and sites if on the ground: our observer, Skyfield's and its time."""
    rng = np.random.default_rng(26)
    for _ in range(COUNT):
        time = FIRST + datetime.timedelta(days=rng.uniform(0, DAYS))
        latitude_deg = rng.uniform(-85, 85)
        longitude_deg = rng.uniform(-180, 180)
        site = SiteConfig()
        theirs = skyfield.bodies["earth"]
        if on_ground:
            site = SiteConfig(
                latitude_deg=latitude_deg, longitude_deg=longitude_deg, height="2000 m"
            )
            theirs = theirs + skyfield.at_site(latitude_deg, longitude_deg, 2000.0)
        their_time = skyfield.time.from_datetime(time.replace(tzinfo=datetime.UTC))
        yield ephemeris.observe_from(time, site), theirs.at(their_time), their_time


def named(skyfield: Skyfield, name: str) -> Any:
    return skyfield.bodies[f"{name} barycenter" if name in BARYCENTERS else name]


@pytest.mark.parametrize("on_ground", [False, True], ids=["geocenter", "site"])
def test_places_match_skyfield(skyfield: Skyfield, on_ground: bool) -> None:
    worst = dict.fromkeys(NAMES, 0.0)
    for ours, theirs, _ in observers(skyfield, on_ground):
        for name in NAMES:
            wanted = theirs.observe(named(skyfield, name)).apparent().xyz.au
            direction = ephemeris.place(name, ours).direction
            off = np.arctan2(np.linalg.norm(np.cross(wanted, direction)), wanted @ direction)
            worst[name] = max(worst[name], np.degrees(off) * 3600)
    assert max(worst.values()) < LIMIT_ARCSEC, worst


def test_satellites_match_skyfield(skyfield: Skyfield, tmp_path: Path) -> None:
    """Places in the GCRS, apparent places from a site with light time and aberration, and where they are sunlit.

    Skyfield uses a spherical Earth and a sharp shadow, so results near the limb may differ.
    """
    from skyfield.api import EarthSatellite

    rng = np.random.default_rng(27)
    path = tmp_path / "orbits.tle"
    lines = [line for n in range(1, 41) for line in circular_tle(n, rng)]
    path.write_text("\n".join(lines), encoding="utf-8")
    ours = orbit_elements.read_elements(str(path))
    site = SiteConfig(latitude_deg=40, longitude_deg=10, height="500 m")
    theirs = skyfield.at_site(40, 10, 500.0)
    for hours in (0.0, 5.2, 19.0):
        time = datetime.datetime(2024, 4, 10, 3) + datetime.timedelta(hours=hours)
        their_time = skyfield.time.from_datetime(time.replace(tzinfo=datetime.UTC))
        seen = (skyfield.bodies["earth"] + theirs).at(their_time)
        place_m = orbit_elements.gcrs_states(ours, time, np.zeros(1))[0][:, 0]
        lit = camera_orbit.sunlit_fraction(place_m, camera_orbit.sun_m(tt_jd(time)))

        def site_at(after_s: float, time: datetime.datetime = time) -> ephemeris.GcrsState:
            then = time + datetime.timedelta(seconds=after_s)
            return ephemeris.site_in_gcrs(then, tt_jd(then), site)

        for n in range(len(ours)):
            satellite = EarthSatellite(lines[2 * n], lines[2 * n + 1], ts=skyfield.time)
            there = satellite.at(their_time)
            assert np.linalg.norm(there.xyz.m - place_m[n]) < 0.01
            assert 0 < lit[n] < 1 or there.is_sunlit(skyfield.bodies) == (lit[n] == 1)
            wanted = seen.observe(skyfield.bodies["earth"] + satellite).apparent().xyz.m
            direction, _ = satellites.path(ours[n], time, 1.0, site_at)
            off = np.linalg.norm(np.cross(wanted / np.linalg.norm(wanted), direction))
            assert np.degrees(off) * 3600 < 0.01


def circular_tle(number: int, rng: np.random.Generator) -> list[str]:
    """The lines of a low orbit of 9 April 2024."""
    inclination, node, along, rate = rng.uniform((0, 0, 0, 11), (110, 360, 360, 15.5))
    lines = (
        f"1 {number:05d}U 20001A   24100.50000000  .00001000  00000-0  50000-4 0  999",
        f"2 {number:05d} {inclination:8.4f} {node:8.4f} 0010000   0.0000 {along:8.4f} {rate:11.8f}    1",
    )
    return [line + orbit_elements.checksum(line) for line in lines]


def test_magnitudes_match_skyfield(skyfield: Skyfield) -> None:
    """Its front end takes the Sun to be at the barycenter (0.18 mag for Mercury), so it is given the distances."""
    library = pytest.importorskip("skyfield.magnitudelib")
    worst = dict.fromkeys(NAMES[2:], 0.0)
    for ours, theirs, time in observers(skyfield, False):
        for name in worst:
            seen = theirs.observe(named(skyfield, name))
            to_body = seen.xyz.au
            from_sun = theirs.xyz.au + seen.xyz.au - skyfield.bodies["sun"].at(time).xyz.au
            args = [np.linalg.norm(from_sun), np.linalg.norm(to_body)]
            args.append(np.degrees(np.arccos(from_sun @ to_body / args[0] / args[1])))
            if name in ("saturn", "uranus"):
                pole = getattr(library, f"_{name.upper()}_POLE")
                args += [
                    np.degrees(np.arccos(pole @ v / np.linalg.norm(v))) - 90
                    for v in (from_sun, to_body)
                ]
            if name == "neptune":
                args.append(time.J)
            wanted = float(getattr(library, f"_{name}_magnitude")(*args))
            if np.isfinite(wanted):  # before 2000 it knows Neptune at small phase angles only
                ours_mag = body_discs.magnitude(name, ephemeris.place(name, ours), ours.tt_jd)
                worst[name] = max(worst[name], abs(wanted - ours_mag))
    assert max(worst.values()) < LIMIT_MAG, worst
