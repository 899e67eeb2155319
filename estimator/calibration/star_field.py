"""Camera calibration from star fields at unknown attitudes: focal length, principal point, distortion, magnitude zero.

Star directions are known to milliarcseconds, so that the unknowns are the eight lens parameters and three attitude
angles per frame. The projection and its derivatives are those of `bundle_adjustment`, with the stars as lights at
distance 1 and no lever. Levenberg-Marquardt minimizes the weighted residuals; the attitudes are eliminated (Schur
complement), so that each step solves an 8 x 8 system whatever the number of frames. `self_calibrate` alternates
identification and calibration.

Some lens parameters are weakly observable: a shift of the principal point differs from a rotation of the camera only
by the square of the field angle, and k2 and k3 resemble k1 over a narrow field. A Gaussian prior on ordinary lenses
(`LensPrior`) constrains them. Along such directions errors of the lens and of the attitudes can cancel in the pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from estimator.attitude import wahba as kernel
from estimator.attitude.solvers import rotation
from estimator.calibration import bundle_adjustment as ba
from estimator.calibration.bundle_adjustment import Bundle, Sightings
from estimator.calibration.dome_survey import CAUCHY, GATE
from estimator.catalog.catalog import StarCatalog
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, ImageError, Ints
from estimator.core.constants import SIGMA_PER_MAD
from estimator.core.types import Attitude, Centroids

# Photometric zero point: the offset between instrumental magnitudes and catalog magnitudes.


@dataclass(frozen=True, slots=True)
class MagnitudeZero:
    """Zero point: median over the stars of V minus the instrumental magnitude -2.5 log10(flux / exposure).

    Attributes
    ----------
    sigma_mag
        Standard deviation of the offset
    scatter_mag
        Of one star about the offset, mainly by its color
    stars
        Number of different stars
    """

    offset_mag: float
    sigma_mag: float
    scatter_mag: float
    stars: int


def magnitude_zero(instrumental_mag: Floats, v_mag: Floats, vectors_ref: Floats) -> MagnitudeZero:
    """Zero point as the median over different stars of each star's median difference.

    Colors are unknown and shift a star by some tenths of a magnitude, equally in every frame; therefore the sample is
    the stars, not the sightings. The scatter is 1.4826 times the median absolute deviation, and the standard deviation
    of the median is sqrt(pi / 2) times the scatter over the square root of the number of stars. Leave out stars near
    the detection limit: only those with positive errors are detected, which biases the median.
    """
    checks.unit_rows("vectors_ref", vectors_ref, None)
    if not len(vectors_ref):
        raise ImageError("magnitude_zero: no stars; allowed: one or more")
    for name, values in (("instrumental_mag", instrumental_mag), ("v_mag", v_mag)):
        if not np.isfinite(checks.floats(name, values, (len(vectors_ref),))).all():
            raise ImageError(f"{name} has a NaN or infinity; allowed: finite")
    _, star = np.unique(vectors_ref, axis=0, return_inverse=True)
    star = np.ravel(star)
    difference = v_mag - instrumental_mag
    each = np.array([np.median(difference[star == k]) for k in range(star.max() + 1)])
    offset = float(np.median(each))
    scatter = float(SIGMA_PER_MAD * np.median(np.abs(each - offset)))
    return MagnitudeZero(
        offset, float(np.sqrt(np.pi / 2 / len(each))) * scatter, scatter, len(each)
    )


LENS = 8  # focal_px, center x and y, k1, k2, p1, p2, k3
LEAST_STARS = 3  # in a frame: two determine its attitude and leave only one coordinate for the lens
START_ROUNDS = 30  # iterations of the robust start attitude
MIN_STAR_FRACTION = (
    0.9  # self_calibrate stops at a round with fewer than this fraction of the most stars so far
)


@dataclass(frozen=True, slots=True)
class StarFrame:
    """Identified stars of one frame.

    Attributes
    ----------
    xy_px
        (K, 2)
    sigma_px
        (K,) of each coordinate
    vectors_ref
        (K, 3) unit vectors of the identified stars
    flux, v_mag
        (K,) brightness in the image and catalog magnitude, for the magnitude zero point; None
        without it
    exposure_s
        Of the frame
    """

    xy_px: Floats
    sigma_px: Floats
    vectors_ref: Floats
    flux: Floats | None = None
    v_mag: Floats | None = None
    exposure_s: float = 1.0


@dataclass(frozen=True, slots=True)
class LensPrior:
    """Prior standard deviations of the lens parameters about the start camera.

    Attributes
    ----------
    center
        Of the principal point, as a fraction of the chip's width
    radial, tangential
        Displacement by each coefficient alone in the farthest corner, as a fraction of the
        corner's distance from the center
    """

    center: float = 0.05
    radial: float = 0.2
    tangential: float = 0.02

    def sigma(self, camera: Camera) -> Floats:
        """(8,) standard deviations of focal_px (inf: no prior), center x and y, k1, k2, p1, p2, k3."""
        r = np.tan(camera.diagonal_rad / 2)
        k1 = self.radial / r**2
        p = self.tangential / (3 * r)
        center = self.center * camera.width_px
        return np.array([np.inf, center, center, k1, k1 / r**2, p, p, k1 / r**4])


@dataclass(frozen=True, slots=True)
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
        (F,) frames with three or more stars
    outliers
        (K, 2) frame, and row in it, of the stars rejected as wrong identifications
    stars
        Number of sightings used
    rms_px
        Of the residual coordinates
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
    """The camera, the (8, 8) covariance of focal_px, center x, y, k1, k2, p1, p2, k3, and the report."""

    camera: Camera
    covariance: Floats
    report: FieldReport


LENS_PRIOR = LensPrior()


def calibrate(
    frames: Sequence[StarFrame], camera_start: Camera, prior: LensPrior = LENS_PRIOR
) -> Calibration:
    """Fit the lens and every frame's attitude by least squares, from a focal length accurate to a few percent.

    Wrong identifications are tolerated: the fit first uses Cauchy's loss, its width shrinking with the median residual;
    then residuals beyond 5 sigma are rejected, and the rest is fitted by least squares, whose covariance is returned.
    Raises ValueError in one line if the frames are malformed or do not determine the lens.
    """
    checks.each_of_type("calibrate: frames", frames, StarFrame)
    checks.of_type("calibrate: camera_start", camera_start, Camera)
    checks.of_type("calibrate: prior", prior, LensPrior)
    sightings = _collect(frames)
    row = np.concatenate([np.arange(len(frame.xy_px)) for frame in frames])
    counts = np.array([len(frame.xy_px) for frame in frames])
    vectors = np.concatenate([frame.vectors_ref for frame in frames])
    problem = _start_problem(sightings, vectors, camera_start, prior, len(frames))
    keep = counts[sightings.frame] >= LEAST_STARS
    _check_enough(sightings.take(keep))
    problem = problem._replace(bundle=_fit_attitudes(problem.bundle, sightings.take(keep)))
    previous = np.inf
    # Graduated robust fit: each round shrinks the width with the residuals, until it shrinks by less than 10 %.
    while (
        current := CAUCHY * ba.robust_scale(problem.bundle, sightings.take(keep))
    ) < 0.9 * previous:
        problem, _ = _minimize(problem, sightings.take(keep), current)
        previous = current
    distance = np.linalg.norm(ba.residuals(problem.bundle, sightings), axis=1)
    keep &= distance < GATE * ba.robust_scale(problem.bundle, sightings.take(keep))
    outliers = np.column_stack([sightings.frame, row])[
        ~keep & (counts[sightings.frame] >= LEAST_STARS)
    ]
    tied = np.bincount(sightings.frame[keep], minlength=len(frames)) >= LEAST_STARS
    keep &= tied[sightings.frame]
    _check_enough(sightings.take(keep))
    problem, converged = _minimize(problem, sightings.take(keep), np.inf)
    status = "converged" if converged else f"stopped after {ba.STEPS} steps without convergence"
    return _report(
        status, problem, sightings.take(keep), tied, outliers, keep, frames, camera_start
    )


class IdentifyingTracker(Protocol):
    """Interface of the identifying tracker: a star list and a solution for centroids. StarTracker has it."""

    stars: StarCatalog

    def solve_centroids(self, centroids: Centroids) -> Attitude: ...


def self_calibrate(
    frames: Sequence[Centroids],
    tracker: Callable[[Camera, float], IdentifyingTracker],
    camera: Camera,
    focal_uncertainty: float = 0.05,
    exposure_s: float = 1.0,
    rounds: int = 8,
) -> Calibration:
    """Calibrate a camera from centroids alone: alternately identify the stars and calibrate with them.

    Stops when a round identifies the same stars as the one before (an equal number is not enough), or has lost too
    many (MIN_STAR_FRACTION). Raises ValueError if no frame is identified.

    Parameters
    ----------
    tracker
        Makes a tracker from a camera and the relative uncertainty of its focal length, 0 after
        a calibration
    camera
        Prior knowledge: the chip, and the focal length to `focal_uncertainty`
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
    for _ in range(rounds):
        identified = _identified(frames, tracker(estimate, focal_uncertainty), exposure_s)
        stars = np.concatenate([np.empty((0, 3)), *(frame.vectors_ref for frame in identified)])
        # Each round identifies with the calibrated camera, but calibrates from the start camera, which is the prior.
        if np.array_equal(stars, previous_stars) or len(stars) < MIN_STAR_FRACTION * most:
            break
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


