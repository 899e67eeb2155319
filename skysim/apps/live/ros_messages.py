"""Packets of a live flight as ROS 2 messages: `TOPICS`.

All stamps are on one clock: the wall clock at the flight's start plus the time of the simulator. Quaternions turn
vectors of a child frame into those of its parent. The camera's axes are those of ROS's optical frames (x right, y down,
z forward), and the first row of pixels is the upper one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from mcap_ros2._dynamic import serialize_dynamic
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from skysim.apps.live.pacing import Live
from skysim.apps.live.packets import Packet
from skysim.core.paths import DATA
from skysim.core.types import Floats
from skysim.dynamics.imu import build_triad
from skysim.scene.sections.vehicle import AccelerometerConfig, GyroConfig
from skysim.tracking.onboard_model import assumed_camera, assumed_lever, onboard_dome

BODY = "body"
CAMERA = "camera_optical_frame"
ENCODINGS = {"|u1": "mono8", "<u2": "mono16", "<f4": "32FC1", "<f8": "64FC1"}

Message = dict[str, Any]


class RosEncoder:
    """Encodes the packets of a flight's main camera and vehicle in CDR. Raises InputError for an unusable dome.

    Attributes
    ----------
    topics
        Topics, those of the truth only where it is on
    camera, lever
        Calibration that the tracker assumes, and mount of the camera on the body
    reference
        Frame of the attitudes: the ICRS, which is the lab of a scene under the stars, or the lab
    """

    def __init__(self, live: Live) -> None:
        self.pace = live.pace
        self.topics = TOPICS + (TRUE_TOPICS if live.has_truth else ())
        main = live.flight.lab.camera
        self.scene = main.scene
        self.reference = "icrs" if self.scene.stars else "lab"
        self.camera = assumed_camera(self.scene)
        self.lever = assumed_lever(self.scene, main.mount)
        if self.scene.dome:
            # A surveyed map contains both.
            self.camera, _, self.lever = onboard_dome(
                self.scene, self.scene.dome, main.mount, main.sources
            )
        self.encoders = {
            one.type: serialize_dynamic(one.type, one.definition)[one.type]
            for one in self.topics
        }

    def stamp_ns(self, t_s: float) -> int:
        """Unix time of a time of the simulator; two stamps differ by exactly that of their times."""
        assert self.pace.zero_s is not None
        return round(1e9 * (self.pace.zero_s + self.pace.offset_s)) + round(1e9 * t_s)

    def header(self, t_s: float, frame: str) -> Message:
        sec, nanosec = divmod(self.stamp_ns(t_s), 10**9)
        return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}

    def encode(self, topic: Topic, packet: Packet) -> Iterator[tuple[int, bytes]]:
        """Stamps in ns and messages of a packet on one of its topics."""
        times_s = packet.header.get("times_s", [packet.header["t_s"]])
        for t_s, message in zip(times_s, topic.messages(self, packet), strict=False):
            header = self.header(t_s, topic.frame or self.reference)
            data = self.encoders[topic.type]({"header": header} | message)
            yield self.stamp_ns(t_s), data


def image(encoder: RosEncoder, packet: Packet) -> list[Message]:
    """The frame; a color camera's is a Bayer mosaic."""
    pixels = packet.pixels
    bayer = encoder.scene.camera.detector.bayer
    encoding = ENCODINGS[pixels.dtype.str]
    if bayer and pixels.dtype.kind == "u":
        encoding = f"bayer_{bayer.lower()}{8 * pixels.itemsize}"
    height, width = pixels.shape
    return [
        {
            "height": height,
            "width": width,
            "encoding": encoding,
            "step": width * pixels.itemsize,
            "data": pixels.tobytes(),
        }
    ]


def camera_info(encoder: RosEncoder, _: Packet) -> list[Message]:
    """The assumed calibration: K, D of plumb_bob, R = 1, and P = [K 0], so that rectifying keeps the scale."""
    camera = encoder.camera
    k = np.diag([camera.focal_px, camera.focal_px * camera.aspect, 1.0])
    k[:2, 2] = camera.center_px
    return [
        {
            "height": camera.height_px,
            "width": camera.width_px,
            "distortion_model": "plumb_bob",
            "d": camera.distortion,
            "k": flat(k),
            "r": flat(np.eye(3)),
            "p": flat(k @ np.eye(3, 4)),
        }
    ]


