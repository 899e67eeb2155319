"""A dome that does not fit into its room is refused: against the geometry of spherical caps and panels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from skysim.core.errors import InputError
from skysim.experiments.study import search
from skysim.experiments.study import study_file as study_loader
from skysim.experiments.study.execution import engines, runner, store
from skysim.scene import loader
from skysim.scene.sections import light
from skysim.scene.sections.light import DomeConfig, RoomConfig
from skysim.simulation import checks
from skysim.simulation.lab import build_lab
from skysim.sources import dome
from skysim.sources.dome import room as rooms
from skysim.sources.dome import surface
from skysim.sources.photometry import Band

RADIUS_M = 1.5
RIM_M = 0.9
HALF_WIDTH_M = np.sqrt(RADIUS_M**2 - RIM_M**2)  # 1.2 m
CAP = {"kind": "sphere", "apex": "1.5 m", "radius": "1.5 m", "rim_height": "0.9 m"}
LAYOUT = {"kind": "fibonacci", "count": 20, "cap_deg": 40}
LED = {"intensity": "16 mcd", "disk_diameter": "2 mm"}
LETTER_BOX = (1e-3, 1e3)  # of which the part is least too thick in its thinnest box


def check(room: dict[str, Any], on: dict[str, Any] = CAP, cap_deg: float = 40) -> None:
    config = {
        "kind": "dome",
        "surface": on,
        "layout": LAYOUT | {"cap_deg": cap_deg},
        "led": LED,
        "room": room,
    }
    dome.sources(DomeConfig.model_validate(config), Band.from_efficiency(0.5))


def part_m(segments: int, on: dict[str, Any] = CAP, **room: Any) -> np.ndarray:
    """Sides of the largest part, ascending, in the box that is thinnest."""
    config = RoomConfig.model_validate(
        room | {"door": ["1 mm", "1 km"], "segments": segments}
    )
    made = surface.build_surface(TypeAdapter(light.AnySurface).validate_python(on))
    return rooms.largest_part_m(config, LETTER_BOX, made, 40.0, segments)[0]


# --- the sizes


def test_a_cap_has_the_height_and_width_of_a_spherical_cap() -> None:
    np.testing.assert_allclose(
        part_m(1), [RADIUS_M - RIM_M, 2 * HALF_WIDTH_M, 2 * HALF_WIDTH_M], rtol=1e-9
    )


def test_a_panel_beside_the_zenith_is_sampled_from_its_near_edge_to_its_far_one() -> None:
    """From 1 mm to 1.001 m off the bearing's axis: the near edge is 0.06 deg from the zenith."""
    panel = {
        "kind": "flat",
        "apex": "1 m",
        "width": "1 m",
        "height": "1 m",
        "offset": ["0.501 m", "0 m", "0 m"],
    }
    made = surface.build_surface(TypeAdapter(light.AnySurface).validate_python(panel))
    x_m = rooms.shell_m(RoomConfig.model_validate({"segments": 1}), made, 40.0, np.zeros(1))[
        :, 0
    ]
    np.testing.assert_allclose([x_m.min(), x_m.max()], [0.001, 1.001], rtol=0, atol=1e-12)


def test_a_thick_shell_is_larger_by_its_thickness() -> None:
    """The outer face is a sphere of R + d about the same center, down to the rim's normals."""
    rim_side = HALF_WIDTH_M * (1 + 0.05 / RADIUS_M)
    expected = [RADIUS_M + 0.05 - RIM_M, 2 * rim_side, 2 * rim_side]
    np.testing.assert_allclose(part_m(1, thickness="5 cm"), expected, rtol=1e-9)


def test_a_half_cap_is_half_as_wide() -> None:
    """Cut through the apex: turned or not, it is R - h by r by 2 r, or better."""
    box = part_m(2)
    upright = np.sort([RADIUS_M - RIM_M, HALF_WIDTH_M, 2 * HALF_WIDTH_M])
    assert box[2] == pytest.approx(2 * HALF_WIDTH_M, rel=1e-9)
    assert box[0] <= upright[0] * (1 + 1e-9)
    # A box holds what it is about: its area across the long side is at least that of the half segment.
    angle = 2 * np.arccos(RIM_M / RADIUS_M)
    half_segment_m2 = RADIUS_M**2 / 2 * (angle - np.sin(angle)) / 2
    assert box[0] * box[1] >= half_segment_m2


