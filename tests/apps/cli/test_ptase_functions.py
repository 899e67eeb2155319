"""PTASE's functions (Fialho & Saotome 2005, section 3): our counterpart of each is called and checked."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import SOLVERS
from estimator.catalog import pair_index, published_catalogs
from estimator.catalog.pair_index import PairIndex
from estimator.core.checks import Ints
from estimator.core.types import ra_dec_roll_rad
from estimator.identification.published.fialho import (
    VERSIONS,
    MagnitudeMatch,
    fialho_2,
    fialho_4,
)
from estimator.identification.registry import IDENTIFIERS
from skysim.core import files, images
from skysim.core.constants import ARCSEC_RAD
from skysim.core.paths import CATALOGS, ROOT
from skysim.core.types import Floats
from skysim.results.plots import to_8bit

SIGMA_MAG = 0.25
TOLERANCE_RAD = 15 * ARCSEC_RAD
SCENE = ("shefex2", "--frames", "1", "--set", "motion.rate_deg_s=[0,0,0]")
STUDY = """schema: 1
title: A Monte Carlo simulation as PTASE's key 2
scene: shefex2
seed: 5
set: {light.limit_mag: 5.75}
trial: {kind: centroids}
factors:
  model: {key: trial.noise_px, values: [0.0, 0.1]}
  field: {key: camera.focal_length, values: ["25 mm"]}
replicates: 40
responses: [identified, wrong, cross_arcsec_rms]
"""
STOPPED = """
import signal, sys
from skysim.simulation import run
from skysim.apps.cli.main import main
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
fly = run.simulate_motion
run.simulate_motion = lambda *arguments: (signal.raise_signal(signal.SIGINT), fly(*arguments))[1]
sys.argv = ["skysim", "run", "shefex2", "--out", sys.argv[1]]
main()
"""
Check = Callable[[Path], bool]


def asked(*words: str) -> Any:
    """JSON printed by a command. Raises ValueError if the command fails."""
    return json.loads(printed(*words, "--json"))


def printed(*words: str) -> str:
    """Text printed by a command. Raises ValueError if the command fails."""
    from typer.testing import CliRunner

    from skysim.apps.cli.main import app

    done = CliRunner().invoke(app, list(words))
    if done.exit_code:
        raise ValueError(f"skysim {' '.join(words)}: {done.exception or done.output}")
    return done.stdout


def flown(folder: Path, *words: str) -> Any:
    """The only row of a run of SHEFEX-2's camera at rest, from the command's JSON."""
    return asked("run", *SCENE, "--out", str(folder), *words)["rows"][0]


def looks(row: Any, ra_deg: float, dec_deg: float, roll_deg: float) -> bool:
    """Whether a run's frame was solved at this pointing."""
    wanted = np.array([ra_deg, dec_deg, roll_deg])
    return row["status"] == "solved" and bool(
        np.abs(np.array(row["estimate_deg"]) - wanted).max() < 0.05
    )


class Field(NamedTuple):
    """Stars of the catalog about a direction as PTASE's sensor sees them, brightest first, and their rows."""

    seen: Floats
    magnitude: Floats
    rows: Ints


@cache
def catalog(limit_mag: float) -> PairIndex:
    """The pairs of Hipparcos by READCAT and PROC_CAT."""
    stars = published_catalogs.read_cat(CATALOGS / "hipparcos_hp6.5.ecsv", limit_mag)
    stars = published_catalogs.proc_cat(stars, 30 * ARCSEC_RAD)
    return pair_index.build(stars.vectors, np.radians(28), magnitude=stars.magnitude)


@cache
def field() -> Field:
    """Twenty degrees about Orion's belt; camera axes are the catalog's."""
    known = catalog(5.1)
    middle = known.vectors[np.argmax(known.vectors @ ORION)]
    rows = np.flatnonzero(known.vectors @ middle > np.cos(np.radians(10)))
    return Field(known.vectors[rows], known.magnitude[rows], rows)


