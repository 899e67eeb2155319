"""SHEFEX-2's camera as rendered: field of view, smear length, peak loss by smear, defocus, calibrated focal length."""

from __future__ import annotations

from functools import cache
import numpy as np
from scipy.spatial.transform import Rotation
from estimator.calibration.star_field import self_calibrate
from estimator.core.camera import Camera
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from estimator.trackers.star_tracker import StarTracker
from skysim.camera.detector import saturation_dn
from skysim.camera.render import Window, render
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Trajectory
from skysim.experiments.papers.compare import (ExperimentOptions, RowResult, format_summary)
from skysim.experiments.papers.compare import (bootstrap_interval, symmetric_interval)
from skysim.experiments.papers.shefex.shefex_setup import (apparent, shefex_lab, stars)
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.setups import Setup
from skysim.experiments.study.plan import FrameTrial
from skysim.results.metrics import Summary, exact
from skysim.scene.loader import load
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.tracking import onboard_model



NOMINAL_FOCAL_MM = 25.0
TRUE_FOCAL_MM = 24.95
DEFOCUS_M = 1e-4
EXPOSURE_S = 0.05


def optics_results(options: ExperimentOptions) -> dict[str, RowResult]:
    """Answers that need no night-sky frames."""
    horizontal, vertical, diagonal = field_deg(onboard_model.calibration(shefex_lab().scene.camera))
    absorbed = star_image(ground_lab(), 0.05).sum() / star_image(shefex_lab(), 0.035).sum()
    results = {
        "field_h": RowResult(exact(horizontal)),
        "field_v": RowResult(exact(vertical)),
        "diagonal": RowResult(
            exact(diagonal), f"hypotenuse of both fields {np.hypot(horizontal, vertical):.3f}"
        ),
        "diagonal_true": RowResult(exact(diagonal)),
        "absorbed": RowResult(exact(absorbed)),
        "blur": RowResult(exact(blur_px())),
        "focal": RowResult(*calibrated_focal_mm(options)),
    }
    for rate in (2, 4):
        results[f"smear_{rate}"] = RowResult(exact(smear_px(rate)))
        results[f"loss_{rate}"] = peak_loss(rate, options.trials(60, 5), options.seed)
    return results


def field_deg(camera: Camera) -> tuple[float, float, float]:
    """Horizontal, vertical and diagonal field of view in degrees, between the detector's outer edges and corners."""
    right = camera.width_px - 0.5
    bottom = camera.height_px - 0.5
    x, y = camera.center_px
    edges = [[(-0.5, y), (right, y)], [(x, -0.5), (x, bottom)], [(-0.5, -0.5), (right, bottom)]]
    rays = [camera.rays(np.array(pair)) for pair in edges]
    return tuple(float(np.degrees(np.arccos(a @ b))) for a, b in rays)  # type: ignore[return-value]


@cache
def ground_lab() -> Lab:
    """The camera below an atmosphere that absorbs 30 %."""
    transmission = 0.7 * shefex_lab().scene.camera.gray_transmission
    return build_lab(load("shefex2", {"camera.transmission": str(transmission)}))


def star_image(
    lab: Lab, exposure_s: float, rate_deg_s: float = 0.0, place_rad: tuple[float, float] = (0.0, 0.0),
    axis_rad: float = 0.0,
) -> Floats:  # fmt: skip
    """(H, W) noise-free electrons of the catalog's brightest star alone, with the camera rotating across the boresight.

    place_rad : offset of the star from the boresight, right and down, at mid-exposure
    axis_rad : direction of the rotation axis, from camera x towards y
    """
    brightest = lab.camera.sources.take(np.array([np.argmax(lab.camera.sources.strength)]))
    star_direction = brightest.place[0, :3]
    roll = Rotation.align_vectors([[0.0, 0.0, 1.0]], [star_direction])[0]
    cam_from_lab = Rotation.from_rotvec([-place_rad[1], place_rad[0], 0.0]) * roll
    # A rate about an axis in the image plane moves the star along a straight line.
    rate_cam = np.radians(rate_deg_s) * np.array([np.cos(axis_rad), np.sin(axis_rad), 0.0])
    lab_from_body = cam_from_lab.inv() * lab.camera.mount.cam_from_body
    rate_body = lab.camera.mount.cam_from_body.inv().apply(rate_cam)
    t_s = np.linspace(-0.01, exposure_s + 0.01, trials.KNOTS)
    path = lab_from_body * Rotation.from_rotvec(np.outer(t_s - exposure_s / 2, rate_body))
    image = np.zeros(lab.camera.canvas.shape)
    trajectory = Trajectory(t_s, path, np.tile(rate_body, (len(t_s), 1)))
    render(
        image, brightest, lab.camera.optics, trajectory, lab.camera.mount, Window(0.0, exposure_s)
    )
    return image


