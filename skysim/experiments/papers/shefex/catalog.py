"""SHEFEX-2's on-board catalogs: counts, pairs, sky maps, uniformity (Samaan & Theil 2011, section 3.3, figs 4, 5)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.catalog import pair_index, shefex
from estimator.catalog.catalog import StarCatalog
from skysim.core.types import Floats
from skysim.experiments.papers.compare import Answer, Ask, Cause, Drawing, Found
from skysim.experiments.papers.intervals import of_means
from skysim.experiments.papers.shefex.setup import PRINTED_FIELD_RAD, PUBLISHED, lab, listed, stars
from skysim.experiments.study import trials
from skysim.results.metrics import exact
from skysim.results.plots import INK

KEPT_MAG, FAINTEST_MAG = 4.5, 5.75
LEAST = 4


def catalogues(ask: Ask) -> Found:
    """The paper's counts for our versions of its catalogs, stars in view at random attitudes, and two sky maps."""
    asymmetric, uniform, chosen = (listed(name) for name in ("asymmetric", "uniform", "chosen"))
    counts = in_fields((asymmetric, uniform), ask)
    bright = stars().id[stars().v_mag <= KEPT_MAG]
    faint = between(asymmetric, 5.2, 5.4)
    thinned = Cause("the thinning of the chosen catalogue", exact(between(chosen, 5.2, 5.4)))
    pool = stars().take(stars().v_mag <= FAINTEST_MAG)
    kept = shefex.uniform(pool, len(uniform), KEPT_MAG)
    all_bright = Cause("all stars to 4.5 mag kept", exact(between(kept, 5.25, 5.75)))
    answers = {
        "asymmetric_faint": Answer(exact(faint), cause=thinned),
        "asymmetric_faintest": Answer(exact(asymmetric.v_mag.max())),
        "uniform_faint": Answer(exact(between(uniform, 5.25, 5.75)), cause=all_bright),
        "chosen_stars": Answer(exact(len(chosen))),
        "chosen_pairs": Answer(exact(pairs_of(chosen))),
        "chosen_bright": Answer(exact(np.isin(bright, chosen.id).mean())),
        "uniform_pairs": Answer(exact(pairs_of(uniform))),
        "spread": Answer(of_means(np.hstack([counts, counts**2]), evenness)),
        "poor": Answer(of_means((counts < LEAST).astype(float), lambda m: m[..., 1] - m[..., 0])),
    }
    return Found(
        answers,
        (
            Drawing("Fig. 4: the asymmetric catalogue.", partial(draw, asymmetric), (7.4, 4.2)),
            Drawing("Fig. 5: the uniform catalogue.", partial(draw, uniform), (7.4, 4.2)),
            Drawing(
                "Stars in the field of 14.9 x 11.2 deg at random attitudes.", partial(draw_counts, counts)
            ),
        ),
    )


def between(known: StarCatalog, bright_mag: float, faint_mag: float) -> int:
    """Number of stars with bright_mag < V <= faint_mag."""
    return int(np.sum((known.v_mag > bright_mag) & (known.v_mag <= faint_mag)))


def pairs_of(known: StarCatalog) -> int:
    """Number of pairs closer than the field's printed diagonal."""
    return len(pair_index.build(known.vectors, float(PRINTED_FIELD_RAD)).pair)


def in_fields(many: tuple[StarCatalog, ...], ask: Ask) -> Floats:
    """(N, K) number of stars of each catalog on the detector at N random attitudes."""
    labs = [replace(lab(), sources=lab().sources.take(np.isin(lab().sources.id, one.id))) for one in many]
    attitudes = Rotation.random(ask.trials(2000, 300), rng=np.random.default_rng([ask.seed, 0]))
    return np.array([[len(trials.lights(one, each)[0]) for one in labs] for each in attitudes], float)


def evenness(means: Floats) -> Floats:
    """Index of dispersion (variance over mean) of the uniform catalog's counts, divided by the asymmetric one's.

    means : (..., 4) mean counts of both catalogs, then mean squared counts
    """
    mean, square = means[..., :2], means[..., 2:]
    index_of_spread = (square - mean**2) / mean
    return np.asarray(index_of_spread[..., 1] / index_of_spread[..., 0])


def draw(known: StarCatalog, fig: Any) -> None:
    """Sky map in Mollweide projection, right ascension increasing to the left; brighter stars are larger."""
    axes = fig.add_subplot(projection="mollweide")
    x, y, z = known.vectors.T
    size = 0.6 + 1.6 * np.clip(6 - known.v_mag, 0, None)
    axes.scatter(-np.arctan2(y, x), np.arcsin(z), s=size, color=INK[0], lw=0)
    axes.set_xticks(np.radians(np.arange(-120, 121, 60)), [])
    axes.set_xlabel("right ascension grows to the left from 0 in the middle", fontsize=8)
    axes.set_yticks(np.radians(np.arange(-60, 61, 30)), [f"{dec} deg" for dec in range(-60, 61, 30)])
    axes.tick_params(labelsize=7)
    axes.set_title(f"ours: {len(known)} stars to {known.v_mag.max():.2f} mag", fontsize=9)


def draw_counts(counts: Floats, fig: Any) -> None:
    axes = fig.subplots()
    edges = np.arange(-0.5, counts.max() + 1)
    for n, name in enumerate(("asymmetric", "uniform")):
        share, _ = np.histogram(counts[:, n], edges, density=True)
        axes.step(edges[:-1] + 0.5, share, where="mid", color=INK[n * 2], label=f"ours, {name}")
    axes.axvline(LEAST - 0.5, color=PUBLISHED, ls="--", label="published: four are needed")
    axes.set(xlabel="stars in the field", ylabel="share of the fields")
    axes.legend()
