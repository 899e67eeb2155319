"""Draws of a dataset's factors, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scipy

from skysim.core.errors import InputError
from skysim.experiments import dataset_run
from tests.helpers.small_dataset import VARY, small


def variations(folder: Path, text: str = VARY) -> Path:
    path = folder / "night.yaml"
    path.write_text(text)
    return path


def test_the_trial_is_drawn_in_every_frame_and_the_scene_in_every_shard(
    tmp_path: Path,
) -> None:
    made = small(variations(tmp_path), 400, frames_per_shard=10)
    levels = [made.draw(frame // 10, frame) for frame in range(400)]
    rates = [one["rate"] for one, _ in levels]
    assert len(set(rates)) == 400
    assert scipy.stats.kstest(rates, scipy.stats.uniform(0.1, 0.4).cdf).pvalue > 1e-4
    for shard in range(40):
        own = [
            (one["lens"], more["camera.detector.hardware_seed"])
            for one, more in levels[10 * shard : 10 * shard + 10]
        ]
        assert len(set(own)) == 1
    lenses = [one["lens"] for one, _ in levels[::10]]
    assert 8 <= lenses.count(2.0) <= 32  # binomial of 40 at 1/2, beyond 3.8 sigma
    assert len({more["camera.detector.hardware_seed"] for _, more in levels}) == 40


def test_draws_are_independent_of_one_another_and_of_the_number_of_frames(
    tmp_path: Path,
) -> None:
    text = VARY.replace("  lens:", "  turn: {key: trial.turn_deg, from: 0, to: 1}\n  lens:")
    short, long = (small(variations(tmp_path, text), count) for count in (20, 500))
    assert [short.draw(n // 2, n) for n in range(20)] == [
        long.draw(n // 2, n) for n in range(20)
    ]
    drawn = np.array(
        [[long.draw(n // 2, n)[0][name] for name in ("rate", "turn")] for n in range(500)]
    )
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 4 / np.sqrt(500)
    assert abs(np.corrcoef(drawn[1:, 0], drawn[:-1, 0])[0, 1]) < 4 / np.sqrt(500)
    assert len({long.seed(n) for n in range(500)}) == 500


def test_the_last_shard_has_the_remaining_frames() -> None:
    made = small(frames=7, frames_per_shard=3)
    assert [list(made.frames_of(shard)) for shard in range(made.shards)] == [
        [0, 1, 2],
        [3, 4, 5],
        [6],
    ]


def test_every_setting_that_changes_the_frames_changes_the_digest(tmp_path: Path) -> None:
    vary = variations(tmp_path)
    others = [
        small(vary, frames=6),
        small(vary, seed=4),
        small(vary, frames_per_shard=3),
        small(vary, formats=("coco",)),
        small(variations(tmp_path, VARY.replace("to: 0.5", "to: 3"))),
        small(variations(tmp_path, VARY.replace("60]", "50]"))),
        small(vary, overrides={"light.limit_mag": "5"}),
        small(),
    ]
    assert len({made.digest for made in [small(variations(tmp_path)), *others]}) == 1 + len(
        others
    )
    json.dumps(others[0].manifest())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            VARY.replace("trial.rate_deg_s", "trial.rate"),
            r"factors\.rate: .*trial.*night\.yaml, line 5",
        ),
        (
            VARY.replace("schema: 1", "schema: 1\nreplicates: 5"),
            "unknown key 'replicates'; allowed: schema, set, trial",
        ),
        (
            VARY.replace("{dec_deg", "{kind: centroids, dec_deg"),
            r"trial.kind: a dataset has frames, not .*centroids.*; allowed: frames",
        ),
        (
            VARY.replace("{dec_deg: [-60, 60]}", "{tilt_deg: 5}"),
            "trial.tilt_deg: .*no effect",
        ),
        (
            VARY.replace("{dec_deg", "{tracked: 3, dec_deg"),
            "trial.tracked: no effect on single frames; allowed: studies",
        ),
        (
            VARY.replace(
                "trial.rate_deg_s, from: 0.1, to: 0.5", "trial.tracked, values: [1, 2]"
            ),
            "trial.tracked: no effe",
        ),
        (VARY.replace("schema: 1\n", ""), "schema"),
        (
            VARY.replace("f_number, values: [1.4, 2.0]", "f_number, values: [1.4, -2.0]"),
            r"factors\.lens: -2.0: camera",
        ),
        (VARY.replace("trial: {dec_deg: [-60, 60]}", "trial: 3"), "trial"),
        (VARY.replace("trial: {dec_deg: [-60, 60]}", "set: 3"), "set: 3"),
    ],
)
def test_wrong_variations_are_refused_in_one_line(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as raised:
        small(variations(tmp_path, text))
    assert "\n" not in str(raised.value)


def test_wrong_options_are_refused() -> None:
    for more, message in (
        ({"frames": 0}, "dataset.frames: 0; allowed: 1 or more"),
        ({"frames_per_shard": 0}, "dataset.frames_per_shard: 0; allowed: 1 or more"),
        (
            {"formats": ("tiff",)},
            "dataset.formats: unknown format 'tiff'; allowed: webdataset, zarr, coco",
        ),
        ({"overrides": {"camera.widht_px": "5"}}, "widht_px"),
    ):
        with pytest.raises(InputError, match=message):
            small(**more)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="nothing"):
        dataset_run.load("nothing", None, 1)
