"""Changes of a scene that a datasheet measures: what would lower the error, and disturbances."""

import math

from skysim.experiments.study.factors import Settings
from skysim.scene.scene import BODIES_YEARS, Scene
from skysim.scene.unused import differs
from skysim.simulation.checks.sky_warnings import CATALOG_MARGIN_MAG
from skysim.tracking.onboard_model import onboard_catalog

Changes = dict[str, Settings]  # by name
FIXED_PATTERN = ("prnu", "dsnu", "hot_pixels", "column_offset_e")  # keys of `camera.detector`
# Error and number of the true centroids in trials with false ones.
FALSE_STARS_PX = 0.05
TRUE_STARS = 20
OFF_DEG = (10.0, 20.0, 30.0, 45.0, 60.0, 90.0)  # angles of the boresight from a bright body


# Changes of any scene.


def catalog_end_mag(scene: Scene) -> float:
    """The V magnitude up to which the tracker's catalog has stars; no star is faint enough for a tracker of LEDs."""
    if scene.stars is None:
        return -math.inf
    stars = onboard_catalog("tracker.catalog", scene.tracker.catalog)
    return float(stars.v_mag.max()) + CATALOG_MARGIN_MAG


def causes(scene: Scene) -> Changes:
    """Changes of the scene that would lower the error; those without effect on it are left out."""
    camera = scene.camera
    exposure = scene.exposure
    changes: Changes = {
        "twice the light (aperture)": {"camera.f_number": camera.f_number / math.sqrt(2)}
    }
    if 2 * exposure.time_s + exposure.trigger_jitter_s <= 1 / exposure.rate_hz:
        changes["twice the exposure time"] = {"exposure.time": f"{2 * exposure.time_s} s"}
    if scene.thermal:
        reference = {"kind": "steady", "temperature_c": scene.thermal.reference_c}
        changes["the temperature held"] = {"thermal.temperature": reference}
    better: Changes = {
        "half the read noise": {
            "camera.detector.read_noise_e": camera.detector.read_noise_e / 2
        },
        "no fixed pattern": {f"camera.detector.{key}": 0 for key in FIXED_PATTERN},
        "no transfer loss": {
            "camera.detector.cti_parallel": 0,
            "camera.detector.cti_serial": 0,
        },
        "the lever known": {"tracker.survey.lever_sigma": "0 mm"},
        "the LEDs' map known": {
            "tracker.survey.led_sigma": "0 mm",
            "tracker.survey.instrument": None,
        },
        "the focal length known": {"tracker.survey.focal_length_sigma": "0 mm"},
        "the pupil fixed": {"camera.pupil_walk": 2 * ["0 mm"]},
        "dies centered": {"light.led.die": 3 * ["0 mm"]},
        "no sag": {"vehicle.sag_arcsec": [0, 0], "vehicle.mast": "0 m"},
        "a round ball": {"vehicle.runout": 3 * ["0 mm"]},
        "no lens errors": {"camera.lens_table": None},
        "no coma": {"camera.psf.coma_px": 0},
        "even pixels": {"camera.detector.intrapixel": 0},
        "straight edges": {"camera.detector.edge_px": 0},
        "no brighter-fatter charge": {"camera.detector.brighter_fatter_per_e": 0},
        "no dispersion by the air": {"light.air.dispersion": False},
    }
    for name, change in better.items():
        if any(differs(scene, key) for key in change):
            changes[name] = change
    fainter_mag = scene.tracker.limit_mag + 0.5
    if fainter_mag <= catalog_end_mag(scene):
        changes["half a magnitude more stars known"] = {"tracker.limit_mag": fainter_mag}
    return changes


def disturbances(scene: Scene) -> Changes:
    """Disturbances that the scene supports, beyond its own."""
    hot = {"camera.detector.hot_e_s": max(scene.camera.detector.hot_e_s, 1000.0)}
    own = scene.model_dump(mode="json", by_alias=True)["background"]
    found: Changes = {
        "protons, 1e3 /cm²/s": {"camera.detector.particles": [{"per_cm2_s": 1e3}]},
        "protons, 1e4 /cm²/s": {"camera.detector.particles": [{"per_cm2_s": 1e4}]},
        "hot pixels, 0.1 %": {"camera.detector.hot_pixels": 1e-3} | hot,
        "hot pixels, 1 %": {"camera.detector.hot_pixels": 1e-2} | hot,
    }
    for electrons in (100, 1000):
        glow = {"kind": "uniform", "e_s": electrons / scene.exposure.time_s}
        found[f"stray light, {electrons} e- a pixel"] = {"background": [*own, glow]}
    if scene.stars is None:
        return found
    for count in (5, 20):
        found[f"false stars, {count} among {TRUE_STARS} true"] = {
            "trial.kind": "centroids",
            "trial.noise_px": FALSE_STARS_PX,
            "trial.lights": TRUE_STARS,
            "trial.false_lights": count,
        }
    if has_bodies(scene):
        edge_deg = float(f"{half_field_deg(scene):.2g}")
        found["Moon in the field"] = beside("moon", 0, edge_deg)
    return found


def beside(body: str, least_deg: float, greatest_deg: float) -> Settings:
    """Settings of attitudes at angles from a body that shines."""
    near: Settings = {"body": body, "off_deg": [least_deg, greatest_deg]}
    return {"trial.near": near, "light.bodies": {}}


def has_bodies(scene: Scene) -> bool:
    """Whether Sun and Moon can be in the scene's sky, and their places are known at its start."""
    known = BODIES_YEARS[0] <= scene.start_time.year <= BODIES_YEARS[1]
    return scene.stars is not None and known


def excluding_bodies(scene: Scene) -> tuple[str, ...]:
    """Bodies whose stray light the scene's baffle lets through."""
    return ("sun", "moon") if has_bodies(scene) and scene.camera.baffle else ()


def side_px(scene: Scene) -> int:
    """The field's smaller side."""
    return min(scene.camera.size_px)


def half_field_deg(scene: Scene) -> float:
    """Half of the field's smaller side."""
    return math.degrees(math.atan(side_px(scene) / 2 / scene.camera.focal_px))
