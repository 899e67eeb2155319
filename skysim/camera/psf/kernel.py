"""Pixel-integrated images (kernels) of sources, as tables that `skysim.camera.psf.splat` adds to a frame.

The image's spectrum is the product of the transfer functions of lens, blur, emitter disk, defocus disk and square
pixel (psf/otf.py). It is transformed to a table once, after which an image costs one table look-up per pixel at any
sub-pixel position. There are three forms (`build_kernel` chooses):

1. A Gaussian image of a point needs no table: it is integrated with the error function.
2. Nearly all other images are round and only the pixel is square. `round_kernel` expands the image in angular harmonics

       T(r, theta) = T0(r) + T4(r) cos 4 theta + T8(r) cos 8 theta,

   each a Hankel transform that a Fourier-Bessel series evaluates.
3. Images that are not round, or too sharp for three harmonics, are sampled by an FFT at S x S sub-pixel positions
   (`grid_kernel`).
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy import special

from skysim.camera.optics import Optics
from skysim.camera.psf.otf import (
    EXTENT,
    NOT_ROUND,
    PSFS,
    WINGED,
    Otf,
    blur,
    coma,
    pixel,
    uniform_disk,
)
from skysim.camera.psf.splat import PER_PX, REACH_SIGMA, cubic
from skysim.core.types import Floats, Singles, frozen
from skysim.scene.sections.camera import CameraConfig, Psf
from skysim.sources.dome.led import Emitter, irradiance_e_s_m2
from skysim.sources.dome.surface import perpendicular

QUANTUM_PX = 0.01  # sizes are rounded to this, so that LEDs of nearly one size share a kernel
CUT_SIGMA = 5.0  # a Gaussian's image ends here: 4e-6 of its light is beyond
FADE_PX = 2.0  # width over which infinite wings are faded to zero
OTF_FLOOR = 1e-6  # a transfer function below this is taken as zero
OPAQUE = 1e-12  # below this, a product is too small for a further factor to matter in single precision
HARMONICS = (0, 4, 8)  # a square has only multiples of four
HARMONIC_FLOOR = 5e-5  # a harmonic below this fraction of the peak is left out
# Largest T8, over the peak and over the total light, for which T0 to T8 are enough.
MAX_T8 = (1e-2, 1e-4)
MAX_TERMS = 1024  # most terms of a Fourier-Bessel series
# Kinds of kernel; an ellipse has a table of its own in each exposure (psf/ellipse.py).
GAUSS = 0
ROUND = 1
GRID = 2
ELLIPSE = 3


class Kernel(NamedTuple):
    """A source's image integrated over the pixels, as compiled code adds it to a patch; its light adds up to 1.

    Attributes
    ----------
    kind
        GAUSS, ROUND or GRID
    sigma_px
        Standard deviation of an exact Gaussian (`splat.add_gaussian`), else 0
    table
        (R, 3, 5 or 7) for `splat.add_round`, (S + 3, S + 3, N, N) for `splat.add_grid`, or empty
    reach_px
        Distance in x or in y beyond which a pixel's center gets no light
    peak
        Fraction of the light in the brightest pixel of a centered image
    sharp_px
        Motion of an image that changes its pixels little: half its peak over its steepest slope. For the table of a
        Gaussian that is 0.82 sigma. For a soft edge it is 1.25 sigma, which is still safe: two nodes in 1.6 sigma
        leave a ripple of 0.5 exp(-2 pi^2 / 1.6^2) = 2e-4, and the ends' fraction falls with the disk's width. For a
        Gaussian drawn by formula it is sigma with the pixel's own variance, 1/12, added
    """

    kind: int
    sigma_px: float
    table: Singles
    reach_px: float
    peak: float
    sharp_px: float


def gaussian_kernel(sigma_px: float) -> Kernel:
    """A kernel of an exact Gaussian, which needs no table."""
    peak = float(special.erf(np.sqrt(0.125) / sigma_px) ** 2)
    sharp_px = float(np.sqrt(sigma_px**2 + 1 / 12))
    none = np.empty((0, 0), np.float32)
    return Kernel(GAUSS, sigma_px, none, REACH_SIGMA * sigma_px + 0.5, peak, sharp_px)


def build_kernel(
    psf: Psf,
    camera: CameraConfig,
    extra_sigma_px: float = 0.0,
    emitter_radius_px: float = 0.0,
    blur_radius_px: float = 0.0,
    coma_px: tuple[float, ...] = (),
) -> Kernel:
    """The kernel of a uniform disk (a star has radius 0) seen through this lens with this defocus.

    All three sizes are rounded to QUANTUM_PX, except that a Gaussian lens's image of a point is exact. A round image
    gets up to three harmonics of the pixel's shape, which leave out 1e-4 of the peak at a blur of 0.2 px and 1e-3 on
    the edge of a disk as sharp as 0.08 px; a sharper point, or a lens that is not round, gets a grid. The light of
    power-law wings beyond their reach is added to the image by normalization, so that its total is 1.

    Parameters
    ----------
    extra_sigma_px
        Standard deviation of a Gaussian blur added to the lens's own (`otf.field_sigma_px`)
    emitter_radius_px
        Radius of the emitting disk's geometric image
    blur_radius_px
        Radius of the defocus disk
    coma_px
        Coma in x and y

    Raises
    ------
    InputError
        For an unreadable file of a measured PSF.
    """
    sigma_px, *radii_px = (
        QUANTUM_PX * round(value / QUANTUM_PX)
        for value in (extra_sigma_px, emitter_radius_px, blur_radius_px)
    )
    model = PsfModel(psf, camera, sigma_px, tuple(filter(None, radii_px)), coma_px)
    if any(coma_px):
        return grid_kernel(model)
    if psf.kind == "gaussian" and not (camera.detector.intrapixel or model.radii_px):
        return gaussian_kernel(float(np.hypot(psf.sigma_px, extra_sigma_px)))
    round_image = None if psf.kind in NOT_ROUND else round_kernel(model)
    return round_image or grid_kernel(model)


def reach_px(
    psf: Psf, camera: CameraConfig, radius_px: Any, sigma_px: Any, cut_sigma: float
) -> Any:
    """Reach in pixels, pixels' corners included, of the images of disks of these largest radii.

    `sigma_px` is that of a Gaussian blur in addition to the lens's own; both together are cut at `cut_sigma` of theirs.
    """
    # Lens, fading wings, disk, blur, and the pixel's half diagonal.
    radius, sigma = EXTENT[psf.kind](psf, camera)
    fade_px = FADE_PX if psf.kind in WINGED else 0.0
    return radius + fade_px + radius_px + cut_sigma * np.hypot(sigma, sigma_px) + np.sqrt(0.5)


@frozen
class PsfModel:
    """The factors of the image's convolution: a lens, an extra Gaussian, disks, and coma."""

    psf: Psf
    camera: CameraConfig
    sigma_px: float
    radii_px: tuple[float, ...]
    coma_px: tuple[float, ...] = ()

    def otf(self, fx: Floats, fy: Floats, extra_sigma_px: float) -> Otf:
        """The product of the factors' transfer functions, without the pixel's, times that of an extra Gaussian."""
        product = PSFS[self.psf.kind](self.psf, self.camera, fx, fy)
        sigma_px = float(np.hypot(self.sigma_px, extra_sigma_px))
        if sigma_px:
            product = product * blur(sigma_px, fx, fy)
        for radius in self.radii_px:
            product = product * uniform_disk(radius, fx, fy)
        if not any(self.coma_px):
            return product
        # Most frequencies of a table pass nothing, and the integral over the pupil takes long.
        passed = np.abs(product) > OPAQUE
        axes = (axis[passed] for axis in np.broadcast_arrays(fx, fy))
        with_coma = np.zeros(product.shape, complex)
        with_coma[passed] = product[passed] * coma(self.coma_px, *axes)
        return with_coma

    def reach_px(self) -> float:
        """Radius of a circle that holds the image, pixels' corners included."""
        radius_px = sum(self.radii_px) + 2 * float(np.hypot(*(self.coma_px or (0, 0))))
        return float(reach_px(self.psf, self.camera, radius_px, self.sigma_px, CUT_SIGMA))

    def wing_margin_px(self) -> float:
        """Distance beyond the image to which wings must be followed so that aliasing is below 1e-4 of the peak."""
        if self.psf.kind not in WINGED:
            return 0.0
        return 2 * EXTENT[self.psf.kind](self.psf, self.camera)[0]


