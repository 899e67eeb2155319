"""Self-calibration of an LED dome: LED positions, lever, lens and attitudes from frames at many attitudes.

The method is bundle adjustment (`bundle_adjustment`) from an approximate map and approximate attitudes:

1. Improve the start attitudes, and reject wrong identifications (`_reject_misidentified`).
2. Select the connected subset: lights and frames that the sightings determine (`connected_subset`).
3. Adjust all unknowns by least squares (`bundle_adjustment.adjust`).
4. Transform the solution to the gauge (`Gauge.transform`).
5. Compute the covariances, and the misfit sqrt(chi-square / redundancy). If the noise is to be fitted, multiply it by
   the misfit and repeat from step 3 (`_fit`).

Gauge freedoms, which no pixel can determine, and the constraints that fix them here:

* rotation of the lab frame (3): every light rotates by G, every body_from_lab by G^-1. Fixed by the start map (the
  survey is rotated onto it in the least-squares sense), or by the attitude of one reference frame.
* rotation of the body frame against the camera (3): body_from_lab <- B body_from_lab, lever <- B lever,
  cam_from_body <- cam_from_body B^-1. cam_from_body is therefore fixed at its start value. External attitudes, such as
  an IMU's, define both frames: `gauge.align_attitudes` computes B and G between two sets of attitudes.
* scale (1): lights and lever scale together. A known lens does not help, because a camera that rotates about the
  bearing measures only directions. One known distance between two lights fixes it, or else the mean size of the start
  map. The attitude does not depend on it.

The focal length is observable (yaw closes at 360 degrees). The principal point is observable weakly: its effect differs
from a rotation of the camera only by the square of the field angle.

Three more moves are nearly free if the field of view is narrow: conformal maps of the sphere of directions.
tan(t/2) <- k tan(t/2) for every angle t from an axis stretches each field equally in both directions, and a small
change of the lights' distances hides the stretch; only its gradient across one field remains. The scale of tilts is
then wrong by about 0.1 percent, whatever the number of lights. The start map constrains these moves if it is used as a
measurement (leds_sigma_m): each of its positions is inaccurate, but there are many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, check_lever, check_map
from estimator.calibration import bundle_adjustment as ba
from estimator.calibration.bundle_adjustment import Assumed, Bundle, Covariances, Sightings
from estimator.calibration.gauge import Gauge, Subset
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints

# Cauchy's width for 95 % efficiency under Gaussian noise (Holland & Welsch 1977), in sigmas.
CAUCHY = 2.385
LOSSES: dict[str, float] = {"linear": np.inf, "cauchy": CAUCHY}
GATE = 5.0  # residuals above this many robust sigmas are outliers in the final fit
GROSS_GATE = 6.0  # the same for the first rejection, after only the attitudes are fitted
# Least number of redundant coordinates of a survey that estimates its noise from them.
MIN_REDUNDANCY = 8
# Least rms angle of the rays to one light from their main direction; below it, the distance is undetermined.
CROSSING_RAD = 0.005
# The same for lights that connect frames before they are adjusted, when the angle is not yet exact.
CONNECTING_RAD = 2 * CROSSING_RAD
# Estimation of the noise from the residuals: number of rounds, and the misfit's difference from 1 that ends them.
NOISE_ROUNDS = 8
NOISE_TOLERANCE = 0.01


class Unconnected(ValueError):
    """Error: the frames form several groups.

    Attributes
    ----------
    frames
        Rows of the frames outside the group of the frame with most LEDs
    """

    def __init__(self, message: str, frames: Ints) -> None:
        super().__init__(message)
        self.frames = frames


@dataclass(frozen=True, slots=True)
class DomeFrame:
    """One frame of a survey: identified LEDs and their centroids.

    Attributes
    ----------
    led
        (K,) rows of the LED map
    xy_px
        (K, 2) centroids
    sigma_px
        (K,) standard deviation of each coordinate
    body_from_lab
        Start value of the attitude, accurate to a few degrees: from an IMU, or from
        nearfield.rotation_only with the old map
    """

    led: Ints
    xy_px: Floats
    sigma_px: Floats
    body_from_lab: Rotation


@dataclass(frozen=True, slots=True)
class DomeSurvey:
    """Result of a dome survey.

    The covariances are of errors against the truth if the start map is used as a measurement. Otherwise, or with a
    known length or a reference frame, they are relative to the gauge and do not include its error.

    Attributes
    ----------
    status
        "converged", or "stopped ..." if the iteration did not converge
    leds
        The map with surveyed positions; lights that are not `surveyed` keep their start
        positions
    surveyed
        (N,) whether each light is surveyed: seen in two or more tied frames, from different
        directions
    lever, camera
        Fitted lever and camera; cam_from_body is the start value
    body_from_lab
        (F,) attitudes; the start value for a frame that is not `tied`
    tied
        (F,) whether each frame is tied: it sees two or more surveyed lights
    outliers
        (K, 2) frame, and row in it, of the sightings rejected as wrong identifications
    led_covariance_m2
        (N, 3, 3) covariance of each position in the lab frame; NaN if not surveyed
    attitude_covariance_rad2
        (F, 3, 3) covariance of each attitude in body axes; NaN if not tied
    lever_covariance_m2
        (3, 3) covariance of the lever in body axes
    lens_covariance
        Covariance of the fitted elements of focal_px, center x and y, k1, k2, p1, p2
    rms_px
        RMS of the residual coordinates
    misfit
        sqrt(chi-square / redundancy), near 1 if sigma_px is correct
    noise_scale
        Factor by which sigma_px was multiplied; 1 unless the noise is fitted
    """

    status: str
    leds: LedMap
    surveyed: np.ndarray
    lever: Lever
    camera: Camera
    body_from_lab: Rotation
    tied: np.ndarray
    outliers: Ints
    led_covariance_m2: Floats
    attitude_covariance_rad2: Floats
    lever_covariance_m2: Floats
    lens_covariance: Floats
    rms_px: float
    misfit: float
    noise_scale: float = 1.0

    @property
    def focal_sigma_px(self) -> float:
        """Standard deviation of the focal length, px."""
        return float(np.sqrt(self.lens_covariance[0, 0]))

    @property
    def surveyed_leds(self) -> LedMap:
        """The map of the surveyed lights only."""
        leds = self.leds
        board = None if leds.board is None else leds.board[self.surveyed]
        position_m = leds.position_m[self.surveyed]
        return LedMap(
            leds.id[self.surveyed], position_m, leds.center_m, leds.semi_axes_m, board
        )


def survey(
    frames: Sequence[DomeFrame],
    leds_start: LedMap,
    lever_start: Lever,
    camera_start: Camera,
    known_length: tuple[int, int, float] | None = None,
    fit_distortion: bool = False,
    loss: str = "linear",
    reference_frame: int | None = None,
    leds_sigma_m: float = np.inf,
    fit_noise: bool = False,
    assumed: Assumed | None = None,
) -> DomeSurvey:
    """Survey the dome: least squares over all lights and attitudes, the lever and the lens.

    Parameters
    ----------
    frames
        Identified LEDs, centroids and start attitude of each frame
    leds_start, lever_start, camera_start
        Start values of the map, the lever and the camera
    known_length
        Rows of two lights and the distance between them in m; fixes the scale
    fit_distortion
        Also fit k1, k2, p1, p2; k3 has no visible effect in a narrow field
    loss
        "linear", or "cauchy", which tolerates wrong identifications: they are rejected with a
        robust loss first (`_reject_misidentified`), and the rest is fitted by least squares, so
        that the covariance is that of a least-squares fit. Errors of a light seen only twice are
        hard to detect
    reference_frame
        Row of the frame whose start attitude fixes the lab frame, instead of the start map
    leds_sigma_m
        Standard deviation of the start map per axis; the map is then used as a measurement,
        which the weakly determined moves need. inf: the map is only a start value
    fit_noise
        Multiply sigma_px by the misfit and fit again until the misfit is 1 (estimation of a
        variance component: Koch 1999, Parameter Estimation and Hypothesis Testing in Linear
        Models, section 3.6). The weights of pixels and map are then right even if the noise is
        known only up to a factor
    assumed
        Lever and focal length with standard deviations, used as measurements beside the map.
        Many frames determine both better. Few frames hardly determine them: a wrong lens could
        then fit misidentified lights

    Raises
    ------
    ValueError
        If the frames are malformed or do not determine the unknowns.
    Unconnected
        If the frames form several groups.
    """
    if loss not in LOSSES:
        raise ValueError(f"survey: unknown loss {loss!r}; allowed: {', '.join(LOSSES)}")
    if not leds_sigma_m > 0:
        raise ValueError(
            f"survey: leds_sigma_m is {leds_sigma_m}; allowed: above 0, inf for a start only"
        )
    if assumed and (np.isinf(leds_sigma_m) or known_length or reference_frame is not None):
        raise ValueError(
            "survey: an assumed lever needs the map for all else; allowed: a finite leds_sigma_m alone"
        )
    checks.each_of_type("survey: frames", frames, DomeFrame)
    checks.of_type("survey: camera_start", camera_start, Camera)
    check_map(leds_start)
    check_lever(leds_start, lever_start)
    sightings = _collect(frames, len(leds_start.position_m))
    free_lens = 7 if fit_distortion else 3  # focal length, center; k1, k2, p1, p2
    start = _start_bundle(frames, leds_start, lever_start, camera_start, free_lens)
    start = replace(start, map_sigma_m=leds_sigma_m, assumed=assumed)
    gauge = Gauge(known_length, reference_frame, start.map_m, start.R_body_from_lab)
    fit = _fit(start, sightings, gauge, LOSSES[loss], fit_noise)
    # The frame, and the row in it, of each rejected sighting.
    row = np.concatenate([np.arange(len(frame.led)) for frame in frames])
    outliers = np.column_stack([sightings.frame, row])[~fit.keep]
    full = fit.subset.insert_into(start, fit.subset.bundle)
    return _report(fit, full, outliers, leds_start, camera_start)


class _Fit(NamedTuple):
    """A fitted subset, the (M,) mask of sightings kept, and the quality of the fit."""

    subset: Subset
    keep: np.ndarray
    converged: bool
    covariances: Covariances
    misfit: float
    noise_scale: float


def _fit(
    start: Bundle, sightings: Sightings, gauge: Gauge, width: float, fit_noise: bool
) -> _Fit:
    """Fit the connected subset of the observations in the given gauge: the numbered steps of the module.

    Raises
    ------
    ValueError
        If the lever or the lens is undetermined.
    """
    covariances = None
    scale = 1.0
    try:
        # 1. Wrong identifications
        start, keep = _reject_misidentified(start, sightings, width)
        # 2. Connected subset
        subset = connected_subset(start, sightings, keep)
        gauge.check(subset)
        for _ in range(NOISE_ROUNDS if fit_noise else 1):
            # 3. Least squares
            scaled = replace(
                subset.sightings, sigma_px=scale * sightings.sigma_px[subset.index]
            )
            fitted, converged = ba.adjust(subset.bundle, scaled, np.inf)
            # 4. Gauge. If the map as a measurement fixes it, the fit is in that gauge already.
            if not _has_prior_gauge(fitted, gauge):
                fitted = gauge.transform(fitted, subset)
            subset = replace(subset, bundle=fitted, sightings=scaled)
            # 5. Covariances, misfit, and noise
            covariances = _covariances(subset, gauge)
            if fit_noise:
                check_redundancy(subset, covariances)
            misfit = _misfit(subset, covariances)
            if not fit_noise or abs(misfit - 1) < NOISE_TOLERANCE or not misfit > 0:
                break
            scale *= misfit
    except LinAlgError:
        pass  # a singular matrix raises the same ValueError below as a nearly singular one
    if covariances is None or not _determined(subset.bundle, covariances.shared):
        raise ValueError(
            "survey: the frames do not determine the lever or the lens; take more tilts and yaws"
        )
    return _Fit(subset, keep, converged, covariances, misfit, scale)


def _has_prior_gauge(bundle: Bundle, gauge: Gauge) -> bool:
    """Return whether the map, as a measurement, fixes rotation and scale."""
    return gauge.is_map and bool(np.isfinite(bundle.map_sigma_m))


def _covariances(subset: Subset, gauge: Gauge) -> Covariances:
    """Return the covariances of a fitted subset: of total errors if its map fixes the gauge, else relative to it."""
    bundle = subset.bundle
    terms = ba.normal_equations(bundle, subset.sightings, np.ones(len(subset.index)))
    if _has_prior_gauge(bundle, gauge):
        return ba.covariance(terms, bundle)
    return ba.covariance_in_gauge(terms, bundle, *gauge.constraints(bundle, subset))


def _misfit(subset: Subset, covariances: Covariances) -> float:
    """Return the square root of the pixels' chi-square over their redundancy."""
    chi2 = np.sum(ba.residuals(subset.bundle, subset.sightings) ** 2)
    return float(np.sqrt(chi2 / max(redundancy(subset, covariances), 1)))


