"""Stream Motion (option J519), classic wire ("flavour A"), versions 1-3: packets <-> SI. Pure: no socket, no clock.

Big-endian, packed, degrees. Nine axes on the wire, of which our arms use the first six. The wire's J3 is FANUC's: the
forearm against the horizontal. Ours is URDF's: the forearm against the upper arm. `joints_to_wire` and
`joints_from_wire` are the only place that knows.
"""

from __future__ import annotations

import struct

import numpy as np

from asc_rt.core.types import Vector, vector
from drivers.base import ProtocolError
from drivers.fanuc_stream_motion.packets import (
    AXES,
    DOF,
    SIGNAL_TYPES,
    STAGES,
    Command,
    Commanded,
    Status,
    Thresholds,
    VersionReply,
    Window,
    check_set_point,
    place_from_wire,
    plausible,
    set_point_degrees,
)

VERSIONS = (1, 2, 3)

_START, _COMMAND, _STOP, _THRESHOLDS, _COMMANDED, _COMMAND_DOUBLE, _VERSION = range(7)
_STATUS = 0  # same number as Start, other direction

_HEADER = struct.Struct(">II")
# sequence, last, read window (type, index, mask), style, write window (type, index, mask, value), unused, 9 axes
_SINGLE = struct.Struct(">III BBHH BBHHH H 9f")
_DOUBLE = struct.Struct(">III BBHH BBHHH HHH 9d")
_THRESHOLD_REQUEST = struct.Struct(">4I")
# sequence, bits, read window (type, index, mask, value), time, pose, joints, currents
_STATUS_LAYOUT = struct.Struct(">III BBHHH I 9f 9f 9f")
_THRESHOLD_REPLY = struct.Struct(">6I 20f 20f")  # axis, kind, greatest speed, interval, limits
_COMMANDED_REPLY = struct.Struct(">III 9f 9f")
_STYLE_JOINT = 1
_UNUSED_SINGLE = (0,)
_UNUSED_DOUBLE = (0xFFFF, 0x3333, 0x3333)  # what clients of real controllers send there


def joints_to_wire(q: Vector) -> Vector:
    """URDF joints (6,) rad -> the wire's nine axes in degrees: J3_fanuc = J3_urdf - J2."""
    axes = np.zeros(AXES)
    axes[:DOF] = np.degrees(q)
    axes[2] -= axes[1]
    return axes


def joints_from_wire(axes: Vector) -> Vector:
    """The wire's nine axes in degrees -> URDF joints (6,) rad: J3_urdf = J3_fanuc + J2."""
    degrees = axes[:DOF].copy()
    degrees[2] += degrees[1]
    return vector(np.radians(degrees))


# --- to the controller -----------------------------------------------------------------------------------------------


def encode_start(version: int) -> bytes:
    return _HEADER.pack(_START, version)


def encode_stop(version: int) -> bytes:
    return _HEADER.pack(_STOP, version)


def encode_version_request(version: int) -> bytes:
    return _HEADER.pack(_VERSION, version)


def encode_threshold_request(version: int, axis: int, kind: int) -> bytes:
    return _THRESHOLD_REQUEST.pack(_THRESHOLDS, version, axis, kind)


def encode_commanded_request(version: int) -> bytes:
    return _HEADER.pack(_COMMANDED, version)


def encode_command(version: int, seq: int, q: Vector, last: bool, window: Window | None = None) -> bytes:
    """Joint set-point `q` (6,) rad as float32 (version 1) or float64 (2 and 3), and the signals to read from now on.

    ValueError: not six finite angles.
    """
    check_set_point(q)
    kind, layout, unused = (
        (_COMMAND, _SINGLE, _UNUSED_SINGLE) if version == 1 else (_COMMAND_DOUBLE, _DOUBLE, _UNUSED_DOUBLE)
    )
    read = (SIGNAL_TYPES[window.name], window.first, window.mask) if window else (0, 0, 0)
    axes = set_point_degrees(joints_to_wire(q))
    return layout.pack(kind, version, seq, last, *read, _STYLE_JOINT, 0, 0, 0, 0, *unused, *axes)


