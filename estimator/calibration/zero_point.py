"""Photometric zero point: the offset between instrumental magnitudes and catalog magnitudes.

The instrumental magnitude of a star is -2.5 log10(flux / exposure). Its difference from the catalog's V is the zero
point plus the star's color term, which is unknown but constant.
"""

import numpy as np

from estimator.core import checks
from estimator.core.checks import Floats, frozen
from estimator.core.constants import SIGMA_PER_MAD
from estimator.core.errors import ImageError


@frozen
class MagnitudeZero:
    """Zero point: median over the stars of V minus the instrumental magnitude -2.5 log10(flux / exposure).

    Attributes
    ----------
    offset_mag
        Zero point
    sigma_mag
        Standard deviation of the zero point
    scatter_mag
        Standard deviation of one star about the zero point, mainly because of its color
    stars
        Number of different stars
    """

    offset_mag: float
    sigma_mag: float
    scatter_mag: float
    stars: int


def magnitude_zero(
    instrumental_mag: Floats, v_mag: Floats, vectors_ref: Floats
) -> MagnitudeZero:
    """Return the zero point: the median over different stars of each star's median difference.

    Colors are unknown and shift a star by some tenths of a magnitude, equally in every frame; therefore the sample is
    the N different stars, not the sightings. The scatter is s = 1.4826 times the median absolute deviation, and the
    standard deviation of the median is sqrt(pi / 2) s / sqrt(N). Leave out stars near the detection limit: only those
    with positive errors are detected, which biases the median.

    Parameters
    ----------
    instrumental_mag, v_mag
        (K,) instrumental and catalog magnitude of each sighting
    vectors_ref
        (K, 3) unit vector of each sighting's star; it identifies the star
    """
    checks.unit_rows("vectors_ref", vectors_ref, None)
    if not len(vectors_ref):
        raise ImageError("magnitude_zero: no stars; allowed: one or more")
    for name, values in (("instrumental_mag", instrumental_mag), ("v_mag", v_mag)):
        if not np.isfinite(checks.floats(name, values, (len(vectors_ref),))).all():
            raise ImageError(f"{name} has a NaN or infinity; allowed: finite")
    # Median of each star
    _, star = np.unique(vectors_ref, axis=0, return_inverse=True)
    star = np.ravel(star)
    difference = v_mag - instrumental_mag
    each = np.array([np.median(difference[star == k]) for k in range(star.max() + 1)])
    # Median of the stars
    offset = float(np.median(each))
    scatter = float(SIGMA_PER_MAD * np.median(np.abs(each - offset)))
    sigma = float(np.sqrt(np.pi / 2 / len(each))) * scatter
    return MagnitudeZero(offset, sigma, scatter, len(each))
