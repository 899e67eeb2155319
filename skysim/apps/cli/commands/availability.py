"""Command `skysim availability`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Option

from skysim.apps.cli.options import Json, Overrides, SceneArg, load
from skysim.apps.cli.terminal import print_json, progress_callback
from skysim.core.constants import DAY_S, EARTH_MU_M3_S2, HOUR_S, JULIAN_YEAR_DAY
from skysim.core.errors import InputError
from skysim.results.report import Column, Table, print_table, text_column

if TYPE_CHECKING:
    from skysim.core.types import Bools
    from skysim.scene.scene import Scene
    from skysim.scene.sections.surroundings import ExclusionConfig
    from skysim.sources.camera_orbit import Pointing, SkySamples

SPANS_S = {"orbit": None, "day": DAY_S, "year": JULIAN_YEAR_DAY * DAY_S}


def availability(
    scene: SceneArg,
    law: Literal["inertial", "zenith"] = "inertial",
    off_deg: float = 0.0,
    around_deg: float = 0.0,
    span: Literal["orbit", "day", "year"] = "orbit",
    samples: Annotated[int, Option(min=10, max=10_000_000)] = 20_000,
    overrides: Overrides = None,
    picture: Path | None = None,
    json: Json = False,
) -> None:
    """Fraction of an orbit or a year in which the tracker is outside its exclusion angles and sees enough stars.

    Parameters
    ----------
    law
        inertial: toward motion.start; zenith: at --off-deg from it.
    off_deg
        Angle of the boresight from the zenith, 180 is nadir.
    around_deg
        Its azimuth from the flight direction, left positive.
    span
        From the scene's start_time.
    samples
        Times that are computed.
    picture
        Also write a picture (.png) of the angles over time.
    """
    import numpy as np

    config = load(scene, overrides)
    exclusion = config.orbit.exclusion if config.orbit else None
    if exclusion is None:
        raise InputError(
            "orbit.exclusion",
            "the scene has none",
            "a scene with a section orbit with exclusion",
        )
    if law == "inertial" and (off_deg or around_deg):
        raise InputError(
            "--off-deg, --around-deg", "have no effect with --law inertial", "--law zenith"
        )
    pointing = pointing_of(config, law, off_deg, around_deg)
    with progress_callback("availability") as watch:
        found = computed(config, pointing, SPANS_S[span], samples, watch)
    outside = found.outside(exclusion)
    available = np.all(list(outside.values()), axis=0)
    holds = outside | {"all": available}
    fractions = {name: float(times.mean()) for name, times in holds.items()}
    if picture is not None:
        write_picture(picture, found, exclusion, available)
    if json:
        print_json(
            {"span": span, "law": law, "samples": len(found.t_s), "fractions": fractions}
        )
    else:
        title = f"{config.name}: {span} of {found.t_s[-1] / HOUR_S:.4g} h"
        print_table(fraction_table(fractions, exclusion), title)


def fraction_table(fractions: dict[str, float], exclusion: ExclusionConfig) -> Table:
    """The conditions with the fraction of time at which each holds."""
    conditions = {
        "Sun": f"more than {exclusion.sun_deg:g}° away",
        "Earth": f"more than {exclusion.earth_deg:g}° away",
        "Moon": f"more than {exclusion.moon_deg:g}° away",
        "stars": f"at least {exclusion.stars}",
        "all": "available",
    }
    rows = [
        [name, condition, f"{100 * fractions[name]:.2f} %"]
        for name, condition in conditions.items()
    ]
    columns = [text_column(""), Column("condition"), Column("fraction of time")]
    return Table(columns, rows)


def pointing_of(scene: Scene, law: str, off_deg: float, around_deg: float) -> Pointing:
    """The boresight's attitude law. Raises InputError for an inertial one without a direction."""
    import numpy as np

    from skysim.scene.sections.motion import PointingConfig
    from skysim.sources.camera_orbit import Pointing
    from skysim.sources.stars import directions

    start = scene.motion.start
    if law == "zenith":
        return Pointing(
            "zenith", np.zeros(3), math.radians(off_deg), math.radians(around_deg)
        )
    if not isinstance(start, PointingConfig):
        raise InputError("--law inertial", "requires motion.start with ra_deg and dec_deg")
    return Pointing("inertial", directions(start.ra_deg, start.dec_deg))


def computed(
    scene: Scene, pointing: Pointing, span_s: float | None, samples: int, watch: Any
) -> SkySamples:
    """The angles over the span; without one, over one revolution."""
    import numpy as np

    from skysim.sources import camera_orbit, catalog, stars

    orbit = camera_orbit.build_orbit(scene.orbit, scene.start_time)
    assert orbit is not None
    if span_s is None:
        first = orbit.states(np.zeros(1))
        energy = np.sum(first.velocity_m_s**2) / 2 - EARTH_MU_M3_S2 / np.linalg.norm(
            first.position_m
        )
        if energy >= 0:
            raise InputError("--span orbit", "this orbit is not closed", "day, year")
        span_s = float(2 * np.pi * EARTH_MU_M3_S2 / (-2 * energy) ** 1.5)
    t_s = np.asarray((np.arange(samples) + 0.5) * (span_s / samples), float)
    known = catalog.read_for("tracker.catalog", scene.tracker.catalog).to_limit(
        scene.tracker.limit_mag
    )
    camera = scene.camera
    area_px = camera.width_px * camera.height_px
    field_rad = math.atan(math.sqrt(area_px / math.pi) / camera.focal_px)
    return camera_orbit.sample(
        orbit,
        scene.start_time,
        t_s,
        pointing,
        stars.apparent(known, scene.start_time),
        field_rad,
        watch,
    )


def write_picture(
    path: Path, found: SkySamples, exclusion: ExclusionConfig, available: Bools
) -> None:
    """The angles over time with their limits, and the times at which the tracker is available."""
    from skysim.core.files import write_bytes
    from skysim.results.plots import INK, png

    hours = found.t_s / HOUR_S
    curves = (
        ("Sun", found.sun_deg, exclusion.sun_deg),
        ("Earth's limb", found.earth_deg, exclusion.earth_deg),
        ("Moon", found.moon_deg, exclusion.moon_deg),
    )

    def draw(fig: Any) -> None:
        axes = fig.subplots()
        for color, (name, angle_deg, limit_deg) in zip(INK, curves, strict=False):
            axes.plot(hours, angle_deg, color=color, label=name)
            axes.axhline(limit_deg, color=color, linestyle=":", linewidth=0.8)
        axes.fill_between(
            hours,
            0,
            1,
            where=available,
            transform=axes.get_xaxis_transform(),
            color="#009e73",
            alpha=0.15,
        )
        axes.set(xlabel="time [h]", ylabel="angle from the boresight [deg]")
        axes.legend()

    write_bytes(path, png(draw, (7, 3.2)))
