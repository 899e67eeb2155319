"""Star identification algorithms by name.

Each is a function of rays, a pair index and a tolerance that returns the match or None; `options.Options` has its
keywords. The tracker verifies what a method answers with the whole field (`trackers.residuals.refinement`).
"""

from __future__ import annotations

from collections.abc import Callable

from estimator.core.types import StarMatch
from estimator.identification.published.fialho import VERSIONS
from estimator.identification.published.master_star import master_star
from estimator.identification.published.pyramid import pyramid
from estimator.identification.published.saa import saa
from estimator.identification.published.shefex import shefex

Identifier = Callable[..., StarMatch | None]

# StarTracker does not look up `default`: it uses identification/stars/search.py. The entry is for direct callers.
IDENTIFIERS: dict[str, Identifier] = {
    "default": pyramid,
    "pyramid": pyramid,
    "saa": saa,
    "shefex": shefex,
    "master_star": master_star,
    **VERSIONS,
}
