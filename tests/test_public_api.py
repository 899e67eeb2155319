"""The public functions of `import skysim` and `import estimator`: names, laziness, and agreement with the commands."""

import dataclasses
import re
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

import estimator
import skysim
from skysim.apps.cli.main import app

AT_REST = {"exposure.frames": 3, "motion.rate_deg_s": [0, 0, 0]}


@pytest.fixture(scope="module")
def run() -> "skysim.results.run.Run":  # type: ignore[name-defined]
    return skysim.simulate(skysim.load_scene("shefex2", AT_REST))


@pytest.mark.parametrize("package", [skysim, estimator])
def test_every_public_name_exists(package: object) -> None:
    assert all(hasattr(package, name) for name in package.__all__)  # type: ignore[attr-defined]
    assert not hasattr(package, "no_such_name")


@pytest.mark.parametrize("package", ["skysim", "estimator"])
def test_an_import_loads_no_library(package: str) -> None:
    script = f"import sys, {package}; print({{'numpy', 'scipy', 'numba', 'mujoco', 'cv2'}} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "set()"


def test_the_command_line_loads_no_library_until_a_command_runs() -> None:
    script = "import sys, skysim.apps.cli.main; print({'numpy', 'scipy', 'numba', 'mujoco', 'cv2'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize("command", [["scenes"], ["study"], ["--version"]])
def test_a_list_of_files_loads_no_library(command: list[str]) -> None:
    script = (
        "import sys\nfrom skysim.apps.cli.main import app\n"
        f"app({command}, standalone_mode=False)\n"
        "print({'numpy', 'scipy', 'numba', 'mujoco', 'cv2'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "set()"


def test_scenes_are_validated_without_libraries_of_pictures_and_tables() -> None:
    script = (
        "import sys\nfrom skysim.apps.cli.main import app\n"
        "app(['validate', 'shefex2', 'afit_simsat'], standalone_mode=False)\n"
        "libraries = {'astropy', 'cv2', 'jinja2', 'matplotlib', 'pandas', 'PIL', 'rich', 'skimage'}\n"
        "print(libraries & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "set()"


def test_a_run_is_a_sequence_of_scored_frames(run) -> None:
    assert len(run) == 3
    assert [frame.row.frame for frame in run] == [0, 1, 2]
    assert all(frame.attitude.solved for frame in run)
    assert not np.shares_memory(run[0].image, run[1].image)


def test_the_total_error_is_the_rotation_angle_of_its_parts(run) -> None:
    """For small angles the error squared is that across the boresight squared plus that of the roll squared."""
    for frame in run:
        parts = np.hypot(frame.row.cross_arcsec, frame.row.roll_arcsec)
        assert frame.error_arcsec == pytest.approx(parts, rel=1e-6)


def test_a_frame_rendered_alone_equals_that_of_the_run(run) -> None:
    frame, truth = skysim.render(run.scene, index=2)
    np.testing.assert_array_equal(frame.image_dn, run[2].image)
    np.testing.assert_array_equal(
        truth.cam_from_lab.as_quat(), run[2].truth.cam_from_lab.as_quat()
    )


@pytest.mark.parametrize("index", [-1, 3])
def test_an_index_outside_of_the_scene_is_refused(run, index: int) -> None:
    with pytest.raises(skysim.InputError, match=r"index: -?\d is outside .* allowed: 0 to 2"):
        skysim.render(run.scene, index=index)


@pytest.mark.slow
def test_a_saved_run_equals_the_command_s_output(run, tmp_path) -> None:
    ours = run.save(tmp_path / "ours")
    words = ["run", "shefex2", "--frames", "3", "--set", "motion.rate_deg_s=[0,0,0]"]
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "theirs")])
    assert done.exit_code == 0, done.output
    names = sorted(path.name for path in ours.iterdir())
    assert names == sorted(path.name for path in (tmp_path / "theirs").iterdir())
    assert "report.html" in names
    for name in names:
        if name not in ("report.html", "solutions.ecsv"):  # which hold seconds of wall clock
            assert (ours / name).read_bytes() == (tmp_path / "theirs" / name).read_bytes(), (
                name
            )


