"""MIT-mode frames of Damiao drives: bytes to SI at the joint and back. Pure; the tables are all there is to know.

A command is position 16 bits, velocity 12, kp 12, kd 12, torque 12, big-endian, each a linear unsigned code over the
range of the motor type; a drive answers each command. Enable, disable, set zero and clear error are frames of the same
identifier with seven bytes FFh in front: a saturated set-point could be one of them, so no position encodes to FFFFh.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

from drivers.base import ProtocolError

REGISTER_ID = 0x7FF
KP_MAX, KD_MAX = 500.0, 5.0  # Nm/rad, Nms/rad
_READ, _WRITE, _REFRESH = 0x33, 0x55, 0xCC


@dataclass(frozen=True, slots=True)
class MotorType:
    """Spans of the codes: -span..span. The drive tells its own in registers 21 to 23: a wrong one is a silent gain."""

    position: float  # rad
    velocity: float  # rad/s
    torque: float  # Nm


# DATASHEET
MOTORS = {
    "DM4310": MotorType(12.5, 30.0, 10.0),
    "DM4310-48V": MotorType(12.5, 50.0, 10.0),
    "DM4340": MotorType(12.5, 10.0, 28.0),
    "DM8009": MotorType(12.5, 45.0, 54.0),
}


class Special(IntEnum):
    """Last byte of a frame that is no set-point."""

    CLEAR_ERROR = 0xFB
    ENABLE = 0xFC
    DISABLE = 0xFD
    SET_ZERO = 0xFE


class DriveStatus(IntEnum):
    """ERR nibble of an answer."""

    DISABLED = 0x0
    ENABLED = 0x1
    OVER_VOLTAGE = 0x8
    UNDER_VOLTAGE = 0x9
    OVER_CURRENT = 0xA
    POWER_STAGE_HOT = 0xB
    COIL_HOT = 0xC
    COMMUNICATION_LOST = 0xD
    OVERLOAD = 0xE

    @property
    def is_fault(self) -> bool:
        return self >= DriveStatus.OVER_VOLTAGE


class Register(IntEnum):
    ANSWER_ID = 7
    COMMAND_ID = 8
    TIMEOUT = 9  # 50 us units
    CONTROL_MODE = 10
    HARDWARE = 13
    FIRMWARE = 14
    SERIAL = 15
    POSITION_SPAN = 21
    VELOCITY_SPAN = 22
    TORQUE_SPAN = 23

    @property
    def is_float(self) -> bool:
        return self in (Register.POSITION_SPAN, Register.VELOCITY_SPAN, Register.TORQUE_SPAN)


@dataclass(frozen=True, slots=True)
class SetPoint:
    """torque = kp (q - q_measured) + kd (dq - dq_measured) + tau, closed inside the drive."""

    q: float  # rad
    dq: float  # rad/s
    kp: float  # Nm/rad
    kd: float  # Nms/rad
    tau: float  # Nm


@dataclass(frozen=True, slots=True)
class Answer:
    status: DriveStatus
    q: float  # rad
    dq: float  # rad/s
    tau: float  # Nm
    power_stage_c: int  # deg C, as the drive tells it
    coil_c: int


def encode(motor: MotorType, point: SetPoint) -> bytes:
    """The command. ValueError: not finite, outside the motor's range, or position control without damping."""
    if point.kp > 0.0 and point.kd == 0.0:
        raise ValueError("position control with kd = 0 oscillates: give a damping")
    p = _code("position", point.q, -motor.position, motor.position, 16)
    if p == 0xFFFF:
        raise ValueError(f"position {point.q:g} rad: the last code belongs to enable, disable and set zero")
    v = _code("velocity", point.dq, -motor.velocity, motor.velocity, 12)
    kp = _code("kp", point.kp, 0.0, KP_MAX, 12)
    kd = _code("kd", point.kd, 0.0, KD_MAX, 12)
    tau = _code("torque", point.tau, -motor.torque, motor.torque, 12)
    return (p << 48 | v << 36 | kp << 24 | kd << 12 | tau).to_bytes(8, "big")


