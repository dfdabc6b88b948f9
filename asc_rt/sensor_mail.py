"""The mailbox of one sensor of people: its newest good message, and why the newest one was refused, if it was."""

from __future__ import annotations

from typing import Protocol

from asc_rt.core.fusion import report
from asc_rt.core.types import Health, HumanState, MessageFault, SensorReport
from asc_rt.human_codec import Heard, HumanCodecError, decode


class Inbox(Protocol):
    def take(self) -> bytes | None:
        """The next message, or None. Never waits."""


GOOD_AGAIN = 5  # good messages in a row after which a refused one is forgotten: two that take turns never get there


class SensorMail:
    """A refused message changes nothing but `fault`, which stays until GOOD_AGAIN good ones have come."""

    def __init__(self, sensor_id: int, box: Inbox, clock: str) -> None:
        self.id = sensor_id
        self.fault = MessageFault.NONE
        self.newest: Heard | None = None
        self._good = 0  # messages in a row
        self._box, self._clock = box, clock
        self._sessions: set[str] = set()

    @property
    def state(self) -> HumanState | None:
        return None if self.newest is None else self.newest.state

    def collect(self, most: int) -> str:
        """Take the newest message, of at most `most` capsules. What is wrong with it, or ""."""
        if (data := self._box.take()) is None:
            return ""
        try:
            found = decode(data, self._clock)
            self._check(found, most)
        except HumanCodecError as error:
            self.fault, self._good = error.fault, 0
            return str(error)
        self.newest, self._good = found, self._good + 1
        if self._good >= GOOD_AGAIN:
            self.fault = MessageFault.NONE
        self._sessions.add(found.session)
        return ""

    def report(self, t_ns: int) -> SensorReport:
        """As of `t_ns`."""
        if self.newest is None:
            return SensorReport(self.id, 0, 0, 0, self.fault, Health.FAULT, 0.0, 0, True)
        state = self.newest.state
        return report(state, t_ns - state.t_capture_ns, self.newest.sigma_ns, self.fault)

    def _check(self, found: Heard, most: int) -> None:
        """Its own, in order, and not too much. Numbers increase within a session; a publisher may start anew, but two
        may not take turns."""
        state, last = found.state, self.newest
        if state.sensor_id != self.id:
            raise HumanCodecError(f"of sensor {state.sensor_id}, on the key of {self.id}", MessageFault.SENDER)
        if len(state.radius) > most:
            raise HumanCodecError(f"{len(state.radius)} capsules; at most {most}", MessageFault.UNREADABLE)
        if last is None:
            return
        if found.session != last.session and found.session in self._sessions:
            what = f"session {found.session!r} is back after another one: two publishers"
            raise HumanCodecError(what, MessageFault.ORDER)
        if found.session == last.session and state.seq <= last.state.seq:
            raise HumanCodecError(f"number {state.seq} after {last.state.seq}", MessageFault.ORDER)
        ahead_ns = state.t_capture_ns - last.state.t_capture_ns
        if ahead_ns <= 0:
            raise HumanCodecError(f"captured {-ahead_ns * 1e-6:.3f} ms before the last one", MessageFault.ORDER)
