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
from skysim.camera.render import Poses, in_view, look
from skysim.core.types import Floats
from skysim.core.units import ARCSEC_RAD
from skysim.experiments.papers.compare import Answer, Ask, Drawing, Found
from skysim.experiments.papers.intervals import resampled
from skysim.experiments.papers.published import experiments
from skysim.results.metrics import exact, extreme
from skysim.results.plots import INK, MARKS
from skysim.scene import loader
from skysim.scene.light import DomeConfig
from skysim.scene.scene import Scene
from skysim.simulation import testbed
from skysim.simulation.testbed import Testbed
from skysim.sources import dome
from skysim.sources.photometry import Band
from skysim.tracking import onboard_model

SHELL_OFF_M, SMALL_OFF_M = 0.05, 1e-3
CIRCLE_DEG, WANTED_STARS = 10.0, 5.0
LEAN_DEG = 60.0  # greatest angle of the boresight from the zenith


def shell(radius_variation: float, seed: int) -> Scene:
    """The scene with another random variation of the shell's radius; the fibers keep their directions."""
    return loader.load(
        "apl_dome",
        {
            "light.layout.radius_variation": str(radius_variation),
            "light.layout.points.hardware_seed": str(seed),
        },
    )


class AplTestbed:
    """The true dome seen by the scene's camera, with its pupil displaced across the boresight by off_m."""

    def __init__(self, told: Scene, lab: Testbed, off_m: float) -> None:
        assert isinstance(told.light, DomeConfig)
        self.true = dome.sources(told.light, Band.of(told.camera.detector.quantum_efficiency))
        perfect = told.light.model_copy(
            update={"layout": told.light.layout.model_copy(update={"radius_variation": 0.0})}
        )
        self.perfect_m = dome.sources(perfect, lab.band).place[:, :3]
        self.lab, self.camera = lab, onboard_model.believed_camera(told)
        self.off_m = lab.mount.cam_from_body.inv().apply([off_m, 0.0, 0.0])

    def discrepancies_arcsec(self, lab_from_body: Rotation, lever: Lever) -> Floats:
        """(N,) angles between the observed rays of the fibers in view and the directions that the tracker expects.

        The tracker assumes a perfect sphere and the pupil at the lever arm of `lever`.
        """
        cam_from_lab = lever.cam_from_body * lab_from_body.inv()
        here = Poses(cam_from_lab.as_matrix()[None], lab_from_body.apply(self.off_m)[None])
        near = in_view(self.true, self.lab.optics, here)
        xy_px = look(self.true.take(near), self.lab.optics, here)[0][0]
        size_px = [self.camera.width_px, self.camera.height_px]
        on_chip = ((xy_px > -0.5) & (xy_px < np.array(size_px) - 0.5)).all(axis=1)
        rays = self.camera.rays(xy_px[on_chip])
        believed_m = cam_from_lab.apply(
            self.perfect_m[near[on_chip]] - lab_from_body.apply(lever.camera_body_m)
        )
        believed = believed_m / np.linalg.norm(believed_m, axis=1, keepdims=True)
        return np.asarray(np.arcsin(np.linalg.norm(np.cross(rays, believed), axis=1)) / ARCSEC_RAD)


def attitudes(count: int, rng: np.random.Generator) -> list[Rotation]:
    """Random lab_from_body of a body with boresight z: boresight uniform within LEAN_DEG of the zenith, any roll."""
    lean = np.arccos(rng.uniform(np.cos(np.radians(LEAN_DEG)), 1, count))
    first, last = rng.uniform(0, 2 * np.pi, (2, count))
    return [Rotation.from_euler("ZYZ", one) for one in np.column_stack([first, lean, last])]


def worst_arcsec(told: Scene, lab: Testbed, off_m: float, corrected: bool, poses: list[Rotation]) -> Floats:
    """(K,) largest discrepancy of each attitude with a fiber in view. corrected : the pupil's offset is known."""
    bed = AplTestbed(told, lab, off_m)
    lever = Lever(bed.off_m if corrected else np.zeros(3), lab.mount.cam_from_body)
    boresight = lab.mount.cam_from_body.inv().apply([0.0, 0.0, 1.0])
    level, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [boresight])
    found = [bed.discrepancies_arcsec(pose * level, lever) for pose in poses]
    return np.array([one.max() for one in found if len(one)])


