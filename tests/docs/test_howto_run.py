"""Every command of docs/howto/run.md runs, in its order, in one folder."""

from pathlib import Path

import mujoco
import pytest

from tests.helpers import doc_pages as pages

PAGE = "docs/howto/run.md"
pytestmark = pytest.mark.long  # every command of the page, each in a process of its own


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder that looks like the checkout, where every command of the page has been run."""
    folder = pages.checkout(tmp_path_factory.mktemp("run"))
    pages.run_commands(PAGE, folder)
    return folder


def test_the_commands_write_the_page_s_files(folder):
    ran = {path.name for path in (folder / "out" / "short").iterdir()}
    frames = {f"frame_000{n}.{suffix}" for n in (0, 1) for suffix in ("fits", "png", "ecsv")}
    assert ran == frames | {
        "solutions.ecsv",
        "telemetry.ecsv",
        "annotated.png",
        "report.html",
    }
    # `render` came after `run` and removed what the latter said of other frames.
    rendered = {path.name for path in (folder / "out" / "shefex2").iterdir()}
    assert rendered == {
        f"frame_0000.{suffix}" for suffix in ("fits", "png", "ecsv", "preview.png")
    }


def test_every_file_of_a_run_is_in_the_table(folder):
    page = pages.text(PAGE)
    left = {path.name for path in (folder / "out" / "simsat_bump").iterdir()}
    assert [
        name for name in left if f"`{name}`" not in page and not name.startswith("frame_")
    ] == []


def test_the_3d_views_are_written_or_the_reason_is_printed(folder):
    """`--scene-3d`: with OpenGL both files, without it the run's report all the same."""
    left = {path.name for path in (folder / "out" / "simsat_slew").iterdir()}
    assert "report.html" in left
    assert ("scene_3d.png" in left) == ("scene_3d.gif" in left)


def test_the_exported_scene_steps_in_mujoco(folder):
    model = mujoco.MjModel.from_xml_path(str(folder / "out" / "simsat_cmg.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_step(model, data, nstep=200)
    assert not data.warning.number.any()
    assert data.time == pytest.approx(0.2)
