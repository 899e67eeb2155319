"""Camera, catalogs and star fields shared by SHEFEX-2's experiments (Samaan & Theil 2011)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from estimator.attitude.solvers import SOLVERS
from estimator.catalog import (catalog)
from estimator.catalog import pair_index
from estimator.catalog import published_catalogs
from estimator.catalog.catalog import StarCatalog
from estimator.catalog.pair_index import PairIndex
from estimator.core.checks import Ints
from estimator.core.types import Centroids
from estimator.identification.published.shefex import FOURTH_STAR, SearchOptions, search
from estimator.trackers.pipeline import Settings
from skysim.core.files import CATALOGS
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.dome_survey.survey_frames import detect_lights
from skysim.experiments.study.execution import detections
from skysim.results.metrics import Summary
from skysim.results.plots import INK, MARKS
from skysim.scene.loader import load
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking import onboard_model



MAX_CENTROIDS = 15
CHOSEN_COS_ERROR = 5.5e-5  # tolerance on cosines of angles
PUBLISHED = INK[1]
UNLIMITED = 10**9
PIXEL_RAD = np.radians(0.02)  # "the angle per pixel, computed from the FOV and the CCD size"
PRINTED_FIELD_RAD = np.radians(18.57)


@cache
def shefex_lab() -> Lab:
    """The scene's lab under the stars of the paper's catalog."""
    return build_lab(load("shefex2", {"light.catalog": "hipparcos_hp6.5"}))


@cache
def stars() -> StarCatalog:
    """Hipparcos to Hp 6.5, as the tracker reads it."""
    return catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv")


@cache
def paper_catalog(name: str) -> StarCatalog:
    """One of the paper's catalogs: asymmetric, uniform or chosen."""
    return published_catalogs.CATALOGS[name](stars())


def lab_with(star_catalog: StarCatalog) -> Lab:
    """The scene's lab with the stars of a catalog only."""
    lab = shefex_lab()
    return lab.with_sources(
        lab.camera.sources.take(np.isin(lab.camera.sources.id, star_catalog.id))
    )


def apparent(star_catalog: StarCatalog) -> Floats:
    """(N, 3) apparent directions at the scene's start time."""
    return catalog.apparent(star_catalog, catalog.on_earth(shefex_lab().scene.start_time))


@cache
def pairs() -> PairIndex:
    """Pair index of the chosen catalog, up to the field's diagonal."""
    camera = onboard_model.calibration(shefex_lab().scene.camera)
    return pair_index.build(apparent(paper_catalog("chosen")), camera.diagonal_rad)


class ChainResult(NamedTuple):
    """Result of the paper's chain for a frame: its centroids, rows of the identified ones, the attitude or None."""

    centroids: Centroids
    observed: Ints
    cam_from_ref: Rotation | None


class ProcessingChain:
    """The paper's processing chain: sequential scan, 15 centroids, triangles and pyramids at cosError 5.5e-5, ESOQ2.

    name : of its catalog;  threshold_sigma : of the scan, in units of the frame's noise;  focal_px : calibrated
    """

    def __init__(self, name: str, threshold_sigma: float, focal_px: float) -> None:
        scene = shefex_lab().scene
        self.camera = replace(onboard_model.calibration(scene.camera), focal_px=focal_px)
        self.index = pair_index.build(apparent(paper_catalog(name)), self.camera.diagonal_rad)
        self.settings = Settings(
            detector="sequential",
            centroider="cog",
            max_blobs=MAX_CENTROIDS,
            gain_e_dn=scene.camera.detector.gain_e_dn,
            threshold_sigma=threshold_sigma,
        )

    def solve(self, image: NDArray[Any]) -> ChainResult:
        """Solve a frame; by the paper's rule, a match with a fourth star is accepted."""
        centroids = detect_lights(self.settings, self.camera, image)
        if len(centroids) < 4:
            return ChainResult(centroids, np.empty(0, np.int64), None)
        rays = self.camera.rays(centroids.xy_px)
        counters = np.zeros(3, np.int64)
        sigma_rad = 0.1 / self.camera.focal_px
        solution = identify_and_solve(
            rays, self.index, CHOSEN_COS_ERROR, FOURTH_STAR, sigma_rad, counters
        )
        return ChainResult(centroids, *solution)


processing_chain = cache(ProcessingChain)


def search_options(
    index: PairIndex, cos_error: float, lights: int, accept_log10_chance: float
) -> SearchOptions:
    """SearchOptions of the paper's identifier for a number of lights, without a limit on its work."""
    # The angular tolerance that corresponds to cosError at the index's largest angle (inverse of eq. 3).
    max_angle_rad = index.max_angle_rad
    tolerance_rad = float(max_angle_rad - np.arccos(min(np.cos(max_angle_rad) + cos_error, 1.0)))
    return SearchOptions(
        cos_error, tolerance_rad, UNLIMITED, UNLIMITED, lights, accept_log10_chance
    )


def identify_and_solve(
    rays: Floats,
    index: PairIndex,
    cos_error: float,
    accept_log10_chance: float,
    sigma_rad: float,
    counters: Ints,
) -> tuple[Ints, Rotation | None]:
    """Rows of the identified rays, and cam_from_ref by ESOQ2; None if none is identified. `counters` count the work."""
    options = search_options(index, cos_error, len(rays), accept_log10_chance)
    observed, star, _, _ = search(rays, index, options, counters)
    if not len(observed):
        return observed, None
    return observed, SOLVERS["esoq2"](
        rays[observed], index.vectors[star], np.full(len(observed), sigma_rad)
    )


class Field(NamedTuple):
    """The catalog's stars on the detector at a random attitude: (N, 2) pixels, brightest first; the true attitude."""

    xy_px: Floats
    cam_from_ref: Rotation


def random_fields(count: int, seed: int) -> list[Field]:
    """Random attitudes over the whole sky, with the projected stars of the chosen catalog."""
    lab = lab_with(paper_catalog("chosen"))
    result = []
    for lab_from_body in Rotation.random(count, rng=random_stream(seed, 0)):
        xy_px, electrons = detections.visible_sources(lab, lab_from_body)
        order = np.argsort(-electrons, kind="stable")
        result.append(Field(xy_px[order], lab.camera.mount.cam_from_body * lab_from_body.inv()))
    return result


def plot_curve(axes: Any, x: Any, summaries: list[Summary], curve: int, label: str) -> None:
    """Plot a curve of ours with its intervals; INK[1] is reserved for published data."""
    value, low, high, *_ = np.array(summaries).T
    color = [one for one in INK if one != PUBLISHED][curve]
    axes.errorbar(
        x,
        value,
        [value - low, high - value],
        marker=MARKS[curve],
        color=color,
        capsize=2,
        label=label,
    )


