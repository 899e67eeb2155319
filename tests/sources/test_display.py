"""Fibers, panels and benches against rulers, spherical trigonometry, and the laws of rounding and of flicker."""

from __future__ import annotations

import datetime
import json
from typing import Any

import numpy as np
import pytest

from skysim.camera.glow import display_glow
from skysim.camera.glow.background import PointedCamera
from skysim.core.errors import InputError
from skysim.core.types import Frame, Sources, Truth
from skysim.scene import loader
from skysim.scene.sections import layouts
from skysim.scene.sections.light import CollimatedDisplayConfig, DomeConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab, exposure_window
from skysim.simulation.lights.emitters import LedDome
from skysim.sources import catalog, dome
from skysim.sources import stars as star_sources
from skysim.sources.dome import display, surface
from skysim.sources.dome.led import lit_moments_s
from skysim.sources.photometry import SUN, Band, led_strength_e_s_sr, star_flux_e_s_m2

FOOT_M = 0.3048
BAND = Band.from_efficiency("interline")
TIME = datetime.datetime(2012, 6, 22, 21)
LED = {"intensity": "13 ucd", "disk_diameter": "0.3 mm", "drive": {"kind": "direct"}}
FLAT = {
    "kind": "flat",
    "apex": "1.4 m",
    "offset": ["50 mm", "-20 mm", "0 m"],
    "tilt_deg": [4, -3],
}
APL = {"kind": "sphere", "apex": "4 ft", "radius": "4 ft"}
EVERYWHERE = {"kind": "random", "cap_deg": 4, "count": 2000}
PANEL = {"kind": "lcd", "pixels": [1680, 1050], "pitch": "0.258 mm", "points": EVERYWHERE}
BENCH = {
    "kind": "collimated_display",
    "pixels": [1920, 1200],
    "pitch": "8.1 um",
    "focal_length": "45 mm",
    "axis_ra_deg": 83,
    "axis_dec_deg": 2,
    "roll_deg": 20,
    "brightest_mag": 1,
}


def lit(layout: dict[str, Any], surface: dict[str, Any] = FLAT, **led: Any) -> Sources:
    part = {"kind": "dome", "surface": surface, "layout": layout, "led": LED | led}
    return dome.sources(DomeConfig.model_validate(part), BAND)


def shown(**more: Any) -> Sources:
    config = CollimatedDisplayConfig.model_validate(BENCH | more)
    return display.display_sources(config, catalog.read(config.catalog), TIME, BAND)


def own_m(place_m: np.ndarray) -> np.ndarray:
    """Places on FLAT in its own axes: center at apex plus offset, rotated about x, then about y."""
    a, b = np.radians([4, -3])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return np.asarray((place_m[:, :3] - [0.05, -0.02, 1.4]) @ (about_y @ about_x))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# Fibers


def fibers(variation: float, **points: Any) -> Sources:
    ends = {"kind": "random", "cap_deg": 88, "count": 4000, "hardware_seed": 3} | points
    return lit({"kind": "fibers", "points": ends, "radius_variation": variation}, APL)


def test_fiber_displacement_along_the_normal_is_uniform_within_its_declared_share() -> None:
    """Uniform over +-.4 % of 4 ft, which is 4.9 mm: mean and variance to four of their sigmas."""
    ideal = fibers(0.0)
    real = fibers(0.004)
    np.testing.assert_allclose(
        unit(real.place[:, :3]), unit(ideal.place[:, :3]), rtol=0, atol=1e-14
    )
    share = (np.linalg.norm(real.place[:, :3], axis=1) / (4 * FOOT_M) - 1) / 0.004
    n = len(share)
    assert np.abs(share).max() <= 1 + 1e-9
    assert abs(share.mean()) < 4 / np.sqrt(3 * n)
    # (1/5 - 1/9) of the fourth moment.
    assert share.var() == pytest.approx(1 / 3, abs=4 * np.sqrt(4 / 45 / n))
    for name in ("id", "strength", "normal", "radius_m", "start_s"):
        np.testing.assert_array_equal(getattr(real, name), getattr(ideal, name))


