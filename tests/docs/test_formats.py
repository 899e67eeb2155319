"""Every command and code block of docs/howto/export.md runs, in its order, in one folder."""

from __future__ import annotations

import contextlib
import io as std_io
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from skysim.apps.cli import main
from skysim.core.paths import ROOT
from skysim.results.files import recording
from skysim.results.files.run_export import EXPORTS

PAGE = (ROOT / "docs/howto/export.md").read_text(encoding="utf-8")
COMMANDS = [
    line
    for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
]
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like the checkout, where every command of the page has been run."""
    folder = tmp_path_factory.mktemp("formats")
    with contextlib.chdir(folder):
        for line in COMMANDS:
            main.app(shlex.split(line)[1:], standalone_mode=False)
    return folder


@pytest.mark.long
def test_the_commands_write_the_table_s_files(folder: Path) -> None:
    left = {path.name for path in (folder / "out" / "shefex2").iterdir()}
    expected = set(recording.EXPORT_FILES) - {"imu.parquet"} | {recording.ZARR}
    assert expected <= left
    assert {f"frame_000{n}.tif" for n in range(3)} <= left
    assert not [name for name in left if name.startswith(".")]
    named = set(re.findall(r"--to (\w+)", PAGE.partition("|---")[2]))
    assert named == set(EXPORTS)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*datfix")
def test_the_code_blocks_run(folder: Path) -> None:
    """In one session, as a reader would type them; the one with ccsds-ndm-py is run by `make oracle`."""
    names: dict[str, Any] = {}
    printed = std_io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed):
        for block in [block for block in BLOCKS if "ccsds_ndm" not in block]:
            exec(compile(block, "docs/howto/export.md", "exec"), names)
    assert "SkyCoord (ICRS)" in printed.getvalue()
    assert "(492, 658, 3)" in printed.getvalue()
    assert "-0.1     0.05    0.0005 -0.0003  0." in printed.getvalue()
    assert "b'px'" in printed.getvalue()


@pytest.mark.slow
def test_the_photograph_as_tiff_is_solved_by_the_calibration(folder: Path) -> None:
    answers = (folder / "out" / "solve" / "solutions.json").read_text()
    assert '"status": "solved"' in answers


def test_a_new_run_removes_the_exports_of_the_old_one(tmp_path: Path) -> None:
    """Old exports would describe other frames."""
    mine = tmp_path / "notes.aem"
    for name in (*recording.EXPORT_FILES, "frame_0003.tif", mine.name):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / recording.ZARR).mkdir()
    recording.remove_results(tmp_path)
    assert list(tmp_path.iterdir()) == [mine]
