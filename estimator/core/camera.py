"""Camera model of the tracker: converts pixels to unit vectors and back, with the calibration that the tracker assumes.

The model is a pinhole with Brown-Conrady distortion in OpenCV's convention. Projection (`Camera.pixels`) applies
the distortion in closed form; back-projection (`Camera.rays`) inverts it by fixed-point iteration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.core.arrays import Floats
from estimator.core.errors import ImageError
from estimator.core.jit import jit

Distortion = tuple[float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole with Brown-Conrady distortion, in camera axes +x right, +y down, +z boresight.

    focal_px : focal length divided by the pixel pitch
    center_px: principal point (x, y); the center of pixel (0, 0) is (0, 0)
    distortion: k1, k2, p1, p2, k3 in OpenCV's order
    focal_sigma: relative standard deviation of the focal length: the error of a calibration, the same in every frame
    row_time_s : rolling shutter: each row is exposed this long after the one above it, negative if the lower one is
        first; 0 for a global shutter
    """

    width_px: int
    height_px: int
    focal_px: float
    center_px: tuple[float, float]
    distortion: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
    focal_sigma: float = 0.0
    row_time_s: float = 0.0

    @classmethod
    def from_fov(
        cls, width_px: int, height_px: int, fov_rad: float | None = None, *, fov_deg: float | None = None
    ) -> Camera:
        """An undistorted camera from its horizontal field of view, in radians or in degrees.

        The field is the angle between the centers of the edge columns: f = (width - 1) / 2 / tan(fov / 2).
        Raises ImageError unless exactly one of the two is given.
        """
        if fov_deg is not None and fov_rad is None:
            fov_rad = float(np.radians(fov_deg))
        elif fov_rad is None or fov_deg is not None:
            raise ImageError("from_fov: takes either fov_rad or fov_deg")
        focal_px = (width_px - 1) / 2 / np.tan(fov_rad / 2)
        return cls(width_px, height_px, float(focal_px), ((width_px - 1) / 2, (height_px - 1) / 2))

    @property
    def fov_rad(self) -> float:
        """Horizontal field of view: the angle between the rays of the left and right edge pixels at mid-height."""
        mid_row = (self.height_px - 1) / 2
        left, right = self.rays(np.array([[0.0, mid_row], [self.width_px - 1.0, mid_row]]))
        return float(np.arctan2(np.linalg.norm(np.cross(left, right)), left @ right))

    @property
    def diagonal_rad(self) -> float:
        """Diagonal field of view: the angle between opposite corners, without distortion."""
        half = np.hypot(self.width_px, self.height_px) / 2
        return float(2 * np.arctan(half / self.focal_px))

    def zoomed(self, factor: float) -> Camera:
        """Return a copy with the focal length multiplied by `factor`."""
        return replace(self, focal_px=self.focal_px * factor)

    def rays(self, xy_px: Floats) -> Floats:
        """Convert (N, 2) pixels to (N, 3) unit vectors in camera axes."""
        tangent = self.tangents(xy_px)
        rays = np.column_stack([tangent, np.ones(len(tangent))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def tangents(self, xy_px: Floats) -> Floats:
        """Convert (N, 2) pixels to (N, 2) tangents (x / z, y / z) in camera axes, without distortion."""
        return undistorted(np.asarray(xy_px, dtype=float), self.focal_px, *self.center_px, self.distortion)

    def pixels(self, vectors_cam: Floats) -> Floats:
        """Project (N, 3) vectors in camera axes to (N, 2) pixels.

        NaN for a vector behind the camera or beyond the angle at which the radial distortion folds back.
        """
        z = np.where(vectors_cam[:, 2] > 0, vectors_cam[:, 2], np.nan)
        tangent = vectors_cam[:, :2] / z[:, None]
        tangent[np.sum(tangent**2, axis=1) >= self._fold()] = np.nan
        return distorted(tangent, self.distortion) * self.focal_px + self.center_px

    def contains(self, xy_px: Floats, margin_px: float = 0.0) -> np.ndarray:
        """Return (N,) whether each pixel position is on the sensor, shrunk by the margin on every side."""
        x, y = xy_px[:, 0], xy_px[:, 1]
        low, right = margin_px - 0.5, self.width_px - 0.5 - margin_px
        bottom = self.height_px - 0.5 - margin_px
        return (x >= low) & (x <= right) & (y >= low) & (y <= bottom)

    def row_delays_s(self, xy_px: Floats) -> Floats:
        """(N,) time of each light's mid-exposure after that of the middle row, to which an attitude refers."""
        return np.asarray(self.row_time_s * (xy_px[:, 1] - (self.height_px - 1) / 2))

    def _fold(self) -> float:
        """Squared tangent at which the radial distortion folds back; infinite if it does not.

        Beyond it, directions outside the field would project into the field. It is the least positive root r^2 of
        d(r radial)/dr = 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6.
        """
        k1, k2, _, _, k3 = self.distortion
        if not (k1 or k2 or k3):
            return np.inf
        # Solve for 1 / r^2: the leading coefficient is then 1, so no tiny coefficient is divided by.
        roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
        largest_root = float(max(roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)], default=0.0))
        return 1 / largest_root if largest_root else np.inf


@jit
def _distort(x: float, y: float, distortion: Distortion) -> tuple[float, float]:
    """Apply the distortion to one tangent (Brown 1966, in OpenCV's form)."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@jit
def distorted(tangent: Floats, distortion: Distortion) -> Floats:
    """Apply the distortion to (N, 2) tangents."""
    out = np.empty_like(tangent)
    for n in range(len(tangent)):
        out[n, 0], out[n, 1] = _distort(tangent[n, 0], tangent[n, 1], distortion)
    return out


@jit
def undistorted(
    xy_px: Floats, focal_px: float, center_x_px: float, center_y_px: float, distortion: Distortion
) -> Floats:
    """Convert (N, 2) pixels to (N, 2) tangents without distortion.

    The distortion is inverted by fixed-point iteration, t <- t + (measured - distort(t)). For a distortion of a few
    percent it converges to 1e-15 in a few tens of iterations.
    """
    out = np.empty(xy_px.shape)
    k1, k2, p1, p2, k3 = distortion
    no_distortion = k1 == 0 and k2 == 0 and p1 == 0 and p2 == 0 and k3 == 0
    for n in range(len(out)):
        measured_x = (xy_px[n, 0] - center_x_px) / focal_px
        measured_y = (xy_px[n, 1] - center_y_px) / focal_px
        x, y = measured_x, measured_y
        for _ in range(0 if no_distortion else 50):
            distorted_x, distorted_y = _distort(x, y, distortion)
            x, y = x + measured_x - distorted_x, y + measured_y - distorted_y
            if max(abs(measured_x - distorted_x), abs(measured_y - distorted_y)) < 1e-15:
                break
        out[n, 0], out[n, 1] = x, y
    return out


def check_shape(image_shape: tuple[int, ...], camera: Camera) -> None:
    """Raise ImageError unless the image has the camera's width and height."""
    if image_shape != (camera.height_px, camera.width_px):
        size = "x".join(map(str, image_shape[1::-1])) if len(image_shape) >= 2 else image_shape
        raise ImageError(f"the image is {size} pixels; this camera's are {camera.width_px}x{camera.height_px}")
