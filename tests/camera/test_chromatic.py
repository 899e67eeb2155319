"""Chromatic aberration: images of polychromatic light against rays of each wavelength."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import fixed_quad
from scipy.spatial.transform import Rotation

from skysim.camera.discs import points_of
from skysim.camera.optics import Optics
from skysim.camera.projection import Poses, project
from skysim.camera.render import Window, render
from skysim.core.errors import InputError
from skysim.core.types import Floats, Mount, Sources, Trajectory
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.exposure import expected_exposure
from skysim.simulation.lab import build_lab
from skysim.simulation.lights.light import beam_of
from skysim.sources.photometry import (
    Band,
    black_body_v0,
    broad_spectrum,
    colored,
    led_chromatic,
    star_chromatic,
    temperature_k,
)
from skysim.sources.satellites import as_sources, moving_light

# B-V and V-I
A0 = (0.0, 0.004)
M1 = (1.485, 2.005)
WAVELENGTH_NM = [450, 550, 700, 900]
FOCUS_UM = [120, 0, 40, 250]
CORNER_PX = [-1.4, 0, 0.8, 1.5]
CHROMATIC = {
    "wavelength": [f"{one} nm" for one in WAVELENGTH_NM],
    "focus": [f"{one} um" for one in FOCUS_UM],
    "corner_px": CORNER_PX,
}
CAMERA = {
    "width_px": 64,
    "height_px": 48,
    "pixel": "10 um",
    "focal_length": "25 mm",
    "f_number": 4,
    "psf": {"kind": "gaussian", "sigma_px": 0.7},
    "chromatic": CHROMATIC,
    "detector": {
        "quantum_efficiency": "cmos",
        "full_well_e": 4e4,
        "gain_e_dn": 10,
        "bits": 12,
    },
}


def camera(**changes: Any) -> CameraConfig:
    return CameraConfig.model_validate(CAMERA | changes)


def planck(color: tuple[float, float]) -> Callable[[Floats], Floats]:
    return lambda wavelength_m: black_body_v0(wavelength_m, temperature_k(*color))


def photons(power: Callable[[Floats], Floats]) -> Callable[[Floats], Floats]:
    return lambda wavelength_m: power(wavelength_m) * wavelength_m


WHITE = photons(broad_spectrum("white", None)[0])
BLUE = photons(colored(470e-9, 25e-9))
CASES = {
    "a blue star": (lambda band: star_chromatic(*A0, band), planck(A0), None),
    "a red star": (lambda band: star_chromatic(*M1, band), planck(M1), None),
    "a white LED": (lambda band: led_chromatic("white", band), WHITE, 0.8),
    "a blue LED": (lambda band: led_chromatic(470e-9, band, 25e-9), BLUE, 0.8),
    "a line": (lambda band: led_chromatic(630e-9, band), photons(colored(630e-9, 2e-9)), 0.8),
}


@pytest.mark.parametrize("case", CASES)
def test_mean_and_spread_of_a_light(case: str) -> None:
    """Over its photo-electrons, by Gauss's quadrature of pieces without a kink."""
    band = Band.from_camera(camera())
    moments, spectrum, _ = CASES[case]
    knots = sorted({380, 400, 900, 1000, 1100, *range(405, 1000, 5), *WAVELENGTH_NM})

    def integral(weight: Callable[[Floats], Floats]) -> float:
        def shape(nm: Floats) -> Floats:
            return spectrum(nm * 1e-9).ravel() * band.response_at(nm * 1e-9) * weight(nm)

        return sum(fixed_quad(shape, *ends, n=8)[0] for ends in itertools.pairwise(knots))

    total = integral(np.ones_like)
    wanted = list[float]()
    moments_px = dict[int, float]()
    for column in (1e-6 * np.array(FOCUS_UM), CORNER_PX):
        mean = integral(lambda nm, of=column: np.interp(nm, WAVELENGTH_NM, of)) / total
        square = integral(
            lambda nm, of=column, mean=mean: (np.interp(nm, WAVELENGTH_NM, of) - mean) ** 2
        )
        wanted += [mean, (square / total) ** 0.5]
        for power in (3, 4, 5, 6, 7):
            moments_px[power] = (
                integral(
                    lambda nm, of=column, mean=mean, power=power: (
                        (np.interp(nm, WAVELENGTH_NM, of) - mean) ** power
                    )
                )
                / total
            )
    made = np.array(moments(band)).ravel()
    nodes_px, shares = made[4:8], made[8:]
    if case == "a line":  # a narrow one has no width, that of the quadrature 2 nm
        np.testing.assert_allclose(made[:2], wanted[::2], rtol=2e-3)
        assert made[2:4].tolist() == [0, 0]
        assert (nodes_px @ shares, shares.sum()) == (0, 1)
        return
    np.testing.assert_allclose(made[:4], wanted[::2] + wanted[1::2], rtol=2e-3)
    # The quadrature of the lateral shifts: its moments up to the seventh are the light's.
    found = [shares.sum(), shares @ nodes_px, np.sqrt(shares @ nodes_px**2)]
    np.testing.assert_allclose(found, [1, 0, wanted[3]], rtol=2e-3, atol=1e-4)
    for power, moment in moments_px.items():
        scale = made[3] ** power
        assert shares @ nodes_px**power == pytest.approx(moment, rel=0.01, abs=0.01 * scale)


