"""Optional parameters common to all identification methods.

The published methods need different things: a magnitude, a prior direction, a tolerance. All are called with the same
keywords, of which each method uses some, so that one method can replace another.
"""

import numpy as np

from estimator.core.checks import Floats, Ints, frozen
from estimator.core.errors import ImageError

ACCEPTANCES = ("evidence", "thesis")


@frozen
class Options:
    """Keyword arguments of an identifier. A method ignores those that it does not use.

    Attributes
    ----------
    stretch
        Relative tolerance of an angle: stretch * angle is added to its tolerance
    focal_unknown
        Whether the stretch is one unknown focal length, which each pattern measures; see `require_known_focal`
    max_triangles
        Greatest number of observed patterns tried
    max_checks
        Greatest number of angles compared. It bounds the time: a comparison takes nanoseconds to tens of nanoseconds
    base_stars
        Number of brightest stars from which patterns are formed
    missed_dex
        Penalty for each catalog star that is predicted in the field and not observed, in powers of ten; 0 if the
        detection limit is unknown, greater if all sources are known to be on
    field_tan
        (left, right, top, bottom) tangents of the field's edges, for missed_dex
    magnitude
        (N,) magnitudes of the observed stars, on the index's scale; None if unknown
    epsilon_mag
        Standard deviation of a magnitude
    boresight_ref
        (3,) unit vector, prior direction of the optical axis in the catalog's frame
    within_rad
        Greatest error of that direction
    acceptance
        One of ACCEPTANCES: `evidence` accepts a match that is significant against chance, `thesis` one that the
        method's own paper would accept. Its log10_chance is then NaN, as it has not been tested
    cos_error
        Greatest difference of the cosines of two angles that agree, for methods that use it; None: from the tolerance
    compared
        (1,) count of the angles compared, to which a method that counts them adds its own; None: not counted
    """

    stretch: float = 0.0
    focal_unknown: bool = False
    max_triangles: int = 3000
    max_checks: int = 20_000_000
    base_stars: int = 20
    missed_dex: float = 0.0
    field_tan: tuple[float, float, float, float] = (-1.0, 1.0, -1.0, 1.0)
    magnitude: Floats | None = None
    epsilon_mag: float = np.inf
    boresight_ref: Floats | None = None
    within_rad: float = np.pi
    acceptance: str = "evidence"
    cos_error: float | None = None
    compared: Ints | None = None

    @property
    def by_paper(self) -> bool:
        """Whether the paper's own rule accepts a match, without a test against chance."""
        return self.acceptance == "thesis"

    @staticmethod
    def require_tolerance(name: str, tolerance_rad: float) -> None:
        """Raise ImageError unless the tolerance of method `name` is positive."""
        if not tolerance_rad > 0:
            raise ImageError(f"{name}: tolerance {tolerance_rad} rad; allowed: more than 0")

    def require_known_focal(self, name: str) -> None:
        """Raise ImageError if the focal length is uncertain, as method `name` needs calibrated angles."""
        if self.focal_unknown:
            raise ImageError(
                f"{name}: the focal length is uncertain; allowed: a calibrated camera, or pyramid"
            )

    def magnitudes(self, count: int) -> Floats:
        """Return (N,) magnitudes of the observed stars, NaN if unknown. Raises ImageError for another shape."""
        if self.magnitude is None:
            return np.full(count, np.nan)
        if np.shape(self.magnitude) != (count,):
            raise ImageError(
                f"magnitudes {np.shape(self.magnitude)} of {count} observed stars; allowed: one for each"
            )
        return np.ascontiguousarray(self.magnitude, dtype=float)
