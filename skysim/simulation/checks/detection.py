"""Prediction of detections and centroids: the lights that the tracker detects, and the covariance of their positions.

1. `threshold_e` is the detection threshold of the scene's detector.
2. `detected_area_px` is the area of an image above the threshold.
3. `usable` selects the lights that are detected.
4. `centroid_variance` predicts the covariance of their centroids.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from estimator.trackers.pipeline import SATURATED_SIGMA_PX, Settings
from skysim.camera.detector import saturation_dn
from skysim.core.types import Floats
from skysim.scene.sections.camera import DetectorConfig
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.checks import beliefs
from skysim.simulation.checks.beliefs import Beliefs
from skysim.simulation.checks.views import CameraModel, View, peak_share
from skysim.simulation.lab import Lab
from skysim.sources.dome.surface import Surface, build_surface
from skysim.tracking.factory import assumed_settings

BINOMIAL_VARIANCE_PX2 = (
    0.5  # variance that the detectors' filter [1 2 1] / 4 adds to an image, along each axis
)
FILTERED_NOISE = 0.375  # factor of that filter on the noise of a pixel
COG_MARGIN_PX = (
    4.5  # margin of the window about the pixels above the threshold, half a pixel included
)
PHASES = 64  # number of phases of the pulses relative to the exposure
MAX_PULSES = (
    500  # number of pulses in an exposure from which the mean time of the light does not vary
)


class Context(NamedTuple):
    """The data that all checks share.

    Attributes
    ----------
    lab
        Laboratory
    settings, beliefs
        Settings and beliefs of the tracker
    camera
        Camera
    surface
        Surface of the dome; None under the stars
    known_id, known_row
        (N,) ascending numbers of the lights that the tracker knows, and their rows in its beliefs
    timing_s
        (N,) standard deviation of the mean time within an exposure of each light that the tracker knows
    """

    lab: Lab
    settings: Settings
    beliefs: Beliefs
    camera: CameraModel
    surface: Surface | None
    known_id: NDArray[np.int64]
    known_row: NDArray[np.int64]
    timing_s: Floats

    def rows_of(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """(M,) rows in the tracker's beliefs of lights with these numbers; -1 for lights that it does not know."""
        if not len(self.known_id):
            return np.full(len(ids), -1)
        at = np.minimum(np.searchsorted(self.known_id, ids), len(self.known_id) - 1)
        return np.where(self.known_id[at] == ids, self.known_row[at], -1)


def context_of(lab: Lab) -> Context:
    """The context of a lab. Raises InputError for a map or a catalog that cannot be read."""
    camera = CameraModel.of(lab)
    believed = beliefs.of(lab, camera)
    light = lab.scene.light
    lights = believed.lights
    surface = build_surface(light.surface) if isinstance(light, DomeConfig) else None
    timing_s = timing_sigma_s(lights.period_s, lights.on_s, lab.scene.exposure.time_s)
    row = np.argsort(lights.id, kind="stable")
    return Context(
        lab,
        assumed_settings(lab.scene),
        believed,
        camera,
        surface,
        lights.id[row],
        row,
        timing_s,
    )


def threshold_e(context: Context) -> float:
    """Detection threshold: electrons above the background of a pixel after the binomial filter."""
    settings = context.settings
    camera = context.camera
    if settings.detector == "thesis":
        detector = context.lab.scene.camera.detector
        threshold_dn = settings.intensity_threshold * saturation_dn(detector)
        return max(
            (threshold_dn - detector.offset_dn) * detector.gain_e_dn - camera.background_e,
            1.0,
        )
    return settings.threshold_sigma * FILTERED_NOISE * camera.noise_e


def full_scale_e(detector: DetectorConfig) -> float:
    """Electrons in a pixel at the saturation of converter or well."""
    return (saturation_dn(detector) - detector.offset_dn) * detector.gain_e_dn


def detected_area_px(view: View, context: Context) -> Floats:
    """(n,) area in px^2 of each image above the detection threshold.

        r = R + s sqrt(2 ln(peak / T)),    area = pi r^2 + 2 r L

    The image is a disk of radius R, blurred by a Gaussian of deviation s, on a path of length L. It is above the
    threshold T up to the radius r, which is exact for a Gaussian alone (R = 0).
    """
    blur2_px2 = view.blur2_px2 + BINOMIAL_VARIANCE_PX2
    share = peak_share(blur2_px2, view.disk_px, view.defocus_px, view.streak_length_px)
    ratio = np.maximum(view.electrons * share / threshold_e(context), 1e-9)
    large = np.maximum(view.disk_px, view.defocus_px)
    small = np.minimum(view.disk_px, view.defocus_px)
    radius = large + np.sqrt((blur2_px2 + small**2 / 4) * 2 * np.maximum(np.log(ratio), 0))
    return np.asarray(
        np.where(ratio > 1, np.pi * radius**2 + 2 * radius * view.streak_length_px, 0.0)
    )


