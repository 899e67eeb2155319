"""Codebooks of LEDs: a word for each LED, with a stated least distance between any two words.

| kind      | words                                                    | distance                      | receiver     |
|-----------|----------------------------------------------------------|-------------------------------|--------------|
| gray      | numbers in the reflected binary code                     | 1                             | synchronous  |
| hamming   | Hamming code, shortened, and a parity bit                | 4                             | synchronous  |
| bch       | BCH code, shortened                                      | as designed                   | synchronous  |
| gold      | Gold's sequences, each at all its shifts                 | (n - t) / 2, t = 9 for n = 31 | synchronous  |
| de_bruijn | shifts of a De Bruijn sequence                           | 1 in any k frames             | synchronous  |
| cyclic    | one word of each orbit of a BCH code under cyclic shifts | as designed, at all shifts    | free-running |

A synchronous receiver knows which bit each frame shows. A free-running one does not: it must not confuse a word with a
shifted one either, and all shifts of a cyclic code's words are words of that code.

Two levels of light show one bit. Four show two bits and eight three, each by its reflected binary number, so that an
error by one level is one wrong bit; a word of b bits takes b / 2 or b / 3 frames. A De Bruijn sequence has symbols of
2, 4 or 8 levels itself.

Words without the highest level or without another one are left out: a tracker that does not know an LED's brightness
cannot tell them from words that are shifted in level, which are equally spaced in magnitude. Among words of equal
distance those with as many ones as zeros come first; a Gray code stays in its order, in which LEDs of successive
numbers differ in one bit.

References: Lin and Costello 2004, Error Control Coding, chapters 4 to 6; Gold 1967, IEEE Trans. Inf. Theory 13, 619;
Fredricksen and Maiorana 1978, Discrete Mathematics 23, 207 (De Bruijn sequences).
"""

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Array, Floats, Ints
from skysim.scene.sections.leds import BchCodeConfig, Code, CyclicCodeConfig

Words = Array[np.uint8]
NO_WORDS: Words = np.zeros((0, 1), np.uint8)

# Primitive polynomials over GF(2) by degree, as bits: x^5 + x^2 + 1 is 0b100101.
PRIMITIVE = {3: 0b1011, 4: 0b10011, 5: 0b100101, 6: 0b1000011, 7: 0b10001001}
# With the first of the degree, Gold's preferred pairs.
PREFERRED = {5: 0b111101, 6: 0b1100111, 7: 0b10001111}

MAX_DATA_BITS = 20  # 2^20 words are listed at most


@lru_cache(maxsize=8)  # every trial of a study asks for the same codebook
def codebook(config: Code, count: int) -> Words:
    """(count, frames) levels of a scene's code, 0 the lowest; read-only.

    Raises
    ------
    InputError
        If the kind has fewer words.
    """
    if isinstance(config, BchCodeConfig):
        words = packed(partial(bch, distance=config.distance), count, config.levels)
    elif isinstance(config, CyclicCodeConfig):
        words = cyclic(count, config.distance)
    elif config.kind == "de_bruijn":
        words = de_bruijn(count, config.levels)
    else:
        words = packed(PLAIN[config.kind], count, config.levels)
    if len(words) < count:
        raise InputError(
            "light.led.code",
            f"{count} LEDs",
            f"at most the {len(words)} words of kind {config.kind}",
        )
    words.flags.writeable = False
    return words


def light_levels(config: Code, words: Words) -> Floats:
    """Fraction of its light that an LED shows at the levels of words: from 1 - depth to 1, equal steps in magnitude."""
    steps = getattr(config, "levels", 2) - 1
    shown = [(1 - config.depth) ** ((steps - level) / steps) for level in range(steps + 1)]
    return np.array(shown)[words]


def packed(kind: Callable[[int], Words], count: int, levels: int) -> Words:
    """(count, frames) words of a binary code, log2(levels) bits in each level of light.

    Fewer than `count` if the code has fewer. Packed words may become unreadable, so more words are made until enough
    are readable.
    """
    bits = levels.bit_length() - 1
    wanted = count
    while True:
        words = kind(wanted)
        symbols = readable(symbols_of(words, bits), levels) if bits > 1 else words
        if len(symbols) >= count or len(words) < wanted:
            return symbols[:count]
        wanted *= 2


