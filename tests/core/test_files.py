"""Files round-trip, astropy reads them correctly, and damaged files are one error line."""

from __future__ import annotations

import datetime
import errno
import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation

from skysim.core import files, images, yaml_reader
from skysim.core.errors import InputError
from skysim.core.files import HOST, TEMPORARY_NAME
from skysim.core.types import BodyTruth, Frame, Truth
from skysim.results.files import recording, run_export
from skysim.scene import loader, scene
from skysim.simulation.flight import simulate_motion

Shot = tuple[scene.Scene, Frame, Truth]


def shoot(name: str, **overrides: str) -> Shot:
    loaded = loader.load(
        name, {key.replace("__", "."): value for key, value in overrides.items()}
    )
    frame, truth = simulate_motion(loaded).render(0)
    return loaded, frame, truth


@pytest.fixture(scope="module")
def sky() -> Shot:
    return shoot("shefex2", exposure__frames="1")


@pytest.fixture(scope="module")
def dome() -> Shot:
    return shoot("afit_simsat", exposure__frames="1", camera__detector__noise="false")


@pytest.fixture(scope="module")
def written(sky: Shot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    recording.write_frame(folder, sky[1], sky[2], sky[0])
    return folder


def complaint(path: Path) -> str:
    """One-line error text for a bad file."""
    with pytest.raises(InputError) as refusal:
        images.read_image(path)
    message = str(refusal.value)
    assert "\n" not in message
    assert str(path) in message
    return message


# Roundtrips


def test_a_frame_is_written_as_exactly_three_files(written: Path) -> None:
    assert {p.name for p in written.iterdir()} == {
        "frame_0000.fits",
        "frame_0000.png",
        "frame_0000.ecsv",
    }


@pytest.mark.parametrize("suffix", ["fits", "png"])
def test_a_frame_round_trips_bit_for_bit(sky: Shot, written: Path, suffix: str) -> None:
    back = images.read_image(written / f"frame_0000.{suffix}")
    assert back.dtype == np.uint16
    np.testing.assert_array_equal(back, sky[1].image_dn)


def test_every_16_bit_value_survives_png_and_fits(tmp_path: Path, sky: Shot) -> None:
    image = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    files.write_png16(tmp_path / "all.png", image)
    recording.write_fits(
        tmp_path / "all.fits", Frame(0, image, 0.1, 0.04, 65535.0), sky[2], sky[0]
    )
    np.testing.assert_array_equal(images.read_image(tmp_path / "all.png"), image)
    np.testing.assert_array_equal(images.read_image(tmp_path / "all.fits"), image)


@pytest.mark.slow
def test_a_noise_free_frame_stays_a_float_in_fits_and_is_rounded_in_png(
    tmp_path: Path, dome: Shot
) -> None:
    loaded, frame, truth = dome
    recording.write_frame(tmp_path, frame, truth, loaded)
    np.testing.assert_array_equal(
        images.read_image(tmp_path / "frame_0000.fits"), frame.image_dn
    )
    rounded = images.read_image(tmp_path / "frame_0000.png").astype(float)
    assert np.abs(rounded - frame.image_dn).max() <= 0.5


def test_the_header_has_date_exposure_and_scene(sky: Shot, written: Path) -> None:
    header = fits.getheader(written / "frame_0000.fits")
    assert header["EXPTIME"] == 0.040
    # 0.1 s after the start the shutter opens, 20 ms later is the middle.
    middle = datetime.datetime(2012, 6, 22, 21, 0, 0, 120_000)
    assert datetime.datetime.fromisoformat(header["DATE-OBS"]) == middle
    assert images.read_picture(written / "frame_0000.fits").date_utc == middle
    assert (header["SCENE"], header["SEED"], header["FRAME"], header["SATURATE"]) == (
        "shefex2",
        2,
        0,
        pytest.approx((40000 - 3 * 14.7) / 10 + 64),
    )


@pytest.mark.parametrize("start", ["2012-06-22T23:00:00+02:00", "2012-06-22T21:00:00Z"])
def test_a_scene_s_time_with_a_zone_is_written_as_utc(sky: Shot, start: str) -> None:
    """DATE-OBS takes no zone, and an attitude message would have been two hours off."""
    loaded, frame, _ = sky
    zoned = loader.load("shefex2", {"start_time": start})
    assert recording.utc_text(zoned, frame.t_mid_s) == recording.utc_text(
        loaded, frame.t_mid_s
    )
    local = datetime.datetime.fromisoformat(start)
    assert run_export.epoch(local) == "2012-06-22T21:00:00.000000"


def test_a_png_has_no_date(written: Path) -> None:
    assert images.read_picture(written / "frame_0000.png").date_utc is None


def test_a_fits_file_is_standard(written: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with fits.open(written / "frame_0000.fits", checksum=True) as hdus:
            hdus.verify("exception")


def test_a_truth_table_round_trips(sky: Shot, written: Path) -> None:
    truth = sky[2]
    seen = sky[2].sources
    table = Table.read(written / "frame_0000.ecsv", format="ascii.ecsv")
    np.testing.assert_array_equal(table["id"], seen.id)
    columns = {
        "x_px": seen.xy_px[:, 0],
        "y_px": seen.xy_px[:, 1],
        "flux_x_px": seen.flux_xy_px[:, 0],
        "flux_y_px": seen.flux_xy_px[:, 1],
        "electrons": seen.electrons,
        "peak_e": seen.peak_e,
        "streak_px": seen.streak_px,
        "area_px": seen.area_px,
        "snr": seen.snr,
    }
    assert set(table.colnames) == {"id", "saturated", *columns}
    assert table["saturated"].dtype == bool
    np.testing.assert_array_equal(table["saturated"], seen.saturated)
    for name, values in columns.items():
        # Nine digits are written.
        np.testing.assert_allclose(table[name], values, rtol=1e-8, atol=0)
    back = Rotation.from_quat(table.meta["cam_from_lab_xyzw"])
    assert (back * truth.cam_from_lab.inv()).magnitude() < 1e-15
    back = Rotation.from_quat(table.meta["lab_from_body_xyzw"])
    assert (back * truth.lab_from_body.inv()).magnitude() < 1e-15
    np.testing.assert_array_equal(table.meta["rate_cam_rad_s"], truth.rate_cam_rad_s)
    assert (table.meta["scene"], table.meta["seed"], table.meta["t_mid_s"]) == (
        "shefex2",
        2,
        truth.t_s,
    )


def test_bodies_of_a_truth_table_round_trip_by_name(sky: Shot, tmp_path: Path) -> None:
    loaded, frame, truth = sky
    moon = BodyTruth(9_000_301, "moon", -8.84, 154.86, 4.84, 1868.9, 118.4)
    for bodies in ((), (moon,)):
        recording.write_truth(
            tmp_path / "truth.ecsv", frame, replace(truth, bodies=bodies), loaded
        )
        meta = Table.read(tmp_path / "truth.ecsv", format="ascii.ecsv").meta
        assert meta.get("bodies", []) == [asdict(body) for body in bodies]


def test_saturation_flags_of_a_truth_table_round_trip(sky: Shot, tmp_path: Path) -> None:
    loaded, frame, truth = sky
    every_third = np.arange(len(truth.sources.id)) % 3 == 0
    truth = replace(truth, sources=replace(truth.sources, saturated=every_third))
    recording.write_truth(tmp_path / "truth.ecsv", frame, truth, loaded)
    table = Table.read(tmp_path / "truth.ecsv", format="ascii.ecsv")
    np.testing.assert_array_equal(table["saturated"], every_third)


def test_a_shorter_run_leaves_no_frames_of_a_longer_one(tmp_path: Path, sky: Shot) -> None:
    recording.write_frame(tmp_path, sky[1], sky[2], sky[0])
    mine = tmp_path / "frame_of_mine.png"
    mine.write_bytes(b"")
    recording.remove_results(tmp_path)
    assert list(tmp_path.iterdir()) == [mine]


# The WCS


@pytest.mark.slow
@pytest.mark.parametrize(
    "pointing",
    [
        {},
        {"motion__start": "{ra_deg: 0.01, dec_deg: -60, roll_deg: -130}"},
        {"motion__start": "{ra_deg: 200, dec_deg: 88, roll_deg: 10}"},
        {"camera__principal_point_px": "[100, 400]"},
        {"camera__focus": "10 m"},
    ],
    ids=["orion", "through RA 0", "near the pole", "off-center lens", "focused nearby"],
)
@pytest.mark.filterwarnings("ignore:.*datfix")
def test_astropy_puts_the_true_stars_on_their_true_pixels(
    tmp_path: Path, pointing: dict[str, str]
) -> None:
    """Directions from the scene's own sources, pixels by astropy's WCS of the header alone."""
    loaded = loader.load("shefex2", {k.replace("__", "."): v for k, v in pointing.items()})
    flight = simulate_motion(loaded)
    frame, truth = flight.render(0)
    recording.write_fits(tmp_path / "f.fits", frame, truth, loaded)
    sources = flight.lab.camera.sources
    rows = {hip: n for n, hip in enumerate(sources.id)}
    direction = sources.place[[rows[hip] for hip in truth.sources.id], :3]
    ra, dec = np.degrees(
        [np.arctan2(direction[:, 1], direction[:, 0]), np.arcsin(direction[:, 2])]
    )
    x, y = WCS(fits.getheader(tmp_path / "f.fits")).all_world2pix(ra, dec, 0)
    assert len(x) > 20
    np.testing.assert_allclose(
        np.column_stack([x, y]), truth.sources.xy_px, rtol=0, atol=1e-6
    )


def test_under_the_dome_there_is_no_wcs(tmp_path: Path, dome: Shot) -> None:
    recording.write_fits(tmp_path / "f.fits", dome[1], dome[2], dome[0])
    assert not [
        key
        for key in fits.getheader(tmp_path / "f.fits")
        if key.startswith(("CTYPE", "CRVAL"))
    ]


# Nothing half-written


def break_off(path: Path, words: str) -> None:
    with files.atomic_file(path) as temporary:
        temporary.write_text(words)
        raise KeyboardInterrupt


def test_an_interrupted_new_file_is_removed(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        break_off(tmp_path / "new.txt", "half")
    assert not list(tmp_path.iterdir())


def test_an_interrupted_file_keeps_the_old_one(tmp_path: Path) -> None:
    files.write_text(tmp_path / "old.txt", "whole")
    with pytest.raises(KeyboardInterrupt):
        break_off(tmp_path / "old.txt", "half")
    assert (tmp_path / "old.txt").read_text() == "whole"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_full_disk_that_only_a_text_reports_is_named_with_the_room_left(
    tmp_path: Path,
) -> None:
    """NumPy counts the numbers of an array that were written, without an error number."""

    def break_off_as_numpy() -> None:
        with files.atomic_file(tmp_path / "new.fits") as temporary:
            temporary.write_text("half")
            raise OSError("324887 requested and 152160 written")

    with pytest.raises(OSError, match=r"No space left on device; .* MB are free") as raised:
        break_off_as_numpy()
    assert raised.value.filename == str(tmp_path / "new.fits")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_names_the_room_that_a_whole_file_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for write, data in (
        (files.write_text, "µ" * 1_000_000),
        (files.write_bytes, b"12" * 10**6),
    ):
        with pytest.raises(OSError, match=r"; \S+ MB are free of 2 needed, nothing is half-"):
            write(tmp_path / "new", data)  # type: ignore[operator]
    assert not list(tmp_path.iterdir())


def test_a_picture_that_cannot_be_encoded_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(
        InputError,
        match=r"x\.png: an image of uint8 and shape \(4, 4, 2\) cannot be encoded in this format",
    ):
        files.write_image(tmp_path / "x.png", np.zeros((4, 4, 2), np.uint8))
    assert not list(tmp_path.iterdir())


def test_an_interrupt_leaves_the_old_folder_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(folder: Path, **_: object) -> None:
        next(Path(folder).iterdir()).unlink()
        raise KeyboardInterrupt

    def shoot(text: str) -> None:
        with files.atomic_folder(film) as folder:
            folder.mkdir()
            (folder / "zarr.json").write_text(text)

    film = tmp_path / "frames.zarr"
    shoot("old")
    monkeypatch.setattr(shutil, "rmtree", interrupted)
    with pytest.raises(KeyboardInterrupt):
        shoot("new")
    assert (film / "zarr.json").read_text() == "new"


KILLED = """
import os, sys
from pathlib import Path
from skysim.core import files as io
out = Path(sys.argv[1])
with io.atomic_file(out / "solutions.ecsv") as file, io.atomic_folder(out / "frames.zarr") as folder:
    file.write_text("half")
    folder.mkdir()
    (folder / "zarr.json").write_text("half")
    os.kill(os.getpid(), 9)
"""


def test_only_temporary_files_of_killed_processes_are_removed(tmp_path: Path) -> None:
    """Files of live processes, of other machines and hidden files of the user are kept."""
    subprocess.run([sys.executable, "-c", KILLED, tmp_path], check=False)
    left = {path.name for path in tmp_path.iterdir()}
    assert len(left) == 2
    (name,) = (name for name in left if name.endswith(".ecsv"))
    pid = TEMPORARY_NAME.fullmatch(name)[1]  # type: ignore[index]
    others = {
        name.replace(f"-{pid}.", f"-{os.getppid()}."),
        name.replace(HOST, "0badcafe"),
        f".solutions.{pid}.ecsv",
        ".hidden",
        "frame_0000.fits",
    }
    for other in others:
        (tmp_path / other).write_text("mine")
    # Of an earlier process by our number.
    ours_before = tmp_path / name.replace(f"-{pid}.", f"-{os.getpid()}.")
    ours_before.write_text("half")
    with files.atomic_file(tmp_path / "truth.ecsv") as temporary:
        temporary.write_text("whole")
        files.make_folder(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == others | {"truth.ecsv"}


def test_a_folder_under_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be created as a folder"):
        files.make_folder(tmp_path / "file" / "out")


# Damage


@pytest.mark.parametrize("share", [0.0, 0.001, 0.0044, 0.1, 0.5, 0.99, 0.9999])
@pytest.mark.parametrize("suffix", ["fits", "png"])
def test_a_truncated_frame_is_refused_in_one_line(
    written: Path, tmp_path: Path, suffix: str, share: float
) -> None:
    data = (written / f"frame_0000.{suffix}").read_bytes()
    path = tmp_path / f"cut.{suffix}"
    path.write_bytes(data[: int(share * len(data))])
    complaint(path)


@pytest.mark.parametrize("suffix", ["jpg", "tif", "bmp"])
def test_other_truncated_images_are_refused_in_one_line(tmp_path: Path, suffix: str) -> None:
    whole = tmp_path / f"whole.{suffix}"
    cv2.imwrite(str(whole), np.random.default_rng(1).integers(0, 255, (200, 300), np.uint8))
    images.read_image(whole)
    (tmp_path / f"cut.{suffix}").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert "truncated" in complaint(tmp_path / f"cut.{suffix}")


@pytest.mark.parametrize(
    ("at", "field_value"), [(33, 200_000_000), (20, 4_000_000)], ids=["chunk", "rows"]
)
def test_a_png_whose_header_exceeds_its_data_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int, field_value: int
) -> None:
    """A chunk's length stands after IHDR, the height in it; OpenCV would take the memory for both."""
    data = bytearray(
        cv2.imencode(".png", np.random.default_rng(1).integers(0, 255, (64, 64), np.uint8))[1]
    )
    data[at : at + 4] = field_value.to_bytes(4, "big")
    (tmp_path / "much.png").write_bytes(data)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    assert "truncated" in complaint(tmp_path / "much.png")


def test_image_libraries_print_nothing_to_stderr(
    written: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    data = (written / "frame_0000.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    complaint(tmp_path / "cut.png")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["text.png", "text.fits", "text.jpg", "text.tiff"])
def test_text_in_an_image_file_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("once upon a time\n" * 300)
    complaint(tmp_path / name)


def test_a_missing_file_or_no_image_is_refused_in_one_line(tmp_path: Path) -> None:
    assert "no such file" in complaint(tmp_path / "missing.fits")
    assert "no such file" in complaint(tmp_path)
    (tmp_path / "x.docx").write_text("")
    assert "allowed: .fits" in complaint(tmp_path / "x.docx")
    fits.PrimaryHDU().writeto(tmp_path / "bare.fits")
    assert "without an image" in complaint(tmp_path / "bare.fits")


def test_the_image_of_an_extension_is_found(tmp_path: Path) -> None:
    image = np.arange(12.0).reshape(3, 4)
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(image)]).writeto(tmp_path / "ext.fits")
    np.testing.assert_array_equal(
        images.read_picture(tmp_path / "ext.fits").pixels, image[::-1]
    )


@pytest.mark.parametrize("seed", [*range(40), 172])
@pytest.mark.filterwarnings("error")
def test_a_few_flipped_bytes_give_an_image_or_one_error_line(
    written: Path, tmp_path: Path, seed: int
) -> None:
    """No damage to a header causes another exception or a warning. Valid FITS with wrong values is read."""
    rng = np.random.default_rng(seed)
    data = bytearray((written / "frame_0000.fits").read_bytes())
    data[int(rng.integers(0, 2880))] = int(rng.integers(0, 256))
    data[int(rng.integers(0, 800))] = int(rng.integers(32, 127))
    path = tmp_path / "flipped.fits"
    path.write_bytes(data)
    outcome = []
    try:
        outcome.append(images.read_picture(path).pixels)
    except InputError as refusal:
        outcome.append(str(refusal))
    assert "\n" not in str(outcome[0]) or isinstance(outcome[0], np.ndarray)


# Color and JSON


def test_color_becomes_luminance_and_monochrome_is_unchanged() -> None:
    gray = np.random.default_rng(2).integers(0, 65535, (5, 7), np.uint16)
    np.testing.assert_array_equal(images.monochrome(gray), gray)
    np.testing.assert_array_equal(images.monochrome(gray[:, :, None]), gray)
    np.testing.assert_array_equal(images.monochrome(np.dstack([gray] * 3)), gray)
    np.testing.assert_array_equal(images.monochrome(np.dstack([gray] * 4)), gray)
    blue_green_red = np.full((2, 2, 3), (10.0, 20.0, 30.0), np.float32)
    # ITU-R BT.601: .299 R + .587 G + .114 B.
    np.testing.assert_allclose(
        images.monochrome(blue_green_red), 0.299 * 30 + 0.587 * 20 + 1.14, rtol=1e-6
    )


@pytest.mark.parametrize("shape", [(5,), (3, 20, 30), (4, 5, 2), (2, 2, 3, 3)])
def test_an_array_of_a_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"an image of shape .*; allowed: \(height, width\)"):
        images.monochrome(np.zeros(shape))


def test_json_writes_nan_and_infinity_as_null() -> None:
    data = {
        "a": float("nan"),
        "b": [np.float64("inf"), np.int64(3)],
        "c": (np.bool_(True), "x", None),
    }
    assert json.loads(files.to_json(data)) == {
        "a": None,
        "b": [None, 3],
        "c": [True, "x", None],
    }


def test_a_live_camera_s_frame_is_read_by_opencv_and_a_missing_one_is_reported(
    tmp_path: Path,
) -> None:
    """A video file stands for the camera: its first frame, to what JPEG leaves of it."""
    frame = np.zeros((48, 64, 3), np.uint8)
    frame[20:30, 30:40] = 200
    video = cv2.VideoWriter(
        str(tmp_path / "camera.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48)
    )
    video.write(frame)
    video.release()
    with closing(images.LiveCamera(str(tmp_path / "camera.avi"))) as camera:
        grabbed = camera.frame()
    assert grabbed.shape == frame.shape
    assert np.abs(grabbed.astype(int) - frame).max() < 30
    for nowhere in (str(tmp_path / "none.avi"), "99"):
        with pytest.raises(InputError, match="no camera found; allowed: an index such as 0"):
            images.LiveCamera(nowhere).frame()


def test_a_yaml_file_is_read_again_after_a_change_of_file_or_values(
    tmp_path: Path,
) -> None:
    """Values are kept by the file's text, and every reader has its own."""
    file = tmp_path / "a.yaml"
    file.write_text("a: {b: [1, 2]}")
    tree, _ = yaml_reader.read_yaml(file)
    tree["a"]["b"].append(3)
    assert yaml_reader.read_yaml(file)[0] == {"a": {"b": [1, 2]}}
    file.write_text("a: {b: [1, 4]}")
    assert yaml_reader.read_yaml(file)[0] == {"a": {"b": [1, 4]}}


ECSV = """# %ECSV 1.0
# ---
# datatype:
# - {{name: x, datatype: {}}}
x
1
{}
"""


@pytest.mark.parametrize(
    ("kind", "cell", "says"),
    [
        ("float6", "2", "not an ECSV table: unexpected datatype 'float6'"),
        ("int64", "2.5.1", "line 7: no row of the table"),
        ("float32", "2", ""),
    ],
)
def test_a_table_is_refused_without_a_warning(
    tmp_path: Path, kind: str, cell: str, says: str
) -> None:
    """Astropy warns of an unknown type, and uses it."""
    path = tmp_path / "x.ecsv"
    path.write_text(ECSV.format(kind, cell))
    with warnings.catch_warnings(action="error"):
        if says:
            with pytest.raises(InputError, match=rf"^[^\n]*{re.escape(says)}[^\n]*$"):
                files.read_table(path)
        else:
            assert files.read_table(path)["x"].tolist() == [1, 2]


def test_a_header_without_end_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    path = tmp_path / "x.ecsv"
    path.write_text("# %ECSV 1.0\n" + "#   - 1\n" * files.MAX_HEADER_LINES + "x\n1\n")
    with pytest.raises(InputError, match="a header of 5001 lines; allowed: up to 5000"):
        files.read_table(path)


@pytest.mark.parametrize("bad", [7, 100, 4006])
def test_the_first_wrong_row_of_a_table_is_named(
    tmp_path: Path, bad: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two wrong ones; halves of the rows are read, together as many again."""
    path = tmp_path / "x.ecsv"
    lines = ECSV.format("int64", "3").splitlines() + ["4"] * 4000
    lines[bad - 1] = "a"
    lines[-1] = "b"
    path.write_text("\n".join(lines))
    read = []
    original = Table.read
    monkeypatch.setattr(
        Table,
        "read",
        lambda rows, **kind: (read.append(len(rows)), original(rows, **kind))[1],
    )
    with pytest.raises(InputError, match=f"line {bad}: no row of the table"):
        files.read_table(path)
    assert sum(read) < 2.1 * len(lines) + 20 * 5
