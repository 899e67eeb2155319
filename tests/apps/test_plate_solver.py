"""Images of unknown field of view: the range is covered, the significance level is divided, rivals cause a refusal."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE
from estimator.identification.refusals import NO_MATCH, NO_STARS
from estimator.trackers.pipeline import Clock
from skysim.apps import plate_solver
from skysim.apps.plate_solver import solver as searching
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.types import Frame, Truth
from skysim.scene import loader
from skysim.simulation.flight import simulate_motion
from skysim.sources import stars

ATTITUDE = Rotation.from_rotvec([0.1, 0.2, 0.3])
TRIES = 12
OTHER_ATTITUDE = Rotation.from_rotvec([0.1, 0.2, 0.4])


# What is tried


@pytest.mark.parametrize(("width_px", "height_px"), [(1024, 768), (600, 900), (3000, 500)])
def test_every_field_from_two_to_a_hundred_degrees_has_a_tracker(
    width_px: int, height_px: int
) -> None:
    cameras = searching.search_cameras(width_px, height_px)
    assert len(cameras) < 20
    for fov_deg in np.geomspace(2, 100, 400):
        focal_px = (width_px - 1) / 2 / np.tan(np.radians(fov_deg / 2))
        assert any(
            abs(focal_px / camera.focal_px - 1) <= uncertainty
            for camera, uncertainty in cameras
        ), fov_deg


def test_a_given_field_is_the_only_one_tried() -> None:
    ((camera, uncertainty),) = plate_solver.make_solver(12.0, None).candidate_cameras(
        640, 480
    )
    assert np.degrees(camera.fov_rad) == pytest.approx(12.0, abs=1e-9)
    assert 0.05 < uncertainty < 0.06
    ((known, none),) = plate_solver.make_solver(
        None, SCENES / "shefex2.yaml"
    ).candidate_cameras(659, 493)
    assert (known.focal_px, none) == (pytest.approx(25 / 9.9e-3, rel=1e-12), 0.0)


def test_trackers_are_kept_for_images_of_one_size_and_time() -> None:
    solver = plate_solver.make_solver(20.0, None)
    first, again, other = (
        next(solver.trackers(*size)) for size in ((640, 480), (640, 480), (640, 400))
    )
    assert first is again
    assert other is not first
    assert len(solver.tracker_cache) == 1  # one size at a time: an index is megabytes


# Which answer counts


class FixedTracker:
    """A tracker that returns a given attitude and counts its calls."""

    def __init__(self, attitude: Attitude) -> None:
        self.attitude = attitude
        self.calls = 0

    def solve_centroids(
        self, centroids: Centroids, clock: Clock | None, effort: int
    ) -> Attitude:
        self.calls += 1
        return self.attitude


def answer(where: Rotation, log10_chance: float) -> Attitude:
    nothing = np.zeros(0, np.int64)
    return Attitude(
        "solved", where, np.eye(3), StarMatch(nothing, nothing, where, log10_chance)
    )


def outcome(*solution: Attitude) -> tuple[Attitude, list[int]]:
    trackers = [FixedTracker(one) for one in solution]
    attitude, _ = plate_solver.best_attitude(
        Centroids.empty(), iter(trackers), Clock(), 0, TRIES
    )  # type: ignore[arg-type]
    return attitude, [one.calls for one in trackers]


REFUSED = Attitude(NO_MATCH)


def test_a_decisive_answer_is_taken_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(searching, "THREADS", 1)
    attitude, calls = outcome(REFUSED, answer(ATTITUDE, -20.0), answer(OTHER_ATTITUDE, -30.0))
    assert attitude.cam_from_ref is ATTITUDE
    assert calls == [1, 1, 0]


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_answers_are_taken_in_the_order_of_the_trackers(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With any number of threads the first decisive answer in order is taken, not the quickest."""
    monkeypatch.setattr(searching, "THREADS", threads)
    for decisive in itertools.permutations(
        [answer(ATTITUDE, -20.0), answer(OTHER_ATTITUDE, -30.0)]
    ):
        attitude, _ = outcome(REFUSED, *decisive, REFUSED)
        assert attitude.cam_from_ref is decisive[0].cam_from_ref


def test_the_chance_threshold_is_divided_by_the_number_of_tries() -> None:
    threshold = ACCEPT_LOG10_CHANCE - np.log10(TRIES)
    assert outcome(REFUSED, answer(ATTITUDE, threshold - 0.01), REFUSED)[0].solved
    refused, calls = outcome(REFUSED, answer(ATTITUDE, threshold + 0.01), REFUSED)
    assert (refused.status, refused.cam_from_ref) == (NO_MATCH, None)
    assert calls == [1, 1, 1]


