"""Hardware redrawn for every replicate: LED places and surveys, pooled over the replicates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from skysim.core.errors import InputError
from skysim.experiments.study import plan, study_file, table
from skysim.experiments.study.execution import runner, store, trials
from tests.helpers.study_stores import done

STUDY: dict[str, Any] = {
    "schema": 1,
    "title": "Any dome of the kind",
    "scene": "afit_simsat",
    "seed": 5,
    "set": {
        "light.layout": {"kind": "random", "count": 300, "cap_deg": 40},
        "tracker.survey": {"led_sigma": "0.2 mm"},
    },
    "trial": {"kind": "centroids", "tilt_deg": [0, 10]},
    "factors": {"noise": {"key": "trial.noise_px", "values": [0.1, 0.2]}},
    "hardware": ["light.layout.hardware_seed", "tracker.survey.seed"],
    "replicates": 6,
    "responses": ["identified", "stars_mean"],
}


def loaded(folder: Path, **keys: Any) -> plan.Plan:
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(STUDY | keys, sort_keys=False))
    return study_file.load(path)


def test_every_replicate_has_its_own_hardware_the_same_at_every_point(
    tmp_path: Path,
) -> None:
    spec = loaded(tmp_path).spec
    drawn = [spec.trial_settings({"trial.noise_px": 0.1}, n) for n in range(50)]
    assert all(set(one) == {"trial.noise_px", *STUDY["hardware"]} for one in drawn)
    seeds = [one[key] for one in drawn for key in STUDY["hardware"]]
    assert len(set(seeds)) == 100
    assert min(seeds) >= 0
    other = spec.trial_settings({"trial.noise_px": 0.2}, 7)
    assert [other[key] for key in STUDY["hardware"]] == [
        drawn[7][key] for key in STUDY["hardware"]
    ]
    assert loaded(tmp_path, seed=6).spec.trial_settings({}, 7) != spec.trial_settings({}, 7)


@pytest.mark.slow
def test_the_trials_are_of_different_domes_and_pooled(tmp_path: Path) -> None:
    """Each replicate's scene has its own hash; the table has a row for a noise, none for a dome."""
    study_plan = loaded(tmp_path)
    assert done(study_plan, tmp_path / "study.sqlite").failed == 0
    with store.open_store(tmp_path / "study.sqlite") as kept:
        columns = kept.columns()
        lines = table.table(kept, study_plan.study.responses)
        assert len(set(columns["scene"])) == 6
        assert np.ptp(columns["stars"]) > 0
        assert [line.levels for line in lines] == [{"noise": 0.1}, {"noise": 0.2}]
        assert lines[0].responses["stars_mean"].trials == 6
        again = runner.replay(study_plan, kept, 8, tmp_path / "trial_8")
    assert again.changed == []
    with store.writing(tmp_path / "study.sqlite") as kept:
        # Its first and last scenes are those of their own hardware.
        runner.prepare_store(study_plan, kept, resume=True)


@pytest.mark.slow
def test_leds_and_survey_are_drawn_independently(tmp_path: Path) -> None:
    """The believed places less the true ones scatter by the survey's 0.2 mm about each axis."""
    spec = loaded(tmp_path).spec
    errors_m = []
    for n in range(4):
        setup = trials.prepared_setup(spec, spec.trial_settings({}, n))
        errors_m.append(
            setup.estimator.leds.position_m - setup.lab.camera.sources.place[:, :3]
        )
    assert np.std(errors_m) == pytest.approx(0.2e-3, rel=0.05)
    assert np.corrcoef(np.reshape(errors_m, (4, -1))) == pytest.approx(np.eye(4), abs=0.2)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            {"hardware": ["light.layout.count"]},
            r"hardware.0: 'light.layout.count' is not allowed",
        ),
        ({"hardware": ["trial.noise_seed"]}, "hardware.0: trial.noise_seed is no hardware"),
        ({"hardware": ["light.led.hardware_seed"]}, "light.led.hardware_seed: unknown key"),
        (
            {"set": {"tracker.survey": {}}},
            "hardware: tracker.survey.seed has no effect without errors of the survey",
        ),
        (
            {
                "factors": {
                    "draw": {"key": "light.layout.hardware_seed", "values": [1, 2, 3]}
                },
                "hardware": [],
            },
            r"factors.draw: light.layout.hardware_seed numbers draws of the hardware; allowed: hardware: \[light",
        ),
        (
            {"factors": {"dome": {"levels": {"A": {"light.layout.hardware_seed": 1}}}}},
            "hardware.0: light.layout.hardware_seed is set by factors.dome too; allowed: one of the two",
        ),
    ],
)
def test_hardware_that_cannot_be_drawn_is_refused(
    tmp_path: Path, change: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(InputError, match=complaint):
        loaded(tmp_path, **change)


def test_domes_with_names_are_levels_and_seeds_may_be_sampled(tmp_path: Path) -> None:
    named = {
        "dome": {
            "levels": {name: {"light.layout.hardware_seed": n} for n, name in enumerate("AB")}
        }
    }
    assert len(loaded(tmp_path, factors=named, hardware=[]).points) == 2
    sampled = {
        "survey": {
            "key": "tracker.survey.seed",
            "distribution": "integers",
            "low": 0,
            "high": 99,
        }
    }
    design = {"kind": "lhs", "points": 4}
    assert len(loaded(tmp_path, factors=sampled, design=design, hardware=[]).points) == 4


def test_hardware_is_part_of_the_digest(tmp_path: Path) -> None:
    assert (
        loaded(tmp_path).digest
        != loaded(tmp_path, hardware=["light.layout.hardware_seed"]).digest
    )
