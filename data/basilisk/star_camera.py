"""Star camera of skysim for Basilisk: a module that takes the spacecraft's states and publishes rendered attitudes.

It talks to `skysim live SCENE --tcp PORT --poses --endless`. Requires Basilisk 2.12 and numpy.
"""

from __future__ import annotations

import json
import socket
import time
from collections import Counter, deque
from typing import Any

import numpy as np
from Basilisk.architecture import messaging, sysModel  # type: ignore[import-not-found]

NANO = 1e-9
STEP_S = 1e-6  # shortest step between two samples
MOST_SAMPLES = 150  # of a pose


def xyzw_of_mrp(sigma: Any) -> np.ndarray:
    """Quaternion (4,), scalar last, of modified Rodrigues parameters sigma = e tan(phi / 4).

    q = (2 sigma, 1 - |sigma|^2) / (1 + |sigma|^2). With sigma_BN it is the rotation of body axes into those of N.
    """
    sigma = np.asarray(sigma, float).ravel()
    square = sigma @ sigma
    return np.array([*(2 * sigma), 1 - square]) / (1 + square)


def mrp_of_xyzw(quaternion: Any) -> np.ndarray:
    """The inverse of `xyzw_of_mrp`; of the two sets that of the shorter rotation, |sigma| <= 1."""
    x, y, z, w = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    return np.copysign(1.0, w) * np.array([x, y, z]) / (1 + abs(w))


def times(p: Any, q: Any) -> np.ndarray:
    """Product p q of two quaternions, scalar last: the rotation q, then p."""
    vector = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
    return np.array([*vector, p[3] * q[3] - p[:3] @ q[:3]])


def inverse(q: Any) -> np.ndarray:
    """Inverse of a unit quaternion, scalar last."""
    return np.array([-q[0], -q[1], -q[2], q[3]])


class Wire:
    """The connection to `skysim live`.

    Parameters
    ----------
    host, port, token
        Address, and the token that the server has printed, if any
    timeout_s
        Wall-clock time for an answer. Raises TimeoutError after it
    """

    def __init__(self, host: str, port: int, token: str, timeout_s: float) -> None:
        self.socket = socket.create_connection((host, port), timeout_s)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.lines = self.socket.makefile("rb")
        self.send({"take": ["solution"]} | ({"token": token} if token else {}))
        self.hello = self.receive()

    def send(self, command: dict[str, Any]) -> None:
        self.socket.sendall(json.dumps(command).encode() + b"\n")

    def receive(self) -> dict[str, Any]:
        """The next packet. Raises RuntimeError for an error, ConnectionError where the server has gone."""
        line = self.lines.readline()
        if not line:
            raise ConnectionError("skysim live has closed the connection")
        packet: dict[str, Any] = json.loads(line)
        if packet["channel"] == "error":
            raise RuntimeError(f"skysim live: {packet['problem']}")
        return packet

    def close(self) -> None:
        self.lines.close()
        self.socket.close()


