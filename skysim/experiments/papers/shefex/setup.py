"""Camera, catalogs and star fields shared by SHEFEX-2's experiments (Samaan & Theil 2011)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import SOLVERS
from estimator.catalog import catalog, pair_index, shefex
from estimator.catalog.catalog import StarCatalog
from estimator.catalog.pair_index import PairIndex
from estimator.core.arrays import Ints
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.identification.published.shefex import FOURTH_STAR, Rules, search
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.core.paths import CATALOGUES
from skysim.core.types import Floats
from skysim.experiments.study import trials
from skysim.results.metrics import Summary
from skysim.results.plots import INK, MARKS
from skysim.scene.loader import load
from skysim.simulation import testbed
from skysim.simulation.testbed import Testbed
from skysim.tracking import onboard_model

MOST = 15  # centroids
CHOSEN = 5.5e-5  # cosError
PUBLISHED = INK[1]
UNLIMITED = 10**9
PIXEL_RAD = np.radians(0.02)  # "the angle per pixel, computed from the FOV and the CCD size"
PRINTED_FIELD_RAD = np.radians(18.57)


@cache
def lab() -> Testbed:
    """The scene's testbed."""
    return testbed.build_testbed(load("shefex2"))


@cache
def stars() -> StarCatalog:
    """The simulator's full star catalog, as the tracker reads it."""
    return catalog.read(CATALOGUES / "hipparcos_hp6.5.ecsv")


@cache
def listed(name: str) -> StarCatalog:
    """One of the paper's catalogs: asymmetric, uniform or chosen."""
    return shefex.CATALOGUES[name](stars())


def apparent(known: StarCatalog) -> Floats:
    """(N, 3) apparent directions at the scene's start time."""
    return catalog.apparent(known, catalog.on_earth(lab().scene.start_time))


@cache
def pairs() -> PairIndex:
    """Pair index of the chosen catalog, up to the field's diagonal."""
    return pair_index.build(
        apparent(listed("chosen")), onboard_model.calibration(lab().scene.camera).diagonal_rad
    )


class Answered(NamedTuple):
    """Result of the paper's chain for a frame: its centroids, rows of the identified ones, the attitude or None."""

    centroids: Centroids
    observed: Ints
    cam_from_ref: Rotation | None


class Chain:
    """The paper's processing chain: sequential scan, 15 centroids, triangles and pyramids at cosError 5.5e-5, ESOQ2.

    name : of its catalog;  threshold_sigma : of the scan, in units of the frame's noise;  focal_px : calibrated
    """

    def __init__(self, name: str, threshold_sigma: float, focal_px: float) -> None:
        scene = lab().scene
        self.camera = replace(onboard_model.calibration(scene.camera), focal_px=focal_px)
        self.index = pair_index.build(apparent(listed(name)), self.camera.diagonal_rad)
        self.settings = Settings(
            detector="sequential",
            centroider="cog",
            max_blobs=MOST,
            gain_e_dn=scene.camera.detector.gain_e_dn,
            threshold_sigma=threshold_sigma,
        )

    def solve(self, image: NDArray[Any]) -> Answered:
        """Solve a frame; by the paper's rule, a match with a fourth star is accepted."""
        try:
            seen = detect_and_centroid(image, self.camera, self.settings, Clock())
        except ImageError:
            return Answered(Centroids.none(), np.empty(0, np.int64), None)
        if len(seen) < 4:
            return Answered(seen, np.empty(0, np.int64), None)
        rays = self.camera.rays(seen.xy_px)
        by = Rules(CHOSEN, slack_rad(self.index, CHOSEN), UNLIMITED, UNLIMITED, len(seen), FOURTH_STAR)
        observed, star, _, _ = search(rays, self.index, by)
        if not len(observed):
            return Answered(seen, observed, None)
        sigma_rad = np.full(len(observed), 0.1 / self.camera.focal_px)
        return Answered(seen, observed, SOLVERS["esoq2"](rays[observed], self.index.vectors[star], sigma_rad))


@cache
def chain(name: str, threshold_sigma: float, focal_px: float) -> Chain:
    """The chain with one of the catalogs, cached."""
    return Chain(name, threshold_sigma, focal_px)


def slack_rad(known: PairIndex, error: float) -> float:
    """Angular tolerance that corresponds to cosError at the index's largest angle (inverse of eq. 3), rad."""
    wide = known.max_angle_rad
    return float(wide - np.arccos(min(np.cos(wide) + error, 1.0)))


class Field(NamedTuple):
    """The catalog's stars on the detector at a random attitude: (N, 2) pixels, brightest first; the true attitude."""

    xy_px: Floats
    cam_from_ref: Rotation


def fields(count: int, seed: int) -> list[Field]:
    """Random attitudes over the whole sky, with the projected stars of the chosen catalog."""
    known = replace(lab(), sources=lab().sources.take(np.isin(lab().sources.id, listed("chosen").id)))
    out = []
    for lab_from_body in Rotation.random(count, rng=np.random.default_rng([seed, 0])):
        xy_px, electrons = trials.lights(known, lab_from_body)
        order = np.argsort(-electrons, kind="stable")
        out.append(Field(xy_px[order], lab().mount.cam_from_body * lab_from_body.inv()))
    return out


def line(axes: Any, x: Any, told: list[Summary], n: int, label: str) -> None:
    """Plot a curve of ours with its intervals; INK[1] is reserved for published data."""
    value, low, high, _ = np.array(told).T
    ink = [one for one in INK if one != PUBLISHED][n]
    axes.errorbar(x, value, [value - low, high - value], marker=MARKS[n], color=ink, capsize=2, label=label)
