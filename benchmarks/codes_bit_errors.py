"""Bit errors of blinking LEDs in rendered frames against theory: exposure, noise, duty, flicker, edges of bits.

A hundred LEDs in a field at rest are detected and centroided; a bit is read as 1 if the light is above the middle of
the LED's two levels, N and N (1 - m) electrons by strength, exposure and duty. With the photons' noise and that of the
chip, s^2 in an LED's window, a bit fails with the mean of Q(m N / 2 / sqrt(N + s^2)) and
Q(m N / 2 / sqrt(N (1 - m) + s^2)). A drive whose period does not divide the exposure changes N from frame to frame by
the pulses' phase, which is uniform. A free-running bit's edge in the exposure mixes both bits; the part x of the time
with the other one is uniform up to 1/2, and the margin shrinks by 1 - 2 x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from estimator.centroiding.moments import MARGIN_PX
from estimator.core.types import NO_PRIORS
from estimator.detection.background import SAMPLE_ROWS, TILE_PX
from estimator.detection.detect import DETECTORS
from estimator.trackers.pipeline import Clock, detect_and_centroid
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab, exposure_window
from skysim.simulation.lights.emitters import LedDome
from skysim.sources.dome.codes import LedCodes
from skysim.sources.dome.led import lit_moments_s
from skysim.tracking.factory import assumed_settings
from skysim.tracking.onboard_model import calibration

FRAMES = 250
MAX_OFF = 0.1  # relative difference from theory
SETTINGS = {
    "light.layout": "{kind: fibonacci, count: 2500, cap_deg: 8}",
    "light.led.scatter": "0",
    "light.led.intensity": "5 mcd",
    "light.led.clock": "{offset_ppm: 0, drift_ppm_h: 0}",
    "camera.width_px": "800",
    "camera.height_px": "600",
    "camera.detector.read_noise_e": "1",
    "camera.detector.gain_e_dn": "1",
    "camera.detector.bits": "16",
    "camera.detector.dark_e_s": "0",
    "camera.detector.hot_pixels": "0",
    "tracker.threshold_sigma": "8",
}


WANDERING = {"light.led.clock": "{offset_ppm: 2000}"}
DIRECT = {"light.led.drive": "{kind: direct}", "light.led.clock": "{}"}


@dataclass(frozen=True)
class Case:
    """A drive, exposure and code; `depth` is 3 / sqrt N unless it is given, for errors of 7 %."""

    name: str
    settings: dict[str, str]
    depth: float | None = None


CASES = (
    Case("steady LED, 2 ms", DIRECT | {"exposure.time": "2 ms"}),
    Case("steady LED, 8 ms", DIRECT | {"exposure.time": "8 ms"}),
    Case(
        "steady LED, 2 ms, 10 e read noise",
        DIRECT | {"exposure.time": "2 ms", "camera.detector.read_noise_e": "10"},
    ),
    Case("duty 0.25, 4 ms", {"exposure.time": "4 ms", "light.layout.levels": "[0.25]"}),
    Case(
        "flicker: duty 0.5 of 1.5 ms, 4 ms",
        {
            "exposure.time": "4 ms",
            "light.layout.levels": "[0.5]",
            "light.led.pwm_period": "1.5 ms",
        }
        | WANDERING,
        depth=0.15,
    ),
    Case(
        "free-running, half a bit",
        {
            "exposure.time": "10 ms",
            "light.led.drive": "{kind: direct}",
            "light.led.clock.offset_ppm": "0",
            "light.led.code": "{kind: cyclic, distance: 3, bit_time: 20.3 ms}",
        },
    ),
)


def lab_of(case: Case, depth: float) -> Lab:
    return build_lab(
        loader.load(
            "coded_spiral", SETTINGS | case.settings | {"light.led.code.depth": str(depth)}
        )
    )


def measure(count: int = FRAMES) -> list[dict[str, Any]]:
    """One row a case: the bit error rate of `count` frames, theory's, their ratio and whether they agree to MAX_OFF."""
    rows = []
    for case in CASES:
        measured, theory = bit_error_rate(case, count)
        ratio = measured / theory
        rows.append(
            {
                "name": f"bit errors, {case.name}",
                "value": 100 * measured,
                "unit": "%",
                "peer": "theory",
                "peer_value": 100 * theory,
                "ratio": ratio,
                "bar": MAX_OFF,
                "met": abs(ratio - 1) <= MAX_OFF,
            }
        )
    return rows


def bit_error_rate(case: Case, frames: int) -> tuple[float, float]:
    """Measured and theoretical rate of a case."""
    _, _, full_e = read_lights(lab_of(case, 0.5), 20)
    lab = lab_of(case, case.depth or float(3 / np.sqrt(np.nanmedian(full_e))))
    light, bits, full_e = read_lights(lab, frames)
    usable = np.isfinite(light).sum(axis=0) > 0.9 * frames
    light = light[:, usable]
    bits = bits[:, usable]
    full_e = np.nanmedian(full_e[:, usable], axis=0)
    levels = [
        np.nanmean(np.where(bits == bit, light, np.nan), axis=0) for bit in (False, True)
    ]
    wrong = (light > np.mean(levels, axis=0)) != bits
    changes = float(np.mean(bits[1:] != bits[:-1]))
    noise_e2 = window_noise_e2(lab)
    return float(wrong[np.isfinite(light)].mean()), theory(lab, full_e, noise_e2, changes)


