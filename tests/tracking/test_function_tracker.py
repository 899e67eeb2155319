"""Trackers of one's own in this process: what they get, and what they may return."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import skysim
from skysim.core.errors import InputError
from skysim.simulation.lab import build_lab
from skysim.tracking import factory
from skysim.tracking.tracker_interface import Answer, Picture, Setup, check_answer, to_answer

TURN = Rotation.from_euler("xyz", [0.3, -0.7, 2.0])


@pytest.mark.parametrize(
    "value",
    [
        TURN,
        TURN.as_quat(),
        TURN.as_quat().tolist(),
        TURN.as_matrix(),
        TURN.as_matrix().tolist(),
        Answer("solved", TURN.as_quat()),
    ],
)
def test_an_attitude_may_be_a_rotation_a_quaternion_or_a_matrix(value: Any) -> None:
    answer = check_answer(value)
    turned = Rotation.from_quat(answer.cam_from_ref_xyzw)
    assert (turned.inv() * TURN).magnitude() < 1e-12


def test_none_is_no_attitude() -> None:
    assert check_answer(None).status == "no attitude"


@pytest.mark.parametrize(
    "matrix",
    [-np.eye(3), np.diag([1.0, 1.0, -1.0]), 1.01 * np.eye(3), np.full((3, 3), np.nan)],
)
def test_a_matrix_that_is_no_rotation_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"the matrix"):
        to_answer(matrix)


@pytest.mark.parametrize(("name", "known"), [("shefex2", "stars"), ("afit_simsat", "leds")])
def test_a_class_gets_the_set_up_once_and_then_every_picture(name: str, known: str) -> None:
    got: list[Any] = []

    class Mine:
        def __init__(self, setup: Setup) -> None:
            got.append(setup)

        def solve(self, picture: Picture) -> Rotation:
            got.append(picture)
            return TURN

    scene = skysim.load_scene(name, {"exposure.frames": 2})
    run = skysim.simulate(scene, tracker=Mine)
    setup, *pictures = got
    lights = build_lab(scene).camera.sources
    assert len(getattr(setup, known).id) <= len(lights)
    assert setup.focal_px == pytest.approx(scene.camera.focal_px, rel=0.1)
    assert setup.time_utc.startswith("2012")
    for picture, step in zip(pictures, run, strict=True):
        np.testing.assert_array_equal(picture.image_dn, step.image)
        assert picture.exposure_s == scene.exposure.time_s
        assert (step.attitude.cam_from_ref.inv() * TURN).magnitude() < 1e-12


def test_a_function_of_a_set_up_returns_the_function_of_a_picture() -> None:
    def mine(setup: Setup) -> Any:
        return lambda picture: TURN if picture.frame and setup.stars else None

    run = skysim.simulate(skysim.load_scene("shefex2", {"exposure.frames": 2}), tracker=mine)
    assert [step.attitude.status for step in run] == ["no attitude", "solved"]


def test_what_makes_no_tracker_is_refused() -> None:
    def mine(setup: Setup) -> int:
        return 3

    scene = skysim.load_scene("shefex2", {"exposure.frames": 1})
    with pytest.raises(InputError, match=r"mine made int of its set-up; allowed: an object"):
        skysim.simulate(scene, tracker=mine)
    with pytest.raises(
        InputError, match=r"the class dict; allowed: .*first parameter `setup`"
    ):
        factory.tracker_of("dict", dict)
