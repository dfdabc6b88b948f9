"""One MCAP file being written: attachments and schemas first, then messages, each flush made durable."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from logs import schema


class LogFile:
    """Append only. `open` -> `message`s and `flush`es -> `close`. OSError: the disk."""

    def __init__(
        self,
        path: str | Path,
        attachments: Mapping[str, bytes],
        session: Mapping[str, str],
        channels: Iterable[schema.Channel] = schema.CHANNELS,
    ) -> None:
        """FileExistsError: recordings are never overwritten."""
        self.path = Path(path)
        self._stream = open(path, "xb")  # noqa: SIM115 (closed by close(); left open by a crash, as it should be)
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True)
        self._writer.start(profile=schema.PROFILE, library=schema.LIBRARY)
        # Monotonic stamps are moved to wall-clock time by one constant, so that viewers show when it happened.
        self._wall_minus_monotonic_ns = time.time_ns() - time.monotonic_ns()
        hashes = {f"sha256 {name}": hashlib.sha256(data).hexdigest() for name, data in attachments.items()}
        offset = {"wall_minus_monotonic_ns": str(self._wall_minus_monotonic_ns)}
        self._writer.add_metadata(schema.SESSION, {**session, **offset, **hashes})
        for name, data in attachments.items():
            now = time.time_ns()
            self._writer.add_attachment(now, now, name, _media_type(name), data)
        self._schemas: dict[str, int] = {"": 0}
        self._channels = {channel.topic: self._register(channel) for channel in channels}
        self._counts = dict.fromkeys(self._channels, 0)
        # The library writes schemas with the first chunk only: make this one now, and small.
        self.json(schema.HELLO, time.monotonic_ns(), dict(session))
        self.flush()

    def _register(self, channel: schema.Channel) -> int:
        if channel.schema_name not in self._schemas:
            self._schemas[channel.schema_name] = self._writer.register_schema(
                channel.schema_name, channel.schema_encoding, channel.schema_data
            )
        return self._writer.register_channel(channel.topic, channel.encoding, self._schemas[channel.schema_name])

    def message(self, channel: schema.Channel, t_ns: int, data: bytes) -> None:
        """Add a message of monotonic time `t_ns`."""
        time_ns = max(0, t_ns + self._wall_minus_monotonic_ns)
        topic = channel.topic
        self._writer.add_message(self._channels[topic], time_ns, data, time_ns, self._counts[topic])
        self._counts[topic] += 1

    def json(self, channel: schema.Channel, t_ns: int, value: Mapping[str, Any]) -> None:
        self.message(channel, t_ns, json.dumps(value).encode())

    def flush(self) -> None:
        """All messages so far survive the death of this process and of the machine."""
        self._writer.flush()
        os.fdatasync(self._stream.fileno())

    def close(self, end: Mapping[str, str]) -> None:
        """Write how the recording ended and the index; nothing can follow."""
        counts = {f"messages {topic}": str(count) for topic, count in self._counts.items()}
        self._writer.flush()
        self._writer.add_metadata(schema.END, {**end, **counts})
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()


def _media_type(name: str) -> str:
    types = {".json": "application/json", ".toml": "application/toml", ".urdf": "application/xml"}
    return types.get(Path(name).suffix, "application/octet-stream")
