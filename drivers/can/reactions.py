"""What each fault of bus, drives and arm means: the table. Nothing in here is ever cleared without a person.

The principle: host software is not the safety function. On a fault the stream goes on; what is streamed changes.
Silence would let every drive's watchdog act, and an arm without brakes fall.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum


class Reaction(Enum):
    WARN = 0  # counted and told
    SLOW = 1  # told to the core, which goes on at its slow speed for as long as it is seen
    STOP = 2  # coordinated stop of every axis that listens, on the path; then hold, and transmit on
    CUT = 3  # nothing can be said on the bus any more: the drives' own watchdogs and the power circuit stop the arm


class Fault(StrEnum):
    MISSED = "missed answer"
    SILENT = "no axis answers"
    STALE = "stale feedback"
    LOST = "axis lost"
    HEARTBEAT = "heartbeat lost"
    BUS_PASSIVE = "bus error passive"
    NO_ACKNOWLEDGE = "nobody acknowledges"
    BACKLOG = "transmit backlog"
    BUS_OFF = "bus-off"
    INTERFACE_GONE = "interface gone"
    AXIS_FAULT = "drive fault"
    DISABLED = "unexpected disable"
    NO_VOLTAGE = "safe torque off"
    ENCODER = "encoder jump"
    FOLLOWING = "following error"
    WARM = "drive warm"
    HEATED = "drive needs rest"
    HOT = "drive hot"
    STRANGERS = "unknown frames"
    FLOOD = "too many unknown frames"
    LATE = "cycle late"
    OVERRUN = "controller overrun"
    BRAKE = "brake does not hold"


@dataclass(frozen=True, slots=True)
class Rule:
    reaction: Reaction
    do: str  # for the operator
    is_axis: bool = True  # of one axis, which then is not commanded along the path any more


_POWER_UP = "find the cause, then asc drives CELL --reset AXIS and start the session anew: nothing is reset by itself"

RULES = {
    Fault.MISSED: Rule(Reaction.WARN, "look at bus load and cabling if it comes often", is_axis=False),
    # The arm stops already: a cycle without any answer is sent as a stop, see `Can.read`.
    Fault.SILENT: Rule(Reaction.WARN, "is the bus plugged in, and has it power?", is_axis=False),
    Fault.STALE: Rule(Reaction.STOP, "check cable and connector of the axis, then start anew", is_axis=False),
    Fault.LOST: Rule(Reaction.STOP, "the axis is dead: support the arm, check power and cable of the drive"),
    Fault.HEARTBEAT: Rule(Reaction.STOP, _POWER_UP, is_axis=False),
    Fault.BUS_PASSIVE: Rule(Reaction.STOP, "check termination and cabling: frames are destroyed", is_axis=False),
    Fault.NO_ACKNOWLEDGE: Rule(Reaction.CUT, "the bus is unplugged or without power", is_axis=False),
    Fault.BACKLOG: Rule(Reaction.STOP, "more is sent than the bus carries: another sender, or errors", is_axis=False),
    Fault.BUS_OFF: Rule(Reaction.CUT, "check cabling, take the interface down and up, start anew", is_axis=False),
    Fault.INTERFACE_GONE: Rule(Reaction.CUT, "plug the adapter in, bring the interface up, start anew", is_axis=False),
    Fault.AXIS_FAULT: Rule(Reaction.STOP, _POWER_UP),
    Fault.DISABLED: Rule(Reaction.STOP, _POWER_UP),
    Fault.NO_VOLTAGE: Rule(Reaction.STOP, "release the emergency stop, support the arm, start the session anew"),
    Fault.ENCODER: Rule(Reaction.STOP, "check the zero of the axis before anything moves"),
    Fault.FOLLOWING: Rule(Reaction.STOP, "something holds the arm, or a brake is closed"),
    Fault.WARM: Rule(Reaction.WARN, "let it cool soon", is_axis=False),
    Fault.HEATED: Rule(Reaction.SLOW, "let the drive cool down: it goes slowly until then", is_axis=False),
    Fault.HOT: Rule(Reaction.STOP, "let the drive cool down: it would go limp by itself", is_axis=False),
    Fault.STRANGERS: Rule(Reaction.WARN, "somebody else sends on this bus", is_axis=False),
    Fault.FLOOD: Rule(Reaction.STOP, "somebody else sends on this bus: take it off", is_axis=False),
    Fault.LATE: Rule(Reaction.WARN, "asc doctor: is this PC fit for the period?", is_axis=False),
    Fault.OVERRUN: Rule(Reaction.STOP, "this PC is too slow or busy: asc doctor", is_axis=False),
    Fault.BRAKE: Rule(
        Reaction.STOP,
        "support the arm before its power goes; brake or contact must be serviced",
    ),
}


@dataclass(frozen=True, slots=True)
class Found:
    """A fault that was seen, with where and since which cycle."""

    fault: Fault
    axis: int | None  # None: of the bus or of this PC
    seq: int
    detail: str

    @property
    def rule(self) -> Rule:
        return RULES[self.fault]

    def __str__(self) -> str:
        where = "" if self.axis is None else f"axis {self.axis + 1}: "
        return f"{where}{self.fault} ({self.detail})"
