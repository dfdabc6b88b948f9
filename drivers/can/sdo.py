"""Service data of CANopen nodes through the `canopen` library, in this thread.

Answers are pumped from the link while the client waits, so that no notifier thread of the library is needed.
"""

from __future__ import annotations

import struct
from importlib import resources
from typing import Any

import canopen
from canopen.sdo import SdoClient
from canopen.sdo.exceptions import SdoCommunicationError

from drivers.can.frame import Frame
from drivers.can.link import Link

TIMEOUT_NS = 50_000_000
EDS = "cia402.eds"


def dictionary(node: int) -> Any:
    """The object dictionary that these drives must have."""
    with resources.as_file(resources.files("drivers.can") / EDS) as path:
        return canopen.import_od(str(path), node)


class _Network:
    """What the client needs of a network."""

    def __init__(self, link: Link) -> None:
        self._link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._link.send([Frame(can_id, bytes(data))])


class Service(SdoClient):
    """Objects of one node by `self[index].raw`, `self[index][sub].raw`. canopen.SdoError: refused, or no answer."""

    def __init__(self, link: Link, node: int) -> None:
        super().__init__(0x600 + node, 0x580 + node, dictionary(node))
        self.network: Any = _Network(link)
        self._link = link

    def __getitem__(self, index: Any) -> Any:
        return super().__getitem__(index)

    def read_response(self) -> bytes:
        deadline_ns = self._link.now_ns() + TIMEOUT_NS
        while self.responses.empty():
            frame = self._link.receive(deadline_ns)
            if frame is None:
                raise SdoCommunicationError("no answer")
            if frame.id == self.tx_cobid:
                self.on_response(frame.id, frame.data, 0.0)
        response: bytes = super().read_response()
        return response


def answers(link: Link, node: int) -> int:
    """How many nodes answer to this number: asks for the device type and counts."""
    link.send([Frame(0x600 + node, struct.pack("<BHB4x", 0x40, 0x1000, 0))])
    count, deadline_ns = 0, link.now_ns() + TIMEOUT_NS // 5
    while (frame := link.receive(deadline_ns)) is not None:
        if frame.id == 0x580 + node:
            count += 1
            deadline_ns = min(deadline_ns, link.now_ns() + 1_000_000)
    return count
