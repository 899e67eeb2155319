"""Shipped cameras: every value has a source, every preset is valid, and derived figures match."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from skysim.core.errors import InputError
from skysim.scene.loader import PRESETS, CameraFileConfig, with_preset
from skysim.scene.sections.camera import CameraConfig

FILES = sorted(PRESETS.glob("*.yaml"))
NAMES = [path.stem for path in FILES]
SOURCE = re.compile(r"\s#.*(\[(S\d|F|M|C|I)\]|\bassumed\b)")
LENS = {"focal_length": "25 mm", "f_number": 1.4}


def tree(name: str, **own: Any) -> dict[str, Any]:
    return with_preset({"camera": {"preset": name} | LENS | own})


def camera(name: str, **own: Any) -> CameraConfig:
    return CameraFileConfig.model_validate(tree(name, **own)).camera


def field_deg(made: CameraConfig) -> tuple[float, float]:
    """The chip's width and height as angles, by the tangent of their halves, for a lens focused at infinity."""
    half = [
        size * made.pixel_m / 2 / made.focal_length_m
        for size in (made.width_px, made.height_px)
    ]
    return 2 * math.degrees(math.atan(half[0])), 2 * math.degrees(math.atan(half[1]))


def test_the_four_documented_presets_exist() -> None:
    assert {"lu205c", "ec655", "wat902h2", "aps"} <= set(NAMES)


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_every_preset_value_states_its_source(path: Path) -> None:
    lines = [
        line for line in path.read_text().splitlines() if line and not line.startswith("#")
    ]
    values = [line for line in lines if not re.fullmatch(r"\s*\w+:", line)]
    assert len(values) > 15
    assert [line for line in values if not SOURCE.search(line)] == []


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_every_preset_value_has_its_own_line(path: Path) -> None:
    def leaves(part: Any) -> int:
        return sum(map(leaves, part.values())) if isinstance(part, dict) else 1

    lines = [
        line for line in path.read_text().splitlines() if re.match(r"\s*\w+: +[^#\s]", line)
    ]
    assert len(lines) == leaves(yaml.safe_load(path.read_text()))


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_and_a_lens_make_a_camera(name: str) -> None:
    made = camera(name)
    assert made.focal_length_m == 0.025
    # The preset is a body without a lens: the lens's keys are the scene's.
    assert not {"focal_length", "f_number", "transmission", "psf"} & set(
        with_preset(bare(name))["camera"]
    )


def bare(name: str) -> dict[str, Any]:
    return {"camera": {"preset": name}}


@pytest.mark.parametrize("name", NAMES)
def test_without_a_lens_the_error_names_the_missing_lens(name: str) -> None:
    with pytest.raises(ValueError, match=r"(?s)focal_length.*Field required"):
        CameraFileConfig.model_validate(with_preset(bare(name)))


@pytest.mark.parametrize("name", NAMES)
def test_the_converter_ends_a_little_above_the_full_well(name: str) -> None:
    detector = camera(name).detector
    full_dn = detector.full_well_e / detector.gain_e_dn + detector.offset_dn
    assert 0.95 * (2**detector.bits - 1) < full_dn <= 2**detector.bits - 1


def test_a_rolling_preset_reads_its_rows_in_11_to_100_ms() -> None:
    """The slowest, lu205c, does 10 frames a second, the fastest, EC655, 90 (reference §2)."""
    made = {name: camera(name) for name in NAMES}
    read = {
        name: one.height_px * one.shutter.row_time_s
        for name, one in made.items()
        if one.shutter.kind != "global"
    }
    assert {"lu205c", "ec655", "imx178", "imx477"} <= set(read)
    assert {name: time_s for name, time_s in read.items() if not 0.011 < time_s <= 0.1} == {}


def test_the_scene_s_keys_replace_the_preset_s() -> None:
    made = camera("ec655", width_px=640, detector={"read_noise_e": 9.0})
    assert (made.width_px, made.height_px) == (640, 493)
    assert made.detector.read_noise_e == 9.0
    assert made.detector.full_well_e == camera("ec655").detector.full_well_e


def test_another_kind_of_shutter_replaces_the_preset_s() -> None:
    assert camera("lu205c", shutter={"kind": "global"}).shutter.kind == "global"
    slower = camera("lu205c", shutter={"kind": "rolling", "row_time": "50 us"}).shutter
    assert slower.row_time_s == pytest.approx(50e-6, rel=1e-12)


def test_an_unknown_preset_is_answered_with_the_known_ones_in_one_line() -> None:
    with pytest.raises(InputError) as caught:
        tree("lu250c")
    assert (
        str(caught.value)
        == f"camera.preset: unknown preset 'lu250c'; allowed: {', '.join(NAMES)}, or a .yaml file with a camera"
    )


def test_a_preset_of_the_base_is_switched_off_by_null() -> None:
    own = {"pixel": "5 um", "width_px": 640}
    assert with_preset({"camera": {"preset": None} | own}) == {"camera": own}


def test_a_camera_without_a_preset_is_unchanged() -> None:
    raw = {"camera": {"width_px": 640}, "title": "x"}
    assert with_preset(raw) is raw


def test_lu205c_has_the_thesis_s_field() -> None:
    # Reference §1.2: 10.45 deg behind 35 mm; §2: 83 us a row are 10 frames a second; the MT9M001's peak of 52 %.
    made = camera("lu205c", focal_length="35 mm")
    assert field_deg(made)[0] == pytest.approx(10.45, abs=0.005)
    assert 1 / (made.height_px * made.shutter.row_time_s) == pytest.approx(10, rel=0.01)


def test_lu205c_is_52_per_cent_efficient_in_the_green() -> None:
    from skysim.sources.photometry import Band

    band = Band.from_efficiency(camera("lu205c").detector.quantum_efficiency)
    assert band.response.max() == pytest.approx(0.52, abs=1e-12)
    assert 500e-9 <= band.wavelength_m[band.response.argmax()] <= 570e-9


def test_ec655_has_the_reference_s_field_and_dynamic_range() -> None:
    # Reference H1: 14.868 x 11.150 deg behind 25 mm, diagonal 18.51; §2: 68.7 dB, 8-bit step 157 e-, 45 e- rms.
    made = camera("ec655")
    assert field_deg(made) == pytest.approx((14.868, 11.150), abs=0.001)
    diagonal_m = math.hypot(made.width_px, made.height_px) * made.pixel_m
    assert 2 * math.degrees(math.atan(diagonal_m / 2 / 0.025)) == pytest.approx(
        18.51, abs=0.005
    )
    detector = made.detector
    assert 20 * math.log10(detector.full_well_e / detector.read_noise_e) == pytest.approx(
        68.7, abs=0.05
    )
    assert detector.full_well_e / 255 == pytest.approx(157, abs=0.5)
    assert detector.full_well_e / 255 / math.sqrt(12) == pytest.approx(45, abs=0.5)
    assert 1 / (made.height_px * made.shutter.row_time_s) == pytest.approx(90, rel=0.01)


def test_wat902h2_has_the_reference_s_field_and_video_noise() -> None:
    # Reference §2: 41.3 x 31.5 deg behind 8.5 mm. Read noise and the converter's rounding together are 50 dB down.
    made = camera("wat902h2", focal_length="8.5 mm")
    assert field_deg(made) == pytest.approx((41.3, 31.5), abs=0.05)
    noise_e = math.hypot(made.detector.read_noise_e, made.detector.gain_e_dn / math.sqrt(12))
    assert 20 * math.log10(made.detector.full_well_e / noise_e) == pytest.approx(50, abs=0.1)
