"""Single quaternions against SciPy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core import quaternion
from skysim.core.types import Trajectory

TURNS = [[0.3, -1.2, 2.0], [1e-12, 0, 0], [0, 0, 0], [0, np.pi - 1e-9, 0], [-2.0, 1.0, 1.5]]


def wxyz(turn: list[float]) -> np.ndarray:
    return Rotation.from_rotvec(turn).as_quat(scalar_first=True)


@pytest.mark.parametrize("turn", TURNS)
def test_rotation_vectors_round_trip_through_quaternions(turn: list[float]) -> None:
    made = quaternion.from_rotvec(np.array(turn, float))
    same = Rotation.from_rotvec(turn)
    assert (Rotation.from_quat(made, scalar_first=True).inv() * same).magnitude() < 1e-15
    np.testing.assert_allclose(
        quaternion.to_rotvec(made), same.as_rotvec(), rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(
        quaternion.to_rotvec(-made), same.as_rotvec(), rtol=0, atol=1e-14
    )


@pytest.mark.parametrize("one", TURNS)
@pytest.mark.parametrize("two", TURNS)
def test_products_and_rotated_vectors_match_scipy(one: list[float], two: list[float]) -> None:
    a = Rotation.from_rotvec(one)
    b = Rotation.from_rotvec(two)
    product = quaternion.multiply(wxyz(one), quaternion.inverse(wxyz(two)))
    assert (
        Rotation.from_quat(product, scalar_first=True).inv() * (a * b.inv())
    ).magnitude() < 3e-15
    vector = np.array([0.2, -3.0, 1.1])
    np.testing.assert_allclose(
        quaternion.apply(wxyz(one), vector), a.apply(vector), rtol=0, atol=2e-15
    )
    np.testing.assert_allclose(
        quaternion.to_matrix(wxyz(one)), a.as_matrix(), rtol=0, atol=1e-15
    )


@pytest.mark.parametrize("count", [None, 0, 1, 5])
def test_rotations_are_those_of_scipy_with_the_scalar_first(count: int | None) -> None:
    turned = Rotation.random(count, rng=np.random.default_rng(4))
    wxyz = turned.as_quat(scalar_first=True)
    np.testing.assert_array_equal(quaternion.from_rotation(turned), wxyz)
    np.testing.assert_array_equal(
        quaternion.to_rotation(wxyz).as_quat(),
        Rotation.from_quat(wxyz, scalar_first=True).as_quat(),
    )
    # Compiled functions are compiled again for another order in memory.
    assert quaternion.from_rotation(turned).flags.c_contiguous


def test_the_cross_product_matches_numpy() -> None:
    a = np.array([1.0, -2.0, 0.5])
    b = np.array([0.3, 4.0, -7.0])
    np.testing.assert_array_equal(quaternion.cross(a, b), np.cross(a, b))


def test_a_motion_of_any_memory_layout_is_interpolated_by_the_same_compiled_code() -> None:
    """Telemetry comes as columns of a table. Compilation for each layout would take a second in a flight."""
    rate = np.array([0.1, -0.2, 0.3])
    t_s = np.linspace(0.0, 2.0, 9)
    made = Trajectory.at_rate(Rotation.identity(), rate, 0.0, t_s)
    table = np.asfortranarray(np.column_stack([t_s, t_s, made.rate_body_rad_s]))
    strided = Trajectory(table[::2, 0], made.lab_from_body[::2], table[::2, 2:])
    times_s = np.array([0.0, 0.33, 1.999, 2.0, 0.5])
    made.attitude_at(times_s)
    compiled = len(quaternion.interpolate.signatures)
    for motion in (made, strided):
        expected = Rotation.from_rotvec(np.outer(times_s[::-1], rate))
        assert (motion.attitude_at(times_s[::-1]).inv() * expected).magnitude().max() < 1e-14
    assert len(quaternion.interpolate.signatures) == compiled
