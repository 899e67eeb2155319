"""Warnings about a plan: each names the key to change, the problem, and a better value.

Each function in `FINDINGS` returns one line, or an empty text if there is nothing to warn of. A warning is left out if
another one explains the problem.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from skysim.camera import as_built
from skysim.camera.detector import saturation_dn
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import median
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import TwoStopsConfig
from skysim.scene.sections.layouts import Layout, OnPoints
from skysim.simulation.checks import vehicle_facts
from skysim.simulation.checks.detection import detected_px, threshold_e
from skysim.simulation.checks.expected_error import AS_BUILT, mismatch
from skysim.simulation.checks.facts import GAUSSIAN_WIDTH, cap_margin, fill, short, uneven_px
from skysim.simulation.checks.sampling import Plan
from skysim.simulation.lights.emitters import BACKGROUND
from skysim.sources.dome.layouts.placing import largest_cap_deg

MAX_SATURATED = 0.25  # fraction of saturated lights that gives no warning
# Recommended peak over full well of the light that a fraction MAX_SATURATED exceeds
TARGET_FILL = 0.7
# Limits of exposure times and lenses that a warning recommends.
SHORTEST_S = 10e-6
LARGEST_F_NUMBER = 22.0
FILTER_BELOW = 0.1  # factor of the light below which a filter is recommended
MIN_LIGHTS = 4  # number of lights that an identification needs
MIN_DETECTED = 0.5  # fraction of the lights on the detector that the tracker should detect
# Fraction of the directions in reach, or of the whole sky, that may have fewer than MIN_LIGHTS.
MAX_FEW = 0.02
MAX_FEW_SKY = 0.5
# Threshold in sigma above which it is the reason for missing detections
HIGH_THRESHOLD = 20.0
MAX_BACKGROUND = 0.5  # fraction of full scale
MAX_BEYOND = 0.25  # fraction of images beyond the tracker's matching radius up to which frames are identified
# A path that is longer than both gives a warning; the second is in widths of the image.
MAX_SMEAR_PX = 4.0
MAX_SMEAR_WIDTHS = 2.0
MAX_UNEVEN_PX = 0.2  # motion beside a uniform path
MAX_DEFOCUS = 0.5  # width of the defocus disk, relative to the image in focus
MIN_DEFOCUS_PX = 1.0
# Error of the time tags over the filter's value, and the rotation in that time, up to which there is no warning.
MAX_TAG_RATIO = 1.3
MAX_TAG_ARCSEC = 1.0


def saturation(plan: Plan) -> str:
    """Warn if many lights are saturated, with the keys that make every light dimmer, those of the LEDs first.

    An exposure is recommended only if it is not shorter than SHORTEST_S and the LED drive's cycle, in which each LED is
    lit once, and an f-number only up to LARGEST_F_NUMBER. Stars always get an exposure.
    """
    ratio = fill(plan)
    scene = plan.scene
    full = float((ratio >= 1).mean()) if len(ratio) else 0.0
    if full <= MAX_SATURATED or bright_background(plan):
        return ""
    factor = TARGET_FILL / float(np.quantile(ratio, 1 - MAX_SATURATED))
    text = (
        f"{100 * full:.0f} % of the lights are saturated, the median light at {short(np.median(ratio), 2)} times"
        f" {plan.full_e:.0f} electrons; change it to"
    )
    cures = led_strength(scene, factor)
    sources = plan.lab.camera.sources
    cycle_s = float(sources.period_s[sources.on_s < sources.period_s].max(initial=0.0))
    exposure_s = factor * scene.exposure.time_s
    if exposure_s >= max(cycle_s, SHORTEST_S) or not cures:
        cures["exposure.time"] = f"{short(1e3 * exposure_s, 2)} ms"
    f_number = scene.camera.f_number / math.sqrt(factor)
    if f_number <= LARGEST_F_NUMBER:
        cures["camera.f_number"] = short(f_number, 2)
    (first, value), *more = cures.items()
    others = "".join(f", or {key} to {other}" for key, other in more)
    if factor < FILTER_BELOW and isinstance(transmission := scene.camera.transmission, float):
        others += (
            f", or camera.transmission to {short(factor * transmission, 2)}, a gray filter"
        )
    return f"{first}: {text} {value}{others}"


def led_strength(scene: Scene, factor: float) -> dict[str, str]:
    """The key of the strength of the LEDs with a value that makes them stronger by a factor; empty without LEDs."""
    led = getattr(scene.light, "led", None)
    if led is None:
        return {}
    if led.intensity_cd is not None:
        return {"light.led.intensity": f"{short(1e3 * factor * led.intensity_cd, 2)} mcd"}
    radiant_uw_sr = 1e6 * factor * led.radiant_intensity_w_sr
    return {"light.led.radiant_intensity": f"{short(radiant_uw_sr, 2)} uW / sr"}


def bright_background(plan: Plan) -> str:
    """Warn if extended light alone fills the pixels."""
    scene = plan.scene
    camera = plan.camera
    full_e = plan.full_e
    if camera.background_e < MAX_BACKGROUND * full_e:
        return ""
    shorter_ms = (
        1e3 * scene.exposure.time_s * MAX_BACKGROUND / 2 * full_e / camera.background_e
    )
    most = max(camera.glow_e, key=lambda name: camera.glow_e[name], default=BACKGROUND)
    cause = "" if most == BACKGROUND else f", most of it from {most}"
    return (
        f"background: {camera.background_e:.0f} electrons in a pixel without a light{cause}, of {full_e:.0f} at"
        f" saturation; lower it, or change exposure.time to {short(shorter_ms, 2)} ms"
    )


def black_level(plan: Plan) -> str:
    """Warn if a pixel without light is above the fixed threshold of the detector `thesis`."""
    detector = plan.scene.camera.detector
    level_dn = detector.offset_dn + plan.camera.background_e / detector.gain_e_dn
    share = plan.settings.intensity_threshold
    threshold_dn = share * saturation_dn(detector)
    if plan.settings.detector != "thesis" or level_dn < threshold_dn:
        return ""
    return (
        f"camera.detector.offset_dn: the black level of {short(level_dn, 3)} DN is above the threshold of"
        f" {100 * share:g} % of the detector thesis, {short(threshold_dn, 3)} DN, so that it finds no light; change"
        f" it to {short(threshold_dn / 4, 2)}, or tracker.detector to local"
    )


def dark_corners(plan: Plan) -> str:
    """Warn if the lens passes no light to a part of the detector."""
    camera = plan.camera.optics.camera
    stops = camera.vignetting
    corner_deg = math.degrees(math.atan(camera.corner_px / camera.focal_px))
    if not isinstance(stops, TwoStopsConfig) or stops.cutoff_deg >= corner_deg:
        return ""
    return (
        f"camera.vignetting.cutoff_deg: the lens is dark beyond {stops.cutoff_deg:g} deg from its axis, and the chip's"
        f" corner is at {corner_deg:.1f} deg; change it to {math.ceil(1.5 * corner_deg)}"
    )


def few_lights(plan: Plan) -> str:
    """Warn if the tracker has too few lights, in the frames or in the directions in reach.

    1. Return no warning if another one explains the problem: a cap that is too small, dark corners, a bright background
       or the black level.
    2. Count the lights, hidden ones included (`hidden_lights` warns of those); stop if there are enough.
    3. Return no warning if enough lights are on the detector (`undetected` warns of those).
    4. Recommend more LEDs, or fainter stars.
    """
    scene = plan.scene
    needed = least_lights(scene)
    # 1. More lights where there are some would not help.
    explained = (cap_too_small, dark_corners, bright_background, black_level)
    if any(find(plan) for find in explained):
        return ""
    if scene.tracker.brightest is not None and scene.tracker.brightest < needed:
        return f"tracker.brightest: the tracker uses {scene.tracker.brightest} lights; change it to {needed} or more"
    # 2. No frame may have too few; of the directions in reach, some may.
    in_reach = MAX_FEW_SKY if scene.vehicle.mount == "free" else MAX_FEW
    for sampled, allowed in ((plan.frames, 0.0), (plan.reach, in_reach)):
        counts = sampled.counts()
        unhidden = counts + sampled.hidden_counts()
        few = float((unhidden < needed).mean())
        if few > allowed:
            break
    else:
        return ""
    on_chip = np.array([len(view) for view in sampled.seen])
    where = sampled.attitudes.describe(int(counts.argmin()))
    text = (
        f"fewer than {needed} lights that the tracker detects at {100 * few:.0f} % of the"
        f" {'frames' if sampled is plan.frames else 'directions in reach'}, least {counts.min()} at {where}"
    )
    # 3. Lights on the detector.
    if (on_chip[counts < needed] >= needed).mean() > MIN_DETECTED:
        return ""
    # 4. Recommendation.
    if scene.dome:
        key, change = denser(scene.dome.layout, float(on_chip.mean()))
        return f"{key}: {text}; {change}"
    fainter = scene.tracker.limit_mag + 1
    sky_mag = getattr(scene.light, "limit_mag", None)
    if sky_mag is not None and sky_mag < scene.tracker.limit_mag:
        return f"light.limit_mag: {text}; change it to {scene.tracker.limit_mag:g}, the tracker's limit"
    return f"tracker.limit_mag: {text}; change it to {fainter:g}, or take a shorter camera.focal_length"


def hidden_lights(plan: Plan) -> str:
    """Warn if something hides so many lights at a frame that the tracker has too few."""
    frames = plan.frames
    scene = plan.scene
    counts = frames.counts()
    hidden = frames.hidden_counts()
    few = (counts < least_lights(scene)) & (counts + hidden >= least_lights(scene))
    if not few.any():
        return ""
    n = int(np.where(few, hidden, -1).argmax())
    (name, behind), *others = frames.hidden[n].most_common()
    expected = int(counts[n] + hidden[n])
    what = f"all behind {name}" if behind == expected else f"{behind} of them behind {name}"
    what += "".join(f", {count} behind {other}" for other, count in others)
    return (
        f"motion.start: {expected} lights expected at {frames.attitudes.describe(n)},"
        f" {what}; so at {100 * few.mean():.0f} % of the frames; point elsewhere, or change the time"
    )


def least_lights(scene: Scene) -> int:
    """Number of lights that an identification needs; two if codes identify them."""
    return 2 if scene.tracker.decoder else MIN_LIGHTS


def denser(layout: Layout, mean: float) -> tuple[str, str]:
    """The key that sets the number of LEDs, and its change to a mean of three times what an identification needs.

    `mean` is the mean number of lights on the detector.
    """
    key = "light.layout.points" if isinstance(layout, OnPoints) else "light.layout"
    points = layout.points if isinstance(layout, OnPoints) else layout
    factor = max(3 * MIN_LIGHTS / max(mean, 0.5), 1.5)
    if (count := getattr(points, "count", None)) is not None:
        return f"{key}.count", f"change it to {math.ceil(factor * count)}"
    if (spacing_m := getattr(points, "spacing_m", None)) is not None:
        spacing_mm = 1e3 * spacing_m / math.sqrt(factor)
        return f"{key}.spacing", f"change it to {spacing_mm:.3g} mm"
    limited = getattr(points, "limit_mag", None) is not None
    return key + ".limit_mag" * limited, f"add LEDs: {factor:.1f} times as many"


def undetected(plan: Plan) -> str:
    """Warn if most lights on the detector are too faint or too small to be detected."""
    scene = plan.scene
    settings = plan.settings
    # The tracker takes at most max_blobs of a frame.
    seen = sum(min(len(view), settings.max_blobs) for view in plan.frames.seen)
    used = sum(map(len, plan.frames.used))
    explained = (bright_background, black_level, dark_corners, long_smear)
    if not seen or used >= MIN_DETECTED * seen or any(find(plan) for find in explained):
        return ""
    area = np.concatenate([detected_px(view, plan)[1] for view in plan.frames.seen])
    text = f"the tracker detects {100 * used / seen:.0f} % of the lights in the field"
    if np.median(area) > 0.5:
        return (
            f"tracker.min_area_px: {text}: images have {np.median(area):.0f} px above the threshold, it wants"
            f" {settings.min_area_px}; change it to {max(int(np.median(area) / 3), 1)}"
        )
    peak_e = plan.frames.joined("peak_e") - plan.camera.background_e
    factor = 3 * threshold_e(plan) / max(median(peak_e), 1e-3)
    text = f"{text}: the others are below the threshold"
    if scene.tracker.threshold_sigma > HIGH_THRESHOLD:
        return f"tracker.threshold_sigma: {text} of {scene.tracker.threshold_sigma:g} sigma; change it to 5"
    return brighter(scene, factor, text)


def brighter(scene: Scene, factor: float, text: str) -> str:
    """A warning that recommends to make lights brighter by a factor.

    It names the exposure time if the frame rate allows it, else the lens for stars and the current for LEDs.
    """
    exposure_s = factor * scene.exposure.time_s
    led = led_strength(scene, factor)
    if exposure_s <= 1 / scene.exposure.rate_hz:
        other = "light.led.intensity as much" if led else "camera.f_number to a faster lens"
        return (
            f"exposure.time: {text}; change it to {short(1e3 * exposure_s, 2)} ms, or {other}"
        )
    led = led or {"camera.f_number": short(scene.camera.f_number / math.sqrt(factor), 2)}
    ((key, value),) = led.items()
    return f"{key}: {text}; change it to {value}"


def not_where_expected(plan: Plan) -> str:
    """Warn if errors that are unknown to the tracker displace images beyond its matching radius."""
    frames = plan.frames
    scene = plan.scene
    found = [one for view in frames.used if (one := mismatch(view, plan)) is not None]
    if not found:
        return ""
    residual_px = np.concatenate([one.residual_px for one in found])
    gate_px = np.concatenate([one.gate_px for one in found])
    beyond = float((residual_px > gate_px).mean())
    if beyond <= MAX_BEYOND:
        return ""
    text = (
        f"{100 * beyond:.0f} % of the images are up to {short(residual_px.max(), 2)} px from where the tracker expects"
        f" them, beyond its matching radius of {short(np.median(gate_px), 2)} px"
    )
    rate_deg_s = float(frames.attitudes.speed_deg_s.max())
    cause = max(found[0].by_cause, key=lambda name: max(one.by_cause[name] for one in found))
    text += f", at up to {rate_deg_s:.3g} deg/s" if cause == "rolling shutter" else ""
    excess = float(np.quantile(residual_px / gate_px, 1 - MAX_BEYOND))
    key, change = ADVICE[cause]
    return f"{key}: {text}; {change(scene, excess)}"


def map_of_other_hardware(plan: Plan) -> str:
    """Warn if the map of a survey differs from the scene by more than the survey's errors."""
    faults = "; ".join(plan.beliefs.faults)
    return faults and (
        f"tracker.map: made of other hardware: {faults}; survey the dome again, or undo the change"
    )


