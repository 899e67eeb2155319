"""The effective scene: every key, its value, and the file and line that it comes from."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from skysim.core.paths import DATA, SCENES
from skysim.scene import loader, opencv_calibration, provenance
from skysim.scene.opencv_calibration import OpencvCalibration
from skysim.scene.provenance import Entry, Origin


def by_key(name: str | Path, **overrides: str) -> dict[str, Entry]:
    found = provenance.effective(
        name, {key.replace("__", "."): value for key, value in overrides.items()}
    )
    return {".".join(entry.path): entry for entry in found}


def line_in(path: Path, words: str) -> int:
    (line,) = [n for n, text in enumerate(path.read_text().splitlines(), 1) if words in text]
    return line


@pytest.mark.slow
@pytest.mark.parametrize("name", loader.list_scenes())
def test_the_shown_values_are_the_scene_s(name: str, tmp_path: Path) -> None:
    """Read back, it is equal: nothing is left out, and quantities keep their unit."""
    path = tmp_path / f"{name}.yaml"
    path.write_text(provenance.text(provenance.effective(name)))
    assert loader.load(path, refuses_unused=False) == loader.load(name)


def test_every_leaf_of_the_schema_is_shown() -> None:
    shown = set(by_key("simsat_slew"))
    scene = loader.load("simsat_slew")
    tree = scene.model_dump(by_alias=True, mode="json")

    def leaves(node: object, path: str) -> set[str]:
        if isinstance(node, dict) and node:
            return {
                leaf
                for key, inner in node.items()
                for leaf in leaves(inner, f"{path}.{key}" if path else key)
            }
        return {path}

    assert leaves(tree, "") == shown


def test_each_value_has_its_origin() -> None:
    """Its own file, a base, a preset, or the default."""
    found = by_key("simsat_bump")
    own = SCENES / "simsat_bump.yaml"
    base = SCENES / "afit_simsat.yaml"
    preset = DATA / "cameras" / "lu205c.yaml"
    for key, value, what, path, words in (
        ("seed", 6, "this file", own, "seed: 6"),
        ("vehicle.imu.gyro.rate_limit_deg_s", 10, "this file", own, "rate_limit_deg_s"),
        ("camera.focal_length", "35 mm", "base afit_simsat.yaml", base, "focal_length"),
        ("camera.shutter.kind", "global", "base afit_simsat.yaml", base, "shutter"),
        ("camera.detector.read_noise_e", 10, "preset lu205c.yaml", preset, "read_noise_e"),
    ):
        entry = found[key]
        assert (entry.value, entry.origin.what, Path(entry.origin.file)) == (
            value,
            what,
            path,
        )
        assert entry.origin.line == line_in(path, words)
    assert found["vehicle.imu.rate_hz"].origin == Origin("default")
    assert (
        found["camera.detector.bits"].value == loader.load("simsat_bump").camera.detector.bits
    )


def test_overrides_are_named_and_replace_earlier_values() -> None:
    """A section with another kind drops the file's keys; an element of a list makes the list the override's."""
    found = by_key(
        "afit_simsat",
        light__led__drive="{kind: direct}",
        vehicle__inertia__0="5 kg m2",
        motion__control="pd",
    )
    assert found["light.led.drive.kind"].origin.what == "--set"
    assert found["vehicle.inertia"].origin.what == "--set"
    assert found["vehicle.inertia"].value == ["5 kg m2", "6.5 kg m2", "9.0 kg m2"]
    assert found["motion.control.law"].origin.what == "--set"
    assert found["motion.control.rate_hz"].origin.what == "default"
    kind = by_key("afit_simsat", light__layout="{kind: fibonacci, count: 900, cap_deg: 27}")
    assert "light.layout.spacing" not in kind
    assert kind["light.layout.hardware_seed"].origin.what == "default"


def test_a_calibration_is_shown_as_an_origin(tmp_path: Path) -> None:
    lens = OpencvCalibration(1600, 1200, 9000.0, (800.0, 600.0), (0.1, 0.0, 0.0, 0.0, 0.0))
    (tmp_path / "lens.yml").write_text(opencv_calibration.text(lens))
    path = tmp_path / "mine.yaml"
    path.write_text(
        "schema: 1\nbase: afit_simsat\ncamera: {calibration: lens.yml, focal_length: null, pixel: 4 um}\n"
    )
    found = by_key(path)
    assert found["camera.distortion"].origin.what == "calibration lens.yml"
    assert found["camera.distortion"].value == [0.1, 0, 0, 0, 0]
    assert found["camera.pixel"].origin.what == "this file"


def test_a_key_without_effect_is_marked() -> None:
    found = by_key("afit_simsat", light__led__drive="{kind: direct}")
    assert "no pulses" in found["light.led.clock.offset_ppm"].no_effect
    assert found["light.led.intensity"].no_effect == ""
    text = provenance.text(list(found.values()))
    (line,) = [one for one in text.splitlines() if one.strip().startswith("pwm_period:")]
    assert line.endswith("# this file, line 48; no effect")


def test_the_text_is_yaml_with_aligned_comments() -> None:
    text = provenance.text(provenance.effective("shefex2"))
    assert yaml.safe_load(text)["camera"]["focal_length"] == "25 mm"
    short = [
        line.index("#")
        for line in text.splitlines()
        if "#" in line and len(line.partition("#")[0].rstrip()) < 44
    ]
    assert len(short) > 100
    assert len(set(short)) == 1