def test_of_two_answers_one_is_taken_only_if_far_better() -> None:
    for one, other in itertools.permutations(
        [answer(ATTITUDE, -9.0), answer(OTHER_ATTITUDE, -7.0)]
    ):
        assert not outcome(one, other)[0].solved
    for one, other in itertools.permutations(
        [answer(ATTITUDE, -9.8), answer(OTHER_ATTITUDE, -6.0)]
    ):
        assert outcome(one, other)[0].cam_from_ref is ATTITUDE
    # One that is not beyond chance itself speaks against another all the same.
    assert not outcome(answer(ATTITUDE, -6.0), answer(OTHER_ATTITUDE, -4.5))[0].solved


def test_agreeing_answers_of_neighboring_trackers_are_not_rivals() -> None:
    near = Rotation.from_rotvec([1e-4, 0, 0]) * ATTITUDE
    assert outcome(answer(ATTITUDE, -7.0), answer(near, -8.0))[0].cam_from_ref is near


def test_a_refusal_states_its_reason() -> None:
    assert outcome(Attitude(NO_STARS), Attitude(NO_STARS))[0].status == NO_STARS


# On rendered frames


@pytest.fixture(scope="module")
def blind() -> plate_solver.Solver:
    """A solver for unknown fields of view; it caches its trackers for frames of one size."""
    return plate_solver.make_solver(None, None)


def photographed(focal: str) -> tuple[Frame, Truth]:
    """A frame of the SHEFEX-2 camera at rest behind a lens."""
    still = {"exposure.frames": "1", "motion.rate_deg_s": "[0, 0, 0]"}
    return simulate_motion(
        loader.load("shefex2", still | {"camera.focal_length": focal})
    ).render(0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("focal", "fov_deg"), [("10 mm", 36.12), ("25 mm", 14.84), ("45 mm", 8.28)]
)
def test_a_rendered_field_is_solved_without_any_hint(
    blind: plate_solver.Solver, focal: str, fov_deg: float
) -> None:
    """2 atan(658 x 9.9 um / 2 f) between the middles of the edge columns, to half a per cent; three arc-minutes."""
    frame, truth = photographed(focal)
    found, _ = plate_solver.solve_array(frame.image_dn, blind)
    solution = plate_solver.solution_fields(found)
    ours = stars.cam_from_icrs(solution["ra_deg"], solution["dec_deg"], solution["roll_deg"])
    x, y, _ = np.degrees((ours * truth.cam_from_lab.inv()).as_rotvec())
    assert np.hypot(x, y) < 0.05
    assert solution["fov_deg"] == pytest.approx(fov_deg, rel=5e-3)


@pytest.mark.slow
def test_centroids_of_smeared_frames_of_a_known_camera_use_their_streaks() -> None:
    """14 px of unmodeled smear: error below 100" and consistent with the covariance; round-star fits roll 400" off."""
    fast = {"exposure.frames": "16", "motion.rate_deg_s": "[4.8, 6.4, 0]"}
    flight = simulate_motion(loader.load("scoreboard", fast))
    start_utc = flight.lab.scene.start_time
    camera = plate_solver.make_solver(None, SCENES / "shefex2.yaml", start_utc)
    for n in (5, 15):
        frame, truth = flight.render(n)
        found = plate_solver.solve_array(frame.image_dn, camera)[0].attitude
        assert found.cam_from_ref is not None
        error_rad = (found.cam_from_ref * truth.cam_from_lab.inv()).as_rotvec()
        assert np.abs(error_rad).max() < 100 * ARCSEC_RAD
        assert error_rad @ np.linalg.solve(found.covariance_rad2, error_rad) < stats.chi2.ppf(
            0.999, 3
        )


@pytest.mark.long
def test_a_mirrored_sky_is_refused_by_the_plate_solver(blind: plate_solver.Solver) -> None:
    """No rotation maps the sky to its mirror image, so every solution would be wrong."""
    frame, _ = photographed("25 mm")
    found, _ = plate_solver.solve_array(np.ascontiguousarray(frame.image_dn[:, ::-1]), blind)
    assert not found.attitude.solved
    assert len(found.centroids) >= 4


# Names


@pytest.mark.parametrize("stage", ["detector", "centroider", "identifier", "solver"])
def test_a_stage_s_wrong_name_is_answered_with_the_allowed_ones(stage: str) -> None:
    with pytest.raises(
        InputError, match=rf"^solve.{stage}: unknown {stage} 'magic'; allowed: \w+, \w+"
    ):
        plate_solver.make_solver(None, None, stages={stage: "magic"})


def test_explicit_algorithm_names_override_the_camera_s() -> None:
    camera = SCENES / "shefex2.yaml"
    defaults = plate_solver.make_solver(None, camera).settings
    settings = plate_solver.make_solver(
        None, camera, stages={"centroider": "cog", "solver": "quest"}
    ).settings
    assert (defaults.centroider, defaults.solver) == ("default", "default")
    assert (settings.centroider, settings.solver, settings.gain_e_dn) == (
        "cog",
        "quest",
        defaults.gain_e_dn,
    )
