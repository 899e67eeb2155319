"""Shared by tests of star identification: a random sky, its frames, and the error of a solution."""

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.catalog import sky_index
from estimator.identification import star_evidence
from estimator.identification.star_evidence import Solution

WIDE_RAD = np.radians(12.0)
FIELD = np.tan(np.radians([-5.0, 5.0, -4.0, 4.0]))
SIGMA = 2e-5
CHECKS = 200_000
SEARCHED = 80


def random_sky(count: int, seed: int):
    """Uniform directions, with star counts that grow as 10^(0.5 magnitude)."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors, np.sort(6.0 + 2 * np.log10(rng.uniform(1e-4, 1, count)))


VECTORS, MAG = random_sky(6000, 1)
SKY = sky_index.add_pairs(sky_index.build(VECTORS, MAG), WIDE_RAD)


def observe(truth: Rotation, rng, sigma=SIGMA, zoom=1.0, vectors=VECTORS, mag=MAG):
    """Tangents, magnitudes and rows of the field's stars, brightest first; the focal length is `zoom` times longer."""
    x, y, z = truth.apply(vectors).T
    tangent = zoom * np.column_stack([x, y]) / np.where(z > 0.1, z, np.inf)[:, None]
    inside = (
        (z > 0.1)
        & (tangent > FIELD[[0, 2]]).all(axis=1)
        & (tangent < FIELD[[1, 3]]).all(axis=1)
    )
    row = np.flatnonzero(inside)
    noisy = tangent[row] + sigma * rng.standard_normal((len(row), 2))
    shown = mag[row] + 0.25 * rng.standard_normal(len(row))
    order = np.argsort(shown)
    return noisy[order], shown[order], row[order]


def detections_of(tangent, mag, sigma=SIGMA, zoom=0.0) -> star_evidence.Detections:
    sigmas = np.full(len(tangent), sigma)
    weight = np.stack([sigmas**-2, sigmas**-2, 0 * sigmas], axis=1)
    return star_evidence.Detections(
        np.ascontiguousarray(tangent),
        sigmas,
        weight,
        np.array(mag),
        0.25,
        FIELD,
        zoom,
        np.nan,
    )


def attitude_error(solution: Solution, truth: Rotation):
    """Small rotation from the truth to the answer, in camera axes."""
    return (Rotation.from_quat(solution.cam_from_ref_xyzw) * truth.inv()).as_rotvec()
