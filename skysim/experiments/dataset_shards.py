"""A frame of a dataset with its labels (sources, detections, masks), and the files of one shard of frames.

They are a tar of frames and labels (WebDataset), COCO JSON, and Parquet tables.
"""

import io
import json
import math
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from pydantic_core import to_json

from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids, ra_dec_roll_rad
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.camera.detector import PARTICLES, SMEAR, AddedCharge
from skysim.camera.render import Window
from skysim.core.errors import InputError, refusing
from skysim.core.files import atomic_file, make_folder
from skysim.core.types import (
    ATTITUDES,
    Array,
    Floats,
    Frame,
    Ints,
    Record,
    SourceTruth,
    Truth,
    lengths,
    taken,
)
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.outcomes import SAME_LIGHT_PX
from skysim.scene.scene import Scene
from skysim.scene.sections.light import StarsConfig
from skysim.simulation.lab import exposure_window
from skysim.tracking.factory import assumed_settings
from skysim.tracking.onboard_model import assumed_camera

SATURATED = "saturated"
MASKS = (SATURATED, PARTICLES, SMEAR)
REACH_SIGMA = 3.0  # half-width of a source's rectangle, in standard deviations of its image across the streak
DISC_PX = 2.0  # sources of a larger radius are discs with edges
EDGE_PX = 3.0  # reach of the blur about the edge of a disc
STILL_PX = 1e-6  # length below which a streak has no direction
SOURCE = np.dtype(
    [
        ("id", "<i8"),
        *((name, "<f8") for name in ("x_px", "y_px", "flux_x_px", "flux_y_px")),
        *(
            (name, "<f4")
            for name in (
                "streak_x_px",
                "streak_y_px",
                "streak_px",
                "electrons",
                "peak_e",
                "snr",
                "sigma_px",
                "radius_px",
            )
        ),
        ("saturated", "?"),
        ("detected", "?"),
        *((name, "<f4") for name in ("detected_x_px", "detected_y_px")),
    ]
)


class Extents(NamedTuple):
    """The rectangle about each source's image, along its streak.

    Attributes
    ----------
    center_px
        (N, 2) centers
    along
        (N, 2) unit vectors of the streaks
    half_px
        (N, 2) half-length and half-width
    """

    center_px: Floats
    along: Floats
    half_px: Floats


class LabelledFrame(NamedTuple):
    """A frame with its labels.

    Attributes
    ----------
    sources
        (N,) of dtype SOURCE, brightest first
    extents
        The rectangle about each image
    unmatched_px
        (M, 2) detections that are not a source: noise, particles, hot pixels
    masks
        Run lengths of `run_lengths` by name of MASKS, without masks that the scene cannot have
    """

    frame: Frame
    truth: Truth
    sources: Array
    extents: Extents
    unmatched_px: Floats
    masks: dict[str, list[int]]


class Labeller(NamedTuple):
    """Values that the labels of all frames of one scene need.

    Attributes
    ----------
    camera, settings
        Camera and settings that the scene's tracker assumes
    threshold_e
        Least charge from particles or smear in a pixel of their masks
    """

    camera: Camera
    settings: Settings
    threshold_e: float


def labeller(scene: Scene) -> Labeller:
    """The labeller of a scene. Build it once for all frames: building takes a tenth of the time of a frame."""
    config = scene.camera.detector
    threshold_e = max(math.hypot(config.read_noise_e, config.reset_noise_e), 1.0)
    return Labeller(assumed_camera(scene), assumed_settings(scene), threshold_e)


def label_frame(
    setup: trials.TrialSetup, seed: int, by: Labeller | None = None
) -> LabelledFrame:
    """Render the frame of a frame trial, and its labels. They depend only on the setup and the seed.

    Parameters
    ----------
    by
        Labeller of the setup's scene, if there is one already
    """
    scene = setup.lab.scene
    by = by or labeller(scene)
    added = AddedCharge(by.threshold_e)
    frame, truth, streak_px = trials.render_trial_frame(setup, seed, added)
    try:
        found = detect_and_centroid(
            frame.image_dn, by.camera, by.settings, Clock(), streak_px
        )
    except ImageError:  # a saturated frame
        found = Centroids.empty()
    sources, unmatched = source_rows(truth.sources, found.xy_px)
    # The radii of Sun, Moon and planets, without the lens's distortion.
    for body in truth.bodies:
        radius_rad = math.radians(body.diameter_arcsec / 7200)
        own = sources["id"] == body.id
        sources["radius_px"][own] = radius_rad * scene.camera.focal_px
    extents = image_extents(sources, exposure_window(scene, frame.index))
    least_dn = frame.saturation_dn
    if frame.image_dn.dtype.kind == "u":
        least_dn = math.ceil(least_dn)  # an integer compares faster
    runs = {SATURATED: run_lengths(frame.image_dn, least_dn)}
    runs |= {name: run_lengths(added.masks[name]) for name in MASKS if name in added.masks}
    return LabelledFrame(frame, truth, sources, extents, unmatched, runs)


