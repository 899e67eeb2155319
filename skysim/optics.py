"""The lens as it is: direction to pixel with distortion, and the shape of a point's image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from skysim import scene
from skysim.types import Floats

# What the lens makes of a point: the standard deviation of a Gaussian and the radius of a disc, convolved.
PSFS: dict[str, Callable[[scene.Psf], tuple[float, float]]] = {
    "gaussian": lambda psf: (psf.sigma_px, 0.0),
    "disc": lambda psf: (psf.sigma_px, psf.radius_px),
}


@dataclass(frozen=True, slots=True)
class Optics:
    """A lens before a chip, in camera axes +x right, +y down, +z boresight.

    distortion      : k1, k2, p1, p2, k3 (Brown-Conrady in OpenCV's order)
    blur_sigma_px, blur_radius_px : the point's image: a disc of that radius convolved with that Gaussian
    collecting_m2   : entrance pupil's area times transmission
    """

    width_px: int
    height_px: int
    focal_px: float
    centre_px: tuple[float, float]
    distortion: tuple[float, ...]
    blur_sigma_px: float
    blur_radius_px: float
    collecting_m2: float

    @classmethod
    def of(cls, camera: scene.Camera) -> Optics:
        """The optics that a scene's camera describes."""
        sigma, radius = PSFS[camera.psf.kind](camera.psf)
        pupil_m = camera.focal_length_m / camera.f_number
        return cls(
            camera.width_px,
            camera.height_px,
            camera.focal_px,
            camera.centre_px,
            camera.distortion,
            sigma,
            radius,
            np.pi / 4 * pupil_m**2 * camera.transmission,
        )

    @property
    def half_diagonal_rad(self) -> float:
        """Greatest angle from the boresight at which an undistorted camera sees anything."""
        centre, size = np.array(self.centre_px), np.array([self.width_px, self.height_px])
        reach = np.hypot(*np.maximum(centre + 0.5, size - 0.5 - centre))
        return float(np.arctan(reach / self.focal_px))

    def project(self, vectors_cam: Floats) -> Floats:
        """(..., 3) vectors in camera axes to (..., 2) pixels; NaN behind the camera.

        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), y' likewise (Brown 1971).
        """
        z = np.where(vectors_cam[..., 2] > 0, vectors_cam[..., 2], np.nan)
        x, y = vectors_cam[..., 0] / z, vectors_cam[..., 1] / z
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        return np.stack(
            [u * self.focal_px + self.centre_px[0], v * self.focal_px + self.centre_px[1]], axis=-1
        )