@lru_cache(maxsize=1024)
def passband(psf: Psf, camera: CameraConfig, sigma_px: float, level: float) -> float:
    """The frequency above which lens and Gaussian pass less than `level`, in steps of 1/16 up to 64."""
    f = np.linspace(0, 64, 1025)
    transfer = (PSFS[psf.kind](psf, camera, *axes) for axes in ((f, 0 * f), (0 * f, f)))
    combined = np.maximum(*map(np.abs, transfer)) * blur(sigma_px, f, 0 * f)
    return float(f[np.flatnonzero(combined >= level)[-1]])


def bandwidth(model: PsfModel, level: float) -> float:
    """`passband` in steps of a half from 1 to 64, so that similar sizes share tables."""
    passed = passband(model.psf, model.camera, model.sigma_px, level)
    return float(max(np.ceil(2 * passed) / 2, 1.0))


def softening_sigma_px(bandwidth: float, highest: float) -> float:
    """Sigma of a Gaussian that passes OTF_FLOOR at a table's highest frequency; 0 if no softening is needed.

    exp(-2 pi^2 sigma^2 f^2) = OTF_FLOOR.
    """
    if bandwidth <= highest:
        return 0.0
    return float(np.sqrt(-np.log(OTF_FLOOR) / 2) / (np.pi * highest))


