"""Expected error of a solution, from the Jacobians of the image positions, and its causes.

A solution is a rotation of the camera that is fitted to the image positions x_i of n lights by weighted least squares.
For a small rotation w of the lights in camera axes, dx_i = J_i w. An error e_i of the measured or predicted position
causes, to first order, the attitude error

    w = sum_i K_i e_i,      K_i = M^-1 J_i' C_i^-1,      M = sum_i J_i' C_i^-1 J_i,

with M the Fisher information of the rotation for the covariances C_i that the tracker believes (its weights).
Each cause is an e_i, so each has its own covariance of w:

    independent in each light, covariance S_i      sum_i K_i S_i K_i'         centroid noise, LED survey
    common to all lights, E_i p, p unit variance   B B',  B = sum_i K_i E_i   lever, surface, focal length, ...

A known error is one of the second kind with p = 1. With G_i the derivative of x_i by the light's position in camera
axes and R the rotation from lab to camera axes:

    centroid noise : S_i of `with_noise`
    LED survey     : S_i = sigma^2 G_i G_i'                  lever survey : E_i = -sigma G_i
    surface survey : E_i = sigma G_i R n_i, n_i the normal   focal length : E_i = relative error (x_i - center)
    common survey  : E_i = G_i dP_i + change by the lens, dP_i of LED i from the pupil; with it no lever, focal length
    hardware as built : E_i = image position minus that by the survey
    survey rotation r : E_i = G_i R (r x P_i)                distortion, star places : difference of the image positions
    rolling shutter : E_i = velocity times the row's delay from the middle row, minus the delay that the tracker assumes

The approximation of a solver (thesis, infinity, ...) has the error of its solution for exact rays. `pnp` also fits the
camera's position, so its J_i has three more columns. Errors of star places are those of the catalog and of neighbors
(beliefs.py). Neighbors of LEDs, jitter beside a uniform path and wrong identifications are left out.

`causes_at` computes the variances at one attitude:

1. The gain K_i of each light (`gains`).
2. The errors e_i of each cause (`CAUSES`).
3. Their covariances of w (`of_independent`, `of_common`). The variances about x and y add up to cross, that about z is
   roll.
"""

import math
from typing import NamedTuple

import numpy as np

from estimator.attitude.dome_map import (
    LedMap,
    Lever,
    common_images_px,
    common_shifts_m,
    led_sigma_rad,
    project,
)
from estimator.attitude.nearfield import SOLVERS
from estimator.identification.chance import GATE_SIGMA, MIN_EVIDENCE_MATCHES
from estimator.identification.star_search import WRONG_FOCAL
from estimator.trackers.dome_tracker import FITS_FOCAL, FOCAL_UNCERTAINTY
from skysim.camera.optics import Optics
from skysim.camera.projection import lateral_color
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, lengths, normalized
from skysim.scene.unused import differs
from skysim.simulation.checks.detection import Context, misshapen_px, with_noise
from skysim.simulation.checks.views import View
from skysim.simulation.lights.effects import AirEffects
from skysim.simulation.lights.light import find_light
from skysim.sources.dome import survey_errors


class Expected(NamedTuple):
    """Variances (A,) of the angles `cross` and `roll` at A attitudes in rad^2, by cause; NaN with too few lights.

    They are NaN also where most streaks break: those that are left are not fitted as well as expected.
    """

    rad2: dict[str, dict[str, Floats]]

    def total(self, angle: str) -> Floats:
        """(A,) variance of the angle `cross` or `roll` by all causes together; NaN with too few lights."""
        return np.asarray(sum(self.rad2[angle].values()))

    def rms_arcsec(self) -> tuple[float, float]:
        """Root mean square of cross and roll over the attitudes in arcsec; NaN without any solution."""
        return mean_root(self.total("cross")), mean_root(self.total("roll"))


def mean_root(variance_rad2: Floats) -> float:
    """Root of the mean of the finite variances in arcsec; NaN if there is none."""
    finite = variance_rad2[np.isfinite(variance_rad2)]
    return float(np.sqrt(finite.mean()) / ARCSEC_RAD) if len(finite) else math.nan


