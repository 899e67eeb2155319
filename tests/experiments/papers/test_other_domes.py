"""JHU/APL's dome (Boone et al. 2005, by Padro 2012, section 2.6): angles from the stated radius and variation."""

from __future__ import annotations

import numpy as np
import pytest

from skysim.core.constants import ARCSEC_RAD, INCH_M
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.sources import dome
from skysim.sources.photometry import Band

RADIUS_M = 48 * INCH_M  # "a 4-ft radius hemispherical dome"
VARIATION = 0.004  # "the variation in radius was found to be as low as 0.4 %"


@pytest.fixture(scope="module")
def fibers_m() -> tuple[Floats, Floats]:
    """(N, 3) places of the fibers on the stretched shell, and on a perfect sphere."""
    shells = []
    for variation in (VARIATION, 0.0):
        scene = loader.load(
            "apl_dome_ideal", {"light.layout.radius_variation": str(variation)}
        )
        shells.append(dome.sources(scene.light, Band.from_camera(scene.camera)).place[:, :3])
    return shells[0], shells[1]


def angles_arcsec(seen_m: Floats, expected_m: Floats) -> Floats:
    """(N,) angles between directions."""
    sine = np.linalg.norm(np.cross(seen_m, expected_m), axis=1)
    return (
        np.arcsin(sine / np.linalg.norm(seen_m, axis=1) / np.linalg.norm(expected_m, axis=1))
        / ARCSEC_RAD
    )


def test_a_hundred_fibers_are_on_a_shell_of_the_stated_variation(
    fibers_m: tuple[Floats, Floats],
) -> None:
    radius_m, perfect_m = (np.linalg.norm(place_m, axis=1) for place_m in fibers_m)
    assert len(radius_m) == 100
    np.testing.assert_allclose(perfect_m, RADIUS_M, rtol=1e-9)
    assert 0.95 * VARIATION < np.abs(radius_m / perfect_m - 1).max() <= VARIATION


@pytest.mark.parametrize("offset_m", [0.0, 0.001, 0.05])
def test_a_known_offset_leaves_the_shell_s_variation(
    fibers_m: tuple[Floats, Floats], offset_m: float
) -> None:
    """At most (r / R)(dR / R): 34 arcsec for a pupil 50 mm off the center; to first order, the next is r / R, 4 %."""
    true_m, perfect_m = fibers_m
    pupil_m = np.array([offset_m, 0.0, 0.0])
    worst = angles_arcsec(true_m - pupil_m, perfect_m - pupil_m).max()
    bound = offset_m / RADIUS_M * VARIATION / ARCSEC_RAD
    assert worst <= 1.05 * bound + 1e-6
    assert worst >= 0.8 * bound
    if offset_m == 0.05:
        assert bound == pytest.approx(34, abs=0.5)


def test_an_unknown_offset_of_a_millimeter_is_169_arcsec(
    fibers_m: tuple[Floats, Floats],
) -> None:
    """r / R across the offset."""
    _, perfect_m = fibers_m
    worst = angles_arcsec(perfect_m - [0.001, 0.0, 0.0], perfect_m).max()
    assert worst == pytest.approx(0.001 / RADIUS_M / ARCSEC_RAD, rel=0.01)
    assert worst == pytest.approx(169, abs=2)


def test_five_of_a_hundred_stars_take_a_field_of_36_degrees() -> None:
    """n (1 - cos(d / 2)) stars of n evenly on a hemisphere: .38 in a circle of 10 deg, 5 in one of 36."""
    assert 100 * (1 - np.cos(np.radians(10 / 2))) == pytest.approx(0.38, abs=0.005)
    assert 2 * np.degrees(np.arccos(1 - 5 / 100)) == pytest.approx(36, abs=0.5)
