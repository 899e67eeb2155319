"""Drift with the temperature: expansion of the dome, rotation of the camera, focal length; exactly by their laws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from skysim.camera.as_built import (
    camera_at,
    leds_at,
    mount_at,
    off_center,
    temperature_c,
)
from skysim.camera.optics import Optics
from skysim.camera.projection import beside_edges
from skysim.camera.psf.kernel import build_kernel
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Mount, Sources
from skysim.results.run import simulate
from skysim.scene import loader
from skysim.scene.sections.surroundings import ThermalConfig
from skysim.scene.sections.vehicle import VehicleConfig
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.expected_error import AS_BUILT, pixel_response
from skysim.simulation.checks.plan_check import plan_of
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.flight import simulate_motion
from skysim.simulation.lab import build_lab
from tests.helpers.splatting import add_kernel

MOUNT = {"mount_arcsec_k": [3.0, -2.0, 1.0]}
LINEAR = {"kind": "linear", "start_c": 20.0, "rate_c_h": 2.0}


def config(temperature: dict[str, Any], **rest: Any) -> ThermalConfig:
    return ThermalConfig.model_validate({"temperature": temperature} | (rest or MOUNT))


@pytest.mark.parametrize(
    ("history", "expected_c"),
    [
        ({"kind": "steady", "temperature_c": 23.0}, 23.0),
        (LINEAR, 23.0),
        (
            {
                "kind": "sine",
                "mean_c": 20.0,
                "amplitude_c": 4.0,
                "period": "9 h",
                "phase_deg": 30.0,
            },
            24.0,
        ),
        (
            {"kind": "table", "hours": [0.0, 1.0, 2.0], "temperature_c": [20.0, 22.0, 26.0]},
            24.0,
        ),
    ],
    ids=lambda value: value["kind"] if isinstance(value, dict) else "",
)
def test_temperature_after_an_hour_and_a_half(
    history: dict[str, Any], expected_c: float
) -> None:
    """The same holds after half an hour for a history three times as fast."""
    assert temperature_c(config(history), 5400.0) == pytest.approx(expected_c, abs=1e-12)
    assert temperature_c(config(history, speed=3.0, **MOUNT), 1800.0) == pytest.approx(
        expected_c, abs=1e-12
    )


def test_table_is_constant_beyond_its_ends() -> None:
    settings = config({"kind": "table", "hours": [1.0, 2.0], "temperature_c": [20.0, 22.0]})
    assert [temperature_c(settings, t_s) for t_s in (0.0, 9000.0)] == [20.0, 22.0]


MOUNTED = Mount(np.array([0.0, 0.0, 0.4]), Rotation.from_euler("x", 0.3))


def leds_and_stars() -> Sources:
    """Two LEDs and a star."""
    ones = np.ones(3)
    place = np.array([[0.3, -0.2, 1.1, 1.0], [0.0, 0.0, 1.2, 1.0], [0.0, 0.0, 1.0, 0.0]])
    rows = np.arange(3)
    return Sources(
        rows, place, np.tile([0.0, 0, -1], (3, 1)), ones, ones, ones, ones, ones, rows, ones
    )


def test_dome_expands_from_its_anchor() -> None:
    """By alpha dT of the distance from it, and creeps; stars stay where they are."""
    settings = config(
        LINEAR, dome_ppm_k=70.0, anchor_height="0.9 m", creep=["0 m", "0 m", "-1 mm"]
    )
    before = leds_and_stars()
    after = leds_at(settings, before, 2 * 3600.0)
    anchor = np.array([0.0, 0.0, 0.9])
    strain = 70e-6 * 4.0
    expected = anchor + (1 + strain) * (before.place[:2, :3] - anchor) + [0.0, 0.0, -1e-3]
    np.testing.assert_allclose(after.place[:2, :3], expected, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(after.place[2], before.place[2])
    optics = Optics.from_camera(loader.load("afit_simsat").camera)
    assert camera_at(settings, MOUNTED, optics, 2 * 3600.0)[1] is optics


def test_image_grows_with_the_focal_length() -> None:
    before = Optics.from_camera(loader.load("afit_simsat").camera)
    _, after = camera_at(config(LINEAR, lens_ppm_k=25.0), MOUNTED, before, 3600.0)
    rays = np.array([[0.02, -0.05, 1.0], [0.0, 0.07, 1.0]])
    center = np.array(before.camera.center_px)
    expected = center + (1 + 50e-6) * (before.project(rays) - center)
    np.testing.assert_allclose(after.project(rays), expected, rtol=0, atol=1e-9)


def test_a_tilted_camera_turns_about_its_own_axes() -> None:
    """A camera turned by 90 degrees about body x, and by the coefficient about camera z: its body y, downward."""
    mounted = Mount(np.zeros(3), Rotation.from_euler("x", 90.0, degrees=True))
    optics = Optics.from_camera(loader.load("afit_simsat").camera)
    settings = config(LINEAR, mount_arcsec_k=[0.0, 0.0, 50.0])
    mount, _ = camera_at(settings, mounted, optics, 2 * 3600.0)
    boresight_body, right_body = (
        mount.cam_from_body.inv().apply(axis) for axis in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    )
    # The boresight stays; a camera that turns clockwise by 200" sees a fixed light turn the other way.
    np.testing.assert_allclose(boresight_body, [0.0, 1.0, 0.0], rtol=0, atol=1e-15)
    expected = [1.0, 0.0, 200 * ARCSEC_RAD]
    np.testing.assert_allclose(right_body, expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_boresight_drifts_by_its_coefficient_in_the_truth() -> None:
    """Every frame's camera is rotated by the coefficient times dT about its axes, and so are its stars."""
    settings = {
        "thermal.temperature": "{kind: linear, start_c: 19, rate_c_h: 2}",
        "thermal.speed": "1800",
        "thermal.mount_arcsec_k": "[300, -200, 100]",
        "exposure.frames": "3",
        "exposure.rate_hz": "1",
        "camera.detector.noise": "false",
    }
    flight = simulate_motion(loader.load("shefex2", settings))
    camera = flight.lab.camera
    for index in range(3):
        _, truth = flight.render(index)
        nominal = camera.mount.cam_from_body * truth.lab_from_body.inv()
        drift_k = -1 + truth.t_s  # 2 K an hour, 1800 times as fast
        turned = (truth.cam_from_lab * nominal.inv()).as_rotvec() / ARCSEC_RAD
        np.testing.assert_allclose(
            turned, np.array([300.0, -200.0, 100.0]) * drift_k, atol=1e-6
        )
        stars = camera.sources.take(np.isin(camera.sources.id, truth.sources.id))
        rows = np.searchsorted(
            truth.sources.id, stars.id, sorter=np.argsort(truth.sources.id)
        )
        xy_px = camera.optics.project(truth.cam_from_lab.apply(stars.place[:, :3]))
        found = truth.sources.xy_px[np.argsort(truth.sources.id)[rows]]
        np.testing.assert_allclose(found, xy_px, atol=1e-6)


