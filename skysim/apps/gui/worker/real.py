"""A real camera beside the simulation: its frames by the scene's tracker, and what would explain their residuals.

The frames come from a folder that is watched, a video or a camera. A frame has the size of the scene's camera; a
rendered one at the same or another attitude is shown in its place, subtracted from it, or over it.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.trackers.pipeline import Report
from skysim.apps.gui.messages import REAL_VIEWS
from skysim.apps.gui.worker import workbench
from skysim.apps.gui.worker.photo import Photo, PhotoPixels, scene_photo
from skysim.apps.gui.worker.playback import UNCERTAINTY
from skysim.apps.live.gige_receiver import open_camera
from skysim.apps.plate_solver import plate_solution
from skysim.core import images
from skysim.core.errors import InputError
from skysim.core.images import ViewedImage
from skysim.core.types import Floats, Frame
from skysim.experiments.dome_survey import (
    adjust,
    survey_frames,
    survey_procedure,
    survey_report,
)
from skysim.experiments.dome_survey.survey_findings import SurveyRun
from skysim.experiments.dome_survey.survey_frames import CalibrationPrior, SurveyFrame
from skysim.results import plots
from skysim.results.metrics import rms
from skysim.scene.scene import Scene
from skysim.simulation.lab import build_lab
from skysim.tracking import factory, onboard_model

NO_FRAME = "no real frame is solved yet: watch a folder, a video or a camera"
CLEAR_SIGMAS = 3.0  # change over its standard error from which it is no chance
LIGHT_SIGMAS = 5.0  # scatter of the sky above which a pixel counts as light


class RealSource:
    """The pictures of a folder that is watched, or of a camera, a video or an address.

    Attributes
    ----------
    waiting
        Complete files of the folder that have not been read yet
    """

    def __init__(self, source: str) -> None:
        self.folder = Path(source) if Path(source).is_dir() else None
        self.camera = None if self.folder else open_camera(source)
        self.files = survey_procedure.CompleteFiles()
        self.waiting: list[Path] = []

    def picture(self) -> tuple[str, ViewedImage] | None:
        """Name and pixels of the next one; None if the folder has no further file now. Raises InputError."""
        if self.camera:
            return "camera", images.as_light(ViewedImage(self.camera.frame()))
        assert self.folder is not None
        self.waiting += self.files.new(survey_procedure.best_images(self.folder))
        if not self.waiting:
            return None
        path = self.waiting.pop(0)
        return path.name, images.as_light(images.read_picture(path))

    def close(self) -> None:
        """Release the camera."""
        if self.camera:
            self.camera.close()


class RealComparison:
    """Frames of a real camera by the tracker of a scene.

    Attributes
    ----------
    solver
        Solver of the scene's dome, without simulated errors, since a real dome has its own; None under the sky
    taken, rms_px
        Solved frames, and the tracker's residuals of each
    pictures
        The newest frame by REAL_VIEWS
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.solver = plate_solution.dome_solver(scene) if scene.dome else None
        self.taken: list[SurveyFrame] = []
        self.rms_px: list[float] = []
        self.pictures: dict[str, NDArray] = {}
        self.photo: Photo | None = None

    def solve(
        self, bench: workbench.Workbench, name: str, picture: ViewedImage, follow: bool
    ) -> PhotoPixels:
        """Solve a frame, and render one at its attitude, or at that of the workbench. Raises InputError.

        Parameters
        ----------
        follow
            Whether the workbench takes the attitude of the frame
        """
        lens = bench.scene.camera
        images.check_size(Path(name), picture.pixels, (lens.height_px, lens.width_px))
        pixels, report, tracker = self.report(bench, picture)
        attitude = report.attitude
        mount = bench.lab.camera.mount
        if attitude.cam_from_ref is not None:
            body_from_lab = mount.body_from_cam * attitude.cam_from_ref
            self.taken.append(SurveyFrame(report.centroids, body_from_lab, len(self.taken)))
            self.rms_px.append(attitude.rms_px)
            if follow:
                bench.lab_from_body = body_from_lab.inv()
        bench.render_at_rest()
        assert bench.frame is not None
        assert bench.truth is not None
        frame = replace(bench.frame, image_dn=pixels)
        solved = replace(bench, estimator=tracker)
        photo = scene_photo(bench, solved.frame_view(frame, bench.truth, report, 0.0))
        # The simulated attitude is no truth of the real one.
        result = replace(photo.result, row=replace(photo.result.row, wrong=False))
        pose = photo.pose if follow else None
        self.photo = replace(photo, result=result, pose=pose, name=name, compared=True)
        self.pictures = pictures(pixels, bench.frame.image_dn)
        return self.show(REAL_VIEWS[0])

    def report(
        self, bench: workbench.Workbench, picture: ViewedImage
    ) -> tuple[NDArray, Report, factory.Estimator]:
        """The pixels as the tracker reads them, its report, and the tracker."""
        if self.solver:
            reading = plate_solution.solve_dome(picture, self.solver)
            return reading.pixels, reading.report, self.solver.tracker
        exposure_s = picture.exposure_s or bench.scene.exposure.time_s
        frame = Frame(0, picture.pixels, 0.0, exposure_s, np.inf)
        return picture.pixels, factory.solve_frame(bench.estimator, frame), bench.estimator

    def show(self, name: str) -> PhotoPixels:
        """The newest frame as one of REAL_VIEWS. Raises InputError if there is none."""
        if self.photo is None or name not in self.pictures:
            raise InputError("", NO_FRAME)
        image = self.pictures[name]
        statistics = plots.frame_statistics(image, self.photo.saturation_dn)
        return replace(self.photo, statistics=statistics), image

    def explain(self) -> str:
        """What a survey by the frames so far finds of focal length, lever and LEDs. Raises InputError."""
        lab = build_lab(survey_frames.as_listed(self.scene))
        camera = onboard_model.assumed_camera(lab.scene)
        prior = survey_frames.listed_prior(lab, camera)._replace(uncertainty=UNCERTAINTY)
        if not self.taken:
            raise InputError("", NO_FRAME)
        run = adjust.run_survey(self.taken, prior)
        return explanation(run, prior, float(rms(np.array(self.rms_px))))


