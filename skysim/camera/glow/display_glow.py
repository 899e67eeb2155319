"""Residual light of a display's black pixels (panel, projector, collimator), in every pixel of the camera.

A black pixel gives 1 / contrast of a white one. The radiance of a white display, as the camera sees it, depends on the
kind of display; times that fraction and the etendue of a camera pixel it is the glow.
"""

import numpy as np

from skysim.camera.glow.background import (
    PointedCamera,
    fill,
)
from skysim.core.types import Floats
from skysim.scene.sections import layouts, leds, light
from skysim.sources.dome.display import (
    black_transmission,
    on_chip_m,
    panel_strength_e_s_sr,
    panel_surface,
    pixel_sr,
    white_wall_per_m2,
)
from skysim.sources.dome.led import LOBES
from skysim.sources.dome.surface import build_surface
from skysim.sources.photometry import SUN, Band, star_flux_e_s_m2

NODE_SPACING_PX = 16  # greatest spacing of the nodes of a projector's glow


def black_glow(
    config: light.DomeConfig | light.StarsConfig | light.CollimatedDisplayConfig,
    pointed: PointedCamera,
) -> Floats | None:
    """(H, W) electrons s^-1 px^-1 of a display's black pixels; None without such a display.

    A camera pixel sees the display or not, by the direction of its center. So the edge is sharp, and motion during the
    exposure and the row times of a rolling shutter are left out. A projector's picture on the wall varies smoothly
    except at its edges: it is computed at nodes at most NODE_SPACING_PX apart and interpolated between them.
    """
    screen = config.layout if isinstance(config, light.DomeConfig) else config
    if not isinstance(screen, layouts.PixelsConfig) or not screen.contrast:
        return None
    optics, _, camera_m, band = pointed
    size_px = optics.camera.size_px
    projected = isinstance(screen, layouts.ProjectorConfig)
    counts = [size // NODE_SPACING_PX + 2 for size in size_px] if projected else size_px
    view = pointed.grid(*counts)
    if isinstance(config, light.CollimatedDisplayConfig):
        white = collimated_radiance_e_s_m2_sr(config, view.toward_lab, band)
    else:
        assert isinstance(config, light.DomeConfig)  # the screen is its layout
        radiance = projected_radiance_e_s_m2_sr if projected else panel_radiance_e_s_m2_sr
        white = radiance(config, view.toward_lab, camera_m, band)
    glow = (black_transmission(screen) * white * view.etendue_m2_sr()).reshape(view.shape)
    if not projected:
        return glow
    out = np.empty(size_px[::-1])
    fill(out, glow, 1.0)
    return out


def panel_radiance_e_s_m2_sr(
    config: light.DomeConfig, toward_lab: Floats, camera_m: Floats, band: Band
) -> Floats:
    """(N,) radiance of a white panel towards the camera, mean over a frame: L = I(theta) / (p^2 cos theta).

    I is a white pixel's intensity from the LED's lobe, p the pitch. 0 for directions (N, 3) that miss the panel.
    """
    assert isinstance(config.layout, layouts.LcdConfig)
    panel = panel_surface(config.layout, build_surface(config.surface))
    # Directions that meet the panel.
    hits_panel = np.isfinite(panel.meet(camera_m, toward_lab)[:, 0])
    # Directions that miss it get a harmless cosine.
    cos_emission = np.where(
        hits_panel, -toward_lab @ panel.inward(panel.center_m[None])[0], 1.0
    )
    return (
        hits_panel * white_radiance(config.led, cos_emission, band) / config.layout.pitch_m**2
    )


def projected_radiance_e_s_m2_sr(
    config: light.DomeConfig, toward_lab: Floats, camera_m: Floats, band: Band
) -> Floats:
    """(N,) radiance of the wall in a projector's white picture towards the camera, mean over a frame.

    Like that of a panel, with the area of the wall that a pixel lights in place of p^2, and the pixel's own light.
    """
    assert isinstance(config.layout, layouts.ProjectorConfig)
    # Only where the direction meets the wall.
    surface = build_surface(config.surface)
    place_m = surface.meet(camera_m, toward_lab)
    hits_wall = np.isfinite(place_m[:, 0])
    radiance = np.zeros(len(toward_lab))
    place_m = place_m[hits_wall]
    toward = toward_lab[hits_wall]
    normal = surface.inward(place_m)
    emitted = white_radiance(config.led, -np.sum(toward * normal, axis=1), band)
    radiance[hits_wall] = emitted * white_wall_per_m2(config.layout, place_m, normal)
    return radiance


def white_radiance(led: leds.LedConfig, cos_emission: Floats, band: Band) -> Floats:
    """(N,) radiance of white pixels times the area of one, e- s^-1 sr^-1: I(theta) / cos(theta), mean over a frame.

    cos_emission (N,) are the cosines of the angles theta from the pixels' normal.
    """
    duty = led.drive.duty if isinstance(led.drive, leds.RefreshConfig) else 1.0
    return (
        LOBES[led.lobe.kind](led.lobe, cos_emission)
        / cos_emission
        * duty
        * panel_strength_e_s_sr(led, band)
    )


def collimated_radiance_e_s_m2_sr(
    config: light.CollimatedDisplayConfig, toward_lab: Floats, band: Band
) -> Floats:
    """(N,) radiance behind the collimator of a white display. 0 for directions (N, 3) that miss it."""
    # A star of brightest_mag is a block of white pixels, behind the collimator a parallel beam for
    # each.
    # Flux of one white pixel.
    white_e_s_m2 = float(star_flux_e_s_m2(config.brightest_mag, *SUN, band)) / config.block**2
    _, on_display = on_chip_m(config, toward_lab)
    return on_display * white_e_s_m2 / pixel_sr(config, np.maximum(toward_lab[:, 2], 1e-9))
