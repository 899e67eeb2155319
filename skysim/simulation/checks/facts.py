"""The facts of a plan as text and as numbers: field, lights, image size, peak, smear, focus, beliefs, expected error.

Each function in `FACTS` returns one fact from the plan, or None if the plan does not have it.
"""

import math
import re
from collections import Counter
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.spatial.transform import Rotation

from skysim.camera.psf.otf import blur_radius_px
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, Record, around_z, median, polar_rad
from skysim.simulation.checks import attitudes, beliefs, vehicle_facts
from skysim.simulation.checks.detection import Context
from skysim.simulation.checks.expected_error import mean_root
from skysim.simulation.checks.sampling import Plan, Sampled
from skysim.simulation.checks.vehicle_facts import Fact, short
from skysim.sources.dome.layouts.led_list import max_tilt_deg
from skysim.sources.dome.room import fit
from skysim.sources.dome.surface import Radial
from skysim.sources.dome.wall import wall_size

GAUSSIAN_WIDTH = 4.0  # width of an image over its rms radius: D4sigma (ISO 11146), the diameter of a uniform disk
SIDES = 12  # number of azimuths of the greatest tilt, and of rays around the field
MIN_SHARE = 0.005  # least share of the variance of a cause that is printed
ARCSEC = "″"
TRACKER_KNOWS = "tracker knows"
REQUIREMENTS = "requirements"
UNTESTED = (
    "matches accepted by the thesis's rule, not tested against chance (tracker.acceptance)"
)


def field_of_view(plan: Plan) -> Fact:
    """Angles between the centers of opposite edges and between opposite corners of the detector, without distortion."""
    lens = plan.camera.optics.camera.calibration()
    return Fact(
        "field of view",
        [lens.field_text()],
        {"field_deg": list(lens.field_deg), "arcsec_px": lens.arcsec_px},
    )


def lights_in_field(plan: Plan) -> Fact:
    """Number of lights that the tracker knows and detects in the field: mean, least, and the attitude of the least."""
    lab = plan.lab
    lines = []
    values = {}
    tilt_deg = float(plan.reach.attitudes.tilts_deg.max())
    reach = f"any azimuth and yaw to {tilt_deg:.1f}° of tilt"
    if lab.scene.stars:
        reach = "in the whole sky"
    for key, what, sampled in (
        ("frames", "at the frames", plan.frames),
        ("reach", reach, plan.reach),
    ):
        counts = sampled.counts()
        seen = np.array([len(view) for view in sampled.seen])
        least_of = sampled
        of = ""
        if sampled is plan.reach:
            # The frames are in reach too.
            least_of = min(plan.frames, plan.reach, key=lambda one: one.counts().min())
            of = f"of {len(counts)} attitudes and the frames "
        least = int(least_of.counts().min())
        where = least_of.attitudes.describe(int(least_of.counts().argmin()))
        limit = plan.settings.max_blobs
        cut = f"; the tracker uses the {limit} brightest" if (counts == limit).any() else ""
        missed = (
            f" (of {seen.mean():.1f} on the chip{cut})"
            if seen.mean() > counts.mean() + 0.5
            else ""
        )
        hidden = {
            name: count / len(counts)
            for name, count in sum(sampled.hidden, Counter[str]()).most_common()
        }
        behind = "".join(
            f"; {count:.1f} more are behind {name}" for name, count in hidden.items()
        )
        rates = sampled.attitudes.rates_text
        lines.append(
            f"{what}, {rates}: mean {counts.mean():.1f}{missed}, least {of}{least} at {where}{behind}"
        )
        values[key] = {
            "mean": counts.mean(),
            "least": least,
            "least_at": where,
            "on_chip": seen.mean(),
        }
        values[key] |= {"hidden": hidden} if hidden else {}
    return Fact("lights in the field", lines, values)


def other_lights(plan: Plan) -> Fact | None:
    """Lights at the frames that the tracker detects and does not know, by name; None if there are none."""
    others = plan.frames.others
    lines = []
    values = {}
    for name in sorted({name for one in others for name in one}):
        most = max(len(one.get(name, ())) for one in others)
        frames = sum(name in one for one in others)
        lines.append(
            f"{name}: up to {most} at {frames} of {len(others)} frames, which the tracker does not know"
        )
        values[name] = {"most": most, "share": frames / len(others)}
    return Fact("other lights", lines, values) if lines else None


