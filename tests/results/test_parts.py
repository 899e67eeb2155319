"""The list of parts: quantities against geometry, effects of drive, code and layout, and price tables."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.results.files.parts import (
    COLUMNS,
    UNITS,
    DomeDesign,
    PartsList,
    find_prices,
    parts_list,
    read_prices,
    to_csv,
)
from skysim.scene import loader
from skysim.scene.sections.layouts import StringConfig
from skysim.sources.dome.layouts.string import wind

ASSUMED = read_prices(find_prices("assumed"))
SPHERE = {
    "light.surface": "{kind: sphere, apex: 1.2 m, radius: 1.2 m}",
    "light.layout": "{kind: fibonacci, count: 300, cap_deg: 40}",
    "light.led.drive": "{kind: direct}",
}
TAPE = "{kind: string, pitch: 33.3 mm, spacing: 100 mm, cap_deg: 40, winding: %s}"


def listed(**settings: str) -> PartsList:
    keys = {key.replace("__", "."): value for key, value in settings.items()}
    return parts_list(loader.load("afit_simsat", SPHERE | keys), ASSUMED)


def bought(**settings: str) -> dict[str, float]:
    return {line.part: line.quantity for line in listed(**settings).lines}


def test_the_parts_of_a_sphere_of_single_leds_are_counted() -> None:
    """Wire: the arcs R (40 deg - t) from each LED to the rim, t uniform in cos t."""
    found = bought()
    radius_m = 1.2
    rim_rad = math.radians(40)
    assert found["led"] == found["mounting_led"] == found["resistor"] == 300
    assert found["shell"] == pytest.approx(
        2 * math.pi * radius_m**2 * (1 - math.cos(rim_rad)), rel=1e-9
    )
    cosine = 1 - (np.arange(300) + 0.5) / 300 * (1 - math.cos(rim_rad))
    assert found["wire"] == pytest.approx(
        radius_m * np.sum(rim_rad - np.arccos(cosine)), rel=1e-4
    )
    assert found["power_supply"] == 1
    assert "driver" not in found
    assert "trigger" not in found


def test_individually_driven_and_coded_leds_need_driver_channels() -> None:
    pwm = bought(light__led__drive="{kind: pwm, filter: {time_constant: 20 ms}}")
    # 300 / 16, rounded up.
    assert (pwm["driver"], pwm["microcontroller"], pwm["filter"]) == (19, 1, 300)
    assert "resistor" not in pwm
    coded = bought(light__led__code="{kind: hamming}", tracker__decoder="{}")
    assert (coded["driver"], coded["trigger"]) == (19, 1)
    free = bought(light__led__code="{kind: cyclic, bit_time: 20 ms}", tracker__decoder="{}")
    assert free["driver"] == 19
    assert "trigger" not in free
    arduino = bought(light__led__drive="{kind: sequential, controller: 9}")
    assert (arduino["sequencer"], arduino["resistor"]) == (34, 300)  # 300 / 9, rounded up


@pytest.mark.parametrize("winding", ["latitude", "spiral", "meridian"])
def test_the_length_of_tape_is_the_sum_of_its_pitches(winding: str) -> None:
    scene = loader.load("afit_simsat", SPHERE | {"light.layout": TAPE % winding})
    layout = DomeDesign(scene).light.layout
    assert isinstance(layout, StringConfig)
    leds = len(wind(layout, DomeDesign(scene).surface).place_m)
    found = bought(light__layout=TAPE % winding)
    assert found["tape"] == found["mounting_tape"] == pytest.approx(0.0333 * leds)
    assert "led" not in found
    if winding == "spiral":  # it ends at the rim
        assert found["wire"] < 0.1
    # Half of them covered is as much tape; a spiral covers the area, one turn every 100 mm.
    half = TAPE % winding
    assert (
        bought(light__layout=half.replace("cap_deg", "lit_fraction: 0.5, cap_deg"))["tape"]
        == found["tape"]
    )
    if winding != "meridian":
        assert found["tape"] == pytest.approx(found["shell"] / 0.1, rel=0.1)


def test_tape_with_unequal_leds_needs_drivers() -> None:
    for key, value in {
        "light__led__code": "{kind: hamming}",
        "light__led__drive": "{kind: pwm}",
        "light__layout": TAPE.replace("cap_deg", "levels: [1, 0.5], cap_deg") % "spiral",
    }.items():
        more = {"tracker__decoder": "{}"} if key.endswith("code") else {}
        found = bought(**({"light__layout": TAPE % "spiral", key: value} | more))
        assert found["tape_controller"] == 1
        assert "tape_addressable" in found
        assert "tape" not in found


def test_the_number_of_boards_follows_from_leds_per_board() -> None:
    layout = "{kind: patch_boards, cap_deg: 27, spacing: 2.2 in, pitch: 8 mm, lit: [4, 4]}"
    found = bought(light__layout=layout)
    assert found["led"] == 4 * found["board"]
    assert found["mounting_board"] == found["board"]
    own = bought(light__layout=layout, light__led__drive="{kind: sequential}")
    assert own["sequencer"] == own["board"]


def test_the_cheapest_sufficient_survey_is_chosen() -> None:
    for sigma, part in {
        "1 mm": "survey_pattern",
        "0.9 mm": "survey_total_station",
        "0.1 mm": "survey_arm",
    }.items():
        assert bought(tracker__survey__led_sigma=sigma)[part] == 300
    assert not any("survey" in part for part in bought(tracker__survey__led_sigma="0 mm"))
    with pytest.raises(
        InputError, match=r"no survey reaches 0.01 mm; allowed: a line survey_NAME"
    ):
        listed(tracker__survey__led_sigma="0.01 mm")
    station = "{kind: total_station, position: [0 m, 0 m, -0.4 m], angle_sigma_arcsec: 2, distance_sigma: 1 mm}"
    assert "survey_total_station" in bought(
        tracker__survey__instrument=station, tracker__survey__led_sigma="0.1 mm"
    )


def test_the_parts_table_sums_to_its_total() -> None:
    parts = listed()
    rows = [
        row
        for row in csv.reader(to_csv(parts, "mine").splitlines())
        if not row[0].startswith("#")
    ]
    assert tuple(rows[0]) == COLUMNS
    sums = [float(row[COLUMNS.index("sum")]) for row in rows[1:]]
    assert sum(sums[:-1]) == pytest.approx(sums[-1], abs=1e-9)
    assert sums[-1] == parts.total
    groups = parts.groups()
    assert sum(groups.values()) == pytest.approx(parts.total)
    for group in ("shell", "survey"):
        of_group = [line.sum for line in parts.lines if line.part.startswith(group)]
        assert groups[group] == pytest.approx(sum(of_group))
    for row in rows[1:-1]:
        quantity, price, fixed, total = (
            float(row[COLUMNS.index(key)]) for key in ("quantity", "price", "fixed", "sum")
        )
        assert total == pytest.approx(fixed + quantity * price, rel=5e-3)


def test_every_part_has_a_price_marked_as_assumed() -> None:
    text = find_prices("assumed").read_text()
    assert "all of them assumed" in text.splitlines()[0]
    assert {*UNITS} <= {*ASSUMED.parts}


def test_a_sky_scene_has_no_parts_list() -> None:
    with pytest.raises(InputError, match=r"light.kind: stars has no parts; allowed: dome"):
        parts_list(loader.load("shefex2"), ASSUMED)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a table of prices"),
        ("part,unit\nled,each", "not a table of prices"),
        ("part,unit,price,color\nled,each,1,red", "not a table of prices"),
        ("part,unit,price\nled,each", "line 2: 2 cells; allowed: 3"),
        ("part,unit,price\nlid,each,1", "line 2: unknown part 'lid'"),
        (
            "part,unit,price\ndrivers,each,1",
            "line 2: unknown part 'drivers'; did you mean driver[?]; allowed: shell, ",
        ),
        ("part,unit,price\ntape,ft,1", "line 2: unit of tape: 'ft'; allowed: m"),
        ("part,unit,price\nled,each,-1", "line 2: price: '-1'; allowed: a number from 0"),
        ("part,unit,price\nled,each,nan", "line 2: price: 'nan'"),
        ("part,unit,price\nled,each,", "line 2: price: ''"),
        (
            "part,unit,price,serves\nled,each,1,0.5",
            "line 2: serves: 0.5; allowed: a whole number",
        ),
        ("part,unit,price,sigma_mm\nled,each,1,1", "line 2: sigma_mm of led"),
        ("part,unit,price\nsurvey_eye,each,1", "line 2: sigma_mm of survey_eye: none"),
        ("part,unit,price\nled,each,1\nled,each,2", "line 3: led occurs twice"),
        ('part,unit,price\n"led,each,1', "line 2: .* is no line of CSV"),
    ],
)
def test_a_bad_price_table_is_refused_in_one_line(
    text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "prices.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_prices(path)
    assert len(str(error.value).splitlines()) == 1


def test_a_missing_price_or_file_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "prices.csv"
    path.write_text("# mine\npart,unit,price\nshell,m2,100\n")
    with pytest.raises(
        InputError, match=r"no price of led; allowed: a line that begins with it"
    ):
        parts_list(
            loader.load("afit_simsat", SPHERE | {"tracker.survey.led_sigma": "0 mm"}),
            read_prices(path),
        )
    with pytest.raises(
        InputError, match=r"none\.csv: cannot be read: No such file or directory$"
    ):
        read_prices(tmp_path / "none.csv")


def test_a_byte_order_mark_in_a_table_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes(b"\xef\xbb\xbf" + find_prices("assumed").read_bytes())
    # NaN differs from NaN.
    assert repr(read_prices(path).parts) == repr(read_prices(find_prices("assumed")).parts)
