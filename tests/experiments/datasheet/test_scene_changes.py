"""The changes of a scene that a datasheet measures: what each leaves of the scene that it changes."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from estimator.catalog import catalog
from skysim.experiments.datasheet import scene_changes
from skysim.experiments.study.plan import TrialSpec, resolve_point
from skysim.scene.loader import load
from skysim.scene.scene import Scene
from skysim.simulation.checks.sky_warnings import CATALOG_MARGIN_MAG

EVERYTHING = {
    "camera.psf.coma_px": "0.2",
    "camera.detector.prnu": "0.01",
    "camera.detector.cti_parallel": "1.0e-5",
    "camera.detector.cti_serial": "1.0e-5",
    "tracker.survey.lever_sigma": "1 mm",
    "tracker.survey.led_sigma": "1 mm",
    "tracker.survey.focal_length_sigma": "0.1 mm",
    "exposure.time": "20 ms",
    "thermal.mount_arcsec_k": "[1.0, 0.0, 0.0]",
    "thermal.reference_c": "19",
    "thermal.temperature": "{kind: table, hours: [0, 1], temperature_c: [20, 23]}",
}


def changed(
    name: str, overrides: dict[str, str], settings: dict[str, Any]
) -> tuple[Scene, Any]:
    base: Any = {key: yaml.safe_load(text) for key, text in overrides.items()}
    spec = TrialSpec(name, ".", 3, base, {"kind": "frames"}, True)
    return resolve_point(spec, settings)


def test_a_cause_is_taken_away_and_everything_else_stays() -> None:
    """Of a scene with all of them: what each named change leaves, read from the changed scene."""
    before = load("afit_as_built", EVERYTHING)
    read = {
        "half the read noise": lambda one: one.camera.detector.read_noise_e,
        "no fixed pattern": lambda one: [
            one.camera.detector.prnu,
            one.camera.detector.dsnu,
            one.camera.detector.hot_pixels,
            one.camera.detector.column_offset_e,
        ],
        "no transfer loss": lambda one: [
            one.camera.detector.cti_parallel,
            one.camera.detector.cti_serial,
        ],
        "the lever known": lambda one: one.tracker.survey.lever_sigma_m,
        "the LEDs' map known": lambda one: one.tracker.survey.led_sigma_m,
        "the focal length known": lambda one: one.tracker.survey.focal_length_sigma_m,
        "the pupil fixed": lambda one: one.camera.pupil_walk_m,
        "dies centered": lambda one: one.dome.led.die_m,
        "no sag": lambda one: one.vehicle.sag_arcsec,
        "a round ball": lambda one: one.vehicle.runout_m,
        "no coma": lambda one: one.camera.psf.coma_px,
        "even pixels": lambda one: one.camera.detector.intrapixel,
        "straight edges": lambda one: one.camera.detector.edge_px,
        "no brighter-fatter charge": lambda one: one.camera.detector.brighter_fatter_per_e,
    }

    def greatest(value: Any) -> float:
        return max(
            abs(part) for part in (value if isinstance(value, list | tuple) else [value])
        )

    causes = scene_changes.causes(before)
    others = {"twice the light (aperture)", "twice the exposure time", "the temperature held"}
    assert set(causes) == {*read, *others}
    for name, settings in causes.items():
        after, _ = changed("afit_as_built", EVERYTHING, settings)
        for other, value in read.items():
            if other != name:
                assert value(after) == value(before), (name, other)
        if name == "twice the light (aperture)":
            # Light goes with the area of the pupil.
            ratio = before.camera.f_number / after.camera.f_number
            assert ratio**2 == pytest.approx(2)
        elif name == "twice the exposure time":
            assert after.exposure.time_s == pytest.approx(2 * before.exposure.time_s)
        elif name == "half the read noise":
            assert read[name](after) == pytest.approx(read[name](before) / 2)
        elif name == "the temperature held":
            assert after.thermal is not None
            assert after.thermal.temperature.temperature_c == 19
        else:
            assert greatest(read[name](before)) > 0
            assert greatest(read[name](after)) == 0
    none, _ = changed("afit_as_built", EVERYTHING, causes["the LEDs' map known"])
    assert none.tracker.survey.instrument is None


def test_a_scene_without_an_effect_has_no_such_cause() -> None:
    names = set(scene_changes.causes(load("shefex2", {})))
    for cause in ("no sag", "no coma", "even pixels", "dies centered", "the lever known"):
        assert cause not in names
    none = {f"camera.detector.{key}": "0" for key in ("prnu", "dsnu", "hot_pixels")}
    assert "no fixed pattern" in names
    assert "no fixed pattern" not in scene_changes.causes(load("shefex2", none))
    for one in ("cti_parallel", "cti_serial"):
        lossy = load("shefex2", {f"camera.detector.{one}": "1.0e-5"})
        assert "no transfer loss" in scene_changes.causes(lossy)


@pytest.mark.parametrize(("time_ms", "possible"), [(39.0, True), (41.0, False), (40.0, True)])
def test_an_exposure_is_doubled_if_the_next_frame_leaves_it_time(
    time_ms: float, possible: bool
) -> None:
    """Of frames 100 ms apart whose triggers jitter by 20 ms."""
    scene: Any = load("shefex2", {})
    exposure = SimpleNamespace(time_s=time_ms / 1000, trigger_jitter_s=0.02, rate_hz=10.0)
    parts = {name: getattr(scene, name) for name in ("camera", "tracker", "thermal", "dome")}
    changes = scene_changes.causes(
        SimpleNamespace(  # type: ignore[arg-type]
            **parts, vehicle=scene.vehicle, stars=scene.stars, exposure=exposure
        )
    )
    assert ("twice the exposure time" in changes) == possible


def test_more_stars_are_known_as_far_as_the_catalog_has_them() -> None:
    """Its faintest star, and a margin; a scene of LEDs has none. The limit goes half a magnitude further."""
    scene = load("shefex2", {})
    end_mag = scene_changes.catalog_end_mag(scene)
    assert end_mag == pytest.approx(catalog.hipparcos().v_mag.max() + CATALOG_MARGIN_MAG)
    assert scene_changes.catalog_end_mag(load("afit_simsat", {})) == -math.inf
    name = "half a magnitude more stars known"
    for limit_mag, known in ((end_mag - 0.51, True), (end_mag - 0.49, False)):
        limited = load("shefex2", {"tracker.limit_mag": f"{limit_mag}"})
        causes = scene_changes.causes(limited)
        assert (name in causes) == known
        if known:
            assert causes[name] == {"tracker.limit_mag": pytest.approx(limit_mag + 0.5)}


def test_a_disturbance_is_as_large_as_its_name_says() -> None:
    scene = load("shefex2", {})
    found = scene_changes.disturbances(scene)
    for name, settings in found.items():
        after, trial = changed("shefex2", {}, settings)
        chip = after.camera.detector
        number = {"1e3": 1e3, "1e4": 1e4, "0.1": 1e-3, "1": 1e-2}
        if name.startswith("protons"):
            (particles,) = chip.particles
            assert particles.per_cm2_s == number[name.split()[1]]
        elif name.startswith("hot pixels"):
            assert chip.hot_pixels == number[name.split()[2]]
            assert chip.hot_e_s == 1000
        elif name.startswith("stray light"):
            own = len(scene.background)
            assert len(after.background) == own + 1
            e_s = after.background[-1].e_s
            assert e_s * scene.exposure.time_s == pytest.approx(float(name.split()[2]))
        elif name.startswith("false stars"):
            _, _, false, _, true, _ = name.replace(",", "").split()
            assert (trial.false_lights, trial.lights) == (int(false), int(true))
            assert trial.noise_px == 0.05
        else:
            assert name == "Moon in the field"
            half_deg = math.degrees(
                math.atan(
                    min(scene.camera.width_px, scene.camera.height_px)
                    / 2
                    / scene.camera.focal_px
                )
            )
            assert scene_changes.half_field_deg(scene) == pytest.approx(half_deg)
            assert trial.near.body == "moon"
            assert list(trial.near.off_deg) == pytest.approx([0, half_deg], rel=0.06)
    assert [name.split(",")[0] for name in found] == [
        *["protons"] * 2,
        *["hot pixels"] * 2,
        *["stray light"] * 2,
        *["false stars"] * 2,
        "Moon in the field",
    ]
    hotter = load("shefex2", {"camera.detector.hot_e_s": "5000"})
    hot = scene_changes.disturbances(hotter)["hot pixels, 1 %"]
    assert hot["camera.detector.hot_e_s"] == 5000
    dome = scene_changes.disturbances(load("afit_simsat", {}))
    assert not any("star" in name or "Moon" in name for name in dome)


def test_bodies_shine_in_a_sky_of_known_years() -> None:
    """From the first to the last year of the ephemeris, and not under a dome."""
    first, last = scene_changes.BODIES_YEARS
    for year, known in ((first, True), (last, True), (first - 1, False), (last + 1, False)):
        scene: Any = SimpleNamespace(stars=object(), start_time=SimpleNamespace(year=year))
        assert scene_changes.has_bodies(scene) == known
    dome: Any = SimpleNamespace(stars=None, start_time=SimpleNamespace(year=first))
    assert not scene_changes.has_bodies(dome)
