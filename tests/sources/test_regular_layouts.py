"""Geodesic and tape layouts against counts, published chords and arc lengths on the surface."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.spatial import ConvexHull

from skysim.core.errors import InputError
from skysim.core.types import Sources
from skysim.scene import loader
from skysim.scene.sections import light
from skysim.scene.sections.light import DomeConfig
from skysim.sources import dome
from skysim.sources.dome import surface
from skysim.sources.dome.layouts.spreads import geodesic_vertices
from skysim.sources.photometry import Band

SPHERE = {"kind": "sphere", "apex": "1.2 m", "radius": "1.2 m"}
OFF = {"kind": "sphere", "apex": "1.5 m", "radius": "1.1 m", "offset": ["2 cm", "0 m", "0 m"]}
OVAL = {"kind": "ellipsoid", "apex": "48 in", "semi_axes": ["38.88 in", "36 in", "28.60 in"]}
FLAT = {"kind": "flat", "apex": "1.2 m"}
VAULT = {"kind": "cylinder", "axis": "x", "apex": "1.2 m", "radius": "1 m"}
SURFACES = {"sphere": SPHERE, "off": OFF, "ellipsoid": OVAL, "flat": FLAT, "cylinder": VAULT}
LED = {"intensity": "16 mcd", "disk_diameter": "2 mm", "drive": {"kind": "direct"}}
BAND = Band.from_efficiency(0.5)


def lit(layout: dict[str, Any], on: dict[str, Any] = SPHERE, **led: Any) -> Sources:
    config = {
        "kind": "dome",
        "surface": on,
        "layout": {"cap_deg": 40} | layout,
        "led": LED | led,
    }
    return dome.sources(DomeConfig.model_validate(config), BAND)


def inside(config: dict[str, Any]) -> surface.Surface:
    return surface.build_surface(TypeAdapter(light.AnySurface).validate_python(config))


def angles(places_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tilt and azimuth from the bearing, rad."""
    x, y, z = places_m.T
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)


def edges(vertices: np.ndarray) -> np.ndarray:
    """Lengths of all edges of the triangulated sphere, by its convex hull."""
    faces = ConvexHull(vertices).simplices
    pairs = np.unique(
        np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [0, 2]]]), axis=1),
        axis=0,
    )
    return np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)


# --- geodesic


@pytest.mark.parametrize("frequency", range(1, 9))
def test_a_class_1_sphere_has_ten_times_the_square_and_two(frequency: int) -> None:
    vertices = geodesic_vertices(frequency, "I")
    assert len(vertices) == 10 * frequency**2 + 2
    # Euler: a triangulation of V vertices has 3 V - 6 edges.
    assert len(edges(vertices)) == 30 * frequency**2
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1, rtol=0, atol=1e-15)


