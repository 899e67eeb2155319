"""Photographs: EXIF, FITS row orders and folders. The answer is that of the picture as it is viewed."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

import skysim as package
from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE
from estimator.trackers.pipeline import Clock
from skysim.apps import plate_solver
from skysim.apps.plate_solver import picture as plate_picture
from skysim.apps.plate_solver import plate_solution, solver
from skysim.core import images
from skysim.core.errors import InputError
from skysim.core.types import Frame, Truth
from skysim.results.files import recording
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.simulation.flight import simulate_motion
from skysim.sources import stars

# of the SHEFEX-2 camera
PIXEL_UM = 9.9
WIDTH_PX = 659
HEIGHT_PX = 493
FOV_DEG = math.degrees(2 * math.atan((WIDTH_PX - 1) * PIXEL_UM / 2 / 25_000))
ORIENTATION = 0x0112
EXIF = 0x8769
FOCAL_35MM = 0xA405
# How each orientation stores the picture that is seen (Exif 2.32, Orientation).
STORED = {
    1: lambda seen: seen,
    2: np.fliplr,
    3: lambda seen: np.rot90(seen, 2),
    4: np.flipud,
    5: np.transpose,
    6: np.rot90,
    7: lambda seen: np.rot90(seen, 2).T,
    8: lambda seen: np.rot90(seen, -1),
}


def photographed(focal: str = "25 mm") -> tuple[Scene, Frame, Truth]:
    """The SHEFEX-2 camera at rest behind a lens."""
    still = {
        "exposure.frames": "1",
        "motion.rate_deg_s": "[0, 0, 0]",
        "camera.focal_length": focal,
    }
    scene = loader.load("shefex2", still)
    return scene, *simulate_motion(scene).render(0)


@pytest.fixture(scope="module")
def sky() -> tuple[Scene, Frame, Truth]:
    return photographed()


@pytest.fixture(scope="module")
def gray(sky: tuple[Scene, Frame, Truth]) -> NDArray[np.uint8]:
    """The frame as a camera's JPEG would show it, the highest row first."""
    return to_8_bits(sky[1].image_dn)


def to_8_bits(image_dn: NDArray) -> NDArray[np.uint8]:
    return np.clip((image_dn.astype(float) - 60) / 4, 0, 255).astype(np.uint8)


def with_exif(
    path: Path, image: NDArray, orientation: int = 1, focal_35mm: int | None = None
) -> Path:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    if focal_35mm is not None:
        exif.get_ifd(EXIF)[FOCAL_35MM] = focal_35mm
    Image.fromarray(np.ascontiguousarray(image)).save(path, exif=exif, quality=97)
    return path


make_solver = functools.lru_cache(maxsize=8)(
    plate_solver.make_solver
)  # it keeps its trackers


def answer(
    path: Path, fov_deg: float | None = FOV_DEG, annotated: Path | None = None
) -> dict[str, Any]:
    return plate_solver.solve_file(
        path, make_solver(fov_deg, None), plate_solver.Outputs(annotated)
    )


def check_right(found: dict[str, Any], truth: Truth, fov_deg: float = FOV_DEG) -> None:
    """Check pointing and roll of the viewed image to one or two arcminutes, the limit of 8 bits and JPEG."""
    assert found["status"] == "solved"
    ours = stars.cam_from_icrs(found["ra_deg"], found["dec_deg"], found["roll_deg"])
    assert math.degrees((ours * truth.cam_from_lab.inv()).magnitude()) < 0.05
    assert found["fov_deg"] == pytest.approx(fov_deg, rel=5e-3)


# Orientation


@pytest.mark.slow
@pytest.mark.parametrize("orientation", STORED)
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_answer_refers_to_the_image_as_viewed(
    sky: tuple[Scene, Frame, Truth],
    gray: NDArray,
    tmp_path: Path,
    suffix: str,
    orientation: int,
) -> None:
    """This holds for mirrored storage (2, 4, 5, 7), too; the annotated image is the viewed one."""
    path = with_exif(tmp_path / f"x{suffix}", STORED[orientation](gray), orientation)
    check_right(answer(path, annotated=tmp_path / "x.annotated.png"), sky[2])
    height, width, _ = cv2.imread(str(tmp_path / "x.annotated.png")).shape
    assert height * WIDTH_PX == width * HEIGHT_PX