def test_a_section_without_a_coefficient_is_refused() -> None:
    with pytest.raises(ValidationError, match="nothing depends on the temperature"):
        config(LINEAR, creep=["0 m", "0 m", "-1 mm"])


# Gravity and bearing.

# A vehicle at rest at tilts, with exact knowledge of all else.
EXACT = {
    "exposure.frames": "6",
    "tracker.survey.led_sigma": "0 mm",
    "tracker.survey.lever_sigma": "0 mm",
}


def vehicle(**keys: Any) -> VehicleConfig:
    return VehicleConfig.model_validate({"model": "simsat"} | keys)


TURNED = Rotation.from_euler("ZYX", [50.0, 17.0, -12.0], degrees=True)


def test_a_camera_on_top_leans_further_over() -> None:
    """By the compliance times the sine of the tilt, in the plane of the tilt; level it is where it was aligned."""
    bent = vehicle(sag_arcsec=(30.0, 30.0))
    mount = Mount(np.array([0.0, 0.0, 0.4]), Rotation.from_euler("z", 0.7))
    level = mount_at(bent, mount, Rotation.from_euler("z", 2.0))
    assert (level.cam_from_body * mount.cam_from_body.inv()).magnitude() < 1e-15
    up = np.array([0.0, 0.0, 1.0])
    leans_rad = []
    for one in (mount, mount_at(bent, mount, TURNED)):
        boresight = (TURNED * one.cam_from_body.inv()).apply(up)
        leans_rad.append(np.arccos(boresight[2]))
    lean_arcsec = (leans_rad[1] - leans_rad[0]) / ARCSEC_RAD
    assert lean_arcsec == pytest.approx(30 * np.sin(leans_rad[0]), rel=1e-3)


