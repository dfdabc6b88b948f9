"""Decoders of their own for the set-points that drivers send, by the driver's name.

Written from the packet descriptions and sharing nothing with the drivers' codecs, so that the two can disagree. A new
driver's is one function and one line in `DECODERS`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import NamedTuple

ROUNDING = 1e-6  # rad: float32 degrees are up to 2.7e-7 rad off
_AXES = {1: (28, ">9f", 64), 5: (32, ">9d", 104)}  # type -> offset, format, size of the packet
_JOINT_STYLE = 1


class SetPoint(NamedTuple):
    seq: int
    last: bool
    q: tuple[float, ...]  # rad, URDF


def stream_motion(data: bytes) -> SetPoint | None:
    """FANUC Stream Motion, classic wire, types 1 and 5; None: not a joint set-point.

    Big-endian: type u32 at 0, version u32 at 4, sequence u32 at 8, last u8 at 12, data style u8 at 18, nine axes in
    degrees at 28 (type 1, float32) or 32 (type 5, float64). FANUC's J3 is the forearm against the horizontal, ours
    against the upper arm.
    """
    if len(data) < 12:
        return None
    kind, _, seq = struct.unpack_from(">III", data)
    if kind not in _AXES or len(data) != _AXES[kind][2] or data[18] != _JOINT_STYLE or data[12] > 1:
        return None
    offset, layout, _ = _AXES[kind]
    axes = list(struct.unpack_from(layout, data, offset))
    axes[2] += axes[1]
    return _set_point(seq, data[12], axes)


def stream_motion_b(data: bytes) -> SetPoint | None:
    """FANUC Stream Motion, ROS 2 wire, type 201 of 344 bytes; None: not a joint set-point that moves.

    Big-endian: type u32 at 0, sequence u32 at 8, last u8 at 12, motion u8 at 13, 0xFFFF at 14 for joint data, nine axes
    in degrees at 16, float64, with the J3 of the URDF.
    """
    if len(data) != 344 or struct.unpack_from(">I", data)[0] != 201:
        return None
    seq, last, motion, word = struct.unpack_from(">IBBH", data, 8)
    if last > 1 or motion != 1 or word != 0xFFFF:
        return None
    return _set_point(seq, last, struct.unpack_from(">9d", data, 16))


def _set_point(seq: int, last: int, axes: tuple[float, ...] | list[float]) -> SetPoint:
    return SetPoint(seq, bool(last), tuple(map(math.radians, axes[:6])))


DECODERS: dict[str, Callable[[bytes], SetPoint | None]] = {
    "fanuc-j519": stream_motion,
    "fanuc-stream-motion-b": stream_motion_b,
}
