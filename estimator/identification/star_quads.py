"""Lost-in-space star identification by quads: for an uncertain focal length, and for a deep sky in a narrow field.

The code of four detections (`catalog.quad_index`) hardly depends on the focal length. Only the few catalog quads of the
same code are therefore candidates, however uncertain the focal length is, and however many stars there are: an index
of quads has the stars that are bright for their surroundings. The two detections farthest apart and their stars
determine the attitude and the focal length, which the other detections confirm as in `star_search`.

The steps; the same numbers return as comments in the code:

1. Take four detections, by brightness: the four brightest, then all fours with the fifth, and so on (`_search`).
2. Call the two farthest apart A and B, and compute the code (`_test_quad`).
3. Look up the catalog quads whose codes differ by no more than the gate (`_code_gate`).
4. Compute the focal ratio and the attitude from A, B and their stars (`star_search.pair_hypothesis`).
5. Match all detections, fit, and compute the Bayes factor (`star_evidence.evaluate`).
6. Stop at the first candidate with DECISIVE_DEX, and fit it to all detections (`star_search.fit_to_all`).
"""

import numpy as np

from estimator.catalog import quad_index
from estimator.catalog.quad_index import SIDE, QuadIndex
from estimator.catalog.sky_index import SkyIndex
from estimator.core import vectors
from estimator.core.checks import Floats, Ints
from estimator.core.jit import inlined, jit
from estimator.identification import star_search
from estimator.identification.chance import GATE_SIGMA
from estimator.identification.star_detections import Detections, chosen, ray, spread
from estimator.identification.star_evidence import (
    Hypothesis,
    Solution,
    no_hypothesis,
)

COMBINED = 24  # number of brightest detections that are combined to quads


@jit
def identify(
    detections: Detections,
    quads: QuadIndex,
    stars: SkyIndex,
    max_detections: int,
    max_checks: int,
    calibrated: bool,
) -> Solution:
    """Identify the detections, and solve the attitude and the focal length.

    Parameters
    ----------
    detections
        All detections of the frame, brightest first
    quads, stars
        The catalog's quads and its stars
    max_detections
        Number of brightest detections on which the candidates are tested
    max_checks
        Bound on the effort: quads compared and star look-ups, plus EVALUATION_COST for each candidate evaluated
    calibrated
        Whether the focal length should be right (see `star_search.fit_to_all`)

    Returns
    -------
    Solution
        Empty if no candidate reaches DECISIVE_DEX
    """
    searched = chosen(
        detections, spread(detections.tangent, detections.field, max_detections)
    )
    best = _search(searched, quads, stars, max_checks)
    # 6. Fit to all detections.
    return star_search.fit_to_all(detections, stars, best, calibrated)


@jit
def _search(
    detections: Detections, quads: QuadIndex, sky: SkyIndex, max_checks: int
) -> Hypothesis:
    """Steps 1 to 5: the first hypothesis of the quads with DECISIVE_DEX, or else the empty one."""
    quad = np.empty(4, np.int64)
    checks = np.zeros(1, np.int64)
    # 1. Row d is the faintest of the four: every quad of brighter detections comes before any with a fainter one.
    for d in range(3, min(len(detections.sigma), COMBINED)):
        for c in range(2, d):
            for b in range(1, c):
                for a in range(b):
                    quad[:] = a, b, c, d
                    candidate = _test_quad(detections, quads, sky, quad, checks)
                    if candidate.dex >= star_search.DECISIVE_DEX:
                        return candidate
                    # Give up when the effort is used up.
                    if checks[0] > max_checks:
                        return no_hypothesis(np.nan)
    return no_hypothesis()


