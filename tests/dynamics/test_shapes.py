"""The geometry of an MJCF file as plain shapes: kinds, sizes, positions, and mesh vertices."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.dynamics.multibody.scene_shapes import Laboratory

# The tetrahedron is neither centered nor turned as its principal axes are.
POINTS = np.array([[0.1, 0.2, 0], [0.6, 0.2, 0.1], [0.1, 0.5, 0], [0.2, 0.2, 0.7]])
PARTS = f"""<mujoco>
<asset><mesh name="tetra" vertex="{" ".join(map(str, POINTS.ravel()))}"/></asset>
<worldbody><camera name="lab" pos="3 2 1"/><geom type="plane" size="5 5 0.1" pos="0 0 -1"/>
<body name="bus" pos="0 0 0.5"><freejoint/>
<geom type="box" size="0.3 0.2 0.1" mass="80"/>
<geom type="sphere" size="0.05" pos="0 0 0.2" mass="0"/>
<geom name="bar" type="cylinder" size="0.04 0.3" pos="0.1 0 0" euler="90 0 0" rgba="1 0 0 1" mass="0"/>
<geom type="capsule" size="0.02 0.15" mass="0"/>
<geom type="ellipsoid" size="0.1 0.2 0.3" mass="0"/>
<geom type="mesh" mesh="tetra" pos="0 0.1 0" euler="10 20 30" mass="1"/>
</body></worldbody></mujoco>"""


def test_shapes_have_the_kinds_and_sizes_of_the_file() -> None:
    floor, box, sphere, cylinder, capsule, ellipsoid, mesh = Laboratory(PARTS).shapes
    kinds = [shape.kind for shape in (floor, box, sphere, cylinder, capsule, ellipsoid, mesh)]
    assert kinds == ["plane", "box", "sphere", "cylinder", "capsule", "ellipsoid", "mesh"]
    assert box.size_m == (0.3, 0.2, 0.1)
    assert sphere.size_m[0] == 0.05
    assert cylinder.size_m[:2] == (0.04, 0.3)
    assert capsule.size_m[:2] == (0.02, 0.15)
    assert ellipsoid.size_m == (0.1, 0.2, 0.3)
    np.testing.assert_allclose(cylinder.rgba, [1, 0, 0, 1])
    assert cylinder.name == "bar"
    assert not floor.on_vehicle
    assert all(
        shape.on_vehicle for shape in (box, sphere, cylinder, capsule, ellipsoid, mesh)
    )


def test_shapes_are_where_the_file_puts_them() -> None:
    lab = Laboratory(PARTS)
    _, _, sphere, cylinder, *_ = lab.shapes
    np.testing.assert_allclose(sphere.position_m, [0, 0, 0.7], atol=1e-12)
    np.testing.assert_allclose(cylinder.position_m, [0.1, 0, 0.5], atol=1e-12)
    axis = Rotation.from_quat(cylinder.parent_from_shape_wxyz, scalar_first=True).apply(
        [0, 0, 1]
    )
    np.testing.assert_allclose(np.abs(axis), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(lab.eye_m, [3, 2, 1])


def test_a_mesh_has_its_vertices_in_its_own_axes() -> None:
    mesh = Laboratory(PARTS).shapes[-1]
    turn = Rotation.from_euler("XYZ", [10, 20, 30], degrees=True)
    expected = np.array([0, 0.1, 0.5]) + turn.apply(POINTS)
    rotation = Rotation.from_quat(mesh.parent_from_shape_wxyz, scalar_first=True)
    found = np.array(mesh.position_m) + rotation.apply(mesh.vertices_m)
    assert sorted(found.round(5).tolist()) == sorted(expected.round(5).tolist())
    assert len(mesh.faces) == 4
