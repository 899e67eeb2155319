"""Refuse options of a study that have no effect: keys of `set`, `trial` and factors.

A key is refused if it has no effect at any level of any factor, each factor varied alone. The rules are those of scenes
(`scene.unused_rules`) and, for the kinds of trial, those below. `exposure.rate_hz` is always tolerated, because it
bounds the exposure time.
"""

from collections.abc import Iterable
from typing import NamedTuple

from skysim.core.yaml_reader import OverrideTexts
from skysim.experiments.study.factors import Settings, Value, each_level
from skysim.experiments.study.plan import (
    TRIAL,
    CentroidTrial,
    FlightTrial,
    FrameTrial,
    Plan,
    Trial,
    TrialSection,
    resolve_point,
)
from skysim.scene import unused, unused_rules
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import DetectorConfig
from skysim.scene.sections.layouts import CelestialConfig
from skysim.scene.unused_rules import Rule
from skysim.tracking import factory

# Detectors and centroiders that use the streak measured by a gyro.
STREAK_ALGORITHMS = ("default", "streak")
DYNAMICS = (
    "motion",
    "filter",
    "heads",
    "vehicle.imu",
    "vehicle.wheels",
    "vehicle.fans",
    "vehicle.thrusters",
    "vehicle.trims",
    "vehicle.drag",
    "vehicle.disturbances",
    "vehicle.mass",
    "vehicle.inertia",
    "vehicle.center_of_mass",
    "vehicle.torque_limit",
    "vehicle.tilt_stop_deg",
)


def without_flight(scene: Scene, trial: Trial) -> bool:
    """Whether a trial is of one attitude."""
    return not isinstance(trial, FlightTrial)


def on_ground(scene: Scene, trial: Trial) -> bool:
    """Whether the view of a trial depends on the site."""
    near = getattr(trial, "near", None)
    return unused_rules.seen_from_ground(scene) or (
        near is not None and near.body == "zenith"
    )


# All but the color and efficiency of the detector, which decide the brightness of the lights.
DETECTOR = tuple(
    f"camera.detector.{key}"
    for key in DetectorConfig.model_fields
    if key not in ("quantum_efficiency", "bayer")
)


def ignores_streak(scene: Scene, trial: Trial) -> bool:
    """Whether neither the detector nor the centroider of skysim's tracker uses a measured streak."""
    chosen = factory.assumed_settings(scene)
    used = {chosen.detector, chosen.centroider} & set(STREAK_ALGORITHMS)
    return isinstance(trial, FrameTrial) and not unused_rules.external(scene) and not used


def tracks(scene: Scene) -> bool:
    """Whether the scene's tracker has a tracking mode."""
    return (
        scene.stars is not None
        and not unused_rules.external(scene)
        and not scene.camera.row_delay_s
    )


RULES = (
    Rule(
        ("trial.gyro",),
        ignores_streak,
        "neither the detector nor the centroider uses the streak that a gyro measures",
        f"tracker.detector: default, or tracker.centroider: {STREAK_ALGORITHMS[1]}",
    ),
    Rule(
        ("trial.tracked",),
        lambda scene, trial: not tracks(scene),
        "the tracker has no tracking mode",
        "a scene with light of kind stars, no rolling shutter and skysim's tracker",
    ),
    Rule(
        ("trial.tilt_deg",),
        lambda scene, trial: scene.dome is None,
        "the boresight is drawn from the sphere",
        "trial.dec_deg, or a scene with light of kind dome",
    ),
    Rule(
        ("trial.dec_deg", "trial.near"),
        lambda scene, trial: scene.dome is not None,
        "under a dome the tilt is drawn",
        "trial.tilt_deg",
    ),
    Rule(
        ("trial.dec_deg",),
        lambda scene, trial: getattr(trial, "near", None) is not None,
        "the boresight is drawn about a body",
        "trial.near.off_deg",
    ),
    Rule(
        ("seed",),
        lambda scene, trial: True,
        "every trial has its own seed",
        "the study's seed",
    ),
    Rule(
        DYNAMICS,
        without_flight,
        "a trial of one attitude does not simulate the motion",
        "trial.kind: flight",
    ),
    Rule(
        ("site",),
        lambda scene, trial: (
            not isinstance(trial, FlightTrial) and not on_ground(scene, trial)
        ),
        "a trial of one attitude does not simulate the motion, and its sky is that of space",
        "trial.kind: flight, light.air, light.bodies with a site.longitude_deg, or trial.near.body: zenith",
    ),
    Rule(
        ("exposure.frames",),
        lambda scene, trial: (
            not isinstance(trial, FlightTrial) and scene.exposure.frames != 1
        ),
        "a trial is one frame",
        "1, or trial.kind: flight",
    ),
    Rule(
        ("exposure.time_tag_offset", "exposure.time_tag_jitter", "tracker.exposure_control"),
        without_flight,
        "a trial is one frame, whose time is not used",
        "trial.kind: flight",
    ),
    Rule(
        ("exposure.first", "exposure.trigger_jitter"),
        lambda scene, trial: (
            isinstance(trial, FrameTrial)
            and not trial.tracked
            and (not scene.dome or unused_rules.steady(scene))
        ),
        "the light of a trial's frame is steady",
        "trial.kind: flight",
    ),
    Rule(
        (
            "background",
            "camera.psf",
            "camera.shutter",
            *DETECTOR,
            "tracker.detector",
            "tracker.centroider",
            "tracker.threshold_sigma",
            "tracker.intensity_threshold",
            "tracker.min_area_px",
            "light.reflection",
            "camera.ghosts",
            "camera.glare",
            "camera.chromatic.focus",
        ),
        lambda scene, trial: isinstance(trial, CentroidTrial),
        "a trial of kind centroids has no image: trial.noise_px is the centroids' error",
        "trial.kind: frames",
    ),
    Rule(
        (
            "exposure.time",
            "exposure.first",
            "exposure.trigger_jitter",
            "camera.transmission",
            "camera.f_number",
            "light.led.intensity",
            "light.led.radiant_intensity",
            "light.led.pwm_period",
            "light.led.clock",
        ),
        lambda scene, trial: (
            isinstance(trial, CentroidTrial) and scene.tracker.decoder is None
        ),
        "a trial of kind centroids has no image: trial.noise_px is the centroids' error",
        "trial.kind: frames, or tracker.decoder, which reads the lights' brightness",
    ),
    Rule(
        ("light.led.disk_diameter",),
        # On a celestial dome the size of an LED decides which stars share one.
        lambda scene, trial: (
            isinstance(trial, CentroidTrial)
            and not (scene.dome and isinstance(scene.dome.points, CelestialConfig))
        ),
        "a trial of kind centroids has no image: trial.noise_px is the centroids' error",
        "trial.kind: frames",
    ),
)


