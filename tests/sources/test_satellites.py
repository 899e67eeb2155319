"""Satellites: elements, places by SGP4, sunlight and the Earth's shadow, and random ones."""

from __future__ import annotations

import csv
import datetime
import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import erfa
import numpy as np
import pytest
import sgp4.api
import sgp4.model
from scipy import stats

from skysim.core.constants import EARTH_FLATTENING, EARTH_RADIUS_M
from skysim.core.errors import InputError
from skysim.core.time import tt_jd
from skysim.scene.sections.surroundings import RandomSatellitesConfig
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources import camera_orbit, orbit_elements, satellites
from skysim.sources.ephemeris import GcrsState, site_in_gcrs
from skysim.sources.satellites import ExposureView

# Satellite 00005 of Vallado et al. 2006 (AIAA 2006-6753), and its TEME states of tcppver.out, km and km/s.
VANGUARD = (
    "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753\n"
    "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667\n"
)
PUBLISHED = {
    0.0: (7022.46529266, -1400.08296755, 0.03995155, 1.893841015, 6.405893759, 4.534807250),
    360.0: (
        -7154.03120202,
        -3783.17682504,
        -3536.19412294,
        4.741887409,
        -4.151817765,
        -2.093935425,
    ),
    720.0: (
        -7134.59340119,
        6531.68641334,
        3260.27186483,
        -4.113793027,
        -2.911922039,
        -2.557327851,
    ),
}
OMM = {
    "OBJECT_NAME": "VANGUARD 1",
    "OBJECT_ID": "1958-002B",
    "NORAD_CAT_ID": "5",
    "EPOCH": "2000-06-27T18:50:19.733568",
    "MEAN_MOTION": "10.82419157",
    "ECCENTRICITY": ".1859667",
    "INCLINATION": "34.2682",
    "RA_OF_ASC_NODE": "348.7242",
    "ARG_OF_PERICENTER": "331.7664",
    "MEAN_ANOMALY": "19.3264",
    "BSTAR": ".28098E-4",
    "MEAN_MOTION_DOT": ".23E-6",
}
DATE = datetime.datetime(2024, 4, 10, 3, 0, 7)
SITE = SiteConfig(latitude_deg=40.0, longitude_deg=10.0, height="500 m")


def written(folder: Path, text: str, name: str = "elements.txt") -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def tle(
    number: int,
    inclination_deg: float,
    node_deg: float,
    along_deg: float,
    revolutions_day: float,
) -> str:
    """A circular orbit of 10 April 2024, 0 h."""
    lines = (
        f"1 {number:05d}U 20001A   24101.00000000  .00000000  00000-0  00000-0 0  999",
        f"2 {number:05d} {inclination_deg:8.4f} {node_deg:8.4f} 0001000   0.0000 {along_deg:8.4f}"
        f" {revolutions_day:11.8f}    1",
    )
    return "".join(f"{line}{orbit_elements.checksum(line)}\n" for line in lines)


@pytest.fixture
def low_orbits(tmp_path: Path) -> list[orbit_elements.MeanElements]:
    rng = np.random.default_rng(4)
    orbits = (
        tle(n, *rng.uniform((0, 0, 0, 13), (100, 360, 360, 15.5))) for n in range(1, 41)
    )
    return orbit_elements.read_elements(written(tmp_path, "".join(orbits)))


def test_sgp4_gives_the_published_states(tmp_path: Path) -> None:
    path = written(tmp_path, f"VANGUARD 1\n{VANGUARD}")
    record = orbit_elements.read_elements(path)[0].record
    for minutes, state in PUBLISHED.items():
        error, place, velocity = record.sgp4_tsince(minutes)
        assert error == 0
        assert np.array([*place]) == pytest.approx(state[:3], abs=1e-5)
        assert np.array([*velocity]) == pytest.approx(state[3:], abs=1e-8)


def test_the_rotation_from_teme_to_gcrs_matches_the_published_one() -> None:
    """Vallado et al. 2006, appendix C: 6 April 2004, 07:51:28.386 UTC; their EOP and polar motion differ by a meter."""
    date = datetime.datetime(2004, 4, 6, 7, 51, 28, 386009)
    place_km = orbit_elements.gcrs_from_teme(date) @ [
        5094.18016210,
        6127.64465950,
        6380.34453270,
    ]
    assert place_km == pytest.approx([5102.508958, 6123.011401, 6378.136928], abs=3e-3)


