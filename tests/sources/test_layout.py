"""Positions of LEDs against distances, counts and the sky; their drive against the thesis's law."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import Lever, project
from estimator.core.camera import Camera
from skysim.core.errors import InputError
from skysim.core.types import Sources
from skysim.scene import loader
from skysim.scene.sections import light
from skysim.scene.sections.layouts import HOLES
from skysim.scene.sections.light import DomeConfig
from skysim.sources import catalog, dome
from skysim.sources import stars as star_sources
from skysim.sources.dome import surface
from skysim.sources.dome.layouts import boards, listed, placing, spreads
from skysim.sources.dome.layouts.led_list import led_list
from skysim.sources.dome.layouts.registry import board_of
from skysim.sources.dome.led import lit_moments_s
from skysim.sources.photometry import Band, led_strength_e_s_sr
from skysim.tracking.dome_map_file import DomeMap, write_dome_map

INCH_M = 0.0254
MEASURED = {
    "kind": "ellipsoid",
    "apex": "48 in",
    "semi_axes": ["38.88 in", "38.88 in", "28.60 in"],
}
SPHERE = {"kind": "sphere", "apex": "48 in", "radius": "48 in"}
FLAT = {"kind": "flat", "apex": "48 in"}
LED = {"intensity": "16 mcd", "disk_diameter": "2 mm"}
BOARDS = {
    "kind": "patch_boards",
    "cap_deg": 27,
    "spacing": "2.6 in",
    "pitch": "8 mm",
    "lit": [9, 9],
}
SKY = {
    "kind": "celestial",
    "cap_deg": 35,
    "camera": ["10 mm", "-20 mm", "15 in"],
    "zenith_ra_deg": 84,
    "zenith_dec_deg": 5,
    "roll_deg": 25,
    "epoch": "2012-03-01T12:00:00",
    "brightness": "v",
}
BAND = Band.from_efficiency("cmos")
SPREADS = [
    {"kind": "fibonacci", "count": 1400},
    {"kind": "random", "count": 1400},
    {"kind": "poisson_disk", "spacing": "1.3 in"},
]


GRID_BOARDS = {
    "kind": "patch_boards",
    "spread": "grid",
    "spacing": "3 in",
    "pitch": "8 mm",
    "lit": [9, 9],
    "cap_deg": 25,
}


def lit(layout: dict[str, Any], surface: dict[str, Any] = SPHERE, **led: Any) -> Sources:
    part = {
        "kind": "dome",
        "surface": surface,
        "layout": {"cap_deg": 40} | layout,
        "led": LED | led,
    }
    return dome.sources(DomeConfig.model_validate(part), BAND)


def inside(part: dict[str, Any]) -> Any:
    return surface.build_surface(TypeAdapter(light.AnySurface).validate_python(part))


def full_e_s_sr() -> float:
    return float(led_strength_e_s_sr(16e-3, "white", BAND))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# Spreads


@pytest.mark.slow
@pytest.mark.parametrize("surface", [SPHERE, MEASURED, FLAT])
@pytest.mark.parametrize("layout", SPREADS, ids=lambda part: part["kind"])
def test_every_led_is_on_the_surface_faces_along_its_normal_and_is_within_the_cap(
    layout: dict, surface: dict
) -> None:
    leds = lit(layout, surface)
    made = inside(surface)
    place = leds.place[:, :3]
    np.testing.assert_allclose(made.meet(np.zeros(3), unit(place)), place, rtol=0, atol=1e-14)
    np.testing.assert_allclose(leds.normal, made.inward(place), rtol=0, atol=1e-15)
    assert np.degrees(np.arccos(unit(place)[:, 2])).max() <= 40 + 1e-12
    np.testing.assert_array_equal(leds.id, np.arange(len(leds)))


def test_a_fibonacci_layout_has_the_expected_share_in_every_cap() -> None:
    """Of N LEDs over 40 deg, N (1 - cos a) / (1 - cos 40 deg) within a of any point: to 2 per cent and an LED."""
    leds = lit({"kind": "fibonacci", "count": 20_000})
    about = unit(np.array([[0, 0, 1.0], [0.3, 0.1, 1], [-0.2, 0.4, 1], [0.05, -0.5, 1]]))
    for reach_deg in (4, 7, 10):
        seen = (unit(leds.place[:, :3]) @ about.T > np.cos(np.radians(reach_deg))).sum(axis=0)
        share = (1 - np.cos(np.radians(reach_deg))) / (1 - np.cos(np.radians(40)))
        np.testing.assert_allclose(seen, 20_000 * share, rtol=0.02, atol=1)


@pytest.mark.slow
@pytest.mark.parametrize("surface", [SPHERE, MEASURED, FLAT])
def test_a_poisson_disk_layout_keeps_its_distance_and_leaves_no_gap(surface: dict) -> None:
    """No pair nearer than the spacing; and no place, but one in a thousand, has every LED farther than that."""
    leds = lit({"kind": "poisson_disk", "spacing": "1.3 in"}, surface)
    tree = cKDTree(leds.place[:, :3])
    assert tree.query(leds.place[:, :3], k=2)[0][:, 1].min() > 1.3 * INCH_M
    somewhere = lit({"kind": "random", "count": 20_000, "hardware_seed": 77}, surface)
    assert np.mean(tree.query(somewhere.place[:, :3])[0] > 1.3 * INCH_M) < 1e-3


@pytest.mark.long
def test_a_poisson_disk_layout_has_the_density_of_random_sequential_adsorption(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Disks of the spacing's diameter jam at a cover of .547, which t darts miss by some c / sqrt(t) (Feder's law).

    So the jam is at twice the cover by 4 t darts less that by t. Away from the rim, which has more of them.
    """
    cover = []
    for tries in (25, 100):
        monkeypatch.setattr(spreads, "DARTS_PER_SPACING2", tries)
        domes = [
            lit({"kind": "poisson_disk", "spacing": "1.3 in", "hardware_seed": s})
            for s in range(3)
        ]
        inner = np.mean(
            [np.sum(unit(leds.place[:, :3])[:, 2] > np.cos(np.radians(37))) for leds in domes]
        )
        cover.append(inner * 0.65**2 / (2 * 48**2 * (1 - np.cos(np.radians(37)))))
    assert cover[0] < cover[1]
    # Some 1,150 LEDs in three domes, of .06 of a Poisson field's variance (assumed): .4 %, extrapolated .9 %.
    assert 2 * cover[1] - cover[0] == pytest.approx(0.547, rel=0.03)