def source_rows(truth: SourceTruth, found_px: Floats) -> tuple[Array, Floats]:
    """(N,) labels of the sources, brightest first, and the (M, 2) detections that belong to no source.

    A detection belongs to the brightest free source whose distance is at most SAME_LIGHT_PX plus half the length of
    its streak.
    """
    order = np.argsort(-truth.electrons, kind="stable")
    rows = np.zeros(len(order), SOURCE)
    for name in ("", "flux_", "streak_"):
        place = getattr(truth, f"{name}xy_px")[order]
        rows[f"{name}x_px"], rows[f"{name}y_px"] = place.T
    for name in ("id", "streak_px", "electrons", "peak_e", "snr", "saturated"):
        rows[name] = getattr(truth, name)[order]
    rows["sigma_px"] = across_sigma_px(truth.area_px, truth.streak_px)[order]
    rows["detected_x_px"] = rows["detected_y_px"] = np.nan
    chosen = brightest_near(
        found_px, truth.flux_xy_px[order], SAME_LIGHT_PX + truth.streak_px[order] / 2
    )
    own = chosen[chosen >= 0]
    rows["detected"][own] = True
    rows["detected_x_px"][own], rows["detected_y_px"][own] = found_px[chosen >= 0].T
    return rows, found_px[chosen < 0]


def brightest_near(found_px: Floats, source_px: Floats, reach_px: Floats) -> Ints:
    """(M,) number of the first free source within reach of each detection; -1 if there is none."""
    chosen = np.full(len(found_px), -1)
    x_px, y_px = map(np.subtract.outer, found_px.T, source_px.T)
    used = set[int]()
    # All pairs within reach, detection by detection.
    for m, n in np.argwhere(x_px**2 + y_px**2 <= reach_px**2).tolist():
        if chosen[m] < 0 and n not in used:
            chosen[m] = n
            used.add(n)
    return chosen


def image_extents(rows: Array, window: Window) -> Extents:
    """The rectangle about each source's streak.

    On each side it is wider than the streak by REACH_SIGMA standard deviations of the blur, or by the radius of a disc
    and its blurred edge. A rolling shutter exposes the row of a disc's center at another time than the middle row, and
    shears the disc.
    """
    streak = np.nan_to_num(
        np.column_stack([rows["streak_x_px"], rows["streak_y_px"]]).astype(float)
    )
    length = lengths(streak)
    along = np.where(
        length[:, None] > STILL_PX, streak / np.maximum(length, STILL_PX)[:, None], [1.0, 0.0]
    )
    # For a source at the row y at mid-exposure: delay = row_time (y + v_y delay - middle row), in exposures.
    rolling = window.row_time_s / window.exposure_s
    rolling = rolling / np.maximum(1 - rolling * streak[:, 1], 0.1)
    radius = rows["radius_px"].astype(float)
    disc = radius > DISC_PX
    delay = rolling * (rows["y_px"] - (window.rows - 1) / 2)
    middle = np.column_stack([rows["x_px"], rows["y_px"]]) + delay[:, None] * streak
    center = np.where(
        disc[:, None], middle, np.column_stack([rows["flux_x_px"], rows["flux_y_px"]])
    )
    reach = np.where(disc, radius + EDGE_PX, REACH_SIGMA * rows["sigma_px"])
    shear = np.where(disc, rolling * radius, 0.0) * length
    return Extents(center, along, np.column_stack([length / 2 + reach + shear, reach]))


def across_sigma_px(area_px: Floats, streak_px: Floats) -> Floats:
    """(N,) standard deviation across the streak of a Gaussian image with this noise-equivalent area.

    A Gaussian of sigma s at rest has 4 pi s^2; one along a path L much longer than s has 2 sqrt(pi) s L. The root of
    (4 pi s^2)^2 + (2 sqrt(pi) s L)^2 = area^2 has both limits, and an error of 6 % at most between them.
    """
    square = streak_px**2
    return np.sqrt((np.sqrt(square**2 + 4 * area_px**2) - square) / (8 * math.pi))


def run_lengths(mask: Array, least: float = True) -> list[int]:
    """Lengths of the runs of an (H, W) mask, column by column, beginning with pixels that are not set: COCO's code.

    Parameters
    ----------
    least
        Least value of a pixel that is set
    """
    rows = np.flatnonzero(mask.max(axis=1) >= least)  # most rows have no pixel that is set
    y, x = np.nonzero(mask[rows] >= least)
    # A copy of the transposed mask would take ten times longer.
    flat = np.sort(x * len(mask) + rows[y])
    if not len(flat):
        return [mask.size]
    breaks = np.flatnonzero(np.diff(flat) != 1)
    first = np.concatenate([flat[:1], flat[breaks + 1]])
    after = np.concatenate([flat[breaks], flat[-1:]]) + 1
    ends = np.column_stack([first, after]).ravel()
    lengths = np.diff(ends, prepend=0)
    rest = mask.size - int(ends[-1])
    return [*lengths.tolist(), *([rest] if rest else [])]


