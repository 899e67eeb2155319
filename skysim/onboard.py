"""The computers on board, as the scene sets them up: the star tracker's, and the one that listens to the gyros."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator import calibrate, catalog
from estimator.attitude import SOLVERS
from estimator.calibrate import DomeFrame, Survey
from estimator.camera import Camera
from estimator.centroid import CENTROIDERS
from estimator.detect import DETECTORS
from estimator.dometracker import IDENTIFIERS as NEAR_IDENTIFIERS
from estimator.dometracker import DomeTracker
from estimator.exposure import Control, Exposure, Observation, observe, step
from estimator.filter import GyroModel, Mekf
from estimator.hints import Hints
from estimator.identify import IDENTIFIERS
from estimator.nearfield import SOLVERS as NEAR_SOLVERS
from estimator.nearfield import LedMap, Lever
from estimator.stages import Clock, Report, Settings, see
from estimator.tracker import StarTracker
from estimator.types import Attitude, BadImage, Centroids
from skysim import display, dome, guest, imu, io, quaternion, survey
from skysim.camera import Camera as CameraPart
from skysim.detector import saturation_dn
from skysim.guest import Guest
from skysim.quantity import ARCSEC_RAD, one_of
from skysim.scene import CATALOGUES, Bench, Dome, Filter, Scene
from skysim.trackers import OWN
from skysim.types import BadInput, Floats, Frame, Mount, Sources

Estimator = StarTracker | DomeTracker | Guest
NO_PROGRAMS: Mapping[str, str] = {}


def tracker(
    scene: Scene, mount: Mount, sources: Sources, programs: Mapping[str, str] = NO_PROGRAMS
) -> Estimator:
    """The star tracker with what it believes of the hardware: the scene's `tracker` section, else the truth.

    programs : commands by name, any of which `tracker.name` may be
    Raises BadInput for a dome that no tracker can work under.
    """
    camera, settings = believed_camera(scene), believed_settings(scene)
    if isinstance(scene.light, Dome):
        leds, lever = believed_dome(scene, scene.light, sources), believed_lever(scene, mount)
        if scene.tracker.map:
            camera, leds, lever = surveyed_dome(scene, scene.tracker.map, leds, lever)
        if scene.tracker.name != OWN:
            return Guest.of(scene, camera, settings, guest.leds(leds, lever), programs)
        try:
            return DomeTracker(camera, leds, lever, settings)
        except BadImage as error:
            raise BadInput(f"light: the star tracker cannot work under this dome: {error}") from None
    stars = catalog.read(CATALOGUES / f"{scene.light.catalogue}.ecsv")
    stars = catalog.brighter(stars, scene.tracker.limit_mag)
    directions = catalog.apparent(stars, catalog.on_earth(scene.start_time))
    if isinstance(scene.light, Bench):
        # Where the bench has its display decides where the stars are in the lab.
        directions = display.lab_from_icrs(scene.light).apply(directions)
    if scene.tracker.name != OWN:
        return Guest.of(scene, camera, settings, guest.stars(stars, directions), programs)
    return StarTracker(camera, stars, directions, settings)


def believed_dome(scene: Scene, light: Dome, sources: Sources) -> LedMap:
    """The dome on the tracker's map: the true one, and the errors of its survey."""
    inside, told = dome.surface(light.surface), scene.tracker.survey
    place_m = survey.believed_leds_m(inside, sources.place[:, :3], told)
    board = dome.board_of(light.layout, sources.id)
    ellipsoid = survey.believed_ellipsoid(inside, told)
    return LedMap(sources.id, place_m, *ellipsoid, board, told.led_sigma_m)


def believed_lever(scene: Scene, mount: Mount) -> Lever:
    """The camera's place on the vehicle as it was told, else as it was surveyed; its attitude is known."""
    told = scene.tracker.survey
    arm_m = scene.tracker.believed_camera_body_m or survey.believed_m(
        mount.camera_body_m, told.lever_sigma_m, told.seed, "lever"
    )
    return Lever(np.array(arm_m), mount.cam_from_body, told.lever_sigma_m)


