"""Run one trial: draw a random attitude, simulate centroids or a frame (or a complete run), solve, and score.

A trial depends only on its specification, design point and seed, not on the order of trials or the worker.
"""

import math
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids, RateEstimate
from estimator.trackers.coded_tracker import CodedTracker
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from estimator.trackers.tracking_mode import Health, TrackedReport, TrackingMode
from skysim.camera.detector import AddedCharge
from skysim.core import errors, quaternion
from skysim.core.paths import DATA, ROOT
from skysim.core.plugins import NO_PROGRAMS, Programs
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Frame, Mount, Trajectory, Truth, frozen
from skysim.dynamics.controllers import CONTROLLERS
from skysim.experiments.study.execution.detections import (
    simulate_detections,
    solve_coded,
    visible_rows,
)
from skysim.experiments.study.execution.outcomes import (
    FAILED,
    Outcome,
    TrueLights,
    score,
    summarize_flight,
    true_lights,
)
from skysim.experiments.study.factors import Settings
from skysim.experiments.study.plan import (
    AxisConfig,
    CentroidTrial,
    FlightTrial,
    FrameTrial,
    Trial,
    TrialSpec,
    digest,
    resolve_point,
)
from skysim.scene.loader import file_names
from skysim.scene.scene import Scene
from skysim.scene.sections.light import PLUGINS
from skysim.simulation.exposure import render_frame
from skysim.simulation.flight import Flight
from skysim.simulation.lab import (
    MARGIN_S,
    Lab,
    StarCamera,
    UserParts,
    build_lab,
    build_tracker,
    exposure_window,
)
from skysim.sources.air import topocentric_axes
from skysim.sources.ephemeris import observe_from, place
from skysim.tracking import factory
from skysim.tracking.tracker_interface import TRACKERS

CACHE_SIZE = 4  # setups that a worker caches


class TrialSetup(NamedTuple):
    """A scene prepared for trials: lab, tracker with its index, trial, scene hash, commands of external programs."""

    lab: Lab
    estimator: factory.Estimator
    trial: Trial
    scene_hash: str
    programs: Programs = NO_PROGRAMS


class SetupCache(threading.local):
    """Least-recently-used cache of setups. One per thread, because a lab's canvas serves one trial at a time."""

    def __init__(self) -> None:
        self.setups: OrderedDict[str, TrialSetup] = OrderedDict()


CACHE = SetupCache()


def prepared_setup(spec: TrialSpec, settings: Settings) -> TrialSetup:
    """The setup of a design point, from the cache if it is there. Raises InputError."""
    programs = {**spec.programs, **spec.digests}
    key = digest([spec.scene, spec.folder, spec.base, spec.trial, programs, settings])
    cached = CACHE.setups
    if key not in cached:
        cached[key] = build_setup(spec, settings)
        while len(cached) > CACHE_SIZE:
            cached.popitem(last=False)
    cached.move_to_end(key)
    return cached[key]


def build_setup(spec: TrialSpec, settings: Settings) -> TrialSetup:
    """Build hardware and tracker of a point, or reuse those of a cached setup that differs only in its trial."""
    scene, trial = resolve_point(spec, settings)
    hash_ = scene_hash(scene, spec.digests)
    for setup in CACHE.setups.values():
        if setup.scene_hash == hash_ and setup.programs == spec.programs:
            return setup._replace(trial=trial)
    # A lab whose scene differs only in section `tracker` has the same hardware.
    cached = (setup.lab for setup in CACHE.setups.values())
    same = (one for one in cached if one.scene.with_values(tracker=scene.tracker) == scene)
    lab = next(same, None) or build_lab(scene, UserParts(spec.programs))
    lab = lab.with_scene(scene)
    return TrialSetup(
        lab, build_tracker(lab.camera, spec.programs), trial, hash_, spec.programs
    )


