"""Every scene in scenes/ loads, runs, shows enough sources, and is reproducible bit for bit."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import project
from skysim.camera.glow.background import PointedCamera
from skysim.camera.glow.display_glow import black_glow
from skysim.core.paths import SCENES, shipped_files
from skysim.dynamics import multibody
from skysim.experiments.study.execution.trials import TrialSetup, run_frame_trial
from skysim.experiments.study.plan import FrameTrial
from skysim.results import metrics
from skysim.results.run import render
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.scene.sections.light import CollimatedDisplayConfig, StarsConfig
from skysim.scene.sections.vehicle import VehicleConfig
from skysim.simulation.flight import Flight, Shot, open_flight, simulate_motion
from skysim.simulation.lab import build_lab, build_tracker, exposure_window
from skysim.tracking import onboard_model

# `afit_laboratory` is what AFIT's tests have in common, and no test of its own.
ALL_NAMES = [name for name in shipped_files(SCENES) if name != "afit_laboratory"]
IDEAL = [name for name in ALL_NAMES if name.endswith("_ideal")]
NAMES = [name for name in ALL_NAMES if name not in IDEAL]
# What a published experiment shows instead of five sources and an attitude.
PAIR = "afit_test2"
GRID = "afit_test1"
CODED = "coded_spiral"  # few LEDs, which are named after some frames
BOARDS = ("afit_board", "afit_board_sanded", "afit_fig_46", GRID)
SHOWN = {PAIR: 2, CODED: 4, **dict.fromkeys(BOARDS, 9)}  # LEDs in its first frame
# On its way from one pair to the next it sees none; Position 4 of Test 3 is beyond this field's short side.
NOT_ALL_ALONG = {PAIR, CODED, "afit_test3"}
# The same field on one million pixels in place of 67, for what is rendered once more.
FEWER = {
    "ptase_monte_carlo": {
        "camera.width_px": "1024",
        "camera.height_px": "1024",
        "camera.pixel": "16 um",
    }
}
MODELS = sorted(path.name for path in (SCENES / "vehicles").glob("*.xml"))


def scene_of(name: str, frames: int, **overrides: str) -> Scene:
    return loader.load(name, overrides | {"exposure.frames": str(frames)})


class Flown(NamedTuple):
    """A flight at its end, and the exposures of its main camera."""

    flight: Flight
    shots: list[Shot]

    @property
    def scene(self) -> Scene:
        return self.flight.lab.scene


# Their identifiers are those of the papers, which no other quick test compiles: ten to twenty seconds each.
COMPILED = ("ptase_monte_carlo", "ptase_table_2", "shefex_night", "nps_bench")
FLOWN = [
    pytest.param(name, marks=[pytest.mark.compiles] * (name in COMPILED)) for name in NAMES
]


@pytest.fixture(scope="module", params=FLOWN)
def flown(request: pytest.FixtureRequest) -> Flown:
    flight = open_flight(scene_of(request.param, 2))
    return Flown(flight, list(flight.shots(cameras=[0])))


def test_scenes_are_shipped() -> None:
    steered = {
        "afit_simsat",
        "shefex2",
        "simsat_slew",
        "simsat_cmg",
        "simsat_bump",
        "simsat_thrusters",
        "tas2_vscmg",
    }
    lit = {
        "afit_test1",
        "afit_test2",
        "afit_test3",
        "nps_tas2",
        "apl_dome",
        "celestial_dome",
        "collimated_display",
    }
    assert steered | lit <= set(NAMES)


@pytest.mark.slow
def test_every_scene_has_its_name_and_a_title(flown: Flown) -> None:
    assert flown.scene.name in NAMES
    assert 10 < len(flown.scene.title) < 80


@pytest.mark.slow
def test_the_first_frame_shows_five_sources_or_the_published_number(flown: Flown) -> None:
    frame = flown.shots[0].frame
    truth = flown.shots[0].truth
    camera = flown.scene.camera
    detector = flown.scene.camera.detector
    assert frame.image_dn.shape == (camera.height_px, camera.width_px)
    above_noise = truth.sources.peak_e > 5 * np.hypot(
        detector.read_noise_e, np.sqrt(truth.sources.peak_e)
    )
    # The dim LED of the pair is at the thesis's threshold, and not above five sigmas.
    dim = flown.scene.name == PAIR
    assert above_noise.sum() >= 5 or above_noise.sum() == SHOWN[flown.scene.name] - dim
    # And none of them blinds the chip.
    assert np.mean(frame.image_dn >= frame.saturation_dn) < 1e-3


@pytest.mark.slow
def test_the_light_of_the_sources_is_on_the_frame(flown: Flown) -> None:
    """Sum above offset, dark and the chip's own pattern, against the truth's electrons, to five sigmas.

    A display's black pixels glow beside them.

    Through a converter of 16 bits, finer than any read noise: a step four times the noise, as the LU205c's, swallows
    most of what is far below half of it (a dark current of a quarter electron all over the frame).
    Sensitivity is the one part of the pattern that goes with the light: a source of E electrons over A pixels has
    it as prnu E / sqrt(A).
    """
    detector_config = flown.scene.camera.detector
    step_e = detector_config.full_well_e / 60000
    # The same in electrons, or noise would be cut off at 0.
    offset_dn = detector_config.offset_dn * detector_config.gain_e_dn / step_e
    fine = {"bits": "16", "gain_e_dn": str(step_e), "offset_dn": str(offset_dn)}
    fine = {f"camera.detector.{key}": value for key, value in fine.items()}
    name = flown.scene.name
    flight = simulate_motion(scene_of(name, 1, **fine, **FEWER.get(name, {})))
    frame, truth = flight.render(0)
    scene = flight.lab.scene
    camera = flight.lab.camera
    part = scene.camera.detector
    detector = camera.detector
    pixels = frame.image_dn.size
    lit_sky = scene.background or getattr(scene.light, "air", None)
    if part.offset_dn * part.gain_e_dn < 5 * part.read_noise_e or lit_sky:
        pytest.skip("the black is clipped, or the sky lights all pixels")
    pattern_e = detector.dark_e_s.sum(dtype=float) * frame.exposure_s
    pattern_e += len(frame.image_dn) * detector.column_offset_e.sum(dtype=float)
    found_e = (
        frame.image_dn.sum(dtype=float) - pixels * part.offset_dn
    ) * part.gain_e_dn - pattern_e
    light_e = truth.sources.electrons
    camera_m = truth.lab_from_body.apply(camera.mount.camera_body_m)
    glow_e_s = black_glow(
        scene.light,
        PointedCamera(camera.optics, truth.cam_from_lab, camera_m, camera.band),
    )
    glow_e = 0.0 if glow_e_s is None else float(glow_e_s.sum()) * frame.exposure_s
    read = pixels * (part.read_noise_e**2 + part.reset_noise_e**2 + part.gain_e_dn**2 / 12)
    shot = light_e.sum() + glow_e + detector.dark_e_s.sum(dtype=float) * frame.exposure_s
    uneven = part.prnu**2 * np.sum(light_e**2 / truth.sources.area_px)
    # What a star beyond full well loses is less than all it has.
    clipped_e = light_e[truth.sources.saturated].sum()
    assert (
        abs(found_e - light_e.sum() - glow_e) < 5 * np.sqrt(read + shot + uneven) + clipped_e
    )


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(flown: Flown) -> None:
    name = flown.scene.name
    fewer = FEWER.get(name, {})
    image = flown.shots[0].frame.image_dn
    if fewer:
        image = next(open_flight(scene_of(name, 2, **fewer)).shots()).frame.image_dn
    again = render(scene_of(name, 2, **fewer), 0)[0].image_dn
    seed = str(flown.scene.seed + 1)
    other = render(scene_of(name, 2, **fewer, seed=seed), 0)[0].image_dn
    assert image.tobytes() == again.tobytes()
    assert np.mean(image != other) > 0.1


@pytest.mark.long
def test_a_frame_rendered_alone_equals_that_of_a_sequence(flown: Flown) -> None:
    """Also one that is rendered again from the whole motion."""
    sequence = flown.shots[1].frame.image_dn.tobytes()
    assert render(scene_of(flown.scene.name, 2), 1)[0].image_dn.tobytes() == sequence
    assert flown.flight.render(1)[0].image_dn.tobytes() == sequence


def test_the_first_frames_are_solved_correctly(flown: Flown) -> None:
    assert len(flown.shots) == 2
    for shot in flown.shots:
        answer = shot.report.attitude
        # Seen, each where it is, to half a pixel; two alone are no attitude.
        if flown.scene.name in SHOWN:
            found_px = shot.report.centroids.xy_px
            seen_px = shot.truth.sources.xy_px
            apart_px = np.linalg.norm(found_px[:, None] - seen_px, axis=2)
            assert len(found_px) == len(seen_px) == SHOWN[flown.scene.name]
            assert apart_px.min(axis=1).max() < 0.5
            assert flown.scene.name != PAIR or answer.status == "too few stars detected"
            continue
        assert answer.status == "solved"
        true_attitude = shot.truth.cam_from_lab
        error_rad = (answer.cam_from_ref * true_attitude.inv()).magnitude()
        nees = metrics.normalized_error_squared(
            answer.cam_from_ref, true_attitude, answer.covariance_rad2
        )
        assert not metrics.is_wrong(error_rad, nees)


@pytest.mark.slow
@pytest.mark.parametrize("name", IDEAL)
def test_an_ideal_scene_s_tracker_has_the_true_dome(name: str) -> None:
    """It differs from its base in the tracker alone, whose map and lever are the true ones."""
    ideal = loader.load(name)
    base = loader.load(name.removesuffix("_ideal"))
    assert (
        ideal.model_copy(
            update={"tracker": base.tracker, "title": base.title, "name": base.name}
        )
        == base
    )
    lab = build_lab(ideal)
    leds = onboard_model.assumed_dome(ideal, ideal.light, lab.camera.sources)
    lever = onboard_model.assumed_lever(ideal, lab.camera.mount)
    np.testing.assert_array_equal(leds.position_m, lab.camera.sources.place[:, :3])
    np.testing.assert_array_equal(lever.camera_body_m, lab.camera.mount.camera_body_m)
    assert (leds.sigma_m, lever.sigma_m) == (0, 0)
    assert onboard_model.assumed_lever(base, lab.camera.mount).sigma_m > 0


def test_a_square_of_equal_leds_is_never_solved_wrong() -> None:
    """AFIT's nine LEDs are their own picture after a quarter turn, but for 0.12 mm of glue: 1.3 px."""
    for shot in open_flight(scene_of(GRID, 4)).shots():
        answer = shot.report.attitude
        if answer.solved:
            assert (
                np.degrees((answer.cam_from_ref * shot.truth.cam_from_lab.inv()).magnitude())
                < 10 / 60
            )