def disagreement_px(camera: Camera, other: Camera, nodes: int = 41) -> float:
    """Rms distance over the sensor between the projections of two cameras, after the best common rotation, px.

    The rotation is removed because it is not a property of the lens: every attitude absorbs it.
    """
    x = np.linspace(-0.5, camera.width_px - 0.5, nodes)
    y = np.linspace(-0.5, camera.height_px - 0.5, nodes)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    checks.of_type("other", other, Camera)
    rays = camera.rays(xy)
    R_other_from_camera, _ = kernel.wahba(other.rays(xy), rays, np.ones(len(xy)))
    return float(
        np.sqrt(np.mean(np.sum((other.pixels(rays @ R_other_from_camera.T) - xy) ** 2, axis=1)))
    )


class _Problem(NamedTuple):
    """The bundle with the stars as lights at distance 1, and the (8,) prior lens with its standard deviations."""

    bundle: Bundle
    prior_lens: Floats
    sigma: Floats

    def cost(self, sightings: Sightings, width: float) -> tuple[float, Floats]:
        """Total loss of the pixels and the prior, and the (M,) robust weights of the sightings."""
        loss, weight = ba.cauchy(np.sum(ba.residuals(self.bundle, sightings) ** 2, axis=1), width)
        return loss + float(
            np.sum(((self.bundle.lens - self.prior_lens) / self.sigma) ** 2)
        ), weight


