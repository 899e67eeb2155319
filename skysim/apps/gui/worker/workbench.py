"""State of a GUI worker: a scene's testbed and tracker, and the current attitude."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import project
from estimator.core.types import Attitude
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Clock, Report
from estimator.trackers.star_tracker import StarTracker
from skysim.apps.gui.messages import Answer, Detection, FrameView, Light, SceneInfo, Triple, Zoom
from skysim.apps.gui.worker import geometry, pointing
from skysim.core import quaternion
from skysim.core.types import Floats, Frame, Trajectory, Truth
from skysim.core.units import ARCSEC_RAD
from skysim.results import metrics, scoring
from skysim.results import stretch as contrast
from skysim.scene.light import StarsConfig
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.simulation import exposure, testbed
from skysim.simulation.testbed import SPARE_S, Testbed
from skysim.tracking import factory
from skysim.tracking import settings as tracker_settings
from skysim.tracking.external.adapter import ExternalTracker

ZOOMED = (11, 7)  # enlarged pixels across and down; their values remain readable
STAGES = ("detector", "centroider", "identifier", "solver")


@dataclass
class Workbench:
    """A scene that is set up, with the current attitude and the newest frame.

    stretch, bright, widest_px : how frames are displayed
    shots : number of frames rendered; it changes the seed, so that each frame has independent noise
    magnitude : V magnitude by a light's number
    """

    scene: Scene
    lab: Testbed
    estimator: factory.Estimator
    lab_from_body: Rotation
    stretch: str = "square root"
    bright: float = 1.0
    widest_px: int = 1400
    shots: int = 0
    frame: Frame | None = None
    truth: Truth | None = None
    report: Report | None = None
    magnitude: dict[int, float] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, overrides: Mapping[str, str], before: Workbench | None = None) -> Workbench:
        """Set up a scene. If only the tracker differs from `before`, its testbed and attitude are kept.

        Raises InputError.
        """
        scene = load(name, overrides)
        if before and before.scene.model_copy(update={"tracker": scene.tracker}) == scene:
            lab = replace(before.lab, scene=scene)
            return replace(before, scene=scene, lab=lab, estimator=testbed.tracker(lab))
        lab = testbed.build_testbed(scene)
        here = lab.trajectory.lab_from_body[0]
        desk = cls(scene, lab, testbed.tracker(lab), here, magnitude=magnitudes(lab))
        if before:
            return replace(desk, stretch=before.stretch, bright=before.bright, widest_px=before.widest_px)
        return desk

    def packed(self, image: NDArray) -> bytes:
        """JPEG of an image: stretched, and reduced to the width on the screen."""
        return contrast.jpeg(
            contrast.fitted(contrast.stretched(image, self.stretch, self.bright), self.widest_px)
        )

    @property
    def setting(self) -> SceneInfo:
        """Facts about the scene for the page."""
        scene, settings = self.scene, tracker_settings.believed_settings(self.scene)
        camera = scene.camera
        return SceneInfo(
            scene.name,
            scene.title,
            isinstance(scene.light, StarsConfig),
            scoring.angle_names(scene),
            prefix_of(self.lab),
            2 * math.degrees(math.atan(camera.width_px / 2 / camera.focal_px)),
            {name: getattr(settings, name) for name in STAGES},
            tracker_settings.choices(scene),
            bool(scene.motion.manoeuvre or any(scene.motion.rate_deg_s)),
            self.lab.flown_s,
            geometry.of(self.lab),
        )

    def point(self, angles_deg: Triple) -> None:
        """Set the attitude. Raises InputError."""
        self.lab_from_body = pointing.from_angles(self.scene, self.lab.mount, angles_deg)

    def move(self, right: float, up: float, roll_deg: float) -> None:
        """Change the attitude by a step. Raises InputError."""
        self.lab_from_body = pointing.moved(
            self.scene, self.lab.mount, self.lab_from_body, right, up, roll_deg
        )

    def look(self, solve: bool = False) -> FrameView:
        """Render a frame at the current attitude at rest, with independent noise; solve it if asked."""
        self.shots += 1
        scene = self.scene.model_copy(update={"seed": self.scene.seed + self.shots})
        when = testbed.window(scene, 0)
        end_s = when.close_s(scene.camera.height_px) + SPARE_S
        still = Trajectory.at_rest(self.lab_from_body, end_s)
        return self.shown(replace(self.lab, scene=scene, trajectory=still), solve)

    @property
    def answer(self) -> Answer | None:
        """The tracker's solution of the newest frame; None if it was not solved."""
        if self.report is None or self.truth is None:
            return None
        return answered(self.lab, self.estimator, self.report, self.truth)

    def shown(self, lab: Testbed, solve: bool) -> FrameView:
        """Render frame 0 of a testbed, solve it if asked, and return the view for the page."""
        clock = Clock()
        self.frame, self.truth = exposure.render_frame(lab, 0)
        self.report = factory.solve_frame(self.estimator, self.frame) if solve else None
        packed, (height, width) = self.packed(self.frame.image_dn), self.frame.image_dn.shape
        clock.lap("all")
        return FrameView(
            packed,
            (width, height),
            scoring.angles_deg(self.truth.cam_from_lab, self.scene, self.lab.mount),
            tuple(quaternion.of(self.truth.lab_from_body).tolist()),
            self.frame.exposure_s,
            contrast.facts(self.frame.image_dn, self.frame.saturation_dn),
            lights_of(self.truth, self.magnitude),
            self.answer,
            1e3 * clock.seconds["all"],
        )


