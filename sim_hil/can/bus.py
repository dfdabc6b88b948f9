"""The wire itself: one frame at a time, the lowest identifier first, each as long as its bits last.

What one node has to send it sends in the order of asking, as the queue of a controller does: only its first frame takes
part in the arbitration. So a SYNC comes after the targets that were sent before it.

Without it a simulated bus carries what no wire can: fourteen classic frames at 1 kHz are 189 % of 1 Mbit/s.
Errors count as in ISO 11898-1: a destroyed frame costs its sender 8, a good one gives 1 back; from 128 on the sender is
error passive, above 255 it is off the bus. A sender whom nobody acknowledges becomes passive and stays on.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

from sim_hil.can.frames import (
    ERROR_ACK,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_TX_PASSIVE,
    ERROR_TX_WARNING,
    EXTENDED,
    Frame,
    error,
)

QUEUE_NS = 20_000_000  # ASSUMED: so much of unsent bus time a controller's transmit queue holds
WARNING, PASSIVE, OFF = 96, 128, 256  # transmit error counter
ERROR_BITS = 31  # flag, echo, delimiter and pause after a destroyed frame


@dataclass(frozen=True, slots=True)
class Delivery:
    t_ns: int  # end of frame
    sender: int
    frame: Frame
    to: int | None = None  # None: everybody but the sender; else what a node's own controller tells it


class Bus:
    """Nodes `join` and `submit` frames; `next` gives them back one by one as they passed."""

    def __init__(self, bitrate: float = 1e6, data_bitrate: float = 5e6) -> None:
        self.busy_ns = 0  # of all time
        self.off: set[int] = set()  # nodes in bus-off
        self.errors: Counter[int] = Counter()  # transmit error counter of each node
        self.corrupt: Counter[int] = Counter()  # frames of a node that will be destroyed on the wire
        self._bitrate, self._data_bitrate = bitrate, data_bitrate
        self._nodes: set[int] = set()
        self._queues: dict[int, deque[tuple[int, Frame, int]]] = {}  # of each sender: ready at, frame, ns on the wire
        self._told: list[Delivery] = []  # to a node by its own controller
        self._free_ns = 0  # the frame on the wire is over

    def join(self, node: int) -> None:
        self._nodes.add(node)

    def leave(self, node: int) -> None:
        """It hears nothing any more; what it has asked to send is still sent, as the queue of an interface does."""
        self._nodes.discard(node)

    def clients(self, first_drive: int) -> list[int]:
        """Nodes that are no drives."""
        return [node for node in self._nodes if node < first_drive]

    def reset(self, node: int) -> None:
        """The node's interface is taken down and up again: the only way out of bus-off."""
        self.off.discard(node)
        self.errors[node] = 0

    def submit(self, sender: int, frame: Frame, t_ns: int) -> bool:
        """False: the sender's queue is full, or it is in bus-off; the frame is lost."""
        if sender in self.off:
            return False
        queue = self._queues.setdefault(sender, deque())
        if sum(duration for _, _, duration in queue) + max(0, self._free_ns - t_ns) > QUEUE_NS:
            return False
        queue.append((t_ns, frame, self.duration_ns(frame)))
        return True

    @property
    def is_busy(self) -> bool:
        """Somebody waits to send, or to be told."""
        return bool(self._told) or any(self._queues.values())

    def next(self, until_ns: int | None = None) -> Delivery | None:
        """The next frame that ends by then (None: ever), or the next thing that a controller tells its node."""
        while not self._told and (first := [(*queue[0], node) for node, queue in self._queues.items() if queue]):
            start = max(self._free_ns, min(ready for ready, _, _, _ in first))
            _, frame, duration, sender = min((e for e in first if e[0] <= start), key=lambda entry: _priority(entry[1]))
            if until_ns is not None and start + duration > until_ns:
                return None
            self._free_ns = start + duration
            self.busy_ns += duration
            if (passed := self._pass(sender, frame)) is not None:
                return passed
        return self._told.pop(0) if self._told else None

    def _pass(self, sender: int, frame: Frame) -> Delivery | None:
        """What comes of the frame that has won the wire; None: nothing that anybody hears."""
        if self.corrupt[sender] > 0:
            self.corrupt[sender] -= 1
            self._free_ns += round(ERROR_BITS / self._bitrate * 1e9)
            self._count(sender, 8)
            return None
        self._queues[sender].popleft()
        if not self._nodes - {sender} - self.off:
            self._count(sender, 8 if self.errors[sender] < PASSIVE else 0)
            self._tell(sender, error(ERROR_ACK))
            return None
        self.errors[sender] = max(0, self.errors[sender] - 1)
        return Delivery(self._free_ns, sender, frame)

    def _count(self, node: int, more: int) -> None:
        before, now = self.errors[node], self.errors[node] + more
        self.errors[node] = now
        if before < OFF <= now:
            self.off.add(node)
            self._queues.pop(node, None)
            self._tell(node, error(ERROR_BUS_OFF))
        elif before < PASSIVE <= now:
            self._tell(node, error(ERROR_CONTROLLER, ERROR_TX_PASSIVE))
        elif before < WARNING <= now:
            self._tell(node, error(ERROR_CONTROLLER, ERROR_TX_WARNING))

    def _tell(self, node: int, frame: Frame) -> None:
        self._told.append(Delivery(self._free_ns, node, frame, to=node))

    def duration_ns(self, frame: Frame) -> int:
        """With every stuff bit that the data could ask for, and the pause between frames."""
        n = len(frame.data)
        if not frame.is_fd:
            plain = 64 if frame.id & EXTENDED else 44  # from start to end of frame
            stuffable = plain - 10 + 8 * n  # start of frame to CRC
            return round((plain + 3 + 8 * n + (stuffable - 1) // 4) / self._bitrate * 1e9)
        crc = 17 if n <= 16 else 21
        data_phase = 5 + 8 * n + (5 + 8 * n) // 4 + (4 + crc) + 1 + (4 + crc) // 4
        rate = self._data_bitrate if frame.switches_rate else self._bitrate
        return round((34 / self._bitrate + data_phase / rate) * 1e9)


def _priority(frame: Frame) -> tuple[int, bool]:
    """A standard identifier wins over an extended one that begins with the same 11 bits."""
    is_extended = bool(frame.id & EXTENDED)
    number = frame.id & 0x1FFF_FFFF
    return (number if is_extended else number << 18), is_extended
