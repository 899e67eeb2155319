"""Attitude profiles of a scene.

1. `read_profile` reads the samples of a file or table (profile_files.py, profile_samples.py).
2. `to_body` converts them to lab_from_body.
3. `profile_samples.check_samples` checks their number, times and steps.
4. `two_axis.on_gimbals` turns them to those that a two-axis mount takes.
5. `reference_curves.AttitudeSpline` interpolates them.
"""

import datetime
from dataclasses import replace
from pathlib import Path
from typing import Any

from skysim.core.errors import InputError
from skysim.core.files import read_table
from skysim.core.text import read_lines
from skysim.core.time import in_utc
from skysim.core.types import Mount
from skysim.dynamics import profile_files, profile_samples
from skysim.dynamics.profile_samples import Samples, check_samples
from skysim.dynamics.reference_curves import AttitudeSpline
from skysim.dynamics.two_axis import on_gimbals
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import ProfileConfig

TABLE = "profile"  # source of a table given in Python


def load_profiles(
    scene: Scene, mount: Mount, given: Any = None
) -> tuple[AttitudeSpline, ...]:
    """The splines of a scene's maneuvers of kind profile, in their order.

    Parameters
    ----------
    scene
        The scene
    mount
        The camera's mount, for profiles of the camera's attitude
    given
        Astropy Table, pandas DataFrame or mapping of columns that replaces the file of the first profile

    Raises
    ------
    InputError
        For an invalid profile; its key is that of the maneuver.
    """
    profiles: list[AttitudeSpline] = []
    for n, element in enumerate(scene.motion.maneuver):
        if isinstance(element, ProfileConfig):
            # A given table replaces the file of the first profile.
            source = given if given is not None and not profiles else Path(element.file)
            try:
                samples = read_profile(source, in_utc(scene.start_time), element.rotation)
                samples = check_samples(to_body(samples, scene, mount))
                if scene.vehicle.gimbals:
                    samples = on_gimbals(samples, scene.vehicle.gimbals)
                profiles.append(AttitudeSpline(samples))
            except InputError as error:
                raise error.within(f"motion.maneuver.{n}") from None
    return tuple(profiles)


def read_profile(
    source: Any, start: datetime.datetime, rotation: str | None = None
) -> Samples:
    """The samples of a file or a table. The format follows from the first line of the file. Raises InputError.

    Parameters
    ----------
    source
        Path of a file, or a table
    start
        The scene's start in UTC, from which epochs count
    rotation
        Name of the rotation of columns q_x, q_y, q_z, q_w; None for other columns
    """
    if not isinstance(source, Path):
        return profile_samples.from_table(source, TABLE, start, rotation)
    # AEM and STK files name their format and frames; other files are tables.
    lines = read_lines(source)
    first = next((line for _, line in lines if not line.startswith("COMMENT")), "")
    is_xml = first.startswith("<")
    is_aem = first.startswith("CCSDS_AEM_VERS") or (
        is_xml and any("<aem" in line for _, line in lines)
    )
    is_stk = first.lower().startswith("stk.v.")
    if (is_aem or is_stk) and rotation is not None:
        raise InputError(
            source, "the file names its frames", "no key rotation in the maneuver"
        )
    if is_aem:
        return profile_files.read_aem(source, lines, start)
    if is_stk:
        return profile_files.read_stk(source, lines, start)
    if first.startswith("# %ECSV"):
        return profile_samples.from_table(read_table(source), source, start, rotation)
    if is_xml:
        raise InputError(source, "XML", "CSV, ECSV, CCSDS AEM, or STK (.a)")
    return profile_samples.read_csv(source, lines, start, rotation)


def to_body(samples: Samples, scene: Scene, mount: Mount) -> Samples:
    """The samples as lab_from_body. Raises InputError for attitudes that the scene's light does not allow.

    Under the stars the lab's axes are those of the ICRS.
    """
    if samples.a in ("body", "cam"):
        samples = samples.inverted()
    sky = scene.stars
    allowed = ("icrs_from_body", "icrs_from_cam") if sky else ("lab_from_body",)
    if samples.direction not in allowed:
        raise InputError(
            samples.source,
            f"attitudes {samples.direction} with light of kind {scene.light.kind}",
            f"{', '.join(allowed)}, or the inverse",
        )
    # lab_from_cam cam_from_body.
    lab_from_body = (
        samples.a_from_b * mount.cam_from_body if samples.b == "cam" else samples.a_from_b
    )
    return replace(samples, a="lab", b="body", a_from_b=lab_from_body)
