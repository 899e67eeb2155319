"""Light on the chip: energy, position, shape and smear against independent integrals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import erf
from scipy.stats import ncx2

from skysim.camera import projection
from skysim.camera import render as rendering
from skysim.camera.detector import Detector, expose
from skysim.camera.optics import Optics
from skysim.camera.render import Window, render
from skysim.core.errors import InputError
from skysim.core.types import Floats, Mount, Sources, SourceTruth, Trajectory
from skysim.dynamics.jitter import Vibration
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig
from skysim.scene.sections.leds import CosineLobeConfig
from skysim.scene.sections.motion import JitterLineConfig, MotionConfig
from skysim.sources.dome.led import Emitter
from skysim.sources.photometry import SUN, Band, led_strength_e_s_sr, star_flux_e_s_m2
from skysim.sources.stars import steady_points

FLAT = Band.from_efficiency(1.0)


def with_sources(parts: Sequence[Sources]) -> Sources:
    """All sources of several sets without motion, in their order."""
    columns = {name: [getattr(part, name) for part in parts] for name in Sources.__slots__}
    return Sources(
        **{name: np.concatenate(own) for name, own in columns.items() if own[0] is not None}
    )


def lens_of(collecting_m2: float = 1.0, **changes: Any) -> Optics:
    """A camera of 64 x 48 pixels, 2,500 px of focal length, sigma .7 px, its pupil taken for a square meter."""
    part = {
        "width_px": 64,
        "height_px": 48,
        "pixel": "10 um",
        "focal_length": "25 mm",
        "f_number": 8,
        "psf": {"kind": "gaussian", "sigma_px": 0.7},
        "detector": {
            "quantum_efficiency": 0.5,
            "full_well_e": 4e4,
            "gain_e_dn": 10,
            "bits": 12,
        },
    }
    return replace(
        Optics.from_camera(CameraConfig.model_validate(part | changes)),
        collecting_m2=collecting_m2,
    )


def blurred(sigma_px: float, radius_px: float = 0.0) -> Optics:
    """The same camera with another Gaussian, or a disk with a Gaussian edge."""
    kind = {"kind": "disk", "radius_px": radius_px} if radius_px else {"kind": "gaussian"}
    return lens_of(psf=kind | {"sigma_px": sigma_px})


LENS = lens_of()
# Camera axes are the body's: it looks along lab z.
AT_CENTER = Mount(np.zeros(3), Rotation.identity())


def turning(rate_rad_s: Floats | list[float], start: Rotation | None = None) -> Trajectory:
    """Three seconds at a constant rate about a fixed axis, through `start` in the middle of the first."""
    t = np.linspace(0, 3, 31)
    rate = np.array(rate_rad_s, float)
    turned = Rotation.from_rotvec((t[:, None] - 0.5) * rate)
    return Trajectory(t, (start or Rotation.identity()) * turned, np.tile(rate, (31, 1)))


STILL = turning([0, 0, 0])


def light(**fields: object) -> Sources:
    """One star on the boresight with one photon per second and square meter, unless given otherwise."""
    made = {
        "id": np.array([7]),
        "place": np.array([[0.0, 0.0, 1.0, 0.0]]),
        "normal": np.zeros((1, 3)),
        "period_s": np.ones(1),
        "on_s": np.ones(1),
        "clock": np.zeros(1, int),
        "strength": np.ones(1),
        "magnitude": np.full(1, np.nan),
    }
    zero = {name: np.zeros(1) for name in ("radius_m", "start_s")}
    return Sources(**zero | made | {key: np.array(value) for key, value in fields.items()})


def star_at(x_px: float, y_px: float, electrons: float = 1.0, lens: Optics = LENS) -> Sources:
    """A star whose light through a square meter, in a second, is `electrons`."""
    place = np.array(
        [*(np.array([x_px, y_px]) - lens.camera.center_px) / lens.camera.focal_px, 1]
    )
    place /= np.linalg.norm(place)
    return light(place=[[*place, 0.0]], strength=[electrons / place[2]])


def led_at(
    x_m: float, y_m: float, z_m: float, radius_m: float = 1e-3, **fields: object
) -> Sources:
    """A Lambertian LED that faces straight down."""
    return light(
        place=[[x_m, y_m, z_m, 1.0]],
        normal=[[0.0, 0.0, -1.0]],
        radius_m=[radius_m],
        **fields,
    )


def draw(
    source: Sources,
    window: Window,
    trajectory: Trajectory | None = None,
    lens: Optics = LENS,
    mount: Mount = AT_CENTER,
    emitter: Emitter | None = None,
) -> tuple[Floats, SourceTruth]:
    image = np.zeros((lens.camera.height_px, lens.camera.width_px))
    return image, render(image, source, lens, trajectory or STILL, mount, window, emitter)


def shot(
    source: Sources,
    trajectory: Trajectory | None = None,
    lens: Optics = LENS,
    mount: Mount = AT_CENTER,
    exposure_s: float = 1.0,
) -> tuple[Floats, SourceTruth]:
    """An exposure whose middle is at 0.5 s."""
    return draw(source, Window(0.5 - exposure_s / 2, exposure_s), trajectory, lens, mount)


def moments(image: Floats) -> tuple[Floats, Floats]:
    """Mean place and variance along x and y."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    mean = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    var = (
        np.array([(image * (x - mean[0]) ** 2).sum(), (image * (y - mean[1]) ** 2).sum()])
        / image.sum()
    )
    return mean, var


# Energy


@pytest.mark.parametrize("sigma_px", [0.2, 0.7, 2.0])
@pytest.mark.parametrize("xy", [(31.0, 23.0), (30.77, 24.31), (31.5, 23.5)])
def test_a_still_star_keeps_every_electron(xy: tuple[float, float], sigma_px: float) -> None:
    image, seen = shot(star_at(*xy, 1e4), lens=blurred(sigma_px))
    assert image.sum() == pytest.approx(1e4, rel=1e-8)  # 6.5 sigma hold all but 1e-10 an axis
    assert seen.electrons[0] == pytest.approx(image.sum(), rel=1e-12)
    assert seen.peak_e[0] == image.max()


