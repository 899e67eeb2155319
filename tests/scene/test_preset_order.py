"""A camera preset replaces the camera keys of the base scene that it defines, and no others."""

from __future__ import annotations

from pathlib import Path

import pytest

from skysim.core.errors import InputError
from skysim.scene import loader, provenance

WITH_LENS = """camera:
  width_px: 2448
  height_px: 2048
  pixel: "3.45 um"
  focal_length: "16 mm"
  f_number: 2.8
  shutter: {kind: rolling, row_time: "20 us"}
  detector: {quantum_efficiency: 0.6, full_well_e: 10000, gain_e_dn: 3, bits: 12, read_noise_e: 3}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine.yaml").write_text(WITH_LENS)
    return tmp_path


def write(folder: Path, camera: str) -> Path:
    path = folder / "scene.yaml"
    path.write_text(f"schema: 1\nbase: afit_simsat\ncamera: {camera}\n")
    return path


def test_a_preset_s_lens_and_shutter_replace_those_of_the_base(folder: Path) -> None:
    """afit_simsat has a lens of 35 mm at f/8 and a global shutter of its own."""
    camera = loader.load(write(folder, "{preset: mine.yaml}")).camera
    assert (camera.focal_length_m, camera.f_number) == (0.016, 2.8)
    assert camera.shutter.kind == "rolling"
    # What the preset does not define is the base's.
    assert camera.transmission == loader.load("afit_simsat").camera.transmission
    assert camera.focus_m == loader.load("afit_simsat").camera.focus_m


def test_the_scene_s_own_keys_replace_the_preset_s(folder: Path) -> None:
    camera = loader.load(
        write(folder, '{preset: mine.yaml, focal_length: "25 mm", shutter: {kind: global}}')
    ).camera
    assert (camera.focal_length_m, camera.shutter.kind) == (0.025, "global")


def test_the_preset_of_a_body_leaves_the_lens_of_the_base(folder: Path) -> None:
    camera = loader.load(write(folder, "{preset: imx477}")).camera
    assert (camera.width_px, camera.shutter.kind, camera.focal_length_m) == (
        4056,
        "rolling",
        0.035,
    )


def test_a_preset_of_the_base_is_dropped_whole(folder: Path) -> None:
    """lu205c states anti_blooming or not; no key of its detector may be left under another body."""
    detector = loader.load(write(folder, "{preset: mine.yaml}")).camera.detector
    assert (detector.prnu, detector.hot_pixels, detector.offset_dn) == (0, 0, 0)


def test_an_overridden_preset_replaces_the_file_s_keys_but_not_other_overrides(
    folder: Path,
) -> None:
    over = {"camera.focal_length": "50 mm", "camera.preset": str(folder / "mine.yaml")}
    camera = loader.load("afit_simsat", over).camera
    assert (camera.focal_length_m, camera.f_number, camera.shutter.kind) == (
        0.05,
        2.8,
        "rolling",
    )


def test_an_unknown_preset_over_a_base_is_an_error_with_its_line(folder: Path) -> None:
    with pytest.raises(
        InputError, match=r"unknown preset 'nosuch'; allowed: .*scene.yaml, line 3\)"
    ):
        loader.load(write(folder, "{preset: nosuch}"))


def test_a_preset_file_is_named_as_the_origin_of_its_keys(folder: Path) -> None:
    entries = provenance.effective(write(folder, "{preset: mine.yaml, f_number: 4}"))
    origin = {".".join(entry.path): str(entry.origin) for entry in entries}
    assert origin["camera.focal_length"] == "preset mine.yaml, line 5"
    assert origin["camera.shutter.kind"] == "preset mine.yaml, line 7"
    assert origin["camera.f_number"] == "this file, line 3"
    assert origin["camera.transmission"].startswith("base afit_simsat.yaml")


# A profile gives the rate at which a motion starts.

PROFILE = (
    "{start: profile, control: prescribed, maneuver: [{kind: profile, file: sky.csv}]%s}"
)


def on_profile(folder: Path, more: str = "") -> Path:
    rows = "\n".join(f"{t},83.0,{2 + 0.01 * t:.3f},20.0" for t in range(0, 20))
    (folder / "sky.csv").write_text(f"t_s,ra_deg,dec_deg,roll_deg\n{rows}\n")
    path = folder / "scene.yaml"
    path.write_text(f"schema: 1\nbase: shefex2\nmotion: {PROFILE % more}\n")
    return path


def test_a_rate_of_the_base_is_dropped_where_a_profile_gives_it(folder: Path) -> None:
    """shefex2 turns at 0.5 deg/s; a rate in the scene itself is a contradiction."""
    assert loader.load("shefex2").motion.rate_deg_s == (0.3, 0.4, 0.0)
    scene = loader.load(on_profile(folder))
    assert (scene.motion.start, scene.motion.rate_deg_s) == ("profile", (0.0, 0.0, 0.0))
    shown = {
        ".".join(entry.path): entry for entry in provenance.effective(on_profile(folder))
    }
    assert shown["motion.rate_deg_s"].origin.what == "default"
    with pytest.raises(
        InputError, match=r"rate_deg_s: has no effect with start: profile.*scene\.yaml"
    ):
        loader.load(on_profile(folder, ", rate_deg_s: [0.1, 0, 0]"))


def test_a_start_on_the_command_line_drops_the_rate_too(folder: Path) -> None:
    on_profile(folder)
    maneuver = f"[{{kind: profile, file: {folder / 'sky.csv'}}}]"
    overrides = {
        "motion.control": "prescribed",
        "motion.maneuver": maneuver,
        "motion.start": "profile",
    }
    assert loader.load("shefex2", overrides).motion.rate_deg_s == (0.0, 0.0, 0.0)
    with pytest.raises(InputError, match="rate_deg_s: has no effect with start: profile"):
        loader.load("shefex2", overrides | {"motion.rate_deg_s": "[0.1, 0, 0]"})
