"""Correction of the filter by a star tracker's solution: innovation, Schmidt's update, reset of the error state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.checks import Floats
from estimator.filter.states import Layout, MekfState, of_head, rotate_quaternion, transition


class AttitudeFix(NamedTuple):
    """A star tracker's solution, at the time of a State.

    Attributes
    ----------
    noise_rad2
        (3, 3) covariance of its small rotation error in body axes, without what solutions share
    systematic_rad2
        (3, 3) covariance of the slow error that it shares with others of its head
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
        (3, N)
    noise_rad2
        (3, 3) covariance of the noise
    distance2
        Squared Mahalanobis distance of the residual
    """

    residual_rad: Floats
    H: Floats
    noise_rad2: Floats
    distance2: float


def wxyz_of(body_from_ref: Rotation) -> Floats:
    """(4,) quaternion of the inverse, scalar first: as the filter stores it."""
    return body_from_ref.inv().as_quat(scalar_first=True).copy()


def innovation(prior: MekfState, solution: AttitudeFix, layout: Layout) -> Innovation:
    """Residual of a solution against the state before it.

    The solution is truth exp(o + v) with the noise v and the offset o = mounting + L slow, where L L^T is the
    systematic covariance. With its estimated offset removed it is truth exp(do + v) = filter exp(residual), so the
    error of the filter is residual - J(residual)^-1 (do + v).

    The distance does not credit the correlation between the filter's own error and the slow one. Both are nearly equal
    after many solutions, so the expected residual is small; but if the slow error changed faster than
    assumed, the gate would refuse correct solutions.
    """
    slow = layout.slices[of_head("systematic", solution.head)]
    offsets = offset_rows(solution, layout)
    measured = Rotation.from_rotvec(offsets @ prior.values) * solution.body_from_ref
    residual = (prior.body_from_ref * measured.inv()).as_rotvec()
    inverse = np.linalg.inv(right_jacobian(residual))
    H = inverse @ offsets
    H[:, :3] = np.eye(3)
    noise = inverse @ solution.noise_rad2 @ inverse.T
    apart = H.copy()
    apart[:, slow] = 0.0
    spread = (
        apart @ prior.covariance @ apart.T
        + H[:, slow] @ prior.covariance[slow, slow] @ H[:, slow].T
        + noise
    )
    return Innovation(residual, H, noise, float(residual @ np.linalg.solve(spread, residual)))


def correct(prior: MekfState, found: Innovation, layout: Layout) -> MekfState:
    """Schmidt's update (1966) in Joseph form; the attitude error is then multiplied into the quaternion.

    The gain is Kalman's with the rows of the considered states set to 0: their values and their covariance stay, and
    their uncertainty is in the gain and in the covariance of the others through the correlations.
    """
    H = found.H
    noise = found.noise_rad2
    crossed = H @ prior.covariance
    gain = np.linalg.solve(crossed @ H.T + noise, crossed).T * layout.estimated[:, None]
    error = gain @ found.residual_rad
    # Joseph form, (I - K H) P (I - K H)^T + K R K^T, holds for any gain, and stays symmetric and positive.
    joseph = np.eye(layout.size) - gain @ H
    covariance = joseph @ prior.covariance @ joseph.T + gain @ noise @ gain.T
    # Reset of the error state: exp(error) exp(e) = exp(error + change) gives e = J(error) change.
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
    prior: MekfState, solution: AttitudeFix, layout: Layout, bias_variance: Floats, support: int
) -> MekfState:
    """The state that a solution alone gives: its attitude and covariance, and the filter's other states.

    The error is then -(do + v), correlated with the offset's. The variance of the bias is increased, as a wrong bias
    may have been the cause.
    """
    offsets = offset_rows(solution, layout)
    wxyz = wxyz_of(Rotation.from_rotvec(offsets @ prior.values) * solution.body_from_ref)
    covariance = prior.covariance.copy()
    covariance[:3] = -offsets @ prior.covariance
    covariance[:, :3] = covariance[:3].T
    covariance[:3, :3] = offsets @ prior.covariance @ offsets.T + solution.noise_rad2
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
    """(3, N) the offset of a solution from the states: its mounting, and L times the normalized slow error."""
    offsets = np.zeros((3, layout.size))
    offsets[:, layout.slices[of_head("systematic", solution.head)]] = root(solution.systematic_rad2)
    for head in {0, solution.head}:
        if mounting := layout.slices.get(of_head("mounting", head)):
            offsets[:, mounting] = np.eye(3)
    return offsets


def right_jacobian(rotation_rad: Floats) -> Floats:
    """(3, 3) J(p) of AttitudeFilter's docstring: the right Jacobian of SO(3)."""
    rows = np.empty((3, 6))
    transition(rotation_rad, -1.0, rows)
    return rows[:, 3:]


def root(covariance: Floats) -> Floats:
    """The symmetric root of a covariance (3, 3), which is continuous in it: so is the slow error of solutions."""
    if not covariance.any():
        return np.zeros((3, 3))
    variances, axes = np.linalg.eigh(covariance)
    return (axes * np.sqrt(np.maximum(variances, 0.0))) @ axes.T