@pytest.mark.parametrize("radius_px", [0.05, 0.3, 0.7, 1.5, 2.0, 2.2, 3.0, 6.0, 12.0])
@pytest.mark.parametrize("sigma_px", [0.6, 1.0])
def test_a_disk_of_any_size_keeps_every_electron(radius_px: float, sigma_px: float) -> None:
    lens = blurred(sigma_px, radius_px)
    image, _ = shot(star_at(30.83, 23.37, 1e4), lens=lens)
    assert image.sum() == pytest.approx(1e4, rel=1e-5)


def test_a_smeared_star_keeps_every_electron() -> None:
    """The star moves 20 px across; the cosine of its angle is 1 to 1e-5."""
    image, seen = shot(star_at(31.5, 23.5, 1e4), turning([0, 20 / 2500, 0]))
    assert seen.streak_px[0] == pytest.approx(20, abs=0.01)
    assert image.sum() == pytest.approx(1e4, rel=1.5e-5)


def test_a_smeared_disk_keeps_every_electron() -> None:
    lens = blurred(0.7, 5.0)
    image, _ = shot(star_at(31.5, 23.5, 1e4), turning([8 / 2500, 12 / 2500, 0]), lens)
    assert image.sum() == pytest.approx(1e4, rel=1e-4)


def test_a_star_on_the_border_leaves_half_of_itself_outside() -> None:
    image, seen = shot(star_at(-0.5, 20.0, 1e4))
    assert image.sum() == pytest.approx(5e3, rel=1e-8)
    assert seen.electrons[0] == pytest.approx(5e3, rel=1e-8)
    np.testing.assert_allclose(seen.xy_px, [[-0.5, 20.0]], rtol=0, atol=1e-10)


