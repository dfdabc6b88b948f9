"""A CAN frame, and how the record keeps the frames of a cycle: as one packet."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

from drivers.base import ProtocolError

_HEAD = struct.Struct("<IB")  # sequence, number of frames
_FRAME = struct.Struct("<IBBiB")  # identifier, flags, cycles missed, carried on, data bytes
_FD = 0x01


@dataclass(frozen=True, slots=True)
class Frame:
    id: int
    data: bytes
    is_fd: bool = False  # with bit rate switch, always
    stamp: float = field(default=0.0, compare=False)  # s, when the interface heard it; only differences mean anything


def bundle(seq: int, frames: Sequence[Frame], missed: Sequence[int] = (), carried: Sequence[int] = ()) -> bytes:
    """What one cycle sent, or what it took its sample from.

    `missed`: for how many cycles the axis of each frame has not answered; (): each did. `carried`: urad that its
    position was carried on to the time of the sample; (): none was.
    """
    none = [0] * len(frames)
    parts = [_HEAD.pack(seq, len(frames))]
    for frame, age, on in zip(frames, missed or none, carried or none, strict=True):
        flags = _FD if frame.is_fd else 0
        parts += [_FRAME.pack(frame.id, flags, min(age, 255), on, len(frame.data)), frame.data]
    return b"".join(parts)


def unbundle(data: bytes) -> tuple[int, list[int], list[int], list[Frame]]:
    """(sequence, cycles missed, carried on, frames). ProtocolError: not a bundle."""
    frames, missed, carried = [], [], []
    try:
        seq, count = _HEAD.unpack_from(data)
        at = _HEAD.size
        for _ in range(count):
            number, flags, age, on, length = _FRAME.unpack_from(data, at)
            at += _FRAME.size + length
            frames.append(Frame(number, data[at - length : at], bool(flags & _FD)))
            missed.append(age)
            carried.append(on)
    except struct.error as error:
        raise ProtocolError(f"{len(data)} bytes are no bundle of frames") from error
    if at != len(data):
        raise ProtocolError(f"a bundle of {count} frames has {at} bytes, not {len(data)}")
    return seq, missed, carried, frames
