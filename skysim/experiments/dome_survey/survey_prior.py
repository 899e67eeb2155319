"""The model that is assumed before a survey of the dome, and its uncertainty."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.calibration.bundle_adjustment import Assumed
from estimator.calibration.survey_plan import SurveyModel
from estimator.core.camera import Camera
from estimator.identification.led_codes import LedCode
from skysim.core.errors import InputError
from skysim.core.types import Floats, Ints, Sources
from skysim.core.units import quantities_within
from skysim.experiments.tracker_comparison import with_config
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig
from skysim.scene.sections.tracker import SurveyErrorsConfig
from skysim.simulation.lab import Lab
from skysim.sources.dome import surface
from skysim.sources.dome.layouts import led_list, registry
from skysim.tracking import onboard_model
from skysim.tracking.factory import DOME_SIGMA_PX

BLUR_PX = 3.0  # width of an image's blurred edge

# Options: unit, quantity, example, minimum and maximum. The LED error must be > 0, because it weights the map.
UNCERTAINTY_RANGES = {
    "imu_sigma": ("rad", "plane angle", '"0.5 deg"', 0.0, 0.1),
    "led_sigma": ("m", "length", '"2 mm"', 1e-6, 0.1),
    "lever_sigma": ("m", "length", '"5 mm"', 0.0, 0.1),
    "focal_error": ("", "share", '"1%" or "0.01"', 0.0, 0.1),
}


class SurveyUncertainty(NamedTuple):
    """Uncertainty before the survey: standard deviations along or about each axis, and of the focal length.

    Attributes
    ----------
    imu_sigma_rad
        Attitude from the IMU at each frame
    led_sigma_m
        Position of each LED
    lever_sigma_m
        Position of the camera in the body
    focal_error
        Relative standard deviation of the assumed focal length
    fit_distortion
        Nothing is known of k1, k2, p1, p2, so that the survey fits them. A narrow field hardly
        determines them, and they correlate with the focal length: on the AFIT dome its sigma grows
        from 10 to 80 px, while the attitude does not change
    """

    imu_sigma_rad: float
    led_sigma_m: float
    lever_sigma_m: float
    focal_error: float
    fit_distortion: bool

    def focal_sigma_px(self, camera: Camera) -> float:
        """Standard deviation of the assumed focal length of a camera."""
        return self.focal_error * camera.focal_px


EXACT = SurveyUncertainty(0.0, 0.0, 0.0, 0.0, fit_distortion=False)


class CalibrationPrior(NamedTuple):
    """Assumed model of dome and camera, before a survey or from it.

    Attributes
    ----------
    floor_px
        Least standard deviation of the residuals of predictions, for the matching of lights
    disk_m
        Diameter of an LED's luminous disk
    levels
        (N,) relative nominal brightness of the LEDs
    code
        Code of the LEDs; None if all are steady
    uncertainty
        Errors of the model, which a survey needs
    """

    camera: Camera
    leds: LedMap
    lever: Lever
    floor_px: float
    disk_m: float
    levels: Floats
    code: LedCode | None = None
    uncertainty: SurveyUncertainty = EXACT

    def expected_light(self, index: Ints) -> Floats:
        """(F, N) relative light of each LED in frames of these numbers; 0 if its code switches it off."""
        if self.code is None or self.code.bit_time_s is not None:
            return np.tile(self.levels, (len(index), 1))
        return self.levels * self.code.levels[:, index % self.code.bits].T

    @property
    def nearest_m(self) -> float:
        """Least distance of an LED from the center of rotation."""
        return float(np.linalg.norm(self.leds.position_m, axis=1).min())

    @property
    def px_per_m(self) -> float:
        """Image scale in pixels per meter perpendicular to the line of sight, at the least distance of an LED."""
        return float(
            self.camera.focal_px / (self.nearest_m - np.linalg.norm(self.lever.camera_body_m))
        )

    @property
    def margin_px(self) -> float:
        """Margin from the chip's edge for a complete image: its radius at the least distance, and BLUR_PX of blur."""
        return self.disk_m / 2 * self.px_per_m + BLUR_PX

    def pixels(self, body_from_lab: Rotation) -> Floats:
        """(N, 2) pixel positions of the LEDs; far outside the image for LEDs behind the camera."""
        xy_px = project(body_from_lab, self.leds.position_m, self.lever, self.camera)
        return np.nan_to_num(xy_px, nan=-1e9)


def survey_uncertainty(
    imu_sigma: str = "0.5 deg",
    led_sigma: str = "2 mm",
    lever_sigma: str = "5 mm",
    focal_error: str = "1%",
    fit_distortion: bool = False,
) -> SurveyUncertainty:
    """Parse quantities with units. Raises InputError for an invalid or out-of-range value."""
    texts = imu_sigma, led_sigma, lever_sigma, focal_error
    sigmas = quantities_within("survey", UNCERTAINTY_RANGES, texts)
    return SurveyUncertainty._make([*sigmas, fit_distortion])


