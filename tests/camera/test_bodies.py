"""Discs in a frame against a hundred thousand single points and against their total light."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.camera import discs as drawing
from skysim.camera.discs import Exposed, convolved, points_of
from skysim.camera.optics import Optics
from skysim.camera.render import Window, render
from skysim.core.types import Floats, Mount, Trajectory
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources.bodies import BodyLight, body_light
from skysim.sources.body_discs import light_map
from skysim.sources.ephemeris import observe_from, place
from skysim.sources.photometry import Band

DATE = datetime.datetime(2012, 6, 24, 21)  # the Moon at a phase angle of 118 degrees
BAND = Band.from_efficiency(0.5)
SIZE = 120
REST = (0.0, 0.0, 0.0)


def camera(focal_px: float, psf: dict[str, object]) -> CameraConfig:
    """A small chip whose lens has this focal length."""
    base = loader.load(
        "shefex2", {"camera.width_px": str(SIZE), "camera.height_px": str(SIZE)}
    ).camera
    kind = type(base.psf).model_validate(psf) if psf["kind"] == base.psf.kind else base.psf
    return base.model_copy(update={"focal_length_m": focal_px * base.pixel_m, "psf": kind})


def toward(direction: Floats, off_px: tuple[float, float], optics: Optics) -> Rotation:
    """lab_from_cam that images a direction at this offset, px, from the chip's center."""
    z = direction
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    centered = Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))
    tilt = np.array(off_px) / optics.camera.focal_px
    return (
        centered
        * Rotation.from_rotvec([tilt[1], -tilt[0], 0.0])
        * Rotation.from_rotvec([0.0, 0.0, 0.4])
    )


def exposed_at(
    optics: Optics,
    direction: Floats,
    off_px: tuple[float, float],
    rate: Floats,
    row_s: float = 0.0,
) -> Exposed:
    attitude = toward(direction, off_px, optics)
    t_s = np.linspace(0.0, 1.0, 101)
    turn = Rotation.from_rotvec(rate * (t_s - 0.5)[:, None])
    motion = Trajectory(t_s, attitude * turn, np.tile(rate, (len(t_s), 1)))
    return Exposed(
        optics,
        motion,
        Mount(np.zeros(3), Rotation.identity()),
        Window(0.48, 0.04, row_s, optics.camera.height_px),
    )


def light(name: str, date: datetime.datetime = DATE) -> BodyLight:
    seen = observe_from(date, SiteConfig())
    return body_light(name, place(name, seen), seen.tt_jd, BAND)


def brute_force(body: BodyLight, exposed: Exposed, across: int = 400) -> Floats:
    """The disc as points on a fine lattice, each rendered as a star."""
    axis = (np.arange(across) + 0.5) * (2 / across) - 1
    x, y = np.meshgrid(axis, axis)
    share = light_map(body.surface, axis)
    lit = share > 0
    image = np.zeros((SIZE, SIZE))
    render(image, points_of(body, np.column_stack([x[lit], y[lit]]), share[lit]), *exposed)
    return image


GAUSS = {"kind": "gaussian", "sigma_px": 0.7}
SHARP = {"kind": "gaussian", "sigma_px": 0.3}
SLEW = np.array([0.02, 0.05, 0.0])
CASES = {
    "still": (2500.0, GAUSS, np.zeros(3), 0.0),
    "sharp": (2500.0, SHARP, np.zeros(3), 0.0),
    "small": (1000.0, GAUSS, np.zeros(3), 0.0),
    "large": (9000.0, GAUSS, np.zeros(3), 0.0),
    "streak": (2500.0, GAUSS, SLEW, 0.0),
    "rolling": (2500.0, GAUSS, SLEW, 2e-4),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ["moon", "sun"])
def test_a_disc_equals_the_sum_of_its_points(name: str, case: str) -> None:
    """Within a few thousandths of the brightest pixel; the Moon's limb is a cusp, which needs many points.

    Rows that move on smooth it.
    """
    focal_px, psf, rate, row_s = CASES[case]
    optics = Optics.from_camera(camera(focal_px, psf))
    body = light(name)
    exposed = exposed_at(optics, body.place.direction, (0.3, -0.45), rate, row_s)
    image = np.zeros((SIZE, SIZE))
    (truth,) = drawing.render_bodies(image, [body], exposed)
    wanted = brute_force(body, exposed, {"large": 600, "rolling": 200}.get(case, 400))
    assert np.abs(image - wanted).max() < (6e-3 if name == "moon" else 2.5e-3) * wanted.max()
    assert image.sum() == pytest.approx(wanted.sum(), rel=1e-4)
    assert truth.electrons[0] == pytest.approx(wanted.sum(), rel=1e-4)


