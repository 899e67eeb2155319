"""Two-sample test of pixel histograms."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

LEAST_COUNT = 20  # of both samples in a bin


def histogram_p(first: NDArray[Any], second: NDArray[Any]) -> float:
    """P-value of chi-square that both have one distribution, with neighboring values merged to LEAST_COUNT."""
    values, index = np.unique(np.concatenate([first, second]), return_inverse=True)
    counts = np.stack(
        [np.bincount(half, minlength=len(values)) for half in np.split(index, [len(first)])]
    )
    groups = np.cumsum(counts.sum(axis=0)) // LEAST_COUNT
    merged = np.stack([np.bincount(groups, weights=one) for one in counts])
    return float(stats.chi2_contingency(merged[:, merged.sum(axis=0) > 0]).pvalue)
