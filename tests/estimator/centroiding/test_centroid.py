"""Centroids against images by erf and against the Cramér-Rao bound from their numerical derivatives."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.special import erf, j1

from estimator.centroiding import moments
from estimator.centroiding.centroid import CENTROIDERS, cog, gaussian_fit
from estimator.core.least_squares import CONVERGED_PX
from estimator.core.types import Centroids, FramePriors
from estimator.detection import detect
from estimator.detection.background import FILTERED_NOISE
from tests.helpers.interpreted import interpreted

SIGMA_PX = 0.7
# stars so far apart that the sky between them is not lifted by their light
CELL_PX = 64
CELLS = 12


def gaussian(
    shape: tuple[int, int], x: float, y: float, flux: float, sigma: float = SIGMA_PX
) -> np.ndarray:
    """Light of a Gaussian integrated over each pixel; pixel centers are integers."""

    def share(count: int, at: float) -> np.ndarray:
        return np.diff(erf((np.arange(count + 1) - 0.5 - at) / (sigma * 2**0.5))) / 2

    return flux * np.outer(share(shape[0], y), share(shape[1], x))


def disk(shape: tuple[int, int], x: float, y: float, radius: float) -> np.ndarray:
    """A uniform disk from 200 chords per row of pixels, each divided exactly among pixels."""
    chords = np.add.outer(np.arange(shape[0]), (np.arange(200) + 0.5) / 200 - 0.5).ravel()
    half = np.sqrt(np.maximum(radius**2 - (chords - y) ** 2, 0))[:, None]
    edges = np.arange(shape[1] + 1) - 0.5
    inside = np.diff(np.clip(edges, x - half, x + half), axis=1)
    return inside.reshape(shape[0], 200, shape[1]).mean(axis=1)


def cramer_rao_px(flux_e: float, read_noise_e: float) -> float:
    """Bound for x of a star whose place, flux, width and sky are unknown, averaged over places in a pixel."""
    shape = (25, 25)
    step = 1e-4

    def bound(x: float, y: float) -> float:
        def model(p: np.ndarray) -> np.ndarray:
            return (p[4] + gaussian(shape, p[0], p[1], flux_e * p[2], p[3])).ravel()

        p = np.array([x, y, 1.0, SIGMA_PX, 0.0])
        slopes = np.array(
            [(model(p + step * e) - model(p - step * e)) / (2 * step) for e in np.eye(5)]
        )
        fisher = slopes / (model(p) + read_noise_e**2) @ slopes.T
        return np.linalg.inv(fisher)[0, 0]

    places = np.linspace(-0.4, 0.4, 5)
    return float(np.sqrt(np.mean([bound(12 + x, 12 + y) for x in places for y in places])))


def starfield(
    rng: np.random.Generator, flux_e: float, noise_e: float
) -> tuple[np.ndarray, np.ndarray]:
    """An image of 144 equal stars with photon and read noise on a sky of 100, and where they are."""
    image = np.empty((CELL_PX * CELLS, CELL_PX * CELLS))
    places = []
    for row in range(CELLS):
        for column in range(CELLS):
            x, y = rng.uniform(31, 32, 2)
            cell = rng.poisson(gaussian((CELL_PX, CELL_PX), x, y, flux_e))
            image[
                row * CELL_PX : (row + 1) * CELL_PX, column * CELL_PX : (column + 1) * CELL_PX
            ] = cell
            places.append((column * CELL_PX + x, row * CELL_PX + y))
    return image + rng.normal(100, noise_e, image.shape), np.array(places)


def errors_of(name: str, flux_e: float, noise_e: float, gain_e_dn: float, seed: int) -> tuple:
    """Errors and reported sigmas over five star fields in DN of so many electrons."""
    rng = np.random.default_rng(seed)
    off = []
    sigma = []
    for _ in range(5):
        image, places = starfield(rng, flux_e, noise_e)
        image /= gain_e_dn
        found = CENTROIDERS[name](image, detect.local(image, 6.0, max_blobs=1000), gain_e_dn)
        error, claimed = matched(found, places)
        off.append(error)
        sigma.append(claimed)
    return np.concatenate(off), np.concatenate(sigma)


def matched(found: Centroids, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error and reported sigma of the centroid that is nearest to each place."""
    rows = np.linalg.norm(found.xy_px[None] - places[:, None], axis=2).argmin(axis=1)
    return found.xy_px[rows] - places, found.sigma_px[rows]


