"""A camera file from a data sheet: parsing, assumptions for missing values, validity as a preset."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.scene.camera_sheet import (
    PLACEHOLDERS,
    QUESTIONS,
    fill,
    outstanding,
    text,
)

STATED = {
    "pixels": "1936 x 1216",
    "pitch": "5.86 um",
    "focal_length": "1 in",
    "f_number": "f/1.4",
    "transmission": "85 %",
    "blur": "0.6 px",
    "shutter": "rolling shutter",
    "row_time": "8.5 us",
    "quantum_efficiency": "70 %",
    "bits": "10 bits",
    "black_level": "16",
    "full_well": "32513 e-",
    "gain": "0.125 DN/e-",
    "read_noise": "6.9 e-",
    "dark_current": "2 e-/s",
    "prnu": "0.8 %",
}


def load(tmp_path: Path, answers: dict[str, str], **own: object) -> loader.CameraConfig:
    """The camera of a scene that takes the file as its preset."""
    path = tmp_path / "my.yaml"
    path.write_text(text(fill(answers), "My camera"))
    scene = {"schema": 1, "base": "shefex2", "camera": {"preset": "my.yaml"} | own}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    return loader.load(tmp_path / "scene.yaml").camera


def test_a_full_data_sheet_is_used_without_assumptions(tmp_path: Path) -> None:
    assert fill(STATED).missing == []
    camera = load(tmp_path, STATED)
    assert (camera.width_px, camera.height_px, camera.f_number) == (1936, 1216, 1.4)
    assert camera.pixel_m == pytest.approx(5.86e-6, rel=1e-12)
    assert camera.focal_length_m == pytest.approx(0.0254, rel=1e-12)
    assert (camera.transmission, camera.psf.sigma_px) == (0.85, 0.6)
    assert camera.shutter.row_time_s == pytest.approx(8.5e-6, rel=1e-12)
    chip = camera.detector
    assert (chip.quantum_efficiency.curve, chip.quantum_efficiency.peak) == ("cmos", 0.7)
    assert (chip.bits, chip.offset_dn, chip.full_well_e, chip.gain_e_dn) == (10, 16, 32513, 8)
    assert (chip.read_noise_e, chip.dark_e_s, chip.prnu) == (6.9, 2, 0.008)
    not_asked = {
        "psf.kind",
        "detector.quantum_efficiency.curve",
        "detector.dark_temperature_c",
    }
    assert {line.key for line in fill(STATED).lines if line.comment != "[S1]"} == not_asked


def test_every_assumption_is_marked_and_has_its_consequence(tmp_path: Path) -> None:
    answers = {
        "pixels": "2448x2048",
        "pitch": "3.45 um",
        "focal_length": "16 mm",
        "f_number": "4",
    }
    sheet = fill(answers)
    assert {one.name for one in sheet.missing} == set(QUESTIONS) - set(answers) - {"row_time"}
    assert all(one.assumed and one.consequence for one in sheet.missing)
    comments = dict(re.findall(r"^ +(\w+): \S.*?# (.*)$", text(sheet, "x"), re.MULTILINE))
    assert {key for key, note in comments.items() if note == "[S1]"} == {
        "width_px",
        "height_px",
        "pixel",
        "focal_length",
        "f_number",
    }
    assert comments["full_well_e"] == "assumed: 900 e- a square micrometer, as in the IMX264"
    chip = load(tmp_path, answers).detector
    # 10,712 e-; the IMX250's measured 10,700.
    assert chip.full_well_e == pytest.approx(900 * 3.45**2, rel=1e-3)
    assert 0.99 * 4095 < chip.full_well_e / chip.gain_e_dn + chip.offset_dn <= 4095


def test_a_stated_gain_bounds_an_unknown_full_well() -> None:
    lines = {
        line.key: line.value
        for line in fill(PLACEHOLDERS | {"gain": "2", "bits": "8", "black_level": "5"}).lines
    }
    assert lines["detector.full_well_e"] == 2 * (255 - 5)


def test_without_a_lens_the_file_is_a_camera_body_and_states_it(tmp_path: Path) -> None:
    sheet = fill({"pixels": "2048x2048", "pitch": "5.5 um", "shutter": "interline"})
    written = text(sheet, "x")
    assert "# Not stated: focal_length; the file has no lens" in written
    assert not {"focal_length", "f_number", "transmission", "psf"} & set(
        yaml.safe_load(written)["camera"]
    )
    assert "curve: interline" in written
    camera = load(tmp_path, {"pixels": "2048x2048", "pitch": "5.5 um"}, focal_length="50 mm")
    assert (camera.width_px, camera.focal_length_m) == (2048, 0.05)


def test_a_lens_without_an_f_number_leaves_it_to_the_scene() -> None:
    (missing,) = [
        one
        for one in fill(PLACEHOLDERS | {"focal_length": "16 mm"}).missing
        if not one.assumed
    ]
    assert missing[::2] == ("f_number", "a scene must give camera.f_number")


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (
            {"pixels": "1936"},
            "answers.pixels: '1936'; allowed: width x height, such as 1936x1216",
        ),
        (
            {"pixels": "99999x9"},
            "answers.pixels: '99999x9'; allowed: less than or equal to 20000",
        ),
        (
            {"pitch": "5.86"},
            "answers.pitch: '5.86'; allowed: a length with its unit, such as \"5.86 um\"",
        ),
        ({"pitch": "5 m"}, "answers.pitch: '5 m'; allowed: less than or equal to 0.01 m"),
        ({"bits": "40"}, "answers.bits: '40'; allowed: 1 to 16"),
        (
            {"quantum_efficiency": "65"},
            "answers.quantum_efficiency: '65'; allowed: less than or equal to 1",
        ),
        (
            {"full_well": "1e999"},
            "answers.full_well: '1e999'; allowed: a number such as 10700",
        ),
        ({"full_well": "0"}, "answers.full_well: '0'; allowed: greater than or equal to 1"),
        (
            {"black_level": "5000"},
            "answers.black_level: '5000': 5000 is beyond the range of 12 bits",
        ),
        (
            {"gain": "0 DN/e-"},
            "answers.gain: '0 DN/e-'; allowed: greater than or equal to 0.000001",
        ),
        (
            {"shutter": "leaf"},
            "answers.shutter: 'leaf'; allowed: global, rolling, frame_transfer, interline",
        ),
        ({"row_time": "9 us"}, "answers.row_time: has no effect with a global shutter"),
        ({"f_number": "2"}, "answers.f_number: has no effect without focal_length"),
        ({"read_noise": "nan"}, "answers.read_noise: 'nan'; allowed: a number such as 3"),
        ({"prnu": "-1 %"}, "answers.prnu: '-1 %'; allowed: greater than or equal to 0"),
    ],
)
def test_a_wrong_answer_is_refused_with_the_allowed_values(
    answers: dict[str, str], message: str
) -> None:
    with pytest.raises(InputError) as caught:
        outstanding(answers)
    assert str(caught.value) == message


def test_size_and_pitch_are_required() -> None:
    required = {name for name, question in QUESTIONS.items() if question.consequence == ""}
    assert required == set(PLACEHOLDERS)
    with pytest.raises(InputError, match=r"^answers\.pitch: missing; Pixel pitch"):
        fill({"pixels": "10x10"})
