"""From a star's brightness in the image to its magnitude in the catalogue: the offset between the two scales."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.core.arrays import Floats


@dataclass(frozen=True, slots=True)
class MagnitudeZero:
    """V - instrumental magnitude, where that is -2.5 log10(flux / exposure): the median over the stars.

    sigma_mag   : of the offset;  scatter_mag : of one star about it, its colour above all;  stars : different ones
    """

    offset_mag: float
    sigma_mag: float
    scatter_mag: float
    stars: int


def magnitude_zero(instrumental_mag: Floats, v_mag: Floats, vectors_ref: Floats) -> MagnitudeZero:
    """The magnitudes' offset as the median over different stars, each the median of its sightings.

    Colours are not known, and put a star off by some tenths of a magnitude, the same in every frame: the scatter is
    1.4826 times the median deviation, and the median's error sqrt(pi / 2) of the scatter over the root of the number
    of stars. Stars near the detection limit should be left out: of them the too bright are seen, the others not.
    """
    _, star = np.unique(vectors_ref, axis=0, return_inverse=True)
    star = np.ravel(star)
    difference = v_mag - instrumental_mag
    each = np.array([np.median(difference[star == k]) for k in range(star.max() + 1)])
    offset = float(np.median(each))
    scatter = float(1.4826 * np.median(np.abs(each - offset)))
    return MagnitudeZero(offset, float(np.sqrt(np.pi / 2 / len(each))) * scatter, scatter, len(each))
