"""`python -m fuzz SECONDS [TARGET ...] [--plain]`: every target for its share of the time; exit code 1 for a finding.

Guided by coverage (atheris, libFuzzer) where that is installed; else, or with --plain, by nothing but mutation of the
corpus. What is found is kept in out/fuzz/; once it is mended it goes into fuzz/corpus/, which the tests read too.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import time
import traceback
from hashlib import sha256
from pathlib import Path
from random import Random

HERE = Path(__file__).parent
CORPUS, OUT = HERE / "corpus", HERE.parent / "out" / "fuzz"
SLOWEST_S, MOST_MB = 10, 3000
NAMES = ("scenes", "studies", "overrides", "fits", "pictures", "catalogues", "maps", "quantities")
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


def seeds(name: str) -> list[bytes]:
    """The corpus of a target."""
    return [path.read_bytes() for path in sorted((CORPUS / name).iterdir())]


def mutated(seed: bytes, others: list[bytes], rng: Random) -> bytes:
    """A seed with a few bytes changed, cut, doubled, or taken from another."""
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


def plainly(name: str, seconds: float, seed: int = 1) -> int:
    """Mutation alone: how many findings."""
    from fuzz.targets import TARGETS

    rng, corpus, end, findings, tries = Random(seed), seeds(name), time.monotonic() + seconds, 0, 0
    while time.monotonic() < end:
        data = corpus[tries] if tries < len(corpus) else mutated(rng.choice(corpus), corpus, rng)
        tries += 1
        begin = time.process_time()
        try:
            TARGETS[name](data)
            if (took_s := time.process_time() - begin) > SLOWEST_S:
                raise AssertionError(f"{took_s:.1f} s")
        except Exception:
            findings += 1
            kept = OUT / f"{name}-{sha256(data).hexdigest()[:12]}"
            kept.write_bytes(data)
            print(f"{name}: {kept}\n{traceback.format_exc()}", flush=True)
    print(f"{name}: {tries} files, {findings} findings", flush=True)
    return findings


def guided(name: str) -> None:
    """libFuzzer with the rest of the command line; it ends the process itself."""
    import atheris

    with atheris.instrument_imports(include=["skysim", "estimator", "yaml"]):
        from fuzz.targets import TARGETS

    atheris.Setup(sys.argv, TARGETS[name])
    atheris.Fuzz()


def main() -> int:
    """Each target in a process of its own, so that one that dies is one finding."""
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    if words and words[0] in NAMES:
        sys.argv = sys.argv[1:]  # called by ourselves: TARGET libFuzzer's words
        guided(words[0])
    seconds, names = float(words[0]) if words else 60.0, words[1:] or list(NAMES)
    OUT.mkdir(parents=True, exist_ok=True)
    share = seconds / len(names)
    if "--plain" in sys.argv or importlib.util.find_spec("atheris") is None:
        return int(sum([plainly(name, share) for name in names]) > 0)
    worst = 0
    for name in names:
        grown = OUT / f"{name}-grown"
        grown.mkdir(exist_ok=True)
        limits = [
            f"-max_total_time={max(round(share), 1)}",
            f"-timeout={SLOWEST_S}",
            f"-rss_limit_mb={MOST_MB}",
        ]
        quiet = ["-verbosity=0", "-print_final_stats=1", f"-artifact_prefix={OUT / name}-"]
        call = [sys.executable, "-m", "fuzz", name, *limits, *quiet, str(grown), str(CORPUS / name)]
        code = subprocess.run(call, check=False).returncode
        print(f"{name}: {'nothing found' if code == 0 else f'FOUND, exit code {code}'}", flush=True)
        worst = max(worst, abs(code))
    return int(worst > 0)


if __name__ == "__main__":
    sys.exit(main())
