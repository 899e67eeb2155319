"""What a detector and a centroider may be told beyond the frame itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from estimator.core.camera import Camera
from estimator.core.arrays import Floats, Ints


@dataclass(frozen=True, slots=True)
class FramePriors:
    """What is known of a frame before it is looked at.

    streak_px  : (dx, dy) that stars move over the sensor during the exposure, from the gyro; None where unknown.
        Its sign does not matter: the light is the same either way
    saturation : least value of a pixel that is full
    """

    streak_px: tuple[float, float] | None = None
    saturation: float = float("inf")


NO_PRIORS = FramePriors()


@dataclass(frozen=True, slots=True)
class Background:
    """Sky level and noise of an image, on a coarse grid of tile centres.

    level, noise : (rows, columns) in the image's units; between the centres both are bilinear
    tile_px      : side of a tile
    """

    level: Floats
    noise: Floats
    tile_px: int


@dataclass(frozen=True, slots=True)
class Blobs:
    """Connected pixels above the threshold, brightest first.

    box_px    : (N, 4) x0, y0, x1, y1, both ends included
    xy_px     : (N, 2) brightness-weighted middle of the pixels above the threshold
    flux      : (N,) sum above the background over those pixels
    peak      : (N,) greatest value of the image in the blob
    area_px   : (N,) how many pixels
    background: the level and noise they were found over
    flag      : (N,) of `judge.Flag`, 0 for a plain star
    streak_px : (dx, dy) that the frame's stars are smeared by, from either end; None if they are round or few
    """

    box_px: Ints
    xy_px: Floats
    flux: Floats
    peak: Floats
    area_px: Ints
    background: Background
    flag: Ints
    streak_px: tuple[float, float] | None = None

    def __len__(self) -> int:
        return len(self.flux)

    def take(self, which: NDArray[Any]) -> Blobs:
        """The chosen blobs, by mask or index."""
        names = ("box_px", "xy_px", "flux", "peak", "area_px", "flag")
        return replace(self, **{name: getattr(self, name)[which] for name in names})


@dataclass(frozen=True, slots=True)
class Centroids:
    """Where the light is, brightest first.

    xy_px    : (N, 2)
    sigma_px : (N,) standard deviation of each coordinate; of an uneven one the root of the mean variance
    flux     : (N,) above the background
    covariance_px2 : (N, 2, 2) where a centroider knows that x and y differ (streaks), else None
    """

    xy_px: Floats
    sigma_px: Floats
    flux: Floats
    covariance_px2: Floats | None = None

    def __len__(self) -> int:
        return len(self.flux)

    @classmethod
    def none(cls) -> Centroids:
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0))

    def take(self, which: NDArray[Any]) -> Centroids:
        """The chosen centroids, by mask or index."""
        spread = None if self.covariance_px2 is None else self.covariance_px2[which]
        return Centroids(self.xy_px[which], self.sigma_px[which], self.flux[which], spread)

    def weights_per_px2(self, sigma_px: Floats) -> Floats:
        """(N, 3) xx, yy, xy of the inverse covariances, for errors sigma_px all told (N,), which add to their own."""
        even = 1 / sigma_px**2
        if self.covariance_px2 is None:
            return np.stack([even, even, 0 * even], axis=1)
        more = sigma_px**2 - self.sigma_px**2
        xx, yy, xy = (self.covariance_px2[:, i, j] + more * (i == j) for i, j in ((0, 0), (1, 1), (0, 1)))
        return np.stack([yy, xx, -xy], axis=1) / (xx * yy - xy**2)[:, None]


@dataclass(frozen=True, slots=True)
class StarMatch:
    """Which centroid is which catalogue star.

    observed : (K,) rows of the centroids
    star     : (K,) rows of the catalogue
    cam_from_ref : the attitude that these matches were verified with
    log10_chance : log10 of the expected number of matches this good by chance over the whole search
    """

    observed: Ints
    star: Ints
    cam_from_ref: Rotation
    log10_chance: float


@dataclass(frozen=True, slots=True)
class Attitude:
    """The tracker's answer, or its refusal.

    status          : "solved", or the reason why there is no attitude
    cam_from_ref    : reference (ICRS for stars, lab for the dome) to camera; None unless solved
    covariance_rad2 : (3, 3) of the small rotation in camera axes; None unless solved
    match           : the stars it rests on; None unless solved
    rms_px          : of the matched centroids' residuals; NaN unless solved
    camera          : the calibration that it was solved with, fitted where it was uncertain; None unless solved
    """

    status: str
    cam_from_ref: Rotation | None = None
    covariance_rad2: Floats | None = None
    match: StarMatch | None = None
    rms_px: float = float("nan")
    camera: Camera | None = None

    @property
    def solved(self) -> bool:
        return self.cam_from_ref is not None

    @property
    def ra_dec_roll_deg(self) -> tuple[float, float, float]:
        """Boresight's right ascension and declination, and the roll, of an attitude under the stars; NaN unless solved."""
        if self.cam_from_ref is None:
            return (float("nan"),) * 3
        ra, dec, roll = np.degrees(ra_dec_roll_rad(self.cam_from_ref))
        return float(ra), float(dec), float(roll)


@dataclass(frozen=True, slots=True)
class FilterState:
    """What the attitude filter believes at a time.

    body_from_ref : reference (ICRS, or lab under the dome) to body
    bias_rad_s    : (3,) of the gyro, in body axes
    covariance    : (6, 6) of the small turn in body axes (rad^2), then of the bias (rad^2/s^2)
    """

    t_s: float
    body_from_ref: Rotation
    bias_rad_s: Floats
    covariance: Floats

    @property
    def sigma_attitude_rad(self) -> Floats:
        """(3,) about the body axes."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def sigma_bias_rad_s(self) -> Floats:
        """(3,) in body axes."""
        return np.sqrt(np.diag(self.covariance)[3:])


def ra_dec_roll_rad(cam_from_icrs: Rotation) -> tuple[float, float, float]:
    """Right ascension, declination of the boresight, and the position angle of the image's up direction.

    The roll is measured at the boresight from north through east; radians, ra in [0, 2 pi), roll in (-pi, pi].
    """
    _, down, sight = cam_from_icrs.as_matrix()
    ra = np.arctan2(sight[1], sight[0]) % (2 * np.pi) % (2 * np.pi)  # once more: -1e-17 % 2 pi is 2 pi
    dec = np.arctan2(sight[2], np.hypot(sight[0], sight[1]))
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    # A sine of -0 would make a half turn -pi.
    return float(ra), float(dec), float(np.arctan2(0.0 - down @ east, -down @ north))
