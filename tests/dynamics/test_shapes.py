"""The vehicle's parts as plain shapes for the lab's page: kinds, sizes and places, and boxes that hold meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.dynamics import multibody
from skysim.dynamics.multibody.view.shapes import Shape, shapes
from skysim.scene.sections.vehicle import VehicleConfig

# The tetrahedron is neither centered nor turned as its principal axes are.
PARTS = """<mujoco>
<asset><mesh name="tetra" vertex="0.1 0.2 0  0.6 0.2 0.1  0.1 0.5 0  0.2 0.2 0.7"/></asset>
<worldbody><body name="bus">
<geom type="box" size="0.3 0.2 0.1" mass="80"/>
<geom type="sphere" size="0.05" pos="0 0 0.2" mass="0"/>
<geom type="cylinder" size="0.04 0.3" pos="0.1 0 0" euler="90 0 0" rgba="1 0 0 1" mass="0"/>
<geom type="capsule" size="0.02 0.15" mass="0"/>
<geom type="ellipsoid" size="0.1 0.2 0.3" mass="0"/>
<geom type="mesh" mesh="tetra" pos="0 0.1 0" euler="10 20 30" mass="1"/>
<camera name="star_camera" quat="0 1 0 0"/>
</body></worldbody></mujoco>"""


def parts(tmp_path: Path) -> list[Shape]:
    (tmp_path / "v.xml").write_text(PARTS)
    return shapes(multibody.build(VehicleConfig.model_validate({"model": str(tmp_path / "v.xml")})))


def test_parts_have_the_kinds_and_sizes_of_the_file(tmp_path: Path) -> None:
    box, sphere, cylinder, capsule, ellipsoid, mesh = parts(tmp_path)
    kinds = [part.kind for part in (box, sphere, cylinder, capsule, ellipsoid, mesh)]
    assert kinds == ["box", "sphere", "cylinder", "cylinder", "sphere", "box"]
    assert box.size_m == (0.3, 0.2, 0.1)
    assert sphere.size_m[0] == 0.05
    assert cylinder.size_m[:2] == (0.04, 0.3)
    assert capsule.size_m[:2] == (0.02, 0.15)
    assert ellipsoid.size_m == (0.1, 0.2, 0.3)
    np.testing.assert_allclose(cylinder.rgba, [1, 0, 0, 1])


def test_parts_are_where_the_file_puts_them(tmp_path: Path) -> None:
    """Relative to the box: the body is moved so that its center of mass is at the bearing."""
    box, sphere, cylinder, *_ = parts(tmp_path)
    np.testing.assert_allclose(np.subtract(sphere.position_m, box.position_m), [0, 0, 0.2], atol=1e-12)
    np.testing.assert_allclose(np.subtract(cylinder.position_m, box.position_m), [0.1, 0, 0], atol=1e-12)
    axis = Rotation.from_quat(cylinder.body_from_shape_wxyz, scalar_first=True).apply([0, 0, 1])
    np.testing.assert_allclose(np.abs(axis), [0, 1, 0], atol=1e-12)


def test_a_mesh_is_in_its_box_and_touches_all_six_sides(tmp_path: Path) -> None:
    first, *_, box = parts(tmp_path)
    points = np.array([[0.1, 0.2, 0], [0.6, 0.2, 0.1], [0.1, 0.5, 0], [0.2, 0.2, 0.7]])
    turned = np.array([0, 0.1, 0]) + Rotation.from_euler("XYZ", [10, 20, 30], degrees=True).apply(points)
    lab = turned + np.array(first.position_m) - np.array(box.position_m)
    own = Rotation.from_quat(box.body_from_shape_wxyz, scalar_first=True).inv().apply(lab)
    np.testing.assert_allclose(own.max(axis=0), box.size_m, atol=1e-6)
    np.testing.assert_allclose(-own.min(axis=0), box.size_m, atol=1e-6)