def surveyed_dome(scene: Scene, path: str, leds: LedMap, lever: Lever) -> tuple[Camera, LedMap, Lever]:
    """Camera, LEDs and lever from the file of a survey; surface and boards as they are believed without it.

    One sigma stands for all LEDs, the median of the file's. Raises BadInput for a file that is of another dome.
    """
    told = io.read_dome_map(Path(path))
    size_px = (scene.camera.width_px, scene.camera.height_px)
    if told.size_px != size_px:
        raise BadInput(
            f"tracker.map: {path}: is of a camera of {told.size_px} px; allowed: this one's, {size_px} px"
        )
    order = np.argsort(leds.id)
    row = order[np.minimum(np.searchsorted(leds.id, told.id, sorter=order), len(order) - 1)]
    strange = told.id[leds.id[row] != told.id]
    if len(strange):
        raise BadInput(f"tracker.map: {path}: LED {strange[0]} is none of this dome's {len(order)}")
    board = None if leds.board is None else leds.board[row]
    placed = replace(
        leds, id=told.id, position_m=told.position_m, board=board, sigma_m=float(np.median(told.sigma_m))
    )
    camera = replace(
        calibration(scene.camera),
        focal_px=told.focal_px,
        centre_px=told.centre_px,
        distortion=told.distortion,
    )
    return camera, placed, Lever(told.camera_body_m, lever.cam_from_body, told.lever_sigma_m)


def believed_camera(scene: Scene) -> Camera:
    """The calibration in the tracker's head."""
    told, true = scene.tracker, calibration(scene.camera)
    if told.believed_distortion is not None:
        true = replace(true, distortion=told.believed_distortion)
    believed_m = told.believed_focal_length_m
    return true.zoomed(believed_m / scene.camera.focal_length_m if believed_m else 1.0)


def calibration(camera: CameraPart) -> Camera:
    """A perfect calibration of a camera, in the tracker's own terms."""
    return Camera(camera.width_px, camera.height_px, camera.focal_px, camera.centre_px, camera.distortion)


def believed_settings(scene: Scene) -> Settings:
    """The tracker's algorithms and thresholds as the scene names them. Raises BadInput for a wrong name."""
    part, usual = scene.tracker, Settings()
    near = isinstance(scene.light, Dome)
    return Settings(
        max_blobs=part.brightest or usual.max_blobs,
        base_stars=min(part.brightest or usual.base_stars, usual.base_stars),
        detector=known("detector", part.detector or ("local" if near else "default"), DETECTORS),
        centroider=known("centroider", part.centroider or ("cog" if near else "default"), CENTROIDERS),
        identifier=known(
            "identifier",
            part.identifier or ("led_pairs" if near else "default"),
            NEAR_IDENTIFIERS if near else IDENTIFIERS,
        ),
        solver=known(
            "solver",
            part.solver or ("rotation_only" if near else "default"),
            NEAR_SOLVERS if near else SOLVERS,
        ),
        threshold_sigma=part.threshold_sigma,
        min_area_px=part.min_area_px,
        gain_e_dn=scene.camera.detector.gain_e_dn,
        saturation=saturation_dn(scene.camera.detector),
        centroid_sigma_px=part.centroid_sigma_px,
    )


def choices(scene: Scene) -> dict[str, tuple[str, ...]]:
    """Every algorithm that a scene's tracker may name, by stage."""
    near = isinstance(scene.light, Dome)
    return {
        "detector": tuple(DETECTORS),
        "centroider": tuple(CENTROIDERS),
        "identifier": tuple(NEAR_IDENTIFIERS if near else IDENTIFIERS),
        "solver": tuple(NEAR_SOLVERS if near else SOLVERS),
    }


def known(key: str, name: str, algorithms: Mapping[str, object]) -> str:
    """The name, if there is such an algorithm: only the estimator knows, and scene.py may not ask it."""
    try:
        return one_of(name, algorithms)
    except ValueError as error:
        raise BadInput(f"tracker.{key}: {error}") from None


def answer(estimator: Estimator, frame: Frame, streak_px: tuple[float, float] | None = None) -> Report:
    """The tracker's report; a frame that it will not look at (empty, saturated) is a status too.

    streak_px : (dx, dy) that lights move in the exposure, where a gyro tells the tracker
    """
    if isinstance(estimator, Guest):
        return estimator.look(frame, streak_px)
    try:
        return estimator.solve(frame.image_dn, streak_px)
    except BadImage as error:
        return Report(Attitude(str(error)), Centroids.none())


