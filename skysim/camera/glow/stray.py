"""Stray light in a lens and in a dome: ghosts, veiling glare, and what the wall reflects.

Ghosts are light that two surfaces of a lens reflect, so that it reaches the chip a second time. To first order the
reflected light has a focal length of its own: a pair of surfaces images the field again, m times as large, through the
same axis, and out of focus. A light at x on the chip has its ghost at

    c - m (x - c),

with the principal point c; m > 0 puts the ghost on the other side. A ghost takes part in motion, pulses, shutter and
vignetting like its light.

Glare is light that rough or dirty surfaces scatter over the chip (`add_glare`). The wall of a dome glows with the light
that it scatters (`wall_glow`), and LEDs are mirrored in it (`mirror.mirrored`).
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import scipy
from scipy import special

from skysim.camera.glow.background import PointedCamera, unproject
from skysim.camera.optics import Optics
from skysim.core.types import UP, Array, Floats, SourceTruth, grid_points, lengths, positive
from skysim.scene.sections.camera import DiskPsfConfig, GhostConfig, GlareConfig
from skysim.sources.dome.interreflection import DiffuseLight, ReflectingDome
from skysim.sources.satellites import GHOST

BLUR_PX = 0.7  # sigma of the edge of a ghost's disk


@lru_cache(maxsize=64)
def ghost_optics(optics: Optics, ghost: GhostConfig) -> Optics:
    """The lens as a pair of surfaces images through it: `share` of the light, spread over a disk.

    Its field contains every light whose ghost reaches the chip.
    """
    blur = DiskPsfConfig(kind="disk", radius_px=ghost.radius_px, sigma_px=BLUR_PX)
    camera = optics.camera.with_values(psf=blur, lens_table=None)
    reach = (1 + ghost.radius_px / camera.corner_px) / abs(ghost.magnification)
    field_rad = math.atan(math.tan(optics.field_rad) * reach)
    collecting_m2 = optics.collecting_m2 * ghost.share
    scale = -ghost.magnification * (optics.scale or 1.0)
    return Optics(camera, collecting_m2, optics.fold_r, field_rad, scale=scale)


def as_ghosts(lights: SourceTruth, number: int) -> SourceTruth:
    """The truth of lights that were drawn through a pair of surfaces, numbered as its ghosts; pairs count from 1."""
    return replace(lights, id=lights.id + number * GHOST) if number else lights


# Veiling glare.


# Least number of blocks of pixels across the core: a light is displaced by less than a 16th of it.
BLOCKS = 8


def add_glare(light_e: Array, config: GlareConfig) -> None:
    """Scatter the fraction `share` of the light of an (H, W) frame by the glare-spread function, in place.

    Polished surfaces scatter by the law of Harvey and Shack, BSDF = b (1 + (sin(theta) / l)^2)^(s / 2), the ABg law
    with a round shoulder (Stover, Optical Scattering, 3rd ed., ch. 4). On the chip that is, around each image,

        g(r) = (n - 2) / (2 pi a^2) (1 + (r / a)^2)^(-n / 2),    n > 2,

    with unit integral.

    1. Bin the frame in blocks that are small against the core a.
    2. Convolve with g as if the field went on beside the chip as its mirror image: as much light enters as leaves, so
       that the total is conserved, and uniform light stays uniform. That is a product of cosine transforms.
    3. Interpolate, and take the scattered light from the images.
    """
    # 1. Mean of each block.
    block = block_px(light_e.shape, config.core_px)
    height, width = (size // block for size in light_e.shape)
    coarse = light_e.reshape(height, block, width, block).mean(axis=(1, 3), dtype=float)
    # 2. Product with the transform of g.
    spectrum = scipy.fft.dctn(coarse, type=2, norm="ortho") * transfer(
        config, (height, width), block
    )
    scattered = scipy.fft.idctn(spectrum, type=2, norm="ortho").astype(light_e.dtype)
    # 3. Back to pixels; `share` of the light is scattered.
    fine = scipy.ndimage.zoom(scattered, block, order=1, mode="reflect", grid_mode=True)
    light_e *= 1 - config.share
    light_e += config.share * fine


def block_px(shape: tuple[int, ...], core_px: float) -> int:
    """Side in pixels of the square blocks in which glare is computed: a divisor of both of the frame's sides."""
    common = math.gcd(*shape)
    largest = max(int(core_px / BLOCKS), 1)
    return max(n for n in range(1, largest + 1) if common % n == 0)


