"""Exports to other tools' formats round-trip by independent formulas and readers."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet
import pytest
import skimage.io
import xarray
import zarr
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation

from skysim.camera import wcs
from skysim.camera.optics import Optics
from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.results import plots, scoring
from skysim.results.files import recording, run_export
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.checks import check
from skysim.simulation.flight import Flight, open_flight
from skysim.simulation.lab import build_lab
from skysim.sources import stars as star_sources

LENS = "[-0.2, 0.1, 0.001, -0.0005, 0.02]"
Flown = tuple[Flight, recording.Recording]
SECOND = datetime.timedelta(seconds=1)
START = datetime.datetime(2012, 6, 22, 21)


def quiet(items: Iterable[Any], total: int, what: str) -> Iterator[Any]:
    yield from items


def sky_flight(folder: Path) -> Flight:
    """Folder of a run of a sky scene: frames, truths, solutions."""
    flight = open_flight(
        loader.load("shefex2", {"exposure.frames": "3", "camera.distortion": LENS})
    )
    scene = flight.lab.scene
    rows = []
    for shot in flight.shots():
        recording.write_frame(folder, shot.frame, shot.truth, scene)
        rows.append(scoring.Score(shot).row)
    files.write_table(folder / "solutions.ecsv", scoring.table(rows, scene))
    return flight


def dome_flight(folder: Path) -> Flight:
    """Folder of a noise-free run of a dome scene: frames and truths."""
    settings = {
        "exposure.frames": "2",
        "motion.start": "{roll_deg: 4, yaw_deg: 70}",
        "camera.shutter": "{kind: global}",
    }
    small = {
        "camera.width_px": "800",
        "camera.height_px": "600",
        "camera.detector.noise": "false",
    }
    flight = open_flight(loader.load("afit_simsat", settings | small))
    for shot in flight.shots(solves=False):
        recording.write_frame(folder, shot.frame, shot.truth, flight.lab.scene)
    return flight


@pytest.fixture(scope="module")
def stars(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("stars")
    return sky_flight(folder), recording.Recording(folder)


@pytest.fixture(scope="module")
def dome(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("dome")
    return dome_flight(folder), recording.Recording(folder)


# Attitude


def read_aem(path: Path) -> tuple[dict[str, str], list[datetime.datetime], Floats]:
    """Keywords, epochs and (K, 4) Q1 Q2 Q3 QC, read by the rules of the notation alone."""
    head, _, rest = path.read_text("ascii").partition("DATA_START\n")
    pairs = (
        line.split(" = ", 1)
        for line in head.splitlines()
        if " = " in line and "COMMENT" not in line
    )
    lines = [line.split() for line in rest.removesuffix("DATA_STOP\n").splitlines()]
    epochs = [datetime.datetime.fromisoformat(line[0]) for line in lines]
    return dict(pairs), epochs, np.array([line[1:] for line in lines], dtype=float)


def matrix_b_from_a(q: Floats) -> Floats:
    """M_BA with X_B = M_BA X_A by CCSDS 504.0-B-2, annex F2.1."""
    q1, q2, q3, qc = q
    return np.array(
        [
            [q1**2 - q2**2 - q3**2 + qc**2, 2 * (q1 * q2 + q3 * qc), 2 * (q1 * q3 - q2 * qc)],
            [
                2 * (q1 * q2 - q3 * qc),
                -(q1**2) + q2**2 - q3**2 + qc**2,
                2 * (q2 * q3 + q1 * qc),
            ],
            [
                2 * (q1 * q3 + q2 * qc),
                2 * (q2 * q3 - q1 * qc),
                -(q1**2) - q2**2 + q3**2 + qc**2,
            ],
        ]
    )


def test_quaternions_match_the_standard_s_examples() -> None:
    """Annex F2.2: B is A turned by 90 deg about Z. F5.4: by 90, 10 and 45 deg about Z, X and Z, one after the other."""
    turns = Rotation.from_euler("ZXZ", [[90, 0, 0], [90, 10, 45]], degrees=True)
    text = run_export.message(
        "x", [], (run_export.ICRF, run_export.BODY), [START, START + SECOND], turns
    )
    rows = [[float(word) for word in line.split()[1:]] for line in text.splitlines()[-3:-1]]
    np.testing.assert_allclose(rows[0], [0, 0, 0.7071, 0.7071], rtol=0, atol=5e-5)
    np.testing.assert_allclose(rows[1], [0.0805, 0.0334, 0.9204, 0.3812], rtol=0, atol=5e-5)
    np.testing.assert_allclose(
        matrix_b_from_a(np.array(rows[0])) @ [1, 0, 0], [0, -1, 0], rtol=0, atol=1e-12
    )


@pytest.mark.slow
def test_under_the_stars_the_message_puts_every_star_on_its_pixel(
    stars: Flown, tmp_path: Path
) -> None:
    """Star directions by the annex's matrix into the camera, by the lens onto the chip, where the truth has them."""
    flight, run = stars
    camera = flight.lab.camera
    run_export.export(run, ["aem"], tmp_path, quiet)
    metadata, epochs, quaternions = read_aem(tmp_path / "truth.aem")
    assert (metadata["REF_FRAME_A"], metadata["REF_FRAME_B"], metadata["TIME_SYSTEM"]) == (
        "ICRF",
        "STARTRACKER_1",
        "UTC",
    )
    place = dict(zip(camera.sources.id.tolist(), camera.sources.place[:, :3], strict=True))
    for stem, epoch, q in zip(run.stems, epochs, quaternions, strict=True):
        seen = Table.read(f"{stem}.ecsv")
        directions = np.array([place[hip] for hip in seen["id"].tolist()])
        pixels = camera.optics.project(directions @ matrix_b_from_a(q).T)
        np.testing.assert_allclose(
            pixels, np.column_stack([seen["x_px"], seen["y_px"]]), rtol=0, atol=1e-5
        )
        assert epoch == camera.scene.start_time + SECOND * seen.meta["t_mid_s"]
    _, when, answers = read_aem(tmp_path / "solutions.aem")
    assert when == epochs
    off = (Rotation.from_quat(answers).inv() * Rotation.from_quat(quaternions)).magnitude()
    assert 1e-8 < np.degrees(off).max() < 0.01


