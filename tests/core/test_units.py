"""Quantities: the table of common units agrees with astropy to the bit."""

from __future__ import annotations

import subprocess
import sys

import pytest
from astropy import units
from hypothesis import given, settings
from hypothesis import strategies as st

from skysim.core.units import COMMON_UNITS, in_si

PAIRS = [(si, unit) for si, table in COMMON_UNITS.items() for unit in table]
INCH = units.def_unit("in", units.imperial.inch)


def by_astropy(text: str, si: str) -> float:
    with units.add_enabled_units([INCH, units.imperial]):
        return float(units.Quantity(text).to_value(si))


@settings(max_examples=20)
@pytest.mark.parametrize(("si", "unit"), PAIRS, ids=[unit for _, unit in PAIRS])
@given(st.floats(-1e9, 1e9) | st.integers(-(10**9), 10**9), st.sampled_from(["", " "]))
def test_a_common_unit_matches_astropy(si: str, unit: str, value: float, space: str) -> None:
    text = f"{value}{space}{unit}"
    assert in_si(text, si) == by_astropy(text, si)


@pytest.mark.parametrize(
    "text", ["1 ft 2", "1 parsec", "3 mm mm", "2 m(9)", "1e999 m", "0x10 m", "1_0 m", "nan m"]
)
def test_an_uncommon_unit_is_converted_by_astropy(text: str) -> None:
    try:
        expected = by_astropy(text, "m")
    except (TypeError, ValueError):
        with pytest.raises((TypeError, ValueError)):
            in_si(text, "m")
    else:
        assert in_si(text, "m") == pytest.approx(expected, rel=0, abs=0, nan_ok=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["shefex2", pytest.param("afit_simsat", marks=pytest.mark.slow)]
)
def test_a_scene_is_loaded_without_astropy(name: str) -> None:
    code = f"import sys; from skysim.scene import loader; loader.load({name!r}); print('astropy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