@pytest.mark.parametrize("case", CASES)
def test_chromatic_images_match_the_integral_over_wavelength(case: str) -> None:
    """Mean position and mean square radius of rays of every wavelength from every part of the pupil.

    The LEDs are also defocused by their distance, which some wavelengths compensate.
    """
    moments, spectrum, distance_m = CASES[case]
    config = camera(focus="0.7 m") if distance_m else camera()
    band = Band.from_camera(config)
    lens = Optics.from_camera(config)
    along = (np.array([50.0, 34.0]) - config.center_px) / config.focal_px
    place = np.append(along, 1.0)
    place = (
        np.append(place * distance_m, 1.0)
        if distance_m
        else np.append(place / np.linalg.norm(place), 0.0)
    )
    image = np.zeros((48, 64))
    render(
        image,
        light(place, np.reshape(moments(band), (1, -1))),
        lens,
        STILL,
        AT_CENTER,
        Window(0.0, 0.1),
    )
    x, y = np.meshgrid(np.arange(64.0), np.arange(48.0))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    mean, square = weighted_moments(pixels, image.ravel())
    points, weights = chip_points(config, band, spectrum, along, distance_m)
    ray_mean, ray_square = weighted_moments(points, weights)
    np.testing.assert_allclose(mean, ray_mean, rtol=0, atol=2e-3)
    assert square == pytest.approx(ray_square + 2 * (0.7**2 + 1 / 12), rel=0.01)
    assert square > 1.02 * 2 * (0.7**2 + 1 / 12)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["a blue star", "a red star", "a white LED", "a blue LED"])
