"""Packets of a live flight as ROS 2 messages (`TOPICS`), in a file of MCAP and by the server of Foxglove.

All stamps are on one clock: the wall clock at the flight's start plus the time of the simulator. Quaternions turn
vectors of a child frame into those of its parent. The camera's axes are those of ROS's optical frames (x right, y down,
z forward), and the first row of pixels is the upper one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import foxglove
import numpy as np
from mcap.writer import Writer
from mcap_ros2._dynamic import serialize_dynamic
from scipy.spatial.transform import Rotation

from skysim.apps.access import HOST
from skysim.apps.live.pacing import Live
from skysim.apps.live.packets import Packet, Sink
from skysim.core import files
from skysim.core.errors import InputError, printable, reason
from skysim.core.paths import DATA
from skysim.tracking.onboard_model import assumed_camera, assumed_lever, onboard_dome

BODY = "body"
CAMERA = "camera_optical_frame"
MOST_WAITING = 64  # messages for a slow client of Foxglove, each of which may be a frame

Message = dict[str, Any]


class RosEncoder:
    """Encodes the packets of a flight's main camera and vehicle in CDR. Raises InputError for an unusable dome.

    Attributes
    ----------
    topics
        Encoders of the messages of each topic, those of the truth only where it is on
    color
        Encoding of pixels of unsigned numbers, without their bits
    camera, lever
        Calibration that the tracker assumes, and mount of the camera on the body
    reference
        Frame of the attitudes: the ICRS, which is the lab of a scene under the stars, or the lab
    """

    def __init__(self, live: Live) -> None:
        self.pace = live.pace
        main = live.flight.lab.camera
        scene = main.scene
        bayer = scene.camera.detector.bayer
        self.color = f"bayer_{bayer.lower()}" if bayer else "mono"
        self.reference = "icrs" if scene.stars else "lab"
        self.camera = assumed_camera(scene)
        self.lever = assumed_lever(scene, main.mount)
        if scene.dome:
            # A surveyed map contains both.
            self.camera, _, self.lever = onboard_dome(
                scene, scene.dome, main.mount, main.sources
            )
        self.topics = {
            topic: serialize_dynamic(topic.type, topic.definition)[topic.type]
            for topic in TOPICS + (TRUE_TOPICS if live.has_truth else ())
        }

    def encode(
        self, packet: Packet, topics: Iterable[Topic]
    ) -> Iterator[tuple[Topic, int, bytes]]:
        """Topic, stamp in ns and bytes of each message of a packet on some of the topics."""
        times_s = packet.header.get("times_s", [packet.header["t_s"]])
        for topic in topics:
            if topic.channel == packet.channel:
                for t_s, message in zip(times_s, self.messages(topic, packet), strict=False):
                    stamp_ns, message["header"] = self.stamped(
                        t_s, topic.frame or self.reference
                    )
                    yield topic, stamp_ns, self.topics[topic](message)

    def stamped(self, t_s: float, frame: str) -> tuple[int, Message]:
        """Unix time in ns of a time of the simulator, and a header with it; two differ by exactly those times."""
        assert self.pace.zero_s is not None
        stamp_ns = round(1e9 * (self.pace.zero_s + self.pace.offset_s)) + round(1e9 * t_s)
        sec, nanosec = divmod(stamp_ns, 10**9)
        return stamp_ns, {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}

    def messages(self, topic: Topic, packet: Packet) -> Iterator[Message]:
        """The messages of a packet on a topic, but for their headers."""
        header = packet.header
        match topic.name:
            case "/camera/camera_info":
                # The assumed calibration: K, D of plumb_bob, R = 1, and P = [K 0], so that rectifying keeps the scale.
                camera = self.camera
                fx = camera.focal_px
                fy = fx * camera.aspect
                cx, cy = camera.center_px
                yield {
                    "height": camera.height_px,
                    "width": camera.width_px,
                    "distortion_model": "plumb_bob",
                    "d": camera.distortion,
                    "k": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
                    "r": [1, 0, 0, 0, 1, 0, 0, 0, 1],
                    "p": [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
                }
            case "/camera/image_raw":
                # Height and width have the same names in the packet; a color camera's frame is a Bayer mosaic.
                pixels = packet.pixels
                bits = 8 * pixels.itemsize
                color = f"{self.color}{bits}" if pixels.dtype.kind == "u" else f"{bits}FC1"
                data = pixels.tobytes()
                yield header | {"encoding": color, "step": pixels.strides[0], "data": data}
            case "/imu/data_raw":
                # Mean rate and specific force of each sample, stamped at the end of its interval. There is no attitude
                # (-1), and the covariances are unknown (0, as `sensor_msgs/Imu` says).
                step_s = header["step_s"]
                increments = zip(header["angle_rad"], header["velocity_m_s"], strict=True)
                for angle_rad, velocity_m_s in increments:
                    yield {
                        "orientation_covariance": [-1],
                        "angular_velocity": named(np.divide(angle_rad, step_s)),
                        "linear_acceleration": named(np.divide(velocity_m_s, step_s)),
                    }
            case "/star_tracker/attitude" | "/truth/camera":
                # Of a frame the true mean over its exposure, with which its solution is compared.
                solved = header.get("cam_from_ref_xyzw")
                if found := packet.truth.get("mean_cam_from_ref_xyzw", solved):
                    yield {"quaternion": named(Rotation.from_quat(found).inv().as_quat())}
            case "/truth/attitude":
                yield {"quaternion": named(header["lab_from_body_xyzw"])}
            case "/tf":
                yield {"transforms": list(self.transforms(header))}

    def transforms(self, header: Message) -> Iterator[Message]:
        """The mount of the camera, and the estimated attitude of the body, of the filter if there is one."""
        mount = named(self.lever.cam_from_body.inv().as_quat())
        links = [(BODY, CAMERA, named(self.lever.camera_body_m), mount)]
        found = header.get("lab_from_filter_xyzw", header.get("lab_from_imu_xyzw"))
        if found:
            links.append((self.reference, BODY, {}, named(found)))
        for parent, child, place, rotation in links:
            yield {
                "header": self.stamped(header["t_s"], parent)[1],
                "child_frame_id": child,
                "transform": {"translation": place, "rotation": rotation},
            }


def named(numbers: Iterable[float]) -> Message:
    """The numbers of a vector, or of a quaternion with its scalar last, by their names."""
    return dict(zip("xyzw", numbers, strict=False))


class Topic(NamedTuple):
    """Name, type and frame (empty: that of the attitudes) of a topic, and the channel of its messages."""

    name: str
    type: str
    frame: str
    channel: str

    @property
    def definition(self) -> str:
        """Text of the message's definition, with those of the types in it."""
        return (DATA / "ros2" / f"{self.type.rpartition('/')[2]}.msg").read_text()


