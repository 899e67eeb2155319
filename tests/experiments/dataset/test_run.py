"""The files of a dataset: contents, and equality on any engine and after a kill."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.experiments import dataset_run, dataset_shards
from skysim.experiments.study.execution import engines, workers
from tests.helpers.small_dataset import HEIGHT, VARY, WIDTH, contents, small

pyarrow = pytest.importorskip("pyarrow.parquet")


@pytest.fixture(scope="module")
def vary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vary") / "night.yaml"
    path.write_text(VARY)
    return path


@pytest.fixture(scope="module")
def whole(vary: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of five frames made by one uninterrupted process."""
    folder = tmp_path_factory.mktemp("whole") / "frames"
    progress = dataset_run.run(small(vary), str(folder), engines.Serial())
    assert (progress.done, progress.failed) == (5, 0)
    return folder


def index(folder: Path) -> list[dict[str, Any]]:
    tables = [
        pyarrow.read_table(path) for path in sorted((folder / "index").glob("*.parquet"))
    ]
    return [row for table in tables for row in table.to_pylist()]


def samples(folder: Path) -> dict[str, dict[str, Any]]:
    """The files of every frame by key and ending, as a loader of WebDataset sees them."""
    found: dict[str, dict[str, Any]] = {}
    for path in sorted((folder / "shards").glob("*.tar")):
        with tarfile.open(path) as tar:
            for member in tar:
                key, _, ending = member.name.partition(".")
                file = tar.extractfile(member)
                assert file is not None
                data = file.read()
                value = (
                    json.loads(data) if ending.endswith("json") else np.load(io.BytesIO(data))
                )
                found.setdefault(key, {})[ending] = value
    return found


def test_every_format_has_the_same_frames(whole: Path) -> None:
    zarr = pytest.importorskip("zarr")
    rows = index(whole)
    made = samples(whole)
    images = zarr.open_group(whole / "images.zarr", mode="r")["images"]
    assert images.metadata.zarr_format == 3
    assert [row["frame"] for row in rows] == list(range(5))
    assert sorted(made) == [dataset_shards.key_of(n) for n in range(5)]
    for row in rows:
        one = made[dataset_shards.key_of(row["frame"])]
        image = one["image.npy"]
        assert image.shape == (row["height"], row["width"])
        np.testing.assert_array_equal(images[row["frame"]], image)
        with (whole / row["file"]).open("rb") as file:  # one frame without its shard
            file.seek(row["position"])
            pixels = np.frombuffer(file.read(image.nbytes), row["pixel_type"]).reshape(
                image.shape
            )
        np.testing.assert_array_equal(pixels, image)
        assert one["frame.json"]["levels"] == json.loads(row["levels"])
        assert 0.1 <= one["frame.json"]["levels"]["rate"] <= 0.5
        assert len(one["sources.npy"]) == row["sources"] > 0
    assert len({row["ra_deg"] for row in rows}) == 5
    rate = [
        np.degrees(np.linalg.norm([row[f"rate_cam_{end}_rad_s"] for end in "xyz"]))
        for row in rows
    ]
    np.testing.assert_allclose(
        rate, [json.loads(row["levels"])["rate"] for row in rows], rtol=1e-9
    )


def test_a_shard_has_the_bytes_that_tarfile_and_numpy_would_write(whole: Path) -> None:
    """Both read each file of the shard and write it again."""
    shards = sorted((whole / "shards").glob("*.tar"))
    assert shards
    for path in shards:
        again = io.BytesIO()
        with (
            tarfile.open(path) as tar,
            tarfile.TarFile(fileobj=again, mode="w", format=tarfile.USTAR_FORMAT) as copy,
        ):
            for member in tar:
                file = tar.extractfile(member)
                assert file is not None
                data = file.read()
                if member.name.endswith(".npy"):
                    written = io.BytesIO()
                    np.save(written, np.load(io.BytesIO(data)))
                    assert written.getvalue() == data
                header = tarfile.TarInfo(member.name)
                header.size = len(data)
                copy.addfile(header, io.BytesIO(data))
        assert again.getvalue() == path.read_bytes()


def test_the_table_of_sources_has_the_sources_of_the_frames(whole: Path) -> None:
    made = samples(whole)
    found = [
        pyarrow.read_table(path) for path in sorted((whole / "sources").glob("*.parquet"))
    ]
    ids = [
        pair
        for table in found
        for pair in zip(*(table[name].to_pylist() for name in ("frame", "id")), strict=True)
    ]
    assert ids == [
        (int(key), n)
        for key, one in sorted(made.items())
        for n in one["sources.npy"]["id"].tolist()
    ]


