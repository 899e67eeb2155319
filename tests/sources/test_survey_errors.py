"""Errors of the tracker's map follow its survey: by chi-square, by geometry, and exactly zero without errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.stats import chi2

from estimator.trackers.dome_tracker import DomeTracker
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.scene.sections import light
from skysim.scene.sections.tracker import SurveyErrorsConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.sources.dome import surface, survey_errors
from skysim.sources.dome.surface import Surface
from skysim.tracking import factory

RARE = 1e-6  # of a sum of squares that is outside: the seeds are fixed, so it fails for a wrong law alone
BARE_CAMERA = {
    "camera.detector.noise": "false",
    "camera.detector.prnu": "0",
    "camera.detector.dsnu": "0",
    "camera.detector.hot_pixels": "0",
    "camera.detector.column_offset_e": "0",
    "camera.detector.cti_parallel": "0",
    "camera.detector.cti_serial": "0",
    "exposure": "{time: 10 ms, rate_hz: 2, frames: 1, first: 0 s}",
}


def loaded(name: str = "afit_simsat", **changes: str) -> Scene:
    return loader.load(
        name,
        {key.replace("__", "."): value for key, value in changes.items()},
        refuses_unused=False,
    )


def believing(**changes: str) -> tuple[DomeTracker, Lab]:
    """The tracker of afit_simsat with these changes, and its lab."""
    lab = build_lab(loaded(**changes))
    eyes = build_tracker(lab.camera)
    assert isinstance(eyes, DomeTracker)
    return eyes, lab


def is_chi_square(normal: Floats) -> None:
    """Whether the mean square of independent numbers is that of the standard normal law."""
    count = normal.size
    low, high = chi2.ppf([RARE / 2, 1 - RARE / 2], count)
    assert low < np.sum(normal**2) < high


def inside_of(**more: Any) -> Surface:
    ball = {"kind": "sphere", "apex": "1.2 m", "radius": "1 m"}
    return surface.build_surface(TypeAdapter(light.AnySurface).validate_python(ball | more))


# --- the laws of the draws ----------------------------------------------------------------------------------


def test_every_led_of_the_map_has_its_own_error_about_each_axis() -> None:
    eyes, lab = believing(tracker__survey="{led_sigma: 0.2 mm, seed: 3}")
    error = (eyes.leds.position_m - lab.camera.sources.place[:, :3]) / 0.2e-3
    assert len(error) > 1000
    for axis in error.T:
        is_chi_square(axis)
    # The mean is zero, and no two axes or neighbors go together: sums of N independent numbers of variance 1.
    for products in (
        error,
        error * np.roll(error, 1, axis=1),
        error * np.roll(error, 1, axis=0),
    ):
        assert np.abs(products.mean(axis=0)).max() < 5 / np.sqrt(len(error))
    np.testing.assert_array_equal(eyes.leds.id, lab.camera.sources.id)


def test_the_camera_s_position_error_over_seeds_is_lever_sigma() -> None:
    true_m = np.array([0.0, 0.01, 0.381])
    error = [
        survey_errors.assumed_m(true_m, 1e-4, seed, "lever") - true_m for seed in range(400)
    ]
    is_chi_square(np.array(error) / 1e-4)


def test_over_the_seeds_the_surface_is_raised_by_its_declared_error() -> None:
    inside = inside_of(error="0.3 mm")
    is_chi_square(
        np.array([survey_errors.surface_offset_m(inside, seed) for seed in range(500)]) / 3e-4
    )


def test_a_raised_sphere_is_a_larger_sphere_with_its_leds_on_it() -> None:
    """Every LED along its normal by one and the same draw, and the believed surface with them."""
    inside = inside_of(error="2 mm", offset=["1 cm", "0 m", "0 m"])
    directions = np.random.default_rng(1).normal(size=(50, 3)) * [0.3, 0.3, 0.0] + [0, 0, 1]
    place_m = inside.meet(np.zeros(3), directions)
    assumed_m = survey_errors.assumed_leds_m(inside, place_m, SurveyErrorsConfig(seed=9))
    center_m, semi_axes_m = survey_errors.assumed_ellipsoid(
        inside, SurveyErrorsConfig(seed=9)
    )
    raised_m = survey_errors.surface_offset_m(inside, 9)
    assert 1e-4 < abs(raised_m) < 1e-2
    np.testing.assert_allclose(semi_axes_m, 1 + raised_m, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        np.linalg.norm(assumed_m - center_m, axis=1), semi_axes_m[0], rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(
        (assumed_m - place_m) @ np.array([0, 0, 1]),
        -raised_m * inside.inward(place_m)[:, 2],
        rtol=0,
        atol=1e-15,
    )


def test_leds_are_on_a_raised_ellipsoid_within_kantorovich_s_bound() -> None:
    """The LEDs' own believed height is all of the draw, the ellipsoid's at least 2 sqrt(a b) / (a + b) of it."""
    eyes, lab = believing(light__surface__error="2 mm", tracker__survey="{seed: 4}")
    assert lab.scene.light.kind == "dome"
    raised_m = survey_errors.surface_offset_m(
        surface.build_surface(lab.scene.light.surface), 4
    )
    leds = eyes.leds
    directions = (lab.camera.sources.place[:, :3] - leds.center_m) / leds.semi_axes_m**2
    normals = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    # Of the plane that touches it with that normal.
    support = np.linalg.norm(normals * leds.semi_axes_m, axis=1)
    true_axes_m = leds.semi_axes_m - raised_m
    share = (support - np.linalg.norm(normals * true_axes_m, axis=1)) / raised_m
    longest = true_axes_m.max()
    shortest = true_axes_m.min()
    assert share.min() > 2 * np.sqrt(longest * shortest) / (longest + shortest) - 1e-3
    assert share.max() < 1 + 1e-3
    # Patch boards are flat and stand a little off the surface, where the normal is nearly the same.
    moved_m = np.sum((leds.position_m - lab.camera.sources.place[:, :3]) * normals, axis=1)
    np.testing.assert_allclose(moved_m, raised_m, rtol=1e-4, atol=0)


# --- what they depend on ------------------------------------------------------------------------------------


def test_without_errors_the_map_is_the_truth_bit_for_bit() -> None:
    eyes, lab = believing(tracker__survey="{seed: 11}")
    assert lab.scene.light.kind == "dome"
    center_m, semi_axes_m = surface.build_surface(lab.scene.light.surface).as_ellipsoid()
    assert eyes.leds.position_m.tobytes() == lab.camera.sources.place[:, :3].tobytes()
    assert eyes.leds.center_m.tobytes() == center_m.tobytes()
    assert eyes.leds.semi_axes_m.tobytes() == semi_axes_m.tobytes()
    assert eyes.lever.camera_body_m.tobytes() == lab.camera.mount.camera_body_m.tobytes()


ALL = "{{led_sigma: 0.2 mm, lever_sigma: {lever}, seed: {seed}}}"


@pytest.mark.slow
def test_survey_errors_depend_on_their_own_seed_and_not_on_the_run_s() -> None:
    def places(seed: int, own: int) -> tuple[bytes, ...]:
        survey = ALL.format(lever="0.1 mm", seed=own)
        eyes, _ = believing(
            seed=str(seed), tracker__survey=survey, light__surface__error="0.1 mm"
        )
        return tuple(
            one.tobytes()
            for one in (eyes.leds.position_m, eyes.lever.camera_body_m, eyes.leds.semi_axes_m)
        )

    first = places(1, 5)
    assert places(2, 5) == first
    assert not set(places(1, 6)) & set(first)


def test_a_further_survey_error_does_not_change_the_others() -> None:
    alone, _ = believing(tracker__survey=ALL.format(lever="0 m", seed=5))
    both, lab = believing(tracker__survey=ALL.format(lever="0.1 mm", seed=5))
    assert alone.leds.position_m.tobytes() == both.leds.position_m.tobytes()
    assert alone.lever.camera_body_m.tobytes() == lab.camera.mount.camera_body_m.tobytes()
    assert both.lever.camera_body_m.tobytes() != lab.camera.mount.camera_body_m.tobytes()


def test_the_survey_does_not_change_the_hardware() -> None:
    """Frames do not depend on the tracker's map."""
    frames = []
    for survey in ("{}", ALL.format(lever="5 mm", seed=1)):
        lab = build_lab(loaded(tracker__survey=survey, exposure=BARE_CAMERA["exposure"]))
        frames.append(render_at_rest(lab.camera, lab.start)[0].image_dn.tobytes())
    assert frames[0] == frames[1]