@pytest.mark.parametrize("segments", [3, 4, 6, 12])
def test_a_gore_is_as_wide_as_its_chord_at_the_rim(segments: int) -> None:
    box = part_m(segments)
    chord_m = 2 * HALF_WIDTH_M * np.sin(np.pi / segments)
    assert np.abs(box - chord_m).min() < 1e-9
    # And as long as the meridian from the apex to the rim at least, which no box about it can undercut.
    meridian_m = np.hypot(HALF_WIDTH_M, RADIUS_M - RIM_M)
    assert np.linalg.norm(box) >= np.hypot(meridian_m, chord_m / 2)


def test_a_panel_has_its_declared_thickness_width_and_height() -> None:
    panel = {"kind": "flat", "apex": "1.2 m", "width": "2.4 m", "height": "1.3 m"}
    np.testing.assert_allclose(
        part_m(1, panel, thickness="6 cm"), [0.06, 1.3, 2.4], rtol=1e-9
    )


def test_a_sphere_without_a_rim_ends_where_its_leds_end() -> None:
    whole = {key: value for key, value in CAP.items() if key != "rim_height"}
    half = 1.5 * np.sin(np.radians(40))
    np.testing.assert_allclose(
        part_m(1, whole), [1.5 * (1 - np.cos(np.radians(40))), 2 * half, 2 * half], rtol=1e-9
    )


def test_a_dome_down_to_below_the_bearing_has_all_of_its_shell() -> None:
    """A rim 30 cm below the bearing: the greatest width is the sphere's, in the middle of the samples."""
    low = CAP | {"rim_height": "-0.3 m"}
    np.testing.assert_allclose(part_m(1, low), [1.8, 3.0, 3.0], rtol=2e-4)


@pytest.mark.slow
def test_the_check_states_how_a_dome_fits_its_room() -> None:
    """A cap of R = 1.5 m from 0.9 m up, on a bearing 1 m above the floor, in quarters through a door."""
    room = (
        "{height: 2.9 m, bearing_height: 1 m, width: 4 m, door: [0.9 m, 2.1 m], segments: 4}"
    )
    surface_text = "{kind: sphere, apex: 1.5 m, radius: 1.5 m, rim_height: 0.9 m}"
    layout = "{kind: fibonacci, count: 300, cap_deg: 40}"
    changes = {"light.surface": surface_text, "light.layout": layout, "light.room": room}
    (fact,) = [
        one
        for one in checks.check(build_lab(loader.load("afit_simsat", changes))).facts
        if one.name == "room"
    ]
    sides = " x ".join(
        f"{side:.2f}"
        for side in rooms.largest_part_m(
            RoomConfig.model_validate({"door": ["0.9 m", "2.1 m"], "segments": 4}),
            (0.9, 2.1),
            surface.build_surface(TypeAdapter(light.AnySurface).validate_python(CAP)),
            40.0,
            4,
        )[0]
    )
    assert fact.lines == [
        "top 2.50 m of 2.90 m, rim 1.90 m above the floor; 2.40 x 2.40 x 0.60 m along x, y, z (room: 4.00 m x any);"
        f" each of 4 segments goes into a box of {sides} m, shortest side first: fits the door of 0.90 x 2.10 m"
    ]
    assert fact.values["top_m"] == pytest.approx(2.5, abs=1e-9)
    assert fact.values["extent_m"] == pytest.approx([2.4, 2.4, 0.6], abs=1e-9)
    free = checks.check(build_lab(loader.load("afit_simsat"))).facts
    assert "room" not in {one.name for one in free}


# --- the limits