@pytest.mark.parametrize("frequency", [2, 4, 6, 8])
def test_a_class_2_sphere_has_three_quarters_as_many_triangles(frequency: int) -> None:
    vertices = geodesic_vertices(frequency, "II")
    assert len(vertices) == 10 * (3 * frequency**2 // 4) + 2
    assert len(edges(vertices)) == 3 * len(vertices) - 6


@pytest.mark.parametrize(
    ("class_", "frequency", "chords"),
    [
        ("I", 1, {1.05146: 30}),
        ("I", 2, {0.54653: 60, 0.61803: 60}),
        ("I", 3, {0.34862: 60, 0.40355: 90, 0.41241: 120}),
        (
            "I",
            4,
            {0.25318: 60, 0.29453: 120, 0.29524: 60, 0.29859: 60, 0.31287: 120, 0.32492: 60},
        ),
        ("II", 2, {0.64085: 60, 0.71364: 30}),
    ],
)
def test_geodesic_chords_match_the_published_tables(
    class_: str, frequency: int, chords: dict[float, int]
) -> None:
    """Chord factors of geodesic domes as builders use them (Kenner 1976, tables), and how often each occurs."""
    lengths, counts = np.unique(
        np.round(edges(geodesic_vertices(frequency, class_)), 5), return_counts=True
    )
    assert dict(zip(lengths.tolist(), counts.tolist(), strict=True)) == pytest.approx(
        chords, abs=1e-5
    )


def test_edges_of_a_fine_sphere_reach_the_limits_of_the_projection() -> None:
    """The icosahedron's edge e over the frequency, seen from the center: times cos(31.7 deg) at the corners, where it
    is foreshortened, and over the face's distance .7947 at the faces' centers, where it is nearest.
    """
    frequency = 40
    edge = 1.0514622
    lengths = edges(geodesic_vertices(frequency, "I")) * frequency / edge
    assert lengths.min() == pytest.approx(np.cos(np.arcsin(edge / 2)), rel=0.03)
    assert lengths.min() > np.cos(np.arcsin(edge / 2))
    assert lengths.max() == pytest.approx(1 / 0.7946545, rel=1e-3)


@pytest.mark.parametrize("on", SURFACES.values(), ids=SURFACES)
def test_geodesic_leds_are_the_vertices_seen_from_the_bearing(on: dict[str, Any]) -> None:
    leds = lit({"kind": "geodesic", "frequency": 8}, on)
    place_m = leds.place[:, :3]
    made = inside(on)
    own_m = (place_m - made.center_m) @ made.lab_from_own.as_matrix()
    np.testing.assert_allclose(made.level_and_gradient(own_m)[0], 0, rtol=0, atol=1e-12)
    vertices = geodesic_vertices(8, "I")
    within = vertices[vertices[:, 2] >= np.cos(np.radians(40))]
    assert len(leds) == len(within)
    seen = place_m / np.linalg.norm(place_m, axis=1, keepdims=True)
    assert np.linalg.norm(seen[:, None] - within, axis=2).min(axis=1).max() < 1e-12
    tilt, _ = angles(place_m)
    assert np.all(np.diff(tilt) > -1e-9)


def test_a_geodesic_layout_rotates_about_the_zenith() -> None:
    plain, turned = (
        lit({"kind": "geodesic", "frequency": 6, "rotation_deg": deg}).place[:, :3]
        for deg in (0, 25)
    )
    c = np.cos(np.radians(25))
    s = np.sin(np.radians(25))
    np.testing.assert_allclose(
        turned, plain @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]), rtol=0, atol=1e-14
    )
    assert angles(plain[1:6])[1] == pytest.approx(
        np.radians([-144, -72, 0, 72, 144]), abs=1e-9
    )


@pytest.mark.parametrize("kind", ["geodesic", "string"])
def test_a_lit_fraction_leaves_the_others_out_and_keeps_the_numbers(kind: str) -> None:
    layout = {"kind": kind} | (
        {"frequency": 20} if kind == "geodesic" else {"pitch": "16.7 mm", "spacing": "4 cm"}
    )
    every = lit(layout)
    some = lit(layout | {"lit_fraction": 0.4})
    assert len(some) == round(0.4 * len(every))
    np.testing.assert_array_equal(every.id, np.arange(len(every)))
    np.testing.assert_array_equal(some.place, every.place[some.id])
    assert np.all(np.diff(some.id) > 0)
    other = lit(layout | {"lit_fraction": 0.4, "hardware_seed": 1})
    assert set(other.id) != set(some.id)
    # Each LED is as likely as any other: of the first half there are as many as of the second, to five sigmas.
    first = np.sum(some.id < len(every) / 2)
    assert abs(first - len(some) / 2) < 5 * np.sqrt(len(some) * 0.6) / 2


# --- tape


def arcs_m(made: surface.Surface, place_m: np.ndarray) -> np.ndarray:
    """Length on the surface from each LED to the next, along equal changes of tilt and azimuth, in 2000 steps."""
    tilt, azimuth = angles(place_m)
    azimuth = np.unwrap(azimuth)
    part = np.linspace(0, 1, 2001)[:, None]
    t, a = (one[:-1] + part * np.diff(one) for one in (tilt, azimuth))
    rays = np.stack([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)], axis=-1)
    points = made.meet(np.zeros(3), rays.reshape(-1, 3)).reshape(rays.shape)
    return np.asarray(np.linalg.norm(np.diff(points, axis=0), axis=2).sum(axis=0))