@pytest.mark.slow
@pytest.mark.parametrize(("orientation", "turned_deg"), [(3, 180), (6, -90), (8, 90)])
def test_without_its_orientation_tag_an_image_has_another_attitude(
    sky: tuple[Scene, Frame, Truth],
    gray: NDArray,
    tmp_path: Path,
    orientation: int,
    turned_deg: float,
) -> None:
    """Without this the tests above would pass for a solver that ignores the tag."""
    tall = math.degrees(
        2 * math.atan(math.tan(math.radians(FOV_DEG / 2)) * (HEIGHT_PX - 1) / (WIDTH_PX - 1))
    )
    found = answer(
        with_exif(tmp_path / "x.png", STORED[orientation](gray)),
        FOV_DEG if orientation == 3 else tall,
    )
    turn = Rotation.from_euler("z", turned_deg, degrees=True)
    ours = stars.cam_from_icrs(found["ra_deg"], found["dec_deg"], found["roll_deg"])
    assert math.degrees((ours * (turn * sky[2].cam_from_lab).inv()).magnitude()) < 0.05


# Focal length


def test_exif_gives_the_field_by_the_diagonal(
    sky: tuple[Scene, Frame, Truth], gray: NDArray, tmp_path: Path
) -> None:
    """43.27 mm over the chip's 8.15 mm: the 25 mm lens is one of 133 mm."""
    focal_35mm = round(
        25 * math.hypot(36, 24) / math.hypot(WIDTH_PX, HEIGHT_PX) / PIXEL_UM * 1000
    )
    found = answer(with_exif(tmp_path / "x.jpg", gray, 1, focal_35mm), None)
    check_right(found, sky[2])
    (narrow, wide), search = found["tried_fov_deg"]
    assert focal_35mm == 133
    assert search[0] < 3 < 99 < search[1]
    assert narrow < 0.93 * FOV_DEG < 1.07 * FOV_DEG < wide
    # The longer side would be 4 % off.
    assert math.sqrt(narrow * wide) == pytest.approx(FOV_DEG, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("focal_35mm", [133, 138])
@pytest.mark.parametrize("orientation", [1, 6])
def test_both_ways_to_convert_a_focal_length_are_within_its_uncertainty(
    gray: NDArray, focal_35mm: int, orientation: int
) -> None:
    """By the longer side (36 mm over 6.52 mm) it is 138 mm. In portrait format the field is the shorter side's."""
    seen = images.ViewedImage(
        np.ascontiguousarray(STORED[orientation](gray)), focal_35mm=focal_35mm
    )
    unknown = plate_solver.make_solver(None, None)
    outcome = plate_solver.solve_picture(seen, unknown)
    assert outcome.report.attitude.solved
    assert outcome.hypothesis.solver.fov_deg is not None
    assert [one.solver.hypotheses for one in outcome.tried] == [2, 2]
    assert (
        plate_picture.hypotheses(seen, plate_solver.make_solver(20.0, None))[0].solver.fov_deg
        == 20.0
    )


def test_trackers_are_cached_by_their_uncertainty(gray: NDArray) -> None:
    default_solver = plate_solver.make_solver(20.0, None)
    # Of the same picture: they share their trackers' cache.
    by_exif = solver.replace(default_solver, fov_uncertainty=0.1)
    first, second, again = (
        next(one.trackers(640, 480)) for one in (default_solver, by_exif, default_solver)
    )
    assert (first.focal_uncertainty, second.focal_uncertainty) == (
        solver.FOV_UNCERTAINTY,
        0.1,
    )
    assert first is again


def test_a_phone_s_wide_field_is_solved_by_its_focal_length(tmp_path: Path) -> None:
    """66 degrees are beyond the search; a phone's main lens is one of 26 mm."""
    _, frame, truth = photographed("5 mm")
    found = answer(with_exif(tmp_path / "x.png", to_8_bits(frame.image_dn), 1, 27), None)
    check_right(found, truth, 66.2)


@pytest.mark.slow
def test_a_wrong_exif_focal_length_is_abandoned(
    sky: tuple[Scene, Frame, Truth], gray: NDArray, tmp_path: Path
) -> None:
    """For a crop or a manual lens; zero and absurd values are not tried."""
    check_right(answer(with_exif(tmp_path / "x.jpg", gray, 1, 50), None), sky[2])
    for absurd in (1, 65_000):
        unknown = plate_solver.make_solver(None, None)
        (only,) = plate_picture.hypotheses(
            images.ViewedImage(gray, focal_35mm=absurd), unknown
        )
        assert (only.solver.fov_deg, only.solver.hypotheses) == (None, 1)


class FixedTracker:
    """A tracker with one answer."""

    efforts = 1

    def __init__(self, log10_chance: float) -> None:
        nothing = np.zeros(0, np.int64)
        where = Rotation.identity()
        self.answer = Attitude(
            "solved", where, np.eye(3), StarMatch(nothing, nothing, where, log10_chance)
        )

    def solve_centroids(self, *_: object) -> Attitude:
        return self.answer


@pytest.mark.parametrize("fov_deg", [12.0, None])
@pytest.mark.parametrize("hypotheses", [1, 4])
def test_every_hypothesis_reduces_the_allowed_chance_probability(
    monkeypatch: pytest.MonkeyPatch, fov_deg: float | None, hypotheses: int
) -> None:
    one = solver.replace(plate_solver.make_solver(fov_deg, None), hypotheses=hypotheses)
    tries = len(one.candidate_cameras(64, 48))
    assert tries == 1 if fov_deg else tries > 8
    limit = ACCEPT_LOG10_CHANCE - math.log10(tries * hypotheses)
    for log10_chance, accepted in ((limit - 0.01, True), (limit + 0.01, False)):
        tracker = FixedTracker(log10_chance)
        monkeypatch.setattr(solver.Solver, "trackers", lambda *_: iter([tracker]))  # noqa: B023
        attitude, _ = solver.solve_centroids(Centroids.empty(), one, (64, 48), Clock())
        assert attitude.solved is accepted


# FITS


@pytest.mark.parametrize(
    "order",
    [
        "TOP-DOWN",
        *(pytest.param(order, marks=pytest.mark.slow) for order in ("BOTTOM-UP", None)),
    ],
)
@pytest.mark.parametrize("highest_first", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_fits_image_has_the_same_attitude_in_either_row_order(
    sky: tuple[Scene, Frame, Truth], tmp_path: Path, order: str | None, highest_first: bool
) -> None:
    """Without ROWORDER both orders are tried. With a wrong ROWORDER the sky is mirrored."""
    image = sky[1].image_dn if highest_first else sky[1].image_dn[::-1]
    path = tmp_path / "x.fits"
    fits.PrimaryHDU(image, fits.Header([("ROWORDER", order)] if order else [])).writeto(path)
    found = answer(path)
    if order and (order == "TOP-DOWN") is not highest_first:
        assert found["ra_deg"] is None
        assert "perhaps mirrored" in found["hint"]
        return
    check_right(found, sky[2])
    assert ("no ROWORDER in the header" in found["hint"]) is (order is None and highest_first)


@pytest.mark.slow
def test_a_mirrored_fits_picture_of_known_order_is_refused(
    sky: tuple[Scene, Frame, Truth], tmp_path: Path
) -> None:
    fits.PrimaryHDU(
        sky[1].image_dn[:, ::-1], fits.Header([("ROWORDER", "TOP-DOWN")])
    ).writeto(tmp_path / "x.fits")
    found = answer(tmp_path / "x.fits")
    assert found["ra_deg"] is None
    assert "perhaps mirrored: it solves when flipped left to right" in found["hint"]


@pytest.mark.slow
def test_our_frames_state_their_row_order_and_are_read_unchanged(
    sky: tuple[Scene, Frame, Truth], tmp_path: Path
) -> None:
    scene, frame, truth = sky
    recording.write_frame(tmp_path, frame, truth, scene)
    seen = images.read_picture(tmp_path / "frame_0000.fits")
    np.testing.assert_array_equal(seen.pixels, frame.image_dn)
    assert seen.row_order_known
    for suffix in (".fits", ".png"):
        check_right(answer(tmp_path / f"frame_0000{suffix}"), truth)


# Files, folders and names


def test_a_folder_stands_for_the_list_of_its_images(tmp_path: Path) -> None:
    inner = tmp_path / "folder.jpg"
    inner.mkdir()
    for name in (
        "b.JPG",
        "a.fits.gz",
        "c.annotated.png",
        ".hidden.png",
        "notes.txt",
        "d.tiff",
    ):
        (inner / name).write_bytes(b"")
    other = tmp_path / "x.png"
    listed = plate_solver.pictures_in([other, inner])
    assert listed == [other, inner / "a.fits.gz", inner / "b.JPG", inner / "d.tiff"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        InputError, match=r"empty: a folder without images; allowed: \.fits, .*\.arw$"
    ):
        plate_solver.pictures_in([tmp_path / "empty"])


def test_annotated_images_have_the_images_names() -> None:
    def names(*paths: str) -> list[str]:
        return [
            path.as_posix()
            for path in plate_solver.annotated_paths(
                Path("out"), [Path(path) for path in paths]
            )
        ]

    assert names("my_sky.jpg", "a/m31.fits.gz") == [
        "out/my_sky.annotated.png",
        "out/m31.annotated.png",
    ]
    assert names("x.jpg", "x.fits") == ["out/x.jpg.annotated.png", "out/x.fits.annotated.png"]
    assert names("a/x.jpg", "b/x.jpg", "y.png") == [
        "out/x.jpg.annotated.png",
        "out/x.jpg-2.annotated.png",
        "out/y.annotated.png",
    ]


def test_stars_have_their_catalog_s_designation() -> None:
    assert [plate_solution.star_name(n) for n in (71683, 1_048_915, 2_345_678)] == [
        "HIP 71683",
        "HD 48915",
        "Gaia 345678",
    ]


# What users call


@pytest.mark.slow
def test_python_gets_detections_and_attempts(gray: NDArray, tmp_path: Path) -> None:
    path = with_exif(
        tmp_path / "x.png", gray, 2
    )  # as stored it is upright: seen, it is mirrored
    found = package.solve(path, fov_deg=FOV_DEG)
    assert (found.status, found.ra_deg, found.matches) == (
        "no identification beyond chance: the budget of the search is used up",
        None,
        0,
    )
    assert "mirrored" in found.hint
    assert found.lights > 20
    assert (found.brightest_dn, found.background_dn) == (gray.max(), np.median(gray))
    ((narrow, wide),) = found.tried_fov_deg
    assert (narrow, wide) == pytest.approx((0.948 * FOV_DEG, 1.058 * FOV_DEG), rel=2e-3)
    assert found.catalog_limit_mag == 8.0
    assert (
        package.solve(
            with_exif(path, gray), fov_deg=FOV_DEG, catalog="gaia_v8.0"
        ).catalog_limit_mag
        == 8.0
    )
    with pytest.raises(
        InputError,
        match=r"solve.catalog: unknown catalog 'deep'; allowed: gaia_v8.0, hipparcos_hp6.5",
    ):
        package.solve(path, catalog="deep")


def test_json_output_keeps_its_keys_and_adds_details(gray: NDArray, tmp_path: Path) -> None:
    found = answer(with_exif(tmp_path / "x.png", gray))
    assert list(json.loads(json.dumps(found))) == [
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
        "lights",
        "brightest_dn",
        "background_dn",
        "tried_fov_deg",
        "catalog_limit_mag",
        "hint",
        "date_utc",
        "time_ms",
        "warning",
        "bad_input",
    ]
    assert found["hint"] == ""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["x.JPG", "x.fits.gz"])
def test_the_browser_s_panel_solves_the_same_image(
    sky: tuple[Scene, Frame, Truth], gray: NDArray, tmp_path: Path, name: str
) -> None:
    from skysim.apps.gui.worker.photo import photo_from_file

    if name == "x.JPG":
        data = with_exif(tmp_path / "x.jpg", STORED[6](gray), 6).read_bytes()
    else:
        fits.PrimaryHDU(sky[1].image_dn[::-1]).writeto(tmp_path / "x.fits.gz")
        data = (tmp_path / "x.fits.gz").read_bytes()
    photo, pixels = photo_from_file(name, data, FOV_DEG)
    assert pixels.shape == (HEIGHT_PX, WIDTH_PX)
    check_right({"status": photo.result.row.status, **photo.solution}, sky[2])
    refused, _ = photo_from_file(
        "x.png", with_exif(tmp_path / "y.png", gray, 2).read_bytes(), FOV_DEG
    )
    assert "mirrored" in refused.hint
