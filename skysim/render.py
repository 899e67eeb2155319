"""Sources over an exposure to mean photo-electrons a pixel. Smear lives here: everything is a time integral."""

from __future__ import annotations

from math import cos, erf, erfc, exp, pi, sin, sqrt

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.led import irradiance_ph_s_m2, lit_s
from skysim.optics import Optics
from skysim.types import Floats, Mount, Seen, Sources, Trajectory

STEP_PX = 0.25
MAX_STEPS = 20_000
REACH_SIGMA = 6.5  # a Gaussian's share beyond is 1e-10
NARROW = 3.0  # radius over sigma below which a disc is a sum of Gaussians
RING_SHARE = ((1 - sqrt(0.6)) / 2, 0.5, (1 + sqrt(0.6)) / 2)  # Gauss-Legendre in r^2 on a disc of radius 1
RING_WEIGHT = (5 / 18, 8 / 18, 5 / 18)


def render(
    sources: Sources,
    optics: Optics,
    trajectory: Trajectory,
    mount: Mount,
    open_s: float,
    exposure_s: float,
    quantum_efficiency: float,
    falloff: str = "inverse_square",
) -> tuple[Floats, Seen]:
    """(H, W) mean photo-electrons and the truth of every source that gave any.

    The exposure is cut into so many equal parts that no image moves more than a quarter pixel in one. In each
    part the camera stands at its true pose, and each source gives what it emits in that time (its pulses
    integrated exactly). Midpoints of a smooth path converge with the square of the part; energy is conserved
    part by part.
    """
    image = np.zeros((optics.height_px, optics.width_px))
    moments_s = open_s + exposure_s * np.linspace(0, 1, 9)
    near = sources.take(in_view(sources, optics, trajectory, mount, moments_s))
    if not len(near):
        return image, Seen(near.id, *(np.empty((0, 2)),) * 2, *(np.empty(0),) * 3)
    streak = path_px(near, optics, trajectory, mount, moments_s)
    parts = int(np.clip(np.ceil(streak.max() / STEP_PX), 1, MAX_STEPS))
    edges = open_s + exposure_s * np.arange(parts + 1) / parts
    xy, _, distance, cos_out, cos_in = look(near, optics, trajectory, mount, (edges[:-1] + edges[1:]) / 2)
    starry = near.place[:, 3] == 0
    flux = np.where(
        starry,
        near.strength * np.maximum(cos_in, 0),
        irradiance_ph_s_m2(near.strength, near.lobe, cos_out, cos_in, distance, falloff),
    )
    lit = lit_s(edges[:-1, None], edges[1:, None], near.period_s, near.start_s, near.on_s)
    electrons = np.nan_to_num(flux * lit) * optics.collecting_m2 * quantum_efficiency
    radius_px = np.where(starry, 0.0, near.radius_m / distance.mean(axis=0) * optics.focal_px)
    # Blur and emitter are both discs; the wider of them with the other's variance in its edge.
    wide, thin = np.maximum(radius_px, optics.blur_radius_px), np.minimum(radius_px, optics.blur_radius_px)
    sigma = np.sqrt(optics.blur_sigma_px**2 + thin**2 / 4)
    table = splat(image, np.ascontiguousarray(np.nan_to_num(xy, nan=-1e6)), electrons, wide, sigma)
    middle = look(near, optics, trajectory, mount, np.array([open_s + exposure_s / 2]))[0][0]
    kept = table[:, 0] > 0
    return image, Seen(
        near.id[kept], middle[kept], table[kept, 2:4], table[kept, 0], table[kept, 1], streak[kept]
    )


