"""The dome's surface against its equation and the FARO-arm figures; the boards against distances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.spatial import cKDTree

from skysim.core.errors import InputError
from skysim.core.types import Sources
from skysim.scene import loader
from skysim.scene.sections import light
from skysim.scene.sections.light import DomeConfig
from skysim.sources import dome
from skysim.sources.dome import surface as dome_surface
from skysim.sources.dome.layouts.placing import cap
from skysim.sources.dome.surface import SURFACES, Ellipsoid, Plane
from skysim.sources.photometry import Band, led_strength_e_s_sr

INCH_M = 0.0254
MEASURED = {
    "kind": "ellipsoid",
    "apex": "48 in",
    "semi_axes": ["38.88 in", "38.88 in", "28.60 in"],
}
SPHERE = {
    "kind": "sphere",
    "apex": "48 in",
    "radius": "45 in",
    "offset": ["1 in", "-2 in", "0.5 in"],
}
BOARDS = {
    "kind": "patch_boards",
    "cap_deg": 27,
    "spacing": "2.6 in",
    "pitch": "8 mm",
    "lit": [3, 6],
}
LED = {"intensity": "16 mcd", "disk_diameter": "2 mm", "pwm_period": "1 ms"}
BAND = Band.from_efficiency("cmos")


def surface(part: dict[str, Any]) -> Any:
    return dome_surface.build_surface(TypeAdapter(light.AnySurface).validate_python(part))


def lit_dome(
    surface: dict[str, Any] = MEASURED, led: dict[str, Any] = LED, **boards: Any
) -> Sources:
    light = {"kind": "dome", "surface": surface, "layout": BOARDS | boards, "led": led}
    return dome.sources(DomeConfig.model_validate(light), BAND)


@pytest.fixture(scope="module")
def afit() -> Sources:
    return lit_dome(led=LED | {"scatter": 0.08}, hardware_seed=2012, pwm_levels=[1.0, 0.5])


def upward_rays(count: int, seed: int) -> np.ndarray:
    rays = np.random.default_rng(seed).standard_normal((count, 3))
    rays[:, 2] = np.abs(rays[:, 2]) + 0.3
    return rays


@pytest.mark.parametrize("part", [MEASURED, SPHERE])
@pytest.mark.parametrize("origin_in", [(0, 0, 0), (2, -1, 15)])
def test_rays_meet_the_surface_on_its_equation_and_on_themselves(
    part: dict, origin_in: tuple
) -> None:
    made = surface(part)
    rays = upward_rays(200, 1)
    origin = INCH_M * np.array(origin_in, float)
    met = made.meet(origin, rays)
    quadric = np.sum(((met - made.center_m) / made.semi_axes_m) ** 2, axis=1)
    np.testing.assert_allclose(quadric, 1, rtol=0, atol=1e-13)  # rounding of a root
    along = met - origin
    assert np.all(np.einsum("nj,nj->n", along, rays) > 0)
    np.testing.assert_allclose(np.cross(along, rays), 0, rtol=0, atol=1e-13)


def test_the_measured_dome_has_the_reference_s_dimensions() -> None:
    # Reference A4: radius from the bearing 48 in at the apex, 48.29 in at most, near 29 degrees.
    angle_deg = np.arange(0, 40, 0.02)
    rays = np.column_stack(
        [np.sin(np.radians(angle_deg)), 0 * angle_deg, np.cos(np.radians(angle_deg))]
    )
    radius_in = np.linalg.norm(surface(MEASURED).meet(np.zeros(3), rays), axis=1) / INCH_M
    assert radius_in[0] == pytest.approx(48.0, abs=1e-12)
    assert radius_in.max() == pytest.approx(48.29, abs=0.01)
    assert angle_deg[radius_in.argmax()] == pytest.approx(29, abs=0.5)


def test_measured_dome_at_the_rim_height_has_the_reference_s_radius() -> None:
    # Reference A4: rim at z = 36.66 in, 48.011 in from the bearing.
    made = surface(MEASURED)
    z = 36.66 * INCH_M
    half_width = made.semi_axes_m[0] * np.sqrt(
        1 - ((z - made.center_m[2]) / made.semi_axes_m[2]) ** 2
    )
    met = made.meet(np.zeros(3), np.array([[half_width, 0, z]]))
    assert np.linalg.norm(met) / INCH_M == pytest.approx(48.011, abs=0.01)


def test_a_sphere_about_the_bearing_has_constant_distance() -> None:
    # Reference A2: exact.
    made = surface({"kind": "sphere", "apex": "48 in", "radius": "48 in"})
    radius = np.linalg.norm(made.meet(np.zeros(3), upward_rays(100, 2)), axis=1)
    np.testing.assert_allclose(radius, 48 * INCH_M, rtol=0, atol=1e-14)


@pytest.mark.parametrize("part", [MEASURED, SPHERE, {"kind": "flat", "apex": "48 in"}])
def test_the_apex_has_its_declared_height(part: dict) -> None:
    """Straight above the dome's own axis; the offset moves it along."""
    made = surface(part)
    offset = TypeAdapter(light.AnySurface).validate_python(part).offset_m
    above = np.array([offset[0], offset[1], 0.0])
    top = made.meet(above, np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(
        top, [*offset[:2], 48 * INCH_M + offset[2]], rtol=0, atol=1e-14
    )


@pytest.mark.parametrize("part", [MEASURED, SPHERE])
def test_normals_are_perpendicular_and_point_inside(part: dict) -> None:
    """Against chords between neighboring points of the surface, found by rays alone."""
    made = surface(part)
    rays = upward_rays(60, 3)
    here = made.meet(np.zeros(3), rays)
    normal = made.inward(here)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=0, atol=1e-15)
    for axis in np.eye(3):
        chord = made.meet(np.zeros(3), rays + 1e-5 * axis) - made.meet(
            np.zeros(3), rays - 1e-5 * axis
        )
        # A symmetric chord is off the tangent by the third power of its length only.
        assert np.abs(np.einsum("nj,nj->n", chord, normal)).max() < 1e-13
    assert np.all(np.einsum("nj,nj->n", normal, made.center_m - here) > 0)


