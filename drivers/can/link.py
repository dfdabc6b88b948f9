"""The bus through python-can: any interface that it knows by name. One thread; nothing here waits but `receive`.

Whether the bus is well is read from error frames: python-can's `state` says ACTIVE on SocketCAN whatever happens.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import can

from drivers.base import LinkError
from drivers.can.frame import Frame

Clock = Callable[[], int]  # monotonic ns
Open = Callable[[], can.BusABC]

_CONTROLLER, _ACK, _BUS_OFF, _RESTARTED = 0x04, 0x20, 0x40, 0x100  # classes of an error frame, linux/can/error.h
_OVERFLOW, _PASSIVE = 0x03, 0x30  # bits of its data[1]


@dataclass(slots=True)
class BusHealth:
    """Latched: only opening the link anew clears it."""

    passive: bool = False  # error passive: the wire is bad, and still carries
    off: bool = False  # bus-off: nothing can be said any more
    unacknowledged: bool = False  # nobody else is on the wire
    backlog: bool = False  # frames were refused or lost: more than a cycle waits
    gone: str = ""  # why the interface is gone


def opener(interface: str, channel: str, is_fd: bool) -> Open:
    """How to open a bus by python-can's names; bit rates of SocketCAN are set with `ip link`, not here."""
    more: dict[str, Any] = {"fd": True} if is_fd and interface == "socketcan" else {}
    if interface == "virtual":
        more["protocol"] = can.CanProtocol.CAN_FD if is_fd else can.CanProtocol.CAN_20
    return lambda: can.Bus(interface=interface, channel=channel, **more)


class Link:
    """`send` and `receive` never raise: what is wrong with the bus is in `health`."""

    def __init__(self, open_bus: Open, clock: Clock = time.monotonic_ns) -> None:
        self.now_ns = clock
        self.health = BusHealth()
        self._open = open_bus
        self._bus: can.BusABC | None = None

    def open(self) -> None:
        """LinkError: there is no such bus. Idempotent."""
        if self._bus is not None:
            return
        self.health = BusHealth()
        try:
            self._bus = self._open()
        except (can.CanError, OSError, ValueError, NotImplementedError) as error:
            raise LinkError(f"the CAN bus cannot be opened: {error}", hint=_OPEN_HINT) from error

    def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    @property
    def is_open(self) -> bool:
        return self._bus is not None

    def send(self, frames: Iterable[Frame]) -> int:
        """How many the interface took."""
        taken = 0
        for frame in frames:
            if self._bus is None or self.health.gone or self.health.off:
                return taken
            try:
                self._bus.send(_message(frame), timeout=0)
                taken += 1
            except (can.CanError, OSError) as error:
                self._note(error)
        return taken

    def receive(self, deadline_ns: int) -> Frame | None:
        """The next frame from the wire; None: the deadline has passed, or the bus is gone."""
        while self._bus is not None and not self.health.gone:
            wait = max(0, deadline_ns - self.now_ns()) * 1e-9
            try:
                message = self._bus.recv(wait)
            except (can.CanError, OSError) as error:
                self._note(error)
                return None
            if message is None:
                return None
            if not message.is_error_frame:
                return Frame(message.arbitration_id, bytes(message.data), message.is_fd, message.timestamp)
            self._hear(message)
        return None

    def _hear(self, message: can.Message) -> None:
        kind, detail = message.arbitration_id, message.data[1] if message.dlc > 1 else 0
        self.health.off |= bool(kind & _BUS_OFF)
        self.health.unacknowledged |= bool(kind & _ACK)
        if kind & _CONTROLLER:
            self.health.passive |= bool(detail & _PASSIVE)
            self.health.backlog |= bool(detail & _OVERFLOW)

    def _note(self, error: Exception) -> None:
        """A full transmit queue is a backlog; everything else: the interface is gone."""
        if _is_full(error):
            self.health.backlog = True
        else:
            self.health.gone = str(error)


def _is_full(error: Exception) -> bool:
    """python-can tells a full queue by its text or its error code only."""
    code = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return code in (105, 11) or "buffer full" in str(error).lower()


def _message(frame: Frame) -> can.Message:
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        is_extended_id=False,
        is_fd=frame.is_fd,
        bitrate_switch=frame.is_fd,
    )


_OPEN_HINT = "check driver.interface and driver.channel, and that the interface is up: ip -d link show"
