"""What a dataset is: a scene, the random values of each frame, and how frames are divided into shards.

Keys are varied by the factors of a study file. A dataset has no design: each factor is drawn at random, independently.
A factor whose keys are all of the trial (rate, attitudes) is drawn in every frame. One that sets a key of the scene
(camera, background, nuisances) is drawn once a shard, as are the hardware's seeds, because each draw builds a lab,
which takes longer than a frame. A frame depends on the plan and its number alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from skysim.core.errors import OVERRIDES, InputError, unknown_name
from skysim.core.yaml_reader import (check_version, parse_yaml, read_yaml)
from skysim.core.random_streams import random_stream
from skysim.experiments.study import loader
from skysim.experiments.study.execution.setups import scene_hash, seed_of
from skysim.experiments.study.factors import (Factor, Settings, Value)
from skysim.experiments.study.plan import TRIAL, Plan, TrialSpec, digest, resolve_point



KEYS = ("schema", "set", "trial", "factors", "hardware")  # of a file of variations
AS_IT_IS: dict[str, Any] = {
    "variation": {"levels": {"none": {}}}
}  # factors of a scene without variations
TRACKED = f"{TRIAL}tracked"
DRAW = (
    2  # first of the four numbers of a draw's key; seeds of trials and of hardware have up to three
)
FORMATS = ("webdataset", "zarr", "coco")


@dataclass(frozen=True)
class DatasetPlan:
    """A dataset that can be made on any worker.

    spec : scene, seed, settings and trial of all frames
    """

    spec: TrialSpec
    factors: dict[str, Factor]
    frames: int
    frames_per_shard: int
    formats: tuple[str, ...]

    @property
    def shards(self) -> int:
        """Number of shards; the last may have fewer frames."""
        return -(-self.frames // self.frames_per_shard)

    def frames_of(self, shard: int) -> range:
        """The numbers of a shard's frames."""
        first = shard * self.frames_per_shard
        return range(first, min(first + self.frames_per_shard, self.frames))

    def draw(self, shard: int, frame: int) -> tuple[dict[str, Value], Settings]:
        """The level of each factor in a frame, and the settings that they make together."""
        levels = {}
        settings = Settings()
        for n, (name, factor) in enumerate(self.factors.items()):
            number = (0, frame) if is_of_frame(factor) else (1, shard)
            u = float(random_stream(self.spec.seed, DRAW, *number, n).random())
            levels[name], own = factor.value_at(u)
            settings |= own
        return levels, self.spec.trial_settings(settings, shard)

    def seed(self, frame: int) -> int:
        """The seed of a frame's attitude and noise."""
        return seed_of(self.spec, 0, frame)

    def manifest(self) -> dict[str, Any]:
        """What makes the frames, for `dataset.json`."""
        spec = self.spec
        return {
            "scene": spec.scene,
            "scene_hash": scene_hash(resolve_point(spec, self.draw(0, 0)[1])[0]),
            "seed": spec.seed,
            "set": spec.base,
            "trial": spec.trial,
            "factors": {
                name: factor.model_dump(mode="json", by_alias=True)
                for name, factor in self.factors.items()
            },
            "hardware": list(spec.hardware),
            "frames": self.frames,
            "frames_per_shard": self.frames_per_shard,
            "formats": list(self.formats),
        }

    @property
    def digest(self) -> str:
        """Hash of everything that the bytes of the dataset depend on, except the code."""
        return digest(self.manifest())


def keys_of(factor: Factor) -> set[str]:
    """The keys that a factor sets."""
    options = [settings for _, settings in factor.options()] or [factor.value_at(0.5)[1]]
    return {key for settings in options for key in settings}


def is_of_frame(factor: Factor) -> bool:
    """Whether a factor sets keys of the trial alone, and is drawn in every frame."""
    return all(key.startswith(TRIAL) for key in keys_of(factor))


def load(
    scene: str,
    vary: Path | None,
    frames: int,
    *,
    seed: int | None = None,
    overrides: Mapping[str, str] | None = None,
    frames_per_shard: int = 64,
    formats: tuple[str, ...] = ("webdataset", "coco"),
) -> DatasetPlan:
    """The plan of a dataset. Raises InputError with one line.

    scene : name or path;  vary : file with the sections `set`, `trial`, `factors` and `hardware` of a study, or None
    """
    for name, count in (("frames", frames), ("frames_per_shard", frames_per_shard)):
        if count < 1:
            raise InputError(f"dataset.{name}", count, "1 or more")
    for name in formats:
        if name not in FORMATS:
            raise InputError("dataset.formats", *unknown_name("format", name, FORMATS))
    plan = study_plan(scene, vary, seed, overrides or {})
    check_trial(plan, vary)
    return DatasetPlan(
        plan.spec, dict(plan.study.factors), frames, frames_per_shard, tuple(dict.fromkeys(formats))
    )


def check_trial(plan: Plan, vary: Path | None) -> None:
    """Refuse the key of the trial that is for solving alone. Raises InputError."""
    keys = {*(TRIAL + key for key in plan.spec.trial)}.union(
        *map(keys_of, plan.study.factors.values())
    )
    if TRACKED in keys:
        raise InputError(vary, f"{TRACKED}: no effect on single frames", "studies")


def study_plan(
    scene: str, vary: Path | None, seed: int | None, overrides: Mapping[str, str]
) -> Plan:
    """The plan of a study with this scene and these variations, validated as a study is. Raises InputError."""
    tree, text = read_yaml(vary) if vary else ({"schema": 1}, "")
    if vary:
        check_version(tree, vary, text)
    for key in tree:
        if key not in KEYS:
            raise InputError(vary, *unknown_name("key", key, KEYS))
    trial = tree.get("trial") or {"kind": "frames"}
    if not isinstance(trial, dict) or trial.get("kind", "frames") != "frames":
        raise InputError(vary, "trial.kind: a dataset has frames", "frames")
    settings = tree.get("set") or {}
    if not isinstance(settings, dict):
        raise InputError(vary, f"set: {settings!r}", "keys of the scene with their values")
    settings = settings | {key: parse_yaml(value)[1] for key, value in overrides.items()}
    tree = {
        "title": "dataset",
        "factors": AS_IT_IS,
        "design": {"kind": "lhs", "points": 2},
        "responses": ["identified"],
        **tree,
        "scene": scene,
        "seed": 0 if seed is None else seed,
        "trial": {**trial, "kind": "frames"},
        "set": settings,
    }
    # Scenes are found from the folder of the command, not from that of the variations.
    return loader.plan_of(tree, text, vary or Path(OVERRIDES.file), Path.cwd() / "dataset")


