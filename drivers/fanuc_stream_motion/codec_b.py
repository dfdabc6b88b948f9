"""Stream Motion, the ROS 2 wire ("flavour B"), versions 3 and 4: packets <-> SI. Pure: no socket, no clock.

Big-endian and packed, degrees, as the classic wire; but J3 is URDF's already, and inside the 256 bytes of signals
numbers are little-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from asc_rt.core.types import Vector, vector
from drivers.base import ProtocolError
from drivers.fanuc_stream_motion import codec
from drivers.fanuc_stream_motion.packets import (
    AXES,
    DOF,
    Command,
    Status,
    Thresholds,
    Window,
    check_set_point,
    place_from_wire,
    plausible,
    set_point_degrees,
)

VERSIONS = (3, 4)

_STOP, _THRESHOLDS, _GET_CAPABILITY, _SET_CAPABILITY = 2, 3, 7, 8
_START, _COMMAND, _STATUS, _GPIO, _STATUS_FORCE, _FORCE_SENSOR = 200, 201, 202, 203, 204, 205
# The field is called unused in the published headers. It is not: anything but this value makes the controller read the
# nine numbers as a Cartesian pose, and the arm slews there.
JOINT_DATA = 0xFFFF
SIGNAL_BYTES = 256
SLOTS = 32

_HEADER = struct.Struct(">II")
_CAPABILITY = struct.Struct(">7I")  # type, version, id, sampling [ms], start_move, version available, pose at the TCP
_COMMAND_LAYOUT = struct.Struct(">III BBH 9d 256s")  # sequence, last, motion, JOINT_DATA, axes, signals
# sequence, status, robot, contact stop, unused, time, pose, joints, currents, safety scale (force: 6 numbers, type)
_STATUS_LAYOUT = struct.Struct(">III BBBB I 9f 9f 9f f 256s")
_STATUS_FORCE_LAYOUT = struct.Struct(">III BBBB I 9f 9f 9f f 6f I 256s")
_SLOT = struct.Struct(">4I")  # kind, signal type, first, length
_GPIO_RESULT = struct.Struct(">3I")
_FORCE = struct.Struct(">4I")  # reset, sensor
_SLOT_STATE = 2  # the robot tells the signals
_SIGNAL_TYPES = {"DO": 0, "DI": 1, "RO": 2, "RI": 3}
FORCE_SENSORS = {"embedded": 1, "external": 2}  # others: none is chosen, none is there
_CONTACT = ("", "contact stop: safe", "contact stop", "contact stop disabled", "contact stop: escape")


@dataclass(frozen=True, slots=True)
class Capability:
    period_ms: int
    start_move: int  # commands buffered before motion
    version: int  # the highest that the controller speaks


@dataclass(frozen=True, slots=True)
class GpioResult:
    ok: bool


def encode_start(version: int) -> bytes:
    return _HEADER.pack(_START, version)


def encode_stop(version: int) -> bytes:
    return _HEADER.pack(_STOP, version)


def encode_capability_request(version: int) -> bytes:
    return _CAPABILITY.pack(_GET_CAPABILITY, version, 1, 0, 0, 0, 0)


def encode_start_move(version: int, commands: int) -> bytes:
    """So many commands are buffered before the arm moves; statuses tell the face plate, not the tool."""
    return _CAPABILITY.pack(_SET_CAPABILITY, version, 1, 0, commands, 0, 0)


def encode_force_sensor(version: int, sensor: str) -> bytes:
    """From now on the statuses carry the forces of `sensor`. Version 3 takes the packet for a system error."""
    return _FORCE.pack(_FORCE_SENSOR, version, 0, FORCE_SENSORS[sensor])


def encode_threshold_request(version: int, axis: int, kind: int) -> bytes:
    return codec.encode_threshold_request(version, axis, kind)


def encode_gpio(version: int, window: Window) -> bytes:
    """From now on the statuses carry the signals of `window`."""
    slot = _SLOT.pack(_SLOT_STATE, _SIGNAL_TYPES[window.name], window.first, window.count)
    return _HEADER.pack(_GPIO, version) + slot + bytes((SLOTS - 1) * _SLOT.size)


def encode_command(version: int, seq: int, q: Vector, last: bool) -> bytes:
    """Joint set-point `q` (6,) rad. ValueError: not six finite angles."""
    check_set_point(q)
    axes = set_point_degrees(np.concatenate([np.degrees(q), np.zeros(AXES - DOF)]))
    return _COMMAND_LAYOUT.pack(_COMMAND, version, seq, last, True, JOINT_DATA, *axes, bytes(SIGNAL_BYTES))


def decode_command(data: bytes) -> Command:
    """What the robot will read in `data`. ProtocolError: not a joint command of ours."""
    kind, version = _header(data)
    if kind != _COMMAND or version not in VERSIONS or len(data) != _COMMAND_LAYOUT.size:
        raise ProtocolError(f"not a joint command: type {kind}, version {version}, {len(data)} bytes")
    fields = _COMMAND_LAYOUT.unpack(data)
    if fields[3] not in (0, 1) or fields[4] != 1 or fields[5] != JOINT_DATA:
        raise ProtocolError(f"not a joint command: last {fields[3]}, motion {fields[4]}, word {fields[5]:#06x}")
    axes = plausible(fields[6:-1], "set-point")
    return Command(seq=fields[2], last=bool(fields[3]), q=vector(np.radians(axes[:DOF])))


def decode(data: bytes, version: int) -> Status | Capability | Thresholds | GpioResult:
    """One packet of the controller in a session of `version`. ProtocolError: anything else."""
    kind, told = _header(data)
    if kind in (_GET_CAPABILITY, _SET_CAPABILITY):
        return _capability(data)
    if kind == _GPIO:
        if len(data) != _GPIO_RESULT.size:
            raise ProtocolError(f"GPIO result of {len(data)} bytes instead of {_GPIO_RESULT.size}")
        return GpioResult(_GPIO_RESULT.unpack(data)[1] == 0)  # the only packet without a version
    if kind not in (_THRESHOLDS, _STATUS, _STATUS_FORCE):
        raise ProtocolError(f"packet of unknown type {kind} ({len(data)} bytes)")
    if told != version:
        raise ProtocolError(f"packet of version {told} in a session of version {version}")
    if kind == _THRESHOLDS:
        return codec.decode_thresholds(data)
    if (kind == _STATUS_FORCE) != (version >= 4):
        raise ProtocolError(f"status of type {kind} in version {version}")
    return _status(data, _STATUS_LAYOUT if kind == _STATUS else _STATUS_FORCE_LAYOUT)


def _status(data: bytes, layout: struct.Struct) -> Status:
    if len(data) != layout.size:
        raise ProtocolError(f"status of {len(data)} bytes instead of {layout.size}")
    fields = layout.unpack(data)
    bits, robot, contact = fields[3:6]
    if contact >= len(_CONTACT):
        raise ProtocolError(f"contact stop {contact}")
    plausible(fields[35:36], "safety scale")
    troubles = ("alarm" * (robot & 1), "teach pendant enabled" * (robot >> 1 & 1), _CONTACT[contact])
    return Status(
        seq=fields[2],
        ready=bool(bits & 0x01),
        servo_on=bool(bits & 0x04),
        moving=bool(bits & 0x08),
        t_ms=fields[7],
        place=place_from_wire(fields[8:17]),
        q=vector(np.radians(plausible(fields[17:26], "joint angle")[:DOF])),
        current=vector(plausible(fields[26:35], "motor current")[:DOF]),
        inputs=int.from_bytes(fields[-1][:4], "little"),
        force=_force(fields[36:-1]),
        emergency_stop=bool(robot & 4),
        trouble=", ".join(trouble for trouble in troubles if trouble),
    )


def _force(fields: tuple[float, ...]) -> Vector | None:
    """Three forces and three moments, and of which sensor they are; a version 3 status has no such fields."""
    if not fields:
        return None
    force = vector(plausible(fields[:6], "force"))
    return force if fields[6] in FORCE_SENSORS.values() else None


def _capability(data: bytes) -> Capability:
    if len(data) != _CAPABILITY.size:
        raise ProtocolError(f"capability of {len(data)} bytes instead of {_CAPABILITY.size}")
    told, _, period_ms, start_move, version = _CAPABILITY.unpack(data)[1:6]
    if not (told and 1 <= period_ms <= 100 and start_move <= 9 and version):
        raise ProtocolError(f"capability of {period_ms} ms, start_move {start_move}, version {version}")
    return Capability(period_ms, start_move, version)


def _header(data: bytes) -> tuple[int, int]:
    if len(data) < _HEADER.size:
        raise ProtocolError(f"packet of {len(data)} bytes, shorter than its header")
    kind, version = _HEADER.unpack_from(data)
    return kind, version
