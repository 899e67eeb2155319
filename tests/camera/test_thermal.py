"""Drift with the temperature: expansion of the dome, rotation of the camera, focal length; exactly by their laws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.camera.thermal_motion import camera_at, leds_at, temperature_c
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Mount, Sources
from skysim.scene import loader
from skysim.scene.sections.surroundings import ThermalConfig
from skysim.simulation.flight import simulate_motion

MOUNT = {"mount_arcsec_k": [3.0, -2.0, 1.0]}
LINEAR = {"kind": "linear", "start_c": 20.0, "rate_c_h": 2.0}


def config(temperature: dict[str, Any], **rest: Any) -> ThermalConfig:
    return ThermalConfig.model_validate({"temperature": temperature} | (rest or MOUNT))


@pytest.mark.parametrize(
    ("history", "expected_c"),
    [
        ({"kind": "steady", "temperature_c": 23.0}, 23.0),
        (LINEAR, 23.0),
        (
            {
                "kind": "sine",
                "mean_c": 20.0,
                "amplitude_c": 4.0,
                "period": "9 h",
                "phase_deg": 30.0,
            },
            24.0,
        ),
        (
            {"kind": "table", "hours": [0.0, 1.0, 2.0], "temperature_c": [20.0, 22.0, 26.0]},
            24.0,
        ),
    ],
    ids=lambda value: value["kind"] if isinstance(value, dict) else "",
)
def test_temperature_after_an_hour_and_a_half(
    history: dict[str, Any], expected_c: float
) -> None:
    """The same holds after half an hour for a history three times as fast."""
    assert temperature_c(config(history), 5400.0) == pytest.approx(expected_c, abs=1e-12)
    assert temperature_c(config(history, speed=3.0, **MOUNT), 1800.0) == pytest.approx(
        expected_c, abs=1e-12
    )


def test_table_is_constant_beyond_its_ends() -> None:
    settings = config({"kind": "table", "hours": [1.0, 2.0], "temperature_c": [20.0, 22.0]})
    assert [temperature_c(settings, t_s) for t_s in (0.0, 9000.0)] == [20.0, 22.0]


MOUNTED = Mount(np.array([0.0, 0.0, 0.4]), Rotation.from_euler("x", 0.3))


def leds_and_stars() -> Sources:
    """Two LEDs and a star."""
    ones = np.ones(3)
    place = np.array([[0.3, -0.2, 1.1, 1.0], [0.0, 0.0, 1.2, 1.0], [0.0, 0.0, 1.0, 0.0]])
    rows = np.arange(3)
    return Sources(
        rows, place, np.tile([0.0, 0, -1], (3, 1)), ones, ones, ones, ones, ones, rows, ones
    )


def test_dome_expands_from_its_anchor() -> None:
    """By alpha dT of the distance from it, and creeps; stars stay where they are."""
    settings = config(
        LINEAR, dome_ppm_k=70.0, anchor_height="0.9 m", creep=["0 m", "0 m", "-1 mm"]
    )
    before = leds_and_stars()
    after = leds_at(settings, before, 2 * 3600.0)
    anchor = np.array([0.0, 0.0, 0.9])
    strain = 70e-6 * 4.0
    expected = anchor + (1 + strain) * (before.place[:2, :3] - anchor) + [0.0, 0.0, -1e-3]
    np.testing.assert_allclose(after.place[:2, :3], expected, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(after.place[2], before.place[2])
    optics = Optics.from_camera(loader.load("afit_simsat").camera)
    assert camera_at(settings, MOUNTED, optics, 2 * 3600.0)[1] is optics


def test_image_grows_with_the_focal_length() -> None:
    before = Optics.from_camera(loader.load("afit_simsat").camera)
    _, after = camera_at(config(LINEAR, lens_ppm_k=25.0), MOUNTED, before, 3600.0)
    rays = np.array([[0.02, -0.05, 1.0], [0.0, 0.07, 1.0]])
    center = np.array(before.camera.center_px)
    expected = center + (1 + 50e-6) * (before.project(rays) - center)
    np.testing.assert_allclose(after.project(rays), expected, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_boresight_drifts_by_its_coefficient_in_the_truth() -> None:
    """Every frame's camera is rotated by the coefficient times dT about its axes, and so are its stars."""
    settings = {
        "thermal.temperature": "{kind: linear, start_c: 19, rate_c_h: 2}",
        "thermal.speed": "1800",
        "thermal.mount_arcsec_k": "[300, -200, 100]",
        "exposure.frames": "3",
        "exposure.rate_hz": "1",
        "camera.detector.noise": "false",
    }
    flight = simulate_motion(loader.load("shefex2", settings))
    camera = flight.lab.camera
    for index in range(3):
        _, truth = flight.render(index)
        nominal = camera.mount.cam_from_body * truth.lab_from_body.inv()
        drift_k = -1 + truth.t_s  # 2 K an hour, 1800 times as fast
        turned = (truth.cam_from_lab * nominal.inv()).as_rotvec() / ARCSEC_RAD
        np.testing.assert_allclose(
            turned, np.array([300.0, -200.0, 100.0]) * drift_k, atol=1e-6
        )
        stars = camera.sources.take(np.isin(camera.sources.id, truth.sources.id))
        rows = np.searchsorted(
            truth.sources.id, stars.id, sorter=np.argsort(truth.sources.id)
        )
        xy_px = camera.optics.project(truth.cam_from_lab.apply(stars.place[:, :3]))
        found = truth.sources.xy_px[np.argsort(truth.sources.id)[rows]]
        np.testing.assert_allclose(found, xy_px, atol=1e-6)


def test_a_section_without_a_coefficient_is_refused() -> None:
    with pytest.raises(ValidationError, match="nothing depends on the temperature"):
        config(LINEAR, creep=["0 m", "0 m", "-1 mm"])