# By cause: the key, and the change as a function of the scene and of the ratio of the displacement to the
# allowed one.
ADVICE: dict[str, tuple[str, Callable[[Any, float], str]]] = {
    "focal length": (
        "tracker.assumed_focal_length",
        lambda scene, excess: (
            f"change it to {short(1e3 * scene.camera.focal_length_m, 5)} mm"
        ),
    ),
    "distortion": (
        "tracker.assumed_distortion",
        lambda scene, excess: f"change it to {list(scene.camera.distortion)}, the lens's",
    ),
    "assumed lever": (
        "tracker.assumed_camera_body",
        lambda scene, excess: "leave it out, or fit the place with tracker.solver: pnp",
    ),
    "rolling shutter": (
        "tracker.assumed_row_time",
        lambda scene, excess: (
            "leave it out, so that the tracker corrects the rows for"
            f" {short(1e6 * scene.camera.shutter.row_time_s, 3)} us each, or turn {short(excess, 2)} times slower"
        ),
    ),
    AS_BUILT: (
        "tracker.map",
        lambda scene, excess: (
            "survey the dome by its camera at this temperature (`skysim survey`), which measures lights where they are"
        ),
    ),
    "survey set-up": (
        "tracker.survey.instrument",
        lambda scene, excess: (
            f"change it to one of smaller errors of the set-up, by a factor of {short(excess, 2)}"
        ),
    ),
    "surface survey": (
        "light.surface.error",
        lambda scene, excess: (
            f"change it to {short(1e3 * scene.light.surface.error_m / excess, 2)} mm"
        ),
    ),
    "common survey": (
        "tracker.map",
        lambda scene, excess: "survey the dome with more frames",
    ),
    "other map": ("tracker.map", lambda scene, excess: "survey the dome again"),
}


