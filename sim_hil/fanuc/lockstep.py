"""A controller in the PC's own thread and in simulated time: waiting for a packet runs its cycles.

Stands where a driver has its UDP transport. As exact as the wire, as fast as the machine, and without a clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from sim_hil.fanuc.cabinet import Device
from sim_hil.fanuc.rmi import RmiServer

PC = ("127.0.0.1", 50000)

Channel = Callable[[bytes], list[bytes]]  # what arrives of one datagram: [] lost, twice the same: repeated


def _perfect(data: bytes) -> list[bytes]:
    return [data]


class Lockstep:
    foreign = 0

    def __init__(self, controller: Device, t_ns: int = 0) -> None:
        self.controller = controller
        self.to_pc: Channel = _perfect
        self.to_robot: Channel = _perfect
        self.powered = True  # False: the controller does not run any more
        self._period_ns = round(controller.settings.period_ms * 1e6)
        self._now_ns = t_ns
        self._next_ns = t_ns + self._period_ns
        self._outbox: list[bytes] = []
        self._inbox: deque[tuple[int, bytes]] = deque()

    def open(self) -> None:
        """Nothing to open."""

    def close(self) -> None:
        self._inbox.clear()

    def now_ns(self) -> int:
        return self._now_ns

    def send(self, data: bytes) -> int:
        self._outbox += self.to_robot(data)
        return self._now_ns

    def receive(self, deadline_ns: int) -> tuple[int, bytes] | None:
        while not self._inbox:
            if deadline_ns < self._next_ns:
                self._now_ns = max(self._now_ns, deadline_ns)
                return None
            self.run(1)
        return self._inbox.popleft()

    def run(self, cycles: int) -> None:
        """Let simulated time pass for the controller while the PC does something else."""
        for _ in range(cycles):
            self._now_ns = self._next_ns
            self._next_ns += self._period_ns
            if not self.powered:
                continue
            packets, self._outbox = [(PC, data) for data in self._outbox], []
            for _, reply in self.controller.cycle(packets):
                self._inbox.extend((self._now_ns, data) for data in self.to_pc(reply))


class RmiLine:
    """Stands where a driver has its RMI connection; each exchange takes a cycle."""

    def __init__(self, wire: Lockstep, server: RmiServer) -> None:
        self._wire, self._server = wire, server
        self._replies: deque[bytes] = deque()

    def open(self, port: int) -> None:
        """Whatever the port, it is this server."""
        self._replies.clear()

    def now_ns(self) -> int:
        return self._wire.now_ns()

    def send(self, line: bytes) -> None:
        if self._wire.powered:
            self._replies.extend(self._server.handle(line))

    def receive(self, deadline_ns: int) -> bytes | None:
        while not self._replies and self._wire.now_ns() < deadline_ns:
            self._wire.run(1)
        self._wire.run(1)
        return self._replies.popleft() if self._replies else None

    def close(self) -> None:
        """Nothing to close."""
