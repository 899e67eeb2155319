"""The files of one shard: a tar of frames and labels (WebDataset), COCO JSON, part of a Zarr array, Parquet tables."""

import io
import json
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from estimator.core.types import ra_dec_roll_rad
from skysim.core.errors import InputError
from skysim.core.files import atomic_file, make_folder
from skysim.core.types import ATTITUDES, Floats, Record
from skysim.experiments.dataset_labels import MASKS, Extents, LabelledFrame
from skysim.scene.scene import Scene
from skysim.scene.sections.light import StarsConfig

# The folder of a dataset: any URL that fsspec knows. A local file, like an object, appears whole or not at all.


EXTRA = "needs optional packages: pip install 'skysim[dataset]'"
URLS = "a folder, or a URL such as s3://bucket/folder"


class Storage:
    """Files of a dataset by name. Raises InputError for a URL that cannot be opened."""

    def __init__(self, url: str) -> None:
        if "memory://" in url:
            raise InputError(url, "is lost at the end of the process", URLS)
        try:
            from fsspec.core import url_to_fs
        except ImportError:
            raise InputError(url, f"a dataset {EXTRA}") from None
        try:
            self.files, self.root = url_to_fs(url)
        except ImportError as error:
            raise InputError(url, f"{error}; {EXTRA}") from None
        except (OSError, ValueError) as error:
            raise InputError(url, error, URLS) from None
        self.url = url
        self.is_local = "file" in (self.files.protocol, *self.files.protocol)

    def path(self, name: str) -> str:
        """The path of a file in the file system."""
        return f"{self.root.rstrip('/')}/{name}"

    def names(self, folder: str = "") -> set[str]:
        """Names of the files of a folder; empty if there is none. Raises InputError if it cannot be read."""
        with self.errors():
            self.files.invalidate_cache()
            try:
                found = self.files.ls(self.path(folder), detail=False)
            except FileNotFoundError:
                return set()
        names = {str(path).rstrip("/").rsplit("/", 1)[-1] for path in found}
        return {name for name in names if name and not name.startswith(".")}

    def read_text(self, name: str) -> str:
        """A text file. Raises InputError if it cannot be read."""
        with self.errors():
            return str(self.files.cat_file(self.path(name)).decode("utf-8", "replace"))

    def prepare(self, folders: tuple[str, ...]) -> None:
        """Create the folders, without temporary files of writers that were killed."""
        if self.is_local:
            for folder in ("", *folders):
                make_folder(Path(self.path(folder)))

    @contextmanager
    def writer(self, name: str) -> Iterator[IO[bytes]]:
        """A file to be written from beginning to end."""
        if self.is_local:
            with (
                atomic_file(Path(self.path(name))) as temporary,
                temporary.open("wb") as file,
            ):
                yield file
            return
        with self.errors(), self.files.open(self.path(name), "wb") as file:
            yield file

    def write(self, name: str, data: bytes) -> None:
        """Write a whole file."""
        with self.writer(name) as file:
            file.write(data)

    def zarr_store(self, name: str) -> Any:
        """The store of a Zarr group."""
        from zarr.storage import FsspecStore, LocalStore

        return (
            LocalStore(self.path(name))
            if self.is_local
            else FsspecStore.from_url(f"{self.url.rstrip('/')}/{name}")
        )

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Raise InputError for errors of the server or the network; errors of local files name their file."""
        try:
            yield
        except InputError:
            raise
        except Exception as error:
            if self.is_local:
                raise
            raise InputError(self.url, error, f"{URLS} that can be written") from None


ZARR = "images.zarr"
ZARR_ARRAY = "images"
IMAGE_NAME = {False: "image.npy", True: "image.npz"}  # of a frame in a tar; True: compressed
COCO_SNR = 3.0  # sources below have no annotation; they are in the other labels
CATEGORIES = ("source", *MASKS)
SOURCE_JSON = (
    '{"id": %d, "image_id": %d, "category_id": 1, "bbox": [%s], "area": %r, '
    '"segmentation": [[%s]], "iscrowd": 0, "source": %d, "electrons": %r, "detected": %s}'
)


def key_of(frame: int) -> str:
    """The key of a frame's files in a shard."""
    return f"{frame:09d}"


