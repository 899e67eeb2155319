"""Whether stray light past the baffle costs stars, and whether a body is within the tracker's exclusion angles."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from skysim.camera.glow.background import angular_separation_deg
from skysim.core.types import Floats
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.detection import Context, full_scale_e
from skysim.simulation.checks.facts import short
from skysim.simulation.checks.sampling import Samples
from skysim.simulation.lights.lens import stray_e_s
from skysim.sources.orbit.earth import limb_elevation_rad
from skysim.sources.solar_system.places import place

MAX_LOSS_MAG = 0.5  # of the faintest star
NAMES = {"sun": "the Sun", "moon": "the Moon", "earth": "the Earth"}


def stray_light(context: Context, samples: Samples) -> Iterator[str]:
    """Warn where stray light makes the noise of a pixel so large that fainter stars are lost.

    With n0 the noise without it and s electrons of it the noise is sqrt(n0^2 + s), and the faintest star brighter by
    1.25 log10(1 + s / n0^2) magnitudes.
    """
    lab = context.lab
    at = samples.frames.attitudes
    if lab.scene.camera.baffle is None:
        return
    by_frame = [stray_e_s(lab.camera.lights, exposure) for exposure in samples.frames.exposures]
    stray_e = context.camera.exposure_s * np.array([sum(one.values()) for one in by_frame])
    n = int(stray_e.argmax())
    own_e2 = context.camera.noise_e**2 - context.camera.stray_e
    loss_mag = 1.25 * math.log10(1 + stray_e[n] / own_e2)
    if loss_mag <= MAX_LOSS_MAG:
        return
    allowed_e = own_e2 * (10 ** (MAX_LOSS_MAG / 1.25) - 1)
    source = max(by_frame[n], key=lambda name: by_frame[n][name])
    full_e = full_scale_e(lab.scene.camera.detector)
    yield (
        f"camera.baffle.pst: stray light of {short(stray_e[n])} electrons in a pixel, most of it of"
        f" {source}, of {full_e:.0f} at saturation,"
        f" at {attitudes.describe(at, n, lab.scene, lab.camera.mount)}; the faintest star is {loss_mag:.1f} mag"
        f" brighter; change it to {short(allowed_e / stray_e[n], 2)} times as much, or point farther away"
    )


def exclusion(context: Context, samples: Samples) -> Iterator[str]:
    """Warn where a frame's boresight is within an exclusion angle of the orbit's tracker: the frame nearest to it."""
    lab = context.lab
    at = samples.frames.attitudes
    limits = lab.scene.orbit.exclusion if lab.scene.orbit else None
    if limits is None:
        return
    boresight = (at.lab_from_body * lab.camera.mount.cam_from_body.inv()).apply([0.0, 0.0, 1.0])
    angles_deg = np.array(
        [beside_deg(context, t, axis) for t, axis in zip(at.t_s.tolist(), boresight, strict=True)]
    )
    for column, (name, limit_deg) in enumerate(
        (("sun", limits.sun_deg), ("earth", limits.earth_deg), ("moon", limits.moon_deg))
    ):
        n = int(angles_deg[:, column].argmin())
        if angles_deg[n, column] < limit_deg:
            what = f"{NAMES[name]}'s limb" if name == "earth" else NAMES[name]
            yield (
                f"orbit.exclusion.{name}_deg: {what} is {angles_deg[n, column]:.1f}° from the boresight at"
                f" {attitudes.describe(at, n, lab.scene, lab.camera.mount)}, within {limit_deg:g}°; point farther away"
            )


def beside_deg(context: Context, t_s: float, boresight: Floats) -> Floats:
    """(3,) angles of a boresight from the Sun's center, the Earth's limb and the Moon's center at a time."""
    here = context.lab.camera.viewpoint.observer_at(t_s)
    sun, moon = (
        float(angular_separation_deg(boresight, place(name, here).direction))
        for name in ("sun", "moon")
    )
    limb_deg = math.degrees(float(limb_elevation_rad(here.from_earth.position_m, boresight)))
    return np.array([sun, limb_deg, moon])
