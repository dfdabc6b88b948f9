"""`can.Bus(interface="asc-sim", channel=NAME)`: the simulated bus for any client of python-can.

NAME is an abstract Unix socket: it leaves no file behind and does not leave this machine. With `line=` a client is
on a `Line` of its own process instead, in lockstep: time passes only while it waits to receive.
One datagram a frame: eight bytes of time in ns (monotonic, when it was sent; of the bus, when it ended), then the frame
as SocketCAN has it.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections import deque
from typing import Any

import can

from sim_hil.can.bus import Delivery
from sim_hil.can.frames import (
    ERROR,
    ERROR_CONTROLLER,
    ERROR_TX_OVERFLOW,
    EXTENDED,
    NUMBER,
    REMOTE,
    Frame,
    error,
    pack,
    unpack,
)
from sim_hil.can.line import Line

STAMP = struct.Struct("<q")
MAX_RECORD = STAMP.size + 72


def address(channel: str) -> str:
    """Of the Unix socket."""
    return f"\0asc-sim/{channel}"


class SimulatedBus(can.BusABC):
    """can.CanInitializationError: nobody is there. can.CanOperationError: the bus has gone."""

    def __init__(self, channel: str, can_filters: Any = None, line: Line | None = None, **kwargs: Any) -> None:
        self.channel_info = f"simulated bus {channel}"
        self._name = channel  # of each message; one word, because candump logs divide at spaces
        self._peer: _Socket | _Lockstep = _Socket(channel) if line is None else _Lockstep(line)
        super().__init__(channel, can_filters=can_filters, **kwargs)
        self._can_protocol = can.CanProtocol.CAN_FD

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if not msg.is_fd and msg.dlc > 8:
            raise can.CanOperationError("a classic frame has at most 8 data bytes")
        flags = (EXTENDED if msg.is_extended_id else 0) | (REMOTE if msg.is_remote_frame else 0)
        self._peer.send(Frame(msg.arbitration_id | flags, bytes(msg.data), msg.is_fd, msg.bitrate_switch))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """As any bus; in lockstep `timeout` is in the time of the line."""
        if isinstance(self._peer, _Socket):
            return super().recv(timeout)
        while True:
            received, filtered = self._recv_internal(timeout)
            if received is None or filtered or self._matches_filters(received):
                return received

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        received = self._peer.receive(timeout)
        return None if received is None else message(*received, self._name), False

    def fileno(self) -> int:
        return self._peer.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._peer.close()


def message(t_ns: int, frame: Frame, channel: str) -> can.Message:
    return can.Message(
        timestamp=t_ns * 1e-9,
        arbitration_id=frame.id & NUMBER,
        is_extended_id=bool(frame.id & EXTENDED),
        is_remote_frame=bool(frame.id & REMOTE),
        is_error_frame=bool(frame.id & ERROR),
        data=frame.data,
        is_fd=frame.is_fd,
        bitrate_switch=frame.switches_rate,
        channel=channel,
    )


class _Socket:
    def __init__(self, channel: str) -> None:
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._link.connect(address(channel))
        except OSError as failed:
            self._link.close()
            raise can.CanInitializationError(f"no simulated bus {channel!r}: {failed.strerror}") from failed
        self._link.setblocking(False)

    def send(self, frame: Frame) -> None:
        try:
            self._link.send(STAMP.pack(time.monotonic_ns()) + pack(frame))
        except OSError as failed:
            raise can.CanOperationError(f"the simulated bus does not take the frame: {failed.strerror}") from failed

    def receive(self, timeout: float | None) -> tuple[int, Frame] | None:
        if not select.select([self._link], [], [], timeout)[0]:
            return None
        try:
            raw = self._link.recv(MAX_RECORD)
        except OSError as failed:
            raise can.CanOperationError(f"the simulated bus has failed: {failed.strerror}") from failed
        if not raw:
            raise can.CanOperationError("the simulated bus has gone")
        return STAMP.unpack_from(raw)[0], unpack(raw[STAMP.size :])

    def fileno(self) -> int:
        return self._link.fileno()

    def close(self) -> None:
        self._link.close()


class _Lockstep:
    """One of the clients of a line. Whoever lets time pass, each keeps what is for it until it asks."""

    _clients = 0

    def __init__(self, line: Line) -> None:
        self._line = line
        self._node = _Lockstep._clients
        _Lockstep._clients += 1
        line.bus.join(self._node)
        self._kept: deque[Delivery] = deque()
        line.listeners.append(self._keep)

    def _keep(self, delivery: Delivery) -> None:
        if is_for(delivery, self._node):
            self._kept.append(delivery)

    def send(self, frame: Frame) -> None:
        self._check()
        self._line.full, refused = max(0, self._line.full - 1), self._line.full > 0
        if refused or not self._line.bus.submit(self._node, frame, self._line.now_ns):
            raise can.CanOperationError("transmit buffer full")

    def _check(self) -> None:
        if self._line.gone:
            raise can.CanOperationError("the simulated bus has gone")

    def receive(self, timeout: float | None) -> tuple[int, Frame] | None:
        """Time passes until there is a frame for this client."""
        self._check()
        until_ns = self._line.now_ns + round((timeout or 0.0) * 1e9)
        while not self._kept:
            if self._line.advance(until_ns) is None:
                return None
        delivery = self._kept.popleft()
        return delivery.t_ns, delivery.frame

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._line.listeners.remove(self._keep)
        self._line.bus.leave(self._node)


def is_for(delivery: Delivery, node: int) -> bool:
    """A node hears the others, and what its own controller tells."""
    return delivery.sender != node if delivery.to is None else delivery.to == node


def refusal() -> Frame:
    """What a controller tells whose queue is full."""
    return error(ERROR_CONTROLLER, ERROR_TX_OVERFLOW)
