"""Sky, Moon and stray light against the law of illumination, published values and independent geometry."""

from __future__ import annotations

import typing

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from skysim.camera.glow.background import (
    BACKGROUNDS,
    NANOLAMBERT_V0,
    PointedCamera,
    diffuse_air_mass,
    even_grid_px,
    fill,
    glow_map,
    moonlight_nl,
    pixel_directions,
    scattering,
    transmittance,
    unproject,
)
from skysim.camera.optics import Optics
from skysim.scene.sections import surroundings
from skysim.scene.sections.camera import CameraConfig
from skysim.sources.photometry import SUN, Band, star_flux_e_s_m2

BAND = Band.from_efficiency(0.5)
CAMERA = {
    "width_px": 801,
    "height_px": 601,
    "pixel": "5.5 um",
    "focal_length": "8 mm",
    "f_number": 1.4,
    "transmission": 0.8,
    "detector": {
        "quantum_efficiency": 0.5,
        "full_well_e": 40000,
        "gain_e_dn": 10,
        "bits": 12,
    },
}
BENT = {"distortion": (-0.25, 0.08, 0.002, -0.001, 0.0), "principal_point_px": (380.0, 310.0)}
POINTING = Rotation.from_euler("xyz", [0.4, -1.1, 2.0])
SKY = {"kind": "sky", "mag_arcsec2": 21.0}
MOON = {
    "kind": "moon",
    "ra_deg": 30.0,
    "dec_deg": 40.0,
    "phase_angle_deg": 20.0,
    "moon_zenith_deg": 50.0,
    "field_zenith_deg": 20.0,
}


def optics(**camera: object) -> Optics:
    return Optics.from_camera(CameraConfig.model_validate(CAMERA | camera))


def pointed(lens: Optics) -> PointedCamera:
    return PointedCamera(lens, POINTING, np.zeros(3), BAND)


def glow(**part: object) -> surroundings.Glow:
    made: surroundings.Glow = TypeAdapter(surroundings.Glow).validate_python(
        part, by_alias=True, by_name=True
    )
    return made


def lab_place(right_deg: float) -> tuple[float, float]:
    """Right ascension and declination, deg, of a point at this angle to the right of the boresight."""
    angle = np.radians(right_deg)
    x, y, z = POINTING.inv().apply([np.sin(angle), 0.0, np.cos(angle)])
    return float(np.degrees(np.arctan2(y, x)) % 360), float(np.degrees(np.arcsin(z)))


def nodes_px(lens: Optics) -> tuple[np.ndarray, tuple[int, int]]:
    rows, columns = pointed(lens).nodes().shape
    return even_grid_px(lens.camera, columns, rows), (rows, columns)


def whole_map(config: surroundings.Glow, lens: Optics) -> np.ndarray:
    """Background computed directly at every fourth pixel, for comparison."""
    view = pointed(lens).grid(201, 151)
    return BACKGROUNDS[config.kind](config, view).reshape(view.shape)


def drawn(config: surroundings.Glow, lens: Optics, exposure_s: float = 1.0) -> np.ndarray:
    image = np.full((lens.camera.height_px, lens.camera.width_px), np.nan, np.float32)
    fill(image, glow_map((config,), pointed(lens)), exposure_s)
    return image


def test_every_background_kind_of_the_schema_is_implemented() -> None:
    union = typing.get_args(typing.get_args(surroundings.Glow)[0])
    assert {typing.get_args(one.model_fields["kind"].annotation)[0] for one in union} == set(
        BACKGROUNDS
    )


@pytest.mark.parametrize("camera", [{}, BENT, {"distortion": (0.1, 0.0, 0.0, 0.01, 0.05)}])
def test_unprojected_pixels_project_to_themselves(camera: dict[str, object]) -> None:
    lens = optics(**camera)
    xy, _ = nodes_px(lens)
    toward = unproject(xy, lens)
    np.testing.assert_allclose(lens.project(toward), xy, rtol=0, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(toward, axis=1), 1, rtol=1e-14)