def decode_command(data: bytes) -> Command:
    """What the robot will read in `data`. ProtocolError: not a joint command of ours."""
    kind, version = _header(data)
    expected = {_COMMAND: (_SINGLE, version == 1), _COMMAND_DOUBLE: (_DOUBLE, version in (2, 3))}.get(kind)
    if expected is None or not expected[1] or len(data) != expected[0].size:
        raise ProtocolError(f"not a joint command: type {kind}, version {version}, {len(data)} bytes")
    fields = expected[0].unpack(data)
    if fields[3] not in (0, 1) or fields[7] != _STYLE_JOINT:
        raise ProtocolError(f"not a joint command: last_data {fields[3]}, data style {fields[7]}")
    return Command(seq=fields[2], last=bool(fields[3]), q=joints_from_wire(plausible(fields[-AXES:], "set-point")))


# --- from the controller ---------------------------------------------------------------------------------------------


def decode(data: bytes, version: int) -> Status | VersionReply | Thresholds | Commanded:
    """One packet of the controller in a session of `version`. ProtocolError: anything else."""
    kind, replied = _header(data)
    if kind == _VERSION:
        if not replied:
            raise ProtocolError("version reply without a version")
        return VersionReply(replied)
    if kind not in (_STATUS, _THRESHOLDS, _COMMANDED):
        raise ProtocolError(f"packet of unknown type {kind} ({len(data)} bytes)")
    if replied != version:
        raise ProtocolError(f"packet of version {replied} in a session of version {version}")
    if kind == _STATUS:
        return _status(data)
    return decode_thresholds(data) if kind == _THRESHOLDS else _commanded(data)


def decode_thresholds(data: bytes) -> Thresholds:
    """A threshold reply, the same on both wires. ProtocolError: none."""
    fields = _sized(_THRESHOLD_REPLY, data, "threshold reply")
    axis, kind, max_speed = fields[2:5]
    if not (1 <= axis <= AXES and kind <= 2 and max_speed):
        raise ProtocolError(f"thresholds of axis {axis}, kind {kind}, {max_speed} mm/s")
    stages = np.radians(plausible(fields[6:], "threshold"))
    return Thresholds(axis, kind, max_speed * 1e-3, vector(stages[:STAGES]), vector(stages[STAGES:]))


def _status(data: bytes) -> Status:
    fields = _sized(_STATUS_LAYOUT, data, "status")
    bits = fields[3]
    return Status(
        seq=fields[2],
        ready=bool(bits & 0x01),
        servo_on=bool(bits & 0x04),
        moving=bool(bits & 0x08),
        t_ms=fields[8],
        place=place_from_wire(fields[9:18]),
        q=joints_from_wire(plausible(fields[18:27], "joint angle")),
        current=vector(plausible(fields[27:36], "motor current")[:DOF]),
        every=max(1, bits >> 4),
        inputs=fields[7] & fields[6] if fields[6] else None,
    )


def _commanded(data: bytes) -> Commanded:
    fields = _sized(_COMMANDED_REPLY, data, "commanded position")
    plausible(fields[3:12], "pose")
    return Commanded(fields[2], joints_from_wire(plausible(fields[12:21], "joint angle")))


def _sized(layout: struct.Struct, data: bytes, what: str) -> tuple[int, ...]:
    if len(data) != layout.size:
        raise ProtocolError(f"{what} of {len(data)} bytes instead of {layout.size}")
    return layout.unpack(data)


def _header(data: bytes) -> tuple[int, int]:
    if len(data) < _HEADER.size:
        raise ProtocolError(f"packet of {len(data)} bytes, shorter than its header")
    kind, version = _HEADER.unpack_from(data)
    return kind, version
