"""Camera calibration from star fields at unknown attitudes: focal length, principal point, distortion, magnitude zero.

Star directions are known to milliarcseconds, so the unknowns are the eight lens parameters and three attitude angles
per frame. The projection and its derivatives are those of `bundle_adjustment`, with the stars as lights at distance 1
and no lever. `calibrate` takes these steps:

1. Find each frame's start attitude with the start camera, by a robust fit (`_robust_attitude`).
2. Fit the attitudes alone with Cauchy's loss.
3. Fit lens and attitudes with Cauchy's loss, whose width shrinks with the median residual.
4. Reject residuals beyond 5 sigma as wrong identifications.
5. Fit the rest by least squares (`bundle_adjustment.adjust`).
6. Compute the covariance and the diagnostics (`_report`).

The fits are those of `bundle_adjustment`, with the attitudes eliminated in place of the lights (Schur complement), so
that each step solves an 8 x 8 system whatever the number of frames. `self_calibrate` alternates identification and
calibration.

Some lens parameters are weakly observable: a shift of the principal point differs from a rotation of the camera only
by the square of the field angle, and k2 and k3 resemble k1 over a narrow field. A Gaussian prior on ordinary lenses
(`LensPrior`) constrains them. Along such directions errors of the lens and of the attitudes can cancel in the pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import LinAlgError
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from estimator.attitude import wahba as kernel
from estimator.attitude.solvers import rotation
from estimator.calibration import bundle_adjustment as ba
from estimator.calibration import survey_subset
from estimator.calibration.bundle_adjustment import Bundle, NormalEquations, Sightings
from estimator.calibration.dome_survey import CAUCHY, GATE
from estimator.calibration.zero_point import MagnitudeZero, magnitude_zero
from estimator.catalog.catalog import StarCatalog
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints, frozen
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids
from estimator.core.vectors import lengths, rms

LENS = 8  # focal_px, center x and y, k1, k2, p1, p2, k3
# In a frame: two determine its attitude and leave only one coordinate for the lens
LEAST_STARS = 3
START_ROUNDS = 30  # iterations of the robust start attitude
CALIBRATION_ROUNDS = 8  # greatest number of rounds of self_calibrate
# self_calibrate stops at a round with fewer than this fraction of the most stars so far.
MIN_STAR_FRACTION = 0.9


@frozen
class StarFrame:
    """Identified stars of one frame.

    Attributes
    ----------
    xy_px
        (K, 2) centroids
    sigma_px
        (K,) standard deviation of each coordinate
    vectors_ref
        (K, 3) unit vectors of the identified stars
    flux, v_mag
        (K,) flux in the image and catalog magnitude, for the magnitude zero point; None without
        it
    exposure_s
        Exposure time of the frame
    """

    xy_px: Floats
    sigma_px: Floats
    vectors_ref: Floats
    flux: Floats | None = None
    v_mag: Floats | None = None
    exposure_s: float = 1.0


@frozen
class LensPrior:
    """Prior standard deviations of the lens parameters about the start camera.

    Attributes
    ----------
    center
        Standard deviation of the principal point, as a fraction of the chip's width
    radial, tangential
        Standard deviation of the displacement by each coefficient alone in the farthest corner,
        as a fraction of the corner's distance from the center
    """

    center: float = 0.05
    radial: float = 0.2
    tangential: float = 0.02

    def sigma(self, camera: Camera) -> Floats:
        """Return the (8,) standard deviations of focal_px (inf: no prior), center x and y, k1, k2, p1, p2, k3."""
        # In the corner k1 displaces by k1 r^2 of r, k2 by k2 r^4, k3 by k3 r^6, and p1 or p2 by up to 3 p r.
        r = np.tan(camera.diagonal_rad / 2)
        k1 = self.radial / r**2
        p = self.tangential / (3 * r)
        center = self.center * camera.width_px
        return np.array([np.inf, center, center, k1, k1 / r**2, p, p, k1 / r**4])


@frozen
class FieldReport:
    """Diagnostics of a calibration.

    Attributes
    ----------
    status
        "converged", or "stopped ..." if the iteration did not converge
    cam_from_ref
        (F,) attitudes; identity for a frame that is not `tied`
    attitude_covariance_rad2
        (F, 3, 3) in camera axes, including the lens's errors; NaN if not tied
    tied
        (F,) whether each frame is tied: three or more of its stars are used
    outliers
        (K, 2) frame, and row in it, of the stars rejected as wrong identifications
    stars
        Number of sightings used
    rms_px
        RMS of the residual coordinates
    misfit
        sqrt(chi-square / degrees of freedom), near 1 if sigma_px is correct
    magnitude
        Zero point; None if the frames have no brightness
    """

    status: str
    cam_from_ref: Rotation
    attitude_covariance_rad2: Floats
    tied: np.ndarray
    outliers: Ints
    stars: int
    rms_px: float
    misfit: float
    magnitude: MagnitudeZero | None


class Calibration(NamedTuple):
    """Result: the camera, the (8, 8) covariance of focal_px, center x, y, k1, k2, p1, p2, k3, and the report."""

    camera: Camera
    covariance: Floats
    report: FieldReport


LENS_PRIOR = LensPrior()


def calibrate(
    frames: Sequence[StarFrame], camera_start: Camera, prior: LensPrior = LENS_PRIOR
) -> Calibration:
    """Fit the lens and every frame's attitude by least squares, from a focal length accurate to a few percent.

    The numbered steps are those of the module. Wrong identifications are tolerated: they are rejected before the
    least-squares fit, whose covariance is returned.

    Raises
    ------
    ValueError
        If the frames are malformed or do not determine the lens.
    """
    checks.each_of_type("calibrate: frames", frames, StarFrame)
    checks.of_type("calibrate: camera_start", camera_start, Camera)
    checks.of_type("calibrate: prior", prior, LensPrior)
    sightings = _collect(frames)
    vectors = np.concatenate([frame.vectors_ref for frame in frames])
    # 1. Start attitudes
    fit = _start(sightings, vectors, camera_start, prior, len(frames))
    enough = np.bincount(sightings.frame)[sightings.frame] >= LEAST_STARS
    used = sightings.take(enough)
    _check_enough(used)
    try:
        # 2. Attitudes alone, in frames with enough stars
        fit = ba.fit_attitudes(fit, used, 12)
        # 3. Graduated robust fit: each round shrinks the width with the residuals, until it shrinks by less than 10 %.
        previous = np.inf
        while (current := CAUCHY * ba.robust_scale(fit, used)) < 0.9 * previous:
            fit, _ = ba.adjust(fit, used, current)
            previous = current
        # 4. Wrong identifications
        distance = lengths(ba.residuals(fit, sightings))
        keep = enough & (distance < GATE * ba.robust_scale(fit, used))
        outliers = sightings.in_frames[~keep & enough]
        tied = np.bincount(sightings.frame[keep], minlength=len(frames)) >= LEAST_STARS
        keep &= tied[sightings.frame]
        # 5. Least squares
        used = sightings.take(keep)
        _check_enough(used)
        fit, status = ba.adjust(fit, used, np.inf)
        # 6. Covariance and diagnostics
        return _report(status, fit, used, tied, outliers, keep, frames, camera_start)
    except LinAlgError:
        raise ValueError(
            "calibrate: the frames do not determine the lens; take more stars over the field"
        ) from None


class IdentifyingTracker(Protocol):
    """Interface of a tracker that identifies stars: a star list, and a solution for centroids. StarTracker has it."""

    stars: StarCatalog

    def solve_centroids(self, centroids: Centroids) -> Attitude: ...


def self_calibrate(
    frames: Sequence[Centroids],
    tracker: Callable[[Camera, float], IdentifyingTracker],
    camera: Camera,
    focal_uncertainty: float = 0.05,
    exposure_s: float = 1.0,
) -> Calibration:
    """Calibrate a camera from centroids alone.

    Each round:

    1. Identify the stars with the camera of the last round.
    2. Stop if they are the same stars as in the round before, or if too many are lost (MIN_STAR_FRACTION).
    3. Calibrate with them, from the start camera.

    Parameters
    ----------
    frames, exposure_s
        Centroids of each frame, and their exposure time
    tracker
        Function that makes a tracker from a camera and the relative uncertainty of its focal length
    camera, focal_uncertainty
        Start camera, and the uncertainty of its focal length, which is 0 after a calibration

    Raises
    ------
    ValueError
        If no frame is identified.
    """
    checks.each_of_type("self_calibrate: frames", frames, Centroids)
    checks.of_type("self_calibrate: camera", camera, Camera)
    checks.number("self_calibrate: exposure_s", exposure_s, 1e-12, 1e12, "finite, above 0")
    if not callable(tracker):
        raise ImageError(
            f"self_calibrate: tracker is {checks.excerpt(tracker)}; allowed: a function that makes one"
        )
    best = None
    most = 0
    previous_stars = np.empty((0, 3))
    estimate = camera
    for _ in range(CALIBRATION_ROUNDS):
        # 1. Identification
        identified = _identified(frames, tracker(estimate, focal_uncertainty), exposure_s)
        stars = np.concatenate(
            [np.empty((0, 3)), *(frame.vectors_ref for frame in identified)]
        )
        # 2. Convergence
        if np.array_equal(stars, previous_stars) or len(stars) < MIN_STAR_FRACTION * most:
            break
        # 3. Calibration. The start camera is the prior, so that the rounds do not count it several times.
        best = calibrate(identified, camera)
        most = max(most, len(stars))
        previous_stars = stars
        estimate = best.camera
        focal_uncertainty = 0.0
    if best is None:
        raise ValueError(
            f"self_calibrate: no star identified in any of {len(frames)} frames; check the camera"
        )
    return best


@frozen
class _StarBundle(Bundle):
    """Bundle with the stars as lights at distance 1, whose unknowns in separate blocks are the attitudes.

    The lever and the stars are fixed, so that the lens is the only other unknown.

    Attributes
    ----------
    prior_lens, lens_sigma
        (8,) prior lens and its standard deviations
    """

    prior_lens: Floats | float = 0.0
    lens_sigma: Floats | float = np.inf

    def cost(self, sightings: Sightings, width: float) -> tuple[float, Floats]:
        """Return the total loss of the pixels and the prior, and the (M,) robust weights of the sightings."""
        loss, weight = Bundle.cost(self, sightings, width)
        from_prior = np.sum(((self.lens - self.prior_lens) / self.lens_sigma) ** 2)
        return loss + float(from_prior), weight

    def equations(self, sightings: Sightings, weight: Floats) -> NormalEquations:
        """Return the normal equations J^T W J and J^T W e, with the prior on the lens added."""
        terms = ba.linearize(self, sightings)
        frames = len(self.R_body_from_lab)
        blocks, rhs = ba.attitude_equations(terms, sightings, weight, frames)
        by_lens = terms.by_shared[:, :, 3:]  # without the lever, which is fixed at zero
        weighted = weight[:, None, None] * by_lens
        coupling = ba.summed(terms.by_rotation.mT @ weighted, sightings.frame, frames)
        lens = np.einsum("mai,maj->ij", weighted, by_lens) + np.diag(self.lens_sigma**-2.0)
        prior_rhs = (self.prior_lens - self.lens) / self.lens_sigma**2
        lens_rhs = np.einsum("mai,ma->i", weighted, terms.residual) + prior_rhs
        between = csr_array(coupling.reshape(-1, LENS).T)
        return NormalEquations(blocks, between, lens, rhs.ravel(), lens_rhs)

    def apply_step(self, led: Floats, rest: Floats) -> Bundle:
        """Return the bundle after (3 F,) small rotations and an (8,) step of the lens."""
        fixed = np.zeros(3)
        return Bundle.apply_step(self, fixed, np.concatenate([led, fixed, rest]))


def _collect(frames: Sequence[StarFrame]) -> Sightings:
    """Return the stars of all frames in one table, each sighting as its own light. Raises ValueError if malformed."""
    if not frames:
        raise ValueError("calibrate: no frames; allowed: 1 or more, typically tens")
    for k, frame in enumerate(frames):
        arrays = [np.asarray(one) for one in (frame.xy_px, frame.sigma_px, frame.vectors_ref)]
        shapes = [one.shape for one in arrays]
        count = shapes[0][0] if shapes[0] else 0
        if shapes != [(count, 2), (count,), (count, 3)]:
            raise ValueError(
                f"calibrate: frame {k} has shapes {shapes}; allowed: (K, 2), (K,), (K, 3)"
            )
        checks.unit_rows(f"calibrate: frame {k}: vectors_ref", arrays[2], count)
        usable_sigma = (arrays[1] > 0) & (arrays[1] < np.inf)
        if not (np.isfinite(arrays[0]).all() and usable_sigma.all()):
            raise ValueError(
                f"calibrate: frame {k} has a pixel or direction that is not finite or a sigma_px not above 0"
            )
    return Sightings.of(frames, np.arange(sum(len(frame.xy_px) for frame in frames)))


def _check_enough(sightings: Sightings) -> None:
    """Raise ValueError if there are fewer coordinates than unknowns."""
    frames = len(np.unique(sightings.frame))
    if 2 * len(sightings.frame) < 3 * frames + LENS:
        raise ValueError(
            f"calibrate: {2 * len(sightings.frame)} coordinates in frames of {LEAST_STARS} stars or more, for "
            f"{3 * frames} unknowns of attitude and {LENS} of the lens; take more frames or more stars"
        )


def _start(
    sightings: Sightings, vectors: Floats, camera: Camera, prior: LensPrior, count: int
) -> Bundle:
    """Return the start values: the start camera, and each frame's robust attitude with it."""
    lens = camera.lens
    rays = camera.rays(sightings.xy_px)
    R_cam_from_ref = np.tile(np.eye(3), (count, 1, 1))
    for k in range(count):
        selected = sightings.frame == k
        if selected.sum() >= LEAST_STARS:
            R_cam_from_ref[k] = _robust_attitude(rays[selected], vectors[selected])
    return _StarBundle(
        vectors,
        R_cam_from_ref,
        np.zeros(3),
        np.eye(3),
        lens,
        LENS,
        vectors,
        prior_lens=lens,
        lens_sigma=prior.sigma(camera),
    )


