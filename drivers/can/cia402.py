"""CiA 402 drives on CANopen: power states, cyclic objects and their scales. Pure; SDO is not in here.

Cyclic frames of an axis, both transmitted with SYNC and full to the last byte:
RPDO1 = controlword 6040h, target position 607Ah, torque offset 60B2h; TPDO1 = statusword 6041h, actual position 6064h,
actual torque 6077h. The mode of operation says which target counts. A drive applies an RPDO at the next SYNC and tells
the effect at the one after: answers are waited for in cycles.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import Enum, IntEnum, IntFlag
from fractions import Fraction

from drivers.base import ProtocolError

NMT_ID, SYNC_ID, EMCY_BASE, TPDO1_BASE, RPDO1_BASE, HEARTBEAT_BASE = 0x000, 0x080, 0x080, 0x180, 0x200, 0x700
RPDO1_MAP = (0x6040_0010, 0x607A_0020, 0x60B2_0010)
TPDO1_MAP = (0x6041_0010, 0x6064_0020, 0x6077_0010)
SYNC_TYPE = 1  # transmission type: each SYNC
_PDO = struct.Struct("<Hih")


class PowerState(Enum):
    """(mask, value) of the statusword."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP = (0x6F, 0x07)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @classmethod
    def of(cls, statusword: int) -> PowerState:
        """ProtocolError: bits that no state has."""
        for state in cls:
            mask, value = state.value
            if statusword & mask == value:
                return state
        raise ProtocolError(f"statusword {statusword:04X}h is no state of CiA 402")


class Control(IntEnum):
    """Controlwords. A fault reset is not among them: it is a rising edge of bit 7, and a person's decision."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F


FAULT_RESET = 0x80

# The way up, one step for each state. A fault or a quick stop is never left by itself.
_ENABLE = {
    PowerState.SWITCH_ON_DISABLED: Control.SHUTDOWN,
    PowerState.READY: Control.SWITCH_ON,
    PowerState.SWITCHED_ON: Control.ENABLE_OPERATION,
    PowerState.OPERATION_ENABLED: Control.ENABLE_OPERATION,
}
# The way down: the axis must be at rest and its brake closed before the voltage goes.
_DISABLE = {
    PowerState.OPERATION_ENABLED: Control.SHUTDOWN,
    PowerState.SWITCHED_ON: Control.SHUTDOWN,
    PowerState.READY: Control.DISABLE_VOLTAGE,
}


class Mode(IntEnum):
    """Modes of operation 6060h; bit mode - 1 of the supported modes 6502h."""

    CYCLIC_POSITION = 8
    CYCLIC_VELOCITY = 9
    CYCLIC_TORQUE = 10


class StatusFlag(IntFlag):
    VOLTAGE = 1 << 4  # off: power removed, as by safe torque off
    WARNING = 1 << 7
    LIMIT = 1 << 11
    FOLLOWS = 1 << 12  # cyclic modes: off, the target is ignored even in operation enabled


_FLAGS = sum(StatusFlag)


class Nmt(IntEnum):
    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NodeState(IntEnum):
    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


@dataclass(frozen=True, slots=True)
class Scale:
    """Joint against drive. The gear is rational, so that nothing drifts: counts = sign gear resolution q / 2 pi."""

    resolution: int  # counts per motor turn, 608Fh
    gear: Fraction  # motor turns per joint turn, 6091h
    rated_torque: float  # Nm at the joint, 6076h
    sign: int = 1
    zero: int = 0  # counts at q = 0

    @property
    def counts_per_radian(self) -> float:
        return float(self.sign * self.resolution * self.gear) / (2.0 * math.pi)

    def counts(self, q: float) -> int:
        """ValueError: not finite, or beyond 32 bits."""
        value = _finite("position", q) * self.counts_per_radian + self.zero
        return _fits("position", round(value), 32)

    def counts_per_second(self, dq: float) -> int:
        """ValueError: not finite, or beyond 32 bits."""
        return _fits("velocity", round(_finite("velocity", dq) * self.counts_per_radian), 32)

    def radians(self, counts: int) -> float:
        return (counts - self.zero) / self.counts_per_radian

    def per_mille(self, tau: float) -> int:
        """ValueError: not finite, or beyond 16 bits."""
        return _fits("torque", round(_finite("torque", tau) * self.sign * 1000.0 / self.rated_torque), 16)

    def newton_metres(self, per_mille: int) -> float:
        return per_mille * self.sign * self.rated_torque / 1000.0


@dataclass(frozen=True, slots=True)
class Target:
    control: int
    q: float  # rad
    tau: float  # Nm


@dataclass(frozen=True, slots=True)
class Actual:
    state: PowerState
    flags: StatusFlag
    q: float  # rad
    tau: float  # Nm


@dataclass(frozen=True, slots=True)
class Emergency:
    code: int  # 00xxh: the error is gone
    register: int
    vendor: bytes


def encode_target(scale: Scale, target: Target) -> bytes:
    """RPDO1. ValueError: not finite, or beyond the object's range."""
    return _PDO.pack(target.control, scale.counts(target.q), scale.per_mille(target.tau))


def decode_target(scale: Scale, data: bytes) -> Target:
    """What an RPDO1 really says. ProtocolError: wrong length."""
    control, counts, per_mille = _unpack("RPDO1", data)
    return Target(control, scale.radians(counts), scale.newton_metres(per_mille))


def decode_actual(scale: Scale, data: bytes) -> Actual:
    """TPDO1; state and flags from one copy of the statusword. ProtocolError: wrong length or no state."""
    status, counts, per_mille = _unpack("TPDO1", data)
    flags = StatusFlag(status & _FLAGS)
    return Actual(PowerState.of(status), flags, scale.radians(counts), scale.newton_metres(per_mille))


def towards_enabled(state: PowerState) -> Control | None:
    """The next controlword; None: only a person leads out of this state, or time does."""
    return _ENABLE.get(state)


def towards_disabled(state: PowerState) -> Control | None:
    """The next controlword of an axis at rest with its brake closed; None: nothing to do."""
    return _DISABLE.get(state)


def encode_nmt(command: Nmt, node: int) -> bytes:
    return bytes([command, node])


def decode_heartbeat(data: bytes) -> NodeState:
    """ProtocolError: no heartbeat."""
    try:
        (value,) = data
        return NodeState(value & 0x7F)
    except ValueError as error:
        raise ProtocolError(f"no heartbeat: {data.hex() or 'no bytes'}") from error


def decode_emergency(data: bytes) -> Emergency:
    """ProtocolError: not 8 bytes."""
    if len(data) != 8:
        raise ProtocolError(f"an EMCY has 8 bytes, not {len(data)}")
    code, register = struct.unpack_from("<HB", data)
    return Emergency(code, register, data[3:])


def _unpack(name: str, data: bytes) -> tuple[int, int, int]:
    if len(data) != _PDO.size:
        raise ProtocolError(f"{name} has {_PDO.size} bytes, not {len(data)}")
    control, counts, per_mille = _PDO.unpack(data)
    return control, counts, per_mille


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"{name} {value} is not finite")
    return value


def _fits(name: str, value: int, bits: int) -> int:
    if not -(1 << bits - 1) <= value < 1 << bits - 1:
        raise ValueError(f"{name}: {value} does not fit {bits} bits")
    return value
