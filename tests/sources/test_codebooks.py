"""Codebooks: the stated distances by comparing all words, published generators, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.scene.sections.leds import BchCodeConfig, Code, CyclicCodeConfig, PlainCodeConfig
from skysim.sources.dome import codebooks
from skysim.sources.dome.codebooks import Words, codebook


def distances(words: Words, others: Words) -> np.ndarray:
    """(N, M) Hamming distances."""
    return (words[:, None] != others).sum(axis=2)


def least_distance(words: Words) -> int:
    apart = distances(words, words)
    np.fill_diagonal(apart, words.shape[1])
    return int(apart.min())


@pytest.mark.parametrize(
    ("code", "bits", "distance"),
    [
        (PlainCodeConfig(kind="gray"), 9, 1),
        (PlainCodeConfig(kind="hamming"), 14, 4),
        (PlainCodeConfig(kind="gold"), 31, 12),
        (BchCodeConfig(kind="bch", distance=3), 13, 3),
        (BchCodeConfig(kind="bch", distance=5), 19, 5),
        (BchCodeConfig(kind="bch", distance=7), 24, 7),
        (BchCodeConfig(kind="bch", distance=11), 29, 11),
        (CyclicCodeConfig(kind="cyclic", distance=5), 31, 5),
        (CyclicCodeConfig(kind="cyclic", distance=7), 31, 7),
    ],
)
def test_code_words_have_the_stated_distance(code: Code, bits: int, distance: int) -> None:
    """For 400 LEDs; and no word is constant, which a light of unknown brightness would not show."""
    words = codebook(code, 400)
    assert words.shape == (400, bits)
    assert least_distance(words) >= distance
    assert np.ptp(words, axis=1).min() == 1
    assert codebook(code, 400) is words
    with pytest.raises(ValueError, match="read-only"):
        words[0, 0] = 1


@pytest.mark.parametrize(
    ("code", "frames", "distance"),
    [
        (PlainCodeConfig(kind="gray", levels=4), 5, 1),
        (PlainCodeConfig(kind="gray", levels=8), 4, 1),
        (PlainCodeConfig(kind="hamming", levels=4), 8, 2),
        (BchCodeConfig(kind="bch", distance=5, levels=4), 10, 3),
        (BchCodeConfig(kind="bch", distance=5, levels=8), 7, 2),
    ],
)
def test_levels_show_several_bits_a_frame(
    code: PlainCodeConfig | BchCodeConfig, frames: int, distance: int
) -> None:
    """A distance of d bits is one of d / bits a frame at least, also from a word at any other unknown brightness:

    levels are equally spaced in magnitude, so that a brightness shifts a word by a constant.
    """
    words = codebook(code, 400).astype(int)
    assert words.shape == (400, frames)
    assert words.max() == code.levels - 1
    for shift in range(code.levels):
        apart = (words[:, None] + shift != words).sum(axis=2)
        if shift == 0:
            np.fill_diagonal(apart, frames)
            assert apart.min() >= distance
        assert apart.min() >= 1


@pytest.mark.parametrize(("levels", "bits"), [(4, 2), (8, 3)])
def test_an_error_by_one_level_is_one_wrong_bit(levels: int, bits: int) -> None:
    words = (np.arange(levels)[:, None] >> np.arange(bits)[::-1] & 1).astype(np.uint8)
    level = codebooks.symbols_of(words, bits)[:, 0]
    assert sorted(level.tolist()) == list(range(levels))
    by_level = words[np.argsort(level)]
    assert (by_level[1:] != by_level[:-1]).sum(axis=1).tolist() == [1] * (levels - 1)


def test_levels_are_equally_spaced_in_magnitude() -> None:
    code = PlainCodeConfig(kind="gray", levels=4, depth=0.9)
    light = codebooks.light_levels(code, np.arange(4))
    np.testing.assert_allclose(
        -2.5 * np.log10(light), [2.5, 5 / 3, 5 / 6, 0], rtol=0, atol=1e-12
    )
    two = PlainCodeConfig(kind="gray", depth=0.3)
    np.testing.assert_array_equal(codebooks.light_levels(two, np.arange(2)), [0.7, 1.0])


@pytest.mark.parametrize(
    ("count", "levels", "k"), [(400, 2, 9), (400, 4, 5), (65, 4, 4), (64, 8, 2)]
)
def test_a_few_frames_or_neighbors_of_a_de_bruijn_sequence_are_unique(
    count: int, levels: int, k: int
) -> None:
    words = codebook(PlainCodeConfig(kind="de_bruijn", levels=levels), count)
    assert words.shape == (count, levels**k)
    frames = {
        tuple(np.take(words[0], np.arange(n, n + k), mode="wrap").tolist())
        for n in range(levels**k)
    }
    assert len(frames) == levels**k
    assert (
        len({tuple(word.tolist()) for word in words[:, 17 % levels**k : 17 % levels**k + k]})
        >= count - k
    )
    np.testing.assert_array_equal(
        words[1:, :-1], words[:-1, 1:]
    )  # the light moves along the LEDs


@pytest.mark.parametrize("distance", [5, 7])
@pytest.mark.slow
def test_cyclic_words_have_the_stated_distance_at_any_shift(distance: int) -> None:
    """Words differ from each other's shifts and from their own."""
    words = codebook(CyclicCodeConfig(kind="cyclic", distance=distance), 400)
    for shift in range(1, words.shape[1]):
        assert distances(words, np.roll(words, shift, axis=1)).min() >= distance


def test_gray_words_of_successive_numbers_differ_in_one_bit() -> None:
    """Codes without the word of ones are excepted."""
    words = codebook(PlainCodeConfig(kind="gray"), 400)
    apart = (words[1:] != words[:-1]).sum(axis=1)
    assert sorted(set(apart.tolist())) == [1, 2]
    assert (apart == 2).sum() == 1


def test_all_gold_sequences_and_shifts_are_far_apart() -> None:
    """33 sequences of 31 bits at 31 shifts: correlations of -9, -1 and 7 (Gold 1967), so distances of 12, 16 and 20."""
    words = codebook(PlainCodeConfig(kind="gold"), 1023)
    assert set(distances(words, words)[np.triu_indices(1023, 1)].tolist()) == {12, 16, 20}


@pytest.mark.parametrize(
    ("degree", "distance", "octal"),
    [
        (4, 5, 0o721),
        (4, 7, 0o2467),
        (5, 5, 0o3551),
        (5, 7, 0o107657),
        (5, 11, 0o5423325),
        (6, 7, 0o1701317),
    ],
)
def test_generator_polynomials_match_the_published_ones(
    degree: int, distance: int, octal: int
) -> None:
    """Lin and Costello 2004, appendix C."""
    assert codebooks.bch_generator(degree, distance) == octal


def test_a_code_with_too_few_words_is_refused() -> None:
    with pytest.raises(
        InputError,
        match=r"light.led.code: 70000 LEDs; allowed: at most the \d+ words of kind gold",
    ):
        codebook(PlainCodeConfig(kind="gold"), 70_000)