def spot(plan: Plan) -> Fact:
    """Width of the median image without motion, and its parts: lens, LED and defocus."""
    sampled = plan.frames if sum(map(len, plan.frames.seen)) else plan.reach
    sigma, disk, defocus = (
        sampled.joined(name) for name in ("sigma_px", "disk_px", "defocus_px")
    )
    lens_px = GAUSSIAN_WIDTH * plan.camera.lens_px
    if not len(sigma):
        return Fact(
            "image size",
            [f"lens {lens_px:.1f} px; no light in the field"],
            {"lens_px": lens_px},
        )
    width, disk_px, defocus_px = (
        median(one) for one in (GAUSSIAN_WIDTH * sigma, 2 * disk, 2 * defocus)
    )
    led = f", LED {disk_px:.1f}" if plan.scene.dome else ""
    text = f"{width:.1f} px wide (D4σ): lens {lens_px:.1f}{led}, defocus {defocus_px:.1f} px"
    values = {
        "width_px": width,
        "lens_px": lens_px,
        "led_px": disk_px,
        "defocus_px": defocus_px,
    }
    return Fact("image size", [text], values)


def fill(plan: Plan) -> Floats:
    """(n,) peaks of all lights at the frames over the full well, or over the range of the converter if that is less."""
    return plan.frames.joined("peak_e") / plan.full_e


def peak(plan: Plan) -> Fact:
    """Mean electrons in the brightest pixel of a centered image over the full well."""
    ratio = fill(plan)
    full_e = plan.full_e
    if not len(ratio):
        return Fact("peak", ["no light in the field"], {"full_e": full_e})
    full = float((ratio >= 1).mean())
    text = f"brightest light {ratio.max():.3g}, median {np.median(ratio):.2g} of saturation ({full_e:.0f} electrons)"
    full_text = f"; {100 * full:.0f} % saturated" if full else ""
    values = {
        "brightest": ratio.max(),
        "median": np.median(ratio),
        "saturated": full,
        "full_e": full_e,
    }
    return Fact("peak", [text + full_text], values)


def smear(plan: Plan) -> Fact:
    """Path of the images during an exposure at the mean rates of the frames, their jitter included."""
    frames = plan.frames
    rate_deg_s = frames.attitudes.speed_deg_s
    length_px = np.array(
        [np.median(view.streak_length_px) if len(view) else 0.0 for view in frames.known]
    )
    fastest = int(rate_deg_s.argmax())
    text = (
        f"{length_px[fastest]:.2g} px at {rate_deg_s[fastest]:.3g} deg/s, the fastest frame; median"
        f" {np.median(length_px):.2g} px"
    )
    values = {
        "largest_px": length_px[fastest],
        "median_px": np.median(length_px),
        "rate_deg_s": rate_deg_s[fastest],
    }
    uneven = uneven_px(plan, frames.attitudes.t_s, plan.camera.exposure_s)
    if uneven:
        values["uneven_px"] = uneven
        text += f"; jitter moves images by {short(uneven, 2)} px (rms) beside that path"
    if length_px[fastest] > 0:
        width_px = GAUSSIAN_WIDTH * median(
            np.concatenate([view.sigma_px for view in frames.known])
        )
        values["width_rate_deg_s"] = rate_deg_s[fastest] * width_px / length_px[fastest]
        text += f"; as long as the image is wide at {short(values['width_rate_deg_s'])} deg/s"
    return Fact("smear", [text], values)


def uneven_px(context: Context, t_s: Floats, exposure_s: float) -> float:
    """Root mean square distance of images from those at the mean rates of exposures about some times."""
    lab = context.lab
    camera = context.camera.optics.camera
    _, rest = attitudes.jitter_in_exposures(lab, t_s, exposure_s)
    turned = lab.camera.mount.cam_from_body.apply(rest.reshape(-1, 3))
    # A roll moves an image at half the way to the corner.
    arm_px = np.array([camera.focal_px, camera.focal_px, camera.corner_px / 2])
    return float(np.sqrt(((turned * arm_px) ** 2).sum(axis=1).mean()))


