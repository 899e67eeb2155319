"""SHEFEX-2's camera as rendered: field of view, smear length, peak loss by smear, defocus, calibrated focal length."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.star_field import self_calibrated
from estimator.core.camera import Camera
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from estimator.trackers.star_tracker import StarTracker
from skysim.camera.detector.detector import saturation_dn
from skysim.camera.render import Window, render
from skysim.core.types import Floats, Trajectory
from skysim.experiments.papers.compare import Answer, Ask, number
from skysim.experiments.papers.intervals import resampled
from skysim.experiments.papers.shefex.setup import apparent, lab, stars
from skysim.experiments.study import trials
from skysim.experiments.study.plan import FrameTrial
from skysim.experiments.study.setups import Setup
from skysim.results.metrics import Summary, exact
from skysim.scene.loader import load
from skysim.simulation import testbed
from skysim.simulation.testbed import Testbed
from skysim.tracking import onboard_model

SHEET_MM, FOUND_MM = 25.0, 24.95
DEFOCUS_M = 1e-4
EXPOSURE_S = 0.05


def answers(ask: Ask) -> dict[str, Answer]:
    """Answers that need no night-sky frames."""
    horizontal, vertical, diagonal = field_deg(onboard_model.calibration(lab().scene.camera))
    out = {
        "field_h": Answer(exact(horizontal)),
        "field_v": Answer(exact(vertical)),
        "diagonal": Answer(
            exact(diagonal), f"hypotenuse of both fields {np.hypot(horizontal, vertical):.3f}"
        ),
        "diagonal_true": Answer(exact(diagonal)),
        "absorbed": Answer(exact(light(ground(), 0.05).sum() / light(lab(), 0.035).sum())),
        "blur": Answer(exact(blur_px())),
        "focal": Answer(*focal_mm(ask)),
    }
    for rate in (2, 4):
        out[f"smear_{rate}"] = Answer(exact(smear_px(rate)))
        out[f"loss_{rate}"] = peak_loss(rate, ask.trials(60, 5), ask.seed)
    return out


def field_deg(camera: Camera) -> tuple[float, float, float]:
    """Horizontal, vertical and diagonal field of view in degrees, between the detector's outer edges and corners."""
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    x, y = camera.centre_px
    ends = [[(-0.5, y), (right, y)], [(x, -0.5), (x, bottom)], [(-0.5, -0.5), (right, bottom)]]
    rays = [camera.rays(np.array(pair)) for pair in ends]
    return tuple(float(np.degrees(np.arccos(a @ b))) for a, b in rays)  # type: ignore[return-value]


@cache
def ground() -> Testbed:
    """The camera below an atmosphere that absorbs 30 %."""
    through = 0.7 * lab().scene.camera.transmission
    return testbed.build_testbed(load("shefex2", {"camera.transmission": str(through)}))


def light(
    where: Testbed, exposure_s: float, rate_deg_s: float = 0.0, place_rad: tuple[float, float] = (0.0, 0.0),
    towards_rad: float = 0.0,
) -> Floats:  # fmt: skip
    """(H, W) noise-free electrons of the catalog's brightest star alone, with the camera rotating across the boresight.

    place_rad : offset of the star from the boresight, right and down, at mid-exposure
    towards_rad : direction of the rotation axis, from camera x towards y
    """
    brightest = where.sources.take(np.array([np.argmax(where.sources.strength)]))
    towards_star = brightest.place[0, :3]
    roll = Rotation.align_vectors([[0.0, 0.0, 1.0]], [towards_star])[0]
    cam_from_lab = Rotation.from_rotvec([-place_rad[1], place_rad[0], 0.0]) * roll
    # A rate about an axis in the image plane moves the star along a straight line.
    rate_cam = np.radians(rate_deg_s) * np.array([np.cos(towards_rad), np.sin(towards_rad), 0.0])
    lab_from_body = cam_from_lab.inv() * where.mount.cam_from_body
    rate_body = where.mount.cam_from_body.inv().apply(rate_cam)
    t_s = np.linspace(-0.01, exposure_s + 0.01, trials.KNOTS)
    path = lab_from_body * Rotation.from_rotvec(np.outer(t_s - exposure_s / 2, rate_body))
    image = np.zeros(where.canvas.shape)
    flown = Trajectory(t_s, path, np.tile(rate_body, (len(t_s), 1)))
    render(image, brightest, where.optics, flown, where.mount, Window(0.0, exposure_s))
    return image


