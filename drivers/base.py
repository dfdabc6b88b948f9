"""The hardware abstraction layer: what a robot driver is.

Life of a driver: configure() -> activate() -> read() / write() each cycle -> stop() -> close().
A driver turns bytes into `JointState` and `JointCommand` into bytes, in SI units and radians, and nothing else: it
starts no thread, retries nothing, recovers from nothing and limits nothing (it may refuse what its robot would refuse).
Recovery is policy (`asc_rt.core.mode`) plus a person.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol, runtime_checkable

from asc_rt.core.types import CommandKind, JointCommand, JointState, StopRequest, Vector


class Pacing(StrEnum):
    DEVICE = "device"  # the robot's samples set the rhythm: read() waits for the next
    HOST = "host"  # this PC sets the rhythm: read() returns the newest sample


@dataclass(frozen=True, slots=True)
class JointLimits:
    """What the robot itself says that its joints may do; set-points inside this box raise no alarm there."""

    dq_max: Vector  # (n,) rad/s
    ddq_max: Vector  # (n,) rad/s2
    dddq_max: Vector  # (n,) rad/s3


@dataclass(frozen=True, slots=True)
class DriverCaps:
    """What configure() found out about the robot."""

    dof: int
    pacing: Pacing
    kinds: frozenset[CommandKind]
    period_ns: int  # nominal
    identity: str  # model, protocol, version as the device tells them
    limits: JointLimits | None = None  # None: it tells none; the profile's are all there is
    reach: tuple[Vector, Vector] | None = None  # least and greatest q that the robot itself lets through, rad
    tells_tool: bool = False  # True: JointState.tool_id is the tool changer's word


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


@runtime_checkable
class ReplayCodec(Protocol):
    """A driver's codec without its link, to check a recording. Optional: a driver that has these two methods.

    `resolution`, if it has that too: how far a position may be rounded by the wire, rad.
    """

    def decode_sample(self, data: bytes) -> tuple[int, Vector, Vector] | None:
        """(sequence, q, current) of a received packet, as `read` tells them; None: a packet of another kind."""

    def encode_command(self, seq: int, command: JointCommand) -> bytes:
        """The packet that `write` sends for it."""


Dynamics = Callable[[Vector, Vector, Vector], Vector]  # (q, dq, ddq) -> the torque that this motion needs, Nm


@runtime_checkable
class Weighted(Protocol):
    """A driver that has to carry the arm while the core is silent: enabling, stopping, leaving. Optional."""

    dynamics: Dynamics  # set before activate()


@runtime_checkable
class Exportable(Protocol):
    """A driver whose recorded packets other tools can read in a format of their own. Optional."""

    def export(self, packets: Iterable[tuple[str, int, bytes]], path: str) -> int:
        """Write (direction, t_ns, bytes), in the order of time, to `path`; how many frames. ValueError: the format."""


@runtime_checkable
class Reporting(Protocol):
    """A driver that has something to tell of a session. Optional."""

    def report(self) -> dict[str, Any]:
        """Counts and verdicts, JSON-able; told with the end of the session."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of an examination."""

    name: str
    ok: bool
    detail: str
    fix: str = ""  # what to do if it is not ok


@runtime_checkable
class Examinable(Protocol):
    """A driver that can look at its robot without moving it, for `asc doctor`. Optional."""

    def examine(self, period_ns: int) -> Iterator[Finding]:
        """What is found, as it is found. Opens the link and closes it; raises nothing of the robot's or the wire's."""


@runtime_checkable
class Serviceable(Protocol):
    """A driver whose drives a person serves while nothing runs, for `asc drives`. Optional. Nothing is enabled by it.

    Each opens the link and closes it, and raises nothing of the robot's or the wire's.
    """

    def drives(self, period_ns: int) -> Iterator[Finding]:
        """How each drive is."""

    def reset(self, period_ns: int, axes: Sequence[int], supported: bool) -> Iterator[Finding]:
        """Reset the faults of these axes, counted from 1; `supported`: the person holds what has no brake."""

    def assign(self, number: int) -> Iterator[Finding]:
        """Give the one drive that has no number on its bus this one."""


class RobotDriver(Protocol):
    fault: RobotFaulted | None  # why the robot left the session, as far as it tells; complete after stop()

    def __init__(self, options: dict[str, Any], tap: WireTap | None = None) -> None:
        """`options`: the cell's [driver] table without `name`. Opens nothing. ValueError names a wrong option."""

    def configure(self) -> DriverCaps:
        """Open the link and read the robot's identity. Nothing can move yet."""

    def activate(self, period_ns: int) -> JointState:
        """Start the session and hold the measured pose. HandshakeError if the robot's period is not `period_ns`."""

    def read(self, deadline_ns: int) -> JointState | None:
        """The next sample (Pacing.DEVICE) or the newest (Pacing.HOST); None at the deadline: silence."""

    def write(self, command: JointCommand) -> WriteReceipt:
        """Send one command, now. ProtocolError: the robot would take it as an offence, so it was not sent."""

    def stop(self, request: StopRequest | None = None) -> None:
        """Leave the session so that the robot stays or comes to rest. From any state, idempotent, never raises."""

    def close(self) -> None:
        """Release the link and the ownership. Idempotent."""
