"""Frames as SocketCAN has them in memory: 16 bytes classic, 72 bytes FD."""

from __future__ import annotations

import struct
from dataclasses import dataclass

EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000  # flags of the identifier
ERROR_CONTROLLER, ERROR_ACK, ERROR_BUS_OFF = 0x04, 0x20, 0x40  # classes of an error frame
ERROR_TX_OVERFLOW, ERROR_TX_WARNING, ERROR_TX_PASSIVE = 0x02, 0x08, 0x20  # data[1] of the controller's
_CLASSIC, _FD = struct.Struct("=IB3x8s"), struct.Struct("=IBB2x64s")
_BRS = 0x01


@dataclass(frozen=True, slots=True)
class Frame:
    id: int  # with the flags above
    data: bytes
    is_fd: bool = False
    switches_rate: bool = False


NUMBER = 0x1FFF_FFFF  # bits of the identifier that are one


def pack(frame: Frame) -> bytes:
    if frame.is_fd:
        return _FD.pack(frame.id, len(frame.data), _BRS if frame.switches_rate else 0, frame.data)
    return _CLASSIC.pack(frame.id, len(frame.data), frame.data)


def unpack(raw: bytes) -> Frame:
    """ValueError: not one frame."""
    if len(raw) == _CLASSIC.size:
        number, length, data = _CLASSIC.unpack(raw)
        most, flags = 8, None
    elif len(raw) == _FD.size:
        number, length, flags, data = _FD.unpack(raw)
        most = 64
    else:
        raise ValueError(f"{len(raw)} bytes are no CAN frame")
    if length > most:
        raise ValueError(f"a frame of {length} data bytes")
    return Frame(number, data[:length], flags is not None, bool((flags or 0) & _BRS))


def error(kind: int, detail: int = 0) -> Frame:
    return Frame(ERROR | kind, bytes([0, detail, 0, 0, 0, 0, 0, 0]))