def scene_hash(scene: Scene, digests: Mapping[str, str] = NO_PROGRAMS) -> str:
    """Hash of a scene, of the files it names, and of the releases of external tracker, controller and lights.

    A tracker or controller given in Python has a digest by its name.
    """
    tree = scene.model_dump(mode="json", by_alias=True)
    contents = [
        sha256(Path(path).read_bytes()).hexdigest()
        for _, path in file_names(tree)
        if Path(path).is_file()
    ]
    releases = [
        TRACKERS.release(scene.tracker.name),
        *(PLUGINS.release(light.kind) for light in scene.lights),
    ]
    law = scene.motion.control.law if scene.motion.control else ""
    if release := CONTROLLERS.release(law):
        releases.append(release)
    releases += [digests[name] for name in (scene.tracker.name, law) if name in digests]
    return digest([tree, contents, *releases])


@cache
def code_version() -> str:
    """Hash of the source code of skysim and estimator and of their data; stored with each trial."""
    code = sha256()
    sources = [
        path for package in ("skysim", "estimator") for path in (ROOT / package).rglob("*.py")
    ]
    data = [
        path
        for folder in ("qe", "led", "bands", "cameras", "ephemeris")
        for path in (DATA / folder).rglob("*")
    ]
    for path in sorted(sources + [path for path in data if path.is_file()]):
        code.update(
            path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes() + b"\0"
        )
    return code.hexdigest()[:16]


def seed_of(spec: TrialSpec, point: int, replicate: int) -> int:
    """Seed of a trial, 63 bits, derived from the study's seed; with `paired` it is the same at every point."""
    key = (replicate,) if spec.paired else (replicate, point)
    return int(
        np.random.SeedSequence(spec.seed, spawn_key=key).generate_state(1, np.uint64)[0] >> 1
    )


# Trials.


# Standard deviation that a frame trial's gyro claims: 2 arcseconds per second.
GYRO_RAD_S = 1e-5
KNOTS = 9  # samples of a frame trial's trajectory in each exposure
BLOCK = 64  # number of centroid trials that run together
REFUSED = "refused"  # stands for the hash of a scene that cannot be built


class Row(NamedTuple):
    """One trial as stored.

    Attributes
    ----------
    scene
        Hash of the scene; REFUSED for an invalid scene, with the reason in `error`; empty if
        the trial's worker died
    error
        Line of an InputError, or traceback of another exception
    """

    trial: int
    point: int
    replicate: int
    seed: int
    scene: str
    code: str
    outcome: Outcome
    error: str | None
    seconds: float


class Segment(NamedTuple):
    """Consecutive replicates of one point, starting with trial number `first`; chunks of these go to workers."""

    point: int
    settings: Settings
    first: int
    replicates: range


# Running trials.


@frozen
class TrialJob:
    """The trials of a study as a job of the engines."""

    spec: TrialSpec

    def run(self, chunk: tuple[Segment, ...]) -> list[Row]:
        """Run all trials of a chunk in order, together in blocks if their kind allows."""
        rows = list[Row]()
        for segment in chunk:
            for block in divided(segment, block_size(self.spec, segment)):
                rows += run_block(self.spec, block)
        return rows

    def failed(self, segment: Segment, error: str) -> Row:
        """The row of a trial that repeatedly killed its worker."""
        return blank_rows(self.spec, segment)[0]._replace(error=error)


def blank_rows(spec: TrialSpec, segment: Segment) -> list[Row]:
    """The rows of a segment's trials before they run: failed, without a scene and an error."""
    point = segment.point
    return [
        Row(trial, point, k, seed_of(spec, point, k), "", code_version(), FAILED, None, 0.0)
        for trial, k in enumerate(segment.replicates, segment.first)
    ]


def block_size(spec: TrialSpec, segment: Segment) -> int:
    """Number of trials of a segment that run together. Detections must reach an external tracker once, in order."""
    try:
        setup = prepared_setup(spec, segment.settings)
    except Exception:  # the trials raise it again and store it in their rows
        return 1
    own = isinstance(setup.estimator, StarTracker | DomeTracker)
    return BLOCK if own and setup.trial.kind == "centroids" else 1


