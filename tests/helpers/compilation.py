"""Fill numba's cache before tests: `python -m tests.helpers.compilation [--basic]`, in two processes at once.

skysim and the estimator call no compiled function of each other, so one process for each compiles nothing twice. What
two steps of a process need is compiled by the first. The basic steps are those of `make test` in a fresh clone: what
most tests need. All steps run once in CI, beside other work: most of what the slow tests need, too.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from skysim.core.paths import ROOT

Step = Sequence[str]  # words after `python -m`; {folder} is a temporary folder
TRACKER = "skysim.simulation.compilation"
FRAME = ("--frames", "1", "--out", "{folder}")
BLIND = ("skysim", "solve", "{folder}/frame_0000.png")
BASIC: tuple[tuple[Step, ...], ...] = (
    ((TRACKER, "shefex2"), ("skysim", "render", "shefex2", *FRAME), BLIND),
    (("skysim", "render", "afit_simsat", *FRAME), (TRACKER, "afit_simsat")),
)
# After the basic steps. Of the estimator: codes, and every algorithm that a setting can name.
# Of skysim: motion under control and a gyro, a second camera, a panel of LEDs.
FURTHER: tuple[tuple[Step, ...], ...] = (
    ((TRACKER, "coded_spiral"), ("tests.helpers.compilation", "--algorithms")),
    (
        ("skysim", "run", "simsat_cmg", *FRAME),
        ("skysim", "render", "two_heads", *FRAME),
        ("skysim", "render", "nps_tas2", *FRAME),
    ),
)


def compile_steps(steps: Sequence[Step], folder: Path) -> None:
    """Run the steps of one process in turn; the output appears only if one fails."""
    for words in steps:
        command = [sys.executable, "-m", *(word.format(folder=folder) for word in words)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}\n{done.stdout}{done.stderr}")


def compile_algorithms() -> None:
    """Solve one synthetic frame by every algorithm that a setting can name, and search an LED layout."""
    from estimator import Camera, StarTracker
    from estimator.attitude.solvers import SOLVERS
    from estimator.centroiding.centroid import CENTROIDERS
    from estimator.core.errors import ImageError
    from estimator.detection.detect import DETECTORS
    from estimator.identification.registry import IDENTIFIERS
    from estimator.trackers.pipeline import Settings

    camera = Camera.from_fov(640, 480, fov_deg=15)
    for stage, names in (
        ("detector", DETECTORS),
        ("centroider", CENTROIDERS),
        ("identifier", IDENTIFIERS),
        ("solver", SOLVERS),
    ):
        for name in names:
            tracker = StarTracker.for_sky(camera, settings=Settings(**{stage: name}))
            try:
                tracker.warm_up()
            except ImageError as error:
                print(f"{stage} {name}: {error}")


def main(words: Sequence[str]) -> None:
    """Compile the basic steps, or all, in as many processes as there are groups."""
    if "--algorithms" in words:
        compile_algorithms()
        return
    groups = BASIC
    if "--basic" not in words:
        groups = tuple(basic + further for basic, further in zip(BASIC, FURTHER, strict=True))
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as pool:
        done = []
        for n, steps in enumerate(groups):
            own_folder = Path(folder) / str(n)
            own_folder.mkdir()
            done.append(pool.submit(compile_steps, steps, own_folder))
        for group in done:
            group.result()


if __name__ == "__main__":
    main(sys.argv[1:])
