"""Surfaces against their equations, rigid motion, finite differences and the measured dome; clouds against theory."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.special import eval_jacobi

from skysim.core.errors import InputError
from skysim.dynamics.multibody import mjcf_export
from skysim.scene import loader
from skysim.scene.sections import light
from skysim.sources.dome import point_cloud
from skysim.sources.dome.surface import SURFACES, Radial, Surface, build_surface

INCH_M = 0.0254
UP = np.array([[0.0, 0.0, 1.0]])
SPHERE = {"kind": "sphere", "apex": "48 in", "radius": "50 in"}
MEASURED = {
    "kind": "ellipsoid",
    "apex": "48 in",
    "semi_axes": ["38.88 in", "38.88 in", "28.60 in"],
}
PROLATE = {"kind": "ellipsoid", "apex": "48 in", "semi_axes": ["44 in", "44 in", "50 in"]}
TRIAXIAL = {"kind": "ellipsoid", "apex": "48 in", "semi_axes": ["38 in", "45 in", "31 in"]}
FLAT = {"kind": "flat", "apex": "48 in"}
VAULT = {"kind": "cylinder", "axis": "x", "apex": "48 in", "radius": "52 in"}
DRUM = {
    "kind": "cylinder",
    "axis": "z",
    "apex": "30 in",
    "radius": "48 in",
    "length": "50 in",
}
WALL = {
    "thickness_apex": "0.2036 in",
    "thickness_base": "0.25 in",
    "base_deg": 40,
    "radius_of": "mid_wall",
}
DESIGN = {"kind": "sphere", "apex": "48.033 in", "radius": "48.135 in", "wall": WALL}
MOVED = {"offset": ["1 in", "-2 in", "0.5 in"], "tilt_deg": [3.0, -2.0]}
KINDS = {
    "sphere": SPHERE,
    "oblate": MEASURED,
    "prolate": PROLATE,
    "triaxial": TRIAXIAL,
    "flat": FLAT,
    "vault": VAULT,
    "across": VAULT | {"axis": "y"},
    "drum": DRUM,
    "wall": DESIGN,
}


def made(part: dict[str, Any], **more: Any) -> Surface:
    return build_surface(TypeAdapter(light.AnySurface).validate_python(part | more))


def rays_up(count: int, seed: int, most_deg: float = 35.0) -> np.ndarray:
    """Directions within an angle of the zenith, of lengths other than 1."""
    rng = np.random.default_rng(seed)
    up = rng.uniform(np.cos(np.radians(most_deg)), 1, count)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    length = rng.uniform(0.3, 3, count)
    out = np.sqrt(1 - up**2)
    return (
        np.column_stack([out * np.cos(azimuth), out * np.sin(azimuth), up]) * length[:, None]
    )


def rays_for(name: str, count: int, seed: int) -> np.ndarray:
    """Rays that meet the kind: the drum has no lid."""
    rays = rays_up(count, seed)
    return rays[:, [2, 0, 1]] * [1, 1, 0.2] if name == "drum" else rays


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """3,000 points of the measured dome to 41 deg with 0.1 mm of noise along the normals, in millimeters."""
    return survey_of(tmp_path_factory.mktemp("arm") / "dome.csv", 3000, 1e-4, seed=7)


def dome_points_m(count: int, seed: int, most_deg: float = 41.0) -> np.ndarray:
    rays = rays_up(count - 40, seed, most_deg)
    edge = np.radians(most_deg)
    azimuth = np.arange(40) * (2 * np.pi / 40)
    ring = [
        np.sin(edge) * np.cos(azimuth),
        np.sin(edge) * np.sin(azimuth),
        np.full(40, np.cos(edge)),
    ]
    return made(MEASURED).meet(np.zeros(3), np.vstack([rays, np.column_stack(ring)]))


def survey_of(path: Path, count: int, sigma_m: float, seed: int) -> dict[str, Any]:
    points = dome_points_m(count, seed)
    noise = sigma_m * np.random.default_rng(seed + 1).standard_normal(count)
    return written(path, points + noise[:, None] * made(MEASURED).inward(points))


def written(
    path: Path, points_m: np.ndarray, head: str = "# FARO arm\nx,y,z"
) -> dict[str, Any]:
    np.savetxt(path, points_m * 1e3, delimiter=",", header=head, comments="", fmt="%.9f")
    return {"kind": "surveyed", "file": str(path), "unit": "mm"}


# Rays, equations and normals


def off_equation(name: str, points_m: np.ndarray) -> np.ndarray:
    """Deviation of undisplaced points from each kind's textbook equation."""
    x, y, z = points_m.T / INCH_M
    off = {
        "sphere": np.hypot(np.hypot(x, y), z + 2) / 50 - 1,
        "oblate": (x**2 + y**2) / 38.88**2 + ((z - 19.4) / 28.6) ** 2 - 1,
        "prolate": (x**2 + y**2) / 44**2 + ((z + 2) / 50) ** 2 - 1,
        "triaxial": (x / 38) ** 2 + (y / 45) ** 2 + ((z - 17) / 31) ** 2 - 1,
        "flat": z / 48 - 1,
        "vault": np.hypot(y, z + 4) / 52 - 1,
        "across": np.hypot(x, z + 4) / 52 - 1,
        "drum": np.hypot(x, y) / 48 - 1,
    }
    height = z - (48.033 - 48.135 + 0.1018)
    angle_deg = np.degrees(np.arctan2(np.hypot(x, y), height))
    wall = (0.2036 + (0.25 - 0.2036) * np.minimum(angle_deg / 40, 1)) / 2
    off["wall"] = (np.hypot(np.hypot(x, y), height) - 48.135 + wall) / 48
    return np.asarray(off[name])


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("origin_in", [(0, 0, 0), (2, -1, 15)])
def test_points_lie_on_their_rays_and_satisfy_the_equation(
    name: str, origin_in: tuple
) -> None:
    origin = INCH_M * np.array(origin_in, float)
    rays = rays_for(name, 300, 1)
    met = made(KINDS[name]).meet(origin, rays)
    assert np.isfinite(met).all()
    np.testing.assert_allclose(
        off_equation(name, met), 0, rtol=0, atol=3e-14
    )  # rounding of a root
    along = met - origin
    assert np.all(np.einsum("nj,nj->n", along, rays) > 0)
    np.testing.assert_allclose(np.cross(along, rays), 0, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", [*KINDS, "cloud"])
def test_normals_match_the_numerical_gradient(name: str, cloud: dict) -> None:
    """Perpendicular to chords between neighbors found by rays alone; of length 1; towards the bearing."""
    shape = made(cloud if name == "cloud" else KINDS[name], **MOVED)
    rays = rays_for(name, 80, 3)
    here = shape.meet(np.zeros(3), rays)
    normal = shape.inward(here)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=0, atol=4e-16)
    assert np.all(np.einsum("nj,nj->n", normal, here) < 0)
    for axis in np.eye(3):
        step = 1e-5 * axis
        chord = shape.meet(np.zeros(3), rays + step) - shape.meet(np.zeros(3), rays - step)
        # A symmetric chord is off the tangent by the cube of its length: (1e-5 m)^3 times at most some 100 m^-2.
        assert np.abs(np.einsum("nj,nj->n", chord, normal)).max() < 2e-13


