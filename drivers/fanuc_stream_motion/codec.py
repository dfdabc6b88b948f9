"""Stream Motion (option J519), classic wire ("flavour A"), versions 1-3: packets <-> SI. Pure: no socket, no clock.

Big-endian, packed, degrees. Nine axes on the wire, of which a LR Mate uses the first six. The wire's J3 is FANUC's: the
forearm against the horizontal. Ours is URDF's: the forearm against the upper arm. `joints_to_wire` and
`joints_from_wire` are the only place that knows.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from asc_rt.core.types import Vector, vector
from drivers.base import ProtocolError

PORT = 60015
VERSIONS = (1, 2, 3)
DOF = 6
AXES = 9
QUEUE_CAPACITY = 10  # commands that the controller buffers ($PKT_STACK, default and maximum)
SEQUENCE_SPAN = 1 << 32
_AXIS_LIMIT = 1e6  # deg; no axis turns this far: such a number is a byte-order or unit error

_START, _COMMAND, _STOP, _COMMAND_DOUBLE, _VERSION = 0, 1, 2, 5, 6
_STATUS = 0  # same number as Start, other direction

_HEADER = struct.Struct(">II")
# sequence, last, read window (type, index, mask), style, write window (type, index, mask, value), unused, 9 axes
_SINGLE = struct.Struct(">III BBHH BBHHH H 9f")
_DOUBLE = struct.Struct(">III BBHH BBHHH HHH 9d")
_STATUS_LAYOUT = struct.Struct(">III BBHHH I 9f 9f 9f")
_STYLE_JOINT = 1
_UNUSED_SINGLE = (0,)
_UNUSED_DOUBLE = (0xFFFF, 0x3333, 0x3333)  # what clients of real controllers send there


@dataclass(frozen=True, slots=True)
class Status:
    """One status packet: where the arm is (servo position) and whether a program takes commands."""

    seq: int
    ready: bool  # a program waits in IBGN start and accepts positions
    servo_on: bool
    moving: bool
    t_ms: int  # controller clock, steps of 2 ms: never differentiate it
    q: Vector  # (6,) rad, URDF
    current: Vector  # (6,) A


@dataclass(frozen=True, slots=True)
class VersionReply:
    version: int  # the highest that the controller speaks


@dataclass(frozen=True, slots=True)
class Command:
    """What a command packet says to the robot."""

    seq: int
    last: bool
    q: Vector  # (6,) rad, URDF, rounded as the wire rounds


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


def sequence_distance(later: int, earlier: int) -> int:
    """Signed steps from `earlier` to `later` on the 32-bit circle."""
    half = SEQUENCE_SPAN // 2
    return (later - earlier + half) % SEQUENCE_SPAN - half


# --- to the controller -----------------------------------------------------------------------------------------------


def encode_start(version: int) -> bytes:
    return _HEADER.pack(_START, version)


def encode_stop(version: int) -> bytes:
    return _HEADER.pack(_STOP, version)


def encode_version_request(version: int) -> bytes:
    return _HEADER.pack(_VERSION, version)


def encode_command(version: int, seq: int, q: Vector, last: bool) -> bytes:
    """Joint set-point `q` (6,) rad as float32 (version 1) or float64 (2 and 3). ValueError: not six finite angles."""
    if q.shape != (DOF,) or not np.isfinite(q).all():
        raise ValueError(f"a set-point is {DOF} finite angles, not {q}")
    kind, layout, unused = (
        (_COMMAND, _SINGLE, _UNUSED_SINGLE) if version == 1 else (_COMMAND_DOUBLE, _DOUBLE, _UNUSED_DOUBLE)
    )
    no_io = (0, 0, 0)
    axes = joints_to_wire(q)
    if abs(axes).max() > _AXIS_LIMIT:
        raise ValueError(f"set-point {q} is not an angle that the wire can say")
    return layout.pack(kind, version, seq, last, *no_io, _STYLE_JOINT, *no_io, 0, *unused, *axes.tolist())


def decode_command(data: bytes) -> Command:
    """What the robot will read in `data`. ProtocolError: not a joint command of ours."""
    kind, version = _header(data)
    expected = {_COMMAND: (_SINGLE, version == 1), _COMMAND_DOUBLE: (_DOUBLE, version in (2, 3))}.get(kind)
    if expected is None or not expected[1] or len(data) != expected[0].size:
        raise ProtocolError(f"not a joint command: type {kind}, version {version}, {len(data)} bytes")
    fields = expected[0].unpack(data)
    if fields[3] not in (0, 1) or fields[7] != _STYLE_JOINT:
        raise ProtocolError(f"not a joint command: last_data {fields[3]}, data style {fields[7]}")
    return Command(seq=fields[2], last=bool(fields[3]), q=joints_from_wire(_axes(fields[-AXES:], "set-point")))


# --- from the controller ---------------------------------------------------------------------------------------------


def decode(data: bytes, version: int) -> Status | VersionReply:
    """One packet of the controller in a session of `version`. ProtocolError: anything else."""
    kind, replied = _header(data)
    if kind == _VERSION:
        if not replied:
            raise ProtocolError("version reply without a version")
        return VersionReply(replied)
    if kind != _STATUS:
        raise ProtocolError(f"packet of unknown type {kind} ({len(data)} bytes)")
    if len(data) != _STATUS_LAYOUT.size:
        raise ProtocolError(f"status of {len(data)} bytes instead of {_STATUS_LAYOUT.size}")
    if replied != version:
        raise ProtocolError(f"status of version {replied} in a session of version {version}")
    fields = _STATUS_LAYOUT.unpack(data)
    bits = fields[3]
    _axes(fields[9:18], "pose")
    return Status(
        seq=fields[2],
        ready=bool(bits & 0x01),
        servo_on=bool(bits & 0x04),
        moving=bool(bits & 0x08),
        t_ms=fields[8],
        q=joints_from_wire(_axes(fields[18:27], "joint angle")),
        current=vector(_axes(fields[27:36], "motor current")[:DOF]),
    )


def _header(data: bytes) -> tuple[int, int]:
    if len(data) < _HEADER.size:
        raise ProtocolError(f"packet of {len(data)} bytes, shorter than its header")
    kind, version = _HEADER.unpack_from(data)
    return kind, version


def _axes(values: tuple[float, ...], what: str) -> Vector:
    array = np.array(values)
    if not (abs(array) <= _AXIS_LIMIT).all():  # false for NaN too
        raise ProtocolError(f"{what} is not a plausible number: {values}")
    return array
