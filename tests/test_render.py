"""What falls on the chip: energy, place, shape and smear against integrals done here by other means."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import erf
from scipy.stats import ncx2

from skysim import render as rendering
from skysim import scene
from skysim.optics import Optics
from skysim.photometry import led_strength_ph_s_sr, star_flux_ph_s_m2
from skysim.render import render
from skysim.types import Floats, Mount, Seen, Sources, Trajectory

LENS = Optics(64, 48, 2500.0, (31.5, 23.5), (0.0,) * 5, 0.7, 0.0, 1.0)
AT_CENTRE = Mount(np.zeros(3), Rotation.identity())  # camera axes are the body's: it looks along lab z


def turning(rate_rad_s: Floats | list[float], start: Rotation | None = None) -> Trajectory:
    """Three seconds at a constant rate about a fixed axis, through `start` in the middle of the first."""
    t, rate = np.linspace(0, 3, 31), np.array(rate_rad_s, float)
    turned = Rotation.from_rotvec((t[:, None] - 0.5) * rate)
    return Trajectory(t, (start or Rotation.identity()) * turned, np.tile(rate, (31, 1)))


STILL = turning([0, 0, 0])


def light(**fields: object) -> Sources:
    """One star on the boresight of one photon per second and square metre, but for what is given."""
    made = {
        "id": np.array([7]),
        "place": np.array([[0.0, 0.0, 1.0, 0.0]]),
        "normal": np.zeros((1, 3)),
        "period_s": np.ones(1),
        "on_s": np.ones(1),
        "strength": np.ones(1),
        "magnitude": np.full(1, np.nan),
    }
    zero = {name: np.zeros(1) for name in ("radius_m", "lobe", "start_s")}
    return Sources(**zero | made | {key: np.array(value) for key, value in fields.items()})


def star_at(x_px: float, y_px: float, electrons: float = 1.0, lens: Optics = LENS) -> Sources:
    """A star whose light through a square metre, in a second, is `electrons`."""
    place = np.array(
        [(x_px - lens.centre_px[0]) / lens.focal_px, (y_px - lens.centre_px[1]) / lens.focal_px, 1]
    )
    place /= np.linalg.norm(place)
    return light(place=[[*place, 0.0]], strength=[electrons / place[2]])


def led_at(x_m: float, y_m: float, z_m: float, radius_m: float = 1e-3, **fields: object) -> Sources:
    """A Lambertian LED that faces straight down."""
    return light(
        place=[[x_m, y_m, z_m, 1.0]],
        normal=[[0.0, 0.0, -1.0]],
        radius_m=[radius_m],
        lobe=[1.0],
        **fields,
    )


def shot(
    source: Sources,
    trajectory: Trajectory = STILL,
    lens: Optics = LENS,
    mount: Mount = AT_CENTRE,
    exposure_s: float = 1.0,
) -> tuple[Floats, Seen]:
    """An exposure whose middle is at 0.5 s."""
    return render(source, lens, trajectory, mount, 0.5 - exposure_s / 2, exposure_s, 1.0)


def moments(image: Floats) -> tuple[Floats, Floats]:
    """Mean place and variance along x and y."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    mean = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    var = np.array([(image * (x - mean[0]) ** 2).sum(), (image * (y - mean[1]) ** 2).sum()]) / image.sum()
    return mean, var


# Energy


@pytest.mark.parametrize("sigma_px", [0.2, 0.7, 2.0])
@pytest.mark.parametrize("xy", [(31.0, 23.0), (30.77, 24.31), (31.5, 23.5)])
def test_a_still_star_keeps_every_electron(xy: tuple[float, float], sigma_px: float) -> None:
    image, seen = shot(star_at(*xy, 1e4), lens=replace(LENS, blur_sigma_px=sigma_px))
    assert image.sum() == pytest.approx(1e4, rel=1e-8)  # 6.5 sigma hold all but 1e-10 an axis
    assert seen.electrons[0] == pytest.approx(image.sum(), rel=1e-12)
    assert seen.peak_e[0] == image.max()


@pytest.mark.parametrize("radius_px", [0.05, 0.3, 0.7, 1.5, 2.0, 2.2, 3.0, 6.0, 12.0])
@pytest.mark.parametrize("sigma_px", [0.6, 1.0])
def test_a_disc_of_any_size_keeps_every_electron(radius_px: float, sigma_px: float) -> None:
    lens = replace(LENS, blur_sigma_px=sigma_px, blur_radius_px=radius_px)
    image, _ = shot(star_at(30.83, 23.37, 1e4), lens=lens)
    assert image.sum() == pytest.approx(1e4, rel=1e-4)


