"""The camera's orbit: circular, of mean elements, and of an OEM."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre
from sgp4.api import WGS72, Satrec

from skysim.core.constants import EARTH_FLATTENING, EARTH_J2, EARTH_MU_M3_S2, EARTH_RADIUS_M
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene.sections.surroundings import (
    CircularOrbitConfig,
    OemOrbitConfig,
    TleOrbitConfig,
)
from skysim.sources import camera_orbit, orbit_elements
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


def test_a_circular_orbit_begins_at_its_elements_and_turns_with_its_node() -> None:
    """By rotations about the pole, the node and the pole of the orbit, at any time, from its two rates."""
    orbit = circular(argument_deg=25.0, raan_deg=200.0, inclination_deg=63.0)
    argument_rate, node_rate = orbit.rates_rad_s
    t_s = np.array([0.0, 500.0, 30_000.0])
    states = orbit.states(t_s)
    for t, place, speed in zip(t_s, states.position_m, states.velocity_m_s, strict=True):
        node = np.radians(200.0) + node_rate * t
        argument = np.radians(25.0) + argument_rate * t
        gcrs_from_orbit = Rotation.from_euler("ZXZ", [node, np.radians(63.0), argument])
        radius_m = EARTH_RADIUS_M + 500e3
        np.testing.assert_allclose(
            place, gcrs_from_orbit.apply([radius_m, 0.0, 0.0]), rtol=0, atol=1e-3
        )
        own = gcrs_from_orbit.apply([0.0, radius_m * argument_rate, 0.0])
        np.testing.assert_allclose(
            speed, own + node_rate * np.array([-place[1], place[0], 0.0]), rtol=0, atol=1e-6
        )


def test_an_orbit_by_sgp4_joins_its_days(tmp_path: Path) -> None:
    """Each time by itself gives the same state, to what the equinox moves in a day: 0.1", 4 m; so do velocities."""
    path = tmp_path / "one.tle"
    path.write_text(VANGUARD, encoding="utf-8")
    start = datetime.datetime(2000, 6, 28)
    orbit = build_orbit(TleOrbitConfig(kind="tle", file=str(path)), start)
    assert orbit
    t_s = np.array([100.0, 43_100.0, 43_300.0, 130_000.0, 300.0])
    states = orbit.states(t_s)
    for n, t in enumerate(t_s):
        alone = state_at(orbit, float(t))
        assert np.linalg.norm(states.position_m[n] - alone.position_m) < 5
        assert np.linalg.norm(states.velocity_m_s[n] - alone.velocity_m_s) < 5e-3
        # And by SGP4 itself: lengths do not depend on the axes.
        record = orbit_elements.read_elements(str(path))[0].record
        minutes = (start - datetime.datetime(2000, 6, 27, 18, 50, 19, 733568)).total_seconds()
        _, place_km, velocity_km_s = record.sgp4_tsince((minutes + t) / 60)
        assert np.linalg.norm(alone.position_m) / 1e3 == pytest.approx(
            np.linalg.norm(place_km), abs=1e-3
        )
        assert np.linalg.norm(alone.velocity_m_s) / 1e3 == pytest.approx(
            np.linalg.norm(velocity_km_s), abs=1e-6
        )


def test_elements_of_another_satellite_or_year_are_refused(tmp_path: Path) -> None:
    """The nearest elements may be 365 days from the start, before or after it."""
    path = tmp_path / "one.tle"
    path.write_text(VANGUARD, encoding="utf-8")
    (element,) = orbit_elements.read_elements(str(path))
    epoch = datetime.datetime(2000, 6, 27, 18, 50, 19, 733568)
    day = datetime.timedelta(days=1)
    for days in (-364.99, 364.99, 0.0):
        orbit_elements.check_epochs("x", [element], epoch + days * day)
    for days, side in ((-365.6, "after"), (365.6, "before")):
        with pytest.raises(InputError, match=f"elements of 366 days {side} start_time"):
            orbit_elements.check_epochs("x", [element], epoch + days * day)
    config = TleOrbitConfig(kind="tle", file=str(path), number=6)
    with pytest.raises(InputError, match=r"6: 0 satellites of .*; allowed: one of 5$"):
        build_orbit(config, epoch)
    path.write_text(VANGUARD * 6, encoding="utf-8")
    with pytest.raises(
        InputError, match=r"5: 6 satellites of .*one of 5, 5, 5, 5, 5, \.\.\.$"
    ):
        build_orbit(TleOrbitConfig(kind="tle", file=str(path), number=5), epoch)
    path.write_text(VANGUARD * 5, encoding="utf-8")
    with pytest.raises(InputError, match=r"one of 5, 5, 5, 5, 5$"):
        build_orbit(TleOrbitConfig(kind="tle", file=str(path), number=5), epoch)


