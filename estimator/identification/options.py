"""What every identifier may be told beside the directions, the index and the tolerance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.core.arrays import Floats
from estimator.core.errors import ImageError


@dataclass(frozen=True, slots=True)
class Options:
    """The keywords of an identifier, the same for all: one that its method has no use for changes nothing.

    stretch       : added to the tolerance of an angle, times the angle
    zooms         : whether the stretch is one unknown focal length, for each pattern to measure; see `fixed_focal`
    max_triangles, max_checks : observed patterns tried, and angles compared, before giving up; the latter bounds
        the time, at some nanoseconds to tens of them each
    base_stars    : among how many of the brightest the patterns are sought
    missed_dex    : what a catalogue star that should be in the field and is not costs, in powers of ten; 0 where
        nobody knows how faint the camera sees, more where every light is known to shine
    field_tan     : (left, right, top, bottom) tangents of the field's edges, for missed_dex
    magnitude     : (N,) of the observed stars, in the index's scale; None where there is no such scale
    epsilon_mag   : its error, one standard deviation
    epsilon_sep_rad : that of an angle between two stars, where the method takes one
    boresight_ref : (3,) unit vector, where the optical axis is believed to point;  within_rad : and how nearly
    """

    stretch: float = 0.0
    zooms: bool = False
    max_triangles: int = 3000
    max_checks: int = 20_000_000
    base_stars: int = 20
    missed_dex: float = 0.0
    field_tan: tuple[float, float, float, float] = (-1.0, 1.0, -1.0, 1.0)
    magnitude: Floats | None = None
    epsilon_mag: float = np.inf
    epsilon_sep_rad: float | None = None
    boresight_ref: Floats | None = None
    within_rad: float = np.pi

    def fixed_focal(self, name: str) -> None:
        """Raises ImageError for a method whose angles are all it has, where the focal length is unknown."""
        if self.zooms:
            raise ImageError(
                f"{name}: the focal length is uncertain; allowed: a calibrated camera, or pyramid"
            )

    def light(self, count: int) -> Floats:
        """(N,) magnitudes of the observed stars, NaN where they are not known."""
        if self.magnitude is None:
            return np.full(count, np.nan)
        if np.shape(self.magnitude) != (count,):
            told = np.shape(self.magnitude)
            raise ImageError(f"magnitudes {told} of {count} observed stars; allowed: one for each")
        return np.ascontiguousarray(self.magnitude, dtype=float)
