"""The blocks of docs/howto/scene.md run and are solved; its error message is the real one."""

import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import yaml

from skysim.camera.optics import VIGNETTING
from skysim.camera.psf.otf import PSFS
from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.scene.sections import camera, motion, vehicle
from skysim.sources.dome import led
from skysim.sources.dome.layouts.registry import LAYOUTS
from skysim.sources.dome.surface import SURFACES
from tests.helpers import doc_pages as pages

PAGE = "docs/howto/scene.md"
REFERENCE = "docs/reference/scenes.md"


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder that looks like the checkout."""
    return pages.checkout(tmp_path)


@pytest.mark.long
def test_the_camera_block_gives_solved_frames(folder):
    """The block's lines in a copy of the scene that the text names, flown for two frames by the real command."""
    block = pages.yaml_block(PAGE, "camera")
    tree = yaml.safe_load((ROOT / "scenes/afit_simsat.yaml").read_text(encoding="utf-8"))
    mine = yaml.safe_load(block)
    assert set(mine) == {"camera", "background", "motion"}
    assert not set(mine["motion"]) & set(tree["motion"])
    path = folder / "mine.yaml"
    path.write_text(
        yaml.safe_dump(
            tree | mine | {"motion": tree["motion"] | mine["motion"]}, sort_keys=False
        )
    )
    report = pages.answer(folder, "run", str(path), "--frames", "2")
    assert (report["frames"], report["solved"], report["wrong"]) == (2, 2, 0)


def test_the_camera_block_names_every_existing_kind():
    """`# or ...` beside a kind lists the others, all of them."""
    block = pages.yaml_block(PAGE, "camera")
    rest = re.findall(r"(\w+): \{kind: (\w+)[^#]*# or ([\w, ]+)", block)
    named_kinds = {section: {kind, *others.split(", ")} for section, kind, others in rest}
    shutters = get_args(get_args(camera.Shutter)[0])
    assert named_kinds == {
        "vignetting": set(VIGNETTING),
        "psf": set(PSFS),
        "shutter": {get_args(part.model_fields["kind"].annotation)[0] for part in shutters},
    }


@pytest.mark.long
def test_the_dome_block_gives_solved_frames(folder):
    path = folder / "dome.yaml"
    path.write_text("schema: 1\nbase: afit_simsat\n" + pages.yaml_block(PAGE, "light"))
    report = pages.answer(folder, "run", str(path), "--frames", "3")
    assert (report["frames"], report["solved"], report["wrong"]) == (3, 3, 0)


@pytest.mark.long
def test_the_vehicle_block_flies_with_a_filtered_attitude(folder):
    """The block as a scene, two seconds of it by the real command: wheels, fans, gyros, filter, all disturbances."""
    path = folder / "flown.yaml"
    path.write_text("schema: 1\n" + pages.yaml_block(PAGE, "base"))
    report = pages.answer(folder, "run", str(path), "--frames", "3")
    assert (report["frames"], report["solved"], report["wrong"]) == (3, 3, 0)
    assert report["flight"]["filter_arcsec_end"] < 30
    assert [row["filter"] for row in report["rows"]] == ["used"] * 3


def test_the_vehicle_block_names_every_existing_choice():
    """`# or ...` beside a choice lists the others, all of them; and every kind of maneuver is shown."""
    block = pages.yaml_block(PAGE, "base")
    named_choices = {
        key: {one, *others.split(", ")}
        for key, one, others in re.findall(r"(\w+): (\w+) +# or ([\w, ]+)", block)
    }
    choices = {
        key: set(get_args(part.model_fields[key].annotation))
        for part, keys in (
            (motion.ControlConfig, ("actuators", "feedback")),
            (vehicle.ImuConfig, ("earth_rate",)),
        )
        for key in keys
    }
    choices["law"] = {*motion.BUILT_IN_LAWS, motion.PRESCRIBED}
    assert named_choices == choices
    shown = {element["kind"] for element in yaml.safe_load(block)["motion"]["maneuver"]}
    kinds = {
        get_args(part.model_fields["kind"].annotation)[0]
        for part in get_args(get_args(motion.Maneuver)[0])
    }
    assert shown | {"profile"} == kinds  # which has a page of its own


@pytest.mark.long
def test_the_page_s_controller_damps_the_motion(folder):
    """Each rate dies as exp(-5 t / J), the angle is its integral; gravity on tens of micrometers adds 0.1 deg or so."""
    (block,) = pages.blocks(PAGE, "python")
    done = subprocess.run(
        [sys.executable, "-c", block], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    numbers = [float(word) for word in re.findall(r"[-\d.]+(?:e[-+]\d+)?", done.stdout)]
    turned = np.array(numbers[:3])
    rate = np.array(numbers[3:])
    inertia = np.array([6.0, 6.5, 9.0])
    expected = np.array([2, 0, 5]) * inertia / 5 * (1 - np.exp(-5 * 1.25 / inertia))
    np.testing.assert_allclose(turned, expected, rtol=0, atol=0.2)
    assert np.abs(rate).max() < 0.2


@pytest.mark.long
def test_the_catalog_commands_leave_catalogs_a_log_and_a_study(folder):
    pages.run_commands(PAGE, folder)
    names = ("chosen.ecsv", "raw.cat", "m6.cat", "m6.log", "shefex_fig_7/report.html")
    assert all((folder / "out" / name).is_file() for name in names)
    page = (folder / "out" / "shefex2" / "report.html").read_text(encoding="utf-8")
    assert "measured (-2.5 log10 DN/s) minus catalog" in page


def test_the_error_message_is_what_a_user_sees(tmp_path, monkeypatch):
    (block,) = pages.blocks(PAGE, "text")
    bad = (ROOT / "scenes/afit_simsat.yaml").read_text(encoding="utf-8")
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes/afit_simsat.yaml").write_text(
        bad.replace("falloff: inverse_square", "falloff: cubic")
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as raised:
        load("scenes/afit_simsat.yaml")
    assert block.strip() == f"skysim: {raised.value}"


def test_every_kind_of_dome_is_in_the_reference():
    """Surfaces, layouts and drives, each by its name in the section on domes."""
    section = pages.text(REFERENCE).partition("## Kinds of dome\n")[2].partition("\n## ")[0]
    kinds = [*SURFACES, *LAYOUTS, *led.DRIVES]
    assert [kind for kind in kinds if f"`{kind}`" not in section] == []


def test_every_section_of_a_scene_is_in_the_reference():
    section = pages.text(REFERENCE).partition("## Sections\n")[2].partition("\n## ")[0]
    named_sections = set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE))
    assert named_sections == set(Scene.model_fields) - {
        "schema_version",
        "name",
        "title",
        "seed",
        "start_time",
    }
