"""`python -m fuzz SECONDS [TARGET ...] [--plain]`: fuzz the targets, each for an equal share of the time.

Exit code 1 if there is a finding. Fuzzing is guided by coverage (atheris, libFuzzer) if atheris is installed;
otherwise, or with --plain, the corpus is only mutated at random. Seeds are fuzz/corpus/, files that skysim ships, and
(guided) the inputs that earlier runs have added in out/fuzz/. Findings are kept in out/fuzz/; after the bug is fixed,
the file goes into fuzz/corpus/, which the tests read too.
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

HERE = Path(__file__).parent
CORPUS, OUT = HERE / "corpus", HERE.parent / "out" / "fuzz"
SLOWEST_S, MOST_MB = 10, 3000
# Targets, and the shipped files that are seeds of each.
TARGETS = {
    "scenes": ("scenes/*.yaml", "data/cameras/*.yaml"),
    "studies": (),
    "overrides": (),
    "fits": (),
    "pictures": (),
    "catalogues": (),
    "maps": (),
    "truths": (),
    "calibrations": (),
    "tables": ("data/qe/*.csv",),
    "vehicles": ("scenes/vehicles/*.xml",),
    "stores": (),
    "answers": (),
    "packets": (),
    "quantities": (),
}
NAMES = tuple(TARGETS)
# Instrumented for coverage: whole packages, and of astropy only the modules that read files (all would take 30 s).
GUIDES = ["skysim", "estimator", "yaml", "json"]
PARTS = ("astropy.io.ascii.", "astropy.io.fits.", "astropy.table.")
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


def shipped(name: str) -> list[Path]:
    """Shipped files that are seeds of a target."""
    return [path for glob in TARGETS[name] for path in sorted(HERE.parent.glob(glob))]


def seeds(name: str) -> list[bytes]:
    """All seeds of a target: corpus and shipped files."""
    return [path.read_bytes() for path in (*sorted((CORPUS / name).iterdir()), *shipped(name))]


def dictionary(name: str) -> Path:
    """Write libFuzzer's dictionary for a target (words of its seeds and schemas, and TOKENS) and return its path."""
    schemas = {"scenes": ("scene",), "overrides": ("scene",), "studies": ("scene", "study")}.get(name, ())
    texts = [*seeds(name), *((HERE.parent / f"data/schema/{one}.json").read_bytes() for one in schemas)]
    found = {word for text in texts for word in re.findall(rb"[A-Za-z_][\w-]{2,40}", text)}
    path = OUT / f"{name}.dict"
    told = ["".join(f"\\x{byte:02x}" for byte in word) for word in sorted(found.union(TOKENS))]
    path.write_text("".join(f'"{word}"\n' for word in told))
    return path


def mutated(seed: bytes, others: list[bytes], rng: Random) -> bytes:
    """Apply 1 to 6 random mutations to a seed: change, delete or duplicate bytes, insert tokens or parts of another."""
    data = bytearray(seed)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(data) + 1)
        to = min(at + rng.choice((1, 2, 8, 40)), len(data))
        match rng.randrange(6):
            case 0 if at < len(data):
                data[at] = rng.randrange(256)
            case 1:
                del data[at:to]
            case 2:
                data[at:at] = data[at:to]
            case 3:
                data[at:to] = rng.choice(TOKENS)
            case 4:
                other = rng.choice(others)
                begin = rng.randrange(len(other) + 1)
                data[at:to] = other[begin : begin + rng.choice((4, 30))]
            case _:
                data[at:at] = rng.choice(TOKENS)
    return bytes(data)


def timed(target: Callable[[bytes], None], data: bytes) -> None:
    """Run a target. Raises AssertionError above SLOWEST_S of CPU time, which other load does not lengthen."""
    begin = time.process_time()
    target(data)
    if (took_s := time.process_time() - begin) > SLOWEST_S:
        raise AssertionError(f"{took_s:.1f} s")


def plainly(name: str, seconds: float, seed: int = 1) -> int:
    """Fuzz a target by random mutation only; return the number of findings."""
    from fuzz.targets import TARGETS

    rng, corpus, end, findings, tries = Random(seed), seeds(name), time.monotonic() + seconds, 0, 0
    while time.monotonic() < end:
        # First every seed unchanged, then mutations of random seeds.
        data = corpus[tries] if tries < len(corpus) else mutated(rng.choice(corpus), corpus, rng)
        tries += 1
        try:
            timed(TARGETS[name], data)
        except Exception:
            findings += 1
            kept = OUT / f"{name}-{sha256(data).hexdigest()[:12]}"
            kept.write_bytes(data)
            print(f"{name}: {kept}\n{traceback.format_exc()}", flush=True)
    print(f"{name}: {tries} files, {findings} findings", flush=True)
    return findings


def guided(names: list[str], share_s: float) -> int:
    """Fuzz with libFuzzer; return the number of targets with a finding.

    libFuzzer ends its process itself, so each target runs in a forked child.
    """
    import atheris

    with atheris.instrument_imports(include=GUIDES):
        from fuzz.targets import TARGETS

        for name in names:
            for path in (CORPUS / name).iterdir():  # imports on first use must be instrumented too
                with suppress(Exception):
                    TARGETS[name](path.read_bytes())
    for name, module in sorted(sys.modules.items()):
        if name.startswith(PARTS):
            for one in functions(module):
                atheris.instrument_func(one)
    found = 0
    for name in names:
        grown = OUT / f"{name}-grown"
        grown.mkdir(exist_ok=True)
        for path in shipped(name):
            (grown / f"shipped-{path.name}").write_bytes(path.read_bytes())
        limits = [
            f"-max_total_time={max(round(share_s), 1)}",
            f"-timeout={12 * SLOWEST_S}",
            f"-rss_limit_mb={MOST_MB}",
        ]
        told = [f"-dict={dictionary(name)}", f"-artifact_prefix={OUT / name}-"]
        quiet = ["-verbosity=0", "-print_final_stats=1"]
        code = alone(
            partial(fuzzed, TARGETS[name], [name, *limits, *told, *quiet, str(grown), str(CORPUS / name)])
        )
        print(f"{name}: {'nothing found' if code == 0 else f'FOUND, exit code {code}'}", flush=True)
        found += code != 0
    return found


def functions(module: ModuleType) -> Iterator[FunctionType]:
    """Functions of a module and methods of its classes."""
    for one in vars(module).values():
        for inner in vars(one).values() if isinstance(one, type) else [one]:
            if isinstance(inner, FunctionType) and inner.__module__ == module.__name__:
                yield inner


def fuzzed(target: Callable[[bytes], None], words: list[str]) -> None:
    """Run libFuzzer on a target; does not return."""
    import atheris

    atheris.Setup(words, partial(timed, target))
    atheris.Fuzz()


def alone(work: Callable[[], None]) -> int:
    """Run `work` in a forked process and return its exit code."""
    sys.stdout.flush()
    if (child := os.fork()) == 0:
        work()  # libFuzzer writes its findings when the interpreter exits
        sys.exit()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def main() -> int:
    """Fuzz the requested targets one after another; return the exit code."""
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    seconds, names = float(words[0]) if words else 60.0, words[1:] or list(NAMES)
    OUT.mkdir(parents=True, exist_ok=True)
    share_s = seconds / len(names)
    if "--plain" in sys.argv or importlib.util.find_spec("atheris") is None:
        print("By mutation alone; the extra `fuzz` (atheris) has it guided by coverage.", flush=True)
        return int(sum([plainly(name, share_s) for name in names]) > 0)
    return int(guided(names, share_s) > 0)


if __name__ == "__main__":
    sys.exit(main())