def redundancy(subset: Subset, covariances: Covariances) -> float:
    """Return the number of pixel coordinates less the number of unknowns that they determine.

    With the map as a measurement, the pixels determine U - tr(C) / sigma_map^2 of the U unknowns, C the covariance of
    the lights, and the map determines the rest. Without it the pixels determine U less the four gauge freedoms. An
    assumed lever and focal length are counted in the same way as the map.
    """
    bundle = subset.bundle
    # Lights, rotations, lever, and lens, less the gauge freedoms
    unknowns = 3.0 * (len(subset.led) + len(subset.frame) + 1) + bundle.free_lens - 4
    if np.isfinite(bundle.map_sigma_m):
        by_prior = float(np.einsum("nii->", covariances.by_led)) / bundle.map_sigma_m**2
        if bundle.assumed:
            by_prior += float(bundle.assumed.weight @ np.diag(covariances.shared)[:4])
        unknowns -= max(by_prior - 4, 0.0)
    return 2 * len(subset.index) - unknowns


def check_redundancy(subset: Subset, covariances: Covariances) -> None:
    """Raise ValueError if so few coordinates are redundant that the residuals would not show a misidentified light.

    Two frames under AFIT's dome have four: one wrong light of 18 moved the lens center by four standard deviations.
    """
    spare = redundancy(subset, covariances)
    if spare < MIN_REDUNDANCY:
        raise ValueError(
            f"survey: {spare:.1f} coordinates more than they determine unknowns, fewer than the {MIN_REDUNDANCY} that"
            " show a misidentified light; take more frames"
        )