def test_a_mast_turns_about_where_it_bends() -> None:
    """Its foot stays; the pupil on top sinks toward the low side by compliance times sine of the tilt times length."""
    mount = Mount(np.array([0.1, -0.2, 0.9]), Rotation.from_euler("zx", [0.7, 0.2]))
    up = np.array([0.0, 0.0, 1.0])
    bent = mount_at(vehicle(sag_arcsec=(90.0, 60.0), mast="0.4 m"), mount, TURNED)
    feet = [
        one.camera_body_m - one.cam_from_body.inv().apply(0.4 * up) for one in (mount, bent)
    ]
    moved_m = bent.camera_body_m - mount.camera_body_m
    assert np.linalg.norm(moved_m) > 1e-5
    np.testing.assert_allclose(feet[1], feet[0], atol=1e-3 * np.linalg.norm(moved_m))
    level = Mount(mount.camera_body_m, Rotation.from_euler("z", 0.7))
    round_ = vehicle(sag_arcsec=(90.0, 90.0), mast="0.4 m")
    sunk_m = mount_at(round_, level, TURNED).camera_body_m - level.camera_body_m
    down = TURNED.inv().apply([0, 0, -1.0])
    expected_m = 0.4 * 90 * ARCSEC_RAD * np.array([down[0], down[1], 0])
    np.testing.assert_allclose(sunk_m, expected_m, rtol=1e-9, atol=1e-15)


def test_compliances_are_about_the_camera_s_axes() -> None:
    """A camera that looks at the horizon when level: weight when tilted about its x axis bends it about x alone."""
    mount = Mount(np.zeros(3), Rotation.from_euler("x", 90.0, degrees=True))
    tilted = Rotation.from_rotvec(np.radians([10.0, 0.0, 0.0]))
    turned = [
        mount_at(vehicle(sag_arcsec=one), mount, tilted).cam_from_body
        * mount.cam_from_body.inv()
        for one in ((8.0, 0.0), (0.0, 8.0))
    ]
    assert turned[1].magnitude() < 1e-15
    # Across the boresight gravity changes from 1 g to cos 10 deg.
    assert turned[0].magnitude() / ARCSEC_RAD == pytest.approx(
        8 * (1 - np.cos(np.radians(10)))
    )


def test_the_cup_holds_the_sphere_around_the_lowest_point() -> None:
    """The center of a sphere fitted to a small cap of the deviating ball stays where it is when level."""
    q_m = np.array([9e-6, -4e-6, 2e-6])
    mount = Mount(np.zeros(3), Rotation.identity())
    ball_m = 0.15

    def center_lab(lab_from_body: Rotation) -> np.ndarray:
        """Center of the sphere through the ball's surface within 3 deg of its lowest point."""
        rng = np.random.default_rng(1)
        cap = np.column_stack([rng.uniform(-0.05, 0.05, (400, 2)), -np.ones(400)])
        u = lab_from_body.inv().apply(cap / np.linalg.norm(cap, axis=1, keepdims=True))
        points = (ball_m + (u**2) @ q_m)[:, None] * u
        # |p|^2 = 2 p . c + (r^2 - |c|^2)
        design = np.column_stack([2 * points, np.ones(400)])
        found = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
        return lab_from_body.apply(found[:3])

    level = Rotation.identity()
    moved_m = TURNED.apply(
        mount_at(vehicle(runout=("9 um", "-4 um", "2 um")), mount, TURNED).camera_body_m
    )
    change_m = center_lab(TURNED) - center_lab(level)
    np.testing.assert_allclose(moved_m[:2], -change_m[:2], rtol=0.01)
    # Across; along the vertical the fitted radius differs by the curvature of the deviation.
    d = TURNED.inv().apply([0, 0, -1.0])
    assert moved_m[2] == pytest.approx((d**2) @ q_m - q_m[2], rel=1e-6)


# Dies of LEDs.


def test_dies_are_beside_their_windows_in_each_led_s_axes() -> None:
    lights = replace(leds_and_stars(), normal=np.array([[0.0, -1, 0], [0, 0, -1], [0, 0, 1]]))
    moved = off_center(lights, np.array([1e-4, 2e-4, 3e-4])).place - lights.place
    np.testing.assert_allclose(moved[0, :3], [1e-4, -3e-4, 2e-4], atol=1e-15)
    np.testing.assert_allclose(moved[1, :3], [1e-4, -2e-4, -3e-4], atol=1e-15)


# The pupil of a lens.


