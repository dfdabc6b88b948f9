"""What sets the rhythm of the loop: the robot's samples or this PC's clock.

Both answer the same questions: how long `driver.read` may wait, whether this cycle began late, how many periods were
lost before it. A lost period is counted and gone; two cycles are never run to make up for it. With the clock of a plant
in this thread the same pacers run in simulated time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from drivers.base import Pacing

Clock = Callable[[], int]  # monotonic ns
Sleep = Callable[[int], None]  # until this monotonic ns

SEQUENCE_SPAN = 1 << 32  # sequence numbers of devices are at most this wide


class Pacer(Protocol):
    late: bool  # the present cycle began more than a period after it was due
    missed: int  # periods lost between the cycle before and the present one

    def deadline_ns(self) -> int:
        """Until when read() may wait for a sample. Past: do not wait."""

    def began(self, t_ns: int, seq: int | None) -> None:
        """A cycle begins at `t_ns` with the robot's sample `seq`; None: silence."""

    def wait(self) -> None:
        """Until the next cycle is due."""


class DevicePaced:
    """Each sample of the robot is a cycle; half a period after it was due, a missing one is a silent cycle."""

    def __init__(self, period_ns: int, clock: Clock = time.monotonic_ns) -> None:
        self.late, self.missed = False, 0
        self._period_ns = period_ns
        self._due_ns = clock() + period_ns
        self._seq: int | None = None

    def deadline_ns(self) -> int:
        return self._due_ns + self._period_ns // 2

    def began(self, t_ns: int, seq: int | None) -> None:
        """Missed are the numbers that the robot's sequence skipped; silent cycles are no misses of ours."""
        self.late = t_ns > self._due_ns + self._period_ns
        self.missed = 0
        if seq is None:
            self._due_ns += max(1, (t_ns - self._due_ns) // self._period_ns) * self._period_ns
            return
        if self._seq is not None:
            ahead = (seq - self._seq) % SEQUENCE_SPAN
            self.missed = ahead - 1 if 0 < ahead < SEQUENCE_SPAN // 2 else 0
        self._seq = seq
        self._due_ns = t_ns + self._period_ns

    def wait(self) -> None:
        """read() waits."""


class HostPaced:
    """Deadlines start + k * period of this PC's clock, absolute: a late cycle does not move the later ones."""

    def __init__(self, period_ns: int, clock: Clock = time.monotonic_ns, sleep: Sleep | None = None) -> None:
        self.late, self.missed = False, 0
        self._period_ns, self._clock, self._sleep = period_ns, clock, sleep or _sleep_until
        self._due_ns = clock()
        self._skipped = 0

    def deadline_ns(self) -> int:
        """A quarter of a period for a robot that answers late."""
        return self._due_ns + self._period_ns // 4

    def began(self, t_ns: int, seq: int | None) -> None:
        self.late = t_ns >= self._due_ns + self._period_ns
        self.missed = self._skipped

    def wait(self) -> None:
        self._due_ns += self._period_ns
        self._skipped = max(0, (self._clock() - self._due_ns) // self._period_ns)
        self._due_ns += self._skipped * self._period_ns
        self._sleep(self._due_ns)


def make(pacing: Pacing, period_ns: int) -> Pacer:
    """The pacer for a driver of that kind."""
    return DevicePaced(period_ns) if pacing is Pacing.DEVICE else HostPaced(period_ns)


def _sleep_until(t_ns: int) -> None:
    remaining_ns = t_ns - time.monotonic_ns()
    if remaining_ns > 0:
        time.sleep(remaining_ns * 1e-9)