@pytest.mark.slow
@pytest.mark.parametrize("on", SURFACES.values(), ids=SURFACES)
def test_leds_of_a_circle_are_a_pitch_apart_on_the_surface(on: dict[str, Any]) -> None:
    place_m = lit({"kind": "string", "pitch": "33 mm", "spacing": "15 cm"}, on).place[:, :3]
    tilt, _ = angles(place_m)
    rings = np.unique(np.round(tilt, 9))
    made = inside(on)
    assert len(rings) >= 4
    for ring in rings:
        leds = place_m[np.abs(tilt - ring) < 1e-8]
        assert arcs_m(made, leds) == pytest.approx(0.033, rel=2e-5)
        # The tape begins at azimuth 0 and is cut where the next LED would be beyond its beginning.
        assert angles(leds[:1])[1] == pytest.approx(0, abs=1e-12)
        closing = np.vstack([leds[-1], leds[0] + [0, -1e-15, 0]])
        assert 0.033 * (1 - 1e-5) <= arcs_m(made, closing)[0] < 0.066 or len(leds) < 3


@pytest.mark.slow
@pytest.mark.parametrize("on", SURFACES.values(), ids=SURFACES)
def test_leds_of_a_spiral_are_a_pitch_apart_on_the_surface(on: dict[str, Any]) -> None:
    place_m = lit(
        {"kind": "string", "winding": "spiral", "pitch": "33 mm", "spacing": "10 cm"}, on
    ).place[:, :3]
    tilt, azimuth = angles(place_m)
    assert tilt[0] == pytest.approx(0, abs=1e-12)
    assert np.all(np.diff(tilt) > 0)
    assert np.all(np.diff(np.unwrap(azimuth))[1:] > 0)
    # Beyond the first turn the tape between two LEDs is straight in tilt over azimuth, to 1e-3 of the pitch.
    outer = place_m[np.unwrap(azimuth) - azimuth[1] > 2 * np.pi]
    assert arcs_m(inside(on), outer) == pytest.approx(0.033, rel=1e-3)
    # The tape ends less than a pitch before the cap's rim.
    assert np.radians(40) - tilt[-1] < 0.033 / 1.1 * 0.15


def test_the_turns_of_a_spiral_are_a_spacing_apart() -> None:
    """On a sphere about the bearing the arc from the apex is the radius times the tilt: Archimedes' spiral."""
    place_m = lit(
        {"kind": "string", "winding": "spiral", "pitch": "10 mm", "spacing": "6 cm"}
    ).place[:, :3]
    tilt, azimuth = angles(place_m)
    turned = np.unwrap(azimuth[1:])
    np.testing.assert_allclose(1.2 * tilt[1:], 0.06 * turned / (2 * np.pi), rtol=0, atol=2e-6)


def test_circles_on_a_sphere_have_their_spacing_and_circumference() -> None:
    place_m = lit({"kind": "string", "pitch": "10 mm", "spacing": "6 cm"}).place[:, :3]
    tilt, _ = angles(place_m)
    rings, counts = np.unique(np.round(tilt, 8), return_counts=True)
    np.testing.assert_allclose(
        1.2 * rings, 0.03 + 0.06 * np.arange(len(rings)), rtol=0, atol=1e-6
    )
    np.testing.assert_array_equal(
        counts, (2 * np.pi * 1.2 * np.sin(rings) / 0.01).astype(int)
    )


@pytest.mark.slow
@pytest.mark.parametrize("on", SURFACES.values(), ids=SURFACES)
def test_strips_follow_meridians_with_leds_a_pitch_apart_to_the_rim(
    on: dict[str, Any],
) -> None:
    place_m = lit(
        {"kind": "string", "winding": "meridian", "pitch": "33 mm", "spacing": "10 cm"}, on
    ).place[:, :3]
    tilt, azimuth = angles(place_m)
    # Rim of 5 m: 64 strips.
    strips = np.rint(azimuth % (2 * np.pi) * 64 / (2 * np.pi)).astype(int) % 64
    assert azimuth % (2 * np.pi / 64) == pytest.approx(0, abs=1e-9) or len(
        np.unique(strips)
    ) in (
        32,
        64,
    )
    for strip in np.unique(strips):
        leds = place_m[strips == strip]
        assert arcs_m(inside(on), leds) == pytest.approx(0.033, rel=1e-4)
        assert np.radians(40) - tilt[strips == strip][-1] < 0.033 / 0.7


