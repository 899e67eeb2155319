"""JHU/APL's dome of a hundred fibers (Boone et al. 2005, cited by Padro 2012, section 2.6): angular discrepancies.

A tracker that assumes a perfect sphere, seen from its center, has angular errors when the pupil is off the center and
the shell's radius varies. The discrepancy is the angle between a fiber's observed ray and its expected direction.
"""

from __future__ import annotations

from typing import Any
import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from skysim.camera.render import Poses, in_view, project
from skysim.core.constants import ARCSEC_RAD
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Sources
from skysim.experiments.tracker_comparison import with_config
from skysim.experiments.papers.compare import (FigureDrawing, ExperimentOptions, ExperimentResult, RowResult)
from skysim.experiments.papers.compare import bootstrap_interval
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import exact, extremum
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.lab import (Lab, build_lab)
from skysim.sources import dome
from skysim.sources.photometry import Band
from skysim.tracking import onboard_model



LARGE_OFFSET_M = 0.05
SMALL_OFFSET_M = 1e-3
OFFSETS_M = (1e-4, 1e-3, 1e-2, 5e-2, 1e-1)
CIRCLE_DEG = 10.0
MEAN_STARS = 5.0
MAX_TILT_DEG = 60.0  # greatest angle of the boresight from the zenith


def shell_scene(radius_variation: float, seed: int) -> Scene:
    """The scene with another random variation of the shell's radius; the fibers keep their directions."""
    variation = "light.layout.radius_variation"
    hardware_seed = "light.layout.points.hardware_seed"
    return loader.load(
        "apl_dome_ideal", {variation: str(radius_variation), hardware_seed: str(seed)}
    )


def fibers(scene: Scene, lab: Lab) -> tuple[Sources, Floats]:
    """The true fibers of a shell, and their (N, 3) positions on a perfect sphere."""
    assert isinstance(scene.light, DomeConfig)
    true = dome.sources(scene.light, Band.from_camera(scene.camera))
    perfect_light = with_config(scene.light, "layout", radius_variation=0.0)
    return true, dome.sources(perfect_light, lab.camera.band).place[:, :3]


def random_attitudes(count: int, rng: np.random.Generator) -> list[Rotation]:
    """Random lab_from_body: boresight (body z) uniform within MAX_TILT_DEG of the zenith, any roll."""
    tilt = np.arccos(rng.uniform(np.cos(np.radians(MAX_TILT_DEG)), 1, count))
    first, last = rng.uniform(0, 2 * np.pi, (2, count))
    return [Rotation.from_euler("ZYZ", angles) for angles in np.column_stack([first, tilt, last])]


def largest_discrepancies_arcsec(
    scene: Scene, lab: Lab, offset_m: float, corrected: bool, attitudes: list[Rotation]
) -> Floats:
    """(K,) largest angle between observed ray and expected direction of a fiber, for each attitude with one in view.

    The pupil is displaced across the boresight by offset_m. The tracker assumes a perfect sphere, and the pupil in its
    center unless `corrected`: then the offset is known.
    """
    true, perfect_m = fibers(scene, lab)
    camera = onboard_model.assumed_camera(scene)
    cam_from_body = lab.camera.mount.cam_from_body
    pupil_m = cam_from_body.inv().apply([offset_m, 0.0, 0.0])
    assumed_pupil_m = pupil_m if corrected else np.zeros(3)
    boresight = cam_from_body.inv().apply([0.0, 0.0, 1.0])
    level_rotation, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [boresight])
    largest = []
    for lab_from_body in (attitude * level_rotation for attitude in attitudes):
        cam_from_lab = cam_from_body * lab_from_body.inv()
        poses = Poses(cam_from_lab.as_matrix()[None], lab_from_body.apply(pupil_m)[None])
        visible = in_view(true, lab.camera.optics, poses)
        xy_px = project(true.take(visible), lab.camera.optics, poses)[0][0]
        on_detector = camera.contains(xy_px)
        assumed_m = cam_from_lab.apply(
            perfect_m[visible[on_detector]] - lab_from_body.apply(assumed_pupil_m)
        )
        expected_rays = assumed_m / np.linalg.norm(assumed_m, axis=1, keepdims=True)
        sine = np.linalg.norm(np.cross(camera.rays(xy_px[on_detector]), expected_rays), axis=1)
        if len(sine):
            largest.append(np.arcsin(sine.max()) / ARCSEC_RAD)
    return np.array(largest)


