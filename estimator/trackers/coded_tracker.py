"""Star tracker for a dome whose LEDs blink coded names: it follows lights over frames and reads their codes.

For each frame:

1. Detect and centroid the lights as `DomeTracker`.
2. Continue the tracks of the frames before with them (`led_codes.LightTracks`).
3. Compare the brightness of each light in the last frames with the words of all LEDs (`led_codes.misfits`).
4. Name the lights by codes and positions together, which gives an attitude (`led_naming.identify`).
5. Refine the attitude with the exact geometry as `DomeTracker`.

A frame without enough bits, or whose lights contradict each other, has no attitude.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Allowed, Floats, frozen
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids, RateEstimate, StarMatch
from estimator.identification import led_codes, led_naming
from estimator.identification.led_codes import LedCode, LightTracks
from estimator.identification.refusals import NO_LIGHTS
from estimator.trackers.dome_tracker import MIN_ERROR_PX, DomeTracker
from estimator.trackers.pipeline import (
    Clock,
    Settings,
)

COLLECTING = "codes: too few lights have been seen long enough"
MISSED_FRAMES = 2  # missed frames after which a light's track ends, if LEDs are never dark
MIN_BITS = 3  # a light measured in fewer frames could be any LED
MIN_FREE_BITS = 8  # the same where the code's time is unknown
PHASE_REACH = 25.0  # largest difference from the best misfit of a phase of the code's clock that is kept

DECODER = {
    "flux_sigma": Allowed(1e-6, 1.0, "1e-6 to 1"),
    "gate_px": Allowed(1.0, 1e4, "1 to 10,000 pixels"),
    "frames": Allowed(MIN_BITS, 10_000, f"{MIN_BITS} to 10,000", True, optional=True),
}


@frozen
class DecoderSettings:
    """Settings of the decoder.

    Attributes
    ----------
    flux_sigma
        Relative error of a light's brightness besides its photon noise: pulses, the chip,
        detection
    gate_px
        Largest motion of a light between two frames that is not predicted
    frames
        Number of last frames whose brightness is used; None: as many as the code has bits

    Raises
    ------
    ImageError
        For a number that cannot be used.
    """

    flux_sigma: float = 0.03
    gate_px: float = 60.0
    frames: int | None = None

    def __post_init__(self) -> None:
        checks.store_numbers(self, "decoder: ", DECODER)


class CodedTracker(DomeTracker):
    """Tracker under a dome of coded LEDs. It has a memory: it needs the frames in order, with their times and numbers.

    A frame that is not later than the last one clears the memory; so does one without a time, whose lights have no
    names.

    Attributes
    ----------
    code
        Words of the LEDs of the map

    Raises
    ------
    ImageError
        As DomeTracker, for a code of other LEDs, and for a rolling shutter with free-running bits.
    """

    def __init__(
        self,
        camera: Camera,
        leds: LedMap,
        lever: Lever,
        settings: Settings,
        code: LedCode,
        decoder: DecoderSettings | None = None,
    ) -> None:
        super().__init__(camera, leds, lever, settings)
        checks.of_type("code", code, LedCode)
        if len(code.levels) != len(leds.position_m):
            raise ImageError(
                f"code: {len(code.levels)} words; allowed: {len(leds.position_m)}, one an LED"
            )
        if camera.row_time_s and code.bit_time_s is not None:
            raise ImageError(
                "code: the rows of a rolling shutter show different bits; allowed: bit_time_s None"
            )
        self.code = code
        self.decoder = decoder or DecoderSettings()
        radius_m = leds.radius_m
        pupil_m = lever.pupil_cam_m
        position_m = np.asarray(leds.position_m, dtype=float)
        self.sphere = led_naming.Sphere(
            position_m, radius_m, position_m / radius_m[:, None], pupil_m
        )
        goes_dark = bool(code.levels.min() == 0)
        self.tracks = LightTracks(
            camera,
            pupil_m,
            float(np.median(radius_m)),
            self.decoder.frames or code.bits,
            self.decoder.gate_px,
            code.bits if goes_dark else MISSED_FRAMES,
            goes_dark,
        )
        # Expected levels and their errors, by phase, LED and frame
        self.templates = np.zeros((2, len(code.phases), len(code.levels), self.tracks.frames))
        # Phases of the code's clock that the lights have not excluded
        self.phases = np.ones(len(code.phases), bool)
        self.last_s: float | None = None
        led_codes.misfits(*np.ones((4, 1, 1)))  # compiles or loads it before the frames

    def solve_centroids(
        self,
        centroids: Centroids,
        clock: Clock | None = None,
        rate: RateEstimate | None = None,
        exposure_s: float | None = None,
        t_s: float | None = None,
        frame: int = 0,
    ) -> Attitude:
        """Track, name and solve centroids from any source.

        Parameters
        ----------
        rate, exposure_s
            Rate and exposure time as in `solve`; the rate also predicts the lights' motion
        t_s
            Mid-exposure time; None if unknown
        frame
            Number of the frame
        """
        Centroids.check_values(centroids)
        clock = clock or Clock()
        exposure_s = exposure_s or 0.0
        # 2. Tracks
        self._advance(centroids, t_s, rate)
        # Expected brightness of all LEDs in this frame
        middle_s = t_s or 0.0
        self.templates[..., self.tracks.column] = self.code.templates(
            frame, middle_s - exposure_s / 2, middle_s + exposure_s / 2
        )
        if not len(centroids):
            return Attitude(NO_LIGHTS)
        # 3. to 5. Names and attitude
        return self._solve_identified(centroids, self._identify_codes(centroids), clock)

    def _advance(
        self, centroids: Centroids, t_s: float | None, rate: RateEstimate | None
    ) -> None:
        """Continue the tracks with a frame's centroids."""
        if t_s is not None:
            t_s = checks.number("t_s", t_s, -1e300, 1e300, "a finite time in seconds")
        elapsed_s = 0.0 if self.last_s is None or t_s is None else t_s - self.last_s
        if elapsed_s <= 0:
            self.tracks.clear()
            self.phases[:] = True
        self.last_s = t_s
        turn = None
        if rate is not None and rate.sign_known:
            turn = Rotation.from_rotvec(-rate.rate_rad_s * elapsed_s)
        relative = np.hypot(
            self.decoder.flux_sigma, 1 / np.sqrt(centroids.flux * self.settings.gain_e_dn)
        )
        self.tracks.advance(centroids, centroids.flux * relative, elapsed_s, turn)

    def _identify_codes(self, centroids: Centroids) -> StarMatch | str:
        """Return the LEDs of the tracks that are in this frame, or the reason for a refusal."""
        # Tracks that are long enough
        tracks = self.tracks
        measured = np.isfinite(tracks.light).sum(axis=1)
        least = MIN_BITS if len(self.phases) == 1 else MIN_FREE_BITS
        usable = np.flatnonzero((tracks.row >= 0) & (measured >= least))
        if len(usable) < 2:
            return COLLECTING
        # 3. Misfits. The error is the same in all frames of a light: relative errors would give dim frames too much
        # weight.
        greatest = np.nanmax(tracks.sigma[usable], axis=1, keepdims=True)
        sigma = np.where(np.isfinite(tracks.light[usable]), greatest, 1.0)
        misfit = self._misfit(tracks.light[usable], sigma)
        lights = len(usable)
        plausible = misfit.min(axis=(0, 2)) <= led_codes.expected_misfit(measured[usable])
        usable = usable[plausible]
        misfit = misfit[:, plausible]
        if len(usable) < 2:
            self.phases[:] = True
            return COLLECTING
        misfit = misfit / led_codes.excess_noise(misfit.min(axis=(0, 2)), measured[usable])
        # 4. Names
        row = tracks.row[usable]
        named = led_naming.NamedLights(
            *self._tangents(centroids.take(row)), misfit.min(axis=0)
        )
        match = led_naming.identify(named, self.sphere)
        if isinstance(match, str):
            return match
        if not led_naming.is_supported(match, misfit, lights):
            return led_naming.CONTRADICTED
        return replace(match, observed=row[match.observed])

    def _misfit(self, light: Floats, sigma: Floats) -> Floats:
        """Return the (P, T, N) misfit of T lights with the codes of N LEDs, at the P phases that all lights allow.

        The next frame tries these phases and their neighbors.
        """
        tried = np.flatnonzero(self.phases)
        leds = len(self.code.levels)
        templates, spread = self.templates[:, tried].reshape(2, len(tried) * leds, -1)
        flat = np.full((len(light), len(templates)), np.inf)
        for one, row, error in zip(flat, light, sigma, strict=True):
            likely = led_codes.likely(row, templates) if len(tried) > 1 else np.arange(leds)
            one[likely] = led_codes.misfits(
                row[None], error[None], templates[likely], spread[likely]
            )[0]
        each = flat.reshape(-1, len(tried), leds)
        # Misfit of each phase: the sum over the lights of that with the best LED
        common = each.min(axis=2).sum(axis=0)
        allowed = common <= common.min() + PHASE_REACH
        self.phases[:] = False
        for step in (-1, 0, 1):
            self.phases[(tried[allowed] + step) % len(self.phases)] = True
        return each[:, allowed].swapaxes(0, 1)

    def _tangents(self, centroids: Centroids) -> tuple[Floats, Floats]:
        """Return the (K, 3) rays of centroids and the (K,) errors of their tangents, map and lever included."""
        rays = self.camera.rays(centroids.xy_px)
        own = np.hypot(
            self.direction_sigma_rad(centroids),
            MIN_ERROR_PX / self.camera.focal_px,
        )
        tangent = np.linalg.norm(rays[:, :2] / rays[:, 2:], axis=1)
        lever = self.lever.sigma_m / self.sphere.radius_m.min() * tangent
        leds = float(self.led_sigma_rad.max())
        return rays, np.sqrt((own**2 + leds**2) / rays[:, 2] ** 4 + lever**2)