@pytest.mark.parametrize("sigma", [0.5, 0.7, 1.0, 1.3])
def test_the_fit_recovers_a_noise_free_gaussian(sigma: float) -> None:
    rng = np.random.default_rng(20)
    for _ in range(20):
        x, y = rng.uniform(29, 35, 2)
        image = 100 + gaussian((64, 64), x, y, 1e4, sigma)
        found = gaussian_fit(image, detect.local(image, min_area_px=1))
        # Newton's last step is below a thousandth of a pixel, and what it leaves is its square.
        np.testing.assert_allclose(found.xy_px, [[x, y]], rtol=0, atol=CONVERGED_PX**2)
        assert found.flux[0] == pytest.approx(1e4, rel=CONVERGED_PX**2)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CENTROIDERS))
def test_a_centroid_follows_its_star_by_whole_pixels_and_across_the_diagonal(
    name: str,
) -> None:
    image = np.full((80, 96), 50.0)
    image += gaussian((80, 96), 40.3, 30.8, 1e4)
    seen = CENTROIDERS[name](image, detect.local(image, min_area_px=1)).xy_px
    turned = CENTROIDERS[name](
        image.T.copy(), detect.local(image.T.copy(), min_area_px=1)
    ).xy_px
    np.testing.assert_allclose(turned, seen[:, ::-1], rtol=0, atol=1e-9)  # rounding
    rolled = np.roll(image, (7, -5), axis=(0, 1))
    moved = CENTROIDERS[name](rolled, detect.local(rolled, min_area_px=1)).xy_px
    np.testing.assert_allclose(moved - seen, [[-5, 7]], rtol=0, atol=1e-9)  # rounding


@pytest.mark.parametrize("radius", [2.0, 5.0, 10.4])
def test_the_center_of_gravity_of_a_disk_is_its_middle(radius: float) -> None:
    # Reference section 2: an LED of 2 mm is a disk of 20.8 px. Larger than the fit's window, it falls back.
    x = 60.37
    y = 58.81
    image = 10 + 200 * disk((128, 128), x, y, radius)
    found = cog(image, detect.local(image, min_area_px=1))
    light = image - 10
    moments = [(light.sum(axis) @ np.arange(128)) / light.sum() for axis in (0, 1)]
    # Rounding.
    np.testing.assert_allclose(found.xy_px, [moments], rtol=0, atol=1e-9)
    # Pixels sample the disk: its transform 2 J1(z) / z at n cycles a pixel aliases to an S-curve (reference
    # section 3 has the Gaussian's). The harmonics at their worst, and 1e-4 for the rendering by chords.
    n = np.arange(1, 50)
    z = 2 * np.pi * radius * n
    aliased = np.sum(2 * np.abs(j1(z)) / z / (np.pi * n))
    np.testing.assert_allclose(found.xy_px, [[x, y]], rtol=0, atol=aliased + 1e-4)
    assert found.flux[0] == pytest.approx(200 * np.pi * radius**2, rel=1e-3)


@pytest.mark.parametrize("light", [0.5, 1.0, 2.0, -1.0])
def test_any_nonzero_light_has_a_center_of_gravity(light: float) -> None:
    """One and three quarters of the light in two pixels on a sky of zero; no light has no center."""
    moments = interpreted("estimator.centroiding.moments")
    image = np.zeros((9, 9))
    sky = np.zeros((3, 3))
    image[4, 3:5] = light * np.array([0.25, 0.75])
    boxes = np.array([[3, 4, 4, 4]])
    first = np.array([0])
    x, y, sigma, flux = moments.center_of_gravity(image, boxes, first, sky, sky + 1.0, 1.0)[0]
    assert (x, y, flux) == (3.75, 4.0, light)
    assert sigma > 0
    x, y, sigma, flux = moments.center_of_gravity(
        0 * image, boxes, first, sky, sky + 1.0, 1.0
    )[0]
    assert np.isnan([x, y, sigma]).all()
    assert flux == 0


def test_chosen_boxes_have_the_centers_of_gravity_that_they_have_among_all() -> None:
    """Also where a box that is not chosen takes pixels of one that is."""
    image = 10 + gaussian((40, 40), 15.2, 20.1, 1e4) + gaussian((40, 40), 21.3, 20.4, 1e4)
    boxes = np.array([[13, 18, 17, 22], [19, 18, 23, 22], [2, 2, 5, 5]])
    sky = np.full((1, 1), 10.0)
    every, second = (
        moments.center_of_gravity(image, boxes, np.array(rows), sky, sky, 1.0)
        for rows in ([0, 1, 2], [1])
    )
    np.testing.assert_array_equal(second, every[1:2])


