"""Frames for an external plant: at its attitude, rate and time, with noise by frame number."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import skysim
from skysim.core.errors import InputError
from skysim.core.types import Floats, Frame
from skysim.simulation.lab import Lab

FULL_SKY = {"motion.rate_deg_s": [0, 0, 0], "exposure.frames": 3}
RATE = np.radians([1.0, -2.0, 0.5])


@pytest.fixture(scope="module")
def lab() -> Lab:
    return skysim.build_lab(skysim.load_scene("shefex2", FULL_SKY))


@pytest.fixture(scope="module")
def attitude(lab: Lab) -> Rotation:
    return Rotation.from_rotvec([0.2, -0.1, 0.3]) * lab.start


def difference_dn(one: Frame, other: Frame) -> Floats:
    """(N,) differences of two frames in the pixels where stars add little noise."""
    dark = (one.image_dn < 0.1 * one.saturation_dn) & (
        other.image_dn < 0.1 * other.saturation_dn
    )
    return np.where(
        dark, one.image_dn.astype(float) - other.image_dn.astype(float), 0.0
    ).ravel()


def test_the_truth_is_the_given_pose_at_mid_exposure(lab: Lab, attitude: Rotation) -> None:
    """Stars are at the positions for this attitude, with streaks of the rate."""
    frame, truth = skysim.render_at(lab, attitude, RATE, t_s=7.5)
    assert frame.t_mid_s == truth.t_s == pytest.approx(7.5, abs=1e-12)
    assert (truth.lab_from_body * attitude.inv()).magnitude() < 1e-12
    np.testing.assert_allclose(
        truth.rate_cam_rad_s, lab.camera.mount.cam_from_body.apply(RATE), rtol=0, atol=1e-15
    )
    sources = lab.camera.sources.take(np.isin(lab.camera.sources.id, truth.sources.id))
    order = np.argsort(truth.sources.id)
    rows = np.searchsorted(truth.sources.id, sources.id, sorter=order)
    expected_px = lab.camera.optics.project(truth.cam_from_lab.apply(sources.place[:, :3]))
    np.testing.assert_allclose(
        truth.sources.xy_px[order][rows], expected_px, rtol=0, atol=1e-9
    )
    center_px = np.array(lab.scene.camera.center_px)
    middle = np.hypot(*(truth.sources.xy_px - center_px).T) < 120
    across = np.linalg.norm(truth.rate_cam_rad_s[:2])
    wanted = across * lab.scene.exposure.time_s * lab.scene.camera.focal_px
    assert middle.sum() >= 3
    # A roll of half a degree a second adds up to 0.1 px at 120 px from the axis.
    np.testing.assert_allclose(truth.sources.streak_px[middle], wanted, rtol=0, atol=0.15)


@pytest.mark.slow
def test_a_frame_at_rest_equals_that_of_the_scene_at_rest() -> None:
    """The number selects the noise as it does in the scene: all pixels are equal, but for roundings of the time."""
    scene = skysim.load_scene("shefex2", FULL_SKY)
    for index in range(2):
        frame, truth = skysim.render(scene, index)
        outside, same = skysim.render_at(
            scene, truth.lab_from_body, t_s=truth.t_s, index=index
        )
        np.testing.assert_allclose(
            same.sources.electrons, truth.sources.electrons, rtol=1e-12
        )
        assert np.mean(outside.image_dn != frame.image_dn) < 1e-4


@pytest.mark.slow
def test_a_frame_with_given_motion_equals_that_of_a_moving_scene() -> None:
    """Without noise, and to the integration: a sphere keeps its rate."""
    keys = {"motion.rate_deg_s": np.degrees(RATE).tolist(), "camera.detector.noise": False}
    scene = skysim.load_scene("shefex2", FULL_SKY | keys)
    frame, truth = skysim.render(scene, 2)
    outside, same = skysim.render_at(scene, truth.lab_from_body, RATE, truth.t_s, index=2)
    np.testing.assert_allclose(same.sources.xy_px, truth.sources.xy_px, rtol=0, atol=1e-6)
    np.testing.assert_allclose(outside.image_dn, frame.image_dn, rtol=0, atol=1e-3)


def test_the_same_number_gives_the_same_bits_and_another_independent_noise(
    lab: Lab, attitude: Rotation
) -> None:
    """Of frames of one attitude: differences of disjoint pairs have one variance and no correlation."""
    frames = [skysim.render_at(lab, attitude, index=index)[0] for index in range(4)]
    again = skysim.render_at(lab, attitude, index=2)[0]
    np.testing.assert_array_equal(again.image_dn, frames[2].image_dn)
    pairs = [difference_dn(frames[0], frames[1]), difference_dn(frames[2], frames[3])]
    size = pairs[0].size
    assert pairs[0].std() == pytest.approx(pairs[1].std(), rel=5 / np.sqrt(2 * size))
    assert abs(np.corrcoef(pairs)[0, 1]) < 5 / np.sqrt(size)
    # Of overlapping pairs half of the variance is the shared frame's.
    shared = difference_dn(frames[0], frames[2])
    assert np.corrcoef(pairs[0], shared)[0, 1] == pytest.approx(0.5, abs=5 / np.sqrt(size))


def test_a_reused_lab_gives_the_frames_of_its_scene(lab: Lab, attitude: Rotation) -> None:
    frame, _ = skysim.render_at(lab, attitude, RATE, 3.0, index=5)
    built_again, _ = skysim.render_at(lab.scene, attitude, RATE, 3.0, index=5)
    np.testing.assert_array_equal(frame.image_dn, built_again.image_dn)


def test_each_camera_of_the_lab_gives_its_own_frame() -> None:
    side_head = {
        "name": "side",
        "position": ["0.2 m", "0 m", "0 m"],
        "rotation_deg": [0, 90, 0],
    }
    lab = skysim.build_lab(
        skysim.load_scene("two_heads", {"thermal": None, "heads": [side_head]})
    )
    (main, of_main), (side, of_side) = (
        skysim.render_at(lab, lab.start, camera=number) for number in (0, 1)
    )
    boresight = of_side.cam_from_lab.inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        boresight, of_main.cam_from_lab.inv().apply([1.0, 0.0, 0.0]), rtol=0, atol=1e-9
    )
    assert np.mean(main.image_dn == side.image_dn) < 0.5


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"index": -1}, "index: -1 is negative; allowed: 0 or more"),
        ({"camera": 1}, "camera: 1 is none of the lab's; allowed: 0 to 0"),
        ({"camera": -1}, "camera: -1 is none of the lab's; allowed: 0 to 0"),
    ],
)
def test_an_invalid_frame_or_camera_is_refused(
    lab: Lab, attitude: Rotation, asked: dict[str, int], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        skysim.render_at(lab, attitude, **asked)
