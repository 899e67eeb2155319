"""Studies made in Python: mapping, file and overrides give the same trials; functions are kept by their code."""

from __future__ import annotations

import importlib.util
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import skysim
from skysim.core.errors import InputError
from skysim.experiments.study import own_code, study_file
from skysim.experiments.study.execution import store
from skysim.scene import loader
from tests.helpers.study_stores import contents

STUDY: dict[str, Any] = {
    "title": "Strays",
    "scene": "shefex2",
    "seed": 1,
    "set": {"light.limit_mag": 5.0},
    "trial": {"kind": "centroids", "lights": 15},
    "factors": {"strays": {"key": "trial.false_lights", "values": [0, 9]}},
    "replicates": 3,
    "responses": ["identified"],
}
FRAMES = STUDY | {"trial": {"kind": "frames"}, "replicates": 1, "responses": ["refused"]}
RATES = {"rate": {"key": "trial.rate_deg_s", "values": [0, 2]}}


def blind(image: np.ndarray) -> None:
    return None


def skewed(image: np.ndarray) -> list[float]:
    return [0.0, 0.0, 0.0, 1.0]


def trials(result: Any) -> str:
    return contents(result.path)


@pytest.mark.slow
def test_mapping_file_overrides_and_scene_give_the_same_trials(tmp_path: Path) -> None:
    """Row for row, to the last bit."""
    file = tmp_path / "strays.yaml"
    file.write_text(yaml.safe_dump({"schema": 1} | STUDY))
    other = {"title": "other", "replicates": 1, "trial": {"kind": "centroids", "lights": 3}}
    scene = {key: STUDY[key] for key in STUDY if key not in ("scene", "seed", "title")}
    ways: dict[str, Callable[[Path], Any]] = {
        "file": lambda out: skysim.run_study(file, out=out, workers=1),
        "mapping": lambda out: skysim.run_study(STUDY, out=out, workers=1),
        "overrides": lambda out: skysim.run_study(
            STUDY | other,
            {"replicates": 3, "trial": {"lights": 15}},
            out=out,
            workers=1,
        ),
        "dotted": lambda out: skysim.run_study(
            STUDY | other, {"replicates": 3, "trial.lights": 15}, out=out, workers=1
        ),
        "scene": lambda out: skysim.run_study(
            skysim.load_scene("shefex2"), scene, seed=1, out=out, workers=1
        ),
        "keys": lambda out: skysim.run_study(
            {"base": "shefex2"}, seed=1, out=out, workers=1, **scene
        ),
    }
    found = {name: trials(way(tmp_path / name)) for name, way in ways.items()}
    assert {name for name, rows in found.items() if rows != found["file"]} == set()


@pytest.mark.parametrize(
    ("nested", "dotted"),
    [
        ({"exposure": {"frames": 3, "time": "20 ms"}}, {"exposure.frames": 3, "exposure.time": "20 ms"}),
        ({"camera": {"detector": {"gain_e_dn": 2}}}, {"camera.detector.gain_e_dn": 2}),
        ({"camera": {"detector.gain_e_dn": 2}}, {"camera.detector.gain_e_dn": 2}),
        ({"light": {"kind": "stars", "limit_mag": 5}}, {"light.limit_mag": 5}),
        ({"tracker": {"identifier": "pyramid"}}, {"tracker.identifier": "pyramid"}),
        ({"motion": {"rate_deg_s": "[0, 0.5, 0]"}}, {"motion.rate_deg_s": [0, 0.5, 0]}),
    ],
)  # fmt: skip
def test_nested_overrides_are_dotted_ones(
    nested: dict[str, Any], dotted: dict[str, Any]
) -> None:
    """They change the keys in them, and leave the others of the section as they are."""
    changed = skysim.load_scene("shefex2", nested)
    assert changed == skysim.load_scene("shefex2", dotted)
    assert changed != skysim.load_scene("shefex2")
    assert changed == skysim.load_scene(
        {"base": "shefex2", **dict(split(dotted))}
    ).model_copy(update={"name": "shefex2"})


def split(dotted: dict[str, Any]) -> list[tuple[str, Any]]:
    """Dotted keys as the tree of a file."""
    tree: dict[str, Any] = {}
    for key, value in dotted.items():
        *parents, last = key.split(".")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[last] = value
    return list(tree.items())


