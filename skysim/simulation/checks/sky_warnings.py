"""Facts and warnings about a scene under the stars: refraction, bodies, errors, stray light, limiting magnitude."""

import math
from collections.abc import Iterator

import numpy as np

from skysim.camera.glow.background import angular_separation_deg
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.checks.detection import (
    BINOMIAL_VARIANCE_PX2,
    STILL_PX,
    Context,
    threshold_e,
)
from skysim.simulation.checks.facts import Fact, short
from skysim.simulation.checks.findings import few_lights
from skysim.simulation.checks.sampling import Plan
from skysim.simulation.checks.views import peak_share
from skysim.simulation.lights.effects import STRAY_LIGHT, AirEffects, stray_e_s
from skysim.simulation.lights.light import find_light
from skysim.sources.bodies import NAMES, BodyLight
from skysim.sources.camera_orbit import limb_elevation_rad
from skysim.sources.ephemeris import place
from skysim.tracking.onboard_model import bright_star_e
from skysim.tracking.tracker_interface import OWN

# Refraction.

MIN_RAISED_ARCSEC = 1.0  # least refraction that gives a warning


def refraction(plan: Plan) -> str:
    """Warn if refraction at the lowest frame exceeds the expected error and the tracker does not correct it.

    The refraction at the boresight is an error of the attitude. The difference of the refractions at both ends of the
    field shortens its height.
    """
    lab = plan.lab
    at = plan.frames.attitudes
    atmosphere = find_light(lab.camera.lights, AirEffects)
    if atmosphere is None or lab.scene.tracker.refraction:
        return ""
    boresight = at.boresights
    zenith = np.array(
        [atmosphere.air.at(exposure.time).zenith for exposure in plan.frames.exposures]
    )
    altitude_rad = np.arcsin(np.sum(boresight * zenith, axis=1))
    n = int(altitude_rad.argmin())
    zenith_rad = math.pi / 2 - altitude_rad[n]
    half_rad = plan.camera.optics.field_rad
    around_rad = zenith_rad + np.array([0.0, half_rad, -half_rad])
    middle, low, high = (
        atmosphere.air.refraction.bending_rad(np.abs(around_rad))
        * np.sign(around_rad)
        / ARCSEC_RAD
    )
    expected_arcsec = plan.frames.error.rms_arcsec()[0]
    if not middle > max(
        MIN_RAISED_ARCSEC, 0.0 if math.isnan(expected_arcsec) else expected_arcsec
    ):
        return ""
    where = at.describe(n)
    text = (
        f"the air raises stars by {short(middle)}″ at {where}, {math.degrees(altitude_rad[n]):.1f}° above the horizon,"
        f" and shortens the field by {short(low - high, 2)}″, which the tracker does not know"
    )
    if lab.scene.tracker.name == OWN:
        return f"tracker.refraction: {text}; change it to true"
    return f"tracker.name: {text}; change it to own, with tracker.refraction: true, or point higher"


# Sun, Moon and planets in the field or near it.

NEAR_DEG = {
    "sun": 60.0,
    "moon": 30.0,
}  # angle from the boresight within which stray light matters


def bodies_near(plan: Plan) -> Iterator[str]:
    """Warn of each body in the field or near it, at the frame where it is nearest to the boresight."""
    # 1. The nearest frame of each body.
    lab = plan.lab
    at = plan.frames.attitudes
    cam_from_lab = lab.camera.mount.cam_from_body * at.lab_from_body.inv()
    closest: dict[str, tuple[float, int, BodyLight]] = {}
    for n, beam in enumerate(plan.frames.beams):
        for body in beam.discs:
            z = float(cam_from_lab[n].apply(body.place.direction)[2])
            off = math.acos(max(min(z, 1.0), -1.0)), n, body
            closest[body.name] = min(
                closest.get(body.name, off), off, key=lambda found: found[0]
            )
    # 2. Warnings.
    for name, (off_rad, n, body) in closest.items():
        seen = body.truth()
        where = at.describe(n)
        what = f"light.bodies: {NAMES[body.id]} (V {seen.v_mag:.1f}, {short(seen.diameter_arcsec, 2)}″ wide)"
        far = f"{math.degrees(off_rad):.1f}° from the boresight at {where}"
        if in_field(
            cam_from_lab[n].apply(body.place.direction), body.radius_rad, lab.scene.camera
        ):
            # Electrons in its brightest pixel at rest. A partly lit body counts as a full disk of the lit area.
            camera = plan.camera
            lit = (1 + math.cos(body.place.phase_rad)) / 2
            radius = math.tan(body.radius_rad) * math.sqrt(lit)
            radius_px = camera.optics.camera.focal_px * radius
            share = float(peak_share(camera.lens_px**2, radius_px))
            light_e = body.flux_e_s_m2 * camera.optics.collecting_m2 * camera.exposure_s
            fill = light_e * share / plan.full_e
            yield f"{what} is in the field, {far}: {short(fill, 2)} times saturation"
        elif lab.scene.camera.baffle is None and off_rad < math.radians(
            NEAR_DEG.get(name, 0.0)
        ):
            yield f"{what} is {far}; its stray light is not drawn: add camera.baffle, or a background of kind stray"


