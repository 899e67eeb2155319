"""Drawing of kernels: light, position and rows at sub-pixel offsets, against error functions and moments."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

from skysim.camera.psf import splat
from skysim.camera.psf.kernel import (
    GAUSS,
    GRID,
    ROUND,
    Kernel,
    PsfModel,
    build_kernel,
    grid_kernel,
    round_kernel,
)
from skysim.core.types import Floats
from skysim.scene.sections.camera import CameraConfig, GaussianPsfConfig, MoffatPsfConfig, Psf
from tests.helpers.splatting import add_kernel

CAMERA = CameraConfig.model_validate(
    {
        "width_px": 659,
        "height_px": 493,
        "pixel": "9.9 um",
        "focal_length": "25 mm",
        "f_number": 1.4,
        "detector": {
            "quantum_efficiency": 0.4,
            "full_well_e": 40000,
            "gain_e_dn": 10,
            "bits": 12,
        },
    }
)
SIZE = 61
MIDDLE = 30
PLACES = np.random.default_rng(1).uniform(-0.5, 0.5, (12, 2)) + MIDDLE


def gaussian(sigma_px: float) -> Psf:
    return GaussianPsfConfig(sigma_px=sigma_px)


def draw(
    image: Kernel,
    x: float,
    y: float,
    rows: tuple[int, int] = (0, SIZE),
    electrons: float = 1.0,
) -> Floats:
    patch = np.zeros((SIZE, SIZE))
    add_kernel(patch, *rows, float(x), float(y), electrons, image)
    return patch


def exact_gaussian(x: float, y: float, sigma_px: float) -> Floats:
    """SciPy's error function, pixel by pixel."""
    edges = np.arange(SIZE + 1) - 0.5
    across, down = (np.diff(erf((edges - at) / (sigma_px * np.sqrt(2)))) / 2 for at in (x, y))
    return np.outer(down, across)


# One of each way of drawing, all of a blur at which the pixels' own aliasing (exp(-2 pi^2 sigma^2)) is below 1e-5.
KERNELS = {
    "gaussian": build_kernel(gaussian(0.8), CAMERA),
    "T0": build_kernel(gaussian(2.0), CAMERA, 0, 6),
    "T0, T4": build_kernel(gaussian(0.8), CAMERA, 0, 6),
    "T0 to T8": build_kernel(gaussian(0.25), CAMERA, 0, 3),
    "grid": grid_kernel(PsfModel(gaussian(0.8), CAMERA, 0.0, (3.0,))),
}
every_kernel = pytest.mark.parametrize("image", KERNELS.values(), ids=KERNELS)


def test_the_test_kernels_cover_every_kind() -> None:
    kinds = [(k.kind, k.table.shape[1] if k.kind == ROUND else 0) for k in KERNELS.values()]
    assert kinds == [(GAUSS, 0), (ROUND, 3), (ROUND, 5), (ROUND, 7), (GRID, 0)]


@every_kernel
def test_light_is_conserved_at_any_subpixel_position(image: Kernel) -> None:
    totals = [draw(image, x, y).sum() for x, y in PLACES]
    np.testing.assert_allclose(totals, 1, rtol=0, atol=1e-5)


@every_kernel
def test_the_image_s_centroid_is_at_its_requested_position(image: Kernel) -> None:
    # 2e-3: the S-curve of the sharpest of them, sigma 0.3 px and a disk of 3 px; the others are below 1e-4.
    index = np.arange(SIZE)
    for x, y in PLACES:
        patch = draw(image, x, y)
        np.testing.assert_allclose(
            [(patch @ index).sum(), (index @ patch).sum()],
            [x, y],
            rtol=0,
            atol=2e-3 + 1e-5 * MIDDLE,
        )


@every_kernel
def test_ranges_of_rows_add_up_to_the_whole(image: Kernel) -> None:
    x, y = PLACES[0]
    parts = [
        draw(image, x, y, rows) for rows in ((-5, 11), (11, 27), (27, 28), (28, 28), (28, 99))
    ]
    np.testing.assert_allclose(sum(parts), draw(image, x, y), rtol=1e-12, atol=0)
    assert not parts[1][:11].any()
    assert not parts[1][27:].any()
    assert not parts[3].any()


@every_kernel
def test_mirrored_places_give_mirrored_images(image: Kernel) -> None:
    x, y = PLACES[1]
    patch = draw(image, x, y)
    tolerance = 1e-6 * patch.max()  # single precision
    np.testing.assert_allclose(
        draw(image, SIZE - 1 - x, y), patch[:, ::-1], rtol=0, atol=tolerance
    )
    np.testing.assert_allclose(
        draw(image, x, SIZE - 1 - y), patch[::-1], rtol=0, atol=tolerance
    )
    np.testing.assert_allclose(draw(image, y, x), patch.T, rtol=0, atol=tolerance)


