"""Single-producer ring of fixed slots in shared memory: the hand-off from the control loop to the logger.

The file is made by the supervisor and never removed by the producer: whatever dies, what was put stays readable.
A slot is [sequence u64 | length u64 | payload], padded to 64 bytes. The producer writes sequence 0, the payload, the
sequence k + 1 and then the head; the reader looks at a slot below the head and takes its copy only if it finds k + 1
afterwards: had the producer begun to overwrite it, it would find another number. Every one of these words is one
aligned 8-byte store. That order holds on x86 (stores are not reordered); ARM would need a barrier.

The producer never waits: a reader that is slower than the ring is deep loses the oldest slots and counts them.
"""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path
from typing import Self

from drivers.base import WireTap

MAGIC = 0x31474E4952435341  # "ASCRING1"
HEADER_SIZE = 4096
DEPTH_S = 40.0  # a logger may stall this long before anything is lost
_MAGIC, _SLOT_SIZE, _SLOTS, _HEAD, _CLOSED, _READ, _LOST = range(7)  # words of the header
_SLOT_HEAD = 16
_LINE = 64


class RingError(Exception):
    """No ring, or no room for one. `hint` tells the operator what to do, in one line."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint


def create(path: str | Path, slot_size: int, slots: int) -> None:
    """Make the file of a ring for payloads up to `slot_size` bytes. RingError: it exists, or there is no room."""
    stride = _stride(slot_size)
    try:
        fd = os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
        try:
            # Allocated at once: in a sparse file a full /dev/shm would kill the producer at some later store.
            os.posix_fallocate(fd, 0, HEADER_SIZE + slots * stride)
            os.pwrite(fd, struct.pack("=7Q", MAGIC, slot_size, slots, 0, 0, 0, 0), 0)
        except OSError:
            os.unlink(path)
            raise
        finally:
            os.close(fd)
    except OSError as error:
        megabytes = slots * stride / 1e6
        raise RingError(
            f"{path}: no ring of {megabytes:.0f} MB: {error.strerror}",
            hint="remove what a dead session left in /dev/shm",
        ) from error


class _Ring:
    """The mapped file. RingError: not a ring."""

    def __init__(self, path: str | Path, writable: bool = True) -> None:
        try:
            fd = os.open(path, os.O_RDWR if writable else os.O_RDONLY)
        except OSError as error:
            raise RingError(f"{path}: {error.strerror}", hint="the ring is made by the session's supervisor") from error
        try:
            size = os.fstat(fd).st_size
            if size < HEADER_SIZE:
                raise RingError(f"{path}: not a ring")
            self._map = mmap.mmap(fd, size, access=mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ)
        finally:
            os.close(fd)
        self.memory = memoryview(self._map)
        self._words = self.memory.cast("Q")
        self.slot_size, self.slots = self._words[_SLOT_SIZE], self._words[_SLOTS]
        self._stride = _stride(self.slot_size)
        if self._words[_MAGIC] != MAGIC or size != HEADER_SIZE + self.slots * self._stride:
            self._unmap()
            raise RingError(f"{path}: not a ring")

    @property
    def head(self) -> int:
        """Slots put so far."""
        return self._words[_HEAD]

    @property
    def lost(self) -> int:
        """Slots that the reader could not get any more."""
        return self._words[_LOST]

    @property
    def closed(self) -> bool:
        """The producer has said that nothing follows."""
        return self._words[_CLOSED] != 0

    def _copies(self, first: int, end: int) -> list[memoryview]:
        """What is in the slots `first` to `end`, without those overwritten before or while they were copied. One copy
        for all: a call for each slot is most of what a logger would do."""
        found: list[memoryview] = []
        while first < end:
            place = first % self.slots
            count = min(end - first, self.slots - place)
            start, step = HEADER_SIZE + place * self._stride, self._stride >> 3
            copy = memoryview(self.memory[start : start + count * self._stride].tobytes())
            sequences = self._words[start >> 3 : (start >> 3) + count * step : step].tolist()
            sizes = copy.cast("Q")[1::step].tolist()
            places = range(_SLOT_HEAD, len(copy), self._stride)
            wanted = range(first + 1, first + count + 1)
            found += [
                copy[at : at + size]
                for at, size, sequence, right in zip(places, sizes, sequences, wanted, strict=True)
                if sequence == right
            ]
            first += count
        return found

    def _unmap(self) -> None:
        self._words.release()
        self.memory.release()
        self._map.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._unmap()


class RingWriter(_Ring):
    """The one producer. It goes on where the last one ended."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self._next = self._words[_HEAD]
        self._word = 0  # of the slot that was begun

    def put(self, payload: bytes | bytearray | memoryview) -> None:
        """Copy the payload into the next slot. Never waits. ValueError: larger than a slot."""
        at = self.begin(len(payload))
        self.memory[at : at + len(payload)] = payload
        self.end()

    def begin(self, size: int) -> int:
        """Where in `memory` the payload of the next slot is to be written; `end` hands it over. Without that nobody has
        seen it: `begin` may be called again. Never waits. ValueError: larger than a slot."""
        if size > self.slot_size:
            raise ValueError(f"{size} bytes do not fit into a slot of {self.slot_size}")
        offset = HEADER_SIZE + self._next % self.slots * self._stride
        self._word = word = offset >> 3
        self._words[word] = 0
        self._words[word + 1] = size
        return offset + _SLOT_HEAD

    def end(self) -> None:
        self._next += 1
        self._words[self._word] = self._next
        self._words[_HEAD] = self._next

    @property
    def backlog(self) -> int:
        """Slots put that are not safe in a file yet; more than `slots` means that some are lost."""
        return self._words[_HEAD] - self._words[_READ]

    def close(self) -> None:
        """Nothing follows. Idempotent."""
        if not self._map.closed:
            self._words[_CLOSED] = 1
            self._unmap()


