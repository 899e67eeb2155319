"""Lists of LEDs as CSV: units, numbers, and what is refused with its line; skysim reads the same files alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from estimator import ImageError, LedMap
from skysim.sources.dome.layouts.listed import read_csv

PLACES_M = np.array([[0.1, 0.0, 1.0], [0.0, -0.2, 0.9], [-0.3, 0.1, 0.8]])


@pytest.mark.parametrize(
    ("head", "factor", "unit"),
    [
        ("x_m,y_m,z_m", 1.0, None),
        ("x_mm,y_mm,z_mm", 1e3, None),
        ("x_cm y_cm z_cm", 1e2, None),
        ("x_in,y_in,z_in", 1 / 0.0254, None),
        ("x,y,z", 1e3, "mm"),
        ("x,y,z", 1.0, "m"),
    ],
)
def test_places_are_read_in_their_unit(
    tmp_path: Path, head: str, factor: float, unit: str | None
) -> None:
    separator = "," if "," in head else " "
    rows = [separator.join(f"{one:.9f}" for one in row) for row in factor * PLACES_M]
    path = tmp_path / "leds.csv"
    path.write_text("\n".join(["# measured by hand", head, "", *rows]))
    leds = LedMap.from_csv(path, unit, sigma_m=1e-3)
    np.testing.assert_allclose(leds.position_m, PLACES_M, atol=1e-9)
    assert leds.id.tolist() == [0, 1, 2]
    assert leds.sigma_m == 1e-3
    assert leds.center_m.tolist() == [0, 0, 0]
    np.testing.assert_allclose(
        leds.semi_axes_m, np.linalg.norm(PLACES_M, axis=1).mean(), rtol=1e-9
    )
    if unit is None:
        assert read_csv(path).coordinates == pytest.approx(leds.position_m, abs=1e-12)


def test_numbers_and_further_columns_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "leds.csv"
    path.write_text("board,z_mm,id,x_mm,y_mm\nleft,1000,7,100,0\nright,900,3,0,-200\n")
    leds = LedMap.from_csv(path)
    assert leds.id.tolist() == [7, 3]
    np.testing.assert_allclose(leds.position_m, PLACES_M[:2], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "x_mm,y_mm,z_mm\n1,2,3\n4,5,6\n1,2,3.05\n",
            "line 4: the LED of line 2; allowed: each once",
        ),
        (
            "id,x_m,y_m,z_m\n1,0,0,1\n\n1,0,1,1\n",
            "line 4: id 1; allowed: whole numbers from 0, each once",
        ),
        ("id,x_m,y_m,z_m\n1.5,0,0,1\n", "line 2: id 1.5; allowed: whole numbers"),
        (
            "x_m,y_m,z_m\n0,0,1\n0,one,1\n",
            "line 3: '0,one,1'; allowed: 3 columns, finite numbers",
        ),
        ("x_m,y_m,z_m\n0,0,1\n0,1\n", "line 3: '0,1'; allowed: 3 columns"),
        ("x_m,y_m,z_m\n0,0,nan\n", "line 2: '0,0,nan'; allowed: 3 columns, finite"),
        ("x,y,z\n0,0,1\n", "no list of LEDs; allowed: columns x_m, y_m, z_m, or x_mm"),
        ("x_m,y_m,z_m,x_mm,y_mm,z_mm\n0,0,1,0,0,1000\n", "no list of LEDs"),
        ("x_m,y_m,z_m\n", "no list of LEDs"),
    ],
)
def test_a_wrong_list_is_refused_with_its_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "leds.csv"
    path.write_text(text)
    with pytest.raises(ImageError) as refused:
        LedMap.from_csv(path)
    assert f"{path}: {says}" in str(refused.value)


def test_a_missing_file_and_an_unknown_unit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"cannot be read: .*; allowed: a list of LEDs"):
        LedMap.from_csv(tmp_path / "none.csv")
    with pytest.raises(ImageError, match=r"unit: 'ft' is unknown; allowed: cm, in, m, mm"):
        LedMap.from_csv(tmp_path / "none.csv", "ft")
