"""The same frame in the formats that people have: each gives the attitude, within its own covariance."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

import skysim
from skysim.apps import plate_solver
from skysim.apps.cli import main
from skysim.core.errors import InputError
from skysim.results.run import render
from skysim.scene import loader

DATE = datetime(2012, 6, 22, 21)
FOV_DEG = 14.8
CHI2_999 = 16.3  # 99.9 % of three degrees of freedom


@pytest.fixture(scope="module")
def frame() -> tuple[NDArray, Rotation]:
    """A frame of 16 bits, and the true attitude."""
    shot, truth = render(loader.load("shefex2", {"exposure.frames": "1"}), 0)[:2]
    return shot.image_dn, truth.mean_cam_from_lab


def as_fits(path: Path, pixels: NDArray, **cards: Any) -> Path:
    header = fits.Header({"ROWORDER": "TOP-DOWN"} | cards)
    fits.PrimaryHDU(pixels, header).writeto(path)
    return path


def eight_bits(image: NDArray) -> NDArray:
    return np.clip(image.astype(float) / 3 - 10, 0, 255).astype(np.uint8)


def float_fits(path: Path, image: NDArray) -> Path:
    return as_fits(path, (image / 65535).astype(np.float32))


def masked_fits(path: Path, image: NDArray) -> Path:
    """A round field of view, and a broad border, without numbers."""
    pixels = (image / 4095).astype(np.float64)
    y, x = np.indices(image.shape)
    pixels[np.hypot(x - 330, y - 250) > 300] = np.nan
    pixels[:40] = np.nan
    return as_fits(path, pixels)


def bayer_fits(path: Path, image: NDArray) -> Path:
    """Filters that pass a half of the light to red and blue pixels; the level of the converter stays."""
    pixels = image.astype(float)
    level = np.median(pixels)
    for y, x in ((0, 0), (1, 1)):
        pixels[y::2, x::2] = level + (pixels[y::2, x::2] - level) / 2
    return as_fits(path, np.rint(pixels).astype(np.uint16), BAYERPAT="RGGB")


def bayer_tiff(path: Path, image: NDArray) -> Path:
    tags = [(33421, 3, 2, (2, 2)), (33422, 1, 4, bytes([0, 1, 1, 2]))]
    tifffile.imwrite(path, image, photometric="cfa", extratags=tags)
    return path


def by_opencv(path: Path, image: NDArray) -> Path:
    cv2.imwrite(str(path), image)
    return path


def npy(path: Path, image: NDArray) -> Path:
    np.save(path, image.astype(">u2"))
    return path


def webp(path: Path, image: NDArray) -> Path:
    Image.fromarray(eight_bits(image)).save(path, lossless=True)
    return path


WRITERS: dict[str, tuple[Callable[[Path, NDArray], Path], float, str]] = {
    # writer, least fraction of the lights of the frame of 16 bits, and what the answer says
    "u16.fits": (as_fits, 1.0, ""),
    "float.fits": (float_fits, 0.95, "the gain is estimated"),
    "nan.fits": (
        masked_fits,
        0.6,
        "pixels without a number (NaN) are left out; floats up to 1",
    ),
    "bayer.fits": (bayer_fits, 0.6, "a raw Bayer frame (RGGB)"),
    "bayer.tif": (bayer_tiff, 0.95, "a raw Bayer frame (TIFF)"),
    "x.png": (by_opencv, 1.0, ""),
    "x.pgm": (by_opencv, 1.0, ""),
    "x.npy": (npy, 1.0, ""),
    "x.webp": (webp, 0.6, ""),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_attitude_within_its_sigma(
    name: str, frame: tuple[NDArray, Rotation], tmp_path: Path
) -> None:
    image, cam_from_icrs = frame
    write, share, note = WRITERS[name]
    path = write(tmp_path / name, image)
    solution = skysim.solve(path, fov_deg=FOV_DEG, time_utc=DATE)
    plain = skysim.solve(
        as_fits(tmp_path / "plain.fits", image), fov_deg=FOV_DEG, time_utc=DATE
    )
    assert plain.lights > 60
    assert share * plain.lights <= solution.lights < 1.2 * plain.lights
    for one in (plain, solution):
        error = (Rotation.from_quat(one.cam_from_icrs_xyzw) * cam_from_icrs.inv()).as_rotvec()
        assert error @ np.linalg.solve(one.covariance_rad2, error) < CHI2_999
    # No claim that is far from that of the original.
    sigma, whole = (np.sqrt(np.trace(one.covariance_rad2)) for one in (solution, plain))
    assert 0.5 < sigma / whole < 3
    assert note in solution.hint
    assert bool(note) == bool(solution.hint)


def test_a_known_camera_s_floats_are_fractions_of_its_converter(
    frame: tuple[NDArray, Rotation], tmp_path: Path
) -> None:
    """SHEFEX-2 has 12 bits: its gain is known, and nothing is estimated."""
    solver = plate_solver.make_solver(None, Path("shefex2"))
    path = as_fits(tmp_path / "x.fits", frame[0] / 4095)
    picture = plate_solver.load_picture(path, solver.camera)
    np.testing.assert_allclose(picture.pixels, frame[0], rtol=1e-9)
    assert picture.notes == ()


def test_a_refusal_also_says_what_was_changed(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).normal(0.1, 0.01, (300, 400))
    found = skysim.solve(as_fits(tmp_path / "x.fits", noise), fov_deg=FOV_DEG)
    assert found.status != "solved"
    assert "the gain is estimated" in found.hint


@pytest.mark.slow
def test_pages_are_solved_one_by_one(
    frame: tuple[NDArray, Rotation], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = frame[0]
    path = as_fits(tmp_path / "cube.fits", np.stack([image, 0 * image, image, image]))
    out = tmp_path / "out"
    monkeypatch.setattr(
        sys, "argv", ["skysim", "solve", str(path), "--fov", str(FOV_DEG), "--out", str(out)]
    )
    with pytest.raises(SystemExit):
        main.main()
    found = json.loads((out / "solutions.json").read_text())
    assert [Path(one["file"]).name for one in found] == [f"cube.fits[{n}]" for n in range(4)]
    assert [one["status"] == "solved" for one in found] == [True, False, True, True]
    assert (out / "cube.fits[2].annotated.png").exists()
    with pytest.raises(InputError, match="4 images; allowed: a file for each"):
        skysim.solve(path)
