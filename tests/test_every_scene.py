"""Whatever stands in scenes/ loads, flies, lights enough sources, and repeats itself bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.nearfield import project
from skysim import control, scene, simulate
from skysim.simulate import Lab

NAMES = sorted(path.stem for path in scene.SCENES.glob("*.yaml"))


def prepared(name: str, frames: int, **overrides: str) -> Lab:
    return simulate.prepare(scene.load(name, overrides | {"exposure.frames": str(frames)}))


@pytest.fixture(scope="module", params=NAMES)
def lab(request: pytest.FixtureRequest) -> Lab:
    return prepared(request.param, 2)


def test_there_are_scenes() -> None:
    assert {"afit_simsat", "shefex2"} <= set(NAMES)


def test_it_says_what_it_is(lab: Lab) -> None:
    assert lab.scene.name in NAMES
    assert 10 < len(lab.scene.title) < 80


def test_its_first_frame_shows_at_least_five_sources(lab: Lab) -> None:
    frame, truth = simulate.shoot(lab, 0)
    camera, chip = lab.scene.camera, lab.scene.camera.detector
    assert frame.image_dn.shape == (camera.height_px, camera.width_px)
    above_noise = truth.seen.peak_e > 5 * np.hypot(chip.read_noise_e, np.sqrt(truth.seen.peak_e))
    assert above_noise.sum() >= 5
    # And none of them blinds the chip.
    assert np.mean(frame.image_dn >= frame.saturation_dn) < 1e-3


def test_its_light_is_on_the_frame(lab: Lab) -> None:
    """Sum above offset, dark and the chip's own pattern, against the truth's electrons, to five sigmas.

    Through a converter of 16 bits, finer than any read noise: a step four times the noise, as the LU205c's, swallows
    most of what is far below half of it (a dark current of a quarter electron all over the frame).
    Sensitivity is the one part of the pattern that goes with the light: a source of E electrons over A pixels has
    it as prnu E / sqrt(A).
    """
    well_e = lab.scene.camera.detector.full_well_e
    fine = {"camera.detector.bits": "16", "camera.detector.gain_e_dn": str(well_e / 60000)}
    lab = prepared(lab.scene.name, 1, **fine)
    frame, truth = simulate.shoot(lab, 0)
    part, chip, pixels = lab.scene.camera.detector, lab.chip, frame.image_dn.size
    assert lab.scene.background == ()
    pattern_e = chip.dark_e_s.sum(dtype=float) * frame.exposure_s
    pattern_e += len(frame.image_dn) * chip.column_offset_e.sum(dtype=float)
    found_e = (frame.image_dn.sum(dtype=float) - pixels * part.offset_dn) * part.gain_e_dn - pattern_e
    light_e = truth.seen.electrons
    read = pixels * (part.read_noise_e**2 + part.reset_noise_e**2 + part.gain_e_dn**2 / 12)
    shot = light_e.sum() + chip.dark_e_s.sum(dtype=float) * frame.exposure_s
    uneven = part.prnu**2 * np.sum(light_e**2 / truth.seen.area_px)
    # What a star beyond full well loses is less than all it has.
    clipped_e = light_e[truth.seen.saturated].sum()
    assert abs(found_e - light_e.sum()) < 5 * np.sqrt(read + shot + uneven) + clipped_e


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(lab: Lab) -> None:
    name, image = lab.scene.name, simulate.shoot(lab, 0)[0].image_dn
    again = simulate.shoot(prepared(name, 2), 0)[0].image_dn
    other = simulate.shoot(prepared(name, 2, seed=str(lab.scene.seed + 1)), 0)[0].image_dn
    assert image.tobytes() == again.tobytes()
    assert np.mean(image != other) > 0.1


def test_a_frame_alone_is_the_frame_of_a_sequence(lab: Lab) -> None:
    sequence = [shot.frame.image_dn for shot in simulate.run(lab, simulate.tracker(lab))]
    alone, _ = simulate.shoot(prepared(lab.scene.name, 2), 1)
    assert alone.image_dn.tobytes() == sequence[1].tobytes()


def test_its_first_frames_are_solved_and_right(lab: Lab) -> None:
    for shot in simulate.run(lab, simulate.tracker(lab)):
        answer = shot.report.attitude
        assert answer.status == "solved"
        error = (answer.cam_from_ref * shot.truth.cam_from_lab.inv()).magnitude()
        assert np.degrees(error) < 10 / 60  # more is what the project calls wrong


def test_the_afit_camera_sees_five_leds_all_along_its_manoeuvre():
    """Two frames a second for the whole manoeuvre, at geometry alone: what is on the chip, by the tracker's map."""
    loaded = scene.load("afit_simsat")
    manoeuvre_s = control.plan(loaded.motion).duration_s
    frames = int((manoeuvre_s - loaded.exposure.first_s) * loaded.exposure.rate_hz)
    lab = simulate.prepare(scene.load("afit_simsat", {"exposure.frames": str(frames)}))
    eyes = simulate.tracker(lab)
    counts = []
    for index in range(frames):
        body_from_lab = lab.trajectory.at(simulate.window(lab.scene, index).open_s).inv()
        pixels = project(body_from_lab, eyes.leds.position_m, eyes.lever, eyes.camera)
        counts.append(int(eyes.camera.contains(np.nan_to_num(pixels, nan=-1e9), 12).sum()))
    assert frames > 50
    assert min(counts) >= 5
