"""State of a GUI worker: a scene's lab and tracker, and the current attitude."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import project
from estimator.core.types import Attitude
from estimator.trackers.coded_tracker import CodedTracker
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Clock, Report
from estimator.trackers.star_tracker import StarTracker
from skysim.apps.gui.messages import (
    LIGHT,
    AmbiguityMap,
    Detection,
    FrameView,
    Lens,
    Lights,
    SceneInfo,
    TrackerResult,
)
from skysim.apps.gui.worker import geometry
from skysim.core import quaternion
from skysim.core.types import Floats, Frame, Ints, Record, Trajectory, Truth
from skysim.core.yaml_reader import yaml_line
from skysim.experiments.dome_survey import survey_frames
from skysim.results import plots, scoring
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import PRESCRIBED
from skysim.simulation import checks, exposure
from skysim.simulation.lab import (
    MAIN,
    Lab,
    StarCamera,
    build_lab,
    build_tracker,
    frame_end_s,
)
from skysim.tracking import factory, onboard_model

MAX_WINDOWS = 200
CODE_RUNS = 2  # repetitions of the LEDs' codes after which unnamed LEDs remain unnamed


@dataclass
class Workbench:
    """A scene that is set up, with the current attitude and the newest frame.

    Attributes
    ----------
    scene, lab
        The scene as the shown camera sees it, and the laboratory with this camera as the main one
    whole, head
        The laboratory with all cameras, and the number of the shown one
    lens
        Directions of the camera's pixels
    geometry
        Geometry of the laboratory
    rendered_count
        Number of frames rendered; it changes the seed, so that each frame has independent noise
    magnitude
        V magnitude by number of the light
    """

    scene: Scene
    lab: Lab
    estimator: factory.Estimator
    lab_from_body: Rotation
    lens: Lens
    geometry: Record
    whole: Lab
    head: int = 0
    rendered_count: int = 0
    frame: Frame | None = None
    truth: Truth | None = None
    report: Report | None = None
    result: TrackerResult | None = None
    magnitude: dict[int, float] = field(default_factory=dict)

    @classmethod
    def open(
        cls,
        name: str,
        overrides: Mapping[str, str],
        before: Workbench | None = None,
        head: str = MAIN,
    ) -> Workbench:
        """Set up a scene for a head of that name, or else its main camera; keep `before` if it is the same.

        If only the tracker differs from `before`, its lab is kept; if only tracker and cameras differ, its attitude.

        Raises
        ------
        InputError
        """
        scene = load(name, overrides)
        former = before.whole.scene if before else None
        keeps_lab = former and former.with_values(tracker=scene.tracker) == scene
        whole = before.whole.with_scene(scene) if before and keeps_lab else build_lab(scene)
        names = [camera.name for camera in whole.cameras]
        number = names.index(head) if head in names else 0
        lab = whole.of_camera(number) if number else whole
        if before and keeps_lab and before.head == number:
            if former == scene:
                return before
            tracker = build_tracker(lab.camera)
            return replace(before, scene=lab.scene, lab=lab, whole=whole, estimator=tracker)
        hardware = {"tracker": scene.tracker, "camera": scene.camera}
        keeps_attitude = former and former.with_values(**hardware) == scene
        return cls(
            lab.scene,
            lab,
            build_tracker(lab.camera),
            before.lab_from_body if before and keeps_attitude else lab.start,
            geometry.scene_lens(lab),
            geometry.lab_geometry(lab),
            whole,
            number,
            magnitude=magnitude_by_id(lab),
        )

    @property
    def scene_info(self) -> SceneInfo:
        """Properties of the scene for the page."""
        scene = self.scene
        lens = scene.camera.calibration()
        settings = factory.assumed_settings(scene)
        return SceneInfo(
            scene,
            scoring.angle_names(scene),
            id_prefix(self.lab),
            lens.field_deg[0],
            lens.arcsec_px,
            {name: getattr(settings, name) for name in factory.STAR_ALGORITHMS},
            self.whole.duration_s,
            scene.camera.detector.noise,
            self.geometry,
            self.lens,
            heads=tuple(camera.name for camera in self.whole.cameras),
            head=self.lab.camera.name,
            code_frames=CODE_RUNS * self.estimator.tracks.frames
            if isinstance(self.estimator, CodedTracker)
            else 0,
        )

    def scene_at_rest(self) -> dict[str, str]:
        """Overrides for the scene in which the vehicle rests at the present attitude."""
        if self.lab_from_body == self.lab.start or self.scene.vehicle.mount == "two_axis":
            return {}  # a mount of two axes has no other attitudes than those of its profiles
        camera = self.lab.camera
        angles = scoring.angles_deg(
            camera.mount.cam_from_body * self.lab_from_body.inv(), camera
        )
        names = scoring.angle_names(self.scene)
        start = {
            f"{name.lower()}_deg": angle for name, angle in zip(names, angles, strict=True)
        }
        motion = {
            "start": start,
            "control": PRESCRIBED,
            "maneuver": [],
            "jitter": [],
            "rate_deg_s": [0, 0, 0],
        }
        return {f"motion.{key}": yaml_line(value) for key, value in motion.items()}

    def render_at_rest(self, solve: bool = False, index: int = 0) -> FrameView:
        """Render a frame of a run at the current attitude at rest; solve it if `solve`.

        Frame 0 begins another run. Only the later ones of the same run show an LED's next bits.
        """
        run = self.run if index else self.next_run()
        trajectory = Trajectory.at_rest(self.lab_from_body, frame_end_s(self.scene, index))
        return self.render(run.camera, trajectory, solve, index)

    @property
    def run(self) -> Lab:
        """The lab of the newest run."""
        return self.lab.in_run(self.scene.seed + self.rendered_count)

    def cover(self, lab_from_body: Rotation) -> tuple[int, scoring.FrameRow]:
        """Number of lights in the field at an attitude at rest, and the frame in numbers; the shown frame stays."""
        trajectory = Trajectory.at_rest(lab_from_body, frame_end_s(self.scene, 0))
        camera = self.next_run().camera
        frame, truth = exposure.render_frame(camera, trajectory, 0)
        report = factory.solve_frame(self.estimator, frame)
        return len(truth.sources.id), scoring.row(camera, frame, truth, report)

    def next_run(self) -> Lab:
        """The lab of the next run, with independent noise."""
        self.rendered_count += 1
        return self.run

    def render(
        self, camera: StarCamera, trajectory: Trajectory, solve: bool, index: int = 0
    ) -> FrameView:
        """Render a frame of a camera in motion, solve it if `solve`, and return the view for the page."""
        clock = Clock()
        self.frame, self.truth = exposure.render_frame(camera, trajectory, index)
        self.report = factory.solve_frame(self.estimator, self.frame) if solve else None
        clock.lap("all")
        view = self.frame_view(self.frame, self.truth, self.report, clock.seconds["all"])
        self.result = view.result
        return view

    def frame_view(
        self,
        frame: Frame,
        truth: Truth,
        report: Report | None,
        seconds: float,
        update_status: str = "",
    ) -> FrameView:
        """The view of a frame of this scene for the page, without its pixels."""
        return FrameView(
            geometry.scene_pose(self.lab, self.lens, truth),
            frame.saturation_dn,
            scoring.true_angles_deg(self.lab.camera, truth),
            quaternion.from_rotation(truth.lab_from_body),
            frame.exposure_s,
            plots.frame_statistics(frame.image_dn, frame.saturation_dn),
            true_lights(truth, self.magnitude),
            tracker_result(self.lab, self.estimator, frame, truth, report, update_status)
            if report
            else None,
            1e3 * seconds,
        )


def id_prefix(lab: Lab) -> str:
    """Prefix of the lights' numbers: LED if no light has a magnitude, else HIP."""
    return "LED" if np.isnan(lab.camera.sources.magnitude).all() else "HIP"