def window_noise_e2(lab: Lab) -> float:
    """Variance of an LED's light by the chip: read and rounding noise of the pixels of a median window, and of its sky.

    The sky's level is that of SAMPLE_ROWS rows of a tile after the binomial filter [1 2 1], which leaves 6/16 of the
    variance, and is interpolated between tiles, which leaves 4/9 of it on average.
    """
    frame, _ = render_at_rest(lab.camera, lab.start)
    settings = assumed_settings(lab.scene)
    detector = lab.scene.camera.detector
    blobs = DETECTORS[settings.detector](
        frame.image_dn,
        settings.threshold_sigma,
        settings.min_area_px,
        settings.max_blobs,
        NO_PRIORS,
    )
    width, height = (blobs.box_px[:, 2:] - blobs.box_px[:, :2] + 1 + 2 * MARGIN_PX).T
    pixels = float(np.median(width * height))
    sky_share = 4 / 9 * 6 / 16 / (SAMPLE_ROWS * TILE_PX)  # of a pixel's variance
    return (
        pixels
        * (1 + pixels * sky_share)
        * (detector.read_noise_e**2 + detector.gain_e_dn**2 / 12)
    )


def codes_of(lab: Lab) -> LedCodes:
    """The codes of a dome's LEDs in this run."""
    dome = lab.camera.known
    assert isinstance(dome, LedDome)
    codes = dome.timing(lab.camera.run_seed).codes
    assert codes is not None
    return codes


def read_lights(lab: Lab, frames: int) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """(F, N) light of each LED in each frame, NaN where it is not detected; the bit in the middle of the exposure; and
    the expected electrons of a 1."""
    camera = calibration(lab.scene.camera)
    settings = assumed_settings(lab.scene)
    codes = codes_of(lab)
    rows = []
    for number in range(frames):
        frame, truth = render_at_rest(lab.camera, lab.start, number)
        centroids = detect_and_centroid(frame.image_dn, camera, settings, Clock())
        light, full_e = np.full((2, len(lab.camera.sources)), np.nan)
        row = np.searchsorted(lab.camera.sources.id, truth.sources.id)
        apart = np.linalg.norm(centroids.xy_px[:, None] - truth.sources.xy_px, axis=2)
        nearest = apart.argmin(axis=1)
        good = apart[np.arange(len(nearest)), nearest] < 2
        light[row[nearest[good]]] = centroids.flux[good]
        window = exposure_window(lab.scene, number)
        level = codes.mean_level(window.open_s, window.exposure_s, number)
        full_e[row] = truth.sources.electrons / level[row]
        middle_s = window.open_s + window.exposure_s / 2
        bit = (
            number
            if codes.clock is None
            else int(codes.time_s(middle_s) // float(codes.config.bit_time_s))
        )
        rows.append((light, codes.words[:, bit % codes.words.shape[1]] > 0, full_e))
    light, bits, full_e = (np.array(one) for one in zip(*rows, strict=True))
    return light, bits, full_e


def theory(lab: Lab, full_e: Floats, noise_e2: float, changes: float) -> float:
    """Mean probability of a bit's error: over both bits, (K,) LEDs, the drive's phases and a bit's edges.

    full_e   : (K,) median electrons of a 1
    noise_e2 : variance beside that of the photons
    changes  : part of the successive bits that differ
    """
    assert isinstance(lab.scene.light, DomeConfig)
    exposure_s = lab.scene.exposure.time_s
    code = codes_of(lab).config
    period_s = float(lab.camera.sources.period_s[0])
    on_s = float(lab.camera.sources.on_s[0])
    phase_s = (np.arange(400) + 0.5) / 400 * period_s
    lit_s = np.array(
        [lit_moments_s(0.0, exposure_s, period_s, start_s, on_s)[0] for start_s in phase_s]
    )
    light_e = (full_e[:, None] * lit_s / np.median(lit_s))[..., None]
    middle_e = full_e[:, None, None] * (1 - code.depth / 2)

    def fails(part: Floats) -> float:
        """Mean failure where a part of the time shows the other bit."""
        one = light_e * (1 - code.depth * part)
        zero = light_e * (1 - code.depth * (1 - part))
        below = (middle_e - one) / np.sqrt(one + noise_e2)
        above = (zero - middle_e) / np.sqrt(zero + noise_e2)
        return float(np.mean([ndtr(below), ndtr(above)]))

    if code.bit_time_s == "frame":
        return fails(np.zeros(1))
    mixed = changes * exposure_s / code.bit_time_s
    return mixed * fails((np.arange(100) + 0.5) / 200) + (1 - mixed) * fails(np.zeros(1))
