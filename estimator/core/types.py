"""Data passed between the steps of the tracker: priors, blobs, centroids, matches, attitudes, filter state."""

from __future__ import annotations

from dataclasses import field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Allowed, Floats, Ints, Step, frozen
from estimator.core.errors import ImageError
from estimator.core.jit import jit

THESIS_INTENSITY = 0.04  # Padro 2012, section 3.7


PRIORS = {
    "saturation": Allowed(-np.inf, np.inf, "a number; inf if unknown"),
    "turn_rad": Allowed(-1e300, 1e300, "a finite number"),
    "intensity_threshold": Allowed(1e-300, 1.0, "above 0, up to 1"),
    "reject": Allowed(-1, 1e9, "bits of detection.classify.Flag, or -1", True),
}


@frozen
class FramePriors:
    """Prior information about a frame, known before it is processed.

    Attributes
    ----------
    streak_px
        (dx, dy) by which stars move over the sensor during the exposure, from the gyro; None if
        unknown. The sign does not matter: a streak looks the same in either direction
    saturation
        Least value of a saturated pixel; inf if unknown
    turn_rad
        Rotation of the stars about the frame's center during the exposure, with the sign of
        streak_px; as in Blobs
    intensity_threshold
        Threshold of the detector `thesis`, as a share of full scale
    reject
        Flags of `detection.classify.Flag` whose blobs are no stars; -1: all of NO_STAR. Text is searched only if its
        flag is among them

    Raises
    ------
    ImageError
        For anything but such numbers.
    """

    streak_px: Step | None = None
    saturation: float = float("inf")
    turn_rad: float = 0.0
    intensity_threshold: float = THESIS_INTENSITY
    reject: int = -1

    def __post_init__(self) -> None:
        object.__setattr__(self, "streak_px", checks.pixel_step("streak_px", self.streak_px))
        checks.store_numbers(self, "", PRIORS)


NO_PRIORS = FramePriors()


@frozen
class RateEstimate:
    """Angular rate of the camera, with its error.

    Attributes
    ----------
    rate_rad_s
        (3,) rate in camera axes: cam_from_ref changes by exp(-[rate] t) in the time t
    covariance_rad2_s2
        (3, 3) covariance of the rate
    sign_known
        False if the rate and its negative explain the data equally well, as in one frame of a
        global shutter
    """

    rate_rad_s: Floats
    covariance_rad2_s2: Floats
    sign_known: bool = True

    def resolved(self, other: RateEstimate) -> RateEstimate:
        """Return the rate with the sign that is nearer to another rate, by both covariances; itself if it is known.

        The sign stays unknown if the sign of the other rate is unknown too, or if both signs fit: the squared
        Mahalanobis distances differ by less than SIGN_CHI2.
        """
        if self.sign_known or not other.sign_known:
            return self
        information = np.linalg.inv(self.covariance_rad2_s2 + other.covariance_rad2_s2)
        apart = [sign * self.rate_rad_s - other.rate_rad_s for sign in (1, -1)]
        plus, minus = (float(difference @ information @ difference) for difference in apart)
        rate_rad_s = self.rate_rad_s if plus <= minus else -self.rate_rad_s
        return RateEstimate(
            rate_rad_s, self.covariance_rad2_s2, abs(plus - minus) > SIGN_CHI2
        )


SIGN_CHI2 = 16.0  # least difference of the chi-squares of both signs of a rate that determines the sign


class Background(NamedTuple):
    """Sky level and noise of an image, on a coarse grid of tile centers. A named tuple: kernels take both in order.

    Attributes
    ----------
    level, noise
        (rows, columns) sky level, and noise of the filtered image, in the image's units; bilinear
        between the centers
    """

    level: Floats
    noise: Floats


@frozen
class Blobs:
    """Connected pixels above the threshold, brightest first.

    Attributes
    ----------
    box_px
        (N, 4) x0, y0, x1, y1, both ends included
    xy_px
        (N, 2) flux-weighted mean position of the pixels above the threshold
    flux
        (N,) sum above the background over those pixels
    peak
        (N,) maximum of the image in the blob
    area_px
        (N,) number of pixels
    background
        Level and noise used for the detection
    flag
        (N,) bits of `estimator.detection.classify.Flag`, 0 for a normal star
    streak_px
        (dx, dy) by which the frame's stars are smeared, sign arbitrary; None if they are round
        or too few
    turn_rad
        Rotation of the stars about the frame's center c during the exposure, from the pixels' x
        to y: a star at (x, y) is smeared by streak_px + turn_rad (c_y - y, x - c_x)
    highest_px
        Height of the highest box among all blobs that were found; a column of readout smear is as high as the frame
    """

    box_px: Ints
    xy_px: Floats
    flux: Floats
    peak: Floats
    area_px: Ints
    background: Background
    flag: Ints
    streak_px: Step | None = None
    turn_rad: float = 0.0
    highest_px: int = 0

    def __len__(self) -> int:
        return len(self.flux)

    def take(self, which: NDArray) -> Blobs:
        """Select blobs by mask or index."""
        names = ("box_px", "xy_px", "flux", "peak", "area_px", "flag")
        return replace(self, **{name: getattr(self, name)[which] for name in names})