def test_boxes_hold_the_light_of_their_sources(whole: Path) -> None:
    """COCO counts from the corner of the first pixel. Brightness above the background inside is that of the source.

    A count is 10 electrons. The error has four standard deviations of the noise, and 2 % for light beside the box.
    """
    made = samples(whole)
    checked = 0
    ids = []
    for path in sorted((whole / "coco").glob("*.json")):
        coco = json.loads(path.read_text())
        ids += [one["id"] for one in coco["annotations"]]
        assert [one["name"] for one in coco["categories"]] == [
            "source",
            "saturated",
            "cosmic_ray",
            "smear",
        ]
        names = {one["id"]: one["file_name"] for one in coco["images"]}
        for one in coco["annotations"]:
            assert names[one["image_id"]].endswith(
                f"{dataset_shards.key_of(one['image_id'])}.image.npy"
            )
            if one["category_id"] != 1:
                continue
            sample = made[dataset_shards.key_of(one["image_id"])]
            image = sample["image.npy"].astype(float)
            rows = sample["sources.npy"]
            row = rows[rows["id"] == one["source"]][0]
            assert one["electrons"] == row["electrons"]
            numbers = [*one["bbox"], *one["segmentation"][0]]
            assert numbers == np.round(numbers, 2).tolist()
            x, y, width, height = one["bbox"]
            assert x < row["flux_x_px"] + 0.5 < x + width
            assert y < row["flux_y_px"] + 0.5 < y + height
            x0 = int(x)
            y0 = int(y)
            x1 = int(np.ceil(x + width))
            y1 = int(np.ceil(y + height))
            alone = np.hypot(rows["x_px"] - row["x_px"], rows["y_px"] - row["y_px"]) < 15
            if (
                row["snr"] > 15
                and alone.sum() == 1
                and x0 > 3
                and y0 > 3
                and x1 < WIDTH - 3
                and y1 < HEIGHT - 3
            ):
                light_e = (image[y0:y1, x0:x1] - np.median(image)).sum() * 10
                noise_e = np.sqrt(
                    (y1 - y0) * (x1 - x0) * np.var(image[:, :20]) * 100 + row["electrons"]
                )
                assert abs(light_e - row["electrons"]) < 4 * noise_e + 0.02 * row["electrons"]
                checked += 1
    assert checked >= 4
    assert len(set(ids)) == len(ids)


def test_the_box_of_a_mask_is_about_its_pixels() -> None:
    from skysim.experiments.dataset_shards import run_lengths

    rng = np.random.default_rng(1)
    for share in (0.02, 0.3):
        mask = rng.random((20, 30)) < share
        y, x = np.nonzero(mask)
        box = [x.min(), y.min(), np.ptp(x) + 1, np.ptp(y) + 1]
        assert dataset_shards.mask_box(run_lengths(mask), 20) == box
    mask[:, :] = False
    # one run from column 7 to column 8
    mask[3:5, 2] = True
    mask[18:, 7] = True
    mask[:2, 8] = True
    assert dataset_shards.mask_box(run_lengths(mask), 20) == [2, 0, 7, 20]


class Stopped(Exception):
    """The process that makes a dataset was killed."""


