"""Mutation score: the share of small changes of the code that the tests notice.

`python -m benchmarks.mutants [COUNT] [SEED] [--again]`. COUNT places are drawn uniformly from all that cosmic-ray's
operators can change in PACKAGES (numbers, operators, comparisons, conditions, loops), and one change of each. Left out
are type annotations, decorators, errors' messages (whole raise statements and f-strings) and __init__.py.

Every mutant is tested in a copy, out/mutants/tree: by the tests that import its module, then by those that import what
imports it and so on, as many as take BUDGET_S. It is killed if a test fails, or if they take more than three times as
long as without it. Results are added to out/mutants/SEED.jsonl, and a run that was stopped goes on. --again tries the
survivors of that file once more, after tests were added.
"""

from __future__ import annotations

import ast
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any
from xml.etree import ElementTree

import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code

ROOT = Path(__file__).parents[1]
OUT = ROOT / "out" / "mutants"
TREE, CACHE, SCRATCH, BASELINE = OUT / "tree", OUT / "cache", OUT / "scratch", OUT / "baseline.xml"
PACKAGES = {  # where the tests of each are
    "estimator": ("estimator",),
    "skysim/camera": ("camera",),
    "skysim/sources": ("sources",),
    "skysim/dynamics": ("dynamics",),
}
USERS = ("simulation", "tracking", "results")  # tests of the packages that use them
BUDGET_S = 90.0
# Operators that are left out: bits of floating-point numbers, which raise TypeError, so any test notices; decorators,
# which are the compiler's; and two that need arguments.
LEFT_OUT = re.compile(r"_(Bit\w+|LShift|RShift|Invert)$|Decorator|Variable")
NO_PLACE = ("decorator", "raise_stmt", "fstring", "import_from", "tfpdef")
PYTEST = ("-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not long and not browser")


def is_left_out(node: Any) -> bool:
    """Whether a parso node is in an annotation, a decorator, an error's message or an import."""
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
    found, tree = defaultdict(list), get_ast(module.read_text())
    for name in sorted(set(cosmic_ray.plugins.operator_names())):
        if LEFT_OUT.search(name):
            continue
        operator, occurrence = cosmic_ray.plugins.get_operator(name)(), 0
        for node in ast_nodes(tree):
            for begin, _ in operator.mutation_positions(node):
                if not is_left_out(node):
                    found[begin].append((name, occurrence))
                occurrence += 1
    return found


def draw(count: int, seed: int) -> list[dict[str, Any]]:
    """So many mutants, in random order."""
    modules = sorted(path for package in PACKAGES for path in (TREE / package).rglob("*.py"))
    every = [(path, at, how) for path in modules if path.name != "__init__.py" for at, how in places(path).items()]
    random = Random(seed)
    chosen = random.sample(every, min(count, len(every)))
    print(f"{len(every)} places in {len(modules)} modules; seed {seed}", flush=True)
    return [
        {"file": str(path.relative_to(TREE)), "line": at[0], "column": at[1], "how": random.choice(how)}
        for path, at, how in chosen
    ]