def test_a_uniform_sky_falls_with_the_fourth_power_of_the_cosine() -> None:
    lens = optics()
    xy, shape = nodes_px(lens)
    offset = xy - [400, 300]
    cosine = lens.camera.focal_px / np.hypot(lens.camera.focal_px, np.hypot(*offset.T))
    levels = glow_map((glow(**SKY),), pointed(lens)).ravel()
    middle = cosine.argmax()
    np.testing.assert_allclose(
        levels / levels[middle], (cosine / cosine[middle]) ** 4, rtol=1e-5
    )
    assert shape[0] * shape[1] == len(xy)
    assert cosine.min() ** 4 < 0.8  # the field is wide enough to tell


def test_a_pixel_s_sky_light_is_its_solid_angle_times_surface_brightness() -> None:
    lens = optics()
    pixel_arcsec = np.degrees(1 / lens.camera.focal_px) * 3600
    star = star_flux_e_s_m2(21.0, *SUN, BAND) * np.pi / 4 * (8e-3 / 1.4) ** 2 * 0.8
    assert drawn(glow(**SKY), lens, 3.0)[300, 400] == pytest.approx(
        3 * star * pixel_arcsec**2, rel=1e-3
    )


@pytest.mark.long
@pytest.mark.parametrize("camera", [{}, BENT])
def test_the_pixels_solid_angles_sum_to_the_field(camera: dict[str, object]) -> None:
    """Their solid angles add up to that inside of the frame's edge, a polygon of great circles (Girard)."""
    lens = optics(**camera)
    x, y = np.meshgrid(np.arange(801.0), np.arange(601.0))
    pixels = pixel_directions(np.column_stack([x.ravel(), y.ravel()]), lens)[1].sum()
    along_x = np.linspace(-0.5, 800.5, 1602)
    along_y = np.linspace(-0.5, 600.5, 1202)
    edge = np.concatenate(
        [
            np.column_stack([along_x, np.full(1602, -0.5)]),
            np.column_stack([np.full(1202, 800.5), along_y]),
            np.column_stack([along_x[::-1], np.full(1602, 600.5)]),
            np.column_stack([np.full(1202, -0.5), along_y[::-1]]),
        ]
    )
    a = unproject(edge, lens)
    b = np.roll(a, -1, axis=0)
    middle = np.array([0.0, 0.0, 1.0])
    # Triangles from the boresight to each piece of edge: tan(E / 2) = triple product / (1 + the three cosines).
    halves = np.arctan2(
        np.cross(a, b) @ middle, 1 + np.sum(a * b, axis=1) + a @ middle + b @ middle
    )
    assert pixels == pytest.approx(2 * halves.sum(), rel=2e-5)


def test_vignetting_dims_the_sky_and_not_a_light_leak() -> None:
    table = {"kind": "table", "angle_deg": (0, 10, 30), "transmission": (1, 0.7, 0.1)}
    clear = optics()
    dim = optics(vignetting=table)
    edge_deg = np.degrees(np.arctan(400 / clear.camera.focal_px))
    ratio = drawn(glow(**SKY), dim)[300] / drawn(glow(**SKY), clear)[300]
    # The cusp on the axis is rounded off: half a node of 30 px, 0.6 degrees, costs 1.8 % there and less elsewhere.
    assert ratio[400] == pytest.approx(1, abs=0.03)
    assert ratio[0] == pytest.approx(
        np.interp(edge_deg, (0, 10, 30), (1, 0.7, 0.1)), rel=1e-3
    )
    leak = drawn(glow(kind="uniform", e_s=7.0), dim, 0.5)
    np.testing.assert_array_equal(leak, np.full((601, 801), 3.5, np.float32))


def test_the_sky_s_gradient_is_relative_per_degree() -> None:
    lens = optics()
    flat, sloped = (
        drawn(glow(**SKY | {"gradient_per_deg": g}), lens) for g in ((0, 0), (0.02, -0.01))
    )
    right_deg = np.degrees(np.arctan(300 / lens.camera.focal_px))
    down_deg = np.degrees(np.arctan(200 / lens.camera.focal_px))
    assert sloped[300, 700] / flat[300, 700] == pytest.approx(1 + 0.02 * right_deg, rel=1e-3)
    assert sloped[500, 400] / flat[500, 400] == pytest.approx(1 - 0.01 * down_deg, rel=1e-3)
    steep = drawn(glow(**SKY | {"gradient_per_deg": (0.2, 0.0)}), lens)
    assert steep.min() == 0  # beyond 5 degrees to the left there is nothing, not less


