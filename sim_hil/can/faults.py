"""Faults of bus, drives and arm, by call or by script: each stands for something that happens in a real cell.

Script entries: {at_s, fault, axis?, value?}; `axis` counts from 1, 0 is every axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from sim_hil import fault_script
from sim_hil.can.frames import Frame
from sim_hil.can.line import FIRST_DRIVE, Line

Action = Callable[[Line, int, float], None]  # line, drive counted from 0, value


def _lose(line: Line, i: int, value: float) -> None:
    line.lose[i] += round(value)


def _late(line: Line, i: int, value: float) -> None:
    line.late[i] = round(value * 1e6)


def _echo(line: Line, i: int, value: float) -> None:
    line.echo.add(i)


def _short(line: Line, i: int, value: float) -> None:
    line.short.add(i)


def _silence(line: Line, i: int, value: float) -> None:
    line.drives[i].is_silent = True


def _heartbeat(line: Line, i: int, value: float) -> None:
    line.drives[i].heart_stopped = True


def _power_cut(line: Line, i: int, value: float) -> None:
    """The axis is dead: no torque, no answer; a brake closes by its spring."""
    line.drives[i].cut_power()
    line.drives[i].is_silent = True


def _safe_torque_off(line: Line, i: int, value: float) -> None:
    line.drives[i].cut_power()


def _power_on(line: Line, i: int, value: float) -> None:
    line.drives[i].restore_power()


def _trip(line: Line, i: int, value: float) -> None:
    line.drives[i].trip_over_current()


def _emergency(line: Line, i: int, value: float) -> None:
    line.drives[i].say_emergency(round(value))


def _stops(line: Line, i: int, value: float) -> None:
    line.drives[i].stop_by_itself()


def _deaf(line: Line, i: int, value: float) -> None:
    line.drives[i].ignore_targets()


def _number(line: Line, i: int, value: float) -> None:
    line.drives[i].forget_number()


def _stand(line: Line, i: int, value: float) -> None:
    """A stand carries the arm until every drive has power again."""
    line.on_stand = True


def _brake(line: Line, i: int, value: float) -> None:
    line.drives[i].jam_brake(value > 0, contact=False)


def _contact(line: Line, i: int, value: float) -> None:
    line.drives[i].jam_brake(value > 0, contact=True)


def _drift(line: Line, i: int, value: float) -> None:
    line.drives[i].drift = value


def _disable(line: Line, i: int, value: float) -> None:
    line.drives[i].switch_off()


def _encoder(line: Line, i: int, value: float) -> None:
    line.drives[i].offset += value


def _block(line: Line, i: int, value: float) -> None:
    line.blocked.add(i)


def _hot(line: Line, i: int, value: float) -> None:
    line.drives[i].coil_c = value


def _corrupt(line: Line, i: int, value: float) -> None:
    """So many frames of every client are destroyed on the wire."""
    for node in line.bus.clients(FIRST_DRIVE):
        line.bus.corrupt[node] += round(value)


def _unplug(line: Line, i: int, value: float) -> None:
    """The cable to the drives is off: nobody acknowledges."""
    for node in range(FIRST_DRIVE, FIRST_DRIVE + len(line.drives)):
        line.bus.off.add(node)


def _babble(line: Line, i: int, value: float) -> None:
    line.babble = Frame(round(value), bytes(8))


FAULTS: dict[str, Action] = {
    "lose": _lose,  # value: frames of the drive
    "late": _late,  # value: ms
    "echo": _echo,
    "short": _short,
    "silence": _silence,
    "heartbeat": _heartbeat,
    "power_cut": _power_cut,
    "safe_torque_off": _safe_torque_off,
    "power_on": _power_on,
    "trip": _trip,
    "emergency": _emergency,  # value: code of the EMCY
    "stops": _stops,
    "deaf": _deaf,
    "number": _number,
    "stand": _stand,
    "brake": _brake,  # value: 1 stays closed, 0 open
    "contact": _contact,  # value: 1 tells closed, 0 open
    "disable": _disable,
    "encoder": _encoder,  # value: rad
    "drift": _drift,  # value: rad/s
    "block": _block,
    "hot": _hot,  # value: deg C
    "corrupt": _corrupt,  # value: frames
    "unplug": _unplug,
    "babble": _babble,  # value: identifier
}


@dataclass(frozen=True, slots=True)
class Fault:
    at_s: float
    fault: str
    axis: int = 0
    value: float = 1.0

    @classmethod
    def parse(cls, entry: object) -> Fault:
        """ValueError: not a fault."""
        if not isinstance(entry, dict) or not {"at_s", "fault"} <= set(entry) <= set(_KEYS):
            raise ValueError(f"a fault is a table with {', '.join(_KEYS)}, not {entry!r}")
        fault = cls(**entry)
        if not isinstance(fault.fault, str) or fault.fault not in FAULTS:
            raise ValueError(f"{fault.fault!r} is no fault; faults: {', '.join(FAULTS)}")
        if not (_is_number(fault.at_s) and fault.at_s >= 0):
            raise ValueError(f"at_s: {fault.at_s!r} is no time; seconds from the first client on, at least 0")
        if type(fault.axis) is not int or fault.axis < 0:
            raise ValueError(f"axis: {fault.axis!r} is no axis; they count from 1, 0 is every one")
        low, high = _VALUES.get(fault.fault, (-math.inf, math.inf))
        if not (_is_number(fault.value) and low <= fault.value <= high):
            raise ValueError(
                f"value: {fault.value!r} is not possible; of {fault.fault!r} a number from {low:g} to {high:g}"
            )
        return fault

    def strike(self, line: Line) -> None:
        """IndexError: there is no such axis, see `check_axes`."""
        axes = range(len(line.drives)) if self.axis == 0 else [self.axis - 1]
        for i in axes if self.fault not in _OF_THE_BUS else [0]:
            FAULTS[self.fault](line, i, self.value)


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]


def check_axes(script: Sequence[Fault], axes: int) -> None:
    """ValueError: faults of axes that this arm does not have."""
    wrong = [f"fault {fault.fault!r}: axis {fault.axis} of {axes}" for fault in script if fault.axis > axes]
    if wrong:
        raise ValueError("\n".join(wrong))


# What else would be no frame, or no number of frames.
_VALUES = {"lose": (0, 1e6), "corrupt": (0, 1e6), "late": (0, 1e3), "babble": (0, 0x7FF), "emergency": (0, 0xFFFF)}
_VALUES["hot"] = (0, 255)  # as much as the answer has bits for
_OF_THE_BUS = ("corrupt", "unplug", "babble", "stand")


parse_script = partial(fault_script.parse, kind=Fault)
read_script = partial(fault_script.read, kind=Fault)
heard = partial(fault_script.heard, kind=Fault)
_KEYS = fault_script.keys(Fault)


def due(script: list[Fault], seconds: float) -> Iterator[Fault]:
    """Takes what has come due out of the script, which is in the order of time."""
    while script and script[0].at_s <= seconds:
        yield script.pop(0)
