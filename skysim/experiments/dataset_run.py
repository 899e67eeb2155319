"""Make the missing shards of a dataset on an engine of the studies, and keep what was made.

A shard is complete when its index, the last of its files, exists. The workers write the files. This process writes only
`dataset.json`, which describes the dataset, before they begin. So it can be killed at any time, and the same command
continues: frames that are made again have the same bytes.
"""

import json
import tarfile
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skysim.core import __version__
from skysim.core.errors import OVERRIDES, InputError, check_name, refusing
from skysim.core.random_streams import random_stream
from skysim.core.types import Array, Record, frozen
from skysim.core.yaml_reader import (
    OverrideTexts,
    check_version,
    excerpt,
    parse_yaml,
    read_yaml,
    where_of,
)
from skysim.experiments.dataset_shards import (
    EXTRA,
    LabelledFrame,
    Storage,
    add_frame,
    coco_annotations,
    coco_file,
    coco_image,
    frame_labels,
    label_frame,
    labeller,
    parquet,
    shard_name,
    sources_table,
)
from skysim.experiments.study import study_file
from skysim.experiments.study.execution.engines import Chunk, Engine
from skysim.experiments.study.execution.runner import Progress
from skysim.experiments.study.execution.trials import (
    Segment,
    TrialSetup,
    code_version,
    prepared_setup,
    scene_hash,
    seed_of,
)
from skysim.experiments.study.factors import Factor, Settings, Value
from skysim.experiments.study.plan import (
    TRIAL,
    Plan,
    TrialSpec,
    digest,
    resolve_point,
    resolve_trial,
)

# The plan of a dataset: a scene, the random values of each frame, and the division of frames into shards.


KEYS = ("schema", "set", "trial", "factors", "hardware")  # sections of a file of variations
# The factors if there are no variations.
AS_IT_IS: Record = {"variation": {"levels": {"none": {}}}}
TRACKED = f"{TRIAL}tracked"
DRAW = 2  # first of the four numbers of a draw's key; seeds of trials and of hardware have up to three
FORMATS = ("webdataset", "zarr", "coco")


@frozen
class DatasetPlan:
    """A dataset that can be made on any worker.

    Attributes
    ----------
    spec
        Scene, seed, settings and trial of all frames
    """

    spec: TrialSpec
    factors: dict[str, Factor]
    frames: int
    frames_per_shard: int
    formats: tuple[str, ...]
    compress: bool

    @property
    def shards(self) -> int:
        """Number of shards; the last may have fewer frames."""
        return -(-self.frames // self.frames_per_shard)

    def frames_of(self, shard: int) -> range:
        """The numbers of a shard's frames."""
        first = shard * self.frames_per_shard
        return range(first, min(first + self.frames_per_shard, self.frames))

    def draw(self, shard: int, frame: int) -> tuple[dict[str, Value], Settings]:
        """The level of each factor in a frame, and the settings of all levels together."""
        levels = {}
        settings = Settings()
        for n, (name, factor) in enumerate(self.factors.items()):
            # A factor that sets only keys of the trial is drawn in every frame.
            of_frame = all(key.startswith(TRIAL) for key in keys_of(factor))
            number = (0, frame) if of_frame else (1, shard)
            u = float(random_stream(self.spec.seed, DRAW, *number, n).random())
            levels[name], own = factor.value_at(u)
            settings |= own
        return levels, self.spec.trial_settings(settings, shard)

    def seed(self, frame: int) -> int:
        """The seed of a frame's attitude and noise."""
        return seed_of(self.spec, 0, frame)

    def manifest(self) -> Record:
        """The description of the dataset for `dataset.json`."""
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
            **({"compress": True} if self.compress else {}),
        }

    @property
    def digest(self) -> str:
        """Hash of everything that the bytes of the dataset depend on, except the code."""
        return digest(self.manifest())


def keys_of(factor: Factor) -> set[str]:
    """The keys that a factor sets."""
    options = factor.options() or [factor.value_at(0.5)]
    return {key for _, settings in options for key in settings}


def load(
    scene: str,
    vary: Path | None,
    frames: int,
    *,
    seed: int | None = None,
    overrides: OverrideTexts | None = None,
    frames_per_shard: int = 64,
    formats: tuple[str, ...] = ("webdataset", "coco"),
    compress: bool = False,
) -> DatasetPlan:
    """The plan of a dataset. Raises InputError with one line.

    Parameters
    ----------
    scene
        Name or path of the scene
    vary
        File with the sections `set`, `trial`, `factors` and `hardware` of a study, or None
    compress
        Whether the images of the tars are compressed
    """
    for name, count in (("frames", frames), ("frames_per_shard", frames_per_shard)):
        if count < 1:
            raise InputError(f"dataset.{name}", count, "1 or more")
    for name in formats:
        check_name("dataset.formats", "format", name, FORMATS)
    plan = study_plan(scene, vary, seed, overrides or {})
    keys = set().union(*map(keys_of, plan.study.factors.values()))
    if "tracked" in plan.spec.trial or TRACKED in keys:  # which only affects solving
        raise InputError(vary, f"{TRACKED}: no effect on single frames", "studies")
    return DatasetPlan(
        plan.spec,
        dict(plan.study.factors),
        frames,
        frames_per_shard,
        tuple(dict.fromkeys(formats)),
        compress,
    )


