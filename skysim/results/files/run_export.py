"""Export a finished run to the formats of other tools: CCSDS AEM, ECSV, Parquet, TIFF, Zarr, video."""

import datetime
import itertools
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core import files, images
from skysim.core.encoded import silent_stderr
from skysim.core.errors import InputError, check_name, refusing
from skysim.core.time import in_utc
from skysim.core.types import ATTITUDES, Array, Record, median
from skysim.dynamics.profile_samples import BODY, CAMERA, ICRF, LAB, continuous
from skysim.results import plots
from skysim.results.files.recording import ZARR, FrameTruth, Recording
from skysim.results.files.row_parts import EXTRA

# Write attitudes as a CCSDS Attitude Ephemeris Message, version 2.0, in keyword = value notation
# (CCSDS 504.0-B-2).


MOST_CHARACTERS = 254  # limit of a line, section 6.3 of the standard
ORIGINATOR = "SKYSIM"  # not in the SANA registry; the standard leaves that to those who exchange the files
MEANING = {
    ICRF: "axes of the ICRS",
    LAB: "the laboratory: origin in the bearing's center, z up; known to this file's users only",
    CAMERA: "the camera: +x right and +y down in the image, +z along the boresight",
    BODY: "the vehicle's body as its MJCF has it",
}


def message(
    name: str,
    notes: Sequence[str],
    frames: tuple[str, str],
    utc: Sequence[datetime.datetime],
    a_from_b: Rotation,
) -> str:
    """The text of an AEM file with one segment of type QUATERNION.

    The standard's quaternion "from A to B" rotates the basis vectors of A into those of B (annex F2). That is the
    quaternion of a_from_b, whose matrix has the axes of B in coordinates of A as columns; coordinates transform by
    X_B = a_from_b^-1 X_A. Scalar last. Raises InputError if there is no epoch, or the epochs do not ascend.

    Parameters
    ----------
    name
        Object name
    notes
        Comments
    frames
        (A, B), keys of MEANING
    utc
        K epochs, ascending
    a_from_b
        K rotations
    """
    if not utc:
        raise InputError(name, "no attitude to write")
    for before, after in itertools.pairwise(utc):
        if after <= before:
            raise InputError(name, f"epoch {epoch(after)} is not after {epoch(before)}")
    comments = [*notes, *(f"{frame} = {MEANING[frame]}" for frame in frames)]
    # A continuous sequence, which other tools can interpolate; the first has a scalar part >= 0.
    xyzw = a_from_b.as_quat()
    first = -1.0 if xyzw[0, 3] < 0 else 1.0
    rows = zip(utc, first * continuous(xyzw) + 0.0, strict=True)  # + 0.0 turns -0.0 into 0.0
    lines = [
        "CCSDS_AEM_VERS = 2.0",
        f"CREATION_DATE = {epoch(datetime.datetime.now(datetime.UTC))}",
        f"ORIGINATOR = {ORIGINATOR}",
        "META_START",
        *(f"COMMENT {text}" for text in comments),
        f"OBJECT_NAME = {name.upper()}",
        "OBJECT_ID = UNKNOWN",
        f"REF_FRAME_A = {frames[0]}",
        f"REF_FRAME_B = {frames[1]}",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {epoch(utc[0])}",
        f"STOP_TIME = {epoch(utc[-1])}",
        "ATTITUDE_TYPE = QUATERNION",
        "META_STOP",
        "DATA_START",
        *(
            f"{epoch(when)} " + " ".join(f"{component:.15f}" for component in xyzw)
            for when, xyzw in rows
        ),
        "DATA_STOP",
    ]
    printable = (re.sub("[^ -~]", "?", line) for line in lines)  # no other ASCII is allowed
    return "".join(f"{line[:MOST_CHARACTERS]}\n" for line in printable)


def epoch(utc: datetime.datetime) -> str:
    """Time string of section 6.8.9 of the standard, in UTC: 2012-06-22T21:00:00.120000."""
    return in_utc(utc).isoformat(timespec="microseconds")


BATCH_ROWS = 1 << 16  # rows buffered before a Parquet row group is written
SAMPLED_FRAMES = 9  # about this many frames determine the black and white levels of a video
FOURCC = "mp4v"  # MPEG-4 part 2, which every wheel of OpenCV can write
PROBE_BYTES = 1 << 20

