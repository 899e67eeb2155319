"""The tracker's model of an LED dome: LED positions, the dome's surface, and the camera's lever arm.

Under a dome the stars (LEDs) are at a finite distance, and the camera moves as the vehicle rotates about the bearing,
so the angles between LEDs as seen from the camera depend on the attitude. Intersecting each ray with the believed
surface gives points whose directions from the bearing center have angles that do not.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints
from estimator.core.errors import ImageError

UNIT_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
SAME_PLACE_M = 1e-4  # distance of two LEDs of a list that are one


@dataclass(frozen=True, slots=True)
class LedMap:
    """The believed dome: LED positions and inner surface, in the lab frame.

    Attributes
    ----------
    id
        (N,) number of each LED
    position_m
        (N, 3) position of each LED
    center_m, semi_axes_m
        (3,) center and semi-axes of the ellipsoid |(x - center) / semi_axes| = 1 of the LEDs
    board
        (N,) label of the patch board of each LED, since all boards have the same pattern; None
        without boards
    sigma_m
        Standard deviation of an LED's position along each axis; the rms over all LEDs if
        `covariance_m2` is given
    covariance_m2
        (N, 3, 3) covariance of each LED's own position error; None if all are sigma_m^2 I
    common_m
        (M, N, 3) displacement of each LED by one standard deviation of each of the M errors that
        all LEDs share (surface, position and orientation of the instrument); None without any
    common_camera
        (M, 11) change of the lever in body axes, m, and of `Camera.lens` that each common error
        brings with it, in a survey by the camera itself; None if lever and lens have errors of
        their own
    flux_s
        (N,) flux of each LED, in image units per second of exposure; None if all are alike
    flux_sigma
        Standard deviation of the natural logarithm of measured over expected flux
    """

    id: Ints
    position_m: Floats
    center_m: Floats
    semi_axes_m: Floats
    board: Ints | None = None
    sigma_m: float = 0.0
    covariance_m2: Floats | None = None
    common_m: Floats | None = None
    common_camera: Floats | None = None
    flux_s: Floats | None = None
    flux_sigma: float = 0.15

    @property
    def radius_m(self) -> Floats:
        """(N,) distance of each LED from the bearing center."""
        return np.linalg.norm(self.position_m, axis=1)

    @classmethod
    def from_csv(
        cls, path: str | Path, unit: str | None = None, sigma_m: float = 0.0
    ) -> LedMap:
        """Return the map of a list of LEDs: a text file whose first line names its columns.

        Columns are separated by commas, or by blanks in a line without commas; lines that begin with # are comments.
        x_m, y_m, z_m, or x_mm, x_cm, x_in and so on, are places from the bearing center in the dome's axes. `id`
        numbers the LEDs; without it they are numbered from 0. Other columns are not used.

        The surface is the sphere |x - c| = R through the LEDs: |x|^2 = 2 c.x + k with k = R^2 - |c|^2 is linear in c
        and k, which least squares gives (Coope 1993, J. Optim. Theory Appl. 76, 381). LEDs in a plane do not determine
        it: it is then about the bearing center.

        Parameters
        ----------
        path
            The file
        unit
            Unit of columns x, y, z, which have none in their names: m, mm, cm or in
        sigma_m
            Standard deviation of a place along each axis

        Raises
        ------
        ImageError
            With the number of the line, for a file that cannot be read in this way, or that has an LED twice.
        """
        places, rows = _read_columns(Path(path), unit)
        position_m = rows[:, :3]
        if pairs := cKDTree(position_m).query_pairs(SAME_PLACE_M):
            first, second = (places[n] for n in min(pairs))
            raise ImageError(
                f"{path}: line {second} is the LED of line {first}; allowed: each once"
            )
        number = rows[:, 3]
        _, first_row = np.unique(number, return_index=True)
        again = np.setdiff1d(np.arange(len(number)), first_row)
        for n in (*again, *np.flatnonzero((number % 1 != 0) | (number < 0))):
            raise ImageError(
                f"{path}: line {places[n]}: id {number[n]:g}; allowed: whole numbers from 0, each once"
            )
        radius_m = np.linalg.norm(position_m, axis=1)
        design = np.column_stack([2 * position_m, np.ones(len(position_m))])
        solution, _, rank, _ = np.linalg.lstsq(design, radius_m**2, rcond=None)
        center_m = solution[:3] if rank == 4 else np.zeros(3)
        semi_axes_m = np.full(3, np.linalg.norm(position_m - center_m, axis=1).mean())
        return cls(
            number.astype(np.int64), position_m, center_m, semi_axes_m, sigma_m=sigma_m
        )


def _read_columns(path: Path, unit: str | None) -> tuple[list[int], Floats]:
    """Return the line numbers and rows x_m, y_m, z_m, id of a list of LEDs, see `LedMap.from_csv`."""
    if unit is not None:
        checks.known("unit", unit, UNIT_M)
    try:
        text = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ImageError(
            f"{path}: cannot be read: {reason}; allowed: a list of LEDs"
        ) from None
    lines = [(n, line) for n, line in enumerate(text, 1) if line.strip() and line[0] != "#"]
    cells = [
        [cell.strip() for cell in line.split("," if "," in line else None)]
        for _, line in lines
    ]
    header = cells[0] if cells else []
    units = {f"_{name}": scale for name, scale in UNIT_M.items()}
    if unit is not None:
        units |= {"": UNIT_M[unit]}
    found = [end for end in units if {f"{axis}{end}" for axis in "xyz"} <= {*header}]
    if len(found) != 1 or len({*header}) < len(header) or len(cells) < 2:
        raise ImageError(
            f"{path}: no list of LEDs; allowed: one of columns x_m, y_m, z_m, or x_mm, x_cm, x_in and so on, or x, y, z"
            " with a unit; one LED a line"
        )
    used = [header.index(f"{axis}{found[0]}") for axis in "xyz"]
    used += [header.index("id")] if "id" in header else []
    rows = np.zeros((len(cells) - 1, 4))
    rows[:, 3] = np.arange(len(rows))
    for row, words, (n, line) in zip(rows, cells[1:], lines[1:], strict=True):
        try:
            row[: len(used)] = [float(words[k]) for k in used]
        except (ValueError, IndexError):
            row[0] = np.nan
        if len(words) != len(header) or not np.isfinite(row).all():
            raise ImageError(
                f"{path}: line {n}: {line.strip()[:40]!r} is no LED; allowed: {len(header)} finite numbers, as the"
                " first line has names"
            )
    rows[:, :3] *= units[found[0]]
    return [n for n, _ in lines[1:]], rows


@dataclass(frozen=True, slots=True)
class Lever:
    """The believed position and orientation of the camera on the vehicle.

    Attributes
    ----------
    camera_body_m
        (3,) position of the entrance pupil, from the bearing center, in the body frame
    cam_from_body
        Rotation from the body frame to camera axes
    sigma_m
        Standard deviation of the pupil's position along each axis
    """

    camera_body_m: Floats
    cam_from_body: Rotation
    sigma_m: float = 0.0


def on_sphere(rays_body: Floats, camera_body_m: Floats, radius_m: Floats | float) -> Floats:
    """Return (N, 3) intersections of rays from the camera with a sphere about the bearing center, in the body frame.

    The distance s along the ray u from the camera at c follows from |c + s u| = R:
    s = -c.u + sqrt((c.u)^2 - c.c + R^2). No attitude is needed: the sphere is the same in every attitude.

    Parameters
    ----------
    rays_body
        (N, 3) unit vectors in the body frame
    camera_body_m
        (3,) position c of the camera in the body frame
    radius_m
        Radius R of one sphere, or (N,) radius of the sphere of each ray

    Raises
    ------
    ValueError
        If the camera is outside the sphere.
    """
    along = rays_body @ camera_body_m  # c.u
    discriminant = along**2 - camera_body_m @ camera_body_m + radius_m**2
    least_m = np.min(radius_m)
    if least_m <= np.linalg.norm(camera_body_m):
        raise ValueError(
            f"camera {np.linalg.norm(camera_body_m)} m from the bearing; allowed: inside the sphere of {least_m} m"
        )
    return camera_body_m + (-along + np.sqrt(discriminant))[:, None] * rays_body


def on_surface(rays_lab: Floats, origin_lab_m: Floats, leds: LedMap) -> Floats:
    """Return (N, 3) intersections of rays from inside with the believed ellipsoid, in the lab frame; NaN if none.

    In the scaled coordinates w = (x - center) / semi_axes the surface is the unit sphere. With w = w0 + s v along a
    ray, |w| = 1 is the quadratic equation a s^2 + 2 b s + c = 0, a = v.v, b = v.w0, c = w0.w0 - 1. The larger root
    is the intersection ahead of an origin inside: s = (-b + sqrt(b^2 - a c)) / a.
    """
    start = (origin_lab_m - leds.center_m) / leds.semi_axes_m  # w0
    along = rays_lab / leds.semi_axes_m  # v
    a = np.sum(along**2, axis=1)
    b = along @ start
    discriminant = b**2 - a * (start @ start - 1)
    root = np.sqrt(np.maximum(discriminant, 0))
    distance = np.where(discriminant >= 0, (-b + root) / a, np.nan)
    return origin_lab_m + distance[:, None] * rays_lab


def project(
    body_from_lab: Rotation, position_m: Floats, lever: Lever, camera: Camera
) -> Floats:
    """Project LEDs at (N, 3) lab positions to (N, 2) pixels; NaN behind the camera."""
    # q = A P - c: from the camera to the LED, in the body frame
    in_body = body_from_lab.apply(position_m) - lever.camera_body_m
    return camera.pixels(lever.cam_from_body.apply(in_body))


def common_shifts_m(leds: LedMap, star: Ints, lever: Lever, cam_from_lab: Rotation) -> Floats:
    """Return the (M, K, 3) shifts of K LEDs from the pupil by one standard deviation of each common error.

    They are in camera axes. The map must have common errors.
    """
    assert leds.common_m is not None
    shift_m = leds.common_m[:, star] @ cam_from_lab.as_matrix().T
    if leds.common_camera is not None:
        shift_m -= lever.cam_from_body.apply(leds.common_camera[:, :3])[:, None]
    return shift_m


def common_images_px(leds: LedMap, camera: Camera, rays_cam: Floats) -> Floats:
    """Return the (M, K, 2) pixels of K rays with the lens of each common error; of the camera's if it has none."""
    changes = np.zeros((1, 11)) if leds.common_camera is None else leds.common_camera
    lenses = camera.lens + changes[:, 3:]
    return np.array([camera.with_lens(lens).pixels(rays_cam) for lens in lenses])


