"""Frames from files: sources of exposure and temperature, and one error line for uninformative frames."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from astropy.io import fits

from skysim.apps.cli import main
from skysim.core.errors import InputError
from skysim.experiments.characterize import characterize_camera, frame_files
from skysim.experiments.characterize.frame_files import Setting, read_frames, read_stack

SIDE = 64
SHAPE = (SIDE, SIDE)
BITS = 12
CAMERA = {
    "width_px": SIDE,
    "height_px": SIDE,
    "pixel": "5 um",
    "detector": {
        "quantum_efficiency": 0.6,
        "full_well_e": 10700,
        "gain_e_dn": 2.64,
        "bits": BITS,
    },
}
GAIN = 2.64
BLACK = 100.0
READ = 3.0
WELL = 10_000.0


def frame(
    rng: np.random.Generator, light_e: Any, exposure_s: float, dark_e_s: float = 2.0
) -> np.ndarray:
    """Poisson electrons in a well, Gaussian read noise, rounding: numpy's own, not the simulated detector."""
    electrons = np.minimum(
        rng.poisson(np.broadcast_to(light_e + dark_e_s * exposure_s, SHAPE)), WELL
    )
    numbers = np.rint((electrons + rng.normal(0, READ, SHAPE)) / GAIN + BLACK)
    return np.clip(numbers, 0, 2**BITS - 1).astype(np.uint16)


def write(path: Path, image: np.ndarray, **header: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".fits":
        fits.PrimaryHDU(image, fits.Header(header)).writeto(path, overwrite=True)
    else:
        assert cv2.imwrite(str(path), image)


DARK_S = (0.1, 100.0)
FLAT_S = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.1, 0.2)


def lab(folder: Path, seed: int = 1, suffix: str = ".png", shift: int = 0) -> None:
    """Darks and flats of one camera; exposures are in the names, as 100000us and at 20C."""
    rng = np.random.default_rng(seed)
    for exposure_s in DARK_S:
        for n in range(4):
            write(
                folder / f"darks/dark_{exposure_s:g}s_20C_{n}{suffix}",
                frame(rng, 0.0, exposure_s) << shift,
            )
    for exposure_s in FLAT_S:
        for n in range(2):
            image = frame(rng, exposure_s * WELL / 0.08, exposure_s)
            write(
                folder / f"flats/flat_{1e6 * exposure_s:.0f}us_20C_{n}{suffix}",
                image << shift,
            )


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    lab(folder)
    (folder / "camera.yaml").write_text(yaml.safe_dump({"camera": CAMERA}), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("name", "header", "expected"),
    [
        ("dark_100ms_20C_1.png", {}, Setting(0.1, 20.0)),
        ("d_2s_-5C.tif", {}, Setting(2.0, -5.0)),
        ("250us/x.png", {}, Setting(250e-6, None)),
        ("60s/10C/a 30s.png", {}, Setting(30.0, 10.0)),
        ("frame.fits", {"EXPTIME": 0.25, "CCD-TEMP": -10.2}, Setting(0.25, -10.0)),
        ("dark_3s.fits", {"EXPOSURE": 0.5}, Setting(0.5, None)),
    ],
)
def test_exposure_and_temperature_are_read_from_names_and_headers(
    tmp_path: Path, name: str, header: dict[str, float], expected: Setting
) -> None:
    write(tmp_path / name, np.full((8, 9), 100, np.uint16), **header)
    ((path, setting, pixels),) = read_frames(tmp_path)
    assert (path, setting) == (tmp_path / name, expected)
    assert pixels.shape == (8, 9)


def test_a_table_beside_the_frames_precedes_names_and_headers(tmp_path: Path) -> None:
    write(tmp_path / "a_3s.png", np.full((8, 9), 100, np.uint16))
    write(tmp_path / "b_3s.png", np.full((8, 9), 100, np.uint16))
    (tmp_path / "frames.csv").write_text(
        "file,exposure_s,temperature_c,lens\na_3s.png,0.004,-3,none\n"
    )
    settings = [setting for _, setting, _ in read_frames(tmp_path)]
    assert settings == [Setting(0.004, -3.0), Setting(3.0, None)]