ORION = np.array([0.105, 0.994, -0.021])


def identified(found: Any, one: Field) -> bool:
    """Whether most of the stars were named, and all names are true."""
    return (
        found is not None
        and len(found.star) > len(one.rows) / 2
        and bool((one.rows[found.observed] == found.star).all())
    )


# The program: what its keys do.


def chosen_catalog(folder: Path) -> bool:
    count = asked("catalog", "info", "hipparcos_hp6.5")["stars"]
    return count > 5000 and bool(
        np.abs(drawn_at(folder, "light.catalog=hipparcos_hp6.5") - [83, 2, 20]).max() < 1e-3
    )


def screen(folder: Path) -> bool:
    asked("render", *SCENE, "--out", str(folder), "--preview")
    return (folder / "frame_0000.preview.png").stat().st_size > 1000


def drawn_at(folder: Path, *sets: str) -> Floats:
    """(3,) right ascension, declination, roll of what is drawn, deg, from the frame's truth."""
    asked(
        "render",
        *SCENE,
        "--out",
        str(folder),
        *(word for one in sets for word in ("--set", one)),
    )
    lines = [
        line
        for line in (folder / "frame_0000.ecsv").read_text("utf-8").splitlines()
        if "cam_from_lab" in line
    ]
    xyzw = np.array(json.loads(lines[0][lines[0].index("[") : lines[0].index("]") + 1]))
    return np.degrees(ra_dec_roll_rad(Rotation.from_quat(xyzw)))


def moved(folder: Path) -> bool:
    """Move the pointing one step up and one to the left."""
    drawn_deg = drawn_at(folder, "motion.start.dec_deg=7", "motion.start.ra_deg=88")
    return bool(np.abs(drawn_deg - [88, 7, 20]).max() < 1e-3)


def rolled(folder: Path) -> bool:
    return bool(
        np.abs(drawn_at(folder, "motion.start.roll_deg=35") - [83, 2, 35]).max() < 1e-3
    )


def coordinates(folder: Path) -> bool:
    start = "motion.start={ra_deg: 250, dec_deg: -40, roll_deg: -90}"
    return looks(flown(folder, "--set", start), 250, -40, -90)


def image_processing(folder: Path) -> bool:
    row = flown(
        folder,
        *("--detector", "local", "--centroider", "gaussian_fit"),
        "--set",
        "tracker.threshold_sigma=7",
    )
    return looks(row, 83, 2, 20)


def ideal_model(folder: Path) -> bool:
    """Remaining differences are double stars that the tracker merges."""
    points = studied(folder)
    return points["identified"][0] == 1 and points["cross_arcsec_rms"][0] < 0.5


def noisy_model(folder: Path) -> bool:
    points = studied(folder)
    return points["identified"][1] > 0.9 and points["cross_arcsec_rms"][1] > 0.1


def studied(folder: Path, *words: str) -> Any:
    """Table of a small study."""
    path = folder / "monte_carlo.yaml"
    files.write_text(path, STUDY)
    report = asked(
        "study",
        "run",
        str(path),
        "--engine",
        "serial",
        "--out",
        str(folder / "study"),
        *words,
    )
    return report["points"]


def identifiers(folder: Path) -> bool:
    """All identifiers in one study, each using the thirty brightest lights."""
    named = f"factors.model={{key: tracker.identifier, values: [{', '.join(VERSIONS)}]}}"
    points = studied(
        folder,
        "--set",
        named,
        "--set",
        "set={light.limit_mag: 5.75, tracker.brightest: 30}",
        "--set",
        "replicates=5",
    )
    return points["model"] == list(VERSIONS) and min(points["identified"]) > 0.5


def other_identifiers(folder: Path) -> bool:
    others = [name for name in IDENTIFIERS if name not in VERSIONS]
    return len(others) > 2 and looks(flown(folder, "--identifier", "pyramid"), 83, 2, 20)


