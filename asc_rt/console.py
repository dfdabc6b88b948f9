"""The operator of a cell: who arms it, and which goal comes next.

A simulated cell arms by itself; a real one only when a person types `arm`.
"""

from __future__ import annotations

import select
import sys
from collections.abc import Sequence
from typing import Any

from asc_rt.bus import Publisher
from asc_rt.core.types import EventKind, Mode

DWELL_S = 0.3  # in HOLD or STOPPED before the simulated cell is armed, and between two tries
RESEND_S = 1.0  # a goal that the control process does not know after this long is sent again
WAITING = (Mode.HOLD.name, Mode.STOPPED.name)


class Operator:
    """Speaks to the control process. `hear` gets its state, about ten times a second."""

    def __init__(
        self, events: Publisher, goals: Publisher, poses: Sequence[Sequence[float]], arms_itself: bool
    ) -> None:
        self.goal_id = 0  # of the goal sent last
        self.is_done = False  # True: the session may end
        self.takes_away: list[str] = []  # processes that the supervisor is to end, as if their device were unplugged
        self._events, self._goals, self._poses = events, goals, poses
        self._arms_itself = arms_itself
        self._event_id = 0
        self._armable_since: float | None = None
        self._goal_sent = 0.0

    def say(self, kind: EventKind, tool: int = 0) -> None:
        self._event_id += 1
        self._events.put_json({"id": self._event_id, "kind": kind.name, "tool": tool})

    def hear(self, state: dict[str, Any], now: float) -> None:
        """React to the control process's state at `now` (s)."""
        self._goal(state, now)
        if state.get("mode") not in WAITING:
            self._armable_since = None
        elif self._armable_since is None:
            self._armable_since = now
        elif self._arms_itself and now - self._armable_since >= DWELL_S:
            self._armable_since = now
            self.say(EventKind.ARM)

    def _goal(self, state: dict[str, Any], now: float) -> None:
        if not self._poses:
            return
        if self.goal_id == 0 or state.get("reached_id", 0) >= self.goal_id:
            self.goal_id += 1
        elif state.get("goal_id", 0) >= self.goal_id or now - self._goal_sent < RESEND_S:
            return
        pose = self._poses[(self.goal_id - 1) % len(self._poses)]
        self._goals.put_json({"id": self.goal_id, "q": list(pose)})
        self._goal_sent = now


class Keyboard:
    """Commands typed by a person: one word a line."""

    WORDS = {"arm": EventKind.ARM, "stop": EventKind.STOP, "end": EventKind.END}

    def __init__(self) -> None:
        self._open = not sys.stdin.closed

    def read(self) -> EventKind | int | str | None:
        """The command typed, the number of a tool, a text that is neither, or None. Never waits for a line to begin."""
        if not self._open or not select.select([sys.stdin], [], [], 0)[0]:
            return None
        line = sys.stdin.readline()
        if not line:
            self._open = False
            return None
        word = line.strip().lower()
        verb, _, number = word.partition(" ")
        if verb == "tool" and number.strip().isdecimal():
            return int(number)
        return self.WORDS.get(word, word)
