"""Close a recording that a crash left open: `asc recover`.

The complete records of the file stay as they are, byte for byte, so that every seal holds; only a record that was cut
by the crash is left out. What the session's ring in shared memory still holds, and the file does not, is added: so not
one complete cycle is lost, whether the controller, the logger or both were killed.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from mcap.records import Attachment, AttachmentIndex, Channel, Chunk, ChunkIndex, MessageIndex, MetadataIndex, Schema
from mcap.records import Metadata as MetadataRecord

from asc_rt import ring
from logs import mcap_scan, schema, seal
from logs.mcap_scan import Bytes, Extent, LogError, Op, Raw
from logs.mcap_writer import Appender, Index, McapWriter, message_index
from logs.reader import Log, open_log

COPY_SIZE = 16 << 20


@dataclass(frozen=True, slots=True)
class Recovery:
    records: int  # complete MCAP records taken over
    cycles: int  # in the new file
    cycles_from_ring: int
    bytes_cut: int
    seals: int
    seals_valid: bool  # all that there are; False: the session was not sealed
    log: str

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def recover(
    source: Path, target: Path, ring_path: Path | None = None, key: Ed25519PrivateKey | None = None
) -> Recovery:
    """Write the closed recording to `target`. `key`: seals the end too, if it is the key that the session had.

    LogError: `source` is damaged or foreign; RingError: the ring; FileExistsError: `target` is never overwritten.
    """
    log = open_log(source)
    data = log.data
    if not log.truncated and ring_path is None:
        raise LogError(f"{source}: was closed in good order: there is nothing to recover")
    size = log.extent.data_bytes
    _copy(data, size, target)
    index, records = _index(data, str(source), size)
    writer = McapWriter(Appender(target, 0, memoryview(data)[:size]), index)
    _complete_last_chunk(writer, data, str(source))
    rescued = _add_rings(writer, log, ring_path) if ring_path is not None else 0
    cut = len(data) - size if log.truncated else 0
    _close(writer, log, cut, rescued, key)
    made = open_log(target)
    return Recovery(records, made.cycles, rescued, cut, made.seals.count, bool(made.seals.public_key), str(target))


def _copy(data: Bytes, size: int, target: Path) -> None:
    with open(target, "xb") as file:
        for start in range(0, size, COPY_SIZE):
            file.write(data[start : min(start + COPY_SIZE, size)])


# --- what is there ---------------------------------------------------------------------------------------------------


def _index(data: Bytes, name: str, size: int) -> tuple[Index, int]:
    """The summary that the file would have, and the number of its records."""
    index, records = Index(), 0
    for raw in mcap_scan.frames(data, name, Extent()):
        if raw.end > size:
            break
        records += 1
        if raw.op == Op.CHUNK:
            _index_chunk(index, data, name, raw)
        elif raw.op == Op.MESSAGE_INDEX:
            found: MessageIndex = mcap_scan.parse(MessageIndex, data, name, raw)
            index.chunks[-1].message_index_offsets[found.channel_id] = raw.start
            index.chunks[-1].message_index_length += raw.end - raw.start
        elif raw.op == Op.ATTACHMENT:
            a: Attachment = mcap_scan.parse(Attachment, data, name, raw)
            length = raw.end - raw.start
            index.attachments.append(
                AttachmentIndex(raw.start, length, a.log_time, a.create_time, len(a.data), a.name, a.media_type)
            )
        elif raw.op == Op.METADATA:
            found_name = mcap_scan.parse(MetadataRecord, data, name, raw).name
            index.metadata.append(MetadataIndex(raw.start, raw.end - raw.start, found_name))
    return index, records


def _index_chunk(index: Index, data: Bytes, name: str, raw: Raw) -> None:
    chunk: Chunk = mcap_scan.parse(Chunk, data, name, raw)
    index.chunks.append(
        ChunkIndex(
            chunk_start_offset=raw.start, chunk_length=raw.end - raw.start, compression=chunk.compression,
            compressed_size=len(chunk.data), uncompressed_size=chunk.uncompressed_size,
            message_start_time=chunk.message_start_time, message_end_time=chunk.message_end_time,
            message_index_offsets={}, message_index_length=0,
        )
    )  # fmt: skip
    content = mcap_scan.chunk_data(data, name, raw)
    for inner in mcap_scan.chunk_records(content, name):
        if inner.op == Op.SCHEMA:
            found = mcap_scan.parse(Schema, content, name, inner)
            index.schemas[found.id] = found
        elif inner.op == Op.CHANNEL:
            channel = mcap_scan.parse(Channel, content, name, inner)
            index.channels[channel.id] = channel
        elif inner.op == Op.MESSAGE:
            number = mcap_scan.message_channel(content, inner)
            index.counts[number] = index.counts.get(number, 0) + 1


def _complete_last_chunk(writer: McapWriter, data: Bytes, name: str) -> None:
    """A crash can fall between a chunk and its message indexes, without which some readers skip it."""
    if not writer.index.chunks:
        return
    last = writer.index.chunks[-1]
    start = last.chunk_start_offset
    content = mcap_scan.chunk_data(data, name, Raw(Op.CHUNK, start, start + 9, start + last.chunk_length))
    entries: dict[int, list[int]] = {}
    for inner in mcap_scan.chunk_records(content, name):
        if inner.op == Op.MESSAGE:
            message = mcap_scan.message(content, inner)
            entries.setdefault(message.channel, []).extend((message.log_time_ns, inner.start))
    for channel in entries.keys() - last.message_index_offsets.keys():
        record = message_index(channel, entries[channel])
        last.message_index_offsets[channel] = writer.file.size
        last.message_index_length += len(record)
        writer.file.append(record)


# --- what is added ---------------------------------------------------------------------------------------------------


def _add_rings(writer: McapWriter, log: Log, path: Path) -> int:
    """Messages for all that the rings hold and the file does not; the number of cycles added."""
    layout, wall = log.layout, log.wall_minus_monotonic_ns
    newest = int(np.frombuffer(log.record(log.cycles - 1), layout.dtype)["inputs.tick"][0]) if log.cycles else -1
    cycles = _Adder(writer, schema.CYCLE)
    for payload in _held(path):
        if len(payload) != layout.size:
            raise ring.RingError(f"{path}: made for another record", hint="give the ring of this session")
        record = layout.sealed(payload)
        row = np.frombuffer(record, layout.dtype)[0]
        if int(row["inputs.tick"]) > newest:
            cycles.add(int(row["inputs.t_ns"]) + wall, record)
    channels = {"rx": _Adder(writer, schema.WIRE_RX), "tx": _Adder(writer, schema.WIRE_TX)}
    last_ns = max((m.t_ns for m in log.messages(schema.WIRE_RX.topic, schema.WIRE_TX.topic)), default=-1)
    for payload in _held(ring.wire_path(path)):
        direction, t_ns, length, content = ring.parse_wire(payload)
        if t_ns > last_ns:
            channels[direction].add(t_ns + wall, schema.wire_message(t_ns, length, content))
    writer.flush()
    return cycles.count


def _held(path: Path) -> Iterator[memoryview]:
    with ring.RingWatcher(path) as watcher:
        yield from watcher.new()


class _Adder:
    """Adds messages to a channel of the file, which it makes if the crash came before it."""

    def __init__(self, writer: McapWriter, channel: schema.Channel) -> None:
        self._writer, self.count = writer, 0
        known = {found.topic: number for number, found in writer.index.channels.items()}
        if channel.topic not in known:
            made = writer.schema(channel.schema_name, channel.schema_encoding, channel.schema_data)
            known[channel.topic] = writer.channel(channel.topic, channel.encoding, made)
        self._channel = known[channel.topic]
        self._sequence = writer.index.counts.get(self._channel, 0)

    def add(self, t_ns: int, data: bytes) -> None:
        self._writer.messages(self._channel, self._sequence + self.count, (t_ns,), (data,))
        self.count += 1


def _close(writer: McapWriter, log: Log, cut: int, rescued: int, key: Ed25519PrivateKey | None) -> None:
    told = {
        "bytes_cut": str(cut),
        "sealed_bytes": str(log.seals.sealed_bytes),
        "cycles_from_ring": str(rescued),
        "time": str(time.time_ns()),
        "host": os.uname().nodename,
    }
    writer.metadata(schema.RECOVERED, told)
    ours = key is not None and seal.raw_hex(key.public_key()) == log.seals.public_key and not log.seals.final
    if key is not None and ours:
        sealer = seal.Sealer(key, log.seals.session, log.seals.count)
        writer.metadata(*sealer.seal(writer.file.size, writer.file.sha.hexdigest(), final=True))
    target = writer.finish()
    if key is not None and ours:
        seal.sign_file(target, key, log.seals.session, writer.file.size, writer.file.sha.hexdigest())
