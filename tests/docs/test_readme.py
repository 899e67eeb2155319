"""Every code block of the README runs, in its order, in one folder."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import get_args

import mujoco
import numpy as np
import pytest
import yaml

from skysim.camera.optics import VIGNETTING
from skysim.camera.psf.otf import PSFS
from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.scene import camera, motion, vehicle
from skysim.scene.loader import load
from skysim.sources.dome import led
from skysim.sources.dome.layout import LAYOUTS
from skysim.sources.dome.surface import SURFACES

README = (ROOT / "README.md").read_text(encoding="utf-8")
SKYSIM = [sys.executable, "-m", "skysim"]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def yaml_block(key: str) -> str:
    """The one block of YAML that has this key at its top."""
    (block,) = [block for block in blocks("yaml") if re.search(rf"^{key}:", block, re.MULTILINE)]
    return block


def commands() -> list[list[str]]:
    """The skysim commands of the shell blocks; `make` is what runs this test."""
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith(".venv/bin/skysim")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder that looks like the checkout, where every command of the README has been run."""
    folder = tmp_path_factory.mktemp("readme")
    for name in ("scenes", "data"):
        (folder / name).symlink_to(ROOT / name)
    for command in commands():
        done = subprocess.run([*SKYSIM, *command], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, f"{command}: {done.stderr}"
        assert done.stdout, command
    return folder


def test_the_commands_leave_what_the_readme_says(folder):
    ran = {path.name for path in (folder / "out" / "short").iterdir()}
    frames = {f"frame_000{n}.{suffix}" for n in (0, 1) for suffix in ("fits", "png", "ecsv")}
    assert ran == frames | {"solutions.ecsv", "telemetry.ecsv", "annotated.png", "report.html"}
    # `render` came after `run` and cleared what the latter said of other frames.
    rendered = {path.name for path in (folder / "out" / "shefex2").iterdir()}
    assert rendered == {f"frame_0000.{suffix}" for suffix in ("fits", "png", "ecsv", "preview.png")}


def test_the_camera_block_is_a_camera_that_sees(folder):
    """The block's lines in a copy of the scene that the text names, flown for two frames by the real command."""
    block = yaml_block("camera")
    tree = yaml.safe_load((ROOT / "scenes/afit_simsat.yaml").read_text(encoding="utf-8"))
    mine = yaml.safe_load(block)
    assert set(mine) == {"camera", "background", "motion"}
    assert not set(mine["motion"]) & set(tree["motion"])
    path = folder / "mine.yaml"
    path.write_text(
        yaml.safe_dump(tree | mine | {"motion": tree["motion"] | mine["motion"]}, sort_keys=False)
    )
    command = [*SKYSIM, "run", str(path), "--frames", "2", "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["frames"], told["solved"], told["wrong"]) == (2, 2, 0)


def test_every_kind_that_the_camera_block_names_is_one():
    """`# or ...` beside a kind lists the others, all of them."""
    block = yaml_block("camera")
    rest = re.findall(r"(\w+): \{kind: (\w+)[^#]*# or ([\w, ]+)", block)
    told = {section: {kind, *others.split(", ")} for section, kind, others in rest}
    shutters = get_args(get_args(camera.Shutter)[0])
    assert told == {
        "vignetting": set(VIGNETTING),
        "psf": set(PSFS),
        "shutter": {get_args(part.model_fields["kind"].annotation)[0] for part in shutters},
    }


def test_the_dome_block_is_a_dome_under_which_the_tracker_finds_itself(folder):
    path = folder / "dome.yaml"
    path.write_text("schema: 1\nbase: afit_simsat\n" + yaml_block("light"))
    command = [*SKYSIM, "run", str(path), "--frames", "3", "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["frames"], told["solved"], told["wrong"]) == (3, 3, 0)


def test_the_study_block_is_a_study(folder):
    path = folder / "lens.yaml"
    path.write_text(yaml_block("trial"))
    command = [*SKYSIM, "study", "run", str(path), "--engine", "serial", "--set", "replicates=2", "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["done"], told["failed"], told["wrong"]) == (4 * 2 * 2 * 2, 0, 0)
    assert (folder / "out" / "lens" / "report.html").is_file()


def test_every_kind_of_dome_is_in_the_readme():
    """Surfaces, layouts and drives, each by its name in the section on the dome."""
    section = README.partition("### The dome\n")[2].partition("\n### ")[0]
    kinds = [*SURFACES, *LAYOUTS, *led.DRIVES]
    assert [kind for kind in kinds if f"`{kind}`" not in section] == []


def test_the_vehicle_block_flies_and_is_told_where_it_is(folder):
    """The block as a scene, two seconds of it by the real command: wheels, fans, gyros, filter, all disturbances."""
    path = folder / "flown.yaml"
    path.write_text("schema: 1\n" + yaml_block("base"))
    command = [*SKYSIM, "run", str(path), "--frames", "3", "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["frames"], told["solved"], told["wrong"]) == (3, 3, 0)
    assert told["flight"]["filter_arcsec_end"] < 30
    assert [row["filter"] for row in told["rows"]] == ["used"] * 3


def test_every_choice_that_the_vehicle_block_names_is_one():
    """`# or ...` beside a choice lists the others, all of them; and every kind of manoeuvre is shown."""
    block = yaml_block("base")
    told = {
        key: {one, *others.split(", ")}
        for key, one, others in re.findall(r"(\w+): (\w+) +# or ([\w, ]+)", block)
    }
    choices = {
        key: set(get_args(part.model_fields[key].annotation))
        for part, keys in (
            (motion.ControlConfig, ("law", "actuators", "feedback")),
            (vehicle.ImuConfig, ("earth_rate",)),
        )
        for key in keys
    }
    assert told == choices
    shown = {element["kind"] for element in yaml.safe_load(block)["motion"]["manoeuvre"]}
    kinds = {
        get_args(part.model_fields["kind"].annotation)[0] for part in get_args(get_args(motion.Manoeuvre)[0])
    }
    assert shown == kinds


def test_the_picture_of_the_lab_is_there_or_the_reason_is_told(folder):
    """`--picture` in the README's own run: with OpenGL both files, without it the run's report all the same."""
    left = {path.name for path in (folder / "out" / "simsat_slew").iterdir()}
    assert "report.html" in left
    assert ("lab.png" in left) == ("lab.gif" in left)


def test_the_exported_scene_steps_in_mujoco(folder):
    model = mujoco.MjModel.from_xml_path(str(folder / "out" / "simsat_cmg.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_step(model, data, nstep=200)
    assert not data.warning.number.any()
    assert data.time == pytest.approx(0.2)


def test_the_controller_of_the_readme_damps(folder):
    """Each rate dies as exp(-5 t / J), the angle is its integral; gravity on tens of micrometres adds 0.1 deg or so."""
    (block,) = [block for block in blocks("python") if "world.fly" in block]
    done = subprocess.run([sys.executable, "-c", block], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    numbers = [float(word) for word in re.findall(r"[-\d.]+(?:e[-+]\d+)?", done.stdout)]
    turned, rate = np.array(numbers[:3]), np.array(numbers[3:])
    inertia = np.array([6.0, 6.5, 9.0])
    expected = np.array([2, 0, 5]) * inertia / 5 * (1 - np.exp(-5 * 1.25 / inertia))
    np.testing.assert_allclose(turned, expected, rtol=0, atol=0.2)
    assert np.abs(rate).max() < 0.2


def test_the_python_block_solves_the_frame(folder):
    (block,) = [block for block in blocks("python") if "StarTracker" in block]
    done = subprocess.run([sys.executable, "-c", block], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    status, ra, dec, roll = done.stdout.replace("[", " ").replace("]", " ").split()
    assert status == "solved"
    # scenes/shefex2.yaml starts at (83, 2, 20) and turns by 0.06 deg before the middle of its first exposure.
    assert [float(ra), float(dec), float(roll)] == pytest.approx([83.0, 2.0, 20.0], abs=0.08)


def test_the_error_message_is_what_a_user_sees(tmp_path, monkeypatch):
    (block,) = blocks("text")
    bad = (ROOT / "scenes/afit_simsat.yaml").read_text(encoding="utf-8")
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes/afit_simsat.yaml").write_text(
        bad.replace("falloff: inverse_square", "falloff: cubic")
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as raised:
        load("scenes/afit_simsat.yaml")
    assert block.strip() == f"skysim: {raised.value}"


def test_every_file_that_the_readme_links_is_there():
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_every_name_in_the_table_of_changes_is_in_its_file():
    """`NAME` in [`file`](file): ten seconds to find it."""
    rows = re.findall(r"\| ((?:`\w+`(?:, )?)+) in (.*) \|", README)
    assert len(rows) >= 8
    for names, places in rows:
        text = "".join(
            (ROOT / path).read_text(encoding="utf-8") for path in re.findall(r"\]\(([^)]+)\)", places)
        )
        assert [name for name in re.findall(r"`(\w+)`", names) if name not in text] == []
