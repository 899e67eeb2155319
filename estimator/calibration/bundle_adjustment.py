"""Bundle adjustment for a camera that rotates about a fixed center: model, derivatives, least squares, covariance.

The pixel of light i in frame k is p = c + f d(q_x / q_z, q_y / q_z), q = C (A_k x_i - r): light x_i and lever r from
the bearing center, A_k = body_from_lab, C = cam_from_body, d the Brown-Conrady distortion. The unknowns are the
positions x_i, small rotations of the A_k, the lever r and the lens; C is fixed. `adjust` minimizes the loss of the
residuals (p_measured - p) / sigma by Levenberg-Marquardt:

1. Linearize: residuals e and Jacobian J by lights, rotations, lever and lens (`linearize`).
2. Sum the normal equations J^T W J d = J^T W e, with Cauchy's weights W, which down-weight wrong identifications, and
   with the priors (`Bundle.equations`).
3. Damp the diagonal and eliminate the lights (`eliminate_lights`). Lights are coupled to one another only through
   frames, so each light's 3 x 3 block is eliminated by the Schur complement, and a dense system of frames, lever and
   lens remains (Triggs et al. 2000, Bundle adjustment: a modern synthesis, section 6).
4. Solve for frames, lever and lens, and substitute back for the lights (`step`).
5. Accept the step and reduce the damping if the loss falls; otherwise increase the damping.
6. Stop when the Newton decrement, the squared step in standard deviations, is negligible.

Afterwards `survey_subset.covariance` computes the covariance.

Measured on AFIT's dome (892 lights, 600 frames): 14 such steps converge to a cost of 1.1e4. scipy's least_squares
with the same sparse Jacobian and lsmr, whose steps are inexact, had only reduced the cost from 5.4e8 to 4.1e8 after
12 evaluations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array, csr_array, hstack
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.attitude.rotation_fit import tangent_gradients
from estimator.core.camera import Camera, distorted, distortion_slopes
from estimator.core.checks import Floats, Ints, frozen

# Newton decrement g^T N^-1 g at convergence: the squared step in standard deviations. It is small enough for a
# relative accuracy of 1e-9 in lengths.
DECREMENT = 1e-12
STEPS = 100
# Least standard deviation of an assumed lever, in m, and of an assumed focal length, relative to it.
EXACT = 1e-6
# Median distance of a two-dimensional unit Gaussian from its mean.
MEDIAN_RADIUS = np.sqrt(2 * np.log(2))


@frozen
class Sightings:
    """Observations of M lights in all frames.

    Attributes
    ----------
    frame, led
        (M,) row of the frame, and of the light
    xy_px
        (M, 2) centroid
    sigma_px
        (M,) standard deviation of each coordinate
    """

    frame: Ints
    led: Ints
    xy_px: Floats
    sigma_px: Floats

    @classmethod
    def of(cls, frames: Sequence[Any], led: Ints) -> Sightings:
        """Return the sightings in frames with `xy_px` and `sigma_px`; led: (M,) rows of their lights."""
        frame = np.repeat(np.arange(len(frames)), [len(one.xy_px) for one in frames])
        xy_px, sigma_px = (
            np.concatenate([getattr(one, name) for one in frames])
            for name in ("xy_px", "sigma_px")
        )
        return cls(frame, led, xy_px, sigma_px)

    @property
    def in_frames(self) -> Ints:
        """(M, 2) frame of each sighting and its number in the frame, where the frames are in order."""
        first = np.searchsorted(self.frame, self.frame)
        return np.column_stack([self.frame, np.arange(len(self.frame)) - first])

    def take(self, which: np.ndarray) -> Sightings:
        """Select sightings by mask or index."""
        return Sightings(
            self.frame[which], self.led[which], self.xy_px[which], self.sigma_px[which]
        )


class Assumed(NamedTuple):
    """Lever and focal length as they are known without the frames; they enter the adjustment as measurements.

    Attributes
    ----------
    camera_body_m
        (3,) entrance pupil in the body frame
    lever_sigma_m
        Standard deviation of its position along each axis
    focal_px, focal_sigma_px
        Focal length and its standard deviation
    """

    camera_body_m: Floats
    lever_sigma_m: float
    focal_px: float
    focal_sigma_px: float

    def less(self, bundle: Bundle) -> Floats:
        """Return the (4,) difference of lever and focal length from those of a bundle."""
        lever_m = self.camera_body_m - bundle.camera_body_m
        return np.array([*lever_m, self.focal_px - bundle.lens[0]])

    @property
    def weight(self) -> Floats:
        """(4,) weights 1 / sigma^2 of lever and focal length; sigma is at least EXACT, so that they are finite."""
        lever_m = max(self.lever_sigma_m, EXACT)
        focal_px = max(self.focal_sigma_px, EXACT * self.focal_px)
        return np.array([lever_m, lever_m, lever_m, focal_px]) ** -2.0


@frozen
class Bundle:
    """Parameters of the model, on which the pixels depend, and their priors.

    Attributes
    ----------
    position_m
        (N, 3) positions of the lights in the lab frame
    R_body_from_lab
        (F, 3, 3) attitudes
    camera_body_m
        (3,) entrance pupil in the body frame
    R_cam_from_body
        (3, 3) mounting of the camera, fixed: rotating it is equivalent to rotating every
        body_from_lab and the lever
    lens
        (8,) focal_px, center x and y in px, k1, k2, p1, p2, k3
    free_lens
        The first free_lens elements of `lens` are unknowns
    map_m, map_sigma_m
        (N, 3) prior positions of the lights, and their standard deviation per axis; inf for no
        prior
    assumed
        Prior lever and focal length; None for no prior
    """

    position_m: Floats
    R_body_from_lab: Floats
    camera_body_m: Floats
    R_cam_from_body: Floats
    lens: Floats
    free_lens: int
    map_m: Floats
    map_sigma_m: float = np.inf
    assumed: Assumed | None = None

    @classmethod
    def start(
        cls, leds: LedMap, lever: Lever, camera: Camera, attitudes: Rotation, distortion: bool
    ) -> Bundle:
        """Start values without priors; free of the lens are focal length and center, and with `distortion` k1 to p2."""
        return cls(
            leds.position_m,
            attitudes.as_matrix().reshape(-1, 3, 3),
            np.array(lever.camera_body_m),
            lever.cam_from_body.as_matrix(),
            camera.lens,
            7 if distortion else 3,
            leds.position_m,
        )

    def cost(self, sightings: Sightings, width: float) -> tuple[float, Floats]:
        """Return the total loss of pixels and priors, and the (M,) robust weights of the sightings.

        Parameters
        ----------
        width
            Width of Cauchy's loss in sigmas; inf for least squares
        """
        loss, weight = cauchy(np.sum(residuals(self, sightings) ** 2, axis=1), width)
        # Priors of the map, of lever and focal length
        loss += float(np.sum(((self.map_m - self.position_m) / self.map_sigma_m) ** 2))
        if self.assumed:
            loss += float(np.sum(self.assumed.weight * self.assumed.less(self) ** 2))
        return loss, weight

    def equations(self, sightings: Sightings, weight: Floats) -> NormalEquations:
        """Return the normal equations: J^T W J and J^T W e of the pixels, plus the priors.

        The lights are the unknowns in separate blocks.
        A prior x ~ N(x_0, sigma^2) adds 1 / sigma^2 to the diagonal and (x_0 - x) / sigma^2 to the right-hand side.

        Parameters
        ----------
        weight
            (M,) robust weight W of each sighting
        """
        # Steps 1 and 2 of the module. Rows of the Jacobian and residuals are multiplied by the root of the weight.
        terms = linearize(self, sightings)
        root = np.sqrt(weight)[:, None, None]
        count = len(weight)
        frames = len(self.R_body_from_lab)
        lights = len(self.position_m)
        by_led = _block_matrix(terms.by_led * root, sightings.led, 3 * lights)
        by_rotation = _block_matrix(terms.by_rotation * root, sightings.frame, 3 * frames)
        shared = (terms.by_shared * root).reshape(2 * count, -1)
        by_rest = hstack([by_rotation, csr_array(shared)], format="csr")
        residual = (terms.residual * root[:, 0]).ravel()
        # The lights' own normal matrix is block diagonal, so that only its blocks are accumulated.
        products = np.einsum("mai,maj->mij", terms.by_led, terms.by_led) * root**2
        blocks = summed(products, sightings.led, lights)
        rest = (by_rest.T @ by_rest).toarray()
        rhs_rest = by_rest.T @ residual
        # Prior of the map
        blocks += np.eye(3) / self.map_sigma_m**2
        from_map = (self.map_m - self.position_m).ravel() / self.map_sigma_m**2
        # Prior of lever and focal length, which follow the rotations
        if self.assumed:
            known = 3 * frames + np.arange(4)
            rest[known, known] += self.assumed.weight
            rhs_rest[known] += self.assumed.weight * self.assumed.less(self)
        coupling = csr_array(by_rest.T @ by_led)
        return NormalEquations(
            blocks, coupling, rest, by_led.T @ residual + from_map, rhs_rest
        )

    def apply_step(self, led: Floats, rest: Floats) -> Bundle:
        """Return the bundle after a step.

        Parameters
        ----------
        led
            (3 N,) changes of the positions, m; (3,) of all alike
        rest
            (R,) 3 F components of small rotations in body axes (rad), 3 changes of the lever (m),
            changes of the free lens elements
        """
        rotation_size = 3 * len(self.R_body_from_lab)
        lens = self.lens.copy()
        lens[: self.free_lens] += rest[rotation_size + 3 :]
        rotation = Rotation.from_rotvec(rest[:rotation_size].reshape(-1, 3)).as_matrix()
        return replace(
            self,
            position_m=self.position_m + led.reshape(-1, 3),
            R_body_from_lab=rotation @ self.R_body_from_lab,
            camera_body_m=self.camera_body_m + rest[rotation_size : rotation_size + 3],
            lens=lens,
        )


class Linearization(NamedTuple):
    """Residuals and Jacobian, both divided by sigma_px.

    Attributes
    ----------
    residual
        (M, 2) measured minus predicted pixel
    by_led, by_rotation
        (M, 2, 3) derivatives of the pixel with respect to the light's position (m) and to a small
        rotation in body axes (rad)
    by_shared
        (M, 2, 3 + free_lens) derivatives with respect to the lever and the free lens elements
    """

    residual: Floats
    by_led: Floats
    by_rotation: Floats
    by_shared: Floats


def residuals(bundle: Bundle, sightings: Sightings) -> Floats:
    """Return the (M, 2) measured minus predicted pixels, divided by sigma_px; inf for a light behind the camera."""
    q = _in_camera(bundle, sightings)[1]
    in_front = q[:, 2] > 0
    tangent = q[:, :2] / np.where(in_front, q[:, 2], 1.0)[:, None]
    distorted_tangent = distorted(tangent, tuple(bundle.lens[3:].tolist()))
    pixel = bundle.lens[1:3] + bundle.lens[0] * distorted_tangent
    residual = (sightings.xy_px - pixel) / sightings.sigma_px[:, None]
    return np.where(in_front[:, None], residual, np.inf)


def linearize(bundle: Bundle, sightings: Sightings) -> Linearization:
    """Compute residuals and analytic derivatives; every light must be in front of the camera.

    With b = A x in body axes, the tangent t of q = C (b - r), and the 2 x 3 matrix
    E = f (dd/dt) [[1/q_z, 0, -q_x/q_z^2], [0, 1/q_z, -q_y/q_z^2]] C, the derivatives of the pixel are

        E A by the position x,  E (-[b]x) by the rotation w (A <- exp([w]) A),  -E by the lever r,
        d(t) by f,  I by the principal point c,  f dd/dk by the distortion's coefficients.
    """
    b, q = _in_camera(bundle, sightings)
    tangent = q[:, :2] / q[:, 2:]
    focal = bundle.lens[0]
    distortion = tuple(bundle.lens[3:].tolist())
    distorted_tangent = distorted(tangent, distortion)
    # E, divided by sigma
    pinhole = tangent_gradients(q)
    weight = 1 / sightings.sigma_px[:, None, None]
    by_tangent, by_coefficients = distortion_slopes(tangent, distortion)
    by_body = focal * weight * (by_tangent @ pinhole @ bundle.R_cam_from_body)
    # Derivatives by all eight elements of the lens; only the first are unknowns.
    by_center = np.tile(np.eye(2), (len(q), 1, 1))
    by_lens = np.concatenate(
        [distorted_tangent[:, :, None], by_center, focal * by_coefficients], axis=2
    )
    error_px = sightings.xy_px - bundle.lens[1:3] - focal * distorted_tangent
    return Linearization(
        error_px / sightings.sigma_px[:, None],
        by_body @ bundle.R_body_from_lab[sightings.frame],
        np.cross(b[:, None, :], by_body),  # d . (w x b) = w . (b x d)
        np.concatenate([-by_body, weight * by_lens[:, :, : bundle.free_lens]], axis=2),
    )


def _in_camera(bundle: Bundle, sightings: Sightings) -> tuple[Floats, Floats]:
    """Return the vectors to the observed LEDs: b from the bearing center in body axes, q from the pupil in camera axes.

    Both are (M, 3), one row for each sighting.
    """
    rotation = bundle.R_body_from_lab[sightings.frame]
    b = np.einsum("mij,mj->mi", rotation, bundle.position_m[sightings.led])
    return b, (b - bundle.camera_body_m) @ bundle.R_cam_from_body.T


class NormalEquations(NamedTuple):
    """Normal equations, with lights and the R other unknowns (rotations, lever, lens) in separate blocks.

    Attributes
    ----------
    by_led
        (N, 3, 3) diagonal blocks of the lights; all others between lights are 0
    coupling
        (R, 3 N) sparse block between the other unknowns and the lights
    rest
        (R, R) block of the other unknowns
    rhs_led, rhs_rest
        (3 N,) and (R,) right-hand sides
    """

    by_led: Floats
    coupling: csr_array
    rest: Floats
    rhs_led: Floats
    rhs_rest: Floats


def summed(parts: Floats, row: Ints, count: int) -> Floats:
    """Return the (count, ...) sums of the (M, ...) parts that belong to each row."""
    total = np.zeros((count, *parts.shape[1:]))
    np.add.at(total, row, parts)
    return total


def _block_matrix(blocks: Floats, column: Ints, width: int) -> csr_array:
    """Return a sparse (2 M, width) matrix of (M, 2, 3) blocks: block m begins at row 2 m, column 3 column[m]."""
    start = np.arange(len(blocks) + 1)
    return csr_array(bsr_array((blocks, column, start), shape=(2 * len(blocks), width)))


class ReducedSystem(NamedTuple):
    """Reduced system after elimination of the lights.

    Attributes
    ----------
    inverse_led
        (3 N, 3 N) A^-1, the inverse diagonal blocks of the lights
    elimination
        (3 N, R) A^-1 B, with B the transposed coupling
    factor
        Cholesky factor of the scaled (R, R) Schur complement
    scale
        (R,) scaling of the unknowns
    """

    inverse_led: bsr_array
    elimination: csr_array
    factor: tuple[Floats, bool]
    scale: Floats


def eliminate_lights(terms: NormalEquations, damping: float) -> ReducedSystem:
    """Eliminate the lights, with Marquardt's damping.

    The normal equations [[A, B], [B^T, D]] [x; y] = [a; b] of lights x and other unknowns y give
    (D - B^T A^-1 B) y = b - B^T A^-1 a: the Schur complement of A, which is block diagonal. Damping multiplies the
    diagonals of A and D by 1 + damping.

    Raises
    ------
    LinAlgError
        If an unknown is undetermined: without a prior map, four moves change no pixel.
    """
    # A^-1, block by block
    blocks = terms.by_led * np.where(np.eye(3, dtype=bool), 1 + damping, 1.0)
    start = np.arange(len(blocks) + 1)
    inverse = bsr_array((np.linalg.inv(blocks), start[:-1], start))
    # Schur complement D - B^T A^-1 B
    elimination = csr_array(inverse @ terms.coupling.T)
    matrix = terms.rest - (terms.coupling @ elimination).toarray()
    matrix[np.diag_indices_from(matrix)] += damping * terms.rest.diagonal()
    # Scale D to a unit diagonal: the unknowns have different units (rad, m, px).
    scale = 1 / np.sqrt(terms.rest.diagonal())
    matrix = matrix * scale * scale[:, None]
    return ReducedSystem(inverse, elimination, cho_factor(matrix, lower=True), scale)


def step(terms: NormalEquations, reduced: ReducedSystem) -> tuple[Floats, Floats]:
    """Solve the reduced system and substitute back: (3 N,) step of the positions and (R,) step of the rest."""
    # (D - B^T A^-1 B) y = b - B^T A^-1 a
    rhs = terms.rhs_rest - reduced.elimination.T @ terms.rhs_led
    rest = reduced.scale * cho_solve(reduced.factor, reduced.scale * rhs)
    # x = A^-1 (a - B y)
    return reduced.inverse_led @ terms.rhs_led - reduced.elimination @ rest, rest


def cauchy(squared: Floats, width: float) -> tuple[float, Floats]:
    """Return Cauchy's loss, sum(w^2 log(1 + s / w^2)), and its (M,) weights 1 / (1 + s / w^2).

    An infinite width w gives least squares.

    Parameters
    ----------
    squared
        (M,) squared lengths s of the residuals
    """
    if np.isinf(width):
        return float(squared.sum()), np.ones_like(squared)
    relative = squared / width**2
    return float(width**2 * np.log1p(relative).sum()), 1 / (1 + relative)


def robust_scale(bundle: Bundle, sightings: Sightings) -> float:
    """Return the robust scale of the residuals, at least 1: ratio of their median length in sigmas to unit noise's."""
    length = np.linalg.norm(residuals(bundle, sightings), axis=1)
    return max(1.0, float(np.median(length) / MEDIAN_RADIUS))


