"""Run compiled functions by the Python interpreter: NumPy checks every index, and nothing is compiled."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

import numba
import pytest


def interpreted(name: str) -> ModuleType:
    """Import a second copy of a module and of its package's modules without numba's compiler."""
    root = name.split(".")[0]
    with pytest.MonkeyPatch.context() as patch:
        for module in [one for one in sys.modules if one.split(".")[0] == root]:
            patch.delitem(sys.modules, module)
        patch.setattr(numba.config, "DISABLE_JIT", True)
        module = importlib.import_module(name)
        for own in [one for one in sys.modules if one.split(".")[0] == root]:
            sys.modules.pop(own)
    return module