def symbols_of(words: Words, bits: int) -> Words:
    """(N, ceil(B / bits)) levels whose reflected binary numbers are the bits of (N, B) words, padded with zeros.

    From reflected to plain binary digits each digit is the exclusive or of all digits before it.
    """
    missing = -words.shape[1] % bits
    padded = np.pad(words, ((0, 0), (0, missing)))
    digits = np.bitwise_xor.accumulate(padded.reshape(len(words), -1, bits), axis=2)
    return (digits @ (1 << np.arange(bits)[::-1])).astype(np.uint8)


def readable(words: Words, levels: int = 2) -> Words:
    """The words that contain the highest level and another one: of two levels, both a one and a zero."""
    return words[(words.max(axis=1) == levels - 1) & (words.min(axis=1) < levels - 1)]


def de_bruijn(count: int, levels: int) -> Words:
    """(count, levels^k) shifts of a De Bruijn sequence, with the least k that gives `count` shifts.

    Every k successive symbols of the sequence occur once in it, so an LED is identified by its last k frames, and so
    are k LEDs that follow each other by one frame. The sequence joins the Lyndon words whose lengths divide k, in
    lexicographic order (Fredricksen and Maiorana).
    """
    k = next(k for k in range(2, 32) if levels**k >= count)
    word = [0]
    sequence = [0]
    while word:
        # Next Lyndon word: repeat to the length k, drop the highest symbols at the end, raise the last (Duval).
        word = (word * k)[:k]
        while word and word[-1] == levels - 1:
            word.pop()
        if word:
            word[-1] += 1
            sequence += word if k % len(word) == 0 else []
    shifts = np.arange(count)[:, None] + np.arange(len(sequence))
    return np.array(sequence, np.uint8)[shifts % len(sequence)]


def gray(count: int) -> Words:
    """(count, bits) numbers n in the reflected binary code, n xor n / 2; the least distance is 1."""
    bits = data_bits(count)
    number = np.arange(2**bits)
    return readable(bits_of(number ^ number >> 1, bits))[:count]


def hamming(count: int) -> Words:
    """(count, bits) words of the extended Hamming code, shortened; the least distance is 4.

    A code whose parity check matrix has distinct columns that are not 0 has the distance 3 (Lin and Costello 4.1);
    the parity bit makes it 4.
    """
    data = data_bits(count)
    checks = next(r for r in range(2, 32) if 2**r >= data + r + 1)
    # A power of 2 is a check bit's own column.
    columns = [n for n in range(1, 2**checks) if n & (n - 1)][:data]
    word = bits_of(np.arange(2**data), data)
    parity = word @ bits_of(np.array(columns), checks) % 2
    word = np.hstack([word, parity])
    # Extended by the parity of the whole word.
    return balanced(np.hstack([word, word.sum(axis=1, keepdims=True) % 2]))[:count]


def bch(count: int, distance: int) -> Words:
    """(count, bits) words of the shortest shortened BCH code of a designed distance: multiples of its generator."""
    data = data_bits(count)
    for degree in PRIMITIVE:
        generator = bch_generator(degree, distance)
        checks = generator.bit_length() - 1
        if 2**degree - 1 - checks >= data:
            word = multiply(np.arange(2**data), generator)
            return balanced(bits_of(word, data + checks))[:count]
    return NO_WORDS


def cyclic(count: int, distance: int) -> Words:
    """(count, bits) words of a BCH code of which no two are shifts of each other, and none is a shift of itself.

    The distance between any two words at any shifts, and of a word from itself shifted, is that of the code.
    """
    for degree in PRIMITIVE:
        generator = bch_generator(degree, distance)
        length = 2**degree - 1
        data = min(length - generator.bit_length() + 1, MAX_DATA_BITS)
        # Of the `length` words of an orbit about one has its leading data bits in the part that is listed.
        if data < 1 or 2**data < count:
            continue
        word = orbits(multiply(np.arange(1, 2**data), generator), length)
        if len(word) >= count:
            return balanced(bits_of(word, length))[:count]
    return NO_WORDS


