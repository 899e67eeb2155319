"""Camera calibrations in OpenCV's YAML format: read them with checks, and write them for OpenCV."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError, shortened
from skysim.core.types import frozen
from skysim.core.yaml_reader import (
    StrictLoader,
    Tree,
    excerpt,
    parse_yaml,
    read_limited,
    reject_duplicate_keys,
)

MAX_BYTES = 1 << 20  # enough for a calibration with the points of all its views
# Allowed relative difference of fx and fy: a detector's pixels are square, so it is an error of the calibration.
MAX_ASPECT_ERROR = 1e-3
MAX_SIDE_PX = 20000  # a side of the detector, as in a scene's camera
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")


@frozen
class OpencvCalibration:
    """A pinhole with square pixels and the distortion of Brown (1971); camera axes +x right, +y down, +z boresight.

    Attributes
    ----------
    width_px, height_px
        Size of the image
    focal_px
        Focal length (strictly, the image distance) over the pixel pitch
    center_px
        Principal point (x, y); the center of pixel (0, 0) is (0, 0), as in OpenCV
    distortion
        Coefficients k1, k2, p1, p2, k3 in OpenCV's order
    """

    width_px: int
    height_px: int
    focal_px: float
    center_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]

    @property
    def field_deg(self) -> tuple[float, float, float]:
        """Field of view along width, height and diagonal, 2 atan(side / 2 f), without distortion."""
        sides_px = self.width_px, self.height_px, math.hypot(self.width_px, self.height_px)
        width, height, diagonal = (
            2 * math.degrees(math.atan(px / 2 / self.focal_px)) for px in sides_px
        )
        return width, height, diagonal

    @property
    def corner_px(self) -> float:
        """Distance from the principal point to the farthest corner of the detector."""
        x, y = self.center_px
        far_x = max(x + 0.5, self.width_px - 0.5 - x)
        far_y = max(y + 0.5, self.height_px - 0.5 - y)
        return math.hypot(far_x, far_y)

    @property
    def arcsec_px(self) -> float:
        """Angle of a pixel on the axis, in arcsec."""
        return 1 / self.focal_px / ARCSEC_RAD

    def field_text(self) -> str:
        """The field of view and the angle of a pixel in words."""
        width, height, diagonal = self.field_deg
        return f"{width:.2f}° × {height:.2f}°, diagonal {diagonal:.2f}°; {self.arcsec_px:.4g}″ a pixel"


class Loader(StrictLoader):
    """`StrictLoader` that reads OpenCV's matrices as mappings, and numbers such as 3e-09, texts in YAML 1.1."""


def matrix_node(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    """The mapping of a node with the tag opencv-matrix."""
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(
            None, None, "a matrix that is not a mapping", node.start_mark
        )
    return loader.construct_mapping(node, deep=True)


Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", matrix_node)
Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?\d+e[-+]?\d+$", re.ASCII), "-+0123456789"
)


def looks_like_calibration(path: Path) -> bool:
    """Whether a file has a camera_matrix, or OpenCV's first line."""
    try:
        with path.open("rb") as file:
            head = file.read(MAX_BYTES)
    except OSError:
        return False
    return (
        head.startswith(b"%YAML")
        or b"\ncamera_matrix:" in head
        or head.startswith(b"camera_matrix:")
    )


