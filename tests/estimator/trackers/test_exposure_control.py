"""Exposure control: every branch of SHEFEX-2's chart, and closed-loop frames with a bright intruder."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.core.errors import ImageError
from estimator.detection.detect import DETECTORS
from estimator.trackers.exposure_control import (
    Control,
    NextExposure,
    Observation,
    observe,
    step,
)
from skysim.camera.detector import saturation_dn
from skysim.scene import loader
from skysim.scene.sections.surroundings import UniformGlowConfig
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab
from skysim.simulation.lights.emitters import BackgroundLight
from tests.helpers.changed_light import with_light, with_sources

CONTROL = Control(mean_dn=100.0)
GOOD = Observation(mean_dn=40.0, stars=12, overexposed=0)


# ---- The chart, branch by branch ----


@pytest.mark.parametrize(
    ("seen", "change_s", "saturated", "no_stars"),
    [
        (GOOD, 0, False, False),
        (replace(GOOD, stars=4), 0, False, False),
        (replace(GOOD, stars=3), 0.002, False, True),
        (replace(GOOD, stars=0), 0.002, False, True),
        (replace(GOOD, mean_dn=100.0), 0, False, False),
        (replace(GOOD, mean_dn=100.1), -0.002, True, False),
        (replace(GOOD, mean_dn=100.1, stars=0), -0.002, True, True),
        (replace(GOOD, overexposed=3), 0, False, False),
        (replace(GOOD, overexposed=4), -0.002, True, False),
        (replace(GOOD, stars=3, overexposed=3), 0.002, False, True),
    ],
)
def test_each_branch_of_the_exposure_chart_is_followed(
    seen: Observation, change_s: float, saturated: bool, no_stars: bool
) -> None:
    after = step(NextExposure(0.03), seen, CONTROL)
    # Microseconds are whole; their sum is not, in binary.
    assert after.time_s == pytest.approx(0.03 + change_s, abs=1e-12)
    assert (after.saturated, after.no_stars) == (saturated, no_stars)


def run(start_s: float, seen: Observation, count: int, control: Control) -> list[float]:
    states = [NextExposure(start_s)]
    for _ in range(count):
        states.append(step(states[-1], seen, control))
    return [state.time_s for state in states]


def test_the_exposure_stops_at_either_limit_and_returns() -> None:
    dark = replace(GOOD, stars=0)
    bright = replace(GOOD, mean_dn=4000.0)
    assert run(0.0471, dark, 4, CONTROL) == pytest.approx(
        [0.0471, 0.0491, 0.05, 0.05, 0.05], abs=1e-12
    )
    assert run(0.0031, bright, 4, CONTROL) == pytest.approx(
        [0.0031, 0.0011, 1e-5, 1e-5, 1e-5], abs=1e-12
    )
    assert run(1e-5, dark, 2, CONTROL) == pytest.approx([1e-5, 0.00201, 0.00401], abs=1e-12)
    widest = Control(100.0, longest_s=10.0, step_s=2.0)
    assert run(5.0, dark, 4, widest) == pytest.approx([5.0, 7.0, 9.0, 10.0, 10.0])


def test_times_are_whole_microseconds_after_many_steps() -> None:
    times = run(0.0123456789, replace(GOOD, stars=0), 15, CONTROL)[1:]
    micro = 1e6 * np.array(times)
    assert np.abs(micro - np.round(micro)).max() < 1e-9


@pytest.mark.parametrize(
    ("limits", "what"),
    [
        ({"shortest_s": 1e-6}, "limits of 1e-06 s"),
        ({"longest_s": 11.0}, "limits of .* 11 s"),
        ({"shortest_s": 0.06}, "the shortest first"),
        ({"longest_s": np.nan}, "limits of"),
        ({"step_s": 0.0}, "step_s is 0.0"),
        ({"mean_dn": np.nan}, "mean_dn is NaN"),
    ],
)
def test_bad_limits_are_refused_in_one_line(limits: dict[str, float], what: str) -> None:
    with pytest.raises(ValueError, match=what) as caught:
        Control(**{"mean_dn": 100.0, **limits})
    assert "\n" not in str(caught.value)


# ---- What the chart looks at ----


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
def test_objects_with_more_than_one_saturated_pixel_are_counted(kind: str) -> None:
    rng = np.random.default_rng(80)
    image = rng.integers(0, 200, (40, 60)).astype(kind)
    image[5, 5] = 255  # one saturated pixel
    image[10, 20:22] = 255  # two
    image[20:24, 30] = 255  # four, of which the box holds two
    image[39, 59] = image[38, 59] = 255  # two, in the corner
    image[30, 2:9] = 255  # seven, in no object
    boxes = np.array(
        [[4, 4, 6, 6], [19, 9, 23, 11], [29, 18, 31, 21], [58, 37, 59, 39], [50, 0, 52, 2]]
    )
    seen = observe(image, boxes, 255.0, CONTROL)
    assert (seen.stars, seen.overexposed) == (5, 3)
    assert seen.mean_dn == pytest.approx(image.astype(float).mean(), rel=1e-12)


def test_boxes_beyond_the_image_are_refused() -> None:
    with pytest.raises(ImageError, match="beyond the image of 60x40 pixels"):
        observe(np.zeros((40, 60)), np.array([[58, 1, 60, 2]]), 255.0, CONTROL)


# ---- The loop, closed on rendered frames ----


@pytest.fixture(scope="module")
def lab() -> Lab:
    """A field without bright stars, fully hidden by glare."""
    coma = {"motion.start": "{ra_deg: 190, dec_deg: 25}", "motion.rate_deg_s": "[0, 0, 0]"}
    return build_lab(loader.load("shefex2", coma | {"exposure.frames": "34"}))


def lit(lab: Lab, glare_e_s: float) -> Lab:
    """The lab with stray light from a body at the baffle's edge on the whole chip."""
    glow = (UniformGlowConfig(kind="uniform", e_s=glare_e_s),) if glare_e_s else ()
    return with_light(lab, BackgroundLight(glow))


