"""The tracker's model of an LED dome: LED positions, the dome's surface, and the camera's lever arm.

Under a dome the stars (LEDs) are at a finite distance, and the camera moves as the vehicle rotates about the bearing,
so the angles between LEDs as seen from the camera depend on the attitude. Intersecting each ray with the believed
surface gives points whose directions from the bearing center have angles that do not.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.core import checks
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints, frozen
from estimator.core.constants import INCH_M
from estimator.core.errors import ImageError, file_bytes, reason
from estimator.core.vectors import lengths

UNIT_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": INCH_M}
SAME_PLACE_M = 1e-4  # distance of two LEDs of a list that are one


@frozen
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
        return lengths(self.position_m)

    @classmethod
    def from_csv(
        cls, path: str | Path, unit: str | None = None, sigma_m: float = 0.0
    ) -> LedMap:
        """Return the map of a list of LEDs: a text file whose first line names its columns.

        Columns are separated by commas, or by blanks in a line without commas; lines that begin with # are comments.
        x_m, y_m, z_m, or x_mm, x_cm, x_in and so on, are places from the bearing center in the dome's axes. `id`
        numbers the LEDs; without it they are numbered from 0. Other columns are not used.

        The surface is the sphere about the bearing center with their mean distance. The default identifier and solver
        do not use it; for the others replace it by the dome's.

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
        lines, table = _read_leds(path, unit)
        position_m = table[:, :3]
        number = table[:, 3] if table.shape[1] == 4 else np.arange(len(table))
        first = dict(zip(number[::-1], lines[::-1], strict=True))
        for n, line in zip(number, lines, strict=True):
            if n % 1 or n < 0 or first[n] != line:
                raise ImageError(
                    f"{path}: line {line}: id {n:g}; allowed: whole numbers from 0, each once"
                )
        if pairs := cKDTree(position_m).query_pairs(SAME_PLACE_M):
            one, other = (lines[n] for n in min(pairs))
            raise ImageError(
                f"{path}: line {other}: the LED of line {one}; allowed: each once"
            )
        radius_m = np.full(3, lengths(position_m).mean())
        numbers = number.astype(np.int64)
        return cls(numbers, position_m, np.zeros(3), radius_m, sigma_m=sigma_m)


def _read_leds(path: str | Path, unit: str | None) -> tuple[list[int], Floats]:
    """Return the numbers of the lines of a list of LEDs, and its columns x_m, y_m, z_m and id, if it has that."""
    units = {f"_{name}": scale for name, scale in UNIT_M.items()}
    if unit is not None:
        checks.known("unit", unit, UNIT_M)
        units[""] = UNIT_M[unit]
    try:
        text = file_bytes(path).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ImageError(
            f"{path}: cannot be read: {reason(error)}; allowed: a list of LEDs"
        ) from None
    rows = [
        (n, [cell.strip() for cell in line.split("," if "," in line else None)])
        for n, line in enumerate(text, 1)
        if line.strip() and line[0] != "#"
    ]
    names = rows[0][1] if rows else []
    found = [end for end in units if {f"{axis}{end}" for axis in "xyz"} <= {*names}]
    if len(found) != 1 or len({*names}) < len(names) or len(rows) < 2:
        raise ImageError(
            f"{path}: no list of LEDs; allowed: columns x_m, y_m, z_m, or x_mm, x_cm, x_in and so on, or x, y, z with a"
            " unit; one LED a line"
        )
    used = [f"{axis}{found[0]}" for axis in "xyz"] + ["id"] * ("id" in names)
    table = []
    for n, cells in rows[1:]:
        try:
            row = dict(zip(names, cells, strict=True))
            table.append([float(row[name]) for name in used])
        except ValueError:
            table.append([np.nan])
        if not np.isfinite(table[-1]).all():
            raise ImageError(
                f"{path}: line {n}: {','.join(cells)[:40]!r}; allowed: {len(names)} columns, finite numbers in"
                f" {', '.join(used)}"
            )
    scales = [units[found[0]]] * 3 + [1.0]
    return [n for n, _ in rows[1:]], np.array(table) * scales[: len(used)]


@frozen
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

    @property
    def body_from_cam(self) -> Rotation:
        """Rotation from camera axes to body axes."""
        return self.cam_from_body.inv()

    @property
    def pupil_cam_m(self) -> Floats:
        """(3,) position of the entrance pupil, from the bearing center, in camera axes."""
        return self.cam_from_body.apply(self.camera_body_m)


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


def led_sigma_rad(leds: LedMap, lever: Lever) -> Floats:
    """Return the (L,) standard deviation of the direction to each LED from the camera, from the error of its position.

    Equal errors of all LEDs are divided by the least distance of any LED from the camera. Otherwise the rms across the
    line from the bearing is divided by the LED's own distance minus the lever.
    """
    radius_m = leds.radius_m
    lever_m = float(np.linalg.norm(lever.camera_body_m))
    if leds.covariance_m2 is None:
        return np.full(len(radius_m), leds.sigma_m / (radius_m.min() - lever_m))
    along = leds.position_m / radius_m[:, None]
    total_m2 = np.trace(leds.covariance_m2, axis1=1, axis2=2)
    along_m2 = np.einsum("ni,nij,nj->n", along, leds.covariance_m2, along)
    return np.sqrt((total_m2 - along_m2) / 2) / (radius_m - lever_m)


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
    """Raise ImageError unless map and lever are usable, and the lever's arm is shorter than any LED's distance."""
    check_map(leds)
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