def before_text(scene: Scene, uncertainty: SurveyUncertainty) -> str:
    """The uncertainty before a survey in words, and that of the scene's tracker, which has no part in it."""
    text = (
        f"before the survey: LEDs to {1e3 * uncertainty.led_sigma_m:.3g} mm (--led-sigma), the lever to"
        f" {1e3 * uncertainty.lever_sigma_m:.3g} mm (--lever-sigma), the focal length to"
        f" {100 * uncertainty.focal_error:.3g} % (--focal-error)"
    )
    own = scene.tracker.survey
    if own == SurveyErrorsConfig(seed=own.seed):
        return text
    return (
        f"{text}; not the scene's tracker.survey (LEDs {1e3 * own.led_sigma_m:.3g} mm, lever"
        f" {1e3 * own.lever_sigma_m:.3g} mm), which is what its tracker flies with"
    )


def calibration_prior(lab: Lab) -> CalibrationPrior:
    """The onboard model of the tracker of a lab. Raises InputError for a scene without a dome."""
    light = require_dome(lab.scene)
    leds = onboard_model.assumed_dome(lab.scene, light, lab.camera.sources)
    return prior_of(lab, onboard_model.assumed_camera(lab.scene), leds)


def listed_prior(lab: Lab, camera: Camera) -> CalibrationPrior:
    """The model of a dome by its list, without the simulated errors of the scene, with this camera."""
    light = require_dome(lab.scene)
    inside = surface.build_surface(light.surface)
    design = design_of(lab)
    board = registry.board_of(light.layout, design.id)
    leds = LedMap(design.id, design.place[:, :3], *inside.as_ellipsoid(), board)
    return prior_of(lab, camera, leds)


def prior_of(lab: Lab, camera: Camera, leds: LedMap) -> CalibrationPrior:
    """The prior with these LEDs, their nominal brightness and code, and the tracker's assumed lever."""
    scene = lab.scene
    design = design_of(lab)
    levels = design.strength[onboard_model.rows_of(leds.id, design.id)]
    lever = onboard_model.assumed_lever(scene, lab.camera.mount)
    light = require_dome(scene)
    code = (
        onboard_model.assumed_code(light, lab.camera.sources, leds)
        if light.led.code
        else None
    )
    floor_px = scene.tracker.centroid_sigma_px or DOME_SIGMA_PX
    disk_m = light.led.disk_diameter_m
    return CalibrationPrior(
        camera, leds, lever, floor_px, disk_m, levels / levels.max(), code
    )


def design_of(lab: Lab) -> Sources:
    """The LEDs of the dome as designed."""
    light = require_dome(lab.scene)
    return led_list.design_leds(light, surface.build_surface(light.surface), lab.camera.band)


def require_dome(scene: Scene) -> DomeConfig:
    """The dome of a scene. Raises InputError if its light is another."""
    if scene.dome is None:
        raise InputError("light.kind", f"a survey needs LEDs, not {scene.light.kind}", "dome")
    return scene.dome


def survey_model(known: CalibrationPrior, noise_px: float) -> SurveyModel:
    """The estimator's model for plans and predictions, with the knowledge before or after a survey."""
    uncertainty = known.uncertainty
    sigmas = (
        uncertainty.led_sigma_m,
        uncertainty.lever_sigma_m,
        uncertainty.focal_sigma_px(known.camera),
        uncertainty.fit_distortion,
    )
    return SurveyModel(known.camera, known.leds, known.lever, noise_px, *sigmas)


def assumed(prior: CalibrationPrior) -> Assumed:
    """Lever and focal length before a survey, which enter its adjustment as measurements."""
    camera = prior.camera
    uncertainty = prior.uncertainty
    arm_m = prior.lever.camera_body_m
    return Assumed(
        arm_m, uncertainty.lever_sigma_m, camera.focal_px, uncertainty.focal_sigma_px(camera)
    )


def with_survey_errors(scene: Scene, uncertainty: SurveyUncertainty) -> Scene:
    """The scene with the onboard model before a survey: errors of this size, drawn with `tracker.survey.seed`."""
    return with_config(
        with_map(scene, None),
        "tracker.survey",
        led_sigma_m=uncertainty.led_sigma_m,
        lever_sigma_m=uncertainty.lever_sigma_m,
        focal_length_sigma_m=scene.camera.focal_length_m * uncertainty.focal_error,
    )


def as_listed(scene: Scene) -> Scene:
    """The scene whose tracker assumes the LEDs of the list and the vehicle's lever, without simulated errors."""
    return with_config(scene, "tracker", survey=SurveyErrorsConfig(), map=None)


def with_map(scene: Scene, path: str | None) -> Scene:
    """The scene whose tracker uses the map file of a surveyed dome, if any, without random errors of a survey."""
    scene = with_config(
        scene, "tracker.survey", led_sigma_m=0.0, lever_sigma_m=0.0, focal_length_sigma_m=0.0
    )
    return with_config(
        scene,
        "tracker",
        assumed_focal_length_m=None,
        assumed_camera_body_m=None,
        map=path,
    )
