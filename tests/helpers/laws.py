"""Shared by property tests: the functions they cover, their inputs, and valid answers."""

from __future__ import annotations

import importlib
import inspect
import os
import pkgutil
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeVar

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as some
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.spatial.transform import Rotation

import estimator
from estimator.catalog import catalog
from estimator.catalog.catalog import StarCatalog
from estimator.core.checks import Floats

EXAMPLES = int(os.environ.get("LAW_EXAMPLES", "8"))
ANY = some.floats(width=64)
NUMBERS = arrays(
    "f8", array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=6), elements=ANY
)
SEEDS = some.integers(0, 2**32 - 1).map(np.random.default_rng)
PROVED: set[str] = set()
Test = TypeVar("Test", bound=Callable[..., None])
T = TypeVar("T")


def law(*functions: Any, slow: bool = False) -> Callable[[Test], Test]:
    """Mark a property test with the public functions of the estimator that it covers."""
    # A public name may be a partial of a private function.
    names = map(name_of, functions)
    PROVED.update(name for name in names if not name.rpartition(".")[2].startswith("_"))
    return settings(
        max_examples=max(EXAMPLES // 10, 2) if slow else EXAMPLES,
        deadline=None,
        derandomize=EXAMPLES < 100,
        suppress_health_check=list(HealthCheck),
    )


def name_of(one: Any) -> str:
    """The full name of a function, of the one that a partial calls, a method, a class's method or a property."""
    if isinstance(one, partial):
        one = one.func
    if isinstance(one, property):
        one = one.fget
    return f"{one.__module__}.{one.__qualname__}"


def public() -> Iterator[str]:
    """Every function and method of the estimator without an underscore, where it is defined.

    Functions compiled by numba, which these call, and protocols are left out.
    """
    for info in pkgutil.walk_packages(estimator.__path__, "estimator."):
        module = importlib.import_module(info.name)
        for name, one in vars(module).items():
            if name.startswith("_") or getattr(one, "__module__", None) != module.__name__:
                continue
            if inspect.isfunction(one):
                yield name_of(one)
            if inspect.isclass(one) and not getattr(one, "_is_protocol", False):
                yield from methods(one)


def methods(of: type) -> Iterator[str]:
    """Public methods and properties of a class."""
    for name, one in vars(of).items():
        if not name.startswith("_") and isinstance(one, classmethod | property):
            yield name_of(one.__func__ if isinstance(one, classmethod) else one)
        elif not name.startswith("_") and inspect.isfunction(one):
            yield name_of(one)


def answered(call: Callable[[], T], way: type[Exception] = ValueError) -> T | None:
    """The result, or None if the call was refused in one line."""
    try:
        return call()
    except way as error:
        lines = str(error).splitlines()
    assert len(lines) == 1
    return None


def units(rng: np.random.Generator, count: int) -> Floats:
    """(N, 3) directions, uniform on the sphere."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def drawn(rng: np.random.Generator, count: int = 60) -> StarCatalog:
    """Random stars, brightest first, with larger proper motions and parallaxes than real ones."""
    hip = np.arange(1, count + 1)
    ra = np.degrees(rng.uniform(0, 7, count))
    dec = np.degrees(np.arcsin(rng.uniform(-1, 1, count)))
    motion = rng.normal(0, 1000, (2, count))
    light = rng.uniform(0, 800, count), np.sort(rng.uniform(-1, 6, count))
    return catalog.from_columns(
        hip, ra, dec, *motion, *light, epoch_yr=rng.uniform(1900, 2100)
    )


def turn(rng: np.random.Generator, most_rad: float = np.pi) -> Rotation:
    """A random rotation by up to an angle."""
    return Rotation.from_rotvec(rng.uniform(0, most_rad) * units(rng, 1)[0])


def assert_covariance(matrix: Floats) -> None:
    """Check that a matrix is symmetric and positive semidefinite to rounding."""
    size = np.abs(matrix).max()
    np.testing.assert_allclose(matrix, np.swapaxes(matrix, -1, -2), rtol=0, atol=1e-9 * size)
    assert (np.linalg.eigvalsh(matrix) >= -1e-9 * size).all()
