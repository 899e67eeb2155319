"""Optical transfer functions of lenses, how far they scatter light, and the defocus disk.

The image of a source is a convolution: lens x Gaussian blur x emitter's disk x defocus disk x pixel. At a spatial
frequency (fx, fy) in cycles a pixel its spectrum is the product of their transfer functions (Goodman, Introduction
to Fourier Optics, ch. 6). Those of the lens are in PSFS, by the scene's `camera.psf.kind`;
`skysim.camera.psf.kernel` multiplies them into an image that `skysim.camera.psf.splat` adds to a frame.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy import special

from skysim.core.errors import InputError
from skysim.core.text import cells_of, read_lines, to_numbers
from skysim.core.types import Array, Floats, lengths
from skysim.core.yaml_reader import is_file
from skysim.scene.sections.camera import (
    AiryPsfConfig,
    CameraConfig,
    DiskPsfConfig,
    GaussianPsfConfig,
    MeasuredPsfConfig,
    MoffatPsfConfig,
)

Otf = Array  # real, or complex where the PSF is not symmetric

COMA_NODES = 32  # of the integral over the pupil's area
WING_LEVEL = 1e-5  # power-law wings are cut where they fall below this fraction of the peak


def blur_radius_px(camera: CameraConfig, distance_m: Any, focus_shift_m: Any = 0.0) -> Any:
    """Radius of the defocus disk of a point, in pixels, by the thin lens.

    The cone from a pupil A to the image at v(u) meets the chip at v0 in a disk of diameter A |v - v0| / v =
    A v0 |1/u - 1/u0|, with the distance u0 in focus. This form has no pole and holds for stars (u infinite) as well.

    Parameters
    ----------
    distance_m
        Axial distances u, scalar or array, infinity allowed
    focus_shift_m
        Shift d of the focal length for the light's color, which adds d / f^2 to 1/u - 1/u0
    """
    distance = np.asarray(distance_m, dtype=float)
    color = focus_shift_m / camera.focal_length_m**2
    diameter_m = (
        camera.pupil_m
        * camera.image_distance_m
        * np.abs(1 / distance - 1 / camera.focus_m + color)
    )
    return diameter_m / (2 * camera.pixel_m)


def field_sigma_px(camera: CameraConfig, xy_px: Floats) -> Floats:
    """(...,) sigma of the field's blur at pixels (..., 2): psf.corner_sigma_px at the farthest corner, or a table's."""
    return lengths(camera.along_radius("sigma_um", camera.psf.corner_sigma_px, xy_px))


def chromatic_sigma_px(camera: CameraConfig, chromatic: Floats) -> Floats:
    """(N,) sigma of the blur by the axial color of the wavelengths within each light.

    A wavelength whose focus is shifted by d has a defocus disk of radius k d and variance k^2 d^2 / 4 along each axis.
    The disk of the mean shift is drawn as such, so a Gaussian of variance k^2 var(d) / 4 is added here.

    Parameters
    ----------
    chromatic
        (N, 4 + 2 K) as in `Sources`
    """
    # k: the defocus disk's radius in pixels per shift of focus in m.
    scale_px_m = (
        camera.pupil_m
        * camera.image_distance_m
        / (2 * camera.pixel_m * camera.focal_length_m**2)
    )
    return scale_px_m * chromatic[:, 2] / 2


def blur(sigma_px: float, fx: Floats, fy: Floats) -> Floats:
    """Transfer function of a Gaussian: exp(-2 pi^2 sigma^2 f^2)."""
    return np.exp(-2 * (np.pi * sigma_px) ** 2 * (fx**2 + fy**2))


def coma(coma_px: tuple[float, ...], fx: Floats, fy: Floats) -> Otf:
    """Transfer function of coma c, a vector in px, without its shift of the center of light.

    A ray through the pupil at the radius rho and the angle phi from c is displaced by |c| rho^2 (2 + cos 2 phi, sin 2
    phi), along and across c (Born & Wolf, Principles of Optics, section 5.3), by c on the mean. Over phi and the area,
    with s = rho^2,

        int_0^1 exp(-2 pi i f c (2 s - 1)) J0(2 pi s |c| |f|) ds.
    """
    along = fx * coma_px[0] + fy * coma_px[1]
    across = math.hypot(*coma_px) * np.hypot(fx, fy)
    nodes, weights = np.polynomial.legendre.leggauss(COMA_NODES)
    return sum(
        weight / 2 * np.exp(-2j * np.pi * along * s) * special.j0(np.pi * (1 + s) * across)
        for s, weight in zip(nodes, weights, strict=True)
    )


def uniform_disk(radius_px: float, fx: Floats, fy: Floats) -> Floats:
    """Transfer function of a uniform disk: 2 J1(z) / z, z = 2 pi a f."""
    # The limit at 0 is 1.
    z = np.maximum(2 * np.pi * radius_px * np.hypot(fx, fy), 1e-9)
    return 2 * special.j1(z) / z


def pixel(depth: float, f: Floats) -> Floats:
    """Transfer function of a pixel along one axis: sinc(f) + p (sinc(f - 1) + sinc(f + 1)) / 2.

    It is that of the response 1 + p cos 2 pi u over the pixel, with the depth p, a uniform one for p = 0 (Kavaldjiev &
    Ninkov 1998, Opt. Eng. 37, 948: the response within a pixel shifts the centroids of sharp images).
    """
    return np.sinc(f) + depth / 2 * (np.sinc(f - 1) + np.sinc(f + 1))


def gaussian(psf: GaussianPsfConfig, camera: CameraConfig, fx: Floats, fy: Floats) -> Floats:
    """A lens with a Gaussian point-spread function: `blur` of psf.sigma_px."""
    return blur(psf.sigma_px, fx, fy)


def moffat(psf: MoffatPsfConfig, camera: CameraConfig, fx: Floats, fy: Floats) -> Floats:
    """Moffat profile, a core with power-law wings: 2 (z/2)^n K_n(z) / Gamma(n), z = 2 pi alpha f, n = beta - 1.

    The Hankel transform of (beta - 1) / (pi alpha^2) (1 + r^2 / alpha^2)^-beta (Moffat 1969, A&A 3, 455).
    """
    # K_n diverges at 0, where the product's limit is 1.
    n = psf.beta - 1
    z = np.maximum(2 * np.pi * moffat_alpha_px(psf) * np.hypot(fx, fy), 1e-6)
    return 2 * (z / 2) ** n * special.kv(n, z) / special.gamma(n)


def moffat_alpha_px(psf: MoffatPsfConfig) -> float:
    """The scale alpha of a Moffat profile from its full width at half maximum."""
    return float(psf.fwhm_px / (2 * np.sqrt(2 ** (1 / psf.beta) - 1)))


def airy(psf: AiryPsfConfig, camera: CameraConfig, fx: Floats, fy: Floats) -> Floats:
    """Diffraction at a round pupil: (2/pi) (acos nu - nu sqrt(1 - nu^2)), nu = lambda N f / pixel (Goodman 6-32)."""
    # Frequency over the cut-off, beyond which nothing passes.
    nu = np.minimum(airy_unit_px(psf, camera) * np.hypot(fx, fy), 1.0)
    pupil = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
    return pupil * blur(psf.sigma_px, fx, fy)


def airy_unit_px(psf: AiryPsfConfig, camera: CameraConfig) -> float:
    """lambda N in pixels, with the working f-number N = v / A (the lens's own for a focus at infinity)."""
    return psf.wavelength_m * camera.image_distance_m / camera.pupil_m / camera.pixel_m


def disk(psf: DiskPsfConfig, camera: CameraConfig, fx: Floats, fy: Floats) -> Floats:
    """A uniform disk with a Gaussian edge: the product of `uniform_disk` and `blur`."""
    return uniform_disk(psf.radius_px, fx, fy) * blur(psf.sigma_px, fx, fy)


def measured(psf: MeasuredPsfConfig, camera: CameraConfig, fx: Floats, fy: Floats) -> Otf:
    """A measured point-spread function about its own center of gravity, so that a centroid is a star's position.

    Each number is the light on a cell of 1 / oversampling px. The cell's own integration is divided out, so that the
    pixel's blur is not counted twice: with an oversampling of 1 a star in the middle of a pixel gives the table
    back, with S the pixels are sums of S x S cells. Between these positions Keys' cubic convolution (1981, IEEE
    ASSP 29, 1153) interpolates. A table that already includes the pixel's blur at an oversampling above 1 (an
    "effective" PSF) is widened by that blur again.

    H(fx, fy) = sum over cells of cell[j, i] exp(-2 pi i (fx x_i + fy y_j)) R(fx / S) R(fy / S), R = `cell_response`.
    """
    cells = read_cells(psf.file)
    x_px, y_px = cell_positions_px(psf)
    # The transform is separable: compute it on the distinct fx and fy, then spread it to all pairs.
    distinct_fx, i = np.unique(fx, return_inverse=True)
    distinct_fy, j = np.unique(fy, return_inverse=True)
    response_x = cell_response(distinct_fx / psf.oversampling)
    response_y = cell_response(distinct_fy / psf.oversampling)
    wave_x = np.exp(-2j * np.pi * np.outer(x_px, distinct_fx)) * response_x
    wave_y = np.exp(-2j * np.pi * np.outer(y_px, distinct_fy)) * response_y
    product = wave_y.T @ cells @ wave_x
    return product[j.reshape(np.shape(fy)), i.reshape(np.shape(fx))]


def cell_positions_px(psf: MeasuredPsfConfig) -> tuple[Floats, Floats]:
    """x of the columns and y of the rows of a measured table, in pixels from its center of gravity."""
    cells = read_cells(psf.file)
    # Cells are equally spaced. The origin is the center of gravity.
    position_px = np.arange(len(cells)) / psf.oversampling
    center_x = cells.sum(axis=0) @ position_px
    center_y = cells.sum(axis=1) @ position_px
    return position_px - center_x, position_px - center_y


@lru_cache(maxsize=16)
def read_cells(file: str) -> Floats:
    """(n, n) numbers of a measured PSF from CSV or an image (FITS, PNG, TIFF), scaled to a sum of 1.

    Raises
    ------
    InputError
        For an unreadable file or an unusable table, under the key camera.psf.file.
    """
    # Readers of images take long to import, and few scenes need one.
    from skysim.core.images import monochrome, read_image

    path = Path(file)
    if not is_file(path):
        raise InputError("camera.psf.file", f"{path} not found")
    try:
        if path.suffix.lower() == ".csv":
            rows = cells_of(read_lines(path))
            cells = to_numbers(path, rows, len(rows))
        else:
            cells = monochrome(read_image(path)).astype(float)
    except InputError as error:
        named = error if error.key else error.under(path)
        raise named.within("camera.psf.file") from None
    if cells.ndim != 2 or cells.shape[0] != cells.shape[1] or not 3 <= len(cells) <= 1024:
        raise InputError(
            "camera.psf.file",
            f"{path}: shape {cells.shape}",
            "a square of 3 to 1024 numbers a side",
        )
    total = cells.sum()
    if not 0 < total < np.inf:
        raise InputError(
            "camera.psf.file",
            f"{path}: its numbers add up to {total:g}",
            "a finite sum above 0",
        )
    return cells / total


def cell_response(u: Floats) -> Floats:
    """Transfer function of Keys' interpolation divided by that of a cell; u in cycles a cell. 0 at whole u except 0.

    Keys' kernel (a = -1/2) has the transform (3 s1^2 - 3 s2^2 - s2 + s4) / (pi u)^2 with sk = sinc(k u).
    """
    one = np.sinc(u)
    two = np.sinc(2 * u)
    four = np.sinc(4 * u)
    # Both limits are 1: sinc at u = 0, and no response where a cell's integral passes nothing.
    keys = (3 * one**2 - 3 * two**2 - two + four) / np.maximum((np.pi * u) ** 2, 1e-300)
    # The cell's own integral is divided out.
    ratio = keys / np.where(np.abs(one) > 1e-6, one, np.inf)
    return np.where(np.abs(u) < 1e-4, 1.0, ratio)


PSFS: dict[str, Callable[[Any, CameraConfig, Floats, Floats], Otf]] = {
    "gaussian": gaussian,
    "moffat": moffat,
    "airy": airy,
    "disk": disk,
    "measured": measured,
}


def moffat_extent_px(psf: MoffatPsfConfig, camera: CameraConfig) -> tuple[float, float]:
    """Radius where a Moffat profile falls below WING_LEVEL of its image's peak pixel; at most 64 px or four alpha."""
    alpha = moffat_alpha_px(psf)
    # A sharp profile's peak pixel has at most all of the light.
    level = WING_LEVEL / max(1.0, (psf.beta - 1) / (np.pi * alpha**2))
    radius = alpha * np.sqrt(level ** (-1 / psf.beta) - 1)
    return float(min(radius, max(64.0, 4 * alpha))), 0.0


def airy_extent_px(psf: AiryPsfConfig, camera: CameraConfig) -> tuple[float, float]:
    """Radius where the mean of Airy's rings, 4 / (pi z^3) of its peak at z = pi r / (lambda N), falls below WING_LEVEL.

    At most 64 px or eight lambda N. The light beyond, 2 / (pi z), is 2.5 % at most.
    """
    unit = airy_unit_px(psf, camera)
    sharp = max(1.0, np.pi / 4 / unit**2)
    z = (4 / np.pi / WING_LEVEL * sharp) ** (1 / 3)
    return float(min(z * unit / np.pi, max(64.0, 8 * unit))), psf.sigma_px


def measured_extent_px(psf: MeasuredPsfConfig, camera: CameraConfig) -> tuple[float, float]:
    """The farthest cell's distance in x or y, plus the two cells that interpolation adds."""
    return float(np.abs(cell_positions_px(psf)).max() + 2 / psf.oversampling), 0.0


# By kind: radius that holds the light of a point, and sigma of the Gaussian that widens it, both in pixels.
EXTENT: dict[str, Callable[[Any, CameraConfig], tuple[float, float]]] = {
    "gaussian": lambda psf, camera: (0.0, psf.sigma_px),
    "moffat": moffat_extent_px,
    "airy": airy_extent_px,
    "disk": lambda psf, camera: (psf.radius_px, psf.sigma_px),
    "measured": measured_extent_px,
}
WINGED = ("moffat", "airy")  # kinds with infinite wings
NOT_ROUND = ("measured",)  # kinds that may not be round
