"""What a stamp of another machine is on the cell's clock, and how far it may be off.

Cristian's bound: asked at t0, answered with the cell's time t1, heard at t3 (t0, t3 on our clock), the offset
cell - ours lies within [t1 - t3, t1 - t0], however the way there and back share the round trip. The bounds of an older
answer widen by the drift that two free oscillators may have; all answers together leave what every one of them allows.
None left means that a clock was set or a machine was exchanged: only the newest answer is kept, and nothing is
converted until the next one agrees with it.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from dataclasses import dataclass

from asc_rt import topics
from asc_rt.bus import Bus
from asc_rt.human_codec import clock_id

DRIFT = 200e-6  # ASSUMED: two quartz oscillators of +-100 ppm
ANSWERS = 32  # kept; at one a second half a minute
PERIOD_S = 1.0
TIMEOUT_S = 0.5


@dataclass(frozen=True, slots=True)
class Answer:
    t0_ns: int  # asked, our clock
    t1_ns: int  # answered, the cell's clock
    t3_ns: int  # heard, our clock

    def bounds(self, t_ns: int) -> tuple[float, float]:
        """Of the offset at our time t_ns, ns. The clocks drift during the round trip, too."""
        drifted = DRIFT * (abs(t_ns - self.t3_ns) + self.t3_ns - self.t0_ns)
        return self.t1_ns - self.t3_ns - drifted, self.t1_ns - self.t0_ns + drifted


class ClockOffset:
    """Pure: `heard` every answer, then ask `at` any time for (offset, how far it may be off), ns; None: not known."""

    def __init__(self) -> None:
        self._answers: deque[Answer] = deque(maxlen=ANSWERS)
        self._is_agreed = True

    def heard(self, answer: Answer) -> None:
        self._answers.append(answer)
        if self._common(answer.t3_ns) is None:
            self._answers.clear()
            self._answers.append(answer)
            self._is_agreed = False
        elif len(self._answers) > 1:
            self._is_agreed = True

    def at(self, t_ns: int) -> tuple[int, int] | None:
        common = self._common(t_ns) if self._answers and self._is_agreed else None
        if common is None:
            return None
        low, high = common
        return round((low + high) / 2.0), round((high - low) / 2.0) + 1

    def _common(self, t_ns: int) -> tuple[float, float] | None:
        bounds = [answer.bounds(t_ns) for answer in self._answers]
        low, high = max(low for low, _ in bounds), min(high for _, high in bounds)
        return (low, high) if low <= high else None


class CellClock:
    """The cell's clock as seen from this process, asked about once a second by a thread of its own: not for the control
    process. On the cell's own machine stamps are its stamps already."""

    def __init__(self, bus: Bus) -> None:
        self.id = ""  # of the cell's clock; "" until it has answered
        self._bus, self._offset, self._lock = bus, ClockOffset(), threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._ask_again_and_again, name="cell clock", daemon=True)
        self._thread.start()

    def convert(self, t_ns: int) -> tuple[int, int] | None:
        """Our stamp as (the cell's stamp, how far it may be off), ns; None: the cell has not answered."""
        with self._lock:
            if self.id == clock_id():
                return t_ns, 0
            found = self._offset.at(t_ns) if self.id else None
        return None if found is None else (t_ns + found[0], found[1])

    def close(self) -> None:
        self._closing.set()
        self._thread.join(TIMEOUT_S + 1.0)

    def _ask_again_and_again(self) -> None:
        while not self._closing.is_set():
            self._ask()
            self._closing.wait(PERIOD_S if self.id else PERIOD_S / 10.0)

    def _ask(self) -> None:
        t0_ns = time.monotonic_ns()
        data = self._bus.ask(topics.CLOCK.key, TIMEOUT_S)
        t3_ns = time.monotonic_ns()
        try:
            told = json.loads(data or b"")
            name, t1_ns = str(told["id"]), int(told["t_ns"])
        except (ValueError, KeyError, TypeError):
            return
        with self._lock:
            if name != self.id:
                self.id, self._offset = name, ClockOffset()
            self._offset.heard(Answer(t0_ns, t1_ns, t3_ns))


def answer() -> bytes:
    """What the cell says when it is asked: the id of its clock and its time now."""
    return json.dumps({"id": clock_id(), "t_ns": time.monotonic_ns()}).encode()