# Shape of a light's value; only numbers are required.
SHAPES: dict[str, tuple[int, ...]] = {
    "sigma_px": (),
    "flux": (),
    "covariance_px2": (2, 2),
    "streak_px": (2,),
    "streak_covariance_px2": (2, 2),
    "moments_px2": (3,),
}


@frozen
class Centroids:
    """Measured positions of the blobs, brightest first: the search begins with the first ones.

    Any array of numbers is accepted; it is stored as C-contiguous float64. The trackers check the numbers
    (`check_values`).

    Attributes
    ----------
    xy_px
        (N, 2) positions, x to the right and y down; the center of the first pixel is (0, 0)
    sigma_px
        (N,) standard deviation per coordinate; the root of the mean variance where x and y
        differ
    flux
        (N,) flux above the background, in any unit
    covariance_px2
        (N, 2, 2) covariance from a centroider that models x and y separately (streaks), else None
    streak_px
        (N, 2) vector of each light's streak, sign arbitrary, NaN where it is not measured; None
        if none is
    streak_covariance_px2
        (N, 2, 2) covariance of streak_px
    moments_px2
        (N, 3) second moments xx - yy, 2 xy, xx + yy of lights that are disks; None if not
        measured

    Raises
    ------
    ImageError
        For other shapes, or for arrays of different lengths.
    """

    xy_px: Floats
    sigma_px: Floats
    flux: Floats
    covariance_px2: Floats | None = None
    streak_px: Floats | None = None
    streak_covariance_px2: Floats | None = None
    moments_px2: Floats | None = None

    def __post_init__(self) -> None:
        xy_px = checks.floats("centroids: xy_px", self.xy_px, (None, 2))
        object.__setattr__(self, "xy_px", xy_px)
        for name, shape in SHAPES.items():
            value = getattr(self, name)
            if value is not None or not shape:
                object.__setattr__(
                    self,
                    name,
                    checks.floats(f"centroids: {name}", value, (len(xy_px), *shape)),
                )

    def check_values(self) -> None:
        """Raise ImageError unless positions are finite, sigmas in range and fluxes above 0; it takes a microsecond.

        The trackers call it for any object, `Centroids.check_values(centroids)`, and it refuses all other types.
        """
        checks.of_type("centroids", self, Centroids)
        spread = self.covariance_px2
        row, fault = _first_fault(
            self.xy_px, self.sigma_px, self.flux, NO_SPREAD if spread is None else spread
        )
        if fault:
            name, allowed = FAULTS[fault]
            value = np.asarray(getattr(self, name)[row]).tolist()
            raise ImageError(f"centroids: {name} of row {row} is {value}; allowed: {allowed}")

    def __len__(self) -> int:
        return len(self.flux)

    @classmethod
    def empty(cls) -> Centroids:
        """Return no centroids."""
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0))

    def take(self, which: NDArray) -> Centroids:
        """Select centroids by mask or index."""
        arrays = {name: getattr(self, name) for name in self.__dataclass_fields__}
        taken = {name: one[which] for name, one in arrays.items() if one is not None}
        return replace(self, **taken)


NO_SPREAD = np.empty((0, 2, 2))
# With less accurate lights every star is a candidate for each of them, and a search would take minutes.
MAX_SIGMA_PX = 20.0
# Attribute and allowed values of each fault, by the number that `_first_fault` returns.
FAULTS = {
    1: ("xy_px", "finite numbers"),
    2: ("sigma_px", f"above 0, up to {MAX_SIGMA_PX:g}"),
    3: ("flux", "finite, above 0"),
    4: ("covariance_px2", "symmetric and positive definite"),
}


@jit
def _first_fault(
    xy_px: Floats, sigma_px: Floats, flux: Floats, spread_px2: Floats
) -> tuple[int, int]:
    """Return row and number of the first fault of centroids, as in FAULTS; (0, 0) without one."""
    for n in range(len(xy_px)):
        if not (abs(xy_px[n, 0]) < np.inf and abs(xy_px[n, 1]) < np.inf):
            return n, 1
        if not 0 < sigma_px[n] <= MAX_SIGMA_PX:
            return n, 2
        if not 0 < flux[n] < np.inf:
            return n, 3
    for n in range(len(spread_px2)):
        xx = spread_px2[n, 0, 0]
        xy = spread_px2[n, 0, 1]
        yx = spread_px2[n, 1, 0]
        yy = spread_px2[n, 1, 1]
        if not (
            0 < xx < np.inf
            and 0 < yy < np.inf
            and xx * yy > xy * xy
            and abs(xy - yx) <= 1e-6 * abs(xy)
        ):
            return n, 4
    return 0, 0