# The folder of a dataset: any URL that fsspec knows. A local file, like an object, appears whole or not at all.


EXTRA = "needs optional packages: pip install 'skysim[dataset]'"
URLS = "a folder, or a URL such as s3://bucket/folder"


class Storage:
    """Files of a dataset by name. Raises InputError for a URL that cannot be opened."""

    def __init__(self, url: str) -> None:
        if "memory://" in url:
            raise InputError(url, "is lost at the end of the process", URLS)
        with refusing(ImportError, url, f"a dataset {EXTRA}"):
            from fsspec.core import url_to_fs
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


IMAGE_NAME = {False: "image.npy", True: "image.npz"}  # of a frame in a tar; True: compressed
COCO_SNR = 3.0  # sources below have no annotation; they are in the other labels
CATEGORIES = ("source", *MASKS)


def key_of(frame: int) -> str:
    """The key of a frame's files in a shard."""
    return f"{frame:09d}"


def shard_name(folder: str, shard: int, suffix: str) -> str:
    """Name of a shard's file in the dataset."""
    return f"{folder}/{shard:06d}.{suffix}"


def add_file(file: IO[bytes], name: str, *parts: bytes | memoryview) -> int:
    """Append a file to a tar, without time and owner, so that the same frames give the same bytes.

    Returns where it ends.
    """
    header = tarfile.TarInfo(name)
    header.size = sum(map(len, parts))
    file.writelines([header.tobuf(tarfile.USTAR_FORMAT), *parts])
    end = file.tell()
    file.write(bytes(-header.size % tarfile.BLOCKSIZE))
    return end


def add_frame(
    file: IO[bytes], number: int, one: LabelledFrame, labels: Record, compress: bool
) -> int:
    """Append a frame with its labels; return the position of its first pixel, -1 if it is compressed (an .npz)."""
    key = key_of(number)
    image = np.ascontiguousarray(one.frame.image_dn)
    pixels = image.data.cast("B")
    data = io.BytesIO()
    if compress:
        np.savez_compressed(data, image=image)
        pixels = pixels[:0]
    else:
        # As `np.save`, which would copy the pixels twice.
        npy.write_array_header_1_0(data, npy.header_data_from_array_1_0(image))
    end = add_file(file, f"{key}.{IMAGE_NAME[compress]}", data.getvalue(), pixels)
    sources = io.BytesIO()
    np.save(sources, one.sources)
    add_file(file, f"{key}.sources.npy", sources.getvalue())
    masks = {
        name: {"size": list(image.shape), "counts": counts}
        for name, counts in one.masks.items()
    }
    more = {
        "masks": masks,
        "unmatched_px": one.unmatched_px.tolist(),
        "hidden": one.truth.hidden.tolist(),
    }
    add_file(file, f"{key}.frame.json", json.dumps(labels | more).encode())
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
    attitudes = {name: getattr(truth, name) for name in ATTITUDES}
    vectors = {
        tuple(f"{name}_q{end}" for end in "xyzw"): attitude.as_quat()
        for name, attitude in attitudes.items()
    }
    vectors[tuple(f"rate_cam_{end}_rad_s" for end in "xyz")] = truth.rate_cam_rad_s
    if isinstance(scene.light, StarsConfig):
        angles_rad = ra_dec_roll_rad(attitudes["mean_cam_from_lab"])
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

    Ids are unique in the dataset.
    """
    seen = one.sources["snr"] >= COCO_SNR
    rows = one.sources[seen]
    first = number * 100_000 + 1
    boxes, corners = outlines(taken(one.extents, seen))
    areas = boxes[:, 2] * boxes[:, 3]
    columns = (boxes, areas, corners, rows["id"], rows["electrons"], rows["detected"])
    found: list[Record] = [
        {
            "id": first + n,
            "image_id": number,
            "category_id": 1,
            "bbox": box,
            "area": area,
            "segmentation": [corner],
            "iscrowd": 0,
            "source": source,
            "electrons": electrons,
            "detected": detected,
        }
        for n, (box, area, corner, source, electrons, detected) in enumerate(
            zip(*(column.tolist() for column in columns), strict=True)
        )
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
            found.append(mask)
    # A quarter of the time of `json.dumps`
    return to_json(found)[1:-1]


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
    with refusing(ImportError, "", f"a dataset {EXTRA}"):
        import pyarrow
        import pyarrow.parquet
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(
        pyarrow.table(columns), sink, compression="zstd", use_dictionary=False
    )
    return bytes(sink.getvalue())


def sources_table(frames: list[int], sources: list[Array]) -> bytes:
    """The sources of a shard: a row for each source of each frame."""
    rows = np.concatenate(sources)
    number = np.repeat(frames, [len(one) for one in sources])
    return parquet(
        {
            "frame": number,
            **{name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names or ()},
        }
    )
