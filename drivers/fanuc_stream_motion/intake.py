"""The statuses of a session in the order of their numbers: what is new, old, lost, and who else is there."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from drivers.base import RobotFaulted
from drivers.fanuc_stream_motion.packets import QUEUE_CAPACITY, Status, sequence_distance
from drivers.fanuc_stream_motion.progress import Counters

RESTART_STEPS = 4  # so many numbers in a row far behind ours: the robot has begun to count anew

Arrived = tuple[int, Status]  # when [ns], what
Receive = Callable[[int], tuple[int, object] | None]  # the next packet until a deadline


class Intake:
    def __init__(self, receive: Receive, counters: Counters) -> None:
        self.newest: Status | None = None  # that was taken
        self.fault: RobotFaulted | None = None  # the numbers say that the session is lost
        self._receive = receive
        self._counters = counters
        self._backlog: deque[Arrived] = deque()  # arrived, not yet their turn
        self._behind: deque[int] = deque(maxlen=RESTART_STEPS)

    def await_one(self, deadline_ns: int) -> Arrived | None:
        """The next status, whatever its number."""
        if self._backlog:
            return self._backlog.popleft()
        while (packet := self._receive(deadline_ns)) is not None:
            if isinstance(packet[1], Status):
                return packet[0], packet[1]
        return None

    def await_newest(self, deadline_ns: int) -> Arrived | None:
        """Before the first command no status wants an answer: the newest counts."""
        arrived = self.await_one(deadline_ns)
        while arrived is not None and (later := self.await_one(0)) is not None:
            arrived = later
        return arrived

    def await_next(self, deadline_ns: int, answered: int) -> Arrived | None:
        """The next with a number after the newest; `answered`: the number of the command sent last."""
        assert self.newest is not None
        while (arrived := self.await_one(deadline_ns)) is not None:
            if sequence_distance(arrived[1].seq, self.newest.seq) > 0:
                self._behind.clear()
                self._look_ahead(arrived[1].seq, answered)
                return arrived
            self._counters.stale += 1
            if self._has_restarted(arrived[1].seq):
                return arrived
        return None

    def take(self, status: Status) -> int:
        """`status` is the newest now; how many numbers it is ahead of the one before (0: not ahead, or the first)."""
        ahead = 0 if self.newest is None else max(0, sequence_distance(status.seq, self.newest.seq))
        self._counters.missing += max(0, ahead - status.every)
        self._counters.new += 1
        self.newest = status
        return ahead

    def _look_ahead(self, newest: int, answered: int) -> None:
        """Take in what else has arrived: answered in one go, more than the buffer holds would overflow it."""
        while (packet := self._receive(0)) is not None:
            if isinstance(packet[1], Status):
                self._backlog.append((packet[0], packet[1]))
        behind = sequence_distance(self._backlog[-1][1].seq if self._backlog else newest, answered)
        if behind > QUEUE_CAPACITY:
            self.fault = self.fault or RobotFaulted(
                f"{behind} cycles were not answered in time, more than the robot buffers",
                hint="check cable, real-time set-up and load of this PC",
            )

    def _has_restarted(self, seq: int) -> bool:
        """Old numbers come singly or in pairs; several that count up are a new session that somebody else began."""
        if self._behind and sequence_distance(seq, self._behind[-1]) != 1:
            self._behind.clear()
        self._behind.append(seq)
        if len(self._behind) < RESTART_STEPS:
            return False
        self._behind.clear()
        self.fault = self.fault or RobotFaulted(
            "the robot counts its statuses anew: another PC took the session",
            hint="stop every other Stream Motion client, then start again",
        )
        return True