def cap_too_small(plan: Plan) -> str:
    """Warn if the field reaches beyond the LEDs at the greatest tilt."""
    found = cap_margin(plan)
    light = plan.scene.dome
    if found is None or light is None or found.needed_deg <= found.cap_deg:
        return ""
    # No key changes the positions of listed LEDs.
    if light.points.kind == "listed":
        return ""
    key = f"light.layout{'.points' * hasattr(light.layout, 'points')}.cap_deg"
    uncovered = (
        "the tilt itself is not covered"
        if found.tilt_deg > found.cap_deg
        else "its edge has no LED"
    )
    assert plan.surface is not None
    largest_deg = largest_cap_deg(plan.surface)
    reach = f"reaches {found.needed_deg:.1f} deg: {uncovered}; change it to"
    if found.needed_deg > largest_deg:
        reach = f"passes the rim of the surface: no cap covers it ({largest_deg:.1f} at most); tilt less"
    elif found.corner_deg > largest_deg:
        reach += f" {math.ceil(found.needed_deg)}; no cap covers its corners, which pass the rim of the surface"
    else:
        reach += f" {math.ceil(found.needed_deg)}, or {math.ceil(found.corner_deg)} for its corners"
    return (
        f"{key}: LEDs end at {found.cap_deg:.3g} deg from the zenith, but at a tilt of {found.tilt_deg:.1f} deg the"
        f" field {reach}"
    )


