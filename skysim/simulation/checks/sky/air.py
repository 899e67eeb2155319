"""What the air does to a scene's frames that the tracker does not know."""

from __future__ import annotations

import math

import numpy as np

from skysim.core.constants import ARCSEC_RAD
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.detection import Context
from skysim.simulation.checks.facts import short
from skysim.simulation.checks.sampling import Samples
from skysim.simulation.lights.air import Atmosphere
from skysim.simulation.lights.light import find_light
from skysim.tracking.external.interface import OWN

MIN_RAISED_ARCSEC = 1.0  # of a refraction that matters


def refraction(context: Context, samples: Samples) -> str:
    """Warn where stars are raised by more than the expected error and the tracker does not undo it: the lowest frame.

    The attitude errs by the refraction at the boresight, and the field's height is shortened by the difference of the
    refractions at its two ends.
    """
    lab = context.lab
    at = samples.frames.attitudes
    atmosphere = find_light(lab.camera.lights, Atmosphere)
    if atmosphere is None or lab.scene.tracker.refraction:
        return ""
    boresight = (at.lab_from_body * lab.camera.mount.cam_from_body.inv()).apply([0.0, 0.0, 1.0])
    zenith = np.array(
        [atmosphere.air.at(exposure.time).zenith for exposure in samples.frames.exposures]
    )
    altitude_rad = np.arcsin(np.sum(boresight * zenith, axis=1))
    n = int(altitude_rad.argmin())
    zenith_rad = math.pi / 2 - altitude_rad[n]
    half_rad = context.camera.optics.field_rad
    around_rad = zenith_rad + np.array([0.0, half_rad, -half_rad])
    middle, low, high = (
        atmosphere.air.refraction.bending_rad(np.abs(around_rad)) * np.sign(around_rad) / ARCSEC_RAD
    )
    expected_arcsec = samples.frames.error.rms_arcsec()[0]
    if not middle > max(MIN_RAISED_ARCSEC, 0.0 if math.isnan(expected_arcsec) else expected_arcsec):
        return ""
    where = attitudes.describe(at, n, lab.scene, lab.camera.mount)
    text = (
        f"the air raises stars by {short(middle)}″ at {where}, {math.degrees(altitude_rad[n]):.1f}° above the horizon,"
        f" and shortens the field by {short(low - high, 2)}″, which the tracker does not know"
    )
    if lab.scene.tracker.name == OWN:
        return f"tracker.refraction: {text}; change it to true"
    return f"tracker.name: {text}; change it to own, with tracker.refraction: true, or point higher"