# Else its flight would render and solve.
NO_EYES = {"simsat_bump": {"filter": "null", "motion.control.feedback": "truth"}}
# Under a dome: range of the tilt in which the tracker has enough LEDs, where it is not 0 to 25.
TILT_DEG = {"afit_test3": (0.0, 3.0), "nps_tas2": (0.0, 4.0), "apl_dome": (0.0, 60.0)}
BENCH_DEG = (87.0, 90.0)  # elevation of the camera below the collimated display
SURVEYS = 100
FRAMES = 3


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [name for name in ALL_NAMES if name.removesuffix("_ideal") not in SHOWN]
)
def test_the_claimed_error_matches_the_actual_error(name: str) -> None:
    """NEES e^T P^-1 e is 3 on average where the claimed covariance P is that of the errors e.

    300 frames at random attitudes and the median rate of the scene's motion. Every three have a new survey of the dome,
    or another sky on the display: these errors are the same in all frames of one laboratory.
    """
    flight = simulate_motion(loader.load(name, NO_EYES.get(name)))
    flown = flight.lab.scene
    motion = flight.trajectory()
    t_s = np.array(
        [exposure_window(flown, index).open_s for index in range(flown.exposure.frames)]
    )
    turned = motion.attitude_at(t_s).inv() * motion.attitude_at(t_s + 0.01)
    trial = FrameTrial(
        kind="frames",
        dec_deg=BENCH_DEG
        if isinstance(flown.light, CollimatedDisplayConfig)
        else (-90.0, 90.0),
        tilt_deg=TILT_DEG.get(name.removesuffix("_ideal"), (0.0, 25.0)),
        rate_deg_s=float(np.degrees(np.median(turned.magnitude())) / 0.01),
    )
    lab = build_lab(loader.load(name))
    outcomes = []
    rng = np.random.default_rng(300)
    for survey in range(SURVEYS):
        scene = lab.scene.with_values("tracker.survey", seed=survey)
        if isinstance(scene.light, CollimatedDisplayConfig):
            dec_deg = np.degrees(np.arcsin(rng.uniform(-1, 1)))
            scene = scene.with_values(
                "light", axis_ra_deg=rng.uniform(0, 360), axis_dec_deg=dec_deg
            )
            lab = build_lab(scene)
        if survey == 0 or not isinstance(scene.light, StarsConfig):
            tracker = build_tracker(lab.with_scene(scene).camera)
        setup = TrialSetup(lab.with_scene(scene), tracker, trial, "")
        outcomes += [
            run_frame_trial(setup, survey * FRAMES + frame) for frame in range(FRAMES)
        ]
    nees = np.array([one.nees for one in outcomes if one.solved])
    assert sum(one.wrong for one in outcomes) == 0
    assert len(nees) > 0.8 * len(outcomes)
    assert 2.5 < nees.mean() < 3.5


