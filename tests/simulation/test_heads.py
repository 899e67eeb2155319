"""Several star cameras on one vehicle: their mounts, chips, frames and messages, and the filter that fuses them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.results.run import simulate
from skysim.scene.loader import load_scene
from skysim.simulation.checks import check
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.flight import open_flight, simulate_motion
from skysim.simulation.lab import Lab, build_lab
from skysim.simulation.motion import mounting_rad
from tests.helpers.head_pairs import gain, measured_pairs

SIDE = {"name": "side", "position": ["0.2 m", "0 m", "0 m"], "rotation_deg": [0, 90, 0]}
SHORT = {"exposure.frames": 2, "motion.maneuver": [{"kind": "hold", "duration": "1 s"}]}


def two_heads(**overrides: object) -> Lab:
    return build_lab(load_scene("two_heads", SHORT | overrides))


def test_a_head_has_its_declared_rotation_and_position() -> None:
    """[0, 90, 0] looks to the right of the main image: the side's boresight is the main camera's x axis."""
    lab = two_heads(heads=[SIDE | {"mount_error_arcsec": [0, 0, 3600]}], thermal=None)
    head = lab.cameras[1]
    _, main = render_at_rest(lab.camera, lab.start)
    _, side = render_at_rest(head, lab.start)
    boresight = side.cam_from_lab.inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        boresight, main.cam_from_lab.inv().apply([1.0, 0.0, 0.0]), atol=1e-12
    )
    # The real camera is turned about its boresight by one degree from the assumed mount.
    assumed = head.mount.cam_from_body * side.lab_from_body.inv()
    error = (side.cam_from_lab * assumed.inv()).as_rotvec(degrees=True)
    np.testing.assert_allclose(error, [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_array_equal(head.mount.camera_body_m, [0.2, 0.0, 0.0])


def test_a_head_is_another_chip_with_other_noise() -> None:
    """The same camera at the same place: only chip and noise differ."""
    same = SIDE | {"position": ["0 m", "0 m", "0 m"], "rotation_deg": [0, 0, 0]}
    lab = two_heads(heads=[same])
    head = lab.cameras[1]
    assert head.scene.camera.detector.hardware_seed != lab.scene.camera.detector.hardware_seed
    assert head.scene.seed != lab.scene.seed
    frame, truth = render_at_rest(lab.camera, lab.start)
    other, _ = render_at_rest(head, lab.start)
    bright = truth.sources.peak_e > 2000
    x, y = np.rint(truth.sources.xy_px[bright]).astype(int).T
    inside = (
        (x >= 0) & (y >= 0) & (x < frame.image_dn.shape[1]) & (y < frame.image_dn.shape[0])
    )
    brightest = (
        frame.image_dn[y[inside], x[inside]].astype(float),
        other.image_dn[y[inside], x[inside]].astype(float),
    )
    assert np.corrcoef(*brightest)[0, 1] > 0.9
    assert np.mean(frame.image_dn == other.image_dn) < 0.5


def test_keys_of_a_head_override_those_of_the_main_camera() -> None:
    lens = {
        "camera": {"f_number": 2.8},
        "exposure": {"time": "80 ms"},
        "tracker": {"limit_mag": 5.0},
    }
    lab = two_heads(heads=[SIDE | lens])
    main, side = (camera.scene for camera in lab.cameras)
    assert (side.camera.f_number, side.exposure.time_s, side.tracker.limit_mag) == (
        2.8,
        0.08,
        5.0,
    )
    assert side.camera.focal_length_m == main.camera.focal_length_m
    assert side.exposure.frames == main.exposure.frames
    assert main.camera.f_number == 1.4


def test_frames_of_the_main_camera_do_not_change_with_a_head() -> None:
    labs = two_heads(heads=[]), two_heads()
    alone, both = (render_at_rest(lab.camera, lab.start, 1)[0].image_dn for lab in labs)
    np.testing.assert_array_equal(alone, both)


@pytest.mark.parametrize(
    ("heads", "message"),
    [
        ([SIDE, SIDE], "heads.1.name: side is the name of another camera"),
        ([SIDE | {"name": "main"}], "heads.0.name: main is the name of another camera"),
        (
            [SIDE | {"tracker": {"identifier": "cedar"}}],
            "heads.0.tracker.identifier: unknown identifier 'cedar'",
        ),
        ([SIDE | {"tracker": {"gyro": True, "map": "x"}}], "heads.0.tracker.map"),
        (
            [SIDE | {"camera": {"preset": "none_such"}}],
            "heads.0.camera.preset: unknown preset 'none_such'",
        ),
        ([SIDE | {"camera": {"f_number": -1}}], "heads.0.camera.f_number"),
        ([SIDE | {"position": ["0 m"]}], "heads.0.position"),
        ([SIDE | {"focal_length": "20 mm"}], "heads.0.focal_length"),
        (["side"], "heads.0"),
        ("side", "heads"),
    ],
)
def test_an_impossible_head_is_refused_in_one_line(heads: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        two_heads(heads=heads)
    assert "\n" not in str(error.value)


def test_a_drift_of_a_mount_needs_temperatures() -> None:
    with pytest.raises(
        InputError, match=r"heads\.0\.mount_arcsec_k: requires the section thermal"
    ):
        two_heads(heads=[SIDE | {"mount_arcsec_k": [1, 0, 0]}], thermal=None)


def test_an_option_without_effect_is_refused_in_a_head_too(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    head = "{name: side, position: [0 m, 0 m, 0 m], rotation_deg: [0, 90, 0], tracker: {solver: rotation_only}}"
    path.write_text(
        f"schema: 1\nbase: shefex2\nheads: [{head.replace('solver: rotation_only', 'brightness_sigma: 0.1')}]\n"
    )
    with pytest.raises(
        InputError, match=r"heads\.0\.tracker\.brightness_sigma: has no effect"
    ):
        load_scene(path)


@pytest.mark.slow
def test_the_expected_roll_of_two_heads_is_from_the_other_s_boresight() -> None:
    """At a right angle the roll about one boresight is an angle across the other: 1 / roll^2 + 2 / cross^2."""
    steady = {"kind": "steady", "temperature_c": 20.0}
    aligned = [SIDE | {"mount_error_arcsec": [0, 0, 0]}]
    lab = two_heads(thermal={"temperature": steady}, heads=aligned)
    facts = check(lab).as_dict()["facts"]
    main = facts["expected_error"]["frames"]
    side = facts["heads"]["heads"][0]
    expected = (main["roll_arcsec"] ** -2 + 2 * side["cross_arcsec"] ** -2) ** -0.5
    np.testing.assert_allclose(facts["heads"]["together"]["roll_arcsec"], expected, rtol=1e-9)
    assert facts["heads"]["together"]["roll_arcsec"] < main["roll_arcsec"] / 3


def test_under_a_dome_a_head_that_looks_below_the_rim_sees_nothing() -> None:
    top = SIDE | {"position": ["0.1 m", "0 m", "0.45 m"]}
    heads = [
        top | {"name": "up", "rotation_deg": [0, 8, 0]},
        top | {"name": "down", "rotation_deg": [0, 150, 0]},
    ]
    scene = load_scene(
        "afit_simsat", {"exposure.frames": 1, "heads": heads, "tracker.survey": {}}
    )
    reports = {shot.camera.name: shot.report for shot in open_flight(scene).shots()}
    solved = {name: report.attitude.solved for name, report in reports.items()}
    assert solved == {"main": True, "up": True, "down": False}
    assert len(reports["down"].centroids) < 3


@pytest.mark.slow
def test_the_filter_uses_the_frames_of_all_heads() -> None:
    """This holds even if only the main camera's frames are requested; its frames and updates are the same."""
    changes = SHORT | {"exposure.frames": 6, "exposure.rate_hz": 10}
    scene = load_scene("two_heads", changes)
    every = list(open_flight(scene).shots())
    for name in ("main", "side"):
        own = [shot for shot in every if shot.camera.name == name]
        assert {shot.frame.index: shot.update_status for shot in own} == dict.fromkeys(
            range(6), "used"
        )
    flight = open_flight(scene, keeps_history=False)
    alone = list(flight.shots(cameras=[0]))
    assert [schedule.index for schedule in flight.schedules] == [6, 6]
    main = [shot for shot in every if shot.camera.name == "main"]
    for shot, other in zip(alone, main, strict=True):
        assert shot.update_status == other.update_status
        np.testing.assert_array_equal(shot.frame.image_dn, other.frame.image_dn)


