"""Mutation score: the share of small changes of the code that the tests notice.

`python -m tests.mutants [COUNT] [SEED] [PACKAGE ...] [--again] [--control]`. COUNT places are drawn uniformly from all
that cosmic-ray's operators can change in the packages (numbers, operators, comparisons, conditions, loops), and one
change of each. A package is a folder or a module of skysim or estimator; PACKAGES unless one is given. Left out are
type annotations, decorators, errors' messages (whole raise statements and f-strings) and __init__.py.

The tests run once without a mutant, and what each enters is noted. A mutant is tested, in a copy, by the tests that
enter the changed function, nearest file first, up to BUDGET_S; if these take less than OTHERS_S, others of near files
fill it. tests/mutants/server.py runs them, in a process forked after all imports. A change outside of functions is
tested in a process that imports all packages anew. A mutant is killed if a test fails, crashes, or takes 60 s and ten
times its time.

Results are added to out/mutants/SEED.jsonl (of given packages: SEED-DIGEST.jsonl), and a run that was stopped goes on.
--again tries the survivors of that file once more, with more tests and those that were added. --control tests the
places without the change: all must survive.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import json
import marshal
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from functools import cache
from multiprocessing import Pipe
from pathlib import Path
from random import Random
from types import CodeType
from typing import Any

import cosmic_ray.plugins
import numba
import pytest
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code

from tests.mutants.server import (
    BROKEN,
    OPTIONS,
    Key,
    Recorder,
    Server,
    forked,
    limit_s,
    nested,
    order,
)

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "out" / "mutants"
TREE = OUT / "tree"
CACHE = OUT / "cache"
SCRATCH = OUT / "scratch"
BASELINE = OUT / "baseline.json"
CONTROL = "--control" * ("--control" in sys.argv)
PACKAGES = ("estimator", "skysim/camera", "skysim/sources", "skysim/dynamics")
USERS = ("simulation", "tracking", "results")  # tests of the packages that use them
# Of given packages only the test files that are so few import steps away are run; for survivors, one step more. To run
# all files once takes half an hour.
STEPS = 2 if "--again" in sys.argv else 1
# Of tests that enter the changed function, and of others if these are few: at first, and for survivors once more.
BUDGET_S, OTHERS_S = (90.0, 30.0) if "--again" in sys.argv else (20.0, 5.0)
# Operators that are left out: bits of floating-point numbers, which raise TypeError, so any test notices; decorators,
# which are the compiler's; and two that need arguments.
LEFT_OUT = re.compile(r"_(Bit\w+|LShift|RShift|Invert)$|Decorator|Variable")
NO_PLACE = ("decorator", "raise_stmt", "fstring", "import_from", "tfpdef")


def is_left_out(node: Any) -> bool:
    """Whether a parso node is in an annotation, a decorator, an error's message or an import, or cannot be changed."""
    # cosmic-ray replaces plain names of exceptions only.
    if node.type == "except_clause" and "." in node.get_code():
        return True
    # `*` and `**` that unpack are no operators.
    if (
        node.type == "operator"
        and node.value in ("*", "**")
        and node.parent.type not in ("term", "power")
    ):
        return True
    while parent := node.parent:
        if parent.type in NO_PLACE:
            return True
        if parent.type == "annassign" and node is parent.children[1]:
            return True
        if parent.type == "funcdef" and node is parent.annotation:
            return True
        node = parent
    return False


def places(module: Path) -> dict[tuple[int, int], list[tuple[str, int]]]:
    """Mutable places (line, column) of a module, and the operators' names and occurrences that change each."""
    found = defaultdict(list)
    tree = get_ast(module.read_text())
    for name in sorted(set(cosmic_ray.plugins.operator_names())):
        if LEFT_OUT.search(name):
            continue
        operator = cosmic_ray.plugins.get_operator(name)()
        occurrence = 0
        for node in ast_nodes(tree):
            for begin, _ in operator.mutation_positions(node):
                if not is_left_out(node):
                    found[begin].append((name, occurrence))
                occurrence += 1
    return found


def modules_of(packages: Iterable[str]) -> list[Path]:
    """Modules of packages, which are folders or modules of the copy."""
    found: set[Path] = set()
    for package in packages:
        path = TREE / package
        if not path.exists() or package.split("/")[0] not in ("estimator", "skysim"):
            raise SystemExit(f"{package!r} is no folder or module of estimator or skysim")
        found |= {path} if path.is_file() else set(path.rglob("*.py"))
    return sorted(path for path in found if path.name != "__init__.py")


def tests_folder(module: str) -> str:
    """Where the tests of a module's package are, which have its name."""
    first, second, *_ = module.split("/")
    return f"tests/{second if first == 'skysim' else first}/"


