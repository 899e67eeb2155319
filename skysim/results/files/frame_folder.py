"""Write frames and their truth to a results folder, and clear an earlier run from it. Writes are atomic."""

from __future__ import annotations

import dataclasses
import datetime
import shutil
from pathlib import Path
from skysim.camera import wcs
from skysim.core.files import (atomic_file, write_png16, write_table)
from skysim.core.types import Frame, Truth
from skysim.scene.scene import Scene
from skysim.scene.sections.light import StarsConfig



RESULT_FILES = (
    "solutions.ecsv",
    "telemetry.ecsv",
    "imu.ecsv",
    "annotated.png",
    "scene_3d.png",
    "scene_3d.gif",
    "report.html",
    "scoreboard.ecsv",
)

EXPORT_FILES = (
    "truth.aem",
    "solutions.aem",
    "truth.ecsv",
    *(f"{name}.parquet" for name in ("truth", "sources", "solutions", "telemetry", "imu")),
    "frames.mp4",
)

ZARR = "frames.zarr"


def remove_results(folder: Path) -> None:
    """Remove the files of an earlier run: its frames, solutions, reports, and the files of `skysim export`."""
    frames = [f"frame_[0-9][0-9][0-9][0-9]*.{suffix}" for suffix in ("fits", "png", "ecsv", "tif")]
    for pattern in (*frames, "solutions.*.ecsv"):
        for path in folder.glob(pattern):
            path.unlink()
    for name in RESULT_FILES + EXPORT_FILES:
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / ZARR, ignore_errors=True)


def write_frame(folder: Path, frame: Frame, truth: Truth, scene: Scene) -> None:
    """Write frame_NNNN.fits (16 bits, with a WCS header under the stars), .png (16 bits) and the truth as .ecsv."""
    stem = folder / f"frame_{frame.index:04d}"
    write_truth(stem.with_suffix(".ecsv"), frame, truth, scene)
    write_png16(stem.with_suffix(".png"), frame.image_dn)
    write_fits(stem.with_suffix(".fits"), frame, truth, scene)  # last: marks a complete frame


def write_fits(path: Path, frame: Frame, truth: Truth, scene: Scene) -> None:
    """Write a FITS file: uint16 (float64 for a noise-free frame) with exposure, time, scene and seed in the header."""
    from astropy.io import fits

    header = fits.Header()
    header["EXPTIME"] = (frame.exposure_s, "exposure [s]")
    header["DATE-OBS"] = (utc_text(scene, frame.t_mid_s), "mid-exposure [UTC]")
    header["TMID"] = (frame.t_mid_s, "mid-exposure since the scene's start [s]")
    header["SCENE"] = (scene.name, "scene")
    header["SEED"] = (scene.seed, "seed of every random stream")
    header["FRAME"] = (frame.index, "index of the frame")
    header["ROWORDER"] = ("TOP-DOWN", "the first row is the highest")
    header["SATURATE"] = (frame.saturation_dn, "saturation [DN]")
    if isinstance(scene.light, StarsConfig):
        header.update(wcs.header(scene.camera, truth.cam_from_lab))
        header["COMMENT"] = (
            "WCS: of the true attitude at mid-exposure; apparent directions in ICRS axes"
        )
    else:
        header["COMMENT"] = "no WCS: the lights are in the laboratory"
    with atomic_file(path) as temporary:
        fits.PrimaryHDU(frame.image_dn, header).writeto(temporary, overwrite=True)


def utc_text(scene: Scene, t_s: float) -> str:
    """A time since the scene's start as UTC, to a microsecond."""
    return (scene.start_time + datetime.timedelta(seconds=t_s)).isoformat(timespec="microseconds")


def write_truth(path: Path, frame: Frame, truth: Truth, scene: Scene) -> None:
    """Write the truth of a frame as ECSV: attitude and rates in the header, one row per source."""
    from astropy.table import Table

    sources = truth.sources
    table = Table(
        {
            "id": sources.id,
            "x_px": sources.xy_px[:, 0],
            "y_px": sources.xy_px[:, 1],
            "flux_x_px": sources.flux_xy_px[:, 0],
            "flux_y_px": sources.flux_xy_px[:, 1],
        }
    )
    for name in ("electrons", "peak_e", "streak_px", "area_px", "snr", "saturated"):
        table[name] = getattr(sources, name)
    for name in table.colnames[1:-1]:
        table[name].info.format = ".9g"
    table.meta = {
        "scene": scene.name,
        "seed": scene.seed,
        "frame": frame.index,
        "t_mid_s": truth.t_s,
        "mid_utc": utc_text(
            scene, truth.t_s
        ),  # the true time; that of the FITS header is the camera's time tag
        "exposure_s": frame.exposure_s,
        "lab_from_body_xyzw": truth.lab_from_body.as_quat().tolist(),
        "cam_from_lab_xyzw": truth.cam_from_lab.as_quat().tolist(),
        "rate_cam_rad_s": truth.rate_cam_rad_s.tolist(),
        "hidden": truth.hidden.tolist(),
        "lab": "ICRS axes" if isinstance(scene.light, StarsConfig) else "bearing center, z up",
    }
    if truth.bodies:
        table.meta["bodies"] = [dataclasses.asdict(body) for body in truth.bodies]
    if truth.satellites:
        table.meta["satellites"] = [dataclasses.asdict(satellite) for satellite in truth.satellites]
    write_table(path, table)


