"""Bundle adjustment of lights seen by a camera that turns about a fixed centre: model, derivatives, least squares.

The pixel of light i in frame k is p = c + f d(q_x / q_z, q_y / q_z), q = C (A_k x_i - r): light x_i and lever r from
the bearing's centre, A_k = body_from_lab, C = cam_from_body, d Brown-Conrady's distortion. Lights meet one another
only through frames, so each light's 3 x 3 block is eliminated and a dense system of frames, lever and lens remains
(Triggs et al. 2000, Bundle adjustment: a modern synthesis, section 6). Measured on AFIT's dome (892 lights,
600 frames): 14 exact steps come to rest; scipy's least_squares with the same sparse Jacobian and lsmr for the steps had
brought the cost after 12 evaluations from 5.4e8 to 4.1e8 only, of 1.1e4: its steps are inexact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array, csr_array
from scipy.spatial.transform import Rotation

from estimator.core.arrays import Floats, Ints

# Newton's decrement g'N^-1 g is the squared step in standard deviations: far below what 1e-9 of a length needs.
DECREMENT = 1e-12
STEPS = 100


@dataclass(frozen=True, slots=True)
class Sightings:
    """Every light in every frame: frame, led (M,) rows; xy_px (M, 2); sigma_px (M,) of each coordinate."""

    frame: Ints
    led: Ints
    xy_px: Floats
    sigma_px: Floats

    def take(self, which: np.ndarray) -> Sightings:
        """The chosen sightings, by mask or index."""
        return Sightings(self.frame[which], self.led[which], self.xy_px[which], self.sigma_px[which])


@dataclass(frozen=True, slots=True)
class Bundle:
    """All that the pixels depend on.

    position_m       : (N, 3) lights in the lab
    R_body_from_lab  : (F, 3, 3)
    camera_body_m    : (3,) entrance pupil in the body frame
    R_cam_from_body  : (3, 3), held: a turn of it is a turn of every body_from_lab and of the lever
    lens             : (8,) focal_px, centre x and y in px, k1, k2, p1, p2, k3
    free_lens        : how many of `lens`, from the front, are unknowns
    map_m, map_sigma_m : (N, 3) where the lights were believed, and how well, each axis; inf is not at all
    """

    position_m: Floats
    R_body_from_lab: Floats
    camera_body_m: Floats
    R_cam_from_body: Floats
    lens: Floats
    free_lens: int
    map_m: Floats
    map_sigma_m: float = np.inf

    def cost(self, seen: Sightings, width: float) -> tuple[float, Floats]:
        """Loss of pixels and of the believed map together, and the (M,) weights of the sightings."""
        loss, weight = cauchy(np.sum(residuals(self, seen) ** 2, axis=1), width)
        return loss + float(np.sum(((self.map_m - self.position_m) / self.map_sigma_m) ** 2)), weight

    def moved(self, led: Floats, rest: Floats) -> Bundle:
        """The bundle after a step: (3 N,) metres, then 3 F small body-axis turns, 3 of the lever, the free lens."""
        turns = 3 * len(self.R_body_from_lab)
        lens = self.lens.copy()
        lens[: self.free_lens] += rest[turns + 3 :]
        turned = Rotation.from_rotvec(rest[:turns].reshape(-1, 3)).as_matrix() @ self.R_body_from_lab
        return replace(
            self,
            position_m=self.position_m + led.reshape(-1, 3),
            R_body_from_lab=turned,
            camera_body_m=self.camera_body_m + rest[turns : turns + 3],
            lens=lens,
        )


class Rows(NamedTuple):
    """Residuals over sigma (M, 2), and the pixel over sigma's derivative (M, 2, n) by light, turn, lever and lens."""

    residual: Floats
    by_led: Floats
    by_turn: Floats
    by_shared: Floats


def residuals(bundle: Bundle, seen: Sightings) -> Floats:
    """(M, 2) measured minus predicted pixel, over its sigma; infinite for a light behind the camera."""
    q = _in_camera(bundle, seen)[1]
    ahead = q[:, 2] > 0
    tangent = q[:, :2] / np.where(ahead, q[:, 2], 1.0)[:, None]
    pixel = bundle.lens[1:3] + bundle.lens[0] * _distorted(tangent, bundle.lens[3:])
    return np.where(ahead[:, None], (seen.xy_px - pixel) / seen.sigma_px[:, None], np.inf)