class CheckedPoint(NamedTuple):
    """A point of a study at which options are checked: one factor at a level, the others at their middle.

    Attributes
    ----------
    factor, level
        The factor and its level
    own
        Settings of that factor alone
    settings
        Settings of all factors
    scene, trial
        Scene and trial with these settings
    """

    factor: str
    level: Value
    own: Settings
    settings: Settings
    scene: Scene
    trial: Trial


class Fault(NamedTuple):
    """A key that has no effect, its rule, and the point at which it was found."""

    key: str
    rule: Rule
    point: CheckedPoint


def check(plan: Plan, points: Iterable[CheckedPoint]) -> None:
    """Raise InputError for an option that has no effect; its key is one of the study.

    1. Find the keys that have no effect at any point: of `set` and `trial`, and of each factor's levels.
    2. Refuse a key of `set` or `trial`.
    3. Refuse a key of a level, unless it has an effect at some level of another factor.

    Parameters
    ----------
    plan
        The study
    points
        Every level of every factor, with the other factors at their middle
    """
    # 1. Faults by factor and level ("" for `set` and `trial`), and key; None for a key with an effect.
    written = [
        *plan.spec.base,
        *(f"{TRIAL}{key}" for key in plan.spec.trial if key != "kind"),
    ]
    faults: dict[tuple[str, str, str], Fault | None] = {}
    for point in points:
        keys = [("", "", key) for key in written if key not in point.settings]
        keys += [(point.factor, repr(point.level), key) for key in point.own]
        for where in keys:
            if faults.get(where, point) is not None:
                faults[where] = find(where[2], plan, point)
    # 2. and 3. Refusals.
    for (name, level, key), fault in faults.items():
        if fault is None:
            continue
        error = unused.no_effect(fault.key, fault.rule)
        if not name:
            raise error if key.startswith(TRIAL) else error.within("set")
        if not has_effect_elsewhere(plan, fault.point, key):
            raise error.within(level).within(f"factors.{name}")


def unused_overrides(overrides: OverrideTexts, scene: Scene, trial: Trial) -> set[str]:
    """The overrides that have no effect on a trial of the resulting scene."""
    useless = set()
    for key, text in overrides.items():
        below = unused.override_keys({key: text})
        if all(unused.find(RULES, [one], scene, scene, trial) for one in below):
            useless.add(key)
    return useless


def find(key: str, plan: Plan, point: CheckedPoint) -> Fault | None:
    """The fault of the first key without effect among those that a key of the study sets at a point."""
    scene = point.scene
    trial = point.trial
    if key.startswith(TRIAL):
        found = unused.find(
            RULES, [key], TrialSection.model_construct(trial=trial), scene, trial
        )
    else:
        keys = list(unused.set_keys({key: (plan.spec.base | point.settings)[key]}))
        found = unused.find(unused_rules.RULES, keys, scene) or unused.find(
            RULES, keys, scene, scene, trial
        )
    return Fault(*found, point) if found else None


def has_effect_elsewhere(plan: Plan, point: CheckedPoint, key: str) -> bool:
    """Whether a key of one factor's level has an effect at some level of another factor, varied alone."""
    others = {
        name: factor for name, factor in plan.study.factors.items() if name != point.factor
    }
    for *_, settings in each_level(others):
        scene, trial = resolve_point(plan.spec, settings | point.own)
        varied = point._replace(settings=settings | point.own, scene=scene, trial=trial)
        if find(key, plan, varied) is None:
            return True
    return False