@inlined
def _test_quad(
    detections: Detections, quads: QuadIndex, sky: SkyIndex, quad: Ints, checks: Ints
) -> Hypothesis:
    """Steps 2 to 5: test four detections against every catalog quad of the same code.

    Parameters
    ----------
    quad
        (4,) rows of the detections, reordered in place to A, B, C, D
    checks
        (1,) effort so far, increased in place

    Returns
    -------
    Hypothesis
        The first one with DECISIVE_DEX, or else the empty one
    """
    # 2. The code: C and D in the axes of A and B.
    _longest_first(detections.tangent, quad)
    ray_a = ray(detections.tangent, quad[0], 1.0)
    ray_b = ray(detections.tangent, quad[1], 1.0)
    length = vectors.chord(ray_a, ray_b)
    code = np.empty(4)
    frame = np.empty((3, 3))
    vectors.pair_frame(ray_a, ray_b, frame)
    code[:2] = quad_index.in_frame(frame, ray(detections.tangent, quad[2], 1.0), length)
    code[2:] = quad_index.in_frame(frame, ray(detections.tangent, quad[3], 1.0), length)
    quad_index.arrange(code, quad)
    # 3. All cells within the gate of the code.
    gate = _code_gate(detections, quad, length)
    low = np.empty(4, np.int64)
    high = np.empty(4, np.int64)
    for axis in range(4):
        low[axis] = quad_index.code_cell(code[axis] - gate, axis)
        high[axis] = quad_index.code_cell(code[axis] + gate, axis)
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            for k in range(low[2], high[2] + 1):
                # The cells along the last axis are contiguous: one loop covers them.
                row = ((i * SIDE + j) * SIDE + k) * SIDE
                for q in range(quads.first[row + low[3]], quads.first[row + high[3] + 1]):
                    checks[0] += 1
                    if not _alike(quads.code, q, code, gate):
                        continue
                    # 4. and 5. Test the attitude of this quad.
                    checks[0] += star_search.EVALUATION_COST
                    stars = quads.star[q]
                    match = (quad[0], quad[1], stars[0], stars[1])
                    candidate = star_search.pair_hypothesis(
                        detections, sky, match, star_search.DECISIVE_DEX
                    )
                    if candidate.dex >= star_search.DECISIVE_DEX:
                        return candidate
    return no_hypothesis()


@jit
def _alike(codes: Floats, q: int, code: Floats, gate: float) -> bool:
    """Whether no coordinate of the code in row q of `codes` differs from `code` (4,) by more than the gate."""
    alike = True
    for axis in range(
        4
    ):  # without a temporary array, which would cost more than the comparison
        alike = alike and abs(codes[q, axis] - code[axis]) <= gate
    return alike


@inlined
def _longest_first(tangent: Floats, quad: Ints) -> None:
    """Reorder four detections in place, so that the first two are the ones farthest apart."""
    longest = -1.0
    first = 0
    second = 1
    for m in range(4):
        for k in range(m):
            # The pair (k, m) farthest apart so far.
            length = vectors.chord(ray(tangent, quad[k], 1.0), ray(tangent, quad[m], 1.0))
            if length > longest:
                longest = length
                first = k
                second = m
    quad[0], quad[first] = quad[first], quad[0]
    quad[1], quad[second] = quad[second], quad[1]


@inlined
def _code_gate(detections: Detections, quad: Ints, length: float) -> float:
    """Greatest difference of the codes of a quad of stars and of its image.

        gate = GATE_SIGMA s / L + u r^2 / (1 + r^2)

    Noise: the errors of C or D and of the two ends are each s / L, L the chord from A to B.

    Focal length: at the angle a from the boresight, a focal length that is wrong by the fraction u changes small
    angles by (1 - u) (1 + 2 u sin^2 a) along the radius and by (1 - u) (1 + u sin^2 a) across it. Ratios of angles
    differ by up to 2 u sin^2 a of the outermost star, sin^2 a = r^2 / (1 + r^2) for the tangent r. Coordinates of a
    code are at most one half along and across, so that half of this difference reaches them.

    Parameters
    ----------
    quad
        (4,) rows of the detections
    length
        Chord L

    Returns
    -------
    float
        In units of the code
    """
    sigma = 0.0
    r2 = 0.0
    for n in quad:
        sigma = max(sigma, detections.sigma[n])
        r2 = max(r2, detections.tangent[n, 0] ** 2 + detections.tangent[n, 1] ** 2)
    return GATE_SIGMA * sigma / length + detections.focal_uncertainty * r2 / (1 + r2)
