"""An option of a study that has no effect at any level is refused before the first trial."""

from __future__ import annotations

from pathlib import Path

import pytest

from skysim.core.errors import InputError
from skysim.experiments.study import study_file, unused_options
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.trials import build_setup
from skysim.experiments.study.plan import CentroidTrial, FrameTrial
from skysim.scene.loader import load

DOME = "{kind: frames, tilt_deg: [0, 10]}"
CENTROIDS = "{kind: centroids, tilt_deg: [0, 10]}"
NOISE = "noise: {key: trial.noise_seed, values: [0, 1]}"


def study(folder: Path, scene: str, trial: str, factors: str, settings: str = "{}") -> Path:
    path = folder / "question.yaml"
    path.write_text(
        f"schema: 1\ntitle: a question\nscene: {scene}\nseed: 1\nset: {settings}\ntrial: {trial}\n"
        f"factors: {{{factors}}}\nreplicates: 2\nresponses: [identified]\n"
    )
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "trial", "factors", "settings", "message"),
    [
        (
            "afit_simsat",
            "{kind: frames, tracked: 2}",
            NOISE,
            "{}",
            r"trial.tracked: has no effect.*line 6\)",
        ),
        (
            "afit_simsat",
            "{kind: frames, gyro: true}",
            NOISE,
            "{}",
            r"trial.gyro: has no effect.*line 6\)",
        ),
        (
            "afit_simsat",
            DOME,
            "chain: {levels: {plain: {}, with gyro: {trial.gyro: true}}}",
            "{}",
            r"factors.chain: 'with gyro': trial.gyro: has no effect",
        ),
        (
            "shefex2",
            "{kind: centroids, tilt_deg: 20}",
            NOISE,
            "{}",
            r"trial.tilt_deg: has no effect",
        ),
        (
            "afit_simsat",
            "{kind: centroids, dec_deg: [0, 90]}",
            NOISE,
            "{}",
            r"trial.dec_deg: has no effect",
        ),
        (
            "afit_simsat",
            "{kind: centroids, near: {body: moon}}",
            NOISE,
            "{}",
            r"trial.near: has no effect",
        ),
        (
            "shefex2",
            "{kind: frames, dec_deg: [0, 9], near: {body: moon}}",
            NOISE,
            "{}",
            r"trial.dec_deg: has no effect",
        ),
        (
            "shefex2",
            "{kind: frames}",
            NOISE,
            "{seed: 4}",
            r"set: seed: has no effect: every trial has its own",
        ),
        (
            "shefex2",
            "{kind: frames}",
            NOISE,
            "{motion.rate_deg_s: [1, 0, 0]}",
            r"set: motion.rate_deg_s: has no effect",
        ),
        (
            "shefex2",
            "{kind: frames}",
            NOISE,
            "{exposure.frames: 9}",
            r"set: exposure.frames: has no effect: a trial is one",
        ),
        (
            "shefex2",
            "{kind: frames}",
            NOISE,
            "{exposure.time_tag_jitter: 1 ms}",
            r"set: exposure.time_tag_jitter: has no",
        ),
        (
            "shefex2",
            "{kind: frames}",
            NOISE,
            "{exposure.first: 1 s}",
            r"set: exposure.first: has no effect",
        ),
        (
            "shefex2",
            "{kind: centroids}",
            "read: {key: camera.detector.read_noise_e, values: [10, 20]}",
            "{}",
            r"factors.read: 10: camera.detector.read_noise_e: has no effect: a trial of kind centroids has no image",
        ),
        (
            "afit_simsat",
            "{kind: centroids}",
            'disk: {key: light.led.disk_diameter, values: ["1 mm", "2 mm"]}',
            "{}",
            r"factors.disk: .*light.led.disk_diameter: has no effect",
        ),
        (
            "afit_simsat",
            DOME,
            NOISE,
            "{tracker.limit_mag: 5}",
            r"set: tracker.limit_mag: has no effect: under a dome",
        ),
        (
            "afit_simsat",
            DOME,
            NOISE,
            "{light.led.drive: {kind: direct}, light.led.pwm_period: 2 ms}",
            r"set: light.led.pwm_period: has no effect",
        ),
    ],
)
def test_an_option_without_effect_is_refused(
    scene: str, trial: str, factors: str, settings: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message) as refused:
        study_file.load(study(tmp_path, scene, trial, factors, settings))
    assert str(refused.value).count("\n") == 0
    assert "allowed: " in str(refused.value)


