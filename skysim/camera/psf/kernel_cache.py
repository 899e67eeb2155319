"""Assign each source of a frame its kernel: look kernels up, share them, and lay them out for compiled code.

Sources of one size share a kernel: sizes are rounded to QUANTUM_PX, and three of them (Gaussian blur, emitter's disk,
defocus disk) are the key of a kernel in the camera's cache. Disks that are visibly elliptical get an image of their own
in each exposure (psf/ellipse.py); they share the tables of their box.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from skysim.camera.optics import Optics
from skysim.camera.psf import ellipse
from skysim.camera.psf.kernel import (
    ELLIPSE,
    GAUSS,
    GRID,
    QUANTUM_PX,
    DiskImages,
    build_kernel,
    reach_px,
)
from skysim.camera.psf.otf import (
    NOT_ROUND,
    WINGED,
    blur_radius_px,
    chromatic_sigma_px,
    field_sigma_px,
)
from skysim.core.errors import InputError
from skysim.core.types import Floats, Ints, Singles, Sources, taken
from skysim.scene.sections.camera import CameraConfig, Psf

BOX_KEY = -1  # first number of the key of an ellipse's box; those of kernels are sizes
# Error, in units of the peak, below which a disk is drawn by its round image.
MAX_ROUND_ERROR = 1e-4
# Packs three sizes, in steps of 0.01 px, into one integer.
PACKING = np.array([1 << 42, 1 << 21, 1])


class Kernels(NamedTuple):
    """The pixel-integrated images of N sources.

    Attributes
    ----------
    kind
        (N,) GAUSS, ROUND, GRID or ELLIPSE
    sigma_px
        (N,) standard deviation of a Gaussian
    reach_px
        (N,) distance in x or in y beyond which there is no light
    sharp_px
        (N,) size of the sharpest feature (as of `Kernel`); 1 for an ellipse, whose table is built later
    table
        (N, 4) begin and end of the source's table in `tables`, and two sizes of its shape
    tables
        All tables that are needed, end to end
    disk
        (N, 15) fields of `ellipse.EllipseDisk`; zeros for other kinds
    bessel
        The table for `ellipse.jinc`; empty without ellipses
    parts
        (N, K, 3) spots of which an image is made by lateral color: shares of the light, and displacements in px
    """

    kind: Ints
    sigma_px: Floats
    reach_px: Floats
    sharp_px: Floats
    table: Ints
    tables: Singles
    disk: Floats
    bessel: Singles
    parts: Floats


NO_TABLE = np.empty(0, np.float32)


@dataclass
class KernelCache:
    """A camera's kernels, their tables laid end to end in the order of first use.

    Attributes
    ----------
    kernels
        Kind, sigma_px, reach_px and sharp_px of each key's kernel, and its row of `Kernels.table`
    tables
        All tables joined
    """

    kernels: dict[tuple[int, ...], tuple[float, ...]]
    tables: Singles


CACHE_BYTES = 1 << 27  # the cache is emptied when it is larger than this
# Largest radius of an image; tables of larger ones would take too much memory
MAX_RADIUS_PX = 500.0
COMA_PX = 0.1  # step of coma along x and y


@lru_cache(maxsize=16)
def kernel_cache(camera: CameraConfig) -> KernelCache:
    """The kernel cache of a camera, empty at first."""
    return KernelCache({}, NO_TABLE)


def source_kernels(
    sources: Sources,
    optics: Optics,
    xy_px: Floats,
    distance_m: Floats,
    cos_field: Floats,
    disks: DiskImages | None = None,
) -> Kernels:
    """The kernels of N sources.

    A disk is drawn as a circle of angular radius radius / distance where that differs from its image in `disks` by less
    than MAX_ROUND_ERROR. LEDs may be out of focus by their own distance_m; stars are at infinity.

    1. Widths of the blurs and radii of the disks of each source.
    2. Disks that a circle does not represent get an ellipse.
    3. Look each source's kernel up by its rounded sizes; make those that are missing.
    4. Widen the exact Gaussians, which are not rounded, by the blurs of each source.

    Lateral color makes several spots along the radius of each image, by the quadrature of its light.

    Parameters
    ----------
    xy_px
        (N, 2) image positions, for the blur that grows with the field; NaN is taken as the principal point
    cos_field
        (N,) cosines of the angles from the boresight
    disks
        Geometric images of the disks, NaN for stars; None draws all disks round

    Raises
    ------
    InputError
        For a source too far out of focus.
    """
    camera = optics.camera
    chromatic = sources.chromatic
    if chromatic is None:
        # No shift, and one node that has all of the light.
        chromatic = np.eye(1, 6, 5).repeat(len(sources), 0)
    is_led = sources.place[:, 3] > 0
    # 1. Gaussian blurs add in squares.
    position = np.where(np.isnan(xy_px), camera.center_px, xy_px)
    sigma = np.hypot(field_sigma_px(camera, position), optics.blur_px)
    sigma = np.hypot(sigma, chromatic_sigma_px(camera, chromatic))
    emitter = np.where(is_led, sources.radius_m / distance_m, 0.0) * camera.focal_px
    # Defocus depends on the distance along the boresight.
    axial_m = np.where(is_led, distance_m * np.maximum(cos_field, 1e-6), np.inf)
    defocus = blur_radius_px(camera, axial_m, chromatic[:, 0])
    # Sources far outside the frame have no image.
    outside_px = np.maximum(-position, position - camera.size_px)
    near = np.maximum(*outside_px.T)[:, None] < MAX_RADIUS_PX
    radii_px = np.where(near, np.column_stack([emitter, defocus]), 0.0)
    axes_px = radii_px[:, [0, 0]] if disks is None else disks.semi_axes_px()
    check_radii(radii_px, axes_px)
    keys = np.rint(np.column_stack([sigma, radii_px]) / QUANTUM_PX).astype(np.int64)
    # 2. Ellipses.
    disk = ellipses(keys, camera, disks, axes_px, sigma, *radii_px.T)
    # 3. Gaussians need no shared table, so all have the key of sharp points.
    coma_px = camera.along_radius("coma_um", camera.psf.coma_px, position)
    gaussian = camera.psf.kind == "gaussian" and not (
        camera.detector.intrapixel or coma_px.any()
    )
    if gaussian:
        keys[keys[:, 1] + keys[:, 2] == 0, 0] = 0
    if coma_px.any():
        coma_px[disk.any(axis=1)] = 0
        keys = np.column_stack([keys, np.rint(coma_px / COMA_PX).astype(np.int64)])
    nodes_px, shares = np.split(chromatic[:, 4:, None], 2, axis=1)
    spots_px = camera.along_radius("lateral", nodes_px, position[:, None])
    parts = np.concatenate([shares, spots_px], axis=2)
    kernels = look_up(camera, keys, disk, parts)
    # 4. Widening.
    if gaussian and sigma.any():
        kernels = widened(kernels, sigma)
    return kernels


def check_radii(radii_px: Floats, axes_px: Floats) -> None:
    """Raise InputError for an image, of a disk with semi-axes axes_px (N, 2), larger than MAX_RADIUS_PX."""
    emitter_px, defocus_px = radii_px.T
    widest = np.where(emitter_px > 0, np.fmax(emitter_px, axes_px[:, 0]), 0)
    largest = (widest + defocus_px).max(initial=0.0)
    if largest > MAX_RADIUS_PX:
        raise InputError(
            "camera.focus",
            f"a source's image, {defocus_px.max():.0f} px out of focus, has a radius of {largest:.0f} px",
            f"up to {MAX_RADIUS_PX:.0f} px",
        )


def ellipses(
    keys: Ints,
    camera: CameraConfig,
    disks: DiskImages | None,
    axes_px: Floats,
    sigma: Floats,
    emitter: Floats,
    defocus: Floats,
) -> Floats:
    """(N, 15) fields of `ellipse.EllipseDisk` of the disks that a circle does not represent, zeros for others.

    Their rows of `keys` become the keys of their boxes.

    Parameters
    ----------
    sigma, emitter, defocus
        (N,) standard deviations of the Gaussian blurs in addition to the lens's, radii of the emitters' disks and of
        the defocus disks, px
    """
    disk = np.zeros((len(keys), len(ellipse.EllipseDisk._fields)))
    if disks is None:
        return disk
    # A Gaussian of this variance has the peak of a point's image: sum of lens, blur and defocus disk.
    lens_px2 = 1 / (2 * np.pi * build_kernel(camera.psf, camera).peak)
    variance_px2 = lens_px2 + sigma**2 + defocus**2 / 4
    error = round_error(disks, axes_px, emitter, variance_px2)
    chosen = np.flatnonzero((emitter > 0) & (error > MAX_ROUND_ERROR))
    own = (part[chosen] for part in (axes_px, defocus, sigma, variance_px2))
    disk[chosen], keys[chosen] = ellipse_disks(camera.psf, camera, taken(disks, chosen), *own)
    return disk


def look_up(camera: CameraConfig, keys: Ints, disk: Floats, parts: Floats) -> Kernels:
    """The kernels of N keys (N, 3 or 5) in the camera's cache, with ellipses and parts; makes the missing ones."""
    cache = kernel_cache(camera)
    # Sizes pack into integers, which sort faster than rows; those with coma do not.
    codes = keys if keys.shape[1] > len(PACKING) else keys @ PACKING
    # Stars in focus share one key, which saves the sort.
    first = np.zeros(1, int)
    inverse = np.zeros(len(codes), int)
    if codes.any() or not codes.size:
        _, first, inverse = np.unique(codes, axis=0, return_index=True, return_inverse=True)
    used = [tuple(key) for key in keys[first].tolist()]
    add_kernels(cache, camera, used)
    # Contiguous: columns of a table would be another array type, for which the renderer is compiled once more.
    properties = np.array([cache.kernels[key] for key in used]).reshape(-1, 8)[inverse]
    kind, sigma, reach, sharp = np.ascontiguousarray(properties[:, :4].T)
    reach += np.abs(parts[..., 1:]).max((1, 2))
    spans = properties[:, 4:].astype(np.int64)
    # The Bessel table takes a while to build.
    bessel = ellipse.jinc_table() if disk.any() else NO_TABLE
    return Kernels(
        kind.astype(np.int64),
        sigma,
        reach,
        sharp,
        spans,
        cache.tables,
        disk,
        bessel,
        parts,
    )


