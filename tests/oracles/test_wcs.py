"""Our projection against astropy's world coordinate system from our frames' headers."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io.fits import Header
from astropy.wcs import WCS

from skysim.camera import wcs
from skysim.camera.optics import Optics
from skysim.scene.sections.camera import CameraConfig
from skysim.sources import stars as star_sources

CAMERA = CameraConfig.model_validate(
    {
        "width_px": 1600,
        "height_px": 1200,
        "pixel": "5.5 um",
        "focal_length": "25 mm",
        "f_number": 1.4,
        "principal_point_px": (790.25, 611.5),
        "detector": {
            "quantum_efficiency": 0.5,
            "full_well_e": 40000,
            "gain_e_dn": 10,
            "bits": 12,
        },
    }
)
POINTINGS = [
    (float(ra), float(np.degrees(np.arcsin(z))), float(roll))
    for ra, z, roll in np.random.default_rng(1).uniform((0, -1, -180), (360, 1, 180), (12, 3))
] + [(10.0, 89.9, 30.0), (200.0, -89.5, -75.0), (0.0, 0.0, 0.0), (359.99, 20.0, 180.0)]


def both_ways(
    pointing: tuple[float, float, float], stars: SkyCoord
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) pixels by our optics, and by astropy from the header."""
    cam_from_icrs = star_sources.cam_from_icrs(*pointing)
    ours = Optics.from_camera(CAMERA).project(
        cam_from_icrs.apply(stars.cartesian.xyz.value.T)
    )
    header = WCS(Header(wcs.header(CAMERA, cam_from_icrs)))
    return ours, np.column_stack(header.world_to_pixel(stars))


@pytest.mark.parametrize("pointing", POINTINGS)
def test_stars_are_where_astropy_s_wcs_puts_them(
    pointing: tuple[float, float, float],
) -> None:
    """Stars up to ten degrees off in all directions, laid out by astropy itself."""
    rng = np.random.default_rng(2)
    center = SkyCoord(*pointing[:2], unit="deg")
    stars = center.directional_offset_by(
        rng.uniform(0, 360, 200) * u.deg, rng.uniform(0, 10, 200) * u.deg
    )
    ours, theirs = both_ways(pointing, stars)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)
    assert np.ptp(ours, axis=0).min() > 1000  # they cover the frame


def test_north_is_up_and_east_is_left_without_roll() -> None:
    center = SkyCoord(83.0, -5.0, unit="deg")
    north, east = (
        center.directional_offset_by(angle * u.deg, 1 * u.deg) for angle in (0, 90)
    )
    step = np.tan(np.radians(1.0)) * CAMERA.focal_px
    for star, offset in ((north, (0, -step)), (east, (-step, 0))):
        ours, theirs = both_ways((83.0, -5.0, 0.0), star.reshape(1))
        wanted = np.array([CAMERA.center_px]) + offset
        np.testing.assert_allclose(ours, wanted, rtol=0, atol=1e-6)
        np.testing.assert_allclose(theirs, wanted, rtol=0, atol=1e-6)


def test_astropy_s_pixel_coordinates_equal_array_indices() -> None:
    """FITS counts from 1, arrays from 0: the pointing lands on the principal point in both counts."""
    header = WCS(Header(wcs.header(CAMERA, star_sources.cam_from_icrs(40.0, 30.0, 10.0))))
    center = SkyCoord(40.0, 30.0, unit="deg")
    np.testing.assert_allclose(
        header.world_to_pixel(center), CAMERA.center_px, rtol=0, atol=1e-6
    )
    counted_from_1 = header.all_world2pix([[40.0, 30.0]], 1)[0]
    np.testing.assert_allclose(
        counted_from_1, np.array(CAMERA.center_px) + 1, rtol=0, atol=1e-6
    )