@pytest.mark.slow
def test_a_dataset_killed_at_any_file_and_resumed_has_the_same_bytes(
    whole: Path, vary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before and after each file; a temporary file that was half written stays behind."""
    original = dataset_shards.Storage.write
    left = 0

    def stopping(self: dataset_shards.Storage, name: str, data: bytes) -> None:
        nonlocal left
        left -= 1
        if left == 0:
            torn = Path(self.path(name))
            torn.with_name(
                f".{torn.stem}.skysim-{storage_host()}-999999999{torn.suffix}"
            ).write_bytes(b"half")
            raise Stopped
        original(self, name, data)
        if left == 1:
            raise Stopped

    monkeypatch.setattr(dataset_shards.Storage, "write", stopping)
    stops = 0
    for first in range(1, 11):
        folder = tmp_path / f"{first}"
        left = first
        for _ in range(30):
            try:
                dataset_run.run(small(vary), str(folder), engines.Serial())
                break
            except Stopped:
                stops = stops + 1
                left = first + 3
        assert contents(folder) == contents(whole)
    assert stops > 12


def storage_host() -> str:
    from skysim.core.files import HOST

    return HOST


DRIVER = """
import sys
from pathlib import Path
from tests.helpers.small_dataset import small
from skysim.experiments import dataset_run
from skysim.experiments.study.execution import engines
if __name__ == "__main__":
    plan = small(Path(sys.argv[1]), 40)
    dataset_run.run(plan, sys.argv[2], engines.Pool(2), lambda progress: print(progress.done, flush=True))
"""


@pytest.mark.long
def test_a_dataset_killed_with_its_workers_and_resumed_has_the_same_bytes(
    vary: Path, tmp_path: Path
) -> None:
    """Twice by kill -9 in the middle of a shard, on two workers; then one process makes the rest."""
    dataset_run.run(small(vary, 40), str(tmp_path / "whole"), engines.Serial())
    driver = tmp_path / "driver.py"
    folder = tmp_path / "killed"
    driver.write_text(DRIVER)
    words = [sys.executable, driver, vary, folder]
    for most in (4, 16):
        environment = (
            os.environ | dict.fromkeys(workers.ONE_THREAD, "1") | {"PYTHONPATH": str(ROOT)}
        )
        with subprocess.Popen(
            words, stdout=subprocess.PIPE, text=True, env=environment, start_new_session=True
        ) as made:
            assert made.stdout is not None
            while int(made.stdout.readline()) < most:
                pass
            os.killpg(made.pid, signal.SIGKILL)
        time.sleep(1)
    assert dataset_run.run(small(vary, 40), str(folder), engines.Serial()).done == 40
    assert contents(folder) == contents(tmp_path / "whole")


@pytest.mark.slow
def test_two_workers_make_the_same_bytes(whole: Path, vary: Path, tmp_path: Path) -> None:
    engine = engines.Pool(2)
    assert dataset_run.run(small(vary), str(tmp_path / "two"), engine).done == 5
    engine.close()
    assert contents(tmp_path / "two") == contents(whole)


@pytest.mark.long
def test_dask_makes_the_same_bytes(whole: Path, vary: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    from skysim.experiments.study.execution.runner import ENGINES

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        engine = ENGINES["dask"](None, cluster.scheduler_address)
        assert dataset_run.run(small(vary), str(tmp_path / "dask"), engine).done == 5
        engine.close()
    assert contents(tmp_path / "dask") == contents(whole)


@pytest.mark.slow
def test_an_object_store_holds_the_same_bytes(
    whole: Path, vary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("s3fs")
    boto3 = pytest.importorskip("boto3")
    moto = pytest.importorskip("moto.server")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_DEFAULT_REGION"):
        monkeypatch.setenv(name, "us-east-1")
    server = moto.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    try:
        endpoint = "http://{}:{}".format(*server.get_host_and_port())
        monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
        client = boto3.client("s3", endpoint_url=endpoint)
        client.create_bucket(Bucket="frames")
        url = "s3://frames/night"
        assert dataset_run.run(small(vary), url, engines.Serial()).done == 5
        listed = client.list_objects_v2(Bucket="frames")["Contents"]
        made = {
            one["Key"]: client.get_object(Bucket="frames", Key=one["Key"])["Body"].read()
            for one in listed
        }
        assert {name.removeprefix("night/") for name in made} == set(contents(whole))
        for name, data in made.items():
            assert data == (whole / name.removeprefix("night/")).read_bytes(), name
        client.delete_object(Bucket="frames", Key="night/index/000001.parquet")
        assert dataset_run.run(small(vary), url, engines.Serial()).now == 2
        again = client.get_object(Bucket="frames", Key="night/index/000001.parquet")[
            "Body"
        ].read()
        assert again == made["night/index/000001.parquet"]
        with pytest.raises(InputError, match=r"^s3://nowhere/x: .*can be written"):
            dataset_run.run(small(vary), "s3://nowhere/x", engines.Serial())
    finally:
        server.stop()


def test_compressed_frames_are_the_same_in_less_space(
    whole: Path, vary: Path, tmp_path: Path
) -> None:
    """And a compressed dataset is another one than the same without."""
    plan = small(vary, compress=True, formats=("webdataset", "coco"))
    assert dataset_run.run(plan, str(tmp_path / "x"), engines.Serial()).done == 5
    packed = samples(tmp_path / "x")
    for key, one in samples(whole).items():
        np.testing.assert_array_equal(packed[key]["image.npz"]["image"], one["image.npy"])
        assert packed[key]["sources.npy"].tobytes() == one["sources.npy"].tobytes()
    sizes = [
        sum(path.stat().st_size for path in folder.glob("shards/*.tar"))
        for folder in (tmp_path / "x", whole)
    ]
    assert sizes[0] < 0.5 * sizes[1]
    assert {row["position"] for row in index(tmp_path / "x")} == {-1}
    coco = json.loads((tmp_path / "x" / "coco" / "000000.json").read_text())
    assert coco["images"][0]["file_name"] == "shards/000000.tar/000000000.image.npz"
    with pytest.raises(InputError, match="another dataset"):
        dataset_run.run(small(vary, compress=True), str(whole), engines.Serial())


def test_a_complete_dataset_is_unchanged(whole: Path, vary: Path) -> None:
    before = contents(whole)
    assert dataset_run.run(small(vary), str(whole), engines.Serial()).now == 0
    assert contents(whole) == before


def changed(key: str, value: Any) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        path = folder / dataset_run.MANIFEST
        path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            changed("digest", "0"),
            "contains another dataset or an earlier version of this one; allowed: another folder",
        ),
        (
            changed("code", "0123"),
            r"made by skysim 0\.\d+\.\d+, code 0123; allowed: [0-9a-f]{16}, the version here",
        ),
        (changed("format", 7), "a dataset of format 7; allowed: 2"),
        (
            lambda folder: (folder / dataset_run.MANIFEST).write_text("[" * 10_000),
            "is not that of a dataset",
        ),
        (
            lambda folder: (folder / dataset_run.MANIFEST).write_text("[]"),
            "is not that of a dataset",
        ),
        (
            lambda folder: (folder / dataset_run.MANIFEST).write_text("{}"),
            "is not that of a dataset",
        ),
        (
            lambda folder: (folder / dataset_run.MANIFEST).rename(folder / "mine.txt"),
            r"contains \w+; allowed: an empty folder",
        ),
    ],
)
def test_another_dataset_is_not_overwritten(
    vary: Path, tmp_path: Path, change: Callable[[Path], object], message: str
) -> None:
    made = dataset_shards.Storage(str(tmp_path / "frames"))
    dataset_run.prepare(small(vary, formats=("webdataset",)), made)
    change(tmp_path / "frames")
    before = contents(tmp_path)
    with pytest.raises(InputError, match=message):
        dataset_run.run(small(vary, formats=("webdataset",)), made.url, engines.Serial())
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "url", ["nowhere://x/y", "s4://bucket", "memory://x", "simplecache::memory://x"]
)
def test_an_unknown_url_is_refused(url: str) -> None:
    with pytest.raises(InputError, match=rf"^{url}: .*allowed"):
        dataset_shards.Storage(url)


def test_without_the_extra_one_line_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(InputError, match=r"pip install 'skysim\[dataset\]'"):
        dataset_shards.Storage("out/frames")


def test_frames_of_several_sizes_are_refused_for_zarr(tmp_path: Path) -> None:
    vary = tmp_path / "sizes.yaml"
    vary.write_text(
        "schema: 1\nfactors: {width: {key: camera.width_px, values: [240, 230, 220, 210]}}\n"
    )
    made = small(vary, 16, formats=("zarr",))
    assert len({made.draw(n // 2, n)[0]["width"] for n in range(16)}) > 1
    with pytest.raises(
        InputError,
        match=r"dataset.formats: zarr: frame \d+ of shard \d+ is \d+x180 uint16, the first one \d+x180",
    ):
        dataset_run.run(made, str(tmp_path / "frames"), engines.Serial())


def test_a_shard_that_kills_its_workers_is_reported_and_left_out() -> None:
    made = small(formats=("coco",))
    (chunk,) = dataset_run.ShardQueue([2]).next()
    failed = dataset_run.DatasetJob(made, "x").failed(chunk, engines.DIED)
    assert (failed.shard, failed.frames, failed.error) == (2, 0, engines.DIED)
    assert dataset_run.FORMATS


def test_workers_in_another_folder_write_to_that_of_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of a Dask cluster; a folder of --out may be relative."""

    class Elsewhere(engines.Serial):
        def run(self, job: Any, chunks: Any) -> Any:
            (tmp_path / "elsewhere").mkdir()
            monkeypatch.chdir(tmp_path / "elsewhere")
            yield from super().run(job, chunks)
            monkeypatch.chdir(tmp_path)

    monkeypatch.chdir(tmp_path)
    made = small(frames=2, formats=("coco",))
    assert dataset_run.run(made, "out", Elsewhere()).done == 2
    assert list((tmp_path / "elsewhere").iterdir()) == []
    assert (tmp_path / "out" / dataset_run.MANIFEST).is_file()
