"""Every key takes its own kind of value only, and every number has a least and a greatest value."""

from __future__ import annotations

import datetime
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

import skysim
from skysim.core import units
from skysim.core.paths import DATA
from skysim.core.yaml_reader import parse_yaml
from skysim.experiments.study import study_file

ISO = "an ISO date, or date and time: 2012-06-21 03:00:00"
DOME = "afit_simsat"


def refusal(overrides: dict[str, Any], scene: str = DOME) -> str:
    """The message with which a scene of these keys is refused, without the place."""
    with pytest.raises(skysim.InputError) as error:
        skysim.load_scene(scene, overrides)
    assert "\n" not in str(error.value)
    return str(error.value).removesuffix(" (overrides)")


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        # Dates: 2012 was 1970-01-01 00:33:32.
        ("start_time", "2012", f"2012 is not a date; allowed: {ISO}"),
        ("start_time", "'2012'", f"'2012' is not a date; allowed: {ISO}"),
        ("start_time", "20120621", f"20120621 is not a date; allowed: {ISO}"),
        ("start_time", "1.5e9", f"1500000000.0 is not a date; allowed: {ISO}"),
        ("start_time", "true", f"True is not a date; allowed: {ISO}"),
        ("start_time", "''", f"'' is not a date; allowed: {ISO}"),
        ("start_time", "'2012-13-01'", f"'2012-13-01' is not a date; allowed: {ISO}"),
        ("start_time", "1850-01-01", "1850-01-01T00:00:00 is outside 1900 to 2100"),
        # Numbers: true was 1, and a text was its number.
        ("camera.f_number", "true", "True is not allowed; allowed: a valid number"),
        ("camera.f_number", "'2'", "'2' is not allowed; allowed: a valid number"),
        ("camera.f_number", ".nan", "nan is not allowed; allowed: a finite number"),
        ("camera.transmission", "true", "True is not allowed; allowed: a valid number"),
        ("camera.detector.quantum_efficiency", "true", "True is not allowed; allowed: a valid n"),
        ("light.led.scatter", "true", "True is not allowed; allowed: a valid number"),
        ("light.led.scatter", "'0.1'", "'0.1' is not allowed; allowed: a valid number"),
        ("light.led.scatter", {"tolerance": True}, "tolerance: True is not allowed; allowed: a v"),
        ("light.led.scatter", {"tolerance": "x"}, "tolerance: 'x' is not allowed; allowed: a v"),
        ("require", {"wrong": True}, "wrong: True is not allowed; allowed: a valid number"),
        ("seed", "true", "True is not allowed; allowed: a valid integer"),
        ("exposure.frames", "2.0", "2.0 is not allowed; allowed: a valid integer"),
        ("vehicle.torque_limit", "true", 'True has no unit; allowed: a torque such as "0.5 N m"'),
        # Flags: 1 and a quoted yes were true.
        ("light.occlusion", "1", "1 is not allowed; allowed: true or false"),
        ("light.occlusion", "'yes'", "'yes' is not allowed; allowed: true or false"),
        # Names and choices: an empty one was the default.
        ("tracker.detector", "''", "'' is not allowed; allowed: a text that is not empty"),
        ("tracker.solver", "''", "'' is not allowed; allowed: a text that is not empty"),
        ("tracker.catalog", "''", "'' is not allowed; allowed: a text that is not empty"),
        ("vehicle.model", "''", "'' is not allowed; allowed: a text that is not empty"),
        ("title", "''", "'' is not allowed; allowed: a text that is not empty"),
        # Sizes that no laboratory has.
        ("light.surface.apex", "1e300 mm", "'1e300 mm'; allowed: a length up to 10000 m"),
        ("vehicle.torque_limit", "1e300 N m", "'1e300 N m'; allowed: a torque up to 1e+06 N m"),
        ("exposure.first", "1e300 s", "'1e300 s'; allowed: a time up to 3e+09 s"),
        ("vehicle.mass", "nan kg", "nan is not allowed; allowed: a finite number"),
        ("camera.focus", "1e300 m", "'1e300 m'; allowed: a length up to 1e+12 m"),
        ("exposure.rate_hz", "1e300", "1e+300 is not allowed; allowed: less than or equal to"),
        ("seed", "1" + 30 * "0", "1000000000000000000000000000000 is not allowed; allowed: less"),
        # A kind that is no text was a TypeError.
        ("lights", [{"kind": {"a": 1}}], "0.kind: {'a': 1} is not allowed; allowed: text"),
        ("lights", [{"kind": 3}], "0.kind: 3 is not allowed; allowed: text"),
    ],
)  # fmt: skip
def test_a_value_of_another_kind_is_refused_in_one_line(
    key: str, value: Any, says: str
) -> None:
    message = refusal({key: value})
    assert message.startswith(key)
    assert says in message


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("2012-06-21", datetime.datetime(2012, 6, 21)),
        ("2012-06-21T03:00", datetime.datetime(2012, 6, 21, 3)),
        ("2012-06-21 03:00:00", datetime.datetime(2012, 6, 21, 3)),
        ("'2012-06-21T03:00:00+02:00'", datetime.datetime(2012, 6, 21, 1)),
        ("2012-06-21T03:00:00Z", datetime.datetime(2012, 6, 21, 3)),
    ],
)
def test_a_date_takes_iso_in_yaml_or_as_text(text: str, time: datetime.datetime) -> None:
    assert skysim.load_scene(DOME, {"start_time": text}).start_time == time


