"""Functions and objects that a user gives to a study in Python: their names, identity and way to other processes.

A study keeps a digest of each of them, so that trials of a changed function are not mixed with earlier ones.
"""

import hashlib
import sys
import sysconfig
from collections.abc import Mapping
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import FunctionType
from typing import Any
from uuid import uuid4

import numpy as np

from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.star_tracker import StarTracker
from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.core.plugins import Programs, describe_error
from skysim.core.yaml_reader import is_file
from skysim.dynamics.controllers import CONTROLLERS
from skysim.simulation.lab import name_of
from skysim.tracking.tracker_interface import OWN

# Beginnings of the paths of code that is not the user's. That of skysim and estimator is in the version that a store
# keeps (`setups.code_version`).
INSTALLED = (
    *(sysconfig.get_paths()[name] for name in ("stdlib", "purelib", "platlib")),
    *(str(ROOT / package) for package in ("skysim", "estimator")),
)


def is_own(file: str) -> bool:
    """Whether a module's file is the user's: neither installed nor of skysim."""
    return is_file(Path(file)) and not file.startswith(INSTALLED)


def digest_of(given: Any) -> str:
    """First 16 hexadecimal digits of the SHA-256 of the user's source files and of the values in a function or object.

    1. The files are the loaded modules from the folder of its own one, and below: any of them may be called.
    2. The values are the variables of a function's closure, or the fields of an object.
    3. What is defined in a session without a file, or has values that do not tell what they are, gets a digest of its
       own each time: nothing tells whether it has changed, so its trials are not continued.
    """
    code = given if isinstance(given, FunctionType | type) else type(given)
    # 1. Files.
    home = getattr(sys.modules.get(code.__module__), "__file__", None) or ""
    files = {getattr(module, "__file__", None) or "" for module in sys.modules.values()}
    folder = str(Path(home).parent)
    own = sorted(file for file in files if home and file.startswith(folder) and is_own(file))
    texts = [code.__qualname__, *(Path(file).read_text("utf-8", "replace") for file in own)]
    # 2. Values.
    cells = [cell.cell_contents for cell in getattr(code, "__closure__", None) or ()]
    fields = getattr(given, "__dict__", {}) if code is not given else {}
    values = [
        repr(value.tolist() if isinstance(value, np.ndarray) else value)
        for value in [*cells, *fields.values()]
    ]
    # 3. Unknown: no file, the address of an object, or an array that is cut short.
    if not own or any(" at 0x" in text or "..." in text for text in values):
        values.append(uuid4().hex)
    texts += values
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


def digests_of(programs: Programs) -> dict[str, str]:
    """The digests of the functions and objects among external trackers and controllers, by name."""
    return {
        name: digest_of(one) for name, one in programs.items() if not isinstance(one, str)
    }


def with_names(value: Any, programs: dict[str, Any]) -> Any:
    """A value of a study or a scene with names for functions and trackers in it, which are added to `programs`.

    Raises InputError for two with one name, and for the name of one of skysim's own.
    """
    if isinstance(value, Mapping):
        return {key: with_names(inner, programs) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [with_names(inner, programs) for inner in value]
    if not (callable(value) or isinstance(value, StarTracker | DomeTracker)):
        return value
    return register(name_of(value), value, programs)


def register(name: str, part: Any, programs: dict[str, Any]) -> str:
    """Add a tracker or controller to the programs, and return its name. Raises InputError if that is in use."""
    if programs.setdefault(name, part) is not part or name in (OWN, *CONTROLLERS.own):
        raise InputError(name, "name already in use", f"a mapping such as {{'my_{name}': …}}")
    return name


def unsendable(programs: Programs) -> str:
    """The reason why other processes cannot take functions and objects; empty if they can."""
    for name, one in programs.items():
        try:
            data = bytes(ForkingPickler.dumps(one))
        except Exception as error:
            return f"{name}: {describe_error(error)}"
        main = sys.modules["__main__"]
        file = Path(getattr(main, "__file__", None) or "")
        if b"__main__" in data and not (main.__spec__ or is_file(file)):
            return f"{name} is defined in a session without a file"
    return ""
