"""Camera, catalogs and star fields shared by SHEFEX-2's experiments (Samaan & Theil 2011)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import SOLVERS
from estimator.catalog import catalog, pair_index, published_catalogs
from estimator.catalog.catalog import StarCatalog
from estimator.catalog.pair_index import PairIndex
from estimator.core.checks import Ints
from estimator.core.types import Centroids
from estimator.identification.published.shefex import FOURTH_STAR, ShefexOptions, search
from estimator.trackers.pipeline import Settings
from skysim.core.paths import CATALOGS
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.dome_survey.survey_frames import detect_lights
from skysim.experiments.papers.compare import (
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    Results,
    bootstrap_of_means,
    with_cause,
)
from skysim.experiments.study.execution import detections
from skysim.results.metrics import Summary, exact
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

    Attributes
    ----------
    name
        Of its catalog
    threshold_sigma
        Of the scan, in units of the frame's noise
    focal_px
        calibrated
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
) -> ShefexOptions:
    """SearchOptions of the paper's identifier for a number of lights, without a limit on its work."""
    # The angular tolerance that corresponds to cosError at the index's largest angle (inverse of eq. 3).
    max_angle_rad = index.max_angle_rad
    tolerance_rad = float(
        max_angle_rad - np.arccos(min(np.cos(max_angle_rad) + cos_error, 1.0))
    )
    return ShefexOptions(
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


class StarField(NamedTuple):
    """The catalog's stars on the detector at a random attitude: (N, 2) pixels, brightest first; the true attitude."""

    xy_px: Floats
    cam_from_ref: Rotation


def random_fields(count: int, seed: int) -> list[StarField]:
    """Random attitudes over the whole sky, with the projected stars of the chosen catalog."""
    lab = lab_with(paper_catalog("chosen"))
    result = []
    for lab_from_body in Rotation.random(count, rng=random_stream(seed, 0)):
        xy_px, electrons = detections.visible_sources(lab, lab_from_body)
        order = np.argsort(-electrons, kind="stable")
        result.append(
            StarField(xy_px[order], lab.camera.mount.cam_from_body * lab_from_body.inv())
        )
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


# SHEFEX-2's on-board catalogs: counts, pairs, sky maps, uniformity (Samaan & Theil 2011, section
# 3.3, figs 4, 5).


BRIGHT_LIMIT_MAG = 4.5
FAINTEST_MAG = 5.75
MIN_STARS = 4


def catalog_statistics(options: ExperimentOptions) -> ExperimentResult:
    """The paper's counts for our versions of its catalogs, stars in view at random attitudes, and two sky maps."""
    asymmetric, uniform, chosen = (
        paper_catalog(name) for name in ("asymmetric", "uniform", "chosen")
    )
    counts = count_in_fields((asymmetric, uniform), options)
    bright = stars().id[stars().v_mag <= BRIGHT_LIMIT_MAG]
    faint = [count_between(one, 5.2, 5.4) for one in (asymmetric, chosen)]
    pool = stars().take(stars().v_mag <= FAINTEST_MAG)
    uniform_with_all_bright = published_catalogs.uniform(pool, len(uniform), BRIGHT_LIMIT_MAG)
    uniform_faint = [
        count_between(one, 5.25, 5.75) for one in (uniform, uniform_with_all_bright)
    ]
    results: Results = {
        "asymmetric_faint": with_cause("the thinning of the chosen catalog", exact, *faint),
        "asymmetric_faintest": exact(asymmetric.v_mag.max()),
        "uniform_faint": with_cause("all stars to 4.5 mag kept", exact, *uniform_faint),
        "chosen_stars": exact(len(chosen)),
        "chosen_pairs": exact(count_pairs(chosen)),
        "chosen_bright": exact(np.isin(bright, chosen.id).mean()),
        "uniform_pairs": exact(count_pairs(uniform)),
        "spread": bootstrap_of_means(np.hstack([counts, counts**2]), relative_dispersion),
        "poor": bootstrap_of_means(
            (counts < MIN_STARS).astype(float), lambda m: m[..., 1] - m[..., 0]
        ),
    }
    drawings = (
        FigureDrawing(
            "Fig. 4: the asymmetric catalog.", partial(draw, asymmetric), (7.4, 4.2)
        ),
        FigureDrawing("Fig. 5: the uniform catalog.", partial(draw, uniform), (7.4, 4.2)),
        FigureDrawing(
            "Stars in the field of 14.9 x 11.2 deg at random attitudes.",
            partial(draw_counts, counts),
        ),
    )
    return ExperimentResult(results, drawings)


def count_between(star_catalog: StarCatalog, bright_mag: float, faint_mag: float) -> int:
    """Number of stars with bright_mag < V <= faint_mag."""
    return int(np.sum((star_catalog.v_mag > bright_mag) & (star_catalog.v_mag <= faint_mag)))


def count_pairs(star_catalog: StarCatalog) -> int:
    """Number of pairs closer than the field's printed diagonal."""
    return len(pair_index.build(star_catalog.vectors, float(PRINTED_FIELD_RAD)).pair)


def count_in_fields(catalogs: tuple[StarCatalog, ...], options: ExperimentOptions) -> Floats:
    """(N, K) number of stars of each catalog on the detector at N random attitudes."""
    labs = [lab_with(star_catalog) for star_catalog in catalogs]
    attitudes = Rotation.random(options.trials(2000, 300), rng=random_stream(options.seed, 0))
    counts = [
        [len(detections.visible_sources(one, attitude)[0]) for one in labs]
        for attitude in attitudes
    ]
    return np.array(counts, float)


def relative_dispersion(means: Floats) -> Floats:
    """Index of dispersion (variance over mean) of the uniform catalog's counts, divided by the asymmetric one's.

    Parameters
    ----------
    means
        (..., 4) mean counts of both catalogs, then mean squared counts
    """
    mean = means[..., :2]
    square = means[..., 2:]
    dispersion_index = (square - mean**2) / mean
    return dispersion_index[..., 1] / dispersion_index[..., 0]


def draw(star_catalog: StarCatalog, fig: Any) -> None:
    """Sky map in Mollweide projection, right ascension increasing to the left; brighter stars are larger."""
    axes = fig.add_subplot(projection="mollweide")
    x, y, z = star_catalog.vectors.T
    size = 0.6 + 1.6 * np.clip(6 - star_catalog.v_mag, 0, None)
    axes.scatter(-np.arctan2(y, x), np.arcsin(z), s=size, color=INK[0], lw=0)
    axes.set_xticks(np.radians(np.arange(-120, 121, 60)), [])
    axes.set_xlabel("right ascension grows to the left from 0 in the middle", fontsize=8)
    axes.set_yticks(
        np.radians(np.arange(-60, 61, 30)), [f"{dec} deg" for dec in range(-60, 61, 30)]
    )
    axes.tick_params(labelsize=7)
    axes.set_title(
        f"ours: {len(star_catalog)} stars to {star_catalog.v_mag.max():.2f} mag", fontsize=9
    )


def draw_counts(counts: Floats, fig: Any) -> None:
    axes = fig.subplots()
    edges = np.arange(-0.5, counts.max() + 1)
    for n, name in enumerate(("asymmetric", "uniform")):
        fraction, _ = np.histogram(counts[:, n], edges, density=True)
        axes.step(
            edges[:-1] + 0.5, fraction, where="mid", color=INK[n * 2], label=f"ours, {name}"
        )
    axes.axvline(
        MIN_STARS - 0.5, color=PUBLISHED, ls="--", label="published: four are needed"
    )
    axes.set(xlabel="stars in the field", ylabel="share of the fields")
    axes.legend()