def test_a_smeared_star_keeps_every_electron() -> None:
    """The star walks 20 px across; the cosine of its angle is 1 to 1e-5."""
    image, seen = shot(star_at(31.5, 23.5, 1e4), turning([0, 20 / 2500, 0]))
    assert seen.streak_px[0] == pytest.approx(20, abs=0.01)
    assert image.sum() == pytest.approx(1e4, rel=1.5e-5)


def test_a_smeared_disc_keeps_every_electron() -> None:
    lens = replace(LENS, blur_radius_px=5.0)
    image, _ = shot(star_at(31.5, 23.5, 1e4), turning([8 / 2500, 12 / 2500, 0]), lens)
    assert image.sum() == pytest.approx(1e4, rel=1e-4)


def test_a_star_on_the_border_leaves_half_of_itself_outside() -> None:
    image, seen = shot(star_at(-0.5, 20.0, 1e4))
    assert image.sum() == pytest.approx(5e3, rel=1e-8)
    assert seen.electrons[0] == pytest.approx(5e3, rel=1e-8)
    np.testing.assert_allclose(seen.xy_px, [[-0.5, 20.0]], rtol=0, atol=1e-10)


def test_lights_add() -> None:
    near, far = star_at(20.2, 20.9, 1e3), star_at(22.0, 21.0, 2e3)
    both = Sources(*(np.concatenate([getattr(near, f), getattr(far, f)]) for f in Sources.__slots__))
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
def test_what_cannot_be_seen_leaves_no_trace(source: Sources) -> None:
    image, seen = shot(source)
    assert image.shape == (48, 64)
    assert not image.any()
    assert len(seen.id) == 0


# Place and shape


@pytest.mark.parametrize("x_px", np.linspace(30.0, 31.0, 6))
def test_a_still_star_s_centroid_is_its_projected_pixel(x_px: float) -> None:
    image, seen = shot(star_at(x_px, 20.3), lens=replace(LENS, blur_sigma_px=1.2))
    np.testing.assert_allclose(seen.xy_px, [[x_px, 20.3]], rtol=0, atol=1e-10)
    np.testing.assert_allclose(seen.flux_xy_px, seen.xy_px, rtol=0, atol=1e-12)
    np.testing.assert_allclose(moments(image)[0], [x_px, 20.3], rtol=0, atol=1e-8)  # cut at 6.5 sigma


@pytest.mark.parametrize("sigma_px", [0.25, 0.3, 0.4, 0.5, 0.6])
def test_pixels_bend_the_centroid_by_the_s_curve(sigma_px: float) -> None:
    """First harmonic exp(-2 pi^2 sigma^2) / pi over the wide window (reference §3)."""
    phase = np.arange(16) / 16
    lens = replace(LENS, blur_sigma_px=sigma_px)
    bias = np.array([moments(shot(star_at(30 + p, 20.0), lens=lens)[0])[0][0] - 30 - p for p in phase])
    amplitude = -2 * np.mean(bias * np.sin(2 * np.pi * phase))
    assert amplitude == pytest.approx(np.exp(-2 * np.pi**2 * sigma_px**2) / np.pi, abs=1e-6)


@pytest.mark.parametrize(("sigma_px", "fine"), [(0.5, 60), (0.7, 50), (1.3, 30)])
def test_a_star_is_a_gaussian_integrated_over_each_pixel(sigma_px: float, fine: int) -> None:
    """Midpoints of fine x fine squares a pixel, whose error is (1 / fine sigma)^2 / 24."""
    image, _ = shot(star_at(30.37, 22.81), lens=replace(LENS, blur_sigma_px=sigma_px))
    sub = (np.arange(fine) + 0.5) / fine - 0.5
    x, y = (np.arange(n)[:, None] + sub for n in (64, 48))
    density = [np.exp(-((axis - at) ** 2) / 2 / sigma_px**2) for axis, at in ((x, 30.37), (y, 22.81))]
    columns, rows = (d.mean(axis=1) / np.sqrt(2 * np.pi) / sigma_px for d in density)
    np.testing.assert_allclose(
        image, np.outer(rows, columns), rtol=0, atol=2 * image.max() / (fine * sigma_px) ** 2 / 24
    )


def disc_image(x_px: float, y_px: float, radius_px: float, sigma_px: float) -> Floats:
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