def test_random_leds_are_a_poisson_point_process() -> None:
    """Nearest neighbors of density n are .5 / sqrt(n) away, sd .2614 / sqrt(n); tenths of the area hold a tenth."""
    leds = lit({"kind": "random", "count": 4000, "hardware_seed": 3})
    place_in = leds.place[:, :3] / INCH_M
    tilt_deg = np.degrees(np.arccos(unit(place_in)[:, 2]))
    nearest = cKDTree(place_in).query(place_in[tilt_deg < 35], k=2)[0][:, 1]
    density = 4000 / (2 * np.pi * 48**2 * (1 - np.cos(np.radians(40))))
    # Two that are each other's nearest count once: the mean's sigma is up to sqrt(2) of independent ones'.
    sigma = np.sqrt(2) * 0.2614 / np.sqrt(density * len(nearest))
    assert nearest.mean() == pytest.approx(0.5 / np.sqrt(density), abs=4 * sigma)
    counts, _ = np.histogram(unit(place_in)[:, 2], np.linspace(np.cos(np.radians(40)), 1, 11))
    assert np.sum((counts - 400) ** 2 / 400) < 27.9  # chi-squared of nine, one in a thousand


# 1,000 attitudes: an even dome's own error is that of its LEDs at the field's border, a random one's of the .53 of
# 1,400 LEDs that tilts to 25 deg look at, 2.5 % conditioned on all: three of either.
# Poisson-disk's LEDs stand denser along the rim, as if the cap were wider by half of their spacing.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("layout", "rim_in", "within"),
    [(SPREADS[0], 0, 0.02), (SPREADS[1], 0, 0.08), (SPREADS[2], 0.65, 0.03)],
)
def test_the_afit_field_sees_eight_of_a_thousand(
    layout: dict, rim_in: float, within: float
) -> None:
    """27.3 in^2 (10.45 x 7.85 deg from 33 in) of a dome of 3,387 in^2 (thesis: 3,384): .008 N LEDs, any attitude."""
    leds = lit(layout)
    camera = Camera(1600, 1200, 800 / np.tan(np.radians(10.45 / 2)), (799.5, 599.5))
    lever = Lever(np.array([0, 0, 15 * INCH_M]), Rotation.identity())
    rng = np.random.default_rng(4)
    seen = []
    for _ in range(1000):
        tilt = np.arccos(1 - rng.random() * (1 - np.cos(np.radians(25))))
        lab_from_body = Rotation.from_euler(
            "ZYZ", [rng.uniform(0, 7), tilt, rng.uniform(0, 7)]
        )
        xy = project(lab_from_body.inv(), leds.place[:, :3], lever, camera)
        seen.append(np.sum(np.all((xy > -0.5) & (xy < [1599.5, 1199.5]), axis=1)))
    share = np.mean(seen) / len(leds)
    field_in2 = 4 * 33**2 * np.tan(np.radians(10.45 / 2)) * np.tan(np.radians(7.85 / 2))
    dome_in2 = 2 * np.pi * 48**2 * (1 - np.cos(np.radians(40) + rim_in / 48))
    assert share == pytest.approx(field_in2 / dome_in2, rel=within)
    assert round(share, 3) == 0.008


@pytest.mark.slow
@pytest.mark.parametrize(
    "layout", [*SPREADS, BOARDS, SKY | {"count": 40}], ids=lambda part: part["kind"]
)
def test_the_hardware_seed_determines_the_dome(layout: dict) -> None:
    first, again, other = (
        lit(layout | {"hardware_seed": s}, scatter=0.08) for s in (5, 5, 6)
    )
    for name in set(Sources.__slots__) - {"motion", "chromatic"}:
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not np.isin(other.strength, first.strength).any()


def test_levels_are_drawn_from_the_list_and_magnitudes_by_pogson() -> None:
    """Levels are equally frequent to four sigmas of n draws; five magnitudes are a factor of 100."""
    levels = lit({"kind": "fibonacci", "count": 3000, "levels": [1.0, 0.5, 0.25]}).on_s / 1e-3
    values, counts = np.unique(levels, return_counts=True)
    np.testing.assert_array_equal(values, [0.25, 0.5, 1.0])
    assert np.abs(counts - 1000).max() < 4 * np.sqrt(3000 * 2 / 9)
    shown = lit({"kind": "random", "count": 300, "magnitudes": [6.0, 1.0]}).on_s / 1e-3
    np.testing.assert_allclose(np.unique(shown), [0.01, 1], rtol=1e-12, atol=0)


# Boards by list, and glue


def listed_boards(*boards: dict[str, Any], **more: Any) -> Sources:
    layout = {"kind": "patch_boards", "cap_deg": 40, "pitch": "8 mm", "boards": list(boards)}
    return lit(layout | more, MEASURED)


def test_boards_on_a_grid_have_equal_areas_and_straight_rows() -> None:
    """On a sphere about the bearing: as many as spacings squared go into the cap, and a row's middles in one plane."""
    made = boards.grid(0.04, np.radians(40))
    area_sr = 2 * np.pi * (1 - np.cos(np.radians(40)))
    # Gauss's circle: the count is wrong by its boundary's lattice points at the most, 2 sqrt(2) pi (radius + 1).
    radius = 2 * np.sin(np.radians(20)) / 0.04
    assert abs(len(made) - area_sr / 0.04**2) < 2 * np.sqrt(2) * np.pi * (radius + 1)
    row = made[np.abs(made[:, 1]) < 1e-12]
    # Equal steps of 2 sin(t / 2) along the row through the zenith.
    out = np.sort(np.sign(row[:, 0]) * 2 * np.sin(np.arccos(np.clip(row[:, 2], -1, 1)) / 2))
    # The arc cosine's rounding at the zenith.
    np.testing.assert_allclose(np.diff(out), 0.04, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(made, axis=1), 1, rtol=0, atol=1e-15)


def test_grid_boards_lie_along_their_rows() -> None:
    leds = lit(GRID_BOARDS)
    place = leds.place[np.argsort(leds.id), :3].reshape(-1, HOLES, 3)
    step_m = place[:, 1] - place[:, 0]
    # Holes 0 and 1 are neighbors along the board's first axis, which has no part along the lab's x.
    np.testing.assert_allclose(np.linalg.norm(step_m, axis=1), 0.008, rtol=0, atol=1e-15)
    np.testing.assert_allclose(step_m[:, 0], 0, rtol=0, atol=1e-15)