Paths = list[Path]
# Progress bar over items: items, count, label.
Bar = Callable[[Iterable[Any], int, str], Iterator[Any]]

# Unit by the ending of a column's name; the first ending that matches applies.
UNITS = {
    "_deg_s": "deg/s",
    "_deg_h": "deg/h",
    "_deg": "deg",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_arcsec": "arcsec",
    "_px": "px",
    "_ms": "ms",
    "_m_s": "m/s",
    "_s": "s",
    "_rpm": "rpm",
    "_nms": "N m s",
    "_nm": "N m",
    "_e": "electron",
    "electrons": "electron",
}


def to_aem(run: Recording, out: Path, bar: Bar) -> Paths:
    """Write truth.aem, solutions.aem if frames were solved, and motion.aem of a simulated motion. Returns the paths.

    Attitudes are means over the exposure, with the time of mid-exposure: those of the camera in the ICRF under the
    stars, and of the body in the laboratory under a dome. The motion is that of the body at every tick of the vehicle's
    computer. Raises InputError if a solution has no truth.
    """
    stars = run.is_celestial
    frames = (ICRF, CAMERA) if stars else (LAB, BODY)
    true = list(truths(run, bar))
    epochs = {truth.frame: truth.mid_utc for truth in true}
    # Mean lab_from_cam or lab_from_body, the same convention as `Recording.solved`.
    a_from_b = Rotation.concatenate(
        [
            Rotation.from_quat(truth.mean_cam_from_lab_xyzw).inv()
            if stars
            else Rotation.from_quat(truth.mean_lab_from_body_xyzw)
            for truth in true
        ]
    )
    content = "True mean attitude in the exposure"
    found = [("truth", content, frames, list(epochs.values()), a_from_b)]
    solved = run.solved()
    if solved is not None:
        unknown = [frame for frame in solved[0].tolist() if frame not in epochs]
        if unknown:
            raise InputError(
                run.folder / "solutions.ecsv",
                f"unknown frame {unknown[0]}",
                "frames with truth",
            )
        utc = [epochs[frame] for frame in solved[0].tolist()]
        content = "Attitude found by the star tracker"
        found.append(("solutions", content, frames, utc, solved[1]))
    motion = run.motion()
    if motion is not None:
        start = true[0].mid_utc - datetime.timedelta(seconds=true[0].t_mid_s)
        utc = [start + datetime.timedelta(seconds=t_s) for t_s in motion[0].tolist()]
        content = "True motion of the vehicle, without jitter,"
        found.append(("motion", content, (frames[0], BODY), utc, motion[1]))
    name = str(run.meta["scene"])
    written = []
    for stem, content, between, utc, rotations in found:
        notes = [f"{content} of skysim, scene {name}, seed {run.meta['seed']}"]
        written.append(out / f"{stem}.aem")
        files.write_text(written[-1], message(name, notes, between, utc, rotations))
    return written


def truths(run: Recording, bar: Bar) -> Iterator[FrameTruth]:
    return bar(run.truths(), len(run.stems), "reading truths")


# Names of the columns of a quantity with several components.
COMPONENTS = {
    **{f"{name}_xyzw": [f"{name}_q{end}" for end in "xyzw"] for name in ATTITUDES},
    "rate_cam_rad_s": [f"rate_cam_{end}_rad_s" for end in "xyz"],
}


def frame_columns(run: Recording, bar: Bar) -> dict[str, Array]:
    """The truth of all frames by the fields of FrameTruth, (F,) or (F, K) each; times as text."""
    true = [truth._replace(sources=None) for truth in truths(run, bar)]
    utc = [truth.mid_utc.isoformat(timespec="microseconds") for truth in true]
    columns = {
        name: np.array([getattr(truth, name) for truth in true])
        for name in FrameTruth._fields[:-1]
    }
    return columns | {"mid_utc": np.array(utc)}


def truth_table(run: Recording, bar: Bar) -> Any:
    """The truth as an astropy table, one row per frame."""
    from astropy.table import Table

    columns: Record = {}
    for name, values in frame_columns(run, bar).items():
        columns |= zip(COMPONENTS.get(name, [name]), np.atleast_2d(values.T), strict=True)
    return Table(columns, meta=run.meta)