def test_images_of_lights_add() -> None:
    near = star_at(20.2, 20.9, 1e3)
    far = star_at(22.0, 21.0, 2e3)
    both = with_sources([near, far])
    np.testing.assert_allclose(shot(both)[0], shot(near)[0] + shot(far)[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "source",
    [
        light(place=[[0.0, 0.0, -1.0, 0.0]]),
        led_at(0, 0, -1.0),
        light(place=[[0, 0, 1.0, 1]], normal=[[0, 0, 1.0]], radius_m=[1e-3]),
        star_at(200.0, 20.0),
        light().take(np.zeros(1, bool)),
    ],
    ids=["star behind", "led behind", "led turned away", "star outside", "no light at all"],
)
def test_invisible_lights_add_no_electrons(source: Sources) -> None:
    image, seen = shot(source)
    assert image.shape == (48, 64)
    assert not image.any()
    assert len(seen.id) == 0


# Place and shape


@pytest.mark.parametrize("x_px", np.linspace(30.0, 31.0, 6))
def test_a_still_star_s_centroid_is_its_projected_pixel(x_px: float) -> None:
    image, seen = shot(star_at(x_px, 20.3), lens=blurred(1.2))
    np.testing.assert_allclose(seen.xy_px, [[x_px, 20.3]], rtol=0, atol=1e-10)
    np.testing.assert_allclose(seen.flux_xy_px, seen.xy_px, rtol=0, atol=1e-12)
    # Cut at 6.5 sigma.
    np.testing.assert_allclose(moments(image)[0], [x_px, 20.3], rtol=0, atol=1e-8)


@pytest.mark.parametrize("sigma_px", [0.2, 0.25, 0.3, 0.4, 0.5, 0.6])
def test_the_pixel_grid_shifts_the_centroid_by_the_s_curve(sigma_px: float) -> None:
    """First harmonic exp(-2 pi^2 sigma^2) / pi over the wide window (reference §3)."""
    phase = np.arange(16) / 16
    lens = blurred(sigma_px)
    bias = np.array(
        [moments(shot(star_at(30 + p, 20.0), lens=lens)[0])[0][0] - 30 - p for p in phase]
    )
    amplitude = -2 * np.mean(bias * np.sin(2 * np.pi * phase))
    assert amplitude == pytest.approx(np.exp(-2 * np.pi**2 * sigma_px**2) / np.pi, abs=1e-6)


@pytest.mark.parametrize(("sigma_px", "fine"), [(0.5, 60), (0.7, 50), (1.3, 30)])
def test_a_star_is_a_gaussian_integrated_over_each_pixel(sigma_px: float, fine: int) -> None:
    """Midpoints of fine x fine squares a pixel, whose error is (1 / fine sigma)^2 / 24."""
    image, _ = shot(star_at(30.37, 22.81), lens=blurred(sigma_px))
    sub = (np.arange(fine) + 0.5) / fine - 0.5
    x, y = (np.arange(n)[:, None] + sub for n in (64, 48))
    density = [
        np.exp(-((axis - at) ** 2) / 2 / sigma_px**2) for axis, at in ((x, 30.37), (y, 22.81))
    ]
    columns, rows = (d.mean(axis=1) / np.sqrt(2 * np.pi) / sigma_px for d in density)
    np.testing.assert_allclose(
        image,
        np.outer(rows, columns),
        rtol=0,
        atol=2 * image.max() / (fine * sigma_px) ** 2 / 24,
    )


def disk_image(x_px: float, y_px: float, radius_px: float, sigma_px: float) -> Floats:
    """The true convolution: a bivariate normal's probability of falling in a circle is a non-central chi-square's;
    its mean over a pixel from 5 x 5 places by Gauss-Legendre."""
    node, weight = np.polynomial.legendre.leggauss(5)
    x, y = np.meshgrid(np.arange(64.0), np.arange(48.0))
    total = np.zeros((48, 64))
    for dx, wx in zip(node / 2, weight / 2, strict=True):
        for dy, wy in zip(node / 2, weight / 2, strict=True):
            offset2 = ((x + dx - x_px) ** 2 + (y + dy - y_px) ** 2) / sigma_px**2
            total += wx * wy * ncx2.cdf((radius_px / sigma_px) ** 2, 2, offset2)
    return total / (np.pi * radius_px**2)


@pytest.mark.slow
@pytest.mark.parametrize("radius_px", [0.3, 1.0, 2.0, 2.9, 3.3, 5.0, 10.4])
def test_a_disk_is_the_convolution_of_disk_and_gaussian(radius_px: float) -> None:
    lens = blurred(1.0, radius_px)
    image, _ = shot(star_at(30.83, 23.37), lens=lens)
    true = disk_image(30.83, 23.37, radius_px, 1.0)
    assert np.abs(image - true).max() < 5e-4 * true.max()


@pytest.mark.parametrize("radius_px", [1.5, 2.9, 3.3, 10.4])
def test_a_disk_s_centroid_is_its_projected_pixel(radius_px: float) -> None:
    lens = blurred(1.0, radius_px)
    image, _ = shot(star_at(30.83, 23.37), lens=lens)
    np.testing.assert_allclose(moments(image)[0], [30.83, 23.37], rtol=0, atol=1e-5)


@pytest.mark.parametrize(("pixel_um", "distance_in"), [(4.0, 33), (4.2, 33), (4.2, 66)])
def test_an_led_s_image_has_the_diameter_of_thin_geometry(
    pixel_um: float, distance_in: float
) -> None:
    """2 mm through 35 mm: 2 mm x f / (u - f) / pixel, in focus. Read off the image's second moments: the variance of
    a disk is a quarter of its radius squared, the blur's and the pixel's are added."""
    distance_m = distance_in * 0.0254
    psf = {"kind": "gaussian", "sigma_px": 1.0}
    lens = lens_of(
        pixel=f"{pixel_um} um", focal_length="35 mm", focus=f"{distance_in} in", psf=psf
    )
    image, _ = shot(led_at(0, 0, distance_m), lens=lens)
    radius_px = 2 * np.sqrt(moments(image)[1] - 1 - 1 / 12)
    # Reference §2: 20.8 px at 33 in, 4.2 um.
    wanted = 2e-3 * 35e-3 / (distance_m - 35e-3) / (pixel_um * 1e-6)
    # Sizes are rounded to 0.01 px.
    np.testing.assert_allclose(2 * radius_px, wanted, rtol=0, atol=0.01)


# Smear


def test_the_smear_of_shefex_matches_the_reference() -> None:
    # Reference H2: 4.41 px at 2 deg/s in 50 ms, 8.8 px at 4 deg/s.
    lens = lens_of(pixel="9.9 um")
    for rate_deg_s, length_px in ((2, 4.41), (4, 8.81)):
        _, seen = shot(
            light(), turning([0, np.radians(rate_deg_s), 0]), lens, exposure_s=0.05
        )
        assert seen.streak_px[0] == pytest.approx(length_px, abs=0.01)


@pytest.mark.parametrize("length_px", [0.1, 1.0, 4.41, 15.0])
def test_a_smeared_star_has_its_path_s_length_and_is_centered_at_mid_exposure(
    length_px: float,
) -> None:
    """A uniform line of length L has the variance L^2 / 12 along itself and none across."""
    image, seen = shot(star_at(31.5, 23.5), turning([0, length_px / 2500, 0]))
    mean, variance = moments(image)
    assert seen.streak_px[0] == pytest.approx(length_px, rel=1e-4)
    np.testing.assert_allclose(seen.xy_px, [[31.5, 23.5]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(seen.flux_xy_px, [[31.5, 23.5]], rtol=0, atol=1e-9)
    # The S-curve of sigma .7 is 2e-5.
    np.testing.assert_allclose(mean, [31.5, 23.5], rtol=0, atol=1e-4)
    along = 0.7**2 + 1 / 12 + length_px**2 / 12
    # The same of the second moment.
    np.testing.assert_allclose(variance, [along, 0.7**2 + 1 / 12], rtol=0, atol=2e-4)


def test_stars_move_opposite_to_the_camera() -> None:
    """A right-handed rotation about body y (down) moves the boresight to +x and stars to the left."""
    _, early = draw(light(), Window(0.0, 0.1), turning([0, 0.004, 0]))
    _, late = draw(light(), Window(0.9, 0.1), turning([0, 0.004, 0]))
    assert early.xy_px[0, 0] - late.xy_px[0, 0] == pytest.approx(0.9 * 0.004 * 2500, rel=1e-4)
    assert early.xy_px[0, 0] > 31.5 > late.xy_px[0, 0]


def test_a_roll_moves_stars_by_radius_times_angle_and_keeps_the_boresight() -> None:
    _, middle = shot(light(), turning([0, 0, 0.2]))
    _, aside = shot(star_at(31.5 + 20, 23.5), turning([0, 0, 0.2]))
    assert middle.streak_px[0] == pytest.approx(0, abs=1e-9)
    assert aside.streak_px[0] == pytest.approx(20 * 0.2, rel=1e-3)


@pytest.mark.parametrize(
    ("length_px", "ratio"), [(2, 0.78), (3, 0.61), (4.41, 0.43), (8.8, 0.22), (15, 0.13)]
)
def test_the_peak_of_a_smeared_star_matches_the_line_integral(
    length_px: float, ratio: float
) -> None:
    # Reference §3, sigma .7: peak relative to the still star's.
    def share(x: float) -> float:
        return float(erf((0.5 - x) / 0.7 / np.sqrt(2)) + erf((0.5 + x) / 0.7 / np.sqrt(2)))

    exact = quad(share, -length_px / 2, length_px / 2)[0] / length_px / share(0)
    _, still = shot(star_at(31.0, 23.0))
    _, smeared = shot(star_at(31.0, 23.0), turning([0, length_px / 2500, 0]))
    measured = float(smeared.peak_e[0] / still.peak_e[0])
    # Parts of a quarter pixel: (0.25 / 0.7)^2 / 24 at the ends.
    assert measured == pytest.approx(exact, rel=2e-3)
    assert measured == pytest.approx(ratio, abs=0.03)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 77.0])
def test_a_streak_is_the_integral_of_its_moments(angle_deg: float) -> None:
    """Ten thousand still stars along the line, added up."""
    length_px = 11.3
    steps = 10_000
    across = np.array([-np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg)), 0])
    image, _ = shot(star_at(31.5, 23.5), turning(across * length_px / 2500))
    along = length_px * ((np.arange(steps) + 0.5) / steps - 0.5)
    direction = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    columns, rows = (
        np.diff(erf((np.arange(n + 1)[:, None] - 0.5 - at) / 0.7 / np.sqrt(2)), axis=0) / 2
        for n, at in ((64, 31.5 + along * direction[0]), (48, 23.5 + along * direction[1]))
    )
    true = rows @ columns.T / steps
    assert np.abs(image - true).max() < 5e-4 * true.max()
    assert image.sum() == pytest.approx(1, rel=1e-5)


