"""Read the results folder of `skysim run` or `skysim render`, frame by frame."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core import files
from skysim.core.fits import read_fits
from skysim.core.types import Floats
from skysim.sources import stars

STARS = "ICRS axes"  # value of `lab` in a truth header for a scene under the stars
UNIT_NORM = 1e-6
SKY_ANGLES = ("ra_deg", "dec_deg", "roll_deg")
LAB_ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """The truth of one frame, as read from its file: attitudes (4,) as xyzw, rate (3,), and the table of sources."""

    frame: int
    mid_utc: datetime.datetime
    t_mid_s: float
    exposure_s: float
    lab_from_body_xyzw: Floats
    cam_from_lab_xyzw: Floats
    rate_cam_rad_s: Floats
    sources: Any


@dataclass(frozen=True)
class Recording:
    """A finished run: its folder, and the frames' file paths without suffix, in frame order."""

    folder: Path
    stems: list[Path] = field(repr=False)

    @cached_property
    def meta(self) -> dict[str, Any]:
        """Scene, seed and definition of the lab axes, from the truth of the first frame. Raises InputError."""
        header = files.read_table(self.stems[0].with_suffix(".ecsv")).meta
        missing = [key for key in ("scene", "seed", "lab") if key not in header]
        if missing:
            raise InputError(
                f"{self.stems[0]}.ecsv", f"no {missing[0]} in the header", "a truth file of a run"
            )
        return {key: header[key] for key in ("scene", "seed", "lab")}

    @property
    def is_celestial(self) -> bool:
        """Whether the lab axes are those of the ICRS."""
        return bool(self.meta["lab"] == STARS)

    def truths(self) -> Iterator[FrameTruth]:
        """The truth of every frame."""
        return (read_truth(stem.with_suffix(".ecsv")) for stem in self.stems)

    def image(self, stem: Path) -> NDArray[Any]:
        """A frame's digital numbers: (H, W) uint16, or float64 from a noise-free camera. Raises InputError."""
        image = read_fits(stem.with_suffix(".fits"))
        if image.ndim != 2 or not image.size:
            raise InputError(f"{stem}.fits", f"an image of shape {image.shape}", "(height, width)")
        return image

    def table(self, name: str) -> Any:
        """The table `solutions`, `telemetry` or `imu` as an astropy table; None if the run wrote none."""
        path = self.folder / f"{name}.ecsv"
        return files.read_table(path) if path.is_file() else None

    def solved(self) -> tuple[NDArray[np.int64], Rotation] | None:
        """(K,) indices of the solved frames and their attitudes.

        Attitudes are lab_from_cam under the stars and lab_from_body in a laboratory. Returns None if there is no
        table of solutions or no frame was solved. Raises InputError if a column is missing.
        """
        solutions = self.table("solutions")
        if solutions is None:
            return None
        names = SKY_ANGLES if self.is_celestial else LAB_ANGLES
        missing = [name for name in ("frame", *names) if name not in solutions.colnames]
        if missing:
            raise InputError(
                self.folder / "solutions.ecsv", f"missing column {missing[0]}", "a table of a run"
            )
        angles = np.column_stack(
            [np.ma.filled(solutions[name].astype(float), np.nan) for name in names]
        )
        valid = np.isfinite(angles).all(axis=1)
        if not valid.any():
            return None
        return np.asarray(solutions["frame"], np.int64)[valid], attitudes(
            angles[valid], self.is_celestial
        )

    def motion(self) -> tuple[Floats, Rotation] | None:
        """(K,) times in s and lab_from_body at every tick of the vehicle's computer; None without telemetry.

        Raises InputError if a column is missing.
        """
        telemetry = self.table("telemetry")
        if telemetry is None:
            return None
        columns = [f"true_{name}" for name in LAB_ANGLES]
        missing = [name for name in ("t_s", *columns) if name not in telemetry.colnames]
        if missing:
            raise InputError(
                self.folder / "telemetry.ecsv", f"missing column {missing[0]}", "a table of a run"
            )
        angles = np.column_stack([np.asarray(telemetry[name], dtype=float) for name in columns])
        return np.asarray(telemetry["t_s"], dtype=float), attitudes(angles, is_celestial=False)


def attitudes(angles_deg: Floats, is_celestial: bool) -> Rotation:
    """Rotations from (K, 3) angles in the convention of `scoring.angles_deg`.

    Under the stars: lab_from_cam from RA, Dec, roll. Otherwise: lab_from_body from the roll, pitch, yaw of the 3-2-1
    sequence.
    """
    if is_celestial:
        return Rotation.concatenate([stars.cam_from_icrs(*row).inv() for row in angles_deg])
    return Rotation.from_euler("ZYX", angles_deg[:, ::-1], degrees=True)


def open_recording(folder: Path) -> Recording:
    """The run in a folder. Raises InputError if the folder holds no frame with its truth."""
    stems = {}
    for path in folder.glob("frame_*.fits"):
        number = re.fullmatch(r"frame_(\d{4,})", path.stem)
        if number and path.with_suffix(".ecsv").is_file():
            stems[int(number[1])] = path.with_suffix("")
    if not stems:
        raise InputError(
            folder, "no frames with truth files", "a folder of a run, or of rendered frames"
        )
    return Recording(folder, [stems[index] for index in sorted(stems)])


def read_truth(path: Path) -> FrameTruth:
    """Read the truth of a frame.

    Raises InputError (one line) for a file that is not a truth file or that an older skysim wrote.
    """
    sources = files.read_table(path)
    counts = {"frame": 1, "t_mid_s": 1, "exposure_s": 1}
    counts |= {"lab_from_body_xyzw": 4, "cam_from_lab_xyzw": 4, "rate_cam_rad_s": 3}
    numbers = {
        key: np.array(files.header_numbers(path, sources.meta, key, count))
        for key, count in counts.items()
    }
    for key in ("lab_from_body_xyzw", "cam_from_lab_xyzw"):
        if abs(np.linalg.norm(numbers[key]) - 1) > UNIT_NORM:
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
    return FrameTruth(
        frame=int(numbers.pop("frame")[0]),
        mid_utc=utc,
        t_mid_s=float(numbers.pop("t_mid_s")[0]),
        exposure_s=float(numbers.pop("exposure_s")[0]),
        sources=sources,
        **numbers,
    )