class StarCamera(sysModel.SysModel):  # type: ignore[misc]
    """Every `period_s` an exposure that ends now is rendered and solved; its attitude is published `latency_s` later.

    Add it to the task of the spacecraft's dynamics, with a lower priority: its samples are the spacecraft's states at
    the task's updates. The inertial frame N has the axes of the ICRS, and its zero base is the Earth.

    Attributes
    ----------
    scStateInMsg
        Message SCStatesMsg of the spacecraft
    stAttOutMsg
        Message STAttMsg: timeTag is mid-exposure, MRP_BdyInrtl the body's attitude. A frame without a solution
        publishes nothing
    period_s, latency_s
        Frame period, and time from the end of the exposure to the message
    has_orbit
        Whether the scene has a section `orbit`, so that the camera's place is sent
    statuses
        Number of frames by status of the solution
    solutions
        Packets of the solutions, as skysim has sent them
    exchange_s
        Wall-clock time of each exchange
    """

    def __init__(
        self,
        port: int,
        *,
        host: str = "127.0.0.1",
        token: str = "",
        timeout_s: float = 60.0,
        period_s: float = 0.125,
        latency_s: float = 0.0,
        has_orbit: bool = True,
    ) -> None:
        super().__init__()
        self.ModelTag = "starCamera"
        self.scStateInMsg = messaging.SCStatesMsgReader()
        self.stAttOutMsg = messaging.STAttMsg()
        self.period_s = period_s
        self.latency_s = latency_s
        self.has_orbit = has_orbit
        self.statuses: Counter[str] = Counter()
        self.solutions: list[dict[str, Any]] = []
        self.exchange_s: list[float] = []
        self.wire = Wire(host, port, token, timeout_s)
        self.exposure_s = float(self.wire.hello["exposure_s"])
        self.cam_from_body = np.array(self.wire.hello["cam_from_body_xyzw"])
        self.samples: deque[tuple[float, dict[str, list[float]]]] = deque(maxlen=MOST_SAMPLES)
        self.frames = 0
        self.pending: deque[tuple[float, Any]] = deque()

    def Reset(self, CurrentSimNanos: int) -> None:
        """Forget samples and unpublished attitudes. The simulation's time goes on from that of the last frame."""
        if not self.scStateInMsg.isLinked():
            raise RuntimeError("StarCamera.scStateInMsg is not linked")
        self.samples.clear()
        self.pending.clear()
        self.first_s = CurrentSimNanos * NANO + self.period_s
        self.frames = 0

    def UpdateState(self, CurrentSimNanos: int) -> None:
        """Take a sample; expose a frame that is due; publish an attitude whose latency has passed."""
        now_s = CurrentSimNanos * NANO
        if self.scStateInMsg.isWritten():
            t_s = self.scStateInMsg.timeWritten() * NANO
            if not self.samples or t_s - self.samples[-1][0] >= STEP_S:
                self.samples.append((t_s, self.values(self.scStateInMsg())))
        due_s = self.first_s + self.frames * self.period_s
        if now_s >= due_s - STEP_S and self.covers_exposure():
            # Frames that could not be exposed are left out.
            self.frames += 1 + int((now_s - due_s + STEP_S) / self.period_s)
            self.expose(now_s)
        while self.pending and self.pending[0][0] <= now_s + STEP_S:
            _, message = self.pending.popleft()
            self.stAttOutMsg.write(message, CurrentSimNanos, self.moduleID)

    def values(self, state: Any) -> dict[str, list[float]]:
        """Values of a state for a pose. They are copied, since the next state overwrites the message."""
        values = {
            "lab_from_body_xyzw": xyzw_of_mrp(state.sigma_BN).tolist(),
            "rate_body_rad_s": list(state.omega_BN_B),
        }
        if self.has_orbit:
            values |= {
                "position_m": list(state.r_BN_N),
                "velocity_m_s": list(state.v_BN_N),
            }
        return values

    def covers_exposure(self) -> bool:
        """Whether the samples last as long as an exposure."""
        return (
            len(self.samples) > 1
            and self.samples[-1][0] - self.samples[0][0] >= self.exposure_s - STEP_S / 1e3
        )

    def expose(self, now_s: float) -> None:
        """Exchange an exposure for its solution."""
        # Samples from the last one before the exposure on.
        open_s = self.samples[-1][0] - self.exposure_s
        while len(self.samples) > 2 and self.samples[1][0] <= open_s:
            self.samples.popleft()
        states = [state for _, state in self.samples]
        pose = {key: [one[key] for one in states] for key in states[0]}
        pose["t_s"] = [t_s for t_s, _ in self.samples]
        begun_s = time.perf_counter()
        self.wire.send({"pose": pose})
        solution = self.wire.receive()
        self.exchange_s.append(time.perf_counter() - begun_s)
        self.statuses[solution["status"]] += 1
        self.solutions.append(solution)
        if solution["status"] == "solved":
            cam_from_lab = np.array(solution["cam_from_ref_xyzw"])
            lab_from_body = times(inverse(cam_from_lab), self.cam_from_body)
            message = messaging.STAttMsgPayload()
            message.timeTag = round(solution["t_s"] / NANO)
            message.MRP_BdyInrtl = mrp_of_xyzw(lab_from_body).tolist()
            self.pending.append((now_s + self.latency_s, message))
