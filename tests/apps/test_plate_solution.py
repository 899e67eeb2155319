"""What a solved plate says beyond its pointing: attitude, stars, FITS header, rates; and where the sky is searched."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation

import skysim
from estimator.core.camera import Camera
from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Clock
from estimator.trackers.star_tracker import StarTracker
from skysim.apps import plate_solver
from skysim.apps.cli import main
from skysim.apps.plate_solver.plate_solution import camera_notes
from skysim.apps.plate_solver.solver import solve_centroids
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.results.run import render
from skysim.scene import loader

CAMERA = Camera(800, 600, 1500.0, (410.0, 290.0), (-0.12, 0.03, 4e-4, -3e-4, 0.0))
PLAIN = Camera(800, 600, 1500.0, (410.0, 290.0))


def command(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """The exit code of `skysim solve` with these words."""
    monkeypatch.setattr(sys, "argv", ["skysim", "solve", *words])
    with pytest.raises(SystemExit) as left:
        main.main()
    return int(left.value.code or 0)


def turning(count: int) -> tuple[list[np.ndarray], Rotation]:
    """Frames of shefex2 at 10 Hz, and the true rotation of the camera from the first to the last."""
    scene = loader.load("shefex2", {"exposure.frames": str(count)})
    frames = [render(scene, n)[0].image_dn for n in range(count)]
    truth = [render(scene, n)[1].cam_from_lab for n in (0, count - 1)]
    return frames, truth[0] * truth[1].inv()


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize(
    "camera", [PLAIN, CAMERA, replace(PLAIN, aspect=0.93), replace(CAMERA, aspect=1.04)]
)
def test_astropy_reads_the_header_to_a_tenth_of_an_arcsecond(
    camera: Camera, flipped: bool
) -> None:
    """The direction of any pixel by the header is that of the tracker's camera, in the file's order of rows."""
    attitude = Attitude("solved", Rotation.from_rotvec([1.0, -0.4, 2.0]), camera=camera)
    header = plate_solver.wcs_header(attitude, flipped)
    xy_px = np.random.default_rng(1).uniform(0, [799, 599], (200, 2))
    expected = attitude.cam_from_ref.inv().apply(camera.rays(xy_px))
    stored_px = xy_px.copy()
    if flipped:
        stored_px[:, 1] = 599 - stored_px[:, 1]
    ra, dec = np.radians(
        WCS(fits.Header.fromstring(header.tostring())).all_pix2world(stored_px, 0)
    ).T
    found = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    assert np.linalg.norm(found - expected, axis=1).max() < 0.1 * ARCSEC_RAD


@pytest.mark.slow
@pytest.mark.parametrize("aspect", [0.96, 1.04])
def test_pixels_that_are_not_square_are_fitted_and_noted(
    tmp_path: Path, aspect: float
) -> None:
    """A picture that is stretched along one of its sides."""
    frame, truth = render(loader.load("shefex2", {"exposure.frames": "1"}), 0)[:2]
    height, width = frame.image_dn.shape
    stretched = max(aspect, 1.0) * height, max(1 / aspect, 1.0) * width
    size_px = round(stretched[1]), round(stretched[0])
    path = tmp_path / "frame.png"
    cv2.imwrite(str(path), cv2.resize(frame.image_dn, size_px))
    field_deg = np.degrees(2 * np.arctan((width - 1) / 2 / (25 / 9.9e-3)))
    found = skysim.solve(path, fov_deg=1.02 * field_deg, time_utc=datetime(2012, 6, 22, 21))
    assert found.status == "solved"
    assert found.pixel_aspect == pytest.approx(aspect, abs=3e-3)
    noted = re.search(r"pixel aspect ([0-9.]+)", found.hint)
    assert noted is not None
    assert float(noted[1]) == pytest.approx(aspect, abs=3e-3)
    turn = Rotation.from_quat(found.cam_from_icrs_xyzw) * truth.cam_from_lab.inv()
    assert turn.magnitude() < 1e-3
    wider = replace(PLAIN, focal_px=0.9 * PLAIN.focal_px)
    assert "field differs by" in camera_notes(wider, StarTracker.for_sky(PLAIN))[0]


def test_a_solution_has_the_attitude_its_covariance_and_the_stars(tmp_path: Path) -> None:
    frame, truth = render(loader.load("shefex2", {"exposure.frames": "1"}), 0)[:2]
    path = tmp_path / "frame.png"
    cv2.imwrite(str(path), frame.image_dn)
    found = skysim.solve(path, camera="shefex2", time_utc=datetime(2012, 6, 22, 21))
    turn = Rotation.from_quat(found.cam_from_icrs_xyzw) * truth.cam_from_lab.inv()
    error = turn.as_rotvec()
    assert error @ np.linalg.solve(found.covariance_rad2, error) < 16.3  # 99.9 % of 3
    assert found.focal_px == pytest.approx(25 / 9.9e-3)
    assert len(found.stars) == found.matches
    residual = [(one["residual_x_px"], one["residual_y_px"]) for one in found.stars]
    assert np.degrees(np.sqrt(np.mean(np.square(residual))) / found.focal_px) * 3600 == (
        pytest.approx(found.rms_arcsec, rel=0.05)
    )
    names = [one["name"] for one in found.stars]
    assert "HIP 25336" in names  # gamma Orionis, V 1.64, at 81.283, +6.350
    (gamma,) = [one for one in found.stars if one["name"] == "HIP 25336"]
    assert (gamma["ra_deg"], gamma["dec_deg"]) == pytest.approx((81.2828, 6.3497), abs=1e-3)


@pytest.mark.slow
def test_a_list_of_lights_gives_the_attitude_of_its_picture(
    tmp_path: Path,
) -> None:
    frame = render(loader.load("shefex2", {"exposure.frames": "1"}), 0)[0]
    picture = tmp_path / "frame.png"
    cv2.imwrite(str(picture), frame.image_dn)
    whole = skysim.solve(picture, camera="shefex2")
    lights = tmp_path / "lights.csv"
    rows = [
        f"{one['x_px']},{one['y_px']},{10 ** (-0.4 * one['v_mag'])}" for one in whole.stars
    ]
    lights.write_text("\n".join(["x_px,y_px,flux", *reversed(rows)]))
    for given in ({"camera": "shefex2"}, {"fov_deg": 14.85, "size_px": (659, 493)}):
        found = skysim.solve(lights, **given)
        assert (found.ra_deg, found.dec_deg) == pytest.approx(
            (whole.ra_deg, whole.dec_deg), abs=5e-3
        )
    with pytest.raises(
        InputError,
        match=r"lights\.csv: a list of lights of a picture of unknown size; allowed: a size",
    ):
        skysim.solve(lights)
    lights.write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match=r"lights\.csv: no lights; allowed: columns x_px"):
        skysim.solve(lights, camera="shefex2")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("near_deg", "solved"), [((83, 2, 5), True), ((200, -40, 20), False)]
)
def test_only_the_given_part_of_the_sky_is_searched(
    tmp_path: Path, near_deg: tuple[float, float, float], solved: bool
) -> None:
    frame = render(loader.load("shefex2", {"exposure.frames": "1"}), 0)[0]
    path = tmp_path / "frame.png"
    cv2.imwrite(str(path), frame.image_dn)
    found = skysim.solve(path, camera="shefex2", near_deg=near_deg)
    assert (found.status == "solved") == solved
    with pytest.raises(InputError, match="a declination of -90 to 90"):
        skysim.solve(path, near_deg=(0, 91, 1))


def test_a_sequence_has_rates_and_gaps() -> None:
    """Turned by 0.1 deg a frame at 10 Hz: 1 deg/s, also over a frame without an attitude."""
    results = []
    for n in range(5):
        xyzw = Rotation.from_rotvec([0, np.radians(0.1 * n), 0]).inv().as_quat()
        results.append(
            {"file": f"{n}", "date_utc": None, "ra_deg": 1.0, "cam_from_icrs_xyzw": xyzw}
        )
    results[2] |= {"ra_deg": None, "cam_from_icrs_xyzw": None}
    plate_solver.add_rates(results, 10.0)
    assert [one["t_s"] for one in results] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert [one["rate_deg_s"] for one in results[:3:2]] == [None, None]
    for n in (1, 3, 4):
        assert results[n]["rate_deg_s"] == pytest.approx([0, 1, 0], abs=1e-9)
    text = plate_solver.sequence_summary(results)
    assert text == (
        "4 of 5 solved over 0.4 s; 1 gaps without an attitude, the longest 0.2 s;"
        " rate median 1 °/s, largest 1 °/s"
    )
    with pytest.raises(InputError, match=r"0: no date; allowed: DATE-OBS in its header"):
        plate_solver.add_rates(results, None)


@pytest.mark.slow
def test_the_command_writes_header_table_and_the_rates_of_a_video(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, last_from_first = turning(3)
    shape = frames[0].shape[::-1]
    video = tmp_path / "night.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"FFV1"), 10.0, shape, False)
    for frame in frames:
        writer.write(np.clip((frame.astype(float) - 60) / 4, 0, 255).astype(np.uint8))
    writer.release()
    out = ["--out", str(tmp_path / "out"), "--fov", "14.85"]
    assert command(monkeypatch, str(video), "--sequence", *out, "--json") == 0
    rows = json.loads(capsys.readouterr().out)
    assert [one["file"][-2:] for one in rows] == ["#0", "#1", "#2"]
    measured = np.linalg.norm(rows[-1]["rate_deg_s"])
    rate = np.degrees(last_from_first.magnitude()) / 0.2
    assert measured == pytest.approx(rate, abs=0.3)

    picture = tmp_path / "frame.png"
    cv2.imwrite(str(picture), frames[0])
    files = {name: tmp_path / f"one.{name}" for name in ("wcs", "ecsv", "png")}
    options = [
        "--wcs",
        str(files["wcs"]),
        "--table",
        str(files["ecsv"]),
        "--annotate",
        str(files["png"]),
    ]
    assert command(monkeypatch, str(picture), *options, *out, "--near", "83,2,5") == 0
    table = Table.read(files["ecsv"], format="ascii.ecsv")
    assert table.colnames[:4] == ["name", "ra_deg", "dec_deg", "v_mag"]
    sky = WCS(fits.getheader(files["wcs"])).all_pix2world(table["x_px"], table["y_px"], 0)
    assert (
        np.abs(sky[1] - table["dec_deg"]).max() < 0.02
    )  # aberration, precession of none, and centroids
    assert cv2.imread(str(files["png"])) is not None
    assert command(monkeypatch, str(picture), str(picture), *options, *out) == 2
    assert "2 images; allowed: one with --annotate" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize("lights", [8, 25])
def test_false_lights_are_not_solved_near_a_place_either(lights: int) -> None:
    """Evidence holds for the part of the sky that is searched: 200 frames of random lights, none solved."""
    solver = plate_solver.make_solver(14.85, None, near_deg=(83, 2, 10))
    rng = np.random.default_rng(lights)
    for _ in range(200):
        xy_px = rng.uniform(0, [658, 492], (lights, 2))
        centroids = Centroids(
            xy_px, np.full(lights, 0.1), np.sort(rng.lognormal(size=lights))[::-1]
        )
        attitude, _ = solve_centroids(centroids, solver, (659, 493), Clock())
        assert not attitude.solved
