"""The tracker's beliefs about lights and hardware, and their differences from the truth.

The measured direction of a star differs from the believed one because of the catalog's errors and of neighbors within
the star's image, which displace its centroid (`response_px`).
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog import catalog
from estimator.core.camera import Camera
from skysim.core.types import Floats, Ints, Sources, frozen, lengths, median, normalized
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.checks.views import CameraModel
from skysim.simulation.lab import Lab
from skysim.tracking import dome_map_file
from skysim.tracking.dome_map_file import DomeMap
from skysim.tracking.factory import assumed_settings
from skysim.tracking.onboard_model import (
    assumed_camera,
    assumed_orbit,
    assumed_stars,
    calibration,
    onboard_dome,
    rows_of,
)

REACH_PX = 7.0  # greatest distance of a neighbor that displaces a centroid
FAULT_SIGMAS = 5.0  # difference of a map from its scene that its survey cannot explain
WINDOW_PX = 3  # half side of the fit's window


@frozen
class Beliefs:
    """The beliefs of a tracker. Standard deviations are over surveys, of which a run draws one.

    Attributes
    ----------
    lights
        The N sources that it knows
    direction_error
        (N, 3) measured minus believed direction of each star in lab axes, from the catalog's errors and from
        neighbors; zeros for LEDs
    camera
        Camera with the believed distortion
    faintest_mag
        Magnitude of the faintest star that it knows; infinite under a dome
    epoch_jyear
        Epoch of its star catalog; NaN under a dome
    dome
        Camera, map and lever of the tracker, with the LEDs in the order of `lights`; None under other lights
    led_sigma_m, lever_sigma_m
        Standard deviations of the surveyed places along each axis (rms of the LEDs if an instrument measured them)
    focal_sigma
        Relative standard deviation of the focal length
    rotation_rad
        (3,) rotation vector of the survey's axes, in lab axes
    lever_error_m
        (3,) believed minus true position of the camera, in body axes
    surface_sigma_m
        Standard deviation of the surveyed surface along its normal, common to all LEDs
    focal_error
        Relative error of the focal length
    faults
        Differences of `tracker.map` from the scene beyond what its survey can explain, in words
    """

    lights: Sources
    direction_error: Floats
    camera: CameraConfig
    faintest_mag: float
    epoch_jyear: float
    dome: tuple[Camera, LedMap, Lever] | None
    led_sigma_m: float
    lever_sigma_m: float
    focal_sigma: float
    rotation_rad: Floats
    lever_error_m: Floats
    surface_sigma_m: float = 0.0
    focal_error: float = 0.0
    faults: tuple[str, ...] = ()

    @property
    def has_common_camera(self) -> bool:
        """Whether the errors of lever and lens are part of the map's common errors."""
        return self.dome is not None and self.dome[1].common_camera is not None


def of(lab: Lab, camera: CameraModel) -> Beliefs:
    """The beliefs of a lab's tracker. Raises InputError for a map or a catalog that cannot be read."""
    # 1. Lights and camera.
    scene = lab.scene
    tracker = scene.tracker
    believed = assumed_camera(scene)
    dome = None
    if scene.dome:
        dome = onboard_dome(scene, scene.dome, lab.camera.mount, lab.camera.sources)
    lights, direction_error, faintest_mag, epoch_jyear = known_lights(lab, camera, dome)
    config = scene.camera.with_values(distortion=believed.distortion)
    focal_error = believed.focal_px / scene.camera.focal_px - 1
    assumed_m = tracker.assumed_camera_body_m
    lever_error_m = np.zeros(3)
    if assumed_m is not None:
        lever_error_m = np.array(assumed_m) - lab.camera.mount.camera_body_m
    # 2. A self-calibrated map has its own uncertainties, and its axes and lever are right on average, unless it was
    # made of other hardware.
    known = (lights, direction_error, config, faintest_mag, epoch_jyear, dome)
    if tracker.map:
        mapped = dome_map_file.read_dome_map(Path(tracker.map))
        return Beliefs(
            *known,
            median(mapped.sigma_m),
            mapped.lever_sigma_m,
            mapped.focal_sigma_px / mapped.focal_px,
            np.zeros(3),
            np.zeros(3),
            faults=map_faults(mapped, lab, lights.xyz),
        )
    # 3. Else those of the survey. An instrument gives each LED its own covariance.
    survey = tracker.survey
    surface_m = scene.dome.surface.error_m if scene.dome else 0.0
    led_sigma_m = survey.led_sigma_m
    own_m2 = dome[1].covariance_m2 if dome else None
    if own_m2 is not None:
        led_sigma_m = float(np.sqrt(np.trace(own_m2, axis1=1, axis2=2).mean() / 3))
    return Beliefs(
        *known,
        led_sigma_m,
        survey.lever_sigma_m,
        survey.focal_length_sigma_m / scene.camera.focal_length_m,
        np.radians(survey.rotation_deg),
        lever_error_m,
        surface_m,
        0.0 if survey.focal_length_sigma_m else focal_error,
    )


