"""The grid to which the lens's polynomials are fitted; `tests/results/test_formats.py` has them against astropy."""

from __future__ import annotations

import numpy as np
import pytest

from skysim.camera import wcs
from skysim.scene.sections.camera import CameraConfig


@pytest.mark.parametrize(
    "center_px", [(319.5, 239.5), (-300.0, 239.5), (900.0, 700.0), (-250.0, -200.0)]
)
@pytest.mark.parametrize("k1", [-0.1, 0.1])
def test_the_fit_s_points_cover_the_chip_and_little_more(
    center_px: tuple[float, float], k1: float
) -> None:
    """Also of a chip beside the optical axis: from edge to edge, and few points elsewhere."""
    camera = CameraConfig.model_validate(
        {
            "width_px": 640,
            "height_px": 480,
            "pixel": "5 um",
            "focal_length": "10 mm",
            "f_number": 2.0,
            "principal_point_px": center_px,
            "distortion": (k1, 0.0, 0.0, 0.0, 0.0),
            "detector": {
                "quantum_efficiency": 0.5,
                "full_well_e": 40000,
                "gain_e_dn": 10,
                "bits": 12,
            },
        }
    )
    _, distorted_px, on_chip = wcs.fit_grid(camera.calibration(), wcs.GRID_SIDE)
    pixels = distorted_px + center_px
    size = np.array([640, 480])
    assert (pixels[on_chip] >= -0.5).all()
    assert (pixels[on_chip] <= size - 0.5).all()
    # Within the margin of all four edges, and at each of them to a step of the grid.
    assert (pixels >= -0.5 - wcs.MARGIN * size).all()
    assert (pixels <= size - 0.5 + wcs.MARGIN * size).all()
    assert (pixels.min(axis=0) < size / wcs.GRID_SIDE).all()
    assert (pixels.max(axis=0) > size - size / wcs.GRID_SIDE).all()
    assert on_chip.sum() > 0.6 * wcs.GRID_SIDE**2
    assert wcs.fit_sip(camera.calibration()).worst_px < wcs.MAX_ERROR_PX
