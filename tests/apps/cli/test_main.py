"""The command line: printed text, written files, and one error line for each wrong input."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import mujoco
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from skysim.apps.cli import main
from skysim.apps.cli.options import load
from skysim.core import images
from skysim.core.errors import InputError
from skysim.core.paths import SCENES, shipped_files
from skysim.scene import loader

SHEFEX = SCENES / "shefex2.yaml"
ANSWER = {
    "lights",
    "brightest_dn",
    "background_dn",
    "tried_fov_deg",
    "catalog_limit_mag",
    "hint",
    "file",
    "status",
    "ra_deg",
    "dec_deg",
    "roll_deg",
    "fov_deg",
    "cam_from_icrs_xyzw",
    "covariance_rad2",
    "focal_px",
    "center_px",
    "distortion",
    "pixel_aspect",
    "log10_chance",
    "matches",
    "rms_arcsec",
    "stars",
    "date_utc",
    "time_ms",
}


class Ran(NamedTuple):
    code: int
    out: str
    err: str

    def one_line(self) -> str:
        """The complaint: exit code 2, one line on stderr, no traceback."""
        assert self.code == 2
        assert self.err.count("\n") == 1
        assert self.err.startswith("skysim: ")
        assert "Traceback" not in self.err + self.out
        return self.err.strip()


class Skysim:
    """Runs the command in this process; stderr is read at the file descriptor, where C libraries print too."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
    ) -> None:
        self.monkeypatch = monkeypatch
        self.capfd = capfd

    def __call__(self, *words: object) -> Ran:
        self.monkeypatch.setattr(sys, "argv", ["skysim", *map(str, words)])
        with pytest.raises(SystemExit) as left:
            main.main()
        out, err = self.capfd.readouterr()
        return Ran(int(left.value.code or 0), out, err)


