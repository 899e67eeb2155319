"""The self-survey of an LED dome: frames at many attitudes give the lights' places, the lever, the lens, the attitudes.

What pixels can never tell, and what settles it here:

* a turn of the lab (3): every light turned by G, every body_from_lab by G^-1. Held by the start map (the survey is
  turned onto it in the least-squares sense), or by the attitude of one reference frame.
* a turn of the body against the camera (3): body_from_lab <- B body_from_lab, lever <- B lever, cam_from_body <-
  cam_from_body B^-1. cam_from_body is therefore held where it started: the vehicle's axes mean nothing to the camera.
  Attitudes from outside, an IMU's, define both: `gauge.common_turns` finds B and G between two sets of attitudes.
* size (1): lights and lever grow alike. A known lens does not help, because a camera that turns about the bearing
  sees directions only; one known length between two lights sets it, or else the mean size of the start map. The
  attitude does not depend on it.

The focal length *is* seen (yaw closes at 360 degrees), and so is the principal point, weakly: next to a turn of the
camera it differs by the square of the field's angle only.

Three more moves are all but free under a dome seen through a narrow field: conformal maps of the sphere of directions.
tan(t/2) <- k tan(t/2) of every angle t from an axis stretches each field alike both ways, and lights a little nearer
or further hide the stretch; only its change across one field is left. Tilts then have a wrong scale by some 0.1 per
cent, whatever the number of lights. The start map, poor light by light but rich in lights, settles it: leds_sigma_m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.calibration import bundle_adjustment as ba
from estimator.calibration.bundle_adjustment import Bundle, Sightings
from estimator.calibration.gauge import Gauge, Part
from estimator.core.arrays import Floats, Ints
from estimator.core.camera import Camera

# Cauchy's width for 95 % efficiency under Gaussian noise (Holland & Welsch 1977), in sigmas.
CAUCHY = 2.385
LOSSES: dict[str, float] = {"linear": np.inf, "cauchy": CAUCHY}
GATE = 5.0
GROSS_GATE = 6.0
CROSSING_RAD = 0.005
MEDIAN_RADIUS = np.sqrt(2 * np.log(2))  # of a two-dimensional unit Gaussian


@dataclass(frozen=True, slots=True)
class DomeFrame:
    """One frame of a survey: lights found and named.

    led      : (K,) rows of the LED map;  xy_px : (K, 2);  sigma_px : (K,) of each coordinate
    body_from_lab : where to start from, good to some degrees: an IMU's, or nearfield.rotation_only's with the old map
    """

    led: Ints
    xy_px: Floats
    sigma_px: Floats
    body_from_lab: Rotation


@dataclass(frozen=True, slots=True)
class Survey:
    """What the frames tell of dome and camera, and how well; covariances are relative to the gauge, without its error.

    status         : "converged", or "stopped ..." where the numbers are not at rest
    leds           : the map with its surveyed places; lights that are not `surveyed` stand where they started
    surveyed       : (N,) lights seen in two tied frames or more, from places apart
    lever, camera  : cam_from_body as it started
    body_from_lab  : (F,) attitudes; of a frame that is not `tied`, the start
    tied           : (F,) frames that see two surveyed lights or more
    outliers       : (K, 2) frame, and row in it, of the sightings left out as wrongly named
    led_covariance_m2 (N, 3, 3), attitude_covariance_rad2 (F, 3, 3) in body axes: NaN where not surveyed or tied
    lever_covariance_m2 (3, 3), lens_covariance: of what was fitted of focal_px, centre x and y, k1, k2, p1, p2
    rms_px         : of the residual coordinates
    misfit         : sqrt(chi-square / degrees of freedom), 1 where sigma_px is honest
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

    @property
    def focal_sigma_px(self) -> float:
        """Standard deviation of the focal length."""
        return float(np.sqrt(self.lens_covariance[0, 0]))

    @property
    def surveyed_leds(self) -> LedMap:
        """The map of surveyed lights alone."""
        board = None if self.leds.board is None else self.leds.board[self.surveyed]
        kept = self.leds.id[self.surveyed], self.leds.position_m[self.surveyed]
        return LedMap(*kept, self.leds.centre_m, self.leds.semi_axes_m, board)


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
) -> Survey:
    """Least squares over every light, attitude, the lever and the lens at once; the module says what fixes the gauge.

    known_length: rows of two lights and the metres between them. fit_distortion: k1, k2, p1, p2 too; k3 moves no
    pixel of a narrow lens. loss: "linear", or "cauchy", which survives wrong names: iteratively reweighted, its width
    shrinking with the median residual, then what lies beyond 5 sigma is left out and the rest fitted by plain least
    squares, so that the covariance is that of a plain fit. A light seen but twice has hardly a check on its names.
    reference_frame: its start attitude holds the lab, instead of the start map. leds_sigma_m: how well the start map
    is known, each axis; it then takes part as a measurement, which the weak moves need. inf: a start, no more.
    Raises ValueError in one line where the frames are malformed or do not determine the unknowns.
    """
    if loss not in LOSSES:
        raise ValueError(f"survey: loss {loss!r} is none of {', '.join(LOSSES)}")
    if not leds_sigma_m > 0:
        raise ValueError(f"survey: leds_sigma_m is {leds_sigma_m}; allowed: above 0, inf for a start only")
    seen = _gathered(frames, len(leds_start.position_m))
    start = _start(frames, leds_start, lever_start, camera_start, 7 if fit_distortion else 3)
    start = replace(start, map_sigma_m=leds_sigma_m)
    gauge = Gauge.of(known_length, reference_frame, start.map_m, start.R_body_from_lab)
    part, keep, at_rest, spread = _settled(start, seen, gauge, LOSSES[loss])
    status = "converged" if at_rest else f"stopped after {ba.STEPS} steps, not at rest"
    row = np.concatenate([np.arange(len(frame.led)) for frame in frames])
    outliers = np.column_stack([seen.frame, row])[~keep]
    return _report(status, part, part.into(start, part.bundle), spread, outliers, leds_start, camera_start)


