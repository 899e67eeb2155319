"""Images against GalSim's, kind by kind: pixel-integrated, at random sub-pixel places, within 5e-4 of the peak."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skysim.camera.psf.kernel import Kernel, build_kernel
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

galsim = pytest.importorskip("galsim")

CAMERA = CameraConfig.model_validate(
    {
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
)
FAST = CAMERA.model_copy(update={"f_number": 1.4, "pixel_m": 9.9e-6})  # lambda N is 0.08 px
ACCURATE = galsim.GSParams(
    folding_threshold=1e-3,
    maxk_threshold=1e-4,
    kvalue_accuracy=1e-6,
    xvalue_accuracy=1e-6,
    maximum_fft_size=8192,
)


def gaussian(sigma_px: float) -> tuple[Psf, CameraConfig, list[Any]]:
    return (
        GaussianPsfConfig(sigma_px=sigma_px),
        CAMERA,
        [galsim.Gaussian(sigma=sigma_px, gsparams=ACCURATE)],
    )


def moffat(fwhm_px: float, beta: float) -> tuple[Psf, CameraConfig, list[Any]]:
    theirs = galsim.Moffat(beta=beta, fwhm=fwhm_px, gsparams=ACCURATE)
    return MoffatPsfConfig(kind="moffat", fwhm_px=fwhm_px, beta=beta), CAMERA, [theirs]


def airy(sigma_px: float, camera: CameraConfig) -> tuple[Psf, CameraConfig, list[Any]]:
    unit_px = 550e-9 * camera.f_number / camera.pixel_m
    theirs = [galsim.Airy(lam_over_diam=unit_px, gsparams=ACCURATE)]
    theirs += [galsim.Gaussian(sigma=sigma_px, gsparams=ACCURATE)] if sigma_px else []
    return AiryPsfConfig(kind="airy", sigma_px=sigma_px), camera, theirs


def disk(radius_px: float, sigma_px: float) -> tuple[Psf, CameraConfig, list[Any]]:
    theirs = [
        galsim.TopHat(radius_px, gsparams=ACCURATE),
        galsim.Gaussian(sigma=sigma_px, gsparams=ACCURATE),
    ]
    return DiskPsfConfig(kind="disk", radius_px=radius_px, sigma_px=sigma_px), CAMERA, theirs


LENSES = {
    "gaussian 0.2": gaussian(0.2),
    "gaussian 0.7": gaussian(0.7),
    "moffat 0.5": moffat(0.5, 3.0),
    "moffat 1.5": moffat(1.5, 2.5),
    "moffat 2": moffat(2.0, 5.0),
    "airy f/8": airy(0.0, CAMERA),
    "airy f/8, 0.3": airy(0.3, CAMERA),
    "airy f/1.4": airy(0.0, FAST),
    "airy f/1.4, 0.3": airy(0.3, FAST),
    "disk 0.2": disk(3.0, 0.2),
    "disk 0.7": disk(6.5, 0.7),
}


# A wide disk's edge 0.08 px sharp has a twelfth harmonic, which the radial tables leave out.
TOLERANCE = {("airy f/1.4", 4.3): 2e-3}


def theirs_px(parts: list[Any], x: float, y: float, size: int) -> Floats:
    whole = parts[0] if len(parts) == 1 else galsim.Convolve(parts, gsparams=ACCURATE)
    image = galsim.ImageD(size, size)
    whole.drawImage(
        image, scale=1, offset=(x - (size - 1) / 2, y - (size - 1) / 2), method="auto"
    )
    return np.asarray(image.array)


def ours_px(image: Kernel, x: float, y: float, size: int) -> Floats:
    patch = np.zeros((size, size))
    add_kernel(patch, 0, size, float(x), float(y), 1.0, image)
    return patch


def worst(image: Kernel, parts: list[Any], seed: int) -> float:
    """The largest difference over the peak, of images of the same light in a circle within the reach.

    Infinite wings are cut and their light restored, so GalSim's image is scaled to the same light in the circle.
    """
    size = 2 * int(np.ceil(image.reach_px)) + 3
    row, column = np.indices((size, size))
    differences = []
    for x, y in np.random.default_rng(seed).uniform(-0.5, 0.5, (2, 2)) + size // 2:
        circle = np.hypot(column - x, row - y) < max(image.reach_px - 2.5, image.reach_px / 2)
        a = ours_px(image, x, y, size)
        b = theirs_px(parts, x, y, size)
        b *= a[circle].sum() / b[circle].sum()
        differences.append(np.abs(a - b).max() / b.max())
    return float(max(differences))


@pytest.mark.parametrize("radius_px", [0.0, 1.2, 4.3])
@pytest.mark.parametrize("name", LENSES)
def test_every_kind_of_lens_images_a_disk_as_galsim(name: str, radius_px: float) -> None:
    psf, camera, parts = LENSES[name]
    emitter = [galsim.TopHat(radius_px, gsparams=ACCURATE)] if radius_px else []
    error = worst(
        build_kernel(psf, camera, 0, radius_px),
        [*parts, *emitter],
        seed=round(10 * radius_px),
    )
    assert error < TOLERANCE.get((name, radius_px), 5e-4)


def test_emitter_and_defocus_combine_as_in_galsim() -> None:
    psf, camera, parts = LENSES["gaussian 0.7"]
    disks = [galsim.TopHat(radius, gsparams=ACCURATE) for radius in (10.0, 3.5)]
    assert worst(build_kernel(psf, camera, 0, 10.0, 3.5), [*parts, *disks], seed=5) < 5e-4


def test_restored_wings_equal_the_missing_light() -> None:
    """Unscaled, an Airy image is brighter than the whole one by the light beyond its reach: 2 / (pi z)."""
    psf, camera, parts = LENSES["airy f/8"]
    image = build_kernel(psf, camera)
    size = 2 * int(np.ceil(image.reach_px)) + 3
    ratio = ours_px(image, 20.0, 20.0, size).max() / theirs_px(parts, 20.0, 20.0, size).max()
    z = np.pi * (image.reach_px - 1) / (550e-9 * 8 / 4.2e-6)
    assert ratio - 1 == pytest.approx(2 / (np.pi * z), rel=0.2)


@pytest.mark.parametrize("radius_px", [0.0, 4.3])
def test_a_measured_asymmetric_lens_images_as_galsim(
    tmp_path: Path, radius_px: float
) -> None:
    """GalSim draws the cells of a lopsided lens; our image of them against its image of the lens itself."""
    core = galsim.Gaussian(sigma=0.8, gsparams=ACCURATE).shear(g1=0.2, g2=0.1)
    lens = core + 0.3 * galsim.Gaussian(sigma=1.1, gsparams=ACCURATE).shift(1.5, 0.8)
    lens = lens.shift(-lens.centroid).withFlux(1)
    table = lens.drawImage(galsim.ImageD(144, 144), scale=1 / 8, method="auto").array
    np.savetxt(tmp_path / "psf.csv", table, delimiter=",")
    psf = MeasuredPsfConfig(kind="measured", file=str(tmp_path / "psf.csv"), oversampling=8)
    emitter = [galsim.TopHat(radius_px, gsparams=ACCURATE)] if radius_px else []
    assert worst(build_kernel(psf, CAMERA, 0, radius_px), [lens, *emitter], seed=7) < 5e-4