@pytest.mark.parametrize("length_px", [0.9, 3.0, 9.0, 21.0])
@pytest.mark.parametrize("radius_px", [1.0, 2.5, 10.0])
def test_a_smeared_disk_s_integration_has_converged(
    monkeypatch: pytest.MonkeyPatch, radius_px: float, length_px: float
) -> None:
    """With steps of a twentieth the image is the same."""
    path = turning([0.6 * length_px / 2500, 0.8 * length_px / 2500, 0])
    usual, _ = shot(star_at(31.3, 23.1), path, blurred(0.8, radius_px))
    monkeypatch.setattr(rendering, "STEP", rendering.STEP / 20)
    true, _ = shot(star_at(31.3, 23.1), path, blurred(0.8, radius_px))
    assert np.abs(usual - true).max() < 5e-4 * true.max()


def test_halving_the_steps_divides_the_error_by_sixteen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two Gaussian points a piece are exact to the third power: the error falls with the fourth."""

    def streak(step: float) -> Floats:
        monkeypatch.setattr(rendering, "STEP", step)
        return shot(star_at(31.2, 23.1), turning([0.001, 8.0 / 2500, 0]))[0]

    true = streak(0.05)
    coarse, fine = (np.abs(streak(step) - true).max() for step in (1.6, 0.8))
    assert 8 < coarse / fine < 40
    assert fine < 2e-4 * true.max()


def test_a_star_that_sweeps_through_from_outside_the_field_is_not_missed() -> None:
    """At 60 deg/s for half a second the star is 15 degrees out at mid-exposure, on the chip at the beginning:
    from the boresight to the left edge, the light of the integral of the cosine."""
    rate = np.radians(60.0)
    focal = 25e-3 / 9.9e-6
    lens = lens_of(pixel="9.9 um", width_px=659, height_px=493)
    image, seen = draw(light(), Window(0.5, 0.5), turning([0, rate, 0]), lens)
    edge_rad = np.arctan(329.5 / focal)
    assert image.sum() == pytest.approx(np.sin(edge_rad) / rate, rel=1e-3)
    assert len(seen.id) == 1


@pytest.mark.slow
def test_stars_that_cross_the_field_between_two_samples_are_not_missed() -> None:
    """One revolution per second, sampled nine times: every star on the equator gives the same light."""
    around = np.radians(np.arange(0, 360, 7.5))
    stars = [light(place=[[np.sin(a), 0, np.cos(a), 0]]) for a in around]
    ring = with_sources(stars)
    t = np.linspace(0, 3, 3001)
    spin = Trajectory(
        t,
        Rotation.from_rotvec(np.outer(t, [0, 2 * np.pi, 0])),
        np.tile([0, 2 * np.pi, 0], (len(t), 1)),
    )
    lens = lens_of(pixel="250 um", psf={"kind": "gaussian", "sigma_px": 0.7})
    _, seen = draw(ring, Window(1.0, 1.0), spin, lens)
    assert len(seen.id) == len(around)
    np.testing.assert_allclose(seen.electrons, np.median(seen.electrons), rtol=0.02, atol=0)


# LEDs


def test_an_led_s_electrons_match_the_reference() -> None:
    # Reference §2: 0.6 cd, 33 in, 35 mm at f/8, T .85, QE .30: 3.1e7 electrons a millisecond.
    pupil_m2 = np.pi / 4 * (0.035 / 8) ** 2 * 0.85
    lens = lens_of(pupil_m2, pixel="4.2 um", focal_length="35 mm", focus="33 in")
    source = led_at(
        0,
        0,
        33 * 0.0254,
        strength=[float(led_strength_e_s_sr(0.6, "white", Band.from_efficiency(0.30)))],
    )
    image, _ = draw(source, Window(0.1, 1e-3), lens=lens)
    assert image.sum() == pytest.approx(3.1e7, rel=0.02)  # two digits


def test_twice_as_far_is_a_quarter_of_the_light_and_half_the_size() -> None:
    near, far = (shot(led_at(0, 0, z, 2e-3))[0] for z in (0.4, 0.8))
    assert near.sum() / far.sum() == pytest.approx(4, rel=1e-4)
    size = [moments(image)[1] - 0.7**2 - 1 / 12 for image in (near, far)]
    np.testing.assert_allclose(size[0] / size[1], 4, rtol=0, atol=0.02)


def test_an_led_off_the_axis_is_dimmed_by_the_fourth_power_of_the_cosine() -> None:
    """Distance squared, emission and incidence under a flat panel: cos^4; off a dome that faces it, one."""
    lens = lens_of(
        pixel="250 um", psf={"kind": "gaussian", "sigma_px": 0.7}, focus="1 m", f_number=1e3
    )
    on_axis, aside = (
        shot(led_at(x, 0, 1.0, 1e-4), lens=lens)[1].electrons[0] for x in (0.0, 0.2)
    )
    assert aside / on_axis == pytest.approx(np.cos(np.arctan(0.2)) ** 4, rel=1e-6)


@pytest.mark.parametrize("duty", [0.35, 0.5, 0.7])
def test_duty_scales_the_light_of_whole_periods(duty: float) -> None:
    full, dim = (
        shot(
            led_at(0, 0, 1.0, period_s=[1e-3], on_s=[d * 1e-3], start_s=[3e-4]),
            exposure_s=0.01,
        )[0].sum()
        for d in (1.0, duty)
    )
    assert dim / full == pytest.approx(duty, rel=1e-10)


def test_an_exposure_between_pulses_sees_no_light() -> None:
    pulsed = led_at(0, 0, 1.0, period_s=[0.1], on_s=[0.02], start_s=[0.0])
    assert not draw(pulsed, Window(0.13, 0.05))[0].any()
    assert draw(pulsed, Window(0.19, 0.05))[0].sum() == pytest.approx(0.02, rel=1e-3)


def test_a_pulse_marks_where_the_led_was_while_it_shone() -> None:
    """Lit for the first quarter of a sweep of 16 px: three eighths of the sweep from the middle."""
    pulsed = led_at(0, 0, 1.0, 1e-5, period_s=[10.0], on_s=[0.25])
    image, seen = shot(pulsed, turning([0, 16 / 2500, 0]))
    assert moments(image)[0][0] - 31.5 == pytest.approx(6.0, abs=2e-3)
    assert seen.flux_xy_px[0, 0] - seen.xy_px[0, 0] == pytest.approx(6.0, abs=2e-3)


@pytest.mark.parametrize("tilt_deg", [-0.4, 0.1, 0.35])
def test_parallax_matches_a_hand_calculation(tilt_deg: float) -> None:
    """An LED R above the bearing, a camera h above it: after a tilt of a about y the LED stands at
    (-R sin a, 0, R cos a - h) from the camera."""
    radius = 1.2192
    height = 0.381
    angle = np.radians(tilt_deg)
    mount = Mount(np.array([0, 0, height]), Rotation.identity())
    _, seen = shot(
        led_at(0, 0, radius),
        turning([0, 0, 0], Rotation.from_rotvec([0, angle, 0])),
        mount=mount,
    )
    wanted = 31.5 - 2500 * radius * np.sin(angle) / (radius * np.cos(angle) - height)
    np.testing.assert_allclose(seen.xy_px, [[wanted, 23.5]], rtol=0, atol=1e-9)


def test_stars_show_no_parallax() -> None:
    far = Mount(np.array([0.3, -0.2, 0.381]), Rotation.identity())
    np.testing.assert_array_equal(
        shot(star_at(20, 20))[0], shot(star_at(20, 20), mount=far)[0]
    )


def test_a_moving_led_draws_a_dashed_streak() -> None:
    """Five pulses of a third of the time each on a walk of 40 px: five dashes of 2.67 px, 8 px apart."""
    pulsed = led_at(0, 0, 1.0, 1e-6, period_s=[0.2], on_s=[0.2 / 3], start_s=[0.0])
    lens = lens_of(focus="1 m")
    image, seen = shot(pulsed, turning([0, 40 / lens.camera.focal_px, 0]), lens)
    profile = image.sum(axis=0)
    bright = profile > profile.max() / 2
    begin = np.flatnonzero(np.diff(bright.astype(int)) == 1)
    end = np.flatnonzero(np.diff(bright.astype(int)) == -1)
    assert len(begin) == 5
    np.testing.assert_allclose(np.diff(begin), 8, rtol=0, atol=1)
    np.testing.assert_allclose(end - begin, 8 / 3, rtol=0, atol=1)
    assert image.sum() == pytest.approx(1 / 3, rel=2e-4)  # five of five periods, a third each
    dark = profile[begin[1:] - 2]
    assert dark.max() < 0.02 * profile.max()
    assert seen.streak_px[0] == pytest.approx(40, abs=0.02)


# Rolling shutter


def test_a_rolling_shutter_images_static_light_like_a_global_one() -> None:
    rolling, seen = draw(star_at(30.3, 20.8), Window(0.1, 0.5, 1e-3, 48))
    still, other = draw(star_at(30.3, 20.8), Window(0.1, 0.5))
    np.testing.assert_allclose(rolling, still, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        seen.flux_xy_px, other.flux_xy_px, rtol=0, atol=1e-4
    )  # the S-curve


def test_a_rolling_shutter_shears_what_moves() -> None:
    """Every row sees the star where it is at its own time: the speed times the rows' time, to the left."""
    speed_px_s = 200.0
    row_time_s = 2e-3
    image, seen = draw(
        star_at(31.5, 23.5),
        Window(0.45, 1e-3, row_time_s, 48),
        turning([0, speed_px_s / 2500, 0]),
    )
    rows = np.arange(21, 27)
    middle = (image[rows] @ np.arange(64)) / image[rows].sum(axis=1)
    np.testing.assert_allclose(np.diff(middle), -speed_px_s * row_time_s, rtol=0, atol=2e-3)
    when = 0.4505 + 23.5 * row_time_s  # of the row in which it stands
    np.testing.assert_allclose(
        seen.flux_xy_px[0, 0], 31.5 - speed_px_s * (when - 0.5), rtol=0, atol=0.02
    )
    middle_s = 0.45 + (1e-3 + 47 * row_time_s) / 2  # of the frame: the truth's own time
    np.testing.assert_allclose(
        seen.xy_px[0, 0], 31.5 - speed_px_s * (middle_s - 0.5), rtol=0, atol=1e-4
    )


