"""Errors of the lens against the field angle, from a table of a lens program."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import special
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.camera.projection import lateral_color
from skysim.camera.psf.otf import field_sigma_px
from skysim.camera.render import Window, render
from skysim.core.errors import InputError
from skysim.core.types import Floats, Mount, Trajectory
from skysim.experiments.datasheet.scene_changes import causes
from skysim.scene import loader, provenance
from skysim.scene.sections.camera import CameraConfig, read_columns
from skysim.sources.stars import steady_points

FIELD_DEG = [0.0, 4.0, 8.0, 12.0]
COMA_UM = [0.0, 1.5, 6.0, 9.0]
SIGMA_UM = [2.0, 2.5, 4.0, 9.0]
LATERAL = [0.0, 0.2, 0.7, 1.0]
TABLE = {"field_deg": FIELD_DEG, "coma_um": COMA_UM, "sigma_um": SIGMA_UM, "lateral": LATERAL}
CSV = "# exported\nfield_deg,coma_um,sigma_um,lateral\n" + "".join(
    f"{','.join(map(str, row))}\n" for row in zip(*TABLE.values(), strict=True)
)
ECSV = (
    "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: field_deg, datatype: float64}\n"
    "# - {name: coma_um, datatype: float64}\nfield_deg coma_um\n0.0 0.0\n\n12.0 9.0\n"
)
DISTORTION = [-0.2, 0.05, 0, 0, 0]
CHROMATIC = {"wavelength": ["400 nm", "900 nm"], "corner_px": [-0.5, 1.5]}


def camera(**changes: Any) -> CameraConfig:
    part = {
        "width_px": 1200, "height_px": 900, "pixel": "5 um", "focal_length": "16 mm", "f_number": 2,
        "detector": {"quantum_efficiency": 0.5, "full_well_e": 4e4, "gain_e_dn": 10, "bits": 12},
    }  # fmt: skip
    return CameraConfig.model_validate(part | changes)


def at(config: CameraConfig, field_deg: Floats, turn_deg: float = 30.0) -> Floats:
    """(N, 2) pixels of directions at these field angles, by the lens itself."""
    field = np.radians(field_deg)
    turn = math.radians(turn_deg)
    across = np.sin(field)[:, None] * [math.cos(turn), math.sin(turn)]
    return Optics.from_camera(config).project(np.column_stack([across, np.cos(field)]))


@pytest.mark.parametrize(
    "text", [CSV, CSV.replace(",", "  "), CSV.replace(",", ", "), f"\ufeff{CSV}"]
)
def test_a_file_gives_its_columns(tmp_path: Path, text: str) -> None:
    file = tmp_path / "lens.csv"
    file.write_text(text)
    lens = {"camera.chromatic": CHROMATIC}
    made = loader.load_scene("shefex2", lens | {"camera.lens_table": str(file)})
    inline = loader.load_scene("shefex2", lens | {"camera.lens_table": TABLE})
    assert made.camera == inline.camera
    assert hash(made.camera) == hash(inline.camera)


def test_an_ecsv_file_beside_its_scene(tmp_path: Path) -> None:
    (tmp_path / "lens.ecsv").write_text(ECSV)
    scene = tmp_path / "one.yaml"
    scene.write_text("schema: 1\nbase: shefex2\ncamera: {lens_table: lens.ecsv}\n")
    table = loader.load(str(scene)).camera.lens_table
    assert table is not None
    assert (table.field_deg, table.coma_um, table.lateral) == ((0, 12), (0, 9), None)
    shown = {entry.path: entry for entry in provenance.effective(str(scene))}
    entry = shown["camera", "lens_table"]
    assert (entry.value, entry.origin.what) == (str(tmp_path / "lens.ecsv"), "this file")


@pytest.mark.parametrize("distortion", [[0, 0, 0, 0, 0], DISTORTION])
def test_each_error_is_the_table_s_at_its_field_angle(distortion: list[float]) -> None:
    """Along the radius, in pixels of 5 um; constant beyond the last row."""
    config = camera(distortion=distortion, chromatic=CHROMATIC, lens_table=TABLE)
    field_deg = np.array([*FIELD_DEG[1:], 20.0])
    xy_px = at(config, field_deg)
    toward = np.array([math.cos(math.radians(30)), math.sin(math.radians(30))])
    coma_px = config.along_radius("coma_um", 0.0, xy_px)
    np.testing.assert_allclose(
        coma_px, np.outer(np.array([1.5, 6, 9, 9]) / 5, toward), rtol=1e-6, atol=1e-9
    )
    sigma_px = field_sigma_px(config, xy_px)
    np.testing.assert_allclose(sigma_px, np.array([2.5, 4, 9, 9]) / 5, rtol=1e-6, atol=0)
    # On the axis coma has no size, blur no direction.
    axis = np.array([config.center_px])
    np.testing.assert_allclose(config.along_radius("coma_um", 0.0, axis), 0, atol=1e-12)
    np.testing.assert_allclose(field_sigma_px(config, axis), 2 / 5, rtol=1e-9)
    chromatic = np.tile([[0, 0.8, 0, 0]], (4, 1))
    moved = lateral_color(config, xy_px, chromatic) - xy_px
    wanted = np.outer(0.8 * np.array([0.2, 0.7, 1, 1]), toward)
    np.testing.assert_allclose(moved, wanted, rtol=1e-6, atol=1e-9)


def image_of(config: CameraConfig, xy_px: Floats) -> Floats:
    """(25, 25) shares of the light around a star whose image is at a whole pixel."""
    toward = np.append((xy_px - config.center_px) / config.focal_px, 1.0)
    star = steady_points(
        np.zeros(1, np.int64),
        (toward / np.linalg.norm(toward))[None],
        np.full(1, 1e9),
        np.ones(1),
    )
    frame = np.zeros((900, 1200))
    still = Trajectory.at_rest(Rotation.identity(), 1.0)
    mount = Mount(np.zeros(3), Rotation.identity())
    render(frame, star, Optics.from_camera(config), still, mount, Window(0.0, 0.1))
    x, y = xy_px.astype(int)
    return frame[y - 12 : y + 13, x - 12 : x + 13] / frame.sum()


def test_a_linear_table_is_the_key() -> None:
    """Coma and blur that grow with the radius, by the keys and by a table of two rows."""
    plain = camera(psf={"kind": "gaussian", "coma_px": 2.0, "corner_sigma_px": 0.9})
    corner_deg = math.degrees(math.atan(plain.corner_px / plain.focal_px))
    rows = {"field_deg": [0, corner_deg], "coma_um": [0, 10], "sigma_um": [0, 4.5]}
    place = np.array([950.0, 300.0])
    np.testing.assert_allclose(
        image_of(camera(lens_table=rows), place), image_of(plain, place), rtol=0, atol=1e-6
    )
    assert np.abs(image_of(camera(), place) - image_of(plain, place)).max() > 0.01


def test_coma_of_a_wavefront_is_where_its_rays_end() -> None:
    """The rays of W131 rho^3 cos phi end at 2 N grad W (Welford 1986); the table has 2 N lambda W131."""
    waves = 2.5
    wavelength_um = 0.6
    config = camera()
    place = np.array([1000.0, 700.0])
    field_deg = math.degrees(
        math.atan(np.hypot(*(place - config.center_px)) / config.focal_px)
    )
    f_number = config.image_distance_m / config.pupil_m
    coma_um = 2 * f_number * wavelength_um * waves
    rows = {"field_deg": [0, field_deg, 30], "coma_um": [0, coma_um, coma_um]}
    image = image_of(camera(lens_table=rows), place)
    # Derivatives by difference quotients over a grid of the pupil, y along the radius of the field.
    step = 1e-4
    side = np.linspace(-1, 1, 161)
    x, y = (one.ravel() for one in np.meshgrid(side, side))
    x, y = (one[x**2 + y**2 <= 1] for one in (x, y))

    def wavefront_um(x: Floats, y: Floats) -> Floats:
        return waves * wavelength_um * (x**2 + y**2) * y

    scale = 2 * f_number / 5.0 / (2 * step)
    across = scale * (wavefront_um(x + step, y) - wavefront_um(x - step, y))
    along = scale * (wavefront_um(x, y + step) - wavefront_um(x, y - step))
    # The image is about the center of light.
    along -= along.mean()
    toward = (place - config.center_px) / np.linalg.norm(place - config.center_px)
    edges = np.arange(26) - 12.5
    places = (
        along * toward[0] - across * toward[1],
        along * toward[1] + across * toward[0],
    )
    shares = (np.diff(special.ndtr((edges - one[:, None]) / 0.7), axis=1) for one in places)
    expected = np.einsum("nj,ni->ij", *shares) / len(x)
    # Coma is rounded to 0.1 px along x and y.
    np.testing.assert_allclose(image, expected, rtol=0, atol=4e-3)
    third = [(one * (np.add.outer(np.arange(25) * toward[1], np.arange(25) * toward[0])
              - 12 * toward.sum()) ** 3).sum() for one in (image, expected)]  # fmt: skip
    assert third[0] == pytest.approx(third[1], rel=0.1)


def test_a_datasheet_removes_the_table() -> None:
    scene = loader.load_scene(
        "shefex2", {"camera.lens_table": {"field_deg": [0, 9], "coma_um": [0, 5]}}
    )
    change = causes(scene)["no lens errors"]
    assert change == {"camera.lens_table": None}
    assert "no lens errors" not in causes(loader.load("shefex2"))


CONFLICT = "columns that conflict with keys of camera; allowed: coma_um or psf.coma_px"


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"camera.psf.coma_px": 1}, CONFLICT),
        ({"camera.psf.corner_sigma_px": 1}, CONFLICT),
        ({"camera.chromatic": None}, CONFLICT),
        ({"camera.lens_table.coma_um": [0, 1]}, "field_deg has 4 numbers, coma_um has 2"),
        (
            {"camera.lens_table.field_deg": [0, 8, 4, 12]},
            "field_deg is not strictly ascending",
        ),
        ({"camera.lens_table.coma_mm": [0, 1]}, "unknown key"),
        ({"camera.lens_table.coma_um": [0, 1, 2, 300]}, "300"),
    ],
)
def test_columns_that_do_not_suit_are_refused(keys: dict[str, Any], message: str) -> None:
    given = {"base": "shefex2", "camera": {"chromatic": CHROMATIC, "lens_table": TABLE}}
    with pytest.raises(InputError, match=rf"^camera\.lens_table\S*: .*{message}"):
        loader.load_scene(given, keys)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read"),
        ("", "not enough values"),
        ("field_deg,coma_um\n", "shorter"),
        ("field_deg,coma_um\n0,1\n2\n", "inhomogeneous"),
        ("field_deg,coma_um\n0,few\n1,2\n", "could not convert"),
        (
            "field_deg,coma_mm\n0,1\n1,2\n",
            "unknown column 'coma_mm'; allowed: field_deg, coma_um, sigma_um",
        ),
    ],
)
def test_a_file_that_is_no_table_is_refused(
    tmp_path: Path, text: str | None, message: str
) -> None:
    file = tmp_path / "lens.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(
        InputError, match=rf"lens\.csv: .*{message}.*; allowed: a line of names"
    ):
        read_columns(str(file))


@pytest.mark.parametrize(
    "text", ["coma_um\n0\n1\n", "field_deg,coma_um\n0,nan\n1,2\n", "field_deg,coma_um\n0,1\n"]
)
def test_numbers_that_are_none_are_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "lens.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=r"^camera\.lens_table: "):
        loader.load_scene("shefex2", {"camera.lens_table": str(file)})
