"""Self-calibration of an LED dome: LED positions, lever, lens and attitudes from frames at many attitudes.

The method is bundle adjustment (`bundle_adjustment`) from an approximate map and approximate attitudes:

1. Improve the start attitudes, and reject wrong identifications (`_reject_misidentified`).
2. Select the connected subset: lights and frames that the sightings determine (`survey_subset`).
3. Adjust all unknowns by least squares (`bundle_adjustment.adjust`).
4. Compute the covariances, and the misfit sqrt(chi-square / redundancy). If the noise is to be fitted, multiply it by
   the misfit and repeat from step 3 (`_fit`).

Gauge freedoms, which no pixel can determine, and what fixes them here:

* rotation of the lab frame (3): every light rotates by G, every body_from_lab by G^-1. Fixed by the start map, which is
  used as a measurement: each of its positions is inaccurate (leds_sigma_m), but there are many.
* rotation of the body frame against the camera (3): body_from_lab <- B body_from_lab, lever <- B lever,
  cam_from_body <- cam_from_body B^-1. cam_from_body is therefore fixed at its start value.
* scale (1): lights and lever scale together. A known lens does not help, because a camera that rotates about the
  bearing measures only directions. The start map fixes it. The attitude does not depend on it.

The focal length is observable (yaw closes at 360 degrees). The principal point is observable weakly: its effect differs
from a rotation of the camera only by the square of the field angle.

Three more moves are nearly free if the field of view is narrow: conformal maps of the sphere of directions.
tan(t/2) <- k tan(t/2) for every angle t from an axis stretches each field equally in both directions, and a small
change of the lights' distances hides the stretch; only its gradient across one field remains. The scale of tilts is
then wrong by about 0.1 percent, whatever the number of lights. The start map constrains these moves as well.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, check_lever
from estimator.calibration import bundle_adjustment as ba
from estimator.calibration.bundle_adjustment import Assumed, Bundle, Sightings
from estimator.calibration.survey_faults import HeldFrames
from estimator.calibration.survey_subset import (
    Covariances,
    Subset,
    common_errors,
    connected_subset,
    covariance,
)
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints, frozen
from estimator.core.vectors import lengths, rms

# Cauchy's width for 95 % efficiency under Gaussian noise (Holland & Welsch 1977), in sigmas.
CAUCHY = 2.385
GATE = 5.0  # residuals above this many robust sigmas are outliers in the final fit
GROSS_GATE = 6.0  # the same for the first rejection, after only the attitudes are fitted
# Least number of redundant coordinates of a survey that estimates its noise from them.
MIN_REDUNDANCY = 8
# Estimation of the noise from the residuals: number of rounds, and the misfit's difference from 1 that ends them.
NOISE_ROUNDS = 8
NOISE_TOLERANCE = 0.01


@frozen
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
        rotation_fit.rotation_only with the old map
    """

    led: Ints
    xy_px: Floats
    sigma_px: Floats
    body_from_lab: Rotation


@frozen
class DomeSurvey(HeldFrames):
    """Result of a dome survey.

    The covariances are of errors against the truth.

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
    common_m, common_camera
        The part of the covariances that all lights, lever and lens share, as of `LedMap`: (M, N, 3)
        and (M, 11)
    """

    status: str
    surveyed: np.ndarray
    tied: np.ndarray
    outliers: Ints
    led_covariance_m2: Floats
    attitude_covariance_rad2: Floats
    lever_covariance_m2: Floats
    lens_covariance: Floats
    rms_px: float
    misfit: float
    noise_scale: float
    common_m: Floats
    common_camera: Floats

    @property
    def focal_sigma_px(self) -> float:
        """Standard deviation of the focal length, px."""
        return float(np.sqrt(self.lens_covariance[0, 0]))

    @property
    def surveyed_leds(self) -> LedMap:
        """The map of the surveyed lights only, with its covariance: of each light's own error, and common errors."""
        leds = self.leds
        row = self.surveyed
        total_m2 = self.led_covariance_m2[row]
        common_m = self.common_m[:, row]
        shared_m2 = np.einsum("mni,mnj->nij", common_m, common_m)
        return LedMap(
            leds.id[row],
            leds.position_m[row],
            leds.center_m,
            leds.semi_axes_m,
            None if leds.board is None else leds.board[row],
            float(np.sqrt(np.einsum("nii->", total_m2) / (3 * len(total_m2)))),
            total_m2 - shared_m2,
            common_m,
            self.common_camera,
        )