def count_fibers(lab: Lab, diameter_deg: float, boresights: Floats) -> Floats:
    """(K,) number of fibers in a circle of this diameter about each of the (K, 3) unit boresights from the center."""
    position_m = lab.camera.sources.place[:, :3]
    directions = position_m / np.linalg.norm(position_m, axis=1, keepdims=True)
    return np.asarray(
        (boresights @ directions.T > np.cos(np.radians(diameter_deg / 2))).sum(axis=1), float
    )


def random_boresights(count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) unit vectors uniform over the upper hemisphere."""
    z = rng.uniform(0, 1, count)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    return np.column_stack(
        [np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z]
    )


def discrepancies_and_counts(options: ExperimentOptions) -> ExperimentResult:
    """Discrepancies over shells and attitudes, and the number of fibers in a field."""
    rng = random_stream(options.seed, 2005)
    lab = build_lab(loader.load("apl_dome_ideal"))
    scenes = [
        shell_scene(0.004, int(seed)) for seed in rng.integers(2**31, size=options.trials(30, 5))
    ]
    attitudes = random_attitudes(options.trials(60, 20), rng)
    large_offset = np.concatenate(
        [
            largest_discrepancies_arcsec(scene, lab, LARGE_OFFSET_M, True, attitudes)
            for scene in scenes
        ]
    )
    small_offset = largest_discrepancies_arcsec(
        shell_scene(0.0, 1), lab, SMALL_OFFSET_M, False, attitudes
    )
    true, perfect_m = fibers(scenes[0], lab)
    radius_m, perfect_radius_m = (
        np.linalg.norm(place_m, axis=1) for place_m in (true.place[:, :3], perfect_m)
    )
    radius_change = radius_m / perfect_radius_m - 1
    boresights = random_boresights(options.trials(100_000, 20_000), rng)
    inner_boresights = boresights[boresights[:, 2] > np.sin(np.radians(20))]

    def excess_stars(diameter_deg: float) -> float:
        return count_fibers(lab, diameter_deg, inner_boresights).mean() - MEAN_STARS

    results = {
        "fibers": RowResult(exact(len(lab.camera.sources))),
        "variation": RowResult(extremum(100 * np.abs(radius_change), np.max)),
        "off_50mm": RowResult(extremum(large_offset, np.max)),
        "off_1mm": RowResult(extremum(small_offset, np.max)),
        "stars_10deg": RowResult(
            bootstrap_interval(count_fibers(lab, CIRCLE_DEG, boresights), np.mean)
        ),
        "field_5stars": RowResult(
            extremum(np.array([brentq(excess_stars, 5, 90, xtol=0.05)]), np.max)
        ),
    }
    # Worst discrepancies without and with the pupil's offset known.
    worst = [
        [
            largest_discrepancies_arcsec(scenes[0], lab, offset_m, known, attitudes).max()
            for known in (False, True)
        ]
        for offset_m in OFFSETS_M
    ]
    caption = "Largest angular discrepancy of a fiber against the camera's offset, with the offset unknown and known."
    return ExperimentResult(results, (FigureDrawing(caption, lambda fig: draw(fig, np.array(worst))),))


def draw(fig: Any, worst_arcsec: Floats) -> None:
    axes = fig.subplots()
    rows = experiments()["apl"].rows
    offset_mm = 1e3 * np.array(OFFSETS_M)
    for n, name in enumerate(("ours, place not told", "ours, place told: the shell is left")):
        axes.plot(offset_mm, worst_arcsec[:, n], color=INK[(0, 2)[n]], marker=MARKS[n], label=name)
    for key, position_mm in (("off_1mm", 1), ("off_50mm", 50)):
        published = rows[key].published
        label = f"stated: {published:g} arcsec at {position_mm} mm"
        axes.plot(position_mm, published, "*", color=INK[1], ms=11, label=label)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="pupil off the dome's center (mm)",
        ylabel="worst error (arcsec)",
    )
    axes.set_xticks(offset_mm, [f"{tick:g}" for tick in offset_mm])
    ticks = 10.0 ** np.arange(-1, 5)
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.legend()


