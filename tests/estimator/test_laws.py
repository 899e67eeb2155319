"""Every public function of the estimator has a property test, and all tests pass with many examples."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import laws

# The property tests of each package; importing them records which functions they cover.
FILES = sorted(Path(__file__).parent.rglob("test_laws_*.py"))
for path in FILES:
    importlib.import_module(
        ".".join(path.relative_to(Path(__file__).parents[2]).with_suffix("").parts)
    )


def test_every_public_function_has_a_law() -> None:
    every = set(laws.public())
    assert len(every) > 150
    assert sorted(every - laws.PROVED) == []
    assert sorted(laws.PROVED - every) == []


@pytest.mark.long
@pytest.mark.parametrize("checked", [False, True], ids=["as it runs", "every index checked"])
def test_the_laws_hold_for_hundreds_of_examples(checked: bool, tmp_path: Path) -> None:
    """Array bounds are checked, as compiled code would otherwise read beyond a table silently."""
    bounds = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)} if checked else {}
    call = [sys.executable, "-m", "pytest", "-x", *map(str, FILES)]
    done = subprocess.run(
        call,
        env=os.environ | bounds | {"LAW_EXAMPLES": "300"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-3000:]
