"""The sky of a flight as pictures for a display before a real camera, so that the camera sees the sky turn.

The real camera stands still before a monitor, a projected picture or a collimated micro-display. Each light is shown in
the direction in which the simulated camera sees it:

1. Directions in the simulated camera's axes, and irradiances, of the lights that reach it (`lights_of`).
2. Places on the display, through its geometry and the distortion of its lens (`DisplayPattern.places_px`).
3. A spot of 3 x 3 pixels for each light, with its centroid at this place (`spots`).
4. The gray levels with this light, by the display's gamma.
"""

from collections.abc import Iterable
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.discs import centers_of
from skysim.core.errors import InputError
from skysim.core.types import Array, Bools, Floats, Ints, frozen, lengths
from skysim.scene.sections.layouts import (
    LcdConfig,
    LensDisplayConfig,
    PixelsConfig,
    ProjectorConfig,
)
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.exposure import expected_exposure
from skysim.simulation.lab import Lab, StarCamera
from skysim.simulation.lights.light import Exposure, Lit, beam_of
from skysim.sources.dome.display import (
    gray_number,
    on_chip_m,
    own_from_lab,
    panel_surface,
)
from skysim.sources.dome.led import irradiance_e_s_m2
from skysim.sources.dome.surface import Surface, build_surface

PEAK = 0.75**2  # greatest share of a spot's light in one pixel


class DisplayPicture(NamedTuple):
    """One picture for the display.

    Attributes
    ----------
    gray
        (H, W) gray levels, 8 bits
    shown
        Number of lights in the picture
    faint
        Number of lights on the display that are too faint for its gray levels
    limited
        Number of lights brighter than white can show
    """

    gray: Array[np.uint8]
    shown: int
    faint: int
    limited: int


@frozen
class DisplayPattern:
    """Pictures of what a simulated camera sees, for the display of a bench with a real camera.

    The bench is a scene with a display: `light` of kind collimated_display, or a dome with a layout lcd or projector.
    The real camera is where the bench's camera is at its start. Call `picture` for each instant.

    Glows, the Moon's extent, and the fall of the display's light toward its edges are left out.

    Attributes
    ----------
    camera
        Simulated camera, in flight
    screen
        Display of the bench
    surface
        The panel, or the wall of a projector; None behind a collimator
    lab_from_cam, camera_m
        Attitude of the bench's camera, and its (3,) entrance pupil, in the bench's lab
    white_e_s_m2
        Irradiance of the brightest light that white can show; `of_bench` has that of the flight's brightest star. With
        less, faint stars are finer: sRGB's dark grays are coarse
    """

    camera: StarCamera
    screen: PixelsConfig
    surface: Surface | None
    lab_from_cam: Rotation
    camera_m: Floats
    white_e_s_m2: float

    @classmethod
    def of_bench(cls, flown: Lab, bench: Lab) -> Self:
        """The pattern of the main camera of `flown`, on the display of `bench`.

        Raises
        ------
        InputError
            If the bench has no display, or one without 256 gray levels.
        """
        screen: object = bench.scene.light
        surface = None
        if isinstance(screen, DomeConfig):
            surface = build_surface(screen.surface)
            screen = screen.layout
        if isinstance(screen, LcdConfig):
            surface = panel_surface(screen, surface)
        if not isinstance(screen, PixelsConfig):
            raise InputError(
                "light.kind", "no display", "collimated_display, or a layout lcd or projector"
            )
        if screen.gray_levels != 256:
            raise InputError("gray_levels", f"{screen.gray_levels}", "256")
        stands, flies = (
            expected_exposure(lab.camera, lab.start, np.zeros(3), 0.0)
            for lab in (bench, flown)
        )
        _, irradiance = lights_of([flown.camera.known.during(flies)], flies)
        return cls(
            flown.camera,
            screen,
            surface,
            stands.cam_from_lab.inv(),
            stands.camera_m,
            float(irradiance.max()),
        )

    def picture(self, t_s: float, lab_from_body: Rotation) -> DisplayPicture:
        """The picture at a time since the scene's start and an attitude of the vehicle.

        They are those of `Flight.state`, or of the truth of a `Shot`.
        """
        # 1. Lights.
        exposure = expected_exposure(self.camera, lab_from_body, np.zeros(3), t_s)
        beam = beam_of(self.camera.lights, exposure)
        lits = [lit._replace(hidden_by=beam.before(lit)) for lit in beam.lits]
        toward_cam, irradiance = lights_of(lits, exposure)
        # 2. Places. A spot at the edge would be cut, and its centroid wrong.
        width, height = self.screen.pixels
        xy_px, shown = self.places_px(self.lab_from_cam.apply(toward_cam))
        shown &= np.all((xy_px > 0.5) & (xy_px < [width - 1.5, height - 1.5]), axis=1)
        # 3. Spots.
        level = irradiance[shown] / self.white_e_s_m2
        index, share = spots(xy_px[shown], width)
        spot = level[:, None] / PEAK * share
        total = np.bincount(index.ravel(), spot.ravel(), width * height)
        # 4. Gray levels, where there is light: those of all pixels would take 25 ms.
        lit = np.flatnonzero(total)
        gray = np.zeros(len(total), np.uint8)
        gray[lit] = gray_number(self.screen, np.minimum(total[lit], 1.0))
        peak = gray_number(self.screen, np.minimum(spot.max(axis=1, initial=0), 1.0))
        return DisplayPicture(
            gray.reshape(height, width),
            int(np.sum(peak > 0)),
            int(np.sum(peak == 0)),
            int(np.sum(level > 1)),
        )

    def places_px(self, toward_lab: Floats) -> tuple[Floats, Bools]:
        """(N, 2) column and row at directions (N, 3) in the bench's lab, and (N,) whether the display is there."""
        screen = self.screen
        surface = self.surface
        own = toward_lab if surface is None else surface.meet(self.camera_m, toward_lab)
        if isinstance(screen, LensDisplayConfig):
            if isinstance(screen, ProjectorConfig):
                own = own_from_lab(screen).apply(own - screen.position_m)
            own_m, shown = on_chip_m(screen, own)
        else:
            assert surface is not None  # a panel
            own_m = surface.lab_from_own.inv().apply(own - surface.center_m)[:, :2]
            shown = np.isfinite(own_m[:, 0])
        return own_m / screen.pitch_m + (np.array(screen.pixels) - 1) / 2, shown