def decode(motor: MotorType, data: bytes) -> SetPoint:
    """What the bytes of a command really say. ProtocolError: they are no set-point."""
    if len(data) != 8 or data[:2] == b"\xff\xff":
        raise ProtocolError(f"no set-point: {data.hex() or 'no bytes'}")
    bits = int.from_bytes(data, "big")
    return SetPoint(
        q=_value(bits >> 48, -motor.position, motor.position, 16),
        dq=_value(bits >> 36 & 0xFFF, -motor.velocity, motor.velocity, 12),
        kp=_value(bits >> 24 & 0xFFF, 0.0, KP_MAX, 12),
        kd=_value(bits >> 12 & 0xFFF, 0.0, KD_MAX, 12),
        tau=_value(bits & 0xFFF, -motor.torque, motor.torque, 12),
    )


def special(kind: Special) -> bytes:
    return b"\xff" * 7 + bytes([kind])


def decode_answer(motor: MotorType, command_id: int, data: bytes) -> Answer:
    """ProtocolError: wrong length, another axis than `command_id`, or a status that the table does not have.

    No code stands for zero velocity: the two beside it are read as standstill.
    """
    if len(data) != 8:
        raise ProtocolError(f"an answer has 8 bytes, not {len(data)}")
    if data[0] & 0xF != command_id & 0xF:
        raise ProtocolError(f"axis {command_id} is answered by axis {data[0] & 0xF}")
    try:
        status = DriveStatus(data[0] >> 4)
    except ValueError as error:
        raise ProtocolError(f"axis {command_id} tells an unknown status {data[0] >> 4:X}h") from error
    bits = int.from_bytes(data[1:6], "big")
    v = bits >> 12 & 0xFFF
    return Answer(
        status=status,
        q=_value(bits >> 24, -motor.position, motor.position, 16),
        dq=0.0 if v in (0x7FF, 0x800) else _value(v, -motor.velocity, motor.velocity, 12),
        tau=_value(bits & 0xFFF, -motor.torque, motor.torque, 12),
        power_stage_c=data[6],
        coil_c=data[7],
    )


def refresh(command_id: int) -> bytes:
    """Sent to REGISTER_ID; answered like a command, without being one."""
    return struct.pack("<HBBI", command_id, _REFRESH, 0, 0)


def read_register(command_id: int, register: Register) -> bytes:
    """Sent to REGISTER_ID; answered also by a drive that is disabled, and enables nothing."""
    return struct.pack("<HBBI", command_id, _READ, register, 0)


def write_register(command_id: int, register: Register, value: float) -> bytes:
    """Into the drive's volatile memory: its flash bears 10 000 writes only."""
    packed = struct.pack("<f", value) if register.is_float else struct.pack("<I", int(value))
    return struct.pack("<HBB", command_id, _WRITE, register) + packed


def decode_register(command_id: int, data: bytes) -> tuple[Register, float] | None:
    """Register and value that a drive tells; None: a frame of another kind or of another axis. Integers are exact."""
    if len(data) != 8 or data[2] not in (_READ, _WRITE) or struct.unpack_from("<H", data)[0] != command_id:
        return None
    try:
        register = Register(data[3])
    except ValueError:
        return None
    return register, struct.unpack_from("<f" if register.is_float else "<I", data, 4)[0]


def _code(name: str, value: float, low: float, high: float, bits: int) -> int:
    """Nearest code. Clipping would hide a defect: what does not fit is refused."""
    if not (math.isfinite(value) and low <= value <= high):
        raise ValueError(f"{name} {value:g} is not a finite number within {low:g}..{high:g}")
    return round((value - low) / (high - low) * ((1 << bits) - 1))


def _value(code: int, low: float, high: float, bits: int) -> float:
    return low + code * (high - low) / ((1 << bits) - 1)