def _collect(frames: Sequence[DomeFrame], lights: int) -> Sightings:
    """Return the sightings of all frames in one table. Raises ValueError for the first malformed frame."""
    if not frames:
        raise ValueError("survey: no frames; allowed: 1 or more, typically tens")
    for k, frame in enumerate(frames):
        count = len(frame.led)
        if frame.xy_px.shape != (count, 2) or frame.sigma_px.shape != (count,):
            shapes = f"{frame.xy_px.shape} and {frame.sigma_px.shape}"
            raise ValueError(
                f"survey: frame {k} has {count} LEDs, but xy_px and sigma_px are {shapes}"
            )
        if count and not (frame.led.min() >= 0 and frame.led.max() < lights):
            raise ValueError(f"survey: frame {k} has LED rows outside of 0 to {lights - 1}")
        usable_sigma = (frame.sigma_px > 0) & (frame.sigma_px < np.inf)
        if not (np.isfinite(frame.xy_px).all() and usable_sigma.all()):
            raise ValueError(
                f"survey: frame {k} has a pixel that is not finite or a sigma_px not above 0"
            )
    return Sightings(
        np.repeat(np.arange(len(frames)), [len(frame.led) for frame in frames]),
        np.concatenate([frame.led for frame in frames]).astype(np.int64),
        np.concatenate([frame.xy_px for frame in frames]),
        np.concatenate([frame.sigma_px for frame in frames]),
    )


