"""Frames of a scene with air: star positions and brightness, and stars hidden by the skyline."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Frame, Truth
from skysim.scene.loader import load
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.simulation.lights.effects import AirEffects, Skyline
from skysim.simulation.lights.light import find_light
from skysim.sources import air
from skysim.tracking.factory import solve_frame
from tests.helpers.changed_light import with_lights

TIME = "2012-06-24T23:00:00"
AIR = {
    "site": "{latitude_deg: 53.1, longitude_deg: 8.8, height: 10 m}",
    "start_time": TIME,
    "light.air.scintillation": "false",
    "camera.detector.noise": "false",
    "motion.jitter": "[]",
    "light.occlusion": "false",
}

NO_AIR = ("start_time", "camera.detector.noise", "motion.jitter", "light.occlusion")


def lab_of(**keys: str) -> Lab:
    return build_lab(load("shefex2", AIR | keys))


def level(lab: Lab, altitude_deg: float) -> Rotation:
    """cam_from_icrs of a camera toward the south at an altitude, the zenith up in its image."""
    atmosphere = find_light(lab.camera.lights, AirEffects)
    assert atmosphere is not None
    north, _, up = atmosphere.air.at(lab.scene.start_time).axes
    h = np.radians(altitude_deg)
    z = -np.cos(h) * north + np.sin(h) * up
    y = -np.sin(h) * north - np.cos(h) * up
    return Rotation.from_matrix(np.stack([np.cross(y, z), y, z]))


def render_toward(lab: Lab, cam_from_lab: Rotation, index: int = 0) -> tuple[Frame, Truth]:
    """A frame of the camera at rest."""
    return render_at_rest(
        lab.camera, cam_from_lab.inv() * lab.camera.mount.cam_from_body, index
    )


def truth_at(lab: Lab, altitude_deg: float, index: int = 0) -> Truth:
    """The truth of a frame of the camera at rest."""
    return render_toward(lab, level(lab, altitude_deg), index)[1]


def test_the_air_raises_and_dims_stars_in_the_frame() -> None:
    """Against the same frame without air: up in the image by A tan Z + B tan^3 Z, fainter by Kasten & Young's law."""
    lab = lab_of()
    through = truth_at(lab, 30.0).sources
    airless = tuple(
        light for light in lab.camera.lights if not isinstance(light, AirEffects | Skyline)
    )
    without = render_toward(with_lights(lab, airless), level(lab, 30.0))[1].sources
    both, ours, bare = np.intersect1d(through.id, without.id, return_indices=True)
    assert len(both) > 30
    focal_px = lab.scene.camera.focal_px
    x, y = ((without.xy_px[bare] - np.array(lab.scene.camera.center_px)) / focal_px).T
    tilt = np.radians(30.0)
    altitude = np.arcsin((np.sin(tilt) - y * np.cos(tilt)) / np.sqrt(1 + x**2 + y**2))
    moved_px = through.xy_px[ours] - without.xy_px[bare]
    near_center = np.hypot(x, y) < 0.03
    raised_arcsec = -moved_px[:, 1] / focal_px / np.radians(1 / 3600)
    cot = 1 / np.tan(altitude)
    wanted = 57.6 * cot - 0.066 * cot**3  # arcsec, sea level, 15 C, 0.7 um
    np.testing.assert_allclose(raised_arcsec[near_center], wanted[near_center], rtol=0.02)
    lost_mag = -2.5 * np.log10(through.electrons[ours] / without.electrons[bare])
    inside = (np.abs(without.xy_px[bare] - lab.scene.camera.center_px) < [280, 200]).all(
        axis=1
    )
    h_deg = np.degrees(altitude)
    masses = 1 / (np.sin(altitude) + 0.50572 * (h_deg + 6.07995) ** -1.6364)
    np.testing.assert_allclose(lost_mag[inside], 0.172 * masses[inside], rtol=0.02)


@pytest.mark.slow
def test_the_skyline_hides_stars_and_the_truth_marks_them() -> None:
    low = {"light.air.horizon": "{azimuth_deg: [0, 180], altitude_deg: [20, 20]}"}
    free, hilly = (truth_at(lab_of(**keys), 20.0) for keys in ({}, low))
    gone = np.setdiff1d(free.sources.id, hilly.sources.id)
    assert 0.2 < len(gone) / len(free.sources.id) < 0.8
    assert np.isin(hilly.hidden, free.sources.id).all()
    lowest_px = hilly.sources.xy_px[:, 1].max()
    center_y = lab_of().scene.camera.center_px[1]
    assert (
        lowest_px < center_y + 3
    )  # a circle of altitude 20 degrees rises by 4 px to the sides
    np.testing.assert_array_equal(
        np.sort(hilly.hidden), np.sort(gone[np.isin(gone, hilly.hidden)])
    )
    assert len(truth_at(lab_of(), -20.0).sources.id) == 0


