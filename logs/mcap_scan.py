"""The records of an MCAP file, one by one, with every checksum checked. Knows the format, nothing of this program.

Written here because the library's readers skip checks (attachments, summary) and take a cut record for a whole one.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Container, Iterator
from dataclasses import dataclass
from enum import IntEnum
from io import BytesIO
from mmap import mmap
from typing import Any, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK = 256 << 20  # bytes of one uncompressed chunk; more is damage, not data
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")

Bytes = bytes | mmap


class LogError(Exception):
    """A file that cannot be read as a recording. The message is one line with file, place and what is wrong."""


class ForeignFile(LogError):
    """Not a recording of this program."""


class CorruptLog(LogError):
    """A recording that has been damaged or altered."""


class Op(IntEnum):
    HEADER = 1
    FOOTER = 2
    SCHEMA = 3
    CHANNEL = 4
    MESSAGE = 5
    CHUNK = 6
    MESSAGE_INDEX = 7
    CHUNK_INDEX = 8
    ATTACHMENT = 9
    ATTACHMENT_INDEX = 10
    STATISTICS = 11
    METADATA = 12
    METADATA_INDEX = 13
    SUMMARY_OFFSET = 14
    DATA_END = 15


_OPS = frozenset(map(int, Op))
_SUMMED = 1 << 20  # bytes of many records that go into the checksum at once
MESSAGE, DATA_END, ATTACHMENT = int(Op.MESSAGE), int(Op.DATA_END), int(Op.ATTACHMENT)  # comparing with an enum is slow


class Raw(NamedTuple):
    op: int
    start: int  # offset of the record
    body: int  # offset of its content
    end: int


class RawMessage(NamedTuple):
    channel: int
    sequence: int
    log_time_ns: int
    data: bytes


@dataclass(slots=True)
class Extent:
    """How far a file is whole."""

    complete_bytes: int = len(MAGIC)  # up to here every record is complete
    data_bytes: int = len(MAGIC)  # the same without index and footer
    closed: bool = False  # the file was closed: index, footer and all checksums are right


def frames(data: Bytes, name: str, extent: Extent) -> Iterator[Raw]:
    """All complete records of the data section, each checked; `extent` says afterwards where and how it ended.

    A file that just stops is a crashed session: all that is complete is given. CorruptLog: a checksum or a length is
    wrong. ForeignFile: not MCAP.
    """
    if data[: len(MAGIC)] != MAGIC:
        raise ForeignFile(f"{name}: not an MCAP file")
    size, at, crc, summed = len(data), len(MAGIC), zlib.crc32(MAGIC), len(MAGIC)
    ends_closed = size >= 2 * len(MAGIC) and data[size - len(MAGIC) :] == MAGIC
    while True:
        raw = _frame(data, name, at)
        if raw is None:
            if ends_closed:  # the end is there, so this is damage and not a crash
                raise CorruptLog(f"{name}: damaged at byte {at}: a record reaches beyond the end of the file")
            return
        if raw.op == DATA_END:
            _check_end(data, name, raw, zlib.crc32(data[summed:at], crc), extent, ends_closed)
            return
        if raw.op == ATTACHMENT:
            _check_attachment(data, name, raw)
        yield raw
        at = extent.complete_bytes = extent.data_bytes = raw.end
        if at - summed > _SUMMED:
            crc, summed = zlib.crc32(data[summed:at], crc), at


def _frame(data: Bytes, name: str, at: int) -> Raw | None:
    """The record at `at`; None: it is not all there."""
    if at + _HEAD.size > len(data):
        return None
    op, length = _HEAD.unpack_from(data, at)
    if op not in _OPS:
        raise CorruptLog(f"{name}: damaged at byte {at}: no record begins here")
    body = at + _HEAD.size
    return Raw(op, at, body, body + length) if body + length <= len(data) else None


def _check_end(data: Bytes, name: str, end: Raw, crc: int, extent: Extent, ends_closed: bool) -> None:
    """DataEnd, summary, footer, magic: each with its checksum; an end that is cut off is a crash while closing."""
    (told,) = struct.unpack_from("<I", data, end.body) if end.end - end.body == 4 else (0,)
    if told != crc:
        raise CorruptLog(f"{name}: damaged: the checksum of the data (bytes 0 to {end.start}) is wrong")
    if not ends_closed:
        return
    footer = len(data) - len(MAGIC) - 20 - _HEAD.size
    if footer < end.end or data[footer : footer + _HEAD.size] != _HEAD.pack(Op.FOOTER, 20):
        raise CorruptLog(f"{name}: damaged: no footer where it should be")
    start, _, summary_crc = struct.unpack_from("<QQI", data, footer + _HEAD.size)
    if start != end.end or zlib.crc32(data[start : len(data) - len(MAGIC) - 4]) != summary_crc:
        raise CorruptLog(f"{name}: damaged: the checksum of the summary (from byte {end.end}) is wrong")
    extent.complete_bytes, extent.closed = len(data), True


def _check_attachment(data: Bytes, name: str, raw: Raw) -> None:
    content, told = data[raw.body : raw.end - 4], data[raw.end - 4 : raw.end]
    if raw.end - raw.body < 4 or zlib.crc32(content) != int.from_bytes(told, "little"):
        raise CorruptLog(f"{name}: damaged at byte {raw.start}: the checksum of an attachment is wrong")


def parse(kind: Any, data: Bytes, name: str, raw: Raw) -> Any:
    """A record of the class `kind` of mcap.records. CorruptLog: it is not one."""
    try:
        return kind.read(ReadDataStream(BytesIO(data[raw.body : raw.end])))
    except (struct.error, UnicodeDecodeError, McapError, OverflowError) as error:
        raise CorruptLog(f"{name}: damaged at byte {raw.start}: no {kind.__name__}") from error


def chunk_data(data: Bytes, name: str, raw: Raw) -> bytes:
    """The content of a chunk, uncompressed and checked."""
    broken = CorruptLog(f"{name}: damaged at byte {raw.start}: the checksum of a chunk is wrong")
    try:
        compression, size, crc, content = _chunk_fields(data[raw.body : raw.end])
    except struct.error as error:
        raise CorruptLog(f"{name}: damaged at byte {raw.start}: no Chunk") from error
    if size > MAX_CHUNK or compression not in (b"", b"zstd"):
        raise broken
    if compression:
        try:
            if zstandard.frame_content_size(content) != size:  # believed, it could ask for any memory
                raise broken
            content = _DECOMPRESSOR.decompress(content, max_output_size=size)
        except zstandard.ZstdError as error:
            raise broken from error
    if len(content) != size or zlib.crc32(content) != crc:
        raise broken
    return content


_DECOMPRESSOR = zstandard.ZstdDecompressor()
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, CRC, length of the compression's name
_LENGTH = struct.Struct("<Q")


def _chunk_fields(body: bytes) -> tuple[bytes, int, int, bytes]:
    """Compression, size and CRC of the content, content as it is. Written out: an hour of recording has 72 000 chunks.

    struct.error: no chunk.
    """
    _, _, size, crc, named = _CHUNK.unpack_from(body)
    at = _CHUNK.size + named
    (length,) = _LENGTH.unpack_from(body, at)
    content = body[at + _LENGTH.size :]
    if length != len(content):
        raise struct.error(f"{length} bytes promised, {len(content)} there")
    return body[_CHUNK.size : at], size, crc, content


def chunk_records(content: bytes, name: str) -> Iterator[Raw]:
    """The records in a chunk; offsets count from the start of the content."""
    at, size = 0, len(content)
    head, skip = _HEAD.unpack_from, _HEAD.size
    while at < size:
        if at + skip > size:
            raise CorruptLog(f"{name}: damaged: a chunk ends within a record")
        op, length = head(content, at)
        body = at + skip
        end = body + length
        if op not in _OPS or end > size or (op == MESSAGE and length < _MESSAGE.size):
            raise CorruptLog(f"{name}: damaged: a chunk ends within a record, or holds something else")
        yield Raw(op, at, body, end)
        at = end


def messages(content: bytes, channels: Container[int]) -> Iterator[RawMessage]:
    """The messages of some channels in a chunk that `chunk_records` has walked through before.

    Written out, because this loop is most of the time that an hour of recording takes to read.
    """
    at, size = 0, len(content)
    head, fields, skip = _HEAD.unpack_from, _MESSAGE.unpack_from, _HEAD.size
    while at < size:
        op, length = head(content, at)
        body = at + skip
        at = body + length
        if op == MESSAGE and content[body] | content[body + 1] << 8 in channels:
            channel, sequence, log_time_ns, _ = fields(content, body)
            yield RawMessage(channel, sequence, log_time_ns, content[body + _MESSAGE.size : at])


def message(content: bytes, raw: Raw) -> RawMessage:
    channel, sequence, log_time_ns, _ = _MESSAGE.unpack_from(content, raw.body)
    return RawMessage(channel, sequence, log_time_ns, content[raw.body + _MESSAGE.size : raw.end])


def message_channel(content: bytes, raw: Raw) -> int:
    channel: int = struct.unpack_from("<H", content, raw.body)[0]
    return channel