def vmag_arcsec2(nanolamberts: float) -> float:
    """Inverse of KS91 eq. 1."""
    return (20.7233 - np.log(nanolamberts / 34.08)) / 0.92104


def masses(*zenith_deg: float) -> np.ndarray:
    return diffuse_air_mass(np.radians(zenith_deg))


def test_moonlight_is_as_bright_as_published() -> None:
    """specsim 0.14's krisciunas_schaefer(20 deg, 70 deg, 50 deg, 0.25, 0.15): 19.855 mag arcsec^-2."""
    value = moonlight_nl(50.0, 45.0, 0.15, *masses(70.0, 20.0))
    assert vmag_arcsec2(float(value)) == pytest.approx(19.855, abs=5e-4)


def test_nanolamberts_convert_to_magnitudes() -> None:
    # 0.92104 = 0.4 ln 10 to five figures, so that a 20th magnitude is 2e-5 off by its rounding.
    assert vmag_arcsec2(NANOLAMBERT_V0 * 10 ** (-0.4 * 20.0)) == pytest.approx(20.0, abs=1e-3)


def test_the_half_moon_is_2_6_magnitudes_below_the_full_moon() -> None:
    """By hand: 0.026 x 90 + 4e-9 x 90^4 = 2.602."""
    full, half = (
        float(moonlight_nl(60.0, phase, 0.172, *masses(45.0, 30.0))) for phase in (0.0, 90.0)
    )
    assert 2.5 * np.log10(full / half) == pytest.approx(2.602, abs=5e-4)


def test_scattered_moonlight_decreases_to_90_degrees_and_vanishes_without_air() -> None:
    rho = np.linspace(0.3, 90, 2000)
    assert (np.diff(moonlight_nl(rho, 10.0, 0.172, *masses(45.0, 30.0))) < 0).all()
    assert not moonlight_nl(rho, 10.0, 0.0, *masses(45.0, 30.0)).any()
    # No step where the laws change.
    assert np.abs(np.diff(np.log(scattering(rho)))[rho[1:] > 5]).max() < 0.02
    # 1 / rho^2 and a little Rayleigh.
    assert scattering(2.0) / scattering(4.0) == pytest.approx(4, rel=0.1)
    assert scattering(0.0) == scattering(0.26)


@pytest.mark.compiles
def test_moonlight_on_the_frame_comes_from_the_moon_s_side() -> None:
    """The Moon 25 degrees to the right of the boresight, just outside of the frame; separations by dot products."""
    lens = optics()
    moon_cam = np.array([np.sin(np.radians(25.0)), 0, np.cos(np.radians(25.0))])
    place = dict(zip(("ra_deg", "dec_deg"), lab_place(25.0), strict=True))
    lit = drawn(glow(**MOON | place), lens)
    even = drawn(glow(**SKY), lens)
    ratio = lit / even
    column = np.array([100, 400, 700])
    toward = np.column_stack([(column - 400) / lens.camera.focal_px, np.zeros(3), np.ones(3)])
    separation = np.degrees(np.arccos(toward @ moon_cam / np.linalg.norm(toward, axis=1)))
    wanted = moonlight_nl(separation, 20.0, 0.172, *masses(50.0, 20.0)) / (
        NANOLAMBERT_V0 * 10 ** (-0.4 * 21.0)
    )
    np.testing.assert_allclose(ratio[300, column], wanted, rtol=1e-3)
    assert ratio[300, 700] > 1.2 * ratio[300, 100]


