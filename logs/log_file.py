"""One MCAP file being written: attachments and schemas first, then messages and seals; each flush is durable."""

from __future__ import annotations

import hashlib
import json
import os
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from logs import schema, seal
from logs.mcap_writer import Appender, McapWriter

SEAL_NS = 1_000_000_000


class LogFile:
    """Append only. `open` -> `message`s and `flush`es -> `close`. OSError: the disk."""

    def __init__(
        self,
        path: str | Path,
        attachments: Mapping[str, bytes],
        session: Mapping[str, str],
        channels: Iterable[schema.Channel] = schema.CHANNELS,
        key: Ed25519PrivateKey | None = None,
    ) -> None:
        """`key`: signs the seals; None: no seals. FileExistsError: recordings are never overwritten."""
        self.path, self.session_id = Path(path), uuid.uuid4().hex
        self._key = key
        self._sealer = None if key is None else seal.Sealer(key, self.session_id)
        self._file = Appender(self.path, os.O_CREAT | os.O_EXCL)
        self._writer = McapWriter(self._file)
        self._writer.start(profile=schema.PROFILE, library=schema.LIBRARY)
        # Monotonic stamps are moved to wall-clock time by one constant, so that viewers show when it happened.
        self._wall_minus_monotonic_ns = time.time_ns() - time.monotonic_ns()
        self._write_head(attachments, session)
        self._schemas: dict[str, int] = {"": 0}
        self._channels = {channel.topic: self._register(channel) for channel in channels}
        self._counts = dict.fromkeys(self._channels, 0)
        # Schemas are written with the first chunk: make this one now, and small.
        self.json(schema.HELLO, time.monotonic_ns(), dict(session))
        self._next_seal_ns = 0
        self.flush()

    def _write_head(self, attachments: Mapping[str, bytes], session: Mapping[str, str]) -> None:
        hashes = {f"sha256 {name}": hashlib.sha256(data).hexdigest() for name, data in attachments.items()}
        own = {"wall_minus_monotonic_ns": str(self._wall_minus_monotonic_ns), seal.SESSION_ID: self.session_id}
        if self._key is not None:
            own[seal.PUBLIC_KEY] = seal.raw_hex(self._key.public_key())
        self._writer.metadata(schema.SESSION, {**session, **own, **hashes})
        for name, data in attachments.items():
            self._writer.attachment(time.time_ns(), name, _media_type(name), data)

    def attach(self, name: str, data: bytes) -> None:
        """One more attachment, of what was not known at the beginning."""
        now = self.wall_ns(time.monotonic_ns())
        self._writer.attachment(now, name, _media_type(name), data)

    def _register(self, channel: schema.Channel) -> int:
        if channel.schema_name not in self._schemas:
            self._schemas[channel.schema_name] = self._writer.schema(
                channel.schema_name, channel.schema_encoding, channel.schema_data
            )
        return self._writer.channel(channel.topic, channel.encoding, self._schemas[channel.schema_name])

    @property
    def sha256(self) -> str:
        """Of all bytes in the file."""
        return self._file.sha.hexdigest()

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.size

    def message(self, channel: schema.Channel, t_ns: int, data: bytes) -> None:
        """Add a message of monotonic time `t_ns`; a channel that is new begins with it."""
        self.messages(channel, (t_ns,), (data,))

    def messages(self, channel: schema.Channel, times: Sequence[int], contents: Sequence[bytes]) -> None:
        """Add messages, at least one, each with its monotonic time."""
        topic = channel.topic
        if topic not in self._channels:
            self._channels[topic], self._counts[topic] = self._register(channel), 0
        first, self._counts[topic] = self._counts[topic], self._counts[topic] + len(contents)
        offset = self._wall_minus_monotonic_ns
        wall = [t_ns + offset if t_ns > -offset else 0 for t_ns in times]
        self._writer.messages(self._channels[topic], first, wall, contents)

    def wall_ns(self, t_ns: int) -> int:
        """Wall-clock time of the monotonic time `t_ns`, as the file has it."""
        return max(0, t_ns + self._wall_minus_monotonic_ns)

    def json(self, channel: schema.Channel, t_ns: int, value: Mapping[str, Any]) -> None:
        self.message(channel, t_ns, json.dumps(value).encode())

    def flush(self) -> None:
        """All messages so far survive the death of this process and of the machine; about each second they are
        sealed."""
        self._writer.flush()
        now_ns = time.monotonic_ns()
        if now_ns >= self._next_seal_ns:
            self._seal()
            self._next_seal_ns = now_ns + SEAL_NS
        self._file.sync()

    def _seal(self, final: bool = False) -> None:
        if self._sealer is not None:
            self._writer.metadata(*self._sealer.seal(self._file.size, self.sha256, final))

    def close(self, end: Mapping[str, str]) -> None:
        """Write how the recording ended, the last seal and the index; nothing can follow."""
        self._file.release()
        self._writer.flush()
        counts = {f"messages {topic}": str(count) for topic, count in self._counts.items()}
        self._writer.metadata(schema.END, {**end, **counts})
        self._seal(final=True)
        self._writer.finish()
        if self._key is not None:
            seal.sign_file(self.path, self._key, self.session_id, self.size, self.sha256)

    def abandon(self) -> None:
        """The disk takes nothing more: leave the file as a crash would, whole up to its last record."""
        self._file.close()

    def forget(self) -> None:
        """Throw away the messages that could not be written."""
        self._writer.forget()


def _media_type(name: str) -> str:
    types = {".json": "application/json", ".toml": "application/toml", ".urdf": "application/xml", ".txt": "text/plain"}
    return types.get(Path(name).suffix, "application/octet-stream")