class CapMargin(NamedTuple):
    """The cap of a dome's LEDs and the reach of the field at a tilt, in degrees from the zenith.

    Attributes
    ----------
    cap_deg
        End of the LEDs; of a `listed` layout, that of the farthest one
    tilt_deg
        The tilt
    needed_deg
        Reach of the middle of the field's shorter sides, its farther edges; infinite if it passes the surface's rim
    corner_deg
        Reach of the field's corner
    limit_deg
        `cap_deg` of the layout, to which shell and wires extend
    """

    cap_deg: float
    tilt_deg: float
    needed_deg: float
    corner_deg: float
    limit_deg: float

    @property
    def text(self) -> str:
        """The reach of the field and the margins in words."""
        if math.isinf(self.needed_deg):
            return "the field's edge passes the rim of the surface: no cap covers it"
        edge = f"{self.cap_deg - self.needed_deg:+.1f}°"
        text = f"the field's edge reaches {self.needed_deg:.1f}°, its corner"
        if math.isinf(self.corner_deg):
            return f"{text} passes the rim of the surface: margin {edge}"
        return f"{text} {self.corner_deg:.1f}°: margin {edge} and {self.cap_deg - self.corner_deg:+.1f}°"


def cap_margin(plan: Plan, tilt_deg: float | None = None) -> CapMargin | None:
    """The cap of the LEDs and the reach of the field at a tilt; None without a layout that fills a cap.

    Any side or corner of the field may point outward. `field_reach_deg` traces rays at their angles from the boresight
    to the surface, at the tilt to all sides. `light.layout.cap_deg` is compared with the angle from the zenith of
    these points as seen from the bearing.

    Parameters
    ----------
    plan
        Data of the checks
    tilt_deg
        The tilt; None for the greatest of the attitudes in reach
    """
    light = plan.scene.dome
    camera = plan.camera.optics.camera
    if light is None or plan.surface is None:
        return None
    points = light.points
    if getattr(points, "boards", ()):
        return None
    listed = points.kind == "listed"
    cap_deg = max_tilt_deg(plan.lab.camera.sources.xyz) if listed else points.cap_deg
    if tilt_deg is None:
        tilt_deg = float(plan.reach.attitudes.tilts_deg.max())
    edge = field_reach_deg(plan, max(camera.size_px) / 2, tilt_deg)
    corner = field_reach_deg(plan, camera.corner_px, tilt_deg)
    return CapMargin(cap_deg, tilt_deg, edge, corner, points.cap_deg)


def field_reach_deg(context: Context, radius_px: float, tilt_deg: float) -> float:
    """Greatest angle from the zenith, seen from the bearing, at which a circle of the tilted field meets the dome.

    Infinite if a ray passes below the rim. The circle has the radius radius_px about the boresight. The tilt is tried
    to SIDES azimuths.
    """
    mount = context.camera.mount
    surface = context.surface
    azimuth = 2 * np.pi * np.arange(SIDES) / SIDES
    assert surface is not None
    radius = radius_px / context.camera.optics.camera.focal_px
    rays_cam = around_z(radius, azimuth, 1.0)
    tilts = np.column_stack([azimuth, np.full(SIDES, math.radians(tilt_deg)), -azimuth])
    needed_deg = 0.0
    for lab_from_body in Rotation.from_euler("ZYZ", tilts):
        rays = lab_from_body.apply(mount.body_from_cam.apply(rays_cam))
        met = surface.meet(lab_from_body.apply(mount.camera_body_m), rays)
        if np.isnan(met).any():
            return math.inf
        zenith_rad = polar_rad(met)
        needed_deg = max(needed_deg, float(np.degrees(zenith_rad).max()))
    return needed_deg