def test_numbers_in_the_upper_bits_are_shifted_back(tmp_path: Path, good: Path) -> None:
    lab(tmp_path, shift=4, suffix=".tif")
    plain, padded = (read_stack(folder / "flats", SHAPE, BITS) for folder in (good, tmp_path))
    for one, other in zip(plain, padded, strict=True):
        np.testing.assert_array_equal(one.halves_dn, other.halves_dn)
        assert one.greatest_dn == other.greatest_dn <= 4095


def test_parameters_of_an_independent_camera_are_recovered(good: Path) -> None:
    config, raw = characterize_camera.read_camera(str(good / "camera.yaml"))
    found = characterize_camera.measure_sensor(
        config, good / "darks", good / "flats"
    ).estimates
    for key, truth in (
        ("gain_e_dn", GAIN),
        ("read_noise_e", READ),
        ("full_well_e", WELL),
        ("offset_dn", BLACK),
    ):
        assert abs(found[key].value - truth) < 4 * found[key].sigma, key
    assert abs(found["dark_e_s"].value - 2.0) < 4 * found["dark_e_s"].sigma
    assert raw["pixel"] == "5 um"


def remove(folder: Path, pattern: str) -> None:
    for path in folder.glob(pattern):
        path.unlink()


def one_exposure(folder: Path) -> None:
    remove(folder, "darks/dark_0.1s*")


def few_flats(folder: Path) -> None:
    remove(folder, "flats/flat_[1-4]0000us*")


def single(folder: Path) -> None:
    remove(folder, "flats/flat_60000us*_1.png")


def saturated(folder: Path) -> None:
    remove(folder, "flats/flat_?0000us*")


def lit(folder: Path) -> None:
    rng = np.random.default_rng(5)
    write(folder / "darks/dark_100s_20C_2.png", frame(rng, 60.0, 100.0))


def gradient(folder: Path) -> None:
    rng = np.random.default_rng(5)
    light_e = np.linspace(0, 200, SIDE)[None, :] * np.ones((SIDE, 1))
    for n in range(4):
        write(folder / f"darks/dark_100s_20C_{n}.png", frame(rng, light_e, 100.0))


def stars(folder: Path) -> None:
    rng = np.random.default_rng(5)
    (y, x) = np.mgrid[0:SIDE, 0:SIDE]
    light_e = sum(
        1000 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 2)
        for a, b in rng.uniform(5, 58, (6, 2))
    )
    for n in range(4):
        write(folder / f"darks/dark_100s_20C_{n}.png", frame(rng, light_e, 100.0))


def copies(folder: Path) -> None:
    image = cv2.imread(str(folder / "darks/dark_100s_20C_0.png"), cv2.IMREAD_UNCHANGED)
    for n in range(4):
        write(folder / f"darks/dark_100s_20C_{n}.png", image)


