"""Faults of line and controller, by call or by script: each stands for something that happens in a real cell.

A `FaultyController` is a controller for whoever drives it. Script entries: {at_s, fault, count?, value?}: from the time
`at_s` of the controller on, to `count` packets.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from sim_hil import fault_script
from sim_hil.fanuc.cabinet import Cabinet, Peer
from sim_hil.fanuc.signals import IDENTITY_BITS

STRANGER: Peer = ("127.0.0.2", 50001)
NAN = bytes.fromhex("7ff8000000000000")  # as float64 and as float32
NAN_AT = 56  # where every packet of numbers has one

LINE = ("lose", "repeat", "delay", "reorder", "truncate", "nan", "foreign")  # + "_status" or "_command"
ROBOT = (
    "foreign_start",
    "foreign_stop",
    "emergency_stop",
    "emergency_release",
    "pendant_on",
    "pendant_off",
    "reset",
    "run_program",
    "sequence",
    "clock",
    "tool",
    "power_off",
)
FAULTS = tuple(f"{fault}_{what}" for fault in LINE for what in ("status", "command")) + ROBOT


@dataclass(frozen=True, slots=True)
class Fault:
    at_s: float
    fault: str
    count: int = 1
    value: int = 1  # delay [cycles], sequence number, clock jump [ms], tool number (0: none)

    @classmethod
    def parse(cls, entry: object) -> Fault:
        """ValueError: not a fault."""
        if not isinstance(entry, dict):
            raise ValueError(f"a fault is a table with {', '.join(_KEYS)}, not {entry!r}")
        if set(entry) - set(_KEYS) or not {"at_s", "fault"} <= set(entry):
            raise ValueError(f"a fault has {', '.join(_KEYS)}, not {', '.join(map(str, entry))}")
        fault = cls(**entry)
        whole = type(fault.count) is int and type(fault.value) is int and fault.count > 0
        if fault.fault not in FAULTS or not whole or type(fault.at_s) not in (int, float) or fault.at_s < 0:
            raise ValueError(f"{entry} is no fault; faults: {', '.join(FAULTS)}")
        if fault.fault == "tool" and not 0 <= fault.value < 2**IDENTITY_BITS:
            raise ValueError(f"{entry}: tools are numbered 1 to {2**IDENTITY_BITS - 1}, 0: none")
        return fault


parse_script = partial(fault_script.parse, kind=Fault)
read_script = partial(fault_script.read, kind=Fault)
heard = partial(fault_script.heard, kind=Fault)
_KEYS = fault_script.keys(Fault)


class _Due(NamedTuple):
    cycle: int
    packet: tuple[Peer, bytes]


class Line:
    """One direction of the cable. Faults apply to the next packets, one after the other."""

    def __init__(self) -> None:
        self._faults: list[tuple[str, int]] = []  # what happens to the packets to come, and its value
        self._late: list[_Due] = []
        self._held: tuple[Peer, bytes] | None = None

    def spoil(self, fault: str, count: int, value: int) -> None:
        self._faults += [(fault, value)] * count

    def carry(self, packets: Iterable[tuple[Peer, bytes]], cycle: int) -> list[tuple[Peer, bytes]]:
        arrived = [late.packet for late in self._late if late.cycle <= cycle]
        self._late = [late for late in self._late if late.cycle > cycle]
        for packet in packets:
            arrived += self._spoiled(packet, cycle)
        return arrived

    def _spoiled(self, packet: tuple[Peer, bytes], cycle: int) -> list[tuple[Peer, bytes]]:
        if self._held is not None:
            before, self._held = self._held, None
            return [packet, before]
        if not self._faults:
            return [packet]
        (fault, value), (peer, data) = self._faults.pop(0), packet
        match fault:
            case "lose":
                return []
            case "repeat":
                return [packet, packet]
            case "delay":
                self._late.append(_Due(cycle + value, packet))
                return []
            case "reorder":
                self._held = packet
                return []
            case "truncate":
                return [(peer, data[: len(data) // 2])]
            case "nan":
                return [(peer, data[:NAN_AT] + NAN + data[NAN_AT + len(NAN) :])]
            case _:
                return [packet, (peer, b"a packet of something else")]


class FaultyController:
    def __init__(self, controller: Cabinet, script: Sequence[Fault] = ()) -> None:
        self.controller = controller
        self.settings = controller.settings
        self.to_pc, self.to_robot = Line(), Line()
        self._script = sorted(script, key=lambda fault: fault.at_s)
        self._cycle = 0
        self._strangers: list[tuple[Peer, bytes]] = []
        self._powered = True

    def cycle(self, packets: Iterable[tuple[Peer, bytes]]) -> list[tuple[Peer, bytes]]:
        while self._script and self._script[0].at_s <= self._cycle * self.settings.period:
            fault = self._script.pop(0)
            self.inject(fault.fault, fault.count, fault.value)
        self._cycle += 1
        arrived = self.to_robot.carry(packets, self._cycle) + self._strangers
        self._strangers = []
        if not self._powered:
            return []
        out = self.controller.cycle(arrived)
        return [packet for packet in self.to_pc.carry(out, self._cycle) if packet[0] != STRANGER]

    def inject(self, fault: str, count: int = 1, value: int = 1) -> None:
        """One of FAULTS, now. ValueError: none of them."""
        robot = self.controller
        name, _, what = fault.rpartition("_")
        match fault:
            case _ if name in LINE and what in ("status", "command"):
                (self.to_pc if what == "status" else self.to_robot).spoil(name, count, value)
            case "foreign_start" | "foreign_stop":
                self._strangers += [(STRANGER, robot.greeting(what))] * count
            case "emergency_stop":
                robot.press_emergency_stop()
            case "emergency_release":
                robot.release_emergency_stop()
            case "pendant_on" | "pendant_off":
                robot.enable_pendant(what == "on")
            case "reset":
                robot.reset()
            case "run_program":
                robot.run_program()
            case "sequence":
                robot.jump_sequence(value)
            case "clock":
                robot.jump_clock(value)
            case "tool":
                robot.couple(value)
            case "power_off":
                self._powered = False
            case _:
                raise ValueError(f"unknown fault {fault!r}; faults: {', '.join(FAULTS)}")
