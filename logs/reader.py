"""Open a recording: every checksum and seal checked, cycles by number, messages by topic.

    log = open_log("runs/x.mcap")
    log.params, log.session, log.attachments["cell.toml"]
    for batch in log.batches(): batch["outputs.decision.d_measured"]     # structured arrays, in order
    for topic, t_ns, data in log.messages("/sim/truth"): ...

A session that crashed leaves a file that just stops: all complete records of it are read, and `log.truncated` says so.
Damage is an error. The file is mapped, never loaded: memory does not grow with its length.
"""

from __future__ import annotations

import bisect
import collections
import copy
import functools
import hashlib
import itertools
import json
import mmap
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema

from asc_rt.core.params import Params
from asc_rt.record import RecordLayout
from logs import mcap_scan, schema
from logs.mcap_scan import CorruptLog, Extent, ForeignFile, LogError, Op, Raw
from logs.seal import PREFIX as SEAL_PREFIX
from logs.seal import Seals

__all__ = ["CorruptLog", "ForeignFile", "Log", "LogError", "LogMessage", "open_log", "records"]

Records = np.ndarray[Any, np.dtype[np.void]]
Progress = Callable[[Iterable[int]], Iterable[int]]  # like tqdm
Visitor = Callable[["Log", str, list[bytes]], None]
"""Meets every chunk's messages of each topic while the file is checked: to read an hour twice takes twice as long."""

MEGABYTE = 1 << 20
_CHUNK, _ATTACHMENT, _METADATA = int(Op.CHUNK), int(Op.ATTACHMENT), int(Op.METADATA)  # comparing with an enum is slow


class LogMessage(NamedTuple):
    topic: str
    t_ns: int  # monotonic time of the recording machine
    data: bytes


@dataclass(frozen=True, slots=True)
class _ChunkRef:
    raw: Raw
    first: int  # number of the first cycle in it
    cycles: int
    channels: frozenset[int]  # that have messages in it