def test_strips_are_between_half_a_spacing_and_a_spacing_apart() -> None:
    """Under a sphere about the bearing, below where the first four begin."""
    layout = {"kind": "string", "winding": "meridian", "pitch": "5 mm", "spacing": "8 cm"}
    tilt, azimuth = angles(lit(layout).place[:, :3])
    assert (
        len(np.unique(np.round(azimuth, 6))) == 64
    )  # 2 pi 1.2 m sin 40 deg over 8 cm is 60.6
    for ring in np.radians([3.0, 8.0, 15.0, 25.0, 39.5]):
        beside = np.unique(np.round(azimuth[np.abs(tilt - ring) < 0.0025 / 1.2], 6))
        apart_m = 2 * np.pi * 1.2 * np.sin(ring) / len(beside)
        assert 0.038 < apart_m < 0.08 * 1.01


def test_tape_led_positions_have_pitch_and_glue_errors() -> None:
    """By 1 % of the pitch of each tape, and by 2 mm sideways, with a correlation of 1 / e after 0.3 m."""
    layout = {"kind": "string", "winding": "meridian", "pitch": "20 mm", "spacing": "2 cm"}
    ideal = lit(layout).place[:, :3]
    made = lit(layout | {"pitch_error": 0.01, "glue_scatter": "2 mm"}).place[:, :3]
    tilt, azimuth = angles(ideal)
    begins = np.flatnonzero(np.append(True, np.diff(tilt) < 0))
    radial = ideal / np.linalg.norm(ideal, axis=1, keepdims=True)
    along = np.column_stack(
        [np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), -np.sin(tilt)]
    )
    sideways_mm = 1e3 * np.sum((made - ideal) * np.cross(radial, along), axis=1)
    whole = [
        slice(a, b)
        for a, b in zip(begins, [*begins[1:], len(ideal)], strict=True)
        if b - a > 20
    ]
    assert len(whole) > 200
    stretch = [
        (np.diff(angles(made[one])[0]) / np.diff(tilt[one])).mean() - 1 for one in whole
    ]
    assert np.std(stretch) == pytest.approx(0.01, rel=0.15)
    same = np.concatenate([sideways_mm[one][:-5] for one in whole])
    later = np.concatenate([sideways_mm[one][5:] for one in whole])
    assert np.std(sideways_mm) == pytest.approx(2, rel=0.1)
    assert np.corrcoef(same, later)[0, 1] == pytest.approx(np.exp(-1 / 3), abs=0.06)


def test_a_surveyed_dome_takes_both_layouts(tmp_path: Any) -> None:
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(800, 3)) * [1, 1, 0.3] + [0, 0, 1.0]
    points = 1.2 * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    points *= 1 + 0.002 * points[:, :1] ** 2
    lines = "\n".join(",".join(f"{x:.9f}" for x in row) for row in points[points[:, 2] > 0.3])
    (tmp_path / "dome.csv").write_text("x,y,z\n" + lines + "\n")
    on = {"kind": "surveyed", "file": str(tmp_path / "dome.csv"), "unit": "m", "degree": 4}
    made = inside(on)
    spiral = {
        "kind": "string",
        "winding": "spiral",
        "pitch": "33 mm",
        "spacing": "10 cm",
        "cap_deg": 20,
    }
    place_m = lit(spiral, on).place[:, :3]
    assert arcs_m(made, place_m[30:60]) == pytest.approx(0.033, rel=1e-3)
    assert len(lit({"kind": "geodesic", "frequency": 10}, on)) == len(
        lit({"kind": "geodesic", "frequency": 10})
    )


# --- with fibers, panels and drives


