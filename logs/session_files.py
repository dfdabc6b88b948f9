"""The files of one session: mostly one; with rotation one after the other, each complete in itself, and a manifest."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from logs import schema
from logs.log_file import LogFile


class SessionFiles:
    """Takes messages like a `LogFile`. OSError: the disk; the file of then is whole up to its last flush."""

    def __init__(
        self,
        path: Path,
        attachments: Mapping[str, bytes],
        session: Mapping[str, str],
        key: Ed25519PrivateKey | None = None,
        rotate_ns: int = 0,
        begin: Callable[[LogFile, int], None] = lambda log, t_ns: None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`rotate_ns`: length of one file, 0: no end. `begin`: writes what every file must have."""
        self._path, self._attachments, self._session, self._key = path, attachments, session, key
        self._rotate_ns, self._begin, self._clock = rotate_ns, begin, clock
        self._parts: list[dict[str, Any]] = []
        self._cycles = 0
        self.log = self._open()

    def _open(self) -> LogFile:
        number = len(self._parts) + 1
        path = self._path if number == 1 else part_path(self._path, number)
        own = {"part": str(number)}
        if self._parts:
            own |= {"recording": self._parts[0]["session_id"], "previous_sha256": self._parts[-1]["sha256"]}
        log = LogFile(path, self._attachments, {**self._session, **own}, key=self._key)
        self._opened_ns, self._first = self._clock(), self._cycles
        self._begin(log, self._opened_ns)
        return log

    def message(self, channel: schema.Channel, t_ns: int, data: bytes) -> None:
        self.messages(channel, (t_ns,), (data,))

    def messages(self, channel: schema.Channel, times: Sequence[int], contents: Sequence[bytes]) -> None:
        self.log.messages(channel, times, contents)
        self._cycles += len(contents) if channel is schema.CYCLE else 0

    def json(self, channel: schema.Channel, t_ns: int, value: Mapping[str, Any]) -> None:
        self.log.json(channel, t_ns, value)

    def attach(self, name: str, data: bytes) -> None:
        """An attachment of this file and of those to come."""
        self._attachments = {**self._attachments, name: data}
        self.log.attach(name, data)

    def flush(self) -> None:
        """Make all messages durable; begin the next file if this one is long enough."""
        self.log.flush()
        if self._rotate_ns and self._clock() - self._opened_ns >= self._rotate_ns:
            self.close({"reason": "rotated"})
            self.log = self._open()

    def close(self, end: Mapping[str, str]) -> None:
        self.log.close(end)
        self._parts.append(
            {
                "file": self.log.path.name,
                "session_id": self.log.session_id,
                "first_cycle": self._first,
                "cycles": self._cycles - self._first,
                "bytes": self.log.size,
                "sha256": self.log.sha256,
                "reason": end.get("reason", ""),
            }
        )
        if len(self._parts) > 1 or end.get("reason") == "rotated":
            self._write_manifest()

    def _write_manifest(self) -> None:
        """Whole or not at all."""
        path = manifest_path(self._path)
        made = path.with_suffix(".new")
        made.write_text(json.dumps({"parts": self._parts}, indent=1) + "\n")
        os.replace(made, path)


def part_path(first: Path, number: int) -> Path:
    """The file of part `number`, 2 and on, of the session that begins in `first`."""
    return first.with_name(f"{first.stem}.part{number}.mcap")


def manifest_path(first: Path) -> Path:
    """Beside the first file of a session."""
    return first.with_name(f"{first.stem}.manifest.json")
