"""A decoder of its own for the set-points that FANUC Stream Motion carries, classic wire, type 1 and 5.

Written from the packet description and sharing nothing with the driver's codec, so that the two can disagree.
Big-endian: type u32 at 0, version u32 at 4, sequence u32 at 8, last u8 at 12, data style u8 at 18, nine axes in degrees
at 28 (type 1, float32) or 32 (type 5, float64). FANUC's J3 is the forearm against the horizontal, ours against the
upper arm.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

STREAM_MOTION = "fanuc-j519"
ROUNDING = 1e-6  # rad: float32 degrees are up to 2.7e-7 rad off
_AXES = {1: (28, ">9f", 64), 5: (32, ">9d", 104)}  # type -> offset, format, size of the packet
_JOINT_STYLE = 1


class SetPoint(NamedTuple):
    seq: int
    last: bool
    q: np.ndarray[tuple[int], np.dtype[np.float64]]  # rad, URDF


def set_point(data: bytes) -> SetPoint | None:
    """None: not a joint set-point."""
    if len(data) < 12:
        return None
    kind, _, seq = struct.unpack_from(">III", data)
    if kind not in _AXES or len(data) != _AXES[kind][2] or data[18] != _JOINT_STYLE or data[12] > 1:
        return None
    offset, layout, _ = _AXES[kind]
    axes = list(struct.unpack_from(layout, data, offset))
    axes[2] += axes[1]
    return SetPoint(seq, bool(data[12]), np.array([axis * np.pi / 180.0 for axis in axes[:6]]))
