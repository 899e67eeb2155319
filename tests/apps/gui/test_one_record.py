"""What the page shows of a frame is the row of `solutions.ecsv`, in every scene."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from astropy.table import Table

from skysim.apps.gui.messages import FlightRow, SceneInfo
from skysim.apps.gui.page.run_panel import flight_table
from skysim.apps.gui.page.strips import rms_line
from skysim.apps.gui.worker.geometry import RANGES
from skysim.apps.gui.worker.tasks import Worker
from skysim.results import scoring
from skysim.scene import loader
from skysim.simulation.flight import open_flight
from tests.helpers.solutions import flown, numbers, solution
from tests.test_every_scene import FEWER, NAMES


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_flight_s_rows_are_those_of_the_command_line(name: str) -> None:
    overrides = {"exposure.frames": "2"} | FEWER.get(name, {})
    worker = Worker()
    info, _ = worker.open(name, overrides, False)
    rows = flown(worker)
    scene = loader.load(name, overrides)
    flight = open_flight(scene)
    shots = [scoring.Score(shot).row for shot in flight.shots(cameras=[0])]
    assert [numbers(one.row) for one in rows] == [numbers(row) for row in shots]
    for index, row in enumerate(shots):
        view = worker.flight_frame(index)
        assert view.result is not None
        assert numbers(view.result.row) == numbers(row)
        np.testing.assert_array_equal(view.angles_deg, row.truth_deg)
    # The file of the page holds the columns of the command's table, and its values.
    table = flight_table(rows, info.scene)
    expected = scoring.table(shots, scene)
    assert table.colnames[: len(expected.colnames)] == expected.colnames
    for column in set(expected.colnames) - {"time_ms"}:
        np.testing.assert_array_equal(table[column], expected[column])


def test_a_wrong_attitude_is_counted_in_the_flight_s_line() -> None:
    fine = solution((), cross_arcsec=3.0, roll_arcsec=4.0).row
    wrong = solution((), cross_arcsec=9000.0, roll_arcsec=0.0, wrong=True).row
    refused = solution((), "too few").row
    rows = [FlightRow(row, 5, 0, np.nan, np.nan) for row in (fine, wrong, refused)]
    assert rms_line(rows).startswith("2 of 3 frames solved, 1 wrong;")


@pytest.fixture(scope="module", params=NAMES)
def at_rest(request: pytest.FixtureRequest) -> tuple[Worker, SceneInfo]:
    """The worker of a page on which a scene was opened; the tests move it in their order."""
    worker = Worker()
    info, _ = worker.open(request.param, FEWER.get(request.param, {}), False)
    return worker, info


@pytest.mark.slow
def test_an_exported_scene_rests_at_the_shown_attitude(
    at_rest: tuple[Worker, SceneInfo], tmp_path: Path
) -> None:
    worker, info = at_rest
    # It has no other attitudes than those of its profile.
    if info.scene.name == "two_axis_mount":
        worker.move(0.01, 0.01, 1.0, False)
        assert set(yaml.safe_load(worker.export()["scene.yaml"])) == {"schema", "base"}
        return
    shown = worker.move(0.01, 0.01, 1.0, False)
    path = tmp_path / "scene.yaml"
    path.write_bytes(worker.export()["scene.yaml"])
    again = Worker()
    _, view = again.open(str(path), {}, False)
    np.testing.assert_allclose(view.angles_deg, shown.angles_deg, rtol=0, atol=1e-9)
    # Also in flight: nothing moves it.
    flight = open_flight(loader.load(str(path), {"exposure.frames": "1"}))
    (shot, *_) = flight.shots(solves=False)
    truth_deg = scoring.true_angles_deg(shot.camera, shot.truth)
    np.testing.assert_allclose(truth_deg, shown.angles_deg, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_typed_angles_are_the_shown_ones(at_rest: tuple[Worker, SceneInfo]) -> None:
    worker, info = at_rest
    typed = (3.0, 2.0, 1.0)
    assert all(RANGES[angle][0] <= 1.0 for angle in info.names)
    view = worker.point(typed, False)
    np.testing.assert_allclose(view.angles_deg, typed, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_exported_command_and_python_show_the_same_frame(tmp_path: Path) -> None:
    worker = Worker()
    worker.open("afit_simsat_ideal", {"exposure.frames": "1"}, True)
    shown = worker.point((3.0, 2.0, 1.0), True)
    files = worker.export()
    command = shlex.split(files["command.txt"].decode())
    out = tmp_path / "out"
    subprocess.run([sys.executable, "-m", *command, "--out", out], check=True, cwd=tmp_path)
    (row,) = Table.read(out / "solutions.ecsv")
    np.testing.assert_allclose(
        [row["true_roll_deg"], row["true_pitch_deg"], row["true_yaw_deg"]],
        shown.angles_deg,
        rtol=0,
        atol=1e-6,
    )
    printed = subprocess.run(
        [sys.executable, "-c", files["scene.py"]],
        check=True,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert printed.stdout.startswith("<frame 0: solved")


@pytest.mark.slow
def test_the_export_of_a_flight_s_frame_is_the_scene_that_flew() -> None:
    worker = Worker()
    worker.open("simsat_slew", {"exposure.frames": "2"}, False)
    flown(worker)
    worker.flight_frame(1)
    tree = yaml.safe_load(worker.export()["scene.yaml"])
    assert tree == {
        "schema": tree["schema"],
        "base": "simsat_slew",
        "exposure": {"frames": 2},
    }
    worker.render(False)
    assert "start" in yaml.safe_load(worker.export()["scene.yaml"])["motion"]
