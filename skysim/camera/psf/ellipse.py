"""The pixel-integrated image of one elliptical disk, built for each exposure (compiled).

An ellipse has more sizes than a cache of kernels can hold: two semi-axes, an orientation and the defocus. Its image is
therefore built from its spectrum when it is drawn,

    H(f) = lens(f) pixel(f) defocus(f) gauss(f) 2 J1(w) / w,    w = 2 pi |A^T f|,

with the matrix A of `kernel.DiskImages`:

1. The factors that all disks of a camera share, and the waves of the Fourier series, are tabulated once for each size
   of box (`ellipse_box`).
2. `spectrum` multiplies in the factors of one disk.
3. `quadrants` sums the waves. The sum is separable, and its even and odd parts need one quadrant of the box only.
4. `unfold` makes the whole image from the quadrants, sampled S times a pixel.
5. `add_ellipse` interpolates between the samples by Lagrange's cubic, for an image at any position.
"""

from functools import lru_cache
from math import ceil, floor, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from skysim.camera.psf.kernel import FADE_PX, PsfModel, passband, reach_px, softening_sigma_px
from skysim.camera.psf.otf import pixel
from skysim.camera.psf.splat import cubic, reached
from skysim.core.jit import jit
from skysim.core.types import Floats, Singles
from skysim.scene.sections.camera import CameraConfig, Psf

CUT_SIGMA = (
    4.0  # a box ends here beyond the disk: 3e-5 of the peak of a resolved disk are beyond
)
MAX_WAVES = 512  # along an axis of a box; a larger image is softened
# Images at most POINT_LIKE times as wide as a point's, and wider ones, whose waves are weaker: level of the lens's
# transfer function below which waves are left out, and samples a pixel over the frequency that the lens passes by 1e-3.
# The image is then within 2e-4 of the peak.
POINT_LIKE = 1.7
ACCURACY = {True: (2e-5, 8), False: (2e-4, 4)}
PAD = 1  # empty pixels about a table, for the four points of the cubic
ENTRIES = 64  # of the Bessel table, per unit of its argument
# least half width, and step of the half widths of wider boxes, in pixels
COARSE_HALF_PX = ((100, 16), (24, 4), (0, 1))


class EllipseBox(NamedTuple):
    """Shared tables for images that reach `half` pixels: sizes, and one array of singles for compiled code.

    Attributes
    ----------
    waves
        Number F of frequencies k / N along each axis of the N x N box, 0 <= k < F
    samples
        Number S of samples per pixel
    table
        The frequencies, (F,); lens and pixel at (fx, fy) and (-fx, fy), real, then imaginary parts, (4, F, F); cosine
        and sine of the waves at x = t + p / S, in the order of p, then t, (2, F, S (half + 1))
    """

    waves: int
    samples: int
    table: Singles


def box_half_px(reach: Any) -> Any:
    """Half widths of the boxes that hold images of this reach: whole pixels, in coarser steps for larger ones."""
    step = np.select(
        [reach > size for size, _ in COARSE_HALF_PX], [step for _, step in COARSE_HALF_PX]
    )
    return (np.ceil(reach / step) * step).astype(np.int64)