def _settled(
    start: Bundle, seen: Sightings, gauge: Gauge, width: float
) -> tuple[Part, np.ndarray, bool, tuple[Floats, Floats, Floats]]:
    """The part that hangs together at its best, which sightings were kept, whether it is at rest, covariances."""
    spread = None
    try:
        near, keep = _without_strangers(start, seen, width)
        part = _tied(near, seen, keep)
        gauge.check(part)
        found, at_rest = ba.adjust(part.bundle, part.seen, np.inf)
        found = gauge.onto(found, part)
        part = replace(part, bundle=found)
        terms = ba.normal(found, part.seen, np.ones(len(part.index)))
        spread = ba.covariance(terms, found, *gauge.held(found, part))
    except LinAlgError:
        pass  # a matrix that is singular is refused below, as one that is nearly so
    if spread is None or not _determined(found, spread[2]):
        raise ValueError("survey: the frames leave the lever or the lens unknown; take more tilts and yaws")
    return part, keep, at_rest, spread


def _gathered(frames: Sequence[DomeFrame], lights: int) -> Sightings:
    """All frames' sightings in one table. Raises ValueError for the first that is malformed."""
    if not frames:
        raise ValueError("survey: no frames; a dome needs some tens")
    for k, frame in enumerate(frames):
        count = len(frame.led)
        if frame.xy_px.shape != (count, 2) or frame.sigma_px.shape != (count,):
            shapes = f"{frame.xy_px.shape} and {frame.sigma_px.shape}"
            raise ValueError(f"survey: frame {k} has {count} LEDs, but xy_px and sigma_px are {shapes}")
        if count and not (frame.led.min() >= 0 and frame.led.max() < lights):
            raise ValueError(f"survey: frame {k} names LED rows outside of 0 to {lights - 1}")
        if not (np.isfinite(frame.xy_px).all() and np.all((frame.sigma_px > 0) & (frame.sigma_px < np.inf))):
            raise ValueError(f"survey: frame {k} has a pixel that is not finite or a sigma_px not above 0")
    return Sightings(
        np.repeat(np.arange(len(frames)), [len(frame.led) for frame in frames]),
        np.concatenate([frame.led for frame in frames]).astype(np.int64),
        np.concatenate([frame.xy_px for frame in frames]),
        np.concatenate([frame.sigma_px for frame in frames]),
    )