def gold(count: int) -> Words:
    """(count, bits) Gold sequences: u, v and u + v shifted by 0 ... n - 1, of n = 2^m - 1 bits, each at all shifts.

    u and v are the maximal sequences of a preferred pair of polynomials. The periodic correlation of any two, and of
    one with itself shifted, is at most t = 1 + 2^floor((m + 2) / 2), so that the distance is (n - t) / 2 (Gold 1967).
    """
    for degree, second in PREFERRED.items():
        length = 2**degree - 1
        if length * (length + 2) < count:
            continue
        u = maximal_sequence(PRIMITIVE[degree], degree)
        v = maximal_sequence(second, degree)
        family = np.vstack([u, v, *(u ^ np.roll(v, shift) for shift in range(length))])
        shifted = [np.roll(family, shift, axis=1) for shift in range(length)]
        return balanced(np.vstack(shifted))[:count]
    return NO_WORDS


def maximal_sequence(polynomial: int, degree: int) -> Words:
    """(2^degree - 1,) output of the linear feedback shift register of a primitive polynomial, started with ones."""
    taps = [k for k in range(degree) if polynomial >> k & 1]
    out = np.ones(2**degree - 1, np.uint8)
    for n in range(degree, len(out)):
        out[n] = sum(int(out[n - degree + k]) for k in taps) % 2
    return out


def bch_generator(degree: int, distance: int) -> int:
    """Generator polynomial, as bits: the product of the minimal polynomials of alpha, ..., alpha^(distance - 1).

    alpha is a root of the primitive polynomial. The minimal polynomial of alpha^i is the product of x - alpha^j over
    the cyclotomic coset j = i, 2 i, 4 i, ... modulo n (Lin and Costello, section 6.1).

    1. Powers of alpha as bits, and their logarithms.
    2. All roots, each once.
    3. Multiply the factors x - root with arithmetic in GF(2^degree).
    """
    # 1.
    order = 2**degree - 1
    power = [1]
    for _ in range(order - 1):
        doubled = power[-1] << 1
        power.append(doubled ^ PRIMITIVE[degree] if doubled >> degree else doubled)
    log = {value: n for n, value in enumerate(power)}
    # 2.
    roots = sorted({i * 2**k % order for i in range(1, distance) for k in range(degree)})
    # 3. Coefficients in GF(2^degree), the constant first.
    polynomial = [1]
    for root in roots:
        times_root = [power[(log[c] + root) % order] if c else 0 for c in polynomial]
        polynomial = [a ^ b for a, b in zip([0, *polynomial], [*times_root, 0], strict=True)]
    return sum(1 << k for k, c in enumerate(polynomial) if c)


def multiply(words: Ints, generator: int) -> Ints:
    """Products of polynomials over GF(2), as bits, with the polynomial `generator`."""
    product = np.zeros_like(words)
    for k in range(generator.bit_length()):
        if generator >> k & 1:
            product ^= words << k
    return product


def orbits(words: Ints, length: int) -> Ints:
    """The least word of each orbit of these words under cyclic shifts, if all its `length` shifts differ."""
    least = words.copy()
    shifted = words.copy()
    mask = (1 << length) - 1
    full = np.ones(len(words), bool)
    for _ in range(length - 1):
        shifted = (shifted << 1 | shifted >> (length - 1)) & mask
        full &= shifted != words
        np.minimum(least, shifted, out=least)
    return np.unique(least[full])


def bits_of(numbers: Ints, bits: int) -> Words:
    """(N, bits) binary digits, the most significant first."""
    return (numbers[:, None] >> np.arange(bits)[::-1] & 1).astype(np.uint8)


def data_bits(count: int) -> int:
    """The number of bits for `count` words and the two words whose bits are all equal."""
    return max((count + 1).bit_length(), 2)


def balanced(words: Words) -> Words:
    """The words that have both a one and a zero, those with as many ones as zeros first."""
    words = readable(words)
    excess = np.abs(2 * words.sum(axis=1, dtype=np.int64) - words.shape[1])
    return words[np.argsort(excess, kind="stable")]


# Binary codes without options, by kind.
PLAIN: dict[str, Callable[[int], Words]] = {"gray": gray, "hamming": hamming, "gold": gold}