class _NormalEquations(NamedTuple):
    """The normal equations: (F, 3, 3) of rotations, (F, 3, 8) coupling, (8, 8) of the lens, right-hand sides."""

    rotation_blocks: Floats
    coupling: Floats
    lens: Floats
    rhs_rotation: Floats
    rhs_lens: Floats


def _collect(frames: Sequence[StarFrame]) -> Sightings:
    """The stars of all frames in one table, each sighting with its own light. Raises ValueError if malformed."""
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
        finite = np.isfinite(arrays[0]).all()
        if not (finite and np.all((arrays[1] > 0) & (arrays[1] < np.inf))):
            raise ValueError(
                f"calibrate: frame {k} has a pixel or direction that is not finite or a sigma_px not above 0"
            )
    counts = [len(frame.xy_px) for frame in frames]
    return Sightings(
        np.repeat(np.arange(len(frames)), counts),
        np.arange(sum(counts)),
        np.concatenate([frame.xy_px for frame in frames]),
        np.concatenate([frame.sigma_px for frame in frames]),
    )


def _check_enough(sightings: Sightings) -> None:
    """Raise ValueError if there are fewer coordinates than unknowns."""
    frames = len(np.unique(sightings.frame))
    if 2 * len(sightings.frame) < 3 * frames + LENS:
        raise ValueError(
            f"calibrate: {2 * len(sightings.frame)} coordinates in frames of {LEAST_STARS} stars or more, for "
            f"{3 * frames} unknowns of attitude and {LENS} of the lens; take more frames or more stars"
        )


def _start_problem(
    sightings: Sightings, vectors: Floats, camera: Camera, prior: LensPrior, count: int
) -> _Problem:
    """Start values: the start camera, and each frame's robust attitude with it."""
    lens = np.array([camera.focal_px, *camera.center_px, *camera.distortion])
    rays = camera.rays(sightings.xy_px)
    R_cam_from_ref = np.tile(np.eye(3), (count, 1, 1))
    for k in range(count):
        selected = sightings.frame == k
        if selected.sum() >= LEAST_STARS:
            R_cam_from_ref[k] = _robust_attitude(rays[selected], vectors[selected])
    bundle = Bundle(vectors, R_cam_from_ref, np.zeros(3), np.eye(3), lens, LENS, vectors)
    return _Problem(bundle, lens, prior.sigma(camera))