def in_field(direction_cam: Floats, radius_rad: float, camera: CameraConfig) -> bool:
    """Whether a disc about a direction (3,) in camera axes overlaps the detector, for a lens without distortion."""
    if direction_cam[2] <= 0:
        return False
    xy_px = camera.focal_px * np.abs(direction_cam[:2]) / direction_cam[2]
    half_px = np.array(camera.size_px) / 2
    return bool((xy_px < half_px + camera.focal_px * math.tan(radius_rad)).all())


# Claimed errors: the expected normalized estimation error squared (NEES) under the stars.

MAX_FACTOR = 1.3  # factor by which claimed errors may be too small
TRUE_NEES = 3.0
LARGEST_FLOOR_PX = 1.0


def fact(plan: Plan) -> Fact | None:
    """The fact about the expected NEES; None under other lights, and if the floor is estimated from each frame."""
    nees = plan.claimed_nees
    if math.isnan(nees):
        return None
    floor_px = plan.settings.searched_sigma_px
    rates = plan.reach.attitudes.rates_text
    text = f"NEES {nees:.2g} over the sky {rates} (3 if true), with a least centroid error of {short(floor_px)} px"
    return Fact("claimed errors", [text], {"nees": nees, "centroid_sigma_px": floor_px})


def floor_too_small(plan: Plan) -> str:
    """Warn if the tracker will claim too small errors because its least centroid error is too small.

    The recommended value, at which the claim is true, is found by bisection.
    """
    nees = plan.claimed_nees
    factor = math.sqrt(nees / TRUE_NEES) if nees > 0 else 0.0
    if factor <= MAX_FACTOR:
        return ""
    low = plan.settings.searched_sigma_px
    high = LARGEST_FLOOR_PX
    while high / low > 1.02:
        middle = math.sqrt(low * high)
        small = plan.expected_nees(middle) > TRUE_NEES
        low, high = (middle, high) if small else (low, middle)
    return (
        f"tracker.centroid_sigma_px: the tracker will claim errors that are {factor:.2g} times too small (NEES"
        f" {nees:.2g}; 3 if true); change it to {short(high, 2)}"
    )


# Stray light past the baffle, and exclusion angles.

MAX_LOSS_MAG = 0.5  # loss of limiting magnitude that gives no warning
# Bodies with an exclusion angle, and what it is measured from.
EXCLUDED = {"sun": "the Sun", "earth": "the Earth's limb", "moon": "the Moon"}


def stray_light(plan: Plan) -> Iterator[str]:
    """Warn if the noise of stray light hides faint stars.

    n0 is the noise of a pixel without stray light. With s electrons of stray light the noise is sqrt(n0^2 + s), and
    the faintest star is brighter by 1.25 log10(1 + s / n0^2) magnitudes.
    """
    lab = plan.lab
    at = plan.frames.attitudes
    if lab.scene.camera.baffle is None:
        return
    by_frame = [stray_e_s(lab.camera.lights, exposure) for exposure in plan.frames.exposures]
    stray_e = plan.camera.exposure_s * np.array([sum(one.values()) for one in by_frame])
    n = int(stray_e.argmax())
    own_e2 = plan.camera.noise_e**2 - plan.camera.glow_e.get(STRAY_LIGHT, 0.0)
    loss_mag = 1.25 * math.log10(1 + stray_e[n] / own_e2)
    if loss_mag <= MAX_LOSS_MAG:
        return
    allowed_e = own_e2 * (10 ** (MAX_LOSS_MAG / 1.25) - 1)
    source = max(by_frame[n], key=lambda name: by_frame[n][name])
    yield (
        f"camera.baffle.pst: stray light of {short(stray_e[n])} electrons in a pixel, most of it of"
        f" {source}, of {plan.full_e:.0f} at saturation,"
        f" at {at.describe(n)}; the faintest star is {loss_mag:.1f} mag"
        f" brighter; change it to {short(allowed_e / stray_e[n], 2)} times as much, or point farther away"
    )