def widened(kernels: Kernels, extra_px: Floats) -> Kernels:
    """The kernels with their Gaussians blurred by further Gaussians of these standard deviations (N,).

    Standard deviation and sharpness grow in proportion, the reach with them.
    """
    point = kernels.kind == GAUSS
    sigma_px = np.where(point, kernels.sigma_px, 1)
    widening = np.where(point, np.hypot(sigma_px, extra_px) / sigma_px, 1)
    return kernels._replace(
        sigma_px=kernels.sigma_px * widening,
        reach_px=kernels.reach_px * np.maximum(widening, 1),
        sharp_px=kernels.sharp_px * widening,
    )


def round_error(
    disks: DiskImages, axes_px: Floats, drawn_px: Floats, variance_px2: Floats
) -> Floats:
    """(N,) estimate of the largest error, over the peak, of disks drawn as circles about their centers.

    The disks have the semi-axes axes_px (N, 2), the circles the radii drawn_px (N,). Behind a blur of variance s^2 the
    edge of a wide disk has the slope 0.4 / s; a radius a of a small one makes the image wider by a^2 / 4, and so its
    peak less by a^2 / 8 s^2. A shifted image differs by up to 0.6 / s a pixel, and so does the gradient of a small
    disk, which shifts the image; the gradient of a wide disk is an error of its own size. NaN where a disk has no
    image.
    """
    s_px = np.sqrt(variance_px2)
    edge_px = np.abs(axes_px - drawn_px[:, None]).max(axis=1)
    shift_px = np.hypot(*disks.center.T)
    gradient_px = np.hypot(*disks.gradient.T)
    gradient = np.minimum(
        gradient_px / np.maximum(axes_px[:, 1], 1e-9), 0.15 * gradient_px / s_px
    )
    return (np.minimum(0.4, drawn_px / 2 / s_px) * edge_px + 0.6 * shift_px) / s_px + gradient