def test_a_flat_panel_is_flat_and_shines_down() -> None:
    made = surface({"kind": "flat", "apex": "48 in"})
    met = made.meet(np.array([0.1, 0, 0.3]), upward_rays(50, 4))
    np.testing.assert_allclose(met[:, 2], 48 * INCH_M, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(made.inward(met), np.tile([0, 0, -1.0], (50, 1)))
    assert np.isnan(made.meet(np.zeros(3), np.array([[0.0, 0.1, -1.0]]))).all()


@pytest.mark.parametrize(
    "part",
    [
        MEASURED | {"apex": "60 in"},
        {"kind": "sphere", "apex": "100 in", "radius": "48 in"},
        MEASURED | {"offset": ["45 in", "0 in", "0 in"]},
        {"kind": "flat", "apex": "48 in", "offset": ["0 m", "0 m", "-50 in"]},
    ],
)
def test_a_dome_that_leaves_the_bearing_outside_is_refused(part: dict) -> None:
    with pytest.raises(InputError, match=r"^light\.surface: .*check apex"):
        surface(part)


def test_every_kind_of_surface_in_a_scene_can_be_made() -> None:
    kinds = light.SurfaceConfig.model_fields["kind"].annotation.__args__
    assert set(kinds) == set(SURFACES)
    assert isinstance(surface({"kind": "flat", "apex": "1 m"}), Plane)
    assert isinstance(surface(SPHERE), Ellipsoid)


def board_of(leds: Sources) -> np.ndarray:
    return leds.id // 9


def test_neighbors_on_a_board_are_a_pitch_apart(afit: Sources) -> None:
    """Holes r and c rows and columns apart are hypot(r, c) pitches apart, for every pair on every board."""
    board = board_of(afit)
    hole = afit.id % 9
    first, second = np.nonzero(np.triu(board[:, None] == board[None, :], 1))
    steps = np.hypot(hole[first] % 3 - hole[second] % 3, hole[first] // 3 - hole[second] // 3)
    apart_m = np.linalg.norm(afit.place[first, :3] - afit.place[second, :3], axis=1)
    assert len(first) > 500
    np.testing.assert_allclose(apart_m, 0.008 * steps, rtol=0, atol=1e-14)


def test_boards_are_flat_tangent_and_touch_the_surface_at_their_middle(afit: Sources) -> None:
    made = surface(MEASURED)
    holes = afit.id % 9
    middle = afit.take(holes == 4)
    assert len(middle) > 50
    quadric = np.sum(((middle.place[:, :3] - made.center_m) / made.semi_axes_m) ** 2, axis=1)
    np.testing.assert_allclose(quadric, 1, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        middle.normal, made.inward(middle.place[:, :3]), rtol=0, atol=1e-14
    )
    height = np.einsum("nj,nj->n", afit.place[:, :3], afit.normal)
    spread = [np.ptp(height[board_of(afit) == b]) for b in np.unique(board_of(afit))]
    assert max(spread) < 1e-14


def test_outer_leds_of_a_board_are_off_the_surface_by_the_sagitta(afit: Sources) -> None:
    """A tangent plate of half-diagonal h under a dome of curvature radius R stands off by h^2 / 2R."""
    made = surface(MEASURED)
    gap = np.linalg.norm(
        made.meet(np.zeros(3), afit.place[:, :3]) - afit.place[:, :3], axis=1
    )
    tightest = made.semi_axes_m[2] ** 2 / made.semi_axes_m[0]  # no ellipsoid's radius is less
    assert gap.max() < 2 * 0.008**2 / (2 * tightest)
    assert (
        gap.max() > 2 * 0.008**2 / (2 * made.semi_axes_m[0] ** 2 / made.semi_axes_m[2]) * 0.9
    )


def patterns(leds: Sources) -> list[frozenset[int]]:
    return [frozenset(leds.id[board_of(leds) == b] % 9) for b in np.unique(board_of(leds))]


def test_boards_differ_in_their_patterns(afit: Sources) -> None:
    made = patterns(afit)
    # Of the 420 ways to light 3 to 6 of 9 about 1 - exp(-n / 420) are drawn at least once by n boards.
    assert len(set(made)) > 0.6 * 420 * (1 - np.exp(-len(made) / 420))


def test_lit_leds_are_within_the_range_and_all_of_it_is_used(afit: Sources) -> None:
    assert {len(pattern) for pattern in patterns(afit)} == {3, 4, 5, 6}
    assert {len(pattern) for pattern in patterns(lit_dome(lit=[9, 9]))} == {9}


def test_no_two_leds_share_a_position(afit: Sources) -> None:
    assert len(np.unique(afit.id)) == len(afit)
    nearest = cKDTree(afit.place[:, :3]).query(afit.place[:, :3], k=2)[0][:, 1]
    assert nearest.min() > 0.0079


def test_the_same_hardware_seed_gives_the_same_dome_and_another_seed_another() -> None:
    first, again, other = (lit_dome(hardware_seed=seed) for seed in (5, 5, 6))
    for name in set(Sources.__slots__) - {"motion", "chromatic"}:
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert not np.array_equal(first.id, other.id)


@pytest.mark.parametrize("spacing_in", [2.0, 2.6, 5.2])
def test_the_density_of_boards_follows_from_their_spacing(spacing_in: float) -> None:
    """One board in every spacing squared of the cap of 2 pi R^2 (1 - cos 27 deg), evenly."""
    leds = lit_dome(spacing=f"{spacing_in} in", lit=[9, 9])
    middle = leds.place[leds.id % 9 == 4, :3]
    cap_in2 = 2 * np.pi * 48**2 * (1 - np.cos(np.radians(27)))
    assert len(middle) == pytest.approx(cap_in2 / spacing_in**2, abs=0.5)
    nearest_in = cKDTree(middle).query(middle, k=2)[0][:, 1] / INCH_M
    assert nearest_in.min() > 0.6 * spacing_in
    assert np.degrees(np.arccos(middle[:, 2] / np.linalg.norm(middle, axis=1))).max() <= 27


def test_boards_are_uniform_in_area() -> None:
    """Fibonacci's spiral is uniform in the cosine: each tenth of the cap's area has a tenth of the boards."""
    z = cap(1000, np.radians(27))[:, 2]
    counts, _ = np.histogram(z, np.linspace(np.cos(np.radians(27)), 1, 11))
    np.testing.assert_array_equal(counts, 100)


def logs(leds: Sources) -> np.ndarray:
    """Logarithm of each LED's brightness over the declared one."""
    return np.asarray(np.log(leds.strength / led_strength_e_s_sr(16e-3, "white", BAND)))


@pytest.mark.parametrize("scatter", [0.07, 0.09])
def test_intensities_scatter_as_declared(scatter: float) -> None:
    """Lognormal, as AFIT's Table 2 (reference A8: 7-9 %): moments of the logarithm to four of their sigmas."""
    drawn = (
        logs(lit_dome(led=LED | {"scatter": scatter}, lit=[9, 9], spacing="1.5 in")) / scatter
    )
    n = len(drawn)
    assert n > 4000
    assert drawn.std() == pytest.approx(1, abs=4 / np.sqrt(2 * n))
    assert abs(drawn.mean()) < 4 / np.sqrt(n)
    assert abs(np.mean(drawn**3)) < 4 * np.sqrt(15 / n)
    assert np.mean(drawn**4) == pytest.approx(3, abs=4 * np.sqrt(96 / n))


def test_without_scatter_all_leds_are_equal() -> None:
    np.testing.assert_array_equal(logs(lit_dome()), 0)


def test_neighboring_leds_scatter_independently() -> None:
    drawn = logs(lit_dome(led=LED | {"scatter": 0.08}, lit=[9, 9], spacing="1.5 in")) / 0.08
    assert abs(np.mean(drawn[1:] * drawn[:-1])) < 4 / np.sqrt(len(drawn))


def test_brightness_depends_on_the_hardware_seed_not_on_the_run() -> None:
    """The scene's own seed changes nothing, nor does what others draw; the hardware's seed changes all."""
    built = loader.load("afit_simsat").light
    rerun = loader.load("afit_simsat", {"seed": "99"}).light
    first = dome.sources(built, BAND)
    np.random.default_rng(99).standard_normal(1000)
    np.testing.assert_array_equal(first.strength, dome.sources(rerun, BAND).strength)
    rebuilt = loader.load("afit_simsat", {"light.layout.hardware_seed": "7"}).light
    assert not np.isin(dome.sources(rebuilt, BAND).strength, first.strength).any()


# AFIT thesis, Table 2: nine equal LEDs, ranked by brightness in each of 250 images, mean of each rank.
TABLE_2 = [132.67, 119.61, 115.58, 112.92, 110.17, 108.30, 106.05, 103.61, 100.05]


def ranked(scatter: float) -> np.ndarray:
    """(boards, 9) brightness of full boards from brightest to dimmest, each board's mean 1."""
    leds = lit_dome(led=LED | {"scatter": scatter}, lit=[9, 9], spacing="1.5 in")
    boards = leds.strength.reshape(-1, 9)
    return np.sort(boards / boards.mean(axis=1, keepdims=True), axis=1)[:, ::-1]


def test_nine_per_cent_ranks_as_normal_order_statistics() -> None:
    """Reference A8: Normal order statistics of mean 112, sd 10. Expected ones of nine: 1.485, .932, .572, .275, 0."""
    upper = np.array([1.485, 0.932, 0.572, 0.275])
    normal = 1 + 0.09 * np.concatenate([upper, [0], -upper[::-1]])
    # A lognormal's upper end is longer: by half the square of 1.485 x .09, .009; the mean of 500 boards adds .009.
    np.testing.assert_allclose(ranked(0.09).mean(axis=0), normal, rtol=0, atol=0.015)


def likelihood(boards: np.ndarray) -> float:
    """Log probability density of Table 2's standard deviation among simulated boards, by a normal law."""
    spread = np.log(boards.std(axis=1))
    seen = np.log(np.std(TABLE_2) / np.mean(TABLE_2))
    return float(-((seen - spread.mean()) ** 2) / (2 * spread.var()))


def test_table_2_is_a_board_of_nine_per_cent_and_not_of_three_or_thirty() -> None:
    assert likelihood(ranked(0.08)) > -2  # within two sigma
    assert likelihood(ranked(0.09)) > -2
    assert likelihood(ranked(0.03)) < -4.5  # beyond three
    assert likelihood(ranked(0.30)) < -4.5
    # Rank by rank within what 99 % of the boards show.
    low, high = np.percentile(ranked(0.09), [0.5, 99.5], axis=0)
    seen = np.array(TABLE_2) / np.mean(TABLE_2)
    assert np.all((seen > low) & (seen < high))


def test_strength_is_in_the_chip_s_own_electrons() -> None:
    light = {
        "kind": "dome",
        "surface": MEASURED,
        "layout": BOARDS,
        "led": LED | {"spectrum": "640 nm"},
    }
    red = dome.sources(DomeConfig.model_validate(light), Band.from_efficiency(0.5)).strength
    # By hand: 16 mcd of V(640 nm) = .175 in photons of 3.1038e-19 J, half of them electrons.
    np.testing.assert_allclose(
        red, 0.016 / (683 * 0.175) / 3.1038e-19 * 0.5, rtol=1e-4, atol=0
    )


def test_pulses_have_the_levels_of_the_scene_and_random_phases(afit: Sources) -> None:
    np.testing.assert_array_equal(np.unique(afit.on_s), [0.5e-3, 1e-3])
    np.testing.assert_array_equal(afit.period_s, 1e-3)
    assert 0 <= afit.start_s.min() < afit.start_s.max() < 1e-3
    # The mean of n uniform phases, to four of its sigmas.
    assert afit.start_s.mean() == pytest.approx(
        0.5e-3, abs=4 * 1e-3 / np.sqrt(12 * len(afit))
    )


@pytest.mark.parametrize("part", [SPHERE, {"kind": "flat", "apex": "48 in"}])
def test_every_surface_carries_boards_that_face_the_bearing(part: dict) -> None:
    leds = lit_dome(part)
    assert np.all(leds.place[:, 3] == 1)
    assert np.all(np.einsum("nj,nj->n", leds.normal, leds.place[:, :3]) < 0)
    np.testing.assert_array_equal(leds.radius_m, 1e-3)
