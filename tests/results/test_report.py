"""Pictures for the eye: marks where the truth is, stretches that compare."""

from __future__ import annotations

import numpy as np

from skysim.core.types import SourceTruth
from skysim.results import report


def seen(xy_px: list[tuple[float, float]], saturated: list[bool]) -> SourceTruth:
    count = len(xy_px)
    one, place = np.ones(count), np.array(xy_px)
    return SourceTruth(
        np.arange(count) + 1, place, place, one * 1e4, one, 0 * one, one, np.rint(place).astype(int),
        np.array(saturated), one,
    )  # fmt: skip


def colored(picture: np.ndarray, bgr: tuple[int, int, int]) -> np.ndarray:
    """(N, 2) x and y of the pixels of exactly this color."""
    return np.argwhere((picture == bgr).all(axis=2))[:, ::-1]


def test_ticks_stand_around_the_true_places_and_leave_them_open() -> None:
    image = np.random.default_rng(1).normal(100, 5, (1000, 1200))
    picture = report.annotate_truth(image, seen([(300.2, 400.7), (900.0, 650.0)], [False, True]))
    for place, bgr in (((300, 401), report.TRUTH_BGR), ((900, 650), report.DETECTED_BGR)):
        away = np.abs(colored(picture, bgr) - place).max(axis=1)
        assert away.min() >= 8
        assert np.sort(away)[:40].max() < 40


def test_a_small_frame_is_doubled_and_its_marks_with_it() -> None:
    picture = report.annotate_truth(np.random.default_rng(1).normal(100, 5, (200, 300)), seen([(100.0, 50.0)], [False]))
    assert picture.shape == (400, 600, 3)
    ticks = colored(picture, report.TRUTH_BGR)
    assert np.abs(ticks.min(axis=0) + ticks.max(axis=0) - [401, 201]).max() < 80  # the label leans to one side


def test_a_contact_sheet_stretches_all_frames_alike() -> None:
    rng = np.random.default_rng(2)
    bright, dim = (rng.normal(100, 1, (40, 50)) for _ in range(2))
    bright[18:23, 23:28], dim[18:23, 23:28] = 1000, 300
    sheet = report.contact_sheet([bright, dim], ["a", "b"], scale=2)
    left, right = np.array_split(sheet, 2, axis=1)
    assert left.shape == right.shape == (80 + 26, 100 + 4)
    peaks = [part[24 + 41, 2 + 51] for part in (left, right)]
    assert peaks[0] == 255
    assert 0.3 < (peaks[1] / 255) ** 2 / (200 / 900) < 3  # the square root's share, not a maximum of its own