def usable(view: View, context: Context) -> View:
    """The brightest lights, at most `tracker.brightest`, whose images are detected and entirely on the detector."""
    settings = context.settings
    config = context.lab.scene.camera
    # Distance of each image from the nearest edge, which must exceed its radius.
    far_px = np.array([config.width_px, config.height_px]) - 1 - view.xy_px
    edge = np.minimum(view.xy_px, far_px).min(axis=1)
    area = detected_area_px(view, context)
    found = np.flatnonzero((area >= settings.min_area_px) & (edge > np.sqrt(area / np.pi)))
    return view.take(
        found[np.argsort(-view.electrons[found], kind="stable")][: settings.max_blobs]
    )


def centroid_variance(view: View, context: Context, prnu: float | None = None) -> Floats:
    """(n, 2, 2) covariance of the centroids in px^2: the sum of

    1. photon noise, and background noise of b electrons^2 a pixel. For a center of gravity in a window of side W it is
       sigma^2 / N + b W^4 / (12 N^2) along each axis; for a fit it is the Cramer-Rao bound of a Gaussian (`fit_loss`).
       Along the path, sigma^2 is increased by L^2 / 12.
    2. pixel sensitivity that varies by p: p^2 sum(I^2 x^2) / N^2, which is p^2 / (8 pi) for a Gaussian and
       p^2 / (4 pi) for a disk.
    3. the plateau of a saturated image.
    4. the mean time of pulsed light, timing^2 v v' with the image's velocity v.

    Parameters
    ----------
    view
        The n lights
    context
        Data of the checks
    prnu
        Relative variation p of the pixels' sensitivity; None for that of the detector
    """
    # 1. Noise along and across the path.
    lab = context.lab
    camera = context.camera
    noise_e2 = camera.noise_e**2
    n_e = np.maximum(view.electrons, 1e-9)
    along2 = view.sigma_px**2 + view.streak_length_px**2 / 12
    if context.settings.centroider == "cog":
        side = 2 * (np.sqrt(detected_area_px(view, context) / np.pi) + COG_MARGIN_PX)
        floor = noise_e2 * side**4 / (12 * n_e**2)
        along = along2 / n_e + floor
        across = view.sigma_px**2 / n_e + floor
    else:
        loss = fit_loss(2 * np.pi * np.sqrt(along2) * view.sigma_px * noise_e2 / n_e)
        along = along2 / n_e * loss
        across = view.sigma_px**2 / n_e * loss
    # 2. Sensitivity of the pixels, between that of a Gaussian and that of a disk.
    disk = (view.disk_px**2 + view.defocus_px**2) / 4 / view.sigma_px**2
    varies = lab.scene.camera.detector.prnu if prnu is None else prnu
    pattern = varies**2 / (8 * np.pi) * (1 + disk)
    # 3. Saturation.
    plateau = SATURATED_SIGMA_PX**2 * (view.peak_e >= full_scale_e(lab.scene.camera.detector))
    unit = view.streak_px / np.maximum(view.streak_length_px, 1e-12)[:, None]
    along_path = unit[:, :, None] * unit[:, None, :]
    # 4. Timing.
    moved = (view.streak_px / lab.scene.exposure.time_s) * context.timing_s[view.row, None]
    return np.asarray(
        (across + pattern + plateau)[:, None, None] * np.eye(2)
        + (along - across)[:, None, None] * along_path
        + moved[:, :, None] * moved[:, None, :]
    )


def fit_loss(tau: Floats) -> Floats:
    """Factor by which background increases the least variance sigma^2 / N of a Gaussian's fitted position:

        1 / (1 + int_0^1 ln t / (1 + t / tau) dt),    tau = 2 pi sigma^2 b / N

    (Mortensen et al. 2010, Nature Methods 7, 377). The integral is tau Li2(-1 / tau). The factor is 1 without
    background and tends to 4 tau.
    """
    tau = np.maximum(tau, 1e-9)
    return np.asarray(1 / (1 + tau * special.spence(1 + 1 / tau)))


def timing_sigma_s(period_s: Floats, on_s: Floats, exposure_s: float) -> Floats:
    """(N,) standard deviation of the mean time of pulsed light within an exposure, over the phase of the pulses.

    The ends of the exposure cut the first and the last pulse, by an amount that depends on the phase.
    """
    # LEDs share few pairs of period and on-time.
    pairs, index = np.unique(np.column_stack([period_s, on_s]), axis=0, return_inverse=True)
    sigma = np.zeros(len(pairs))
    for k, (period, on) in enumerate(pairs):
        count = int(exposure_s / period) + 2
        if on >= period or count > MAX_PULSES:
            continue
        # (PHASES, count) beginnings of the pulses, one before the exposure included.
        phase_s = (np.arange(PHASES) + 0.5)[:, None] / PHASES * period
        begin = phase_s + (np.arange(count) - 1) * period
        first = np.clip(begin, 0, exposure_s)
        last = np.clip(begin + on, 0, exposure_s)
        lit = last - first
        total = lit.sum(axis=1)
        mean = (lit * (first + last) / 2).sum(axis=1)[total > 0] / total[total > 0]
        sigma[k] = np.std(mean) if len(mean) else 0.0
    return np.asarray(sigma[index.ravel()])