def test_in_the_laboratory_the_message_puts_every_led_on_its_pixel(
    dome: Flown, tmp_path: Path
) -> None:
    """LEDs in lab coordinates by the annex's matrix into the body, by the mount into the camera."""
    flight, run = dome
    camera = flight.lab.camera
    run_export.export(run, ["aem"], tmp_path, quiet)
    metadata, _, quaternions = read_aem(tmp_path / "truth.aem")
    assert (metadata["REF_FRAME_A"], metadata["REF_FRAME_B"]) == ("LAB", "SC_BODY_1")
    place = dict(zip(camera.sources.id.tolist(), camera.sources.place[:, :3], strict=True))
    for stem, q in zip(run.stems, quaternions, strict=True):
        seen = Table.read(f"{stem}.ecsv")
        leds_m = np.array([place[led] for led in seen["id"].tolist()])
        from_camera_m = leds_m @ matrix_b_from_a(q).T - camera.mount.camera_body_m
        pixels = camera.optics.project(camera.mount.cam_from_body.apply(from_camera_m))
        np.testing.assert_allclose(
            pixels, np.column_stack([seen["x_px"], seen["y_px"]]), rtol=0, atol=5e-4
        )
    assert not (tmp_path / "solutions.aem").exists()  # no frame was solved


@pytest.mark.parametrize("which", ["stars", "dome"])
def test_angles_of_a_solution_are_its_attitude(
    which: str, request: pytest.FixtureRequest
) -> None:
    """What `solutions.ecsv` has of a camera's attitude in the lab, turned back: the camera's, or the body's."""
    flight, run = request.getfixturevalue(which)
    camera = flight.lab.camera
    cam_from_lab = Rotation.random(50, rng=np.random.default_rng(3))
    angles = np.array([scoring.angles_deg(one, camera) for one in cam_from_lab])
    back = recording.attitudes(angles, run.is_celestial)
    meant = cam_from_lab.inv() * (
        Rotation.identity() if which == "stars" else camera.mount.cam_from_body
    )
    np.testing.assert_allclose((back * meant.inv()).magnitude(), 0, rtol=0, atol=1e-12)


