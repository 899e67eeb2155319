"""PTASE: its matrix, its numbers that are formulas, the turning Earth, and simulated directions and magnitudes."""

from __future__ import annotations

import datetime

import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.core.types import ra_dec_roll_rad
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.time import tt_jd, ut1_jd
from skysim.experiments.study.execution.detections import simulate_detections
from skysim.experiments.study.plan import CentroidTrial
from skysim.scene import loader
from skysim.simulation.lab import build_lab, build_tracker
from skysim.sources import stars
from skysim.sources.air import topocentric_axes
from skysim.sources.ephemeris import earth_rate_rad_s
from skysim.tracking.onboard_model import zero_point_mag
from tests.test_every_scene import FEWER


def test_the_paper_s_attitude_error_is_the_root_of_two_times_the_angle() -> None:
    """Eq. 7: |R - I|_F = 2 sqrt(2) sin(angle / 2). Table 1's 6.77 are 4.79, with the roll 4.69 and the axis .962."""
    turn = Rotation.from_rotvec([0, 0, 4.79 * ARCSEC_RAD]).as_matrix() - np.eye(3)
    assert np.linalg.norm(turn) / ARCSEC_RAD == pytest.approx(6.77, abs=0.005)
    assert np.sqrt(2) * np.hypot(4.69, 0.962) == pytest.approx(6.77, abs=0.005)


def test_the_scatter_of_table_1_s_success_is_binomial() -> None:
    """0.25 %, of five simulations of 1000 runs (uncertain by 35 %), is sqrt(p (1 - p) / 1000) at 99.12 %."""
    assert 100 * np.sqrt(0.9912 * 0.0088 / 1000) == pytest.approx(0.25, rel=0.35)


def test_the_paper_s_angles_match_its_matrix() -> None:
    """Eq. 5 with row 1 of Table 2; its x points right when ours, seen from inside, is turned by half; its roll is minus
    ours."""
    ra, dec, phi = np.radians([-49.3924, -41.2645, -27.7198])
    sa, ca, sd, cd, sf, cf = (f(one) for one in (ra, dec, phi) for f in (np.sin, np.cos))
    theirs = np.array(
        [
            [-sa * cf - ca * sd * sf, ca * cf - sa * sd * sf, cd * sf],
            [sa * sf - ca * sd * cf, -ca * sf - sa * sd * cf, cd * cf],
            [ca * cd, sa * cd, sd],
        ]
    )
    ours = Rotation.from_matrix(np.diag([-1.0, -1.0, 1.0]) @ theirs)
    angles_deg = np.degrees(ra_dec_roll_rad(ours))
    np.testing.assert_allclose(angles_deg, [310.6076, -41.2645, 27.7198], rtol=0, atol=1e-9)


def test_the_camera_of_2003_points_near_the_zenith() -> None:
    """Section 4, by the first row's clock, three hours behind UTC, and the town's place."""
    scene = loader.load("ptase_table_2")
    start = scene.motion.start
    zenith = topocentric_axes(scene.start_time, scene.site)[2]
    boresight = stars.cam_from_icrs(start.ra_deg, start.dec_deg, 0.0).inv().apply([0, 0, 1])
    assert np.degrees(np.arccos(boresight @ zenith)) < 20


def test_the_earth_turns_about_its_pole_of_the_date() -> None:
    """Table 2's text: 0.2507 deg a minute. The oracle is SOFA's rotation of the Earth, ten minutes later."""
    begin = datetime.datetime(2003, 10, 2, 22, 55, 22)
    later = begin + datetime.timedelta(minutes=10)
    then, now = (
        Rotation.from_matrix(erfa.c2t06a(tt_jd(time), 0.0, ut1_jd(time), 0.0, 0.0, 0.0))
        for time in (begin, later)
    )
    rate = earth_rate_rad_s(begin)
    assert np.degrees(np.linalg.norm(rate)) * 60 == pytest.approx(0.2507, abs=5e-5)
    turned = now.inv() * then
    assert (turned * Rotation.from_rotvec(600 * rate).inv()).magnitude() < 0.1 * ARCSEC_RAD