def true_lights(truth: Truth, magnitude: Mapping[int, float]) -> Lights:
    """Return the true lights of a frame, the brightest first.

    Parameters
    ----------
    magnitude
        V magnitude by number, of stars and LEDs
    """
    sources = truth.sources
    of_bodies = {body.id: body.v_mag for body in truth.bodies}
    of_bodies |= {satellite.id: satellite.v_mag for satellite in truth.satellites}
    rows = np.argsort(-sources.electrons)
    ids = sources.id[rows]
    magnitudes = [of_bodies.get(id, magnitude.get(id, math.nan)) for id in ids.tolist()]
    charges = (
        sources.electrons[rows],
        magnitudes,
        sources.peak_e[rows],
        sources.saturated[rows],
    )
    return np.rec.fromarrays([ids, sources.flux_xy_px[rows], *charges], LIGHT)


def magnitude_by_id(lab: Lab) -> dict[int, float]:
    """V magnitude by a light's number; NaN for an LED."""
    return dict(
        zip(
            lab.camera.sources.id.tolist(), lab.camera.sources.magnitude.tolist(), strict=True
        )
    )


def tracker_result(
    lab: Lab,
    estimator: factory.Estimator,
    frame: Frame,
    truth: Truth,
    report: Report,
    update_status: str = "",
) -> TrackerResult:
    """The tracker's report with its errors relative to the truth."""
    row = scoring.row(lab.camera, frame, truth, report, update_status)
    # Lights in the field: tracking mode would search at their places in the next frame.
    windows_px: list[tuple[float, float]] = []
    if report.attitude.solved and not isinstance(estimator, factory.UserTracker):
        _, xy_px = predicted_lights(estimator, report.attitude)
        inside = estimator.camera.contains(np.nan_to_num(xy_px, nan=-1e9))
        windows_px = [(x, y) for x, y in xy_px[inside][:MAX_WINDOWS].tolist()]
    return TrackerResult(row, detections_of(estimator, report), tuple(windows_px))


