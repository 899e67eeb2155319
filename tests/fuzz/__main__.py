"""`python -m tests.fuzz SECONDS [TARGET ...] [--plain]`: fuzz the targets, each for an equal share of the time.

Exit code 1 if there is a finding. Fuzzing is guided by coverage (atheris, libFuzzer) if atheris is installed;
otherwise, or with --plain, the corpus is only mutated at random. Seeds are tests/fuzz/corpus/, files that skysim
ships, and (guided) the inputs that earlier runs have added in out/fuzz/. Findings are kept in out/fuzz/; after the bug
is fixed, the file goes into tests/fuzz/corpus/, which the tests read too.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from hashlib import sha256
from pathlib import Path
from random import Random
from types import FunctionType, ModuleType

ROOT = Path(__file__).resolve().parents[2]
CORPUS = Path(__file__).parent / "corpus"
OUT = ROOT / "out" / "fuzz"
TIME_LIMIT_S = 10
MEMORY_LIMIT_MB = 3000
# Targets, and the shipped files that are seeds of each.
TARGETS = {
    "scenes": ("scenes/*.yaml", "data/cameras/*.yaml"),
    "studies": (),
    "overrides": (),
    "fits": (),
    "pictures": (),
    "catalogs": (),
    "maps": (),
    "truths": (),
    "calibrations": (),
    "tables": ("data/qe/*.csv",),
    "vehicles": ("scenes/vehicles/*.xml",),
    "stores": (),
    "answers": (),
    "profiles": (),
    "orbits": (),
    "torques": (),
    "packets": (),
    "commands": (),
    "poses": (),
    "datagrams": (),
    "gvsp": (),
    "genicam": (),
    "quantities": (),
}
NAMES = tuple(TARGETS)
# Instrumented for coverage: whole packages, and of astropy only the modules that read files (all would take 30 s).
INSTRUMENTED_PACKAGES = ["skysim", "estimator", "yaml", "json"]
INSTRUMENTED_MODULES = ("astropy.io.ascii.", "astropy.io.fits.", "astropy.table.")
TOKENS = (
    b"[",
    b"{",
    b"&a ",
    b"*a",
    b"\n",
    b": ",
    b"- ",
    b"!!int ",
    b"9" * 40,
    b"-1",
    b".nan",
    b"\0",
    b"\xff",
    b"1e999",
)


def shipped_files(name: str) -> list[Path]:
    """Shipped files that are seeds of a target."""
    return [path for glob in TARGETS[name] for path in sorted(ROOT.glob(glob))]


def seeds(name: str) -> list[bytes]:
    """All seeds of a target: corpus and shipped files."""
    return [
        path.read_bytes()
        for path in (*sorted((CORPUS / name).iterdir()), *shipped_files(name))
    ]


def write_dictionary(name: str) -> Path:
    """Write libFuzzer's dictionary for a target (words of its seeds and schemas, and TOKENS) and return its path."""
    schemas = {
        "scenes": ("scene",),
        "overrides": ("scene",),
        "studies": ("scene", "study"),
    }.get(name, ())
    texts = [
        *seeds(name),
        *((ROOT / f"data/schema/{schema}.json").read_bytes() for schema in schemas),
    ]
    words = {word for text in texts for word in re.findall(rb"[A-Za-z_][\w-]{2,40}", text)}
    path = OUT / f"{name}.dict"
    entries = [
        "".join(f"\\x{byte:02x}" for byte in word) for word in sorted(words.union(TOKENS))
    ]
    path.write_text("".join(f'"{word}"\n' for word in entries))
    return path


def mutate(seed: bytes, others: list[bytes], rng: Random) -> bytes:
    """Apply 1 to 6 random mutations to a seed: change, delete or duplicate bytes, insert tokens or parts of another."""
    data = bytearray(seed)
    for _ in range(rng.randint(1, 6)):
        start = rng.randrange(len(data) + 1)
        stop = min(start + rng.choice((1, 2, 8, 40)), len(data))
        match rng.randrange(6):
            case 0 if start < len(data):
                data[start] = rng.randrange(256)
            case 1:
                del data[start:stop]
            case 2:
                data[start:start] = data[start:stop]
            case 3:
                data[start:stop] = rng.choice(TOKENS)
            case 4:
                other = rng.choice(others)
                begin = rng.randrange(len(other) + 1)
                data[start:stop] = other[begin : begin + rng.choice((4, 30))]
            case _:
                data[start:start] = rng.choice(TOKENS)
    return bytes(data)


def run_timed(target: Callable[[bytes], None], data: bytes) -> None:
    """Run a target. Raises AssertionError above SLOWEST_S of CPU time, which other load does not lengthen."""
    start_s = time.process_time()
    target(data)
    if (cpu_s := time.process_time() - start_s) > TIME_LIMIT_S:
        raise AssertionError(f"{cpu_s:.1f} s")


