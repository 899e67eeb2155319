"""Bundle adjustment for a camera that rotates about a fixed center: model, derivatives, least squares, covariance.

The pixel of light i in frame k is p = c + f d(q_x / q_z, q_y / q_z), q = C (A_k x_i - r): light x_i and lever r from
the bearing center, A_k = body_from_lab, C = cam_from_body, d the Brown-Conrady distortion. The unknowns are the
positions x_i, small rotations of the A_k, the lever r and the lens; C is fixed.

Each step solves the damped normal equations (Levenberg-Marquardt). Lights are coupled to one another only through
frames, so each light's 3 x 3 block is eliminated by the Schur complement, and a dense system of frames, lever and lens
remains (Triggs et al. 2000, Bundle adjustment: a modern synthesis, section 6). Wrong identifications are
down-weighted with Cauchy's loss. Moves that change no pixel (`gauge_freedoms`) are held by a penalty, and the
covariance is transformed to the requested gauge afterwards (Baarda's S-transformation).

Measured on AFIT's dome (892 lights, 600 frames): 14 such steps converge to a cost of 1.1e4. scipy's least_squares
with the same sparse Jacobian and lsmr, whose steps are inexact, had only reduced the cost from 5.4e8 to 4.1e8 after
12 evaluations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array, csr_array
from scipy.spatial.transform import Rotation

from estimator.core.checks import Floats, Ints

# Newton decrement g'N^-1 g at convergence: the squared step in standard deviations. Small enough for a relative
# accuracy of 1e-9 in lengths.
DECREMENT = 1e-12
STEPS = 100
EXACT = 1e-6  # least standard deviation of an assumed lever in m, and of an assumed focal length as a share of it
MEDIAN_RADIUS = np.sqrt(
    2 * np.log(2)
)  # median distance of a two-dimensional unit Gaussian from its mean


@dataclass(frozen=True, slots=True)
class Sightings:
    """Observations of all frames: rows of frame and led (M,); xy_px (M, 2); sigma_px (M,) of each coordinate."""

    frame: Ints
    led: Ints
    xy_px: Floats
    sigma_px: Floats

    def take(self, which: np.ndarray) -> Sightings:
        """The selected sightings, by mask or index."""
        return Sightings(
            self.frame[which], self.led[which], self.xy_px[which], self.sigma_px[which]
        )


class Assumed(NamedTuple):
    """Lever and focal length as they are known without the frames; they enter the adjustment as measurements.

    Attributes
    ----------
    camera_body_m, lever_sigma_m
        (3,) m, and the standard deviation of each axis;  focal_px, focal_sigma_px
    """

    camera_body_m: Floats
    lever_sigma_m: float
    focal_px: float
    focal_sigma_px: float

    def less(self, bundle: Bundle) -> Floats:
        """(4,) lever and focal length less those of a bundle."""
        return np.array(
            [*(self.camera_body_m - bundle.camera_body_m), self.focal_px - bundle.lens[0]]
        )

    @property
    def weight(self) -> Floats:
        """(4,) 1 / sigma^2 of each. A sigma of 0 is taken as EXACT, so that the weights are finite."""
        lever_m = max(self.lever_sigma_m, EXACT)
        focal_px = max(self.focal_sigma_px, EXACT * self.focal_px)
        return np.array([lever_m, lever_m, lever_m, focal_px]) ** -2.0


@dataclass(frozen=True, slots=True)
class Bundle:
    """Parameters of the model: everything that the pixels depend on, and what is known of them without the pixels.

    Attributes
    ----------
    position_m
        (N, 3) lights in the lab frame
    R_body_from_lab
        (F, 3, 3)
    camera_body_m
        (3,) entrance pupil in the body frame
    R_cam_from_body
        (3, 3), fixed: its rotation is equivalent to one of every body_from_lab and of the lever
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

    def cost(self, sightings: Sightings, width: float) -> tuple[float, Floats]:
        """Total loss of the pixels and of what is known without them, and the (M,) robust weights of the sightings."""
        loss, weight = cauchy(np.sum(residuals(self, sightings) ** 2, axis=1), width)
        loss += float(np.sum(((self.map_m - self.position_m) / self.map_sigma_m) ** 2))
        if self.assumed:
            loss += float(np.sum(self.assumed.weight * self.assumed.less(self) ** 2))
        return loss, weight

    def apply_step(self, led: Floats, rest: Floats) -> Bundle:
        """The bundle after a step.

        Parameters
        ----------
        led
            (3 N,) changes of the positions, m
        rest
            3 F small rotations in body axes (rad), 3 changes of the lever (m), changes of the
            free lens elements
        """
        rotation_size = 3 * len(self.R_body_from_lab)
        lens = self.lens.copy()
        lens[: self.free_lens] += rest[rotation_size + 3 :]
        rotated = (
            Rotation.from_rotvec(rest[:rotation_size].reshape(-1, 3)).as_matrix()
            @ self.R_body_from_lab
        )
        return replace(
            self,
            position_m=self.position_m + led.reshape(-1, 3),
            R_body_from_lab=rotated,
            camera_body_m=self.camera_body_m + rest[rotation_size : rotation_size + 3],
            lens=lens,
        )


