"""The noise chain's mean and variance against getframes', the same built in both (extra `oracle`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skysim.camera import detector
from skysim.camera.detector import Detector
from skysim.scene.sections.camera import CameraConfig

gf = pytest.importorskip("getframes")

SHAPE = (80, 100)
FRAMES = 60


def both(
    mean_e: float, exposure_s: float = 0.5, **part: Any
) -> tuple[np.ndarray, np.ndarray]:
    """(FRAMES, H, W) pixel values of skysim and of getframes."""
    ours = {
        "quantum_efficiency": 1.0,
        "full_well_e": 4e4,
        "read_noise_e": 12.0,
        "dark_e_s": 60.0,
        "gain_e_dn": 3.7,
        "offset_dn": 100.0,
        "bits": 14,
        "hardware_seed": 3,
    } | part
    lens = {
        "width_px": SHAPE[1],
        "height_px": SHAPE[0],
        "pixel": "5 um",
        "focal_length": "25 mm",
        "f_number": 2,
    }
    built = Detector.from_camera(CameraConfig.model_validate(lens | {"detector": ours}))
    rng = np.random.default_rng(1)
    light = np.full(SHAPE, mean_e, np.float32)
    mine = np.array(
        [detector.expose(light.copy(), exposure_s, built, rng) for _ in range(FRAMES)], float
    )
    config = gf.CameraConfig(
        name="oracle",
        sensor_type=gf.SensorType.CCD,
        resolution=SHAPE,
        pixel_size_um=5.0,
        quantum_efficiency=1.0,
        full_well_e=ours["full_well_e"],
        bit_depth=ours["bits"],
        gain_e_per_adu=ours["gain_e_dn"],
        bias_offset_adu=ours["offset_dn"],
        read_noise_e=ours["read_noise_e"],
        prnu=ours.get("prnu", 0.0),
        dark_current_e_per_s=ours["dark_e_s"],
        dark_current_nonuniformity=ours.get("dsnu", 0.0),
        fixed_pattern_seed=9,
    )
    made = gf.Camera(config, seed=2)
    theirs = np.array(
        [made.expose(mean_e / exposure_s, exposure_s).data for _ in range(FRAMES)], float
    )
    return mine, theirs


@pytest.mark.parametrize("mean_e", [0.0, 5.0, 300.0, 20_000.0])
def test_mean_and_variance_agree_with_getframes(mean_e: float) -> None:
    mine, theirs = both(mean_e)
    count = mine.size
    variance = mine.var()
    assert mine.mean() == pytest.approx(theirs.mean(), abs=5 * np.sqrt(2 * variance / count))
    assert variance == pytest.approx(theirs.var(), rel=5 * np.sqrt(2 * 2 / count))


def test_fixed_pattern_noise_agrees_with_getframes() -> None:
    """PRNU of 2 % and a dark current that varies by 30 %: the scatter of the pixels' own means."""
    spread = [
        frames.mean(axis=0).std()
        for frames in both(10_000.0, prnu=0.02, dsnu=0.3, dark_e_s=2000.0)
    ]
    assert spread[0] == pytest.approx(
        spread[1], rel=5 * np.sqrt(2 / (2 * SHAPE[0] * SHAPE[1]))
    )


def test_saturation_agrees_with_getframes() -> None:
    mine, theirs = both(1e5, read_noise_e=0.0)
    np.testing.assert_allclose(mine, np.median(theirs), rtol=0, atol=1)