class RingReader(_Ring):
    """The one consumer. It begins where the last one made its reading durable."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self._next = self._words[_READ]

    def take(self) -> memoryview | None:
        """The oldest payload not yet taken, or None."""
        return next(iter(self.drain(1)), None)

    def drain(self, limit: int = 100) -> list[memoryview]:
        """The oldest payloads not yet taken, up to `limit`; none: there are no more."""
        while self._next < (head := self.head):
            first, self._next = self._next, min(head, self._next + limit)
            found = self._copies(first, self._next)
            self._words[_LOST] += self._next - first - len(found)
            if found:
                return found
        return []

    def commit(self) -> None:
        """What was taken so far is safe: a successor begins after it."""
        self._words[_READ] = self._next

    @property
    def finished(self) -> bool:
        """Closed by the producer, and all taken."""
        return self.closed and self._next >= self.head


class RingWatcher(_Ring):
    """Looks on beside the consumer, any number of them. The ring is mapped read-only: nobody can notice."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(path, writable=False)
        self._next = 0

    def new(self) -> list[memoryview]:
        """What was put since the last look and is still there; the first time all that is there."""
        head = self.head
        first, self._next = max(self._next, head - self.slots), head
        return self._copies(first, head)


def _stride(slot_size: int) -> int:
    return -(-(_SLOT_HEAD + slot_size) // _LINE) * _LINE


# --- the two rings of a session --------------------------------------------------------------------------------------

WIRE_DATA_SIZE = 512  # bytes of one packet that are kept; the length tells of more
_WIRE_HEAD = struct.Struct("<qII")  # t_ns, direction, length on the wire
_DIRECTIONS = ("rx", "tx")


def wire_path(path: str | Path) -> Path:
    """Where the ring of raw packets is, next to the ring of records."""
    return Path(f"{path}.wire")


def create_session(path: str | Path, record_size: int, period_ns: int) -> None:
    """Both rings of a session, DEPTH_S deep. RingError as `create`."""
    cycles = round(DEPTH_S * 1e9 / period_ns)
    create(path, record_size, cycles)
    try:
        create(wire_path(path), _WIRE_HEAD.size + WIRE_DATA_SIZE, 2 * cycles)
    except RingError:
        os.unlink(path)
        raise


def remove_session(path: str | Path) -> None:
    """Remove both rings, once everything in them is safe. For the supervisor only."""
    for name in (Path(path), wire_path(path)):
        name.unlink(missing_ok=True)


def wire_tap(ring: RingWriter) -> WireTap:
    """A tap for a driver that puts every packet into `ring`."""
    put, pack, numbers = ring.put, _WIRE_HEAD.pack, {name: i for i, name in enumerate(_DIRECTIONS)}

    def tap(direction: str, t_ns: int, data: bytes) -> None:
        put(pack(t_ns, numbers[direction], len(data)) + data[:WIRE_DATA_SIZE])

    return tap


def parse_wire(payload: memoryview) -> tuple[str, int, int, memoryview]:
    """(direction, t_ns, length on the wire, data) of a payload of the wire ring."""
    t_ns, direction, length = _WIRE_HEAD.unpack_from(payload)
    return _DIRECTIONS[direction], t_ns, length, payload[_WIRE_HEAD.size :]