def _start_bundle(
    frames: Sequence[DomeFrame], leds: LedMap, lever: Lever, camera: Camera, free_lens: int
) -> Bundle:
    """Return the start values of all parameters, without priors."""
    attitudes = Rotation.concatenate([frame.body_from_lab for frame in frames])
    return Bundle(
        leds.position_m,
        attitudes.as_matrix(),
        np.array(lever.camera_body_m),
        lever.cam_from_body.as_matrix(),
        np.array([camera.focal_px, *camera.center_px, *camera.distortion]),
        free_lens,
        leds.position_m,
    )


def _reject_misidentified(
    full: Bundle, sightings: Sightings, width: float
) -> tuple[Bundle, np.ndarray]:
    """Improve the start values and reject wrong identifications; return the bundle and the (M,) mask of those kept.

    a. Fit the attitudes only. With an infinite width (least squares) this is all.
    b. Reject gross outliers: residuals beyond GROSS_GATE robust sigmas.
    c. Fit the whole bundle with Cauchy's loss, for a noise that shrinks with the residuals until it settles.
    d. Reject residuals beyond GATE robust sigmas.

    With the true noise at once, a few wrong identifications would move the lever or the lens by ten times their prior
    standard deviations, and the fit would end in a minimum where the right ones are rejected. In step c the priors
    therefore count at first as much as the pixels (graduated non-convexity: Blake and Zisserman 1987, Visual
    Reconstruction, chapter 7).
    """
    # a. Attitudes
    keep = np.ones(len(sightings.led), dtype=bool)
    subset = connected_subset(full, sightings, keep)
    fitted = ba.fit_attitudes(subset.bundle, subset.sightings, 12)
    full = subset.insert_into(full, fitted)
    if np.isinf(width):
        return full, keep
    # b. Gross outliers
    keep[subset.index] = _inliers(fitted, subset.sightings, GROSS_GATE)
    subset = connected_subset(full, sightings, keep)
    # c. Whole bundle, as long as the noise shrinks by a tenth or more
    fitted = subset.bundle
    previous = np.inf
    while (scale := ba.robust_scale(fitted, subset.sightings)) < 0.9 * previous:
        noisy = replace(subset.sightings, sigma_px=scale * subset.sightings.sigma_px)
        fitted = ba.adjust(fitted, noisy, width, decrement=0.1)[0]
        previous = scale
    # d. Outliers
    keep[subset.index] = _inliers(fitted, subset.sightings, GATE)
    return subset.insert_into(full, fitted), keep