def cut_off(folder: Path) -> None:
    for path in folder.glob("darks/*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        write(path, (np.maximum(image, 106) - 106).astype(np.uint16))


def vignette(folder: Path) -> None:
    rng = np.random.default_rng(5)
    (y, x) = np.mgrid[0:SIDE, 0:SIDE] / SIDE - 0.5
    for n in range(2):
        write(
            folder / f"flats/flat_50000us_20C_{n}.png",
            frame(rng, 6000 * (1 - 1.5 * (x**2 + y**2)), 0.05),
        )


def lamp(folder: Path) -> None:
    write(
        folder / "flats/flat_50000us_20C_1.png",
        frame(np.random.default_rng(5), 6250 * 1.1, 0.05),
    )


def small(folder: Path) -> None:
    write(folder / "flats/flat_50000us_20C_1.png", np.full((32, 64), 500, np.uint16))


def unnamed(folder: Path) -> None:
    (folder / "flats/flat_50000us_20C_1.png").rename(folder / "flats/flat.png")


def no_temperature(folder: Path) -> None:
    for n in range(2):
        (folder / f"flats/flat_50000us_20C_{n}.png").rename(
            folder / f"flats/flat_50000us_{n}.png"
        )


def color(folder: Path) -> None:
    write(folder / "flats/flat_50000us_20C_1.png", np.full((SIDE, SIDE, 3), 500, np.uint16))


def jpeg(folder: Path) -> None:
    write(folder / "flats/flat_50000us_20C_9.jpg", np.full(SHAPE, 50, np.uint8))


def webp(folder: Path) -> None:
    write(folder / "flats/flat_50000us_20C_9.webp", np.full(SHAPE, 50, np.uint8))


def mosaic(folder: Path) -> None:
    header = fits.Header({"ROWORDER": "TOP-DOWN", "BAYERPAT": "RGGB"})
    path = folder / "flats/flat_50000us_20C_9.fits"
    fits.PrimaryHDU(np.full(SHAPE, 50, np.uint16), header).writeto(path)


def average(folder: Path) -> None:
    write(folder / "flats/flat_50000us_20C_9.fits", np.full(SHAPE, 50.25, np.float32))


def beyond(folder: Path) -> None:
    write(folder / "flats/flat_50000us_20C_9.png", np.full(SHAPE, 4097, np.uint16))


BAD: list[tuple[Callable[[Path], None], str]] = [
    (
        one_exposure,
        "darks of 100 s only; allowed: two exposures or more: add 4 of the shortest and 4 of 1000 s",
    ),
    (
        few_flats,
        "1 levels from 1 to 70 % of the brightest; allowed: 4 or more: add pairs at 3 exposures from 0.005",
    ),
    (
        single,
        "flat_60000us_20C_0.png: the only frame of 0.06 s at 20 °C; allowed: 2 or more, alike",
    ),
    (
        saturated,
        "all saturated, at 3888 DN; allowed: 4 levels or more below: exposures shorter than 0.1 s",
    ),
    (
        lit,
        "dark_100s_20C_2.png: not dark: median 198 DN, the other frames of 100 s at 20 °C 176 DN",
    ),
    (gradient, "the darks of 100 s at 20 °C are not dark: 50.8"),
    (
        gradient,
        "DN brighter at the middle right than at the top left; allowed: 12 DN: cap the lens, cover the window",
    ),
    (stars, "spots of 4 pixels or more, the largest at x "),
    (
        copies,
        "the darks of 100 s at 20 °C are equal in every pixel; allowed: frames of their own, no copies",
    ),
    (cut_off, "% of the pixels at 0 DN; allowed: a higher black level"),
    (vignette, "not flat: "),
    (
        lamp,
        "the flats of 0.05 s at 20 °C differ by 9.5 % from frame to frame; allowed: 3 %: a steady lamp",
    ),
    (
        small,
        "flat_50000us_20C_1.png: 64 x 32 pixels; allowed: 64 x 64, as the camera has them",
    ),
    (
        unnamed,
        "flat.png: no exposure time; allowed: EXPTIME in a FITS header, a row of frames.csv beside it",
    ),
    (
        no_temperature,
        "flat_50000us_0.png: no temperature, which other frames have; allowed: of all frames, or of none",
    ),
    (color, "flat_50000us_20C_1.png: a color image; allowed: monochrome frames, raw"),
    (
        jpeg,
        "flat_50000us_20C_9.jpg: JPEG changes the noise; allowed: raw frames in FITS, PNG or TIFF",
    ),
    (webp, "flat_50000us_20C_9.webp: a color image; allowed: monochrome frames, raw"),
    (mosaic, "flat_50000us_20C_9.fits: a color image; allowed: monochrome frames, raw"),
    (
        average,
        "flat_50000us_20C_9.fits: numbers that are not whole, as of an average; allowed: raw frames",
    ),
    (
        beyond,
        "flat_50000us_20C_9.png: 4097 DN; allowed: up to 4095, the 12 bits of the camera",
    ),
]


@pytest.mark.parametrize(("spoil", "message"), BAD, ids=[one.__name__ for one, _ in BAD])
def test_uninformative_frames_are_refused_in_one_line(
    tmp_path: Path, spoil: Callable[[Path], None], message: str
) -> None:
    lab(tmp_path)
    spoil(tmp_path)
    (tmp_path / "camera.yaml").write_text(
        yaml.safe_dump({"camera": CAMERA}), encoding="utf-8"
    )
    config, _ = characterize_camera.read_camera(str(tmp_path / "camera.yaml"))
    with pytest.raises(InputError) as refused:
        characterize_camera.measure_sensor(config, tmp_path / "darks", tmp_path / "flats")
    assert message in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file\na.png\n", "no exposures; allowed: columns file, exposure_s"),
        ("file,exposure_s\na.png,1,2\n", "line 2: 3 values; allowed: 2"),
        ("file,exposure_s\na.png,soon\n", "'soon' is not a number"),
        ("file,exposure_s\na.png,1\na.png,2\n", "'a.png' is in line 2 too"),
        ("file,exposure_s\na.png,-1\n", "an exposure below 0"),
    ],
)
def test_a_table_of_exposures_is_refused_in_one_line(
    tmp_path: Path, text: str, message: str
) -> None:
    write(tmp_path / "a.png", np.full((8, 9), 100, np.uint16))
    (tmp_path / "frames.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        list(read_frames(tmp_path))


def test_a_folder_without_images_is_refused(tmp_path: Path) -> None:
    for folder, message in ((tmp_path, "no images"), (tmp_path / "x", "no such folder")):
        with pytest.raises(InputError, match=message):
            read_stack(folder, SHAPE, BITS)


def test_hot_pixels_are_not_taken_for_stars(tmp_path: Path) -> None:
    """One pixel in fifty hot: many touch by chance."""
    rng = np.random.default_rng(6)
    hot = np.where(rng.random(SHAPE) < 0.02, 3000.0, 0.0)
    for exposure_s in DARK_S:
        for n in range(2):
            image = frame(rng, hot * exposure_s / 100, exposure_s)
            write(tmp_path / f"dark_{exposure_s:g}s_{n}.png", image)
    frame_files.check_darks(tmp_path, read_stack(tmp_path, SHAPE, BITS))


# The command


def command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: object
) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["skysim", "characterize", *map(str, words)])
    with pytest.raises(SystemExit) as left:
        main.main()
    return int(left.value.code or 0), *capsys.readouterr()