def test_a_camera_off_the_center_of_apl_s_dome_has_the_reference_s_error() -> None:
    """(r / R)(dR / R) at most: 34 arcsec at 50 mm, and no more than its square beside it; none in the center."""
    camera_m = np.array([0.05, 0, 0])
    ideal = fibers(0.0).place[:, :3]
    real = fibers(0.004).place[:, :3]
    apart = np.linalg.norm(np.cross(unit(real - camera_m), unit(ideal - camera_m)), axis=1)
    bound = 0.05 / (4 * FOOT_M) * 0.004
    assert np.degrees(bound) * 3600 == pytest.approx(34, abs=0.5)
    assert 0.9 * bound < apart.max() < bound * (1 + 0.05 / (4 * FOOT_M) + 0.004)


def test_fibers_show_the_stars_of_a_projected_sky() -> None:
    """Marked by a laser from the center: in its direction whatever the radius, Hipparcos' number on each."""
    stars = {"kind": "celestial", "cap_deg": 80, "count": 100, "camera": ["0 m"] * 3}
    stars |= {"zenith_ra_deg": 0, "zenith_dec_deg": 90}
    ends = lit({"kind": "fibers", "points": stars, "radius_variation": 0.004}, APL)
    known = catalog.read("hipparcos_hp6.5")
    known = known.take(np.array([np.flatnonzero(known.hip == hip)[0] for hip in ends.id]))
    seen = star_sources.apparent(known, datetime.datetime(2000, 1, 1, 12))
    # Overhead the pole, -y along the meridian of RA 0 and so x towards RA 270: x = -y_icrs, y = x_icrs.
    wanted = np.column_stack([-seen[:, 1], seen[:, 0], seen[:, 2]])
    np.testing.assert_allclose(unit(ends.place[:, :3]), wanted, rtol=0, atol=1e-12)
    assert len(ends) == 100


# The LCD panel


@pytest.mark.parametrize("block", [1, 2, 3])
def test_stars_are_centered_in_blocks_of_pixels_on_the_panel(block: int) -> None:
    """Of an even number of columns the middle is between two: odd blocks are at halves of a pitch, even at wholes."""
    wanted = lit(EVERYWHERE)
    drawn = lit(PANEL | {"block": block})
    own = own_m(drawn.place)
    np.testing.assert_allclose(own[:, 2], 0, rtol=0, atol=1e-14)
    pitches = own[:, :2] / 0.258e-3 - (block % 2) / 2
    np.testing.assert_allclose(pitches, np.rint(pitches), rtol=0, atol=1e-9)
    normal = lit(EVERYWHERE | {"count": 1}).normal[0]
    np.testing.assert_allclose(
        drawn.normal, np.tile(normal, (len(drawn), 1)), rtol=0, atol=1e-14
    )
    off_m = own[:, :2] - own_m(wanted.place)[drawn.id, :2]
    assert np.abs(off_m).max() <= 0.129e-3 * (1 + 1e-9)
    np.testing.assert_allclose(drawn.strength, block**2 * led_e_s_sr(), rtol=1e-12, atol=0)
    np.testing.assert_allclose(drawn.radius_m, block * 0.15e-3, rtol=1e-12, atol=0)


def led_e_s_sr() -> float:
    return float(led_strength_e_s_sr(13e-6, "white", BAND))


def test_rounding_to_pixels_is_a_uniform_error_over_a_pitch() -> None:
    """Variance p^2 / 12 along either axis, mean none, no correlation: to four sigmas of some 2,000 stars."""
    wanted = lit(EVERYWHERE)
    drawn = lit(PANEL)
    off = (own_m(drawn.place) - own_m(wanted.place)[drawn.id])[:, :2] / 0.258e-3
    n = len(off)
    assert n > 1990
    for one in off.T:
        assert abs(one.mean()) < 4 / np.sqrt(12 * n)
        assert one.var() == pytest.approx(1 / 12, abs=4 / np.sqrt(180 * n))
    assert abs(np.mean(off[:, 0] * off[:, 1])) < 4 / (12 * np.sqrt(n))


@pytest.mark.parametrize(("grays", "gamma"), [(4, 1.0), (256, 2.2), (2, 1.8)])
def test_levels_are_the_nearest_grays(grays: int, gamma: float) -> None:
    """Against a search through all of them in the picture's own numbers."""
    level = (np.arange(1, 400) - 0.3) / 399
    config = layouts.LcdConfig.model_validate(PANEL | {"gray_levels": grays, "gamma": gamma})
    number = np.arange(grays) / (grays - 1)
    nearest = np.abs(level[:, None] ** (1 / gamma) - number).argmin(axis=1)
    np.testing.assert_allclose(
        display.gray_transmission(config, level), number[nearest] ** gamma, rtol=1e-12, atol=0
    )
    low = display.min_level(config)
    assert (
        display.gray_transmission(config, np.array([low * 0.999]))[0]
        == 0
        < display.gray_transmission(config, np.array([low * 1.001]))[0]
    )


