"""Trim masses: positions held by a motor, and effect on the vehicle's mass properties."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.dynamics import multibody
from skysim.dynamics.multibody.mass import tree_mass
from skysim.scene.sections.vehicle import VehicleConfig

CUBESAT = {"model": "vehicles/cubesat.xml", "center_of_mass": ["40 um", "-30 um", "-350 um"]}


def vehicle(**changes: object) -> multibody.VehicleModel:
    return multibody.build(VehicleConfig.model_validate(CUBESAT | changes))


def trimmed(*position_mm: float, step: str = "1 um") -> multibody.VehicleModel:
    return vehicle(trim={"position": [f"{one} mm" for one in position_mm], "step": step})


def test_moved_masses_change_center_and_inertia_as_in_mujoco() -> None:
    """In MuJoCo's own sum over bodies: the center moves by mass times travel over the total, the axes' inertia too."""
    moved = trimmed(3, -5, 12)
    still = vehicle()
    weighed = tree_mass(moved.model)
    np.testing.assert_allclose(moved.mass.center_m, weighed.center_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(moved.inertia_kg_m2, weighed.inertia_kg_m2, rtol=0, atol=1e-12)
    expected = still.mass.center_m + 0.2 * np.array([3e-3, -5e-3, 12e-3]) / still.mass.mass_kg
    np.testing.assert_allclose(moved.mass.center_m, expected, rtol=0, atol=1e-12)
    full = np.zeros((3, 3))
    data = mujoco.MjData(moved.model)
    mujoco.mj_forward(moved.model, data)
    mujoco.mj_fullM(moved.model, data, full)
    np.testing.assert_allclose(full, moved.inertia_kg_m2, rtol=0, atol=1e-12)


def test_a_trimmed_vehicle_swings_with_its_new_period() -> None:
    """A pendulum about body x: T = 2 pi sqrt(J / (m g r)) for small swings, with the mass lowered by 15 mm."""
    low = vehicle(
        center_of_mass=["0 m", "0 m", "-350 um"], trim={"position": ["0 m", "0 m", "-15 mm"]}
    )
    J = low.inertia_kg_m2[0, 0]
    depth_m = -low.mass.center_m[2]
    period_s = 2 * np.pi * np.sqrt(J / (low.mass.mass_kg * low.gravity_m_s2 * depth_m))
    flight = multibody.simulate(
        low, Rotation.from_rotvec([0.002, 0, 0]), np.zeros(3), 1.1 * period_s
    )
    roll = flight.lab_from_body.as_rotvec()[:, 0]
    falling = np.flatnonzero((roll[:-1] > 0) & (roll[1:] <= 0))
    # Products of inertia couple a little.
    assert 4 * flight.t_s[falling[0]] == pytest.approx(period_s, rel=0.02)


def test_trim_masses_move_in_whole_steps_and_are_locked_without_their_section() -> None:
    np.testing.assert_allclose(
        trimmed(1.0031, 0, 0, step="2 um").trims.position_m, [1.004e-3, 0, 0], atol=1e-12
    )
    assert len(vehicle().trims) == 0
    assert vehicle().model.nv == 3
    assert trimmed(1, 2, 3).trims.names == ("trim_x", "trim_y", "trim_z")


def test_a_mass_that_a_motor_cannot_hold_is_refused() -> None:
    with pytest.raises(
        InputError,
        match=r"^vehicle.trim.position: 2 values; allowed: 3, one for each of trim_x, ",
    ):
        trimmed(1, 2)
    with pytest.raises(ValidationError, match="position: beyond travel 20 mm"):
        trimmed(21, 0, 0)
    with pytest.raises(
        ValidationError, match="trim: a free vehicle rotates about its center of mass"
    ):
        vehicle(mount="free", trim={}, center_of_mass=["0 m"] * 3)
    with pytest.raises(
        InputError, match=r"simsat.xml: no joint trim_\*, which vehicle.trim needs$"
    ):
        vehicle(model="vehicles/simsat.xml", trim={})


@pytest.mark.slow
def test_slides_of_other_kinds_are_refused(tmp_path: Path) -> None:
    text = (SCENES / "vehicles/cubesat.xml").read_text(encoding="utf-8")
    for old, new, refusal in (
        ('name="trim_x" type="slide"', 'name="trim_x"', "must be slides"),
        (
            'type="slide" axis="1',
            'type="slide" range="-1 1" axis="1',
            "trim_x: range is set by the scene",
        ),
        (
            '<body name="trim_x" pos="0 -0.13 -0.01">',
            '<body><body name="trim_x">',
            "on a body directly in body bus",
        ),
    ):
        changed = text.replace(old, new)
        if "<body><body" in new:
            changed = changed.replace(
                '<geom class="trim"/>\n      </body>', '<geom class="trim"/></body></body>', 1
            )
        path = tmp_path / "vehicle.xml"
        path.write_text(changed, encoding="utf-8")
        with pytest.raises(InputError, match=refusal):
            vehicle(model=str(path), trim={})
