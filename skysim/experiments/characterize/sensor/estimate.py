"""A measured number with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import special

from skysim.core.types import Floats

SIGMAS_95 = 1.959964  # half of a normal 95 % interval in standard deviations
STEP = 1e-4  # of a slope's difference, in standard deviations


class Estimate(NamedTuple):
    """A value, its standard error, and its 95 % interval."""

    value: float
    sigma: float
    low: float
    high: float

    @classmethod
    def normal(cls, value: float, sigma: float) -> Estimate:
        """A normal estimate: value ± 1.96 sigma."""
        half = SIGMAS_95 * sigma
        return cls(float(value), float(sigma), float(value - half), float(value + half))

    @classmethod
    def lognormal(cls, value: float, sigma: float) -> Estimate:
        """An estimate of a positive number whose logarithm is normal, such as a standard deviation."""
        factor = math.exp(min(SIGMAS_95 * sigma / value, 50.0)) if value > 0 else 1.0
        return cls(float(value), float(sigma), float(value / factor), float(value * factor))

    @classmethod
    def logistic(cls, logit: float, sigma: float) -> Estimate:
        """An estimate of a fraction whose logit is normal."""
        low, value, high = (
            float(special.expit(logit + sign * SIGMAS_95 * sigma)) for sign in (-1, 0, 1)
        )
        return cls(value, value * (1 - value) * float(sigma), low, high)

    @classmethod
    def root(cls, variance: float, sigma: float) -> Estimate:
        """The square root of a variance, with the standard error of that; an interval from 0 if it is not above 0."""
        value = math.sqrt(max(variance, 0.0))
        low, high = (math.sqrt(max(variance + sign * SIGMAS_95 * sigma, 0.0)) for sign in (-1, 1))
        return cls(value, sigma / (2 * value) if value else high / SIGMAS_95, low, high)


def propagate(
    function: Callable[[Floats], float], at: Floats, covariance: Floats
) -> tuple[float, float]:
    """Value and standard error of a function of parameters, by central differences of a fraction of their errors."""
    step = STEP * np.sqrt(np.diag(covariance))
    slope = np.zeros(len(at))
    for n in np.flatnonzero(step > 0):
        moved = np.zeros(len(at))
        moved[n] = step[n]
        slope[n] = (function(at + moved) - function(at - moved)) / (2 * step[n])
    return float(function(at)), math.sqrt(max(float(slope @ covariance @ slope), 0.0))
