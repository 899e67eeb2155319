"""Annotated pictures: marks at true positions and equal stretches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skysim.core.types import SourceTruth
from skysim.results import plots


def seen(xy_px: list[tuple[float, float]], saturated: list[bool]) -> SourceTruth:
    count = len(xy_px)
    one = np.ones(count)
    place = np.array(xy_px)
    return SourceTruth(
        np.arange(count) + 1, place, place, one * 1e4, one, 0 * one, one, np.rint(place).astype(int),
        np.array(saturated), 9 * one,
    )  # fmt: skip


def colored(picture: np.ndarray, bgr: tuple[int, int, int]) -> np.ndarray:
    """(N, 2) x and y of the pixels of exactly this color."""
    return np.argwhere((picture == bgr).all(axis=2))[:, ::-1]


def test_ticks_surround_the_true_positions_without_covering_them() -> None:
    image = np.random.default_rng(1).normal(100, 5, (1000, 1200))
    picture = plots.annotate_truth(
        image, seen([(300.2, 400.7), (900.0, 650.0)], [False, True])
    )[:1000]
    for place, bgr in (((300, 401), plots.TRUTH_BGR), ((900, 650), plots.DETECTED_BGR)):
        away = np.abs(colored(picture, bgr) - place).max(axis=1)
        assert away.min() >= 8
        assert np.sort(away)[:40].max() < 40


def test_a_small_frame_is_doubled_and_its_marks_with_it() -> None:
    picture = plots.annotate_truth(
        np.random.default_rng(1).normal(100, 5, (200, 300)), seen([(100.0, 50.0)], [False])
    )
    assert picture.shape == (400 + plots.LEGEND_PX, 600, 3)
    ticks = colored(picture[:400], plots.TRUTH_BGR)
    # The label leans to one side.
    assert np.abs(ticks.min(axis=0) + ticks.max(axis=0) - [401, 201]).max() < 80


def test_invisible_sources_are_not_marked_and_a_legend_names_the_colors() -> None:
    """Of two sources the one with a signal-to-noise ratio of 2 has no ticks; one of unknown ratio has."""
    image = np.random.default_rng(1).normal(100, 5, (1200, 1000))
    sources = seen([(300.0, 400.0), (700.0, 800.0)], [False, False])
    for snr, shown in (
        (np.array([9.0, 2.0]), [True, False]),
        (np.array([9.0, np.nan]), [True, True]),
    ):
        picture = plots.annotate_truth(image, replace(sources, snr=snr))
        ticks = colored(picture, plots.TRUTH_BGR)
        near = [
            (np.hypot(*(ticks - place).T) < 60).any() for place in ((300, 400), (700, 800))
        ]
        assert near == shown
        assert (ticks[:, 1] >= 1200).any()  # the legend, below the frame
        assert len(picture) == 1200 + plots.LEGEND_PX
