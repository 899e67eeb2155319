"""Functions and objects that a user gives to a study in Python: their identity and way to other processes.

A study keeps a digest of each of them, so that trials of a changed function are not mixed with earlier ones.
"""

import hashlib
import sys
import sysconfig
from collections.abc import Iterator
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any
from uuid import uuid4

import numpy as np

from skysim.core.paths import ROOT
from skysim.core.plugins import Programs, describe_error
from skysim.core.yaml_reader import is_file

# Beginnings of the paths of code that is not the user's. That of skysim and estimator is in the version that a store
# keeps (`trials.code_version`).
INSTALLED = (
    *(sysconfig.get_paths()[name] for name in ("stdlib", "purelib", "platlib")),
    *(str(ROOT / package) for package in ("skysim", "estimator")),
)


def is_own(file: str) -> bool:
    """Whether a module's file is the user's: neither installed nor of skysim."""
    return is_file(Path(file)) and not file.startswith(INSTALLED)


def file_of(code: FunctionType | type) -> str:
    """The file of a function's or class's module; empty if it has none."""
    return getattr(sys.modules.get(code.__module__), "__file__", None) or ""


def digest_of(given: Any) -> str:
    """First 16 hexadecimal digits of the SHA-256 of the user's source files and of the values in a function or object.

    1. The files are the loaded modules from the folder of its own one, and below: any of them may be called.
    2. The values are those that its code uses (`values_of`), and the fields of an object.
    3. What is defined in a session without a file, or has values that do not tell what they are, gets a digest of its
       own each time: nothing tells whether it has changed, so its trials are not continued.
    """
    code = given if isinstance(given, FunctionType | type) else type(given)
    # 1. Files.
    home = Path(file_of(code))
    files = {getattr(module, "__file__", None) or "" for module in sys.modules.values()}
    own = sorted(
        one for one in files if is_own(one) and Path(one).is_relative_to(home.parent)
    )
    texts = [code.__qualname__, *(Path(file).read_text("utf-8", "replace") for file in own)]
    # 2. Values.
    used = list(values_of(code, set()))
    if code is not given:
        used += getattr(given, "__dict__", {}).values()
        used += [getattr(given, name, None) for name in getattr(code, "__slots__", ())]
    values = [repr(one.tolist() if isinstance(one, np.ndarray) else one) for one in used]
    # 3. Unknown: no file, the address of an object, or an array that is cut short.
    if not own or any(" at 0x" in text or "..." in text for text in values):
        values.append(uuid4().hex)
    return hashlib.sha256("\n".join(texts + values).encode()).hexdigest()[:16]


def values_of(part: Any, seen: set[Any]) -> Iterator[Any]:
    """Yield what the user's functions and classes use, also in one another: globals, defaults, closures; and values."""
    if isinstance(part, FunctionType | type):
        if part in seen or not is_own(file_of(part)):
            return
        seen.add(part)
        inner = list(vars(part).values())
        if isinstance(part, FunctionType):
            names = sorted(names_in(part.__code__) & set(part.__globals__))
            inner = [part.__globals__[name] for name in names]
            inner += [part.__defaults__, part.__kwdefaults__]
            inner += [cell.cell_contents for cell in part.__closure__ or ()]
        for one in inner:
            if isinstance(part, FunctionType) or isinstance(one, FunctionType):
                yield from values_of(one, seen)
    elif not isinstance(part, ModuleType | BuiltinFunctionType):
        yield part


def names_in(code: CodeType) -> set[str]:
    """The names of globals in compiled code and in the functions in it."""
    inner = (names_in(one) for one in code.co_consts if isinstance(one, CodeType))
    return set(code.co_names).union(*inner)


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