def ellipse_disks(
    psf: Psf,
    camera: CameraConfig,
    disks: DiskImages,
    axes_px: Floats,
    blur_px: Floats,
    sigma_px: Floats,
    variance_px2: Floats,
) -> tuple[Floats, Ints]:
    """The fields of `ellipse.EllipseDisk` of M disks (M, 15), and the keys of their boxes (M, 3).

    Behind a Gaussian blur of variance s^2 a light I (1 + g x) becomes (1 + g x) I + s^2 g dI/dx: the blurred I, shifted
    by -s^2 g, times (1 + g x). A disk smaller than its blur is only shifted by its gradient. For a lens with wings or
    one that is not round the gradient is in the spectrum.

    Parameters
    ----------
    axes_px
        (M, 2) semi-axes of the disks' images, the larger one first
    blur_px, sigma_px
        (M,) radii of the defocus disks, and sigmas of the Gaussian blurs in addition to the lens's
    variance_px2
        (M,) s^2 of the blur behind which the disks are seen
    """
    matrix, center, gradient = disks
    # A A^T.
    square = matrix @ matrix.transpose(0, 2, 1)
    xx = square[:, 0, 0]
    xy = square[:, 0, 1]
    yy = square[:, 1, 1]
    mean = center + gradient / 4
    zero = np.zeros_like(gradient)
    winged = psf.kind in WINGED
    odd = psf.kind in WINGED + NOT_ROUND
    wide = (axes_px[:, 1] > 1.5 * np.sqrt(variance_px2))[:, None]
    # The slope g solves A A^T g = A q, by Cramer's rule.
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.column_stack(
            [
                yy * gradient[:, 0] - xy * gradient[:, 1],
                xx * gradient[:, 1] - xy * gradient[:, 0],
            ]
        )
        slope = np.where(wide, inverse / (xx * yy - xy**2)[:, None], 0)
    # Where the image is drawn, and what its light does across it.
    drawn = center if odd else np.where(wide, center - variance_px2[:, None] * slope, mean)
    parts = (zero, gradient) if odd else (slope, zero)
    # With wings the reach is that of a circle, where they are faded; else that along x and y.
    radius_px = axes_px[:, 0] if winged else np.sqrt(np.maximum(xx, yy))
    reach = reach_px(psf, camera, radius_px + blur_px, sigma_px, ellipse.CUT_SIGMA)
    one = np.ones_like(xx)
    half_px = ellipse.box_half_px(reach + np.abs(drawn).max(axis=1))
    disk = np.column_stack(
        [drawn, mean, xx, xy, yy, *parts, blur_px, sigma_px, reach * winged, odd * one]
    )
    return disk, np.column_stack([BOX_KEY * one, half_px, 0 * one]).astype(np.int64)