def test_light_enters_where_the_pupil_is_at_its_angle() -> None:
    """The angle at which a ray from the LED meets the axis at the pupil of this angle, by bisection."""
    scene = loader.load("afit_simsat", {"camera.pupil_walk": "[5 mm, -20 mm]"})
    optics = Optics.from_camera(scene.camera)
    x_m = np.array([0.0, 0.1, 0.3, -0.2])
    z_m = np.array([1.1, 1.0, 0.9, 1.2])
    distance_m = np.hypot(x_m, z_m)
    u = np.column_stack([x_m, np.zeros(4), z_m]) / distance_m[:, None]
    seen = optics.from_pupil(u, 1 / distance_m)
    for x, z, one in zip(x_m, z_m, seen, strict=True):

        def off(t: float, x: float = x, z: float = z) -> float:
            return t - x / (z - (0.005 * t**2 - 0.020 * t**4))

        assert one[0] / one[2] == pytest.approx(brentq(off, -1, 1), abs=1e-9)
    np.testing.assert_array_equal(optics.from_pupil(u, np.zeros(4)), u)


# The chip's edge.


def test_images_near_an_edge_are_displaced_outward_by_an_exponential() -> None:
    scene = loader.load(
        "afit_simsat",
        {"camera.detector.edge_px": "0.8", "camera.detector.edge_reach_px": "12"},
    )
    width = scene.camera.width_px
    height = scene.camera.height_px
    xy = np.array([[-0.5, height / 2], [width - 12.5, 11.5], [width / 2, height / 2]])
    moved = beside_edges(scene.camera, xy) - xy
    np.testing.assert_allclose(
        moved, 0.8 * np.array([[-1, 0], [np.exp(-1), -np.exp(-1)], [0, 0]]), atol=1e-9
    )


# What a run does, and what `check` counts.


def test_the_response_within_pixels_shifts_centers_as_check_counts() -> None:
    """Against images that are drawn at even steps over a pixel."""
    sharp = {
        "camera.psf": "{kind: gaussian, sigma_px: 0.4}",
        "motion.rate_deg_s": "[0, 0, 0]",
    }
    even = loader.load("shefex2", sharp).camera
    scene = loader.load("shefex2", sharp | {"camera.detector.intrapixel": "0.1"})
    lab = build_lab(scene)
    plan = plan_of(lab, attitudes.of_frames(lab))
    counted_px2 = pixel_response(plan.frames.used[0], plan)
    assert counted_px2 is not None
    moved_px = []
    for phase in np.linspace(-0.5, 0.5, 40, endpoint=False):
        centers = []
        for one in (even, scene.camera):
            patch = np.zeros((11, 11))
            add_kernel(patch, 0, 11, 5 + phase, 5.0, 1.0, build_kernel(one.psf, one))
            centers.append(patch.sum(axis=0) @ np.arange(11) / patch.sum())
        moved_px.append(centers[1] - centers[0])
    assert np.sqrt(counted_px2[0, 0, 0]) == pytest.approx(np.std(moved_px), rel=0.1)