def test_a_message_follows_the_standard_s_notation() -> None:
    """Printable ASCII, 254 characters a line, times that ascend, quaternions that do not jump."""
    spin = Rotation.from_euler("z", np.arange(0, 800, 40)[:, None], degrees=True)
    utc = [START + n * SECOND for n in range(len(spin))]
    text = run_export.message(
        "ünïcode", ["″" * 400], (run_export.LAB, run_export.BODY), utc, spin
    )
    assert all(
        line.isascii() and line.isprintable() and len(line) <= 254
        for line in text.splitlines()
    )
    rows = np.array(
        [line.split()[1:] for line in text.splitlines() if line.startswith("2012-")],
        dtype=float,
    )
    assert (np.sum(rows[1:] * rows[:-1], axis=1) > 0.9).all()
    for epochs in ([], [START, START]):
        with pytest.raises(InputError):
            run_export.message(
                "x", [], (run_export.LAB, run_export.BODY), epochs, spin[: len(epochs)]
            )


# Tables


def test_parquet_has_the_columns_and_units_of_the_ecsv(stars: Flown, tmp_path: Path) -> None:
    run = stars[1]
    run_export.export(run, ["parquet", "ecsv"], tmp_path, quiet)
    answers = pyarrow.parquet.read_table(tmp_path / "solutions.parquet")
    kept = Table.read(run.folder / "solutions.ecsv")
    assert answers.column_names == kept.colnames
    np.testing.assert_array_equal(answers["ra_deg"].to_numpy(), kept["ra_deg"])
    assert answers["status"].to_pylist() == ["solved"] * 3
    units = {
        name: (answers.schema.field(name).metadata or {}).get(b"unit")
        for name in answers.column_names
    }
    assert (units["t_s"], units["ra_deg"], units["cross_arcsec"]) == (b"s", b"deg", b"arcsec")
    assert (units["status"], units["frame"], units["rms_px"], units["time_ms"]) == (
        None,
        None,
        b"px",
        b"ms",
    )
    lights = pyarrow.parquet.read_table(tmp_path / "sources.parquet")
    each = [Table.read(f"{stem}.ecsv") for stem in run.stems]
    np.testing.assert_array_equal(
        lights["x_px"].to_numpy(), np.concatenate([one["x_px"] for one in each])
    )
    np.testing.assert_array_equal(
        lights["frame"].to_numpy(), np.repeat([0, 1, 2], [len(one) for one in each])
    )
    assert lights.schema.metadata[b"skysim.seed"] == b"2"
    truth = pyarrow.parquet.read_table(tmp_path / "truth.parquet")
    same = Table.read(tmp_path / "truth.ecsv")
    for name in ("t_mid_s", "mean_cam_from_lab_qw", "cam_from_lab_qw", "rate_cam_x_rad_s"):
        np.testing.assert_array_equal(truth[name].to_numpy(), same[name])
    assert same["cam_from_lab_qw"][1] == each[1].meta["cam_from_lab_xyzw"][3]


# Frames


def test_every_value_of_16_bits_is_in_a_tiff(tmp_path: Path) -> None:
    image = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    files.write_image(tmp_path / "all.tif", image)
    for back in (
        cv2.imread(str(tmp_path / "all.tif"), cv2.IMREAD_UNCHANGED),
        skimage.io.imread(tmp_path / "all.tif"),
    ):
        assert back.dtype == np.uint16
        np.testing.assert_array_equal(back, image)


def test_a_noise_free_frame_keeps_every_digit(dome: Flown, tmp_path: Path) -> None:
    """As TIFF and as Zarr, 64-bit floats."""
    run = dome[1]
    written = run_export.export(run, ["tiff", "zarr"], tmp_path, quiet)
    image = fits.getdata(f"{run.stems[1]}.fits")
    assert image.dtype.itemsize == 8
    np.testing.assert_array_equal(cv2.imread(str(written[1]), cv2.IMREAD_UNCHANGED), image)
    np.testing.assert_array_equal(skimage.io.imread(written[1]), image)
    np.testing.assert_array_equal(
        zarr.open_group(tmp_path / recording.ZARR, mode="r")["frames"][1], image
    )