@pytest.mark.slow
def test_the_command_writes_a_preset_that_a_scene_takes(
    good: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from skysim.scene import loader

    folders = (
        "--camera",
        good / "camera.yaml",
        "--darks",
        good / "darks",
        "--flats",
        good / "flats",
    )
    code, out, _ = command(capsys, monkeypatch, *folders, "--out", tmp_path, "--json")
    assert code == 0
    report = json.loads(out)
    rows = {row["what"]: row for row in report["values"]}
    assert rows["gain_e_dn"]["file"] == 2.64
    assert report == json.loads((tmp_path / "characterize.json").read_text())
    preset = str(tmp_path / "camera.yaml")
    scene = loader.load(
        "shefex2",
        {"camera.preset": preset, "camera.focal_length": "16 mm", "camera.f_number": "2"},
    )
    assert scene.camera.detector.gain_e_dn == pytest.approx(
        rows["gain_e_dn"]["value"], rel=1e-5
    )
    assert scene.camera.width_px == SIDE
    code, out, _ = command(capsys, monkeypatch, *folders, "--out", tmp_path)
    assert code == 0
    assert (
        "doubling temperature: darks at one temperature; allowed: two, 5 K apart or more"
        in " ".join(out.split())
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "--darks: missing: without them dark current and black level are unknown"),
        (("--darks", "x"), "--flats: missing: without them gain and full well are unknown"),
        (("--frames-to", "x", "--flats", "y"), "--flats: has no effect with --frames-to"),
    ],
)
def test_contradicting_options_are_refused(
    words: tuple[str, ...],
    message: str,
    good: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code, _, err = command(capsys, monkeypatch, "--camera", good / "camera.yaml", *words)
    assert code == 2
    assert message in err


@pytest.mark.parametrize(("pixels", "columns"), [(20.0, 0.0), (5.0, 3.0), (1.0, 4.0)])
def test_the_range_of_a_dark_s_blocks_is_that_of_its_pixels_and_columns(
    pixels: float, columns: float
) -> None:
    """Of 20 chips with lognormal pixels and normal columns; a gradient over the chip changes nothing."""
    rng = np.random.default_rng(6)
    ranges, expected = [], []
    for _ in range(20):
        image = pixels * (np.exp(0.3 * rng.standard_normal((384, 384))) - 1) / 0.3
        image += columns * rng.standard_normal(384)
        medians = frame_files.block_medians(image)
        ranges.append(np.ptp(medians))
        slope = np.arange(384)[:, None] * 0.05
        expected.append(frame_files.chance_range(image + slope, medians))
    assert np.mean(expected) == pytest.approx(np.mean(ranges), rel=0.15)


def test_a_leak_is_named_where_it_is_and_not_where_the_noise_is_highest() -> None:
    medians = 0.1 * np.random.default_rng(7).standard_normal((32, 32))
    medians[25:, :8] += 0.3
    medians[14:18, 14:18] -= 1.0
    medians[0, 31] += 1.0
    assert frame_files.extremes(medians) == "the bottom left than at the center"
