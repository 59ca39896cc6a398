"""Recordings: MCAP files, mostly JSON messages with Foxglove's schema names, for Foxglove and Rerun.

Written as FILE.part and renamed when complete. After a kill or on a full disk, FILE.part can be read except for its
last FLUSH_S seconds. Needs the extra `record`.
"""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from protocol.errors import ConfigError
from protocol.files import sync_folder

FLUSH_S = 10.0  # interval of flushes: the most a kill loses
MOST_BYTES = 2**28  # bound of a record, against damaged lengths
MOST_TOPICS = 2**16 - 2  # MCAP numbers topics with 16 bits
MSGPACK = ""  # schema of wire messages


class Message(NamedTuple):
    """One message. log_ns: when recorded; stamp_ns: when true."""

    topic: str
    schema: str
    log_ns: int
    stamp_ns: int
    data: bytes


def time_of(stamp_ns: int) -> dict[str, int]:
    """A stamp as in Foxglove."""
    return dict(zip(("sec", "nsec"), divmod(stamp_ns, 10**9), strict=True))


class Recording:
    """A file being written. counts: messages by topic. excluded: beyond MOST_TOPICS."""

    def __init__(self, path: Path, about: Mapping[str, str], clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with metadata `about`. ConfigError if an interrupted recording has this name; OSError."""
        from mcap.writer import Writer

        self.path, self.part = path, path.with_name(f"{path.name}.part")
        self.counts: Counter[str] = Counter()
        self.excluded = 0
        self._clock, self._flush_s = clock, clock() + FLUSH_S
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {MSGPACK: 0}
        try:
            self._file = self.part.open("xb")
        except FileExistsError:
            problem = "an interrupted recording: it can be read under this name; move it away to record anew"
            raise ConfigError(self.part, problem) from None
        writer: Any = Writer
        self._writer = writer(self._file)
        with self._named():
            self._writer.start(library="sitegrid")
            self._writer.add_metadata("sitegrid", dict(about))

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self._file.tell()

    def write(self, message: Message, properties: Mapping[str, Any]) -> None:
        """Add a message; properties: JSON Schema of its schema. OSError on a full disk."""
        channel = self._channels.get(message[:2])
        if not channel and len(self._channels) == MOST_TOPICS:
            self.excluded += 1
            return
        with self._named():
            channel = channel or self._channel(message.topic, message.schema, properties)
            self._writer.add_message(channel, message.log_ns, message.data, message.stamp_ns)
        self.counts[message.topic] += 1

    def tend(self) -> None:
        """Flush if due; call it every second."""
        if self._clock() >= self._flush_s:
            self._flush_s = self._clock() + FLUSH_S
            with self._named():
                self._writer.flush()

    def finish(self) -> None:
        """Complete and rename the file."""
        with self._named():
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self.part.replace(self.path)
            sync_folder(self.path.parent)

    def abandon(self) -> None:
        """Leave FILE.part."""
        with suppress(OSError):
            self._file.close()

    def _channel(self, topic: str, schema: str, properties: Mapping[str, Any]) -> int:
        if schema not in self._schemas:
            text = json.dumps({"title": schema, "type": "object", "properties": properties})
            self._schemas[schema] = self._writer.register_schema(schema, "jsonschema", text.encode())
        number: int = self._writer.register_channel(topic, "json" if schema else "msgpack", self._schemas[schema])
        self._channels[topic, schema] = number
        return number

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Add the file name to errors of a full disk."""
        try:
            yield
        except OSError as error:
            raise OSError(error.errno, error.strerror or str(error), str(self.part)) from None


@dataclass
class RecordedFile:
    """A recording being read, maybe interrupted. is_cut: whether it was, known at its end."""

    path: Path
    is_cut: bool = field(default=False, init=False)

    def messages(self) -> Iterator[Message]:
        """Messages as recorded; ConfigError if damaged or no recording."""
        from mcap.records import Channel, Schema
        from mcap.records import Message as Record
        from mcap.stream_reader import StreamReader

        schemas, channels, is_begun = {0: ""}, dict[int, tuple[str, str]](), False
        with self.path.open("rb") as file:
            try:
                for record in StreamReader(file, validate_crcs=True, record_size_limit=MOST_BYTES).records:
                    is_begun = True
                    if isinstance(record, Record):
                        yield Message(*channels[record.channel_id], record.log_time, record.publish_time, record.data)
                    elif isinstance(record, Channel):
                        channels[record.id] = record.topic, schemas[record.schema_id]
                    elif isinstance(record, Schema):
                        schemas[record.id] = record.name
            except OSError:
                raise
            except Exception as error:  # the library and Python have an error per kind of damage
                self.is_cut = is_begun and not file.read(1)
                if not self.is_cut:
                    raise ConfigError(self.path, f"no MCAP file, or damaged: {error or type(error).__name__}") from None