def look(
    sources: Sources, optics: Optics, trajectory: Trajectory, mount: Mount, t_s: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Where each of N sources is seen at each of K times.

    Returns (K, N, 2) pixels, (K, N, 3) unit vectors towards them in camera axes, (K, N) distances in m (1 for
    stars), (K, N) cosines at the emitter and at the aperture.
    """
    lab_from_body = trajectory.at(t_s)
    cam_from_lab = mount.cam_from_body * lab_from_body.inv()
    camera_m = lab_from_body.apply(mount.camera_body_m)
    offset = sources.place[None, :, :3] - sources.place[None, :, 3:] * camera_m[:, None, :]
    distance = np.linalg.norm(offset, axis=2)
    offset /= distance[:, :, None]
    cos_out = -np.einsum("knj,nj->kn", offset, sources.normal)
    toward = np.einsum("kij,knj->kni", cam_from_lab.as_matrix().reshape(-1, 3, 3), offset)
    return optics.project(toward), toward, distance, cos_out, toward[:, :, 2]


def in_view(
    sources: Sources, optics: Optics, trajectory: Trajectory, mount: Mount, t_s: Floats
) -> NDArray[np.int64]:
    """Rows of the sources within the field's circle at any of these times, with a quarter more for distortion
    and for images that reach in from outside."""
    lab_from_body: Rotation = trajectory.at(t_s)
    sight = (mount.cam_from_body * lab_from_body.inv()).inv().apply([0.0, 0.0, 1.0])
    camera_m = lab_from_body.apply(mount.camera_body_m)
    place, near = sources.place[:, :3], sources.place[:, 3:]  # near is 1 for an LED, 0 for a star
    along = place @ sight.T - near * np.sum(camera_m * sight, axis=1)
    square = (
        np.sum(place**2, axis=1)[:, None]
        - 2 * near * (place @ camera_m.T)
        + near * np.sum(camera_m**2, axis=1)
    )
    edge = np.cos(min(1.25 * optics.half_diagonal_rad + 0.02, np.pi))
    return np.flatnonzero((along > edge * np.sqrt(square)).any(axis=1))


def path_px(sources: Sources, optics: Optics, trajectory: Trajectory, mount: Mount, t_s: Floats) -> Floats:
    """(N,) length of each image's path through these times."""
    xy = look(sources, optics, trajectory, mount, t_s)[0]
    return np.asarray(np.nan_to_num(np.linalg.norm(np.diff(xy, axis=0), axis=2)).sum(axis=0))


@numba.njit(cache=True)
def splat(image: Floats, xy: Floats, electrons: Floats, radius_px: Floats, sigma_px: Floats) -> Floats:
    """Add every source's image, summed over the parts of the exposure, and measure it on the way.

    xy (K, N, 2), electrons (K, N), radius_px and sigma_px (N,). A source of no radius is a Gaussian integrated
    over each pixel; one with a radius is a uniform disc with a Gaussian edge. Returns (N, 4): electrons that
    fell on the chip, those of the brightest pixel, and the flux-weighted mean pixel of the whole image.
    """
    height, width = image.shape
    parts, count = electrons.shape
    out = np.zeros((count, 4))
    for n in range(count):
        total = electrons[:, n].sum()
        if total <= 0:
            continue
        out[n, 2] = (electrons[:, n] * xy[:, n, 0]).sum() / total
        out[n, 3] = (electrons[:, n] * xy[:, n, 1]).sum() / total
        reach = radius_px[n] + REACH_SIGMA * sigma_px[n] + 1
        x0 = max(int(np.floor(xy[:, n, 0].min() - reach)), 0)
        x1 = min(int(np.ceil(xy[:, n, 0].max() + reach)), width - 1)
        y0 = max(int(np.floor(xy[:, n, 1].min() - reach)), 0)
        y1 = min(int(np.ceil(xy[:, n, 1].max() + reach)), height - 1)
        if x1 < x0 or y1 < y0:
            continue
        patch = np.zeros((y1 - y0 + 1, x1 - x0 + 1))
        for k in range(parts):
            x, y = xy[k, n, 0] - x0, xy[k, n, 1] - y0
            if radius_px[n] > NARROW * sigma_px[n]:
                _add_disc(patch, x, y, electrons[k, n], radius_px[n], sigma_px[n])
            elif radius_px[n] > 0:
                _add_narrow_disc(patch, x, y, electrons[k, n], radius_px[n], sigma_px[n])
            else:
                _add_gaussian(patch, x, y, electrons[k, n], sigma_px[n])
        out[n, 0], out[n, 1] = patch.sum(), patch.max()
        image[y0 : y1 + 1, x0 : x1 + 1] += patch
    return out


@numba.njit(cache=True)
def _add_gaussian(patch: Floats, x: float, y: float, electrons: float, sigma_px: float) -> None:
    """A Gaussian's share of each pixel: the product of two differences of the error function."""
    height, width = patch.shape
    reach = REACH_SIGMA * sigma_px + 1
    left, right = max(int(np.floor(x - reach)), 0), min(int(np.ceil(x + reach)), width - 1)
    top, bottom = max(int(np.floor(y - reach)), 0), min(int(np.ceil(y + reach)), height - 1)
    if right < left or bottom < top:
        return
    scale = 1 / (sigma_px * sqrt(2.0))
    columns = np.empty(right - left + 1)
    low = erf((left - 0.5 - x) * scale)
    for i in range(left, right + 1):
        high = erf((i + 0.5 - x) * scale)
        columns[i - left] = (high - low) / 2
        low = high
    low = erf((top - 0.5 - y) * scale)
    for j in range(top, bottom + 1):
        high = erf((j + 0.5 - y) * scale)
        row = electrons * (high - low) / 2
        low = high
        for i in range(left, right + 1):
            patch[j, i] += row * columns[i - left]


@numba.njit(cache=True)
def _add_narrow_disc(
    patch: Floats, x: float, y: float, electrons: float, radius_px: float, sigma_px: float
) -> None:
    """A disc of up to three sigma convolved with a Gaussian, as 24 Gaussians on three rings.

    Gauss-Legendre over the disc's area, eight places a ring: within 1 % of the peak of the true convolution at
    a radius of three sigma, 0.1 % at two, and no electron is lost.
    """
    for ring in range(3):
        r = radius_px * sqrt(RING_SHARE[ring])
        for k in range(8):
            angle = (k + ring / 2) * pi / 4
            share = electrons * RING_WEIGHT[ring] / 8
            _add_gaussian(patch, x + r * cos(angle), y + r * sin(angle), share, sigma_px)


@numba.njit(cache=True)
def _add_disc(patch: Floats, x: float, y: float, electrons: float, radius_px: float, sigma_px: float) -> None:
    """A uniform disc with a Gaussian edge, wider than three sigma, sampled at the pixels' middles.

    Surface brightness erfc((r - b) / (s sqrt 2)) / 2 over its integral pi ((b^2 + s^2) P(b/s) + b s p(b/s)), P and
    p the normal distribution and its density, with the pixel's own variance in the edge, s^2 = sigma^2 + 1/12.
    The edge's own curvature brings it in to b = a - s^2 / (2 a): within 1 % of the peak of the true convolution
    at a = 3 s. So smooth an image loses nothing to sampling for s > 0.6 px.
    """
    height, width = patch.shape
    edge = sqrt(sigma_px**2 + 1 / 12)
    reach = radius_px + REACH_SIGMA * edge
    inner = radius_px - edge**2 / (2 * radius_px)
    b = inner / edge
    area = (b**2 + 1) * erfc(-b / sqrt(2.0)) / 2 + b * exp(-(b**2) / 2) / sqrt(2 * pi)
    brightness = electrons / (2 * pi * edge**2 * area)
    top, bottom = max(int(np.ceil(y - reach)), 0), min(int(np.floor(y + reach)), height - 1)
    for j in range(top, bottom + 1):
        half = sqrt(max(reach**2 - (j - y) ** 2, 0.0))
        left, right = max(int(np.ceil(x - half)), 0), min(int(np.floor(x + half)), width - 1)
        for i in range(left, right + 1):
            r = sqrt((i - x) ** 2 + (j - y) ** 2)
            depth = (r - inner) / (edge * sqrt(2.0))
            patch[j, i] += 2 * brightness if depth < -4.6 else brightness * erfc(depth)