@frozen
class StarMatch:
    """Correspondence between centroids and catalog stars.

    Attributes
    ----------
    observed
        (K,) row of each centroid
    star
        (K,) row of its catalog star
    cam_from_ref
        Attitude with which the matches were verified
    log10_chance
        Logarithm of the expected number of equally good chance matches over the whole search
    v_mag
        (K,) catalog magnitudes of the stars; None of LEDs
    """

    observed: Ints
    star: Ints
    cam_from_ref: Rotation
    log10_chance: float
    v_mag: Floats | None = None


@frozen
class Attitude:
    """The tracker's solution, or the reason why there is none.

    Attributes
    ----------
    status
        "solved", or the reason why there is no attitude
    cam_from_ref
        Rotation from the reference frame (ICRS for stars, lab for the dome) to camera axes, at
        mid-exposure (of the middle row with a rolling shutter); None unless solved
    covariance_rad2
        (3, 3) covariance of the small rotation in camera axes; None unless solved
    match
        Stars used; None unless solved
    rms_px
        RMS residual of the matched centroids; NaN unless solved
    camera
        Camera used, None unless solved. Where it was uncertain or did not fit the field, it has the
        fitted `focal_px`, `aspect` (width over height of a pixel) and `distortion`
    systematic_rad2
        (3, 3) part of covariance_rad2 that is common to successive frames; None if there is none
    rate
        Rate of the camera at the attitude's time; None where neither streaks nor rows determine it
    angles_compared
        Number of angles that the identifier has compared, of those that count them; None of others
    constant_rad2
        (3, 3) part of systematic_rad2 that is one rotation of the camera in all frames, such as that by the error of
        its place; None if there is none
    rivals
        Attitudes of other skies in the frame, each with its own match and evidence, the most matches first. Those of a
        solution are too weak to be the true one. Those of an ambiguous frame include the attitude that fits best
    """

    status: str
    cam_from_ref: Rotation | None = None
    covariance_rad2: Floats | None = None
    match: StarMatch | None = None
    rms_px: float = float("nan")
    camera: Camera | None = None
    systematic_rad2: Floats | None = None
    rate: RateEstimate | None = None
    angles_compared: int | None = None
    constant_rad2: Floats | None = None
    rivals: tuple[Attitude, ...] = ()

    @property
    def solved(self) -> bool:
        """Whether there is an attitude."""
        return self.cam_from_ref is not None

    @property
    def log10_chance(self) -> float:
        """Logarithm of the expected number of equally good chance matches; 0 without a match."""
        return self.match.log10_chance if self.match else 0.0

    @property
    def ra_dec_roll_deg(self) -> tuple[float, float, float]:
        """Right ascension and declination of the boresight, and the roll, under the stars; NaN unless solved."""
        if self.cam_from_ref is None:
            return (float("nan"),) * 3
        ra, dec, roll = np.degrees(ra_dec_roll_rad(self.cam_from_ref))
        return float(ra), float(dec), float(roll)


@frozen
class FilterState:
    """State estimate of the attitude filter at one time.

    Attributes
    ----------
    t_s
        Time
    body_from_ref
        Rotation from the reference frame (ICRS, or lab under the dome) to body axes
    bias_rad_s
        (3,) bias of the gyro, in body axes
    covariance
        (N, N) covariance of the small rotation in body axes (rad^2), of the bias (rad^2/s^2),
        then of `others` in order; N is 6 without others
    others
        Estimates of the filter's other states by name: "scale" (3,) of the gyro's axes,
        "misalignment" (6,) of its matrix off the diagonal, row by row (rad), "mounting" (3,) of
        the tracker in body axes (rad), of further star cameras relative to the first
        "mounting_1" and so on
    """

    t_s: float
    body_from_ref: Rotation
    bias_rad_s: Floats
    covariance: Floats
    others: dict[str, Floats] = field(default_factory=dict)

    @property
    def sigma_attitude_rad(self) -> Floats:
        """(3,) standard deviation of the attitude about each body axis."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def sigma_bias_rad_s(self) -> Floats:
        """(3,) standard deviation of the gyro bias in body axes."""
        return np.sqrt(np.diag(self.covariance)[3:6])

    def sigma(self, name: str) -> Floats:
        """Return the standard deviations of one of the `others`. Raises KeyError for a name that is not among them."""
        first = 6
        for other, values in self.others.items():
            if other == name:
                return np.sqrt(np.diag(self.covariance)[first : first + len(values)])
            first += len(values)
        raise KeyError(name)


def ra_dec_roll_rad(cam_from_icrs: Rotation) -> tuple[float, float, float]:
    """Return right ascension and declination of the boresight, and the roll: the position angle of the image's up.

    The roll is measured at the boresight from north through east. All are in radians, ra in [0, 2 pi), roll in
    (-pi, pi].
    """
    _, down, boresight = cam_from_icrs.as_matrix()
    # The second modulo is needed because -1e-17 % 2 pi is 2 pi.
    ra = np.arctan2(boresight[1], boresight[0]) % (2 * np.pi) % (2 * np.pi)
    dec = np.arctan2(boresight[2], np.hypot(boresight[0], boresight[1]))
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    # A sine of -0 would make a half turn -pi.
    return float(ra), float(dec), float(np.arctan2(0.0 - down @ east, -down @ north))