def test_files(modules: list[Path], nearest: bool) -> list[str]:
    """Test files of the modules' packages and of USERS; of given packages those that are few import steps away."""
    found: set[str] = set()
    for path in modules:
        module = str(path.relative_to(TREE))
        folders = (tests_folder(module), *(f"tests/{name}/" for name in USERS))
        if nearest:
            files = {file for file, steps in importers(module).items() if steps <= STEPS}
        else:
            files = {
                str(file.relative_to(TREE))
                for one in folders
                for file in (TREE / one).rglob("*.py")
            }
        found |= {file for file in files if file.startswith(folders)}
    return sorted(file for file in found if Path(file).name.startswith("test_"))


def draw(modules: list[Path], count: int, seed: int) -> list[dict[str, Any]]:
    """So many mutants, in random order, without the few that are no Python, such as 2**not 2."""
    every = [(path, at, how) for path in modules for at, how in places(path).items()]
    random = Random(seed)
    chosen = random.sample(every, min(count, len(every)))
    print(f"{len(every)} places in {len(modules)} modules; seed {seed}", flush=True)
    drawn = [
        {
            "file": str(path.relative_to(TREE)),
            "line": at[0],
            "column": at[1],
            "how": random.choice(how),
        }
        for path, at, how in chosen
    ]
    return [one for one in drawn if is_python(mutated((TREE / one["file"]).read_text(), one))]


def mutated(source: str, mutant: dict[str, Any]) -> str:
    """The text of a module with its change."""
    name, occurrence = mutant["how"]
    return str(mutate_code(source, cosmic_ray.plugins.get_operator(name)(), occurrence))


def is_python(source: str) -> bool:
    """Whether a text can be compiled."""
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


@cache
def imports(file: str) -> frozenset[str]:
    """Modules of the copy that a file of it imports; skysim and estimator themselves, which name all, left out."""
    names: set[str] = set()
    for node in ast.walk(ast.parse((TREE / file).read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    files = (
        name.replace(".", "/") + ending
        for name in names
        for ending in (".py", "/__init__.py")
    )
    return frozenset(file for file in files if file.count("/") > 1 and (TREE / file).exists())


@cache
def importers(module: str) -> dict[str, int]:
    """The module (0), the files that import it (1), those that import these (2), and so on; tests included."""
    files = [
        path
        for folder in (module.split("/")[0], "tests")
        for path in (TREE / folder).rglob("*.py")
    ]
    direct = {name: imports(name) for name in (str(path.relative_to(TREE)) for path in files)}
    steps = {module: 0}
    while more := {
        name for name, used in direct.items() if name not in steps and used & steps.keys()
    }:
        steps |= dict.fromkeys(more, 1 + max(steps.values()))
    return steps


class Tests:
    """The tests of the packages: what each enters, the time that it takes, and a server that runs them on mutants."""

    def __init__(self, files: list[str]) -> None:
        self.recorded = record(files)
        self.imported = set(map(tuple, self.recorded["imported"]))
        self.times_s = Counter(
            {name: test["time_s"] for name, test in self.recorded["tests"].items()}
        )
        self.requests, theirs = Pipe()
        if not os.fork():
            session(files, Server(TREE, theirs, self.recorded))
            os._exit(0)

    def ask(self, *request: Any) -> Any:
        self.requests.send(request)
        return self.requests.recv()

    def chosen(self, module: str, keys: list[Key]) -> list[str]:
        """Tests that enter one of these functions, nearest first, then others of the nearest files."""
        steps = importers(module)

        def distance(file: str) -> float:
            return steps.get(file, 99) + 0.5 * (not file.startswith(tests_folder(module)))

        first = order(self.ask("tests_of", keys), distance, self.times_s, BUDGET_S)
        rest = [
            name
            for name in self.times_s
            if name not in set(first) and distance(name.split("::")[0]) < 4
        ]
        return first + order(
            rest, distance, self.times_s, OTHERS_S - sum(self.times_s[name] for name in first)
        )


def record(files: list[str]) -> dict[str, Any]:
    """Run the tests of files that are new or changed since the last call; this fills numba's cache, too."""
    old = (
        json.loads(BASELINE.read_text())
        if BASELINE.exists()
        else {"digests": {}, "imported": [], "tests": {}}
    )
    digests = {file: hashlib.sha1((TREE / file).read_bytes()).hexdigest() for file in files}
    changed = [file for file in files if old["digests"].get(file) != digests[file]]
    if not changed:
        return of_files(old, files)
    part = OUT / "part.json"
    part.unlink(missing_ok=True)
    forked(lambda: session(changed, Recorder(TREE, part)), 7200)
    new = json.loads(part.read_text())
    kept = {
        name: test
        for name, test in old["tests"].items()
        if name.split("::")[0] not in changed
    }
    if new["failed"]:
        print("left out, for they fail without a mutant:", *new["failed"], sep="\n  ")
    merged = {
        "digests": old["digests"] | digests,
        "imported": old["imported"] + new["imported"],
        "tests": kept | new["tests"],
    }
    BASELINE.write_text(json.dumps(merged))
    return of_files(merged, files)


def of_files(recorded: dict[str, Any], files: list[str]) -> dict[str, Any]:
    """What was recorded, of the tests in these files only."""
    tests = {
        name: test for name, test in recorded["tests"].items() if name.split("::")[0] in files
    }
    return recorded | {"tests": tests}


def session(words: list[str], plugin: Any) -> str:
    """Run pytest in the copy with one of the two plugins."""
    os.chdir(TREE)
    code = pytest.main([*OPTIONS, f"--basetemp={OUT / 'tmp'}", *words], plugins=[plugin])
    return f"exit code {code}"


def environment() -> dict[str, str]:
    """One thread, the tree's packages and its cache of compiled code."""
    threads = {
        name: "1"
        for name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PYTHONDONTWRITEBYTECODE")
    }
    return os.environ | threads | {"PYTHONPATH": str(TREE), "NUMBA_CACHE_DIR": str(CACHE)}


def forget(folder: Path, module: str) -> None:
    """Remove compiled code of a module and of all modules that import it.

    Numba notices a change of the file where a function is; not of the functions and constants that it took from
    other files.
    """
    for file in map(Path, importers(module)):
        for path in folder.glob(f"{file.parent.name}_*/{file.stem}.*"):
            path.unlink()


def function_at(source: str, at: tuple[int, int]) -> ast.FunctionDef | None:
    """The function, not one within another, whose body is at a place; None for the module's and a class's own lines."""
    nodes: list[Any] = [ast.parse(source)]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.FunctionDef):
            begin = node.body[0]
            end = (node.end_lineno, node.end_col_offset)
            if (begin.lineno, begin.col_offset) <= at < end:
                return node
        elif isinstance(node, ast.Module | ast.ClassDef | ast.If):
            nodes += node.body
    return None


def first_line(function: ast.FunctionDef) -> int:
    return min([function.lineno, *(one.lineno for one in function.decorator_list)])


def functions_in(file: str, source: str) -> list[Key]:
    nodes = (
        node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)
    )
    return [(file, first_line(node), node.name) for node in nodes]