def run_once(folder: Path) -> bool:
    row = flown(folder)
    return looks(row, 83, 2, 20) and 0 < row["cross_arcsec"] < 30


def monte_carlo(folder: Path) -> bool:
    return studied(folder)["identified_trials"] == [40, 40]


def how_many(folder: Path) -> bool:
    """Half the number of runs, and twice the field width."""
    sets = ("--set", "replicates=20", "--set", "factors.field.values=['12 mm']")
    points = studied(folder, *sets)
    return points["identified_trials"] == [20, 20] and points["field"] == ["12 mm"] * 2


def log_file(folder: Path) -> bool:
    flown(folder)
    return all(
        (folder / name).stat().st_size > 100 for name in ("solutions.ecsv", "report.html")
    )


def histogram(folder: Path) -> bool:
    """Of the attitude errors of a simulation's trials, which the study stores."""
    studied(folder)
    with sqlite3.connect(folder / "study" / "study.sqlite") as store:
        rolls = [row[0] for row in store.execute("SELECT roll_arcsec FROM trials")]
    errors = np.array(rolls, dtype=float)
    return int(np.histogram(errors[np.isfinite(errors)], 10)[0].sum()) > 20


def helped(folder: Path) -> bool:
    return "--frames" in printed("run", "--help") and "reproduce" in printed("--help")


def stopped(folder: Path) -> bool:
    """Ctrl-C as a flight begins: one line, and exit code 130."""
    done = subprocess.run(
        [sys.executable, "-c", STOPPED, str(folder / "stopped")],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        check=False,
    )
    return done.returncode == 128 + signal.SIGINT and "stopped" in done.stderr


# The catalog's programs, and what the identifier can do.


def readcat(folder: Path) -> bool:
    """A limit, the mission's epoch, and instrumental magnitudes; the order is the file's."""
    path = CATALOGS / "hipparcos_hp6.5.ecsv"
    plain = published_catalogs.read_cat(path, 5.0)
    later = published_catalogs.read_cat(
        path, 5.0, 2010.0, published_catalogs.Color(0.1, 0.2, 0.0)
    )
    shift = np.linalg.norm(later.vectors - plain.vectors, axis=1) / ARCSEC_RAD
    return bool(
        plain.magnitude.max() <= 5.0
        and (np.diff(plain.id) > 0).all()
        and shift.max() > 60
        and np.median(shift) < 5
        and (later.magnitude != plain.magnitude).any()
    )


def proc_cat(folder: Path) -> bool:
    """Doubles merged, growing magnitude, the log with its histogram and every star."""
    plain = published_catalogs.read_cat(CATALOGS / "hipparcos_hp6.5.ecsv", 5.0)
    done = published_catalogs.proc_cat(plain, 60 * ARCSEC_RAD)
    log_text = published_catalogs.log(done)
    return bool(
        len(done) < len(plain)
        and done.components.sum() == len(plain)
        and (np.diff(done.magnitude) >= 0).all()
        and len(log_text.splitlines()) > len(done)
    )


def attitudes(folder: Path) -> bool:
    """The deterministic attitude from two stars, and least squares."""
    one = field()
    names = ("triad", "least_squares")
    sigma_rad = np.full(len(one.rows), ARCSEC_RAD)
    found = [SOLVERS[name](one.seen, one.seen, sigma_rad) for name in names]
    return all(getattr(each, "cam_from_ref", each).magnitude() < ARCSEC_RAD for each in found)


def true_sky(folder: Path) -> bool:
    asked("render", *SCENE, "--out", str(folder))
    solution = asked(
        "solve",
        str(folder / "frame_0000.png"),
        "--fov",
        "14.87",
        "--out",
        str(folder / "solved"),
    )[0]
    return (
        solution["status"] == "solved"
        and abs(solution["ra_deg"] - 83) < 0.2
        and abs(solution["dec_deg"] - 2) < 0.2
    )