def adjust(
    bundle: Bundle, sightings: Sightings, width: float, decrement: float = DECREMENT
) -> tuple[Bundle, str]:
    """Minimize the loss over all unknowns by Levenberg-Marquardt; return the bundle and the status of the fit.

    The status is "converged", or "stopped ..." without convergence. The numbered steps are those of the module.

    Parameters
    ----------
    width
        Width of Cauchy's loss in sigmas; inf for least squares
    decrement
        Newton decrement at which the iteration ends

    Raises
    ------
    LinAlgError
        If an unknown is undetermined.
    """
    damping = 1e-4
    cost, weight = bundle.cost(sightings, width)
    # 1. and 2. Linearize, and sum the normal equations.
    terms = bundle.equations(sightings, weight)
    for _ in range(STEPS):
        # 3. and 4. Eliminate the lights, solve, and substitute back. More damping makes a matrix regular.
        try:
            led, rest = step(terms, eliminate_lights(terms, damping))
        except LinAlgError:
            if damping > 1e6:
                raise
            damping *= 10
            continue
        slope = terms.rhs_led @ led + terms.rhs_rest @ rest  # g^T d: the Newton decrement
        trial = bundle.apply_step(led, rest)
        new_cost, new_weight = trial.cost(sightings, width)
        # 5. Near the minimum the costs differ only by rounding: a step is accepted within that.
        if new_cost <= cost * (1 + 1e-13) + 1e-20:
            bundle = trial
            cost = new_cost
            damping = max(damping / 10, 1e-12)
            # 6. Convergence
            if slope < decrement:
                return bundle, "converged"
            terms = bundle.equations(sightings, new_weight)
        else:
            damping *= 10
            if damping > 1e12:
                break
    return bundle, f"stopped after {STEPS} steps without convergence"