@pytest.mark.parametrize("name", [*KINDS, "cloud"])
def test_offset_and_tilt_are_a_rigid_motion_about_the_center(name: str, cloud: dict) -> None:
    """The rays are rotated instead: first about x by 3 deg, then about y by -2 deg, by explicit matrices."""
    part = cloud if name == "cloud" else KINDS[name]
    still = made(part)
    moved = made(part, **MOVED)
    a, b = np.radians(MOVED["tilt_deg"])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    turn = about_y @ about_x
    shift = INCH_M * np.array([1, -2, 0.5])
    pivot = np.zeros(3) if name == "cloud" else still.center_m
    origin = np.array([0.05, -0.02, 0.1])
    rays = rays_for(name, 100, 5)
    before = still.meet(pivot + turn.T @ (origin - shift - pivot), rays @ turn)
    expected = (before - pivot) @ turn.T + pivot + shift
    met = moved.meet(origin, rays)
    assert np.isfinite(met).sum() > 200
    np.testing.assert_allclose(met, expected, rtol=0, atol=4e-15)
    good = np.isfinite(met[:, 0])
    normal = still.inward(before[good]) @ turn.T
    np.testing.assert_allclose(moved.inward(met[good]), normal, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["sphere", "oblate", "vault", "drum", "wall", "cloud"])