def map_faults(mapped: DomeMap, lab: Lab, place_m: Floats) -> tuple[str, ...]:
    """Where a map differs from the scene by more than FAULT_SIGMAS of its own standard deviations, in words.

    A parameter that the survey held fixed has no deviation: any difference counts. LEDs are at place_m (N, 3).
    """
    true = calibration(lab.scene.camera)
    limit = FAULT_SIGMAS * math.sqrt(3)  # from one axis to the length of a vector
    led_m = lengths(mapped.position_m - place_m)
    moved = led_m > limit * mapped.sigma_m
    lever_m = math.dist(mapped.camera_body_m, lab.camera.mount.camera_body_m)
    zoom = mapped.focal_px / true.focal_px - 1
    lens = [*mapped.center_px, *mapped.distortion]
    lens_sigma = np.array([*mapped.center_sigma_px, *mapped.distortion_sigma])
    others = np.abs(lens - true.lens[1:]) > FAULT_SIGMAS * lens_sigma + 1e-9
    found = {
        f"{moved.sum()} of {len(moved)} LEDs are up to {1e3 * led_m.max():.3g} mm from the scene's": moved.any(),
        f"its lever is {1e3 * lever_m:.3g} mm from the scene's": lever_m
        > limit * mapped.lever_sigma_m,
        f"its focal length differs by {100 * zoom:+.2g} %": abs(zoom) * mapped.focal_px
        > FAULT_SIGMAS * mapped.focal_sigma_px + 1e-6,
        "its principal point is not the scene's": others[:2].any(),
        "its distortion is not the scene's": others[2:].any(),
    }
    return tuple(text for text, differs in found.items() if differs)


def known_lights(
    lab: Lab, camera: CameraModel, dome: tuple[Camera, LedMap, Lever] | None
) -> tuple[Sources, Floats, float, float]:
    """The N sources that the tracker knows, their direction errors (N, 3), the faintest magnitude, the epoch.

    Raises InputError for a catalog that cannot be read.
    """
    if dome:
        sources = lab.camera.sources
        sources = sources.take(rows_of(dome[1].id, sources.id))
        return sources, np.zeros((len(sources), 3)), math.inf, math.nan
    # Stars at their believed directions, with unresolved doubles merged.
    scene = lab.scene
    stars, directions = assumed_stars(scene, assumed_orbit(scene))
    merge_rad = assumed_settings(scene).merge_px / scene.camera.focal_px
    stars = catalog.merge_doubles(replace(stars, vectors=directions), merge_rad)
    sources = lab.camera.sources
    row = np.flatnonzero(np.isin(sources.id, stars.id))
    star = rows_of(sources.id[row], stars.id)
    place = normalized(sources.xyz)
    rate_e_s = sources.strength * lab.camera.optics.collecting_m2
    shift = neighbor_shift(place, rate_e_s, row, camera)
    error = place[row] + shift - stars.vectors[star]
    faintest_mag = float(stars.v_mag.max(initial=-math.inf))
    return sources.take(row), error, faintest_mag, stars.epoch_yr


def neighbor_shift(place: Floats, rate_e_s: Floats, row: Ints, camera: CameraModel) -> Floats:
    """(N, 3) displacement of the directions of some stars by the images of their neighbors.

    Parameters
    ----------
    place
        (M, 3) unit vectors of all sources
    rate_e_s
        (M,) photo-electrons per second
    row
        (N,) rows of the stars among the sources
    camera
        Camera
    """
    # 1. Pairs of a star and another source within reach.
    focal_px = camera.optics.camera.focal_px
    reach = cKDTree(place[row]).sparse_distance_matrix(
        cKDTree(place), REACH_PX / focal_px, output_type="ndarray"
    )
    pairs = reach[row[reach["i"]] != reach["j"]]
    first = row[pairs["i"]]
    second = pairs["j"]
    apart = place[second] - place[first]
    apart_px = focal_px * lengths(apart)
    electrons = rate_e_s * camera.exposure_s
    # 2. The displacements by all neighbors of a star add up.
    moved_px = response_px(apart_px, electrons[first], electrons[second], camera)
    shift = np.zeros((len(row), 3))
    np.add.at(shift, pairs["i"], (moved_px / np.maximum(apart_px, 1e-9))[:, None] * apart)
    return shift


