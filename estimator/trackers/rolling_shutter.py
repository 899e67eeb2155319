"""Frames of a rolling shutter: move every light to the time of the middle row, and solve as a global shutter's frame.

The rate of the camera moves the lights (`attitude.rate`). `solve_lights` takes these steps:

1. Choose candidates of the rate (`candidates`): from a gyro; otherwise from the streaks, in both signs; without
   streaks a slow one, with an error that covers streaks too short to be measured.
2. Move the lights to the time of the middle row with a candidate, and identify and solve them.
3. Fit attitude and rate together to the identified lights (`attitude.rolling`), and solve the frame again with that
   rate, until the matches stay the same.
4. Add the rate's error to the covariance.

Every stage of the tracker therefore works on lights of one time, and its tests against a wrong camera model remain
valid.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.attitude import rolling
from estimator.attitude.rate import (
    MAX_RATE_RAD_S,
    STARS,
    Sight,
    at_middle_row,
    from_moments,
    from_streaks,
)
from estimator.attitude.systematic import geometry
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Attitude, Centroids, RateEstimate, StarMatch
from estimator.core.vectors import lengths
from estimator.identification.chance import MIN_EVIDENCE_MATCHES
from estimator.identification.refusals import NO_LIGHTS, NO_STARS

SHORT_STREAK_PX = 1.5  # standard deviation of a streak that is too short to be measured
# Standard deviation of a rate without streaks, if the exposure is unknown.
SLOW_RAD_S = np.radians(0.5)
# Shear at the first and last row that is tried before the full range of slow rates
SMALL_SHEAR_PX = 1.0
# Factor of the slow rates' standard deviation in the prior of the fit: streaks that differ over the field are not
# measured either.
PRIOR_FACTOR = 4.0
# Largest relative difference of focal lengths that a rate not yet fitted causes
SAME_FOCAL = 2e-3
ROUNDS = 5  # largest number of fits: the matches change with the rate


class Lights(NamedTuple):
    """Lights of a tracker.

    Attributes
    ----------
    place_ref
        (N, 3) unit vectors of stars, or positions of LEDs from the bearing, m
    lever_cam_m
        (3,) position of the camera from the bearing, in camera axes; zeros for stars
    with_errors
        Function that returns K centroids of given lights (K,) with their total errors
    """

    place_ref: Floats
    lever_cam_m: Floats
    with_errors: Callable[[Centroids, NDArray], Centroids]

    @property
    def sight(self) -> Sight:
        """Sight of all lights, at their median distance."""
        return Sight(self.lever_cam_m, float(np.median(lengths(self.place_ref))))


def solve_lights(
    camera: Camera,
    lights: Lights,
    centroids: Centroids,
    solve_global: Callable[[Centroids], Attitude],
    rate: RateEstimate | None,
    exposure_s: float | None,
) -> Attitude:
    """Return attitude and rate by either shutter, or the refusal of too few lights.

    With a rolling shutter they are those at the middle row, or the last refusal if no candidate solves. The numbered
    steps are those of the module. Where streaks leave the sign of the rate open, some stars may match with the wrong
    one as well: both signs are tried, and the one with more evidence is kept.

    Parameters
    ----------
    solve_global
        Function that solves centroids of one time
    rate
        Rate from a gyro; None: from the frame
    exposure_s
        Exposure time; None: streaks do not determine the rate
    """
    if len(centroids) < MIN_EVIDENCE_MATCHES:
        return Attitude(NO_STARS if len(centroids) else NO_LIGHTS)
    if not camera.row_time_s:
        return with_streak_rate(solve_global(centroids), centroids, exposure_s, rate, lights)
    best: Attitude | None = None
    # 1. Candidates of the rate
    for start in candidates(camera, lights.sight, centroids, rate, exposure_s):
        # 2. to 4. Solution with a candidate
        attitude = _solve_with(camera, lights, centroids, solve_global, start, exposure_s)
        if attitude.solved and (best is None or attitude.log10_chance < best.log10_chance):
            best = attitude
        if best is not None and start[0].sign_known:
            break
    return best or attitude


def _solve_with(
    camera: Camera,
    lights: Lights,
    centroids: Centroids,
    solve_global: Callable[[Centroids], Attitude],
    start: tuple[RateEstimate, RateEstimate],
    exposure_s: float | None,
) -> Attitude:
    """Return attitude and rate from one candidate of the rate with its prior: steps 2 to 4 of the module."""
    # 2. Identification
    fitted = start[0]
    attitude = solve_global(at_middle_row(camera, centroids, fitted, lights.sight))
    matched = np.empty((2, 0), int)
    for _ in range(ROUNDS):
        # 3. Fit, until the matches stay the same
        match = attitude.match
        if match is None:
            break
        rows = np.stack([match.observed, match.star])
        if np.array_equal(rows, matched):
            break
        matched = rows
        try:
            seen = lights.with_errors(centroids.take(match.observed), match.star)
            lens = _lens(attitude, camera)
            fitted = _fit(lens, lights, seen, match, start, exposure_s)
        except ValueError as error:
            return Attitude(f"no attitude: {error}")
        # The rate's error is common to all lights, and is added in step 4.
        exact = replace(fitted, covariance_rad2_s2=np.zeros((3, 3)))
        # Identified lights are at their own distance, others at the median one.
        radius_m = np.full(len(centroids), lights.sight.radius_m)
        radius_m[match.observed] = lengths(lights.place_ref[match.star])
        sight = Sight(lights.lever_cam_m, radius_m)
        attitude = solve_global(at_middle_row(camera, centroids, exact, sight))
    # 4. Error of the rate
    match = attitude.match
    if match is None or attitude.covariance_rad2 is None:
        return attitude
    seen = lights.with_errors(centroids.take(match.observed), match.star)
    place = match.cam_from_ref.apply(lights.place_ref[match.star])
    by_rate = rolling.rate_covariance_rad2(
        _lens(attitude, camera),
        seen,
        geometry(place, place - lights.lever_cam_m).jacobian,
        fitted.covariance_rad2_s2,
    )
    return replace(attitude, covariance_rad2=attitude.covariance_rad2 + by_rate, rate=fitted)


def candidates(
    camera: Camera,
    sight: Sight,
    centroids: Centroids,
    rate: RateEstimate | None,
    exposure_s: float | None,
) -> Iterator[tuple[RateEstimate, RateEstimate]]:
    """Yield rates with which a frame is identified, each with the prior with which attitude and rate are then fitted.

    They are the gyro's alone, if it is given; otherwise those of the streaks or disks, in both signs; slow ones where
    no streak is measured.
    """
    if rate is not None:
        yield rate, rate
        if not rate.sign_known:
            reverse = replace(rate, rate_rad_s=-rate.rate_rad_s)
            yield reverse, reverse
        return
    anything = RateEstimate(np.zeros(3), MAX_RATE_RAD_S**2 * np.eye(3))
    streaks = []
    if exposure_s is not None:
        streaks = from_streaks(camera, centroids, exposure_s, sight) or from_moments(
            camera, centroids, exposure_s, sight
        )
    if streaks:
        yield from ((streak, anything) for streak in streaks)
        return
    slow_rad_s = SLOW_RAD_S
    if exposure_s is not None:
        slow_rad_s = SHORT_STREAK_PX / camera.focal_px / exposure_s
    shear_px = slow_rad_s * camera.focal_px * abs(camera.row_time_s) * camera.height_px / 2
    # About the boresight a streak is short near the center: at half the height it is as long for a greater rate.
    sigma = slow_rad_s * np.array([1.0, 1.0, 2 * camera.focal_px / camera.height_px])
    slow, prior = (
        RateEstimate(np.zeros(3), np.diag((factor * sigma) ** 2))
        for factor in (1, PRIOR_FACTOR)
    )
    if shear_px > SMALL_SHEAR_PX:
        covariance = slow.covariance_rad2_s2 * (SMALL_SHEAR_PX / shear_px) ** 2
        yield replace(slow, covariance_rad2_s2=covariance), prior
    yield slow, prior


def _fit(
    lens: Camera,
    lights: Lights,
    seen: Centroids,
    match: StarMatch,
    start: tuple[RateEstimate, RateEstimate],
    exposure_s: float | None,
) -> RateEstimate:
    """Return the rate from the matched lights of a frame.

    The times of the rows alone determine the rate with its sign. The streaks are used too if that rate determines their
    sign beyond doubt.

    Parameters
    ----------
    seen
        Centroids of the matches
    start
        Candidate of the rate, and its prior
    """
    candidate, prior = start
    places = lights.place_ref[match.star]
    # Rows alone
    first = match.cam_from_ref, candidate.rate_rad_s
    by_rows = rolling.fit(lens, seen, places, lights.lever_cam_m, first, prior)
    if exposure_s is None:
        return by_rows.rate
    # Rows and streaks
    streaks = from_streaks(lens, seen, exposure_s, _radii(lights, places))
    if not streaks:
        return by_rows.rate
    resolved = [streak.resolved(by_rows.rate) for streak in streaks]
    signed = min(
        resolved, key=lambda one: np.linalg.norm(one.rate_rad_s - by_rows.rate.rate_rad_s)
    )
    if not signed.sign_known:
        return by_rows.rate
    first = by_rows.cam_from_ref, signed.rate_rad_s
    return rolling.fit(lens, seen, places, lights.lever_cam_m, first, prior, exposure_s).rate


def _lens(attitude: Attitude, camera: Camera) -> Camera:
    """Return the camera of a solution, or the calibration where both agree.

    A search that fits the focal length also absorbs a part of the shear with it.
    """
    fitted = attitude.camera or camera
    return fitted if abs(fitted.focal_px / camera.focal_px - 1) > SAME_FOCAL else camera


def _radii(lights: Lights, places: Floats) -> Sight:
    """Return the sight of identified lights: each at its own distance from the bearing, which no attitude changes."""
    return Sight(lights.lever_cam_m, lengths(places))


def with_streak_rate(
    attitude: Attitude,
    centroids: Centroids,
    exposure_s: float | None,
    gyro: RateEstimate | None = None,
    lights: Lights | None = None,
) -> Attitude:
    """Return the attitude of a global shutter with the rate from the streaks of its lights; a gyro gives their sign."""
    match = attitude.match
    camera = attitude.camera
    if match is None or camera is None or exposure_s is None:
        return attitude
    sight = STARS if lights is None else _radii(lights, lights.place_ref[match.star])
    streaks = from_streaks(camera, centroids.take(match.observed), exposure_s, sight)
    if not streaks:
        return attitude
    return replace(attitude, rate=streaks[0] if gyro is None else streaks[0].resolved(gyro))
