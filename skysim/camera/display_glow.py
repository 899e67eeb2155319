"""Residual light of an LCD panel's black pixels, in every pixel of the camera."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.background import look, view_of
from skysim.camera.optics import Optics
from skysim.core.types import Floats
from skysim.scene import leds, light
from skysim.sources.dome.display import black, glass
from skysim.sources.dome.led import LOBES, full_e_s_sr
from skysim.sources.dome.surface import build_surface
from skysim.sources.photometry import SUN, Band, star_flux_e_s_m2


def black_glow(
    part: light.DomeConfig | light.StarsConfig | light.BenchConfig,
    optics: Optics,
    cam_from_lab: Rotation,
    camera_m: Floats,
    band: Band,
) -> Floats | None:
    """(H, W) electrons s^-1 px^-1 of a display's black pixels, 1 / contrast of white; None without such a display.

    camera_m : (3,) the entrance pupil in the lab
    A chip pixel sees the display or not, by the direction of its center. So the edge is sharp, and motion during the
    exposure and the row times of a rolling shutter are left out.
    """
    screen = part.layout if isinstance(part, light.DomeConfig) else part
    if not isinstance(screen, leds.PixelsConfig) or not screen.contrast:
        return None
    view = view_of(*look_of_all(optics), optics, cam_from_lab, band)
    if isinstance(part, light.BenchConfig):
        white = bench_radiance_e_s_m2_sr(part, view.toward_lab, band)
    else:
        assert isinstance(part, light.DomeConfig)  # the screen is its layout
        white = panel_radiance_e_s_m2_sr(part, view.toward_lab, camera_m, band)
    glow = black(screen) * white * view.gathered_m2_sr()
    return glow.reshape(optics.camera.height_px, optics.camera.width_px)


@lru_cache(maxsize=2)
def look_of_all(optics: Optics) -> tuple[Floats, Floats]:
    """Viewing directions of all pixels of the chip, (H * W, 3) in camera axes, and their solid angles."""
    y, x = np.indices((optics.camera.height_px, optics.camera.width_px), dtype=float)
    return look(np.column_stack([x.ravel(), y.ravel()]), optics)


def panel_radiance_e_s_m2_sr(
    part: light.DomeConfig, toward_lab: Floats, camera_m: Floats, band: Band
) -> Floats:
    """(N,) radiance of a white panel, mean over a frame, towards the camera: L = I(theta) / (p^2 cos theta).

    0 for directions (N, 3) that miss it. p is the pitch, I a white pixel's intensity from the LED's lobe.
    """
    assert isinstance(part.layout, leds.LcdConfig)
    panel = glass(part.layout, build_surface(part.surface))
    on_it = np.isfinite(panel.meet(camera_m, toward_lab)[:, 0])
    cos_emission = np.where(on_it, -toward_lab @ panel.inward(panel.centre_m[None])[0], 1.0)
    emitted = LOBES[part.led.lobe.kind](part.led.lobe, cos_emission) / cos_emission
    lit = part.led.drive.duty if isinstance(part.led.drive, leds.RefreshConfig) else 1.0
    return np.asarray(on_it * emitted * lit * full_e_s_sr(part.led, band) / part.layout.pitch_m**2)


def bench_radiance_e_s_m2_sr(part: light.BenchConfig, toward_lab: Floats, band: Band) -> Floats:
    """(N,) radiance behind the collimator of a white display; each pixel spans (p / f)^2 cos^3 steradian.

    0 for directions (N, 3) that miss it.
    """
    white_e_s_m2 = float(star_flux_e_s_m2(part.brightest_mag, *SUN, band)) / part.block**2
    up = np.maximum(toward_lab[:, 2], 1e-9)
    half = np.array(part.pixels) * part.pitch_m / 2 / part.focal_length_m
    within = np.all(np.abs(toward_lab[:, :2]) <= half * up[:, None], axis=1) & (toward_lab[:, 2] > 0)
    return np.asarray(within * white_e_s_m2 / ((part.pitch_m / part.focal_length_m) ** 2 * up**3))
