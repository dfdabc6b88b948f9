"""Layer setting services (CiA 305) through the `canopen` library, in this thread: a number for a drive that has none.

A drive as it comes from its maker may have no node number: it hears nothing else, and answers nothing else.
"""

from __future__ import annotations

from typing import Any

from canopen.lss import LssError, LssMaster

from drivers.can.frame import Frame
from drivers.can.link import Link

__all__ = ["LssError", "assign", "is_nameless_there"]

ANSWER_NS = 20_000_000
IDENTIFY_NAMELESS, IS_NAMELESS = 0x4C, 0x50
WAITING = LssMaster.WAITING_STATE


class _Master(LssMaster):
    """Answers are pumped from the link before the library waits for them, so that no other thread is needed."""

    RESPONSE_TIMEOUT = 0.0

    def __init__(self, link: Link) -> None:
        super().__init__()
        self.network: Any = self
        self._link = link

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._link.send([Frame(can_id, bytes(data))])
        deadline_ns = self._link.now_ns() + ANSWER_NS
        while (frame := self._link.receive(deadline_ns)) is not None:
            if frame.id == self.LSS_RX_COBID and self.responses.empty():
                self.on_message_received(frame.id, frame.data, 0.0)
                deadline_ns = min(deadline_ns, self._link.now_ns() + 1_000_000)  # others answer the same at once


def is_nameless_there(link: Link) -> bool:
    """Does a drive without a node number listen on this bus? Changes nothing."""
    link.send([Frame(LssMaster.LSS_TX_COBID, bytes([IDENTIFY_NAMELESS, *[0] * 7]))])
    deadline_ns = link.now_ns() + ANSWER_NS
    while (frame := link.receive(deadline_ns)) is not None:
        if frame.id == LssMaster.LSS_RX_COBID and frame.data[:1] == bytes([IS_NAMELESS]):
            return True
    return False


def assign(link: Link, number: int) -> list[int]:
    """Find the drive that has no number, give it this one and let it store it: [vendor, product, revision, serial].

    LssError: there is none, it refuses, or it does not store it.
    """
    master = _Master(link)
    master.send_switch_state_global(WAITING)
    found, identity = master.fast_scan()  # leaves it, and it alone, waiting for its settings
    if not found:
        raise LssError("no drive without a node number answers")
    try:
        master.configure_node_id(number)
        master.store_configuration()
    finally:
        master.send_switch_state_global(WAITING)  # from here on it is known by its number
    return list(identity)