def _start(frames: Sequence[DomeFrame], leds: LedMap, lever: Lever, camera: Camera, free_lens: int) -> Bundle:
    lens = np.array([camera.focal_px, *camera.centre_px, *camera.distortion])
    turned = Rotation.concatenate([frame.body_from_lab for frame in frames]).as_matrix()
    R_cam_from_body = lever.cam_from_body.as_matrix()
    return Bundle(
        leds.position_m,
        turned,
        np.array(lever.camera_body_m),
        R_cam_from_body,
        lens,
        free_lens,
        leds.position_m,
    )


def _without_strangers(whole: Bundle, seen: Sightings, width: float) -> tuple[Bundle, np.ndarray]:
    """The start brought near, and (M,) which sightings to keep: all of them for an infinite width."""
    keep = np.ones(len(seen.led), dtype=bool)
    part = _tied(whole, seen, keep)
    found = ba.turn_frames(part.bundle, part.seen, 12)
    whole = part.into(whole, found)
    if np.isinf(width):
        return whole, keep
    keep[part.index] = _inside(found, part.seen, GROSS_GATE)
    part = _tied(whole, seen, keep)
    found, before = part.bundle, np.inf
    while (now := width * _noise(found, part.seen)) < 0.9 * before:
        found, before = ba.adjust(found, part.seen, now, decrement=0.1)[0], now
    keep[part.index] = _inside(found, part.seen, GATE)
    return part.into(whole, found), keep


def _noise(bundle: Bundle, seen: Sightings) -> float:
    """Robust size of the residuals in sigmas, one at least: the median distance over that of unit noise."""
    distance = np.linalg.norm(ba.residuals(bundle, seen), axis=1)
    return max(1.0, float(np.median(distance) / MEDIAN_RADIUS))


def _inside(bundle: Bundle, seen: Sightings, gate: float) -> np.ndarray:
    distance = np.linalg.norm(ba.residuals(bundle, seen), axis=1)
    return distance < gate * _noise(bundle, seen)


def _tied(whole: Bundle, seen: Sightings, keep: np.ndarray) -> Part:
    """The sightings that determine anything: lights in two frames with rays that cross, frames with two such lights.

    Raises ValueError where too little is left, or where it falls apart into groups of frames.
    """
    ahead = np.isfinite(ba.residuals(whole, seen)).all(axis=1)
    index = np.flatnonzero(keep & ahead)
    lights, frames = len(whole.position_m), len(whole.R_body_from_lab)
    while True:
        led, frame = seen.led[index], seen.frame[index]
        incidence = csr_array((np.ones(len(index)), (frame, led)), shape=(frames, lights)) > 0
        good_led = (incidence.sum(axis=0) >= 2) & _crossing(whole, seen.take(index))
        good_frame = incidence @ good_led.astype(float) >= 2
        stays = good_led[led] & good_frame[frame]
        if stays.all():
            break
        index = index[stays]
    led_rows, frame_rows = np.unique(led), np.unique(frame)
    unknowns = 3 * len(led_rows) + 3 * len(frame_rows) + 3 + whole.free_lens - 4
    if 2 * len(index) < unknowns or not len(index):
        raise ValueError(
            f"survey: {2 * len(index)} usable coordinates for {unknowns} unknowns; take more frames"
        )
    _check_one_group(incidence, frame_rows)
    seen = seen.take(index)
    numbered = replace(seen, frame=np.searchsorted(frame_rows, frame), led=np.searchsorted(led_rows, led))
    bundle = replace(
        whole,
        position_m=whole.position_m[led_rows],
        R_body_from_lab=whole.R_body_from_lab[frame_rows],
        map_m=whole.map_m[led_rows],
    )
    return Part(bundle, numbered, led_rows, frame_rows, index)


