"""Covariance of a bundle adjustment: of total errors, or in a gauge by Baarda's S-transformation.

Only the diagonal blocks of lights and attitudes are computed, and the block of lever and lens.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, eigh, solve_triangular
from scipy.sparse import bsr_array

from estimator.calibration.bundle_adjustment import (
    Bundle,
    NormalEquations,
    ReducedSystem,
    eliminate_lights,
    free_gauge,
    gauge_freedoms,
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
    """Return the diagonal blocks of the inverse normal matrix: errors against the truth if a prior map fixes the gauge.

    Without a prior map only the penalty holds the gauge freedoms: see `covariance_in_gauge`.

    Raises
    ------
    LinAlgError
        If an unknown is undetermined.
    """
    return _blocks(*_inverse(terms, bundle), bundle)


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
    reduced = eliminate_lights(terms, free_gauge(bundle), 0.0)
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


def covariance_in_gauge(terms: NormalEquations, bundle: Bundle) -> Covariances:
    """Return the covariance in the gauge of the start map, without the error of the gauge itself.

    With the gauge freedoms Z and the linear gauge constraints H^T d = 0, any generalized inverse Q of the normal matrix
    becomes T Q T^T, T = I - Z (H^T Z)^-1 H^T (Baarda's S-transformation). Written out, with K = Q H (H^T Z)^-T and
    P = (H^T Z)^-1 H^T Q H (H^T Z)^-T, it is Q - K Z^T - Z K^T + Z P Z^T. Only diagonal blocks are computed:

    1. Invert the normal matrix by blocks: Q.
    2. Compute Q H, the covariance of all unknowns with the four constraints.
    3. Compute K and P.
    4. Add the terms of the gauge to each diagonal block.

    Raises
    ------
    LinAlgError
        If an unknown is undetermined.
    """
    # 1. Q
    led_free, rest_free = gauge_freedoms(bundle)
    reduced, rest = _inverse(terms, bundle)
    blocks = _blocks(reduced, rest, bundle)
    # 2. Q H; the constraints fix positions of lights alone
    fixed_led = gauge_constraints(bundle)
    rest_fixed = -rest @ (reduced.elimination.T @ fixed_led)
    led_fixed = reduced.inverse_led @ fixed_led - reduced.elimination @ rest_fixed
    # 3. K and P
    transform = np.linalg.inv(led_free.T @ fixed_led)  # (H^T Z)^-T
    k_led = led_fixed @ transform
    k_rest = rest_fixed @ transform
    outer = transform.T @ fixed_led.T @ led_fixed @ transform
    # 4. Diagonal blocks of lights, rotations, and lever and lens
    rotated = slice(3 * len(bundle.R_body_from_lab))
    shared = slice(rotated.stop, None)
    k_rotated = k_rest[rotated].reshape(-1, 3, 4)
    rotated_free = rest_free[rotated].reshape(-1, 3, 4)
    return Covariances(
        blocks.by_led
        + _gauge_terms(k_led.reshape(-1, 3, 4), led_free.reshape(-1, 3, 4), outer),
        blocks.by_rotation + _gauge_terms(k_rotated, rotated_free, outer),
        blocks.shared + _gauge_terms(k_rest[None, shared], rest_free[None, shared], outer)[0],
    )


def gauge_constraints(bundle: Bundle) -> Floats:
    """Return the (3 N, 4) matrix H of the four constraints H^T dx = 0 on the positions, linearized."""
    start_m = bundle.map_m
    by_led = np.zeros((len(start_m), 3, 4))
    # Rotation: sum((e x x_0) . dx) = 0 about each axis e.
    for axis, e in enumerate(np.eye(3)):
        by_led[:, :, axis] = np.cross(e, start_m)
    # Scale: sum(x_0 . dx) = 0.
    by_led[:, :, 3] = start_m
    return by_led.reshape(-1, 4)


def _inverse(terms: NormalEquations, bundle: Bundle) -> tuple[ReducedSystem, Floats]:
    """Return the reduced system and the (R, R) inverse of its Schur complement: the covariance of all but lights."""
    reduced = eliminate_lights(terms, free_gauge(bundle), 0.0)
    scale = reduced.scale
    return reduced, cho_solve(reduced.factor, np.eye(len(scale))) * scale * scale[:, None]


def _blocks(reduced: ReducedSystem, rest: Floats, bundle: Bundle) -> Covariances:
    """Return the diagonal blocks by block inversion: A^-1 + S Q S^T of the lights, S = A^-1 B, and Q of the rest."""
    lights = len(bundle.position_m)
    size = len(rest)
    frames = len(bundle.R_body_from_lab)
    elimination = reduced.elimination.toarray()  # S
    product = (elimination @ rest).reshape(lights, 3, size)
    by_led = np.einsum("nik,njk->nij", product, elimination.reshape(lights, 3, size))
    by_rotation = np.array(
        [rest[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(frames)]
    )
    shared = rest[3 * frames :, 3 * frames :]
    return Covariances(by_led + reduced.inverse_led.data, by_rotation, shared)


def _gauge_terms(with_gauge: Floats, free: Floats, outer: Floats) -> Floats:
    """Return the terms that the S-transformation adds to diagonal blocks: -K Z^T - Z K^T + Z P Z^T."""
    cross = with_gauge @ free.transpose(0, 2, 1)
    return free @ outer @ free.transpose(0, 2, 1) - cross - cross.transpose(0, 2, 1)
