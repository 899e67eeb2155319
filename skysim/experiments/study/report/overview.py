"""The first part of a study's report: its scene as a table, and the findings of the scene's checks."""

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.core.yaml_reader import one_line
from skysim.experiments.study.execution.trials import rate_axis
from skysim.experiments.study.factors import (
    Distribution,
    Factor,
    Option,
    Point,
    Range,
    make_point,
)
from skysim.experiments.study.plan import (
    CentroidTrial,
    FlightTrial,
    FrameTrial,
    Plan,
    Trial,
    resolve_point,
)
from skysim.experiments.study.study_file import (
    SURVEY_SEED,
    fixed_seeds,
    may_report_ambiguity,
)
from skysim.experiments.study.table import format_level
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation import checks
from skysim.simulation.checks.expected_error import CENTROIDS
from skysim.simulation.checks.facts import SURVEYED, TRACKER_KNOWS, Fact
from skysim.simulation.lab import Lab, UserParts, build_lab

Texts = list[tuple[str, str]]  # names with texts, or texts with the names of points
NUMBER = re.compile(r"\d[\d.]*")
# Maximum number of scenes that are checked: building one takes up to a second.
MAX_CHECKED = 16


class Overview(NamedTuple):
    """The first part of a report.

    Attributes
    ----------
    rows
        Names and texts of the scene table, for the first level of every factor
    findings
        Findings of the checks at the rates of the trials, each with the levels at which it was
        found
    may_be_ambiguous
        Whether the tracker can refuse a frame as ambiguous
    fixed
        Seeds of hardware that all trials share, see `study_file.fixed_seeds`
    require
        Requirements of the study, or else of its scene
    survey_share
        Largest share of a survey that all trials share in the expected variance
    """

    rows: Texts
    findings: list[str]
    may_be_ambiguous: bool
    fixed: tuple[str, ...]
    require: Mapping[str, float]
    survey_share: float


def overview(plan: Plan) -> Overview:
    """The overview of a study. The finding of a scene that cannot be built is the reason."""
    points = dict(itertools.islice(checked_points(plan), MAX_CHECKED))
    rows: Texts = []
    found: dict[str, Texts] = {}
    leds: dict[str, int] = {}
    may_be_ambiguous = False
    fixed = dict[str, None]()
    require = plan.study.require
    share = 0.0
    for levels, point in points.items():
        try:
            scene, trial = resolve_point(
                plan.spec, plan.spec.trial_settings(point.settings, 0)
            )
            lab = build_lab(scene, UserParts(plan.spec.programs))
            found_here = checks.check(
                lab,
                greatest_tilt_deg(scene, trial),
                trial_rate_rad_s(trial, lab),
                not isinstance(trial, FlightTrial) or trial.start is not None,
            )
        except InputError as error:
            lines = [str(error)]
        else:
            lines = found_here.findings
            rows = rows or scene_rows(plan, lab, found_here.facts)
            if scene.dome:
                leds[levels] = len(lab.camera.sources)
            may_be_ambiguous |= may_report_ambiguity(scene)
            if not plan.study.optimize:  # candidates need not meet them
                require = require or scene.require
            seeds = fixed_seeds(plan.study, scene)
            fixed |= dict.fromkeys(seeds)
            if SURVEY_SEED in seeds or scene.tracker.map:
                share = max(share, survey_share(found_here, trial))
        for line in lines:
            found.setdefault(NUMBER.sub("#", line), []).append((line, levels))
    # The number of LEDs is in the name of a checked point if the points of the study differ in it.
    if len(set(leds.values())) > 1:
        found = {
            key: [(line, f"{at}, {leds[at]} LEDs" if at in leds else at) for line, at in one]
            for key, one in found.items()
        }
    findings = [finding_text(one, len(points)) for one in found.values()]
    return Overview(rows, findings, may_be_ambiguous, tuple(fixed), require, share)


def survey_share(found: checks.Check, trial: Trial) -> float:
    """The larger share of the survey in the expected variance of cross and roll at the attitudes in reach.

    Trials of centroids have their own noise instead of that of the images.
    """
    (reach,) = (one.values["reach"] for one in found.facts if one.name == "expected error")
    scale = trial.noise_px / reach["centroid_px"] if isinstance(trial, CentroidTrial) else 1.0
    shares = [0.0]
    for angle in ("cross", "roll"):
        sizes = reach[f"{angle}_causes_arcsec"]
        sizes |= {CENTROIDS: scale * sizes.get(CENTROIDS, 0.0)}
        total = math.fsum(size**2 for size in sizes.values())
        if total:
            shares.append(math.fsum(sizes.get(name, 0.0) ** 2 for name in SURVEYED) / total)
    return max(shares)


def greatest_tilt_deg(scene: Scene, trial: Trial) -> float | None:
    """The greatest tilt of a trial's random attitudes under a dome; None if there are none."""
    drawn = trial.start if isinstance(trial, FlightTrial) else trial
    return None if drawn is None or not scene.dome else float(np.max(drawn.tilt_deg))


def finding_text(at: Texts, checked: int) -> str:
    """Text of a finding that has other numbers at other levels: the first one, and the levels at which it was found."""
    line, first = at[0]
    if len(at) != checked:
        return f"{line} [{'; '.join(levels for _, levels in at)}]"
    if len({text for text, _ in at}) == 1:
        return line
    return f"{line} [{first}; with other numbers at all others]"


