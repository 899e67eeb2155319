"""3-D view of the laboratory (three.js): dome or sky, lights, vehicle and the camera's field of view."""

from __future__ import annotations

from typing import Any

import numpy as np
from nicegui import ui
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.apps.gui.messages import FrameView, LabGeometry, SceneInfo, Triple
from skysim.apps.gui.page.style import DARK, color_scale
from skysim.core.types import Floats

BRIGHTNESS_CLASSES = 3  # each with its own point size
POINT_M = (0.008, 0.013, 0.02)
DIM_RGB, HIGHLIGHT_RGB = (0.75, 0.72, 0.62), (1.0, 0.85, 0.25)
SRGB_GAMMA = 2.2  # the colors of points are linear
DOME_RGB = (0.25, 0.30, 0.38)
# Without a GPU the browser draws on the CPU cores that also render frames: draw rarely then, except under the mouse.
FPS, FPS_SLOW, UPDATE_S, UPDATE_SLOW_S = 30, 2, 0.1, 0.5
HAS_GPU_JS = """(() => { const gl = document.createElement("canvas").getContext("webgl");
  const info = gl && gl.getExtension("WEBGL_debug_renderer_info");
  return Boolean(info) && !/swiftshader|llvmpipe|software/i.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)); })()"""


class Scene3D:
    """The three.js scene; `set_scene` builds it, `show` sets the attitude, which a timer draws."""

    def __init__(self) -> None:
        self.scene = ui.scene(
            width=400, height=300, grid=False, background_color=DARK["ground"], fps=FPS_SLOW, click_events=[]
        )
        self.scene.classes("w-full h-full lab-space").mark("space")
        self.fps = FPS_SLOW
        self.scene.on("pointerenter", lambda: self.scene.props(f"fps={FPS}"), args=[])
        self.scene.on("pointerleave", lambda: self.scene.props(f"fps={self.fps}"), args=[])
        self.vehicle: Any = None
        self.highlighted: Any = None
        self.colored: Any = None
        self.geometry: LabGeometry | None = None
        self.newest_view: FrameView | None = None
        self.timer = ui.timer(UPDATE_SLOW_S, self.update)

    async def adapt_frame_rate(self) -> None:
        """Raise the frame rate if the browser has a GPU."""
        if await ui.run_javascript(HAS_GPU_JS, timeout=10):
            self.fps, self.timer.interval = FPS, UPDATE_S
            self.scene.props(f"fps={self.fps}")

    def set_scene(self, scene_info: SceneInfo) -> None:
        self.geometry = geometry = scene_info.geometry
        self.scene.clear()
        with self.scene:
            self.draw_points(geometry.dome_m, DOME_RGB, POINT_M[0] / 2)
            self.draw_lights(geometry)
            self.colored = self.scene.point_cloud([], [], 1.3 * POINT_M[-1])
            self.highlighted = self.scene.point_cloud([], [], 1.6 * POINT_M[-1])
            with self.scene.group() as self.vehicle:
                self.draw_vehicle(geometry)
        distance, target_z = (2.2, 0.0) if scene_info.under_stars else (1.25, 0.5)
        self.scene.move_camera(distance, -distance, 0.7 * distance, 0, 0, target_z, duration=0)

    def draw_lights(self, geometry: LabGeometry) -> None:
        """Draw the lights in BRIGHTNESS_CLASSES classes, brighter ones larger."""
        edges = np.quantile(geometry.size, [1 / 3, 2 / 3]) if len(geometry.size) else np.zeros(2)
        kind = np.digitize(geometry.size, edges)
        for n in range(BRIGHTNESS_CLASSES):
            if (kind == n).any():
                self.draw_points(geometry.lights_m[kind == n], DIM_RGB, POINT_M[n])

    def color_lights(self, ids: NDArray[np.int64], values: Floats) -> None:
        """Color some lights by values from 0 to 1, until the scene changes."""
        assert self.geometry is not None
        known = np.isin(ids, self.geometry.ids)
        order = np.argsort(self.geometry.ids)
        rows = order[np.searchsorted(self.geometry.ids, ids[known], sorter=order)]
        linear_rgb = color_scale(values[known]) ** SRGB_GAMMA
        self.colored.set_points(self.geometry.lights_m[rows].tolist(), linear_rgb.tolist())

    def draw_points(self, points_m: Floats, rgb: Triple, size_m: float) -> None:
        self.scene.point_cloud(points_m.tolist(), [list(rgb)] * len(points_m), size_m)

    def draw_vehicle(self, geometry: LabGeometry) -> None:
        for kind, size, position, wxyz, rgb in geometry.shapes:
            rotation = Rotation.from_quat(wxyz, scalar_first=True)
            if kind == "box":
                shape: Any = self.scene.box(*(2 * value for value in size))
            elif kind == "sphere":
                shape = self.scene.sphere(size[0], 20, 12)
            else:  # the axis of a cylinder is y in three.js, z in MuJoCo
                shape = self.scene.cylinder(size[0], size[0], 2 * size[1], 24)
                rotation = rotation * Rotation.from_euler("x", 90, degrees=True)
            shape.move(*position).rotate_R(rotation.as_matrix().tolist())
            shape.material("#" + "".join(f"{round(255 * min(max(value, 0.12), 1)):02x}" for value in rgb))
        pupil, corners = geometry.camera_m.tolist(), geometry.corners_m.tolist()
        for n, corner in enumerate(corners):
            self.scene.line(pupil, corner).material(DARK["accent"])
            self.scene.line(corner, corners[(n + 1) % 4]).material(DARK["accent"])

    def show(self, view: FrameView) -> None:
        """Queue the newest attitude for the timer."""
        self.newest_view = view

    def update(self) -> None:
        """Timer: set the vehicle's attitude and highlight the lights in view."""
        view, self.newest_view = self.newest_view, None
        if view is None or self.vehicle is None or self.geometry is None:
            return
        rotation = Rotation.from_quat(view.body_wxyz, scalar_first=True)
        self.vehicle.rotate_R(rotation.as_matrix().tolist())
        in_view = np.isin(self.geometry.ids, [light.id for light in view.lights])
        points = self.geometry.lights_m[in_view].tolist()
        self.highlighted.set_points(points, [list(HIGHLIGHT_RGB)] * len(points))