AS_BUILT = "hardware as built"
AS_BUILT_KEYS = (
    "thermal",
    "vehicle.sag_arcsec",
    "vehicle.runout",
    "light.led.die",
    "camera.pupil_walk",
    "camera.detector.edge_px",
)

# Causes of the attitude error. Each returns None if the scene does not have it, else the displacements (n, 2, k) of the
# image positions in px by k errors of unit variance that all lights share. Errors of surveyed LEDs are independent:
# they are covariances (n, 2, 2) in px^2.


def led_survey(view: View, context: Context) -> Floats | None:
    """Errors of the surveyed LED positions, S_i = sigma^2 G_i G_i', or G_i C_i G_i' if an instrument gives C_i."""
    dome = context.beliefs.dome
    if dome and dome[1].covariance_m2 is not None:
        # Derivative of the image by a position in lab axes.
        gradient_lab = view.gradient @ view.lab_from_cam.inv().as_matrix()
        own_m2 = dome[1].covariance_m2[view.row]
        return gradient_lab @ own_m2 @ np.swapaxes(gradient_lab, 1, 2)
    sigma_m = context.beliefs.led_sigma_m
    if not sigma_m:
        return None
    return sigma_m**2 * view.gradient @ np.swapaxes(view.gradient, 1, 2)


def pixel_response(view: View, context: Context) -> Floats | None:
    """Errors of centroids by the response within pixels, at random places in them.

    The response 1 + p cos 2 pi x moves the center of gravity of the pixels of a Gaussian of deviation s, to first order
    in p, by p exp(-2 pi^2 s^2) (1 / 4 pi - 2 pi s^2) sin 2 pi x; along a path of length L this is, with sinc L =
    sin(pi L) / pi L, multiplied by sinc L, and (sinc L - cos pi L) / 2 pi is subtracted within its last bracket. A fit
    errs by between half of it and all.
    """
    depth = context.scene.camera.detector.intrapixel
    if not depth:
        return None
    # Without the pixel's own variance.
    s2 = np.maximum(view.sigma_px**2 - 1 / 12, 0)
    path = np.sinc(view.streak_px)
    moved = (1 / (4 * np.pi) - 2 * np.pi * s2)[:, None] * path
    moved -= (path - np.cos(np.pi * view.streak_px)) / (2 * np.pi)
    moved_px = depth * np.exp(-2 * np.pi**2 * s2)[:, None] * moved
    return (moved_px**2 / 2)[:, :, None] * np.eye(2)


def survey_setup(view: View, context: Context) -> Floats | None:
    """Errors of the set-up of the survey's instrument, common to all LEDs."""
    instrument = context.scene.tracker.survey.instrument
    if instrument is None:
        return None
    shifts_m = survey_errors.station_displacements_m(
        instrument, context.beliefs.lights.xyz[view.row]
    )
    parts = [displacement(view, shift_m) for shift_m in shifts_m]
    return np.concatenate(parts, axis=2) if parts else None


def common_survey(view: View, context: Context) -> Floats | None:
    """Errors that LEDs, lever and lens of a survey by the camera share: E_i = G_i dP_i + the change by the lens."""
    dome = context.beliefs.dome
    if dome is None or not context.beliefs.has_common_camera:
        return None
    camera, leds, lever = dome
    shift_m = common_shifts_m(leds, view.row, lever, view.lab_from_cam.inv())
    moved_px = np.einsum("nij,mnj->nim", view.gradient, shift_m)
    by_lens_px = common_images_px(leds, camera, view.offset_m) - camera.pixels(view.offset_m)
    return moved_px + np.moveaxis(by_lens_px, 0, 2)


def other_map(view: View, context: Context) -> Floats | None:
    """Images by the map minus the true ones, if the map was made of other hardware than the scene's."""
    dome = context.beliefs.dome
    if dome is None or not context.beliefs.faults:
        return None
    camera, leds, lever = dome
    body_from_lab = (view.lab_from_cam * lever.cam_from_body).inv()
    mapped_px = project(body_from_lab, leds.position_m[view.row], lever, camera)
    return np.nan_to_num(mapped_px - view.xy_px)[:, :, None]