@pytest.mark.parametrize("psf", ["gaussian", "coma"])
def test_lateral_color_spreads_an_image_as_its_wavelengths_do(case: str, psf: str) -> None:
    """Each pixel, and the centroid within an aperture, against one image for every nanometer."""
    moments, spectrum, _ = CASES[case]
    lateral = {key: CHROMATIC[key] for key in ("wavelength", "corner_px")}
    shape = {"kind": "gaussian", "sigma_px": 0.7} | (
        {"coma_px": 1.5} if psf == "coma" else {}
    )
    config = camera(chromatic=lateral, psf=shape, width_px=640, height_px=480)
    lens = Optics.from_camera(config)
    band = Band.from_camera(config)
    place_px = np.array([530.0, 360.0])
    toward = np.append((place_px - config.center_px) / config.focal_px, 1.0)
    place = np.append(toward / np.linalg.norm(toward), 0.0)

    def drawn(chromatic: Any) -> Floats:
        image = np.zeros((480, 640))
        render(
            image,
            light(place, np.atleast_2d(chromatic)),
            lens,
            STILL,
            AT_CENTER,
            Window(0.0, 0.1),
        )
        return image[348:373, 518:543] / image.sum()

    image = drawn(moments(band))
    nm = np.arange(380.5, 1100)
    share = spectrum(nm * 1e-9).ravel() * band.response_at(nm * 1e-9)
    corner_px = np.interp(nm, WAVELENGTH_NM, CORNER_PX)
    wanted = (
        sum(
            share[corner_px == one].sum() * drawn([0, one, *np.eye(10)[6]])
            for one in np.unique(corner_px[share > 0])
        )
        / share.sum()
    )
    np.testing.assert_allclose(image, wanted, rtol=0, atol=1e-3 * wanted.max())
    y, x = np.mgrid[-12:13, -12:13]
    along = (x * toward[0] + y * toward[1]) / np.hypot(*toward[:2])

    def centroid_px(one: Floats, radius_px: float) -> float:
        inside = np.hypot(x, y) < radius_px
        return float((one * along)[inside].sum() / one[inside].sum())

    for radius_px in (1.5, 2.5, 10.0):
        assert centroid_px(image, radius_px) == pytest.approx(
            centroid_px(wanted, radius_px), abs=2e-4
        )
    # A symmetric image of this width has its peak at its center of light.
    center_px = centroid_px(image, 10.0)
    third = (image * (along - center_px) ** 3).sum() / image.sum()
    if psf == "gaussian":
        mean_px = share @ corner_px / share.sum()
        scale = np.hypot(*(place_px - config.center_px)) / config.corner_px
        skew = share @ ((corner_px - mean_px) * scale) ** 3 / share.sum()
        assert third == pytest.approx(skew, rel=0.02, abs=3e-4)


def chip_points(
    config: CameraConfig,
    band: Band,
    spectrum: Callable[[Floats], Floats],
    along: Floats,
    distance_m: float | None,
) -> tuple[Floats, Floats]:
    """Pixels that rays of many wavelengths meet, from rings of the pupil, and their shares of the light."""
    wavelength_nm = np.arange(380.0, 1100.0)
    share = spectrum(wavelength_nm * 1e-9).ravel() * band.response_at(wavelength_nm * 1e-9)
    focal_m = config.focal_length_m + 1e-6 * np.interp(wavelength_nm, WAVELENGTH_NM, FOCUS_UM)
    image_m = 1 / (1 / focal_m - (1 / distance_m if distance_m else 0.0))
    ring = np.sqrt((np.arange(12) + 0.5) / 12)
    angle = 2 * np.pi * np.arange(8) / 8
    pupil_m = (
        config.pupil_m
        / 2
        * np.stack([np.outer(ring, np.cos(angle)), np.outer(ring, np.sin(angle))], axis=-1)
    )
    height_px = config.focal_px * along
    lateral = 1 + np.interp(wavelength_nm, WAVELENGTH_NM, CORNER_PX) / config.corner_px
    # A ray from p on the pupil to the image at v meets the chip at v0 in p (1 - v0 / v) and the chief ray's height.
    defocus_px = (
        (1 - config.image_distance_m / image_m)[:, None, None]
        * pupil_m.reshape(1, -1, 2)
        / config.pixel_m
    )
    points = config.center_px + lateral[:, None, None] * height_px + defocus_px
    return points.reshape(-1, 2), np.repeat(share, points.shape[1])


def weighted_moments(points: Floats, weights: Floats) -> tuple[Floats, float]:
    """Mean and mean square distance from it."""
    mean = weights @ points / weights.sum()
    return mean, float(weights @ ((points - mean) ** 2).sum(axis=1) / weights.sum())


def light(place: Floats, chromatic: Floats) -> Sources:
    one = np.ones(1)
    zero = np.zeros(1)
    normal = -place[None, :3] / np.linalg.norm(place[:3]) * place[3]
    rows = np.zeros(1, np.int64)
    return Sources(
        rows, place[None], normal, zero, 1e9 * one, one, zero, one, rows, one, None, chromatic
    )


STILL = Trajectory.at_rest(Rotation.identity(), 1.0)
AT_CENTER = Mount(np.zeros(3), Rotation.identity())

