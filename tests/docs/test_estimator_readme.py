"""The package's README: its code solves an image, and its tables list every algorithm."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator import Camera, ra_dec_roll_rad
from estimator.attitude.solvers import SOLVERS
from estimator.catalog import catalog
from estimator.centroiding.centroid import CENTROIDERS
from estimator.detection.detect import DETECTORS
from estimator.identification.registry import IDENTIFIERS

ROOT = Path(__file__).parents[2]
README = (ROOT / "estimator/README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def picture(cam_from_icrs: Rotation) -> np.ndarray:
    """A gray 8-bit image of a field of 0.26 rad, focal length 2 % longer, star blur of one pixel."""
    camera = Camera.from_fov(1000, 800, 0.26).zoomed(1.02)
    stars = catalog.read(ROOT / "data/catalogs/hipparcos_hp6.5.ecsv")
    xy = camera.pixels(cam_from_icrs.apply(stars.vectors))
    inside = camera.contains(np.nan_to_num(xy, nan=-1e9))
    light = np.zeros((800, 1000))
    rows, columns = np.mgrid[:800, :1000]
    for (x, y), mag in zip(xy[inside], stars.v_mag[inside], strict=True):
        light += (
            4000 * 10 ** (-0.4 * mag) * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 2)
        )
    return np.clip(
        light + np.random.default_rng(1).normal(10, 1.5, light.shape), 0, 255
    ).astype(np.uint8)


def dome_picture(folder: Path, cam_from_lab: Rotation) -> None:
    """Write a list of LEDs, 30 mm apart on a plane 1 m above the bearing, and a picture of them, as the README has."""
    x, y = np.meshgrid(np.arange(-300, 301, 30.0), np.arange(-300, 301, 30.0))
    rng = np.random.default_rng(3)
    place_mm = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1000.0)])
    place_mm[:, :2] += rng.uniform(-8, 8, (len(place_mm), 2))
    rows = [f"{n},{row[0]},{row[1]},{row[2]}" for n, row in enumerate(place_mm)]
    (folder / "leds.csv").write_text("\n".join(["id,x_mm,y_mm,z_mm", *rows]))
    camera = Camera.from_fov(1000, 800, fov_deg=14.9)
    xy = camera.pixels(cam_from_lab.apply(place_mm / 1e3) - [0, 0, 0.38])
    light = rng.normal(100, 3, (800, 1000))
    down, along = np.mgrid[:800, :1000]
    for x_px, y_px in xy[camera.contains(np.nan_to_num(xy, nan=-1e9))]:
        light += 3000 * np.exp(-((along - x_px) ** 2 + (down - y_px) ** 2) / 4)
    cv2.imwrite(str(folder / "my_dome.png"), light.astype(np.uint16))


@pytest.mark.slow
def test_five_lines_solve_an_image(tmp_path: Path, monkeypatch, capsys) -> None:
    truth = Rotation.from_euler("xyz", [25, 40, 10], degrees=True)
    cv2.imwrite(str(tmp_path / "my_sky.jpg"), picture(truth))
    turn = Rotation.from_euler("zyx", [20, 4, -5], degrees=True)
    dome_picture(tmp_path, turn)
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in BLOCKS:
        exec(block, names)
    first, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith("solved")
    found = names["attitude"].cam_from_ref
    # Ten stars of a tenth of a pixel of 54": some tens of arcseconds, roll ten times that.
    assert (found * truth.inv()).magnitude() < 2e-3
    assert names["under_dome"].status == "solved"
    assert (names["under_dome"].cam_from_ref * turn.inv()).magnitude() < 1e-3
    assert ra_dec_roll_rad(found)[0] == pytest.approx(ra_dec_roll_rad(truth)[0], abs=3e-4)


@pytest.mark.parametrize(
    ("name", "algorithms"),
    [
        ("DETECTORS", DETECTORS),
        ("CENTROIDERS", CENTROIDERS),
        ("IDENTIFIERS", IDENTIFIERS),
        ("SOLVERS", SOLVERS),
    ],
)
def test_the_table_names_every_algorithm(name: str, algorithms: dict) -> None:
    line = next(line for line in README.splitlines() if line.startswith(f"| `{name}`"))
    named = {word for word in re.findall(r"`(\w+)`", line)} | {
        "default",
        "fialho_2",
        "fialho_3",
    }
    assert set(algorithms) - named == set()


def test_every_link_has_an_existing_target() -> None:
    links = re.findall(r"\]\(([\w/]+\.py)\)", README)
    assert len(links) > 10
    assert [link for link in links if not (ROOT / "estimator" / link).is_file()] == []
