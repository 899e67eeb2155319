"""The lens's transfer functions, the defocus disk and the kernels, against theory and brute force."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import special
from scipy.integrate import simpson
from scipy.signal import fftconvolve

from skysim.camera.psf.kernel import (
    GRID,
    HARMONIC_FLOOR,
    ROUND,
    Kernel,
    PsfModel,
    bandwidth,
    build_kernel,
    pack_table,
    round_kernel,
)
from skysim.camera.psf.otf import (
    EXTENT,
    PSFS,
    airy_unit_px,
    blur_radius_px,
    cell_response,
    field_sigma_px,
)
from skysim.camera.psf.splat import PER_PX
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene.sections.camera import (
    AiryPsfConfig,
    CameraConfig,
    DiskPsfConfig,
    GaussianPsfConfig,
    MeasuredPsfConfig,
    MoffatPsfConfig,
    Psf,
)
from tests.helpers.splatting import add_kernel

INCH_M = 0.0254
PLACES = np.random.default_rng(1).uniform(-0.5, 0.5, (6, 2))


def camera(**own: Any) -> CameraConfig:
    base = {
        "width_px": 1600,
        "height_px": 1200,
        "pixel": "4.2 um",
        "focal_length": "35 mm",
        "f_number": 8.0,
        "detector": {
            "quantum_efficiency": 0.4,
            "full_well_e": 20000,
            "gain_e_dn": 10,
            "bits": 12,
        },
    }
    return CameraConfig.model_validate(base | own)


def draw(image: Kernel, x: float, y: float, size: int) -> Floats:
    patch = np.zeros((size, size))
    add_kernel(patch, 0, size, float(x), float(y), 1.0, image)
    return patch


def profile(image: Kernel, radii: Floats) -> Floats:
    """Profile of the image along the x axis."""
    return np.array(
        [
            draw(image, 0.0, 0.0, 1)[0, 0] if r == 0 else draw(image, -r, 0.0, 1)[0, 0]
            for r in radii
        ]
    )


# --- defocus ---


@pytest.mark.parametrize(
    ("f_number", "diameter_px"), [(1.4, 249), (2.8, 124), (8, 43), (16, 22)]
)
def test_the_blur_of_an_led_with_focus_at_infinity_matches_the_reference(
    f_number: float, diameter_px: float
) -> None:
    lens = camera(f_number=f_number)
    assert 2 * blur_radius_px(lens, 33 * INCH_M) == pytest.approx(diameter_px, abs=0.5)


@pytest.mark.parametrize(("f_number", "blur_um"), [(1.4, 9.4), (8, 1.6)])
def test_the_blur_of_an_led_beyond_the_focus_matches_the_reference(
    f_number: float, blur_um: float
) -> None:
    lens = camera(f_number=f_number, focus="33 in")
    assert 2 * blur_radius_px(lens, 33.287 * INCH_M) * 4.2 == pytest.approx(blur_um, abs=0.05)


def test_the_blur_of_a_star_0_1_mm_out_of_focus_matches_the_reference() -> None:
    """Reference H11: chip 0.1 mm behind the focus of 25 mm f/1.4: 71 um, 7.2 px of 9.9 um."""
    focus_m = 1 / (1 / 0.025 - 1 / 0.0251)
    lens = camera(focal_length="25 mm", f_number=1.4, pixel="9.9 um", focus=f"{focus_m} m")
    assert lens.image_distance_m == pytest.approx(0.0251, abs=1e-9)
    assert 2 * blur_radius_px(lens, math.inf) == pytest.approx(7.2, abs=0.05)


def test_the_blur_is_the_cone_s_section_at_the_chip() -> None:
    """A |v - v0| / v with v from the lens equation, before and behind the focus, and none in it."""
    lens = camera(f_number=2.0, focus="1 m")
    distance = np.array([0.5, 0.9, 1.0, 1.1, 30.0, math.inf])
    v = 1 / (1 / lens.focal_length_m - 1 / distance)
    wanted = lens.pupil_m * np.abs(v - lens.image_distance_m) / v / 2 / lens.pixel_m
    np.testing.assert_allclose(blur_radius_px(lens, distance), wanted, rtol=1e-10, atol=1e-9)
    assert blur_radius_px(lens, 1.0) == pytest.approx(0, abs=1e-12)


def test_the_field_blur_grows_from_the_center_to_the_far_corner() -> None:
    psf = {"kind": "gaussian", "corner_sigma_px": 1.5}
    lens = camera(principal_point_px=[500.0, 700.0], psf=psf)
    corner = np.array([1599.5, -0.5])  # the farthest of the four
    at = np.array([[500.0, 700.0], (corner + np.array([500, 700])) / 2, corner])
    np.testing.assert_allclose(field_sigma_px(lens, at), [0, 0.75, 1.5], rtol=0, atol=1e-12)


# --- transfer functions ---

KINDS: dict[str, Psf] = {
    "gaussian": GaussianPsfConfig(sigma_px=0.8),
    "moffat": MoffatPsfConfig(kind="moffat", fwhm_px=2.0, beta=4.0),
    "airy": AiryPsfConfig(kind="airy"),
    "disk": DiskPsfConfig(kind="disk", radius_px=3.0, sigma_px=0.6),
}


def density(psf: Psf, r: Floats) -> Floats:
    """Textbook profiles, not normalized."""
    x = np.maximum(np.pi * r / airy_unit_px(KINDS["airy"], camera()), 1e-9)  # type: ignore[arg-type]
    alpha = 1 / np.sqrt(2**0.25 - 1)
    laws: dict[str, Floats] = {
        "gaussian": np.exp(-(r**2) / (2 * 0.8**2)),
        "moffat": (1 + (r / alpha) ** 2) ** -4.0,
        "airy": (2 * special.j1(x) / x) ** 2,
    }
    return laws[psf.kind]


@pytest.mark.parametrize("kind", ["gaussian", "moffat", "airy"])
def test_a_transfer_function_is_the_hankel_transform_of_its_profile(kind: str) -> None:
    """Integrated numerically to 400 px; what Airy's rings hold beyond is 2 / (pi x) = 0.05 %."""
    r: Floats = (np.arange(400_000, dtype=np.float64) + 0.5) * 1e-3
    f = np.array([0.05, 0.2, 0.5, 0.8])
    weight = r * density(KINDS[kind], r)
    wanted = np.array([weight @ special.j0(2 * np.pi * at * r) for at in f]) / weight.sum()
    made = PSFS[kind](KINDS[kind], camera(), f * 0.6, f * 0.8)
    np.testing.assert_allclose(made, wanted, rtol=0, atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_passes_all_light_and_has_an_extent(kind: str) -> None:
    assert KINDS[kind].kind == kind
    assert PSFS[kind](KINDS[kind], camera(), np.zeros(1), np.zeros(1)) == pytest.approx(
        1, abs=1e-9
    )
    radius, sigma = EXTENT[kind](KINDS[kind], camera())
    assert radius + 3 * sigma > 1


def test_every_lens_kind_of_the_schema_is_implemented() -> None:
    assert set(PSFS) == set(EXTENT) == {*KINDS, "measured"}


def test_diffraction_uses_the_working_f_number() -> None:
    """Focused near, the cone is slower: v / A = N v / f; a cutoff of 1 / (lambda N) at infinity."""
    psf = AiryPsfConfig(kind="airy")
    assert airy_unit_px(psf, camera()) == pytest.approx(0.55 * 8 / 4.2, rel=1e-12)
    near = camera(focus="33 in")
    assert airy_unit_px(psf, near) == pytest.approx(
        0.55 * 8 / 4.2 * near.image_distance_m / 0.035, rel=1e-12
    )


# --- images ---


def test_airy_s_first_dark_ring_encloses_the_textbook_s_light() -> None:
    """1.22 lambda N, and 83.8 % of the light (Born & Wolf 8.5), on pixels so small that they blur nothing."""
    lens = camera(pixel="0.4 um")
    psf = AiryPsfConfig(kind="airy")
    image = build_kernel(psf, lens)
    unit = 0.55 * 8 / 0.4
    radii = np.linspace(0.9, 1.6, 281) * unit
    assert radii[np.argmin(profile(image, radii))] == pytest.approx(
        1.2197 * unit, abs=0.005 * unit
    )
    size = 2 * math.ceil(image.reach_px) + 1
    y, x = np.indices((size, size)) - size // 2
    inside = draw(image, size // 2, size // 2, size)[np.hypot(x, y) <= 1.2197 * unit].sum()
    # Mean light beyond the reach, put back into the image.
    beyond = 2 / (np.pi**2) * unit / image.reach_px
    assert inside * (1 - beyond) == pytest.approx(0.838, abs=0.004)


@pytest.mark.parametrize("pixel_um", [0.2, 0.4, 0.55, 1.0, 4.2, 30.0])
def test_airy_s_light_beyond_its_reach_is_a_fortieth_at_most(pixel_um: float) -> None:
    """On average over its rings 2 / (pi z) of the light is farther than z = pi r / (lambda N) (Born & Wolf 8.5)."""
    psf = AiryPsfConfig(kind="airy")
    lens = camera(pixel=f"{pixel_um} um")
    reach_px, _ = EXTENT["airy"](psf, lens)
    assert 2 / np.pi**2 * airy_unit_px(psf, lens) / reach_px < 0.0254


def test_a_table_has_the_harmonics_above_the_floor() -> None:
    profile_0 = np.exp(-((np.arange(300) / PER_PX) ** 2))
    for fraction, columns in ((0.9, 3), (1.1, 5)):
        weak = [fraction * HARMONIC_FLOOR, 0.1 * HARMONIC_FLOOR]
        assert pack_table(np.outer([1, *weak], profile_0)).shape == (301, columns)


def test_moffat_s_full_width_at_half_maximum_matches_its_formula() -> None:
    image = build_kernel(MoffatPsfConfig(kind="moffat", fwhm_px=24.0, beta=3.0), camera())
    center, half, out = profile(image, np.array([0.0, 12.0, 36.0]))
    # The pixel widens it by 1/12 px^2 of some 100.
    assert half / center == pytest.approx(0.5, abs=1e-3)
    assert out / center == pytest.approx((1 + 9 * (2 ** (1 / 3) - 1)) ** -3, abs=1e-3)


def brute(parts: list[Floats], fine: int, x: float, y: float, size: int) -> Floats:
    """Convolved on a grid of 1 / fine px by SciPy and summed into pixels; x and y are whole grid steps."""
    image = parts[0]
    for part in parts[1:]:
        image = fftconvolve(image, part, mode="same")
    shifted = np.roll(image, (round(y * fine), round(x * fine)), axis=(0, 1))
    pixels = shifted.reshape(size, fine, size, fine).sum(axis=(1, 3))
    return pixels / pixels.sum()


def fine_grid(size: int, fine: int) -> tuple[Floats, Floats]:
    """Positions of the fine grid's cells relative to its center cell."""
    at = (np.arange(size * fine) - (size * fine) // 2) / fine
    return np.meshgrid(at, at)


def covered_disk(radius: float, size: int, fine: int) -> Floats:
    """A uniform disk by the share of each cell that it covers, 8 x 8 points a cell."""
    x, y = fine_grid(size, fine)
    dots = (np.arange(8) - 3.5) / 8 / fine
    return np.asarray(sum(np.hypot(x + u, y + v) <= radius for u in dots for v in dots)) / 64


@pytest.mark.slow
@pytest.mark.parametrize("radii", [(4.3, 2.6), (3.0, 0.0), (6.0, 1.37)])
@pytest.mark.parametrize("sigma_px", [0.25, 0.7])
def test_images_of_disks_match_brute_force(
    radii: tuple[float, float], sigma_px: float
) -> None:
    """Emitter x defocus x Gaussian x pixel, summed on a grid of 1/21 px, within 5e-4 of the peak."""
    # odd: the middle cell is in the middle of the middle pixel
    size = 25
    fine = 21
    grid_x, grid_y = fine_grid(size, fine)
    parts = [np.exp(-(grid_x**2 + grid_y**2) / (2 * sigma_px**2))]
    parts += [covered_disk(radius, size, fine) for radius in radii if radius]
    image = build_kernel(GaussianPsfConfig(sigma_px=sigma_px), camera(), 0, *radii)
    for x, y in ((0, 0), (8 / 21, -3 / 21), (-10 / 21, 10 / 21)):
        wanted = brute(parts, fine, x, y, size)
        made = draw(image, size // 2 + x, size // 2 + y, size)
        np.testing.assert_allclose(made, wanted, rtol=0, atol=5e-4 * wanted.max())


def test_blurs_add_in_quadrature() -> None:
    lens = camera()
    half = 12
    apart = build_kernel(
        DiskPsfConfig(kind="disk", radius_px=3.0, sigma_px=0.3), lens, extra_sigma_px=0.4
    )
    together = build_kernel(DiskPsfConfig(kind="disk", radius_px=3.0, sigma_px=0.5), lens)
    emitter = build_kernel(GaussianPsfConfig(sigma_px=0.3), lens, 0.4, 3.0)
    for x, y in PLACES + half:
        wanted = draw(together, x, y, 25)
        for image in (apart, emitter):
            np.testing.assert_allclose(
                draw(image, x, y, 25), wanted, rtol=0, atol=1e-5 * wanted.max()
            )


def test_nearly_equal_sizes_share_a_kernel() -> None:
    lens = camera()
    psf = GaussianPsfConfig(sigma_px=0.7)
    assert build_kernel(psf, lens, 0.1, 5.001, 2.0) is build_kernel(
        psf, lens, 0.1, 5.004, 2.0
    )
    assert build_kernel(psf, lens, 0.1, 5.001, 2.0) is not build_kernel(
        psf, lens, 0.1, 5.02, 2.0
    )


@pytest.mark.long
def test_sharp_images_use_a_grid_and_blurred_ones_tables() -> None:
    lens = camera(f_number=1.4, pixel="9.9 um")
    assert round_kernel(PsfModel(AiryPsfConfig(kind="airy"), lens, 0.0, ())) is None
    assert build_kernel(AiryPsfConfig(kind="airy"), lens).kind == GRID
    assert build_kernel(AiryPsfConfig(kind="airy", sigma_px=0.6), lens).kind == ROUND


# --- a measured lens ---


def cells(tmp_path: Path, table: Floats, name: str = "psf.csv") -> str:
    path = tmp_path / name
    np.savetxt(path, table, delimiter=",")
    return str(path)


def gaussian_cells(
    sigma_px: float, oversampling: int, half_px: int, x: float = 0.0, y: float = 0.0
) -> Floats:
    """The light of a Gaussian on cells of 1 / oversampling px."""
    edges = np.linspace(-half_px, half_px, 2 * half_px * oversampling + 1)
    across, down = (
        np.diff(special.erf((edges - at) / (sigma_px * np.sqrt(2)))) / 2 for at in (x, y)
    )
    return np.outer(down, across)


@pytest.mark.parametrize(("sigma_px", "oversampling"), [(0.7, 8), (1.0, 6)])
def test_a_measured_gaussian_is_that_gaussian(
    tmp_path: Path, sigma_px: float, oversampling: int
) -> None:
    psf = MeasuredPsfConfig(
        kind="measured",
        file=cells(tmp_path, gaussian_cells(sigma_px, oversampling, 7)),
        oversampling=oversampling,
    )
    image = build_kernel(psf, camera())
    wanted = build_kernel(GaussianPsfConfig(sigma_px=sigma_px), camera())
    for x, y in PLACES + 10:
        peak = draw(wanted, x, y, 21)
        np.testing.assert_allclose(
            draw(image, x, y, 21), peak, rtol=0, atol=5e-4 * peak.max()
        )
    # As few sub-pixel positions, in powers of two, as are more than seven times the highest frequency.
    assert (
        7 * bandwidth(PsfModel(psf, camera(), 0.0, ()), 1e-3)
        < len(image.table) - 3
        <= 14 * bandwidth(PsfModel(psf, camera(), 0.0, ()), 1e-3)
    )


def test_a_star_measured_in_whole_pixels_reproduces_its_image(tmp_path: Path) -> None:
    """Oversampling 1: the image itself where it was measured, centered on its center of gravity."""
    table = np.array(
        [
            [0, 1, 1, 0, 0],
            [1, 6, 9, 2, 0],
            [1, 9, 20, 8, 1],
            [0, 3, 7, 4, 1],
            [0, 0, 1, 1, 0.0],
        ]
    )
    table /= table.sum()
    x = table.sum(axis=0) @ np.arange(5)
    y = table.sum(axis=1) @ np.arange(5)
    image = build_kernel(
        MeasuredPsfConfig(kind="measured", file=cells(tmp_path, table)), camera()
    )
    patch = draw(image, 10 + x, 10 + y, 25)
    np.testing.assert_allclose(patch[10:15, 10:15], table, rtol=0, atol=5e-3 * table.max())
    assert patch.sum() == pytest.approx(1, abs=1e-5)


def test_a_measured_image_keeps_its_handedness_and_its_center(tmp_path: Path) -> None:
    """A core and a fainter blob to its lower right, drawn with its center of gravity at (x, y)."""
    table = gaussian_cells(0.8, 4, 8) + 0.25 * gaussian_cells(0.8, 4, 8, x=3.0, y=2.0)
    psf = MeasuredPsfConfig(kind="measured", file=cells(tmp_path, table), oversampling=4)
    index = np.arange(41)
    for x, y in PLACES + 20:
        patch = draw(build_kernel(psf, camera()), x, y, 41)
        np.testing.assert_allclose(
            [(patch @ index).sum(), (index @ patch).sum()], [x, y], rtol=0, atol=2e-3
        )
        third = (
            ((index - x) ** 3) @ patch.sum(axis=0),
            ((index - y) ** 3) @ patch.sum(axis=1),
        )
        assert third[0] > third[1] > 0.5


def test_mirroring_a_measured_lens_mirrors_its_image(tmp_path: Path) -> None:
    table = gaussian_cells(0.8, 4, 8) + 0.25 * gaussian_cells(0.8, 4, 8, x=3.0, y=2.0)
    there, back = (
        build_kernel(
            MeasuredPsfConfig(kind="measured", file=cells(tmp_path, t, name), oversampling=4),
            camera(),
            0,
            2.0,
        )
        for t, name in ((table, "a.csv"), (table[:, ::-1], "b.csv"))
    )
    for x, y in PLACES + 20:
        wanted = draw(there, x, y, 41)[:, ::-1]
        np.testing.assert_allclose(
            draw(back, 40 - x, y, 41), wanted, rtol=0, atol=1e-5 * wanted.max()
        )


def test_interpolation_of_cells_uses_keys_s_cubic() -> None:
    """Its transform, integrated from the cubic pieces; 1 at rest, 0 at whole cycles a cell."""
    t = np.linspace(-2, 2, 40_001)
    s = np.abs(t)
    pieces = np.where(
        s < 1, 1.5 * s**3 - 2.5 * s**2 + 1, -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2
    )
    u = np.array([0.0, 0.1, 0.5, 0.9, 1.3, 2.4])
    wanted = np.array([np.trapezoid(pieces * np.cos(2 * np.pi * at * t), t) for at in u])
    np.testing.assert_allclose(cell_response(u) * np.sinc(u), wanted, rtol=0, atol=1e-7)
    np.testing.assert_allclose(cell_response(np.array([1.0, 2.0, 3.0])), 0, rtol=0, atol=1e-9)


def test_a_measured_lens_is_read_from_fits_and_png_too(tmp_path: Path) -> None:
    import cv2
    from astropy.io import fits

    table = np.round(
        gaussian_cells(0.8, 4, 5) / gaussian_cells(0.8, 4, 5).max() * 60000
    ).astype(np.uint16)
    fits.PrimaryHDU(table).writeto(tmp_path / "psf.fits")
    cv2.imwrite(str(tmp_path / "psf.png"), table)
    files = [
        cells(tmp_path, table.astype(float)),
        str(tmp_path / "psf.fits"),
        str(tmp_path / "psf.png"),
    ]
    csv, *others = (
        draw(
            build_kernel(
                MeasuredPsfConfig(kind="measured", file=file, oversampling=4), camera()
            ),
            10.2,
            9.9,
            21,
        )
        for file in files
    )
    for other in others:
        np.testing.assert_allclose(other, csv, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("absent.csv", None, "absent.csv"),
        ("words.csv", "1,2,3\n4,five,6\n7,8,9\n", "five"),
        ("oblong.csv", "1,2,3\n4,5,6\n", "line 1: 3 values; allowed: 2"),
        ("dark.csv", "0,0,0\n0,0,0\n0,0,0\n", "add up to 0; allowed"),
        ("negative.csv", "0,0,0\n0,-1,0\n0,0,0\n", "add up to -1; allowed"),
        ("hole.csv", "1,2,3\n4,nan,6\n7,8,9\n", "line 2: 'nan' is not a finite number"),
        ("cut.fits", "SIMPLE  =", "not a complete FITS file"),
        ("cut.png", "no picture", "cannot be decoded"),
        ("psf.docx", "x", "unknown image suffix"),
    ],
)
def test_a_file_that_is_not_a_psf_is_refused_in_one_line(
    tmp_path: Path, name: str, text: str | None, said: str
) -> None:
    path = tmp_path / name
    written = [path.write_text(line) for line in ([] if text is None else [text])]
    assert len(written) == (text is not None)
    with pytest.raises(InputError) as caught:
        build_kernel(MeasuredPsfConfig(kind="measured", file=str(path)), camera())
    message = str(caught.value)
    assert message.startswith("camera.psf.file: ")
    assert said in message
    assert "\n" not in message


# The response within a pixel.


@pytest.mark.parametrize("sigma_px", [0.25, 0.45])
def test_an_image_on_pixels_with_a_response_is_its_integral(sigma_px: float) -> None:
    """Each pixel has the integral of the Gaussian times 1 + p cos 2 pi u along x and along y, by Simpson's rule."""
    depth = 0.4
    lens = camera(psf={"kind": "gaussian", "sigma_px": sigma_px})
    chip = lens.detector.model_copy(update={"intrapixel": depth})
    lens = lens.model_copy(update={"detector": chip})
    image = build_kernel(lens.psf, lens)
    u = np.linspace(-0.5, 0.5, 401)
    response = 1 + depth * np.cos(2 * np.pi * u)

    def along(place: float) -> Floats:
        """(9,) integrals over the pixels of one axis."""
        x = np.arange(9)[:, None] + u - place
        gauss = np.exp(-(x**2) / (2 * sigma_px**2)) / (sigma_px * math.sqrt(2 * np.pi))
        return simpson(gauss * response, u, axis=1)

    for dx, dy in PLACES:
        expected = np.outer(along(4 + dy), along(4 + dx))
        drawn = draw(image, 4 + dx, 4 + dy, 9)
        np.testing.assert_allclose(drawn, expected, atol=1e-3)


# Coma.


@pytest.mark.parametrize("direction_deg", [0.0, 30.0, 250.0])
def test_coma_is_where_rays_through_the_pupil_end(direction_deg: float) -> None:
    """Rays of an even grid over the pupil, displaced by Seidel's law, blurred and summed over the pixels."""
    sigma_px = 0.6
    size_px = 2.0
    angle = math.radians(direction_deg)
    axis = np.array([math.cos(angle), math.sin(angle)])
    lens = camera(psf={"kind": "gaussian", "sigma_px": sigma_px})
    image = draw(build_kernel(lens.psf, lens, coma_px=tuple(size_px * axis)), 8.0, 8.0, 17)
    side = np.linspace(-1, 1, 201)
    px, py = (one.ravel() for one in np.meshgrid(side, side))
    inside = px**2 + py**2 <= 1
    radius2 = (px**2 + py**2)[inside]
    turn = np.arctan2(py, px)[inside]
    along = size_px * (radius2 * (2 + np.cos(2 * turn)) - 1)
    across = size_px * radius2 * np.sin(2 * turn)
    x = 8 + along * axis[0] - across * axis[1]
    y = 8 + along * axis[1] + across * axis[0]
    edges = np.arange(18) - 0.5

    def shares(places: Floats) -> Floats:
        """(rays, 17) shares of Gaussians in the pixels of one axis."""
        return np.diff(special.ndtr((edges - places[:, None]) / sigma_px), axis=1)

    expected = np.einsum("ni,nj->ij", shares(y), shares(x)) / len(x)
    np.testing.assert_allclose(image, expected, atol=2e-3)
    # The center of light stays, and the flare points outward, away from the bright tip.
    pixels = np.arange(17)
    center = np.array([image.sum(axis=0) @ pixels, image.sum(axis=1) @ pixels])
    np.testing.assert_allclose(center / image.sum(), 8, atol=0.02)
    tip = np.array(np.unravel_index(image.argmax(), image.shape))[::-1] - 8
    assert tip @ axis < 0