@pytest.fixture
def skysim(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Skysim:
    return Skysim(monkeypatch, capfd)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `skysim render shefex2 --frames 1`, by the real command."""
    folder = tmp_path_factory.mktemp("rendered")
    command = [
        sys.executable,
        "-c",
        "from skysim.apps.cli.main import main; main()",
        "render",
        "shefex2",
    ]
    done = subprocess.run(
        [*command, "--frames", "1", "--out", str(folder)], capture_output=True, text=True
    )
    assert done.returncode == 0
    assert done.stderr == ""
    return folder


def frame_of(rendered: Path) -> np.ndarray:
    return images.read_image(rendered / "frame_0000.fits")


# What it does


def test_help_lists_the_commands(skysim: Skysim) -> None:
    ran = skysim("--help")
    assert ran.code == 0
    for command in ("run", "render", "solve", "scenes", "catalog"):
        assert f" {command} " in ran.out


@pytest.mark.slow
def test_scenes_are_listed_with_their_titles(skysim: Skysim) -> None:
    listed = json.loads(skysim("scenes", "--json").out)
    assert [entry["name"] for entry in listed] == list(shipped_files(SCENES))
    for entry in listed:
        assert loader.load(entry["file"]).title == entry["title"]
    assert "AFIT SimSat" in skysim("scenes").out


@pytest.mark.slow
def test_export_writes_a_scene_that_mujoco_loads(skysim: Skysim, tmp_path: Path) -> None:
    path = tmp_path / "made" / "lab.xml"
    done = skysim("scenes", "export", "simsat_cmg", "--out", path)
    assert (done.code, done.err) == (0, "")
    assert str(path) in done.out
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.joint("gimbal_1").id >= 0
    assert "nothing: no such scene" in skysim("scenes", "export", "nothing").one_line()


@pytest.mark.slow
def test_export_writes_a_list_of_leds_that_a_scene_reads(
    skysim: Skysim, tmp_path: Path
) -> None:
    path = tmp_path / "leds.csv"
    done = skysim("scenes", "export", "afit_simsat", "--out", path)
    layout = f"{{kind: listed, cap_deg: 28, file: {path}}}"
    assert (done.code, done.out) == (0, f"{path}: light.layout: {layout}\n")
    assert skysim("check", "afit_simsat", "--set", f"light.layout={layout}").code == 0
    assert "allowed: dome" in skysim("scenes", "export", "shefex2", "--out", path).one_line()


@pytest.mark.long
def test_without_opengl_the_run_continues_and_reports_the_missing_picture(
    skysim: Skysim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    done = skysim(
        "run", "shefex2", "--frames", "1", "--scene-3d", "--json", "--out", tmp_path
    )
    assert done.code == 0
    assert done.err.count("\n") == 1
    assert done.err.startswith("skysim: no picture of the lab: ")
    assert "apt-get install" in done.err
    assert json.loads(done.out)["pictures"] == []
    assert (tmp_path / "report.html").is_file()
    assert not (tmp_path / "scene_3d.png").exists()


@pytest.mark.long
def test_render_writes_only_frames_with_their_truth(rendered: Path) -> None:
    assert {p.name for p in rendered.iterdir()} == {
        "frame_0000.fits",
        "frame_0000.png",
        "frame_0000.ecsv",
    }


@pytest.mark.slow
def test_an_error_at_the_first_frame_keeps_earlier_results(
    skysim: Skysim, tmp_path: Path
) -> None:
    words = ["render", "afit_simsat", "--frames", "1", "--out", str(tmp_path)]
    assert skysim(*words).code == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    refused = skysim(*words, "--set", "camera.focus=infinity", "--set", "camera.f_number=0.3")
    assert refused.code == 2
    assert refused.err.startswith("skysim: camera.focus: ")
    assert refused.err.count("\n") == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.slow
def test_a_black_frame_of_a_camera_outside_of_the_dome_has_a_warning(
    skysim: Skysim, tmp_path: Path
) -> None:
    words = ["render", "apl_dome", "--frames", "1", "--out", str(tmp_path)]
    result = skysim(*words, "--set", "vehicle.camera=[0 m, 0 m, 5 m]")
    assert result.code == 0
    assert result.err.startswith(
        "skysim: vehicle.camera: 5 m from the bearing, outside of light.surface"
    )
    assert result.err.count("\n") == 1


@pytest.mark.slow
def test_a_preview_is_a_picture_beside_the_frame(skysim: Skysim, tmp_path: Path) -> None:
    ran = skysim("render", "shefex2", "--frames", "1", "--preview", "--out", str(tmp_path))
    assert ran.code == 0
    picture = cv2.imread(str(tmp_path / "frame_0000.preview.png"), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (2 * 659, 3)
    assert 2 * 493 < picture.shape[0] < 2 * 493 + 40  # the legend is below the frame
    skysim("render", "shefex2", "--frames", "1", "--out", str(tmp_path))
    assert not (tmp_path / "frame_0000.preview.png").exists()  # it spoke of an earlier run


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*datfix")
def test_render_then_solve_agrees_with_the_wcs_of_the_true_pointing(
    skysim: Skysim, rendered: Path, tmp_path: Path
) -> None:
    path = rendered / "frame_0000.fits"
    ran = skysim("solve", path, "--camera", "shefex2", "--json", "--out", tmp_path)  # by name
    assert (ran.code, ran.err) == (0, "")
    (answer,) = json.loads(ran.out)
    assert set(answer) == ANSWER
    assert answer["status"] == "solved"
    assert answer["matches"] >= 10
    wcs = WCS(fits.getheader(path))
    ra, dec = wcs.all_pix2world(329, 246, 0)
    east_deg = (answer["ra_deg"] - ra) * np.cos(np.radians(dec))
    assert np.hypot(east_deg, answer["dec_deg"] - dec) < 0.01
    # Position angle of up: where the sky goes when the pixel goes up by one.
    up_ra, up_dec = wcs.all_pix2world(329, 245, 0)
    roll = np.degrees(np.arctan2((up_ra - ra) * np.cos(np.radians(dec)), up_dec - dec))
    assert answer["roll_deg"] == pytest.approx(float(roll), abs=0.05)
    # Between the middles of the edge columns: 2 atan(329 x 9.9 um / 25 mm).
    assert answer["fov_deg"] == pytest.approx(
        2 * np.degrees(np.arctan(329 * 9.9e-3 / 25)), abs=1e-6
    )


@pytest.mark.slow
def test_solve_needs_no_hint(skysim: Skysim, rendered: Path, tmp_path: Path) -> None:
    """2 atan(658 x 9.9 um / 50 mm) between the middles of the edge columns, where the scene points."""
    ran = skysim("solve", rendered / "frame_0000.fits", "--json", "--out", tmp_path)
    (answer,) = json.loads(ran.out)
    assert answer["status"] == "solved"
    assert answer["fov_deg"] == pytest.approx(14.84, abs=0.05)
    assert answer["ra_deg"] == pytest.approx(83.0, abs=0.1)
    assert answer["dec_deg"] == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
def test_solve_ignores_an_impossible_header_date_with_a_warning(
    skysim: Skysim, rendered: Path, tmp_path: Path
) -> None:
    """Aberration is then left out, as without a date."""
    frames = {}
    for name, date in (
        ("none", None),
        ("late", "9012-06-22T21:00:00"),
        ("good", "2012-06-22T21:00:00"),
    ):
        frames[name] = tmp_path / f"{name}.fits"
        with fits.open(rendered / "frame_0000.fits") as hdus:
            hdus[0].header["DATE-OBS"] = date
            hdus.writeto(frames[name])
    ran = skysim(
        "solve", *frames.values(), "--camera", SHEFEX, "--json", "--out", tmp_path / "out"
    )
    none, late, good = json.loads(ran.out)
    assert ran.code == 0
    assert ran.err == (
        f"skysim: {frames['late']}: DATE-OBS 9012-06-22T21:00:00 is outside 1900 to 2100: ignored\n"
    )
    for key in ("ra_deg", "dec_deg", "roll_deg"):
        assert late[key] == none[key]
        assert late[key] != good[key]
    options = ["--time", "2012-06-22T21:00:00", "--json", "--out", tmp_path / "out"]
    ran = skysim("solve", frames["late"], "--camera", SHEFEX, *options)
    assert ran.err == ""
    assert json.loads(ran.out)[0]["ra_deg"] == good["ra_deg"]


@pytest.mark.slow
def test_solve_writes_what_it_prints_and_a_picture(
    skysim: Skysim, rendered: Path, tmp_path: Path
) -> None:
    ran = skysim(
        "solve", rendered / "frame_0000.png", "--fov", "14.8", "--json", "--out", tmp_path
    )
    assert json.loads((tmp_path / "solutions.json").read_text()) == json.loads(ran.out)
    assert {p.name for p in tmp_path.iterdir()} == {
        "solutions.json",
        "frame_0000.annotated.png",
    }
    height, width, channels = cv2.imread(str(tmp_path / "frame_0000.annotated.png")).shape
    assert (height * 659, channels) == (width * 493, 3)


@pytest.mark.slow
def test_solve_takes_a_folder_and_states_why_an_image_is_refused(
    skysim: Skysim, rendered: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "night"
    folder.mkdir()
    frame = cv2.imread(str(rendered / "frame_0000.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(folder / "a.png"), frame)
    cv2.imwrite(str(folder / "b.png"), frame[:, ::-1])
    ran = skysim("solve", folder, "--fov", "14.8", "--out", tmp_path / "out")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.count("  likely: perhaps mirrored: it solves when flipped") == 1
    assert f"{folder / 'b.png'}: no identification beyond chance: " in ran.out
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "solutions.json",
        "a.annotated.png",
        "b.annotated.png",
    }


@pytest.mark.slow
def test_solve_accepts_catalogs_by_name(
    skysim: Skysim, rendered: Path, tmp_path: Path
) -> None:
    path = rendered / "frame_0000.png"
    ran = skysim(
        "solve", path, "--fov", "14.8", "--catalog", "gaia_v8.0", "--json", "--out", tmp_path
    )
    assert json.loads(ran.out)[0]["catalog_limit_mag"] == 8.0
    assert (
        "--catalog: unknown catalog 'hip'; allowed: gaia_v8.0"
        in skysim("solve", path, "--catalog", "hip").one_line()
    )
    damaged = tmp_path / "x.ecsv"
    damaged.write_text("stars")
    assert (
        f"--catalog: {damaged}: not a star catalog"
        in skysim("solve", path, "--catalog", damaged).one_line()
    )


@pytest.mark.slow
def test_a_run_s_json_parses_and_counts(skysim: Skysim, tmp_path: Path) -> None:
    ran = skysim("run", "shefex2", "--frames", "2", "--json", "--out", tmp_path)
    assert (ran.code, ran.err) == (0, "")
    report = json.loads(ran.out)
    assert (report["scene"], report["frames"], len(report["rows"])) == ("shefex2", 2, 2)
    assert report["solved"] == sum(row["status"] == "solved" for row in report["rows"])
    assert report["wrong"] == 0
    page = Path(report["report"]).read_text()
    assert "<html" in page
    assert 'src="http' not in page
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


@pytest.mark.slow
def test_the_same_seed_writes_the_same_bytes(
    skysim: Skysim, rendered: Path, tmp_path: Path
) -> None:
    assert skysim("render", "shefex2", "--frames", "1", "--out", tmp_path).code == 0
    for name in ("frame_0000.fits", "frame_0000.png", "frame_0000.ecsv"):
        assert (tmp_path / name).read_bytes() == (rendered / name).read_bytes()


def test_a_shorter_run_leaves_no_frames_of_a_longer_one(
    skysim: Skysim, tmp_path: Path
) -> None:
    (tmp_path / "frame_0039.fits").write_bytes(b"old")
    skysim("render", "shefex2", "--frames", "1", "--out", tmp_path)
    assert not (tmp_path / "frame_0039.fits").exists()


@pytest.mark.slow
def test_an_option_overrides_the_scene(skysim: Skysim, tmp_path: Path) -> None:
    skysim(
        "render",
        "shefex2",
        "--frames",
        "1",
        "--seed",
        "9",
        "--out",
        tmp_path,
        "--set",
        "title=Nine",
    )
    assert fits.getheader(tmp_path / "frame_0000.fits")["SEED"] == 9


@pytest.mark.parametrize("stage", ["detector", "centroider", "identifier", "solver"])
def test_a_stage_of_a_run_is_named_by_its_option(
    skysim: Skysim, tmp_path: Path, stage: str
) -> None:
    ran = skysim("run", "shefex2", f"--{stage}", "magic", "--out", tmp_path / "out")
    assert f"tracker.{stage}: unknown {stage} 'magic'; allowed: " in ran.one_line()
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_stages_of_a_run_are_those_named(skysim: Skysim, tmp_path: Path) -> None:
    """The option overrides the scene and --set; TRIAD uses two stars where the scene's QUEST uses all."""
    words = [
        "run",
        "shefex2",
        "--frames",
        "1",
        "--json",
        "--out",
        tmp_path,
        "--set",
        "tracker.solver=magic",
    ]
    named = [
        "--detector",
        "default",
        "--centroider",
        "cog",
        "--identifier",
        "pyramid",
        "--solver",
    ]
    (triad,), (quest,) = (
        json.loads(skysim(*words, *named, solver).out)["rows"]
        for solver in ("triad", "quest")
    )
    assert (triad["status"], quest["status"]) == ("solved", "solved")
    assert triad["matched"] == quest["matched"]
    assert triad["cross_sigma_arcsec"] > 1.1 * quest["cross_sigma_arcsec"]


@pytest.mark.slow
def test_exposure_times_are_recorded_frame_by_frame(skysim: Skysim, tmp_path: Path) -> None:
    """By `run` and by `render`, which make the same frames."""
    growing = "tracker.exposure_control={mean_dn: 500, min_stars: 1000}"
    words = ["shefex2", "--frames", "2", "--out", tmp_path, "--set", growing]
    ran = json.loads(skysim("run", *words, "--json").out)
    assert ran["exposures_ms"] == pytest.approx([40, 42], abs=1e-9)
    solved = [images.read_image(tmp_path / f"frame_000{n}.fits") for n in (0, 1)]
    assert skysim("render", *words).code == 0
    exposures_s = [fits.getheader(tmp_path / f"frame_000{n}.fits")["EXPTIME"] for n in (0, 1)]
    assert exposures_s == pytest.approx([0.040, 0.042], abs=1e-12)
    for n in (0, 1):
        np.testing.assert_array_equal(
            images.read_image(tmp_path / f"frame_000{n}.fits"), solved[n]
        )


# Scenes that are wrong


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ["nosuch"],
            "nosuch: no such scene; allowed: a .yaml file or one of afit_as_built, ",
        ),
        (
            ["shefex2", "--set", "camera.focal_lenght=25 mm"],
            "unknown key; did you mean focal_length?; allowed: ",
        ),
        (
            ["shefex2", "--set", "camera.focal_length=25"],
            "25 has no unit; allowed: a length such as",
        ),
        (
            ["shefex2", "--set", "camera.focal_length=25 kg"],
            "'25 kg' is not a length; allowed: a length such as",
        ),
        (
            ["shefex2", "--set", "exposure.time=-40 ms"],
            "'-40 ms' is not allowed; allowed: greater than or equal to 0.000001",
        ),
        (
            ["shefex2", "--set", "exposure.time=nan s"],
            "nan is not allowed; allowed: a finite number",
        ),
        (
            ["afit_simsat", "--set", "light.led.falloff=cubic"],
            "light.led.falloff: 'cubic' is not allowed; allowed: 'inverse_square'",
        ),
        (
            ["afit_simsat", "--set", "motion.start={ra_deg: 3, dec_deg: 4}"],
            "requires roll_deg, pitch_deg, yaw_deg",
        ),
        (
            ["afit_simsat", "--set", "motion.start={roll_deg: 40}"],
            "up to vehicle.tilt_stop_deg 30",
        ),
        (
            ["afit_simsat", "--set", "light.surface.apex=90 in"],
            "the bearing's center is outside of the dome",
        ),
        (
            ["shefex2", "--set", "tracker.identifier=magic"],
            "tracker.identifier: unknown identifier 'magic'; allowed: default, pyramid",
        ),
        (
            ["shefex2", "--set", "tracker.solver=rotation_only"],
            "unknown solver 'rotation_only'; allowed: ",
        ),
        (
            ["shefex2", "--set", "light.catalog=nosuch"],
            "light.catalog: unknown catalog 'nosuch'; allowed: gaia_v8.0, hipparcos_hp6.5",
        ),
        (["shefex2", "--set", "vehicle.model=nosuch.xml"], "nosuch.xml: no such file"),
        (
            ["shefex2", "--set", "camera.preset=nosuch"],
            "camera.preset: unknown preset 'nosuch'; allowed: aps, cmv4000, ec655, ",
        ),
        (
            ["shefex2", "--set", "camera.psf={kind: gauss}"],
            "psf.kind: unknown kind 'gauss'; allowed: gaussian, ",
        ),
        (
            ["shefex2", "--set", "camera.psf={kind: measured, file: nosuch.csv}"],
            "nosuch.csv",
        ),
        (
            ["shefex2", "--set", "camera.detector.quantum_efficiency=nosuch.csv"],
            "unknown curve 'nosuch.csv'; allowed: bayer_blue",
        ),
        (
            ["shefex2", "--set", "background=[{kind: aurora}]"],
            "background.0.kind: unknown kind 'aurora'; allowed: uniform, ",
        ),
        (
            [
                "shefex2",
                "--set",
                "motion.jitter=[{kind: line, frequency_hz: 1e6, rms_arcsec: [1, 1, 1]}]",
            ],
            "motion.jitter: 1e+06 Hz over ",
        ),
        (["shefex2", "--set", "seed"], "--set: seed; allowed: path.to.key=value"),
        (["shefex2", "--set", "seed=["], "seed: '[' is not YAML (--set)"),
        (["shefex2", "--frames", "0"], "--frames: 0 is not allowed"),
        (["shefex2", "--seed", "-1"], "seed: -1 is not allowed"),
        (["shefex2", "--frames", "many"], "--frames"),
        (["shefex2", "--nosuch"], "--nosuch"),
        ([], ""),
        (
            ["shefex2", "--set", "tracker.exposure_control={mean_dn: 150, longest: 101 ms}"],
            "tracker.exposure_control.longest: 0.101 s is longer than the frame period 0.1 s (--set)",
        ),
    ],
)
@pytest.mark.parametrize("command", ["run", "render"])
def test_a_bad_scene_is_refused_in_one_line_and_leaves_no_file(
    skysim: Skysim, tmp_path: Path, command: str, words: list[str], says: str
) -> None:
    assert says in skysim(command, *words, "--out", tmp_path / "out").one_line()
    assert not (tmp_path / "out").exists()


