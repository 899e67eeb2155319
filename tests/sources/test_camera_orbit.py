"""The camera's orbit: circular, of mean elements, and of an OEM."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.special import eval_legendre
from sgp4.api import WGS72, Satrec

from skysim.core.constants import EARTH_J2, EARTH_MU_M3_S2, EARTH_RADIUS_M
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene.sections.surroundings import (
    CircularOrbitConfig,
    OemOrbitConfig,
    TleOrbitConfig,
)
from skysim.sources import orbit_elements
from skysim.sources.camera_orbit import CircularOrbit, build_orbit, state_at

START = datetime.datetime(2024, 4, 10, 3)
VANGUARD = (
    "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753\n"
    "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667\n"
)
HEADER = """CCSDS_OEM_VERS = 2.0
META_START
CENTER_NAME = EARTH
REF_FRAME = GCRF
TIME_SYSTEM = UTC
META_STOP
"""


def circular(**keys: object) -> CircularOrbit:
    config = {
        "kind": "circular",
        "altitude": "500 km",
        "inclination_deg": 97.4,
        "raan_deg": 30.0,
        **keys,
    }
    orbit = build_orbit(CircularOrbitConfig(**config), START)
    assert isinstance(orbit, CircularOrbit)
    return orbit


def numbers(values: Floats) -> str:
    return " ".join(f"{value:.9f}" for value in values)


def oem_text(t_s: Floats, position_m: Floats, velocity_m_s: Floats) -> str:
    epochs = [(START + datetime.timedelta(seconds=float(t))).isoformat() for t in t_s]
    rows = zip(epochs, position_m / 1e3, velocity_m_s / 1e3, strict=True)
    return HEADER + "".join(
        f"{epoch} {numbers(place)} {numbers(speed)}\n" for epoch, place, speed in rows
    )


def ellipse(t_s: Floats) -> tuple[Floats, Floats]:
    """An orbit of two bodies by Kepler's equation: 7000 km by an eccentricity of 0.05, in a tilted plane."""
    a = 7e6
    e = 0.05
    n = np.sqrt(EARTH_MU_M3_S2 / a**3)
    anomaly = n * t_s
    for _ in range(20):
        anomaly = anomaly - (anomaly - e * np.sin(anomaly) - n * t_s) / (
            1 - e * np.cos(anomaly)
        )
    across = np.sqrt(1 - e**2)
    rate = n / (1 - e * np.cos(anomaly))
    plane = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    place = a * np.column_stack([np.cos(anomaly) - e, across * np.sin(anomaly)])
    speed = a * rate[:, None] * np.column_stack([-np.sin(anomaly), across * np.cos(anomaly)])
    return place @ plane, speed @ plane


def test_a_circular_orbit_has_its_radius_speed_and_plane() -> None:
    states = circular(argument_deg=40.0).states(np.linspace(0, 6000, 50))
    radius_m = np.linalg.norm(states.position_m, axis=1)
    assert radius_m == pytest.approx(EARTH_RADIUS_M + 500e3)
    assert np.linalg.norm(states.velocity_m_s, axis=1) == pytest.approx(
        np.sqrt(EARTH_MU_M3_S2 / radius_m[0]), rel=2e-3
    )
    normal = np.cross(states.position_m[0], states.velocity_m_s[0])
    assert normal[2] / np.linalg.norm(normal) == pytest.approx(
        np.cos(np.radians(97.4)), abs=3e-4
    )
    start = states.position_m[0] / radius_m[0]
    assert start[2] == pytest.approx(np.sin(np.radians(40)) * np.sin(np.radians(97.4)))


def test_velocity_is_the_derivative_of_position() -> None:
    orbit = circular()
    t_s = np.array([1000.0, 1000.0 - 0.5, 1000.0 + 0.5])
    states = orbit.states(t_s)
    assert states.position_m[2] - states.position_m[1] == pytest.approx(
        states.velocity_m_s[0], abs=1e-2
    )


def test_a_sun_synchronous_orbit_precesses_once_a_year() -> None:
    """Vallado 2013, section 11.4.1: at 800 km an inclination of 98.6 degrees gives 0.9856 degrees a day."""
    _, node_rate = circular(altitude="800 km", inclination_deg=98.6).rates_rad_s
    assert np.degrees(node_rate) * 86400 == pytest.approx(0.9856, rel=5e-3)


@pytest.mark.parametrize("inclination_deg", [20.0, 51.6, 90.0, 140.0])
def test_a_circular_orbit_drifts_at_sgp4_s_secular_rates(inclination_deg: float) -> None:
    """Perigee and mean anomaly together, and the node, per mean motion; SGP4 has terms of J2 squared, 2e-6, too."""
    rates = circular(altitude="700 km", inclination_deg=inclination_deg).rates_rad_s
    radius = (EARTH_RADIUS_M + 700e3) / EARTH_RADIUS_M
    mean_motion = np.sqrt(EARTH_MU_M3_S2 / (EARTH_RADIUS_M + 700e3) ** 3)
    # SGP4's unit of time: 0.0743669161 radians a minute at the radius of the Earth of WGS 72.
    of_sgp4 = 0.0743669161 * radius**-1.5
    record = Satrec()
    # Its mean motion is Kozai's: changed until the semi-major axis is the radius.
    kozai = of_sgp4
    for _ in range(5):
        angles = 0.0, np.radians(inclination_deg), 0.0
        record.sgp4init(WGS72, "i", 5, 27000.0, 0.0, 0.0, 0.0, 1e-6, *angles, kozai, 0.0)
        kozai *= (record.a / radius) ** 1.5
    expected = [record.mdot + record.argpdot, record.nodedot]
    np.testing.assert_allclose(
        np.array(rates) / mean_motion, np.array(expected) / of_sgp4, rtol=0, atol=2e-5
    )


