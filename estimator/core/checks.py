"""Checks of a caller's arguments: each raises ImageError with one line that says what, where, and what is allowed.

The checks run at the public entries, before compiled code, which would read beyond a short array. They also convert
arrays and numbers to the one type for which the loops are compiled: a Fortran-ordered, flipped, read-only or big-endian
array, or an int in place of a float, would cause a compilation of seconds.
"""

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import Any, NamedTuple, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy.spatial.transform import Rotation

from estimator.core.errors import ImageError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]  # half the memory where there are millions
Bools = NDArray[np.bool_]
Step = tuple[float, float]  # (dx, dy) in pixels
Kind = TypeVar("Kind")


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(kind: type[Kind]) -> type[Kind]:
    """Return the class as a dataclass whose objects have its fields only, and cannot be changed."""
    return dataclass(frozen=True, slots=True)(kind)


def known(what: str, name: object, allowed: Iterable[str]) -> None:
    """Raise ImageError unless a name is one of the allowed ones; the message lists them and suggests the nearest."""
    names = sorted(allowed)
    if name not in names:
        close = difflib.get_close_matches(str(name), names, 1)
        guess = f"; did you mean {close[0]}?" if close else ""
        raise ImageError(f"{what}: {name!r} is unknown{guess}; allowed: {', '.join(names)}")


def number(
    what: str, value: object, low: float, high: float, allowed: str, integer: bool = False
) -> Any:
    """Return a number as a plain float (or int) within [low, high]. Raises ImageError for anything else, NaN included.

    Parameters
    ----------
    what
        Name of the number, for the message
    allowed
        Allowed values in words, for the message
    integer
        Whether only whole numbers are allowed
    """
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, Integral if integer else Real) and not isinstance(
        value, bool | np.bool_
    ):
        plain = int(value) if integer else float(value)  # type: ignore[call-overload]
        if low <= plain <= high:
            return plain
    raise ImageError(f"{what} is {excerpt(value)}; allowed: {allowed}")


class Allowed(NamedTuple):
    """Allowed values of a number: low to high, in words; whether only whole numbers, and whether None too."""

    low: float
    high: float
    words: str
    whole: bool = False
    optional: bool = False


def store_numbers(owner: object, what: str, allowed: Mapping[str, Allowed]) -> None:
    """Replace numbers of a frozen dataclass, by name, by plain floats and ints, which compiled code knows.

    Raises ImageError for others, with `what` before the name.
    """
    for name, limits in allowed.items():
        value = getattr(owner, name)
        if value is not None or not limits.optional:
            object.__setattr__(owner, name, number(f"{what}{name}", value, *limits[:4]))


def of_type(what: str, value: object, *kinds: type) -> None:
    """Raise ImageError unless a value is of one of the types."""
    if not isinstance(value, kinds):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise ImageError(
            f"{what} is {excerpt(value)} of type {type(value).__name__}; allowed: {names}"
        )


def each_of_type(what: str, values: object, kind: type) -> None:
    """Raise ImageError unless a value is a list or tuple whose elements are of one type."""
    of_type(what, values, list, tuple)
    for k, one in enumerate(values):  # type: ignore[arg-type,var-annotated]
        of_type(f"{what}: number {k}", one, kind)


def one_rotation(what: str, value: object) -> None:
    """Raise ImageError unless a value is a single Rotation."""
    of_type(what, value, Rotation)
    if not value.single:  # type: ignore[attr-defined]
        raise ImageError(f"{what} is a stack of {len(value)} rotations; allowed: one")  # type: ignore[arg-type]
    if not np.isfinite(value.as_quat()).all():  # type: ignore[attr-defined]
        raise ImageError(f"{what} is NaN; allowed: a rotation")


def pixel_step(what: str, value: object) -> Step | None:
    """Return (dx, dy) as two finite floats, or None. Raises ImageError for anything else."""
    if value is None:
        return None
    pair = floats(what, value, (2,))
    if not np.isfinite(pair).all():
        raise ImageError(f"{what} is {pair.tolist()}; allowed: two finite numbers, or None")
    return float(pair[0]), float(pair[1])


def floats(what: str, value: object, shape: tuple[int | None, ...]) -> Floats:
    """Return an array as C-contiguous, aligned, writable float64; a copy only if it is needed.

    Parameters
    ----------
    shape
        Allowed shape, with None where any length is allowed

    Raises
    ------
    ImageError
        For another shape, and for anything that is no array of real numbers.
    """
    array = native(what, value, np.float64)
    if array.ndim != len(shape) or any(
        want is not None and want != got for want, got in zip(shape, array.shape, strict=True)
    ):
        words = ["N" if length is None else str(length) for length in shape]
        allowed = f"({', '.join(words)}{',' * (len(words) == 1)})"
        raise ImageError(f"{what} has shape {array.shape}; allowed: {allowed}")
    return array


def native(what: str, value: object, dtype: DTypeLike) -> NDArray[Any]:
    """Return an array of a dtype in the form for compiled code; a copy only if it is needed.

    The form is C-contiguous, aligned, writable. Raises ImageError for anything that is no array of real numbers.
    """
    if type(value) is np.ndarray and value.dtype == dtype:
        if not value.flags.c_contiguous:
            return np.ascontiguousarray(value)
        return value if value.flags.behaved else value.copy()
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "buif":
            raise ValueError(f"its type is {array.dtype}")
        return np.require(array, dtype, ["C", "A", "W", "E"])
    except (ValueError, TypeError) as error:
        raise ImageError(f"{what}: not an array of real numbers ({excerpt(error)})") from None


def rows(what: str, value: object, count: int | None, width: int) -> Floats:
    """Return (count, width) finite floats. Raises ImageError for another shape, and for NaN or infinity."""
    array = floats(what, value, (count, width))
    if not np.isfinite(array).all():
        finite = np.asarray(np.isfinite(array).all(axis=1))
        raise ImageError(f"{what} has a NaN or infinity in row {first_bad(finite)}")
    return array


def unit_rows(what: str, value: object, count: int | None) -> Floats:
    """Return (count, 3) vectors of unit length, to 1e-6. Raises ImageError for others."""
    array = rows(what, value, count, 3)
    length = np.sqrt(np.einsum("ij,ij->i", array, array))
    good = np.abs(length - 1) < 1e-6
    if not good.all():
        n = first_bad(good)
        raise ImageError(f"{what}: row {n} has length {length[n]:.6g}; allowed: unit vectors")
    return array


def row_numbers(what: str, value: object, below: int) -> Ints:
    """Return (K,) whole numbers from 0 to below - 1, as int64. Raises ImageError for others."""
    array = np.asarray(value)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise ImageError(
            f"{what} has shape {array.shape} of {array.dtype}; allowed: (K,) whole numbers"
        )
    good = (array >= 0) & (array < below)
    if not good.all():
        raise ImageError(
            f"{what}: {array[first_bad(good)]} is no row of {below}; allowed: 0 to {below - 1}"
        )
    return array.astype(np.int64, copy=False)


def first_bad(good: Bools) -> int:
    """Return the index of the first False."""
    return int(np.argmin(good))


def excerpt(value: object) -> str:
    """Return a value's text in one line of at most 60 characters."""
    text = " ".join((str(value) if isinstance(value, Exception) else repr(value)).split())
    return text if len(text) <= 60 else f"{text[:59]}…"
