"""Blooming, transfer loss and smear against step-by-step simulations of the same processes."""

from __future__ import annotations

import numpy as np
import pytest

from skysim.camera.charge_transfer import (
    bloom,
    delayed_fractions,
    smear,
    transfer_loss,
)

WELL = 1000.0


def frame(column: np.ndarray, width: int = 3) -> np.ndarray:
    """A column of charge with empty columns beside it."""
    image = np.zeros((len(column), width), np.float32)
    image[:, width // 2] = column
    return image


def halve_till_it_fits(column: np.ndarray) -> np.ndarray:
    """Repeatedly move the excess of every overfull pixel in halves to its neighbors, all at once."""
    charge = np.concatenate([[0.0], column, [0.0]])  # the two outer places swallow
    while (excess := np.maximum(charge[1:-1] - WELL, 0)).max() > 1e-7 * WELL:
        charge[1:-1] -= excess
        charge[:-2] += excess / 2
        charge[2:] += excess / 2
    return charge[1:-1]


@pytest.mark.compiles
@pytest.mark.parametrize("seed", range(6))
def test_blooming_equals_the_limit_of_repeated_halving(seed: int) -> None:
    """Random sky with one to four saturated sources, near each other and near the ends."""
    rng = np.random.default_rng(seed)
    column = rng.uniform(0, 0.9 * WELL, 60)
    column[rng.integers(0, 60, 1 + seed % 4)] += rng.uniform(1, 9) * WELL
    image = frame(column)
    bloom(image, WELL)
    np.testing.assert_allclose(
        image[:, 1], halve_till_it_fits(column), rtol=0, atol=1e-3 * WELL
    )


@pytest.mark.compiles
def test_blooming_keeps_the_charge_and_its_center() -> None:
    rng = np.random.default_rng(2)
    image = rng.uniform(0, 0.5 * WELL, (400, 30)).astype(np.float32)
    image[150:250:30, ::3] += np.float32(20 * WELL)
    before = image.astype(float)
    rows = np.arange(400)
    bloom(image, WELL)
    assert image.max() == WELL
    # Roundings to float32, 6e-5 e each, for 400 pixels; for the moment each at up to row 400.
    np.testing.assert_allclose(
        image.sum(axis=0, dtype=float), before.sum(axis=0), rtol=0, atol=0.03
    )
    np.testing.assert_allclose(rows @ image.astype(float), rows @ before, rtol=0, atol=10.0)


@pytest.mark.compiles
@pytest.mark.parametrize("wells", [1, 3, 11, 41])
def test_a_single_source_fills_as_many_pixels_as_it_has_wells(wells: int) -> None:
    column = np.zeros(101)
    column[50] = wells * WELL
    image = frame(column)
    bloom(image, WELL)
    half = wells // 2
    np.testing.assert_array_equal(
        np.flatnonzero(image[:, 1]), np.arange(50 - half, 51 + half)
    )
    np.testing.assert_allclose(image[50 - half : 51 + half, 1], WELL, rtol=1e-6)
    np.testing.assert_array_equal(image[:, 1], image[::-1, 1])
    assert not image[:, [0, 2]].any()


def test_the_last_electrons_go_in_halves_to_both_ends() -> None:
    column = np.zeros(11)
    column[5] = 3.5 * WELL
    image = frame(column)
    bloom(image, WELL)
    np.testing.assert_allclose(
        image[2:9, 1], WELL * np.array([0, 0.25, 1, 1, 1, 0.25, 0]), rtol=1e-6
    )


def test_two_equal_sources_make_one_symmetric_streak() -> None:
    column = np.zeros(60)
    column[[27, 32]] = 10 * WELL
    image = frame(column)
    bloom(image, WELL)
    np.testing.assert_array_equal(np.flatnonzero(image[:, 1] > 1), np.arange(20, 40))
    np.testing.assert_allclose(image[20:40, 1], WELL, rtol=1e-6)


def test_anti_blooming_drains_its_share_of_the_excess() -> None:
    column = np.zeros(101)
    column[50] = 11 * WELL
    drained = frame(column)
    dry = frame(column)
    bloom(drained, WELL, anti_blooming=0.6)
    bloom(dry, WELL, anti_blooming=1.0)
    assert drained.sum(dtype=float) == pytest.approx(WELL * (1 + 0.4 * 10), rel=1e-6)
    np.testing.assert_array_equal(dry[:, 1], np.minimum(column, WELL))


def test_charge_beyond_the_column_s_end_is_lost() -> None:
    column = np.zeros(20)
    column[10] = 1000 * WELL
    image = frame(column)
    bloom(image, WELL)
    np.testing.assert_allclose(image[:, 1], WELL, rtol=1e-6)
    flooded = np.full((20, 4), 5 * WELL, np.float32)
    bloom(flooded, WELL)
    np.testing.assert_array_equal(flooded, np.full((20, 4), WELL, np.float32))


def test_columns_below_full_well_are_unchanged_bit_for_bit() -> None:
    image = np.random.default_rng(3).uniform(0, WELL, (50, 70)).astype(np.float32)
    before = image.copy()
    bloom(image, WELL)
    np.testing.assert_array_equal(image, before)
    image[20, 33] = 10 * WELL
    bloom(image, WELL)
    others = np.arange(70) != 33
    np.testing.assert_array_equal(image[:, others], before[:, others])
    assert not np.array_equal(image[:, 33], before[:, 33])


def clocked_out(line_e: np.ndarray, cti: float, clocks: int) -> np.ndarray:
    """A register moved place by place: each clock all charge but the fraction cti goes on towards place 0 and out."""
    charge = line_e.astype(float)
    out = np.zeros(clocks)
    for clock in range(clocks):
        moved = (1 - cti) * charge
        charge -= moved
        out[clock] = moved[0]
        charge[:-1] += moved[1:]
    return out


@pytest.mark.parametrize("cti", [1e-5, 1e-3, 1e-2])
def test_transfer_loss_equals_that_of_packets_moved_pixel_by_pixel(cti: float) -> None:
    rng = np.random.default_rng(4)
    line = rng.uniform(0, 1e4, 150)
    wanted = clocked_out(line, cti, 150)
    down = frame(line)
    across = frame(line).T.copy()
    transfer_loss(down, cti, 0.0)
    transfer_loss(across, 0.0, cti)
    # 1e-6 of some packets is a place or so amiss, and float32 rounds to 1e-3 e.
    np.testing.assert_allclose(down[:, 1], wanted, rtol=0, atol=0.05)
    np.testing.assert_allclose(across[1], wanted, rtol=0, atol=0.05)


def test_parallel_and_serial_loss_of_a_frame_are_clocked_one_after_the_other() -> None:
    image = np.random.default_rng(5).uniform(0, 1e4, (70, 140)).astype(np.float32)
    rows = np.array([clocked_out(column, 3e-3, 70) for column in image.T]).T
    wanted = np.array([clocked_out(row, 2e-3, 140) for row in rows])
    transfer_loss(image, 3e-3, 2e-3)
    np.testing.assert_allclose(image, wanted, rtol=0, atol=0.1)


@pytest.mark.compiles
def test_deferred_charge_of_a_flat_field_is_transfers_times_inefficiency() -> None:
    """The extended-pixel edge response: what trails a flat field of n rows is n cti of a row (Janesick 2001)."""
    rows = 1000
    cti = 1e-6
    image = np.zeros((rows + 20, 130))
    image[:rows] = 5e4
    transfer_loss(image, cti, 0.0)
    np.testing.assert_allclose(image[rows:].sum(axis=0), 5e4 * rows * cti, rtol=2e-3)
    np.testing.assert_allclose(image.sum(axis=0), 5e4 * rows, rtol=1e-12)


def test_deferred_charge_conserves_the_total() -> None:
    for cti in (1e-9, 1e-6, 1e-4, 1e-2):
        share = delayed_fractions(2000, cti)
        np.testing.assert_allclose(share.sum(axis=0), 1, rtol=1e-12)
        assert share.min() >= 0
    image = np.random.default_rng(6).uniform(0, 100, (20, 30))
    before = image.copy()
    transfer_loss(image, 0.0, 0.0)
    np.testing.assert_array_equal(image, before)


def clocked_under_light(
    rate_e_s: np.ndarray, exposure_s: float, row_time_s: float
) -> np.ndarray:
    """One column: dark charge clocked in row by row under the light, exposed, and clocked out into the store."""
    charge = np.zeros(len(rate_e_s))
    store = []
    for _ in rate_e_s:
        charge = np.append((charge + rate_e_s * row_time_s)[1:], 0.0)
    charge += rate_e_s * exposure_s
    for _ in rate_e_s:
        store.append(charge[0])
        charge = np.append(charge[1:], 0.0) + rate_e_s * row_time_s
    return np.array(store)


@pytest.mark.slow
def test_smear_equals_that_of_a_column_clocked_under_light() -> None:
    exposure_s = 0.05
    row_time_s = 2e-6
    rate = np.random.default_rng(7).uniform(0, 1e5, (90, 130))
    wanted = np.array(
        [clocked_under_light(column, exposure_s, row_time_s) for column in rate.T]
    ).T
    light = rate * exposure_s
    smear(light, exposure_s, row_time_s)
    np.testing.assert_allclose(light, wanted, rtol=1e-12)
    single = (rate * exposure_s).astype(np.float32)
    smear(single, exposure_s, row_time_s)
    np.testing.assert_allclose(single, wanted, rtol=1e-6)


def test_a_leaking_register_smears_in_proportion_to_its_leak() -> None:
    rate = np.random.default_rng(8).uniform(0, 1e5, (40, 65))
    open_sky = rate * 0.1
    covered = rate * 0.1
    smear(open_sky, 0.1, 5e-6)
    smear(covered, 0.1, 5e-6, leak=1e-3)
    np.testing.assert_allclose(
        covered - rate * 0.1, 1e-3 * (open_sky - rate * 0.1), rtol=0, atol=1e-9
    )


def test_a_bright_star_smears_only_its_column() -> None:
    light = np.zeros((100, 80), np.float32)
    light[30, 40] = 1e6
    smear(light, 0.1, 1e-6)
    others = np.delete(light[:, 40], 30)
    np.testing.assert_allclose(others, 10.0, rtol=1e-6)  # 1e6 e x 1 us / 0.1 s
    assert light[30, 40] == 1e6
    assert not np.delete(light, 40, axis=1).any()
