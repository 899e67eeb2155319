"""Render one frame of a dataset with its labels: sources, detections, masks of saturation, particles and smear."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.camera.detector import PARTICLES, SMEAR, AddedCharge
from skysim.camera.render import Window
from skysim.core.types import Bools, Floats, Frame, Ints, SourceTruth, Truth
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.outcomes import SAME_LIGHT_PX
from skysim.experiments.study.execution.trials import TrialSetup
from skysim.scene.scene import Scene
from skysim.simulation.timing import exposure_window
from skysim.tracking.factory import assumed_settings
from skysim.tracking.onboard_model import assumed_camera

SATURATED = "saturated"
MASKS = (SATURATED, PARTICLES, SMEAR)
REACH_SIGMA = 3.0  # half-width of a source's rectangle, in standard deviations of its image across the streak
DISC_PX = 2.0  # sources of a larger radius are discs with edges
EDGE_PX = 3.0  # reach of the blur about the edge of a disc
STILL_PX = 1e-6  # length below which a streak has no direction
SOURCE = np.dtype(
    [
        ("id", "<i8"),
        *((name, "<f8") for name in ("x_px", "y_px", "flux_x_px", "flux_y_px")),
        *(
            (name, "<f4")
            for name in (
                "streak_x_px",
                "streak_y_px",
                "streak_px",
                "electrons",
                "peak_e",
                "snr",
                "sigma_px",
                "radius_px",
            )
        ),
        ("saturated", "?"),
        ("detected", "?"),
        *((name, "<f4") for name in ("detected_x_px", "detected_y_px")),
    ]
)


class Extents(NamedTuple):
    """The rectangle about each source's image, along its streak.

    Attributes
    ----------
    center_px
        (N, 2) centers
    along
        (N, 2) unit vectors of the streaks
    half_px
        (N, 2) half-length and half-width
    """

    center_px: Floats
    along: Floats
    half_px: Floats

    def of(self, which: Bools) -> Extents:
        """The rectangles of some sources."""
        return Extents(*(part[which] for part in self))


class LabelledFrame(NamedTuple):
    """A frame with its labels.

    Attributes
    ----------
    sources
        (N,) of dtype SOURCE, brightest first
    extents
        The rectangle about each image
    unmatched_px
        (M, 2) detections that are not a source: noise, particles, hot pixels
    masks
        Run lengths of `run_lengths` by name of MASKS, without masks that the scene cannot have
    """

    frame: Frame
    truth: Truth
    sources: NDArray
    extents: Extents
    unmatched_px: Floats
    masks: dict[str, list[int]]


class Labeller(NamedTuple):
    """Values that the labels of all frames of one scene need.

    Attributes
    ----------
    camera, settings
        Camera and settings that the scene's tracker assumes
    threshold_e
        Least charge from particles or smear in a pixel of their masks
    """

    camera: Camera
    settings: Settings
    threshold_e: float


def labeller(scene: Scene) -> Labeller:
    """The labeller of a scene. Build it once for all frames: building takes a tenth of the time of a frame."""
    config = scene.camera.detector
    threshold_e = max(math.hypot(config.read_noise_e, config.reset_noise_e), 1.0)
    return Labeller(assumed_camera(scene), assumed_settings(scene), threshold_e)


def label_frame(setup: TrialSetup, seed: int, by: Labeller | None = None) -> LabelledFrame:
    """Render the frame of a frame trial, and its labels. They depend only on the setup and the seed.

    Parameters
    ----------
    by
        Labeller of the setup's scene, if there is one already
    """
    scene = setup.lab.scene
    by = by or labeller(scene)
    added = AddedCharge(by.threshold_e)
    frame, truth, streak_px = trials.render_trial_frame(setup, seed, added)
    try:
        found = detect_and_centroid(
            frame.image_dn, by.camera, by.settings, Clock(), streak_px
        )
    except ImageError:  # a saturated frame
        found = Centroids.empty()
    sources, unmatched = source_rows(truth.sources, found.xy_px)
    # The radii of Sun, Moon and planets, without the lens's distortion.
    for body in truth.bodies:
        radius_rad = math.radians(body.diameter_arcsec / 7200)
        own = sources["id"] == body.id
        sources["radius_px"][own] = radius_rad * scene.camera.focal_px
    extents = image_extents(
        sources, exposure_window(scene, frame.index), scene.camera.height_px
    )
    least_dn = frame.saturation_dn
    if frame.image_dn.dtype.kind == "u":
        least_dn = math.ceil(least_dn)  # an integer compares faster
    runs = {SATURATED: run_lengths(frame.image_dn, least_dn)}
    runs |= {name: run_lengths(added.masks[name]) for name in MASKS if name in added.masks}
    return LabelledFrame(frame, truth, sources, extents, unmatched, runs)


def source_rows(truth: SourceTruth, found_px: Floats) -> tuple[NDArray, Floats]:
    """(N,) labels of the sources, brightest first, and the (M, 2) detections that belong to no source.

    A detection belongs to the brightest free source whose distance is at most SAME_LIGHT_PX plus half the length of
    its streak.
    """
    order = np.argsort(-truth.electrons, kind="stable")
    rows = np.zeros(len(order), SOURCE)
    for name in ("", "flux_", "streak_"):
        place = getattr(truth, f"{name}xy_px")[order]
        rows[f"{name}x_px"], rows[f"{name}y_px"] = place.T
    for name in ("id", "streak_px", "electrons", "peak_e", "snr", "saturated"):
        rows[name] = getattr(truth, name)[order]
    rows["sigma_px"] = across_sigma_px(truth.area_px, truth.streak_px)[order]
    rows["detected_x_px"] = rows["detected_y_px"] = np.nan
    chosen = brightest_near(
        found_px, truth.flux_xy_px[order], SAME_LIGHT_PX + truth.streak_px[order] / 2
    )
    own = chosen[chosen >= 0]
    rows["detected"][own] = True
    rows["detected_x_px"][own], rows["detected_y_px"][own] = found_px[chosen >= 0].T
    return rows, found_px[chosen < 0]


def brightest_near(found_px: Floats, source_px: Floats, reach_px: Floats) -> Ints:
    """(M,) number of the first free source within reach of each detection; -1 if there is none."""
    chosen = np.full(len(found_px), -1)
    is_free = np.ones(len(source_px), np.bool_)
    for m, place in enumerate(found_px):
        near = is_free & (np.sum((source_px - place) ** 2, axis=1) <= reach_px**2)
        if near.any():
            chosen[m] = np.argmax(near)
            is_free[chosen[m]] = False
    return chosen


def image_extents(rows: NDArray, window: Window, height_px: int) -> Extents:
    """The rectangle about each source's streak.

    On each side it is wider than the streak by REACH_SIGMA standard deviations of the blur, or by the radius of a disc
    and its blurred edge. A rolling shutter exposes the row of a disc's center at another time than the middle row, and
    shears the disc.
    """
    streak = np.nan_to_num(
        np.column_stack([rows["streak_x_px"], rows["streak_y_px"]]).astype(float)
    )
    length = np.linalg.norm(streak, axis=1)
    along = np.where(
        length[:, None] > STILL_PX, streak / np.maximum(length, STILL_PX)[:, None], [1.0, 0.0]
    )
    # For a source at the row y at mid-exposure: delay = row_time (y + v_y delay - middle row), in exposures.
    rolling = window.row_time_s / window.exposure_s
    rolling = rolling / np.maximum(1 - rolling * streak[:, 1], 0.1)
    radius = rows["radius_px"].astype(float)
    disc = radius > DISC_PX
    delay = rolling * (rows["y_px"] - (height_px - 1) / 2)
    middle = np.column_stack([rows["x_px"], rows["y_px"]]) + delay[:, None] * streak
    center = np.where(
        disc[:, None], middle, np.column_stack([rows["flux_x_px"], rows["flux_y_px"]])
    )
    reach = np.where(disc, radius + EDGE_PX, REACH_SIGMA * rows["sigma_px"])
    shear = np.where(disc, rolling * radius, 0.0) * length
    return Extents(center, along, np.column_stack([length / 2 + reach + shear, reach]))


def across_sigma_px(area_px: Floats, streak_px: Floats) -> Floats:
    """(N,) standard deviation across the streak of a Gaussian image with this noise-equivalent area.

    A Gaussian of sigma s at rest has 4 pi s^2; one along a path L much longer than s has 2 sqrt(pi) s L. The root of
    (4 pi s^2)^2 + (2 sqrt(pi) s L)^2 = area^2 has both limits, and an error of 6 % at most between them.
    """
    square = streak_px**2
    return np.sqrt((np.sqrt(square**2 + 4 * area_px**2) - square) / (8 * math.pi))


def run_lengths(mask: NDArray, least: float = True) -> list[int]:
    """Lengths of the runs of an (H, W) mask, column by column, beginning with pixels that are not set: COCO's code.

    Parameters
    ----------
    least
        Least value of a pixel that is set
    """
    rows = np.flatnonzero(mask.max(axis=1) >= least)  # most rows have no pixel that is set
    y, x = np.nonzero(mask[rows] >= least)
    # A copy of the transposed mask would take ten times longer.
    flat = np.sort(x * len(mask) + rows[y])
    if not len(flat):
        return [mask.size]
    breaks = np.flatnonzero(np.diff(flat) != 1)
    first = np.concatenate([flat[:1], flat[breaks + 1]])
    after = np.concatenate([flat[breaks], flat[-1:]]) + 1
    ends = np.column_stack([first, after]).ravel()
    lengths = np.diff(ends, prepend=0)
    rest = mask.size - int(ends[-1])
    return [*lengths.tolist(), *([rest] if rest else [])]