def ball_moved_m(q_m: np.ndarray) -> np.ndarray:
    """Where a cup of 2 deg, an even foundation, carries a ball of the deviations q TURNED, beside it level; lab."""
    cap = np.column_stack(
        [np.mgrid[-20:21, -20:21].reshape(2, -1).T * 0.0017, -np.ones(1681)]
    )
    u = cap / np.linalg.norm(cap, axis=1, keepdims=True)
    # The gap, deviation + u . x, has no resultant.
    rest = [
        -np.linalg.solve(u.T @ u, u.T @ (one.inv().apply(u) ** 2 @ q_m))
        for one in (TURNED, Rotation.identity())
    ]
    return np.asarray(rest[0] - rest[1])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("vehicle.sag_arcsec", "[90, 60]"),
        ("vehicle.runout", "[60 um, -40 um, 20 um]"),
        ("light.led.die", "[0.3 mm, -0.2 mm, 0.4 mm]"),
        ("camera.pupil_walk", "[26 mm, 0 mm]"),
    ],
)
def test_rendered_lights_are_where_a_pinhole_sees_them(key: str, value: str) -> None:
    """Torque of the weight, a ball in a cup, dies along their axes, a ray through the pupil of its angle; to 0.5 %."""
    images = []
    for keys in ({}, {key: value}):
        camera = build_lab(loader.load("afit_simsat", keys)).camera
        images.append(render_at_rest(camera, TURNED)[1].sources)
    _, before, after = np.intersect1d(images[0].id, images[1].id, return_indices=True)
    camera = build_lab(loader.load("afit_simsat")).camera
    order = np.argsort(camera.sources.id)
    rows = np.searchsorted(camera.sources.id, images[0].id[before], sorter=order)
    leds = camera.sources.take(order[rows])
    focal_px = camera.scene.camera.focal_px
    place = leds.place[:, :3]
    lever_m = TURNED.apply(camera.mount.camera_body_m)
    cam_from_lab = camera.mount.cam_from_body * TURNED.inv()
    nominal = cam_from_lab.apply(place - lever_m)
    seen = nominal
    if key == "vehicle.sag_arcsec":
        weight = cam_from_lab.apply([0, 0, -1.0])
        torque = np.cross([0, 0, 1.0], weight)
        seen = Rotation.from_rotvec(-np.array([90, 60, 0]) * ARCSEC_RAD * torque).apply(
            nominal
        )
    if key == "vehicle.runout":
        seen = nominal - cam_from_lab.apply(ball_moved_m(np.array([60e-6, -40e-6, 20e-6])))
    if key == "light.led.die":
        x = np.cross([0, 0, 1.0], leds.normal)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        die = 3e-4 * x - 2e-4 * np.cross(leds.normal, x) + 4e-4 * leds.normal
        seen = nominal + cam_from_lab.apply(die)
    tangent = seen[:, :2] / seen[:, 2:]
    if key == "camera.pupil_walk":
        across = np.hypot(*nominal[:, :2].T)
        met = [
            brentq(lambda t, r=r, z=z: t * (z - 0.026 * t**2) - r, 0, 1)
            for r, z in zip(across, nominal[:, 2], strict=True)
        ]
        tangent = nominal[:, :2] * (np.array(met) / across)[:, None]
    expected_px = focal_px * (tangent - nominal[:, :2] / nominal[:, 2:])
    moved_px = images[1].xy_px[after] - images[0].xy_px[before]
    assert len(moved_px) > 20
    np.testing.assert_allclose(
        moved_px, expected_px, rtol=0, atol=0.005 * np.abs(expected_px).max()
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("light.led.die", "[0.1 mm, 0 mm, 0 mm]"),
        ("vehicle.sag_arcsec", "[90, 60]"),
        ("vehicle.mast", "[30, 20]"),
        ("vehicle.runout", "[60 um, -40 um, 0 um]"),
    ],
)
def test_a_run_errs_as_check_forecasts(key: str, value: str) -> None:
    mast = {"vehicle.mast": "0.5 m"} if key == "vehicle.mast" else {}
    key = "vehicle.sag_arcsec" if mast else key
    scene = loader.load("simsat_bump", {key: value} | mast | EXACT)
    lab = build_lab(scene)
    forecast = plan_of(lab, attitudes.of_frames(lab)).frames.error
    scores = simulate(scene).scores
    assert len(scores) == 6
    squares = [one.row.cross_arcsec**2 for one in scores]
    measured_arcsec = np.sqrt(np.mean(squares))
    assert measured_arcsec == pytest.approx(forecast.rms_arcsec()[0], rel=0.05)
    share = forecast.rad2["cross"][AS_BUILT] / forecast.total("cross")
    assert share.min() > 0.5


@pytest.mark.slow
def test_flares_of_coma_point_outward_in_a_frame() -> None:
    """The third moment of the light along the radius, in proportion to the distance from the principal point."""
    scene = loader.load(
        "shefex2", {"camera.psf.coma_px": "3", "camera.detector.noise": "false"}
    )
    lab = build_lab(scene)
    frame, truth = render_at_rest(lab.camera, lab.start)
    center = np.array(scene.camera.center_px)
    sources = truth.sources
    y, x = np.mgrid[-8:9, -8:9]
    found = []
    for n in np.argsort(-sources.electrons)[:40]:
        place = sources.xy_px[n]
        apart = np.linalg.norm(sources.xy_px - place, axis=1)
        column, row = np.rint(place).astype(int)
        window = frame.image_dn[row - 8 : row + 9, column - 8 : column + 9]
        if window.shape != (17, 17) or np.sort(apart)[1] < 20:
            continue
        light = window - np.median(window)
        radius = place - center
        toward = radius / np.linalg.norm(radius)
        along = (x + column - place[0]) * toward[0] + (y + row - place[1]) * toward[1]
        skew = (light * along**3).sum() / light.sum()
        found.append((np.linalg.norm(radius) / scene.camera.corner_px, skew))
    # Faint neighbors hide the moment where there is little coma.
    field, skew = np.array([one for one in found if one[0] > 0.5]).T
    assert len(field) > 4
    # Of Seidel's pattern: c^3 <(s (2 + cos 2 phi) - 1)^3> = c^3 / 4.
    np.testing.assert_allclose(np.cbrt(4 * skew), 3 * field, rtol=0.2)