def rows(bundle: Bundle, seen: Sightings) -> Rows:
    """Residuals and their exact derivatives; every light must be ahead of the camera."""
    b, q = _in_camera(bundle, seen)
    tangent = q[:, :2] / q[:, 2:]
    focal, coefficients = bundle.lens[0], bundle.lens[3:]
    distorted = _distorted(tangent, coefficients)
    pinhole = np.zeros((len(q), 2, 3))
    pinhole[:, 0, 0] = pinhole[:, 1, 1] = 1 / q[:, 2]
    pinhole[:, :, 2] = -tangent / q[:, 2:]
    weight = 1 / seen.sigma_px[:, None, None]
    by_body = focal * weight * (_by_tangent(tangent, coefficients) @ pinhole @ bundle.R_cam_from_body)
    by_lens = np.concatenate(
        [distorted[:, :, None], np.tile(np.eye(2), (len(q), 1, 1)), focal * _by_coefficients(tangent)], axis=2
    )
    residual = (seen.xy_px - bundle.lens[1:3] - focal * distorted) / seen.sigma_px[:, None]
    return Rows(
        residual,
        by_body @ bundle.R_body_from_lab[seen.frame],
        np.cross(b[:, None, :], by_body),  # d . (w x b) = w . (b x d)
        np.concatenate([-by_body, weight * by_lens[:, :, : bundle.free_lens]], axis=2),
    )


def _in_camera(bundle: Bundle, seen: Sightings) -> tuple[Floats, Floats]:
    """(M, 3) lights from the bearing's centre in body axes, and from the camera in its own."""
    b = np.einsum("mij,mj->mi", bundle.R_body_from_lab[seen.frame], bundle.position_m[seen.led])
    return b, (b - bundle.camera_body_m) @ bundle.R_cam_from_body.T


def _distorted(tangent: Floats, coefficients: Floats) -> Floats:
    k1, k2, p1, p2, k3 = coefficients
    x, y = tangent.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    across = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return np.column_stack([x * radial + across, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])


def _by_tangent(tangent: Floats, coefficients: Floats) -> Floats:
    """(M, 2, 2) derivative of the distorted tangent by the true one; it is symmetric."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = tangent.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # of the radial factor by x, over x
    by = np.empty((len(x), 2, 2))
    by[:, 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    by[:, 0, 1] = by[:, 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by[:, 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return by


def _by_coefficients(tangent: Floats) -> Floats:
    """(M, 2, 5) derivative of the distorted tangent by k1, k2, p1, p2, k3."""
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


class Normal(NamedTuple):
    """The normal equations: by_led (N, 3, 3) blocks, coupling (R, 3 N) sparse, rest (R, R), and both right sides."""

    by_led: Floats
    coupling: csr_array
    rest: Floats
    pull_led: Floats
    pull_rest: Floats


def normal(bundle: Bundle, seen: Sightings, weight: Floats) -> Normal:
    """J'WJ and J'W residual, W one weight a sighting."""
    terms = rows(bundle, seen)
    root = np.sqrt(weight)[:, None, None]
    count, frames, lights = len(weight), len(bundle.R_body_from_lab), len(bundle.position_m)
    by_led = _spread(terms.by_led * root, seen.led, 3 * lights)
    by_turn = _spread(terms.by_turn * root, seen.frame, 3 * frames)
    shared = (terms.by_shared * root).reshape(2 * count, -1)
    residual = (terms.residual * root[:, 0]).ravel()
    blocks = np.zeros((lights, 3, 3))
    np.add.at(blocks, seen.led, np.einsum("mai,maj->mij", terms.by_led, terms.by_led) * root**2)
    by_rest = _beside(by_turn, shared)
    blocks += np.eye(3) / bundle.map_sigma_m**2
    from_map = (bundle.map_m - bundle.position_m).ravel() / bundle.map_sigma_m**2
    return Normal(
        blocks,
        csr_array(by_rest.T @ by_led),
        (by_rest.T @ by_rest).toarray(),
        by_led.T @ residual + from_map,
        by_rest.T @ residual,
    )


def _spread(blocks: Floats, column: Ints, width: int) -> csr_array:
    """(M, 2, 3) blocks, each in its own two rows, at columns 3 * column."""
    start = np.arange(len(blocks) + 1)
    return csr_array(bsr_array((blocks, column, start), shape=(2 * len(blocks), width)))


def _beside(left: csr_array, right: Floats) -> csr_array:
    """The two matrices side by side."""
    width = right.shape[1]
    columns = np.tile(np.arange(width), len(right)) + left.shape[1]
    per_row = np.diff(left.indptr)[0]
    data = np.hstack([left.data.reshape(len(right), per_row), right])
    index = np.hstack([left.indices.reshape(len(right), per_row), columns.reshape(len(right), width)])
    start = np.arange(len(right) + 1) * (per_row + width)
    return csr_array((data.ravel(), index.ravel(), start), shape=(len(right), left.shape[1] + width))


def freedoms(bundle: Bundle) -> tuple[Floats, Floats]:
    """(3 N, 4) and (R, 4): the moves that change no pixel: three turns of the lab, and the size of everything.

    Lab turn e: x <- e x x, and A <- A exp(-e) = exp(-A e) A. Size: x and r grow alike. A believed map resists them.
    """
    lights, frames = len(bundle.position_m), len(bundle.R_body_from_lab)
    led = np.zeros((lights, 3, 4))
    for axis, e in enumerate(np.eye(3)):
        led[:, :, axis] = np.cross(e, bundle.position_m)
    led[:, :, 3] = bundle.position_m
    rest = np.zeros((3 * frames + 3 + bundle.free_lens, 4))
    rest[: 3 * frames, :3] = -bundle.R_body_from_lab.reshape(-1, 3)
    rest[3 * frames : 3 * frames + 3, 3] = bundle.camera_body_m
    return led.reshape(-1, 4), rest


def _unresisted(bundle: Bundle) -> Floats:
    """The freedoms of the rest, or (R, 0) where a believed map resists them."""
    rest = freedoms(bundle)[1]
    return rest if np.isinf(bundle.map_sigma_m) else rest[:, :0]


class Reduced(NamedTuple):
    """Lights eliminated: inverse light blocks, spread = their product with the coupling, the rest's factor."""

    inverse_led: bsr_array
    spread: csr_array
    factor: tuple[Floats, bool]
    scale: Floats


