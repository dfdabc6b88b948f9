"""A third codec of Stream Motion, written from the packet tables alone, for peers that know neither ours nor the
simulated robot's: fixed big-endian records, degrees and millimetres as they stand on the wire."""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_float, c_uint8, c_uint16, c_uint32


class Record(ctypes.BigEndianStructure):
    _pack_ = 1

    def __bytes__(self) -> bytes:
        return ctypes.string_at(ctypes.addressof(self), ctypes.sizeof(self))

    @classmethod
    def of(cls, data: bytes) -> Record:
        assert len(data) == ctypes.sizeof(cls), f"{cls.__name__}: {len(data)} bytes instead of {ctypes.sizeof(cls)}"
        return cls.from_buffer_copy(data)


class Head(Record):
    _fields_ = [("type", c_uint32), ("version", c_uint32)]


class ThresholdRequest(Record):
    _fields_ = [*Head._fields_, ("axis", c_uint32), ("kind", c_uint32)]


class ThresholdReply(Record):
    _fields_ = [
        *ThresholdRequest._fields_,
        ("vmax", c_uint32),
        ("interval", c_uint32),
        ("empty", c_float * 20),
        ("full", c_float * 20),
    ]


class Status(Record):  # classic
    _fields_ = [
        *Head._fields_,
        ("seq", c_uint32),
        ("status", c_uint8),
        ("io_type", c_uint8),
        ("io_index", c_uint16),
        ("io_mask", c_uint16),
        ("io_value", c_uint16),
        ("time", c_uint32),
        ("pose", c_float * 9),
        ("joints", c_float * 9),
        ("current", c_float * 9),
    ]


_COMMAND = [
    *Head._fields_,
    ("seq", c_uint32),
    ("last", c_uint8),
    ("r_type", c_uint8),
    ("r_index", c_uint16),
    ("r_mask", c_uint16),
    ("style", c_uint8),
    ("w_type", c_uint8),
    ("w_index", c_uint16),
    ("w_mask", c_uint16),
    ("w_value", c_uint16),
]


class Single(Record):
    _fields_ = [*_COMMAND, ("unused", c_uint16), ("axes", c_float * 9)]


class Double(Record):
    _fields_ = [*_COMMAND, ("unused", c_uint16 * 3), ("axes", c_double * 9)]


class Commanded(Record):
    _fields_ = [*Head._fields_, ("time", c_uint32), ("pose", c_float * 9), ("joints", c_float * 9)]


# --- the ROS 2 wire --------------------------------------------------------------------------------------------------


class Capability(Record):
    _fields_ = [
        *Head._fields_,
        ("id", c_uint32),
        ("sampling", c_uint32),
        ("start_move", c_uint32),
        ("available", c_uint32),
        ("use_tcp", c_uint32),
    ]


class Slot(Record):
    _fields_ = [("kind", c_uint32), ("gpio", c_uint32), ("start", c_uint32), ("length", c_uint32)]


class Gpio(Record):
    _fields_ = [*Head._fields_, ("slots", Slot * 32)]


class GpioResult(Record):
    _fields_ = [("type", c_uint32), ("result", c_uint32), ("ptf", c_uint32)]


class RosCommand(Record):
    _fields_ = [
        *Head._fields_,
        ("seq", c_uint32),
        ("last", c_uint8),
        ("motion", c_uint8),
        ("word", c_uint16),
        ("axes", c_double * 9),
        ("io", c_uint8 * 256),
    ]


class RosStatus(Record):
    _fields_ = [
        *Head._fields_,
        ("seq", c_uint32),
        ("status", c_uint8),
        ("robot", c_uint8),
        ("contact", c_uint8),
        ("unused", c_uint8),
        ("time", c_uint32),
        ("pose", c_float * 9),
        ("joints", c_float * 9),
        ("current", c_float * 9),
        ("scale", c_float),
        ("io", c_uint8 * 256),
    ]


class ForceConfig(Record):
    _fields_ = [*Head._fields_, ("reset", c_uint32), ("sensor", c_uint32)]


SIZES = {
    Head: 8, ThresholdRequest: 16, ThresholdReply: 184, Status: 132, Single: 64, Double: 104, Commanded: 84,
    Capability: 28, Gpio: 520, GpioResult: 12, RosCommand: 344, RosStatus: 388, ForceConfig: 16,
}  # fmt: skip
assert all(ctypes.sizeof(record) == size for record, size in SIZES.items())
