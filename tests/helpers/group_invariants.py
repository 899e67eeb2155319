"""Projective and affine invariants of groups of lights.

Of a camera of which nothing is known, five lights have two invariants under the homography between any two images of
their rays (Mundy & Zisserman 1992, Geometric Invariance in Computer Vision), ratios of determinants |ijk| of three
rays,

    I1 = |431||521| / (|421||531|),  I2 = |421||532| / (|432||521|);

of a camera whose image is an affine one of the rays' tangents, four lights have the ratios of the areas of triangles
|124| / |123| and |134| / |123|.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.core.checks import Floats


class Transform(NamedTuple):
    """A family of image transforms: lights of its invariants, and lights that fix it."""

    lights: int
    fixed_by: int


TRANSFORMS = {"projective": Transform(5, 4), "affine": Transform(4, 3)}


def determinant(rays: Floats, i: int, j: int, k: int) -> Floats:
    """(...,) determinant of rays i, j and k of (..., L, 3)."""
    return np.asarray(
        np.einsum(
            "...a,...a->...", rays[..., i, :], np.cross(rays[..., j, :], rays[..., k, :])
        )
    )


def invariants(rays: Floats, name: str) -> Floats:
    """(..., 2) invariants of (..., L, 3) homogeneous rays (x, y, 1); see the module."""

    def det(i: int, j: int, k: int) -> Floats:
        return determinant(rays, i - 1, j - 1, k - 1)

    with np.errstate(divide="ignore", invalid="ignore"):
        if name == "affine":
            return np.stack(
                [det(1, 2, 4) / det(1, 2, 3), det(1, 3, 4) / det(1, 2, 3)], axis=-1
            )
        first = det(4, 3, 1) * det(5, 2, 1) / (det(4, 2, 1) * det(5, 3, 1))
        return np.stack(
            [first, det(4, 2, 1) * det(5, 3, 2) / (det(4, 3, 2) * det(5, 2, 1))], axis=-1
        )


def predicted(name: str, source: Floats, target: Floats, points: Floats) -> Floats:
    """(K, 2) images of points under the transform that takes the source's points to the target's."""
    if name == "affine":
        matrix = np.linalg.lstsq(source, target, rcond=None)[0].T
    else:
        bases = [one[:3].T * np.linalg.solve(one[:3].T, one[3]) for one in (source, target)]
        matrix = bases[1] @ np.linalg.inv(bases[0])
    image = points @ matrix.T
    return np.asarray(image[:, :2] / image[:, 2:])