def trial_rate_rad_s(trial: Trial, lab: Lab) -> Floats | None:
    """(3,) rate of a trial of a single attitude in body axes; None for a flight, whose rates are in its scene."""
    if isinstance(trial, FlightTrial):
        return None
    if not isinstance(trial, FrameTrial):
        return np.zeros(3)
    # For a random axis, one between the camera's x and y is taken: a rolling shutter then both shears and stretches.
    axis_cam = rate_axis(trial.rate_axis, math.pi / 4, lab.camera.mount)
    return lab.camera.mount.body_from_cam.apply(math.radians(trial.rate_deg_s) * axis_cam)


def checked_points(plan: Plan) -> Iterator[tuple[str, Point]]:
    """The points whose scenes are checked, with their names; each once.

    They are the point of all first levels, the corners of the design with all factors at their ends first, since a long
    exposure and a fast rate smear only together, and each other level of a factor that changes the scene.
    """
    levels = {name: options(factor) for name, factor in plan.study.factors.items()}
    first = {name: one[0] for name, one in levels.items()}
    corners = itertools.product(*(ends(one) for one in levels.values()))
    chosen = [
        first,
        *reversed([dict(zip(levels, corner, strict=True)) for corner in corners]),
    ]
    for name, one in levels.items():
        chosen += [
            first | {name: level}
            for level in one[1:]
            if any(not key.startswith("trial.") for key in level[1])
        ]
    named = {}
    for point in chosen:
        changed = [
            f"{name} = {format_level(level[0])}"
            for name, level in point.items()
            if level != first[name]
        ]
        named[", ".join(changed) or "first levels"] = make_point(point)
    yield from named.items()


def ends(levels: list[Option]) -> list[Option]:
    """The levels with the least and the greatest number; the first and the last one of levels without numbers."""
    numbers = [float(found[0]) for value, _ in levels if (found := NUMBER.match(str(value)))]
    if len(numbers) == len(levels):
        levels = [levels[n] for n in np.argsort(numbers)]
    return [levels[0], levels[-1]] if len(levels) > 1 else levels


def options(factor: Factor) -> list[Option]:
    """The levels of a factor, the ends of a range, or the median of a distribution."""
    if isinstance(factor, Range):
        return [factor.value_at(0.0), factor.value_at(1.0)]
    return factor.options() or [factor.value_at(0.5)]


# The table.


def scene_rows(plan: Plan, lab: Lab, facts: Sequence[Fact]) -> Texts:
    """Rows on the scene of a lab, its tracker by the facts of the checks, and how the study varies and repeats it."""
    study = plan.study
    scene = lab.scene
    changed = "; ".join(
        f"{key}: {one_line(value, sort_keys=False)}" for key, value in study.set.items()
    )
    points = f"at each of {len(plan.points)} points" if plan.points else "a candidate"
    attitudes = f"{'the same' if study.paired else 'other'} attitudes at every point"
    name = study.scene if isinstance(study.scene, str) else scene.title
    return [
        ("scene", name + (f", with {changed}" if changed else "")),
        ("light", light_text(scene, lab)),
        ("camera", camera_text(scene.camera)),
        ("exposure", f"{1e3 * scene.exposure.time_s:.4g} ms"),
        ("tracker", tracker_text(scene)),
        *((fact.name, "; ".join(fact.lines)) for fact in facts if fact.name == TRACKER_KNOWS),
        ("trial", one_line(plan.spec.trial, sort_keys=False)[1:-1]),
        *((f"varied: {name}", factor_text(factor)) for name, factor in study.factors.items()),
        ("trials", f"{study.replicates} {points}, {attitudes}; seed {study.seed}"),
        *([("drawn in every trial", ", ".join(study.hardware))] if study.hardware else []),
        *(
            (f"given in Python: {own}", f"code {code}")
            for own, code in plan.spec.digests.items()
        ),
    ]


def light_text(scene: Scene, lab: Lab) -> str:
    """The light source in words."""
    if scene.dome:
        surface = scene.dome.surface
        apex_m = getattr(surface, "apex_m", None)
        height = f", {apex_m:.4g} m above the bearing" if apex_m else ""
        cap = f" within {scene.dome.points.cap_deg:g}°"
        return f"dome ({surface.kind}{height}) with {len(lab.camera.sources)} LEDs ({scene.dome.layout.kind}){cap}"
    if light := scene.stars:
        limit = f" to V = {light.limit_mag:g}" if light.limit_mag is not None else ""
        return f"{len(lab.camera.sources)} stars of {light.catalog}{limit}"
    return scene.light.kind.replace("_", " ")


def camera_text(camera: CameraConfig) -> str:
    """The camera in words: pixels, field of view and scale."""
    known = camera.calibration()
    field = " × ".join(f"{side:.3g}°" for side in known.field_deg[:2])
    lens = f"{1e3 * camera.focal_length_m:.4g} mm f/{camera.f_number:.3g}"
    size = f"{camera.width_px} × {camera.height_px} px"
    return f"{size}, {lens}, field {field}, {known.arcsec_px:.3g}″ a pixel"


def tracker_text(scene: Scene) -> str:
    """The tracker's chain."""
    tracker = scene.tracker
    stages = ("detector", "centroider", "identifier", "solver")
    chosen = [f"{name} {getattr(tracker, name)}" for name in stages if getattr(tracker, name)]
    return tracker.name + (f": {', '.join(chosen)}" if chosen else ", default chain")


def factor_text(factor: Factor) -> str:
    """The levels of a factor, or its range or distribution."""
    keys = ", ".join(
        dict.fromkeys(key for _, settings in options(factor) for key in settings)
    )
    if isinstance(factor, Range):
        return f"{factor.from_} to {factor.to} ({keys})"
    if isinstance(factor, Distribution):
        return f"{factor.distribution} ({keys})"
    return ", ".join(format_level(value) for value, _ in factor.options()) + (
        f" ({keys})" if keys else ""
    )