def from_a_camera(folder: Path) -> bool:
    """A video file replaces the camera: OpenCV opens both in the same way."""
    import cv2

    asked("render", *SCENE, "--out", str(folder))
    gray = to_8bit(images.read_image(folder / "frame_0000.png"), "square root")
    video = cv2.VideoWriter(
        str(folder / "camera.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, gray.shape[::-1]
    )
    video.write(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR))
    video.release()
    solution = asked(
        "solve", "--live", str(folder / "camera.avi"), "--fov", "14.87", "--out", str(folder)
    )[0]
    return (
        solution["status"] == "solved"
        and abs(solution["ra_deg"] - 83) < 0.2
        and abs(solution["dec_deg"] - 2) < 0.2
    )


def estimate(folder: Path) -> bool:
    """With a hint near the axis the stars are identified; with a wrong hint there are no candidates."""
    one = field()
    known = catalog(5.1)
    axis = one.seen.mean(axis=0) / np.linalg.norm(one.seen.mean(axis=0))
    options = {
        "magnitude": one.magnitude,
        "epsilon_mag": SIGMA_MAG,
        "within_rad": np.radians(15),
    }
    right = fialho_2(one.seen, known, TOLERANCE_RAD, boresight_ref=axis, **options)
    return (
        identified(right, one)
        and fialho_2(one.seen, known, TOLERANCE_RAD, boresight_ref=-axis, **options) is None
    )


def false_stars(folder: Path) -> bool:
    """Three false lights are brighter than all stars, so the first triangle is false."""
    one = field()
    known = catalog(5.1)
    side = np.cross(one.seen[0], [0.0, 0.0, 1.0])
    false = (
        one.seen.mean(axis=0)
        + np.outer([0.05, -0.07, 0.11], side)
        + [[0.0, 0.0, z] for z in (0.06, 0.02, -0.09)]
    )
    seen = np.vstack([false / np.linalg.norm(false, axis=1, keepdims=True), one.seen])
    light = np.append([-1.5, -1.4, -1.3], one.magnitude)
    options = {"magnitude": light, "epsilon_mag": SIGMA_MAG}
    with_false = Field(seen, light, np.append([-1, -1, -1], one.rows))
    return identified(fialho_4(seen, known, TOLERANCE_RAD, **options), with_false) and (
        fialho_2(seen, known, TOLERANCE_RAD, **options) is None
    )


def magnitude_errors(folder: Path) -> bool:
    """Mean and variance are recovered from magnitudes off by 0.1 with an alternating 0.05 about it."""
    one = field()
    known = catalog(5.1)
    off = 0.1 + 0.05 * (-1.0) ** np.arange(len(one.rows))
    options = {"magnitude": one.magnitude + off, "epsilon_mag": SIGMA_MAG}
    found = fialho_4(one.seen, known, TOLERANCE_RAD, **options)
    return isinstance(found, MagnitudeMatch) and (
        abs(found.offset_mag - 0.1) < 0.01 and abs(found.variance_mag2 - 0.05**2) < 0.001
    )


CHECKS: dict[str, Check] = {
    "catalog": chosen_catalog,
    "screen": screen,
    "arrows": moved,
    "roll": rolled,
    "coordinates": coordinates,
    "image_processing": image_processing,
    "ideal_model": ideal_model,
    "noisy_model": noisy_model,
    "identifiers": identifiers,
    "once": run_once,
    "monte_carlo": monte_carlo,
    "how_many": how_many,
    "log": log_file,
    "histogram": histogram,
    "help": helped,
    "escape": stopped,
    "readcat": readcat,
    "proc_cat": proc_cat,
    "attitudes": attitudes,
    "true_sky": true_sky,
    "camera": from_a_camera,
    "estimate": estimate,
    "false_stars": false_stars,
    "magnitude_errors": magnitude_errors,
    "others": other_identifiers,
}


@pytest.mark.long
@pytest.mark.parametrize("name", CHECKS)
def test_every_function_of_the_2005_program_has_a_counterpart(
    name: str, tmp_path: Path
) -> None:
    assert CHECKS[name](tmp_path)