@pytest.mark.parametrize("sigma", [0.3, 0.4, 0.5])
def test_the_center_of_gravity_has_the_theoretical_s_curve(sigma: float) -> None:
    # Reference section 3: the center of gravity errs by exp(-2 pi^2 sigma^2) / pi sin(2 pi x), wide window.
    phases = np.linspace(-0.5, 0.5, 21)
    images = [100 + gaussian((40, 40), 20 + x, 20.0, 1e4, sigma) for x in phases]
    off = np.array(
        [
            cog(im, detect.local(im, min_area_px=1)).xy_px[0, 0] - 20 - x
            for im, x in zip(images, phases, strict=True)
        ]
    )
    curve = -np.exp(-2 * (np.pi * sigma) ** 2) / np.pi * np.sin(2 * np.pi * phases)
    # The second harmonic is exp(-8 pi^2 sigma^2) / (2 pi), .0001 at sigma .3.
    np.testing.assert_allclose(off, curve, rtol=0, atol=2e-4)


def test_a_blob_whose_fit_fails_keeps_its_center_of_gravity() -> None:
    image = 10 + 200 * disk((128, 128), 60.37, 58.81, 10.4)
    image += gaussian((128, 128), 2.0, 100.2, 2e4)  # too near the border for a window of 7x7
    blobs = detect.local(image, min_area_px=1)
    assert len(blobs) == 2
    fitted = gaussian_fit(image, blobs)
    wanted = cog(image, blobs)
    np.testing.assert_array_equal(fitted.xy_px, wanted.xy_px)
    np.testing.assert_array_equal(fitted.sigma_px, wanted.sigma_px)
    np.testing.assert_array_equal(fitted.flux, wanted.flux)


@pytest.mark.compiles
@pytest.mark.parametrize(
    ("flux_e", "noise_e", "published_px"),
    [(1e4, 15, 0.0097), (1e5, 15, 0.0025), (3e3, 15, 0.022), (1e5, 0.5, 0.0024)],
)
def test_the_fit_reaches_the_cramer_rao_bound(
    flux_e: float, noise_e: float, published_px: float
) -> None:
    bound = cramer_rao_px(flux_e, noise_e)
    # The reference's table, section 3, has two figures.
    assert bound == pytest.approx(published_px, rel=0.04)
    off, _ = errors_of("gaussian_fit", flux_e, noise_e, 1.0, seed=21)
    # 1,440 errors give their deviation to 1.9 %; no unbiased estimate may pass the bound.
    assert 0.94 < off.std() / bound < 1.10
    assert np.abs(off.mean(axis=0)).max() < 4 * bound / np.sqrt(len(off))


# cog's own variance is photon + pixel noise over its box; its box moves with the noise, hence the wider band.
# The S-curves of the other two are in their variance as if their profiles were Gaussian.
@pytest.mark.compiles
@pytest.mark.parametrize(
    ("name", "band"),
    [
        ("cog", (0.75, 1.25)),
        ("weighted", (0.75, 1.25)),
        ("gaussian_window", (0.75, 1.25)),
        ("gaussian_fit", (0.88, 1.12)),
    ],
)
@pytest.mark.parametrize("gain_e_dn", [1.0, 20.0])
@pytest.mark.parametrize(("flux_e", "noise_e"), [(1e4, 15), (1e5, 15), (1e5, 1)])
def test_the_reported_sigma_matches_the_scatter(
    name: str, band: tuple[float, float], gain_e_dn: float, flux_e: float, noise_e: float
) -> None:
    off, sigma = errors_of(name, flux_e, noise_e, gain_e_dn, seed=22)
    # Chi-square a degree of freedom; 1,440 numbers give it to 3.7 %, three deviations are 0.11.
    chi2 = np.mean((off / sigma[:, None]) ** 2)
    assert band[0] < chi2 < band[1]