def test_a_rolling_shutter_bands_a_pulsed_led() -> None:
    """A row's light is the time that its own exposure overlaps the pulses, counted here moment by moment."""
    window = Window(0.2, 1.5e-3, 83e-6, 48)
    emitter = led_at(0, 0, 0.4, 2e-3, period_s=[1e-3], on_s=[4e-4], start_s=[2.5e-4])
    pulsed, _ = draw(emitter, window)
    steady, _ = draw(led_at(0, 0, 0.4, 2e-3), window)
    rows = np.flatnonzero(steady.sum(axis=1) > 0.01 * steady.sum(axis=1).max())
    t = (
        window.open_s
        + window.row_time_s * rows[:, None]
        + window.exposure_s * (np.arange(3000) + 0.5) / 3000
    )
    lit = ((t - 2.5e-4) % 1e-3 < 4e-4).mean(axis=1)
    assert np.ptp(lit) > 0.2
    shares = pulsed[rows].sum(axis=1) / steady[rows].sum(axis=1)
    np.testing.assert_allclose(shares, lit, rtol=0, atol=2e-3)


# Any attitude history


@pytest.mark.compiles
def test_jitter_widens_a_star_by_its_own_variance() -> None:
    line = JitterLineConfig(kind="line", frequency_hz=40.0, rms_arcsec=(60.0, 120.0, 0.0))
    shaken = Vibration(MotionConfig(jitter=(line,)), np.random.default_rng(4)).add_to(STILL)
    image, seen = shot(star_at(31.5, 23.5), shaken)  # forty whole periods
    wide = (np.radians([120 / 3600, 60 / 3600]) * 2500) ** 2  # about y it swings along x
    np.testing.assert_allclose(moments(image)[1], 0.7**2 + 1 / 12 + wide, rtol=2e-3, atol=0)
    assert image.sum() == pytest.approx(1, rel=1e-4)
    # Four amplitudes a period, at the least.
    assert seen.streak_px[0] > 40 * 4 * np.sqrt(2 * wide.max())