def test_stars_on_one_pixel_add_up_to_white() -> None:
    """The sum has the number of the brightest star."""
    points = {"kind": "listed", "cap_deg": 5, "levels": [0.25, 0.5, 0.8, 0.9]}
    points["directions_deg"] = [[0, 1], [0, 1.0001], [90, 2], [90, 2.0001]]
    drawn = lit(PANEL | {"points": points, "gray_levels": 65536, "gamma": 1})
    of = dict(zip(drawn.id.tolist(), drawn.strength / led_e_s_sr(), strict=True))
    assert of == {1: pytest.approx(0.75, rel=1e-4), 3: pytest.approx(1, rel=1e-12)}


def test_the_camera_sees_the_real_sky_on_the_panel_to_half_a_pixel() -> None:
    """The brightest of the stars that fall on the panel, and no other: a list of their own."""
    camera_m = np.array([0.02, 0, 0.4])
    points = {
        "kind": "celestial",
        "cap_deg": 40,
        "count": 25,
        "camera": ["20 mm", "0 mm", "400 mm"],
    }
    points |= {"zenith_ra_deg": 84, "zenith_dec_deg": 5, "epoch": TIME.isoformat()}
    drawn = lit(PANEL | {"points": points})
    stars = catalog.read("hipparcos_hp6.5")
    direction = star_sources.cam_from_icrs(84, 5, 0).apply(star_sources.apparent(stars, TIME))
    stars = stars.take(direction[:, 2] > 0)
    direction = direction[direction[:, 2] > 0]
    normal = drawn.normal[0]
    along = ((np.array([0.05, -0.02, 1.4]) - camera_m) @ normal) / (direction @ normal)
    where = own_m(camera_m + along[:, None] * direction)[:, :2]
    on_panel = np.all(np.abs(where) <= np.array([1680, 1050]) * 0.129e-3, axis=1) & (
        along > 0
    )
    on_panel &= direction[:, 2] > np.cos(np.radians(60))
    brightest = np.flatnonzero(on_panel)[np.argsort(stars.v_mag[on_panel])[:25]]
    assert set(drawn.id) == set(stars.hip[brightest])
    which = [np.flatnonzero(stars.hip == hip)[0] for hip in drawn.id]
    assert np.abs(own_m(drawn.place)[:, :2] - where[which]).max() <= 0.129e-3 * (1 + 1e-9)


def test_pixels_scatter_less_in_a_block() -> None:
    """The mean of n^2 pixels: the logarithm's sigma is led.scatter / n, to four of its own."""
    for block in (1, 4):
        drawn = lit(PANEL | {"block": block}, scatter=0.08)
        log = np.log(drawn.strength / led_e_s_sr() / block**2)
        assert log.std() == pytest.approx(0.08 / block, rel=4 / np.sqrt(2 * len(log)))


# Refresh


def refreshed(duty: float, **more: Any) -> Sources:
    return lit(PANEL | more, drive={"kind": "refresh", "rate_hz": 60, "duty": duty})


def test_pixels_of_a_row_light_up_together_and_rows_one_after_another() -> None:
    """A 1,050th of a frame from a row to the next, downwards; another panel has another phase."""
    drawn = refreshed(0.2)
    row = np.rint(own_m(drawn.place)[:, 1] / 0.258e-3 + 524.5)
    np.testing.assert_allclose(drawn.on_s, 0.2 / 60, rtol=1e-12, atol=0)
    np.testing.assert_allclose(drawn.period_s, 1 / 60, rtol=1e-12, atol=0)
    first = drawn.start_s - row / 1050 / 60
    np.testing.assert_allclose(first, first[0], rtol=0, atol=1e-15)
    other = refreshed(0.2, points=EVERYWHERE | {"hardware_seed": 1})
    assert abs(other.start_s.min() - drawn.start_s.min()) > 1e-4