@pytest.mark.parametrize("sigma", [1.0, 2.5])
def test_the_windowed_centroid_s_error_is_an_eighth_above_the_minimum(sigma: float) -> None:
    """In noise of the sky a Gaussian sampled at points is placed to sqrt(8 pi) sigma^2 n / F at best in x and y."""
    y, x = np.mgrid[:61, :61]
    image = (
        1e4
        * np.exp(-((x - 30.3) ** 2 + (y - 29.8) ** 2) / (2 * sigma**2))
        / (2 * np.pi * sigma**2)
    )
    noise = np.full((1, 1), 3.0 * FILTERED_NOISE)
    box = np.array([[25, 25, 35, 35]])
    row = moments.gaussian_windowed(
        image, np.array([[30.0, 30.0]]), box, np.zeros((1, 1)), noise, 1e12
    )[0]
    np.testing.assert_allclose(row[:2], [30.3, 29.8], rtol=0, atol=1e-3)
    assert row[2] == pytest.approx(
        9 / 8 * np.sqrt(8 * np.pi) * sigma**2 * 3.0 / 1e4, rel=0.01
    )


def test_a_star_at_an_edge_is_placed_as_its_mirror_image_at_the_other() -> None:
    image = gaussian((17, 21), 1.2, 2.3, 1e4, 0.9)
    grid = np.ones((1, 1))
    last = np.array([20, 16])

    def mirrored(*flip: bool) -> np.ndarray:
        axes = [axis for axis in (0, 1) if flip[1 - axis]]
        corners = np.where(flip, last - [[0, 0], [4, 5]], [[0, 0], [4, 5]])
        box = np.hstack([corners.min(axis=0), corners.max(axis=0)])[None]
        start = np.where(flip, last - [1, 2], [1, 2])
        flipped = np.ascontiguousarray(np.flip(image, axes))
        row = moments.gaussian_windowed(
            flipped, start[None].astype(float), box, 0 * grid, grid, 1.0
        )[0]
        return np.append(np.where(flip, last - row[:2], row[:2]), row[2:])

    wanted = mirrored(False, False)
    assert np.isfinite(wanted).all()
    for flip in ((True, False), (False, True), (True, True)):
        np.testing.assert_allclose(mirrored(*flip), wanted, rtol=1e-9)


def test_a_large_saturated_star_is_placed_by_its_wings() -> None:
    """In the largest window, of 21 px; run by the interpreter, which checks array indices."""
    plain = interpreted("estimator.centroiding.gaussian_fit")
    image = gaussian((41, 41), 20.3, 19.8, 1e5, 1.2)
    level = np.zeros((1, 1))
    noise = np.ones((1, 1))
    box = np.array([[10, 10, 30, 30]])
    clipped = np.minimum(image, 5000.0)
    start = np.array([[20.0, 20.0]])
    row = plain.fit_all(
        clipped, start, np.array([4e4]), box, np.array([5000.0]), level, noise, 1.0, 5000.0
    )[0]
    np.testing.assert_allclose(row[:2], [20.3, 19.8], rtol=0, atol=1e-3)
    assert row[3] == pytest.approx(1e5, rel=1e-3)


@pytest.mark.compiles
@pytest.mark.parametrize("name", list(CENTROIDERS))
@pytest.mark.parametrize("apart_px", [8.0, 11.0])
def test_stars_side_by_side_do_not_pull_each_other(name: str, apart_px: float) -> None:
    rng = np.random.default_rng(23)
    scaled = []
    for _ in range(150):
        x, y = rng.uniform(29, 30, 2)
        turn = rng.uniform(0, 2 * np.pi)
        places = np.array(
            [[x, y], [x + apart_px * np.cos(turn), y + apart_px * np.sin(turn)]]
        )
        light = gaussian((64, 64), *places[0], 2e4) + gaussian((64, 64), *places[1], 4e3)
        image = rng.poisson(light) + rng.normal(100, 5, light.shape)
        blobs = detect.local(image)
        assert len(blobs) == 2
        off, sigma = matched(CENTROIDERS[name](image, blobs), places)
        scaled.append(off / sigma[:, None])
    # Chi-square of either star: 300 numbers give it to 8 %; three deviations.
    chi2 = np.mean(np.square(scaled), axis=(0, 2))
    assert np.all((chi2 > 0.7) & (chi2 < 1.3))


@pytest.mark.compiles
@pytest.mark.parametrize("name", list(CENTROIDERS))
def test_the_flux_is_the_light_above_the_sky(name: str) -> None:
    image = np.random.default_rng(24).normal(300, 2, (128, 128)) + gaussian(
        (128, 128), 60.2, 70.9, 5e4
    )
    found = CENTROIDERS[name](image, detect.local(image))
    # 17x17 pixels of noise 2, and of a sky level known to 0.1: five deviations of 45.
    assert found.flux[0] == pytest.approx(5e4, abs=225)