def test_a_step_of_the_attitude_draws_two_stars() -> None:
    """Half of the exposure at each of two places 20 px apart, with a step of 1 ms between them."""
    t = np.concatenate([np.arange(0, 0.5, 1e-3), np.arange(0.5, 3, 1e-3)])
    turned = np.where(t < 0.5, 0.0, 20 / 2500)
    leap = Trajectory(
        t, Rotation.from_rotvec(np.outer(turned, [0, 1, 0])), np.zeros((len(t), 3))
    )
    image, _ = shot(star_at(41.5, 23.5), leap)
    assert image[:, 37:47].sum() == pytest.approx(0.5, abs=2e-3)
    assert image[:, 17:27].sum() == pytest.approx(0.5, abs=2e-3)


def test_an_exposure_of_too_many_attitude_samples_is_refused() -> None:
    t = np.linspace(0, 3, 60_000)
    fine = Trajectory(t, Rotation.identity(len(t)), np.zeros((len(t), 3)))
    with pytest.raises(
        InputError,
        match=r"exposure\.time: 2 s holds \d+ samples of the attitude; allowed: 32769",
    ):
        draw(light(), Window(0.1, 2.0), fine)


# Fast motion between two samples of the attitude


def test_a_star_that_crosses_the_field_between_two_poses_is_kept() -> None:
    """A sweep of 0.2 rad from pose to pose, five fields wide: every star that is on the chip at any time is kept."""
    rng = np.random.default_rng(8)
    rays = Rotation.from_rotvec(np.outer(rng.uniform(-1.2, 1.2, 3000), [0, 1, 0])).apply(
        [0.0, 0.0, 1.0]
    )
    rays = Rotation.from_rotvec(np.outer(rng.uniform(-1.2, 1.2, 3000), [1, 0, 0])).apply(rays)
    stars = light().take(np.zeros(3000, int))
    stars.place[:, :3] = rays
    angles = np.linspace(-0.8, 0.8, 9)

    def poses(angles_rad: Floats) -> projection.Poses:
        turns = Rotation.from_rotvec(np.outer(angles_rad, [0, 1, 0]))
        return projection.Poses(turns.as_matrix(), np.zeros((len(angles_rad), 3)))

    fine = projection.project(stars, LENS, poses(np.linspace(-0.8, 0.8, 201)))[0]
    on_chip = np.flatnonzero(((fine > -0.5) & (fine < [63.5, 47.5])).all(axis=2).any(axis=0))
    kept = projection.in_view(stars, LENS, poses(angles))
    assert len(on_chip) >= 10
    assert set(on_chip) <= set(kept)
    assert len(kept) < 600


@pytest.mark.parametrize("angles", [[0.0], [0.0, 0.02], list(np.linspace(-0.6, 0.6, 9))])
def test_a_field_of_a_deep_catalog_costs_only_the_stars_near_it(
    monkeypatch: pytest.MonkeyPatch, angles: list[float]
) -> None:
    """The rows are those of a pass over all stars; those tested are as many as the cone's part of the sky holds."""
    rng = np.random.default_rng(5)
    rays = rng.standard_normal((25_000, 3))
    stars = steady_points(
        np.arange(25_000),
        rays / np.linalg.norm(rays, axis=1, keepdims=True),
        np.ones(25_000),
        np.zeros(25_000),
    )
    turns = Rotation.from_rotvec(np.outer(angles, [0, 1, 0])).as_matrix()
    poses = projection.Poses(turns, np.zeros((len(angles), 3)))
    tested = []
    in_cone = projection._in_cone
    monkeypatch.setattr(
        projection,
        "_in_cone",
        lambda place, *more: tested.append(len(place)) or in_cone(place, *more),
    )
    rows = projection.in_view(stars, LENS, poses)
    monkeypatch.setattr(projection, "MIN_BAND_STARS", 10**9)
    assert rows.tolist() == projection.in_view(stars, LENS, poses).tolist()
    assert tested[1] == 25_000
    assert len(rows) <= tested[0] < (0.05 * 25_000 if len(angles) < 3 else 25_001)


