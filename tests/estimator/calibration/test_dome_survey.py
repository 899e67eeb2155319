"""The dome's self-survey on frames made by an independent projection."""

from dataclasses import replace
from time import perf_counter, process_time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude import dome_map, rotation_fit
from estimator.attitude.dome_map import LedMap, Lever
from estimator.calibration import bundle_adjustment as ba
from estimator.calibration import dome_survey
from estimator.calibration.bundle_adjustment import Bundle
from estimator.calibration.dome_survey import DomeFrame, DomeSurvey, survey
from estimator.core.camera import Camera

INCH = 0.0254
# AFIT (reference 1.1): measured semi-axes, apex at 48 in, camera 15 in up; 35 mm lens focused at 33 in, 4.2 um pixels.
AXES_M = np.array([38.88, 38.88, 28.60]) * INCH
CENTER_M = np.array([0.0, 0.0, 48 * INCH - AXES_M[2]])
FOCAL_PX = 1 / (1 / 0.035 - 1 / (33 * INCH)) / 4.2e-6
AFIT = Camera(1600, 1200, FOCAL_PX, (805.0, 594.0))
AFIT_LEVER = Lever(
    np.array([0.003, -0.002, 15 * INCH]), Rotation.from_rotvec([0.01, -0.015, 0.4])
)
# The small dome: a wide lens, so that 60 lights fill the field.
SMALL = Camera(800, 600, 900.0, (398.0, 303.0), (-0.08, 0.03, 0.001, -0.0007, 0.0))


def pixels(
    body_from_lab: Rotation, place_m: np.ndarray, lever: Lever, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and whether they are on the chip, by independent trigonometry: off-axis angle, azimuth, Brown's law."""
    q = lever.cam_from_body.apply(body_from_lab.apply(place_m) - lever.camera_body_m)
    off = np.arccos(q[:, 2] / np.linalg.norm(q, axis=1))
    azimuth = np.arctan2(q[:, 1], q[:, 0])
    ahead = off < 0.7
    r = np.tan(np.where(ahead, off, 0))
    x = r * np.cos(azimuth)
    y = r * np.sin(azimuth)
    k1, k2, p1, p2, k3 = camera.distortion
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    u = (
        camera.focal_px * (x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2))
        + camera.center_px[0]
    )
    v = (
        camera.focal_px * (y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y)
        + camera.center_px[1]
    )
    on_chip = ahead & (abs(u - 799.5 * camera.width_px / 1600) < camera.width_px / 2)
    on_chip &= abs(v - camera.height_px / 2 + 0.5) < camera.height_px / 2
    return np.column_stack([u, v]), on_chip


def dome(count: int, half_deg: float) -> np.ndarray:
    """Lights spread evenly over the ellipsoid's cap, by a golden spiral seen from the bearing."""
    n = np.arange(count) + 0.5
    z = 1 - n / count * (1 - np.cos(np.radians(half_deg)))
    turn = n * np.pi * (3 - np.sqrt(5))
    along = np.column_stack(
        [np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z]
    )
    return dome_map.on_surface(
        along, np.zeros(3), LedMap(np.arange(0), np.zeros((0, 3)), CENTER_M, AXES_M)
    )


def attitudes(rng: np.random.Generator, count: int, tilt_deg: float) -> Rotation:
    """Attitudes with tilts uniform over the cap and any yaw."""
    tilt = np.arccos(rng.uniform(np.cos(np.radians(tilt_deg)), 1, count))
    about = rng.uniform(0, 2 * np.pi, count)
    lean = Rotation.from_rotvec(
        tilt[:, None] * np.column_stack([np.cos(about), np.sin(about), 0 * about])
    )
    return lean * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, count)[:, None])


def small_dome(seed: int, frames: int = 40) -> tuple[np.ndarray, Rotation, Lever]:
    rng = np.random.default_rng(seed)
    place = dome(60, 42) + rng.normal(0, 0.005, (60, 3))
    return (
        place,
        attitudes(rng, frames, 25),
        Lever(np.array([0.02, -0.03, 0.38]), AFIT_LEVER.cam_from_body),
    )