# --- what they do -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_pupil_position_error_rotates_the_attitude_by_shift_over_led_distance(
    seed: int,
) -> None:
    """The sight of an LED at p from the bearing stays as it was if the vehicle turns by p x shift / |p|^2.

    Across the boresight, to 5 %: LEDs 4 deg aside, about as many as the field is wide, are not at p.
    """
    survey = f"{{lever_sigma: 2 mm, seed: {seed}}}"
    eyes, lab = believing(
        tracker__survey=survey, motion__start="{roll_deg: 7}", **BARE_CAMERA
    )
    frame, truth = render_at_rest(lab.camera, lab.start)
    answer = factory.solve_frame(eyes, frame).attitude
    assert answer.status == "solved"
    assert answer.cam_from_ref is not None
    shift = eyes.lever.camera_body_m - lab.camera.mount.camera_body_m
    to_body = truth.lab_from_body.inv()
    middle = to_body.apply(
        lab.camera.sources.place[np.isin(lab.camera.sources.id, truth.sources.id), :3]
    ).mean(axis=0)
    expected = lab.camera.mount.cam_from_body.apply(
        np.cross(middle, shift) / (middle @ middle)
    )
    found = (answer.cam_from_ref * truth.cam_from_lab.inv()).as_rotvec()
    assert np.linalg.norm(expected[:2]) > 1e-3
    np.testing.assert_allclose(
        found[:2], expected[:2], rtol=0, atol=0.05 * np.linalg.norm(expected[:2])
    )