def _inliers(bundle: Bundle, sightings: Sightings, gate: float) -> np.ndarray:
    """Return (M,) whether each residual is below `gate` robust sigmas."""
    length = np.linalg.norm(ba.residuals(bundle, sightings), axis=1)
    return length < gate * ba.robust_scale(bundle, sightings)


def connected_subset(full: Bundle, sightings: Sightings, keep: np.ndarray) -> Subset:
    """Return the subset that the sightings determine.

    1. Remove lights seen in fewer than two frames or without crossing rays, and frames that see fewer than two of the
       remaining lights, until nothing changes.
    2. Check that the coordinates suffice for the unknowns, and that the frames form one group.
    3. Renumber lights, frames and sightings from 0.

    Raises
    ------
    ValueError
        If too few sightings remain.
    Unconnected
        If they form groups of frames that are not connected.
    """
    in_front = np.isfinite(ba.residuals(full, sightings)).all(axis=1)
    index = np.flatnonzero(keep & in_front)
    lights = len(full.position_m)
    frames = len(full.R_body_from_lab)
    camera_m = np.einsum("kji,j->ki", full.R_body_from_lab, full.camera_body_m)  # in the lab
    # 1. Removing a light can leave its frames with too few lights, and the reverse.
    while True:
        led = sightings.led[index]
        frame = sightings.frame[index]
        incidence = csr_array((np.ones(len(index)), (frame, led)), shape=(frames, lights)) > 0
        angle_rad = ray_angles(full.position_m, camera_m, frame, led)
        good_led = (incidence.sum(axis=0) >= 2) & (angle_rad > CROSSING_RAD)
        good_frame = incidence @ good_led.astype(float) >= 2
        valid = good_led[led] & good_frame[frame]
        if valid.all():
            break
        index = index[valid]
    # 2. Coordinates and connection
    led_rows = np.unique(led)
    frame_rows = np.unique(frame)
    unknowns = 3 * len(led_rows) + 3 * len(frame_rows) + 3 + full.free_lens - 4
    if 2 * len(index) < unknowns or not len(index):
        raise ValueError(
            f"survey: {2 * len(index)} usable coordinates for {unknowns} unknowns; take more frames"
        )
    _check_one_group(incidence, frame_rows)
    # 3. New numbers
    numbered = replace(
        sightings.take(index),
        frame=np.searchsorted(frame_rows, frame),
        led=np.searchsorted(led_rows, led),
    )
    bundle = replace(
        full,
        position_m=full.position_m[led_rows],
        R_body_from_lab=full.R_body_from_lab[frame_rows],
        map_m=full.map_m[led_rows],
    )
    return Subset(bundle, numbered, led_rows, frame_rows, index)


