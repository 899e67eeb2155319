"""Searches of the star tracker: error models and efforts, tried in turn until one gives an attitude."""

from typing import NamedTuple

from estimator.identification.star_search import WRONG_FOCAL

# Least centroid error of a star, for a calibrated lens and the catalog's positions
MIN_ERROR_PX = 0.005

# Largest error of an uncertain focal length, in units of the uncertainty that was given: users give round numbers.
FOCAL_MARGIN = 1.1


class SearchModel(NamedTuple):
    """Error model and effort of one search.

    Attributes
    ----------
    min_error_px
        Least centroid error
    relative_error
        Additional error, as a fraction of the distance from the principal point
    max_checks
        Bound on the effort; 50,000 take about 0.01 s
    by_quads
        Whether quads are searched in place of pairs
    focal_uncertainty
        Relative uncertainty of the focal length, if it is larger than that of the tracker
    aspect
        Assumed width over height of a pixel, relative to the camera's
    """

    min_error_px: float
    relative_error: float
    max_checks: int
    by_quads: bool = False
    focal_uncertainty: float = 0.0
    aspect: float = 1.0


WRONG_FOCAL_SEARCH = SearchModel(MIN_ERROR_PX, 0.0, 40_000, True, WRONG_FOCAL)
# Of a frame that is refused: whether it would be solved with another focal length
WRONG_SCALE_SEARCH = SearchModel(MIN_ERROR_PX, 0.0, 10_000, True, 0.4)
# Short searches for each way in which a frame can be unlike its model, and then longer ones
CALIBRATED_SEARCHES = (
    SearchModel(MIN_ERROR_PX, 0.0, 600),
    SearchModel(MIN_ERROR_PX, 0.0, 1_500, True, WRONG_FOCAL),
    SearchModel(0.5, 0.0, 600),
    SearchModel(MIN_ERROR_PX, 0.0, 15_000),
    WRONG_FOCAL_SEARCH,
    # A wrong camera model: `lens_fit` then extends the match.
    SearchModel(0.5, 0.003, 10_000),
    SearchModel(MIN_ERROR_PX, 0.0, 25_000),
)
# Of a deep sky, whose separations have hundreds of candidates
DEEP_SEARCHES = (WRONG_FOCAL_SEARCH._replace(max_checks=150_000), *CALIBRATED_SEARCHES)
UNCALIBRATED_SEARCHES = (
    SearchModel(MIN_ERROR_PX, 0.0, 10_000, True),
    SearchModel(MIN_ERROR_PX, 0.0, 100_000, True),
    SearchModel(0.5, 0.0, 100_000, True),
    SearchModel(1.0, 0.005, 100_000, True),
    SearchModel(2.0, 0.01, 100_000, True),
    *(SearchModel(1.0, 0.01, 50_000, True, aspect=ratio) for ratio in (0.93, 1.07)),
    SearchModel(0.5, 0.0, 100_000),
    SearchModel(1.0, 0.005, 200_000),
    SearchModel(2.0, 0.01, 100_000),
)
# Searches for an unknown field of view.
QUAD_SEARCHES = tuple(model for model in UNCALIBRATED_SEARCHES if model.by_quads)