def filmed(
    rng: np.random.Generator,
    turned: Rotation,
    place_m: np.ndarray,
    lever: Lever,
    camera: Camera,
    noise_px: float,
    imu_deg: float = 1.0,
) -> list[DomeFrame]:
    """Frames of the camera with initial attitudes wrong by imu_deg per axis."""
    frames = []
    for k in range(len(turned)):
        xy, on_chip = pixels(turned[k], place_m, lever, camera)
        led = np.flatnonzero(on_chip)
        noisy = xy[led] + rng.normal(0, noise_px, (len(led), 2))
        start = Rotation.from_rotvec(np.radians(imu_deg) * rng.normal(size=3)) * turned[k]
        frames.append(DomeFrame(led, noisy, np.full(len(led), noise_px or 0.1), start))
    return frames


def leds_of(place_m: np.ndarray) -> LedMap:
    return LedMap(np.arange(len(place_m)), place_m, CENTER_M, AXES_M)


def start_bundle(
    frames: list[DomeFrame], leds: LedMap, lever: Lever, camera: Camera, free_lens: int
) -> Bundle:
    attitudes = Rotation.concatenate([frame.body_from_lab for frame in frames])
    start = Bundle.start(leds, lever, camera, attitudes, True)
    return replace(start, free_lens=free_lens)


def small_survey(
    noise_px: float, seed: int, start_seed: int = 3, **how: object
) -> tuple[DomeSurvey, np.ndarray, Rotation, Lever]:
    """The small dome from a start wrong by 2 mm, 5 mm, 1 % and 1 degree."""
    place, turned, lever = small_dome(1)
    frames = filmed(np.random.default_rng(seed), turned, place, lever, SMALL, noise_px)
    rng = np.random.default_rng(start_seed)
    start = leds_of(place + rng.normal(0, 0.002, place.shape))
    believed = Lever(lever.camera_body_m + rng.normal(0, 0.005, 3), lever.cam_from_body)
    camera = replace(
        SMALL, focal_px=1.01 * SMALL.focal_px, center_px=(399.5, 299.5), distortion=(0.0,) * 5
    )
    return (
        survey(frames, start, believed, camera, fit_distortion=True, **how),
        place,
        turned,
        lever,
    )


def size_and_turn(found: np.ndarray, truth: np.ndarray) -> tuple[float, Rotation]:
    """Scale and rotation of the lab that map a survey's lights onto the true ones."""
    turn = Rotation.align_vectors(truth, found)[0]
    return float(np.sum(truth * turn.apply(found)) / np.sum(found**2)), turn


def align_attitudes(ours: Rotation, theirs: Rotation) -> tuple[Rotation, Rotation]:
    """Constant rotations of body and lab between attitudes: theirs = left * ours * right, by Gauss-Newton.

    If all attitudes rotate about one axis, a rotation can be divided between the two; the step is of minimum norm.
    """
    left = Rotation.identity()
    right = (ours.inv() * theirs).mean()
    for _ in range(50):
        residual = (theirs * (left * ours * right).inv()).as_rotvec()
        by_left = np.tile(np.eye(3), (len(residual), 1, 1))
        jacobian = np.concatenate([by_left, (left * ours).as_matrix()], axis=2)
        step = np.linalg.lstsq(jacobian.reshape(-1, 6), residual.ravel(), rcond=1e-9)[0]
        left = Rotation.from_rotvec(step[:3]) * left
        right = Rotation.from_rotvec(step[3:]) * right
        if np.linalg.norm(step) < 1e-14:
            break
    return left, right


def errors_rad(found: Rotation, truth: Rotation) -> np.ndarray:
    """(F, 3) attitude errors in body axes, without the unobservable rotations of lab and body."""
    left, right = align_attitudes(found, truth)
    return (left * found * right * truth.inv()).as_rotvec()