@pytest.mark.parametrize("radius_px", [0.3, 1.0, 2.0, 2.9, 3.3, 5.0, 10.4])
def test_a_disc_is_the_convolution_of_disc_and_gaussian(radius_px: float) -> None:
    lens = replace(LENS, blur_sigma_px=1.0, blur_radius_px=radius_px)
    image, _ = shot(star_at(30.83, 23.37), lens=lens)
    true = disc_image(30.83, 23.37, radius_px, 1.0)
    assert np.abs(image - true).max() < 0.012 * true.max()  # as the renderer's comments promise


@pytest.mark.parametrize("radius_px", [1.5, 2.9, 3.3, 10.4])
def test_a_disc_s_centroid_is_its_projected_pixel(radius_px: float) -> None:
    lens = replace(LENS, blur_sigma_px=1.0, blur_radius_px=radius_px)
    image, _ = shot(star_at(30.83, 23.37), lens=lens)
    np.testing.assert_allclose(moments(image)[0], [30.83, 23.37], rtol=0, atol=1e-5)  # the model edge's kink


@pytest.mark.parametrize(("pixel_um", "distance_in"), [(4.0, 33), (4.2, 33), (4.2, 66)])
def test_an_led_s_image_has_the_diameter_of_thin_geometry(pixel_um: float, distance_in: float) -> None:
    """2 mm through 35 mm: 2 mm x 35 mm / distance / pixel. Read off the image's second moments: the variance of
    a disc is a quarter of its radius squared, the blur's and the pixel's are added."""
    lens = replace(LENS, focal_px=35e3 / pixel_um, blur_sigma_px=1.0)
    distance_m = distance_in * 0.0254
    image, _ = shot(led_at(0, 0, distance_m), lens=lens)
    radius_px = 2 * np.sqrt(moments(image)[1] - 1 - 1 / 12)
    wanted = 2e-3 * 35e-3 / distance_m / (pixel_um * 1e-6)
    np.testing.assert_allclose(2 * radius_px, wanted, rtol=0, atol=0.02)  # the edge is a model, good to 1 %


# Smear


def test_reference_smear_of_shefex() -> None:
    # Reference H2: 4.41 px at 2 deg/s in 50 ms, 8.8 px at 4 deg/s.
    lens = replace(LENS, focal_px=25e-3 / 9.9e-6)
    for rate_deg_s, length_px in ((2, 4.41), (4, 8.81)):
        _, seen = shot(light(), turning([0, np.radians(rate_deg_s), 0]), lens, exposure_s=0.05)
        assert seen.streak_px[0] == pytest.approx(length_px, abs=0.01)


