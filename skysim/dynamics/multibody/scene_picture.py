"""Pictures and animations of the laboratory, which MuJoCo renders without a screen."""

import errno
import io
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import cv2
import mujoco
import numpy as np

from skysim.core.errors import InputError, unknown_name
from skysim.core.files import atomic_file
from skysim.core.guarded import GL_OFF, PYTHON
from skysim.core.types import Array, Floats
from skysim.dynamics.multibody.mjcf import LAB_CAMERA, MujocoWarnings, one_line

Picture = Array[np.uint8]

# Width and height.
PICTURE_PX = (960, 720)
FILM_PX = (480, 360)
NO_OPENGL = (
    "no picture of the lab: {why}; MuJoCo draws with OpenGL by EGL: apt-get install libegl1 libgl1-mesa-dri"
    " (or libosmesa6, and MUJOCO_GL=osmesa)"
)
# Formats that browsers show, with encoder options for less than 20 kB per frame of FILM_PX.
ANIMATED = {
    ".gif": [cv2.IMWRITE_GIF_DITHER, 3],
    ".webp": [cv2.IMWRITE_WEBP_QUALITY, 75],
}


class NoPicture(RuntimeError):
    """Rendering is not possible on this machine; the message is one line and says what to install."""


def picture(mjcf: str, qpos: Floats, size_px: tuple[int, int] = PICTURE_PX) -> Picture:
    """(H, W, 3) RGB picture of the laboratory from its camera `lab`. Raises NoPicture.

    Parameters
    ----------
    mjcf
        Text from `mjcf_export.mjcf`
    qpos
        (nq,) joint positions
    size_px
        Width and height, at most `mjcf_export.MAX_PX`
    """
    return next(film(mjcf, np.atleast_2d(qpos), size_px))


def film(mjcf: str, qpos: Floats, size_px: tuple[int, int] = FILM_PX) -> Iterator[Picture]:
    """Yield a `picture` for each row of qpos (N, nq), as it is rendered.

    Rendering runs in its own process. MuJoCo chooses its OpenGL when it is first imported, by MUJOCO_GL (here EGL
    by default), and a graphics driver may crash the whole process.
    """
    # The task goes to the process as a file, and each picture comes back as raw bytes.
    width, height = size_px
    with tempfile.TemporaryFile() as task, tempfile.TemporaryFile() as errors:
        np.savez(task, mjcf=np.array(mjcf), qpos=qpos, size_px=np.array(size_px))
        task.seek(0)
        environment = dict(os.environ)
        if environment.get("MUJOCO_GL") in (None, GL_OFF):
            environment["MUJOCO_GL"] = "egl"
        with subprocess.Popen(
            [*PYTHON, "-m", "skysim.dynamics.multibody.scene_picture"],
            stdin=task,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
        ) as renderer:
            try:
                for _ in range(len(qpos)):
                    raw = renderer.stdout.read(height * width * 3) if renderer.stdout else b""
                    # A short read means that the process has ended.
                    if len(raw) < height * width * 3:
                        raise NoPicture(
                            NO_OPENGL.format(why=failure_reason(renderer.wait(), errors))
                        )
                    yield np.frombuffer(raw, np.uint8).reshape(height, width, 3)
            finally:
                renderer.kill()  # a caller may stop before the last picture


def write_film(pictures: Iterable[Picture], path: Path, fps: float) -> None:
    """Write RGB pictures as .gif, or as .webp, which is a quarter as large.

    Parameters
    ----------
    pictures
        (H, W, 3) RGB pictures
    path
        File to write
    fps
        Pictures per second; a GIF counts in hundredths of a second, and browsers show 50 at most

    Raises
    ------
    InputError
        For another type of file.
    OSError
        If the file cannot be written.
    """
    if path.suffix not in ANIMATED:
        raise InputError(path, *unknown_name("animation format", path.suffix, ANIMATED))
    animation = cv2.Animation()
    animation.frames = [cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) for picture in pictures]
    animation.durations = [round(1000 / fps)] * len(animation.frames)
    done, coded = cv2.imencodeanimation(path.suffix, animation, ANIMATED[path.suffix])
    if not done:
        raise OSError(errno.EIO, "OpenCV could not encode the film", str(path))
    with atomic_file(path) as temporary:
        temporary.write_bytes(coded.tobytes())


def failure_reason(code: int, errors: IO[bytes]) -> str:
    """The last line that the rendering process wrote to standard error, or its signal or exit code."""
    errors.seek(0)
    lines = errors.read().decode(errors="replace").strip().splitlines()
    if code < 0:
        return f"the renderer was ended by {signal.Signals(-code).name}"
    return (
        one_line(RuntimeError(lines[-1]))
        if lines
        else f"the renderer exited with code {code}"
    )


def render_task() -> None:
    """Main function of the rendering process: task as npz on stdin, raw pictures on stdout, errors on stderr."""
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # output of a driver to stdout must not reach the pictures
        with np.load(io.BytesIO(sys.stdin.buffer.read())) as task, MujocoWarnings():
            text = str(task["mjcf"])
            states = task["qpos"]
            width, height = task["size_px"].tolist()
            model = mujoco.MjModel.from_xml_string(text)
            data = mujoco.MjData(model)
            with mujoco.Renderer(model, height, width) as renderer:
                for qpos in states:
                    data.qpos[:] = qpos
                    mujoco.mj_forward(model, data)
                    renderer.update_scene(data, camera=LAB_CAMERA)
                    out.write(np.ascontiguousarray(renderer.render()).tobytes())


if __name__ == "__main__":
    try:
        render_task()
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {one_line(error)}")