def test_listed_boards_have_their_positions_leds_and_levels() -> None:
    leds = listed_boards(
        {"azimuth_deg": 30, "tilt_deg": 20, "leds": [4, 0, 8], "levels": [1.0, 0.5, 0.25]},
        {"azimuth_deg": 200, "tilt_deg": 7, "leds": [4, 1]},
    )
    np.testing.assert_array_equal(leds.id, [4, 0, 8, 13, 10])
    np.testing.assert_allclose(
        leds.on_s, np.array([1, 0.5, 0.25, 1, 1]) * 1e-3, rtol=1e-15, atol=0
    )
    tilt = np.radians([20, 7])
    azimuth = np.radians([30, 200])
    ray = np.array(
        [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
    ).T
    np.testing.assert_allclose(unit(leds.place[[0, 3], :3]), ray, rtol=0, atol=1e-15)
    apart_m = np.linalg.norm(leds.place[[1, 2], :3] - leds.place[0, :3], axis=1)
    np.testing.assert_allclose(apart_m, 0.008 * np.sqrt(2), rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        leds.normal[:3], np.tile(leds.normal[0], (3, 1)), rtol=0, atol=0
    )


def test_a_listed_board_turns_about_its_normal() -> None:
    where = {"azimuth_deg": 75, "tilt_deg": 18, "leds": list(range(9))}
    flat = listed_boards(where)
    turned = listed_boards(where | {"rotation_deg": 35})
    middle = flat.place[4, :3]
    about = Rotation.from_rotvec(np.radians(35) * flat.normal[0])
    expected = about.apply(flat.place[:, :3] - middle) + middle
    np.testing.assert_allclose(turned.place[:, :3], expected, rtol=0, atol=1e-15)


def test_a_board_on_the_rim_of_a_hemisphere_faces_along_the_lab_s_x() -> None:
    leds = lit(
        {
            "kind": "patch_boards",
            "cap_deg": 90,
            "pitch": "8 mm",
            "boards": [{"azimuth_deg": 0, "tilt_deg": 90, "leds": [3, 4, 5]}],
        }
    )
    np.testing.assert_allclose(leds.normal, np.tile([-1.0, 0, 0], (3, 1)), rtol=0, atol=1e-15)
    steps = np.linalg.norm(np.diff(leds.place[:, :3], axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.008, rtol=0, atol=1e-15)


def test_glue_moves_each_led_in_its_board_s_plane_as_declared() -> None:
    """Reference 1.3: 0.12 mm. Normal along two axes: moments of each to four of their sigmas."""
    ideal = lit(BOARDS, MEASURED)
    real = lit(BOARDS | {"glue_scatter": "0.12 mm"}, MEASURED)
    np.testing.assert_array_equal(ideal.id, real.id)
    np.testing.assert_array_equal(ideal.start_s, real.start_s)
    displacement = (real.place - ideal.place)[:, :3]
    n = len(displacement)
    assert n > 1000
    np.testing.assert_allclose(
        np.einsum("nj,nj->n", displacement, ideal.normal), 0, rtol=0, atol=1e-15
    )
    one = unit(np.cross(ideal.normal, [0, 1.0, 0]))
    a, b = (
        np.einsum("nj,nj->n", displacement, axis) / 0.12e-3
        for axis in (one, np.cross(ideal.normal, one))
    )
    for value in (a, b):
        assert abs(value.mean()) < 4 / np.sqrt(n)
        assert value.var() == pytest.approx(1, abs=4 * np.sqrt(2 / n))
    assert abs(np.mean(a * b)) < 4 / np.sqrt(n)


def test_glue_tilts_boards_evenly_up_to_its_limit_and_keeps_them_flat() -> None:
    """Normals uniform over a cap of 5 deg: (1 - cos) / (1 - cos 5 deg) has mean 1/2 and variance 1/12."""
    made = inside(MEASURED)
    leds = lit(BOARDS | {"spacing": "1.5 in", "glue_tilt_deg": 5}, MEASURED)
    middle = leds.take(leds.id % 9 == 4)
    np.testing.assert_allclose(
        made.meet(np.zeros(3), unit(middle.place[:, :3])),
        middle.place[:, :3],
        rtol=0,
        atol=1e-14,
    )
    straight = made.inward(middle.place[:, :3])
    cosine = np.einsum("nj,nj->n", middle.normal, straight)
    n = len(cosine)
    share = (1 - cosine) / (1 - np.cos(np.radians(5)))
    assert share.max() <= 1 + 1e-12
    assert share.mean() == pytest.approx(0.5, abs=4 / np.sqrt(12 * n))
    assert share.var() == pytest.approx(1 / 12, abs=4 / np.sqrt(180 * n))
    sideways = np.linalg.norm((middle.normal - cosine[:, None] * straight).mean(axis=0))
    assert sideways < 4 * np.sin(np.radians(5)) / np.sqrt(n)
    corner = leds.place[np.argsort(leds.id)].reshape(n, 9, 4)[:, :, :3]
    off = np.einsum(
        "bhj,bj->bh", corner - corner[:, 4:5], middle.normal[np.argsort(middle.id)]
    )
    np.testing.assert_allclose(off, 0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        np.linalg.norm(corner[:, 8] - corner[:, 0], axis=1),
        0.016 * np.sqrt(2),
        rtol=0,
        atol=1e-14,
    )


# The real sky


@pytest.mark.parametrize("surface", [SPHERE, MEASURED, FLAT])
def test_from_its_nominal_position_the_camera_sees_stars_in_true_directions(
    surface: dict,
) -> None:
    """Angle from the zenith and position angle there, by spherical trigonometry from the apparent RA and Dec."""
    leds = lit(SKY | {"count": 60}, surface)
    stars = catalog.read("hipparcos_hp6.5")
    stars = stars.take(np.array([np.flatnonzero(stars.hip == hip)[0] for hip in leds.id]))
    config = DomeConfig.model_validate(
        {"kind": "dome", "surface": surface, "layout": SKY | {"count": 60}, "led": LED}
    )
    x, y, z = star_sources.apparent(stars, config.layout.epoch).T
    ra = np.arctan2(y, x) - np.radians(84)
    dec = np.arcsin(z)
    zenith = np.radians(5)
    cosine = np.sin(dec) * np.sin(zenith) + np.cos(dec) * np.cos(zenith) * np.cos(ra)
    east = np.cos(dec) * np.sin(ra)
    north = np.sin(dec) * np.cos(zenith) - np.cos(dec) * np.sin(zenith) * np.cos(ra)
    roll = np.radians(
        25
    )  # of the lab's -y, from north through east, which is -x where north is -y
    expected = np.column_stack(
        [
            -(east * np.cos(roll) - north * np.sin(roll)),
            -(north * np.cos(roll) + east * np.sin(roll)),
            cosine,
        ]
    )
    seen = unit(leds.place[:, :3] - np.array([0.01, -0.02, 15 * INCH_M]))
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(leds.magnitude, stars.v_mag)


@pytest.mark.parametrize("drive", ["pwm", "direct"])
def test_light_at_the_nominal_position_follows_pogson_s_law(drive: str) -> None:
    """I D cos(theta) / d^2 of every LED is 10^(-0.4 V) of the brightest's, whatever its distance and slant."""
    leds = lit(SKY | {"limit_mag": 4.5}, FLAT, drive={"kind": drive})
    to_camera = np.array([0.01, -0.02, 15 * INCH_M]) - leds.place[:, :3]
    distance_m = np.linalg.norm(to_camera, axis=1)
    cosine = np.einsum("nj,nj->n", to_camera, leds.normal) / distance_m
    reaches = leds.strength * leds.on_s / leds.period_s * cosine / distance_m**2
    expected = 10 ** (-0.4 * (leds.magnitude - leds.magnitude[0]))
    np.testing.assert_allclose(reaches / reaches[0], expected, rtol=1e-12, atol=0)
    shares = leds.strength / full_e_s_sr() * leds.on_s / leds.period_s
    assert shares.max() == pytest.approx(1, abs=1e-12)
    assert np.ptp(distance_m) > 0.1  # they did have something to make up for


def test_no_star_is_shown_brighter_than_the_limit() -> None:
    leds = lit(
        SKY | {"limit_mag": 4.5, "camera": ["0 m", "0 m", "0 m"], "brightest_mag": 2.0}
    )
    assert np.sum(leds.magnitude < 2) >= 5  # Orion
    expected = 10 ** (-0.4 * (np.maximum(leds.magnitude, 2.0) - 2.0))
    np.testing.assert_allclose(leds.on_s / leds.period_s, expected, rtol=1e-12, atol=0)


def test_count_and_limit_choose_the_brightest_that_are_on_the_dome() -> None:
    to_limit = lit(SKY | {"limit_mag": 4.0})
    assert to_limit.magnitude.max() <= 4.0
    np.testing.assert_array_equal(np.sort(to_limit.magnitude), to_limit.magnitude)
    counted = lit(SKY | {"count": len(to_limit)})
    np.testing.assert_array_equal(counted.id, to_limit.id)
    tilt_deg = np.degrees(np.arccos(unit(to_limit.place[:, :3])[:, 2]))
    assert 30 < tilt_deg.max() <= 35
    # Betelgeuse, Rigel, Bellatrix, and the belt stand within 35 deg of (84, 5).
    assert {27989, 24436, 25336, 25930, 26311, 26727} <= set(to_limit.id)


def test_a_millimeter_off_the_nominal_position_causes_the_apl_dome_s_error() -> None:
    """Reference 5: on a sphere of 4 ft a camera 1 mm off its center is wrong by 169 arcsec, d/R sin of the angle."""
    dome_4ft = {"kind": "sphere", "apex": "4 ft", "radius": "4 ft"}
    leds = lit(
        SKY | {"limit_mag": 6.0, "cap_deg": 80, "camera": ["0 m", "0 m", "0 m"]}, dome_4ft
    )
    moved = unit(leds.place[:, :3] - np.array([1e-3, 0, 0]))
    error_arcsec = np.degrees(np.linalg.norm(moved - unit(leds.place[:, :3]), axis=1)) * 3600
    across = np.sqrt(1 - unit(leds.place[:, :3])[:, 0] ** 2)
    np.testing.assert_allclose(error_arcsec, 169.2 * across, rtol=2e-3, atol=0)
    assert error_arcsec.max() == pytest.approx(169, abs=1)


# Lists


def test_listed_directions_are_put_on_the_surface_and_positions_kept() -> None:
    leds = lit(
        {"kind": "listed", "directions_deg": [[0, 0], [90, 30]], "levels": [1.0, 0.3]},
        MEASURED,
    )
    np.testing.assert_allclose(
        unit(leds.place[:, :3]), [[0, 0, 1], [0, 0.5, np.sqrt(0.75)]], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(leds.place[0, 2], 48 * INCH_M, rtol=0, atol=1e-15)
    np.testing.assert_allclose(leds.on_s, [1e-3, 0.3e-3], rtol=1e-15, atol=0)
    places = [["0.1 m", "0.2 m", "1.2 m"], ["0 m", "0 m", "47.5 in"]]
    leds = lit({"kind": "listed", "positions": places, "magnitudes": [3.5, 1.0]}, FLAT)
    np.testing.assert_allclose(
        leds.place[:, :3], [[0.1, 0.2, 1.2], [0, 0, 1.2065]], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(leds.on_s, [1e-4, 1e-3], rtol=1e-12, atol=0)
    np.testing.assert_array_equal(leds.normal, [[0, 0, -1.0], [0, 0, -1.0]])


def test_a_file_of_leds_equals_a_list_in_the_scene(tmp_path: Path) -> None:
    path = tmp_path / "leds.csv"
    path.write_text("# surveyed\nazimuth_deg, tilt_deg, magnitude\n0,0,1.0\n\n90,30,3.5\n")
    listed = {"kind": "listed", "directions_deg": [[0, 0], [90, 30]], "levels": [1.0, 0.1]}
    from_file = lit({"kind": "listed", "file": str(path)}, MEASURED)
    from_list = lit(listed, MEASURED)
    for name in set(Sources.__slots__) - {"motion", "chromatic"}:
        np.testing.assert_allclose(
            getattr(from_file, name), getattr(from_list, name), rtol=1e-14, atol=0
        )
    rows = "\n".join(",".join(map(repr, row)) for row in from_list.place[:, :3].tolist())
    path.write_text(f"x_m,y_m,z_m\n{rows}\n")
    np.testing.assert_array_equal(
        lit({"kind": "listed", "file": str(path)}, MEASURED).place, from_list.place
    )


@pytest.mark.parametrize(
    "layout",
    [
        {"kind": "poisson_disk", "count": 100},
        {
            "kind": "string",
            "pitch": "0.1 m",
            "spacing": "0.1 m",
            "lit_fraction": 0.6,
            "levels": [0.2, 1.0],
        },
        {
            "kind": "string",
            "pitch": "0.1 m",
            "spacing": "0.1 m",
            "winding": "spiral",
            "lit_fraction": 0.6,
        },
        BOARDS,
        SKY | {"count": 50},
    ],
    ids=["poisson_disk", "circles", "spiral", "boards", "sky"],
)
def test_the_exported_list_of_leds_is_read_back(
    tmp_path: Path, layout: dict[str, Any]
) -> None:
    path = tmp_path / "leds.csv"
    direct = {"drive": {"kind": "direct"}, "scatter": 0.0}
    config = {
        "kind": "dome",
        "surface": SPHERE,
        "layout": {"cap_deg": 40} | layout,
        "led": LED | direct,
    }
    text, cap_deg = led_list(DomeConfig.model_validate(config), BAND, "mine")
    path.write_text(text)
    planned = lit(layout, SPHERE, **direct)
    read = lit({"kind": "listed", "cap_deg": cap_deg, "file": str(path)}, SPHERE, **direct)
    np.testing.assert_allclose(read.place, planned.place, rtol=0, atol=1e-12)
    np.testing.assert_allclose(read.strength, planned.strength, rtol=1e-8, atol=0)
    np.testing.assert_array_equal(read.id, planned.id)
    # The LEDs of a board have its normal, those of a list the surface's.
    np.testing.assert_allclose(
        read.normal, planned.normal, rtol=0, atol=0.02 if layout is BOARDS else 1e-11
    )


@pytest.mark.parametrize("winding", ["latitude", "spiral", "meridian"])
def test_an_led_is_at_its_listed_place_on_its_tape(winding: str) -> None:
    """LEDs that follow each other on one tape are a pitch apart: by the chord, which is a little less."""
    layout = {
        "kind": "string",
        "pitch": "2 cm",
        "spacing": "0.1 m",
        "winding": winding,
        "cap_deg": 40,
    }
    layout |= {"pitch_error": 0.01, "glue_scatter": "1 mm"}  # the list is the design
    config = DomeConfig.model_validate(
        {"kind": "dome", "surface": SPHERE, "layout": layout, "led": LED}
    )
    text, _ = led_list(config, BAND, "mine")
    rows = np.genfromtxt(
        text.splitlines(), delimiter=",", names=True, skip_header=text.count("#")
    )
    place_m = np.column_stack([rows[name] for name in ("x_m", "y_m", "z_m")])
    same = np.diff(rows["tape"]) == 0
    far = rows["tilt_deg"][:-1] > 10
    np.testing.assert_allclose(np.diff(rows["tape_m"])[same], 0.02, rtol=1e-6)
    chord_m = np.linalg.norm(np.diff(place_m, axis=0), axis=1)[same & far]
    np.testing.assert_allclose(chord_m, 0.02, rtol=1e-3)
    rings = len(np.unique(np.round(rows["tilt_deg"], 4)))
    assert rows["tape"].max() + 1 == {"latitude": rings, "spiral": 1, "meridian": 64}[winding]
    assert np.all(rows["tape_m"][np.append(True, ~same)] == 0)


def test_a_survey_s_file_is_a_list_of_leds(tmp_path: Path) -> None:
    place_m = lit({"kind": "fibonacci", "count": 5}, SPHERE).place[:, :3]
    zero = (0.0, 0.0)
    lens: dict[str, Any] = {
        "size_px": (640, 480),
        "focal_px": 1000.0,
        "focal_sigma_px": 0.0,
        "center_px": zero,
    }
    lens |= {
        "center_sigma_px": zero,
        "distortion": (0.0,) * 5,
        "distortion_sigma": (0.0,) * 5,
    }
    found = np.array([7, 3, 11, 4, 9])
    errors: dict[str, Any] = {
        "own_m2": np.tile(1e-8 * np.eye(3), (5, 1, 1)),
        "common_m": np.full((2, 5, 3), -1e-5),
        "common_camera": np.zeros((2, 11)),
    }
    surveyed = DomeMap(found, place_m, np.full(5, 1e-4), np.zeros(3), 1e-4, **lens, **errors)
    write_dome_map(tmp_path / "leds.ecsv", surveyed)
    read = lit({"kind": "listed", "file": str(tmp_path / "leds.ecsv")}, SPHERE)
    np.testing.assert_array_equal(read.id, found)
    np.testing.assert_allclose(read.place[:, :3], place_m, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x_m,y_m,z_m,size\n0,0,1,1\n", "not a list of LEDs"),
        (
            "x_m,y_m,z_m,id\n0,0,1.2,1\n0,0.1,1.2,1\n",
            ", line 3: id 1; allowed: whole numbers from 0, each once",
        ),
        ("x_m,y_m,z_m,id\n0,0,1.2,0.5\n", ", line 2: id 0.5; allowed: whole numbers from 0"),
        (
            "x_m,y_m,z_m,id\n0,0,1.2,1e300\n",
            ", line 2: '1e300' is not a finite number up to 1e+15",
        ),
        (
            "x_m,y_m\n1,2\n",
            "not a list of LEDs; allowed: columns x_m, y_m, z_m or azimuth_deg, tilt_deg, or x_mm",
        ),
        ("azimuth_deg,tilt_deg\n", "not a list of LEDs"),
        ("", "not a list of LEDs"),
        (
            "azimuth_deg,tilt_deg\n0,0\n# half\n1\n",
            ", line 4: 1 values; allowed: 2",
        ),
        (
            "azimuth_deg,tilt_deg,level\n0,0,1.5\n",
            ", line 2: level 1.5; allowed: above 0 and at most 1",
        ),
        ("azimuth_deg,tilt_deg,level\n0,nan,1\n", ", line 2: 'nan' is not a finite number"),
        ("azimuth_deg,tilt_deg\n0,0\n10,50\n", ", line 3: 50 deg from the zenith"),
        ("x_m,y_m,z_m\n0,0,48\n", ", line 2: 46.8 m from the surface; allowed: 0.05 m"),
        ("x_m,y_m,z_m\n0,0,0\n", ", line 2: 0 deg from the zenith"),
    ],
)
def test_a_bad_file_of_leds_is_refused_in_one_line(
    tmp_path: Path, text: str, says: str
) -> None:
    path = tmp_path / "leds.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        lit({"kind": "listed", "file": str(path)})
    message = str(caught.value)
    assert says in message
    assert message.startswith(str(path))
    assert "\n" not in message


# What a scene may not say


@pytest.mark.parametrize(
    ("layout", "says"),
    [
        (
            "{kind: spiral}",
            "light.layout.kind: unknown kind 'spiral'; allowed: patch_boards, fibonacci, poisson_disk, random,",
        ),
        ("{kind: fibonacci, cap_deg: 30}", "light.layout.count: missing"),
        ("{kind: fibonacci, cap_deg: 30, count: 0}", "light.layout.count: 0 is not allowed"),
        (
            "{kind: fibonacci, cap_deg: 30, count: 9, spacing: 1 in}",
            "light.layout.spacing: unknown key; allowed: cap_deg, levels,",
        ),
        (
            "{kind: random, cap_deg: 30, count: 9, levels: [1.2]}",
            "light.layout.levels.0: 1.2 is not allowed",
        ),
        (
            "{kind: random, cap_deg: 30, count: 9, levels: [1], magnitudes: [2]}",
            "either levels or magnitudes",
        ),
        (
            "{kind: poisson_disk, cap_deg: 30, spacing: 1 um}",
            "light.layout.spacing: 1e-06 m gives too many LEDs",
        ),
        (
            "{kind: patch_boards, cap_deg: 30, pitch: 8 mm}",
            "patch_boards takes spacing, or boards by list",
        ),
        (
            "{kind: patch_boards, cap_deg: 30, pitch: 8 mm, boards: [{azimuth_deg: 0, tilt_deg: 0, leds: [1, 1]}]}",
            "light.layout.boards.0.leds: [1, 1] has a duplicate hole",
        ),
        (
            "{kind: patch_boards, cap_deg: 30, pitch: 8 mm, boards: [{azimuth_deg: 0, tilt_deg: 0, leds: [9]}]}",
            "light.layout.boards.0.leds.0: 9 is not allowed",
        ),
        (
            "{kind: patch_boards, cap_deg: 30, pitch: 8 mm, boards: [{azimuth_deg: 0, tilt_deg: 0, leds: [1],"
            " levels: [1, 1]}]}",
            "leds has 1 holes, levels 2",
        ),
        (
            "{kind: patch_boards, cap_deg: 30, pitch: 8 mm, boards: [{azimuth_deg: 0, tilt_deg: 0, leds: [1]},"
            " {azimuth_deg: 0, tilt_deg: 1, leds: [1]}]}",
            "light.layout.boards.1: overlaps board 0, 0.0213 m away; allowed: 0.024 m, three pitches",
        ),
        (
            "{kind: patch_boards, cap_deg: 30, pitch: 8 mm, boards: [{azimuth_deg: 0, tilt_deg: 31, leds: [1]}]}",
            "light.layout.boards.0: 31 deg from the zenith",
        ),
        (
            "{kind: listed, cap_deg: 30}",
            "listed takes one of positions, directions_deg, file",
        ),
        (
            "{kind: listed, cap_deg: 30, directions_deg: [[0, 1]], levels: [1, 1]}",
            "1 LEDs, but 2 levels or magnitudes",
        ),
        (
            "{kind: listed, cap_deg: 30, file: x.csv, levels: [1]}",
            "of a file belong in its columns",
        ),
        (
            "{kind: listed, cap_deg: 30, file: nowhere.csv}",
            "light.layout.file: nowhere.csv: cannot be read",
        ),
        (
            "{kind: listed, cap_deg: 30, directions_deg: [[0, 1], [5, 40]]}",
            "light.layout.directions_deg.1: 40 deg from the zenith",
        ),
    ],
)
def test_a_wrong_layout_is_refused_in_one_line(layout: str, says: str) -> None:
    assert_refused({"light.layout": layout}, says)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("", "celestial takes either count or limit_mag"),
        ("count: 5, limit_mag: 3", "celestial takes either count or limit_mag"),
        ("limit_mag: -2", "light.layout.limit_mag: no star to -2 mag on the dome"),
        ("count: 90000", "light.layout.count: 90000 LEDs, but the catalog gives "),
        (
            "count: 5, catalog: gaia",
            "light.layout.catalog: unknown catalog 'gaia'; allowed: gaia_v8.0, hipparcos_hp6.5",
        ),
        (
            "count: 5, epoch: 1700-01-01T00:00:00",
            "epoch: 1700-01-01T00:00:00 is outside 1900 to 2100",
        ),
        (
            "count: 5, camera: [0 m, 0 m, 2 m]",
            "light.layout.camera: 2 m from the bearing's center, outside",
        ),
    ],
)
def test_a_wrong_projected_sky_is_refused_in_one_line(more: str, says: str) -> None:
    camera = "" if "camera" in more else "camera: [0 m, 0 m, 0.3 m],"
    layout = f"{{kind: celestial, cap_deg: 30, {camera} zenith_ra_deg: 1, zenith_dec_deg: 2, {more}}}"
    assert_refused({"light.layout": layout}, says)


def assert_refused(overrides: dict[str, str], says: str) -> None:
    with pytest.raises(InputError) as caught:
        dome.sources(loader.load("afit_simsat", overrides).light, BAND)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_each_led_has_its_board_s_number_if_there_are_boards() -> None:
    config = loader.load("afit_simsat").light
    leds = dome.sources(config, BAND)
    boards = board_of(config.layout, leds.id)
    assert boards is not None
    middle = np.array([leds.place[boards == b, :3].mean(axis=0) for b in np.unique(boards)])
    # Corner to corner.
    assert np.linalg.norm(middle[boards] - leds.place[:, :3], axis=1).max() < 0.0227
    spread = loader.load(
        "afit_simsat", {"light.layout": "{kind: fibonacci, cap_deg: 9, count: 5}"}
    ).light
    assert board_of(spread.layout, np.arange(5)) is None


# Drives


def test_leds_at_direct_current_are_always_lit_and_dimmed_by_current() -> None:
    leds = lit(
        {"kind": "listed", "directions_deg": [[0, 1], [0, 2]], "levels": [1.0, 0.2]},
        drive={"kind": "direct"},
    )
    assert np.all(leds.on_s >= leds.period_s)
    np.testing.assert_allclose(
        leds.strength, np.array([1, 0.2]) * full_e_s_sr(), rtol=1e-15, atol=0
    )
    assert lit_moments_s(0.3, 0.30001, leds.period_s[1], leds.start_s[1], leds.on_s[1])[
        0
    ] == pytest.approx(1e-5)


def light_s(leds: Sources, which: int, begin_s: float, length_s: float) -> float:
    pulses = leds.period_s[which], leds.start_s[which], leds.on_s[which]
    return float(lit_moments_s(begin_s, begin_s + length_s, *pulses)[0])


def sequential(count: int, **more: Any) -> dict[str, Any]:
    """One board of this number of LEDs on an Arduino."""
    board = {"azimuth_deg": 10, "tilt_deg": 5, "leds": list(range(count))} | more
    return {"kind": "patch_boards", "cap_deg": 40, "pitch": "8 mm", "boards": [board]}


def test_slots_without_an_led_stay_dark() -> None:
    """Two LEDs in a cycle of nine slots of 1 ms: each is lit for a ninth of the time (thesis, eq. 37)."""
    drive = {"kind": "sequential", "slot": "1 ms", "slots": 9}
    leds = lit(sequential(2), drive=drive)
    assert leds.period_s == pytest.approx(9e-3)
    assert leds.on_s / leds.period_s == pytest.approx(1 / 9)
    with pytest.raises(InputError, match=r"slots: 2; allowed: 5 LEDs"):
        lit(sequential(5), drive=drive | {"slots": 2})


def test_sequential_leds_are_lit_one_after_another_for_their_share() -> None:
    """Eq. 37: D = t_on / sum T; never two at once, and the whole cycle is lit where every level is one."""
    leds = lit(sequential(5), drive={"kind": "sequential", "slot": "1 ms"})
    np.testing.assert_allclose(leds.period_s, 5e-3, rtol=1e-15, atol=0)
    np.testing.assert_allclose(leds.on_s / leds.period_s, 0.2, rtol=1e-15, atol=0)
    looks = leds.start_s[0] + (np.arange(1000) + 0.5) * 37.1e-6
    on = (looks[:, None] - leds.start_s) % leds.period_s < leds.on_s
    np.testing.assert_array_equal(on.sum(axis=1), 1)
    turn = np.round((leds.start_s - leds.start_s[0]) / 1e-3)
    np.testing.assert_array_equal(turn, np.arange(5))


@pytest.mark.parametrize(("controller", "sharing"), [("board", 9), ("dome", 27), (6, 6)])
def test_a_cycle_is_as_long_as_its_controller_has_leds(
    controller: str | int, sharing: int
) -> None:
    boards = [
        {"azimuth_deg": a, "tilt_deg": 20, "leds": list(range(9))} for a in (0, 120, 240)
    ]
    layout = sequential(9) | {"boards": boards}
    leds = lit(layout, drive={"kind": "sequential", "slot": "2 ms", "controller": controller})
    last = 27 % sharing or sharing
    np.testing.assert_allclose(leds.period_s[:-last], sharing * 2e-3, rtol=1e-15, atol=0)
    np.testing.assert_allclose(leds.period_s[-last:], last * 2e-3, rtol=1e-15, atol=0)
    # All of a controller's turns are taken, in the order of its LEDs.
    group = np.arange(27) // sharing
    for one in np.unique(group):
        start = (leds.start_s[group == one] - leds.start_s[group == one][0]) / 2e-3
        np.testing.assert_allclose(start, np.arange(len(start)), rtol=0, atol=1e-9)


def test_controllers_have_independent_random_phases() -> None:
    """Phases of boards are uniform over the cycle: mean to four sigmas, and the boards' are not one another's."""
    leds = lit(BOARDS | {"lit": [5, 5], "spacing": "1.5 in"}, drive={"kind": "sequential"})
    first = np.array([leds.start_s[leds.id // 9 == b].min() for b in np.unique(leds.id // 9)])
    assert len(np.unique(first)) == len(first)
    assert first.mean() == pytest.approx(2.5e-3, abs=4 * 5e-3 / np.sqrt(12 * len(first)))
    assert 0 <= first.min() < first.max() < 5e-3


def test_a_layout_without_boards_requires_leds_per_controller() -> None:
    spread = {
        "light.layout": "{kind: fibonacci, cap_deg: 30, count: 9}",
        "light.led.drive": "{kind: sequential}",
    }
    assert_refused(
        spread,
        "light.led.drive.controller: fibonacci has no boards; allowed: dome, or a number of LEDs",
    )
    assert_refused(
        {"light.led.drive": "{kind: fm}"},
        "light.led.drive.kind: unknown kind 'fm'; allowed: direct, pwm, sequential",
    )
    assert_refused(
        {"light.led.drive": "{kind: sequential, slot: 1}"},
        "light.led.drive.slot: 1 has no unit",
    )


def relative_sd(leds: Sources, which: int, exposure_s: float) -> float:
    """Frame-to-frame flicker: relative deviation of the light over start times uniform in the cycle."""
    begins = (np.arange(4000) + 0.5) / 4000 * leds.period_s[which]
    got = np.array([light_s(leds, which, begin, exposure_s) for begin in begins])
    return float(got.std() / got.mean())


@pytest.mark.parametrize("level", [0.001, 0.01])
@pytest.mark.parametrize(
    ("cycles", "part"), [(2, 0.5), (6, 0.6), (3, 2 / 3), (9, 0.05), (20, 0.93)]
)
def test_a_short_pulse_s_flicker_matches_the_reference(
    cycles: int, part: float, level: float
) -> None:
    """Reference 1.3: in an exposure of (n + f) cycles n or n + 1 pulses fall: sqrt(f (1 - f)) / (n + f)."""
    leds = lit(sequential(6, levels=[level] * 6), drive={"kind": "sequential"})
    law = np.sqrt(part * (1 - part)) / (cycles + part)
    # A pulse of share w = level / 6 of the cycle that is cut takes w / 3 off the variance f (1 - f); 4,000 begins
    # count f to 1 / 4,000.
    share = level / 6
    error = (share / 3 + 1 / 4000) / (2 * part * (1 - part))
    assert relative_sd(leds, 2, (cycles + part) * 6e-3) == pytest.approx(
        law, rel=error + 1e-3
    )


@pytest.mark.parametrize(("count", "published"), [(5, 0.063), (2, 0.017), (9, 0.117)])
def test_the_flicker_of_full_slots_at_33_ms_matches_the_reference(
    count: int, published: float
) -> None:
    """Variance f (1 - f) - w / 3 of a pulse of share w <= f <= 1 - w: 6.3, 1.7 and 11.7 % for 5, 2 and 9 LEDs."""
    leds = lit(sequential(count), drive={"kind": "sequential"})
    cycle = 33 / count
    part = cycle % 1
    share = 1 / count
    law = np.sqrt(part * (1 - part) - share / 3) / cycle
    got = relative_sd(leds, count - 1, 33e-3)
    assert got == pytest.approx(law, rel=2e-3)
    assert got == pytest.approx(published, abs=0.001)


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_whole_cycles_do_not_flicker(count: int) -> None:
    levels = [1.0, 0.5, 0.4, 0.2, 0.001, 1, 1, 1, 1][:count]
    leds = lit(sequential(count, levels=levels), drive={"kind": "sequential"})
    for which in range(count):
        assert relative_sd(leds, which, 7 * count * 1e-3) < 1e-9


# AFIT thesis, Table 7: t_on in us of a 1 ms slot, and the mean brightness seen.
TABLE_7 = {1000: 146.7, 500: 116.0, 400: 87.8, 200: 44.9, 1: 16.6}


def test_the_measured_order_and_ratio_of_levels_matches_table_7() -> None:
    """Reference A10: the ordering; 200-500 us are linear, and the published slopes are one number to 5 per cent."""
    levels = [on_us / 1000 for on_us in TABLE_7]
    leds = lit(sequential(5, levels=levels), drive={"kind": "sequential"})
    ours = np.array([light_s(leds, which, 0.0123, 40e-3) for which in range(5)])
    np.testing.assert_array_equal(
        np.argsort(-ours), np.argsort(-np.array(list(TABLE_7.values())))
    )
    # Eight cycles of 5 ms.
    np.testing.assert_allclose(ours, 8e-6 * np.array(list(TABLE_7)), rtol=1e-9, atol=0)
    slopes = np.array(
        [TABLE_7[on_us] / ours[n] for n, on_us in enumerate(TABLE_7) if 200 <= on_us <= 500]
    )
    np.testing.assert_allclose(slopes / slopes.mean(), 1, rtol=0, atol=0.05)


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e-3), ("cm", 0.01), ("in", INCH_M)])
def test_the_header_of_a_list_states_the_unit(
    unit: str, scale: float, tmp_path: Path
) -> None:
    place_m = lit({"kind": "listed", "directions_deg": [[0, 0], [90, 30]]}, MEASURED).place
    path = tmp_path / "leds.csv"
    rows = "\n".join(",".join(map(repr, row)) for row in (place_m[:, :3] / scale).tolist())
    path.write_text(f"x_{unit},y_{unit},z_{unit}\n{rows}\n")
    read = lit({"kind": "listed", "file": str(path)}, MEASURED).place
    np.testing.assert_allclose(read, place_m, rtol=0, atol=1e-12)
    path.write_text(f"x_m,y_m,z_m\n{rows}\n")
    with pytest.raises(InputError, match=r"m from the surface; allowed: 0.05 m; .* x_mm"):
        lit({"kind": "listed", "file": str(path)}, MEASURED)


@pytest.mark.parametrize("names", ["azimuth_deg,tilt_deg", "azimuth_deg,tilt_deg,id"])
def test_an_led_that_is_listed_twice_is_refused(names: str, tmp_path: Path) -> None:
    """Without a column id a repeated row was a light more; at the zenith any azimuth is the same place."""
    path = tmp_path / "leds.csv"
    rows = [
        f"{azimuth},{tilt},{n}"
        for n, (azimuth, tilt) in enumerate([(0, 0), (90, 30), (7, 0)])
    ]
    columns = names.count(",") + 1
    path.write_text("\n".join([names, *(",".join(row.split(",")[:columns]) for row in rows)]))
    with pytest.raises(
        InputError,
        match=r"leds.csv, line 4: at the place of .*leds.csv, line 2; allowed: each LED once",
    ):
        lit({"kind": "listed", "file": str(path)}, MEASURED)


@pytest.mark.parametrize("spacing_m", [0.0, 0.01, 0.05, 0.4, 3.0])
def test_sites_taken_by_cells_are_those_of_an_exhaustive_search(spacing_m: float) -> None:
    rng = np.random.default_rng(5)
    sites_m = placing.scattered_cap(600, 1.5, rng) + 0.1 * rng.standard_normal((600, 3))
    taken = list[int]()
    for site, place_m in enumerate(sites_m):
        distance_m = np.linalg.norm(sites_m[taken] - place_m, axis=1)
        if (distance_m > spacing_m).all():
            taken.append(site)
    np.testing.assert_array_equal(placing.thin(sites_m, spacing_m), taken)
    np.testing.assert_array_equal(placing.thin(sites_m, spacing_m, 5), taken[:5])


def test_a_file_of_too_many_leds_is_refused_before_its_rows_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "leds.csv"
    monkeypatch.setattr(listed, "column_numbers", None)
    path.write_text("azimuth_deg,tilt_deg\n" + "0,1\n" * 100_001)
    with pytest.raises(InputError, match=r"leds\.csv: 100001 LEDs; allowed: up to 100000$"):
        listed.read_csv(path)


@pytest.mark.slow
def test_leds_that_all_are_in_one_place_are_refused_in_linear_time(tmp_path: Path) -> None:
    """The pairs of 100,000 LEDs in one place would be five billion."""
    path = tmp_path / "leds.csv"
    path.write_text("azimuth_deg,tilt_deg\n" + "0,1\n" * 100_000)
    begin_s = time.process_time()
    with pytest.raises(
        InputError, match=r"leds\.csv, line 3: at the place of .*leds\.csv, line 2"
    ):
        lit({"kind": "listed", "file": str(path)}, MEASURED)
    assert time.process_time() - begin_s < 10


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fibonacci", "poisson_disk", "random"])
def test_a_hundred_thousand_leds_are_placed_in_seconds(kind: str) -> None:
    """Each place is drawn, and on a dome of the measured shape."""
    lit({"kind": kind, "count": 100}, MEASURED)
    begin_s = time.process_time()
    leds = lit({"kind": kind, "count": 100_000}, MEASURED)
    assert time.process_time() - begin_s < 15
    assert len(leds) == 100_000
