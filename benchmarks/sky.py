"""The sky's other lights in rendered frames: wrong attitudes and solved shares, narrow fields, time of a deep sky.

`python -m benchmarks sky` builds a sky of Gaia to V 10 in out/catalogs first (needs the extra `catalog`). Frames are
those of SHEFEX-2's camera, and for narrow fields the same camera behind a longer lens of the same f-number, which sees
as many stars in a smaller field.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from benchmarks.timing import verdict
from skysim.experiments.study.api import run_study
from skysim.experiments.study.execution.trials import visible_rows
from skysim.scene.loader import load
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab
from skysim.sources import star_archives
from tests.helpers.changed_light import with_sources

DEEP = Path("out/catalogs/gaia_v10.0.ecsv")
FIELDS_DEG = 2, 3, 5
SHEFEX_DEG = 14.87
SHEFEX_MM = 25.0
NARROW_FRAMES = 500
BODY_FRAMES = 2500
MIN_STARS = 6  # of the tracker's catalog in the field
SEED = 26
BODIES = {
    "Moon": {
        "start_time": "2012-06-27T03:30:00",
        "trial.near": {"body": "moon", "off_deg": [0, 8]},
    },
    "full Moon": {
        "start_time": "2012-07-03T18:00:00",
        "trial.near": {"body": "moon", "off_deg": [0, 8]},
    },
    "Venus": {
        "start_time": "2012-04-30T00:00:00",
        "trial.near": {"body": "venus", "off_deg": [0, 8]},
    },
    "Jupiter": {
        "start_time": "2012-12-03T00:00:00",
        "trial.near": {"body": "jupiter", "off_deg": [0, 8]},
    },
}


def measure() -> list[dict[str, Any]]:
    """All rows of the area."""
    deep_catalog()
    return [
        *bodies(),
        *(row for fov_deg in FIELDS_DEG for row in narrow(fov_deg)),
        frame_time(),
    ]


def deep_catalog() -> Path:
    """The catalog of Gaia to V 10, which is built where it is missing."""
    if not DEEP.is_file():
        DEEP.parent.mkdir(parents=True, exist_ok=True)
        star_archives.build_gaia(10.0, DEEP)
    return DEEP


def bodies() -> list[dict[str, Any]]:
    """Wrong attitudes, and the solved share of frames with six catalog stars: a body in or near each field, a satellite
    in every field in the mean, and the airglow of a dark site.
    """
    lights = {
        "light.bodies": {},
        "light.satellites": {"random": {"per_field": 1, "seed": SEED}},
        "background": [{"kind": "sky", "mag_arcsec2": 21.9}],
    }
    trials = study_trials("shefex2", lights, {"body": {"levels": BODIES}}, BODY_FRAMES)
    lab = build_lab(load("shefex2"))
    enough = np.array([catalog_stars(lab, row) >= MIN_STARS for row in trials])
    return shares(
        f"bodies, satellites and airglow, {len(trials)} frames",
        trials[enough],
        len(trials),
        wrong_of=trials,
        bar=97,
    )


def narrow(fov_deg: float) -> list[dict[str, Any]]:
    """Wrong attitudes and the solved share of a narrow camera that knows the sky to V 10."""
    catalog = str(DEEP.resolve())
    focal_mm = (
        SHEFEX_MM
        * math.tan(math.radians(SHEFEX_DEG / 2))
        / math.tan(math.radians(fov_deg / 2))
    )
    camera = {
        "camera.focal_length": f"{focal_mm:.4g} mm",
        "light.catalog": catalog,
        "tracker.catalog": catalog,
        "tracker.limit_mag": 10,
    }
    trials = study_trials(
        "shefex2", camera, {"field": {"levels": {f"{fov_deg:g} deg": {}}}}, NARROW_FRAMES
    )
    return shares(
        f"{fov_deg:g} deg, sky and tracker to V 10",
        trials,
        len(trials),
        wrong_of=trials,
        bar=99,
    )


def study_trials(
    scene: str, settings: Mapping[str, Any], factors: Mapping[str, Any], replicates: int
) -> Any:
    """The table of all trials of a study of rendered frames."""
    plan = {
        "schema": 1,
        "title": "benchmarks sky",
        "scene": scene,
        "seed": SEED,
        "set": dict(settings),
        "trial": {"kind": "frames"},
        "factors": dict(factors),
        "replicates": replicates,
        "responses": ["identified", "wrong"],
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sky.yaml"
        path.write_text(yaml.safe_dump(plan), encoding="utf-8")
        return run_study(path, out=folder).trials()


def catalog_stars(lab: Lab, trial: Any) -> int:
    """Stars of the tracker's limiting magnitude on the chip at a trial's attitude."""
    wxyz = [trial[f"lab_from_body_{axis}"] for axis in "wxyz"]
    rows = visible_rows(lab, Rotation.from_quat([wxyz], scalar_first=True))[0].rows
    return int(np.sum(lab.camera.sources.magnitude[rows] <= lab.scene.tracker.limit_mag))


def shares(
    name: str, trials: Any, drawn: int, wrong_of: Any, bar: float
) -> list[dict[str, Any]]:
    """Rows of the solved share of some trials, and of the number of wrong attitudes among all."""
    solved = 100 * float(np.mean(trials["status"] == "solved"))
    wrong = float(np.sum(wrong_of["wrong"]))
    return [
        verdict(
            f"{name}: solved",
            solved,
            "%",
            f"{len(trials)} of {drawn} frames",
            bar,
            least=True,
        ),
        verdict(f"{name}: wrong", wrong, "frames", f"of {drawn}", 0),
    ]


def frame_time() -> dict[str, Any]:
    """Time of a 3 deg frame in a sky to V 10, over that where the sky holds only the stars within 10 deg of it."""
    focal_mm = SHEFEX_MM * SHEFEX_DEG / 3
    keys = {"light.catalog": str(DEEP.resolve()), "camera.focal_length": f"{focal_mm:.4g} mm"}
    whole = build_lab(load("shefex2", keys))
    boresight = whole.camera.mount.cam_from_body.inv().apply([0, 0, 1.0])
    direction = whole.start.apply(boresight)
    near = whole.camera.sources.place[:, :3] @ direction > math.cos(math.radians(10))
    part = with_sources(whole, whole.camera.sources.take(near))
    seconds: list[list[float]] = [[], []]
    for _ in range(40):
        for side, lab in enumerate((whole, part)):
            began = time.perf_counter()
            render_at_rest(lab.camera, lab.start)
            seconds[side].append(time.perf_counter() - began)
    ratio = min(seconds[0]) / min(seconds[1])
    what = f"{len(whole.camera.sources)} stars over {int(near.sum())}"
    return verdict(
        "frame of 3 deg, time in a deep sky over that of its stars alone",
        ratio,
        "",
        what,
        1.1,
    )