@pytest.mark.parametrize("duty", [0.002, 0.1, 0.3])
@pytest.mark.parametrize(
    ("frames", "part"), [(0, 0.5), (1, 0.4), (2, 0.6), (7, 0.35), (20, 0.65)]
)
def test_a_panel_s_flicker_matches_the_reference(
    duty: float, frames: int, part: float
) -> None:
    """Reference 1.3: sqrt(f (1 - f) - w / 3) / (n + f) for pulses of a share w <= f <= 1 - w, over all beginnings."""
    got = light_s(refreshed(duty), (frames + part) / 60)
    law = np.sqrt(part * (1 - part) - duty / 3) / (frames + part)
    assert got.mean() == pytest.approx(duty * (frames + part) / 60, rel=1e-3)
    assert got.std() / got.mean() == pytest.approx(law, rel=2e-3)


def test_a_panel_does_not_flicker_in_whole_frames_nor_when_always_lit() -> None:
    assert np.ptp(light_s(refreshed(0.3), 3 / 60)) < 1e-12
    np.testing.assert_allclose(
        light_s(refreshed(1.0), 2.4 / 60), 2.4 / 60, rtol=1e-12, atol=0
    )


def still_frame(lab: Lab) -> tuple[Frame, Truth]:
    """The first frame of a vehicle that stays at its start."""
    return render_at_rest(lab.camera, lab.start)


def light_s(drawn: Sources, exposure_s: float) -> np.ndarray:
    """A pixel's light in exposures with start times uniform over a frame."""
    begins = (np.arange(4000) + 0.5) / 4000 / 60
    pulses = drawn.period_s[5], drawn.start_s[5], drawn.on_s[5]
    return np.array(
        [lit_moments_s(begin, begin + exposure_s, *pulses)[0] for begin in begins]
    )


def test_rows_that_are_not_lit_within_the_exposure_are_dark() -> None:
    """NPS's stars lit for a quarter of a frame, in an exposure of a quarter: by each row's own turn, or not at all."""
    changes = {
        "light.led.drive.duty": "0.25",
        "exposure.time": f"{1000 / 240} ms",
        "light.led.scatter": "0",
    }
    dark_lab = build_lab(loader.load("nps_tas2", changes))
    dark = dark_lab.camera
    steady = build_lab(
        loader.load("nps_tas2", changes | {"light.led.drive": "{kind: direct}"})
    )
    window = exposure_window(dark.scene, 0)
    assert isinstance(dark.known, LedDome)
    clocks = dark.known.timing(dark.run_seed).clocks
    assert clocks is not None
    trains = clocks.pulses_at(dark.sources, window.middle_s)
    looks = window.open_s + (np.arange(20_000) + 0.5) / 20_000 * window.exposure_s
    (_, flickering), (_, full) = still_frame(dark_lab), still_frame(steady)
    all_e = dict(zip(full.sources.id.tolist(), full.sources.electrons, strict=True))
    got = dict.fromkeys(all_e, 0.0) | dict(
        zip(flickering.sources.id.tolist(), flickering.sources.electrons, strict=True)
    )
    for n, number in enumerate(dark.sources.id.tolist()):
        phase = (looks - trains.start_s[n]) / trains.period_s[n] % 1
        assert got[number] / all_e[number] == pytest.approx(np.mean(phase < 0.25), abs=1e-3)
    assert len(all_e) == 9
    assert min(got.values()) < 0.5 * max(got.values())


# The bench


def test_a_bench_shows_stars_on_pixels_at_their_sky_positions() -> None:
    """Gnomonic about the axis by spherical trigonometry, lab -y at position angle roll; rounded to a pixel."""
    made = shown()
    stars = catalog.read("gaia_v8.0")
    stars = stars.take(np.array([np.flatnonzero(stars.hip == hip)[0] for hip in made.id]))
    x, y, z = star_sources.apparent(stars, TIME).T
    ra = np.arctan2(y, x) - np.radians(83)
    dec = np.arcsin(z)
    axis = np.radians(2)
    roll = np.radians(20)
    below = np.sin(axis) * np.sin(dec) + np.cos(axis) * np.cos(dec) * np.cos(ra)
    east = np.cos(dec) * np.sin(ra) / below
    north = (np.cos(axis) * np.sin(dec) - np.sin(axis) * np.cos(dec) * np.cos(ra)) / below
    up = north * np.cos(roll) + east * np.sin(roll)
    left = east * np.cos(roll) - north * np.sin(roll)
    tangent = made.place[:, :2] / made.place[:, 2:3]
    pixels = tangent * 45e-3 / 8.1e-6 - 0.5
    np.testing.assert_allclose(pixels, np.rint(pixels), rtol=0, atol=1e-9)
    off = (tangent - np.column_stack([-left, -up])) * 45e-3 / 8.1e-6
    assert np.abs(off).max() <= 0.5 + 1e-9
    assert off.var() == pytest.approx(1 / 12, abs=4 / np.sqrt(180 * off.size))
    assert len(made) > 80
    assert np.all(made.place[:, 3] == 0)


