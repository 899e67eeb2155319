"""Constants are those of astropy, ERFA and SciPy, and each is defined once in skysim and once in the estimator."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import erfa
import numpy as np
import pytest
import scipy
from astropy import constants as astro
from astropy import units as u
from scipy.stats import norm

from estimator.core import constants as believed
from skysim.core import constants, time

ROOT = Path(__file__).resolve().parents[2]
OWN_FILES = {
    "skysim": ("core/constants.py", "core/time.py"),
    "estimator": ("core/constants.py",),
}
ROUNDED = 1e-4  # relative error of a number of four digits

# What others say of each constant, and how many digits ours has.
ORACLES = {
    "SPEED_OF_LIGHT_M_S": (astro.c.si.value, 0),
    "PLANCK_J_S": (astro.h.si.value, 0),
    "BOLTZMANN_J_K": (astro.k_B.si.value, 0),
    "LUMINOUS_EFFICACY_LM_W": (scipy.constants.value("luminous efficacy"), 0),
    "STANDARD_GRAVITY_M_S2": (astro.g0.si.value, 0),
    "ZERO_CELSIUS_K": (scipy.constants.zero_Celsius, 0),
    "STANDARD_PRESSURE_HPA": (astro.atm.to_value("hPa"), 0),
    "STANDARD_TEMPERATURE_K": (
        (15 * u.deg_C).to_value("K", equivalencies=u.temperature()),
        0,
    ),
    "ARCSEC_RAD": (erfa.DAS2R, 0),
    "MAS_RAD": (erfa.DMAS2R, 1e-15),
    "ARCSEC_DEG": (u.arcsec.to("deg"), 1e-15),
    "ARCSEC2_SR": ((u.arcsec**2).to("sr"), 1e-15),
    "GOLDEN_ANGLE_RAD": (2 * np.pi * (1 - 1 / scipy.constants.golden), 1e-15),
    "INCH_M": (scipy.constants.inch, 0),
    "PPM": (u.percent.to("") / 1e4, 1e-15),
    "HOUR_S": (scipy.constants.hour, 0),
    "DAY_S": (erfa.DAYSEC, 0),
    "JULIAN_YEAR_DAY": (erfa.DJY, 0),
    "JULIAN_CENTURY_DAY": (erfa.DJC, 0),
    "RPM_RAD_S": (2 * np.pi / scipy.constants.minute, 1e-15),
    "DEG_H_RAD_S": ((u.deg / u.hour).to("rad/s"), 1e-15),
    "EARTH_RADIUS_M": (erfa.eform(1)[0], 0),
    "EARTH_FLATTENING": (erfa.eform(1)[1], 0),
    "EARTH_MU_M3_S2": (
        astro.GM_earth.si.value,
        2e-7,
    ),  # the nominal 3.986004e14 of IAU 2015 B3
    "EARTH_J2": (1.0826e-3, ROUNDED),
    "EARTH_RATE_RAD_S": (2 * np.pi * 1.00273781191135448 / erfa.DAYSEC, 3e-8),  # IERS
    "AU_M": (astro.au.si.value, 0),
    "AU_KM": (astro.au.to_value("km"), 1e-15),
    "SPEED_OF_LIGHT_KM_S": (astro.c.to_value("km/s"), 1e-15),
    "SPEED_OF_LIGHT_AU_DAY": (astro.c.to_value("AU/d"), 1e-15),
    "SUN_DEFLECTION_RAD": (2 * (astro.GM_sun / astro.c**2 / astro.au).to_value(""), 3e-4),
    "FWHM_PER_SIGMA": (2 * np.sqrt(2 * np.log(2)), 1e-15),
    "MAD_PER_SIGMA": (norm.ppf(0.75), ROUNDED),
    "SIGMA_PER_MAD": (1 / norm.ppf(0.75), ROUNDED),
}
TIMES = {"J2000", "J2000_JD", "TT_MINUS_UTC_S"}  # of tests/core/test_time.py
# Other spellings of the same numbers, and of some that the test would take for round ones.
NOTORIOUS = (
    206264.80624709636,
    206264.8,
    206265.0,
    4.848e-6,
    57.29577951308232,
    69.184,
    64.184,
    32.184,
    86400.0,
    0.0254,
)


def test_each_constant_matches_other_libraries() -> None:
    for module in (constants, believed):
        named = numbers_of(module)
        assert set(named) - TIMES <= set(ORACLES) | {"SUN_V_MAG"}
        for name in set(named) & set(ORACLES):
            value, error = ORACLES[name]
            assert named[name] == pytest.approx(value, rel=error, abs=0), name
    assert set(ORACLES) <= set(numbers_of(constants)) | set(numbers_of(believed))


def test_the_suns_magnitude_follows_from_its_luminosity() -> None:
    # Willmer 2018, ApJS 236, 47: V = -26.76 in the Vega system, and spectra differ by 0.02 mag.
    assert pytest.approx(-26.76, abs=0.025) == constants.SUN_V_MAG


@pytest.mark.slow
@pytest.mark.parametrize("package", OWN_FILES)
def test_no_constant_is_defined_twice(package: str) -> None:
    own = [ROOT / package / name for name in OWN_FILES[package]]
    others = [path for path in sorted((ROOT / package).rglob("*.py")) if path not in own]
    known = (
        numbers_of(constants) | numbers_of(time)
        if package == "skysim"
        else numbers_of(believed)
    )
    assert len(others) > 80
    assert [again for path in others for again in defined_again(path, known)] == []


@pytest.mark.parametrize(
    "text",
    [
        "DAY_S = 1",
        "X = 4.84813681109536e-6",
        "ARCSEC = math.pi / 180 / 3600",
        "ARCSEC = np.pi / 648_000",
        "def f(x):\n    return math.radians(1 / 3600) * x",
        "ARCSEC = erfa.DAS2R",
        "def f(x):\n    return x * 206265",
        "EPOCH = 2451545.0, 0.0",
        "def f(x):\n    return x + 69.184 / 86400",
        "HC = 6.62607015e-34 * 299792458.0",
        "KM = 6378.137",
        "INCH_MM = 25.4",
        "C_KM = 299_792.458",
        "def f(x):\n    return -26.74 + x",
    ],
)
def test_a_second_definition_is_found(text: str, tmp_path: Path) -> None:
    path = tmp_path / "second.py"
    path.write_text(text)
    assert list(defined_again(path, numbers_of(constants) | numbers_of(time)))


def numbers_of(module: ModuleType) -> dict[str, float]:
    """The numbers that a module defines, by name."""
    values = vars(module).items()
    return {
        name: float(value)
        for name, value in values
        if name.isupper() and isinstance(value, int | float)
    }


def digits(value: float) -> str:
    """The significant digits of a number: units of powers of ten have the same."""
    return f"{abs(value):.15e}".split("e")[0].replace(".", "").rstrip("0")


def defined_again(path: Path, known: dict[str, float]) -> Iterator[str]:
    """Places where a file gives a name of these constants a value, or writes the number of one with four digits or
    more: as a literal, as an expression of literals, or as ERFA's.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    characteristic = [value for value in known.values() if len(digits(value)) >= 4]
    characteristic += NOTORIOUS
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Store)
            and node.id in known
        ):
            yield f"{path}, line {node.lineno}: {node.id}"
        value = number_of(node)
        if value and any(same(value, constant) for constant in characteristic):
            yield f"{path}, line {node.lineno}: {ast.unparse(node)}"  # type: ignore[attr-defined]


def number_of(node: ast.AST) -> float | None:
    """The value of an expression of literals, pi and ERFA's constants; None for another node."""
    if not isinstance(node, ast.Constant | ast.BinOp | ast.Call | ast.Attribute):
        return None
    names = {leaf.id for leaf in ast.walk(node) if isinstance(leaf, ast.Name)}
    if not names <= {"math", "np", "erfa"}:
        return None
    try:
        return float(
            eval(
                compile(ast.Expression(node), "", "eval"),
                {"math": math, "np": np, "erfa": erfa},
            )
        )
    except (ArithmeticError, AttributeError, TypeError, ValueError):
        return None


def same(value: float, constant: float) -> bool:
    """Whether the numbers are equal to 8 digits, but for prefixes of their units: powers of a thousand."""
    if not 1e-50 < abs(value) < 1e50:
        return False
    thousands = math.log10(abs(value / constant)) / 3
    return abs(thousands - round(thousands)) < 3e-9