def _robust_attitude(rays: Floats, vectors: Floats) -> Floats:
    """(3, 3) rotation of the least sum of distances, by iteratively reweighted Wahba solutions.

    With the sum of distances (not of squares) an outlier has no more influence than any other star. Raises ValueError
    if all stars coincide.
    """
    weight = np.ones(len(rays))
    for _ in range(START_ROUNDS):
        R_cam_from_ref, _ = kernel.wahba(rays, vectors, weight)
        separation = np.linalg.norm(rays - vectors @ R_cam_from_ref.T, axis=1)
        # Without the floor, one pair of residual 0 would have infinite weight.
        weight = 1 / np.maximum(separation, 0.1 * np.median(separation) + 1e-9)
    return R_cam_from_ref


def _fit_attitudes(bundle: Bundle, sightings: Sightings) -> Bundle:
    """The bundle with every frame's attitude fitted under Cauchy's loss, the lens fixed."""
    frames = np.unique(sightings.frame)
    selected = replace(bundle, R_body_from_lab=bundle.R_body_from_lab[frames])
    numbered = replace(sightings, frame=np.searchsorted(frames, sightings.frame))
    R = bundle.R_body_from_lab.copy()
    R[frames] = ba.fit_attitudes(selected, numbered, 12).R_body_from_lab
    return replace(bundle, R_body_from_lab=R)


def _normal_equations(problem: _Problem, sightings: Sightings, weight: Floats) -> _NormalEquations:
    """The normal equations J'WJ and J'W residual, with one weight per sighting and the prior on the lens added."""
    terms = ba.linearize(problem.bundle, sightings)
    frames = len(problem.bundle.R_body_from_lab)
    by_rotation = terms.by_rotation
    by_lens = terms.by_shared[
        :, :, 3:
    ]  # the first three columns are the lever, which is fixed at zero
    weighted_rotation = weight[:, None, None] * by_rotation
    weighted_lens = weight[:, None, None] * by_lens
    rotation_blocks = np.zeros((frames, 3, 3))
    coupling = np.zeros((frames, 3, LENS))
    rhs = np.zeros((frames, 3))
    np.add.at(rotation_blocks, sightings.frame, by_rotation.transpose(0, 2, 1) @ weighted_rotation)
    np.add.at(coupling, sightings.frame, by_rotation.transpose(0, 2, 1) @ weighted_lens)
    np.add.at(rhs, sightings.frame, np.einsum("mai,ma->mi", weighted_rotation, terms.residual))
    rotation_blocks[np.bincount(sightings.frame, minlength=frames) == 0] = np.eye(
        3
    )  # unused frame: zero step
    lens = np.einsum("mai,maj->ij", weighted_lens, by_lens) + np.diag(problem.sigma**-2)
    prior_rhs = (problem.prior_lens - problem.bundle.lens) / problem.sigma**2
    return _NormalEquations(
        rotation_blocks,
        coupling,
        lens,
        rhs,
        np.einsum("mai,ma->i", weighted_lens, terms.residual) + prior_rhs,
    )


def _eliminate_attitudes(terms: _NormalEquations, damping: float) -> tuple[Floats, Floats, Floats]:
    """Eliminate the attitudes, with Marquardt's damping: (F, 3, 8) A^-1 C, (F, 3) A^-1 pull, (8, 8) Schur complement.

    A are the blocks of the attitudes, C their coupling with the lens.
    """
    blocks = terms.rotation_blocks * np.where(np.eye(3, dtype=bool), 1 + damping, 1.0)
    right_sides = np.concatenate([terms.coupling, terms.rhs_rotation[:, :, None]], axis=2)
    solved = np.asarray(np.linalg.solve(blocks, right_sides), dtype=np.float64)
    through = solved[:, :, :LENS]
    uncoupled = solved[:, :, LENS]
    matrix = terms.lens - np.einsum("fij,fik->jk", terms.coupling, through)
    matrix[np.diag_indices(LENS)] += damping * terms.lens.diagonal()
    return through, uncoupled, matrix