def test_a_sidereal_rate_is_the_earth_s_in_body_axes() -> None:
    scene = loader.load("ptase_table_2")
    lab = build_lab(scene)
    rate = lab.start_rate_rad_s
    np.testing.assert_allclose(
        lab.start.apply(rate), earth_rate_rad_s(scene.start_time), rtol=0, atol=1e-18
    )


@pytest.mark.parametrize(
    ("scene", "settings", "reason"),
    [
        (
            "afit_simsat",
            {"motion.control": "null", "motion.maneuver": "[]"},
            "light of kind stars",
        ),
        ("shefex2", {"motion.control": "prescribed"}, "conflicts with a controller"),
    ],
)
def test_a_sidereal_rate_needs_stars_and_no_controller(
    scene: str, settings: dict[str, str], reason: str
) -> None:
    with pytest.raises(InputError, match=reason):
        loader.load(scene, settings | {"motion.rate_deg_s": "sidereal"})


def test_directions_err_equally_in_the_whole_field() -> None:
    """3 arcsec about each axis at the center and 14 deg from it, where a pixel is 6 % smaller: to four sigmas."""
    scene = loader.load("ptase_monte_carlo")
    trial = CentroidTrial(kind="centroids", noise_arcsec=3.0)
    corner_px = np.full((4000, 2), 8191.0)
    corner_px[:2000] = scene.camera.center_px
    seen = simulate_detections(
        trial, corner_px, np.arange(4000.0, 0, -1), scene, np.random.default_rng(1)
    )
    true_px = corner_px[np.argsort(np.linalg.norm(corner_px - 8191, axis=1), kind="stable")]
    order = np.argsort(np.linalg.norm(seen.xy_px - 8191, axis=1) > 1000, kind="stable")
    rays, truth = (
        np.column_stack(
            [(px - scene.camera.center_px) / scene.camera.focal_px, np.ones(4000)]
        )
        for px in (seen.xy_px[order], true_px)
    )
    rays, truth = (one / np.linalg.norm(one, axis=1, keepdims=True) for one in (rays, truth))
    off = np.linalg.norm(rays - truth, axis=1).reshape(2, -1) / ARCSEC_RAD
    np.testing.assert_allclose(np.sqrt((off**2).mean(axis=1) / 2), 3.0, rtol=4 / 2 / 44.7)


@pytest.mark.slow
def test_the_tracker_measures_the_catalog_s_magnitudes() -> None:
    """In the band V a star of V = 4 is measured as 4, whatever its color: to .04 mag."""
    scene = loader.load("ptase_monte_carlo", FEWER["ptase_monte_carlo"])
    lab = build_lab(scene)
    zero_mag = zero_point_mag(scene)
    assert zero_mag is not None
    tracker = build_tracker(lab.camera)
    exposure = lab.camera.optics.collecting_m2 * scene.exposure.time_s
    place = lab.camera.sources.place[:, :3]
    flux = lab.camera.sources.strength * exposure / scene.camera.detector.gain_e_dn
    nearest = (place @ tracker.stars.vectors.T).argmax(axis=1)
    error_mag = zero_mag - 2.5 * np.log10(flux) - tracker.stars.v_mag[nearest]
    assert np.median(np.abs(error_mag)) < 0.04


@pytest.mark.slow
def test_magnitudes_are_in_the_index_only_if_they_are_known() -> None:
    fewer = FEWER["ptase_monte_carlo"]
    lab = build_lab(loader.load("ptase_monte_carlo", fewer))
    assert np.isfinite(build_tracker(lab.camera).index.magnitude).all()
    blind = loader.load("ptase_monte_carlo", fewer | {"tracker.magnitude_sigma": "null"})
    assert np.isnan(build_tracker(lab.with_scene(blind).camera).index.magnitude).all()
