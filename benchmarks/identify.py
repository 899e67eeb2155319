"""Lost-in-space solution from centroids, compared with tetra3rs: SHEFEX-2's camera, and narrow fields of a deep sky.

The deep sky is Gaia's to V 10 (`benchmarks.sky`). The narrow camera's index is built once and then read from disk; that
of tetra3rs takes a minute, and is kept in out/ too.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.sky import deep_catalog
from benchmarks.timing import figure, verdict, versus
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.paths import CATALOGS

FIELDS = 100
NARROW_FIELDS = 200
COMMAND_FIELDS = 18
NARROW_DEG = 2.6
NARROW_PX = 1024
FALSE_SHARES = 0.0, 0.3
WRONG_RAD = np.radians(1 / 6)
# A command of skysim, and then its greatest resident and its private memory, MB, and its CPU time, s. The kernel's
# figure for a child process would include the memory of this one.
MEASURED = """
import runpy, sys, time
try:
    runpy.run_module("skysim", run_name="__main__", alter_sys=True)
except SystemExit as end:
    if end.code:
        raise
kilobytes = {}
for name in ("status", "smaps_rollup"):
    for line in open(f"/proc/self/{name}"):
        key, *words = line.split()
        kilobytes[key] = words[0] if words else ""
print(*(1024 * int(kilobytes[key]) / 1e6 for key in ("VmHWM:", "Anonymous:")), time.process_time())
"""


def measure() -> list[dict[str, Any]]:
    """All rows of the area."""
    return [shefex(), *narrow()]


def shefex() -> dict[str, Any]:
    """100 random fields of 14.87 x 11.15 deg: the 15 brightest stars to V 5.75, 0.1 px noise, no false stars."""
    camera = Camera(659, 493, 25e-3 / 9.9e-6, (329.0, 246.0))
    stars = catalog.brighter_than(catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv"), 5.75)
    tracker = StarTracker(
        camera, stars, catalog.at_epoch(stars, 2020.0), Settings(centroid_sigma_px=0.1)
    )
    fields = [field(tracker, np.random.default_rng([3, n])) for n in range(FIELDS)]
    return versus(
        f"identify + solve {FIELDS} SHEFEX fields",
        lambda: [tracker.solve_centroids(centroids) for centroids in fields],
        "tetra3rs",
        tetra3rs(camera, fields),
        bar=1.0,
        repeats=20,
    )


def narrow() -> list[dict[str, Any]]:
    """Index and times of fields of 2.6 deg, all stars to V 10 (55 in a mean field), 0.1 px noise."""
    stars = catalog.read(deep_catalog())
    camera = Camera.from_fov(NARROW_PX, NARROW_PX, fov_deg=NARROW_DEG)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ESTIMATOR_CACHE_DIR"] = folder
        for step in ("built", "read"):
            tracker = StarTracker.for_sky(camera, stars=stars)
            begin = time.perf_counter()
            megabytes = sum(array.nbytes for array in tracker.quads) / 1e6
            taken = time.perf_counter() - begin
            rows.append(figure(f"2.6 deg to V 10: index of quads {step} in", taken, "s"))
        rows.append(figure("2.6 deg to V 10: index of quads", megabytes, "MB"))
        tracker.warm_up()
        for share in FALSE_SHARES:
            rows += narrow_times(tracker, share)
        rows += narrow_command(tracker, Path(folder))
    return rows


def narrow_command(tracker: StarTracker, folder: Path) -> list[dict[str, Any]]:
    """Memory and CPU time of `skysim solve` for lists of lights of narrow fields, its index on disk.

    A refused list is also tried with all other fields of view, whose trackers are built for it.
    """
    out = folder / "solved"
    options = ["--fov", str(NARROW_DEG), "--size", f"{NARROW_PX}x{NARROW_PX}"]
    options += ["--catalog", str(deep_catalog().resolve()), "--out", str(out)]

    def used(lists: list[str]) -> list[float]:
        command = [sys.executable, "-c", MEASURED, "solve", *options, *lists]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return [float(word) for word in done.stdout.splitlines()[-1].split()]

    clean, crowd = (narrow_lists(tracker, folder, share) for share in FALSE_SHARES)
    first = used(clean[:1])  # it builds the index
    one = used(clean[:1])
    many = used(clean)
    refused_mb = [
        used(crowd)[0] for _ in range(2)
    ]  # the first one builds the indexes of other fields
    solutions = json.loads((out / "solutions.json").read_text(encoding="utf-8"))
    solved = [found["file"] for found in solutions if found["status"] == "solved"]
    a_frame_s = (many[2] - one[2]) / (COMMAND_FIELDS - 1)
    what = f"{COMMAND_FIELDS} lists of lights"
    false = f"{100 * FALSE_SHARES[1]:.0f} % false lights"
    name = "2.6 deg to V 10, skysim solve"
    refused = f"{what}, {len(crowd) - len(solved)} refused"
    return [
        verdict(f"{name}: greatest memory", many[0], "MB", what, 400),
        verdict(
            f"{name}: greatest memory, {false}, solved",
            used(solved)[0],
            "MB",
            f"{len(solved)} lists of lights",
            400,
        ),
        figure(f"{name}: greatest memory, {false}", refused_mb[1], "MB", refused),
        figure(f"{name}: the same, indexes built", refused_mb[0], "MB", refused),
        figure(f"{name}: private memory at the end", many[1], "MB", what),
        figure(f"{name}: greatest memory, index built", first[0], "MB", "1 list"),
        verdict(f"{name}: CPU of a frame", a_frame_s, "s", what, 0.3),
    ]


def narrow_lists(tracker: StarTracker, folder: Path, false_share: float) -> list[str]:
    """Files of lights of narrow fields, with a share of false lights."""
    lists = []
    for n in range(COMMAND_FIELDS):
        rng = np.random.default_rng([4, n])
        seen = crowded(tracker, Rotation.random(rng=rng), false_share, rng)
        table = np.column_stack([seen.xy_px, seen.flux])
        lists.append(str(folder / f"{n}_{100 * false_share:.0f}.csv"))
        np.savetxt(lists[-1], table, delimiter=",", header="x_px,y_px,flux", comments="")
    return lists


def narrow_times(tracker: StarTracker, false_share: float) -> list[dict[str, Any]]:
    """Median and 90 % of the times of narrow fields with a share of false lights, and the fields solved right."""
    name = f"2.6 deg to V 10, {100 * false_share:.0f} % false"
    seconds = []
    right = 0
    for n in range(NARROW_FIELDS):
        rng = np.random.default_rng([4, n])
        attitude = Rotation.random(rng=rng)
        seen = crowded(tracker, attitude, false_share, rng)
        begin = time.perf_counter()
        solved = tracker.solve_centroids(seen).cam_from_ref
        seconds.append(time.perf_counter() - begin)
        right += solved is not None and (solved * attitude.inv()).magnitude() < WRONG_RAD
    middle, late = 1e3 * np.quantile(seconds, [0.5, 0.9])
    what = f"{NARROW_FIELDS} fields"
    return [
        verdict(f"{name}: median", float(middle), "ms", what, 1.0),
        figure(f"{name}: 90 %", float(late), "ms", what),
        verdict(f"{name}: right", 100 * right / NARROW_FIELDS, "%", what, 98, least=True),
    ]


def crowded(
    tracker: StarTracker, attitude: Rotation, false_share: float, rng: np.random.Generator
) -> Centroids:
    """All stars in the field at an attitude, with noise, and false lights of the catalog's magnitudes."""
    rows, xy_px = tracker.field_matcher.in_field(tracker.camera, attitude)
    false = round(len(rows) * false_share / (1 - false_share))
    mag = tracker.stars.v_mag[rows] + 0.25 * rng.standard_normal(len(rows))
    mag = np.concatenate([mag, rng.choice(tracker.stars.v_mag, false)])
    places = rng.uniform(0, tracker.camera.width_px - 1, (false, 2))
    xy_px = np.concatenate([xy_px + 0.1 * rng.standard_normal(xy_px.shape), places])
    order = np.argsort(mag)
    return Centroids(xy_px[order], np.full(len(order), 0.1), 10 ** (-0.4 * mag[order]))