STEERED = [name for name in NAMES if loader.load(name).motion.control]


@pytest.fixture(scope="module", params=STEERED)
def whole(request: pytest.FixtureRequest) -> Flight:
    """A scene's motion up to its last frame, without rendering."""
    return simulate_motion(loader.load(request.param, NO_EYES.get(request.param)))


@pytest.mark.long
def test_the_camera_sees_five_leds_throughout_the_maneuver(whole: Flight) -> None:
    """In every frame, at geometry alone: what is on the chip, by the tracker's map."""
    if isinstance(whole.lab.scene.light, StarsConfig):
        pytest.skip("no LEDs")
    motion = whole.trajectory()
    eyes = build_tracker(whole.lab.camera)
    counts = []
    for index in range(whole.lab.scene.exposure.frames):
        body_from_lab = motion.attitude_at(
            exposure_window(whole.lab.scene, index).open_s
        ).inv()
        pixels = project(body_from_lab, eyes.leds.position_m, eyes.lever, eyes.camera)
        counts.append(int(eyes.camera.contains(np.nan_to_num(pixels, nan=-1e9), 12).sum()))
    assert len(counts) >= 20
    assert min(counts) >= 5 or whole.lab.scene.name in NOT_ALL_ALONG


@pytest.mark.long
def test_the_vehicle_reaches_its_targets_and_stays_off_its_stop(whole: Flight) -> None:
    telemetry = whole.telemetry()
    assert telemetry.lab_from_ref is not None
    error_deg = np.degrees(
        (telemetry.lab_from_ref.inv() * telemetry.lab_from_body).magnitude()
    )
    assert error_deg[-1] < 0.1  # some are still on their way
    assert np.median(error_deg) < 0.05
    up = telemetry.lab_from_body.as_matrix()[:, 2, 2]
    tilt_deg = np.degrees(np.arccos(np.clip(up, -1, 1)))
    assert whole.lab.scene.vehicle.mount == "free" or tilt_deg.max() < 29