def variance_px2(image: Floats) -> Floats:
    """(2,) largest and smallest variance of an image about its centroid (eigenvalues of its second moments)."""
    y, x = np.indices(image.shape)
    total = image.sum()
    offset_px = np.stack([x - (image * x).sum() / total, y - (image * y).sum() / total])
    covariance = np.einsum("iyx,jyx,yx->ij", offset_px, offset_px, image) / total
    return np.linalg.eigvalsh(covariance)[::-1]


def smear_px(rate_deg_s: float) -> float:
    """Length L of a streak in pixels: smear along a line adds L^2 / 12 to the variance of the star at rest."""
    moving, at_rest = (
        variance_px2(star_image(shefex_lab(), EXPOSURE_S, rate))[0] for rate in (rate_deg_s, 0.0)
    )
    return float(np.sqrt(12 * (moving - at_rest)))


def peak_loss(rate_deg_s: float, count: int, seed: int) -> RowResult:
    """Loss of the brightest pixel by smear in magnitudes, for a star centered on a pixel and moving along a row.

    The note gives the mean over random positions in the pixel and random directions.
    """
    rng = random_stream(seed, 4)
    pixel_rad = 1 / shefex_lab().camera.optics.camera.focal_px
    places = [((0.0, 0.0), np.pi / 2)]
    places += [
        (tuple(rng.uniform(-0.5, 0.5, 2) * pixel_rad), rng.uniform(0, 2 * np.pi))
        for _ in range(count)
    ]
    loss_mag = []
    for place, axis_rad in places:
        peaks = [
            star_image(shefex_lab(), EXPOSURE_S, rate, place, axis_rad).max()
            for rate in (0.0, rate_deg_s)
        ]
        loss_mag.append(2.5 * np.log10(peaks[0] / peaks[1]))
    mean_note = format_summary(bootstrap_interval(np.array(loss_mag[1:]), np.mean))
    return RowResult(
        exact(loss_mag[0]), f"mean over positions in the pixel and directions: {mean_note}"
    )


def blur_px() -> float:
    """Diameter D in pixels of a star's blur disk, 0.1 mm out of focus: a uniform disk adds D^2 / 16 per axis."""
    labs = build_lab(load("shefex2", out_of_focus(DEFOCUS_M))), shefex_lab()
    defocused, sharp = (variance_px2(star_image(one, EXPOSURE_S)).mean() for one in labs)
    return float(4 * np.sqrt(defocused - sharp))


def out_of_focus(defocus_m: float) -> dict[str, str]:
    """Overrides that put the detector defocus_m behind the focus of stars: the lens is focused at a finite distance.

    By the thin-lens equation, 1 / distance = 1 / f - 1 / (f + defocus).
    """
    focal_m = shefex_lab().scene.camera.focal_length_m
    return {"camera.focus": f"{1 / (1 / focal_m - 1 / (focal_m + defocus_m)):.9g} m"}


def calibrated_focal_mm(options: ExperimentOptions) -> tuple[Summary, str]:
    """Focal length in mm by our star-field calibration, of a 24.95 mm lens with a nominal 25 mm; with a note."""
    overrides = {"camera.focal_length": f"{TRUE_FOCAL_MM} mm", "exposure.time": "50 ms"}
    lab = build_lab(
        load("shefex2", overrides | {"exposure.first": "10 ms", "exposure.frames": "1"})
    )
    setup = Setup(lab, build_tracker(lab.camera), FrameTrial(kind="frames"), "")
    nominal_camera = onboard_model.calibration(shefex_lab().scene.camera)
    detector = lab.scene.camera.detector
    settings = Settings(gain_e_dn=detector.gain_e_dn, saturation=saturation_dn(detector))
    first_seed = 1_000_000 * options.seed
    rendered = (
        trials.render_trial_frame(setup, first_seed + n)[0] for n in range(options.trials(40, 8))
    )
    frames = [
        detect_and_centroid(frame.image_dn, nominal_camera, settings, Clock()) for frame in rendered
    ]

    def tracker(camera: Camera, uncertainty: float) -> StarTracker:
        return StarTracker(camera, stars(), apparent(stars()), settings, uncertainty)

    calibrated = self_calibrate(frames, tracker, nominal_camera, 0.01, EXPOSURE_S)
    mm_per_px = 1e3 * lab.scene.camera.pixel_m
    value = calibrated.camera.focal_px * mm_per_px
    half_width = 1.96 * mm_per_px * float(np.sqrt(calibrated.covariance[0, 0]))
    note = f"from {len(frames)} frames, starting from {NOMINAL_FOCAL_MM:g} mm"
    return symmetric_interval(value, half_width, len(frames)), note


