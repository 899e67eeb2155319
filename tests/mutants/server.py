"""Tests of one mutant at a time, in processes forked from one that has imported and collected all tests.

A pytest plugin of `tests.mutants`. In `record` it runs all tests once and notes which functions each of
them enters; in `serve` it forks a process for each mutant, in which the functions have the changed code.
"""

from __future__ import annotations

import contextlib
import cProfile
import gc
import json
import marshal
import os
import signal
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any

import numba
import pytest
from numba.core.caching import NullCache
from numba.core.registry import CPUDispatcher

Key = tuple[str, int, str]  # of a function: file, first line, name
BROKEN = "broken:"
OPTIONS = ("-q", "-p", "no:cacheprovider", "-m", "not long and not browser", "--tb=no")


def key_of(code: CodeType, tree: Path) -> Key | None:
    """A function of the tree, or None for any other."""
    if not code.co_filename.startswith(f"{tree}/"):
        return None
    return code.co_filename[len(str(tree)) + 1 :], code.co_firstlineno, code.co_name


def nested(code: CodeType) -> Iterator[CodeType]:
    """A function's code and that of the functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from nested(constant)


class Entered:
    """Functions that are entered between two calls; the profiler is C and costs little."""

    def __init__(self, tree: Path) -> None:
        self.tree = tree
        self.start()

    def start(self) -> None:
        self.profile = cProfile.Profile(subcalls=False, builtins=False)
        self.profile.enable()

    def stop(self) -> list[Key]:
        self.profile.disable()
        codes = (entry.code for entry in self.profile.getstats())
        keys = {key_of(code, self.tree) for code in codes if isinstance(code, CodeType)}
        return sorted(key for key in keys if key)


class Recorder:
    """Notes the time, the outcome and the entered functions of each test."""

    def __init__(self, tree: Path, out: Path) -> None:
        self.tree = tree
        self.out = out
        self.tests = {}
        self.failed = set()
        self.entered = Entered(tree)
        self.imported: list[Key] = []

    def pytest_collection_finish(self) -> None:
        self.imported = self.entered.stop()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        began_s = time.process_time()
        self.entered.start()
        result = yield
        entered = self.entered.stop()
        time_s = time.process_time() - began_s
        self.tests[item.nodeid] = {"time_s": round(time_s, 4), "entered": entered}
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        passed = {name: test for name, test in self.tests.items() if name not in self.failed}
        self.out.write_text(
            json.dumps(
                {"imported": self.imported, "tests": passed, "failed": sorted(self.failed)}
            )
        )


class Program:
    """The functions of a process and the compiled ones among them, with what each of these calls."""

    def __init__(self, tree: Path) -> None:
        self.tree = tree
        self.functions: dict[Key, list[FunctionType]] = defaultdict(list)
        self.compiled: list[CPUDispatcher] = []
        for one in gc.get_objects():
            if type(one) is FunctionType and (key := key_of(one.__code__, tree)):
                self.functions[key].append(one)
            elif isinstance(one, CPUDispatcher) and key_of(one.py_func.__code__, tree):
                self.compiled.append(one)
        self.callers: dict[Any, set[Any]] = defaultdict(set)
        for one in self.compiled:
            for called in compiled_names(one.py_func):
                self.callers[called].add(one)

    def users(self, key: Key) -> set[CPUDispatcher]:
        """Compiled functions whose machine code contains this function's: itself and all that call it."""
        found: set[CPUDispatcher] = set()
        more = {
            one for one in self.compiled if key_of(one.py_func.__code__, self.tree) == key
        }
        while more:
            found |= more
            more = {user for one in more for user in self.callers[one]} - found
        return found

    def calls_of(self, key: Key) -> set[Key | None]:
        """Compiled functions that a function names: a call of them enters no Python function."""
        found = {
            one
            for function in self.functions.get(key, ())
            for one in compiled_names(function)
        }
        return {key_of(one.py_func.__code__, self.tree) for one in found}