def reduce(terms: Normal, still: Floats, damping: float) -> Reduced:
    """Schur complement over the lights, with Marquardt's damping, unit diagonal and the free moves held.

    `still` (R, 4 or 0) are the freedoms that nothing resists: added as a penalty they make the matrix regular and
    change no other move. Raises LinAlgError where lever or lens is left unknown besides.
    """
    swell = 1 + damping
    blocks = terms.by_led * np.where(np.eye(3, dtype=bool), swell, 1.0)
    lights = len(blocks)
    inverse = bsr_array((np.linalg.inv(blocks), np.arange(lights), np.arange(lights + 1)))
    spread = csr_array(inverse @ terms.coupling.T)
    matrix = terms.rest - (terms.coupling @ spread).toarray()
    matrix[np.diag_indices_from(matrix)] += damping * terms.rest.diagonal()
    scale = 1 / np.sqrt(terms.rest.diagonal())
    held, _ = np.linalg.qr(still / scale[:, None])
    matrix = matrix * scale * scale[:, None] + held @ held.T
    return Reduced(inverse, spread, cho_factor(matrix, lower=True), scale)


def step(terms: Normal, part: Reduced) -> tuple[Floats, Floats]:
    """The move of lights and of the rest."""
    pull = terms.pull_rest - part.spread.T @ terms.pull_led
    rest = part.scale * cho_solve(part.factor, part.scale * pull)
    return part.inverse_led @ terms.pull_led - part.spread @ rest, rest


def cauchy(squared: Floats, width: float) -> tuple[float, Floats]:
    """Cost and (M,) weights of w^2 log(1 + s / w^2); an infinite width is plain least squares."""
    if np.isinf(width):
        return float(squared.sum()), np.ones_like(squared)
    return float(width**2 * np.log1p(squared / width**2).sum()), 1 / (1 + squared / width**2)


