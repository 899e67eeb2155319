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
from skysim.dynamics.flight_computer import authority_nm
from skysim.dynamics.multibody.actuator_kind import ControlInput
from skysim.dynamics.multibody.mass import tree_mass
from skysim.dynamics.multibody.model import build_actuators, build_drives
from skysim.scene import loader
from skysim.scene.sections.vehicle import VehicleConfig
from skysim.simulation.flight import simulate_motion

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


# --- in flight ----------------------------------------------------------------------------------------------


def driven(
    flying: multibody.VehicleModel, wanted_m: list[float], seconds: float, start: Rotation
) -> tuple[multibody.Simulation, np.ndarray]:
    """A flight with the displacements commanded from its start on, and the (K, 3) positions of the motors."""
    (drive,) = build_drives(flying.config, flying)
    flight = multibody.Simulation(flying, start, np.zeros(3), seconds)
    motors = [flying.model.actuator(name).id for name in flying.trims.names]
    positions = []
    while flight.steps_left:
        control = np.zeros((10, flying.model.nu))
        control[:, motors] = wanted_m
        drive.apply(control, flight.angles_rad)
        flight.advance(control)
        positions.append(drive.readings["trim_m"])
    return flight, np.array(positions)


def test_masses_that_stay_in_place_move_the_vehicle_as_held_ones_do() -> None:
    place = {"position": ["3 mm", "-5 mm", "-12 mm"]}
    start = Rotation.from_euler("xyz", [8, -5, 30], degrees=True)
    held = multibody.Simulation(vehicle(trim=place), start, np.zeros(3), 3.0)
    held.advance(np.zeros((3000, held.model.nu)))
    flight, positions = driven(vehicle(trim=place, trims={}), [0, 0, 0], 3.0, start)
    np.testing.assert_allclose(positions, [[3e-3, -5e-3, -12e-3]] * 300, rtol=0, atol=1e-15)
    end, expected = (one.lab_from_body_wxyz for one in (flight, held))
    assert np.abs(expected - held.knots()[1][0]).max() > 0.02
    np.testing.assert_allclose(end, expected, rtol=0, atol=1e-4)
    # A lead screw does not sag: 0.25 mm would be that of a servo alone.
    np.testing.assert_allclose(
        flight.angles_rad[4:7], [3e-3, -5e-3, -12e-3], rtol=0, atol=2e-6
    )


def test_masses_move_at_their_speed_to_their_travel() -> None:
    table = vehicle(trims={"travel": "4 mm", "speed_limit": "5 mm/s"})
    _, positions = driven(table, [3e-3, -9e-3, 1e-3], 1.0, Rotation.identity())
    t_s = 0.01 * np.arange(1, 101)
    expected = np.minimum(5e-3 * t_s[:, None], [3e-3, 4e-3, 1e-3]) * [1, -1, 1]
    np.testing.assert_allclose(positions, expected, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_displaced_mass_tilts_the_table_by_its_weight_times_its_lever() -> None:
    """At rest the first moment M c + m d points down: it was moved by (0.2 kg 4 mm, -0.2 kg 3 mm, 0)."""
    table = vehicle(trims={}, drag={"viscous": "0.1 N m s"})
    flight, _ = driven(table, [4e-3, -3e-3, 0], 40.0, Rotation.identity())
    moment = 7.04 * np.array([40e-6, -30e-6, -350e-6]) + 0.2 * np.array([4e-3, -3e-3, 0])
    down = Rotation.from_quat(flight.lab_from_body_wxyz, scalar_first=True).inv()
    np.testing.assert_allclose(
        down.apply([0, 0, -1]), moment / np.linalg.norm(moment), rtol=0, atol=1e-3
    )


def test_displacements_give_the_horizontal_part_of_a_torque() -> None:
    """T = m d a x g, of 0.2 kg each: on a level table x turns about +y, y about -x, and z about nothing."""
    table = vehicle(trims={"speed_limit": "1 m/s", "travel": "50 mm"})
    actuator = build_actuators(table.config, table)["trims"]
    control = np.zeros(table.model.nu)
    level = ControlInput(0.0, 0.1, np.zeros(3), table.model.qpos0, np.zeros(table.model.nv))
    achieved = actuator.allocate(control, np.array([0.01, 0.02, 0.5]), level)
    np.testing.assert_allclose(achieved, [0.01, 0.02, 0], rtol=0, atol=1e-15)
    weight_n = 0.2 * 9.80665
    np.testing.assert_allclose(
        control[actuator.motor], [0.02 / weight_n, -0.01 / weight_n, 0], rtol=0, atol=1e-15
    )
    assert authority_nm(actuator) == pytest.approx(0.05 * weight_n)


@pytest.mark.slow
def test_trim_masses_balance_the_table_in_flight() -> None:
    """A controller that holds the table level brings the center of mass below the bearing: m d = -M c."""
    changes = {
        "vehicle.trims": "{}",
        "vehicle.trim": "null",
        "vehicle.imu": "null",
        "vehicle.disturbances": "{}",
        "vehicle.center_of_mass": '["40 um", "-30 um", "-350 um"]',
        "filter": "null",
        "motion": "{control: {law: pid, actuators: trims, bandwidth_rad_s: 0.8, integral_rad_s: 0.3},"
        " maneuver: [{kind: hold, duration: 60 s}]}",
        "exposure": "{time: 10 ms, frames: 60, rate_hz: 1}",
    }
    log = simulate_motion(loader.load("cubesat_table", changes)).telemetry()
    assert log.readings["trim_m"].shape[1] == 3
    np.testing.assert_allclose(
        log.readings["trim_m"][-1],
        [-7.04 * 40e-6 / 0.2, 7.04 * 30e-6 / 0.2, 0],
        rtol=0,
        atol=2e-5,
    )
    assert np.degrees(log.lab_from_body[-1].magnitude()) < 0.05


def test_trims_beyond_their_travel_and_on_a_free_vehicle_are_refused() -> None:
    with pytest.raises(
        InputError, match=r"trim.position: beyond vehicle.trims.travel 0.004 m"
    ):
        vehicle(trim={"position": ["5 mm", "0 m", "0 m"]}, trims={"travel": "4 mm"})
    with pytest.raises(ValidationError, match="trims: a free vehicle rotates about"):
        vehicle(mount="free", center_of_mass=["0 m", "0 m", "0 m"], trims={})