def cap(plan: Plan) -> Fact | None:
    """Margin of the LED cap over the tilt plus half the field, at the greatest tilt in reach and at the tilt stop."""
    found = cap_margin(plan)
    vehicle = plan.scene.vehicle
    if found is None:
        return None
    wider = (
        f", shell and wires to cap_deg, {found.limit_deg:.3g}°"
        if found.limit_deg > found.cap_deg
        else ""
    )
    lines = [
        f"LEDs to {found.cap_deg:.3g}° from the zenith{wider}; at a tilt of {found.tilt_deg:.1f}° {found.text}"
    ]
    values = {**found._asdict(), "margin_deg": found.cap_deg - found.needed_deg}
    if vehicle.mount == "air_bearing" and vehicle.tilt_stop_deg > found.tilt_deg + 0.05:
        stop = cap_margin(plan, vehicle.tilt_stop_deg)
        assert stop is not None
        lines.append(f"at the tilt stop, {stop.tilt_deg:g}°, {stop.text}")
        values |= {
            "stop_deg": stop.tilt_deg,
            "stop_margin_deg": stop.cap_deg - stop.needed_deg,
        }
    return Fact("LED cap", lines, values)


def room(plan: Plan) -> Fact | None:
    """The size of the dome and its parts in the room and its door; a scene that does not fit was refused before."""
    light = plan.scene.dome
    surface = plan.surface
    if light is None or light.room is None or surface is None:
        return None
    limits = light.room
    values = fit(light.room, surface, light.points.cap_deg)
    x_m, y_m, z_m = values["extent_m"]
    floor = [
        f"{size:.2f} m" if size is not None else "any"
        for size in (limits.width_m, limits.length_m)
    ]
    text = (
        f"{x_m:.2f} x {y_m:.2f} x {z_m:.2f} m along x, y, z (room: {floor[0]} x {floor[1]})"
    )
    if limits.bearing_height_m is not None:
        ceiling = f" of {limits.height_m:.2f} m" if limits.height_m is not None else ""
        text = f"top {values['top_m']:.2f} m{ceiling}, rim {values['rim_m']:.2f} m above the floor; {text}"
    if limits.door_m is not None:
        part = "the shell" if limits.segments == 1 else f"each of {limits.segments} segments"
        sides, door = (
            " x ".join(f"{side:.2f}" for side in box)
            for box in (values["part_m"], limits.door_m)
        )
        text += f"; {part} goes into a box of {sides} m, shortest side first: fits the door of {door} m"
    return Fact("room", [text], values)


def wall(plan: Plan) -> Fact | None:
    """Area, volume and mass of a formed wall without its flange; None without `surface.wall`."""
    light = plan.scene.dome
    config = getattr(light.surface, "wall", None) if light else None
    if light is None or config is None:
        return None
    assert isinstance(plan.surface, Radial)
    size = wall_size(plan.surface, light.points.cap_deg)
    text = f"inside {size.area_m2:.3f} m², volume {1e3 * size.volume_m3:.2f} L"
    values = size._asdict()
    if config.density_kg_m3 is not None:
        values["mass_kg"] = config.density_kg_m3 * size.volume_m3
        text += f", mass {values['mass_kg']:.2f} kg"
    return Fact("dome's wall", [text + ", without ribs and flange"], values)


def depth_of_focus(plan: Plan) -> Fact:
    """Distances u at which the defocus disk is one pixel wide: 1 / u = 1 / focus ± pixel / (pupil image_distance)."""
    camera = plan.camera.optics.camera
    spread = camera.pixel_m / (camera.pupil_m * camera.image_distance_m)
    near_m = 1 / (1 / camera.focus_m + spread)
    far_m = 1 / (1 / camera.focus_m - spread) if 1 / camera.focus_m > spread else math.inf
    near, far = (
        f"{value:.3g} m" if math.isfinite(value) else "infinity" for value in (near_m, far_m)
    )
    text = f"from {near} to {far} (defocus below one pixel)"
    distance_m = np.concatenate(
        [sampled.joined("distance_m") for sampled in (plan.frames, plan.reach)]
    )
    values = {"near_m": near_m, "far_m": far_m}
    if len(distance_m) and np.isfinite(distance_m).all():
        low_m = distance_m.min()
        high_m = distance_m.max()
        within = "within" if near_m <= low_m and high_m <= far_m else "not all within"
        text += f"; LEDs at {low_m:.3g} to {high_m:.3g} m: {within}"
        values |= {"nearest_led_m": low_m, "farthest_led_m": high_m}
    elif len(distance_m):
        text += f"; stars: {'within' if math.isinf(far_m) else f'{2 * blur_radius_px(camera, math.inf):.2g} px wide'}"
    return Fact("depth of focus", [text], values)


