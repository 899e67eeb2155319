"""Geometric images of the emitting disks of LEDs: ellipses in perspective, whose light varies across them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.camera.optics import Optics
from skysim.core.types import Floats
from skysim.sources.dome.led import Emitter, irradiance_e_s_m2
from skysim.sources.dome.shell.surface import perpendicular


class DiskImages(NamedTuple):
    """Images of N disks through a pinhole, to the second order in radius over distance.

    The point r e of a disk, |e| <= 1, is imaged at center + A e from the image of the disk's center, and the density
    of the light there is 1 + q e over its mean. Its center of gravity is center + A q / 4.

    matrix   : (N, 2, 2) A in pixels; the image's semi-axes are its singular values
    center   : (N, 2) pixels
    gradient : (N, 2) A q in pixels
    """

    matrix: Floats
    center: Floats
    gradient: Floats

    def take(self, which: NDArray[np.int64]) -> DiskImages:
        """The chosen ones."""
        return DiskImages(*(part[which] for part in self))

    def semi_axes_px(self) -> Floats:
        """(N, 2) semi-axes of the images, the larger one first: the singular values of A; 0 without an image.

        (s1 +- s2)^2 = |A|^2 +- 2 |det A|.
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
    in Q. Infinite or NaN where a point of the rim has no image.

    offset_cam : (N, 3) from the pupil to the disks' centers
    normal_cam : (N, 3)
    radius_m   : (N,)
    """
    across = radius_m[:, None] * perpendicular(normal_cam)
    rim = np.stack([across, np.cross(normal_cam, across)])  # (2, N, 3)
    points = offset_cam + np.concatenate([0 * rim[:1], rim, -rim])
    distance_m = np.linalg.norm(points, axis=2)
    cos_out = -np.sum(points * normal_cam, axis=2) / distance_m
    throughput = optics.throughput(points[..., 2] / distance_m)
    light = irradiance_e_s_m2(np.ones(()), emitter, cos_out, throughput, distance_m)
    image = optics.project(points)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = (light[1:3] - light[3:]) / (2 * light[0])  # (2, N)
        depth = rim[..., 2] / offset_cam[:, 2]
    matrix = np.moveaxis((image[1:3] - image[3:]) / 2, 0, 2)
    trace = image[1:].sum(axis=0) - 4 * image[0]
    gradient, tilt = (np.einsum("nij,jn->ni", matrix, part) for part in (slope + 3 * depth, depth))
    return DiskImages(matrix, trace / 8 - 0.75 * tilt, gradient)
