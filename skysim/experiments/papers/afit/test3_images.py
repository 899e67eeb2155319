"""AFIT's Test 3 at fixed attitudes (Padro 2012, 3.7.3): five LEDs imaged from five attitudes, and his measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.calibration.home_position import Sighting, instrument_brightness
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core.arrays import Ints
from estimator.core.types import FramePriors
from estimator.detection.detect import DETECTORS
from skysim.core.types import Floats, Mount
from skysim.dynamics import guidance
from skysim.experiments.papers.afit.test_stand import light_positions_m, pair_angles_arcsec
from skysim.experiments.papers.published import experiments
from skysim.scene import loader
from skysim.scene.sections.motion import AttitudeConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking import onboard_model
from skysim.tracking import settings as tracker_settings

# Roll, pitch, yaw in degrees, Tables 10-14: by the IMU, and by the thesis's algorithm.
IMU_DEG = experiments()["afit-table-10-15"].data["imu_deg"]
ALGORITHM_DEG = experiments()["afit-table-10-15"].data["algorithm_deg"]
LEDS = 5
HOME = 0

CAMERA_ROTATION_DEG = (
    55.0  # of the camera about its boresight: assumed; at 0 deg it misses position 4
)
# Table 9
EPSILON_MAG = 10.191
EPSILON_POS_M = 1.9861e-3
EPSILON_SEP_ARCSEC = 9.675

# What the thesis states about its images, and assumptions for the rest; see data/published.
STATED_IMAGING = {
    "camera.detector.bits": "8",
    "camera.detector.gain_e_dn": "164",
    "camera.detector.offset_dn": "2",
    "light.led.scatter": "0",
    "light.led.intensity": "35 mcd",
    "light.layout.levels": "[1.0, 0.5, 0.4, 0.2, 0.075]",
    "exposure.rate_hz": "0.987",
}
FITTED_IMAGING = {  # rolling shutter, exposure of a non-integer number of LED cycles, early saturation
    "camera.shutter": '{kind: rolling, row_time: "83 us"}',
    "tracker.assumed_row_time": "0 s",  # the thesis's tracker does not know its rows' times
    "camera.detector.full_well_e": "30500",
    "exposure.time": "16.667 ms",
    "light.led.intensity": "73.5 mcd",
}


def build_test3(overrides: Mapping[str, str] | None = None) -> Lab:
    """Test 3's lab, with the camera turned so that all five positions are on the detector."""
    lab = build_lab(loader.load("afit_test3_ideal", STATED_IMAGING | dict(overrides or {})))
    cam_from_body = (
        Rotation.from_euler("z", CAMERA_ROTATION_DEG, degrees=True) * lab.camera.mount.cam_from_body
    )
    return lab.with_camera(mount=Mount(lab.camera.mount.camera_body_m, cam_from_body))


def lab_from_body(angles_deg: Sequence[float]) -> Rotation:
    """lab_from_body from roll, pitch and yaw."""
    roll, pitch, yaw = angles_deg
    return guidance.attitude(AttitudeConfig(roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw))


def angles_deg(lab_from_body: Rotation) -> Floats:
    """(..., 3) roll, pitch, yaw."""
    return np.asarray(lab_from_body.as_euler("ZYX", degrees=True)[..., ::-1])


def photograph(
    lab: Lab, position: int, lab_from_body: Rotation, images: int, rng: np.random.Generator
) -> list[Sighting]:
    """Images from one attitude at random times; lights identified by the truth, in the order of the LEDs.

    The IMU's attitude is the true one. Images without all five LEDs are left out.
    """
    camera = onboard_model.calibration(lab.scene.camera)
    settings = tracker_settings.assumed_settings(lab.scene)
    sightings = []
    for seed in rng.integers(
        2**62, size=images
    ):  # each image in a run of its own, for a random phase of the LEDs
        frame, truth = render_at_rest(lab.in_run(int(seed)).camera, lab_from_body)
        priors = FramePriors(None, frame.saturation_dn)
        blobs = DETECTORS["thesis"](frame.image_dn, priors=priors)
        lights = CENTROIDERS["cog"](frame.image_dn, blobs, settings.gain_e_dn, priors)
        inside = camera.contains(lights.xy_px)
        _, nearest = cKDTree(truth.sources.xy_px).query(lights.xy_px[inside])
        magnitude = instrument_brightness(blobs.flux / blobs.area_px, blobs.area_px.astype(float))[
            inside
        ]
        led, led_row = np.unique(truth.sources.id[nearest], return_index=True)
        if len(led) == LEDS:
            xy_px = lights.xy_px[inside][led_row]
            sightings.append(
                Sighting(position, lab_from_body.inv(), led, xy_px, magnitude[led_row])
            )
    return sightings


@dataclass(frozen=True, slots=True)
class Measurements:
    """F images of all five LEDs as the thesis measures them (eqs 43-45).

    position : (F,) of the vehicle, from 0;  magnitude : (F, 5)
    body_m, lab_m : (F, 5, 3) LED positions in body axes, and rotated to the lab frame by the IMU's attitude
    """

    position: Ints
    magnitude: Floats
    body_m: Floats
    lab_m: Floats

    @property
    def separation_arcsec(self) -> Floats:
        """(F, 10) angle about the bearing of every pair, in the order of np.triu_indices."""
        return pair_angles_arcsec(self.body_m)


def measure(lab: Lab, sightings: Sequence[Sighting]) -> Measurements:
    """Measure the images as in the thesis."""
    body_m = np.array([light_positions_m(lab, sighting.xy_px) for sighting in sightings])
    lab_m = np.array(
        [one.body_from_lab.inv().apply(led_m) for one, led_m in zip(sightings, body_m, strict=True)]
    )
    position, magnitude = (
        np.array([getattr(one, name) for one in sightings]) for name in ("stop", "brightness")
    )
    return Measurements(position, magnitude, body_m, lab_m)
