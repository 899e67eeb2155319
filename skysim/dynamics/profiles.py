"""The attitude profiles of a scene: read, checked, converted to lab_from_body and fitted by a spline."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

from skysim.core.errors import InputError
from skysim.core.text import read_lines
from skysim.core.time import in_utc
from skysim.core.types import Mount
from skysim.dynamics import profile_aem, profile_stk, profile_table
from skysim.dynamics.profile_samples import Samples, check_samples
from skysim.dynamics.reference_curves import AttitudeSpline, fit_spline
from skysim.scene.scene import Scene
from skysim.scene.sections.light import StarsConfig
from skysim.scene.sections.motion import ProfileConfig

TABLE = "profile"  # source of a table given in Python


def load_profiles(scene: Scene, mount: Mount, given: Any = None) -> tuple[AttitudeSpline, ...]:
    """The profiles of a scene's maneuvers, in their order.

    Parameters
    ----------
    given
        Astropy Table, pandas DataFrame or mapping of columns in place of the first profile's
        file

    Raises
    ------
    InputError
        That begins with the key.
    """
    profiles: list[AttitudeSpline] = []
    for n, element in enumerate(scene.motion.maneuver):
        if isinstance(element, ProfileConfig):
            source = given if given is not None and not profiles else Path(element.file)
            try:
                samples = read_profile(source, in_utc(scene.start_time), element.rotation)
                profiles.append(fit_spline(check_samples(to_body(samples, scene, mount))))
            except InputError as error:
                raise error.within(f"motion.maneuver.{n}") from None
    return tuple(profiles)


def read_profile(source: Any, start: datetime.datetime, rotation: str | None = None) -> Samples:
    """The samples of a file, whose format its content tells, or of a table. Raises InputError.

    Parameters
    ----------
    start
        The scene's start in UTC, from which epochs are counted
    """
    if not isinstance(source, Path):
        return profile_table.from_table(source, TABLE, start, rotation)
    lines = read_lines(source)
    first = next((line for _, line in lines if not line.startswith("COMMENT")), "")
    named = first.startswith("CCSDS_AEM_VERS"), first.lower().startswith("stk.v.")
    if any(named) and rotation is not None:
        raise InputError(source, "the file names its frames", "no key rotation in the maneuver")
    if named[0]:
        return profile_aem.read_aem(source, lines, start)
    if named[1]:
        return profile_stk.read_stk(source, lines, start)
    if first.startswith("# %ECSV"):
        return profile_table.read_ecsv(source, start, rotation)
    if first.startswith("<"):
        raise InputError(
            source, "XML", "CSV, ECSV, CCSDS AEM in keyword = value notation, or STK (.a)"
        )
    return profile_table.read_csv(source, lines, start, rotation)


def to_body(samples: Samples, scene: Scene, mount: Mount) -> Samples:
    """The samples as lab_from_body; under the stars the lab's axes are the ICRS's. Raises InputError for others."""
    if samples.a in ("body", "cam"):
        samples = samples.inverted()
    sky = isinstance(scene.light, StarsConfig)
    allowed = ("icrs_from_body", "icrs_from_cam") if sky else ("lab_from_body",)
    if samples.direction not in allowed:
        raise InputError(
            samples.source,
            f"attitudes {samples.direction} with light of kind {scene.light.kind}",
            f"{', '.join(allowed)}, or the inverse",
        )
    lab_from_body = (
        samples.a_from_b * mount.cam_from_body if samples.b == "cam" else samples.a_from_b
    )
    return Samples(
        samples.source,
        samples.unit,
        samples.places,
        samples.t_s,
        "lab",
        "body",
        lab_from_body,
        samples.absolute,
    )
