"""3-D geometry of the laboratory, as numbers for the browser to draw."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skysim.apps.gui.messages import Stage, Triple
from skysim.core.types import Floats
from skysim.dynamics import multibody
from skysim.scene.light import DomeConfig
from skysim.simulation.testbed import Testbed
from skysim.sources.dome import surface
from skysim.sources.dome.surface import Surface

SKY_RADIUS_M = 2.5
MOST_STARS, MOST_LEDS = 600, 4000
RAY_M = 2.5  # drawn length of the field's edges that meet no surface
RINGS, SECTORS, DOTS = 4, 12, 144  # of the dotted lines on a dome


def of(lab: Testbed) -> Stage:
    """Geometry of a testbed: vehicle, lights, camera and dome."""
    under_dome = isinstance(lab.scene.light, DomeConfig)
    ids, place, size = lights(lab, under_dome)
    shapes = tuple(
        (one.kind, one.size_m, one.place_m, one.body_from_shape_wxyz, one.rgba[:3])
        for one in multibody.shapes(lab.ship)
    )
    return Stage(
        shapes,
        tuple(ids.tolist()),
        triples(place),
        tuple(size.tolist()),
        triples(lab.mount.camera_body_m[None])[0],
        triples(corners_m(lab)),
        shell(lab) if under_dome else (),
    )


def lights(lab: Testbed, under_dome: bool) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Ids, (N, 3) positions and (N,) drawn sizes of the brightest lights, the brightest first.

    The size grows with the time-averaged power to the power of 0.3, so that faint lights remain visible.
    """
    sources = lab.sources
    power = sources.strength * np.minimum(sources.on_s / sources.period_s, 1.0)
    rows = np.argsort(-power)[: MOST_LEDS if under_dome else MOST_STARS]
    place = sources.place[rows, :3] * (1.0 if under_dome else SKY_RADIUS_M)
    brightest = max(float(power[rows[0]]), 1e-300) if len(rows) else 1.0
    return sources.id[rows], place, np.clip((power[rows] / brightest) ** 0.3, 0.15, 1.0)


def corners_m(lab: Testbed) -> Floats:
    """(4, 3) points where the field's corners meet the dome with the vehicle level, else RAY_M away; body axes."""
    camera = lab.scene.camera
    x, y = camera.width_px / 2 / camera.focal_px, camera.height_px / 2 / camera.focal_px
    rays_cam = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1.0]])
    rays = lab.mount.cam_from_body.inv().apply(rays_cam / np.linalg.norm(rays_cam, axis=1)[:, None])
    away = lab.mount.camera_body_m + RAY_M * rays
    if not isinstance(lab.scene.light, DomeConfig):
        return away
    met = surface.build_surface(lab.scene.light.surface).meet(lab.mount.camera_body_m, rays)
    return np.where(np.isfinite(met), met, away)


def shell(lab: Testbed) -> tuple[tuple[Triple, ...], ...]:
    """Circles of equal polar angle and meridians on the dome's inside, as lists of points."""
    assert isinstance(lab.scene.light, DomeConfig)
    inside = surface.build_surface(lab.scene.light.surface)
    most = np.radians(lab.scene.light.layout.cap_deg)
    around = np.linspace(0, 2 * np.pi, 49)
    lines = [met(inside, np.full(49, most * n / RINGS), around) for n in range(1, RINGS + 1)]
    lines += [met(inside, np.linspace(0, most, 13), np.full(13, a)) for a in around[: 48 : 48 // SECTORS]]
    return tuple(triples(line) for line in lines if len(line) > 1)


def met(inside: Surface, lean: Floats, azimuth: Floats) -> Floats:
    """(K, 3) points where rays from the bearing meet the dome; rays that miss it are left out. Angles in rad."""
    rays = np.column_stack([np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), np.cos(lean)])
    places = inside.meet(np.zeros(3), rays)
    return places[np.isfinite(places).all(axis=1)]


def triples(rows: Floats) -> tuple[Triple, ...]:
    return tuple((float(x), float(y), float(z)) for x, y, z in rows)