@pytest.mark.slow
def test_only_a_report_of_several_frames_has_plots_against_time(run, tmp_path) -> None:
    one = dataclasses.replace(run, scores=run.scores[:1]).save(tmp_path / "one")
    three = run.save(tmp_path / "three")
    headings = [
        re.findall("<h2>(.*?)</h2>", (folder / "report.html").read_text("utf-8"))
        for folder in (three, one)
    ]
    assert headings[0][:3] == ["The last solved frame", "Errors", "Motion"]
    assert headings[1] == ["The last solved frame", *headings[0][3:]]


def test_a_table_has_one_row_per_frame(run) -> None:
    assert list(run.table()["frame"]) == [0, 1, 2]
    assert list(run.to_pandas()["status"]) == ["solved"] * 3


def test_notebook_views_show_image_and_numbers(run) -> None:
    for shown in (run, run[0], run.scene):
        page = shown._repr_html_()
        assert page.count("<table") == page.count("</table>")
        assert "shefex2" in page.lower() or "SHEFEX-2" in page or "frame 0" in page
    assert "data:image/jpeg;base64," in run._repr_html_()


@pytest.mark.slow
def test_a_solved_image_has_the_true_attitude(run, tmp_path) -> None:
    folder = run.save(tmp_path)
    found = skysim.solve(folder / "frame_0000.fits", fov_deg=14.87)
    ra_deg, dec_deg, _ = run[0].row.truth_deg
    assert found.status == "solved"
    assert [found.ra_deg, found.dec_deg] == pytest.approx([ra_deg, dec_deg], abs=0.02)
    with pytest.raises(skysim.InputError, match=r"no such file"):
        skysim.solve(folder / "missing.png")


def test_overrides_in_python_equal_those_of_the_command_line() -> None:
    scene = skysim.load_scene(
        "afit_simsat", {"exposure.time": "5 ms", "exposure.frames": 2, "seed": 7}
    )
    assert (scene.exposure.time_s, scene.exposure.frames, scene.seed) == (0.005, 2, 7)
    assert "shefex2" in skysim.list_scenes()
    with pytest.raises(skysim.InputError, match=r"exposure\.frames"):
        skysim.load_scene("shefex2", {"exposure.frames": 0})


def test_a_study_runs_and_is_continued(tmp_path) -> None:
    changes = {
        "replicates": 1,
        "factors": {"rate_deg_s": {"key": "trial.rate_deg_s", "values": [0, 1]}},
        "figures": [],
        "thresholds": [],
    }
    first = skysim.run_study("rate_smear", changes, out=tmp_path, workers=1)
    assert list(first.table()["rate_deg_s"]) == [0, 1]
    again = skysim.run_study("rate_smear", changes, out=tmp_path, workers=1)
    assert list(again.table()["identified"]) == list(first.table()["identified"])


def test_a_tracker_of_one_line_solves_a_frame(run) -> None:
    height_px, width_px = run[0].image.shape
    camera = estimator.Camera.from_fov(width_px, height_px, fov_deg=14.87)
    assert camera.fov_rad == pytest.approx(np.radians(14.87), rel=1e-12)
    tracker = estimator.StarTracker.for_sky(
        camera, limit_mag=6, date="2012-06-22", focal_uncertainty=0.05
    )
    found = tracker.solve(run[0].image).attitude
    assert found.ra_dec_roll_deg[:2] == pytest.approx(run[0].row.truth_deg[:2], abs=0.02)
    with pytest.raises(estimator.ImageError, match="either"):
        estimator.Camera.from_fov(1024, 1024)
    with pytest.raises(estimator.ImageError, match="ISO 8601"):
        estimator.StarTracker.for_sky(camera, date="yesterday")