def out_of_focus(plan: Plan) -> str:
    """Warn if the defocus disk is wide compared with the image in focus."""
    sampled = plan.frames
    defocus = sampled.joined("defocus_px")
    sigma = sampled.joined("sigma_px")
    distance_m = sampled.joined("distance_m")
    if not len(defocus):
        return ""
    blur_px = 2 * median(defocus)
    sharp_px = GAUSSIAN_WIDTH * median(np.sqrt(np.maximum(sigma**2 - defocus**2 / 4, 0)))
    if blur_px <= max(MAX_DEFOCUS * sharp_px, MIN_DEFOCUS_PX):
        return ""
    # Defocus is proportional to the difference of 1 / distance, so the best focus is at the middle of it; 0 for stars.
    middle = float(1 / distance_m.min() + 1 / distance_m.max()) / 2
    best = f"{1 / middle:.3g} m" if middle else "infinity"
    text = f"images are {blur_px:.1f} px out of focus and would be {sharp_px:.1f} px wide"
    return f"camera.focus: {text}; change it to {best}"


def long_smear(plan: Plan) -> str:
    """Warn if images move by more than MAX_SMEAR_PX and MAX_SMEAR_WIDTHS of their own width."""
    frames = plan.frames
    scene = plan.scene
    length_px = frames.joined("streak_length_px")
    sigma = frames.joined("sigma_px")
    if not len(length_px):
        return ""
    limit_px = max(MAX_SMEAR_PX, MAX_SMEAR_WIDTHS * GAUSSIAN_WIDTH * median(sigma))
    longest_px = float(length_px.max())
    if longest_px <= limit_px:
        return ""
    rate_deg_s = float(frames.attitudes.speed_deg_s.max())
    shorter_ms = 1e3 * scene.exposure.time_s * limit_px / longest_px
    breaking = (
        ", so that most break up or join others: frames fail, or err by more than their noise"
        if frames.broken().any()
        else ""
    )
    return (
        f"exposure.time: images move by up to {longest_px:.0f} px during an exposure, at {rate_deg_s:.3g} deg/s"
        f"{breaking}; change it to {short(shorter_ms, 2)} ms"
    )