def test_small_discs_and_points_keep_their_light_and_center() -> None:
    """Venus of 51" at a phase angle of 146 degrees: 2.5 px, then 0.12 px."""
    body = light("venus", datetime.datetime(2012, 5, 20, 21))
    for focal_px, limit in ((10_000.0, 5e-3), (500.0, 5e-3)):
        optics = Optics.from_camera(camera(focal_px, GAUSS))
        exposed = exposed_at(optics, body.place.direction, (0.3, -0.45), np.zeros(3))
        image = np.zeros((SIZE, SIZE))
        (truth,) = drawing.render_bodies(image, [body], exposed)
        wanted = brute_force(body, exposed, 100)
        assert np.abs(image - wanted).max() < limit * wanted.max()
        columns = wanted.sum(axis=0) @ np.arange(SIZE) / wanted.sum()
        assert truth.flux_xy_px[0, 0] == pytest.approx(columns, abs=2e-3)
        assert truth.electrons[0] == pytest.approx(wanted.sum(), rel=1e-4)


def test_a_body_s_electrons_follow_from_its_magnitude() -> None:
    """A disc gives what a star of its flux gives through the same lens."""
    optics = Optics.from_camera(camera(2500.0, GAUSS))
    body = light("moon")
    exposed = exposed_at(optics, body.place.direction, (0.0, 0.0), np.zeros(3))
    image = np.zeros((SIZE, SIZE))
    drawing.render_bodies(image, [body], exposed)
    assert image.sum() == pytest.approx(
        body.flux_e_s_m2 * optics.collecting_m2 * 0.04, rel=1e-4
    )


def test_a_disc_half_off_the_chip_is_cut_at_the_border() -> None:
    optics = Optics.from_camera(camera(2500.0, GAUSS))
    body = light("sun")
    exposed = exposed_at(optics, body.place.direction, (SIZE / 2, 0.0), np.zeros(3))
    image = np.zeros((SIZE, SIZE))
    (truth,) = drawing.render_bodies(image, [body], exposed)
    share = image.sum() / (body.flux_e_s_m2 * optics.collecting_m2 * 0.04)
    assert 0.1 < share < 0.9
    assert image.sum() == pytest.approx(brute_force(body, exposed, 200).sum(), rel=1e-3)
    assert truth.electrons[0] == pytest.approx(image.sum(), rel=1e-9)
    beyond = exposed_at(optics, body.place.direction, (2 * SIZE, 0.0), np.zeros(3))
    assert drawing.render_bodies(image, [body], beyond) == []


def test_the_moon_eclipses_the_sun() -> None:
    """2017 August 21 at Carbondale: total from 18:20:10 to 18:22:50 UT, and less light before."""
    site = SiteConfig(latitude_deg=37.727, longitude_deg=-89.217)
    optics = Optics.from_camera(camera(2500.0, GAUSS))
    left = []
    for minute in (0, 10, 18, 21.5):
        seen = observe_from(
            datetime.datetime(2017, 8, 21, 18) + datetime.timedelta(minutes=minute), site
        )
        sun, moon = (
            body_light(name, place(name, seen), seen.tt_jd, BAND) for name in ("sun", "moon")
        )
        exposed = exposed_at(optics, sun.place.direction, (0.0, 0.0), np.zeros(3))
        image = np.zeros((SIZE, SIZE))
        drawing.render_bodies(image, [sun, moon], exposed)
        left.append(image.sum() / (sun.flux_e_s_m2 * optics.collecting_m2 * 0.04))
    assert left == sorted(left, reverse=True)
    assert left[0] > 0.1
    assert left[-1] < 1e-6


def test_a_star_behind_the_moon_is_hidden() -> None:
    """Stars within its radius of 0.26 deg are hidden, in addition to those behind vehicle parts."""
    moon = light("moon")
    stars = points_of(moon, np.array([[0.0, 0.0], [0.7, 0.7], [0.0, 1.01]]))
    hidden = drawing.behind([moon], None)
    assert hidden is not None
    assert hidden(stars.place).tolist() == [True, True, False]
    by_both = drawing.behind([moon], lambda place: np.array([False, False, True]))
    assert by_both is not None
    assert by_both(stars.place).all()
    assert drawing.behind([], None) is None


def test_a_disc_does_not_darken_the_surrounding_pixels() -> None:
    """Rounding of Fourier transforms beside a bright disc must not make sums of pixels negative."""
    light = np.zeros((40, 40))
    patches = np.zeros((2, 2, 9, 9))
    light[10:30, 10:30] = 1e12
    patches[:, :, 4, 4] = 1.0
    image = convolved(light, patches)
    assert image.min() == 0.0
    assert image.sum() == pytest.approx(light.sum(), rel=1e-12)