def fuzz_by_mutation(name: str, seconds: float, seed: int = 1) -> int:
    """Fuzz a target by random mutation only; return the number of findings."""
    from tests.fuzz.targets import TARGETS

    rng = Random(seed)
    corpus = seeds(name)
    end_s = time.monotonic() + seconds
    findings = 0
    tries = 0
    while time.monotonic() < end_s:
        # First every seed unchanged, then mutations of random seeds.
        data = (
            corpus[tries] if tries < len(corpus) else mutate(rng.choice(corpus), corpus, rng)
        )
        tries += 1
        try:
            run_timed(TARGETS[name], data)
        except Exception:
            findings += 1
            path = OUT / f"{name}-{sha256(data).hexdigest()[:12]}"
            path.write_bytes(data)
            print(f"{name}: {path}\n{traceback.format_exc()}", flush=True)
    print(f"{name}: {tries} files, {findings} findings", flush=True)
    return findings


def fuzz_by_coverage(names: list[str], seconds_each: float) -> int:
    """Fuzz with libFuzzer; return the number of targets with a finding.

    libFuzzer ends its process itself, so each target runs in a forked child.
    """
    import atheris

    with atheris.instrument_imports(INSTRUMENTED_PACKAGES, exclude=compiled_modules()):
        from tests.fuzz.targets import TARGETS

        for name in names:
            for path in (
                CORPUS / name
            ).iterdir():  # imports on first use must be instrumented too
                with suppress(Exception):
                    TARGETS[name](path.read_bytes())
    for name, module in sorted(sys.modules.items()):
        if name.startswith(INSTRUMENTED_MODULES):
            for function in functions_of(module):
                atheris.instrument_func(function)
    findings = 0
    for name in names:
        grown_corpus = OUT / f"{name}-grown"
        grown_corpus.mkdir(exist_ok=True)
        for path in shipped_files(name):
            (grown_corpus / f"shipped-{path.name}").write_bytes(path.read_bytes())
        limits = [
            f"-max_total_time={max(round(seconds_each), 1)}",
            f"-timeout={12 * TIME_LIMIT_S}",
            f"-rss_limit_mb={MEMORY_LIMIT_MB}",
        ]
        files = [f"-dict={write_dictionary(name)}", f"-artifact_prefix={OUT / name}-"]
        output = ["-verbosity=0", "-print_final_stats=1"]
        arguments = [name, *limits, *files, *output, str(grown_corpus), str(CORPUS / name)]
        exit_code = run_forked(partial(run_libfuzzer, TARGETS[name], arguments))
        print(
            f"{name}: {f'finding, exit code {exit_code}' if exit_code else 'no finding'}",
            flush=True,
        )
        findings += exit_code != 0
    return findings


def compiled_modules() -> list[str]:
    """Names of the modules with compiled functions: numba can't read bytecode that is instrumented."""
    files = [
        path for package in ("skysim", "estimator") for path in (ROOT / package).rglob("*.py")
    ]
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in files
        if re.search(r"^\s*@(jit|inlined|loop)", path.read_text(), re.MULTILINE)
    ]


def functions_of(module: ModuleType) -> Iterator[FunctionType]:
    """Functions of a module and methods of its classes."""
    for member in vars(module).values():
        for function in vars(member).values() if isinstance(member, type) else [member]:
            if isinstance(function, FunctionType) and function.__module__ == module.__name__:
                yield function


def run_libfuzzer(target: Callable[[bytes], None], arguments: list[str]) -> None:
    """Run libFuzzer on a target; does not return."""
    import atheris

    atheris.Setup(arguments, partial(run_timed, target))
    atheris.Fuzz()


def run_forked(task: Callable[[], None]) -> int:
    """Run `task` in a forked process and return its exit code."""
    sys.stdout.flush()
    if (pid := os.fork()) == 0:
        task()  # libFuzzer writes its findings when the interpreter exits
        sys.exit()
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def main() -> int:
    """Fuzz the requested targets one after another; return the exit code."""
    arguments = [word for word in sys.argv[1:] if not word.startswith("-")]
    seconds = float(arguments[0]) if arguments else 60.0
    names = arguments[1:] or list(NAMES)
    OUT.mkdir(parents=True, exist_ok=True)
    seconds_each = seconds / len(names)
    if "--plain" in sys.argv or importlib.util.find_spec("atheris") is None:
        print(
            "Fuzzing by random mutation; the extra `fuzz` (atheris) adds coverage guidance.",
            flush=True,
        )
        findings = sum([fuzz_by_mutation(name, seconds_each) for name in names])
    else:
        findings = fuzz_by_coverage(names, seconds_each)
    print(f"{len(names)} targets, {findings} findings", flush=True)
    return int(findings > 0)


if __name__ == "__main__":
    sys.exit(main())
