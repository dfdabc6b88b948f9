"""How far a session has come, and what came in."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Phase(Enum):
    CLOSED = 0
    CONFIGURED = 1  # link open, no session
    MONITORING = 2  # statuses flow, nothing was commanded
    STREAMING = 3
    FINISHED = 4  # last command sent


@dataclass(slots=True)
class Counters:
    """What came in since activate()."""

    new: int = 0
    stale: int = 0  # repeated or reordered: their number was answered before
    missing: int = 0  # numbers that did not come in their turn
    pauses: int = 0  # of ours, longer than two periods: the robot may have run dry