class Linearization(NamedTuple):
    """Weighted residuals and Jacobian: both divided by sigma_px.

    Attributes
    ----------
    residual
        (M, 2)
    by_led, by_rotation
        (M, 2, 3) derivatives of the pixel with respect to position and rotation
    by_shared
        (M, 2, 3 + free_lens) with respect to the lever and the free lens elements
    """

    residual: Floats
    by_led: Floats
    by_rotation: Floats
    by_shared: Floats


def residuals(bundle: Bundle, sightings: Sightings) -> Floats:
    """(M, 2) measured minus predicted pixel, divided by sigma_px; inf for a light behind the camera."""
    q = _in_camera(bundle, sightings)[1]
    in_front = q[:, 2] > 0
    tangent = q[:, :2] / np.where(in_front, q[:, 2], 1.0)[:, None]
    pixel = bundle.lens[1:3] + bundle.lens[0] * _distort(tangent, bundle.lens[3:])
    return np.where(
        in_front[:, None], (sightings.xy_px - pixel) / sightings.sigma_px[:, None], np.inf
    )


def linearize(bundle: Bundle, sightings: Sightings) -> Linearization:
    """Residuals and analytic derivatives; every light must be in front of the camera."""
    b, q = _in_camera(bundle, sightings)
    tangent = q[:, :2] / q[:, 2:]
    focal = bundle.lens[0]
    coefficients = bundle.lens[3:]
    distorted_tangent = _distort(tangent, coefficients)
    pinhole = np.zeros((len(q), 2, 3))
    pinhole[:, 0, 0] = pinhole[:, 1, 1] = 1 / q[:, 2]
    pinhole[:, :, 2] = -tangent / q[:, 2:]
    weight = 1 / sightings.sigma_px[:, None, None]
    by_body = (
        focal * weight * (_by_tangent(tangent, coefficients) @ pinhole @ bundle.R_cam_from_body)
    )
    by_lens = np.concatenate(
        [
            distorted_tangent[:, :, None],
            np.tile(np.eye(2), (len(q), 1, 1)),
            focal * _by_coefficients(tangent),
        ],
        axis=2,
    )
    residual = (
        sightings.xy_px - bundle.lens[1:3] - focal * distorted_tangent
    ) / sightings.sigma_px[:, None]
    return Linearization(
        residual,
        by_body @ bundle.R_body_from_lab[sightings.frame],
        np.cross(b[:, None, :], by_body),  # d . (w x b) = w . (b x d)
        np.concatenate([-by_body, weight * by_lens[:, :, : bundle.free_lens]], axis=2),
    )


def _in_camera(bundle: Bundle, sightings: Sightings) -> tuple[Floats, Floats]:
    """(M, 3) lights from the bearing center in body axes, and (M, 3) from the camera's pupil in camera axes."""
    b = np.einsum(
        "mij,mj->mi", bundle.R_body_from_lab[sightings.frame], bundle.position_m[sightings.led]
    )
    return b, (b - bundle.camera_body_m) @ bundle.R_cam_from_body.T