@pytest.mark.parametrize(
    ("room", "on"),
    [
        ({"height": "2.501 m", "bearing_height": "1 m"}, CAP),
        ({"height": "2.551 m", "bearing_height": "1 m", "thickness": "5 cm"}, CAP),
        ({"width": "2.401 m", "length": "2.401 m"}, CAP),
        ({"door": ["0.601 m", "2.401 m"]}, CAP),
        ({"door": ["2.401 m", "0.601 m"]}, CAP),
        ({"door": ["0.9 m", "2.1 m"], "segments": 2}, CAP),
        ({}, CAP),
    ],
)
def test_a_dome_that_fits_is_built(room: dict[str, Any], on: dict[str, Any]) -> None:
    check(room, on)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("room", "on", "complaint"),
    [
        (
            {"height": "2.499 m", "bearing_height": "1 m"},
            CAP,
            "light.room.height: the dome's top is 2.500 m above the floor; allowed: 2.499 m, the ceiling",
        ),
        (
            {"height": "2.549 m", "bearing_height": "1 m", "thickness": "5 cm"},
            CAP,
            "light.room.height: the dome's top is 2.550 m above the floor; allowed: 2.549 m, the ceiling",
        ),
        (
            {"bearing_height": "0.2 m"},
            CAP | {"rim_height": "-0.3 m"},
            "light.room.bearing_height: 0.200 m puts the dome's rim 0.100 m below the floor; allowed: 0.300 m or more,"
            " or a higher rim",
        ),
        (
            {"width": "2.399 m"},
            CAP,
            "light.room.width: the dome is 2.400 m wide along x; allowed: 2.399 m, the room",
        ),
        (
            {"length": "2 m"},
            CAP | {"offset": ["0 m", "1 m", "0 m"]},
            "light.room.length: the dome is 2.400 m wide along y; allowed: 2.000 m, the room",
        ),
        (
            {"door": ["0.9 m", "2.1 m"]},
            CAP | {"rim_height": "0.3 m"},
            "light.room.door: the shell is 1.251 x 2.938 x 2.939 m; allowed: two of its sides within 0.900 x 2.100 m,"
            " or segments: 3",
        ),
        (
            {"door": ["0.1 m", "0.1 m"], "segments": 2},
            CAP,
            "light.room.door: a part of the shell in 2 segments is 1.",
        ),
    ],
)
def test_a_dome_that_does_not_fit_is_refused_with_both_numbers(
    room: dict[str, Any], on: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(InputError) as caught:
        check(room, on)
    assert str(caught.value).startswith(complaint)
    assert "\n" not in str(caught.value)


def test_the_number_of_segments_named_by_the_error_is_enough() -> None:
    door = {"door": ["0.7 m", "1.2 m"]}
    with pytest.raises(InputError, match=r"or segments: (\d+)$") as caught:
        check(door)
    enough = int(str(caught.value).rsplit(" ", 1)[1])
    check(door | {"segments": enough})
    with pytest.raises(InputError):
        check(door | {"segments": enough - 1})


@pytest.mark.parametrize(
    ("room", "complaint"),
    [
        ("{height: 3 m}", "height requires bearing_height"),
        ("{segments: 4}", "segments: have no effect without a door"),
        ("{height: 3}", "light.room.height: 3 has no unit"),
        ("{door: 2 m}", "light.room.door"),
        ("{ceiling: 3 m}", "light.room.ceiling: unknown key"),
    ],
)
def test_an_invalid_room_is_refused_in_one_line(room: str, complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        loader.load("afit_simsat", {"light.room": room})
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


SEARCH = """
schema: 1
title: The largest dome under a ceiling
scene: afit_simsat
seed: 1
set:
  light.layout: {kind: fibonacci, count: 800, cap_deg: 27}
  light.room: {height: "2.4 m", bearing_height: "1 m", door: ["0.9 m", "2.1 m"]}
trial: {kind: centroids, noise_px: 0.1, tilt_deg: [0, 10]}
factors:
  radius:
    levels:
      small: {light.surface: {kind: sphere, apex: "1.2 m", radius: "1.2 m"}}
      high: {light.surface: {kind: sphere, apex: "1.45 m", radius: "1.45 m"}}
      low: {light.surface: {kind: sphere, apex: "1.35 m", radius: "1.35 m"}}
replicates: 2
responses: [identified]
optimize:
  objectives: [{response: identified, better: more}]
  candidates: 3
"""


@pytest.mark.slow
def test_a_room_constrains_a_search(tmp_path: Path) -> None:
    """A candidate that does not fit is infeasible, and the reason says by how much."""
    (tmp_path / "study.yaml").write_text(SEARCH)
    plan = study_loader.load(tmp_path / "study.yaml")
    with store.writing(tmp_path / "s.db") as kept:
        runner.prepare_store(plan, kept, resume=False)
        found = search.search(plan, kept, engines.Serial())
    reasons = {
        one.levels["radius"]: (one.feasible, one.refused, one.why) for one in found.candidates
    }
    assert set(reasons) == {"small", "low", "high"}
    assert reasons["small"] == reasons["low"] == (True, False, "")
    assert reasons["high"][:2] == (False, True)
    assert reasons["high"][2].startswith(
        "light.room.height: the dome's top is 2.450 m above the floor; allowed: 2.400 m, the ceiling"
    )
    assert {one.levels["radius"] for one in found.front} <= {"small", "low"}