@pytest.mark.parametrize(
    ("scene", "trial", "factors", "settings"),
    [
        ("shefex2", "{kind: frames, gyro: true}", NOISE, "{}"),
        ("afit_simsat", "{kind: frames, gyro: true}", NOISE, "{tracker.detector: default}"),
        ("shefex2", "{kind: frames}", NOISE, "{exposure.frames: 1, exposure.rate_hz: 5}"),
        (
            "shefex2",
            "{kind: flight}",
            "rate: {key: exposure.frames, values: [4, 5]}",
            "{motion.rate_deg_s: [1, 0, 0]}",
        ),
        (
            "celestial_dome",
            "{kind: centroids}",
            'disk: {key: light.led.disk_diameter, values: ["1 mm", "2 mm"]}',
            "{}",
        ),
        (
            "shefex2",
            "{kind: frames}",
            "name: {key: tracker.name, values: [own]}",
            "{tracker.limit_mag: 6}",
        ),
    ],
)
def test_an_option_with_an_effect_is_allowed(
    scene: str, trial: str, factors: str, settings: str, tmp_path: Path
) -> None:
    assert study_file.load(study(tmp_path, scene, trial, factors, settings)).trials >= 2


@pytest.mark.parametrize("order", ["[local, default]", "[default, local]"])
def test_an_option_that_has_an_effect_at_another_factor_s_level_is_allowed(
    order: str, tmp_path: Path
) -> None:
    """Whichever level of the detector is the middle: with one of them the gyro is used."""
    factors = f"detector: {{key: tracker.detector, values: {order}}}, gyro: {{key: trial.gyro, values: [false, true]}}"
    assert study_file.load(study(tmp_path, "afit_simsat", DOME, factors)).trials == 8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "trial", "settings", "change"),
    [
        ("afit_simsat", DOME, {}, {"trial.gyro": True}),
        (
            "shefex2",
            "{kind: frames}",
            {"tracker.detector": "local", "tracker.centroider": "cog"},
            {"trial.gyro": True},
        ),
        (
            "shefex2",
            "{kind: frames}",
            {},
            {"exposure.frames": 7, "exposure.time_tag_jitter": "1 ms"},
        ),
        (
            "shefex2",
            "{kind: frames}",
            {},
            {"motion.jitter": [{"kind": "line", "frequency_hz": 9, "rms_arcsec": [9, 9, 9]}]},
        ),
        (
            "shefex2",
            "{kind: centroids}",
            {},
            {"camera.detector.read_noise_e": 90, "exposure.time": "3 ms"},
        ),
        (
            "shefex2",
            "{kind: centroids}",
            {"camera.chromatic": {"wavelength": ["500 nm", "600 nm"], "corner_px": [0, 1]}},
            {"camera.chromatic.focus": ["0 um", "9 um"]},
        ),
        (
            "afit_simsat",
            CENTROIDS,
            {},
            {"light.led.intensity": "1 mcd", "camera.psf": {"kind": "gaussian"}},
        ),
    ],
)
def test_a_refused_option_changes_no_outcome(
    scene: str,
    trial: str,
    settings: dict[str, object],
    change: dict[str, object],
    tmp_path: Path,
) -> None:
    plan = study_file.load(study(tmp_path, scene, trial, NOISE, "{}"))
    outcomes = []
    for chosen in (settings, settings | change):
        setup = build_setup(plan.spec, chosen)
        outcomes += trials.TRIALS[setup.trial.kind](setup, [5])
    assert outcomes[0] == outcomes[1]
    assert outcomes[0].status == "solved"
    for key in change:
        assert any(
            unused_options.unused.section_of(key, rule) for rule in unused_options.RULES
        )


def test_overrides_without_effect_on_a_trial() -> None:
    overrides = {
        "light.limit_mag": "5",
        "camera.detector": "{read_noise_e: 20}",
        "camera.focal_length": "25 mm",
        "tracker": "{threshold_sigma: 9, identifier: pyramid}",
    }
    scene = load("shefex2", overrides)
    unused = unused_options.unused_overrides(
        overrides, scene, CentroidTrial(kind="centroids")
    )
    assert unused == {"camera.detector"}
    assert (
        unused_options.unused_overrides(overrides, scene, FrameTrial(kind="frames")) == set()
    )
