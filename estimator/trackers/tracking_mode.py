"""Tracking mode of a star tracker: predict the attitude, centroid only in windows around the predicted stars.

1. Predict the attitude from the last one, with the gyros or with the last rate.
2. Search for the brightest predicted stars in small windows around their positions.
3. Match and fit the attitude, and accept it by the same Bayes factor as in the lost-in-space search, with the volumes
   that the windows leave to attitudes and to lights (`_window_dex`).
4. If that fails, or the last attitude is too old, solve the whole frame lost in space.
5. Add the error by a change of the rate during the exposure to the covariance (`_remember`).
"""

from dataclasses import dataclass, field, replace
from enum import IntFlag
from math import log10, pi

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.rate import center_streak_px
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core import checks
from estimator.core.camera import check_frame
from estimator.core.checks import Allowed, Floats, Step, frozen
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids, FramePriors, RateEstimate, StarMatch
from estimator.detection.background import cleaned
from estimator.detection.classify import Flag
from estimator.detection.detect import in_row_order
from estimator.detection.windows import in_windows
from estimator.identification import star_evidence
from estimator.identification.chance import ACCEPT_DEX, MIN_EVIDENCE_MATCHES
from estimator.identification.star_evidence import Hypothesis, Solution
from estimator.trackers.pipeline import (
    Clock,
    Report,
    detect_and_centroid,
    inflate_uncertainty,
    monochrome,
    run_all_stages,
)
from estimator.trackers.rolling_shutter import with_streak_rate
from estimator.trackers.star_tracker import StarTracker

WINDOW_SIGMA = 4.0  # detection threshold: lower than in a frame, as fewer pixels are searched
# Longer streaks are detected with the streak filter in the whole frame
LONGEST_STREAK_PX = 4.0
RATE_CHANGE = 0.3  # relative difference of a rate from its mean since the last attitude
ENDS_PX = 8.0  # length of a streak, of stars 0.7 px wide, whose middle is off by half as much as that of a long one
ROUGH = 3.0  # reduced chi-square above which a solution is flagged
# Least share of the expected stars in a tracked solution: a few may be right where the prediction is wrong.
LEAST_SHARE = 1 / 3
ALLOWED = {
    "reach_px": Allowed(1.0, 1e4, "1 to 10,000 pixels"),
    "max_windows": Allowed(
        MIN_EVIDENCE_MATCHES, 1e6, f"{MIN_EVIDENCE_MATCHES} or more", True
    ),
    "max_age_s": Allowed(0.0, np.inf, "0 or more"),
}


class Health(IntFlag):
    """Quality flags of a solution."""

    GOOD = 0
    LOST = 1  # no attitude
    SEARCHED = 2  # solved lost in space in this frame
    FEW = 4  # five matched stars or fewer
    MISSING = 8  # fewer than half of the expected stars are matched
    ROUGH = 16  # residuals exceed their errors: reduced chi-square above 3
    SATURATED = 32  # a star is saturated
    SMEARED = 64  # streaks are longer than eight pixels


@dataclass(slots=True)
class TrackedReport(Report):
    """A frame's report with the quality of its solution.

    Attributes
    ----------
    health
        Quality flags
    log10_odds
        Logarithm of the odds of the attitude over chance; -inf without an attitude
    chi2_per_dof
        Reduced chi-square of the residuals; NaN without an attitude
    expected
        Number of stars searched for in windows; 0 if solved lost in space
    """

    health: Health = Health.LOST
    log10_odds: float = -np.inf
    chi2_per_dof: float = float("nan")
    expected: int = 0


@frozen
class LastSolution:
    """The last attitude.

    Attributes
    ----------
    t_s
        Time of the attitude
    cam_from_ref
        Attitude
    rate_rad_s
        (3,) mean rate of the stars, in camera axes, since the attitude before: the negative of the camera's rate
    acceleration_rad_s2
        (3,) change of that rate per time; zeros if it is unknown
    step_s
        Time since the attitude before; 0 if there is none
    """

    t_s: float
    cam_from_ref: Rotation
    rate_rad_s: Floats
    acceleration_rad_s2: Floats = field(default_factory=lambda: np.zeros(3))
    step_s: float = 0.0