def test_a_patch_holds_the_bend_of_a_path_between_two_samples() -> None:
    """A circle of 100 px sampled every 45 deg, none of them where it is widest: 7.6 px beyond the samples."""
    angle = np.radians(22.5 + 45 * np.arange(9))
    xy = 150 + 100 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x0, x1, y0, y1 = rendering.patches(xy[:, None], np.array([3.0]), (300, 300))[0]
    assert max(x0, y0) <= 150 - 100 - 3
    assert min(x1, y1) > 150 + 100 + 3
    # And no more than a quarter of a chord of 77 px wider.
    assert x1 - x0 < 2 * (100 + 3) + 2 * 77 / 4 + 4


def test_positions_without_an_image_do_not_widen_a_patch() -> None:
    """The first source loses its image during the exposure, the second has none, the third is beside the chip."""
    xy = np.full((9, 3, 2), np.nan)
    xy[:4, 0] = [[20, 30], [21, 30], [23, 30], [24, 30]]
    xy[:, 2] = [150.0, 40.0]
    first, second, third = rendering.patches(xy, np.full(3, 3.0), (100, 120))
    # The reach, a pixel, and a quarter of the longest chord on either side; up to the next whole pixels.
    assert first.tolist() == [20 - 5, 24 + 5 + 1, 30 - 4, 30 + 4 + 1]
    for x0, x1, y0, y1 in (second, third):
        assert (x1 - x0) * (y1 - y0) == 0


def test_a_cubic_path_is_followed_exactly_from_its_first_sample_to_its_last() -> None:
    """A cubic through four samples is the path itself if that is cubic, in the first and last interval too."""

    def path(t: Any) -> Any:
        return np.stack(
            [30 + 4 * t - 2 * t**2 + t**3, 20 - 3 * t + t**2 - 0.5 * t**3, 100 + t**3],
            axis=-1,
        )

    t_s = np.linspace(0.0, 4.0, 9)
    samples = path(t_s)[:, None]
    tracks = projection.Tracks(
        0.0, 0.5, samples[:, :, :2].copy(), samples[:, :, 2].copy(), np.ones((1, 3))
    )
    times = np.linspace(0.0, 4.0, 33)
    found = np.array([rendering._interpolate(tracks, 0, t) for t in times])
    np.testing.assert_allclose(found, path(times), rtol=0, atol=1e-11)


# Lens


@pytest.mark.parametrize(("focus", "radius_px"), [("33 in", 0.0), ("infinity", None)])
def test_an_led_out_of_focus_is_blurred_by_the_circle_of_confusion(
    focus: str, radius_px: float | None
) -> None:
    """A (v - f) / v of a lens focused at infinity; variances of disks, a quarter of the radii squared, add."""
    lens = lens_of(pixel="40 um", focal_length="35 mm", focus=focus)
    image, _ = shot(led_at(0, 0, 33 * 0.0254, 1e-3), lens=lens)
    v = 1 / (1 / 35e-3 - 1 / (33 * 0.0254))
    blur_px = radius_px if radius_px is not None else 35e-3 / 8 * (v - 35e-3) / v / 2 / 40e-6
    emitter_px = 1e-3 / (33 * 0.0254) * (v if radius_px is not None else 35e-3) / 40e-6
    wanted = 0.7**2 + 1 / 12 + (blur_px**2 + emitter_px**2) / 4
    np.testing.assert_allclose(moments(image)[1], wanted, rtol=0, atol=0.02)


def test_blur_grows_to_its_value_in_the_corner() -> None:
    lens = lens_of(psf={"kind": "gaussian", "sigma_px": 0.7, "corner_sigma_px": 2.0})
    corner = np.hypot(32.0, 24.0)
    for x in (31.5, 45.0, 57.0):
        image, _ = shot(star_at(x, 23.5, lens=lens), lens=lens)
        wanted = 0.7**2 + (2 * (x - 31.5) / corner) ** 2 + 1 / 12
        y = np.arange(48)
        across = (image.sum(axis=1) * (y - 23.5) ** 2).sum() / image.sum()
        assert across == pytest.approx(wanted, rel=5e-4)  # the S-curve of the second moment


def test_vignetting_dims_a_star_and_an_led_alike() -> None:
    lens = lens_of(
        pixel="250 um",
        vignetting={"kind": "table", "angle_deg": [0, 20], "transmission": [1, 0.6]},
    )
    plain = lens_of(pixel="250 um")
    for source in (star_at(41.5, 23.5, lens=plain), led_at(0.1, 0, 1.0, 1e-5)):
        ratio = (
            shot(source, lens=lens)[1].electrons[0] / shot(source, lens=plain)[1].electrons[0]
        )
        assert ratio == pytest.approx(1 - 0.4 * np.degrees(np.arctan(0.1)) / 20, rel=1e-6)


def test_a_lobe_dims_an_led_seen_obliquely() -> None:
    source = led_at(0.2, 0, 1.0, 1e-5)
    lens = lens_of(pixel="250 um")
    lambert, narrow = (
        draw(
            source,
            Window(0.1, 0.1),
            lens=lens,
            emitter=Emitter(lobe=CosineLobeConfig(exponent=n)),
        )[1].electrons[0]
        for n in (1.0, 7.0)
    )
    assert narrow / lambert == pytest.approx(np.cos(np.arctan(0.2)) ** 6, rel=1e-6)


# Truth


def test_the_noise_equivalent_area_of_a_gaussian_matches_theory() -> None:
    """(sum s)^2 / sum s^2 is 4 pi sigma^2 of a wide Gaussian, the pixel's variance among it."""
    _, seen = shot(star_at(30.2, 22.9), lens=blurred(3.0))
    assert seen.area_px[0] == pytest.approx(4 * np.pi * (9 + 1 / 12), rel=1e-3)