def lever_survey(view: View, context: Context) -> Floats | None:
    """Error of the surveyed lever (camera's position), E_i = -sigma G_i."""
    sigma_m = context.beliefs.lever_sigma_m
    if not sigma_m or context.beliefs.has_common_camera:
        return None
    return -sigma_m * view.gradient


def surface_survey(view: View, context: Context) -> Floats | None:
    """Error of the surveyed surface along its normal, E_i = sigma G_i R n_i."""
    sigma_m = context.beliefs.surface_sigma_m
    surface = context.surface
    if not sigma_m or surface is None:
        return None
    normal = surface.inward(context.beliefs.lights.xyz[view.row])
    return displacement(view, -sigma_m * normal)


def survey_rotation(view: View, context: Context) -> Floats | None:
    """Rotation r of the survey's axes, E_i = G_i R (r x P_i)."""
    rotation_rad = context.beliefs.rotation_rad
    if not rotation_rad.any():
        return None
    shift_m = np.cross(rotation_rad, context.beliefs.lights.xyz[view.row])
    return displacement(view, shift_m)


def assumed_lever(view: View, context: Context) -> Floats | None:
    """Error of the lever that the scene makes the tracker assume, E_i = -G_i error."""
    error_m = context.beliefs.lever_error_m
    if not error_m.any() or context.surface is None:
        return None
    error_cam_m = context.camera.mount.cam_from_body.apply(error_m)
    return -(view.gradient @ error_cam_m)[:, :, None]


def focal_length(view: View, context: Context) -> Floats | None:
    """Relative error of the focal length, E_i = error (x_i - center)."""
    error = math.hypot(context.beliefs.focal_error, context.beliefs.focal_sigma)
    if not error or context.beliefs.has_common_camera:
        return None
    return error * from_center_px(view, context)


def from_center_px(view: View, context: Context) -> Floats:
    """(n, 2, 1) image positions relative to the principal point: their derivative by the relative focal length."""
    return (view.xy_px - np.array(context.camera.optics.camera.center_px))[:, :, None]


def distortion(view: View, context: Context) -> Floats | None:
    """Difference of the image positions with the believed and the true distortion."""
    believed = context.beliefs.camera
    if believed.distortion == context.camera.optics.camera.distortion:
        return None
    shift_px = Optics.from_camera(believed).project(view.offset_m) - view.xy_px
    return np.nan_to_num(shift_px)[:, :, None]


def star_places(view: View, context: Context) -> Floats | None:
    """Errors of the stars' believed directions, from the catalog and from neighbors."""
    error = context.beliefs.direction_error[view.row]
    return displacement(view, error) if error.any() else None


def dispersion(view: View, context: Context) -> Floats | None:
    """Refraction of the stars in their own colors minus that at the wavelength of `light.air`."""
    if find_light(context.lab.camera.lights, AirEffects) is None:
        return None
    own, common = (through_air(view, context, own_color) for own_color in (True, False))
    return displacement(view, (own - common)[:, :3])


def through_air(view: View, context: Context, own_color: bool) -> Floats:
    """(n, 4) places of the lights as the air shows them, in their own colors or at the wavelength of `light.air`."""
    lights = context.beliefs.lights.take(view.row)
    place = lights.place.copy()
    effects = find_light(context.lab.camera.lights, AirEffects)
    if effects is not None:
        air = effects.air
        scale = air.dispersion[air.rows(lights.id)] if own_color else 1.0
        zenith = air.at(view.time).zenith
        place[:, :3] = air.refraction.apparent(place[:, :3], zenith, scale)
    return place


def rolling_shutter(view: View, context: Context) -> Floats | None:
    """Motion of the images during the difference of true and assumed delay of their rows from the middle row."""
    camera = context.camera.optics.camera
    true_s = camera.row_delay_s
    assumed_s = context.scene.tracker.assumed_row_time_s
    if not true_s or assumed_s is None or assumed_s == true_s:
        return None
    delay_s = (true_s - assumed_s) * (view.xy_px[:, 1] - (camera.height_px - 1) / 2)
    velocity_px_s = view.streak_px / context.scene.exposure.time_s
    return (velocity_px_s * delay_s[:, None])[:, :, None]


