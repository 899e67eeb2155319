"""Outputs of ROS 2 messages: a file of MCAP, and the server of Foxglove."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from pathlib import Path

import foxglove
from mcap.writer import Writer

from skysim.apps.live.packets import Packet
from skysim.apps.live.ros_messages import RosEncoder
from skysim.apps.live.sinks import Sink
from skysim.core import files
from skysim.core.errors import InputError, printable

LOOPBACK_HOST = "127.0.0.1"
MOST_WAITING = 64  # messages for a slow client of Foxglove, each of which may be a frame


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
        self.whole_bytes = self.file.tell()
        self.chunk = Counter[str]()  # packets of the next one

    def record(self, packet: Packet) -> None:
        """Add a packet. Raises OSError."""
        with files.name_in_errors(self.path):
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
            self.fault = f"{self.path}: {error.strerror}"
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
                host=LOOPBACK_HOST,
                port=port,
                context=self.context,
                message_backlog_size=MOST_WAITING,
            )
        except Exception as error:
            problem = printable(f"cannot listen on {LOOPBACK_HOST}:{port}: {error}")
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