def divided(segment: Segment, size: int) -> Iterator[Segment]:
    """The segment in parts of `size` trials."""
    for n in range(0, len(segment.replicates), size):
        yield segment._replace(
            first=segment.first + n, replicates=segment.replicates[n : n + size]
        )


def run_block(spec: TrialSpec, segment: Segment) -> list[Row]:
    """Run the trials of a segment together.

    If one of them raises an exception, each is run alone, and the row of the faulty one stores the exception.
    """
    rows = blank_rows(spec, segment)
    scene = ""
    outcomes = [FAILED] * len(rows)
    error = None
    start_s = time.perf_counter()
    try:
        setup = prepared_setup(spec, segment.settings)
        scene = setup.scene_hash
        start_s = time.perf_counter()
        outcomes = TRIALS[setup.trial.kind](setup, [row.seed for row in rows])
    except Exception as raised:
        errors.raise_wrapped(raised)
        if len(rows) > 1:
            return [row for one in divided(segment, 1) for row in run_block(spec, one)]
        if isinstance(raised, errors.InputError):
            scene = scene or REFUSED
            error = str(raised)
        else:
            # The stored text must not depend on the installation path.
            error = traceback.format_exc().replace(f"{ROOT}/", "")
    seconds = (time.perf_counter() - start_s) / len(rows)
    return [
        row._replace(scene=scene, outcome=outcome, error=error, seconds=seconds)
        for row, outcome in zip(rows, outcomes, strict=True)
    ]


def run_centroid_trials(setup: TrialSetup, seeds: Sequence[int]) -> list[Outcome]:
    """Centroid trials: at a random attitude, noisy true detections and false ones are identified and solved.

    Each step is done for all trials before the next step, so that its code is in the processor's cache.
    """
    solved = solved_centroids(setup, seeds)
    return [score(setup.lab, setup.estimator, report, lights) for lights, report in solved]


def solved_centroids(
    setup: TrialSetup, seeds: Sequence[int]
) -> list[tuple[TrueLights, Report]]:
    """The lights of centroid trials, and the report on the detections (under coded light, of the last frame)."""
    lab = setup.lab
    trial = setup.trial
    estimator = setup.estimator
    assert isinstance(trial, CentroidTrial)
    attitude_rngs, noise = zip(*(streams(setup, seed) for seed in seeds), strict=True)
    lab_from_body = random_attitudes(setup, attitude_rngs)
    if isinstance(estimator, CodedTracker):
        found = [
            solve_coded(lab, estimator, trial, *each)
            for each in zip(lab_from_body, noise, strict=True)
        ]
    else:
        views = visible_rows(lab, lab_from_body)
        detections = [
            simulate_detections(trial, view.xy_px, view.electrons, lab.scene, rng)
            for view, rng in zip(views, noise, strict=True)
        ]
        exposure_s = lab.scene.exposure.time_s
        found = [
            (view.xy_px, Report(factory.solve_centroids(estimator, each, exposure_s), each))
            for view, each in zip(views, detections, strict=True)
        ]
    return [
        (TrueLights(attitude, attitude, xy_px, xy_px, None), report)
        for attitude, (xy_px, report) in zip(lab_from_body, found, strict=True)
    ]


def streams(setup: TrialSetup, seed: int) -> tuple[Generator, Generator]:
    """Random generators of a trial's attitude and of its noise; `noise_seed` changes only the noise."""
    trial = setup.trial
    assert isinstance(trial, CentroidTrial | FrameTrial)
    attitude = (0, trial.attitude_seed) if trial.attitude_seed else (0,)
    return random_stream(seed, *attitude), random_stream(seed, 1, trial.noise_seed)


