"""Several LED types in a dome (`light.led.types`): each LED has the light and color of its own type, by a list or a
board."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.core.types import Sources
from skysim.scene.sections.camera import ChromaticConfig
from skysim.scene.sections.light import DomeConfig
from skysim.sources import dome
from skysim.sources.photometry import Band

BAND = Band.from_efficiency("cmos")
RED = {"intensity": "20 mcd", "spectrum": "630 nm", "fwhm": "20 nm"}
BLUE = {"radiant_intensity": "3 mW/sr", "spectrum": "470 nm"}
LED = {"intensity": "10 mcd", "disk_diameter": "2 mm", "drive": {"kind": "direct"}}
PLACES = [[f"{x} mm", "0 mm", "1 m"] for x in (-8, 0, 8)]
LIST = {"kind": "listed", "cap_deg": 10, "positions": PLACES}


def section(layout: dict[str, Any], **led: Any) -> DomeConfig:
    surface = {"kind": "sphere", "apex": "1 m", "radius": "1 m"}
    return DomeConfig.model_validate(
        {"kind": "dome", "surface": surface, "layout": layout, "led": LED | led}
    )


def leds(layout: dict[str, Any], band: Band = BAND, **led: Any) -> Sources:
    return dome.sources(section(layout, **led), band)


def strengths_of(kind: dict[str, Any], **led: Any) -> np.ndarray[Any, Any]:
    """Of the same places with LEDs of one type only."""
    own = {key: value for key, value in LED.items() if key != "intensity"}
    parts = {"kind": "dome", "surface": {"kind": "sphere", "apex": "1 m", "radius": "1 m"}}
    config = DomeConfig.model_validate(parts | {"layout": LIST, "led": own | kind | led})
    return dome.sources(config, BAND).strength


def test_each_led_has_the_light_of_a_dome_of_its_type_only() -> None:
    """Also its own scatter: the draws of an LED do not depend on the types of the others."""
    mixed = leds(
        LIST | {"types": ["red", "blue", "red"]},
        types={"red": RED, "blue": BLUE},
        scatter=0.08,
    )
    red, blue = (strengths_of(kind, scatter=0.08) for kind in (RED, BLUE))
    assert mixed.strength == pytest.approx([red[0], blue[1], red[2]], rel=1e-14)
    assert len(np.unique(mixed.strength)) == 3


def test_equal_watts_give_photons_as_the_wavelength() -> None:
    """For a chip with the same efficiency at all wavelengths: a photon has the energy h c / wavelength."""
    kinds = {
        f"{peak}": {"radiant_intensity": "1 mW/sr", "spectrum": f"{peak} nm"}
        for peak in (470, 525, 630)
    }
    flat = Band.from_efficiency(0.5)
    found = leds(LIST | {"types": list(kinds)}, flat, types=kinds).strength
    assert found / found[0] == pytest.approx(np.array([470, 525, 630]) / 470, rel=1e-9)


def test_resistors_of_one_type_are_levels() -> None:
    """I = (V - V_f) / R: with 1, 5 and 10 kohm the light is 1, 1/5 and 1/10."""
    currents = np.array([(5 - 2.0) / ohm for ohm in (1e3, 5e3, 1e4)])
    levels = (currents / currents[0]).tolist()
    found = leds(LIST | {"levels": levels, "types": ["red"] * 3}, types={"red": RED}).strength
    assert found / found[0] == pytest.approx([1, 0.2, 0.1])


def test_the_types_of_a_board_are_those_of_its_holes() -> None:
    boards = [
        {"azimuth_deg": 0, "tilt_deg": 0, "leds": [4, 0], "types": ["blue", "red"]},
        {"azimuth_deg": 0, "tilt_deg": 5, "leds": [2]},
    ]
    layout = {"kind": "patch_boards", "cap_deg": 20, "pitch": "8 mm", "boards": boards}
    found = leds(layout, types={"red": RED, "blue": BLUE})
    strength = dict(zip(found.id.tolist(), found.strength, strict=True))
    assert strength[4] == pytest.approx(strengths_of(BLUE)[0])
    assert strength[0] == pytest.approx(strengths_of(RED)[0])
    assert strength[9 + 2] == pytest.approx(strengths_of({"intensity": "10 mcd"})[0])


def test_a_lens_with_chromatic_aberration_shifts_each_color_by_its_own() -> None:
    lens = ChromaticConfig.model_validate(
        {"wavelength": ["400 nm", "900 nm"], "focus": ["0 um", "40 um"]}
    )
    band = replace(BAND, chromatic=lens)
    mixed, red, blue = (
        leds(LIST | {"types": names}, band, types=types).chromatic
        for names, types in (
            (["red", "blue", "red"], {"red": RED, "blue": BLUE}),
            (["red"] * 3, {"red": RED}),
            (["blue"] * 3, {"blue": BLUE}),
        )
    )
    assert mixed is not None
    assert red is not None
    assert blue is not None
    np.testing.assert_allclose(mixed, [red[0], blue[1], red[2]], rtol=1e-12)
    assert abs(red[0, 0] - blue[0, 0]) > 1e-6


def test_color_scatter_is_that_of_the_type() -> None:
    wide = RED | {"color_scatter": "5 nm"}
    mixed = leds(
        LIST | {"types": ["red", "blue", "red"]}, types={"red": wide, "blue": BLUE}
    ).strength
    even = leds(
        LIST | {"types": ["red", "blue", "red"]}, types={"red": RED, "blue": BLUE}
    ).strength
    assert mixed[1] == even[1]
    assert abs(mixed[[0, 2]] / even[[0, 2]] - 1).min() > 1e-4


@pytest.mark.parametrize(
    ("layout", "types", "words"),
    [
        (LIST | {"types": ["rod"] * 3}, {"red": RED}, "unknown LED type 'rod'; allowed: red"),
        (LIST | {"types": ["red"] * 2}, {"red": RED}, "types: 2; allowed: one for each"),
        (
            {"kind": "listed", "cap_deg": 10, "file": "ten_chars!", "types": ["red"] * 10},
            {"red": RED},
            "types: 10; allowed: one for each",
        ),
        (LIST, {"red": RED}, "led.types: not all are used"),
        ({"kind": "random", "count": 3, "cap_deg": 10}, {"red": RED}, "not all are used"),
        (
            {"kind": "fibers", "points": LIST | {"types": ["red"] * 3}},
            {"red": RED},
            "not all are used",
        ),
        (LIST | {"types": ["x"] * 3}, {"x": RED | {"spectrum": "white"}}, "whole spectrum"),
        (LIST | {"types": ["x"] * 3}, {"x": RED | BLUE}, "either intensity or"),
    ],
)
def test_bad_types_are_refused(
    layout: dict[str, Any], types: dict[str, Any], words: str
) -> None:
    with pytest.raises((InputError, ValueError), match=words):
        section(layout, types=types)