def field(tracker: StarTracker, rng: np.random.Generator) -> Centroids:
    """The 15 brightest stars in the field at a random attitude, with noise."""
    camera = tracker.camera
    attitude = Rotation.random(rng=rng)
    pixels = camera.pixels(attitude.apply(tracker.stars.vectors))
    rows = np.flatnonzero(camera.contains(np.nan_to_num(pixels, nan=-1e9)))[:15]
    xy = pixels[rows] + 0.1 * rng.standard_normal((len(rows), 2))
    return Centroids(xy, np.full(len(rows), 0.1), 10 ** (-0.4 * tracker.stars.v_mag[rows]))


def tetra3rs(camera: Camera, fields: list[Centroids]) -> Callable[[], Any] | None:
    """A function that solves the same fields with tetra3rs; None if it is not installed (extra `oracle`)."""
    if importlib.util.find_spec("tetra3rs") is None:
        return None
    from tetra3rs import SolverDatabase

    database = SolverDatabase.generate_from_gaia(max_fov_deg=16.0, star_max_magnitude=6.0)
    middle = np.array([*camera.center_px])
    tables = [np.column_stack([c.xy_px - middle, c.flux]) for c in fields]
    degrees = float(np.degrees(camera.fov_rad))
    return lambda: [
        database.solve_from_centroids(
            t,
            fov_estimate_deg=degrees,
            image_width=659,
            image_height=493,
            fov_max_error_deg=0.2,
        )
        for t in tables
    ]
