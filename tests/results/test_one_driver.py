"""The command line and Python run a scene by the same code, which renders each frame once."""

from __future__ import annotations

import hashlib
from pathlib import Path
from unittest import mock

import pytest
from astropy.table import Table
from typer.testing import CliRunner

import skysim
from skysim.apps.cli.main import app
from skysim.simulation import exposure

TIMES = ("time_ms",)  # of this run, not of the scene


def digest(path: Path) -> str:
    """Hash of a file; tables are hashed without computing times."""
    if path.name != "solutions.ecsv":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    table = Table.read(path)
    table.remove_columns(TIMES)
    return hashlib.sha256(repr(table.as_array().tolist()).encode()).hexdigest()


def digests(folder: Path) -> dict[str, str]:
    """Hashes of all files except reports, which contain their command."""
    files = [
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".html"
    ]
    return {str(path.relative_to(folder)): digest(path) for path in files}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "frames"), [("shefex2", 2), ("two_heads", 2)])
def test_the_command_and_python_write_the_same_files(
    tmp_path: Path, name: str, frames: int
) -> None:
    by_command = CliRunner().invoke(
        app, ["run", name, "--frames", str(frames), "--out", str(tmp_path / "command")]
    )
    assert by_command.exit_code == 0, by_command.output
    skysim.simulate(skysim.load_scene(name, {"exposure.frames": frames})).save(
        tmp_path / "python"
    )
    written = digests(tmp_path / "command")
    assert written == digests(tmp_path / "python")
    assert "frame_0001.fits" in written


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cameras"), [("shefex2", 1), ("simsat_bump", 1), ("two_heads", 2)]
)
def test_each_frame_of_each_camera_is_exposed_once_with_a_filter_or_without(
    name: str, cameras: int
) -> None:
    with mock.patch.object(exposure, "expose", wraps=exposure.expose) as exposed:
        skysim.simulate(skysim.load_scene(name, {"exposure.frames": 2}))
    assert exposed.call_count == 2 * cameras


@pytest.mark.slow
def test_a_run_along_a_given_table_is_saved(tmp_path: Path) -> None:
    """A table in memory has no file that the check of the plan could read."""
    level = [0.0] * 4
    table = Table(
        {
            "t_s": [0.0, 1.0, 2.0, 3.0],
            "roll_deg": [0.0, 0.5, 1.0, 1.5],
            "pitch_deg": level,
            "yaw_deg": level,
        }
    )
    run = skysim.simulate(
        skysim.load_scene("afit_simsat", {"exposure.frames": 1}), profile=table
    )
    assert (run.save(tmp_path / "run") / "report.html").is_file()