def test_the_brightest_pixel_is_at_the_star() -> None:
    image, seen = shot(star_at(30.2, 22.9))
    np.testing.assert_array_equal(seen.peak_xy, [[30, 23]])
    assert image[23, 30] == seen.peak_e[0]


# Centroids of what was rendered and exposed follow the Cramer-Rao bound


def fitted(
    frames: Floats, x_px: float, y_px: float, electrons: float, read_noise_e: float
) -> Floats:
    """(K, 2) maximum-likelihood places of K stars of unknown flux: Fisher's scoring from the truth."""
    grid = np.arange(frames.shape[1])
    flux = np.full(len(frames), electrons)
    x = np.full(len(frames), x_px)
    y = np.full(len(frames), y_px)

    def edge(at: Floats) -> tuple[Floats, Floats]:
        u = (grid[:, None] + np.array([-0.5, 0.5]) - at[:, None, None]) / 0.7
        return np.diff(erf(u / np.sqrt(2)))[..., 0] / 2, -np.diff(np.exp(-(u**2) / 2))[
            ..., 0
        ] / 0.7 / np.sqrt(2 * np.pi)

    for _ in range(12):
        (px, dx), (py, dy) = edge(x), edge(y)
        shape = py[:, :, None] * px[:, None, :]
        slopes = np.stack([shape, flux[:, None, None] * py[:, :, None] * dx[:, None, :],
                           flux[:, None, None] * dy[:, :, None] * px[:, None, :]], axis=1)  # fmt: skip
        model = flux[:, None, None] * shape
        weight = 1 / (np.maximum(model, 0) + read_noise_e**2 + 1e-3)
        fisher = np.einsum("kaij,kbij,kij->kab", slopes, slopes, weight)
        score = np.einsum("kaij,kij,kij->ka", slopes, frames - model, weight)
        step = np.linalg.solve(fisher, score[..., None])[..., 0]
        flux = flux + step[:, 0]
        x = x + np.clip(step[:, 1], -0.3, 0.3)
        y = y + np.clip(step[:, 2], -0.3, 0.3)
    return np.column_stack([x, y])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("read_noise_e", "electrons", "bound_px"),
    [
        (0, 1e3, 0.024), (0, 3e3, 0.014), (0, 1e4, 0.0076), (0, 1e5, 0.0024),
        (15, 1e3, 0.053), (15, 3e3, 0.022), (15, 1e4, 0.0097), (15, 1e5, 0.0025),
        (50, 1e3, 0.148), (50, 3e3, 0.051), (50, 1e4, 0.017), (50, 1e5, 0.0031),
    ],
)  # fmt: skip
def test_centroids_follow_the_cramer_rao_bound(
    read_noise_e: float, electrons: float, bound_px: float
) -> None:
    """Reference §3, sigma .7: within a tenth, 600 stars at 30 places within a pixel, through optics and detector."""
    rng = np.random.default_rng(int(electrons + read_noise_e))
    errors = []
    detector = Detector.from_camera(
        lens_of(
            width_px=16, height_px=16,
            detector={"quantum_efficiency": 0.5, "full_well_e": 1e6, "gain_e_dn": 1, "bits": 16,
                      "offset_dn": 500, "read_noise_e": read_noise_e},
        ).camera
    )  # fmt: skip
    lens = lens_of(width_px=16, height_px=16)
    for x, y in rng.uniform(7, 8, (30, 2)):
        image, _ = shot(star_at(x, y, electrons, lens), lens=lens)
        frames = (
            np.array(
                [expose(image.astype(np.float32), 1.0, detector, rng) for _ in range(20)]
            )
            - 500.0
        )
        errors.append(
            fitted(frames, x, y, electrons, np.hypot(read_noise_e, np.sqrt(1 / 12))) - [x, y]
        )
    assert np.std(np.concatenate(errors)) == pytest.approx(bound_px, rel=0.1)


# Stars


def test_a_star_of_magnitude_zero_gives_liebe_s_electrons() -> None:
    # Reference §2: 19,100 e-/s/mm2 with QE x T = .34.
    source = light(strength=[float(star_flux_e_s_m2(0.0, *SUN, Band.from_efficiency(0.34)))])
    image, _ = draw(source, Window(0.0, 1.0), lens=lens_of(1e-6))
    assert image.sum() == pytest.approx(19_100, rel=2e-3)


@pytest.mark.parametrize(
    ("v_mag", "electrons"), [(4.0, 6008), (5.0, 2392), (5.4, 1655), (6.0, 952)]
)
def test_reference_electrons_of_stars_in_the_ec655(v_mag: float, electrons: float) -> None:
    # Reference §2: f/1.4, 50 ms, Liebe's rate.
    camera = loader.load("shefex2", {"camera.detector.quantum_efficiency": "0.40"}).camera
    band = Band.from_efficiency(camera.detector.quantum_efficiency)
    source = light(strength=[float(star_flux_e_s_m2(v_mag, *SUN, band))])
    image = np.zeros((camera.height_px, camera.width_px))
    render(image, source, Optics.from_camera(camera), STILL, AT_CENTER, Window(0.0, 0.05))
    assert image.sum() == pytest.approx(electrons, rel=2e-3)


def test_electrons_are_proportional_to_time_and_pupil_area() -> None:
    bright = draw(light(), Window(0.0, 1.5), lens=lens_of(2.0))[0]
    np.testing.assert_allclose(bright, 3 * shot(light())[0], rtol=1e-12, atol=0)


def test_rendering_in_batches_equals_rendering_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Patches of many sources are processed in batches, which does not change the result."""
    rng = np.random.default_rng(2)
    many = [star_at(*xy, 1e3) for xy in rng.uniform((5, 5), (58, 42), (40, 2))]
    stars = with_sources(many)
    whole, seen = shot(stars)
    monkeypatch.setattr(rendering, "MAX_PATCH_PIXELS", 500)
    parts, again = shot(stars)
    np.testing.assert_allclose(parts, whole, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(seen.electrons, again.electrons)