def to_ecsv(run: Recording, out: Path, bar: Bar) -> Paths:
    """Write truth.ecsv, one row per frame; the run has already written solutions.ecsv."""
    files.write_table(out / "truth.ecsv", truth_table(run, bar))
    return [out / "truth.ecsv"]


def to_parquet(run: Recording, out: Path, bar: Bar) -> Paths:
    """Write truth (one row per frame), sources (one row per source and frame) and the run's own tables as Parquet.

    Units are in the field metadata. Raises InputError if pyarrow is not installed.
    """
    with refusing(ImportError, "export.formats", f"parquet {EXTRA}"):
        import pyarrow.parquet
    tables = {"truth": truth_table(run, bar)}
    tables |= {
        name: table
        for name in ("solutions", "telemetry", "imu")
        if (table := run.table(name)) is not None
    }
    written = []
    for name, table in tables.items():
        path = out / f"{name}.parquet"
        with files.atomic_file(path) as temporary:
            pyarrow.parquet.write_table(to_arrow(table, run), temporary)
        written.append(path)
    return [*written, sources_parquet(run, out / "sources.parquet", bar)]


def sources_parquet(run: Recording, path: Path, bar: Bar) -> Path:
    """Write every source of every frame from the truth files, in batches of about BATCH_ROWS rows to limit memory."""
    import pyarrow
    import pyarrow.parquet

    def frame_table(truth: FrameTruth) -> Any:
        truth.sources.add_column(
            np.full(len(truth.sources), truth.frame), name="frame", index=0
        )
        return to_arrow(truth.sources, run)

    tables = map(frame_table, truths(run, bar))
    batch = [next(tables)]
    with (
        files.atomic_file(path) as temporary,
        pyarrow.parquet.ParquetWriter(temporary, batch[0].schema) as writer,
    ):
        for table in tables:
            if sum(len(part) for part in batch) >= BATCH_ROWS:
                writer.write_table(pyarrow.concat_tables(batch))
                batch = []
            batch.append(table)
        writer.write_table(pyarrow.concat_tables(batch))
    return path


def to_arrow(table: Any, run: Recording) -> Any:
    """Convert an astropy table to an Arrow table; masked values become null. Units and run metadata are kept."""
    import pyarrow

    fields = []
    columns = []
    for name in table.colnames:
        values = pyarrow.array(
            table[name].tolist(),
            type=pyarrow.from_numpy_dtype(table[name].dtype)
            if table[name].dtype.kind in "biuf"
            else pyarrow.string(),
        )
        unit = unit_of(name)
        fields.append(
            pyarrow.field(name, values.type, metadata={"unit": unit} if unit else None)
        )
        columns.append(values)
    metadata = {f"skysim.{key}": str(value) for key, value in run.meta.items()}
    return pyarrow.table(columns, schema=pyarrow.schema(fields, metadata=metadata))


def unit_of(name: str) -> str:
    """Unit of a column from the ending of its name; empty if it has none."""
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def to_tiff(run: Recording, out: Path, bar: Bar) -> Paths:
    """Write frame_NNNN.tif with unchanged digital numbers: 16 bits (64-bit floats for a noise-free camera)."""
    written = []
    for stem in bar(run.stems, len(run.stems), "TIFF"):
        written.append(out / f"{stem.name}.tif")
        files.write_image(written[-1], run.image(stem))
    return written


def to_zarr(run: Recording, out: Path, bar: Bar) -> Paths:
    """Write frames.zarr (Zarr 3): frames in chunks of one, with times, exposures, attitudes and rates.

    Raises
    ------
    InputError
        If zarr is not installed or the frames differ in size or type.
    """
    with refusing(ImportError, "export.formats", f"zarr {EXTRA}"):
        import zarr
    path = out / ZARR
    count = len(run.stems)
    columns = frame_columns(run, bar)
    first = run.image(run.stems[0])
    with files.atomic_folder(path) as temporary:
        group = zarr.create_group(
            temporary, zarr_format=3, attributes=run.meta | {"made_by": "skysim"}
        )
        frames = group.create_array(
            "frames",
            shape=(count, *first.shape),
            chunks=(1, *first.shape),
            dtype=first.dtype,
            dimension_names=("frame", "y", "x"),
            attributes={"units": "DN"},
        )
        for n, stem in enumerate(bar(run.stems, count, "Zarr")):
            frames[n] = check_same_format(run.image(stem), first, stem)
        for name, values in columns.items():
            unit = unit_of(name)
            if name == "mid_utc":
                values = values.astype("datetime64[us]").astype(np.int64)
                unit = "microseconds since 1970-01-01"
            group.create_array(
                name,
                data=values,
                dimension_names=("frame", "xyzw"[: values.shape[-1]])[: values.ndim],
                attributes={"units": unit} if unit else {},
            )
    return [path]