def test_gravity_is_the_gradient_of_its_potential() -> None:
    """mu / r (1 - J2 (R / r)^2 P2(z / r)), by central differences over 10 m."""

    def potential(place_m: Floats) -> Floats:
        r = np.linalg.norm(place_m, axis=-1)
        flattened = EARTH_J2 * (EARTH_RADIUS_M / r) ** 2
        return EARTH_MU_M3_S2 / r * (1 - flattened * eval_legendre(2, place_m[..., 2] / r))

    rng = np.random.default_rng(6)
    place_m = rng.normal(0, 1, (40, 3))
    place_m *= rng.uniform(6.7e6, 4e7, (40, 1)) / np.linalg.norm(place_m, axis=1)[:, None]
    step_m = 10 * np.eye(3)
    rise = potential(place_m[:, None] + step_m) - potential(place_m[:, None] - step_m)
    found = orbit_elements.gravity_m_s2(place_m)
    size = np.linalg.norm(found, axis=1, keepdims=True)
    np.testing.assert_allclose(found / size, rise / 20 / size, rtol=0, atol=2e-7)


def test_an_oem_is_interpolated_between_its_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kepler's ellipse sampled every two minutes, without J2."""
    monkeypatch.setattr(orbit_elements, "EARTH_J2", 0.0)
    t_s = np.arange(-600.0, 6000.0, 120.0)
    path = tmp_path / "orbit.oem"
    path.write_text(oem_text(t_s, *ellipse(t_s)), encoding="utf-8")
    orbit = build_orbit(OemOrbitConfig(kind="oem", file=str(path)), START)
    assert orbit
    between = np.random.default_rng(2).uniform(0, 5800, 200)
    for found, expected, limit in zip(
        orbit.states(between), ellipse(between), (3e-3, 2e-4), strict=True
    ):
        assert np.abs(found - expected).max() < limit
    with pytest.raises(
        InputError, match=r"is from -600 to 5880 s after start_time, not at 7000 s"
    ):
        state_at(orbit, 7000.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("= 2.0", "= 9.0", "CCSDS_OEM_VERS is '9.0'; allowed: 1.0, 2.0, 3.0"),
        ("= EARTH", "= MARS", "line 3: CENTER_NAME = 'MARS'; allowed: EARTH"),
        ("= GCRF", "= ITRF2000", "line 4: REF_FRAME = 'ITRF2000'"),
        ("TIME_SYSTEM = UTC\n", "", "TIME_SYSTEM is missing"),
        ("META_START", "META", "is not KEYWORD = value"),
        ("META_START\n", "", "line 5: META_STOP before META_START"),
        (
            numbers(ellipse(np.zeros(1))[0][0] / 1e3),
            "0 0 0",
            "a position in the Earth's core",
        ),
    ],
)
def test_a_bad_oem_is_refused_in_one_line(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "orbit.oem"
    t_s = np.array([0.0, 60.0])
    path.write_text(oem_text(t_s, *ellipse(t_s)).replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        orbit_elements.read_oem(str(path), START)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_oem_in_eme2000_differs_by_the_frame_bias(tmp_path: Path) -> None:
    """23 mas: 0.8 m at 7000 km."""
    t_s = np.array([0.0, 60.0])
    path = tmp_path / "orbit.oem"
    text = oem_text(t_s, *ellipse(t_s))
    places = []
    for frame in ("GCRF", "EME2000"):
        path.write_text(text.replace("GCRF", frame), encoding="utf-8")
        places.append(
            orbit_elements.read_oem(str(path), START).states(np.array([30.0]))[0][0]
        )
    assert 0.1 < np.linalg.norm(places[0] - places[1]) < 0.9


def test_eme2000_has_the_published_pole_and_equinox(tmp_path: Path) -> None:
    """IERS Conventions 2010, 5.4.4: the pole of J2000.0 at (-16.617, -6.819) mas in the ICRS, the equinox at -14.6."""
    mas = np.radians(1 / 3.6e6)
    for axis, expected in (
        ([0.0, 0.0, 1.0], [-16.617 * mas, -6.819 * mas, 1.0]),
        ([1.0, 0.0, 0.0], [1.0, -14.6 * mas, 16.617 * mas]),
    ):
        path = tmp_path / "orbit.oem"
        t_s = np.array([0.0, 60.0])
        text = oem_text(t_s, np.tile(7e6 * np.array(axis), (2, 1)), np.zeros((2, 3)))
        path.write_text(text.replace("GCRF", "EME2000"), encoding="utf-8")
        states = orbit_elements.read_oem(str(path), START).states(np.array([0.0]))
        found = states.position_m[0] / 7e6
        np.testing.assert_allclose(found, expected, rtol=0, atol=0.1 * mas)


def test_a_tle_of_several_satellites_requires_a_number(tmp_path: Path) -> None:
    path = tmp_path / "two.tle"
    path.write_text(VANGUARD * 2, encoding="utf-8")
    with pytest.raises(InputError, match=r"orbit.number: None: 2 satellites"):
        build_orbit(TleOrbitConfig(kind="tle", file=str(path)), START)
    path.write_text(VANGUARD, encoding="utf-8")
    start = datetime.datetime(2000, 6, 28)
    orbit = build_orbit(TleOrbitConfig(kind="tle", file=str(path), number=5), start)
    assert orbit
    states = orbit.states(np.array([-0.5, 0.0, 0.5, 2 * 86400.0]))
    assert states.position_m[2] - states.position_m[0] == pytest.approx(
        states.velocity_m_s[1], abs=2.0
    )
