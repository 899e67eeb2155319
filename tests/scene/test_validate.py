"""Files are checked before a run; the schema for editors has the same rules."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from typer.testing import CliRunner

from skysim.apps.cli import json_schema, main
from skysim.apps.cli.commands.validate import check_file
from skysim.core import yaml_reader
from skysim.core.errors import InputError
from skysim.core.paths import DATA, ROOT, SCENES
from skysim.experiments.study import study_file
from skysim.scene import opencv_calibration
from skysim.scene.loader import load, load_camera

SHIPPED = {
    "scene": sorted(SCENES.glob("*.yaml")),
    "study": sorted((SCENES / "studies").glob("*.yaml")),
}


class Plain(yaml.SafeLoader):
    """YAML loader as in editors: times are text."""


Plain.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in pairs if not tag.endswith(":timestamp")]
    for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def faults(kind: str, tree: Any) -> list[str]:
    """What an independent validator has against it."""
    validator = jsonschema.Draft202012Validator(json_schema.json_schema(kind))
    return [error.message for error in validator.iter_errors(tree)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", SHIPPED)
def test_the_published_schema_is_the_newest_and_takes_every_file_that_ships(
    kind: str,
) -> None:
    published = json.loads((DATA / "schema" / f"{kind}.json").read_text())
    assert published == json_schema.json_schema(kind), (
        f"skysim validate --schema {kind} > data/schema/{kind}.json"
    )
    jsonschema.Draft202012Validator.check_schema(published)
    for path in SHIPPED[kind]:
        tree = yaml.load(path.read_text(), Plain)
        assert tree["schema"] == yaml_reader.VERSION
        assert faults(kind, tree) == [], path


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        {"camera": {"f_numbr": 2}},
        {"camera": {"width_px": "wide"}},
        {"camera": {"transmission": 1.5}},
        {"camera": {"focal_length": 35}},
        {"camera": {"focal_length": "mm 35"}},
        {"light": {"kind": "candle"}},
        {"motion": {"control": 3}},
        {"exposure": {"frames": 0}},
        {"schema": 2},
    ],
)
def test_an_editor_marks_what_skysim_refuses(wrong: dict[str, Any], tmp_path: Path) -> None:
    assert faults("scene", {"schema": 1} | wrong)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"schema": 1, "base": "shefex2"} | wrong))
    with pytest.raises(InputError):
        load(path)


def test_another_version_is_refused_by_name_anywhere_in_the_file(tmp_path: Path) -> None:
    newer, mine, study = (tmp_path / f"{name}.yaml" for name in ("newer", "mine", "study"))
    newer.write_text("schema: 3\nbase: shefex2\nfuture: 1\n")
    mine.write_text("schema: 1\nbase: newer.yaml\n")
    for path in (newer, mine):
        with pytest.raises(
            InputError,
            match=r"^schema: version 3 is newer than skysim .*newer\.yaml, line 1\)$",
        ):
            load(path)
    study.write_text("title: T\nschema: 0\n")
    with pytest.raises(
        InputError,
        match=r"^schema: version 0 is no longer supported; allowed: 1 \(.*study\.yaml, line 2\)$",
    ):
        study_file.load(study)


def test_a_scene_or_study_without_a_version_gets_the_line_to_add(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    above = tmp_path / "above.yaml"
    path.write_text("base: shefex2\n")
    above.write_text("schema: 1\nbase: mine.yaml\n")
    says = f"schema: missing; add the line schema: 1 ({path})"
    for read in (
        lambda: load(path),
        lambda: load(above),
        lambda: load(path, {"schema": "1"}),
    ):
        with pytest.raises(InputError, match=f"^{re.escape(says)}$"):
            read()
    path.write_text("title: T\nscene: shefex2\n")
    with pytest.raises(InputError, match=f"^{re.escape(says)}$"):
        study_file.load(path)
    for kind in SHIPPED:
        assert faults(kind, {"title": "T"}) == ["'schema' is a required property"]
    path.write_text(
        "camera: {preset: ec655, focal_length: 16 mm, f_number: 1.4}\n"
    )  # no scene
    assert load_camera(path).f_number == 1.4


def test_a_shipped_camera_is_checked_by_its_name() -> None:
    assert check_file(Path("imx264"), {}).what == "a camera of 2448 x 2048 pixels"


@pytest.mark.slow
def test_each_kind_of_file_is_recognized_and_each_fault_is_one_line(tmp_path: Path) -> None:
    broken = tmp_path / "broken.ecsv"
    xml = tmp_path / "a.xml"
    broken.write_text("# %ECSV 1.0\nnothing\n")
    for path, what in (
        (SCENES / "shefex2.yaml", "a scene of 45735 lights and 40 frames"),
        (SCENES / "studies" / "end_to_end.yaml", "a study of 6 trials"),
        (DATA / "cameras" / "aps.yaml", "a camera of "),
        (DATA / "catalogs" / "hipparcos_hp6.5.ecsv", "a catalog of 7996 stars"),
        (DATA / "catalogs" / "gaia_v8.0.ecsv", "a catalog of 45735 stars"),
    ):
        result = check_file(path, {})
        assert (result.fault, result.what[: len(what)]) == ("", what)
    for path in (broken, xml, tmp_path / "none.yaml", ROOT / "data/published/afit.yaml"):
        fault = check_file(path, {}).fault
        assert fault
        assert "\n" not in fault


@pytest.mark.slow
def test_every_file_that_skysim_reads_is_valid(tmp_path: Path) -> None:
    lens = tmp_path / "lens.yml"
    lens.write_text(opencv_calibration.text(load("shefex2").camera.calibration()))
    for path, what in (
        (lens, "a calibration of 659 x 493 pixels"),
        (Path("shefex2"), "a scene of 45735 lights"),
        (Path("end_to_end"), "a study of 6 trials"),
        (SCENES / "vehicles/simsat.xml", "a vehicle of 73.35 kg"),
    ):
        result = check_file(path, {})
        assert (result.fault, result.what[: len(what)]) == ("", what)
    assert (
        "allowed: a .yaml file or one of afit_as_built"
        in check_file(Path("nosuch"), {}).fault
    )


def test_an_endless_file_is_refused_without_waiting(tmp_path: Path) -> None:
    for suffix in ("yaml", "ecsv", "xml"):
        os.mkfifo(tmp_path / f"pipe.{suffix}")
        (tmp_path / f"zero.{suffix}").symlink_to("/dev/zero")
        for name in ("pipe", "zero"):
            assert check_file(tmp_path / f"{name}.{suffix}", {}).fault.endswith(
                "not a regular file"
            )


def test_a_wrong_key_of_a_trial_is_answered_with_the_allowed_ones(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    text = (SCENES / "studies/false_stars.yaml").read_text()
    path.write_text(text.replace("trial.false_lights", "trial.false_light"))
    says = (
        r"trial\.false_light: unknown key; did you mean false_lights\?; allowed: .*noise_px.*"
    )
    assert re.fullmatch(
        rf"factors\.strays: 0: {says} \(.*mine\.yaml, line 9\)", check_file(path, {}).fault
    )


def test_an_error_found_at_setup_has_its_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("schema: 1\nbase: afit_simsat\ntracker:\n  map: nothing.ecsv\n")
    assert "nothing.ecsv" in check_file(path, {}).fault
    assert "mine.yaml, line 4" in check_file(path, {}).fault


@pytest.mark.slow
def test_the_command_refuses_with_2_and_prints_a_schema() -> None:
    done = CliRunner().invoke(
        main.app, ["validate", str(SCENES / "shefex2.yaml"), "nothing.yaml", "--json"]
    )
    assert done.exit_code == 2
    assert [bool(one["fault"]) for one in json.loads(done.stdout)] == [False, True]
    assert (
        json.loads(CliRunner().invoke(main.app, ["validate", "--schema", "study"]).stdout)[
            "title"
        ]
        == "A study of skysim"
    )