def test_rays_that_never_leave_the_surface_are_nan(name: str, cloud: dict) -> None:
    """From far outside, past it and away from it; and along a cylinder's axis."""
    shape = made(cloud if name == "cloud" else KINDS[name])
    aside = np.array([0.0, 0.0, 1.0]) if name == "vault" else np.array([0.0, 1.0, 0.0])
    assert np.isnan(
        shape.meet(10 * aside, np.array([[1.0, 0.0, 0.0], aside, 0 * aside]))
    ).all()
    if name in ("vault", "drum"):
        axis = np.eye(3)[[0 if name == "vault" else 2]]
        assert np.isnan(shape.meet(np.zeros(3), np.vstack([axis, -axis]))).all()


def test_no_rays_give_no_points(cloud: dict) -> None:
    for part in (*KINDS.values(), cloud):
        shape = made(part)
        none = np.zeros((0, 3))
        assert shape.meet(np.zeros(3), none).shape == shape.inward(none).shape == (0, 3)


def test_a_wall_of_one_thickness_is_a_sphere() -> None:
    """Newton's points against the quadratic's."""
    even = DESIGN | {"wall": WALL | {"thickness_base": "0.2036 in", "radius_of": "outside"}}
    ball = made({"kind": "sphere", "apex": "48.033 in", "radius": "47.9314 in"}, **MOVED)
    origin = np.array([0.1, 0.2, 0.3])
    rays = rays_up(500, 8, 120)
    met = made(even, **MOVED).meet(origin, rays)
    np.testing.assert_allclose(met, ball.meet(origin, rays), rtol=0, atol=1e-14)


