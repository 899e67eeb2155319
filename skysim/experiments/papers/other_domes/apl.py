"""JHU/APL's dome of a hundred fibers (Boone et al. 2005, cited by Padro 2012, section 2.6): angular discrepancies.

A tracker that assumes a perfect sphere, seen from its center, has angular errors when the pupil is off the center and
the shell's radius varies. The discrepancy is the angle between a fiber's observed ray and its expected direction.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import Lever
from skysim.camera.render import Poses, in_view, project
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.core.units import ARCSEC_RAD
from skysim.experiments.papers.compare import Drawing, ExperimentOptions, ExperimentResult, RowResult
from skysim.experiments.papers.intervals import bootstrap_interval
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import exact, extremum
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.light import DomeConfig
from skysim.scene.scene import Scene
from skysim.simulation.testbed import Testbed, build_testbed
from skysim.sources import dome
from skysim.sources.photometry import Band
from skysim.tracking import onboard_model

LARGE_OFFSET_M, SMALL_OFFSET_M = 0.05, 1e-3
CIRCLE_DEG, MEAN_STARS = 10.0, 5.0
MAX_TILT_DEG = 60.0  # greatest angle of the boresight from the zenith


def shell_scene(radius_variation: float, seed: int) -> Scene:
    """The scene with another random variation of the shell's radius; the fibers keep their directions."""
    return loader.load(
        "apl_dome",
        {
            "light.layout.radius_variation": str(radius_variation),
            "light.layout.points.hardware_seed": str(seed),
        },
    )


class AplTestbed:
    """The true dome seen by the scene's camera, with its pupil displaced across the boresight by offset_m."""

    def __init__(self, scene: Scene, testbed: Testbed, offset_m: float) -> None:
        assert isinstance(scene.light, DomeConfig)
        self.true = dome.sources(scene.light, Band.from_efficiency(scene.camera.detector.quantum_efficiency))
        perfect_light = scene.light.model_copy(
            update={"layout": scene.light.layout.model_copy(update={"radius_variation": 0.0})}
        )
        self.perfect_m = dome.sources(perfect_light, testbed.band).place[:, :3]
        self.testbed, self.camera = testbed, onboard_model.assumed_camera(scene)
        self.offset_m = testbed.mount.cam_from_body.inv().apply([offset_m, 0.0, 0.0])

    def discrepancies_arcsec(self, lab_from_body: Rotation, lever: Lever) -> Floats:
        """(N,) angles between the observed rays of the fibers in view and the directions that the tracker expects.

        The tracker assumes a perfect sphere and the pupil at the lever arm of `lever`.
        """
        cam_from_lab = lever.cam_from_body * lab_from_body.inv()
        poses = Poses(cam_from_lab.as_matrix()[None], lab_from_body.apply(self.offset_m)[None])
        visible = in_view(self.true, self.testbed.optics, poses)
        xy_px = project(self.true.take(visible), self.testbed.optics, poses)[0][0]
        size_px = [self.camera.width_px, self.camera.height_px]
        on_detector = ((xy_px > -0.5) & (xy_px < np.array(size_px) - 0.5)).all(axis=1)
        rays = self.camera.rays(xy_px[on_detector])
        assumed_m = cam_from_lab.apply(self.perfect_m[visible[on_detector]] - lab_from_body.apply(lever.camera_body_m))
        expected_rays = assumed_m / np.linalg.norm(assumed_m, axis=1, keepdims=True)
        return np.asarray(np.arcsin(np.linalg.norm(np.cross(rays, expected_rays), axis=1)) / ARCSEC_RAD)


def random_attitudes(count: int, rng: np.random.Generator) -> list[Rotation]:
    """Random lab_from_body: boresight (body z) uniform within MAX_TILT_DEG of the zenith, any roll."""
    tilt = np.arccos(rng.uniform(np.cos(np.radians(MAX_TILT_DEG)), 1, count))
    first, last = rng.uniform(0, 2 * np.pi, (2, count))
    return [Rotation.from_euler("ZYZ", angles) for angles in np.column_stack([first, tilt, last])]


def largest_discrepancies_arcsec(
    scene: Scene, testbed: Testbed, offset_m: float, corrected: bool, attitudes: list[Rotation]
) -> Floats:
    """(K,) largest discrepancy of each attitude with a fiber in view. corrected : the pupil's offset is known."""
    apl_testbed = AplTestbed(scene, testbed, offset_m)
    lever = Lever(apl_testbed.offset_m if corrected else np.zeros(3), testbed.mount.cam_from_body)
    boresight = testbed.mount.cam_from_body.inv().apply([0.0, 0.0, 1.0])
    level_rotation, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [boresight])
    discrepancies = [apl_testbed.discrepancies_arcsec(attitude * level_rotation, lever) for attitude in attitudes]
    return np.array([arcsec.max() for arcsec in discrepancies if len(arcsec)])


