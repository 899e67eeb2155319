"""Outputs of ROS 2 messages: a file of MCAP, and the server of Foxglove."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import foxglove
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, Writer

from skysim.apps.live.packets import Packet
from skysim.apps.live.ros_messages import RosEncoder
from skysim.apps.live.sinks import Sink
from skysim.core import files
from skysim.core.errors import InputError, printable

CHUNK_BYTES = 1 << 20
CHUNK_S = 1.0
LOOPBACK_HOST = "127.0.0.1"
BACKLOG_BYTES = 1 << 28  # of frames that wait for a slow client of Foxglove
LEAST_BACKLOG = 16  # messages


class RecordFile:
    """A new file of MCAP records that is whole after each chunk: an end without an index, which the next overwrites."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("xb", buffering=0)
        self.tell = self.file.tell
        self.place = 0  # of the end
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        Footer(0, 0, 0).write(builder)
        self.end = builder.end() + MCAP0_MAGIC

    def write(self, data: bytes) -> None:
        """Append records. Raises OSError."""
        view = memoryview(data)
        while view:
            view = view[self.file.write(view) :]

    def flush(self) -> None:
        """Write the end after a chunk. Raises OSError."""
        place = self.tell()
        self.write(self.end)
        self.place = self.file.seek(place)

    def cut(self) -> None:
        """Remove what follows the last whole chunk; the end had room there before."""
        self.file.seek(self.place)
        self.file.truncate()
        self.write(self.end)


class McapSink(Sink):
    """Writes packets to a new file, in chunks of CHUNK_BYTES or CHUNK_S. Raises InputError for one that exists.

    A chunk holds whole packets, so that `sent` counts those in the file also where the disk is full.
    """

    def __init__(self, encoder: RosEncoder, path: Path) -> None:
        self.encoder = encoder
        self.path = path
        self.lock = Lock()
        self.is_open = True
        try:
            self.file = RecordFile(path)
            self.writer = Writer(self.file, chunk_size=1 << 62)  # chunks end by `flush` alone
            self.writer.start(profile="ros2")
            self.flush()
        except OSError as error:
            raise InputError(f"--mcap {path}", error.strerror, "a new file") from None
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
        self.chunk = Counter[str]()  # its packets
        self.size = 0
        self.begun_s = time.monotonic()

    def record(self, packet: Packet) -> None:
        """Add a packet, after a chunk that is full. Raises OSError, with the file ended."""
        with self.lock, self.ends_at_error():
            if self.size >= CHUNK_BYTES or time.monotonic() - self.begun_s >= CHUNK_S:
                self.flush()
            for topic, number in self.numbers.items():
                if topic.channel == packet.channel:
                    for stamp_ns, data in self.encoder.encode(topic, packet):
                        self.writer.add_message(number, stamp_ns, data, stamp_ns)
                        self.size += len(data)
            self.chunk[packet.channel] += 1

    @contextmanager
    def ends_at_error(self) -> Iterator[None]:
        """End the file at an error, and count the packets that it lacks as dropped."""
        try:
            with files.name_in_errors(self.path):
                yield
        except OSError:
            self.is_open = False
            self.sent -= self.chunk
            self.dropped += self.chunk
            self.file.cut()
            raise

    def close(self) -> None:
        """Write what is queued, the last chunk and the index."""
        super().close()
        with self.lock:
            try:
                if self.is_open:
                    with self.ends_at_error():
                        self.flush()
                        self.writer.finish()
            except OSError as error:
                self.fault = f"{error.filename}: {error.strerror}"
            self.file.file.close()


class FoxgloveSink(Sink):
    """Publishes packets by Foxglove's own server. It knows neither tokens nor origins, so it serves loopback alone.

    A client that is slow loses the oldest messages; these the server does not count. Raises InputError for a port that
    cannot be bound.
    """

    def __init__(self, encoder: RosEncoder, port: int) -> None:
        super().__init__("foxglove", self.publish, ())
        self.encoder = encoder
        self.clients = Counter[str]()  # by topic
        # The server and its channels end with the context, so that it is kept.
        self.context = foxglove.Context()
        self.topics = {
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
        frame_bytes = 2 * encoder.camera.width_px * encoder.camera.height_px
        try:
            self.server = foxglove.start_server(
                name="skysim live",
                host=LOOPBACK_HOST,
                port=port,
                context=self.context,
                server_listener=self,
                message_backlog_size=max(BACKLOG_BYTES // frame_bytes, LEAST_BACKLOG),
            )
        except Exception as error:
            problem = f"cannot listen on {LOOPBACK_HOST}:{port}: {error}"
            raise InputError(f"--foxglove {port}", printable(problem)) from None

    def publish(self, packet: Packet) -> None:
        """Send a packet on the topics that are taken."""
        for topic, channel in self.topics.items():
            if topic.channel == packet.channel and channel.has_sinks():
                for stamp_ns, data in self.encoder.encode(topic, packet):
                    channel.log(data, log_time=stamp_ns)

    def close(self) -> None:
        super().close()
        self.server.stop()

    def on_subscribe(self, _: Any, channel: Any) -> None:
        self.count(channel.topic, 1)

    def on_unsubscribe(self, _: Any, channel: Any) -> None:
        self.count(channel.topic, -1)

    def count(self, name: str, more: int) -> None:
        """Count the clients of a topic; the sink takes the channels that have any."""
        self.clients[name] += more
        self.channels = {one.channel for one in self.topics if self.clients[one.name] > 0}
