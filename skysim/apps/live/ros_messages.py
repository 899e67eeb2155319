"""Packets of a live flight as ROS 2 messages; what a topic holds stands in `TOPICS`.

All stamps are on one clock: the wall clock at the flight's start plus the time of the simulator. Attitudes are those of
a child frame in its parent: the quaternion turns vectors of the child's axes into the parent's. The camera's axes are
those of ROS's optical frames (x right, y down, z forward), and the first row of pixels is the upper one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from mcap_ros2._dynamic import serialize_dynamic
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import Lever
from estimator.core.camera import Camera
from skysim.apps.live.pacing import Live, Pace
from skysim.apps.live.packets import Packet
from skysim.core.paths import DATA
from skysim.dynamics.imu import build_triad
from skysim.scene.scene import Scene
from skysim.scene.sections.vehicle import AccelerometerConfig, GyroConfig
from skysim.simulation.lab import StarCamera
from skysim.tracking.onboard_model import assumed_camera, assumed_lever, onboard_dome

BODY = "body"
CAMERA = "camera_optical_frame"
# By NumPy's name of the pixels; a Bayer mosaic has its own.
ENCODINGS = {"|u1": "mono8", "<u2": "mono16", "<f4": "32FC1", "<f8": "64FC1"}

Message = dict[str, Any]


@dataclass(frozen=True)
class RosRig:
    """What the messages need beside the packets: the clock, and the hardware that the tracker assumes.

    Attributes
    ----------
    pace
        Clock of the flight
    scene
        Its scene
    camera, lever
        Assumed calibration of the main camera, and its mount on the body
    """

    pace: Pace
    scene: Scene
    camera: Camera
    lever: Lever

    @classmethod
    def of_live(cls, live: Live) -> RosRig:
        """The rig of a flight's main camera. Raises InputError for a dome that no tracker can use."""
        main: StarCamera = live.flight.lab.camera
        scene = main.scene
        if scene.dome:
            camera, _, lever = onboard_dome(scene, scene.dome, main.mount, main.sources)
        else:
            camera, lever = assumed_camera(scene), assumed_lever(scene, main.mount)
        return cls(live.pace, scene, camera, lever)

    @property
    def reference(self) -> str:
        """Frame of the attitudes: the ICRS, which is the lab of a scene under the stars, or the lab."""
        return "icrs" if self.scene.stars else "lab"

    def stamp_ns(self, t_s: float) -> int:
        """Unix time of a time of the simulator, in ns; two stamps differ by exactly that of their times."""
        assert self.pace.zero_s is not None
        return round(1e9 * (self.pace.zero_s + self.pace.offset_s)) + round(1e9 * t_s)

    def header(self, t_s: float, frame: str) -> Message:
        sec, nanosec = divmod(self.stamp_ns(t_s), 10**9)
        return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}

    @cached_property
    def calibration(self) -> Message:
        """CameraInfo without its header: K, D of plumb_bob, R = 1, P = [K 0]: rectifying keeps the scale."""
        camera = self.camera
        k = np.diag([camera.focal_px, camera.focal_px * camera.aspect, 1.0])
        k[:2, 2] = camera.center_px
        return {
            "height": camera.height_px,
            "width": camera.width_px,
            "distortion_model": "plumb_bob",
            "d": list(camera.distortion),
            "k": k.ravel().tolist(),
            "r": np.eye(3).ravel().tolist(),
            "p": np.column_stack([k, np.zeros(3)]).ravel().tolist(),
        }


Messages = Iterator[tuple[float, Message]]


def image(rig: RosRig, packet: Packet) -> Messages:
    """The frame, stamped at mid-exposure."""
    pixels = packet.pixels
    encoding = ENCODINGS[pixels.dtype.str]
    if rig.scene.camera.detector.bayer and pixels.dtype.kind == "u":
        encoding = f"bayer_{rig.scene.camera.detector.bayer.lower()}{8 * pixels.itemsize}"
    t_s = packet.header["t_s"]
    height, width = pixels.shape
    yield (
        t_s,
        {
            "header": rig.header(t_s, CAMERA),
            "height": height,
            "width": width,
            "encoding": encoding,
            "is_bigendian": 0,
            "step": width * pixels.itemsize,
            "data": pixels.tobytes(),
        },
    )


def camera_info(rig: RosRig, packet: Packet) -> Messages:
    """The calibration, with the stamp of its image."""
    t_s = packet.header["t_s"]
    yield t_s, {"header": rig.header(t_s, CAMERA), **rig.calibration}


def imu(rig: RosRig, packet: Packet) -> Messages:
    """Mean rate and specific force of each sample, stamped at the end of its interval; the attitude is unknown (-1)."""
    config = rig.scene.vehicle.imu
    assert config is not None
    step_s = packet.header["step_s"]
    spread = {
        "orientation_covariance": [-1.0] + [0.0] * 8,
        "angular_velocity_covariance": mean_covariance(config.gyro, step_s),
        "linear_acceleration_covariance": mean_covariance(config.accelerometer, step_s),
    }
    keys = ("times_s", "angle_rad", "velocity_m_s")
    for t_s, angle_rad, velocity_m_s in zip(*map(packet.header.get, keys), strict=True):
        yield (
            t_s,
            {
                "header": rig.header(t_s, BODY),
                "angular_velocity": vector(np.divide(angle_rad, step_s)),
                "linear_acceleration": vector(np.divide(velocity_m_s, step_s)),
                **spread,
            },
        )