def as_built(view: View, context: Context) -> Floats | None:
    """Images minus those of the surveyed hardware: temperature, sag, run-out, dies, pupil of the lens, chip's edge."""
    scene = context.scene
    if not any(differs(scene, key) for key in AS_BUILT_KEYS):
        return None
    mount = context.camera.mount
    place = through_air(view, context, own_color=True)
    surveyed_m = mount.toward(place, view.lab_from_cam * mount.cam_from_body)
    surveyed_px = context.camera.optics.project(surveyed_m)
    chromatic = context.beliefs.lights.chromatic
    if chromatic is not None:
        surveyed_px = lateral_color(scene.camera, surveyed_px, chromatic[view.row])
    return (view.xy_px - surveyed_px)[:, :, None]


def displacement(view: View, shift_lab: Floats) -> Floats:
    """The displacement of the images by shifts (n, 3) of the lights in lab axes, E_i = G_i R shift_i."""
    shift_cam = view.lab_from_cam.inv().apply(shift_lab)
    return np.einsum("nij,nj->ni", view.gradient, shift_cam)[:, :, None]


CAUSES = {
    "common survey": common_survey,
    "survey set-up": survey_setup,
    "lever survey": lever_survey,
    "surface survey": surface_survey,
    "survey rotation": survey_rotation,
    "assumed lever": assumed_lever,
    "focal length": focal_length,
    "distortion": distortion,
    "star places": star_places,
    "dispersion": dispersion,
    "coma and charge": misshapen_px,
    "rolling shutter": rolling_shutter,
    "other map": other_map,
    AS_BUILT: as_built,
}
UNKNOWN_TO_TRACKER = (
    "focal length",
    "distortion",
    "assumed lever",
    "rolling shutter",
    "other map",
    AS_BUILT,
)
# A survey draws these once. The tracker's covariance contains them, its matching radius does not.
OUTSIDE_OF_GATE = ("survey set-up", "common survey", "surface survey")
CENTROIDS = "centroid noise"
# Causes of errors that are independent in each light, beside the noise of the centroids.
INDEPENDENT = {
    "LED survey": led_survey,
    "response within pixels": pixel_response,
}
SOLVER = "solver"
EXACT_SOLVERS = ("rotation_only", "pnp")  # solvers without an approximation


# Propagation to the attitude.


def gains(view: View, covariance_px2: Floats, fitted: Floats | None = None) -> Floats:
    """(n, 3, 2) gains K_i = M^-1 J_i' C_i^-1: rotation vector by a unit error of each image position.

    Parameters
    ----------
    view
        The n lights
    covariance_px2
        (n, 2, 2) covariances C_i
    fitted
        (n, 2, k) derivatives of the image positions by k parameters that are fitted with the rotation

    Raises
    ------
    LinAlgError
        If the lights do not determine the rotation.
    """
    jacobian = view.jacobian
    if fitted is not None:
        jacobian = np.concatenate([jacobian, fitted], axis=2)
    weighted = np.linalg.solve(covariance_px2, jacobian)
    # Scale the columns, because a rotation in rad and a shift in meters have different sizes.
    size = np.sqrt(np.einsum("nij,nij->j", jacobian, jacobian))
    information = np.einsum("nij,nik->jk", weighted, jacobian) / np.outer(size, size)
    if np.linalg.cond(information) > 1e14:
        raise np.linalg.LinAlgError("singular")
    inverse = np.linalg.inv(information) / np.outer(size, size)
    return (inverse @ np.swapaxes(weighted, 1, 2))[:, :3]


def of_independent(gain: Floats, covariance_px2: Floats) -> Floats:
    """(3, 3) covariance of the rotation in camera axes in rad^2 by errors of single lights: sum K_i S_i K_i'."""
    return np.einsum("nij,njk,nlk->il", gain, covariance_px2, gain)


