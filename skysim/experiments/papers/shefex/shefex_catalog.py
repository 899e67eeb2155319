"""SHEFEX-2's on-board catalogs: counts, pairs, sky maps, uniformity (Samaan & Theil 2011, section 3.3, figs 4, 5)."""

from __future__ import annotations

from functools import partial
from typing import Any
import numpy as np
from scipy.spatial.transform import Rotation
from estimator.catalog import pair_index
from estimator.catalog import published_catalogs
from estimator.catalog.catalog import StarCatalog
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats
from skysim.experiments.papers.compare import (Drawing, ExperimentOptions, ExperimentResult, RowResult, with_cause)
from skysim.experiments.papers.compare import bootstrap_of_means
from skysim.experiments.papers.shefex.shefex_setup import (PRINTED_FIELD_RAD, PUBLISHED, lab_with, paper_catalog, stars)
from skysim.experiments.study.execution import detections
from skysim.results.metrics import exact
from skysim.results.plots import INK



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
    uniform_faint = [count_between(one, 5.25, 5.75) for one in (uniform, uniform_with_all_bright)]
    results = {
        "asymmetric_faint": with_cause("the thinning of the chosen catalog", exact, *faint),
        "asymmetric_faintest": RowResult(exact(asymmetric.v_mag.max())),
        "uniform_faint": with_cause("all stars to 4.5 mag kept", exact, *uniform_faint),
        "chosen_stars": RowResult(exact(len(chosen))),
        "chosen_pairs": RowResult(exact(count_pairs(chosen))),
        "chosen_bright": RowResult(exact(np.isin(bright, chosen.id).mean())),
        "uniform_pairs": RowResult(exact(count_pairs(uniform))),
        "spread": RowResult(
            bootstrap_of_means(np.hstack([counts, counts**2]), relative_dispersion)
        ),
        "poor": RowResult(
            bootstrap_of_means((counts < MIN_STARS).astype(float), lambda m: m[..., 1] - m[..., 0])
        ),
    }
    drawings = (
        Drawing("Fig. 4: the asymmetric catalog.", partial(draw, asymmetric), (7.4, 4.2)),
        Drawing("Fig. 5: the uniform catalog.", partial(draw, uniform), (7.4, 4.2)),
        Drawing(
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

    means : (..., 4) mean counts of both catalogs, then mean squared counts
    """
    mean = means[..., :2]
    square = means[..., 2:]
    dispersion_index = (square - mean**2) / mean
    return np.asarray(dispersion_index[..., 1] / dispersion_index[..., 0])


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
        axes.step(edges[:-1] + 0.5, fraction, where="mid", color=INK[n * 2], label=f"ours, {name}")
    axes.axvline(MIN_STARS - 0.5, color=PUBLISHED, ls="--", label="published: four are needed")
    axes.set(xlabel="stars in the field", ylabel="share of the fields")
    axes.legend()