def count_fibers(testbed: Testbed, diameter_deg: float, boresights: Floats) -> Floats:
    """(K,) number of fibers in a circle of this diameter about each of the (K, 3) unit boresights from the center."""
    position_m = testbed.sources.place[:, :3]
    directions = position_m / np.linalg.norm(position_m, axis=1, keepdims=True)
    return np.asarray((boresights @ directions.T > np.cos(np.radians(diameter_deg / 2))).sum(axis=1), float)


def random_boresights(count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) unit vectors uniform over the upper hemisphere."""
    z, azimuth = rng.uniform(0, 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z])


def discrepancies_and_counts(options: ExperimentOptions) -> ExperimentResult:
    """Discrepancies over shells and attitudes, and the number of fibers in a field."""
    rng = random_stream(options.seed, 2005)
    testbed = build_testbed(loader.load("apl_dome"))
    scenes = [shell_scene(0.004, int(seed)) for seed in rng.integers(2**31, size=options.trials(30, 5))]
    attitudes = random_attitudes(options.trials(60, 20), rng)
    large_offset = np.concatenate(
        [largest_discrepancies_arcsec(scene, testbed, LARGE_OFFSET_M, True, attitudes) for scene in scenes]
    )
    small_offset = largest_discrepancies_arcsec(shell_scene(0.0, 1), testbed, SMALL_OFFSET_M, False, attitudes)
    apl_testbed = AplTestbed(scenes[0], testbed, 0.0)
    radius_m, perfect_m = (
        np.linalg.norm(place, axis=1) for place in (apl_testbed.true.place[:, :3], apl_testbed.perfect_m)
    )
    radius_change = radius_m / perfect_m - 1
    boresights = random_boresights(options.trials(100_000, 20_000), rng)
    inner_boresights = boresights[boresights[:, 2] > np.sin(np.radians(20))]

    def excess_stars(diameter_deg: float) -> float:
        return count_fibers(testbed, diameter_deg, inner_boresights).mean() - MEAN_STARS

    results = {
        "fibers": RowResult(exact(len(testbed.sources))),
        "variation": RowResult(extremum(100 * np.abs(radius_change), np.max)),
        "off_50mm": RowResult(extremum(large_offset, np.max)),
        "off_1mm": RowResult(extremum(small_offset, np.max)),
        "stars_10deg": RowResult(bootstrap_interval(count_fibers(testbed, CIRCLE_DEG, boresights), np.mean)),
        "field_5stars": RowResult(extremum(np.array([brentq(excess_stars, 5, 90, xtol=0.05)]), np.max)),
    }
    worst = [worst_before_and_after(testbed, scenes[0], attitudes, offset_m) for offset_m in OFFSETS_M]
    caption = "Largest angular discrepancy of a fiber against the camera's offset, with the offset unknown and known."
    return ExperimentResult(results, (Drawing(caption, lambda fig: draw(fig, np.array(worst))),))


OFFSETS_M = (1e-4, 1e-3, 1e-2, 5e-2, 1e-1)


def worst_before_and_after(
    testbed: Testbed, scene: Scene, attitudes: list[Rotation], offset_m: float
) -> tuple[float, float]:
    """Worst discrepancies in arcsec: without and with the pupil's offset known."""
    before, after = (
        largest_discrepancies_arcsec(scene, testbed, offset_m, corrected, attitudes).max()
        for corrected in (False, True)
    )
    return float(before), float(after)


def draw(fig: Any, worst_arcsec: Floats) -> None:
    """Both discrepancies against the offset, with the stated numbers."""
    axes, rows = fig.subplots(), experiments()["apl"].rows
    offset_mm = 1e3 * np.array(OFFSETS_M)
    for n, name in enumerate(("ours, place not told", "ours, place told: the shell is left")):
        axes.plot(offset_mm, worst_arcsec[:, n], color=INK[(0, 2)[n]], marker=MARKS[n], label=name)
    for key, position_mm in (("off_1mm", 1), ("off_50mm", 50)):
        published = rows[key].published
        label = f"stated: {published:g} arcsec at {position_mm} mm"
        axes.plot(position_mm, published, "*", color=INK[1], ms=11, label=label)
    axes.set(xscale="log", yscale="log", xlabel="pupil off the dome's center (mm)", ylabel="worst error (arcsec)")
    axes.set_xticks(offset_mm, [f"{tick:g}" for tick in offset_mm])
    ticks = 10.0 ** np.arange(-1, 5)
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.legend()