def variance_px2(image: Floats) -> Floats:
    """(2,) largest and smallest variance of an image about its centroid (eigenvalues of its second moments)."""
    y, x = np.indices(image.shape)
    total = image.sum()
    off = np.stack([x - (image * x).sum() / total, y - (image * y).sum() / total])
    spread = np.einsum("iyx,jyx,yx->ij", off, off, image) / total
    return np.linalg.eigvalsh(spread)[::-1]


def smear_px(rate_deg_s: float) -> float:
    """Length L of a streak in pixels: smear along a line adds L^2 / 12 to the variance of the star at rest."""
    moved, still = (variance_px2(light(lab(), EXPOSURE_S, rate))[0] for rate in (rate_deg_s, 0.0))
    return float(np.sqrt(12 * (moved - still)))


def peak_loss(rate_deg_s: float, count: int, seed: int) -> Answer:
    """Loss of the brightest pixel by smear in magnitudes, for a star centered on a pixel and moving along a row.

    The note gives the mean over random positions in the pixel and random directions.
    """
    rng, pixel_rad = np.random.default_rng([seed, 4]), 1 / lab().optics.camera.focal_px
    places = [((0.0, 0.0), np.pi / 2)]
    places += [
        (tuple(rng.uniform(-0.5, 0.5, 2) * pixel_rad), rng.uniform(0, 2 * np.pi)) for _ in range(count)
    ]
    loss_mag = []
    for place, towards in places:
        still, moved = (light(lab(), EXPOSURE_S, rate, place, towards).max() for rate in (0.0, rate_deg_s))
        loss_mag.append(2.5 * np.log10(still / moved))
    told = number(resampled(np.array(loss_mag[1:]), np.mean))
    return Answer(exact(loss_mag[0]), f"anywhere in a pixel and along any direction: {told}")


def blur_px() -> float:
    """Diameter D in pixels of a star's blur disc, 0.1 mm out of focus: a uniform disc adds D^2 / 16 per axis."""
    scene = load("shefex2", out_of_focus(DEFOCUS_M))
    disc, sharp = (
        variance_px2(light(one, EXPOSURE_S)).mean() for one in (testbed.build_testbed(scene), lab())
    )
    return float(4 * np.sqrt(disc - sharp))


def out_of_focus(defocus_m: float) -> dict[str, str]:
    """Overrides that put the detector defocus_m behind the focus of stars: the lens is focused at a finite distance.

    By the thin-lens equation, 1 / distance = 1 / f - 1 / (f + defocus).
    """
    focal_m = lab().scene.camera.focal_length_m
    return {"camera.focus": f"{1 / (1 / focal_m - 1 / (focal_m + defocus_m)):.9g} m"}


def focal_mm(ask: Ask) -> tuple[Summary, str]:
    """Focal length in mm by our star-field calibration, of a 24.95 mm lens with a nominal 25 mm; with a note."""
    told = {"camera.focal_length": f"{FOUND_MM} mm", "exposure.time": "50 ms", "exposure.first": "10 ms"}
    where = testbed.build_testbed(load("shefex2", told | {"exposure.frames": "1"}))
    ready = Setup(where, testbed.tracker(where), FrameTrial(kind="frames"), "")
    sheet = onboard_model.calibration(lab().scene.camera)
    detector = where.scene.camera.detector
    settings = Settings(gain_e_dn=detector.gain_e_dn, saturation=saturation_dn(detector))
    first = 1_000_000 * ask.seed
    frames = [
        detect_and_centroid(trials.shot(ready, first + n)[0].image_dn, sheet, settings, Clock())
        for n in range(ask.trials(40, 8))
    ]

    def tracker(camera: Camera, uncertainty: float) -> StarTracker:
        return StarTracker(camera, stars(), apparent(stars()), settings, uncertainty)

    found = self_calibrated(frames, tracker, sheet, 0.01, EXPOSURE_S)
    mm = 1e3 * where.scene.camera.pixel_m
    value, half = found.camera.focal_px * mm, 1.96 * mm * float(np.sqrt(found.covariance[0, 0]))
    return Summary(
        value, value - half, value + half, len(frames)
    ), f"from {len(frames)} frames, 25 mm believed at first"