def test_newton_converges_in_few_steps_from_anywhere_inside(
    cloud: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight are allowed here of the 200 by which bisection alone would end."""
    monkeypatch.setattr("skysim.sources.dome.surface.MAX_STEPS", 8)
    rng = np.random.default_rng(2)
    for part in (cloud, DESIGN):
        shape = made(part)
        for origin in rng.uniform(-0.4, 0.4, (10, 3)):
            met = shape.meet(origin, rng.standard_normal((500, 3)))
            far = met[np.isfinite(met[:, 0])]
            assert np.abs(shape.level_and_gradient(far - shape.center_m)[0]).max() < 1e-14
            assert len(far) > 20


def test_a_ray_that_does_not_converge_is_an_error(
    cloud: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    shape = made(cloud)
    monkeypatch.setattr("skysim.sources.dome.surface.MAX_STEPS", 1)
    with pytest.raises(
        ArithmeticError, match=r"no convergence on the surface for \d+ rays in 1 steps"
    ):
        shape.meet(np.array([0.1, 0.0, 0.3]), rays_up(10, 1))


# Rims


@pytest.mark.parametrize("name", ["sphere", "oblate", "wall", "cloud"])
def test_a_rim_s_half_angle_is_seen_from_the_bearing(name: str, cloud: dict) -> None:
    part = cloud if name == "cloud" else KINDS[name]
    shape = made(part, rim_deg=30)
    whole = made(part)
    angle_deg = np.array([0, 15, 29.999, 30.001, 40])
    rays = np.column_stack(
        [0 * angle_deg, np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))]
    )
    met = shape.meet(np.zeros(3), rays)
    np.testing.assert_array_equal(np.isnan(met[:, 0]), angle_deg > 30)
    np.testing.assert_array_equal(met[:3], whole.meet(np.zeros(3), rays)[:3])


@pytest.mark.parametrize("name", ["sphere", "oblate", "vault", "wall", "cloud"])
def test_the_rim_s_height_moves_with_the_dome(name: str, cloud: dict) -> None:
    """Upright it is a height above the bearing; displaced, nothing is left beneath the displaced plane."""
    part = cloud if name == "cloud" else KINDS[name]
    rim = 40 * INCH_M
    rays = rays_up(4000, 4, 60)
    met, whole = (
        one.meet(np.zeros(3), rays) for one in (made(part, rim_height="40 in"), made(part))
    )
    lower = ~(whole[:, 2] >= rim)
    np.testing.assert_array_equal(np.isnan(met[:, 0]), lower)
    assert 100 < lower.sum() < 3900
    moved = made(part, rim_height="40 in", **MOVED)
    own = (moved.meet(np.zeros(3), rays) - moved.center_m) @ moved.lab_from_own.as_matrix()
    height = own[:, 2] + made(part).center_m[2]
    assert np.nanmin(height) == pytest.approx(rim, abs=0.005)
    assert np.nanmin(height) >= rim - 1e-11


def test_a_panel_and_a_vault_end_at_their_sides() -> None:
    rays = np.array(
        [[0.49, 0.29, 1], [0.51, 0, 1], [0, 0.31, 1], [-0.49, -0.29, 1], [0, 0, -1]]
    )
    panel = made({"kind": "flat", "apex": "1 m", "width": "1 m", "height": "0.6 m"})
    missed = [False, True, True, False, True]
    np.testing.assert_array_equal(np.isnan(panel.meet(np.zeros(3), rays)[:, 0]), missed)
    vault = made(
        {"kind": "cylinder", "axis": "y", "apex": "1 m", "radius": "1 m", "length": "0.6 m"}
    )
    along = np.array([[0, 0.29, 1], [0, 0.31, 1], [0, -0.29, 1], [0, -0.31, 1]])
    np.testing.assert_array_equal(
        np.isnan(vault.meet(np.zeros(3), along)[:, 0]), [False, True] * 2
    )


def test_a_drum_extends_down_from_its_upper_edge() -> None:
    height_in = np.array([29.9, 30.1, -19.9, -20.1])
    met = made(DRUM).meet(
        np.zeros(3), np.column_stack([np.full(4, 48.0), np.zeros(4), height_in])
    )
    np.testing.assert_array_equal(np.isnan(met[:, 0]), [False, True, False, True])


# The thesis's dome


def test_the_design_contour_follows_from_its_wall_thickness() -> None:
    """Reference A3: 48.033 in at the apex, 48.010 in at the rim, 40 deg off; less than .05 % between."""
    angle = np.radians([0, 40])
    rays = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    radius_in = np.linalg.norm(made(DESIGN).meet(np.zeros(3), rays), axis=1) / INCH_M
    np.testing.assert_allclose(radius_in, [48.033, 48.010], rtol=0, atol=1e-3)
    assert abs(radius_in[1] / radius_in[0] - 1) < 5e-4


def test_the_design_s_sphere_is_not_its_outside() -> None:
    """48.135 in less the wall of 0.2036 in would leave 47.931 in, which the thesis has nowhere."""
    shape = made(DESIGN, wall=WALL | {"radius_of": "outside"})
    top = shape.meet(shape.center_m, UP)[0]
    assert np.linalg.norm(top - shape.center_m) / INCH_M == pytest.approx(47.9314, abs=1e-9)


def test_the_wall_thickens_linearly_with_the_angle_down_to_its_base() -> None:
    shape = made(DESIGN)
    angle = np.radians([0, 10, 20, 30, 40, 60])
    rays = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    radius_in = (
        np.linalg.norm(shape.meet(shape.center_m, rays) - shape.center_m, axis=1) / INCH_M
    )
    wall_in = 2 * (48.135 - radius_in)
    np.testing.assert_allclose(
        wall_in, [0.2036, 0.2152, 0.2268, 0.2384, 0.25, 0.25], rtol=0, atol=1e-11
    )


def test_the_measured_dome_s_rim_is_the_reference_s() -> None:
    """Reference A4: rim at z = 36.66 in, 11.34 in under the apex, 48.011 in off; 48.29 in at most, near 29 deg."""
    angle_deg = np.arange(0, 45, 0.002)
    rays = np.column_stack(
        [np.sin(np.radians(angle_deg)), 0 * angle_deg, np.cos(np.radians(angle_deg))]
    )
    met_in = made(MEASURED, rim_height="36.66 in").meet(np.zeros(3), rays) / INCH_M
    met_in = met_in[np.isfinite(met_in[:, 0])]
    far_in = np.linalg.norm(met_in, axis=1)
    assert met_in[-1, 2] == pytest.approx(36.66, abs=0.01)
    assert met_in[-1, 0] == pytest.approx(31, abs=0.01)  # of the dome's 62 in
    assert met_in[0, 2] - met_in[-1, 2] == pytest.approx(11.34, abs=0.01)
    assert far_in[-1] == pytest.approx(48.011, abs=0.01)
    assert far_in.max() == pytest.approx(48.29, abs=0.01)
    assert angle_deg[far_in.argmax()] == pytest.approx(29, abs=0.15)


def test_the_measured_dome_s_best_sphere_is_the_reference_s() -> None:
    """Reference A4: R = 48.34 in about z = -0.16 in, off by 0.10 in rms.

    The sphere is that of least squares over equal areas of the design's cap, asin(31 / 48.135) = 40.09 deg (evenly over
    the contour it would be one of 48.9 in). Its rms there is .083 in; evenly over the contour it is the reference's.
    """
    shape = made(MEASURED, rim_deg=float(np.degrees(np.arcsin(31 / 48.135))))
    ball = point_cloud.fit_sphere(shape.samples_m())
    assert ball.radius_m / INCH_M == pytest.approx(48.34, abs=0.01)
    np.testing.assert_allclose(ball.center_m / INCH_M, [0, 0, -0.16], rtol=0, atol=0.01)
    assert ball.rms_m / INCH_M == pytest.approx(0.083, abs=0.002)
    angle = np.radians(np.arange(0, 40.09, 0.01))
    contour = shape.meet(
        np.zeros(3), np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    )
    off_in = (np.linalg.norm(contour - ball.center_m, axis=1) - ball.radius_m) / INCH_M
    assert np.sqrt(np.mean(off_in**2)) == pytest.approx(0.10, abs=0.01)


# What the estimator believes


def test_the_tracker_models_upright_quadrics_exactly() -> None:
    center, axes = made(MEASURED, offset=["1 in", "2 in", "3 in"]).as_ellipsoid()
    np.testing.assert_allclose(center / INCH_M, [1, 2, 22.4], rtol=0, atol=1e-12)
    np.testing.assert_allclose(axes / INCH_M, [38.88, 38.88, 28.60], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(
        made(SPHERE, **MOVED).as_ellipsoid()[1], np.full(3, 50 * INCH_M)
    )
    assert made(MEASURED).nearest_ellipsoid().rms_m == 0


@pytest.mark.parametrize("name", ["flat", "vault", "across", "drum"])
def test_straight_walls_are_modeled_by_infinite_semi_axes(name: str) -> None:
    """Where rays meet it within a couple of meters, to a few micrometers: the sagitta of 1000 km and rounding."""
    more = MOVED if name == "flat" else {"offset": MOVED["offset"]}
    shape = made(KINDS[name], **more)
    center, axes = shape.as_ellipsoid()
    met = (shape.meet(np.zeros(3), rays_for(name, 300, 3)) - center) / axes
    size = np.linalg.norm(met, axis=1)
    apart_m = (size - 1) * size / np.linalg.norm(met / axes, axis=1)
    assert np.abs(apart_m).max() < 3e-6


def test_the_nearest_ellipsoid_of_other_surfaces_states_its_residual() -> None:
    """The design contour is the thesis's prolate spheroid to the micrometers that its wall's straight law leaves.

    An ellipsoid with axes along the lab's has no cross term, which is what a tilt makes, of first order.
    """
    wall = made(DESIGN, rim_deg=40).nearest_ellipsoid()
    assert wall.rms_m < 0.001 * INCH_M
    assert (
        wall.semi_axes_m[2]
        > wall.semi_axes_m[0]
        == pytest.approx(wall.semi_axes_m[1], rel=1e-6)
    )
    near, far = (
        made(MEASURED, rim_deg=35, tilt_deg=[t, 0]).nearest_ellipsoid() for t in (0.5, 1.0)
    )
    assert 0 < near.rms_m < far.rms_m < 1e-3
    assert far.rms_m == pytest.approx(2 * near.rms_m, rel=0.05)


def test_the_nearest_ellipsoid_of_an_ellipsoid_is_itself() -> None:
    points = made(TRIAXIAL, offset=["1 in", "2 in", "3 in"], rim_deg=50).samples_m()
    found = point_cloud.fit_ellipsoid(points)
    assert found.rms_m < 1e-9
    np.testing.assert_allclose(found.center_m / INCH_M, [1, 2, 20], rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.semi_axes_m / INCH_M, [38, 45, 31], rtol=0, atol=1e-5)


def test_the_nearest_ellipsoid_keeps_the_survey_error() -> None:
    assert made(MEASURED, error="0.3 mm").survey_sigma_m == pytest.approx(3e-4, rel=1e-12)
    assert made(DESIGN).survey_sigma_m == 0


# Surveyed points


def test_zernike_polynomials_and_gradients_match_the_textbook() -> None:
    """R_n^m as a Jacobi polynomial (Born & Wolf, app. VII); orthogonal on the disk; slopes by differences."""
    radius, azimuth = np.random.default_rng(1).uniform([0, 0], [1, 2 * np.pi], (50, 2)).T
    disk = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth)])
    value, slope = point_cloud.zernike(8, disk)
    column = 0
    for n in range(9):
        for m in range(n % 2, n + 1, 2):
            k = (n - m) // 2
            radial = (-1) ** k * radius**m * eval_jacobi(k, m, 0, 1 - 2 * radius**2)
            for trig in (np.cos, np.sin)[: 1 + (m > 0)]:
                np.testing.assert_allclose(
                    value[:, column], radial * trig(m * azimuth), rtol=0, atol=1e-13
                )
                column += 1
    assert column == value.shape[1] == 45
    assert np.abs(value).max() <= 1 + 1e-13
    for axis in (0, 1):
        step = 1e-5 * np.eye(2)[axis]
        chord = (
            point_cloud.zernike(8, disk + step)[0] - point_cloud.zernike(8, disk - step)[0]
        ) / 2e-5
        np.testing.assert_allclose(slope[..., axis], chord, rtol=0, atol=1e-6)


def test_a_noise_free_point_cloud_gives_the_dome_to_two_micrometers(tmp_path: Path) -> None:
    """What degree 6 leaves of the measured ellipsoid is 0.5 um rms; the normals are within its slope."""
    shape = made(survey_of(tmp_path / "exact.csv", 3000, 0.0, seed=3))
    assert isinstance(shape, Radial)
    assert shape.fit is not None
    assert shape.fit.rms_m < 1e-6
    rays = rays_up(500, 9)
    true = made(MEASURED)
    expected = true.meet(np.zeros(3), rays)
    met = shape.meet(np.zeros(3), rays)
    np.testing.assert_allclose(met, expected, rtol=0, atol=3e-6)
    assert np.abs(shape.inward(met) - true.inward(expected)).max() < 5e-5


def test_a_noisy_point_cloud_gives_the_dome_within_theoretical_error(cloud: dict) -> None:
    """28 terms of 3,000: residuals sigma sqrt(1 - 28/3000), the surface sigma sqrt(28/3000) = 9.7 um rms.

    Four of chi's own sigmas for each: 1 / sqrt(2 * 2972) of the first, 1 / sqrt(2 * 28) of the second.
    """
    shape = made(cloud)
    assert isinstance(shape, Radial)
    assert shape.fit is not None
    lean = 28 / 3000
    residual = shape.fit.rms_m / (1e-4 * np.sqrt(1 - lean))
    assert residual == pytest.approx(1, abs=4 / np.sqrt(2 * 2972))
    true = dome_points_m(3000, 7)
    met = shape.meet(shape.center_m, true - shape.center_m)
    kept = np.isfinite(met[:, 0])
    assert kept.mean() > 0.98  # all but those beyond the least far sector
    apart = np.linalg.norm(met[kept], axis=1) - np.linalg.norm(true[kept], axis=1)
    assert np.sqrt(np.mean(apart**2)) / (1e-4 * np.sqrt(lean)) == pytest.approx(
        1, abs=4 / np.sqrt(56)
    )
    # The greatest of 3,000 normal deviates is 3.2 to 5 sigma but once in a thousand.
    assert 3.0e-4 < shape.fit.max_residual_m < 5.0e-4
    assert shape.fit.max_residual_m == np.abs(shape.fit.residual_m).max()


def test_a_cloud_s_nearest_ellipsoid_is_the_dome_s_within_noise(cloud: dict) -> None:
    """A cap determines the axes poorly but the position of the ellipsoid's surface well."""
    believed = made(cloud, rim_deg=38).nearest_ellipsoid()
    assert believed.rms_m < 3e-5
    met = (
        made(MEASURED).meet(np.zeros(3), rays_up(500, 4)) - believed.center_m
    ) / believed.semi_axes_m
    size = np.linalg.norm(met, axis=1)
    apart_m = (size - 1) * size / np.linalg.norm(met / believed.semi_axes_m, axis=1)
    assert np.sqrt(np.mean(apart_m**2)) < 1e-4 * np.sqrt(28 / 3000) * 1.5