def tracker_beliefs(plan: Plan) -> Fact:
    """The beliefs of the tracker that are uncertain or wrong."""
    believed = plan.beliefs
    values = {
        "led_sigma_m": believed.led_sigma_m,
        "lever_sigma_m": believed.lever_sigma_m,
        "surface_sigma_m": believed.surface_sigma_m,
        "survey_rotation_rad": believed.rotation_rad.tolist(),
        "lever_error_m": believed.lever_error_m.tolist(),
        "focal_error": believed.focal_error,
        "focal_sigma": believed.focal_sigma,
        "distortion": list(believed.camera.distortion),
        "catalog_epoch_jyear": believed.epoch_jyear,
        "map_faults": list(believed.faults),
    }
    lines = beliefs.describe(believed, plan.scene)
    if plan.settings.acceptance == "thesis":
        lines = [*lines, UNTESTED]
    return Fact(TRACKER_KNOWS, lines, values)


def expected_error(plan: Plan) -> Fact:
    """Expected cross and roll error, 1 sigma, and their causes, the largest first."""
    lines = []
    values = Record()
    for key, what, sampled in (
        ("frames", "at the frames", plan.frames),
        ("reach", "in reach", plan.reach),
    ):
        failing = int(np.isnan(sampled.error.total("roll")).sum())
        broken = int(sampled.broken().sum())
        total = len(sampled.seen)
        known = sampled.predicted()
        cross, roll = sampled.error.rms_arcsec() if known else (math.nan, math.nan)
        few = f"; too few lights at {failing - broken} of {total}" if failing > broken else ""
        if broken:
            few += f"; not predicted at {broken} of {total}, where most streaks break up or join others"
        worst = ""
        if key == "reach" and known and failing < total:
            n = int(np.nanargmax(sampled.error.total("roll")))
            where = sampled.attitudes.describe(n)
            worst = f"; worst roll {short(math.sqrt(sampled.error.total('roll')[n]) / ARCSEC_RAD)}{ARCSEC} at {where}"
        errors = errors_text(cross, roll) if known else "unknown"
        rates = sampled.attitudes.rates_text
        lines.append(f"{what}, {rates}: {errors}{worst}{few}")
        values[key] = {
            "cross_arcsec": cross,
            "roll_arcsec": roll,
            "without_solution": failing,
            "centroid_px": centroid_px(sampled),
            "cross_causes_arcsec": causes(sampled, "cross"),
            "roll_causes_arcsec": causes(sampled, "roll"),
        }
    chosen = plan.frames if np.isfinite(values["frames"]["roll_arcsec"]) else plan.reach
    # The causes with their size and their share of the variance.
    named: set[str] = set()
    for angle in ("cross", "roll"):
        sizes = causes(chosen, angle)
        named |= sizes.keys()
        if chosen.predicted() and sizes:
            variance = math.fsum(size**2 for size in sizes.values())
            parts = [
                f"{name} {short(size)}{ARCSEC} ({100 * size**2 / variance:.0f} %)"
                for name, size in sizes.items()
                if size**2 >= MIN_SHARE * variance
            ]
            lines.append(f"{angle}: {', '.join(parts)}")
    lines.append(
        "cross: sqrt(x² + y²), x and y the errors about both axes across the boresight"
    )
    if named & {*SURVEYED, *(["focal length"] if plan.beliefs.focal_sigma else [])}:
        lines.append(
            "of the survey: 1σ over surveys; one dome has one survey, whose error stays the same"
        )
    return Fact("expected error", lines, values)


