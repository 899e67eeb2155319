"""Read the results folder of `skysim run` or `skysim render`, frame by frame."""

import dataclasses
import datetime
import re
import shutil
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera import wcs
from skysim.core.errors import InputError
from skysim.core.files import (
    atomic_file,
    header_numbers,
    read_table,
    write_png16,
    write_table,
)
from skysim.core.images import TOP_DOWN_CARD, read_image
from skysim.core.types import ATTITUDES, Array, Floats, Frame, Record, Truth
from skysim.dynamics.profile_samples import BODY_ANGLES, CAMERA_ANGLES
from skysim.scene.scene import Scene
from skysim.sources import stars

STARS = "ICRS axes"  # value of `lab` in a truth header for a scene under the stars
UNIT_NORM = 1e-6
Attitudes = tuple[Array, Rotation] | None  # (K,) frames or times, and their attitudes


class FrameTruth(NamedTuple):
    """The truth of one frame, as read from its file: attitudes (4,) as xyzw, rate (3,), and the table of sources."""

    frame: int
    mid_utc: datetime.datetime
    t_mid_s: float
    exposure_s: float
    lab_from_body_xyzw: Floats
    cam_from_lab_xyzw: Floats
    mean_lab_from_body_xyzw: Floats
    mean_cam_from_lab_xyzw: Floats
    rate_cam_rad_s: Floats
    sources: Any


class Recording:
    """A finished run: its folder, and the frames' file paths without suffix, in frame order.

    Raises
    ------
    InputError
        If the folder holds no frame with its truth.
    """

    def __init__(self, folder: Path) -> None:
        stems = {}
        for path in folder.glob("frame_*.fits"):
            number = re.fullmatch(r"frame_(\d{4,})", path.stem)
            if number and path.with_suffix(".ecsv").is_file():
                stems[int(number[1])] = path.with_suffix("")
        if not stems:
            raise InputError(
                folder,
                "no frames with truth files",
                "a folder of a run, or of rendered frames",
            )
        self.folder = folder
        self.stems = [stems[index] for index in sorted(stems)]

    @cached_property
    def meta(self) -> Record:
        """Scene, seed and definition of the lab axes, from the truth of the first frame. Raises InputError."""
        header = read_table(self.stems[0].with_suffix(".ecsv")).meta
        missing = [key for key in ("scene", "seed", "lab") if key not in header]
        if missing:
            raise InputError(
                f"{self.stems[0]}.ecsv",
                f"no {missing[0]} in the header",
                "a truth file of a run",
            )
        return {key: header[key] for key in ("scene", "seed", "lab")}

    @property
    def is_celestial(self) -> bool:
        """Whether the lab axes are those of the ICRS."""
        return bool(self.meta["lab"] == STARS)

    def truths(self) -> Iterator[FrameTruth]:
        """The truth of every frame."""
        return (read_truth(stem.with_suffix(".ecsv")) for stem in self.stems)

    def image(self, stem: Path) -> Array:
        """A frame's digital numbers: (H, W) uint16, or float64 from a noise-free camera. Raises InputError."""
        image = read_image(stem.with_suffix(".fits"))
        if image.ndim != 2 or not image.size:
            raise InputError(
                f"{stem}.fits", f"an image of shape {image.shape}", "(height, width)"
            )
        return image

    def table(self, name: str) -> Any:
        """The table `solutions`, `telemetry` or `imu` as an astropy table; None if the run wrote none."""
        path = self.folder / f"{name}.ecsv"
        return read_table(path) if path.is_file() else None

    def _attitudes(
        self, name: str, key: str, angles: Sequence[str], is_celestial: bool
    ) -> Attitudes:
        """(K,) values of a column of a table, and the attitudes of these rows; None without any.

        Raises InputError if a column is missing.
        """
        table = self.table(name)
        if table is None:
            return None
        for column in (key, *angles):
            if column not in table.colnames:
                path = self.folder / f"{name}.ecsv"
                raise InputError(path, f"missing column {column}", "a table of a run")
        angles_deg = np.column_stack(
            [np.ma.filled(table[column].astype(float), np.nan) for column in angles]
        )
        valid = np.isfinite(angles_deg).all(axis=1)
        if not valid.any():
            return None
        return np.asarray(table[key])[valid], attitudes(angles_deg[valid], is_celestial)

    def solved(self) -> Attitudes:
        """(K,) indices of the solved frames and their attitudes.

        Attitudes are lab_from_cam under the stars and lab_from_body in a laboratory. Returns None if there is no
        table of solutions or no frame was solved. Raises InputError if a column is missing.
        """
        names = CAMERA_ANGLES if self.is_celestial else BODY_ANGLES
        return self._attitudes("solutions", "frame", names, self.is_celestial)

    def motion(self) -> Attitudes:
        """(K,) times in s and lab_from_body at every tick of the vehicle's computer; None without telemetry.

        Raises
        ------
        InputError
            If a column is missing.
        """
        names = [f"true_{name}" for name in BODY_ANGLES]
        return self._attitudes("telemetry", "t_s", names, is_celestial=False)


