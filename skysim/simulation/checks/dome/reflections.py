"""Whether the tracker detects images of LEDs in the dome's wall."""

from __future__ import annotations

import numpy as np

from skysim.camera.stray.wall import images_in_wall
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.detection import Context, threshold_e, usable
from skysim.simulation.checks.facts import Samples, short
from skysim.simulation.checks.views import View, view

MAX_FRAMES = 4  # in which images are searched


def mirror_images(context: Context, samples: Samples) -> str:
    """Warn where images of LEDs in the wall are bright enough to be taken for LEDs: false lights."""
    lab, frames = context.lab, samples.frames
    if lab.camera.reflecting is None or not lab.camera.reflecting.config.mirrors:
        return ""
    chosen = np.unique(np.linspace(0, len(frames.seen) - 1, MAX_FRAMES).astype(int)).tolist()
    found = [usable(images_at(context, samples, n), context) for n in chosen]
    counts = [len(images) for images in found]
    if not any(counts):
        return ""
    n = chosen[int(np.argmax(counts))]
    peak_e = max(float(images.peak_e.max()) for images in found if len(images)) - context.camera.background_e
    share = threshold_e(context) / peak_e
    specular, cure = lab.camera.reflecting.config.specular, "make the wall matt"
    key = "specular" if specular else "refractive_index"
    if specular:
        cure = f"change it to {short(share * specular, 2)}"
    return (
        f"light.reflection.{key}: the tracker detects up to {max(counts)} images of LEDs in the wall beside"
        f" {len(frames.used[n])} LEDs, the brightest {short(1 / share, 2)} times above its threshold, at"
        f" {attitudes.describe(frames.attitudes, n, lab.scene, lab.camera.mount)}; {cure}"
    )


def images_at(context: Context, samples: Samples, n: int) -> View:
    """The images of LEDs in the wall that the camera has on its chip at one of the frames."""
    lab, at = context.lab, samples.frames.attitudes
    assert lab.camera.reflecting is not None
    lab_from_body = at.lab_from_body[n]
    cam_from_lab = lab.camera.mount.cam_from_body * lab_from_body.inv()
    camera_m = lab_from_body.apply(lab.camera.mount.camera_body_m)
    images = images_in_wall(lab.camera.reflecting, lab.camera.sources, lab.camera.optics, cam_from_lab, camera_m)
    return view(lab, images, lab_from_body, at.rate_body_rad_s[n], context.camera)