def shard_name(folder: str, shard: int, suffix: str) -> str:
    """Name of a shard's file in the dataset."""
    return f"{folder}/{shard:06d}.{suffix}"


def add_file(tar: tarfile.TarFile, name: str, data: bytes) -> int:
    """Append a file without time and owner, so that the same frames give the same bytes; return where it ends."""
    header = tarfile.TarInfo(name)
    header.size = len(data)
    begin = tar.offset + tarfile.BLOCKSIZE
    tar.addfile(header, io.BytesIO(data))
    return begin + len(data)


def add_frame(
    tar: tarfile.TarFile, number: int, one: LabelledFrame, labels: Record, compress: bool
) -> int:
    """Append a frame with its labels; return the position of its first pixel, -1 if it is compressed (an .npz)."""
    key = key_of(number)
    image = np.ascontiguousarray(one.frame.image_dn)
    data = io.BytesIO()
    if compress:
        np.savez_compressed(data, image=image)
    else:
        np.save(data, image)
    end = add_file(tar, f"{key}.{IMAGE_NAME[compress]}", data.getvalue())
    sources = io.BytesIO()
    np.save(sources, one.sources)
    add_file(tar, f"{key}.sources.npy", sources.getvalue())
    masks = {
        name: {"size": list(image.shape), "counts": counts}
        for name, counts in one.masks.items()
    }
    more = {
        "masks": masks,
        "unmatched_px": one.unmatched_px.tolist(),
        "hidden": one.truth.hidden.tolist(),
    }
    add_file(tar, f"{key}.frame.json", json.dumps(labels | more).encode())
    return -1 if compress else end - image.nbytes


def frame_labels(one: LabelledFrame, scene: Scene, numbers: Record) -> Record:
    """The scalar labels of a frame, by column of the index; `numbers` come first."""
    truth = one.truth
    frame = one.frame
    height, width = frame.image_dn.shape
    labels = {
        **numbers,
        "height": height,
        "width": width,
        "exposure_s": frame.exposure_s,
        "saturation_dn": frame.saturation_dn,
    }
    vectors = {
        tuple(f"{name}_q{end}" for end in "xyzw"): getattr(truth, name).as_quat()
        for name in ATTITUDES
    }
    vectors[tuple(f"rate_cam_{end}_rad_s" for end in "xyz")] = truth.rate_cam_rad_s
    if isinstance(scene.light, StarsConfig):
        angles_rad = ra_dec_roll_rad(truth.mean_cam_from_lab)
        vectors["ra_deg", "dec_deg", "roll_deg"] = np.degrees(angles_rad)
    for names, values in vectors.items():
        labels |= zip(names, values.tolist(), strict=True)
    labels |= {"sources": len(one.sources), "detected": int(one.sources["detected"].sum())}
    labels["unmatched"] = len(one.unmatched_px)
    return labels | {f"{name}_pixels": sum(one.masks.get(name, [])[1::2]) for name in MASKS}


# COCO.


def coco_image(labels: Record, compress: bool) -> Record:
    """The entry of an image; its file is in the tar of the shard."""
    tar = shard_name("shards", labels["shard"], "tar")
    return {
        "id": labels["frame"],
        "file_name": f"{tar}/{key_of(labels['frame'])}.{IMAGE_NAME[compress]}",
        "height": labels["height"],
        "width": labels["width"],
    }


def coco_annotations(one: LabelledFrame, number: int) -> bytes:
    """JSON objects, joined by commas: outlines of the sources, and masks of the rest as crowds.

    Ids are unique in the dataset. A source is written as `json.dumps` would, but faster.
    """
    seen = one.sources["snr"] >= COCO_SNR
    rows = one.sources[seen]
    first = number * 100_000 + 1
    boxes, corners = outlines(one.extents.of(seen))
    ids = rows["id"].tolist()
    detected = (("false", "true")[one] for one in rows["detected"].tolist())
    areas = (boxes[:, 2] * boxes[:, 3]).tolist()
    columns = (
        hundredths(boxes),
        areas,
        hundredths(corners),
        ids,
        rows["electrons"].tolist(),
        detected,
    )
    found = [
        SOURCE_JSON % (first + n, number, *each)
        for n, each in enumerate(zip(*columns, strict=True))
    ]
    height, width = one.frame.image_dn.shape
    for name, counts in one.masks.items():
        if len(counts) > 1:
            mask = {
                "id": first + len(found),
                "image_id": number,
                "category_id": 1 + CATEGORIES.index(name),
                "bbox": mask_box(counts, height),
                "area": sum(counts[1::2]),
                "segmentation": {"size": [height, width], "counts": counts},
                "iscrowd": 1,
            }
            found.append(json.dumps(mask))
    return ", ".join(found).encode()


