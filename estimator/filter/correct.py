"""Correction of the filter by a star tracker's solution.

1. Innovation: the residual of the solution against the filter's attitude, and its Mahalanobis distance (`innovation`).
2. Schmidt's update of the error state and its covariance (`correct`).
3. Reset: the attitude error is multiplied into the quaternion and set to zero (`correct`).

A solution that the filter adopts after a jump replaces the attitude instead (`adopt`).
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.checks import Floats
from estimator.filter.states import Layout, MekfState, of_head, rotate_quaternion, transition


class AttitudeFix(NamedTuple):
    """A star tracker's solution, at the time of a MekfState.

    Attributes
    ----------
    body_from_ref
        Measured attitude
    noise_rad2
        (3, 3) covariance of its small rotation error in body axes, without the part that
        solutions share
    systematic_rad2
        (3, 3) covariance of the slow error that it shares with other solutions of its head
    head
        Number of the star camera
    """

    body_from_ref: Rotation
    noise_rad2: Floats
    systematic_rad2: Floats
    head: int = 0


class Innovation(NamedTuple):
    """Residual of a solution, linearized: residual = H error + noise.

    Attributes
    ----------
    residual_rad
        (3,) rotation vector in body axes from the filter's attitude to the solution's
    H
        (3, N) derivative of the residual with respect to the filter's error
    noise_rad2
        (3, 3) covariance R of the noise
    distance2
        Squared Mahalanobis distance of the residual
    """

    residual_rad: Floats
    H: Floats
    noise_rad2: Floats
    distance2: float


def wxyz_of(body_from_ref: Rotation) -> Floats:
    """Return the (4,) quaternion of ref_from_body, scalar first, as the filter stores it."""
    return body_from_ref.inv().as_quat(scalar_first=True).copy()


def innovation(prior: MekfState, solution: AttitudeFix, layout: Layout) -> Innovation:
    """Return the residual of a solution against the state before it.

    The solution is truth exp(o + v) with the noise v and the offset o = mounting + L slow, where L L^T is the
    systematic covariance. With its estimated offset removed it is truth exp(do + v) = filter exp(residual), so the
    error of the filter is residual - J(residual)^-1 (do + v).

    1. Remove the estimated offset from the solution, and compute the residual rotation vector.
    2. Linearize: residual = H error + noise, with H = [I, J^-1 offsets] and noise J^-1 v.
    3. Compute the squared Mahalanobis distance of the residual, for the gate.

    The distance ignores the correlation between the filter's own error and the slow one. Both are nearly equal after
    many solutions, so the expected residual is small; but if the slow error changed faster than assumed, the gate
    would refuse correct solutions.
    """
    # 1. Residual
    offsets = offset_rows(solution, layout)
    measured = Rotation.from_rotvec(offsets @ prior.values) * solution.body_from_ref
    residual = (prior.body_from_ref * measured.inv()).as_rotvec()
    # 2. Linearization
    inverse = np.linalg.inv(right_jacobian(residual))
    H = inverse @ offsets
    H[:, :3] = np.eye(3)
    noise = inverse @ solution.noise_rad2 @ inverse.T
    # 3. Distance: the slow error's own part of the covariance, apart from that of all other states
    slow = layout.slices[of_head("systematic", solution.head)]
    apart = H.copy()
    apart[:, slow] = 0.0
    from_slow = H[:, slow] @ prior.covariance[slow, slow] @ H[:, slow].T
    spread = apart @ prior.covariance @ apart.T + from_slow + noise
    return Innovation(residual, H, noise, float(residual @ np.linalg.solve(spread, residual)))


def correct(prior: MekfState, found: Innovation, layout: Layout) -> MekfState:
    """Return the state after Schmidt's update (1966) in Joseph form, with the attitude error reset to zero.

    1. Gain K = P H^T (H P H^T + R)^-1, with the rows of the considered states set to 0. Their values and their
       covariance stay; their uncertainty enters the gain, and the covariance of the others through the correlations.
    2. Estimated error K residual.
    3. Covariance P <- (I - K H) P (I - K H)^T + K R K^T. This form holds for any gain, and P stays symmetric and
       positive.
    4. Reset: the attitude error is multiplied into the quaternion, and the covariance is transformed to the new
       attitude. From exp(error) exp(e) = exp(error + change) follows e = J(error) change.
    """
    H = found.H
    noise = found.noise_rad2
    # 1. Gain
    crossed = H @ prior.covariance
    gain = np.linalg.solve(crossed @ H.T + noise, crossed).T * layout.estimated[:, None]
    # 2. Error
    error = gain @ found.residual_rad
    # 3. Covariance
    joseph = np.eye(layout.size) - gain @ H
    covariance = joseph @ prior.covariance @ joseph.T + gain @ noise @ gain.T
    # 4. Reset
    jacobian = right_jacobian(error[:3])
    covariance[:3] = jacobian @ covariance[:3]
    covariance[:, :3] = covariance[:, :3] @ jacobian.T
    wxyz = prior.ref_from_body_wxyz.copy()
    values = prior.values + error
    rotate_quaternion(wxyz, error[:3])
    values[:3] = 0.0
    return prior._replace(
        ref_from_body_wxyz=wxyz,
        values=values,
        covariance=(covariance + covariance.T) / 2,
        lost_rad=0.0,
        used_s=prior.t_s,
        used_wxyz=wxyz,
        # A solution that follows a lost rotation determines the attitude alone.
        support=1 if prior.lost_rad > 0 else prior.support + 1,
    )


def adopt(
    prior: MekfState,
    solution: AttitudeFix,
    layout: Layout,
    bias_variance: Floats,
    support: int,
) -> MekfState:
    """Return the state that adopts a solution: its attitude and covariance, and the filter's other states.

    The attitude error is then -(do + v), with the names of `innovation`: it is correlated with the errors of the
    offset's states. The variance of the bias is increased, as a wrong bias may have been the cause.
    """
    offsets = offset_rows(solution, layout)
    wxyz = wxyz_of(Rotation.from_rotvec(offsets @ prior.values) * solution.body_from_ref)
    # Covariance of -(do + v) with the other states, and its own
    covariance = prior.covariance.copy()
    covariance[:3] = -offsets @ prior.covariance
    covariance[:, :3] = covariance[:3].T
    covariance[:3, :3] = offsets @ prior.covariance @ offsets.T + solution.noise_rad2
    # The old attitude may have been wrong because of the bias.
    covariance[layout.slices["bias"], layout.slices["bias"]] += np.diag(bias_variance)
    return prior._replace(
        ref_from_body_wxyz=wxyz,
        covariance=covariance,
        lost_rad=0.0,
        used_s=prior.t_s,
        used_wxyz=wxyz,
        support=support,
    )


def offset_rows(solution: AttitudeFix, layout: Layout) -> Floats:
    """Return the (3, N) matrix that maps the states to a solution's offset: mounting + L times the slow error."""
    offsets = np.zeros((3, layout.size))
    offsets[:, layout.slices[of_head("systematic", solution.head)]] = root(
        solution.systematic_rad2
    )
    # The mounting of a further head is relative to that of the first one.
    for head in {0, solution.head}:
        if mounting := layout.slices.get(of_head("mounting", head)):
            offsets[:, mounting] = np.eye(3)
    return offsets


def right_jacobian(rotation_rad: Floats) -> Floats:
    """Return the (3, 3) right Jacobian J(p) of SO(3), as in AttitudeFilter's docstring."""
    rows = np.empty((3, 6))
    transition(rotation_rad, -1.0, rows)
    return rows[:, 3:]


def root(covariance: Floats) -> Floats:
    """Return the (..., 3, 3) symmetric roots L of covariances.

    The symmetric root is continuous in the covariance, so the slow error of successive solutions is too.
    """
    if not covariance.any():
        return np.zeros_like(covariance)
    variances, axes = np.linalg.eigh(covariance)
    return axes * np.sqrt(np.maximum(variances, 0.0))[..., None, :] @ axes.mT
