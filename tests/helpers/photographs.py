"""Photographs as people take them.

The renderer is independent of skysim's: stars of the catalog are drawn as Gaussians, disks out of focus or trails in
linear light, on a sky with noise, and pass through a tone curve to 8 bits and JPEG. Each case has the nuisance it is
named for. The starless cases have it too, or lights at random: no answer to them is right.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import erf

from estimator.catalog import catalog
from estimator.core.camera import Camera

# level of the sky and full scale in standard deviations of its noise
SKY = 30.0
FULL = 400.0
GAMMA = 1 / 2.2
WRONG_RAD = math.radians(0.5)
EPOCH = 2020


@dataclass(frozen=True)
class Shot:
    """One picture to draw: lens, sharpness and what spoils it.

    limit_mag : of a star that is ten standard deviations of its own footprint's noise
    radius_px : of stars out of focus;  trail : (dx, dy) of all stars, and their turn about the middle, rad
    spoil     : change the linear light;  print : change the 8-bit picture
    """

    width_px: int
    height_px: int
    fov_deg: float
    limit_mag: float
    sigma_px: float = 1.1
    radius_px: float = 0.0
    trail: tuple[float, float, float] = (0.0, 0.0, 0.0)
    corner_distortion: float = 0.0
    spoil: Callable[[NDArray, np.random.Generator], None] | None = None
    print: Callable[[NDArray, np.random.Generator], None] | None = None
    starless: bool = False
    quality: int = 92

    @property
    def camera(self) -> Camera:
        """Its camera: a pinhole with the first radial distortion."""
        camera = Camera.from_fov(self.width_px, self.height_px, math.radians(self.fov_deg))
        r2 = (self.width_px**2 + self.height_px**2) / 4 / camera.focal_px**2
        return replace(camera, distortion=(self.corner_distortion / r2, 0.0, 0.0, 0.0, 0.0))


def draw(
    shot: Shot, stars: catalog.StarCatalog, vectors: NDArray, rng: np.random.Generator
) -> tuple[NDArray, Rotation]:
    """The 8-bit picture of a shot at a random attitude, and the attitude, cam_from_icrs."""
    camera = shot.camera
    cam_from_icrs = Rotation.random(rng=rng)
    seen = cam_from_icrs.apply(vectors)
    ahead = seen[:, 2] > math.cos(1.05 * math.atan(math.tan(camera.diagonal_rad / 2)))
    xy_px = camera.pixels(seen[ahead])
    mag = stars.v_mag[ahead]
    inside = np.all(
        (xy_px > -40) & (xy_px < [shot.width_px + 40, shot.height_px + 40]), axis=1
    )
    xy_px = xy_px[inside]
    mag = mag[inside]
    if shot.starless:
        xy_px = rng.uniform(0, [shot.width_px, shot.height_px], xy_px.shape)
    light = np.full((shot.height_px, shot.width_px), SKY, np.float32)
    length_px = math.hypot(*shot.trail[:2])
    footprint_px = (
        4 * math.pi * shot.sigma_px**2
        + math.pi * shot.radius_px**2
        + 2 * shot.sigma_px * length_px
    )
    flux = (
        10
        * math.sqrt(footprint_px)
        * 10 ** (0.4 * (shot.limit_mag - mag - 0.2 * rng.standard_normal(len(mag))))
    )
    middle = np.array([shot.width_px - 1, shot.height_px - 1]) / 2
    for (x, y), brightness in zip(xy_px, flux, strict=True):
        dx = x - middle[0]
        dy = y - middle[1]
        trail = shot.trail[0] - shot.trail[2] * dy, shot.trail[1] + shot.trail[2] * dx
        add_star(light, x, y, brightness, shot.sigma_px, shot.radius_px, trail)
    if shot.spoil:
        shot.spoil(light, rng)
    light += rng.standard_normal(light.shape, dtype=np.float32) * np.sqrt(
        np.maximum(light, 1) / SKY
    )
    image = np.rint(255 * np.clip(light / FULL, 0, 1) ** GAMMA).astype(np.uint8)
    if shot.print:
        shot.print(image, rng)
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, shot.quality])
    return cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), cam_from_icrs


def add_star(
    light: NDArray,
    x: float,
    y: float,
    flux: float,
    sigma_px: float,
    radius_px: float,
    trail: tuple[float, float],
) -> None:
    """Add the light of one star: a Gaussian, along a trail, or a disk with a blurred edge."""
    length = math.hypot(*trail)
    reach = [math.ceil(4 * sigma_px + radius_px + abs(step) / 2) for step in trail]
    x0 = max(round(x) - reach[0], 0)
    y0 = max(round(y) - reach[1], 0)
    patch = light[y0 : max(round(y) + reach[1] + 1, 0), x0 : max(round(x) + reach[0] + 1, 0)]
    if not patch.size:
        return
    v, u = (
        np.mgrid[y0 : y0 + patch.shape[0], x0 : x0 + patch.shape[1]]
        - np.array([y, x])[:, None, None]
    )
    if radius_px:
        edge = 1 / (1 + np.exp((np.hypot(u, v) - radius_px) / (0.6 * sigma_px)))
        patch += flux / (math.pi * radius_px**2) * edge
    elif length < 0.5:
        patch += (
            flux / (2 * math.pi * sigma_px**2) * np.exp(-(u**2 + v**2) / (2 * sigma_px**2))
        )
    else:
        along = (u * trail[0] + v * trail[1]) / length
        across = (v * trail[0] - u * trail[1]) / length
        ends = [
            erf((along + side * length / 2) / (sigma_px * math.sqrt(2))) for side in (1, -1)
        ]
        patch += (
            flux
            / (2 * length * math.sqrt(2 * math.pi) * sigma_px)
            * (ends[0] - ends[1])
            * np.exp(-(across**2) / (2 * sigma_px**2))
        )


def caption(image: NDArray, rng: np.random.Generator) -> None:
    """Burn a line of text into a border, in one of OpenCV's fonts."""
    words = [
        "2019-07-29 20:47:26",
        "Orion 30 s ISO 3200 f/1.8",
        "(c) night sky 2021",
        "Exp 0.5 s Gain 300 T 12.5C",
    ]
    font = int(rng.choice([0, 2, 3, 4]))
    scale = image.shape[0] / 960 * rng.uniform(0.6, 2.0)
    text = str(rng.choice(words))
    thick = int(rng.integers(1, 4))
    (width, height), _ = cv2.getTextSize(text, font, scale, thick)
    x = int(rng.uniform(10, max(image.shape[1] - width - 10, 11)))
    y = int(height + 10 if rng.random() < 0.5 else image.shape[0] - 15)
    cv2.putText(
        image, text, (x, y), font, scale, int(rng.integers(180, 256)), thick, cv2.LINE_AA
    )