def test_an_error_in_a_scene_file_is_reported_with_its_line(
    skysim: Skysim, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        (SCENES / "afit_simsat.yaml").read_text().replace("inverse_square", "cubic")
    )
    line = path.read_text()[: path.read_text().index("falloff:")].count("\n") + 1
    said = skysim("render", path).one_line()
    assert (
        said
        == f"skysim: light.led.falloff: 'cubic' is not allowed; allowed: 'inverse_square' ({path}, line {line})"
    )


def test_a_file_that_is_not_yaml_is_refused_in_one_line(
    skysim: Skysim, tmp_path: Path
) -> None:
    (tmp_path / "mine.yaml").write_text("a: [1, 2\nb: {")
    assert "not YAML" in skysim("render", tmp_path / "mine.yaml").one_line()


def test_an_unknown_command_is_refused_in_one_line(skysim: Skysim) -> None:
    assert "nosuch" in skysim("nosuch").one_line()
    assert "nosuch" in skysim("catalog", "info", "nosuch").one_line()


def test_without_a_command_the_help_is_shown(skysim: Skysim) -> None:
    ran = skysim()
    assert "Usage" in ran.out + ran.err
    assert "Traceback" not in ran.out + ran.err


def test_a_folder_that_cannot_be_made_is_refused_in_one_line(
    skysim: Skysim, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    said = skysim(
        "render", "shefex2", "--frames", "1", "--out", tmp_path / "file" / "out"
    ).one_line()
    assert "cannot be created as a folder" in said


# Images that are wrong


def as_fits(folder: Path, image: np.ndarray) -> Path:
    fits.PrimaryHDU(image).writeto(folder / "bad.fits")
    return folder / "bad.fits"


def as_png(folder: Path, image: np.ndarray) -> Path:
    cv2.imwrite(str(folder / "bad.png"), image)
    return folder / "bad.png"


def cut(whole: Path, folder: Path) -> Path:
    path = folder / f"bad{whole.suffix}"
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    return path


def text_as_png(folder: Path) -> Path:
    (folder / "bad.png").write_text("once upon a time")
    return folder / "bad.png"


def with_nan(image: np.ndarray) -> np.ndarray:
    changed = image.astype(np.float32)
    changed[100, 200] = np.nan
    return changed


BAD_IMAGES: dict[str, tuple[Any, str]] = {
    "wrong size": (
        lambda at, r: as_fits(at, frame_of(r)[:, :-1]),
        "658x493 pixels; this camera's are 659x493",
    ),
    "8 bits": (
        lambda at, r: as_png(at, (frame_of(r) // 16).astype(np.uint8)),
        "an 8-bit image; this camera's",
    ),
    "color": (
        lambda at, r: as_png(at, np.dstack([frame_of(r)] * 3)),
        "a color image of shape (493, 659, 3)",
    ),
    "empty frame": (
        lambda at, r: as_fits(at, np.zeros_like(frame_of(r))),
        "the frame is empty",
    ),
    "flat frame": (
        lambda at, r: as_fits(at, np.full_like(frame_of(r), 64)),
        "the frame is empty",
    ),
    "saturated": (
        lambda at, r: as_fits(at, np.full_like(frame_of(r), 4064)),
        "the frame is saturated",
    ),
    "truncated FITS": (
        lambda at, r: cut(r / "frame_0000.fits", at),
        "not a complete FITS file",
    ),
    "truncated PNG": (lambda at, r: cut(r / "frame_0000.png", at), "cannot be decoded"),
    "text": (lambda at, _: text_as_png(at), "cannot be decoded"),
    "missing": (lambda at, _: at / "nosuch.fits", "no such file"),
    "not an image": (lambda at, _: SHEFEX, "unknown image suffix; allowed: .fits"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(BAD_IMAGES))
def test_a_bad_image_is_refused_in_one_line_and_leaves_no_partial_file(
    skysim: Skysim, rendered: Path, tmp_path: Path, kind: str
) -> None:
    make, says = BAD_IMAGES[kind]
    path = make(tmp_path, rendered)
    out = tmp_path / "out"
    ran = skysim("solve", path, "--camera", SHEFEX, "--json", "--out", out)
    said = ran.one_line()
    assert says in said
    assert str(path) in said
    (answer,) = json.loads(ran.out)
    assert set(answer) == ANSWER
    assert answer["ra_deg"] is None
    assert [p.name for p in out.iterdir()] == ["solutions.json"]


@pytest.mark.slow
def test_a_bad_image_does_not_stop_the_next_one(
    skysim: Skysim, rendered: Path, tmp_path: Path
) -> None:
    good = rendered / "frame_0000.fits"
    ran = skysim(
        "solve",
        tmp_path / "nosuch.fits",
        good,
        "--camera",
        SHEFEX,
        "--json",
        "--out",
        tmp_path / "out",
    )
    ran.one_line()
    assert [answer["status"] == "solved" for answer in json.loads(ran.out)] == [False, True]


@pytest.mark.slow
def test_an_image_of_noise_is_refused(skysim: Skysim, tmp_path: Path) -> None:
    noise = 64 + 2 * np.random.default_rng(3).standard_normal((493, 659))
    path = as_fits(tmp_path, np.rint(noise).astype(np.uint16))
    ran = skysim("solve", path, "--camera", SHEFEX, "--json", "--out", tmp_path / "out")
    (answer,) = json.loads(ran.out)
    assert (ran.code, ran.err, answer["ra_deg"]) == (0, "", None)
    assert answer["status"] != "solved"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ["--fov", "15", "--camera", SHEFEX],
            "--fov: conflicts with a camera; allowed: one of the two",
        ),
        (["--fov", "0"], "--fov: 0; allowed: the horizontal field of view, 1 to 120 degrees"),
        (["--fov", "nan"], "--fov: nan; allowed"),
        (["--fov", "wide"], "--fov"),
        (["--camera", "nosuch.yaml"], "nosuch.yaml: cannot be read: No such file"),
        (
            ["--camera", "nosuch"],
            "nosuch: no such scene; allowed: a .yaml file or one of afit_as_built, ",
        ),
        (["--camera", SHEFEX, "--time", "yesterday"], "--time yesterday: allowed: ISO 8601"),
        (
            ["--time", "9999-12-31T23:59:59"],
            "--time: 9999-12-31T23:59:59 is outside 1900 to 2100",
        ),
        (["--time", "1899-12-31T23:59:59+00:00"], "is outside 1900 to 2100"),
        (["--detector", "magic"], "--detector: unknown detector 'magic'; allowed: default, "),
        (["--centroider", "magic"], "--centroider: unknown centroider 'magic'; allowed: "),
        (
            ["--identifier", "magic"],
            "--identifier: unknown identifier 'magic'; allowed: default, ",
        ),
        (
            ["--solver", "magic"],
            "--solver: unknown solver 'magic'; allowed: default, quest, ",
        ),
    ],
)
def test_a_wrong_option_of_solve_is_refused_in_one_line(
    skysim: Skysim, rendered: Path, tmp_path: Path, words: list[object], says: str
) -> None:
    ran = skysim("solve", rendered / "frame_0000.fits", *words, "--out", tmp_path / "out")
    assert says in ran.one_line()
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_faulty_camera_file_is_refused_in_one_line(
    skysim: Skysim, rendered: Path, tmp_path: Path
) -> None:
    camera = tmp_path / "camera.yaml"
    camera.write_text(SHEFEX.read_text().replace('focal_length: "25 mm"', "focal_length: 25"))
    said = skysim("solve", rendered / "frame_0000.fits", "--camera", camera).one_line()
    assert "camera.focal_length: 25 has no unit" in said
    assert f"({camera}, line " in said


# Check a plan, show a scene


@pytest.mark.slow
def test_check_prints_facts_and_warnings_in_eighty_columns(skysim: Skysim) -> None:
    ran = skysim("check", "afit_simsat", "--set", "light.led.intensity=60 mcd")
    assert (ran.code, ran.err) == (0, "")
    assert max(map(len, ran.out.splitlines())) <= 80
    for name in (
        "field of view",
        "lights in the field",
        "peak",
        "smear",
        "LED cap",
        "depth of focus",
        "expected error",
    ):
        assert f"\n{name} " in f"\n{ran.out}"
    words = " ".join(ran.out.split())
    assert "warning: light.led.intensity: " in words
    assert "; change it to 17 mcd, or exposure.time to " in words
    assert words.endswith(" (--set)")
    assert "no warnings" in skysim("check", "shefex2").out


@pytest.mark.slow
def test_check_as_json_has_numbers_and_findings(skysim: Skysim) -> None:
    report = json.loads(
        skysim("check", "afit_simsat", "--json", "--set", "light.layout.cap_deg=15").out
    )
    assert report["facts"]["field_of_view"]["arcsec_px"] == pytest.approx(22.6, abs=0.1)
    assert report["facts"]["expected_error"]["frames"]["cross_arcsec"] == pytest.approx(
        120, abs=5
    )
    assert any(line.startswith("light.layout.cap_deg: ") for line in report["findings"])


@pytest.mark.slow
def test_a_run_shows_the_check_s_findings_before_its_frames_and_in_its_report(
    skysim: Skysim, tmp_path: Path
) -> None:
    words = ("--frames", 1, "--set", "light.led.intensity=60 mcd", "--out", tmp_path)
    ran = skysim("run", "afit_simsat", *words, "--json")
    assert ran.code == 0
    assert ran.err.startswith("skysim: light.led.intensity: ")
    assert "of the lights are saturated" in ran.err
    (finding,) = json.loads(ran.out)["findings"]
    assert finding in ran.err
    page = (tmp_path / "report.html").read_text()
    parts = (
        "check of the plan warns: 1",
        "last solved frame",
        "<h2>Scene",
        "of the lights are saturated",
        "<h2>Frames",
    )
    places = [page.index(part) for part in parts]
    assert places == sorted(places)
    for name in ("lights in the field", "expected error", "camera", "1600 × 1200 px"):
        assert name in page[page.index("<h2>Scene") : page.index("<h2>Frames")]


@pytest.mark.slow
def test_validate_shows_the_check_s_findings(skysim: Skysim, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("schema: 1\nbase: afit_simsat\nlight:\n  led: {intensity: 60 mcd}\n")
    out = skysim("validate", path).out
    assert "light.led.intensity: " in out
    assert f"({path}, line 4)" in out


def test_scenes_show_prints_keys_with_their_origin(skysim: Skysim) -> None:
    ran = skysim("scenes", "show", "afit_simsat_ideal", "--set", "seed=9")
    assert (ran.code, ran.err) == (0, "")
    assert "  focal_length: 35 mm " in ran.out
    assert "# base afit_simsat.yaml, line " in ran.out
    (seed,) = [line for line in ran.out.splitlines() if line.startswith("seed:")]
    assert seed.split() == ["seed:", "9", "#", "--set"]
    entries = json.loads(skysim("scenes", "show", "shefex2", "--json").out)
    (catalog,) = [entry for entry in entries if entry["key"] == "tracker.catalog"]
    assert (catalog["value"], catalog["what"]) == ("hipparcos_hp6.5", "this file")
    assert catalog["line"] > 1
    assert "nothing: no such scene" in skysim("scenes", "show", "nothing").one_line()


def test_an_option_without_effect_is_refused_in_one_line(skysim: Skysim) -> None:
    for words in (
        ("check", "afit_simsat"),
        ("run", "afit_simsat"),
        ("scenes", "show", "afit_simsat"),
    ):
        line = skysim(*words, "--set", "tracker.limit_mag=4").one_line()
        assert (
            "tracker.limit_mag: has no effect: under a dome the tracker's map is of LEDs; allowed: "
            in line
        )


def test_compare_takes_options_of_any_of_its_trackers() -> None:
    """An option is refused only if no compared tracker uses it."""
    words = ["tracker.solver=quest", "tracker.options={a: 1}"]
    both = ["own", "mine"]
    assert load("shefex2", words, None, 1, both).tracker.name == "own"
    for trackers in (["own"], ["mine"]):
        with pytest.raises(InputError, match="has no effect"):
            load("shefex2", words, None, 1, trackers)
    with pytest.raises(
        InputError, match=r"tracker.assumed_camera_body: has no effect.*\(overrides\)"
    ):
        load("shefex2", ["tracker.assumed_camera_body=[1 m, 0 m, 0 m]"], None, 1, both)