def lights_of(lits: Iterable[Lit], exposure: Exposure) -> tuple[Floats, Floats]:
    """Unit directions (N, 3) in camera axes and mean irradiances (N,), e- s^-1 m^-2, of what nothing hides of lights.

    Discs are points at their centers.
    """
    toward = [np.zeros((0, 3))]
    irradiance = [np.zeros(0)]
    for lit in lits:
        hidden = lit.occlusion
        for sources in filter(None, (lit.points, centers_of(lit.discs))):
            seen = sources.take(~hidden(sources.place)) if hidden else sources
            offset_m = seen.xyz - seen.place[:, 3:] * exposure.camera_m
            distance_m = lengths(offset_m)
            direction = offset_m / distance_m[:, None]
            cos_out = -np.sum(direction * seen.normal, axis=1)
            near = irradiance_e_s_m2(
                seen.strength, lit.emitter, cos_out, np.ones(1), distance_m
            )
            lit_e_s_m2 = np.where(seen.place[:, 3] > 0, near, seen.strength)
            toward.append(exposure.cam_from_lab.apply(direction))
            irradiance.append(lit_e_s_m2 * seen.on_s / seen.period_s)
    return np.concatenate(toward), np.concatenate(irradiance)


def spots(xy_px: Floats, width: int) -> tuple[Ints, Floats]:
    """(N, 9) flat indices of the 3 x 3 pixels around each place (N, 2), and their (N, 9) shares of its light.

    The shares are the quadratic B-spline, (1/2 - u)^2 / 2, 3/4 - u^2 and (1/2 + u)^2 / 2 with the place's offset u from
    the nearest pixel. Their centroid is u and their variance 1/4 px^2 for every u, so that a moving star neither
    wobbles nor changes its width (de Boor 1978, A Practical Guide to Splines).
    """
    nearest = np.rint(xy_px)
    u = xy_px - nearest
    x, y = np.stack([(0.5 - u) ** 2 / 2, 0.75 - u**2, (0.5 + u) ** 2 / 2]).transpose(2, 1, 0)
    share = (y[:, :, None] * x[:, None, :]).reshape(-1, 9)
    step = np.add.outer(width * np.arange(-1, 2), np.arange(-1, 2)).ravel()
    middle = (nearest @ [1, width]).astype(np.int64)
    return middle[:, None] + step, share