def exposed(lab: Lab, time_s: float) -> Lab:
    exposure = lab.scene.exposure.model_copy(update={"time_s": time_s})
    return lab.with_scene(lab.scene.model_copy(update={"exposure": exposure}))


def flown(
    lab: Lab, glare_e_s: list[float], start_s: float, control: Control
) -> tuple[list[NextExposure], list[Observation]]:
    """Frames exposed for the time that the chart commands, each under its glare."""
    state = NextExposure(start_s)
    states = []
    seen = []
    saturation = saturation_dn(lab.scene.camera.detector)
    for index, glare in enumerate(glare_e_s):
        frame, _ = render_at_rest(
            exposed(lit(lab, glare), state.time_s).camera, lab.start, index
        )
        blobs = DETECTORS["local"](frame.image_dn, 5.0, 3, 100)
        seen.append(observe(frame.image_dn, blobs.box_px, saturation, control))
        state = step(state, seen[-1], control)
        states.append(state)
    return states, seen


# 40,000 e- of full well at 10 e-/DN: 4e5 e-/s leave 16,000 e- in 40 ms, and 126 e- of noise for the stars.
GLARE_E_S = 4e5


@pytest.mark.slow
def test_a_bright_intruder_shortens_the_exposure_until_it_leaves(lab: Lab) -> None:
    glare = [0.0] * 3 + [GLARE_E_S] * 19 + [0.0] * 12
    control = Control(mean_dn=150.0)
    states, seen = flown(lab, glare, 0.04, control)
    times = np.array([state.time_s for state in states])
    assert ((times >= control.shortest_s) & (times <= control.longest_s)).all()
    # Before: stars, and no reason to change.
    assert [state.time_s for state in states[:3]] == [0.04] * 3
    # In the glare: shorter by 2 ms a frame as long as the mean, 64 DN + 4e4 DN/s, is above the reference (down to
    # 2.15 ms), although there are too few stars.
    assert times[3:22] == pytest.approx(0.04 - 0.002 * np.arange(1, 20), abs=1e-9)
    assert all(state.saturated for state in states[3:22])
    assert all(state.no_stars for state in states[3:22])
    # Afterwards: longer by 2 ms after each frame with fewer than four stars, until they are there to stay.
    few = np.array([one.stars < control.min_stars for one in seen[22:]])
    np.testing.assert_allclose(
        np.diff(times[21:]), np.where(few, 0.002, 0.0), rtol=0, atol=1e-12
    )
    assert few[0]
    assert not few[-5:].any()


def test_without_the_mean_the_same_intruder_would_lengthen_it(lab: Lab) -> None:
    # What the reference mean is for: glare hides the stars, and the other flag alone would expose longer.
    states, seen = flown(lab, [GLARE_E_S] * 6, 0.01, Control(mean_dn=np.inf))
    assert all(one.stars < 4 for one in seen)
    assert states[-1].time_s > 0.01
    guarded, _ = flown(lab, [GLARE_E_S] * 6, 0.01, Control(mean_dn=150.0))
    assert guarded[-1].time_s < 0.0021


@pytest.mark.slow
def test_one_planet_does_not_shorten_the_exposure_and_four_do(lab: Lab) -> None:
    # Strengths multiplied until the brightest stars of the field saturate: one of them, then many.
    truth = render_at_rest(lab.camera, lab.start)[1]
    inside = np.flatnonzero(np.isin(lab.camera.sources.id, truth.sources.id))
    brightest = inside[np.argsort(lab.camera.sources.strength[inside])[::-1]]
    for count, expected in ((1, 0.04), (6, 0.038)):
        strength = lab.camera.sources.strength.copy()
        strength[brightest[:count]] = 1e4 * strength[brightest[5]]
        planets = with_sources(lab, replace(lab.camera.sources, strength=strength))
        states, seen = flown(planets, [0.0], 0.04, Control(mean_dn=150.0))
        assert seen[0].overexposed >= count
        assert states[0].time_s == pytest.approx(expected, abs=1e-9)