def uneven_motion(plan: Plan) -> str:
    """Warn if jitter moves the images unevenly within an exposure, which the expected errors leave out."""
    scene = plan.scene
    t_s = plan.frames.attitudes.t_s
    moved_px = uneven_px(plan, t_s, scene.exposure.time_s)
    if moved_px <= MAX_UNEVEN_PX:
        return ""
    shorter_s = scene.exposure.time_s
    while uneven_px(plan, t_s, shorter_s) > MAX_UNEVEN_PX:
        shorter_s /= 1.1
    return (
        f"exposure.time: jitter moves images by {short(moved_px, 2)} px (rms) beside their uniform path within an"
        " exposure, which is in neither the expected nor the claimed error; change it to"
        f" {short(1e3 * shorter_s, 2)} ms"
    )


def unknown_tag_error(plan: Plan) -> str:
    """Warn if time tags have larger errors than the filter assumes, and the vehicle rotates in that time."""
    scene = plan.scene
    sigma_s = float(scene.exposure.time_tag_jitter_s)
    if scene.filter is None or sigma_s <= MAX_TAG_RATIO * scene.filter.time_tag_sigma_s:
        return ""
    rate_deg_s = float(plan.frames.attitudes.speed_deg_s.max())
    turn_arcsec = sigma_s * math.radians(rate_deg_s) / ARCSEC_RAD
    if turn_arcsec <= MAX_TAG_ARCSEC:
        return ""
    return (
        f"filter.time_tag_sigma: frames' times err by {short(1e3 * sigma_s, 2)} ms (exposure.time_tag_jitter), in which"
        f" the vehicle turns by {short(turn_arcsec, 2)}″ at {rate_deg_s:.3g} deg/s; change it to"
        f" {short(1e3 * sigma_s, 2)} ms"
    )


