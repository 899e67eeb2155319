"""Pixel-integrated images (kernels) of sources, as tables that `skysim.camera.psf.splat` adds to a frame.

The image's spectrum is the product of the transfer functions of lens, blur, emitter disc, defocus disc and square
pixel (psf/otf.py). It is transformed to a table once, after which an image costs one table look-up per pixel at any
sub-pixel position.

Nearly all images are round and only the pixel is square. `round_kernel` therefore expands the image in angular
harmonics T0(r) + T4(r) cos 4 theta + T8(r) cos 8 theta, each a Hankel transform that a Fourier-Bessel series
evaluates. Images that are not round, or too sharp for three harmonics, are sampled by an FFT at S x S sub-pixel
positions (`grid_kernel`). A Gaussian image of a point needs no table: it is integrated with the error function.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import fft, special
from scipy.interpolate import CubicSpline

from skysim.camera.psf.otf import EXTENT, PSFS, SQUARE, WINGED, Otf, blur, uniform_disc
from skysim.camera.psf.splat import PER_PX, REACH_SIGMA, Singles
from skysim.core.types import Floats
from skysim.scene.camera import CameraConfig, Psf

QUANTUM_PX = 0.01  # sizes are rounded to this, so that LEDs of nearly one size share a kernel
CUT_SIGMA = 5.0  # a Gaussian's image ends here: 4e-6 of its light is beyond
FADE_PX = 2.0  # width over which infinite wings are faded to zero
FAINT = 1e-6  # a transfer function below this is taken as zero
HARMONICS = (0, 4, 8)  # a square has only multiples of four
NOTHING = 5e-5  # a harmonic below this fraction of the peak is left out
SHARP = 1e-2, 1e-4  # largest T8, over the peak and over the total light, for which T0 to T8 are enough
TERMS = 1024  # most terms of a Fourier-Bessel series
NO_RADIAL, NO_GRID = np.empty((0, 3), np.float32), np.empty((0, 0, 0, 0), np.float32)


@dataclass(frozen=True, slots=True)
class Kernel:
    """A source's image integrated over the pixels, as `splat.add` draws it; its light adds up to 1.

    One of three: sigma_px > 0, an exact Gaussian; radial (R, 3, 5 or 7), see `splat.add_round`; grid (P, P, N, N),
    see `splat.add_grid`. Tables that are not used are empty.
    """

    sigma_px: float
    radial: Singles
    grid: Singles

    @property
    def reach_px(self) -> float:
        """Pixels whose center is farther than this in x or in y get no light."""
        if len(self.grid):
            return self.grid.shape[2] / 2
        return (len(self.radial) - 2) / PER_PX if len(self.radial) else REACH_SIGMA * self.sigma_px + 0.5


def kernel(
    psf: Psf,
    camera: CameraConfig,
    extra_sigma_px: float = 0.0,
    emitter_radius_px: float = 0.0,
    blur_radius_px: float = 0.0,
) -> Kernel:
    """The kernel of a uniform disc (a star has radius 0) seen through this lens with this defocus.

    extra_sigma_px    : Gaussian blur added to the lens's own, see `otf.field_sigma_px`
    emitter_radius_px : of the emitting disc's geometric image
    blur_radius_px    : of the defocus disc
    All three are rounded to QUANTUM_PX, except that a Gaussian lens's image of a point is exact. A round image gets
    up to three harmonics of the pixel's shape, which leave out 1e-4 of the peak at a blur of 0.2 px and 1e-3 on the
    edge of a disc as sharp as 0.08 px; a sharper point, or a lens that is not round, gets a grid. The light of
    power-law wings beyond their reach is added to the image by normalization, so that its total is 1. Raises
    InputError for an unreadable file of a measured PSF.
    """
    steps = tuple(round(value / QUANTUM_PX) for value in (extra_sigma_px, emitter_radius_px, blur_radius_px))
    if psf.kind == "gaussian" and not (steps[1] or steps[2]):
        return Kernel(float(np.hypot(psf.sigma_px, extra_sigma_px)), NO_RADIAL, NO_GRID)
    made = None if psf.kind in SQUARE else round_kernel(psf, camera, *steps)
    return made or grid_kernel(psf, camera, *steps)


@dataclass(frozen=True, slots=True)
class Blend:
    """The factors of the convolution: a lens, an extra Gaussian, and discs."""

    psf: Psf
    camera: CameraConfig
    sigma_px: float
    radii_px: tuple[float, ...]

    @classmethod
    def of(cls, psf: Psf, camera: CameraConfig, sigma: int, *radii: int) -> Blend:
        """From sizes in steps of QUANTUM_PX."""
        return cls(psf, camera, sigma * QUANTUM_PX, tuple(radius * QUANTUM_PX for radius in radii if radius))

    def otf(self, fx: Floats, fy: Floats, softening_px: float) -> Otf:
        """The product of the transfer functions without the pixel's, times that of a softening Gaussian."""
        product = PSFS[self.psf.kind](self.psf, self.camera, fx, fy)
        sigma_px = float(np.hypot(self.sigma_px, softening_px))
        product = product * blur(sigma_px, fx, fy) if sigma_px else product
        for radius in self.radii_px:
            product = product * uniform_disc(radius, fx, fy)
        return product

    def reach_px(self) -> float:
        """Radius of a circle that holds the image, pixels' corners included."""
        radius, sigma = EXTENT[self.psf.kind](self.psf, self.camera)
        fade = FADE_PX if self.psf.kind in WINGED else 0.0
        sigma_px = float(np.hypot(sigma, self.sigma_px))
        return radius + fade + sum(self.radii_px) + CUT_SIGMA * sigma_px + float(np.sqrt(0.5))

    def beyond_px(self) -> float:
        """How much farther wings must be followed so that aliasing is below 1e-4 of the peak."""
        return 2 * EXTENT[self.psf.kind](self.psf, self.camera)[0] if self.psf.kind in WINGED else 0.0