def exclusion(plan: Plan) -> Iterator[str]:
    """Warn if the boresight of a frame is within an exclusion angle of the orbit's tracker, at the nearest frame."""
    lab = plan.lab
    at = plan.frames.attitudes
    limits = lab.scene.orbit.exclusion if lab.scene.orbit else None
    if limits is None:
        return
    # Angles from the Sun's center, the Earth's limb and the Moon's center.
    rows = []
    for t_s, boresight in zip(at.t_s.tolist(), at.boresights, strict=True):
        here = lab.camera.viewpoint.observer_at(t_s)
        sun, moon = (
            float(angular_separation_deg(boresight, place(name, here).direction))
            for name in ("sun", "moon")
        )
        limb_rad = limb_elevation_rad(here.from_earth.position_m, boresight)
        rows.append([sun, math.degrees(float(limb_rad)), moon])
    limits_deg = (limits.sun_deg, limits.earth_deg, limits.moon_deg)
    for (name, what), limit_deg, angle_deg in zip(
        EXCLUDED.items(), limits_deg, np.array(rows).T, strict=True
    ):
        n = int(angle_deg.argmin())
        if angle_deg[n] < limit_deg:
            yield (
                f"orbit.exclusion.{name}_deg: {what} is {angle_deg[n]:.1f}° from the boresight at"
                f" {at.describe(n)}, within {limit_deg:g}°; point farther away"
            )


# Limiting magnitudes of the camera, the simulated sky and the tracker's catalog.

# Magnitudes by which the camera may detect fainter stars than those of a catalog, or of a limit in the scene.
CATALOG_MARGIN_MAG = 0.3
LIMIT_MARGIN_MAG = 0.5
MIN_KNOWN = 0.2  # least share of the detected stars that the tracker should know
DEEPEST_V = 10.0  # faintest magnitude of a catalog that `skysim catalog build` makes
SNR = 5.0


def faintest_star(plan: Plan) -> Fact | None:
    """V of the faintest star that the tracker detects, and of a star with the signal-to-noise ratio SNR."""
    scene = plan.scene
    believed = plan.beliefs
    if not scene.stars:
        return None
    rate_deg_s = float(plan.frames.attitudes.speed_deg_s.min())
    limit_mag = detection_limit_mag(plan)
    snr_mag = snr_limit_mag(plan)
    sky = plan.lab.camera.sources.magnitude
    known = known_share(plan, limit_mag)
    lines = [
        f"the tracker detects V {limit_mag:.1f} (like the Sun) in {1e3 * scene.exposure.time_s:.4g} ms at"
        f" {rate_deg_s:.3g} deg/s; signal to noise {SNR:g} at V {snr_mag:.1f}",
        f"the sky ends at V {np.nanmax(sky, initial=-math.inf):.1f}; the tracker knows stars to V"
        f" {believed.faintest_mag:.1f}, {100 * known:.0f} % of those that it detects",
    ]
    values = {
        "detected_v_mag": limit_mag,
        "snr_5_v_mag": snr_mag,
        "known": known,
        "rate_deg_s": rate_deg_s,
    }
    return Fact("faintest star", lines, values)


def known_share(context: Context, limit_mag: float) -> float:
    """Share of the sky's stars brighter than a limit that are also brighter than the tracker's faintest one."""
    sky = context.lab.camera.sources.magnitude
    seen = sky < limit_mag
    return float((sky[seen] <= context.beliefs.faintest_mag).mean()) if seen.any() else 1.0