def imu(encoder: RosEncoder, packet: Packet) -> list[Message]:
    """Mean rate and specific force of each sample, stamped at the end of its interval, without an attitude (-1)."""
    config = encoder.scene.vehicle.imu
    assert config is not None
    step_s = packet.header["step_s"]
    spread = {
        "orientation_covariance": [-1.0] + [0.0] * 8,
        "angular_velocity_covariance": mean_covariance(config.gyro, step_s),
        "linear_acceleration_covariance": mean_covariance(config.accelerometer, step_s),
    }
    rates_rad_s = np.divide(packet.header["angle_rad"], step_s)
    forces_m_s2 = np.divide(packet.header["velocity_m_s"], step_s)
    return [
        {"angular_velocity": named(rate), "linear_acceleration": named(force)} | spread
        for rate, force in zip(rates_rad_s, forces_m_s2, strict=True)
    ]


def mean_covariance(config: GyroConfig | AccelerometerConfig, step_s: float) -> list[float]:
    """(9,) covariance of the mean over a sample of h: white noise N^2 / h, and the counter's steps q^2 / (6 h^2).

    An increment has the difference of two carried remainders, which are uniform with q^2 / 12. Bias, scale and
    misalignment are no noise of a sample and are left out.
    """
    triad = build_triad(config, np.zeros((4, 3)), np.zeros(3))
    variance = triad.white**2 / step_s + triad.quantum**2 / (6 * step_s**2)
    return flat(variance * np.eye(3))


def flat(matrix: Floats) -> list[float]:
    return matrix.ravel().tolist()


def named(numbers: ArrayLike) -> Message:
    """The numbers of a vector, or of a quaternion with its scalar last, by their names."""
    return dict(zip("xyzw", np.asarray(numbers).tolist(), strict=False))


def inverse(xyzw: ArrayLike) -> Message:
    return named(Rotation.from_quat(xyzw).inv().as_quat())


def transforms(encoder: RosEncoder, packet: Packet) -> list[Message]:
    """The estimated attitude of the body, of the filter if there is one, and the mount of the camera."""
    header = packet.header
    lever = encoder.lever
    links = [(BODY, CAMERA, lever.camera_body_m, inverse(lever.cam_from_body.as_quat()))]
    found = header.get("lab_from_filter_xyzw", header.get("lab_from_imu_xyzw"))
    if found:
        links.append((encoder.reference, BODY, np.zeros(3), named(found)))
    made = [
        {
            "header": encoder.header(header["t_s"], parent),
            "child_frame_id": child,
            "transform": {"translation": named(place_m), "rotation": rotation},
        }
        for parent, child, place_m, rotation in links
    ]
    return [{"transforms": made}]


def true_attitude(_: RosEncoder, packet: Packet) -> list[Message]:
    """Attitude of the body."""
    return [{"quaternion": named(packet.header["lab_from_body_xyzw"])}]


def camera_attitude(_: RosEncoder, packet: Packet) -> list[Message]:
    """Attitude of the camera: of a frame the true mean over its exposure, with which its solution is compared."""
    found = packet.truth.get("mean_cam_from_ref_xyzw", packet.header.get("cam_from_ref_xyzw"))
    return [{"quaternion": inverse(found)}] if found else []


class Topic(NamedTuple):
    """Name, type and frame (empty: that of the attitudes) of a topic, and the channel and function of its messages."""

    name: str
    type: str
    frame: str
    channel: str
    messages: Callable[[RosEncoder, Packet], list[Message]]

    @property
    def definition(self) -> str:
        """Text of the message's definition, with those of the types in it."""
        return (DATA / "ros2" / f"{self.type.rpartition('/')[2]}.msg").read_text()


ATTITUDE = "geometry_msgs/msg/QuaternionStamped"
TOPICS = (
    Topic("/camera/image_raw", "sensor_msgs/msg/Image", CAMERA, "frame", image),
    Topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo", CAMERA, "frame", camera_info),
    Topic("/imu/data_raw", "sensor_msgs/msg/Imu", BODY, "imu", imu),
    Topic("/star_tracker/attitude", ATTITUDE, "", "solution", camera_attitude),
    Topic("/tf", "tf2_msgs/msg/TFMessage", "", "telemetry", transforms),
)
TRUE_TOPICS = (
    Topic("/truth/camera", ATTITUDE, "", "frame", camera_attitude),
    Topic("/truth/attitude", ATTITUDE, "", "truth", true_attitude),
)