def study_plan(
    scene: str, vary: Path | None, seed: int | None, overrides: OverrideTexts
) -> Plan:
    """The plan of a study with this scene and these variations, validated as a study is. Raises InputError."""
    tree, text = read_yaml(vary) if vary else ({"schema": 1}, "")
    if vary:
        check_version(tree, vary, text)
    for key in tree:
        check_name(vary, "key", key, KEYS)
    trial = tree.get("trial") or {"kind": "frames"}
    if not isinstance(trial, dict) or trial.get("kind", "frames") != "frames":
        refusal = InputError(
            "trial.kind", f"a dataset has frames, not {excerpt(trial)}", "frames"
        )
        raise refusal.at(where_of("trial", [(vary or Path(OVERRIDES.file), text)], {}))
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
    # Scene paths are relative to the folder of the command, not to that of the variations.
    return study_file.plan_of(
        tree, text, vary or Path(OVERRIDES.file), Path.cwd() / "dataset"
    )


MANIFEST = "dataset.json"
FORMAT = 2
INDEX = "index"
SOURCES = "sources"
SHARDS = "shards"
COCO = "coco"
FOLDERS = {"webdataset": SHARDS, "coco": COCO}  # folders of the formats that have one


class ShardResult(NamedTuple):
    """A shard that was made, or the error that prevented it."""

    shard: int
    frames: int
    error: str | None = None


@frozen
class DatasetJob:
    """The shards of a dataset as a job of the engines; an item is a shard."""

    plan: DatasetPlan
    url: str

    def run(self, chunk: Chunk) -> list[ShardResult]:
        """Make the shards of a chunk."""
        return [make_shard(self.plan, Storage(self.url), segment.point) for segment in chunk]

    def failed(self, segment: Segment, error: str) -> ShardResult:
        """The result of a shard that repeatedly killed its worker."""
        return ShardResult(segment.point, 0, error)


class ShardQueue:
    """The missing shards, one per chunk."""

    def __init__(self, missing: list[int]) -> None:
        self.chunks = (
            (Segment(shard, {}, shard, range(shard, shard + 1)),) for shard in missing
        )

    def next(self) -> Chunk:
        """The next shard as a chunk; empty if nothing is left."""
        return next(self.chunks, ())

    def report_time(self, chunk: Chunk, seconds: float) -> None:
        """Do nothing: the size of a shard is fixed by the plan."""


# The images of all frames as one array.


ZARR = "images.zarr"
ZARR_ARRAY = "images"


def require_zarr() -> Any:
    """The package zarr. Raises InputError."""
    with refusing(ImportError, "dataset.formats", f"zarr {EXTRA}"):
        import zarr
    return zarr


def create_zarr(storage: Storage, plan: DatasetPlan) -> None:
    """Create the array of all images, with the size and type of the first; its shards are those of the dataset."""
    image = next(labelled_frames(plan, 0))[3].frame.image_dn
    shape = image.shape
    group = require_zarr().create_group(
        storage.zarr_store(ZARR), zarr_format=3, overwrite=True
    )
    group.create_array(
        ZARR_ARRAY,
        shape=(plan.frames, *shape),
        chunks=(1, *shape),
        shards=(plan.frames_per_shard, *shape),
        dtype=image.dtype,
        dimension_names=("frame", "y", "x"),
        attributes={"units": "DN"},
    )


def write_zarr(storage: Storage, first: int, images: list[Array], shard: int) -> None:
    """Write the images of one shard, which is one object. Raises InputError for an image of another size."""
    array = require_zarr().open_group(storage.zarr_store(ZARR), mode="r+")[ZARR_ARRAY]
    for n, image in enumerate(images):
        if image.shape != array.shape[1:] or image.dtype != array.dtype:
            raise InputError(
                "dataset.formats",
                f"zarr: frame {first + n} of shard {shard} is {image.shape[1]}x{image.shape[0]} {image.dtype}, the"
                f" first one {array.shape[2]}x{array.shape[1]} {array.dtype}",
                "one size, or webdataset",
            )
    array[first : first + len(images)] = np.stack(images)


# On the workers.


def labelled_frames(
    plan: DatasetPlan, shard: int
) -> Iterator[tuple[int, Record, TrialSetup, LabelledFrame]]:
    """The frames of a shard: number, level of each factor, lab, frame with labels."""
    known = None  # settings of the previous frame
    for frame in plan.frames_of(shard):
        levels, settings = plan.draw(shard, frame)
        if known is None:
            setup = prepared_setup(plan.spec, settings)
            by = labeller(setup.lab.scene)
        if settings != known:
            setup = setup._replace(trial=resolve_trial(plan.spec, settings))
            known = settings
        yield frame, levels, setup, label_frame(setup, plan.seed(frame), by)