def test_a_section_of_another_kind_replaces_and_a_contradiction_is_refused() -> None:
    ring = {"kind": "points", "file": "x"}
    with pytest.raises(InputError, match=r"^light\.layout"):
        skysim.load_scene("afit_simsat", {"light": {"layout": ring}})
    with pytest.raises(InputError) as refusal:
        skysim.load_scene("shefex2", {"exposure.frames": 3, "exposure": {"frames": 4}})
    assert "exposure.frames: given twice, as 3 and as 4" in str(refusal.value)
    same = skysim.load_scene("shefex2", {"exposure.frames": 3, "exposure": {"frames": 3}})
    assert same.exposure.frames == 3


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"base": "nowhere"}, "base: nowhere: no such scene"),
        (
            {"base": "shefex2", "camera": {"f_number": -1}},
            "camera.f_number: -1 is not allowed",
        ),
        ({"base": "shefex2", "camra": {}}, "camra: unknown key; did you mean camera?"),
        ({"base": "shefex2", "orbit": {"file": "no.tle"}}, "orbit"),
        ({"base": "shefex2", "schema": 2}, "schema: 2 is not allowed"),
    ],
)
def test_an_error_of_a_mapping_says_where_its_files_are(
    keys: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as refusal:
        skysim.load_scene(keys)
    assert str(refusal.value).startswith(message)
    assert str(refusal.value).endswith(f"(mapping, files in {tmp_path})")


def test_a_mapping_s_files_are_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.yaml").write_text("schema: 1\nbase: shefex2\ntitle: Mine\n")
    (tmp_path / "glass.csv").write_text("wavelength_nm,transmission\n400,0.9\n900,0.9\n")
    monkeypatch.chdir(tmp_path)
    scene = skysim.load_scene({"base": "mine.yaml", "camera": {"transmission": "glass.csv"}})
    assert (scene.title, scene.camera.transmission) == ("Mine", str(tmp_path / "glass.csv"))


def test_a_scene_that_was_changed_after_loading_is_refused() -> None:
    scene = skysim.load_scene("shefex2", {"exposure": {"frames": 3}})
    again = loader.load(loader.keys_of(scene)).model_copy(update={"name": scene.name})
    assert again == scene
    with pytest.raises(InputError, match=r"not as skysim\.load_scene returned it"):
        loader.keys_of(scene.model_copy(update={"seed": 99}))


# --- functions ----------------------------------------------------------------------------------------------

SOURCE = """
GAIN = 2.0
def helper(image):
    return GAIN * image.sum()
"""
PILOT = """
from itertools import count
from helper_of_a_user import helper
def solve(image):
    return helper(image), count(), float(1)
"""


def load_module(folder: Path, name: str, text: str) -> types.ModuleType:
    """Import a module of the user's from a file."""
    path = folder / f"{name}.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[name] = made
    spec.loader.exec_module(made)
    return made


def test_the_digest_of_a_function_follows_the_user_s_modules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own module, and one that it calls."""
    monkeypatch.setattr(sys, "modules", dict(sys.modules))
    load_module(tmp_path, "helper_of_a_user", SOURCE)
    pilot = load_module(tmp_path, "pilot_of_a_user", PILOT)
    first = own_code.digest_of(pilot.solve)
    assert own_code.digest_of(pilot.solve) == first
    for name, text in (("helper_of_a_user", SOURCE), ("pilot_of_a_user", PILOT)):
        (tmp_path / f"{name}.py").write_text(text + "# changed")
        assert own_code.digest_of(pilot.solve) != first
        (tmp_path / f"{name}.py").write_text(text)
    assert own_code.digest_of(pilot.solve) == first
    # A value that the helper uses, and one that nothing uses.
    helper = sys.modules["helper_of_a_user"]
    helper.other = 1
    assert own_code.digest_of(pilot.solve) == first
    helper.GAIN = 2.5
    assert own_code.digest_of(pilot.solve) != first


@pytest.mark.slow
def test_the_digest_has_the_values_of_closures_and_objects() -> None:
    def with_gain(gain: Any) -> Callable[[Any], Any]:
        return lambda image: gain

    class Held:
        def __init__(self, gain: float) -> None:
            self.gain = gain

        def __call__(self, image: Any) -> Any:
            return self.gain

    class Slotted:
        __slots__ = ("gain",)

        def __init__(self, gain: float) -> None:
            self.gain = gain

    def with_default(gain: float) -> Callable[..., Any]:
        def law(image: Any, factor: float = gain) -> Any:
            return factor

        return law

    values = (1.0, 2.0, np.arange(3000), np.append(np.arange(2999), 0))
    parts: list[Any] = [*map(with_gain, values), with_default(1.0), with_default(2.0)]
    parts += [Slotted(1.0), Slotted(2.0), Held(1.0), Held(2.0)]
    digests = [own_code.digest_of(part) for part in parts]
    assert len(set(digests)) == len(parts)
    assert own_code.digest_of(with_gain(2.0)) == digests[1]
    assert own_code.digest_of(Held(2.0)) == digests[-1]


def test_what_may_have_changed_unseen_is_not_continued() -> None:
    """A function of a session without a file, and a value that does not tell what it is."""
    session: dict[str, Any] = {"__name__": "session_without_a_file"}
    exec("def mine(image):\n    return None", session)

    def opaque(image: Any) -> Any:
        return holder

    holder = object()
    for given in (session["mine"], opaque):
        assert own_code.digest_of(given) != own_code.digest_of(given)


@pytest.mark.slow
def test_own_trackers_are_levels_and_a_changed_one_is_not_mixed(tmp_path: Path) -> None:
    def run(**parts: Any) -> Any:
        return skysim.run_study(FRAMES, {"factors": RATES}, out=tmp_path, workers=1, **parts)

    result = run(tracker={"blind": blind, "skewed": skewed})
    table = result.table()
    assert list(table["tracker"]) == ["blind", "skewed"] * 2
    assert list(table["refused"]) == [1, 0] * 2
    with store.open_store(result.path) as kept:
        assert own_code.digest_of(blind) in kept.meta("functions")
        assert len({row[2] for row in kept.scenes()}) == 2
    # Continued with the same functions; refused with another one.
    assert run(tracker={"blind": blind, "skewed": skewed}).failed == 0
    with pytest.raises(
        InputError, match=r"blind: code .* then, .* now; allowed: another store"
    ):
        run(tracker={"blind": skewed, "skewed": skewed})
    # The file beside the store is the study, but for the functions.
    plan = study_file.load(tmp_path / f"{tmp_path.name}.yaml")
    assert plan.digest == result.plan.digest
    with pytest.raises(InputError, match="unknown tracker"):
        study_file.load(tmp_path / f"{tmp_path.name}.yaml", programs={})


@pytest.mark.slow
def test_a_function_in_a_mapping_is_that_of_the_argument(tmp_path: Path) -> None:
    who = {"who": {"key": "tracker.name", "values": [blind, skewed]}}
    levels = skysim.run_study(FRAMES | {"factors": who}, out=tmp_path / "a", workers=2)
    assert list(levels.table()["refused"]) == [1, 0]
    one = skysim.run_study(
        FRAMES, {"factors": RATES}, tracker=blind, out=tmp_path / "b", workers=1
    )
    assert list(one.table()["refused"]) == [1, 1]


@pytest.mark.slow
def test_own_controllers_and_profiles_are_levels(tmp_path: Path) -> None:
    """Without torque the vehicle keeps its rate of zero; a profile is followed exactly where nothing controls it."""

    def idle(setup: Any) -> Any:
        return lambda now: np.zeros(3)

    def run(name: str, **parts: Any) -> Any:
        study = {
            "title": "t",
            "scene": {"base": "afit_simsat", "exposure": {"frames": 1, "first": "1 s"}},
            "seed": 2,
            "trial": {"kind": "flight"},
            "responses": ["pointing_arcsec_rms"],
        }
        return skysim.run_study(study, out=tmp_path / name, workers=1, **parts)

    table = run("laws", controller={"pid": "pid", "idle": idle}).table()
    assert table["pointing_arcsec_rms"][1] > 3 * table["pointing_arcsec_rms"][0]
    t_s = np.arange(0.0, 4.0, 0.1)
    still = {"t_s": t_s, "roll_deg": 0 * t_s, "pitch_deg": 0 * t_s, "yaw_deg": 0 * t_s}
    turn = still | {"yaw_deg": 3 * t_s**2}
    profiles = run("profiles", profile={"still": still, "turn": turn}).trials()
    assert len(set(profiles["scene"])) == 2
    assert list(profiles["status"]) != []


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"tracker": 3}, "tracker: int; allowed: a name, a function of an image"),
        ({"tracker": {"a": 3}}, "tracker: int; allowed"),
        ({"controller": [3]}, "controller: int; allowed: a name, or a callable"),
        ({"profile": 3}, "profile: int; allowed: a file, or a table"),
        ({"tracker": {"own": blind}}, "own: name already in use"),
        ({"tracker": [blind, blind]}, "tracker: two have the same name"),
        (
            {"study": FRAMES | {"factors": RATES}, "tracker": lambda image: None, "workers": 2},
            "workers: 2 processes cannot take lambda: ",
        ),
        ({"tracker": blind}, "tracker.name: blind needs frames"),
        ({"study": 3}, "study: 3; allowed: a name, a path, a mapping of keys, a Scene"),
        ({"trail": {}}, "trail: unknown key; did you mean trial?"),
        ({"replicates": {1}}, "replicates: {1}; allowed: text, numbers"),
    ],
)  # fmt: skip
def test_wrong_parts_of_a_study_are_refused_in_one_line(
    parts: dict[str, Any], message: str, tmp_path: Path
) -> None:
    study = parts.pop("study", STUDY)
    with pytest.raises(InputError) as refusal:
        skysim.run_study(study, out=tmp_path, **parts)
    assert message in str(refusal.value)


def test_a_function_of_a_session_cannot_be_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes import the file of a script; a notebook or standard input has none."""
    session = types.ModuleType("__main__")
    exec("def mine(image):\n    return None\n", vars(session))
    monkeypatch.setitem(sys.modules, "__main__", session)
    assert "without a file" in own_code.unsendable({"mine": vars(session)["mine"]})
    vars(session)["__file__"] = __file__
    assert own_code.unsendable({"mine": vars(session)["mine"], "other": "python x.py"}) == ""