def test_the_surface_of_a_cloud_ends_with_its_points(cloud: dict) -> None:
    angle = np.radians([39.0, 40.5, 42.0])
    rays = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    assert list(np.isnan(made(cloud).meet(np.zeros(3), rays)[:, 0])) == [False, False, True]


def test_a_scene_flies_under_a_surveyed_dome(cloud: dict) -> None:
    loaded = loader.load(
        "afit_simsat",
        {
            "light.surface": f"{{kind: surveyed, file: {cloud['file']}, unit: mm}}",
            "light.layout.cap_deg": "27",
        },
    )
    assert loaded.light.surface == TypeAdapter(light.AnySurface).validate_python(cloud)
    shape = build_surface(loaded.light.surface)
    assert shape.meet(np.zeros(3), UP)[0, 2] == pytest.approx(48 * INCH_M, abs=1e-4)


DRAWN: dict[str, dict[str, Any]] = {name: KINDS[name] | MOVED for name in KINDS}
DRAWN |= {
    "rimmed": MEASURED | {"rim_height": "36.66 in"},
    "narrow": MEASURED | {"rim_deg": 20},
}
DRAWN |= {
    "panel": FLAT | MOVED | {"width": "30 in", "height": "20 in"},
    "short vault": VAULT | {"length": "1 m"},
}