def check_map(leds: object) -> None:
    """Raise ImageError unless a map's arrays have matching shapes and usable numbers."""
    checks.of_type("leds", leds, LedMap)
    assert isinstance(leds, LedMap)
    count = len(checks.rows("leds: position_m", leds.position_m, None, 3))
    if not count:
        raise ImageError("leds: the map is empty; allowed: 3 LEDs or more")
    for name in ("id", "board"):
        column = getattr(leds, name)
        if column is not None and np.shape(column) != (count,):
            raise ImageError(
                f"leds: {name} has shape {np.shape(column)}; allowed: ({count},), one an LED"
            )
    for name in ("center_m", "semi_axes_m"):
        checks.floats(f"leds: {name}", getattr(leds, name), (3,))
    checks.number("leds: sigma_m", leds.sigma_m, 0.0, 1e9, "finite, 0 or more")
    if leds.covariance_m2 is not None:
        checks.floats("leds: covariance_m2", leds.covariance_m2, (count, 3, 3))
    if leds.common_m is not None:
        errors = len(checks.floats("leds: common_m", leds.common_m, (None, count, 3)))
        if leds.common_camera is not None:
            checks.floats("leds: common_camera", leds.common_camera, (errors, 11))
    checks.number("leds: flux_sigma", leds.flux_sigma, 1e-3, 10.0, "0.001 to 10")
    if leds.flux_s is not None:
        flux_s = checks.floats("leds: flux_s", leds.flux_s, (count,))
        if not (flux_s > 0).all():  # False for NaN too
            raise ImageError("leds: flux_s is 0 or less, or not a number; allowed: above 0")


def check_lever(leds: LedMap, lever: Lever) -> None:
    """Raise ImageError unless the lever's numbers are usable and its arm is shorter than the nearest LED's distance."""
    checks.of_type("lever", lever, Lever)
    if not np.isfinite(
        checks.floats("lever: camera_body_m", lever.camera_body_m, (3,))
    ).all():
        raise ImageError("lever: camera_body_m has a NaN or infinity; allowed: finite")
    checks.one_rotation("lever: cam_from_body", lever.cam_from_body)
    checks.number("lever: sigma_m", lever.sigma_m, 0.0, 1e9, "finite, 0 or more")
    nearest = leds.radius_m.min()
    lever_m = np.linalg.norm(lever.camera_body_m)
    if lever_m >= nearest:
        raise ImageError(
            f"camera {lever_m:.3f} m from the bearing; allowed: less than the nearest LED's {nearest:.3f} m"
        )
