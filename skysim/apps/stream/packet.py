"""Wire format of a frame: a header as one line of JSON, then the raw pixels."""

from __future__ import annotations

import json
import re
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.core import quaternion
from skysim.core.errors import InputError
from skysim.simulation.flight import Shot

# limits for the reader
MAX_HEADER_BYTES = 1 << 16
MAX_PIXELS = 1 << 28


class Packet(NamedTuple):
    """A frame to send.

    header : what a tracker may use. index, t_s (mid-exposure since the scene's start), exposure_s, width, height,
             dtype (numpy's, little-endian), bytes (of the pixels), due_unix_s and made_unix_s (wall-clock times at
             which the exposure ended and the frame was ready), dropped (frames dropped before this one)
    pixels : (H, W)
    truth  : cam_from_ref_xyzw (scalar last; ref: ICRS or the lab), rate_cam_rad_s, and ids, x_px, y_px of the lights
             on the detector
    """

    header: dict[str, Any]
    pixels: NDArray[Any]
    truth: dict[str, Any]

    @property
    def number(self) -> int:
        """Sequence number among the frames that were rendered."""
        return int(self.header["index"] - self.header["dropped"])

    def plus_dropped(self, missed: int) -> Packet:
        """The same packet for a receiver that missed further frames: its header's `dropped` is that much larger."""
        return self._replace(header=self.header | {"dropped": self.header["dropped"] + missed})

    def pack(self) -> bytes:
        """Serialize: the header line, then the pixels row by row from the top."""
        return json.dumps(self.header).encode() + b"\n" + self.pixels.tobytes()


def build_packet(shot: Shot, due_unix_s: float, made_unix_s: float, dropped: int) -> Packet:
    """Make the packet of a shot. Times: due and made, Unix seconds;  dropped : frames dropped before it."""
    frame = shot.frame
    truth = shot.truth
    pixels = np.ascontiguousarray(frame.image_dn, frame.image_dn.dtype.newbyteorder("<"))
    height, width = pixels.shape
    header = {
        "index": frame.index,
        "t_s": frame.t_mid_s,
        "exposure_s": frame.exposure_s,
        "width": width,
        "height": height,
        "dtype": pixels.dtype.str,
        "bytes": pixels.nbytes,
        "due_unix_s": due_unix_s,
        "made_unix_s": made_unix_s,
        "dropped": dropped,
    }
    truth_values = {
        "cam_from_ref_xyzw": np.roll(quaternion.from_rotation(truth.cam_from_lab), -1).tolist(),
        "rate_cam_rad_s": truth.rate_cam_rad_s.tolist(),
        "ids": truth.sources.id.tolist(),
        "x_px": truth.sources.xy_px[:, 0].round(4).tolist(),
        "y_px": truth.sources.xy_px[:, 1].round(4).tolist(),
    }
    return Packet(header, pixels, truth_values)


def unpack(stream: BinaryIO) -> tuple[dict[str, Any], NDArray[Any]] | None:
    """Read the next header and its (H, W) pixels; None at the end. Raises InputError for malformed or cut-off data."""
    line = stream.readline(MAX_HEADER_BYTES)
    if not line:
        return None
    try:
        header = json.loads(line)
        shape = (int(header["height"]), int(header["width"]))
        dtype_name = header["dtype"]
        if not re.fullmatch(r"[<>|]?(u[1248]|f[248])", dtype_name):
            raise ValueError(dtype_name)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError("", f"not a packet of skysim stream: {line[:40]!r}") from error
    count = shape[0] * shape[1]
    dtype = np.dtype(dtype_name)
    if min(shape) < 1 or count > MAX_PIXELS:
        raise InputError(
            "", f"not a packet of skysim stream: {shape[1]} x {shape[0]} pixels of {dtype}"
        )
    pixels = stream.read(count * dtype.itemsize)
    if len(pixels) < count * dtype.itemsize:
        raise InputError("", f"the stream ended within frame {header.get('index')}")
    return header, np.frombuffer(pixels, dtype).reshape(shape)