def of_common(gain: Floats, displacement_px: Floats) -> Floats:
    """(3, 3) covariance of the rotation in camera axes in rad^2 by errors of all lights: B B', B = sum K_i E_i."""
    response = np.einsum("nij,njk->ik", gain, displacement_px)
    return response @ response.T


def believed_px2(view: View, context: Context, floor_px: float | None) -> Floats:
    """(n, 2, 2) covariance of each image position that the tracker believes: centroid, floor and LED survey.

    Only the fit of streaks tells the star tracker the directions of its errors.

    Parameters
    ----------
    view, context
        The n lights, and the data of the checks
    floor_px
        Least centroid error; None if it is estimated from each frame, as nothing else disturbs the centroids
    """
    settings = context.settings
    beliefs = context.beliefs
    noise_px2 = view.noise_px2
    if context.surface is not None or settings.centroider not in ("default", "streak"):
        variance = np.trace(noise_px2, axis1=1, axis2=2) / 2
        noise_px2 = variance[:, None, None] * np.eye(2)
    survey_px = np.zeros(len(view))
    if beliefs.dome:
        camera, leds, lever = beliefs.dome
        survey_px = camera.focal_px * led_sigma_rad(leds, lever)[view.row]
    added_px2 = (floor_px or 0.0) ** 2 + survey_px**2
    return noise_px2 + added_px2[:, None, None] * np.eye(2)


def believed_sigma_px(view: View, context: Context) -> Floats:
    """(n,) standard deviation of each image position in the tracker's gates: `believed_px2` with the search's floor."""
    believed = believed_px2(view, context, context.settings.searched_sigma_px)
    return np.sqrt(np.trace(believed, axis1=1, axis2=2) / 2)


def within_gate(view: View, context: Context) -> View:
    """The lights whose errors of the believed directions, but their median, are within the tracker's matching radius.

    The others are no matches, for example a star that a neighbor displaces. A rotation removes what all share.
    """
    error = context.beliefs.direction_error[view.row]
    if not error.any():
        return view
    off_px = lengths(error - np.median(error, axis=0))
    off_px *= context.camera.optics.camera.focal_px
    sigma_px = believed_sigma_px(with_noise(view, context), context)
    return view.take(off_px <= GATE_SIGMA * sigma_px)


class Mismatch(NamedTuple):
    """Distances of images from their expected positions, after the best rotation.

    Attributes
    ----------
    residual_px
        (n,) distances by all errors together, with 1 sigma of the errors that are drawn once
    gate_px
        (n,) matching radius of the tracker
    by_cause
        Rms distance by each cause
    """

    residual_px: Floats
    gate_px: Floats
    by_cause: dict[str, float]


def fits_focal_length(context: Context) -> bool:
    """Whether the tracker fits the focal length with the attitude, as some identifiers do under a dome."""
    return context.surface is not None and context.settings.identifier in FITS_FOCAL


def finds_focal_length(context: Context) -> bool:
    """Whether the tracker finds the right focal length: by a fit, or by the default identifier under the stars."""
    scene = context.scene
    if fits_focal_length(context):
        return abs(context.beliefs.focal_error) < FOCAL_UNCERTAINTY
    if not scene.stars:
        return False
    by_default = scene.tracker.identifier in (None, "default")
    return by_default and abs(context.beliefs.focal_error) < WRONG_FOCAL


