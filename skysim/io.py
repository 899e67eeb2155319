"""Files in and out: frames, truth, solutions. Nothing is ever half-written."""

from __future__ import annotations

import datetime
import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim import wcs
from skysim.fitsfile import FITS_SUFFIXES, read_fits
from skysim.fitsfile import date_of as date_of
from skysim.leftovers import being_written, sweep
from skysim.picturefile import check_bytes, read_picture
from skysim.scene import Scene, Stars
from skysim.types import BadInput, Floats, Frame, Truth

IMAGE_SUFFIXES = (*FITS_SUFFIXES, ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")


@dataclass(frozen=True, slots=True)
class DomeMap:
    """A dome and its camera as a survey found them, in the lab frame; what `tracker.map` reads.

    id, position_m : (N,) and (N, 3) of the LEDs surveyed, m;  sigma_m : (N,) of a place, rms of the three axes
    camera_body_m  : (3,) the entrance pupil in the body frame;  lever_sigma_m : of it, rms of the three axes
    size_px        : width and height of the chip
    focal_px, centre_px, distortion (k1, k2, p1, p2, k3), and the standard deviation of each number; 0 where it was held
    """

    id: NDArray[np.int64]
    position_m: Floats
    sigma_m: Floats
    camera_body_m: Floats
    lever_sigma_m: float
    size_px: tuple[int, int]
    focal_px: float
    focal_sigma_px: float
    centre_px: tuple[float, float]
    centre_sigma_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    distortion_sigma: tuple[float, float, float, float, float]


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Whatever cannot be written is told of `path`, in the system's own words for why.

    Some libraries tell neither which file nor, of a full disk, what is wrong in a line.
    """
    try:
        yield
    except OSError as error:
        full = error.errno in (None, errno.ENOSPC, errno.EDQUOT) and "space" in str(error).lower()
        number = errno.ENOSPC if full else error.errno
        if number is None:
            raise
        raise OSError(number, os.strerror(number), str(path)) from error


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` that becomes it once everything is written, or vanishes."""
    with being_written(path) as temporary, naming(path):
        yield temporary
        os.replace(temporary, path)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """`whole` of a folder: a temporary one beside `path` that takes its place, whatever was there."""
    aside = path.with_name(f"{path.stem}.old{path.suffix}")
    with being_written(path) as temporary, being_written(aside) as old, naming(path):
        yield temporary
        # Put aside at once and removed at leisure: an interrupt finds the one or the other.
        if path.exists():
            path.rename(old)
        temporary.rename(path)


def make_folder(path: Path) -> Path:
    """The folder, made if it is not there, without what a killed process of ours left half-written.

    Raises BadInput where that cannot be.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{path}: cannot be made a folder: {error.strerror}") from error
    sweep(path)
    return path


RESULTS = (
    *("solutions.ecsv", "telemetry.ecsv", "imu.ecsv"),
    *("annotated.png", "lab.png", "lab.gif", "report.html", "scoreboard.ecsv"),
)


EXPORTED = (
    *("truth.aem", "solutions.aem", "truth.ecsv"),
    *(f"{name}.parquet" for name in ("truth", "sources", "solutions", "telemetry", "imu")),
    "frames.mp4",
)
ZARR = "frames.zarr"


def clear(folder: Path) -> None:
    """Remove what an earlier run left: its frames, what was said of them and what `skysim export` made of it."""
    for suffix in ("fits", "png", "ecsv", "tif"):
        for path in folder.glob(f"frame_[0-9][0-9][0-9][0-9]*.{suffix}"):
            path.unlink()
    for path in folder.glob("solutions.*.ecsv"):
        path.unlink()
    for name in RESULTS + EXPORTED:
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / ZARR, ignore_errors=True)


def unlike(paths: list[Path]) -> list[Path]:
    """The paths, numbered where one would overwrite another."""
    seen: dict[Path, int] = {}
    named = []
    for path in paths:
        seen[path] = seen.get(path, 0) + 1
        again = seen[path] > 1
        named.append(path.with_name(f"{path.stem}-{seen[path]}{path.suffix}") if again else path)
    return named


def write_frame(folder: Path, frame: Frame, truth: Truth, scene: Scene) -> None:
    """frame_NNNN.fits (16 bits, header with WCS under the stars), .png (16 bits) and the truth as .ecsv."""
    stem = folder / f"frame_{frame.index:04d}"
    write_truth(stem.with_suffix(".ecsv"), frame, truth, scene)
    write_png16(stem.with_suffix(".png"), frame.image_dn)
    write_fits(stem.with_suffix(".fits"), frame, truth, scene)  # last: where it is, the others are


def write_fits(path: Path, frame: Frame, truth: Truth, scene: Scene) -> None:
    """FITS: uint16 (or float64 of a noise-free frame) with exposure, time, scene, seed."""
    from astropy.io import fits

    header = fits.Header()
    header["EXPTIME"] = (frame.exposure_s, "exposure [s]")
    header["DATE-OBS"] = (mid_time(scene, frame).isoformat(timespec="microseconds"), "mid-exposure [UTC]")
    header["TMID"] = (frame.t_mid_s, "mid-exposure since the scene's start [s]")
    header["SCENE"] = (scene.name, "scene")
    header["SEED"] = (scene.seed, "seed of every random stream")
    header["FRAME"] = (frame.index, "index of the frame")
    header["SATURATE"] = (frame.saturation_dn, "saturation [DN]")
    if isinstance(scene.light, Stars):
        header.update(wcs.header(scene.camera, truth.cam_from_lab))
        header["COMMENT"] = "WCS: of the true attitude at mid-exposure; apparent directions in ICRS axes"
    else:
        header["COMMENT"] = "no WCS: the lights are in the laboratory"
    with whole(path) as temporary:
        fits.PrimaryHDU(frame.image_dn, header).writeto(temporary, overwrite=True)


def mid_time(scene: Scene, frame: Frame) -> datetime.datetime:
    return scene.start_time + datetime.timedelta(seconds=frame.t_mid_s)


def write_png16(path: Path, image_dn: NDArray) -> None:
    """16-bit PNG of the digital numbers themselves; a noise-free frame is rounded."""
    numbers = np.clip(np.rint(image_dn), 0, 65535).astype(np.uint16)
    write_image(path, numbers)


PLAIN = (cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE)  # some readers know no other


def write_image(path: Path, image: NDArray) -> None:
    """An image by the name's ending. Raises BadInput if it cannot be encoded, OSError if it cannot be written.

    OpenCV encodes in memory: of a file that it cannot write it would not tell why.
    """
    try:
        done, coded = cv2.imencode(path.suffix, image, PLAIN if path.suffix == ".tif" else ())
    except cv2.error:
        done = False
    if not done:
        raise BadInput(f"{path}: an image of {image.dtype} and shape {image.shape} cannot be encoded so")
    with whole(path) as temporary:
        temporary.write_bytes(coded.data)


def write_truth(path: Path, frame: Frame, truth: Truth, scene: Scene) -> None:
    """The truth beside the frame: attitude and rates in the header, one row a source."""
    from astropy.table import Table

    seen = truth.seen
    table = Table(
        {
            "id": seen.id,
            "x_px": seen.xy_px[:, 0],
            "y_px": seen.xy_px[:, 1],
            "flux_x_px": seen.flux_xy_px[:, 0],
            "flux_y_px": seen.flux_xy_px[:, 1],
            "electrons": seen.electrons,
            "peak_e": seen.peak_e,
            "streak_px": seen.streak_px,
            "area_px": seen.area_px,
            "snr": seen.snr,
            "saturated": seen.saturated,
        }
    )
    for name in table.colnames[1:-1]:
        table[name].info.format = ".9g"
    table.meta = {
        "scene": scene.name,
        "seed": scene.seed,
        "frame": frame.index,
        "t_mid_s": frame.t_mid_s,
        "mid_utc": mid_time(scene, frame).isoformat(timespec="microseconds"),
        "exposure_s": frame.exposure_s,
        "lab_from_body_xyzw": truth.lab_from_body.as_quat().tolist(),
        "cam_from_lab_xyzw": truth.cam_from_lab.as_quat().tolist(),
        "rate_cam_rad_s": truth.rate_cam_rad_s.tolist(),
        "hidden": truth.hidden.tolist(),
        "lab": "ICRS axes" if isinstance(scene.light, Stars) else "bearing centre, z up",
    }
    write_table(path, table)


def write_table(path: Path, table: Any) -> None:
    """An astropy table as ECSV."""
    with whole(path) as temporary:
        table.write(temporary, format="ascii.ecsv", overwrite=True)


MAP_COLUMNS = ("id", "x_m", "y_m", "z_m", "sigma_m")
# Numbers in the header of a dome's map, and how many.
MAP_META = {
    **{"size_px": 2, "focal_px": 1, "focal_sigma_px": 1, "centre_px": 2, "centre_sigma_px": 2},
    **{"distortion": 5, "distortion_sigma": 5, "camera_body_m": 3, "lever_sigma_m": 1},
}


def write_dome_map(path: Path, dome: DomeMap) -> None:
    """A surveyed dome as ECSV: one row an LED, the camera in the header."""
    from astropy.table import Table

    table = Table(dict(zip(MAP_COLUMNS, (dome.id, *dome.position_m.T, dome.sigma_m), strict=True)))
    table.meta = {key: np.array(getattr(dome, key)).tolist() for key in MAP_META}
    write_table(path, table)


def read_dome_map(path: Path) -> DomeMap:
    """What `write_dome_map` wrote. Raises BadInput with one line for a file that is none."""
    import warnings

    from astropy.table import Table

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = Table.read(path, format="ascii.ecsv")
    except Exception as error:  # of a file that is no ECSV astropy says whatever its parsers stumble over
        raise BadInput(f"{path}: no ECSV table: {' '.join(str(error).split())[:120]}") from None
    missing = [name for name in MAP_COLUMNS if name not in table.colnames]
    if missing or not len(table):
        what = f"no column {missing[0]}" if missing else "no LED"
        raise BadInput(f"{path}: {what}; allowed: a map that skysim survey wrote")
    try:
        numbers = np.column_stack([np.ma.filled(table[name].astype(float), np.nan) for name in MAP_COLUMNS])
    except (TypeError, ValueError):
        raise BadInput(f"{path}: allowed: numbers in the columns {', '.join(MAP_COLUMNS)}") from None
    wrong = np.flatnonzero(~np.isfinite(numbers).all(axis=1) | (numbers[:, 4] <= 0))
    if len(wrong):
        raise BadInput(f"{path}: row {wrong[0] + 1}: allowed: finite numbers, and a sigma_m above 0")
    id_, count = np.unique(numbers[:, 0].astype(np.int64), return_counts=True)
    if count.max() > 1:
        raise BadInput(f"{path}: LED {id_[count > 1][0]} stands {count.max()} times; allowed: once")
    meta = {key: header_numbers(path, table.meta, key, count) for key, count in MAP_META.items()}
    told: dict[str, Any] = {key: value[0] if len(value) == 1 else tuple(value) for key, value in meta.items()}
    told["size_px"] = tuple(round(side) for side in meta["size_px"])
    told["camera_body_m"] = np.array(meta["camera_body_m"])
    return DomeMap(
        id=numbers[:, 0].astype(np.int64), position_m=numbers[:, 1:4], sigma_m=numbers[:, 4], **told
    )


def header_numbers(path: Path, meta: dict[str, Any], key: str, count: int) -> list[float]:
    """So many finite numbers under a key of an ECSV's header; what a size or focal length is, is above 0."""
    try:
        numbers = np.atleast_1d(np.array(meta.get(key), dtype=float))
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    positive = key in ("size_px", "focal_px")
    if numbers.shape != (count,) or not np.isfinite(numbers).all() or (positive and numbers.min() <= 0):
        what = f"{count} finite number{'s' if count > 1 else ''}{' above 0' if positive else ''}"
        raise BadInput(f"{path}: {key} in the header is {meta.get(key)!r}; allowed: {what}")
    return [float(number) for number in numbers]


def write_text(path: Path, text: str) -> None:
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_bytes(path: Path, data: bytes) -> None:
    with whole(path) as temporary:
        temporary.write_bytes(data)


def to_json(data: Any) -> str:
    """JSON with null for what is not a number."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        if isinstance(value, np.generic):
            value = value.item()
        return None if isinstance(value, float) and not np.isfinite(value) else value

    return json.dumps(plain(data), indent=1, allow_nan=False)


def read_image(path: Path) -> NDArray:
    """The pixels of a FITS, PNG, TIFF, JPEG or BMP file as they are: (H, W) or (H, W, channels).

    Raises BadInput with one line for a file that is missing, truncated, no image, or of more pixels than are
    allowed.
    """
    if not path.is_file():
        raise BadInput(f"{path}: no such file")
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        raise BadInput(f"{path}: not an image by its name; allowed: {', '.join(IMAGE_SUFFIXES)}")
    check_bytes(path)
    image = read_fits(path) if path.suffix.lower() in FITS_SUFFIXES else read_picture(path)
    if image.dtype.kind not in "uif":
        raise BadInput(f"{path}: pixels of type {image.dtype}; allowed: integers and floats")
    return image


def monochrome(image: NDArray) -> NDArray:
    """Luminance of a colour picture (its alpha channel aside); a monochrome one as it is."""
    if image.ndim == 2:
        return image
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise BadInput(
            f"an image of shape {image.shape}; allowed: (height, width) and colour with 3 or 4 channels"
        )
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    return cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_BGR2GRAY)