# --- what is refused ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "changes", "complaint"),
    [
        (
            "afit_simsat",
            {"tracker.survey": "{led_sigma: -1 mm}"},
            r"tracker\.survey\.led_sigma: '-1 mm'",
        ),
        ("afit_simsat", {"tracker.survey": "{led: 1 mm}"}, r"tracker\.survey\.led"),
        (
            "shefex2",
            {"tracker.survey": "{led_sigma: 1 mm}"},
            r"kind stars has no LEDs to survey; allowed: dome",
        ),
        (
            "afit_simsat",
            {
                "tracker.survey": "{lever_sigma: 1 mm}",
                "tracker.assumed_camera_body": "[0 m, 0 m, 0.4 m]",
            },
            r"conflicts with assumed_camera_body; allowed: 0, or the survey alone",
        ),
    ],
)
def test_an_impossible_tracker_survey_is_refused_in_one_line(
    name: str, changes: dict[str, str], complaint: str
) -> None:
    with pytest.raises(InputError, match=complaint) as refused:
        loader.load(name, changes)
    assert "\n" not in str(refused.value)


def test_a_survey_that_leaves_no_dome_is_refused() -> None:
    inside = inside_of(error="1 m")
    seed = next(
        seed for seed in range(100) if survey_errors.surface_offset_m(inside, seed) < -1.0
    )
    with pytest.raises(
        InputError,
        match=r"light\.surface\.error: 1 m makes an ellipsoid of -.* m; allowed: far less",
    ):
        survey_errors.assumed_ellipsoid(inside, SurveyErrorsConfig(seed=seed))