def mismatch(view: View, context: Context) -> Mismatch | None:
    """The mismatch by errors that the tracker's matching radius leaves out; None if there is none, or too few lights.

    1. Displacements by each of these causes. A known error displaces every image by its vector; an error that is drawn
       once displaces it by 1 sigma of each of its parts.
    2. The best rotation removes a part of each: shift_i - J_i sum_k K_k shift_k is left.
    3. Known errors add up as vectors, the others in quadrature.
    """
    if len(view) < MIN_EVIDENCE_MATCHES:
        return None
    # 1. Displacements.
    shifts = {}
    for name in (*UNKNOWN_TO_TRACKER, *OUTSIDE_OF_GATE):
        shift_px = CAUSES[name](view, context)
        if shift_px is not None:
            shifts[name] = shift_px
    if context.beliefs.focal_sigma or finds_focal_length(context):
        shifts.pop("focal length", None)  # the tracker corrects it
    if not shifts:
        return None
    sigma_px = believed_sigma_px(view, context)
    floor_px = context.settings.centroid_sigma_px
    try:
        gain = gains(view, believed_px2(view, context, floor_px))
    except np.linalg.LinAlgError:
        return None
    known = np.zeros((len(view), 2, 1))
    drawn = []
    rms = {}
    for name, shift in shifts.items():
        # 2. Residuals of the best rotation.
        left = shift - view.jacobian @ np.einsum("nij,njk->ik", gain, shift)
        rms[name] = float(np.sqrt((left**2).sum(axis=(1, 2)).mean()))
        # 3. Known errors; those that are drawn once are joined below.
        if name in UNKNOWN_TO_TRACKER:
            known = known + left
        else:
            drawn.append(left)
    residual_px = np.linalg.norm(np.concatenate([known, *drawn], axis=2), axis=(1, 2))
    return Mismatch(residual_px, GATE_SIGMA * sigma_px, rms)


def solver_error(view: View, context: Context) -> Floats | None:
    """(3,) error of the dome's solver for exact rays, a rotation vector in camera axes; None for an exact solver."""
    mount = context.camera.mount
    name = context.settings.solver
    surface = context.surface
    if surface is None or name in EXACT_SOLVERS:
        return None
    place_m = context.beliefs.lights.xyz[view.row]
    center_m, semi_axes_m = surface.as_ellipsoid()
    leds = LedMap(view.row, place_m, center_m, semi_axes_m, None, 0.0)
    cam_from_body = mount.cam_from_body
    lever = Lever(mount.camera_body_m, cam_from_body, 0.0)
    rays = normalized(view.offset_m)
    body_from_lab = cam_from_body.inv() * view.lab_from_cam.inv()
    try:
        solved, _ = SOLVERS[name](
            rays, np.full(len(rays), 1e-5), place_m, leds, lever, body_from_lab
        )
    except (ValueError, np.linalg.LinAlgError):
        return None
    error = cam_from_body * solved * body_from_lab.inv() * cam_from_body.inv()
    return error.as_rotvec()


def expected(views: list[View], context: Context) -> Expected:
    """The expected errors at some attitudes, from the views of the lights that the tracker uses there."""
    names = (CENTROIDS, *INDEPENDENT, *CAUSES, SOLVER)
    found = [causes_at(view, context) for view in views]
    by_cause = {
        name: np.array([one.get(name, np.zeros(3)) for one in found]).T for name in names
    }
    cross = {name: rad2[0] + rad2[1] for name, rad2 in by_cause.items()}
    return Expected({"cross": cross, "roll": {name: by_cause[name][2] for name in names}})


def causes_at(view: View, context: Context) -> dict[str, Floats]:
    """(3,) variances about the camera's axes at one attitude in rad^2, by cause; NaN with too few lights."""
    floor_px = context.settings.centroid_sigma_px
    # 1. Gains, with the parameters that the tracker fits as well.
    fitted = None
    if fits_focal_length(context):
        fitted = from_center_px(view, context)
    elif context.surface is not None and context.settings.solver == "pnp":
        fitted = view.gradient
    try:
        if len(view) < MIN_EVIDENCE_MATCHES:
            raise np.linalg.LinAlgError("too few lights")
        gain = gains(view, believed_px2(view, context, floor_px), fitted)
    except np.linalg.LinAlgError:
        return {CENTROIDS: np.full(3, np.nan)}
    # 2. and 3. Covariances by each cause, and the solver's own error squared.
    variances = {CENTROIDS: np.diag(of_independent(gain, view.noise_px2))}
    for table, propagated in ((INDEPENDENT, of_independent), (CAUSES, of_common)):
        for name, cause in table.items():
            error_px = cause(view, context)
            if error_px is not None:
                variances[name] = np.diag(propagated(gain, error_px))
    bias = solver_error(view, context)
    return variances if bias is None else variances | {SOLVER: bias**2}