@frozen
class FourierBesselSeries:
    """Fourier-Bessel series of the HARMONICS on a circle of radius B.

    Attributes
    ----------
    f
        (3, K) frequencies j / (2 pi B), with the zeros j of J_n
    weight
        (3, K) P_n(f) / (pi B^2 J_{n+1}(j)^2), with the square pixel's own n-th harmonic P_n
    matrix
        (3, rows, K) J_n(j r / B) at r = 0, 1 / per_px, ..., up to reach_px
    """

    f: Floats
    weight: Floats
    matrix: Singles


@lru_cache(maxsize=8)
def fourier_bessel_series(
    depth: float, box_px: float, reach_px: float, highest: float, per_px: int
) -> FourierBesselSeries:
    """The series up to a frequency; it does not depend on the image.

    T_n(r) = 2 pi integral of OTF(f) P_n(f) J_n(2 pi f r) f df. A function that vanishes beyond B is exactly the sum
    over k of OTF(f_k) weight_k J_n(j_k r / B) (Watson, Theory of Bessel Functions, ch. 18).
    """
    r = np.arange(round(reach_px * per_px) + 1) / per_px
    zeros = np.array([special.jn_zeros(n, int(2 * highest * box_px)) for n in HARMONICS])
    f = zeros / (2 * np.pi * box_px)
    # The pixel's harmonics P_n: its transfer function sinc(fx) sinc(fy) on circles, projected on cos n theta.
    angle = np.arange(256) * 2 * np.pi / 256
    f_circle = f[..., None]
    square = pixel(depth, f_circle * np.cos(angle)) * pixel(depth, f_circle * np.sin(angle))
    weight = np.empty_like(f)
    matrix = np.empty((len(f), len(r), f.shape[1]), np.float32)
    x = np.arange(0, zeros.max() + 1, 0.05)
    for k, n in enumerate(HARMONICS):
        harmonic = (square[k] * np.cos(n * angle)).mean(axis=1) * (2 if n else 1)
        weight[k] = harmonic / (np.pi * (box_px * special.jv(n + 1, zeros[k])) ** 2)
        # A spline of this step is within 2e-8 of J_n and ten times as fast.
        spline = scipy.interpolate.CubicSpline(x, special.jv(n, x))
        matrix[k] = spline(np.outer(r, 2 * np.pi * f[k]))
    return FourierBesselSeries(f, weight, matrix)


