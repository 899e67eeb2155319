"""Solvers of Wahba's problem: the rotation that best maps reference vectors to observed ones, with its covariance.

Six methods, based on the compiled kernels in `estimator.attitude.wahba`, which has the equations. All but TRIAD
minimize sum(w |cam - A ref|^2), w = 1 / sigma^2, over all stars. Their results are refined by Gauss-Newton on the
vectors (`wahba.refine`), so that they agree to the last digits.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude import wahba as kernel
from estimator.core import checks
from estimator.core.checks import Floats
from estimator.core.vectors import quaternion_xyzw

Solver = Callable[..., Rotation]


def _solve_pair(
    refined: bool, vectors_cam: Floats, vectors_ref: Floats, sigma_rad: Floats
) -> Rotation:
    """Solve for the attitude of the best pair, and if wanted refine the solution on all vectors."""
    cam, ref, weight = _checked_arrays(vectors_cam, vectors_ref, sigma_rad)
    kernel.profile(cam, ref, weight)  # raises ValueError for unusable or parallel directions
    R_cam_from_ref = kernel.raw_triad(cam, ref, weight)
    if refined:
        kernel.refine(R_cam_from_ref, cam, ref, weight)
    return rotation(R_cam_from_ref)


triad = partial(_solve_pair, False)
"""Return cam_from_ref by TRIAD (Black 1964; in the form optimal for two stars, Markley 2002), from the best pair.

Of more than two stars it uses the pair with the smallest variance about the worst axis: two accurate stars that are
far apart (`wahba.best_pair`). The covariance is that of the pair: covariance(..., solver="triad"). Arguments and
errors are those of `quest`.
"""

least_squares = partial(_solve_pair, True)
"""Return cam_from_ref by Gauss-Newton on the vectors from TRIAD's solution. Arguments and errors as `quest`."""


def _solve_profile(
    raw: Callable[[Floats], Floats],
    vectors_cam: Floats,
    vectors_ref: Floats,
    sigma_rad: Floats,
) -> Rotation:
    """Solve the attitude profile with the method `raw`, then refine the solution on the vectors."""
    cam, ref, weight = _checked_arrays(vectors_cam, vectors_ref, sigma_rad)
    R_cam_from_ref = raw(kernel.profile(cam, ref, weight))
    kernel.refine(R_cam_from_ref, cam, ref, weight)
    return rotation(R_cam_from_ref)


davenport = partial(_solve_profile, kernel.raw_davenport)
"""Return cam_from_ref by Davenport's q-method, refined. Arguments and errors are those of `quest`."""

quest = partial(_solve_profile, kernel.raw_quest)
"""Return cam_from_ref by QUEST (Shuster & Oh 1981), refined by Gauss-Newton.

Parameters
----------
vectors_cam, vectors_ref
    (N, 3) unit vectors, N >= 2, in camera axes and in the reference frame
sigma_rad
    (N,) standard deviation of each direction per axis

Raises
------
ValueError
    For fewer than two directions, and for unusable numbers.
"""

esoq2 = partial(_solve_profile, kernel.raw_esoq2)
"""Return cam_from_ref by ESOQ2 (Mortari 1997), refined. Arguments and errors are those of `quest`."""

svd = partial(_solve_profile, kernel.raw_svd)
"""Return cam_from_ref by singular value decomposition (Markley 1988), refined. Arguments and errors as `quest`."""


SOLVERS: dict[str, Solver] = {
    "default": least_squares,
    "quest": quest,
    "triad": triad,
    "davenport": davenport,
    "esoq2": esoq2,
    "svd": svd,
    "least_squares": least_squares,
}


def _checked_arrays(
    vectors_cam: Floats, vectors_ref: Floats, sigma_rad: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the kernels' arguments: two (N, 3) arrays and (N,) weights, rad^-2. Raises ValueError for other shapes."""
    cam, ref, sigma = (
        checks.native("directions", one, np.float64)
        for one in (vectors_cam, vectors_ref, sigma_rad)
    )
    count = len(cam) if cam.ndim else 0
    if cam.shape != (count, 3) or ref.shape != (count, 3) or sigma.shape != (count,):
        raise ValueError(
            f"shapes {cam.shape}, {ref.shape}, {sigma.shape}; allowed: (N, 3), (N, 3), (N,)"
        )
    return cam, ref, kernel.weights(sigma)


def rotation(R_a_from_b: Floats) -> Rotation:
    """Convert a matrix that is a rotation to within rounding to a Rotation.

    The conversion uses the quaternion: Rotation.from_matrix orthogonalizes any matrix and takes four times as long.
    """
    return Rotation.from_quat(quaternion_xyzw(R_a_from_b))


def covariance(vectors_cam: Floats, sigma_rad: Floats, solver: str = "quest") -> Floats:
    """Return the (3, 3) covariance of the small rotation in camera axes: P = [sum((I - b b^T) / sigma^2)]^-1, rad^2.

    This is QUEST's measurement model (Shuster & Oh 1981, eq. 97), confirmed by Monte Carlo in the tests. It holds for
    all methods that use all stars; for TRIAD the sum is over its pair.

    Raises
    ------
    ValueError
        If the roll is unobservable.
    """
    cam, _, weight = _checked_arrays(vectors_cam, vectors_cam, sigma_rad)
    checks.unit_rows("vectors_cam", cam, None)
    checks.known("solver", solver, SOLVERS)
    if solver == "triad" and len(cam) > 2:
        pair = list(kernel.best_pair(cam, weight))
        cam = cam[pair]
        weight = weight[pair]
    return kernel.attitude_covariance(cam, weight)