@pytest.mark.parametrize("length_px", [0.1, 1.0, 4.41, 15.0])
def test_a_smeared_star_is_as_long_as_its_path_and_stands_at_mid_exposure(length_px: float) -> None:
    """A uniform line of length L has the variance L^2 / 12 along itself and none across."""
    image, seen = shot(star_at(31.5, 23.5), turning([0, length_px / 2500, 0]))
    mean, variance = moments(image)
    assert seen.streak_px[0] == pytest.approx(length_px, rel=1e-4)
    np.testing.assert_allclose(seen.xy_px, [[31.5, 23.5]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(seen.flux_xy_px, [[31.5, 23.5]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(mean, [31.5, 23.5], rtol=0, atol=1e-4)  # the S-curve of sigma .7 is 2e-5
    # A quarter pixel's own variance, 1/192 px^2, is what the cut into parts leaves out.
    along = 0.7**2 + 1 / 12 + length_px**2 / 12
    np.testing.assert_allclose(variance, [along, 0.7**2 + 1 / 12], rtol=0, atol=1 / 192 + 1e-3)


def test_stars_move_against_the_camera() -> None:
    """Turning about body y (down) by the right-hand rule swings the boresight to +x: stars go left."""
    _, early = render(light(), LENS, turning([0, 0.004, 0]), AT_CENTRE, 0.0, 0.1, 1.0)
    _, late = render(light(), LENS, turning([0, 0.004, 0]), AT_CENTRE, 0.9, 0.1, 1.0)
    assert early.xy_px[0, 0] - late.xy_px[0, 0] == pytest.approx(0.9 * 0.004 * 2500, rel=1e-4)
    assert early.xy_px[0, 0] > 31.5 > late.xy_px[0, 0]


def test_a_roll_leaves_the_boresight_and_swings_the_rest_by_radius_times_angle() -> None:
    _, middle = shot(light(), turning([0, 0, 0.2]))
    _, aside = shot(star_at(31.5 + 20, 23.5), turning([0, 0, 0.2]))
    assert middle.streak_px[0] == pytest.approx(0, abs=1e-9)
    assert aside.streak_px[0] == pytest.approx(20 * 0.2, rel=1e-3)


@pytest.mark.parametrize(
    ("length_px", "ratio"), [(2, 0.78), (3, 0.61), (4.41, 0.43), (8.8, 0.22), (15, 0.13)]
)
def test_the_peak_of_a_smeared_star_is_that_of_the_line_integral(length_px: float, ratio: float) -> None:
    # Reference §3, sigma .7: peak relative to the still star's.
    def share(x: float) -> float:
        return float(erf((0.5 - x) / 0.7 / np.sqrt(2)) + erf((0.5 + x) / 0.7 / np.sqrt(2)))

    exact = quad(share, -length_px / 2, length_px / 2)[0] / length_px / share(0)
    _, still = shot(star_at(31.0, 23.0))
    _, smeared = shot(star_at(31.0, 23.0), turning([0, length_px / 2500, 0]))
    measured = float(smeared.peak_e[0] / still.peak_e[0])
    assert measured == pytest.approx(
        exact, rel=2e-3
    )  # parts of a quarter pixel: (0.25 / 0.7)^2 / 24 at the ends
    assert measured == pytest.approx(ratio, abs=0.03)


def test_halving_the_parts_quarters_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Midpoints of a smooth path converge with the square of the part, and at 0.25 px are there already."""
    images = []
    for step_px in (0.5, 0.25, 0.125, 0.0625):
        monkeypatch.setattr(rendering, "STEP_PX", step_px)
        images.append(shot(star_at(31.2, 23.1), turning([0.001, 8.0 / 2500, 0]))[0])
    changes = [np.abs(a - b).max() for a, b in pairwise(images)]
    for coarse, fine in pairwise(changes):
        assert coarse / fine == pytest.approx(4, abs=0.5)
    assert changes[1] < 3e-3 * images[-1].max()


def test_a_star_that_sweeps_through_from_outside_the_field_is_not_missed() -> None:
    """At 60 deg/s for half a second the star is 15 degrees out at mid-exposure, on the chip at the beginning:
    from the boresight to the left edge, the light of the integral of the cosine."""
    rate, focal = np.radians(60.0), 25e-3 / 9.9e-6
    lens = Optics(659, 493, focal, (329.0, 246.0), (0.0,) * 5, 0.7, 0.0, 1.0)
    image, seen = render(light(), lens, turning([0, rate, 0]), AT_CENTRE, 0.5, 0.5, 1.0)
    edge_rad = np.arctan(329.5 / focal)
    assert image.sum() == pytest.approx(np.sin(edge_rad) / rate, rel=5e-3)  # 2,000 parts of 0.7 px
    assert len(seen.id) == 1


# LEDs


def test_an_led_s_electrons_are_those_of_the_reference() -> None:
    # Reference §2: 0.6 cd, 33 in, 35 mm at f/8, T .85, QE .30: 3.1e7 electrons a millisecond.
    pupil_m2 = np.pi / 4 * (0.035 / 8) ** 2 * 0.85
    lens = replace(LENS, focal_px=35e-3 / 4.2e-6, collecting_m2=pupil_m2)
    source = led_at(0, 0, 33 * 0.0254, strength=[float(led_strength_ph_s_sr(0.6))])
    image, _ = render(source, lens, STILL, AT_CENTRE, 0.1, 1e-3, 0.30)
    assert image.sum() == pytest.approx(3.1e7, rel=0.02)  # two digits


def test_twice_as_far_is_a_quarter_of_the_light_and_half_the_size() -> None:
    near, far = (shot(led_at(0, 0, z, 2e-3))[0] for z in (0.4, 0.8))
    assert near.sum() / far.sum() == pytest.approx(4, rel=1e-4)
    size = [moments(image)[1] - 0.7**2 - 1 / 12 for image in (near, far)]
    np.testing.assert_allclose(size[0] / size[1], 4, rtol=0, atol=0.02)


def test_an_led_off_the_axis_is_dimmed_by_the_fourth_power_of_the_cosine() -> None:
    """Distance squared, emission and incidence under a flat panel: cos^4; off a dome that faces it, one."""
    lens = Optics(64, 48, 100.0, (31.5, 23.5), (0.0,) * 5, 0.7, 0.0, 1.0)
    on_axis, aside = (shot(led_at(x, 0, 1.0, 1e-4), lens=lens)[1].electrons[0] for x in (0.0, 0.2))
    assert aside / on_axis == pytest.approx(np.cos(np.arctan(0.2)) ** 4, rel=1e-6)


@pytest.mark.parametrize("duty", [0.35, 0.5, 0.7])
def test_duty_scales_the_light_of_whole_periods(duty: float) -> None:
    full, dim = (
        shot(led_at(0, 0, 1.0, period_s=[1e-3], on_s=[d * 1e-3], start_s=[3e-4]), exposure_s=0.01)[0].sum()
        for d in (1.0, duty)
    )
    assert dim / full == pytest.approx(duty, rel=1e-10)


def test_an_exposure_within_the_dark_of_a_pulse_sees_nothing() -> None:
    pulsed = led_at(0, 0, 1.0, period_s=[0.1], on_s=[0.02], start_s=[0.0])
    assert not render(pulsed, LENS, STILL, AT_CENTRE, 0.13, 0.05, 1.0)[0].any()
    assert render(pulsed, LENS, STILL, AT_CENTRE, 0.19, 0.05, 1.0)[0].sum() == pytest.approx(0.02, rel=1e-3)


def test_a_pulse_marks_where_the_led_was_while_it_shone() -> None:
    """Lit for the first quarter of a sweep of 16 px: three eighths of the sweep from the middle."""
    pulsed = led_at(0, 0, 1.0, 1e-5, period_s=[10.0], on_s=[0.25])
    image, seen = shot(pulsed, turning([0, 16 / 2500, 0]))
    assert moments(image)[0][0] - 31.5 == pytest.approx(6.0, abs=2e-3)
    assert seen.flux_xy_px[0, 0] - seen.xy_px[0, 0] == pytest.approx(6.0, abs=2e-3)


@pytest.mark.parametrize("tilt_deg", [-0.4, 0.1, 0.35])
def test_parallax_is_that_computed_by_hand(tilt_deg: float) -> None:
    """An LED R above the bearing, a camera h above it: after a tilt of a about y the LED stands at
    (-R sin a, 0, R cos a - h) from the camera."""
    radius, height, angle = 1.2192, 0.381, np.radians(tilt_deg)
    mount = Mount(np.array([0, 0, height]), Rotation.identity())
    _, seen = shot(led_at(0, 0, radius), turning([0, 0, 0], Rotation.from_rotvec([0, angle, 0])), mount=mount)
    wanted = 31.5 - 2500 * radius * np.sin(angle) / (radius * np.cos(angle) - height)
    np.testing.assert_allclose(seen.xy_px, [[wanted, 23.5]], rtol=0, atol=1e-9)


def test_stars_show_no_parallax() -> None:
    far = Mount(np.array([0.3, -0.2, 0.381]), Rotation.identity())
    np.testing.assert_array_equal(shot(star_at(20, 20))[0], shot(star_at(20, 20), mount=far)[0])


# Stars


def shefex_lens() -> tuple[Optics, float]:
    camera = scene.load("shefex2").camera
    lens = replace(Optics.of(camera), width_px=64, height_px=48, centre_px=(31.5, 23.5))
    return lens, camera.detector.quantum_efficiency


def test_a_star_of_magnitude_zero_gives_liebe_s_electrons() -> None:
    # Reference §2: 19,100 e-/s/mm2 with QE x T = .34.
    lens = replace(LENS, collecting_m2=1e-6)
    source = light(strength=[float(star_flux_ph_s_m2(0.0))])
    image, _ = render(source, lens, STILL, AT_CENTRE, 0.0, 1.0, 0.34)
    assert image.sum() == pytest.approx(19_100, rel=2e-3)


@pytest.mark.parametrize(("v_mag", "electrons"), [(4.0, 6008), (5.0, 2392), (5.4, 1655), (6.0, 952)])
def test_reference_electrons_of_stars_in_the_ec655(v_mag: float, electrons: float) -> None:
    # Reference §2: f/1.4, 50 ms, Liebe's rate.
    lens, efficiency = shefex_lens()
    source = light(strength=[float(star_flux_ph_s_m2(v_mag))])
    image, _ = render(source, lens, STILL, AT_CENTRE, 0.0, 0.05, efficiency)
    assert image.sum() == pytest.approx(electrons, rel=2e-3)


def test_light_grows_with_time_pupil_and_efficiency() -> None:
    bright = render(light(), replace(LENS, collecting_m2=2.0), STILL, AT_CENTRE, 0.0, 1.5, 0.5)[0]
    np.testing.assert_allclose(bright, 1.5 * shot(light())[0], rtol=1e-12, atol=0)
