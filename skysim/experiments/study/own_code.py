"""Functions and objects that a user gives to a study in Python: their names, identity and way to other processes.

A study keeps a digest of each of them, so that trials of a changed function are not mixed with earlier ones. It covers
the source code of the function, of what it calls in the user's own modules, and the values that it uses.
"""

import hashlib
import inspect
import io
import marshal
import pickle
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

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
    "<frozen",
)
# What a tracker of the estimator is made from; the rest follows from it.
TRACKER = (
    "camera",
    "settings",
    "stars",
    "focal_uncertainty",
    "searches",
    "air",
    "leds",
    "lever",
    "code",
)


class SourcePickler(pickle.Pickler):
    """Pickles functions and classes of the user's modules by their source code, others by name and version.

    The result is not read again: it is the input of a digest.
    """

    def reducer_override(self, obj: Any) -> Any:
        """See `pickle.Pickler`. The state, in third place, may refer to the object itself."""
        if isinstance(obj, ModuleType | FunctionType | type):
            if obj is str:
                return NotImplemented
            if not is_own(obj):
                return str, (f"{obj.__name__} {version_of(obj)}",)
            contents = None if isinstance(obj, ModuleType) else dict(contents_of(obj))
            return str, (source_of(obj),), contents
        if isinstance(obj, StarTracker | DomeTracker):
            return (
                str,
                (type(obj).__qualname__,),
                [getattr(obj, key, None) for key in TRACKER],
            )
        try:
            return obj.__reduce_ex__(4)
        except TypeError:  # such as a lock or an open file
            return str, (type(obj).__qualname__,)


def is_own(code: Any) -> bool:
    """Whether a module, function or class is the user's: neither installed nor of skysim."""
    if isinstance(code, FunctionType):
        return not code.__code__.co_filename.startswith(INSTALLED)
    name = code.__name__ if isinstance(code, ModuleType) else code.__module__
    file = getattr(sys.modules.get(name), "__file__", None) or ""
    return name not in sys.builtin_module_names and not file.startswith(INSTALLED)


def version_of(code: Any) -> str:
    """The version of the package of a module, function or class; empty if it has none."""
    package = (getattr(code, "__module__", None) or code.__name__).partition(".")[0]
    return str(getattr(sys.modules.get(package), "__version__", ""))


def source_of(code: Any) -> str:
    """The source code of a module, function or class; of a function without a file its compiled code."""
    try:
        return inspect.getsource(code)
    except (OSError, TypeError):
        return marshal.dumps(code.__code__).hex() if hasattr(code, "__code__") else repr(code)


def contents_of(code: Any) -> Iterator[tuple[str, Any]]:
    """Yield what a function uses, by name: defaults, globals, variables of a closure; or the methods of a class."""
    if isinstance(code, type):
        yield "bases", code.__bases__
        for name, member in vars(code).items():
            inner = getattr(member, "__func__", getattr(member, "fget", member))
            if isinstance(inner, FunctionType):
                yield name, inner
        return
    yield "defaults", (code.__defaults__, code.__kwdefaults__)
    for name in sorted(set(names_in(code.__code__)) & set(code.__globals__)):
        yield name, code.__globals__[name]
    for name, cell in zip(code.__code__.co_freevars, code.__closure__ or (), strict=True):
        try:
            yield name, cell.cell_contents
        except ValueError:  # not yet assigned
            continue


def names_in(code: CodeType) -> Iterator[str]:
    """Yield the names of globals and attributes in compiled code, with that of the functions in it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from names_in(constant)


def digest_of(given: Any) -> str:
    """First 16 hexadecimal digits of the SHA-256 of what a function or an object does, see the module."""
    data = io.BytesIO()
    SourcePickler(data, 4).dump(given)
    return hashlib.sha256(data.getvalue()).hexdigest()[:16]


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