def thermal_drift(plan: Plan) -> str:
    """Warn if thermal drift of dome, mount and lens causes larger errors than expected otherwise."""
    thermal_config = plan.scene.thermal
    if thermal_config is None:
        return ""
    error = plan.frames.error
    drift_rad2 = error.rad2["cross"][AS_BUILT]
    if not (drift_rad2 > error.total("cross") / 2).any():
        return ""
    n = int(np.nanargmax(drift_rad2))
    t_s = float(plan.frames.attitudes.t_s[n])
    others_rad = math.sqrt(error.total("cross")[n] - drift_rad2[n])
    return (
        f"thermal.reference_c: dome, mount and lens turn the solution by"
        f" {short(math.sqrt(drift_rad2[n]) / ARCSEC_RAD)}″ (cross) at"
        f" {as_built.temperature_c(thermal_config, t_s):.1f} °C, t = {t_s:.1f} s, beside an expected error of"
        f" {short(others_rad / ARCSEC_RAD)}″; survey and calibrate nearer to that temperature, or change"
        " thermal.mount_arcsec_k"
    )


FINDINGS = (
    bright_background,
    black_level,
    saturation,
    dark_corners,
    hidden_lights,
    few_lights,
    undetected,
    cap_too_small,
    out_of_focus,
    long_smear,
    uneven_motion,
    map_of_other_hardware,
    not_where_expected,
    unknown_tag_error,
    thermal_drift,
    *vehicle_facts.FINDINGS,
)