@pytest.mark.parametrize(
    "points",
    [
        {"kind": "geodesic", "frequency": 10, "cap_deg": 30},
        {"kind": "string", "pitch": "4 cm", "spacing": "8 cm", "cap_deg": 30},
    ],
    ids=lambda points: points["kind"],
)
def test_fibers_and_panels_take_their_points(points: dict[str, Any]) -> None:
    plain = lit(points)
    fibers = {"kind": "fibers", "points": points}
    ends = dome.sources(
        DomeConfig.model_validate(
            {"kind": "dome", "surface": SPHERE, "layout": fibers, "led": LED}
        ),
        BAND,
    )
    np.testing.assert_array_equal(ends.place, plain.place)
    panel = {"kind": "lcd", "points": points, "pixels": [4000, 4000], "pitch": "0.5 mm"}
    drawn = dome.sources(
        DomeConfig.model_validate(
            {"kind": "dome", "surface": FLAT, "layout": panel, "led": LED}
        ),
        BAND,
    )
    on_panel = lit(points, FLAT)
    assert len(drawn) == len(on_panel)
    by_number = on_panel.place[np.argsort(on_panel.id), :3]
    assert np.abs(drawn.place[np.argsort(drawn.id), :3] - by_number).max() <= 0.00025 * (
        1 + 1e-9
    )


def test_controllers_along_a_tape_light_their_leds_in_turn() -> None:
    """A controller for every 50 LEDs of the tape: each has its slot in the order along the tape."""
    drive = {"kind": "sequential", "controller": 50, "slot": "1 ms"}
    leds = lit(
        {"kind": "string", "winding": "spiral", "pitch": "4 cm", "spacing": "8 cm"},
        drive=drive,
    )
    whole = len(leds) // 50
    assert whole >= 4
    start_s = leds.start_s[: 50 * whole].reshape(whole, 50)
    np.testing.assert_allclose(np.diff(start_s, axis=1), 1e-3, rtol=1e-9, atol=0)
    np.testing.assert_allclose(leds.period_s[: 50 * whole], 50e-3, rtol=1e-12, atol=0)
    np.testing.assert_array_equal(leds.clock, np.arange(len(leds)) // 50)
    # Neighbors in time are neighbors on the dome.
    assert np.linalg.norm(np.diff(leds.place[:50, :3], axis=0), axis=1).max() <= 0.04 * (
        1 + 1e-4
    )


# --- what is refused


@pytest.mark.parametrize(
    ("layout", "complaint"),
    [
        (
            "{kind: geodesic, frequency: 3, class: II, cap_deg: 30}",
            "3 is odd, with class: II; allowed: even",
        ),
        ("{kind: geodesic, frequency: 0, cap_deg: 30}", "frequency: 0 is not allowed"),
        (
            "{kind: geodesic, frequency: 4, class: III, cap_deg: 30}",
            "class: 'III' is not allowed; allowed: 'I'",
        ),
        (
            "{kind: geodesic, frequency: 4, lit_fraction: 0, cap_deg: 30}",
            "lit_fraction: 0 is not allowed",
        ),
        ("{kind: string, pitch: 1 cm, cap_deg: 30}", "light.layout.spacing: missing"),
        (
            "{kind: string, pitch: 0.1 mm, spacing: 1 cm, cap_deg: 30}",
            "light.layout.pitch: '0.1 mm' is not allowed",
        ),
        (
            "{kind: string, pitch: 1 cm, spacing: 1 cm, winding: helix, cap_deg: 30}",
            "winding: 'helix' is not allowed",
        ),
    ],
)
def test_an_impossible_layout_is_refused_in_one_line(layout: str, complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        loader.load("afit_simsat", {"light.layout": layout})
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("winding", ["latitude", "spiral"])
def test_too_much_tape_is_refused_with_its_length(winding: str) -> None:
    layout = {"kind": "string", "winding": winding, "pitch": "1 mm", "spacing": "2 mm"}
    with pytest.raises(
        InputError,
        match=r"light.layout.pitch: .* m of tape with an LED every 0.001 m are \d+ LEDs",
    ):
        lit(layout)


@pytest.mark.parametrize(
    "layout", [{"kind": "geodesic", "frequency": 8}, {"kind": "string", "pitch": "3 cm"}]
)
def test_a_cap_beyond_the_rim_is_refused(layout: dict[str, Any]) -> None:
    layout = layout | ({"spacing": "5 cm"} if layout["kind"] == "string" else {})
    with pytest.raises(InputError, match=r"^light.layout: exceeds the surface"):
        lit(layout, SPHERE | {"rim_deg": 30})
