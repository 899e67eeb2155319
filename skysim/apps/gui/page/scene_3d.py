"""3-D view of the laboratory (three.js): dome or sky, lights, vehicle and the camera's field of view."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from nicegui import ui
from scipy.spatial.transform import Rotation

from skysim.apps.gui.messages import FrameView, SceneInfo, Stage
from skysim.apps.gui.page.style import INK

CLASSES = 3  # of brightness, each with its own point size
POINT_M = (0.008, 0.013, 0.02)
DIM, LIT = (0.75, 0.72, 0.62), (1.0, 0.85, 0.25)
SHELL = (0.25, 0.30, 0.38)
# Without a GPU the browser draws on the CPU cores that also render frames: draw rarely then, except under the mouse.
FPS, FPS_SLOW, MOVED_S, MOVED_SLOW_S = 30, 2, 0.1, 0.5
CARD = """(() => { const gl = document.createElement("canvas").getContext("webgl");
  const told = gl && gl.getExtension("WEBGL_debug_renderer_info");
  return Boolean(told) && !/swiftshader|llvmpipe|software/i.test(gl.getParameter(told.UNMASKED_RENDERER_WEBGL)); })()"""


class Space:
    """The three.js scene; `set` builds it, `show` sets the attitude, which a timer draws."""

    def __init__(self) -> None:
        self.scene = ui.scene(
            width=400, height=300, grid=False, background_color=INK["ground"], fps=FPS_SLOW, click_events=[]
        )
        self.scene.classes("w-full h-full").mark("space")
        self.fps = FPS_SLOW
        self.scene.on("pointerenter", lambda: self.scene.props(f"fps={FPS}"), args=[])
        self.scene.on("pointerleave", lambda: self.scene.props(f"fps={self.fps}"), args=[])
        self.vehicle: Any = None
        self.lit: Any = None
        self.stage: Stage | None = None
        self.newest: FrameView | None = None
        self.moves = ui.timer(MOVED_SLOW_S, self.move)

    async def suit(self) -> None:
        """Raise the frame rate if the browser has a GPU."""
        if await ui.run_javascript(CARD, timeout=10):
            self.fps, self.moves.interval = FPS, MOVED_S
            self.scene.props(f"fps={self.fps}")

    def set(self, setting: SceneInfo) -> None:
        """Build the view of a new scene."""
        self.stage = stage = setting.stage
        self.scene.clear()
        with self.scene:
            shell = [list(point) for line in stage.shell_m for point in line]
            self.scene.point_cloud(shell, [list(SHELL)] * len(shell), POINT_M[0] / 2)
            self.cloud(stage)
            self.lit = self.scene.point_cloud([], [], 1.6 * POINT_M[-1])
            with self.scene.group() as self.vehicle:
                self.body(stage)
        away = 1.25 if not setting.under_stars else 2.2
        self.scene.move_camera(away, -away, 0.7 * away, 0, 0, 0.0 if setting.under_stars else 0.5, duration=0)

    def cloud(self, stage: Stage) -> None:
        """Draw the lights in CLASSES of brightness, brighter ones larger."""
        size, places = np.array(stage.size), np.array(stage.lights_m).reshape(-1, 3)
        edges = np.quantile(size, [1 / 3, 2 / 3]) if len(size) else np.zeros(2)
        kind = np.digitize(size, edges)
        for n in range(CLASSES):
            points = places[kind == n].tolist()
            if points:
                self.scene.point_cloud(points, [list(DIM)] * len(points), POINT_M[n])

    def body(self, stage: Stage) -> None:
        """Draw the vehicle and the edges of the camera's field of view."""
        for kind, size, place, wxyz, rgb in stage.shapes:
            turn = Rotation.from_quat(wxyz, scalar_first=True)
            if kind == "box":
                shape: Any = self.scene.box(*(2 * one for one in size))
            elif kind == "sphere":
                shape = self.scene.sphere(size[0], 20, 12)
            else:  # the axis of a cylinder is y in three.js, z in MuJoCo
                shape = self.scene.cylinder(size[0], size[0], 2 * size[1], 24)
                turn = turn * Rotation.from_euler("x", 90, degrees=True)
            shape.move(*place).rotate_R(turn.as_matrix().tolist())
            shape.material("#" + "".join(f"{round(255 * min(max(one, 0.12), 1)):02x}" for one in rgb))
        eye, corners = list(stage.camera_m), [list(one) for one in stage.corners_m]
        for n, corner in enumerate(corners):
            self.scene.line(eye, corner).material(INK["accent"])
            self.scene.line(corner, corners[(n + 1) % 4]).material(INK["accent"])

    def show(self, view: FrameView) -> None:
        """Queue the newest attitude for the timer."""
        self.newest = view

    def move(self) -> None:
        """Timer: set the vehicle's attitude and highlight the lights in view."""
        view, self.newest = self.newest, None
        if view is None or self.vehicle is None or self.stage is None:
            return
        turn = Rotation.from_quat(view.body_wxyz, scalar_first=True)
        self.vehicle.rotate_R(turn.as_matrix().tolist())
        points = self.places({light.id for light in view.lights})
        self.lit.set_points(points, [list(LIT)] * len(points))

    def places(self, seen: Collection[int]) -> list[list[float]]:
        """Positions of the lights with these ids."""
        assert self.stage is not None
        pairs = zip(self.stage.ids, self.stage.lights_m, strict=True)
        return [list(place) for id, place in pairs if id in seen]