def test_names_and_checksums_of_a_tle_are_optional(tmp_path: Path) -> None:
    path = tmp_path / "some.tle"
    first, second = VANGUARD.splitlines()
    cases = {
        VANGUARD: "00005",
        f"VANGUARD 1\n{VANGUARD}": "VANGUARD 1",
        f"0 VANGUARD 1\n{VANGUARD}": "VANGUARD 1",
        f"1 OF 2\n{VANGUARD}": "1 OF 2",
        f"{first[:68]}\n{second[:68]}\n": "00005",
        f"{first}  \n{second}\n": "00005",
    }
    for text, name in cases.items():
        path.write_text(text, encoding="utf-8")
        (found,) = orbit_elements.read_elements(str(path))
        assert found.number == 5
        assert found.name in (name, name.lstrip("0"))
    path.write_text(f"A\n{VANGUARD}{VANGUARD}B\n{VANGUARD}", encoding="utf-8")
    names = [one.name for one in orbit_elements.read_elements(str(path))]
    assert [names[0], names[2]] == ["A", "B"]
    assert names[1].lstrip("0") == "5"
    for text, line in ((f"X\n{first}\n", 2), (f"{VANGUARD}{first[:60]}\n{second}\n", 4)):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=f"line {line}"):
            orbit_elements.read_elements(str(path))


def test_a_checksum_counts_digits_and_minus_signs_of_68_characters() -> None:
    assert orbit_elements.checksum("1 -2.3+4x" + " " * 58 + "55") == "6"
    assert orbit_elements.checksum("9" * 68) == "2"
    for line in VANGUARD.splitlines():
        assert orbit_elements.checksum(line) == line[-1]


def segment_of(t_s: Floats) -> str:
    return oem_text(t_s, *ellipse(t_s)).removeprefix("CCSDS_OEM_VERS = 2.0\n")


def test_segments_share_the_sample_at_their_seam(tmp_path: Path) -> None:
    """To a meter; one that differs more, or a time that is not later, is refused; so is a single sample."""
    path = tmp_path / "orbit.oem"
    head = "CCSDS_OEM_VERS = 2.0\n"
    first = segment_of(np.array([0.0, 60.0]))
    after = segment_of(np.array([60.0, 120.0]))
    path.write_text(head + first + after, encoding="utf-8")
    assert orbit_elements.read_oem(str(path), START).t_s.tolist() == [0, 60, 120]
    path.write_text(head + first + segment_of(np.array([90.0, 120.0])), encoding="utf-8")
    assert orbit_elements.read_oem(str(path), START).t_s.tolist() == [0, 60, 90, 120]
    x_km = ellipse(np.array([60.0]))[0][0, 0] / 1e3
    for off_km, same in ((0.9e-3, True), (1.1e-3, False)):
        moved = after.replace(f"{x_km:.9f}", f"{x_km + off_km:.9f}")
        assert moved != after
        path.write_text(head + first + moved, encoding="utf-8")
        if same:
            assert len(orbit_elements.read_oem(str(path), START).t_s) == 3
            continue
        with pytest.raises(InputError, match="the epochs of 4 samples"):
            orbit_elements.read_oem(str(path), START)
    path.write_text(head + segment_of(np.array([0.0, 0.5])), encoding="utf-8")
    assert orbit_elements.read_oem(str(path), START).t_s.tolist() == [0, 0.5]
    for bad, count in (
        (segment_of(np.array([60.0, 0.0])), 2),
        (segment_of(np.array([60.0])), 1),
        (segment_of(np.array([0.0, 60.0, 60.0])), 3),
    ):
        path.write_text(head + bad, encoding="utf-8")
        with pytest.raises(InputError, match=f"the epochs of {count} samples"):
            orbit_elements.read_oem(str(path), START)


def test_an_oem_s_own_accelerations_are_taken(tmp_path: Path) -> None:
    """A path of the fifth degree, which no gravity bends, is met exactly by its positions, speeds and accelerations."""
    path = tmp_path / "orbit.oem"
    rng = np.random.default_rng(7)
    factors = rng.standard_normal((6, 3)) * [[7e6], [5e3], [3.0], [1e-2], [1e-4], [1e-6]]
    factors[0] = [7e6, 1e6, -2e6]

    def at(t_s: Floats, order: int) -> Floats:
        columns = [
            Polynomial(column).deriv(order)(t_s) if order else Polynomial(column)(t_s)
            for column in factors.T
        ]
        return np.column_stack(columns)

    t_s = np.array([0.0, 50.0])
    text = oem_text(t_s, at(t_s, 0), at(t_s, 1))
    rows = text.splitlines()
    for n, row in enumerate(at(t_s, 2)):
        rows[len(rows) - 2 + n] += " " + " ".join(f"{one:.15f}" for one in row / 1e3)
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    orbit = orbit_elements.read_oem(str(path), START)
    between = np.array([0.0, 13.0, 31.0, 50.0])
    states = orbit.states(between)
    np.testing.assert_allclose(states.position_m, at(between, 0), rtol=0, atol=1e-3)
    np.testing.assert_allclose(states.velocity_m_s, at(between, 1), rtol=0, atol=1e-4)
    for t in (-0.001, 50.001):
        with pytest.raises(
            InputError, match=rf"from 0 to 50 s after start_time, not at {t:g} s"
        ):
            orbit.states(np.array([20.0, t]))