@pytest.mark.parametrize("name", DRAWN)
def test_the_drawn_mesh_is_on_the_surface(name: str) -> None:
    """Every corner of the stage's sheet is one of the surface, within its rim."""
    shape = made(DRAWN[name])
    sheet = mjcf_export.shell_m(shape, 0.3)
    own = (sheet.reshape(-1, 3) - shape.center_m) @ shape.lab_from_own.as_matrix()
    assert np.abs(shape.level_and_gradient(own)[0]).max() < 1e-12
    assert shape.within(own).all()


@pytest.mark.parametrize("name", ["rimmed", "narrow", "panel"])
def test_the_drawn_mesh_extends_to_the_rim(name: str) -> None:
    """Half a degree beyond the last ring the surface has ended."""
    shape = made(DRAWN[name])
    last = mjcf_export.shell_m(shape, 0.6)[-1]
    beyond = last / np.linalg.norm(last, axis=1, keepdims=True) - [0.0, 0.0, 0.017]
    assert np.isnan(shape.meet(np.zeros(3), beyond)[:, 0]).all()


# Faulty keys


def complaint(more: str) -> str:
    with pytest.raises(InputError) as refused:
        build_surface(loader.load("afit_simsat", {"light.surface": more}).light.surface)
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize(
    ("surface", "says"),
    [
        ("{kind: torus}", "light.surface.kind: unknown kind 'torus'; .*allowed: sphere, ellipsoid, flat"),
        ("{kind: [flat]}", r"light.surface.kind: unknown kind .*\['flat'\]"),
        ("{apex: 1 m}", "light.surface: kind is missing"),
        ("{kind: sphere, apex: 1 m}", "light.surface.radius: missing"),
        ("{kind: flat, apex: 1 m, radius: 1 m}", "light.surface.radius: unknown key; .*allowed: .*width, height"),
        ("{kind: sphere, apex: 1 m, radius: 1 m, tilt_deg: [50, 0]}", "tilt_deg.0: 50 is not .* less than or equal"),
        ("{kind: sphere, apex: 1 m, radius: 1 m, error: -1 mm}", "light.surface.error: '-1 mm' is not allowed"),
        ("{kind: sphere, apex: 1 m, radius: 1 m, rim_deg: 200}", "light.surface.rim_deg: 200 is not allowed"),
        (
            "{kind: sphere, apex: 1 m, radius: 1 m, rim_deg: 40, rim_height: 80 cm}",
            "light.surface: rim_height and rim_deg conflict; allowed: one of the two",
        ),
        (
            "{kind: ellipsoid, apex: 1 m, semi_axes: [1 m, 1 m, 1 m], rim_height: 1 m}",
            "light.surface.rim_height: 1 m is not below the apex",
        ),
        (
            "{kind: sphere, apex: 1 m, radius: 1 m, wall: {thickness_apex: 5 mm, thickness_base: 20 cm, base_deg: 40}}",
            "light.surface: a wall of 0.2 m is too thick; allowed: up to a tenth of the radius",
        ),
        (
            "{kind: sphere, apex: 1 m, radius: 1 m, wall: {thickness_apex: 5 mm, base_deg: 40}}",
            "light.surface.wall.thickness_base: missing",
        ),
        ("{kind: cylinder, axis: w, apex: 1 m, radius: 1 m}", "light.surface.axis: 'w' is not .* 'x', 'y' or 'z'"),
        ("{kind: cylinder, axis: z, apex: 1 m, radius: 1 m}", "light.surface: a cylinder about z requires length"),
        (
            "{kind: cylinder, axis: z, apex: 1 m, radius: 1 m, length: 1 m, offset: [2 m, 0 m, 0 m]}",
            "light.surface: the bearing's center is outside of the dome; check apex, sizes and offset",
        ),
        (
            "{kind: flat, apex: 1 m, width: 1 m, offset: [90 m, 0 m, 0 m]}",
            "light.surface: no part of it is above the bearing; check rim, width",
        ),
        ("{kind: surveyed, file: no.csv, unit: mm}", "light.surface.file: 'no.csv' is not a file; allowed: a .csv"),
        ("{kind: surveyed, file: pyproject.toml, unit: mm}", "light.surface.file: 'pyproject.toml' is not a file"),
    ],
)  # fmt: skip
def test_a_wrong_surface_is_refused_in_one_line_with_key_and_allowed_values(
    surface: str, says: str
) -> None:
    assert re.search(says, complaint(surface))