def test_the_sun_s_stray_light_matches_its_transmittance() -> None:
    """Irradiance by Planck: 5772 K over the solar disk's 6.794e-5 sr, 400-1000 nm, with an efficiency of one half."""
    ra_deg, dec_deg = lab_place(110.0)
    sun = glow(
        kind="stray", ra_deg=ra_deg, dec_deg=dec_deg, angle_deg=(40, 180), pst=(1e-4, 1e-12)
    )
    wavelength = np.linspace(400e-9, 1000e-9, 6001)
    photons = (
        2
        * 299792458.0
        / wavelength**4
        / np.expm1(0.01438777 / (wavelength * 5772.0))
        * 6.794e-5
    )
    wanted = 0.5 * np.trapezoid(photons, wavelength) * 1e-8 * (5.5e-6) ** 2
    levels = glow_map((sun,), pointed(optics()))
    assert levels.shape == (1, 1)
    assert levels[0, 0] == pytest.approx(wanted, rel=0.05)  # a black body, and V's zero point


def test_transmittance_is_log_linear_and_constant_beyond_its_ends() -> None:
    angle_deg = (10.0, 30.0, 50.0)
    pst = (1e-2, 1e-6, 0.0)
    assert transmittance(20.0, angle_deg, pst) == pytest.approx(1e-4, rel=1e-9)
    assert transmittance(5.0, angle_deg, pst) == pytest.approx(1e-2, rel=1e-9)
    assert transmittance(120.0, angle_deg, pst) < 1e-29


def test_backgrounds_add_and_without_one_the_frame_is_dark() -> None:
    lens = optics()
    parts = (glow(**SKY), glow(**MOON), glow(kind="uniform", e_s=3.0))
    apart = [glow_map((part,), pointed(lens)) for part in parts]
    np.testing.assert_allclose(glow_map(parts, pointed(lens)), sum(apart), rtol=1e-12)
    dark = np.full((601, 801), np.nan, np.float32)
    fill(dark, glow_map((), pointed(lens)), 1.0)
    assert not dark.any()


SLOPED = SKY | {"gradient_per_deg": (0.005, 0.004)}
FAR_MOON = MOON | dict(zip(("ra_deg", "dec_deg"), lab_place(60.0), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("part", [SLOPED, FAR_MOON])
@pytest.mark.parametrize("camera", [{}, BENT, {"focal_length": "3 mm"}])
def test_frames_drawn_between_nodes_are_within_a_thousandth(
    part: dict[str, object], camera: dict[str, object]
) -> None:
    lens = optics(**camera)
    np.testing.assert_allclose(
        drawn(glow(**part), lens)[::4, ::4], whole_map(glow(**part), lens), rtol=1e-3
    )


@pytest.mark.compiles
def test_the_cusp_of_two_stops_is_rounded_off_within_a_node_of_the_axis() -> None:
    lens = optics(vignetting={"kind": "two_stops", "cutoff_deg": 50.0})
    error = np.abs(
        drawn(glow(**SLOPED), lens)[::4, ::4] / whole_map(glow(**SLOPED), lens) - 1
    )
    assert error.max() < 0.02
    y, x = np.indices(error.shape)
    assert error[np.hypot(4 * x - 400, 4 * y - 300) > 200].max() < 1e-3


@pytest.mark.compiles
@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("shape", "nodes"), [((601, 801), (20, 27)), ((97, 33), (2, 3)), ((50, 64), (50, 64))]
)
def test_the_fill_between_nodes_is_bilinear(
    kind: type, shape: tuple[int, int], nodes: tuple[int, int]
) -> None:
    coarse = np.random.default_rng(1).uniform(1, 2, nodes)
    image = np.full(shape, np.nan, kind)
    fill(image, coarse, 0.25)
    axes = [np.linspace(0, size - 1, count) for size, count in zip(shape, nodes, strict=True)]
    places = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    wanted = 0.25 * RegularGridInterpolator(
        axes, coarse, bounds_error=False, fill_value=None
    )(places)
    np.testing.assert_allclose(image, wanted, rtol=1e-6 if kind is np.float32 else 1e-12)


def test_the_fill_of_a_constant_is_exact() -> None:
    image = np.full((30, 40), np.nan, np.float32)
    fill(image, np.full((2, 2), 12.0), 0.5)
    np.testing.assert_array_equal(image, np.full((30, 40), 6.0, np.float32))