def _distort(tangent: Floats, coefficients: Floats) -> Floats:
    k1, k2, p1, p2, k3 = coefficients
    x, y = tangent.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    tangential = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return np.column_stack(
        [x * radial + tangential, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    )


def _by_tangent(tangent: Floats, coefficients: Floats) -> Floats:
    """(M, 2, 2) derivative of the distorted tangent with respect to the undistorted one; it is symmetric."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = tangent.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (
        k1 + r2 * (2 * k2 + 3 * r2 * k3)
    )  # derivative of the radial factor by x, divided by x
    by = np.empty((len(x), 2, 2))
    by[:, 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    by[:, 0, 1] = by[:, 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by[:, 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return by


def _by_coefficients(tangent: Floats) -> Floats:
    """(M, 2, 5) derivative of the distorted tangent with respect to k1, k2, p1, p2, k3."""
    x, y = tangent.T
    r2 = x * x + y * y
    return np.stack(
        [
            tangent * r2[:, None],
            tangent * r2[:, None] ** 2,
            np.column_stack([2 * x * y, r2 + 2 * y * y]),
            np.column_stack([r2 + 2 * x * x, 2 * x * y]),
            tangent * r2[:, None] ** 3,
        ],
        axis=2,
    )


class NormalEquations(NamedTuple):
    """The normal equations, with lights and the R other unknowns (rotations, lever, lens) in separate blocks.

    Attributes
    ----------
    by_led
        (N, 3, 3)
    coupling
        (R, 3 N) sparse
    rest
        (R, R)
    rhs_led, rhs_rest
        right-hand sides
    """

    by_led: Floats
    coupling: csr_array
    rest: Floats
    rhs_led: Floats
    rhs_rest: Floats


def normal_equations(bundle: Bundle, sightings: Sightings, weight: Floats) -> NormalEquations:
    """The normal equations J'WJ and J'W residual, with one weight per sighting and the priors added."""
    terms = linearize(bundle, sightings)
    root = np.sqrt(weight)[:, None, None]
    count = len(weight)
    frames = len(bundle.R_body_from_lab)
    lights = len(bundle.position_m)
    by_led = _block_matrix(terms.by_led * root, sightings.led, 3 * lights)
    by_rotation = _block_matrix(terms.by_rotation * root, sightings.frame, 3 * frames)
    shared = (terms.by_shared * root).reshape(2 * count, -1)
    residual = (terms.residual * root[:, 0]).ravel()
    # The lights' own normal matrix is block diagonal, so that only its blocks are accumulated.
    blocks = np.zeros((lights, 3, 3))
    np.add.at(
        blocks, sightings.led, np.einsum("mai,maj->mij", terms.by_led, terms.by_led) * root**2
    )
    by_rest = _append_dense(by_rotation, shared)
    blocks += np.eye(3) / bundle.map_sigma_m**2
    from_map = (bundle.map_m - bundle.position_m).ravel() / bundle.map_sigma_m**2
    rest = (by_rest.T @ by_rest).toarray()
    rhs_rest = by_rest.T @ residual
    if bundle.assumed:
        known = 3 * frames + np.arange(4)  # lever and focal length
        rest[known, known] += bundle.assumed.weight
        rhs_rest[known] += bundle.assumed.weight * bundle.assumed.less(bundle)
    return NormalEquations(
        blocks, csr_array(by_rest.T @ by_led), rest, by_led.T @ residual + from_map, rhs_rest
    )


def _block_matrix(blocks: Floats, column: Ints, width: int) -> csr_array:
    """Sparse (2 M, width) matrix of (M, 2, 3) blocks: block m is in rows 2 m, columns 3 * column[m]."""
    start = np.arange(len(blocks) + 1)
    return csr_array(bsr_array((blocks, column, start), shape=(2 * len(blocks), width)))


def _append_dense(left: csr_array, right: Floats) -> csr_array:
    """The sparse matrix `left` and the dense matrix `right` side by side; rows of `left` have equal lengths."""
    width = right.shape[1]
    columns = np.tile(np.arange(width), len(right)) + left.shape[1]
    per_row = np.diff(left.indptr)[0]
    data = np.hstack([left.data.reshape(len(right), per_row), right])
    index = np.hstack(
        [left.indices.reshape(len(right), per_row), columns.reshape(len(right), width)]
    )
    start = np.arange(len(right) + 1) * (per_row + width)
    return csr_array(
        (data.ravel(), index.ravel(), start), shape=(len(right), left.shape[1] + width)
    )


def gauge_freedoms(bundle: Bundle) -> tuple[Floats, Floats]:
    """Gauge freedoms: the four moves that change no pixel, three rotations of the lab frame and the scale.

    Returns their (3 N, 4) parts in the positions and (R, 4) in the other unknowns. A rotation by e of the lab changes x
    by e x x, and A to A exp(-e) = exp(-A e) A. A change of scale multiplies x and r alike. A prior map fixes all four.
    """
    lights = len(bundle.position_m)
    frames = len(bundle.R_body_from_lab)
    led = np.zeros((lights, 3, 4))
    for axis, e in enumerate(np.eye(3)):
        led[:, :, axis] = np.cross(e, bundle.position_m)
    led[:, :, 3] = bundle.position_m
    rest = np.zeros((3 * frames + 3 + bundle.free_lens, 4))
    rest[: 3 * frames, :3] = -bundle.R_body_from_lab.reshape(-1, 3)
    rest[3 * frames : 3 * frames + 3, 3] = bundle.camera_body_m
    return led.reshape(-1, 4), rest


def _free_gauge(bundle: Bundle) -> Floats:
    """(R, 4) part of the gauge freedoms in the rest of the unknowns, or (R, 0) if a prior map fixes them."""
    rest = gauge_freedoms(bundle)[1]
    return rest if np.isinf(bundle.map_sigma_m) else rest[:, :0]


class ReducedSystem(NamedTuple):
    """The reduced system after elimination of the lights.

    Attributes
    ----------
    inverse_led
        Inverse blocks of the lights
    elimination
        (3 N, R) their product with the transposed coupling
    factor
        Cholesky factor of the scaled (R, R) Schur complement
    scale
        (R,) its scaling to a unit diagonal
    """

    inverse_led: bsr_array
    elimination: csr_array
    factor: tuple[Floats, bool]
    scale: Floats


def eliminate_lights(terms: NormalEquations, gauge: Floats, damping: float) -> ReducedSystem:
    """Eliminate the lights (Schur complement), with Marquardt's damping and the gauge freedoms held.

    Parameters
    ----------
    gauge
        (R, 4 or 0) gauge freedoms without a constraint. Their outer product is added as a
        penalty, which makes the matrix regular and changes no other move

    Raises
    ------
    LinAlgError
        If the lever or the lens is undetermined as well.
    """
    blocks = terms.by_led * np.where(np.eye(3, dtype=bool), 1 + damping, 1.0)
    lights = len(blocks)
    inverse = bsr_array((np.linalg.inv(blocks), np.arange(lights), np.arange(lights + 1)))
    elimination = csr_array(inverse @ terms.coupling.T)
    matrix = terms.rest - (terms.coupling @ elimination).toarray()
    matrix[np.diag_indices_from(matrix)] += damping * terms.rest.diagonal()
    # Scaling to a unit diagonal: the unknowns have different units (rad, m, px).
    scale = 1 / np.sqrt(terms.rest.diagonal())
    gauge_basis, _ = np.linalg.qr(gauge / scale[:, None])
    matrix = matrix * scale * scale[:, None] + gauge_basis @ gauge_basis.T
    return ReducedSystem(inverse, elimination, cho_factor(matrix, lower=True), scale)


def step(terms: NormalEquations, reduced: ReducedSystem) -> tuple[Floats, Floats]:
    """Solve the reduced system and back-substitute: (3 N,) step of the positions and (R,) of the rest."""
    rhs = terms.rhs_rest - reduced.elimination.T @ terms.rhs_led
    rest = reduced.scale * cho_solve(reduced.factor, reduced.scale * rhs)
    return reduced.inverse_led @ terms.rhs_led - reduced.elimination @ rest, rest


def cauchy(squared: Floats, width: float) -> tuple[float, Floats]:
    """Cauchy's loss w^2 log(1 + s / w^2), summed, and its (M,) weights; an infinite width gives least squares."""
    if np.isinf(width):
        return float(squared.sum()), np.ones_like(squared)
    return float(width**2 * np.log1p(squared / width**2).sum()), 1 / (1 + squared / width**2)


def robust_scale(bundle: Bundle, sightings: Sightings) -> float:
    """Robust scale of the residuals in sigmas, at least 1: their median length over that of unit noise."""
    length = np.linalg.norm(residuals(bundle, sightings), axis=1)
    return max(1.0, float(np.median(length) / MEDIAN_RADIUS))


def adjust(
    bundle: Bundle, sightings: Sightings, width: float, decrement: float = DECREMENT
) -> tuple[Bundle, bool]:
    """Minimize the loss over all unknowns by Levenberg-Marquardt; returns the bundle and whether it converged.

    Parameters
    ----------
    width
        Of Cauchy's loss in sigmas; inf for least squares
    decrement
        Newton decrement at which the iteration ends

    Raises
    ------
    LinAlgError
        If an unknown is undetermined.
    """
    damping = 1e-4
    cost, weight = bundle.cost(sightings, width)
    terms = normal_equations(bundle, sightings, weight)
    for _ in range(STEPS):
        try:
            led, rest = step(terms, eliminate_lights(terms, _free_gauge(bundle), damping))
        except LinAlgError:
            if damping > 1e6:
                raise
            damping *= 10
            continue
        slope = (
            terms.rhs_led @ led + terms.rhs_rest @ rest
        )  # g' times the step: the Newton decrement
        trial = bundle.apply_step(led, rest)
        new_cost, new_weight = trial.cost(sightings, width)
        # Near the minimum the costs differ only by rounding, so that a step is accepted within that.
        if new_cost <= cost * (1 + 1e-13) + 1e-20:
            bundle = trial
            cost = new_cost
            damping = max(damping / 10, 1e-12)
            if slope < decrement:
                return bundle, True
            terms = normal_equations(bundle, sightings, new_weight)
        else:
            damping *= 10
            if damping > 1e12:
                break
    return bundle, False


def fit_attitudes(bundle: Bundle, sightings: Sightings, rounds: int) -> Bundle:
    """Starting values: Gauss-Newton on each frame's attitude alone, with all other unknowns fixed.

    Uses Cauchy's weights with the median residual as width, for `rounds` iterations.
    """
    rotation_size = 3 * len(bundle.R_body_from_lab)
    no_step = np.zeros(3 * len(bundle.position_m))
    rest = np.zeros(rotation_size + 3 + bundle.free_lens)
    for _ in range(rounds):
        terms = linearize(bundle, sightings)
        squared = np.sum(terms.residual**2, axis=1)
        _, weight = cauchy(squared, max(1.0, float(np.sqrt(np.median(squared)))))
        matrix = np.zeros((rotation_size // 3, 3, 3))
        rhs = np.zeros((rotation_size // 3, 3))
        by = terms.by_rotation
        np.add.at(
            matrix, sightings.frame, weight[:, None, None] * np.einsum("mai,maj->mij", by, by)
        )
        np.add.at(
            rhs, sightings.frame, weight[:, None] * np.einsum("mai,ma->mi", by, terms.residual)
        )
        rest[:rotation_size] = np.linalg.solve(matrix, rhs[:, :, None]).ravel()
        bundle = bundle.apply_step(no_step, rest)
    return bundle


class Covariances(NamedTuple):
    """Diagonal blocks of the covariance: (N, 3, 3) of LEDs, (F, 3, 3) of rotations, and that of lever and free lens."""

    by_led: Floats
    by_rotation: Floats
    shared: Floats


def covariance(terms: NormalEquations, bundle: Bundle) -> Covariances:
    """Diagonal blocks of the inverse normal matrix: errors against the truth if the prior map fixes the gauge.

    Without a prior map the gauge freedoms are held by their penalty: see `covariance_in_gauge`. Raises LinAlgError if
    an unknown is undetermined.
    """
    return _blocks(*_inverse(terms, bundle), bundle)


def covariance_in_gauge(
    terms: NormalEquations, bundle: Bundle, fixed_led: Floats, fixed_rest: Floats
) -> Covariances:
    """The covariance in a given gauge, without the error of the gauge itself.

    With Z the gauge freedoms, any generalized inverse Q of the normal matrix becomes T Q T', T = I - Z (H'Z)^-1 H'
    (Baarda's S-transformation). Only the diagonal blocks are computed. Raises LinAlgError if an unknown is
    undetermined.

    Parameters
    ----------
    fixed_led, fixed_rest
        (3 N, 4), (R, 4) the matrix H of the four linear gauge constraints H'd = 0
    """
    led_free, rest_free = gauge_freedoms(bundle)
    reduced, rest = _inverse(terms, bundle)
    blocks = _blocks(reduced, rest, bundle)
    # Q H: covariance of all unknowns with the four gauge constraints.
    through = fixed_rest - reduced.elimination.T @ fixed_led
    rest_fixed = rest @ through
    led_fixed = reduced.inverse_led @ fixed_led - reduced.elimination @ rest_fixed
    transform = np.linalg.inv(led_free.T @ fixed_led + rest_free.T @ fixed_rest)  # (H'Z)^-T
    k_led = led_fixed @ transform
    k_rest = rest_fixed @ transform
    outer = transform.T @ (fixed_led.T @ led_fixed + fixed_rest.T @ rest_fixed) @ transform
    rotation_size = 3 * len(bundle.R_body_from_lab)
    rotated = slice(rotation_size)
    shared = slice(rotation_size, None)
    return Covariances(
        blocks.by_led + _gauge_terms(k_led.reshape(-1, 3, 4), led_free.reshape(-1, 3, 4), outer),
        blocks.by_rotation
        + _gauge_terms(
            k_rest[rotated].reshape(-1, 3, 4), rest_free[rotated].reshape(-1, 3, 4), outer
        ),
        blocks.shared + _gauge_terms(k_rest[None, shared], rest_free[None, shared], outer)[0],
    )


def _inverse(terms: NormalEquations, bundle: Bundle) -> tuple[ReducedSystem, Floats]:
    """The reduced system, and the (R, R) inverse of the Schur complement: covariance of all but the lights."""
    reduced = eliminate_lights(terms, _free_gauge(bundle), 0.0)
    rest = (
        cho_solve(reduced.factor, np.eye(len(reduced.scale)))
        * reduced.scale
        * reduced.scale[:, None]
    )
    return reduced, rest


def _blocks(reduced: ReducedSystem, rest: Floats, bundle: Bundle) -> Covariances:
    """Covariance of the lights by block inversion, A^-1 + S Q S', S = A^-1 C' the elimination matrix; of the rest Q."""
    lights = len(bundle.position_m)
    size = len(rest)
    frames = len(bundle.R_body_from_lab)
    elimination = reduced.elimination.toarray()
    by_led = np.einsum(
        "nik,njk->nij",
        (elimination @ rest).reshape(lights, 3, size),
        elimination.reshape(lights, 3, size),
    )
    by_rotation = np.array([rest[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(frames)])
    return Covariances(
        by_led + reduced.inverse_led.data, by_rotation, rest[3 * frames :, 3 * frames :]
    )


def _gauge_terms(with_gauge: Floats, free: Floats, outer: Floats) -> Floats:
    """The terms that the S-transformation adds to the diagonal blocks: -K Z' - Z K' + Z P Z'."""
    cross = with_gauge @ free.transpose(0, 2, 1)
    return free @ outer @ free.transpose(0, 2, 1) - cross - cross.transpose(0, 2, 1)