def sky_too_shallow(plan: Plan) -> str:
    """Warn if the camera detects fainter stars than the simulated sky has."""
    stars = plan.scene.stars
    sky = plan.lab.camera.sources.magnitude
    if not stars or not len(sky):
        return ""
    limit_mag = detection_limit_mag(plan)
    faintest_mag = float(np.nanmax(sky))
    text = f"the camera detects stars to V {limit_mag:.1f}, but the sky ends at V {faintest_mag:.1f}; change it to"
    if stars.limit_mag is not None:
        # `few_lights` may recommend a fainter limit already.
        said = few_lights(plan).startswith("light.limit_mag")
        if said or limit_mag <= stars.limit_mag + LIMIT_MARGIN_MAG:
            return ""
        return f"light.limit_mag: {text} {math.ceil(2 * limit_mag) / 2:g}, or leave it out"
    if limit_mag <= min(faintest_mag + CATALOG_MARGIN_MAG, DEEPEST_V):
        return ""
    wanted = min(math.ceil(2 * limit_mag) / 2, DEEPEST_V)
    return f"light.catalog: {text} a file of `skysim catalog build --source gaia --limit {wanted:g}`"


def tracker_too_shallow(plan: Plan) -> str:
    """Warn if most stars that the tracker detects are fainter than those that it knows."""
    if not plan.scene.stars:
        return ""
    limit_mag = detection_limit_mag(plan)
    faintest_mag = plan.beliefs.faintest_mag
    known = known_share(plan, limit_mag)
    if known >= MIN_KNOWN or limit_mag <= faintest_mag + LIMIT_MARGIN_MAG:
        return ""
    return (
        f"tracker.limit_mag: the camera detects stars to V {limit_mag:.1f}, but the tracker knows them to V"
        f" {faintest_mag:.1f} only, {100 * known:.0f} % of them; change it to {math.floor(2 * limit_mag) / 2:g}, with a"
        f" tracker.catalog of `skysim catalog build --limit {math.floor(2 * limit_mag) / 2:g}`"
    )


def beyond_catalog(plan: Plan) -> str:
    """Warn if the tracker's limit is beyond its catalog, which has no stars to add."""
    scene = plan.scene
    faintest_mag = plan.beliefs.faintest_mag
    limit_mag = scene.tracker.limit_mag
    if not scene.stars or limit_mag <= faintest_mag + CATALOG_MARGIN_MAG:
        return ""
    return (
        f"tracker.limit_mag: V {limit_mag:g}, but tracker.catalog ends at V {faintest_mag:.1f}; change it to"
        f" {math.floor(2 * faintest_mag) / 2:g}, or the catalog to one of `skysim catalog build --limit {limit_mag:g}`"
    )


def detection_limit_mag(plan: Plan) -> float:
    """V of a star of the Sun's color that is detected in about half of the cases, at the slowest frame.

    An image of deviation s on a path L has the least area A = pi r^2 + 2 r L above the threshold T if its peak is
    T exp(r^2 / (2 s^2)), see `detection.detected_px`.
    """
    camera = plan.camera
    streak_px = least_streak_px(plan)
    length_px = float(np.hypot(*streak_px))
    blur2_px2 = camera.lens_px**2 + BINOMIAL_VARIANCE_PX2
    half_px = length_px / math.pi
    radius_px = math.sqrt(half_px**2 + plan.settings.min_area_px / math.pi) - half_px
    peak_e = threshold_e(plan, streak_px) * math.exp(radius_px**2 / (2 * blur2_px2))
    share = float(peak_share(blur2_px2, streak_px=length_px))
    return 2.5 * math.log10(bright_star_e(plan.scene) * share / peak_e)


def snr_limit_mag(plan: Plan) -> float:
    """V of a star of the Sun's color with a signal-to-noise ratio of 5 over the noise-equivalent area A.

    It is that of the slowest frame. With the noise n of a pixel,

        S / sqrt(S + A n^2) = 5    gives    S = (25 + sqrt(25^2 + 100 A n^2)) / 2.

    A Gaussian of deviation s has A = 4 pi s^2; on a path L much longer than s it has 2 sqrt(pi) s L. The root of the
    sum of their squares is taken in between.
    """
    camera = plan.camera
    width_px = 2 * math.sqrt(math.pi) * camera.lens_px
    area_px = width_px * math.hypot(width_px, *least_streak_px(plan))
    signal_e = (SNR**2 + math.sqrt(SNR**4 + 4 * SNR**2 * area_px * camera.noise_e**2)) / 2
    return 2.5 * math.log10(bright_star_e(plan.scene) / signal_e)


def least_streak_px(plan: Plan) -> Floats:
    """(2,) path of the images at the slowest frame."""
    paths_px = [np.median(view.streak_px, axis=0) for view in plan.frames.known if len(view)]
    return min(paths_px, key=np.linalg.norm, default=STILL_PX)
