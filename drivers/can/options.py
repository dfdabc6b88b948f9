"""The [driver] table of a cell whose drives are on CAN."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from drivers.can.arms import ARMS


@dataclass(frozen=True, slots=True)
class Options:
    interface: str  # as python-can names it: "socketcan", "pcan", "asc-sim", "virtual"
    channel: str  # "can0"; of the simulated bus any name
    arm: str  # of ARMS
    period_ms: float = 4.0
    watchdog_ms: float = 50.0  # a drive that hears nothing for so long stops by itself; set at start, read back
    stale_ms: float = 12.0  # an answer older than this, or a command of ours so late, stops the arm
    listen_s: float = 0.2  # at start: who else speaks on this bus?
    hold_s: float = 0.5  # at start: how long the arm must stand still once it is enabled
    serials: tuple[int, ...] = ()  # of the drives, axis by axis; (): not checked
    home: str = ""  # file that keeps the pose of the last clean end, to find an arm that was moved or re-zeroed
    lock_dir: str | None = None  # of the owner lock; default: the system's directory for temporary files

    @property
    def period_ns(self) -> int:
        return round(self.period_ms * 1e6)

    @classmethod
    def parse(cls, table: dict[str, Any]) -> Options:
        """ValueError naming every wrong option at once."""
        known = [field.name for field in fields(cls)]
        wrong = [f"unknown option {key!r} (known: {', '.join(known)})" for key in table if key not in known]
        for key in ("interface", "channel", "arm"):
            if not isinstance(table.get(key), str) or not table[key]:
                wrong.append(f"{key} must be a name, not {table.get(key)!r}")
        if isinstance(table.get("arm"), str) and table["arm"] not in ARMS:
            wrong.append(f"arm {table['arm']!r} is unknown; known: {', '.join(ARMS)}")
        for key, (low, high) in _RANGES.items():
            if key in table and not _is_number(table[key], low, high):
                wrong.append(f"{key} must be a number from {low:g} to {high:g}, not {table[key]!r}")
        serials = table.get("serials", [])
        if not isinstance(serials, list | tuple) or not all(type(number) is int for number in serials):
            wrong.append(f"serials must be a list of whole numbers, not {serials!r}")
        elif serials and table.get("arm") in ARMS and len(serials) != len(ARMS[table["arm"]].joints):
            wrong.append(f"serials: {len(serials)} numbers for {len(ARMS[table['arm']].joints)} axes")
        if wrong:
            raise ValueError("can: " + "; ".join(wrong))
        return cls(**{**table, "serials": tuple(serials)})


_RANGES = {
    "period_ms": (1.0, 20.0),
    "watchdog_ms": (5.0, 200.0),
    "stale_ms": (2.0, 100.0),
    "listen_s": (0.0, 5.0),
    "hold_s": (0.0, 10.0),
}


def _is_number(value: object, low: float, high: float) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value) and low <= value <= high