def ellipse_box(psf: Psf, camera: CameraConfig, half: int) -> EllipseBox:
    """The tables of a box of 2 half + 1 pixels, with a margin for wings: step 1 of the module."""
    lens = PsfModel(psf, camera, 0.0, ())
    size = 2 * (half + ceil(lens.wing_margin_px())) + 1
    point_like = bool(half <= POINT_LIKE * reach_px(psf, camera, 0.0, 0.0, CUT_SIGMA))
    level, per_wave = ACCURACY[point_like]
    passed = passband(psf, camera, 0.0, level)
    # As many waves as the lens passes, and as many samples as they need.
    waves = min(ceil(passed * size) + 1, MAX_WAVES)
    needed = ceil(per_wave * passband(psf, camera, 0.0, 1e-3))
    samples = max(2, min(needed, 3072 // size))
    f = np.arange(waves) / size
    # fy > 0 represents -fy too; fx = 0 is in both halves.
    weight = np.outer(np.where(f > 0, 1.0, 0.5), np.where(f > 0, 2.0, 1.0)) / size**2
    one_axis = pixel(camera.detector.intrapixel, f)
    weight *= np.outer(one_axis, one_axis)
    # Lens and pixel at (fx, fy) and at (-fx, fy).
    softening_px = softening_sigma_px(passed, f[-1])
    spectra = [weight * lens.otf(fx[:, None], f[None, :], softening_px) for fx in (f, -f)]
    # The waves at x = t + p / S.
    x = (np.arange(half + 1) + np.arange(samples)[:, None] / samples).ravel()
    phase = 2 * np.pi * np.outer(f, x)
    parts = [f, *map(np.real, spectra), *map(np.imag, spectra), np.cos(phase), np.sin(phase)]
    table = np.concatenate([part.ravel() for part in parts])
    return EllipseBox(waves, samples, table.astype(np.float32))


@lru_cache(maxsize=1)
def jinc_table() -> Singles:
    """2 J1(w) / w at w = 0, 1 / ENTRIES, ..., up to the argument of the largest image."""
    w = np.arange(1, 4096 * ENTRIES) / ENTRIES
    return np.concatenate([[1.0], 2 * special.j1(w) / w]).astype(np.float32)


@jit
def jinc(table: Singles, w: float) -> Any:
    """2 J1(w) / w and its slope, by linear interpolation: within 8e-6 and 4e-3.

    Unsigned indices save numba's check for negative ones.
    """
    at = min(w * np.float32(ENTRIES), np.float32(table.size - 2))
    k = np.uint64(at)
    step = table[k + np.uint64(1)] - table[k]
    return table[k] + (at - np.float32(k)) * step, step * np.float32(ENTRIES)


class EllipseDisk(NamedTuple):
    """One disk for compiled code, all in pixels.

    Attributes
    ----------
    center_x, center_y
        Center of the drawn image, from the image of the disk's center
    mean_x, mean_y
        Center of gravity of the light, from there
    xx, xy, yy
        Elements of A A^T
    slope_x, slope_y
        Slope of the light behind the blur, over the light at the center, per pixel
    gradient_x, gradient_y
        A q, which makes an odd part of the spectrum
    blur
        Radius of the defocus disk
    sigma
        Standard deviation of a Gaussian blur in addition to the lens's
    fade
        Reach of wings, where they are faded to zero; 0 for a lens without wings
    odd
        1 if the spectrum has an odd part, else 0
    """

    center_x: float
    center_y: float
    mean_x: float
    mean_y: float
    xx: float
    xy: float
    yy: float
    slope_x: float
    slope_y: float
    gradient_x: float
    gradient_y: float
    blur: float
    sigma: float
    fade: float
    odd: float


@jit
def spectrum(disk: EllipseDisk, f: Singles, lens: Singles, bessel: Singles) -> Singles:
    """Spectra of a disk with its lens and blur: step 2 of the module.

    The transform of a disk of density 1 + q e is J + i (A q f) 2 pi J' / w, with J(w) = 2 J1(w) / w and
    w^2 = (2 pi)^2 f^T A A^T f.

    Returns
    -------
    Singles
        (4, F, F), [l, m] at (f[l], f[m]): sum and difference of the spectra at (fx, fy) and (-fx, fy), of the real
        part, then of the imaginary part
    """
    waves = lens.shape[1]
    turn = np.float32(2 * np.pi)
    out = np.zeros((4, waves, waves), np.float32)
    gauss = np.exp(np.float32(-2 * (np.pi * disk.sigma) ** 2) * f * f)
    radius = np.float32(disk.blur)
    xx = np.float32(disk.xx)
    xy = np.float32(disk.xy)
    yy = np.float32(disk.yy)
    for i in range(waves):
        for j in range(waves):
            # Gaussian and defocus disk depend on |f| alone.
            common = gauss[i] * gauss[j]
            if radius > 0:
                common *= jinc(bessel, turn * radius * np.sqrt(f[i] * f[i] + f[j] * f[j]))[0]
            # The argument w at (fx, fy), and v at (-fx, fy).
            squares = xx * f[i] * f[i] + yy * f[j] * f[j]
            cross = np.float32(2) * xy * f[i] * f[j]
            w = turn * np.sqrt(max(squares + cross, 0))
            v = turn * np.sqrt(max(squares - cross, 0))
            (p, p_slope), (q, q_slope) = jinc(bessel, w), jinc(bessel, v)
            # A real spectrum, or a complex one: (lens real + i lens imaginary) (p + i tilt).
            if disk.odd == 0:
                a = common * lens[0, i, j] * p
                b = common * lens[1, i, j] * q
            else:
                along = disk.gradient_x * f[i]
                aside = disk.gradient_y * f[j]
                tilt_p = turn * (aside + along) * p_slope / max(w, np.float32(1e-9))
                tilt_q = turn * (aside - along) * q_slope / max(v, np.float32(1e-9))
                a = common * (lens[0, i, j] * p - lens[2, i, j] * tilt_p)
                b = common * (lens[1, i, j] * q - lens[3, i, j] * tilt_q)
                c = common * (lens[0, i, j] * tilt_p + lens[2, i, j] * p)
                d = common * (lens[1, i, j] * tilt_q + lens[3, i, j] * q)
                out[2, i, j] = c + d
                out[3, i, j] = c - d
            out[0, i, j] = a + b
            out[1, i, j] = a - b
    return out


@jit(fastmath=True)
def product(a: Singles, b: Singles) -> Singles:
    """a^T b, four rows of the factors at a time."""
    out = np.zeros((a.shape[1], b.shape[1]), np.float32)
    whole = len(a) // 4 * 4
    for r in range(len(out)):
        row = out[r]
        for k in range(0, whole, 4):
            w0 = a[k, r]
            w1 = a[k + 1, r]
            w2 = a[k + 2, r]
            w3 = a[k + 3, r]
            for i in range(row.size):
                row[i] += (
                    w0 * b[k, i] + w1 * b[k + 1, i] + w2 * b[k + 2, i] + w3 * b[k + 3, i]
                )
        for k in range(whole, len(a)):
            w = a[k, r]
            for i in range(row.size):
                row[i] += w * b[k, i]
    return out


@jit(fastmath=True)
def quadrants(spectra: Singles, cosine: Singles, sine: Singles, odd: float) -> Singles:
    """Sum the waves of a separable Fourier series: step 3 of the module.

    cos(a + b) = cos a cos b - sin a sin b and sin(a + b) = sin a cos b + cos a sin b, so these four parts give the
    image in every quadrant.

    Returns
    -------
    Singles
        (4, M, M) parts at x, y >= 0, [y, x]: cos cos and sin sin of the real part, sin cos and cos sin of the imaginary
    """
    out = np.zeros((4, cosine.shape[1], cosine.shape[1]), np.float32)
    out[0] = product(cosine, product(spectra[0], cosine))
    out[1] = product(sine, product(spectra[1], sine))
    if odd > 0:
        out[2] = product(cosine, product(spectra[3], sine))
        out[3] = product(sine, product(spectra[2], cosine))
    return out


@jit
def mirrored(position: int, phase: int, samples: int, count: int) -> Any:
    """Index of |position + phase / S| in the quadrants' order, and the sign of position + phase / S."""
    if position >= 0:
        return phase * count + position, np.float32(1)
    return ((samples - phase) * count - position - 1 if phase else -position), np.float32(-1)


@jit(fastmath=True)
def unfold(parts: Singles, samples: int, half: int, disk: EllipseDisk) -> Singles:
    """The image from its four parts, with the disk's slope applied and negative ringing cut: step 4 of the module.

    Returns
    -------
    Singles
        (S, n, S n) samples [q, j, p n + i] of the image at (i + p / S, j + q / S), for n x n pixels,
        n = 2 (half + PAD) + 1; pixel (half + PAD, half + PAD) is at the image's center
    """
    size = 2 * (half + PAD) + 1
    count = half + 1
    middle = half + PAD
    none = np.float32(0)
    out = np.zeros((samples, size, samples * size), np.float32)
    slope = np.float32(disk.slope_x)
    for q in range(samples):
        for j in range(-half, half + 1):
            # The row of the parts, and the sign of y.
            r, up = mirrored(j, q, samples, count)
            even0 = parts[0, r]
            even1 = parts[1, r]
            odd0 = parts[2, r]
            odd1 = parts[3, r]
            # Even parts to the right of the center, then mirrored to the left.
            for p in range(samples):
                row = out[q, middle + j, p * size : (p + 1) * size]
                right = p * count
                left = mirrored(-1, p, samples, count)[0]
                for i in range(half + 1):
                    row[middle + i] = even0[right + i] - up * even1[right + i]
                for i in range(half):
                    row[middle - 1 - i] = even0[left + i] + up * even1[left + i]
                # Odd parts change their sign with x.
                if disk.odd > 0:
                    for i in range(half + 1):
                        row[middle + i] -= odd0[right + i] + up * odd1[right + i]
                    for i in range(half):
                        row[middle - 1 - i] += odd0[left + i] - up * odd1[left + i]
                # 1 + slope (position) of the disk's light; ringing below zero is cut.
                light = np.float32(
                    1
                    + disk.slope_x * (p / samples - middle)
                    + disk.slope_y * (j + q / samples)
                )
                for i in range(size):
                    row[i] = max(row[i] * (light + slope * np.float32(i)), none)
    return out


@jit(fastmath=True)
def fade(table: Singles, reach_px: float) -> None:
    """Fade wings to zero over FADE_PX, since a sharp end would alias with the pixel grid, and scale the light to 1.

    The factor is 3 s^2 - 2 s^3, s from 1 to 0 over the last FADE_PX of the reach. In place.
    """
    samples = table.shape[0]
    size = table.shape[1]
    total = 0.0
    for q in range(samples):
        for j in range(size):
            v = (j - size // 2 + q / samples) ** 2
            for p in range(samples):
                for i in range(size):
                    r = sqrt((i - size // 2 + p / samples) ** 2 + v)
                    s = min(max((reach_px - r) / FADE_PX, 0.0), 1.0)
                    table[q, j, p * size + i] *= np.float32(s * s * (3 - 2 * s))
                    total += table[q, j, p * size + i]
    table *= np.float32(samples * samples / total)


@jit(fastmath=True)
def sharpest_px(table: Singles) -> float:
    """Half the peak over the steepest slope, like `Kernel.sharp_px`, by differences of samples."""
    samples = table.shape[0]
    size = table.shape[1]
    peak = np.float32(0)
    slope2 = np.float32(0)
    for q in range(samples - 1):
        for j in range(size):
            row = table[q, j]
            below = table[q + 1, j]
            for i in range(size):
                x = row[i + size] - row[i]
                y = below[i] - row[i]
                slope2 = max(slope2, x * x + y * y)
                peak = max(peak, row[i])
    return peak / (2 * samples * sqrt(slope2))


@jit
def ellipse_table(
    disk: EllipseDisk, box: Singles, waves: int, samples: int, bessel: Singles
) -> Singles:
    """The image of a disk for `add_ellipse`, from the tables of its box, by steps 2 to 4; its light is 1."""
    square = waves * waves
    # Unpack `EllipseBox.table`.
    count = (box.size - waves - 4 * waves * waves) // (2 * waves)
    f = box[:waves]
    lens = box[waves : waves + 4 * square].reshape(4, waves, waves)
    wave = box[waves + 4 * square :].reshape(2, waves, count)
    parts = quadrants(spectrum(disk, f, lens, bessel), wave[0], wave[1], disk.odd)
    table = unfold(parts, samples, count // samples - 1, disk)
    if disk.fade > 0:
        fade(table, disk.fade)
    return table


@jit(fastmath=True)
def add_ellipse(
    patch: Floats, row0: int, row1: int, x: float, y: float, electrons: float, table: Singles
) -> None:
    """Add an image from its samples (`unfold`), by Lagrange's cubic through 4 x 4 of them, along y first.

    All pixels of an image have the same sixteen weights, since the samples repeat with the pixels.
    """
    samples = table.shape[0]
    size = table.shape[1]
    half = size // 2 - PAD
    center_x = floor(x + 0.5)
    center_y = floor(y + 0.5)
    left, right, top, bottom = reached(patch, row0, row1, center_x, center_y, half)
    if right <= left or bottom <= top:
        return
    # Place of the first pixel among the samples, and the weights of the four samples on either axis.
    at_x = (center_x - x) * samples
    at_y = (center_y - y) * samples
    first_x = floor(at_x)
    first_y = floor(at_y)
    wx = cubic(at_x - first_x)
    wy = cubic(at_y - first_y)
    u0 = np.float32(wx[0])
    u1 = np.float32(wx[1])
    u2 = np.float32(wx[2])
    u3 = np.float32(wx[3])
    v0 = np.float32(wy[0])
    v1 = np.float32(wy[1])
    v2 = np.float32(wy[2])
    v3 = np.float32(wy[3])
    # Phase and pixel of the four samples: along y rows of the table, along x offsets into a row.
    phase = np.empty(4, np.int64)
    row = np.empty(4, np.int64)
    start = np.empty(4, np.int64)
    for s in range(4):
        phase[s] = (first_y + s - 1) % samples
        row[s] = size // 2 - center_y + (first_y + s - 1) // samples
        k = first_x + s - 1
        start[s] = k % samples * size + size // 2 + left - center_x + k // samples
    sums = np.empty(table.shape[2], np.float32)
    a = sums[start[0] :]
    b = sums[start[1] :]
    c = sums[start[2] :]
    d = sums[start[3] :]
    for j in range(top, bottom):
        first = table[phase[0], row[0] + j]
        second = table[phase[1], row[1] + j]
        third = table[phase[2], row[2] + j]
        fourth = table[phase[3], row[3] + j]
        # Along y, then along x.
        for i in range(sums.size):
            sums[i] = v0 * first[i] + v1 * second[i] + v2 * third[i] + v3 * fourth[i]
        line = patch[j, left:right]
        for i in range(line.size):
            line[i] += electrons * (u0 * a[i] + u1 * b[i] + u2 * c[i] + u3 * d[i])