def _crossing(whole: Bundle, seen: Sightings) -> np.ndarray:
    """(N,) whether each light's rays spread enough: 1 - largest eigenvalue of their mean u u' is the mean sin^2."""
    camera_lab = np.einsum("kji,j->ki", whole.R_body_from_lab, whole.camera_body_m)
    ray = whole.position_m[seen.led] - camera_lab[seen.frame]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    lights = len(whole.position_m)
    scatter, count = np.zeros((lights, 3, 3)), np.maximum(np.bincount(seen.led, minlength=lights), 1)
    np.add.at(scatter, seen.led, ray[:, :, None] * ray[:, None, :])
    largest = np.linalg.eigvalsh(scatter / count[:, None, None])[:, 2]
    return 1 - largest > CROSSING_RAD**2


def _check_one_group(incidence: csr_array, frame_rows: Ints) -> None:
    """Raise ValueError unless every frame hangs on the others by two lights: about one, a group could turn freely."""
    table = incidence[frame_rows].astype(float)
    member = np.zeros(len(frame_rows), dtype=bool)
    member[np.argmax(table.sum(axis=1))] = True
    while True:
        known = (table.T @ member.astype(float)) > 0
        grown = member | (table @ known.astype(float) >= 2)
        if (grown == member).all():
            break
        member = grown
    if not member.all():
        first, second = frame_rows[member][0], frame_rows[~member][0]
        raise ValueError(
            f"survey: the frames fall apart; {np.sum(~member)} of {len(member)}, frame {second} first, share fewer "
            f"than two LEDs with the group of frame {first}: take frames between them"
        )


def _determined(found: Bundle, shared: Floats) -> bool:
    """Whether lever and focal length are known to a tenth of the distances, as numbers near an answer are."""
    sigma = np.sqrt(np.maximum(np.diag(shared), 0))
    reach = np.linalg.norm(found.position_m, axis=1).min()
    return bool(np.isfinite(sigma).all() and sigma[:3].max() < 0.1 * reach and sigma[3] < 0.1 * found.lens[0])


def _report(
    status: str,
    part: Part,
    whole: Bundle,
    spread: tuple[Floats, Floats, Floats],
    outliers: Ints,
    leds: LedMap,
    camera: Camera,
) -> Survey:
    lights, frames = len(whole.position_m), len(whole.R_body_from_lab)
    surveyed, tied = np.zeros(lights, dtype=bool), np.zeros(frames, dtype=bool)
    surveyed[part.led] = tied[part.frame] = True
    by_led, by_turn = np.full((lights, 3, 3), np.nan), np.full((frames, 3, 3), np.nan)
    by_led[part.led], by_turn[part.frame], shared = spread
    seen = part.seen
    left_over = ba.residuals(part.bundle, seen)
    lens = [float(value) for value in whole.lens]
    unknowns = 3 * len(part.led) + 3 * len(part.frame) + 3 + whole.free_lens - 4
    return Survey(
        status,
        replace(leds, position_m=whole.position_m),
        surveyed,
        Lever(whole.camera_body_m, Rotation.from_matrix(whole.R_cam_from_body)),
        replace(
            camera,
            focal_px=lens[0],
            centre_px=(lens[1], lens[2]),
            distortion=(lens[3], lens[4], lens[5], lens[6], lens[7]),
        ),
        Rotation.from_matrix(whole.R_body_from_lab),
        tied,
        outliers,
        by_led,
        by_turn,
        shared[:3, :3],
        shared[3:, 3:],
        rms_px=float(np.sqrt(np.mean((left_over * seen.sigma_px[:, None]) ** 2))),
        misfit=float(np.sqrt(np.sum(left_over**2) / max(2 * len(seen.led) - unknowns, 1))),
    )