class Meter:
    """The camera's control: how long to expose the next frame, told by the one before.

    exposure_s : of the next frame; always the scene's `exposure.time` without `tracker.exposure_control`
    """

    def __init__(self, scene: Scene) -> None:
        self.control, self.settings = exposure_control(scene), believed_settings(scene)
        self.exposure_s = scene.exposure.time_s

    def see(self, frame: Frame) -> None:
        """Take note of the frame that was exposed for `exposure_s`."""
        if self.control:
            state = Exposure(frame.exposure_s)
            self.exposure_s = step(state, observed(self.settings, self.control, frame), self.control).time_s


def exposure_control(scene: Scene) -> Control | None:
    """The constants of the chart, as the scene has them; None where exposures are fixed."""
    part = scene.tracker.exposure_control
    return Control(**dict(part)) if part else None


def observed(settings: Settings, control: Control, frame: Frame) -> Observation:
    """What the image processing says of a frame: objects that are no stars (defects, tracks, the Moon) do not count.

    A full pixel is one near the value at which this camera's are cut off.
    """
    try:
        blobs = DETECTORS[settings.detector](
            frame.image_dn,
            settings.threshold_sigma,
            settings.min_area_px,
            settings.max_blobs,
            Hints(None, settings.saturation),
        )
    except BadImage:  # a coarse converter's frame may hold one value alone: there is nothing in it
        return observe(frame.image_dn, np.empty((0, 4), np.int64), settings.saturation, control)
    box_px = blobs.box_px[blobs.flag & settings.reject == 0]
    return observe(frame.image_dn, box_px, settings.saturation, control)


def lights(settings: Settings, camera: Camera, frame: Frame) -> Centroids:
    """The lights of a frame, unnamed; none of a frame that the tracker would not look at."""
    try:
        return see(frame.image_dn, camera, settings, Clock())
    except BadImage:
        return Centroids.none()


def sighting(
    seen: Centroids,
    light: NDArray[np.int64],
    led: NDArray[np.int64],
    body_from_lab: Rotation,
    floor_px: float,
) -> DomeFrame:
    """A frame of a survey: the rows of its lights that have a name, and the rows of the LEDs that they are."""
    sigma_px = np.hypot(seen.sigma_px[light], floor_px)
    return DomeFrame(led, seen.xy_px[light], sigma_px, body_from_lab)


def surveyed(
    frames: list[DomeFrame],
    leds: LedMap,
    lever: Lever,
    camera: Camera,
    led_sigma_m: float,
    fit_distortion: bool,
) -> Survey:
    """`calibrate.survey`, robust against wrong names, with the map before it as a measurement. Raises BadInput."""
    try:
        return calibrate.survey(
            frames, leds, lever, camera, None, fit_distortion, loss="cauchy", leds_sigma_m=led_sigma_m
        )
    except ValueError as error:
        raise BadInput(str(error)) from None


