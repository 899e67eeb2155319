"""Invalid images, times, rotations, maps and measurements are refused in one line with the allowed values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator import (
    AttitudeFilter,
    Camera,
    Centroids,
    DomeTracker,
    GyroModel,
    Settings,
    StarTracker,
    TrackingMode,
)
from estimator.attitude.dome_map import LedMap, Lever
from estimator.attitude.solvers import SOLVERS, covariance
from estimator.calibration import dome_survey, home_position, star_field, zero_point
from estimator.calibration.star_field import StarFrame
from estimator.catalog import catalog
from estimator.core.types import FramePriors
from estimator.detection.detect import DETECTORS
from estimator.trackers import exposure_control
from estimator.trackers.pipeline import draw

CAMERA = Camera.from_fov(640, 480, fov_deg=15)
TRACKER = StarTracker.for_sky(CAMERA)
_, XY, LIGHT = TRACKER.rich_field()
IMAGE = draw(CAMERA, XY, 3000 * LIGHT / LIGHT.max(), np.dtype("u2"))
LIGHTS = Centroids(XY, np.full(len(XY), 0.1), LIGHT)
STARS = catalog.hipparcos()
ONE = Rotation.identity()
NAN = np.nan
GYRO = GyroModel(1e-4, 1e-4, 1000.0)
UNITS = np.random.default_rng(1).normal(size=(9, 3))
UNITS /= np.linalg.norm(UNITS, axis=1, keepdims=True)
SIGMA = np.full(9, 0.1)
FRAME = StarFrame(XY[:9], SIGMA, UNITS)
LEDS = LedMap(np.arange(9), UNITS, np.zeros(3), np.ones(3))
LEVER = Lever(np.array([0, 0, 0.3]), ONE)


def made() -> AttitudeFilter:
    return AttitudeFilter(GYRO, 0.0, ONE, 0.1, 0.01)


def follower() -> TrackingMode:
    return TrackingMode(TRACKER)


def lens(focal_px: object = 9.0, **more: object) -> Camera:
    return Camera(4, 3, focal_px, (1.5, 1.0), **more)  # type: ignore[arg-type]


COLOR = np.dstack([IMAGE] * 3)
MASKED = np.ma.masked_greater(IMAGE, 300)
Case = tuple[str, Callable[[], object], str]
CAMERAS: list[Case] = [
    (
        "degrees",
        lambda: Camera.from_fov(9, 9, 14.9),
        r"fov 14\.9 rad is 854°; degrees\? allowed: fov_deg from 1\.6",
    ),
    (
        "radians",
        lambda: Camera.from_fov(9, 9, fov_deg=0.26),
        r"fov_deg is 0\.26; radians\? allowed",
    ),
    ("no field", lambda: Camera.from_fov(9, 9, fov_deg=0), "fov_deg is 0; allowed"),
    ("field NaN", lambda: Camera.from_fov(9, 9, NAN), "fov_rad is nan; allowed"),
    ("field word", lambda: Camera.from_fov(9, 9, fov_deg="15"), "fov_deg is '15'; allowed"),
    (
        "one column",
        lambda: Camera.from_fov(1, 9, 0.3),
        "width_px is 1; allowed: 2 pixels or more",
    ),
    ("focal 0", lambda: lens(0), "focal_px is 0; allowed: finite, above 0"),
    ("focal < 0", lambda: lens(-5.0), r"focal_px is -5\.0; allowed"),
    ("focal NaN", lambda: lens(NAN), "focal_px is nan; allowed"),
    ("zoom 0", lambda: CAMERA.zoomed(0), r"focal_px is 0\.0; allowed"),
    (
        "sigma < 0",
        lambda: lens(focal_sigma=-0.1),
        r"focal_sigma is -0\.1; allowed: 0 to 0\.5",
    ),
    (
        "distortion",
        lambda: lens(distortion=(0.1, 0.2)),
        r"distortion has shape \(2,\); allowed: \(5,\)",
    ),
    (
        "distortion NaN",
        lambda: lens(distortion=(NAN, 0, 0, 0, 0)),
        "distortion is .* allowed: 5 finite numbers",
    ),
    ("size", lambda: Camera(4.0, 3, 9.0, (1, 1)), r"width_px is 4\.0; allowed: whole"),
    ("rays", lambda: CAMERA.rays(np.zeros(2)), r"xy_px has shape \(2,\); allowed: \(N, 2\)"),
    ("rays of 3", lambda: CAMERA.tangents(np.zeros((4, 3))), r"allowed: \(N, 2\)"),
    (
        "pixels",
        lambda: CAMERA.pixels(np.zeros((4, 2))),
        r"vectors_cam has shape \(4, 2\); allowed: \(N, 3\)",
    ),
    ("contains", lambda: CAMERA.contains(np.zeros(2)), r"allowed: \(N, 2\)"),
]
SKIES: list[Case] = [
    ("no camera", lambda: StarTracker.for_sky(5), "camera is 5 of type int; allowed: Camera"),
    (
        "limit",
        lambda: StarTracker.for_sky(CAMERA, -5),
        "the catalog is empty at this limiting magnitude",
    ),
    ("limit word", lambda: StarTracker.for_sky(CAMERA, "6"), "limit_mag is '6'; allowed"),
    ("date", lambda: StarTracker.for_sky(CAMERA, date=5), "date: 5; allowed: a UTC date"),
    (
        "stars",
        lambda: StarTracker.for_sky(CAMERA, stars=[1]),
        r"stars is \[1\] of type list; allowed: StarCatalog",
    ),
    (
        "no stars",
        lambda: StarTracker.for_sky(CAMERA, stars=STARS.take(np.empty(0, int))),
        "the catalog is empty",
    ),
    (
        "uncertain",
        lambda: StarTracker.for_sky(CAMERA, focal_uncertainty=-0.1),
        r"focal_uncertainty is -0\.1; allowed",
    ),
    (
        "uncertain NaN",
        lambda: StarTracker.for_sky(CAMERA, focal_uncertainty=NAN),
        "focal_uncertainty is nan; allowed",
    ),
    (
        "5 %",
        lambda: StarTracker.for_sky(CAMERA, focal_uncertainty=5),
        "focal_uncertainty is 5; allowed: 0 to 0",
    ),
    (
        "vectors",
        lambda: StarTracker(CAMERA, STARS, STARS.vectors[:5]),
        r"vectors has shape \(5, 3\); allowed",
    ),
    (
        "no units",
        lambda: StarTracker(CAMERA, STARS, 2 * STARS.vectors),
        "row 0 has length 2; allowed: unit vectors",
    ),
    (
        "detector",
        lambda: StarTracker.for_sky(CAMERA, settings=Settings(detector="lokal")),
        "detector: 'lokal' is unknown; did you mean local.* allowed: components, default",
    ),
    (
        "identifier",
        lambda: StarTracker.for_sky(CAMERA, settings=Settings(identifier="piramid")),
        "identifier: 'piramid' is unknown; did you mean pyramid",
    ),
    (
        "settings",
        lambda: StarTracker.for_sky(CAMERA, settings={}),
        "settings is {} of type dict; allowed: Settings",
    ),
    ("lights", lambda: TRACKER.solve_centroids(XY), "centroids is .* allowed: Centroids"),
    (
        "effort",
        lambda: TRACKER.solve_centroids(LIGHTS, effort=TRACKER.efforts),
        rf"effort is {TRACKER.efforts}; allowed: 0 to {TRACKER.efforts - 1}, or None",
    ),
    (
        "no row",
        lambda: TRACKER.solve_matches(LIGHTS, [0, 999], [1, 2]),
        "observed: 999 is no row of",
    ),
    (
        "row < 0",
        lambda: TRACKER.solve_matches(LIGHTS, [0, 1], [-1, 2]),
        "star: -1 is no row of",
    ),
    (
        "rows",
        lambda: TRACKER.solve_matches(LIGHTS, [0, 1], [1]),
        "2 of observed, 1 of star; allowed: equal",
    ),
    (
        "vague",
        lambda: TRACKER.solve_centroids(Centroids(XY, 100 + 0 * LIGHT, LIGHT)),
        r"sigma_px of row 0 is 100\.0; allowed: above 0, up to 20",
    ),
]
IMAGES: list[Case] = [
    (
        "none",
        lambda: TRACKER.solve(None),
        "the image is a NoneType .*cv2.imread answers None",
    ),
    (
        "list",
        lambda: TRACKER.solve(IMAGE.tolist()),
        "the image is a list; allowed: a numpy array",
    ),
    (
        "color",
        lambda: TRACKER.solve(COLOR),
        r"the image has 3 channels .*allowed: monochrome.*image\.mean\(axis=2\)",
    ),
    ("planes", lambda: TRACKER.solve(np.moveaxis(COLOR, 2, 0)), r"image\.mean\(axis=0\)"),
    (
        "turned",
        lambda: TRACKER.solve(IMAGE.T),
        "480x640 pixels; transposed.* this camera's are 640x480",
    ),
    ("size", lambda: TRACKER.solve(IMAGE[:9]), "640x9 pixels; this camera's are 640x480"),
    ("row", lambda: TRACKER.solve(IMAGE[0]), r"of shape \(640,\)"),
    (
        "complex",
        lambda: TRACKER.solve(IMAGE * 1j),
        "pixels of type complex128 are not real numbers",
    ),
    (
        "masked",
        lambda: TRACKER.solve(MASKED),
        "the image has masked pixels; allowed: image.filled",
    ),
    ("NaN", lambda: TRACKER.solve(IMAGE * NAN), "NaN or infinite pixels"),
    (
        "streak",
        lambda: TRACKER.solve(IMAGE, (1.0,)),
        r"streak_px has shape \(1,\); allowed: \(2,\)",
    ),
    (
        "streak NaN",
        lambda: TRACKER.solve(IMAGE, (NAN, 1.0)),
        "streak_px is .*allowed: two finite numbers",
    ),
    *(
        (
            f"{name} {key}",
            lambda name=name, key=key, value=value: DETECTORS[name](IMAGE, **{key: value}),
            f"{key} is ",
        )
        for name in DETECTORS
        for key, value in (("threshold_sigma", -1), ("min_area_px", 0), ("max_blobs", 2.5))
    ),
    *(
        (f"{name} list", lambda name=name: DETECTORS[name]([1]), "the image is a list")
        for name in DETECTORS
    ),
    ("priors", lambda: DETECTORS["default"](IMAGE, priors=None), "priors is None"),
    ("saturation", lambda: FramePriors(None, NAN), "saturation is nan"),
]
TRACKS: list[Case] = [
    ("tracker", lambda: TrackingMode(5), "tracker is 5 of type int; allowed: StarTracker"),
    ("reach", lambda: TrackingMode(TRACKER, reach_px=-1), "reach_px is -1; allowed"),
    (
        "windows",
        lambda: TrackingMode(TRACKER, max_windows=0),
        "max_windows is 0; allowed: 3 or more",
    ),
    ("age", lambda: TrackingMode(TRACKER, max_age_s=NAN), "max_age_s is nan; allowed"),
    ("time", lambda: follower().solve(IMAGE, NAN), "t_s is nan; allowed: a finite time"),
    ("time word", lambda: follower().solve(IMAGE, "1"), "t_s is '1'"),
    (
        "matrix",
        lambda: follower().solve(IMAGE, 0.0, np.eye(3)),
        "now_from_then is .*allowed: Rotation",
    ),
    (
        "stack",
        lambda: follower().solve(IMAGE, 0.0, Rotation.identity(2)),
        "a stack of 2 rotations; allowed: one",
    ),
    ("color", lambda: follower().solve(COLOR, 0.0), "the image has 3 channels"),
    ("warm up", lambda: follower().warm_up("word"), "warm_up: dtype is 'word'"),
]
FILTERS: list[Case] = [
    ("gyro", lambda: AttitudeFilter(None, 0, ONE, 1, 1), "gyro is None"),
    ("gyro word", lambda: GyroModel("a", 1, 1), "arw_rad_sqrt_s is 'a'"),
    ("time", lambda: AttitudeFilter(GYRO, NAN, ONE, 1, 1), "t_s is nan"),
    (
        "matrix",
        lambda: AttitudeFilter(GYRO, 0, np.eye(3), 1, 1),
        "body_from_ref is .*allowed: Rotation",
    ),
    (
        "stack",
        lambda: AttitudeFilter(GYRO, 0, Rotation.identity(2), 1, 1),
        "a stack of 2 rotations",
    ),
    ("update", lambda: made().update(0, None, np.eye(3)), "body_from_ref_measured is None"),
    ("update time", lambda: made().update("0", ONE, np.eye(3)), "update: t_s is '0'"),
    ("future", lambda: made().update(5, ONE, np.eye(3)), "a solution at 5"),
    (
        "systematic",
        lambda: made().update(0, ONE, np.eye(3), -np.eye(3)),
        "systematic_rad2 .*not negative",
    ),
    (
        "crooked",
        lambda: made().update(0, ONE, np.eye(3), np.eye(3, k=1)),
        "systematic_rad2 .*symmetric",
    ),
    (
        "two",
        lambda: made().update(0, ONE, np.eye(3), np.eye(2)),
        "systematic_rad2 .*allowed: .3, 3., symmetric",
    ),
]
OTHERS: list[Case] = [
    ("no dome", lambda: DomeTracker(CAMERA, None, LEVER), "leds is None"),
    ("no lever", lambda: DomeTracker(CAMERA, LEDS, None), "lever is None"),
    (
        "solver",
        lambda: DomeTracker(CAMERA, LEDS, LEVER, Settings(identifier="saa", solver="x")),
        "solver: 'x' is unk",
    ),
    (
        "sky's",
        lambda: DomeTracker(CAMERA, LEDS, LEVER, Settings(identifier="shefex")),
        "identifier: 'shefex' is unknown.* led_pairs",
    ),
    (
        "solve",
        lambda: SOLVERS["quest"](None, UNITS, SIGMA),
        "directions: not an array of real numbers",
    ),
    ("spread", lambda: covariance(2 * UNITS, SIGMA), "allowed: unit vectors"),
    (
        "spread by",
        lambda: covariance(UNITS, SIGMA, "qest"),
        "'qest' is unknown; did you mean quest",
    ),
    ("calibrate", lambda: star_field.calibrate([None], CAMERA), "frames: number 0 is None"),
    ("calibrate by", lambda: star_field.calibrate([FRAME], None), "camera_start is None"),
    ("no prior", lambda: star_field.calibrate([FRAME], CAMERA, None), "prior is None"),
    (
        "long",
        lambda: star_field.calibrate([StarFrame(XY[:9], SIGMA, 2 * UNITS)], CAMERA),
        "allowed: unit vectors",
    ),
    (
        "self",
        lambda: star_field.self_calibrate([LIGHTS], None, CAMERA),
        "tracker is None; allowed: a function",
    ),
    (
        "self lights",
        lambda: star_field.self_calibrate([XY], lambda *_: TRACKER, CAMERA),
        "allowed: Centroids",
    ),
    (
        "survey",
        lambda: dome_survey.survey([5], LEDS, LEVER, CAMERA, leds_sigma_m=0.01),
        "frames: number 0 is 5",
    ),
    (
        "survey map",
        lambda: dome_survey.survey([], None, LEVER, CAMERA, leds_sigma_m=0.01),
        "leds is None",
    ),
    (
        "home",
        lambda: home_position.calibrate([5], CAMERA, LEDS, LEVER),
        "sightings: number 0 is 5",
    ),
    (
        "zero",
        lambda: zero_point.magnitude_zero(SIGMA, SIGMA[:3], UNITS),
        r"v_mag has shape \(3,\)",
    ),
    (
        "zero NaN",
        lambda: zero_point.magnitude_zero(SIGMA * NAN, SIGMA, UNITS),
        "instrumental_mag has a NaN",
    ),
    (
        "no zero",
        lambda: zero_point.magnitude_zero(SIGMA[:0], SIGMA[:0], UNITS[:0]),
        "no stars",
    ),
    ("control", lambda: exposure_control.Control("a"), "mean_dn is 'a'"),
    ("counts", lambda: exposure_control.Control(9.0, min_stars=-3), "min_stars is -3"),
    (
        "observe",
        lambda: exposure_control.observe(COLOR, [], 5, exposure_control.Control(9.0)),
        "allowed: monochrome",
    ),
    (
        "boxes",
        lambda: exposure_control.observe(IMAGE, None, 5, exposure_control.Control(9.0)),
        "box_px: not an array",
    ),
    (
        "box",
        lambda: exposure_control.observe(IMAGE, [1, 2], 5, exposure_control.Control(9.0)),
        r"allowed: \(N, 4\)",
    ),
]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        pytest.param(call, message, id=f"{kind}: {name}")
        for kind, cases in (
            ("camera", CAMERAS),
            ("sky", SKIES),
            ("image", IMAGES),
            ("track", TRACKS),
            ("filter", FILTERS),
            ("other", OTHERS),
        )
        for name, call, message in cases
    ],
)
def test_invalid_input_is_refused_in_one_line(
    call: Callable[[], object], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        call()
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 500