def counts(lab: Testbed, diameter_deg: float, boresights: Floats) -> Floats:
    """(K,) number of fibers in a circle of this diameter about each of the (K, 3) unit boresights from the center."""
    place = lab.sources.place[:, :3]
    towards = place / np.linalg.norm(place, axis=1, keepdims=True)
    return np.asarray((boresights @ towards.T > np.cos(np.radians(diameter_deg / 2))).sum(axis=1), float)


def anywhere(count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) unit vectors uniform over the upper hemisphere."""
    z, azimuth = rng.uniform(0, 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z])


def fibres(ask: Ask) -> Found:
    """Discrepancies over shells and attitudes, and the number of fibers in a field."""
    rng = np.random.default_rng([ask.seed, 2005])
    lab = testbed.build_testbed(loader.load("apl_dome"))
    shells = [shell(0.004, int(seed)) for seed in rng.integers(2**31, size=ask.trials(30, 5))]
    poses = attitudes(ask.trials(60, 20), rng)
    varied = np.concatenate([worst_arcsec(one, lab, SHELL_OFF_M, True, poses) for one in shells])
    moved = worst_arcsec(shell(0.0, 1), lab, SMALL_OFF_M, False, poses)
    bed = AplTestbed(shells[0], lab, 0.0)
    stretched = np.linalg.norm(bed.true.place[:, :3], axis=1) / np.linalg.norm(bed.perfect_m, axis=1) - 1
    boresights = anywhere(ask.trials(100_000, 20_000), rng)
    inner = boresights[boresights[:, 2] > np.sin(np.radians(20))]

    def mean_less(diameter_deg: float) -> float:
        return counts(lab, diameter_deg, inner).mean() - WANTED_STARS

    answers = {
        "fibres": Answer(exact(len(lab.sources))),
        "variation": Answer(extreme(100 * np.abs(stretched), np.max)),
        "off_50mm": Answer(extreme(varied, np.max)),
        "off_1mm": Answer(extreme(moved, np.max)),
        "stars_10deg": Answer(resampled(counts(lab, CIRCLE_DEG, boresights), np.mean)),
        "field_5stars": Answer(extreme(np.array([brentq(mean_less, 5, 90, xtol=0.05)]), np.max)),
    }
    offs = [told_off(lab, shells[0], poses, off_m) for off_m in OFFS_M]
    caption = (
        "Worst angular discrepancy of a fibre by the camera's offset, before its place is told and after."
    )
    return Found(answers, (Drawing(caption, lambda fig: draw(fig, np.array(offs))),))


OFFS_M = (1e-4, 1e-3, 1e-2, 5e-2, 1e-1)


def told_off(lab: Testbed, told: Scene, poses: list[Rotation], off_m: float) -> tuple[float, float]:
    """Worst discrepancies in arcsec: without and with the pupil's offset known."""
    before, after = (worst_arcsec(told, lab, off_m, corrected, poses).max() for corrected in (False, True))
    return float(before), float(after)


def draw(fig: Any, offs: Floats) -> None:
    """Both discrepancies against the offset, with the stated numbers."""
    axes, rows = fig.subplots(), experiments()["apl"].rows
    off_mm = 1e3 * np.array(OFFS_M)
    for n, name in enumerate(("ours, place not told", "ours, place told: the shell is left")):
        axes.plot(off_mm, offs[:, n], color=INK[(0, 2)[n]], marker=MARKS[n], label=name)
    for key, place_mm in (("off_1mm", 1), ("off_50mm", 50)):
        told = rows[key].published
        axes.plot(place_mm, told, "*", color=INK[1], ms=11, label=f"stated: {told:g} arcsec at {place_mm} mm")
    axes.set(
        xscale="log", yscale="log", xlabel="pupil off the dome's centre (mm)", ylabel="worst error (arcsec)"
    )
    axes.set_xticks(off_mm, [f"{one:g}" for one in off_mm])
    ticks = 10.0 ** np.arange(-1, 5)
    axes.set_yticks(ticks, [f"{one:g}" for one in ticks])
    axes.minorticks_off()
    axes.legend()