def read(path: Path) -> OpencvCalibration:
    """The calibration in a file of OpenCV's calibration samples, or of ROS, which has the same keys.

    It reads image_width, image_height, camera_matrix and distortion_coefficients and ignores other keys. Raises
    InputError for another file, and for another lens model: fisheye, rational, skewed.
    """
    # 1. Lens model and size.
    tree = parse_file(path)
    for key, allowed in (("fisheye_model", (0, False)), ("distortion_model", ("plumb_bob",))):
        if key in tree and tree[key] not in allowed:
            raise InputError(
                path, f"{key}: {excerpt(repr(tree[key]))}", ", ".join(map(str, allowed))
            )
    width, height = (image_side(path, tree, key) for key in ("image_width", "image_height"))
    # 2. Camera matrix of a pinhole without skew and with square pixels.
    fx, skew, cx, zero, fy, cy, *last = matrix(path, tree, "camera_matrix", ((3, 3),))
    if min(fx, fy) <= 0 or skew or zero or last != [0, 0, 1]:
        raise InputError(
            path,
            "camera_matrix: another form",
            "[fx, 0, cx, 0, fy, cy, 0, 0, 1], fx and fy above 0",
        )
    if abs(fx / fy - 1) > MAX_ASPECT_ERROR:
        raise InputError(
            path,
            f"camera_matrix: fx {fx:g} and fy {fy:g} differ by {100 * abs(fx / fy - 1):.2g} %",
            f"square pixels, to {100 * MAX_ASPECT_ERROR:g} % (calibrate with CALIB_FIX_ASPECT_RATIO)",
        )
    # 3. Distortion: the terms beyond the fifth, of other models, must be zero.
    shapes = tuple(shape for n in (4, 5, 8, 12, 14) for shape in ((1, n), (n, 1)))
    coefficients = matrix(path, tree, "distortion_coefficients", shapes)
    if any(coefficients[5:]):
        raise InputError(
            path,
            f"distortion_coefficients: {len(coefficients)} terms",
            ", ".join(COEFFICIENTS),
        )
    k1, k2, p1, p2, k3 = [*coefficients, 0.0][:5]
    return OpencvCalibration(
        width, height, math.sqrt(fx * fy), (cx, cy), (k1, k2, p1, p2, k3)
    )


def parse_file(path: Path) -> Tree:
    """The mapping in the file. Raises InputError.

    OpenCV before version 5 begins a file with %YAML:1.0, which is invalid YAML.
    """
    text = read_limited(path, MAX_BYTES)
    try:
        first, _, rest = text.partition("\n")
        node, tree = parse_yaml(f"\n{rest}" if first.startswith("%YAML") else text, Loader)
    except (yaml.YAMLError, ValueError, RecursionError, TypeError, OverflowError) as error:
        problem = shortened(getattr(error, "problem", None) or error, 120)
        raise InputError(path, f"not OpenCV's YAML: {problem}") from None
    reject_duplicate_keys(node, path)
    if not isinstance(tree, dict):
        raise InputError(path, "", "a calibration of OpenCV, a mapping of keys to values")
    return tree


def image_side(path: Path, tree: Tree, key: str) -> int:
    """The width or height of the image. Raises InputError."""
    value = tree.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_SIDE_PX:
        problem = f"{key}: {excerpt(repr(value))} is not allowed"
        raise InputError(path, problem, f"a whole number from 1 to {MAX_SIDE_PX}")
    return value


def matrix(
    path: Path, tree: Tree, key: str, shapes: tuple[tuple[int, int], ...]
) -> list[float]:
    """The numbers of a matrix, row by row. Raises InputError."""
    node = tree.get(key)
    if not isinstance(node, dict):
        raise InputError(path, f"{key}: missing", "a matrix with rows, cols and data")
    shape = (node.get("rows"), node.get("cols"))
    data = node.get("data")
    if shape not in shapes:
        raise InputError(
            path,
            f"{key}: {excerpt(shape[0])} rows and {excerpt(shape[1])} cols",
            ", ".join(f"{rows}x{cols}" for rows, cols in shapes),
        )
    count = shape[0] * shape[1]
    # Below 1e12 excludes infinity and NaN.
    if (
        not isinstance(data, list)
        or len(data) != count
        or not all(type(one) in (int, float) and abs(one) < 1e12 for one in data)
    ):
        raise InputError(path, f"{key}: other data", f"{count} finite numbers")
    return [float(value) for value in data]


def text(calibration: OpencvCalibration) -> str:
    """The calibration as YAML for `read` and for OpenCV's FileStorage (versions 4 and 5)."""
    import cv2  # slow to import

    f = calibration.focal_px
    cx, cy = calibration.center_px
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY
    storage = cv2.FileStorage(".yml", flags)
    storage.write("image_width", calibration.width_px)
    storage.write("image_height", calibration.height_px)
    storage.write("camera_matrix", np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]], float))
    storage.write("distortion_coefficients", np.array([calibration.distortion]))
    return str(storage.releaseAndGetString())
