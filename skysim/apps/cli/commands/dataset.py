"""Command `skysim dataset`."""

from contextlib import closing
from pathlib import Path

import typer

from skysim.apps.cli.commands.study import (
    EngineName,
    Scheduler,
    Workers,
    create_engine,
    start_workers,
)
from skysim.apps.cli.options import Json, Overrides, SceneArg, Seed
from skysim.apps.cli.terminal import print_error, print_json, trial_progress


def dataset(
    scene: SceneArg,
    frames: int,
    out: str,
    vary: Path | None = None,
    to: list[str] | None = None,
    shard_frames: int = 64,
    compress: bool = False,
    seed: Seed = None,
    set_: Overrides = None,
    workers: Workers = None,
    engine: EngineName = "pool",
    scheduler: Scheduler = "",
    json: Json = False,
) -> None:
    """Write labelled frames at random attitudes, for those who train and test detectors.

    Stopped or killed, it goes on where it was when it is called again.

    Parameters
    ----------
    frames
        Number of frames.
    out : URL
        Output folder, or a URL such as s3://bucket/folder.
    vary : FILE
        Variations: YAML with the study's keys set, trial, factors, hardware.
    to
        Format: webdataset, zarr, coco; repeatable. Default: webdataset and coco.
    shard_frames
        Frames of a shard.
    compress
        Compress the images of the tars: .npz in place of .npy.
    """
    start_workers(engine)
    from skysim.core.yaml_reader import parse_overrides
    from skysim.experiments import dataset_run
    from skysim.experiments.dataset_shards import Storage

    Storage(out)  # raises for a wrong URL before the scene is read
    made = dataset_run.load(
        scene,
        vary,
        frames,
        seed=seed,
        overrides=parse_overrides(set_),
        frames_per_shard=shard_frames,
        formats=tuple(to or ("webdataset", "coco")),
        compress=compress,
    )
    with (
        closing(create_engine(engine, workers, scheduler)) as chosen,
        trial_progress(f"dataset of {scene}", frames, "frames") as update,
    ):
        progress = dataset_run.run(made, out, chosen, update)
    if json:
        print_json(
            {
                "out": out,
                "frames": progress.done,
                "shards": made.shards,
                "failed": progress.failed,
                "rate_hz": progress.rate,
            }
        )
    else:
        print(f"{progress.done} of {frames} frames in {made.shards} shards: {out}")
    if progress.failed:
        print_error(
            f"{progress.failed} frames are missing: their workers died; the same command tries them again"
        )
        raise typer.Exit(2)
