"""The lens: projection of directions to pixels with distortion, and throughput with vignetting.

This is the hardware as it is; what a tracker believes about its camera is separate code (estimator/core/camera.py).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from skysim.core.types import Floats, frozen, positive
from skysim.scene.sections.camera import (
    CameraConfig,
    TwoStopsConfig,
    VignettingTableConfig,
    radial,
)


def two_stops(config: TwoStopsConfig, field_rad: Floats) -> Floats:
    """Fraction of the light that passes two equal round stops: the overlap area of two circles, over a circle's area.

    V = (2 / pi) (acos u - u sqrt(1 - u^2)), u = tan(field) / tan(cutoff): seen obliquely, one stop is displaced
    against the other by u diameters.
    """
    # 1.57 is just below pi / 2, where the tangent overflows.
    tangent = np.tan(np.minimum(field_rad, 1.57))
    u = np.clip(tangent / np.tan(np.radians(config.cutoff_deg)), 0, 1)
    return 2 / np.pi * (np.arccos(u) - u * np.sqrt(1 - u**2))


def table(config: VignettingTableConfig, field_rad: Floats) -> Floats:
    """Measured transmission, linear between the angles and constant beyond them."""
    return np.interp(np.degrees(field_rad), config.angle_deg, config.transmission)


VIGNETTING: dict[str, Callable[[Any, Floats], Floats]] = {
    "two_stops": two_stops,
    "table": table,
}


PUPIL_ROUNDS = 4


@frozen
class Optics:
    """Lens and image geometry of a camera, in camera axes +x right, +y down, +z boresight.

    Attributes
    ----------
    camera
        Focal length, principal point, distortion and point-spread function
    collecting_m2
        Area of the entrance pupil times the transmission, if that is one number for all wavelengths
    fold_r
        Tangent of the field angle at which strong barrel distortion folds back; no image beyond it
    field_rad
        Greatest field angle (from the boresight) on the chip
    blur_px
        Standard deviation of a Gaussian blur before the lens (seeing)
    scale
        Scale of the image about the principal point, if any; a negative one mirrors it through the axis
    """

    camera: CameraConfig
    collecting_m2: float
    fold_r: float
    field_rad: float
    blur_px: float = 0.0
    scale: float | None = None

    @classmethod
    def from_camera(cls, camera: CameraConfig) -> "Optics":
        """The optics of a scene's camera, without seeing."""
        # Collecting area of the round pupil.
        area_m2 = np.pi / 4 * camera.pupil_m**2
        collecting_m2 = float(area_m2 * camera.gray_transmission)
        fold = fold_r(camera.distortion)
        corner_r = camera.corner_px / camera.focal_px
        return cls(camera, collecting_m2, fold, field_rad(corner_r, camera.distortion, fold))

    def project(self, vectors_cam: Floats) -> Floats:
        """Project (..., 3) vectors in camera axes to (..., 2) pixels; NaN behind the camera and beyond the fold.

        With x = X / Z, y = Y / Z and r^2 = x^2 + y^2:
        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), y' likewise (Brown 1971).
        Pixel = center + f x', then scaled about the center.
        """
        # NaN in Z marks directions without an image.
        z = positive(vectors_cam[..., 2])
        x = vectors_cam[..., 0] / z
        y = vectors_cam[..., 1] / z
        focal = self.camera.focal_px
        center = self.camera.center_px
        if any(self.camera.distortion):
            x, y = distort(self.camera.distortion, self.fold_r, x, y)
        xy_px = np.stack([x * focal + center[0], y * focal + center[1]], axis=-1)
        return xy_px if self.scale is None else center + self.scale * (xy_px - center)

    def from_pupil(self, direction_cam: Floats, nearness: Floats) -> Floats:
        """Vectors (..., 3) along which lights at unit directions from the nominal pupil enter the real one.

        The entrance pupil of light at the field angle t is z = a tan^2 t + b tan^4 t farther along the boresight (pupil
        aberration; Kingslake & Johnson 2010, Lens Design Fundamentals, 2nd ed., ch. 8). So a light at d u is in the
        direction u - (z / d) e_z, whose angle t decides z. Newton's method solves for its third component.

        Parameters
        ----------
        nearness
            (...,) 1 / d in 1/m, 0 for stars
        """
        a, b = self.camera.pupil_walk_m
        seen = direction_cam.copy()
        across2 = direction_cam[..., 0] ** 2 + direction_cam[..., 1] ** 2
        for _ in range(PUPIL_ROUNDS):
            tangent2 = across2 / seen[..., 2] ** 2
            excess = seen[..., 2] - direction_cam[..., 2]
            excess += nearness * tangent2 * (a + b * tangent2)
            slope = 1 - 2 * nearness * tangent2 * (a + 2 * b * tangent2) / seen[..., 2]
            seen[..., 2] -= excess / slope
        return seen

    def throughput(self, cos_field: Floats) -> Floats:
        """Relative throughput at field angles theta of any shape: cos(theta) V(theta), zero behind the camera.

        The cosine is the foreshortening of the pupil, V the vignetting.
        """
        # Behind the camera nothing enters the pupil.
        cosine = np.maximum(cos_field, 0)
        config = self.camera.vignetting
        if config is None:
            return cosine
        return cosine * VIGNETTING[config.kind](config, np.arccos(np.minimum(cosine, 1)))


def tangential(distortion: tuple[float, ...], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Tangential (decentering) distortion: 2 p1 x y + p2 (r^2 + 2 x^2) and p1 (r^2 + 2 y^2) + 2 p2 x y (p1, p2)."""
    p1, p2 = distortion[2:4]
    r2 = x**2 + y**2
    return 2 * p1 * x * y + p2 * (r2 + 2 * x**2), p1 * (r2 + 2 * y**2) + 2 * p2 * x * y


def distort(
    distortion: tuple[float, ...], fold_r: float, x: Floats, y: Floats
) -> tuple[Floats, Floats]:
    """Brown's distortion of (...,) tangents x and y; NaN beyond the fold."""
    r2 = x**2 + y**2
    # Beyond the fold a direction would have a second image.
    scale = np.where(r2 < fold_r**2, radial(distortion, r2), np.nan)
    shift_x, shift_y = tangential(distortion, x, y)
    return x * scale + shift_x, y * scale + shift_y


def field_rad(corner_r: float, distortion: tuple[float, ...], fold_r: float) -> float:
    """Field angle of the chip's farthest corner, a tangent, with the radial distortion inverted by interpolation."""
    # The radius grows up to the fold, so a table inverts it.
    r = np.linspace(0, min(fold_r, 20 * corner_r), 4001)
    return float(np.arctan(np.interp(corner_r, r * radial(distortion, r**2), r)))


def fold_r(distortion: tuple[float, ...]) -> float:
    """The least r at which r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing; infinity if it always grows.

    There the derivative 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 vanishes.
    """
    k1, k2, _, _, k3 = distortion
    # A polynomial in 1 / r^2, whose leading coefficient is never 0; its largest real root is the least r.
    roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
    # Real positive roots, up to rounding.
    real = abs(roots.imag) < 1e-9 * (1 + abs(roots.real))
    extrema = roots.real[real & (roots.real > 1e-12)]
    return float(1 / np.sqrt(extrema.max())) if len(extrema) else float("inf")