@lru_cache(maxsize=4)
def transfer(config: GlareConfig, shape: tuple[int, int], block: int) -> Floats:
    """(h, w) the Fourier transform of g at the frequencies of the blocks' cosine transform (Matern's).

    G(k) = 2^(1 - v) / Gamma(v) (a k)^v K_v(a k), v = n / 2 - 1, at the angular frequency k.
    """
    order = config.exponent / 2 - 1
    rows, columns = (np.pi * np.arange(size) / (size * block) for size in shape)
    scaled = config.core_px * np.hypot(rows[:, None], columns)
    # K_v is infinite at 0, where the limit of the product is 1.
    scaled[0, 0] = 1.0
    values = (
        2 ** (1 - order) / special.gamma(order) * scaled**order * special.kv(order, scaled)
    )
    values[0, 0] = 1.0
    return values


def without_glare(sources: SourceTruth, config: GlareConfig) -> SourceTruth:
    """The truth of images that lost the scattered fraction of their light."""
    kept = 1 - config.share
    return replace(sources, electrons=kept * sources.electrons, peak_e=kept * sources.peak_e)


# The light that a dome reflects: the glow of wall and floor, and images of LEDs in the wall.


# Rows and columns of places on the chip at which the wall's light is computed.
IRRADIANCE = 16, 21
# Rows and columns of directions on the chip from which images in the wall are searched.
GRID = (28, 36)
MARGIN = 0.15  # of the chip's size, beyond its edges, for images of LEDs that reach in


def wall_glow(dome: ReflectingDome, camera: PointedCamera) -> Floats:
    """(h, w) electrons s^-1 px^-1 of wall and floor at the nodes of `background.glow_map`.

    The radiance rho E / pi of a Lambertian surface times the etendue of the pixels.

    1. Directions of the nodes; the irradiance E varies slowly and is computed at fewer places (`IRRADIANCE`).
    2. Where the wall is seen: its light, interpolated.
    3. Where the floor is seen: its light. Beyond wall and floor it is dark.

    Nothing is in front of wall and floor. The rim is smoothed over the distance of two nodes. A camera outside of the
    wall sees nothing.
    """
    # 1.
    optics, cam_from_lab, camera_m, _ = camera
    view = camera.nodes()
    shape = view.shape
    if dome.diffuse is None or not dome.wall.inside(camera_m):
        return np.zeros(shape)
    few = (chip_grid(optics, IRRADIANCE, 0.0) @ cam_from_lab.as_matrix()).reshape(-1, 3)
    # 2. Rays that meet the wall above the rim.
    seen = np.isfinite(dome.wall.meet(camera_m, view.toward_lab)[:, 0])
    wall_m = camera_m + dome.wall.exit_m(camera_m, few)[:, None] * few
    wall_light = spread(dome.diffuse, wall_m, dome.wall.inward(wall_m), shape)
    radiance = seen * dome.config.diffuse * wall_light
    # 3. Rays that meet the floor instead.
    if dome.config.floor:
        depth_m = camera_m[2] + dome.config.floor.depth_m
        floor_m = camera_m + meeting(few, depth_m)
        up = np.tile(UP, (len(floor_m), 1))
        met_m = camera_m + meeting(view.toward_lab, depth_m)
        axis_m = lengths(met_m[:, :2])
        on_floor = ~seen & (axis_m < dome.config.floor.radius_m)
        floor_light = spread(dome.diffuse, floor_m, up, shape)
        radiance += on_floor * dome.config.floor.share * floor_light
    return (radiance / np.pi * view.etendue_m2_sr()).reshape(shape)


def meeting(toward: Floats, depth_m: float) -> Floats:
    """(N, 3) offsets along unit vectors to a level plane depth_m below; NaN for vectors that do not point down."""
    return toward * (depth_m / positive(-toward[:, 2]))[:, None]


def spread(
    diffuse: DiffuseLight, points_m: Floats, normals: Floats, shape: tuple[int, int]
) -> Floats:
    """(h * w,) irradiance at the nodes, linear between values at the IRRADIANCE points."""
    values = np.nan_to_num(diffuse.irradiance_e_s_m2(points_m, normals)).reshape(IRRADIANCE)
    places = (np.linspace(0, 1, count) for count in IRRADIANCE)
    nodes = (np.linspace(0, 1, count) for count in shape)
    return scipy.interpolate.RectBivariateSpline(*places, values, kx=1, ky=1)(*nodes).ravel()


@lru_cache(maxsize=8)
def chip_grid(optics: Optics, shape: tuple[int, int], margin: float) -> Floats:
    """(h, w, 3) unit vectors in camera axes, evenly spread over the chip and `margin` of its size."""
    camera = optics.camera
    rows, columns = (
        np.linspace(-margin * size, (1 + margin) * size, count) - 0.5
        for size, count in zip((camera.height_px, camera.width_px), shape, strict=True)
    )
    return unproject(grid_points(columns, rows), optics).reshape(*shape, 3)
