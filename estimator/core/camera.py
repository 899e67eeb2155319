"""Camera model of the tracker: converts pixels to unit vectors and back, with the calibration that the tracker assumes.

The model is a pinhole with Brown-Conrady distortion in OpenCV's convention. Projection (`Camera.pixels`) applies
the distortion in closed form; back-projection (`Camera.rays`) inverts it by fixed-point iteration. With the focal
length f in pixels along x, the aspect a, the principal point c and the distorted tangents t',

    x_px = c_x + f t'_x,    y_px = c_y + a f t'_y.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from estimator.core import checks
from estimator.core.checks import Allowed, Floats, frozen
from estimator.core.errors import ImageError
from estimator.core.jit import jit

Distortion = tuple[float, float, float, float, float]

# Limits of the horizontal field of view in `Camera.from_fov`. They do not overlap: a usual number of degrees is above
# WIDEST_RAD as radians, and a number of radians is below NARROWEST_DEG as degrees.
WIDEST_RAD = 2.7
NARROWEST_DEG = 1.6
# Numbers of channels of an image with a channel axis: gray or color, without or with transparency.
COLORS = (1, 2, 3, 4)

NUMBERS = {
    "width_px": Allowed(1, 1e6, "whole, 1 to 1e6", True),
    "height_px": Allowed(1, 1e6, "whole, 1 to 1e6", True),
    "focal_px": Allowed(1e-9, 1e12, "finite, above 0: focal length over pixel"),
    "focal_sigma": Allowed(0.0, 0.5, "0 to 0.5, relative"),
    "row_time_s": Allowed(-1.0, 1.0, "-1 to 1: seconds from row to row"),
    "aspect": Allowed(0.5, 2.0, "0.5 to 2: width over height of a pixel"),
}
_FIELDS = f"fov_deg from {NARROWEST_DEG} to {math.degrees(WIDEST_RAD):.0f}, or fov_rad above 0 to {WIDEST_RAD}"


@frozen
class Camera:
    """A pinhole with Brown-Conrady distortion, in camera axes +x right, +y down, +z boresight.

    Attributes
    ----------
    width_px, height_px
        Size of the image
    focal_px
        Focal length divided by the pixel pitch along x
    center_px
        Principal point (x, y); the center of pixel (0, 0) is (0, 0)
    distortion
        k1, k2, p1, p2, k3 in OpenCV's order
    focal_sigma
        Relative standard deviation of the focal length: the error of a calibration, the same in
        every frame
    row_time_s
        Rolling shutter: each row is exposed this long after the one above it, negative if the
        lower one is first; 0 for a global shutter
    aspect
        Width over height of a pixel: the focal length in pixels along y, divided by that along x; 1 for square pixels

    Raises
    ------
    ImageError
        For impossible numbers.
    """

    width_px: int
    height_px: int
    focal_px: float
    center_px: tuple[float, float]
    distortion: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
    focal_sigma: float = 0.0
    row_time_s: float = 0.0
    aspect: float = 1.0

    def __post_init__(self) -> None:
        if self._is_plain():
            return
        checks.store_numbers(self, "camera: ", NUMBERS)
        # Plain floats: compiled code would be compiled again for a tuple of integers.
        for name, count in (("center_px", 2), ("distortion", 5)):
            array = checks.floats(f"camera: {name}", getattr(self, name), (count,))
            if not np.isfinite(array).all():
                raise ImageError(
                    f"camera: {name} is {array.tolist()}; allowed: {count} finite numbers"
                )
            object.__setattr__(self, name, tuple(array.tolist()))

    def _is_plain(self) -> bool:
        """Return whether all numbers are possible and of the declared types.

        It is a quick check, since a lens fit makes a hundred cameras.
        """
        lens = (self.center_px, self.distortion)
        if not (
            type(lens[0]) is type(lens[1]) is tuple
            and len(lens[0]) == 2
            and len(lens[1]) == 5
        ):
            return False
        for name, (low, high, _, whole, _) in NUMBERS.items():
            value = getattr(self, name)
            if type(value) is not (int if whole else float) or not low <= value <= high:
                return False
        numbers = (*lens[0], *lens[1])
        return all([type(one) is float for one in numbers]) and math.isfinite(sum(numbers))

    @classmethod
    def from_fov(
        cls,
        width_px: int,
        height_px: int,
        fov_rad: float | None = None,
        *,
        fov_deg: float | None = None,
    ) -> Camera:
        """Return an undistorted camera from its horizontal field of view, in radians or in degrees.

        The field is the angle between the centers of the edge columns: f = (width - 1) / 2 / tan(fov / 2).

        Raises
        ------
        ImageError
            Unless exactly one of the two is given; for a number in the range of the other unit:
            fov_rad above WIDEST_RAD, fov_deg below NARROWEST_DEG.
        """
        if (fov_rad is None) == (fov_deg is None):
            raise ImageError("from_fov: takes either fov_rad or fov_deg")
        if fov_deg is None:
            fov_rad = checks.number(
                "from_fov: fov_rad", fov_rad, -math.inf, math.inf, _FIELDS
            )
            if not 0 < fov_rad <= WIDEST_RAD:
                guess = "; degrees?" if 0 < fov_rad < math.inf else ";"
                degrees = f"{math.degrees(fov_rad):.0f}°"
                raise ImageError(
                    f"from_fov: fov {fov_rad:g} rad is {degrees}{guess} allowed: {_FIELDS}"
                )
        else:
            fov_deg = checks.number(
                "from_fov: fov_deg", fov_deg, -math.inf, math.inf, _FIELDS
            )
            if not NARROWEST_DEG <= fov_deg <= math.degrees(WIDEST_RAD):
                guess = "; radians?" if 0 < fov_deg < NARROWEST_DEG else ";"
                raise ImageError(
                    f"from_fov: fov_deg is {fov_deg:g}{guess} allowed: {_FIELDS}"
                )
            fov_rad = math.radians(fov_deg)
        width_px = checks.number(
            "from_fov: width_px", width_px, 2, 1e6, "2 pixels or more", True
        )
        focal_px = (width_px - 1) / 2 / np.tan(fov_rad / 2)
        return cls(
            width_px, height_px, float(focal_px), ((width_px - 1) / 2, (height_px - 1) / 2)
        )

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

    @property
    def field_sr(self) -> float:
        """Solid angle of a small field of view."""
        return self.width_px * self.height_px / self.focal_px**2

    @property
    def corners_px(self) -> Floats:
        """(4, 2) corners of the sensor, half a pixel beyond the centers of its corner pixels."""
        right = self.width_px - 0.5
        bottom = self.height_px - 0.5
        return np.array([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])

    def zoomed(self, factor: float) -> Camera:
        """Return a copy with the focal length multiplied by `factor`."""
        return replace(self, focal_px=self.focal_px * factor)

    @property
    def lens(self) -> Floats:
        """(8,) focal_px, center x and y in px, k1, k2, p1, p2, k3."""
        return np.array([self.focal_px, *self.center_px, *self.distortion])

    def with_lens(self, lens: Floats) -> Camera:
        """Return a copy with these numbers of `lens`."""
        focal_px, x, y, *distortion = lens.tolist()
        return replace(
            self, focal_px=focal_px, center_px=(x, y), distortion=tuple(distortion)
        )

    def rays(self, xy_px: Floats) -> Floats:
        """Convert (N, 2) pixels to (N, 3) unit vectors in camera axes."""
        tangent = self.tangents(xy_px)
        rays = np.column_stack([tangent, np.ones(len(tangent))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def tangents(self, xy_px: Floats) -> Floats:
        """Convert (N, 2) pixels to (N, 2) tangents (x / z, y / z) in camera axes, without distortion."""
        return undistorted(
            checks.floats("xy_px", xy_px, (None, 2)),
            self.focal_px,
            *self.center_px,
            self.distortion,
            self.aspect,
        )

    def pixels(self, vectors_cam: Floats) -> Floats:
        """Project (N, 3) vectors in camera axes to (N, 2) pixels.

        NaN for a vector behind the camera or beyond the angle at which the radial distortion folds back.
        """
        vectors_cam = checks.floats("vectors_cam", vectors_cam, (None, 3))
        z = np.where(vectors_cam[:, 2] > 0, vectors_cam[:, 2], np.nan)
        tangent = vectors_cam[:, :2] / z[:, None]
        tangent[np.sum(tangent**2, axis=1) >= self._fold()] = np.nan
        focal_px = self.focal_px * np.array([1.0, self.aspect])
        return distorted(tangent, self.distortion) * focal_px + self.center_px

    def contains(self, xy_px: Floats, margin_px: float = 0.0) -> np.ndarray:
        """Return (N,) whether each pixel position is on the sensor, shrunk by the margin on every side; NaN is not."""
        x, y = checks.floats("xy_px", xy_px, (None, 2)).T
        low = margin_px - 0.5
        right = self.width_px - 0.5 - margin_px
        bottom = self.height_px - 0.5 - margin_px
        return (x >= low) & (x <= right) & (y >= low) & (y <= bottom)

    def row_delays_s(self, xy_px: Floats) -> Floats:
        """Return the (N,) times of the lights' mid-exposures after that of the middle row: tau (y - y_mid).

        An attitude refers to the middle row.
        """
        return np.asarray(self.row_time_s * (xy_px[:, 1] - (self.height_px - 1) / 2))

    def _fold(self) -> float:
        """Return the squared tangent at which the radial distortion folds back; infinite if it does not.

        Beyond it, directions outside the field would project into the field. It is the least positive root r^2 of
        d(r radial)/dr = 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6.
        """
        k1, k2, _, _, k3 = self.distortion
        if not (k1 or k2 or k3):
            return np.inf
        # Solve for 1 / r^2: the leading coefficient is then 1, so no tiny coefficient is divided by.
        roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
        largest_root = float(
            max(roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)], default=0.0)
        )
        return 1 / largest_root if largest_root else np.inf


@jit
def _distort(x: float, y: float, distortion: Distortion) -> tuple[float, float]:
    """Apply the distortion to one tangent (Brown 1966, in OpenCV's form).

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2),
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y.
    """
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
    xy_px: Floats,
    focal_px: float,
    center_x_px: float,
    center_y_px: float,
    distortion: Distortion,
    aspect: float = 1.0,
) -> Floats:
    """Convert (N, 2) pixels to (N, 2) tangents without distortion.

    The distortion is inverted by fixed-point iteration, t <- t + (measured - distort(t)). For a distortion of a few
    percent it converges to 1e-15 in a few tens of iterations.
    """
    out = np.empty(xy_px.shape)
    no_distortion = distortion == (0.0, 0.0, 0.0, 0.0, 0.0)
    for n in range(len(out)):
        measured_x = (xy_px[n, 0] - center_x_px) / focal_px
        measured_y = (xy_px[n, 1] - center_y_px) / (aspect * focal_px)
        x = measured_x
        y = measured_y
        for _ in range(0 if no_distortion else 50):
            distorted_x, distorted_y = _distort(x, y, distortion)
            x = x + measured_x - distorted_x
            y = y + measured_y - distorted_y
            if max(abs(measured_x - distorted_x), abs(measured_y - distorted_y)) < 1e-15:
                break
        out[n, 0] = x
        out[n, 1] = y
    return out


def distortion_slopes(tangent: Floats, distortion: Distortion) -> tuple[Floats, Floats]:
    """Return the derivatives of the distorted tangent with respect to the undistorted one and to the coefficients.

    The first is (M, 2, 2) and symmetric, the second (M, 2, 5) for k1, k2, p1, p2, k3.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = tangent.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # Derivative of the radial factor by x, divided by x; by y, divided by y.
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    by = np.empty((len(x), 2, 2))
    by[:, 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    by[:, 0, 1] = by[:, 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by[:, 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    by_coefficients = [
        tangent * r2[:, None],
        tangent * r2[:, None] ** 2,
        np.column_stack([2 * x * y, r2 + 2 * y * y]),
        np.column_stack([r2 + 2 * x * x, 2 * x * y]),
        tangent * r2[:, None] ** 3,
    ]
    return by, np.stack(by_coefficients, axis=2)


def check_frame(image: object, camera: Camera) -> None:
    """Raise ImageError unless the image is a monochrome array of the camera's width and height."""
    if not isinstance(image, np.ndarray):
        reason = (
            " (cv2.imread answers None for a file that it cannot read)"
            if image is None
            else ""
        )
        raise ImageError(
            f"the image is a {type(image).__name__}{reason}; allowed: a numpy array, (height, width)"
        )
    if isinstance(image, np.ma.MaskedArray) and np.ma.is_masked(image):
        raise ImageError(
            "the image has masked pixels; allowed: image.filled(...), and the mask as Settings.bad_px"
        )
    shape = image.shape
    wanted = (camera.height_px, camera.width_px)
    if shape == wanted:
        return
    if len(shape) == 3 and (shape[2] in COLORS or shape[0] in COLORS):
        channels, axis = (shape[2], 2) if shape[2] in COLORS else (shape[0], 0)
        raise ImageError(
            f"the image has {channels} channels {shape}; allowed: monochrome, for example image.mean(axis={axis})"
        )
    size = f"{shape[1]}x{shape[0]} pixels" if len(shape) == 2 else f"of shape {shape}"
    turned = "; transposed?" if shape == wanted[::-1] else ""
    raise ImageError(
        f"the image is {size}{turned}; this camera's are {camera.width_px}x{camera.height_px}"
    )
