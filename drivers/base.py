"""The hardware abstraction layer: what a robot driver is.

Life of a driver: configure() -> activate() -> read() / write() each cycle -> stop() -> close().
A driver turns bytes into `JointState` and `JointCommand` into bytes, in SI units and radians, and nothing else: it starts
no thread, retries nothing, recovers from nothing and limits nothing. Recovery is policy (`asc_rt.core.mode`) plus a person.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

from asc_rt.core.types import CommandKind, JointCommand, JointState, StopRequest, Vector


class Pacing(StrEnum):
    DEVICE = "device"  # the robot's samples set the rhythm: read() waits for the next
    HOST = "host"  # this PC sets the rhythm: read() returns the newest sample


@dataclass(frozen=True, slots=True)
class DriverCaps:
    """What configure() found out about the robot."""

    dof: int
    pacing: Pacing
    kinds: frozenset[CommandKind]
    period_ns: int  # nominal
    identity: str  # model, protocol, version as the device tells them


@dataclass(frozen=True, slots=True)
class WriteReceipt:
    """What really left: taken back from the encoded bytes, not from the command."""

    t_tx_ns: int
    seq: int
    q: Vector  # (n,) rad as the encoded bytes say (rounded the way the wire rounds)
    ok: bool  # False: nothing was sent


class DriverError(Exception):
    """A driver failed. `hint` tells the operator what to do, in one line."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint


class LinkError(DriverError):
    """The wire: cannot open, port in use, unreachable."""


class HandshakeError(DriverError):
    """The robot answers, but not as the cell says: version, period, profile."""


class ProtocolError(DriverError):
    """Bytes that are not of the protocol: wrong length, type, version, not finite."""


class RobotFaulted(DriverError):
    """The robot says that it cannot move."""


class OwnershipError(DriverError):
    """Another process commands this robot."""

    def __init__(self, message: str, pid: int) -> None:
        super().__init__(message, hint=f"stop process {pid} first; one robot has one controller")
        self.pid = pid


WireTap = Callable[[str, int, bytes], None]  # (direction "rx" or "tx", t_ns, raw bytes): for the record


class RobotDriver(Protocol):
    def __init__(self, options: dict[str, Any], tap: WireTap | None = None) -> None:
        """`options`: the cell's [driver] table without `name`. Opens nothing. Raises ValueError naming a wrong option."""

    def configure(self) -> DriverCaps:
        """Open the link and read the robot's identity. Nothing can move yet."""

    def activate(self, period_ns: int) -> JointState:
        """Start the session and hold the measured pose. HandshakeError if the robot's period is not `period_ns`."""

    def read(self, deadline_ns: int) -> JointState | None:
        """The next sample (Pacing.DEVICE) or the newest (Pacing.HOST); None at the deadline: silence."""

    def write(self, command: JointCommand) -> WriteReceipt:
        """Send one command, now."""

    def stop(self, request: StopRequest | None = None) -> None:
        """Leave the session so that the robot stays or comes to rest. From any state, idempotent, never raises."""

    def close(self) -> None:
        """Release the link and the ownership. Idempotent."""