def _robust_attitude(rays: Floats, vectors: Floats) -> Floats:
    """Return the (3, 3) rotation of the least sum of distances, by iteratively reweighted Wahba solutions.

    With the sum of distances d (not of squares) an outlier has no more influence than any other star: the weights of
    the next solution are 1 / d.

    Raises
    ------
    ValueError
        If all stars coincide.
    """
    weight = np.ones(len(rays))
    for _ in range(START_ROUNDS):
        R_cam_from_ref, _ = kernel.wahba(rays, vectors, weight)
        separation = lengths(rays - vectors @ R_cam_from_ref.T)
        # Without the floor, one pair of residual 0 would have infinite weight.
        weight = 1 / np.maximum(separation, 0.1 * np.median(separation) + 1e-9)
    return R_cam_from_ref


def _report(
    status: str,
    bundle: Bundle,
    sightings: Sightings,
    tied: np.ndarray,
    outliers: Ints,
    keep: np.ndarray,
    frames: Sequence[StarFrame],
    camera: Camera,
) -> Calibration:
    """Return the calibration with its covariances and diagnostics.

    The lens has the covariance S^-1 with the Schur complement S, the attitudes A^-1 + A^-1 C S^-1 C^T A^-1.
    """
    # Covariances of the lens and of the attitudes
    terms = bundle.equations(sightings, np.ones(len(sightings.frame)))
    R = bundle.R_body_from_lab
    # No rotation is among the unknowns that are not eliminated.
    covariance = survey_subset.covariance(terms, replace(bundle, R_body_from_lab=R[:0]))
    attitude_covariance = covariance.by_led
    attitude_covariance[~tied] = np.nan
    # Magnitude zero point from the stars that were kept, if every frame has flux and magnitude
    flux = [frame.flux for frame in frames if frame.flux is not None]
    v_mag = [frame.v_mag for frame in frames if frame.v_mag is not None]
    zero = None
    if len(flux) == len(v_mag) == len(frames):
        exposure_s = np.concatenate(
            [np.full(len(frame.xy_px), frame.exposure_s) for frame in frames]
        )
        instrumental = -2.5 * np.log10(np.concatenate(flux) / exposure_s)
        zero = magnitude_zero(
            instrumental[keep], np.concatenate(v_mag)[keep], bundle.position_m[keep]
        )
    # Residuals
    residual = ba.residuals(bundle, sightings)
    residual_px = residual * sightings.sigma_px[:, None]
    freedom = 2 * len(sightings.frame) - 3 * tied.sum() - LENS
    attitudes = [rotation(R[k]) if tied[k] else Rotation.identity() for k in range(len(R))]
    report = FieldReport(
        status,
        Rotation.concatenate(attitudes),
        attitude_covariance,
        tied,
        outliers,
        len(sightings.frame),
        rms_px=rms(residual_px),
        misfit=float(np.sqrt(np.sum(residual**2) / max(freedom, 1))),
        magnitude=zero,
    )
    return Calibration(camera.with_lens(bundle.lens), covariance.shared, report)


def _identified(
    frames: Sequence[Centroids], tracker: IdentifyingTracker, exposure_s: float
) -> list[StarFrame]:
    """Return the frames that the tracker solves, with their identified stars."""
    identified = []
    for centroids in frames:
        match = tracker.solve_centroids(centroids).match
        if match is None:
            continue
        seen = centroids.take(match.observed)
        vectors = tracker.stars.vectors[match.star]
        v_mag = tracker.stars.v_mag[match.star]
        identified.append(
            StarFrame(seen.xy_px, seen.sigma_px, vectors, seen.flux, v_mag, exposure_s)
        )
    return identified