def attitudes(angles_deg: Floats, is_celestial: bool) -> Rotation:
    """Rotations from (K, 3) angles in the convention of `scoring.angles_deg`.

    Under the stars: lab_from_cam from RA, Dec, roll. Otherwise: lab_from_body from the roll, pitch, yaw of the 3-2-1
    sequence.
    """
    if is_celestial:
        return stars.cam_from_icrs(*angles_deg.T).inv()
    return Rotation.from_euler("ZYX", angles_deg[:, ::-1], degrees=True)


def read_truth(path: Path) -> FrameTruth:
    """Read the truth of a frame.

    Raises
    ------
    InputError
        (one line) for a file that is not a truth file or that an older skysim wrote.
    """
    sources = read_table(path)
    quaternions = [f"{name}_xyzw" for name in ATTITUDES]
    frame, t_mid_s, exposure_s = (
        header_numbers(path, sources.meta, key, 1)[0]
        for key in ("frame", "t_mid_s", "exposure_s")
    )
    counts = {**dict.fromkeys(quaternions, 4), "rate_cam_rad_s": 3}
    vectors = {
        key: np.array(header_numbers(path, sources.meta, key, count))
        for key, count in counts.items()
    }
    for key in quaternions:
        if abs(np.linalg.norm(vectors[key]) - 1) > UNIT_NORM:
            raise InputError(
                path, f"{key} in the header is {sources.meta[key]}", "a unit quaternion"
            )
    try:
        utc = datetime.datetime.fromisoformat(str(sources.meta.get("mid_utc")))
    except ValueError:
        raise InputError(
            path,
            f"mid_utc in the header is {sources.meta.get('mid_utc')!r}",
            "a time; run the scene again",
        ) from None
    return FrameTruth(int(frame), utc, t_mid_s, exposure_s, **vectors, sources=sources)


# Write frames and their truth to a results folder, and clear an earlier run from it. Writes are
# atomic.


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
    frames = [
        f"frame_[0-9][0-9][0-9][0-9]*.{suffix}" for suffix in ("fits", "png", "ecsv", "tif")
    ]
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
    """Write a frame as FITS, under the stars with the WCS of the true attitude."""
    cards = {}
    comment = "no WCS: the lights are in the laboratory"
    if scene.stars:
        cards = wcs.header(scene.camera.calibration(), truth.mean_cam_from_lab)
        comment = (
            "WCS: of the true mean attitude in the exposure; apparent directions in ICRS axes"
        )
    image = fits_image(frame, scene, cards, comment)
    with atomic_file(path, image.filebytes()) as temporary:
        image.writeto(temporary, overwrite=True)


def fits_image(frame: Frame, scene: Scene, wcs_cards: Any, comment: str) -> Any:
    """A FITS image: uint16 (float64 for a noise-free frame) with exposure, time, scene and seed in the header."""
    from astropy.io import fits

    header = fits.Header(
        [
            ("EXPTIME", frame.exposure_s, "exposure [s]"),
            ("DATE-OBS", utc_text(scene, frame.t_mid_s), "mid-exposure [UTC]"),
            ("TMID", frame.t_mid_s, "mid-exposure since the scene's start [s]"),
            ("SCENE", scene.name, "scene"),
            ("SEED", scene.seed, "seed of every random stream"),
            ("FRAME", frame.index, "index of the frame"),
            TOP_DOWN_CARD,
            ("SATURATE", frame.saturation_dn, "saturation [DN]"),
        ]
    )
    header.update(wcs_cards)
    header["COMMENT"] = comment
    return fits.PrimaryHDU(frame.image_dn, header)


def utc_text(scene: Scene, t_s: float) -> str:
    """A time since the scene's start as UTC, to a microsecond."""
    return (scene.start_time + datetime.timedelta(seconds=t_s)).isoformat(
        timespec="microseconds"
    )


def write_truth(path: Path, frame: Frame, truth: Truth, scene: Scene) -> None:
    """Write the truth of a frame as ECSV: attitude and rates in the header, one row per source."""
    from astropy.table import Table

    sources = truth.sources
    table = Table({"id": sources.id})
    table["x_px"], table["y_px"] = sources.xy_px.T
    table["flux_x_px"], table["flux_y_px"] = sources.flux_xy_px.T
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
        **{f"{name}_xyzw": getattr(truth, name).as_quat().tolist() for name in ATTITUDES},
        "rate_cam_rad_s": truth.rate_cam_rad_s.tolist(),
        "hidden": truth.hidden.tolist(),
        "lab": STARS if scene.stars else "bearing center, z up",
    }
    for name, found in (("bodies", truth.bodies), ("satellites", truth.satellites)):
        if found:
            table.meta[name] = [dataclasses.asdict(one) for one in found]
    write_table(path, table)
