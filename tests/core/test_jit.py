"""The note about compilation."""

from __future__ import annotations

import numba
import pytest
from numba.core import event

from skysim.core import errors
from skysim.core.jit import CompilationNotice


def test_compilation_is_noted_once_and_others_hear_of_all_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """numba skips the next listener if one leaves while it calls them in turn."""
    notes: list[str] = []
    monkeypatch.setattr(errors, "note", notes.append)
    with (
        event.install_listener("numba:compile", CompilationNotice()),
        event.install_recorder("numba:compile") as recorder,
    ):
        for one in (numba.njit(lambda x: x + 1), numba.njit(lambda x: x - 1)):
            one(1)
    assert len(notes) == 1
    states = [heard.status.name for _, heard in recorder.buffer]
    assert states.count("START") == states.count("END") >= 2
