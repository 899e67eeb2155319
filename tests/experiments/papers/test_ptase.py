"""PTASE's experiments: error measures, Earth rotation and roll against theory and SOFA."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from estimator.catalog.pair_index import PairIndex
from skysim.apps.cli.main import app
from skysim.core.constants import ARCSEC_RAD
from skysim.experiments.papers import ptase_ground, ptase_monte_carlo
from skysim.results.metrics import rms


def test_the_paper_s_attitude_error_is_the_root_of_two_times_the_angle() -> None:
    """|R - I|_F = 2 sqrt(2) sin(angle / 2), and about the axis alone the axis does not err."""
    rng = np.random.default_rng(1)
    truth = Rotation.random(200, rng=rng)
    turn = Rotation.from_rotvec(np.outer(np.linspace(1, 60, 200) * ARCSEC_RAD, [0, 0, 1]))
    off = ptase_monte_carlo.errors(truth.as_matrix(), (turn * truth).as_matrix())
    np.testing.assert_allclose(off.angle, np.linspace(1, 60, 200), rtol=1e-6, atol=0)
    np.testing.assert_allclose(off.attitude, np.sqrt(2) * off.angle, rtol=1e-6, atol=0)
    np.testing.assert_allclose(off.roll, off.angle, rtol=1e-5, atol=0)
    assert off.axis.max() < 1e-6


def test_near_a_pole_an_error_of_the_axis_turns_north() -> None:
    """d(roll) = tan(dec) times the error along right ascension: eq. 9 counts it as roll."""
    east_arcsec = 2.0
    dec_rad = np.radians(80)
    z = np.array([np.cos(dec_rad), 0, np.sin(dec_rad)])
    truth = np.array([[0, 1, 0], np.cross(z, [0, 1, 0]), z])
    # About the sensor's y axis, which points north: the boresight goes east, and nothing turns about it.
    moved = Rotation.from_rotvec([0, east_arcsec * ARCSEC_RAD, 0]).as_matrix() @ truth
    off = ptase_monte_carlo.errors(truth[None], moved[None])
    assert off.axis[0] == pytest.approx(east_arcsec, rel=1e-6)
    assert off.roll[0] == pytest.approx(east_arcsec * np.tan(dec_rad), rel=1e-3)


@pytest.fixture(scope="module")
def sky() -> PairIndex:
    return ptase_monte_carlo.catalog(ptase_monte_carlo.FITTED_LIMIT_MAG)


@pytest.mark.slow
def test_simulated_errors_match_the_covariance(sky: PairIndex) -> None:
    """P = sigma^2 [sum(I - b b')]^-1: across 1 / sqrt(N), roll by the stars' distance from the axis."""
    truly, estimated, stars = ptase_monte_carlo.simulate(
        sky, ptase_monte_carlo.version("fialho_2"), 600, 7
    )
    found = np.isfinite(estimated[:, 0, 0])
    off = np.einsum("nij,nkj->nik", estimated[found], truly[found])
    x, y, roll = (off[:, a, b] - off[:, b, a] for a, b in ((2, 1), (0, 2), (1, 0)))
    n = stars[found]
    # Of a square field of half-width a the mean of x^2 + y^2 is 2 a^2 / 3 (tangents), a little less of sines.
    a2 = 2 * ptase_monte_carlo.HALF_FIELD_TAN**2 / 3
    across, about = (
        1 / 2 * one / (3 * ARCSEC_RAD) * np.sqrt(n)
        for one in (np.concatenate([x, y]).reshape(2, -1), roll)
    )
    # The roll's part through a lopsided field comes on top.
    assert rms(across.ravel()) == pytest.approx(1, abs=0.12)
    assert rms(about * np.sqrt(a2)) == pytest.approx(1, rel=0.2)


def test_the_earth_turns_once_in_a_sidereal_day_about_its_pole() -> None:
    day = datetime.timedelta(seconds=86164.0905)
    begin = datetime.datetime(2003, 10, 2, 20)
    once, quarter = (ptase_ground.itrs_from_icrs(begin + part * day) for part in (1, 0.25))
    start = ptase_ground.itrs_from_icrs(begin)
    assert (
        once * start.inv()
    ).magnitude() < 0.5 * ARCSEC_RAD  # a day's precession is 0.14 arcsec
    turned = (quarter * start.inv()).as_rotvec()
    assert turned[2] == pytest.approx(-np.pi / 2, abs=1e-5)


def test_the_paper_s_angles_match_its_matrix() -> None:
    """Eq. 5 written out; its x points right when ours, seen from inside, is turned by half."""
    ra, dec, phi = np.radians([-49.3924, -41.2645, -27.7198])
    sa, ca, sd, cd, sf, cf = (f(one) for one in (ra, dec, phi) for f in (np.sin, np.cos))
    theirs = np.array(
        [
            [-sa * cf - ca * sd * sf, ca * cf - sa * sd * sf, cd * sf],
            [sa * sf - ca * sd * cf, -ca * sf - sa * sd * cf, cd * cf],
            [ca * cd, sa * cd, sd],
        ]
    )
    ours = np.diag([-1.0, -1.0, 1.0]) @ theirs
    angles_deg = ptase_ground.paper_angles_deg(Rotation.from_matrix(ours))
    np.testing.assert_allclose(angles_deg, [-49.3924, -41.2645, -27.7198], rtol=0, atol=1e-9)


def test_a_catalog_s_json_describes_it() -> None:
    """The path of the catalog is not JSON-serializable and once raised an error."""
    done = CliRunner().invoke(app, ["catalog", "info", "--json"])
    assert done.exit_code == 0
    assert '"stars"' in done.stdout