def run_frame_trial(setup: TrialSetup, seed: int) -> Outcome:
    """Frame trial: random attitude, one rendered frame, solved lost in space or in tracking mode."""
    moving = moving_camera(setup, seed)
    frame, truth = moving.render(moving.tracked)
    if moving.tracked:
        report = tracked_report(setup, moving, frame)
    else:
        report = lost_in_space(setup, frame, truth, moving.streak_px)
    return score(setup.lab, setup.estimator, report, true_lights(truth))


def run_flight_trial(setup: TrialSetup, seed: int) -> Outcome:
    """Flight trial: the complete scene with another seed, and with a random start if the trial has one."""
    trial = setup.trial
    assert isinstance(trial, FlightTrial)
    with trial_flight(setup, seed) as flight:
        outcomes = [
            one
            for t_s, one in flight_outcomes(flight, setup.estimator)
            if t_s >= trial.settle_s
        ]
        return summarize_flight(flight.telemetry(), outcomes, trial.settle_s)


def trial_flight(setup: TrialSetup, seed: int) -> Flight:
    """The flight of a trial at its start."""
    trial = setup.trial
    lab = setup.lab.in_run(seed)
    assert isinstance(trial, FlightTrial)
    if trial.start is not None:
        lab = replace(lab, start=random_attitudes(setup, [random_stream(seed, 0)])[0])
    return Flight(lab, UserParts(setup.programs, tracker=setup.estimator))


def flight_outcomes(
    flight: Flight, estimator: factory.Estimator
) -> Iterator[tuple[float, Outcome]]:
    """Mid-exposure time and outcome of every frame of the main camera."""
    for shot in flight.shots(cameras=[0]):
        one = score(flight.lab, estimator, shot.solution, true_lights(shot.truth))
        yield shot.truth.t_s, replace(one, exposure_ms=1e3 * shot.frame.exposure_s)


# From a setup and seeds to the outcomes of the trials.
Trials = Callable[[TrialSetup, Sequence[int]], list[Outcome]]


def one_by_one(run: Callable[[TrialSetup, int], Outcome]) -> Trials:
    """Outcomes of trials that are run one by one."""
    return lambda setup, seeds: [run(setup, seed) for seed in seeds]


TRIALS: dict[str, Trials] = {
    "centroids": run_centroid_trials,
    "frames": one_by_one(run_frame_trial),
    "flight": one_by_one(run_flight_trial),
}


# Parts of trials.


def random_attitudes(setup: TrialSetup, rngs: Sequence[Generator]) -> Rotation:
    """N random lab_from_body, each drawn by its own generator.

    Under a dome: tilt uniform in solid angle within `tilt_deg`, tilt direction and yaw uniform. Otherwise: boresight
    uniform over the sphere within `dec_deg` or between two angles from a body, roll uniform.
    """
    trial = setup.trial
    lab = setup.lab
    attitudes = trial.start if isinstance(trial, FlightTrial) else trial
    assert attitudes is not None
    near = attitudes.near
    under_dome = lab.scene.dome is not None
    turns = [rng.uniform(0, 2 * math.pi, 2).tolist() for rng in rngs]
    # A uniform cosine of the tilt, or sine of the declination, is uniform in solid angle.
    if under_dome:
        tilt_deg = attitudes.tilt_deg
        low, high = tilt_deg if isinstance(tilt_deg, tuple) else (tilt_deg,) * 2
        ends = math.cos(math.radians(high)), math.cos(math.radians(low))
    else:
        low, high = (math.radians(dec) for dec in attitudes.dec_deg)
        if near:  # a body is the pole
            high, low = (math.pi / 2 - math.radians(off) for off in near.off_deg)
        ends = math.sin(low), math.sin(high)
    zeniths = [math.acos(min(max(rng.uniform(*ends), -1.0), 1.0)) for rng in rngs]
    # Under a dome the second turn is the yaw, which contains that of the tilt.
    drawn = [
        zyz(first, zenith, last - first * under_dome)
        for (first, last), zenith in zip(turns, zeniths, strict=True)
    ]
    if not under_dome:
        if near:
            lab_from_pole = lab_from_body_pole(near.body, lab.scene)
            drawn = [quaternion.multiply(lab_from_pole, each) for each in drawn]
        cam_from_body = quaternion.from_rotation(lab.camera.mount.cam_from_body)
        drawn = [quaternion.multiply(each, cam_from_body) for each in drawn]
    return quaternion.to_rotation(np.array(drawn))