@pytest.mark.compiles
@pytest.mark.parametrize("name", list(CENTROIDERS))
def test_a_big_endian_frame_gives_the_same_centroids(name: str) -> None:
    image = np.random.default_rng(25).normal(300, 5, (128, 128)) + gaussian(
        (128, 128), 60.2, 70.9, 5e4
    )
    foreign = image.astype(">f8")
    np.testing.assert_array_equal(
        CENTROIDERS[name](foreign, detect.local(foreign)).xy_px,
        CENTROIDERS[name](image, detect.local(image)).xy_px,
    )


@pytest.mark.parametrize("name", list(CENTROIDERS))
def test_a_frame_without_blobs_gives_no_centroids(name: str) -> None:
    image = np.random.default_rng(26).normal(300, 5, (128, 128))
    assert len(CENTROIDERS[name](image, detect.local(image, 20.0))) == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("radius", "bright_e"), [(5.0, 400.0), (10.4, 400.0), (10.4, 4000.0)]
)
def test_the_disk_fit_is_unbiased_and_beats_center_of_gravity_under_noise(
    radius: float, bright_e: float
) -> None:
    # An edge blurred by optics of 0.8 px; the reference's LED of 20.8 px, and a smaller one.
    rng = np.random.default_rng(27)
    off = []
    sigma = []
    by_gravity = []
    for _ in range(80):
        x, y = rng.uniform(63, 64, 2)
        light = ndimage.gaussian_filter(bright_e * disk((128, 128), x, y, radius), 0.8)
        image = rng.poisson(light) + rng.normal(300, 30, light.shape)
        blobs = detect.default(image)
        found = CENTROIDERS["disk"](image, blobs)
        off.append(found.xy_px[0] - (x, y))
        sigma.append(found.sigma_px[0])
        by_gravity.append(cog(image, blobs).xy_px[0] - (x, y))
    chi2 = np.mean((np.array(off) / np.array(sigma)[:, None]) ** 2)
    # 160 numbers give it to 11 %; three deviations.
    assert 0.66 < chi2 < 1.34
    assert np.std(off) < 1.1 * np.std(by_gravity)


@pytest.mark.slow
def test_a_saturated_disk_is_placed_by_its_edge() -> None:
    rng = np.random.default_rng(28)
    off = []
    sigma = []
    for _ in range(60):
        x, y = rng.uniform(63, 64, 2)
        light = ndimage.gaussian_filter(3000 * disk((128, 128), x, y, 10.4), 0.8)
        image = (rng.poisson(light) + rng.normal(300, 20, light.shape)).clip(0, 2000)
        found = CENTROIDERS["disk"](
            image, detect.default(image), 1.0, FramePriors(saturation=2000)
        )
        off.append(found.xy_px[0] - (x, y))
        sigma.append(found.sigma_px[0])
    # 120 numbers give it to 13 %. Which pixels at the edge are full is left to the noise, and they are not weighed:
    # half as much again, which `see` covers with what it adds for saturation.
    assert 0.6 < np.mean((np.array(off) / np.array(sigma)[:, None]) ** 2) < 2.0


def test_the_disk_fit_gives_position_flux_and_radius_of_a_blurred_disk() -> None:
    """Without noise, on a sky of 50; run by the interpreter, which checks array indices."""
    fit = interpreted("estimator.centroiding.disk_fit")
    radius = 4.0
    x = 15.3
    y = 14.8
    light = 100 * ndimage.gaussian_filter(disk((31, 31), x, y, radius), 0.6)
    area = np.array([int(np.pi * radius**2)])
    sky = np.full((3, 3), 50.0)
    boxes = np.array([[11, 10, 20, 19]])
    place = np.array([[15.0, 15.0]])
    flux = np.array([light.sum()])
    row = fit.fit_all(light + 50, place, flux, area, boxes, sky, sky / 50, 1.0, np.inf)[0]
    assert row[:2] == pytest.approx([x, y], abs=0.02)  # pixels are not narrow beside the edge
    assert 0 < row[2] < 0.05
    assert row[3] == pytest.approx(light.sum(), rel=0.01)
    # The blur's and the pixel's variance moves the half level of a curved edge inward by half of it over the radius.
    assert row[4] == pytest.approx(radius - (0.6**2 + 1 / 12) / (2 * radius), rel=3e-3)