def detections_of(estimator: factory.Estimator, report: Report) -> tuple[Detection, ...]:
    """Detections with the numbers of their matched lights, and their places relative to the predicted ones of these."""
    centroids = report.centroids
    ids = np.full(len(centroids.flux), -1)
    residual_px = np.full((len(ids), 2), math.nan)
    attitude = report.attitude
    if (
        attitude.match is not None
        and attitude.cam_from_ref is not None
        and not isinstance(estimator, factory.UserTracker)
    ):
        light_ids, predicted_px = predicted_lights(estimator, attitude)
        rows = attitude.match.observed
        light = attitude.match.star
        ids[rows] = light_ids[light]
        residual_px[rows] = centroids.xy_px[rows] - predicted_px[light]
    columns = (*centroids.xy_px.T, centroids.sigma_px, centroids.flux, ids)
    vectors_px = map(tuple, residual_px.tolist())
    return tuple(map(Detection, *(column.tolist() for column in columns), vectors_px))


def predicted_lights(
    estimator: DomeTracker | StarTracker, attitude: Attitude
) -> tuple[Ints, Floats]:
    """(N,) ids and (N, 2) predicted pixels of all lights on the tracker's map, for its attitude and camera model.

    If the solution has its own camera (the field of view was fitted), that camera is used.
    """
    assert attitude.cam_from_ref is not None
    camera = attitude.camera or estimator.camera
    if isinstance(estimator, DomeTracker):
        body_from_lab = estimator.lever.cam_from_body.inv() * attitude.cam_from_ref
        places = estimator.leds.position_m
        return estimator.leds.id, project(body_from_lab, places, estimator.lever, camera)
    return estimator.stars.id, camera.pixels(
        attitude.cam_from_ref.apply(estimator.stars.vectors)
    )


def ambiguity(lab: Lab) -> AmbiguityMap:
    """How much of the field about each LED another field shows too. Raises InputError for a scene without such fields.

    See `skysim.sources.dome.layouts.ambiguity`.
    """
    found, coincidence_m = checks.ambiguity_map(lab)
    ids = onboard_model.assumed_dome(
        lab.scene, survey_frames.require_dome(lab.scene), lab.camera.sources
    ).id
    return AmbiguityMap(
        ids[found.led],
        ids[found.other],
        found.fraction,
        checks.LEAST_ALIKE,
        1e3 * coincidence_m,
    )