@pytest.mark.slow
def test_a_sequence_is_chunked_by_frame_and_dated(stars: Flown, tmp_path: Path) -> None:
    flight, run = stars
    run_export.export(run, ["zarr"], tmp_path, quiet)
    group = zarr.open_group(tmp_path / recording.ZARR, mode="r")
    assert group.metadata.zarr_format == 3
    assert group["frames"].chunks == (1, 493, 659)
    images = [fits.getdata(f"{stem}.fits") for stem in run.stems]
    assert group["frames"].dtype == np.uint16
    np.testing.assert_array_equal(group["frames"][:], images)
    opened = xarray.open_zarr(tmp_path / recording.ZARR, consolidated=False)
    assert opened["frames"].dims == ("frame", "y", "x")
    assert opened["mid_utc"].values[0] == np.datetime64("2012-06-22T21:00:00.120000")
    lab_from_body = flight.trajectory().attitude_at(opened["t_mid_s"].values)
    cam_from_lab = flight.lab.camera.mount.cam_from_body * lab_from_body.inv()
    off = (
        Rotation.from_quat(opened["cam_from_lab_xyzw"].values) * cam_from_lab.inv()
    ).magnitude()
    assert off.max() < 1e-12


def test_a_film_has_the_frame_rate_of_the_run(stars: Flown, tmp_path: Path) -> None:
    run = stars[1]
    (path,) = run_export.export(run, ["video"], tmp_path, quiet)
    film = cv2.VideoCapture(str(path))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0, rel=1e-3)
    for stem in run.stems:
        there, picture = film.read()
        assert there
        meant = plots.to_8bit(fits.getdata(f"{stem}.fits").astype(np.uint16), "square root")[
            :492, :658
        ]
        assert np.corrcoef(picture[:, :, 0].ravel(), meant.ravel())[0, 1] > 0.8
    assert not film.read()[0]


# The sky in the header


def camera(distortion: tuple[float, ...], focal_length: str) -> CameraConfig:
    part = {
        "width_px": 1600,
        "height_px": 1200,
        "pixel": "5.5 um",
        "focal_length": focal_length,
        "f_number": 1.4,
    }
    detector = {"quantum_efficiency": 0.5, "full_well_e": 40000, "gain_e_dn": 10, "bits": 12}
    return CameraConfig.model_validate(
        part
        | {
            "principal_point_px": (790.25, 611.5),
            "distortion": distortion,
            "detector": detector,
        }
    )