def attitude_equations(
    terms: Linearization, sightings: Sightings, weight: Floats, frames: int
) -> tuple[Floats, Floats]:
    """Return the normal equations of each frame's attitude: (F, 3, 3) matrices and (F, 3) right-hand sides.

    A frame without sightings has the identity, which gives it a step of zero.
    """
    weighted = weight[:, None, None] * terms.by_rotation
    matrix = summed(terms.by_rotation.mT @ weighted, sightings.frame, frames)
    matrix[np.bincount(sightings.frame, minlength=frames) == 0] = np.eye(3)
    gradients = np.einsum("mai,ma->mi", weighted, terms.residual)
    return matrix, summed(gradients, sightings.frame, frames)


def fit_attitudes(bundle: Bundle, sightings: Sightings, rounds: int) -> Bundle:
    """Return a bundle with better attitudes: Gauss-Newton on each frame's attitude alone, all other unknowns fixed.

    The weights are Cauchy's, with the median residual (at least 1 sigma) as width.
    """
    frames = len(bundle.R_body_from_lab)
    others = np.zeros(3 + bundle.free_lens)
    for _ in range(rounds):
        terms = linearize(bundle, sightings)
        squared = np.sum(terms.residual**2, axis=1)
        width = max(1.0, float(np.sqrt(np.median(squared))))
        _, weight = cauchy(squared, width)
        matrix, rhs = attitude_equations(terms, sightings, weight, frames)
        turn = np.linalg.solve(matrix, rhs[:, :, None]).ravel()
        bundle = Bundle.apply_step(bundle, np.zeros(3), np.append(turn, others))
    return bundle