def adjust(
    bundle: Bundle, seen: Sightings, width: float, decrement: float = DECREMENT
) -> tuple[Bundle, bool]:
    """Least squares over everything by Levenberg-Marquardt, and whether it came to rest.

    width: of Cauchy's loss in sigmas; inf for plain least squares. Raises LinAlgError where an unknown is free.
    """
    damping = 1e-4
    cost, weight = bundle.cost(seen, width)
    terms = normal(bundle, seen, weight)
    for _ in range(STEPS):
        try:
            led, rest = step(terms, reduce(terms, _unresisted(bundle), damping))
        except LinAlgError:
            if damping > 1e6:
                raise
            damping *= 10
            continue
        slope = terms.pull_led @ led + terms.pull_rest @ rest
        trial = bundle.moved(led, rest)
        new_cost, new_weight = trial.cost(seen, width)
        # Near rest the costs differ by their rounding only.
        if new_cost <= cost * (1 + 1e-13) + 1e-20:
            bundle, cost, damping = trial, new_cost, max(damping / 10, 1e-12)
            if slope < decrement:
                return bundle, True
            terms = normal(bundle, seen, new_weight)
        else:
            damping *= 10
            if damping > 1e12:
                break
    return bundle, False


def turn_frames(bundle: Bundle, seen: Sightings, rounds: int) -> Bundle:
    """Every frame's attitude alone, with Cauchy's weights about the median residual: a start for the whole."""
    turns = 3 * len(bundle.R_body_from_lab)
    still = np.zeros(3 * len(bundle.position_m))
    rest = np.zeros(turns + 3 + bundle.free_lens)
    for _ in range(rounds):
        terms = rows(bundle, seen)
        squared = np.sum(terms.residual**2, axis=1)
        _, weight = cauchy(squared, max(1.0, float(np.sqrt(np.median(squared)))))
        matrix = np.zeros((turns // 3, 3, 3))
        pull = np.zeros((turns // 3, 3))
        by = terms.by_turn
        np.add.at(matrix, seen.frame, weight[:, None, None] * np.einsum("mai,maj->mij", by, by))
        np.add.at(pull, seen.frame, weight[:, None] * np.einsum("mai,ma->mi", by, terms.residual))
        rest[:turns] = np.linalg.solve(matrix, pull[:, :, None]).ravel()
        bundle = bundle.moved(still, rest)
    return bundle


def covariance(
    terms: Normal, bundle: Bundle, fixed_led: Floats, fixed_rest: Floats
) -> tuple[Floats, Floats, Floats]:
    """Covariances (N, 3, 3) of lights, (F, 3, 3) of turns, and of lever and free lens, in the gauge that is asked.

    fixed_led (3 N, 4), fixed_rest (R, 4): the four linear functions H'd that the gauge holds at zero. With Z the
    freedoms, any generalised inverse Q of the normal matrix becomes T Q T', T = I - Z (H'Z)^-1 H' (Baarda's
    S-transformation). Raises LinAlgError where an unknown is left free.
    """
    led_free, rest_free = freedoms(bundle)
    part = reduce(terms, _unresisted(bundle), 0.0)
    size = len(part.scale)
    rest = cho_solve(part.factor, np.eye(size)) * part.scale * part.scale[:, None]
    lights = len(bundle.position_m)
    spread = part.spread.toarray()
    # Covariance of the gauge's four functions with everything: Q H.
    through = fixed_rest - part.spread.T @ fixed_led
    rest_fixed = rest @ through
    led_fixed = part.inverse_led @ fixed_led - part.spread @ rest_fixed
    back = np.linalg.inv(led_free.T @ fixed_led + rest_free.T @ fixed_rest)  # (H'Z)^-T
    k_led, k_rest = led_fixed @ back, rest_fixed @ back
    spare = back.T @ (fixed_led.T @ led_fixed + fixed_rest.T @ rest_fixed) @ back

    by_led = np.einsum(
        "nik,njk->nij", (spread @ rest).reshape(lights, 3, size), spread.reshape(lights, 3, size)
    )
    by_led += part.inverse_led.data
    by_led += _transformed(k_led.reshape(lights, 3, 4), led_free.reshape(lights, 3, 4), spare)
    turns = 3 * len(bundle.R_body_from_lab)
    frames = turns // 3
    by_turn = np.array([rest[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(frames)])
    by_turn += _transformed(k_rest[:turns].reshape(-1, 3, 4), rest_free[:turns].reshape(-1, 3, 4), spare)
    shared = rest[turns:, turns:] + _transformed(k_rest[None, turns:], rest_free[None, turns:], spare)[0]
    return by_led, by_turn, shared


def _transformed(with_gauge: Floats, free: Floats, spare: Floats) -> Floats:
    """What the S-transformation adds to diagonal blocks: -K Z' - Z K' + Z P Z'."""
    cross = with_gauge @ free.transpose(0, 2, 1)
    return free @ spare @ free.transpose(0, 2, 1) - cross - cross.transpose(0, 2, 1)
