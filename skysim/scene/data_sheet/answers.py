"""Parsers of the answers, from a typed text to a value of the file. Each raises InputError with what is allowed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from skysim.core.errors import InputError


def pixels(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,6})\s*(?:px)?\s*[x×*,]\s*(\d{1,6})\s*(?:px)?", text.strip())
    if not match:
        raise InputError("", "", "width x height, such as 1936x1216")
    return int(match[1]), int(match[2])


def quantity_text(si_unit: str, what: str, example: str) -> Callable[[str], str]:
    """A parser that checks a quantity and returns its text."""

    def parse(text: str) -> str:
        from skysim.core.units import quantity

        try:
            quantity(si_unit, what, example)(text)
        except ValueError:
            raise InputError("", "", f"a {what} with its unit, such as {example}") from None
        return " ".join(text.split())

    return parse


def finite(value: float) -> float:
    if not math.isfinite(value):
        raise InputError("", "not finite")
    return value


def plain(value: float) -> float:
    """The number, without a decimal point if it is whole."""
    return int(value) if value.is_integer() and abs(value) < 1e15 else value


def number(units: str, example: str) -> Callable[[str], float]:
    """A parser of a number without or with its unit. units : a pattern"""

    def parse(text: str) -> float:
        match = re.fullmatch(rf"([-+.\de]*?\d\.?)\s*(?:{units})?", text.strip(), re.IGNORECASE)
        try:
            value = finite(float(match[1] if match else ""))
        except ValueError:
            raise InputError("", "", f"a number such as {example}") from None
        return plain(value)

    return parse


def share(text: str) -> float:
    """A fraction, or a percentage with its sign."""
    digits, percent, _ = text.partition("%")
    value = number("", '0.65, or "65 %"')(digits)
    return rounded(value / 100, 12) if percent else value


def bits(text: str) -> int:
    value = number("bits?", "12")(text)
    if value not in range(1, 17):
        raise InputError("", "", "1 to 16")
    return int(value)


def f_number(text: str) -> float:
    return number("", "1.4")(re.sub(r"^\s*f\s*/?\s*", "", text, flags=re.IGNORECASE))


def gain(text: str) -> float:
    """Electrons a digital number; EMVA 1288 states the inverse, in DN/e-."""
    inverse = re.fullmatch(r"(.*?)\s*(?:DN|ADU)\s*/\s*e-?", text.strip(), re.IGNORECASE)
    value = number(r"e-?\s*/\s*(?:DN|ADU)", '2.64, "2.64 e-/DN" or "0.379 DN/e-"')(
        inverse[1] if inverse else text
    )
    return rounded(1 / value, 6) if inverse and value else value


def shutter(text: str) -> str:
    kinds = ("global", "rolling", "frame_transfer", "interline")
    kind = text.strip().lower().replace(" ", "_").replace("-", "_").removesuffix("_shutter")
    if kind not in kinds:
        raise InputError("", "", ", ".join(kinds))
    return kind


def rounded(value: float, digits: int = 4) -> float:
    return plain(float(f"{value:.{digits}g}"))