# --- the vehicles, at the hands of chance -------------------------------------------------------------------

TURNS = {
    "cubesat.xml": 2.0
}  # times the rate of the others: its wheels hold it as a gyroscope


def at_random(config: VehicleConfig, rate_body_rad_s: np.ndarray) -> multibody.Simulation:
    """A second of flight; every 10 ms each motor gets another random control over its full range.

    A vehicle's own motors have the range of their file. `Simulation.advance` raises where MuJoCo warned.
    """
    vehicle = multibody.build(config)
    rng = np.random.default_rng(7)
    most = np.where(
        vehicle.model.actuator_ctrllimited, vehicle.model.actuator_ctrlrange[:, 1], 1.0
    )
    most[vehicle.torques] = config.torque_limit_nm
    most[vehicle.gimbals.motor] = (
        np.radians(config.cmgs.gimbal_rate_limit_deg_s) if config.cmgs else 0.0
    )
    flight = multibody.Simulation(vehicle, Rotation.identity(), rate_body_rad_s, 1.0)
    flight.advance(np.repeat(most * rng.uniform(-1, 1, (100, vehicle.model.nu)), 10, axis=0))
    return flight


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_second_of_random_control_gives_no_mujoco_warning(name: str) -> None:
    flight = at_random(loader.load(name).vehicle, np.zeros(3))
    assert flight.steps_left == 0
    assert np.isfinite(flight.states).all()
    assert np.linalg.norm(flight.rate_body_rad_s) > 1e-4  # it was moved


@pytest.mark.parametrize("mount", ["free", "air_bearing"])
@pytest.mark.parametrize("model", MODELS)
def test_a_second_of_random_control_of_every_actuator_gives_no_mujoco_warning(
    model: str, mount: str
) -> None:
    """At 1.1 rad/s and, on the bearing, against its stop; wheels at 3000 rpm and out of balance."""
    spec = mujoco.MjSpec.from_file(str(SCENES / "vehicles" / model))
    named = [element.name for element in [*spec.joints, *spec.sites]]
    wheels = sum(name.startswith("wheel_") for name in named)
    parts = {
        "wheel_": {
            "wheels": {
                "start_rpm": [3000] * wheels,
                "coulomb": "2 mN m",
                "static_imbalance": "1 g cm",
            }
        },
        "gimbal_": {"cmgs": {"rotor_torque_limit": "0.1 N m"}},
        "fan_": {"fans": {}},
        "thruster_": {"thrusters": {}},
    }
    balanced = {"center_of_mass": ["0 m", "0 m", "0 m"]}
    given = {"model": f"vehicles/{model}", "mount": mount} | balanced
    for prefix, part in parts.items():
        given |= part if any(name.startswith(prefix) for name in named) else {}
    flight = at_random(
        VehicleConfig.model_validate(given), TURNS.get(model, 1.0) * np.array([0.6, 0.5, 0.8])
    )
    assert flight.steps_left == 0
    assert np.isfinite(flight.states).all()
    assert flight.model.nu == 3 + sum(
        name.startswith(("wheel_", "gimbal_", "rotor_", "fan_", "thruster_"))
        for name in named
    )
    up = Rotation.from_quat(flight.states[:, 1:5], scalar_first=True).as_matrix()[:, 2, 2]
    tilt_deg = np.degrees(np.arccos(np.clip(up, -1, 1))).max()
    lowest, highest = {"free": (30.0, 180.0), "air_bearing": (29.9, 30.1)}[mount]
    assert lowest < tilt_deg <= highest
