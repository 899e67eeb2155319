"""Our projection against MuJoCo's camera: OpenGL draws a bright ball at the pixel that our optics predict."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.dynamics.multibody.model import CAM_FROM_MJCAM
from skysim.scene.sections.camera import CameraConfig

WIDTH = 640
HEIGHT = 480
CAMERA = CameraConfig.model_validate(
    {
        "width_px": WIDTH,
        "height_px": HEIGHT,
        "pixel": "10 um",
        "focal_length": "6 mm",
        "f_number": 2.0,
        "detector": {
            "quantum_efficiency": 0.5,
            "full_well_e": 40000,
            "gain_e_dn": 10,
            "bits": 12,
        },
    }
)
BALL_M = (
    0.03  # at 2 m its image is 18 px wide; perspective moves its middle by 1e-4 of the offset
)
POSES = {  # lab_from_mjcam as a quaternion wxyz, and where the camera stands
    "as it comes": ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "looking up": (
        tuple(Rotation.from_euler("xz", [180, 35], True).as_quat(scalar_first=True)),
        (0.3, -0.2, 1.0),
    ),
    "aslant": (
        tuple(Rotation.from_rotvec([0.7, -1.9, 0.4]).as_quat(scalar_first=True)),
        (-1.0, 2.0, 0.5),
    ),
}
# Directions in camera axes, +x right, +y down: each side of both axes, the diagonals, near and far.
TOWARD_CAM_M = np.array(
    [
        [0, 0, 2],
        [0.7, 0, 2],
        [-0.7, 0, 2],
        [0, 0.5, 2],
        [0, -0.5, 2],
        [0.8, -0.55, 2],
        [-1.5, 1.1, 4],
    ],
    float,
)

# In a process of its own: MuJoCo chooses its OpenGL once, when it is first imported.
DRAW = """
import json, sys
import numpy as np
task = json.load(sys.stdin)
try:
    import mujoco
    mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
except Exception as error:
    print(f"{type(error).__name__}: {error}")
    sys.exit(3)
model = mujoco.MjModel.from_xml_string(task["xml"])
data = mujoco.MjData(model)
renderer = mujoco.Renderer(model, task["height"], task["width"])
images = []
for place in task["places_m"]:
    data.mocap_pos[0] = place
    mujoco.mj_forward(model, data)
    renderer.update_scene(data, camera="eye")
    images.append(renderer.render().astype(np.uint16).sum(axis=2))
np.save(task["file"], np.array(images))
"""


def world_xml(quaternion_wxyz: tuple[float, ...], place_m: tuple[float, ...]) -> str:
    """A ball that glows, a camera whose vertical field is our chip's, and no other light."""
    fovy_deg = float(np.degrees(2 * np.arctan(HEIGHT / 2 / CAMERA.focal_px)))
    place, turn = (
        " ".join(map(repr, map(float, numbers))) for numbers in (place_m, quaternion_wxyz)
    )
    return f"""
    <mujoco>
      <statistic extent="1"/>
      <visual>
        <global offwidth="{WIDTH}" offheight="{HEIGHT}"/>
        <headlight ambient="0 0 0" diffuse="0 0 0" specular="0 0 0"/>
        <map znear="0.01"/>
      </visual>
      <asset><material name="glow" emission="1" rgba="1 1 1 1"/></asset>
      <worldbody>
        <camera name="eye" pos="{place}" quat="{turn}" fovy="{fovy_deg!r}"/>
        <body mocap="true"><geom size="{BALL_M}" material="glow"/></body>
      </worldbody>
    </mujoco>"""


def drawn(xml: str, places_m: np.ndarray, file: Path) -> np.ndarray:
    """(N, H, W) pictures of the ball at N places. Skips if no OpenGL context can be created."""
    task = {
        "xml": xml,
        "places_m": places_m.tolist(),
        "width": WIDTH,
        "height": HEIGHT,
        "file": str(file),
    }
    done = subprocess.run(
        [sys.executable, "-c", DRAW],
        input=json.dumps(task),
        env={"MUJOCO_GL": "egl"} | dict(os.environ),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    if done.returncode == 3:
        pytest.skip(f"no OpenGL context for MuJoCo's renderer: {done.stdout.strip()}")
    assert done.returncode == 0, done.stderr
    return np.load(file)


def middles(pictures: np.ndarray) -> np.ndarray:
    """(N, 2) centroids of the bright pixels; each picture has one whole ball."""
    y, x = np.indices(pictures.shape[1:])
    bright = pictures > pictures.max() / 2
    assert (bright.sum(axis=(1, 2)) > 20).all()
    assert not bright[:, [0, -1], :].any()
    assert not bright[:, :, [0, -1]].any()
    return np.array([[x[one].mean(), y[one].mean()] for one in bright])


@pytest.mark.slow
@pytest.mark.parametrize("pose", POSES)
def test_mujoco_draws_the_ball_where_our_optics_project_it(pose: str, tmp_path: Path) -> None:
    quaternion_wxyz, place_m = POSES[pose]
    lab_from_mjcam = Rotation.from_quat(quaternion_wxyz, scalar_first=True)
    lab_from_cam = lab_from_mjcam * CAM_FROM_MJCAM.inv()
    balls_m = np.array(place_m) + lab_from_cam.apply(TOWARD_CAM_M)
    found = middles(
        drawn(world_xml(quaternion_wxyz, place_m), balls_m, tmp_path / "balls.npy")
    )
    wanted = Optics.from_camera(CAMERA).project(
        lab_from_cam.inv().apply(balls_m - np.array(place_m))
    )
    # A ball's outline is an ellipse whose middle is off by (r / z)^2 of the offset, and OpenGL draws it as facets.
    np.testing.assert_allclose(found, wanted, rtol=0, atol=0.25)


@pytest.mark.slow
def test_mujoco_s_camera_has_the_image_axes_of_ours(tmp_path: Path) -> None:
    """By MuJoCo's manual alone: its camera looks along -z, +x is right, +y is up; row 0 is the top."""
    balls_m = np.array([[0.6, 0.0, -2.0], [0.0, 0.4, -2.0]])
    right, above = middles(
        drawn(world_xml(*POSES["as it comes"]), balls_m, tmp_path / "balls.npy")
    )
    np.testing.assert_allclose(right, [319.5 + 600 * 0.3, 239.5], rtol=0, atol=0.25)
    np.testing.assert_allclose(above, [319.5, 239.5 - 600 * 0.2], rtol=0, atol=0.25)
