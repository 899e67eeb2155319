"""What Python hands to skysim: refused in one line, or taken as it is meant."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import skysim
from skysim.core.paths import DATA
from skysim.core.yaml_reader import PATTERNS, override_texts
from skysim.experiments.study import study_file


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: skysim.simulate("x.yaml"), "scene: 'x.yaml'; allowed: a Scene"),
        (lambda: skysim.render(Path("x.yaml")), "x.yaml'); allowed: a Scene"),
        (lambda: skysim.render_at({}, None), "scene: {}; allowed: a Scene"),
        (lambda: skysim.build_lab(None), "scene: None; allowed: a Scene"),
        (lambda: skysim.open_flight("shefex2"), "scene: 'shefex2'; allowed: a Scene"),
        (lambda: skysim.load_scene("shefex2", ["a=1"]), "overrides: ['a=1']; allowed: values by"),
        (lambda: skysim.load_scene("shefex2", {3: 4}), "overrides: 3; allowed: dotted keys"),
        (lambda: skysim.load_scene("shefex2", {"seed": {1}}), "seed: {1}; allowed: text, num"),
        (lambda: skysim.Scene(schema=1), "title: missing"),
        (lambda: skysim.Scene(titel="x"), "titel: unknown key; did you mean title?"),
        (lambda: skysim.Scene(seed="x"), "seed: 'x' is not allowed; allowed: a valid integer"),
    ],
)  # fmt: skip
def test_wrong_input_from_python_is_refused_in_one_line(
    call: Callable[[], Any], message: str
) -> None:
    with pytest.raises(skysim.InputError) as refusal:
        call()
    assert message in str(refusal.value)


def test_numbers_of_numpy_are_those_of_python() -> None:
    values = {
        "exposure.frames": np.int64(3),
        "camera.f_number": np.float32(2),
        "motion.rate_deg_s": np.array([0, 0.5, 1]),
        "camera.detector.noise": np.bool_(False),
    }
    plain = {key: value.tolist() for key, value in values.items()}
    assert override_texts(values, {}) == override_texts(plain, {})


@pytest.mark.parametrize("schema", ["scene", "study"])
def test_every_pattern_of_the_schema_has_words(schema: str) -> None:
    """A message says what is allowed without a regular expression; quantities have their own messages."""
    text = (DATA / "schema" / f"{schema}.json").read_text(encoding="utf-8")
    found = set(re.findall(r'"pattern": ("(?:[^"\\]|\\.)*")', text))
    quantities = ("a-zA-Z", r"[.]?\d")
    plain = {json.loads(one) for one in found}
    assert {one for one in plain if not any(q in one for q in quantities)} <= set(PATTERNS)


def test_an_error_of_a_key_that_no_factor_sets_is_not_blamed_on_one(tmp_path: Path) -> None:
    """An unknown law was reported under factors.com_z, a key of the vehicle."""
    path = tmp_path / "study.yaml"
    path.write_text(
        "schema: 1\ntitle: t\nscene: simsat_slew\nseed: 4\ntrial: {kind: flight}\nreplicates: 2\n"
        "set: {motion.control: lqrr}\nresponses: [identified]\n"
        'factors: {com_z: {key: vehicle.center_of_mass.2, values: ["-50 um", "-90 um"]}}\n'
    )
    with pytest.raises(skysim.InputError, match=r"^motion.control.law: unknown law 'lqrr'"):
        study_file.load(path, programs={})
    path.write_text(path.read_text().replace('"-90 um"', "90").replace("lqrr", "pid"))
    with pytest.raises(
        skysim.InputError, match=r"^factors.com_z: 90: vehicle.center_of_mass"
    ):
        study_file.load(path, programs={})