@pytest.mark.slow
def test_scintillation_is_independent_by_frame_and_star() -> None:
    lab = lab_of(**{"light.air.scintillation": "true"})
    sources = [truth_at(lab, 60.0, index).sources for index in (0, 0, 1)]
    same = [one.electrons for one in sources]
    np.testing.assert_array_equal(same[0], same[1])
    still = truth_at(lab_of(), 60.0).sources
    ratios = []
    for index in range(12):
        seen = truth_at(lab, 60.0, index).sources
        _, a, b = np.intersect1d(seen.id, still.id, return_indices=True)
        ratios.append(seen.electrons[a] / still.electrons[b])
    ratio = np.concatenate(ratios)
    camera = lab.scene.camera
    exposure_s = lab.scene.exposure.time_s
    mass = np.array([1 / np.sin(np.radians(60))])
    variance = air.variance(
        mass, camera.pupil_m, exposure_s, lab.scene.site.height_m, 660e-9
    )[0]
    assert ratio.mean() == pytest.approx(1, abs=4 * np.sqrt(variance / len(ratio)))
    assert ratio.var() == pytest.approx(variance, rel=0.25)


@pytest.mark.slow
def test_seeing_widens_images_by_its_variance() -> None:
    """20" at the zenith before a lens of 200 mm; at 30 degrees of altitude 2^0.6 times that."""
    keys = {"camera.focal_length": "200 mm", "camera.f_number": "4"}
    areas = []
    for seeing in ({}, {"light.air.seeing_arcsec": "20"}):
        truth = truth_at(lab_of(**keys, **seeing), 30.0).sources
        assert len(truth.id)
        areas.append(float(np.median(truth.area_px)) / (4 * np.pi))
    wanted_px = 20 / np.sqrt(8 * np.log(2)) * np.radians(1 / 3600) * 0.2 / 9.9e-6 * 2**0.6
    assert areas[1] - areas[0] == pytest.approx(wanted_px**2, rel=0.03)


def test_air_without_a_site_is_refused() -> None:
    with pytest.raises(InputError, match=r"light\.air: requires site\.longitude_deg"):
        load("shefex2", {"light.air": "{}"})
    with pytest.raises(InputError, match="conflicts with a background of kind sky"):
        load(
            "shefex2",
            AIR | {"light.air.glow": "{}", "background": "[{kind: sky, mag_arcsec2: 21}]"},
        )
    with pytest.raises(InputError, match="outside 1972 to 2100"):
        load("shefex2", AIR | {"light.air.glow": "{}", "start_time": "1960-01-01T00:00:00"})
    with pytest.raises(
        InputError, match=r"azimuth_deg\.1: 360 is not allowed; allowed: less than 360"
    ):
        load(
            "shefex2",
            AIR | {"light.air.horizon": "{azimuth_deg: [0, 360], altitude_deg: [0, 20]}"},
        )


def errors_arcsec(lab: Lab, altitude_deg: float, index: int = 0) -> tuple[float, float]:
    """Error across the boresight and rms residual in px of a frame."""
    has_air = find_light(lab.camera.lights, AirEffects) is not None
    cam_from_lab = level(lab if has_air else lab_of(), altitude_deg)
    frame, truth = render_toward(lab, cam_from_lab, index)
    attitude = solve_frame(build_tracker(lab.camera), frame).attitude
    assert attitude.cam_from_ref is not None
    error = (attitude.cam_from_ref * truth.cam_from_lab.inv()).as_rotvec() * 206264.8
    return float(np.hypot(*error[:2])), attitude.rms_px


@pytest.mark.slow
@pytest.mark.parametrize("altitude_deg", [60.0, 25.0])
def test_a_tracker_with_its_site_is_as_accurate_as_without_air(altitude_deg: float) -> None:
    """Noise is off: what is left is the centroiding's own error, and 0.3" of the ground's aberration."""
    settings = {"tracker.refraction": "true"}
    later = {"exposure.first": "600 s"}
    without = errors_arcsec(
        build_lab(load("shefex2", {key: AIR[key] for key in NO_AIR})), altitude_deg
    )
    undone = errors_arcsec(lab_of(**settings), altitude_deg)
    assert undone[0] < without[0] + 1.0
    assert undone[1] == pytest.approx(without[1], abs=0.02)
    assert errors_arcsec(lab_of(**settings, **later), altitude_deg)[0] < without[0] + 1.0


@pytest.mark.slow
def test_a_tracker_that_ignores_its_site_errs_by_the_refraction() -> None:
    """57.6" tan(30 degrees) at an altitude of 60 degrees."""
    assert errors_arcsec(lab_of(), 60.0)[0] == pytest.approx(33.2, abs=1.5)
