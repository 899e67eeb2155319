"""A camera in orbit: aberration of each frame, the tracker's correction, and the Earth."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.sources import catalog, stars
from skysim.sources.camera_orbit import state_at
from skysim.sources.satellites import ID_BASE
from skysim.tracking.factory import solve_frame

HALF_S = 2838.0  # half a revolution at 500 km: the velocity is reversed
ORBIT = (
    "{kind: circular, altitude: 500 km, inclination_deg: 90, raan_deg: 0, argument_deg: 0}"
)


def in_orbit(**keys: str) -> Lab:
    """Two frames, half a revolution apart, of a camera that looks along the orbit's pole or as the keys say."""
    overrides = {
        "orbit": ORBIT,
        "exposure.frames": "2",
        "exposure.rate_hz": str(1 / HALF_S),
        "motion.start": "{ra_deg: 90, dec_deg: 0, roll_deg: 0}",
        "camera.detector.noise": "false",
        **{key.replace("__", "."): value for key, value in keys.items()},
    }
    return build_lab(loader.load("shefex2", overrides))


def test_stars_have_the_aberration_of_each_frame_s_velocity() -> None:
    """Against `stars.apparent` with the velocity of mid-exposure, projected by the lens: half a revolution is 10"."""
    lab = in_orbit(light__limit_mag="4")
    scene = lab.scene
    star_camera = lab.camera
    known = catalog.read_for("light.catalog", scene.light.catalog)
    for index in range(2):
        _, truth = render_at_rest(star_camera, lab.start, index)
        time = scene.start_time + datetime.timedelta(seconds=truth.t_s)
        velocity_m_s = state_at(star_camera.orbit, truth.t_s).velocity_m_s
        rows = np.searchsorted(known.hip[np.argsort(known.hip)], truth.sources.id)
        chosen = np.argsort(known.hip)[rows]
        exact = stars.apparent(known, time, velocity_m_s)[chosen]
        xy_px = star_camera.optics.project(truth.cam_from_lab.apply(exact))
        off_arcsec = (
            np.linalg.norm(xy_px - truth.sources.xy_px, axis=1)
            / scene.camera.focal_px
            * 206265
        )
        # Parallax, proper motion and deflection of half a revolution are below 0.001".
        assert off_arcsec.max() < 0.005
        still = star_camera.optics.project(
            truth.cam_from_lab.apply(stars.apparent(known, time)[chosen])
        )
        moved = (
            np.linalg.norm(still - truth.sources.xy_px, axis=1)
            / scene.camera.focal_px
            * 206265
        )
        assert moved.mean() == pytest.approx(7617 / 299_792_458 * 206265, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("knows", "low", "high"), [("true", 0.0, 1.0), ("false", 4.5, 6.0)])
def test_a_tracker_with_the_orbit_s_velocity_is_free_of_its_aberration(
    knows: str, low: float, high: float
) -> None:
    """Without noise, at the start and half a revolution later. The error without it is 5.2"."""
    lab = in_orbit(tracker__orbit_velocity=knows)
    tracker = build_tracker(lab.camera)
    for index in range(2):
        frame, truth = render_at_rest(lab.camera, lab.start, index)
        attitude = solve_frame(tracker, frame).attitude
        assert attitude.status == "solved"
        error = (attitude.cam_from_ref * truth.cam_from_lab.inv()).as_rotvec()
        assert low <= np.degrees(np.hypot(error[0], error[1])) * 3600 < high


def test_the_earth_hides_the_stars_behind_it() -> None:
    """Above the equator at RA 0, looking at RA 180 (nadir), and half a revolution later at the zenith."""
    lab = in_orbit(motion__start="{ra_deg: 180, dec_deg: 0, roll_deg: 0}")
    _, hidden = render_at_rest(lab.camera, lab.start, 0)
    _, seen = render_at_rest(lab.camera, lab.start, 1)
    assert len(hidden.sources.id) == 0
    assert len(seen.sources.id) > 50


def test_a_satellite_ahead_on_the_same_orbit_is_seen(tmp_path: Path) -> None:
    """A TLE of the camera's orbit, half a degree ahead: 60 km away, where the camera looks along its flight."""
    path = tmp_path / "pair.tle"
    lines = (
        "1 00001U 20001A   12174.00000000  .00000000  00000-0  00000-0 0  999",
        "2 00001  97.0000 100.0000 0001000   0.0000 000.0000 15.20000000    1",
        "1 00002U 20001B   12174.00000000  .00000000  00000-0  00000-0 0  999",
        "2 00002  97.0000 100.0000 0001000   0.0000 000.5000 15.20000000    1",
    )
    path.write_text("\n".join(lines), encoding="utf-8")
    keys = {
        "orbit": f"{{kind: tle, file: {path}, number: 1}}",
        "light__satellites": f"{{file: {path}}}",
    }
    keys |= {
        "start_time": "2012-06-22T00:00:00",
        "exposure__frames": "1",
        "exposure__rate_hz": "1",
    }
    lab = in_orbit(**keys)
    velocity = state_at(lab.camera.orbit, 0.0).velocity_m_s
    ra = np.degrees(np.arctan2(velocity[1], velocity[0])) % 360
    dec = np.degrees(np.arcsin(velocity[2] / 7.6e3))
    lab = in_orbit(**keys, motion__start=f"{{ra_deg: {ra}, dec_deg: {dec}, roll_deg: 0}}")
    _, truth = render_at_rest(lab.camera, lab.start, 0)
    assert [satellite.id for satellite in truth.satellites] == [ID_BASE + 2]
    assert truth.satellites[0].range_km == pytest.approx(60, abs=1.5)
    # It turns with the orbit.
    assert truth.satellites[0].rate_deg_s == pytest.approx(0.063, rel=0.1)


def test_an_orbit_needs_the_sky() -> None:
    with pytest.raises(
        InputError, match=r"orbit: light of kind dome is in a laboratory; allowed: stars"
    ):
        loader.load("afit_simsat", {"orbit": ORBIT})


@pytest.mark.parametrize("key", ["orbit", "light.satellites"])
def test_elements_of_another_year_are_refused(key: str, tmp_path: Path) -> None:
    """The epoch is 2006-02-17: SGP4 would be 1 to 3 km a day off (the verification of Vallado et al. 2006)."""
    path = tmp_path / "x.tle"
    path.write_text(
        "1 06251U 62025E   06176.82412014  .00008885  00000-0  12808-3 0  3985\n"
        "2 06251  58.0579  54.0425 0030035 139.1568 221.1854 15.56387291  6774\n"
    )
    section = {"orbit": "{kind: tle, file: %s}", "light.satellites": "{file: %s}"}[key] % path
    space = {key: section, "orbit": "{kind: circular, altitude: 500 km, inclination_deg: 60}"}
    space[key] = section
    build_lab(loader.load("shefex2", space | {"start_time": "2007-06-20T00:00:00"}))
    with pytest.raises(
        InputError, match=r"x.tle: elements of 6\d\d\d days before start_time 2024"
    ):
        build_lab(loader.load("shefex2", space | {"start_time": "2024-06-20T00:00:00"}))