def survey(
    frames: Sequence[DomeFrame],
    leds_start: LedMap,
    lever_start: Lever,
    camera_start: Camera,
    fit_distortion: bool = False,
    *,
    leds_sigma_m: float,
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
    fit_distortion
        Also fit k1, k2, p1, p2; k3 has no visible effect in a narrow field
    leds_sigma_m
        Standard deviation of the start map per axis, which is used as a measurement
    fit_noise
        Multiply sigma_px by the misfit and fit again until the misfit is 1 (estimation of a variance component: Koch
        1999, Parameter Estimation and Hypothesis Testing in Linear Models, section 3.6). The weights of pixels and map
        are then right even if the noise is known only up to a factor
    assumed
        Lever and focal length with standard deviations, used as measurements like the map. Few frames hardly
        determine them: a wrong lens could then fit misidentified lights

    Raises
    ------
    ValueError
        If the frames are malformed or do not determine the unknowns.
    Unconnected
        If the frames form several groups.
    """
    if not 0 < leds_sigma_m < np.inf:
        raise ValueError(f"survey: leds_sigma_m is {leds_sigma_m}; allowed: finite, above 0")
    checks.each_of_type("survey: frames", frames, DomeFrame)
    checks.of_type("survey: camera_start", camera_start, Camera)
    check_lever(leds_start, lever_start)
    sightings = _collect(frames, len(leds_start.position_m))
    attitudes = Rotation.concatenate([frame.body_from_lab for frame in frames])
    start = Bundle.start(leds_start, lever_start, camera_start, attitudes, fit_distortion)
    start = replace(start, map_sigma_m=leds_sigma_m, assumed=assumed)
    try:
        return _fit(start, sightings, fit_noise, leds_start, camera_start)
    except LinAlgError:
        raise ValueError(
            "survey: the frames do not determine the lever or the lens; take more tilts and yaws"
        ) from None


def _fit(
    start: Bundle, sightings: Sightings, fit_noise: bool, leds: LedMap, camera: Camera
) -> DomeSurvey:
    """Fit the connected subset of the observations: the numbered steps of the module.

    Raises
    ------
    LinAlgError
        If the lever or the lens is undetermined.
    """
    scale = 1.0
    # 1. Wrong identifications
    improved, keep = _reject_misidentified(start, sightings)
    # 2. Connected subset
    subset = connected_subset(improved, sightings, keep)
    for _ in range(NOISE_ROUNDS if fit_noise else 1):
        # 3. Least squares
        scaled = replace(subset.sightings, sigma_px=scale * sightings.sigma_px[subset.index])
        fitted, status = ba.adjust(subset.bundle, scaled, np.inf)
        subset = replace(subset, bundle=fitted, sightings=scaled)
        # 4. Covariances, misfit, and noise
        covariances = covariance(subset.terms, fitted)
        if fit_noise:
            check_redundancy(subset, covariances)
        chi2 = np.sum(ba.residuals(fitted, scaled) ** 2)
        misfit = float(np.sqrt(chi2 / max(redundancy(subset, covariances), 1)))
        if not fit_noise or abs(misfit - 1) < NOISE_TOLERANCE or not misfit > 0:
            break
        scale *= misfit
    # The lever to 10 % of the least LED distance, and the focal length to 10 %
    sigma = np.sqrt(np.maximum(np.diag(covariances.shared), 0))
    nearest_m = lengths(fitted.position_m).min()
    determined = sigma[:3].max() < 0.1 * nearest_m and sigma[3] < 0.1 * fitted.lens[0]
    if not (determined and np.isfinite(sigma).all()):
        raise LinAlgError
    return _report(
        start,
        subset,
        covariances,
        leds,
        camera,
        status=status,
        # The frame, and the row in it, of each rejected sighting.
        outliers=sightings.in_frames[~keep],
        misfit=misfit,
        noise_scale=scale,
    )


def redundancy(subset: Subset, covariances: Covariances) -> float:
    """Return the number of pixel coordinates minus the number of unknowns that they determine.

    The pixels determine U - tr(C) / sigma_map^2 of the U unknowns, C the covariance of the lights, and the map
    determines the rest: at least the four gauge freedoms. An assumed lever and focal length are counted in the same way
    as the map.
    """
    bundle = subset.bundle
    # Lights, rotations, lever and lens
    unknowns = 3.0 * (len(subset.led) + len(subset.frame) + 1) + bundle.free_lens
    by_prior = float(np.einsum("nii->", covariances.by_led)) / bundle.map_sigma_m**2
    if bundle.assumed:
        by_prior += float(bundle.assumed.weight @ np.diag(covariances.shared)[:4])
    return 2 * len(subset.index) - unknowns + max(by_prior, 4.0)


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
    led = np.concatenate([frame.led for frame in frames]).astype(np.int64)
    return Sightings.of(frames, led)


def _reject_misidentified(full: Bundle, sightings: Sightings) -> tuple[Bundle, np.ndarray]:
    """Improve the start values and reject wrong identifications; return the bundle and the (M,) mask of those kept.

    a. Fit the attitudes only.
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
    subset = connected_subset(full, sightings)
    fitted = ba.fit_attitudes(subset.bundle, subset.sightings, 12)
    full = subset.insert_into(full, fitted)
    # b. Gross outliers
    keep[subset.index] = _inliers(fitted, subset.sightings, GROSS_GATE)
    subset = connected_subset(full, sightings, keep)
    # c. Whole bundle, as long as the noise shrinks by a tenth or more
    fitted = subset.bundle
    previous = np.inf
    while (scale := ba.robust_scale(fitted, subset.sightings)) < 0.9 * previous:
        noisy = replace(subset.sightings, sigma_px=scale * subset.sightings.sigma_px)
        fitted = ba.adjust(fitted, noisy, CAUCHY, decrement=0.1)[0]
        previous = scale
    # d. Outliers
    keep[subset.index] = _inliers(fitted, subset.sightings, GATE)
    return subset.insert_into(full, fitted), keep


def _inliers(bundle: Bundle, sightings: Sightings, gate: float) -> np.ndarray:
    """Return (M,) whether each residual is below `gate` robust sigmas."""
    length = lengths(ba.residuals(bundle, sightings))
    return length < gate * ba.robust_scale(bundle, sightings)


def _report(
    start: Bundle,
    subset: Subset,
    covariances: Covariances,
    leds: LedMap,
    camera: Camera,
    **quality: Any,
) -> DomeSurvey:
    """Return the survey's result: the fitted subset in the full set of lights and frames, with its quality."""
    full = subset.insert_into(start, subset.bundle)
    lights = len(full.position_m)
    frames = len(full.R_body_from_lab)
    surveyed = np.zeros(lights, dtype=bool)
    tied = np.zeros(frames, dtype=bool)
    surveyed[subset.led] = tied[subset.frame] = True
    # Covariances of the subset; NaN elsewhere
    by_led = np.full((lights, 3, 3), np.nan)
    by_rotation = np.full((frames, 3, 3), np.nan)
    by_led[subset.led], by_rotation[subset.frame], shared = covariances
    residual = ba.residuals(subset.bundle, subset.sightings)
    residual_px = residual * subset.sightings.sigma_px[:, None]
    common, by_camera = common_errors(subset.terms, subset.bundle)
    common_m = np.zeros((len(common), lights, 3))
    common_m[:, subset.led] = common
    common_camera = np.pad(by_camera, ((0, 0), (0, 8 - full.free_lens)))
    return DomeSurvey(
        leds=replace(leds, position_m=full.position_m),
        surveyed=surveyed,
        lever=Lever(full.camera_body_m, Rotation.from_matrix(full.R_cam_from_body)),
        camera=camera.with_lens(full.lens),
        body_from_lab=Rotation.from_matrix(full.R_body_from_lab),
        tied=tied,
        led_covariance_m2=by_led,
        attitude_covariance_rad2=by_rotation,
        lever_covariance_m2=shared[:3, :3],
        lens_covariance=shared[3:, 3:],
        rms_px=rms(residual_px),
        common_m=common_m,
        common_camera=common_camera,
        **quality,
    )