def code_of(source: str, path: Path, function: ast.FunctionDef) -> tuple[Key, CodeType]:
    """A function's code when the module's source is compiled, and its key."""
    first = first_line(function)
    module = compile(source, str(path), "exec", dont_inherit=True)
    code = next(
        one
        for one in nested(module)
        if (one.co_firstlineno, one.co_name) == (first, function.name)
    )
    return (str(path.relative_to(TREE)), first, function.name), code


def scratch_cache(module: str) -> None:
    """A copy of the cache without what the change of a module outdates, for processes that import it anew."""
    shutil.rmtree(SCRATCH, ignore_errors=True)
    shutil.copytree(CACHE, SCRATCH, copy_function=os.link)
    forget(SCRATCH, module)


def try_module(names: list[str], tests: Tests) -> str:
    """Outcome of tests in a process that imports all of the packages anew: the change is in no function's body."""

    class Chosen:
        def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
            by_name = {item.nodeid: item for item in items}
            items[:] = [by_name[name] for name in names if name in by_name]

        def pytest_collectreport(self, report: pytest.CollectReport) -> None:
            if report.failed:
                outcomes.append(report.nodeid)

        def pytest_runtest_logstart(self, nodeid: str) -> None:
            signal.setitimer(signal.ITIMER_PROF, limit_s(tests.times_s[nodeid]))

        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                outcomes.append(report.nodeid)

    outcomes: list[str] = []
    numba.config.CACHE_DIR = str(SCRATCH)
    signal.setitimer(signal.ITIMER_PROF, 200)
    said = session(["-x", *dict.fromkeys(name.split("::")[0] for name in names)], Chosen())
    return (
        outcomes[0]
        if outcomes
        else "survived"
        if said == "exit code 0"
        else f"{BROKEN} {said}"
    )