def ray_angles(
    position_m: np.ndarray, camera_m: np.ndarray, frame: Ints, led: Ints
) -> np.ndarray:
    """Return the (N,) rms angle of the rays to each light from their main direction; the distance depends on it.

    The mean sin^2 of these angles is 1 minus the largest eigenvalue of the mean of u u^T. Without a sighting it is 0.

    Parameters
    ----------
    position_m
        (N, 3) positions of the lights
    camera_m
        (F, 3) positions of the camera in each frame
    frame, led
        (K,) rows of each sighting's frame and light
    """
    ray = position_m[led] - camera_m[frame]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    lights = len(position_m)
    scatter = np.zeros((lights, 3, 3))
    count = np.bincount(led, minlength=lights)
    np.add.at(scatter, led, ray[:, :, None] * ray[:, None, :])
    largest = np.linalg.eigvalsh(scatter / np.maximum(count, 1)[:, None, None])[:, 2]
    return np.sqrt(np.where(count > 0, np.maximum(1 - largest, 0.0), 0.0))


def _check_one_group(incidence: csr_array, frame_rows: Ints) -> None:
    """Raise Unconnected unless the frames form one group, each sharing two or more lights with the rest.

    A group that shares only one light with the rest could rotate about it. The group grows from the frame with the most
    lights.
    """
    # Frames by lights; the group begins with the frame with the most lights.
    table = incidence[frame_rows].astype(float)
    member = np.zeros(len(frame_rows), dtype=bool)
    member[np.argmax(table.sum(axis=1))] = True
    while True:
        leds_in_group = (table.T @ member.astype(float)) > 0
        grown = member | (table @ leds_in_group.astype(float) >= 2)
        if (grown == member).all():
            break
        member = grown
    # The message names one frame of the group and one outside it.
    if not member.all():
        first = frame_rows[member][0]
        second = frame_rows[~member][0]
        raise Unconnected(
            f"survey: the frames are not connected; {np.sum(~member)} of {len(member)}, frame {second} first, share "
            f"fewer than two LEDs with the group of frame {first}: take frames between them",
            frame_rows[~member],
        )


def _determined(fitted: Bundle, shared: Floats) -> bool:
    """Return whether the lever is determined to 10 % of the least LED distance, and the focal length to 10 %."""
    sigma = np.sqrt(np.maximum(np.diag(shared), 0))
    nearest_m = np.linalg.norm(fitted.position_m, axis=1).min()
    return bool(
        np.isfinite(sigma).all()
        and sigma[:3].max() < 0.1 * nearest_m
        and sigma[3] < 0.1 * fitted.lens[0]
    )


def _report(
    fit: _Fit, full: Bundle, outliers: Ints, leds: LedMap, camera: Camera
) -> DomeSurvey:
    """Return the survey's result: the fitted subset in the full set of lights and frames."""
    status = (
        "converged" if fit.converged else f"stopped after {ba.STEPS} steps without convergence"
    )
    subset = fit.subset
    lights = len(full.position_m)
    frames = len(full.R_body_from_lab)
    surveyed = np.zeros(lights, dtype=bool)
    tied = np.zeros(frames, dtype=bool)
    surveyed[subset.led] = tied[subset.frame] = True
    # Covariances of the subset; NaN elsewhere
    by_led = np.full((lights, 3, 3), np.nan)
    by_rotation = np.full((frames, 3, 3), np.nan)
    by_led[subset.led], by_rotation[subset.frame], shared = fit.covariances
    residual = ba.residuals(subset.bundle, subset.sightings)
    residual_px = residual * subset.sightings.sigma_px[:, None]
    focal_px, center_x, center_y, k1, k2, p1, p2, k3 = (float(value) for value in full.lens)
    return DomeSurvey(
        status,
        replace(leds, position_m=full.position_m),
        surveyed,
        Lever(full.camera_body_m, Rotation.from_matrix(full.R_cam_from_body)),
        replace(
            camera,
            focal_px=focal_px,
            center_px=(center_x, center_y),
            distortion=(k1, k2, p1, p2, k3),
        ),
        Rotation.from_matrix(full.R_body_from_lab),
        tied,
        outliers,
        by_led,
        by_rotation,
        lever_covariance_m2=shared[:3, :3],
        lens_covariance=shared[3:, 3:],
        rms_px=float(np.sqrt(np.mean(residual_px**2))),
        misfit=fit.misfit,
        noise_scale=fit.noise_scale,
    )