def test_a_low_orbit_s_gravity_is_that_of_a_flattened_earth_between_samples(
    tmp_path: Path,
) -> None:
    """Against an orbit that is integrated with the same potential: millimeters at two minutes."""
    path = tmp_path / "orbit.oem"
    start = np.concatenate(
        [
            circular().states(np.zeros(1)).position_m[0],
            circular().states(np.zeros(1)).velocity_m_s[0],
        ]
    )

    def slope(_: float, state: Floats) -> Floats:
        return np.concatenate([state[3:], orbit_elements.gravity_m_s2(state[None, :3])[0]])

    t_s = np.arange(0.0, 721.0, 120.0)
    exact = solve_ivp(
        slope, (0.0, 720.0), start, rtol=1e-12, atol=1e-6, dense_output=True
    ).sol
    samples = exact(t_s).T
    path.write_text(oem_text(t_s, samples[:, :3], samples[:, 3:]), encoding="utf-8")
    between = np.array([60.0, 200.0, 555.0])
    found = orbit_elements.read_oem(str(path), START).states(between)
    np.testing.assert_allclose(found.position_m, exact(between).T[:, :3], rtol=0, atol=5e-3)


def test_positions_within_the_earth_are_refused(tmp_path: Path) -> None:
    """Of less than 1,000 km along every axis: a file in meters, or of velocities first."""
    path = tmp_path / "orbit.oem"
    t_s = np.array([0.0, 60.0])
    for size_m, refused in ((0.99e6, True), (1.01e6, False)):
        place = np.array([[0.0, -size_m, 0.0], [0.0, -size_m, 1.0]])
        path.write_text(oem_text(t_s, place, np.ones((2, 3))), encoding="utf-8")
        if refused:
            with pytest.raises(InputError, match="line 7: a position in the Earth's core"):
                orbit_elements.read_oem(str(path), START)
        else:
            assert len(orbit_elements.read_oem(str(path), START).t_s) == 2


def test_what_the_ellipsoid_hides_is_where_a_ray_meets_it_first() -> None:
    """By the roots of x^2 + y^2 + (z / (1 - f))^2 = R^2 along the ray: between the camera and the point."""
    rng = np.random.default_rng(8)
    scale = np.array([1.0, 1.0, 1 / (1 - EARTH_FLATTENING)]) / EARTH_RADIUS_M
    hidden = []
    for _ in range(400):
        place = rng.standard_normal(3)
        place *= rng.uniform(6.5e6, 2e7) / np.linalg.norm(place)
        target = rng.standard_normal(3)
        target *= rng.uniform(6.5e6, 2e7) / np.linalg.norm(target)
        away = target - place
        distance_m = float(np.linalg.norm(away))
        direction = away / distance_m
        p = place * scale
        d = direction * scale
        roots = np.roots([d @ d, 2 * p @ d, p @ p - 1])
        met = [one.real for one in roots if abs(one.imag) < 1e-9]
        between = any(0 < one < distance_m for one in met)
        assert camera_orbit.hidden_by_earth(place, direction, distance_m) == between
        far = any(one > 0 for one in met)
        assert camera_orbit.hidden_by_earth(place, direction) == far
        both = camera_orbit.hidden_by_earth(
            np.array([place, place]), np.array([direction, -direction]), distance_m
        )
        assert both[0] == between
        hidden.append(between)
    assert 50 < sum(hidden) < 350


def test_a_limb_is_below_the_horizontal_by_the_dip() -> None:
    """In the plane of the equator, a circle: arccos(R / r) below it; at or under the ground no dip is left."""
    for height_m, dip in (
        (0.0, 0.0),
        (500e3, np.arccos(EARTH_RADIUS_M / (EARTH_RADIUS_M + 500e3))),
    ):
        place = (EARTH_RADIUS_M + height_m) * np.array([0.6, 0.8, 0.0])
        for elevation in (-0.5, 0.0, 0.3, 1.2):
            toward = np.cos(elevation) * np.array([-0.8, 0.6, 0]) + np.sin(
                elevation
            ) * place / np.linalg.norm(place)
            found = camera_orbit.limb_elevation_rad(place, 3.0 * toward)
            assert found == pytest.approx(elevation + dip, abs=1e-9)
    sunk = 0.99 * EARTH_RADIUS_M * np.array([1.0, 0.0, 0.0])
    assert camera_orbit.limb_elevation_rad(sunk, np.array([0.0, 1.0, 0.0])) == pytest.approx(
        0
    )


def test_a_direction_has_a_right_ascension_from_0_to_360() -> None:
    assert camera_orbit.to_astronomical(np.array([0.0, -2.0, 0.0])) == pytest.approx((270, 0))
    found = camera_orbit.to_astronomical(np.array([-1.0, 0.0, -1.0]))
    assert found == pytest.approx((180, -45))
