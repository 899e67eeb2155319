"""Covariance of a bundle adjustment: of the errors against the truth.

Only the diagonal blocks of lights and attitudes are computed, and the block of lever and lens.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, eigh, solve_triangular
from scipy.sparse import bsr_array

from estimator.calibration.bundle_adjustment import (
    Bundle,
    NormalEquations,
    eliminate_lights,
)
from estimator.core.checks import Floats

COMMON = 3  # number of errors common to all lights, besides those of lever and lens


class Covariances(NamedTuple):
    """Diagonal blocks of the covariance.

    Attributes
    ----------
    by_led
        (N, 3, 3) covariance of each light's position, m^2, in the lab frame
    by_rotation
        (F, 3, 3) covariance of each attitude, rad^2, in body axes
    shared
        (3 + free_lens, 3 + free_lens) covariance of the lever and the free lens elements
    """

    by_led: Floats
    by_rotation: Floats
    shared: Floats


def covariance(terms: NormalEquations, bundle: Bundle) -> Covariances:
    """Return the diagonal blocks of the inverse normal matrix: A^-1 + S Q S^T of the lights, S = A^-1 B, Q of the rest.

    Raises
    ------
    LinAlgError
        If an unknown is undetermined.
    """
    # Q, the inverse of the scaled Schur complement: the covariance of all but the lights
    reduced = eliminate_lights(terms, 0.0)
    scale = reduced.scale
    rest = cho_solve(reduced.factor, np.eye(len(scale))) * scale * scale[:, None]
    size = len(rest)
    frames = len(bundle.R_body_from_lab)
    elimination = reduced.elimination.toarray()  # S
    product = (elimination @ rest).reshape(-1, 3, size)
    by_led = np.einsum("nik,njk->nij", product, elimination.reshape(-1, 3, size))
    by_rotation = np.array(
        [rest[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(frames)]
    )
    shared = rest[3 * frames :, 3 * frames :]
    return Covariances(by_led + reduced.inverse_led.data, by_rotation, shared)


def common_errors(terms: NormalEquations, bundle: Bundle) -> tuple[Floats, Floats]:
    """Return the errors that the lights share: changes by one standard deviation of each of M independent errors.

    These are (M, N, 3) of the positions, m, and (M, 3 + free_lens) of the lever and the free lens elements. All
    unknowns but the lights err by y = L z, with L L^T their covariance and z standard normal. The lights err by -S y,
    S = A^-1 B, and each by an independent error of covariance A^-1. A rotation of z changes no covariance (principal
    components: Jolliffe 2002, Principal Component Analysis, chapter 2):

    1. Compute L from the Cholesky factor.
    2. The first elements of z are those that change lever and lens.
    3. The next COMMON ones turn the directions of the lights from the bearing most: in general a rotation of the map.

    What the other elements add to the lights' own covariances is local. Taken as independent, it leaves 1 % of an
    attitude's variance out.
    """
    # 1. L
    reduced = eliminate_lights(terms, 0.0)
    unit = np.eye(len(reduced.scale))
    root = solve_triangular(reduced.factor[0], unit, trans="T", lower=True)
    root *= reduced.scale[:, None]
    # 2. Lever and lens
    shared = slice(3 * len(bundle.R_body_from_lab), None)
    first = np.linalg.qr(root[shared].T)[0]
    # 3. Directions of the lights
    radius_m = np.linalg.norm(bundle.position_m, axis=1)[:, None, None]
    along = (bundle.position_m / radius_m[:, 0])[:, :, None]
    start = np.arange(len(along) + 1)
    across = bsr_array(((np.eye(3) - along * along.mT) / radius_m, start[:-1], start))
    turned = across @ reduced.elimination
    others = root @ (unit - first @ first.T)
    variance = others.T @ (turned.T @ turned).toarray() @ others
    _, next_ = eigh(variance, subset_by_index=(len(unit) - COMMON, len(unit) - 1))
    change = root @ np.column_stack([first, next_])
    position_m = -(reduced.elimination @ change)
    return position_m.T.reshape(-1, len(along), 3), change[shared].T
