"""A flight's figures, table and plot, from an artificial flight with known numbers."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core.types import Telemetry
from skysim.dynamics.imu import Increments
from skysim.results import telemetry_report

T_S = np.arange(50) * 0.01
DEG = np.pi / 180


def turned(axis: str, degrees: np.ndarray | float) -> Rotation:
    return Rotation.from_euler(
        axis, np.broadcast_to(degrees, len(T_S))[:, None], degrees=True
    )


def bare() -> Telemetry:
    """Telemetry without control: a yaw at 10 deg/s."""
    nothing = np.zeros((len(T_S), 3))
    return Telemetry(
        T_S,
        0.01,
        turned("z", 10 * T_S),
        nothing + np.array([0, 0, 10 * DEG]),
        nothing,
        nothing,
        nothing,
        np.empty((len(T_S), 0)),
        np.empty((len(T_S), 0)),
        np.empty((len(T_S), 4)),
    )


def full() -> Telemetry:
    """The reference is 2 deg ahead in yaw, the IMU ends 0.5 deg off in roll, the filter is 3 arcsec off throughout."""
    log = bare()
    bias = np.full((len(T_S), 3), 5 * DEG / 3600)
    return replace(
        log,
        lab_from_ref=turned("z", 10 * T_S + 2),
        torque_nm=np.column_stack([T_S, -4 * T_S, T_S]),
        momentum_nms=np.column_stack([3 * T_S, 4 * T_S, 0 * T_S]),
        wheel_rad_s=np.column_stack([T_S * 100, -T_S * 200]),
        gimbal_rad=np.column_stack([T_S]),
        wheel_names=("wheel_a", "wheel_b"),
        gimbal_names=("gimbal_1",),
        manipulability=1 - T_S,
        lab_from_imu=log.lab_from_body * turned("x", T_S / T_S[-1] * 0.5),
        saturated=T_S < 0.095,
        bias_rad_s=bias,
        lab_from_filter=log.lab_from_body * turned("y", 3 / 3600),
        sigma_attitude_rad=np.full((len(T_S), 3), 1e-5),
        assumed_bias_rad_s=bias + np.array([0, 0, 1 * DEG / 3600]),
        sigma_bias_rad_s=np.full((len(T_S), 3), 1e-6),
    )


def test_telemetry_figures_match_the_flight() -> None:
    expected = {
        "pointing_deg_worst": 2.0,
        "pointing_deg_end": 2.0,
        "torque_nm_worst": 4 * T_S[-1],
        "momentum_nms_worst": 5 * T_S[-1],
        "wheel_rpm_worst": 200 * T_S[-1] * 30 / np.pi,
        "manipulability_least": 1 - T_S[-1],
        "imu_deg_worst": 0.5,
        "imu_deg_end": 0.5,
        "gyro_saturated_s": 0.1,
        "filter_deg_worst": 3 / 3600,
        "filter_arcsec_end": 3.0,
        "filter_bias_deg_h_end": 1.0,
    }
    assert telemetry_report.summary(full()) == pytest.approx(expected, rel=1e-6)


def test_an_uncontrolled_flight_has_no_control_figures() -> None:
    assert telemetry_report.summary(bare()) == {}


def test_the_table_has_the_telemetry_in_degrees() -> None:
    table = telemetry_report.table(full())
    np.testing.assert_allclose(table["true_yaw_deg"], 10 * T_S, rtol=0, atol=1e-12)
    np.testing.assert_allclose(table["commanded_yaw_deg"], 10 * T_S + 2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(table["imu_roll_deg"][-1], 0.5, rtol=0, atol=1e-12)
    np.testing.assert_allclose(table["rate_z_deg_s"], 10, rtol=0, atol=1e-12)
    np.testing.assert_allclose(table["wheel_b_rpm"], -200 * T_S * 30 / np.pi, rtol=1e-12)
    np.testing.assert_allclose(table["gimbal_1_deg"], T_S / DEG, rtol=1e-12)
    np.testing.assert_allclose(
        table["assumed_bias_z_deg_h"] - table["bias_z_deg_h"], 1, rtol=1e-9
    )
    assert {"commanded_roll_deg", "imu_roll_deg", "wheel_a_rpm"}.isdisjoint(
        telemetry_report.table(bare()).colnames
    )


def test_every_sample_of_the_imu_is_in_its_table() -> None:
    """At rest, rolled by 30 deg: the force of 1 g points up, which is (0, sin 30, cos 30) in body axes."""
    ends = np.arange(1, 9) * 2.5e-3
    force = 9.80665 * 2.5e-3 * np.array([0, 0.5, np.sqrt(0.75)])
    record = Increments(
        ends, 2.5e-3, np.full((8, 3), 1e-6), np.tile(force, (8, 1)), ends > 0.01, ends < 0.004
    )
    table = telemetry_report.imu_table(record)
    assert len(table) == 8
    np.testing.assert_allclose(table["level_roll_deg"], 30, rtol=0, atol=1e-9)
    np.testing.assert_allclose(table["level_pitch_deg"], 0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(table["velocity_y_m_s"], force[1], rtol=1e-15)
    assert table["gyro_saturated"].tolist() == [False] * 4 + [True] * 4
    assert table["accelerometer_overloaded"].tolist() == [True] + [False] * 7


@pytest.mark.slow
def test_the_plot_has_a_panel_for_each_recorded_quantity() -> None:
    heights = [
        cv2.imdecode(
            np.frombuffer(telemetry_report.figure(log), np.uint8), cv2.IMREAD_COLOR
        ).shape[0]
        for log in (bare(), full())
    ]
    assert [len(telemetry_report.panels(log)) for log in (bare(), full())] == [1, 7]
    assert heights[1] > 4 * heights[0]
