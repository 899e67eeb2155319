"""tetra3rs as a tracker (extra `oracle`): with our camera model it finds the true attitudes of our frames."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from estimator.core.camera import Camera
from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.results import scoring
from skysim.scene import loader
from skysim.simulation.flight import open_flight
from skysim.simulation.lab import build_lab, build_tracker
from skysim.tracking import tetra3rs as tetra3rs_tracker
from skysim.tracking import tracker_interface
from skysim.tracking.tracker_interface import Setup

tetra3rs = pytest.importorskip("tetra3rs")


def test_tetra3rs_s_camera_model_matches_ours() -> None:
    """Distorted, off-center: both turn pixels to the same tangents, by two pieces of code."""
    f = 2500.0
    center = (331.0, 244.0)
    bent = (-0.1, 0.05, 1e-3, -2e-3, 0.01)
    setup = Setup("icrs", "2012-06-22T21:00:00", 659, 493, f, center, bent, 1.0, 4095.0, 1)
    theirs = tetra3rs_tracker.camera_model(tetra3rs, setup)
    middle = tetra3rs_tracker.image_center_px(setup)
    xy_px = np.array([[20.0, 30.0], [600.0, 400.0], [330.0, 10.0]])
    tangents = [theirs.pixel_to_tanplane(*(xy - middle)) for xy in xy_px]
    ours = Camera(659, 493, f, center, bent).tangents(xy_px)
    np.testing.assert_allclose(tangents, ours, rtol=0, atol=1e-8)


@pytest.mark.parametrize("options", ["{}", "{fast: true}"])
def test_tetra3rs_solves_our_frames_without_bias(options: str) -> None:
    """Twelve fields; proper motion and aberration (20 arcsec) are both its own, so what is left is noise."""
    keys = {"tracker.name": "tetra3rs", "tracker.options": options, "exposure.frames": "12"}
    scene = loader.load("scoreboard", keys | {"motion.rate_deg_s": "[0.6, 0.8, 0]"})
    shots = list(open_flight(scene).shots())
    rows = [scoring.Score(shot).row for shot in shots]
    assert sum(row.status == "solved" for row in rows) >= 11
    assert not any(row.wrong for row in rows)
    turns = [
        (s.report.attitude.cam_from_ref * s.truth.cam_from_lab.inv()).as_rotvec()
        for s in shots
        if s.report.attitude.solved
    ]
    assert np.degrees(np.median(np.hypot(*np.array(turns).T[:2]))) * 3600 < 10


@pytest.mark.parametrize("name", ["afit_simsat", "collimated_display"])
def test_tetra3rs_is_refused_for_a_scene_without_a_sky(name: str) -> None:
    with pytest.raises(InputError, match=re.escape("tetra3rs solves star fields only")):
        build_tracker(build_lab(loader.load(name, {"tracker.name": "tetra3rs"})).camera)


PAGE = (ROOT / "docs/howto/external_tracker.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^skysim (.*--tracker tetra3rs.*)$", PAGE, re.MULTILINE)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_page_s_commands_run_without_wrong_attitudes(
    command: str, tmp_path: Path
) -> None:
    """Every frame is listed or counted, and none is wrong."""
    words = [
        sys.executable,
        "-m",
        "skysim",
        *shlex.split(command),
        "--json",
        "--out",
        str(tmp_path),
    ]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    lines = report.get(
        "scoreboard", [report | {"right": report.get("solved", 0) / report.get("frames", 1)}]
    )
    assert [line["wrong"] for line in lines] == [0] * len(lines)
    assert min(line["right"] for line in lines) > 0.9


def test_tetra3rs_is_an_entry_point_of_skysim() -> None:
    assert (
        tracker_interface.TRACKERS.entry_points()["tetra3rs"].load()
        is tetra3rs_tracker.Tetra3rs
    )