@lru_cache(maxsize=1024)
def cutoff(psf: Psf, camera: CameraConfig, sigma_px: float, level: float) -> float:
    """The frequency above which lens and Gaussian pass less than `level`, in steps of a half from 1 to 64."""
    f = np.linspace(0, 64, 1025)
    along = (PSFS[psf.kind](psf, camera, *axes) for axes in ((f, 0 * f), (0 * f, f)))
    passed = np.maximum(*map(np.abs, along)) * blur(sigma_px, f, 0 * f)
    return float(max(np.ceil(2 * f[np.flatnonzero(passed >= level)[-1]]) / 2, 1.0))


def softening_px(wanted: float, held: float) -> float:
    """Sigma of the Gaussian that passes only FAINT at the highest frequency of a table; 0 if no
    softening is needed.
    """
    return 0.0 if wanted <= held else float(np.sqrt(-np.log(FAINT) / 2) / (np.pi * held))


@dataclass(frozen=True, slots=True)
class Series:
    """Fourier-Bessel series of the HARMONICS on a circle of radius B.

    f      : (3, K) frequencies j / (2 pi B), j the zeros of J_n
    weight : (3, K) P_n(f) / (pi B^2 J_{n+1}(j)^2), P_n the square pixel's own n-th harmonic
    matrix : (3, rows, K) J_n(j r / B) at r = 0, 1 / per_px, ..., up to reach_px
    """

    f: Floats
    weight: Floats
    matrix: Singles


@lru_cache(maxsize=8)
def series(box_px: float, reach_px: float, highest: float, per_px: int) -> Series:
    """The series up to a frequency; it does not depend on the image.

    T_n(r) = 2 pi integral of OTF(f) P_n(f) J_n(2 pi f r) f df; a function that vanishes beyond B is the sum
    over k of OTF(f_k) weight_k J_n(j_k r / B) exactly (Watson, Theory of Bessel Functions, ch. 18).
    """
    r = np.arange(round(reach_px * per_px) + 1) / per_px
    zeros = np.array([special.jn_zeros(n, int(2 * highest * box_px)) for n in HARMONICS])
    f = zeros / (2 * np.pi * box_px)
    angle = np.arange(256) * 2 * np.pi / 256
    square = np.sinc(f[..., None] * np.cos(angle)) * np.sinc(f[..., None] * np.sin(angle))
    weight, matrix = np.empty_like(f), np.empty((len(f), len(r), f.shape[1]), np.float32)
    x = np.arange(0, zeros.max() + 1, 0.05)
    for k, n in enumerate(HARMONICS):
        harmonic = (square[k] * np.cos(n * angle)).mean(axis=1) * (2 if n else 1)
        weight[k] = harmonic / (np.pi * (box_px * special.jv(n + 1, zeros[k])) ** 2)
        # A spline of this step is within 2e-8 of J_n and ten times as fast.
        matrix[k] = CubicSpline(x, special.jv(n, x))(np.outer(r, 2 * np.pi * f[k]))
    return Series(f, weight, matrix)


