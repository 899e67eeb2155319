"""Whether the tracker detects images of LEDs in the dome's wall."""

from __future__ import annotations

from skysim.simulation.checks import attitudes
from skysim.simulation.checks.detection import Context, threshold_e
from skysim.simulation.checks.facts import short
from skysim.simulation.checks.sampling import Samples
from skysim.simulation.lights.light import find_light
from skysim.simulation.lights.wall import IMAGES, Mirror


def mirror_images(context: Context, samples: Samples) -> str:
    """Warn where images of LEDs in the wall are bright enough to be taken for LEDs: false lights."""
    lab = context.lab
    frames = samples.frames
    mirror = find_light(lab.camera.lights, Mirror)
    found = {n: others[IMAGES] for n, others in enumerate(frames.others) if IMAGES in others}
    if mirror is None or not found:
        return ""
    n = max(found, key=lambda n: len(found[n]))
    peak_e = (
        max(float(images.peak_e.max()) for images in found.values()) - context.camera.background_e
    )
    share = threshold_e(context) / peak_e
    specular = mirror.dome.config.specular
    cure = "make the wall matt"
    key = "specular" if specular else "refractive_index"
    if specular:
        cure = f"change it to {short(share * specular, 2)}"
    return (
        f"light.reflection.{key}: the tracker detects up to {len(found[n])} images of LEDs in the wall beside"
        f" {len(frames.used[n])} LEDs, the brightest {short(1 / share, 2)} times above its threshold, at"
        f" {attitudes.describe(frames.attitudes, n, lab.scene, lab.camera.mount)}; {cure}"
    )
