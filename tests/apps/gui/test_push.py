"""Pushing the vehicle in the 3-D view: torque, motion, and frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.labpage import (
    CHROMIUM,
    angles,
    changed,
    come,
    open_scene,
    source,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.worker.geometry import PULL_RAD_S, Grip, Push, pull_torque_nm
from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.simulation.lab import Lab, build_lab, exposure_window

pytest_plugins = ["tests.helpers.labpage"]
INERTIA = np.array([6.0, 6.5, 9.0])
SPHERE_KG_M2 = 120.0  # of shefex2's vehicle, which is free


@pytest.fixture(scope="module")
def free() -> Lab:
    return build_lab(loader.load("shefex2", {"light.limit_mag": "3"}))


def test_the_pull_force_is_linear_up_to_a_limit() -> None:
    """A force k d at the lever r: the torque of a spring of J PULL_RAD_S^2, with J the mean moment."""
    rest = np.zeros(3)
    turned = Rotation.from_rotvec([0.1, -0.4, 0.3])
    held = np.array([0.3, 0.0, 0.4])
    way = np.array([0.0, 0.01, 0.0])
    grip = Grip(tuple(held), tuple(turned.apply(held + way)))
    stiffness = INERTIA.mean() * PULL_RAD_S**2
    expected = stiffness * np.cross(held, way) / 0.25  # r^2
    np.testing.assert_allclose(
        pull_torque_nm(grip, turned, rest, np.diag(INERTIA)), expected, rtol=1e-9, atol=1e-12
    )
    far = Grip(tuple(held), tuple(turned.apply(held + 1000 * way)))
    assert np.linalg.norm(
        pull_torque_nm(far, turned, rest, np.diag(INERTIA))
    ) == pytest.approx(stiffness)
    along = Grip(tuple(held), tuple(turned.apply(3 * held)))
    np.testing.assert_allclose(
        pull_torque_nm(along, turned, rest, np.diag(INERTIA)), 0.0, atol=1e-9
    )
    np.testing.assert_array_equal(
        pull_torque_nm(None, turned, rest, np.diag(INERTIA)), np.zeros(3)
    )


def test_a_pushed_free_vehicle_gains_and_keeps_torque_times_time(free: Lab) -> None:
    """L = int T dt in the lab, where T turns with the vehicle; then nothing changes L."""
    push = Push(free, Rotation.from_rotvec([0.2, 0.5, -0.3]))
    grip = Grip((0.5, 0.1, 0.2), (0.1, 0.6, 0.4))
    gained = np.zeros(3)
    for _ in range(100):
        before = push.lab_from_body
        push.advance(grip, 0.01)
        half = Rotation.from_rotvec((before.inv() * push.lab_from_body).as_rotvec() / 2)
        gained += (before * half).apply(push.torque_nm) * 0.01

    def momentum() -> np.ndarray:
        return push.lab_from_body.apply(SPHERE_KG_M2 * push.simulation.rate_body_rad_s)

    assert np.linalg.norm(gained) > 10
    np.testing.assert_allclose(momentum(), gained, rtol=0, atol=1e-4 * np.linalg.norm(gained))
    kept = momentum()
    for _ in range(10):
        push.advance(None, 0.1)
    np.testing.assert_allclose(momentum(), kept, rtol=0, atol=1e-9 * np.linalg.norm(kept))
    assert push.simulation.now_s == pytest.approx(2.0)


def test_a_vehicle_without_gravity_comes_to_the_pulled_attitude(free: Lab) -> None:
    """A critically damped pendulum from rest: angle (1 - (1 + W t) exp(-W t)) of the offset, without overshoot."""
    push = Push(free, Rotation.identity())
    offset = math.radians(2)
    grip = Grip((0.5, 0.0, 0.0), (0.5 * math.cos(offset), 0.5 * math.sin(offset), 0.0))
    turned = []
    for _ in range(300):
        push.advance(grip, 0.01)
        turned.append(push.lab_from_body.as_rotvec()[2])
    phase = PULL_RAD_S * 0.01 * np.arange(1, 301)
    expected = offset * (1 - (1 + phase) * np.exp(-phase))
    np.testing.assert_allclose(turned, expected, rtol=0, atol=0.01 * offset)


def test_a_short_pull_is_slow(free: Lab) -> None:
    """No faster than the pulled angle times PULL_RAD_S / e, which it has after 1 / PULL_RAD_S."""
    push = Push(free, Rotation.identity())
    offset = math.radians(30)
    grip = Grip((0.5, 0.0, 0.0), (0.5 * math.cos(offset), 0.5 * math.sin(offset), 0.0))
    rates = []
    for _ in range(300):
        push.advance(grip, 0.01)
        rates.append(np.linalg.norm(push.simulation.rate_body_rad_s))
    assert max(rates) == pytest.approx(math.sin(offset) * PULL_RAD_S / math.e, rel=0.05)


def test_a_frame_sees_the_motion_of_its_exposure(free: Lab) -> None:
    push = Push(free, Rotation.identity())
    window = exposure_window(free.scene, 0)
    still = push.seen()
    assert still.rate_at(window.open_s).tolist() == [0, 0, 0]
    for _ in range(20):
        push.advance(Grip((0.5, 0.0, 0.0), (0.0, 0.5, 0.0)), 0.1)
    rate = push.simulation.rate_body_rad_s.copy()
    seen = push.seen()
    close_s = window.close_s
    turned = (seen.attitude_at(window.open_s).inv() * seen.attitude_at(close_s)).as_rotvec()
    np.testing.assert_allclose(turned, rate * (close_s - window.open_s), rtol=0.05, atol=1e-6)
    np.testing.assert_allclose(seen.rate_at(close_s), rate, rtol=0.01, atol=1e-9)


@pytest.mark.parametrize(
    ("scene", "reason"), [("collimated_display", "no vehicle"), ("two_heads", "prescribed")]
)
def test_only_a_moving_vehicle_can_be_pushed(scene: str, reason: str) -> None:
    lab = build_lab(loader.load(scene, {}))
    with pytest.raises(InputError, match=reason):
        Push(lab, lab.start)


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_dragging_the_vehicle_moves_it_and_reset_restores_it(page: Any) -> None:
    open_scene(page, "afit_simsat")
    page.get_by_role("button", name="outside").click()
    before = angles(page)
    frame = source(page)
    moved = page.locator(".lab-push")
    box = page.locator(".lab-space > canvas").first.bounding_box()
    x = box["x"] + 0.5 * box["width"]
    y = box["y"] + 0.5 * box["height"]
    for step in range(20):  # from the middle downwards until the vehicle is under the mouse
        page.mouse.move(x, y + 8 * step)
        page.mouse.down()
        page.mouse.move(x + 60, y + 8 * step)
        page.wait_for_timeout(300)
        if moved.is_visible():
            break
        page.mouse.up()
        page.get_by_role("button", name="outside").click()
    page.locator(".lab-push .mono", has_text="N m").wait_for()
    assert come(lambda: float(page.locator(".lab-push .mono").inner_text().split()[0]) > 0.1)
    changed(page, frame)
    assert come(lambda: bool(np.abs(angles(page) - before).max() > 0.05))
    page.mouse.up()
    assert come(lambda: page.locator(".lab-push .mono").inner_text().startswith("0 N m"))
    page.get_by_role("button", name="reset").click()
    assert come(lambda: bool(np.abs(angles(page) - before).max() < 1e-3))
    assert not moved.is_visible()
    open_scene(page, "shefex2")