def test_a_bench_s_field_ends_with_its_display() -> None:
    """All the stars within it to the limit, none beyond: counted through a wider one."""
    wide = shown(pixels=[3000, 3000], limit_mag=6.0)
    narrow = shown(limit_mag=6.0)
    tangent = np.abs(wide.place[:, :2] / wide.place[:, 2:3]) * 45e-3 / 8.1e-6
    within = np.all(tangent < [960, 600], axis=1)
    assert set(wide.id[within]) == set(narrow.id)
    assert len(narrow) < len(wide)


def test_a_bench_s_stars_follow_pogson_to_half_a_gray() -> None:
    """Strength of a G2 star of that V; brighter than white is white; a gray's step is gamma / g of its light."""
    made = shown(brightest_mag=2)
    white = float(star_flux_e_s_m2(2.0, *SUN, BAND))
    level = np.minimum(10 ** (-0.4 * (made.magnitude - 2)), 1)
    assert 3 <= np.sum(made.magnitude < 2) < len(made) / 2
    got = made.strength / white
    grays = 255 * level ** (1 / 2.2)
    alone = np.abs(255 * got ** (1 / 2.2) - grays) <= 0.5 + 1e-9
    assert np.mean(alone) > 0.95  # the rest share a pixel with another
    np.testing.assert_allclose(got[made.magnitude < 2], 1, rtol=1e-12, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("conjugate_m", [None, 20.0, 500.0])
def test_a_camera_on_a_lever_sees_only_the_collimation_s_parallax(
    conjugate_m: float | None,
) -> None:
    """Stars at D are seen along D d - r, in the light of 1 / |D d - r|^2; r is SimSat's camera, tilted."""
    settings = {} if conjugate_m is None else {"light.conjugate": f"{conjugate_m} m"}
    lab = build_lab(
        loader.load(
            "collimated_display",
            settings
            | {
                "vehicle.model": "vehicles/simsat.xml",
                "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
                "motion.start.roll_deg": "6",
            },
        )
    )
    central = build_lab(loader.load("collimated_display", {"motion.start.roll_deg": "6"}))
    _, moved = still_frame(lab)
    _, still = still_frame(central)
    both, ours, theirs = np.intersect1d(
        moved.sources.id, still.sources.id, return_indices=True
    )
    camera_m = moved.lab_from_body.apply(lab.camera.mount.camera_body_m)
    sources = central.camera.sources
    direction = sources.place[[np.flatnonzero(sources.id == n)[0] for n in both], :3]
    ray = direction if conjugate_m is None else conjugate_m * direction - camera_m
    xyz = moved.cam_from_lab.apply(ray)
    camera = lab.scene.camera
    wanted = np.array(camera.center_px) + camera.focal_px * xyz[:, :2] / xyz[:, 2:]
    np.testing.assert_allclose(moved.sources.xy_px[ours], wanted, rtol=0, atol=1e-6)
    shift_px = np.abs(moved.sources.xy_px[ours] - still.sources.xy_px[theirs]).max()
    lever_px = 0.0 if conjugate_m is None else 0.381 / conjugate_m * camera.focal_px
    assert shift_px <= lever_px + 1e-6
    assert (shift_px > lever_px * 0.05) == (conjugate_m is not None)
    inside = still.sources.electrons[theirs] > 300
    np.testing.assert_allclose(
        moved.sources.electrons[ours][inside],
        still.sources.electrons[theirs][inside],
        rtol=1e-3 if conjugate_m is None else 3 * 0.381 / conjugate_m + 1e-3,
        atol=0,
    )


# Black that glows


def glow_e_s(lab: Lab) -> np.ndarray:
    camera = lab.camera
    camera_m = lab.start.apply(camera.mount.camera_body_m)
    cam_from_lab = camera.mount.cam_from_body * lab.start.inv()
    glow = display_glow.black_glow(
        lab.scene.light, PointedCamera(camera.optics, cam_from_lab, camera_m, camera.band)
    )
    assert glow is not None
    return glow


@pytest.mark.slow
def test_a_black_panel_has_the_light_of_all_pixels_over_the_contrast() -> None:
    """20 x 15 pixels drawn white one by one, off the axis and seen aslant: their light on the frame over the contrast.

    The chip has some 170 x 130 pixels of it: an edge to half a pixel at each end is under a per cent.
    """
    x, y = np.meshgrid((np.arange(20) - 9.5) * 0.01, (np.arange(15) - 7) * 0.01)
    places = [
        [f"{0.15 + a} m", f"{b} m", "1.4 m"]
        for a, b in zip(x.ravel(), y.ravel(), strict=True)
    ]
    points = {"kind": "listed", "cap_deg": 30, "positions": places}
    layout = {"kind": "lcd", "pixels": [20, 15], "pitch": "1 cm", "points": points}
    changes = {
        "light.surface": "{kind: flat, apex: 1.4 m, offset: [150 mm, 0 m, 0 m], tilt_deg: [0, 0]}",
        "light.layout": json.dumps(layout),
        "light.led.drive": "{kind: refresh, rate_hz: 60, duty: 0.5}",
        "light.led.scatter": "0",
        "exposure.time": "100 ms",
        "motion.start": "{roll_deg: 4, pitch_deg: -3, yaw_deg: 10}",
    }
    white = build_lab(loader.load("nps_tas2", changes))
    seen = still_frame(white)[1].sources
    assert len(seen.id) == 300
    gray = build_lab(loader.load("nps_tas2", changes | {"light.layout.contrast": "500"}))
    glow = glow_e_s(gray)
    assert glow.sum() == pytest.approx(seen.electrons.sum() / 0.1 / 500, rel=0.01)
    assert 0.05 < np.mean(glow > 0) < 0.2
    # And white is as bright as without: black and what is above it.
    np.testing.assert_allclose(
        gray.camera.sources.strength,
        white.camera.sources.strength * (1 - 1 / 500),
        rtol=1e-12,
        atol=0,
    )


def test_a_black_bench_has_the_light_of_the_display_pixels_within_each_chip_pixel() -> None:
    """A pixel of the chip holds (81.7 / 37.1)^2 of the display's, each 1 / contrast of a white star; none beside it."""
    changes = {
        "light.contrast": "400",
        "motion.start": "{roll_deg: 0, pitch_deg: 0, yaw_deg: 0}",
    }
    lab = build_lab(loader.load("collimated_display", changes))
    glow = glow_e_s(lab)
    camera = lab.scene.camera
    white_e_s = (
        float(star_flux_e_s_m2(0.0, *SUN, lab.camera.band)) * lab.camera.optics.collecting_m2
    )
    pixels = (45e-3 / 8.1e-6 / camera.focal_px) ** 2
    assert glow[246, 329] == pytest.approx(white_e_s * pixels / 400, rel=1e-3)
    rows = np.flatnonzero(glow[:, 329] > 0)
    assert len(rows) == 493  # 11.1 of 12.3 deg
    tilted = changes | {"motion.start": "{roll_deg: 4, pitch_deg: 0, yaw_deg: 0}"}
    seen = np.sum(glow_e_s(build_lab(loader.load("collimated_display", tilted)))[:, 329] > 0)
    half_deg = np.degrees(np.arctan(600 * 8.1e-6 / 45e-3))
    wanted = 246.5 + camera.focal_px * np.tan(np.radians(half_deg - 4))
    assert seen == pytest.approx(wanted, abs=1)


@pytest.mark.slow
def test_the_glow_is_on_the_frame_only_with_a_finite_contrast() -> None:
    """A noise-free frame with it less one without is the glow by the exposure, but for what is taken off the stars."""
    silent = {"camera.detector.noise": "false"}
    plain = build_lab(loader.load("collimated_display", silent))
    glowing = build_lab(loader.load("collimated_display", silent | {"light.contrast": "200"}))
    more = still_frame(glowing)[0].image_dn - still_frame(plain)[0].image_dn
    gain = plain.scene.camera.detector.gain_e_dn
    time_s = plain.scene.exposure.time_s
    wanted = np.median(glow_e_s(glowing)) * time_s / gain
    assert np.median(more) == pytest.approx(wanted, rel=0.01)
    assert (
        display_glow.black_glow(
            plain.scene.light,
            PointedCamera(
                plain.camera.optics, star_sources.cam_from_icrs(0, 90, 0), np.zeros(3), BAND
            ),
        )
        is None
    )


# Faulty keys


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (
            {"light.surface": "{kind: sphere, apex: 1.4 m, radius: 1.4 m}"},
            "lcd does not fit a surface of kind sphere",
        ),
        (
            {"light.led.drive": "{kind: pwm}"},
            "light.led.drive: pwm cannot drive an lcd; allowed: direct",
        ),
        ({"light.led.drive.duty": "0"}, "light.led.drive.duty: 0 is not allowed"),
        (
            {"light.layout.block": "2000"},
            "light.layout.block: 2000 is wider than the display; allowed: up to 1050 pixels",
        ),
        ({"light.layout.gray_levels": "1"}, "light.layout.gray_levels: 1 is not allowed"),
        (
            {"light.layout.points.kind": "patch_boards"},
            "points.kind: unknown kind 'patch_boards'; allowed:",
        ),
        (
            {"light.layout.points.cap_deg": "0"},
            "light.layout.points.cap_deg: 0 is not allowed",
        ),
        (
            {"light.surface.width": "0.4 m"},
            "light.layout.pixels: need 0.4334 m by 0.2709 m; allowed: the surface",
        ),
        ({"light.layout.pitch": "0.1 mm"}, "light.layout: exceeds the surface"),
        (
            {
                "light.layout.points.levels": "[1, 1, 1, 1, 1, 1, 1, 1, 0.01]",
                "light.layout.gray_levels": "4",
            },
            "a star of level 0.01 is black on 4 gray levels; allowed: 0.019 or more",
        ),
    ],
)
def test_a_wrong_panel_is_refused_in_one_line(overrides: dict[str, str], says: str) -> None:
    assert_refused("nps_tas2", overrides, says)