def _minimize(problem: _Problem, sightings: Sightings, width: float) -> tuple[_Problem, bool]:
    """Minimize over lens and attitudes by Levenberg-Marquardt; returns the problem and whether it converged.

    Parameters
    ----------
    width
        Of Cauchy's loss in sigmas; inf for least squares

    Raises
    ------
    ValueError
        If the lens is undetermined.
    """
    damping = 1e-4
    cost, weight = problem.cost(sightings, width)
    terms = _normal_equations(problem, sightings, weight)
    no_step = np.zeros(3 * len(problem.bundle.position_m))
    for _ in range(ba.STEPS):
        through, uncoupled, matrix = _eliminate_attitudes(terms, damping)
        lens = _solve_scaled(
            matrix, terms.rhs_lens - np.einsum("fij,fi->j", terms.coupling, uncoupled)
        )
        rotation = uncoupled - through @ lens
        slope = float(np.sum(terms.rhs_rotation * rotation) + terms.rhs_lens @ lens)
        step = np.concatenate([rotation.ravel(), np.zeros(3), lens])
        trial = problem._replace(bundle=problem.bundle.apply_step(no_step, step))
        new_cost, new_weight = trial.cost(sightings, width)
        # Near the minimum the costs differ only by rounding, so that a step is accepted within that.
        if new_cost <= cost * (1 + 1e-13) + 1e-20:
            problem = trial
            cost = new_cost
            damping = max(damping / 10, 1e-12)
            if slope < ba.DECREMENT:
                return problem, True
            terms = _normal_equations(problem, sightings, new_weight)
        else:
            damping *= 10
    return problem, False


def _solve_scaled(matrix: Floats, right: Floats) -> Floats:
    """matrix^-1 right for a positive definite matrix, scaled to a unit diagonal. Raises ValueError if it is not."""
    try:
        scale = 1 / np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
        factor = cho_factor(matrix * scale * scale[:, None], lower=True)
    except LinAlgError:
        raise ValueError(
            "calibrate: the frames do not determine the lens; take more stars over the field"
        ) from None
    return (scale * cho_solve(factor, (scale * right.T)).T).T


def _report(
    status: str,
    problem: _Problem,
    sightings: Sightings,
    tied: np.ndarray,
    outliers: Ints,
    keep: np.ndarray,
    frames: Sequence[StarFrame],
    camera: Camera,
) -> Calibration:
    terms = _normal_equations(problem, sightings, np.ones(len(sightings.frame)))
    through, _, matrix = _eliminate_attitudes(terms, 0.0)
    covariance = _solve_scaled(matrix, np.eye(LENS))
    attitude_covariance = np.linalg.inv(
        terms.rotation_blocks
    ) + through @ covariance @ through.transpose(0, 2, 1)
    attitude_covariance[~tied] = np.nan
    residual = ba.residuals(problem.bundle, sightings)
    R = problem.bundle.R_body_from_lab
    focal, x, y, *rest = (float(value) for value in problem.bundle.lens)
    k1, k2, p1, p2, k3 = rest
    report = FieldReport(
        status,
        Rotation.concatenate(
            [rotation(R[k]) if tied[k] else Rotation.identity() for k in range(len(R))]
        ),
        attitude_covariance,
        tied,
        outliers,
        len(sightings.frame),
        float(np.sqrt(np.mean((residual * sightings.sigma_px[:, None]) ** 2))),
        float(
            np.sqrt(np.sum(residual**2) / max(2 * len(sightings.frame) - 3 * tied.sum() - LENS, 1))
        ),
        _magnitude(frames, keep),
    )
    lens = replace(camera, focal_px=focal, center_px=(x, y), distortion=(k1, k2, p1, p2, k3))
    return Calibration(lens, covariance, report)


def _magnitude(frames: Sequence[StarFrame], keep: np.ndarray) -> MagnitudeZero | None:
    """The magnitude zero point from the stars that were kept; None unless every frame has brightnesses."""
    flux = [frame.flux for frame in frames if frame.flux is not None]
    v_mag = [frame.v_mag for frame in frames if frame.v_mag is not None]
    if not len(flux) == len(v_mag) == len(frames):
        return None
    exposure_s = np.concatenate([np.full(len(frame.xy_px), frame.exposure_s) for frame in frames])
    instrumental = -2.5 * np.log10(np.concatenate(flux) / exposure_s)
    vectors = np.concatenate([frame.vectors_ref for frame in frames])
    return magnitude_zero(instrumental[keep], np.concatenate(v_mag)[keep], vectors[keep])


def _identified(
    frames: Sequence[Centroids], tracker: IdentifyingTracker, exposure_s: float
) -> list[StarFrame]:
    """The frames that the tracker solves, with their identified stars."""
    identified = []
    for centroids in frames:
        match = tracker.solve_centroids(centroids).match
        if match is not None:
            selected = centroids.take(match.observed)
            vectors = tracker.stars.vectors[match.star]
            v_mag = tracker.stars.v_mag[match.star]
            identified.append(
                StarFrame(
                    selected.xy_px, selected.sigma_px, vectors, selected.flux, v_mag, exposure_s
                )
            )
    return identified
