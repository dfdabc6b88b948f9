"""A bus of python-can between the driver and a simulated line, in lockstep: every frame goes through the interface.

The bit times, errors and drives are the line's. What is the interface's own: opening it by name, its messages, their
flags and lengths, and what it does with error frames.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from drivers.can.link import opener
from sim_hil.can.plugin import SimulatedBus

VCAN, FD_MTU = "vcan0", 72
PATIENCE_S = 10.0  # for a frame that is on its way through the interface
_numbers = itertools.count()


def has_vcan() -> bool:
    """ip link add dev vcan0 type vcan; ip link set vcan0 mtu 72 up"""
    mtu = Path(f"/sys/class/net/{VCAN}/mtu")
    return mtu.exists() and int(mtu.read_text()) >= FD_MTU


class Through:
    """As a bus, for the driver. Time passes while it waits; frames are stamped with the time of the line."""

    def __init__(self, interface: str, is_fd: bool, line: SimulatedBus) -> None:
        self._interface, self._is_fd, self._line = interface, is_fd, line
        channel = VCAN if interface == "socketcan" else f"through-{next(_numbers)}"
        open_bus: Callable[[], can.BusABC] = opener(interface, channel, is_fd)
        self._near, self._far = open_bus(), open_bus()

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self._near.send(message, timeout)
        arrived = self._far.recv(PATIENCE_S)
        assert arrived is not None, "lost on the way out"
        self._line.send(arrived)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        told = self._line.recv(timeout)
        if told is None:
            return None
        self._far.send(told)
        heard = self._near.recv(PATIENCE_S)
        assert heard is not None, "lost on the way in"
        heard.timestamp = told.timestamp
        return heard

    def shutdown(self) -> None:
        for bus in (self._near, self._far, self._line):
            bus.shutdown()

    def __deepcopy__(self, memo: dict[int, Any]) -> Through:
        """On a channel of its own."""
        return Through(self._interface, self._is_fd, copy.deepcopy(self._line, memo))