@lru_cache(maxsize=4096)
def round_kernel(model: PsfModel) -> Kernel | None:
    """A kernel of radial tables; None where three harmonics cannot represent the pixel's corners.

    1. Size of the image and of the series' circle, highest frequency and number of terms.
    2. Sum the series for T0, T4 and T8 and interpolate between the radii.
    3. Refuse an image whose T8 is strong: the higher harmonics, which are left out, then matter too.
    4. Fade wings to zero at their end.

    A series holds at most 16 cycles a pixel and MAX_TERMS terms; a sharper image is softened to that: an image of 130
    px radius by 0.2 px.
    """
    reach = model.reach_px()
    highest_passed = bandwidth(model, OTF_FLOOR)
    # 1. Radii in coarse steps, so that images of similar size share a cached series.
    step = 4.0 if reach < 64 else 16.0
    sizes = reach, reach + model.wing_margin_px()
    table_px, box_px = (float(np.ceil(size / step)) * step for size in sizes)
    highest = min(highest_passed, 16.0, max(MAX_TERMS / 2 / box_px, 0.5))
    # A series of low frequencies is summed at every fourth radius.
    coarse = 4 if highest <= 4 else 1
    depth = model.camera.detector.intrapixel
    terms = fourier_bessel_series(depth, box_px, table_px, highest, PER_PX // coarse)
    # 2. Sum the series.
    softening_px = softening_sigma_px(highest_passed, highest)
    spectrum = model.otf(terms.f, np.zeros(1), softening_px) * terms.weight
    rows = int(reach * PER_PX / coarse) + 2
    count = int(reach * PER_PX) + 1
    products = zip(terms.matrix[:, :rows], spectrum.astype(np.float32), strict=True)
    sums = np.array([matrix @ spectrum_n for matrix, spectrum_n in products], dtype=float)
    harmonics = interpolate_cubic(sums, coarse)[:, :count]
    # 3.
    if np.abs(harmonics[2]).max() > min(MAX_T8[0] * harmonics[0].max(), MAX_T8[1]):
        return None
    # 4. A sharp end would alias with the pixel grid.
    if model.psf.kind in WINGED:
        s = np.clip((reach - np.arange(count) / PER_PX) / FADE_PX, 0, 1)
        harmonics *= s**2 * (3 - 2 * s)
    table = pack_table(harmonics)
    peak = float(table[0, 0])
    sharp_px = float(0.5 * table[0, 0] / (np.abs(table[:, 1]).max() * PER_PX))
    return Kernel(ROUND, 0.0, table, (len(table) - 2) / PER_PX, peak, sharp_px)


def interpolate_cubic(samples: Floats, factor: int) -> Floats:
    """Interpolate even functions of r from (n, R) to (n, factor R) samples, by Lagrange's cubic."""
    if factor == 1:
        return samples
    # Weights of the samples at -1, 0, 1 and 2 for each position s between 0 and 1.
    weights = np.array([cubic(s) for s in np.arange(factor) / factor]).T
    count, rows = samples.shape
    # An even function has at -1 the value that it has at 1.
    padded = np.zeros((count, rows + 3))
    padded[:, 0] = samples[:, 1]
    padded[:, 1:-2] = samples
    return np.asarray(
        sum(padded[:, k : k + rows, None] * weights[k] for k in range(4))
    ).reshape(count, -1)


def pack_table(harmonics: Floats) -> Singles:
    """The table for `splat.add_round` from (3, R) harmonics: normalized to 1, nowhere negative.

    Returns (R + 1, 3, 5 or 7): T0 with its step to the next radius and Bessel's second difference, then T4 / r^4 and
    T8 / r^8 with their steps, without the harmonics that are too weak to matter.
    """
    largest = np.abs(harmonics).max(axis=1)
    harmonics = harmonics[: 1 + np.count_nonzero(largest[1:] > HARMONIC_FLOOR * largest[0])]
    # Raise T0 where the other harmonics would make the image negative.
    harmonics[0] = np.maximum(harmonics[0], np.abs(harmonics[1:]).sum(axis=0))
    r = np.arange(harmonics.shape[1]) / PER_PX
    # Total light 2 pi int r T0 dr by the trapezoid rule, with its end correction at r = 0 (Euler-Maclaurin).
    harmonics /= 2 * np.pi / PER_PX * (r @ harmonics[0] + harmonics[0, 0] / 12 / PER_PX)
    table = np.zeros((len(r) + 1, 1 + 2 * len(harmonics)), np.float32)
    second_difference = np.zeros(len(r) + 1)
    second_difference[0] = 2 * (harmonics[0, 1] - harmonics[0, 0])
    second_difference[1:-2] = harmonics[0, 2:] - 2 * harmonics[0, 1:-1] + harmonics[0, :-2]
    # Bessel's interpolation uses the mean of the second differences at both ends, over 2.
    table[:-1, 2] = (second_difference[:-1] + second_difference[1:]) / 4
    # Divide by r^n, whose product with cos n theta is a polynomial of dx^2 and dy^2.
    for column, n, values in zip((0, 3, 5), HARMONICS, harmonics, strict=False):
        values[1:] /= r[1:] ** n
        values[0] *= n == 0
        table[:-1, column] = values
        table[:-1, column + 1] = np.append(values[1:], 0) - values
    return table


@lru_cache(maxsize=64)
def grid_kernel(model: PsfModel) -> Kernel:
    """A kernel of tables at S x S sub-pixel positions, by a fast Fourier transform of the product.

    1. S is a power of two from 4 to 128: more than seven times the highest frequency, but less for a large image.
    2. Transform the product of the transfer functions to an image of S samples per pixel.
    3. Sort the samples: one table of pixels for each sub-pixel position, each normalized to 1, all together if the
       response varies within a pixel.
    """
    # 1. Number of samples.
    half = int(np.ceil(model.reach_px()))
    highest_passed = bandwidth(model, 1e-3)
    size = 2 * half + 1
    samples = 128
    while samples > 4 and (samples >= 14 * highest_passed or samples * size > 3072):
        samples //= 2
    # The transform is periodic: wings need room beyond the image, or they fold back into it.
    with_wings = min(size + 2 * int(np.ceil(model.wing_margin_px())), 3072 // samples)
    box = scipy.fft.next_fast_len(max(size, with_wings), real=True)
    # 2. The spectrum, the pixel's included, and its inverse transform.
    fx = scipy.fft.rfftfreq(samples * box, 1 / samples)[None, :]
    fy = scipy.fft.fftfreq(samples * box, 1 / samples)[:, None]
    softening_px = softening_sigma_px(highest_passed, 0.4 * samples)
    otf = model.otf(fx, fy, softening_px)
    depth = model.camera.detector.intrapixel
    otf = otf * pixel(depth, fx) * pixel(depth, fy)
    image = scipy.fft.irfft2(otf, s=(samples * box,) * 2)
    place = np.arange(size) - half
    position = np.arange(-1, samples + 2)
    # 3. Sub-pixel sample of each pixel and position; the modulo wraps negative indices of the periodic image.
    index = (place * samples + samples // 2 - position[:, None]) % (samples * box)
    # Negative ringing is cut.
    tables = np.maximum(image[index[:, None, :, None], index[None, :, None, :]], 0)
    light = tables.sum(axis=(2, 3), keepdims=True)
    # The response within a pixel makes the light depend on the position.
    normalized = (tables / (light[1:-2, 1:-2].mean() if depth else light)).astype(np.float32)
    peak = normalized.max()
    slope = max(np.abs(np.diff(normalized, axis=axis)).max() for axis in (0, 1)) * samples
    return Kernel(GRID, 0.0, normalized, size / 2, float(peak), float(0.5 * peak / slope))


# Geometric images of the emitting disks of LEDs: ellipses in perspective, with light that varies across them.


class DiskImages(NamedTuple):
    """Images of N disks through a pinhole, to the second order in radius over distance.

    The point r e of a disk, |e| <= 1, is imaged at center + A e from the image of the disk's center. The density of the
    light there is 1 + q e over its mean. Its center of gravity is center + A q / 4.

    Attributes
    ----------
    matrix
        (N, 2, 2) A in pixels; the image's semi-axes are its singular values
    center
        (N, 2) centers of the ellipses in pixels, from the images of the disks' centers
    gradient
        (N, 2) A q in pixels
    """

    matrix: Floats
    center: Floats
    gradient: Floats

    def semi_axes_px(self) -> Floats:
        """(N, 2) semi-axes of the images, the larger one first; 0 without an image.

        They are the singular values s1, s2 of A, by (s1 +- s2)^2 = |A|^2 +- 2 |det A|.
        """
        a, b, c, d = np.nan_to_num(self.matrix).reshape(-1, 4).T
        squares = a * a + b * b + c * c + d * d
        twice = 2 * np.abs(a * d - b * c)
        total = np.sqrt(squares + twice)
        difference = np.sqrt(np.maximum(squares - twice, 0))
        return np.column_stack([total + difference, total - difference]) / 2


def disk_images(
    optics: Optics, emitter: Emitter, offset_cam: Floats, normal_cam: Floats, radius_m: Floats
) -> DiskImages:
    """The images of N disks, from those of five points of each: its center and r e1, -r e1, r e2, -r e2 on its rim.

    With the image u and the light w that the pupil receives from a point, their expansions about the disk's center

        u = u0 + A e + Q(e, e) / 2,    w = w0 (1 + g e)

    follow from central differences. By <e e^T> = 1/4 over the disk the light's center of gravity is A g / 4 + tr Q / 8.
    An area of the disk is imaged 1 / Z^3 times as large, Z = Z0 (1 + k e) (foreshortening and 1 / Z^2), so the image's
    density goes as q = g + 3 k. For a Lambertian disk that is the law cos^4 of the field angle. Distortion is in A and
    in Q. Results are infinite or NaN where a point of the rim has no image.

    Parameters
    ----------
    offset_cam
        (N, 3) vectors from the pupil to the disks' centers in m, camera axes
    normal_cam
        (N, 3) unit normals of the disks, camera axes
    radius_m
        (N,) radii of the disks
    """
    # The five points, (5, N, 3), and the light that the pupil gets from each.
    across = radius_m[:, None] * perpendicular(normal_cam)
    rim = np.stack([across, np.cross(normal_cam, across)])  # (2, N, 3)
    points = offset_cam + np.concatenate([0 * rim[:1], rim, -rim])
    distance_m = np.linalg.norm(points, axis=2)
    cos_out = -np.sum(points * normal_cam, axis=2) / distance_m
    throughput = optics.throughput(points[..., 2] / distance_m)
    light = irradiance_e_s_m2(np.ones(()), emitter, cos_out, throughput, distance_m)
    image = optics.project(points)
    # g and k, each (2, N) along e1 and e2.
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = (light[1:3] - light[3:]) / (2 * light[0])
        depth = rim[..., 2] / offset_cam[:, 2]
    # A, tr Q and A q.
    matrix = np.moveaxis((image[1:3] - image[3:]) / 2, 0, 2)
    trace = image[1:].sum(axis=0) - 4 * image[0]
    gradient, tilt = (
        np.einsum("nij,jn->ni", matrix, part) for part in (slope + 3 * depth, depth)
    )
    return DiskImages(matrix, trace / 8 - 0.75 * tilt, gradient)
