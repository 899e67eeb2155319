"""`python -m tests.fuzz.campaign COUNT [--seed N] [--workers N] [--only READER,...] [--case READER:NUMBER]`.

Wrong files of every kind, given to the commands that read them, as a user would. Each input is a shipped or recorded
file with one mutation that knows its structure (`tests.fuzz.mutations`), in a folder of its own. The command runs in
a fork of a process that has all imports, with 20 s of processor time and 2 GB of memory. A finding is

- a traceback, a crash, a time-out, or too much memory;
- a refusal of other than one line, or of more than 1,000 characters, or in the words of a library;
- a line on stderr that is not skysim's own (a warning of NumPy, a message of ffmpeg);
- a file that no reader may take and that is taken, and a result that is no number: nonsense without a word;
- in a list or table, a refusal that names neither the line at fault nor any other.

COUNT inputs are shared out over the readers; input number N of a reader depends on the seed and N alone. Findings stay
in out/fuzz/campaign/, each with its input, its command and its answer.
"""

from __future__ import annotations

import os

# One thread, and a pool of numba's that survives a fork; read when numba is imported.
os.environ |= {
    "NUMBA_THREADING_LAYER": "workqueue",
    "NUMBA_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}

import argparse
import contextlib
import io
import json
import re
import resource
import shutil
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import cv2
import numpy as np

from tests.baseline.command import CRASHED, command, exit_code, preload
from tests.fuzz import mutations
from tests.fuzz.__main__ import CORPUS, OUT, ROOT
from tests.fuzz.mutations import Mutant, Mutation, chosen

CPU_S = 20.0
WALL_S = 90.0  # of a process that waits, or on a machine that others use
MEMORY_BYTES = 2 << 30
ADDRESS_BYTES = 8 << 30  # that a case may add, so that none takes the machine
MESSAGE_CHARACTERS = 1000
KIT = OUT / "kit"
FOUND = OUT / "campaign"
# Words of Python and its libraries, which say nothing to a user.
RAW = re.compile(
    r"\(\d+, '|\[Errno|out of range$|Numerical result|math domain|cannot convert float|invalid literal"
    r"|unsupported operand|not subscriptable|object has no attribute|object is not|NoneType|broadcast"
    r"|ufunc|dtype\('|<class|at 0x[0-9a-f]+"
    r"|could not convert|codec can't|Traceback|list index out|KeyError|IndexError|OpenCV\(|np\.float"
)
NAMES_PLACE = r": missing|no attitudes|column names|damaged|(LED|star) \d|line \d|row \d|message \d|satellite \d|\.\d+"
NO_RESULT = re.compile(  # but for a count of things of that name, as in "1 inf"
    r"(?<!\d )(?<![\w./-])(nan|inf|NaN|Infinity|NaT|None)(?![\w/-]| in )|(?<!\d )\b[\d.]*\de\+?(1[6-9]|[2-9]\d|\d{3})\b"
)


# Its errors, and the progress of studies and datasets.
OWN = re.compile(r"skysim: |[^:]*: \d+ (trials|frames)|[^:]*: \d+ of \d+, ")


class Reader(NamedTuple):
    """A kind of file and the commands that read it.

    Attributes
    ----------
    file
        Name of the mutated file in the folder of a case; several names: one of them
    seeds
        Shipped files, by glob, of which one is mutated; none: the kit's file of that name
    mutations
        Those of its structure
    commands
        Words of commands
    weight
        Share of the inputs, in those of an average reader
    """

    file: str | tuple[str, ...]
    seeds: tuple[str, ...]
    mutations: tuple[Mutation, ...]
    commands: tuple[str, ...]
    weight: float = 1.0


def scene(text: str) -> str:
    """A scene file of the kit."""
    return f"schema: 1\n{text}"


# Scenes that name the mutated file.
SCENES = {
    "listed.yaml": "base: afit_simsat\nlight: {layout: {kind: listed, cap_deg: 40, file: leds.csv}}\n",
    "surveyed.yaml": "base: afit_simsat\n"
    "light: {surface: {kind: surveyed, file: points.csv, unit: m, degree: 3, rms_limit: 100 mm}}\n",
    "mapped.yaml": "base: afit_simsat\ntracker: {map: map.ecsv}\n",
    "spectrum.yaml": "base: afit_simsat\nlight: {led: {spectrum: curve.csv}}\n",
    "response.yaml": "base: shefex2\ncamera: {detector: {quantum_efficiency: curve.csv}}\n",
    "transmission.yaml": "base: shefex2\ncamera: {transmission: curve.csv}\n",
    "psf.yaml": "base: shefex2\ncamera: {psf: {kind: measured, file: psf.csv}}\n",
    "catalog.yaml": "base: shefex2\nlight: {catalog: stars.ecsv}\n",
    "satellites.yaml": "base: shefex2\norbit: {kind: circular, altitude: 500 km, inclination_deg: 97}\n"
    "light: {satellites: {file: elements}}\n",
    "orbit.yaml": "base: shefex2\nstart_time: 2000-06-28T00:00:00\norbit: {kind: tle, file: elements, exclusion: {}}\n",
    "oem.yaml": "base: shefex2\nstart_time: 2016-12-31T00:00:00\nexposure: {frames: 1}\n"
    "orbit: {kind: oem, file: orbit.oem, exclusion: {}}\n",
    "profile.yaml": "base: afit_simsat\nexposure: {frames: 1, first: 0 s}\n"
    "motion: {start: profile, maneuver: [{kind: profile, file: profile.csv, begin: first_sample}]}\n",
    "vehicle.yaml": "base: shefex2\nvehicle: {model: vehicle.xml, center_of_mass: [0 m, 0 m, 0 m]}\n",
    "calibrated.yaml": "base: shefex2\n"
    "camera: {focal_length: null, principal_point_px: null, calibration: camera.yml}\n",
    "preset.yaml": "base: shefex2\ncamera: {preset: camera.yaml, focal_length: 25 mm, f_number: 2}\n",
}
READERS = {
    "scenes": Reader(
        "scene.yaml",
        (
            "scenes/*.yaml",
            "scenes/papers/*.yaml",
            "data/new/dome.yaml",
            "data/new/sky.yaml",
            "data/basilisk/orbit.yaml",
            "out/fuzz/kit/shown/*.yaml",
        ),
        mutations.YAML,
        (
            "validate scene.yaml",
            "check scene.yaml",
            "run scene.yaml --frames 1 --out o",
            "scenes show scene.yaml --json",
            "check scene.yaml --json",
            "validate scene.yaml",
            "scenes parts scene.yaml",
            "render scene.yaml --frames 1 --out o",
        ),
        8,
    ),
    "cameras": Reader(
        "camera.yaml",
        ("data/cameras/*.yaml", "data/new/camera.yaml"),
        mutations.YAML,
        (
            "validate camera.yaml",
            "camera camera.yaml --json",
            "check preset.yaml",
            "solve frame.png --camera camera.yaml",
        ),
        1.5,
    ),
    "studies": Reader(
        "study.yaml",
        (
            "scenes/studies/*.yaml",
            "scenes/papers/studies/*.yaml",
            "data/new/study.yaml",
            "tests/fuzz/corpus/studies/s*",
        ),
        mutations.YAML,
        ("validate study.yaml",),
        5,
    ),
    "small studies": Reader(
        ("small.yaml", "search.yaml"),
        (),
        mutations.YAML,
        ("study {verb} {file} --engine serial --out o",),
        1.5,
    ),
    "variations": Reader(
        "vary.yaml",
        (),
        mutations.YAML,
        ("dataset small_sky.yaml --frames 1 --vary vary.yaml --out o --engine serial",),
        1,
    ),
    "LED lists": Reader(
        "leds.csv",
        ("out/fuzz/kit/leds.csv", "out/fuzz/kit/leds_angles.csv", "out/fuzz/kit/map.ecsv"),
        mutations.TABLE,
        (
            "check listed.yaml",
            "scenes parts listed.yaml",
            "scenes export listed.yaml --out x.xml",
            "validate listed.yaml",
        ),
        2,
    ),
    "points of a dome": Reader(
        "points.csv",
        ("tests/fuzz/corpus/tables/points",),
        mutations.TABLE,
        ("validate surveyed.yaml", "check surveyed.yaml"),
        0.5,
    ),
    "maps": Reader(
        "map.ecsv",
        ("out/fuzz/kit/map.ecsv", "tests/fuzz/corpus/maps/covariance"),
        mutations.TABLE + mutations.WORDS[:1],
        (
            "validate map.ecsv",
            "check mapped.yaml",
            "solve dome.png --dome afit_simsat --map map.ecsv",
        ),
        2,
    ),
    "curves": Reader(
        "curve.csv",
        ("data/qe/*.csv", "data/led/white.csv", "data/bands/*_v.csv"),
        mutations.TABLE,
        (
            "check spectrum.yaml",
            "check response.yaml",
            "check transmission.yaml",
            "validate response.yaml",
        ),
        1,
    ),
    "PSFs": Reader(
        "psf.csv",
        ("tests/fuzz/corpus/tables/psf",),
        mutations.TABLE,
        ("check psf.yaml", "render psf.yaml --frames 1 --out o"),
        0.7,
    ),
    "prices": Reader(
        "prices.csv",
        ("data/prices/assumed.csv",),
        mutations.TABLE,
        (
            "scenes parts afit_simsat --prices prices.csv",
            "scenes parts coded_spiral --prices prices.csv --json",
        ),
        2,
    ),
    "catalogs": Reader(
        "stars.ecsv",
        ("out/fuzz/kit/stars.ecsv", "data/catalogs/shefex_*.ecsv"),
        mutations.TABLE + mutations.WORDS[:1],
        (
            "validate stars.ecsv",
            "catalog info stars.ecsv",
            "check catalog.yaml",
            "solve frame.png --fov 14.87 --catalog stars.ecsv",
            "catalog select --help",
        ),
        2,
    ),
    "CAT files": Reader(
        "stars.cat",
        ("tests/fuzz/corpus/catalogs/cat",),
        mutations.WORDS,
        ("catalog proc-cat stars.cat --out y.cat",),
        0.7,
    ),
    "elements": Reader(
        "elements",
        ("tests/fuzz/corpus/orbits/tle", "tests/fuzz/corpus/orbits/omm*"),
        mutations.WORDS + mutations.BINARY[:1],
        (
            "check satellites.yaml",
            "check orbit.yaml",
            "availability orbit.yaml --samples 100",
            "validate orbit.yaml",
        ),
        2,
    ),
    "ephemerides": Reader(
        "orbit.oem",
        ("tests/fuzz/corpus/orbits/oem",),
        mutations.WORDS + mutations.BINARY[:1],
        (
            "check oem.yaml",
            "availability oem.yaml --samples 100",
            "render oem.yaml --frames 1 --out o",
        ),
        1,
    ),
    "attitudes": Reader(
        "profile.csv",
        (
            "tests/fuzz/corpus/profiles/[ac]*",
            "tests/fuzz/corpus/profiles/stk*",
            "scenes/papers/two_axis_profile.csv",
        ),
        mutations.TABLE + mutations.WORDS,
        (
            "check profile.yaml",
            "validate profile.yaml",
            "render profile.yaml --frames 1 --out o",
        ),
        2,
    ),
    "vehicles": Reader(
        "vehicle.xml",
        ("scenes/vehicles/*.xml", "data/new/vehicle.xml"),
        mutations.XML,
        ("validate vehicle.xml", "check vehicle.yaml", "validate vehicle.yaml"),
        1.5,
    ),
    "calibrations": Reader(
        "camera.yml",
        ("out/fuzz/kit/camera.yml", "tests/fuzz/corpus/calibrations/four"),
        (*mutations.YAML, *mutations.WORDS),
        (
            "validate camera.yml",
            "camera camera.yml",
            "check calibrated.yaml",
            "solve frame.png --camera camera.yml",
        ),
        1.5,
    ),
    "FITS": Reader(
        "frame.fits",
        ("out/fuzz/kit/run/frame_0000.fits", "tests/fuzz/corpus/fits/plain"),
        mutations.FITS,
        ("solve frame.fits --fov 14.87", "solve frame.fits --camera shefex2 --json"),
        3,
    ),
    "packed FITS": Reader(
        "frame.fits.gz",
        ("tests/fuzz/corpus/fits/compressed.gz",),
        mutations.BINARY,
        ("solve frame.fits.gz --fov 14.87",),
        0.4,
    ),
    "NPY": Reader(
        "frame.npy",
        ("tests/fuzz/corpus/pictures/npy",),
        (mutations.npy_array, mutations.npy_array, mutations.flipped),
        ("solve frame.npy --fov 14.87", "solve frame.npy --dome afit_simsat"),
        2,
    ),
    "PNG": Reader(
        "frame.png",
        ("out/fuzz/kit/frame.png", "tests/fuzz/corpus/pictures/*png*"),
        mutations.BINARY,
        ("solve frame.png --fov 14.87", "solve frame.png --dome afit_simsat"),
        2,
    ),
    "TIFF": Reader(
        "frame.tif",
        ("out/fuzz/kit/frame.tif", "tests/fuzz/corpus/pictures/tiff*"),
        mutations.BINARY,
        ("solve frame.tif --fov 14.87",),
        2,
    ),
    "JPEG and others": Reader(
        ("frame.jpg", "frame.bmp", "frame.pgm", "frame.webp"),
        (),
        mutations.BINARY,
        ("solve {file} --fov 14.87", "solve {file}"),
        1,
    ),
    "films": Reader(
        "film.avi",
        (),
        mutations.BINARY,
        (
            "solve --live film.avi --fov 14.87",
            "survey afit_simsat --images film.avi --camera camera.yml",
            "solve film.avi --fov 14.87",
        ),
        0.4,
    ),
    "lists of lights": Reader(
        ("lights.csv", "lights.ecsv"),
        (),
        mutations.TABLE,
        ("solve {file} --fov 14.87 --size 659x493", "solve {file} --camera shefex2"),
        0.4,
    ),
    "stores": Reader(
        "study/study.sqlite",
        (),
        mutations.DATABASE,
        (
            "study status small.yaml --out study",
            "study report small.yaml --out study",
            "study resume small.yaml --out study --engine serial",
            "study export small.yaml o.csv o.parquet --out study",
            "study worst small.yaml --out study",
            "study replay small.yaml 1 --out study",
        ),
        3,
    ),
    "runs": Reader(
        ("run/*.ecsv", "run/*.ecsv", "run/frame_0001.fits"),
        (),
        mutations.TABLE + mutations.WORDS + mutations.BINARY,
        (
            "export run --to aem --to ecsv --out o",
            "export run --to parquet --out o",
            "export run --to tiff --out o",
            "solve run --camera shefex2",
            "export run --to video --out o",
        ),
        1.5,
    ),
    "survey images": Reader(
        ("images/attitudes.csv", "images/attitudes.csv", "images/frame_0001.*"),
        (),
        mutations.TABLE,
        ("survey afit_simsat --images images --camera afit_simsat --out o",),
        0.8,
    ),
    "camera frames": Reader(
        ("lab/*/*_000.*", "lab/*/*_001.*"),
        (),
        mutations.TABLE + mutations.BINARY,
        (
            "characterize --camera small_camera.yaml --darks lab/darks --flats lab/flats --out o",
        ),
        0.8,
    ),
    "dataset": Reader(
        ("data/*.json",),
        (),
        mutations.JSON,
        ("dataset small_sky.yaml --frames 2 --out data --engine serial",),
        0.6,
    ),
    "overrides": Reader("words", (), (), (), 7),
    "options": Reader("words", (), (), (), 4),
    "wire": Reader("words", (), (), (), 5),
}
WIRE = (
    "answers",
    "torques",
    "packets",
    "commands",
    "poses",
    "datagrams",
    "gvsp",
    "genicam",
)  # targets without a command
# Commands with an option that takes a value.
OPTIONS = (
    "solve frame.png --fov {}",
    "solve frame.png --camera {}",
    "solve frame.png --fov 14 --time {}",
    "solve frame.png --fov 14 --near {}",
    "solve frame.png --fov 14 --catalog {}",
    "solve lights.csv --fov 14 --size {}",
    "solve frame.png --dome {}",
    "solve frame.png --fov 14 --sequence --rate {}",
    "solve --live {}",
    "solve {}",
    "run shefex2 --frames {} --out o",
    "run shefex2 --frames 1 --seed {} --out o",
    "run {}",
    "validate {}",
    "camera {}",
    "camera new --pixels {} --out my.yaml",
    "camera new --pixels 64x64 --pitch {} --out my.yaml",
    "availability orbit.yaml --samples 100 --off-deg {}",
    "availability orbit.yaml --samples {}",
    "availability orbit.yaml --samples 100 --around-deg {}",
    "catalog info {}",
    "scenes parts afit_simsat --prices {}",
    "survey afit_simsat --plan --tilt {}",
    "survey afit_simsat --plan --imu-sigma {}",
    "survey afit_simsat --plan --led-sigma {}",
    "survey afit_simsat --plan --focal-error {}",
    "survey afit_simsat --images {}",
    "balance cubesat_table --tilt {}",
    "balance cubesat_table --torque {}",
    "balance cubesat_table --inertia-sigma {}",
    "datasheet shefex2 --rates {}",
    "dataset shefex2 --frames {} --out o",
    "export {} --to aem",
    "study run {}",
    "study status {}",
    "reproduce {}",
    "scenes show {}",
    "scenes export {}",
    "live shefex2 --folder o --frames {} --speed 0",
    "live shefex2 --folder o --speed {} --frames 1",
    "characterize --camera {} --darks lab/darks --flats lab/flats",
    "compare shefex2 --tracker {}",
    "new dome {}",
    "run shefex2 --frames 1 --out {}",
    "export run --to {}",
    "study worst small.yaml --out study --response {}",
    "study replay small.yaml {} --out study",
)


# The kit: files as skysim writes them


SMALL_STUDY = """\
schema: 1
title: a small study
scene: shefex2
seed: 1
trial: {kind: centroids, noise_px: 0.1}
factors:
  strays: {key: trial.false_lights, values: [0, 5]}
  lens: {key: camera.focal_length, values: [25 mm, 30 mm]}
replicates: 3
responses: [identified, cross_arcsec_p95]
figures:
  - {kind: curve, x: strays, y: identified, by: lens}
"""
SEARCH = """\
schema: 1
title: a small search
scene: shefex2
seed: 1
trial: {kind: centroids}
factors:
  lens: {key: camera.focal_length, from: 20 mm, to: 30 mm}
replicates: 3
responses: [identified, cross_arcsec_median]
optimize: {candidates: 2, objectives: [{response: cross_arcsec_median}]}
"""
VARY = """\
schema: 1
set:
  exposure.time: 30 ms
trial: {kind: frames, rate_deg_s: 0.5}
factors:
  strays: {key: camera.detector.read_noise_e, from: 5, to: 20}
  noise: {key: camera.f_number, values: [1.4, 2.0]}
"""


def make_kit() -> None:
    """Write the files of the kit, unless they are there."""
    if (KIT / "complete").exists():
        return
    shutil.rmtree(KIT, ignore_errors=True)
    (KIT / "shown").mkdir(parents=True)
    for name, text in SCENES.items():
        (KIT / name).write_text(scene(text))
    (KIT / "small_sky.yaml").write_text(scene("base: shefex2\n"))
    (KIT / "small_camera.yaml").write_text(
        (ROOT / "data/cameras/imx264.yaml")
        .read_text()
        .replace("2448", "96")
        .replace("2048", "64")
    )
    for name, text in {
        "small.yaml": SMALL_STUDY,
        "search.yaml": SEARCH,
        "vary.yaml": VARY,
    }.items():
        (KIT / name).write_text(text)
    for words in (
        "run shefex2 --frames 2 --out run",
        "run afit_simsat --frames 1 --out dome",
        "scenes export afit_simsat --out leds.csv",
        "survey afit_simsat --frames 30 --checks 2 --out surveyed",
        "survey afit_simsat --frames 12 --frames-to images --checks 1 --out ignored",
        "study run small.yaml --engine serial --out study",
        "characterize --camera small_camera.yaml --frames-to lab",
        "dataset small_sky.yaml --frames 2 --out data --engine serial",
        "camera shefex2 --out camera.yml",
    ):
        with contextlib.chdir(KIT):
            quietly(words)
    maps = [
        path for path in (KIT / "surveyed").glob("*.ecsv") if "sigma_m" in path.read_text()
    ]
    shutil.copy(maps[0], KIT / "map.ecsv")
    frame = cv2.imread(str(KIT / "run/frame_0000.png"), cv2.IMREAD_UNCHANGED)
    for name in ("frame.png", "frame.tif"):
        cv2.imwrite(str(KIT / name), frame)
    small = cv2.normalize(frame[:200, :300], None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    for name in ("frame.jpg", "frame.bmp", "frame.pgm", "frame.webp"):
        cv2.imwrite(str(KIT / name), small)
    shutil.copy(KIT / "dome/frame_0000.png", KIT / "dome.png")
    film = cv2.VideoWriter(
        str(KIT / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (300, 200), False
    )
    for _ in range(4):
        film.write(small)
    film.release()
    rows = np.random.default_rng(1).uniform(0, (659, 493, 900), (12, 3))
    lines = [f"{x:.2f}{{0}}{y:.2f}{{0}}{flux:.1f}" for x, y, flux in rows]
    (KIT / "lights.csv").write_text("\n".join(["x_px,y_px,flux", *lines]).format(","))
    head = "# %ECSV 1.0\n# ---\n# datatype:\n" + "".join(
        f"# - {{{{name: {name}, datatype: float64}}}}\n" for name in ("x_px", "y_px", "flux")
    )
    (KIT / "lights.ecsv").write_text(
        (head + "\n".join(["x_px y_px flux", *lines])).format(" ")
    )
    (KIT / "leds_angles.csv").write_text(
        "azimuth_deg,tilt_deg,level\n" + "".join(f"{7 * n},{n},0.5\n" for n in range(1, 50))
    )
    stars = (ROOT / "data/catalogs/hipparcos_hp6.5.ecsv").read_text().splitlines()
    kept = next(n for n, line in enumerate(stars) if line[0] != "#") + 1 + 1500
    text = "\n".join(stars[:kept])
    (KIT / "stars.ecsv").write_text(re.sub(r"rows: \d+", "rows: 1500", text))
    for name in (
        "points.csv",
        "psf.csv",
        "curve.csv",
        "vehicle.xml",
        "elements",
        "orbit.oem",
        "profile.csv",
        "camera.yaml",
    ):
        shutil.copy(
            seeds_of(next(one for one in READERS.values() if one.file == name))[0], KIT / name
        )
    for path in sorted((ROOT / "scenes").glob("*.yaml")):
        text = quietly(f"scenes show {path.stem}")
        (KIT / "shown" / path.name).write_text(text)
    (KIT / "complete").touch()


def quietly(words: str) -> str:
    """Run a command in this process, and return what it printed. Raises RuntimeError if it fails."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        command(*words.split())
    return out.getvalue()


def seeds_of(reader: Reader) -> list[Path]:
    """The files of which one is mutated."""
    return [path for glob in reader.seeds for path in sorted(ROOT.glob(glob))]


@cache
def content(path: Path) -> bytes:
    return path.read_bytes()


# A case


class Case(NamedTuple):
    """An input: words of the command, what was mutated and how; `target` and `data` for one without a command."""

    words: tuple[str, ...]
    mutant: Mutant
    file: str = ""
    target: str = ""


def make_case(name: str, number: int, seed: int) -> Case:
    """Input of a reader by its number."""
    rng = Random(f"{seed}/{name}/{number}")
    if name == "overrides":
        return override_case(rng)
    if name == "options":
        value = rng.choice(
            (
                *mutations.CELLS,
                *mutations.ODD,
                "1",
                "14.9",
                "1e9 m",
                "-3 deg",
                "0,0",
                "1,nan",
                "90,91",
                "64x0",
                "0 %",
                "1e300%",
                "small.yaml",
                "frame.fits",
                "..",
                "study",
                "nan deg",
                "1e9 deg",
                "all,all",
                "1900-01-01",
                "2100-13-01",
                "0.0001x3",
            )
        )
        value = value.replace("\0", "")
        words = tuple(value if word == "{}" else word for word in rng.choice(OPTIONS).split())
        return Case(words, Mutant(b"", " ".join(words)[:80]))
    if name == "wire":
        target = rng.choice(WIRE)
        seeds = [path.read_bytes() for path in sorted((CORPUS / target).iterdir())]
        kinds = (
            mutations.BINARY if target in ("packets", "datagrams", "gvsp") else mutations.JSON
        )
        mutant = chosen(kinds, rng.choice(seeds), rng)
        return Case(
            (), mutant._replace(data=mutant.data or b"", is_wrong=False), target=target
        )
    reader = READERS[name]
    file = rng.choice((reader.file,) if isinstance(reader.file, str) else reader.file)
    if "*" in file:
        found = sorted(KIT.glob(file))
        file = str(rng.choice(found).relative_to(KIT)) if found else file
    seeds = seeds_of(reader) or [KIT / file]
    mutant = chosen(reader.mutations, content(rng.choice(seeds)), rng)
    words = (
        rng.choice(reader.commands)
        .replace("{file}", file)
        .replace("{verb}", "optimize" if "search" in file else "run")
        .split()
    )
    return Case(tuple(words), mutant, file)


@cache
def schema_keys() -> list[str]:
    """Dotted keys of the shown scenes."""
    import yaml

    keys: set[str] = set()
    for path in sorted((KIT / "shown").glob("*.yaml")):
        keys |= {
            ".".join(place.keys) for place in mutations.places(yaml.compose(path.read_text()))
        }
    return sorted(keys)


def override_case(rng: Random) -> Case:
    """A command with one or two values given by --set."""
    words = rng.choice(
        (
            "check shefex2",
            "check afit_simsat",
            "run simsat_cmg --frames 1 --out o",
            "scenes parts afit_simsat",
            "check cubesat_table",
            "check coded_spiral",
            "run shefex2 --frames 1 --out o",
            "study run small.yaml --engine serial --out o",
        )
    ).split()
    sets = []
    for _ in range(rng.choice((1, 1, 2))):
        value = rng.choice(
            (
                *mutations.ODD,
                *mutations.CELLS,
                "5",
                "0.5",
                "10 mm",
                "1 s",
                "[0, 0, 0]",
                "{kind: x}",
            )
        )
        sets += ["--set", f"{rng.choice(schema_keys())}={value}".replace("\0", "")]
    return Case((*words, *sets), Mutant(b"", " ".join(sets)[:120]))


def place(folder: Path, case: Case) -> None:
    """Make the folder of a case: links to the kit, and the mutated file."""
    own = Path(case.file).parts[0] if case.file else ""
    for path in KIT.iterdir():
        if (path.name == own and path.is_dir()) or (
            path.is_dir() and path.name in ("study", "data")
        ):
            # A log of SQLite's is there while another process has the store open.
            passing = shutil.ignore_patterns("*-shm", "*-wal")
            shutil.copytree(path, folder / path.name, ignore=passing)
        elif (
            path.suffix == ".yaml" and path.name != own
        ):  # files are sought beside a scene, not beside a link
            shutil.copy(path, folder / path.name)
        elif path.name not in (own, "shown", "complete", "ignored", "surveyed", "dome"):
            (folder / path.name).symlink_to(path)
    if not case.file:
        return
    path = folder / case.file
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    if case.mutant.data is not None:
        path.write_bytes(case.mutant.data)
    elif case.mutant.what == "folder":
        path.mkdir()
    elif case.mutant.what == "pipe":
        os.mkfifo(path)
    else:
        targets = {
            "loop": path.name,
            "dangling": "nowhere",
            "zero": "/dev/zero",
            "memory": "/proc/self/mem",
        }
        path.symlink_to(targets[case.mutant.what])


class Answer(NamedTuple):
    """How a command ended: exit code, output, errors, processor seconds, most memory, and whether it was stopped."""

    code: int
    out: str
    err: str
    cpu_s: float
    memory_bytes: int
    timed_out: bool


def run_case(folder: Path, case: Case) -> Answer:
    """Run the command of a case in a fork."""
    out, err = folder.with_suffix(".out"), folder.with_suffix(".err")
    begin = time.monotonic()
    if (process := os.fork()) == 0:
        os.setsid()
        for number, path in enumerate((Path(os.devnull), out, err)):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        os.chdir(folder)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + ADDRESS_BYTES,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 31,) * 2)
        # What the parent has been warned of is said again.
        warnings.simplefilter("default", RuntimeWarning, append=True)
        os._exit(exit_code(lambda: act(case)))
    timed_out = False
    while (ended := os.wait4(process, os.WNOHANG))[0] == 0:
        waited = time.monotonic() - begin
        if waited > WALL_S or (waited > CPU_S and cpu_s(process) > CPU_S):
            timed_out = True
            os.killpg(process, signal.SIGKILL)
            ended = os.wait4(process, 0)
            break
        time.sleep(0.01)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process, signal.SIGKILL)  # what the command has left
    _, status, usage = ended
    answer = Answer(
        os.waitstatus_to_exitcode(status),
        out.read_text(encoding="utf-8", errors="replace"),
        err.read_text(encoding="utf-8", errors="replace"),
        usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss * 1024,
        timed_out,
    )
    out.unlink()
    err.unlink()
    return answer


def cpu_s(process: int) -> float:
    """Processor seconds of a process and of its ended children."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def act(case: Case) -> None:
    """The body of the process."""
    if case.words:
        command(*case.words)
        return
    from tests.fuzz.targets import TARGETS

    TARGETS[case.target](case.mutant.data or b"")


def findings(name: str, case: Case, answer: Answer) -> Iterator[str]:
    """Yield what is wrong with an answer, the kind before a colon."""
    lines = answer.err.splitlines()
    own = [line for line in lines if OWN.match(line)]
    last = lines[-1][:300] if lines else ""
    works = re.search(r": \d+ (trials|frames)$", answer.err, re.MULTILINE)
    asked = "frames" in case.mutant.what or "1_000" in case.words
    if (works or asked) and (answer.timed_out or answer.cpu_s > CPU_S):
        return  # a study runs, and shows its progress
    if answer.timed_out:
        yield f"time-out: {answer.cpu_s:.0f} s of the processor"
        return
    if answer.cpu_s > CPU_S:
        yield f"time-out: {answer.cpu_s:.0f} s of the processor"
    if answer.memory_bytes > MEMORY_BYTES:
        yield f"memory: {answer.memory_bytes / 1e9:.1f} GB"
    if answer.code < 0:
        yield f"crash: {signal.Signals(-answer.code).name}"
        return
    if "Traceback (most recent call last)" in answer.err or answer.code == CRASHED:
        yield f"traceback: {last}"
        return
    if len(own) < len(lines):
        yield f"library: {next(line for line in lines if line not in own)[:300]}"
    own = [line for line in own if line.startswith("skysim: ")]
    long = max(map(len, own), default=0)
    if long > MESSAGE_CHARACTERS:
        yield f"long: {long} characters: {own[-1][:160]}"
    if raw := next(filter(None, map(RAW.search, own)), None):
        yield f"words: {raw.string[max(raw.start() - 150, 0) : raw.end() + 60]}"
    if answer.code == 2 and not own:
        yield "silent refusal:"
        return
    if answer.code == 2 and len(own) != 1 and case.words[0] not in ("validate", "solve"):
        yield f"lines: {own[0][:100]} / {own[-1][:100]}"
    if answer.code not in (0, 1, 2):
        yield f"exit code: {answer.code}"
    if (
        answer.code == 0
        and case.mutant.is_wrong
        and name != "runs"
        # The tracker uses some columns of a catalog only.
        and (name, case.words[0]) != ("catalogs", "solve")
        # A link of that name to nowhere: the images have no attitudes.
        and (name, case.mutant.what) != ("survey images", "dangling")
        and case.file.split("/")[0] in " ".join(case.words)
    ):
        yield f"taken: {case.mutant.what}"
    if answer.code == 0 and (
        odd := NO_RESULT.search(re.sub(r'"what": .*|report: .*', "", answer.out))
    ):
        yield f"no number: {answer.out[max(odd.start() - 80, 0) : odd.end() + 20]!r}"
    lists = READERS[name].mutations
    listed = (
        name != "calibrations" and lists and lists[0] in (*mutations.TABLE, *mutations.YAML)
    )
    if (
        answer.code == 2
        and own
        and listed
        and case.mutant.line
        and Path(case.file).name in own[-1]
        and not re.search(NAMES_PLACE, own[-1])
        and (case.mutant.what.rpartition(": ")[2].strip("'") or "-") not in own[-1]
    ):
        yield f"no line: {own[-1][:300]}"


# The campaign


class Tally(NamedTuple):
    """What became of the inputs of a reader."""

    refused: int
    done: int
    findings: int
    longest: int
    slowest_s: float
    most_mb: float


def shares(count: int, names: Sequence[str]) -> list[tuple[str, int]]:
    """Reader and number of each input, `count` in all, readers in turn."""
    weight = sum(READERS[name].weight for name in names)
    each = {name: max(round(count * READERS[name].weight / weight), 1) for name in names}
    return [(name, n) for n in range(max(each.values())) for name in names if n < each[name]]


def work(cases: Sequence[tuple[str, int]], seed: int, results: Path) -> None:
    """Run cases one after another and write a line of JSON of each."""
    folder = OUT / f"case-{os.getpid()}"
    with results.open("w") as file:
        for name, number in cases:
            case = make_case(name, number, seed)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            place(folder, case)
            answer = run_case(folder, case)
            found = list(findings(name, case, answer))
            record = {
                "reader": name,
                "number": number,
                "words": list(case.words) or case.target,
                "what": case.mutant.what,
                "code": answer.code,
                "cpu_s": round(answer.cpu_s, 2),
                "mb": answer.memory_bytes >> 20,
                "err": answer.err[-3000:],
                "out": answer.out[:300],
                "findings": found,
            }
            file.write(json.dumps(record) + "\n")
            file.flush()
            if found:
                keep(name, number, case, answer)
                print(
                    f"{name}:{number} {' '.join(case.words)[:90]} [{case.mutant.what[:70]}]\n    "
                    + "\n    ".join(found),
                    flush=True,
                )
    shutil.rmtree(folder, ignore_errors=True)


def keep(name: str, number: int, case: Case, answer: Answer) -> None:
    """Keep the input of a finding and what was answered."""
    folder = FOUND / f"{name.replace(' ', '_')}-{number}"
    folder.mkdir(parents=True, exist_ok=True)
    if case.mutant.data is not None:
        (folder / (Path(case.file).name or "input")).write_bytes(case.mutant.data)
    (folder / "answer.txt").write_text(
        f"{case.words}\n{case.mutant.what}\n{answer.err[-20000:]}\n{answer.out[:2000]}"
    )


def warm_up() -> None:
    """Run commands once in this process, so that its forks have the compiled code."""
    preload()
    make_kit()
    import tests.fuzz.targets  # noqa: F401

    os.chdir(KIT)
    for words in (
        "check afit_simsat",
        "run shefex2 --frames 1 --out warm",
        "solve frame.png --fov 14.87 --out warm",
        "run afit_simsat --frames 1 --out warm",
        "availability orbit.yaml --samples 100",
        "check oem.yaml",
        "validate map.ecsv",
        "scenes parts afit_simsat",
        "solve dome.png --dome afit_simsat --out warm",
        "study status small.yaml --out study",
        "validate small.yaml",
    ):
        quietly(words)
    os.chdir(ROOT)


def run(count: int, seed: int, workers: int, names: Sequence[str]) -> list[dict[str, Any]]:
    """Run the campaign; return a record of each input."""
    cv2.setNumThreads(1)
    OUT.mkdir(parents=True, exist_ok=True)
    warm_up()
    cases = shares(count, names)
    files = [OUT / f"campaign-{n}.jsonl" for n in range(workers)]
    processes = []
    for n, file in enumerate(files):
        sys.stdout.flush()
        if (process := os.fork()) == 0:
            os._exit(exit_code(lambda n=n, file=file: work(cases[n::workers], seed, file)))
        processes.append(process)
    for process in processes:
        os.waitpid(process, 0)
    return [json.loads(line) for file in files for line in file.read_text().splitlines()]


def again(seed: int) -> int:
    """Run the inputs of the last campaign again that had findings; return the number that still has."""
    records = [
        json.loads(line)
        for path in OUT.glob("campaign-*.jsonl")
        for line in path.read_text().splitlines()
    ]
    cases = [(one["reader"], one["number"]) for one in records if one["findings"]]
    shutil.rmtree(FOUND, ignore_errors=True)
    warm_up()
    results = OUT / "again.jsonl"
    work(cases, seed, results)
    still = sum('"findings": []' not in line for line in results.read_text().splitlines())
    print(f"{len(cases)} inputs again, {still} findings")
    return still


def whole(names: Sequence[str]) -> int:
    """Run the commands on files without a mutation, and print what is refused; return the number of findings."""
    warm_up()
    folder = OUT / "whole"
    found = 0
    for name in names:
        reader = READERS[name]
        for file in [reader.file] if isinstance(reader.file, str) else reader.file:
            files = (
                [file]
                if "*" not in file
                else [str(path.relative_to(KIT)) for path in sorted(KIT.glob(file))][:2]
            )
            for one in files:
                for words in reader.commands:
                    path = (seeds_of(reader) or [KIT / one])[-1]
                    case = Case(
                        tuple(
                            words.replace("{file}", one)
                            .replace("{verb}", "optimize" if "search" in one else "run")
                            .split()
                        ),
                        Mutant(path.read_bytes(), "whole"),
                        one,
                    )
                    shutil.rmtree(folder, ignore_errors=True)
                    folder.mkdir()
                    place(folder, case)
                    answer = run_case(folder, case)
                    wrong = list(findings(name, case, answer))
                    found += bool(wrong)
                    if wrong or answer.code:
                        print(
                            f"{name}: {' '.join(case.words)}: {answer.code} {answer.err[-300:]} {wrong}",
                            flush=True,
                        )
    return found


def table(records: list[dict[str, Any]]) -> str:
    """The table by reader, and the findings by kind."""
    lines = [
        f"{'reader':18s} {'inputs':>7s} {'refused':>8s} {'done':>6s} {'findings':>9s}"
        f" {'longest':>8s} {'s':>6s} {'MB':>6s}"
    ]
    for name in (*READERS, ""):
        rows = [one for one in records if one["reader"] == name or not name]
        if not rows:
            continue
        longest = max(
            (
                len(line)
                for one in rows
                if one["code"] == 2
                for line in one["err"].splitlines()
            ),
            default=0,
        )
        refused = sum(one["code"] == 2 for one in rows)
        done = sum(one["code"] in (0, 1) for one in rows)
        found = sum(bool(one["findings"]) for one in rows)
        slowest = max(one["cpu_s"] for one in rows)
        lines += [
            f"{name or 'all':18s} {len(rows):7d} {refused:8d} {done:6d} {found:9d}"
            f" {longest:8d} {slowest:6.1f} {max(one['mb'] for one in rows):6d}"
        ]
    kinds = Counter(text.partition(":")[0] for one in records for text in one["findings"])
    return "\n".join([*lines, f"findings by kind: {dict(kinds) or 'none'}"])


def main() -> int:
    """Run the campaign that the command line asks for; exit code 1 if there is a finding."""
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int, nargs="?", default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", default=",".join(READERS))
    parser.add_argument(
        "--whole", action="store_true", help="run every command on the seeds as they are"
    )
    parser.add_argument(
        "--again", action="store_true", help="run the inputs again that had findings"
    )
    parser.add_argument("--case", help="READER:NUMBER; run this one and print the answer")
    asked = parser.parse_args()
    if asked.again:
        return again(asked.seed)
    if asked.whole:
        return whole(asked.only.split(","))
    if asked.case:
        name, _, number = asked.case.partition(":")
        warm_up()
        folder = OUT / "case"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        case = make_case(name, int(number), asked.seed)
        place(folder, case)
        answer = run_case(folder, case)
        print(
            case.words,
            case.file,
            case.mutant.what,
            answer,
            *findings(name, case, answer),
            sep="\n",
        )
        return 0
    records = run(asked.count, asked.seed, asked.workers, asked.only.split(","))
    print(table(records))
    return int(any(one["findings"] for one in records))


if __name__ == "__main__":
    sys.exit(main())