@lru_cache(maxsize=4096)
def round_kernel(psf: Psf, camera: CameraConfig, *steps: int) -> Kernel | None:
    """A kernel of radial tables; None where three harmonics cannot represent the pixel's corners.

    A series holds at most 16 cycles a pixel and TERMS terms; a sharper image is softened to that: one of 130 px
    radius by 0.2 px.
    """
    blend = Blend.of(psf, camera, *steps)
    reach, wanted = blend.reach_px(), cutoff(psf, camera, blend.sigma_px, FAINT)
    # Radii in coarse steps, so that images of similar size share a cached series.
    step = 4.0 if reach < 64 else 16.0
    shown, box = (float(np.ceil(size / step)) * step for size in (reach, reach + blend.beyond_px()))
    highest = min(wanted, 16.0, max(TERMS / 2 / box, 0.5))
    coarse = 4 if highest <= 4 else 1  # a series of low frequencies is summed at every fourth radius
    terms = series(box, shown, highest, PER_PX // coarse)
    passed = blend.otf(terms.f, np.zeros(1), softening_px(wanted, highest)) * terms.weight
    rows, count = int(reach * PER_PX / coarse) + 2, int(reach * PER_PX) + 1
    pairs = zip(terms.matrix[:, :rows], passed.astype(np.float32), strict=True)
    t = refined(np.array([matrix @ amount for matrix, amount in pairs], dtype=float), coarse)[:, :count]
    # A strong eighth harmonic means that the higher ones, which are left out, matter too.
    if np.abs(t[2]).max() > min(SHARP[0] * t[0].max(), SHARP[1]):
        return None
    if psf.kind in WINGED:
        s = np.clip((reach - np.arange(count) / PER_PX) / FADE_PX, 0, 1)
        t *= s**2 * (3 - 2 * s)  # a sharp end would alias with the pixel grid
    return Kernel(0.0, packed(t), NO_GRID)


def refined(coarse: Floats, times: int) -> Floats:
    """Interpolate even functions of r from (n, R) to (n, times R) samples, by Lagrange's cubic."""
    if times == 1:
        return coarse
    s = np.arange(times) / times
    a, b, c, d = s + 1, s, s - 1, s - 2
    weights = np.array([-b * c * d / 6, a * c * d / 2, -a * b * d / 2, a * b * c / 6])
    count, rows = coarse.shape
    padded = np.zeros((count, rows + 3))
    padded[:, 0], padded[:, 1:-2] = coarse[:, 1], coarse
    return np.asarray(sum(padded[:, k : k + rows, None] * weights[k] for k in range(4))).reshape(count, -1)


def packed(t: Floats) -> Singles:
    """(R + 1, 3, 5 or 7) table for `splat.add_round` from (3, R) harmonics: normalized to 1, nowhere negative."""
    sizes = np.abs(t).max(axis=1)
    t = t[: 1 + np.count_nonzero(sizes[1:] > NOTHING * sizes[0])]
    # Raise T0 where the other harmonics would make the image negative.
    t[0] = np.maximum(t[0], np.abs(t[1:]).sum(axis=0))
    r = np.arange(t.shape[1]) / PER_PX
    # Total light 2 pi int r T0 dr by the trapezoid rule, with its end correction at r = 0 (Euler-Maclaurin).
    t /= 2 * np.pi / PER_PX * (r @ t[0] + t[0, 0] / 12 / PER_PX)
    out = np.zeros((len(r) + 1, 1 + 2 * len(t)), np.float32)
    bend = np.zeros(len(r) + 1)
    bend[0], bend[1:-2] = 2 * (t[0, 1] - t[0, 0]), t[0, 2:] - 2 * t[0, 1:-1] + t[0, :-2]
    # Bessel's interpolation uses the mean of the second differences at both ends, over 2.
    out[:-1, 2] = (bend[:-1] + bend[1:]) / 4
    for value, n, harmonic in zip((0, 3, 5), HARMONICS, t, strict=False):
        harmonic[1:] /= r[1:] ** n
        harmonic[0] *= n == 0
        out[:-1, value] = harmonic
        out[:-1, value + 1] = np.append(harmonic[1:], 0) - harmonic
    return out


@lru_cache(maxsize=64)
def grid_kernel(psf: Psf, camera: CameraConfig, *steps: int) -> Kernel:
    """A kernel of tables at S x S sub-pixel positions, by a fast Fourier transform of the product.

    S is a power of two from 4 to 128: more than seven times the highest frequency, but less for a large image.
    """
    blend = Blend.of(psf, camera, *steps)
    half = int(np.ceil(blend.reach_px()))
    wanted, size = cutoff(psf, camera, blend.sigma_px, 1e-3), 2 * half + 1
    places = 128
    while places > 4 and (places >= 14 * wanted or places * size > 3072):
        places //= 2
    # The transform is periodic: wings need room beyond the image, or they fold back into it.
    room = min(size + 2 * int(np.ceil(blend.beyond_px())), 3072 // places)
    box = fft.next_fast_len(max(size, room), real=True)
    fx = fft.rfftfreq(places * box, 1 / places)[None, :]
    fy = fft.fftfreq(places * box, 1 / places)[:, None]
    otf = blend.otf(fx, fy, softening_px(wanted, 0.4 * places)) * np.sinc(fx) * np.sinc(fy)
    image = fft.irfft2(otf, s=(places * box,) * 2)
    pixel, place = np.arange(size) - half, np.arange(-1, places + 2)
    # Sub-pixel sample of each pixel and position; the modulo wraps negative indices of the periodic image.
    pick = (pixel * places + places // 2 - place[:, None]) % (places * box)
    tables = np.maximum(image[pick[:, None, :, None], pick[None, :, None, :]], 0)  # clip the negative ringing
    return Kernel(0.0, NO_RADIAL, (tables / tables.sum(axis=(2, 3), keepdims=True)).astype(np.float32))