LENS = "{wavelength: [400 nm, 900 nm], focus: [0 um, 40 um], corner_px: [0, 1]}"
CELESTIAL = "{kind: celestial, cap_deg: 10, count: 20, camera: [0 m, 0 m, 0 m], zenith_ra_deg: 0, zenith_dec_deg: 90}"


@pytest.mark.parametrize(
    ("scene", "keys"),
    [
        ("shefex2", {}),
        ("afit_simsat", {}),
        (
            "afit_simsat",
            {
                "light.led.spectrum": "630 nm",
                "light.led.fwhm": "18 nm",
                "light.led.color_scatter": "3 nm",
            },
        ),
        ("nps_tas2", {}),
        ("collimated_display", {}),
    ],
)
def test_every_light_of_a_scene_has_its_color(scene: str, keys: dict[str, str]) -> None:
    """The image is at the place for its mean wavelength."""
    lab = build_lab(loader.load(scene, keys | {"camera.chromatic": LENS}))
    sources = lab.camera.sources
    config = lab.scene.camera
    assert sources.chromatic is not None
    assert sources.chromatic.shape == (len(sources), 12)
    assert np.all((sources.chromatic[:, :2] > 0) & (sources.chromatic[:, :2] < [40e-6, 1]))
    spread = np.ptp(sources.chromatic[:, 1])
    assert (spread > 0.01) == (scene == "shefex2" or "light.led.color_scatter" in keys)
    toward = Rotation.align_vectors([[0, 0, 1]], sources.place[:1, :3])[0]
    pose = Poses(
        (Rotation.from_euler("x", 2, degrees=True) * toward).as_matrix()[None],
        np.zeros((1, 3)),
    )
    first = sources.take(np.arange(1))
    gray = Sources(*(getattr(first, name) for name in Sources.__slots__[:-1]))
    seen, nominal = (
        project(one, lab.camera.optics, pose)[0][0, 0] - config.center_px
        for one in (first, gray)
    )
    np.testing.assert_allclose(
        seen, nominal * (1 + first.chromatic[0, 1] / config.corner_px), rtol=1e-9, atol=1e-9
    )


def test_bodies_and_satellites_have_their_colors() -> None:
    """Mars is redder than the Sun and Uranus bluer; a satellite is as the Sun."""
    lens = {"camera.chromatic": LENS, "light.bodies": "{}"}
    lab = build_lab(loader.load("shefex2", lens))
    bodies = beam_of(
        lab.camera.lights, expected_exposure(lab.camera, lab.start, np.zeros(3), 0.0)
    ).discs
    lights = {body.name: points_of(body, np.zeros((2, 2))).chromatic for body in bodies}
    assert lights["mars"][1, 1] > lights["sun"][1, 1] + 0.02
    assert lights["uranus"][1, 1] < lights["sun"][1, 1] - 0.02
    path = np.array([0.0, 0, 1]), np.zeros((2, 3))
    satellite = as_sources(
        [moving_light(1, "one", 3.0, path, (500.0, 90.0, 1.0))], lab.camera.band
    )
    np.testing.assert_allclose(satellite.chromatic, lights["sun"][:1], rtol=1e-12)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            "{wavelength: [400 nm, 900 nm]}",
            "nothing depends on the wavelength; allowed: focus or corner_px other than",
        ),
        (
            "{wavelength: [400 nm, 900 nm], corner_px: [0, 0]}",
            "nothing depends on the wavelength",
        ),
        (
            "{wavelength: [400 nm, 900 nm], corner_px: [0, 1, 2]}",
            "wavelength has 2 numbers, corner_px has 3",
        ),
        (
            "{wavelength: [900 nm, 400 nm], corner_px: [0, 1]}",
            "wavelength is not strictly ascending",
        ),
    ],
)
def test_an_invalid_aberration_is_refused(value: str, message: str) -> None:
    with pytest.raises(InputError, match=rf"^camera\.chromatic: {message}"):
        loader.load("shefex2", {"camera.chromatic": value})