def check_same_format(image: Any, first: Any, stem: Path) -> Any:
    """The image itself. Raises InputError if its size or type differs from the first one's."""
    if image.shape != first.shape or image.dtype != first.dtype:
        raise InputError(
            f"{stem}.fits",
            f"{image.shape[1]}x{image.shape[0]} {image.dtype}; the first frame is"
            f" {first.shape[1]}x{first.shape[0]} {first.dtype}",
        )
    return image


def to_video(run: Recording, out: Path, bar: Bar) -> Paths:
    """Write frames.mp4 for display: 8 bits, square-root stretch, at the scene's frame rate.

    All frames share the same black and white levels. A side with an odd number of pixels is cropped by one pixel.
    Raises InputError if OpenCV cannot write the video, and OSError if the disk is full.
    """
    path = out / "frames.mp4"
    first = run.image(run.stems[0])
    seconds = [truth.t_mid_s for truth in truths(run, bar)]
    rate_hz = 1 / median(np.diff(seconds)) if len(seconds) > 1 else 1.0
    sampled = run.stems[:: max(len(run.stems) // SAMPLED_FRAMES, 1)]
    low, high = np.median([plots.display_levels(run.image(stem)) for stem in sampled], axis=0)
    height, width = (
        side // 2 * 2 for side in first.shape
    )  # color subsampling needs even sides
    with files.atomic_file(path) as temporary:
        film = cv2.VideoWriter(
            str(temporary), cv2.VideoWriter.fourcc(*FOURCC), rate_hz, (width, height), False
        )
        try:
            if not film.isOpened():
                check_disk_space(temporary)
                raise InputError(
                    path,
                    f"this OpenCV cannot write {FOURCC} video of {width}x{height} at {rate_hz:g} Hz",
                )
            for stem in bar(run.stems, len(run.stems), "video"):
                image = check_same_format(run.image(stem), first, stem)
                gray = plots.to_8bit(
                    image, "square root", levels_dn=(float(low), float(high))
                )
                with silent_stderr():
                    film.write(np.ascontiguousarray(gray[:height, :width]))
        finally:
            film.release()
        readable = count_frames(temporary)
        count = len(run.stems)
        # OpenCV reports no write errors, so count the frames that can be read back.
        if readable != count:
            check_disk_space(temporary)
            raise InputError(
                path, f"OpenCV wrote {readable} of {count} frames, without an error message"
            )
    return [path]


def count_frames(film: Path) -> int:
    """Number of readable frames in a video file."""
    with closing(images.LiveCamera(str(film))) as reader, silent_stderr():
        return sum(1 for _ in iter(reader.capture.grab, False))


def check_disk_space(path: Path) -> None:
    """Append PROBE_BYTES to a file, more than a video index needs, to raise the OSError that OpenCV did not report.

    A full disk then raises "no space left on device" rather than an unexplained failure of OpenCV.
    """
    with path.open("ab") as file:
        file.write(bytes(PROBE_BYTES))
        os.fsync(file.fileno())


EXPORTS: dict[str, Callable[[Recording, Path, Bar], Paths]] = {
    "aem": to_aem,
    "ecsv": to_ecsv,
    "parquet": to_parquet,
    "tiff": to_tiff,
    "zarr": to_zarr,
    "video": to_video,
}


def export(run: Recording, formats: Iterable[str], out: Path, bar: Bar) -> Paths:
    """Write a run in each of the formats and return the paths.

    Raises
    ------
    InputError
        For an unknown format before anything is written.
    """
    names = list(dict.fromkeys(formats))
    for name in names:
        check_name("export.formats", "format", name, EXPORTS)
    files.make_folder(out)
    return [path for name in names for path in EXPORTS[name](run, out, bar)]