def mean_covariance(config: GyroConfig | AccelerometerConfig, step_s: float) -> list[float]:
    """(9,) covariance of the mean over a sample of h: white noise N^2 / h, and the counter's steps q^2 / (6 h^2).

    A carried remainder is uniform with the variance q^2 / 12, and an increment is the difference of two. Bias, scale
    and misalignment are no noise of a sample and are left out.
    """
    triad = build_triad(config, np.zeros((4, 3)), np.zeros(3))
    variance = triad.white**2 / step_s + triad.quantum**2 / (6 * step_s**2)
    return np.diag([variance] * 3).ravel().tolist()


def vector(xyz: Sequence[float]) -> Message:
    return dict(zip("xyz", map(float, xyz), strict=True))


def quaternion(parent_from_child_xyzw: Sequence[float]) -> Message:
    return dict(zip("xyzw", map(float, parent_from_child_xyzw), strict=True))


def stamped(rig: RosRig, packet: Packet, frame: str, **value: Message) -> Messages:
    """One message of a header and a value."""
    t_s = packet.header["t_s"]
    yield t_s, {"header": rig.header(t_s, frame), **value}


def solved_attitude(rig: RosRig, packet: Packet) -> Messages:
    """Attitude of the camera at mid-exposure, where the frame was solved."""
    found = packet.header.get("cam_from_ref_xyzw")
    if found is not None:
        yield from stamped(rig, packet, rig.reference, quaternion=inverse(found))


def inverse(xyzw: Sequence[float]) -> Message:
    return quaternion(Rotation.from_quat(xyzw).inv().as_quat())


def transforms(rig: RosRig, packet: Packet) -> Messages:
    """The estimated attitude of the body, of the filter if there is one, and the assumed mount of the camera."""
    header = packet.header
    body_from_cam = rig.lever.cam_from_body.inv().as_quat()
    links = [(BODY, CAMERA, rig.lever.camera_body_m, body_from_cam)]
    found = header.get("lab_from_filter_xyzw", header.get("lab_from_imu_xyzw"))
    if found is not None:
        links.append((rig.reference, BODY, np.zeros(3), found))
    t_s = header["t_s"]
    made = [
        {
            "header": rig.header(t_s, parent),
            "child_frame_id": child,
            "transform": {"translation": vector(at_m), "rotation": quaternion(xyzw)},
        }
        for parent, child, at_m, xyzw in links
    ]
    yield t_s, {"transforms": made}


def true_camera(rig: RosRig, packet: Packet) -> Messages:
    """Mean attitude of the camera over the exposure, with which a solution is compared."""
    true = inverse(packet.truth["mean_cam_from_ref_xyzw"])
    yield from stamped(rig, packet, rig.reference, quaternion=true)


def true_attitude(rig: RosRig, packet: Packet) -> Messages:
    """Attitude of the body."""
    true = quaternion(packet.header["lab_from_body_xyzw"])
    yield from stamped(rig, packet, rig.reference, quaternion=true)


def true_rate(rig: RosRig, packet: Packet) -> Messages:
    """Rate of the body, in its axes."""
    yield from stamped(rig, packet, BODY, vector=vector(packet.header["rate_body_rad_s"]))


class Topic(NamedTuple):
    """Name and type of a topic, the channel whose packets it tells of, and the function of its stamped messages."""

    name: str
    type: str
    channel: str
    messages: Callable[[RosRig, Packet], Messages]

    @property
    def definition(self) -> str:
        """Text of the message's definition, with those of the types in it."""
        return (DATA / "ros2" / f"{self.type.rpartition('/')[2]}.msg").read_text()


ATTITUDE = "geometry_msgs/msg/QuaternionStamped"
TOPICS = (
    Topic("/camera/image_raw", "sensor_msgs/msg/Image", "frame", image),
    Topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo", "frame", camera_info),
    Topic("/imu/data_raw", "sensor_msgs/msg/Imu", "imu", imu),
    Topic("/star_tracker/attitude", ATTITUDE, "solution", solved_attitude),
    Topic("/tf", "tf2_msgs/msg/TFMessage", "telemetry", transforms),
)
TRUE_TOPICS = (
    Topic("/truth/camera", ATTITUDE, "frame", true_camera),
    Topic("/truth/attitude", ATTITUDE, "truth", true_attitude),
    Topic("/truth/rate", "geometry_msgs/msg/Vector3Stamped", "truth", true_rate),
)


class RosEncoder:
    """Messages of a flight's packets in CDR.

    Attributes
    ----------
    rig
        Clock and hardware
    topics
        Topics, those of the truth only where it is on
    """

    def __init__(self, live: Live) -> None:
        self.rig = RosRig.of_live(live)
        self.topics = TOPICS + (TRUE_TOPICS if live.has_truth else ())
        self.encoders = {
            one.type: serialize_dynamic(one.type, one.definition)[one.type]
            for one in self.topics
        }

    def encode(self, topic: Topic, packet: Packet) -> Iterator[tuple[int, bytes]]:
        """Stamps in ns and messages of a packet on one of its topics."""
        for t_s, message in topic.messages(self.rig, packet):
            yield self.rig.stamp_ns(t_s), self.encoders[topic.type](message)
