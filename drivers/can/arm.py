"""What the driver asks of a protocol, and what it asks an axis to do: the same for MIT-mode and CiA 402 drives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

from asc_rt.core.types import CommandKind
from drivers.base import Finding
from drivers.can.bus_load import FrameSize
from drivers.can.frame import Frame
from drivers.can.link import Link


class Power(Enum):
    """State of an axis' power stage, whatever its protocol calls it."""

    DISABLED = auto()
    ENABLED = auto()
    NO_VOLTAGE = auto()  # power removed: emergency stop, safe torque off
    FAULT = auto()


class Wish(Enum):
    """What the power stage of an axis is asked for. Nothing but `activate` asks to enable."""

    LOOK = auto()  # it is only asked how it is: before anything is known of it
    KEEP = auto()  # as it is: an axis that fell out stays out
    ENABLE = auto()  # and open the brake
    BRAKE = auto()  # as it is, and close the brake
    DISABLE = auto()


@dataclass(frozen=True, slots=True)
class Feedback:
    """What one axis told: SI at the joint. Age and validity go with it in `AxisState`."""

    power: Power
    q: float  # rad
    dq: float | None  # rad/s; None: it does not tell its speed
    tau: float  # Nm
    hottest_c: float | None  # deg C; None: this protocol does not tell it in the cycle
    warning: bool
    words: str  # the drive's own state, for people
    raw: int = 0  # the same in bits, for the protocol
    dq_step: float = 0.0  # rad/s, between two codes of dq


@dataclass(frozen=True, slots=True)
class Heartbeat:
    operational: bool


@dataclass(frozen=True, slots=True)
class Emergency:
    words: str  # "": what it was is over


@dataclass(frozen=True, slots=True)
class Brake:
    """What the brake's own contact tells."""

    closed: bool | None  # None: the drive has heard of it, and tells nothing


Heard = Feedback | Heartbeat | Emergency | Brake


@dataclass(frozen=True, slots=True)
class Target:
    """What one axis shall do for one period."""

    kind: CommandKind
    q: float  # rad
    dq: float  # rad/s
    tau: float  # Nm: the torque (TORQUE), feed-forward otherwise
    wish: Wish = Wish.KEEP


@dataclass(frozen=True, slots=True)
class Joint:
    """Data of one joint that do not depend on the protocol. Angles in rad, ASSUMED unless the arm says otherwise."""

    q_min: float
    q_max: float
    dq_max: float  # rad/s
    stop_ddq: float  # rad/s2 of the coordinated stop
    has_brake: bool
    holds_on_silence: bool  # MEASURED on the bench: what the drive does when nobody talks to it; False: it goes limp


class ArmCodec(Protocol):
    """A whole arm's drives on one bus. Pure but for `start_up`."""

    @property
    def joints(self) -> Sequence[Joint]: ...
    @property
    def kinds(self) -> frozenset[CommandKind]: ...
    @property
    def bitrate(self) -> float: ...
    @property
    def data_bitrate(self) -> float:
        """0: classic CAN."""

    @property
    def heartbeat_ns(self) -> int:
        """0: these drives have none."""

    @property
    def tells_brakes(self) -> bool:
        """Wishes of ENABLE and BRAKE are answered by what the contact of the brake tells."""

    @property
    def resolution(self) -> float:
        """How far a position may be rounded by the wire, rad."""

    def budget(self) -> list[FrameSize]:
        """Every frame of one cycle, both directions."""

    def encode(self, seq: int, targets: Sequence[Target], last: Sequence[Feedback | None]) -> list[Frame]:
        """One cycle's frames in the order of sending. ValueError: a target that the drives cannot be told."""

    def encoded(self, frames: Sequence[Frame]) -> Sequence[float | None]:
        """Positions that the frames really say, rad, one for each axis; None: this kind of command sends none."""

    def decode(self, frame: Frame) -> tuple[int, Heard] | None:
        """(axis, what it told); None: a frame of nobody we know. ProtocolError: bytes of no meaning."""

    def start_up(self, link: Link, period_ns: int, serials: Sequence[int]) -> Iterator[Finding]:
        """Identity, scales, limits: the checks that only the protocol knows. Enables nothing."""

    def guard(self, link: Link, i: int, watchdog_ns: int) -> Finding:
        """Set the watchdog of drive i, and read it back. The stream runs, and waits no longer than a few ms."""

    def reset(self, link: Link, i: int) -> Finding:
        """Reset the fault of drive i, and see that it is over and that the drive stays disabled. Nothing streams."""

    def assign(self, link: Link, number: int) -> Finding:
        """Give the drive that has no number on the bus this one. Nothing streams."""

    def leave(self) -> list[Frame]:
        """Said once the arm is at rest and its power is off, or left on where nothing else holds it."""
