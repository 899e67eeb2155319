"""Pictures whose field of view nobody tells: the range is covered, chance is shared out, rivals are a refusal."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE
from estimator.trackers.pipeline import Clock
from estimator.trackers.star_tracker import NO_MATCH, NO_STARS
from skysim.apps import plate_solver
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.units import ARCSEC_RAD
from skysim.scene import loader
from skysim.simulation import exposure, run
from skysim.simulation.testbed import Testbed
from skysim.sources import stars

HERE = Rotation.from_rotvec([0.1, 0.2, 0.3])
THERE = Rotation.from_rotvec([0.1, 0.2, 0.4])


# What is tried


@pytest.mark.parametrize(("width_px", "height_px"), [(1024, 768), (600, 900), (3000, 500)])
def test_every_field_from_five_to_forty_degrees_is_some_tracker_s(width_px: int, height_px: int) -> None:
    beliefs = plate_solver.make_solver(None, None).beliefs(width_px, height_px)
    assert len(beliefs) == plate_solver.TRACKERS
    for fov_deg in np.linspace(5, 40, 200):
        focal_px = (width_px - 1) / 2 / np.tan(np.radians(fov_deg / 2))
        assert any(abs(focal_px / camera.focal_px - 1) <= share for camera, share in beliefs), fov_deg


def test_a_field_that_is_told_is_the_only_one_tried() -> None:
    ((camera, share),) = plate_solver.make_solver(12.0, None).beliefs(640, 480)
    assert np.degrees(camera.fov_rad) == pytest.approx(12.0, abs=1e-9)
    assert 0.05 < share < 0.06
    ((known, none),) = plate_solver.make_solver(None, SCENES / "shefex2.yaml").beliefs(659, 493)
    assert (known.focal_px, none) == (pytest.approx(25 / 9.9e-3, rel=1e-12), 0.0)


def test_trackers_are_kept_for_images_of_one_size_and_time() -> None:
    solver = plate_solver.make_solver(20.0, None)
    first, again, other = (
        next(solver.trackers(*size, None)) for size in ((640, 480), (640, 480), (640, 400))
    )
    assert first is again
    assert other is not first
    assert len(solver.built) == 1  # one size at a time: an index is megabytes


# Which answer counts


class Says:
    """A tracker that has its answer ready."""

    def __init__(self, attitude: Attitude) -> None:
        self.attitude = attitude
        self.asked = 0

    def solve_centroids(self, centroids: Centroids, clock: Clock, effort: int) -> Attitude:
        self.asked += 1
        return self.attitude


def answer(where: Rotation, log10_chance: float) -> Attitude:
    nothing = np.zeros(0, np.int64)
    return Attitude("solved", where, np.eye(3), StarMatch(nothing, nothing, where, log10_chance))


def outcome(*said: Attitude) -> tuple[Attitude, list[int]]:
    trackers = [Says(one) for one in said]
    attitude, _ = plate_solver.sought(Centroids.none(), iter(trackers), Clock(), 0)  # type: ignore[arg-type]
    return attitude, [one.asked for one in trackers]


REFUSED = Attitude(NO_MATCH)


def test_a_decisive_answer_is_taken_at_once() -> None:
    attitude, asked = outcome(REFUSED, answer(HERE, -20.0), answer(THERE, -30.0))
    assert attitude.cam_from_ref is HERE
    assert asked == [1, 1, 0]


def test_as_many_tries_are_allowed_as_much_chance_as_one() -> None:
    share = ACCEPT_LOG10_CHANCE - np.log10(plate_solver.TRACKERS)
    assert outcome(REFUSED, answer(HERE, share - 0.01), REFUSED)[0].solved
    refused, asked = outcome(REFUSED, answer(HERE, share + 0.01), REFUSED)
    assert (refused.status, refused.cam_from_ref) == (NO_MATCH, None)
    assert asked == [1, 1, 1]


def test_of_two_answers_neither_is_taken_unless_it_is_far_better() -> None:
    for one, other in itertools.permutations([answer(HERE, -9.0), answer(THERE, -7.0)]):
        assert not outcome(one, other)[0].solved
    for one, other in itertools.permutations([answer(HERE, -9.8), answer(THERE, -6.0)]):
        assert outcome(one, other)[0].cam_from_ref is HERE
    # One that is not beyond chance itself speaks against another all the same.
    assert not outcome(answer(HERE, -6.0), answer(THERE, -4.5))[0].solved


def test_neighbours_that_agree_are_no_rivals() -> None:
    near = Rotation.from_rotvec([1e-4, 0, 0]) * HERE
    assert outcome(answer(HERE, -7.0), answer(near, -8.0))[0].cam_from_ref is near


def test_a_refusal_says_why() -> None:
    assert outcome(Attitude(NO_STARS), Attitude(NO_STARS))[0].status == NO_STARS


# On rendered frames


@pytest.fixture(scope="module")
def blind() -> plate_solver.Solver:
    """Told nothing; it keeps its trackers for frames of one size."""
    return plate_solver.make_solver(None, None)


def photographed(focal: str) -> Testbed:
    """The SHEFEX-2 camera at rest behind a lens."""
    still = {"exposure.frames": "1", "motion.rate_deg_s": "[0, 0, 0]"}
    return run.prepare(loader.load("shefex2", still | {"camera.focal_length": focal}))


@pytest.mark.parametrize(("focal", "fov_deg"), [("10 mm", 36.12), ("25 mm", 14.84), ("45 mm", 8.28)])
def test_a_rendered_field_is_solved_with_nothing_told(
    blind: plate_solver.Solver, focal: str, fov_deg: float
) -> None:
    """2 atan(658 x 9.9 um / 2 f) between the middles of the edge columns, to half a per cent; three arc-minutes."""
    frame, truth = exposure.render_frame(photographed(focal), 0)
    found, _ = plate_solver.look(frame.image_dn, blind, None)
    said = plate_solver.solution(found)
    ours = stars.cam_from_icrs(said["ra_deg"], said["dec_deg"], said["roll_deg"])
    x, y, _ = np.degrees((ours * truth.cam_from_lab.inv()).as_rotvec())
    assert np.hypot(x, y) < 0.05
    assert said["fov_deg"] == pytest.approx(fov_deg, rel=5e-3)


def test_smeared_frames_of_a_known_camera_are_placed_by_their_streaks() -> None:
    """14 px of smear, of which nobody tells: within 100" and what is claimed; fits of round stars roll 400" off."""
    fast = {"exposure.frames": "16", "motion.rate_deg_s": "[4.8, 6.4, 0]"}
    lab = run.prepare(loader.load("scoreboard", fast))
    camera = plate_solver.make_solver(None, SCENES / "shefex2.yaml")
    for n in (5, 15):
        frame, truth = exposure.render_frame(lab, n)
        found = plate_solver.look(frame.image_dn, camera, lab.scene.start_time)[0].attitude
        assert found.cam_from_ref is not None
        off = (found.cam_from_ref * truth.cam_from_lab.inv()).as_rotvec()
        assert np.abs(off).max() < 100 * ARCSEC_RAD
        assert off @ np.linalg.solve(found.covariance_rad2, off) < stats.chi2.ppf(0.999, 3)


@pytest.mark.long
def test_a_sky_seen_in_a_mirror_is_refused(blind: plate_solver.Solver) -> None:
    """No turn of the sky is its mirror image, so whatever were answered would be wrong."""
    frame, _ = exposure.render_frame(photographed("25 mm"), 0)
    found, _ = plate_solver.look(np.ascontiguousarray(frame.image_dn[:, ::-1]), blind, None)
    assert not found.attitude.solved
    assert len(found.centroids) >= 4


# Names


@pytest.mark.parametrize("stage", list(plate_solver.STAGES))
def test_a_stage_s_wrong_name_is_answered_with_the_allowed_ones(stage: str) -> None:
    with pytest.raises(InputError, match=rf"^--{stage}: 'magic' is none of \w+, \w+"):
        plate_solver.make_solver(None, None, stages={stage: "magic"})


def test_names_stand_above_what_a_camera_tells() -> None:
    camera = SCENES / "shefex2.yaml"
    plain = plate_solver.make_solver(None, camera).settings
    told = plate_solver.make_solver(None, camera, stages={"centroider": "cog", "solver": "quest"}).settings
    assert (plain.centroider, plain.solver) == ("default", "default")
    assert (told.centroider, told.solver, told.gain_e_dn) == ("cog", "quest", plain.gain_e_dn)
