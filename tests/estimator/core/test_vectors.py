"""Small rotations and frames of compiled code, run by the interpreter, against SciPy and the axioms of a frame."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.core import vectors as compiled
from tests.helpers.interpreted import interpreted

MODULES = {"compiled": compiled, "interpreted": interpreted("estimator.core.vectors")}
every_mode = pytest.mark.parametrize("vectors", MODULES.values(), ids=MODULES)


@every_mode
@pytest.mark.parametrize("size_rad", [1e-2, 1e-3])
def test_a_small_rotation_is_accurate_to_second_order(vectors, size_rad: float) -> None:
    """The error of I + [w] + [w]^2 / 2 is |w|^3 / 6; the rows are made orthonormal to rounding."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        start = Rotation.random(rng=rng)
        w = size_rad * np.array(rng.uniform(-1, 1, 3))
        matrix = start.as_matrix()
        vectors.rotate_in_place(w, matrix)
        assert np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-15
        truth = (Rotation.from_rotvec(w) * start).as_matrix()
        assert np.abs(matrix - truth).max() < np.linalg.norm(w) ** 3 / 3


@every_mode
def test_a_pair_s_frame_is_right_handed_with_its_bisector_and_normal(vectors) -> None:
    rng = np.random.default_rng(1)
    out = np.empty((3, 3))
    for u, v in rng.normal(size=(20, 2, 3)):
        u = u / np.linalg.norm(u)
        v = v / np.linalg.norm(v)
        vectors.pair_frame(tuple(u), tuple(v), out)
        bisector = (u + v) / np.linalg.norm(u + v)
        normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        np.testing.assert_allclose(
            out, np.column_stack([bisector, normal, np.cross(bisector, normal)]), atol=1e-13
        )


@every_mode
def test_products_match_numpy(vectors) -> None:
    rng = np.random.default_rng(2)
    out = np.empty((3, 3))
    a, b = rng.normal(size=(2, 3, 3))
    vectors.multiply_transposed(a, b, out)
    np.testing.assert_allclose(out, a @ b.T, rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        vectors.rotate(a, vectors.row(b, 1)), a @ b[1], rtol=0, atol=1e-14
    )
    assert vectors.chord(tuple(a[0]), tuple(b[2])) == pytest.approx(
        np.linalg.norm(a[0] - b[2]), rel=1e-14
    )
    assert vectors.squared_chord(tuple(a[0]), tuple(b[2])) == pytest.approx(
        np.sum((a[0] - b[2]) ** 2), rel=1e-14
    )