def prefix_of(lab: Testbed) -> str:
    """Catalog of the lights' numbers: LED if no light has a magnitude, else HIP."""
    return "LED" if np.isnan(lab.sources.magnitude).all() else "HIP"


def lights_of(truth: Truth, magnitude: Mapping[int, float]) -> tuple[Light, ...]:
    """The true lights of a frame, the brightest first."""
    seen = truth.seen
    rows = np.argsort(-seen.electrons)
    told = zip(
        seen.id[rows].tolist(), seen.flux_xy_px[rows].tolist(), seen.electrons[rows].tolist(), strict=True
    )
    return tuple(Light(id, x, y, e, magnitude.get(id, math.nan)) for id, (x, y), e in told)


def magnitudes(lab: Testbed) -> dict[int, float]:
    """V magnitude by a light's number; NaN for an LED."""
    return dict(zip(lab.sources.id.tolist(), lab.sources.magnitude.tolist(), strict=True))


def answered(lab: Testbed, estimator: factory.Estimator, report: Report, truth: Truth) -> Answer:
    """The tracker's report with its errors relative to the truth."""
    told, ms = report.attitude, 1e3 * sum(report.seconds.values())
    spots = spots_of(report, named(estimator, told, report.centroids.xy_px))
    if told.cam_from_ref is None:
        return Answer(told.status, spots, ms)
    cross, roll = metrics.cross_and_roll_rad(told.cam_from_ref, truth.cam_from_lab)
    return Answer(
        told.status,
        spots,
        ms,
        scoring.angles_deg(told.cam_from_ref, lab.scene, lab.mount),
        cross / ARCSEC_RAD,
        roll / ARCSEC_RAD,
        claimed_arcsec(told),
        metrics.is_wrong(told.cam_from_ref, truth.cam_from_lab),
        windows(estimator, told),
    )


def spots_of(report: Report, names: Mapping[int, tuple[int, float]]) -> tuple[Detection, ...]:
    """Detections with id and residual of their matched lights. names : (id, residual in pixels) by centroid row"""
    seen = report.centroids
    rows = zip(seen.xy_px.tolist(), seen.sigma_px.tolist(), seen.flux.tolist(), strict=True)
    return tuple(
        Detection(x, y, sigma, flux, *names.get(n, (-1, math.nan)))
        for n, ((x, y), sigma, flux) in enumerate(rows)
    )


def zoomed(image: NDArray, x: float, y: float) -> Zoom:
    """The window of ZOOMED pixels around (x, y), moved inside the image at its border."""
    (height, width), (across, down) = image.shape, ZOOMED
    x0 = min(max(round(x) - across // 2, 0), max(width - across, 0))
    y0 = min(max(round(y) - down // 2, 0), max(height - down, 0))
    part = np.rint(image[y0 : y0 + down, x0 : x0 + across]).astype(int)
    return Zoom(x0, y0, tuple(map(tuple, part.tolist())))


def claimed_arcsec(told: Attitude) -> tuple[float, float]:
    """Estimated standard errors across the boresight (both axes) and about it, arcsec; NaN without a covariance."""
    if told.covariance_rad2 is None:
        return math.nan, math.nan
    variance = np.diag(told.covariance_rad2)
    return float(np.sqrt(variance[:2].sum())) / ARCSEC_RAD, float(np.sqrt(variance[2])) / ARCSEC_RAD


def predicted(estimator: DomeTracker | StarTracker, told: Attitude) -> tuple[NDArray[np.int64], Floats]:
    """(N,) ids and (N, 2) predicted pixels of all lights on the tracker's map, for its attitude and camera model.

    If the solution has its own camera (the field of view was fitted), that camera is used.
    """
    assert told.cam_from_ref is not None
    if isinstance(estimator, DomeTracker):
        body_from_lab = estimator.lever.cam_from_body.inv() * told.cam_from_ref
        places = estimator.leds.position_m
        return estimator.leds.id, project(body_from_lab, places, estimator.lever, estimator.camera)
    camera = told.camera or estimator.camera
    return estimator.stars.id, camera.pixels(told.cam_from_ref.apply(estimator.stars.vectors))


def named(estimator: factory.Estimator, told: Attitude, xy_px: Floats) -> dict[int, tuple[int, float]]:
    """By centroid row: (id of the matched light, distance from its predicted position in pixels)."""
    if told.match is None or told.cam_from_ref is None or isinstance(estimator, ExternalTracker):
        return {}
    ids, where = predicted(estimator, told)
    rows, star = told.match.observed, told.match.star
    off = np.hypot(*(where[star] - xy_px[rows]).T)
    return dict(zip(rows.tolist(), zip(ids[star].tolist(), off.tolist(), strict=True), strict=True))


def windows(estimator: factory.Estimator, told: Attitude) -> tuple[tuple[float, float], ...]:
    """Predicted pixels of up to 200 lights in the field: where tracking mode would search in the next frame."""
    if isinstance(estimator, ExternalTracker):
        return ()
    _, xy_px = predicted(estimator, told)
    inside = estimator.camera.contains(np.nan_to_num(xy_px, nan=-1e9))
    return tuple((float(x), float(y)) for x, y in xy_px[inside][:200])
