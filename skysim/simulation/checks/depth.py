"""How deep the camera sees, and whether the simulated sky and the tracker's catalog are as deep."""

from __future__ import annotations

import math
import numpy as np
from skysim.scene.sections.light import StarsConfig
from skysim.simulation.checks.detection import BINOMIAL_VARIANCE_PX2, Context, threshold_e
from skysim.simulation.checks.facts import Fact
from skysim.simulation.checks.findings import few_lights
from skysim.simulation.checks.sampling import Samples
from skysim.simulation.checks.views import peak_share
from skysim.sources.photometry import SUN, star_flux_e_s_m2



# by which the camera may see fainter stars than a catalog, a limit
CATALOG_MARGIN_MAG = 0.3
LIMIT_MARGIN_MAG = 0.5
MIN_KNOWN = (
    0.2  # share of the stars detected that the tracker should know: among more others it needs luck
)
DEEPEST_V = 10.0  # of a sky that `skysim catalog build` makes
SNR = 5.0


def faintest_star(context: Context, samples: Samples) -> Fact | None:
    """V of the faintest star that the tracker detects, and of that with a signal-to-noise ratio of 5."""
    scene = context.lab.scene
    believed = context.beliefs
    if not isinstance(scene.light, StarsConfig):
        return None
    rate_deg_s = float(
        np.degrees(np.linalg.norm(samples.frames.attitudes.rate_body_rad_s, axis=1)).min()
    )
    limit_mag = detection_limit_mag(context, samples)
    snr_mag = snr_limit_mag(context, samples)
    sky = context.lab.camera.sources.magnitude
    known = known_share(context, limit_mag)
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


def sky_too_shallow(context: Context, samples: Samples) -> str:
    """Warn where the camera detects fainter stars than the simulated sky holds."""
    light = context.lab.scene.light
    sky = context.lab.camera.sources.magnitude
    if not isinstance(light, StarsConfig) or not len(sky):
        return ""
    limit_mag = detection_limit_mag(context, samples)
    faintest_mag = float(np.nanmax(sky))
    text = f"the camera detects stars to V {limit_mag:.1f}, but the sky ends at V {faintest_mag:.1f}; change it to"
    if light.limit_mag is not None:
        said = few_lights(context, samples).startswith(
            "light.limit_mag"
        )  # which asks for a deeper one already
        deeper = limit_mag > light.limit_mag + LIMIT_MARGIN_MAG and not said
        return (
            f"light.limit_mag: {text} {math.ceil(2 * limit_mag) / 2:g}, or leave it out"
            if deeper
            else ""
        )
    if limit_mag <= min(faintest_mag + CATALOG_MARGIN_MAG, DEEPEST_V):
        return ""
    wanted = min(math.ceil(2 * limit_mag) / 2, DEEPEST_V)
    return (
        f"light.catalog: {text} a file of `skysim catalog build --source gaia --limit {wanted:g}`"
    )


def tracker_too_shallow(context: Context, samples: Samples) -> str:
    """Warn where most of the stars that the tracker detects are fainter than those that it knows."""
    if not isinstance(context.lab.scene.light, StarsConfig):
        return ""
    limit_mag = detection_limit_mag(context, samples)
    faintest_mag = context.beliefs.faintest_mag
    known = known_share(context, limit_mag)
    if known >= MIN_KNOWN or limit_mag <= faintest_mag + LIMIT_MARGIN_MAG:
        return ""
    return (
        f"tracker.limit_mag: the camera detects stars to V {limit_mag:.1f}, but the tracker knows them to V"
        f" {faintest_mag:.1f} only, {100 * known:.0f} % of them; change it to {math.floor(2 * limit_mag) / 2:g}, with a"
        f" tracker.catalog of `skysim catalog build --limit {math.floor(2 * limit_mag) / 2:g}`"
    )


def detection_limit_mag(context: Context, samples: Samples) -> float:
    """V of the faintest star like the Sun that is detected at the slowest frame, about half of such stars being so.

    A Gaussian of variance s^2 has the least area A above the threshold T if its peak is T exp(A / (2 pi s^2)), see
    `detection.detected_area_px`.
    """
    camera = context.camera
    blur2_px2 = camera.lens_px**2 + BINOMIAL_VARIANCE_PX2
    peak_e = threshold_e(context) * math.exp(
        context.settings.min_area_px / (2 * math.pi * blur2_px2)
    )
    none = np.zeros(1)
    share = peak_share(np.array([blur2_px2]), none, none, np.array([least_streak_px(samples)]))[0]
    reference_e_s_m2 = float(star_flux_e_s_m2(0.0, *SUN, context.lab.camera.band))
    return 2.5 * math.log10(
        reference_e_s_m2 * camera.optics.collecting_m2 * camera.exposure_s * share / peak_e
    )


def snr_limit_mag(context: Context, samples: Samples) -> float:
    """V of a star like the Sun with a signal-to-noise ratio of 5 over the noise-equivalent area, at the slowest frame.

    S / sqrt(S + A n^2) = 5, n the noise of a pixel, gives S = (25 + sqrt(25^2 + 100 A n^2)) / 2. A Gaussian of
    deviation s has the area A = 4 pi s^2, moved by L much more than s it has 2 sqrt(pi) s L; between them the
    hypotenuse.
    """
    camera = context.camera
    area_px = (
        2
        * math.sqrt(math.pi)
        * camera.lens_px
        * math.hypot(2 * math.sqrt(math.pi) * camera.lens_px, least_streak_px(samples))
    )
    signal_e = (SNR**2 + math.sqrt(SNR**4 + 4 * SNR**2 * area_px * camera.noise_e**2)) / 2
    reference_e_s_m2 = float(star_flux_e_s_m2(0.0, *SUN, context.lab.camera.band))
    return 2.5 * math.log10(
        reference_e_s_m2 * camera.optics.collecting_m2 * camera.exposure_s / signal_e
    )


def least_streak_px(samples: Samples) -> float:
    """Path of the images at the slowest frame."""
    return float(
        min(
            (np.median(view.streak_length_px) for view in samples.frames.known if len(view)),
            default=0.0,
        )
    )