@cache
def imports(file: str) -> frozenset[str]:
    """Modules of the copy that a file of it imports; skysim and estimator themselves, which name all, left out."""
    names: set[str] = set()
    for node in ast.walk(ast.parse((TREE / file).read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    files = (name.replace(".", "/") + ending for name in names for ending in (".py", "/__init__.py"))
    return frozenset(file for file in files if file.count("/") > 1 and (TREE / file).exists())


def importers(module: str) -> dict[str, int]:
    """The module (0), the files that import it (1), those that import these (2), and so on; tests included."""
    files = [path for folder in (module.split("/")[0], "tests") for path in (TREE / folder).rglob("*.py")]
    direct = {name: imports(name) for name in (str(path.relative_to(TREE)) for path in files)}
    steps = {module: 0}
    while more := {name for name, used in direct.items() if name not in steps and used & steps.keys()}:
        steps |= dict.fromkeys(more, 1 + max(steps.values()))
    return steps


def test_times_s() -> Counter[str]:
    """Seconds that each file of tests takes without a mutant; the first call runs them and fills numba's cache."""
    folders = [TREE / "tests" / name for names in (*PACKAGES.values(), USERS) for name in names]
    if not BASELINE.exists():
        command = [sys.executable, *PYTEST, f"--junitxml={OUT / 'baseline.part'}", *map(str, folders)]
        subprocess.run(command, cwd=TREE, env=environment(CACHE), check=True)
        (OUT / "baseline.part").rename(BASELINE)
    times = Counter({str(path.relative_to(TREE)): 0.0 for folder in folders for path in folder.rglob("test_*.py")})
    for case in ElementTree.parse(BASELINE).iter("testcase"):
        times[case.get("classname", "").replace(".", "/") + ".py"] += float(case.get("time", 0))
    return times


def tests_of(module: str, times_s: Counter[str]) -> tuple[list[str], float]:
    """Files of tests for a module, those that import it in the fewest steps first, and the time that they take."""
    own = tuple(f"tests/{name}/" for package in PACKAGES if module.startswith(package) for name in PACKAGES[package])
    steps = importers(module)
    files, total_s = [], 0.0
    for file in sorted(times_s, key=lambda file: (steps.get(file, 99), not file.startswith(own), times_s[file])):
        if not files or total_s + times_s[file] <= BUDGET_S:
            files.append(file)
            total_s += times_s[file]
    return files, total_s


def environment(compiled: Path) -> dict[str, str]:
    """One thread, the tree's packages and this cache of compiled code."""
    threads = {name: "1" for name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PYTHONDONTWRITEBYTECODE")}
    return os.environ | threads | {"PYTHONPATH": str(TREE), "NUMBA_CACHE_DIR": str(compiled)}


def forget(folder: Path, module: str) -> None:
    """Remove compiled code of a module and of all modules that import it.

    Numba notices a change of the file where a function is; not of the functions and constants that it took from
    other files.
    """
    for file in map(Path, importers(module)):
        for path in folder.glob(f"{file.parent.name}_*/{file.stem}.*"):
            path.unlink()


def run_tests(files: list[str], limit_s: float) -> str:
    """`survived`, `timeout`, or the first test that fails. The limit is of processor time: the machine may be busy."""
    command = [sys.executable, *PYTEST, "--tb=no", *files]
    process = subprocess.Popen(
        command,
        cwd=TREE,
        env=environment(SCRATCH),
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=partial(resource.setrlimit, resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 5)),
    )
    try:
        said, _ = process.communicate(timeout=10 * limit_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "timeout"
    if process.returncode == -signal.SIGXCPU:
        return "timeout"
    if process.returncode in (4, 5):  # pytest's codes of a wrong command and of no tests
        raise SystemExit(said)
    lines = [line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return "survived" if process.returncode == 0 else (lines or [f"exit code {process.returncode}"])[0][:200]


def try_mutant(mutant: dict[str, Any], times_s: Counter[str]) -> dict[str, Any]:
    """Test one mutant; the module is put back, with the time stamp that compiled code is kept for."""
    path, began_s = TREE / mutant["file"], time.monotonic()
    source, stamp_ns = path.read_text(), path.stat().st_mtime_ns
    name, occurrence = mutant["how"]
    mutated = mutate_code(source, cosmic_ray.plugins.get_operator(name)(), occurrence)
    changed = next(pair for pair in zip(source.splitlines(), mutated.splitlines(), strict=False) if len(set(pair)) > 1)
    files, total_s = tests_of(mutant["file"], times_s)
    shutil.rmtree(SCRATCH, ignore_errors=True)
    shutil.copytree(CACHE, SCRATCH, copy_function=os.link)
    forget(SCRATCH, mutant["file"])
    try:
        path.write_text(mutated)
        outcome = run_tests(files, 120 + 3 * total_s)
    finally:
        path.write_text(source)
        os.utime(path, ns=(stamp_ns, stamp_ns))
    old, new = (line.strip() for line in changed)
    return mutant | {"old": old, "new": new, "outcome": outcome, "seconds": round(time.monotonic() - began_s)}


def copy_tree() -> None:
    """Bring the copy up to date; unchanged files keep their time stamps, for which numba keeps compiled code."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in filter(None, listed.split("\0")):
        source, copy = ROOT / name, TREE / name
        if not copy.exists() or copy.read_bytes() != source.read_bytes():
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, copy)
            if source.suffix == ".py" and not name.startswith("tests"):
                forget(CACHE, name)


def key_of(mutant: dict[str, Any]) -> tuple[Any, ...]:
    return mutant["file"], mutant["line"], mutant["column"], *mutant["how"]


def main() -> None:
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    count, seed = (int(word) for word in (words + ["300", "1"][len(words) :]))
    OUT.mkdir(parents=True, exist_ok=True)
    copy_tree()
    results, times_s, drawn = OUT / f"{seed}.jsonl", test_times_s(), draw(count, seed)
    lines = results.read_text().splitlines() if results.exists() else []
    done = {key_of(result): result for result in map(json.loads, lines)}  # of a mutant that was tried again, the last
    survivors = [result for result in done.values() if result["outcome"] == "survived"]
    left = [mutant for mutant in drawn if key_of(mutant) not in done]
    for mutant in survivors if "--again" in sys.argv else left:
        result = done[key_of(mutant)] = try_mutant(mutant, times_s)
        with results.open("a") as file:
            file.write(json.dumps(result) + "\n")
        survived = sum(each["outcome"] == "survived" for each in done.values())
        print(f"{len(done)} tried, {len(done) - survived} killed; {result['file']}:{result['line']}", end=" ")
        print(f"{result['old']!r} -> {result['new']!r}: {result['outcome']} ({result['seconds']} s)", flush=True)
    for result in done.values():
        if result["outcome"] == "survived":
            print(f"survived: {result['file']}:{result['line']}\n  - {result['old']}\n  + {result['new']}")
    killed = sum(each["outcome"] != "survived" for each in done.values())
    print(f"{killed} of {len(done)} killed, {100 * killed / max(len(done), 1):.1f} %")


if __name__ == "__main__":
    main()