def outlines(extents: Extents) -> tuple[Floats, Floats]:
    """(N, 4) boxes (x, y, width, height) and (N, 8) outlines (x, y of four corners).

    COCO's origin is the corner of the first pixel, half a pixel from its center.
    """
    across = extents.along[:, ::-1] * [-1, 1]
    a = extents.along * extents.half_px[:, :1]
    b = across * extents.half_px[:, 1:]
    corners = np.round(
        extents.center_px[:, None] + 0.5 + np.stack([-a - b, a - b, a + b, b - a], axis=1), 2
    )
    low = corners.min(axis=1)
    high = corners.max(axis=1)
    return np.round(np.column_stack([low, high - low]), 2), corners.reshape(-1, 8)


def hundredths(numbers: Floats) -> list[str]:
    """The rows of (N, K) finite numbers with two decimals, as `json.dumps` writes a list without its brackets."""
    return [str(row)[1:-1] for row in np.round(numbers, 2).tolist()]


def mask_box(counts: list[int], height: int) -> list[float]:
    """The box about the pixels of a mask."""
    ends = np.cumsum(counts)
    first = ends[:-1:2]
    last = ends[1::2] - 1
    x0 = int(first[0] // height)
    x1 = int(last[-1] // height)
    # A run over the end of a column has its first and its last row.
    whole = first // height != last // height
    y0 = 0 if whole.any() else int((first % height).min())
    y1 = height - 1 if whole.any() else int((last % height).max())
    return [float(x0), float(y0), float(x1 - x0 + 1), float(y1 - y0 + 1)]


def coco_file(images: list[Record], annotations: list[bytes]) -> bytes:
    """A COCO file of one shard, from the annotations of each frame."""
    categories = json.dumps(
        [{"id": n, "name": name} for n, name in enumerate(CATEGORIES, 1)]
    ).encode()
    parts = (json.dumps(images).encode(), b", ".join(filter(None, annotations)), categories)
    return b'{"images": %b, "annotations": [%b], "categories": %b}' % parts


# Tables.


def parquet(columns: Record) -> bytes:
    """A Parquet file of some columns, the same bytes for the same columns. Raises InputError without pyarrow."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError("", f"a dataset {EXTRA}") from None
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.table(columns), sink, compression="zstd")
    return bytes(sink.getvalue())


def index_table(rows: list[Record]) -> bytes:
    """The index of a shard: a row for each frame."""
    return parquet({name: [row[name] for row in rows] for name in rows[0]})


def sources_table(frames: list[int], sources: list[NDArray]) -> bytes:
    """The sources of a shard: a row for each source of each frame."""
    rows = np.concatenate(sources)
    number = np.repeat(frames, [len(one) for one in sources])
    return parquet(
        {
            "frame": number,
            **{name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names or ()},
        }
    )


# Zarr.


def require_zarr() -> Any:
    """The package zarr. Raises InputError."""
    try:
        import zarr
    except ImportError:
        raise InputError("dataset.formats", f"zarr {EXTRA}") from None
    return zarr


def create_zarr(storage: Storage, frames: int, per_shard: int, image: NDArray) -> None:
    """Create the array of all images, with the size and type of this one; its shards are those of the dataset."""
    shape = image.shape
    group = require_zarr().create_group(
        storage.zarr_store(ZARR), zarr_format=3, overwrite=True
    )
    group.create_array(
        ZARR_ARRAY,
        shape=(frames, *shape),
        chunks=(1, *shape),
        shards=(per_shard, *shape),
        dtype=image.dtype,
        dimension_names=("frame", "y", "x"),
        attributes={"units": "DN"},
    )


def write_zarr(storage: Storage, first: int, images: list[NDArray], shard: int) -> None:
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