@pytest.mark.parametrize("kind", ["csv", "json", "xml"])
def test_omm_and_tle_give_the_same_states(kind: str, tmp_path: Path) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(OMM))
    writer.writeheader()
    writer.writerow(OMM)
    leaves = "".join(f"<{key}>{value}</{key}>" for key, value in OMM.items())
    xml = f"<ndm><omm><body><segment><metadata/><data>{leaves}</data></segment></body></omm></ndm>"
    omm = orbit_elements.read_elements(
        written(
            tmp_path,
            {"csv": text.getvalue(), "json": json.dumps([OMM]), "xml": xml}[kind],
            "omm",
        )
    )
    line = orbit_elements.read_elements(written(tmp_path, VANGUARD))
    time = datetime.datetime(2000, 6, 28)
    places_m = [orbit_elements.gcrs_states(one, time, np.zeros(1))[0] for one in (omm, line)]
    assert [one.name for one in omm] == ["VANGUARD 1"]
    assert [one.number for one in (*omm, *line)] == [5, 5]
    assert np.abs(places_m[0] - places_m[1]).max() < 0.01


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        (
            VANGUARD.replace("4753", "4754"),
            "line 1: the checksum of line 1 is 4; it should be 3",
        ),
        (VANGUARD.splitlines()[0], "is not line 2 of a TLE"),
        ("[{}]", "message 1: EPOCH is missing"),
        ("<ndm>", "not an OMM"),
        (json.dumps({**OMM, "EPOCH": "yesterday"}), "message 1: EPOCH 'yesterday'"),
        (
            json.dumps({**OMM, "EPOCH": "2012-02-30T00:00:00"}),
            "message 1: not elements of SGP4",
        ),
        (json.dumps({**OMM, "MEAN_MOTION": "fast"}), "message 1: 'fast' is not a number"),
        (json.dumps({**OMM, "ELEMENT_SET_NO": "1.5"}), "message 1: not elements of SGP4"),
        (
            json.dumps({**OMM, "ECCENTRICITY": "1.5"}),
            "satellite 1: SGP4 refuses these elements",
        ),
    ],
)
def test_bad_elements_are_refused_in_one_line(
    text: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as refused:
        orbit_elements.read_elements(written(tmp_path, text))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_lines_that_sgp4_in_python_cannot_read_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without compiled code sgp4 raises an error of its own for fields that are not numbers."""
    monkeypatch.setattr(sgp4.api, "Satrec", sgp4.model.Satrec)
    first, second = VANGUARD.splitlines()
    wrong = second.replace("34.2682", "3x.2682")
    # Without the checksum, which would no longer fit.
    path = written(tmp_path, f"{first}\n{wrong[:68]}\n")
    with pytest.raises(InputError, match=r"line 1: not a TLE: its fields"):
        orbit_elements.read_elements(path)


def test_the_phase_law_is_that_of_a_lambert_sphere() -> None:
    """The integral of mu mu0 over the part of a sphere that is lit and seen, over that at 90 degrees."""
    z, around = np.meshgrid(
        (np.arange(600) + 0.5) / 300 - 1, (np.arange(600) + 0.5) * np.pi / 300
    )
    normal = np.stack(
        [np.sqrt(1 - z**2) * np.cos(around), np.sqrt(1 - z**2) * np.sin(around), z]
    )

    def light(phase_rad: float) -> float:
        sun = np.array([np.sin(phase_rad), 0.0, np.cos(phase_rad)])
        return float(
            (np.maximum(normal[2], 0) * np.maximum(np.tensordot(sun, normal, 1), 0)).sum()
        )

    for phase_rad in (0.0, 0.7, 1.5, 2.4, 2.9):
        fainter = -2.5 * np.log10(light(phase_rad) / light(np.pi / 2))
        assert satellites.phase_mag(phase_rad) == pytest.approx(fainter, abs=2e-3)


def test_magnitudes_follow_range_and_light() -> None:
    assert satellites.magnitude(6.0, 1e6, np.pi / 2, 1.0) == pytest.approx(6.0)
    assert satellites.magnitude(6.0, 1e7, np.pi / 2, 1.0) == pytest.approx(11.0)
    assert satellites.magnitude(6.0, 1e6, np.pi / 2, 0.01) == pytest.approx(11.0)


def test_the_earth_s_shadow_is_a_cone() -> None:
    """On a circle about the Earth's axis the umbra ends where the limb hides all of the Sun."""
    sun_m = np.array([1.496e11, 0.0, 0.0])
    radius_m = 7e6
    sun_rad = np.arcsin(camera_orbit.SUN_RADIUS_M / 1.496e11)
    limb_rad = np.arccos(EARTH_RADIUS_M / radius_m)  # beyond 90 degrees from the Sun

    def lit(angle_rad: float) -> float:
        place = radius_m * np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
        return float(camera_orbit.sunlit_fraction(place, sun_m))

    parallax_rad = radius_m / 1.496e11
    edge = np.pi / 2 + limb_rad - parallax_rad
    assert lit(0.0) == 1
    assert lit(np.pi) == 0
    assert lit(edge) == pytest.approx(0.5, abs=0.01)
    assert lit(edge - 1.02 * sun_rad) == 1
    assert lit(edge + 1.02 * sun_rad) == 0
    # Area of a disc above a chord at half its radius.
    half = 0.5 + (0.5 * np.sqrt(0.75) + np.arcsin(0.5)) / np.pi
    assert lit(edge - 0.5 * sun_rad) == pytest.approx(half, abs=0.01)


def test_satellites_behind_the_earth_s_ellipsoid_are_hidden() -> None:
    high = np.array([0.0, 0.0, 7e6])
    pole_m = EARTH_RADIUS_M * (1 - EARTH_FLATTENING)
    limb_rad = np.arcsin(pole_m / 7e6)
    for off, hidden in ((-0.02, True), (0.02, False)):  # from the nadir to the limb
        direction = np.array([np.sin(limb_rad + off), 0.0, -np.cos(limb_rad + off)])
        assert camera_orbit.hidden_by_earth(high, direction) == hidden
    down = np.array([0.0, 0.0, -1.0])
    assert not camera_orbit.hidden_by_earth(high, down, 7e6 - pole_m - 1)
    assert camera_orbit.hidden_by_earth(high, down, 7e6 - pole_m + 1)
    ground = np.array([EARTH_RADIUS_M, 0.0, 0.0])
    horizon = np.array([[0.001, 1.0, 0.0], [-0.001, 1.0, 0.0]])
    assert camera_orbit.hidden_by_earth(ground, horizon).tolist() == [False, True]


def test_a_path_matches_positions_at_its_times(
    low_orbits: list[orbit_elements.MeanElements],
) -> None:
    """Place and motion at mid-exposure give the apparent place at another time of a long exposure."""

    def observer_at(after_s: float) -> GcrsState:
        time = DATE + datetime.timedelta(seconds=after_s)
        return site_in_gcrs(time, tt_jd(time), SITE)

    for one in low_orbits:
        place, motion = satellites.path(one, DATE, 10.0, observer_at)
        for after_s in (-3.1, 4.2):
            then = place + after_s * (motion[0] + after_s / 2 * motion[1])
            time = DATE + datetime.timedelta(seconds=after_s)
            exact, _ = satellites.path(
                one, time, 0.1, lambda t, at=after_s: observer_at(at + t)
            )
            off = np.linalg.norm(np.cross(then / np.linalg.norm(then), exact))
            assert np.degrees(off) * 3600 < 0.1


def test_a_camera_in_orbit_sees_satellites_displaced_ahead(
    low_orbits: list[orbit_elements.MeanElements],
) -> None:
    """By ERFA's aberration of the direction in which the light left: up to 5" at 7.5 km/s, to 1 mas."""
    velocity_m_s = np.array([3000.0, -5000.0, 4700.0])

    def observer_at(after_s: float) -> GcrsState:
        return GcrsState(np.array([6.9e6, 1e6, -5e5]) + after_s * velocity_m_s, velocity_m_s)

    beta = velocity_m_s / 299792458.0
    for one in low_orbits[:10]:
        seen, _ = satellites.path(one, DATE, 0.0, observer_at)
        # Light time by another scheme: steps in the satellite's own time until it changes no more.
        left_s = 0.0
        for _ in range(20):
            states = orbit_elements.gcrs_states([one], DATE, np.array([left_s]))
            to_m = states[0][0, 0] - observer_at(0.0).position_m
            left_s = -float(np.linalg.norm(to_m)) / 299792458.0
        straight = to_m / np.linalg.norm(to_m)
        expected = erfa.ab(straight, beta, 1.0, np.sqrt(1 - beta @ beta))
        assert np.degrees(erfa.sepp(seen, expected)) * 3600 < 1e-3
        assert np.degrees(erfa.sepp(seen, straight)) * 3600 > 0.1


def test_satellites_of_the_field_are_those_that_cross_it(
    low_orbits: list[orbit_elements.MeanElements],
) -> None:
    """From a place beside each sunlit satellite, looking at it: found, with its range, and nothing where it is dark."""
    place_m, velocity_m_s, _ = orbit_elements.gcrs_states(low_orbits, DATE, np.zeros(1))
    lit = camera_orbit.sunlit_fraction(place_m[:, 0], camera_orbit.sun_m(tt_jd(DATE)))
    assert 5 < np.count_nonzero(lit == 1) < 40
    for n in range(len(lit)):
        up = place_m[n, 0] / np.linalg.norm(place_m[n, 0])
        here = GcrsState(place_m[n, 0] - 50e3 * up, velocity_m_s[n, 0])
        view = ExposureView(up, 0.05, 0.0, 0.1)
        found = list(
            satellites.known_satellites(low_orbits, 6.0, view, DATE, lambda t, at=here: at)
        )
        assert [light.truth.id - satellites.ID_BASE for light in found] == [n + 1] * int(
            lit[n] > 0
        )
        for light in found:
            assert light.truth.range_km == pytest.approx(50)


def test_random_satellites_have_their_density_rates_and_magnitudes() -> None:
    config = RandomSatellitesConfig(
        per_field=30.0, rate_deg_s=(0.1, 2.0), v_mag=(3.0, 5.0), seed=8
    )
    view = ExposureView(np.array([0.6, 0.0, 0.8]), 0.1, 0.0, 1.0)
    drawn = [
        list(satellites.random_satellites(config, view, 1, index)) for index in range(60)
    ]
    lights = [light for frame in drawn for light in frame]
    inside = sum(light.place @ view.boresight > np.cos(view.field_rad) for light in lights)
    assert inside / 60 == pytest.approx(30, abs=4 * np.sqrt(30 / 60))
    rates = np.log([light.truth.rate_deg_s for light in lights])
    assert rates.mean() == pytest.approx(np.log([0.1, 2.0]).mean(), abs=0.05)
    assert rates.min() >= np.log(0.1) - 1e-9
    assert rates.max() <= np.log(2.0) + 1e-9
    magnitudes = np.array([light.truth.v_mag for light in lights])
    assert magnitudes.mean() == pytest.approx(4, abs=0.05)
    headings = np.array(
        [light.motion[0] / np.linalg.norm(light.motion[0]) for light in lights]
    )
    assert np.abs(headings.mean(axis=0)).max() < 0.05
    other_run = list(satellites.random_satellites(config, view, 2, 3))
    assert [light.truth for light in other_run] != [light.truth for light in drawn[3]]
    again = list(satellites.random_satellites(config, view, 1, 3))
    assert [str(light.truth) for light in again] == [str(light.truth) for light in drawn[3]]


RANGE_M = 1e6


def seen_of(
    monkeypatch: pytest.MonkeyPatch,
    places_m: np.ndarray,
    velocities_m_s: np.ndarray,
    **state: float,
) -> list[satellites.MovingLight]:
    """The lights of satellites at these places from a camera at 7,000 km that looks away from the Earth, sun at y."""
    here = GcrsState(np.array([7e6, 0.0, 0.0]), np.zeros(3))
    failed = np.zeros((len(places_m), 1))
    failed[: int(state.get("failed", 0))] = 6
    monkeypatch.setattr(
        satellites,
        "gcrs_states",
        lambda elements, time, after_s: (places_m[:, None], velocities_m_s[:, None], failed),
    )
    monkeypatch.setattr(satellites, "sun_m", lambda _: np.array([7e6, 1.5e11, 0.0]))
    monkeypatch.setattr(
        satellites,
        "sunlit_fraction",
        lambda place, sun: np.full(len(place), state.get("sunlit", 1.0)),
    )
    monkeypatch.setattr(
        satellites,
        "path",
        lambda one, *_: (
            np.array([1.0, 0.0, 0.0]),
            np.array([[0.0, 0.02, 0.0], [0.0, 0.0, 0.0]]),
        ),
    )
    elements = [SimpleNamespace(number=n, name=f"number {n}") for n in range(len(places_m))]
    view = ExposureView(
        np.array([1.0, 0.0, 0.0]),
        0.05,
        state.get("turn_rad", 0.0),
        state.get("duration_s", 1.0),
    )
    unused: Any = elements
    return list(satellites.known_satellites(unused, 6.0, view, DATE, lambda _: here))


def at_angles(angles_rad: np.ndarray, range_m: float = RANGE_M) -> np.ndarray:
    along = np.column_stack([np.cos(angles_rad), np.sin(angles_rad), 0 * angles_rad])
    return np.array([7e6, 0.0, 0.0]) + range_m * along


@pytest.mark.parametrize(
    ("turn_rad", "rate", "duration_s"), [(0, 0, 1), (0.02, 0, 1), (0, 0.01, 3)]
)
def test_a_satellite_counts_as_far_as_camera_and_satellite_turn(
    monkeypatch: pytest.MonkeyPatch, turn_rad: float, rate: float, duration_s: float
) -> None:
    """Beyond the corner of the field by a thousandth and half of both turns; its speed along the ray moves nothing."""
    limit = 0.05 + 1e-3 + (turn_rad + rate * duration_s) / 2
    angles = np.array([0.0, -limit + 1e-5, limit - 1e-5, limit + 1e-5, -limit - 1e-5])
    places = at_angles(angles)
    across = np.column_stack([-np.sin(angles), np.cos(angles), 0 * angles])
    toward = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    velocities = rate * RANGE_M * across + 3000.0 * toward
    state = {"turn_rad": turn_rad, "duration_s": duration_s}
    found = seen_of(monkeypatch, places, velocities, **state)
    assert [one.truth.id - satellites.ID_BASE for one in found] == [0, 1, 2]
    # A camera that turns more than half a circle sees everything.
    everything = at_angles(np.array([0.5, 2.0]), 2e7)
    found = seen_of(monkeypatch, everything[:1], 0 * everything[:1], turn_rad=9.0)
    assert len(found) == 1


def test_a_satellite_s_truth_is_that_of_its_geometry(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 2,000 km and 0.04 rad toward the Sun's side: the phase is the angle at it between Sun and camera."""
    angle = np.array([0.04])
    (found,) = seen_of(monkeypatch, at_angles(angle, 2e6), np.zeros((1, 3)), sunlit=0.5)
    phase = np.pi / 2 + 0.04
    truth = found.truth
    assert truth.phase_deg == pytest.approx(np.degrees(phase), abs=2e-3)
    assert truth.range_km == pytest.approx(2000)
    assert truth.sunlit == 0.5
    # 5 log 2, half of the Sun, and the Lambert sphere at this phase
    light = np.sin(phase) + (np.pi - phase) * np.cos(phase)
    expected = 6 + 5 * np.log10(2) + 2.5 * np.log10(2) - 2.5 * np.log10(light)
    assert truth.v_mag == pytest.approx(expected, abs=1e-4)
    assert truth.rate_deg_s == pytest.approx(np.degrees(0.02))
    assert seen_of(monkeypatch, at_angles(angle), np.zeros((1, 3)), sunlit=0.0) == []
    assert seen_of(monkeypatch, at_angles(angle), np.zeros((1, 3)), failed=1) == []
    for range_m, count in ((9.9, 0), (10.1, 1)):
        near = at_angles(angle, range_m)
        assert len(seen_of(monkeypatch, near, np.zeros((1, 3)))) == count


def test_a_satellite_behind_the_earth_is_not_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through the Earth: at 20,000 km on its other side, seen by a camera that turns all around."""
    behind = at_angles(np.array([np.pi, np.pi - 1.3]), 2e7)
    found = seen_of(monkeypatch, behind, np.zeros((2, 3)), turn_rad=9.0)
    assert [one.truth.id - satellites.ID_BASE for one in found] == [1]


@pytest.mark.slow
@pytest.mark.parametrize("turn_rad", [0.0, 0.3])
def test_random_satellites_fill_the_cone_of_all_paths(turn_rad: float) -> None:
    """Uniform in the cosine to the field's edge and half of both turns; a great circle's acceleration; any heading."""
    config = RandomSatellitesConfig(
        per_field=20.0, rate_deg_s=(0.5, 4.0), v_mag=(3.0, 5.0), seed=8
    )
    boresight = np.array([0.6, 0.0, 0.8])
    view = ExposureView(boresight, 0.1, turn_rad, 2.0)
    reach = 0.1 + (turn_rad + np.radians(4.0) * 2.0) / 2
    mean = 20.0 * (1 - np.cos(reach)) / (1 - np.cos(0.1))
    frames = [
        list(satellites.random_satellites(config, view, 1, index)) for index in range(40)
    ]
    lights = [light for frame in frames for light in frame]
    assert len(lights) / 40 == pytest.approx(mean, abs=4 * np.sqrt(mean / 40))
    place = np.array([light.place for light in lights])
    motion = np.array([light.motion for light in lights])
    np.testing.assert_allclose(np.linalg.norm(place, axis=1), 1, rtol=1e-12)
    share = (1 - place @ boresight) / (1 - np.cos(reach))
    assert 0 <= share.min() < 0.02
    assert 0.98 < share.max() <= 1
    assert stats.kstest(share, "uniform").pvalue > 1e-3
    outward = place - (place @ boresight)[:, None] * boresight
    turned = np.arctan2(outward @ [0.0, 1.0, 0.0], outward @ [0.8, 0.0, -0.6]) % (2 * np.pi)
    assert stats.kstest(turned / (2 * np.pi), "uniform").pvalue > 1e-3
    rate = np.linalg.norm(motion[:, 0], axis=1)
    np.testing.assert_allclose(np.sum(motion[:, 0] * place, axis=1), 0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion[:, 1], -(rate**2)[:, None] * place, rtol=1e-12)
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    inward = outward - np.sum(outward * place, axis=1)[:, None] * place
    inward /= np.linalg.norm(inward, axis=1)[:, None]
    heading = np.arctan2(
        np.sum(np.cross(place, inward) * motion[:, 0], axis=1),
        np.sum(inward * motion[:, 0], axis=1),
    )
    assert stats.kstest(heading / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    logarithm = np.log(np.degrees(rate) / 0.5) / np.log(8)
    assert stats.kstest(logarithm, "uniform").pvalue > 1e-3
    assert all(np.isnan(light.truth.range_km) for light in lights)
    assert {light.truth.sunlit for light in lights} == {1.0}
    ids = [light.truth.id for light in frames[0]]
    assert ids == [satellites.RANDOM_BASE + n for n in range(len(ids))]


def test_lights_without_a_star_are_named_by_their_numbers() -> None:
    mirrored = satellites.MIRRORED
    for number, name in (
        (mirrored - 1, str(mirrored - 1)),
        (mirrored, "reflection of 0"),
        (2 * mirrored + 17, "reflection of 17"),
        (satellites.ID_BASE, str(satellites.ID_BASE)),
        (satellites.GHOST - 1, str(satellites.GHOST - 1)),
        (satellites.GHOST, "ghost of 0"),
        (satellites.GHOST + 32349, "ghost of 32349"),
        (3 * satellites.GHOST + mirrored + 5, "ghost of reflection of 5"),
    ):
        assert satellites.light_name(number) == name