@pytest.mark.parametrize("block", ["by_led", "by_rotation", "by_shared"])
def test_the_derivatives_match_finite_differences_of_the_residuals(block: str) -> None:
    place, turned, lever = small_dome(11, frames=3)
    frames = filmed(np.random.default_rng(12), turned, place, lever, SMALL, 0.1)
    seen = dome_survey._collect(frames, len(place))
    bundle = start_bundle(frames, leds_of(place), lever, SMALL, 8)
    exact = getattr(ba.linearize(bundle, seen), block)
    lights = 3 * len(place)
    size = 3 * 3 + 3 + 8
    first = {"by_led": 0, "by_rotation": 0, "by_shared": 9}[block]
    for m in [0, len(seen.led) // 2, len(seen.led) - 1]:
        rows = {"by_led": seen.led, "by_rotation": seen.frame, "by_shared": 0 * seen.led}[
            block
        ]
        one = seen.take([m])
        for n in range(exact.shape[2]):
            led = np.zeros(lights)
            rest = np.zeros(size)
            column = first + 3 * rows[m] + n
            # 1 mm, 1 mrad and 1e-3 of the lens's numbers would bend; 1e-6 rounds at 1e-9 of the slopes.
            h = 1e-3 if block == "by_shared" and 3 <= n < 6 else 1e-6
            (led if block == "by_led" else rest)[column] = h
            up = ba.residuals(bundle.apply_step(led, rest), one)[0]
            down = ba.residuals(bundle.apply_step(-led, -rest), one)[0]
            slope = (down - up) / (2 * h)  # the residual is measured minus predicted
            # Rounding: residual of 1e4 sigma, 1e-12, over the step; and the slope's own size.
            np.testing.assert_allclose(slope, exact[m, :, n], rtol=1e-7, atol=1e-11 / h)


@pytest.mark.slow
def test_noise_free_frames_recover_every_parameter() -> None:
    """But for the pull of the map, which is 2 mm wrong: it falls with the square of the map's claimed error."""
    found, place, turned, lever = small_survey(0.0, 5, leds_sigma_m=0.5)
    assert found.status == "converged"
    assert found.surveyed.sum() > 35
    assert found.tied.all()
    assert len(found.outliers) == 0
    size, turn = size_and_turn(found.leds.position_m[found.surveyed], place[found.surveyed])
    np.testing.assert_allclose(
        size * turn.apply(found.leds.position_m[found.surveyed]),
        place[found.surveyed],
        rtol=0,
        atol=1e-6,
    )
    np.testing.assert_allclose(
        size * found.lever.camera_body_m, lever.camera_body_m, rtol=0, atol=1e-6
    )
    back = found.body_from_lab * turn.inv() * turned.inv()
    assert back.magnitude().max() < 1e-7
    assert found.camera.focal_px == pytest.approx(SMALL.focal_px, rel=1e-6)
    np.testing.assert_allclose(found.camera.center_px, SMALL.center_px, rtol=1e-6)
    np.testing.assert_allclose(found.camera.distortion, SMALL.distortion, rtol=0, atol=1e-5)


def misnamed(
    rng: np.random.Generator, frames: list[DomeFrame], lights: int, share: float
) -> list[DomeFrame]:
    """The same frames with a share of their lights assigned to wrong rows."""
    wrong = []
    for frame in frames:
        other = (frame.led + rng.integers(1, lights, len(frame.led))) % lights
        wrong.append(
            replace(frame, led=np.where(rng.random(len(frame.led)) < share, other, frame.led))
        )
    return wrong


def test_a_robust_loss_tolerates_wrong_names_and_reports_them() -> None:
    place, turned, lever = small_dome(31, frames=60)
    rng = np.random.default_rng(32)
    frames = filmed(rng, turned, place, lever, SMALL, 0.1)
    mixed = misnamed(rng, frames, 60, 0.05)
    start = leds_of(place + rng.normal(0, 0.002, place.shape))
    believed = Lever(lever.camera_body_m + rng.normal(0, 0.005, 3), lever.cam_from_body)
    camera = replace(SMALL, focal_px=1.01 * SMALL.focal_px)
    clean = survey(frames, start, believed, camera, leds_sigma_m=0.002)
    robust = survey(mixed, start, believed, camera, leds_sigma_m=0.002)
    outliers = {(int(k), int(row)) for k, row in robust.outliers}
    wrong = {
        (k, int(row))
        for k, (frame, other) in enumerate(zip(frames, mixed, strict=True))
        for row in np.flatnonzero(frame.led != other.led)
        if robust.surveyed[other.led[row]] and robust.tied[k]
    }
    assert len(wrong) > 15
    assert wrong <= outliers
    # Some right ones go too: 5 sigma in two dimensions are 4e-6 of Gaussian noise, so none of a thousand.
    assert all(frames[k].led[row] != mixed[k].led[row] for k, row in outliers)
    # Some 700 degrees of freedom.
    assert robust.misfit == pytest.approx(1, abs=4 / np.sqrt(2 * 700))
    rms = [
        np.sqrt(np.mean(errors_rad(found.body_from_lab, turned) ** 2))
        for found in (clean, robust)
    ]
    # 5 % fewer sightings: some 3 % more error; a fifth leaves room for chance.
    assert rms[1] < 1.2 * rms[0]


def test_a_light_seen_once_keeps_its_start_position_unsurveyed() -> None:
    place, turned, lever = small_dome(33)
    rng = np.random.default_rng(34)
    frames = filmed(rng, turned, place, lever, SMALL, 0.1)
    chosen = int(frames[0].led[0])
    once = [frames[0]]
    for frame in frames[1:]:
        rest = frame.led != chosen
        once.append(
            replace(
                frame,
                led=frame.led[rest],
                xy_px=frame.xy_px[rest],
                sigma_px=frame.sigma_px[rest],
            )
        )
    start = leds_of(place + rng.normal(0, 0.002, place.shape))
    found = survey(once, start, lever, SMALL, leds_sigma_m=0.002)
    assert not found.surveyed[chosen]
    np.testing.assert_array_equal(found.leds.position_m[chosen], start.position_m[chosen])
    assert np.isnan(found.led_covariance_m2[chosen]).all()
    assert chosen not in found.surveyed_leds.id
    assert len(found.surveyed_leds.id) == found.surveyed.sum() > 30


def test_a_light_seen_often_from_one_place_has_no_distance() -> None:
    # Yaw alone keeps the camera of an axial lever where it is: every ray of a light is one line.
    place, _, _ = small_dome(35)
    turned = Rotation.from_euler("z", np.linspace(0, 6, 20)[:, None])
    lever = Lever(np.array([0.0, 0.0, 0.38]), Rotation.identity())
    frames = filmed(np.random.default_rng(36), turned, place, lever, SMALL, 0.1, imu_deg=0.0)
    with pytest.raises(
        ValueError, match=r"^survey: 0 usable coordinates for \d+ unknowns; take more frames$"
    ):
        survey(frames, leds_of(place), lever, SMALL, leds_sigma_m=0.002)


def test_frames_in_two_groups_are_refused() -> None:
    _, _, lever = small_dome(37)
    rng = np.random.default_rng(38)
    near = attitudes(rng, 16, 4)
    narrow = replace(SMALL, focal_px=2500.0)
    apart = [
        near[:8] * Rotation.from_rotvec([0.45, 0, 0]),
        near[8:] * Rotation.from_rotvec([-0.45, 0, 0]),
    ]
    crowd = dome(600, 42)
    frames = filmed(rng, Rotation.concatenate(apart), crowd, lever, narrow, 0.1)
    # The great lean comes first, in the lab: each group stays at its own side of the dome, whatever its yaws.
    seen = [set(frame.led.tolist()) for frame in frames]
    assert all(len(one & other) < 2 for one in seen[:8] for other in seen[8:])
    with pytest.raises(
        ValueError,
        match=r"the frames are not connected; 8 of 16, frame \d+ first, share fewer than two",
    ):
        survey(frames, leds_of(crowd), lever, narrow, leds_sigma_m=0.002)


@pytest.mark.parametrize("sigma_m", [0.0, np.inf, np.nan])
def test_a_useless_error_of_the_map_is_refused_in_one_line(sigma_m: float) -> None:
    with pytest.raises(
        ValueError, match=rf"^survey: leds_sigma_m is {sigma_m}; allowed: finite, above 0$"
    ):
        small_survey(0.1, 5, leds_sigma_m=sigma_m)


def test_malformed_frames_are_refused_by_number() -> None:
    place, turned, lever = small_dome(1)
    frames = filmed(np.random.default_rng(2), turned, place, lever, SMALL, 0.1)
    asked = leds_of(place), lever, SMALL
    for wrong, message in [
        (
            replace(frames[3], led=frames[3].led + 60),
            r"frame 3 has LED rows outside of 0 to 59",
        ),
        (
            replace(frames[3], sigma_px=0 * frames[3].sigma_px),
            r"frame 3 has a pixel that is not finite or a sigma",
        ),
        (
            replace(frames[3], led=frames[3].led[1:]),
            r"frame 3 has \d+ LEDs, but xy_px and sigma_px are",
        ),
    ]:
        with pytest.raises(ValueError, match=f"^survey: {message}"):
            survey([*frames[:3], wrong, *frames[4:]], *asked, leds_sigma_m=0.002)
    with pytest.raises(ValueError, match=r"^survey: no frames"):
        survey([], *asked, leds_sigma_m=0.002)
    with pytest.raises(
        ValueError,
        match=r"^survey: \d+ usable coordinates for \d+ unknowns; take more frames",
    ):
        survey(frames[:3], *asked, leds_sigma_m=0.002)


def afit_errors_deg(
    found: DomeSurvey, rng: np.random.Generator, place: np.ndarray, trials: int
) -> tuple[float, float]:
    """rms cross and roll errors of new frames with tilts to 25 deg, solved with the surveyed map."""
    turned = attitudes(rng, trials, 25)
    solved = []
    for frame in filmed(rng, turned, place, AFIT_LEVER, AFIT, 0.1, imu_deg=0.5):
        known = found.surveyed[frame.led]
        led = frame.led[known]
        xy = frame.xy_px[known]
        sigma = np.full(len(led), 0.1 / found.camera.focal_px)
        solved.append(
            rotation_fit.rotation_only(
                found.camera.rays(xy),
                sigma,
                found.leds.position_m[led],
                found.leds,
                found.lever,
                frame.body_from_lab,
            )[0]
        )
    # The turns of lab and body that the pixels cannot tell are those between the survey's frames and the truth's.
    error = AFIT_LEVER.cam_from_body.apply(errors_rad(Rotation.concatenate(solved), turned))
    cross = np.hypot(error[:, 0], error[:, 1])
    roll = error[:, 2]
    return float(np.degrees(np.sqrt(np.mean(cross**2)))), float(
        np.degrees(np.sqrt(np.mean(roll**2)))
    )


@pytest.mark.long
@pytest.mark.parametrize("begin", ["imu", "rotation_only", "imu and wrong names"])
def test_the_afit_dome_is_surveyed_from_its_own_frames(begin: str) -> None:
    """The issue's bar: 1,400 lights, 600 frames, 0.1 px; 2 mm, 5 mm and 1 % wrong at the start."""
    rng = np.random.default_rng(2012)
    place = dome(1400, 40.2) + rng.normal(0, 0.001, (1400, 3))
    turned = attitudes(rng, 600, 30)
    frames = filmed(rng, turned, place, AFIT_LEVER, AFIT, 0.1)
    start = leds_of(place + rng.normal(0, 0.002, place.shape))
    believed = Lever(
        AFIT_LEVER.camera_body_m + rng.normal(0, 0.005, 3), AFIT_LEVER.cam_from_body
    )
    camera = replace(AFIT, focal_px=1.01 * AFIT.focal_px, center_px=(799.5, 599.5))
    if begin == "rotation_only":
        frames = [
            replace(
                f,
                body_from_lab=rotation_fit.rotation_only(
                    camera.rays(f.xy_px),
                    f.sigma_px / camera.focal_px,
                    start.position_m[f.led],
                    start,
                    believed,
                    f.body_from_lab,
                )[0],
            )
            for f in frames
        ]
    wrong = begin == "imu and wrong names"
    if wrong:
        frames = misnamed(rng, frames, 1400, 0.05)
    began_s = perf_counter()
    worked_s = process_time()
    found = survey(
        frames,
        start,
        believed,
        camera,
        leds_sigma_m=0.002,
    )
    took_s = perf_counter() - began_s
    worked_s = process_time() - worked_s
    cross, roll = afit_errors_deg(found, rng, place, 300)
    print(
        f"{begin}: {np.mean([len(f.led) for f in frames]):.1f} in the field, {found.surveyed.sum()} surveyed, "
        f"{took_s:.1f} s by the clock, {worked_s:.1f} s of processor, "
        f"cross {cross:.5f} deg, roll {roll:.5f} deg, misfit {found.misfit:.3f}, "
        f"focal {found.camera.focal_px - AFIT.focal_px:+.1f} +- {found.focal_sigma_px:.1f} px, lever "
        f"{1e3 * (found.lever.camera_body_m - AFIT_LEVER.camera_body_m)} mm, {len(found.outliers)} left out"
    )
    assert found.status == "converged"
    assert cross <= 0.01
    assert roll <= 0.03
    # The bar is 60 s on two cores of one's own; the clock of a machine that others share tells little, so the work of
    # all threads together is held to what one core does in that time.
    assert worked_s <= 60
