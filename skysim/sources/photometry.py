"""Photometry: magnitudes and candelas to photo-electrons, by integrating spectra with the camera's response.

A star is a black body of its effective temperature, which follows from its colors along the measured sequence of
dwarfs, scaled to its V magnitude. An LED has a tabulated spectrum, a Gaussian one or a single line. In all cases

    electrons = integral of photons(lambda) R(lambda) d lambda,

with the camera's response R (`Band`): the chip's quantum efficiency, times the lens's transmission if that is a curve.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from skysim.core.constants import (
    ARCSEC2_SR,
    BOLTZMANN_J_K,
    FWHM_PER_SIGMA,
    LUMINOUS_EFFICACY_LM_W,
    PLANCK_J_S,
    SPEED_OF_LIGHT_M_S,
)
from skysim.core.errors import InputError, Where
from skysim.core.paths import DATA
from skysim.core.text import cells_of, column_numbers, read_lines, to_numbers
from skysim.core.types import Floats
from skysim.scene.sections.camera import (
    CameraConfig,
    ChromaticConfig,
    ColorEfficiencyConfig,
    EfficiencyConfig,
    curve_file,
)
from skysim.scene.sections.leds import spectrum_file

HC_J_M = PLANCK_J_S * SPEED_OF_LIGHT_M_S  # energy of a photon times its wavelength
HC_K_M = HC_J_M / BOLTZMANN_J_K
V0_W_M3 = 3.63e-2  # irradiance of a star of V = 0: 3.63e-9 erg s^-1 cm^-2 A^-1 (reference §2)

# Bandpass of the silicon camera for a quantum efficiency that is one number (reference §2).
FLAT_M = (400e-9, 1000e-9)

LUMA = (0.2989, 0.5870, 0.1140)  # weights of red, green, blue in gray (ITU-R BT.601)
STEP_M = 1e-9  # of the integrals
NODES = 4  # of the quadrature of lateral color, K
LONGEST_NM = 10_000.0  # of a curve; the integral of a longer one would take too many steps
SUN = (
    0.650,
    0.713,
)  # B-V and V-I of a G2 star, the zero point of every instrumental magnitude
kept = lru_cache(maxsize=64)  # for what scenes of one process share
Reals = float | Floats  # one number, or an array of them
Curve = Callable[[Floats], Floats]  # of wavelengths in m
Spectrum = str | float  # of an LED: "white" or a file, or the peak wavelength in m


@dataclass(frozen=True, eq=False, slots=True)
class Band:
    """Response of a camera: photo-electrons per photon against wavelength.

    Attributes
    ----------
    wavelength_m
        (K,) ascending wavelengths; the response is zero beyond their ends
    response
        (K,) electrons per photon, linear between the wavelengths
    chromatic
        Chromatic aberration of the lens, which is averaged over a light's photo-electrons
    """

    wavelength_m: Floats
    response: Floats
    chromatic: ChromaticConfig | None = None

    @classmethod
    def from_camera(cls, camera: CameraConfig, curve: str = "") -> "Band":
        """The response of a camera: its chip's quantum efficiency times its lens's transmission curve; cached.

        `curve` is the quantum efficiency of one of its colors; if empty, that of the chip. A transmission that is one
        number is part of `Optics.collecting_m2`. Raises as `from_efficiency`.
        """
        band = cls.from_efficiency(curve or camera.detector.quantum_efficiency)
        if isinstance(camera.transmission, str):
            # The time of change is part of the cache's key.
            path = Path(camera.transmission)
            band = _product(band, _read_curve(path, path.stat().st_mtime_ns))
        return _through(band, camera.chromatic) if camera.chromatic else band

    @classmethod
    def from_efficiency(
        cls, quantum_efficiency: float | str | EfficiencyConfig | ColorEfficiencyConfig
    ) -> "Band":
        """The band of one number (flat over 400-1000 nm) or of a named curve; cached, so the same object every time.

        A curve with a peak is scaled to it. That of three colors is the band of the gray image that a tracker makes of
        them, 0.2989 R + 0.5870 G + 0.1140 B (ITU-R BT.601, as MATLAB's rgb2gray).

        Raises
        ------
        InputError
            For an unknown name, and for a file that is not a curve.
        """
        if isinstance(quantum_efficiency, str):
            path = curve_file(quantum_efficiency)
            return _read_curve(path, path.stat().st_mtime_ns)
        if isinstance(quantum_efficiency, EfficiencyConfig):
            return _scaled(
                cls.from_efficiency(quantum_efficiency.curve), quantum_efficiency.peak
            )
        if isinstance(quantum_efficiency, ColorEfficiencyConfig):
            return _luma(*(cls.from_efficiency(curve) for _, curve in quantum_efficiency))
        return _flat(float(quantum_efficiency))

    def response_at(self, wavelength_m: Reals) -> Floats:
        """The response at wavelengths of any shape, by linear interpolation; 0 beyond the curve's ends."""
        return np.asarray(
            np.interp(wavelength_m, self.wavelength_m, self.response, left=0.0, right=0.0)
        )

    def grid_m(self) -> Floats:
        """Wavelengths in steps of a nanometer, and the curve's own samples, because it has kinks there."""
        first, last = self.wavelength_m[[0, -1]]
        # Whole nanometers within the curve.
        even = np.arange(math.ceil(first / STEP_M), math.floor(last / STEP_M) + 1) * STEP_M
        return np.union1d(even[(even > first) & (even < last)], self.wavelength_m)

    def integral(self, spectrum: Curve) -> Floats:
        """Integral of a spectrum times the response over wavelength: trapezoidal rule on `grid_m`.

        Parameters
        ----------
        spectrum
            Function of (M,) wavelengths in m that returns (..., M) values per meter of wavelength

        Returns
        -------
        Floats
            (...,)
        """
        grid = self.grid_m()
        return np.asarray(
            np.trapezoid(spectrum(grid) * self.response_at(grid), grid, axis=-1)
        )


@kept
def _flat(quantum_efficiency: float) -> Band:
    """A constant response over FLAT_M."""
    return Band(np.array(FLAT_M), np.full(2, quantum_efficiency))


@kept
def _scaled(band: Band, peak: float) -> Band:
    """A response scaled to another peak."""
    return Band(band.wavelength_m, band.response * (peak / band.response.max()))


@kept
def _luma(*colors: Band) -> Band:
    """The band of the gray image of a red, a green and a blue band."""
    grid_m = np.unique(np.concatenate([color.wavelength_m for color in colors]))
    return Band(grid_m, np.dot(LUMA, [color.response_at(grid_m) for color in colors]))


@kept
def _through(band: Band, chromatic: ChromaticConfig) -> Band:
    """A response with the chromatic aberration of a lens."""
    return replace(band, chromatic=chromatic)


@kept
def _product(first: Band, second: Band) -> Band:
    """The product of two curves where both reach, sampled every nanometer and at the samples of both."""
    low_m = max(first.wavelength_m[0], second.wavelength_m[0])
    high_m = min(first.wavelength_m[-1], second.wavelength_m[-1])
    if not low_m < high_m:
        raise InputError(
            "camera.transmission",
            "lets nothing through where the chip has a response",
            "an overlap",
        )
    grid = np.union1d(first.grid_m(), second.grid_m())
    grid = grid[(grid >= low_m) & (grid <= high_m)]
    return Band(grid, first.response_at(grid) * second.response_at(grid))


@kept
def _read_curve(path: Path, _changed_ns: int = 0, largest: float = 1.0) -> Band:
    """Read a curve: comments (#), a line of names, then lines of wavelength in nm and response, 0 to `largest`.

    _changed_ns is the file's modification time: a changed file has another key in the cache. Raises InputError.
    """
    rows = cells_of(read_lines(path))[1:]
    if len(rows) < 2:
        raise InputError(
            path, "fewer than two rows", "two columns, wavelength_nm and response"
        )
    wavelength_nm, response = to_numbers(path, rows, 2).T
    right = (np.diff(wavelength_nm, prepend=0.0) > 0) & (wavelength_nm <= LONGEST_NM)
    right &= (response >= 0) & (response <= largest)
    if not (right.all() and response.any()):
        # The first wrong line; of a curve of zeros the first.
        raise Where(path, rows[np.argmin(right)][0]).error(
            "not a response curve",
            f"ascending wavelength_nm to {LONGEST_NM:.0f}, response within 0 and {largest:g}, not always 0",
        )
    return Band(wavelength_nm * 1e-9, response)


class StellarSequence(NamedTuple):
    """The measured sequence of stars from hot to cool, (K,) each, from data/bands/stellar_sequence.csv."""

    temperature_k: Floats
    b_v: Floats
    v_i: Floats


@lru_cache(maxsize=1)
def stellar_sequence() -> StellarSequence:
    """Effective temperature against color of real stars (Pecaut & Mamajek 2013, ApJS 208, 9)."""
    path = DATA / "bands" / "stellar_sequence.csv"
    rows = cells_of(read_lines(path))
    return StellarSequence(*column_numbers(path, rows, rows[0][1][:3]).T)


def complete_colors(b_v: Reals, v_i: Reals) -> tuple[Floats, Floats]:
    """The catalog's colors; a missing one is taken from the stellar sequence at the other one.

    Parameters
    ----------
    b_v, v_i
        Johnson B-V and Cousins V-I, any shapes that broadcast. NaN is missing. Hipparcos writes zeros in both (and in
        their errors) if it has neither, and a V-I of 0 with |B-V| > 0.1 fits no star.

    Returns
    -------
    tuple
        B-V and V-I. If both are missing they are a G2 star's (the median of the catalog is .2 bluer). Values beyond the
        sequence's ends (a V-I of 9) are clipped.
    """
    b_v, v_i = np.broadcast_arrays(np.asarray(b_v, dtype=float), np.asarray(v_i, dtype=float))
    # Marks of missing colors.
    neither = (b_v == 0) & (v_i == 0)
    no_b_v = np.isnan(b_v) | neither
    no_v_i = np.isnan(v_i) | neither | ((v_i == 0) & (np.abs(b_v) > 0.1))
    stars = stellar_sequence()
    # The sequence gives each color from the other one.
    from_b_v = np.where(no_b_v, SUN[1], np.interp(b_v, stars.b_v, stars.v_i))
    from_v_i = np.where(no_v_i, SUN[0], np.interp(v_i, stars.v_i, stars.b_v))
    return (
        np.clip(np.where(no_b_v, from_v_i, b_v), stars.b_v[0], stars.b_v[-1]),
        np.clip(np.where(no_v_i, from_b_v, v_i), stars.v_i[0], stars.v_i[-1]),
    )


def temperature_k(b_v: Reals, v_i: Reals) -> Floats:
    """A star's effective temperature from its color, along the sequence of real stars.

    V-I is used, and B-V only where V-I is missing. V-I spans the wavelengths where silicon is sensitive, still grows
    for M stars, whose B-V is constant, and depends least on gravity and metallicity. A star reddened by dust gets a
    lower temperature, which matches how its light is distributed over the chip's band. The colors are not a black
    body's: one of the Sun's temperature has B-V = .45 instead of .65 (reference §2). The sequence is that of dwarfs;
    K giants come out 5 % too warm. Colors beyond the table's ends get the end values, 33,300 K and 2,680 K. Shapes
    as in `complete_colors`.
    """
    stars = stellar_sequence()
    return np.interp(complete_colors(b_v, v_i)[1], stars.v_i, stars.temperature_k)


def black_body_v0(wavelength_m: Floats, temperature_k: Floats) -> Floats:
    """Spectral photon flux of a black body of V = 0: Planck's law, scaled to V's zero point.

    B(lambda, T) / (h c / lambda), in photons s^-1 m^-2 per meter of wavelength. The energy-weighted mean spectral flux
    in Bessell's V is 3.63e-9 erg s^-1 cm^-2 A^-1. (The same zero point applied at 5450 A alone makes a G2 star 1.3 %
    fainter, and puts it 1.3 % off the reference's 56,200 photons s^-1 mm^-2.)

    Parameters
    ----------
    wavelength_m
        (M,)
    temperature_k
        (...,)

    Returns
    -------
    Floats
        (..., M)
    """
    # One more axis, for the wavelengths.
    kelvin = np.asarray(temperature_k, dtype=float)[..., None]

    # Planck's law up to a constant factor, which cancels against the mean in V.
    def power(wavelength_m: Floats) -> Floats:
        return wavelength_m**-5.0 / np.expm1(HC_K_M / (wavelength_m * kelvin))

    # V's zero point fixes the mean of the power in V.
    johnson_v = _read_curve(DATA / "bands" / "johnson_v.csv")
    mean = johnson_v.integral(power) / johnson_v.integral(np.ones_like)
    return power(wavelength_m) * wavelength_m / HC_J_M * (V0_W_M3 / mean)[..., None]


@kept
def _black_bodies(band: Band) -> tuple[Floats, Floats]:
    """(256,) inverse temperatures, and log10 of the photo-electrons s^-1 m^-2 at V = 0, a smooth function of them."""
    # Even steps of 1/T, in which the logarithm of the flux is smooth.
    range_k = stellar_sequence().temperature_k[[0, -1]]
    inverse_k = np.linspace(1 / range_k[0], 1 / range_k[1], 256)
    return inverse_k, np.log10(
        band.integral(lambda wavelength_m: black_body_v0(wavelength_m, 1 / inverse_k))
    )


def star_flux_e_s_m2(v_mag: Reals, b_v: Reals, v_i: Reals, band: Band) -> Floats:
    """Pogson's law for a black body of the star's effective temperature: photo-electrons above the atmosphere.

    Returns photo-electrons s^-1 m^-2 of collecting area, in the band and before any loss in the lens:
    10^(-0.4 V) int n(lambda, T) R(lambda) d lambda, from a table for each band, accurate to 1e-5.
    Error of the black body: in Gaia's G, as broad as silicon, its G-V relative to a G2 star agrees with measured
    stars within .045 mag from B5 to K0. Molecules darken cooler stars in V, so the black body makes them too faint:
    .05 mag at K3, .09 at K5, .19 at M0, .25 at M1, .44 at M3.

    Parameters
    ----------
    v_mag, b_v, v_i
        Johnson V, Johnson B-V, Cousins V-I, shapes that broadcast. To convert Hp to V see
        `star_archives.v_from_hp`; for missing colors `complete_colors`.
    """
    inverse_k, log_e = _black_bodies(band)
    log_v0 = np.interp(1 / temperature_k(b_v, v_i), inverse_k, log_e)
    return 10.0 ** (log_v0 - 0.4 * np.asarray(v_mag, dtype=float))


@kept
def _black_body_moments(band: Band) -> tuple[Floats, Floats]:
    """(256,) inverse temperatures, and `chromatic_moments` (256, 4 + 2 K) of black bodies of these temperatures."""
    inverse_k, _ = _black_bodies(band)
    return inverse_k, chromatic_moments(
        band, lambda wavelength_m: black_body_v0(wavelength_m, 1 / inverse_k)
    )


def star_chromatic(b_v: Reals, v_i: Reals, band: Band) -> Floats | None:
    """(..., 4 + 2 K) `chromatic_moments` of stars of these colors; None for a lens without chromatic aberration."""
    if band.chromatic is None:
        return None
    inverse_k, moments = _black_body_moments(band)
    # Each column is interpolated in 1/T.
    own_k = 1 / temperature_k(b_v, v_i)
    return np.stack([np.interp(own_k, inverse_k, column) for column in moments.T], axis=-1)


def led_chromatic(spectrum: Spectrum, band: Band, fwhm_m: float | None = None) -> Floats:
    """(4 + 2 K,) `chromatic_moments` of an LED, with arguments as in `led_strength_e_s_sr`."""
    # A line has no spread.
    if not isinstance(spectrum, str) and fwhm_m is None:
        shifts = chromatic_shifts(band, np.array([spectrum]))[:, 0]
        return np.array([*shifts, 0, 0, *np.eye(2 * NODES)[NODES]])
    power, _ = broad_spectrum(spectrum, fwhm_m)
    return chromatic_moments(band, lambda wavelength_m: power(wavelength_m) * wavelength_m)


def chromatic_moments(band: Band, photons: Curve) -> Floats:
    """Moments of the lens's chromatic shifts over a light's photo-electrons, and a quadrature of the lateral ones.

    The quadrature's K nodes and shares give the mean of polynomials of degree 2 K - 1 over the light, so an image made
    of K spots has the mean, the variance, the skewness and further moments of the whole light. It is Gauss's: in the
    basis of polynomials that are orthogonal under the light, multiplication by the shift is a matrix whose eigenvalues
    are the nodes, and the squares of the eigenvectors' first components are the shares (Golub & Welsch 1969, Math.
    Comp. 23, 221). A light of fewer shifts has nodes without a share.

    Parameters
    ----------
    photons
        Spectrum in photons, to any scale, as in `Band.integral`

    Returns
    -------
    Floats
        (..., 4 + 2 K) means of the shift of focus in m and of the shift at the chip's corner in px, their standard
        deviations, K nodes of the latter about its mean in px, and their shares of the light
    """
    # Weights of the trapezoidal rule, as in `Band.integral`.
    grid = band.grid_m()
    light = photons(grid) * band.response_at(grid) * np.convolve(np.diff(grid), (0.5, 0.5))
    # The camera may see nothing of it.
    light /= np.maximum(light.sum(axis=-1, keepdims=True), 1e-300)
    shifts = chromatic_shifts(band, grid).T
    means = light @ shifts
    # Rounding may leave less than nothing.
    spreads = np.sqrt(np.maximum(light @ shifts**2 - means**2, 0))
    lateral_px = shifts[:, 1]
    powers = np.vander(lateral_px, NODES, increasing=True)
    basis = np.linalg.qr(np.sqrt(light)[..., None] * powers)[0]
    nodes_px, vectors = np.linalg.eigh(basis.mT @ (lateral_px[:, None] * basis))
    return np.concatenate(
        [means, spreads, nodes_px - means[..., 1:], vectors[..., 0, :] ** 2], axis=-1
    )


def chromatic_shifts(band: Band, wavelength_m: Floats) -> Floats:
    """(2, M) shift of the focus in m, and at the chip's corner in px, at (M,) wavelengths."""
    config = band.chromatic
    assert config is not None
    none = np.zeros(len(config.wavelength_m))
    columns = [
        none if column is None else column for column in (config.focus_m, config.corner_px)
    ]
    return np.array(
        [np.interp(wavelength_m, config.wavelength_m, column) for column in columns]
    )


def synthetic_mag(v_mag: Reals, b_v: Reals, v_i: Reals, band: Band) -> Floats:
    """Instrumental magnitude of a star in this band, equal to V for a G2 star.

    m = -2.5 log10(e- of the star / e- of a G2 star of V = 0). Shapes as in `star_flux_e_s_m2`.
    """
    # V is the zero point of a G2 star by definition.
    ratio = star_flux_e_s_m2(v_mag, b_v, v_i, band) / star_flux_e_s_m2(0.0, *SUN, band)
    return -2.5 * np.log10(ratio)


def sky_radiance_e_s_m2_sr(mag_arcsec2: Reals, band: Band) -> Floats:
    """Radiance of a sky with this V magnitude per square arcsecond and sunlight's color.

    Moonlight and zodiacal light are sunlight. Airglow has emission lines, which a V magnitude does not describe.

    Parameters
    ----------
    mag_arcsec2
        V magnitude per square arcsecond, any shape

    Returns
    -------
    Floats
        Photo-electrons s^-1 m^-2 sr^-1
    """
    return star_flux_e_s_m2(mag_arcsec2, *SUN, band) / ARCSEC2_SR


def led_strength_e_s_sr(
    intensity_cd: Reals, spectrum: Spectrum, band: Band, fwhm_m: float | None = None
) -> Floats:
    """Candela to photo-electrons s^-1 sr^-1: luminous intensity / luminous efficacy * electrons per joule.

    Parameters
    ----------
    intensity_cd
        Luminous intensity along the LED's normal, any shape
    spectrum
        "white" (data/led/white.csv, 304 lm/W) or a file, or the peak wavelength in m of a colored LED
    fwhm_m
        Width of its spectrum at half maximum; None for a narrow line

    Raises
    ------
    InputError
        For a line outside the visible range, which has no candelas.
    """
    # Candela are lumens per steradian.
    watts_sr = np.asarray(intensity_cd, dtype=float) / lumens_per_watt(spectrum, fwhm_m)
    return radiant_strength_e_s_sr(watts_sr, spectrum, band, fwhm_m)


def radiant_strength_e_s_sr(
    intensity_w_sr: Reals,
    spectrum: Spectrum,
    band: Band,
    fwhm_m: float | None = None,
) -> Floats:
    """Radiant intensity to photo-electrons s^-1 sr^-1: I_e int S R l / (h c) dl / int S dl over the wavelength l.

    S is the spectrum's shape, R the camera's response.
    """
    if not isinstance(spectrum, str) and fwhm_m is None:
        # A line has one wavelength.
        electrons_per_joule = band.response_at(spectrum) * spectrum / HC_J_M
    else:
        power, total = broad_spectrum(spectrum, fwhm_m)
        electrons = band.integral(
            lambda wavelength_m: power(wavelength_m) * wavelength_m / HC_J_M
        )
        electrons_per_joule = electrons / total
    return np.asarray(intensity_w_sr, dtype=float) * electrons_per_joule


def broad_spectrum(spectrum: Spectrum, fwhm_m: float | None) -> tuple[Curve, float]:
    """The power of an LED, not a line, per meter of wavelength to any scale, and its integral: a file's or `colored`.

    Features narrower than the steps of `Band.integral` are not resolved. Raises InputError for a file that is not a
    curve.
    """
    if not isinstance(spectrum, str):
        return colored(spectrum, fwhm_m or 0.0), 1.0
    path = spectrum_file(spectrum)
    measured = _read_curve(path, path.stat().st_mtime_ns, math.inf)
    return measured.response_at, float(measured.integral(np.ones_like))


def colored(peak_m: float, fwhm_m: float) -> Curve:
    """Gaussian spectrum of a colored LED, per meter of wavelength, with unit integral: sigma = FWHM / sqrt(8 ln 2)."""
    sigma_m = fwhm_m / FWHM_PER_SIGMA
    scale = 1 / (math.sqrt(2 * math.pi) * sigma_m)
    return lambda wavelength_m: (
        scale * np.exp(-0.5 * ((wavelength_m - peak_m) / sigma_m) ** 2)
    )


def lumens_per_watt(spectrum: Spectrum, fwhm_m: float | None = None) -> float:
    """Luminous efficacy of radiation in lm/W: 683 int S V dl / int S dl, with the eye's response V.

    Raises
    ------
    InputError
        For a colored LED whose peak is where V is zero, and for a measured spectrum without light there.
    """
    # The eye's response in daylight.
    photopic = _read_curve(DATA / "bands" / "photopic.csv")
    if isinstance(spectrum, str):
        power, total = broad_spectrum(spectrum, fwhm_m)
        seen = float(photopic.integral(power))
        if not seen:
            raise InputError(
                "light.led.spectrum",
                f"{spectrum} is invisible and has no candelas",
                "radiant_intensity",
            )
        return LUMINOUS_EFFICACY_LM_W * seen / total
    if not photopic.response_at(spectrum):
        allowed = "{:g} to {:g} nm".format(*(photopic.wavelength_m[[0, -1]] * 1e9))
        raise InputError(
            "light.led.spectrum",
            f"{spectrum * 1e9:g} nm is invisible and has no candelas",
            f"{allowed}, or radiant_intensity",
        )
    if fwhm_m is None:
        return float(LUMINOUS_EFFICACY_LM_W * photopic.response_at(spectrum))
    return float(LUMINOUS_EFFICACY_LM_W * photopic.integral(colored(spectrum, fwhm_m)))


def snr(
    signal_e: Reals,
    area_px: Reals,
    background_e: Reals,
    read_noise_e: Reals,
) -> Floats:
    """Signal-to-noise ratio of light summed over some pixels: the CCD equation, S / sqrt(S + n (B + R^2)).

    Parameters
    ----------
    signal_e
        Electrons S of the star in these n = area_px pixels
    background_e
        Mean electrons B per pixel of everything else (sky, dark current)
    read_noise_e
        Read noise R per pixel
    """
    signal_e = np.asarray(signal_e, dtype=float)
    # Variances of signal, background and read noise add.
    noise = np.sqrt(signal_e + area_px * (background_e + np.square(read_noise_e)))
    return signal_e / noise