def lab_from_body_pole(name: str, scene: Scene) -> Floats:
    """(4,) wxyz of a rotation that takes z to the Sun, the Moon, a planet or the zenith at the scene's start."""
    if name == "zenith":
        x, y, z = topocentric_axes(scene.start_time, scene.site)[2]
    else:
        x, y, z = place(name, observe_from(scene.start_time, scene.site)).direction
    return zyz(math.atan2(y, x), math.acos(z), 0.0)


def zyz(first_rad: float, second_rad: float, third_rad: float) -> Floats:
    """(4,) wxyz of Rz(first) Ry(second) Rz(third), which rotates z to azimuth `first` and zenith angle `second`."""
    half = second_rad / 2
    sum_ = (first_rad + third_rad) / 2
    difference = (first_rad - third_rad) / 2
    sine = math.sin(half)
    cosine = math.cos(half)
    x = -sine * math.sin(difference)
    y = sine * math.cos(difference)
    return np.array([cosine * math.cos(sum_), x, y, cosine * math.sin(sum_)])


def render_trial_frame(
    setup: TrialSetup, seed: int, added: AddedCharge | None = None
) -> tuple[Frame, Truth, tuple[float, float] | None]:
    """Frame of a frame trial, its truth and, with a gyro, the streak vector (dx, dy) in pixels at the image center.

    Parameters
    ----------
    added
        Receives the masks of smear and particles
    """
    moving = moving_camera(setup, seed)
    return *moving.render(moving.tracked, added), moving.streak_px


class MovingCamera(NamedTuple):
    """The camera of a frame trial in its motion.

    Attributes
    ----------
    streak_px
        (dx, dy) streak vector of the frame as a gyro measures it; None without a gyro
    tracked
        Number of frames that are followed before the frame of the trial; also the index of that frame
    """

    camera: StarCamera
    trajectory: Trajectory
    streak_px: tuple[float, float] | None
    tracked: int

    def render(self, index: int, added: AddedCharge | None = None) -> tuple[Frame, Truth]:
        """A frame and its truth."""
        return render_frame(self.camera, self.trajectory, index, added=added)


def moving_camera(setup: TrialSetup, seed: int) -> MovingCamera:
    """The camera in the motion of a frame trial and, with a gyro, the streak vector of its frame."""
    trial = setup.trial
    attitude_rng, noise = streams(setup, seed)
    assert isinstance(trial, FrameTrial)
    camera = setup.lab.in_run(int(noise.integers(2**62))).camera
    middle, axis_cam = attitude_and_axis(setup, attitude_rng)
    rate_cam = math.radians(trial.rate_deg_s) * axis_cam
    body_from_cam = camera.mount.body_from_cam
    rate_body, turn_body, acceleration_body = (
        body_from_cam.apply(math.radians(value) * axis_cam)
        for value in (trial.rate_deg_s, trial.turn_deg, trial.acceleration_deg_s2)
    )
    middle = middle * Rotation.from_rotvec(turn_body)
    trajectory = constant_acceleration(
        camera.scene, middle, rate_body, acceleration_body, trial.tracked
    )
    streak_px = exposure_window(camera.scene, 0).exposure_s * camera.scene.camera.focal_px
    # For a star on the boresight: d(x / z)/dt = -w_y, d(y / z)/dt = w_x.
    streak = (-rate_cam[1] * streak_px, rate_cam[0] * streak_px) if trial.gyro else None
    return MovingCamera(camera, trajectory, streak, trial.tracked)