ATTITUDE = "geometry_msgs/msg/QuaternionStamped"
TOPICS = (
    Topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo", CAMERA, "frame"),
    Topic("/camera/image_raw", "sensor_msgs/msg/Image", CAMERA, "frame"),
    Topic("/imu/data_raw", "sensor_msgs/msg/Imu", BODY, "imu"),
    Topic("/star_tracker/attitude", ATTITUDE, "", "solution"),
    Topic("/tf", "tf2_msgs/msg/TFMessage", "", "telemetry"),
)
TRUE_TOPICS = (
    Topic("/truth/camera", ATTITUDE, "", "frame"),
    Topic("/truth/attitude", ATTITUDE, "", "truth"),
)


# Outputs


class McapSink(Sink):
    """Writes packets to a new file. Raises InputError for one that exists.

    A chunk, of a MB or more, ends with a packet. After an error the file ends with the last whole chunk, without an
    index, and `sent` counts the packets in it.
    """

    def __init__(self, encoder: RosEncoder, path: Path) -> None:
        self.encoder = encoder
        self.path = path
        try:
            self.file = path.open("xb")
            self.writer = Writer(self.file)
            self.writer.start(profile="ros2")
            self.flush()
        except OSError as error:
            raise InputError(f"--mcap {path}", reason(error), "a new file") from None
        self.numbers = {
            topic: self.writer.register_channel(
                topic.name,
                "cdr",
                self.writer.register_schema(topic.type, "ros2msg", topic.definition.encode()),
            )
            for topic in encoder.topics
        }
        super().__init__("mcap", self.record, {topic.channel for topic in encoder.topics})

    def flush(self) -> None:
        """Write the chunk in progress. Raises OSError."""
        self.writer.flush()
        self.whole_bytes = self.file.tell()
        self.chunk = Counter[str]()  # packets of the next one

    def record(self, packet: Packet) -> None:
        """Add a packet. Raises OSError."""
        with files.name_in_errors(self.path, left="its whole chunks are kept"):
            for topic, stamp_ns, data in self.encoder.encode(packet, self.numbers):
                self.writer.add_message(self.numbers[topic], stamp_ns, data, stamp_ns)
            if self.file.tell() > self.whole_bytes:
                # The writer has ended a chunk, which may lack the rest of the packet.
                self.flush()
            else:
                self.chunk[packet.channel] += 1

    def close(self) -> None:
        """Write what is queued, the last chunk and the index; after an error cut what follows the last whole chunk."""
        super().close()
        # It may still write a packet.
        self.thread.join()
        try:
            if not self.fault:
                self.flush()
                self.writer.finish()
                self.file.close()
        except OSError as error:
            self.fault = f"{self.path}: {reason(error)}"
        if self.fault:
            self.sent -= self.chunk
            self.dropped += self.chunk
            # What the file still holds back has no room.
            with suppress(OSError):
                self.file.close()
            with suppress(OSError), self.path.open("ab") as file:
                file.truncate(self.whole_bytes)
                Writer(file, use_statistics=False, use_summary_offsets=False).finish()


class FoxgloveSink(Sink):
    """Publishes packets by Foxglove's own server. It knows neither tokens nor origins, so it serves loopback alone.

    A client that is slow loses the oldest messages; these the server does not count. Raises InputError for a port that
    cannot be bound.
    """

    def __init__(self, encoder: RosEncoder, port: int) -> None:
        self.encoder = encoder
        # The server and its channels end with the context, so that it is kept.
        self.context = foxglove.Context()
        self.outlets = {
            topic: foxglove.Channel(
                topic.name,
                schema=foxglove.Schema(
                    name=topic.type, encoding="ros2msg", data=topic.definition.encode()
                ),
                message_encoding="cdr",
                context=self.context,
            )
            for topic in encoder.topics
        }
        try:
            self.server = foxglove.start_server(
                name="skysim live",
                host=HOST,
                port=port,
                context=self.context,
                message_backlog_size=MOST_WAITING,
            )
        except Exception as error:
            problem = printable(f"cannot listen on {HOST}:{port}: {error}")
            raise InputError(f"--foxglove {port}", problem) from None
        super().__init__(
            "foxglove", self.publish, {topic.channel for topic in encoder.topics}
        )

    def publish(self, packet: Packet) -> None:
        """Send a packet on the topics that a client takes."""
        taken = [topic for topic, outlet in self.outlets.items() if outlet.has_sinks()]
        for topic, stamp_ns, data in self.encoder.encode(packet, taken):
            self.outlets[topic].log(data, log_time=stamp_ns)

    def close(self) -> None:
        super().close()
        self.server.stop()