def surveyed_complaint(path: Path, more: str = "") -> str:
    return complaint(f"{{kind: surveyed, file: '{path}', unit: mm{more}}}")


def test_a_file_that_is_not_a_point_cloud_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    for text in (
        "",
        "x,y,z\n",
        "x,y,z\n1,2\n3,4\n",
        "x,y,z\n1,2,three\n",
        "x,y,z\n1,2,nan\n",
        "x,y,z\n1,2,3\n1,2\n",
    ):
        path.write_text(text)
        assert re.match(
            rf"light\.surface\.file: {path}(: 0 points|, line \d: )", surveyed_complaint(path)
        )


def test_points_that_determine_no_smooth_dome_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    rng = np.random.default_rng(1)
    good = dome_points_m(500, 1)
    written(path, good[:83])
    assert "83 points; allowed: at least 84 for degree 6" in surveyed_complaint(path)
    written(path, good * [1, 1, 0] + [0, 0, 1.2])
    assert (
        "the points lie in a plane or on a line; allowed: points of a dome"
        in surveyed_complaint(path)
    )
    written(path, good[good[:, 0] > 0])
    assert (
        "parts of the dome have no points; allowed: points all around +z"
        in surveyed_complaint(path)
    )
    written(path, good + 3e-3 * rng.standard_normal(good.shape))
    assert re.search(
        r"0.00\d+ m rms off .*worst 0.0\d+ m\); allowed: rms_limit 0.001 m",
        surveyed_complaint(path),
    )
    assert made(
        {"kind": "surveyed", "file": str(path), "unit": "mm", "rms_limit": "5 mm"}
    ).inside(np.zeros(3))
    written(path, good)
    assert "do not reach the rim; allowed: a rim within 41." in surveyed_complaint(
        path, ", rim_deg: 60"
    )
    assert "do not reach the rim" in surveyed_complaint(path, ", rim_height: 60 cm")
    far = "check file, unit, offset"
    assert far in surveyed_complaint(path, ", offset: [0 m, 0 m, -2 m]")


def test_every_kind_of_part_has_its_surface() -> None:
    parts, _ = get_args(light.AnySurface)
    kinds = [part.model_fields["kind"].annotation.__args__ for part in get_args(parts)]
    assert kinds == [(kind,) for kind in SURFACES]


@pytest.mark.parametrize(
    ("rim_deg", "mean_z"),
    [(None, 1 / 2), (80.0, (1 + np.cos(np.radians(80))) / 2), (40.0, None)],
)
def test_samples_are_uniform_in_solid_angle_down_to_rim_or_horizon(
    rim_deg: float | None, mean_z: float | None
) -> None:
    """On a sphere about the bearing; z is then uniform, from the lowest direction's to 1 (Archimedes)."""
    ball = {"kind": "sphere", "apex": "1 m", "radius": "1 m"}
    z = made(ball, **({} if rim_deg is None else {"rim_deg": rim_deg})).samples_m()[:, 2]
    wanted = (1 + np.cos(np.radians(40))) / 2 if mean_z is None else mean_z
    assert z.mean() == pytest.approx(wanted, abs=1e-9)
    assert np.var(z) == pytest.approx((2 * (1 - wanted)) ** 2 / 12, rel=1e-3)  # of 60 rings