def make_shard(plan: DatasetPlan, storage: Storage, shard: int) -> ShardResult:
    """Render a shard's frames and write all of its files, the index last."""
    frames = plan.frames_of(shard)
    rows = list[Record]()
    sources = []
    images = []
    coco = []
    name = shard_name(SHARDS, shard, "tar")
    with storage.writer(name) if "webdataset" in plan.formats else nullcontext() as file:
        for frame, levels, setup, one in labelled_frames(plan, shard):
            numbers = {"frame": frame, "shard": shard, "seed": plan.seed(frame)}
            row = frame_labels(one, setup.lab.scene, numbers)
            row |= {"pixel_type": one.frame.image_dn.dtype.str, "file": name if file else ""}
            row["position"] = (
                add_frame(file, frame, one, row | {"levels": levels}, plan.compress)
                if file
                else -1
            )
            rows.append(row | {"levels": json.dumps(levels, default=str)})
            sources.append(one.sources)
            if "zarr" in plan.formats:
                images.append(one.frame.image_dn)
            if "coco" in plan.formats:
                coco.append(coco_annotations(one, frame))
        if file:
            tarfile.TarFile(fileobj=file, mode="w").close()  # writes the end of the tar
    if images:
        write_zarr(storage, frames.start, images, shard)
    if "coco" in plan.formats:
        storage.write(
            shard_name(COCO, shard, "json"),
            coco_file([coco_image(row, plan.compress) for row in rows], coco),
        )
    storage.write(
        shard_name(SOURCES, shard, "parquet"),
        sources_table(list(frames), sources),
    )
    storage.write(
        shard_name(INDEX, shard, "parquet"),
        parquet({name: [row[name] for row in rows] for name in rows[0]}),
    )
    return ShardResult(shard, len(rows))


# In the process of the command.


def prepare(plan: DatasetPlan, storage: Storage) -> None:
    """Write the manifest of a new dataset, or check that an existing one is the plan's. Raises InputError."""
    described = {
        "made_by": "skysim",
        "format": FORMAT,
        "skysim": __version__,
        "code": code_version(),
        "digest": plan.digest,
    }
    there = storage.names()
    if MANIFEST in there:
        check_manifest(storage, described)
    elif there:
        raise InputError(
            storage.url, f"contains {min(there)}", "an empty folder, or this dataset"
        )
    else:
        storage.prepare(())
        text = json.dumps(described | plan.manifest(), indent=1, default=str)
        storage.write(MANIFEST, text.encode())
    storage.prepare(folders_of(plan))
    # The description of the array is written last.
    if "zarr" in plan.formats and "zarr.json" not in storage.names(f"{ZARR}/{ZARR_ARRAY}"):
        create_zarr(storage, plan)


def folders_of(plan: DatasetPlan) -> tuple[str, ...]:
    """The folders of a dataset's files, except that of Zarr."""
    return (
        INDEX,
        SOURCES,
        *(folder for name, folder in FOLDERS.items() if name in plan.formats),
    )


def check_manifest(storage: Storage, own: Record) -> None:
    """Raise InputError if the existing dataset is another one, or of another version."""
    try:
        stored = json.loads(storage.read_text(MANIFEST))
        kept = {key: stored[key] for key in own}
    except (LookupError, TypeError, ValueError, RecursionError):
        raise InputError(
            storage.url, f"{MANIFEST} is not that of a dataset", "an empty folder"
        ) from None
    if kept["format"] != FORMAT:
        raise InputError(
            storage.url,
            f"a dataset of format {kept['format']}",
            f"{FORMAT}, or another folder",
        )
    if kept["digest"] != own["digest"]:
        raise InputError(
            storage.url,
            "contains another dataset or an earlier version of this one",
            "another folder",
        )
    if kept["code"] != own["code"]:
        raise InputError(
            storage.url,
            f"made by skysim {kept['skysim']}, code {kept['code']}",
            f"{own['code']}, the version here, or another folder",
        )


def run(
    plan: DatasetPlan,
    url: str,
    engine: Engine,
    watch: Callable[[Progress], Any] | None = None,
) -> Progress:
    """Make the missing shards. Progress counts frames; frames of shards that killed their workers count as failed."""
    storage = Storage(url)
    prepare(plan, storage)
    there = storage.names(INDEX)
    missing = [
        shard
        for shard in range(plan.shards)
        if shard_name("", shard, "parquet")[1:] not in there
    ]
    left = sum(len(plan.frames_of(shard)) for shard in missing)
    progress = Progress(plan.frames, plan.frames - left)
    # Workers of a cluster run in folders of their own.
    job = DatasetJob(plan, storage.root if storage.is_local else url)
    for results in engine.run(job, ShardQueue(missing)) if missing else ():
        for result in results:
            progress.done += result.frames
            progress.now += result.frames
            progress.failed += len(plan.frames_of(result.shard)) if result.error else 0
        if watch:
            watch(progress)
    # Workers of a killed run may have been writing when this one began.
    storage.prepare(folders_of(plan))
    return progress