@pytest.mark.slow
def test_a_saved_run_has_a_folder_for_each_head(tmp_path: Path) -> None:
    simulated = simulate(load_scene("two_heads", SHORT))
    folder = simulated.save(tmp_path / "run")
    assert [len(simulated), len(simulated.heads["side"])] == [2, 2]
    assert (folder / "side" / "report.html").is_file()
    assert (folder / "side" / "frame_0001.fits").is_file()
    assert "mounting_side_x_arcsec" in (folder / "telemetry.ecsv").read_text()


@pytest.mark.slow
def test_two_heads_lower_the_roll_by_the_factor_of_their_covariances() -> None:
    """Rendered pairs: mean squares of n normalized errors have the relative deviation sqrt(2 / n)."""
    found = gain(measured_pairs(120, 5))
    assert found.pairs > 100
    assert found.predicted > 3
    assert abs(found.factor / found.predicted - 1) < 4 / np.sqrt(found.pairs)
    assert abs(found.nees - 3) < 4 * np.sqrt(6 / found.pairs)


@pytest.mark.long
def test_the_filter_finds_how_far_the_mounts_have_turned() -> None:
    """The shipped scene to its half: the second camera's boresight relative to the first, and the claimed errors."""
    flight = simulate_motion(load_scene("two_heads", {"exposure.frames": 200}))
    mountings = flight.telemetry().mountings
    for name, mounting in mountings.items():
        error = mounting.estimate_rad[-1] - mounting.true_rad[-1]
        sigma = mounting.sigma_rad[-1]
        assert np.abs(error / sigma).max() < 4, name
    side = mountings["side"]
    boresight = flight.lab.cameras[1].mount.cam_from_body.apply(
        side.estimate_rad[-1] - side.true_rad[-1]
    )[:2]
    assert np.linalg.norm(side.true_rad[-1]) > 20 * ARCSEC_RAD
    assert np.linalg.norm(boresight) < 3 * ARCSEC_RAD


def test_the_mounts_may_drift_as_far_as_the_scene_moves_them() -> None:
    """A random walk of d per root hour has the standard deviation d sqrt(t); a ramp within it lags by less than it."""
    lab = build_lab(load_scene("two_heads"))
    config = lab.scene.filter
    assert config is not None
    ends_s = np.array([0.0, lab.duration_s])
    main, side = (np.diff(mounting_rad(camera, ends_s), axis=0) for camera in lab.cameras)
    walk_arcsec = config.mounting_drift_arcsec_sqrt_h * np.sqrt(lab.duration_s / 3600)
    for moved in (main, side - main):
        assert np.abs(moved).max() / ARCSEC_RAD < 1.05 * walk_arcsec
