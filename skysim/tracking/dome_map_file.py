"""Read and write the dome map that `skysim survey` measures."""

from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.errors import InputError
from skysim.core.files import header_numbers, read_table, write_table
from skysim.core.types import Floats, Ints, Record, frozen


@frozen
class DomeMap:
    """A surveyed dome and its camera; `tracker.map` names its file.

    Attributes
    ----------
    id, position_m
        Numbers (N,) of the surveyed LEDs, and their positions (N, 3) in the lab
    sigma_m
        (N,) standard deviations of the positions, rms of the three axes
    camera_body_m
        (3,) position of the entrance pupil in body axes
    lever_sigma_m
        Standard deviation of that position, rms of the three axes
    size_px
        Width and height of the detector
    focal_px, center_px, distortion
        Focal length, principal point and k1, k2, p1, p2, k3
    focal_sigma_px, center_sigma_px, distortion_sigma
        Standard deviations of these numbers; 0 for a number that the survey held fixed
    own_m2, common_m, common_camera
        Covariance of the errors: `covariance_m2`, `common_m` and `common_camera` of
        `estimator.attitude.dome_map.LedMap`; None if all errors are independent
    """

    id: Ints
    position_m: Floats
    sigma_m: Floats
    camera_body_m: Floats
    lever_sigma_m: float
    size_px: tuple[int, int]
    focal_px: float
    focal_sigma_px: float
    center_px: tuple[float, float]
    center_sigma_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    distortion_sigma: tuple[float, float, float, float, float]
    own_m2: Floats | None = None
    common_m: Floats | None = None
    common_camera: Floats | None = None


MAP_COLUMNS = ("id", "x_m", "y_m", "z_m", "sigma_m")

# Keys in the header of a dome map, and the count of numbers in each.
MAP_META = {
    "size_px": 2,
    "focal_px": 1,
    "focal_sigma_px": 1,
    "center_px": 2,
    "center_sigma_px": 2,
    "distortion": 5,
    "distortion_sigma": 5,
    "camera_body_m": 3,
    "lever_sigma_m": 1,
}


ROUNDING = 1e-5  # of a map's variances, of the greatest


def write_dome_map(path: Path, dome: DomeMap) -> None:
    """Write a surveyed dome as ECSV: one row for each LED, the camera in the header.

    A row has the LED's own covariance (3, 3) and its shift by each common error (M, 3); 4 bytes a number suffice.
    """
    from astropy.table import Table

    table = Table(
        dict(zip(MAP_COLUMNS, (dome.id, *dome.position_m.T, dome.sigma_m), strict=True))
    )
    table.meta = {key: np.array(getattr(dome, key)).tolist() for key in MAP_META}
    if dome.own_m2 is not None and dome.common_m is not None:
        table["own_m2"] = dome.own_m2.astype(np.float32)
        table["common_m"] = dome.common_m.swapaxes(0, 1).astype(np.float32)
        table.meta["common_camera"] = np.array(dome.common_camera).tolist()
    write_table(path, table)


def read_dome_map(path: Path) -> DomeMap:
    """The dome map in a file that `write_dome_map` wrote. Raises InputError for any other file."""
    table = read_table(path)
    missing = [name for name in MAP_COLUMNS if name not in table.colnames]
    if missing or not len(table):
        fault = f"no column {missing[0]}" if missing else "no LED"
        raise InputError(path, fault, "a map written by a survey")
    try:
        numbers = np.column_stack(
            [np.ma.filled(table[name].astype(float), np.nan) for name in MAP_COLUMNS]
        )
    except (TypeError, ValueError):
        raise InputError(
            path, "", f"numbers in the columns {', '.join(MAP_COLUMNS)}"
        ) from None
    # Each LED once, with finite numbers.
    invalid = np.flatnonzero(~np.isfinite(numbers).all(axis=1) | (numbers[:, 4] <= 0))
    if len(invalid):
        raise InputError(
            path, f"row {invalid[0] + 1}", "finite numbers, and a sigma_m above 0"
        )
    id_, count = np.unique(numbers[:, 0].astype(np.int64), return_counts=True)
    if count.max() > 1:
        raise InputError(path, f"LED {id_[count > 1][0]} occurs {count.max()} times", "once")
    # The camera.
    meta = {
        key: header_numbers(path, table.meta, key, count) for key, count in MAP_META.items()
    }
    fields: Record = {
        key: value[0] if len(value) == 1 else tuple(value) for key, value in meta.items()
    }
    fields["size_px"] = tuple(round(side) for side in meta["size_px"])
    fields["camera_body_m"] = np.array(meta["camera_body_m"])
    fields |= read_covariance(path, table)
    return DomeMap(
        id=numbers[:, 0].astype(np.int64),
        position_m=numbers[:, 1:4],
        sigma_m=numbers[:, 4],
        **fields,
    )


def read_covariance(path: Path, table: Any) -> dict[str, Floats]:
    """The covariance of a map's errors by the names of `DomeMap`; empty if it has none. Raises InputError."""
    if "common_camera" not in table.meta:
        return {}
    try:
        found = {
            "own_m2": np.array(table["own_m2"], dtype=float),
            "common_m": np.array(table["common_m"], dtype=float).swapaxes(0, 1),
            "common_camera": np.array(table.meta["common_camera"], dtype=float),
        }
    except (KeyError, TypeError, ValueError):
        found = {}
    errors = len(np.atleast_1d(found.get("common_camera", ())))
    shapes = ((len(table), 3, 3), (errors, len(table), 3), (errors, 11))
    if (
        tuple(array.shape for array in found.values()) != shapes
        or not np.isfinite(found["common_camera"]).all()
    ):
        raise InputError(
            path,
            "its covariance is incomplete",
            "own_m2 (3, 3) and common_m (M, 3) of each LED, common_camera (M, 11) in the header",
        )
    finite = np.isfinite(found["own_m2"]).all((1, 2)) & np.isfinite(found["common_m"]).all(
        (0, 2)
    )
    variances_m2 = np.linalg.eigvalsh(np.where(finite[:, None, None], found["own_m2"], 0.0))
    # They are kept with 4 bytes a number.
    valid = finite & (variances_m2[:, 0] >= -ROUNDING * variances_m2[:, -1])
    if not valid.all():
        raise InputError(
            path,
            f"row {np.argmin(valid) + 1}: its covariance",
            "finite numbers, and no variance below 0",
        )
    return found