@pytest.mark.parametrize(
    "text", ["1e-4", "1E-4", "+1e-4", ".1e-3", "1.e-4", "0.001e-1", "1.0e-4"]
)
def test_a_number_with_an_exponent_needs_no_point_and_no_sign(text: str) -> None:
    """YAML 1.1 takes 1e-4 and 1.5e9 for texts; YAML 1.2, JSON and Python do not."""
    assert parse_yaml("1.5e9")[1] == 1.5e9
    assert parse_yaml(text)[1] == pytest.approx(1e-4, rel=1e-15)


def test_a_name_that_only_begins_like_a_number_remains_a_text() -> None:
    assert parse_yaml("[1e4x, e4, 1e, 0x1e4]")[1] == ["1e4x", "e4", "1e", 0x1E4]


def numbers(node: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every number of a JSON schema that is not one of a list of values, with its path."""
    if isinstance(node, list):
        node = dict(enumerate(node))
    if isinstance(node, dict):
        if node.get("type") in ("number", "integer") and not {"const", "enum"} & {*node}:
            yield path, node
        for key, inner in node.items():
            yield from numbers(inner, f"{path}/{key}")


@pytest.mark.parametrize("kind", ["scene", "study"])
def test_every_number_of_the_schema_has_a_least_and_a_greatest_value(kind: str) -> None:
    schema = json.loads((DATA / "schema" / f"{kind}.json").read_text(encoding="utf-8"))
    found = dict(numbers(schema))
    assert len(found) > 20
    ends = ({"minimum", "exclusiveMinimum"}, {"maximum", "exclusiveMaximum"})
    assert [
        path for path, node in found.items() if not all(end & {*node} for end in ends)
    ] == []


QUANTITIES = {
    name: re.findall(r'"([^"]+)"', found[0])
    for name, kind in vars(units).items()
    if (found := re.findall(r"a [\w ]+ such as (.*)", str(getattr(kind, "__metadata__", ""))))
}


def test_the_quantities_are_found() -> None:
    assert {"Length", "Time", "Mass", "Torque", "Imbalance", "Duration"} <= {*QUANTITIES}


@pytest.mark.parametrize("name", QUANTITIES)
def test_every_quantity_has_a_greatest_size(name: str) -> None:
    kind = TypeAdapter(getattr(units, name))
    for example in QUANTITIES[name]:
        unit = example.partition(" ")[2]
        assert kind.validate_python(example) > 0
        for number in ("1e300", "-1e300"):
            with pytest.raises(ValidationError, match="up to"):
                kind.validate_python(f"{number} {unit}")


LISTED = {"kind": "listed", "cap_deg": 60}


@pytest.mark.parametrize(
    ("places", "says"),
    [
        (
            {"positions": [["0 m", "0 m", "1.2192 m"], ["0.2 um", "0 m", "1.2192 m"]]},
            "light.layout.positions.1: at the place of light.layout.positions.0; allowed: each LED once",
        ),
        (
            {"directions_deg": [[10, 20], [50, 5], [10, 20]]},
            "light.layout.directions_deg.2: at the place of light.layout.directions_deg.0; allowed: each LED once",
        ),
    ],
)
def test_two_leds_in_one_place_are_refused(places: dict[str, Any], says: str) -> None:
    scene = skysim.load_scene(DOME, {"light.layout": LISTED | places})
    with pytest.raises(skysim.InputError, match=re.escape(says)):
        skysim.build_lab(scene)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ("seed: true", "seed: True is not allowed; allowed: a valid integer"),
        ("replicates: '2'", "replicates: '2' is not allowed; allowed: a valid integer"),
        ("paired: 1", "paired: 1 is not allowed; allowed: true or false"),
        ("responses: ['']", "responses.0: '' is not allowed; allowed: a text that is not empty"),
        ("budget: {time: 1e300 s}", "budget.time: '1e300 s'; allowed: a time up to 3e+09 s"),
        ("budget: {trials: true}", "budget.trials: True is not allowed; allowed: a valid int"),
    ],
)  # fmt: skip
def test_a_study_is_as_strict(tmp_path: Path, keys: str, says: str) -> None:
    tree = {
        "schema": "1",
        "title": "t",
        "scene": "shefex2",
        "seed": "4",
        "trial": "{kind: frames}",
        "responses": "[identified]",
    }
    key, _, value = keys.partition(": ")
    path = tmp_path / "study.yaml"
    path.write_text(
        "".join(f"{name}: {one}\n" for name, one in (tree | {key: value}).items())
    )
    with pytest.raises(skysim.InputError, match=re.escape(says)):
        study_file.load(path, programs={})
