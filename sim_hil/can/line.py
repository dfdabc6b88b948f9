"""Bus, drives and mechanics in one time, without sockets: in lockstep, or led by a real clock (`server`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from sim_hil.can.bus import Bus, Delivery
from sim_hil.can.frames import Frame

TICK_NS = 1_000_000
ANSWER_NS = 50_000  # from the end of a command to the answer being ready, ASSUMED
FIRST_DRIVE = 1 << 20  # drives are nodes from here on, clients from 0


class Drive(Protocol):
    @property
    def brake_closed(self) -> bool: ...
    @property
    def is_enabled(self) -> bool: ...

    age: float  # s since its last tick: an encoder is read when it is asked
    offset: float  # rad that the encoder is off
    drift: float  # rad/s by which that grows
    coil_c: float  # deg C
    is_silent: bool  # it hears, but its transceiver is dead
    heart_stopped: bool  # its cyclic answers go on, its heartbeat does not

    def cut_power(self) -> None: ...
    def restore_power(self) -> None: ...
    def trip_over_current(self) -> None: ...
    def say_emergency(self, code: int) -> None:
        """And go on as if nothing were."""

    def stop_by_itself(self) -> None: ...
    def jam_brake(self, closed: bool, contact: bool) -> None:
        """It, or its contact only, stays so."""

    def forget_number(self) -> None:
        """As it comes from its maker."""

    def ignore_targets(self) -> None:
        """And tell so."""

    def switch_off(self) -> None:
        """As if told to by a stranger."""

    def hear(self, frame: Frame) -> list[Frame]:
        """Its answers to a frame that passed on the bus."""

    def speak(self, elapsed_ns: int) -> list[Frame]:
        """What it says unasked after a tick."""

    def tick(self, q: float, dq: float, elapsed_ns: int) -> float:
        """Torque of the coming tick, Nm."""


class Mechanics(Protocol):
    @property
    def q(self) -> npt.NDArray[np.float64]: ...
    @property
    def dq(self) -> npt.NDArray[np.float64]: ...
    def step(self, torque: npt.NDArray[np.float64], braked: npt.NDArray[np.bool_], seconds: float) -> None: ...


class Line:
    """Drive i turns joint i of the mechanics; drives beyond the joints turn nothing (a duplicate on the bus).

    Faults of the wire, by drive: `lose` so many of its frames, `late` so many ns on every answer, `echo` twice, `short`
    of the last byte.
    """

    def __init__(self, drives: Sequence[Drive], mechanics: Mechanics, bus: Bus | None = None) -> None:
        self.drives, self.mechanics, self.bus = drives, mechanics, bus or Bus()
        self.listeners: list[Callable[[Delivery], None]] = []
        self.lose: Counter[int] = Counter()
        self.late: dict[int, int] = {}
        self.echo: set[int] = set()
        self.short: set[int] = set()
        self.babble: Frame | None = None  # said by a stranger after each tick
        self.on_stand = False  # a stand carries the arm until every drive has power
        self.gone = False  # the interface of every client is unplugged
        self.full = 0  # frames that the clients' transmit queues will refuse
        self.blocked: set[int] = set()  # joints that something holds
        self.begin(0)
        for i in range(len(drives)):
            self.bus.join(FIRST_DRIVE + i)

    def begin(self, t_ns: int) -> None:
        """It is `t_ns` now; what lies before nobody has lived through."""
        self.now_ns = self._ticked_ns = t_ns
        self._tick_ns = t_ns + TICK_NS

    @property
    def due_ns(self) -> int:
        """When the next tick is."""
        return self._tick_ns

    def next(self, until_ns: int) -> Delivery | None:
        """The next frame on the wire by then, heard and answered by the drives."""
        delivery = self.bus.next(until_ns)
        if delivery is not None:
            for listener in self.listeners:
                listener(delivery)
            if delivery.to is None:
                self._answer(delivery)
        return delivery

    def advance(self, until_ns: int) -> Delivery | None:
        """The next frame until then, after every tick that is due before it; None: it is `until_ns` now."""
        while True:
            stop_ns = min(until_ns, self._tick_ns)
            if (delivery := self.next(stop_ns)) is not None:
                self.now_ns = max(self.now_ns, delivery.t_ns)
                return delivery
            self.now_ns = max(self.now_ns, stop_ns)
            if self._tick_ns > until_ns:
                return None
            self.tick(self._tick_ns)
            self._tick_ns += TICK_NS

    def settle(self) -> Delivery | None:
        """The next frame that waits on the bus, however long it takes; None: there is none."""
        while self.bus.is_busy:
            if (delivery := self.advance(self._tick_ns)) is not None:
                return delivery
        return None

    def tick(self, t_ns: int) -> None:
        """One tick of drives and mechanics, at `t_ns` of the bus."""
        self._ticked_ns = t_ns
        n = len(self.mechanics.q)
        q, dq = self.mechanics.q, self.mechanics.dq
        torque = np.zeros(n)
        for i, drive in enumerate(self.drives):
            turned = i if i < n else 0
            tau = drive.tick(float(q[turned]), float(dq[turned]), TICK_NS)
            if i < n:
                torque[i] = tau
            self._say(i, drive.speak(TICK_NS), t_ns)
        if self.babble is not None:
            self.bus.submit(FIRST_DRIVE - 1, self.babble, t_ns)
        self.on_stand &= not all(drive.is_enabled for drive in self.drives[:n])
        braked = np.array(
            [drive.brake_closed or self.on_stand or i in self.blocked for i, drive in enumerate(self.drives[:n])]
        )
        self.mechanics.step(torque, braked, TICK_NS * 1e-9)

    def _answer(self, delivery: Delivery) -> None:
        age = min(max(delivery.t_ns - self._ticked_ns, 0), TICK_NS) * 1e-9
        for i, drive in enumerate(self.drives):
            if delivery.sender != FIRST_DRIVE + i and FIRST_DRIVE + i not in self.bus.off:
                drive.age = age
                self._say(i, drive.hear(delivery.frame), delivery.t_ns + ANSWER_NS)

    def _say(self, i: int, frames: list[Frame], t_ns: int) -> None:
        for frame in frames * (2 if i in self.echo else 1):
            if self.lose[i] > 0:
                self.lose[i] -= 1
                continue
            if i in self.short:
                frame = replace(frame, data=frame.data[:-1])
            self.bus.submit(FIRST_DRIVE + i, frame, t_ns + self.late.get(i, 0))