def misfits(lens: CameraConfig) -> tuple[float, float]:
    """Largest error, px, of astropy's projection to the sky and ours back, and of the header's inverse polynomials from
    ours."""
    cam_from_icrs = star_sources.cam_from_icrs(83.0, -5.0, 37.0)
    header = WCS(fits.Header(wcs.header(lens, cam_from_icrs)))
    across, down = np.meshgrid(np.linspace(-0.5, 1599.5, 33), np.linspace(-0.5, 1199.5, 25))
    pixels = np.column_stack([across.ravel(), down.ravel()])
    ra, dec = np.radians(header.all_pix2world(pixels, 0)).T
    directions = np.column_stack(
        [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    )
    back = Optics.from_camera(lens).project(cam_from_icrs.apply(directions))
    straight = header.wcs_world2pix(
        np.degrees([ra, dec]).T, 0
    )  # of a lens without distortion
    inverse = header.sip_foc2pix(straight + 1 - header.wcs.crpix, 1) - 1
    return float(np.linalg.norm(back - pixels, axis=1).max()), float(
        np.linalg.norm(inverse - back, axis=1).max()
    )


@pytest.mark.parametrize(
    ("distortion", "focal_length"),
    [
        ((-0.1, 0.02, 1e-3, -5e-4, 0.0), "25 mm"),
        ((0.2, 0.1, 1e-3, 1e-3, 0.05), "12 mm"),
        ((0.0, 0.0, 2e-3, -1e-3, 0.0), "16 mm"),
        ((-0.3, 0.1, 0.0, 0.0, -0.02), "10 mm"),
    ],
)
def test_the_header_s_sip_polynomials_match_the_renderer_s_lens(
    distortion: tuple[float, ...], focal_length: str
) -> None:
    """Distortion of up to 100 px: forwards to 0.01 px, backwards exactly, as Brown's law is a polynomial."""
    lens = camera(distortion, focal_length)
    forwards, backwards = misfits(lens)
    assert forwards < wcs.MAX_ERROR_PX
    assert backwards < 1e-6
    assert wcs.accuracy_warning(lens) == ""


@pytest.mark.slow
def test_a_lens_beyond_sip_is_noted_in_header_and_warning() -> None:
    lens = camera((-0.3, 0.1, 0.0, 0.0, -0.02), "6.5 mm")
    forwards, backwards = misfits(lens)
    error_px = wcs.header(lens, Rotation.identity())["SIPERR"]
    assert error_px > 2 * wcs.MAX_ERROR_PX
    assert error_px == pytest.approx(forwards, rel=2 / 3)
    assert backwards < 1e-6
    assert f"{error_px:.2g} px" in wcs.accuracy_warning(lens)
    wide = loader.load(
        "shefex2",
        {"camera.focal_length": "4.5 mm", "camera.distortion": "[-0.4, 0, 0, 0, 0]"},
    )
    assert any(
        line.startswith("camera.distortion: ") for line in check(build_lab(wide)).findings
    )


@pytest.mark.filterwarnings("ignore:.*datfix")
def test_a_distorted_frame_s_header_maps_stars_to_their_pixels(stars: Flown) -> None:
    flight, run = stars
    sources = flight.lab.camera.sources
    seen = Table.read(f"{run.stems[2]}.ecsv")
    place = dict(zip(sources.id.tolist(), sources.place[:, :3], strict=True))
    x, y, z = np.array([place[hip] for hip in seen["id"].tolist()]).T
    header = fits.getheader(f"{run.stems[2]}.fits")
    pixels = np.column_stack(
        WCS(header).all_world2pix(np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z)), 0)
    )
    true = np.column_stack([seen["x_px"], seen["y_px"]])
    assert len(true) > 50
    np.testing.assert_allclose(pixels, true, rtol=0, atol=2 * wcs.TARGET_ERROR_PX)
    bare = WCS(
        {
            key: value
            for key, value in header.items()
            if key[:2] not in ("A_", "B_", "AP", "BP")
        }
    )
    assert (
        np.abs(
            bare.wcs_world2pix(np.degrees([np.arctan2(y, x), np.arcsin(z)]).T, 0) - true
        ).max()
        > 1.0
    )


# What cannot be


def test_bad_input_is_refused_in_one_line_and_leaves_no_file(
    stars: Flown, tmp_path: Path
) -> None:
    with pytest.raises(
        InputError, match="no frames with truth files; allowed: a folder of a run"
    ):
        recording.Recording(tmp_path)
    with pytest.raises(
        InputError,
        match="unknown format 'jpeg'; allowed: aem, ecsv, parquet, tiff, zarr, video",
    ):
        run_export.export(stars[1], ["aem", "jpeg"], tmp_path / "out", quiet)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["zarr", "video"])
def test_a_damaged_frame_leaves_no_half_of_a_sequence(
    stars: Flown, tmp_path: Path, name: str
) -> None:
    folder = tmp_path / "run"
    out = tmp_path / "out"
    folder.mkdir()
    for stem in stars[1].stems:
        for suffix in (".fits", ".ecsv"):
            (folder / (stem.name + suffix)).write_bytes(Path(f"{stem}{suffix}").read_bytes())
    last = folder / "frame_0002.fits"
    last.write_bytes(last.read_bytes()[:100_000])
    with pytest.raises(InputError, match=r"frame_0002\.fits: not a complete FITS file"):
        run_export.export(recording.Recording(folder), [name], out, quiet)
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("mid_utc: ", "mid_uct: ", "mid_utc in the header is None"),
        ("exposure_s: 0.04", "exposure_s: soon", "exposure_s in the header is 'soon'"),
        ("# %ECSV 1.0", "# ECSV", "not an ECSV table"),
    ],
)
def test_a_damaged_truth_table_is_refused_in_one_line(
    stars: Flown, tmp_path: Path, old: str, new: str, complaint: str
) -> None:
    text = Path(f"{stars[1].stems[0]}.ecsv").read_text()
    assert old in text
    path = tmp_path / "frame_0000.ecsv"
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as raised:
        recording.read_truth(path)
    assert complaint in str(raised.value)
    assert "\n" not in str(raised.value)
