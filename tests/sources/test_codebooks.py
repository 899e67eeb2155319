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


def test_polynomials_are_primitive_and_pairs_preferred() -> None:
    """x has the order 2^m - 1; the correlations of a pair are -1 and -1 +- 2^floor((m + 2) / 2) (Gold 1967)."""
    tables = [*codebooks.PRIMITIVE.items(), *codebooks.PREFERRED.items()]
    assert [degree for degree, _ in tables] == [3, 4, 5, 6, 7, 5, 6, 7]
    for degree, polynomial in tables:
        power = 2
        order = 1
        while power != 1 and order < 2**degree:
            power <<= 1
            power ^= polynomial if power >> degree else 0
            order += 1
        assert order == 2**degree - 1
        sequence = codebooks.maximal_sequence(polynomial, degree)
        assert len(sequence) == 2**degree - 1
        assert sequence[:degree].tolist() == [1] * degree
        assert sequence.sum() == 2 ** (degree - 1)
        signs = 1 - 2 * sequence.astype(int)
        for shift in range(1, len(signs)):
            assert signs @ np.roll(signs, shift) == -1
        # The recursion of the polynomial, of all its shifts
        taps = [k for k in range(degree + 1) if polynomial >> k & 1]
        cyclic = np.array([np.roll(sequence, -k) for k in taps]).sum(axis=0) % 2
        assert not cyclic.any()
    for degree, second in codebooks.PREFERRED.items():
        u, v = (
            1 - 2 * codebooks.maximal_sequence(one, degree).astype(int)
            for one in (codebooks.PRIMITIVE[degree], second)
        )
        found = {int(u @ np.roll(v, shift)) for shift in range(len(u))}
        t = 1 + 2 ** ((degree + 2) // 2)
        assert found == {-1, -t, t - 2}


@pytest.mark.parametrize(
    ("count", "bits"), [(1, 2), (2, 2), (3, 3), (6, 3), (7, 4), (14, 4), (15, 5), (510, 9)]
)
def test_data_bits_leave_out_the_two_constant_words(count: int, bits: int) -> None:
    assert codebooks.data_bits(count) == bits
    words = codebook(PlainCodeConfig(kind="gray"), count)
    assert words.shape == (count, bits)


@pytest.mark.parametrize(
    ("count", "bits"),
    [(2, 2 + 3 + 1), (14, 4 + 3 + 1), (15, 5 + 4 + 1), (400, 9 + 4 + 1), (2000, 11 + 4 + 1)],
)
def test_a_hamming_code_has_the_least_check_bits_and_the_distance_of_four(
    count: int, bits: int
) -> None:
    """Of r checks for 2^r - r - 1 data bits, and the parity of the whole word; also of the words of that."""
    words = codebook(PlainCodeConfig(kind="hamming"), count)
    assert words.shape == (count, bits)
    assert not (words.sum(axis=1) % 2).any()
    assert least_distance(words[:200]) >= 4


@pytest.mark.parametrize(
    ("count", "distance", "bits"),
    [
        # [7, 4], [15, 11], [15, 7], [31, 21] and [63, 51] codes, shortened (Lin and Costello, table 6.1)
        (14, 3, 7),
        (15, 3, 5 + 4),
        (2000, 3, 15),
        (126, 5, 15),
        (127, 5, 8 + 10),
        (30, 7, 15),
        (31, 7, 6 + 15),
    ],
)
def test_a_bch_code_is_the_shortest_of_its_distance(
    count: int, distance: int, bits: int
) -> None:
    words = codebook(BchCodeConfig(kind="bch", distance=distance), count)
    assert words.shape == (count, bits)
    assert least_distance(words[:300]) >= distance


@pytest.mark.parametrize(("count", "bits"), [(1023, 31), (1024, 63), (4095, 63), (4096, 127)])
def test_gold_sequences_are_the_shortest_that_are_enough(count: int, bits: int) -> None:
    """n (n + 2) of n bits; none beyond 127 (129)."""
    words = codebooks.gold(count)
    assert words.shape == (count, bits)
    assert len(np.unique(words, axis=0)) == count
    assert len(codebooks.gold(127 * 129)) == 127 * 129
    assert codebooks.gold(127 * 129 + 1).shape == (0, 1)


def test_codes_without_enough_words_are_empty() -> None:
    assert codebooks.bch(2**20, 63).shape == (0, 1)
    assert codebooks.cyclic(2**20 + 1, 3).shape == (0, 1)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "distance"), [(1, 3), (2, 3), (5, 5), (50, 7)])
def test_a_cyclic_code_is_the_shortest_with_enough_orbits(count: int, distance: int) -> None:
    """By listing all words of all lengths: the orbits of their full length under shifts."""
    words = codebook(CyclicCodeConfig(kind="cyclic", distance=distance), count)
    found = None
    for degree in (3, 4, 5):
        generator = codebooks.bch_generator(degree, distance)
        length = 2**degree - 1
        data = length - generator.bit_length() + 1
        if data < 1:
            continue
        every = [0]
        for k in range(data):
            every += [one ^ generator << k for one in every]
        full = set()
        for one in every:
            shifts = {
                (one << k | one >> (length - k)) & (2**length - 1) for k in range(length)
            }
            if len(shifts) == length:
                full.add(min(shifts))
        if len(full) >= count and 2**data >= count:
            found = length
            break
    assert found == words.shape[1]
    numbers = [int("".join(map(str, word)), 2) for word in words.tolist()]
    assert set(numbers) <= full
    assert len(set(numbers)) == count


def test_orbits_are_the_least_shifts_of_words_without_symmetry() -> None:
    """Of 6 bits: 9 necklaces of the full length (Moebius: (64 - 8 - 4 + 2) / 6)."""
    found = codebooks.orbits(np.arange(64), 6)
    assert found.tolist() == [1, 3, 5, 7, 11, 13, 15, 23, 31]


def test_products_over_two_elements_are_sums_of_shifts() -> None:
    """(x + 1)^2 is x^2 + 1, and (x^2 + x + 1)(x + 1) is x^3 + 1."""
    products = codebooks.multiply(np.array([0b11, 0b111, 0b1, 0b1011]), 0b11)
    assert products.tolist() == [0b101, 0b1001, 0b11, 0b11101]


def test_words_with_as_many_ones_as_zeros_come_first() -> None:
    words = codebooks.bits_of(np.arange(32), 5)
    found = codebooks.balanced(words)
    ones = found.sum(axis=1).astype(int)
    assert len(found) == 30
    assert (np.diff(np.abs(2 * ones - 5)) >= 0).all()
    # Else in their order
    numbers = found @ (1 << np.arange(5)[::-1])
    assert (np.diff(numbers[:20]) > 0).all()
    assert codebooks.bits_of(np.array([6]), 4).tolist() == [[0, 1, 1, 0]]


def test_a_word_is_readable_that_has_the_highest_level_and_another() -> None:
    words = np.array([[0, 3], [3, 3], [2, 2], [3, 2], [0, 2]])
    assert codebooks.readable(words, 4).tolist() == [[0, 3], [3, 2]]


@pytest.mark.parametrize(
    ("count", "levels", "k"), [(2, 2, 2), (4, 2, 2), (5, 2, 3), (9, 3, 2)]
)
def test_a_de_bruijn_sequence_is_the_shortest_with_enough_shifts(
    count: int, levels: int, k: int
) -> None:
    """Two symbols at least, so that one frame alone does not say which LED it is."""
    words = codebooks.de_bruijn(count, levels)
    assert words.shape == (count, levels**k)
    assert words[0, :k].tolist() == [0] * k