def try_mutant(mutant: dict[str, Any], tests: Tests) -> dict[str, Any]:
    """Test one mutant; the module is put back, with the time stamp that compiled code is kept for."""
    path = TREE / mutant["file"]
    began_s = time.monotonic()
    source = path.read_text()
    stamp_ns = path.stat().st_mtime_ns
    changed = source if CONTROL else mutated(source, mutant)
    lines = zip(source.splitlines(), changed.splitlines(), strict=False)
    old, new = next((pair for pair in lines if len(set(pair)) > 1), ("", ""))
    function = function_at(source, (mutant["line"], mutant["column"]))
    outcome = "import anew"
    scratch_cache(mutant["file"])
    try:
        path.write_text(changed)
        if function and code_of(source, path, function)[0] not in tests.imported:
            key, code = code_of(changed, path, function)
            names = tests.chosen(mutant["file"], [key])
            outcome = tests.ask("try_code", key, marshal.dumps(code), names, SCRATCH)
        if outcome == "import anew":
            function = None
            names = tests.chosen(mutant["file"], functions_in(mutant["file"], source))
            outcome = forked(lambda: try_module(names, tests))
    finally:
        path.write_text(source)
        os.utime(path, ns=(stamp_ns, stamp_ns))
    if not names:  # only long tests enter the function
        outcome = "survived"
    if outcome.startswith(BROKEN):
        raise SystemExit(f"{mutant}: {outcome}, {len(names)} tests")
    facts = {
        "old": old.strip(),
        "new": new.strip(),
        "outcome": outcome,
        "tests": len(names),
        "fresh": function is None,
    }
    return mutant | facts | {"seconds": round(time.monotonic() - began_s, 1)}


def use_copy() -> None:
    """Import the packages and the tests from the copy; only this program stays that of the checkout."""
    for name in list(sys.modules):
        package, _, rest = name.partition(".")
        if (
            package in ("benchmarks", "skysim", "estimator", "tests")
            and rest.partition(".")[0] != "mutants"
        ):
            del sys.modules[name]
    sys.path.insert(0, str(TREE))
    importlib.invalidate_caches()  # Python remembers that the copy's folder did not exist when it started


def copy_tree() -> None:
    """Bring the copy up to date; unchanged files keep their time stamps, for which numba keeps compiled code."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    changed = []
    for name in filter(None, listed.split("\0")):
        source = ROOT / name
        copy = TREE / name
        if not copy.exists() or copy.read_bytes() != source.read_bytes():
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, copy)
            if source.suffix == ".py" and not name.startswith("tests"):
                changed.append(name)
    for (
        name
    ) in changed:  # once all are there: who imports whom is read from the copy, and kept
        forget(CACHE, name)


def key_of(mutant: dict[str, Any]) -> tuple[Any, ...]:
    return mutant["file"], mutant["line"], mutant["column"], *mutant["how"]


def main() -> None:
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    numbers = [word for word in words if word.isdecimal()]
    count, seed = (int(word) for word in (numbers + ["300", "1"][len(numbers) :]))
    given = sorted({word.rstrip("/") for word in words if not word.isdecimal()})
    if os.environ.get("NUMBA_CACHE_DIR") != str(CACHE):  # before any import reads them
        os.execve(
            sys.executable,
            [sys.executable, "-m", "tests.mutants", *sys.argv[1:]],
            environment(),
        )
    OUT.mkdir(parents=True, exist_ok=True)
    copy_tree()
    use_copy()
    digest = hashlib.sha1(" ".join(given).encode()).hexdigest()[:6]
    results = OUT / f"{seed}{f'-{digest}' * bool(given)}{CONTROL}.jsonl"
    modules = modules_of(given or PACKAGES)
    tests = Tests(test_files(modules, nearest=bool(given)))
    drawn = draw(modules, count, seed)
    lines = results.read_text().splitlines() if results.exists() else []
    # Of a mutant that was tried again, the last.
    done = {key_of(result): result for result in map(json.loads, lines)}
    survivors = [result for result in done.values() if result["outcome"] == "survived"]
    left = [mutant for mutant in drawn if key_of(mutant) not in done]
    for mutant in survivors if "--again" in sys.argv else left:
        result = done[key_of(mutant)] = try_mutant(mutant, tests)
        with results.open("a") as file:
            file.write(json.dumps(result) + "\n")
        survived = sum(each["outcome"] == "survived" for each in done.values())
        print(
            f"{len(done)} tried, {len(done) - survived} killed; {result['file']}:{result['line']}",
            end=" ",
        )
        print(
            f"{result['old']!r} -> {result['new']!r}: {result['outcome']} ({result['seconds']} s)",
            flush=True,
        )
    for result in done.values():
        if result["outcome"] == "survived":
            print(
                f"survived: {result['file']}:{result['line']}\n  - {result['old']}\n  + {result['new']}"
            )
    killed = sum(each["outcome"] != "survived" for each in done.values())
    print(f"{killed} of {len(done)} killed, {100 * killed / max(len(done), 1):.1f} %")


if __name__ == "__main__":
    main()