def add_kernels(
    cache: KernelCache, camera: CameraConfig, keys: list[tuple[int, ...]]
) -> None:
    """Make the kernels that the cache does not hold yet; empty the cache first if it is over CACHE_BYTES.

    Raises
    ------
    InputError
        For kernels that take more than twice CACHE_BYTES.
    """
    if cache.tables.nbytes > CACHE_BYTES:
        cache.kernels.clear()
        cache.tables = NO_TABLE
    tables = [cache.tables]
    begin = len(cache.tables)
    # Each missing key once, in order.
    for key in dict.fromkeys(key for key in keys if key not in cache.kernels):
        properties, sizes, table = make_kernel(camera, key)
        cache.kernels[key] = (*properties, begin, begin + table.size, *sizes)
        tables.append(table.ravel())
        begin += table.size
        if 4 * begin > 2 * CACHE_BYTES:
            raise InputError(
                "camera.psf",
                f"images of different sizes take more than {2 * CACHE_BYTES >> 20} MB",
                "a smaller table, or corner_sigma_px: 0",
            )
    if len(tables) > 1:
        cache.tables = np.concatenate(tables)


def make_kernel(
    camera: CameraConfig, key: tuple[int, ...]
) -> tuple[tuple[int, float, float, float], tuple[int, int], Singles]:
    """Make the kernel of a key: a row of `KernelCache.kernels`, two sizes of its table's shape, and the table."""
    if key[0] == BOX_KEY:
        box = ellipse.ellipse_box(camera.psf, camera, key[1])
        return (ELLIPSE, 0.0, key[1] + 0.5, 1.0), (box.waves, box.samples), box.table
    sigma_px, emitter_px, defocus_px = (n * QUANTUM_PX for n in key[:3])
    coma_px = tuple(n * COMA_PX for n in key[3:])
    kernel = build_kernel(camera.psf, camera, sigma_px, emitter_px, defocus_px, coma_px)
    # A grid's first two sides are equal.
    sizes = kernel.table.shape[1:3] if kernel.kind == GRID else kernel.table.shape
    properties = (kernel.kind, kernel.sigma_px, kernel.reach_px, kernel.sharp_px)
    return properties, sizes, kernel.table