def response_px(
    apart_px: Floats, star_e: Floats, neighbor_e: Floats, camera: CameraModel
) -> Floats:
    """(P,) displacement of a star's fitted position toward a neighbor, for P pairs.

    A weighted fit of a Gaussian image g, of deviation s and N electrons, over a background of b electrons^2 a pixel
    responds to f electrons at the distance d with a displacement along d of, to first order,

        r = sum(w g' f g(x - d)) / sum(w (N + f exp(-d^2 / 4 s^2)) g'^2),      w = 1 / (b + N g).

    For d far below s this is f d / (N + f), the center of light.

    Parameters
    ----------
    apart_px
        (P,) distances d
    star_e, neighbor_e
        (P,) electrons N and f
    camera
        Camera with the image's deviation and the background
    """
    side = np.arange(-WINDOW_PX, WINDOW_PX + 1)
    x = np.repeat(side, len(side))
    y = np.tile(side, len(side))
    s2 = camera.lens_px**2

    def image(offset_px: Floats) -> Floats:
        """(P, window) share of a Gaussian's light in each pixel, with its center displaced along x."""
        return np.exp(-((x - offset_px) ** 2 + y**2) / (2 * s2)) / (2 * math.pi * s2)

    own = image(np.zeros(1))
    other = image(apart_px[:, None])
    slope = own * x / s2
    weight = 1 / (camera.noise_e**2 + star_e[:, None] * own)
    total_e = star_e + neighbor_e * np.exp(-(apart_px**2) / (4 * s2))
    pull = neighbor_e * (weight * slope * other).sum(axis=1)
    stiffness = total_e * (weight * slope**2).sum(axis=1)
    return pull / stiffness


def describe(beliefs: Beliefs, scene: Scene) -> list[str]:
    """The beliefs in words: one line for each that is uncertain or wrong, or one that says that all are exact."""
    lines = []
    if not math.isnan(beliefs.epoch_jyear):
        error_arcsec = np.degrees(lengths(beliefs.direction_error)) * 3600
        differ = (
            f"; its stars are {np.median(error_arcsec):.2g}″ (median) from the sky's"
            if len(error_arcsec)
            else ""
        )
        catalog = Path(scene.tracker.catalog).name.removesuffix(".ecsv")
        lines.append(
            f"{len(beliefs.lights)} stars to V {beliefs.faintest_mag:.2f} of {catalog}, epoch"
            f" J{beliefs.epoch_jyear:.2f} moved to {scene.start_time:%Y-%m-%d}{differ}"
        )
    source = (
        f"tracker.map {Path(scene.tracker.map).name}"
        if scene.tracker.map
        else "tracker.survey"
    )
    sigmas = {
        "LEDs": beliefs.led_sigma_m,
        "the lever": beliefs.lever_sigma_m,
        "the surface": beliefs.surface_sigma_m,
    }
    known = [
        f"{what} to {1e3 * sigma_m:.3g} mm" for what, sigma_m in sigmas.items() if sigma_m
    ]
    if known:
        lines.append(f"{', '.join(known)} about each axis ({source})")
    if instrument := scene.tracker.survey.instrument:
        lines.append(
            f"LEDs measured by a {instrument.kind.replace('_', ' ')} (tracker.survey.instrument)"
        )
    elif not known and scene.dome:
        lines.append("every LED and the lever exactly (tracker.survey)")
    lines += [f"{fault} ({source})" for fault in beliefs.faults]
    if beliefs.rotation_rad.any():
        lines.append(
            f"the survey's axes rotated by {np.degrees(np.linalg.norm(beliefs.rotation_rad)) * 3600:.3g}″"
        )
    if beliefs.lever_error_m.any() and scene.dome:
        lines.append(
            f"the lever wrong by {1e3 * np.linalg.norm(beliefs.lever_error_m):.3g} mm (assumed_camera_body)"
        )
    if beliefs.focal_error:
        lines.append(
            f"the focal length wrong by {100 * beliefs.focal_error:+.3g} % (assumed_focal_length)"
        )
    if beliefs.focal_sigma:
        lines.append(f"the focal length to {100 * beliefs.focal_sigma:.2g} % ({source})")
    if beliefs.camera.distortion != scene.camera.distortion:
        lines.append("another distortion than the lens's (assumed_distortion)")
    elif not beliefs.focal_error and not beliefs.focal_sigma:
        lines.append("focal length and distortion exactly")
    return lines