@pytest.mark.parametrize(
    ("name", "overrides", "says"),
    [
        (
            "apl_dome",
            {"light.led.drive": "{kind: refresh, rate_hz: 60}"},
            "refresh requires a layout of kind lcd",
        ),
        (
            "apl_dome",
            {"light.layout.radius_variation": "4"},
            "light.layout.radius_variation: 4 is not allowed",
        ),
        (
            "collimated_display",
            {"light.limit_mag": "-2"},
            "light.limit_mag: no star of the catalog is on the display",
        ),
        (
            "collimated_display",
            {"light.gray_levels": "8"},
            "are black on 8 gray levels; allowed: to 6.3",
        ),
        (
            "collimated_display",
            {"light.catalog": "gaia"},
            "light.catalog: unknown catalog 'gaia'; allowed:",
        ),
        (
            "collimated_display",
            {"light.conjugate": "1 m"},
            "light.conjugate: '1 m' is not allowed",
        ),
        (
            "collimated_display",
            {"motion.start": "{ra_deg: 0, dec_deg: 0, roll_deg: 0}"},
            "motion.start: light of kind",
        ),
    ],
)
def test_a_wrong_display_is_refused_in_one_line(
    name: str, overrides: dict[str, str], says: str
) -> None:
    assert_refused(name, overrides, says)


def assert_refused(name: str, overrides: dict[str, str], says: str) -> None:
    with pytest.raises(InputError) as caught:
        build_lab(loader.load(name, overrides))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("width_m", "fits"), [(0.5, True), (0.2, True), (0.2 - 1e-6, False)])
def test_the_surface_ends_with_its_pixels_which_must_fit(width_m: float, fits: bool) -> None:
    config = layouts.LcdConfig.model_validate(PANEL | {"pixels": [20, 15], "pitch": "1 cm"})
    plane = surface.Plane(np.zeros(3), half_m=np.array([width_m / 2, 1.0]))
    if fits:
        np.testing.assert_allclose(
            display.panel_surface(config, plane).half_m, [0.1, 0.075], rtol=1e-15
        )
        return
    with pytest.raises(
        InputError, match=r"light.layout.pixels: need 0.2 m by 0.15 m; allowed"
    ):
        display.panel_surface(config, plane)
