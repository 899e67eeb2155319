"""No public function of the estimator without a property test; and all of them with many examples."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import laws
import pytest
import test_est_laws_catalog
import test_est_laws_dome
import test_est_laws_filter
import test_est_laws_frame
import test_est_laws_sky
import test_est_laws_survey

FILES = (
    test_est_laws_catalog,
    test_est_laws_dome,
    test_est_laws_filter,
    test_est_laws_frame,
    test_est_laws_sky,
    test_est_laws_survey,
)


def test_every_public_function_has_a_law() -> None:
    every = set(laws.public())
    assert len(every) > 150
    assert sorted(every - laws.PROVED) == []
    assert sorted(laws.PROVED - every) == []


@pytest.mark.long
@pytest.mark.parametrize("checked", [False, True], ids=["as it runs", "every index checked"])
def test_the_laws_hold_for_hundreds_of_examples(checked: bool, tmp_path: Path) -> None:
    """Compiled code reads beyond a table without a word, unless it is compiled to say so."""
    bounds = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)} if checked else {}
    paths = [str(Path(str(one.__file__))) for one in FILES]
    call = [sys.executable, "-m", "pytest", "-x", *paths]
    done = subprocess.run(
        call, env=os.environ | bounds | {"LAW_EXAMPLES": "300"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-3000:]