@dataclass(eq=False)
class TrackingMode:
    """Star tracker with memory: tracks the predicted stars, and solves lost in space if that fails.

    Attributes
    ----------
    tracker
        Lost-in-space tracker with a calibrated camera and the default identifier
    reach_px
        Half the side of a window: largest error of the prediction
    max_windows
        Largest number of windows, for the brightest stars
    max_age_s
        Largest age of the last attitude for a prediction
    last
        Last attitude; None before the first

    Raises
    ------
    ImageError
        For another tracker or for unusable numbers.
    """

    tracker: StarTracker
    reach_px: float = 8.0
    max_windows: int = 25
    max_age_s: float = 5.0
    last: LastSolution | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        checks.of_type("TrackingMode: tracker", self.tracker, StarTracker)
        if self.tracker.focal_uncertainty:
            raise ImageError(
                f"TrackingMode: focal_uncertainty is {self.tracker.focal_uncertainty}; allowed: 0"
            )
        checks.store_numbers(self, "TrackingMode: ", ALLOWED)

    def solve(
        self,
        image: NDArray,
        t_s: float,
        now_from_then: Rotation | None = None,
        streak_px: Step | None = None,
        exposure_s: float | None = None,
    ) -> TrackedReport:
        """Solve the frame at t_s. Raises ImageError for bad input; the status reports any other failure.

        A rate from streaks gets its sign from the last attitude. The frames of a rolling shutter are solved lost in
        space, with that rate.

        Parameters
        ----------
        now_from_then
            Rotation of the camera axes from the last solved frame to t_s, from the gyros; None:
            the last rate is extrapolated
        streak_px
            (dx, dy) by which stars move during the exposure, from the gyros
        exposure_s
            Exposure time, to estimate the rate from streaks
        """
        check_frame(image, self.tracker.camera)
        image = in_row_order(image)
        streak_px = checks.pixel_step("streak_px", streak_px)
        t_s = checks.number("t_s", t_s, -1e300, 1e300, "a finite time in seconds")
        if now_from_then is not None:
            checks.one_rotation("now_from_then", now_from_then)
        # 1. Prediction
        predicted = self._predict(t_s, now_from_then)
        clock = Clock()
        # 2. and 3. Windows
        report = None
        if predicted is not None:
            report = self._track(image, predicted, streak_px, clock)
        # 4. Lost in space
        if report is None:
            tracker = self.tracker
            centroids = detect_and_centroid(
                image, tracker.camera, tracker.settings, clock, streak_px
            )
            attitude = tracker.solve_centroids(centroids, clock, exposure_s=exposure_s)
            sigma_px = tracker.sigma_px(centroids)
            report = self._report(attitude, centroids, sigma_px, clock, streak_px)
        # 5. Memory
        report.attitude = self._remember(t_s, report.attitude, report.centroids, exposure_s)
        return report

    def warm_up(self, dtype: DTypeLike = np.uint16) -> None:
        """Compile all that `solve` uses, in windows and in whole frames, as `StarTracker.warm_up`; keep the memory.

        Parameters
        ----------
        dtype
            Type of the frames' pixels
        """
        self.tracker.warm_up(dtype)
        cam_from_ref, xy_px, light = self.tracker.rich_field()
        follower = TrackingMode(self.tracker, self.reach_px, self.max_windows, self.max_age_s)

        def look(image: NDArray, streak_px: Step | None) -> None:
            follower.last = LastSolution(0.0, cam_from_ref, np.zeros(3))
            follower.solve(image, 0.0, None, streak_px)

        run_all_stages(self.tracker.camera, xy_px, light, dtype, look)

    def _predict(self, t_s: float, now_from_then: Rotation | None) -> Rotation | None:
        """Return the predicted cam_from_ref, or None without a recent attitude, and with a rolling shutter."""
        last = self.last
        if (
            self.tracker.camera.row_time_s
            or last is None
            or not 0 <= t_s - last.t_s <= self.max_age_s
        ):
            return None
        if now_from_then is None:
            step_s = t_s - last.t_s
            change_s = (last.step_s + step_s) / 2  # between the middles of both steps
            rate_rad_s = last.rate_rad_s + last.acceleration_rad_s2 * change_s
            now_from_then = Rotation.from_rotvec(rate_rad_s * step_s)
        return now_from_then * last.cam_from_ref

    def _remember(
        self, t_s: float, attitude: Attitude, centroids: Centroids, exposure_s: float | None
    ) -> Attitude:
        """Store an attitude; return it with the rate of its streaks, and with the error by a change of the rate.

        1. Mean rate since the last attitude, and its change: from the mean rate before that attitude, otherwise, less
           accurately, from the rate of this frame's streaks, whose sign the mean rate determines.
        2. A streak's middle between its ends is off from its center of light, where the mean attitude of the exposure
           puts it, by a T^2 / 12, with the acceleration a along the streak in the exposure T. The fit of a streak of
           length L and width w is off by about L / (L + ENDS_PX) of that: the light fades from one end to the other by
           s = a T^2 / L, which moves the middle back by sqrt(pi) / 2 w s, as its ends have the width w. The covariance
           gets the square (`rate.image_paths` corrects what a constant rate does).

        A frame without an attitude leaves the memory unchanged.
        """
        if attitude.rate is None:
            attitude = with_streak_rate(attitude, centroids, exposure_s)
        cam_from_ref = attitude.cam_from_ref
        if cam_from_ref is None or attitude.covariance_rad2 is None:
            return attitude
        last = self.last
        rate = attitude.rate
        self.last = LastSolution(t_s, cam_from_ref, np.zeros(3))
        if last is None or not 0 < t_s - last.t_s <= self.max_age_s:
            return attitude
        # 1. Rate
        step_s = t_s - last.t_s
        between_rad_s = (cam_from_ref * last.cam_from_ref.inv()).as_rotvec() / step_s
        change_rad_s = np.zeros(3)
        if last.step_s:
            change_rad_s = between_rad_s - last.rate_rad_s
        if rate is not None:
            sigma_rad_s = RATE_CHANGE * float(np.linalg.norm(between_rad_s))
            mean = RateEstimate(-between_rad_s, sigma_rad_s**2 * np.eye(3))
            rate = rate.resolved(mean)
            if rate.sign_known and not last.step_s:
                change_rad_s = -rate.rate_rad_s - between_rad_s
        acceleration_rad_s2 = 2 * change_rad_s / (step_s + last.step_s)
        self.last = LastSolution(
            t_s, cam_from_ref, between_rad_s, acceleration_rad_s2, step_s
        )
        if rate is None or exposure_s is None:
            return replace(attitude, rate=rate)
        # 2. Acceleration
        axis = rate.rate_rad_s / np.linalg.norm(rate.rate_rad_s)
        length_px = np.hypot(*center_streak_px(self.tracker.camera, rate, exposure_s))
        share = length_px / (length_px + ENDS_PX)
        off_rad = share * exposure_s**2 / 12 * (acceleration_rad_s2 @ axis) * axis
        covariance_rad2 = attitude.covariance_rad2 + np.outer(off_rad, off_rad)
        return replace(attitude, rate=rate, covariance_rad2=covariance_rad2)

    def _track(
        self,
        image: NDArray,
        predicted: Rotation,
        streak_px: Step | None,
        clock: Clock,
    ) -> TrackedReport | None:
        """Solve from the detections in windows; None if that fails.

        1. Detect and centroid in the windows.
        2. Match the detections at the predicted attitude, and compute the evidence. Refuse it below ACCEPT_DEX.
        3. Fit the attitude. Refuse it if fewer stars than LEAST_SHARE match, or if the field is sheared.
        """
        # 1. Detections
        tracker = self.tracker
        window_centers_px = self.window_centers_px(predicted)
        windows = len(window_centers_px)
        if windows < MIN_EVIDENCE_MATCHES:
            return None
        centroids, saturated = self._in_windows(image, window_centers_px, streak_px, clock)
        if len(centroids) < MIN_EVIDENCE_MATCHES:
            return None
        # 2. Evidence
        sigma_px = tracker.sigma_px(centroids)
        detections = tracker.detections(centroids, sigma_px)
        reach_rad = self.reach_px / tracker.camera.focal_px
        gates = np.full(len(centroids), 1.5 * reach_rad)  # covers a window's corner
        hypothesis = star_evidence.evaluate(
            detections, tracker.sky, predicted.as_matrix(), 1.0, gates, -np.inf
        )
        if self._tracked_dex(windows, hypothesis) < ACCEPT_DEX:
            return None
        # 3. Attitude
        solution = star_evidence.build_solution(detections, tracker.sky, hypothesis)
        refitted = tracker.refit(centroids, solution, sigma_px)
        found = refitted.solution
        if refitted.sheared or len(found.star) < LEAST_SHARE * windows:
            return None
        tracked = found._replace(dex=self._tracked_dex(windows, found))
        refitted = refitted._replace(solution=tracked)
        attitude = tracker.attitude_of(centroids, refitted, sigma_px)
        clock.lap("solve")
        return self._report(
            attitude, centroids, sigma_px, clock, streak_px, windows, saturated
        )

    def _tracked_dex(self, windows: int, found: Hypothesis | Solution) -> float:
        """Return the evidence of an attitude, which the windows of a prediction change.

        - The prior volume of attitudes is not 8 pi^2 but that of the prediction: the boresight in a square of side
          2 reach, the roll in an interval of 2 reach over the half field.
        - Chance does not put lights anywhere on the sensor: they are those in the windows. The density of false
          lights is larger by the ratio of the sensor's area to that of the windows, for each match. Where the
          prediction is wrong, each window has a light anywhere, and three of them soon agree.
        """
        side_rad = 2 * self.reach_px / self.tracker.camera.focal_px
        left, right, top, bottom = self.tracker.sensor.field
        half = min(right - left, bottom - top) / 2
        prior_volume = side_rad**2 * min(side_rad / half, 2 * pi)
        share = min(windows * side_rad**2 / ((right - left) * (bottom - top)), 1.0)
        return found.dex + (log10(8 * pi**2 / prior_volume) + len(found.star) * log10(share))

    def window_centers_px(self, cam_from_ref: Rotation) -> Floats:
        """Return the (N, 2) predicted pixels of the brightest stars whose windows are on the sensor.

        Of stars closer together than reach_px only the brightest is kept.
        """
        tracker = self.tracker
        rows, xy = tracker.field_matcher.in_field(tracker.camera, cam_from_ref)
        inside = tracker.camera.contains(xy, self.reach_px)
        xy = xy[inside][np.argsort(rows[inside])][: 2 * self.max_windows]
        close = np.abs(xy[:, None] - xy).max(axis=2) < self.reach_px
        shadowed = np.tril(close, -1).any(axis=1)
        return xy[~shadowed][: self.max_windows]

    def _in_windows(
        self,
        image: NDArray,
        window_centers_px: Floats,
        streak_px: Step | None,
        clock: Clock,
    ) -> tuple[Centroids, bool]:
        """Return the centroids of the detections in windows, and whether any of them is saturated."""
        settings = self.tracker.settings
        priors = FramePriors(streak_px, settings.saturation, reject=settings.reject)
        # Long streaks need the streak filter: the whole frame is processed.
        if streak_px is not None and np.hypot(*streak_px) > LONGEST_STREAK_PX:
            return detect_and_centroid(
                image, self.tracker.camera, settings, clock, streak_px
            ), False
        image = monochrome(image, settings)
        image, blobs = cleaned(
            in_windows, image, priors, window_centers_px, self.reach_px, WINDOW_SIGMA
        )
        blobs = blobs.take(blobs.flag & settings.reject == 0)
        clock.lap("detect")
        centroids = CENTROIDERS[settings.centroider](image, blobs, settings.gain_e_dn, priors)
        centroids = inflate_uncertainty(centroids, blobs, settings)
        clock.lap("centroid")
        valid = np.isfinite(centroids.sigma_px) & (centroids.flux > 0)
        return centroids.take(valid), bool(np.any(blobs.flag & Flag.SATURATED))

    def _report(
        self,
        attitude: Attitude,
        centroids: Centroids,
        sigma_px: Floats,
        clock: Clock,
        streak_px: Step | None,
        expected: int = 0,
        saturated: bool = False,
    ) -> TrackedReport:
        """Return the report with quality flags; `expected` is the number of windows, 0 of a whole frame."""
        if attitude.match is None or attitude.cam_from_ref is None:
            return TrackedReport(attitude, centroids, clock.seconds)
        match: StarMatch = attitude.match
        vectors_cam = attitude.cam_from_ref.apply(self.tracker.stars.vectors[match.star])
        camera = attitude.camera or self.tracker.camera
        residual_px = camera.pixels(vectors_cam) - centroids.xy_px[match.observed]
        chi2 = float(np.sum((residual_px / sigma_px[match.observed][:, None]) ** 2))
        chi2_per_dof = chi2 / max(2 * len(match.star) - 3, 1)
        streak = float(np.hypot(*streak_px)) if streak_px is not None else 0.0
        raised = {
            Health.SEARCHED: expected == 0,
            Health.FEW: len(match.star) <= 5,
            Health.MISSING: 2 * len(match.star) < expected,
            Health.ROUGH: chi2_per_dof > ROUGH,
            Health.SATURATED: saturated,
            Health.SMEARED: streak > 8,
        }
        health = Health(sum(flag for flag, is_raised in raised.items() if is_raised))
        odds = -match.log10_chance
        return TrackedReport(
            attitude, centroids, clock.seconds, health, odds, chi2_per_dof, expected
        )
