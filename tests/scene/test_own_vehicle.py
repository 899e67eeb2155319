"""A vehicle of the user's over a base scene: its file's mass properties, file names, and what it inherits."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from skysim.dynamics import multibody
from skysim.scene import loader, provenance
from skysim.scene.scene import Scene
from skysim.simulation.checks import check
from skysim.simulation.lab import build_lab

TABLE = """<mujoco><worldbody><body name="bus">
  <inertial pos="0.0005 0 0" mass="12" diaginertia="0.4 0.5 0.6"/>
  <geom type="box" size="0.2 0.2 0.02"/>
  <camera name="star_camera" pos="0 0 0.2" quat="0 1 0 0"/>
</body></worldbody></mujoco>"""
OWN = "schema: 1\nbase: afit_simsat\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with table.xml, and own.yaml over afit_simsat; commands run elsewhere."""
    lab = tmp_path / "lab"
    lab.mkdir()
    (lab / "table.xml").write_text(TABLE)
    (lab / "own.yaml").write_text(OWN + "vehicle: {model: table.xml}\n")
    (lab / "plain.yaml").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    return lab


def by_file(folder: Path) -> Scene:
    return loader.load(folder / "own.yaml")


def by_override(folder: Path) -> Scene:
    """The message of a missing model says: relative to the scene."""
    return loader.load(folder / "plain.yaml", {"vehicle.model": "table.xml"})


@pytest.mark.slow
@pytest.mark.parametrize("load", [by_file, by_override])
def test_another_model_brings_its_own_mass_properties(load, folder: Path) -> None:
    """afit_simsat's are 80 kg, 6 to 9 kg m2 and tens of micrometers; Steiner's term is 3e-6 kg m2."""
    scene = load(folder)
    mass = multibody.build(scene.vehicle).mass
    assert mass.mass_kg == pytest.approx(12)
    assert mass.inertia_kg_m2.diagonal() == pytest.approx([0.4, 0.5, 0.6], abs=4e-6)
    assert mass.center_m == pytest.approx([0.0005, 0, 0])
    assert scene.inherited == ("torque_limit",)
    found = check(build_lab(scene))
    assert [line for line in found.findings if "whose torque_limit the vehicle keeps" in line]
    (said,) = (one.lines for one in found.facts if one.name == "vehicle")
    assert said == [
        "12 kg (table.xml), inertia 0.4, 0.5, 0.6 kg m² (table.xml), center of mass 0.5, 0, 0 mm (table.xml)"
    ]


def test_own_values_of_the_scene_win(folder: Path) -> None:
    path = folder / "own.yaml"
    keys = {"vehicle.mass": "11 kg", "vehicle.torque_limit": "0.1 N m"}
    scene = loader.load(path, keys)
    assert (scene.vehicle.mass_kg, scene.vehicle.center_of_mass_m) == (11, None)
    assert scene.inherited == ()
    # A scene over it inherits from the same model.
    above = folder / "above.yaml"
    above.write_text(
        'schema: 1\nbase: own.yaml\nvehicle: {mass: "11 kg", torque_limit: "1 N m"}\n'
    )
    assert loader.load(above).inherited == ()
    assert loader.load("afit_simsat_ideal").vehicle.mass_kg == 80


@pytest.mark.parametrize("name", loader.list_scenes())
def test_no_shipped_scene_inherits_from_another_vehicle(name: str) -> None:
    assert loader.load(name).inherited == ()


def test_the_origins_name_the_file_of_the_override(folder: Path) -> None:
    found = provenance.effective(folder / "plain.yaml", {"vehicle.model": "table.xml"})
    entries = {".".join(one.path): one for one in found}
    assert entries["vehicle.mass"].value is None
    assert entries["vehicle.mass"].origin == provenance.DEFAULT
    assert Path(entries["vehicle.model"].value) == folder.resolve() / "table.xml"


@pytest.mark.parametrize("key", [key.replace("*", "0") for key in loader.FILE_KEYS])
def test_every_file_of_an_override_may_be_beside_the_scene(key: str, folder: Path) -> None:
    """One law for all keys that name a file: where the command runs, else beside the scene."""
    beside = folder.resolve() / "table.xml"
    scene = folder / "plain.yaml"
    found = loader.resolve_overrides(scene, {key: "table.xml"})
    assert json.loads(found[key]) == str(beside)
    # Within the value of a section.
    section, _, last = key.rpartition(".")
    found = loader.resolve_overrides(scene, {section: json.dumps({last: "table.xml"})})
    assert json.loads(found[key]) == str(beside)
    (here := Path("table.xml")).write_text(TABLE)
    found = loader.resolve_overrides(scene, {key: "table.xml"})
    assert found[key] in ("table.xml", json.dumps(str(here.resolve())))