class Navigation:
    """What the vehicle believes of its attitude: gyros added up, and corrected by the star tracker.

    scene : with `vehicle.imu`, and `filter` where there is one
    lab_from_body_wxyz : (4,) the true attitude at the start, when the navigator is zeroed
    place_body_m, gravity_m_s2 : of the accelerometers
    records : whether all that the unit put out is kept, for `record`
    """

    def __init__(
        self,
        scene: Scene,
        mount: Mount,
        lab_from_body: Rotation,
        place_body_m: Floats,
        gravity_m_s2: float,
        rng: np.random.Generator,
        records: bool = True,
    ) -> None:
        part = scene.vehicle.imu
        assert part is not None
        self.unit = imu.Unit.of(part, rng)
        self.place_body_m, self.gravity_m_s2 = place_body_m, gravity_m_s2
        self.body_from_cam = mount.cam_from_body.inv()
        self.step_s = 1 / part.rate_hz
        self.samples = 0
        earth = imu.earth_rate_lab_rad_s(scene.lab)
        self.earth_felt_rad_s = earth * (part.earth_rate != "none")
        self.earth_known_rad_s = earth * (part.earth_rate == "compensated")
        believed = at_home(lab_from_body, part.home_error_deg)
        self.navigator = imu.Navigator(believed.as_quat(scalar_first=True), self.earth_known_rad_s)
        self.filter = mekf(scene.filter, believed) if scene.filter else None
        self.records, self.measured = records, list[imu.Increments]()
        self.rate_rad_s = np.zeros(3)
        self.saturated = False

    def feel(self, now_s: float, t_s: Floats, lab_from_body_wxyz: Floats, rate_body_rad_s: Floats) -> None:
        """The unit's samples up to now, from the knots (K,), (K, 4), (K, 3) of the flight since the last call."""
        due = int(now_s / self.step_s + 1e-6) - self.samples
        if due < 1:
            return
        ends_s = (self.samples + 1 + np.arange(due)) * np.float64(self.step_s)
        self.samples += due
        ideal = imu.felt(
            t_s,
            lab_from_body_wxyz,
            rate_body_rad_s,
            ends_s,
            self.step_s,
            self.place_body_m,
            self.gravity_m_s2,
            self.earth_felt_rad_s,
        )
        measured = self.unit.measure(ideal)
        if self.records:
            self.measured.append(measured)
        self.navigator.add(measured)
        self.saturated = bool(measured.saturated.any())
        known = self.earth_body_rad_s(self.navigator.lab_from_body_wxyz)
        self.rate_rad_s = measured.angle_rad.mean(axis=0) / self.step_s - known
        if self.filter:
            known = self.earth_body_rad_s(self.attitude_wxyz("filter"))
            self.filter.propagate(ends_s, measured.angle_rad - known * self.step_s, measured.saturated)

    def record(self) -> imu.Increments:
        """All that the unit put out so far."""
        columns = zip(
            *((m.t_s, m.angle_rad, m.velocity_m_s, m.saturated, m.overloaded) for m in self.measured),
            strict=True,
        )
        t_s, angle, velocity, saturated, overloaded = (np.concatenate(column) for column in columns)
        return imu.Increments(t_s, self.step_s, angle, velocity, saturated, overloaded)

    def apparent_bias_rad_s(self, lab_from_body_wxyz: Floats, rate_body_rad_s: Floats) -> Floats:
        """(3,) what the gyros show too much at that true attitude and rate (3,), noise apart.

        Their bias, what scale factors and misalignments make of the rate, and the Earth where nobody takes it away.
        """
        unknown = self.earth_felt_rad_s - self.earth_known_rad_s
        earth = quaternion.apply(quaternion.inverse(lab_from_body_wxyz), unknown)
        return self.unit.gyro_bias_rad_s + self.unit.gyro.matrix @ rate_body_rad_s - rate_body_rad_s + earth

    def earth_body_rad_s(self, lab_from_body_wxyz: Floats) -> Floats:
        """(3,) what is taken away for the Earth's turning, in body axes."""
        return quaternion.apply(quaternion.inverse(lab_from_body_wxyz), self.earth_known_rad_s)

    def see(self, t_s: float, answer: Attitude) -> str:
        """A star tracker's solution for mid-exposure t_s; what the filter made of it."""
        if self.filter is None or answer.cam_from_ref is None or answer.covariance_rad2 is None:
            return answer.status
        body_from_cam = self.body_from_cam.as_matrix()
        covariance = body_from_cam @ answer.covariance_rad2 @ body_from_cam.T
        return self.filter.update(t_s, self.body_from_cam * answer.cam_from_ref, covariance).status

    def attitude_wxyz(self, feedback: str) -> Floats:
        """(4,) lab_from_body as the navigator or the filter has it."""
        if feedback == "imu" or self.filter is None:
            return self.navigator.lab_from_body_wxyz
        return self.filter.ref_from_body_wxyz

    def rate(self, feedback: str) -> Floats:
        """(3,) the body's rate in the lab as either has it, the mean over the last tick."""
        return self.rate_rad_s if feedback == "imu" or self.filter is None else self.filter.rate_rad_s


def at_home(lab_from_body: Rotation, error_deg: tuple[float, float, float]) -> Rotation:
    """What the navigator takes the attitude for when it is zeroed: the true one less the error in roll, pitch, yaw."""
    yaw, pitch, roll = lab_from_body.as_euler("ZYX", degrees=True)
    wrong = [yaw - error_deg[2], pitch - error_deg[1], roll - error_deg[0]]
    return Rotation.from_euler("ZYX", wrong, degrees=True)


def mekf(part: Filter, lab_from_body: Rotation) -> Mekf:
    """The attitude filter at the start, its reference the lab."""
    hour_s = 3600.0
    gyro = GyroModel(
        math.radians(part.arw_deg_sqrt_h) / math.sqrt(hour_s),
        math.radians(part.bias_deg_h) / hour_s,
        part.bias_time_s,
    )
    return Mekf(
        gyro,
        0.0,
        lab_from_body.inv(),
        math.radians(part.start_deg),
        math.radians(part.start_bias_deg_h) / hour_s,
        part.floor_arcsec * ARCSEC_RAD,
        part.gate_sigma,
    )