@every_kernel
@pytest.mark.parametrize(
    "place", [(-3.3, 20.2), (20.2, -3.3), (62.7, 61.4), (0.0, 0.0), (-1e6, 5.0), (5.0, 1e6)]
)
def test_light_beyond_the_patch_is_left_out(
    image: Kernel, place: tuple[float, float]
) -> None:
    x, y = place
    wide = np.zeros((SIZE + 80, SIZE + 80))
    add_kernel(wide, 0, len(wide), x + 40, y + 40, 1.0, image)
    np.testing.assert_allclose(
        draw(image, x, y),
        wide[40:-40, 40:-40],
        rtol=0,
        atol=1e-6 * KERNELS["grid"].peak,
    )


@every_kernel
def test_light_is_added_in_proportion_and_none_of_it_is_negative(image: Kernel) -> None:
    x, y = PLACES[2]
    one = draw(image, x, y)
    assert one.min() >= -1e-8 * one.max()
    np.testing.assert_allclose(
        draw(image, x, y, electrons=2e5), 2e5 * one, rtol=1e-6, atol=1e-9
    )


@every_kernel
def test_the_reach_holds_all_of_the_image(image: Kernel) -> None:
    x, y = PLACES[3]
    row, column = np.nonzero(draw(image, x, y))
    assert max(np.abs(column - x).max(), np.abs(row - y).max()) <= image.reach_px + 1e-9


@pytest.mark.parametrize("sigma_px", [0.2, 0.7, 2.0])
def test_a_point_through_a_gaussian_lens_is_exact(sigma_px: float) -> None:
    image = build_kernel(gaussian(sigma_px), CAMERA)
    for x, y in PLACES:
        np.testing.assert_allclose(
            draw(image, x, y), exact_gaussian(x, y, sigma_px), rtol=0, atol=1e-9
        )


@pytest.mark.parametrize("sigma_px", [0.35, 0.5, 0.7, 1.0, 2.0])
@pytest.mark.parametrize("make", [round_kernel, grid_kernel])
def test_tables_give_the_error_function_s_image(make: object, sigma_px: float) -> None:
    # Radial tables end at 5 sigma, where the image has fallen to 4e-6 of its peak.
    image: Kernel = make(PsfModel(gaussian(sigma_px), CAMERA, 0.0, ()))  # type: ignore[operator]
    for x, y in PLACES:
        wanted = exact_gaussian(x, y, sigma_px)
        np.testing.assert_allclose(
            draw(image, x, y), wanted, rtol=0, atol=1e-4 * wanted.max()
        )


@pytest.mark.parametrize(
    ("sigma_px", "radius_px"), [(0.8, 0.0), (0.8, 6.0), (2.0, 6.0), (0.7, 1.5), (1.5, 12.0)]
)
def test_variances_of_lens_disk_and_pixel_add_up(sigma_px: float, radius_px: float) -> None:
    """sigma^2 + a^2 / 4 + 1 / 12 along each axis; the cut at 5 sigma takes 1e-4 of sigma^2."""
    image = build_kernel(gaussian(sigma_px), CAMERA, 0, radius_px)
    wanted = sigma_px**2 + radius_px**2 / 4 + 1 / 12
    index = np.arange(SIZE)
    for x, y in PLACES:
        patch = draw(image, x, y)
        along = [
            (((index - x) ** 2) * patch.sum(axis=0)).sum(),
            (((index - y) ** 2) * patch.sum(axis=1)).sum(),
        ]
        np.testing.assert_allclose(along, wanted, rtol=2e-4, atol=0)


@pytest.mark.parametrize("t", [0.0, 0.25, 0.99])
def test_the_weights_between_places_are_exact_for_cubics(t: float) -> None:
    weights = np.array(splat.cubic(t))
    samples: NDArray[np.float64] = np.array([-1.0, 0.0, 1.0, 2.0])
    for power in range(4):
        assert weights @ samples**power == pytest.approx(t**power, abs=1e-12)


def test_faded_wings_keep_the_total_light_at_any_position() -> None:
    """Power-law wings are faded out, so that the total does not depend on where the image stands."""
    image = build_kernel(MoffatPsfConfig(kind="moffat", fwhm_px=1.5, beta=2.5), CAMERA)
    assert image.reach_px < MIDDLE
    np.testing.assert_allclose(
        [draw(image, x, y).sum() for x, y in PLACES], 1, rtol=0, atol=1e-5
    )