def attitude_and_axis(setup: TrialSetup, rng: Generator) -> tuple[Rotation, Floats]:
    """Random lab_from_body of a frame trial, and the (3,) axis of its rate in camera axes."""
    assert isinstance(setup.trial, FrameTrial)
    lab_from_body = random_attitudes(setup, [rng])[0]
    return lab_from_body, rate_axis(
        setup.trial.rate_axis, rng.uniform(0, 2 * math.pi), setup.lab.camera.mount
    )


def tracked_report(setup: TrialSetup, moving: MovingCamera, frame: Frame) -> Report:
    """The report on a frame trial's last frame by a tracker in its tracking mode, which has solved the frames before.

    It has no attitude if the prediction failed and the frame had to be solved lost in space. A gyro's prediction is the
    true rotation since the frame before.
    """
    assert isinstance(setup.estimator, StarTracker)
    tracker = TrackingMode(setup.estimator)
    for index in range(frame.index + 1):
        shown = frame if index == frame.index else moving.render(index)[0]
        turned = (
            rotation_between(moving, tracker.last.t_s, shown.t_mid_s)
            if moving.streak_px and tracker.last
            else None
        )
        try:
            report = tracker.solve(
                shown.image_dn, shown.t_mid_s, turned, moving.streak_px, shown.exposure_s
            )
        except ImageError as error:
            report = TrackedReport(Attitude(str(error)), Centroids.empty())
    if report.attitude.solved and report.health & Health.SEARCHED:
        report.attitude = Attitude("tracking lost: the frame is solved lost in space")
    return report


def rotation_between(moving: MovingCamera, then_s: float, now_s: float) -> Rotation:
    """True rotation cam(now) from cam(then)."""
    now, then = (
        moving.camera.mount.cam_from_body * moving.trajectory.attitude_at(t_s).inv()
        for t_s in (now_s, then_s)
    )
    return now * then.inv()


def lost_in_space(
    setup: TrialSetup, frame: Frame, truth: Truth, streak_px: tuple[float, float] | None
) -> Report:
    """The report on a frame trial's frame alone. The trial's gyro measures the rate without an error."""
    rate = (
        RateEstimate(truth.rate_cam_rad_s, GYRO_RAD_S**2 * np.eye(3)) if streak_px else None
    )
    return factory.solve_frame(setup.estimator, frame, streak_px, rate)


def rate_axis(axis: str | AxisConfig, azimuth_rad: float, mount: Mount) -> Floats:
    """(3,) unit axis of rotation in camera axes; azimuth_rad is used if it is perpendicular to the boresight."""
    if axis == "boresight":
        return np.array([0.0, 0.0, 1.0])
    if isinstance(axis, str):
        return np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
    vector = (
        mount.cam_from_body.apply(axis.body)
        if axis.body is not None
        else np.array(axis.camera, dtype=float)
    )
    return vector / np.linalg.norm(vector)


def constant_acceleration(
    scene: Scene,
    middle: Rotation,
    rate_body: Floats,
    acceleration_body: Floats,
    frame: int = 0,
) -> Trajectory:
    """A trajectory through the exposures up to a frame's; in the middle of that one it has this attitude and rate.

    The acceleration is along the rate, or the rate is zero: the rotation vector is rate t + acceleration t^2 / 2.
    """
    windows = [exposure_window(scene, index) for index in range(frame + 1)]
    exposures = [
        np.linspace(one.open_s - MARGIN_S, one.close_s + MARGIN_S, KNOTS) for one in windows
    ]
    t_s = np.unique(np.concatenate(exposures))
    since_s = t_s - windows[-1].middle_s
    turned = np.outer(since_s, rate_body) + np.outer(since_s**2 / 2, acceleration_body)
    rate = rate_body + np.outer(since_s, acceleration_body)
    return Trajectory(t_s, middle * Rotation.from_rotvec(turned), rate)