def planets(light: NDArray, rng: np.random.Generator) -> None:
    """Two or three lights brighter than the stars: planets, aircraft."""
    for _ in range(int(rng.integers(2, 4))):
        x, y = rng.uniform(0.1, 0.9, 2) * light.shape[::-1]
        add_star(light, x, y, float(rng.uniform(6e3, 3e4)), 1.1, 0.0, (0.0, 0.0))


def hot_column(light: NDArray, rng: np.random.Generator) -> None:
    """A column that is brighter than the sky, from some row to the border, by 2 to 300 standard deviations."""
    x = rng.integers(5, light.shape[1] - 5)
    top = rng.integers(0, light.shape[0] // 2)
    light[top:, x] += 10 ** rng.uniform(0.3, 2.5)


def trees(light: NDArray, rng: np.random.Generator) -> None:
    """A dark outline of trees at the lower border with 39 lights in it, and clouds lit from below."""
    height, width = light.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    waves = sum(
        np.sin(
            2 * np.pi * (rng.normal(0, 2) * x / width + rng.normal(0, 2) * y / height)
            + rng.uniform(0, 6)
        )
        for _ in range(6)
    )
    light += (SKY * (1.5 * y / height + 0.3 * np.clip(waves, -2, 4))).clip(-0.6 * SKY)
    edge = (
        rng.uniform(0.55, 0.8) * height
        + cv2.GaussianBlur(rng.normal(0, 150, (1, width)), (0, 0), 8)[0]
    )
    edge += 0.08 * height * np.sin(np.arange(width) / width * rng.uniform(5, 25))
    hidden = y > edge
    light[hidden] = SKY / 4 + np.abs(rng.normal(0, 2, np.count_nonzero(hidden)))
    for _ in range(39):
        at = rng.integers(0, width)
        add_star(
            light,
            at,
            rng.uniform(edge[at], height),
            10 ** rng.uniform(2, 4.3),
            rng.uniform(0.8, 3),
            0.0,
            (0.0, 0.0),
        )


def lens(rng: np.random.Generator) -> Shot:
    """A camera of 1.2 megapixels behind a lens, as the cases without a size of their own use it."""
    fov_deg = float(np.exp(rng.uniform(math.log(10), math.log(40))))
    return Shot(
        1280,
        960,
        fov_deg,
        6.3 - 2.5 * math.log10(fov_deg / 20),
        quality=int(rng.integers(80, 97)),
    )


def phone(rng: np.random.Generator, limit_mag: float = 5.0) -> Shot:
    """A phone of 12 megapixels."""
    return Shot(
        4032,
        3024,
        float(rng.uniform(50, 74)),
        limit_mag,
        1.6,
        quality=int(rng.integers(80, 97)),
    )


def trailed(rng: np.random.Generator) -> Shot:
    length_px = rng.uniform(20, 60)
    angle = rng.uniform(0, math.pi)
    turn = rng.uniform(-0.012, 0.012)  # +-8 px at the corner
    few = lens(rng)
    return replace(
        few,
        limit_mag=few.limit_mag - 1,
        trail=(length_px * math.cos(angle), length_px * math.sin(angle), turn),
    )


def defocused(rng: np.random.Generator) -> Shot:
    return replace(phone(rng, 4.6), radius_px=float(rng.uniform(12, 40)))


def barrel(rng: np.random.Generator) -> Shot:
    wide = replace(lens(rng), fov_deg=float(rng.uniform(35, 80)), limit_mag=5.2)
    return replace(wide, corner_distortion=-0.05)


CASES: dict[str, Callable[[np.random.Generator], Shot]] = {
    "plain": lens,
    "phone": phone,
    "trails of 20 to 60 px": trailed,
    "out of focus, 24 to 80 px": defocused,
    "caption": lambda rng: replace(lens(rng), print=caption),
    "planets": lambda rng: replace(lens(rng), spoil=planets),
    "hot column": lambda rng: replace(lens(rng), spoil=hot_column),
    "barrel distortion, 5 %": barrel,
    "trees and clouds": lambda rng: replace(lens(rng), spoil=trees),
}


def is_same(found: Rotation, truth: Rotation) -> bool:
    """Whether an attitude is right."""
    return bool((found * truth.inv()).magnitude() < WRONG_RAD)
