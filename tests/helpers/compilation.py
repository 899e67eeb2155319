"""Fill numba's cache before tests: `python -m tests.helpers.compilation [--basic]`, in two processes at once.

One process begins with the identification of stars, the other with the renderer. What two steps of a process need is
compiled by the first. The basic steps are those of `make test` in a fresh clone: what most tests need. All steps run
once in CI, beside other work: most of what the slow tests need, too.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, TimeElapsedColumn

from skysim.core.paths import ROOT

POLL_S = 0.5
Step = Sequence[str]  # words after `python -m`; {folder} is a temporary folder
IDENTIFY = "skysim.simulation.compilation"
FRAME = ("--frames", "1", "--out", "{folder}")
ALGORITHMS = ("tests.helpers.compilation", "--algorithms")  # and stages
BLIND = ("skysim", "solve", "{folder}/frame_0000.png")
BASIC: tuple[tuple[Step, ...], ...] = (
    (
        (IDENTIFY, "shefex2"),
        ("skysim", "render", "shefex2", *FRAME),
        ("skysim", "run", "shefex2", *FRAME),
        BLIND,
    ),
    (("skysim", "render", "afit_simsat", *FRAME), ("skysim", "run", "afit_simsat", *FRAME)),
)
# After the basic steps. Of the estimator: codes, and every algorithm that a setting can name.
# Of skysim: motion under control and a gyro, a second camera, a panel of LEDs.
FURTHER: tuple[tuple[Step, ...], ...] = (
    ((*ALGORITHMS, "identifier"),),
    (
        (*ALGORITHMS, "detector", "centroider", "solver"),
        ("skysim", "run", "coded_spiral", *FRAME),
        ("skysim", "run", "simsat_cmg", *FRAME),
        ("skysim", "render", "two_heads", *FRAME),
        ("skysim", "render", "nps_tas2", *FRAME),
    ),
)


def compile_steps(steps: Sequence[Step], folder: Path, advance: Callable[[], None]) -> None:
    """Run the steps of one process in turn, and advance after each; the output appears only if one fails."""
    for words in steps:
        command = [sys.executable, "-m", *(word.format(folder=folder) for word in words)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
        advance()


def compile_algorithms(stages: Sequence[str]) -> None:
    """Solve one synthetic frame by every algorithm that a setting can name for these stages."""
    from estimator import Camera, StarTracker
    from estimator.attitude.solvers import SOLVERS
    from estimator.centroiding.centroid import CENTROIDERS
    from estimator.core.errors import ImageError
    from estimator.detection.detect import DETECTORS
    from estimator.identification.registry import IDENTIFIERS
    from estimator.trackers.pipeline import Settings

    camera = Camera.from_fov(640, 480, fov_deg=15)
    tables = {
        "detector": DETECTORS,
        "centroider": CENTROIDERS,
        "identifier": IDENTIFIERS,
        "solver": SOLVERS,
    }
    for stage in stages:
        for name in tables[stage]:
            tracker = StarTracker.for_sky(camera, settings=Settings(**{stage: name}))
            try:
                tracker.warm_up()
            except ImageError as error:
                print(f"{stage} {name}: {error}")


def main(words: Sequence[str]) -> None:
    """Compile the basic steps, or all, in as many processes as there are groups."""
    if words[:1] == ["--algorithms"]:
        compile_algorithms(words[1:])
        return
    groups = BASIC
    if "--basic" not in words:
        groups = tuple(basic + further for basic, further in zip(BASIC, FURTHER, strict=True))
    before = compiled_files()
    with (
        tempfile.TemporaryDirectory() as folder,
        ThreadPoolExecutor() as pool,
        Progress(
            *Progress.get_default_columns(),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            disable=not sys.stderr.isatty(),
        ) as bar,
    ):
        task = bar.add_task("", total=sum(map(len, groups)))
        done = []
        for n, steps in enumerate(groups):
            own_folder = Path(folder) / str(n)
            own_folder.mkdir()
            done.append(
                pool.submit(compile_steps, steps, own_folder, lambda: bar.advance(task))
            )
        while wait(done, POLL_S).not_done:
            text = f"{compiled_files() - before} functions compiled"
            bar.update(task, description=text)
        for group in done:
            group.result()


def compiled_files() -> int:
    """Number of functions in numba's cache: one file for each type of their arguments."""
    cache = os.environ.get("NUMBA_CACHE_DIR")
    folders = [Path(cache)] if cache else [ROOT / "skysim", ROOT / "estimator"]
    return sum(1 for folder in folders for _ in folder.rglob("*.nbc"))


if __name__ == "__main__":
    main(sys.argv[1:])