def pictures(real: NDArray, simulated: NDArray) -> dict[str, NDArray]:
    """The images by REAL_VIEWS: the simulated one has the real one's amount of light in their difference and mean."""

    def over_sky(image: NDArray) -> tuple[Floats, float]:
        statistics = plots.frame_statistics(image, np.inf)
        above_dn = image - statistics.sky_dn
        is_light = above_dn > LIGHT_SIGMAS * statistics.scatter_dn
        return above_dn, float(above_dn[is_light].sum())

    real_dn, real_sum = over_sky(real)
    simulated_dn, simulated_sum = over_sky(simulated)
    scaled_dn = simulated_dn * (real_sum / simulated_sum if real_sum * simulated_sum else 1.0)
    mixed = real, simulated, real_dn - scaled_dn, (real_dn + scaled_dn) / 2
    return dict(zip(REAL_VIEWS, mixed, strict=True))


def explanation(run: SurveyRun, prior: CalibrationPrior, before_px: float) -> str:
    """The changes that a survey makes, each with its standard error, the most significant first.

    Parameters
    ----------
    before_px
        Rms of the residuals by the model before it
    """
    found = survey_report.survey_statistics(run, prior)
    measured = run.survey.surveyed
    moved_m = (run.survey.leds.position_m - run.listed.position_m)[measured]
    led_mm = 1e3 * float(rms(moved_m.ravel()))
    sigma_mm = 1e3 * run.accuracy.led_rms_m
    changes = [
        (row["what"], row["found"] - row["believed"], row["sigma"])
        for row in found["values"]
        if row["sigma"]
    ]
    changes.append(
        (f"places of {measured.sum()} LEDs, mm rms along an axis", led_mm, sigma_mm)
    )
    changes.sort(key=lambda one: -abs(one[1] / one[2]))
    _, change, sigma = changes[0]
    is_clear = abs(change) > CLEAR_SIGMAS * sigma
    first = "" if is_clear else " Nothing explains the residuals yet: more frames."
    listed = "; ".join(
        f"{what} {change:+.2f} ± {sigma:.2g}" for what, change, sigma in changes
    )
    return (
        f"{len(run.matches)} of {len(run.taken)} frames are connected, residuals {before_px:.2g} px rms before and"
        f" {found['rms_px']:.2g} px after. Found minus assumed, the most significant first: {listed}.{first}"
    )