class Log:
    """A recording. Made by `open_log`."""

    def __init__(self, path: Path, data: mmap.mmap, visit: Visitor | None = None, progress: Progress = iter) -> None:
        self.path, self.data, self._name = path, data, str(path)
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.extent = Extent()
        self.seals = Seals(self._name)
        self._topics: dict[int, str] = {}
        self._schemas: dict[int, Schema] = {}
        self._cycle_channel = -1
        self._chunks: list[_ChunkRef] = []
        self.cycles = 0
        self._content = functools.lru_cache(4)(self._uncached_content)
        self._cycle_data = functools.lru_cache(4)(self._uncached_cycle_data)
        self._visit = visit
        self._scan(progress)
        self.params = self._load_params(schema.DECIDED if schema.DECIDED in self.attachments else schema.PARAMS)
        self.layout  # noqa: B018 - a recording without cycles must have one, too
        try:
            self.wall_minus_monotonic_ns = int(self.session["wall_minus_monotonic_ns"])
        except (KeyError, ValueError) as error:
            raise CorruptLog(f"{self._name}: damaged: its session metadata tell no clock") from error

    @functools.cached_property
    def layout(self) -> RecordLayout:
        """Of its cycle records. The parameters are written before the first of them."""
        return RecordLayout(self._load_params(schema.PARAMS).n)

    @property
    def truncated(self) -> bool:
        """The file was not closed: it holds all complete records up to `extent.complete_bytes`."""
        return not self.extent.closed

    @property
    def session(self) -> dict[str, str]:
        return self.metadata.get(schema.SESSION, {})

    @property
    def end(self) -> dict[str, str]:
        """What the logger wrote when it closed the file; empty: it did not."""
        return self.metadata.get(schema.END, {})

    @property
    def recovered(self) -> dict[str, str]:
        """What `asc recover` told when it closed the file; empty: the logger closed it, or nobody."""
        return self.metadata.get(schema.RECOVERED, {})

    @property
    def fingerprint(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.attachments.get(schema.FINGERPRINT, b"{}"))
        return found

    def record(self, index: int) -> bytes:
        """The bytes of cycle record `index`, counted from 0 in the order of the file."""
        if not 0 <= index < self.cycles:
            raise IndexError(index)
        chunk = self._chunks[bisect.bisect_right(self._chunks, index, key=lambda c: c.first) - 1]
        return self._cycle_data(chunk)[index - chunk.first]

    def batches(self) -> Iterator[Records]:
        """All cycle records in order, as structured arrays of a chunk each."""
        for chunk in self._chunks:
            if chunk.cycles:
                yield np.frombuffer(b"".join(self._cycle_data(chunk)), self.layout.dtype)

    @property
    def chunks_with_cycles(self) -> int:
        """As many as `batches` gives."""
        return sum(chunk.cycles > 0 for chunk in self._chunks)

    def columns(self, *paths: str) -> dict[str, np.ndarray[Any, Any]]:
        """Some fields of all cycles: path -> one array. Their copy is all that stays in memory."""
        parts = [{path: batch[path].copy() for path in paths} for batch in self.batches()]
        if not parts:
            return {path: np.zeros(0, self.layout.dtype[path]) for path in paths}
        return {path: np.concatenate([part[path] for part in parts]) for path in paths}

    def excerpt(self, first: int, stop: int) -> Log:
        """The same recording as if it held only the chunks with the cycles `first` to `stop` - 1."""
        found, near = copy.copy(self), [c for c in self._chunks if c.first < stop and c.first + c.cycles >= first]
        found._chunks = [replace(chunk, first=chunk.first - near[0].first) for chunk in near]
        found.cycles = sum(chunk.cycles for chunk in near)
        return found

    @property
    def topics(self) -> frozenset[str]:
        return frozenset(self._topics.values())

    def messages(self, *topics: str) -> Iterator[LogMessage]:
        """The messages of some topics, in the order of the file."""
        wanted = {channel: topic for channel, topic in self._topics.items() if topic in topics}
        for chunk in self._chunks:
            if chunk.channels.isdisjoint(wanted):
                continue
            for found in mcap_scan.messages(self._content(chunk.raw), wanted):
                t_ns = found.log_time_ns - self.wall_minus_monotonic_ns
                yield LogMessage(wanted[found.channel], t_ns, found.data)

    def _uncached_content(self, raw: Raw) -> bytes:
        return mcap_scan.chunk_data(self.data, self._name, raw)

    def _uncached_cycle_data(self, chunk: _ChunkRef) -> list[bytes]:
        return [m.data for m in mcap_scan.messages(self._content(chunk.raw), (self._cycle_channel,))]

    # --- opening -----------------------------------------------------------------------------------------------------

    def _scan(self, progress: Progress) -> None:
        data, name, sha, hashed = self.data, self._name, hashlib.sha256(), 0
        view = memoryview(data)  # without seals all of it is hashed at once: not copied for that
        left = iter(progress(range(len(data) // MEGABYTE)))
        done = 0
        for raw in mcap_scan.frames(data, name, self.extent):
            if raw.op == _CHUNK:
                self._scan_chunk(raw)
            elif raw.op == _ATTACHMENT:
                attachment = mcap_scan.parse(Attachment, data, name, raw)
                self.attachments[attachment.name] = attachment.data
            elif raw.op == _METADATA:
                sha.update(view[hashed : raw.start])
                hashed = raw.start
                metadata = mcap_scan.parse(Metadata, data, name, raw)
                self._meet_metadata(metadata, raw.start, sha.hexdigest())
            while done < raw.end // MEGABYTE:
                done += 1
                next(left, None)
        collections.deque(left, 0)  # so that a bar ends full
        self.seals.finish(self.extent.closed, bool(self.recovered))
        if self._cycle_channel < 0 and (self.extent.closed or self._chunks):
            raise ForeignFile(f"{name}: an MCAP file, but no recording of a cell (no {schema.CYCLE.topic})")

    def _meet_metadata(self, found: Metadata, at: int, sha256: str) -> None:
        """`sha256`: of the bytes before it."""
        if found.name.startswith(SEAL_PREFIX):
            self.seals.check(found.metadata, at, sha256)
        elif found.name in self.metadata:
            raise CorruptLog(f"{self._name}: altered at byte {at}: its metadata {found.name!r} are there twice")
        else:
            self.metadata[found.name] = found.metadata
            if found.name == schema.SESSION:
                self.seals.begin(found.metadata)

    def _scan_chunk(self, chunk: Raw) -> None:
        content = self._content(chunk)
        found: dict[int, list[bytes]] = {}
        for raw in mcap_scan.chunk_records(content, self._name):
            if raw.op == mcap_scan.MESSAGE:
                message = mcap_scan.message(content, raw)
                found.setdefault(message.channel, []).append(message.data)
            elif raw.op == Op.SCHEMA:
                told = mcap_scan.parse(Schema, content, self._name, raw)
                self._schemas[told.id] = told
            elif raw.op == Op.CHANNEL:
                self._meet(mcap_scan.parse(Channel, content, self._name, raw))
        records = found.get(self._cycle_channel, [])
        if any(len(data) != self.layout.size for data in records):
            raise CorruptLog(f"{self._name}: damaged at byte {chunk.start}: a cycle record of the wrong size")
        self._chunks.append(_ChunkRef(chunk, self.cycles, len(records), frozenset(found)))
        self.cycles += len(records)
        if self._visit is not None:
            for channel, messages in found.items():
                self._visit(self, self._topics.get(channel, ""), messages)

    def _meet(self, channel: Channel) -> None:
        self._topics[channel.id] = channel.topic
        if channel.topic != schema.CYCLE.topic:
            return
        found = self._schemas.get(channel.schema_id)
        if found is None or found.data != schema.CYCLE.schema_data:
            raise ForeignFile(
                f"{self._name}: its cycle records have another schema: read it with the code that wrote it"
            )
        self._cycle_channel = channel.id

    def _load_params(self, name: str) -> Params:
        if schema.PARAMS not in self.attachments:
            raise ForeignFile(
                f"{self._name}: no {schema.PARAMS} in it: not a recording, or cut off before its first cycle"
            )
        try:
            return Params.from_canonical(self.attachments[name])
        except (ValueError, TypeError, KeyError) as error:
            raise ForeignFile(f"{self._name}: {name} is of another version: {error}") from error


def open_log(path: str | Path, visit: Visitor | None = None, progress: Progress = iter) -> Log:
    """Map and check the whole file. `visit` meets the messages on the way; `progress` goes over the megabytes.

    LogError: not readable, foreign, damaged.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            if file.seek(0, 2) == 0:
                raise ForeignFile(f"{path}: empty")
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error
    return Log(path, data, visit, progress)


def records(path: str | Path) -> Records:
    """All cycle records of a short recording as one structured array."""
    log = open_log(path)
    return np.frombuffer(b"".join(itertools.chain.from_iterable(log.batches())), log.layout.dtype)