def centroid_px(sampled: Sampled) -> float:
    """Rms noise of the centroids along each axis at some attitudes; NaN without lights."""
    noise_px2 = np.concatenate([view.noise_px2 for view in sampled.used])
    if not len(noise_px2):
        return math.nan
    return math.sqrt(np.trace(noise_px2, axis1=1, axis2=2).mean() / 2)


def errors_text(cross: float, roll: float) -> str:
    """Expected errors in arcsec as text."""
    return (
        f"cross {short(cross)}{ARCSEC}, roll {short(roll)}{ARCSEC} (1σ)"
        if cross == cross
        else "no solution"
    )


EQUALLY_LIKELY = (np.arange(1000) + 0.5) / 1000
# Errors about the boresight's axes of 1 sigma each in 1000 equally likely draws: Rayleigh's law of the length of two
# equal normal ones, of which cross is the root sum square, and the magnitude of a normal one.
UNIT_ERRORS = {
    "cross": np.sqrt(-np.log(EQUALLY_LIKELY)),
    "roll": special.ndtri(
        (1 + np.mod(EQUALLY_LIKELY * len(EQUALLY_LIKELY) * attitudes.GOLDEN_RATIO, 1)) / 2
    ),
}


def requirements(plan: Plan) -> Fact | None:
    """The expected value of each required error or share at the frames, None without requirements.

    The errors are normal with the expected variances, those about both axes across the boresight equal. `drawn_once` is
    the share of the variance by errors that a run draws once, of cross or roll, whichever is more.
    """
    error = plan.frames.error
    known = np.isfinite(error.total("cross"))
    cross, roll = (
        np.outer(np.sqrt(error.total(angle)), unit) / ARCSEC_RAD
        for angle, unit in UNIT_ERRORS.items()
    )
    sizes = {"cross": cross, "roll": roll, "angle": np.hypot(cross, roll)}
    lines = []
    values = Record()
    for name, limit in plan.scene.require.items():
        limits = re.findall(r"([a-z]+)_arcsec_([\d.]+)", name)
        quantile = re.fullmatch(r"([a-z]+)_arcsec_(?:median|[a-z]+(\d+))", name)
        expected = math.nan
        text = "not forecast; `skysim run` and `skysim study` show it"
        if limits:
            within = [sizes[angle] <= float(most) for angle, most in limits]
            expected = float(np.all(within, axis=0).mean())
            text = f"{100 * expected:.3g} % of at least {100 * limit:g} %"
        elif quantile and known.any():
            share = float(f"0.{quantile[2] or 5}")
            expected = float(np.quantile(sizes[quantile[1]][known], share))
            text = f"{short(expected)}{ARCSEC} of {limit:g}{ARCSEC}"
        if not math.isnan(expected):
            met = expected >= limit if limits else expected <= limit
            text = f"expected {'' if met else 'not '}to be met: {text}"
        lines.append(f"{name}: {text}")
        values[name] = {"limit": limit, "expected": expected}
    shares = [
        sum(error.rad2[angle][name] for name in DRAWN_ONCE) / error.total(angle)
        for angle in UNIT_ERRORS
    ]
    values["drawn_once"] = (
        float(np.mean(np.max(shares, axis=0)[known])) if known.any() else 1.0
    )
    return Fact(REQUIREMENTS, lines, values) if lines else None


# Causes of the expected error that are drawn with the survey.
SURVEYED = ("LED survey", "survey set-up", "common survey", "lever survey", "surface survey")
DRAWN_ONCE = (*SURVEYED, "focal length")


def causes(sampled: Sampled, angle: str) -> dict[str, float]:
    """The rms over the attitudes of the error by each cause in arcsec, the largest first."""
    by_cause = sampled.error.rad2[angle]
    known = np.isfinite(sampled.error.total(angle))
    size = {name: mean_root(variance[known]) for name, variance in by_cause.items()}
    return {
        name: value
        for name, value in sorted(size.items(), key=lambda item: -item[1])
        if value > 0
    }


FACTS = (
    field_of_view,
    lights_in_field,
    other_lights,
    spot,
    peak,
    smear,
    cap,
    room,
    wall,
    *vehicle_facts.FACTS,
    depth_of_focus,
    tracker_beliefs,
    expected_error,
    requirements,
)