def compiled_names(function: FunctionType) -> Iterator[CPUDispatcher]:
    """Compiled functions that the names in a function's code stand for, in tables and modules too."""
    names = {name for code in nested(function.__code__) for name in code.co_names}
    values = [function.__globals__.get(name) for name in names]
    # Not an empty one.
    values += [
        cell.cell_contents for cell in function.__closure__ or () if cell != CellType()
    ]
    for value in values:
        if isinstance(value, ModuleType):
            members = [vars(value).get(name) for name in names]
        elif isinstance(value, dict | tuple | list):
            members = list(value.values()) if isinstance(value, dict) else list(value)
        else:
            members = [value]
        yield from (one for one in members if isinstance(one, CPUDispatcher))


class Server:
    """Answers requests: which tests enter given functions, and what these tests say of a mutant."""

    def __init__(self, tree: Path, requests: Connection, recorded: dict[str, Any]) -> None:
        self.tree = tree
        self.requests = requests
        self.recorded = recorded

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self.session = session
        self.items = {item.nodeid: item for item in session.items}
        self.program = Program(self.tree)
        self.tests: dict[Key, set[str]] = defaultdict(set)  # that enter each function
        calls: dict[Key, set[Any]] = {}
        for name, test in self.recorded["tests"].items():
            for key in map(tuple, test["entered"]):
                self.tests[key].add(name)
                for called in calls.setdefault(key, self.program.calls_of(key)):
                    self.tests[called].add(name)
        self.tests = {key: names & self.items.keys() for key, names in self.tests.items()}
        gc.freeze()  # a forked process does not copy what it does not write
        while request := self.requests.recv():
            self.requests.send(getattr(self, request[0])(*request[1:]))
        return True

    def tests_of(self, keys: list[Key]) -> list[str]:
        """Tests that enter a function or, if it is compiled, one that calls it."""
        users = {
            key_of(one.py_func.__code__, self.tree)
            for key in keys
            for one in self.program.users(key)
        }
        return sorted(set().union(*(self.tests.get(key, ()) for key in {*keys, *users})))

    def try_code(self, key: Key, code: bytes, names: list[str], scratch: Path) -> str:
        """Outcome of tests in a process in which a function has another code."""
        users = self.program.users(key)
        if not self.program.functions[key] or any(one.overloads for one in users):
            return "import anew"

        def change() -> None:
            # Of what is imported from now on.
            numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = str(scratch)
            for function in self.program.functions[key]:
                function.__code__ = marshal.loads(code)
            for one in users:
                one._cache = NullCache()

        items = [self.items[name] for name in names]
        return forked(lambda: run_items(self.session, items, self.recorded, change))


def limit_s(time_s: float) -> float:
    """Processor time that a test may take, in which code may have to be compiled."""
    return 60 + 10 * time_s


def run_items(
    session: pytest.Session, items: list[Any], recorded: Any, change: Callable[[], None]
) -> str:
    """Run tests up to the first that fails; a test that uses far more processor time than before ends the process."""
    failed: list[str] = []

    class Listener:
        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                failed.append(report.nodeid)

    change()
    session.config.pluginmanager.register(Listener())
    for item, after in zip(items, [*items[1:], None], strict=True):
        signal.setitimer(
            signal.ITIMER_PROF, limit_s(recorded["tests"][item.nodeid]["time_s"])
        )
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
        if failed:
            return failed[0]
    return "survived"


def forked(run: Callable[[], str], wall_s: float = 900) -> str:
    """What a function returns in a process of its own; `timeout` or a signal where that ends otherwise."""
    reader, writer = os.pipe()
    if not (child := os.fork()):
        os.setsid()
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.alarm(int(wall_s))
        try:
            said = run()
        except BaseException as error:  # of this program: pytest catches those of the tests
            said = f"{BROKEN} {error!r}"
        os.write(writer, said[:300].encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        _, status = os.waitpid(child, 0)
        said = pipe.read() if os.WIFEXITED(status) else ""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what the tests started
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return "timeout" if number == signal.SIGPROF else signal.Signals(number).name
    return said or f"{BROKEN} no answer"


def order(
    names: list[str], distance: Callable[[str], float], times_s: Counter[str], budget_s: float
) -> list[str]:
    """Tests of the nearest files first, the quick ones of each file first, as many as take the budget."""
    chosen = []
    total_s = 0.0
    for name in sorted(
        names, key=lambda name: (distance(file := name.split("::")[0]), file, times_s[name])
    ):
        if total_s + times_s[name] <= budget_s:
            chosen.append(name)
            total_s += times_s[name]
    return chosen
