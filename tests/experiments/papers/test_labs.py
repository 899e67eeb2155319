"""Experiments of other labs: APL's angles, NPS's distances and the OLED dome's law against geometry and theory."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD
from skysim.experiments.papers import nps, other_domes
from skysim.simulation.lab import build_lab

pytestmark = pytest.mark.slow  # much is compiled


@pytest.fixture(scope="module")
def level() -> nps.OnboardModel:
    return nps.build_model(None, 3, 3)


def test_with_the_true_attitude_the_distances_are_true(level: nps.OnboardModel) -> None:
    """R_0 + alpha b is the star's place: within a pitch of the panel and the noise, a few tenths of a px."""
    place = level.lab.camera.sources.place[:, :3]
    wanted = place / np.linalg.norm(place, axis=1, keepdims=True)
    apart = np.array([np.linalg.norm(wanted - one, axis=1).min() for one in level.vectors])
    assert len(apart) == 9
    assert apart.max() < 0.5 * 243 * ARCSEC_RAD  # half a pixel


def test_one_update_removes_most_of_the_error(level: nps.OnboardModel) -> None:
    """A wrong distance moves a point almost along its direction: two degrees become less than a tenth of that."""
    rays = nps.rays_body(level.lab, 11)
    found = nps.solve(level, rays, nps.initial_error(2.0))
    again = nps.solve_iteratively(level, rays, nps.initial_error(2.0))
    exact = nps.solve(level, rays, Rotation.identity())
    assert found.error_deg < 0.2
    assert abs(again.error_deg - exact.error_deg) < 1e-3


def test_a_camera_at_the_center_has_no_parallax() -> None:
    """(r / R)(dR / R) is nothing for r = 0, and proportional to r."""
    scene = other_domes.shell_scene(0.004, 5)
    lab = build_lab(scene)
    poses = other_domes.random_attitudes(8, np.random.default_rng(1))
    worst = [
        other_domes.largest_discrepancies_arcsec(scene, lab, offset_m, True, poses).max()
        for offset_m in (0.0, 0.001, 0.01)
    ]
    assert worst[0] < 1e-6
    assert worst[2] == pytest.approx(10 * worst[1], rel=0.02)


def test_a_circle_about_the_zenith_holds_its_share_of_evenly_spread_stars() -> None:
    """n (1 - cos(d / 2)) of n on a hemisphere."""
    lab = build_lab(other_domes.shell_scene(0.0, 1))
    rng = np.random.default_rng(2)
    mean = other_domes.count_fibers(
        lab, 10.0, other_domes.random_boresights(50_000, rng)
    ).mean()
    assert mean == pytest.approx(100 * (1 - np.cos(np.radians(5))), rel=0.05)


@pytest.mark.long
def test_noise_falls_with_the_root_of_the_lights() -> None:
    """Twice the lights, 1 / sqrt(2) of the noise, to four sigmas of 150 trials."""
    few, many = (
        other_domes.solve_random_attitudes(other_domes.build_setup(lights), range(150))
        for lights in (20, 40)
    )
    ratio = few.error_arcsec.std(axis=0) / many.error_arcsec.std(axis=0)
    assert np.abs(ratio / np.sqrt(2) - 1).max() < 4 / np.sqrt(150)
