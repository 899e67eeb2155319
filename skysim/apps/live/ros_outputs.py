"""Outputs of ROS 2 messages: a file of MCAP, and the server of Foxglove."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import foxglove
from foxglove.websocket import ServerListener
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, Writer

from skysim.apps.live.packets import Packet
from skysim.apps.live.ros_messages import RosEncoder, Topic
from skysim.apps.live.sinks import Sink
from skysim.core import files
from skysim.core.errors import InputError, printable

CHUNK_BYTES = 1 << 20
CHUNK_S = 1.0  # what a killed process loses at most
LOOPBACK_HOST = "127.0.0.1"
BACKLOG_BYTES = 1 << 28  # of frames that a slow client of Foxglove keeps waiting
LEAST_BACKLOG = 16
MOST_BACKLOG = 1024


class RecordFile:
    """A new file of whole MCAP records. Where the disk is full it is cut back to whole chunks and ended.

    Attributes
    ----------
    wholes
        The two newest places where the data may end
    """

    def __init__(self, path: Path) -> None:
        try:
            self.file = path.open("xb", buffering=0)
        except OSError as error:
            raise InputError(
                f"--mcap {path}", error.strerror or str(error), "a new file"
            ) from None
        self.wholes: deque[int] = deque(maxlen=2)

    def tell(self) -> int:
        return self.file.tell()

    def write(self, data: bytes) -> None:
        """Append records. Raises OSError."""
        view = memoryview(data)
        while view:
            view = view[self.file.write(view) :]

    def flush(self) -> None:
        """The place is one where the data may end."""
        self.wholes.append(self.tell())

    def end_early(self) -> int:
        """End the data at the newest place after which there is room for the end; return how many chunks that costs.

        Without a summary it is a whole file all the same, which readers search from its start.
        """
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        Footer(0, 0, 0).write(builder)
        end = builder.end() + MCAP0_MAGIC
        for lost, place in enumerate(reversed(self.wholes)):
            self.file.seek(place)
            self.file.truncate()
            try:
                self.write(end)
            except OSError:
                continue
            return lost
        return len(self.wholes)


class McapSink(Sink):
    """Writes packets to a file, in chunks of CHUNK_BYTES or CHUNK_S. Raises InputError for a file that exists.

    A chunk holds whole packets, so that `sent` counts those that a reader finds also where the disk is full.
    """

    def __init__(self, encoder: RosEncoder, path: Path) -> None:
        self.encoder = encoder
        self.path = path
        self.file = RecordFile(path)
        self.lock = Lock()
        self.is_open = True
        self.writer = Writer(self.file, chunk_size=1 << 62)  # chunks end by `flush` alone
        self.writer.start(profile="ros2")
        schemas: dict[str, int] = {}
        self.ids: dict[Topic, int] = {}
        for topic in encoder.topics:
            if topic.type not in schemas:
                definition = topic.definition.encode()
                schemas[topic.type] = self.writer.register_schema(
                    topic.type, "ros2msg", definition
                )
            self.ids[topic] = self.writer.register_channel(
                topic.name, "cdr", schemas[topic.type]
            )
        self.chunk: Counter[str] = Counter()
        self.flush()
        super().__init__("mcap", self.record, {topic.channel for topic in encoder.topics})

    def flush(self) -> None:
        """Write the chunk in progress. Raises OSError."""
        self.writer.flush()
        # Packets of the last chunk and of the one in progress.
        self.former = self.chunk
        self.chunk = Counter()
        self.size = 0
        self.begun_s = time.monotonic()

    def record(self, packet: Packet) -> None:
        """Add a packet, after a chunk that is full. Raises OSError, with the file ended."""
        with self.lock, self.ends_at_error():
            if self.size >= CHUNK_BYTES or time.monotonic() - self.begun_s >= CHUNK_S:
                self.flush()
            for topic, number in self.ids.items():
                if topic.channel == packet.channel:
                    for stamp_ns, data in self.encoder.encode(topic, packet):
                        self.writer.add_message(number, stamp_ns, data, stamp_ns)
                        self.size += len(data)
            self.chunk[packet.channel] += 1

    @contextmanager
    def ends_at_error(self) -> Iterator[None]:
        """End the file at an error, and count as dropped what it has lost."""
        try:
            with files.name_in_errors(self.path):
                yield
        except OSError:
            if self.is_open:
                self.is_open = False
                lost = self.chunk + self.former if self.file.end_early() else self.chunk
                self.sent -= lost
                self.dropped += lost
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
            self.is_open = False
            self.file.file.close()


class Subscriptions(ServerListener):
    """Keeps the channels of a sink those of the topics that clients of Foxglove take."""

    def __init__(self, sink: Sink, topics: Iterable[Topic]) -> None:
        self.sink = sink
        self.topics = tuple(topics)
        self.clients: Counter[str] = Counter()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self.count(channel.topic, 1)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        self.count(channel.topic, -1)

    def count(self, topic: str, more: int) -> None:
        self.clients[topic] += more
        self.sink.channels = {
            one.channel for one in self.topics if self.clients[one.name] > 0
        }


class FoxgloveSink(Sink):
    """Publishes packets by Foxglove's own server. It knows neither tokens nor origins, so it serves loopback alone.

    A client that is slow loses the oldest messages; these the server does not count.

    Raises
    ------
    InputError
        For a port that cannot be bound.
    """

    def __init__(self, encoder: RosEncoder, port: int) -> None:
        super().__init__("foxglove", self.publish, ())
        self.encoder = encoder
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
        camera = encoder.rig.camera
        frames = BACKLOG_BYTES // (2 * camera.width_px * camera.height_px)
        try:
            self.server = foxglove.start_server(
                name="skysim live",
                host=LOOPBACK_HOST,
                port=port,
                context=self.context,
                server_listener=Subscriptions(self, self.topics),
                message_backlog_size=min(max(frames, LEAST_BACKLOG), MOST_BACKLOG),
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
